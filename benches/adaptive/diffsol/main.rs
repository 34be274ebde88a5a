//! Runs the two loops of `loops.h` with the solvers of diffsol: `LOOP METHOD TOL ROUNDS` prints the least processor
//! time of a run in s, then the position at 201 instants.

use diffsol::{NalgebraLU, NalgebraMat, OdeBuilder, OdeSolverMethod};

type Matrix = NalgebraMat<f64>;
type Solver = NalgebraLU<f64>;

const INSTANTS: usize = 200;
const SIGMA0: f64 = 1e5;
const SIGMA1: f64 = 316.227_766_016_837_96;

/// dz/dt, and its derivatives along v and z.
fn bristle(v: f64, z: f64) -> (f64, f64, f64) {
    let q = v / 1e-3;
    let e = 0.5 * (-q * q).exp();
    let g = 1.0 + e;
    let k = SIGMA0 * v.abs() / g;
    let dk = SIGMA0 * v.signum() / g + k / g * e * 2.0 * q / 1e-3;
    (v - k * z, 1.0 - dk * z, -k)
}

fn processor_time() -> f64 {
    let mut now = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: the clock exists, and `now` is a valid place to write to.
    unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &mut now) };
    now.tv_sec as f64 + 1e-9 * now.tv_nsec as f64
}

macro_rules! run {
    ($end:expr, $states:expr, $scale:expr, $tol:expr, $method:expr, $f:expr, $j:expr) => {{
        let instants: Vec<f64> = (1..=INSTANTS).map(|k| $end * k as f64 / INSTANTS as f64).collect();
        let mut problem = OdeBuilder::<Matrix>::new()
            .rtol($tol)
            .atol($scale.map(|scale: f64| scale * $tol))
            .rhs_implicit($f, $j)
            .init(|_p, _t, x: &mut [f64]| x.fill(0.0), $states)
            .build()
            .expect("the loop is well posed");
        // As in the CVODE program: kinks cost many attempts.
        problem.ode_options.max_error_test_failures = 1000;
        problem.ode_options.max_nonlinear_solver_failures = 100_000_000;
        problem.ode_options.min_timestep = 1e-18;
        let result = match $method {
            "bdf" => problem.bdf::<Solver>().and_then(|mut solver| solver.solve_dense(&instants)),
            "tr_bdf2" => problem.tr_bdf2::<Solver>().and_then(|mut solver| solver.solve_dense(&instants)),
            "esdirk34" => problem.esdirk34::<Solver>().and_then(|mut solver| solver.solve_dense(&instants)),
            other => panic!("no method {other}"),
        };
        match result {
            Ok((x, _)) => std::iter::once(0.0).chain((0..INSTANTS).map(|k| x[(0, k)])).collect(),
            // The tolerance cannot be met.
            Err(_) => vec![f64::NAN; INSTANTS + 1],
        }
    }};
}

fn stick_slip(tol: f64, method: &str) -> Vec<f64> {
    run!(
        20.0,
        3,
        [1.0, 1.0, 1e-6],
        tol,
        method,
        |x: &[f64], _p: &[f64], t: f64, f: &mut [f64]| {
            let (dz, ..) = bristle(x[1], x[2]);
            f[0] = x[1];
            f[1] = 2.0 * (0.1 * t - x[0]) - (SIGMA0 * x[2] + SIGMA1 * dz + 0.4 * x[1]);
            f[2] = dz;
        },
        |x: &[f64], _p: &[f64], _t: f64, d: &[f64], j: &mut [f64]| {
            let (_, zv, zz) = bristle(x[1], x[2]);
            let dz = zv * d[1] + zz * d[2];
            j[0] = d[1];
            j[1] = -2.0 * d[0] - (SIGMA0 * d[2] + SIGMA1 * dz + 0.4 * d[1]);
            j[2] = dz;
        }
    )
}

fn hunting(tol: f64, method: &str) -> Vec<f64> {
    run!(
        100.0,
        4,
        [1.0, 1.0, 1e-6, 1.0],
        tol,
        method,
        |x: &[f64], _p: &[f64], _t: f64, f: &mut [f64]| {
            let (dz, ..) = bristle(x[1], x[2]);
            f[0] = x[1];
            f[1] = 3.0 * (1.0 - x[0]) + x[3] - 6.0 * x[1] - (SIGMA0 * x[2] + SIGMA1 * dz + 0.4 * x[1]);
            f[2] = dz;
            f[3] = 4.0 * (1.0 - x[0]);
        },
        |x: &[f64], _p: &[f64], _t: f64, d: &[f64], j: &mut [f64]| {
            let (_, zv, zz) = bristle(x[1], x[2]);
            let dz = zv * d[1] + zz * d[2];
            j[0] = d[1];
            j[1] = -3.0 * d[0] + d[3] - 6.0 * d[1] - (SIGMA0 * d[2] + SIGMA1 * dz + 0.4 * d[1]);
            j[2] = dz;
            j[3] = -4.0 * d[0];
        }
    )
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [name, method, tol, rounds] = &args[..] else { panic!("LOOP METHOD TOL ROUNDS") };
    let (tol, rounds): (f64, usize) = (tol.parse().expect("a tolerance"), rounds.parse().expect("a number"));
    let run = if name == "hunting" { hunting } else { stick_slip };
    let (mut least, mut positions) = (f64::INFINITY, Vec::new());
    for _ in 0..rounds {
        let begin = processor_time();
        positions = run(tol, method);
        least = least.min(processor_time() - begin);
    }
    println!("{least:.9e}");
    positions.iter().for_each(|x| println!("{x:.17e}"));
}
