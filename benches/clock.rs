//! The clock of the benches.

/// Seconds this thread has had the processor: other programs count little.
pub fn processor_time() -> f64 {
    let now = nix::time::clock_gettime(nix::time::ClockId::CLOCK_THREAD_CPUTIME_ID).expect("a clock of this system");
    now.tv_sec() as f64 + 1e-9 * now.tv_nsec() as f64
}
