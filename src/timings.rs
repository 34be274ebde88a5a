//! `--timings`: where the time of a command goes, from its first instruction to its last word.
//!
//! In: the stages of a command with their durations. Out: a table on the standard error.

use crate::compile::Stages;
use crate::quantity::duration;
use crate::terminal::Terminal;
use std::time::Instant;

/// The stages of a command so far.
pub struct Timings {
    wanted: bool,
    begin: Instant,
    /// Stages one after the other, and those that ran in another thread meanwhile.
    stages: Stages,
    meanwhile: Stages,
}

impl Timings {
    /// The first stage, from `begin` to now, is the reading of the arguments. `wanted`: whether a table is printed.
    pub fn new(wanted: bool, begin: Instant) -> Timings {
        let stages = Stages(vec![("arguments", begin.elapsed().as_secs_f64())]);
        Timings { wanted, begin, stages, meanwhile: Stages::default() }
    }

    /// Adds a duration in s to a stage.
    pub fn add(&mut self, stage: &'static str, seconds: f64) {
        self.stages.add(stage, seconds);
    }

    /// Adds several stages.
    pub fn add_all(&mut self, stages: &Stages) {
        stages.0.iter().for_each(|(stage, seconds)| self.add(stage, *seconds));
    }

    /// Adds a duration in s of work that another thread did beside other stages.
    pub fn add_meanwhile(&mut self, stage: &'static str, seconds: f64) {
        self.meanwhile.add(stage, seconds);
    }

    /// Prints the table, if it is wanted.
    pub fn print(&self, terminal: &Terminal) {
        if self.wanted {
            terminal.report(&self.table(self.begin.elapsed().as_secs_f64()));
        }
    }

    /// The table of a command that took so many seconds.
    fn table(&self, whole: f64) -> String {
        let rest = whole - self.stages.total();
        let own = self.stages.0.iter().map(|(stage, seconds)| (*stage, *seconds, ""));
        let meanwhile = self.meanwhile.0.iter().map(|(stage, seconds)| (*stage, *seconds, "  in a thread of its own"));
        let ends = [("other", rest, ""), ("together", whole, "")];
        let line = |(stage, seconds, note): (&str, f64, &str)| {
            let words = duration(seconds, 3);
            let (number, unit) = words.split_once(' ').unwrap_or((&words, ""));
            format!("  {stage:<12} {number:>7} {unit:<3}{note}").trim_end().to_string() + "\n"
        };
        let lines: String = own.chain(meanwhile).chain(ends).map(line).collect();
        format!("timings, from the first instruction of the program\n{lines}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_and_the_rest_are_together_the_whole() {
        let mut timings = Timings::new(true, Instant::now());
        timings.stages = Stages(vec![("arguments", 1e-3)]);
        timings.add_all(&Stages(vec![("parse", 2e-3), ("code", 3e-3)]));
        timings.add("parse", 1e-3);
        timings.add_meanwhile("files", 4e-3);
        let expected = "timings, from the first instruction of the program
  arguments          1 ms
  parse              3 ms
  code               3 ms
  files              4 ms   in a thread of its own
  other            500 µs
  together         7.5 ms
";
        assert_eq!(timings.table(7.5e-3), expected);
    }
}
