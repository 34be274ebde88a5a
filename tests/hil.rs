//! Rigs in operation: the example with simulated drives, its log, its replay, killed processes, and restrictions on a
//! cycle.

#![allow(clippy::disallowed_methods, reason = "tests compare with the platform's functions")]

#[path = "../runtime/src/hil/faults/heap.rs"]
mod heap;
mod support;

use abi::rig::{Kind, Rig, Signal, SignalKind};
use compiler::{Changes, CompiledRig, Options};
use heap::asked;
use runtime::hil::cycle::{End, Hil, Options as HilOptions};
use runtime::hil::simulated::{Pace, World};
use std::fs;
use std::io::{BufRead, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use support::{Texts, root};

/// The example, changed by settings such as `fr = rotary Karnopp()`.
fn ready(set: &[&str]) -> CompiledRig {
    rig_of("rtfs.fric", "rtfs", set)
}

/// A rig from a text beside the example.
fn rig_of(file: &str, rig: &str, set: &[&str]) -> CompiledRig {
    rig_in(file, &fs::read_to_string(root().join("examples/rtfs").join(file)).unwrap(), rig, set)
}

/// A rig from this text, as if it were stored there.
fn rig_in(file: &str, text: &str, rig: &str, set: &[&str]) -> CompiledRig {
    let dbc = fs::read_to_string(root().join("examples/rtfs/shaft.dbc")).unwrap();
    let sources = Texts(vec![("shaft.dbc".into(), dbc)]);
    let mut loaded = compiler::load(file, text, &sources);
    let changes = Changes { set: set.iter().map(|one| (*one).to_string()).collect(), ..Changes::default() };
    let options = Options { changes, ..Options::default() };
    let made = compiler::rig(&mut loaded, &sources, rig, &options, &mut Vec::new());
    made.unwrap_or_else(|errors| panic!("{errors:?}"))
}

fn started(ready: CompiledRig, seconds: f64) -> (Hil, World, Rig) {
    let CompiledRig { rig, control, plant, .. } = ready;
    let look = runtime::hil::coupling::look_ahead(&rig, &plant).unwrap();
    let mut world = World::new(&rig, Some(plant), Pace::Fast, 1).unwrap();
    let duration_ns = Some((seconds * 1e9) as u64);
    let options = HilOptions { arms_itself: true, duration_ns, look, ..HilOptions::default() };
    let masters = world.masters();
    let (hil, _) = Hil::new(&rig, control, world.clock(), masters, options, None).unwrap();
    (hil, world, rig)
}

/// True positions of the servo, one per cycle, while the model runs.
fn course(mut hil: Hil, world: &World) -> (Vec<f64>, End) {
    let mut all = Vec::new();
    loop {
        hil.cycle();
        if hil.counts().cycles as usize > all.len() {
            all.push(world.bench().shaft(1).position);
        }
        if let Some(end) = hil.ended() {
            return (all, end.clone());
        }
    }
}

#[test]
fn the_example_hunts_on_simulated_drives_as_it_does_without_them() {
    let (hil, world, _) = started(ready(&[]), 60.0);
    let (x, end) = course(hil, &world);
    assert_eq!(end, End::Asked);
    assert_eq!(x.len(), 60_000);
    let late = &x[40_000..];
    let (least, greatest) = late.iter().fold((f64::MAX, f64::MIN), |(a, b), x| (a.min(*x), b.max(*x)));
    // The SIL run of the example expects about 89 mrad after 40 s.
    assert!(greatest - least > 0.05, "peak to peak {} rad", greatest - least);
    assert!((least + greatest - 2.0).abs() < 0.1, "around 1 rad: {least} .. {greatest}");
}

#[test]
fn another_model_is_put_on_the_shaft() {
    for model in ["fr = rotary Karnopp(Fc = 0.28 N·m, Fs = 0.42 N·m)", "fr = rotary KFM(Fc = 0.28 N·m, Fs = 0.42 N·m)"]
    {
        let (hil, world, _) = started(ready(&[model]), 10.0);
        let (x, end) = course(hil, &world);
        assert_eq!(end, End::Asked, "{model}");
        assert!(x.iter().any(|x| *x > 0.8), "{model}: it moved");
    }
}

/// The recorded signals of a rig and its readings, one row per cycle, while the model runs.
fn recorded(ready: CompiledRig, seconds: f64, signals: &[Signal]) -> Vec<(Vec<f64>, Vec<f64>)> {
    let mut world = World::new(&ready.rig, Some(ready.plant), Pace::Fast, 1).unwrap();
    let mut options =
        HilOptions { arms_itself: true, duration_ns: Some((seconds * 1e9) as u64), ..HilOptions::default() };
    options.start.sign_test = runtime::drive::polarity_check::SignTest::Skip;
    let masters = world.masters();
    let (mut hil, _) = Hil::new(&ready.rig, ready.control, world.clock(), masters, options, None).unwrap();
    let mut rows = Vec::new();
    loop {
        hil.cycle();
        if hil.counts().cycles as usize > rows.len() {
            let model = hil.control().unwrap().model();
            let series = ready.rig.record.iter().map(|series| model.get(series.slot)).collect();
            let read = signals.iter().map(|signal| hil.fieldbus().reading(*signal).value).collect();
            rows.push((series, read));
        }
        if let Some(end) = hil.ended() {
            assert_eq!(*end, End::Asked);
            return rows;
        }
    }
}

/// F(v) as the load drive applies it, against LuGre's own: g(v) sgn(v) + σ1 exp(−(v/vd)²) … + σ2 v for slow rotation.
#[test]
fn the_characteristic_measured_on_the_rig_is_that_of_the_model() {
    let torque = Signal { node: 0, what: SignalKind::Torque };
    let speed = Signal { node: 0, what: SignalKind::Speed };
    let rows = recorded(rig_of("characteristics.fric", "characteristic", &[]), 40.0, &[speed, torque]);
    assert_eq!(rows.len(), 40_000);
    let (mut worst, mut compared) = (0f64, 0);
    for (_, read) in &rows[10_000..] {
        let (v, friction) = (read[0], -read[1]);
        // After a reversal the bristles move from one side to the other within 2 z = 3 mrad: at 0.157 rad/s² that is
        // over, several times, when 0.05 rad/s is reached.
        if v.abs() < 0.05 {
            continue;
        }
        let g = 0.28 + (0.42 - 0.28) * (-(v / 0.01f64).powi(2)).exp();
        let own = g * v.signum() + 0.018 * v;
        worst = worst.max((friction - own).abs() / own.abs());
        compared += 1;
    }
    assert!(compared > 20_000, "{compared}");
    assert!(worst < 0.02, "measured and own friction differ by up to {} %", 100.0 * worst);
    // T_friction against T_ref: the drive reports the commanded torque, except for its resolution of 4 mN·m and its
    // lag.
    let apart = rows[10_000..].iter().map(|(series, read)| (series[1] + read[1]).powi(2)).sum::<f64>();
    let rms = (apart / 30_000.0).sqrt();
    assert!(rms < 0.02, "{rms} N·m between asked and applied");
}

#[test]
fn an_observer_of_the_friction_makes_the_servo_follow() {
    let rms = |share: &str| {
        let rows = recorded(rig_of("characteristics.fric", "tracking", &[share]), 15.0, &[]);
        let squares: f64 = rows[5_000..].iter().map(|(series, _)| series[0].powi(2)).sum();
        (squares / 10_000.0).sqrt()
    };
    let (with, without) = (rms("share = 1"), rms("share = 0"));
    assert!(without > 0.05, "{without} rad without it");
    assert!(with < without / 50.0, "{with} rad with it, {without} without");
}

/// The rig of `stick_slip.fric` with the contact itself on its shaft: the reference for a drive that emulates the
/// contact. The servo pulls as in the rig, with the same delay and the same encoder; the load drive applies no torque.
const UNBROKEN: &str = "
model Rubbed {
  input  F_motor [N]
  input  F_load [N]
  part   fr : Friction = LuGre(v = mass.v)
  part   mass          = Axis(m = 1 kg, F_motor = F_motor, F_load = fr.F + F_load)
  output v [m/s] = mass.v
  output x [m]   = mass.x
  output F [N]   = fr.F
}
model Unbroken {
  param  k  = 2 N/m       in > 0
  param  vp = 0.1 m/s     in >= 0
  part   block = Rubbed(F_motor = k * (vp * t - block.x), F_load = 0 N)
}
device Gauge { read F [N·m] = 0 N·m  at 0x7F0  byte 0  as f32 }
rig unbroken {
  run      rotary Unbroken()
  rate     1 ms
  bus      can0  = can(\"can0\", 1 Mbit/s)
  drive    load  = cia402(can0, node = 3, T_rated = 0.5 N·m, T_max = 2 N·m, mode = torque,
                          count = 1 rev / 6283185, speed_unit = 0.0001 rpm, speed_max = 50 rad/s,
                          delay = 2 ms, lag = 0.3183 ms)
  drive    servo = cia402(can0, node = 4, T_rated = 0.5 N·m, T_max = 2 N·m, mode = torque,
                          count = 1 rev / 6283185, speed_unit = 0.0001 rpm, speed_max = 50 rad/s,
                          delay = 0.8 ms, lag = 0.3183 ms)
  device   gauge = Gauge(can0)
  hardware block {
    servo.torque = F_motor         limit -2 N·m .. 2 N·m
    load.torque  = -F_load         limit -2 N·m .. 2 N·m
    v            = load.speed
    x            = servo.position
    F            = gauge.F
  }
  safe     load.torque = 0 N·m, servo.torque = 0 N·m
  record   block.x [rad]
}
";

/// Torque of the contact on the shaft once per cycle, from the first cycle of the model on, and how often it slipped.
/// `known`: whether the predictor knows the pull.
fn pulled(rig: &str, delay_ms: f64, known: bool) -> (Vec<f64>, u32) {
    let text = fs::read_to_string(root().join("examples/rtfs/stick_slip.fric")).unwrap() + UNBROKEN;
    let made = rig_in("stick_slip.fric", &text, rig, &[&format!("load.delay = {delay_ms} ms")]);
    let mut seen = made.rig.clone();
    if !known {
        seen.plant.applied.retain(|(signal, _)| signal.node == 0);
    }
    let look = runtime::hil::coupling::look_ahead(&seen, &made.plant).unwrap();
    let mut world = World::new(&made.rig, Some(made.plant), Pace::Fast, 1).unwrap();
    let mut options =
        HilOptions { arms_itself: true, duration_ns: Some(20_000_000_000), look, ..HilOptions::default() };
    options.control.ramp_ns = 1;
    // The push of the polarity check would move the block.
    options.start.sign_test = runtime::drive::polarity_check::SignTest::Skip;
    let masters = world.masters();
    let (mut hil, _) = Hil::new(&made.rig, made.control, world.clock(), masters, options, None).unwrap();
    let (mut course, mut slips, mut fast) = (Vec::new(), 0, false);
    loop {
        hil.cycle();
        if hil.counts().cycles as usize > course.len() {
            let bench = world.bench();
            let shaft = bench.shaft(0);
            let gauge = made.rig.nodes.iter().position(|node| node.name == "gauge");
            course.push(gauge.and_then(|node| bench.value(node, 0, 0)).unwrap_or(-shaft.torque));
            slips += u32::from(shaft.speed > 0.1 && !fast);
            fast = if fast { shaft.speed > 0.01 } else { shaft.speed > 0.1 };
        }
        if let Some(end) = hil.ended() {
            assert_eq!(*end, End::Asked);
            return (course, slips);
        }
    }
}

/// The effect of a late drive on stick-slip, and the improvement by the predictor: rms error of the friction in % of
/// F_C. 2 ms in the test suite; `FRIC_TABLE=1` prints the table of docs/prediction.md.
#[test]
fn friction_is_right_at_2_ms_of_delay_when_commands_look_ahead() {
    let (own, slips) = pulled("unbroken", 2.0, true);
    assert_eq!(slips, 2, "the contact itself slips twice in 20 s");
    let error = |course: &[f64]| {
        let squares: f64 = course.iter().zip(&own).map(|(a, b)| (a - b).powi(2)).sum();
        100.0 * (squares / course.len() as f64).sqrt()
    };
    let whole = std::env::var_os("FRIC_TABLE").is_some();
    let delays: &[f64] = if whole { &[0.7, 1.0, 1.5, 2.0, 3.0, 4.5] } else { &[2.0] };
    for delay in delays {
        let [plain, known, unknown] = [("plain", true), ("ahead", true), ("ahead", false)].map(|(rig, known)| {
            let (course, slips) = pulled(rig, *delay, known);
            (error(&course), slips)
        });
        println!("{delay} ms  plain {plain:.2?}  pull told {known:.2?}  pull unknown {unknown:.2?}");
        if *delay == 2.0 {
            assert!(plain.0 > 20.0, "plain: {plain:?}");
            assert!(known.0 <= 1.0 && known.1 == 2, "{known:?}");
            assert!(unknown.0 <= 1.0 && unknown.1 == 2, "{unknown:?}");
        }
    }
}

/// The limit that `fric predict` computes from the compiled step is where the rig begins to chatter, within 5 %.
#[test]
fn the_predicted_limit_is_where_the_simulated_rig_begins_to_chatter() {
    let folder = folder("hil-onset");
    let text = root().join("examples/rtfs/stick_slip.fric").display().to_string();
    let said = run(&folder, &["predict", "--json", "--rig", "plain", "--set", "load.delay=1ms", &text], 0);
    let number = |after: &str| -> f64 {
        let from = said.find(after).unwrap_or_else(|| panic!("no {after} in {said}")) + after.len();
        said[from..].split([',', '}']).next().unwrap().parse().unwrap()
    };
    let (tau, margin) = (number("\"tau\":"), number("\"delay_margin\":"));
    // Total delay by the formula: 2.25 ms; for the discrete loop 2.37.
    assert!((tau + margin - 2.37e-3).abs() < 0.03e-3, "{tau} + {margin}");
    // Ripple of the speed while the spring winds up, 3 to 4 s after the start.
    let ripple = |part: f64| {
        let delay_ms = 1.0 + 1e3 * (part * (tau + margin) - tau);
        let (course, _) = pulled("plain", delay_ms, true);
        let held = &course[3000..4000];
        let smooth = held.windows(3).map(|w| (w[0] - 2.0 * w[1] + w[2]).powi(2)).sum::<f64>();
        (smooth / held.len() as f64).sqrt()
    };
    let (below, above) = (ripple(0.95), ripple(1.05));
    // Below the limit, only the noise of the speed's resolution remains.
    assert!(above > 3.0 * below, "ripple of the torque {below} below, {above} N·m above the limit");
}

#[test]
fn a_cycle_does_not_allocate() {
    for made in [ready(&[]), rig_of("stick_slip.fric", "ahead", &[])] {
        let (mut hil, _world, rig) = started(made, 10.0);
        while hil.counts().cycles < 100 {
            hil.cycle();
            assert_eq!(hil.ended(), None);
        }
        let before = asked();
        for _ in 0..2000 {
            hil.cycle();
        }
        assert_eq!(asked() - before, 0, "heap calls in 2,000 cycles of {}, simulated drives included", rig.name);
    }
}

fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).unwrap();
    path
}

fn fric(folder: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
    command.current_dir(folder).args(args).stdin(Stdio::null());
    command
}

#[track_caller]
fn run(folder: &Path, args: &[&str], code: i32) -> String {
    let Output { status, stdout, stderr } = fric(folder, args).output().unwrap();
    let said = format!("{}{}", String::from_utf8_lossy(&stdout), String::from_utf8_lossy(&stderr));
    assert_eq!(status.code(), Some(code), "{args:?}\n{said}");
    said
}

fn example() -> String {
    root().join("examples/rtfs/rtfs.fric").display().to_string()
}

/// The time of the model in the last row of a table of cycles, in s.
fn model_time(csv: &str) -> f64 {
    let (head, rows) = csv.split_once('\n').unwrap();
    let at = head.split(',').position(|name| name == "model t [s]").unwrap();
    rows.lines().last().unwrap().split(',').nth(at).unwrap().parse().unwrap()
}

#[test]
fn a_run_leaves_a_log_that_replays_and_two_equal_runs_leave_equal_logs() {
    let folder = folder("hil-replay");
    let example = example();
    for log in ["a", "b"] {
        run(&folder, &["hil", "--sim", "--fast", "--for", "5s", "--log", log, &example], 0);
    }
    let [a, b] = ["a", "b"].map(|log| fs::read(folder.join(log)).unwrap());
    assert!(a == b, "two equal runs, two logs");
    let said = run(&folder, &["replay", "a", "--csv", "a.csv", "--candump", "a.log"], 0);
    assert!(said.contains("agree to the bit") && said.contains("ended as asked"), "{said}");
    assert!(run(&folder, &["replay", "a", "--interpret"], 0).contains("agree to the bit"), "the other back end");
    let csv = fs::read_to_string(folder.join("a.csv")).unwrap();
    assert!(csv.lines().next().unwrap().contains("load.torque permitted"), "{:?}", csv.lines().next());
    assert!(csv.lines().count() > 5000);
    assert!((model_time(&csv) - 5.0).abs() < 2e-3, "the model ran for 5 s: {}", model_time(&csv));
    let frames = fs::read_to_string(folder.join("a.log")).unwrap();
    assert!(frames.lines().any(|line| line.ends_with(" can0 080#")), "SYNC");
    // A flipped bit and a truncation are detected.
    let mut flipped = a.clone();
    let middle = flipped.len() / 2;
    flipped[middle] ^= 4;
    fs::write(folder.join("flipped"), &flipped).unwrap();
    assert!(run(&folder, &["replay", "flipped"], 1).contains("damaged at byte"));
    fs::write(folder.join("cut"), &a[..middle]).unwrap();
    assert!(run(&folder, &["replay", "cut"], 0).contains("cut off at byte"));
}

#[test]
fn a_contact_that_is_too_late_is_refused_and_runs_where_it_looks_ahead() {
    let folder = folder("hil-stability");
    let text = root().join("examples/rtfs/stick_slip.fric").display().to_string();
    let said = run(&folder, &["predict", "--rig", "plain", &text], 1);
    assert!(said.contains("UNSTABLE") && !said.contains("inf") && !said.contains("NaN"), "{said}");
    let said = run(&folder, &["predict", "--rig", "ahead", &text], 0);
    assert!(said.lines().any(|line| line.starts_with("look ahead  load") && line.ends_with("  stable")), "{said}");
    let said = run(&folder, &["hil", "--sim", "--fast", "--for", "1s", &text, "plain"], 1);
    assert!(said.contains("refused: the contact that `load` plays is not stable"), "{said}");
    assert!(said.contains("--accept-unstable"), "{said}");
    assert!(!folder.join("out/plain.friclog").exists(), "nothing was started");
    let daring = ["hil", "--sim", "--fast", "--for", "2s", "--accept-unstable", &text, "plain"];
    let said = run(&folder, &daring, 0);
    assert!(said.contains("of the stored energy came back"), "{said}");
    let said = run(&folder, &["hil", "--sim", "--fast", "--for", "5s", &text, "ahead"], 0);
    assert!(said.contains("0 cycles did not look ahead"), "{said}");
    assert!(run(&folder, &["replay", "out/ahead.friclog"], 0).contains("agree to the bit"));
}

#[test]
fn the_cause_of_a_stop_is_reported_with_exit_code_3() {
    let folder = folder("hil-stops");
    let example = example();
    let stops = |fault: &str| run(&folder, &["hil", "--sim", "--fast", "--for", "20s", "--inject", fault, &example], 3);
    assert!(stops("panel.enable = 0 at 8 s").contains("enabling switch released"));
    assert!(stops("load fault 0x2310 at 8 s").contains("load (node 3)"));
    let said = run(&folder, &["replay", "out/rtfs.friclog"], 0);
    assert!(said.contains("agree to the bit") && said.contains("stopped: load (node 3)"), "{said}");
    // A time of the run is one of the model.
    for at in [0.5, 2.25, 6.0] {
        assert!(stops(&format!("load fault 0x2310 at {at} s of run")).contains("load (node 3)"));
        run(&folder, &["replay", "out/rtfs.friclog", "--csv", "fault.csv"], 0);
        let ended = model_time(&fs::read_to_string(folder.join("fault.csv")).unwrap());
        assert!((at..at + 0.02).contains(&ended), "a fault at {at} s of the model ended it at {ended} s");
    }
    let no_log = ["hil", "--sim", "--fast", "--for", "20s", "--no-log", "--inject", "servo silent at 14 s", &example];
    run(&folder, &no_log, 3);
    let said = run(&folder, &["replay", "out/rtfs.blackbox.friclog"], 0);
    assert!(said.contains("agree to the bit"), "{said}");
}

#[test]
fn drive_properties_are_identified() {
    let folder = folder("hil-identify");
    let said = run(&folder, &["hil", "--sim", "--fast", "--identify", &example()], 0);
    let line = said.lines().find(|line| line.contains("drive load")).unwrap_or_else(|| panic!("{said}"));
    let number = |after: &str| -> f64 {
        let rest = &line[line.find(after).unwrap() + after.len()..];
        rest.trim_start().split(' ').next().unwrap().parse().unwrap()
    };
    // 0.8 and 0.6 ms in the text of the rig; a command takes about 0.1 ms on the bus.
    assert!((0.6..1.1).contains(&number("delay =")), "{line}");
    assert!((0.5..0.7).contains(&number("lag =")), "{line}");
    assert!((0.011..0.013).contains(&number("inertia")), "{line}");
}

#[test]
fn wrong_usage_is_reported() {
    let folder = folder("hil-usage");
    let example = example();
    let said = run(&folder, &["hil", &example], 1);
    assert!(said.contains("can0") && said.contains("--sim"), "{said}");
    let said = run(&folder, &["hil", "--fast", &example], 2);
    assert!(said.contains("--fast needs --sim"), "{said}");
    let said = run(&folder, &["hil", "--sim", "--fast", &example], 2);
    assert!(said.contains("--fast needs --for"), "{said}");
    assert!(!folder.join("out").exists(), "nothing was written");
    let said = run(&folder, &["hil", "--sim", "--bus", "can1=sim:x", &example], 2);
    assert!(said.contains("no bus `can1`; it has can0"), "{said}");
    let said = run(&folder, &["hil", "--sim", "--inject", "load explodes at 3 s", &example], 2);
    assert!(said.contains("load explodes"), "{said}");
    let said = run(&folder, &["hil", "--sim", &example, "rtsf"], 1);
    assert!(said.contains("did you mean `rtfs`?"), "{said}");
    let said = run(&folder, &["replay", &example], 1);
    assert!(said.contains("not a log of fric"), "{said}");
}

const FRAMED: &str = "\
import std.friction
import std.plant

device Drive {
  param node = 5 in 1 .. 127
  send torque   [N·m]   = 0 at 0x200 + node byte 0 as i16 scale 1 mN·m
  read speed    [rad/s] = 0 at 0x180 + node byte 0 as i32 scale 0.001 rpm
  read position [rad]   = 0 at 0x280 + node byte 0 as i32 scale 1 rev / 262144
}

rig bench {
  run      rotary Servo(fr = rotary LuGre(sigma0 = 260 N·m/rad, sigma1 = 1.2 N·m·s/rad,
                                     sigma2 = 0.018 N·m·s/rad, vs = 0.01 rad/s),
                m = 0.012 kg·m^2)
  rate     10 ms
  bus      can0  = can(\"can0\", 1 Mbit/s)
  drive    load  = Drive(can0, timeout = 10 s, speed_max = 100 rad/s)
  hardware body {
    load.torque  = F_motor - F_load  limit -2 N·m .. 2 N·m
    v            = load.speed
    x            = load.position
  }
  safe     load.torque = 0 N·m
  allow    no-drive-timeout \"a relay cuts the power when the enabling signal stays away\"
}
";

/// A drive described by frames identifies itself by nothing: it cannot prove to be simulated.
#[test]
fn options_for_simulated_drives_are_refused_to_a_drive_that_proves_nothing() {
    let folder = folder("hil-permissions");
    fs::write(folder.join("framed.fric"), FRAMED).unwrap();
    let mut served = fric(&folder, &["drives", "framed.fric", "--tcp", "0"]);
    let mut served = served.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let mut said = String::new();
    let mut lines = std::io::BufReader::new(served.stderr.take().unwrap());
    lines.read_line(&mut said).unwrap();
    let port = said.split("port ").nth(1).and_then(|rest| rest.split(|c: char| !c.is_ascii_digit()).next());
    let bus = format!("can0=socketcand:127.0.0.1:{}/can0", port.unwrap_or_else(|| panic!("{said}")));
    for option in ["--arm", "--accept-jitter", "--count-overruns", "--accept-unstable"] {
        let mut args = vec!["hil", "framed.fric", "--bus", &bus, option, "--for", "1s", "--no-log"];
        if option != "--accept-unstable" {
            args.push("--accept-unstable");
        }
        let told = fric(&folder, &args).output().unwrap();
        let told = (told.status.code(), String::from_utf8_lossy(&told.stderr).into_owned());
        assert!(told.0 == Some(2) && told.1.contains("`load` has not proved to be one of ours"), "{option}: {told:?}");
    }
    served.kill().unwrap();
    served.wait().unwrap();
}

/// A real-time run that counts overruns of this machine, once its log exists.
fn under_way(folder: &Path, log: &str) -> std::process::Child {
    let example = example();
    let mut command = fric(folder, &["hil", "--sim", "--count-overruns", "--roll", "40kB", "--log", log, &example]);
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    while !folder.join(log).exists() {
        std::thread::sleep(Duration::from_millis(20));
        assert!(child.try_wait().unwrap().is_none(), "it ended by itself");
    }
    child
}

#[test]
fn control_c_is_a_controlled_stop() {
    let folder = folder("hil-interrupt");
    for signal in ["-INT", "-TERM"] {
        let mut child = under_way(&folder, "log");
        std::thread::sleep(Duration::from_millis(1500));
        assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
        assert_eq!(child.wait().unwrap().code(), Some(0), "{signal}");
        let said = run(&folder, &["replay", "log"], 0);
        assert!(said.contains("agree to the bit; it ended as asked"), "{said}");
        fs::remove_file(folder.join("log")).unwrap();
    }
}

#[test]
fn parameters_change_while_it_runs_and_the_log_knows() {
    let folder = folder("hil-set");
    let mut child = under_way(&folder, "log");
    let mut say = |line: &str| {
        std::thread::sleep(Duration::from_millis(700));
        if writeln!(child.stdin.as_mut().unwrap(), "{line}").is_err() {
            let mut said = String::new();
            child.stderr.as_mut().unwrap().read_to_string(&mut said).unwrap();
            panic!("it ended before `{line}`: {said}");
        }
    };
    say("");
    say("set fr.Fs = 0.5 N·m, fr.Fc = 0.3 N·m");
    say("set fr.Fs = -1 N·m");
    say("set fr.Fz = 1 N·m");
    say("set fr.Fs = 1 s");
    say("set fr.vs = 0 rad/s");
    say("set fr.Fs = 0.2 N·m");
    say("set pid.Ts = 1.5 ms");
    say("reset");
    say("show");
    say("stop");
    let output = child.wait_with_output().unwrap();
    let answers = String::from_utf8_lossy(&output.stdout);
    for words in ["  fr.Fs ", " → 0.5 N·m, fr.Fc ", "  fr.Fs = 0.5 N·m", "  fr.Fc = 0.3 N·m"] {
        assert!(answers.contains(words), "no `{words}` in {answers}");
    }
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{said}");
    for words in [
        "E0501: `Fs` is smaller than `Fc`: LuGre requires Fs >= Fc (`fr`)",
        "no parameter `fr.Fz`; did you mean `fr.F",
        "E0101: `fr.Fs` is a",
        "E0502: `vs` of LuGre must be above 0 mrad/s, not 0 mrad/s (`fr.vs`)",
        "only a start reads `pid.Ts`: a period follows from it; start with `--set pid.Ts=1.5 ms`",
        "`reset` is refused: a stop is final",
    ] {
        assert!(said.contains(words), "no `{words}` in {said}");
    }
    let said = run(&folder, &["replay", "log"], 0);
    assert!(said.contains("agree to the bit"), "{said}");
    assert!(said.contains("  set fr.Fs = 0.5 N·m ") && said.contains("  set fr.Fc = 0.3 N·m "), "{said}");
}

/// The stability of a contact is checked with the values of a set as at a start, and before a package is built.
/// `FRIC_SEED` selects other stiffnesses, `FRIC_RUNS` more of them.
#[test]
fn a_set_is_refused_where_a_start_and_a_package_would_be() {
    let folder = folder("hil-set-stability");
    let number = |name: &str, plain| std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(plain);
    let mut chance = runtime::rng::Chance(number("FRIC_SEED", 22));
    let stiffnesses: Vec<String> =
        (0..number("FRIC_RUNS", 4)).map(|_| format!("{:.1} N·m/rad", 10f64.powf(chance.between(2.5, 3.5)))).collect();
    let mut child = under_way(&folder, "log");
    let mut stdin = child.stdin.take().unwrap();
    std::thread::sleep(Duration::from_millis(1500));
    for stiffness in &stiffnesses {
        writeln!(stdin, "set fr.sigma0 = {stiffness}").unwrap();
    }
    // Lines are executed in order: after this one all sets have been answered.
    writeln!(stdin, "set fr.Fz = 1 N·m").unwrap();
    let mut errors = String::new();
    let mut lines = std::io::BufReader::new(child.stderr.take().unwrap()).lines();
    while !errors.contains("fr.Fz") {
        errors += &(lines.next().unwrap_or_else(|| panic!("it ended: {errors}")).unwrap() + "\n");
    }
    writeln!(stdin, "stop").unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(0), "{errors}");
    assert!(run(&folder, &["replay", "log"], 0).contains("agree to the bit"));
    let mut counts = [0; 2];
    for stiffness in &stiffnesses {
        let set = format!("fr.sigma0={stiffness}");
        let refused = |args: &[&str]| {
            let out = fric(&folder, &[args, &["--set", &set, &example()]].concat()).output().unwrap();
            let said = String::from_utf8_lossy(&out.stderr).into_owned();
            match out.status.code() {
                Some(0) => false,
                Some(1) if said.contains("the contact that `load` plays is not stable") => true,
                code => panic!("{set}: {code:?}, {said}"),
            }
        };
        let start = refused(&["hil", "--sim", "--fast", "--for", "5ms", "--no-log"]);
        let package = refused(&["build", "-o", "set.fricpkg"]);
        let set =
            errors.contains(&format!("`set fr.sigma0 = {stiffness}` is refused: the contact that `load` plays is"));
        assert_eq!((set, package), (start, start), "{stiffness}: {errors}");
        counts[usize::from(start)] += 1;
    }
    assert!(number("FRIC_SEED", 22) != 22 || counts.iter().all(|count| *count > 0), "{counts:?}");
}

/// The files of a log, the first one first.
fn parts_of(first: &Path) -> Vec<PathBuf> {
    (1..).map(|number| runtime::record::parts::path(first, number)).take_while(|path| path.exists()).collect()
}

/// The words of a message take 8 bytes each, plus one word: the size of an uncompressed log.
#[test]
fn a_log_takes_a_quarter_of_its_words_goes_on_in_further_files_and_replays_through_them() {
    let folder = folder("hil-roll");
    let hil = ["hil", "--sim", "--fast", "--for", "12s", "--roll", "150kB", "--log"];
    for log in ["a.friclog", "b.friclog"] {
        run(&folder, &[&hil[..], &[log, &example()]].concat(), 0);
    }
    let [a, b] = ["a.friclog", "b.friclog"].map(|log| parts_of(&folder.join(log)));
    assert!(a.len() > 3 && a.len() == b.len(), "{} files", a.len());
    for (a, b) in a.iter().zip(&b) {
        assert!(fs::read(a).unwrap() == fs::read(b).unwrap(), "{} and {} differ", a.display(), b.display());
    }
    let mut reader = runtime::record::log::Reader::open(&a[0]).unwrap();
    let mut words = 0;
    while let Some(message) = reader.message().unwrap() {
        words += message.words.len() + 1;
    }
    let packed: u64 = a.iter().map(|path| fs::metadata(path).unwrap().len()).sum();
    // This includes the heads, with the texts of rig and library in each file.
    assert!(packed * 4 <= 8 * words as u64, "{packed} of {} bytes", 8 * words);
    let cycles = |log: &Path| -> u64 {
        let said = run(&folder, &["replay", log.to_str().unwrap()], 0);
        assert!(said.contains("agree to the bit; "), "{said}");
        assert!(!said.contains("could not be computed"), "{said}");
        said.split(": ").nth(1).unwrap().split(' ').next().unwrap().replace(',', "").parse().unwrap()
    };
    let all = cycles(&a[0]);
    assert!(all > 12_000);
    let alone: Vec<u64> = a.iter().map(|path| cycles(path)).collect();
    assert!(alone.is_sorted_by(|one, next| one > next), "{alone:?}");
    run(
        &folder,
        &[
            "hil",
            "--sim",
            "--fast",
            "--for",
            "12s",
            "--roll",
            "1MB",
            "--keep",
            "400kB",
            "--log",
            "c.friclog",
            &example(),
        ],
        0,
    );
    let size = |path: PathBuf| fs::metadata(path).unwrap().len();
    let left = fs::read_dir(&folder).unwrap().flatten().map(|entry| entry.path());
    let left: u64 = left.filter(|path| path.extension().is_some_and(|ending| ending == "friclog")).map(size).sum();
    assert!(left <= 400_000, "{left} bytes");
}

#[test]
fn simulated_time_without_an_end_is_wrong_usage() {
    let folder = folder("hil-endless");
    assert!(run(&folder, &["hil", "--sim", "--fast", &example()], 2).contains("--fast needs --for"));
    assert!(run(&folder, &["hil", "--sim", "--fast", "--for", "1s", "--roll", "12", &example()], 2).contains("256MB"));
    assert!(!folder.join("out").exists(), "nothing was begun");
}

/// `FRIC_KILLS`: how often; 200 for the full test.
#[test]
fn a_log_of_a_killed_run_lacks_less_than_the_last_second() {
    let folder = folder("hil-kill");
    let kills = std::env::var("FRIC_KILLS").ok().and_then(|text| text.parse().ok()).unwrap_or(4);
    let now = || SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs_f64();
    for kill in 0..kills {
        let log = format!("killed-{kill}");
        let mut child = under_way(&folder, &log);
        let path = folder.join(&log);
        std::thread::sleep(Duration::from_millis(1500 + 97 * kill % 1000));
        let killed = now();
        child.kill().unwrap();
        child.wait().unwrap();
        let said = run(&folder, &["replay", &log, "--csv", "killed.csv"], 0);
        assert!(said.contains("agree to the bit"), "{said}");
        // The wall-clock time of the rig's start, and the time since then at which the last cycle of the log was due.
        let started = runtime::record::log::Reader::open(&path).unwrap().head.text("started").unwrap().to_string();
        let started: f64 = started.split(' ').next().unwrap().parse().unwrap();
        let csv = fs::read_to_string(folder.join("killed.csv")).unwrap();
        let due: f64 = csv.lines().last().unwrap().split(',').nth(1).unwrap().parse().unwrap();
        let lost = killed - (started + due);
        assert!(due > 0.5 && lost < 1.0, "kill {kill}: {lost} s lost of {} s", killed - started);
        parts_of(&path).iter().for_each(|path| fs::remove_file(path).unwrap());
    }
}

/// `FRIC_SOAK`: how many cycles; 3,600,000 for the full test.
#[test]
fn a_long_run_misses_nothing_and_its_memory_stays_as_it_is() {
    let cycles = std::env::var("FRIC_SOAK").ok().and_then(|text| text.parse().ok()).unwrap_or(60_000u64);
    let (mut hil, _world, _) = started(ready(&[]), cycles as f64 * 1e-3);
    let resident = || {
        let status = fs::read_to_string("/proc/self/statm").unwrap();
        status.split(' ').nth(1).unwrap().parse::<u64>().unwrap() * 4096
    };
    let mut early = 0;
    let mut calls = 0;
    while hil.ended().is_none() {
        hil.cycle();
        if hil.counts().cycles == cycles / 10 && early == 0 {
            (early, calls) = (resident(), asked());
        }
    }
    assert_eq!(hil.ended(), Some(&End::Asked));
    assert_eq!((hil.counts().cycles, hil.counts().missed), (cycles, 0));
    assert_eq!(asked() - calls, 0, "heap calls");
    let grown = resident().saturating_sub(early);
    assert!(grown < 8 << 20, "{grown} bytes more");
}

#[test]
fn signals_of_the_example_are_named_as_in_its_text() {
    let CompiledRig { rig, .. } = ready(&[]);
    let named = |node, what| runtime::hil::words::signal(&rig, Signal { node, what });
    assert_eq!(named(0, SignalKind::Speed), "load.speed");
    assert!(matches!(rig.nodes[2].kind, Kind::Frames(_)));
    assert_eq!(named(3, SignalKind::Field(0, 0)), "panel.enable");
}

/// A log is a recording: columns by their names, with their units, at the times of the cycles.
#[test]
fn a_log_is_data_of_an_experiment() {
    let folder = folder("hil-data");
    run(&folder, &["hil", "--sim", "--fast", "--for", "2s", "--log", "a.friclog", &example()], 0);
    run(&folder, &["replay", "a.friclog", "--csv", "a.csv"], 0);
    let text = |columns: &str, unit: &str| {
        format!(
            "model Held {{\n  input u [{unit}]\n  output y [{unit}] = u\n}}\n\nexperiment played {{\n  \
             data \"a.friclog\" ({columns})\n  run Held(u = data.u) for 5 s\n  solver rk4 step 1 ms\n  plot y [{unit}]\n}}\n"
        )
    };
    let table = fs::read_to_string(folder.join("a.csv")).unwrap();
    let mut lines = table.lines();
    let headings: Vec<&str> = lines.next().unwrap().split(',').collect();
    let rows: Vec<Vec<&str>> = lines.map(|line| line.split(',').collect()).collect();
    let column = |name: &str| headings.iter().position(|heading| *heading == name).unwrap();
    // A reading, a command, and a quantity under `record`, in a unit that is not SI: the same numbers as in the table.
    for (name, heading, unit) in [
        ("load.speed", "load.speed", "rad/s"),
        ("servo.torque permitted", "servo.torque permitted", "N·m"),
        ("body.v", "body.v [rpm]", "rpm"),
    ] {
        fs::write(folder.join("played.fric"), text(&format!("t = \"t\", u [{unit}] = \"{name}\""), unit)).unwrap();
        run(&folder, &["run", "played.fric", "--data", "played.csv", "--no-error"], 0);
        let played = fs::read_to_string(folder.join("played.csv")).unwrap();
        let played: Vec<(f64, f64)> = played
            .lines()
            .skip(1)
            .map(|line| line.split_once(',').map(|(t, y)| (t.parse().unwrap(), y.parse().unwrap())).unwrap())
            .collect();
        let (t, u) = (column("t [s]"), column(heading));
        let mut compared = 0;
        for row in &rows {
            let [t, u] = [t, u].map(|at| row[at].parse::<f64>().unwrap());
            let near = played.iter().find(|(time, _)| (time - t).abs() < 1e-9);
            if let Some((_, y)) = near {
                assert!((y - u).abs() <= 1e-6 * u.abs().max(1e-3), "{name} at {t} s: {y} and {u}");
                compared += i32::from(u != 0.0);
            }
        }
        assert!(compared > 500, "{name}: {compared} values");
    }
    // Units of the headings count, and what is not there is said.
    fs::write(folder.join("wrong.fric"), text("t = \"t\", u [N] = \"load.speed\"", "N")).unwrap();
    let said = run(&folder, &["check", "wrong.fric"], 1);
    assert!(said.contains("load.speed") && said.contains("rad/s"), "{said}");
    fs::write(folder.join("wrong.fric"), text("t = \"t\", u [N] = \"load.sped\"", "N")).unwrap();
    assert!(run(&folder, &["check", "wrong.fric"], 1).contains("load.sped"));
    let mut bytes = fs::read(folder.join("a.friclog")).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    fs::write(folder.join("a.friclog"), &bytes).unwrap();
    assert!(run(&folder, &["check", "played.fric"], 1).contains("damaged at byte"));
}
