//! The key of a panel: 128 bits from the system, new at each start.
//!
//! It travels in the fragment of the link, which no browser sends to a server, and then as the first message of a
//! socket. The only file that uses the getrandom crate.

use std::fmt::{self, Write};

/// A key. It has no `Debug` of its content, so that it cannot slip into a message.
#[derive(Clone)]
pub struct Key([u8; 16]);

impl Key {
    /// A key from the system's source of random numbers.
    ///
    /// # Errors
    /// Why the system gives none.
    pub fn random() -> Result<Key, String> {
        let mut bytes = [0; 16];
        getrandom::fill(&mut bytes).map_err(|why| format!("the system gives no random numbers: {why}"))?;
        Ok(Key(bytes))
    }

    /// As it stands in a link: 32 hexadecimal digits.
    pub fn text(&self) -> String {
        self.0.iter().fold(String::new(), |mut text, byte| {
            let _ = write!(text, "{byte:02x}");
            text
        })
    }

    /// Whether a text is this key. The time that it takes depends only on the length of the text.
    pub fn is(&self, text: &str) -> bool {
        let own = self.text();
        let differ = own.bytes().zip(text.bytes()).fold(0, |differ, (a, b)| differ | (a ^ b));
        own.len() == text.len() && differ == 0
    }
}

impl fmt::Debug for Key {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("Key")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_whole_key_is_the_key() {
        let key = Key::random().unwrap();
        let text = key.text();
        assert_eq!(text.len(), 32);
        assert!(key.is(&text) && format!("{key:?}") == "Key");
        for cut in 0..32 {
            assert!(!key.is(&text[..cut]));
            let other = if &text[cut..=cut] == "0" { "1" } else { "0" };
            assert!(!key.is(&format!("{}{other}{}", &text[..cut], &text[cut + 1..])), "digit {cut}");
        }
        assert!(
            !key.is(&format!("{text}0"))
                && !key.is(&format!(" {text}"))
                && !key.is(&text.to_uppercase().replace('0', "O"))
        );
        assert_ne!(Key::random().unwrap().text(), text);
    }
}
