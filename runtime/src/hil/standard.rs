//! Standard experiments for a contact that a drive plays: compares the ideal contact with the one that is sampled,
//! computed once per period and applied after a delay.
//!
//! In: a rig, its control program, the program of the part that hardware replaces. Out: figures of each contact. The
//! shaft is rigid. The external torque is exact, so that the figures are those of the contact alone; a predictor knows
//! that torque if the rig has another drive that applies it.

use super::coupling::{Contact, contacts};
use crate::coupling::lag::Lag;
use crate::coupling::predictor::{self, ShaftObserver, Torque};
use abi::rig::{Kind, Rig, SignalKind};
use abi::{Instance, Slot};

/// Fine steps per period.
const FINE: u64 = 20;

/// A figure of the ideal contact, and of the contact as the rig plays it.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Pair {
    /// The ideal contact.
    pub own: f64,
    /// The contact on the rig.
    pub played: f64,
}

/// Figures of one contact.
#[derive(Clone, PartialEq, Debug)]
pub struct Figures {
    /// The drive that plays it: an index into the rig's nodes.
    pub node: usize,
    /// Break-away torque in a slow motion, N·m: the unit of the errors below.
    pub holds: f64,
    /// Torque of a slow ramp at which the contact has slid ten times its presliding displacement, N·m.
    pub break_away: Pair,
    /// Peak-to-peak ripple of the speed under half of `holds`, rad/s: an excess of the rig over the ideal contact is a
    /// limit cycle of the rig.
    pub ripple: Pair,
    /// Area of the hysteresis loop of torque over angle under 0.8 `holds` at 1 Hz, J.
    pub loop_area: Pair,
    /// Number of slips within 20 s, under a spring whose torque grows to `holds` within 5 s.
    pub slips: Pair,
    /// Rms error of the torque in that experiment, as a share of `holds`.
    pub stick_slip_error: f64,
    /// Greatest error of F(v) in an oscillation with a period of 2 s, above half of the greatest speed, as a share of
    /// `holds`. Without a predictor, because a shaft with a prescribed speed is not free.
    pub curve_error: f64,
}

/// Excitation of the shaft.
enum Motion<'a> {
    /// A torque as a function of time and angle, N·m.
    Pulled(&'a dyn Fn(f64, f64) -> f64),
    /// A prescribed speed as a function of time, rad/s.
    Turned(&'a dyn Fn(f64) -> f64),
}

/// State of the shaft at the end of a period, and the mean torque of the contact in it, which opposes a positive speed.
#[derive(Clone, Copy)]
struct PeriodRow {
    x: f64,
    v: f64,
    torque: f64,
}

/// Figures of all contacts that drives of a rig play. Empty if the plant has no known inertia.
pub fn standard(rig: &Rig, model: &Instance, plant: &Instance) -> Vec<Figures> {
    let Some(inertia) = rig.plant.inertia else { return Vec::new() };
    let stands = contacts(rig, model).into_iter().map(|contact| Stand { rig, model, plant, inertia, contact });
    stands.filter_map(|stand| stand.figures()).collect()
}

struct Stand<'a> {
    rig: &'a Rig,
    model: &'a Instance,
    plant: &'a Instance,
    inertia: f64,
    contact: Contact,
}

impl Stand<'_> {
    /// None if the program fails in an experiment.
    #[allow(clippy::disallowed_methods, reason = "figures to be shown: they decide nothing that runs")]
    fn figures(&self) -> Option<Figures> {
        let Contact { output, most: holds, stiffness } = self.contact;
        let turn = 2.0 * std::f64::consts::PI;
        // The approximate break-away angle.
        let angle = holds / stiffness;
        let both =
            |seconds: f64, motion: &Motion| Some([self.run(false, seconds, motion)?, self.run(true, seconds, motion)?]);
        let pair = |runs: &[Vec<PeriodRow>; 2], of: &dyn Fn(&[PeriodRow]) -> f64| Pair {
            own: of(&runs[0]),
            played: of(&runs[1]),
        };

        let ramp = |t: f64, _: f64| 1.3 * holds * t;
        let runs = both(1.2, &Motion::Pulled(&ramp))?;
        let period = self.rig.period_ns as f64 * 1e-9;
        let first = |rows: &[PeriodRow]| {
            let at = rows.iter().position(|row| row.x.abs() > 10.0 * angle);
            at.map_or(f64::INFINITY, |k| ramp(period * (k + 1) as f64, 0.0))
        };
        let break_away = pair(&runs, &first);

        let half = |t: f64, _: f64| 0.5 * holds * (t / 0.2).min(1.0);
        let runs = both(1.5, &Motion::Pulled(&half))?;
        let spread = |values: &mut dyn Iterator<Item = f64>| {
            let (least, greatest) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
            greatest - least
        };
        let ripple = pair(&runs, &|rows| spread(&mut rows[rows.len() * 2 / 3..].iter().map(|row| row.v)));

        let swing = |t: f64, _: f64| 0.8 * holds * (turn * t).sin();
        let runs = both(3.0, &Motion::Pulled(&swing))?;
        let area = |rows: &[PeriodRow]| {
            let last = &rows[rows.len() * 2 / 3..];
            last.windows(2).map(|pair| pair[1].torque * (pair[1].x - pair[0].x)).sum::<f64>()
        };
        let loop_area = pair(&runs, &area);

        // A spring whose slip takes two seconds.
        let spring = self.inertia * (0.25 * turn).powi(2);
        let pace = holds / (5.0 * spring);
        let runs = both(20.0, &Motion::Pulled(&|t, x| spring * (pace * t - x)))?;
        let slips = pair(&runs, &|rows| {
            let (mut count, mut fast) = (0.0, false);
            for row in rows {
                count += if row.v > pace && !fast { 1.0 } else { 0.0 };
                fast = if fast { row.v > 0.1 * pace } else { row.v > pace };
            }
            count
        });
        let apart = |rows: &[Vec<PeriodRow>; 2]| {
            rows[0].iter().zip(&rows[1]).map(|(a, b)| a.torque - b.torque).collect::<Vec<_>>()
        };
        let squares: f64 = apart(&runs).iter().map(|d| d * d).sum();
        let stick_slip_error = (squares / runs[0].len() as f64).sqrt() / holds;

        let fast = 100.0 * angle;
        let runs = both(4.0, &Motion::Turned(&|t| fast * (0.5 * turn * t).sin()))?;
        let sliding = runs[0].iter().map(|row| row.v.abs() > 0.5 * fast);
        let worst = apart(&runs).into_iter().zip(sliding).filter(|(_, slides)| *slides).map(|(d, _)| d.abs());
        let curve_error = worst.fold(0.0, f64::max) / holds;
        let node = self.rig.outputs[output].signal.node;
        Some(Figures { node, holds, break_away, ripple, loop_area, slips, stick_slip_error, curve_error })
    }

    /// The slots that read this quantity of the shaft.
    fn slots(&self, what: SignalKind) -> Vec<Slot> {
        self.rig.inputs.iter().filter(|input| input.signal.what == what).map(|input| input.slot).collect()
    }

    /// One experiment from rest, one row per period. `played`: by the drive instead of the ideal contact. None if the
    /// program fails.
    fn run(&self, played: bool, seconds: f64, motion: &Motion) -> Option<Vec<PeriodRow>> {
        let Stand { rig, plant, inertia, .. } = self;
        let output = &rig.outputs[self.contact.output];
        let node = &rig.nodes[output.signal.node];
        let Kind::Cia402(drive) = &node.kind else { return None };
        // The contact opposes the motion; the plant determines the direction in which its drive turns the shaft.
        let sign = predictor::sign(rig, plant, output.signal, output.signal.node);
        let period = rig.period_ns as f64 * 1e-9;
        let dead_ns = (node.delay * 1e9).round() as u64 + if drive.at_sync { rig.period_ns } else { 0 };
        let (speeds, positions) = (self.slots(SignalKind::Speed), self.slots(SignalKind::Position));
        let mut model = self.model.clone();
        let steps = u64::from(rig.steps.max(1));
        let fine = period / FINE as f64;
        (model.start(if played { period / steps as f64 } else { fine }) == 0).then_some(())?;
        let mut applied = Lag::new(node.lag);
        // A shaft with a prescribed speed is not free, so there is nothing to predict.
        let free = matches!(motion, Motion::Pulled(_));
        let looks = played && free && rig.predict == Some(output.signal.node);
        let other = |other: &abi::rig::Output| other.signal.what == SignalKind::Torque && other.signal != output.signal;
        let told = rig.outputs.iter().any(other);
        let mut look = looks.then(|| {
            let torques = vec![Torque::new(dead_ns, node.lag), Torque::new(0, 0.0)];
            ShaftObserver::new(*inertia, rig.period_ns, drive.count, torques)
        });
        let (mut x, mut v) = (0.0, 0.0);
        let mut give = |v: f64, x: f64, steps: u64| {
            speeds.iter().for_each(|slot| model.set(*slot, v));
            positions.iter().for_each(|slot| model.set(*slot, x));
            (model.advance(steps) == 0).then(|| model.get(output.slot))
        };
        let mut rows = Vec::new();
        for tick in 0..(seconds / period).round() as u64 {
            let now_ns = tick * rig.period_ns;
            if played {
                let counted = (x / drive.count).floor() * drive.count;
                let (v, x) = match &mut look {
                    Some(look) => {
                        look.observe(now_ns, counted);
                        if let (Motion::Pulled(pull), true) = (motion, told) {
                            look.sent(1, pull(tick as f64 * period, x));
                        }
                        let ahead = look.ahead();
                        (ahead.speed, ahead.position)
                    }
                    None => ((v / drive.speed_unit).round() * drive.speed_unit, counted),
                };
                let step = 1e-3 * drive.rated_torque;
                let heard = (give(v, x, steps)?.clamp(output.low, output.high) / step).round() * step;
                applied.send(now_ns + dead_ns, sign * heard);
                if let Some(look) = &mut look {
                    look.sent(0, sign * heard);
                }
            }
            let mut sum = 0.0;
            for k in 0..FINE {
                let t = (tick * FINE + k) as f64 * fine;
                let torque = match played {
                    true => applied.advance(now_ns + rig.period_ns * k / FINE, now_ns + rig.period_ns * (k + 1) / FINE),
                    false => sign * give(v, x, 1)?,
                };
                match motion {
                    Motion::Pulled(pull) => {
                        let acceleration = (pull(t, x) + torque) / inertia;
                        x += fine * (v + 0.5 * fine * acceleration);
                        v += fine * acceleration;
                    }
                    Motion::Turned(speed) => {
                        v = speed(t + fine);
                        x += fine * v;
                    }
                }
                sum -= torque / FINE as f64;
            }
            rows.push(PeriodRow { x, v, torque: sum });
        }
        rows.iter().all(|row| row.v.is_finite()).then_some(rows)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::rigs;

    /// A bristle of 20 N·m/rad that slips at 0.34 N·m on a shaft of 0.012 kg·m²: played with a delay of 0.8 ms it is
    /// nearly ideal, with 30 ms it oscillates.
    #[test]
    fn a_late_contact_shows_in_the_figures() {
        let (mut rig, model, plant) = rigs::bristle();
        let figures = |rig: &Rig| standard(rig, &model, &plant).swap_remove(0);
        let near = figures(&rig);
        assert_eq!(rig.nodes[near.node].name, "load");
        assert!((near.holds / 0.34 - 1.0).abs() < 0.05, "{near:?}");
        assert!((near.break_away.played / near.break_away.own - 1.0).abs() < 0.05, "{near:?}");
        assert!((near.loop_area.played / near.loop_area.own - 1.0).abs() < 0.1, "{near:?}");
        assert!(near.curve_error < 0.05 && near.stick_slip_error < 0.05, "{near:?}");
        assert_eq!(near.slips.own, near.slips.played, "{near:?}");
        rig.nodes[0].delay = 30e-3;
        let late = figures(&rig);
        assert_eq!((late.break_away.own, late.slips.own), (near.break_away.own, near.slips.own));
        assert!(late.ripple.played > 5.0 * near.ripple.played, "{late:?} {near:?}");
    }
}
