//! Runs many experiments on all cores.
//!
//! In: cases. Out: what became of each, in the order of the cases. Every case runs alone on one thread, so the
//! results have the same bits for any number of threads.

use crate::engine::{self, Continue, Failure, Outcome};
use abi::Instance;
use abi::plan::Experiment;
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// One run of a sweep.
#[derive(Clone)]
pub struct Case {
    /// What sets it apart: `fr = Karnopp()`, `fr.Fs = 1.25 N`.
    pub label: String,
    /// With the parameters of this case.
    pub instance: Instance,
    /// What to run.
    pub experiment: Experiment,
}

/// Runs all cases; the results are in their order.
///
/// `watch` sees the fraction of the whole that is done, from several threads, and may end the sweep: cases that are
/// complete keep their outcome, the others fail as stopped.
pub fn run(cases: &[Case], watch: &(dyn Fn(f64) -> Continue + Sync)) -> Vec<Result<Outcome, Failure>> {
    // In millionths of a case: what is added up must be whole to be the same in any order.
    let done = AtomicU64::new(0);
    let stopped = AtomicBool::new(false);
    let whole = 1e6 * cases.len() as f64;
    let run = |case: &Case| {
        let mut reported = 0;
        let mut report = |fraction: f64| {
            let now = (fraction * 1e6) as u64;
            let all = done.fetch_add(now - reported, Ordering::Relaxed) + now - reported;
            reported = now;
            if !stopped.load(Ordering::Relaxed) && watch(all as f64 / whole).is_break() {
                stopped.store(true, Ordering::Relaxed);
            }
            if stopped.load(Ordering::Relaxed) { Continue::Break(()) } else { Continue::Continue(()) }
        };
        engine::run(case.instance.clone(), &case.experiment, &mut report)
    };
    cases.par_iter().with_max_len(1).map(run).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::Cause;
    use crate::models::{Model, fixed, plot, reading};
    use abi::Function;
    use abi::plan::MeasureKind;

    /// Oscillators of different frequency.
    fn cases() -> Vec<Case> {
        let case = |n: u32| {
            let instance = Model::new("Oscillator")
                .param(f64::from(n) + 1.0)
                .state("x", "m")
                .state("v", "m/s")
                .body(Function::Start, |m| m.set_x(1, 1.0))
                .body(Function::Derivatives, |m| {
                    m.set_dx(0, m.x(1));
                    m.set_dx(1, -m.p(0) * m.x(0));
                })
                .build();
            let mut experiment = fixed(1.0 + 0.1 * f64::from(n % 7), 1e-3);
            experiment.plots.push(plot(&instance, &["x"]));
            experiment.expects.push(reading(&instance, MeasureKind::Rms, "x"));
            Case { label: format!("w2 = {n}"), instance, experiment }
        };
        (0..50).map(case).collect()
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits_in_the_same_order() {
        let on = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| run(&cases(), &|_| Continue::Continue(())))
        };
        let one = on(1);
        assert_eq!(one.len(), 50);
        assert!(one.windows(2).all(|pair| pair[0] != pair[1]));
        assert_eq!(one, on(2));
        assert_eq!(one, on(5));
    }

    #[test]
    fn a_stopped_sweep_keeps_what_is_complete() {
        let watch = |fraction| if fraction > 0.5 { Continue::Break(()) } else { Continue::Continue(()) };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let results = pool.install(|| run(&cases(), &watch));
        let complete = results.iter().filter(|result| result.is_ok()).count();
        assert_eq!(complete, 25);
        assert!(results.iter().flat_map(|result| result.as_ref().err()).all(|failure| failure.cause == Cause::Stopped));
    }
}
