//! Turns recordings into figures.
//!
//! In: the plots of an experiment and the recordings of its cases. Out: one [`Figure`]; the cases of a sweep share its
//! axes.

use crate::compile::Case;
use crate::plot::{Axis, Band, Curve, Figure, Panel};
use abi::plan::{Plot, Series};
use runtime::engine::{Failure, Outcome};
use runtime::record::Recording;

/// One case: its label, empty if it is the only one, and its recording.
pub type Recorded<'a> = (&'a str, &'a Recording);

/// The recording of each case, up to where its run ended.
pub fn recorded<'a>(cases: &'a [Case], results: &'a [Result<Outcome, Failure>]) -> Vec<Recorded<'a>> {
    let of = |(case, result): (&'a Case, &'a Result<Outcome, Failure>)| {
        let recording = match result {
            Ok(outcome) => &outcome.recording,
            Err(failure) => &failure.recording,
        };
        (case.label.as_str(), recording)
    };
    cases.iter().zip(results).map(of).collect()
}

/// The figure of the plots of an experiment.
///
/// Quantities of one unit share axes; further units get axes of their own below. A truth value shades the time in which
/// it is true, or has its own axes if the shades of several cases would overlap.
pub fn figure(title: &str, subtitle: &str, plots: &[Plot], cases: &[Recorded]) -> Figure {
    let panels = plots.iter().flat_map(|plot| panels(plot, cases)).collect();
    Figure { title: title.into(), subtitle: subtitle.into(), panels }
}

fn panels(plot: &Plot, cases: &[Recorded]) -> Vec<Panel> {
    let x = match &plot.against {
        Some(series) => Axis { name: series.label.clone(), unit: series.unit.text.clone(), ..Axis::default() },
        None => Axis { name: "t".into(), unit: "s".into(), ..Axis::default() },
    };
    // A truth value plotted against another quantity is a curve, because there is no time axis to shade.
    let as_curve = |series: &&Series| !series.boolean || plot.against.is_some();
    let mut units: Vec<Vec<&Series>> = Vec::new();
    for series in plot.series.iter().filter(as_curve) {
        match units.iter_mut().find(|group| group[0].unit.text == series.unit.text) {
            Some(group) => group.push(series),
            None => units.push(vec![series]),
        }
    }
    let truths: Vec<&Series> = plot.series.iter().filter(|series| !as_curve(series)).collect();
    let shading = cases.len() == 1 && !units.is_empty();
    let bands: Vec<Band> = match cases {
        [(_, recording)] if shading => {
            truths.iter().map(|series| Band::of(&series.label, &points(recording, series, None))).collect()
        }
        _ => Vec::new(),
    };

    let panel = |group: &[&Series]| {
        let names: Vec<&str> = group.iter().map(|series| series.label.as_str()).collect();
        let curve = |(case, recording): &Recorded, series: &Series| Curve {
            name: match (case.is_empty(), group.len()) {
                (true, _) => series.label.clone(),
                (false, 1) => case.to_string(),
                (false, _) => format!("{}, {case}", series.label),
            },
            points: points(recording, series, plot.against.as_ref()),
            boolean: series.boolean && plot.against.is_none(),
            marks: false,
            style: None,
        };
        // Signals that are equal in all cases, such as a reference, are drawn once.
        let (common, own): (Vec<&Series>, Vec<&Series>) =
            group.iter().partition(|series| plot.against.is_none() && cases.len() > 1 && same_in_all(cases, series));
        let common = common.into_iter().map(|series| curve(&("", cases[0].1), series));
        let own = cases.iter().flat_map(|case| own.iter().map(move |series| curve(case, series)));
        Panel {
            x: x.clone(),
            y: Axis { name: names.join(", "), unit: group[0].unit.text.clone(), ..Axis::default() },
            curves: own.chain(common).collect(),
            bands: bands.clone(),
        }
    };
    let mut panels: Vec<Panel> = units.iter().map(|group| panel(group)).collect();
    if !shading {
        panels.extend(truths.iter().map(|series| panel(&[series])));
    }
    panels
}

/// The points of a series in the units shown, over time or against another series.
fn points(recording: &Recording, series: &Series, against: Option<&Series>) -> Vec<(f64, f64)> {
    let Some(y) = recording.column(series) else { return Vec::new() };
    let x = against.and_then(|against| Some((recording.column(against)?, &against.unit)));
    let shown = |row: &[f64]| {
        let x = x.map_or(row[0], |(column, unit)| unit.from_si(row[column + 1]));
        (x, series.unit.from_si(row[y + 1]))
    };
    recording.rows().map(shown).collect()
}

/// Whether a series is equal in all cases, at the resolution of a picture.
fn same_in_all(cases: &[Recorded], series: &Series) -> bool {
    const SAMPLES: usize = 200;
    let courses: Vec<Vec<(f64, f64)>> = cases.iter().map(|(_, recording)| points(recording, series, None)).collect();
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
