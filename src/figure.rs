//! Turns recordings into figures.
//!
//! In: the plots of an experiment and the recordings of its cases. Out: one [`Figure`]; the cases of a sweep share its
//! axes.

use crate::compile::Case;
use crate::plot::{Axis, Band, Curve, Figure, Panel};
use abi::plan::{Look, Plot, Series};
use runtime::engine::{Failure, Outcome};
use runtime::record::Recording;
use runtime::run::verdict::Verdict;

/// One case: its label, empty if it is the only one, its plots, its recording, and what it measured.
#[derive(Clone, Copy)]
pub struct Recorded<'a> {
    pub label: &'a str,
    pub plots: &'a [Plot],
    pub recording: &'a Recording,
    pub verdicts: &'a [Verdict],
}

/// What is kept of a run for its figures: its recording, up to where it ended, and its verdicts.
pub type Kept = (Recording, Vec<Verdict>);

/// What each case recorded.
pub fn recorded<'a>(cases: &'a [Case], kept: &'a [Kept]) -> Vec<Recorded<'a>> {
    let of = |(case, (recording, verdicts)): (&'a Case, &'a Kept)| recorded_by(case, recording, verdicts);
    cases.iter().zip(kept).map(of).collect()
}

/// The same of finished runs.
pub fn of_results<'a>(cases: &'a [Case], results: &'a [Result<Outcome, Failure>]) -> Vec<Recorded<'a>> {
    let of = |(case, result): (&'a Case, &'a Result<Outcome, Failure>)| match result {
        Ok(outcome) => recorded_by(case, &outcome.recording, &outcome.verdicts),
        Err(failure) => recorded_by(case, &failure.recording, &[]),
    };
    cases.iter().zip(results).map(of).collect()
}

fn recorded_by<'a>(case: &'a Case, recording: &'a Recording, verdicts: &'a [Verdict]) -> Recorded<'a> {
    Recorded { label: &case.label, plots: &case.experiment.plots, recording, verdicts }
}

/// The figure of the plots of an experiment; `from`: the first of them to draw.
///
/// Quantities of one unit share axes; further units get axes of their own below. A truth value shades the time in which
/// it is true, or has its own axes if the shades of several cases would overlap.
pub fn figure(title: &str, subtitle: &str, from: usize, cases: &[Recorded]) -> Figure {
    let count = cases.first().map_or(0, |case| case.plots.len());
    let models = models(cases);
    let cases: Vec<Recorded> = match &models {
        Some(models) => cases.iter().zip(models).map(|(case, label)| Recorded { label, ..*case }).collect(),
        None => cases.to_vec(),
    };
    let mut panels: Vec<Panel> = (from..count).flat_map(|k| panels(k, &cases)).collect();
    // The same curves have the same legend: it is shown once.
    for k in (1..panels.len()).rev() {
        let names = |panel: &Panel| panel.curves.iter().map(|curve| curve.name.clone()).collect::<Vec<_>>();
        let bands = !panels[k].bands.is_empty() || !panels[k - 1].bands.is_empty();
        if panels[k].curves.len() > 1 && !bands && names(&panels[k]) == names(&panels[k - 1]) {
            panels[k].legend = false;
        }
    }
    Figure { title: title.into(), subtitle: subtitle.into(), panels }
}

/// Short labels of cases that differ in the model of one slot: `fr = LuGre(Fs = 2 N)`, `fr = Dahl()` as
/// `LuGre(Fs = 2 N)`, `Dahl`. None if they differ in something else.
fn models(cases: &[Recorded]) -> Option<Vec<String>> {
    let (slot, _) = cases.first()?.label.split_once(" = ")?;
    let model = |case: &Recorded| {
        let rest = case.label.strip_prefix(slot)?.strip_prefix(" = ")?;
        let name = rest.trim_start_matches("rotary ");
        let is_model = name.starts_with(|c: char| c.is_ascii_uppercase()) && without(case.label, slot).is_empty();
        is_model.then(|| rest.strip_suffix("()").unwrap_or(rest).to_string())
    };
    cases.iter().map(model).collect()
}

/// A quantity of a plot and how it looks.
type Shown<'a> = (&'a Series, &'a Look);

/// The name of a quantity: that which the text gives it, or its expression.
fn name(look: &Look, label: &str) -> String {
    look.label.clone().unwrap_or_else(|| label.into())
}

/// The axis of quantities of one unit.
fn axis(names: &[String], unit: &abi::unit::Unit, looks: &[&Look]) -> Axis {
    let mut different: Vec<&str> = Vec::new();
    for name in names {
        if !different.contains(&name.as_str()) {
            different.push(name);
        }
    }
    let range = looks.iter().find_map(|look| look.range).map(|(from, to)| (unit.from_si(from), unit.from_si(to)));
    let logarithmic = looks.iter().any(|look| look.logarithmic);
    Axis { name: different.join(", "), unit: unit.text.clone(), logarithmic, range }
}

/// The panels of the `k`-th plot.
fn panels(k: usize, cases: &[Recorded]) -> Vec<Panel> {
    let plot = &cases[0].plots[k];
    if plot.view.across.is_some() {
        return across(k, cases);
    }
    let second = abi::unit::Unit::parse("s").expect("the second is known");
    let mut x = match &plot.against {
        Some(series) => axis(&[name(&plot.view.x, &series.label)], &series.unit, &[&plot.view.x]),
        None => axis(&["t".into()], &second, &[&plot.view.x]),
    };
    let over_time = plot.against.as_ref().is_none_or(|series| series.label == "t");
    if over_time && x.range.is_none() && (plot.view.after.is_some() || plot.view.before.is_some()) {
        let times = |ends: (f64, f64), case: &Recorded| {
            let mut rows = case.recording.rows();
            let (first, last) = (rows.next().map_or(ends.0, |row| row[0]), rows.last().map_or(ends.1, |row| row[0]));
            (ends.0.min(first), ends.1.max(last))
        };
        let ends = cases.iter().fold((f64::INFINITY, f64::NEG_INFINITY), times);
        let unit = plot.against.as_ref().map_or(&second, |series| &series.unit);
        // A window may depend on what a sweep varies: the axis has room for all.
        let windows = || cases.iter().filter_map(|case| case.plots.get(k)).map(|plot| &plot.view);
        let from = windows().map(|view| view.after.unwrap_or(ends.0)).fold(f64::INFINITY, f64::min);
        let to = windows().map(|view| view.before.unwrap_or(ends.1)).fold(f64::NEG_INFINITY, f64::max);
        x.range = Some((unit.from_si(from), unit.from_si(to)));
    }
    let unseen = Look::default();
    let look = |i: usize| plot.view.looks.get(i).unwrap_or(&unseen);
    let all: Vec<Shown> = plot.series.iter().enumerate().map(|(i, series)| (series, look(i))).collect();
    // A truth value plotted against another quantity is a curve, because there is no time axis to shade.
    let as_curve = |(series, _): &&Shown| !series.boolean || !over_time;
    let mut units: Vec<Vec<Shown>> = Vec::new();
    for shown in all.iter().filter(as_curve) {
        match units.iter_mut().find(|group| group[0].0.unit.text == shown.0.unit.text) {
            Some(group) => group.push(*shown),
            None => units.push(vec![*shown]),
        }
    }
    let truths: Vec<Shown> = all.iter().filter(|shown| !as_curve(shown)).copied().collect();
    let shading = cases.len() == 1 && !units.is_empty();
    let bands: Vec<Band> = match cases {
        [case] if shading => {
            let band = |(series, look): &Shown| Band::of(&name(look, &series.label), &points(case, series, k));
            truths.iter().map(band).collect()
        }
        _ => Vec::new(),
    };
    let recorded_x = over_time || plot.view.x.recorded;

    let panel = |group: &[Shown]| {
        let is_recorded = |look: &Look| look.recorded && recorded_x;
        let curve = |case: &Recorded, (series, look): Shown, label: &str, among: usize| Curve {
            name: match (label.is_empty(), among) {
                (true, _) => name(look, &series.label),
                (false, 1) => label.into(),
                (false, _) => format!("{}, {label}", name(look, &series.label)),
            },
            points: points(case, series, k),
            boolean: series.boolean && over_time,
            marks: false,
            recorded: is_recorded(look),
            style: None,
        };
        // Recordings, and signals that are equal in all cases, such as a reference, are drawn once.
        let (common, own): (Vec<Shown>, Vec<Shown>) = group.iter().partition(|(series, look)| {
            is_recorded(look) || over_time && cases.len() > 1 && same_in_all(cases, series, k)
        });
        // The axis is named after what the models compute, if they do.
        let computed = group.iter().any(|(_, look)| !is_recorded(look));
        let names = group.iter().filter(|(_, look)| !computed || !is_recorded(look));
        let names: Vec<String> = names.map(|(series, look)| name(look, &series.label)).collect();
        let among = own.len();
        let common = common.into_iter().map(|shown| curve(&cases[0], shown, "", among));
        let own = cases.iter().flat_map(|case| own.iter().map(move |shown| curve(case, *shown, case.label, among)));
        let looks: Vec<&Look> = group.iter().map(|(_, look)| *look).collect();
        let (y, curves) = (axis(&names, &group[0].0.unit, &looks), own.chain(common).collect());
        Panel { x: x.clone(), y, curves, bands: bands.clone(), ..Panel::default() }
    };
    let mut panels: Vec<Panel> = units.iter().map(|group| panel(group)).collect();
    if !shading {
        panels.extend(truths.iter().map(|shown| panel(&[*shown])));
    }
    if let (Some(first), Some(title)) = (panels.first_mut(), &plot.view.title) {
        first.title.clone_from(title);
    }
    panels
}

/// The panels of measures over a parameter: a point for each case, a curve for all cases that differ in it alone.
fn across(k: usize, cases: &[Recorded]) -> Vec<Panel> {
    let mut panels: Vec<Panel> = Vec::new();
    let plot = &cases[0].plots[k];
    let measures = plot.view.across.as_ref().map_or(0, |across| across.measures.len());
    let unseen = Look::default();
    for i in 0..measures {
        let look = plot.view.looks.get(i).unwrap_or(&unseen);
        let mut curves: Vec<Curve> = Vec::new();
        let mut of_axes = None;
        for case in cases {
            let Some(across) = case.plots.get(k).and_then(|plot| plot.view.across.as_ref()) else { continue };
            let Some(verdict) = across.measures.get(i).and_then(|at| case.verdicts.get(*at)) else { continue };
            let Some(reading) = &verdict.shown else { continue };
            let rest = without(case.label, &across.label);
            let point = (across.unit.from_si(across.value), reading.unit.from_si(reading.value));
            let label = name(look, &reading.text);
            let title = if rest.is_empty() { label.clone() } else { rest.clone() };
            of_axes.get_or_insert((label, &reading.unit, across));
            match curves.iter_mut().find(|curve| curve.name == title) {
                Some(curve) => curve.points.push(point),
                None => curves.push(Curve { name: title, points: vec![point], marks: true, ..Curve::default() }),
            }
        }
        let Some((label, unit, across)) = of_axes else { continue };
        for curve in &mut curves {
            curve.points.sort_by(|a, b| a.0.total_cmp(&b.0));
        }
        let x = axis(&[name(&plot.view.x, &across.label)], &across.unit, &[&plot.view.x]);
        let y = axis(std::slice::from_ref(&label), unit, &[look]);
        // Measures of one unit share axes, as quantities do; but not the curves of several cases.
        let alone = |panel: &Panel| panel.curves.len() == 1 && curves.len() == 1;
        match panels.iter_mut().find(|panel| panel.y.unit == y.unit && alone(panel)) {
            Some(panel) => {
                panel.y.name = format!("{}, {}", panel.y.name, y.name);
                panel.y.range = panel.y.range.or(y.range);
                panel.y.logarithmic |= y.logarithmic;
                panel.curves.append(&mut curves);
            }
            None => panels.push(Panel { x, y, curves, ..Panel::default() }),
        }
    }
    if let (Some(first), Some(title)) = (panels.first_mut(), &plot.view.title) {
        first.title.clone_from(title);
    }
    panels
}

/// The label of a case without the value of one parameter: `fr = LuGre(), k = 2 N/m` without `k` is `fr = LuGre()`.
fn without(label: &str, path: &str) -> String {
    let mut depth = 0i32;
    let ends = label.char_indices().filter(|(_, c)| {
        depth += i32::from(matches!(c, '(' | '[')) - i32::from(matches!(c, ')' | ']'));
        *c == ',' && depth == 0
    });
    let ends: Vec<usize> = ends.map(|(at, _)| at).chain([label.len()]).collect();
    let mut from = 0;
    let mut kept: Vec<&str> = Vec::new();
    for end in ends {
        let one = label[from.min(end)..end].trim();
        // `a = 1, 2` does not occur: a value has no comma outside brackets. `a, b = 1` has both.
        if end < label.len() && !one.contains('=') {
            continue;
        }
        from = end + 1;
        let names = one.split_once('=').map_or("", |(names, _)| names.trim());
        let own = names == path || names.split(',').any(|name| name.trim() == path);
        if !own && !one.is_empty() {
            kept.push(one);
        }
    }
    kept.join(", ")
}

/// The points of a series in the units shown, over time or against another series, within the window of the `k`-th
/// plot, which may depend on what a sweep varies.
fn points(case: &Recorded, series: &Series, k: usize) -> Vec<(f64, f64)> {
    let recording = case.recording;
    let Some(plot) = case.plots.get(k) else { return Vec::new() };
    let Some(y) = recording.column(series) else { return Vec::new() };
    let x = plot.against.as_ref().and_then(|against| Some((recording.column(against)?, &against.unit)));
    let (after, before) = (plot.view.after.unwrap_or(f64::NEG_INFINITY), plot.view.before.unwrap_or(f64::INFINITY));
    let x = |row: &[f64]| x.map_or(row[0], |(column, unit)| unit.from_si(row[column + 1]));
    let rows = recording.rows().map(|row| (row[0], x(row), series.unit.from_si(row[y + 1])));
    within(rows, (after, before), series.boolean)
}

/// The points of rows of a time, x and y within a window. Where the window begins or ends between two rows, it has a
/// point there, on the line between them; of a truth value (`held`) with the value of the row before.
fn within(rows: impl Iterator<Item = (f64, f64, f64)>, (after, before): (f64, f64), held: bool) -> Vec<(f64, f64)> {
    let mut points = Vec::new();
    let mut last: Option<(f64, f64, f64)> = None;
    for row in rows {
        if let Some(from) = last {
            let edge = |t: f64| {
                let part = (t - from.0) / (row.0 - from.0);
                let at = |a: f64, b: f64| a + part * (b - a);
                (at(from.1, row.1), if held { from.2 } else { at(from.2, row.2) })
            };
            points.extend([after, before].into_iter().filter(|t| from.0 < *t && *t < row.0).map(edge));
        }
        if row.0 >= after && row.0 <= before {
            points.push((row.1, row.2));
        }
        if row.0 > before {
            break;
        }
        last = Some(row);
    }
    points
}

/// Whether a series is equal in all cases, at the resolution of a picture.
fn same_in_all(cases: &[Recorded], series: &Series, k: usize) -> bool {
    const SAMPLES: usize = 200;
    let courses: Vec<Vec<(f64, f64)>> = cases.iter().map(|case| points(case, series, k)).collect();
    let (first, others) = courses.split_first().expect("there are several cases");
    let (Some((from, _)), Some((to, _))) = (first.first(), first.last()) else { return false };
    let size = first.iter().fold(0.0, |size: f64, (_, y)| size.max(y.abs()));
    others.iter().all(|other| {
        other.last().is_some_and(|(end, _)| end == to)
            && (0..=SAMPLES).all(|i| {
                let t = from + (to - from) * i as f64 / SAMPLES as f64;
                (value_at(first, t) - value_at(other, t)).abs() <= 1e-4 * size
            })
    })
}

/// The value at a time, interpolated linearly.
fn value_at(points: &[(f64, f64)], t: f64) -> f64 {
    let next = points.partition_point(|(time, _)| *time < t);
    match (points.get(next.wrapping_sub(1)), points.get(next)) {
        (Some(&(t0, y0)), Some(&(t1, y1))) => y0 + (y1 - y0) * (t - t0) / (t1 - t0),
        (None, Some(&(_, y))) | (Some(&(_, y)), None) => y,
        (None, None) => f64::NAN,
    }
}

#[cfg(test)]
mod tests {
    use super::{within, without};

    /// A closed curve over one period, whose rows do not lie on the ends of the window: it has its whole period, and it
    /// closes. The rows are those of a polygon, so that the points on its edges are exact.
    ///
    /// Mutant tried by hand: only rows within the window are points.
    #[test]
    fn a_window_begins_and_ends_on_its_edges() {
        let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(6);
        let mut random = compiler::ir::random::Random(seed);
        for case in 0..300 {
            let period = random.within(0.1, 3.0);
            let mut corners: Vec<f64> = (0..2 + random.below(9)).map(|_| random.within(0.0, period)).collect();
            corners.sort_by(f64::total_cmp);
            let values: Vec<(f64, f64)> =
                corners.iter().map(|_| (random.within(-1.0, 1.0), random.within(-1.0, 1.0))).collect();
            let rows: Vec<(f64, f64, f64)> = (0..4)
                .flat_map(|round| {
                    let at = f64::from(round) * period;
                    corners.iter().zip(&values).map(move |(t, (x, y))| (at + t, *x, *y))
                })
                .collect();
            let after = random.within(1.0, 1.9) * period;
            let points = within(rows.iter().copied(), (after, after + period), false);
            let (first, last) = (points[0], points[points.len() - 1]);
            let told = format!("seed {seed}, case {case}: {first:?} {last:?}");
            assert!((first.0 - last.0).abs() < 1e-9 && (first.1 - last.1).abs() < 1e-9, "{told}");
            // One round has each corner once, and both ends.
            assert!(points.len() > corners.len(), "{told}");
            // Without a window nothing is added; a window beyond the rows is empty.
            let all = within(rows.iter().copied(), (f64::NEG_INFINITY, f64::INFINITY), false);
            assert_eq!(all.len(), rows.len(), "{told}");
            assert!(within(rows.iter().copied(), (10.0 * period, 11.0 * period), false).is_empty(), "{told}");
            // A window within one edge has two points; a truth value keeps that of the row before.
            let (from, to) = (rows[0].0, rows[1].0);
            let inside = (from + 0.25 * (to - from), from + 0.75 * (to - from));
            let held = within(rows.iter().copied(), inside, true);
            assert!(held.len() == 2 && held.iter().all(|point| point.1 == rows[0].2), "{told}: {held:?}");
        }
    }

    #[test]
    fn a_label_loses_the_parameter_on_the_axis() {
        let label = "fr = LuGre(Fs = 1 N, vs = 1 mm/s), rate = 5 N/s, m = 1 kg";
        assert_eq!(without(label, "rate"), "fr = LuGre(Fs = 1 N, vs = 1 mm/s), m = 1 kg");
        assert_eq!(without(label, "vs"), label);
        assert_eq!(without("rate = 5 N/s", "rate"), "");
        let joint = "x.k, y.k = 5 N/m, fr = Dahl()";
        assert_eq!(without(joint, "y.k"), "fr = Dahl()");
        assert_eq!(without(joint, "x.k, y.k"), "fr = Dahl()");
        assert_eq!(without(joint, "fr"), "x.k, y.k = 5 N/m");
    }
}
