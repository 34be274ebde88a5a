//! `fric excite`: designs the motion that makes the unknowns of a fit as certain as possible within limits.
//!
//! In: a fit, and limits of the motion. Out: the motion as a text and as a table, and the standard deviations that a
//! recording of it promises. The motion is a Fourier series; its coefficients become parameters of the fit's own model,
//! so that all candidates run in the lanes of one program.

use super::fit::search::Runs;
use super::{End, load, load_text, reported, sound};
use crate::args;
use crate::compile::{self, ElementaryFunction, Loaded, Options, Stopwatch, Unary};
use crate::named_files::NamedFiles;
use crate::project;
use crate::quantity::{self, count, duration, show, significant};
use crate::terminal::{Style, Terminal};
use abi::Slot;
use abi::unit::Unit;
use grammar::ast::{self, ExperimentStatement, Expr, FitStatement};
use runtime::fit::cma_es::{self, Search};
use runtime::fit::information::Information;
use runtime::fit::unknowns::Scale;
use runtime::fit::{Elementary, Runs as _, Unknown, Way};
use runtime::rng::Chance;
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::f64::consts::PI;
use std::fmt::Write as _;
use std::path::Path;
use std::time::Instant;

/// Sets of values of the unknowns for which a motion is judged, where none are known.
const DRAWS: usize = 8;
/// Most sets that are tried for them.
const MOST_DRAWS: usize = 64;
/// Relative size of the differences for derivatives.
const DIFFERENCE: f64 = 1e-3;
/// Instants of a period at which limits are checked, for each harmonic.
const INSTANTS: usize = 64;
/// A combination of unknowns that moves the outputs by less, in units of the noise, is not determined.
const LEAST_SENSITIVITY: f64 = 4.0;
/// Criterion of a motion that cannot be run.
const FAILED: f64 = 1e9;
/// Most sizes of a motion that are tried for limits of quantities that follow from runs, and the part of a limit that is
/// near enough.
const MOST_SCALINGS: usize = 12;
const NEAR_LIMIT: f64 = 0.99;
/// Most rows of a design.
const MOST_ROWS: f64 = 1e6;

/// The quantities of a motion, with the order of their derivative of the position.
const MOTION: [(&str, &str); 3] = [("x", "m"), ("v", "m/s"), ("a", "m/s^2")];
/// The same of a rotary model.
const ROTATION: [(&str, &str); 3] = [("x", "rad"), ("v", "rad/s"), ("a", "rad/s^2")];

/// What moves: position, speed and acceleration together, or one quantity of any other kind.
#[derive(Clone, PartialEq, Debug)]
enum Moves {
    Motion { rotary: bool },
    Other(String, Unit),
}

impl Moves {
    /// Its quantities with their units: of a motion, each is the derivative of the one before.
    fn quantities(&self) -> Vec<(String, String)> {
        match self {
            Moves::Motion { rotary } => {
                let all = if *rotary { ROTATION } else { MOTION };
                all.iter().map(|(name, unit)| ((*name).to_string(), (*unit).to_string())).collect()
            }
            Moves::Other(name, unit) => vec![(name.clone(), Unit::si(unit.dimension).to_string())],
        }
    }

    /// Which derivative of the series a quantity is.
    fn order(&self, name: &str) -> Option<usize> {
        self.quantities().iter().position(|(other, _)| other == name)
    }
}

/// A Fourier series that is faded in over its first period.
#[derive(Clone, Debug)]
struct Series {
    /// The lowest frequency in Hz.
    base: f64,
    harmonics: usize,
}

impl Series {
    fn period(&self) -> f64 {
        1.0 / self.base
    }

    /// Fading at a time, with two derivatives: 10 τ³ − 15 τ⁴ + 6 τ⁵ of τ = t / period.
    fn fade(&self, t: f64) -> [f64; 3] {
        let tau = t / self.period();
        if tau >= 1.0 {
            return [1.0, 0.0, 0.0];
        }
        let (first, second) = (self.base, self.base * self.base);
        [
            tau * tau * tau * (10.0 + tau * (6.0 * tau - 15.0)),
            30.0 * tau * tau * (1.0 + tau * (tau - 2.0)) * first,
            60.0 * tau * (1.0 + tau * (2.0 * tau - 3.0)) * second,
        ]
    }

    /// Position, speed and acceleration at a time for these coefficients of position: sines, then cosines.
    fn at(&self, coefficients: &[f64], t: f64) -> [f64; 3] {
        let (sin, cos) = (ElementaryFunction::unary(Unary::Sin), ElementaryFunction::unary(Unary::Cos));
        let mut sum = [0.0; 3];
        for k in 0..self.harmonics {
            let w = 2.0 * PI * self.base * (k + 1) as f64;
            let (s, c) = (sin.at(w * t), cos.at(w * t));
            let (a, b) = (coefficients[k], coefficients[self.harmonics + k]);
            sum[0] += a * s + b * c;
            sum[1] += w * (a * c - b * s);
            sum[2] -= w * w * (a * s + b * c);
        }
        let [f, df, ddf] = self.fade(t);
        [f * sum[0], f * sum[1] + df * sum[0], f * sum[2] + 2.0 * df * sum[1] + ddf * sum[0]]
    }

    /// The series as functions of a text, with these names of coefficients, and their declarations as arguments:
    /// a quantity of this unit, and two derivatives.
    fn text(&self, out: &mut String, coefficients: &[String], arguments: &str, unit: &str) {
        let w = format!("2 * pi * {} Hz", abi::format::plain(self.base));
        let tau = format!("time * {} Hz", abi::format::plain(self.base));
        let [series, rate, bend] = self.sums(coefficients, "time", &w);
        let [fading, fading_rate, fading_bend] = self.fading(&tau);
        let pass = coefficients.join(", ");
        let (first, second) = (format!("{unit}/s"), format!("{unit}/s^2"));
        let _ = write!(
            out,
            "fn fading(time [s]) [1] = {fading}\n\
             fn fading_rate(time [s]) [1/s] = {fading_rate}\n\
             fn fading_bend(time [s]) [1/s^2] = {fading_bend}\n\
             fn series(time [s], {arguments}) [{unit}] = {series}\n\
             fn series_rate(time [s], {arguments}) [{first}] = {rate}\n\
             fn series_bend(time [s], {arguments}) [{second}] = {bend}\n\
             fn excite_0(time [s], {arguments}) [{unit}] = fading(time) * series(time, {pass})\n\
             fn excite_1(time [s], {arguments}) [{first}] = fading(time) * series_rate(time, {pass}) + fading_rate(time) * series(time, {pass})\n\
             fn excite_2(time [s], {arguments}) [{second}] = fading(time) * series_bend(time, {pass}) + 2 * fading_rate(time) * series_rate(time, {pass}) + fading_bend(time) * series(time, {pass})\n",
        );
    }

    /// The sums of a series and of its derivatives as expressions of a time and of the angular frequency of its fundamental.
    fn sums(&self, coefficients: &[String], t: &str, w: &str) -> [String; 3] {
        let h = self.harmonics;
        let of = |order: u32| {
            let one = |k: usize| {
                let w = if k == 0 { w.to_string() } else { format!("{} * {w}", k + 1) };
                let (a, b, angle) = (&coefficients[k], &coefficients[h + k], format!("{w} * {t}"));
                match order {
                    0 => format!("{a} * sin({angle}) + {b} * cos({angle})"),
                    1 => format!("{w} * ({a} * cos({angle}) - {b} * sin({angle}))"),
                    _ => format!("-({w})^2 * ({a} * sin({angle}) + {b} * cos({angle}))"),
                }
            };
            (0..h).map(one).collect::<Vec<_>>().join(" + ")
        };
        [of(0), of(1), of(2).replace(" + -(", " - (")]
    }

    /// The fading and its derivatives as expressions of the part of the first period that is over.
    fn fading(&self, tau: &str) -> [String; 3] {
        let base = format!("{} Hz", abi::format::plain(self.base));
        [
            format!("if {tau} < 1 then ({tau})^3 * (10 + {tau} * (6 * {tau} - 15)) else 1"),
            format!("if {tau} < 1 then 30 * ({tau})^2 * (1 + {tau} * ({tau} - 2)) * {base} else 0"),
            format!("if {tau} < 1 then 60 * {tau} * (1 + {tau} * (2 * {tau} - 3)) * ({base})^2 else 0"),
        ]
    }
}

/// `x = -2 mm .. 2 mm`
#[derive(Clone, Debug)]
struct Limit {
    name: String,
    low: f64,
    high: f64,
    unit: Unit,
}

impl Limit {
    /// `-2 mm .. 2 mm`
    fn range(&self) -> String {
        let [low, high] = [self.low, self.high].map(|end| show(end, &self.unit, 4));
        format!("{low} .. {high}")
    }

    /// The part of it that the least and the greatest value reach.
    fn share(&self, (low, high): (f64, f64)) -> f64 {
        (high / self.high).max(low / self.low)
    }

    fn read(text: &str) -> Result<Limit, String> {
        let wrong = || format!("--limit: `{text}` is none; write it as 'x = -2 mm .. 2 mm'");
        let (name, range) = text.split_once('=').ok_or_else(wrong)?;
        let (low, high) = range.split_once("..").ok_or_else(wrong)?;
        let read = |text: &str| quantity::parse(text.trim()).map_err(|why| format!("--limit: {why}"));
        let ((low, unit), (high, other)) = (read(low)?, read(high)?);
        if unit.dimension != other.dimension {
            return Err(format!("--limit: {unit} and {other} do not fit together"));
        }
        if !(low < 0.0 && high > 0.0 && low.is_finite() && high.is_finite()) {
            return Err(format!(
                "--limit: `{}` must lie around 0, since the motion begins and ends there",
                text.trim()
            ));
        }
        Ok(Limit { name: name.trim().into(), low, high, unit })
    }
}

/// The name of the table of times that the design runs over.
const TABLE: &str = "(design).csv";

/// A fit whose motion is designed.
struct Design {
    runs: Runs,
    /// The unknowns of the fit, without those of the motion.
    unknowns: Vec<Unknown>,
    series: Series,
    moves: Moves,
    /// Limits of what moves.
    limits: Vec<Limit>,
    /// Limits of other quantities, each with its slot: whether a motion keeps them follows from its runs.
    watched: Vec<(Limit, Slot)>,
    /// Instants at which limits are checked: position, speed and acceleration there for each coefficient alone.
    shapes: Vec<Vec<[f64; 3]>>,
    /// Deviation of each compared quantity.
    noise: Vec<f64>,
    steps: Vec<f64>,
}

/// What a motion promises for one set of values.
struct Promise {
    log_determinant: f64,
    /// Standard deviation of each unknown, in its scale.
    deviations: Vec<f64>,
    /// The least determined combination: its sensitivity and direction.
    weakest: (f64, Vec<f64>),
}

fn with<T>(of: impl FnOnce(&Elementary) -> T) -> T {
    let (exp, log) = (ElementaryFunction::exp(), ElementaryFunction::log());
    of(&Elementary { exp: &|x| exp.at(x), log: &|x| log.at(x) })
}

impl Design {
    /// Coefficients of a shape, scaled to the tightest limit.
    fn scaled(&self, shape: &[f64]) -> Vec<f64> {
        let h = self.series.harmonics;
        // Equal numbers are equal speeds.
        let coefficients: Vec<f64> = (0..2 * h).map(|k| shape[k] / (k % h + 1) as f64).collect();
        let mut most = 0.0_f64;
        for instant in &self.shapes {
            for limit in &self.limits {
                let order = self.moves.order(&limit.name).expect("limits are of the motion");
                let value: f64 = coefficients.iter().zip(instant).map(|(c, unit)| c * unit[order]).sum();
                most = most.max(value / limit.high).max(value / limit.low);
            }
        }
        if most == 0.0 {
            return vec![0.0; 2 * h];
        }
        coefficients.iter().map(|c| c / most).collect()
    }

    /// Least and greatest value of each watched quantity for some motions, each with all sets of values; none where a run
    /// fails.
    fn extremes(&self, motions: &[Vec<f64>], sets: &[Vec<f64>]) -> Vec<Option<Vec<(f64, f64)>>> {
        if self.watched.is_empty() {
            return vec![Some(Vec::new()); motions.len()];
        }
        let slots: Vec<Slot> = self.watched.iter().map(|(_, slot)| *slot).collect();
        let point = |motion: &Vec<f64>| sets.iter().map(|set| [&set[..], motion].concat()).collect::<Vec<_>>();
        let points: Vec<Vec<f64>> = motions.iter().flat_map(point).collect();
        let part = &self.runs.parts[0];
        let all = part.sampled_all(&points, self.steps[0], &slots);
        let one = |runs: &[Result<Vec<f64>, String>]| {
            let mut out = vec![(f64::INFINITY, f64::NEG_INFINITY); slots.len()];
            for values in runs {
                for row in values.as_ref().ok()?.chunks(slots.len()) {
                    for ((low, high), value) in out.iter_mut().zip(row).filter(|(_, value)| value.is_finite()) {
                        (*low, *high) = (low.min(*value), high.max(*value));
                    }
                }
            }
            Some(out)
        };
        all.chunks(sets.len()).map(one).collect()
    }

    /// The part of their limits that watched quantities reach for some motions; infinite where a run fails.
    fn shares(&self, motions: &[Vec<f64>], sets: &[Vec<f64>]) -> Vec<f64> {
        let most = |all: Vec<(f64, f64)>| {
            self.watched.iter().zip(all).map(|((limit, _), reached)| limit.share(reached)).fold(0.0, f64::max)
        };
        self.extremes(motions, sets).into_iter().map(|one| one.map_or(f64::INFINITY, most)).collect()
    }

    /// Motions, each made smaller until the watched quantities keep their limits for all sets of values, by secant and
    /// bisection in turn. At rest all keep them, which [`Design::leaves_at_rest`] checks before.
    fn kept(&self, motions: Vec<Vec<f64>>, sets: &[Vec<f64>]) -> Vec<Vec<f64>> {
        if self.watched.is_empty() || sets.is_empty() {
            return motions;
        }
        let of = |part: f64, motion: &[f64]| motion.iter().map(|c| part * c).collect::<Vec<f64>>();
        let rest = self.shares(&[of(0.0, &motions[0])], sets)[0];
        // Of each motion a part that keeps the limits, and one that does not, each with what is reached.
        let whole = self.shares(&motions, sets);
        let mut ends: Vec<((f64, f64), (f64, f64))> = whole.iter().map(|share| ((0.0, rest), (1.0, *share))).collect();
        for turn in 0..MOST_SCALINGS {
            let is_open =
                |k: &usize| ends[*k].1.1 > 1.0 && ends[*k].0.1 < NEAR_LIMIT && ends[*k].1.0 - ends[*k].0.0 > 1e-3;
            let open: Vec<usize> = (0..motions.len()).filter(is_open).collect();
            let parts = open.iter().map(|k| {
                let ((inner, reached), (outer, beyond)) = ends[*k];
                let secant = (0.5 * (1.0 + NEAR_LIMIT) - reached) / (beyond - reached);
                let part = if turn % 2 == 0 && secant > 0.0 { secant.clamp(0.02, 0.98) } else { 0.5 };
                inner + part * (outer - inner)
            });
            let parts: Vec<f64> = parts.collect();
            let tried: Vec<Vec<f64>> = open.iter().zip(&parts).map(|(k, part)| of(*part, &motions[*k])).collect();
            for ((k, part), share) in open.iter().zip(&parts).zip(self.shares(&tried, sets)) {
                if share <= 1.0 { ends[*k].0 = (*part, share) } else { ends[*k].1 = (*part, share) }
            }
        }
        let part =
            |((inner, _), (outer, share)): &((f64, f64), (f64, f64))| if *share <= 1.0 { *outer } else { *inner };
        motions.iter().zip(&ends).map(|(motion, ends)| of(part(ends), motion)).collect()
    }

    /// A watched quantity that leaves its limits without motion.
    fn leaves_at_rest(&self, sets: &[Vec<f64>]) -> Option<&Limit> {
        if self.watched.is_empty() {
            return None;
        }
        let rest = self.extremes(&[vec![0.0; 2 * self.series.harmonics]], sets).remove(0)?;
        let limits = self.watched.iter().map(|(limit, _)| limit);
        limits.zip(rest).find(|(limit, (low, high))| *high > limit.high || *low < limit.low).map(|(limit, _)| limit)
    }

    /// What motions promise for each set of values; none where a run fails or an unknown changes nothing.
    fn promises(&self, motions: &[Vec<f64>], sets: &[Vec<f64>]) -> Vec<Vec<Option<Promise>>> {
        let n = self.unknowns.len();
        let mut points = Vec::new();
        for motion in motions {
            for set in sets {
                for k in 0..n {
                    for sign in [1.0, -1.0] {
                        let mut values = set.clone();
                        values[k] += sign * DIFFERENCE * self.unknowns[k].slope(set[k]);
                        points.push([values, motion.clone()].concat());
                    }
                }
            }
        }
        let all = self.runs.with(&self.steps).run(Way::Whole, &points);
        let one = |runs: &[Result<Vec<Vec<f64>>, String>]| {
            let column = |pair: &[Result<Vec<Vec<f64>>, String>]| -> Option<Vec<f64>> {
                let (Ok(up), Ok(down)) = (&pair[0], &pair[1]) else { return None };
                let items = up.iter().zip(down).zip(&self.noise);
                let of = |((up, down), noise): ((&Vec<f64>, &Vec<f64>), &f64)| {
                    let scale = 0.5 / (DIFFERENCE * noise);
                    up.iter().zip(down).map(|(a, b)| scale * (a - b)).collect::<Vec<f64>>()
                };
                Some(items.flat_map(of).collect())
            };
            let columns: Vec<Vec<f64>> = runs.chunks(2).map(column).collect::<Option<_>>()?;
            let information = Information::of(&columns)?;
            let zeros = vec![0.0; columns[0].len()];
            let log_determinant = with(|with| information.log_determinant(with));
            let deviations = information.deviations();
            let weakest = match deviations.iter().any(|sd| *sd > 0.5 / LEAST_SENSITIVITY) {
                true => {
                    let singular = runtime::fit::least_squares::singular(columns, &zeros);
                    (*singular.values.last()?, singular.vectors.last()?.clone())
                }
                false => (f64::INFINITY, Vec::new()),
            };
            Some(Promise { log_determinant, deviations, weakest })
        };
        let of_motion = |runs: &[Result<Vec<Vec<f64>>, String>]| runs.chunks(2 * n).map(one).collect();
        all.chunks(2 * n * sets.len()).map(of_motion).collect()
    }

    /// Minus the criterion of each shape: the mean log-determinant.
    fn judge(&self, shapes: &[Vec<f64>], sets: &[Vec<f64>]) -> Vec<f64> {
        let motions = self.kept(shapes.iter().map(|shape| self.scaled(shape)).collect(), sets);
        let mean = |all: Vec<Option<Promise>>| {
            let count = all.len() as f64;
            all.iter().map(|one| one.as_ref().map_or(FAILED, |one| -one.log_determinant)).sum::<f64>() / count
        };
        self.promises(&motions, sets).into_iter().map(mean).collect()
    }
}

/// `fric excite`
pub fn excite(args: &args::Excite, terminal: &mut Terminal) -> End {
    match designed(args, terminal) {
        Ok(end) => end,
        Err((why, end)) => {
            if !why.is_empty() {
                terminal.error(&why);
            }
            end
        }
    }
}

fn failed(why: impl Into<String>) -> (String, End) {
    (why.into(), End::Failed)
}

fn misused(why: impl Into<String>) -> (String, End) {
    (why.into(), End::Misused)
}

fn designed(args: &args::Excite, terminal: &mut Terminal) -> Result<End, (String, End)> {
    let begin = Instant::now();
    let limits: Vec<Limit> =
        args.limits.iter().map(|text| Limit::read(text)).collect::<Result<_, _>>().map_err(misused)?;
    let mut watch = Stopwatch::start("read");
    let loaded = load(&args.file, terminal, &mut watch).ok_or_else(|| failed(""))?;
    if sound(&loaded, args.json || args.quiet, terminal, &mut watch).is_err() {
        return Err(failed(""));
    }
    let name = super::fit::only(&args.file, args.fit.as_deref(), &loaded).map_err(failed)?;
    let fit = compile::find_fit(&loaded, &name).expect("it has been chosen");
    let series = Series { base: args.base, harmonics: args.harmonics };
    let moves = moves(&loaded, fit, &limits).map_err(failed)?;
    let (limits, watched): (Vec<Limit>, Vec<Limit>) =
        limits.into_iter().partition(|limit| moves.order(&limit.name).is_some());
    let text = text(&loaded, fit, (&series, &moves), &watched, args).map_err(failed)?;
    let length = series.period() + args.duration;
    let rows = (length * args.rate).round();
    if rows > MOST_ROWS {
        return Err(misused(format!("{rows} rows are too many; take a lower --rate or a shorter time")));
    }
    let columns = fit_columns(&loaded, fit).len();
    let mut table = String::new();
    for k in 0..=rows as usize {
        let _ = writeln!(table, "{:?}{}", k as f64 / args.rate, ";0".repeat(columns));
    }
    let place = args.file.display().to_string();
    let sources = NamedFiles::new(vec![(place.clone(), TABLE.into(), TABLE.into(), table)]);
    let mut changed = load_text(&place, &text, &sources, terminal, &mut watch).ok_or_else(|| failed(""))?;
    let compiled = match compile::fit(&mut changed, &sources, &name, &Options::default(), &mut Vec::new()) {
        Ok(compiled) => compiled.into_iter().next().expect("it has been compiled"),
        Err(errors) => {
            reported(&changed, &errors, terminal);
            return Err(failed(""));
        }
    };
    let runs = Runs::new(compiled, args.threads);
    let count_of = runs.unknowns.len() - 2 * series.harmonics;
    let written: Vec<f64> = runs.unknowns.iter().map(|one| one.start).collect();
    let (all, items) = (runs.asked(&written), runs.compared_whole());
    let noise: Vec<f64> = items.iter().filter_map(|item| item.sd).collect();
    if noise.len() < items.len() {
        return Err(failed(format!(
            "fit `{name}` does not say how exact its measurement is: `minimise rms(F - data.F) / 5 mN`, with the standard deviation"
        )));
    }
    let scaled: Vec<Unknown> = all[..count_of].to_vec();
    let unknowns: Vec<Unknown> = scaled.iter().map(|one| Unknown { above: None, ..*one }).collect();
    let instants = 2 * INSTANTS * series.harmonics;
    let shape = |at: usize| {
        let t = 2.0 * series.period() * at as f64 / instants as f64;
        let one = |k: usize| {
            let mut coefficients = vec![0.0; 2 * series.harmonics];
            coefficients[k] = 1.0;
            series.at(&coefficients, t)
        };
        (0..2 * series.harmonics).map(one).collect::<Vec<[f64; 3]>>()
    };
    let shapes = (0..instants).map(shape).collect();
    let steps = runs.steps();
    // The text has a plot for each of them, in their order.
    let plots = runs.parts[0].varying.plots.iter().flat_map(|plot| &plot.series).map(|series| series.slot);
    let watched = watched.into_iter().zip(plots).collect();
    let design = Design { runs, unknowns, series, moves, limits, watched, shapes, noise, steps };
    let mut sine = vec![0.0; 2 * design.series.harmonics];
    sine[0] = 1.0;
    let sets = match &args.known {
        Some(path) => vec![known(path, &design).map_err(failed)?],
        None => drawn(&design, &scaled, args.seed),
    };
    if let Some(limit) = design.leaves_at_rest(&sets) {
        let values = if sets.len() == 1 { "with these values" } else { "for some values in the ranges" };
        return Err(failed(format!(
            "--limit: `{}` leaves {} without any motion, {values}; widen the limit{}",
            limit.name,
            limit.range(),
            if args.known.is_some() { "" } else { ", or give values by --known" }
        )));
    }
    // A sine may leave an unknown undetermined; all harmonics together are the start of the search.
    let start = vec![1.0; 2 * design.series.harmonics];
    let best = with(|with| {
        let search = Search { step: 0.5, evaluations: args.evaluations, seed: args.seed };
        cma_es::minimise(&start, search, with, &mut |shapes| design.judge(shapes, &sets))
    });
    let mut motions = design.kept(vec![design.scaled(&best.0), design.scaled(&sine)], &sets);
    let mut promises = design.promises(&motions, &sets);
    let motion = motions.remove(0);
    let reached = design.extremes(std::slice::from_ref(&motion), &sets).remove(0).unwrap_or_default();
    let (of_sine, of_best) = (promises.remove(1), promises.remove(0));
    let of_best: Vec<Promise> = of_best.into_iter().flatten().collect();
    if of_best.is_empty() {
        return Err(failed(format!(
            "no motion within these limits can be run and moves every unknown of `{name}`: widen the limits, or vary fewer"
        )));
    }
    let of_sine: Vec<Promise> = of_sine.into_iter().flatten().collect();
    let text = answer_text(&design, &motion, args, &name);
    let path = &args.output;
    let table = path.with_extension("csv");
    for (path, text) in [(path, &text), (&table, &rows_of(&design, &motion, args))] {
        if let Err(error) = project::write(path, text.as_bytes()) {
            return Err(failed(format!("cannot write {}: {error}", path.display())));
        }
    }
    let report = Report {
        design: &design,
        best: &of_best,
        sine: &of_sine,
        reached: &reached,
        name: &name,
        args,
        draws: sets.len(),
    };
    if args.json {
        terminal.line(&report.json(&motion).to_string());
    } else if !args.quiet {
        terminal.line(&terminal.styled(Style::Bold, &name));
        terminal.print(&report.words(args.evaluations, begin.elapsed().as_secs_f64()));
        terminal.line(&format!("  wrote {}, {}", path.display(), table.display()));
    }
    Ok(End::Fine)
}

/// The columns of the recording that its run reads, and whether they are a motion.
fn moves(loaded: &Loaded, fit: &ast::Fit, limits: &[Limit]) -> Result<Moves, String> {
    let name = &fit.name.text;
    if fit.body.iter().any(|statement| matches!(statement, FitStatement::Case(_))) {
        return Err(format!(
            "`fric excite` designs one kind of experiment, and fit `{name}` has cases; write a fit for each"
        ));
    }
    let run = fit.body.iter().find_map(|statement| match statement {
        FitStatement::Experiment(ExperimentStatement::Run(run)) => Some(run),
        _ => None,
    });
    let read = columns_of(run.into_iter().flat_map(|run| run.instance.paths()));
    let is_motion = |column: &String| MOTION.iter().any(|(name, _)| name == column);
    let moves = match &read[..] {
        [] => {
            return Err(format!(
                "the run of fit `{name}` reads no column, so there is no motion to design: `run LuGre(v = data.v)`"
            ));
        }
        all if all.iter().all(is_motion) => Moves::Motion { rotary: run.is_some_and(|run| run.instance.rotary) },
        [one] => {
            let unit =
                fit_columns_all(loaded, fit).into_iter().find(|(column, _)| column == one).and_then(|(_, unit)| unit);
            let unit = unit.ok_or_else(|| format!("give the column `{one}` of fit `{name}` its unit: `{one} [N]`"))?;
            Moves::Other(one.clone(), Unit::parse(&unit).map_err(|part| format!("unknown unit `{part}`"))?)
        }
        all => {
            return Err(format!(
                "the run of fit `{name}` reads {}: a motion is x, v or a, or one column alone",
                all.join(", ")
            ));
        }
    };
    let with_units = fit_columns(loaded, fit);
    if let Some(column) = compared_columns(fit).iter().find(|name| with_units.iter().all(|(other, _)| other != *name)) {
        return Err(format!(
            "fit `{name}` compares `data.{column}`, whose unit is not written: `{column} [N]` in `data`, for a column of the recording"
        ));
    }
    let quantities = moves.quantities();
    let known = |name: &str| {
        let found = quantities.iter().find(|(other, _)| other == name);
        found.map(|(_, unit)| Unit::parse(unit).expect("it is known").dimension)
    };
    for limit in limits {
        if let Some(dimension) = known(&limit.name).filter(|dimension| *dimension != limit.unit.dimension) {
            return Err(format!("--limit: `{}` is {}, not {}", limit.name, dimension.describe(), limit.unit));
        }
    }
    // Other quantities make a motion smaller, from one that is within limits of its own.
    if limits.iter().all(|limit| known(&limit.name).is_none()) {
        let all = quantities.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>().join(", ");
        return Err(format!(
            "--limit: what moves needs a limit of its own, as in `--limit '{} = -2 {1} .. 2 {1}'`; it is one of {all}",
            quantities[0].0, quantities[0].1
        ));
    }
    Ok(moves)
}

/// The columns of the recording that these paths name, sorted.
fn columns_of<'a>(paths: impl IntoIterator<Item = &'a ast::Path>) -> Vec<String> {
    let names = paths.into_iter().filter_map(|path| Some(path.column()?.text.clone()));
    names.collect::<BTreeSet<String>>().into_iter().collect()
}

/// All named columns of a fit but the time, with their units as written.
fn fit_columns_all(loaded: &Loaded, fit: &ast::Fit) -> Vec<(String, Option<String>)> {
    let data = fit.body.iter().find_map(|statement| match statement {
        FitStatement::Experiment(ExperimentStatement::Data(data)) => Some(data),
        _ => None,
    });
    let named = data.into_iter().flat_map(|data| &data.columns);
    let named = named.filter(|column| !matches!(column.name.text.as_str(), "t" | "_"));
    named
        .map(|column| {
            (column.name.text.clone(), column.unit.as_ref().map(|unit| loaded.files.slice(unit.span).to_string()))
        })
        .collect()
}

/// The columns that are compared.
fn compared_columns(fit: &ast::Fit) -> Vec<String> {
    let compared = fit.body.iter().find_map(|statement| match statement {
        FitStatement::Minimise(minimise) => Some(&minimise.items),
        _ => None,
    });
    columns_of(compared.into_iter().flatten().flat_map(Expr::paths))
}

/// The columns that are compared, with their units: those of the file whose units are written.
fn fit_columns(loaded: &Loaded, fit: &ast::Fit) -> Vec<(String, String)> {
    let all = fit_columns_all(loaded, fit);
    let unit = |name: &String| all.iter().find(|(other, _)| other == name).and_then(|(_, unit)| unit.clone());
    compared_columns(fit).into_iter().filter_map(|name| unit(&name).map(|unit| (name, unit))).collect()
}

/// The text of the file with the fit changed: its run follows a series whose coefficients are unknowns.
fn text(
    loaded: &Loaded,
    fit: &ast::Fit,
    (series, moves): (&Series, &Moves),
    watched: &[Limit],
    args: &args::Excite,
) -> Result<String, String> {
    let slice = |span| loaded.files.slice(span);
    let root = loaded.files.get(loaded.root());
    let whole = &root.text;
    let h = series.harmonics;
    let (_, unit) = moves.quantities().remove(0);
    let coefficients: Vec<String> = (0..2 * h).map(|k| format!("excite_c{k}")).collect();
    let arguments = coefficients.iter().map(|name| format!("{name} [{unit}]")).collect::<Vec<_>>().join(", ");
    let mut body = format!("fit {} {{\n", fit.name.text);
    for statement in &fit.body {
        match statement {
            FitStatement::Experiment(ExperimentStatement::Run(run)) => {
                let mut columns: Vec<(&ast::Path, &ast::Name)> =
                    run.instance.paths().into_iter().filter_map(|path| Some((path, path.column()?))).collect();
                let begin = run.instance.span.start;
                let mut instance = slice(run.instance.span).to_string();
                columns.sort_by_key(|(path, _)| std::cmp::Reverse(path.span.start));
                for (path, column) in columns {
                    let order = moves.order(&column.text).expect("it is part of the motion");
                    let call = format!("excite_{order}(t, {})", coefficients.join(", "));
                    let at = (path.span.start - begin) as usize..(path.span.end - begin) as usize;
                    instance.replace_range(at, &call);
                }
                let _ = writeln!(body, "run {instance}");
            }
            FitStatement::Experiment(ExperimentStatement::Data(_)) => {
                let columns = fit_columns(loaded, fit);
                let named: Vec<String> = columns.iter().map(|(name, unit)| format!(", {name} [{unit}]")).collect();
                let _ = writeln!(body, "data \"{TABLE}\" (t [s]{})", named.concat());
            }
            FitStatement::Vary(_, span) => {
                let _ = writeln!(body, "{}", slice(*span));
            }
            FitStatement::Minimise(minimise) => {
                let items: Vec<&str> = minimise.items.iter().map(|item| slice(item.span)).collect();
                let _ = writeln!(body, "minimise {} after {} s", items.join(", "), abi::format::plain(series.period()));
            }
            FitStatement::Experiment(ExperimentStatement::Solver(one)) => {
                let _ = writeln!(body, "{}", slice(one.span));
            }
            FitStatement::Experiment(ExperimentStatement::Allow(one)) => {
                let _ = writeln!(body, "{}", slice(one.span));
            }
            FitStatement::Experiment(ExperimentStatement::Sweep(_)) => {
                return Err(format!("fit `{}` has several laws; write a fit for the one to be excited", fit.name.text));
            }
            FitStatement::Case(_)
            | FitStatement::Validate(..)
            | FitStatement::Experiment(
                ExperimentStatement::Plot(_)
                | ExperimentStatement::Tune(..)
                | ExperimentStatement::Expect(_)
                | ExperimentStatement::Record(_)
                | ExperimentStatement::Derived(_),
            ) => {}
        }
    }
    for Limit { name, unit, .. } in watched {
        let _ = writeln!(body, "plot {name} [{unit}]");
    }
    let free = coefficients.iter().map(|name| format!("{name} = 0 {unit} in -1e9 {unit} .. 1e9 {unit}"));
    let _ = writeln!(body, "vary {}", free.collect::<Vec<_>>().join(", "));
    let solver = fit.body.iter().any(|one| matches!(one, FitStatement::Experiment(ExperimentStatement::Solver(_))));
    if !solver {
        let _ = writeln!(body, "solver expo step {} s", abi::format::plain(1.0 / args.rate));
    }
    body += "}\n";
    let mut functions = String::new();
    series.text(&mut functions, &coefficients, &arguments, &unit);
    let (from, to) = (fit.span.start as usize, fit.span.end as usize);
    Ok(format!("{}{body}{}\n{functions}", &whole[..from], &whole[to..]))
}

/// Values of a fit so far, from its JSON.
fn known(path: &Path, design: &Design) -> Result<Vec<f64>, String> {
    let why = |why: String| format!("--known {}: {why}", path.display());
    let text = std::fs::read_to_string(path).map_err(|error| why(error.to_string()))?;
    let read: Value = serde_json::from_str(&text).map_err(|error| why(error.to_string()))?;
    let all = read["parameters"].as_array().ok_or_else(|| why("it is no answer of `fric fit`".into()))?;
    let one = |unknown: &compile::FitUnknown| {
        let found = all.iter().find(|one| one["path"] == *unknown.path);
        let value = found.and_then(|one| one["value"].as_f64());
        let unit = found.and_then(|one| Unit::parse(one["unit"].as_str()?).ok());
        match (value, unit) {
            (Some(value), Some(unit)) => Ok(unit.to_si(value)),
            _ => Err(why(format!("it has no value of `{}`", unknown.label))),
        }
    };
    design.runs.unknowns[..design.unknowns.len()].iter().map(one).collect()
}

/// Sets of values all over the ranges that can be run.
fn drawn(design: &Design, scaled: &[Unknown], seed: u64) -> Vec<Vec<f64>> {
    let start = design.scaled(&vec![1.0; 2 * design.series.harmonics]);
    let mut chance = Chance(seed);
    with(|with| {
        let scale = Scale { unknowns: scaled, with: *with };
        let (low, high) = scale.bounds();
        let mut sets: Vec<Vec<f64>> = Vec::new();
        for _ in 0..MOST_DRAWS {
            let x: Vec<f64> = low.iter().zip(&high).map(|(low, high)| chance.between(*low, *high)).collect();
            let values = scale.values(&x);
            if design.promises(std::slice::from_ref(&start), std::slice::from_ref(&values))[0][0].is_some() {
                sets.push(values);
            }
            if sets.len() == DRAWS {
                break;
            }
        }
        if sets.is_empty() {
            sets.push(scaled.iter().map(|one| one.start).collect());
        }
        sets
    })
}

/// The motion as a text: a model with the series, and an experiment that shows it. The model is a straight one also for
/// a rotary fit: inside of a rotary model it turns into its twin.
fn answer_text(design: &Design, motion: &[f64], args: &args::Excite, name: &str) -> String {
    let rotary = design.moves == Moves::Motion { rotary: true };
    let straight = if rotary { Moves::Motion { rotary: false } } else { design.moves.clone() };
    let outputs = straight.quantities();
    let unit = &outputs[0].1;
    let plain = abi::format::plain;
    let length = plain(design.series.period() + args.duration);
    let folder = args.output.parent().filter(|folder| !folder.as_os_str().is_empty());
    let file = project::relative(&args.file, folder.unwrap_or(Path::new(".")));
    let names: Vec<String> = (0..motion.len()).map(|k| format!("c{k}")).collect();
    let mut out = format!(
        "/// A motion for `fit {name}` of {file}, by `fric excite`: faded in over {}, then {} that count.\nmodel Excite {{\n",
        duration(design.series.period(), 3),
        duration(args.duration, 3)
    );
    for (name, c) in names.iter().zip(motion) {
        let _ = writeln!(out, "  param {name} = {} {unit}", plain(*c));
    }
    let base = plain(design.series.base);
    let [series, rate, bend] = design.series.sums(&names, "t", "w");
    let [fading, fading_rate, fading_bend] = design.series.fading("tau");
    let _ = write!(
        out,
        "  let w = 2 * pi * {base} Hz\n  let tau = t * {base} Hz\n  let fading = {fading}\n  let series = {series}\n"
    );
    let values = [
        "fading * series",
        "fading * series_rate + fading_rate * series",
        "fading * series_bend + 2 * fading_rate * series_rate + fading_bend * series",
    ];
    if outputs.len() > 1 {
        let _ = write!(
            out,
            "  let fading_rate = {fading_rate}\n  let fading_bend = {fading_bend}\n  let series_rate = {rate}\n  let series_bend = {bend}\n"
        );
    }
    for ((name, unit), value) in outputs.iter().zip(values) {
        let _ = writeln!(out, "  output {name} [{unit}] = {value}");
    }
    let twin = if rotary { "rotary " } else { "" };
    let _ = writeln!(
        out,
        "}}\n\nexperiment excite {{\n  run {twin}Excite() for {length} s\n  solver rk4 step {} s",
        plain(1.0 / args.rate)
    );
    for (name, _) in &outputs {
        let _ = writeln!(out, "  plot {name}");
    }
    for limit in &design.limits {
        let one = |value: f64| format!("{} {}", significant(limit.unit.from_si(1.001 * value), 6), limit.unit);
        let (high, low) = (one(limit.high), one(limit.low));
        let _ = writeln!(out, "  expect max({0}) < {high}\n  expect min({0}) > {low}", limit.name);
    }
    out += "}\n";
    grammar::format::format(&out, 120).unwrap_or(out)
}

/// The motion as a table.
fn rows_of(design: &Design, motion: &[f64], args: &args::Excite) -> String {
    let length = design.series.period() + args.duration;
    let quantities = design.moves.quantities();
    let headings: Vec<String> = quantities.iter().map(|(name, unit)| format!(",{name} [{unit}]")).collect();
    let mut out = format!("t [s]{}\n", headings.concat());
    for k in 0..=(length * args.rate).round() as usize {
        let t = k as f64 / args.rate;
        let all = design.series.at(motion, t);
        let cells: Vec<String> = all.iter().take(quantities.len()).map(|value| format!(",{value:?}")).collect();
        let _ = writeln!(out, "{t:?}{}", cells.concat());
    }
    out
}

/// What is shown of a design.
struct Report<'a> {
    design: &'a Design,
    best: &'a [Promise],
    sine: &'a [Promise],
    /// Least and greatest value of each watched quantity.
    reached: &'a [(f64, f64)],
    name: &'a str,
    args: &'a args::Excite,
    draws: usize,
}

impl Report<'_> {
    /// The mean log-determinant.
    fn criterion(of: &[Promise]) -> f64 {
        of.iter().map(|one| one.log_determinant).sum::<f64>() / of.len() as f64
    }

    /// Median and worst deviation of an unknown, in its scale.
    fn deviations(of: &[Promise], k: usize) -> (f64, f64) {
        let mut all: Vec<f64> = of.iter().map(|one| one.deviations[k]).collect();
        all.sort_by(f64::total_cmp);
        (all[all.len() / 2], all[all.len() - 1])
    }

    /// A deviation in words: a part of the value, or a quantity.
    fn shown(&self, k: usize, sd: f64) -> String {
        let unknown = &self.design.unknowns[k];
        let unit = &self.design.runs.unknowns[k].unit;
        match unknown.is_logarithmic() {
            true => format!("{} %", significant(100.0 * sd, 2)),
            false => show(sd * (unknown.high - unknown.low), unit, 2),
        }
    }

    /// The combination that the worst draw does not determine.
    fn weakest(&self) -> Option<String> {
        let worst = self.best.iter().min_by(|a, b| a.weakest.0.total_cmp(&b.weakest.0))?;
        let (sensitivity, direction) = &worst.weakest;
        if *sensitivity >= LEAST_SENSITIVITY {
            return None;
        }
        let largest = direction.iter().map(|c| c.abs()).fold(0.0, f64::max);
        let named = direction.iter().zip(&self.design.runs.unknowns).filter(|(c, _)| c.abs() > 0.2 * largest);
        Some(named.map(|(_, unknown)| format!("`{}`", unknown.label)).collect::<Vec<_>>().join(" with "))
    }

    fn words(&self, evaluations: usize, seconds: f64) -> String {
        let Report { design, best, sine, args, draws, .. } = *self;
        let of =
            if draws == 1 { "the values known".to_string() } else { format!("{draws} sets of values in the ranges") };
        let mut out = format!(
            "  {} harmonics of {} Hz for {}, {} motions judged for {of} in {}\n",
            args.harmonics,
            significant(args.base, 4),
            duration(args.duration, 3),
            count(evaluations as u64),
            duration(seconds, 3)
        );
        let mut table = vec![vec!["unknown".to_string(), "±".into(), "worst".into(), "± by a sine".into()]];
        for (k, unknown) in design.runs.unknowns[..design.unknowns.len()].iter().enumerate() {
            let (sd, worst) = Report::deviations(best, k);
            let by_sine =
                if sine.is_empty() { "not determined".into() } else { self.shown(k, Report::deviations(sine, k).0) };
            table.push(vec![unknown.label.clone(), self.shown(k, sd), self.shown(k, worst), by_sine]);
        }
        let width = |column: usize| table.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
        let widths = [0, 1, 2, 3].map(width);
        for row in &table {
            let cells: Vec<String> = row.iter().zip(widths).map(|(cell, width)| format!("{cell:width$}")).collect();
            let _ = writeln!(out, "  {}", cells.join("  ").trim_end());
        }
        let by_sine = if sine.is_empty() {
            String::new()
        } else {
            format!("; of a sine {}", significant(Report::criterion(sine), 3))
        };
        let _ = writeln!(out, "  log det of the information {}{by_sine}", significant(Report::criterion(best), 3));
        for ((limit, _), (low, high)) in design.watched.iter().zip(self.reached) {
            let binds = limit.share((*low, *high)) >= NEAR_LIMIT;
            let [low, high] = [*low, *high].map(|end| show(end, &limit.unit, 3));
            let what = if binds { "the limit" } else { "not the limit; that of another quantity is met first" };
            let _ = writeln!(out, "  {} reaches {low} .. {high}: {what}", limit.name);
        }
        if let Some(named) = self.weakest() {
            let _ = writeln!(
                out,
                "  warning: for the worst of them this motion does not tell {named}; widen the limits, or vary fewer"
            );
        }
        out
    }

    fn json(&self, motion: &[f64]) -> Value {
        let one = |(k, unknown): (usize, &compile::FitUnknown)| {
            let scale = &self.design.unknowns[k];
            let (sd, worst) = Report::deviations(self.best, k);
            let by_sine = (!self.sine.is_empty()).then(|| Report::deviations(self.sine, k).0);
            json!({
                "name": unknown.label,
                "relative": scale.is_logarithmic(),
                "sd": sd,
                "worst_sd": worst,
                "sine_sd": by_sine,
            })
        };
        let unknowns = self.design.runs.unknowns[..self.design.unknowns.len()].iter().enumerate();
        json!({
            "fit": self.name,
            "unknowns": unknowns.map(one).collect::<Vec<_>>(),
            "log_det": Report::criterion(self.best),
            "sine_log_det": (!self.sine.is_empty()).then(|| Report::criterion(self.sine)),
            "undetermined": self.weakest(),
            "watched": self.design.watched.iter().zip(self.reached).map(|((limit, _), (low, high))| json!({
                "name": limit.name,
                "low": limit.unit.from_si(*low),
                "high": limit.unit.from_si(*high),
                "unit": limit.unit.text,
            })).collect::<Vec<_>>(),
            "base": self.args.base,
            "sines": motion[..self.args.harmonics],
            "cosines": motion[self.args.harmonics..],
        })
    }
}
