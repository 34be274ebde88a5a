//! Splits a text into items, blocks and statements without parsing them, so that each is parsed, and fails, separately
//! (error recovery).
//!
//! In: the tokens of a text. Out: ranges of tokens, and errors of the braces. Relies on keywords, braces and the heads
//! `name =`, `dz/dt =`, `next(`. Knows nothing of the contents of statements.

use crate::diagnostic::Diagnostic;
use crate::span::{FileId, Span};
use crate::tokens::{Token, TokenKind, is_keyword, tokens};
use std::ops::Range;

/// A token that is neither blank nor comment.
#[derive(Clone, Copy)]
pub(crate) struct Mark {
    pub token: Token,
    /// Whether only blanks precede it on its line.
    pub first_on_line: bool,
    /// Line, counted from 0.
    pub line: u32,
}

/// One line of documentation.
struct DocLine {
    /// Number of marks before it.
    after: usize,
    /// Whether only blanks precede it on its line.
    own_line: bool,
    line: u32,
    start: usize,
    end: usize,
}

/// A text as tokens, with matched braces.
pub(crate) struct Source<'t> {
    pub file: FileId,
    pub text: &'t str,
    pub marks: Vec<Mark>,
    docs: Vec<DocLine>,
    /// For the index of each `{`: the end of its block, and where the text continues.
    blocks: Vec<(usize, usize)>,
    /// Errors of the braces.
    pub complaints: Vec<Diagnostic>,
    /// `/* … */` comments, which are skipped.
    pub block_comments: Vec<Span>,
}

/// A range of marks.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Piece {
    pub start: usize,
    pub end: usize,
}

/// Kind of a block that contains statements.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Place {
    Interface,
    Model,
    Every,
    Mode,
    Resets,
    Experiment,
    Fit,
    Case,
    Device,
    Rig,
    Hardware,
}

impl Place {
    /// A description for messages.
    pub fn words(self) -> &'static str {
        match self {
            Place::Interface => "an interface",
            Place::Model => "a model",
            Place::Every => "an `every` block",
            Place::Mode => "a `mode`",
            Place::Resets => "a block of resets",
            Place::Experiment => "an experiment",
            Place::Fit => "a fit",
            Place::Case => "a `case` of a fit",
            Place::Device => "a device",
            Place::Rig => "a rig",
            Place::Hardware => "a `hardware` block",
        }
    }

    /// Words that begin a statement in this block and are allowed as names elsewhere.
    fn starters(self) -> &'static [&'static str] {
        match self {
            Place::Experiment => &["run", "solver", "sweep", "data", "plot", "tune", "expect", "show", "record"],
            Place::Fit | Place::Case => &[
                "run", "solver", "sweep", "data", "plot", "tune", "expect", "show", "record", "vary", "minimise",
                "validate", "case",
            ],
            Place::Device => &["send", "read"],
            Place::Rig => &[
                "run", "rate", "solver", "bus", "drive", "hardware", "watchdog", "overrun", "predict", "safe", "stop",
                "record", "plot", "tune",
            ],
            Place::Interface | Place::Model | Place::Every | Place::Mode | Place::Resets | Place::Hardware => &[],
        }
    }
}

/// Words that begin an item.
pub(crate) const ITEMS: [&str; 10] =
    ["import", "const", "fn", "table", "interface", "model", "experiment", "fit", "device", "rig"];
/// Keywords that begin a statement.
const STARTERS: [&str; 15] = [
    "param", "input", "output", "state", "let", "require", "storage", "allow", "part", "every", "when", "mode", "go",
    "next", "reset",
];
/// Words that are followed by the name of a declaration.
const DECLARERS: [&str; 11] =
    ["param", "input", "output", "state", "let", "part", "const", "bus", "drive", "device", "sweep"];
/// Words that continue a statement even at the start of a line.
const CONTINUATIONS: [&str; 27] = [
    "then", "else", "and", "or", "in", "crosses", "rises", "falls", "initial", "for", "by", "after", "before",
    "against", "step", "tol", "limit", "slew", "at", "byte", "as", "scale", "from", "message", "when", "title", "log",
];

/// Whether `word` begins an item.
pub(crate) fn begins_item(word: &str) -> bool {
    ITEMS.contains(&word)
}

impl<'t> Source<'t> {
    pub fn new(file: FileId, text: &'t str) -> Source<'t> {
        Source::of(file, text, 0..text.len())
    }

    /// A part of a text, with the offsets of the whole.
    pub fn of(file: FileId, text: &'t str, part: Range<usize>) -> Source<'t> {
        let (mut marks, mut docs, mut block_comments) = (Vec::new(), Vec::new(), Vec::new());
        let (mut fresh, mut line) = (true, 0);
        for token in tokens(&text[part.clone()]) {
            let token = Token { start: part.start + token.start, end: part.start + token.end, ..token };
            match token.kind {
                TokenKind::Newline => (fresh, line) = (true, line + 1),
                TokenKind::Blank | TokenKind::Comment => {}
                TokenKind::Doc => {
                    docs.push(DocLine { after: marks.len(), own_line: fresh, line, start: token.start, end: token.end })
                }
                TokenKind::Unknown if token.text(text).starts_with("/*") => {
                    block_comments.push(Span::new(file, token.start, token.end));
                    line += token.text(text).matches('\n').count() as u32;
                }
                TokenKind::Word
                | TokenKind::Number
                | TokenKind::Unit
                | TokenKind::Text
                | TokenKind::OpenText
                | TokenKind::Symbol
                | TokenKind::Unknown => {
                    marks.push(Mark { token, first_on_line: fresh, line });
                    fresh = false;
                }
            }
        }
        let blocks = vec![(0, 0); marks.len()];
        let mut source = Source { file, text, marks, docs, blocks, complaints: Vec::new(), block_comments };
        source.match_braces();
        source
    }

    /// The characters of a mark; empty after the last one.
    pub fn word(&self, at: usize) -> &'t str {
        self.marks.get(at).map_or("", |mark| &self.text[mark.token.start..mark.token.end])
    }

    /// The kind of a mark.
    pub fn kind(&self, at: usize) -> Option<TokenKind> {
        self.marks.get(at).map(|mark| mark.token.kind)
    }

    /// The span of a mark; after the last one, the span of the last one.
    pub fn span(&self, at: usize) -> Span {
        match self.marks.get(at).or(self.marks.last()) {
            Some(mark) => Span::new(self.file, mark.token.start, mark.token.end),
            None => Span::new(self.file, 0, 0),
        }
    }

    /// The span of a non-empty range of marks.
    pub fn span_of(&self, piece: Piece) -> Span {
        self.span(piece.start).to(self.span(piece.end.max(piece.start + 1) - 1))
    }

    /// Whether no blank precedes this mark.
    pub fn glued(&self, at: usize) -> bool {
        at > 0 && self.marks[at - 1].token.end == self.marks[at].token.start
    }

    /// The first block of a piece: the index of its `{`, and the range inside.
    pub fn block(&self, piece: Piece) -> Option<(usize, Piece)> {
        let open = (piece.start..piece.end).find(|&at| self.is_symbol(at, "{"))?;
        Some((open, Piece { start: open + 1, end: self.blocks[open].0 }))
    }

    /// Where the text continues after the block that opens at `open`.
    pub fn behind(&self, open: usize) -> usize {
        self.blocks[open].1
    }

    /// Documentation of a piece: the lines directly before it, and those at the end of its own lines.
    pub fn doc(&self, piece: Piece) -> Option<String> {
        let from = self.docs.partition_point(|doc| doc.after < piece.start);
        let to = self.docs.partition_point(|doc| doc.after <= piece.end);
        let before: Vec<&DocLine> =
            self.docs[from..to].iter().filter(|doc| doc.own_line && doc.after == piece.start).collect();
        // Only the last run of lines without a gap; earlier lines belong to no item.
        let run = before.windows(2).rposition(|pair| pair[1].line != pair[0].line + 1).map_or(0, |gap| gap + 1);
        let behind = self.docs[from..to].iter().filter(|doc| !doc.own_line && doc.after > piece.start);
        let lines: Vec<&str> = before[run..]
            .iter()
            .copied()
            .chain(behind)
            .map(|doc| {
                let line = self.text[doc.start + 3..doc.end].trim_end();
                line.strip_prefix(' ').unwrap_or(line)
            })
            .collect();
        (!lines.is_empty()).then(|| lines.join("\n"))
    }

    pub fn is_symbol(&self, at: usize, symbol: &str) -> bool {
        self.kind(at) == Some(TokenKind::Symbol) && self.word(at) == symbol
    }

    pub fn is_word(&self, at: usize, word: &str) -> bool {
        self.kind(at) == Some(TokenKind::Word) && self.word(at) == word
    }

    /// Whether an item certainly begins here, even inside an unclosed block.
    fn surely_item(&self, at: usize) -> bool {
        if !self.marks[at].first_on_line || self.kind(at) != Some(TokenKind::Word) {
            return false;
        }
        let name = self.kind(at + 1) == Some(TokenKind::Word);
        match self.word(at) {
            "import" => name || self.kind(at + 1) == Some(TokenKind::Text),
            "const" => name,
            "fn" | "table" => name && self.is_symbol(at + 2, "("),
            "interface" | "model" | "experiment" | "fit" | "rig" => name && self.is_symbol(at + 2, "{"),
            "device" => name && (self.is_symbol(at + 2, "{") || self.is_word(at + 2, "from")),
            _ => false,
        }
    }

    fn match_braces(&mut self) {
        let mut open: Vec<usize> = Vec::new();
        let mut at = 0;
        while at < self.marks.len() {
            if self.is_symbol(at, "{") {
                open.push(at);
            } else if self.is_symbol(at, "}") {
                if let Some(brace) = open.pop() {
                    self.blocks[brace] = (at, at + 1);
                }
            } else if !open.is_empty() && self.surely_item(at) {
                self.rematch(open[0], at);
                open.clear();
            }
            at += 1;
        }
        if let Some(&first) = open.first() {
            self.rematch(first, self.marks.len());
        }
    }

    /// Matches the braces of `from..to`, of which one is unclosed, by the indentation of their lines, and reports the
    /// unclosed one.
    fn rematch(&mut self, from: usize, to: usize) {
        let indents: Vec<usize> = self.indents(from, to);
        let (mut open, mut guilty): (Vec<usize>, Option<usize>) = (Vec::new(), None);
        for at in from..to {
            let indent = |mark: usize| indents[mark - from];
            if self.is_symbol(at, "{") {
                open.push(at);
            } else if self.is_symbol(at, "}") {
                if self.marks[at].first_on_line
                    && open.iter().rev().skip(1).any(|&brace| indent(brace) == indent(at))
                    && open.last().is_some_and(|&brace| indent(brace) > indent(at))
                {
                    while open.last().is_some_and(|&brace| indent(brace) > indent(at)) {
                        let brace = open.pop().unwrap_or(from);
                        self.blocks[brace] = (at, at);
                        guilty = guilty.or(Some(brace));
                    }
                }
                if let Some(brace) = open.pop() {
                    self.blocks[brace] = (at, at + 1);
                }
            } else if self.marks[at].first_on_line && self.kind(at) == Some(TokenKind::Word) {
                while open.len() > 1 && open.last().is_some_and(|&brace| indent(brace) >= indent(at)) {
                    let brace = open.pop().unwrap_or(from);
                    self.blocks[brace] = (at, at);
                    guilty = guilty.or(Some(brace));
                }
            }
        }
        for &brace in &open {
            self.blocks[brace] = (to, to);
        }
        let guilty = guilty.or(open.last().copied()).unwrap_or(from);
        let last = self.marks[self.blocks[guilty].0 - 1].line + 1;
        let end = self.blocks[guilty].0 - 1;
        if self.is_word(end, "end") && self.marks[end].first_on_line {
            self.complaints.push(
                Diagnostic::error("E0002", "a block ends with `}`")
                    .label(self.span(end), "ends nothing")
                    .label(self.span(guilty), "the block begins here")
                    .help("write `}` in place of `end`"),
            );
            return;
        }
        self.complaints.push(
            Diagnostic::error("E0002", "this `{` is not closed")
                .label(self.span(guilty), "no `}` belongs to it")
                .help(format!("add `}}` after line {last}")),
        );
    }

    /// For each mark of `from..to`, the indentation of its line.
    fn indents(&self, from: usize, to: usize) -> Vec<usize> {
        let mut first = (0..=from).rev().find(|&at| self.marks[at].first_on_line).unwrap_or(from);
        let mut indents = Vec::with_capacity(to - from);
        for at in from..to {
            if self.marks[at].first_on_line {
                first = at;
            }
            let same = indents.last().copied().filter(|_| at != first);
            indents.push(same.unwrap_or_else(|| {
                let start = self.marks[first].token.start;
                start - self.text[..start].rfind('\n').map_or(0, |newline| newline + 1)
            }));
        }
        indents
    }

    /// The items of the whole text, interleaved with pieces outside of items.
    pub fn items(&self) -> Vec<Piece> {
        let mut pieces = Vec::new();
        let (mut start, mut at) = (0, 0);
        while at < self.marks.len() {
            let item = self.kind(at) == Some(TokenKind::Word)
                && begins_item(self.word(at))
                && !(at > 0 && begins_item(self.word(at - 1)));
            if item && at > start {
                pieces.push(Piece { start, end: at });
                start = at;
            }
            if self.is_symbol(at, "{") {
                at = self.behind(at).max(at + 1);
                // Text after the block of an item is not part of the item.
                pieces.push(Piece { start, end: at });
                start = at;
            } else {
                at += 1;
            }
        }
        pieces.push(Piece { start, end: self.marks.len() });
        pieces.retain(|piece| piece.start < piece.end);
        pieces
    }

    /// The statements of a block.
    pub fn statements(&self, place: Place, block: Piece) -> Vec<Piece> {
        let mut pieces = Vec::new();
        let mut start = block.start;
        while start < block.end {
            let end = self.statement_end(place, start, block.end);
            pieces.push(Piece { start, end });
            start = end;
        }
        pieces
    }

    fn statement_end(&self, place: Place, start: usize, end: usize) -> usize {
        let mut depth = 0usize;
        let mut at = start;
        while at < end {
            if at > start && self.starts(place, start, at, depth > 0) {
                return at;
            }
            if self.kind(at) == Some(TokenKind::Symbol) {
                match self.word(at) {
                    "(" | "[" => depth += 1,
                    ")" | "]" => depth = depth.saturating_sub(1),
                    "{" => return self.behind(at).clamp(at + 1, end),
                    ";" | "}" => return at + 1,
                    _ => {}
                }
            }
            at += 1;
        }
        end
    }

    /// Whether a new statement begins at `at`, within a statement that began at `first`. `inside`: within brackets.
    fn starts(&self, place: Place, first: usize, at: usize, inside: bool) -> bool {
        if self.kind(at) == Some(TokenKind::Number) {
            return !inside && self.marks[at].first_on_line && self.ends_operand(at - 1);
        }
        if self.kind(at) != Some(TokenKind::Word) {
            return false;
        }
        // `m/%dt` is read as one unit, which `=` must not follow: `dt = v` in it is no statement.
        if self.glued(at) && self.kind(at - 1) == Some(TokenKind::Unknown) {
            return false;
        }
        let (word, fresh) = (self.word(at), self.marks[at].first_on_line);
        let before = self.word(at - 1);
        if before == "." || (before == "rotary" && !fresh) {
            return false;
        }
        let head = DECLARERS.contains(&before) && self.kind(at - 1) == Some(TokenKind::Word);
        // A single word is not a statement: the text after it on its line belongs to it.
        let ended = self.ends_operand(at - 1) && (fresh || at - 1 > first);
        let begins = |sure: bool| if inside { fresh && sure } else { fresh || ended };
        if STARTERS.contains(&word) || begins_item(word) {
            let condition = word == "when"
                && matches!(self.word(first), "go" | "stop")
                && !(first..at).any(|mark| self.is_word(mark, "when"));
            let condition = condition || word == "every" && self.word(first) == "record";
            let argument = inside && self.is_symbol(at + 1, "=");
            let call = !matches!(word, "next" | "reset") || self.is_symbol(at + 1, "(");
            return !condition && !argument && call && (fresh || !head) && begins(true);
        }
        if place.starters().contains(&word) && self.fits(at) {
            return begins(ended);
        }
        if let Some(equals) = self.behind_path(at).filter(|&mark| self.is_symbol(mark, "=")) {
            let derivative = equals > at + 1 && self.is_symbol(at + 1, "/");
            let case = matches!(self.word(first), "expect" | "show")
                && (before == "for" || before == "," && (first..at).any(|mark| self.is_word(mark, "for")));
            let listed = case || matches!(self.word(first), "safe" | "vary") && before == ",";
            return !head && !listed && begins(ended || derivative);
        }
        !inside && fresh && ended && !CONTINUATIONS.contains(&word)
    }

    /// The mark after `a`, `a.b`, `el[1].f`, `dz/dt` or `dz / dt`.
    fn behind_path(&self, at: usize) -> Option<usize> {
        let derivative = |word: &str| word.len() > 1 && word.starts_with('d');
        if self.is_symbol(at + 1, "/") && derivative(self.word(at)) && derivative(self.word(at + 2)) {
            return Some(at + 3);
        }
        let mut at = at + 1;
        loop {
            if self.is_symbol(at, "[") && self.is_symbol(at + 2, "]") && self.is_symbol(at + 3, ".") {
                at += 3;
            }
            if !self.is_symbol(at, ".") || self.kind(at + 1) != Some(TokenKind::Word) {
                return Some(at);
            }
            at += 2;
        }
    }

    /// Whether the marks after a word that is no keyword make it the start of a statement.
    fn fits(&self, at: usize) -> bool {
        let next = self.word(at + 1);
        match (self.word(at), self.kind(at + 1)) {
            (_, None) => false,
            ("data" | "validate", kind) => kind == Some(TokenKind::Text),
            ("stop", _) => next == "when",
            ("overrun", _) => matches!(next, "stop" | "hold"),
            (_, Some(TokenKind::Word)) => {
                !matches!(next, "and" | "or" | "then" | "else" | "crosses" | "rises" | "falls")
            }
            (_, Some(TokenKind::Number)) => true,
            (word, Some(TokenKind::Symbol)) => {
                matches!(next, "-" | "(" | "?")
                    && matches!(word, "plot" | "expect" | "show" | "minimise" | "record" | "rate" | "watchdog")
                    && self.marks[at].first_on_line
            }
            (_, Some(_)) => false,
        }
    }

    /// Whether an operand may end with this mark, so that a word after it cannot belong to the same expression.
    pub fn ends_operand(&self, at: usize) -> bool {
        match self.kind(at) {
            Some(TokenKind::Word) => !is_keyword(self.word(at)) || self.word(at) == "initial",
            Some(TokenKind::Symbol) => matches!(self.word(at), ")" | "]" | "}" | "?"),
            Some(TokenKind::Number | TokenKind::Unit | TokenKind::Text | TokenKind::OpenText | TokenKind::Unknown) => {
                true
            }
            Some(TokenKind::Blank | TokenKind::Newline | TokenKind::Comment | TokenKind::Doc) | None => false,
        }
    }
}
