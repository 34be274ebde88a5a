//! A table that is written and read as a recording has the same values: to the bit, in the units stated, up to its last
//! row; or it is refused with the place.
//!
//! Random tables are written as text (points and commas, four separators, five ways to state units), read by a run,
//! written by `fric run --data` to each format, read by a second run, and written again. An oracle states each number:
//! it reads no file, and knows units as a factor or a divisor. `FRIC_SEED`, `FRIC_RUNS` (default 48 tables).
//!
//! Mutants of reader and writer tried by hand, each fails:
//! - units: the unit of the heading ignored, a second line of units ignored, the data of a run written in SI, the check
//!   of dimensions left out;
//! - rows: the last row lost in text, and in the other formats; no warning about the end of the data;
//! - text: a comma taken for the separator wherever there is one, a decimal comma dropped;
//! - columns: two exchanged in .mat, and in .parquet; the list `columns` ignored; an unknown heading replaced by a place;
//! - digits: -0 written as 0 in CSV, and in the text of the other formats; that text with 15 digits.

use compiler::ir::random::Random;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// How a unit is converted. A divisor rounds once where a factor such as 0.001 would round twice.
#[derive(Clone, Copy, PartialEq)]
enum Scale {
    Times(f64),
    Over(f64),
}

use Scale::{Over, Times};

impl Scale {
    fn si(self, x: f64) -> f64 {
        match self {
            Times(factor) => x * factor,
            Over(divisor) => x / divisor,
        }
    }

    fn shown(self, si: f64) -> f64 {
        match self {
            Times(factor) => si / factor,
            Over(divisor) => si * divisor,
        }
    }
}

/// A unit and its scale.
type Unit = (&'static str, Scale);

/// Units of one dimension each; the first is that of SI. The two last kinds are pure numbers.
const KINDS: [&[Unit]; 8] = [
    &[("m", Times(1.0)), ("mm", Over(1e3)), ("um", Over(1e6)), ("cm", Over(1e2)), ("km", Times(1e3))],
    &[("N", Times(1.0)), ("kN", Times(1e3)), ("mN", Over(1e3))],
    &[("m/s", Times(1.0)), ("mm/s", Over(1e3))],
    &[("N·m", Times(1.0)), ("mN·m", Over(1e3))],
    &[("rad/s", Times(1.0)), ("rpm", Times(2.0 * std::f64::consts::PI / 60.0))],
    &[("K", Times(1.0)), ("mK", Over(1e3))],
    &[("1", Times(1.0)), ("%", Over(1e2))],
    &[("rad", Times(1.0)), ("deg", Times(std::f64::consts::PI / 180.0))],
];
const PURE: usize = 6;
const SECONDS: [Unit; 3] = [("s", Times(1.0)), ("ms", Over(1e3)), ("us", Over(1e6))];

/// Rows lie at multiples of this time, in s. It and its multiples are exact in s, ms and us.
const STEP: f64 = 1.0 / 64.0;

const FORMATS: [&str; 4] = ["csv", "npz", "mat", "parquet"];

fn any<T: Copy>(random: &mut Random, of: &[T]) -> T {
    of[random.below(of.len())]
}

fn shuffled(random: &mut Random, n: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..n).collect();
    for k in (1..n).rev() {
        order.swap(k, random.below(k + 1));
    }
    order
}

/// Zeros of both signs, integers, denormals, and numbers of either sign over 600 decades.
fn value(random: &mut Random) -> f64 {
    let sign = any(random, &[1.0, -1.0]);
    sign * match random.below(8) {
        0 => 0.0,
        1 => random.below(1000) as f64,
        2 => f64::from_bits(1 + random.below(1 << 40) as u64),
        3 => format!("{}e{}", random.within(1.0, 10.0), random.below(600) as i32 - 310).parse().unwrap(),
        4 => random.below(1 << 53) as f64,
        _ => random.within(0.0, 10.0),
    }
}

/// A column of a file: its heading, its numbers as written, and the unit in which they are written.
struct Column {
    heading: String,
    unit: Unit,
    /// Its row of [`KINDS`]; none for the time.
    kind: Option<usize>,
    numbers: Vec<f64>,
}

impl Column {
    fn si(&self) -> Vec<f64> {
        self.numbers.iter().map(|x| self.unit.1.si(*x)).collect()
    }
}

/// How the text of an experiment declares a column.
struct Declared {
    /// Its place in the file.
    column: usize,
    name: String,
    unit: Option<Unit>,
    /// Whether the text names the heading.
    by_heading: bool,
}

/// A random table; its first column is the time.
fn table(random: &mut Random) -> Vec<Column> {
    const NAMES: [&str; 10] = ["x", "F", "force", "pos_", "Kraft", "omega", "columns", "slip_rate", "T", "inf"];
    const ENDINGS: [&str; 9] = ["", " 2", ".v", "é", " (raw)", " #1", "'", ", raw", " – Istwert"];
    let rows = [1, 2, 3 + random.below(40), 3 + random.below(300)][random.below(4)];
    let plain = random.below(2) == 0;
    let unit = any(random, &SECONDS);
    let (mut tick, mut numbers) = (0, Vec::new());
    for _ in 0..rows {
        numbers.push(unit.1.shown(tick as f64 * STEP));
        tick += 1 + random.below(5) / 3;
    }
    let mut columns = vec![Column { heading: "t".into(), unit, kind: None, numbers }];
    for k in 0..1 + random.below(6) {
        let kind = random.below(KINDS.len());
        let ending = if plain { "" } else { any(random, &ENDINGS) };
        let heading = format!("{}{k}{ending}", any(random, &NAMES));
        let numbers = (0..rows).map(|_| value(random)).collect();
        columns.push(Column { heading, unit: any(random, KINDS[kind]), kind: Some(kind), numbers });
    }
    columns
}

/// A table as text: whether it has a heading, and whether it states the units of its columns.
struct Text {
    text: String,
    headed: bool,
    states_units: bool,
}

fn text(random: &mut Random, columns: &[Column]) -> Text {
    let separator = any(random, &[",", ";", "\t", "; "]);
    let comma = random.below(2) == 0;
    let style = random.below(6);
    let headed = style > 0;
    let end = any(random, &["\n", "\r\n"]);
    let trailing = if random.below(6) == 0 { separator.trim_end_matches(' ') } else { "" };
    let row = |cells: Vec<String>| cells.join(separator) + trailing + end;
    let mut out = if random.below(4) == 0 { "\u{feff}".to_string() } else { String::new() };
    if headed && random.below(3) == 0 {
        out += &format!("# bench 3, 2.5 kHz; cold{end}{end}");
    }
    let heading = |column: &Column| {
        let (name, unit) = (&column.heading, column.unit.0);
        let cell = match style {
            1 => format!("{name} [{unit}]"),
            2 => format!("{name} ({unit})"),
            3 => format!("{name} / {unit}"),
            _ => name.clone(),
        };
        if cell.contains(',') { format!("\"{cell}\"") } else { cell }
    };
    if headed {
        out += &row(columns.iter().map(heading).collect());
    }
    if style == 4 {
        let unit = |column: &Column| format!("[{}]", column.unit.0);
        out += &row(columns.iter().map(unit).collect());
    }
    for k in 0..columns[0].numbers.len() {
        let cell = |column: &Column| {
            let x = column.numbers[k];
            let cell = if random.below(2) == 0 { format!("{x:e}") } else { x.to_string() };
            match (comma, separator) {
                (true, ",") => format!("\"{}\"", cell.replace('.', ",")),
                (true, _) => cell.replace('.', ","),
                (false, _) => cell,
            }
        };
        out += &row(columns.iter().map(cell).collect());
    }
    Text { text: out, headed, states_units: (1..=4).contains(&style) }
}

/// A random experiment on a file with these columns, in an order of its own and in units of its own.
fn declared(random: &mut Random, columns: &[Column], headed: bool, states_units: bool) -> Vec<Declared> {
    let is_word = |column: &Column| column.heading.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
    // By name alone, by heading, or by place.
    let by_name = headed && columns.iter().all(is_word) && random.below(3) == 0;
    let order = if headed { shuffled(random, columns.len()) } else { (0..columns.len()).collect() };
    let one = |column: usize| {
        let of = &columns[column];
        let units = of.kind.map_or(&SECONDS[..], |kind| KINDS[kind]);
        let name = match (of.kind, by_name) {
            (None, _) => "t".into(),
            (_, true) => of.heading.clone(),
            (_, false) => format!("d{}", column * 7 % 10 + 10 * column),
        };
        let unit = match (states_units, random.below(3)) {
            (true, 0) => None,
            (true, _) => Some(any(random, units)),
            (false, _) => Some(of.unit),
        };
        Declared { column, name, unit, by_heading: headed && !by_name }
    };
    let mut all: Vec<Declared> = order.into_iter().map(one).collect();
    if headed {
        // Some columns of the file are not used.
        let mut kept = |one: &Declared| columns[one.column].kind.is_none() || random.below(6) > 0;
        let values = all.iter().position(|one| columns[one.column].kind.is_some()).expect("a value");
        let first = all[values].column;
        all.retain(|one| one.column == first || kept(one));
    }
    all
}

/// `data "r.csv" (t [ms] = "t", d0 = "x [mm]")`.
fn statement(file: &str, columns: &[Column], declared: &[Declared]) -> String {
    let one = |one: &Declared| {
        let unit = one.unit.map_or(String::new(), |unit| format!(" [{}]", unit.0));
        let heading = match one.by_heading {
            true => format!(" = \"{}\"", columns[one.column].heading),
            false => String::new(),
        };
        format!("{}{unit}{heading}", one.name)
    };
    format!("data \"{file}\" ({})", declared.iter().map(one).collect::<Vec<_>>().join(", "))
}

/// A text that passes each column on, and what it records.
struct Passing {
    text: String,
    /// Columns of its data, without their numbers. The first is the time.
    recorded: Vec<Column>,
    /// Whence each comes.
    from: Vec<usize>,
}

fn passing(random: &mut Random, columns: &[Column], declared: &[Declared], data: &str, duration: &str) -> Passing {
    let (mut model, mut arguments, mut shows) = (String::new(), Vec::new(), Vec::new());
    let mut recorded = vec![Column { heading: "t".into(), unit: SECONDS[0], kind: None, numbers: vec![] }];
    let mut from = vec![0];
    for place in shuffled(random, declared.len()) {
        let Declared { column, name, .. } = &declared[place];
        let Some(kind) = columns[*column].kind else { continue };
        let si = KINDS[kind][0].0;
        let output = format!("{}{}", any(random, &["y", "columns", "Wert", "q_"]), column * 3 + 1);
        model += &format!("  input  u{column} [{si}]\n  output {output} [{si}] = u{column}\n");
        arguments.push(format!("u{column} = data.{name}"));
        let unit = any(random, KINDS[kind]);
        // A heading with a comma: quoted in CSV, no name in MATLAB.
        let heading = if random.below(4) == 0 { format!("max({output}, {output})") } else { output };
        shows.push(format!("{heading} [{}]", unit.0));
        recorded.push(Column { heading, unit, kind: Some(kind), numbers: vec![] });
        from.push(*column);
    }
    let text = format!(
        "model Passing {{\n{model}}}\n\nexperiment e {{\n  run Passing({}){duration}\n  {data}\n  solver rk4 step {} us\n  \
         record {}\n}}\n",
        arguments.join(", "),
        STEP * 1e6,
        shows.join(", ")
    );
    Passing { text, recorded, from }
}

/// A recording at a time from its first row on: linear between rows, then held; in SI, with the fused sum of the step
/// functions.
fn at(t: f64, times: &[f64], values: &[f64]) -> f64 {
    let last = times.len() - 1;
    if t >= times[last] {
        return values[last];
    }
    let k = times.iter().rposition(|begin| *begin <= t).unwrap_or(0);
    let s = (t - times[k]) / (times[k + 1] - times[k]);
    s.mul_add(values[k + 1] - values[k], values[k])
}

/// The columns that a run of `steps` steps records of a file.
fn pass(columns: &[Column], passing: &Passing, steps: usize) -> Vec<Column> {
    let time = columns.iter().position(|column| column.kind.is_none()).expect("a time");
    let times = columns[time].si();
    let grid: Vec<f64> = (0..=steps).map(|k| k as f64 * STEP).collect();
    let one = |(column, from): (&Column, &usize)| {
        let values = columns[*from].si();
        let shown = |t: &f64| column.unit.1.shown(at(*t, &times, &values));
        let numbers = if column.kind.is_none() { grid.clone() } else { grid.iter().map(shown).collect() };
        Column { heading: column.heading.clone(), numbers, ..*column }
    };
    passing.recorded.iter().zip(&passing.from).map(one).collect()
}

/// The rows of a CSV that the command wrote, without its reader.
fn rows(text: &str) -> (Vec<String>, Vec<Vec<f64>>) {
    let mut lines = text.lines();
    let mut headings = vec![String::new()];
    let mut quoted = false;
    for c in lines.next().expect("a heading").chars() {
        match c {
            '"' => quoted = !quoted,
            ',' if !quoted => headings.push(String::new()),
            c => headings.last_mut().unwrap().push(c),
        }
    }
    let row = |line: &str| line.split(',').map(|cell| cell.parse().unwrap_or_else(|_| panic!("`{cell}`"))).collect();
    (headings, lines.map(row).collect())
}

fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("recordings").join(name);
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).unwrap();
    path
}

/// Runs a text; its exit code and what it says on the standard error.
fn run(folder: &Path, text: &str, args: &[&str]) -> (Option<i32>, String) {
    fs::write(folder.join("p.fric"), text).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
    let done = command.current_dir(folder).args(["run", "p.fric"]).args(args).output().unwrap();
    (done.status.code(), String::from_utf8(done.stderr).unwrap())
}

/// What each case needs to say where it fails.
struct Case<'a> {
    folder: &'a Path,
    label: String,
}

impl Case<'_> {
    fn runs(&self, text: &str, args: &[&str]) -> String {
        let (code, said) = run(self.folder, text, args);
        assert_eq!(code, Some(0), "{}\n{text}\n{said}", self.label);
        said
    }

    /// Refused with exit code 1, the code of the error, its place in the text, and these words.
    fn refused(&self, text: &str, words: &[&str]) {
        let (code, said) = run(self.folder, text, &["--data", "refused.csv"]);
        assert_eq!(code, Some(1), "{}: not refused\n{text}\n{said}", self.label);
        for word in [&["E0903", "p.fric:"], words].concat() {
            assert!(said.contains(word), "{}: no `{word}` in\n{said}\nof\n{text}", self.label);
        }
        assert!(!self.folder.join("refused.csv").exists(), "{}: data of a text that is refused", self.label);
    }

    /// The CSV that the command wrote holds these columns to the bit.
    fn holds(&self, file: &str, expected: &[Column]) {
        let (headings, rows) = rows(&fs::read_to_string(self.folder.join(file)).unwrap());
        let heading = |column: &Column| format!("{} [{}]", column.heading, column.unit.0.replace("um", "µm"));
        let wanted: Vec<String> = expected.iter().map(heading).collect();
        assert_eq!(headings, wanted, "{}, {file}", self.label);
        assert_eq!(rows.len(), expected[0].numbers.len(), "{}, {file}: rows", self.label);
        for (k, row) in rows.iter().enumerate() {
            for (found, column) in row.iter().zip(expected) {
                let (wanted, heading) = (column.numbers[k], &column.heading);
                let said = || format!("{}, {file}: row {}, `{heading}`: {found:e}, not {wanted:e}", self.label, k + 1);
                assert_eq!(found.to_bits(), wanted.to_bits(), "{}", said());
            }
        }
    }

    /// A heading that the file lacks, a unit of another kind and a time that is none are refused.
    fn refuses(&self, random: &mut Random, file: &str, columns: &[Column], units: bool, declared: &[Declared]) {
        let other = declared.iter().position(|one| columns[one.column].kind.is_some()).expect("a value");
        let mut chance = random.clone();
        let mut text = |data: String| passing(&mut chance, columns, declared, &data, "").text;
        let data = statement(file, columns, declared);
        if declared[other].by_heading {
            let heading = format!("\"{}\"", columns[declared[other].column].heading);
            let unknown = format!("\"no {}", &heading[1..]);
            self.refused(
                &text(data.replace(&heading, &unknown)),
                &["does not fit", &format!("has no column {unknown}")],
            );
        }
        if units {
            let kind = columns[declared[other].column].kind.expect("a value");
            let wrong = any(random, KINDS[if kind < PURE { (kind + 1) % PURE } else { 0 }]);
            let changed = |one: &Declared| Declared {
                name: one.name.clone(),
                unit: if one.column == declared[other].column { Some(wrong) } else { one.unit },
                ..*one
            };
            let changed: Vec<Declared> = declared.iter().map(changed).collect();
            self.refused(&text(statement(file, columns, &changed)), &["its heading says so"]);
        }
    }
}

fn number_of(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(otherwise)
}

#[test]
fn a_recording_is_read_as_it_was_written() {
    let (seed, cases) = (number_of("FRIC_SEED", 29), number_of("FRIC_RUNS", 48));
    let folder = folder("round-trip");
    let mut counted = [0; 4];
    for case in 0..cases {
        let mut random = Random(seed.wrapping_mul(1_000_003).wrapping_add(case));
        let random = &mut random;
        let format = FORMATS[case as usize % 4];
        let case = Case {
            folder: &folder,
            label: format!("FRIC_SEED={seed}, case {case}, {format}; files in {}", folder.display()),
        };

        // Text, in any dialect, with its columns in any order.
        let mut columns: Vec<Option<Column>> = table(random).into_iter().map(Some).collect();
        let order = shuffled(random, columns.len());
        let columns: Vec<Column> = order.into_iter().map(|k| columns[k].take().expect("each once")).collect();
        let Text { text, headed, states_units } = text(random, &columns);
        fs::write(folder.join("r.csv"), &text).unwrap();
        let declared_first = declared(random, &columns, headed, states_units);
        let data = statement("r.csv", &columns, &declared_first);

        // Without `for`, the run ends with the recording; beyond, the last row is held, with a warning.
        let time = columns.iter().find(|column| column.kind.is_none()).expect("a time");
        let last = (time.si().last().expect("a row") / STEP) as usize;
        let beyond = if last == 0 { 1 + random.below(5) } else { random.below(2) * random.below(5) };
        let duration =
            if beyond > 0 { format!(" for {} us", (last + beyond) as f64 * STEP * 1e6) } else { String::new() };
        let first = passing(random, &columns, &declared_first, &data, &duration);
        let said = case.runs(&first.text, &["--data", "whole.csv"]);
        assert_eq!(said.contains("W0901"), beyond > 0, "{}: end of data\n{}\n{said}", case.label, first.text);
        let written = pass(&columns, &first, last + beyond);
        case.holds("whole.csv", &written);
        case.refuses(random, "r.csv", &columns, states_units, &declared_first);

        // What the command wrote, in each format, is a recording of the same values.
        let file = format!("whole.{format}");
        case.runs(&first.text, &["--data", &file]);
        let declared_again = declared(random, &written, true, true);
        let data = statement(&file, &written, &declared_again);
        let second = passing(random, &written, &declared_again, &data, "");
        let said = case.runs(&second.text, &["--data", "again.csv"]);
        assert!(!said.contains("W0901"), "{}\n{said}", case.label);
        case.holds("again.csv", &pass(&written, &second, last + beyond));
        case.refuses(random, &file, &written, true, &declared_again);

        // A row that is cut off is refused with its line.
        let mut lines: Vec<&str> = text.lines().collect();
        *lines.last_mut().expect("a row") = "1";
        fs::write(folder.join("r.csv"), lines.join("\n")).unwrap();
        case.refused(&first.text, &[&format!("line {} has 1 columns", lines.len())]);
        counted[usize::from(beyond > 0)] += 1;
        counted[2 + usize::from(headed)] += 1;
    }
    assert!(cases < 40 || counted.iter().all(|count| *count > 2), "seed {seed}: {counted:?}");
}
