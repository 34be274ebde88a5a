//! File tests of passes, `tests/ir/*.ir`, as Cranelift's filetests; and listings of the library, read back.
//!
//! A file holds a listing and, after a line `---`, what the passes make of it. Its first lines are comments:
//!
//! ```text
//! ; pass: reassociate, contract              one or more passes, in the order in which they run
//! ; block: params 1, states 2                the segments of the block; slot 3 is the first of them
//! ; balanced                                 opposite forces must cancel to exactly 0; only `reassociate` looks at it
//! ; A sentence: what must happen and what must not.
//! ```
//!
//! A pass is one of [`PASSES`], `expand`, or one of [`LATE`], of which the output shows what it did in words, and of
//! `hoist_params` both parts. `BLESS=1 cargo test --test ir` writes what the passes make now: read that diff as code.

use abi::plan::Method;
use abi::{Layout, Slot};
use compiler::codegen::hoist_params::Hoisted;
use compiler::codegen::passes::LATE;
use compiler::ir::Func;
use compiler::ir::interpret::run_once;
use compiler::ir::parse::parse;
use compiler::ir::random::Random;
use compiler::ir::verify::{Stage, verify};
use compiler::math::{POOL, expand};
use compiler::opt::{Context, PASSES};
use compiler::{Changes, Sources};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// The files, in the order of their names.
fn files() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/ir");
    let mut files: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "ir"));
    files.sort();
    files
}

/// What a file says besides its listings.
struct Case {
    passes: Vec<String>,
    layout: Layout,
    balanced: bool,
    input: Func,
}

impl Case {
    fn read(text: &str) -> Result<Case, String> {
        let header = |key: &str| text.lines().find_map(|line| line.strip_prefix("; ")?.strip_prefix(key));
        let passes = header("pass: ").ok_or("no line `; pass: NAME`")?;
        let layout = layout(header("block: ").ok_or("no line `; block: params 1, states 2`")?)?;
        let input = parse(text).map_err(|error| error.to_string())?;
        verify(&input, &layout, POOL.len(), Stage::Lowered)?;
        let balanced = text.lines().any(|line| line == "; balanced");
        Ok(Case { passes: passes.split(", ").map(str::to_string).collect(), layout, balanced, input })
    }

    /// The text of what the passes make of the input.
    fn run(&self) -> Result<String, String> {
        let mut func = self.input.clone();
        for (place, name) in self.passes.iter().enumerate() {
            let is_last = place + 1 == self.passes.len();
            match name.as_str() {
                "expand" => func = expand(&func),
                "hoist_params" if is_last => {
                    let Hoisted { prepare, step } = Hoisted::of(&func, &self.layout);
                    self.agrees(&[&prepare, &step])?;
                    return Ok(format!("{prepare}\n{step}"));
                }
                name => match PASSES.iter().find(|pass| pass.name == name) {
                    Some(pass) => {
                        let context = Context { layout: &self.layout, balanced: self.balanced };
                        func = (pass.run)(&func, context);
                    }
                    None => {
                        let late = LATE.iter().find(|pass| pass.name == name).filter(|_| is_last);
                        let late = late.ok_or(format!("no pass `{name}`, or it is not the last one"))?;
                        return Ok(format!("; {}\n", late.effect(&func, &self.layout)));
                    }
                },
            }
            let stage = if name == "expand" { Stage::Expanded } else { Stage::Lowered };
            verify(&func, &self.layout, POOL.len(), stage)?;
        }
        self.agrees(&[&func])?;
        Ok(func.to_string())
    }

    /// Whether the input, and the outputs one after the other, compute the same values up to rounding, on 500 blocks of
    /// moderate numbers.
    fn agrees(&self, outputs: &[&Func]) -> Result<(), String> {
        let input = [expand(&self.input)];
        let outputs: Vec<Func> = outputs.iter().map(|func| expand(func)).collect();
        let mut random = Random(1);
        // Values that one output stores for the next lie after the block.
        let after = outputs.iter().map(|func| func.stores.len()).sum::<usize>();
        for _ in 0..500 {
            let mut number = |slot: usize| {
                let size = random.within(0.1, 4.0);
                // Time, the step length and the count of steps are positive.
                if slot >= Slot::FIXED as usize && random.below(4) == 0 { -size } else { size }
            };
            let block: Vec<f64> = (0..self.layout.size() + after).map(&mut number).collect();
            let run = |funcs: &[Func]| {
                let mut block = block.clone();
                let status: u64 = funcs.iter().map(|func| run_once(func, &mut block, POOL.as_slice())).sum();
                block.truncate(self.layout.size());
                (status, block)
            };
            let ((a, one), (b, other)) = (run(&input), run(&outputs));
            let close = |(a, b): (&f64, &f64)| {
                a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan() || (a - b).abs() <= 1e-9 * (1.0 + a.abs())
            };
            if a != b || !one.iter().zip(&other).all(close) {
                return Err(format!("{block:?} becomes {one:?}, status {a}; after the pass {other:?}, status {b}"));
            }
        }
        Ok(())
    }
}

/// `params 1, states 2`
fn layout(text: &str) -> Result<Layout, String> {
    const SEGMENTS: [&str; 10] =
        ["params", "inputs", "states", "memory", "regimes", "outputs", "derivatives", "roots", "jacobian", "due"];
    let (mut lens, mut rings) = ([0; 10], 0);
    for part in text.split(", ") {
        let (name, len) = part.split_once(' ').ok_or(format!("expected a segment and its length, not `{part}`"))?;
        let len: u32 = len.parse().map_err(|_| format!("`{len}` is no length"))?;
        match SEGMENTS.iter().position(|segment| *segment == name) {
            Some(at) => lens[at] = len,
            None if name == "rings" => rings = len,
            None => return Err(format!("no segment `{name}`")),
        }
    }
    Ok(Layout::new(lens).with_rings(rings))
}

#[test]
fn passes_make_what_the_files_say() {
    let mut wrong = String::new();
    for path in files() {
        let text = fs::read_to_string(&path).unwrap();
        let name = path.file_name().unwrap().display();
        let (input, expected) = text.split_once("\n---\n").unwrap_or((text.trim_end(), ""));
        match Case::read(input).and_then(|case| case.run()) {
            Err(cause) => wrong += &format!("{name}: {cause}\n"),
            Ok(found) if found == expected => {}
            Ok(found) if std::env::var_os("BLESS").is_some() => {
                fs::write(&path, format!("{input}\n---\n{found}")).unwrap();
            }
            Ok(found) => wrong += &format!("{name}: BLESS=1 writes what the pass makes now\n{found}\n"),
        }
    }
    assert!(wrong.is_empty(), "\n{wrong}");
}

#[test]
fn each_pass_has_three_files_and_each_file_says_what_it_shows() {
    let mut files_of: BTreeMap<String, u32> = BTreeMap::new();
    for path in files() {
        let text = fs::read_to_string(&path).unwrap();
        let name = path.file_name().unwrap().display();
        let comment = text.lines().take_while(|line| line.starts_with(';')).skip(2).find(|line| line.ends_with('.'));
        assert!(text.starts_with("; pass: ") && comment.is_some(), "{name}: a sentence says what it shows");
        for pass in Case::read(text.split("\n---\n").next().unwrap()).unwrap().passes {
            *files_of.entry(pass).or_default() += 1;
        }
    }
    for name in PASSES.iter().map(|pass| pass.name).chain(["expand"]) {
        assert!(files_of.get(name).is_some_and(|files| *files >= 3), "{name}: {files_of:?}");
    }
}

/// The library as the compiler finds it: dotted names and texts.
struct Library(Vec<(String, String)>);

impl Library {
    fn read() -> Library {
        fn below(folder: &Path, module: &str, texts: &mut Vec<(String, String)>) {
            for entry in fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                let name = format!("{module}.{}", path.file_stem().unwrap().display());
                if path.is_dir() {
                    below(&path, &name, texts);
                } else if path.extension().is_some_and(|extension| extension == "fric") {
                    texts.push((name, fs::read_to_string(path).unwrap()));
                }
            }
        }
        let mut texts = Vec::new();
        below(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../stdlib-models"), "std", &mut texts);
        texts.sort();
        Library(texts)
    }
}

impl Sources for Library {
    fn library(&self, module: &str) -> Option<Vec<(String, String)>> {
        let is_inside =
            |name: &str| name.strip_prefix(module).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
        let found: Vec<(String, String)> = self.0.iter().filter(|(name, _)| is_inside(name)).cloned().collect();
        (!found.is_empty()).then_some(found)
    }

    fn modules(&self) -> Vec<String> {
        self.0.iter().map(|(name, _)| name.clone()).collect()
    }

    fn file(&self, _: &str, _: &str) -> Result<(String, String), String> {
        Err("the library reads no files".into())
    }
}

#[test]
fn functions_of_library_models_are_read_back() {
    let library = Library::read();
    let mut functions = 0;
    for (name, text) in &library.0 {
        let mut loaded = compiler::load(name, text, &library);
        let models: Vec<String> = loaded.models().iter().map(|model| model.name.text.clone()).collect();
        for model in models {
            for method in [Method::Expo, Method::Adaptive] {
                let step = (method != Method::Adaptive).then_some(1e-3);
                let changes = Changes { method: Some(method), step, ..Changes::default() };
                // A model with an open part has no program.
                let Ok(built) = compiler::build(&mut loaded, &library, &model, &changes, &mut Vec::new()) else {
                    continue;
                };
                for (function, func) in compiler::functions(&built.program, method) {
                    assert!(parse(&func.to_string()) == Ok(func), "{name} {model} {method:?} {}", function.name());
                    functions += 1;
                }
            }
        }
    }
    assert!(functions > 300, "{functions}");
}
