//! Texts and where they come from.

use grammar::ast;
use grammar::span::{FileId, Span};
use std::sync::Arc;

/// How an import, or a file that a text names, is found. The compiler itself opens nothing.
pub trait Sources {
    /// The texts of a library module such as `std.friction`: name to show and text of each file of its folder.
    fn library(&self, module: &str) -> Option<Vec<(String, String)>>;

    /// The names of all library modules, for suggestions.
    fn modules(&self) -> Vec<String>;

    /// A file named in the text called `from`: its own name and its text.
    ///
    /// # Errors
    /// Why it cannot be read, as a half sentence: `no such file`.
    fn file(&self, from: &str, path: &str) -> Result<(String, String), String>;
}

/// Sources with neither library nor files.
pub struct NoSources;

impl Sources for NoSources {
    fn library(&self, _: &str) -> Option<Vec<(String, String)>> {
        None
    }

    fn modules(&self) -> Vec<String> {
        Vec::new()
    }

    fn file(&self, _: &str, _: &str) -> Result<(String, String), String> {
        Err("no files can be read here".into())
    }
}

/// One text of a compilation.
#[derive(Clone, Debug)]
pub struct SourceFile {
    /// Name to show, and to find what it imports.
    pub name: String,
    /// The text.
    pub text: Arc<str>,
    /// Its tree.
    pub ast: Arc<ast::File>,
    /// Whether it belongs to the library.
    pub library: bool,
}

/// The texts of a compilation, by [`FileId`].
#[derive(Clone, Debug, Default)]
pub struct Files(pub Vec<SourceFile>);

impl Files {
    /// One of them.
    pub fn get(&self, id: FileId) -> &SourceFile {
        &self.0[id.0 as usize]
    }

    /// The characters at a place.
    pub fn slice(&self, span: Span) -> &str {
        &self.get(span.file).text[span.range()]
    }

    /// Line of a place, counted from 1.
    pub fn line(&self, span: Span) -> usize {
        self.get(span.file).text.as_bytes()[..span.start as usize].iter().filter(|&&b| b == b'\n').count() + 1
    }
}
