//! The model beside the recording of its rig: a dry run from the instant at which the model took over, and short ones from
//! each full state in the log.
//!
//! In: both programs of a rig, the values of its parameters or its whole state at an instant, the recording so far. Out: for
//! each recorded quantity the curve of the dry run, and how far the recording is from it. In the long run the control
//! program starts as it does on the rig, and the plant at its own start. The short ones start from the true state, and the
//! plant from what the drives measured; each lasts until the next state is due. Sets after the begin are not repeated.

use crate::thin;
use abi::plan::{Experiment, PARTS, Plot, Solver, View};
use abi::rig::{Bench, Rig, Signal};
use abi::series::Method;
use abi::{Instance, Slot};
use runtime::coupling::sil::{self, Moment};
use runtime::engine::{Continue, run};
use std::sync::Arc;

/// Steps of the plant in a period: those of a dry run.
const STEPS: f64 = 50.0;

/// A dry run to be made.
pub struct Twin {
    /// The rig.
    pub rig: Rig,
    /// The control program at its start.
    pub control: Instance,
    /// The program of the plant: the part of the model in whose place the drives are on the rig.
    pub plant: Instance,
    /// Values of parameters at that instant, SI.
    pub set: Vec<(Slot, f64)>,
    /// That instant, s.
    pub at: f64,
}

impl Twin {
    /// Makes it, for this long; for each recorded quantity its points: time of the recording in s, value in its unit.
    pub fn run(self, seconds: f64) -> Vec<Vec<(f64, f64)>> {
        let Twin { rig, mut control, plant, set, at } = self;
        set.iter().for_each(|(slot, value)| control.set(*slot, *value));
        let series = rig.record.clone();
        let period = rig.period_ns as f64 * 1e-9;
        let experiment = Experiment {
            name: rig.name.clone(),
            duration: (seconds / period).floor() * period,
            solver: Solver { method: Method::Expo, step: period / STEPS, tol: 1e-6, parts: PARTS },
            bench: Some(Box::new(Bench { rig, plant })),
            plots: vec![Plot { series: series.clone(), against: None, view: View::default() }],
            records: Vec::new(),
            every: None,
            expects: Vec::new(),
            corners: Vec::new(),
            stepped: true,
        };
        // A run that a condition of the rig stops has a curve up to there.
        let recording = match run(control, &experiment, &mut |_| Continue::Continue(())) {
            Ok(outcome) => outcome.recording,
            Err(failure) => failure.recording,
        };
        let column = |one: &abi::plan::Series| {
            let found = recording.columns().iter().position(|column| {
                column.label == one.label && column.unit == one.unit && column.boolean == one.boolean
            });
            let points = found.map(|column| recording.points(column).map(|(t, si)| (at + t, one.unit.from_si(si))));
            points.map(Iterator::collect).unwrap_or_default()
        };
        series.iter().map(column).collect()
    }
}

/// A full state in the log, from which a short run can start.
#[derive(Clone, PartialEq, Debug)]
pub struct State {
    /// The last cycle before it, counted in periods.
    pub at: u64,
    /// The block of the control program.
    pub block: Vec<f64>,
    /// What the drives measured in that cycle, SI.
    pub measured: Vec<(Signal, f64)>,
    /// The outputs that were permitted then, SI.
    pub permitted: Vec<f64>,
}

/// A short run to be made.
pub struct Short {
    /// The rig.
    pub rig: Rig,
    /// Its control program, and that of its plant.
    pub programs: Arc<(Instance, Instance)>,
    /// Where it starts.
    pub from: State,
}

/// A short run from a state.
pub struct Ahead {
    /// The last cycle before it.
    pub at: u64,
    /// For each recorded quantity its values after each of the following cycles, in its unit.
    pub curves: Vec<Vec<f64>>,
    /// For each the points (s, value) of a picture of [`COARSE`] columns: what pages get as long as that is enough.
    pub coarse: Vec<Vec<(f64, f64)>>,
}

/// Columns of the pictures of short runs, with four points each: a second of a window of 20 s has 60 pixels.
pub const COARSE: usize = 24;

impl Ahead {
    /// Makes it, for this many cycles; shorter where a program cannot continue.
    pub fn run(short: &Short, cycles: u64) -> Ahead {
        let Short { rig, programs, from } = short;
        let mut curves = vec![Vec::with_capacity(cycles as usize); rig.record.len()];
        let moment = Moment { control: &from.block, measured: &from.measured, permitted: &from.permitted };
        sil::ahead(rig, (&programs.0, &programs.1), &moment, (STEPS as u64, cycles), &mut |control| {
            for (curve, series) in curves.iter_mut().zip(&rig.record) {
                curve.push(series.unit.from_si(control.get(series.slot)));
            }
        });
        let mut made = Ahead { at: from.at, curves, coarse: Vec::new() };
        let period = rig.period_ns as f64 * 1e-9;
        made.coarse = (0..made.curves.len()).map(|curve| made.points(curve, period, COARSE)).collect();
        made
    }

    /// The points (s, value) of one of its curves, thinned to a picture of this many columns. `period`: of the cycle, s.
    pub fn points(&self, curve: usize, period: f64, columns: usize) -> Vec<(f64, f64)> {
        let at = |cycle: u64| cycle as f64 * period;
        let points = self.curves[curve].iter().zip(self.at + 1..).map(|(y, k)| (at(k), *y));
        let points: Vec<(f64, f64)> = points.collect();
        thin::window(&points, at(self.at + 1), at(self.at + points.len() as u64), columns)
    }

    /// Root of the mean square of its difference from a recording, for one of its curves. `value`: of a cycle.
    pub fn rms(&self, curve: usize, value: impl Fn(u64) -> f64) -> Option<f64> {
        let off = self.curves[curve].iter().zip(self.at + 1..).map(|(own, cycle)| own - value(cycle));
        let squares = off.map(|off| off * off);
        let known: Vec<f64> = squares.filter(|square| !square.is_nan()).collect();
        (!known.is_empty()).then(|| (known.iter().sum::<f64>() / known.len() as f64).sqrt())
    }
}

/// Difference of a recording from its twin, cycle by cycle in the order of time.
#[derive(Clone, Default)]
pub struct Difference {
    squares: f64,
    count: u64,
    /// The point of the twin before the last cycle.
    place: usize,
}

impl Difference {
    /// Adds a cycle.
    pub fn see(&mut self, twin: &[(f64, f64)], t: f64, value: f64) {
        while self.place + 1 < twin.len() && twin[self.place + 1].0 <= t {
            self.place += 1;
        }
        let (Some(a), Some(b)) = (twin.get(self.place), twin.get(self.place + 1)) else { return };
        if t < a.0 || value.is_nan() {
            return;
        }
        let model = if b.0 > a.0 { a.1 + (b.1 - a.1) * (t - a.0) / (b.0 - a.0) } else { b.1 };
        self.squares += (value - model) * (value - model);
        self.count += 1;
    }

    /// Root of the mean square; none before the first cycle.
    pub fn rms(&self) -> Option<f64> {
        (self.count > 0).then(|| (self.squares / self.count as f64).sqrt())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A recording of the twin's own polyline differs by nothing, one that is shifted by its shift.
    #[test]
    fn the_difference_is_that_of_the_curves() {
        let mut state = 3_u64;
        let mut chance = || (abi::random::next(&mut state) >> 11) as f64 / (1_u64 << 53) as f64;
        for case in 1..=200 {
            let mut t = 1.0;
            let twin: Vec<(f64, f64)> = (0..60)
                .map(|_| {
                    t += 0.01 + 0.2 * chance();
                    (t, 10.0 * chance() - 5.0)
                })
                .collect();
            let shift = chance() - 0.5;
            let mut found = [Difference::default(), Difference::default()];
            for k in 0..4000 {
                let t = 5e-3 * f64::from(k);
                let after = twin.partition_point(|point| point.0 <= t);
                let own = match (after.checked_sub(1).and_then(|i| twin.get(i)), twin.get(after)) {
                    (Some(a), Some(b)) => a.1 + (b.1 - a.1) * (t - a.0) / (b.0 - a.0),
                    _ => 77.0,
                };
                found[0].see(&twin, t, own);
                found[1].see(&twin, t, own + shift);
            }
            let [none, shifted] = found.map(|one| one.rms().unwrap());
            assert!(none < 1e-9 && (shifted - shift.abs()).abs() < 1e-9, "case {case}: {none} {shifted} {shift}");
        }
        assert_eq!(Difference::default().rms(), None);
    }
}
