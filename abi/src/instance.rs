//! A model that runs: its block of numbers and its code, with every access checked.

use crate::description::{Description, Slot};
use crate::table::{Code, Function};
use std::sync::Arc;

/// One running copy of a compiled model.
#[derive(Clone)]
pub struct Instance {
    description: Arc<Description>,
    code: Code,
    block: Vec<f64>,
}

impl Instance {
    /// A copy whose parameters have their defaults: `params`, SI, as many as the layout has.
    pub fn new(description: Arc<Description>, code: Code, params: &[f64]) -> Instance {
        let mut block = vec![0.0; description.layout.size()];
        block[description.layout.params.range()].copy_from_slice(params);
        Instance { description, code, block }
    }

    /// What it is.
    pub fn description(&self) -> &Arc<Description> {
        &self.description
    }

    /// Whether its code has this function.
    pub fn has(&self, function: Function) -> bool {
        self.code.has(function)
    }

    /// The value in a slot, SI.
    pub fn get(&self, slot: Slot) -> f64 {
        self.block[slot.index()]
    }

    /// Writes a slot, SI.
    pub fn set(&mut self, slot: Slot, value: f64) {
        self.block[slot.index()] = value;
    }

    /// All slots.
    pub fn block(&self) -> &[f64] {
        &self.block
    }

    /// All slots, to write.
    pub fn block_mut(&mut self) -> &mut [f64] {
        &mut self.block
    }

    /// Runs one function once; returns its status, 0 for none.
    pub fn call(&mut self, function: Function) -> u64 {
        self.code.call(function, &mut self.block, &self.description.pool, 1)
    }

    /// Puts the model at t = 0 for steps of `h` seconds: initial values and the blocks due at 0, then transitions
    /// until none applies (at most as often as an automaton has regimes), then outputs.
    pub fn start(&mut self, h: f64) -> u64 {
        self.set(Slot::TIME, 0.0);
        self.set(Slot::COUNT, 0.0);
        self.set(Slot::STEP, h);
        let mut status = self.call(Function::Start);
        if self.has(Function::Transitions) {
            let regimes = self.description.layout.regimes.range();
            let most = self.description.automata.iter().map(|automaton| automaton.regimes.len()).max().unwrap_or(0);
            for _ in 0..=most {
                let before = self.block[regimes.clone()].to_vec();
                status = status.max(self.call(Function::Transitions));
                if self.block[regimes.clone()] == before[..] {
                    break;
                }
            }
        }
        status.max(self.call(Function::Outputs))
    }

    /// Advances by up to `n` fixed steps; returns the first status that is not 0, at which it stops.
    pub fn advance(&mut self, n: u64) -> u64 {
        self.code.call(Function::Step, &mut self.block, &self.description.pool, n)
    }
}
