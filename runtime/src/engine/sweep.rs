//! Runs many experiments on all cores.
//!
//! In: cases, or numbers of runs. Out: the outcome of each, in order. Each run stays on one thread, so the results have
//! the same bits for any number of threads.

use crate::engine::estimate;
use crate::engine::{self, Continue, Failure, Outcome};
use abi::Instance;
use abi::plan::Experiment;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard};
use std::time::Duration;

/// One run of a sweep.
#[derive(Clone)]
pub struct Case {
    /// How it differs from the others: `fr = Karnopp()`, `fr.Fs = 1.25 N`.
    pub label: String,
    /// The instance with the parameters of this case.
    pub instance: Instance,
    /// The experiment to run.
    pub experiment: Experiment,
}

/// Runs all cases; returns the results in their order.
///
/// `watch` receives the fraction of the whole that is done, from several threads, and may stop the sweep: completed
/// cases keep their outcome, the others fail as stopped.
pub fn run(cases: &[Case], watch: &(dyn Fn(f64) -> Continue + Sync)) -> Vec<Result<Outcome, Failure>> {
    // In millionths of a case: sums of integers do not depend on their order.
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
    // One run needs no pool of threads, whose start takes as long as a short run.
    match cases {
        [one] => vec![run(one)],
        cases => cases.par_iter().with_max_len(1).map(run).collect(),
    }
}

/// Estimates the errors of all outcomes, as [`estimate::judge`] does.
pub fn judge(cases: &[Case], results: &mut [Result<Outcome, Failure>], watch: &(dyn Fn(f64) -> Continue + Sync)) {
    let judge = |(case, result): (&Case, &mut Result<Outcome, Failure>)| {
        if let Ok(outcome) = result {
            estimate::judge(&case.instance, &case.experiment, outcome, cases.len() == 1, watch);
        }
    };
    match cases {
        [_] => cases.iter().zip(results).for_each(judge),
        cases => cases.par_iter().zip(results).with_max_len(1).for_each(judge),
    }
}

/// For each thread, the most results that may wait for an earlier one: more than there are lanes.
const WAITING: u64 = 128;

/// A work queue: workers take numbers and return results, which are released in order.
pub struct Desk<T> {
    state: Mutex<State<T>>,
    room: Condvar,
    news: Condvar,
    /// The most results that may wait for an earlier one.
    most: u64,
    end: u64,
}

struct State<T> {
    next: u64,
    taken: u64,
    waiting: BTreeMap<u64, Option<T>>,
    closed: bool,
}

/// The answer to a request for work.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Ticket {
    /// This number.
    Number(u64),
    /// Nothing until an earlier number is handed in.
    Later,
    /// Nothing any more.
    Nothing,
}

impl<T> Desk<T> {
    fn state(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().expect("nobody panics at the desk")
    }

    /// The next number. A worker with other numbers in progress gets [`Ticket::Later`] and does not block on another
    /// worker.
    pub fn number(&self, has_others: bool) -> Ticket {
        let mut state = self.state();
        while state.next >= state.taken + self.most && !state.closed {
            if has_others {
                return Ticket::Later;
            }
            state = self.room.wait(state).expect("nobody panics at the desk");
        }
        if state.closed || state.next >= self.end {
            return Ticket::Nothing;
        }
        state.next += 1;
        Ticket::Number(state.next - 1)
    }

    /// Hands in the result of a number; none if it was stopped.
    pub fn hand_in(&self, number: u64, result: Option<T>) {
        self.state().waiting.insert(number, result);
        self.news.notify_one();
    }
}

/// Runs `worker` on `threads` threads until all numbers of a range are done, and passes the results to `take` in order,
/// as soon as each is available. Memory is bounded, because no worker runs far ahead of the slowest. Ends early if
/// `take` requests it, or if a number has no result because it was stopped.
pub fn ordered<T: Send>(
    numbers: Range<u64>,
    threads: usize,
    worker: &(dyn Fn(&Desk<T>) + Sync),
    take: &mut dyn FnMut(u64, T) -> Continue,
) {
    let state = State { next: numbers.start, taken: numbers.start, waiting: BTreeMap::new(), closed: false };
    let most = WAITING * threads.max(1) as u64;
    let desk = Desk { state: Mutex::new(state), room: Condvar::new(), news: Condvar::new(), most, end: numbers.end };
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads.max(1)).map(|_| scope.spawn(|| worker(&desk))).collect();
        let mut number = numbers.start;
        while number < numbers.end {
            let result = {
                let mut state = desk.state();
                loop {
                    if let Some(result) = state.waiting.remove(&number) {
                        state.taken = number + 1;
                        break result;
                    }
                    // A worker that panicked hands in nothing more: the scope propagates its panic.
                    if workers.iter().any(|worker| worker.is_finished()) && state.next < numbers.end {
                        break None;
                    }
                    state = desk.news.wait_timeout(state, Duration::from_millis(200)).expect("nobody panics").0;
                }
            };
            desk.room.notify_all();
            let Some(result) = result else { break };
            if take(number, result).is_break() {
                break;
            }
            number += 1;
        }
        desk.state().closed = true;
        desk.room.notify_all();
    });
}

/// A worker that processes one number after the other.
pub fn one_by_one<T>(desk: &Desk<T>, job: &dyn Fn(u64) -> Option<T>) {
    while let Ticket::Number(number) = desk.number(false) {
        desk.hand_in(number, job(number));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_come_in_order_for_any_number_of_threads() {
        for threads in [1, 2, 5] {
            let mut seen = Vec::new();
            let job = |n: u64| {
                // The first ones take longest.
                (0..(1000 - n) * 20).for_each(|k| {
                    std::hint::black_box(k);
                });
                Some(n * n)
            };
            ordered(3..1000, threads, &|desk| one_by_one(desk, &job), &mut |n, square| {
                seen.push((n, square));
                Continue::Continue(())
            });
            assert!(seen.iter().copied().eq((3..1000).map(|n| (n, n * n))), "{threads} threads");
        }
    }

    #[test]
    fn completed_results_are_kept_when_a_sweep_is_stopped() {
        let mut seen = 0;
        ordered(0..1_000_000, 3, &|desk| one_by_one(desk, &Some), &mut |n, _| {
            seen = n + 1;
            if n == 500 { Continue::Break(()) } else { Continue::Continue(()) }
        });
        assert_eq!(seen, 501);
        let mut seen = 0;
        ordered(0..1_000_000, 3, &|desk| one_by_one(desk, &|n| (n < 700).then_some(n)), &mut |n, _| {
            seen = n + 1;
            Continue::Continue(())
        });
        assert_eq!(seen, 700);
        ordered(5..5, 2, &|desk| one_by_one(desk, &Some), &mut |_, _| unreachable!("there is nothing to do"));
    }
    use crate::engine::Cause;
    use crate::testing::models::{Model, fixed, plot, reading};
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
