//! Real-time support: clocks in nanoseconds, histograms of latencies, set-up of threads, and a check of the host.

pub mod clock;
pub mod histogram;
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub mod threads;
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub mod host_check;
