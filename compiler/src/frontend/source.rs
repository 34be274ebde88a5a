//! Texts of a compilation and the interface through which they are read.
//!
//! In: names of modules and files. Out: texts. Opens no file itself; the caller implements [`Sources`].

use grammar::ast::{self, Item};
use grammar::outline::Head;
use grammar::parse::parse_item;
use grammar::span::{FileId, Span};
use std::sync::{Arc, OnceLock};

/// Finds imports and the files that a text names. The compiler itself opens no file.
pub trait Sources {
    /// The texts of a library module such as `std.friction`: displayed name and text of each file of its folder.
    fn library(&self, module: &str) -> Option<Vec<(String, String)>>;

    /// The names of all library modules, for suggestions in messages.
    fn modules(&self) -> Vec<String>;

    /// Whether the texts of the library are known to be without errors and in canonical layout, so that an item may be
    /// parsed when it is first needed.
    fn library_is_sound(&self) -> bool {
        false
    }

    /// Reads a file named in the text called `from`. Returns the file's name and its text.
    ///
    /// # Errors
    /// The reason why it cannot be read, as a sentence fragment: `no such file`.
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

/// The syntax tree of a text, each item parsed when it is first needed if the text is known to be without errors.
#[derive(Default, Debug)]
pub struct Tree {
    items: Vec<OnceLock<Item>>,
    /// Where the items are that have not been parsed; `None` if all have been.
    rest: Option<(FileId, Arc<str>, Vec<Head>)>,
    /// As [`ast::File::lost`].
    pub lost: Vec<String>,
}

impl From<ast::File> for Tree {
    fn from(file: ast::File) -> Tree {
        let ast::File { items, lost } = file;
        Tree { items: items.into_iter().map(OnceLock::from).collect(), rest: None, lost }
    }
}

impl Tree {
    /// The tree of a text without errors in canonical layout, whose items begin at `heads`.
    pub fn of_heads(file: FileId, text: Arc<str>, heads: Vec<Head>) -> Tree {
        let items = heads.iter().map(|_| OnceLock::new()).collect();
        Tree { items, rest: Some((file, text, heads)), lost: Vec::new() }
    }

    /// The item of this number.
    pub fn item(&self, index: u32) -> &Item {
        self.items[index as usize].get_or_init(|| {
            let (file, text, heads) = self.rest.as_ref().expect("a parsed tree has its items");
            let (item, found) = parse_item(*file, text, &heads[index as usize]);
            item.filter(|_| found.is_empty()).unwrap_or_else(|| panic!("a text that was known to be sound: {found:?}"))
        })
    }

    /// The words and names of the items, without parsing them; `None` if all have been parsed.
    pub fn heads(&self) -> Option<&[Head]> {
        self.rest.as_ref().map(|(_, _, heads)| heads.as_slice())
    }

    /// All items, in the order of the text.
    pub fn items(&self) -> impl Iterator<Item = &Item> {
        (0..self.items.len()).map(|index| self.item(index as u32))
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
    pub ast: Arc<Tree>,
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
