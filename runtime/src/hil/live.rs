//! Changes of parameters while a rig runs: typed text becomes a set, and the conditions of a start are checked for the
//! set.
//!
//! In: the compiler's description of the parameters ([`Live`]), and the program that computes the numbers of all
//! conditions. Out: whether the rig would start with the values that a set leads to; if not, the message of such a
//! start. Judging allocates nothing, so that the cycle itself can do it, with the model's values at that moment: of
//! several waiting sets, none is judged by values that another one changes later.

use super::line::{Assignment, distance};
use crate::safety::{Protection, is_present};
use abi::description::Guard;
use abi::format::{quantity, three_digits};
use abi::live::{Live, NUMBERS, Tunable};
use abi::unit::{self, NoQuantity, Unit};
use abi::{Function, Instance, Slot};
use std::sync::Arc;

/// Most parameters that can change in one set.
pub const SET_MOST: usize = 64;
/// Most violated conditions that are reported for a refused set.
pub const TOLD: usize = 3;

/// New values of parameters, SI, which take effect together.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Set {
    slots: [(Slot, f64); SET_MOST],
    len: usize,
}

impl Set {
    /// Slots of the control program with their values; none if there are more than [`SET_MOST`].
    pub fn new(values: &[(Slot, f64)]) -> Option<Set> {
        let mut slots = [(Slot::TIME, 0.0); SET_MOST];
        slots.get_mut(..values.len())?.copy_from_slice(values);
        Some(Set { slots, len: values.len() })
    }

    /// Slots and values.
    pub fn values(&self) -> &[(Slot, f64)] {
        &self.slots[..self.len]
    }
}

/// Reason to refuse a set.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Objection {
    /// The slot is not that of a parameter that may change.
    NotLive(Slot),
    /// A value is not finite.
    NotFinite(Slot),
    /// Violated conditions: the indices and numbers of the first ones, and how many there are.
    Broken([(u32, [f64; NUMBERS]); TOLD], u32),
    /// The model could not continue: its status, 0 if its values were not finite.
    Model(u64),
}

/// Judges sets.
#[derive(Clone)]
pub struct Judge {
    live: Arc<Live>,
    program: Instance,
    guards: Arc<[Guard]>,
}

impl Judge {
    /// A judge. `program`: its `Outputs` compute the numbers of all conditions from the parameters, if there are
    /// conditions; `control`: the program whose parameters change.
    ///
    /// # Errors
    /// A message, if the conditions and the two programs do not belong together.
    pub fn new(live: Live, program: Instance, control: &Instance) -> Result<Judge, String> {
        let description = control.description();
        match live.fault(description.layout.params.range(), program.block().len()) {
            Some(fault) => Err(format!("the conditions on its parameters: {fault}")),
            None if live.checks.iter().any(|_| !program.has(Function::Outputs)) => {
                Err("the conditions on its parameters: nothing computes their numbers".into())
            }
            None => Ok(Judge { live: Arc::new(live), program, guards: Arc::from(description.guards.clone()) }),
        }
    }

    /// Description of the parameters.
    pub fn live(&self) -> &Live {
        &self.live
    }

    /// Judges a set. `present`: the block of the control program.
    ///
    /// # Errors
    /// The objection of a start with the same values.
    pub fn judge(&mut self, present: &[f64], set: &[(Slot, f64)]) -> Result<(), Objection> {
        for (control, judge) in self.live.places() {
            self.program.set(judge, present[control.index()]);
        }
        for (slot, value) in set {
            let Some(judge) = self.live.judged(*slot) else { return Err(Objection::NotLive(*slot)) };
            if !value.is_finite() {
                return Err(Objection::NotFinite(*slot));
            }
            self.program.set(judge, *value);
        }
        self.conditions()
    }

    /// Checks that the values in the block of the control program satisfy all conditions of a start.
    ///
    /// # Errors
    /// The violated conditions.
    pub fn holds(&mut self, present: &[f64]) -> Result<(), Objection> {
        self.judge(present, &[])
    }

    fn conditions(&mut self) -> Result<(), Objection> {
        if !is_present(Protection::Judged) {
            return Ok(());
        }
        if !self.live.checks.is_empty() {
            self.program.call(Function::Outputs);
        }
        let (mut broken, mut count) = ([(0, [0.0; NUMBERS]); TOLD], 0);
        let mut stage = u8::MAX;
        // A start reports only its first stage with a violated condition.
        for (k, check) in self.live.checks.iter().enumerate() {
            let numbers = check.numbers(self.program.block());
            if check.stage() > stage || check.holds(numbers) {
                continue;
            }
            if check.stage() < stage {
                (stage, count) = (check.stage(), 0);
            }
            if let Some(place) = broken.get_mut(count as usize) {
                *place = (k as u32, numbers);
            }
            count += 1;
        }
        if count == 0 { Ok(()) } else { Err(Objection::Broken(broken, count)) }
    }

    /// Error codes of the violated conditions, each once, as a start reports them.
    pub fn codes(&self, objection: &Objection) -> Vec<&'static str> {
        let Objection::Broken(broken, count) = objection else { return Vec::new() };
        let mut codes: Vec<&str> =
            broken.iter().take(*count as usize).map(|(k, _)| self.live.checks[*k as usize].code()).collect();
        codes.sort_unstable();
        codes.dedup();
        codes
    }

    /// The message for a refused set.
    pub fn words(&self, objection: &Objection) -> String {
        let path = |slot: Slot| {
            let here = |place: &Tunable| matches!(place, Tunable::Live(control, _) if *control == slot);
            let found = self.live.params.iter().find(|param| here(&param.place));
            found.map_or_else(|| format!("slot {}", slot.0), |param| format!("`{}`", param.path))
        };
        match objection {
            Objection::NotLive(slot) => format!("{} is no parameter that may change while the rig runs", path(*slot)),
            Objection::NotFinite(slot) => format!("{} must be a finite number", path(*slot)),
            Objection::Broken(broken, count) => {
                let told = broken.iter().take(*count as usize).map(|(k, numbers)| {
                    let check = &self.live.checks[*k as usize];
                    format!("{}: {}", check.code(), check.words(*numbers))
                });
                let mut said = told.collect::<Vec<_>>().join("; ");
                if *count as usize > TOLD {
                    said += &format!("; and {} more", *count as usize - TOLD);
                }
                said
            }
            Objection::Model(0) => "the model gives no number with it, and goes on without".into(),
            Objection::Model(status) => {
                let guard = usize::try_from(*status).ok().and_then(|status| self.guards.get(status.wrapping_sub(1)));
                let what = guard
                    .map_or_else(|| format!("status {status}"), |guard| format!("`{}` leaves its range", guard.path));
                format!("the model cannot go on with it ({what}), and goes on without")
            }
        }
    }

    /// Makes one set of `fr.Fs = 2 N, fr.Fc = 1.5 N`.
    ///
    /// # Errors
    /// A message, with the error code of a start where there is one.
    pub fn read(&self, all: &[Assignment]) -> Result<Set, String> {
        let mut values: Vec<(Slot, f64)> = Vec::new();
        for Assignment { path, value } in all {
            let (path, value) = (path.as_str(), value.as_str());
            let Some(param) = self.live.param(path) else { return Err(self.unknown(path)) };
            let slot = match &param.place {
                Tunable::Live(slot, _) => *slot,
                Tunable::Start(why) => {
                    return Err(format!("only a start reads `{path}`: {why}; start with `--set {path}={value}`"));
                }
            };
            let range = self.range(path)?;
            if values.iter().any(|(other, _)| *other == slot) {
                return Err(format!("`{path}` stands twice in this set"));
            }
            let si = match (param.boolean, value) {
                (true, "true") => 1.0,
                (true, "false") => 0.0,
                (true, _) => return Err(format!("E0101: `{path}` is true or false, not `{value}`")),
                (false, _) => in_unit(path, &param.unit, value)?,
            };
            if si < range.0 || si > range.1 {
                let shown = |si: f64| quantity(si, &param.unit, 3);
                return Err(format!(
                    "E0502: the rig lets `{path}` be set from {} to {} (`tune`), not to {}",
                    shown(range.0),
                    shown(range.1),
                    shown(si)
                ));
            }
            values.push((slot, si));
        }
        Set::new(&values)
            .ok_or_else(|| format!("at most {SET_MOST} parameters change at once, and these are {}", values.len()))
    }

    /// How far a parameter may be set, SI; a message if `tune` names others only.
    fn range(&self, path: &str) -> Result<(f64, f64), String> {
        if let Some((_, range)) = self.live.settable().find(|(param, _)| param.path == path) {
            return Ok(range);
        }
        let names: Vec<&str> = self.live.settable().map(|(param, _)| param.path.as_str()).collect();
        Err(format!("the rig does not let `{path}` be set: its `tune` names {}", names.join(", ")))
    }

    fn unknown(&self, path: &str) -> String {
        let paths = self.live.params.iter().map(|param| param.path.as_str());
        let near =
            paths.map(|other| (distance(path, other), other)).min().filter(|(far, _)| *far <= 2.max(path.len() / 4));
        let help = near.map_or(String::new(), |(_, near)| format!("; did you mean `{near}`?"));
        format!("there is no parameter `{path}`{help}")
    }
}

/// Converts a number with a unit to SI, for a parameter with another unit of the same dimension.
fn in_unit(path: &str, unit: &Unit, text: &str) -> Result<f64, String> {
    let (number, given) = unit::quantity(text).map_err(|why| match why {
        NoQuantity::Number(_) => format!("`{path}` is set to a number with its unit: {why}"),
        NoQuantity::Unit(_) => format!("E0102: {why}"),
    })?;
    if given.dimension == unit.dimension || number == 0.0 && given.text.is_empty() {
        return Ok(given.to_si(number));
    }
    Err(match given.text.is_empty() {
        true => format!("E0103: `{}` needs a unit: write `{} {unit}`", three_digits(number), three_digits(number)),
        false => {
            format!("E0101: `{path}` is {}, not {}", unit.dimension.describe(), given.dimension.describe())
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;
    use crate::testing::rigs;
    use abi::live::Tuned;

    /// Random `tune`s and random sets, judged by what they were made of.
    #[test]
    fn tune_lets_exactly_its_parameters_be_set_within_their_ranges() {
        let (_, model, _) = rigs::pair();
        let judge = rigs::judge(&model);
        let (mut taken, mut refused) = (0, 0);
        for seed in 1..=4000 {
            let mut chance = Chance(seed);
            let mut hundredth = |below: u64| chance.below(below) as f64 / 100.0;
            let mut tuned = Vec::new();
            for param in 0..3 {
                let (low, width, which) = (hundredth(50), 0.01 + hundredth(50), hundredth(4));
                let range = if which < 0.015 { (f64::NEG_INFINITY, f64::INFINITY) } else { (low, low + width) };
                if which > 0.005 {
                    tuned.push(Tuned { param, range });
                }
            }
            let (at, value) = (chance.below(3) as usize, 0.005 + chance.below(120) as f64 / 100.0);
            let live = Live { tuned: tuned.clone(), ..(*judge.live).clone() };
            let judge = Judge { live: Arc::new(live), ..judge.clone() };
            let (path, unit) = [("T", "N·m"), ("d", "N·m·s/rad"), ("end", "s")][at];
            let found = judge.read(&[Assignment { path: path.into(), value: format!("{value} {unit}") }]);
            let own = tuned.iter().find(|tuned| tuned.param == at);
            let allowed = tuned.is_empty() || own.is_some_and(|own| (own.range.0..=own.range.1).contains(&value));
            match &found {
                Ok(set) => assert!(allowed && set.values().len() == 1, "seed {seed}: {path} = {value} by {tuned:?}"),
                Err(why) => assert!(!allowed && why.contains("tune"), "seed {seed}: {path} = {value}: {why}"),
            }
            *(if allowed { &mut taken } else { &mut refused }) += 1;
        }
        assert!(taken > 500 && refused > 500, "{taken} taken, {refused} refused");
    }
}
