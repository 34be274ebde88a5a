//! Interval branch and bound: proves that a value of a function is non-negative for all inputs within a box (Moore,
//! Kearfott, Cloud, *Introduction to Interval Analysis*, 2009).
//!
//! In: a function before its elementary functions are expanded, the intervals of its inputs, and a limit on the work.
//! Out: whether there is a proof.
//!
//! Boxes are bisected until each is proven. A value is expanded into a sum of products of opaque terms (inputs,
//! functions, quotients, undecided branches), so that terms cancel symbolically, and is then bounded by intervals.
//! Comparisons with the same result throughout a box are decided; a comparison of an input with a number bisects the
//! box at that number. Bounds are rounded outwards. A sum counts as zero if it is negative by no more than 1e-12 of its
//! terms, because coefficients of equal products may differ in their last digits.

use crate::interval::Interval;
use crate::ir::hash::HashMap;
use crate::ir::{Func, Op, Value};
use abi::Slot;
use std::collections::BTreeMap;
use std::rc::Rc;

/// A claim about a function: one of the values `any` is non-negative wherever none of the conditions `unless` holds.
pub struct Claim<'a> {
    /// The function.
    pub func: &'a Func,
    /// Alternatives: in each box one of them suffices, not necessarily the same.
    pub any: &'a [Value],
    /// Exceptions: where one of these holds, nothing is claimed.
    pub unless: &'a [Value],
}

/// Limit on the terms of an expanded sum; a longer sum is opaque.
const MOST_TERMS: usize = 48;
/// Relative magnitude below which a part of a sum counts as zero.
const NOTHING: f64 = 1e-12;
/// Limit on the depth of bisection.
const DEEPEST: u32 = 60;

/// Proves a claim for all inputs in `inputs`. Returns false if there is no proof within `work` steps of a few
/// operations each. Subtracts the steps taken from `work`.
pub fn prove(claim: &Claim, inputs: &[(Slot, Interval)], pool: &[f64], work: &mut usize) -> bool {
    let live = claim.func.live();
    let mut stack = vec![Cell { inputs: inputs.to_vec(), facts: Vec::new(), depth: 0 }];
    while let Some(cell) = stack.pop() {
        let cost = claim.func.ops.len() + 1;
        let Some(rest) = work.checked_sub(cost) else { return false };
        *work = rest;
        let mut bounds = Bounds::new(claim.func, &live, &cell, pool, work);
        if claim.unless.iter().any(|condition| bounds.truth(*condition) == Some(true)) {
            continue;
        }
        if claim.any.iter().any(|value| bounds.not_negative(*value)) {
            continue;
        }
        if cell.depth >= DEEPEST {
            return false;
        }
        let Some(halves) = bounds.halves(claim) else { return false };
        stack.extend(halves);
    }
    true
}

/// A box, with the known results of comparisons in it.
#[derive(Clone)]
struct Cell {
    inputs: Vec<(Slot, Interval)>,
    facts: Vec<(Value, bool)>,
    depth: u32,
}

/// A product of powers of opaque terms: (index of the value, exponent).
type Product = Vec<(u32, i32)>;

/// A sum of products. Each has its coefficient, and the sum of the magnitudes from which the coefficient was added up.
#[derive(Clone, Default)]
struct Sum(BTreeMap<Product, (f64, f64)>);

impl Sum {
    fn number(x: f64) -> Sum {
        Sum([(Product::new(), (x, x.abs()))].into_iter().filter(|(_, (x, _))| *x != 0.0).collect())
    }

    fn opaque(value: Value) -> Sum {
        Sum([(vec![(value.0, 1)], (1.0, 1.0))].into())
    }

    fn add(mut self, other: &Sum, sign: f64) -> Sum {
        for (product, (x, size)) in &other.0 {
            let entry = self.0.entry(product.clone()).or_default();
            entry.0 += sign * x;
            entry.1 += size;
        }
        self.0.retain(|_, (x, size)| x.abs() > NOTHING * *size);
        self
    }

    fn times(&self, other: &Sum) -> Sum {
        let mut out = Sum::default();
        for (a, (x, size)) in &self.0 {
            for (b, (y, other)) in &other.0 {
                let mut product: BTreeMap<u32, i32> = a.iter().copied().collect();
                for (opaque, power) in b {
                    *product.entry(*opaque).or_default() += power;
                }
                let product: Product = product.into_iter().filter(|(_, power)| *power != 0).collect();
                let entry = out.0.entry(product).or_default();
                entry.0 += x * y;
                entry.1 += size * other;
            }
        }
        out.0.retain(|_, (x, size)| x.abs() > NOTHING * *size);
        out
    }

    /// The only product of the sum and its coefficient, if there is exactly one.
    fn single(&self) -> Option<(&Product, f64)> {
        match self.0.len() {
            1 => self.0.iter().next().map(|(product, (x, _))| (product, *x)),
            _ => None,
        }
    }
}

/// Bounds of the values of a function in a box.
struct Bounds<'a> {
    func: &'a Func,
    cell: &'a Cell,
    ranges: Vec<Interval>,
    truths: Vec<Option<bool>>,
    sums: Vec<Option<Rc<Sum>>>,
    /// Opaque terms that stand for the reciprocal of a sum, by the index of the sum.
    inverse: HashMap<u32, Interval>,
    work: &'a mut usize,
}

/// 1 / x; everything if x can be 0.
fn inverse(x: Interval) -> Interval {
    if x.has_zero() { Interval::ALL } else { x.reciprocal() }
}

/// x^n
fn power(x: Interval, n: i32) -> Interval {
    let base = if n < 0 { inverse(x) } else { x };
    base.power(n.unsigned_abs())
}

impl<'a> Bounds<'a> {
    fn new(func: &'a Func, live: &[bool], cell: &'a Cell, pool: &[f64], work: &'a mut usize) -> Bounds<'a> {
        let n = func.ops.len();
        let mut ranges = vec![Interval::ALL; n];
        let mut truths: Vec<Option<bool>> = vec![None; n];
        for (i, op) in func.ops.iter().enumerate().filter(|(i, _)| live[*i]) {
            let r = |value: Value| ranges[value.index()];
            let known = cell.facts.iter().find(|(value, _)| value.index() == i).map(|(_, truth)| *truth);
            let mut truth = None;
            let range = match *op {
                Op::Real(bits) => Interval::point(f64::from_bits(bits)),
                Op::Load(slot) => {
                    cell.inputs.iter().find(|(at, _)| *at == slot).map_or(Interval::ALL, |(_, range)| *range)
                }
                Op::Pool { base, len, .. } => {
                    let entries = &pool[base as usize..(base + len) as usize];
                    entries.iter().fold(Interval::point(entries[0]), |all, x| all.hull(Interval::point(*x)))
                }
                Op::Add(a, b) => r(a).plus(r(b)),
                Op::Sub(a, b) => r(a).minus(r(b)),
                Op::Mul(a, b) if a == b => r(a).square(),
                Op::Mul(a, b) => r(a).multiply(r(b)),
                Op::Fma(a, b, c) => r(a).multiply(r(b)).plus(r(c)),
                Op::Div(a, b) => r(a).multiply(inverse(r(b))),
                Op::Neg(a) => r(a).negate(),
                Op::Abs(a) => r(a).abs(),
                // Outside its domain a function is not a number.
                Op::Sqrt(a) if r(a).is_not_negative() => r(a).sqrt(),
                Op::Unary(function, a) if function.row().domain.holds(r(a)) => function.image(r(a)),
                Op::Binary(function, a, b) => (function.row().image)(r(a), r(b)),
                Op::Bool(b) => {
                    truth = Some(b);
                    Interval::ALL
                }
                Op::Less(a, b) => {
                    truth = (r(a).high < r(b).low).then_some(true).or((r(a).low >= r(b).high).then_some(false));
                    Interval::ALL
                }
                Op::LessEqual(a, b) => {
                    truth = (r(a).high <= r(b).low).then_some(true).or((r(a).low > r(b).high).then_some(false));
                    Interval::ALL
                }
                Op::Equal(a, b) => {
                    let (a, b) = (r(a), r(b));
                    truth = (a.low == a.high && a == b).then_some(true);
                    truth = truth.or((a.high < b.low || b.high < a.low).then_some(false));
                    Interval::ALL
                }
                Op::And(a, b) => {
                    truth = match (truths[a.index()], truths[b.index()]) {
                        (Some(false), _) | (_, Some(false)) => Some(false),
                        (Some(true), Some(true)) => Some(true),
                        _ => None,
                    };
                    Interval::ALL
                }
                Op::Or(a, b) => {
                    truth = match (truths[a.index()], truths[b.index()]) {
                        (Some(true), _) | (_, Some(true)) => Some(true),
                        (Some(false), Some(false)) => Some(false),
                        _ => None,
                    };
                    Interval::ALL
                }
                Op::Not(a) => {
                    truth = truths[a.index()].map(|truth| !truth);
                    Interval::ALL
                }
                Op::Select(condition, a, b) => match truths[condition.index()] {
                    Some(yes) => {
                        let chosen = if yes { a } else { b };
                        truth = truths[chosen.index()];
                        r(chosen)
                    }
                    None => {
                        truth = truths[a.index()].filter(|truth| truths[b.index()] == Some(*truth));
                        smaller_or_larger(func, condition, a, b, r(a), r(b)).unwrap_or(r(a).hull(r(b)))
                    }
                },
                Op::Ring { .. }
                | Op::Sqrt(_)
                | Op::Unary(..)
                | Op::Floor(_)
                | Op::Nearest(_)
                | Op::Int(_)
                | Op::IntAdd(..)
                | Op::IntSub(..)
                | Op::IntMul(..)
                | Op::IntAnd(..)
                | Op::IntOr(..)
                | Op::IntXor(..)
                | Op::ShiftLeft(..)
                | Op::ShiftRight(..)
                | Op::ShiftRightSigned(..)
                | Op::IntLess(..)
                | Op::IntEqual(..)
                | Op::ToBits(_)
                | Op::FromBits(_)
                | Op::ToInt(_)
                | Op::ToReal(_) => Interval::ALL,
            };
            truths[i] = known.or(truth);
            ranges[i] = range;
        }
        Bounds { func, cell, ranges, truths, sums: vec![None; n], inverse: HashMap::default(), work }
    }

    fn truth(&self, condition: Value) -> Option<bool> {
        self.truths[condition.index()]
    }

    /// The value as a sum of products, memoised.
    fn sum(&mut self, value: Value) -> Rc<Sum> {
        if let Some(known) = &self.sums[value.index()] {
            return known.clone();
        }
        let sum = Rc::new(self.expanded(value));
        self.sums[value.index()] = Some(sum.clone());
        sum
    }

    fn expanded(&mut self, value: Value) -> Sum {
        let opaque = || Sum::opaque(value);
        let out = match self.func.ops[value.index()] {
            Op::Real(bits) => Sum::number(f64::from_bits(bits)),
            Op::Add(a, b) => (*self.sum(a)).clone().add(&self.sum(b), 1.0),
            Op::Sub(a, b) => (*self.sum(a)).clone().add(&self.sum(b), -1.0),
            Op::Neg(a) => Sum::default().add(&self.sum(a), -1.0),
            Op::Mul(a, b) => self.product(a, b).unwrap_or_else(opaque),
            Op::Fma(a, b, c) => match self.product(a, b) {
                Some(product) => product.add(&self.sum(c), 1.0),
                None => opaque(),
            },
            Op::Div(a, b) => {
                let (above, below) = (self.sum(a), self.sum(b));
                let range = self.ranges[b.index()];
                let safe = !range.has_zero();
                let inverse = match below.single() {
                    Some((product, x)) if safe => {
                        let turned: Product = product.iter().map(|(opaque, power)| (*opaque, -power)).collect();
                        Sum([(turned, (1.0 / x, (1.0 / x).abs()))].into())
                    }
                    _ => {
                        // The divisor as a whole becomes opaque: its index with the top bit set, which no other opaque
                        // term has.
                        let key = b.0 | 1 << 31;
                        self.inverse.insert(key, inverse(range));
                        Sum([(vec![(key, 1)], (1.0, 1.0))].into())
                    }
                };
                above.times(&inverse)
            }
            Op::Abs(a) if self.ranges[a.index()].low >= 0.0 => (*self.sum(a)).clone(),
            Op::Abs(a) if self.ranges[a.index()].high <= 0.0 => Sum::default().add(&self.sum(a), -1.0),
            Op::Select(condition, a, b) => match self.truth(condition) {
                Some(yes) => (*self.sum(if yes { a } else { b })).clone(),
                None => opaque(),
            },
            _ => opaque(),
        };
        if out.0.len() > MOST_TERMS { opaque() } else { out }
    }

    fn product(&mut self, a: Value, b: Value) -> Option<Sum> {
        let (a, b) = (self.sum(a), self.sum(b));
        let terms = a.0.len() * b.0.len();
        *self.work = self.work.saturating_sub(4 * terms);
        (terms <= MOST_TERMS).then(|| a.times(&b))
    }

    fn opaque(&self, key: u32) -> Interval {
        self.inverse.get(&key).copied().unwrap_or_else(|| self.ranges[key as usize])
    }

    /// Whether the value is non-negative throughout the box.
    fn not_negative(&mut self, value: Value) -> bool {
        if self.ranges[value.index()].low >= 0.0 {
            return true;
        }
        let sum = self.sum(value);
        *self.work = self.work.saturating_sub(4 * sum.0.len());
        if sum.0.is_empty() {
            return true;
        }
        // A common positive factor does not affect the sign.
        let mut common: BTreeMap<u32, i32> = sum.0.keys().next().expect("there is one").iter().copied().collect();
        for product in sum.0.keys() {
            common.retain(|opaque, power| match product.iter().find(|(other, _)| other == opaque) {
                Some((_, other)) if (*power > 0) == (*other > 0) => {
                    *power = if *power > 0 { (*power).min(*other) } else { (*power).max(*other) };
                    true
                }
                _ => false,
            });
        }
        common.retain(|opaque, power| *power % 2 == 0 || self.opaque(*opaque).low > 0.0);
        let mut total = Interval::point(0.0);
        let mut size = 0.0;
        for (product, (x, _)) in &sum.0 {
            let mut range = Interval::point(*x);
            for (opaque, power) in product {
                let power = power - common.get(opaque).copied().unwrap_or(0);
                if power != 0 {
                    range = range.multiply(self::power(self.opaque(*opaque), power));
                }
            }
            total = total.plus(range);
            size += range.size();
        }
        total.low >= -NOTHING * size && size.is_finite() || total.low >= 0.0
    }

    /// Bisects the box: at the number with which an undecided comparison compares an input; otherwise the widest
    /// relevant input, at 0, at its geometric mean if it has one sign and spans more than a factor of 2, or at its
    /// midpoint.
    fn halves(&self, claim: &Claim) -> Option<[Cell; 2]> {
        let mut matters = vec![false; self.func.ops.len()];
        claim.any.iter().chain(claim.unless).for_each(|value| matters[value.index()] = true);
        let mut inputs: Vec<Slot> = Vec::new();
        for i in (0..self.func.ops.len()).rev() {
            if !matters[i] {
                continue;
            }
            let op = &self.func.ops[i];
            match op {
                Op::Select(condition, a, b) => match self.truth(*condition) {
                    Some(yes) => matters[if yes { a } else { b }.index()] = true,
                    None => [condition, a, b].into_iter().for_each(|value| matters[value.index()] = true),
                },
                Op::Less(..) | Op::LessEqual(..) | Op::Equal(..) if self.truths[i].is_some() => {}
                Op::Load(slot) => inputs.push(*slot),
                op => op.each_operand(|operand| matters[operand.index()] = true),
            }
        }
        for (i, op) in self.func.ops.iter().enumerate().filter(|(i, _)| matters[*i] && self.truths[*i].is_none()) {
            let (Op::Less(a, b) | Op::LessEqual(a, b)) = *op else { continue };
            let load = |value: Value| match self.func.ops[value.index()] {
                Op::Load(slot) => Some(slot),
                _ => None,
            };
            let number = |value: Value| {
                let range = self.ranges[value.index()];
                (range.low == range.high).then_some(range.low)
            };
            let (slot, at, below) = match (load(a), number(b), load(b), number(a)) {
                (Some(slot), Some(at), ..) => (slot, at, true),
                (.., Some(slot), Some(at)) => (slot, at, false),
                _ => continue,
            };
            let half = |low: bool| {
                let mut cell = self.cell.clone();
                let (_, range) = cell.inputs.iter_mut().find(|(input, _)| *input == slot)?;
                *range = range.and(if low { Interval::to(at) } else { Interval::from(at) });
                cell.depth += 1;
                cell.facts.push((Value(i as u32), low == below));
                Some(cell)
            };
            return Some([half(true)?, half(false)?]);
        }
        let width = |range: &Interval| match (range.low, range.high) {
            (low, high) if low > 0.0 => (high / low).min(1e300) - 1.0,
            (low, high) if high < 0.0 => (low / high).min(1e300) - 1.0,
            // The ratio of the ends is meaningless across zero.
            (low, high) => {
                if low == high {
                    0.0
                } else {
                    1.0
                }
            }
        };
        let (at, range) = self
            .cell
            .inputs
            .iter()
            .enumerate()
            .filter(|(_, (slot, _))| inputs.contains(slot))
            .map(|(k, (_, range))| (k, *range))
            .max_by(|a, b| width(&a.1).total_cmp(&width(&b.1)).then(b.0.cmp(&a.0)))?;
        let middle = match (range.low, range.high) {
            (low, high) if low > 0.0 && high > 2.0 * low => (low.sqrt() * high.min(1e300).sqrt()).clamp(low, high),
            (low, high) if high < 0.0 && low < 2.0 * high => -(low.max(-1e300).abs().sqrt() * high.abs().sqrt()),
            (low, high) if low < 0.0 && high > 0.0 => 0.0,
            (low, high) => 0.5 * low.max(-1e300) + 0.5 * high.min(1e300),
        };
        let inside = range.low < middle && middle < range.high;
        inside.then(|| {
            [Interval::to(middle), Interval::from(middle)].map(|half| {
                let mut cell = self.cell.clone();
                cell.inputs[at].1 = range.and(half);
                cell.depth += 1;
                cell
            })
        })
    }
}

/// The interval of min(a, b) or max(a, b), if a selection computes one of them. `x` and `y`: the intervals of a and b.
fn smaller_or_larger(func: &Func, condition: Value, a: Value, b: Value, x: Interval, y: Interval) -> Option<Interval> {
    match func.ops[condition.index()] {
        Op::Less(p, q) | Op::LessEqual(p, q) if (p, q) == (a, b) => Some(x.min(y)),
        Op::Less(p, q) | Op::LessEqual(p, q) if (p, q) == (b, a) => Some(x.max(y)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::functions::{Binary, Unary};
    use crate::interval::planted;
    use crate::ir::build::Build;
    use crate::ir::random::Random;

    const X: Slot = Slot(0);
    const Y: Slot = Slot(1);

    /// Whether `f(x, y)` is proven non-negative for x in −1..1 and y in 0.001..10.
    fn proven(f: impl Fn(&mut Build, Value, Value) -> Value) -> bool {
        let mut build = Build::new("claim");
        let (x, y) = (build.load(X), build.load(Y));
        let value = f(&mut build, x, y);
        build.store(Slot(2), value);
        let func = build.finish();
        let value = func.stores[0].1;
        let inputs = [(X, Interval::closed(-1.0, 1.0)), (Y, Interval::closed(1e-3, 10.0))];
        let claim = Claim { func: &func, any: &[value], unless: &[] };
        let mut work = 1_000_000;
        prove(&claim, &inputs, &[], &mut work)
    }

    #[test]
    fn terms_cancel_symbolically() {
        // (x + y)² − x² − 2xy = y²
        assert!(proven(|b, x, y| {
            let sum = b.add(x, y);
            let square = b.mul(sum, sum);
            let (xx, xy) = (b.mul(x, x), b.mul(x, y));
            let two = b.add(xy, xy);
            let rest = b.sub(square, xx);
            b.sub(rest, two)
        }));
        // x y − x (y − y x / 2) = y x²/2: a bristle returns no more energy than it has stored.
        assert!(proven(|b, x, y| {
            let half = b.real(0.5);
            let part = b.mul(y, x);
            let slip = b.mul(part, half);
            let rate = b.sub(y, slip);
            let (took, kept) = (b.mul(x, y), b.mul(x, rate));
            b.sub(took, kept)
        }));
    }

    #[test]
    fn boxes_are_bisected_where_needed() {
        // x² − x + 0.3 has its minimum, 0.05, at 0.5; with 0.2 it is negative there.
        let parabola = |c: f64| {
            move |b: &mut Build, x: Value, _: Value| {
                let (square, c) = (b.mul(x, x), b.real(c));
                let rest = b.sub(square, x);
                b.add(rest, c)
            }
        };
        assert!(proven(parabola(0.3)) && !proven(parabola(0.2)));
        // y / (1 + x²) − 0.0004
        let quotient = |c: f64| {
            move |b: &mut Build, x: Value, y: Value| {
                let (square, one, c) = (b.mul(x, x), b.real(1.0), b.real(c));
                let below = b.add(one, square);
                let q = b.div(y, below);
                b.sub(q, c)
            }
        };
        assert!(proven(quotient(0.0004)) && !proven(quotient(0.0006)));
    }

    #[test]
    fn conditions_decide_branches_within_a_box() {
        // min(x, 0.25) − x ≤ 0, and exactly 0 below.
        let clipped = |sign: f64| {
            move |b: &mut Build, x: Value, _: Value| {
                let (quarter, sign) = (b.real(0.25), b.real(sign));
                let min = b.min(x, quarter);
                let rest = b.sub(min, x);
                b.mul(sign, rest)
            }
        };
        assert!(proven(clipped(-1.0)) && !proven(clipped(1.0)));
        // A jump: 1 up to 0.5 and −1 beyond.
        assert!(!proven(|b, x, _| {
            let (half, one, less) = (b.real(0.5), b.real(1.0), b.real(-1.0));
            let beyond = b.less(half, x);
            b.select(beyond, less, one)
        }));
        // exp(−x²) − 0.36 > 0 for |x| ≤ 1
        assert!(proven(|b, x, _| {
            let (square, c) = (b.mul(x, x), b.real(0.36));
            let minus = b.neg(square);
            let bell = b.unary(Unary::Exp, minus);
            b.sub(bell, c)
        }));
    }

    #[test]
    fn exceptions_exclude_their_part_of_the_box() {
        let mut build = Build::new("claim");
        let (x, zero) = (build.load(X), build.real(0.0));
        let (negative, one) = (build.less(x, zero), build.real(1.0));
        let chosen = build.select(negative, one, zero);
        build.store(Slot(2), chosen);
        build.store(Slot(3), x);
        let func = build.finish();
        let stored = |slot: Slot| func.stores.iter().find(|(at, _)| *at == slot).expect("it is stored").1;
        let x = stored(Slot(3));
        let Op::Select(negative, ..) = func.ops[stored(Slot(2)).index()] else { panic!("a choice") };
        let inputs = [(X, Interval::closed(-1.0, 1.0))];
        for (unless, wanted) in [(vec![negative], true), (vec![], false)] {
            let claim = Claim { func: &func, any: &[x], unless: &unless };
            assert_eq!(prove(&claim, &inputs, &[], &mut 10_000), wanted);
        }
    }

    /// A function of three inputs that stores the value of each operation, with elementary functions among them.
    fn random_function(random: &mut Random) -> Func {
        let mut build = Build::new("random");
        let mut values: Vec<Value> = (0..3).map(|slot| build.load(Slot(slot))).collect();
        for number in [0.0, 1.0, -2.5, 1e-3] {
            values.push(build.real(number));
        }
        for _ in 0..10 {
            let mut pick = || values[random.below(values.len())];
            let (x, y, z) = (pick(), pick(), pick());
            let value = match random.below(14) {
                0 => build.add(x, y),
                1 => build.sub(x, y),
                2 => build.mul(x, y),
                3 => build.mul(x, x),
                4 => build.div(x, y),
                5 => build.fma(x, y, z),
                6 => build.neg(x),
                7 => build.abs(x),
                8 => build.sqrt(x),
                9 => build.min(x, y),
                10 => build.max(x, y),
                11 => {
                    let less = build.less(x, y);
                    build.select(less, z, x)
                }
                12 => build.unary(Unary::ALL[random.below(Unary::ALL.len())], x),
                _ => build.binary(Binary::ALL[random.below(Binary::ALL.len())], x, y),
            };
            values.push(value);
        }
        for (k, value) in values.into_iter().enumerate() {
            build.store(Slot(3 + k as u32), value);
        }
        build.finish()
    }

    /// An end of a box: of either sign, and of any magnitude.
    fn end(random: &mut Random) -> f64 {
        let size = [0.0, 1e-300, 1e-40, 1e-3, 0.3, 1.0, 1.0, 7.3, 40.0, 1e6][random.below(10)];
        random.within(-1.0, 1.0).signum() * size * [1.0, random.within(0.5, 1.0)][random.below(2)]
    }

    /// Every value that a function computes from a point of a box lies in its interval. Exempt are values that are not
    /// finite, and those computed from them.
    fn values_lie_in_their_intervals(functions: u64) {
        let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(0xB0C5);
        let (mut checked, mut bounded) = (0, 0);
        for case in 0..functions {
            let mut random = Random(seed + case);
            let func = random_function(&mut random);
            let ends: [[f64; 2]; 3] = std::array::from_fn(|_| [end(&mut random), end(&mut random)]);
            let inputs: Vec<(Slot, Interval)> = (0..3)
                .map(|k| {
                    (
                        Slot(k),
                        Interval::closed(
                            ends[k as usize][0].min(ends[k as usize][1]),
                            ends[k as usize][0].max(ends[k as usize][1]),
                        ),
                    )
                })
                .collect();
            let cell = Cell { inputs: inputs.clone(), facts: Vec::new(), depth: 0 };
            let (live, mut work) = (func.live(), 0);
            let ranges = Bounds::new(&func, &live, &cell, &[], &mut work).ranges;
            let expanded = crate::math::expand(&func);
            for _ in 0..8 {
                let mut block = vec![0.0; 3 + func.stores.len()];
                for (slot, range) in &inputs {
                    let inside = random.within(0.0, 1.0);
                    let x = [range.low, range.high, range.low + inside * (range.high - range.low)][random.below(3)];
                    block[slot.index()] = x.clamp(range.low, range.high);
                }
                let at = block[..3].to_vec();
                crate::ir::interpret::run_once(&expanded, &mut block, crate::math::pool());
                let stored: HashMap<Value, f64> =
                    func.stores.iter().map(|(slot, value)| (*value, block[slot.index()])).collect();
                let mut finite = vec![true; func.ops.len()];
                for (i, op) in func.ops.iter().enumerate() {
                    let found = stored.get(&Value(i as u32)).copied();
                    op.each_operand(|operand| finite[i] &= finite[operand.index()]);
                    finite[i] &= found.is_none_or(f64::is_finite);
                    let (Some(y), true) = (found, finite[i]) else { continue };
                    let range = ranges[i];
                    checked += 1;
                    bounded += u32::from(range != Interval::ALL);
                    assert!(
                        y >= range.low && y <= range.high && y.abs() >= range.away,
                        "seed {}: v{i} = {y:e} in {range:?} at {at:?}\n{func}",
                        seed + case
                    );
                }
            }
        }
        assert!(bounded * 2 > checked, "{bounded} of {checked} values have a bound");
    }

    #[test]
    fn values_of_random_functions_lie_in_their_intervals() {
        values_lie_in_their_intervals(4000);
    }

    #[test]
    fn mistakes_in_interval_arithmetic_are_detected() {
        for fault in ["ends do not round", "products are never too small", "tanh never reaches 1"] {
            planted::plant(fault);
            let found = std::panic::catch_unwind(|| values_lie_in_their_intervals(40_000));
            planted::plant("");
            assert!(found.is_err(), "{fault}");
        }
    }
}
