//! What is said about a text: plain data, rendered elsewhere.

use crate::span::Span;

/// How bad it is.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub enum Severity {
    /// The text cannot be compiled.
    Error,
    /// The text compiles, but something in it deserves a look.
    Warning,
}

/// Mistakes that are met again at each place that leads to them. Of each kind one message is shown: the first.
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

/// One mistake: what is wrong, where, and what would mend it.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Diagnostic {
    /// Stable code with a page of its own, such as `E0101`.
    pub code: &'static str,
    /// Error or warning.
    pub severity: Severity,
    /// One sentence in the words of the file.
    pub message: String,
    /// Places; the first is where the change is to be made.
    pub labels: Vec<Label>,
    /// What to do, if possible as text to paste. May have several lines.
    pub help: Option<String>,
    /// Its kind, if it recurs.
    pub recurring: Option<Recurring>,
}

/// A marked place with a few words.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Label {
    /// The marked bytes.
    pub span: Span,
    /// The words; may be empty.
    pub text: String,
}

impl Diagnostic {
    /// An error without a place yet: [`label`](Diagnostic::label) gives it one.
    pub fn error(code: &'static str, message: impl Into<String>) -> Diagnostic {
        let (severity, message) = (Severity::Error, message.into());
        Diagnostic { code, severity, message, labels: Vec::new(), help: None, recurring: None }
    }

    /// A warning.
    pub fn warning(code: &'static str, message: impl Into<String>) -> Diagnostic {
        Diagnostic { severity: Severity::Warning, ..Diagnostic::error(code, message) }
    }

    /// Adds a marked place. The first one added is the primary place.
    pub fn label(mut self, span: Span, text: impl Into<String>) -> Diagnostic {
        self.labels.push(Label { span, text: text.into() });
        self
    }

    /// Says what would mend it.
    pub fn help(mut self, help: impl Into<String>) -> Diagnostic {
        self.help = Some(help.into());
        self
    }

    /// Marks it as one that recurs.
    pub fn recurring(mut self, recurring: Recurring) -> Diagnostic {
        self.recurring = Some(recurring);
        self
    }

    /// The primary place: where the change is to be made.
    pub fn span(&self) -> Span {
        self.labels.first().map(|label| label.span).unwrap_or_default()
    }

    /// Whether the text cannot be compiled because of this.
    pub fn is_error(&self) -> bool {
        self.severity == Severity::Error
    }
}
