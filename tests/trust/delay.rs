//! The delay at which `check` reports an emulated contact as unstable (W0801) is the one that `fric predict` computes.

use crate::chance::{Chance, seeds};
use compiler::rig::Emulated;
use runtime::coupling::loop_stability::{CommandDelay, Loop};

/// A contact with this natural frequency and damping ratio on an inertia of 1 kg·m².
fn sampled(contact: Emulated) -> Loop {
    let Emulated { natural, damping_ratio, period, lag } = contact;
    Loop::bristle(1.0, natural * natural, 2.0 * damping_ratio * natural, period, CommandDelay { dead: 0.0, lag })
}

#[test]
fn the_lint_and_predict_agree_on_the_largest_delay() {
    let seeds = seeds(200);
    println!("seeds {seeds:?}");
    let (mut failed, mut compared, mut worst) = (Vec::new(), 0, 0.0f64);
    for seed in seeds {
        let mut chance = Chance::new(seed);
        let period = chance.decades(0.25e-3, 4e-3);
        let (natural, damping_ratio) = (chance.decades(0.03, 0.4) / period, chance.decades(0.05, 2.0));
        let lag = chance.within(0.05, 0.4) * Emulated { natural, damping_ratio, period, lag: 0.0 }.limit();
        let contact = Emulated { natural, damping_ratio, period, lag };
        let lint = contact.limit();
        // A contact that is unstable at any dead time has no limit to compare.
        let Some(dead) = sampled(contact).limit(0).filter(|dead| *dead > 0.0) else { continue };
        compared += 1;
        let predict = 0.5 * period + lag + dead;
        worst = worst.max((lint / predict - 1.0).abs());
        if (lint - predict).abs() > 0.04 * predict {
            failed.push(format!("seed {seed}, {contact:?}: lint {lint:e} s, predict {predict:e} s"));
        }
    }
    println!("{compared} compared, worst {worst:.3}");
    assert!(compared > 50, "{compared}");
    assert!(failed.is_empty(), "{} fail:\n{}", failed.len(), failed.join("\n"));
}
