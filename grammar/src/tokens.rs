//! Tokeniser: a text as a sequence of tokens without gaps, including blanks and comments.
//!
//! In: any text. Out: [`Token`]s, which together are the text. Used to split statements, to format, and to colour text
//! in editors. Knows words but no grammar rules. Only the extent of a unit is decided here, because otherwise `2 N*m`
//! would be a product.

/// Words that are reserved everywhere.
pub const KEYWORDS: [&str; 36] = [
    "allow",
    "and",
    "const",
    "crosses",
    "device",
    "else",
    "every",
    "experiment",
    "falls",
    "fit",
    "fn",
    "go",
    "if",
    "import",
    "in",
    "initial",
    "input",
    "interface",
    "let",
    "mode",
    "model",
    "next",
    "not",
    "or",
    "output",
    "param",
    "part",
    "require",
    "reset",
    "rig",
    "rises",
    "state",
    "storage",
    "table",
    "then",
    "when",
];

/// Words with a meaning only in experiments, fits, tables, devices and rigs. They are allowed as names, but never a
/// unit.
pub const CONTEXT_WORDS: [&str; 47] = [
    "after", "against", "as", "at", "before", "bus", "by", "byte", "case", "data", "drive", "each", "expect", "for",
    "from", "hardware", "hold", "limit", "lin", "linear", "log", "message", "minimise", "overrun", "plot", "predict",
    "rate", "read", "record", "rotary", "run", "safe", "scale", "send", "show", "slew", "smooth", "solver", "step",
    "stop", "sweep", "title", "tol", "tune", "validate", "vary", "watchdog",
];

/// Whether `word` is reserved everywhere.
pub fn is_keyword(word: &str) -> bool {
    KEYWORDS.binary_search(&word).is_ok()
}

/// Whether `word` has a meaning in some contexts only.
pub fn is_context_word(word: &str) -> bool {
    CONTEXT_WORDS.binary_search(&word).is_ok()
}

/// Kind of a token.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum TokenKind {
    /// Spaces, tabs, carriage returns, or a byte order mark at the start.
    Blank,
    /// One line feed.
    Newline,
    /// `// …`, without its line feed.
    Comment,
    /// `/// …`, without its line feed.
    Doc,
    /// A name or a keyword.
    Word,
    /// `3`, `0.5`, `1e-3`, `0x200`.
    Number,
    /// A unit after a number or in brackets.
    Unit,
    /// `"…"`.
    Text,
    /// A quote that is not closed on its line, up to the end of the line.
    OpenText,
    /// An operator or a bracket.
    Symbol,
    /// A character that the language does not use, or `/* … */`.
    Unknown,
}

/// A token: a range of bytes and its kind.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Token {
    /// What it is.
    pub kind: TokenKind,
    /// Offset of its first byte.
    pub start: usize,
    /// Offset after its last byte.
    pub end: usize,
}

impl Token {
    /// The characters of the token.
    pub fn text(self, source: &str) -> &str {
        &source[self.start..self.end]
    }

    /// Whether it only separates tokens: a blank, a line feed or a comment.
    pub fn is_trivia(self) -> bool {
        match self.kind {
            TokenKind::Blank | TokenKind::Newline | TokenKind::Comment | TokenKind::Doc => true,
            TokenKind::Word
            | TokenKind::Number
            | TokenKind::Unit
            | TokenKind::Text
            | TokenKind::OpenText
            | TokenKind::Symbol
            | TokenKind::Unknown => false,
        }
    }
}

/// The tokens of `text`, in order and without gaps.
pub fn tokens(text: &str) -> Vec<Token> {
    let mut found: Vec<Token> = Vec::with_capacity(text.len() / 3);
    let mut at = 0;
    // Determines whether a word is a unit: after a number on the same line with only blanks between, or in brackets.
    let mut behind = Behind::Other;
    while at < text.len() {
        let bytes = text.as_bytes();
        let (kind, end) = match bytes[at] {
            b' ' | b'\t' | b'\r' => (TokenKind::Blank, at + run(&bytes[at..], |b| matches!(b, b' ' | b'\t' | b'\r'))),
            b'\n' => (TokenKind::Newline, at + 1),
            b'/' if bytes[at..].starts_with(b"//") => {
                let end = at + run(&bytes[at..], |b| b != b'\n');
                let doc = bytes[at..].starts_with(b"///") && !bytes[at..].starts_with(b"////");
                (if doc { TokenKind::Doc } else { TokenKind::Comment }, end)
            }
            // Not a comment in this language, but in others.
            b'/' if bytes[at..].starts_with(b"/*") => {
                let end = text[at + 2..].find("*/").map_or(text.len(), |close| at + 2 + close + 2);
                (TokenKind::Unknown, end)
            }
            b'"' => {
                let inside = at + 1 + run(&bytes[at + 1..], |b| b != b'"' && b != b'\n');
                let closed = bytes.get(inside) == Some(&b'"');
                if closed { (TokenKind::Text, inside + 1) } else { (TokenKind::OpenText, inside) }
            }
            first => match unit_behind(text, at, behind) {
                Some(end) => (TokenKind::Unit, end),
                None if first.is_ascii_alphabetic() || first == b'_' => {
                    (TokenKind::Word, at + run(&bytes[at..], is_name))
                }
                None if first.is_ascii_digit() => (TokenKind::Number, number_end(bytes, at)),
                None => symbol(text, at),
            },
        };
        behind = match (kind, behind) {
            (TokenKind::Number, _) => Behind::Number,
            (TokenKind::Symbol, _) if &text[at..end] == "[" => Behind::Bracket,
            // A carriage return counts as a blank, but a unit cannot follow it.
            (TokenKind::Blank, before) if !text[at..end].contains('\r') || before == Behind::Bracket => before,
            (TokenKind::Newline | TokenKind::Comment | TokenKind::Doc, Behind::Bracket) => Behind::Bracket,
            _ => Behind::Other,
        };
        debug_assert!(end > at);
        found.push(Token { kind, start: at, end });
        at = end;
    }
    found
}

#[derive(Clone, Copy, PartialEq)]
enum Behind {
    Number,
    Bracket,
    Other,
}

fn run(bytes: &[u8], inside: impl Fn(u8) -> bool) -> usize {
    bytes.iter().position(|&b| !inside(b)).unwrap_or(bytes.len())
}

fn is_name(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || byte == b'_'
}

fn number_end(bytes: &[u8], start: usize) -> usize {
    let digits = |from: usize| run(&bytes[from.min(bytes.len())..], |b| b.is_ascii_digit());
    if bytes[start..].starts_with(b"0x") {
        let hex = run(&bytes[start + 2..], |b| b.is_ascii_hexdigit());
        if hex > 0 {
            return start + 2 + hex;
        }
    }
    let mut end = start + digits(start);
    if bytes.get(end) == Some(&b'.') && digits(end + 1) > 0 {
        end += 1 + digits(end + 1);
    }
    if matches!(bytes.get(end), Some(b'e' | b'E')) {
        let sign = matches!(bytes.get(end + 1), Some(b'+' | b'-')) as usize;
        if digits(end + 1 + sign) > 0 {
            end += 1 + sign + digits(end + 1 + sign);
        }
    }
    end
}

/// The end of the unit that begins at `at`, if a unit is allowed there.
fn unit_behind(text: &str, at: usize, behind: Behind) -> Option<usize> {
    match behind {
        Behind::Number => unit_end(text, at),
        Behind::Bracket => unit_end(text, at).filter(|&end| closes(text.as_bytes(), end)),
        Behind::Other => None,
    }
}

/// The end of the unit that begins at `start`, if there is one. The same rule as `unit` in the grammar.
fn unit_end(text: &str, start: usize) -> Option<usize> {
    let rest = &text[start..];
    let word = &rest[..run(rest.as_bytes(), is_name)];
    if is_keyword(word) || is_context_word(word) {
        return None;
    }
    let mut end = start + if rest.starts_with("1/") { 2 } else { 0 };
    end = unit_atom_end(text, end)?;
    while let Some(operator) = text[end..].chars().next().filter(|c| matches!(c, '·' | '*' | '/')) {
        let Some(next) = unit_atom_end(text, end + operator.len_utf8()) else { break };
        end = next;
    }
    let behind = text[end..].trim_start_matches([' ', '\t']);
    let defined = behind.starts_with('=') && !behind.starts_with("==");
    (!defined).then_some(end)
}

fn unit_atom_end(text: &str, start: usize) -> Option<usize> {
    let rest = &text[start..];
    let letters: usize =
        rest.chars().take_while(|&c| c.is_ascii_alphabetic() || "%°µμΩ".contains(c)).map(char::len_utf8).sum();
    let bytes = rest.as_bytes();
    let behind = bytes.get(letters).copied().unwrap_or(b' ');
    if letters == 0 || is_name(behind) || behind == b'(' {
        return None;
    }
    let exponent = match &bytes[letters..] {
        [b'^', b'-', digit, ..] if digit.is_ascii_digit() => 3,
        [b'^', digit, ..] if digit.is_ascii_digit() => 2,
        _ => 0,
    };
    Some(start + letters + exponent)
}

/// Whether only blanks precede the next closing bracket after `at`.
fn closes(bytes: &[u8], at: usize) -> bool {
    let blanks = run(&bytes[at..], |b| b.is_ascii_whitespace());
    bytes.get(at + blanks) == Some(&b']')
}

fn symbol(text: &str, at: usize) -> (TokenKind, usize) {
    const SYMBOLS: [&str; 27] = [
        "<=", ">=", "==", "!=", "~=", "+-", "..", ":=", "<", ">", "=", "+", "-", "*", "/", "^", "(", ")", "[", "]",
        "{", "}", ",", ".", ":", "?", ";",
    ];
    if let Some(symbol) = SYMBOLS.iter().find(|symbol| text[at..].starts_with(**symbol)) {
        return (TokenKind::Symbol, at + symbol.len());
    }
    let length = text[at..].chars().next().map_or(1, char::len_utf8);
    let mark = at == 0 && text.starts_with('\u{feff}');
    (if mark { TokenKind::Blank } else { TokenKind::Unknown }, at + length)
}
