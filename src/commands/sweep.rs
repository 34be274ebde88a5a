//! `fric sweep`: many runs of one experiment with other parameters, one row each.
//!
//! Rows are appended in the order of the runs as they complete, so an interrupted file is a prefix of the complete one,
//! and the concatenation of shards is the whole. Until the table is complete, [`Unfinished`] locks it and records the
//! request, so that it cannot be resumed with another sweep or from damaged rows. After completion, [`errors`]
//! estimates the numerical errors of a sample of its runs.

mod best;
mod errors;
mod summary;

use self::best::Best;
use super::shared::progress;
use super::{End, has_experiment, load, reported};
use crate::args::Sweep;
use crate::compile::{self, Changes, Loaded, Options, PreparedRun, Stopwatch, Varying};
use crate::parquet::{self, Holds};
use crate::plot::{self, Axis};
use crate::quantity::{self, count, significant};
use crate::terminal::{Style, Terminal};
use crate::unfinished::{Hash, Mark, Unfinished};
use crate::vary::{Dice, How, Vary};
use crate::{project, results};
use abi::plan::{Expect, Formula, Measure};
use abi::unit::Unit;
use abi::{Description, Slot};
use runtime::engine::lanes::{self, Next};
use runtime::engine::sweep::{self, Desk, Ticket};
use runtime::engine::{self, Cause, Continue, Failure, Outcome};
use runtime::run::verdict::Verdict;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Draws of distributions if no number is given.
const DEFAULT_RUNS: u64 = 100;

pub fn sweep(args: &Sweep, terminal: &mut Terminal) -> End {
    let Some(mut loaded) = load(&args.file, terminal, &mut Stopwatch::start("read")) else { return End::Failed };
    let all: Vec<String> = loaded.experiments().into_iter().map(|experiment| experiment.name).collect();
    if let Err(message) = has_experiment(&args.file, &args.experiment, &all) {
        terminal.error(&message);
        return End::Failed;
    }
    for (k, vary) in args.vary.iter().enumerate() {
        let before = || args.vary[..k].iter().flat_map(Vary::paths);
        if let Some(twice) = vary.paths().find(|path| before().any(|other| other == *path)) {
            terminal.error(&format!("`{twice}` is varied twice; give it one --vary"));
            return End::Misused;
        }
        let set = |wanted: &&str| args.changed.stepped.set.all.iter().any(|(path, _)| path == wanted);
        if let Some(path) = vary.paths().find(set) {
            terminal.error(&format!("`{path}` is both set and varied; leave out --set or --vary"));
            return End::Misused;
        }
    }
    let (models, numbers): (Vec<Vary>, Vec<Vary>) =
        args.vary.iter().cloned().partition(|vary| matches!(vary.how, How::Models(_)));
    let best = match best::read(&args.best) {
        Ok(best) => best,
        Err(message) => {
            terminal.error(&message);
            return End::Misused;
        }
    };
    if let Some(why) = args.look.unused(args.plot.is_some(), "--plot FIG.pdf") {
        terminal.error(&why);
        return End::Misused;
    }
    let Some(cases) = compiled(args, &models, &numbers, best.as_ref(), &mut loaded, terminal) else {
        return End::Failed;
    };
    let method = cases.first().map(|case| case.experiment.solver.method);
    let (stepped, tol) = (&args.changed.stepped, args.changed.tol);
    if let Some(why) = method.and_then(|method| stepped.without_effect_and(tol, &args.experiment, method)) {
        terminal.error(&why);
        return End::Misused;
    }
    if args.vary.is_empty() && cases.len() == 1 {
        terminal.error(&format!(
            "nothing varies: add --vary 'PATH = 1 N .. 2 N by 0.1 N', or a `sweep` to `{}`",
            args.experiment
        ));
        return End::Misused;
    }
    let table = match SweepTable::new(args, numbers, cases, best) {
        Ok(table) => table,
        Err(message) => {
            terminal.error(&message);
            return End::Misused;
        }
    };
    match table.run(args, &loaded, terminal) {
        Ok(end) => end,
        Err(message) => {
            terminal.error(&message);
            End::Failed
        }
    }
}

/// The experiment with its parameters variable; a parameter that is computed from others, or has no value, is assigned
/// one first.
fn compiled(
    args: &Sweep,
    models: &[Vary],
    numbers: &[Vary],
    best: Option<&Best>,
    loaded: &mut Loaded,
    terminal: &Terminal,
) -> Option<Vec<Varying>> {
    // What rows are ranked by need not occur in the experiment.
    let ranked = best.and_then(|best| best.measure.as_ref()).map(|measure| format!("show {measure}"));
    // Models of a slot are compiled one by one, as those of a `sweep`.
    let swept = models.iter().filter_map(|vary| match &vary.how {
        How::Models(models) => Some(format!("sweep {} = {models}", vary.path)),
        _ => None,
    });
    let also = ranked.into_iter().chain(swept);
    let mut options = Options {
        changes: Changes {
            vary: numbers.iter().flat_map(Vary::paths).map(str::to_string).collect(),
            also: also.collect(),
            ..args.changed.changes()
        },
        interpret: args.interpret,
    };
    let name = &args.experiment;
    let first = compile::varying(loaded, &crate::disk::Disk, name, &options, &mut Vec::new());
    let open = |(_, path): &(&Vary, &str)| match &first {
        Ok(cases) => cases.iter().any(|case| case.param(path).is_none()),
        Err(_) => true,
    };
    let all = numbers.iter().flat_map(|vary| vary.paths().map(move |path| (vary, path)));
    let missing: Vec<(&Vary, &str)> =
        all.filter(|(vary, _)| !matches!(vary.how, How::Around(..))).filter(open).collect();
    if missing.is_empty()
        && let Ok(cases) = first
    {
        return Some(cases);
    }
    let shown = |(vary, path): (&Vary, &str)| {
        let unit = Some(vary.unit.to_string()).filter(|unit| unit != "1").unwrap_or_default();
        format!("{path}={} {unit}", vary.unit.from_si(vary.typical()))
    };
    options.changes.set.extend(missing.into_iter().map(shown));
    match compile::varying(loaded, &crate::disk::Disk, name, &options, &mut Vec::new()) {
        Ok(cases) => Some(cases),
        Err(diagnostics) => {
            reported(loaded, &diagnostics, terminal);
            None
        }
    }
}

/// The file to which rows are appended: the table itself, or one beside it if the format cannot grow row by row.
fn rows_of(out: &Path) -> PathBuf {
    match out.extension().is_some_and(|extension| extension == "parquet") {
        true => out.with_file_name(format!(".{}.csv", name_of(out))),
        false => out.to_path_buf(),
    }
}

/// All runs of a sweep and the columns of its table.
struct SweepTable {
    cases: Vec<Varying>,
    vary: Vec<Vary>,
    /// For each case, and each of what varies: the slots that take its values, each with a factor.
    slots: Vec<Vec<Vec<(Slot, f64)>>>,
    /// Combinations of the grids, and draws for each.
    grid: u64,
    draws: u64,
    seed: u64,
    columns: Vec<Column>,
    /// The ranking of rows, with the column that ranks them.
    best: Option<(Best, usize)>,
}

/// Finds the slots of what varies in each case. A share of the values in the text becomes a grid of their unit, or, if
/// several quantities or cases differ in them, one in percent.
fn placed(vary: Vary, cases: &[Varying], slots: &mut [Vec<Vec<(Slot, f64)>>]) -> Result<Vary, String> {
    let (mut values, mut own_unit) = (Vec::new(), None);
    for (case, slots) in cases.iter().zip(slots.iter_mut()) {
        let mut of_case = Vec::new();
        for path in vary.paths() {
            let Some(param) = case.param(path) else {
                return Err(match vary.how {
                    How::Around(..) => format!("`{path}` has no number of its own to vary around: give its values"),
                    _ => format!(
                        "`{path}` is neither a parameter nor a state: only parameters and start values of states vary"
                    ),
                });
            };
            let value = case.params().find(|(quantity, _)| quantity.slot == param.slot).map(|(_, value)| value);
            values.push((path.to_string(), value.unwrap_or(f64::NAN)));
            own_unit = own_unit.or(Some(param.unit.clone()));
            if !matches!(vary.how, How::Around(..)) && param.unit.dimension != vary.unit.dimension {
                let (wanted, found) = (param.unit.dimension.describe(), vary.unit.dimension.describe());
                return Err(format!("`{path}` is {wanted}, it cannot be {found}"));
            }
            of_case.push((param.slot, 1.0));
        }
        slots.push(of_case);
    }
    let (How::Around(..), Some((first, middle)), Some(unit)) = (&vary.how, values.first(), own_unit) else {
        return Ok(vary);
    };
    if let Some((path, value)) = values.iter().find(|(_, value)| !(value.is_finite() && *value != 0.0)) {
        let value = quantity::show(*value, &unit, 6);
        return Err(format!("`{path}` is {value} in the text, of which there is no share: give its values"));
    }
    if values.iter().all(|(path, value)| path == first && value.to_bits() == middle.to_bits()) {
        return Ok(vary.around(*middle, &unit));
    }
    let mut values = values.iter();
    for of_case in slots.iter_mut().filter_map(|slots| slots.last_mut()) {
        for ((_, factor), (_, value)) in of_case.iter_mut().zip(&mut values) {
            *factor = *value;
        }
    }
    let percent = Unit::parse("%").expect("percent is known");
    Ok(vary.around(1.0, &percent))
}

/// The file to which rows are appended, and its checkpoint.
struct Writing<'a> {
    file: &'a mut File,
    unfinished: &'a mut Unfinished,
    mark: Mark,
}

/// A run of a sweep.
struct SweepRun {
    number: u64,
    /// Number of its case.
    at: usize,
    /// The varied values, SI.
    values: Vec<f64>,
    description: Arc<Description>,
}

/// A column of the file.
struct Column {
    title: String,
    /// Its axis in a figure.
    axis: Axis,
    kind: ColumnKind,
    /// For a measure, a value or a verdict: what it is of.
    of: Of,
}

/// What a column shows of the expectations of a run. Cases may have different expectations, so it is found by its text.
#[derive(Clone, PartialEq, Default)]
struct Of {
    /// The expectation, of a value or a verdict.
    expect: String,
    /// The measure as written.
    measure: String,
    /// The window of the expectation in s; infinite to the end of the run.
    window: (f64, f64),
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum ColumnKind {
    Run,
    Case,
    Varied,
    /// A measure, or arithmetic over measures.
    Measure,
    Value,
    Verdict,
    Status,
}

impl ColumnKind {
    /// Whether its cells are numbers that a run yields.
    fn is_measured(self) -> bool {
        matches!(self, ColumnKind::Measure | ColumnKind::Value)
    }
}

/// What a run yields for one expectation.
struct Yield {
    /// Each measure and its value in its unit.
    readings: Vec<(String, f64)>,
    /// The value of the left side, in the unit of the column.
    value: Option<f64>,
    holds: bool,
}

/// The window of an expectation in s, infinite to the end of the run.
fn window(expect: &Expect, duration: f64) -> (f64, f64) {
    (expect.after, if expect.before >= duration { f64::INFINITY } else { expect.before })
}

impl SweepTable {
    fn new(args: &Sweep, vary: Vec<Vary>, cases: Vec<Varying>, best: Option<Best>) -> Result<SweepTable, String> {
        let mut slots: Vec<Vec<Vec<(Slot, f64)>>> = cases.iter().map(|_| Vec::new()).collect();
        let vary: Vec<Vary> =
            vary.into_iter().map(|vary| placed(vary, &cases, &mut slots)).collect::<Result<_, String>>()?;
        let grid = vary.iter().filter_map(Vary::len).map(|len| len as u64).product();
        let random = vary.iter().any(|vary| vary.len().is_none());
        let draws = match (random, args.runs) {
            (true, runs) => runs.unwrap_or(DEFAULT_RUNS),
            (false, None | Some(1)) => 1,
            (false, Some(_)) => {
                return Err("--runs is for distributions, such as --vary 'm ~ normal(1 kg, 0.1 kg)'".into());
            }
        };
        if !random && args.seed.is_some() {
            return Err("--seed is for distributions, such as --vary 'm ~ normal(1 kg, 0.1 kg)'".into());
        }
        let columns = columns(&cases, &vary);
        let best = match best {
            Some(best) => {
                let column = best.column(&columns)?;
                Some((best, column))
            }
            None => None,
        };
        Ok(SweepTable { cases, vary, slots, grid, draws, seed: args.seed.unwrap_or(1), columns, best })
    }

    fn total(&self) -> u64 {
        self.cases.len() as u64 * self.grid * self.draws
    }

    /// The case of a run and its values in SI: the last grid varies fastest, with the draws inside it.
    fn values(&self, run: u64, dice: &Dice) -> (usize, Vec<f64>) {
        let (point, draw) = (run / self.draws, run % self.draws);
        let (case, mut left) = ((point / self.grid) as usize, point % self.grid);
        let mut values = vec![0.0; self.vary.len()];
        let mut stride = self.grid;
        let mut k = 0;
        for (vary, value) in self.vary.iter().zip(&mut values) {
            match &vary.how {
                How::Values(all) => {
                    stride /= all.len() as u64;
                    *value = all[(left / stride) as usize];
                    left %= stride;
                }
                how => {
                    // The same draws at each point of a grid (common random numbers): points differ by what was
                    // changed, not by chance.
                    *value = dice.value(how, draw, k);
                    k += 1;
                }
            }
        }
        (case, values)
    }

    /// The number of the case of a run.
    fn case_of(&self, run: u64) -> usize {
        (run / self.draws / self.grid) as usize
    }

    /// Executes runs and hands in their rows: in lanes if available and if there are enough runs to fill them.
    fn work(&self, desk: &Desk<Vec<u8>>, dice: &Dice, stopped: &AtomicBool, each: u64) {
        let watch = &mut |_| match stopped.load(Ordering::Relaxed) {
            true => Continue::Break(()),
            false => Continue::Continue(()),
        };
        // A run that was taken already but belongs to the next case.
        let mut first = None;
        loop {
            let number = match first.take() {
                Some(number) => number,
                None => match desk.number(false) {
                    Ticket::Number(number) => number,
                    Ticket::Later | Ticket::Nothing => return,
                },
            };
            let at = self.case_of(number);
            let Some(lanes) = self.cases[at].lanes().filter(|lanes| each >= lanes.width() as u64 / 2) else {
                let row = match self.fitted(number, dice) {
                    Ok((run, fitted)) => {
                        let PreparedRun { instance, experiment } = fitted;
                        self.row(run, engine::run(instance, &experiment, watch))
                    }
                    Err(row) => Some(row),
                };
                desk.hand_in(number, row);
                continue;
            };
            first = Some(number);
            let mut next = |busy: bool| loop {
                let number = match first.take().map_or_else(|| desk.number(busy), Ticket::Number) {
                    Ticket::Number(number) => number,
                    Ticket::Later => return Next::Later,
                    Ticket::Nothing => return Next::Nothing,
                };
                if self.case_of(number) != at {
                    first = Some(number);
                    return Next::Nothing;
                }
                match self.fitted(number, dice) {
                    Ok((run, fitted)) => return Next::Run(run, Box::new((fitted.instance, fitted.experiment))),
                    Err(row) => desk.hand_in(number, Some(row)),
                }
            };
            let mut give = |run: SweepRun, result| {
                let number = run.number;
                desk.hand_in(number, self.row(run, result));
            };
            lanes::run(lanes, &mut next, &mut give, watch);
        }
    }

    /// A run with its values; or the row of a run that its values do not allow.
    fn fitted(&self, number: u64, dice: &Dice) -> Result<(SweepRun, PreparedRun), Vec<u8>> {
        let (at, values) = self.values(number, dice);
        let of = |(slots, value): (&Vec<(Slot, f64)>, &f64)| {
            slots.iter().map(|(slot, factor)| (*slot, factor * value)).collect::<Vec<_>>()
        };
        let given: Vec<(Slot, f64)> = self.slots[at].iter().zip(&values).flat_map(of).collect();
        let description = |fitted: &PreparedRun| fitted.instance.description().clone();
        match self.cases[at].at(&given) {
            Ok(fitted) => Ok((SweepRun { number, at, values, description: description(&fitted) }, fitted)),
            Err(broken) => Err(self.cells(number, at, &values, &[], &format!("not run: {broken}"))),
        }
    }

    /// The outcome of a run as a row; none if it was stopped.
    fn row(&self, run: SweepRun, result: Result<Outcome, Failure>) -> Option<Vec<u8>> {
        let SweepRun { number, at, values, description } = run;
        let case = &self.cases[at];
        let mut yields: Vec<Yield> = Vec::new();
        let status = match result {
            Err(failure) if failure.cause == Cause::Stopped => return None,
            Err(failure) => format!("stopped: {failure}"),
            Ok(outcome) => {
                let (own, watched) = outcome.verdicts.split_at(case.expects());
                let extremes: Vec<(f64, f64)> = watched.iter().map(extremes).collect();
                for verdict in own {
                    let read = |r: &runtime::run::verdict::Reading| (r.text.clone(), r.unit.from_si(r.value));
                    let shown = verdict.shown.as_ref().map(|shown| shown.unit.from_si(shown.value));
                    let compared = verdict.margin.as_ref().map(|margin| margin.unit.from_si(margin.value));
                    yields.push(Yield {
                        readings: verdict.readings.iter().map(read).collect(),
                        value: shown.or(compared),
                        holds: verdict.holds,
                    });
                }
                let problem = own.iter().find_map(|verdict| verdict.problem.clone());
                match (case.left(&description, &extremes), problem) {
                    (Some(left), _) => format!("stopped: {left}"),
                    (None, Some(problem)) => problem,
                    (None, None) => "ok".into(),
                }
            }
        };
        Some(self.cells(number, at, &values, &yields, &status))
    }

    /// A row.
    fn cells(&self, run: u64, at: usize, values: &[f64], yields: &[Yield], status: &str) -> Vec<u8> {
        let case = &self.cases[at];
        let duration = case.experiment.duration;
        let expects = || case.experiment.expects[..case.expects()].iter().zip(yields);
        let number = |value: Option<f64>| value.map_or(String::new(), abi::format::plain);
        let cell = |column: &Column| match column.kind {
            ColumnKind::Run => run.to_string(),
            ColumnKind::Case => case.label.clone(),
            ColumnKind::Varied => {
                let k = self.vary.iter().position(|vary| vary.path == column.axis.name).expect("it is varied");
                abi::format::plain(self.vary[k].unit.from_si(values[k]))
            }
            // For an expectation that could not be evaluated, some measures may be missing; for one of another case, all.
            ColumnKind::Measure => number(expects().find_map(|(expect, found)| {
                let known = window(expect, duration) == column.of.window;
                let read = |read: &&(String, f64)| known && read.0 == column.of.measure;
                found.readings.iter().find(read).map(|(_, value)| *value)
            })),
            ColumnKind::Value => {
                number(expects().find_map(|(expect, found)| found.value.filter(|_| expect.text == column.of.expect)))
            }
            ColumnKind::Verdict => {
                let found = expects().find(|(expect, _)| expect.text == column.of.expect);
                found.map_or(String::new(), |(_, found)| found.holds.to_string())
            }
            ColumnKind::Status => status.split_whitespace().collect::<Vec<_>>().join(" "),
        };
        line(self.columns.iter().map(cell))
    }

    fn run(&self, args: &Sweep, loaded: &Loaded, terminal: &mut Terminal) -> Result<End, String> {
        let begin = Instant::now();
        let total = self.total();
        let (shard, shards) = args.shard.unwrap_or((1, 1));
        let part = |i: u64| (u128::from(total) * u128::from(i) / u128::from(shards)) as u64;
        let range = part(shard - 1)..part(shard);
        // Only the first shard has a header, so that the concatenation of all is the whole.
        let header = if shard == 1 { line(self.columns.iter().map(|column| column.title.clone())) } else { Vec::new() };
        let asked = self.asked(args, loaded, &range);
        let out = &args.out;
        let rows = rows_of(out);
        let told = |what: &str, error: io::Error| format!("cannot {what} {}: {error}", out.display());
        project::make_folder_of(out).map_err(|error| told("write", error))?;
        let mut unfinished = Unfinished::claim(out)?;
        let before = unfinished.before().map(str::to_string);
        let dice = Dice::new(self.seed);
        let mut mark = Mark { rows: 0, bytes: 0, hash: Hash::EMPTY };
        match (args.resume, &before) {
            (true, Some(before)) if *before != asked.trim_end() => {
                return Err(format!(
                    "{} was begun with other settings or another text:\n{}now:\n{}give the same, or remove it",
                    out.display(),
                    indented(before),
                    indented(&asked)
                ));
            }
            (true, Some(_)) => {
                let fits = |k: u64, row: &str| self.is_row(range.start + k, row, &dice);
                let sound = unfinished.sound(&rows, &header, &fits).map_err(|error| told("read", error))?;
                mark = sound.mark;
                if let Some(fault) = sound.fault {
                    terminal.report(&format!(
                        "{fault} of {} is missing or not as it was written: rows from {} on are computed again\n",
                        rows.display(),
                        range.start + mark.rows
                    ));
                }
            }
            (true, None) if out.exists() => {
                return Err(format!("{} is complete or was not made by a sweep: nothing to resume", out.display()));
            }
            (false, Some(_)) if rows.exists() => {
                return Err(format!(
                    "{} holds a sweep that is not finished; go on with --resume, or remove it",
                    out.display()
                ));
            }
            (true | false, _) => {}
        }
        let mut file = if mark.rows > 0 {
            OpenOptions::new().append(true).open(&rows).map_err(|error| told("write", error))?
        } else {
            unfinished.begin(&asked).map_err(|error| told("write", error))?;
            let mut file = File::create(&rows).map_err(|error| told("write", error))?;
            file.write_all(&header).map_err(|error| told("write", error))?;
            mark = Mark { rows: 0, bytes: header.len() as u64, hash: Hash::EMPTY.and(&header) };
            file
        };
        let threads = args.threads.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from));
        let from = range.start + mark.rows;
        let into = Writing { file: &mut file, unfinished: &mut unfinished, mark };
        let stopped = stopped_by_ctrl_c();
        let written =
            self.append(args, into, from..range.end, threads, &dice, &stopped).map_err(|error| told("write", error))?;
        let reached = from + written;
        let wall = begin.elapsed().as_secs_f64();
        if reached < range.end {
            terminal.report(&format!(
                "stopped after {} of {} runs, which are kept in {}; go on with --resume\n",
                count(reached - range.start),
                count(range.end - range.start),
                rows.display()
            ));
            return Ok(End::Failed);
        }
        file.sync_all().map_err(|error| told("write", error))?;
        let summary = self.summary(&rows, shard == 1).map_err(|error| told("read", error))?;
        if rows != *out {
            self.convert(&rows, shard == 1, out).map_err(|error| told("write", error))?;
        }
        unfinished.finish();
        if let Some(path) = &args.plot {
            let figure = args.look.titled(self.figure(args, &summary)?);
            let kind = plot::Kind::of(path).unwrap_or(plot::Kind::Svg);
            let bytes = plot::picture(&figure, &args.look.look(), kind);
            project::write(path, &bytes).map_err(|error| format!("cannot write {}: {error}", path.display()))?;
        }
        if !args.quiet {
            let speed = written as f64 / wall;
            let heading = format!(
                "{}, {}: {} runs in {}, {} a second on {} thread{}",
                args.experiment,
                results::solver(&self.cases[0].experiment.solver),
                count(written),
                quantity::duration(wall, 3),
                significant(speed, 3),
                threads,
                if threads == 1 { "" } else { "s" }
            );
            terminal.line(&terminal.styled(Style::Bold, &heading));
            for note in self.cases.iter().flat_map(|case| &case.notes) {
                terminal.line(&format!("  note: {note}"));
            }
            terminal.print(&summary.words(self));
            if !args.no_error {
                match self.errors(&range, threads, &dice, &stopped) {
                    Some(errors) => terminal.print(&errors.words()),
                    None if stopped.load(Ordering::Relaxed) => {
                        terminal
                            .report("stopped before the errors of a sample were estimated; the table is complete\n");
                        return Ok(End::Failed);
                    }
                    None => {}
                }
            }
            let files = args.plot.iter().map(|path| format!(", {}", path.display())).collect::<String>();
            terminal.line(&format!("  wrote {}{files}", out.display()));
        }
        Ok(End::Fine)
    }

    /// Whether a line of the table can be the row of a run: its number, the varied values, the number of columns, and
    /// numbers in the columns of measures.
    fn is_row(&self, run: u64, row: &str, dice: &Dice) -> bool {
        let mut reader = csv::ReaderBuilder::new().has_headers(false).flexible(true).from_reader(row.as_bytes());
        let mut record = csv::StringRecord::new();
        if !reader.read_record(&mut record).is_ok_and(|found| found) || record.len() != self.columns.len() {
            return false;
        }
        // The CSV reader accepts missing quotes; readers of the whole table do not.
        if line(record.iter().map(str::to_string)).strip_suffix(b"\n") != Some(row.as_bytes()) {
            return false;
        }
        let (at, values) = self.values(run, dice);
        let mut varied = self.vary.iter().zip(&values);
        self.columns.iter().zip(&record).all(|(column, cell)| match column.kind {
            ColumnKind::Run => cell == run.to_string(),
            ColumnKind::Case => cell == self.cases[at].label,
            ColumnKind::Varied => {
                varied.next().is_some_and(|(vary, value)| cell == abi::format::plain(vary.unit.from_si(*value)))
            }
            ColumnKind::Measure | ColumnKind::Value => cell.is_empty() || cell.parse::<f64>().is_ok(),
            ColumnKind::Verdict => matches!(cell, "" | "true" | "false"),
            ColumnKind::Status => !cell.is_empty(),
        })
    }

    /// Appends rows; returns how many.
    fn append(
        &self,
        args: &Sweep,
        into: Writing,
        range: Range<u64>,
        threads: usize,
        dice: &Dice,
        stopped: &AtomicBool,
    ) -> io::Result<u64> {
        let Writing { file, unfinished, mut mark } = into;
        let rest = "{human_pos} of {human_len}  {per_sec}  {eta} left";
        let bar = progress::bar(range.end - range.start, rest, args.quiet);
        let mut writer = BufWriter::new(file);
        let (mut written, mut failed) = (0, None);
        let mut flushed = Instant::now();
        let each = (range.end - range.start) / threads.max(1) as u64;
        let worker = |desk: &Desk<Vec<u8>>| self.work(desk, dice, stopped, each);
        sweep::ordered(range, threads, &worker, &mut |_, row: Vec<u8>| {
            let mut put = || {
                writer.write_all(&row)?;
                let Mark { rows, bytes, hash } = mark;
                mark = Mark { rows: rows + 1, bytes: bytes + row.len() as u64, hash: hash.and(&row) };
                if flushed.elapsed() > Duration::from_millis(200) {
                    writer.flush()?;
                    unfinished.note(mark)?;
                    flushed = Instant::now();
                    bar.at(written + 1);
                }
                Ok(())
            };
            match put() {
                Ok(()) => {
                    written += 1;
                    Continue::Continue(())
                }
                Err(error) => {
                    failed = Some(error);
                    // Runs in progress need not finish.
                    stopped.store(true, Ordering::Relaxed);
                    Continue::Break(())
                }
            }
        });
        bar.clear();
        match failed {
            Some(error) => Err(error),
            None => writer.flush().map(|()| written),
        }
    }

    /// The request that a sweep must share with one that it resumes.
    fn asked(&self, args: &Sweep, loaded: &Loaded, range: &Range<u64>) -> String {
        let texts = loaded.files.0.iter().filter(|file| !file.name.starts_with("--"));
        let texts = texts.fold(Hash::EMPTY, |hash, file| hash.and(file.text.as_bytes()));
        let mut asked = format!("fric {}, texts {texts:016x}\n", env!("CARGO_PKG_VERSION"));
        let solver = results::solver(&self.cases[0].experiment.solver);
        asked += &format!("{} with {solver} for {} s\n", args.experiment, self.cases[0].experiment.duration);
        for vary in args.vary.iter().filter(|vary| matches!(vary.how, How::Models(_))) {
            asked += &format!("--vary {}: {:?}\n", vary.path, vary.how);
        }
        for set in args.changed.stepped.set.texts() {
            asked += &format!("--set {set}\n");
        }
        for vary in &self.vary {
            let how = match &vary.how {
                How::Values(values) => {
                    format!("{} values, {:?} .. {:?}", values.len(), values[0], values[values.len() - 1])
                }
                how => format!("{how:?}"),
            };
            asked += &format!("--vary {} in {}: {how}\n", vary.path, vary.unit);
        }
        asked + &format!("--seed {}, runs {}..{} of {}\n", self.seed, range.start, range.end, self.total())
    }

    /// Converts the rows to a Parquet file, after which they are no longer needed.
    fn convert(&self, rows: &Path, header: bool, out: &Path) -> io::Result<()> {
        let holds = |column: &Column| match column.kind {
            ColumnKind::Run => Holds::Integers,
            ColumnKind::Case | ColumnKind::Status => Holds::Words,
            ColumnKind::Varied | ColumnKind::Measure | ColumnKind::Value => Holds::Numbers,
            ColumnKind::Verdict => Holds::Booleans,
        };
        let columns: Vec<(String, Holds)> =
            self.columns.iter().map(|column| (column.title.clone(), holds(column))).collect();
        let part = out.with_file_name(format!(".{}.part", name_of(out)));
        let written = File::create(&part)
            .and_then(|to| parquet::from_csv(File::open(rows)?, header, &columns, to))
            .and_then(|()| fs::rename(&part, out))
            .and_then(|()| fs::remove_file(rows));
        if written.is_err() {
            let _ = fs::remove_file(&part);
        }
        written
    }
}

/// A flag that Ctrl-C sets. A second Ctrl-C ends the process at once: the table then holds complete rows except for the
/// last, which --resume drops.
fn stopped_by_ctrl_c() -> Arc<AtomicBool> {
    let stopped = Arc::new(AtomicBool::new(false));
    let flag = stopped.clone();
    crate::interrupt::on_interrupt(move || {
        if flag.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
    });
    stopped
}

/// Least and greatest value of a guarded range.
pub fn extremes(watched: &Verdict) -> (f64, f64) {
    let value = |k: usize| watched.readings.get(k).map_or(f64::NAN, |reading| reading.value);
    (value(0), value(1))
}

fn columns(cases: &[Varying], vary: &[Vary]) -> Vec<Column> {
    let plain = |title: &str, kind| Column { title: title.into(), axis: Axis::default(), kind, of: Of::default() };
    let mut columns = vec![plain("run", ColumnKind::Run)];
    if cases.len() > 1 {
        columns.push(plain("case", ColumnKind::Case));
    }
    let titled = |name: &str, unit: &Unit, kind, of| {
        let axis = Axis { name: name.into(), unit: unit.text.clone(), ..Axis::default() };
        Column { title: axis.title(), axis, kind, of }
    };
    columns.extend(vary.iter().map(|vary| titled(&vary.path, &vary.unit, ColumnKind::Varied, Of::default())));
    let all = || cases.iter().flat_map(|case| case.experiment.expects[..case.expects()].iter().map(move |e| (case, e)));
    // The same measure in windows of two expectations is two columns.
    let windows = |text: &str| {
        let mut found: Vec<(f64, f64)> = Vec::new();
        for (case, expect) in all().filter(|(_, expect)| expect.measures.iter().any(|measure| measure.text == text)) {
            let window = window(expect, case.experiment.duration);
            found.extend((!found.contains(&window)).then_some(window));
        }
        found.len()
    };
    let known =
        |columns: &[Column], kind, of: &Of| columns.iter().any(|column| column.kind == kind && column.of == *of);
    for (case, expect) in all() {
        let window = window(expect, case.experiment.duration);
        for Measure { text, unit, .. } in &expect.measures {
            let of = Of { expect: String::new(), measure: text.clone(), window };
            if known(&columns, ColumnKind::Measure, &of) {
                continue;
            }
            let mut name = text.clone();
            if windows(text) > 1 {
                name += &if window.0 > 0.0 { format!(" after {} s", window.0) } else { String::new() };
                name += &if window.1.is_finite() { format!(" before {} s", window.1) } else { String::new() };
            }
            columns.push(titled(&name, unit, ColumnKind::Measure, of));
        }
        let of = Of { expect: expect.text.clone(), measure: String::new(), window };
        if let Some((left, unit)) = left_side(expect)
            && !known(&columns, ColumnKind::Value, &of)
            && columns.iter().all(|column| column.axis.name != left)
        {
            columns.push(titled(&left, &unit, ColumnKind::Value, of.clone()));
        }
        if !matches!(expect.condition, Formula::Shown(..)) && !known(&columns, ColumnKind::Verdict, &of) {
            columns.push(Column { of, ..plain(&expect.text, ColumnKind::Verdict) });
        }
    }
    columns.push(plain("status", ColumnKind::Status));
    columns
}

/// The left side of an expectation, or what is shown, as text with its unit; none for a measure alone, which has a column.
fn left_side(expect: &Expect) -> Option<(String, Unit)> {
    let text = expect.text.trim();
    let (unit, left, text) = match &expect.condition {
        Formula::Shown(unit, value) => {
            let window = text.find(" after ").or(text.find(" before ")).unwrap_or(text.len());
            let shown = text[..window].trim_end();
            (unit, &**value, shown.rsplit_once(" [").map_or(shown, |(left, _)| left))
        }
        Formula::In(unit, comparison) => {
            let left = match &**comparison {
                Formula::Less(a, _)
                | Formula::LessEqual(a, _)
                | Formula::Greater(a, _)
                | Formula::GreaterEqual(a, _) => a,
                Formula::Near { value, .. } => value,
                _ => return None,
            };
            let sign = text.find(['<', '>', '~', '=']).unwrap_or(text.len());
            (unit, &**left, &text[..sign])
        }
        _ => return None,
    };
    let plain = matches!(left, Formula::Measure(_) | Formula::Number(_));
    (!plain).then(|| (text.trim().to_string(), unit.clone()))
}

/// A row of the file.
fn line(cells: impl Iterator<Item = String>) -> Vec<u8> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    writer.write_record(cells).expect("writing to memory does not fail");
    writer.into_inner().expect("writing to memory does not fail")
}

fn name_of(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

fn indented(text: &str) -> String {
    text.lines().map(|line| format!("  {line}\n")).collect()
}
