//! The clock of the benchmarks.

/// Processor time of this thread in s, which other programs affect little.
pub fn processor_time() -> f64 {
    let now = nix::time::clock_gettime(nix::time::ClockId::CLOCK_THREAD_CPUTIME_ID).expect("a clock of this system");
    now.tv_sec() as f64 + 1e-9 * now.tv_nsec() as f64
}
