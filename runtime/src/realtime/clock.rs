//! Clocks in whole nanoseconds since an origin: the machine's, or one that tests and fast runs advance.

use std::cell::Cell;
use std::rc::Rc;

/// Source of time.
pub trait Clock {
    /// Nanoseconds since the clock's origin; never decreases.
    fn now_ns(&self) -> u64;

    /// Returns when the clock shows this time: by sleeping, or by advancing the clock.
    fn sleep_until(&self, until_ns: u64);
}

/// The machine's monotonic clock, relative to its construction.
#[derive(Clone, Copy, Debug)]
pub struct Monotonic {
    origin_ns: u64,
}

impl Monotonic {
    /// A clock that shows 0 now.
    pub fn new() -> Monotonic {
        Monotonic { origin_ns: monotonic_ns() }
    }

    /// Value of [`monotonic_ns`] at the origin.
    pub fn origin_ns(&self) -> u64 {
        self.origin_ns
    }
}

impl Default for Monotonic {
    fn default() -> Monotonic {
        Monotonic::new()
    }
}

impl Clock for Monotonic {
    fn now_ns(&self) -> u64 {
        monotonic_ns() - self.origin_ns
    }

    fn sleep_until(&self, until_ns: u64) {
        monotonic_sleep(self.origin_ns.saturating_add(until_ns));
    }
}

#[cfg(all(feature = "hardware", target_os = "linux"))]
const SECOND_NS: u64 = 1_000_000_000;

/// Sleeps until an absolute time, so that delays in between do not accumulate.
#[cfg(all(feature = "hardware", target_os = "linux"))]
fn monotonic_sleep(until_ns: u64) {
    let seconds = i64::try_from(until_ns / SECOND_NS).unwrap_or(i64::MAX);
    let until = libc::timespec { tv_sec: seconds, tv_nsec: (until_ns % SECOND_NS) as i64 };
    // SAFETY: `until` is a valid time and outlives the call; the remaining time is not requested.
    let sleep =
        || unsafe { libc::clock_nanosleep(libc::CLOCK_MONOTONIC, libc::TIMER_ABSTIME, &until, std::ptr::null_mut()) };
    while sleep() == libc::EINTR {}
}

/// CLOCK_MONOTONIC: the same for all processes of a machine.
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub fn monotonic_ns() -> u64 {
    let mut now = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `now` is written by the call and outlives it.
    let done = unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &mut now) };
    assert_eq!(done, 0, "every Linux has a monotonic clock");
    now.tv_sec as u64 * SECOND_NS + now.tv_nsec as u64
}

/// Sleeps until an absolute time, as exactly as the system wakes a thread.
#[cfg(not(all(feature = "hardware", target_os = "linux")))]
fn monotonic_sleep(until_ns: u64) {
    std::thread::sleep(std::time::Duration::from_nanos(until_ns.saturating_sub(monotonic_ns())));
}

/// Nanoseconds since the first call in this process.
#[cfg(not(all(feature = "hardware", target_os = "linux")))]
pub fn monotonic_ns() -> u64 {
    static ORIGIN: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    let origin = *ORIGIN.get_or_init(std::time::Instant::now);
    u64::try_from(origin.elapsed().as_nanos()).unwrap_or(u64::MAX)
}

/// A clock that stands still until it is advanced. Clones share their time.
#[derive(Clone, Default, Debug)]
pub struct Simulated {
    now_ns: Rc<Cell<u64>>,
}

impl Simulated {
    /// A clock at 0.
    pub fn new() -> Simulated {
        Simulated::default()
    }

    /// Advances the clock to `t_ns`.
    ///
    /// # Panics
    /// If that lies in the past: time never decreases.
    pub fn advance_to(&self, t_ns: u64) {
        assert!(t_ns >= self.now_ns.get(), "time would fall from {} to {t_ns} ns", self.now_ns.get());
        self.now_ns.set(t_ns);
    }
}

impl Clock for Simulated {
    fn now_ns(&self) -> u64 {
        self.now_ns.get()
    }

    fn sleep_until(&self, until_ns: u64) {
        self.now_ns.set(until_ns.max(self.now_ns.get()));
    }
}
