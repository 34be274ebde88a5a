//! Text for a page: names, comments and messages come from files that others may have written.

/// The text with control characters and marks of writing direction as escapes, so that it shows what it holds: a mark
/// of direction can make `fr.Fs = 1` read as another line.
pub fn clean(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '\n' => out.push(c),
            '\u{200e}' | '\u{200f}' | '\u{061c}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => {
                out.extend(c.escape_unicode());
            }
            c if c.is_control() => out.extend(c.escape_unicode()),
            c => out.push(c),
        }
    }
    out
}

#[test]
fn marks_of_direction_are_visible() {
    assert_eq!(clean("fr.Fs \u{202e}stiction\t1\u{7}"), "fr.Fs \\u{202e}stiction\\u{9}1\\u{7}");
    assert_eq!(clean("N·m µ ⟨a⟩ \nעברית"), "N·m µ ⟨a⟩ \nעברית");
}
