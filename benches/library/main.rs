//! One step of each model of the library, called once a step as a rig calls it, against C written by hand for that model
//! and called through a pointer: `cargo bench --bench abi`.
//!
//! The C (`models.c`, `gcc -O3 -march=native`) gets the same inputs, new ones at every call, and does the same step: by
//! `expo`, in the form in which one writes it for one model alone. First both go through the same course, whose states
//! and outputs must agree; then they are timed in turn, in one process. Ratios of medians; below 1 is faster than C. The bar
//! is this C as it stands, which does not watch what it does. Two columns tell what that is worth: the same C with just
//! that, and our step without guards. The last three are of calls whose inputs wait for the outputs of the call
//! before, as they do where a loop is closed; in all others many calls are under way at once.
//! A word behind the command takes only models whose names begin with it.

#[path = "../../src/project.rs"]
#[allow(dead_code, unused_imports, reason = "the command uses more of it")]
mod project;

mod compile {
    pub use compiler::Sources;
}

#[path = "../gcc.rs"]
mod gcc;

use abi::description::Kind;
use abi::plan::Method;
use abi::table::Entry;
use abi::{Description, Function, Instance, Slot};
use compiler::program::Program;
use compiler::{Changes, NoSources, Sources};
use std::ffi::{CStr, c_char};
use std::hint::black_box;
use std::sync::Arc;
use std::time::Instant;

/// Instants of the course of inputs, which then begins again.
const COURSE: usize = 4096;
/// Steps for which both must agree.
const COMPARED: usize = 20_000;
/// Largest difference of a quantity, as a share of the largest value that it has had.
const TOLERANCE: f64 = 1e-9;
const ROUNDS: usize = 151;
const CALLS: usize = 1000;

/// Models without C, and why.
const LEFT_OUT: &[(&str, &str)] = &[
    ("ForceBench", "a mass around the contact in its slot, not a model to call by itself"),
    ("ObserverBench", "a mass around the observer in its slot"),
    ("SpeedBench", "hands its speed to the contact in its slot"),
    ("SpringBench", "a spring around the contact in its slot"),
    ("Servo", "a whole closed loop: benches/step.rs has it"),
    ("Pull", "a whole closed loop"),
    ("Hold", "a whole closed loop"),
];

/// A model in C: names of its ports, by which numbers find their places, and its step.
#[repr(C)]
struct Hand {
    name: *const c_char,
    inputs: *const c_char,
    params: *const c_char,
    states: *const c_char,
    outputs: *const c_char,
    step: unsafe extern "C" fn(*mut f64, *const f64, *const f64, *mut f64, f64),
    /// The same that also watches.
    checked: unsafe extern "C" fn(*mut f64, *const f64, *const f64, *mut f64, f64) -> i64,
    /// Which states it watches, a bit each.
    watched: u64,
    number_of_outputs: u64,
}

fn words(text: *const c_char) -> Vec<String> {
    // SAFETY: the table holds C strings, which live as long as the library.
    let text = unsafe { CStr::from_ptr(text) }.to_str().expect("names are ASCII");
    text.split_whitespace().map(String::from).collect()
}

/// What a name of a state in C stands for.
enum State {
    /// In the block.
    Slot(Slot),
    /// C's own, which begins as an input does (`.v`) or as 0 (`.`).
    Own(f64),
}

fn main() {
    let library = gcc::built("library/models.c");
    // SAFETY: the table is in the source; it ends with an entry without a name.
    let hands = unsafe { library.get::<*const Hand>(b"models") }.expect("the source has a table");
    let hand = |name: &str| {
        // SAFETY: as above.
        let mut entries = (0..).map(|k| unsafe { &*(*hands).add(k) }).take_while(|hand| !hand.name.is_null());
        entries.find(|hand| words(hand.name) == [name])
    };
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
        "{:<22} {:>8} {:>8} {:>8} {:>7} {:>10} {:>10} {:>9} {:>8} {:>7}",
        "", "C", "checked", "ours", "ratio", "to checked", "unguarded", "C in turn", "ours", "in turn"
    );
    let (mut ratios, mut left_out) = ([const { Vec::new() }; 4], Vec::new());
    for name in names.iter().filter(|name| name.starts_with(&chosen)) {
        if let Some((_, why)) = LEFT_OUT.iter().find(|(left_out, _)| left_out == name) {
            left_out.push(format!("{name}: {why}"));
            continue;
        }
        let hand = hand(name).unwrap_or_else(|| panic!("`models.c` has no {name}"));
        let [c, checked, ours, bare, c_in_turn, ours_in_turn] = compare(name, &mut loaded, hand);
        let of_model = [ours / c, ours / checked, bare / c, ours_in_turn / c_in_turn];
        let [ratio, to_checked, unguarded, in_turn] = of_model;
        println!(
            "{name:<22} {c:5.1} ns {checked:5.1} ns {ours:5.1} ns {ratio:7.3} {to_checked:10.3} {unguarded:10.3} \
             {c_in_turn:6.1} ns {ours_in_turn:5.1} ns {in_turn:7.3}"
        );
        ratios.iter_mut().zip(of_model).for_each(|(ratios, ratio)| ratios.push((ratio, name)));
    }
    left_out.iter().for_each(|what| println!("left out: {what}"));
    for (what, ratios) in ["ratio", "to checked", "unguarded", "in turn"].into_iter().zip(ratios) {
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

/// Nanoseconds a call in C, in C that watches too, of ours, and of ours without guards, and in C and of ours one call behind
/// the other, medians.
fn compare(name: &str, loaded: &mut compiler::Loaded, hand: &Hand) -> [f64; 6] {
    // A sampled model is called at its own pace.
    let h = match name {
        "DriveTorqueSampled" => 0.5e-3,
        _ => 1e-3,
    };
    let built = compiler::build(loaded, &NoSources, name, &Changes::default(), &mut Vec::new());
    let mut program = built.unwrap_or_else(|found| panic!("{name}: {found:?}")).program;
    program.size_rings(h);
    let mut ours = Running::new(&program);
    program.description.guards.clear();
    let mut bare = Running::new(&program);
    let description = ours.instance.description().clone();
    let entry = ours.entry;
    let ours = &mut ours.instance;
    let slots = |names: Vec<String>| -> Vec<Slot> { names.iter().map(|path| slot(&description, name, path)).collect() };
    let inputs = slots(words(hand.inputs));
    let layout = &description.layout;
    assert!(
        inputs.iter().enumerate().all(|(k, slot)| *slot == layout.inputs.slot(k))
            && inputs.len() == layout.inputs.len as usize,
        "{name}: inputs in the order of the text"
    );
    let outputs = slots(words(hand.outputs));
    for quantity in description.quantities.iter().filter(|quantity| quantity.kind == Kind::Output) {
        let own = !quantity.path.contains('.');
        assert!(!own || outputs.contains(&quantity.slot), "{name} in C lacks output {}", quantity.path);
    }
    let course = course(&words(hand.inputs));
    let row = |k: usize| &course[k % COURSE * inputs.len()..][..inputs.len()];
    for instance in [&mut *ours, &mut bare.instance] {
        instance.block_mut()[layout.inputs.range()].copy_from_slice(row(0));
        assert_eq!(instance.start(h), 0, "{name} starts");
    }
    let params: Vec<f64> = slots(words(hand.params)).into_iter().map(|slot| ours.get(slot)).collect();
    let states: Vec<State> = words(hand.states).iter().map(|path| state(&description, name, path, ours)).collect();
    let begin = |state: &State| match state {
        State::Slot(slot) => ours.get(*slot),
        State::Own(begin) => *begin,
    };
    let mut x: Vec<f64> = states.iter().map(begin).collect();
    for quantity in description.quantities.iter().filter(|q| matches!(q.kind, Kind::State | Kind::SampledState)) {
        let known = states.iter().any(|state| matches!(state, State::Slot(slot) if *slot == quantity.slot));
        assert!(known, "{name} in C lacks state {}", quantity.path);
    }
    let mut out = vec![0.0; outputs.len()];
    let names = words(hand.states);
    let own = names.iter().enumerate().filter(|(_, path)| !path.starts_with(['.', '@']));
    let watched = own.fold(0, |all, (k, _)| all | 1 << k);
    assert_eq!(
        (hand.watched, hand.number_of_outputs),
        (watched, outputs.len() as u64),
        "{name} in C watches all states of its own and all outputs"
    );

    // The same course.
    let in_block = states.iter().enumerate().filter_map(|(k, state)| match state {
        State::Slot(slot) => Some((k, *slot)),
        State::Own(_) => None,
    });
    let in_block: Vec<(usize, Slot)> = in_block.collect();
    let mut largest = vec![0.0f64; in_block.len() + outputs.len()];
    for k in 1..COMPARED {
        ours.block_mut()[layout.inputs.range()].copy_from_slice(row(k));
        let status = ours.advance(1);
        assert_eq!(status, 0, "{name} at step {k}: {:?}", description.guards.get(status as usize - 1));
        // SAFETY: the arrays are as long as the names that the source gives.
        unsafe { (hand.step)(x.as_mut_ptr(), params.as_ptr(), row(k).as_ptr(), out.as_mut_ptr(), h) };
        let states = in_block.iter().map(|(k, slot)| (x[*k], *slot));
        for ((c, slot), largest) in states.chain(out.iter().copied().zip(outputs.iter().copied())).zip(&mut largest) {
            let own = ours.get(slot);
            *largest = largest.max(own.abs());
            let path = || description.quantities.iter().find(|q| q.slot == slot).map_or("?", |q| q.path.as_str());
            assert!(
                (c - own).abs() <= TOLERANCE * *largest,
                "{name} at step {k}, inputs {:?}: {} is {own:e}, in C {c:e}",
                row(k),
                path()
            );
        }
    }
    let ours = [(entry, ours), (bare.entry, &mut bare.instance)];
    timed(hand, ours, &mut x, &params, &mut out, (&course, &inputs, &outputs), h)
}

/// A model and its step.
struct Running {
    instance: Instance,
    entry: Entry,
}

impl Running {
    fn new(program: &Program) -> Running {
        let (code, notes) = compiler::code(&compiler::functions(program, Method::Expo), &program.description, false);
        assert!(notes.is_empty(), "{notes:?}");
        let entry = code.entry(Function::Step).expect("it is machine code");
        Running { instance: Instance::new(Arc::new(program.description.clone()), code, &program.params), entry }
    }
}

/// Medians of interleaved rounds, ns a call.
#[allow(clippy::too_many_arguments, reason = "all that the two calls need")]
fn timed(
    hand: &Hand,
    ours: [(Entry, &mut Instance); 2],
    x: &mut [f64],
    params: &[f64],
    out: &mut [f64],
    (course, inputs, outputs): (&[f64], &[Slot], &[Slot]),
    h: f64,
) -> [f64; 6] {
    let description = ours[0].1.description().clone();
    let first = description.layout.inputs.start as usize;
    let pool = description.pool.as_ptr();
    let mut u = vec![0.0; inputs.len()];
    let in_c: Vec<usize> = (0..outputs.len()).collect();
    let in_block: Vec<usize> = outputs.iter().map(|slot| slot.index()).collect();
    let mut watched = x.to_vec();
    let (x, watched) = (x.as_mut_ptr(), watched.as_mut_ptr());
    let (params, u, out) = (params.as_ptr(), u.as_mut_ptr(), out.as_mut_ptr());
    let of_c = Ports { inputs: u, base: out, outputs: &in_c };
    let ours = ours.map(|(entry, instance)| {
        let block = instance.block_mut().as_mut_ptr();
        // SAFETY: the inputs lie in the block.
        let inputs = unsafe { block.add(first) };
        (black_box(entry), block, Ports { inputs, base: block, outputs: &in_block })
    });
    let (step, checked) = (black_box(hand.step), black_box(hand.checked));
    let mut times = [const { Vec::new() }; 6];
    let mut at = 0;
    for _ in 0..ROUNDS {
        let rows = || (at..at + CALLS).map(|k| &course[k % COURSE * inputs.len()..][..inputs.len()]);
        // SAFETY: the arrays are as long as the names that the source gives.
        let plain = || unsafe {
            step(x, params, u, out, h);
            0
        };
        // SAFETY: as above.
        let watching = || unsafe { checked(watched, params, u, out, h) };
        times[0].push(round::<false>(rows(), &of_c, plain));
        times[1].push(round::<false>(rows(), &of_c, watching));
        times[4].push(round::<true>(rows(), &of_c, plain));
        for (k, (entry, block, ports)) in ours.iter().enumerate() {
            let (entry, block) = (*entry, *block);
            // SAFETY: block and pool are those of the model.
            let own = || unsafe { entry(block, pool, 1) as i64 };
            times[2 + k].push(round::<false>(rows(), ports, own));
            if k == 0 {
                times[5].push(round::<true>(rows(), ports, own));
            }
        }
        at += CALLS;
    }
    times.map(|mut times| {
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    })
}

/// Where a step reads its inputs, one behind the other, and leaves its outputs.
struct Ports<'a> {
    inputs: *mut f64,
    base: *const f64,
    /// Numbers behind the base.
    outputs: &'a [usize],
}

/// Nanoseconds a call over some rows of inputs: all that stands around the call is the same for each kind of step. If it
/// `WAITS`, nothing of a call can begin that needs an input before the call before has left its outputs.
#[inline(never)]
fn round<'a, const WAITS: bool>(
    rows: impl Iterator<Item = &'a [f64]>,
    ports: &Ports,
    mut call: impl FnMut() -> i64,
) -> f64 {
    let mut sum = 0.0;
    let begun = Instant::now();
    for row in rows {
        for (k, from) in row.iter().enumerate() {
            let input = if WAITS { from + 0.0 * sum } else { *from };
            // SAFETY: a row is as long as the model has inputs.
            unsafe { *ports.inputs.add(k) = input };
        }
        assert_eq!(call(), 0, "no guard fires");
        if WAITS {
            sum = 0.0;
        }
        for from in ports.outputs {
            // SAFETY: these are the model's outputs.
            sum += unsafe { *ports.base.add(*from) };
        }
    }
    let nanoseconds = begun.elapsed().as_secs_f64() / CALLS as f64 * 1e9;
    black_box(sum);
    nanoseconds
}

fn slot(description: &Description, name: &str, path: &str) -> Slot {
    description.quantity(path).unwrap_or_else(|| panic!("{name} has no {path}")).slot
}

fn state(description: &Description, name: &str, path: &str, ours: &Instance) -> State {
    if path == "@count" {
        return State::Slot(Slot::COUNT);
    }
    if let Some(part) = path.strip_prefix("@mode") {
        let part = part.trim_start_matches(':');
        let automaton = description.automata.iter().find(|automaton| automaton.path == part);
        return State::Slot(automaton.unwrap_or_else(|| panic!("{name} has no automaton `{part}`")).slot);
    }
    match path.strip_prefix('.') {
        Some("") => State::Own(0.0),
        Some(input) => State::Own(ours.get(slot(description, name, input))),
        None => State::Slot(slot(description, name, path)),
    }
}

/// The inputs at each instant, one behind the other: through zero and over all that contacts do.
fn course(inputs: &[String]) -> Vec<f64> {
    let mut course = Vec::new();
    for k in 0..COURSE {
        for (number, input) in inputs.iter().enumerate() {
            let angle = std::f64::consts::TAU * k as f64 / COURSE as f64;
            // The platform's sine, since these are only inputs.
            #[allow(clippy::disallowed_methods)]
            let wave = |cycles: f64| (cycles * angle + 0.3 + number as f64).sin();
            let mixed = 0.7 * wave(7.0) + 0.3 * wave(31.0);
            course.push(match input.as_str() {
                "v" | "v_d" => 5e-3 * mixed,
                "de" => 1e-3 * mixed,
                "v0" => 1e-3 + 0.5e-3 * mixed,
                "limit" => 0.4 + 0.1 * mixed,
                "e" => 20e-6 * mixed,
                "r" | "y" | "x" => 3e-3 * mixed,
                "rest" => 1.5 + mixed,
                "Fn" | "F_l" | "Fl" => 1.5 + mixed,
                "T" => 50.0 + 40.0 * mixed,
                "u" | "u_in" | "F_ext" | "F_m" | "F_e" | "F_motor" | "F_load" => 2.0 * mixed,
                other => panic!("what does the input `{other}` do?"),
            });
        }
    }
    course
}
