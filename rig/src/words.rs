//! What is said on the two output streams. A reader that went away loses words, nothing else.

use std::io::Write;

/// Prints to the standard output.
pub fn print(text: &str) {
    let mut out = std::io::stdout().lock();
    let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
}

/// Reports a failure on the standard error.
pub fn error(why: &str) {
    let _ = writeln!(std::io::stderr().lock(), "error: {}", why.trim_end());
}
