//! A parameter as a slider: its ends, its scale, and values as typed.

use crate::words::clean;
use abi::description::{Quantity, TINY};
use abi::format;
use abi::unit::Unit;
use serde_json::{Value, json};

/// A parameter that can be set.
#[derive(Clone, PartialEq, Debug)]
pub struct Knob {
    /// Dotted path.
    pub path: String,
    /// The unit in which it is shown.
    pub unit: Unit,
    doc: Option<String>,
    /// Whether it is a truth value.
    pub boolean: bool,
    range: (f64, f64),
    /// How far `tune` lets it be set, SI.
    pub limit: (f64, f64),
    /// The value of the text, SI.
    pub own: f64,
}

/// The ends of a slider, SI.
#[derive(Clone, Copy, PartialEq, Debug)]
struct Ends {
    from: f64,
    to: f64,
    /// Whether equal distances are equal ratios.
    logarithmic: bool,
}

/// The ends of a slider: the declared range if it is finite; if only its upper end is open, a tenth to ten times a
/// positive value; otherwise plus and minus twice the value. Never outside the declared range.
fn ends(value: f64, (low, high): (f64, f64)) -> Ends {
    if low.is_finite() && high.is_finite() {
        // A range such as `> 0` begins at the smallest number that it allows, which is no end for a slider.
        let low = if low == TINY { 0.0 } else { low };
        return Ends { from: low, to: high, logarithmic: low > 0.0 && high >= 100.0 * low };
    }
    if low >= 0.0 && value > 0.0 {
        return Ends { from: (0.1 * value).max(low), to: 10.0 * value, logarithmic: true };
    }
    // Without an end of its own the page shows no slider.
    let size = if value == 0.0 || !value.is_finite() { 1.0 } else { 2.0 * value.abs() };
    Ends { from: (-size).max(low), to: size.min(high), logarithmic: false }
}

impl Knob {
    /// Of a parameter with its value in the text.
    pub fn new(quantity: &Quantity, own: f64) -> Knob {
        let Quantity { path, unit, doc, boolean, range, .. } = quantity;
        let limit = (f64::NEG_INFINITY, f64::INFINITY);
        Knob { path: path.clone(), unit: unit.clone(), doc: doc.clone(), boolean: *boolean, range: *range, limit, own }
    }

    /// With the limits of `tune`, SI.
    pub fn tuned(self, limit: (f64, f64)) -> Knob {
        let range = (self.range.0.max(limit.0), self.range.1.min(limit.1));
        Knob { range, limit, ..self }
    }

    /// What the page needs to know of it; numbers in its unit.
    pub fn json(&self) -> Value {
        let Ends { from, to, logarithmic } = ends(self.own, self.range);
        json!({
            "path": self.path,
            "unit": self.unit.text,
            "doc": self.doc.as_deref().map(|doc| clean(doc.lines().next().unwrap_or_default().trim())),
            "boolean": self.boolean,
            "from": self.unit.from_si(from),
            "to": self.unit.from_si(to),
            "logarithmic": logarithmic,
            "own": self.unit.from_si(self.own),
        })
    }

    /// A value in SI as it is typed: `0.42 N·m`.
    pub fn text(&self, si: f64) -> String {
        match si {
            si if self.boolean => (si != 0.0).to_string(),
            f64::INFINITY => "inf".into(),
            f64::NEG_INFINITY => "-inf".into(),
            si => format::quantity(si, &self.unit, 9),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use abi::Slot;
    use abi::description::Kind;

    fn knob(path: &str, unit: &str, own: f64, range: (f64, f64)) -> Knob {
        let unit = if unit.is_empty() { Unit::none() } else { Unit::parse(unit).unwrap() };
        let kind = Kind::Param;
        let quantity =
            Quantity { path: path.into(), kind, unit, boolean: path == "on", slot: Slot(3), range, doc: None };
        Knob::new(&quantity, own)
    }

    #[test]
    fn ends_hold_the_value_and_stay_inside_the_range() {
        const INF: f64 = f64::INFINITY;
        let of = |value, range| {
            let Ends { from, to, logarithmic } = ends(value, range);
            assert!(from <= value && value <= to && from < to, "{value} in {range:?}: {from} .. {to}");
            assert!(from >= range.0 || range.0 == TINY, "{from}");
            assert!(to <= range.1 && from.is_finite() && to.is_finite());
            (from, to, logarithmic)
        };
        assert_eq!(of(0.5, (0.0, 1.0)), (0.0, 1.0, false));
        assert_eq!(of(0.5, (TINY, 1.0)), (0.0, 1.0, false));
        assert_eq!(of(5.0, (0.01, 10.0)), (0.01, 10.0, true));
        assert_eq!(of(2.0, (TINY, INF)), (0.2, 20.0, true));
        assert_eq!(of(2.0, (1.0, INF)), (1.0, 20.0, true));
        assert_eq!(of(0.0, (0.0, INF)), (0.0, 1.0, false));
        assert_eq!(of(-3.0, (-INF, INF)), (-6.0, 6.0, false));
        assert_eq!(of(-3.0, (-INF, -1.0)), (-6.0, -1.0, false));
        assert_eq!(of(0.0, (-INF, INF)), (-1.0, 1.0, false));
    }

    #[test]
    fn tune_narrows_the_ends() {
        let tuned = knob("Ti", "s", 0.2, (0.0, 9.0)).tuned((0.1, 0.5));
        assert_eq!(ends(0.2, tuned.range), Ends { from: 0.1, to: 0.5, logarithmic: false });
        let open = knob("Ti", "s", 0.2, (0.0, 9.0)).tuned((f64::NEG_INFINITY, f64::INFINITY));
        assert_eq!(open, knob("Ti", "s", 0.2, (0.0, 9.0)));
    }
}
