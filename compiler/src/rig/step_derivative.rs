//! Derivative of a compiled step with respect to states, memory and inputs. Differentiates the step itself, including
//! sampled blocks and held commands, rather than the underlying equations.
//!
//! In: a program, a method, inputs and outputs. Out: the matrices of a discrete-time linear system. Knows nothing of
//! rigs.

use crate::ir::Func;
use crate::ir::build::{Build, Env};
use crate::ir::expr::Shared;
use crate::ir::interpret::run_once;
use crate::ir::program::Program;
use crate::numerics::autodiff;
use abi::Slot;
use abi::series::Method;

/// Stands for 0 in a state, SI units: far below physical values, but not flushed to 0 by a step.
const AT_REST: f64 = 1e-20;

/// One step of a program, ready to be differentiated at any point of its block.
pub struct StepDerivative {
    func: Func,
    size: usize,
    states: Vec<Slot>,
    /// Number of continuous states; they come first.
    continuous: usize,
    inputs: usize,
    outputs: usize,
    pool: std::sync::Arc<[f64]>,
}

/// s' = A s + B y, u = C s + D y around a point, over one step; SI units, row-major.
#[derive(Clone, PartialEq, Debug)]
#[allow(missing_docs)]
pub struct Discrete {
    pub states: usize,
    pub inputs: usize,
    pub outputs: usize,
    pub a: Vec<f64>,
    pub b: Vec<f64>,
    pub c: Vec<f64>,
    pub d: Vec<f64>,
}

impl StepDerivative {
    /// The derivative of a program's step by a method, with respect to states and these inputs, of states and these
    /// outputs.
    pub fn new(program: &Program, method: Method, inputs: &[Slot], outputs: &[Slot]) -> StepDerivative {
        let layout = &program.description.layout;
        let stored = layout.states.range().chain(layout.memory.range());
        let states: Vec<Slot> = stored.map(|slot| Slot(slot as u32)).collect();
        let directions: Vec<Slot> = states.iter().chain(inputs).copied().collect();
        let step = crate::numerics::fixed_step::step(program, method);
        let build = Shared::new(Build::new("step derivative").with_pool(program.description.pool.clone()));
        let gradients = autodiff::inline(&build, &step, &mut Env::default(), &directions);
        let mut build = build.into_inner();
        let mut next = layout.size();
        for row in states.iter().chain(outputs) {
            let itself = directions.iter().position(|direction| direction == row);
            let gradient = gradients.get(row);
            for k in 0..directions.len() {
                let entry = gradient.and_then(|gradient| autodiff::entry(gradient, k as u32));
                // A state that the step does not write keeps its value (derivative 1); an absent entry of a written one
                // is 0.
                let entry = entry.unwrap_or_else(|| build.real(f64::from(gradient.is_none() && itself == Some(k))));
                build.store(Slot(next as u32), entry);
                next += 1;
            }
        }
        StepDerivative {
            func: crate::math::expand(&build.finish()),
            size: layout.size(),
            states,
            continuous: layout.states.len as usize,
            inputs: inputs.len(),
            outputs: outputs.len(),
            pool: program.description.pool.clone(),
        }
    }

    /// The matrices at a block, for this number of steps with the inputs held.
    pub fn at(&self, block: &[f64], steps: u32) -> Discrete {
        let (n, m, p) = (self.states.len(), self.inputs, self.outputs);
        let mut block = block.to_vec();
        // A step flushes decayed states to 0, and at exactly 0 would take that branch, whose derivative is 0.
        for slot in &self.states[..self.continuous] {
            let value = &mut block[slot.index()];
            if value.abs() < AT_REST {
                *value = AT_REST;
            }
        }
        block.resize(self.size + (n + p) * (n + m), 0.0);
        run_once(&self.func, &mut block, &self.pool);
        let rows: Vec<&[f64]> = block[self.size..].chunks_exact((n + m).max(1)).collect();
        let part = |from: usize, to: usize, first: usize, last: usize| -> Vec<f64> {
            rows[from..to].iter().flat_map(|row| &row[first..last]).copied().collect()
        };
        let (a1, b1) = (part(0, n, 0, n), part(0, n, n, n + m));
        let (c1, d1) = (part(n, n + p, 0, n), part(n, n + p, n, n + m));
        let (mut a, mut b, mut c, mut d) = (a1.clone(), b1.clone(), c1.clone(), d1.clone());
        for _ in 1..steps {
            // u = C (A s + B y) + D y of the preceding steps.
            (c, d) = (product(&c1, &a, p, n, n), sum(&product(&c1, &b, p, n, m), &d1));
            (a, b) = (product(&a1, &a, n, n, n), sum(&product(&a1, &b, n, n, m), &b1));
        }
        Discrete { states: n, inputs: m, outputs: p, a, b, c, d }
    }
}

/// The product of a rows × inner and an inner × columns matrix.
fn product(a: &[f64], b: &[f64], rows: usize, inner: usize, columns: usize) -> Vec<f64> {
    let entry = |i: usize, j: usize| (0..inner).map(|k| a[i * inner + k] * b[k * columns + j]).sum();
    (0..rows * columns).map(|at| entry(at / columns.max(1), at % columns.max(1))).collect()
}

fn sum(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a + b).collect()
}
