//! Work that lets other threads run, and that Ctrl-C ends.

use crate::raise;
use pyo3::prelude::*;
use runtime::engine::Continue;
use std::cell::{Cell, RefCell};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, Instant};

/// Pause between two looks for signals.
const LOOK: Duration = Duration::from_millis(20);

/// What a worker reports and asks.
pub struct Progress {
    stop: Arc<AtomicBool>,
    /// The fraction done, as bits.
    done: AtomicU64,
}

impl Progress {
    /// Set when the work must stop.
    pub fn stop(&self) -> &Arc<AtomicBool> {
        &self.stop
    }

    /// Reports the fraction done, and whether to go on.
    pub fn report(&self, fraction: f64) -> Continue {
        self.done.store(fraction.to_bits(), Ordering::Relaxed);
        if self.stop.load(Ordering::Relaxed) { Continue::Break(()) } else { Continue::Continue(()) }
    }
}

/// Does work in a thread of its own, while this one looks for signals and calls `progress` with the fraction done. An
/// exception of either stops the work and is returned.
pub fn watched<T: Send>(
    py: Python,
    progress: Option<&Bound<PyAny>>,
    work: impl FnOnce(&Progress) -> T + Send,
) -> PyResult<T> {
    let state = Progress { stop: Arc::new(AtomicBool::new(false)), done: AtomicU64::new(0f64.to_bits()) };
    let progress = progress.map(|progress| progress.clone().unbind());
    let (mut raised, mut result) = (None, None);
    py.detach(|| {
        std::thread::scope(|scope| {
            let (to, from) = channel();
            let shared = &state;
            // Errors of steps are values; a deep text needs a deep stack.
            let worker = std::thread::Builder::new().stack_size(16 << 20).spawn_scoped(scope, move || {
                let _ = to.send(catch_unwind(AssertUnwindSafe(|| work(shared))));
            });
            if let Err(error) = worker {
                result = Some(Err(format!("no thread can be had: {error}")));
                return;
            }
            loop {
                match from.recv_timeout(LOOK) {
                    Ok(done) => {
                        result = Some(done.map_err(|why| words(&*why)));
                        return;
                    }
                    Err(RecvTimeoutError::Disconnected) => return,
                    Err(RecvTimeoutError::Timeout) => {}
                }
                if raised.is_some() {
                    continue;
                }
                let looked = Python::attach(|py| {
                    py.check_signals()?;
                    let done = f64::from_bits(state.done.load(Ordering::Relaxed));
                    progress.as_ref().map_or(Ok(()), |call| call.call1(py, (done, 1.0)).map(|_| ()))
                });
                if let Err(error) = looked {
                    raised = Some(error);
                    state.stop.store(true, Ordering::Relaxed);
                }
            }
        });
    });
    match (raised, result) {
        (Some(error), _) => Err(error),
        (None, Some(Ok(done))) => Ok(done),
        (None, Some(Err(message))) => Err(raise::internal(py, &message)),
        (None, None) => Err(raise::internal(py, "a thread ended without a result")),
    }
}

/// Steps in one call from which on other threads may run meanwhile: some 10 µs.
const LONG: u64 = 1000;

/// Makes `count` steps in parts between which other threads run and Ctrl-C is noticed. `part(done, some)` makes `some` steps
/// after the first `done`, and returns the number made and the status; fewer, or a status that is not 0, end the work. Returns
/// the number of steps and the last status.
pub fn in_parts(py: Python, count: u64, mut part: impl FnMut(u64, u64) -> (u64, u64) + Send) -> PyResult<(u64, u64)> {
    if count < LONG {
        return Ok(part(0, count));
    }
    let (mut done, mut some) = (0, LONG);
    loop {
        let begin = Instant::now();
        some = some.min(count - done);
        let (made, status) = py.detach(|| part(done, some));
        done += made;
        if status != 0 || made < some || done == count {
            return Ok((done, status));
        }
        py.check_signals()?;
        if begin.elapsed() < LOOK / 8 {
            some *= 4;
        }
    }
}

/// Does work in this thread while others of Python run. The work asks at least every millisecond or so whether to go on;
/// Ctrl-C ends it.
pub fn in_place<T: Send>(py: Python, work: impl FnOnce(&dyn Fn() -> bool) -> T + Send) -> PyResult<T> {
    let done = py.detach(|| {
        let (raised, next) = (RefCell::new(None), Cell::new(Instant::now() + LOOK));
        let goes_on = || {
            if raised.borrow().is_some() {
                return false;
            }
            let now = Instant::now();
            if now < next.get() {
                return true;
            }
            next.set(now + LOOK);
            *raised.borrow_mut() = Python::attach(|py| py.check_signals()).err();
            raised.borrow().is_none()
        };
        let done = catch_unwind(AssertUnwindSafe(|| work(&goes_on)));
        (raised.into_inner(), done)
    });
    match done {
        (Some(error), _) => Err(error),
        (None, Ok(done)) => Ok(done),
        (None, Err(why)) => Err(raise::internal(py, &words(&*why))),
    }
}

/// Does work without letting a panic through.
pub fn guarded<T>(py: Python, work: impl FnOnce() -> T) -> PyResult<T> {
    catch_unwind(AssertUnwindSafe(work)).map_err(|why| raise::internal(py, &words(&*why)))
}

/// The message of a panic.
fn words(why: &(dyn std::any::Any + Send)) -> String {
    let text = why.downcast_ref::<String>().cloned();
    text.or_else(|| why.downcast_ref::<&str>().map(|text| text.to_string())).unwrap_or_else(|| "a panic".into())
}
