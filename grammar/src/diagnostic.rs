//! Diagnostics: errors and warnings about a text, as plain data.
//!
//! Produced by every stage of the compiler; rendered elsewhere.

use crate::span::Span;

/// Severity of a diagnostic.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub enum Severity {
    /// The text cannot be compiled.
    Error,
    /// The text compiles, but the user should look at the marked place.
    Warning,
}

/// Kinds of errors that are found again at each place that leads to them. Only the first of each kind is shown.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Recurring {
    /// A model contains itself.
    Part,
    /// A function calls itself.
    Call,
    /// A name is defined by itself.
    Name,
    /// Parts or functions are nested too deep.
    Depth,
    /// The program has too many quantities and parts.
    Quantities,
    /// The program has too many operations.
    Operations,
}

/// Mistakes about one word that stands in many places: the parser reports them once.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum WordMistake {
    /// A name has letters that names cannot contain.
    ForeignName,
    /// A keyword stands in the place of a name.
    Reserved,
    /// A word does not fit where it stands.
    Misfit,
    /// A word begins a choice or a loop of statements, as in other languages.
    Block,
    /// A word ends such a block.
    BlockEnd,
}

/// One error or warning: the problem, its place, and a suggestion.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Diagnostic {
    /// Stable code with a page of its own, such as `E0101`.
    pub code: &'static str,
    /// Error or warning.
    pub severity: Severity,
    /// One sentence in the words of the file.
    pub message: String,
    /// Labelled spans; the first is where the user should make the change.
    pub labels: Vec<Label>,
    /// Suggestion, if possible as text to paste. May have several lines.
    pub help: Option<String>,
    /// Its kind, if it recurs.
    pub recurring: Option<Recurring>,
    /// Its kind, if it is about the word at its primary place.
    pub word: Option<WordMistake>,
}

/// A span with a short text.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Label {
    /// The labelled bytes.
    pub span: Span,
    /// The text of the label; may be empty.
    pub text: String,
}

impl Diagnostic {
    /// An error without a span; add one by [`label`](Diagnostic::label).
    pub fn error(code: &'static str, message: impl Into<String>) -> Diagnostic {
        let (severity, message) = (Severity::Error, message.into());
        Diagnostic { code, severity, message, labels: Vec::new(), help: None, recurring: None, word: None }
    }

    /// A warning without a span.
    pub fn warning(code: &'static str, message: impl Into<String>) -> Diagnostic {
        Diagnostic { severity: Severity::Warning, ..Diagnostic::error(code, message) }
    }

    /// Adds a label. The first label is the primary one.
    pub fn label(mut self, span: Span, text: impl Into<String>) -> Diagnostic {
        self.labels.push(Label { span, text: text.into() });
        self
    }

    /// Sets the suggestion.
    pub fn help(mut self, help: impl Into<String>) -> Diagnostic {
        self.help = Some(help.into());
        self
    }

    /// Marks it as one that recurs.
    pub fn recurring(mut self, recurring: Recurring) -> Diagnostic {
        self.recurring = Some(recurring);
        self
    }

    /// Marks it as a mistake about the word at its primary place.
    pub(crate) fn about_word(mut self, mistake: WordMistake) -> Diagnostic {
        self.word = Some(mistake);
        self
    }

    /// The primary place: where the change is to be made.
    pub fn span(&self) -> Span {
        self.labels.first().map(|label| label.span).unwrap_or_default()
    }

    /// Whether it prevents compilation.
    pub fn is_error(&self) -> bool {
        self.severity == Severity::Error
    }
}
