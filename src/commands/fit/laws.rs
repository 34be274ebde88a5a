//! Standard laws for a recording that comes without a text: a fit of each, with ranges from the data.
//!
//! In: the recording as CSV. Out: a text with a fit for each law. A range spans what the data can tell of a parameter of
//! its dimension: forces by the largest one, speeds by those that occur, stiffnesses by force and path.

use crate::compile::{Columns, Fault, Selector, read_columns};
use abi::unit::Unit;
use std::fmt::Write;

/// Columns of a recording with their units in SI, and the velocity as an argument of a law.
type Shape = (&'static [(&'static str, &'static str)], &'static str);

const SHAPES: [Shape; 3] = [
    (&[("t", "s"), ("v", "m/s"), ("F", "N")], "data.v"),
    (&[("t", "s"), ("x", "m"), ("F", "N")], "slope(data.x)"),
    (&[("v", "m/s"), ("F", "N")], "data.v"),
];

/// What the parameter of a law is.
#[derive(Clone, Copy)]
enum Kind {
    Coulomb,
    Stiction,
    Stribeck,
    Viscous,
    Stiffness,
    MicroDamping,
}

use Kind::{Coulomb, MicroDamping, Stiction, Stiffness, Stribeck, Viscous};

/// A law: its model and its parameters.
type Law = (&'static str, &'static [(&'static str, Kind)]);

const STATIC: [Law; 5] = [
    ("Coulomb", &[("Fc", Coulomb)]),
    ("CoulombViscous", &[("Fc", Coulomb), ("Fv", Viscous)]),
    ("Tustin", &[("Fc", Coulomb), ("Fs", Stiction), ("vs", Stribeck), ("Fv", Viscous)]),
    ("StribeckGauss", &[("Fc", Coulomb), ("Fs", Stiction), ("vs", Stribeck), ("Fv", Viscous)]),
    ("StribeckLorentz", &[("Fc", Coulomb), ("Fs", Stiction), ("vs", Stribeck), ("Fv", Viscous)]),
];

/// Laws with states, for recordings over time.
const DYNAMIC: [Law; 3] = [
    ("Dahl", &[("Fc", Coulomb), ("sigma", Stiffness)]),
    ("MaxwellElement", &[("W", Coulomb), ("k", Stiffness)]),
    (
        "LuGre",
        &[
            ("Fc", Coulomb),
            ("Fs", Stiction),
            ("vs", Stribeck),
            ("sigma0", Stiffness),
            ("sigma1", MicroDamping),
            ("sigma2", Viscous),
        ],
    ),
];

/// Least number of rows.
const LEAST: usize = 20;

/// What the ranges come from, in SI.
struct Extent {
    /// A large force.
    force: f64,
    /// A large and a small speed.
    fast: f64,
    slow: f64,
    /// The path between the ends of the motion; none for steady points.
    path: f64,
}

/// A text with a fit for each law. `recording`: the recording as CSV; `file`: how the text names it.
///
/// # Errors
/// What the recording lacks, in words.
pub fn text(recording: &str, file: &str) -> Result<String, String> {
    let heading = recording.lines().find(|line| !line.trim().is_empty() && !line.trim_start().starts_with('#'));
    let heading = heading.ok_or("it is empty")?;
    let selectors =
        |shape: &Shape| -> Vec<Selector> { shape.0.iter().map(|(name, _)| Selector::Headed(name)).collect() };
    let shape = SHAPES.iter().find(|shape| read_columns(heading, &selectors(shape)).is_ok());
    let shape = shape.ok_or_else(|| {
        format!(
            "its heading has neither t, v, F nor t, x, F nor v, F: `{heading}`; write one, such as `t [s],v [mm/s],F [N]`, or a fit that names the columns"
        )
    })?;
    let read = read_columns(recording, &selectors(shape));
    let Columns { numbers, units, .. } = read.map_err(|Fault { what, help }| format!("{what}\n  mend: {help}"))?;
    let mut columns = Vec::new();
    let mut data: Vec<Vec<f64>> = Vec::new();
    for (((name, si), unit), numbers) in shape.0.iter().zip(units).zip(numbers) {
        let unit = unit.ok_or_else(|| format!("its heading states no unit of `{name}`: write `{name} [{si}]`"))?;
        let wanted = Unit::parse(si).map_err(|part| format!("unknown unit `{part}`"))?;
        if unit.dimension != wanted.dimension {
            return Err(format!("its column `{name}` is in {unit}, not in {si} or the like"));
        }
        columns.push(format!("{name} [{unit}]"));
        data.push(numbers.iter().map(|number| unit.to_si(*number)).collect());
    }
    let steady = data.len() == 2;
    let (motion, force) = (&data[data.len() - 2], &data[data.len() - 1]);
    if motion.len() < LEAST {
        return Err(format!("it has {} rows; {LEAST} or more are needed", motion.len()));
    }
    let time = (!steady).then_some(&data[0][..]);
    let extent = match shape.1 {
        "data.v" => extent(motion, time.map_or(f64::NAN, |t| path(&travelled(t, motion))), force),
        _ => extent(&slopes(&data[0], motion), path(motion), force),
    }
    .ok_or("nothing moves in it, or it has no force")?;
    let laws: Vec<&Law> = if steady { STATIC.iter().collect() } else { STATIC.iter().chain(&DYNAMIC).collect() };
    let mut out = "import std.friction\n".to_string();
    let against = if shape.1 == "data.v" { "data.v" } else { "data.x" };
    for (model, parameters) in laws {
        let vary = parameters.iter().map(|(name, kind)| format!("{name} {}", range(*kind, &extent)));
        let vary: Vec<String> = vary.collect();
        let _ = write!(
            out,
            "\nfit {} {{\nrun {model}(v = {})\ndata \"{file}\" ({})\nvary {}\nminimise rms(F - data.F)\nplot data.F, F against {against}\n}}\n",
            model.to_lowercase(),
            shape.1,
            columns.join(", "),
            vary.join(", ")
        );
    }
    Ok(grammar::format::format(&out, 120).unwrap_or(out))
}

/// The range of a parameter, with a start in it.
fn range(kind: Kind, extent: &Extent) -> String {
    let Extent { force, fast, slow, path } = *extent;
    let (low, start, high, unit) = match kind {
        Coulomb => (0.01 * force, 0.7 * force, 2.0 * force, "N"),
        Stiction => (0.01 * force, force, 4.0 * force, "N"),
        Stribeck => {
            let low = slow.min(0.01 * fast);
            (low, (low * fast).sqrt(), fast, "m/s")
        }
        Viscous => (1e-4 * force / fast, 0.1 * force / fast, 10.0 * force / fast, "N·s/m"),
        Stiffness => (force / path, 300.0 * force / path, 1e5 * force / path, "N/m"),
        MicroDamping => (1e-2 * force / fast, 10.0 * force / fast, 1e3 * force / fast, "N·s/m"),
    };
    let [low, start, high] = [low, start, high].map(|x| abi::format::plain(two_digits(x)));
    format!("= {start} {unit} in {low} {unit} .. {high} {unit}")
}

fn two_digits(x: f64) -> f64 {
    format!("{x:.1e}").parse().unwrap_or(x)
}

fn extent(speeds: &[f64], path: f64, force: &[f64]) -> Option<Extent> {
    let (speeds, force) = (sorted(speeds), quantile(&sorted(force), 0.99));
    let fast = *speeds.last()?;
    let moving: Vec<f64> = speeds.into_iter().filter(|v| *v > 1e-6 * fast).collect();
    let is_whole = fast > 0.0 && fast.is_finite() && force > 0.0 && force.is_finite() && (path.is_nan() || path > 0.0);
    is_whole.then(|| Extent { force, fast, slow: quantile(&moving, 0.05), path })
}

/// Positions from speeds, by the trapezoidal rule.
fn travelled(t: &[f64], v: &[f64]) -> Vec<f64> {
    let mut x = vec![0.0];
    for (t, v) in t.windows(2).zip(v.windows(2)) {
        x.push(x[x.len() - 1] + 0.5 * (t[1] - t[0]) * (v[0] + v[1]));
    }
    x
}

fn slopes(t: &[f64], x: &[f64]) -> Vec<f64> {
    t.windows(2).zip(x.windows(2)).map(|(t, x)| (x[1] - x[0]) / (t[1] - t[0])).collect()
}

/// The distance between the ends of a motion.
fn path(x: &[f64]) -> f64 {
    let (least, most) = x.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| (a.min(*x), b.max(*x)));
    most - least
}

/// Magnitudes in rising order.
fn sorted(values: &[f64]) -> Vec<f64> {
    let mut all: Vec<f64> = values.iter().map(|value| value.abs()).collect();
    all.sort_by(f64::total_cmp);
    all
}

fn quantile(sorted: &[f64], part: f64) -> f64 {
    sorted[((sorted.len() - 1) as f64 * part).round() as usize]
}
