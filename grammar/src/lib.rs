//! Text to syntax tree and diagnostics, and tree back to canonical text.
//!
//! In: a text. Out: always a [`ast::File`], with what is wrong as [`diagnostic::Diagnostic`]s. Does no input or
//! output and knows no units, models or names beyond the model that it is reading.

pub mod span;

pub mod diagnostic;

pub mod ast;

pub mod tokens;

mod split;

mod slips;

pub mod parse;

pub mod format;
