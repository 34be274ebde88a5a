//! `fric characterise` and `fric compare`: run friction models through the standard battery.

use super::End;
use crate::args::{Characterise, Compare, Figures};
use crate::characterise::subject::{self, Origin, Subject, Written};
use crate::characterise::{Extent, Seen, Study, latex, page, shown, study};
use crate::compile::{self, Changes, Loaded, Options};
use crate::terminal::{Style, Terminal};
use crate::vary::{How, Vary};
use crate::{project, report};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

pub fn characterise(args: &Characterise, terminal: &mut Terminal) -> End {
    let found = match subjects(&args.what, &args.models, &args.set, args.out.as_deref()) {
        Ok(found) => found,
        Err(why) => return failed(terminal, &why),
    };
    if let Some(over) = &args.over {
        return family(args, over, terminal);
    }
    let mut end = End::Fine;
    for (subject, folder) in found {
        let label = subject.instance.label();
        let study = match study(subject, &battery_in(&folder), &crate::disk::Disk, Extent::Whole) {
            Ok(study) => study,
            Err(why) => {
                end = failed(terminal, &format!("{label} {why}"));
                continue;
            }
        };
        let written = write(&study, &folder, &args.figures);
        if args.json {
            terminal.line(&json(&study).to_string());
        } else {
            tell(&study, terminal);
        }
        match written {
            Ok(count) if !args.json => {
                let page = folder.join("report.html");
                terminal.line(&format!("  wrote {}, battery.fric, report.tex and {count} beside it\n", page.display()));
            }
            Ok(_) => {}
            Err(why) => end = failed(terminal, &why),
        }
    }
    end
}

/// A model with several values of one input or parameter, side by side.
fn family(args: &Characterise, over: &Vary, terminal: &mut Terminal) -> End {
    let How::Values(values) = &over.how else {
        terminal.error("--over takes values, such as 'N = 5 N, 10 N': distributions are for `fric sweep`");
        return End::Misused;
    };
    if values.len() > MOST_OVER {
        terminal.error(&format!("--over takes up to {MOST_OVER} values, and these are {}", values.len()));
        return End::Misused;
    }
    let (mut studies, mut folder, mut end) = (Vec::new(), PathBuf::new(), End::Fine);
    for value in values {
        let mut set = args.set.clone();
        let unit = if over.unit.text.is_empty() { String::new() } else { format!(" {}", over.unit) };
        set.push((over.path.clone(), format!("{}{unit}", over.unit.from_si(*value))));
        let found = match subjects(&args.what, &args.models, &set, args.out.as_deref()) {
            Ok(found) => found,
            Err(why) => return failed(terminal, &why),
        };
        for (subject, own) in found {
            if add(&mut studies, subject, &own, terminal) != End::Fine {
                end = End::Failed;
            }
            folder = own;
        }
    }
    compared(&studies, &args.out.clone().unwrap_or(folder), &args.figures, args.json, end, terminal)
}

/// Most values of `--over`.
const MOST_OVER: usize = 12;

pub fn compare(args: &Compare, terminal: &mut Terminal) -> End {
    let folder = args.out.clone().unwrap_or_else(|| PathBuf::from("out").join("compare"));
    let mut studies: Vec<Study> = Vec::new();
    let mut end = End::Fine;
    for what in &args.models {
        let found = match subjects(what, &[], &[], Some(&folder)) {
            Ok(found) => found,
            Err(why) => return failed(terminal, &why),
        };
        for (subject, _) in found {
            if add(&mut studies, subject, &folder, terminal) != End::Fine {
                end = End::Failed;
            }
        }
    }
    compared(&studies, &folder, &args.figures, args.json, end, terminal)
}

/// Characterises a subject with the battery in a folder, and adds its study.
fn add(studies: &mut Vec<Study>, subject: Subject, folder: &Path, terminal: &Terminal) -> End {
    let label = subject.instance.label();
    match study(subject, &battery_in(folder), &crate::disk::Disk, Extent::Whole) {
        Ok(study) => {
            studies.push(study);
            End::Fine
        }
        Err(why) => failed(terminal, &format!("{label} {why}")),
    }
}

/// Writes the page of several models and prints their table. `end`: how their characterisation ended.
fn compared(
    studies: &[Study],
    folder: &Path,
    figures: &Figures,
    as_json: bool,
    end: End,
    terminal: &mut Terminal,
) -> End {
    if studies.is_empty() {
        return End::Failed;
    }
    let path = folder.join("compare.html");
    let all: Vec<&Study> = studies.iter().collect();
    let mut files = vec![
        ("compare.html".to_string(), page::comparison(studies).into_bytes()),
        ("compare.tex".to_string(), latex::tables(studies).into_bytes()),
    ];
    let drawn = figures.files(|| page::figures(&all));
    let count = if drawn.is_empty() { String::new() } else { format!(" and {} figures", drawn.len()) };
    files.extend(drawn);
    for (name, bytes) in files {
        let path = folder.join(name);
        if let Err(error) = project::write(&path, &bytes) {
            return failed(terminal, &format!("cannot write {}: {error}", path.display()));
        }
    }
    if as_json {
        for study in studies {
            terminal.line(&json(study).to_string());
        }
        return end;
    }
    terminal.print(&table(studies, terminal));
    terminal.line(&format!("  wrote {}, compare.tex{count} beside it\n", path.display()));
    end
}

fn failed(terminal: &Terminal, why: &str) -> End {
    match why.contains("\n") {
        true => terminal.report(&format!("{}\n", why.trim_end())),
        false => terminal.error(why),
    }
    End::Failed
}

fn battery_in(folder: &Path) -> String {
    folder.join("battery.fric").display().to_string()
}

/// The requested models, each with the folder for its report.
fn subjects(
    what: &str,
    models: &[String],
    set: &[(String, String)],
    out: Option<&Path>,
) -> Result<Vec<(Subject, PathBuf)>, String> {
    let path = Path::new(what);
    let is_file = what.ends_with(".fric");
    let folder = |model: &str, many: bool| match out {
        Some(out) if many => out.join(model),
        Some(out) => out.to_path_buf(),
        None => PathBuf::from("out").join(model),
    };
    let mut written: Vec<Written> = models.iter().map(|model| Written::read(model)).collect::<Result<_, _>>()?;
    if !is_file {
        if !models.is_empty() {
            return Err(format!("`{what}` is not a file: name its models after a .fric file only"));
        }
        written = vec![Written::read(what)?];
    } else if written.is_empty() {
        let text = project::read(path).map_err(|why| format!("cannot read {what}: {why}"))?;
        let loaded = compile::load(what, &text, &crate::disk::Disk);
        if loaded.has_errors() {
            return Err(report::full(&loaded.files.0, &loaded.diagnostics, false));
        }
        let fitting = loaded.models().into_iter().filter(|model| subject::looks_like_friction(model));
        written = fitting.map(|model| Written::read(&model.name.text)).collect::<Result<_, _>>()?;
        if written.is_empty() {
            return Err(format!("{what} has no friction model: one has an input `v` and an output `F`"));
        }
    }
    let many = written.len() > 1;
    let mut found = Vec::new();
    for mut written in written {
        for (path, value) in set {
            written.set(path, value)?;
        }
        let folder = folder(written.model(), many);
        found.push((fitted(written, is_file.then_some(path), &folder)?, folder));
    }
    Ok(found)
}

/// Finds a model, compiles it alone, and reads its ports.
pub(super) fn fitted(written: Written, file: Option<&Path>, folder: &Path) -> Result<Subject, String> {
    let (origin, own) = match file {
        None => (Origin::Library, String::new()),
        Some(path) => {
            let path = project::relative(path, folder);
            (Origin::File(path.clone()), format!("import \"{path}\"\n"))
        }
    };
    let name = battery_in(folder);
    // A text with its own models does not need the library's, unless an argument is one of those.
    let imports = [format!("{own}import std.bench\n"), format!("{own}import std.friction\nimport std.bench\n")];
    let imports = match file {
        None => imports[1].clone(),
        Some(_) => {
            let alone = compile::load(&name, &probe(&imports[0], &written, &[]), &crate::disk::Disk);
            let unknown = compiled(&alone, "probe").is_err_and(|found| found.contains("E0201"));
            imports[usize::from(unknown)].clone()
        }
    };
    let loaded = compile::load(&name, &imports, &crate::disk::Disk);
    if loaded.has_errors() {
        return Err(report::full(&loaded.files.0, &loaded.diagnostics, false));
    }
    let Some((_, model)) = subject::model(&loaded, written.model()) else {
        let near = loaded.visible(loaded.root(), compile::Space::Type);
        let help = match compile::nearest(written.model(), near) {
            Some(near) => format!("; did you mean `{near}`?"),
            None => String::new(),
        };
        let place = file.map_or("the library".into(), |path| path.display().to_string());
        return Err(format!("{place} has no model `{}`{help}", written.model()));
    };
    if !subject::looks_like_friction(model) {
        return Err(format!("{} is no friction model: one has an input `v` and an output `F`", written.model()));
    }
    let open: Vec<&str> =
        subject::open_inputs(model).into_iter().filter(|name| matches!(*name, "v" | "F_ext")).collect();
    let zero: Vec<(&str, &str)> = open.iter().map(|name| (*name, "0")).collect();
    let loaded = compile::load(&name, &probe(&imports, &written, &zero), &crate::disk::Disk);
    let cases = compiled(&loaded, "probe")?;
    let instance = &cases[0].instance;
    let description = instance.description();
    let (_, model) = subject::model(&loaded, written.model()).expect("it was there before");
    let rotary =
        subject::rotary(model, &written, instance).map_err(|why| format!("{} does not fit: {why}", written.model()))?;
    Ok(Subject {
        model: written.model().into(),
        origin,
        imports: format!(
            "// The standard battery for {written}, as `fric characterise` laid it out.\n\
             // Run it with `fric run`, one experiment by its name; change what you like.\n{imports}"
        ),
        doc: model.doc.clone(),
        equations: subject::equations(&loaded, model, &written),
        rotary,
        external: subject::external(model),
        held: subject::held(&loaded, model, &written),
        params: subject::params(model, instance),
        states: crate::results::states(description),
        regimes: description.automata.iter().flat_map(|automaton| automaton.regimes.clone()).collect(),
        own_regimes: description
            .automata
            .iter()
            .filter(|automaton| automaton.path.is_empty())
            .flat_map(|automaton| automaton.regimes.clone())
            .collect(),
        period: subject::period(instance),
        instance: written,
    })
}

fn probe(imports: &str, written: &Written, zero: &[(&str, &str)]) -> String {
    format!("{imports}\nexperiment probe {{ run {} for 1 s }}\n", written.with(zero))
}

fn compiled(loaded: &Loaded, name: &str) -> Result<Vec<compile::Case>, String> {
    let mut loaded = loaded.clone();
    if loaded.has_errors() {
        return Err(report::full(&loaded.files.0, &loaded.diagnostics, false));
    }
    let options = Options { changes: Changes::default(), interpret: true };
    compile::compile(&mut loaded, &crate::disk::Disk, name, &options, &mut Vec::new(), &mut |_| ())
        .map_err(|found| report::full(&loaded.files.0, &found, false))
}

/// Writes the report, the battery, a table for each graph and the requested figures; returns how many of the last two.
fn write(study: &Study, folder: &Path, figures: &Figures) -> Result<String, String> {
    let mut files: Vec<(String, Vec<u8>)> = vec![
        ("report.html".into(), page::report(study).into_bytes()),
        ("battery.fric".into(), study.battery.clone().into_bytes()),
        ("report.tex".into(), latex::tables(std::slice::from_ref(study)).into_bytes()),
    ];
    let others = files.len();
    for graph in study.tests.iter().filter_map(|test| test.result.as_ref().ok()).flatten() {
        let unit = |unit: &str| if unit.is_empty() { String::new() } else { format!(" [{unit}]") };
        let mut table = format!("curve,{}{},{}{}\n", graph.x.0, unit(&graph.x.1), graph.y.0, unit(&graph.y.1));
        for line in &graph.lines {
            for (x, y) in &line.points {
                table += &format!("\"{}\",{x},{y}\n", line.name.replace('"', "'"));
            }
        }
        files.push((format!("{}.csv", graph.key), table.into_bytes()));
    }
    let tables = files.len() - others;
    let figures = figures.files(|| page::figures(&[study]));
    let count = match figures.len() {
        0 => format!("{tables} tables"),
        figures => format!("{tables} tables and {figures} figures"),
    };
    files.extend(figures);
    for (name, bytes) in files {
        let path = folder.join(name);
        project::write(&path, &bytes).map_err(|error| format!("cannot write {}: {error}", path.display()))?;
    }
    Ok(count)
}

/// Prints the summary of one model.
fn tell(study: &Study, terminal: &mut Terminal) {
    terminal.line(&terminal.styled(Style::Bold, &study.label));
    let scales = &study.scales;
    terminal.line(&format!(
        "  lets go at {} after {}, slides with {}",
        shown(scales.f_b, study.units.force),
        shown(scales.travel, study.units.length),
        shown(scales.f_c, study.units.force)
    ));
    let width = study.findings.iter().map(|finding| finding.name.chars().count()).max().unwrap_or(0);
    for finding in &study.findings {
        terminal.line(&format!("  {} {:width$}  {}", mark(finding.seen, terminal), finding.name, finding.why));
    }
    for test in &study.tests {
        if let Err(why) = &test.result {
            terminal.line(&format!("  {}: not available: {}", test.title, why.lines().next().unwrap_or_default()));
        }
    }
    for note in &study.notes {
        terminal.line(&format!("  note: {note}"));
    }
}

fn mark(seen: Seen, terminal: &Terminal) -> String {
    match seen {
        Seen::Shown => terminal.styled(Style::Good, "✓"),
        Seen::NotShown => terminal.styled(Style::Bad, "✗"),
        Seen::NotApplicable => "–".into(),
        Seen::NotRun => "?".into(),
    }
}

/// The phenomena of several models, a column each.
fn table(studies: &[Study], terminal: &Terminal) -> String {
    let Some(first) = studies.first() else { return String::new() };
    let width = first.findings.iter().map(|finding| finding.name.chars().count()).max().unwrap_or(0);
    let mut out = format!("  {:width$}", "");
    for (i, study) in studies.iter().enumerate() {
        out += &format!("  {}", terminal.styled(Style::Bold, &format!("{} {}", i + 1, study.label)));
    }
    out.push('\n');
    for (row, finding) in first.findings.iter().enumerate() {
        out += &format!("  {:width$}", finding.name);
        for study in studies {
            let wide = study.label.chars().count() + 2;
            out += &format!("  {}{:2$}", mark(study.findings[row].seen, terminal), "", wide - 1);
        }
        out = out.trim_end().to_string() + "\n";
    }
    out
}

/// The output of `--json`.
fn json(study: &Study) -> Value {
    let number = |value: f64| serde_json::Number::from_f64(value).map_or(Value::Null, Value::Number);
    let tests = study.tests.iter().map(|test| {
        let numbers: Vec<Value> = test
            .numbers
            .iter()
            .map(|n| json!({ "key": n.key, "name": n.name, "value": number(n.value), "unit": n.unit }))
            .collect();
        json!({
            "key": test.key,
            "reason": test.result.as_ref().err(),
            "numbers": numbers,
        })
    });
    let findings = study.findings.iter().map(
        |finding| json!({ "key": finding.key, "name": finding.name, "seen": finding.seen.key(), "why": finding.why }),
    );
    json!({
        "model": study.subject.model,
        "instance": study.subject.instance.to_string(),
        "version": env!("CARGO_PKG_VERSION"),
        "rotary": study.subject.rotary,
        "scales": {
            "break_away_force": number(study.scales.f_b),
            "break_away_travel": number(study.scales.travel),
            "sliding_force": number(study.scales.f_c),
            "stribeck_speed": number(study.scales.v_s),
            "mass": number(study.scales.mass),
        },
        "phenomena": findings.collect::<Vec<_>>(),
        "tests": tests.collect::<Vec<_>>(),
        "notes": study.notes,
    })
}
