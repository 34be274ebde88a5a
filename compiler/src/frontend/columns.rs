//! Reads columns of numbers from the text of a file, for recordings and tables.
//!
//! In: text, and which of its columns are wanted. Out: their numbers and the units that the heading states, or the
//! first error with its line and column. Nothing is guessed: every line must have as many cells as the first one, and a
//! comma that could separate either cells or decimals is an error.
//!
//! Cells are separated by semicolons, tabs, commas or blanks: by the first of these that occurs in the first line
//! outside quotes. A decimal comma is accepted where commas do not separate cells, or in quotes; a file must use one
//! decimal mark throughout. A first line without a number is a heading; `name [unit]` and `name (unit)` state units.
//! Lines that begin with `#` are comments.

use abi::unit::Unit;

/// Columns of a file.
#[derive(Debug, PartialEq)]
pub struct Columns {
    /// Numbers as written, one list for each wanted column; the lists of other columns are empty.
    pub numbers: Vec<Vec<f64>>,
    /// The unit of each column, if the heading states one.
    pub units: Vec<Option<Unit>>,
}

/// Reads as many columns as `wanted` has entries. Cells of columns that are not wanted may hold anything.
///
/// # Errors The first error, in words that begin with the line.
pub fn read(text: &str, wanted: &[bool]) -> Result<Columns, String> {
    let mut out = Columns { numbers: vec![Vec::new(); wanted.len()], units: vec![None; wanted.len()] };
    let mut separator = None;
    // The number of cells, and whether there is a heading that names them.
    let mut cells: Option<(usize, bool)> = None;
    let mut decimals = None;
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
            if fields.len() < wanted.len() {
                return Err(format!("line {at} has {} columns, {} are needed", fields.len(), wanted.len()));
            }
            if fields.len() > wanted.len() && !headed {
                return Err(format!(
                    "line {at} has {} columns, {} are named; name the others `_`, and write decimals with a point",
                    fields.len(),
                    wanted.len()
                ));
            }
            cells = Some((fields.len(), headed));
            if headed {
                for (k, field) in fields.iter().enumerate().take(wanted.len()) {
                    out.units[k] = if wanted[k] { stated(&field.text, at, k)? } else { None };
                }
                continue;
            }
            push(&mut out, &fields, wanted, by, &mut decimals, at)?;
            continue;
        };
        if fields.len() != count {
            let first = if headed { "the heading" } else { "the first line" };
            return Err(format!("line {at} has {} columns, {first} {count}", fields.len()));
        }
        push(&mut out, &fields, wanted, by, &mut decimals, at)?;
    }
    Ok(out)
}

/// A cell, and whether it was quoted.
struct Cell {
    text: String,
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
fn split(line: &str, separator: Option<char>) -> Vec<Cell> {
    let mut cells = vec![Cell { text: String::new(), quoted: false }];
    let mut inside = false;
    for c in line.chars() {
        let cell = cells.last_mut().expect("there is one");
        match c {
            '"' => {
                inside = !inside;
                cell.quoted = true;
            }
            c if !inside && Some(c) == separator => cells.push(Cell { text: String::new(), quoted: false }),
            c if !inside && separator.is_none() && c.is_whitespace() => {
                if !cell.text.is_empty() {
                    cells.push(Cell { text: String::new(), quoted: false });
                }
            }
            c => cell.text.push(c),
        }
    }
    for cell in &mut cells {
        cell.text = cell.text.trim().to_string();
    }
    if cells.len() > 1 && cells.last().is_some_and(|cell| cell.text.is_empty() && !cell.quoted) {
        cells.pop();
    }
    cells
}

/// A finite number, and whether it has a decimal comma.
fn number(cell: &Cell, separator: Option<char>) -> Option<(f64, bool)> {
    let commas = cell.text.matches(',').count();
    let comma = commas == 1 && !cell.text.contains('.') && (separator != Some(',') || cell.quoted);
    let text = if comma { cell.text.replace(',', ".") } else { cell.text.clone() };
    let finite = text.parse().ok().filter(|x: &f64| x.is_finite());
    finite.map(|x| (x, comma))
}

fn push(
    out: &mut Columns,
    fields: &[Cell],
    wanted: &[bool],
    separator: Option<char>,
    decimals: &mut Option<(bool, usize)>,
    at: usize,
) -> Result<(), String> {
    for (k, field) in fields.iter().enumerate().take(wanted.len()).filter(|(k, _)| wanted[*k]) {
        let Some((number, comma)) = number(field, separator) else {
            return Err(format!("line {at}, column {}: `{}` is no finite number", k + 1, shown(&field.text)));
        };
        if comma || field.text.contains('.') {
            let (of_before, line) = *decimals.get_or_insert((comma, at));
            if of_before != comma {
                let sign = |comma: bool| if comma { "comma" } else { "point" };
                return Err(format!(
                    "line {at}, column {}: `{}` has a decimal {}, line {line} a decimal {}",
                    k + 1,
                    shown(&field.text),
                    sign(comma),
                    sign(of_before)
                ));
            }
        }
        out.numbers[k].push(number);
    }
    Ok(())
}

/// The unit that a cell of the heading states: `x [mm]`, or `x (mm)` if `mm` is a unit.
fn stated(cell: &str, at: usize, k: usize) -> Result<Option<Unit>, String> {
    let inside = |open: char, close: char| {
        let text = cell.strip_suffix(close)?;
        Some(text[text.rfind(open)? + open.len_utf8()..].trim().to_string())
    };
    if let Some(text) = inside('[', ']') {
        return match Unit::parse(&text) {
            Ok(unit) => Ok(Some(unit)),
            Err(part) => Err(format!("line {at}, column {}: unknown unit `{}` in the heading", k + 1, shown(&part))),
        };
    }
    Ok(inside('(', ')').and_then(|text| Unit::parse(&text).ok()))
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

    fn numbers(text: &str) -> Result<Vec<Vec<f64>>, String> {
        read(text, &[true, true]).map(|columns| columns.numbers)
    }

    #[test]
    fn decimal_commas_are_decimals_or_an_error() {
        assert_eq!(numbers("t;x\n0;1,5\n1;3,5\n"), Ok(vec![vec![0.0, 1.0], vec![1.5, 3.5]]));
        assert_eq!(
            numbers("0,5 1,5\n1 3\n").unwrap_err(),
            "line 1 has 3 columns, 2 are named; name the others `_`, and write decimals with a point"
        );
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
            read(text, &[true, true])
                .map(|c| c.units.iter().map(|u| u.as_ref().map(ToString::to_string)).collect::<Vec<_>>())
        };
        assert_eq!(units("t [ms],x [m]\n0,1\n"), Ok(vec![Some("ms".into()), Some("m".into())]));
        assert_eq!(units("t (ms);x (raw)\n0;1\n"), Ok(vec![Some("ms".into()), None]));
        assert_eq!(units("t [s],x [kp]\n0,1\n"), Err("line 1, column 2: unknown unit `kp` in the heading".into()));
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
            let wanted: Vec<bool> = (0..columns).map(|_| random.below(5) > 0).collect();
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
                    if *wanted {
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
