//! Output on the two standard streams. A reader that has closed its end loses text and nothing else happens.
//!
//! Many texts come from elsewhere (names in packages, on buses, in folders): characters that would control a terminal
//! are escaped. The program itself uses no colour.

use abi::foreign::shown;
use std::io::Write;

/// Prints to the standard output.
pub fn print(text: &str) {
    let _ = is_read(text);
}

/// Prints to the standard output; returns whether the stream is still open.
pub fn is_read(text: &str) -> bool {
    let mut out = std::io::stdout().lock();
    out.write_all(shown(text).as_bytes()).and_then(|()| out.flush()).is_ok()
}

/// Writes bytes to the standard output as they are, for a program at its other end; returns whether it is still open.
pub fn is_written(bytes: &[u8]) -> bool {
    let mut out = std::io::stdout().lock();
    out.write_all(bytes).and_then(|()| out.flush()).is_ok()
}

/// Prints a report that is no failure to the standard error.
pub fn report(text: &str) {
    let _ = std::io::stderr().lock().write_all(shown(text).as_bytes());
}

/// Prints a failure to the standard error.
pub fn error(why: &str) {
    let _ = writeln!(std::io::stderr().lock(), "error: {}", shown(why.trim_end()));
}
