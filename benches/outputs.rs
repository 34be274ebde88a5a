//! Costs of outputs: one step of the PID servo with LuGre friction at 10 µs without an output, with its friction force as
//! an output that nothing reads, and with that output computed after every step, against C that computes the same
//! (`gcc -O3 -march=native`). All are interleaved in one run; ratios are of medians over rounds.
//!
//! Many steps are one call, as in a run that observes only its end; then whole runs follow, which observe every step.
//! Last, the contact alone: its speed comes from an array, and its force is written to another one after every step.
//! `cargo bench --bench outputs`. The number of instructions of one row: `perf stat -e instructions:u` with
//! `FRIC_ROW=text,method,row`, each counted from 0; the C of a method is row 3, and 4 with the force.

mod gcc;

#[path = "../src/project.rs"]
#[allow(dead_code, unused_imports, reason = "the command uses more of it")]
mod project;

mod compile {
    pub use compiler::Sources;
}

use abi::follow::{Rows, RowsMut};
use abi::plan::Method;
use abi::{Instance, Slice, Slot};
use compiler::codegen::tiering;
use compiler::ir::program::Program;
use runtime::engine::{Continue, run};
use std::sync::Arc;
use std::time::Instant;

/// r, m, σ0, σ1, σ2, Fc, Fs, vs, Kp, Ti, Td, N, Tt, u_max
const PARAMS: [f64; 14] = [1.0, 1.0, 1e5, 316.0, 0.4, 1.0, 1.5, 1e-3, 3.0, 0.75, 2.0, 200.0, 0.5, 20.0];
/// Step in s.
const H: f64 = 1e-5;

/// The servo of the library, and one that is written out. `OUTPUT` is replaced.
const TEXTS: [(&str, &str); 2] = [
    (
        "the library's servo",
        "import std.plant
model Top {
  part s = Servo(r = 1 m)
  OUTPUT F [N] = s.fr.F
}",
    ),
    (
        "a servo in one text",
        "model Top {
  param r = 1 m        param m = 1 kg         param Kp = 3 N/m     param Ti = 0.75 s   param Td = 2 s
  param N = 200        param Tt = 0.5 s       param u_max = 20 N   param sigma0 = 1e5 N/m
  param sigma1 = 316 N·s/m   param sigma2 = 0.4 N·s/m   param Fc = 1 N   param Fs = 1.5 N   param vs = 1 mm/s
  state x [m] = 0      state v [m/s] = 0      state z [um] = 0     state i [N] = 0     state y [m] = 0
  let e   = r - x
  let raw = Kp * e + i - Kp * N * (x - y)
  let u   = clamp(raw, -u_max, u_max)
  let g   = Fc + (Fs - Fc) * exp(-(v / vs)^2)
  OUTPUT F [N] = sigma0 * z + sigma1 * dz/dt + sigma2 * v
  dx/dt = v
  dv/dt = (u - F) / m
  dz/dt = v - sigma0 * abs(v) / g * z
  di/dt = Kp / Ti * e + (u - raw) / Tt
  dy/dt = N / Td * (x - y)
}",
    ),
];

/// The contact alone.
const CONTACT: &str = "model Contact {
  input  v [m/s]
  param  sigma0 = 1e5 N/m    param sigma1 = 316 N·s/m   param sigma2 = 0.4 N·s/m
  param  Fc = 1 N            param Fs = 1.5 N           param vs = 1 mm/s
  let    g = Fc + (Fs - Fc) * exp(-(v / vs)^2)
  state  z [um] = 0
  dz/dt  = v - sigma0 * abs(v) / g * z
  output F [N] = sigma0 * z + sigma1 * dz/dt + sigma2 * v
}";

type Hand = unsafe extern "C" fn(state: *mut f64, params: *const f64, h: f64, count: u64);
/// The same, with an array of inputs and an array for outputs.
type Rowwise = unsafe extern "C" fn(
    state: *mut f64,
    params: *const f64,
    h: f64,
    count: u64,
    inputs: *const f64,
    outputs: *mut f64,
);

fn program(text: &str, declaration: &str) -> Program {
    let text = text.replace("OUTPUT", declaration);
    let mut loaded = compiler::load("outputs.fric", &text, &project::Disk);
    let changes = compiler::Changes::default();
    let built = compiler::build(&mut loaded, &project::Disk, "Top", &changes, &mut Vec::new());
    built.map_err(|found| format!("{found:?}")).expect("it compiles").program
}

fn instance(program: &Program, method: Method) -> Instance {
    let (code, notes) = compiler::code(&compiler::functions(program, method), &program.description, false);
    assert!(notes.is_empty(), "{notes:?}");
    let mut instance = Instance::new(Arc::new(program.description.clone()), code, &program.params);
    instance.start(H);
    instance
}

/// Instances without the output, with one that nothing reads, and with one that every step computes.
fn instances(text: &str, method: Method) -> [Instance; 3] {
    // A `let` without a reader is no output.
    let (without, with) = (program(text, "let"), program(text, "output"));
    let left_out: Vec<Slot> = with.outputs_for_readers().collect();
    let sliced = Program { left_out: left_out.clone(), ..with.clone() };
    let code = compiler::code(&compiler::functions(&sliced, method), &sliced.description, false).0;
    let mut unread = instance(&with, method).with_slice(Slice { code, left_out: left_out.into() });
    unread.read_only(None);
    [instance(&without, method), unread, instance(&with, method)]
}

fn main() {
    let library = gcc::built("servo.c");
    // SAFETY: the library was just built from a source with functions of these names and of this type.
    let hand = |name: &str| *unsafe { library.get::<Hand>(name.as_bytes()) }.expect("it is in the source");
    let only: Option<Vec<usize>> = std::env::var("FRIC_ROW")
        .ok()
        .map(|row| row.split(',').map(|k| k.parse().expect("FRIC_ROW=text,method,row")).collect());
    println!("PID servo with LuGre, {} µs, many steps in a call; ratios to C that computes the same", H * 1e6);
    for (at, (title, text)) in TEXTS.iter().enumerate() {
        for (of, method) in [Method::Euler, Method::Rk4].into_iter().enumerate() {
            if only.as_ref().is_some_and(|only| only[..2] != [at, of]) {
                continue;
            }
            let mut ours = instances(text, method);
            let name = method.name();
            let theirs = [hand(name), hand(&format!("{name}_force"))];
            let mut states = [[0.0; 6]; 2];
            let count = 40_000 / if method == Method::Rk4 { 4 } else { 1 };
            let mut times = [const { Vec::new() }; 5];
            for _ in 0..301 {
                for row in 0..5 {
                    if only.as_ref().is_some_and(|only| only[2] != row) {
                        continue;
                    }
                    let begun = Instant::now();
                    match row.checked_sub(3) {
                        None => assert_eq!(ours[row].advance(count), 0),
                        // SAFETY: six numbers and fourteen parameters, as the source declares.
                        Some(k) => unsafe { theirs[k](states[k].as_mut_ptr(), PARAMS.as_ptr(), H, count) },
                    }
                    times[row].push(begun.elapsed().as_secs_f64() / count as f64 * 1e9);
                }
            }
            if let Some(only) = &only {
                println!("{title}, {name}, row {}: {} steps", only[2], 301 * count);
                continue;
            }
            let [without, unread, computed, gcc, gcc_force] = times.map(median);
            println!("{title}, {name}: gcc {gcc:.2} ns a step, {gcc_force:.2} with the force");
            println!("  without the output            {without:6.2} ns, {:.3}", without / gcc);
            println!(
                "  with it, read by nothing      {unread:6.2} ns, {:.3}; to without {:.3}",
                unread / gcc,
                unread / without
            );
            println!(
                "  with it, after every step     {computed:6.2} ns, {:.3}; to without {:.3}",
                computed / gcc_force,
                computed / without
            );
        }
    }
    if only.is_none() {
        runs();
        contact(&library);
    }
}

/// The contact alone under a speed of 10 mm/s and 1 Hz.
fn contact(library: &libloading::Library) {
    println!("contact alone, its speed from an array, its force to another one");
    let mut loaded = compiler::load("contact.fric", CONTACT, &project::Disk);
    let changes = compiler::Changes::default();
    let built = compiler::build(&mut loaded, &project::Disk, "Contact", &changes, &mut Vec::new());
    let program = built.map_err(|found| format!("{found:?}")).expect("it compiles").program;
    let slot = |path: &str| program.description.quantity(path).expect("it is declared").slot;
    const COUNT: usize = 20_000;
    #[allow(clippy::disallowed_methods, reason = "both get the same speeds")]
    let speeds: Vec<f64> = (0..COUNT).map(|n| 0.01 * (std::f64::consts::TAU * n as f64 / COUNT as f64).sin()).collect();
    for method in [Method::Euler, Method::Rk4] {
        let name = format!("contact_{}", method.name());
        // SAFETY: the source has functions of these names and of this type.
        let hand = *unsafe { library.get::<Rowwise>(name.as_bytes()) }.expect("it is in the source");
        let follow = tiering::follow(&program, method, &[slot("v")], &[slot("F")], false);
        assert!(follow.is_compiled());
        let mut ours = instance(&program, method);
        let (mut z, mut forces, mut times) = (0.0, [vec![0.0; COUNT], vec![0.0; COUNT]], [const { Vec::new() }; 2]);
        for _ in 0..301 {
            let [theirs, rows] = &mut forces;
            let begun = Instant::now();
            // SAFETY: one state, fourteen parameters, and as many numbers in the arrays as steps.
            unsafe { hand(&mut z, PARAMS.as_ptr(), H, COUNT as u64, speeds.as_ptr(), theirs.as_mut_ptr()) };
            times[0].push(begun.elapsed().as_secs_f64() / COUNT as f64 * 1e9);
            let begun = Instant::now();
            let from = Rows { numbers: &speeds, stride: 1 };
            let ended = ours.follow(&follow, from, RowsMut { numbers: rows, stride: 1 }, COUNT as u64);
            times[1].push(begun.elapsed().as_secs_f64() / COUNT as f64 * 1e9);
            assert_eq!(ended, (COUNT as u64, 0));
        }
        let off = forces[0].iter().zip(&forces[1]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let [gcc, ours] = times.map(median);
        println!(
            "  {}: gcc {gcc:.2} ns a step, ours {ours:.2}, ratio {:.3}; forces differ by {off:.1e} N",
            method.name(),
            ours / gcc
        );
    }
}

/// Whole runs that observe every step: what of it is an output costs.
fn runs() {
    println!("runs of 2 s by euler that measure every step, ns a step");
    for (title, text) in TEXTS {
        let cases = [("let", "x"), ("output", "x"), ("output", "F")].map(|(declaration, read)| {
            let position = if title.contains("library") { "s.body.x" } else { "x" };
            let read = if read == "x" { format!("expect max({position}) > 0 m") } else { "expect max(F) > 0 N".into() };
            let model = text.replace("OUTPUT", declaration);
            let text =
                format!("{model}\nexperiment e {{\n  run Top() for 2 s\n  solver euler step 10 us\n  {read}\n}}\n");
            let mut loaded = compiler::load("outputs.fric", &text, &project::Disk);
            let options = compiler::Options::default();
            let made = compiler::compile(&mut loaded, &project::Disk, "e", &options, &mut Vec::new(), &mut |_| ());
            made.unwrap_or_else(|found| panic!("{found:?}\n{text}")).remove(0)
        });
        let mut times = [const { Vec::new() }; 3];
        for _ in 0..21 {
            for (case, times) in cases.iter().zip(&mut times) {
                let begun = Instant::now();
                let outcome = run(case.instance.clone(), &case.experiment, &mut |_| Continue::Continue(()));
                let steps = outcome.expect("it runs").work.steps;
                times.push(begun.elapsed().as_secs_f64() / steps as f64 * 1e9);
            }
        }
        let [without, unread, read] = times.map(median);
        println!(
            "  {title}: without the output {without:.1}; with it, measuring the position {unread:.1}, {:.3}; measuring it {read:.1}, {:.3}",
            unread / without,
            read / without
        );
    }
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}
