//! One step of each model of the library, with one call per step as in a rig, against C written by hand for that model
//! and called through a pointer: `cargo bench --bench abi`.
//!
//! The C (`models.c`, `gcc -O3 -march=native`) receives the same inputs, new ones at every call, and makes the same
//! step: by `expo`, in the form in which one writes it for one model alone. First both run through the same input
//! sequence, and their states and outputs must agree; then they are timed interleaved in one process. Reported are
//! ratios of medians; below 1 is faster than C. The targets, a geometric mean of at most 0.85 and at worst 1.3, compare
//! this C without guards with our step as an instance calls it: expressions of parameters are hoisted and evaluated
//! when a parameter changes. Three columns show the effect of these differences: the same C with guards, our step
//! without guards, and our step without hoisting, as in images. The last three are for calls whose inputs depend on the
//! outputs of the previous call, as in a closed loop; in all others, many calls overlap in the pipeline. `C to C`, the
//! same C twice and in each round at two places, shows the noise of the measurement. An argument after the command
//! selects models whose names begin with it.
//!
//! The placement of data may cost a step more than everything else: a load waits for a store whose address has the same
//! last twelve bits, and where that happens is a matter of luck. So all data moves to another place in each round. The
//! placement of code matters as much, because branch prediction is indexed by address. So each side has its code at
//! several places, and so has the calling loop.

#[path = "../../src/project.rs"]
#[allow(dead_code, unused_imports, reason = "the command uses more of it")]
mod project;

mod compile {
    pub use compiler::Sources;
}

#[path = "../gcc.rs"]
mod gcc;
mod hand;

use abi::plan::Method;
use abi::table::{Entry, Machine};
use abi::{Code, Function, Instance, Slot};
use compiler::codegen::jit;
use compiler::ir::Func;
use compiler::ir::program::Program;
use compiler::{Changes, NoSources, Sources};
use hand::{BEYOND, COMPARED, COURSE, Hand, LEFT_OUT, Pair};
use std::hint::black_box;
use std::sync::Arc;
use std::time::Instant;

const ROUNDS: usize = PLACES * 29;
/// Number of places of the code, used in turn.
const PLACES: usize = 12;
/// Kinds of calls.
const KINDS: usize = 8;
/// Calls of a round, and warm-up calls before it.
const CALLS: usize = 1000;
const WARM: usize = 200;
const _: () = assert!(WARM + CALLS <= BEYOND, "a round does not leave the input sequence");

fn main() {
    let leads: [usize; PLACES] = std::array::from_fn(|place| 16 + 1040 * place);
    let [libraries, calls] = ["library/models.c", "library/calls.c"].map(|source| gcc::built_at(source, leads));
    let around = calls.each_ref().map(Around::of);
    let hands = libraries.each_ref().map(hand::hands);
    let chosen = std::env::args().skip(1).find(|word| !word.starts_with('-')).unwrap_or_default();
    let modules = project::Disk.modules();
    let texts = modules.iter().filter_map(|module| project::Disk.library(module)).flatten();
    let whole: String = texts
        .flat_map(|(_, text)| text.lines().map(|line| format!("{line}\n")).collect::<Vec<_>>())
        .filter(|line| !line.starts_with("import "))
        .collect();
    let mut loaded = compiler::load("library.fric", &whole, &NoSources);
    let names: Vec<String> = loaded.models().iter().map(|model| model.name.text.clone()).collect();
    println!("one step a call by `expo`, new inputs at each; below 1 is faster than C through a pointer");
    println!(
        "{:<22} {:>8} {:>8} {:>8} {:>7} {:>10} {:>10} {:>10} {:>9} {:>8} {:>7} {:>7}",
        "",
        "C",
        "checked",
        "ours",
        "ratio",
        "to checked",
        "unguarded",
        "unprepared",
        "C in turn",
        "ours",
        "in turn",
        "C to C"
    );
    let (mut ratios, mut left_out) = ([const { Vec::new() }; WHAT.len()], Vec::new());
    for name in names.iter().filter(|name| name.starts_with(&chosen)) {
        if let Some((_, why)) = LEFT_OUT.iter().find(|(left_out, _)| left_out == name) {
            left_out.push(format!("{name}: {why}"));
            continue;
        }
        let hands = hands.each_ref().map(|hands| {
            let found = hands.iter().find(|hand| hand.name() == *name).copied();
            found.unwrap_or_else(|| panic!("models.c has no C for {name}, and LEFT_OUT no reason"))
        });
        let Times { c, c_to_c, checked, ours, bare, unprepared, c_in_turn, ours_in_turn } =
            compare(name, &mut loaded, (hands, &around));
        let of_model = [ours / c, ours / checked, bare / c, unprepared / c, ours_in_turn / c_in_turn, c_to_c];
        let [ratio, to_checked, unguarded, unprepared, in_turn, _] = of_model;
        println!(
            "{name:<22} {c:5.1} ns {checked:5.1} ns {ours:5.1} ns {ratio:7.3} {to_checked:10.3} {unguarded:10.3} \
             {unprepared:10.3} {c_in_turn:6.1} ns {ours_in_turn:5.1} ns {in_turn:7.3} {c_to_c:7.3}"
        );
        ratios.iter_mut().zip(of_model).for_each(|(ratios, ratio)| ratios.push((ratio, name)));
    }
    left_out.iter().for_each(|what| println!("left out: {what}"));
    for (what, ratios) in WHAT.into_iter().zip(ratios) {
        #[allow(clippy::disallowed_methods, reason = "for people only")]
        let mean = (ratios.iter().map(|(ratio, _)| ratio.ln()).sum::<f64>() / ratios.len() as f64).exp();
        let above = ratios.iter().filter(|(ratio, _)| *ratio > 1.0).count();
        let (worst, name) = ratios.iter().max_by(|a, b| a.0.total_cmp(&b.0)).expect("at least one model");
        println!(
            "{} models, {what}: geometric mean {mean:.3}, worst {worst:.3} ({name}), {above} above 1",
            ratios.len()
        );
    }
}

/// The ratios, in the order of the columns.
const WHAT: [&str; 6] = ["ratio", "to checked", "unguarded", "unprepared", "in turn", "C to C"];

/// Nanoseconds per call, medians.
struct Times {
    c: f64,
    /// Ratio, larger by smaller, of two measurements of the same C at different places.
    c_to_c: f64,
    /// C with guards.
    checked: f64,
    ours: f64,
    /// Without guards.
    bare: f64,
    /// Without hoisting.
    unprepared: f64,
    /// With inputs that depend on the previous call.
    c_in_turn: f64,
    ours_in_turn: f64,
}

/// Compares a model's step with its C over the same input sequence, then times both.
fn compare(name: &str, loaded: &mut compiler::Loaded, (hands, around): ([&Hand; PLACES], &[Around; PLACES])) -> Times {
    let h = hand::step_length(name);
    let built = compiler::build(loaded, &NoSources, name, &Changes::default(), &mut Vec::new());
    let mut program = built.unwrap_or_else(|found| panic!("{name}: {found:?}")).program;
    program.size_rings(h);
    let contained = codes(&program, |functions| {
        let made = jit::compile(functions, &program.description.layout, program.description.pool.len());
        Code::Machine(made.unwrap_or_else(|why| panic!("{name}: {why}")).0)
    });
    let mut ours = Running::new(&program);
    program.description.guards.clear();
    let mut bare = Running::new(&program);
    let (made, ours) = (ours.codes, &mut ours.instance);
    let refused = |why: String| -> ! { panic!("{why}") };
    let mut pair = Pair::new(name, hands[0], ours).unwrap_or_else(|why| refused(why));
    let inputs = ours.description().layout.inputs.range();
    bare.instance.block_mut()[inputs.clone()].copy_from_slice(&pair.course[..inputs.len()]);
    assert_eq!(bare.instance.start(h), 0, "{name} starts without guards");
    pair.agrees(ours, COMPARED).unwrap_or_else(|why| refused(why));
    let Pair { x, params, course, inputs, outputs, .. } = pair;
    let ways = [Way::of(&made, ours), Way::of(&bare.codes, &bare.instance), Way::of(&contained, ours)];
    timed((hands, around), ways, &x, &params, (&course, &inputs, &outputs), h)
}

/// The code at each of its places: after a varying number of other functions.
fn codes(program: &Program, make: impl Fn(&[(Function, Func)]) -> Code) -> [Code; PLACES] {
    let functions = compiler::functions(program, Method::Expo);
    let start = functions.iter().find(|(function, _)| *function == Function::Start).expect("there is a start");
    std::array::from_fn(|place| make(&[&vec![start.clone(); place], &functions[..]].concat()))
}

/// A model and its code.
struct Running {
    instance: Instance,
    codes: [Code; PLACES],
}

impl Running {
    fn new(program: &Program) -> Running {
        let codes = codes(program, |functions| {
            let (code, notes) = compiler::code(functions, &program.description, false);
            assert!(notes.is_empty(), "{notes:?}");
            code
        });
        let instance = Instance::new(Arc::new(program.description.clone()), codes[0].clone(), &program.params);
        Running { instance, codes }
    }
}

/// One variant of our step, at each of its places, with its data.
struct Way<'a> {
    entries: [Entry; PLACES],
    pool: &'a [f64],
    numbers: Moving,
}

impl Way<'_> {
    /// The single step from the present state of the instance.
    fn of<'a>(codes: &[Code; PLACES], instance: &'a Instance) -> Way<'a> {
        let pool = &*instance.description().pool;
        let mut numbers = instance.block().to_vec();
        let prepared = |code: &Code| code.made(Function::Step).and_then(Machine::prepared);
        if let Some(prepared) = prepared(&codes[0]) {
            numbers.resize(numbers.len() + prepared.len, f64::NAN);
            if let Some(prepare) = prepared.prepare {
                // SAFETY: the block, the data after it, and the pool are those of the model.
                unsafe { prepare(numbers.as_mut_ptr(), pool.as_ptr(), 1) };
            }
        }
        let entries = codes.each_ref().map(|code| match prepared(code) {
            Some(prepared) => black_box(prepared.step),
            None => black_box(code.entry(Function::Step).expect("it is machine code")),
        });
        Way { entries, pool, numbers: Moving::new(&numbers) }
    }
}

/// Data that moves in each round: by one cache line, through a page.
struct Moving {
    room: Vec<f64>,
    /// Start of the pages, and the offset within one.
    page: usize,
    at: usize,
    /// Initial values.
    first: Vec<f64>,
}

impl Moving {
    const PAGE: usize = 4096 / size_of::<f64>();
    const LINE: usize = 64 / size_of::<f64>();

    fn new(numbers: &[f64]) -> Moving {
        let room = vec![0.0; 2 * Moving::PAGE + numbers.len()];
        let page = room.as_ptr().align_offset(4096);
        let mut moving = Moving { room, page, at: 0, first: numbers.to_vec() };
        moving.again();
        moving
    }

    /// Restores the initial values.
    fn again(&mut self) {
        self.room[self.page + self.at..][..self.first.len()].copy_from_slice(&self.first);
    }

    /// Moves to the place for the next round.
    fn next(&mut self) -> *mut f64 {
        let begin = self.page + self.at;
        self.at = (self.at + Moving::LINE) % Moving::PAGE;
        self.room.copy_within(begin..begin + self.first.len(), self.page + self.at);
        self.room[self.page + self.at..].as_mut_ptr()
    }
}

/// Medians of interleaved rounds, averaged over the places.
fn timed(
    (hands, around): ([&Hand; PLACES], &[Around; PLACES]),
    mut ways: [Way; 3],
    x: &[f64],
    params: &[f64],
    (course, inputs, outputs): (&[f64], &[Slot], &[Slot]),
    h: f64,
) -> Times {
    let first = inputs.first().map_or(0, |slot| slot.index());
    let in_c: Vec<usize> = (0..outputs.len()).collect();
    let in_block: Vec<usize> = outputs.iter().map(|slot| slot.index()).collect();
    // States, parameters, inputs and outputs, in the order of their declaration; a second copy for the C with guards.
    let all: Vec<f64> = [x, params, &vec![0.0; inputs.len() + outputs.len()]].concat();
    let mut of_c = [Moving::new(&all), Moving::new(&all)];
    // Kinds in order: C with dependent calls, C with guards, C, C elsewhere; ours with dependent calls, ours, without
    // guards, without hoisting.
    let mut times = [const { [const { Vec::new() }; PLACES] }; KINDS];
    let mut order: [usize; KINDS] = std::array::from_fn(|kind| kind);
    let mut drawn = 1;
    for number in 0..ROUNDS {
        let rows = number * (WARM + CALLS) % COURSE * inputs.len();
        let rows = &course[rows..][..(WARM + CALLS) * inputs.len()];
        let place = number / (ROUNDS / PLACES);
        // The calling loop is at another place in each round, because its alignment relative to the callee matters,
        // too.
        let around = &around[number % PLACES];
        if number % (ROUNDS / PLACES) == 0 {
            of_c.iter_mut().chain(ways.iter_mut().map(|way| &mut way.numbers)).for_each(Moving::again);
        }
        // Random order: no kind is always first or always after the same one, because branch predictors keep the
        // history of what ran before.
        for kind in 0..KINDS {
            order.swap(kind, draw(&mut drawn) % (kind + 1));
        }
        for kind in order {
            let calls = if kind < 4 {
                let numbers = of_c[kind % 2].next();
                // SAFETY: the data has this length.
                let (params, u) = unsafe { (numbers.add(x.len()), numbers.add(x.len() + params.len())) };
                // SAFETY: as above.
                let out = unsafe { u.add(inputs.len()) };
                let elsewhere = if kind == 3 { PLACES / 2 } else { 0 };
                let Hand { step, checked, .. } = hands[(place + elsewhere) % PLACES];
                Calls {
                    step: if kind == 1 { *checked as *const () } else { *step as *const () },
                    first: numbers,
                    second: params,
                    third: u.cast(),
                    fourth: out,
                    h,
                    mask: if kind == 1 { -1 } else { 0 },
                    inputs: u,
                    width: inputs.len(),
                    base: out,
                    outputs: in_c.as_ptr(),
                    number_of_outputs: in_c.len(),
                }
            } else {
                let Way { entries, pool, numbers } = &mut ways[(kind - 4).saturating_sub(1)];
                let block = numbers.next();
                Calls {
                    step: entries[place] as *const (),
                    first: block,
                    second: pool.as_ptr(),
                    third: std::ptr::without_provenance(1),
                    fourth: block,
                    h,
                    mask: -1,
                    // SAFETY: the inputs lie in the block.
                    inputs: unsafe { block.add(first) },
                    width: inputs.len(),
                    base: block,
                    outputs: in_block.as_ptr(),
                    number_of_outputs: in_block.len(),
                }
            };
            let calls_of = if matches!(kind, 0 | 4) { around.in_turn } else { around.many };
            let (warm, timed) = rows.split_at(WARM * inputs.len());
            // SAFETY: the step matches these arguments, and there is a row for each call.
            let all = |rows: &[f64], number| unsafe { calls_of(&calls, rows.as_ptr(), number) };
            assert_eq!(all(warm, WARM), 1, "no guard fires");
            let begun = Instant::now();
            let fine = all(timed, CALLS);
            times[kind][place].push(begun.elapsed().as_secs_f64() / CALLS as f64 * 1e9);
            assert_eq!(fine, 1, "no guard fires");
        }
    }
    let median = |mut times: Vec<f64>| {
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    };
    let mean = |places: [Vec<f64>; PLACES]| places.map(median).iter().sum::<f64>() / PLACES as f64;
    let [c_in_turn, checked, c, again, ours_in_turn, ours, bare, unprepared] = times.map(mean);
    let c_to_c = again.max(c) / again.min(c);
    Times { c, c_to_c, checked, ours, bare, unprepared, c_in_turn, ours_in_turn }
}

/// A number from a linear congruential generator: the same in every run.
fn draw(last: &mut u64) -> usize {
    *last = last.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*last >> 33) as usize
}

/// The calling loop, `calls.c`: the same for each kind of step.
#[repr(C)]
struct Calls {
    step: *const (),
    first: *mut f64,
    second: *const f64,
    third: *const (),
    fourth: *mut f64,
    h: f64,
    /// The bits of the status to check.
    mask: i64,
    /// Where a step reads its inputs, one after the other.
    inputs: *mut f64,
    width: usize,
    /// Where it writes its outputs, as indices relative to the base.
    base: *const f64,
    outputs: *const usize,
    number_of_outputs: usize,
}

type Made = unsafe extern "C" fn(&Calls, *const f64, usize) -> i32;

/// The calling loop at one of its places.
struct Around {
    many: Made,
    in_turn: Made,
}

impl Around {
    fn of(library: &libloading::Library) -> Around {
        // SAFETY: the source defines them.
        let made = |name: &[u8]| *unsafe { library.get::<Made>(name) }.expect("the source has it");
        Around { many: made(b"many"), in_turn: made(b"in_turn") }
    }
}
