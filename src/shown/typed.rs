//! Values of parameters as they are typed on the page of a simulation.
//!
//! In: `PATH = VALUE, …`. Out: the numbers of the parameters and their values in SI, or what is wrong.

use crate::quantity;
use panel::knob::Knob;
use panel::words::clean;
use runtime::hil::line::{Assignment, assignments};

/// A typed value in SI.
///
/// # Errors
/// What is wrong with it.
fn value(knob: &Knob, text: &str) -> Result<f64, String> {
    if knob.boolean {
        return match text {
            "true" => Ok(1.0),
            "false" => Ok(0.0),
            _ => Err(format!("`{}` is true or false, not `{}`", knob.path, clean(text))),
        };
    }
    // A value without end has no unit; only where the text has one.
    if text == "inf" && knob.own == f64::INFINITY || text == "-inf" && knob.own == f64::NEG_INFINITY {
        return Ok(knob.own);
    }
    let (si, unit) = quantity::parse(text).map_err(|why| clean(&why))?;
    if unit.dimension == knob.unit.dimension || si == 0.0 && unit.text.is_empty() {
        let (low, high) = knob.limit;
        if si < low || si > high {
            let [low, high, si] = [low, high, si].map(|si| knob.text(si));
            return Err(format!("E0502: `{}` is tuned from {low} to {high}, not to {si}", knob.path));
        }
        return Ok(si);
    }
    let (wanted, found) = (knob.unit.dimension.describe(), unit.dimension.describe());
    Err(format!("`{}` is {wanted}, not {found}: type it as in {}", knob.path, knob.text(knob.own)))
}

/// Reads `PATH = VALUE, …`: the numbers of the knobs and their values in SI.
///
/// # Errors
/// What is wrong with it; then nothing is set.
pub fn set(text: &str, knobs: &[Knob]) -> Result<Vec<(usize, f64)>, String> {
    let one = |Assignment { path, value }: Assignment| {
        let path = path.as_str();
        let Some(at) = knobs.iter().position(|knob| knob.path == path) else {
            let near = crate::compile::nearest(path, knobs.iter().map(|knob| knob.path.as_str()));
            let help = near.map_or(String::new(), |near| format!("; did you mean `{near}`?"));
            return Err(format!("there is no parameter `{}` to set{help}", clean(path)));
        };
        Ok((at, self::value(&knobs[at], &value)?))
    };
    assignments(text)?.into_iter().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use abi::Slot;
    use abi::description::{Kind, Quantity};
    use abi::unit::Unit;

    fn knob(path: &str, unit: &str, own: f64, range: (f64, f64)) -> Knob {
        let unit = if unit.is_empty() { Unit::none() } else { Unit::parse(unit).unwrap() };
        let kind = Kind::Param;
        let quantity =
            Quantity { path: path.into(), kind, unit, boolean: path == "on", slot: Slot(3), range, doc: None };
        Knob::new(&quantity, own)
    }

    #[test]
    fn values_are_read_in_any_unit_that_fits() {
        let all =
            [knob("fr.Fs", "N·m", 0.42, (0.0, 1.0)), knob("Ti", "s", 0.2, (0.0, 9.0)), knob("on", "", 1.0, (0.0, 1.0))];
        assert_eq!(set("fr.Fs = 310 mN·m", &all), Ok(vec![(0, 0.31)]));
        assert_eq!(set("Ti=20 ms , fr.Fs = 0, on = false", &all), Ok(vec![(1, 0.02), (0, 0.0), (2, 0.0)]));
        let tuned = [knob("Ti", "s", 0.2, (0.0, 9.0)).tuned((0.1, 0.5))];
        assert_eq!(set("Ti = 500 ms", &tuned), Ok(vec![(0, 0.5)]));
        let refused = set("Ti = 0.6 s", &tuned).unwrap_err();
        assert_eq!(refused, "E0502: `Ti` is tuned from 0.1 s to 0.5 s, not to 0.6 s");
        let endless = [knob("vd", "m/s", f64::INFINITY, (0.0, f64::INFINITY))];
        assert_eq!(set("vd = inf", &endless), Ok(vec![(0, f64::INFINITY)]));
        assert_eq!(set("vd = 3 mm/s", &endless), Ok(vec![(0, 0.003)]));
        for (text, why) in [
            ("Ti = inf", "does not begin with a number"),
            ("fr.Fs = 0.3", "`fr.Fs` is"),
            ("fr.Fs = 0.3 s", "type it as in 0.42 N·m"),
            ("fr.Fx = 0.3 N·m", "did you mean `fr.Fs`?"),
            ("fr.Fs 0.3 N·m", "write `set PATH = VALUE`"),
            ("Ti = 1 s, fr.Fs = x", "does not begin with a number"),
            ("on = 2", "true or false"),
            ("", "write `set PATH = VALUE, PATH = VALUE`"),
        ] {
            let found = set(text, &all);
            assert!(found.as_ref().is_err_and(|found| found.contains(why)), "{text}: {found:?}");
        }
    }

    #[test]
    fn what_is_shown_is_read_back_to_the_same_value() {
        let knob = knob("fr.Fs", "mN", 0.0, (-1e9, 1e9));
        for i in -300..300 {
            let si = f64::from(i) * 1.37e-5;
            let again = value(&knob, &knob.text(si)).unwrap();
            assert!((again - si).abs() <= 1e-8 * si.abs(), "{si} {again}");
        }
    }
}
