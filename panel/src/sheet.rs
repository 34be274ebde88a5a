//! How signals share canvases.

use crate::words::clean;
use abi::plan::{Plot, Series};
use abi::unit::Unit;
use serde_json::{Value, json};

/// A curve's quantity.
#[derive(Clone, PartialEq, Debug)]
pub struct Signal {
    /// As written.
    pub label: String,
    /// The unit in which it is shown.
    pub unit: Unit,
    /// Whether it is a truth value.
    pub boolean: bool,
}

impl Signal {
    /// Of a series.
    pub fn of(series: &Series) -> Signal {
        Signal { label: series.label.clone(), unit: series.unit.clone(), boolean: series.boolean }
    }

    fn json(&self) -> Value {
        json!({ "label": clean(&self.label), "unit": self.unit.text, "boolean": self.boolean })
    }
}

/// Signals and their canvases.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Sheet {
    /// Every signal once.
    pub signals: Vec<Signal>,
    /// Signals that share a canvas; with one more signal, they stand over that one instead of time.
    canvases: Vec<(Vec<usize>, Option<usize>)>,
}

/// A contact in the plane, by the numbers of its signals: a page shows force over speed, force over position, or speed
/// over position.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Phase {
    /// Its force.
    pub force: usize,
    /// Its speed, or that of its shaft.
    pub speed: usize,
    /// The position there.
    pub position: Option<usize>,
}

/// Most curves of a canvas.
const CURVES: usize = 4;

impl Sheet {
    /// Of the plots of the cases of an experiment. Curves of one unit share a canvas, in the order of the text, four at
    /// most. A plot that several cases have, in whatever slots, is there once.
    pub fn of<'a>(cases: impl Iterator<Item = &'a [Plot]>) -> Sheet {
        let mut sheet = Sheet::default();
        let mut placed = Vec::new();
        for plot in cases.flatten() {
            let signals: Vec<usize> = plot.series.iter().map(|series| sheet.signal(Signal::of(series))).collect();
            let against = plot.against.as_ref().map(|series| sheet.signal(Signal::of(series)));
            let whole = (signals, against);
            if !placed.contains(&whole) {
                sheet.place(&whole.0, whole.1);
                placed.push(whole);
            }
        }
        sheet
    }

    /// The number of a signal.
    pub fn signal(&mut self, signal: Signal) -> usize {
        self.signals.iter().position(|other| *other == signal).unwrap_or_else(|| {
            self.signals.push(signal);
            self.signals.len() - 1
        })
    }

    /// Adds canvases for signals.
    pub fn place(&mut self, signals: &[usize], against: Option<usize>) {
        let begin = self.canvases.len();
        for signal in signals {
            let own = &self.signals[*signal];
            let fits = |other: &usize| {
                let other = &self.signals[*other];
                other.unit.text == own.unit.text && other.boolean == own.boolean
            };
            let most = if against.is_some() { 1 } else { CURVES };
            let open = self.canvases[begin..].iter_mut().find(|(all, _)| all.len() < most && fits(&all[0]));
            match open {
                Some((all, _)) => all.push(*signal),
                None => self.canvases.push((vec![*signal], against)),
            }
        }
    }

    /// The contacts among the signals: each `F` of a part, over what the text shows it, or else over the `v` of the same
    /// part, or over the only `v` that there is. The position is the `x` of whose `v` that is.
    pub fn phases(&self) -> Vec<Phase> {
        let named = |label: &str, name: &str| {
            label.strip_suffix(name).is_some_and(|part| part.is_empty() || part.ends_with('.'))
        };
        let find = |label: &str| self.signals.iter().position(|signal| signal.label == label);
        let speeds: Vec<usize> = (0..self.signals.len()).filter(|at| named(&self.signals[*at].label, "v")).collect();
        let phase = |force: usize| {
            let label = &self.signals[force].label;
            let part = label.strip_suffix('F').filter(|_| named(label, "F"))?;
            let shown = self.canvases.iter().find(|(all, against)| against.is_some() && all.contains(&force));
            let speed = match shown {
                Some((_, over)) => over.filter(|over| speeds.contains(over)),
                None => find(&format!("{part}v")).or(match speeds[..] {
                    [only] => Some(only),
                    _ => None,
                }),
            }?;
            let whose = self.signals[speed].label.strip_suffix('v')?;
            Some(Phase { force, speed, position: find(&format!("{whose}x")) })
        };
        (0..self.signals.len()).filter_map(phase).collect()
    }

    /// Adds a canvas for each contact that has none.
    pub fn place_phases(&mut self) {
        for Phase { force, speed, .. } in self.phases() {
            if !self.canvases.contains(&(vec![force], Some(speed))) {
                self.canvases.push((vec![force], Some(speed)));
            }
        }
    }

    /// The contacts, for the page.
    pub fn phases_json(&self) -> Value {
        let json = |Phase { force, speed, position }| json!({ "force": force, "speed": speed, "position": position });
        self.phases().into_iter().map(json).collect()
    }

    /// For the page.
    pub fn json(&self) -> (Value, Value) {
        let signals: Vec<Value> = self.signals.iter().map(Signal::json).collect();
        let canvases = self.canvases.iter().map(|(signals, against)| json!({ "signals": signals, "against": against }));
        (signals.into(), canvases.collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use abi::Slot;
    use abi::plan::View;

    #[test]
    fn curves_of_one_unit_share_a_canvas_in_the_order_of_the_text() {
        let in_slot = |slot: u32, label: &str, unit: &str| {
            let unit = Unit::parse(unit).unwrap();
            Series { label: label.into(), slot: Slot(slot), unit, boolean: false }
        };
        let series = |label: &str, unit: &str| in_slot(3, label, unit);
        let plots = [
            Plot {
                series: vec![series("x", "m"), series("v", "m/s"), series("r", "m")],
                against: None,
                view: View::default(),
            },
            Plot { series: vec![series("F", "N")], against: Some(series("v", "m/s")), view: View::default() },
            Plot {
                series: (0..6).map(|i| series(&format!("a{i}"), "N")).collect(),
                against: None,
                view: View::default(),
            },
        ];
        // Another case has the first plot in other slots, and one of its own.
        let others = [
            Plot {
                series: vec![in_slot(7, "x", "m"), in_slot(8, "v", "m/s"), in_slot(9, "r", "m")],
                against: None,
                view: View::default(),
            },
            Plot { series: vec![in_slot(7, "z", "m")], against: None, view: View::default() },
        ];
        let sheet = Sheet::of([&plots[..], &others[..]].into_iter());
        let labels: Vec<&str> = sheet.signals.iter().map(|signal| signal.label.as_str()).collect();
        assert_eq!(labels, ["x", "v", "r", "F", "a0", "a1", "a2", "a3", "a4", "a5", "z"]);
        assert_eq!(
            sheet.canvases,
            [
                (vec![0, 2], None),
                (vec![1], None),
                (vec![3], Some(1)),
                (vec![4, 5, 6, 7], None),
                (vec![8, 9], None),
                (vec![10], None)
            ]
        );
    }

    #[test]
    fn a_force_stands_over_its_speed() {
        let sheet = |labels: &[&str], planes: &[(usize, usize)]| {
            let mut sheet = Sheet::default();
            for label in labels {
                let unit = Unit::parse("1").unwrap();
                sheet.signal(Signal { label: (*label).into(), unit, boolean: false });
            }
            planes.iter().for_each(|(y, x)| sheet.place(&[*y], Some(*x)));
            sheet
        };
        let phase = |force, speed, position| Phase { force, speed, position };
        for (labels, planes, wanted) in [
            // The speed of its own part first, then the only one.
            (&["x", "v", "fr.F", "fr.v"][..], &[][..], &[phase(2, 3, None)][..]),
            (&["body.x", "body.v", "fr.F"], &[], &[phase(2, 1, Some(0))]),
            (&["x", "v", "F"], &[], &[phase(2, 1, Some(0))]),
            (&["a.v", "b.v", "fr.F"], &[], &[]),
            // What the text says comes before all.
            (&["a.v", "b.v", "fr.F", "b.x"], &[(2, 1)], &[phase(2, 1, Some(3))]),
            (&["x", "v", "fr.F"], &[(2, 0)], &[]),
            (&["CF", "v", "conv", "F_load"], &[], &[]),
        ] {
            let mut sheet = sheet(labels, planes);
            assert_eq!(sheet.phases(), wanted, "{labels:?} {planes:?}");
            sheet.place_phases();
            let count = sheet.canvases.len();
            sheet.place_phases();
            assert_eq!(sheet.canvases.len(), count);
            assert!(wanted.iter().all(|one| sheet.canvases.contains(&(vec![one.force], Some(one.speed)))));
        }
    }
}
