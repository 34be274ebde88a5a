//! Elementary functions outside a model, with the same bits on every machine.
//!
//! In: a function of the IR. Out: an object that evaluates it with the interpreter.

use crate::ir::build::Build;
use crate::ir::interpret::run_once;
use crate::ir::{Binary, Func, Unary, Value};
use abi::Slot;

/// A single elementary function.
#[derive(Clone)]
pub struct ElementaryFunction(Func);

impl ElementaryFunction {
    /// e^x
    pub fn exp() -> ElementaryFunction {
        ElementaryFunction::unary(Unary::Exp)
    }

    /// The natural logarithm.
    pub fn log() -> ElementaryFunction {
        ElementaryFunction::unary(Unary::Log)
    }

    /// A function of one argument.
    pub fn unary(function: Unary) -> ElementaryFunction {
        ElementaryFunction::of(|build| {
            let x = build.load(Slot(0));
            build.unary(function, x)
        })
    }

    /// A function of two arguments.
    pub fn binary(function: Binary) -> ElementaryFunction {
        ElementaryFunction::of(|build| {
            let (x, y) = (build.load(Slot(0)), build.load(Slot(1)));
            build.binary(function, x, y)
        })
    }

    fn of(make: impl FnOnce(&mut Build) -> Value) -> ElementaryFunction {
        let mut build = Build::new("alone");
        let y = make(&mut build);
        build.store(Slot(0), y);
        ElementaryFunction(crate::math::expand(&build.finish()))
    }

    /// Evaluates a function of one argument.
    pub fn at(&self, x: f64) -> f64 {
        self.of_both(x, 0.0)
    }

    /// Evaluates a function of two arguments.
    pub fn of_both(&self, x: f64, y: f64) -> f64 {
        let mut block = [x, y];
        run_once(&self.0, &mut block, crate::math::pool());
        block[0]
    }
}
