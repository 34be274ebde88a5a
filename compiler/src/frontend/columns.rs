//! Reads columns of numbers from the text of a file, for recordings and tables.
//!
//! In: text, and which of its columns are wanted. Out: their numbers and the units that the heading states, or the
//! first error with its line and column. Nothing is guessed: every line must have as many cells as the first one, and a
//! comma that could separate either cells or decimals is an error.
//!
//! Cells are separated by semicolons, tabs, commas or blanks: by the first of these that occurs in the first line
//! outside quotes. A decimal comma is accepted where commas do not separate cells, or in quotes; a file must use one
//! decimal mark throughout. A first line without a number is a heading; `name [unit]`, `name (unit)` and `name / unit`
//! state units, and so does a second line of units alone. Lines that begin with `#` are comments.
//!
//! A column is found by its place or by its heading.

use crate::frontend::names::nearest;
use abi::unit::Unit;
use std::borrow::Cow;

/// Columns of a file.
#[derive(Debug, PartialEq)]
pub struct Columns {
    /// Numbers as written, one list for each wanted column; the lists of unused columns are empty.
    pub numbers: Vec<Vec<f64>>,
    /// The unit of each wanted column, if the heading states one.
    pub units: Vec<Option<Unit>>,
    /// For each wanted column the number of the column in the file, from 1.
    pub places: Vec<usize>,
}

/// A column that is wanted.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Selector<'a> {
    /// The column at this place is not used and may hold anything.
    Unused,
    /// The column at this place, whatever its heading.
    Place,
    /// The column of this name, or the one at this place if the heading has no such names.
    Named(&'a str),
    /// The column with this heading.
    Headed(&'a str),
}

/// A cell of a heading, taken apart.
#[derive(Clone, PartialEq, Debug)]
struct Heading {
    /// The whole cell.
    cell: String,
    /// Without the unit.
    name: String,
    /// The unit stated, or why it is not known.
    unit: Result<Option<Unit>, String>,
}

/// Why columns cannot be read.
#[derive(Clone, PartialEq, Debug)]
pub struct Fault {
    /// The first error, in words that begin with the line.
    pub what: String,
    /// What to do about it.
    pub help: String,
}

fn fault<T>(what: String, help: impl Into<String>) -> Result<T, Fault> {
    Err(Fault { what, help: help.into() })
}

/// Fewer columns than are named.
fn too_few(line: &str, has: usize, needed: usize) -> Fault {
    let what = format!("{line} has {has} columns, {needed} are needed");
    Fault { what, help: "name the columns that the file has, in its order".into() }
}

/// Reads the wanted columns of a text.
///
/// # Errors
/// The first error.
pub fn read(text: &str, wanted: &[Selector]) -> Result<Columns, Fault> {
    let mut out = Columns { numbers: vec![Vec::new(); wanted.len()], units: vec![None; wanted.len()], places: vec![] };
    let mut separator = None;
    // The number of cells, and whether there is a heading that names them.
    let mut cells: Option<(usize, bool)> = None;
    let mut places: Vec<Option<usize>> = Vec::new();
    let mut first_after_heading = false;
    let mut decimals = None;
    // A column that grows would be copied, and take twice its room.
    let lines = text.bytes().filter(|byte| *byte == b'\n').count() + 1;
    let used = out.numbers.iter_mut().zip(wanted).filter(|(_, one)| **one != Selector::Unused);
    used.for_each(|(numbers, _)| numbers.reserve_exact(lines));
    for (row, line) in text.lines().enumerate() {
        let at = row + 1;
        let line = line.trim_start_matches('\u{feff}');
        if line.trim().is_empty() || line.trim_start().starts_with('#') {
            continue;
        }
        let by = *separator.get_or_insert_with(|| separator_of(line));
        let fields = split(line, by);
        let is_number = |field: &Cell| number(field, by).is_some();
        let Some((count, headed)) = cells else {
            let headed = !fields.iter().any(is_number);
            if headed {
                let headings = fields.iter().enumerate().map(|(k, field)| heading(&field.text, at, k));
                let headings: Vec<Heading> = headings.collect();
                places = found(&headings, wanted, &format!("line {at}"))?;
                // A unit that is not known matters only in a column that is used.
                for (unit, place) in out.units.iter_mut().zip(&places) {
                    let stated = place.map_or(Ok(None), |place| headings[place].unit.clone());
                    *unit = stated.or_else(|what| fault(what, "write a unit such as `mm` in the heading, or none"))?;
                }
            } else {
                if let Some(Selector::Headed(name)) = wanted.iter().find(|one| matches!(one, Selector::Headed(_))) {
                    return fault(
                        format!("line {at} is no heading, so there is no column \"{}\"", shown(name)),
                        "write the headings into the first line of the file, or name its columns in their order",
                    );
                }
                if fields.len() < wanted.len() {
                    return Err(too_few(&format!("line {at}"), fields.len(), wanted.len()));
                }
                if fields.len() > wanted.len() {
                    return fault(
                        format!("line {at} has {} columns, {} are named", fields.len(), wanted.len()),
                        "name the others `_`, and write decimals with a point",
                    );
                }
                places = by_place(wanted);
                push(&mut out, &fields, &places, by, &mut decimals, at)?;
            }
            out.places = places.iter().map(|place| place.map_or(0, |place| place + 1)).collect();
            cells = Some((fields.len(), headed));
            first_after_heading = headed;
            continue;
        };
        if fields.len() != count {
            let first = if headed { "the heading" } else { "the first line" };
            return fault(
                format!("line {at} has {} columns, {first} {count}", fields.len()),
                "complete the line or remove it; write decimals with a point, or separate cells with semicolons",
            );
        }
        if std::mem::take(&mut first_after_heading) && !fields.iter().any(is_number) {
            for (unit, place) in out.units.iter_mut().zip(&places) {
                let Some(place) = *place else { continue };
                let text = fields[place].text.trim_matches(['[', ']', '(', ')']).trim();
                if text.is_empty() || text == "-" {
                    continue;
                }
                let stated = Unit::parse(text).or_else(|part| {
                    fault(
                        format!("line {at}, column {}: `{}` is neither a number nor a unit", place + 1, shown(&part)),
                        "write a unit such as `mm`, or begin a line of words with `#`",
                    )
                })?;
                if let Some(before) = unit.as_ref().filter(|before| **before != stated) {
                    return fault(
                        format!("line {at}, column {}: {stated} here, {before} in the heading", place + 1),
                        "state the unit once, or the same in both lines",
                    );
                }
                *unit = Some(stated);
            }
            continue;
        }
        push(&mut out, &fields, &places, by, &mut decimals, at)?;
    }
    Ok(out)
}

fn by_place(wanted: &[Selector]) -> Vec<Option<usize>> {
    wanted.iter().enumerate().map(|(k, one)| (*one != Selector::Unused).then_some(k)).collect()
}

/// Where each wanted column is among the headings.
///
/// By heading, if a column says its heading or if the headings have all names; else by place. A name that the headings
/// have at another place than the text is an error: by place it would be read from another column.
///
/// # Errors
/// Why not. `line`: of the headings.
fn found(headings: &[Heading], wanted: &[Selector], line: &str) -> Result<Vec<Option<usize>>, Fault> {
    let at = |name: &str| -> Vec<usize> {
        let exact = |heading: &Heading| heading.cell == name;
        let places = |fits: &dyn Fn(&Heading) -> bool| (0..headings.len()).filter(|k| fits(&headings[*k])).collect();
        let whole: Vec<usize> = places(&exact);
        if whole.is_empty() { places(&|heading| heading.name == name) } else { whole }
    };
    let says_heading = wanted.iter().any(|one| matches!(one, Selector::Headed(_)));
    let named = wanted.iter().filter_map(|one| match one {
        Selector::Named(name) => Some(*name),
        Selector::Unused | Selector::Place | Selector::Headed(_) => None,
    });
    let has_names = named.clone().next().is_some() && !wanted.contains(&Selector::Place);
    if says_heading || has_names && named.clone().all(|name| !at(name).is_empty()) {
        let place = |one: &Selector| match one {
            Selector::Unused | Selector::Place => Ok(None),
            Selector::Named(name) | Selector::Headed(name) => match at(name)[..] {
                [place] => Ok(Some(place)),
                [] => {
                    let all = headings.iter().map(|heading| heading.name.as_str());
                    let known: Vec<String> = all.clone().map(shown).collect();
                    let help = match nearest(name, all) {
                        Some(near) => format!("did you mean \"{near}\"?"),
                        None => "write the heading as the file has it, as in `x [mm] = \"Position\"`".into(),
                    };
                    fault(format!("{line} has no column \"{}\", only {}", shown(name), known.join(", ")), help)
                }
                _ => fault(
                    format!("{line} has several columns \"{}\"", shown(name)),
                    "give them different headings in the file, or name its columns in their order",
                ),
            },
        };
        return wanted.iter().map(place).collect();
    }
    if headings.len() < wanted.len() {
        return Err(too_few(line, headings.len(), wanted.len()));
    }
    for (k, one) in wanted.iter().enumerate() {
        if let Selector::Named(name) = one
            && let [other] = at(name)[..]
            && other != k
        {
            return fault(
                format!("{line} calls column {} `{name}`, and the text column {}", other + 1, k + 1),
                format!("give each column its heading, as in `{name} = \"{}\"`", shown(&headings[other].cell)),
            );
        }
    }
    Ok(by_place(wanted))
}

/// A cell, and whether it was quoted.
struct Cell<'a> {
    text: Cow<'a, str>,
    quoted: bool,
}

fn separator_of(line: &str) -> Option<char> {
    let mut quoted = false;
    let mut plain = String::new();
    for c in line.chars() {
        quoted ^= c == '"';
        if !quoted && c != '"' {
            plain.push(c);
        }
    }
    [';', '\t', ','].into_iter().find(|separator| plain.contains(*separator))
}

/// The cells of a line. An empty cell after the last separator is ignored.
fn split(line: &str, separator: Option<char>) -> Vec<Cell<'_>> {
    let mut cells = match separator.filter(|_| !line.contains('"')) {
        Some(separator) => line.split(separator).map(|cell| Cell { text: cell.trim().into(), quoted: false }).collect(),
        None => quoted(line, separator),
    };
    if cells.len() > 1 && cells.last().is_some_and(|cell| cell.text.is_empty() && !cell.quoted) {
        cells.pop();
    }
    cells
}

/// The cells of a line in which quotes may hold separators, or blanks are these.
fn quoted(line: &str, separator: Option<char>) -> Vec<Cell<'static>> {
    let mut cells = vec![(String::new(), false)];
    let mut inside = false;
    for c in line.chars() {
        let (text, quoted) = cells.last_mut().expect("there is one");
        match c {
            '"' => {
                inside = !inside;
                *quoted = true;
            }
            c if !inside && Some(c) == separator => cells.push((String::new(), false)),
            c if !inside && separator.is_none() && c.is_whitespace() => {
                if !text.is_empty() {
                    cells.push((String::new(), false));
                }
            }
            c => text.push(c),
        }
    }
    cells.into_iter().map(|(text, quoted)| Cell { text: text.trim().to_string().into(), quoted }).collect()
}

/// A finite number, and whether it has a decimal comma.
fn number(cell: &Cell, separator: Option<char>) -> Option<(f64, bool)> {
    let commas = cell.text.matches(',').count();
    let comma = commas == 1 && !cell.text.contains('.') && (separator != Some(',') || cell.quoted);
    let text = if comma { cell.text.replace(',', ".").into() } else { Cow::Borrowed(&*cell.text) };
    let finite = text.parse().ok().filter(|x: &f64| x.is_finite());
    finite.map(|x| (x, comma))
}

fn push(
    out: &mut Columns,
    fields: &[Cell],
    places: &[Option<usize>],
    separator: Option<char>,
    decimals: &mut Option<(bool, usize)>,
    at: usize,
) -> Result<(), Fault> {
    for (wanted, place) in places.iter().enumerate() {
        let Some(k) = *place else { continue };
        let field = &fields[k];
        let Some((number, comma)) = number(field, separator) else {
            return fault(
                format!("line {at}, column {}: `{}` is no finite number", k + 1, shown(&field.text)),
                "write a number there, or remove the line; a column that is not used is called `_`",
            );
        };
        if comma || field.text.contains('.') {
            let (of_before, line) = *decimals.get_or_insert((comma, at));
            if of_before != comma {
                let sign = |comma: bool| if comma { "comma" } else { "point" };
                return fault(
                    format!(
                        "line {at}, column {}: `{}` has a decimal {}, line {line} a decimal {}",
                        k + 1,
                        shown(&field.text),
                        sign(comma),
                        sign(of_before)
                    ),
                    "write all numbers of the file with the same decimal mark",
                );
            }
        }
        out.numbers[wanted].push(number);
    }
    Ok(())
}

/// A cell of the heading, taken apart: `x [mm]`; `x (mm)` and `x / mm` if `mm` is a unit.
fn heading(cell: &str, at: usize, k: usize) -> Heading {
    let with = |name: &str, unit| Heading { cell: cell.into(), name: name.trim().into(), unit };
    let inside = |open: char, close: char| {
        let text = cell.strip_suffix(close)?;
        let from = text.rfind(open)?;
        Some((&text[..from], text[from + open.len_utf8()..].trim()))
    };
    if let Some((name, text)) = inside('[', ']') {
        let unknown =
            |part: String| format!("line {at}, column {}: unknown unit `{}` in the heading", k + 1, shown(&part));
        return with(name, Unit::parse(text).map(Some).map_err(unknown));
    }
    let slash = || cell.split_once('/').map(|(name, unit)| (name, unit.trim()));
    for (name, text) in inside('(', ')').into_iter().chain(slash()) {
        if let Ok(unit) = Unit::parse(text)
            && !name.trim().is_empty()
        {
            return with(name, Ok(Some(unit)));
        }
    }
    with(cell, Ok(None))
}

/// A cell as shown in messages: control characters replaced, at most 40 characters.
fn shown(text: &str) -> String {
    let short: String = text.chars().take(40).map(|c| if c.is_control() { '?' } else { c }).collect();
    if short.len() < text.len() { format!("{short}…") } else { short }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::random::Random;

    /// The columns, or the first error.
    fn read(text: &str, wanted: &[Selector]) -> Result<Columns, String> {
        super::read(text, wanted).map_err(|fault| {
            assert!(!fault.help.is_empty(), "{fault:?}");
            fault.what
        })
    }

    fn numbers(text: &str) -> Result<Vec<Vec<f64>>, String> {
        read(text, &[Selector::Place; 2]).map(|columns| columns.numbers)
    }

    #[test]
    fn decimal_commas_are_decimals_or_an_error() {
        assert_eq!(numbers("t;x\n0;1,5\n1;3,5\n"), Ok(vec![vec![0.0, 1.0], vec![1.5, 3.5]]));
        assert_eq!(numbers("0,5 1,5\n1 3\n").unwrap_err(), "line 1 has 3 columns, 2 are named");
        assert_eq!(numbers("t,x\n0,1,5\n").unwrap_err(), "line 2 has 3 columns, the heading 2");
        assert_eq!(numbers("t,x\n\"0\",\"1,5\"\n"), Ok(vec![vec![0.0], vec![1.5]]));
        assert_eq!(
            numbers("t;x\n0;1,5\n1;3.5\n").unwrap_err(),
            "line 3, column 2: `3.5` has a decimal point, line 2 a decimal comma"
        );
        assert_eq!(numbers("t;x\n0;1.234,5\n").unwrap_err(), "line 2, column 2: `1.234,5` is no finite number");
    }

    #[test]
    fn a_first_line_with_a_number_is_not_a_heading() {
        assert_eq!(numbers("0 1x\n1 2\n").unwrap_err(), "line 1, column 2: `1x` is no finite number");
        assert_eq!(numbers("# a comment\nt x\n1 2\n"), Ok(vec![vec![1.0], vec![2.0]]));
    }

    #[test]
    fn headings_state_units() {
        let units = |text: &str| {
            read(text, &[Selector::Place; 2])
                .map(|c| c.units.iter().map(|u| u.as_ref().map(ToString::to_string)).collect::<Vec<_>>())
        };
        assert_eq!(units("t [ms],x [m]\n0,1\n"), Ok(vec![Some("ms".into()), Some("m".into())]));
        assert_eq!(units("t (ms);x (raw)\n0;1\n"), Ok(vec![Some("ms".into()), None]));
        assert_eq!(units("t [s],x [kp]\n0,1\n"), Err("line 1, column 2: unknown unit `kp` in the heading".into()));
    }

    #[test]
    fn columns_are_found_by_heading_or_by_place() {
        let text = "time [ms],F / N,x (mm)\n0,1,2\n1,3,4\n";
        let found = |wanted: &[Selector]| read(text, wanted).map(|columns| columns.places);
        assert_eq!(found(&[Selector::Headed("x"), Selector::Headed("time")]), Ok(vec![3, 1]));
        assert_eq!(found(&[Selector::Headed("x (mm)"), Selector::Named("F")]), Ok(vec![3, 2]));
        assert_eq!(found(&[Selector::Named("x"), Selector::Named("F")]), Ok(vec![3, 2]));
        assert_eq!(found(&[Selector::Named("t"), Selector::Unused, Selector::Named("s")]), Ok(vec![1, 0, 3]));
        assert_eq!(
            found(&[Selector::Named("t"), Selector::Named("x"), Selector::Unused]).unwrap_err(),
            "line 1 calls column 3 `x`, and the text column 2"
        );
        assert_eq!(found(&[Selector::Headed("tme")]).unwrap_err(), "line 1 has no column \"tme\", only time, F, x");
        let twice = read("a,a\n1,2\n", &[Selector::Headed("a")]);
        assert_eq!(twice.unwrap_err(), "line 1 has several columns \"a\"");
        let bare = read("1,2\n", &[Selector::Headed("a"), Selector::Unused]);
        assert_eq!(bare.unwrap_err(), "line 1 is no heading, so there is no column \"a\"");
    }

    #[test]
    fn a_second_line_may_state_units() {
        let units = |text: &str| {
            let columns = read(text, &[Selector::Named("t"), Selector::Named("x")])?;
            Ok((columns.units.iter().map(|unit| unit.as_ref().map(ToString::to_string)).collect(), columns.numbers))
        };
        type Found = Result<(Vec<Option<String>>, Vec<Vec<f64>>), String>;
        let found: Found = units("t;x\n[ms];mm\n0;1,5\n");
        assert_eq!(found, Ok((vec![Some("ms".into()), Some("mm".into())], vec![vec![0.0], vec![1.5]])));
        let found: Found = units("t,x [m]\ns,-\n0,1\n");
        assert_eq!(found.unwrap().0, [Some("s".into()), Some("m".into())]);
        let found: Found = units("t,x [m]\ns,mm\n0,1\n");
        assert_eq!(found.unwrap_err(), "line 2, column 2: mm here, m in the heading");
        let found: Found = units("t,x\ns,kp\n0,1\n");
        assert_eq!(found.unwrap_err(), "line 2, column 2: `kp` is neither a number nor a unit");
    }

    /// Whatever the order, the units and the way they are stated: a column has the values of its heading in SI, or is
    /// refused because its unit is of another kind. No column is read from another place or in another scale.
    #[test]
    fn no_column_is_taken_for_another() {
        const UNITS: [[&str; 3]; 4] = [["s", "ms", "us"], ["m", "mm", "um"], ["N", "mN", "kN"], ["m/s", "mm/s", "m/s"]];
        let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(23);
        let mut random = Random(seed);
        let (mut fine, mut refused) = (0, 0);
        for case in 0..2000 {
            // A single column has no separator: a blank in its heading would be one.
            let count = 2 + random.below(3);
            let kinds: Vec<usize> = (0..count).map(|_| random.below(4)).collect();
            let units: Vec<&str> = kinds.iter().map(|kind| UNITS[*kind][random.below(3)]).collect();
            let in_row = random.below(4) == 0;
            let cells: Vec<String> = (0..count)
                .map(|k| match (in_row, random.below(3)) {
                    (true, _) => format!("c{k}"),
                    (false, 0) => format!("c{k} [{}]", units[k]),
                    (false, 1) => format!("c{k} ({})", units[k]),
                    (false, _) => format!("c{k} / {}", units[k]),
                })
                .collect();
            let comma = random.below(2) == 0;
            let separator = if comma { ";" } else { [",", ";", "\t"][random.below(3)] };
            let numbers: Vec<f64> = (0..count).map(|_| random.within(-9.0, 9.0)).collect();
            let row: Vec<String> = numbers.iter().map(|x| x.to_string()).collect();
            let row = if comma { row.join(separator).replace('.', ",") } else { row.join(separator) };
            let second = if in_row { units.join(separator) + "\n" } else { String::new() };
            let text = format!("{}\n{second}{row}\n", cells.join(separator));
            // A permutation of the columns, by name or by heading.
            let mut order: Vec<usize> = (0..count).collect();
            for k in (1..count).rev() {
                order.swap(k, random.below(k + 1));
            }
            let names: Vec<String> = order.iter().map(|k| format!("c{k}")).collect();
            let by_name = random.below(2) == 0;
            let wanted: Vec<Selector> = (0..count)
                .map(|k| if by_name { Selector::Named(&names[k]) } else { Selector::Headed(&names[k]) })
                .collect();
            let read = read(&text, &wanted).unwrap_or_else(|what| panic!("seed {seed}, case {case}: {what}\n{text}"));
            for (k, column) in order.iter().enumerate() {
                let declared = Unit::parse(UNITS[random.below(4)][random.below(3)]).unwrap();
                let stated = read.units[k].as_ref().expect("each column states its unit");
                let written = Unit::parse(units[*column]).unwrap();
                if declared.dimension != written.dimension {
                    assert_ne!(stated.dimension, declared.dimension, "seed {seed}, case {case}:\n{text}");
                    refused += 1;
                    continue;
                }
                let (found, exact) = (stated.to_si(read.numbers[k][0]), written.to_si(numbers[*column]));
                assert_eq!(found, exact, "seed {seed}, case {case}, column {k}:\n{text}");
                fine += 1;
            }
        }
        println!("seed {seed}: {fine} read, {refused} of another kind");
        assert!(fine > 300 && refused > 300, "{fine} {refused}");
    }

    /// Numbers written in any of the usual formats are read back to the bit or refused, never read as other numbers.
    #[test]
    fn written_numbers_are_read_back_or_refused() {
        let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(16);
        let mut random = Random(seed);
        let (mut read_back, mut refused) = (0, 0);
        for case in 0..4000 {
            let columns = 1 + random.below(4);
            let separator = [",", ";", "\t", " ", ", ", "; "][random.below(6)];
            let (comma, headed, end) = (random.below(2) == 0, random.below(2) == 0, ["\n", "\r\n"][random.below(2)]);
            let quoted = random.below(4) == 0;
            let trailing = if separator.trim().is_empty() || random.below(4) > 0 { "" } else { separator.trim() };
            let used = |used| if used { Selector::Place } else { Selector::Unused };
            let wanted: Vec<Selector> = (0..columns).map(|_| used(random.below(5) > 0)).collect();
            let mut text = String::from(if random.below(8) == 0 { "\u{feff}" } else { "" });
            if headed {
                let names: Vec<String> = (0..columns).map(|k| format!("c{k}")).collect();
                text += &format!("{}{trailing}{end}", names.join(separator));
            }
            let mut expected = vec![Vec::new(); columns];
            for _ in 0..1 + random.below(4) {
                let mut cells = Vec::new();
                for (k, wanted) in wanted.iter().enumerate() {
                    let x = match random.below(3) {
                        0 => random.below(10) as f64,
                        1 => random.within(-5.0, 5.0),
                        _ => random.within(-5.0, 5.0) * 1e-9,
                    };
                    if *wanted == Selector::Place {
                        expected[k].push(x);
                    }
                    let cell = if random.below(2) == 0 { format!("{x}") } else { format!("{x:e}") };
                    let cell = if comma { cell.replace('.', ",") } else { cell };
                    cells.push(if quoted { format!("\"{cell}\"") } else { cell });
                }
                text += &format!("{}{trailing}{end}", cells.join(separator));
            }
            match read(&text, &wanted) {
                Ok(found) => {
                    assert_eq!(found.numbers, expected, "seed {seed}, case {case}:\n{text}");
                    read_back += 1;
                }
                Err(message) => {
                    let ambiguous =
                        comma && !quoted && (separator.starts_with(',') || separator == " " || columns == 1);
                    assert!(ambiguous, "seed {seed}, case {case}: {message}\n{text}");
                    refused += 1;
                }
            }
        }
        println!("seed {seed}: {read_back} read, {refused} refused");
        assert!(read_back > 2000 && refused > 100, "{read_back} read, {refused} refused");
    }
}
