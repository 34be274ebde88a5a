//! The conditions that the start of a rig checks on its parameters, as plain data. A set of parameters that arrives
//! later is checked by the same conditions and refused with the same messages.
//!
//! A *judge* program computes the numbers of all conditions from a block of parameters; each [`Check`] names the slots
//! of its numbers in that block. Only the compiler knows how they are computed. It also records for each parameter
//! whether the step reads it, so that it may change while the rig runs, or why only a start reads it.

use crate::description::{Slot, TINY};
use crate::encode::{Encode, Malformed, Reader};
use crate::encode_structs;
use crate::format::{duration, quantity, three_digits};
use crate::unit::Unit;

/// The parameters of a rig and the conditions on them.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Live {
    /// Every parameter of the rig, in the order of the text.
    pub params: Vec<Param>,
    /// The conditions, in the order in which a start reports violations.
    pub checks: Vec<Check>,
    /// The parameters that the rig lets its operator set, in this order; all of them if there are none.
    pub tuned: Vec<Tuned>,
}

/// `tune fr.Fs in 1 N .. 2 N`
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Tuned {
    /// Index into [`Live::params`].
    pub param: usize,
    /// Smallest and largest value that can be set, SI; infinite where the text gives no range.
    pub range: (f64, f64),
}

/// A parameter.
#[derive(Clone, PartialEq, Debug)]
pub struct Param {
    /// Dotted path: `fr.Fs`.
    pub path: String,
    /// The unit it is declared in.
    pub unit: Unit,
    /// Whether it is a Boolean.
    pub boolean: bool,
    /// Whether it may change while the rig runs.
    pub place: Tunable,
}

/// Whether a parameter may change while the rig runs.
#[derive(Clone, PartialEq, Debug)]
pub enum Tunable {
    /// Yes: its slot in the control program and its slot in the judge.
    Live(Slot, Slot),
    /// No, only a start reads it. The reason, as a clause such as "a period follows from it".
    Start(String),
}

/// A condition that a start checks.
#[derive(Clone, PartialEq, Debug)]
pub enum Check {
    /// E0502: a value is in its declared range.
    Range {
        /// Dotted path.
        path: String,
        /// Its own name.
        name: String,
        /// The model that declares it.
        model: String,
        /// The unit for messages.
        unit: Unit,
        /// The value.
        value: Slot,
        /// Lower bound, and whether it is excluded.
        low: Option<(Slot, bool)>,
        /// Upper bound, and whether it is excluded.
        high: Option<(Slot, bool)>,
    },
    /// E0501: a `require` holds.
    Require {
        /// The message if it does not hold.
        message: String,
        /// Not 0 if it holds.
        value: Slot,
    },
    /// E0502: a period is positive.
    Period(Slot),
    /// E0701: a period is an integer number of steps.
    Multiple {
        /// The period, s.
        period: Slot,
        /// The step, s.
        step: f64,
    },
    /// E0802: a constant command fits the field that carries it.
    Carried {
        /// The command: `panel.lamp`.
        path: String,
        /// The unit for messages.
        unit: Unit,
        /// Its value; NaN if it is not constant.
        value: Slot,
        /// Smallest and largest value that the field can carry.
        range: (f64, f64),
    },
}

/// Number of stages. A condition is only checked if all conditions of earlier stages hold: a start ends with the first
/// stage that fails.
pub const STAGES: u8 = 2;

/// Maximum number of values that a condition depends on.
pub const NUMBERS: usize = 3;

impl Check {
    /// Its error code, for `fric explain`.
    pub fn code(&self) -> &'static str {
        match self {
            Check::Range { .. } | Check::Period(_) => "E0502",
            Check::Require { .. } => "E0501",
            Check::Multiple { .. } => "E0701",
            Check::Carried { .. } => "E0802",
        }
    }

    /// Its stage: 0 for conditions on values, 1 for conditions on the rig.
    pub fn stage(&self) -> u8 {
        match self {
            Check::Range { .. } | Check::Require { .. } | Check::Period(_) => 0,
            Check::Multiple { .. } | Check::Carried { .. } => 1,
        }
    }

    /// The slots of its numbers in the block of the judge.
    pub fn slots(&self) -> [Option<Slot>; NUMBERS] {
        match self {
            Check::Range { value, low, high, .. } => [Some(*value), low.map(|it| it.0), high.map(|it| it.0)],
            Check::Require { value, .. } | Check::Carried { value, .. } => [Some(*value), None, None],
            Check::Period(period) | Check::Multiple { period, .. } => [Some(*period), None, None],
        }
    }

    /// Its numbers; NaN for those it does not have.
    pub fn numbers(&self, block: &[f64]) -> [f64; NUMBERS] {
        self.slots().map(|slot| slot.map_or(f64::NAN, |slot| block[slot.index()]))
    }

    /// Whether it holds for its numbers.
    pub fn holds(&self, numbers: [f64; NUMBERS]) -> bool {
        let [value, low, high] = numbers;
        match self {
            Check::Range { low: below, high: above, .. } => {
                let (low, high) = (bound(below, low), bound(above, high));
                !is_empty(low, high) && beyond(value, low, high).is_none()
            }
            Check::Require { .. } => value != 0.0,
            Check::Period(_) => is_period(value),
            Check::Multiple { step, .. } => is_multiple(value, *step),
            // NaN is not constant; a command that changes is checked at run time.
            Check::Carried { range, .. } => !(value < range.0 || value > range.1),
        }
    }

    /// The message for numbers that violate the condition.
    pub fn words(&self, numbers: [f64; NUMBERS]) -> String {
        let [value, low, high] = numbers;
        match self {
            Check::Range { path, name, model, unit, low: below, high: above, .. } => {
                let said = match beyond(value, bound(below, low), bound(above, high)) {
                    Some(beyond) if !is_empty(bound(below, low), bound(above, high)) => {
                        beyond_words(name, model, unit, value, beyond)
                    }
                    _ => nothing_in_range(name),
                };
                if path == name { said } else { format!("{said} (`{path}`)") }
            }
            Check::Require { message, .. } => message.clone(),
            Check::Period(_) => NO_PERIOD.into(),
            Check::Multiple { step, .. } => no_multiple(value, *step),
            Check::Carried { path, unit, .. } => cannot_be(path, unit, value),
        }
    }
}

fn bound(declared: &Option<(Slot, bool)>, number: f64) -> Option<(f64, bool)> {
    declared.map(|(_, strict)| (number, strict))
}

/// The bound of a range that a value violates.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct ViolatedBound {
    /// `above`, `at least`, `below`, `at most`.
    pub word: &'static str,
    /// The bound, SI.
    pub bound: f64,
}

/// The bound that a value violates. Each bound comes with whether it is excluded.
pub fn beyond(value: f64, low: Option<(f64, bool)>, high: Option<(f64, bool)>) -> Option<ViolatedBound> {
    let below = low.filter(|(bound, strict)| value < least(*bound, *strict));
    let above = high.filter(|(bound, strict)| value > greatest(*bound, *strict));
    // A bound that excludes 0 also excludes everything below TINY.
    let tiny = value != 0.0 && value.abs() < TINY;
    let named = |(bound, strict): (f64, bool)| {
        if strict && bound == 0.0 && tiny { (TINY.copysign(value), strict) } else { (bound, strict) }
    };
    match (below.map(named), above.map(named)) {
        (Some((bound, strict)), _) => Some(ViolatedBound { word: if strict { "above" } else { "at least" }, bound }),
        (None, Some((bound, strict))) => Some(ViolatedBound { word: if strict { "below" } else { "at most" }, bound }),
        (None, None) => None,
    }
}

/// The smallest value of a range with this lower bound. `strict`: the bound is excluded.
pub fn least(bound: f64, strict: bool) -> f64 {
    match strict {
        true if bound == 0.0 => TINY,
        true => bound.next_up(),
        false => bound,
    }
}

/// The largest value of a range with this upper bound. `strict`: the bound is excluded.
pub fn greatest(bound: f64, strict: bool) -> f64 {
    -least(-bound, strict)
}

/// Whether the lower bound is above the upper one.
pub fn is_empty(low: Option<(f64, bool)>, high: Option<(f64, bool)>) -> bool {
    matches!((low, high), (Some((low, _)), Some((high, _))) if low > high)
}

/// E0502: the message for a value outside of its range.
pub fn beyond_words(name: &str, model: &str, unit: &Unit, value: f64, beyond: ViolatedBound) -> String {
    let (bound, value) = (quantity(beyond.bound, unit, 3), quantity(value, unit, 3));
    format!("`{name}` of {model} must be {} {bound}, not {value}", beyond.word)
}

/// E0502: the message for a range whose lower bound is above its upper one.
pub fn nothing_in_range(name: &str) -> String {
    format!("nothing lies in the range of `{name}`")
}

/// E0502: the message for an invalid period.
pub const NO_PERIOD: &str = "a period must be positive and known before the run";

/// Whether a value is a valid period.
pub fn is_period(seconds: f64) -> bool {
    seconds > 0.0 && seconds.is_finite()
}

/// Whether a period is an integer number of steps, up to rounding.
pub fn is_multiple(period: f64, step: f64) -> bool {
    let ratio = period / step;
    (ratio - ratio.round()).abs() <= 1e-9 * ratio && ratio.round() >= 1.0
}

/// E0701: the message for a period that is not an integer number of steps.
pub fn no_multiple(period: f64, step: f64) -> String {
    format!("a period of {} is no multiple of the step of {}", duration(period, 3), duration(step, 3))
}

/// E0802: the message for a command that its field cannot carry.
pub fn cannot_be(path: &str, unit: &Unit, value: f64) -> String {
    format!("`{path}` cannot be {}", three_digits(unit.from_si(value)))
}

impl Live {
    /// The parameters that an operator can set, in the order in which a panel shows them, with their ranges in SI.
    pub fn settable(&self) -> impl Iterator<Item = (&Param, (f64, f64))> {
        let all = if self.tuned.is_empty() { &self.params[..] } else { &[] };
        let own = self.tuned.iter().filter_map(|tuned| Some((self.params.get(tuned.param)?, tuned.range)));
        own.chain(all.iter().map(|param| (param, (f64::NEG_INFINITY, f64::INFINITY))))
    }

    /// The parameter with this path.
    pub fn param(&self, path: &str) -> Option<&Param> {
        self.params.iter().find(|param| param.path == path)
    }

    /// The judge's slot for a slot of the control program, if it is a parameter that may change.
    pub fn judged(&self, control: Slot) -> Option<Slot> {
        self.places().find(|(slot, _)| *slot == control).map(|(_, judge)| judge)
    }

    /// Both slots of each parameter that may change: control program, judge.
    pub fn places(&self) -> impl Iterator<Item = (Slot, Slot)> {
        self.params.iter().filter_map(|param| match &param.place {
            Tunable::Live(control, judge) => Some((*control, *judge)),
            Tunable::Start(_) => None,
        })
    }

    /// An inconsistency with the programs, as a message. `params`: the parameter slots of the control program. `judge`:
    /// number of slots of the judge's block.
    pub fn fault(&self, params: std::ops::Range<usize>, judge: usize) -> Option<String> {
        let slots = self.checks.iter().flat_map(|check| check.slots().into_iter().flatten());
        if let Some(slot) = self.places().map(|(_, slot)| slot).chain(slots).find(|slot| slot.index() >= judge) {
            return Some(format!("a condition names slot {} in a block of {judge} slots", slot.0));
        }
        let range = |tuned: &Tuned| tuned.range.0 < tuned.range.1;
        if let Some(tuned) = self.tuned.iter().find(|tuned| tuned.param >= self.params.len() || !range(tuned)) {
            return Some(format!("`tune` has parameter {} from {} to {}", tuned.param, tuned.range.0, tuned.range.1));
        }
        let outside = self.places().find(|(slot, _)| !params.contains(&slot.index()));
        outside.map(|(slot, _)| format!("slot {} of the control program is no parameter", slot.0))
    }
}

encode_structs! {
    Live { params, checks, tuned }
    Tuned { param, range }
    Param { path, unit, boolean, place }
}

impl Encode for Tunable {
    fn encode(&self, out: &mut Vec<u8>) {
        match self {
            Tunable::Live(control, judge) => {
                out.push(0);
                (*control, *judge).encode(out);
            }
            Tunable::Start(why) => {
                out.push(1);
                why.encode(out);
            }
        }
    }

    fn decode(reader: &mut Reader) -> Result<Tunable, Malformed> {
        match u8::decode(reader)? {
            0 => <(Slot, Slot)>::decode(reader).map(|(control, judge)| Tunable::Live(control, judge)),
            1 => String::decode(reader).map(Tunable::Start),
            other => Err(Malformed(format!("{other} is no place of a parameter"))),
        }
    }
}

impl Encode for Check {
    fn encode(&self, out: &mut Vec<u8>) {
        match self {
            Check::Range { path, name, model, unit, value, low, high } => {
                out.push(0);
                [path, name, model].into_iter().for_each(|text| text.encode(out));
                unit.encode(out);
                value.encode(out);
                low.encode(out);
                high.encode(out);
            }
            Check::Require { message, value } => {
                out.push(1);
                message.encode(out);
                value.encode(out);
            }
            Check::Period(period) => {
                out.push(2);
                period.encode(out);
            }
            Check::Multiple { period, step } => {
                out.push(3);
                period.encode(out);
                step.encode(out);
            }
            Check::Carried { path, unit, value, range } => {
                out.push(4);
                path.encode(out);
                unit.encode(out);
                value.encode(out);
                range.encode(out);
            }
        }
    }

    fn decode(reader: &mut Reader) -> Result<Check, Malformed> {
        let kind = u8::decode(reader)?;
        let r = reader;
        Ok(match kind {
            0 => Check::Range {
                path: Encode::decode(r)?,
                name: Encode::decode(r)?,
                model: Encode::decode(r)?,
                unit: Encode::decode(r)?,
                value: Encode::decode(r)?,
                low: Encode::decode(r)?,
                high: Encode::decode(r)?,
            },
            1 => Check::Require { message: Encode::decode(r)?, value: Encode::decode(r)? },
            2 => Check::Period(Encode::decode(r)?),
            3 => Check::Multiple { period: Encode::decode(r)?, step: Encode::decode(r)? },
            4 => Check::Carried {
                path: Encode::decode(r)?,
                unit: Encode::decode(r)?,
                value: Encode::decode(r)?,
                range: Encode::decode(r)?,
            },
            other => return Err(Malformed(format!("{other} is no condition on parameters"))),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn live() -> Live {
        let unit = Unit::parse("N·m").unwrap();
        let param = |path: &str, place| Param { path: path.into(), unit: unit.clone(), boolean: false, place };
        Live {
            params: vec![
                param("fr.Fc", Tunable::Live(Slot(4), Slot(3))),
                param("Ts", Tunable::Start("a period follows from it".into())),
            ],
            checks: vec![
                Check::Range {
                    path: "fr.Fc".into(),
                    name: "Fc".into(),
                    model: "LuGre".into(),
                    unit: unit.clone(),
                    value: Slot(3),
                    low: Some((Slot(5), true)),
                    high: None,
                },
                Check::Require { message: "`Fs` is smaller than `Fc`".into(), value: Slot(6) },
                Check::Period(Slot(7)),
                Check::Multiple { period: Slot(7), step: 1e-3 },
                Check::Carried { path: "panel.lamp".into(), unit, value: Slot(8), range: (0.0, 255.0) },
            ],
            tuned: vec![Tuned { param: 0, range: (0.1, f64::INFINITY) }],
        }
    }

    #[test]
    fn it_round_trips_and_no_byte_causes_a_panic() {
        let bytes = live().to_bytes();
        assert_eq!(Live::from_bytes(&bytes), Ok(live()));
        for at in 0..bytes.len() {
            assert!(Live::from_bytes(&bytes[..at]).is_err(), "cut at {at}");
            for value in [0, 1, 0x7f, 0xff] {
                let mut changed = bytes.clone();
                changed[at] = value;
                if let Ok(read) = Live::from_bytes(&changed) {
                    assert_eq!(read.to_bytes(), changed, "byte {at} as {value}");
                }
            }
        }
    }

    #[test]
    fn excluded_bounds_violate_their_range() {
        for (value, low, high, word) in [
            (0.0, Some((0.0, true)), None, Some("above")),
            (0.0, Some((0.0, false)), None, None),
            (-1.0, Some((0.0, false)), None, Some("at least")),
            (1.0, None, Some((1.0, true)), Some("below")),
            (2.0, Some((0.0, true)), Some((1.0, false)), Some("at most")),
            (f64::NAN, Some((0.0, true)), Some((1.0, true)), None),
        ] {
            assert_eq!(beyond(value, low, high).map(|beyond| beyond.word), word, "{value} in {low:?} .. {high:?}");
        }
        let check = &live().checks[0];
        assert!(!check.holds([0.0, 0.0, f64::NAN]) && check.holds([1e-9, 0.0, f64::NAN]));
        assert_eq!(check.words([0.0, 0.0, f64::NAN]), "`Fc` of LuGre must be above 0 N·m, not 0 N·m (`fr.Fc`)");
    }

    #[test]
    fn a_slot_outside_of_its_block_is_found() {
        assert_eq!(live().fault(3..6, 9), None);
        assert!(live().fault(3..6, 8).is_some_and(|why| why.contains("slot 8")));
        assert!(live().fault(3..4, 9).is_some_and(|why| why.contains("no parameter")));
        for tuned in [
            Tuned { param: 2, range: (0.0, 1.0) },
            Tuned { param: 0, range: (1.0, 1.0) },
            Tuned { param: 0, range: (f64::NAN, 1.0) },
        ] {
            let live = Live { tuned: vec![tuned], ..live() };
            assert!(live.fault(3..6, 9).is_some_and(|why| why.contains("`tune` has parameter")), "{tuned:?}");
        }
    }
}
