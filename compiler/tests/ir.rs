//! File tests of passes, `tests/ir/*.ir`, as Cranelift's filetests; all passes over graphs on random functions; and
//! listings of the library, read back.
//!
//! A file holds a listing and, after a line `---`, what the passes make of it. Its first lines are comments:
//!
//! ```text
//! ; pass: reassociate, contract              one or more passes, in the order in which they run
//! ; block: params 1, states 2                the segments of the block; slot 3 is the first of them
//! ; balanced                                 opposite forces must cancel to exactly 0; only `reassociate` looks at it
//! ; pieces: 2 to 4, repeated 3               lengths of pieces and least number of repetitions; only `outline` looks at it
//! ; A sentence: what must happen and what must not.
//! ```
//!
//! A pass is one of [`PASSES`], `expand`, or one of [`LATE`]; the latter work on a graph. `BLESS=1 cargo test --test ir`
//! writes the present output of the passes: read that diff as code.

use abi::plan::Method;
use abi::{Layout, Slot};
use compiler::codegen::forms::{Context as Late, Form, Options};
use compiler::codegen::passes::LATE;
use compiler::ir::Func;
use compiler::ir::build::{Build, Env};
use compiler::ir::cfg::{BlockId, Cfg, Entry};
use compiler::ir::cfg_text::parse_cfg;
use compiler::ir::cfg_verify::verify_cfg;
use compiler::ir::interpret::{prepare_cfg, run_cfg, run_once};
use compiler::ir::parse::{parse, parse_layout};
use compiler::ir::random::{self, POOL_LEN, Random};
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
    options: Options,
    input: Func,
}

impl Case {
    fn read(text: &str) -> Result<Case, String> {
        let header = |key: &str| text.lines().find_map(|line| line.strip_prefix("; ")?.strip_prefix(key));
        let passes = header("pass: ").ok_or("no line `; pass: NAME`")?;
        let layout = parse_layout(header("block: ").ok_or("no line `; block: params 1, states 2`")?)?;
        let input = parse(text).map_err(|error| error.to_string())?;
        verify(&input, &layout, POOL.len(), Stage::Lowered)?;
        let balanced = text.lines().any(|line| line == "; balanced");
        let mut options = Options::default();
        if let Some(pieces) = header("pieces: ") {
            let numbers: Vec<usize> =
                pieces.split(|c: char| !c.is_ascii_digit()).filter_map(|n| n.parse().ok()).collect();
            let [min, max, repeated] = numbers[..] else { return Err("no `; pieces: 2 to 4, repeated 3`".into()) };
            options.lengths.max_function = 0;
            (options.lengths.min_piece, options.lengths.max_piece) = (min, max);
            options.lengths.min_repetitions = repeated;
        }
        let passes = passes.split(", ").map(str::to_string).collect();
        Ok(Case { passes, layout, balanced, options, input })
    }

    /// The text of what the passes make of the input.
    fn run(&self) -> Result<String, String> {
        let mut func = self.input.clone();
        for (place, name) in self.passes.iter().enumerate() {
            match PASSES.iter().find(|pass| pass.name == name) {
                Some(pass) => {
                    let context = Context { layout: &self.layout, balanced: self.balanced };
                    func = (pass.run)(&func, context);
                }
                None if name == "expand" => func = expand(&func),
                None => return self.run_late(&func, &self.passes[place..]),
            }
            let stage = if name == "expand" { Stage::Expanded } else { Stage::Lowered };
            verify(&func, &self.layout, POOL.len(), stage)?;
        }
        self.agrees(&func)?;
        Ok(func.to_string())
    }

    /// The text of what passes over graphs make of a function.
    fn run_late(&self, func: &Func, names: &[String]) -> Result<String, String> {
        let find = |name: &String| LATE.iter().find(|pass| pass.name == name).ok_or(format!("no pass `{name}`"));
        let passes: Vec<_> = names.iter().map(find).collect::<Result<_, _>>()?;
        let forms = [Form::Single, Form::Loop, Form::Long, Form::Distributed];
        let form = forms.into_iter().find(|form| passes.iter().all(|pass| pass.on.contains(form)));
        let form = form.ok_or("no form of code has all of these passes")?;
        let called = if form == Form::Single { Entry::Single } else { Entry::Several };
        let context = Late { layout: Some(&self.layout), options: &self.options };
        let mut cfg = Cfg::straight(func, called);
        for pass in passes {
            pass.apply(&mut cfg, form, &context);
            verify_cfg(&cfg)?;
        }
        cfg.compact();
        if form != Form::Distributed {
            let counts: &[u64] = if form == Form::Single { &[1] } else { &[1, 3] };
            counts.iter().try_for_each(|count| self.graph_agrees(func, &cfg, *count))?;
        }
        Ok(cfg.to_string())
    }

    /// Whether a graph does the same as a straight line, to the bit, on 200 blocks of moderate numbers.
    fn graph_agrees(&self, func: &Func, cfg: &Cfg, count: u64) -> Result<(), String> {
        let mut random = Random(2);
        for _ in 0..200 {
            let block: Vec<f64> = (0..self.layout.size()).map(|_| random.within(-3.0, 3.0)).collect();
            same_bits(func, cfg, count, &block, POOL.as_slice())?;
        }
        Ok(())
    }

    /// Whether input and output compute the same values up to rounding, on 500 blocks of moderate numbers.
    fn agrees(&self, output: &Func) -> Result<(), String> {
        let (input, output) = (expand(&self.input), expand(output));
        let mut random = Random(1);
        for _ in 0..500 {
            let mut number = |slot: usize| {
                let size = random.within(0.1, 4.0);
                // Time, the step length and the count of steps are positive.
                if slot >= Slot::FIXED as usize && random.below(4) == 0 { -size } else { size }
            };
            let block: Vec<f64> = (0..self.layout.size()).map(&mut number).collect();
            let run = |func: &Func| {
                let mut block = block.clone();
                (run_once(func, &mut block, POOL.as_slice()), block)
            };
            let ((a, one), (b, other)) = (run(&input), run(&output));
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

/// Whether a graph does the same as a straight line for a number of iterations; the step counter of single steps is the
/// caller's.
fn same_bits(func: &Func, cfg: &Cfg, count: u64, start: &[f64], pool: &[f64]) -> Result<(), String> {
    let mut expected = start.to_vec();
    let status = (0..count).map(|_| run_once(func, &mut expected, pool)).find(|status| *status != 0).unwrap_or(0);
    let mut found = start.to_vec();
    // Hoisted values lie after the block.
    found.resize(start.len() + cfg.ops.len(), 0.0);
    prepare_cfg(cfg, &mut found, pool);
    let of_graph = run_cfg(cfg, count, &mut found, pool);
    found.truncate(start.len());
    if cfg.called == Entry::Single {
        found[Slot::COUNT.index()] = expected[Slot::COUNT.index()];
    }
    let same = |(a, b): (&f64, &f64)| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan();
    if status == of_graph && found.iter().zip(&expected).all(same) {
        return Ok(());
    }
    Err(format!("{start:?}\nbecomes {expected:?}, status {status};\nthe graph {found:?}, status {of_graph}"))
}

/// A step that begins and ends with the same function of the slots, as real ones do: it computes the new states from the
/// old ones and the outputs from the new ones, and its status says whether an output is finite.
fn with_outputs(rate: &Func) -> Func {
    let layout = random::layout();
    let mut build = Build::new("step");
    let mut env = Env::default();
    build.inline(rate, &mut env);
    env.retain(|slot, _| layout.states.contains(*slot));
    build.store_env(&env, |_| true);
    build.inline(rate, &mut env);
    build.store_env(&env, |slot| layout.outputs.contains(slot));
    let failed = layout.outputs.range().fold(build.truth(false), |failed, slot| {
        let output = build.read(Slot(slot as u32), &env);
        let finite = build.finite(output);
        let infinite = build.not(finite);
        build.or(failed, infinite)
    });
    let [fine, code] = [0, 1].map(|status| build.int(status));
    let status = build.select(failed, code, fine);
    build.status(status);
    build.finish()
}

/// After each pass over graphs, for each form of code: the graph is sound, its listing is read back, and it does the same as
/// the function.
#[test]
fn passes_over_graphs_keep_the_bits_of_random_functions() {
    let mut changed: BTreeMap<&str, u32> = BTreeMap::new();
    for seed in 0..600 {
        let mut random = Random(seed);
        let len = 20 + random.below(100);
        let func = random::func(&mut random, len);
        let func = if seed % 2 == 0 { func } else { with_outputs(&func) };
        let pool: Vec<f64> = (0..POOL_LEN).map(|_| random.real()).collect();
        let layout = random::layout();
        let mut options = Options::default();
        options.lengths.min_piece = 1 + random.below(8);
        options.lengths.max_piece = options.lengths.min_piece + random.below(9);
        options.lengths.min_repetitions = 2;
        let context = Late { layout: Some(&layout), options: &options };
        for form in [Form::Single, Form::Loop, Form::Long] {
            let (called, count) = match form {
                Form::Single => (Entry::Single, 1),
                _ => (Entry::Several, 1 + random.below(4) as u64),
            };
            let blocks: Vec<Vec<f64>> = (0..3).map(|_| (0..layout.size()).map(|_| random.real()).collect()).collect();
            let mut cfg = Cfg::straight(&func, called);
            for pass in &LATE {
                let before = cfg.clone();
                if !pass.apply(&mut cfg, form, &context) {
                    continue;
                }
                *changed.entry(pass.name).or_default() += u32::from(cfg != before);
                let what = format!("seed {seed}, {form:?}, after {}", pass.name);
                verify_cfg(&cfg).unwrap_or_else(|fault| panic!("{what}: {fault}\n{cfg}"));
                assert!(parse_cfg(&cfg.to_string()).as_ref() == Ok(&cfg), "{what}\n{cfg}");
                // Before the loop is formed, the graph makes one iteration.
                let is_loop = cfg.blocks.len() > 1;
                let count = if form == Form::Single || is_loop { count } else { 1 };
                for block in &blocks {
                    // A real step stores no parameters.
                    let stores_params = func.stores.iter().any(|(slot, _)| layout.params.contains(*slot));
                    if !(stores_params && cfg.prepare.is_some()) {
                        same_bits(&func, &cfg, count, block, &pool)
                            .unwrap_or_else(|fault| panic!("{what}: {fault}\n{func}\n{cfg}"));
                    }
                }
            }
            let whole = cfg.to_string();
            cfg.compact();
            verify_cfg(&cfg).unwrap_or_else(|fault| panic!("seed {seed}, {form:?}: {fault}\n{whole}\n{cfg}"));
            for block in &blocks {
                let same = same_bits(&func, &cfg, count, block, &pool);
                same.unwrap_or_else(|fault| panic!("seed {seed}, {form:?}, compact: {fault}\n{whole}\n{cfg}"));
            }
        }
    }
    println!("{changed:?}");
    // Random functions have no modes, and few end as they begin; those of the library below do.
    let with_modes = ["unswitch", "specialise_modes", "loop_distribution", "predictive_commoning"];
    assert!(changed["predictive_commoning"] > 10, "{changed:?}");
    for pass in LATE.iter().filter(|pass| !with_modes.contains(&pass.name)) {
        assert!(changed.get(pass.name).is_some_and(|times| *times > 50), "{}: {changed:?}", pass.name);
    }
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
    for pass in &LATE {
        assert!(files_of.contains_key(pass.name), "{}: {files_of:?}", pass.name);
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
fn functions_of_library_models_are_read_back_and_keep_their_bits() {
    let library = Library::read();
    let (mut functions, mut compared, mut random) = (0, 0, Random(3));
    let mut specialised: BTreeMap<&str, u32> = BTreeMap::new();
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
                let (options, layout) = (Options::default(), &built.program.description.layout);
                let context = Late { layout: Some(layout), options: &options };
                for (function, func) in compiler::functions(&built.program, method) {
                    for form in
                        [Form::Single, Form::Loop, Form::Distributed].into_iter().filter(|_| func.ops.len() < 400)
                    {
                        let called = if form == Form::Single { Entry::Single } else { Entry::Several };
                        let mut cfg = Cfg::straight(&func, called);
                        for pass in &LATE {
                            let blocks = cfg.blocks.len();
                            pass.apply(&mut cfg, form, &context);
                            let fault = verify_cfg(&cfg).err().unwrap_or_default();
                            assert!(fault.is_empty(), "{name} {model} {form:?} after {}: {fault}\n{cfg}", pass.name);
                            let count = specialised.entry(pass.name).or_default();
                            *count += u32::from(cfg.blocks.len() > blocks);
                        }
                        // Modes are small integers, −0 and other numbers.
                        let mut number = |_| match random.below(3) {
                            0 => random.within(-3.0, 3.0),
                            _ => [0.0, 1.0, 2.0, 3.0, -0.0, 7.0][random.below(6)],
                        };
                        let is_loop = cfg.head(&cfg.order(BlockId(0))).is_some();
                        for _ in (0..4).filter(|_| cfg.leading.is_none() && (form == Form::Single || is_loop)) {
                            let block: Vec<f64> = (0..layout.size()).map(&mut number).collect();
                            let count = if form == Form::Single { 1 } else { 3 };
                            same_bits(&func, &cfg, count, &block, &built.program.description.pool)
                                .unwrap_or_else(|fault| panic!("{name} {model} {form:?}: {fault}\n{cfg}"));
                            compared += 1;
                        }
                    }
                    assert!(parse(&func.to_string()) == Ok(func), "{name} {model} {method:?} {}", function.name());
                    functions += 1;
                }
            }
        }
    }
    println!("{functions} functions, {compared} blocks, graphs with more blocks after {specialised:?}");
    assert!(functions > 300 && compared > 2000, "{functions}, {compared}");
    assert!(["unswitch", "specialise_modes"].iter().all(|pass| specialised[pass] > 5), "{specialised:?}");
}
