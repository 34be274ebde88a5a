//! Elementary functions by themselves: for code outside a model that needs the same bits on every machine.
//!
//! In: the name of a function. Out: something that evaluates it, by the interpreter.

use crate::ir::build::Build;
use crate::ir::interpret::run_once;
use crate::ir::{Binary, Func, Unary, Value};
use abi::Slot;

/// One such function.
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

    /// Of one number.
    pub fn unary(function: Unary) -> Alone {
        Alone::of(|build| {
            let x = build.load(Slot(0));
            build.unary(function, x)
        })
    }

    /// Of two.
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

    /// Its value.
    pub fn at(&self, x: f64) -> f64 {
        self.of_both(x, 0.0)
    }

    /// Its value, of a function of two numbers.
    pub fn of_both(&self, x: f64, y: f64) -> f64 {
        let mut block = [x, y];
        run_once(&self.0, &mut block, crate::math::pool());
        block[0]
    }
}
