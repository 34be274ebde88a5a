//! An interactive session: classification of lines, state of the session, editing and completion.
//!
//! In: lines. Out: values, figures, diagnostics. A session is a text under construction: its items and instances form a
//! file, and every line is parsed, checked and compiled as part of that file. Prints nothing.

mod command;

mod session;

mod complete;

mod line;

pub use command::{COMMANDS, LineKind, PromptCommand, cut_to, inputs, read};
pub use complete::{Candidate, meant};
pub use line::{Editor, Input, as_typed};
pub use session::{Cut, Fault, Ran, Session, Value, library_models, plain};
