//! Any text gives a tree, and errors with their places.

#![no_main]

use grammar::span::FileId;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    let parsed = grammar::parse::parse(FileId(0), text);
    for diagnostic in &parsed.diagnostics {
        fric_fuzz::sound(diagnostic, |file| (file == 0).then_some(text));
    }
});
