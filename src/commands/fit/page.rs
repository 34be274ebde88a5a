//! The report of a fit: one self-contained HTML page.
//!
//! In: an answer, its runs, and the compared rows. Out: a page with inline figures, which loads nothing and runs no script.

use super::answer::{Fitted, said};
use super::search::{Part, Runs};
use crate::characterise::page::{escaped, page, words};
use crate::compile::FitItem;
use crate::figure::{self, Recorded};
use crate::plot::{self, Axis, Curve, Figure, Look, Panel};
use crate::quantity::{count, show, significant};
use grammar::diagnostic::Diagnostic;
use runtime::record::Recording;
use std::fmt::Write;

/// Width of a figure in px.
const WIDE: f64 = 560.0;
/// Points of a curve; more are drawn as every n-th.
const MOST_POINTS: usize = 4000;
/// Lags of the autocorrelation.
const LAGS: usize = 40;

/// What a page shows of one recording beside the answer.
pub struct PageRun<'a> {
    /// The run with the values found.
    pub recording: &'a Recording,
    /// Every n-th of the compared rows: its number, all differences, then all sides.
    pub rows: Vec<(usize, Vec<f64>)>,
}

/// The page.
pub fn report(
    fitted: &Fitted,
    runs: &Runs,
    (title, text): (&str, &str),
    warnings: &[Diagnostic],
    shown: &[PageRun],
) -> String {
    let mut body = String::new();
    let _ = writeln!(body, "<h1>{}</h1>", escaped(title));
    let files: Vec<&str> = runs.parts.iter().map(|part| &part.asks.recording[..]).collect();
    let _ = writeln!(
        body,
        "<p class=\"faint\">{} fitted to {} by fric {}.</p>",
        escaped(&super::answer::models(runs)),
        escaped(&files.join(", ")),
        env!("CARGO_PKG_VERSION")
    );
    for warning in warnings {
        let help = warning
            .help
            .as_ref()
            .map_or(String::new(), |help| format!(" <span class=\"faint\">{}</span>", words(help)));
        let _ = writeln!(body, "<p class=\"note\">{}: {}.{help}</p>", warning.code, words(&warning.message));
    }
    body += "<h2>Values</h2>\n";
    body += &values(fitted, runs);
    body += &compared(fitted, runs);
    let mut number = 0;
    let mut draw = |panel: Vec<Panel>, columns: usize| {
        number += 1;
        let drawn = Figure { panels: panel, ..Figure::default() };
        format!(
            "<section>{}</section>\n",
            plot::inline(&drawn, &Look { columns, ..Look::default() }, WIDE, &format!("f{number}"))
        )
    };
    for ((part, shown), items) in runs.parts.iter().zip(shown).zip(runs.items()) {
        let of = if runs.parts.len() > 1 { format!(": {}", part.asks.label) } else { String::new() };
        let _ = writeln!(body, "<h2>Measured and fitted{}</h2>\n<div class=\"tests\">", escaped(&of));
        for panel in measured(part, &shown.rows) {
            body += &draw(vec![panel], 1);
        }
        let plots = &part.varying.plots;
        if !plots.is_empty() {
            let drawn = Recorded { label: "", plots, recording: shown.recording, verdicts: &[] };
            for panel in figure::figure("", "", 0, &[drawn]).panels {
                body += &draw(vec![panel], 1);
            }
        }
        let _ = writeln!(body, "</div>\n<h2>Residuals{}</h2>\n<div class=\"tests\">", escaped(&of));
        for (item, k) in part.asks.items.iter().zip(items) {
            let rows = &fitted.answer.residuals[k];
            for panel in residuals(part, item, rows) {
                body += &draw(vec![panel], 1);
            }
            body += &draw(vec![autocorrelation(&item.shown(), rows, &fitted.answer.noise[k].whitened(rows))], 1);
        }
        body += "</div>\n";
    }
    if fitted.profiles.iter().any(Option::is_some) {
        body += "<h2>Profiles</h2>\n<p class=\"how\">Growth of −2 log-likelihood when a parameter is held and the others are fitted again. \
                 Values below 3.84 are compatible with the data at 95 %.</p>\n<div class=\"tests\">\n";
        for (k, profile) in fitted.profiles.iter().enumerate() {
            let Some(profile) = profile else { continue };
            let unknown = &runs.unknowns[k];
            let points: Vec<(f64, f64)> =
                profile.points.iter().map(|(x, y)| (unknown.unit.from_si(*x), y.min(12.0))).collect();
            let ends = [points[0].0, points[points.len() - 1].0];
            let logarithmic = ends[0] > 0.0 && ends[1] > 10.0 * ends[0];
            let x = Axis { name: unknown.label.clone(), unit: unknown.unit.text.clone(), logarithmic, range: None };
            let y = Axis { name: "growth".into(), range: Some((0.0, 12.0)), ..Axis::default() };
            let level = Curve { name: "95 %".into(), points: ends.map(|x| (x, 3.84)).to_vec(), ..Curve::default() };
            let curve = Curve { name: unknown.label.clone(), points, marks: true, ..Curve::default() };
            body += &draw(vec![Panel { x, y, curves: vec![curve, level], ..Panel::default() }], 1);
        }
        body += "</div>\n";
    }
    body += "<h2>Search</h2>\n";
    body += &search(fitted);
    if !text.is_empty() {
        let _ = writeln!(body, "<h2>Text</h2>\n<pre>{}</pre>", escaped(text));
    }
    page(title, &body)
}

/// The table of values.
fn values(fitted: &Fitted, runs: &Runs) -> String {
    let percent = significant(100.0 * fitted.level, 4);
    let mut out = format!(
        "<table>\n<tr><th>unknown</th><th>value</th><th>±</th><th>{percent} % interval</th><th>pieces</th><th>profile</th></tr>\n"
    );
    for (k, unknown) in runs.unknowns.iter().enumerate() {
        let [value, sd, low, high] = fitted.shown(k, unknown);
        let interval = if low.is_empty() { "not determined".to_string() } else { format!("{low} .. {high}") };
        let pieces = fitted.piece_words(k, unknown).unwrap_or_default();
        let profile = fitted.profile_words(k, unknown).unwrap_or_default();
        let _ = writeln!(
            out,
            "<tr><td>{}</td><td class=\"n\">{value}</td><td class=\"n\">{sd}</td><td class=\"n\">{interval}</td><td>{pieces}</td><td>{profile}</td></tr>",
            escaped(&unknown.label)
        );
    }
    out += "</table>\n";
    let n = runs.unknowns.len();
    if n > 1 {
        out += "<details><summary>Correlations</summary>\n<table>\n<tr><th></th>";
        for unknown in &runs.unknowns {
            let _ = write!(out, "<th>{}</th>", escaped(&unknown.label));
        }
        out += "</tr>\n";
        for (i, unknown) in runs.unknowns.iter().enumerate() {
            let _ = write!(out, "<tr><td>{}</td>", escaped(&unknown.label));
            for j in 0..n {
                let c = fitted.answer.correlation[i * n + j];
                let strength = (c.abs() * 70.0).round();
                let hue = if c < 0.0 { "213, 94, 0" } else { "0, 114, 178" };
                let text = if c.is_finite() { format!("{c:.2}").replace('-', "−") } else { "–".into() };
                let _ = write!(out, "<td class=\"n\" style=\"background: rgba({hue}, 0.{strength:02})\">{text}</td>");
            }
            out += "</tr>\n";
        }
        out += "</table></details>\n";
    }
    out
}

/// The table of what is compared.
fn compared(fitted: &Fitted, runs: &Runs) -> String {
    let mut out =
        String::from("<table>\n<tr><th>compared</th><th>rows</th><th>rms</th><th>noise</th><th>remarks</th></tr>\n");
    for ((part, run), items) in runs.parts.iter().zip(&fitted.runs).zip(runs.items()) {
        for ((item, k), remarks) in part.asks.items.iter().zip(items).zip(&run.remarks) {
            let of = runs.before(part);
            let order = fitted.answer.noise[k].order();
            let mut noise = if order == 0 { "white".to_string() } else { format!("autoregressive of order {order}") };
            if fitted.answer.misfits && order > 0 {
                noise += ", but no noise: values by least squares";
            }
            let _ = writeln!(
                out,
                "<tr><td>{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td><td>{noise}</td><td>{}</td></tr>",
                escaped(&format!("{of}{}", item.shown())),
                count(fitted.answer.residuals[k].len() as u64),
                show(fitted.answer.rms[k], &item.unit, 4),
                escaped(&said(remarks, part))
            );
        }
    }
    out + "</table>\n"
}

/// Which of so many rows are drawn: every n-th.
pub fn every(rows: usize) -> usize {
    rows.div_ceil(MOST_POINTS).max(1)
}

/// Both sides of each difference over time, or over the number of the point.
fn measured(part: &Part, rows: &[(usize, Vec<f64>)]) -> Vec<Panel> {
    let asks = &part.asks;
    let mut at = asks.items.len();
    let mut out = Vec::new();
    for item in &asks.items {
        let Some(sides) = &item.sides else { continue };
        let curve = |k: usize| {
            let name = sides[k].0.clone();
            let recorded = name.starts_with("data.");
            let points = rows.iter().map(|(row, values)| (time(part, *row), item.unit.from_si(values[at + k])));
            Curve { name, points: points.collect(), recorded, ..Curve::default() }
        };
        let mut curves = vec![curve(0), curve(1)];
        curves.sort_by_key(|curve| !curve.recorded);
        let y = Axis { name: sides[0].0.clone(), unit: item.unit.text.clone(), ..Axis::default() };
        out.push(Panel { x: time_axis(part), y, curves, ..Panel::default() });
        at += 2;
    }
    out
}

fn time(part: &Part, row: usize) -> f64 {
    if part.asks.steady { (row + 1) as f64 } else { part.instants[row] }
}

fn time_axis(part: &Part) -> Axis {
    let (name, unit) = if part.asks.steady { ("point", "") } else { ("t", "s") };
    Axis { name: name.into(), unit: unit.into(), ..Axis::default() }
}

/// Residuals over time and over each column of the recording.
fn residuals(part: &Part, item: &FitItem, rows: &[f64]) -> Vec<Panel> {
    let (text, unit) = (&item.shown(), &item.unit);
    let kept = item.kept(&part.instants);
    let y = || Axis { name: text.clone(), unit: unit.text.clone(), ..Axis::default() };
    let (after, before) = part.asks.window;
    let compared: Vec<usize> =
        (0..part.asks.rows.len()).filter(|row| (after..=before).contains(&part.asks.rows[*row])).collect();
    let of = |x: Axis, at: &dyn Fn(usize) -> f64| {
        let points = (0..rows.len())
            .step_by(every(rows.len()))
            .map(|row| (at(row), unit.from_si(rows[row]) - unit.from_si(0.0)))
            .collect();
        let curve = Curve { name: text.clone(), points, recorded: true, ..Curve::default() };
        Panel { x, y: y(), curves: vec![curve], legend: false, ..Panel::default() }
    };
    let mut out = vec![of(time_axis(part), &|row| time(part, kept[row]))];
    for (name, column, values) in &part.asks.columns {
        let x = Axis { name: name.clone(), unit: column.text.clone(), ..Axis::default() };
        out.push(of(x, &|row| column.from_si(values[compared[kept[row]]])));
    }
    out
}

/// The autocorrelation of residuals, as they are and whitened.
fn autocorrelation(text: &str, rows: &[f64], white: &[f64]) -> Panel {
    let of = |name: &str, rows: &[f64]| {
        let all: f64 = rows.iter().map(|r| r * r).sum::<f64>().max(f64::MIN_POSITIVE);
        let lags = 0..=LAGS.min(rows.len().saturating_sub(2));
        let one = |lag: usize| (lag as f64, rows[lag..].iter().zip(rows).map(|(a, b)| a * b).sum::<f64>() / all);
        Curve { name: name.into(), points: lags.map(one).collect(), ..Curve::default() }
    };
    let bound = 1.96 / (white.len().max(1) as f64).sqrt();
    let level = |y: f64| Curve {
        name: "95 % of white noise".into(),
        points: vec![(0.0, y), (LAGS as f64, y)],
        style: Some((2, 1)),
        ..Curve::default()
    };
    let x = Axis { name: "lag".into(), unit: "rows".into(), ..Axis::default() };
    let y = Axis { name: "autocorrelation".into(), ..Axis::default() };
    let curves = vec![of(text, rows), of("whitened", white), level(bound)];
    Panel { x, y, curves, ..Panel::default() }
}

/// Where the searches ended.
fn search(fitted: &Fitted) -> String {
    let answer = &fitted.answer;
    let mut out = format!(
        "<p>{} starts judged, {} followed, {} of them ended here; {} runs.</p>\n",
        count(answer.starts as u64),
        answer.followed,
        answer.agreed,
        count(answer.runs)
    );
    let least = answer.ends.iter().copied().fold(f64::INFINITY, f64::min);
    if answer.ends.len() > 1 {
        out += "<table>\n<tr><th>search</th><th>−2 log-likelihood above the best</th></tr>\n";
        let mut ends = answer.ends.clone();
        ends.sort_by(f64::total_cmp);
        for (k, end) in ends.iter().enumerate() {
            let _ = writeln!(out, "<tr><td>{}</td><td class=\"n\">{}</td></tr>", k + 1, significant(end - least, 3));
        }
        out += "</table>\n";
    }
    if !answer.failures.is_empty() {
        out += "<table>\n<tr><th>failed runs</th><th>cause</th></tr>\n";
        for (why, times) in &answer.failures {
            let _ = writeln!(out, "<tr><td class=\"n\">{}</td><td>{}</td></tr>", count(*times), words(why));
        }
        out += "</table>\n";
    }
    out
}
