//! Formatter: writes a text in its canonical form.
//!
//! In: a text without errors. Out: the same text with one statement per line, canonical blanks and units, and aligned
//! columns of adjacent declarations and equations. Keeps comments, blank lines and line breaks within statements. Moves
//! tokens only and never changes the syntax tree.

use std::collections::{HashMap, HashSet};

use crate::diagnostic::Diagnostic;
use crate::parse::derivatives;
use crate::span::FileId;
use crate::split::{Piece, Place, Source};
use crate::tokens::{Token, TokenKind, is_context_word, is_keyword, tokens};

/// Default columns of ranges and comments.
const RANGE_COLUMN: usize = 27;
const COMMENT_COLUMN: usize = 53;

/// Limit on the number of layout passes over a text.
const PASSES_MAX: usize = 16;

/// The canonical form of `text`, or its errors. A line longer than `width` is broken after a comma in brackets, if it
/// has one.
pub fn format(text: &str, width: usize) -> Result<String, Vec<Diagnostic>> {
    let mut text = once(text, width)?;
    // A broken line may move a column, and a moved column may break a line. Breaks are only added, so this terminates.
    for _ in 0..PASSES_MAX {
        let next = once(&text, width)?;
        if next == text {
            break;
        }
        text = next;
    }
    Ok(text)
}

fn once(text: &str, width: usize) -> Result<String, Vec<Diagnostic>> {
    let strokes = derivatives(text)?;
    let source = Source::new(FileId::default(), text);
    let mut layout = Layout::new(&source, strokes);
    layout.structure();
    layout.lines();
    layout.heads();
    layout.fold(width);
    let runs = layout.runs();
    layout.names(&runs);
    layout.arguments();
    layout.chosen();
    layout.columns(&runs);
    Ok(layout.write())
}

/// Canonical form of a unit: products before quotients, `·` for products, ASCII otherwise.
pub fn canonical_unit(unit: &str) -> String {
    let plain = unit.replace('*', "·").replace(['µ', 'μ'], "u").replace('°', "deg").replace('Ω', "Ohm");
    let (mut over, mut under): (Vec<String>, Vec<String>) = (Vec::new(), Vec::new());
    let mut divide = false;
    let mut atom = String::new();
    let mut flush = |atom: &mut String, divide: bool| {
        let (base, power) = atom.split_at(atom.find('^').unwrap_or(atom.len()));
        let side = if divide { &mut under } else { &mut over };
        match base.strip_suffix("Nm") {
            Some(prefix) if prefix.len() <= 1 && power.is_empty() => {
                side.push(format!("{prefix}N"));
                side.push("m".to_string());
            }
            _ => side.push(atom.clone()),
        }
        atom.clear();
    };
    for letter in plain.chars() {
        match letter {
            '·' | '/' => {
                flush(&mut atom, divide);
                divide = letter == '/';
            }
            _ => atom.push(letter),
        }
    }
    flush(&mut atom, divide);
    if over.len() > 1 {
        over.retain(|atom| atom != "1");
    }
    let mut result = over.join("·");
    for atom in under {
        result.push('/');
        result.push_str(&atom);
    }
    result
}

/// A line of the output.
struct Line {
    /// Marks of the line; empty for a line with only a comment.
    piece: Piece,
    comment: Option<Token>,
    /// Whether a blank line precedes it.
    gap: bool,
}

/// The start of a statement or item.
#[derive(Clone, Copy)]
struct Start {
    level: usize,
    place: Option<Place>,
    /// The enclosing block: the index of its `{`, or `usize::MAX`.
    block: usize,
}

struct Layout<'s, 't> {
    source: &'s Source<'t>,
    /// Offsets of the slashes of derivatives.
    strokes: HashSet<usize>,
    /// The canonical characters of each mark.
    words: Vec<String>,
    starts: Vec<Option<Start>>,
    /// For a `}` on a line of its own: the nesting level of its statement.
    closers: HashMap<usize, usize>,
    lines: Vec<Line>,
    /// Additional blanks before a mark.
    pads: HashMap<usize, usize>,
    /// Column of the comment of a line.
    comments: HashMap<usize, usize>,
}

/// Words that begin a column.
const COLUMN_WORDS: [&str; 7] = ["in", "limit", "slew", "at", "byte", "as", "scale"];

impl<'s, 't> Layout<'s, 't> {
    fn new(source: &'s Source<'t>, strokes: HashSet<usize>) -> Layout<'s, 't> {
        let words = (0..source.marks.len())
            .map(|at| match source.kind(at) {
                Some(TokenKind::Unit) => canonical_unit(source.word(at)),
                _ => source.word(at).to_string(),
            })
            .collect();
        let starts = vec![None; source.marks.len()];
        let (closers, pads, comments) = (HashMap::new(), HashMap::new(), HashMap::new());
        Layout { source, strokes, words, starts, closers, lines: Vec::new(), pads, comments }
    }

    // ---- structure

    fn structure(&mut self) {
        for piece in self.source.items() {
            let place = match self.source.word(piece.start) {
                "interface" => Some(Place::Interface),
                "model" => Some(Place::Model),
                "experiment" => Some(Place::Experiment),
                "fit" => Some(Place::Fit),
                "device" => Some(Place::Device),
                "rig" => Some(Place::Rig),
                _ => None,
            };
            self.starts[piece.start] = Some(Start { level: 0, place: None, block: usize::MAX });
            if let Some(place) = place {
                self.block(piece, place, 0);
            }
        }
    }

    fn block(&mut self, piece: Piece, place: Place, level: usize) {
        let Some((open, inside)) = self.source.block(piece) else { return };
        let (from, to) = (self.source.marks[open].line, self.source.marks.get(inside.end).map_or(0, |mark| mark.line));
        let empty = inside.start == inside.end;
        if from == to && (place == Place::Resets || empty) {
            return;
        }
        self.closers.insert(inside.end, level);
        for piece in self.source.statements(place, inside) {
            self.starts[piece.start] = Some(Start { level: level + 1, place: Some(place), block: open });
            let inner = match self.source.word(piece.start) {
                "every" => Place::Every,
                "mode" => Place::Mode,
                "when" | "go" => Place::Resets,
                "hardware" => Place::Hardware,
                "case" if place == Place::Fit => Place::Case,
                _ => continue,
            };
            self.block(piece, inner, level + 1);
        }
    }

    /// Splits the text into lines: at its own line breaks, and before each statement of a block.
    fn lines(&mut self) {
        let mut lines: Vec<Line> = Vec::new();
        let (mut mark, mut newlines) = (0, 2);
        for token in tokens(self.source.text) {
            match token.kind {
                TokenKind::Blank => {}
                TokenKind::Newline => newlines += 1,
                TokenKind::Comment | TokenKind::Doc => {
                    match lines.last_mut() {
                        Some(line) if newlines == 0 => line.comment = Some(token),
                        _ => lines.push(Line {
                            piece: Piece { start: mark, end: mark },
                            comment: Some(token),
                            gap: newlines > 1,
                        }),
                    }
                    newlines = 0;
                }
                _ => {
                    let breaks = newlines > 0 || self.starts[mark].is_some() || self.closers.contains_key(&mark);
                    match lines.last_mut() {
                        Some(line) if !breaks => line.piece.end = mark + 1,
                        _ => lines.push(Line {
                            piece: Piece { start: mark, end: mark + 1 },
                            comment: None,
                            gap: newlines > 1,
                        }),
                    }
                    (mark, newlines) = (mark + 1, 0);
                }
            }
        }
        if let Some(first) = lines.first_mut() {
            first.gap = false;
        }
        self.lines = lines;
    }

    /// Breaks lines that are too long after a comma of the outermost brackets.
    fn fold(&mut self, width: usize) {
        let mut folded: Vec<Line> = Vec::with_capacity(self.lines.len());
        for line in std::mem::take(&mut self.lines) {
            let Piece { mut start, end } = line.piece;
            let indent = match self.starts.get(start).copied().flatten() {
                Some(start) => 2 * start.level,
                None => self.source.marks.get(start).map_or(0, |mark| self.old_column(mark.token.start)),
            };
            let (mut gap, mut depth, mut column, mut open) = (line.gap, 0usize, indent, 0);
            // The last comma after which the line may be broken, with its end column.
            let mut comma: Option<(usize, usize)> = None;
            for at in line.piece.start..end {
                column += self.space(at, start) + self.pad(at) + self.width(at);
                match self.source.word(at) {
                    "(" => {
                        depth += 1;
                        if depth == 1 {
                            open = column;
                        }
                    }
                    ")" => depth = depth.saturating_sub(1),
                    _ => {}
                }
                if column > width
                    && let Some((break_at, ended)) = comma.take()
                {
                    folded.push(Line { piece: Piece { start, end: break_at + 1 }, comment: None, gap });
                    (start, gap) = (break_at + 1, false);
                    column = open + (column - ended).saturating_sub(1);
                }
                if depth == 1 && self.source.word(at) == "," && at + 1 < end {
                    comma = Some((at, column));
                }
            }
            folded.push(Line { piece: Piece { start, end }, comment: line.comment, gap });
        }
        self.lines = folded;
    }

    // ---- blanks between two marks

    fn width(&self, at: usize) -> usize {
        self.words[at].chars().count()
    }

    /// Blanks before `at` on a line that begins with `first`, without alignment.
    fn space(&self, at: usize, first: usize) -> usize {
        if at == first { 0 } else { self.separates(at - 1, at) as usize }
    }

    /// Whether this mark is a word that is followed by an expression.
    fn asks(&self, at: usize) -> bool {
        let word = self.source.word(at);
        self.source.kind(at) == Some(TokenKind::Word)
            && (is_keyword(word) && !matches!(word, "next" | "reset" | "initial")
                || is_context_word(word) && (self.starts[at].is_some() || at > 0 && self.ends(at - 1)))
    }

    /// Whether an operand ends with this mark.
    fn ends(&self, at: usize) -> bool {
        self.source.ends_operand(at) && !self.asks_after_operand(at)
    }

    fn asks_after_operand(&self, at: usize) -> bool {
        let word = self.source.word(at);
        self.source.kind(at) == Some(TokenKind::Word)
            && is_context_word(word)
            && (self.starts[at].is_some() || at > 0 && self.source.ends_operand(at - 1))
    }

    fn separates(&self, before: usize, at: usize) -> bool {
        let (left, right) = (self.source.word(before), self.source.word(at));
        let symbol = |mark: usize| self.source.kind(mark) == Some(TokenKind::Symbol);
        let unary = |mark: usize| symbol(mark) && self.source.word(mark) == "-" && (mark == 0 || !self.ends(mark - 1));
        if symbol(at) {
            match right {
                ")" | "]" | "," | "." | "^" => return false,
                "(" => {
                    let called = self.source.kind(before) == Some(TokenKind::Word) && !self.asks(before);
                    return !(called || symbol(before) && matches!(left, "(" | "[" | "^") || unary(before));
                }
                "[" => {
                    let index = symbol(at + 2) && self.source.word(at + 2) == "]" && self.source.word(at + 3) == ".";
                    let index = index && self.source.glued(at);
                    return !(index || self.source.word(at + 2) == "in");
                }
                ":" => return self.slot(at),
                "-" if self.hyphen(at) => return false,
                "/" if self.strokes.contains(&self.source.marks[at].token.start) => return false,
                _ => {}
            }
        }
        if symbol(before) {
            match left {
                "(" | "[" | "." | "^" => return false,
                "/" if self.strokes.contains(&self.source.marks[before].token.start) => return false,
                "-" if unary(before) || self.hyphen(before) => return false,
                _ => {}
            }
        }
        true
    }

    /// Whether a colon belongs to the slot of a part rather than to a point of a table.
    fn slot(&self, colon: usize) -> bool {
        let start = (0..=colon).rev().find(|&at| self.starts[at].is_some()).unwrap_or(0);
        self.source.is_word(start, "part")
    }

    /// Whether a minus sign is the hyphen in the name of a lint: `allow large-step`.
    fn hyphen(&self, minus: usize) -> bool {
        let start = (0..=minus).rev().find(|&at| self.starts[at].is_some()).unwrap_or(0);
        self.source.is_word(start, "allow")
    }

    // ---- columns

    /// The column of a mark, including the blanks decided so far.
    fn column(&self, line: &Line, at: usize) -> usize {
        let first = line.piece.start;
        let indent = self.starts[first].map_or(0, |start| 2 * start.level);
        let gaps: usize = (first + 1..=at).map(|mark| self.space(mark, first) + self.pad(mark)).sum();
        indent + gaps + (first..at).map(|mark| self.width(mark)).sum::<usize>()
    }

    fn pad(&self, at: usize) -> usize {
        self.pads.get(&at).copied().unwrap_or(0)
    }

    fn end_column(&self, line: &Line) -> usize {
        let last = line.piece.end - 1;
        self.column(line, last) + self.width(last)
    }

    /// The original column of a byte if at least two blanks precede it; otherwise 0.
    fn chosen_column(&self, at: usize) -> usize {
        if self.source.text[..at].ends_with("  ") { self.old_column(at) } else { 0 }
    }

    /// The original column of a byte.
    fn old_column(&self, at: usize) -> usize {
        let line = self.source.text[..at].rfind('\n').map_or(0, |newline| newline + 1);
        self.source.text[line..at].trim_start_matches('\u{feff}').chars().count()
    }

    /// Pads the words that begin statements to the same width.
    fn heads(&mut self) {
        let mut widths: HashMap<usize, usize> = HashMap::new();
        let mut heads: Vec<(usize, Start)> = Vec::new();
        for line in &self.lines {
            let first = line.piece.start;
            let Some(start) = self.starts.get(first).copied().flatten().filter(|_| line.piece.end > first) else {
                continue;
            };
            let word = self.source.word(first);
            let declares = matches!(word, "param" | "input" | "output" | "state" | "let" | "part" | "send" | "read");
            let equation = line.piece.end < first + 2 || matches!(self.source.word(first + 1), "=" | "." | "/" | "[");
            let long = self.source.word(line.piece.end - 1) == "(";
            let padded = match start.place {
                Some(Place::Interface | Place::Model | Place::Device | Place::Every) => declares,
                Some(Place::Experiment | Place::Fit | Place::Case | Place::Rig) => !equation && !long,
                Some(Place::Mode | Place::Resets | Place::Hardware) | None => false,
            };
            if padded {
                let least =
                    if matches!(start.place, Some(Place::Interface | Place::Model | Place::Device)) { 6 } else { 0 };
                let width = widths.entry(start.block).or_insert(least);
                *width = (*width).max(self.width(first));
                heads.push((first, start));
            }
        }
        for (first, start) in heads {
            let pad = widths[&start.block] - self.width(first);
            self.pads.insert(first + 1, pad);
        }
    }

    /// Runs of consecutive lines that begin a statement, without a blank line or a comment between them.
    fn runs(&self) -> Vec<Vec<usize>> {
        let mut runs: Vec<Vec<usize>> = Vec::new();
        let mut block = None;
        for (index, line) in self.lines.iter().enumerate() {
            let comment = line.piece.start == line.piece.end;
            let start =
                if comment { None } else { self.starts[line.piece.start].filter(|start| start.place.is_some()) };
            match start {
                Some(start) if block == Some(start.block) && !line.gap => {
                    runs.last_mut().expect("a run is open").push(index);
                }
                Some(start) => {
                    runs.push(vec![index]);
                    block = Some(start.block);
                }
                None if comment || self.closers.contains_key(&line.piece.start) => block = None,
                None => {}
            }
        }
        runs
    }

    /// Aligns adjacent statements of the same kind: names, units and equals signs.
    fn names(&mut self, runs: &[Vec<usize>]) {
        for run in runs {
            let groups: Vec<&[usize]> = run.chunk_by(|&a, &b| self.kind(a) == self.kind(b)).collect();
            for group in groups {
                let name: Vec<(usize, usize)> = group.iter().filter_map(|&line| self.name_stop(line)).collect();
                let loose = !self.kind(group[0]).1;
                self.align(&name, loose);
                let equals: Vec<(usize, usize)> = group.iter().filter_map(|&line| self.equals_stop(line)).collect();
                self.align(&equals, false);
            }
        }
    }

    /// Aligns ranges, comments and other columns of adjacent statements.
    fn columns(&mut self, runs: &[Vec<usize>]) {
        for run in runs {
            for word in COLUMN_WORDS {
                let stops: Vec<(usize, usize)> = run.iter().filter_map(|&line| self.word_stop(line, word)).collect();
                let least = if word == "in" { RANGE_COLUMN } else { 0 };
                self.keep_or_align(&stops, least);
            }
            self.align_comments(run);
        }
        for index in 0..self.lines.len() {
            if self.lines[index].piece.start < self.lines[index].piece.end && !self.comments.contains_key(&index) {
                self.align_comments(&[index]);
            }
        }
    }

    /// The key that two statements must share to be aligned.
    fn kind(&self, line: usize) -> (&str, bool) {
        let first = self.lines[line].piece.start;
        let word = self.source.word(first);
        let place = self.starts[first].and_then(|start| start.place);
        let unit = self.source.word(first + 2) == "[";
        match (place, word) {
            (Some(Place::Interface), _) => ("port", true),
            (Some(Place::Device), "send" | "read") => ("signal", true),
            (Some(Place::Rig), "bus" | "drive" | "device") => ("bus", false),
            (Some(Place::Experiment | Place::Fit | Place::Case), "let") => ("derived", true),
            (_, "param" | "input" | "output" | "state" | "let") => (word, unit),
            (_, "part" | "go" | "next") => (word, false),
            _ if self.source.word(first + 1) == "/" => ("derivative", false),
            _ if matches!(self.source.word(first + 1), "=" | "." | "[") => ("equation", false),
            _ => (word, true),
        }
    }

    /// The mark after the name that a statement declares.
    fn name_stop(&self, line: usize) -> Option<(usize, usize)> {
        let first = self.lines[line].piece.start;
        let mark = match self.kind(line).0 {
            "port" | "signal" | "param" | "input" | "output" | "state" | "let" | "go" => first + 2,
            "part" if self.source.word(first + 2) == ":" => first + 2,
            _ => return None,
        };
        (mark < self.lines[line].piece.end).then_some((line, mark))
    }

    /// The equals sign of a statement, unless it directly follows the name.
    fn equals_stop(&self, line: usize) -> Option<(usize, usize)> {
        let Piece { start, end } = self.lines[line].piece;
        let (kind, unit) = self.kind(line);
        let wanted = match kind {
            "part" | "bus" | "derivative" | "equation" | "next" => true,
            "port" | "signal" | "param" | "input" | "output" | "state" | "let" => unit,
            _ => false,
        };
        let mark = (start..end).find(|&at| self.source.is_symbol(at, "=")).filter(|_| wanted)?;
        Some((line, mark))
    }

    /// The word `word` of a statement, outside brackets.
    fn word_stop(&self, line: usize, word: &str) -> Option<(usize, usize)> {
        let Piece { start, end } = self.lines[line].piece;
        let mut depth = 0i32;
        for at in start..end {
            match self.source.word(at) {
                "(" | "[" => depth += 1,
                ")" | "]" => depth -= 1,
                found if depth == 0 && found == word && at > start + 1 && self.source.ends_operand(at - 1) => {
                    let signal = matches!(self.source.word(start), "send" | "read");
                    let wire = self.kind(line).0 == "equation";
                    let fits = match word {
                        // A `vary` and a `tune` list several parameters, each with its range; so does a `plot` its
                        // curves.
                        "in" => !matches!(self.source.word(start), "plot" | "tune" | "vary"),
                        "limit" | "slew" => wire,
                        _ => signal,
                    };
                    return fits.then_some((line, at));
                }
                _ => {}
            }
        }
        None
    }

    /// Aligns `stops` to one column. `loose`: excludes one name that is much longer than all others.
    fn align(&mut self, stops: &[(usize, usize)], loose: bool) {
        let mut columns: Vec<usize> = stops.iter().map(|&(line, at)| self.column(&self.lines[line], at)).collect();
        columns.sort_unstable();
        let Some(&widest) = columns.last() else { return };
        let next = columns.iter().rev().nth(1).copied().unwrap_or(widest);
        let goal = if loose && widest - next > 2 { next } else { widest };
        for &(line, at) in stops {
            let column = self.column(&self.lines[line], at);
            *self.pads.entry(at).or_insert(0) += goal.saturating_sub(column);
        }
    }

    /// Keeps the column that `stops` share, or aligns them to one that is preceded by two blanks.
    fn keep_or_align(&mut self, stops: &[(usize, usize)], least: usize) {
        let natural: Vec<usize> = stops.iter().map(|&(line, at)| self.column(&self.lines[line], at)).collect();
        let old: Vec<usize> =
            stops.iter().map(|&(_, at)| self.chosen_column(self.source.marks[at].token.start)).collect();
        let Some(goal) = goal(&natural.iter().map(|column| column + 1).collect::<Vec<_>>(), &old, least) else {
            return;
        };
        for (&(_, at), column) in stops.iter().zip(natural) {
            *self.pads.entry(at).or_insert(0) += goal - column;
        }
    }

    fn align_comments(&mut self, run: &[usize]) {
        let lines: Vec<(usize, Token)> =
            run.iter().filter_map(|&line| self.lines[line].comment.map(|comment| (line, comment))).collect();
        let natural: Vec<usize> = lines.iter().map(|&(line, _)| self.end_column(&self.lines[line]) + 2).collect();
        let old: Vec<usize> = lines.iter().map(|&(_, comment)| self.chosen_column(comment.start)).collect();
        let statement = run
            .first()
            .is_some_and(|&line| self.starts[self.lines[line].piece.start].is_some_and(|start| start.place.is_some()));
        let Some(goal) = goal(&natural, &old, if statement { COMMENT_COLUMN } else { 0 }) else { return };
        for (line, _) in lines {
            self.comments.insert(line, goal);
        }
    }

    /// Aligns the equals signs of arguments on lines of their own.
    fn arguments(&mut self) {
        let mut open: Vec<Vec<usize>> = Vec::new();
        let mut groups: Vec<Vec<usize>> = Vec::new();
        for line in &self.lines {
            for at in line.piece.start..line.piece.end {
                if at == line.piece.start
                    && self.source.is_symbol(at + 1, "=")
                    && self.starts[at].is_none()
                    && let Some(group) = open.last_mut()
                {
                    group.push(at + 1);
                }
                match self.source.word(at) {
                    "(" => open.push(Vec::new()),
                    ")" => groups.extend(open.pop()),
                    _ => {}
                }
            }
        }
        for group in groups {
            // The first argument follows the bracket unless the bracket ends its line.
            let Some(&first) = group.first() else { continue };
            if !self.source.is_symbol(first - 2, "(") {
                continue;
            }
            let widest = group.iter().map(|&at| self.width(at - 1)).max().unwrap_or(0);
            for at in group {
                self.pads.insert(at, widest - self.width(at - 1));
            }
        }
    }

    /// Keeps blanks that place a mark exactly below or above a mark of the adjacent statement: `F_ext >  Fs` over
    /// `F_ext < -Fs`.
    fn chosen(&mut self) {
        type Mark = (usize, usize);
        let mut kept: Vec<(usize, Mark, Mark)> = Vec::new();
        let statement = |layout: &Self, line: usize| {
            let piece = layout.lines[line].piece;
            layout.starts.get(piece.start).copied().flatten().filter(|start| start.place.is_some()).map(|s| s.block)
        };
        for upper in 1..self.lines.len() {
            let (upper, lower) = (upper - 1, upper);
            let block = statement(self, upper);
            if block.is_none() || block != statement(self, lower) || self.lines[lower].gap {
                continue;
            }
            let (above, below) = (self.marks_of(upper), self.marks_of(lower));
            for (line, marks, other, others) in [(upper, &above, lower, &below), (lower, &below, upper, &above)] {
                for &(column, at, _) in marks.iter().filter(|(_, _, extra)| *extra) {
                    // Columns increase along a line.
                    if let Ok(k) = others.binary_search_by_key(&column, |(column, ..)| *column)
                        && !others[k].2
                    {
                        kept.push((column, (line, at), (other, others[k].1)));
                    }
                }
            }
        }
        kept.sort_unstable();
        for (_, (line, at), (other, mark)) in kept {
            let (here, there) = (self.column(&self.lines[line], at), self.column(&self.lines[other], mark));
            *self.pads.entry(at).or_insert(0) += there.saturating_sub(here);
        }
    }

    /// The marks of a line except the first, provided that it was a single line before: the original column of each,
    /// and whether it had more blanks before it than it has now.
    fn marks_of(&self, line: usize) -> Vec<(usize, usize, bool)> {
        let Piece { start, end } = self.lines[line].piece;
        let begins = |at: usize| self.source.marks[at].token.start;
        if self.source.marks[start].line != self.source.marks[end - 1].line {
            return Vec::new();
        }
        let mut column = self.old_column(begins(start));
        let columns: Vec<usize> = COLUMN_WORDS.iter().filter_map(|word| Some(self.word_stop(line, word)?.1)).collect();
        let mut out = Vec::new();
        for at in start + 1..end {
            let before = self.source.marks[at - 1].token;
            column += before.text(self.source.text).chars().count();
            let blanks = begins(at) - before.end;
            column += blanks;
            // Marks in a column of their own are aligned later.
            if !columns.contains(&at) {
                out.push((column, at, blanks > self.space(at, start) + self.pad(at)));
            }
        }
        out
    }

    // ---- output

    fn write(&self) -> String {
        let mut text = String::with_capacity(self.source.text.len() + 64);
        // For each open bracket the column after it, or `None` if it ends its line; and the columns of `if`s.
        let mut open: Vec<Option<usize>> = Vec::new();
        let mut ifs: Vec<(usize, usize)> = Vec::new();
        // An `if` after an `else` continues the preceding `if`, so its `else` is aligned with that of the former.
        let mut before = None;
        let mut indent = 0;
        for (index, line) in self.lines.iter().enumerate() {
            if line.gap {
                text.push('\n');
            }
            let Piece { start, end } = line.piece;
            if start == end {
                // A comment is indented like the line that follows it, or as a statement before the end of a block.
                let level = match self.closers.get(&start) {
                    Some(level) => 2 * level + 2,
                    None => self.starts.get(start).copied().flatten().map_or(indent + 2, |start| 2 * start.level),
                };
                let level = if start == self.source.marks.len() { 0 } else { level };
                let comment = line.comment.map_or("", |comment| comment.text(self.source.text).trim_end());
                text.extend(std::iter::repeat_n(' ', level));
                text.push_str(comment);
                text.push('\n');
                continue;
            }
            let mut column = if let Some(begin) = self.starts[start] {
                indent = 2 * begin.level;
                ifs.clear();
                indent
            } else if let Some(level) = self.closers.get(&start) {
                2 * level
            } else {
                let branch = matches!(self.source.word(start), "then" | "else");
                let matching = ifs.iter().rev().find(|&&(depth, _)| depth == open.len()).filter(|_| branch);
                match (matching, open.last()) {
                    (Some(&(_, column)), _) => column,
                    (None, Some(&Some(column))) => column,
                    (None, Some(None)) => indent + 6,
                    (None, None) => indent + 2,
                }
            };
            text.extend(std::iter::repeat_n(' ', column));
            for at in start..end {
                let blanks = if at == start { 0 } else { self.space(at, start) + self.pad(at) };
                text.extend(std::iter::repeat_n(' ', blanks));
                text.push_str(&self.words[at]);
                column += blanks;
                let word = self.source.word(at);
                before = before.filter(|_| word == "if");
                match word {
                    "if" => ifs.push((open.len(), before.take().unwrap_or(column))),
                    "else" => {
                        let matching = ifs.iter().rposition(|&(depth, _)| depth <= open.len()).unwrap_or(0);
                        before = ifs.drain(matching..).next().map(|(_, column)| column);
                    }
                    "(" | "[" => open.push((at + 1 < end).then_some(column + 1)),
                    ")" | "]" => {
                        open.pop();
                    }
                    _ => {}
                }
                column += self.width(at);
            }
            if let Some(comment) = line.comment {
                let goal = self.comments.get(&index).copied().unwrap_or(0).max(column + 2);
                text.extend(std::iter::repeat_n(' ', goal - column));
                text.push_str(comment.text(self.source.text).trim_end());
            }
            text.push('\n');
        }
        text
    }
}

/// The column for marks that need at least the columns `natural`: the one they share, or the least that suffices for
/// all.
fn goal(natural: &[usize], old: &[usize], least: usize) -> Option<usize> {
    let needed = *natural.iter().max()?;
    let shared = old.iter().all(|&column| column == old[0]) && old[0] >= needed;
    Some(if shared { old[0] } else { needed.max(least) })
}
