//! Any text is checked in a bounded time, without a panic.

#![no_main]

use fric_fuzz::{Library, sound};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    let mut loaded = compiler::load("text.fric", text, &Library);
    for diagnostic in compiler::check(&mut loaded, &Library) {
        sound(&diagnostic, |file| loaded.files.0.get(file).map(|file| &*file.text));
    }
});
