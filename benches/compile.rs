//! How long a text takes from its first character to its first step, by stage, in a warm process; and how long the whole
//! library takes to be checked. Medians over many rounds; run with `cargo bench --bench compile`.

#[path = "../src/project.rs"]
#[allow(dead_code, unused_imports, reason = "the command uses more of it")]
mod project;

mod compile {
    pub use compiler::Sources;
}

use compiler::{Options, Sources, check, load};
use std::hint::black_box;
use std::time::Instant;

const ROUNDS: usize = 60;

/// The PID servo with LuGre friction, as the library has it.
const SERVO: &str = "import std.interfaces
import std.friction
import std.control
import std.plant

experiment hunting {
  run    Servo(r = 1 m) for 100 s
  solver rk4 step 10 us
  expect peak_to_peak(x) ~= 126.4 mm +- 0.2 mm after 50 s
}
";

fn main() {
    stages();
    library();
}

/// Milliseconds of each stage, in the order in which they ran.
fn stages() {
    let mut all: Vec<(&'static str, Vec<f64>)> = Vec::new();
    for _ in 0..ROUNDS {
        let mut marks: Vec<(&'static str, Instant)> = vec![("parse", Instant::now())];
        let mut loaded = load("servo.fric", SERVO, &project::Disk);
        let (mut warnings, options) = (Vec::new(), Options::default());
        let mut mark = |stage| marks.push((stage, Instant::now()));
        let cases = compiler::compile(&mut loaded, &project::Disk, "hunting", &options, &mut warnings, &mut mark);
        let Ok(mut cases) = cases else { panic!("the servo compiles") };
        marks.push(("first step", Instant::now()));
        let instance = &mut cases[0].instance;
        instance.start(1e-5);
        assert_eq!(instance.advance(1), 0);
        black_box(&instance);
        marks.push(("", Instant::now()));
        for pair in marks.windows(2) {
            let ms = 1e3 * (pair[1].1 - pair[0].1).as_secs_f64();
            match all.iter_mut().find(|(stage, _)| *stage == pair[0].0) {
                Some((_, times)) => times.push(ms),
                None => all.push((pair[0].0, vec![ms])),
            }
        }
    }
    println!("PID servo with LuGre, rk4: from text to first step, the library's texts it imports included");
    let mut sum = 0.0;
    for (stage, times) in &mut all {
        let ms = median(times);
        sum += ms;
        println!("  {stage:<12} {ms:8.3} ms");
    }
    println!("  {:<12} {sum:8.3} ms", "together");
}

fn library() {
    let modules = project::Disk.modules();
    let texts: Vec<(String, String)> =
        modules.iter().filter_map(|module| project::Disk.library(module)).flatten().collect();
    let mut times: Vec<f64> = (0..5)
        .map(|_| {
            let begin = Instant::now();
            for (name, text) in &texts {
                let mut loaded = load(name, text, &project::Disk);
                black_box(check(&mut loaded, &project::Disk));
            }
            1e3 * begin.elapsed().as_secs_f64()
        })
        .collect();
    println!(
        "checking each of the library's {} texts on its own, imports read anew: {:.0} ms",
        texts.len(),
        median(&mut times)
    );
}

fn median(times: &mut [f64]) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}
