//! A session at the prompt: what a line is, what the session knows, how a line is edited and completed.
//!
//! In: lines. Out: values, figures, diagnostics. A session is a text under construction: its items and instances are
//! laid out as a file, and every line is read, checked and compiled as part of that file. Prints nothing.

mod command;

mod session;

mod complete;

mod line;

pub use command::{COMMANDS, Command, Line, cut_to, inputs, read};
pub use complete::{Candidate, meant};
pub use line::{Editor, Input, as_typed};
pub use session::{Cut, Fault, Ran, Session, Value, library_models, plain};
