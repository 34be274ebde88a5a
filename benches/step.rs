//! Time of one step of the PID servo with LuGre friction, at 10 µs: generated code, the interpreter, and hand-written C
//! with `gcc -O3 -march=native`, interleaved in one run. Ratios are medians over rounds.

mod gcc;

use abi::description::Guard;
use abi::lanes::Batch;
use abi::plan::Method;
use abi::unit::Unit;
use abi::{Code, Description, Function, Layout, Slot};
use compiler::codegen::jit::compile;
use compiler::codegen::lanes::{self, Width};
use compiler::ir::Unary;
use compiler::ir::build::Build;
use compiler::ir::expr::{Real, Shared};
use compiler::ir::interpret::Interpreter;
use compiler::ir::program::Program;
use compiler::math::{POOL, expand};
use compiler::numerics::fixed_step::step;
use compiler::opt::contract::contract;
use compiler::opt::reassociate::reassociate;
use std::sync::Arc;
use std::time::Instant;

/// r, m, σ0, σ1, σ2, Fc, Fs, vs, Kp, Ti, Td, N, Tt, u_max
const PARAMS: [f64; 14] = [1.0, 1.0, 1e5, 316.0, 0.4, 1.0, 1.5, 1e-3, 3.0, 0.75, 2.0, 200.0, 0.5, 20.0];
/// Step in s.
const H: f64 = 1e-5;

/// The servo; `watched`: with the guards of a model compiled from text.
fn servo(watched: bool) -> Program {
    let layout = Layout::new([14, 0, 5, 0, 0, 1, 5, 0, 30, 0]);
    let func = |name: &str| {
        let build = Shared::new(Build::new(name));
        let load = |slot| Real::new(&build, build.borrow_mut().load(slot));
        let p = |k| load(layout.params.slot(k));
        let x = |k| load(layout.states.slot(k));
        let e = p(0) - x(0);
        let raw = p(8) * e + x(3) - p(8) * p(11) * (x(0) - x(4));
        let (low, high) = (-p(13), p(13));
        let clamped = build.borrow_mut().clamp(raw.value, low.value, high.value);
        let u = Real::new(&build, clamped);
        let ratio = x(1) / p(7);
        let g = p(5) + (p(6) - p(5)) * (-(ratio * ratio)).of(Unary::Exp);
        let dz = x(1) - p(2) * x(1).abs() / g * x(2);
        let force = p(2) * x(2) + p(3) * dz + p(4) * x(1);
        let rates = [x(1), (u - force) / p(1), dz, p(8) / p(9) * e + (u - raw) / p(12), p(11) / p(10) * (x(0) - x(4))];
        let (rates, output) = (rates.map(|rate| rate.value), e.value);
        let mut build = build.into_inner();
        match name {
            "outputs" => build.store(layout.outputs.slot(0), output),
            _ => rates.iter().enumerate().for_each(|(k, rate)| build.store(layout.derivatives.slot(k), *rate)),
        }
        build.finish()
    };
    let (outputs, derivatives) = (func("outputs"), func("derivatives"));
    let guard = |slot, range| Guard { path: String::new(), slot, range, unit: Unit::none() };
    let open = (f64::NEG_INFINITY, f64::INFINITY);
    let ranges = [open, open, (-15e-6, 15e-6), open, open];
    let mut guards: Vec<Guard> =
        ranges.into_iter().enumerate().map(|(k, range)| guard(layout.states.slot(k), range)).collect();
    guards.push(guard(layout.outputs.slot(0), open));
    guards.truncate(if watched { guards.len() } else { 0 });
    let description = Description { layout, guards, pool: POOL.as_slice().into(), ..Description::default() };
    Program { description, params: PARAMS.to_vec(), outputs, derivatives, ..Program::default() }
}

type Hand = unsafe extern "C" fn(state: *mut f64, params: *const f64, h: f64, count: u64);

fn main() {
    let library = gcc::built("servo.c");
    println!("PID servo with LuGre, {} µs, one instance; below 1 is faster than gcc -O3 -march=native", H * 1e6);
    for (method, name) in [(Method::Euler, "euler"), (Method::Rk4, "rk4")] {
        // SAFETY: the library was just built from a source with functions of this name and type.
        let hand = unsafe { library.get::<Hand>(name.as_bytes()) }.expect("the function is in the source");
        let layout = servo(false).description.layout;
        let start = || {
            let mut block = vec![0.0; layout.size()];
            block[Slot::STEP.index()] = H;
            block[layout.params.range()].copy_from_slice(&PARAMS);
            block
        };
        let [as_written, plain, watched] = [(false, false), (true, false), (true, true)].map(|(regrouped, watched)| {
            let func = step(&servo(watched), method);
            let func = if regrouped { contract(&reassociate(&func, false), &layout) } else { func };
            let funcs = [(Function::Step, expand(&func))];
            let begun = Instant::now();
            let (machine, stats) = compile(&funcs, &layout, POOL.len()).expect("this processor can");
            let (_, operations, bytes) = stats.functions[0];
            println!("  {name}: {operations} operations, {bytes} bytes, compiled in {:.2} ms", ms(begun));
            (Code::Machine(machine), Code::Interpreted(Arc::new(Interpreter::new(&funcs, &layout, POOL.len()))))
        });
        // Short enough that most rounds are not interrupted.
        let count = 40_000 / if method == Method::Rk4 { 4 } else { 1 };
        let mut blocks = [start(), start(), start(), start()];
        let mut state = [0.0; 5];
        let mut times = [const { Vec::new() }; 5];
        for _ in 0..301 {
            let mut time = |k: usize, n: u64, run: &mut dyn FnMut()| {
                let begun = Instant::now();
                run();
                times[k].push(begun.elapsed().as_secs_f64() / n as f64 * 1e9);
            };
            // SAFETY: five states and fourteen parameters, as the source declares.
            time(0, count, &mut || unsafe { hand(state.as_mut_ptr(), PARAMS.as_ptr(), H, count) });
            time(1, count, &mut || assert_eq!(plain.0.call(Function::Step, &mut blocks[0], &POOL, count), 0));
            time(2, count, &mut || assert_eq!(watched.0.call(Function::Step, &mut blocks[1], &POOL, count), 0));
            time(3, count / 50, &mut || {
                assert_eq!(watched.1.call(Function::Step, &mut blocks[2], &POOL, count / 50), 0);
            });
            time(4, count, &mut || assert_eq!(as_written.0.call(Function::Step, &mut blocks[3], &POOL, count), 0));
        }
        let [gcc, plain, watched, interpreted, as_written] = times.map(median);
        println!("  {name}: gcc {gcc:.1} ns a step");
        println!("  {name}: machine code in text's order  {as_written:7.1} ns, ratio {:.3}", as_written / gcc);
        println!("  {name}: machine code, regrouped       {plain:7.1} ns, ratio {:.3}", plain / gcc);
        println!("  {name}: machine code with guards      {watched:7.1} ns, ratio {:.3}", watched / gcc);
        println!("  {name}: interpreter with guards       {interpreted:7.1} ns, ratio {:.1}", interpreted / gcc);
        let x = blocks[0][layout.states.slot(0).index()];
        println!("  {name}: position at the end {x:.12} m, of gcc {:.12} m", state[0]);
        lanes(method, name, *hand);
    }
    // SAFETY: as above.
    contact(*unsafe { library.get::<Hand>(b"contact") }.expect("the function is in the source"));
}

/// The contact alone with its speed as a function of time: only its state has a loop-carried dependency.
fn contact(hand: Hand) {
    const TEXT: &str = "model Contact {
  param sigma0 = 1e5 N/m  param Fc = 1 N  param Fs = 1.5 N  param vs = 1 mm/s
  let   v = 10 mm/s * sin(6.283185307179586 1/s * t)
  let   g = Fc + (Fs - Fc) * exp(-(v / vs)^2)
  state z [um] = 0
  dz/dt = v - sigma0 * abs(v) / g * z
}";
    let mut loaded = compiler::load("contact.fric", TEXT, &compiler::NoSources);
    let changes = compiler::Changes::default();
    let built = compiler::build(&mut loaded, &compiler::NoSources, "Contact", &changes, &mut Vec::new());
    let program = built.map_err(|found| format!("{found:?}")).expect("it compiles").program;
    let (code, notes) = compiler::code(&compiler::functions(&program, Method::Euler), &program.description, false);
    assert!(notes.is_empty(), "{notes:?}");
    let mut instance = abi::Instance::new(Arc::new(program.description.clone()), code, &program.params);
    instance.start(H);
    let mut state = [0.0; 2];
    let (count, mut times) = (40_000, [const { Vec::new() }; 2]);
    for _ in 0..301 {
        let begun = Instant::now();
        // SAFETY: two states and the servo's parameters, as the source declares.
        unsafe { hand(state.as_mut_ptr(), PARAMS.as_ptr(), H, count) };
        times[0].push(begun.elapsed().as_secs_f64() * 1e9 / count as f64);
        let begun = Instant::now();
        assert_eq!(instance.advance(count), 0);
        times[1].push(begun.elapsed().as_secs_f64() * 1e9 / count as f64);
    }
    let [gcc, ours] = times.map(median);
    println!(
        "contact alone under a sine, euler: gcc {gcc:.1} ns a step; machine code {ours:.1} ns, ratio {:.3}",
        ours / gcc
    );
    let z = instance.get(program.description.layout.states.slot(0));
    println!("  deflection at the end {z:.12e} m, of gcc {:.12e} m", state[0]);
}

/// Many instances, each with its own parameters, on one core: code for lanes against C that runs one after the other.
fn lanes(method: Method, name: &str, hand: Hand) {
    println!("{name}, many instances with their own parameters, on one core:");
    let program = servo(true);
    let layout = &program.description.layout;
    let func = contract(&reassociate(&step(&program, method), program.balanced), layout);
    let mut codes = Vec::new();
    for width in Width::ALL.into_iter().filter(|width| width.is_here()) {
        for vectors in [1, 2, 3, 4, 5, 6, 8] {
            let begun = Instant::now();
            let lanes = lanes::compile(&func, layout, POOL.len(), width, vectors).expect("this processor can");
            codes.push((format!("{} compiled in {:.2} ms", lanes.name(), ms(begun)), lanes));
        }
    }
    let count = 2_000 / if method == Method::Rk4 { 4 } else { 1 };
    // Parameters within 10 % of the nominal ones; the same for every code.
    let varied = |instance: usize| {
        let mut params = PARAMS;
        for (k, param) in params.iter_mut().enumerate() {
            *param *= 0.9 + 0.2 * ((instance * 31 + k * 17) % 101) as f64 / 100.0;
        }
        params
    };
    let mut batches: Vec<Batch> = codes.iter().map(|(_, lanes)| Batch::new(lanes.clone())).collect();
    for batch in &mut batches {
        for lane in 0..batch.width() {
            let mut block = vec![0.0; layout.size()];
            block[Slot::STEP.index()] = H;
            block[layout.params.range()].copy_from_slice(&varied(lane));
            batch.load(lane, &block);
        }
    }
    let mut states = [[0.0; 5]; 16];
    let params: Vec<[f64; 14]> = (0..16).map(varied).collect();
    let mut times = vec![Vec::new(); 1 + batches.len()];
    for _ in 0..101 {
        let begun = Instant::now();
        for (state, params) in states.iter_mut().zip(&params) {
            // SAFETY: five states and fourteen parameters, as the source declares.
            unsafe { hand(state.as_mut_ptr(), params.as_ptr(), H, count) };
        }
        times[0].push(begun.elapsed().as_secs_f64() * 1e9 / (16 * count) as f64);
        for (batch, times) in batches.iter_mut().zip(&mut times[1..]) {
            let begun = Instant::now();
            assert_eq!(batch.advance(&POOL, count), count);
            times.push(begun.elapsed().as_secs_f64() * 1e9 / (batch.width() as u64 * count) as f64);
        }
    }
    let medians: Vec<f64> = times.into_iter().map(median).collect();
    println!("  gcc, one after the other   {:7.2} ns a step and instance", medians[0]);
    for ((name, _), ns) in codes.iter().zip(&medians[1..]) {
        println!("  {name:<36} {ns:7.2} ns, ratio {:.4}", ns / medians[0]);
    }
    let x = (batches[0].get(layout.states.slot(0), 1), states[1][0]);
    println!("  position of the second instance {:.12} m, of gcc {:.12} m", x.0, x.1);
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

fn ms(begun: Instant) -> f64 {
    begun.elapsed().as_secs_f64() * 1e3
}
