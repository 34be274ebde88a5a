//! Tests that every back end returns the same bits as the interpreter.

use super::jit::{compile, compile_prepared, compile_with};
use super::target::{FunctionCompiler, with};
use crate::codegen::emit::Facts;
use crate::codegen::lanes::{self, Width};
use crate::codegen::outline::{Lengths, outline};
use crate::codegen::unswitch::unswitchable;
use crate::ir::build::Build;
use crate::ir::interpret::Interpreter;
use crate::ir::random::{self, POOL_LEN, REALS, Random};
use crate::ir::{Func, Op, Unary, Value};
use crate::math;
use abi::image::Target;
use abi::lanes::Batch;
use abi::table::Interpret;
use abi::{Code, Function, Layout, Slot};
use std::sync::Arc;

/// Whether two blocks are equal to the bit; all NaN count as equal.
fn same(a: &[f64], b: &[f64]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan())
}

/// Runs `func` compiled and interpreted, from each block for `count` iterations, and compares blocks and statuses.
#[track_caller]
fn check(func: &Func, layout: &Layout, blocks: &[Vec<f64>], pool: &[f64], count: u64, what: &str) {
    check_outlined(func, layout, blocks, pool, count, Lengths::USUAL, what);
}

/// As `check`, with these lengths for outlining.
#[track_caller]
fn check_outlined(
    func: &Func,
    layout: &Layout,
    blocks: &[Vec<f64>],
    pool: &[f64],
    count: u64,
    lengths: Lengths,
    what: &str,
) {
    let funcs = [(Function::Step, func.clone())];
    let machine = Code::Machine(compile_with(&funcs, layout, pool.len(), lengths, false).unwrap().0);
    let reference = Code::Interpreted(Arc::new(Interpreter::new(&funcs, layout, pool.len())));
    for start in blocks {
        let (mut found, mut expected) = (start.clone(), start.clone());
        let statuses = [(&machine, &mut found), (&reference, &mut expected)]
            .map(|(code, block)| code.call(Function::Step, block, pool, count));
        assert!(
            same(&found, &expected) && statuses[0] == statuses[1],
            "{what}\n{func}\nfrom {start:?}\nmachine code: {found:?} status {}\ninterpreter: {expected:?} status {}",
            statuses[0],
            statuses[1]
        );
    }
}

/// Three inputs, four states.
fn layout() -> Layout {
    Layout::new([0, 3, 4, 0, 0, 0, 0, 0, 0, 0])
}

/// A mode that each step sets to 0 or 1 without selecting its old value, which the step still compares.
#[test]
fn a_mode_is_read_before_it_is_set() {
    let layout = Layout::new([0, 2, 1, 0, 1, 0, 0, 0, 0, 0]);
    let (x, regime) = (layout.states.slot(0), layout.regimes.slot(0));
    let mut build = Build::new("step");
    let [v, w] = [0, 1].map(|k| build.load(layout.inputs.slot(k)));
    let [zero, one] = [0.0, 1.0].map(|number| build.real(number));
    let (mut next, was) = (build.load(x), build.load(regime));
    let rests = build.equal(was, zero);
    for factor in [v, w, v, w] {
        let product = build.mul(next, factor);
        let moved = build.add(product, w);
        next = build.select(rests, moved, next);
    }
    let less = build.less(v, w);
    let set = build.select(less, one, zero);
    build.store(x, next);
    build.store(regime, set);
    // −0 equals mode 0.
    let regimes = [0.0, -0.0, 1.0].into_iter().flat_map(|regime| [[2.0, 3.0, regime], [3.0, 2.0, regime]]);
    let blocks: Vec<Vec<f64>> = regimes.map(|[v, w, regime]| vec![0.0, 1.0, 0.0, v, w, 5.0, regime]).collect();
    check(&build.finish(), &layout, &blocks, &[], 1, "a regime that is set");
}

/// Each operation on reals, on every pair of edge values.
#[test]
fn every_operation_on_reals_agrees_at_the_edges() {
    let of_two: [fn(Value, Value) -> Op; 7] = [Op::Add, Op::Sub, Op::Mul, Op::Div, Op::Less, Op::LessEqual, Op::Equal];
    let of_one: [fn(Value) -> Op; 7] =
        [Op::Neg, Op::Abs, Op::Sqrt, Op::Floor, Op::Nearest, Op::ToInt, |a| Op::Fma(a, a, a)];
    let layout = layout();
    let blocks: Vec<Vec<f64>> =
        REALS.iter().flat_map(|a| REALS.iter().map(|b| vec![0.0, 0.0, 0.0, *a, *b, 0.3, 0.0, 0.0, 0.0, 0.0])).collect();
    let ops = of_two.map(|of| of(Value(0), Value(1))).into_iter().chain(of_one.map(|of| of(Value(0))));
    for op in ops.chain([Op::Fma(Value(0), Value(1), Value(0)), Op::Fma(Value(0), Value(1), Value(1))]) {
        let mut func =
            Func { name: "f".into(), ops: vec![Op::Load(Slot(3)), Op::Load(Slot(4)), op], ..Func::default() };
        let result = match op {
            Op::Less(..) | Op::LessEqual(..) | Op::Equal(..) => {
                func.ops.extend([Op::Select(Value(2), Value(0), Value(1))]);
                3
            }
            Op::ToInt(_) => {
                func.ops.extend([Op::ToReal(Value(2))]);
                3
            }
            _ => 2,
        };
        func.stores = vec![(Slot(6), Value(result))];
        check(&func, &layout, &blocks, &[], 1, "an operation");
    }
}

/// min and max as selects become one instruction, which must also treat zeros and NaN as the select does.
#[test]
fn minimum_and_maximum_agree_at_the_edges() {
    let mut build = Build::new("extremes");
    let (x, y, z) = (build.load(Slot(3)), build.load(Slot(4)), build.load(Slot(5)));
    let values = [build.min(x, y), build.max(x, y), build.clamp(x, y, z), build.sign(x)];
    for (i, value) in values.into_iter().enumerate() {
        build.store(Slot(6 + i as u32), value);
    }
    let blocks: Vec<Vec<f64>> =
        REALS.iter().flat_map(|a| REALS.iter().map(|b| vec![0.0, 0.0, 0.0, *a, *b, 1.0, 0.0, 0.0, 0.0, 0.0])).collect();
    check(&build.finish(), &layout(), &blocks, &[], 1, "extremes");
}

/// Back ends recognise the select form of the sign and replace it: also at ±0 and NaN.
#[test]
fn signs_agree_at_the_edges() {
    let layout = Layout::new([0, 0, 1, 0, 0, 3, 0, 0, 0, 0]);
    let mut build = Build::new("signs");
    let (x, two) = (build.load(Slot(3)), build.real(2.0));
    // A state, so that iterations differ and the loop remains.
    let next = build.mul(x, two);
    build.store(Slot(3), next);
    // Several signs: of operands that are also read elsewhere, some of them later, the last one not.
    for (slot, of) in [(4, x), (5, next)] {
        let sign = build.sign(of);
        build.store(Slot(slot), sign);
    }
    let other = build.sub(next, two);
    let [first, second] = [build.sign(other), build.mul(other, x)];
    let last = build.fma(first, second, x);
    build.store(Slot(6), last);
    let func = build.finish();
    let below = |x: &f64| [*x, -x, 1.0f64.next_up() * x, f64::from_bits(1) * x];
    let blocks: Vec<Vec<f64>> = REALS.iter().flat_map(below).map(|x| vec![0.0, 0.0, 0.0, x, 0.0, 0.0, 0.0]).collect();
    check(&func, &layout, &blocks, &[], 1, "signs");
    let alone = Interpreter::new(&[(Function::Step, func.clone())], &layout, 0);
    for width in Width::ALL.into_iter().filter(|width| width.is_here()) {
        let lanes = lanes::compile(&func, &layout, 0, width, 1).expect("this processor can");
        let mut batch = Batch::new(lanes);
        for starts in blocks.chunks(batch.width()) {
            starts.iter().enumerate().for_each(|(lane, start)| batch.load(lane, start));
            batch.advance(&[], 1);
            for (lane, start) in starts.iter().enumerate() {
                let (mut expected, mut found) = (start.clone(), start.clone());
                alone.call(Function::Step, &mut expected, &[], 1);
                batch.save(lane, &mut found);
                assert!(same(&found, &expected), "{width:?}: {found:?} instead of {expected:?}");
            }
        }
    }
}

/// A random function with a pool and a layout, and four initial blocks.
fn random_program(random: &mut Random) -> (Func, Vec<f64>, Layout, Vec<Vec<f64>>) {
    let len = 20 + random.below(120);
    let func = random::func(random, len);
    let pool = (0..POOL_LEN).map(|_| random.real()).collect();
    let layout = random::layout();
    let blocks = (0..4).map(|_| (0..layout.size()).map(|_| random.real()).collect()).collect();
    (func, pool, layout, blocks)
}

#[test]
fn random_programs_agree() {
    // The counts below show that the random programs are varied enough.
    let (mut stopped, mut nans, mut total) = (0, 0, 0);
    for seed in 0..2000 {
        let mut random = Random(seed);
        let (func, pool, layout, blocks) = random_program(&mut random);
        let count = 1 + random.below(5) as u64;
        check(&func, &layout, &blocks, &pool, count, &format!("seed {seed}, {count} iterations"));
        let code = Interpreter::new(&[(Function::Step, func)], &layout, POOL_LEN);
        for mut block in blocks {
            stopped += usize::from(code.call(Function::Step, &mut block, &pool, count) != 0);
            nans += block.iter().filter(|x| x.is_nan()).count();
            total += block.len();
        }
    }
    println!("of 8000 runs {stopped} stopped with a status; {nans} of {total} values are NaN");
    assert!(stopped > 200 && nans * 4 < total);
}

/// The bits do not depend on where a function is cut, nor on whether the scratch area has room for the loop invariants.
#[test]
fn outlined_functions_agree() {
    let (mut pieces, mut crossing) = (0, 0);
    for seed in 0..1500 {
        let mut random = Random(seed);
        let (func, pool, layout, blocks) = random_program(&mut random);
        let least = 1 + random.below(8);
        let facts = Facts::of(&func);
        let lengths = Lengths {
            max_function: 0,
            min_piece: least,
            max_piece: least + random.below(9),
            max_scratch: u32::MAX,
            min_repetitions: 2,
        };
        let all = outline(&func, &facts, lengths).expect("there is room");
        let again = outline(&func, &facts, Lengths { max_scratch: all.scratch_len.saturating_sub(1), ..lengths });
        let max_scratch = again.map_or(all.scratch_len, |outlined| outlined.scratch_len);
        for max_scratch in [all.scratch_len, max_scratch] {
            let what = format!("seed {seed}, {lengths:?} with {max_scratch} doubles of scratch");
            check_outlined(
                &func,
                &layout,
                &blocks,
                &pool,
                1 + random.below(5) as u64,
                Lengths { max_scratch, ..lengths },
                &what,
            );
        }
        pieces += all.pieces.len();
        crossing += all.scratch_slots.len();
    }
    println!("{pieces} pieces, {crossing} values that cross");
    assert!(pieces > 10_000 && crossing > 10_000);
}

/// A function of `copies` copies of a random function. Each copy has slots of its own, at constant strides; some slots
/// are shared by all copies or with the next copy, and half of the constants differ between copies. One value of each
/// copy is added to a sum; the first status that is not 0 is the status of the function.
fn copies(random: &mut Random, copies: usize) -> (Func, Layout) {
    let one = random::layout();
    let len = 20 + random.below(60);
    let part = random::func(random, len);
    let segments = |layout: &Layout| {
        [layout.params, layout.inputs, layout.states, layout.memory, layout.regimes, layout.outputs, layout.due]
    };
    let sizes = segments(&one).map(|segment| segment.len);
    let all = sizes.map(|len| len * copies as u32);
    let layout = Layout::new([all[0], all[1], all[2], all[3], all[4], all[5], 0, 0, 0, all[6]]);
    let side_by_side = random.below(2) == 0;
    let of_copy = |slot: Slot, copy: usize| {
        let k = segments(&one).iter().position(|segment| segment.contains(slot));
        k.map_or(slot, |k| {
            let place = slot.0 - segments(&one)[k].start;
            let place = if side_by_side { place * copies as u32 + copy as u32 } else { copy as u32 * sizes[k] + place };
            segments(&layout)[k].slot(place as usize)
        })
    };
    let shared: Vec<Slot> = part.loads().into_iter().filter(|_| random.below(4) == 0).collect();
    let neighbours: Vec<Slot> = part.loads().into_iter().filter(|_| random.below(6) == 0).collect();
    let clock = |slot: Slot| slot.0 < Slot::FIXED;
    let mut build = Build::new("copies");
    let (mut sum, mut status) = (build.real(0.0), build.int(0));
    let (added, zero) = (random.below(part.ops.len()), build.int(0));
    let types = crate::ir::verify::types(&part).unwrap();
    for copy in 0..copies {
        let mut values: Vec<Value> = Vec::new();
        for op in &part.ops {
            let of = |slot: Slot| match slot {
                slot if shared.contains(&slot) => of_copy(slot, 0),
                slot if neighbours.contains(&slot) => of_copy(slot, (copy + 1) % copies),
                slot => of_copy(slot, copy),
            };
            let op = match *op {
                Op::Load(slot) => Op::Load(of(slot)),
                Op::Ring { .. } => Op::Load(Slot::TIME),
                Op::Real(bits) if bits % 2 == 0 => Op::Real((f64::from_bits(bits) * (1.0 + copy as f64)).to_bits()),
                op => op.map(|operand| values[operand.index()]),
            };
            values.push(build.op(op));
        }
        for (slot, value) in part.stores.iter().filter(|(slot, _)| copy == 0 || !clock(*slot)) {
            build.store(of_copy(*slot, copy), values[value.index()]);
        }
        if let crate::ir::Type::Real = types[added] {
            sum = build.add(sum, values[added]);
        }
        if let Some(value) = part.status {
            let fine = build.op(Op::IntEqual(status, zero));
            status = build.select(fine, values[value.index()], status);
        }
    }
    build.store(layout.outputs.slot(0), sum);
    build.status(status);
    (build.finish(), layout)
}

/// A rerolled loop returns the same bits as the straight line.
#[test]
fn rerolled_loops_agree() {
    let (mut loops, mut rows, mut stores, mut tables) = (0, 0, 0, 0);
    for seed in 0..1000 {
        let mut random = Random(seed);
        let of = 2 + random.below(7);
        let (func, layout) = copies(&mut random, of);
        let pool: Vec<f64> = (0..POOL_LEN).map(|_| random.real()).collect();
        let blocks: Vec<Vec<f64>> = (0..4).map(|_| (0..layout.size()).map(|_| random.real()).collect()).collect();
        let (least, most) = (1 + random.below(30), 31 + random.below(30));
        let lengths = Lengths {
            max_function: 0,
            min_piece: least,
            max_piece: most,
            max_scratch: u32::MAX,
            min_repetitions: 2 + random.below(2),
        };
        let outlined = outline(&func, &Facts::of(&func), lengths).expect("there is room");
        loops += outlined.pieces.iter().filter(|piece| !piece.rows.is_empty()).count();
        rows += outlined.pieces.iter().map(|piece| piece.rows.len()).sum::<usize>();
        stores += outlined.pieces.iter().map(|piece| piece.row_stores.len()).sum::<usize>();
        tables += outlined.repeats.tables.len();
        let count = 1 + random.below(5) as u64;
        check_outlined(
            &func,
            &layout,
            &blocks,
            &pool,
            count,
            lengths,
            &format!("seed {seed}, {of} copies, {lengths:?}"),
        );
    }
    println!("{loops} loops of {rows} rows, which store {stores} themselves; {tables} tables of constants");
    assert!(loops > 1000 && rows > 5000 && stores > 500 && tables > 300);
}

/// A call for several iterations does the same as single calls, and stops after the same iteration.
#[test]
fn iterations_in_one_call_equal_single_calls() {
    for seed in 5000..5100 {
        let mut random = Random(seed);
        let func = random::func(&mut random, 60);
        let pool: Vec<f64> = (0..POOL_LEN).map(|_| random.real()).collect();
        let layout = random::layout();
        let code = Code::Machine(compile(&[(Function::Step, func)], &layout, POOL_LEN).unwrap().0);
        let start: Vec<f64> = (0..layout.size()).map(|_| random.real()).collect();
        let (mut many, mut single) = (start.clone(), start.clone());
        let status = code.call(Function::Step, &mut many, &pool, 7);
        let first = (0..7).map(|_| code.call(Function::Step, &mut single, &pool, 1)).find(|status| *status != 0);
        assert_eq!(status, first.unwrap_or(0), "seed {seed}");
        assert!(same(&many, &single), "seed {seed}");
        let mut untouched = start.clone();
        assert_eq!(code.call(Function::Step, &mut untouched, &pool, 0), 0);
        assert!(same(&untouched, &start), "seed {seed}: no iteration changes nothing");
    }
}

/// A single step with hoisted parameter expressions returns the same bits as one without.
#[test]
fn hoisted_parameter_expressions_agree() {
    let (mut numbers, mut most) = (0, 0);
    for seed in 6000..6300 {
        let (func, pool, layout, blocks) = random_program(&mut Random(seed));
        let start = &blocks[0];
        let funcs = [(Function::Step, func.clone())];
        let code = compile_prepared(&funcs, &layout, POOL_LEN).unwrap().0;
        let Some(prepared) = code.prepared() else { continue };
        numbers += prepared.len;
        most = most.max(prepared.len);
        let reference = Code::Interpreted(Arc::new(Interpreter::new(&funcs, &layout, POOL_LEN)));
        let (mut found, mut expected) = (start.clone(), start.clone());
        found.resize(start.len() + prepared.len, f64::NAN);
        // The second step starts from another state and reuses the hoisted values.
        for there in [false, true] {
            let status = code.step_prepared(&mut found, &pool, there).expect("it has such a step");
            let of_reference = reference.call(Function::Step, &mut expected, &pool, 1);
            assert!(
                status == of_reference && same(&found[..start.len()], &expected),
                "seed {seed}\n{func}\nfrom {start:?}\nfound {found:?} status {status}\n{expected:?} status {of_reference}"
            );
            // A random function may store parameters and counters, which a real step does not: restore them.
            for slot in layout.params.range().chain(0..Slot::FIXED as usize) {
                (found[slot], expected[slot]) = (start[slot], start[slot]);
            }
        }
    }
    println!("{numbers} numbers prepared, at most {most} of a step");
    assert!(numbers > 100);
}

/// Sets the status to 1 if a number is not finite.
fn fails_unless_finite(build: &mut Build, number: Value) {
    let rest = build.sub(number, number);
    let fine = build.less_equal(rest, rest);
    let [none, failed] = [0, 1].map(|number| build.int(number));
    let status = build.select(fine, none, failed);
    build.status(status);
}

/// Constants of special bit patterns beside a division: runs of ones at any position, the smallest, the largest, and
/// others.
#[test]
fn constants_of_special_bits_agree() {
    let runs = (0..64).flat_map(|from| [1, 2, 11, 40].map(|ones| (((1u128 << ones) - 1) << from) as u64));
    let others = [u64::MAX, 0, 1 << 63, 0x3ff8_0000_0000_0001, 0x8000_0000_0000_0001, 1.5f64.to_bits()];
    let layout = Layout::new([2, 1, 0, 0, 0, 1, 0, 0, 0, 0]);
    for (k, bits) in runs.chain(others).enumerate() {
        let mut build = Build::new("constants");
        let [a, b] = [0, 1].map(|k| build.load(layout.params.slot(k)));
        let u = build.load(layout.inputs.slot(0));
        let quotient = build.div(u, b);
        let constant = build.real(f64::from_bits(bits));
        let product = build.mul(quotient, constant);
        let sum = build.add(product, a);
        build.store(layout.outputs.slot(0), sum);
        fails_unless_finite(&mut build, sum);
        let block = |k: usize| {
            let mut block = vec![0.0; layout.size()];
            block[layout.params.range()].copy_from_slice(&[REALS[k % REALS.len()], REALS[(k + 3) % REALS.len()]]);
            block[layout.inputs.slot(0).index()] = REALS[(k + 7) % REALS.len()];
            block
        };
        let blocks: Vec<Vec<f64>> = (k..k + 5).map(block).collect();
        check(&build.finish(), &layout, &blocks, &[], 1, &format!("constant {bits:#x}"));
    }
}

/// Parameters in adjacent slots, some of which are also read alone.
#[test]
fn adjacent_parameters_agree() {
    let layout = Layout::new([5, 1, 1, 0, 0, 2, 0, 0, 0, 0]);
    let mut build = Build::new("pairs");
    let p: [Value; 5] = std::array::from_fn(|k| build.load(layout.params.slot(k)));
    let [u, x] = [layout.inputs.slot(0), layout.states.slot(0)].map(|slot| build.load(slot));
    let ratio = build.div(p[4], p[3]);
    let moved = build.fma(p[1], u, x);
    let held = build.min(p[2], moved);
    let beyond = build.less(p[0], held);
    let next = build.select(beyond, p[0], held);
    build.store(layout.states.slot(0), next);
    for (slot, with) in [(0, p[1]), (1, ratio)] {
        let output = build.mul(next, with);
        build.store(layout.outputs.slot(slot), output);
    }
    let funcs = [(Function::Step, build.finish())];
    let code = compile_prepared(&funcs, &layout, 0).unwrap().0;
    let len = code.prepared().expect("a single step has code of its own").len;
    assert_eq!(len, 1, "a ratio of parameters");
    let reference = Interpreter::new(&funcs, &layout, 0);
    for (k, number) in REALS.iter().enumerate() {
        for other in REALS {
            let mut block = vec![0.0; layout.size()];
            block[layout.params.range()].copy_from_slice(&[*number, *other, 2.0, REALS[(k + 5) % REALS.len()], 3.0]);
            block[layout.inputs.slot(0).index()] = *other;
            block[layout.states.slot(0).index()] = *number;
            let (mut found, mut expected) = (block.clone(), block);
            found.resize(expected.len() + len, f64::NAN);
            let status = code.step_prepared(&mut found, &[], false).expect("it has such a step");
            assert_eq!(status, reference.call(Function::Step, &mut expected, &[], 1));
            assert!(same(&found[..expected.len()], &expected), "{found:?} instead of {expected:?}");
        }
    }
}

/// A random function that advances time as a step does: random operations on time, parameters and inputs, then other
/// random operations that read some of these instead of their own loads.
fn function_of_time(random: &mut Random) -> Func {
    let layout = random::layout();
    let len = 60 + random.below(80);
    let mut func = Func { stores: Vec::new(), writes: Vec::new(), status: None, ..random::func(random, len) };
    for op in &mut func.ops {
        match *op {
            // A ring may hold samples of states.
            Op::Ring { .. } => *op = Op::Load(Slot::TIME),
            Op::Load(slot) if !layout.params.contains(slot) && !layout.inputs.contains(slot) => {
                *op = Op::Load([Slot::TIME, Slot::COUNT][random.below(2)]);
            }
            _ => {}
        }
    }
    let types = crate::ir::verify::types(&func).unwrap();
    let first = func.ops.len();
    let len = 20 + random.below(80);
    let other = random::func(random, len);
    let mut values = Vec::new();
    for op in &other.ops {
        let leaf = matches!(op, Op::Load(_) | Op::Int(_) | Op::Bool(_));
        func.ops.push(op.map(|operand| values[operand.index()]));
        let here = Value(func.ops.len() as u32 - 1);
        let fit = |value: &Value| types[value.index()] == crate::ir::verify::result(*op, |_| unreachable!()).unwrap();
        let ahead: Vec<Value> = match leaf {
            true => (first - 20..first).map(|i| Value(i as u32)).filter(fit).collect(),
            false => Vec::new(),
        };
        let take = !ahead.is_empty() && random.below(4) > 0;
        values.push(if take { ahead[random.below(ahead.len())] } else { here });
    }
    let at = |value: Value| values[value.index()];
    let clock = [Slot::TIME, Slot::COUNT, Slot::STEP];
    let stores = other.stores.iter().filter(|(slot, _)| !clock.contains(slot));
    func.stores = stores.map(|(slot, value)| (*slot, at(*value))).collect();
    func.writes = other.writes.iter().map(|write| write.map(at)).collect();
    func.status = other.status.map(at);
    let mut push = |op: Op| {
        func.ops.push(op);
        Value(func.ops.len() as u32 - 1)
    };
    let [count, one, step] = [Op::Load(Slot::COUNT), Op::Real(1f64.to_bits()), Op::Load(Slot::STEP)].map(&mut push);
    let next = push(Op::Add(count, one));
    let time = push(Op::Mul(next, step));
    func.stores.extend([(Slot::COUNT, next), (Slot::TIME, time)]);
    func
}

/// Loop distribution returns the same bits for any number of steps, whether a guard ends the loop early or not.
#[test]
fn loop_distribution_agrees() {
    let (mut ahead, mut stopped, mut odd) = (0, 0, 0);
    for seed in 0..1500 {
        let mut random = Random(seed);
        let func = function_of_time(&mut random);
        let pool: Vec<f64> = (0..POOL_LEN).map(|_| random.real()).collect();
        let layout = random::layout();
        let funcs = [(Function::Step, func.clone())];
        ahead += usize::from(compile(&funcs, &layout, POOL_LEN).unwrap().0.goes_ahead());
        let block = |random: &mut Random| {
            let mut block: Vec<f64> = (0..layout.size()).map(|_| random.real()).collect();
            let whole = [0.0, random.below(1000) as f64, 9007199254740992.0 - random.below(200) as f64, 0.5];
            let count = whole[random.below(4)];
            if random.below(8) > 0 {
                block[Slot::COUNT.index()] = count;
                block[Slot::STEP.index()] = random.within(0.0, 1e-2);
            }
            block
        };
        let blocks: Vec<Vec<f64>> = (0..4).map(|_| block(&mut random)).collect();
        let count = random.below(90) as u64;
        check(&func, &layout, &blocks, &pool, count, &format!("seed {seed}, {count} iterations"));
        let code = Interpreter::new(&funcs, &layout, POOL_LEN);
        for mut block in blocks {
            odd += usize::from(block[Slot::COUNT.index()].fract() != 0.0);
            stopped += usize::from(code.call(Function::Step, &mut block, &pool, count) != 0);
        }
    }
    println!(
        "of 1500 programs {ahead} go ahead; of 6000 runs {stopped} stopped with a status, {odd} with an odd count"
    );
    assert!(Width::here().is_none() || ahead > 300 && stopped > 200 && odd > 200);
}

/// Every lane ends with the bits and the status of a single instance, up to the step at which the first of the lanes
/// stops.
#[test]
fn lanes_agree_with_single_instances() {
    let widths: Vec<Width> = Width::ALL.into_iter().filter(|width| width.is_here()).collect();
    let mut counts = vec![[0; 3]; widths.len()];
    for seed in 0..6000 {
        let mut random = Random(seed);
        let len = 20 + random.below(120);
        let func = random::func(&mut random, len);
        let pool: Vec<f64> = (0..POOL_LEN).map(|_| random.real()).collect();
        let layout = random::layout();
        let code = Interpreter::new(&[(Function::Step, func.clone())], &layout, POOL_LEN);
        for (width, [compared, stopped, refused]) in widths.iter().zip(&mut counts) {
            let vectors = 1 + random.below(6);
            let Ok(lanes) = lanes::compile(&func, &layout, POOL_LEN, *width, vectors) else {
                *refused += 1;
                continue;
            };
            let mut batch = Batch::new(lanes);
            let starts: Vec<Vec<f64>> =
                (0..batch.width()).map(|_| (0..layout.size()).map(|_| random.real()).collect()).collect();
            starts.iter().enumerate().for_each(|(lane, start)| batch.load(lane, start));
            let count = random.below(5) as u64;
            let done = batch.advance(&pool, count);
            assert!(done <= count);
            for (lane, start) in starts.iter().enumerate() {
                let (mut expected, mut found) = (start.clone(), start.clone());
                let status = code.call(Function::Step, &mut expected, &pool, done);
                batch.save(lane, &mut found);
                assert!(
                    same(&found, &expected) && batch.status(lane) == status,
                    "seed {seed}, {width:?} × {vectors}, lane {lane}, {done} of {count} steps\n{func}\nfrom {start:?}\n\
                     lane:  {found:?} status {}\nalone: {expected:?} status {status}",
                    batch.status(lane)
                );
                *stopped += usize::from(status != 0);
                *compared += 1;
            }
            let any = (0..batch.width()).any(|lane| batch.status(lane) != 0);
            assert!(done == count || any, "seed {seed}: {done} of {count} steps and no status");
        }
    }
    for (width, [compared, stopped, refused]) in widths.into_iter().zip(counts) {
        println!("{width:?}: {compared} lanes agree, {stopped} of them with a status; {refused} programs refused");
        assert!(compared > 2_000 && stopped > 250, "{width:?}: too few are compared");
    }
}

/// Code for lanes of two can be compiled for any target and has no unresolved references.
#[test]
fn lanes_of_two_compile_for_any_target() {
    for target in [Target::X86_64, Target::Aarch64] {
        let isa = with(target, &[]);
        let mut coder = FunctionCompiler::new(&isa);
        let mut made = 0;
        for seed in 0..600 {
            let mut random = Random(seed);
            let func = random::func(&mut random, 60);
            made += usize::from(coder.pairs(&func, &random::layout(), 1 + seed as usize % 3).is_ok());
        }
        assert!(made > 50, "{made} of 600 programs have no ring");
    }
}

/// AVX-512 has an instruction sequence of its own for e^x: same bits from the smallest to the largest argument.
#[test]
fn exponentials_in_lanes_agree_with_single_instances() {
    let layout = Layout::new([0, 0, 1, 0, 0, 2, 0, 0, 0, 0]);
    let slot = layout.states.slot(0);
    let mut build = Build::new("exponentials").with_pool(math::pool().into());
    let x = build.load(slot);
    let e = build.unary(Unary::Exp, x);
    build.store(layout.outputs.slot(0), e);
    let square = build.mul(x, x);
    let less = build.neg(square);
    let e = build.unary(Unary::Exp, less);
    build.store(layout.outputs.slot(1), e);
    let func = build.finish();
    let alone = Interpreter::new(&[(Function::Step, math::expand(&func))], &layout, math::pool().len());
    let mut random = Random(11);
    let edges = REALS.iter().copied().chain((-1500..=1500).map(|half| 0.5 * f64::from(half)));
    let spread = (0..40_000).map(|_| random.within(-760.0, 760.0));
    let mut random = Random(12);
    let any = (0..40_000).map(|_| random.real());
    let arguments: Vec<f64> = edges.chain(spread).chain(any).collect();
    for width in Width::ALL.into_iter().filter(|width| width.is_here()) {
        let lanes = lanes::compile(&func, &layout, math::pool().len(), width, 2).expect("this processor can");
        let mut batch = Batch::new(lanes);
        for some in arguments.chunks(batch.width()) {
            let start = |x: f64| {
                let mut block = vec![0.0; layout.size()];
                block[slot.index()] = x;
                block
            };
            some.iter().enumerate().for_each(|(lane, x)| batch.load(lane, &start(*x)));
            assert_eq!(batch.advance(math::pool(), 1), 1);
            for (lane, x) in some.iter().enumerate() {
                let (mut expected, mut found) = (start(*x), start(*x));
                alone.call(Function::Step, &mut expected, math::pool(), 1);
                batch.save(lane, &mut found);
                assert!(same(&found, &expected), "{width:?}, x = {x:e}: {found:?} instead of {expected:?}");
            }
        }
    }
}

/// The residual output of a mode may be a value that is already computed: inside an arm of a select, or as the bits of
/// a table entry.
#[test]
fn a_residual_output_may_be_computed_already() {
    let layout = Layout::new([0, 1, 5, 0, 0, 0, 0, 0, 0, 0]);
    let mut build = Build::new("regimes");
    let (x, regime) = (build.load(Slot(3)), build.load(Slot(4)));
    let [zero, one] = [0.0, 1.0].map(|number| build.real(number));
    let size = build.abs(x);
    let mut long = size;
    for _ in 0..8 {
        long = build.fma(long, size, one);
    }
    let small = build.less(x, one);
    let chosen = build.select(small, long, x);
    build.store(Slot(5), chosen);
    let (bits, mask) = (build.op(Op::ToBits(x)), build.int(3));
    let index = build.op(Op::IntAnd(bits, mask));
    let entry = build.op(Op::Pool { base: 0, len: 4, index });
    let bits = build.op(Op::ToBits(entry));
    let sticks = build.equal(regime, zero);
    let other = build.fma(x, x, one);
    let turned = build.select(sticks, x, other);
    let output = build.abs(turned);
    build.store(Slot(6), output);
    let mut more = turned;
    for _ in 0..6 {
        more = build.fma(more, turned, x);
    }
    build.store(Slot(7), more);
    let (none, some) = (build.int(0), build.int(1));
    let added = build.select(sticks, none, some);
    let sum = build.op(Op::IntAdd(bits, added));
    let of_table = build.op(Op::FromBits(sum));
    build.store(Slot(8), of_table);
    let next = build.select(small, regime, one);
    build.store(Slot(4), next);
    let blocks: Vec<Vec<f64>> = [0.0, 1.0, 7.0]
        .into_iter()
        .flat_map(|regime| [-0.5, 0.7, 3.0].map(|x| vec![0.0, 0.0, 0.0, x, regime, 0.0, 0.0, 0.0, 0.0]))
        .collect();
    for count in [1, 3] {
        check(&build.clone().finish(), &layout, &blocks, &[1.0, 2.0, 3.0, 4.0], count, "regimes");
    }
}

/// Springs with three modes each (stuck, and sliding at ±1) at the speed in slot 3. The layout has their states, then
/// their modes, then the sum of their forces, which a guard tests.
fn springs(number: u32) -> (Func, Layout) {
    let layout = Layout::new([0, 1, number, 0, number, 1, 0, 0, 0, 0]);
    let mut build = Build::new("springs");
    let v = build.load(layout.inputs.slot(0));
    let [zero, one, two, minus_one] = [0.0, 1.0, 2.0, -1.0].map(|number| build.real(number));
    let [forth, back] = [build.less(zero, v), build.less(v, zero)];
    let mut sum = None;
    for k in 0..number as usize {
        let [state, slot] = [layout.states.slot(k), layout.regimes.slot(k)];
        let [f, regime] = [state, slot].map(|slot| build.load(slot));
        let [sticks, slides, slides_back] = [zero, one, two].map(|number| build.equal(regime, number));
        let moved = build.add(f, v);
        let moved = build.select(sticks, moved, f);
        let [above, below] = [build.less(one, moved), build.less(moved, minus_one)];
        let yields = |build: &mut Build, beyond, direction| {
            let both = build.and(beyond, direction);
            build.and(sticks, both)
        };
        let [up, down] = [yields(&mut build, above, forth), yields(&mut build, below, back)];
        let [turns, turns_back] = [build.and(slides, back), build.and(slides_back, forth)];
        let mut next = regime;
        for (when, number) in [(turns, zero), (turns_back, zero), (down, two), (up, one)] {
            next = build.select(when, number, next);
        }
        let held = build.select(down, minus_one, moved);
        let f = build.select(up, one, held);
        build.store(state, f);
        build.store(slot, next);
        sum = Some(sum.map_or(f, |sum| build.add(sum, f)));
    }
    let sum = sum.unwrap();
    build.store(layout.outputs.slot(0), sum);
    fails_unless_finite(&mut build, sum);
    (build.finish(), layout)
}

/// Any number may stand in the slot of a mode, also −0 and numbers of no mode: for one automaton, and for four with an
/// unswitched direction.
#[test]
fn any_number_in_the_slot_of_a_mode_agrees() {
    let numbers = [0.0, -0.0, 1.0, 2.0, 7.0, f64::NAN];
    for count in [1, 4] {
        let (func, layout) = springs(count);
        assert_eq!(unswitchable(&func).is_some(), count > 1);
        let mut blocks = Vec::new();
        for v in [-0.7, -0.0, 0.0, 0.7, f64::NAN, f64::INFINITY] {
            for f in [-1.5, -0.5, 0.0, 0.5, 1.5, f64::NAN] {
                for (k, number) in numbers.into_iter().enumerate() {
                    let count = count as usize;
                    let mut block = vec![0.0, 1e-3, 0.0, v];
                    block.extend(std::iter::repeat_n(f, count));
                    // The automata after the first are in any of the modes.
                    block
                        .extend((0..count).map(|later| if later == 0 { number } else { numbers[(k + 2 * later) % 4] }));
                    block.push(0.0);
                    blocks.push(block);
                }
            }
        }
        for steps in [1, 3] {
            check(&func, &layout, &blocks, &[], steps, &format!("{count} springs, {steps} steps"));
        }
    }
}

/// A loop carries more states than there are registers through the block.
#[test]
fn many_states_agree() {
    let layout = Layout::new([0, 0, 60, 0, 0, 2, 0, 0, 0, 0]);
    let mut build = Build::new("many");
    let states: Vec<Value> = (0..60).map(|k| build.load(layout.states.slot(k))).collect();
    let half = build.real(0.5);
    for k in 0..60 {
        let mixed = build.fma(states[(k + 7) % 60], half, states[k]);
        // Some states only exchange places.
        build.store(layout.states.slot(k), if k % 9 == 0 { states[(k + 1) % 60] } else { mixed });
    }
    build.store(layout.outputs.slot(0), states[3]);
    let limit = build.real(1e3);
    let over = build.less(limit, states[11]);
    let (zero, code) = (build.int(0), build.int(4));
    let status = build.select(over, code, zero);
    build.status(status);
    let mut random = Random(7);
    let blocks: Vec<Vec<f64>> =
        (0..20).map(|_| (0..layout.size()).map(|_| random.within(-9.0, 9.0)).collect()).collect();
    let func = build.finish();
    for count in [1, 2, 3, 40] {
        check(&func, &layout, &blocks, &[], count, "many states");
    }
}
