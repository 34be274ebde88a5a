//! Whole adaptive runs against closed forms and published figures.

use crate::engine::{Cause, Continue, Failure, Outcome, run};
use crate::testing::models::{self, Contact, Model, adaptive, plot, reading};
use abi::plan::{Experiment, MeasureKind};
use abi::{Function, Instance};

fn go(instance: &Instance, experiment: &Experiment) -> Result<Outcome, Failure> {
    let result = run(instance.clone(), experiment, &mut |_| Continue::Continue(()));
    if let Ok(outcome) = &result {
        println!("{} at tol {:e}: {:?}", instance.description().name, experiment.solver.tol, outcome.work);
    }
    result
}

/// Runs with one measure over the whole run.
fn measured(instance: &Instance, mut experiment: Experiment, kind: MeasureKind, path: &str) -> f64 {
    experiment.expects.push(reading(instance, kind, path));
    value(&go(instance, &experiment).unwrap_or_else(|failure| panic!("{failure}")), 0)
}

fn value(outcome: &Outcome, expect: usize) -> f64 {
    let verdict = &outcome.verdicts[expect];
    assert_eq!(verdict.problem, None);
    verdict.readings[0].value
}

#[test]
fn a_decay_is_as_accurate_as_asked() {
    for tol in [1e-4, 1e-6, 1e-8, 1e-10] {
        let x = measured(&models::decay(), adaptive(3.0, tol), MeasureKind::Final, "x");
        assert!((x - (-3f64).exp()).abs() < tol, "{:e} at {tol:e}", x - (-3f64).exp());
    }
}

#[test]
fn an_oscillator_uses_the_explicit_method_and_its_measures_are_as_accurate_as_its_states() {
    let instance = models::oscillator();
    let mut experiment = adaptive(100.0, 1e-8);
    for kind in [MeasureKind::Max, MeasureKind::Period, MeasureKind::Rms, MeasureKind::Final] {
        experiment.expects.push(reading(&instance, kind, "x"));
    }
    let outcome = go(&instance, &experiment).unwrap();
    assert!((value(&outcome, 0) - 1.0).abs() < 1e-6, "{}", value(&outcome, 0));
    assert!((value(&outcome, 1) / std::f64::consts::TAU - 1.0).abs() < 1e-7, "{}", value(&outcome, 1));
    let rms = (0.5 - 200f64.sin() / 400.0).sqrt();
    assert!((value(&outcome, 2) / rms - 1.0).abs() < 1e-6, "{}", value(&outcome, 2) / rms - 1.0);
    assert!((value(&outcome, 3) - 100f64.sin()).abs() < 2e-6);
    assert!(outcome.work.stiff_steps < outcome.work.steps / 2, "{:?}", outcome.work);
}

/// Van der Pol with μ = 1000, time as in the literature.
fn van_der_pol() -> Instance {
    let mu = 1000.0;
    Model::new("VanDerPol")
        .state("x", "1")
        .state("y", "1")
        .body(Function::Start, |m| m.set_x(0, 2.0))
        .body(Function::Derivatives, move |m| {
            m.set_dx(0, m.x(1));
            m.set_dx(1, mu * (1.0 - m.x(0) * m.x(0)) * m.x(1) - m.x(0));
        })
        .body(Function::Jacobian, move |m| {
            let (x, y) = (m.x(0), m.x(1));
            m.set_jacobian(&[0.0, 1.0, -2.0 * mu * x * y - 1.0, mu * (1.0 - x * x), 0.0, 0.0]);
        })
        .build()
}

#[test]
fn van_der_pol_keeps_the_stiff_method() {
    // Hairer & Wanner's test set, x at t = 2000 with μ = 1000.
    let instance = van_der_pol();
    let mut experiment = adaptive(2000.0, 1e-8);
    experiment.expects.push(reading(&instance, MeasureKind::Final, "x"));
    let outcome = go(&instance, &experiment).unwrap();
    assert!((value(&outcome, 0) - 1.706167732170483).abs() < 1e-5, "{}", value(&outcome, 0));
    assert!(outcome.work.steps < 3000 && outcome.work.stiff_steps > outcome.work.steps / 3);
}

/// A ball dropped from 1 m; at the ground its speed reverses and shrinks by a tenth.
fn ball() -> Instance {
    Model::new("Ball")
        .state("x", "m")
        .state("v", "m/s")
        .memory(1)
        .root("x falls 0")
        .body(Function::Start, |m| {
            m.set_x(0, 1.0);
            m.set_memory(0, 1.0);
        })
        .body(Function::Derivatives, |m| {
            m.set_dx(0, m.x(1));
            m.set_dx(1, -9.81);
        })
        .body(Function::Jacobian, |m| m.set_jacobian(&[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]))
        .body(Function::Roots, |m| m.set_root(0, m.x(0)))
        .body(Function::Transitions, |m| {
            if m.memory(0) > 0.0 && m.x(0) <= 0.0 {
                m.set_x(1, -0.9 * m.x(1));
            }
            m.set_memory(0, m.x(0));
        })
        .build()
}

#[test]
fn a_ball_bounces_when_it_should() {
    let instance = ball();
    let mut experiment = adaptive(5.0, 1e-6);
    experiment.plots.push(plot(&instance, &["x", "v"]));
    let outcome = go(&instance, &experiment).unwrap();
    // Bounce n is at √(2/g) (1 + 2 Σ 0.9^k), k = 1 … n.
    let first = (2.0f64 / 9.81).sqrt();
    let mut expected = vec![first];
    let mut flight = 2.0 * first;
    while *expected.last().unwrap() < 5.0 {
        flight *= 0.9;
        expected.push(expected.last().unwrap() + flight);
    }
    expected.pop();
    let rows: Vec<Vec<f64>> = outcome.recording.rows().map(<[f64]>::to_vec).collect();
    let both = rows.windows(2).filter(|pair| pair[0][0] == pair[1][0] && pair[0][2] < 0.0 && pair[1][2] > 0.0);
    let times: Vec<f64> = both.map(|pair| pair[0][0]).collect();
    assert_eq!(times.len(), expected.len());
    assert_eq!(outcome.work.events as usize, expected.len());
    for (time, expected) in times.iter().zip(&expected) {
        assert!((time - expected).abs() < 1e-10, "{time} for {expected}");
    }
    assert!(outcome.recording.points(0).all(|(_, x)| x > -1e-9));
}

#[test]
fn bounces_without_end_are_chatter() {
    let failure = go(&ball(), &adaptive(10.0, 1e-6)).unwrap_err();
    // Bounces accumulate at √(2/g) · 19.
    assert!((failure.time - 19.0 * (2.0f64 / 9.81).sqrt()).abs() < 1e-4, "{failure}");
    println!("{failure}");
    assert!(matches!(failure.cause, Cause::Chatter(_)));
    assert!(failure.to_string().contains("`x falls 0` turned more than 100 times within"));
}

/// A mass of 1 kg on a dry contact of 1 N modelled as sign(v), pushed with 0.5 N; thrown with 1 m/s.
fn sign_friction() -> Instance {
    Model::new("Dry")
        .state("v", "m/s")
        .automaton(&["sliding"])
        .root("v < 0")
        .body(Function::Start, |m| m.set_x(0, 1.0))
        .body(Function::Derivatives, |m| {
            let v = m.x(0);
            m.set_dx(0, 0.5 - if v == 0.0 { 0.0 } else { v.signum() });
        })
        .body(Function::Roots, |m| m.set_root(0, m.x(0)))
        .build()
}

#[test]
fn a_sign_that_should_stick_is_reported_with_regime_instant_and_remedy() {
    let failure = go(&sign_friction(), &adaptive(20.0, 1e-6)).unwrap_err();
    println!("{failure}");
    // The first crossing is at 2 s. It is reported as soon as two thousand have moved no state, after 2e-4 of the run.
    assert!((2.0..2.0 + 2e-4 * 20.0).contains(&failure.time), "{failure}");
    let Cause::Chatter(chatter) = &failure.cause else { panic!("{failure}") };
    assert_eq!((&chatter.regimes[..], &chatter.conditions[..]), (&["sliding".into()][..], &["v < 0".into()][..]));
}

/// The same contact with a regime of rest: stops at 2/3 s when thrown against the push, and stays at rest.
fn holding() -> Instance {
    let sliding = |m: &models::View| m.regime(0) != 0.0;
    Model::new("Holding")
        .state("x", "m")
        .state("v", "m/s")
        .automaton(&["stick", "slide"])
        .memory(1)
        .root("v falls 0")
        .body(Function::Start, |m| {
            m.set_x(1, -1.0);
            m.set_regime(0, 1.0);
            m.set_memory(0, -1.0);
        })
        .body(Function::Derivatives, move |m| {
            let v = m.x(1);
            m.set_dx(0, v);
            m.set_dx(1, if sliding(m) { 0.5 - v.signum() } else { 0.0 });
        })
        .body(Function::Roots, |m| m.set_root(0, m.x(1)))
        .body(Function::Transitions, move |m| {
            if sliding(m) && m.memory(0) * m.x(1) <= 0.0 {
                m.set_regime(0, 0.0);
                m.set_x(1, 0.0);
            }
            m.set_memory(0, m.x(1));
        })
        .build()
}

#[test]
fn a_mass_comes_to_rest_and_stays() {
    let instance = holding();
    let mut experiment = adaptive(3600.0, 1e-6);
    experiment.expects.push(reading(&instance, MeasureKind::Final, "v"));
    experiment.expects.push(reading(&instance, MeasureKind::Min, "x"));
    experiment.expects.push(reading(&instance, MeasureKind::Final, "x"));
    let outcome = go(&instance, &experiment).unwrap();
    assert_eq!(outcome.work.events, 1);
    assert_eq!(value(&outcome, 0), 0.0);
    assert!((value(&outcome, 2) + 1.0 / 3.0).abs() < 1e-6, "{}", value(&outcome, 2));
    assert!((value(&outcome, 1) - value(&outcome, 2)).abs() < 1e-9);
}

#[test]
fn event_times_follow_the_tolerance() {
    // x = sin t falls through 0.3 while v turns the spring off: x' = const from there.
    let instance = Model::new("Cut")
        .state("x", "m")
        .state("v", "m/s")
        .root("x rises 0.3")
        .body(Function::Start, |m| m.set_x(1, 1.0))
        .body(Function::Derivatives, |m| {
            m.set_dx(0, m.x(1));
            m.set_dx(1, if m.x(0) < 0.3 { -m.x(0) } else { 0.0 });
        })
        .body(Function::Roots, |m| m.set_root(0, m.x(0) - 0.3))
        .build();
    let crossing = 0.3f64.asin();
    for tol in [1e-6, 1e-8, 1e-11] {
        let x = measured(&instance, adaptive(2.0, tol), MeasureKind::Final, "x");
        let exact = 0.3 + crossing.cos() * (2.0 - crossing);
        assert!((x - exact).abs() < 10.0 * tol, "{:e} at {tol:e}", x - exact);
    }
}

#[test]
fn ticks_are_met_exactly() {
    // A sampled counter drives an integrator: x' = number of ticks.
    let instance = Model::new("Counter")
        .state("x", "m")
        .memory(1)
        .every(0.1)
        .body(Function::Start, |_| {})
        .body(Function::Derivatives, |m| m.set_dx(0, m.memory(0)))
        .body(Function::Tick, |m| {
            assert!(m.due(0));
            assert!((m.t() / 0.1 - (m.t() / 0.1).round()).abs() < 1e-12, "{}", m.t());
            m.set_memory(0, m.memory(0) + 1.0);
        })
        .build();
    let mut experiment = adaptive(1.0, 1e-6);
    experiment.plots.push(plot(&instance, &["x"]));
    experiment.expects.push(reading(&instance, MeasureKind::Final, "x"));
    let outcome = go(&instance, &experiment).unwrap();
    assert_eq!(outcome.work.ticks, 10);
    assert!((value(&outcome, 0) - 4.5).abs() < 1e-12, "{}", value(&outcome, 0));
}

#[test]
fn corners_are_met_exactly_and_show_both_sides() {
    // x' = 1 from 0.3 s on, 0 before.
    let on = |t: f64| if t >= 0.3 { 1.0 } else { 0.0 };
    let instance = Model::new("Switched")
        .state("x", "m")
        .output("u", "1")
        .body(Function::Start, |_| {})
        .body(Function::Derivatives, move |m| m.set_dx(0, on(m.t())))
        .body(Function::Outputs, move |m| m.set_y(0, on(m.t())))
        .build();
    let mut experiment = adaptive(1.0, 1e-6);
    experiment.corners.push(0.3);
    experiment.plots.push(plot(&instance, &["u"]));
    experiment.expects.push(reading(&instance, MeasureKind::Final, "x"));
    let outcome = go(&instance, &experiment).unwrap();
    assert!((value(&outcome, 0) - 0.7).abs() < 1e-14, "{}", value(&outcome, 0));
    let sides: Vec<f64> = outcome.recording.points(0).filter(|(t, _)| *t == 0.3).map(|(_, u)| u).collect();
    assert_eq!(sides, [0.0, 1.0]);
    assert_eq!(outcome.work.rejected, 0);
}

#[test]
fn a_model_without_states_is_shown_smoothly() {
    let instance = Model::new("Curve")
        .output("y", "1")
        .body(Function::Start, |_| {})
        .body(Function::Outputs, |m| m.set_y(0, (m.t() * 20.0).sin()))
        .build();
    let mut experiment = adaptive(1.0, 1e-6);
    experiment.plots.push(plot(&instance, &["y"]));
    experiment.expects.push(reading(&instance, MeasureKind::Max, "y"));
    let outcome = go(&instance, &experiment).unwrap();
    assert!((value(&outcome, 0) - 1.0).abs() < 1e-5);
    assert!(outcome.recording.rows().len() >= 1000);
}

#[test]
fn stick_slip_has_its_period() {
    let instance = models::stick_slip(1e5f64.sqrt());
    let mut experiment = adaptive(40.0, 1e-8);
    let mut period = reading(&instance, MeasureKind::Period, "pull");
    period.after = 8.0;
    experiment.expects.push(period);
    let outcome = go(&instance, &experiment).unwrap();
    println!("period {:.9} s", value(&outcome, 0));
    assert!((value(&outcome, 0) / 6.362720 - 1.0).abs() < 1e-7, "{}", value(&outcome, 0));
}

#[test]
fn a_pull_ends_where_it_should_by_default_too() {
    // Converged values of fixed-step runs with sigma1 = 316 N·s/m.
    let instance = models::stick_slip(316.0);
    let mut experiment = adaptive(40.0, 1e-8);
    experiment.expects.push(reading(&instance, MeasureKind::Max, "v"));
    experiment.expects.push(reading(&instance, MeasureKind::Final, "x"));
    let outcome = go(&instance, &experiment).unwrap();
    assert!((value(&outcome, 0) - 0.369817).abs() < 1e-6, "{}", value(&outcome, 0));
    assert!((value(&outcome, 1) - 3.306792).abs() < 1e-6, "{}", value(&outcome, 1));
    let default = measured(&instance, adaptive(40.0, 1e-6), MeasureKind::Final, "x");
    assert!((default / 3.306792 - 1.0).abs() < 1e-4, "{default}");
}

#[test]
fn dry_contacts_stick_and_slip() {
    // Converged values of fixed-step runs: end in m, top speed in m/s.
    for (contact, end, top) in [(Contact::Karnopp, 3.29869, 0.38767), (Contact::Kfm, 3.24011, 0.37682)] {
        let instance = models::dry_pull(contact, None);
        for tol in [1e-6, 1e-8] {
            let mut experiment = adaptive(40.0, tol);
            experiment.expects.push(reading(&instance, MeasureKind::Final, "x"));
            experiment.expects.push(reading(&instance, MeasureKind::Max, "v"));
            let outcome = go(&instance, &experiment).unwrap_or_else(|failure| panic!("{failure}"));
            println!("end {:.8} m, top {:.8} m/s", value(&outcome, 0), value(&outcome, 1));
            assert!((value(&outcome, 0) / end - 1.0).abs() < 100.0 * tol.max(1e-7), "{}", value(&outcome, 0));
            assert!((value(&outcome, 1) / top - 1.0).abs() < 100.0 * tol.max(1e-7), "{}", value(&outcome, 1));
        }
    }
}

#[test]
fn dry_contacts_hold_half_their_force() {
    for contact in [Contact::Karnopp, Contact::Kfm] {
        let instance = models::dry_pull(contact, Some(0.5));
        let moved = measured(&instance, adaptive(3600.0, 1e-6), MeasureKind::PeakToPeak, "x");
        assert!(moved < 1e-9, "{moved}");
    }
}

/// A mass of 1 kg thrown at 1 m/s on a contact that knows `stick` and `forward` exactly: at rest when its speed is 0.
#[test]
fn a_throw_stops_at_its_closed_form() {
    let instance = Model::new("CoastDown")
        .state("x", "m")
        .state("v", "m/s")
        .output("resting", "1")
        .automaton(&["forward", "stick"])
        .root("v <= 0")
        .body(Function::Start, |m| m.set_x(1, 1.0))
        .body(Function::Derivatives, |m| {
            let sliding = m.regime(0) == 0.0;
            m.set_dx(0, m.x(1));
            m.set_dx(1, if sliding { -1.0 - 0.4 * m.x(1) } else { 0.0 });
        })
        .body(Function::Roots, |m| m.set_root(0, m.x(1)))
        .body(Function::Transitions, |m| {
            if m.regime(0) == 0.0 && m.x(1) <= 0.0 {
                m.set_regime(0, 1.0);
                m.set_x(1, 0.0);
            }
        })
        .body(Function::Outputs, |m| m.set_y(0, m.regime(0)))
        .build();
    let stop = measured(&instance, adaptive(2.0, 1e-11), MeasureKind::First, "resting");
    assert!((stop - 2.5 * 1.4f64.ln()).abs() < 1e-11, "{stop}");
}

/// A mass of 1 kg with LuGre friction under u = Kp e + i − Kv v, di/dt = Ki e, from 0 to 1 m; without a Jacobian.
fn hunting() -> Instance {
    Model::new("Hunting")
        .state("x", "m")
        .state("v", "m/s")
        .state("z", "um")
        .state("i", "N")
        .root("v < 0")
        .body(Function::Start, |_| {})
        .body(Function::Derivatives, |m| {
            let (x, v, z, i) = (m.x(0), m.x(1), m.x(2), m.x(3));
            let g = 1.0 + 0.5 * (-(v / 1e-3) * (v / 1e-3)).exp();
            let dz = v - 1e5 * v.abs() / g * z;
            let friction = 1e5 * z + 1e5f64.sqrt() * dz + 0.4 * v;
            m.set_dx(0, v);
            m.set_dx(1, 3.0 * (1.0 - x) + i - 6.0 * v - friction);
            m.set_dx(2, dz);
            m.set_dx(3, 4.0 * (1.0 - x));
        })
        .body(Function::Roots, |m| m.set_root(0, m.x(1)))
        .build()
}

#[test]
fn hunting_has_its_period_and_overshoot_without_a_jacobian() {
    let instance = hunting();
    let mut experiment = adaptive(300.0, 1e-8);
    let mut period = reading(&instance, MeasureKind::Period, "x");
    // A whole number of periods, so that the mean is the centre.
    (period.after, period.before) = (150.0, 150.0 + 6.0 * 24.436786);
    experiment.expects.push(period);
    experiment.expects.push(reading(&instance, MeasureKind::Max, "x"));
    let outcome = go(&instance, &experiment).unwrap();
    println!("period {:.7} s, overshoot to {:.6} m", value(&outcome, 0), value(&outcome, 1));
    assert!((value(&outcome, 0) / 24.436786 - 1.0).abs() < 1e-6, "{}", value(&outcome, 0));
    assert!((value(&outcome, 1) - 1.5005).abs() < 1e-4, "{}", value(&outcome, 1));
}

#[test]
fn a_large_system_runs_as_a_small_one_does() {
    // Thirty stiff decays, each following the one before it.
    const N: usize = 30;
    let model = (0..N).fold(Model::new("Chain"), |model, _| model.state("x", "m"));
    let rate = |i: usize| 1.0 + 100.0 * i as f64;
    let instance = model
        .body(Function::Start, |m| m.set_x(0, 1.0))
        .body(Function::Derivatives, move |m| {
            m.set_dx(0, -m.x(0));
            (1..N).for_each(|i| m.set_dx(i, rate(i) * (m.x(i - 1) - m.x(i))));
        })
        .build();
    let mut experiment = adaptive(5.0, 1e-9);
    experiment.expects.push(reading(&instance, MeasureKind::Final, "x"));
    let last = &mut experiment.expects[0].measures[0];
    last.slot = instance.description().layout.states.slot(N - 1);
    let outcome = go(&instance, &experiment).unwrap();
    // After the slowest mode dominates, each member is larger than the previous one by rate/(rate − 1).
    let exact = (1..N).fold((-5f64).exp(), |x, i| x * rate(i) / (rate(i) - 1.0));
    assert!((value(&outcome, 0) - exact).abs() < 1e-8, "{} for {exact}", value(&outcome, 0));
    // Until the signal reaches the end of the chain, steps are short and the explicit method is chosen.
    assert!(outcome.work.stiff_steps > 100 && outcome.work.steps < 1000, "{}", outcome.work);
}

#[test]
fn a_surface_that_is_only_grazed_is_found() {
    // x = 1 − 1.0001 sin t dips below 0 for 28 ms; a check at the ends of steps would miss it.
    let instance = Model::new("Graze")
        .state("x", "m")
        .state("count", "1")
        .memory(1)
        .root("x falls 0")
        .body(Function::Start, |m| {
            m.set_x(0, 1.0);
            m.set_memory(0, 1.0);
        })
        .body(Function::Derivatives, |m| m.set_dx(0, -1.0001 * m.t().cos()))
        .body(Function::Roots, |m| m.set_root(0, m.x(0)))
        .body(Function::Transitions, |m| {
            if m.memory(0) > 0.0 && m.x(0) <= 0.0 {
                m.set_x(1, m.x(1) + 1.0);
            }
            m.set_memory(0, m.x(0));
        })
        .build();
    for tol in [1e-5, 1e-7, 1e-9] {
        assert_eq!(measured(&instance, adaptive(30.0, tol), MeasureKind::Final, "count"), 5.0, "tol {tol:e}");
    }
}

#[test]
fn regimes_that_switch_in_a_cycle_are_chatter() {
    let instance = Model::new("Buck")
        .state("x", "m")
        .automaton(&["left", "right"])
        .root("x > 1")
        .body(Function::Start, |_| {})
        .body(Function::Derivatives, |m| m.set_dx(0, 1.0))
        .body(Function::Roots, |m| m.set_root(0, m.x(0) - 1.0))
        .body(Function::Transitions, |m| {
            if m.x(0) > 1.0 {
                m.set_regime(0, 1.0 - m.regime(0));
            }
        })
        .build();
    let failure = go(&instance, &adaptive(2.0, 1e-6)).unwrap_err();
    assert!((failure.time - 1.0).abs() < 1e-9, "{failure}");
    assert!(failure.to_string().contains("turned more often than there are regimes"), "{failure}");
}

#[test]
fn a_watched_range_stops_an_adaptive_run_too() {
    let instance = Model::new("Ramp")
        .state("x", "m")
        .within((0.0, 1.0))
        .body(Function::Start, |_| {})
        .body(Function::Derivatives, |m| m.set_dx(0, 1.0))
        .build();
    assert!(go(&instance, &adaptive(1.0, 1e-6)).is_ok());
    let failure = go(&instance, &adaptive(2.0, 1e-6)).unwrap_err();
    assert!(failure.to_string().starts_with("`x` left its range 0 .. 1 m: it is 1.0"), "{failure}");
}

#[test]
fn a_blow_up_is_reported_with_its_state() {
    let blow_up = |power: i32| {
        Model::new("BlowUp")
            .state("x", "m")
            .body(Function::Start, |m| m.set_x(0, 1.0))
            .body(Function::Derivatives, move |m| m.set_dx(0, m.x(0).powi(power)))
            .build()
    };
    let failure = go(&blow_up(2), &adaptive(2.0, 1e-6)).unwrap_err();
    assert!((failure.time - 1.0).abs() < 1e-5 && failure.to_string().contains("`x`"), "{failure}");
    let undefined = Model::new("Undefined")
        .state("x", "m")
        .body(Function::Start, |m| m.set_x(0, 1.0))
        .body(Function::Derivatives, |m| m.set_dx(0, -m.x(0).sqrt() - 0.1))
        .build();
    let failure = go(&undefined, &adaptive(10.0, 1e-6)).unwrap_err();
    assert!(failure.to_string().contains("`x`"), "{failure}");
    println!("{failure}");
}

/// The mass with LuGre friction under a position controller sampled at 1 kHz.
#[test]
fn a_sampled_controller_costs_a_step_a_tick() {
    let instance = Model::new("Sampled")
        .state("x", "m")
        .state("v", "m/s")
        .state("z", "um")
        .root("v < 0")
        .memory(2)
        .every(1e-3)
        .body(Function::Start, |_| {})
        .body(Function::Derivatives, |m| {
            let (v, z) = (m.x(1), m.x(2));
            let g = 1.0 + 0.5 * (-(v / 1e-3) * (v / 1e-3)).exp();
            let dz = v - 1e5 * v.abs() / g * z;
            m.set_dx(0, v);
            m.set_dx(1, m.memory(0) - 1e5 * z - 1e5f64.sqrt() * dz - 0.4 * v);
            m.set_dx(2, dz);
        })
        .body(Function::Roots, |m| m.set_root(0, m.x(1)))
        .body(Function::Tick, |m| {
            let i = m.memory(1) + 1e-3 * 4.0 * (1.0 - m.x(0));
            m.set_memory(1, i);
            m.set_memory(0, 3.0 * (1.0 - m.x(0)) + i - 6.0 * m.x(1));
        })
        .build();
    let mut experiment = adaptive(10.0, 1e-6);
    experiment.expects.push(reading(&instance, MeasureKind::Max, "x"));
    let outcome = go(&instance, &experiment).unwrap();
    assert_eq!(outcome.work.ticks, 10_000);
    assert!(outcome.work.steps + outcome.work.rejected < 10_500, "{}", outcome.work);
    // The overshoot is about that of the continuous controller.
    assert!((value(&outcome, 0) - 1.5).abs() < 0.01, "{}", value(&outcome, 0));
}

/// Pulls with random parameters over several decades each: all runs end, and no bristle exceeds its largest possible
/// deflection.
#[test]
fn any_bristle_can_be_pulled() {
    for seed in 0..20u64 {
        let mut state = seed;
        let mut between = |low: f64, high: f64| {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            low * (high / low).powf((state >> 11) as f64 / (1u64 << 53) as f64)
        };
        between(1.0, 2.0);
        let (mass, spring, pull) = (between(0.1, 10.0), between(0.5, 200.0), between(1e-3, 1.0));
        let (sliding, rest, slow) = (between(0.1, 10.0), between(1.0, 2.0), between(1e-4, 1e-2));
        let (stiffness, viscous) = (between(1e3, 1e7), between(0.01, 10.0));
        let damping = (stiffness * mass).sqrt() * between(0.01, 2.0);
        let level = move |v: f64| sliding * (1.0 + (rest - 1.0) * (-(v / slow) * (v / slow)).exp());
        let instance = Model::new("Random")
            .state("x", "m")
            .state("v", "m/s")
            .state("z", "um")
            .root("v < 0")
            .body(Function::Start, |_| {})
            .body(Function::Derivatives, move |m| {
                let (x, v, z) = (m.x(0), m.x(1), m.x(2));
                let dz = v - stiffness * v.abs() / level(v) * z;
                m.set_dx(0, v);
                m.set_dx(1, (spring * (pull * m.t() - x) - stiffness * z - damping * dz - viscous * v) / mass);
                m.set_dx(2, dz);
            })
            .body(Function::Roots, |m| m.set_root(0, m.x(1)))
            .build();
        let duration = 3.0 * sliding * rest / (spring * pull);
        let mut experiment = adaptive(duration, 1e-6);
        experiment.expects.push(reading(&instance, MeasureKind::Max, "z"));
        experiment.expects.push(reading(&instance, MeasureKind::Min, "z"));
        let outcome = go(&instance, &experiment).unwrap_or_else(|failure| panic!("seed {seed}: {failure}"));
        let reach = value(&outcome, 0).max(-value(&outcome, 1));
        // At rest the speed is far below its tolerance of 1e-6 m/s, which deflects the bristle slightly too far.
        let bound = 1.01 * sliding * rest / stiffness;
        assert!(reach < bound, "seed {seed}: {reach} m, beyond {bound} m");
    }
}
