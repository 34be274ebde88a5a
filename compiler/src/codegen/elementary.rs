//! Elementary functions outside a model, with the same bits on every machine.
//!
//! In: a function of the IR. Out: an object that evaluates it with the interpreter.

use crate::ir::build::Build;
use crate::ir::interpret::run_once;
use crate::ir::{Binary, Func, Unary, Value};
use abi::Slot;

/// A single elementary function.
#[derive(Clone)]
pub struct Alone(Func);

impl Alone {
    /// e^x
    pub fn exp() -> Alone {
        Alone::unary(Unary::Exp)
    }

    /// The natural logarithm.
    pub fn log() -> Alone {
        Alone::unary(Unary::Log)
    }

    /// A function of one argument.
    pub fn unary(function: Unary) -> Alone {
        Alone::of(|build| {
            let x = build.load(Slot(0));
            build.unary(function, x)
        })
    }

    /// A function of two arguments.
    pub fn binary(function: Binary) -> Alone {
        Alone::of(|build| {
            let (x, y) = (build.load(Slot(0)), build.load(Slot(1)));
            build.binary(function, x, y)
        })
    }

    fn of(make: impl FnOnce(&mut Build) -> Value) -> Alone {
        let mut build = Build::new("alone");
        let y = make(&mut build);
        build.store(Slot(0), y);
        Alone(crate::math::expand(&build.finish()))
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
