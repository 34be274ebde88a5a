//! Values and instances as texts: for display, and for insertion into a program.
//!
//! In: values, instances as typed. Out: texts. Knows no session.

use crate::quantity;
use abi::unit::Unit;
use grammar::span::FileId;

/// A quantity or a truth value.
#[derive(Clone, PartialEq, Debug)]
pub struct Value {
    /// In SI; 1 and 0 for true and false.
    pub si: f64,
    /// The declared unit, or that of SI.
    pub unit: Unit,
    /// Whether it is a truth value.
    pub boolean: bool,
}

/// A value in a suitable unit: `20 mN`, `1.5 µm`, `true`.
pub fn plain(value: &Value) -> String {
    if value.boolean {
        return if value.si > 0.5 { "true".into() } else { "false".into() };
    }
    let unit = &value.unit;
    // A declared unit stays; an SI unit gets a prefix of suitable size.
    if unit.scale == 1.0 && !unit.text.is_empty() && value.si != 0.0 && value.si.is_finite() {
        let size = value.si.abs();
        let prefixes = [("", 1.0), ("m", 1e-3), ("u", 1e-6), ("n", 1e-9), ("k", 1e3), ("M", 1e6), ("G", 1e9)];
        let fits = |scale: f64| (0.999_999_5 * scale..999.999_5 * scale).contains(&size);
        let chosen = prefixes.iter().filter(|(_, scale)| fits(*scale)).find_map(|(prefix, _)| {
            let prefixed = Unit::parse(&format!("{prefix}{}", unit.text)).ok()?;
            (prefixed.dimension == unit.dimension).then_some(prefixed)
        });
        if let Some(chosen) = chosen {
            return quantity::show(value.si, &chosen, 6);
        }
    }
    quantity::show(value.si, unit, 6)
}

/// A value as a text that parses to exactly that value.
pub(super) fn literal(value: &Value) -> String {
    if value.boolean {
        return if value.si > 0.5 { "true".into() } else { "false".into() };
    }
    let unit = Unit::si(value.unit.dimension).text;
    let number = format!("{:?}", value.si.abs());
    let number = if value.si.is_infinite() { "inf".into() } else { number };
    let space = if unit.is_empty() || value.si.is_infinite() { String::new() } else { format!(" {unit}") };
    if value.si < 0.0 { format!("(-{number}{space})") } else { format!("({number}{space})") }
}

/// The unit after the number at the beginning of a text.
pub(super) fn unit_as_typed(text: &str) -> Option<Unit> {
    let text = text.trim().trim_start_matches('-').trim_start();
    quantity::parse(text).ok().map(|(_, unit)| unit).filter(|unit| !unit.text.is_empty())
}

pub(super) fn counted(n: usize, one: &str) -> String {
    format!("{n} {one}{}", if n == 1 { "" } else { "s" })
}

/// `LuGre(v = 0, vd = 10 mm/s)`: an instance with further arguments.
pub(super) fn with_inputs<'a>(instance: &str, more: impl Iterator<Item = (&'a str, &'a str)>) -> String {
    let more: Vec<String> = more.map(|(name, value)| format!("{name} = {value}")).collect();
    let (Some(close), false) = (instance.rfind(')'), more.is_empty()) else { return instance.to_string() };
    let before = instance[..close].trim_end();
    let comma = if before.ends_with('(') { "" } else { ", " };
    format!("{before}{comma}{}{}", more.join(", "), &instance[close..])
}

/// An instance with one argument replaced.
pub(super) fn rewired(instance: &str, name: &str, value: &str) -> String {
    let (read, _) = grammar::parse::parse_instance(FileId(0), instance);
    let bound = read.and_then(|read| read.args.into_iter().find(|arg| arg.name.text == name));
    match bound {
        Some(arg) => {
            format!("{}{name} = {value}{}", &instance[..arg.span.range().start], &instance[arg.span.range().end..])
        }
        None => with_inputs(instance, std::iter::once((name, value))),
    }
}

/// The model name of an instance.
pub(super) fn model_of(instance: &str) -> String {
    let written = instance.trim();
    let written = written.strip_prefix("rotary ").unwrap_or(written);
    written.split('(').next().unwrap_or(written).split(" for ").next().unwrap_or_default().trim().to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::repl::Session;

    fn quantity(si: f64, unit: &str) -> Value {
        Value { si, unit: Unit::parse(unit).unwrap(), boolean: false }
    }

    #[test]
    fn values_are_shown_in_handy_units() {
        assert_eq!(plain(&quantity(0.02, "N")), "20 mN");
        assert_eq!(plain(&quantity(1e5, "N/m")), "100 kN/m");
        assert_eq!(plain(&quantity(1.5, "N")), "1.5 N");
        assert_eq!(plain(&quantity(0.0, "N")), "0 N");
        assert_eq!(plain(&quantity(1.5e-5, "um")), "15 µm");
        assert_eq!(plain(&quantity(3.0, "1")), "3");
        assert_eq!(plain(&quantity(2.0, "kg")), "2 kg");
        assert_eq!(plain(&Value { boolean: true, ..quantity(1.0, "1") }), "true");
    }

    #[test]
    fn arguments_are_added_and_replaced() {
        assert_eq!(with_inputs("LuGre()", [("v", "0")].into_iter()), "LuGre(v = 0)");
        assert_eq!(with_inputs("LuGre(Fs = 2 N)", [("v", "0")].into_iter()), "LuGre(Fs = 2 N, v = 0)");
        assert_eq!(rewired("LuGre(v = 1 m/s, Fs = 2 N)", "v", "swept"), "LuGre(v = swept, Fs = 2 N)");
        assert_eq!(rewired("LuGre(Fs = 2 N)", "v", "swept"), "LuGre(Fs = 2 N, v = swept)");
    }

    #[test]
    fn a_literal_parses_to_the_same_number() {
        for si in [0.1 + 0.2, -1e-300, 5e17, 0.0] {
            let text = literal(&quantity(si, "N"));
            let mut session = Session::default();
            let Ok(value) = session.value(&text) else { panic!("{text}") };
            assert_eq!(value.si.to_bits(), si.to_bits(), "{text}");
        }
    }
}
