//! From a text to cases that run: the only place that calls the compiler.

pub use abi::plan::Method;
pub use compiler::explain::{Explanation, Listed};
pub use compiler::friction::Verdict;
pub use compiler::linearise::{Linear, Matrices, Ports};
pub use compiler::names::nearest;
pub use compiler::resolve::{Lookup, Space};
pub use compiler::vary::{Alone, Varying};
pub use compiler::{
    Case, Changes, Loaded, Options, Ready, SourceFile, Sources, check, check_models, compile, dissipation, explain,
    explain_in, explain_run, linear, load, quantities, rig, stepping, varying,
};
use std::time::Instant;

/// How long each stage took, in the order in which they ran.
#[derive(Clone, Debug, Default)]
pub struct Stages(pub Vec<(&'static str, f64)>);

impl Stages {
    /// Seconds of all of them.
    pub fn total(&self) -> f64 {
        self.0.iter().map(|(_, seconds)| seconds).sum()
    }
}

/// Times stages: each lasts until the next begins, or until [`Stopwatch::stop`].
pub struct Stopwatch {
    stages: Stages,
    since: Option<(&'static str, Instant)>,
}

impl Stopwatch {
    /// Begins with a stage.
    pub fn start(stage: &'static str) -> Stopwatch {
        Stopwatch { stages: Stages::default(), since: Some((stage, Instant::now())) }
    }

    /// Ends the stage under way and begins another.
    pub fn stage(&mut self, stage: &'static str) {
        self.end();
        self.since = Some((stage, Instant::now()));
    }

    /// Ends the stage under way.
    pub fn stop(mut self) -> Stages {
        self.end();
        self.stages
    }

    fn end(&mut self) {
        let Some((stage, since)) = self.since.take() else { return };
        let seconds = since.elapsed().as_secs_f64();
        // A stage may be done in several pieces, as for each case of a sweep.
        match self.stages.0.iter_mut().find(|(name, _)| *name == stage) {
            Some((_, sum)) => *sum += seconds,
            None => self.stages.0.push((stage, seconds)),
        }
    }
}
