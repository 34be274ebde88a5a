//! `fric linearise`: the matrices A, B, C, D at an operating point and the modes of A; P and Q, the derivatives of
//! rates and outputs by parameters. With `--loop`, the loop broken at a signal and its margins.

mod broken_loop;

use super::{End, load, reported};
use crate::args::Linearise;
use crate::compile::{self, Changes, Linear, Matrices, Options, Ports, Stopwatch};
use crate::matrices::{self, Matrix};
use crate::quantity::{parse, show, significant};
use crate::results::number;
use crate::terminal::{Style, Terminal};
use crate::{project, quantity};
use abi::Slot;
use abi::description::{Kind, Quantity};
use abi::unit::Unit;
use runtime::coupling::eigenvalues::{Mode, modes};
use runtime::engine::{self, Continue, equilibrium};
use serde_json::{Value, json};
use std::f64::consts::TAU;

pub fn linearise(args: &Linearise, terminal: &mut Terminal) -> End {
    let drawn = args.bode.as_ref().is_some_and(|file| file.extension().is_none_or(|ending| ending != "csv"));
    if let Some(why) = args.look.unused(drawn, "--bode FIG.pdf") {
        terminal.error(&why);
        return End::Misused;
    }
    let Some(mut loaded) = load(&args.file, terminal, &mut Stopwatch::start("read")) else { return End::Failed };
    let ports = Ports {
        inputs: args.inputs.clone(),
        outputs: args.outputs.clone(),
        params: args.params.clone(),
        broken: args.broken.clone(),
    };
    let changes = Changes { ports: Some(ports), ..args.set.changes() };
    let options = Options { changes, ..Options::default() };
    let mut linear = match compile::linear(&mut loaded, &crate::disk::Disk, &args.name, &options, &mut Vec::new()) {
        Ok(linear) => linear,
        Err(diagnostics) => {
            reported(&loaded, &diagnostics, terminal);
            return End::Failed;
        }
    };
    if let Some(unknown) = args.params.iter().find(|path| !linear.params.iter().any(|param| param.path == **path)) {
        let known = linear.movable().filter(|quantity| quantity.kind == Kind::Param);
        let help = compile::nearest(unknown, known.map(|quantity| quantity.path.as_str()));
        let help = help.map_or(String::new(), |near| format!("; did you mean `{near}`?"));
        terminal.error(&format!("there is no parameter `{unknown}`{help}"));
        return End::Failed;
    }
    let point = Point { at: &args.at, time: args.time, rest: args.rest };
    if let Err(message) = go_to_point(&mut linear, &point) {
        terminal.error(&message);
        return End::Failed;
    }
    if let Some(path) = &args.broken {
        return match broken_loop::broken_loop(&mut linear, path, args, terminal) {
            Ok(()) => End::Fine,
            Err(message) => {
                terminal.error(&message);
                End::Failed
            }
        };
    }
    let (found, modes) = match matrices_and_modes(&mut linear) {
        Ok(found) => found,
        Err(message) => {
            terminal.error(&message);
            return End::Failed;
        }
    };
    if let Some(path) = &args.out {
        let bytes = match path.extension().and_then(|extension| extension.to_str()) {
            Some("npz") => matrices::npz(&named(&linear, &found)),
            Some("mat") => matrices::mat(&named(&linear, &found)),
            _ => format!("{}\n", object(&linear, &found, &modes)).into_bytes(),
        };
        if let Err(error) = project::write(path, &bytes) {
            terminal.error(&format!("cannot write {}: {error}", path.display()));
            return End::Failed;
        }
    }
    if args.json {
        terminal.line(&object(&linear, &found, &modes).to_string());
    } else {
        let words = words(&linear, &found, &modes, terminal);
        terminal.print(&words);
        if let Some(path) = &args.out {
            terminal.line(&format!("  wrote {}", path.display()));
        }
    }
    End::Fine
}

/// The matrices at the point where the instance is, and the modes of A.
fn matrices_and_modes(linear: &mut Linear) -> Result<(Matrices, Vec<Mode>), String> {
    let found = linear.at();
    let all = [&found.a, &found.b, &found.c, &found.d, &found.p, &found.q];
    if !all.iter().all(|matrix| matrix.iter().all(|entry| entry.is_finite())) {
        return Err("the derivatives are not finite at this point; give another one with --at".into());
    }
    let modes = modes(linear.states.len(), &found.a).ok_or("the eigenvalues of A could not be found")?;
    Ok((found, modes))
}

/// The JSON of `fric linearise` at a point.
///
/// # Errors
/// Why there is no such point, or there are no matrices, in words.
pub(crate) fn as_json(linear: &mut Linear, point: &Point) -> Result<Value, String> {
    go_to_point(linear, point)?;
    let (found, modes) = matrices_and_modes(linear)?;
    Ok(object(linear, &found, &modes))
}

/// An operating point.
pub(crate) struct Point<'a> {
    /// Values of states, free inputs, parameters and regimes, as texts.
    pub at: &'a [(String, String)],
    /// Time in s.
    pub time: Option<f64>,
    /// Where everything has come to rest.
    pub rest: bool,
}

/// Moves the instance to the operating point: the state of an experiment at a given time, if requested; then the given
/// values.
fn go_to_point(linear: &mut Linear, args: &Point) -> Result<(), String> {
    let mut later = Vec::new();
    for (path, text) in args.at {
        if let Some((slot, number)) = regime(linear, path, text) {
            later.push((slot, number?));
            continue;
        }
        let Some(quantity) = linear.movable().find(|quantity| quantity.path == *path) else {
            let known: Vec<&str> = linear.movable().map(|quantity| quantity.path.as_str()).collect();
            let help = match compile::nearest(path, known) {
                Some(near) => format!("did you mean `{near}`?"),
                None => "give states, free inputs and parameters; other values change with --set".into(),
            };
            return Err(format!("there is no state, free input or parameter `{path}`; {help}"));
        };
        let value = given(quantity, text)?;
        match quantity.kind {
            // Parameters and inputs are set before the start, because initial values may depend on them.
            Kind::Param | Kind::Input => linear.instance.set(quantity.slot, value),
            _ => later.push((quantity.slot, value)),
        }
    }
    let experiment = linear.experiment.clone();
    match (args.time, experiment) {
        (Some(time), Some(mut experiment)) => {
            experiment.duration = time;
            experiment.corners.retain(|corner| *corner < time);
            let layout = &linear.instance.description().layout;
            let kept = [layout.params, layout.inputs, layout.states, layout.memory, layout.regimes];
            let slots: Vec<Slot> =
                kept.iter().flat_map(|segment| segment.range()).map(|slot| Slot(slot as u32)).collect();
            let go_on = &mut |_| Continue::Continue(());
            let (values, ended) = engine::sample(linear.instance.clone(), &experiment, &[time], &slots, go_on);
            ended.map_err(|failure| failure.to_string())?;
            for (slot, value) in slots.iter().zip(values) {
                linear.instance.set(*slot, value);
            }
            linear.instance.set(Slot::TIME, time);
        }
        (time, _) => {
            linear.instance.start(0.0);
            linear.instance.set(Slot::TIME, time.unwrap_or(0.0));
        }
    }
    if args.rest {
        come_to_rest(linear)?;
    }
    for (slot, value) in later {
        linear.instance.set(slot, value);
    }
    Ok(())
}

/// Relative tolerance of the search for rest.
const REST_TOL: f64 = 1e-9;

/// Sets a started instance to an equilibrium, the rest state that it reaches by itself.
fn come_to_rest(linear: &mut Linear) -> Result<(), String> {
    let mut from = linear.instance.adaptive().unwrap_or_else(|| linear.instance.clone());
    from.start(0.0);
    let go_on = &mut |_| Continue::Continue(());
    let rested = equilibrium::settle(from, REST_TOL, go_on).map_err(|restless| {
        format!("{} {restless}; give another point with --at or --time", linear.instance.description().name)
    })?;
    let layout = &linear.instance.description().layout;
    let kept = [layout.states, layout.memory, layout.regimes];
    let slots: Vec<Slot> = kept.iter().flat_map(|segment| segment.range()).map(|slot| Slot(slot as u32)).collect();
    for slot in slots.into_iter().chain([Slot::TIME]) {
        linear.instance.set(slot, rested.get(slot));
    }
    Ok(())
}

/// `fr=stick`: the automaton of a part, and one of its regimes.
fn regime(linear: &Linear, path: &str, text: &str) -> Option<(Slot, Result<f64, String>)> {
    let automaton = linear.instance.description().automata.iter().find(|automaton| automaton.path == path)?;
    let at = automaton.regimes.iter().position(|regime| regime == text.trim());
    let number = at
        .map(|at| at as f64)
        .ok_or_else(|| format!("`{path}` has no regime `{}`; it has {}", text.trim(), automaton.regimes.join(", ")));
    Some((automaton.slot, number))
}

/// Parses a value in SI with the dimension of a quantity.
fn given(quantity: &Quantity, text: &str) -> Result<f64, String> {
    let (value, unit) = parse(text).map_err(|reason| format!("{}: {reason}", quantity.path))?;
    let fits = unit.dimension == quantity.unit.dimension || value == 0.0 && unit.text.is_empty();
    match fits {
        true => Ok(value),
        false if unit.text.is_empty() => {
            Err(format!("`{}` needs a unit: {}={} {}", quantity.path, quantity.path, text.trim(), quantity.unit))
        }
        false => Err(format!(
            "`{}` is {}, not {}",
            quantity.path,
            quantity.unit.dimension.describe(),
            unit.dimension.describe()
        )),
    }
}

/// The matrices with their names; P and Q only if parameters were named.
fn named<'a>(linear: &Linear, found: &'a Matrices) -> Vec<Matrix<'a>> {
    let (n, m, p, q) = (linear.states.len(), linear.inputs.len(), linear.outputs.len(), linear.params.len());
    let matrix = |name, rows, columns, values| Matrix { name, rows, columns, values };
    let mut all = vec![
        matrix("A", n, n, &found.a[..]),
        matrix("B", n, m, &found.b),
        matrix("C", p, n, &found.c),
        matrix("D", p, m, &found.d),
    ];
    if q > 0 {
        all.extend([matrix("P", n, q, &found.p), matrix("Q", p, q, &found.q)]);
    }
    all
}

fn object(linear: &Linear, found: &Matrices, modes: &[Mode]) -> Value {
    let rows = |matrix: &Matrix| -> Value {
        let row = |i: usize| -> Value {
            matrix.values[i * matrix.columns..(i + 1) * matrix.columns].iter().map(|entry| number(*entry)).collect()
        };
        (0..matrix.rows).map(row).collect()
    };
    let state = |(quantity, rate): (&Quantity, &f64)| {
        json!({
            "name": quantity.path,
            "unit": Unit::si(quantity.unit.dimension).text,
            "value": number(linear.instance.get(quantity.slot)),
            "rate": number(*rate),
        })
    };
    let port =
        |(path, quantity): &(String, Quantity)| json!({ "name": path, "unit": Unit::si(quantity.unit.dimension).text });
    let mode = |mode: &Mode| {
        json!({
            "real": number(mode.real),
            "imaginary": number(mode.imaginary),
            "frequency": number(mode.frequency()),
            "damping": mode.damping().map(number),
        })
    };
    let mut object = json!({
        "model": linear.instance.description().name,
        "time": number(linear.instance.get(Slot::TIME)),
        "states": linear.states.iter().zip(&found.rates).map(state).collect::<Value>(),
        "inputs": linear.inputs.iter().map(port).collect::<Value>(),
        "outputs": linear.outputs.iter().map(port).collect::<Value>(),
        "modes": modes.iter().map(mode).collect::<Value>(),
    });
    if !linear.params.is_empty() {
        let param = |quantity: &Quantity| {
            json!({
                "name": quantity.path,
                "unit": Unit::si(quantity.unit.dimension).text,
                "value": number(linear.instance.get(quantity.slot)),
            })
        };
        object["params"] = linear.params.iter().map(param).collect::<Value>();
    }
    for matrix in named(linear, found) {
        object[matrix.name] = rows(&matrix);
    }
    object
}

fn words(linear: &Linear, found: &Matrices, modes: &[Mode], terminal: &Terminal) -> String {
    let description = linear.instance.description();
    let mut out = terminal.styled(Style::Bold, &description.name);
    out += &format!(" at t = {}; all in SI\n", quantity::duration(linear.instance.get(Slot::TIME), 3));
    let regimes: Vec<String> = description
        .automata
        .iter()
        .filter_map(|automaton| {
            let name = automaton.regimes.get(linear.instance.get(automaton.slot) as usize)?;
            Some(if automaton.path.is_empty() { name.clone() } else { format!("{}.{name}", automaton.path) })
        })
        .collect();
    if !regimes.is_empty() {
        out += &format!("  in {}\n", regimes.join(", "));
    }
    if !description.ticks.is_empty() {
        out += "  what is sampled is held\n";
    }
    let names: Vec<&str> = linear.states.iter().map(|quantity| quantity.path.as_str()).collect();
    for (quantity, rate) in linear.states.iter().zip(&found.rates) {
        let unit = Unit::si(quantity.unit.dimension);
        let value = show(linear.instance.get(quantity.slot), &unit, 6);
        out += &format!("  {} = {value}, changes by {}/s\n", quantity.path, significant(*rate, 4));
    }
    let inputs: Vec<&str> = linear.inputs.iter().map(|(path, _)| path.as_str()).collect();
    let outputs: Vec<&str> = linear.outputs.iter().map(|(path, _)| path.as_str()).collect();
    let rates: Vec<String> = names.iter().map(|name| format!("d{name}/dt")).collect();
    let rates: Vec<&str> = rates.iter().map(String::as_str).collect();
    let params: Vec<&str> = linear.params.iter().map(|quantity| quantity.path.as_str()).collect();
    let titles = [&names, &inputs, &params].map(|columns| [(&rates, columns), (&outputs, columns)]);
    let [[a, c], [b, d], [p, q]] = titles;
    for (matrix, (rows, columns)) in named(linear, found).iter().zip([a, b, c, d, p, q]) {
        if matrix.rows > 0 && matrix.columns > 0 {
            out += &format!("\n{}", table(matrix, rows, columns));
        }
    }
    if !modes.is_empty() {
        out += &format!("\n  {:>13}  {:>13}  {:>10}  {:>10}  {:>9}\n", "eigenvalue", "± i", "rad/s", "Hz", "damping");
    }
    for mode in modes {
        let damping = mode.damping().map_or("-".into(), |damping| significant(damping, 4));
        let imaginary = if mode.imaginary > 0.0 { significant(mode.imaginary, 5) } else { String::new() };
        let (frequency, real) = (mode.frequency(), significant(mode.real, 5));
        let [rad, hertz] = [frequency, frequency / TAU].map(|x| significant(x, 4));
        let grows = if mode.real > 0.0 { "  grows" } else { "" };
        out += &format!("  {real:>13}  {imaginary:>13}  {rad:>10}  {hertz:>10}  {damping:>9}{grows}\n");
    }
    out
}

/// Formats a matrix with the names of its rows and columns.
fn table(matrix: &Matrix, rows: &[&str], columns: &[&str]) -> String {
    let entry = |i: usize, j: usize| significant(matrix.values[i * matrix.columns + j], 6);
    let first = rows.iter().map(|name| name.chars().count()).max().unwrap_or(0);
    let width = |j: usize| {
        let entries = (0..matrix.rows).map(|i| entry(i, j).chars().count());
        entries.max().unwrap_or(0).max(columns[j].chars().count())
    };
    let widths: Vec<usize> = (0..matrix.columns).map(width).collect();
    let line = |name: &str, cells: Vec<String>| {
        let cells: Vec<String> = cells.iter().zip(&widths).map(|(cell, width)| format!("{cell:>width$}")).collect();
        format!("  {name:first$}  {}\n", cells.join("  "))
    };
    let mut out = format!("  {}\n", matrix.name);
    out += &line("", columns.iter().map(|name| (*name).to_string()).collect());
    for (i, name) in rows.iter().enumerate() {
        out += &line(name, (0..matrix.columns).map(|j| entry(i, j)).collect());
    }
    out
}
