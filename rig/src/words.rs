//! What is said on the two output streams. A reader that went away loses words, nothing else.
//!
//! Much of it comes from elsewhere (names in packages, on buses, in folders): what would act on a terminal is shown as an
//! escape. The program itself uses no colour.

use abi::foreign::shown;
use std::io::Write;

/// Prints to the standard output.
pub fn print(text: &str) {
    let _ = is_read(text);
}

/// Prints to the standard output; returns whether somebody reads it.
pub fn is_read(text: &str) -> bool {
    let mut out = std::io::stdout().lock();
    out.write_all(shown(text).as_bytes()).and_then(|()| out.flush()).is_ok()
}

/// Says something on the standard error that is no failure.
pub fn report(text: &str) {
    let _ = std::io::stderr().lock().write_all(shown(text).as_bytes());
}

/// Reports a failure on the standard error.
pub fn error(why: &str) {
    let _ = writeln!(std::io::stderr().lock(), "error: {}", shown(why.trim_end()));
}
