//! Formats diagnostics for people and programs: in full, one line each, or as JSON.
//!
//! In: diagnostics and the texts that they refer to. Out: a string, or a JSON value. The only file that uses miette.
//!
//! Miette receives an excerpt instead of the text: whole lines, with tabs and control characters made visible, and with
//! lines wider than a screen cut to the relevant part. So no text can break the layout or the terminal.

use crate::compile::SourceFile;
use grammar::diagnostic::{Diagnostic, Label, Severity};
use grammar::span::{FileId, Span};
use miette::{
    GraphicalReportHandler, GraphicalTheme, LabeledSpan, MietteError, MietteSpanContents, SourceCode, SourceSpan,
    SpanContents, ThemeCharacters, ThemeStyles,
};
use serde_json::{Value, json};
use std::collections::HashMap;
use std::fmt;

/// Most diagnostics shown per file; the rest are counted.
const MOST_PER_FILE: usize = 10;
/// Width of a report in columns: fixed, so that it reads the same everywhere.
const WIDTH: usize = 100;
/// A longer line is cut around its first label.
const LONGEST_LINE: usize = 160;
/// Columns kept before and after the start of that label.
const KEPT: (usize, usize) = (60, 80);
/// A label over more lines than this marks only its first line.
const MOST_LINES: usize = 8;
/// Labels at most this many lines apart share one excerpt.
const GAP: usize = 3;
/// Width of a tab stop, as in the language server and most editors.
const TAB: usize = 4;

/// Everything in full, in the order of the files; empty if there are no diagnostics.
pub fn full(files: &[SourceFile], diagnostics: &[Diagnostic], colour: bool) -> String {
    let mut out = String::new();
    for group in by_file(diagnostics) {
        for diagnostic in group.iter().take(MOST_PER_FILE) {
            if !out.is_empty() {
                out.push('\n');
            }
            out += &one(files, diagnostic, colour);
        }
        if let Some(rest) = group.len().checked_sub(MOST_PER_FILE).filter(|rest| *rest > 0) {
            let name = files.get(group[0].span().file.0 as usize).map_or("", |file| &file.name);
            out += &format!("\n… and {rest} more in {name}\n");
        }
    }
    out
}

/// One line each: `file:line:column: E0101 message`.
pub fn short(files: &[SourceFile], diagnostics: &[Diagnostic]) -> String {
    let mut places = Places::new(files);
    let mut out = String::new();
    for diagnostic in by_file(diagnostics).into_iter().flatten() {
        if let Some(place) = diagnostic.labels.first().and_then(|label| places.of(label.span)) {
            out += &format!("{place}: ");
        }
        out += &format!("{} {}\n", diagnostic.code, diagnostic.message);
    }
    out
}

/// `file:line:column` of a span; empty if the file is unknown.
pub fn place(files: &[SourceFile], span: Span) -> String {
    Places::new(files).of(span).map_or(String::new(), |place| place.to_string())
}

/// All of them as a JSON array. Lines and columns count from 1, columns in characters; offsets are bytes.
pub fn json(files: &[SourceFile], diagnostics: &[Diagnostic]) -> Value {
    let mut places = Places::new(files);
    let mut label = |label: &Label| {
        let place = places.of(label.span);
        let end = place.as_ref().map(|place| place.end);
        json!({
            "file": place.as_ref().map(|place| place.file),
            "line": place.as_ref().map(|place| place.line),
            "column": place.as_ref().map(|place| place.column),
            "end_line": end.map(|end| end.0),
            "end_column": end.map(|end| end.1),
            "start": label.span.start,
            "end": label.span.end,
            "text": label.text,
        })
    };
    let one = |diagnostic: &Diagnostic| {
        json!({
            "code": diagnostic.code,
            "severity": severity_word(diagnostic.severity),
            "message": diagnostic.message,
            "labels": diagnostic.labels.iter().map(&mut label).collect::<Vec<_>>(),
            "help": diagnostic.help,
        })
    };
    by_file(diagnostics).into_iter().flatten().map(one).collect()
}

fn severity_word(severity: Severity) -> &'static str {
    match severity {
        Severity::Error => "error",
        Severity::Warning => "warning",
    }
}

/// Diagnostics in the order of the text, grouped by file.
fn by_file(diagnostics: &[Diagnostic]) -> Vec<Vec<&Diagnostic>> {
    let mut sorted: Vec<&Diagnostic> = diagnostics.iter().collect();
    sorted.sort_by_key(|diagnostic| (diagnostic.span().file, diagnostic.span().start));
    sorted.chunk_by(|a, b| a.span().file == b.span().file).map(<[_]>::to_vec).collect()
}

/// The position of a label as users count it.
struct LabelPosition<'a> {
    file: &'a str,
    line: usize,
    column: usize,
    /// Line and column after the last character.
    end: (usize, usize),
}

impl fmt::Display for LabelPosition<'_> {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}:{}:{}", self.file, self.line, self.column)
    }
}

/// Positions of many labels: the lines of each text are indexed once.
struct Places<'a> {
    files: &'a [SourceFile],
    lines: HashMap<FileId, Lines<'a>>,
}

impl<'a> Places<'a> {
    fn new(files: &'a [SourceFile]) -> Places<'a> {
        Places { files, lines: HashMap::new() }
    }

    fn of(&mut self, span: Span) -> Option<LabelPosition<'a>> {
        let file = self.files.get(span.file.0 as usize)?;
        let lines = self.lines.entry(span.file).or_insert_with(|| Lines::new(&file.text));
        let (line, column) = lines.place(span.start as usize);
        Some(LabelPosition { file: &file.name, line, column, end: lines.place(span.end as usize) })
    }
}

/// The start offsets of the lines of a text.
struct Lines<'a> {
    text: &'a str,
    starts: Vec<usize>,
    ascii: bool,
}

impl<'a> Lines<'a> {
    fn new(text: &'a str) -> Lines<'a> {
        let starts = std::iter::once(0).chain(text.match_indices('\n').map(|(at, _)| at + 1)).collect();
        Lines { text, starts, ascii: text.is_ascii() }
    }

    /// Line and column of a byte offset, from 1, the column in characters. A byte order mark does not count.
    fn place(&self, offset: usize) -> (usize, usize) {
        let offset = floor_boundary(self.text, offset);
        let line = self.starts.partition_point(|start| *start <= offset);
        let before = &self.text[self.starts[line - 1]..offset];
        let column = if self.ascii { before.len() } else { before.chars().filter(|c| *c != BYTE_ORDER_MARK).count() };
        (line, column + 1)
    }
}

const BYTE_ORDER_MARK: char = '\u{feff}';

/// The greatest character boundary ≤ `offset`.
fn floor_boundary(text: &str, offset: usize) -> usize {
    (0..=offset.min(text.len())).rev().find(|at| text.is_char_boundary(*at)).unwrap_or(0)
}

fn one(files: &[SourceFile], diagnostic: &Diagnostic, colour: bool) -> String {
    let theme = GraphicalTheme {
        characters: ThemeCharacters::unicode(),
        styles: if colour { ThemeStyles::ansi() } else { ThemeStyles::none() },
    };
    let handler =
        GraphicalReportHandler::new_themed(theme).with_width(WIDTH).with_context_lines(0).without_syntax_highlighting();
    let render = |labels: &[&Label], help: bool| {
        let mut out = String::new();
        let shown = Shown { diagnostic, excerpt: Excerpt::new(files, labels), help };
        handler.render_report(&mut out, &shown).expect("excerpts hold all their labels");
        out
    };
    // A miette report refers to one text. Labels in further files become further excerpts before the help.
    let primary = diagnostic.span().file;
    let (here, elsewhere): (Vec<&Label>, Vec<&Label>) =
        diagnostic.labels.iter().partition(|label| label.span.file == primary);
    let with_help = render(&here, true);
    if elsewhere.is_empty() {
        return with_help;
    }
    let mut out = render(&here, false);
    let help = with_help[out.len()..].to_string();
    let head = render(&[], false);
    for labels in elsewhere.chunk_by(|a, b| a.span.file == b.span.file) {
        out += &render(labels, false)[head.len()..];
    }
    out + &help
}

/// A diagnostic in the form that miette expects.
#[derive(Debug)]
struct Shown<'a> {
    diagnostic: &'a Diagnostic,
    excerpt: Option<Excerpt>,
    help: bool,
}

impl fmt::Display for Shown<'_> {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&printable(&self.diagnostic.message))
    }
}

impl std::error::Error for Shown<'_> {}

impl miette::Diagnostic for Shown<'_> {
    fn code<'a>(&'a self) -> Option<Box<dyn fmt::Display + 'a>> {
        Some(Box::new(self.diagnostic.code))
    }

    fn severity(&self) -> Option<miette::Severity> {
        Some(match self.diagnostic.severity {
            Severity::Error => miette::Severity::Error,
            Severity::Warning => miette::Severity::Warning,
        })
    }

    fn help<'a>(&'a self) -> Option<Box<dyn fmt::Display + 'a>> {
        let help = self.diagnostic.help.as_ref().filter(|_| self.help)?;
        Some(Box::new(printable(help)))
    }

    fn source_code(&self) -> Option<&dyn SourceCode> {
        self.excerpt.as_ref().map(|excerpt| excerpt as &dyn SourceCode)
    }

    fn labels(&self) -> Option<Box<dyn Iterator<Item = LabeledSpan> + '_>> {
        let excerpt = self.excerpt.as_ref()?;
        Some(Box::new(excerpt.labels.iter().enumerate().map(|(i, label)| {
            let text = Some(label.text.clone()).filter(|text| !text.is_empty());
            let span: SourceSpan = (label.start, label.end - label.start).into();
            if i == 0 { LabeledSpan::new_primary_with_span(text, span) } else { LabeledSpan::new_with_span(text, span) }
        })))
    }
}

/// Replaces control characters by visible symbols; line ends and blanks stay.
fn printable(text: &str) -> String {
    text.chars().map(|c| if c == '\n' { c } else { visible(c) }).collect()
}

/// The visible form of a character: itself, unless it would move the cursor or hide others.
fn visible(c: char) -> char {
    match c {
        '\u{0}'..='\u{1f}' => char::from_u32(0x2400 + c as u32).expect("control pictures are characters"),
        '\u{7f}' => '␡',
        '\u{80}'..='\u{9f}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => '�',
        BYTE_ORDER_MARK => '�',
        c => c,
    }
}

/// The lines of one text from the first to the last label, prepared for display.
#[derive(Debug)]
struct Excerpt {
    name: String,
    /// Lines, each with a newline at its end.
    text: String,
    /// Number of the first line, from 0.
    first_line: usize,
    /// In the order of the diagnostic.
    labels: Vec<ExcerptLabel>,
}

/// A label as a byte range of the excerpt.
#[derive(Debug)]
struct ExcerptLabel {
    start: usize,
    end: usize,
    /// Column of its start in the original line, from 0.
    column: usize,
    text: String,
}

impl Excerpt {
    /// The excerpt for labels in one file; none if there are none or the file is unknown.
    fn new(files: &[SourceFile], labels: &[&Label]) -> Option<Excerpt> {
        let file = files.get(labels.first()?.span.file.0 as usize)?;
        let text: &str = &file.text;
        let spans: Vec<(usize, usize)> = labels.iter().map(|label| shown_span(text, label)).collect();
        let first = spans.iter().map(|(start, _)| *start).min()?;
        let last = spans.iter().map(|(_, end)| *end).max()?;
        let from = text[..first].rfind('\n').map_or(0, |newline| newline + 1);
        let to = text[last..].find('\n').map_or(text.len(), |newline| last + newline);

        let lines = Lines::new(text);
        let mut excerpt = Excerpt {
            name: printable(&file.name),
            text: String::new(),
            first_line: lines.place(from).0 - 1,
            labels: labels
                .iter()
                .zip(&spans)
                .map(|(label, span)| ExcerptLabel {
                    start: 0,
                    end: 0,
                    column: lines.place(span.0).1 - 1,
                    text: printable(&label.text),
                })
                .collect(),
        };
        let mut line_start = from;
        for line in text[from..to].split('\n') {
            excerpt.add_line(line, line_start, &spans);
            line_start += line.len() + 1;
        }
        Some(excerpt)
    }

    /// Adds a line that begins at `offset` of the original text, and maps the ends of labels in it.
    fn add_line(&mut self, line: &str, offset: usize, spans: &[(usize, usize)]) {
        let body = line.strip_suffix('\r').unwrap_or(line);
        let start = self.text.len();
        // Maps characters: (original offset, offset in the excerpt), ascending in both.
        let mut moved: Vec<(usize, usize)> = Vec::with_capacity(body.len() + 1);
        let keep = kept_columns(body, offset, spans);
        let mut column = 0;
        for (n, (at, c)) in body.char_indices().enumerate() {
            moved.push((offset + at, self.text.len()));
            if !keep.contains(&n) {
                if n == 0 || n == keep.end {
                    self.text.push('…');
                    column += 1;
                }
            } else if c == '\t' {
                let width = TAB - column % TAB;
                self.text.extend(std::iter::repeat_n(' ', width));
                column += width;
            } else if !(c == BYTE_ORDER_MARK && offset + at == 0) {
                self.text.push(visible(c));
                column += 1;
            }
        }
        moved.push((offset + body.len(), self.text.len()));
        let place = |original: usize| {
            let next = moved.partition_point(|(from, _)| *from < original);
            moved.get(next).map_or(self.text.len(), |(_, to)| *to)
        };
        let inside = offset..=offset + line.len();
        for (label, span) in self.labels.iter_mut().zip(spans) {
            if inside.contains(&span.0) {
                label.start = place(span.0).max(start);
            }
            if inside.contains(&span.1) {
                label.end = place(span.1).max(label.start);
            }
        }
        self.text.push('\n');
    }

    /// Line number of a byte offset, within the excerpt.
    fn line_of(&self, offset: usize) -> usize {
        self.text[..offset].bytes().filter(|byte| *byte == b'\n').count()
    }
}

/// The marked part of a label: inside the text, at character boundaries, not over many lines.
fn shown_span(text: &str, label: &Label) -> (usize, usize) {
    let start = floor_boundary(text, label.span.start as usize);
    let end = floor_boundary(text, label.span.end as usize).max(start);
    let marked = &text[start..end];
    // A mark up to the end of a line does not extend into the next one.
    let marked = marked.trim_end_matches(['\n', '\r']);
    if marked.bytes().filter(|byte| *byte == b'\n').count() >= MOST_LINES {
        let first = marked.split('\n').next().unwrap_or_default();
        return (start, start + first.trim_end_matches('\r').len());
    }
    (start, start + marked.len())
}

/// The characters of a line that are shown: all, or those around the first label in it.
fn kept_columns(line: &str, offset: usize, spans: &[(usize, usize)]) -> std::ops::Range<usize> {
    let count = line.chars().count();
    if count <= LONGEST_LINE {
        return 0..count;
    }
    let inside = spans.iter().filter(|span| (offset..=offset + line.len()).contains(&span.0));
    let first = inside.map(|span| span.0 - offset).min().unwrap_or(0);
    let centre = line[..floor_boundary(line, first)].chars().count();
    centre.saturating_sub(KEPT.0)..(centre + KEPT.1).min(count)
}

impl SourceCode for Excerpt {
    /// Always whole lines, whatever context miette requests.
    fn read_span<'a>(
        &'a self,
        span: &SourceSpan,
        _before: usize,
        _after: usize,
    ) -> Result<Box<dyn SpanContents<'a> + 'a>, MietteError> {
        let (start, end) = (span.offset(), span.offset() + span.len());
        if end > self.text.len() {
            return Err(MietteError::OutOfBounds);
        }
        let from = self.text[..start].rfind('\n').map_or(0, |newline| newline + 1);
        let to = self.text[end..].find('\n').map_or(self.text.len(), |newline| end + newline + 1);
        let first = self.line_of(start);
        let lines = self.line_of(end) - first + GAP;
        let column = self.labels.iter().find(|label| label.start == start).map_or(0, |label| label.column);
        Ok(Box::new(MietteSpanContents::new_named(
            self.name.clone(),
            &self.text.as_bytes()[from..to],
            (from, to - from).into(),
            self.first_line + first,
            column,
            lines,
        )))
    }
}

#[cfg(test)]
mod tests;
