//! `fric sweep`: many runs of one experiment with other parameters, one row each.
//!
//! Rows are appended in the order of the runs as they complete, so an interrupted file is a prefix of the complete one,
//! and the concatenation of shards is the whole. Until the table is complete, [`Unfinished`] locks it and records the
//! request, so that it cannot be resumed with another sweep or from damaged rows. After completion, [`errors`]
//! estimates the numerical errors of a sample of its runs.

mod best;
mod errors;
mod summary;
mod sketch;
mod statistics;
mod version;
mod request;
mod plan;
mod unit;
mod sink;
mod sent;

use self::best::Best;
use self::plan::Plan;
use self::request::{Fault, Request};
pub use self::request::{Fault as SweepFault, Request as SweepRequest};
pub use self::sent::{Rows, Sent};
use self::sink::{Before, Finished, Sink};
use self::statistics::Cut;
use super::shared::progress;
use super::{End, has_experiment, load_from};
use crate::args::{Keep, Sweep};
use crate::compile::{Loaded, Method, PreparedRun, Stopwatch, Varying};
use crate::named_files::NamedFiles;
use crate::parquet::Holds;
use crate::plot::{self, Axis};
use crate::quantity::{self, count, significant};
use crate::terminal::{Style, Terminal};
use crate::unfinished::Hash;
use crate::vary::{Dice, How, Vary, combinations};
use crate::{project, results};
use abi::plan::{Expect, Formula, Measure};
use abi::unit::Unit;
use abi::{Description, Slot};
use runtime::engine::lanes::{self, Next};
use runtime::engine::sweep::{self, Desk, Ticket};
use runtime::engine::{self, Cause, Continue, Failure, Outcome};
use runtime::run::verdict::Verdict;
use std::fs;
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Draws of distributions if no number is given.
const DEFAULT_RUNS: u64 = 100;

pub fn sweep(args: &Sweep, terminal: &mut Terminal) -> End {
    if let Some(why) = args.look.unused(args.plot.is_some(), "--plot FIG.pdf") {
        terminal.error(&why);
        return End::Misused;
    }
    let end = match &args.unit {
        Some(which) => of_plan(args, terminal).and_then(|planned| planned.unit(args, which, terminal)),
        None if args.join => of_plan(args, terminal).and_then(|planned| planned.join(args, terminal)),
        None => of_text(args, terminal),
    };
    end.unwrap_or_else(|fault| match fault {
        Fault::Misused(message) => {
            terminal.error(&message);
            End::Misused
        }
        fault @ (Fault::Failed(_) | Fault::Version(_)) => {
            terminal.error(&fault.words());
            End::Failed
        }
        Fault::Text(message, _) => {
            terminal.report(&message);
            End::Failed
        }
    })
}

/// The name of the table, or of the statistics if no rows are kept.
fn table_name(args: &Sweep, keep: Keep) -> Result<PathBuf, Fault> {
    let default = if keep.rows() { "sweep.csv" } else { "sweep.json" };
    let out = args.out.clone().unwrap_or_else(|| default.into());
    let named = out.display();
    let why = match out.extension().and_then(|extension| extension.to_str()) {
        _ if args.shard.is_some() && keep.statistics() => {
            format!(
                "--keep {}: the statistics are those of all runs, and --shard has a part: see --plan and --unit",
                keep.name()
            )
        }
        Some("json") if !keep.rows() && args.plot.is_some() => {
            "--plot needs the rows, which --keep summary drops: --keep both".into()
        }
        Some("json") if !keep.rows() => return Ok(out),
        _ if !keep.rows() => format!("--out {named}: the name of statistics ends in .json"),
        Some("csv" | "parquet") => return Ok(out),
        None if args.shard.is_none() => return Ok(out),
        None => "--shard is for tables: the files of a dataset are parts already; see --plan and --unit".into(),
        Some("json") => format!("--out {named}: statistics without rows are written with --keep summary"),
        Some(_) => format!(
            "--out {named}: the name of a table ends in .csv or .parquet, that of a dataset, a folder, has no ending"
        ),
    };
    Err(Fault::Misused(why))
}

/// The sweep of a text: run, or written as a plan.
fn of_text(args: &Sweep, terminal: &mut Terminal) -> Result<End, Fault> {
    if let Some(address) = &args.on {
        let engine = if address.starts_with("ray:") { "ray" } else { "dask" };
        return Err(Fault::Misused(format!(
            "--on {address} needs the Python package, whose `fric` sends units to a cluster: pip install 'fric[{engine}]'; \
             without Python see --plan and --unit"
        )));
    }
    let out = table_name(args, args.keep.unwrap_or_default())?;
    let sources = NamedFiles::default();
    let Some(mut loaded) = load_from(&args.file, &sources, terminal, &mut Stopwatch::start("read")) else {
        return Ok(End::Failed);
    };
    let all: Vec<String> = loaded.experiments().into_iter().map(|experiment| experiment.name).collect();
    let [name] = args.rest.as_slice() else {
        let named = if args.rest.is_empty() { "name an experiment" } else { "name one experiment" };
        return Err(Fault::Misused(format!("{named}: {} has {}", args.file.display(), all.join(", "))));
    };
    let name = name.to_string_lossy();
    has_experiment(&args.file, &name, &all).map_err(Fault::Failed)?;
    let mut request = Request::of(args, &name);
    if let Some(path) = &args.design {
        let told = |error| Fault::Failed(format!("cannot read {}: {error}", path.display()));
        request.design = Some(fs::read_to_string(path).map_err(told)?);
    }
    let table = request::table(request, &mut loaded, &sources, terminal.error_colour())?;
    let (stepped, tol) = (&args.changed.stepped, args.changed.tol);
    let method = table.cases[0].experiment.solver.method;
    if let Some(why) = stepped.without_effect_and(tol, &name, method) {
        return Err(Fault::Misused(why));
    }
    let Some(path) = &args.plan else { return table.run(args, &out, &loaded, terminal).map_err(Fault::Failed) };
    let root = loaded.files.get(loaded.root());
    let bytes = plan::bytes(&table.request, &root.name, &root.text, &sources.all());
    project::write(path, &bytes).map_err(|error| Fault::Failed(format!("cannot write {}: {error}", path.display())))?;
    if !args.quiet {
        let blocks =
            if table.items() == table.total() { String::new() } else { format!(" in {} blocks", count(table.items())) };
        terminal.line(&format!("wrote {}: {} runs of {name}{blocks}", path.display(), count(table.total())));
        terminal.line(&format!("  run a part:  fric sweep --unit 0/8 {}", path.display()));
        terminal.line(&format!(
            "  join all:    fric sweep --join {} *.fricunit --out {}",
            path.display(),
            table_name(args, table.request.keep)?.display()
        ));
    }
    Ok(End::Fine)
}

/// The plan of a sweep as bytes, and the method of its first case.
///
/// # Errors
/// Why it cannot be run.
pub fn planned(request: Request, loaded: &mut Loaded, sources: &NamedFiles) -> Result<(Method, Vec<u8>), Fault> {
    let table = request::table(request, loaded, sources, false)?;
    let root = loaded.files.get(loaded.root());
    let bytes = plan::bytes(&table.request, &root.name, &root.text, &sources.all());
    Ok((table.cases[0].experiment.solver.method, bytes))
}

/// A sweep that was read from a plan.
struct Planned {
    /// The file of the plan, and its hash.
    path: PathBuf,
    hash: String,
    loaded: Loaded,
    table: SweepTable,
}

fn of_plan(args: &Sweep, terminal: &Terminal) -> Result<Planned, Fault> {
    let path = args.file.clone();
    let told = |why: version::Unusable| Fault::Failed(format!("{} {why}", path.display()));
    let bytes = fs::read(&path).map_err(|error| Fault::Failed(format!("cannot read {}: {error}", path.display())))?;
    let Plan { mut request, hash, text } = plan::read(&bytes).map_err(told)?;
    let (mut loaded, sources) = text.load();
    request.interpret = args.interpret;
    let table = request::table(request, &mut loaded, &sources, terminal.error_colour())?;
    Ok(Planned { path, hash, loaded, table })
}

impl Planned {
    /// Makes one unit. One that is there already, whole, is left as it is.
    fn unit(self, args: &Sweep, which: &str, terminal: &mut Terminal) -> Result<End, Fault> {
        if !args.rest.is_empty() {
            return Err(Fault::Misused(
                "--unit takes a plan and nothing more: fric sweep --unit 0/8 sweep.fricjob".into(),
            ));
        }
        let Planned { hash, table, .. } = self;
        let runs = unit::runs(which, table.items(), &|name| std::env::var(name).ok()).map_err(Fault::Misused)?;
        let named = || PathBuf::from(format!("runs-{}-{}.fricunit", runs.start, runs.end));
        let out = args.out.clone().unwrap_or_else(named);
        let told = |error: io::Error| Fault::Failed(format!("cannot write {}: {error}", out.display()));
        let head = unit::Head { plan: hash.clone(), runs: runs.clone() };
        let size = runs.end - runs.start;
        match unit::read_file(&out, &hash, &mut |_, _| Ok(())) {
            Ok((found, _)) if found == runs => {
                if !args.quiet {
                    terminal.line(&format!(
                        "{} has its {} {} already",
                        out.display(),
                        count(size),
                        table.unit_of_work()
                    ));
                }
                return Ok(End::Fine);
            }
            // What only this command writes may be replaced.
            Err(unit::Fault::Cut(found, _) | unit::Fault::Changed(found)) if found == head => {}
            Err(unit::Fault::Unreadable(_)) if !out.exists() => {}
            Ok(_) | Err(_) => {
                return Err(Fault::Failed(format!(
                    "{} is there, and it is not the unit of {} {}..{} of this plan: give this one another --out, or remove it",
                    out.display(),
                    table.unit_of_work(),
                    runs.start,
                    runs.end
                )));
            }
        }
        project::make_folder_of(&out).map_err(told)?;
        let threads = threads(args);
        let (dice, stopped, begin) = (table.dice(), stopped_by_ctrl_c(), Instant::now());
        let rest = "{human_pos} of {human_len}  {per_sec}  {eta} left";
        let bar = progress::bar(size, rest, args.quiet);
        let written = unit::write(&out, &head, |put| {
            let put = &mut |written: u64, row: &[u8]| {
                if written.is_multiple_of(64) {
                    bar.at(written);
                }
                put(row)
            };
            Ok(table.computed(runs.clone(), threads, &dice, &stopped, put)? == size)
        });
        bar.clear();
        if written.map_err(told)?.is_none() {
            terminal.report(&format!("stopped: {} is not written; a unit is whole or not there\n", out.display()));
            return Ok(End::Failed);
        }
        if !args.quiet {
            let wall = quantity::duration(begin.elapsed().as_secs_f64(), 3);
            let what = table.unit_of_work();
            terminal.line(&format!("wrote {}: {what} {}..{} in {wall}", out.display(), runs.start, runs.end));
        }
        Ok(End::Fine)
    }

    /// Joins units to the table of the whole.
    fn join(self, args: &Sweep, terminal: &mut Terminal) -> Result<End, Fault> {
        let Planned { path, hash, loaded, table } = self;
        let out = table_name(args, table.request.keep)?;
        let (mut units, mut faults) = (Vec::new(), Vec::new());
        for path in &args.rest {
            match unit::read_file(path, &hash, &mut |_, _| Ok(())) {
                Ok((runs, hash)) if runs.end <= table.items() => {
                    units.push(unit::Found { path: path.clone(), runs, hash })
                }
                Ok((runs, _)) => faults.push((path, unit::Fault::Changed(unit::Head { plan: hash.clone(), runs }))),
                Err(fault) => faults.push((path, fault)),
            }
        }
        let faults: Vec<String> = faults.iter().map(|(unit, fault)| fault.words(unit, &path)).collect();
        let cover = unit::cover(&units, table.items());
        if args.missing {
            faults.iter().for_each(|fault| terminal.error(fault));
            cover.missing.iter().for_each(|runs| terminal.line(&format!("{}..{}", runs.start, runs.end)));
            return Ok(End::Fine);
        }
        if !faults.is_empty() {
            let (last, first) = faults.split_last().expect("there is one");
            first.iter().for_each(|fault| terminal.error(fault));
            return Err(Fault::Failed(last.clone()));
        }
        if let Some((a, b)) = cover.at_odds {
            let [a, b] = [a, b].map(|k| units[k].path.display());
            return Err(Fault::Failed(format!(
                "{a} and {b} hold the same runs with different rows: one of them was changed after it was made; remove both and \
                 make that unit again"
            )));
        }
        if let Some(first) = cover.missing.first() {
            let runs: u64 = cover.missing.iter().map(|runs| runs.end - runs.start).sum();
            return Err(Fault::Failed(format!(
                "{} of {} {} are in no unit, the first of them {}..{}: fric sweep --unit {}..{} {} makes them; --missing lists \
                 all such ranges",
                count(runs),
                count(table.items()),
                table.unit_of_work(),
                first.start,
                first.end,
                first.start,
                first.end,
                path.display()
            )));
        }
        table.joined(args, &out, &loaded, (&units, &cover, &hash), terminal).map_err(Fault::Failed)
    }
}

/// Threads of a sweep.
fn threads(args: &Sweep) -> usize {
    args.threads.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from))
}

/// All runs of a sweep and the columns of its table.
struct SweepTable {
    request: Request,
    cases: Vec<Varying>,
    vary: Vec<Vary>,
    /// For each case, and each of what varies: the slots that take its values, each with a factor.
    slots: Vec<Vec<Vec<(Slot, f64)>>>,
    /// Combinations of the grids, and draws for each.
    grid: u64,
    draws: u64,
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
    fn new(request: Request, vary: Vec<Vary>, cases: Vec<Varying>, best: Option<Best>) -> Result<SweepTable, String> {
        let mut slots: Vec<Vec<Vec<(Slot, f64)>>> = cases.iter().map(|_| Vec::new()).collect();
        let vary: Vec<Vary> =
            vary.into_iter().map(|vary| placed(vary, &cases, &mut slots)).collect::<Result<_, String>>()?;
        let grid = combinations(&vary);
        let random = vary.iter().any(|vary| vary.len().is_none());
        let draws = match (random, request.runs) {
            (true, runs) => runs.unwrap_or(DEFAULT_RUNS),
            (false, None | Some(1)) => 1,
            (false, Some(_)) => {
                return Err("--runs is for distributions, such as --vary 'm ~ normal(1 kg, 0.1 kg)'".into());
            }
        };
        if !random && request.seed.is_some() {
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
        if best.is_some() && !request.keep.rows() {
            return Err("--best ranks rows, and --keep summary drops them: it keeps the 16 rows with the lowest and the highest \
                 values of each measure; or --keep both"
                .into());
        }
        let table = SweepTable { request, cases, vary, slots, grid, draws, columns, best };
        match table.too_many_groups().filter(|_| table.request.keep.statistics()) {
            Some(why) => Err(why),
            None => Ok(table),
        }
    }

    /// The random numbers of all runs.
    fn dice(&self) -> Dice {
        Dice::new(self.seed())
    }

    fn seed(&self) -> u64 {
        self.request.seed.unwrap_or(1)
    }

    fn total(&self) -> u64 {
        self.cases.len() as u64 * self.grid * self.draws
    }

    /// The case of a run and its values in SI: the design varies slowest and the last grid fastest, with the draws inside
    /// it.
    fn values(&self, run: u64, dice: &Dice) -> (usize, Vec<f64>) {
        let (point, draw) = (run / self.draws, run % self.draws);
        let (case, mut left) = ((point / self.grid) as usize, point % self.grid);
        let mut values = vec![0.0; self.vary.len()];
        let mut stride = self.grid;
        let (mut k, mut row) = (0, None);
        for (vary, value) in self.vary.iter().zip(&mut values) {
            match &vary.how {
                How::Design(all) => {
                    if row.is_none() {
                        stride /= all.len() as u64;
                        row = Some(left / stride);
                        left %= stride;
                    }
                    *value = all[row.unwrap_or(0) as usize];
                }
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

    /// Computes the rows, or those of a shard, and writes the table.
    fn run(&self, args: &Sweep, out: &Path, loaded: &Loaded, terminal: &mut Terminal) -> Result<End, String> {
        let begin = Instant::now();
        let total = self.items();
        let (shard, shards) = args.shard.unwrap_or((1, 1));
        let part = |i: u64| (u128::from(total) * u128::from(i) / u128::from(shards)) as u64;
        let range = part(shard - 1)..part(shard);
        let before = if args.resume { Before::Continue } else { Before::Nothing };
        let asked = self.asked(loaded, &range);
        let which = (range.clone(), shard == 1);
        let mut sink = Sink::begin(self, out, which, asked, before, &mut |words| terminal.report(words))?;
        let told = |error: io::Error| format!("cannot write {}: {error}", out.display());
        let (stopped, threads) = (stopped_by_ctrl_c(), threads(args));
        let rest = "{human_pos} of {human_len}  {per_sec}  {eta} left";
        let bar = progress::bar(range.end - sink.next(), rest, args.quiet);
        let written = self.computed(sink.next()..range.end, threads, &self.dice(), &stopped, &mut |before, row| {
            if sink.row(self, row)? {
                bar.at(before + 1);
            }
            Ok(())
        });
        bar.clear();
        let written = written.map_err(told)?;
        if sink.next() < range.end {
            let (reached, rows) = (sink.next(), sink.rows());
            sink.leave().map_err(told)?;
            terminal.report(&format!(
                "stopped after {} of {} {}, which are kept in {}; go on with --resume\n",
                count(reached - range.start),
                count(range.end - range.start),
                self.unit_of_work(),
                rows.display()
            ));
            return Ok(End::Failed);
        }
        let wall = begin.elapsed().as_secs_f64();
        let written = self.cut().map_or(written, |cut| {
            let runs = cut.runs(range.end - written..range.end);
            runs.end - runs.start
        });
        let how = format!(
            "{} runs in {}, {} a second on {threads} thread{}",
            count(written),
            quantity::duration(wall, 3),
            significant(written as f64 / wall, 3),
            if threads == 1 { "" } else { "s" }
        );
        let finished = sink.finish(self)?;
        let runs = self.cut().map_or(range.clone(), |cut| cut.runs(range));
        self.settle(args, out, &finished, &runs, &how, &stopped, terminal)
    }

    /// Writes the table from the rows of units.
    fn joined(
        &self,
        args: &Sweep,
        out: &Path,
        loaded: &Loaded,
        (units, cover, hash): (&[unit::Found], &unit::Cover, &str),
        terminal: &mut Terminal,
    ) -> Result<End, String> {
        let asked = self.asked(loaded, &(0..self.items()));
        let which = (0..self.items(), true);
        // What this sweep itself has left there is written anew.
        let mut sink = Sink::begin(self, out, which, asked, Before::Replace, &mut |_| ())?;
        for (k, runs) in &cover.taken {
            let path = &units[*k].path;
            let mut failed = None;
            let put = &mut |run: u64, row: &[u8]| {
                if runs.contains(&run)
                    && let Err(error) = sink.row(self, row)
                {
                    failed = Some(format!("cannot write {}: {error}", out.display()));
                    return Err(io::ErrorKind::Other.into());
                }
                Ok(())
            };
            let read = unit::read_file(path, hash, put);
            if let Some(failed) = failed {
                return Err(failed);
            }
            if !matches!(&read, Ok((_, hash)) if *hash == units[*k].hash) {
                return Err(format!("{} has changed while it was read: join again", path.display()));
            }
        }
        let taken = cover.taken.len();
        let s = if taken == 1 { "" } else { "s" };
        let how = format!("{} runs from {} unit{s}", count(self.total()), taken);
        let finished = sink.finish(self)?;
        self.settle(args, out, &finished, &(0..self.total()), &how, &stopped_by_ctrl_c(), terminal)
    }

    /// The first line of a table. Only the first shard has one, so that the concatenation of all is the whole.
    fn header(&self, is_first: bool) -> Vec<u8> {
        if is_first && self.request.keep.rows() {
            line(self.columns.iter().map(|column| column.title.clone()))
        } else {
            Vec::new()
        }
    }

    /// What follows a complete table: its figure, summary and errors. `how`: how the rows came.
    #[allow(clippy::too_many_arguments, reason = "both ways to the last row end here")]
    fn settle(
        &self,
        args: &Sweep,
        out: &Path,
        finished: &Finished,
        range: &Range<u64>,
        how: &str,
        stopped: &AtomicBool,
        terminal: &mut Terminal,
    ) -> Result<End, String> {
        if let (Some(path), Finished::Rows(summary)) = (&args.plot, finished) {
            let figure = args.look.titled(self.figure(args, summary)?);
            let kind = plot::Kind::of(path).unwrap_or(plot::Kind::Svg);
            let bytes = plot::picture(&figure, &args.look.look(), kind);
            project::write(path, &bytes).map_err(|error| format!("cannot write {}: {error}", path.display()))?;
        }
        if !args.quiet {
            let solver = results::solver(&self.cases[0].experiment.solver);
            let heading = format!("{}, {solver}: {how}", self.request.experiment);
            terminal.line(&terminal.styled(Style::Bold, &heading));
            for note in self.cases.iter().flat_map(|case| &case.notes) {
                terminal.line(&format!("  note: {note}"));
            }
            terminal.print(&finished.words(self));
            if !args.no_error {
                match self.errors(range, threads(args), &self.dice(), stopped) {
                    Some(errors) => terminal.print(&errors.words()),
                    None if stopped.load(Ordering::Relaxed) => {
                        terminal
                            .report("stopped before the errors of a sample were estimated; the table is complete\n");
                        return Ok(End::Failed);
                    }
                    None => {}
                }
            }
            let beside = (self.request.keep == Keep::Both).then(|| sink::statistics_of(out));
            let files = beside.iter().chain(&args.plot).map(|path| format!(", {}", path.display())).collect::<String>();
            terminal.line(&format!("  wrote {}{files}", out.display()));
        }
        Ok(End::Fine)
    }

    /// Whether a line can be what was kept under this number: a block of runs, or the row of a run, with the number, the
    /// varied values, the number of columns, and numbers in the columns of measures.
    fn is_row(&self, run: u64, row: &str, dice: &Dice) -> bool {
        if let Some(cut) = self.cut() {
            return statistics::is_block(self, cut, run, row);
        }
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

    /// Number of what is computed one by one and handed in: rows, or blocks of runs if no rows are kept.
    fn items(&self) -> u64 {
        self.cut().map_or(self.total(), Cut::blocks)
    }

    /// What [`SweepTable::items`] counts, in words.
    fn unit_of_work(&self) -> &'static str {
        if self.request.keep.rows() { "runs" } else { "blocks of runs" }
    }

    /// Computes rows, or blocks, and passes each, with how many were passed before it, in order; returns how many.
    fn computed(
        &self,
        items: Range<u64>,
        threads: usize,
        dice: &Dice,
        stopped: &AtomicBool,
        put: &mut dyn FnMut(u64, &[u8]) -> io::Result<()>,
    ) -> io::Result<u64> {
        let rows =
            &mut |runs, see: &mut dyn FnMut(u64, &[u8]) -> io::Result<()>| self.rows(runs, threads, dice, stopped, see);
        match self.cut() {
            None => rows(items, put),
            Some(cut) => self.blocks(cut, items, rows, put),
        }
    }

    /// Computes rows and passes each, with how many were passed before it, in order; returns how many.
    fn rows(
        &self,
        range: Range<u64>,
        threads: usize,
        dice: &Dice,
        stopped: &AtomicBool,
        put: &mut dyn FnMut(u64, &[u8]) -> io::Result<()>,
    ) -> io::Result<u64> {
        let (mut written, mut failed) = (0, None);
        let each = (range.end - range.start) / threads.max(1) as u64;
        let worker = |desk: &Desk<Vec<u8>>| self.work(desk, dice, stopped, each);
        sweep::ordered(range, threads, &worker, &mut |_, row: Vec<u8>| match put(written, &row) {
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
        });
        failed.map_or(Ok(written), Err)
    }

    /// The request that a sweep must share with one that it resumes.
    fn asked(&self, loaded: &Loaded, range: &Range<u64>) -> String {
        let mut asked = format!("fric {}, texts {:016x}\n", env!("CARGO_PKG_VERSION"), Hash::of_texts(loaded));
        let solver = results::solver(&self.cases[0].experiment.solver);
        asked += &format!("{} with {solver} for {} s\n", self.request.experiment, self.cases[0].experiment.duration);
        for vary in self.request.vary.iter().filter(|vary| matches!(vary.how, How::Models(_))) {
            asked += &format!("--vary {}: {:?}\n", vary.path, vary.how);
        }
        for set in &self.request.set {
            asked += &format!("--set {set}\n");
        }
        for vary in &self.vary {
            let how = match &vary.how {
                How::Design(values) => {
                    format!("a design of {} rows, {:016x}", values.len(), Hash::of_numbers(values))
                }
                How::Values(values) => {
                    format!("{} values, {:?} .. {:?}", values.len(), values[0], values[values.len() - 1])
                }
                how => format!("{how:?}"),
            };
            asked += &format!("--vary {} in {}: {how}\n", vary.path, vary.unit);
        }
        if !self.request.keep.rows() {
            asked += "--keep summary\n";
        }
        let Range { start, end } = self.cut().map_or(range.clone(), |cut| cut.runs(range.clone()));
        asked + &format!("--seed {}, runs {start}..{end} of {}\n", self.seed(), self.total())
    }

    /// The titles of the columns, and what their cells hold.
    fn kinds(&self) -> Vec<(String, Holds)> {
        let holds = |column: &Column| match column.kind {
            ColumnKind::Run => Holds::Integers,
            ColumnKind::Case | ColumnKind::Status => Holds::Words,
            ColumnKind::Varied | ColumnKind::Measure | ColumnKind::Value => Holds::Numbers,
            ColumnKind::Verdict => Holds::Booleans,
        };
        self.columns.iter().map(|column| (column.title.clone(), holds(column))).collect()
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
