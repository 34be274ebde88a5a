//! Makes one fused operation of a product and a sum, where sums are all it is used for: one rounding less, and half the
//! latency.
//!
//! In: a function. Out: the same with a · b + c as `fma(a, b, c)`. Like regrouping, this is part of what a function *is*:
//! it stands before every back end.

use crate::ir::build::Build;
use crate::ir::{Func, Op, Value};

/// Contracts every sum of a product that only sums use. Of two products the one that is ready later is fused.
pub fn contract(func: &Func) -> Func {
    let mut kept = vec![false; func.ops.len()];
    for op in &func.ops {
        if !matches!(op, Op::Add(..) | Op::Sub(..)) {
            op.each_operand(|operand| kept[operand.index()] = true);
        }
    }
    for (_, value) in &func.stores {
        kept[value.index()] = true;
    }
    let mut build = Build::new(&func.name);
    let mut values: Vec<Value> = Vec::with_capacity(func.ops.len());
    let mut depth: Vec<u32> = Vec::with_capacity(func.ops.len());
    for op in &func.ops {
        let mut deepest = 0;
        op.each_operand(|operand| deepest = deepest.max(depth[operand.index()]));
        depth.push(deepest + super::regroup::latency(*op));
        let product = |value: Value| match func.op(value) {
            Op::Mul(a, b) if !kept[value.index()] => Some((values[a.index()], values[b.index()])),
            _ => None,
        };
        let late = |a: Value, b: Value| depth[a.index()] > depth[b.index()];
        let at = |value: Value| values[value.index()];
        let contracted = match *op {
            Op::Add(a, b) => match (product(a), product(b)) {
                (Some((x, y)), other) if other.is_none() || late(a, b) => build.fma(x, y, at(b)),
                (_, Some((x, y))) => build.fma(x, y, at(a)),
                _ => build.add(at(a), at(b)),
            },
            Op::Sub(a, b) => match (product(a), product(b)) {
                (Some((x, y)), other) if other.is_none() || late(a, b) => {
                    let minus = build.neg(at(b));
                    build.fma(x, y, minus)
                }
                (_, Some((x, y))) => {
                    let minus = build.neg(x);
                    build.fma(minus, y, at(a))
                }
                _ => build.sub(at(a), at(b)),
            },
            op => build.op(op.map(at)),
        };
        values.push(contracted);
    }
    for (slot, value) in &func.stores {
        build.store(*slot, values[value.index()]);
    }
    if let Some(status) = func.status {
        build.status(values[status.index()]);
    }
    build.finish()
}

#[cfg(test)]
mod tests {
    use super::*;
    use abi::Slot;

    #[track_caller]
    fn check(make: impl Fn(&mut Build, [Value; 3]) -> Vec<Value>, expected: &str) {
        let mut build = Build::new("f");
        let loads = [3, 4, 5].map(|slot| build.load(Slot(slot)));
        for (k, value) in make(&mut build, loads).into_iter().enumerate() {
            build.store(Slot(6 + k as u32), value);
        }
        let listing = contract(&build.finish()).to_string();
        let found: Vec<&str> = listing.lines().skip(1).map(str::trim).filter(|line| !line.contains("load")).collect();
        assert_eq!(found.join("; "), expected);
    }

    #[test]
    fn a_product_that_sums_use_is_fused() {
        let sum = |b: &mut Build, [x, y, z]: [Value; 3]| {
            let product = b.mul(x, y);
            vec![b.add(z, product)]
        };
        check(sum, "v3 = fma v0 v1 v2; store 6 = v3");
        let less = |b: &mut Build, [x, y, z]: [Value; 3]| {
            let product = b.mul(x, y);
            vec![b.sub(z, product)]
        };
        check(less, "v3 = neg v0; v4 = fma v1 v3 v2; store 6 = v4");
        let minus = |b: &mut Build, [x, y, z]: [Value; 3]| {
            let product = b.mul(x, y);
            vec![b.sub(product, z)]
        };
        check(minus, "v3 = neg v2; v4 = fma v0 v1 v3; store 6 = v4");
    }

    #[test]
    fn a_product_with_another_use_keeps_its_rounding() {
        let twice = |b: &mut Build, [x, y, z]: [Value; 3]| {
            let product = b.mul(x, y);
            vec![b.add(z, product), product]
        };
        check(twice, "v3 = mul v0 v1; v4 = add v2 v3; store 6 = v4; store 7 = v3");
    }

    #[test]
    fn of_two_products_the_later_one_is_fused() {
        let both = |b: &mut Build, [x, y, z]: [Value; 3]| {
            let root = b.sqrt(x);
            let (late, early) = (b.mul(root, y), b.mul(y, z));
            vec![b.add(late, early)]
        };
        check(both, "v3 = sqrt v0; v4 = mul v1 v2; v5 = fma v1 v3 v4; store 6 = v5");
    }
}
