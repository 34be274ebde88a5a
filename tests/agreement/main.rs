//! Agreement of the back ends: the reference interpreter, machine code in memory, lanes, images for x86-64 and 64-bit
//! Arm, and C produce the same bits, on the models of the library and on random programs: of operations, of texts from
//! the grammar, of mutated texts of the library. All NaN count as one value.
//!
//! A plain run tests 2,000 random programs. `FRIC_PROGRAMS=1000000 cargo test --release --test agreement seeds` resumes
//! an earlier run of the same command: see docs/machine-code.md.

mod back_ends;
mod campaign;
mod case;
#[path = "../support/debian.rs"]
mod debian;
mod emulator;
mod generate;
mod mutate;
mod report;
#[path = "../support/mod.rs"]
mod support;
mod texts;

use abi::Function;
use abi::plan::Method;
use campaign::{Campaign, Kind, Made};
use case::{Case, Run, of_chance};
use compiler::functions::{Binary, Unary};
use compiler::ir::random::{self, Random};
use compiler::ir::{Func, Op, Value};
use report::Distribution;
use std::path::Path;
use texts::Fallen;

/// Random programs in a plain run, of all kinds together.
const PLAIN: u64 = 2000;

/// Functions of random operations.
const OPERATIONS: Kind = Kind {
    title: "programs of random operations",
    name: "agreement-operations",
    batch: 200,
    level: "-O1",
    make: |seed| Ok(Made { cases: vec![of_chance(seed)], marks: Vec::new() }),
};

/// Texts from the grammar.
const GRAMMAR: Kind = Kind {
    title: "programs from the grammar",
    name: "agreement-grammar",
    batch: 50,
    level: "-O0",
    make: from_the_grammar,
};

/// Mutated texts of the library.
const MUTANTS: Kind = Kind {
    title: "changed programs of the library",
    name: "agreement-mutants",
    batch: 100,
    level: "-O0",
    make: mutate::mutant,
};

/// A text from the grammar with a fixed method, as an experiment or as a model with open inputs; every fourth also with
/// the adaptive method.
fn from_the_grammar(seed: u64) -> Result<Made, Fallen> {
    let generated = generate::text(seed);
    let (text, step) = (&generated.text, generated.step);
    let mut random = Random(!seed);
    let name = format!("text from the grammar, seed {seed}");
    let fixed = Method::fixed().cycle().nth(seed as usize % Method::fixed().count());
    let methods = [fixed, (seed % 4 == 1).then_some(Method::Adaptive)];
    let mut cases = Vec::new();
    for method in methods.into_iter().flatten() {
        let program = match random.below(2) {
            0 => texts::model("generated.fric", text, "Top", method, step).map_err(|found| texts::fallen(&found))?,
            _ => {
                let (mut variants, _) =
                    texts::read("generated.fric", text, "e", method).map_err(|found| texts::fallen(&found))?;
                variants.remove(0).program
            }
        };
        cases.push(texts::case(&name, text, &program, method, step, &mut random)?);
    }
    Ok(Made { cases, marks: Vec::new() })
}

/// Random programs of one kind, a fraction of all; progress is stored if a campaign was requested.
fn seeds(kind: &Kind, part: (u64, u64)) -> Distribution {
    let asked: Option<u64> =
        std::env::var("FRIC_PROGRAMS").ok().map(|n| n.parse().expect("FRIC_PROGRAMS is a whole number"));
    let progress = asked.map(|_| Path::new(env!("CARGO_TARGET_TMPDIR")).join(kind.name));
    let goal = (asked.unwrap_or(PLAIN) * part.0).div_ceil(part.1);
    let mut campaign = Campaign::begin(kind, progress.as_deref());
    campaign.go(goal, usize::MAX);
    print!("{}", campaign.seen.told(kind.title));
    assert!(campaign.seen.count("programs") >= goal);
    campaign.seen
}

#[test]
fn seeds_of_operations_agree() {
    let seen = seeds(&OPERATIONS, (1, 2));
    assert!(seen.group("operation").len() >= 16, "operations of every kind");
    assert!(seen.count("runs stopped") * 20 > seen.count("runs"));
    assert!(seen.count("value/NaN") * 4 < seen.count("values"));
}

#[test]
fn seeds_of_the_grammar_agree() {
    let seen = seeds(&GRAMMAR, (1, 4));
    let programs = seen.count("programs");
    assert!(seen.count("seeds kept") * 10 >= seen.count("seeds") * 8, "most texts are well-typed");
    for what in [
        "states",
        "inputs",
        "regimes",
        "transitions or events",
        "sampled blocks",
        "delays",
        "guards",
        "switching surfaces",
        "parts",
        "arrays of parts",
        "tables",
        "noise",
        "choices",
    ] {
        let with = seen.count(&format!("with/{what}"));
        assert!(with * 50 >= programs, "{what} in {with} of {programs} programs");
    }
    // All of them, and the square root.
    assert_eq!(seen.group("elementary").len(), Unary::ALL.len() + Binary::ALL.len() + 1, "every elementary function");
    for (width, with) in seen.group("lanes") {
        assert!(with * 5 >= programs, "{with} of {programs} programs have lanes of {width}");
    }
    assert!(seen.count("programs with distinct results") * 10 >= programs * 9);
}

#[test]
fn seeds_of_changed_texts_agree() {
    let seen = seeds(&MUTANTS, (1, 4));
    let programs = seen.count("programs");
    assert!(seen.count("seeds kept") * 3 >= seen.count("seeds"), "enough of what is changed still checks");
    assert!(seen.group("of").len() >= 30, "of many texts");
    assert!(seen.group("mutation").len() >= 8, "changed in every way");
    assert!(seen.count("programs with distinct results") * 10 >= programs * 9);
}

/// Every experiment of the library and of its tests, by fixed methods in turn and by the adaptive one; equal programs
/// once.
#[test]
fn models_of_the_library_agree() {
    let mut cases: Vec<Case> = Vec::new();
    let mut methods = Method::fixed().cycle();
    let mut seen = std::collections::HashSet::new();
    for (name, text) in library() {
        let loaded = compiler::load(&name, &text, &support::Texts::default());
        for experiment in loaded.experiments() {
            for method in [methods.next().expect("it goes round"), Method::Adaptive] {
                let read = texts::read(&name, &text, &experiment.name, method);
                let (variants, step) = read.unwrap_or_else(|errors| panic!("{name}, {}: {errors:?}", experiment.name));
                // There are many adaptive functions: only those of the first combination.
                let most = if method == Method::Adaptive { 1 } else { usize::MAX };
                for variant in variants.into_iter().take(most) {
                    let name = format!("{name}, {} {}", experiment.name, variant.label);
                    let case =
                        case::of_program(name, "", &variant.program, method, step, &mut Random(seen.len() as u64));
                    if seen.insert(case.listing()) {
                        cases.push(case);
                    }
                }
            }
        }
    }
    let mut distribution = Distribution::default();
    for batch in cases.chunks(100) {
        for (case, agreed) in batch.iter().zip(&back_ends::compare(batch, "-O0")) {
            distribution.see(case, agreed);
        }
    }
    print!("{}", distribution.told("models of the library"));
    assert!(distribution.count("programs") > 400);
    assert!(distribution.count("runs that change something") * 20 >= distribution.count("runs") * 19);
}

/// Texts of the library and of its tests, by name.
fn library() -> Vec<(String, String)> {
    let folders = ["stdlib-models", "tests/stdlib"];
    let texts = folders.into_iter().flat_map(|folder| support::texts_below(&support::root().join(folder)));
    texts.map(|(path, text)| (path.file_name().unwrap().to_string_lossy().into_owned(), text)).collect()
}

/// A long step: started, stepped, and stopped by a guard in the middle of a call.
#[test]
fn a_long_line_agrees() {
    let text = "import std.friction
model Surface {
  param grows = 1 1/s
  let   v [m/s] = 10 mm/s * sin(6 rad/s * t) * exp(grows * t)
  part  el[i in 1 .. 60] = LuGre(v = v * i, sigma0 = 1e5 N/m * i)
  let   seen = delay(v, 0.7 ms)
  output F [N] = sum(el.F)   in -2000 N .. 2000 N
  output w [m/s] = seen
}
experiment e {
  run    Surface() for 1 s
  solver expo step 0.1 ms
  expect final(w) >= 0
}
";
    let mut cases = Vec::new();
    for method in [Method::Expo, Method::Implicit] {
        let (variants, step) = texts::read("long.fric", text, "e", method).expect("it checks");
        let program = &variants[0].program;
        let mut case = case::of_program("a long line".into(), text, program, method, step, &mut Random(3));
        let (_, line) = case.functions.iter().find(|(function, _)| *function == Function::Step).expect("a step");
        assert!(line.ops.len() > 6000, "{} operations are not long", line.ops.len());
        let mut start = case.runs[0].start.clone();
        let usual = vec![(Function::Start, 1), (Function::Outputs, 1), (Function::Step, 40)];
        let grows = program.description.quantity("grows").expect("a parameter");
        case.runs = vec![Run { start: start.clone(), calls: usual.clone() }];
        start[grows.slot.index()] = 5e3;
        case.runs.push(Run { start, calls: usual });
        cases.push(case);
    }
    for agreed in back_ends::compare(&cases, "-O0") {
        let [usual, fast] = [0, 1].map(|run| agreed.results[run].0);
        assert!(usual == 0 && fast != 0, "statuses {usual} and {fast}");
    }
}

/// gcc 12 replaces 0 − x by −x where it infers that x is never −0. For x = 0 the result is then −0, and 0 on all other
/// back ends.
#[test]
fn zero_minus_zero_is_positive_zero() {
    let text = "model Zeros {
  param  a = 0 N
  output w [N] = 0 - abs(a)
  output x [N] = 0 - (if t > 1 s then 1 N else 0)
  output y [N] = 0 - max(abs(a), 0)
  output z [m] = 0 - sqrt(abs(a) * 1 m/N * 1 m)
}";
    let program = texts::model("zeros.fric", text, "Zeros", Method::Euler, 1e-3).expect("it checks");
    let case = || case::of_program("zeros".into(), text, &program, Method::Euler, 1e-3, &mut Random(1));
    for level in ["-O0", "-O2"] {
        let [agreed] = &back_ends::compare(&[case()], level)[..] else { panic!("one case") };
        let outputs = &agreed.results[0].1[program.description.layout.outputs.range()];
        assert!(outputs.iter().all(|x| x.to_bits() == 0), "{outputs:?}");
    }
}

/// C that compares a mask with an impossible value compiles without a warning.
#[test]
fn a_mask_compared_with_an_impossible_value_compiles_without_a_warning() {
    let layout = random::layout();
    let mask = [
        Op::Load(layout.states.slot(0)),
        Op::ToInt(Value(0)),
        Op::Int(2),
        Op::IntAnd(Value(1), Value(2)),
        Op::Int(71),
        Op::IntEqual(Value(4), Value(3)),
        Op::Real(1f64.to_bits()),
        Op::Select(Value(5), Value(6), Value(0)),
    ];
    let stores = vec![(layout.outputs.slot(0), Value(7))];
    let func = Func { name: "masked".into(), ops: mask.to_vec(), stores, ..Func::default() };
    let case = case::of_func("a mask".into(), func, &mut Random(2));
    let output = layout.outputs.slot(0).index();
    let [agreed] = &back_ends::compare(&[case], "-O1")[..] else { panic!("one case") };
    for (_, block) in &agreed.results {
        let x = block[layout.states.slot(0).index()];
        assert!(block[output] == x || x.is_nan() && block[output].is_nan(), "71 & 2 is 2 at most");
    }
}

/// An interrupted campaign ends with the same report as an uninterrupted one.
#[test]
fn an_interrupted_campaign_goes_on() {
    let small = |kind: &Kind| Kind { batch: 6, ..*kind };
    for kind in [small(&OPERATIONS), small(&GRAMMAR)] {
        let mut whole = Campaign::begin(&kind, None);
        whole.go(15, usize::MAX);
        let progress = back_ends::scratch("progress");
        let mut first = Campaign::begin(&kind, Some(&progress));
        first.go(15, 1);
        let part = first.seen.count("seeds");
        drop(first);
        assert_eq!(part, 6);
        let mut rest = Campaign::begin(&kind, Some(&progress));
        assert_eq!(rest.seen.count("seeds"), part, "it goes on with what was counted");
        rest.go(15, usize::MAX);
        assert_eq!(rest.seen, whole.seen);
        assert_eq!(rest.seen.told("all"), whole.seen.told("all"));
        // A campaign that has reached its goal is not run again, and still has its report.
        let mut again = Campaign::begin(&kind, Some(&progress));
        again.go(15, usize::MAX);
        assert_eq!(again.seen, whole.seen);
        std::fs::remove_file(progress).expect("it was written");
    }
}
