//! Packages and their deployment: reproducible builds, refusal of changed bits, deployment over a real sshd on this
//! machine, rollback, running, bit-identical replay of the recording, and the chain of identification that ends there.

#[path = "../support/debian.rs"]
mod debian;
#[path = "../agreement/emulator.rs"]
mod emulator;
#[path = "../support/fric_rig.rs"]
mod fric_rig;
mod chain;
mod fuzz;
mod package;
mod ssh;
mod trust;

use fric_rig::FRIC_RIG;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// A rig on a simulated bus: it needs no hardware and arms itself.
const RIG: &str = r#"
import std.friction
import std.control
import std.plant

rig rtfs {
  run rotary Servo(
        r   = step(0 s, 1 rad),
        m   = 0.012 kg·m^2,
        pid = rotary PIDDiscrete(Kp = 1.2 N·m/rad, Ti = 0.2 s, Td = 80 ms,
                                 N = 10, u_max = 2 N·m, Ts = 1 ms),
        fr  = rotary LuGre(sigma0 = 260 N·m/rad, sigma1 = 1.2 N·m·s/rad,
                           sigma2 = 0.018 N·m·s/rad, Fc = 0.28 N·m,
                           Fs = 0.42 N·m, vs = 0.01 rad/s, vd = 0.1 rad/s))
  rate     1 ms
  bus      can0  = BUS
  drive    load  = cia402(can0, node = 3, T_rated = 4 N·m, mode = torque,
                          count = 1 rev / 262144, speed_unit = 0.01 rpm,
                          delay = 0.8 ms, lag = 0.6 ms, timeout = 3 ms)
  drive    servo = cia402(can0, node = 4, T_rated = 4 N·m, mode = torque,
                          count = 1 rev / 262144, speed_unit = 0.01 rpm,
                          delay = 0.8 ms, lag = 0.6 ms, timeout = 3 ms)
  hardware body {
    servo.torque = F_motor         limit -2 N·m .. 2 N·m
    load.torque  = -F_load         limit -1 N·m .. 1 N·m  slew 200 N·m/s
    v            = load.speed
    x            = servo.position
  }
  watchdog 50 ms
  overrun  hold 20
  safe     load.torque = 0 N·m, servo.torque = 0 N·m
  stop     when abs(body.v) > 150 rad/s, "overspeed"
  record   body.x [deg], fr.F [N·m]
}
"#;

fn text(bus: &str) -> String {
    RIG.replace("BUS", bus)
}

/// The rig at a rate that a busy computer can keep, in real time and over TCP.
fn unhurried(bus: &str) -> String {
    let changes = [
        ("rate     1 ms", "rate     10 ms"),
        ("Ts = 1 ms", "Ts = 10 ms"),
        ("timeout = 3 ms", "timeout = 1 s"),
        ("watchdog 50 ms", "watchdog 5 s"),
        ("hold 20", "hold 100"),
        ("sigma0 = 260 N·m/rad, sigma1 = 1.2", "sigma0 = 2 N·m/rad, sigma1 = 0.05"),
        ("Kp = 1.2 N·m/rad", "Kp = 0.1 N·m/rad"),
    ];
    changes.into_iter().fold(text(bus), |rig, (from, to)| {
        assert!(rig.contains(from), "{from}");
        rig.replace(from, to)
    })
}

/// A folder for one test, empty at its start.
fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("deploy-{name}"));
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).unwrap();
    path
}

fn fric(folder: &Path, args: &[&str]) -> Output {
    // Keys created on first use belong to the test.
    let config = folder.join("config");
    Command::new(env!("CARGO_BIN_EXE_fric"))
        .current_dir(folder)
        .args(args)
        .env("XDG_CONFIG_HOME", config)
        .output()
        .unwrap()
}

fn said(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

#[track_caller]
fn fine(folder: &Path, args: &[&str]) -> String {
    let output = fric(folder, args);
    assert!(output.status.success(), "fric {args:?}\n{}", said(&output));
    said(&output)
}

#[track_caller]
fn fails(folder: &Path, args: &[&str], why: &str) {
    let output = fric(folder, args);
    let told = said(&output);
    assert!(output.status.code() == Some(1) && told.contains(why), "fric {args:?}\n{told}");
}
