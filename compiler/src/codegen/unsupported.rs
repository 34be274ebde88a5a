//! The reason why something cannot be compiled to machine code.

use std::fmt;

/// The reason why there is no machine code. Callers run the interpreter instead, and report the reason.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Unsupported(pub String);

impl fmt::Display for Unsupported {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Unsupported {}
