//! Time as whole nanoseconds, how late a cycle is, and what a thread and a machine need to be real-time.

pub mod clock;
pub mod histogram;
pub mod threads;
pub mod host_check;
