//! Replacing a model by another one during a run: states, delayed and sampled quantities continue.

mod support;

use abi::plan::Method;
use abi::{Instance, Slot};
use compiler::{Changes, Options};
use support::Texts;

const ECHO: &str = "
model Echo {
  param  T = 20 ms in 4 ms .. 50 ms
  param  Ts = 4 ms in > 0 s
  state  x [m] = 0
  dx/dt = 1 m/s
  output y [m] = delay(x, T)
  state  n [m] = 0
  every Ts {
    next(n) = n + 1 m
  }
}

experiment echo {
  run Echo() for 1 s
}
";

/// The model in fixed steps of `h` s with some settings, at its start.
fn echo(h: f64, set: &[&str]) -> Instance {
    let sources = Texts::default();
    let mut loaded = compiler::load("echo.fric", ECHO, &sources);
    let set = set.iter().map(|set| set.to_string()).collect();
    let changes = Changes { set, method: Some(Method::Expo), step: Some(h), any_step: true, ..Changes::default() };
    let options = Options { changes, interpret: true };
    let cases = compiler::compile(&mut loaded, &sources, "echo", &options, &mut Vec::new(), &mut |_| ());
    let mut instance = cases.unwrap_or_else(|errors| panic!("{errors:?}")).remove(0).instance;
    assert_eq!(instance.start(h), 0);
    instance
}

fn value(instance: &Instance, path: &str) -> f64 {
    instance.get(instance.description().quantity(path).unwrap().slot)
}

/// Takes over at the same instant.
fn at_its_time(mut new: Instance, old: &Instance, h: f64) -> Instance {
    new.set(Slot::TIME, old.get(Slot::TIME));
    new.set(Slot::COUNT, (old.get(Slot::TIME) / h).round());
    let carried = new.carry(old);
    assert!(carried.fresh.is_empty() && carried.lost.is_empty(), "{carried:?}");
    new
}

#[track_caller]
fn close(a: f64, b: f64) {
    assert!((a - b).abs() < 1e-12, "{a} and {b}");
}

#[test]
fn delayed_quantities_continue_bit_identically() {
    let mut old = echo(1e-3, &[]);
    assert_eq!(old.advance(100), 0);
    let mut new = at_its_time(echo(1e-3, &[]), &old, 1e-3);
    for _ in 0..60 {
        assert_eq!([old.advance(1), new.advance(1)], [0, 0]);
        assert_eq!(old.block(), new.block());
    }
}

#[test]
fn another_step_and_another_dead_time_read_the_same_past() {
    let mut old = echo(1e-3, &[]);
    assert_eq!(old.advance(100), 0);
    for h in [0.5e-3, 2e-3] {
        let mut new = at_its_time(echo(h, &["T = 30 ms"]), &old, h);
        // Dead time and history take effect at once: x moves 1 m in a second.
        for k in 1..=40 {
            assert_eq!(new.advance(1), 0);
            close(value(&new, "y"), 0.1 + f64::from(k) * h - 0.03);
        }
    }
}

#[test]
fn a_period_that_was_changed_counts() {
    let mut old = echo(1e-3, &[]);
    assert_eq!(old.advance(100), 0);
    let before = value(&old, "n");
    let mut new = at_its_time(echo(1e-3, &["Ts = 2 ms"]), &old, 1e-3);
    assert_eq!(new.advance(20), 0);
    assert_eq!(value(&new, "n") - before, 10.0);
}

/// If time starts anew, there is no history: that is reported.
#[test]
fn a_lost_history_is_reported() {
    let mut old = echo(1e-3, &[]);
    assert_eq!(old.advance(100), 0);
    let mut new = echo(1e-3, &[]);
    let carried = new.carry(&old);
    assert_eq!(carried.fresh, ["what is delayed"]);
    assert_eq!(carried.kept, ["x", "n"]);
    assert_eq!(new.advance(1), 0);
    close(value(&new, "x"), 0.101);
}
