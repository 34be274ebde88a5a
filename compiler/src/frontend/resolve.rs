//! Name resolution at file level: reads a text with all its imports and resolves the top-level names of each file.
//!
//! In: a text and [`Sources`]. Out: always a [`Loaded`], with its diagnostics. Does not look inside items.

use crate::frontend::names::nearest;
use crate::frontend::source::{Files, SourceFile, Sources, Tree};
use crate::ir::hash::HashMap;
use grammar::ast::{self, Item, Name};
use grammar::diagnostic::Diagnostic;
use grammar::outline::heads;
use grammar::span::{FileId, Span};
use std::cell::RefCell;
use std::sync::Arc;

/// The texts of a compilation, with their top-level names resolved.
#[derive(Clone, Debug, Default)]
pub struct Loaded {
    /// The texts; the first is the root file, which the caller named.
    pub files: Files,
    /// Errors of syntax, imports and top-level names.
    pub diagnostics: Vec<Diagnostic>,
    scopes: Vec<Scope>,
}

/// Top-level names visible in one file.
#[derive(Clone, Debug, Default)]
struct Scope {
    /// By name: the items that the file declares.
    own: HashMap<String, Vec<(Space, ItemRef)>>,
    /// The files whose items are visible too, in the order of the imports.
    imported: Vec<FileId>,
}

impl Scope {
    /// The file's own item of this name.
    fn own(&self, space: Space, name: &str) -> Option<ItemRef> {
        self.own.get(name)?.iter().find(|(own, _)| *own == space).map(|(_, item)| *item)
    }
}

/// Namespaces at file level.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Space {
    /// Models, interfaces, devices.
    Type,
    /// Functions and tables.
    Function,
    /// Constants.
    Const,
    /// Experiments and fits.
    Experiment,
    /// Rigs.
    Rig,
}

/// Reference to an item of a file.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct ItemRef {
    /// The file.
    pub file: FileId,
    /// Index of the item in the file's tree.
    pub index: u32,
}

/// Result of a name lookup.
pub enum Lookup<'a> {
    /// The name refers to this item.
    Found(ItemRef, &'a Item),
    /// Defined by two imports.
    Ambiguous(ItemRef, ItemRef),
    /// Not defined.
    Missing,
}

/// An experiment of the root file.
#[derive(Clone, PartialEq, Debug)]
pub struct ExperimentInfo {
    /// Its name.
    pub name: String,
    /// Span of the name.
    pub span: Span,
    /// Whether it has an `expect`; a `show` does not count.
    pub has_expect: bool,
}

impl Loaded {
    /// The item of a reference.
    pub fn item(&self, item: ItemRef) -> &Item {
        self.files.get(item.file).ast.item(item.index)
    }

    /// Resolves `name` in `file`. The file's own items take precedence over imported ones.
    pub fn find(&self, file: FileId, space: Space, name: &str) -> Lookup<'_> {
        let scope = &self.scopes[file.0 as usize];
        if let Some(item) = scope.own(space, name) {
            return Lookup::Found(item, self.item(item));
        }
        let imported = || scope.imported.iter().filter_map(|from| self.scopes[from.0 as usize].own(space, name));
        // What a user's file declares hides what the library has, as in the file itself.
        let mut nearest = imported().filter(|item| !self.files.get(item.file).library);
        let (own, other) = (nearest.next(), nearest.next());
        let mut all = imported();
        match (own, other, all.next(), all.next()) {
            (Some(item), None, ..) | (None, _, Some(item), None) => Lookup::Found(item, self.item(item)),
            (Some(a), Some(b), ..) | (None, _, Some(a), Some(b)) => Lookup::Ambiguous(a, b),
            (None, _, None, _) => Lookup::Missing,
        }
    }

    /// All names of a namespace visible in `file`, sorted.
    pub fn visible(&self, file: FileId, space: Space) -> Vec<&str> {
        let scope = &self.scopes[file.0 as usize];
        let scopes = std::iter::once(scope).chain(scope.imported.iter().map(|from| &self.scopes[from.0 as usize]));
        let declared = scopes.flat_map(|scope| &scope.own);
        let mut names: Vec<&str> = declared
            .filter(|(_, items)| items.iter().any(|(own, _)| *own == space))
            .map(|(name, _)| name.as_str())
            .collect();
        names.sort_unstable();
        names.dedup();
        names
    }

    /// Adds a text from outside, such as a value of the command line. It has spans, but no names of its own.
    pub fn add_text(&mut self, name: &str, text: &str) -> FileId {
        let id = FileId(self.files.0.len() as u32);
        let file = SourceFile { name: name.into(), text: text.into(), ast: Arc::default(), library: false };
        self.files.0.push(file);
        self.scopes.push(Scope::default());
        id
    }

    /// The file that the caller named.
    pub fn root(&self) -> FileId {
        FileId(0)
    }

    /// Whether an error lies within this span.
    pub fn misread(&self, place: Span) -> bool {
        self.diagnostics.iter().any(|d| d.is_error() && d.span().is_within(place))
    }

    /// Experiments of the root file, in order.
    pub fn experiments(&self) -> Vec<ExperimentInfo> {
        let experiment = |item: &Item| match item {
            Item::Experiment(e) => Some(ExperimentInfo {
                name: e.name.text.clone(),
                span: e.name.span,
                has_expect: e
                    .body
                    .iter()
                    .any(|s| matches!(s, ast::ExperimentStatement::Expect(e) if e.shows.is_none())),
            }),
            _ => None,
        };
        self.files.get(self.root()).ast.items().filter_map(experiment).collect()
    }

    /// Names of the fits of the root file, in order.
    pub fn fits(&self) -> Vec<&str> {
        let items = self.files.get(self.root()).ast.items();
        items
            .filter_map(|item| match item {
                Item::Fit(fit) => Some(fit.name.text.as_str()),
                _ => None,
            })
            .collect()
    }

    /// Rigs of the root file, in order.
    pub fn rigs(&self) -> Vec<&ast::Rig> {
        let items = self.files.get(self.root()).ast.items();
        items
            .filter_map(|item| match item {
                Item::Rig(rig) => Some(rig),
                _ => None,
            })
            .collect()
    }

    /// The model called `name` in the root file, its own or an imported one, and the model's file.
    pub fn model_named(&self, name: &str) -> Option<(ast::Model, FileId)> {
        match self.find(self.root(), Space::Type, name) {
            Lookup::Found(item, Item::Model(model)) => Some((model.clone(), item.file)),
            _ => None,
        }
    }

    /// Models of the root file, in order.
    pub fn models(&self) -> Vec<&ast::Model> {
        self.files
            .get(self.root())
            .ast
            .items()
            .filter_map(|item| match item {
                Item::Model(model) => Some(model),
                _ => None,
            })
            .collect()
    }

    /// Whether there are errors, which prevent compilation.
    pub fn has_errors(&self) -> bool {
        self.diagnostics.iter().any(Diagnostic::is_error)
    }
}

impl Space {
    /// The namespace of the items that begin with a word; `None` for imports.
    fn of_word(word: &str) -> Option<Space> {
        Some(match word {
            "const" => Space::Const,
            "fn" | "table" => Space::Function,
            "interface" | "model" | "device" => Space::Type,
            "experiment" | "fit" => Space::Experiment,
            "rig" => Space::Rig,
            _ => return None,
        })
    }
}

/// The namespace and name of an item; `None` for imports.
fn named(item: &Item) -> Option<(Space, &Name)> {
    Some(match item {
        Item::Import(_) => return None,
        Item::Const(c) => (Space::Const, &c.name),
        Item::Function(f) => (Space::Function, &f.name),
        Item::Table(t) => (Space::Function, &t.name),
        Item::Interface(i) => (Space::Type, &i.name),
        Item::Model(m) => (Space::Type, &m.name),
        Item::Variant(v) => (Space::Type, &v.name),
        Item::Device(d) => (Space::Type, &d.name),
        Item::Experiment(e) => (Space::Experiment, &e.name),
        Item::Fit(f) => (Space::Experiment, &f.name),
        Item::Rig(r) => (Space::Rig, &r.name),
    })
}

/// Names that cannot be declared.
pub const RESERVED: [&str; 5] = ["t", "pi", "inf", "true", "false"];

/// Reads `text`, called `name`, and everything it imports.
pub fn load(name: &str, text: &str, sources: &dyn Sources) -> Loaded {
    let mut loader = Loader { loaded: Loaded::default(), sources, by_name: HashMap::default(), open: Vec::new() };
    let root = loader.add(name.to_string(), text, false);
    let mut loaded = loader.loaded;
    if loaded.files.get(root).ast.items().next().is_none() && loaded.diagnostics.is_empty() {
        let error = Diagnostic::error("E0001", "there is nothing in this file").label(Span::new(root, 0, 0), "empty");
        loaded.diagnostics.push(error.help("begin with a model: `model M { … }`, or let `fric new DIR` write one"));
    }
    loaded
}

struct Loader<'a> {
    loaded: Loaded,
    sources: &'a dyn Sources,
    by_name: HashMap<String, FileId>,
    /// Files whose imports are being read, to detect import cycles.
    open: Vec<FileId>,
}

impl Loader<'_> {
    fn add(&mut self, name: String, text: &str, library: bool) -> FileId {
        let id = FileId(self.loaded.files.0.len() as u32);
        self.by_name.insert(name.clone(), id);
        let (text, ast) = match library {
            true => library_tree(id, &name, text, self.sources.library_is_sound(), &mut self.loaded.diagnostics),
            false => tree(id, text, &mut self.loaded.diagnostics),
        };
        self.loaded.files.0.push(SourceFile { name, text: text.clone(), ast: ast.clone(), library });
        self.loaded.scopes.push(Scope::default());
        self.open.push(id);
        match ast.heads() {
            // The names of a text that is known to be sound are those of its heads, and none is declared twice.
            Some(heads) => {
                for (index, head) in heads.iter().enumerate() {
                    match Space::of_word(head.word) {
                        Some(space) => self.own(id, space, &text[head.name.clone()], index),
                        None => self.item(id, ast.item(index as u32)),
                    }
                }
            }
            None => {
                self.declare(id, &ast);
                ast.items().for_each(|item| self.item(id, item));
            }
        }
        self.open.pop();
        id
    }

    /// Brings the names of an import into a file; other items have none to bring.
    fn item(&mut self, into: FileId, item: &Item) {
        if let Item::Import(import) = item {
            for file in self.import(into, import) {
                self.bring_in(into, file);
            }
        }
    }

    fn declare(&mut self, file: FileId, ast: &Tree) {
        for (index, item) in ast.items().enumerate() {
            let Some((space, name)) = named(item) else { continue };
            if RESERVED.contains(&name.text.as_str()) && matches!(space, Space::Const | Space::Function) {
                self.loaded.diagnostics.push(reserved(name));
                continue;
            }
            match self.loaded.scopes[file.0 as usize].own(space, &name.text) {
                None => self.own(file, space, &name.text, index),
                Some(first) => {
                    let first = named(self.loaded.item(first)).expect("only named items are declared").1.span;
                    self.loaded.diagnostics.push(declared_twice(name, first));
                }
            }
        }
    }

    /// Declares an item of a file.
    fn own(&mut self, file: FileId, space: Space, name: &str, index: usize) {
        let item = ItemRef { file, index: index as u32 };
        self.loaded.scopes[file.0 as usize].own.entry(name.into()).or_default().push((space, item));
    }

    /// The files that an import refers to.
    fn import(&mut self, from: FileId, import: &ast::Import) -> Vec<FileId> {
        match &import.source {
            ast::ImportSource::Library(module) => {
                let Some(files) = self.sources.library(&module.text) else {
                    let modules = self.sources.modules();
                    let mut error = Diagnostic::error("E0201", format!("there is no library module `{}`", module.text))
                        .label(module.span, "not found");
                    error = match nearest(&module.text, modules.iter().map(String::as_str)) {
                        Some(near) => error.help(format!("did you mean `{near}`?")),
                        None if modules.is_empty() => error,
                        None => error.help(format!("the library has {}", modules.join(", "))),
                    };
                    self.loaded.diagnostics.push(error);
                    return Vec::new();
                };
                files.into_iter().map(|(name, text)| self.once(name, &text, true)).collect()
            }
            ast::ImportSource::File(path) => {
                let from_name = self.loaded.files.get(from).name.clone();
                match self.sources.file(&from_name, &path.text) {
                    Ok((name, text)) => {
                        if let Some(id) = self.by_name.get(&name).copied().filter(|id| self.open.contains(id)) {
                            let circle: Vec<&str> = self
                                .open
                                .iter()
                                .skip_while(|open| **open != id)
                                .map(|open| self.loaded.files.get(*open).name.as_str())
                                .collect();
                            let message = match circle.as_slice() {
                                [_] => "this file imports itself".to_string(),
                                circle => format!("imports in a circle: {} -> {name}", circle.join(" -> ")),
                            };
                            let error = Diagnostic::error("E0211", message).label(path.span, "closes the circle");
                            self.loaded.diagnostics.push(error.help("move what both need into a file of its own"));
                            return Vec::new();
                        }
                        vec![self.once(name, &text, false)]
                    }
                    Err(reason) => {
                        let module = path.text.trim_end_matches(".fric");
                        let library = self.sources.library(module).is_some_and(|files| !files.is_empty());
                        let error = Diagnostic::error("E0201", format!("cannot import \"{}\"", path.text))
                            .label(path.span, reason)
                            .help(match library {
                                true => format!("a module of the library stands without quotes: `import {module}`"),
                                false => "the path is relative to the importing file".into(),
                            });
                        self.loaded.diagnostics.push(error);
                        Vec::new()
                    }
                }
            }
        }
    }

    fn once(&mut self, name: String, text: &str, library: bool) -> FileId {
        match self.by_name.get(&name) {
            Some(&id) => id,
            None => self.add(name, text, library),
        }
    }

    fn bring_in(&mut self, into: FileId, from: FileId) {
        let imported = &mut self.loaded.scopes[into.0 as usize].imported;
        if into != from && !imported.contains(&from) {
            imported.push(from);
        }
    }
}

/// Capacity of the cache of library trees.
const MOST_KEPT: usize = 1000;

type Kept = (Arc<str>, Arc<Tree>);

thread_local! {
    /// Key: the file id, which the spans of the tree contain, and the name.
    static KEPT: RefCell<HashMap<(FileId, String), Kept>> = RefCell::default();
}

fn tree(id: FileId, text: &str, diagnostics: &mut Vec<Diagnostic>) -> Kept {
    let parsed = grammar::parse::parse(id, text);
    diagnostics.extend(parsed.diagnostics);
    (text.into(), Arc::new(parsed.file.into()))
}

/// As [`tree`], with a cache for library texts, which many texts import. An entry is valid while the text is the same.
/// The items of a text that is known to be sound are parsed when they are first needed.
fn library_tree(id: FileId, name: &str, text: &str, is_sound: bool, diagnostics: &mut Vec<Diagnostic>) -> Kept {
    let key = (id, name.to_string());
    let known = KEPT.with_borrow(|kept| kept.get(&key).filter(|(known, _)| **known == *text).cloned());
    if let Some(known) = known {
        return known;
    }
    let before = diagnostics.len();
    let new = match is_sound {
        true => {
            let text: Arc<str> = text.into();
            (text.clone(), Arc::new(Tree::of_heads(id, text.clone(), heads(&text))))
        }
        false => tree(id, text, diagnostics),
    };
    if diagnostics.len() == before {
        KEPT.with_borrow_mut(|kept| {
            if kept.len() >= MOST_KEPT {
                kept.clear();
            }
            kept.insert(key, new.clone());
        });
    }
    new
}

/// E0210: a declaration of a reserved name.
pub fn reserved(name: &Name) -> Diagnostic {
    Diagnostic::error("E0210", format!("`{}` has a fixed meaning and cannot be declared", name.text))
        .label(name.span, "declared here")
        .help(match name.text.as_str() {
            "t" => "`t` is time; give this another name, such as `t1`".to_string(),
            other => format!("give this another name, such as `{other}_0`"),
        })
}

/// E0202: two declarations of one name in one scope.
pub fn declared_twice(name: &Name, first: Span) -> Diagnostic {
    Diagnostic::error("E0202", format!("`{}` is declared twice", name.text))
        .label(name.span, "again here")
        .label(first, "first here")
        .help("remove one of them or give it another name")
}
