//! Generates the battery, runs it, and extracts the behaviour of the model from the curves.
//!
//! In: a [`Subject`]. Out: a [`Study`]. Scales are measured first: the force of fast sliding, then break-away and
//! presliding displacement, then the steady curve; the remaining experiments are sized with them.

use super::battery::{self, Entry, Layout, Scales, Units, n};
use super::bench::{self, Endless, Ran, Results};
use super::measured::{Graph, Line, Number, Test, prefixed, shown};
use super::phenomena::{self, Finding};
use super::subject::{External, Subject};
use crate::compile::{self, Sources, Verdict};
use crate::plot::{Axis, Band, Curve, Figure, Panel};
use abi::unit::Unit;
use runtime::engine::Cause;

/// The results for a model.
#[derive(Clone, Debug)]
pub struct Study {
    /// The model.
    pub subject: Subject,
    /// Short name for legends.
    pub label: String,
    /// Units of the model.
    pub units: Units,
    /// The battery that was run.
    pub battery: String,
    /// Scales, SI.
    pub scales: Scales,
    /// Mass on the benches, SI.
    pub mass: f64,
    /// The bench that it shares with the other members of a family, in words.
    pub bench: Option<String>,
    /// In the order of the report.
    pub tests: Vec<Test>,
    /// The phenomena that it shows.
    pub findings: Vec<Finding>,
    /// General remarks, such as that it chatters.
    pub notes: Vec<String>,
}

/// How much of the battery is run.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Extent {
    /// All of it.
    Whole,
    /// The steady curve and the presliding loops: for a page on many models.
    Sketch,
}

/// A graph as a figure: the curves of several models, each with its number, or all curves of one. A model has the same
/// colour in every figure.
pub fn figure(graphs: &[(usize, &str, &Graph)], among: usize) -> Figure {
    let Some((_, _, first)) = graphs.first() else { return Figure::default() };
    let alone = graphs.len() == 1;
    let shown = |line: &&Line| alone || line.main;
    let lines = || {
        graphs.iter().flat_map(|(number, name, graph)| {
            let shown = graph.lines.iter().filter(shown).enumerate();
            shown.map(move |(k, line)| (*name, (*number, k), line))
        })
    };
    let size = |of: fn(&(f64, f64)) -> f64| {
        let values = lines().flat_map(|(_, _, line)| line.points.iter().map(of));
        values.filter(|value| value.is_finite()).fold(0.0, |size: f64, value| size.max(value.abs()))
    };
    let (x_unit, x_scale) = prefixed(&first.x.1, size(|point| point.0));
    let (y_unit, y_scale) = prefixed(&first.y.1, size(|point| point.1));
    // A change in the fifth digit does not fill an axis.
    let (low, high) = lines()
        .flat_map(|(_, _, line)| &line.points)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |ends, point| (ends.0.min(point.1), ends.1.max(point.1)));
    let level = !first.logarithmic.1 && high - low < 1e-4 * high.abs().max(low.abs());
    let drawn = |y: f64| if level { 0.5 * (low + high) } else { y };
    let curves = lines().map(|(model, style, line)| Curve {
        name: match (alone, graphs.iter().map(|(_, _, graph)| graph.lines.iter().filter(shown).count()).max() > Some(1))
        {
            (true, _) if among == 1 => line.name.clone(),
            // In a comparison with one curve, use the name of the model.
            (true, _) => format!("{model}{}{}", if line.name.is_empty() { "" } else { ", " }, line.name),
            (false, true) => format!("{model}, {}", line.name),
            (false, false) => model.into(),
        },
        points: line.points.iter().map(|(x, y)| (x / x_scale, drawn(*y) / y_scale)).collect(),
        boolean: false,
        marks: line.marks,
        recorded: false,
        style: (among > 1).then_some(style),
    });
    let axis = |(name, _): &(String, String), unit: Unit, logarithmic| Axis {
        name: name.clone(),
        unit: unit.text,
        logarithmic,
        range: None,
    };
    let panel = Panel {
        x: axis(&first.x, x_unit, first.logarithmic.0),
        y: axis(&first.y, y_unit, first.logarithmic.1),
        curves: curves.collect(),
        // Shades of several models would overlap.
        bands: if alone { first.bands.clone() } else { Vec::new() },
        ..Panel::default()
    };
    Figure { title: String::new(), subtitle: String::new(), panels: vec![panel] }
}

/// The figure of one graph of a study, if it exists.
pub fn drawn(study: &Study, key: &str) -> Option<Figure> {
    let graphs = study.tests.iter().filter_map(|test| test.result.as_ref().ok()).flatten();
    // A force that jumps at every step makes no useful picture.
    let graph = graphs.into_iter().find(|graph| graph.key == key && graph.alone.as_deref() != Some(JUMPS))?;
    // Without motion there is no curve.
    let moved = graph.lines.iter().any(|line| line.points.iter().any(|point| point.0.abs() > 1e-12));
    moved.then(|| figure(&[(0, &study.label, graph)], 1))
}

/// Characterises a model, on benches that are laid out for it.
///
/// # Errors
/// Why nothing can be measured, as a message or a report.
pub fn study(subject: Subject, name: &str, sources: &(dyn Sources + Sync), extent: Extent) -> Result<Study, String> {
    Scaled::new(subject, name, sources)?.study(None, extent)
}

/// Characterises several members of a family on the same benches. `members`: each with the name of its battery. Returns
/// the studies, and for each member without one the reason, as a message or a report.
pub fn family(members: Vec<(Subject, String)>, sources: &(dyn Sources + Sync)) -> (Vec<Study>, Vec<String>) {
    let (mut scaled, mut failures): (Vec<Scaled>, Vec<String>) = (Vec::new(), Vec::new());
    for (subject, name) in members {
        let label = subject.instance.label();
        match Scaled::new(subject, &name, sources) {
            Ok(member) => scaled.push(member),
            Err(why) => failures.push(format!("{label} {why}")),
        }
    }
    let scales: Vec<Scales> = scaled.iter().map(|member| member.scales.clone()).collect();
    let scales: Vec<&Scales> = scales.iter().collect();
    let bench = battery::family(&scales).zip(scaled.first()).map(|(bench, first)| {
        let layout = Layout::new(&first.runner.subject, bench.clone());
        Scales { v_slip: battery::sliding_speed(&scales, &layout), ..bench }
    });
    let mut studies = Vec::new();
    for member in scaled {
        let label = member.runner.subject.instance.label();
        match member.study(bench.as_ref(), Extent::Whole) {
            Ok(study) => studies.push(study),
            Err(why) => failures.push(format!("{label} {why}")),
        }
    }
    (studies, failures)
}

/// A model whose scales have been measured.
struct Scaled<'a> {
    runner: Runner<'a>,
    scales: Scales,
    steady: Steady,
}

impl<'a> Scaled<'a> {
    fn new(subject: Subject, name: &str, sources: &'a (dyn Sources + Sync)) -> Result<Scaled<'a>, String> {
        let rotary = subject.rotary;
        // Rotary twins of translational models keep their numbers; models written for shafts run faster.
        let v_max = if rotary && !subject.instance.is_rotary() { 10.0 } else { 1.0 };
        let mut runner = Runner {
            subject,
            name: name.into(),
            sources,
            entries: Vec::new(),
            results: Results::new(),
            chatter: None,
            slow: false,
        };
        let mut scales = Scales {
            f_ref: 0.0,
            mass: 1.0,
            f_b: 0.0,
            x_b: 0.0,
            travel: 0.0,
            f_c: 0.0,
            v_s: 0.01 * v_max,
            stiffness: f64::INFINITY,
            v_slip: 0.01 * v_max,
            v_max,
        };

        runner.run(&scales, None, |layout| vec![layout.scale_sliding()])?;
        let sliding = runner.one("scale_sliding")?.rows().map_err(|why| format!("does not slide steadily: {why}"))?;
        scales.f_ref = sliding.last().map_or(0.0, |row| row[1].abs());
        if scales.f_ref.is_nan() || scales.f_ref <= 0.0 {
            return Err("gives no force when it slides, so there is nothing to characterise".into());
        }
        scales.mass = battery::power_near(scales.f_ref);

        for times in [1.0, 10.0] {
            runner.run(&scales, None, |layout| vec![layout.scale_break_away(times)])?;
            let rows = runner.one("scale_break_away")?.rows().map_err(|why| format!("cannot be pushed: {why}"))?;
            if let Some((force, travel)) = break_away(&rows, scales.v_slip) {
                (scales.f_b, scales.x_b) = (force, travel.abs());
                scales.travel = travel_to(&rows, 0.99 * force).map_or(scales.x_b, f64::abs);
                scales.stiffness = early_stiffness(&rows, force).unwrap_or(f64::INFINITY);
                break;
            }
            runner.entries.retain(|entry| entry.name != "scale_break_away");
        }
        if scales.f_b <= 0.0 {
            return Err(format!("does not let go under {} times the force it slides with", 60));
        }

        runner.run(&scales, None, |layout| layout.steady())?;
        let steady = Steady::of(&runner.results)?;
        (scales.f_c, scales.v_s) = (steady.f_c, steady.v_s.unwrap_or(scales.v_s / 10.0));
        let layout = Layout::new(&runner.subject, scales.clone());
        scales.v_slip = battery::sliding_speed(&[&scales], &layout);
        Ok(Scaled { runner, scales, steady })
    }

    /// Runs the battery: on benches of these scales, or of its own.
    fn study(self, bench: Option<&Scales>, extent: Extent) -> Result<Study, String> {
        let Scaled { mut runner, mut scales, steady } = self;
        let units = Units::of(runner.subject.rotary);
        if let Some(bench) = bench {
            scales.v_slip = bench.v_slip;
        }
        runner.run(&scales, bench, |layout| {
            let wanted = |entry: &Entry| extent == Extent::Whole || entry.name.starts_with("presliding");
            layout.rest().into_iter().filter(wanted).collect()
        })?;
        let layout = on(Layout::new(&runner.subject, scales.clone()), bench);
        let text = battery::text(&runner.subject.imports, &layout.head(), &runner.entries);
        let dissipation = runner.dissipation(&text);
        let (chatter, slow) = (runner.chatter.clone(), runner.slow);
        let reader = StudyReader {
            results: &runner.results,
            layout: &layout,
            units,
            scales: &scales,
            steady: &steady,
            chatters: chatter.is_some(),
            reference: runner.entries.iter().find(|entry| entry.name == "steps_reference").and_then(Entry::step),
        };
        let tests = reader.tests(dissipation.as_ref());
        let subject = &runner.subject;
        // The step-size sweep has fixed steps on purpose.
        let stepped = runner.entries.iter().filter(|entry| !entry.adaptive() && !entry.name.starts_with("steps_"));
        let stepped: Vec<String> = stepped.map(|entry| entry.name.clone()).collect();
        let findings = phenomena::findings(subject, &scales, &tests, dissipation, &stepped, chatter.as_deref());
        let mut notes = Vec::new();
        if !subject.held.is_empty() {
            let one = |(name, value): &(String, String)| format!("{name} = {value}");
            let held: Vec<String> = subject.held.iter().map(one).collect();
            notes.push(format!(
                "Beside v, these inputs were held: {}. `--over '{} = …, …'` draws a family over one of them.",
                held.join(", "),
                subject.held[0].0
            ));
        }
        if slow {
            notes.push(
                "Some adaptive runs took too many steps, and were run with a fixed step: what happens within one is not seen."
                    .to_string(),
            );
        }
        if let Some(chatter) = chatter {
            let made_to_hold = match subject.states {
                0 => format!(" `Sticking(law = {})` is the same law made to hold.", subject.instance),
                _ => String::new(),
            };
            notes.push(format!(
                "At rest it chatters: {chatter} to and fro without end. What comes to rest was therefore run with a fixed \
                 step; there the force jumps to and fro at every step, and what it carries is an average.{made_to_hold}"
            ));
        }
        if subject.external == External::Absent && subject.states == 0 && subject.regimes.is_empty() {
            notes.push("A static map of the velocity: it has no memory, and no port F_ext to hold a load with.".into());
        }
        let bench = bench.map(|_| {
            let pulls = layout.pull_speeds();
            format!(
                "one bench for all: mass {} {}, spring {} {}, pull speeds {} to {}, force rates {} to {}; laid out for a \
                 break-away force of {}, the middle of the family in ratio",
                n(layout.bench().mass),
                units.mass,
                n(2.0 * layout.bench().mass),
                units.stiffness,
                shown(pulls[0], units.speed),
                shown(pulls[pulls.len() - 1], units.speed),
                n(layout.rates()[0]),
                format_args!("{} {}", n(layout.rates()[layout.rates().len() - 1]), units.rate),
                shown(layout.bench().f_b, units.force),
            )
        });
        let mass = layout.bench().mass;
        let label = subject.instance.label();
        Ok(Study { label, units, battery: text, scales, mass, bench, tests, findings, notes, subject: runner.subject })
    }
}

/// A layout on the bench that it shares with others, if any.
fn on<'a>(layout: Layout<'a>, bench: Option<&Scales>) -> Layout<'a> {
    match bench {
        Some(bench) => layout.on(bench.clone()),
        None => layout,
    }
}

/// Collects the experiments and their results.
struct Runner<'a> {
    subject: Subject,
    name: String,
    sources: &'a (dyn Sources + Sync),
    entries: Vec<Entry>,
    results: Results,
    chatter: Option<String>,
    /// Whether some adaptive runs took too many steps.
    slow: bool,
}

impl Runner<'_> {
    fn run(
        &mut self,
        scales: &Scales,
        bench: Option<&Scales>,
        entries: impl Fn(&Layout) -> Vec<Entry>,
    ) -> Result<(), String> {
        let layout = on(Layout::new(&self.subject, scales.clone()), bench);
        let first = self.entries.len();
        self.entries.extend(entries(&layout));
        // An experiment that was slow once will be slow again.
        let (slow, period) = (self.slow, self.subject.period);
        let again = self.entries[first..].iter_mut().filter(|entry| slow && entry.adaptive());
        again.for_each(|entry| entry.step_fixed(period));
        let mut names: Vec<String> = self.entries[first..].iter().map(|entry| entry.name.clone()).collect();
        for _ in 0..2 {
            let text = battery::text(&self.subject.imports, &layout.head(), &self.entries);
            let loaded = bench::load(&self.name, &text, self.sources)?;
            let results = bench::run(&loaded, &names, self.sources);
            names = results
                .iter()
                .filter(|(_, result)| bench::endless(result).is_some())
                .map(|(name, _)| name.clone())
                .collect();
            self.results.extend(results);
            for entry in self.entries.iter_mut().filter(|entry| names.contains(&entry.name) && entry.adaptive()) {
                let result = &self.results[&entry.name];
                if bench::endless(result) == Some(Endless::Slow) {
                    self.slow = true;
                } else if let (None, Ok(cases)) = (&self.chatter, result) {
                    self.chatter = cases.iter().find_map(|ran| match &ran.result.as_ref().err()?.cause {
                        Cause::Chatter(chatter) => Some(what_turns(&chatter.conditions)),
                        _ => None,
                    });
                }
                entry.step_fixed(period);
            }
            if names.is_empty() {
                break;
            }
        }
        Ok(())
    }

    fn one(&self, name: &str) -> Result<&Ran, String> {
        one(&self.results, name)
    }

    fn dissipation(&self, text: &str) -> Option<Verdict> {
        let loaded = bench::load(&self.name, text, self.sources).ok()?;
        let written = self.subject.instance.to_string();
        let (instance, _) = grammar::parse::parse_instance(loaded.root(), &written);
        compile::dissipation(&loaded, self.sources, &instance?, loaded.root())
    }
}

/// A clause that names the switching conditions: ``"`abs(v)` and `sign(v)` turn"``.
fn what_turns(conditions: &[String]) -> String {
    let conditions: Vec<String> = conditions.iter().map(|text| format!("`{text}`")).collect();
    match &conditions[..] {
        [] => "its regimes turn".into(),
        [one] => format!("{one} turns"),
        several => format!("{} turn", several.join(" and ")),
    }
}

fn one<'a>(results: &'a Results, name: &str) -> Result<&'a Ran, String> {
    match results.get(name) {
        Some(Ok(cases)) => cases.first().ok_or_else(|| format!("{name} has no case")),
        Some(Err(report)) => Err(report.clone()),
        None => Err(format!("{name} was not run")),
    }
}

/// Largest force before the speed first reaches `v_slip`, and the displacement there. Rows hold t, F, x, v.
fn break_away(rows: &[Vec<f64>], v_slip: f64) -> Option<(f64, f64)> {
    let end = rows.iter().position(|row| row[3].abs() >= v_slip)?;
    let best = rows[..=end].iter().max_by(|a, b| a[1].total_cmp(&b[1]))?;
    Some((best[1], best[2]))
}

/// Displacement at which the force first reaches a value. Rows hold t, F, x, v.
fn travel_to(rows: &[Vec<f64>], force: f64) -> Option<f64> {
    let at = rows.iter().position(|row| row[1] >= force)?;
    let Some(before) = at.checked_sub(1).map(|before| &rows[before]) else { return Some(rows[at][2]) };
    let part = (force - before[1]) / (rows[at][1] - before[1]);
    Some(before[2] + part.clamp(0.0, 1.0) * (rows[at][2] - before[2]))
}

/// Force per displacement at a tenth of the break-away force. Rows hold t, F, x, v.
fn early_stiffness(rows: &[Vec<f64>], f_b: f64) -> Option<f64> {
    let early = rows.iter().find(|row| row[1] >= 0.1 * f_b)?;
    let stiffness = early[1] / early[2];
    (stiffness.is_finite() && stiffness > 0.0).then_some(stiffness)
}

/// The force at the end of a constant-speed run; if it is still changing, its mean over the last half, and the amount
/// of change.
fn settled(rows: &[Vec<f64>]) -> (f64, f64) {
    let Some(last) = rows.last() else { return (f64::NAN, 0.0) };
    let half = rows.partition_point(|row| row[0] < 0.5 * last[0]);
    let course = &rows[half.min(rows.len() - 1)..];
    let spread = peak_to_peak(course, 1);
    if spread <= 0.01 * last[1].abs() || course.len() < 3 {
        return (last[1], 0.0);
    }
    let area: f64 = course.windows(2).map(|pair| 0.5 * (pair[0][1] + pair[1][1]) * (pair[1][0] - pair[0][0])).sum();
    (area / (last[0] - course[0][0]), spread)
}

/// The steady curve.
struct Steady {
    /// Speed and force, ascending in speed, for both directions.
    forward: Vec<(f64, f64)>,
    backward: Vec<(f64, f64)>,
    f_c: f64,
    v_s: Option<f64>,
    /// Speed and height of the peak, and for how many points of the grid the force falls after it.
    peak: (f64, f64),
    falls: usize,
    viscous: f64,
    asymmetry: f64,
    failures: Vec<String>,
}

impl Steady {
    fn of(results: &Results) -> Result<Steady, String> {
        let (mut forward, mut backward, mut failures) = (Vec::new(), Vec::new(), Vec::new());
        let mut noise: f64 = 0.0;
        for (name, cases) in results.iter().filter(|(name, _)| name.starts_with("steady_")) {
            let cases = cases.as_ref().map_err(|why| why.clone())?;
            for ran in cases {
                let speed = ran.label.split_once('=').and_then(|(_, value)| crate::quantity::parse(value).ok());
                let Some((speed, _)) = speed else { continue };
                match ran.rows() {
                    Ok(rows) => {
                        let (force, spread) = settled(&rows);
                        noise = noise.max(0.5 * spread);
                        if speed > 0.0 { forward.push((speed, force)) } else { backward.push((speed, force)) }
                    }
                    Err(why) => failures.push(format!("{name}, {}: {why}", ran.label)),
                }
            }
        }
        forward.sort_by(|a, b| a.0.total_cmp(&b.0));
        backward.sort_by(|a, b| b.0.total_cmp(&a.0));
        let [.., before, last] = forward[..] else {
            return Err(failures.into_iter().next().unwrap_or_else(|| "it has no steady curve".into()));
        };
        let viscous = (last.1 - before.1) / (last.0 - before.0);
        // The first speed at which the force begins to fall, and where it stops falling.
        let top = (0..forward.len() - 1).find(|i| forward[i + 1].1 < forward[*i].1 * (1.0 - 5e-4));
        let (mut falls, mut v_s, mut peak) = (0, None, forward[0]);
        let intercept = last.1 - viscous * last.0;
        let mut f_c = if intercept > 0.0 { intercept.min(last.1) } else { 0.0 };
        if let Some(top) = top {
            peak = forward[top];
            let foot =
                (top..forward.len() - 1).find(|i| forward[i + 1].1 >= forward[*i].1).unwrap_or(forward.len() - 1);
            falls = foot - top;
            f_c = forward[foot].1;
            let level = f_c + (peak.1 - f_c) / std::f64::consts::E;
            let below = (top..=foot).find(|i| forward[*i].1 <= level).unwrap_or(foot);
            let (a, b) = (forward[below - 1], forward[below]);
            // A jump, or the noise of a force that never settles, defines no Stribeck speed.
            v_s = (falls >= 3 && peak.1 - f_c > noise)
                .then_some(a.0 + (b.0 - a.0) * ((a.1 - level) / (a.1 - b.1)).clamp(0.0, 1.0));
        }
        let asymmetry = forward.iter().zip(&backward).map(|(a, b)| (a.1 + b.1).abs()).fold(0.0, f64::max);
        Ok(Steady { forward, backward, f_c, v_s, peak, falls, viscous, asymmetry, failures })
    }
}

/// Extracts tests from results.
struct StudyReader<'a> {
    results: &'a Results,
    layout: &'a Layout<'a>,
    units: Units,
    scales: &'a Scales,
    steady: &'a Steady,
    /// Whether the force jumps back and forth at rest.
    chatters: bool,
    /// The step in s of the reference of the step-size sweep, if it could not run adaptively.
    reference: Option<f64>,
}

/// Why a curve of a model that chatters is not drawn together with others.
const JUMPS: &str = "at rest its force jumps to and fro";

type Read = Result<(Vec<Graph>, Vec<Number>), String>;

impl StudyReader<'_> {
    fn tests(&self, dissipation: Option<&Verdict>) -> Vec<Test> {
        let s = self.scales;
        let test = |key, title, how: String, read: Read| {
            let (result, numbers) = match read {
                Ok((graphs, numbers)) => (Ok(graphs), numbers),
                Err(why) => (Err(why), Vec::new()),
            };
            Test { key, title, how, result, numbers }
        };
        let speed = |v: f64| shown(v, self.units.speed);
        let force = |f: f64| shown(f, self.units.force);
        vec![
            test(
                "steady",
                "Steady friction against velocity",
                format!(
                    "Moved at constant speed until the force had settled; {} speeds in each direction.",
                    self.steady.forward.len()
                ),
                self.read_steady(),
            ),
            test(
                "break_away",
                "Break-away against force rate",
                format!(
                    "A mass of {} {} pushed by a growing force; the largest friction before the speed first reaches {}.",
                    n(self.layout.bench().mass),
                    self.units.mass,
                    speed(s.v_slip)
                ),
                self.read_break_away(),
            ),
            test(
                "presliding",
                "Presliding hysteresis",
                format!(
                    "A slow force to 30 % and 95 % of the break-away force ({}) and back; the second loop is measured, then \
                     an inner one.",
                    force(s.f_b)
                ),
                self.read_presliding(),
            ),
            test(
                "lag",
                "Frictional lag",
                format!(
                    "Speed {} · (1.5 + sin ωt), which keeps its sign; the last cycle of each.",
                    speed(self.layout.bench().v_s)
                ),
                self.read_lag(),
            ),
            test(
                "reversal",
                "Start and reversal",
                format!("At {} from rest, and then back.", speed(self.layout.cycle_speed())),
                self.read_reversal(),
            ),
            test(
                "stick_slip",
                "Stick-slip on a spring",
                format!(
                    "A mass of {} {} pulled through a spring of {} {} without damping.",
                    n(self.layout.bench().mass),
                    self.units.mass,
                    n(2.0 * self.layout.bench().mass),
                    self.units.stiffness
                ),
                self.read_stick_slip(),
            ),
            test("coast_down", "Coast-down", "A mass thrown and left alone.".into(), self.read_coast_down()),
            test(
                "hold",
                "Holding a load",
                "Half of the sliding force, applied within 2 s and held for 100 s, on a lightly damped mass.".into(),
                self.read_hold(),
            ),
            test(
                "drift",
                "Drift under a small oscillation",
                "A load of 0.6 times the sliding force, applied within 2 s and then shaken by 0.3 times it at 1 Hz, on a \
                 lightly damped mass; the trend over 20 cycles."
                    .into(),
                self.read_drift(),
            ),
            test(
                "energy",
                "Energy per cycle",
                "Sinusoidal cycles of growing amplitude at one greatest speed; the loss of a cycle after the contact has \
                 forgotten its start."
                    .into(),
                self.read_energy(),
            ),
            test(
                "rate",
                "Rate independence",
                format!(
                    "The same path at 0.1, 1 and 10 times {}; a rate-independent model draws one curve.",
                    speed(self.layout.cycle_speed())
                ),
                self.read_rate(),
            ),
            test(
                "dissipation",
                "Dissipation",
                "Irregular motions on closed paths, and a search for a point at which power is given out.".into(),
                self.read_dissipation(dissipation),
            ),
            test(
                "steps",
                "Step size",
                format!(
                    "The spring again with fixed steps (expo): error of the position at the end against {}.",
                    match self.reference {
                        Some(step) => format!("a run with steps of {}", shown(step, "s")),
                        None => "the adaptive run".into(),
                    }
                ),
                self.read_steps(),
            ),
        ]
    }

    fn number(&self, key: &'static str, name: impl Into<String>, value: f64, unit: &str) -> Number {
        // Work and power have the magnitude of the force at the speeds and paths of the battery.
        let of_force = ["N", "N·m", "J", "W"].contains(&unit) || unit == self.units.damping;
        let nothing = if of_force { 1e-8 * self.scales.f_ref } else { 0.0 };
        let nothing = if ["J", "W"].contains(&unit) { 1e-6 * nothing } else { nothing };
        Number { key, name: name.into(), value, unit: unit.into(), nothing }
    }

    fn rows(&self, name: &str) -> Result<Vec<Vec<f64>>, String> {
        one(self.results, name)?.rows()
    }

    /// The regime of the model over time; rows hold t, F, x, v, and then its regimes.
    fn regimes(&self, rows: &[Vec<f64>]) -> Vec<Band> {
        let band = |(k, name): (usize, &String)| {
            let course: Vec<(f64, f64)> = rows.iter().map(|row| (row[0], row[4 + k])).collect();
            Band::of(name, &course)
        };
        self.layout.own_regimes().iter().enumerate().map(band).collect()
    }

    fn axis(&self, name: &str, unit: &str) -> (String, String) {
        (name.into(), unit.into())
    }

    fn read_steady(&self) -> Read {
        let steady = self.steady;
        let mirrored = steady.backward.iter().map(|(v, f)| (-v, -f)).collect();
        let graph = Graph {
            key: "steady",
            bands: Vec::new(),
            alone: None,
            x: self.axis("|v|", self.units.speed),
            y: self.axis("|F|", self.units.force),
            logarithmic: (true, false),
            lines: vec![Line::course("forward", steady.forward.clone()), Line::course("backward", mirrored).aside()],
        };
        let mut numbers = vec![
            self.number("sliding_force", "least sliding force F_c", steady.f_c, self.units.force),
            self.number("steady_peak", "greatest force of slow sliding", steady.peak.1, self.units.force),
        ];
        if let Some(v_s) = steady.v_s {
            numbers.push(self.number("stribeck_speed", "speed at which the excess is 1/e", v_s, self.units.speed));
        }
        numbers.push(self.number("stribeck_points", "points of the grid over which it falls", steady.falls as f64, ""));
        numbers.push(self.number("viscous_slope", "viscous slope", steady.viscous, self.units.damping));
        numbers.push(self.number(
            "asymmetry",
            "greatest difference of the directions",
            steady.asymmetry,
            self.units.force,
        ));
        if !steady.failures.is_empty() {
            numbers.push(self.number("failures", "speeds at which it failed", steady.failures.len() as f64, ""));
        }
        Ok((vec![graph], numbers))
    }

    fn read_break_away(&self) -> Read {
        let mut points = Vec::new();
        let mut lines = Vec::new();
        let rates = self.layout.rates();
        for (i, rate) in rates.iter().enumerate() {
            let rows = self.rows(&format!("break_away_{}", i + 1))?;
            let Some((force, _)) = break_away(&rows, self.scales.v_slip) else { continue };
            points.push((*rate, force));
            if [3, 6, 9].contains(&i) {
                let course = rows.iter().filter(|row| row[3].abs() <= self.scales.v_slip).map(|row| (row[2], row[1]));
                lines.push(Line::course(format!("{} {}", n(*rate), self.units.rate), course.collect()).aside());
            }
        }
        if points.is_empty() {
            return Err("never let go at any rate".into());
        }
        if let Some(line) = lines.first_mut() {
            line.main = true;
        }
        let graphs = vec![
            Graph {
                key: "break_away",
                bands: Vec::new(),
                alone: None,
                x: self.axis("force rate", self.units.rate),
                y: self.axis("break-away force", self.units.force),
                logarithmic: (true, false),
                lines: vec![Line::marked("", points.clone())],
            },
            Graph {
                key: "break_away_travel",
                bands: Vec::new(),
                alone: self.chatters.then(|| JUMPS.into()),
                x: self.axis("x", self.units.length),
                y: self.axis("F", self.units.force),
                logarithmic: (false, false),
                lines,
            },
        ];
        let forces = points.iter().map(|point| point.1);
        let (low, high) = forces.fold((f64::INFINITY, 0.0_f64), |(low, high), f| (low.min(f), high.max(f)));
        let mut numbers: Vec<Number> = points
            .iter()
            .map(|(rate, force)| {
                self.number(
                    "break_away_force",
                    format!("at {} {}", n(*rate), self.units.rate),
                    *force,
                    self.units.force,
                )
            })
            .collect();
        numbers.push(self.number("break_away_change", "fall from the greatest to the least", (high - low) / high, ""));
        numbers.push(self.number("break_away_travel", "travel at break-away", self.scales.travel, self.units.length));
        Ok((graphs, numbers))
    }

    fn read_presliding(&self) -> Read {
        let (small, large) = (self.rows("presliding_small")?, self.rows("presliding_large")?);
        let course = |rows: &[Vec<f64>]| rows.iter().map(|row| (row[2], row[1])).collect::<Vec<_>>();
        let creeps = one(self.results, "hold").is_ok_and(|ran| ran.reading(0).is_some_and(|moved| moved > 1e-9));
        let graph = Graph {
            key: "presliding",
            bands: Vec::new(),
            alone: match (self.chatters, creeps) {
                (true, _) => Some(JUMPS.into()),
                (false, true) => Some("it creeps, so that its travel is no presliding".into()),
                (false, false) => None,
            },
            x: self.axis("x", self.units.length),
            y: self.axis("F", self.units.force),
            logarithmic: (false, false),
            lines: vec![Line::course("to 95 %", course(&large)), Line::course("to 30 %", course(&small)).aside()],
        };
        let small_travel = peak_to_peak(&between(&small, self.layout.presliding(0.3).loop_times()), 2);
        let path = self.layout.presliding(0.95);
        let large_loop = ClosedLoop::of(&large, path.loop_times(), one(self.results, "presliding_large")?.reading(0));
        let [left, turned, back] = path.inner_times().map(|t| value_at(&large, t, 2));
        let inner = (left - turned).abs();
        let mut numbers = vec![
            self.number("presliding_travel", "travel within ±30 %", small_travel, self.units.length),
            self.number("presliding_travel_large", "travel within ±95 %", large_loop.travel, self.units.length),
        ];
        if let Some(stiffness) = early_stiffness(&small, self.scales.f_b)
            && small_travel > 0.0
        {
            numbers.push(self.number("stiffness", "stiffness at 10 %", stiffness, self.units.stiffness));
        }
        numbers.push(self.number("loop_loss", "loss of a large loop", large_loop.area, "J"));
        numbers.push(self.number("loop_area", "area of the large loop over its box", large_loop.part(), ""));
        numbers.push(self.number(
            "loop_gap",
            "the large loop moves on by, of its travel",
            large_loop.gap.abs() / large_loop.travel.max(1e-300),
            "",
        ));
        if inner > 0.0 {
            numbers.push(self.number(
                "memory_error",
                "inner loop misses its start by, of its width",
                (back - left).abs() / inner,
                "",
            ));
        }
        Ok((vec![graph], numbers))
    }

    fn read_lag(&self) -> Read {
        let mut lines = Vec::new();
        let mut widths = Vec::new();
        let mut numbers = Vec::new();
        for (i, f) in self.layout.lag_frequencies().into_iter().enumerate() {
            let rows = self.rows(&format!("lag_{}", i + 1))?;
            let end = rows.last().map_or(0.0, |row| row[0]);
            let last = between(&rows, (end - 1.0 / f, end));
            let last: Vec<(f64, f64)> = last.iter().map(|row| (row[2], row[1])).collect();
            let width = lag(&last);
            widths.push((f, width.abs()));
            numbers.push(self.number(
                "lag",
                format!("F rising minus F falling at {} Hz, greatest", n(f)),
                width,
                self.units.force,
            ));
            let line = Line::course(format!("{} Hz", n(f)), last);
            lines.push(if i == 1 { line } else { line.aside() });
        }
        let graph = Graph {
            key: "lag",
            bands: Vec::new(),
            alone: None,
            x: self.axis("v", self.units.speed),
            y: self.axis("F", self.units.force),
            logarithmic: (false, false),
            lines,
        };
        Ok((vec![graph], numbers))
    }

    fn read_reversal(&self) -> Read {
        let rows = self.rows("reversal")?;
        let turn = rows.iter().map(|row| row[2]).fold(0.0, f64::max);
        let half = rows.last().map_or(0.0, |row| row[0]) / 2.0;
        // The row at the reversal exists twice: before and after it.
        let turned = rows.partition_point(|row| row[0] <= half).saturating_sub(1);
        let forth: Vec<(f64, f64)> = rows[..turned].iter().map(|row| (row[2], row[1])).collect();
        let back: Vec<(f64, f64)> = rows[turned..].iter().map(|row| (turn - row[2], -row[1])).collect();
        let top = |points: &[(f64, f64)]| points.iter().map(|point| point.1).fold(f64::NEG_INFINITY, f64::max);
        let settled = forth.last().map_or(f64::NAN, |point| point.1);
        let (first, second) = (top(&forth) - settled, top(&back) - settled);
        // After both have settled there is no more difference to measure.
        let size = settled.abs().max(1e-300);
        let moving = |points: &[(f64, f64)]| {
            let last = points.iter().rev().find(|point| (point.1 - settled).abs() > 0.01 * size);
            last.map_or(0.0, |point| point.0)
        };
        let far = match moving(&forth).max(moving(&back)) {
            0.0 => 0.1 * turn,
            path => (2.5 * path).clamp(1e-3 * turn, turn),
        };
        let cut = |points: Vec<(f64, f64)>| {
            let rows: Vec<Vec<f64>> = points.iter().map(|point| vec![point.0, point.1]).collect();
            let mut inside: Vec<(f64, f64)> = points.into_iter().filter(|point| point.0 <= far).collect();
            inside.push((far, value_at(&rows, far, 1)));
            inside
        };
        let (forth, back) = (cut(forth), cut(back));
        let graph = Graph {
            key: "reversal",
            bands: Vec::new(),
            alone: None,
            x: self.axis("path", self.units.length),
            y: self.axis("F", self.units.force),
            logarithmic: (false, false),
            lines: vec![
                Line::course("from rest", forth),
                Line::course("after the reversal, turned over", back).aside(),
            ],
        };
        let force = self.units.force;
        let numbers = vec![
            self.number("settled_force", "settled force", settled, force),
            self.number("virgin_overshoot", "overshoot from rest", first, force),
            self.number("reversal_overshoot", "overshoot after the reversal", second, force),
        ];
        Ok((vec![graph], numbers))
    }

    fn read_stick_slip(&self) -> Read {
        let (mut lines, mut numbers, mut periods) = (Vec::new(), Vec::new(), Vec::new());
        let mut bands = Vec::new();
        let mut failed = Vec::new();
        let speeds = self.layout.pull_speeds();
        let (mut sticks_last, mut smooth_first) = (None, None);
        for (i, vp) in speeds.iter().enumerate() {
            let rows = match self.rows(&format!("stick_slip_{}", i + 1)) {
                Ok(rows) => rows,
                Err(why) => {
                    failed.push(format!("at {} {}: {why}", n(*vp), self.units.speed));
                    continue;
                }
            };
            let slips = slips(&rows, *vp);
            let sticking = sticks(&rows, &slips, *vp);
            if sticking {
                sticks_last = Some(*vp);
                let period = (slips[slips.len() - 1] - slips[0]) / (slips.len() - 1) as f64;
                periods.push((*vp, period));
                let half = rows.last().map_or(0.0, |row| row[0]) / 2.0;
                let peak = rows.iter().filter(|row| row[0] > half).map(|row| row[1]).fold(0.0, f64::max);
                let at = format!("at {} {}", n(*vp), self.units.speed);
                numbers.push(self.number("period", format!("period {at}"), period, "s"));
                numbers.push(self.number("peak_force", format!("peak force {at}"), peak, self.units.force));
            } else if smooth_first.is_none() && sticks_last.is_some() {
                smooth_first = Some(*vp);
            }
            if i == 2 {
                lines.push(Line::course("x", smooth(&rows)));
                bands = self.regimes(&rows);
                let end = rows.last().map_or(0.0, |row| row[0]);
                lines.push(Line::course("far end of the spring", vec![(0.0, 0.0), (end, vp * end)]).aside());
            }
        }
        if lines.is_empty() {
            return Err(failed.join("; "));
        }
        let mut graphs = vec![Graph {
            key: "stick_slip",
            bands,
            alone: None,
            x: self.axis("t", "s"),
            y: self.axis("x", self.units.length),
            logarithmic: (false, false),
            lines,
        }];
        if periods.len() > 1 {
            graphs.push(Graph {
                key: "stick_slip_period",
                bands: Vec::new(),
                alone: None,
                x: self.axis("pull speed", self.units.speed),
                y: self.axis("period", "s"),
                logarithmic: (true, true),
                lines: vec![Line::marked("", periods)],
            });
        }
        numbers.push(self.number("slowest_pull", "slowest pull", speeds[0], self.units.speed));
        numbers.push(self.number("fastest_pull", "fastest pull", speeds[speeds.len() - 1], self.units.speed));
        if let Some(vp) = sticks_last {
            numbers.push(self.number("stick_slip_up_to", "sticks and slips up to", vp, self.units.speed));
        }
        if let Some(vp) = smooth_first {
            numbers.push(self.number("stick_slip_gone", "smooth from", vp, self.units.speed));
        }
        Ok((graphs, numbers))
    }

    fn read_coast_down(&self) -> Read {
        let rows = self.rows("coast_down")?;
        let v0 = rows.first().map_or(0.0, |row| row[3]);
        let stop = rows.iter().find(|row| row[3].abs() < 1e-4 * v0).map(|row| row[0]);
        let graph = Graph {
            key: "coast_down",
            bands: self.regimes(&rows),
            alone: None,
            x: self.axis("t", "s"),
            y: self.axis("v", self.units.speed),
            logarithmic: (false, false),
            lines: vec![Line::course("", rows.iter().map(|row| (row[0], row[3])).collect())],
        };
        let mut numbers = vec![self.number("start_speed", "speed at the start", v0, self.units.speed)];
        if let Some(stop) = stop {
            numbers.push(self.number("stop_time", "time to 1e-4 of it", stop, "s"));
        }
        let travel = rows.last().map_or(0.0, |row| row[2]);
        numbers.push(self.number("stop_distance", "travel after 2 s", travel, self.units.length));
        Ok((vec![graph], numbers))
    }

    fn read_hold(&self) -> Read {
        let rows = self.rows("hold")?;
        let end = rows.last().map_or(0.0, |row| row[0]);
        let graph = Graph {
            key: "hold",
            bands: self.regimes(&rows),
            alone: None,
            x: self.axis("t", "s"),
            y: self.axis("x", self.units.length),
            logarithmic: (false, false),
            lines: vec![Line::course("", rows.iter().map(|row| (row[0], row[2])).collect())],
        };
        let creep = (value_at(&rows, end, 2) - value_at(&rows, 12.0, 2)) / (end - 12.0);
        let numbers = vec![
            self.number(
                "held_peak_to_peak",
                "motion from 12 s on",
                one(self.results, "hold")?.reading(0).unwrap_or(f64::NAN),
                self.units.length,
            ),
            self.number("creep_speed", "creep speed", creep, self.units.speed),
        ];
        Ok((vec![graph], numbers))
    }

    fn read_drift(&self) -> Read {
        let rows = self.rows("drift")?;
        // From whole cycle to whole cycle, in the second half against the first: what has not settled by then is a trend.
        let (begin, end) = battery::DRIFT;
        let drift = (value_at(&rows, end, 2) - value_at(&rows, begin, 2)) / (end - begin);
        let last = &rows[rows.partition_point(|row| row[0] < end - 1.0)..];
        let graph = Graph {
            key: "drift",
            bands: self.regimes(&rows),
            alone: None,
            x: self.axis("t", "s"),
            y: self.axis("x", self.units.length),
            logarithmic: (false, false),
            lines: vec![Line::course("", rows.iter().map(|row| (row[0], row[2])).collect())],
        };
        let numbers = vec![
            self.number("drift", "drift in a cycle", drift, self.units.length),
            self.number("swing", "swing within a cycle", peak_to_peak(last, 2), self.units.length),
        ];
        Ok((vec![graph], numbers))
    }

    fn read_energy(&self) -> Read {
        let mut points = Vec::new();
        let mut lines = Vec::new();
        for (i, x) in self.layout.amplitudes().into_iter().enumerate() {
            let name = format!("energy_{}", i + 1);
            let loss = one(self.results, &name)?.reading(0);
            let rows = self.rows(&name)?;
            points.push((x, loss.unwrap_or(f64::NAN)));
            if i == 5 {
                let end = rows.last().map_or(0.0, |row| row[0]);
                let from = end * (1.0 - 1.0 / self.layout.cycles(x));
                let cycle = between(&rows, (from, end)).iter().map(|row| (row[2] - x, row[1])).collect();
                lines.push(Line::course("", cycle));
            }
        }
        let least = points.iter().map(|point| point.1).fold(f64::INFINITY, f64::min);
        let (x, loss) = points[points.len() - 1];
        let numbers = vec![
            self.number("least_loss", "least loss of a cycle", least, "J"),
            self.number("mean_force", "loss over path, largest cycle", loss / (4.0 * x), self.units.force),
        ];
        let graphs = vec![
            Graph {
                key: "energy",
                bands: Vec::new(),
                alone: None,
                x: self.axis("amplitude", self.units.length),
                y: self.axis("loss per cycle", "J"),
                logarithmic: (true, true),
                lines: vec![Line::marked("", points)],
            },
            Graph {
                key: "energy_cycle",
                bands: Vec::new(),
                alone: None,
                x: self.axis("x", self.units.length),
                y: self.axis("F", self.units.force),
                logarithmic: (false, false),
                lines,
            },
        ];
        Ok((graphs, numbers))
    }

    fn read_rate(&self) -> Read {
        let mut lines = Vec::new();
        let mut courses: Vec<Vec<Vec<f64>>> = Vec::new();
        for (i, times) in [0.1, 1.0, 10.0].into_iter().enumerate() {
            let mut rows = self.rows(&format!("rate_{}", i + 1))?;
            let end = rows.last().map_or(1.0, |row| row[0]);
            for row in &mut rows {
                row[0] /= end;
            }
            // The second of two cycles, over a path normalised to length 1, which removes the rounding of the
            // frequency.
            let whole = peak_to_peak(&rows, 2).max(1e-300);
            let cycle: Vec<(f64, f64)> =
                rows.iter().filter(|row| row[0] >= 0.5).map(|row| (row[2] / whole, row[1])).collect();
            let line = Line::course(format!("{} times", n(times)), cycle);
            lines.push(if i == 1 { line } else { line.aside() });
            courses.push(rows);
        }
        let mut difference = 0.0_f64;
        for i in 0..=400 {
            let t = 0.5 + 0.5 * f64::from(i) / 400.0;
            // The force may jump at the reversal itself.
            if !((i % 200) < 3 || (i % 200) > 197) {
                let forces: Vec<f64> = courses.iter().map(|rows| value_at(rows, t, 1)).collect();
                for a in &forces {
                    for b in &forces {
                        difference = difference.max((a - b).abs());
                    }
                }
            }
        }
        let graph = Graph {
            key: "rate",
            bands: Vec::new(),
            alone: None,
            x: self.axis("place on the path", ""),
            y: self.axis("F", self.units.force),
            logarithmic: (false, false),
            lines,
        };
        let size = self.scales.f_b.max(self.scales.f_c);
        let numbers = vec![
            self.number("rate_difference", "greatest difference of the force", difference, self.units.force),
            self.number("rate_difference_part", "of the break-away force", difference / size, ""),
        ];
        Ok((vec![graph], numbers))
    }

    fn read_dissipation(&self, verdict: Option<&Verdict>) -> Read {
        let (mut least, mut greatest, mut lines) = (f64::INFINITY, 0.0_f64, Vec::new());
        for i in 1..=6 {
            let name = format!("closed_path_{i}");
            let work = one(self.results, &name)?.reading(0).unwrap_or(f64::NAN);
            let rows = self.rows(&name)?;
            greatest = greatest.max(work);
            if work < least {
                least = work;
                let end = rows.last().map_or(1.0, |row| row[0]);
                let last = between(&rows, (end - 1.0, end));
                let power = last.iter().map(|row| (row[0] - (end - 1.0), row[1] * row[2])).collect();
                lines = vec![Line::course("power into the contact, least of six", power)];
            }
        }
        let graph = Graph {
            key: "dissipation",
            bands: Vec::new(),
            alone: None,
            x: self.axis("t", "s"),
            y: self.axis("F v", "W"),
            logarithmic: (false, false),
            lines,
        };
        let mut numbers = vec![
            self.number("least_work", "least work of a round", least, "J"),
            self.number("greatest_work", "greatest work of a round", greatest, "J"),
        ];
        match verdict {
            Some(Verdict::Proved) => numbers.push(self.number("dissipation_proved", "proved for all points", 1.0, "")),
            Some(Verdict::Holds(points)) => {
                numbers.push(self.number(
                    "dissipation_points",
                    "points searched, none gives out power",
                    *points as f64,
                    "",
                ));
            }
            Some(Verdict::Fails(point)) => {
                numbers.push(self.number("pushes_at", "gives out power at v =", point.v, self.units.speed));
                numbers.push(self.number("pushes_with", "there F =", point.force, self.units.force));
            }
            Some(Verdict::NotChecked(_)) | None => {}
        }
        Ok((vec![graph], numbers))
    }

    fn read_steps(&self) -> Read {
        let reference = self.rows("steps_reference")?;
        let end = |rows: &[Vec<f64>]| rows.last().map_or(f64::NAN, |row| row[2]);
        let travel = end(&reference).abs().max(peak_to_peak(&reference, 2));
        let mut points = Vec::new();
        let mut numbers = Vec::new();
        let mut failed = Vec::new();
        for (i, h) in self.layout.steps().into_iter().enumerate() {
            match self.rows(&format!("steps_{}", i + 1)) {
                Ok(rows) => {
                    let error = (end(&rows) - end(&reference)).abs() / travel;
                    points.push((h, error.max(1e-16)));
                    numbers.push(self.number("step_error", format!("error at a step of {} s", n(h)), error, ""));
                }
                Err(why) => failed.push(format!("{} s: {why}", n(h))),
            }
        }
        if points.is_empty() {
            return Err(failed.join("; "));
        }
        let graph = Graph {
            key: "steps",
            bands: Vec::new(),
            alone: None,
            x: self.axis("step", "s"),
            y: self.axis("error of x, relative", ""),
            logarithmic: (true, true),
            lines: vec![Line::marked("", points)],
        };
        Ok((vec![graph], numbers))
    }
}

/// Maximum minus minimum of a column.
fn peak_to_peak(rows: &[Vec<f64>], column: usize) -> f64 {
    let values = rows.iter().map(|row| row[column]);
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
    high - low
}

/// The value of a column at a time, interpolated linearly.
fn value_at(rows: &[Vec<f64>], t: f64, column: usize) -> f64 {
    let next = rows.partition_point(|row| row[0] < t);
    match (rows.get(next.wrapping_sub(1)), rows.get(next)) {
        (Some(a), Some(b)) if b[0] > a[0] => a[column] + (b[column] - a[column]) * (t - a[0]) / (b[0] - a[0]),
        (_, Some(row)) | (Some(row), None) => row[column],
        (None, None) => f64::NAN,
    }
}

/// The rows between two times, with both ends, interpolated linearly where there is no row.
fn between(rows: &[Vec<f64>], (from, to): (f64, f64)) -> Vec<Vec<f64>> {
    let width = rows.first().map_or(0, Vec::len);
    let at = |t: f64| (0..width).map(|column| if column == 0 { t } else { value_at(rows, t, column) }).collect();
    let inside = rows.iter().filter(|row| row[0] > from && row[0] < to).cloned();
    std::iter::once(at(from)).chain(inside).chain(std::iter::once(at(to))).collect()
}

/// A loop of the force over the travel, from a turn of the force to the next of the same side.
struct ClosedLoop {
    /// Loss of the loop: its area, J.
    area: f64,
    /// Greatest travel within it.
    travel: f64,
    /// Greatest force minus least force within it.
    height: f64,
    /// How far it moves on: 0 if it closes.
    gap: f64,
}

impl ClosedLoop {
    /// Rows hold t, F, x; `work`: ∫F v dt between these times, as the run integrated it. A loop that moves on is closed
    /// by the chord between its ends, whose work is not a loss of the loop.
    fn of(rows: &[Vec<f64>], times: (f64, f64), work: Option<f64>) -> ClosedLoop {
        let inside = between(rows, times);
        let (Some(first), Some(last)) = (inside.first(), inside.last()) else {
            return ClosedLoop { area: f64::NAN, travel: 0.0, height: 0.0, gap: 0.0 };
        };
        let gap = last[2] - first[2];
        let area = work.unwrap_or(f64::NAN) - 0.5 * (first[1] + last[1]) * gap;
        ClosedLoop { area, travel: peak_to_peak(&inside, 2), height: peak_to_peak(&inside, 1), gap }
    }

    /// Its area over that of the box around it.
    fn part(&self) -> f64 {
        self.area / (self.height * self.travel).max(1e-300)
    }
}

/// Force at increasing speed minus force at the same decreasing speed, where that difference is largest.
fn lag(cycle: &[(f64, f64)]) -> f64 {
    let (mut rising, mut falling): (Vec<Vec<f64>>, Vec<Vec<f64>>) = (Vec::new(), Vec::new());
    for pair in cycle.windows(2) {
        let row = vec![pair[1].0, pair[1].1];
        if pair[1].0 > pair[0].0 {
            rising.push(row);
        } else if pair[1].0 < pair[0].0 {
            falling.push(row);
        }
    }
    rising.sort_by(|a, b| a[0].total_cmp(&b[0]));
    falling.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let (Some(first), Some(last)) = (rising.first(), rising.last()) else { return f64::NAN };
    let (low, high) = (first[0], last[0]);
    let gap = |i: u32| {
        // Skip the ends of the loop, where it reverses.
        let v = low + (high - low) * (0.05 + 0.9 * f64::from(i) / 100.0);
        value_at(&rising, v, 1) - value_at(&falling, v, 1)
    };
    (0..=100).map(gap).fold(0.0, |widest: f64, gap| if gap.abs() > widest.abs() { gap } else { widest })
}

/// Instants at which a pulled mass begins to slip after rest, without the first.
fn slips(rows: &[Vec<f64>], vp: f64) -> Vec<f64> {
    let (mut resting, mut starts) = (true, Vec::new());
    for row in rows {
        if resting && row[3] > 0.7 * vp {
            starts.push(row[0]);
            resting = false;
        } else if row[3].abs() < 0.1 * vp {
            resting = true;
        }
    }
    starts.split_off(1.min(starts.len()))
}

/// Whether a pulled mass that slips at these instants also comes to rest each time: for a twenty-fifth of the period it
/// moves less than a thousandth of the distance of the pulled end. A mass that oscillates about steady sliding without
/// loss only touches zero speed, and moves 2.6 thousandths in that time. A contact without damping rings while it
/// holds, but by far less.
fn sticks(rows: &[Vec<f64>], slips: &[f64], vp: f64) -> bool {
    let [first, .., last] = slips[..] else { return false };
    let period = (last - first) / (slips.len() - 1) as f64;
    let wide = 0.04 * period;
    let rests = |pair: &[f64]| {
        let inside = rows.iter().filter(|row| row[0] >= pair[0] && row[0] + wide <= pair[1]);
        let mut moved = inside.map(|row| (value_at(rows, row[0] + wide, 2) - row[2]).abs());
        moved.any(|moved| moved < 1e-3 * vp * wide)
    };
    slips.len() >= 3 && slips.windows(2).all(rests)
}

/// The position with additional points between distant rows, from the cubic Hermite interpolation with their speeds.
/// Rows hold t, F, x, v.
fn smooth(rows: &[Vec<f64>]) -> Vec<(f64, f64)> {
    let fine = rows.last().map_or(0.0, |row| row[0]) / 500.0;
    let mut points = Vec::with_capacity(rows.len());
    for pair in rows.windows(2) {
        let (a, b) = (&pair[0], &pair[1]);
        let h = b[0] - a[0];
        let parts = (h / fine).ceil().clamp(1.0, 500.0) as u32;
        for k in 0..parts {
            let s = f64::from(k) / f64::from(parts);
            let (r, q) = (1.0 - s, s * (1.0 - s));
            let x = a[2] * r * r * (1.0 + 2.0 * s) + b[2] * s * s * (3.0 - 2.0 * s) + h * q * (a[3] * r - b[3] * s);
            points.push((a[0] + s * h, x));
        }
    }
    points.extend(rows.last().map(|row| (row[0], row[2])));
    points
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[allow(clippy::disallowed_methods, reason = "its last bits decide nothing")]
    fn a_mass_that_only_touches_rest_does_not_stick() {
        // 0.1 m/s (1 − cos t), and the same with half a second of rest in each period.
        let swing = |t: f64| vec![t, 0.0, 0.1 * (t - t.sin()), 0.1 * (1.0 - t.cos())];
        let touching: Vec<Vec<f64>> = (0..4000).map(|i| swing(f64::from(i) * 0.01)).collect();
        let turn = std::f64::consts::TAU;
        let resting = |t: f64| {
            let (round, phase) = ((t / (turn + 0.5)).floor(), t % (turn + 0.5));
            let row = swing(phase.min(turn));
            vec![t, 0.0, row[2] + 0.1 * turn * round, row[3]]
        };
        let sticking: Vec<Vec<f64>> = (0..4000).map(|i| resting(f64::from(i) * 0.01)).collect();
        for (rows, expected) in [(touching, false), (sticking, true)] {
            let slips = slips(&rows, 0.1);
            assert!(slips.len() >= 3);
            assert_eq!(sticks(&rows, &slips, 0.1), expected);
        }
    }
}
