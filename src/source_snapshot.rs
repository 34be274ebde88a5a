//! Snapshots of source texts in a log: the texts that were read while a rig was compiled, for replay.
//!
//! In: the [`Sources`] of a compilation. Out: sections of a log, and sources reconstructed from them, so that a replay
//! compiles the texts that ran even if the files have changed since.

use crate::compile::Sources;
use runtime::record::log::Sections;
use std::cell::RefCell;

/// Forwards to other sources and records their answers.
pub struct Keeping<'a> {
    inner: &'a dyn Sources,
    kept: RefCell<Sections>,
}

/// Separator within the name and the text of a section: occurs in no text of the language.
const GAP: char = '\0';

impl<'a> Keeping<'a> {
    /// Records the answers of other sources.
    pub fn new(inner: &'a dyn Sources) -> Keeping<'a> {
        Keeping { inner, kept: RefCell::default() }
    }

    /// Adds the recorded answers to the head of a log.
    pub fn into(self, mut head: Sections) -> Sections {
        head.0.extend(self.kept.into_inner().0);
        head
    }

    fn keep(&self, name: &str, text: &str) {
        let mut kept = self.kept.borrow_mut();
        if kept.get(name).is_none() {
            kept.0.push((name.into(), text.into()));
        }
    }
}

impl Sources for Keeping<'_> {
    fn library(&self, module: &str) -> Option<Vec<(String, String)>> {
        let found = self.inner.library(module)?;
        let names: Vec<&str> = found.iter().map(|(name, _)| name.as_str()).collect();
        self.keep(&format!("library{GAP}{module}"), &names.join("\n"));
        found.iter().for_each(|(name, text)| self.keep(&format!("text{GAP}{name}"), text));
        Some(found)
    }

    fn modules(&self) -> Vec<String> {
        self.inner.modules()
    }

    fn library_is_sound(&self) -> bool {
        self.inner.library_is_sound()
    }

    fn file(&self, from: &str, path: &str) -> Result<(String, String), String> {
        let (name, text) = self.inner.file(from, path)?;
        self.keep(&format!("file{GAP}{from}{GAP}{path}"), &name);
        self.keep(&format!("text{GAP}{name}"), &text);
        Ok((name, text))
    }
}

/// Sources that answer from the head of a log.
pub struct Kept<'a>(pub &'a Sections);

impl Kept<'_> {
    fn text(&self, name: &str) -> Option<(String, String)> {
        Some((name.into(), self.0.text(&format!("text{GAP}{name}"))?.into()))
    }
}

impl Sources for Kept<'_> {
    fn library(&self, module: &str) -> Option<Vec<(String, String)>> {
        let names = self.0.text(&format!("library{GAP}{module}"))?;
        names.lines().map(|name| self.text(name)).collect()
    }

    fn modules(&self) -> Vec<String> {
        Vec::new()
    }

    fn file(&self, from: &str, path: &str) -> Result<(String, String), String> {
        let name = self.0.text(&format!("file{GAP}{from}{GAP}{path}"));
        name.and_then(|name| self.text(name)).ok_or_else(|| "the log does not hold it".into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Some2;

    impl Sources for Some2 {
        fn library(&self, module: &str) -> Option<Vec<(String, String)>> {
            (module == "std.a")
                .then(|| vec![("std.a.x.fric".into(), "one".into()), ("std.a.y.fric".into(), "two".into())])
        }
        fn modules(&self) -> Vec<String> {
            vec!["std.a".into()]
        }
        fn file(&self, from: &str, path: &str) -> Result<(String, String), String> {
            (path == "p.fric").then(|| (format!("{from}/p.fric"), "three".into())).ok_or("no".into())
        }
    }

    #[test]
    fn a_snapshot_returns_the_recorded_answers() {
        let keeping = Keeping::new(&Some2);
        let library = keeping.library("std.a");
        let file = keeping.file("f", "p.fric");
        assert!(keeping.library("std.b").is_none() && keeping.file("f", "q").is_err());
        let head = keeping.into(Sections::default().with("rig", "r"));
        let kept = Kept(&head);
        assert_eq!((kept.library("std.a"), kept.file("f", "p.fric")), (library, file));
        assert!(kept.library("std.b").is_none() && kept.file("g", "p.fric").is_err());
        assert_eq!(head.text("rig"), Some("r"));
    }
}
