//! What has no syntax error is formatted, and the result is formatted into itself.

#![no_main]

use grammar::span::FileId;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    let fine = grammar::parse::parse(FileId(0), text).diagnostics.is_empty();
    let formatted = grammar::format::format(text, 100);
    assert_eq!(formatted.is_ok(), fine);
    if let Ok(formatted) = formatted {
        assert_eq!(grammar::format::format(&formatted, 100).as_deref(), Ok(formatted.as_str()));
    }
});
