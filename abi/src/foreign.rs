//! Checks of untrusted text: from another computer, a package or a log.
//!
//! In: an untrusted text. Out: whether it can serve as a name or as one component of a path, and a form of it without
//! any effect on a terminal. Does not know where the text came from.

use std::borrow::Cow;

/// Maximum length of a name in bytes. With a suffix, it still fits into a file system.
const LONGEST_NAME: usize = 128;

/// Whether a character changes the state of a terminal, or the order or visibility of its neighbours.
fn acts(c: char) -> bool {
    // Control characters; then direction marks, joiners, and invisible operators of Unicode.
    c.is_control()
        || matches!(c, '\u{200B}'..='\u{200F}' | '\u{2028}'..='\u{202E}' | '\u{2060}'..='\u{206F}' | '\u{FEFF}')
}

/// Whether a text is one line that a terminal displays unchanged.
pub fn is_plain(text: &str) -> bool {
    !text.chars().any(acts)
}

/// Whether a text of one or more lines can be displayed unchanged.
pub fn is_text(text: &str) -> bool {
    !text.chars().any(hidden)
}

fn hidden(c: char) -> bool {
    acts(c) && !matches!(c, '\n' | '\t')
}

/// Escapes every character that affects a terminal. Line feeds and tabs are unchanged.
///
/// `"x\u{1b}[2J"` becomes `x\u{1b}[2J` in letters.
pub fn shown(text: &str) -> Cow<'_, str> {
    if is_text(text) {
        return Cow::Borrowed(text);
    }
    let escaped = text.chars().map(|c| if hidden(c) { c.escape_default().to_string() } else { c.to_string() });
    Cow::Owned(escaped.collect())
}

/// Whether a text is a name of the language: letters, digits and `_`, not empty, not too long for a file.
pub fn is_name(text: &str) -> bool {
    (1..=LONGEST_NAME).contains(&text.len()) && text.chars().all(|c| c.is_alphanumeric() || c == '_')
}

/// Whether a text names one file in a folder: one component of a path, not hidden, and not an option of a command.
pub fn is_component(text: &str) -> bool {
    (1..=2 * LONGEST_NAME - 1).contains(&text.len())
        && is_plain(text)
        && !text.contains(['/', '\\'])
        && !text.starts_with(['.', '-'])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_acts_on_a_terminal_is_shown_as_an_escape() {
        assert_eq!(shown("σ₀ = 1e5 N/m\nnext"), "σ₀ = 1e5 N/m\nnext");
        assert_eq!(shown("a\u{1b}]0;title\u{7}b\r"), "a\\u{1b}]0;title\\u{7}b\\r");
        assert_eq!(shown("\u{9b}2J\u{202e}txt.exe"), "\\u{9b}2J\\u{202e}txt.exe");
    }

    #[test]
    fn a_component_stays_in_its_folder() {
        for good in ["rtfs-1764000000000.friclog", "σ.friclog", "a b"] {
            assert!(is_component(good), "{good}");
        }
        let long = "x".repeat(256);
        for bad in ["", ".", "..", "../x", "/etc/passwd", "a/b", "a\\b", "-rf", ".hidden", "a\u{1b}[2J", "a\nb", &long]
        {
            assert!(!is_component(bad), "{bad:?}");
        }
        assert!(is_name("rtfs_2") && is_name("Roller_é"));
        for bad in ["", "../x", "a b", "a.b", "a-b", "a\u{7}"] {
            assert!(!is_name(bad), "{bad:?}");
        }
    }
}
