//! System identification of a rig's drives and shaft: dead time, lag and inertia, from small torque pulses.
//!
//! In: a rig. Out: a program that pulses one torque drive after the other in place of the model, and, from the recorded
//! torque and speed, the numbers for the rig's text. Knows neither buses nor drives: it runs like any model.

use abi::description::{Kind as QuantityKind, Layout, Quantity};
use abi::rig::{Kind, Mode, Output, Rig, Signal, SignalKind};
use abi::table::Interpret;
use abi::unit::Unit;
use abi::{Code, Description, Function, Instance, Slot};
use std::sync::Arc;

/// Pulses of each drive, alternating in sign.
const PULSES: u64 = 12;
/// Duration of a pulse, s.
const PULSE: f64 = 0.02;
/// Rest before the next drive, s.
const REST: f64 = 0.1;
/// Height of a pulse as a share of the output's limit.
const PART: f64 = 0.3;
/// Steps per period in the simulation of the torque.
const SUBSTEPS: usize = 50;

/// The program and the rig it runs on: the same nodes, without stop conditions.
pub struct Identification {
    /// The given rig, with the outputs of this program.
    pub rig: Rig,
    /// The program that generates the pulses.
    pub program: Instance,
    /// Run time, ns.
    pub duration_ns: u64,
    drives: Vec<usize>,
}

/// Recording of one cycle, one value per drive.
#[derive(Clone, Debug, Default)]
pub struct Row {
    /// Permitted torque, N·m.
    pub told: Vec<f64>,
    /// Torque that each drive reports for SYNC, N·m.
    pub torque: Vec<f64>,
    /// Speed at SYNC, rad/s.
    pub speed: Vec<f64>,
}

/// Identified values of one drive.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Found {
    /// Index into the rig's nodes.
    pub node: usize,
    /// Dead time from the reading of the shaft, at SYNC, to the first effect of the command that answers it, s: the
    /// `delay` of the rig's text.
    pub delay: f64,
    /// Time constant of the torque, s. Below about half a period hardly one sample lies on the rise of the torque; lag
    /// and delay can then be separated only as far as the resolution of the torque permits.
    pub lag: f64,
    /// Residual of the best fit, rms, N·m.
    pub residual: f64,
    /// Moment of inertia of all rotating parts, kg·m²; none if the shaft hardly moved.
    pub inertia: Option<f64>,
}

impl Identification {
    /// Pulses for the torque drives of a rig.
    ///
    /// # Errors
    /// If the rig has no torque drive.
    pub fn new(rig: &Rig) -> Result<Identification, String> {
        let torque = |node: &usize| match &rig.nodes[*node].kind {
            Kind::Cia402(drive) => drive.mode == Mode::Torque && rig.nodes[*node].moves,
            Kind::Frames(_) => false,
        };
        let drives: Vec<usize> = (0..rig.nodes.len()).filter(torque).collect();
        if drives.is_empty() {
            return Err("the rig has no drive that takes a torque".into());
        }
        let layout = Layout::new([0, 0, 0, 0, 0, drives.len() as u32, 0, 0, 0, 0]);
        let period = rig.period_ns as f64 * 1e-9;
        let limits = |node: usize| {
            let of = |output: &&Output| output.signal.node == node && output.signal.what == SignalKind::Torque;
            let rated = match &rig.nodes[node].kind {
                Kind::Cia402(drive) => drive.rated_torque,
                Kind::Frames(_) => 0.0,
            };
            match rig.outputs.iter().find(of) {
                Some(output) => (output.low.max(-rated), output.high.min(rated), output.slew),
                None => (-rated, rated, f64::INFINITY),
            }
        };
        let mut outputs = Vec::new();
        let mut heights = Vec::new();
        for (i, node) in drives.iter().enumerate() {
            let (low, high, slew) = limits(*node);
            let signal = Signal { node: *node, what: SignalKind::Torque };
            outputs.push(Output { signal, slot: layout.outputs.slot(i), low, high, slew, safe: 0.0 });
            heights.push(PART * high.min(-low).max(0.0));
        }
        let ticks = |seconds: f64| (seconds / period).round().max(1.0) as u64;
        let (pulse, rest) = (ticks(PULSE), ticks(REST));
        let each = PULSES * pulse + rest;
        let quantities = outputs.iter().map(|output| Quantity {
            path: format!("{}.torque", rig.nodes[output.signal.node].name),
            kind: QuantityKind::Output,
            unit: Unit::none(),
            boolean: false,
            slot: output.slot,
            range: (f64::NEG_INFINITY, f64::INFINITY),
            doc: None,
        });
        let description = Description {
            name: "torque pulses".into(),
            quantities: quantities.collect(),
            layout: layout.clone(),
            ..Description::default()
        };
        let pulses = Pulses { layout, heights, pulse, each };
        let program = Instance::new(Arc::new(description), Code::Interpreted(Arc::new(pulses)), &[]);
        let duration_ns = each * drives.len() as u64 * rig.period_ns;
        let (inputs, stops, record, plots, predict) = (Vec::new(), Vec::new(), Vec::new(), Vec::new(), None);
        let rig = Rig { outputs, inputs, stops, record, plots, predict, steps: 1, ..rig.clone() };
        Ok(Identification { rig, program, duration_ns, drives })
    }

    /// The pulsed drives in order, as indices into the rig's nodes.
    pub fn drives(&self) -> &[usize] {
        &self.drives
    }

    /// Evaluates a recording, drive by drive.
    pub fn evaluate(&self, rows: &[Row]) -> Vec<Found> {
        let period = self.rig.period_ns as f64 * 1e-9;
        let rest = (REST / period) as usize;
        // From the last cycle before its first pulse on: before that, the command of this drive was 0.
        let part = |i: usize| {
            let pulsed = |row: &Row| row.told[i] != 0.0;
            let first = rows.iter().position(pulsed).unwrap_or(0).saturating_sub(1);
            let last = rows.iter().rposition(pulsed).unwrap_or(0);
            &rows[first..(last + rest).min(rows.len())]
        };
        let one = |(i, node): (usize, &usize)| {
            let told: Vec<f64> = part(i).iter().map(|row| row.told[i]).collect();
            let torque: Vec<f64> = part(i).iter().map(|row| row.torque[i]).collect();
            let speed: Vec<f64> = part(i).iter().map(|row| row.speed[i]).collect();
            let (delay, lag, residual) = dead_time_and_lag(&told, &torque, period);
            Found { node: *node, delay, lag, residual, inertia: inertia(&torque, &speed, period) }
        };
        self.drives.iter().enumerate().map(one).collect()
    }
}

/// Rms difference between the measured torque and the commands after dead time and lag, at each SYNC.
fn misfit(told: &[f64], torque: &[f64], period: f64, delayed: f64, lag: f64) -> f64 {
    let h = period / SUBSTEPS as f64;
    let x = h / lag.max(1e-9);
    // The exponential of one substep by its (1, 1) Padé approximant, accurate to x³/12.
    let rest = ((1.0 - x / 2.0) / (1.0 + x / 2.0)).max(0.0);
    let shift = (delayed / h).round() as usize;
    let (mut q, mut sum) = (0.0, 0.0);
    for (k, measured) in torque.iter().enumerate().skip(1) {
        for i in 0..SUBSTEPS {
            let at = ((k - 1) * SUBSTEPS + i).checked_sub(shift);
            let u = at.map_or(0.0, |at| told[at / SUBSTEPS]);
            q = u + (q - u) * rest;
        }
        sum += (q - measured) * (q - measured);
    }
    (sum / told.len() as f64).sqrt()
}

/// Dead time, lag and residual of the best fit: a coarse grid, then a fine one around its best point.
fn dead_time_and_lag(told: &[f64], torque: &[f64], period: f64) -> (f64, f64, f64) {
    let best = |delays: &[f64], lags: &[f64]| {
        let pairs = delays.iter().flat_map(|delay| lags.iter().map(move |lag| (*delay, *lag)));
        let rated = pairs.map(|(delay, lag)| (delay, lag, misfit(told, torque, period, delay, lag)));
        rated.min_by(|a, b| a.2.total_cmp(&b.2)).expect("a grid has points")
    };
    let coarse: Vec<f64> = (0..60).map(|i| 1e-4 * f64::from(i)).collect();
    let (delay, lag, _) = best(&coarse, &coarse[1..]);
    let around = |centre: f64| -> Vec<f64> {
        (-10..=10).map(|i| centre + 1e-5 * f64::from(i)).filter(|value| *value > 0.0).collect()
    };
    best(&around(delay), &around(lag))
}

/// Fits Δω = (∫T dt − friction · sgn ω · t) / J by least squares; returns J.
fn inertia(torque: &[f64], speed: &[f64], period: f64) -> Option<f64> {
    let (mut qq, mut qs, mut ss, mut qd, mut sd) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for k in 1..torque.len() {
        let q = (torque[k - 1] + torque[k]) / 2.0 * period;
        let sign = if speed[k] == 0.0 { 0.0 } else { -period.copysign(speed[k]) };
        let change = speed[k] - speed[k - 1];
        (qq, qs, ss) = (qq + q * q, qs + q * sign, ss + sign * sign);
        (qd, sd) = (qd + q * change, sd + sign * change);
    }
    let det = qq * ss - qs * qs;
    let per_inertia = if det > 1e-9 * qq * ss { (qd * ss - sd * qs) / det } else { qd / qq };
    let fastest = speed.iter().fold(0f64, |most, speed| most.max(speed.abs()));
    (per_inertia.is_finite() && per_inertia > 0.0 && fastest > 0.0).then(|| 1.0 / per_inertia)
}

/// The pulses as a program: one drive after the other.
struct Pulses {
    layout: Layout,
    heights: Vec<f64>,
    /// Duration of a pulse, ticks.
    pulse: u64,
    /// Duration of a drive's pulses and rest, ticks.
    each: u64,
}

impl Interpret for Pulses {
    fn call(&self, function: Function, block: &mut [f64], _: &[f64], count: u64) -> u64 {
        if function == Function::Step {
            block[Slot::COUNT.index()] += count as f64;
        }
        let tick = block[Slot::COUNT.index()] as u64;
        for (i, height) in self.heights.iter().enumerate() {
            let (drive, within) = (tick / self.each, tick % self.each);
            let pulse = within / self.pulse;
            let on = drive == i as u64 && pulse < PULSES;
            let value = match (on, pulse % 2) {
                (false, _) => 0.0,
                (true, 0) => *height,
                (true, _) => -height,
            };
            block[self.layout.outputs.slot(i).index()] = value;
        }
        0
    }

    fn has(&self, function: Function) -> bool {
        matches!(function, Function::Start | Function::Outputs | Function::Step)
    }
}

/// Runs a rig to its end, and records one row per cycle while the program runs.
pub fn rows(hil: &mut super::cycle::Hil, asked: &Identification) -> Vec<Row> {
    let mut rows = Vec::new();
    loop {
        hil.cycle();
        if hil.counts().cycles as usize > rows.len()
            && let Some(control) = hil.control()
        {
            let read = |what| {
                let signal = |node: &usize| hil.fieldbus().reading(Signal { node: *node, what }).value;
                asked.drives.iter().map(signal).collect()
            };
            let told = control.supervisor().permitted().to_vec();
            rows.push(Row { told, torque: read(SignalKind::Torque), speed: read(SignalKind::Speed) });
        }
        if hil.ended().is_some() {
            return rows;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hil::cycle::{End, Hil, Options};
    use crate::hil::simulated::{Pace, World};
    use crate::testing::rigs;

    #[test]
    fn identification_finds_the_values_of_simulated_drives() {
        let (mut rig, _, plant) = rigs::pair();
        for (node, delay, lag) in [(0, 0.8e-3, 0.6e-3), (1, 1.5e-3, 0.5e-3)] {
            (rig.nodes[node].delay, rig.nodes[node].lag) = (delay, lag);
        }
        let asked = Identification::new(&rig).unwrap();
        let mut world = World::new(&rig, Some(plant), Pace::Fast, 1).unwrap();
        let masters = world.masters();
        let mut options = Options { arms_itself: true, duration_ns: Some(asked.duration_ns), ..Options::default() };
        options.control.ramp_ns = 0;
        let program = asked.program.clone();
        let (mut hil, _) = Hil::new(&asked.rig, program, world.clock(), masters, options, None).unwrap();
        let rows = rows(&mut hil, &asked);
        assert_eq!(hil.ended(), Some(&End::Asked));
        let found = asked.evaluate(&rows);
        for (found, (delay, lag)) in found.iter().zip([(0.8e-3, 0.6e-3), (1.5e-3, 0.5e-3)]) {
            assert!((found.delay - delay).abs() < 0.05e-3, "{found:?}");
            assert!((found.lag - lag).abs() < 0.1e-3, "{found:?}");
            let inertia = found.inertia.unwrap();
            assert!((inertia / 0.012 - 1.0).abs() < 0.03, "{found:?}");
        }
    }

    #[test]
    fn a_rig_without_torque_drives_is_refused() {
        let (mut rig, _, _) = rigs::pair();
        for node in &mut rig.nodes {
            if let Kind::Cia402(drive) = &mut node.kind {
                drive.mode = Mode::Speed;
            }
        }
        assert!(Identification::new(&rig).is_err());
    }
}
