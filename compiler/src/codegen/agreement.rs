//! Tests that every back end returns the same bits as the interpreter.

use super::jit::{compile, compile_prepared, compile_with};
use super::target::{self, FunctionCompiler};
use crate::codegen::forms::{Context, Form, Options};
use crate::codegen::lanes::{self, Width};
use crate::codegen::outline::Lengths;
use crate::codegen::passes;
use crate::codegen::unswitch::unswitchable;
use crate::ir::build::Build;
use crate::ir::cfg::{Area, BlockId, Cfg, Entry as Called, Inst, Place};
use crate::ir::interpret::Interpreter;
use crate::ir::parse::{parse, parse_layout};
use crate::ir::random::{self, POOL_LEN, REALS, Random};
use crate::ir::{Func, Op, Unary, Value};
use crate::math;
use abi::image::Target;
use abi::lanes::Batch;
use abi::table::Interpret;
use abi::{Code, Function, Layout, Slot};
use std::path::Path;
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
    let machine = Code::Machine(compile_with(&funcs, layout, pool.len(), &with(lengths), false).unwrap().0);
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

/// Settings with these lengths.
fn with(lengths: Lengths) -> Options {
    Options { lengths, ..Options::default() }
}

/// The graph of an outlined function.
fn outlined(func: &Func, lengths: Lengths) -> Cfg {
    let options = with(lengths);
    passes::run(func, Form::Long, Called::Several, &Context { layout: None, options: &options })
}

/// A case of `tests/ir/agreement/*.ir`: a function, and the blocks from which it starts.
///
/// ```text
/// ; What is special about it.
/// ; block: inputs 2, states 1      the segments of the block, as in the files of passes
/// ; pool: 1.0, 2.0                 the pool, if it reads one
/// ; slot 3: 0.5, edges             numbers of a slot: each is combined with those of all others; `edges` are special numbers
/// ```
struct AgreementCase {
    func: Func,
    layout: Layout,
    pool: Vec<f64>,
    blocks: Vec<Vec<f64>>,
}

impl AgreementCase {
    fn read(text: &str) -> AgreementCase {
        let numbers = |list: &str| -> Vec<f64> {
            let number = |word: &str| match word {
                "edges" => REALS.to_vec(),
                word => vec![word.parse().unwrap_or_else(|_| panic!("`{word}` is no number"))],
            };
            list.split(", ").flat_map(number).collect()
        };
        let (mut layout, mut pool, mut blocks) = (Layout::default(), Vec::new(), Vec::new());
        for line in text.lines().filter_map(|line| line.strip_prefix("; ")) {
            match line.split_once(": ") {
                Some(("block", segments)) => {
                    layout = parse_layout(segments).unwrap();
                    blocks = vec![vec![0.0; layout.size()]];
                }
                Some(("pool", list)) => pool = numbers(list),
                Some((slot, list)) if let Some(slot) = slot.strip_prefix("slot ") => {
                    let slot: usize = slot.parse().expect("a slot");
                    let with = |block: &Vec<f64>, number: f64| {
                        let mut block = block.clone();
                        block[slot] = number;
                        block
                    };
                    let all = numbers(list);
                    blocks =
                        blocks.iter().flat_map(|block| all.iter().map(move |number| with(block, *number))).collect();
                }
                _ => {}
            }
        }
        AgreementCase { func: parse(text).unwrap_or_else(|error| panic!("{error}\n{text}")), layout, pool, blocks }
    }
}

/// Each function of the files, on the interpreter, as a loop, as a single step with hoisted parameters, and in lanes of all
/// widths.
#[test]
fn functions_of_files_agree() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/ir/agreement");
    let (mut files, mut steps) = (0, 0);
    for path in std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
        let name = path.display().to_string();
        let AgreementCase { func, layout, pool, blocks } =
            AgreementCase::read(&std::fs::read_to_string(&path).unwrap());
        for count in [1, 3, 40] {
            check(&func, &layout, &blocks, &pool, count, &format!("{name}, {count} iterations"));
        }
        files += 1;
        steps += blocks.len();
        let funcs = [(Function::Step, func.clone())];
        let reference = Interpreter::new(&funcs, &layout, pool.len());
        let code = compile_prepared(&funcs, &layout, pool.len()).unwrap().0;
        for start in &blocks {
            let (mut found, mut expected) = (start.clone(), start.clone());
            let expected_status = reference.call(Function::Step, &mut expected, &pool, 1);
            if let Some(prepared) = code.prepared() {
                found.resize(start.len() + prepared.len, f64::NAN);
                let status = code.step_prepared(&mut found, &pool, false).expect("it has such a step");
                assert_eq!(status, expected_status, "{name} from {start:?}");
                assert!(same(&found[..start.len()], &expected), "{name} from {start:?}: {found:?}, not {expected:?}");
            }
        }
        for width in Width::ALL.into_iter().filter(|width| width.is_here()) {
            let mut batch =
                Batch::new(lanes::compile(&func, &layout, pool.len(), width, 1).expect("this processor can"));
            for starts in blocks.chunks(batch.width()) {
                starts.iter().enumerate().for_each(|(lane, start)| batch.load(lane, start));
                batch.advance(&pool, 1);
                for (lane, start) in starts.iter().enumerate() {
                    let (mut expected, mut found) = (start.clone(), start.clone());
                    reference.call(Function::Step, &mut expected, &pool, 1);
                    batch.save(lane, &mut found);
                    assert!(same(&found, &expected), "{name}, {width:?}: {found:?} instead of {expected:?}");
                }
            }
        }
    }
    println!("{files} files, {steps} blocks");
    assert!(files >= 8 && steps > 2000, "{files} files, {steps} blocks");
}

/// Unswitching finds what four springs share.
#[test]
fn four_springs_are_unswitched() {
    let texts = [
        include_str!("../../../tests/ir/agreement/springs_1.ir"),
        include_str!("../../../tests/ir/agreement/springs_4.ir"),
    ];
    let found = texts.map(|text| unswitchable(&AgreementCase::read(text).func).is_some());
    assert_eq!(found, [false, true]);
}

/// Each operation on reals, on every pair of edge values.
#[test]
fn every_operation_on_reals_agrees_at_the_edges() {
    let of_two: [fn(Value, Value) -> Op; 7] = [Op::Add, Op::Sub, Op::Mul, Op::Div, Op::Less, Op::LessEqual, Op::Equal];
    let of_one: [fn(Value) -> Op; 7] =
        [Op::Neg, Op::Abs, Op::Sqrt, Op::Floor, Op::Nearest, Op::ToInt, |a| Op::Fma(a, a, a)];
    let layout = Layout::new([0, 3, 4, 0, 0, 0, 0, 0, 0, 0]);
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
        let lengths = Lengths {
            max_function: 0,
            min_piece: least,
            max_piece: least + random.below(9),
            max_scratch: u32::MAX,
            min_repetitions: 2,
        };
        let all = outlined(&func, lengths);
        let again = outlined(&func, Lengths { max_scratch: all.scratch_len.saturating_sub(1), ..lengths });
        let max_scratch = if again.pieces.is_empty() { all.scratch_len } else { again.scratch_len };
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
        crossing += scratch_stores(&all);
    }
    println!("{pieces} pieces, {crossing} values that cross");
    assert!(pieces > 10_000 && crossing > 10_000);
}

/// Number of values that pieces store for others.
fn scratch_stores(cfg: &Cfg) -> usize {
    let stores = |inst: &&Inst| matches!(inst, Inst::Store(place, _) if place.area == Area::Scratch);
    cfg.blocks.iter().flat_map(|block| &block.insts).filter(stores).count()
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
        let cfg = outlined(&func, lengths);
        assert!(!cfg.pieces.is_empty(), "there is room");
        let of_loop = |piece: &&BlockId| cfg.head(&cfg.order(**piece)).is_some();
        for piece in cfg.pieces.iter().filter(of_loop) {
            loops += 1;
            for inst in cfg.order(*piece).iter().flat_map(|block| &cfg.blocks[block.index()].insts) {
                match inst {
                    Inst::Compute(_) => rows += 1,
                    Inst::Store(Place { area: Area::Block, .. }, _) => stores += 1,
                    Inst::Reload(value, _) => tables += usize::from(cfg.op(*value) == Op::Load(Slot(u32::MAX))),
                    _ => {}
                }
            }
        }
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
        ahead += usize::from(compile(&funcs, &layout, POOL_LEN).unwrap().0.is_distributed());
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
        let isa = target::with(target, &[]);
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
