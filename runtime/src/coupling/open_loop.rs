//! A control loop that is broken at one signal: its frequency response, and the margins of the loop when it is closed.
//!
//! In: the derivatives of a system with sampled code ([`Hybrid`]), row by row. Out: the loop as one state-space model,
//! in discrete time if the signal is computed at ticks ([`OpenLoop`]), its response, its [`Margins`]. Between ticks the
//! system is integrated exactly with held signals (zero-order hold), and a computation delay of any length is part of
//! the state (Åström, Wittenmark, *Computer-Controlled Systems*, 1997, ch. 2 and 3).
//!
//! L is the loop gain with the sign of negative feedback: L = −y/u, where u replaces y for its users. The closed loop
//! has the characteristic equation 1 + L = 0.

use crate::coupling::eigenvalues::{Mode, modes};
use nalgebra::{Complex, DMatrix, DVector};
use std::f64::consts::{PI, TAU};
use std::fmt;

/// Relative difference of times that counts as rounding.
const SAME: f64 = 1e-9;
/// Points of the frequency grid in each decade.
const GRID: usize = 240;
/// Most instants in one period, and most periods of computation delay.
const MOST: usize = 10_000;

/// The derivatives of a system whose users of y read y + w: states x (n), memory s (m), and w; row-major, SI.
#[derive(Clone, PartialEq, Debug)]
pub struct Hybrid {
    /// n
    pub states: usize,
    /// m
    pub memory: usize,
    /// dx/dt by x, s, w: n × (n + m + 1).
    pub flow: Vec<f64>,
    /// y by x, s: n + m.
    pub output: Vec<f64>,
    /// Period of each sampled block, s.
    pub periods: Vec<f64>,
}

/// Why a loop has no frequency response.
#[derive(Clone, PartialEq, Debug)]
pub enum Unbroken {
    /// The signal does not depend on what replaces it.
    NoLoop,
    /// The signal changes between ticks, although the loop passes through the sampled block of this period.
    Continuous(f64),
    /// Its block has this period, but the loop passes through a block of this longer one.
    Slower(f64, f64),
    /// The period is not a multiple of the period of another block.
    NoMultiple(f64, f64),
    /// Too many instants in a period, or too long a computation delay.
    TooLong,
    /// A derivative is not finite, or eigenvalues cannot be computed.
    NotFinite,
}

impl fmt::Display for Unbroken {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let ms = |time: &f64| format!("{} ms", abi::format::significant(1e3 * time, 6));
        match self {
            Unbroken::NoLoop => write!(f, "no loop passes through it at this point"),
            Unbroken::Continuous(period) => {
                write!(f, "it changes between ticks, but its loop passes through a block of {}", ms(period))
            }
            Unbroken::Slower(own, other) => {
                write!(f, "it is computed every {}, but its loop passes through a block of {}", ms(own), ms(other))
            }
            Unbroken::NoMultiple(own, other) => {
                write!(f, "its period of {} is no multiple of {}, the period of another block", ms(own), ms(other))
            }
            Unbroken::TooLong => write!(f, "the loop has more than {MOST} instants"),
            Unbroken::NotFinite => write!(f, "the derivatives are not finite at this point"),
        }
    }
}

impl std::error::Error for Unbroken {}

/// A broken loop: x' = A x + B u, y = C x + D u, where x' is the rate or, with a period, the next state.
#[derive(Clone, PartialEq, Debug)]
pub struct OpenLoop {
    /// N × N
    a: DMatrix<f64>,
    /// N
    b: DVector<f64>,
    /// N
    c: DVector<f64>,
    /// The direct path.
    d: f64,
    /// Period, s; `None` in continuous time.
    pub period: Option<f64>,
    /// Computation delay in s; in continuous time it is not part of the state.
    pub delay: f64,
}

/// L at one frequency.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Point {
    /// rad/s
    pub frequency: f64,
    /// |L|
    pub gain: f64,
    /// In degrees, without jumps along the grid.
    pub phase: f64,
}

/// A frequency, and a margin there.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct At {
    /// rad/s
    pub frequency: f64,
    /// The margin: a phase in degrees, a factor of the gain, a delay in s.
    pub value: f64,
}

/// The margins of a loop. A margin is missing if L has no such crossing.
#[derive(Clone, PartialEq, Debug)]
pub struct Margins {
    /// Whether the closed loop is stable: all of its deviations decay.
    pub stable: bool,
    /// Whether some deviations stay as they are and all others decay: a contact at rest keeps any small displacement.
    pub neutral: bool,
    /// The smallest phase lag that would make a stable loop unstable, at |L| = 1.
    pub phase: Option<At>,
    /// The smallest factor above 1 by which the gain may grow.
    pub gain: Option<At>,
    /// The largest factor below 1 to which the gain may shrink.
    pub reduction: Option<At>,
    /// The smallest delay that would make the loop unstable, s.
    pub delay: Option<At>,
    /// The greatest sensitivity 1/|1 + L|.
    pub sensitivity: At,
    /// All frequencies with |L| = 1, rad/s.
    pub crossings: Vec<f64>,
}

impl Hybrid {
    /// The broken loop. `tick`: the memory after a tick of the blocks that are due, by x, s, w: m × (n + m + 1).
    /// `delay`: from the instant at which y is computed to the one at which its users receive it, s.
    ///
    /// # Errors
    /// Why there is no loop.
    pub fn open(&self, delay: f64, tick: &mut dyn FnMut(&[bool]) -> Vec<f64>) -> Result<OpenLoop, Unbroken> {
        let (n, m, blocks) = (self.states, self.memory, self.periods.len());
        let size = n + m;
        let width = size + 1;
        let singles: Vec<DMatrix<f64>> = (0..blocks)
            .map(|k| {
                let due: Vec<bool> = (0..blocks).map(|other| other == k).collect();
                DMatrix::from_row_slice(m, width, &tick(&due))
            })
            .collect();
        let flow = DMatrix::from_row_slice(n, width, &self.flow);
        let output = DVector::from_column_slice(&self.output);
        let parts = singles.iter().chain([&flow]);
        if parts.flat_map(|matrix| matrix.iter()).chain(output.iter()).any(|entry| !entry.is_finite()) {
            return Err(Unbroken::NotFinite);
        }
        // The block of each slot of the memory: the one whose tick does not simply keep it.
        let owner = |slot: usize| {
            (0..blocks).find(|k| (0..width).any(|j| singles[*k][(slot, j)] != f64::from(u8::from(j == n + slot))))
        };
        let owners: Vec<Option<usize>> = (0..m).map(owner).collect();
        // Paths from w to y: what w reaches, and what reaches y.
        let depends = |to: usize, from: usize| match to < n {
            true => flow[(to, from)] != 0.0,
            false => owners[to - n].is_some_and(|k| singles[k][(to - n, from)] != 0.0),
        };
        let closure = |start: Vec<bool>, edge: &dyn Fn(usize, usize) -> bool| {
            let mut reached = start;
            while let Some(next) = (0..size).find(|i| !reached[*i] && (0..size).any(|j| reached[j] && edge(*i, j))) {
                reached[next] = true;
            }
            reached
        };
        let after = closure((0..size).map(|i| depends(i, size)).collect(), &|i, j| depends(i, j));
        let before = closure((0..size).map(|i| output[i] != 0.0).collect(), &|i, j| depends(j, i));
        let kept: Vec<usize> = (0..size).filter(|i| after[*i] && before[*i]).collect();
        if kept.is_empty() {
            return Err(Unbroken::NoLoop);
        }
        let used: Vec<usize> = {
            let mut used: Vec<usize> = kept.iter().filter(|i| **i >= n).filter_map(|i| owners[*i - n]).collect();
            used.sort_unstable();
            used.dedup();
            used
        };
        let longest = used.iter().map(|k| self.periods[*k]).fold(0.0, f64::max);
        let by_states = kept.iter().any(|i| *i < n && output[*i] != 0.0);
        if by_states && !used.is_empty() {
            return Err(Unbroken::Continuous(longest));
        }
        let (states, memory): (Vec<usize>, Vec<usize>) = kept.iter().copied().partition(|i| *i < n);
        let columns: Vec<usize> = kept.iter().copied().chain([size]).collect();
        let select = |matrix: &DMatrix<f64>, rows: &[usize]| {
            DMatrix::from_fn(rows.len(), columns.len(), |i, j| matrix[(rows[i], columns[j])])
        };
        let flow = select(&flow, &states);
        let output = DVector::from_iterator(kept.len(), kept.iter().map(|i| output[*i]));
        let (n, size) = (states.len(), kept.len());
        // With u = y + w the users of y no longer depend on it: the row of y times the column of w leaves.
        let broken = |matrix: &DMatrix<f64>, y: &DVector<f64>| {
            DMatrix::from_fn(matrix.nrows(), size + 1, |i, j| {
                let through = if j < size { matrix[(i, size)] * y[j] } else { 0.0 };
                matrix[(i, j)] - through
            })
        };
        let flow = broken(&flow, &output);
        if used.is_empty() {
            let a = flow.columns(0, size).into_owned();
            let b = flow.column(size).into_owned();
            return OpenLoop { a, b, c: output, d: 0.0, period: None, delay }.checked();
        }
        let mut own: Vec<f64> = kept
            .iter()
            .zip(output.iter())
            .filter(|(i, c)| **i >= self.states && **c != 0.0)
            .filter_map(|(i, _)| owners[*i - self.states].map(|k| self.periods[k]))
            .collect();
        own.sort_by(f64::total_cmp);
        let period = own.last().copied().unwrap_or(longest);
        if longest > period * (1.0 + SAME) {
            return Err(Unbroken::Slower(period, longest));
        }
        let mut offsets: Vec<f64> = Vec::new();
        for k in &used {
            let times = period / self.periods[*k];
            if (times - times.round()).abs() > SAME * times {
                return Err(Unbroken::NoMultiple(period, self.periods[*k]));
            }
            if times > MOST as f64 {
                return Err(Unbroken::TooLong);
            }
            offsets.extend((0..times.round() as usize).map(|i| i as f64 * self.periods[*k]));
        }
        let whole = (delay / period + SAME).floor();
        if whole > MOST as f64 {
            return Err(Unbroken::TooLong);
        }
        let rest = if delay - whole * period > SAME * period { delay - whole * period } else { 0.0 };
        let whole = whole as usize;
        offsets.extend([rest, period]);
        offsets.sort_by(f64::total_cmp);
        offsets.dedup_by(|a, b| (*a - *b).abs() <= SAME * period);
        // Over one period, by the state before its first tick, the older and the newer of two inputs.
        let mut over = DMatrix::<f64>::zeros(size, size + 2);
        over.view_mut((0, 0), (size, size)).fill_with_identity();
        let mut first: Option<DMatrix<f64>> = None;
        for (at, offset) in offsets[..offsets.len() - 1].iter().enumerate() {
            let input = if *offset + SAME * period < rest { size } else { size + 1 };
            let step = |matrix: &DMatrix<f64>, over: &DMatrix<f64>| {
                let mut next = matrix.columns(0, size) * over;
                for i in 0..next.nrows() {
                    next[(i, input)] += matrix[(i, size)];
                }
                next
            };
            let is_due = |k: usize| {
                let times = offset / self.periods[k];
                (times - times.round()).abs() <= SAME * times.max(1.0)
            };
            let due: Vec<bool> = (0..blocks).map(|k| used.contains(&k) && is_due(k)).collect();
            if due.contains(&true) {
                let all = DMatrix::from_row_slice(m, width, &tick(&due));
                let rows: Vec<usize> = memory.iter().map(|i| i - self.states).collect();
                let ticked = select(&all, &rows);
                // y after the tick, by the state before it.
                let mut y = DVector::zeros(size);
                for j in 0..size {
                    y[j] = (0..n).map(|i| if i == j { output[i] } else { 0.0 }).sum::<f64>()
                        + (0..rows.len()).map(|i| output[n + i] * ticked[(i, j)]).sum::<f64>();
                }
                let ticked = broken(&ticked, &y);
                let next = step(&ticked, &over);
                over.rows_mut(n, rows.len()).copy_from(&next);
            }
            if at == 0 {
                first = Some(over.clone());
            }
            if n > 0 {
                let mut rates = DMatrix::zeros(size + 1, size + 1);
                rates.rows_mut(0, n).copy_from(&(&flow * (offsets[at + 1] - offset)));
                let transition = rates.exp().rows(0, n).into_owned();
                let next = step(&transition, &over);
                over.rows_mut(0, n).copy_from(&next);
            }
        }
        let first = first.ok_or(Unbroken::TooLong)?;
        let seen = first.transpose() * &output;
        // u(k − 1), u(k − 2), …: the older input of a period is the one delayed by one more period.
        let queue = whole + usize::from(rest > 0.0);
        let all = size + queue;
        let (mut a, mut b) = (DMatrix::zeros(all, all), DVector::zeros(all));
        let (mut c, mut d) = (DVector::zeros(all), 0.0);
        a.view_mut((0, 0), (size, size)).copy_from(&over.columns(0, size));
        c.rows_mut(0, size).copy_from(&seen.rows(0, size));
        for (input, late) in [(size, whole + 1), (size + 1, whole)] {
            if late > queue {
                continue;
            }
            match late {
                0 => {
                    b.rows_mut(0, size).copy_from(&over.column(input));
                    d += seen[input];
                }
                late => {
                    a.view_mut((0, size + late - 1), (size, 1)).copy_from(&over.column(input));
                    c[size + late - 1] += seen[input];
                }
            }
        }
        if queue > 0 {
            b[size] = 1.0;
            for k in 1..queue {
                a[(size + k, size + k - 1)] = 1.0;
            }
        }
        OpenLoop { a, b, c, d, period: Some(period), delay }.checked()
    }
}

/// A, B, C and D of a loop with N states, row by row.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct StateSpace {
    pub states: usize,
    pub a: Vec<f64>,
    pub b: Vec<f64>,
    pub c: Vec<f64>,
    pub d: Vec<f64>,
}

impl OpenLoop {
    /// Its matrices: x' = A x + B u, y = C x + D u.
    pub fn state_space(&self) -> StateSpace {
        let rows = |matrix: &DMatrix<f64>| matrix.transpose().as_slice().to_vec();
        let (b, c) = (self.b.as_slice().to_vec(), self.c.as_slice().to_vec());
        StateSpace { states: self.a.nrows(), a: rows(&self.a), b, c, d: vec![self.d] }
    }

    /// Its poles: of z with a period, else of s.
    ///
    /// # Errors
    /// If they cannot be computed.
    pub fn poles(&self) -> Result<Vec<Mode>, Unbroken> {
        OpenLoop::eigenvalues(&self.a)
    }

    fn checked(self) -> Result<OpenLoop, Unbroken> {
        let mut entries = self.a.iter().chain(self.b.iter()).chain(self.c.iter());
        if entries.all(|entry| entry.is_finite()) && self.d.is_finite() { Ok(self) } else { Err(Unbroken::NotFinite) }
    }

    /// L at a frequency in rad/s; not finite at a pole on the axis.
    #[allow(clippy::disallowed_methods, reason = "margins and diagrams: shown with few digits, no run depends on them")]
    pub fn response(&self, frequency: f64) -> Complex<f64> {
        let turn = |angle: f64| Complex::new(angle.cos(), angle.sin());
        let (s, late) = match self.period {
            Some(period) => (turn(frequency * period), Complex::new(1.0, 0.0)),
            None => (Complex::new(0.0, frequency), turn(-frequency * self.delay)),
        };
        let size = self.a.nrows();
        let pencil = DMatrix::from_fn(size, size, |i, j| {
            let own = if i == j { s } else { Complex::new(0.0, 0.0) };
            own - Complex::new(self.a[(i, j)], 0.0)
        });
        let b = self.b.map(|entry| Complex::new(entry, 0.0));
        let Some(x) = pencil.lu().solve(&b) else { return Complex::new(f64::INFINITY, f64::INFINITY) };
        let y = x.iter().zip(self.c.iter()).fold(Complex::new(self.d, 0.0), |sum, (x, c)| sum + x * *c);
        -y * late
    }

    /// The eigenvalues of a matrix of this loop.
    fn eigenvalues(matrix: &DMatrix<f64>) -> Result<Vec<Mode>, Unbroken> {
        let size = matrix.nrows();
        modes(size, matrix.transpose().as_slice()).ok_or(Unbroken::NotFinite)
    }

    /// A of the closed loop, u = y; in continuous time without its delay.
    fn closed(&self) -> Result<DMatrix<f64>, Unbroken> {
        let closed = &self.a + &self.b * self.c.transpose() / (1.0 - self.d);
        if closed.iter().all(|entry| entry.is_finite()) { Ok(closed) } else { Err(Unbroken::NotFinite) }
    }

    /// Whether the loop is stable when it is closed, and whether it is neutral; in continuous time without its delay.
    fn closed_is_stable(&self) -> Result<(bool, bool), Unbroken> {
        let closed = self.closed()?;
        let modes = OpenLoop::eigenvalues(&closed)?;
        let fastest = modes.iter().map(|mode| mode.frequency()).fold(0.0, f64::max);
        // Where deviations stay, and what counts as rounding there.
        let (limit, rounding) = if self.period.is_some() { (1.0, SAME) } else { (0.0, 1e-12 * fastest) };
        let decays = |mode: &&Mode| match self.period {
            Some(_) => mode.frequency() < limit - rounding,
            None => mode.real < -rounding,
        };
        let others: Vec<&Mode> = modes.iter().filter(|mode| !decays(mode)).collect();
        let stays = |mode: &&Mode| (mode.real - limit).abs() <= rounding && mode.imaginary.abs() <= rounding;
        if others.is_empty() || !others.iter().all(stays) {
            return Ok((others.is_empty(), false));
        }
        // As many independent deviations stay as there are such eigenvalues; with fewer, one drives another.
        let moved = closed - DMatrix::identity(self.a.nrows(), self.a.nrows()) * limit;
        let values = moved.singular_values();
        let still = values.iter().filter(|value| **value <= SAME * values.max()).count();
        Ok((false, still == others.len()))
    }

    /// Frequencies in rad/s at which L is examined: even in the logarithm up to half the sampling frequency, and denser
    /// near resonances.
    #[allow(clippy::disallowed_methods, reason = "a grid of frequencies for a diagram: no run depends on it")]
    fn grid(&self) -> Result<Vec<f64>, Unbroken> {
        let mut poles: Vec<(f64, f64)> = Vec::new();
        let mut modes = OpenLoop::eigenvalues(&self.a)?;
        modes.extend(OpenLoop::eigenvalues(&self.closed()?)?);
        for mode in modes {
            match self.period {
                None => poles.push((mode.real, mode.imaginary)),
                // z = e^{sT}
                Some(period) if mode.frequency() > 1e-12 => {
                    poles.push((mode.frequency().ln() / period, mode.imaginary.atan2(mode.real) / period));
                }
                Some(_) => {}
            }
        }
        let sizes = || poles.iter().map(|(re, im)| re.hypot(*im)).filter(|size| *size > 0.0);
        let fastest = sizes().fold(0.0, f64::max);
        let last = match self.period {
            Some(period) => PI / period,
            None if fastest > 0.0 => 30.0 * fastest,
            None => 1e3,
        };
        let slowest = sizes().filter(|size| *size > 1e-7 * last).fold(last, f64::min);
        let begin = (1e-1 * slowest).min(1e-3 * last).max(1e-9 * last);
        let count = ((last / begin).log10() * GRID as f64).ceil() as usize;
        let mut grid: Vec<f64> = (0..=count).map(|k| begin * (last / begin).powf(k as f64 / count as f64)).collect();
        for (re, im) in poles.iter().filter(|(_, im)| *im > 0.0) {
            let width = re.abs().max(1e-6 * im);
            for k in -40i32..=40 {
                let away = width * f64::from(k.signum()) * (1.25f64.powi(k.abs()) - 1.0) * 0.1;
                grid.push(im + away);
            }
        }
        grid.retain(|w| *w >= begin && *w <= last);
        if let Some(end) = grid.iter_mut().max_by(|a, b| a.total_cmp(b)) {
            *end = last;
        }
        grid.sort_by(f64::total_cmp);
        grid.dedup_by(|a, b| (*a - *b).abs() < 1e-12 * *b);
        Ok(grid)
    }

    /// L along the frequency.
    ///
    /// # Errors
    /// If its eigenvalues cannot be computed.
    pub fn bode(&self) -> Result<Vec<Point>, Unbroken> {
        let mut points: Vec<Point> = Vec::new();
        for frequency in self.grid()? {
            let value = self.response(frequency);
            if !value.re.is_finite() || !value.im.is_finite() {
                continue;
            }
            let mut phase = degrees(value);
            match points.last() {
                Some(before) => phase += 360.0 * ((before.phase - phase) / 360.0).round(),
                // An integrator begins at −90°, two of them at −180°.
                None if phase > 90.0 + 1e-6 => phase -= 360.0,
                None => {}
            }
            points.push(Point { frequency, gain: size(value), phase });
        }
        Ok(points)
    }

    /// Margins by bisection between the points of `bode`.
    ///
    /// # Errors
    /// If its eigenvalues cannot be computed.
    pub fn margins(&self, bode: &[Point]) -> Result<Margins, Unbroken> {
        let (stable, neutral) = self.closed_is_stable()?;
        let mut found = Margins {
            stable,
            neutral,
            phase: None,
            gain: None,
            reduction: None,
            delay: None,
            sensitivity: At { frequency: 0.0, value: 0.0 },
            crossings: Vec::new(),
        };
        let bisect = |low: f64, high: f64, above: &dyn Fn(Complex<f64>) -> bool| {
            let (mut low, mut high) = (low, high);
            let begins = above(self.response(low));
            for _ in 0..80 {
                let middle = (low * high).sqrt();
                if above(self.response(middle)) == begins { low = middle } else { high = middle }
            }
            high
        };
        for pair in bode.windows(2) {
            let (from, to) = (pair[0], pair[1]);
            if (from.gain > 1.0) != (to.gain > 1.0) {
                let frequency = bisect(from.frequency, to.frequency, &|value| size(value) > 1.0);
                let value = self.response(frequency);
                found.crossings.push(frequency);
                let beyond = degrees(value) + 180.0;
                let margin = if beyond > 180.0 { beyond - 360.0 } else { beyond };
                nearer(&mut found.phase, At { frequency, value: margin }, f64::abs);
                // Degrees of lag until −180°, from below one turn.
                let lag = if margin < 0.0 { margin + 360.0 } else { margin };
                nearer(&mut found.delay, At { frequency, value: lag.to_radians() / frequency }, |delay| delay);
            }
            // L crosses the negative real axis.
            let turns = |phase: f64| ((phase + 180.0) / 360.0).floor();
            if turns(from.phase) != turns(to.phase) {
                let frequency = bisect(from.frequency, to.frequency, &|value| value.im > 0.0);
                let value = self.response(frequency);
                if value.re < 0.0 {
                    found.crosses(frequency, value);
                }
            }
            let ahead = self.response(from.frequency);
            let sensitivity = 1.0 / size(Complex::new(1.0 + ahead.re, ahead.im));
            if sensitivity > found.sensitivity.value {
                found.sensitivity = At { frequency: from.frequency, value: sensitivity };
            }
        }
        if let Some(last) = bode.last().filter(|_| self.period.is_some()) {
            let value = self.response(last.frequency);
            // At half the sampling frequency L is real.
            if value.re < 0.0 && value.im.abs() <= 1e-6 * value.re.abs() {
                found.crosses(last.frequency, value);
            }
        }
        if self.period.is_none() && self.delay > 0.0 {
            let keeps = (found.stable || found.neutral) && self.keeps_stable()?;
            (found.stable, found.neutral) = (found.stable && keeps, found.neutral && keeps);
        }
        Ok(found)
    }

    /// Whether a loop in continuous time that is stable without its delay is so with it: the delay is below the margin
    /// of the loop without it.
    fn keeps_stable(&self) -> Result<bool, Unbroken> {
        let undelayed = OpenLoop { delay: 0.0, ..self.clone() };
        let margins = undelayed.margins(&undelayed.bode()?)?;
        Ok(margins.delay.is_none_or(|margin| self.delay < margin.value))
    }
}

impl Margins {
    /// Notes a crossing of the negative real axis.
    fn crosses(&mut self, frequency: f64, value: Complex<f64>) {
        let factor = 1.0 / size(value);
        let at = At { frequency, value: factor };
        if factor >= 1.0 {
            nearer(&mut self.gain, at, |factor| factor);
        } else {
            nearer(&mut self.reduction, at, |factor| -factor);
        }
    }
}

/// Keeps the margin of the smaller size.
fn nearer(kept: &mut Option<At>, one: At, of: impl Fn(f64) -> f64) {
    if kept.is_none_or(|kept| of(one.value) < of(kept.value)) {
        *kept = Some(one);
    }
}

/// |L| without overflow in between.
#[allow(clippy::disallowed_methods, reason = "shown with few digits, no run depends on it")]
fn size(value: Complex<f64>) -> f64 {
    value.re.hypot(value.im)
}

/// The angle of L in degrees, above −180 and up to 180.
#[allow(clippy::disallowed_methods, reason = "shown with few digits, no run depends on it")]
fn degrees(value: Complex<f64>) -> f64 {
    let angle = value.im.atan2(value.re) / TAU * 360.0;
    if angle <= -180.0 { angle + 360.0 } else { angle }
}

#[cfg(test)]
#[allow(clippy::disallowed_methods, reason = "tests compare with the platform's functions")]
mod tests {
    use super::*;

    fn continuous(n: usize, flow: &[f64], output: &[f64]) -> OpenLoop {
        let hybrid = Hybrid { states: n, memory: 0, flow: flow.to_vec(), output: output.to_vec(), periods: Vec::new() };
        hybrid.open(0.0, &mut |_| Vec::new()).unwrap()
    }

    fn margins(open: &OpenLoop) -> Margins {
        open.margins(&open.bode().unwrap()).unwrap()
    }

    /// dx/dt = u; every T: u = −K x, held.
    fn integrator(gain: f64, period: f64, delay: f64) -> OpenLoop {
        // The users of u read u + w: the rate has u and w.
        let hybrid =
            Hybrid { states: 1, memory: 1, flow: vec![0.0, 1.0, 1.0], output: vec![0.0, 1.0], periods: vec![period] };
        hybrid.open(delay, &mut |due| if due[0] { vec![-gain, 0.0, 0.0] } else { vec![0.0, 1.0, 0.0] }).unwrap()
    }

    /// L(z) = K T/(z − 1): ω = 2/T asin(K T/2), phase margin 90° − ω T/2, gain margin 2/(K T) at half the sampling
    /// frequency (Åström, Wittenmark, ch. 3).
    #[test]
    fn a_sampled_integrator_has_its_margins() {
        for (gain, period) in [(10.0, 0.01), (50.0, 0.01), (3.0, 0.5), (100.0, 1e-3)] {
            let found = margins(&integrator(gain, period, 0.0));
            let frequency = 2.0 / period * (gain * period / 2.0).asin();
            let phase = found.phase.unwrap();
            assert!(found.stable, "{gain} {period}");
            assert!((phase.frequency / frequency - 1.0).abs() < 1e-9, "{phase:?} {frequency}");
            let expected = 90.0 - (0.5 * frequency * period).to_degrees();
            assert!((phase.value - expected).abs() < 1e-7, "{phase:?} {expected}");
            let limit = found.gain.unwrap();
            assert!((limit.value * gain * period / 2.0 - 1.0).abs() < 1e-9, "{limit:?}");
            assert!((limit.frequency * period - PI).abs() < 1e-9);
            let delay = found.delay.unwrap().value;
            assert!((delay - expected.to_radians() / frequency).abs() < 1e-9 * delay);
        }
        assert!(!margins(&integrator(201.0, 0.01, 0.0)).stable);
        assert!(margins(&integrator(199.0, 0.01, 0.0)).stable);
    }

    /// v' = −c v − K x − k z + w, x' = z' = v: a bristle z that moves with x keeps the difference of the two. The loop is
    /// neutral if all else decays and that difference drives nothing that adds it up.
    #[test]
    fn a_loop_with_a_resting_contact_is_neutral() {
        for (damping, neutral) in [(0.5, true), (-0.5, false)] {
            let flow = [-damping, -2.0, -3.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];
            let found = margins(&continuous(3, &flow, &[0.0, -2.0, 0.0]));
            assert_eq!((found.stable, found.neutral), (false, neutral), "{damping}");
        }
        // q' = z − x pushes, too.
        let flow = [
            [-0.5, -2.0, -3.0, -1.0, 1.0],
            [1.0, 0.0, 0.0, 0.0, 0.0],
            [1.0, 0.0, 0.0, 0.0, 0.0],
            [0.0, -1.0, 1.0, 0.0, 0.0],
        ];
        let found = margins(&continuous(4, flow.as_flattened(), &[0.0, -2.0, 0.0, 0.0]));
        assert_eq!((found.stable, found.neutral), (false, false));
        assert!(!margins(&integrator(10.0, 0.01, 0.0)).neutral);
    }

    /// A computation delay of d turns L by −ω d if it is a whole number of periods; by part of a period the integrator
    /// has L(z) = K T ((1 − f) z + f) z^(−k − 1) / (z − 1).
    #[test]
    fn a_computation_delay_is_part_of_the_loop() {
        let (gain, period) = (20.0, 0.01);
        for (whole, part) in [(0, 0.0), (1, 0.0), (3, 0.0), (0, 0.25), (0, 0.999), (2, 0.5)] {
            let open = integrator(gain, period, (f64::from(whole) + part) * period);
            for w in [0.3, 5.0, 80.0, 250.0, 314.0] {
                let z = Complex::new((w * period).cos(), (w * period).sin());
                let own = gain * period / (z - 1.0) * (z * (1.0 - part) + part) / z.powi(whole + 1);
                let found = open.response(w);
                assert!((found - own).norm() < 1e-9 * own.norm(), "{whole} {part} {w}: {found} {own}");
            }
        }
    }

    /// The delay margin is the delay at which the closed loop becomes unstable, whatever part of a period it is.
    #[test]
    fn the_delay_margin_is_the_limit_of_stability() {
        // Shorter than the period the margin of the sampled response is not exact: only whole periods keep L's form.
        let (gain, period) = (2.0, 0.01);
        let margin = margins(&integrator(gain, period, 0.0)).delay.unwrap().value;
        assert!(margin > 50.0 * period);
        for (share, stable) in [(0.98, true), (1.02, false)] {
            assert_eq!(margins(&integrator(gain, period, share * margin)).stable, stable, "{share}");
        }
    }

    /// k/(s (s + 1) (s + 2)): gain margin 6/k at √2 rad/s.
    #[test]
    fn a_continuous_loop_has_its_gain_margin() {
        let k = 1.5;
        // x1' = −y + w in place of … : the users of y read y + w, and y = −k x3 is fed back.
        let flow = [0.0, 0.0, -k, 1.0, 1.0, -1.0, 0.0, 0.0, 0.0, 1.0, -2.0, 0.0];
        let open = continuous(3, &flow, &[0.0, 0.0, -k]);
        let found = margins(&open);
        let gain = found.gain.unwrap();
        assert!(found.stable && (gain.value - 6.0 / k).abs() < 1e-9, "{gain:?}");
        assert!((gain.frequency - 2f64.sqrt()).abs() < 1e-9, "{gain:?}");
        let bode = open.bode().unwrap();
        assert!(bode.len() > 100 && bode[0].frequency < 1.0 && bode.last().unwrap().frequency > 2.0);
        for point in bode {
            let w = point.frequency;
            let phase = -90.0 - w.atan().to_degrees() - (w / 2.0).atan().to_degrees();
            let gain = k / (w * w.hypot(1.0) * w.hypot(2.0));
            assert!((point.phase - phase).abs() < 1e-6 && (point.gain / gain - 1.0).abs() < 1e-9, "{point:?}");
        }
    }

    #[test]
    fn a_signal_outside_of_every_loop_is_refused() {
        let hybrid =
            Hybrid { states: 1, memory: 1, flow: vec![-1.0, 1.0, 1.0], output: vec![0.0, 1.0], periods: vec![1e-3] };
        let alone = hybrid.open(0.0, &mut |due| if due[0] { vec![0.0; 3] } else { vec![0.0, 1.0, 0.0] });
        assert_eq!(alone, Err(Unbroken::NoLoop));
    }

    /// A block of 4 ms in the loop of a signal computed every millisecond.
    #[test]
    fn a_slower_block_is_named() {
        let hybrid = Hybrid {
            states: 1,
            memory: 2,
            flow: vec![0.0, 1.0, 0.0, 1.0],
            output: vec![0.0, 1.0, 0.0],
            periods: vec![1e-3, 4e-3],
        };
        let slow = hybrid.open(0.0, &mut |due| {
            let u = if due[0] { [0.0, 0.0, 1.0, 0.0] } else { [0.0, 1.0, 0.0, 0.0] };
            let outer = if due[1] { [-1.0, 0.0, 0.0, 0.0] } else { [0.0, 0.0, 1.0, 0.0] };
            [u, outer].concat()
        });
        assert_eq!(slow, Err(Unbroken::Slower(1e-3, 4e-3)));
    }
}
