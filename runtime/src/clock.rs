//! Time, as a whole number of nanoseconds since some instant: the real one, or one that tests and fast runs advance.

use std::cell::Cell;
use std::rc::Rc;
use std::time::Instant;

/// Where time comes from.
pub trait Clock {
    /// Nanoseconds since the clock's origin; never falls.
    fn now_ns(&self) -> u64;
}

/// The machine's monotonic clock, counted from its making.
#[derive(Clone, Copy, Debug)]
pub struct Monotonic {
    origin: Instant,
}

impl Monotonic {
    /// A clock that starts at 0 now.
    pub fn new() -> Monotonic {
        Monotonic { origin: Instant::now() }
    }
}

impl Default for Monotonic {
    fn default() -> Monotonic {
        Monotonic::new()
    }
}

impl Clock for Monotonic {
    fn now_ns(&self) -> u64 {
        u64::try_from(self.origin.elapsed().as_nanos()).expect("a run ends before 584 years")
    }
}

/// Time that stands until it is moved. Copies show the same time.
#[derive(Clone, Default, Debug)]
pub struct Simulated {
    now_ns: Rc<Cell<u64>>,
}

impl Simulated {
    /// A clock at 0.
    pub fn new() -> Simulated {
        Simulated::default()
    }

    /// Moves on to `t_ns`.
    ///
    /// # Panics
    /// If that lies in the past: time never falls.
    pub fn advance_to(&self, t_ns: u64) {
        assert!(t_ns >= self.now_ns.get(), "time would fall from {} to {t_ns} ns", self.now_ns.get());
        self.now_ns.set(t_ns);
    }
}

impl Clock for Simulated {
    fn now_ns(&self) -> u64 {
        self.now_ns.get()
    }
}
