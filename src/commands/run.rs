//! `fric run`: compiles experiments, runs them, and shows and writes their results.

use super::{Done, End, compiled, done_beside, has_experiment, load, sound};
use crate::args::{self, Run};
use crate::commands::shared::cross_check::{Crossed, cross};
use crate::commands::shared::open::open;
use crate::compile::{self, Case, Changes, Loaded, Method, Options, Stages, Stopwatch};
use crate::figure::{self, Kept, Recorded};
use crate::plot::{self, Figure, Kind};
use crate::recording_files::{self, Format};
use crate::results::{self, Ran};
use crate::terminal::{Style, Terminal};
use crate::timings::Timings;
use crate::{project, quantity, report};
use grammar::diagnostic::Diagnostic;
use runtime::engine::{self, Cause, Continue, Failure, even_grid};
use runtime::record::Recording;
use serde_json::json;
use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::time::Instant;

pub fn run(args: &Run, timings: &mut Timings, terminal: &mut Terminal) -> End {
    let mut watch = Stopwatch::start("read");
    let Some(mut loaded) = load(&args.file, terminal, &mut watch) else { return End::Failed };
    let names = match chosen(args, &loaded) {
        Ok(names) => names,
        Err(message) => {
            terminal.error(&message);
            return End::Failed;
        }
    };
    let standard = [("--plot", &args.plot), ("--data", &args.data)]
        .map(|(option, file)| file.as_deref().filter(|file| project::is_standard(file)).map(|_| option));
    if let ([Some(_), Some(_)], _) | ([Some(_), _] | [_, Some(_)], true) = (standard, args.json) {
        terminal.error("only one of --plot -, --data - and --json can have the standard output");
        return End::Misused;
    }
    if names.len() > 1 && args.data.is_some() {
        terminal.error(&format!(
            "--data is for one experiment, and this runs {}: name one, or use --out DIR",
            names.join(", ")
        ));
        return End::Misused;
    }
    let by_default = args.plot.is_none() && !args.json;
    let rows = [(args.every.is_some(), "--every"), (args.thin, "--thin")];
    if let Some((_, option)) = rows.into_iter().find(|(given, _)| *given)
        && args.data.is_none()
        && args.out.is_none()
        && !by_default
    {
        terminal.error(&format!(
            "{option} is for the rows of the data, and none are written: add --data FILE or --out DIR"
        ));
        return End::Misused;
    }
    let drawn = args.plot.is_some() || args.out.is_some() || by_default;
    if let Some(why) = args.look.unused(drawn, "--plot FIG.pdf or --out DIR") {
        terminal.error(&why);
        return End::Misused;
    }
    if args.trust.digits.is_some() && args.json {
        terminal.error("--digits is for the text, and --json has all of them: leave one of them out");
        return End::Misused;
    }
    if let Err(diagnostics) = sound(&loaded, args.json || args.quiet, terminal, &mut watch) {
        if args.json {
            names.iter().for_each(|name| refused(args, &loaded, name, &diagnostics, terminal));
        }
        return End::Failed;
    }
    let stages = watch.stop();
    timings.add_all(&stages);
    let options = Options { changes: args.changed.changes(), interpret: args.interpret };
    let mut end = End::Fine;
    // Of several experiments --plot makes one figure.
    let mut together = (names.len() > 1 && args.plot.is_some()).then(Figure::default);
    for name in &names {
        match experiment(args, &mut loaded, name, &options, &stages, &mut together, timings, terminal) {
            End::Fine => {}
            End::Misused => return End::Misused,
            End::Failed | End::Stopped => end = End::Failed,
        }
    }
    if let (Some(figure), Some(path)) = (together, &args.plot) {
        if figure.panels.is_empty() {
            terminal.error(&format!("--plot has nothing to write: none of {} has a `plot`", names.join(", ")));
            return End::Failed;
        }
        let picture = plot::picture(&args.look.titled(figure), &args.look.look(), Kind::of(path).unwrap_or(Kind::Svg));
        let mut written = Written::default();
        if let Err((path, error)) = written.put(path, &picture, "") {
            terminal.error(&format!("cannot write {}: {error}", path.display()));
            return End::Failed;
        }
        terminal.bytes(&written.output);
        if !args.quiet && !args.json && !written.names.is_empty() {
            terminal.line(&format!("wrote {}", written.names.join(", ")));
        }
        if args.open {
            show(Some(path).filter(|path| !project::is_standard(path)).map(PathBuf::as_path), terminal);
        }
    }
    end
}

/// The `--json` output for an experiment that does not compile.
fn refused(args: &Run, loaded: &Loaded, name: &str, diagnostics: &[Diagnostic], terminal: &mut Terminal) {
    let (file, found) = (args.file.display().to_string(), report::json(&loaded.files.0, diagnostics));
    terminal.line(&json!({ "file": file, "experiment": name, "passed": false, "diagnostics": found }).to_string());
}

/// The experiments to run: those named, else all.
fn chosen(args: &Run, loaded: &Loaded) -> Result<Vec<String>, String> {
    let all: Vec<String> = loaded.experiments().into_iter().map(|experiment| experiment.name).collect();
    if all.is_empty() {
        return Err(format!("{} has no experiment to run", args.file.display()));
    }
    args.experiments.iter().try_for_each(|name| has_experiment(&args.file, name, &all))?;
    Ok(if args.experiments.is_empty() { all } else { args.experiments.clone() })
}

#[allow(clippy::too_many_arguments)]
fn experiment(
    args: &Run,
    loaded: &mut Loaded,
    name: &str,
    options: &Options,
    before: &Stages,
    together: &mut Option<Figure>,
    timings: &mut Timings,
    terminal: &mut Terminal,
) -> End {
    let file = args.file.display().to_string();
    let standard = |file: &Option<PathBuf>| file.as_deref().is_some_and(project::is_standard);
    let to_output = standard(&args.plot) || standard(&args.data);
    let talking = !args.json && !args.quiet && !to_output;
    let (cases, stages) = match compiled(loaded, name, options, before, talking, terminal) {
        Ok(compiled) => compiled,
        Err(diagnostics) => {
            if args.json {
                refused(args, loaded, name, &diagnostics, terminal);
            }
            return End::Failed;
        }
    };
    let changed = &args.changed;
    let method = cases.first().map(|case| case.experiment.solver.method);
    if let Some(why) = method.and_then(|method| changed.stepped.without_effect_and(changed.tol, name, method)) {
        terminal.error(&why);
        return End::Misused;
    }
    if let (true, Some(case)) = (talking, cases.first()) {
        terminal.line(&terminal.styled(Style::Bold, name));
        let description = case.instance.description();
        terminal.print(&results::compiled(description, &case.experiment, &stages, cases.len()));
        for note in &case.notes {
            terminal.line(&format!("  note: {note}"));
        }
    }

    let recorded = |case: &Case| case.experiment.recorded().next().is_some();
    if cases.iter().all(|case| case.experiment.plots.is_empty()) {
        let records = cases.iter().any(recorded);
        let asked = [
            (args.plot.is_some() && together.is_none(), "--plot"),
            (args.data.is_some() && !records, "--data"),
            (args.every.is_some() && !records, "--every"),
            (args.thin && !records, "--thin"),
            (args.look.given().is_some() && args.experiments.len() == 1, args.look.given().unwrap_or("--size")),
        ];
        if let Some((_, option)) = asked.into_iter().find(|(asked, _)| *asked) {
            terminal.error(&format!(
                "{}: {option} has nothing to write: `{name}` {}",
                place(loaded, name),
                match option {
                    option if option == "--plot" || args.look.given() == Some(option) =>
                        "draws nothing; add `plot` with what to draw, such as `plot x, v`",
                    _ => "records nothing; add `record` with what to record, such as `record x, v`",
                }
            ));
            return End::Failed;
        }
        if args.out.is_some() && !records {
            let words = "nothing to write: the experiment has no `plot` and no `record`";
            match talking {
                true => terminal.line(&format!("  {words}")),
                false => terminal.report(&format!("--out: {words}\n")),
            }
        }
    }
    let every = |case: &Case| args.every.or(case.experiment.every.filter(|_| !args.thin));
    let grids: Result<Vec<Option<Vec<f64>>>, _> = cases
        .iter()
        .map(|case| every(case).map(|every| even_grid::instants(every, &case.experiment)).transpose())
        .collect();
    let grids = match grids {
        Ok(grids) => grids,
        Err(why) => {
            let option = if args.every.is_some() { "--every" } else { "`every`" };
            terminal.error(&format!("{}: {option}: {why}", place(loaded, name)));
            return End::Failed;
        }
    };
    stages.0.iter().skip(before.0.len()).for_each(|(stage, seconds)| timings.add(stage, *seconds));
    // Files are written before anything is said: they exist even if the reader of our output has gone.
    let errors = !args.trust.no_error;
    let picture = args.plot.as_ref().filter(|_| together.is_none());
    let draws = talking || args.plot.is_some() || folder(args).is_some();
    let files = |cases: &[Case], kept: &[Kept]| {
        let begin = Instant::now();
        let recorded = figure::recorded(cases, kept);
        let drawn = draws.then(|| drawn(name, cases, &recorded, &args.look)).flatten();
        let written = write(args, name, cases, &recorded, &grids, drawn.as_ref(), picture);
        (drawn, written, begin.elapsed().as_secs_f64())
    };
    let (done, (drawn, written, of_files)) = done_beside(cases, stages, !talking, errors, files);
    if let (Some(all), Some(figure)) = (together.as_mut(), &drawn) {
        let mut panels = figure.panels.clone();
        // `--title ""` takes away every heading that the text does not write itself.
        let named = args.look.title.as_deref() != Some("");
        if let Some(first) = panels.first_mut().filter(|first| first.title.is_empty() && named) {
            first.title = name.into();
        }
        all.panels.append(&mut panels);
    }
    timings.add("run", done.wall);
    match errors {
        true => {
            timings.add("errors", done.judging);
            timings.add_meanwhile("files", of_files);
        }
        false => timings.add("files", of_files),
    }
    let crossed: Option<Vec<Crossed>> = match args.cross {
        true => cross(loaded, name, options, &done.cases, terminal),
        false => Some(Vec::new()),
    };
    let mut passed = crossed.as_ref().is_some_and(|all| all.iter().all(Crossed::passed));
    let crossed = crossed.unwrap_or_default();
    for (k, (case, result)) in done.cases.iter().zip(&done.results).enumerate() {
        let ran = Ran {
            file: &file,
            experiment: &case.experiment,
            label: &case.label,
            instance: &case.instance,
            notes: &case.notes,
            result,
            wall: done.wall,
            stages: &done.stages,
        };
        passed &= ran.passed();
        if args.json {
            let mut object = ran.json();
            if let Some(crossed) = crossed.get(k) {
                object["cross"] = crossed.json();
            }
            terminal.line(&object.to_string());
        }
    }
    if talking {
        tell(&done, drawn.as_ref(), args.trust.digits, terminal);
        crossed.iter().for_each(|crossed| terminal.print(&crossed.words(terminal, "  ")));
    } else if args.quiet || to_output {
        complain(name, &done, args.trust.digits, terminal);
        for crossed in crossed.iter().filter(|crossed| !crossed.passed()) {
            terminal.report(&crossed.words(terminal, "  "));
        }
    }
    for (case, result) in done.cases.iter().zip(&done.results) {
        if let Err(failure) = result {
            let label = if case.label.is_empty() { String::new() } else { format!(", {}", case.label) };
            let cause = too_long(loaded, name, options, case, failure).unwrap_or_default();
            terminal.error(&format!("{}: {name}{label}: {failure}{cause}", place(loaded, name)));
        }
    }
    match written {
        Ok(written) => {
            terminal.bytes(&written.output);
            if args.open && together.is_none() {
                show(written.picture.as_deref(), terminal);
            }
            if talking && !written.names.is_empty() {
                terminal.line(&format!("  wrote {}\n", written.names.join(", ")));
            }
            if passed { End::Fine } else { End::Failed }
        }
        Err((path, error)) => {
            terminal.error(&format!("cannot write {}: {error}", path.display()));
            End::Failed
        }
    }
}

/// Says that the length of its steps made a run leave a range or become infinite: adaptive steps do neither.
fn too_long(loaded: &mut Loaded, name: &str, options: &Options, case: &Case, failure: &Failure) -> Option<String> {
    /// The run is given up after this many looks of the engine.
    const MOST_LOOKS: usize = 2000;
    let solver = case.experiment.solver;
    let of_steps = matches!(failure.cause, Cause::Guard { .. } | Cause::NotFinite { .. });
    if !of_steps || solver.method == Method::Adaptive || case.experiment.bench.is_some() {
        return None;
    }
    let changes = Changes { method: Some(Method::Adaptive), step: None, tol: None, ..options.changes.clone() };
    let options = Options { changes, ..options.clone() };
    let cases = compile::compile(loaded, &crate::disk::Disk, name, &options, &mut Vec::new(), &mut |_| ()).ok()?;
    let other = cases.into_iter().find(|other| other.label == case.label)?;
    let mut looks = 0;
    let mut watch = |_| {
        looks += 1;
        if looks > MOST_LOOKS { Continue::Break(()) } else { Continue::Continue(()) }
    };
    // An adaptive run tests ranges at the ends of its steps, which may lie long after a value has left one.
    let passed = match engine::run(other.instance, &other.experiment, &mut watch) {
        Ok(_) => true,
        Err(other) => other.time > 2.0 * failure.time,
    };
    let step = abi::format::time(solver.step);
    passed.then(|| format!("; by adaptive steps it does not: steps of {step} by {} are too long", solver.method.name()))
}

/// The position of an experiment in its file.
fn place(loaded: &Loaded, name: &str) -> String {
    let all = loaded.experiments();
    let found = all.iter().find(|experiment| experiment.name == name);
    found.map_or(String::new(), |experiment| report::place(&loaded.files.0, experiment.span))
}

/// All recordings in one figure; none if the experiment plots nothing.
fn drawn(name: &str, cases: &[Case], recorded: &[Recorded], look: &args::Look) -> Option<Figure> {
    let first = cases.first()?;
    if first.experiment.plots.is_empty() {
        return None;
    }
    let subtitle = format!("{}, {}", first.instance.description().name, results::solver(&first.experiment.solver));
    Some(look.titled(figure::figure(name, &subtitle, 0, recorded)))
}

/// The files that have been written.
#[derive(Default)]
struct Written {
    /// Their paths, each with a remark if it has one.
    names: Vec<String>,
    /// The path of a plot.
    picture: Option<PathBuf>,
    /// What goes to the standard output.
    output: Vec<u8>,
}

impl Written {
    /// Writes a file, or keeps the bytes for the standard output. Returns the path that cannot be written, and why.
    fn put(&mut self, path: &Path, bytes: &[u8], remark: &str) -> Result<(), (PathBuf, String)> {
        if project::is_standard(path) {
            self.output.extend_from_slice(bytes);
            return Ok(());
        }
        project::write_result(path, bytes).map_err(|error| (path.to_path_buf(), error.to_string()))?;
        self.names.push(format!("{}{remark}", path.display()));
        Ok(())
    }
}

/// Shows a plot with the desktop's program, if one was written.
fn show(picture: Option<&Path>, terminal: &mut Terminal) {
    match picture {
        Some(picture) => open(picture, terminal),
        None => terminal.report("--open: no plot was written to a file\n"),
    }
}

/// Most rows of the data that the default folder gets without being asked.
const UNASKED_ROWS: u64 = 100_000;

/// The folder for a plot and the data of each experiment: the requested one, or one where nothing else is requested.
fn folder(args: &Run) -> Option<PathBuf> {
    let by_default = args.plot.is_none() && args.data.is_none() && !args.json;
    args.out.clone().or(by_default.then(|| PathBuf::from("out")))
}

/// Writes the requested files, or returns the one that failed and why. `grids`: the instants of each case in s, where
/// rows are requested on a time grid.
fn write(
    args: &Run,
    name: &str,
    cases: &[Case],
    recorded: &[Recorded],
    grids: &[Option<Vec<f64>>],
    drawn: Option<&Figure>,
    picture: Option<&PathBuf>,
) -> Result<Written, (PathBuf, String)> {
    let folder = folder(args);
    let mut written = Written::default();
    let pictures = folder.iter().map(|folder| folder.join(format!("{name}.svg"))).chain(picture.cloned());
    for (path, figure) in pictures.zip(std::iter::repeat(drawn)).filter_map(|(path, drawn)| Some((path, drawn?))) {
        let bytes = plot::picture(figure, &args.look.look(), Kind::of(&path).unwrap_or(Kind::Svg));
        written.put(&path, &bytes, "")?;
        written.picture = Some(path).filter(|path| !project::is_standard(path)).or(written.picture);
    }
    let tables: Vec<PathBuf> =
        folder.iter().map(|folder| folder.join(format!("{name}.csv"))).chain(args.data.clone()).collect();
    let asked = args.data.is_some() || args.out.is_some();
    for (k, (case, &Recorded { label, recording, .. })) in cases.iter().zip(recorded).enumerate() {
        // Measures over a parameter leave no recording.
        if tables.is_empty() || recording.columns().is_empty() {
            continue;
        }
        let rows = rows(args, case, recording, grids.get(k).and_then(Option::as_ref), asked);
        let (rows, remark) = rows.map_err(|why| (tables[0].clone(), why))?;
        for path in &tables {
            let path = for_case(path, label);
            let format = Format::of(&path).unwrap_or(Format::Csv);
            let bytes = recording_files::bytes(&rows, format).map_err(|error| (path.clone(), error.to_string()))?;
            written.put(&path, &bytes, &remark)?;
        }
    }
    Ok(written)
}

/// The rows of the data of a case: every step, unless something else is requested; and a remark if some are left out.
fn rows<'a>(
    args: &Run,
    case: &Case,
    recording: &'a Recording,
    grid: Option<&Vec<f64>>,
    asked: bool,
) -> Result<(Cow<'a, Recording>, String), String> {
    // How the run ends has been reported for the first one.
    let mut watch = |_| Continue::Continue(());
    if let Some(grid) = grid {
        let evenly = even_grid::record(case.instance.clone(), &case.experiment, grid, &mut watch).0;
        return Ok((Cow::Owned(evenly), String::new()));
    }
    let (kept, seen) = (recording.rows().len() as u64, recording.seen());
    if kept >= seen {
        let remark = if args.thin { " (every step: `--thin` has nothing to leave out)" } else { "" };
        return Ok((Cow::Borrowed(recording), remark.into()));
    }
    let of = format!("{} of {} steps", quantity::count(kept), quantity::count(seen));
    if args.thin {
        return Ok((Cow::Borrowed(recording), format!(" ({of})")));
    }
    if !asked && seen > UNASKED_ROWS {
        return Ok((
            Cow::Borrowed(recording),
            format!(" ({of}: `--data FILE` writes all, `--every TIME` an even grid)"),
        ));
    }
    match engine::every_step(case.instance.clone(), &case.experiment, &mut watch).0 {
        Some(every) => Ok((Cow::Owned(every), String::new())),
        None => {
            let width = recording.columns().len() + 1;
            let most = engine::MOST_NUMBERS / width;
            Err(format!(
                "{} steps of {width} columns are too many, {} steps are possible: take `--every 1ms`, or `--thin` for as many rows as a plot needs",
                quantity::count(seen),
                quantity::count(most as u64)
            ))
        }
    }
}

/// The path with the label of a case before its extension: `compare-fr-LuGre.csv`.
fn for_case(path: &Path, label: &str) -> PathBuf {
    let words: Vec<&str> =
        label.split(|c: char| !(c.is_alphanumeric() || c == '.' || c == '_')).filter(|word| !word.is_empty()).collect();
    if words.is_empty() {
        return path.to_path_buf();
    }
    if project::is_standard(path) {
        return path.to_path_buf();
    }
    let stem = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
    let extension = path.extension().map(|extension| extension.to_string_lossy().into_owned()).unwrap_or_default();
    path.with_file_name(format!("{stem}-{}.{extension}", words.join("-")))
}

/// Prints work, plot and verdicts in full.
fn tell(done: &Done, drawn: Option<&Figure>, digits: Option<u8>, terminal: &mut Terminal) {
    let outcomes: Vec<_> = done.results.iter().filter_map(|result| result.as_ref().ok()).collect();
    if let Some(case) = done.cases.first().filter(|_| !outcomes.is_empty()) {
        terminal.print(&results::work(&case.experiment, &outcomes, done.wall, done.judging));
    }
    let mut notes: Vec<&String> = outcomes.iter().flat_map(|outcome| &outcome.notes).collect();
    notes.dedup();
    for note in notes {
        terminal.line(&format!("  note: {note}"));
    }
    if let Some(figure) = drawn {
        let text = plot::terminal(figure, terminal.width(), terminal.colour());
        terminal.line(&format!("\n{text}"));
    }
    for (case, result) in done.cases.iter().zip(&done.results) {
        let Ok(outcome) = result else { continue };
        if !case.label.is_empty() && !outcome.verdicts.is_empty() {
            terminal.line(&format!("  {}", case.label));
        }
        terminal.print(&results::verdicts(terminal, &outcome.verdicts, outcome.estimate.as_ref(), digits, "  "));
    }
    let labels: Vec<&str> = done.cases.iter().map(|case| case.label.as_str()).collect();
    terminal.print(&results::cases(terminal, &labels, &done.results, "  "));
}

/// Prints failed and undecided expectations to the standard error.
fn complain(name: &str, done: &Done, digits: Option<u8>, terminal: &Terminal) {
    for (case, result) in done.cases.iter().zip(&done.results) {
        let Ok(outcome) = result else { continue };
        let failed: Vec<_> = outcome.verdicts.iter().filter(|verdict| !verdict.passed()).cloned().collect();
        if !failed.is_empty() {
            let label = if case.label.is_empty() { String::new() } else { format!(", {}", case.label) };
            let words = results::verdicts(terminal, &failed, outcome.estimate.as_ref(), digits, "  ");
            terminal.report(&format!("{name}{label}\n{words}"));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_of_a_sweep_carry_their_case() {
        let path = Path::new("out/compare.csv");
        assert_eq!(for_case(path, ""), path);
        assert_eq!(for_case(path, "fr = LuGre(vd = 10 mm/s)"), Path::new("out/compare-fr-LuGre-vd-10-mm-s.csv"));
        assert_eq!(for_case(path, "fr.Fs = 1.25 N"), Path::new("out/compare-fr.Fs-1.25-N.csv"));
    }
}
