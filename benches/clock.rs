//! The clock of the benchmarks.

/// Processor time of this thread in s, which other programs affect little.
pub fn processor_time() -> f64 {
    let mut now = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: it writes the time to the place that it is given.
    let failed = unsafe { libc::clock_gettime(libc::CLOCK_THREAD_CPUTIME_ID, &mut now) };
    assert_eq!(failed, 0, "a clock of this system");
    now.tv_sec as f64 + 1e-9 * now.tv_nsec as f64
}
