//! Rules of this repository that no other test checks: how changes, commits, tests and names look.
//!
//! In: the sources, the changelog, the history. Out: one line for each rule, and a last line that counts them, with
//! those that could not be checked here. It has its own `main`, because a test that passes says nothing.
//!
//! Mutants tried by hand, each fails: an `#[ignore]`, a fourth type of one name, a fifth loose file in the compiler's
//! root, a heading without kind, the host of a registry in a page, a branch on the wording of a message, a test that
//! returns early, words after `# Errors` on its line.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use syn::visit::Visit;

/// The result of a rule.
enum Outcome {
    /// What was counted.
    Holds(String),
    /// Each place that breaks it.
    Broken(Vec<String>),
    /// Why it could not be checked.
    Unchecked(String),
}

impl Outcome {
    fn of(broken: Vec<String>, counted: String) -> Outcome {
        if broken.is_empty() { Outcome::Holds(counted) } else { Outcome::Broken(broken) }
    }
}

/// What a rule says, and its check.
type Rule = (&'static str, fn() -> Outcome);

const RULES: [Rule; 9] = [
    ("the changelog has its headings by kind", changelog),
    ("commits are named by what they do", commits),
    ("no test is ignored", ignored),
    ("no test returns early", early_returns),
    ("no production code branches on the wording of a message", wording),
    ("a type's name is used at most three times in a crate", type_names),
    ("the root of the compiler has at most four loose files", compiler_root),
    ("no host of a package registry is named", registries),
    ("a heading of a docstring stands on a line of its own", headings),
];

fn main() -> ExitCode {
    // Test runners ask for the list of tests first.
    if std::env::args().any(|argument| argument == "--list") {
        return ExitCode::SUCCESS;
    }
    let (mut held, mut broken, mut unchecked) = (0, 0, 0);
    for (rule, check) in RULES {
        match check() {
            Outcome::Holds(counted) => {
                held += 1;
                println!("holds: {rule} ({counted})");
            }
            Outcome::Broken(places) => {
                broken += 1;
                println!("BROKEN: {rule}");
                places.iter().for_each(|place| println!("  {place}"));
            }
            Outcome::Unchecked(why) => {
                unchecked += 1;
                println!("NOT CHECKED: {rule}: {why}");
            }
        }
    }
    println!("house rules: {held} hold, {broken} broken, {unchecked} not checked");
    if broken == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// All files below folders of the project whose names end so; products of builds and downloads are left out.
fn files(folders: &[&str], ending: &str) -> Vec<PathBuf> {
    let mut open: Vec<PathBuf> = folders.iter().map(|folder| root().join(folder)).collect();
    let mut found = Vec::new();
    while let Some(path) = open.pop() {
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        if path.is_dir() {
            if !["target", "cache", ".git"].contains(&name.as_str()) {
                open.extend(fs::read_dir(&path).expect("a folder").map(|entry| entry.expect("an entry").path()));
            }
        } else if name.ends_with(ending) {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// Folders of sources, with the name of their crate.
const SOURCES: [(&str, &str); 7] = [
    ("grammar", "grammar/src"),
    ("abi", "abi/src"),
    ("compiler", "compiler/src"),
    ("runtime", "runtime/src"),
    ("panel", "panel/src"),
    ("fric-rig", "rig/src"),
    ("fric", "src"),
];

fn shown(path: &Path) -> String {
    path.strip_prefix(root()).unwrap_or(path).display().to_string()
}

fn parsed(path: &Path) -> syn::File {
    let text = fs::read_to_string(path).unwrap_or_else(|why| panic!("{}: {why}", path.display()));
    syn::parse_file(&text).unwrap_or_else(|why| panic!("{}: {why}", path.display()))
}

/// Kinds of changes, and what a user must do.
const KINDS: [&str; 12] = [
    "What you must do",
    "Numbers",
    "Runs and numbers",
    "Language",
    "Library",
    "Rig",
    "Figures and recordings",
    "Export of code",
    "Commands and prompt",
    "Speed",
    "Fixes",
    "Documentation",
];

fn changelog() -> Outcome {
    let text = fs::read_to_string(root().join("CHANGELOG.md")).expect("there is a changelog");
    let mut broken = Vec::new();
    let (mut versions, mut entries) = (0, 0);
    let mut kind = None;
    for (at, line) in text.lines().enumerate() {
        let place = |what: &str| format!("CHANGELOG.md:{}: {what}", at + 1);
        if let Some(version) = line.strip_prefix("## ") {
            versions += 1;
            kind = None;
            if versions == 1 && version != "Unreleased" {
                broken.push(place("the first version is `Unreleased`"));
            }
        } else if let Some(heading) = line.strip_prefix("### ") {
            kind = Some(heading);
            if !KINDS.contains(&heading) {
                broken.push(place(&format!("`{heading}` is no kind of change: {}", KINDS.join(", "))));
            }
        } else if line.starts_with("- ") {
            entries += 1;
            if versions == 1 && kind.is_none() {
                broken.push(place("an entry without a kind"));
            }
        }
    }
    Outcome::of(broken, format!("{versions} versions, {entries} entries"))
}

/// Commits up to this one were made before the rule.
const BEFORE: &str = "36a34d3";

fn commits() -> Outcome {
    let git = |arguments: &[&str]| {
        let output = Command::new("git").args(arguments).current_dir(root()).output().ok()?;
        output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned())
    };
    let Some(log) = git(&["log", "--format=%h %s", &format!("{BEFORE}..HEAD")]) else {
        return Outcome::Unchecked("there is no history here".into());
    };
    let mut broken = Vec::new();
    for line in log.lines() {
        let Some((hash, subject)) = line.split_once(' ') else { continue };
        if subject.to_lowercase().split(|c: char| !c.is_alphanumeric()).any(|word| word == "wip") {
            broken.push(format!("{hash}: `wip`: {subject}"));
        }
        if subject.chars().count() > 72 {
            broken.push(format!("{hash}: longer than 72 characters: {subject}"));
        }
    }
    Outcome::of(broken, format!("{} commits", log.lines().count()))
}

/// Every folder with Rust code.
const ALL: [&str; 12] = [
    "grammar", "abi", "compiler", "runtime", "panel", "rig", "src", "tests", "benches", "fuzz", "examples", "build.rs",
];

/// Functions with an attribute, by file.
struct Tests<'f> {
    visit: &'f mut dyn FnMut(&syn::ItemFn),
}

impl<'a> Visit<'a> for Tests<'_> {
    fn visit_item_fn(&mut self, item: &'a syn::ItemFn) {
        if item.attrs.iter().any(|attribute| attribute.path().is_ident("test")) {
            (self.visit)(item);
        }
        syn::visit::visit_item_fn(self, item);
    }
}

fn each_test(mut visit: impl FnMut(&Path, &syn::ItemFn)) {
    for path in files(&ALL, ".rs") {
        Tests { visit: &mut |item| visit(&path, item) }.visit_file(&parsed(&path));
    }
}

/// `cfg_attr(…, ignore = "…")` is another thing: where a test cannot run, cargo counts it in its last line.
fn ignored() -> Outcome {
    let (mut broken, mut all) = (Vec::new(), 0);
    each_test(|path, item| {
        all += 1;
        if item.attrs.iter().any(|attribute| attribute.path().is_ident("ignore")) {
            broken.push(format!("{}: {} is ignored: a measurement belongs to benches/", shown(path), item.sig.ident));
        }
    });
    Outcome::of(broken, format!("{all} tests"))
}

/// Finds `return` without a value, outside closures and inner functions.
#[derive(Default)]
struct Returns {
    /// Number of endless loops around the place: there it may end a search.
    depth: usize,
    found: bool,
}

impl<'a> Visit<'a> for Returns {
    fn visit_expr_return(&mut self, expr: &'a syn::ExprReturn) {
        self.found |= expr.expr.is_none() && self.depth == 0;
    }
    fn visit_expr_closure(&mut self, _: &'a syn::ExprClosure) {}
    fn visit_item_fn(&mut self, _: &'a syn::ItemFn) {}
    fn visit_expr_loop(&mut self, expr: &'a syn::ExprLoop) {
        self.depth += 1;
        syn::visit::visit_expr_loop(self, expr);
        self.depth -= 1;
    }
}

fn early_returns() -> Outcome {
    let (mut broken, mut all) = (Vec::new(), 0);
    each_test(|path, item| {
        all += 1;
        let mut returns = Returns::default();
        returns.visit_block(&item.block);
        if returns.found {
            broken.push(format!("{}: {} may return before it has tested anything", shown(path), item.sig.ident));
        }
    });
    Outcome::of(broken, format!("{all} tests"))
}

fn is_test(attributes: &[syn::Attribute]) -> bool {
    attributes.iter().any(|attribute| match &attribute.meta {
        syn::Meta::List(list) => list.path.is_ident("cfg") && list.tokens.to_string() == "test",
        meta => meta.path().is_ident("test"),
    })
}

/// Files of a crate's sources without those of its test modules.
fn production(folder: &str) -> Vec<PathBuf> {
    let all = files(&[folder], ".rs");
    let mut tests: Vec<PathBuf> = Vec::new();
    for path in &all {
        let is_folder = path.ends_with("mod.rs") || path.ends_with("lib.rs") || path.ends_with("main.rs");
        let below = if is_folder { path.parent().expect("a folder").to_path_buf() } else { path.with_extension("") };
        for item in parsed(path).items {
            if let syn::Item::Mod(module) = item
                && module.content.is_none()
                && is_test(&module.attrs)
            {
                tests.push(below.join(module.ident.to_string()));
            }
        }
    }
    let outside =
        |path: &PathBuf| tests.iter().all(|test| !path.starts_with(test) && *path != test.with_extension("rs"));
    all.into_iter().filter(outside).collect()
}

/// Visits production code: items of tests are left out.
struct Production<'f> {
    on_type: &'f mut dyn FnMut(String),
    on_wording: &'f mut dyn FnMut(String),
}

fn names_message(expr: &syn::Expr) -> bool {
    match expr {
        syn::Expr::Field(field) => matches!(&field.member, syn::Member::Named(name) if name == "message"),
        syn::Expr::Path(path) => path.path.is_ident("message"),
        syn::Expr::Reference(inner) => names_message(&inner.expr),
        syn::Expr::Paren(inner) => names_message(&inner.expr),
        syn::Expr::MethodCall(call) => {
            ["as_str", "as_ref", "trim", "to_string", "clone", "lines"].iter().any(|name| call.method == name)
                && names_message(&call.receiver)
        }
        _ => false,
    }
}

fn is_text(expr: &syn::Expr) -> bool {
    matches!(expr, syn::Expr::Lit(literal) if matches!(literal.lit, syn::Lit::Str(_)))
        || matches!(expr, syn::Expr::Path(path) if path.path.segments.last().is_some_and(|last| {
            last.ident.to_string().chars().all(|c| c.is_uppercase() || c == '_')
        }))
}

impl<'a> Visit<'a> for Production<'_> {
    fn visit_item(&mut self, item: &'a syn::Item) {
        let (attributes, name): (&[syn::Attribute], Option<&syn::Ident>) = match item {
            syn::Item::Fn(item) => (&item.attrs, None),
            syn::Item::Mod(item) => (&item.attrs, None),
            syn::Item::Impl(item) => (&item.attrs, None),
            syn::Item::Struct(item) => (&item.attrs, Some(&item.ident)),
            syn::Item::Enum(item) => (&item.attrs, Some(&item.ident)),
            syn::Item::Trait(item) => (&item.attrs, Some(&item.ident)),
            syn::Item::Type(item) => (&item.attrs, Some(&item.ident)),
            _ => (&[], None),
        };
        if is_test(attributes) {
            return;
        }
        if let Some(name) = name {
            (self.on_type)(name.to_string());
        }
        syn::visit::visit_item(self, item);
    }

    fn visit_expr_method_call(&mut self, call: &'a syn::ExprMethodCall) {
        let asks = ["contains", "starts_with", "ends_with", "strip_prefix", "strip_suffix", "find", "eq"];
        if asks.iter().any(|name| call.method == name)
            && names_message(&call.receiver)
            && call.args.first().is_some_and(is_text)
        {
            (self.on_wording)(call.method.to_string());
        }
        syn::visit::visit_expr_method_call(self, call);
    }

    fn visit_expr_binary(&mut self, expr: &'a syn::ExprBinary) {
        let compares = matches!(expr.op, syn::BinOp::Eq(_) | syn::BinOp::Ne(_));
        let pairs = [(&expr.left, &expr.right), (&expr.right, &expr.left)];
        if compares && pairs.into_iter().any(|(one, other)| names_message(one) && is_text(other)) {
            (self.on_wording)("==".into());
        }
        syn::visit::visit_expr_binary(self, expr);
    }
}

fn wording() -> Outcome {
    let (mut broken, mut all) = (Vec::new(), 0);
    for (_, folder) in SOURCES {
        for path in production(folder) {
            all += 1;
            let mut on_wording = |how: String| broken.push(format!("{}: `{how}` of a message", shown(&path)));
            Production { on_type: &mut |_| (), on_wording: &mut on_wording }.visit_file(&parsed(&path));
        }
    }
    Outcome::of(broken, format!("{all} files"))
}

/// Names that more than three types of a crate have, and why.
const SHARED_NAMES: [(&str, &str, usize); 1] = [
    // Those of a bus, of a start-up, of the computing part and of a run: each is written with its module.
    ("runtime", "Options", 4),
];

fn type_names() -> Outcome {
    let (mut broken, mut all) = (Vec::new(), 0);
    for (name, folder) in SOURCES {
        let mut types: BTreeMap<String, Vec<String>> = BTreeMap::new();
        for path in production(folder) {
            let mut on_type = |of: String| types.entry(of).or_default().push(shown(&path));
            Production { on_type: &mut on_type, on_wording: &mut |_| () }.visit_file(&parsed(&path));
        }
        all += types.values().map(Vec::len).sum::<usize>();
        for (of, places) in types {
            let listed = SHARED_NAMES.iter().find(|(known, shared, _)| *known == name && *shared == of);
            let most = listed.map_or(3, |(_, _, most)| *most);
            if places.len() > most {
                broken.push(format!("{name} has {} types `{of}`: {}", places.len(), places.join(", ")));
            }
        }
    }
    Outcome::of(broken, format!("{all} types"))
}

fn compiler_root() -> Outcome {
    let folder = root().join("compiler/src");
    let loose: Vec<String> = fs::read_dir(folder)
        .expect("a folder")
        .map(|entry| entry.expect("an entry").path())
        .filter(|path| path.is_file() && !path.ends_with("lib.rs"))
        .map(|path| shown(&path))
        .collect();
    let broken = if loose.len() > 4 { loose.clone() } else { Vec::new() };
    Outcome::of(broken, format!("{} beside lib.rs", loose.len()))
}

/// Hosts of package registries, in halves, because this file is searched too.
const REGISTRIES: [(&str, &str); 5] =
    [("crates", ".io"), ("pypi", ".org"), ("npmjs", ".com"), ("registry", ".npmjs"), ("rubygems", ".org")];

fn registries() -> Outcome {
    let (mut broken, mut all) = (Vec::new(), 0);
    for ending in [".rs", ".md", ".toml", ".sh", ".fric", ".c", ".h", ".py", "run", "prepare", "runner", "guest"] {
        for path in files(&["."], ending) {
            let Ok(text) = fs::read_to_string(&path) else { continue };
            all += 1;
            for (front, back) in REGISTRIES {
                if text.contains(&format!("{front}{back}")) {
                    broken.push(format!("{}: {front}{back}", shown(&path)));
                }
            }
        }
    }
    Outcome::of(broken, format!("{all} files"))
}

fn headings() -> Outcome {
    let (mut broken, mut all) = (Vec::new(), 0);
    for path in files(&["."], ".rs") {
        for (number, line) in fs::read_to_string(&path).expect("a source").lines().enumerate() {
            let comment = line.trim_start();
            let Some(words) = comment.strip_prefix("/// # ").or_else(|| comment.strip_prefix("//! # ")) else {
                continue;
            };
            all += 1;
            let begins = |heading: &str| words.strip_prefix(heading).is_some_and(|more| more.starts_with(' '));
            if ["Errors", "Panics", "Safety"].into_iter().any(begins) {
                broken.push(format!("{}:{}: {comment}", shown(&path), number + 1));
            }
        }
    }
    Outcome::of(broken, format!("{all} headings"))
}
