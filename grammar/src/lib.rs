//! Parser and formatter: text to syntax tree and diagnostics, and text to its canonical form.
//!
//! In: a text. Out: always an [`ast::File`], with errors as [`diagnostic::Diagnostic`]s. Performs no input or output.
//! Knows no units, no models, and no names beyond the model that is being parsed.

pub mod span;

pub mod diagnostic;

pub mod ast;

pub mod tokens;

mod split;

pub mod outline;

mod slips;

pub mod parse;

pub mod format;
