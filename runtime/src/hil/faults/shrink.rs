//! Shrinks a failing script: fewer faults, shorter, in a simpler phase, on a simpler rig.
//!
//! In: a script and its violation. Out: a script with the same violation that no further simplification preserves.

use super::broken::Broken;
use super::invariants::Violation;
use super::rigs::{Made, PLAIN, Sort};
use super::space::{EVER, Fault, Ill, MS, Only, Phase, Script, What};
use crate::testing::generated;

/// Shrinks a script that violates a property; returns the smallest script found and its violation.
pub fn shrink(
    script: &Script,
    first: Violation,
    run: impl Fn(&Script) -> Result<(), Violation>,
) -> (Script, Violation) {
    let kind: Broken = first.broken;
    generated::shrunk(script, first, simpler, |script| match run(script) {
        Err(violation) if violation.broken != kind => Ok(()),
        other => other,
    })
}

/// Scripts that are simpler in one respect, the largest simplification first.
fn simpler(script: &Script) -> Vec<Script> {
    let mut all = Vec::new();
    let with = |change: &dyn Fn(&mut Script)| {
        let mut other = script.clone();
        change(&mut other);
        (other != *script).then_some(other)
    };
    for at in 0..script.faults.len() {
        all.extend(with(&|other| _ = other.faults.remove(at)));
    }
    all.extend(with(&|other| other.rig = PLAIN));
    all.extend(with(&|other| other.again = other.faults.iter().any(|fault| fault.phase == Phase::Again)));
    all.extend(with(&|other| other.tested = false));
    all.extend(with(&|other| other.sets = 1));
    all.extend(with(&|other| other.only = Only::Any));
    let sort = |other: &mut Script, sort: Sort| other.rig.sort = sort;
    if fits(&script.faults, Sort::Pair) {
        all.extend(with(&|other| sort(other, Sort::Pair)));
    }
    let plainer: [fn(&mut Made); 13] = [
        |made| made.swing = PLAIN.swing,
        |made| made.hertz = PLAIN.hertz,
        |made| made.damping = PLAIN.damping,
        |made| (made.rated, made.most) = (PLAIN.rated, PLAIN.most),
        |made| made.slew = PLAIN.slew,
        |made| made.speed = PLAIN.speed,
        |made| made.travel = PLAIN.travel,
        |made| made.power = PLAIN.power,
        |made| (made.hold, made.at_sync) = (PLAIN.hold, PLAIN.at_sync),
        |made| made.eager = PLAIN.eager,
        |made| (made.safe, made.far) = (PLAIN.safe, PLAIN.far),
        |made| made.no_number = PLAIN.no_number,
        |made| made.float = PLAIN.float,
    ];
    for plain in plainer {
        all.extend(with(&|other| plain(&mut other.rig)));
    }
    all.extend(with(&|other| other.seed = 1));
    for at in 0..script.faults.len() {
        for fault in simpler_fault(&script.faults[at]) {
            all.extend(with(&|other| other.faults[at] = fault));
        }
    }
    all
}

/// Whether a rig of this sort has everything that the faults refer to.
fn fits(faults: &[Fault], sort: Sort) -> bool {
    let (frames, _) = super::space::frames(sort);
    faults.iter().all(|fault| match fault.what {
        What::Frame(bus, id, _) => frames.contains(&(bus, id)),
        What::Node(node, _) => node == 0 || !matches!(sort, Sort::One | Sort::FramesServo),
        What::Short(bus)
        | What::Unplugged(bus)
        | What::Alone(bus)
        | What::Down(bus)
        | What::Babble(bus)
        | What::Foreign(bus, _)
        | What::Overrun(bus, _) => bus == 0 || sort == Sort::TwoBuses,
        What::NoNumber(..) => sort == Sort::FramesServo,
        What::Frozen(_) => true,
    })
}

fn simpler_fault(fault: &Fault) -> Vec<Fault> {
    let mut all = Vec::new();
    let simpler_phases = Phase::ALL.iter().take_while(|phase| **phase != fault.phase);
    all.extend(simpler_phases.map(|phase| Fault { phase: *phase, after: 0, ..*fault }));
    for after in [0, fault.after / 2, fault.after / MS * MS] {
        if after < fault.after {
            all.push(Fault { after, ..*fault });
        }
    }
    if let What::Frame(bus, id, Ill::Late(by)) = fault.what {
        for shorter in [by / 2, by / 100_000 * 100_000] {
            if shorter < by && shorter > 0 {
                all.push(Fault { what: What::Frame(bus, id, Ill::Late(shorter)), ..*fault });
            }
        }
    }
    // A short time is simpler than a long one, and a permanent fault is simpler than an odd time.
    for lasts in [MS, 3 * MS, 10 * MS, 40 * MS, EVER] {
        if lasts < fault.lasts || lasts == EVER && fault.lasts > 40 * MS && fault.lasts != EVER {
            all.push(Fault { lasts, ..*fault });
        }
    }
    all
}
