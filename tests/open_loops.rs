//! A loop that `fric linearise --loop` breaks has the gain and the phase that a simulation of the same loop, broken in
//! the text, shows under a sine; and its gain margin is where the simulated closed loop begins to grow.
//!
//! The simulation is independent of the derivatives, of the matrix exponential and of the algebra of the broken loop:
//! the loop is opened by hand, a held sine takes the place of the controller's output, a computation delay is a chain
//! of shift registers, and gain and phase are the Fourier coefficient of what the controller then computes.

#![allow(clippy::disallowed_methods, reason = "a Fourier coefficient is compared within a tolerance")]

#[path = "trust/chance.rs"]
#[allow(dead_code, reason = "other tests use more of it")]
mod chance;

use abi::Instance;
use chance::{Chance, seeds};
use compiler::analysis::linearise::Ports;
use compiler::{Changes, NoSources, Options};
use runtime::coupling::open_loop::{Hybrid, OpenLoop};
use std::f64::consts::TAU;

/// A loop of a controller, a plant and a sensor, with its numbers.
struct Generated {
    models: String,
    /// `m = 0.1 kg, …`: arguments of the plant.
    plant: String,
    sensor: &'static str,
    /// Sample time, s.
    period: f64,
    gain: f64,
    reset: f64,
    /// Computation delay in quarters of the sample time.
    quarters: usize,
}

impl Generated {
    fn of(seed: u64) -> Generated {
        let mut chance = Chance::new(seed);
        let period = chance.decades(1e-4, 1e-2);
        let lag = chance.decades(1.0, 15.0) * period;
        let mass = chance.decades(0.1, 10.0);
        let plant = match chance.below(3) {
            0 => "dv/dt = (u - d * v) / m".to_string(),
            1 => "state w [m/s] = 0\n  dw/dt = (u / d - w) / T\n  dv/dt = (d * w - d * v) / m".to_string(),
            _ => {
                // A second mass on a spring: a resonance.
                "state s [m] = 0\n  state w [m/s] = 0\n  let f = k * s + c * (v - w)\n  ds/dt = v - w\n  \
                 dv/dt = (u - f - d * v) / m\n  dw/dt = (f - d * w) / m"
                    .to_string()
            }
        };
        let resonance = chance.within(0.1, 0.8) / period;
        let stiffness = mass * resonance * resonance / 2.0;
        let damping = 2.0 * chance.within(0.05, 0.3) * mass * resonance / 2.0;
        let models = format!(
            "model Plant {{
  input  u [N]
  param  m = {mass} kg
  param  d = {} N·s/m  in > 0
  param  T = {} s  in > 0
  param  k = {stiffness} N/m
  param  c = {damping} N·s/m
  state  v [m/s] = 0
  {plant}
  allow unused \"some plants need fewer\"
}}
model Sensor {{
  input  u [m/s]
  param  Ts = {period} s
  param  T  = {lag} s  in > 0
  output y [m/s]
  SENSOR
  allow unused \"some sensors need fewer\"
}}
model PI {{
  input  y [m/s]
  param  K  = 1 N·s/m
  param  Ti = 1 s  in > 0
  param  Ts = {period} s
  state  i [N] = 0
  state  old [N] = 0
  output u [N]
  every Ts {{
    let raw = -K * y + i
    u = 0.8 * raw + 0.2 * old
    next(i) = i - Ts * K / Ti * y
    next(old) = u
  }}
}}
model Late {{
  input  u [N]
  param  Ts = {} s
  state  last [N] = 0
  output y [N]
  every Ts {{
    y = last
    next(last) = u
  }}
}}
model Held {{
  input  u [N]
  param  Ts = {period} s
  output y [N]
  every Ts {{ y = u }}
}}
",
            mass / lag,
            chance.decades(0.5, 5.0) * period,
            period / 4.0,
        );
        let sensor = chance.of(&[
            "y = u",
            "state f [m/s] = 0\n  df/dt = (u - f) / (0.3 * T)\n  y = f",
            "every Ts { y = u }",
            "every 0.5 * Ts { y = u }",
            "state before [m/s] = 0\n  every 0.25 * Ts {\n    y = 0.5 * (u + before)\n    next(before) = u\n  }",
        ]);
        let gain = chance.decades(0.02, 0.6) * mass / period;
        Generated {
            models: models.replace("SENSOR", sensor),
            plant: String::new(),
            sensor,
            period,
            gain,
            reset: chance.decades(5.0, 200.0) * period,
            quarters: if chance.below(2) == 0 { 0 } else { chance.below(10) },
        }
    }

    /// The whole loop; the plant reads `source` through the shift registers.
    fn text(&self, gain: f64, source: &str, registers: usize) -> String {
        let mut chain = String::new();
        let mut last = source.to_string();
        for k in 0..registers {
            chain += &format!("  part late{k} = Late(u = {last})\n");
            last = format!("late{k}.y");
        }
        format!(
            "{}model Whole {{
  part wave = Held(u = WAVE)
{chain}  part plant = Plant(u = {last}{})
  part sensor = Sensor(u = plant.v)
  part ctl = PI(y = sensor.y, K = {gain} N·s/m, Ti = {} s)
  output u [N] = ctl.u
}}
",
            self.models, self.plant, self.reset
        )
    }

    fn instance(&self, text: &str) -> Instance {
        let text = format!(
            "{text}experiment it {{ run Whole() for {} s  solver rk4 step {} s }}\n",
            self.period * 100.0,
            self.period / 16.0
        );
        let mut loaded = compiler::load("loop.fric", &text, &NoSources);
        let options = Options { changes: Changes { any_step: true, ..Changes::default() }, interpret: false };
        let cases = compiler::compile(&mut loaded, &NoSources, "it", &options, &mut Vec::new(), &mut |_| ());
        let mut instance = cases.unwrap_or_else(|found| panic!("{found:?}\n{text}")).remove(0).instance;
        assert_eq!(instance.start(self.period / 16.0), 0);
        instance
    }

    /// The values of the controller's output in so many periods.
    fn simulated(&self, text: &str, periods: usize) -> Vec<f64> {
        let mut instance = self.instance(text);
        let slot = instance.description().quantity("u").expect("it is an output").slot;
        let mut stopped = false;
        (0..periods)
            .map(|_| {
                let value = if stopped { f64::INFINITY } else { instance.get(slot) };
                stopped = stopped || instance.advance(16) != 0;
                value
            })
            .collect()
    }

    fn broken(&self, gain: f64) -> OpenLoop {
        let text = self.text(gain, "ctl.u", 0).replace("WAVE", "0 N");
        let mut loaded = compiler::load("loop.fric", &text, &NoSources);
        let ports = Ports { broken: Some("ctl.u".into()), ..Ports::default() };
        let options = Options { changes: Changes { ports: Some(ports), ..Changes::default() }, interpret: false };
        let linear = compiler::linear(&mut loaded, &NoSources, "Whole", &options, &mut Vec::new());
        let mut linear = linear.unwrap_or_else(|found| panic!("{found:?}\n{text}"));
        linear.instance.start(0.0);
        let found = linear.loop_at().expect("it is broken");
        let hybrid = Hybrid {
            states: found.states,
            memory: found.memory,
            flow: found.flow,
            output: found.output,
            periods: found.periods,
        };
        let delay = self.quarters as f64 * self.period / 4.0;
        hybrid.open(delay, &mut |due| linear.tick_at(due).expect("it has ticks")).expect("it has a loop")
    }
}

/// Periods until a transient has decayed.
const SETTLED: usize = 3000;
/// Periods in which gain and phase are measured.
const MEASURED: usize = 600;

#[test]
fn a_broken_loop_responds_like_a_simulated_one() {
    let mut seen = 0;
    for seed in seeds(40) {
        let case = Generated::of(seed);
        let open = case.broken(case.gain);
        assert!((open.period.unwrap() / case.period - 1.0).abs() < 1e-12);
        let mut chance = Chance::new(seed + 1_000_000);
        for _ in 0..2 {
            // Whole turns in the time measured.
            let turns = chance.decades(3.0, 0.45 * MEASURED as f64).floor();
            let frequency = turns / (MEASURED as f64 * case.period);
            let wave = format!("sine(1 N, {frequency:e} Hz)");
            let text = case.text(case.gain, "wave.y", case.quarters).replace("WAVE", &wave);
            let values = case.simulated(&text, SETTLED + MEASURED);
            let (mut re, mut im) = (0.0, 0.0);
            for (k, value) in values.iter().enumerate().skip(SETTLED) {
                let angle = TAU * frequency * k as f64 * case.period;
                re += value * angle.sin();
                im += value * angle.cos();
            }
            // u(k) = sin(ωkT), y(k) = a sin(ωkT) + b cos(ωkT): Y/U = a + jb, and L = −Y/U.
            let (re, im) = (-2.0 * re / MEASURED as f64, -2.0 * im / MEASURED as f64);
            let found = open.response(TAU * frequency);
            let (size, away) = (re.hypot(im), (found.re - re).hypot(found.im - im));
            assert!(
                away <= 2e-5 * size + 1e-7,
                "seed {seed}, {frequency} Hz: {found} is not {re} + {im}i; {} quarters, {}\n{text}",
                case.quarters,
                case.sensor
            );
            seen += 1;
        }
    }
    println!("{seen} responses agree");
}

#[test]
fn the_gain_margin_is_where_a_simulated_loop_begins_to_grow() {
    let (mut seen, mut without) = (0, 0);
    for seed in seeds(40) {
        let case = Generated::of(seed);
        let open = case.broken(case.gain);
        let margins = open.margins(&open.bode().unwrap()).unwrap();
        let Some(limit) = margins.gain.filter(|_| margins.stable) else {
            without += 1;
            continue;
        };
        for (share, grows) in [(0.9, false), (1.1, true)] {
            let gain = share * limit.value * case.gain;
            let text = case.text(gain, "ctl.u + wave.y", case.quarters).replace("WAVE", "pulse(0 s, 1 us, 1 N)");
            let values = case.simulated(&text, 4000);
            let most = |part: &[f64]| part.iter().fold(0.0f64, |most, value| most.max(value.abs()));
            let (early, late) = (most(&values[500..1000]), most(&values[3000..]));
            assert_eq!(
                late > early || late.is_infinite(),
                grows,
                "seed {seed}, {share} of {limit:?}: {early} to {late}\n{text}"
            );
            assert_eq!(case.broken(gain).margins(&case.broken(gain).bode().unwrap()).unwrap().stable, !grows);
        }
        seen += 1;
    }
    assert!(seen >= without, "{seen} loops have a gain margin, {without} have none or are unstable");
}

/// The command: margins in words and as JSON, the diagram in its forms, and the reasons why there is no loop.
const AXIS: &str = "import std.control
import std.plant
import std.friction

model Loop {
  param  goal = 10 mm
  part   enc  = Encoder(x = body.x, count = 1 um, Ts = 0.5 ms)
  part   ctl  = CascadeDiscrete(r = goal, y = enc.y, v = enc.v, Kx = 40 1/s, Kv = 60 N·s/m, Tv = 0.05 s, Ts = 1 ms)
  part   body = Axis(F_motor = ctl.u, F_load = 2 N·s/m * body.v, m = 0.5 kg)
}
model Outer {
  param  goal = 10 mm
  state  demand [m/s] = 0
  output u [N]
  every 4 ms { next(demand) = 40 1/s * (goal - body.x) }
  every 1 ms { u = 60 N·s/m * (demand - body.v) }
  part   body = Axis(F_motor = u, m = 0.5 kg)
}
model Hanging {
  input  u [N] = 3 N
  state  x [m] = 0
  state  v [m/s] = 0
  let    pull = 2 N/m * x + 1 N·s/m * v
  dx/dt = v
  dv/dt = (u - pull) / 1 kg
}
experiment move { run Loop() for 0.3 s  plot body.x }
";

fn fric(args: &[&str], code: i32) -> (String, String) {
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("open_loops");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("axis.fric"), AXIS).unwrap();
    let out = std::process::Command::new(env!("CARGO_BIN_EXE_fric"))
        .args(args)
        .current_dir(&folder)
        .env("NO_COLOR", "1")
        .output()
        .unwrap();
    let texts = [out.stdout, out.stderr].map(|bytes| String::from_utf8(bytes).unwrap());
    assert_eq!(out.status.code(), Some(code), "{args:?}: {texts:?}");
    let [out, err] = texts;
    (out, err)
}

#[test]
fn the_command_reports_margins_and_draws_them() {
    let at = ["linearise", "axis.fric", "move", "--time", "0.2s", "--loop", "ctl.u"];
    let with = |more: &[&'static str]| [&at[..], more].concat();
    let (out, _) = fric(&with(&["--margins", "--bode", "b.svg"]), 0);
    for words in ["computed every 1 ms and held", "a staircase (floor)", "phase margin", "is stable", "wrote b.svg"] {
        assert!(out.contains(words), "{words}: {out}");
    }
    assert!(!out.contains("pole of z"), "{out}");
    let (out, _) = fric(&with(&[]), 0);
    assert!(out.contains("pole of z") && out.contains("gain margin"), "{out}");
    let object =
        |more: &[&'static str]| -> serde_json::Value { serde_json::from_str(fric(&with(more), 0).0.trim()).unwrap() };
    let (early, late) = (object(&["--json"]), object(&["--json", "--delay", "0.5ms"]));
    let phase = |object: &serde_json::Value| object["phase_margin"]["value"].as_f64().unwrap();
    let frequency = early["phase_margin"]["frequency"].as_f64().unwrap();
    // A delay well below the period of the crossing turns L by −360° f d there.
    let turned = 360.0 * frequency * 0.5e-3;
    assert!((phase(&early) - phase(&late) - turned).abs() < 0.1, "{} {} {turned}", phase(&early), phase(&late));
    assert_eq!((&early["period"], &early["stable"]), (&serde_json::json!(0.001), &serde_json::json!(true)));
    fric(&with(&["--bode", "b.csv", "--out", "loop.npz"]), 0);
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("open_loops");
    let table = std::fs::read_to_string(folder.join("b.csv")).unwrap();
    let mut rows = table.lines();
    assert_eq!(rows.next(), Some("f [Hz],gain [dB],phase [deg]"));
    let last: Vec<f64> = rows.last().unwrap().split(',').map(|cell| cell.parse().unwrap()).collect();
    assert!((last[0] - 500.0).abs() < 1e-6, "up to half the sampling frequency: {last:?}");
    assert!(std::fs::read(folder.join("loop.npz")).unwrap().starts_with(b"PK"));
    let (_, err) = fric(&with(&["--bode", "b.txt"]), 2);
    assert!(err.contains(".csv"), "{err}");
    fric(&["linearise", "axis.fric", "move", "--margins"], 2);
}

#[test]
fn a_loop_that_cannot_be_broken_says_why() {
    let (_, err) = fric(&["linearise", "axis.fric", "Outer", "--loop", "u"], 1);
    assert!(err.contains("every 1 ms") && err.contains("a block of 4 ms") && err.contains("slower block"), "{err}");
    let (_, err) = fric(&["linearise", "axis.fric", "move", "--time", "0.2s", "--loop", "body.F_load"], 1);
    assert!(err.contains("changes between ticks") || err.contains("every"), "{err}");
    let (_, err) = fric(&["linearise", "axis.fric", "move", "--loop", "body.x"], 1);
    assert!(err.contains("no computed quantity") && err.contains("such as `enc.y`"), "{err}");
    let (_, err) = fric(&["linearise", "axis.fric", "move", "--loop", "ctl.uu"], 1);
    assert!(err.contains("did you mean `ctl.u`?"), "{err}");
    // At the start the controller is at its limit.
    let (_, err) = fric(&["linearise", "axis.fric", "move", "--loop", "ctl.u"], 1);
    assert!(err.contains("no loop passes through it at this point") && err.contains("--time"), "{err}");
}

#[test]
fn a_model_is_linearised_where_it_rests() {
    let (out, _) = fric(&["linearise", "axis.fric", "Hanging", "--rest", "--at", "u=3N", "--json"], 0);
    let object: serde_json::Value = serde_json::from_str(out.trim()).unwrap();
    let x = object["states"][0]["value"].as_f64().unwrap();
    assert!((x - 1.5).abs() < 1e-5, "3 N on 2 N/m: {out}");
    let (out, _) = fric(&["linearise", "axis.fric", "Hanging", "--rest", "--loop", "pull", "--margins"], 0);
    assert!(out.contains("in continuous time") && out.contains("phase margin"), "{out}");
    fric(&["linearise", "axis.fric", "Hanging", "--rest", "--time", "1s"], 2);
}
