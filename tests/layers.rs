//! The structure that docs/architecture.md promises: crates know only the crates below them, a module uses only modules
//! that are declared above it, at every level of folders, and each outside crate has one home.
//!
//! Sources are parsed (syn), so `crate::`, `super::` and `self::` paths count alike, in code and in macros. Only items
//! under `#[cfg(test)]` are left out. The same sources say what only Linux or Unix has under a `cfg` alone, so that the
//! rest builds on other systems.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use syn::visit::Visit;

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// Our crates with their sources, and those of our crates that each may use.
const CRATES: [(&str, &str, &[&str]); 8] = [
    ("grammar", "grammar/src/lib.rs", &[]),
    ("abi", "abi/src/lib.rs", &[]),
    ("compiler", "compiler/src/lib.rs", &["grammar", "abi"]),
    ("runtime", "runtime/src/lib.rs", &["abi"]),
    ("panel", "panel/src/lib.rs", &["abi", "runtime"]),
    ("fric-rig", "rig/src/main.rs", &["abi", "runtime", "panel"]),
    ("fric", "src/lib.rs", &["grammar", "abi", "compiler", "runtime", "panel"]),
    ("fric-python", "python/src/lib.rs", &["abi", "compiler", "runtime", "fric"]),
];

/// Where an outside crate may be named: files or folders. A crate used throughout one of ours has the source folder of
/// that crate as its home.
const HOMES: &[(&str, &[&str])] = &[
    ("bytes", &["src/parquet.rs"]),
    ("can-dbc", &["compiler/src/rig/dbc.rs"]),
    // An option's values are the cases of an enum: one of them lies where they are carried out.
    ("clap", &["src/args.rs", "src/compile.rs", "rig/src/main.rs"]),
    ("clap_complete", &["src/args.rs"]),
    ("clap_mangen", &["src/args.rs"]),
    ("cranelift-codegen", &["compiler/src/codegen/"]),
    ("cranelift-frontend", &["compiler/src/codegen/"]),
    ("cranelift-jit", &["compiler/src/codegen/executable_memory.rs"]),
    ("cranelift-module", &["compiler/src/codegen/"]),
    ("cranelift-native", &["compiler/src/codegen/target.rs"]),
    ("crc32fast", &["runtime/src/record/blocks.rs"]),
    ("csv", &["src/", "runtime/src/record/csv.rs"]),
    ("ct-codecs", &["src/signing.rs"]),
    ("ctrlc", &["src/interrupt.rs"]),
    ("getrandom", &["panel/src/key.rs"]),
    ("httparse", &["panel/src/http.rs"]),
    ("indicatif", &["src/commands/shared/progress.rs"]),
    // The kernel's calls: descriptors and sockets, clocks and threads, signals.
    ("libc", &["runtime/src/can/", "runtime/src/realtime/", "runtime/src/hil/emergency.rs"]),
    ("memmap2", &["runtime/src/image.rs"]),
    ("miette", &["src/report.rs"]),
    ("minisign", &["src/signing.rs"]),
    ("minisign-verify", &["runtime/src/package/signature.rs"]),
    ("miniz_oxide", &["src/matrices.rs", "runtime/src/record/packed.rs"]),
    ("nalgebra", &["runtime/src/coupling/"]),
    ("numpy", &["python/src/"]),
    ("parquet", &["src/parquet.rs"]),
    ("pdf-writer", &["src/plot/pdf.rs"]),
    ("pest", &["grammar/src/parse.rs"]),
    ("pest_derive", &["grammar/src/parse.rs"]),
    ("pyo3", &["python/src/"]),
    ("rayon", &["runtime/src/engine/sweep.rs"]),
    ("resvg", &["src/plot/png.rs", "src/plot/pdf.rs"]),
    ("rtrb", &["runtime/src/spsc.rs"]),
    ("rustix", &["runtime/src/record/parts.rs"]),
    ("rustyline", &["src/repl/line.rs"]),
    ("rustc-hash", &["compiler/src/ir/hash.rs"]),
    // JSON is a form of every command's results, and what the page of a panel reads.
    ("same-file", &["runtime/src/record/claim.rs"]),
    ("serde_json", &["src/", "panel/src/"]),
    ("sha2", &["abi/src/image.rs"]),
    ("socketcan", &["runtime/src/can/socketcan.rs"]),
    ("stacker", &["grammar/src/parse.rs"]),
    ("strsim", &["compiler/src/frontend/names.rs"]),
    ("subsetter", &["src/plot/pdf.rs"]),
    ("tempfile", &["src/commands/deploy.rs", "src/commands/panel.rs", "src/commands/remote_rig.rs"]),
    ("terminal_size", &["src/terminal.rs"]),
    // Pinned for miette, which sets its texts with it.
    ("textwrap", &["src/report.rs"]),
    // A socket begins as a request.
    ("tungstenite", &["panel/src/http.rs", "panel/src/viewer.rs"]),
    ("zmij", &["abi/src/format.rs"]),
];

type Module = Vec<String>;

/// Declarations and paths of a crate's modules.
#[derive(Default)]
struct Source {
    /// For each module its submodules, in the order of their declarations; without test modules.
    children: BTreeMap<Module, Vec<String>>,
    /// For each module the paths that it uses, without those in tests: resolved inside the crate.
    inside: BTreeMap<Module, BTreeSet<Module>>,
    /// For each file the outside crates that it may use: the first segments of its other paths.
    outside: BTreeMap<PathBuf, BTreeSet<String>>,
    /// For each file the names that it imports from its own crate, which may be re-exports of outside crates.
    imported: BTreeMap<PathBuf, BTreeSet<String>>,
}

fn is_test(attributes: &[syn::Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        let syn::Meta::List(list) = &attribute.meta else { return false };
        list.path.is_ident("cfg") && list.tokens.to_string() == "test"
    })
}

/// Collects the paths of one file.
struct Reader<'s> {
    source: &'s mut Source,
    module: Module,
    file: PathBuf,
}

impl Reader<'_> {
    fn path(&mut self, words: &[String]) {
        let Some(first) = words.first() else { return };
        let (mut base, mut rest) = (self.module.clone(), words);
        match first.as_str() {
            "crate" => (base, rest) = (Vec::new(), &words[1..]),
            "self" => rest = &words[1..],
            "super" => {
                while rest.first().is_some_and(|word| word == "super") {
                    base.pop();
                    rest = &rest[1..];
                }
            }
            name if self.source.children[&self.module].iter().any(|child| child == name) => {}
            name => {
                self.source.outside.entry(self.file.clone()).or_default().insert(name.to_string());
                return;
            }
        }
        base.extend(rest.iter().cloned());
        self.source.inside.entry(self.module.clone()).or_default().insert(base);
    }

    fn tree(&mut self, tree: &syn::UseTree, before: &[String]) {
        let with = |name: &syn::Ident| before.iter().cloned().chain([name.to_string()]).collect::<Vec<_>>();
        match tree {
            syn::UseTree::Path(path) => self.tree(&path.tree, &with(&path.ident)),
            syn::UseTree::Name(name) => {
                let itself = name.ident == "self";
                let (before, name) = match before.split_last() {
                    Some((name, before)) if itself => (before, name.clone()),
                    _ => (before, name.ident.to_string()),
                };
                if before.first().is_some_and(|first| ["crate", "self", "super"].contains(&first.as_str())) {
                    self.source.imported.entry(self.file.clone()).or_default().insert(name.clone());
                }
                self.path(&before.iter().cloned().chain([name]).collect::<Vec<_>>());
            }
            syn::UseTree::Rename(name) => self.path(&with(&name.ident)),
            syn::UseTree::Glob(_) => self.path(before),
            syn::UseTree::Group(group) => group.items.iter().for_each(|item| self.tree(item, before)),
        }
    }
}

impl<'a> Visit<'a> for Reader<'_> {
    fn visit_item(&mut self, item: &'a syn::Item) {
        let attributes: &[syn::Attribute] = match item {
            syn::Item::Fn(item) => &item.attrs,
            syn::Item::Mod(item) => &item.attrs,
            syn::Item::Use(item) => &item.attrs,
            syn::Item::Const(item) => &item.attrs,
            syn::Item::Static(item) => &item.attrs,
            syn::Item::Struct(item) => &item.attrs,
            syn::Item::Enum(item) => &item.attrs,
            syn::Item::Impl(item) => &item.attrs,
            syn::Item::Macro(item) => &item.attrs,
            _ => &[],
        };
        if !is_test(attributes) {
            syn::visit::visit_item(self, item);
        }
    }

    fn visit_item_use(&mut self, item: &'a syn::ItemUse) {
        self.tree(&item.tree, &[]);
    }

    fn visit_path(&mut self, path: &'a syn::Path) {
        let words: Vec<String> = path.segments.iter().map(|segment| segment.ident.to_string()).collect();
        if words.len() > 1 {
            self.path(&words);
        }
        syn::visit::visit_path(self, path);
    }

    fn visit_macro(&mut self, of: &'a syn::Macro) {
        syn::visit::visit_macro(self, of);
        let text = of.tokens.to_string().replace(" :: ", "::");
        for word in text.split(|c: char| !(c.is_alphanumeric() || c == '_' || c == ':')) {
            let words: Vec<String> = word.split("::").map(str::to_string).collect();
            if words.len() > 1 && words.iter().all(|word| !word.is_empty() && !word.contains(':')) {
                self.path(&words);
            }
        }
    }
}

/// Parses a file and, recursively, the files of its modules.
fn read(source: &mut Source, file: &Path, module: Module) {
    let text = fs::read_to_string(file).unwrap_or_else(|why| panic!("{}: {why}", file.display()));
    let parsed = syn::parse_file(&text).unwrap_or_else(|why| panic!("{}: {why}", file.display()));
    let is_folder = matches!(file.file_name().and_then(|name| name.to_str()), Some("lib.rs" | "main.rs" | "mod.rs"));
    let folder = if is_folder { file.parent().expect("a folder").to_path_buf() } else { file.with_extension("") };
    let declared: Vec<String> = parsed
        .items
        .iter()
        .filter_map(|item| match item {
            syn::Item::Mod(item) if item.content.is_none() && !is_test(&item.attrs) => Some(item.ident.to_string()),
            _ => None,
        })
        .collect();
    source.children.insert(module.clone(), declared.clone());
    let mut reader = Reader { source, module: module.clone(), file: file.to_path_buf() };
    reader.visit_file(&parsed);
    for child in declared {
        let candidates = [folder.join(format!("{child}.rs")), folder.join(&child).join("mod.rs")];
        let found = candidates.iter().find(|path| path.is_file());
        let path = found.unwrap_or_else(|| panic!("no file of module {child} beside {}", file.display()));
        read(source, path, module.iter().cloned().chain([child]).collect());
    }
}

fn source(entry: &str) -> Source {
    let mut source = Source::default();
    read(&mut source, &root().join(entry), Vec::new());
    source
}

/// Each use of a module that is declared later than its user, compared at their deepest common folder.
fn upward(source: &Source) -> Vec<String> {
    let mut found = Vec::new();
    for (user, paths) in &source.inside {
        for path in paths {
            let shared = user.iter().zip(path).take_while(|(a, b)| a == b).count();
            let (Some(own), Some(other)) = (user.get(shared), path.get(shared)) else { continue };
            let siblings = &source.children[&user[..shared]];
            let place = |name: &String| siblings.iter().position(|sibling| sibling == name);
            if let (Some(own_place), Some(other_place)) = (place(own), place(other))
                && other_place > own_place
            {
                found.push(format!(
                    "{} uses {}, whose `{other}` is declared below `{own}`",
                    user.join("::"),
                    path.join("::")
                ));
            }
        }
    }
    found
}

#[test]
fn modules_use_only_modules_above_them() {
    let mut found = Vec::new();
    for (name, entry, _) in CRATES {
        let source = source(entry);
        assert!(source.children[&Vec::new()].len() > 3, "{name} declares its modules");
        found.extend(upward(&source).into_iter().map(|what| format!("{name}: {what}")));
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn a_use_of_a_module_below_is_found() {
    let source = source("compiler/src/lib.rs");
    for (user, used) in
        [("opt::contract", "codegen::jit"), ("codegen::sink", "codegen::jit"), ("ir", "frontend::units")]
    {
        let words = |path: &str| path.split("::").map(str::to_string).collect::<Module>();
        let mut broken = Source { children: source.children.clone(), ..Source::default() };
        broken.inside.insert(words(user), BTreeSet::from([words(used)]));
        assert_eq!(upward(&broken).len(), 1, "{user} uses {used}");
    }
}

/// The names in a table of dependencies.
fn dependencies(manifest: &str, tables: &[&str]) -> Vec<String> {
    let text = fs::read_to_string(root().join(manifest)).unwrap_or_else(|why| panic!("{manifest}: {why}"));
    let mut table = "";
    let mut found = Vec::new();
    for line in text.lines() {
        if let Some(name) = line.strip_prefix('[') {
            table = name.trim_end_matches(']');
        } else if tables.contains(&table)
            && !line.starts_with('#')
            && let Some((name, _)) = line.split_once(['=', '.'])
        {
            found.push(name.trim().to_string());
        }
    }
    found
}

fn manifest(entry: &str) -> String {
    entry.replace("src/lib.rs", "Cargo.toml").replace("src/main.rs", "Cargo.toml")
}

#[test]
fn crates_know_only_the_crates_below_them() {
    let ours: Vec<&str> = CRATES.iter().map(|(name, ..)| *name).collect();
    for (name, entry, below) in CRATES {
        let named = dependencies(&manifest(entry), &["dependencies", "dev-dependencies"]);
        for other in named.iter().filter(|other| ours.contains(&other.as_str())) {
            assert!(below.contains(&other.as_str()), "{name} depends on {other}");
        }
    }
}

#[test]
fn outside_crates_have_one_home() {
    let ours: Vec<&str> = CRATES.iter().map(|(name, ..)| *name).collect();
    let homes: BTreeMap<&str, &[&str]> = HOMES.iter().copied().collect();
    let mut used: BTreeSet<&str> = BTreeSet::new();
    for (name, entry, _) in CRATES {
        let named = dependencies(
            &manifest(entry),
            &["dependencies", "target.'cfg(target_os = \"linux\")'.dependencies", "target.'cfg(unix)'.dependencies"],
        );
        let source = source(entry);
        for outside in named.iter().filter(|outside| !ours.contains(&outside.as_str())) {
            let (known, homes) = homes.get_key_value(outside.as_str()).unwrap_or_else(|| {
                panic!("{name} depends on {outside}, which has no home in the list of tests/layers.rs")
            });
            used.insert(known);
            for (file, words) in &source.outside {
                let word = outside.replace('-', "_");
                let is_ours = source.imported.get(file).is_some_and(|imported| imported.contains(&word));
                let file = file.strip_prefix(root()).expect("a source of this project").display().to_string();
                let is_home = homes.iter().any(|home| file.starts_with(home));
                assert!(
                    !words.contains(&word) || is_ours || is_home,
                    "{file} names {outside}, whose home is {homes:?}"
                );
            }
        }
    }
    let idle: Vec<&&str> = homes.keys().filter(|home| !used.contains(**home)).collect();
    assert!(idle.is_empty(), "no crate depends on {idle:?}");
}

/// What not every system has.
const OF_LINUX: &[&str] = &["libc", "socketcan", "rustix", "std::os::unix", "std::os::fd", "std::os::linux"];

/// Whether a `cfg` restricts what it is on to systems that have it.
fn is_restricted(attributes: &[syn::Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        let syn::Meta::List(list) = &attribute.meta else { return false };
        let condition = list.tokens.to_string();
        let restricting = ["unix", "test", "all (feature = \"hardware\" , target_os = \"linux\")"];
        list.path.is_ident("cfg") && restricting.contains(&condition.as_str())
    })
}

/// Collects the paths of [`OF_LINUX`] that a file names without such a `cfg`.
#[derive(Default)]
struct Unrestricted(Vec<String>);

impl Unrestricted {
    fn path(&mut self, path: &str) {
        let inside = |name: &&str| path == *name || path.strip_prefix(*name).is_some_and(|rest| rest.starts_with("::"));
        if OF_LINUX.iter().any(inside) {
            self.0.push(path.to_string());
        }
    }

    fn tree(&mut self, tree: &syn::UseTree, before: &str) {
        let with = |name: &syn::Ident| if before.is_empty() { name.to_string() } else { format!("{before}::{name}") };
        match tree {
            syn::UseTree::Path(path) => self.tree(&path.tree, &with(&path.ident)),
            syn::UseTree::Name(name) => self.path(&with(&name.ident)),
            syn::UseTree::Rename(name) => self.path(&with(&name.ident)),
            syn::UseTree::Glob(_) => self.path(before),
            syn::UseTree::Group(group) => group.items.iter().for_each(|item| self.tree(item, before)),
        }
    }
}

/// Visits what carries no restricting attribute.
macro_rules! where_unrestricted {
    ($($visit:ident: $node:ident),*) => {
        $(fn $visit(&mut self, node: &'a syn::$node) {
            if !is_restricted(&node.attrs) {
                syn::visit::$visit(self, node);
            }
        })*
    };
}

impl<'a> Visit<'a> for Unrestricted {
    where_unrestricted! {
        visit_item_fn: ItemFn, visit_item_mod: ItemMod, visit_item_const: ItemConst, visit_item_type: ItemType,
        visit_item_struct: ItemStruct, visit_item_enum: ItemEnum, visit_item_impl: ItemImpl,
        visit_impl_item_fn: ImplItemFn, visit_local: Local, visit_arm: Arm, visit_expr_call: ExprCall,
        visit_expr_method_call: ExprMethodCall, visit_expr_return: ExprReturn, visit_expr_block: ExprBlock,
        visit_field: Field
    }

    fn visit_item_use(&mut self, item: &'a syn::ItemUse) {
        if !is_restricted(&item.attrs) {
            self.tree(&item.tree, "");
        }
    }

    fn visit_path(&mut self, path: &'a syn::Path) {
        let words: Vec<String> = path.segments.iter().map(|segment| segment.ident.to_string()).collect();
        self.path(&words.join("::"));
        syn::visit::visit_path(self, path);
    }
}

/// The files of a crate's modules, without those under a restricting `cfg`.
fn unrestricted_files(file: &Path, found: &mut Vec<PathBuf>) {
    let text = fs::read_to_string(file).unwrap_or_else(|why| panic!("{}: {why}", file.display()));
    let parsed = syn::parse_file(&text).unwrap_or_else(|why| panic!("{}: {why}", file.display()));
    let is_folder = matches!(file.file_name().and_then(|name| name.to_str()), Some("lib.rs" | "main.rs" | "mod.rs"));
    let folder = if is_folder { file.parent().expect("a folder").to_path_buf() } else { file.with_extension("") };
    found.push(file.to_path_buf());
    for item in &parsed.items {
        let syn::Item::Mod(module) = item else { continue };
        if module.content.is_some() || is_restricted(&module.attrs) {
            continue;
        }
        let candidates =
            [folder.join(format!("{}.rs", module.ident)), folder.join(module.ident.to_string()).join("mod.rs")];
        let path = candidates.iter().find(|path| path.is_file()).expect("each module has a file");
        unrestricted_files(path, found);
    }
}

/// `fric-rig` runs on the computer of a rig, which has Linux; all else builds without it.
#[test]
fn only_the_feature_hardware_needs_linux() {
    let unrestricted = |text: &str| {
        let mut found = Unrestricted::default();
        found.visit_file(&syn::parse_file(text).expect("a file"));
        found.0
    };
    // The mistakes that it is for are found, and what a `cfg` restricts is not.
    assert_eq!(unrestricted("use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};").len(), 2);
    assert_eq!(unrestricted("fn f() -> libc::c_int { match 0 { 0 => rustix::fs::x(), _ => 1 } }").len(), 2);
    assert_eq!(unrestricted("fn f() { #[cfg(unix)] std::os::unix::x(1); #[cfg(windows)] libc::y(); }"), ["libc::y"]);
    assert!(unrestricted("#[cfg(unix)] fn f() { libc::y() } mod libc_of_ours {}").is_empty());
    let mut files = Vec::new();
    for (_, entry, _) in CRATES.iter().filter(|(name, ..)| *name != "fric-rig") {
        unrestricted_files(&root().join(entry), &mut files);
    }
    assert!(files.len() > 200, "{} files", files.len());
    let mut wrong = Vec::new();
    for file in files {
        let text = fs::read_to_string(&file).expect("it was just read");
        let named = unrestricted(&text);
        wrong.extend(named.iter().map(|path| format!("{}: {path}", file.display())));
    }
    assert!(wrong.is_empty(), "without `cfg(unix)` or the feature `hardware`:\n{}", wrong.join("\n"));
}
