//! Texts of a compilation and the interface through which they are read.
//!
//! In: names of modules and files. Out: texts. Opens no file itself; the caller implements [`Sources`].

use grammar::ast;
use grammar::span::{FileId, Span};
use std::sync::Arc;

/// Finds imports and the files that a text names. The compiler itself opens no file.
pub trait Sources {
    /// The texts of a library module such as `std.friction`: displayed name and text of each file of its folder.
    fn library(&self, module: &str) -> Option<Vec<(String, String)>>;

    /// The names of all library modules, for suggestions in messages.
    fn modules(&self) -> Vec<String>;

    /// Reads a file named in the text called `from`. Returns the file's name and its text.
    ///
    /// # Errors The reason why it cannot be read, as a sentence fragment: `no such file`.
    fn file(&self, from: &str, path: &str) -> Result<(String, String), String>;
}

/// Sources without library and without files.
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
    /// Displayed name, relative to which imports are found.
    pub name: String,
    /// The text.
    pub text: Arc<str>,
    /// The syntax tree.
    pub ast: Arc<ast::File>,
    /// Whether it belongs to the library.
    pub library: bool,
}

/// The texts of a compilation, by [`FileId`].
#[derive(Clone, Debug, Default)]
pub struct Files(pub Vec<SourceFile>);

impl Files {
    /// The text with this id.
    pub fn get(&self, id: FileId) -> &SourceFile {
        &self.0[id.0 as usize]
    }

    /// The characters of a span.
    pub fn slice(&self, span: Span) -> &str {
        &self.get(span.file).text[span.range()]
    }

    /// Line of the start of a span, counted from 1.
    pub fn line(&self, span: Span) -> usize {
        self.get(span.file).text.as_bytes()[..span.start as usize].iter().filter(|&&b| b == b'\n').count() + 1
    }
}
