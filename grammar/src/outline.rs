//! Finds the items of a text without parsing them, so that each can be parsed when it is first needed.
//!
//! In: a text without errors in canonical layout, where each item begins at the start of a line and no line inside an
//! item begins with the word of an item. Out: its [`Head`]s. Looks only at the beginnings of lines.

use crate::split::ITEMS;
use std::ops::Range;

/// An item of a text, as far as the beginning of its first line tells.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Head {
    /// The word that it begins with: `model`.
    pub word: &'static str,
    /// The bytes of the name after it; for an import, of the beginning of its source.
    pub name: Range<usize>,
    /// The bytes from the comments before the item to those before the next one.
    pub range: Range<usize>,
}

/// The items of a text in canonical layout, in order.
pub fn heads(text: &str) -> Vec<Head> {
    let mut heads: Vec<Head> = Vec::new();
    // Where the comments that precede the present line begin.
    let mut comments = None;
    let mut at = 0;
    for line in text.split_inclusive('\n') {
        let start = at;
        at += line.len();
        if line.starts_with("//") {
            comments.get_or_insert(start);
        }
        if line.starts_with("//") || line.trim_end().is_empty() {
            continue;
        }
        let begin = comments.take().unwrap_or(start);
        let is_name = |b: &u8| b.is_ascii_alphanumeric() || *b == b'_';
        let word = &line[..line.bytes().take_while(|b| is_name(b)).count()];
        let Some(word) = ITEMS.into_iter().find(|item| *item == word) else { continue };
        if let Some(last) = heads.last_mut() {
            last.range.end = begin;
        }
        let rest = line[word.len()..].trim_start();
        let from = at - rest.len();
        let name = from..from + rest.bytes().take_while(is_name).count();
        heads.push(Head { word, name, range: begin..text.len() });
    }
    heads
}

/// Whether an item of this word declares a name that distinguishes derivatives from divisions in the whole text.
pub(crate) fn declares_for_text(word: &str) -> bool {
    matches!(word, "const" | "fn" | "table")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ast::Item;
    use crate::parse::{parse, parse_item};
    use crate::span::FileId;

    /// Checks that the items of a text are the same whether they are parsed together or one by one.
    fn agrees(name: &str, text: &str) {
        let whole = parse(FileId(7), text);
        assert_eq!(whole.diagnostics, [], "{name}");
        let one_by_one: Vec<Item> =
            heads(text).iter().map(|head| parse_item(FileId(7), text, head).0.unwrap()).collect();
        assert_eq!(one_by_one, whole.file.items, "{name}");
    }

    #[test]
    fn comments_before_an_item_belong_to_it() {
        let text = "// the file\n\nimport std.friction\n/// one\n/// a\nconst a = 1\n\n/// stray\n\n/// f\n\nfn f(x) =\n  x * a\n";
        let found: Vec<_> =
            heads(text).into_iter().map(|head| (head.word, &text[head.name], &text[head.range])).collect();
        let expected = [
            ("import", "std", "// the file\n\nimport std.friction\n"),
            ("const", "a", "/// one\n/// a\nconst a = 1\n\n"),
            ("fn", "f", "/// stray\n\n/// f\n\nfn f(x) =\n  x * a\n"),
        ];
        assert_eq!(found, expected);
        agrees("comments", text);
    }

    /// `dz/dc` is a division where the text declares a constant `dc`, in whichever item.
    #[test]
    fn names_of_the_whole_text_decide_what_is_a_derivative() {
        agrees("names", "model M {\n  state z = 0\n  state c = 0\n  dz/dt = dz/dc\n  dc/dt = 1\n}\n\nconst dc = 1\n");
    }

    #[test]
    fn every_text_of_the_library_and_every_sample_agrees() {
        let mut folders = vec![concat!(env!("CARGO_MANIFEST_DIR"), "/../stdlib-models").into()];
        folders.push(concat!(env!("CARGO_MANIFEST_DIR"), "/../examples").into());
        let mut count = 0;
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir::<std::path::PathBuf>(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() {
                    folders.push(path);
                } else if path.extension().is_some_and(|extension| extension == "fric") {
                    agrees(&path.display().to_string(), &std::fs::read_to_string(&path).unwrap());
                    count += 1;
                }
            }
        }
        assert!(count > 60, "{count} texts");
    }
}
