//! Tests of the differences by which a search linearises its runs, against exact derivatives: those of a closed form where
//! events depend on the unknowns, and those of the complex step where there are none.

#![allow(clippy::disallowed_methods, reason = "recordings and exact derivatives are of the platform's functions")]

use super::search::{Runs, Settings, Stepped, estimate};
use crate::compile::{self, Options};
use crate::named_files::NamedFiles;
use runtime::fit::{Tile, Way};
use std::f64::consts::{PI, TAU};

/// Two sets of values at both sides of a point, and what they leave of the recording, above minus below.
struct Pair {
    below: Vec<f64>,
    above: Vec<f64>,
    difference: Vec<f64>,
}

/// The model of a search, with the differences that it asks for.
struct Watched<'r> {
    model: Stepped<'r>,
    jacobians: Vec<Vec<Pair>>,
}

impl runtime::fit::Runs for Watched<'_> {
    fn run(&mut self, way: Way, points: &[Vec<f64>]) -> Vec<Result<Vec<Vec<f64>>, String>> {
        self.model.run(way, points)
    }

    fn pass(&mut self, way: Way, points: &[Vec<f64>], each: &mut dyn FnMut(&Tile)) -> Vec<Result<(), String>> {
        let mut pairs: Vec<Pair> = Vec::new();
        // A single start is judged alone.
        for pair in points.chunks_exact(2) {
            pairs.push(Pair { above: pair[0].clone(), below: pair[1].clone(), difference: Vec::new() });
        }
        let ended = self.model.pass(way, points, &mut |tile| {
            for (pair, rows) in pairs.iter_mut().zip(tile.rows.chunks_exact(2)) {
                let [above, below] = [rows[0], rows[1]].map(|rows| &rows.expect("it can be run")[0]);
                pair.difference.extend(above.iter().zip(below).map(|(a, b)| a - b));
            }
            each(tile);
        });
        if !pairs.is_empty() {
            self.jacobians.push(pairs);
        }
        ended
    }
}

/// The differences of all Jacobians of a search from the written start.
fn differences(text: &str, data: String) -> Vec<Vec<Pair>> {
    let sources = NamedFiles::new(vec![("f.fric".into(), "r.csv".into(), "r.csv".into(), data)]);
    let mut loaded = compile::load("f.fric", text, &sources);
    let compiled = compile::fit(&mut loaded, &sources, "f", &Options::default(), &mut Vec::new());
    let compiled = compiled.unwrap_or_else(|errors| panic!("{errors:?}"));
    let runs = Runs::new(compiled.into_iter().next().expect("there is one"), Some(1));
    let steps = runs.steps();
    let starts: Vec<f64> = runs.unknowns.iter().map(|one| one.start).collect();
    let mut watched = Watched { model: runs.with(&steps), jacobians: Vec::new() };
    let settings = Settings { starts: Some(1), ..Settings::new(0.95) };
    estimate(&runs, &runs.asked(&starts), &runs.compared_whole(), settings, (&mut watched, None))
        .unwrap_or_else(|trouble| panic!("{trouble:?}"));
    watched.jacobians
}

/// The change of what is compared from one set of values to another.
type Exact<'e> = dyn Fn(&[f64], &[f64]) -> Vec<f64> + 'e;

/// The largest relative error of a column of each Jacobian: of all of them, since its size differs from one to the next.
/// `exact`: from the middle of two sets of values and their difference, to first order.
fn errors(jacobians: &[Vec<Pair>], exact: &Exact) -> Vec<f64> {
    let length = |column: &mut dyn Iterator<Item = f64>| column.map(|c| c * c).sum::<f64>().sqrt();
    let of = |Pair { below, above, difference }: &Pair| {
        let middle: Vec<f64> = below.iter().zip(above).map(|(a, b)| 0.5 * (a + b)).collect();
        let change: Vec<f64> = below.iter().zip(above).map(|(a, b)| b - a).collect();
        let exact = exact(&middle, &change);
        assert_eq!(exact.len(), difference.len(), "a number for each row");
        length(&mut exact.iter().zip(difference).map(|(a, b)| a - b)) / length(&mut exact.iter().copied())
    };
    jacobians.iter().map(|pairs| pairs.iter().map(of).fold(0.0, f64::max)).collect()
}

/// Spring, speed and mass of a pulled body on a contact with exact stiction, without viscous friction.
const SPRING: f64 = 2.0;
const SPEED: f64 = 0.1;

/// The position of the body at an instant, and its derivatives by Coulomb friction and stiction.
///
/// The force of the spring falls from Fs to 2 Fc − Fs while the body slides, for θ/ω with tan(θ/2) = −a ω/v₀ and
/// a = (Fs − Fc)/k; at rest it rises by k v₀ a second.
fn pulled(t: f64, [fc, fs]: [f64; 2]) -> [f64; 3] {
    let (k, speed, omega) = (SPRING, SPEED, SPRING.sqrt());
    let a = (fs - fc) / k;
    let slope = a * omega / speed;
    let theta = 2.0 * (PI - slope.atan());
    let theta_of_a = -2.0 * omega / speed / (1.0 + slope * slope);
    let (first, period) = (fs / (k * speed), 2.0 * a / speed + theta / omega);
    if t < first {
        return [0.0; 3];
    }
    let n = ((t - first) / period).floor();
    let tau = t - first - n * period;
    let slides = tau < theta / omega;
    let phase = if slides { omega * tau } else { theta };
    // The elongation of the spring, its rate, and how it depends on a.
    let elongation = fc / k + a * phase.cos() + speed / omega * phase.sin();
    let rate = speed * phase.cos() - a * omega * phase.sin();
    let until = if slides { t } else { first + n * period + theta / omega };
    let by = |of_fc: f64, of_fs: f64| {
        let of_a = (of_fs - of_fc) / k;
        let begins = of_fs / (k * speed) + n * (2.0 * of_a / speed + theta_of_a * of_a / omega);
        match slides {
            true => rate * begins - of_fc / k - phase.cos() * of_a,
            false => speed * (begins + theta_of_a * of_a / omega) - (2.0 * of_fc - of_fs) / k,
        }
    };
    [speed * until - elongation, by(1.0, 0.0), by(0.0, 1.0)]
}

/// Where events depend on the unknowns, derivatives of fixed steps are wrong by up to 100 %; those with located events are
/// within 5 % of the closed form, those of the first Jacobian included.
///
/// Mutant: `theta_of_a` of the other sign, which makes the closed form wrong by 12 %.
#[test]
fn differences_across_events_are_those_of_the_closed_form() {
    let rows: Vec<f64> = (0..=1500).map(|k| 0.02 * f64::from(k)).collect();
    let data = rows.iter().enumerate().map(|(k, t)| {
        // Readings that are off by about 2 mm.
        let off = 2e-3 * (1.7 * k as f64).sin() * 1.4;
        format!("{t},{}\n", 1e3 * (pulled(*t, [1.0, 1.5])[0] + off))
    });
    let data = "t [s],x [mm]\n".to_string() + &data.collect::<String>();
    let text = "import std.friction.kfm
model Pull {
  let u = 2 N/m * (0.1 m/s * t - x)
  part fr = KFM(v = v, F_ext = u, Fv = 0 N·s/m)
  state x [m] = 0
  state v [m/s] = 0
  dx/dt = v
  dv/dt = (u - fr.F) / 1 kg
}
fit f {
  run Pull()
  data \"r.csv\" (t [s], x [mm])
  vary fr.Fc = 1.02 N in 0.1 N .. 10 N, fr.Fs = 1.52 N in 0.1 N .. 15 N
  minimise rms(x - data.x) / 2 mm
}
";
    let jacobians = differences(text, data);
    let exact = |middle: &[f64], change: &[f64]| -> Vec<f64> {
        let at = |t: &f64| {
            let [_, by_fc, by_fs] = pulled(*t, [middle[0], middle[1]]);
            by_fc * change[0] + by_fs * change[1]
        };
        rows.iter().map(at).collect()
    };
    let errors = errors(&jacobians, &exact);
    assert!(errors.len() >= 4 && errors.iter().all(|error| *error <= 0.05), "{errors:?}");
}

/// A complex number, for the complex step: Squire, Trapp, SIAM Rev. 40 (1998).
#[derive(Clone, Copy)]
struct Complex(f64, f64);

impl Complex {
    fn plus(self, other: Complex) -> Complex {
        Complex(self.0 + other.0, self.1 + other.1)
    }

    fn times(self, other: Complex) -> Complex {
        Complex(self.0 * other.0 - self.1 * other.1, self.0 * other.1 + self.1 * other.0)
    }

    fn by(self, factor: f64) -> Complex {
        Complex(factor * self.0, factor * self.1)
    }

    fn over(self, other: Complex) -> Complex {
        let square = other.0 * other.0 + other.1 * other.1;
        self.times(Complex(other.0 / square, -other.1 / square))
    }

    fn exp(self) -> Complex {
        Complex(self.1.cos(), self.1.sin()).by(self.0.exp())
    }
}

/// The forces of a LuGre contact at its rows, moved with velocities that are linear between rows 1 ms apart, by ten steps of
/// the classical Runge–Kutta method from row to row.
fn lugre(v: &[f64], [sigma0, sigma1, sigma2, fc, fs, vs]: [Complex; 6]) -> Vec<Complex> {
    let rate = |z: Complex, v: f64| {
        let ratio = Complex(v, 0.0).over(vs);
        let g = fc.plus(fs.plus(fc.by(-1.0)).times(ratio.times(ratio).by(-1.0).exp()));
        Complex(v, 0.0).plus(sigma0.by(-v.abs()).over(g).times(z))
    };
    let (h, mut z, mut out) = (1e-4, Complex(0.0, 0.0), Vec::new());
    for row in 0..v.len() {
        out.push(sigma0.times(z).plus(sigma1.times(rate(z, v[row]))).plus(sigma2.by(v[row])));
        let Some(next) = v.get(row + 1) else { break };
        for step in 0..10 {
            let at = |part: f64| v[row] + (next - v[row]) * (f64::from(step) + part) / 10.0;
            let a = rate(z, at(0.0));
            let b = rate(z.plus(a.by(0.5 * h)), at(0.5));
            let c = rate(z.plus(b.by(0.5 * h)), at(0.5));
            let d = rate(z.plus(c.by(h)), at(1.0));
            z = z.plus(a.plus(b.by(2.0)).plus(c.by(2.0)).plus(d).by(h / 6.0));
        }
    }
    out
}

/// Without events, differences are within 0.3 % of the complex step through the same method with the same steps, those of
/// the first Jacobian too.
///
/// Mutant: derivatives at one end of the difference and not in its middle, from which it is 1.3 % off.
#[test]
fn differences_without_events_are_those_of_the_complex_step() {
    let velocity = |t: f64| {
        let slow = if t < 0.5 { 1e-4 * (TAU * 4.0 * t).cos() } else { 5e-3 * (TAU * 2.0 * t).sin() };
        slow + 4e-4 * (TAU * 60.0 * t).cos()
    };
    let v: Vec<f64> = (0..=1500).map(|k| velocity(1e-3 * f64::from(k))).collect();
    let truth = [1e5, 316.0, 0.4, 1.0, 1.5, 1e-3];
    let forces = lugre(&v, truth.map(|value| Complex(value, 0.0)));
    let data = v.iter().zip(&forces).enumerate().map(|(k, (v, force))| {
        // Readings that are off by about 5 mN.
        let off = 5e-3 * (1.7 * k as f64).sin() * 1.4;
        format!("{},{v:e},{:e}\n", 1e-3 * k as f64, force.0 + off)
    });
    let data = "t [s],v [m/s],F [N]\n".to_string() + &data.collect::<String>();
    let text = "import std.friction.lugre
fit f {
  run LuGre(v = data.v)
  solver rk4 step 0.1 ms
  data \"r.csv\" (t [s], v [m/s], F [N])
  vary sigma0 = 1.2e5 N/m in 1e4 N/m .. 1e6 N/m, sigma1 = 280 N·s/m in 30 N·s/m .. 3000 N·s/m, sigma2 = 0.5 N·s/m in 0.04 N·s/m .. 4 N·s/m,
    Fc = 1.1 N in 0.1 N .. 10 N, Fs = 1.4 N in 0.1 N .. 15 N, vs = 1.2 mm/s in 0.1 mm/s .. 10 mm/s
  minimise rms(F - data.F)
}
";
    let jacobians = differences(text, data);
    const SMALL: f64 = 1e-30;
    let exact = |middle: &[f64], change: &[f64]| -> Vec<f64> {
        let values: Vec<Complex> = middle.iter().zip(change).map(|(x, by)| Complex(*x, SMALL * by)).collect();
        let values: [Complex; 6] = values.try_into().unwrap_or_else(|_| panic!("six values"));
        lugre(&v, values).into_iter().map(|force| force.1 / SMALL).collect()
    };
    let errors = errors(&jacobians, &exact);
    assert!(errors.len() >= 4 && errors.iter().all(|error| *error <= 0.003), "{errors:?}");
}
