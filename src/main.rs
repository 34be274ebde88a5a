//! The `fric` command: joins the crates and talks to people.

mod compile;
mod plot;
mod report;

fn main() {}
