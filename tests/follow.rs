//! A loop over rows of inputs makes the steps that a call for each row makes, to the bit: every model of the library by
//! every fixed method, and random texts; interpreted, as machine code, and in lanes. Inputs and outputs are chosen at
//! random, rows have any distance, and some inputs leave a range, so that steps end with a status.
//!
//! Mutants tried by hand, each fails with seed 1: the row of a step that fails is not written; the inputs of the last row
//! are not kept; an output that is a followed input has the value of its slot before the loop; the distances of inputs and
//! outputs are exchanged; a lane reads its neighbour's inputs; a lane that failed stops the others.
//!
//! `FRIC_SEED`, `FRIC_RUNS` (default 60 random texts).

#[allow(dead_code, reason = "the agreement of back ends uses all of it")]
#[path = "agreement/generate.rs"]
mod generate;
mod support;

use abi::follow::{Follow, Rows, RowsMut};
use abi::lanes::Batch;
use abi::plan::Method;
use abi::{Instance, Layout, Slot};
use compiler::codegen::tiering;
use compiler::ir::program::Program;
use compiler::ir::random::Random;
use compiler::{Changes, Loaded, Sources};
use std::sync::Arc;
use support::{Texts, number};

/// How often each situation occurred: the test fails if one never did, because it then proves nothing.
#[derive(Debug, Default)]
struct Seen {
    programs: u64,
    compiled: u64,
    distributed: u64,
    in_lanes: u64,
    by_code: u64,
    followed: u64,
    stopped: u64,
    lanes_stopped: u64,
}

/// All NaN count as one value.
fn bits(x: f64) -> u64 {
    if x.is_nan() { f64::NAN.to_bits() } else { x.to_bits() }
}

fn block(instance: &Instance) -> Vec<u64> {
    instance.block().iter().map(|x| bits(*x)).collect()
}

/// A subset in random order.
fn chosen(random: &mut Random, mut all: Vec<Slot>) -> Vec<Slot> {
    let most = random.below(all.len().min(6) + 1);
    (0..most).map(|_| all.remove(random.below(all.len()))).collect()
}

/// Rows of inputs near those of the instance, or in their ranges; a few outside.
fn rows(random: &mut Random, instance: &Instance, inputs: &[Slot], count: usize, stride: usize) -> Vec<f64> {
    let mut numbers: Vec<f64> = (0..count * stride.max(inputs.len())).map(|_| random.within(-9.0, 9.0)).collect();
    let wild = random.below(4) == 0;
    for (k, slot) in inputs.iter().enumerate() {
        let description = instance.description();
        let (low, high) = description.quantities.iter().find(|q| q.slot == *slot).map_or((-1.0, 1.0), |q| q.range);
        let (low, high) = (low.max(-1.0), high.min(1.0));
        let (low, high) = if low < high { (low, high) } else { (0.0, 1.0) };
        for row in 0..count {
            numbers[row * stride + k] = match random.below(40) {
                0 if wild => random.within(-1e9, 1e9),
                1 if wild => f64::NAN,
                2 => instance.get(*slot),
                _ => random.within(low, high),
            };
        }
    }
    numbers
}

/// What a call for each row gives: the rows of outputs that were reached, and the last status.
fn by_calls(
    instance: &mut Instance,
    (inputs, given, stride): (&[Slot], &[f64], usize),
    outputs: &[Slot],
    count: usize,
) -> (Vec<Vec<u64>>, u64) {
    let (mut taken, mut status) = (Vec::new(), 0);
    for row in 0..count {
        inputs.iter().enumerate().for_each(|(k, slot)| instance.set(*slot, given[row * stride + k]));
        status = instance.advance(1);
        taken.push(outputs.iter().map(|slot| bits(instance.get(*slot))).collect());
        if status != 0 {
            break;
        }
    }
    (taken, status)
}

/// Compares all ways to follow rows.
fn compare(program: &Program, method: Method, step: f64, place: &str, random: &mut Random, seen: &mut Seen) {
    let description = Arc::new(program.description.clone());
    let Layout { inputs, outputs, states, params, memory, regimes, .. } = description.layout.clone();
    let slots = |segments: &[abi::description::Segment]| -> Vec<Slot> {
        segments.iter().flat_map(|segment| segment.range().map(|slot| Slot(slot as u32))).collect()
    };
    let read = chosen(random, slots(&[inputs]));
    let written = chosen(random, slots(&[inputs, outputs, states, params, memory, regimes]));
    let functions = compiler::functions(program, method);
    let instance = |interpret: bool| {
        let (code, _) = compiler::code(&functions, &description, interpret);
        let mut instance = Instance::new(description.clone(), code, &program.params);
        instance.start(step);
        instance
    };
    let mut reference = instance(true);
    let start = reference.clone();
    let follows = [false, true].map(|interpret| tiering::follow(program, method, &read, &written, interpret));
    assert!(!follows[1].is_compiled());
    seen.programs += 1;
    seen.compiled += u64::from(follows[0].is_compiled());
    seen.distributed += u64::from(follows[0].is_distributed());
    let mut ways: Vec<(Instance, &Follow)> =
        vec![(instance(false), &follows[0]), (instance(true), &follows[0]), (instance(false), &follows[1])];
    for part in 0..3 {
        let count = [0, 1, 2, 7, 40, 130][random.below(6)];
        let (stride, wide) = (read.len() + random.below(3), written.len() + random.below(3));
        let stride = if random.below(5) == 0 { 0 } else { stride };
        let given = rows(random, &reference, &read, count.max(1), stride);
        let (taken, status) = by_calls(&mut reference, (&read, &given, stride), &written, count);
        seen.followed += taken.len() as u64;
        seen.stopped += u64::from(status != 0);
        for (way, (instance, follow)) in ways.iter_mut().enumerate() {
            let mut out = vec![0.125; count * wide + 1];
            let rows = Rows { numbers: &given, stride };
            let found = instance.follow(follow, rows, RowsMut { numbers: &mut out, stride: wide }, count as u64);
            let place = || format!("{place}, way {way}, part {part}: {count} rows");
            assert_eq!(found, (taken.len() as u64, status), "{}", place());
            for (row, expected) in taken.iter().enumerate() {
                let row: Vec<u64> = out[row * wide..][..written.len()].iter().map(|x| bits(*x)).collect();
                assert_eq!(row, *expected, "{}", place());
            }
            let untouched = out.iter().enumerate().skip(taken.len() * wide).all(|(_, x)| *x == 0.125);
            assert!(untouched, "{}: rows that were not reached are written", place());
            assert_eq!(block(instance), block(&reference), "{}", place());
        }
        if status != 0 {
            break;
        }
    }
    // Code for the loop over rows, or a step for each.
    let by_code = random.below(4) != 0;
    let lanes = if by_code {
        tiering::lanes_on_rows(program, method, &read, &written)
    } else {
        tiering::lanes(program, method)
    };
    let Some(lanes) = lanes else { return };
    seen.in_lanes += 1;
    seen.by_code += u64::from(lanes.is_on_rows());
    let (width, count) = (lanes.width(), [0, 1, 3, 50][random.below(4)]);
    let mut batch = Batch::new(lanes);
    let given: Vec<Vec<f64>> = (0..width).map(|_| rows(random, &start, &read, count, read.len())).collect();
    (0..width).for_each(|lane| batch.load(lane, start.block()));
    let mut tile = Vec::new();
    for row in 0..count {
        (0..read.len()).for_each(|k| tile.extend(given.iter().map(|given| given[row * read.len() + k])));
    }
    let mut out = vec![0.0; count * written.len() * width];
    let mut failed: Vec<Option<(usize, u64, Vec<f64>)>> = vec![None; width];
    let pool = &description.pool;
    batch.follow(pool, (&read, &tile), (&written, &mut out), count, &mut |row, batch| {
        for (lane, failed) in failed.iter_mut().enumerate() {
            let status = batch.status(lane);
            if status != 0 && failed.is_none() {
                let mut numbers = start.block().to_vec();
                batch.save(lane, &mut numbers);
                *failed = Some((row, status, numbers));
            }
        }
    });
    for lane in 0..width {
        let mut alone = start.clone();
        let (taken, status) = by_calls(&mut alone, (&read, &given[lane], read.len()), &written, count);
        let place = format!("{place}, lane {lane} of {width}, {count} rows");
        let mut numbers = start.block().to_vec();
        batch.save(lane, &mut numbers);
        if let Some((row, failed, at_failure)) = &failed[lane] {
            assert_eq!((row + 1, *failed), (taken.len(), status), "{place}");
            numbers.clone_from(at_failure);
            seen.lanes_stopped += 1;
        } else {
            assert_eq!(status, 0, "{place}");
        }
        for (row, expected) in taken.iter().enumerate() {
            let at = |k: usize| bits(out[(row * written.len() + k) * width + lane]);
            assert_eq!((0..written.len()).map(at).collect::<Vec<_>>(), *expected, "{place}, row {row}");
        }
        // The caller keeps time.
        numbers[Slot::TIME.index()] = alone.get(Slot::TIME);
        assert_eq!(numbers.into_iter().map(bits).collect::<Vec<_>>(), block(&alone), "{place}");
    }
}

/// A model with its inputs open, for steps of this length; none if it has errors.
fn program(loaded: &mut Loaded, sources: &dyn Sources, name: &str, method: Method, step: f64) -> Option<Program> {
    let changes = Changes { method: Some(method), step: Some(step), any_step: true, ..Changes::default() };
    Some(compiler::build(loaded, sources, name, &changes, &mut Vec::new()).ok()?.program)
}

#[test]
fn rows_are_followed_as_a_call_for_each_would() {
    let seed = number("FRIC_SEED").unwrap_or(1);
    let (mut random, mut seen) = (Random(seed), Seen::default());
    let texts = support::texts_below(&support::root().join("stdlib-models"));
    let lines = texts.iter().flat_map(|(_, text)| text.lines()).filter(|line| !line.starts_with("import "));
    let library = lines.map(|line| format!("{line}\n")).collect::<String>();
    let sources = Texts::default();
    let mut loaded = compiler::load("library.fric", &library, &sources);
    let models: Vec<String> = loaded.models().iter().map(|model| model.name.text.clone()).collect();
    for model in &models {
        for method in Method::fixed() {
            // A period of the library's sampled models is a multiple of it.
            let step = 0.5e-3;
            let program = program(&mut loaded, &sources, model, method, step).unwrap_or_else(|| panic!("{model}"));
            let place = format!("seed {seed}: {model} by {}", method.name());
            compare(&program, method, step, &place, &mut random, &mut seen);
        }
    }
    assert!(models.len() > 90 && seen.compiled >= seen.programs - 8, "{seen:?}");
    let of_library = seen.programs;
    for text in 0..number("FRIC_RUNS").unwrap_or(60) {
        let generated = generate::text(seed.wrapping_mul(1000) + text);
        let mut loaded = compiler::load("generated.fric", &generated.text, &sources);
        let method = Method::fixed().nth(random.below(Method::fixed().count())).expect("there are some");
        let made = program(&mut loaded, &sources, "Top", method, generated.step);
        let place = format!("seed {seed}: text {text} by {}", method.name());
        if let Some(program) = made {
            compare(&program, method, generated.step, &place, &mut random, &mut seen);
        }
    }
    println!("seed {seed}: {seen:?}");
    assert!(seen.programs > of_library + 20, "random texts compile: {seen:?}");
    assert!(seen.stopped * 20 > seen.programs && seen.lanes_stopped > 0, "steps fail: {seen:?}");
    assert!(seen.distributed * 8 > seen.programs, "inputs are worked on ahead: {seen:?}");
    assert!(seen.followed > 20 * seen.programs, "rows are followed: {seen:?}");
    assert!(!cfg!(target_arch = "x86_64") || seen.in_lanes * 10 > seen.programs * 9, "in lanes: {seen:?}");
    let by_code = seen.by_code * 2 > seen.programs;
    assert!(!cfg!(target_arch = "x86_64") || by_code, "lanes in a loop of their own: {seen:?}");
}
