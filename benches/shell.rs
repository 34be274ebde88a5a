//! From the shell to the answer: whole commands, from the start of their process to its end, by wall clock, each with
//! the stages that it reports itself and with the ratio to the same work in a warm process; and a single adaptive run
//! whose code is new against the same run with its code made. Needs an idle machine. Run with
//! `cargo bench --bench shell`; a word in the arguments selects commands by their names.

mod clock;

#[path = "../src/project.rs"]
#[allow(dead_code, unused_imports, reason = "the command uses more of it")]
mod project;

mod compile {
    pub use compiler::Sources;
}

use clock::processor_time;
use compiler::{Case, Changes, Options};
use runtime::engine::{self, Continue};
use std::hint::black_box;
use std::io::{Read, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

const ROUNDS: usize = 41;

/// A text of ten lines with a friction model of the library.
const TEN_LINES: &str = "import std.friction

/// A mass on a rough plane.
model Sled {
  input  F [N] = 2 N
  state  v [m/s] = 0
  part   fr = LuGre(v = v)
  dv/dt = (F - fr.F) / 1 kg
  output slip [m/s] = v
}
";

/// Wall time in s of each round, ascending, and the output of the last.
struct Timed {
    walls: Vec<f64>,
    errors: String,
}

impl Timed {
    fn median(&self) -> f64 {
        self.walls[self.walls.len() / 2]
    }
}

/// Times a command that gets this input.
fn timed(arguments: &[&str], folder: &Path, input: &str) -> Timed {
    let (mut walls, mut errors) = (Vec::new(), String::new());
    for _ in 0..ROUNDS {
        let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
        command.args(arguments).current_dir(folder).env("HOME", folder);
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let begin = Instant::now();
        let mut child = command.spawn().expect("the command starts");
        child.stdin.take().expect("it is piped").write_all(input.as_bytes()).expect("it reads");
        let output = child.wait_with_output().expect("it ends");
        walls.push(begin.elapsed().as_secs_f64());
        errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{arguments:?}: {errors}");
    }
    walls.sort_by(f64::total_cmp);
    Timed { walls, errors }
}

/// The time until a session on a terminal shows its prompt.
fn prompt(folder: &Path) -> Timed {
    let mut walls = Vec::new();
    for _ in 0..ROUNDS {
        let pair = nix::pty::openpty(None, None).expect("a pseudo-terminal");
        let slave = || Stdio::from(pair.slave.try_clone().expect("it can be copied"));
        let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
        command.current_dir(folder).env("HOME", folder).env("TERM", "xterm");
        command.stdin(slave()).stdout(slave()).stderr(slave());
        let begin = Instant::now();
        let mut child = command.spawn().expect("the session starts");
        let mut master = std::fs::File::from(pair.master.try_clone().expect("it can be copied"));
        let (mut seen, mut part) = (String::new(), [0; 1024]);
        while !seen.contains("> ") {
            let read = master.read(&mut part).expect("the session shows its prompt");
            seen += &String::from_utf8_lossy(&part[..read]);
        }
        walls.push(begin.elapsed().as_secs_f64());
        master.write_all(b"\x04").expect("it reads");
        child.wait().expect("it ends");
    }
    walls.sort_by(f64::total_cmp);
    Timed { walls, errors: String::new() }
}

/// One line for a command, and one for each stage that it reports.
fn told(name: &str, limit_ms: Option<f64>, timed: &Timed, warm_ms: Option<f64>) {
    let ms = 1e3 * timed.median();
    let limit = limit_ms
        .map_or(String::new(), |limit| format!("  limit {limit} ms: {}", if ms <= limit { "held" } else { "MISSED" }));
    let ratio =
        warm_ms.map_or(String::new(), |warm| format!("  {:.1} times the {warm:.2} ms in a warm process", ms / warm));
    println!("{name:<24} {ms:8.2} ms, least {:.2}{limit}{ratio}", 1e3 * timed.walls[0]);
    timed.errors.lines().filter(|line| line.starts_with("  ")).for_each(|line| println!("  {line}"));
}

/// Median milliseconds of work in this process, by a clock in s.
fn in_process(clock: impl Fn() -> f64, work: &mut dyn FnMut()) -> f64 {
    let mut times: Vec<f64> = (0..ROUNDS)
        .map(|_| {
            let begin = clock();
            work();
            1e3 * (clock() - begin)
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

fn compiled(name: &str, text: &str, experiment: &str, changes: Changes, interpret: bool) -> Case {
    let mut loaded = compiler::load(name, text, &project::Disk);
    let options = Options { changes, interpret };
    let mut warnings = Vec::new();
    let cases = compiler::compile(&mut loaded, &project::Disk, experiment, &options, &mut warnings, &mut |_| ());
    cases.map_err(|found| format!("{found:?}")).expect("it compiles").remove(0)
}

fn go(case: &Case) -> u64 {
    let outcome = engine::run(case.instance.clone(), &case.experiment, &mut |_| Continue::Continue(()));
    outcome.map_err(|failure| failure.to_string()).expect("it runs").work.steps
}

/// LuGre friction on a mass that a spring pulls.
const PULL: &str = include_str!("adaptive/bristle.fric");

/// A single run: with new code by wall clock, which includes the wait for code and a start of all functions; with its
/// code made and interpreted, in processor time.
fn cold() {
    println!("20 s of stick-slip: a run with new code (limit 3 ms), with its code made, interpreted");
    for tol in [1e-4, 1e-6, 1e-9] {
        let case = |interpret| {
            let changes = Changes { tol: Some(tol), ..Changes::default() };
            compiled("bristle.fric", PULL, "stick_slip", changes, interpret)
        };
        let (mut new, mut steps) = (Vec::new(), 0);
        for _ in 0..ROUNDS {
            let case = case(false);
            let begin = Instant::now();
            steps = go(&case);
            new.push(1e3 * begin.elapsed().as_secs_f64());
            // Code made in the background must not disturb the next round.
            std::thread::sleep(Duration::from_millis(30));
        }
        new.sort_by(f64::total_cmp);
        let (made, interpreted) = (case(false), case(true));
        (0..100).for_each(|_| _ = black_box(go(&made)));
        std::thread::sleep(Duration::from_millis(100));
        let made = in_process(processor_time, &mut || _ = black_box(go(&made)));
        let interpreted = in_process(processor_time, &mut || _ = black_box(go(&interpreted)));
        let new = new[new.len() / 2];
        println!("  tol {tol:.0e}, {steps:5} steps: {new:6.2} ms, {made:6.2} ms, {interpreted:6.2} ms");
    }
}

fn main() {
    let began = Instant::now();
    let warm = |work: &mut dyn FnMut()| in_process(|| began.elapsed().as_secs_f64(), work);
    let wanted: Vec<String> = std::env::args().skip(1).filter(|word| !word.starts_with('-')).collect();
    let wants = |name: &str| wanted.is_empty() || wanted.iter().any(|word| name.contains(word.as_str()));
    let folder = tempfile::tempdir().expect("a folder");
    let at = folder.path();
    std::fs::write(at.join("ten.fric"), TEN_LINES).expect("it can be written");
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/stick-slip/stick_slip.fric");
    let (path, text) = (example.display().to_string(), std::fs::read_to_string(&example).expect("the example"));
    if wants("version") {
        told("fric --version", None, &timed(&["--version"], at, ""), None);
    }
    if wants("check") {
        let check = || {
            let mut loaded = compiler::load("ten.fric", TEN_LINES, &project::Disk);
            black_box(compiler::check(&mut loaded, &project::Disk));
        };
        let warm = warm(&mut { check });
        told("fric check", Some(5.0), &timed(&["check", "--timings", "ten.fric"], at, ""), Some(warm));
    }
    if wants("run") {
        let warm = warm(&mut || {
            black_box(go(&compiled(&path, &text, "stick_slip", Changes::default(), false)));
        });
        let arguments = ["run", "--timings", &path, "stick_slip"];
        told("fric run", Some(25.0), &timed(&arguments, at, ""), Some(warm));
        let arguments = ["run", "--timings", "--no-error", "--json", &path, "stick_slip"];
        told("fric run, bare", None, &timed(&arguments, at, ""), Some(warm));
    }
    if wants("prompt") {
        told("fric, to its prompt", Some(8.0), &prompt(at), None);
        told("fric, 1 mm + 1 m", None, &timed(&[], at, "1 mm + 1 m\n"), None);
    }
    if wants("cold") {
        cold();
    }
}
