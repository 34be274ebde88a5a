//! Real-time support: clocks in nanoseconds, histograms of latencies, set-up of threads, and a check of the host.

pub mod clock;
pub mod histogram;
pub mod threads;
pub mod host_check;
