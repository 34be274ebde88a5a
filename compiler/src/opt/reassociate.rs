//! Regroups sums and products so that what is ready last enters last: one step is bound by latency.
//!
//! In: a step, before elementary functions are expanded. Out: the same algebra with the shortest chain from the states
//! to the states of the next step. This rounds differently from the text's order, so it is part of what a step *is*:
//! it stands before every back end. It touches only what the longest of these chains needs to get shorter, so sums that
//! have time keep the text's order, and with it their exact cancellations:
//!
//! - x / p → x · (1/p) for p that no iteration changes, where 1/p is computed once, or that depends on time alone, where it
//!   is computed ahead.
//! - Factors are multiplied in the order in which they are ready, constants of the loop first, divisors last:
//!   `sigma0 * abs(v) / g * z` → `(sigma0 |v| z) / g`.
//! - What is affine in a late value L is split: f(L) → f(0) + C L, with C a constant of the loop or of time alone:
//!   v + h (u − (σ0 z + σ1 (w − L)))/m → [v + h (u − (σ0 z + σ1 w))/m] + (h σ1/m) L.

use crate::ir::build::Build;
use crate::ir::{Binary, Func, Op, Unary, Value};
use abi::Slot;
use std::collections::HashSet;

/// When a value is ready, in processor cycles after the beginning of an iteration; none: it is constant in the loop.
type Ready = Option<i32>;

/// When time is ready: long before, for no state holds it back. What depends on time alone stays below 0, and keeps its order.
const EARLY: i32 = i32::MIN / 2;

/// Cycles, of two sums, from which on it is worth to split a sum on the way to what is affine throughout.
const WORTH: i32 = 6;

/// Regroups a function that is iterated. `balanced`: differences of equal forces must stay exactly 0, as a contact at rest
/// needs it, so no sum is split.
pub fn reassociate(func: &Func, balanced: bool) -> Func {
    let carried = carried(func);
    let after = after(func, &carried);
    // First everything, to learn how short the longest chain can be; then only what is needed for that.
    let (_, shortest) = rebuilt(func, Pass::new(func, &carried, balanced), &after, 0);
    rebuilt(func, Pass::new(func, &carried, balanced), &after, shortest).0
}

/// Slots that an iteration takes over from the one before, time and the count of steps apart: no state holds them back.
pub(super) fn carried(func: &Func) -> HashSet<Slot> {
    let stored: HashSet<Slot> = func.stores.iter().map(|(slot, _)| *slot).collect();
    let waits = |slot: &Slot| stored.contains(slot) && ![Slot::TIME, Slot::COUNT].contains(slot);
    func.loads().into_iter().filter(waits).collect()
}

/// The function rebuilt so that chains longer than `enough` cycles get shorter, and its longest chain.
fn rebuilt(func: &Func, mut pass: Pass, after: &[Ready], enough: i32) -> (Func, i32) {
    let mut values: Vec<Value> = Vec::with_capacity(func.ops.len());
    for (op, after) in func.ops.iter().zip(after) {
        let op = op.map(|operand| values[operand.index()]);
        let plain = pass.op(op);
        let long = after.zip(pass.at(plain)).is_some_and(|(after, ready)| ready + after > enough);
        values.push(if long { pass.sooner(plain) } else { plain });
    }
    let handed = func.stores.iter().filter(|(slot, _)| pass.carried.contains(slot));
    let longest = handed.filter_map(|(_, value)| pass.at(values[value.index()])).fold(0, i32::max);
    (pass.build.finish_as(func, &values), longest)
}

/// For each operation, the cycles from its value to a result; none if no result needs it.
fn after(func: &Func, results: &HashSet<Slot>) -> Vec<Ready> {
    let mut after = vec![None; func.ops.len()];
    for (slot, value) in &func.stores {
        if results.contains(slot) {
            after[value.index()] = Some(0);
        }
    }
    for i in (0..func.ops.len()).rev() {
        if let Some(rest) = after[i] {
            let through = Some(rest + latency(func.ops[i]));
            func.ops[i].each_operand(|operand| after[operand.index()] = after[operand.index()].max(through));
        }
    }
    after
}

/// Cycles of the longest chain from what an iteration takes over to what it hands on.
pub fn critical_path(func: &Func) -> u32 {
    let carried = carried(func);
    let mut ready: Vec<Ready> = Vec::with_capacity(func.ops.len());
    for op in &func.ops {
        let mut last = matches!(op, Op::Load(slot) if carried.contains(slot)).then_some(0);
        op.each_operand(|operand| last = last.max(ready[operand.index()]));
        ready.push(last.map(|last| last + latency(*op)));
    }
    let handed = func.stores.iter().filter(|(slot, _)| carried.contains(slot));
    handed.filter_map(|(_, value)| ready[value.index()]).fold(0, i32::max).cast_unsigned()
}

/// Latency in cycles, rounded from current processors; only its order of size matters.
pub(super) fn latency(op: Op) -> i32 {
    match op {
        Op::Real(_) | Op::Int(_) | Op::Bool(_) | Op::Load(_) => 0,
        Op::Neg(_) | Op::Abs(_) => 1,
        Op::Add(..) | Op::Sub(..) => 3,
        Op::Mul(..) | Op::Fma(..) => 4,
        Op::Div(..) => 14,
        Op::Sqrt(_) => 18,
        Op::Floor(_) | Op::Nearest(_) => 8,
        Op::Less(..) | Op::LessEqual(..) | Op::Equal(..) | Op::Select(..) => 3,
        Op::And(..) | Op::Or(..) | Op::Not(_) => 1,
        Op::IntAdd(..) | Op::IntSub(..) | Op::IntAnd(..) | Op::IntOr(..) | Op::IntXor(..) => 1,
        Op::ShiftLeft(..) | Op::ShiftRight(..) | Op::ShiftRightSigned(..) => 1,
        Op::IntMul(..) | Op::IntLess(..) | Op::IntEqual(..) => 3,
        Op::ToBits(_) | Op::FromBits(_) => 3,
        Op::Pool { .. } | Op::Ring { .. } | Op::ToInt(_) | Op::ToReal(_) => 7,
        Op::Unary(Unary::Exp, _) => 36,
        Op::Unary(Unary::Log | Unary::Expm1 | Unary::Log1p | Unary::Sin | Unary::Cos, _) => 45,
        Op::Unary(
            Unary::Tan | Unary::Asin | Unary::Acos | Unary::Atan | Unary::Sinh | Unary::Cosh | Unary::Tanh,
            _,
        ) => 80,
        Op::Binary(Binary::Atan2 | Binary::Pow | Binary::Hypot, ..) => 100,
    }
}

struct Pass<'a> {
    build: Build,
    /// Of every value of the builder.
    ready: Vec<Ready>,
    carried: &'a HashSet<Slot>,
    balanced: bool,
}

/// A product of values over a product of values.
#[derive(Default)]
struct Product {
    above: Vec<Value>,
    below: Vec<Value>,
}

impl<'a> Pass<'a> {
    fn new(func: &Func, carried: &'a HashSet<Slot>, balanced: bool) -> Pass<'a> {
        Pass { build: Build::new(&func.name), ready: Vec::new(), carried, balanced }
    }

    fn op(&mut self, op: Op) -> Value {
        let value = self.build.op(op);
        self.note();
        value
    }

    /// Notes when the values that are new are ready.
    fn note(&mut self) {
        while self.ready.len() < self.build.len() {
            let op = self.build.get(Value(self.ready.len() as u32));
            let mut last = match op {
                Op::Load(slot) if self.carried.contains(&slot) => Some(0),
                Op::Load(Slot::TIME | Slot::COUNT) => Some(EARLY),
                Op::Ring { .. } => Some(0),
                _ => None,
            };
            op.each_operand(|operand| last = last.max(self.ready[operand.index()]));
            self.ready.push(last.map(|last| last + latency(op)));
        }
    }

    fn at(&self, value: Value) -> Ready {
        self.ready[value.index()]
    }

    /// Whether no state holds it back: it is constant in the loop or depends on time alone.
    fn is_early(&self, value: Value) -> bool {
        self.at(value).is_none_or(|ready| ready < 0)
    }

    /// The value, or the same computed earlier.
    fn sooner(&mut self, plain: Value) -> Value {
        let other = match self.build.get(plain) {
            Op::Mul(..) | Op::Div(..) => self.product(plain),
            Op::Add(..) | Op::Sub(..) if !self.balanced => self.split(plain),
            _ => plain,
        };
        if self.at(other) < self.at(plain) { other } else { plain }
    }

    /// A product with its factors in the order in which they are ready.
    fn product(&mut self, value: Value) -> Value {
        let mut product = Product::default();
        self.factors(value, false, &mut product);
        let above = self.multiplied(product.above);
        match self.multiplied(product.below) {
            None => above.expect("a product has a factor"),
            Some(below) => {
                let above = above.unwrap_or_else(|| self.op(Op::Real(1f64.to_bits())));
                self.op(Op::Div(above, below))
            }
        }
    }

    /// Collects factors; divisors that no state holds back become factors.
    fn factors(&mut self, value: Value, inverted: bool, product: &mut Product) {
        // Deep enough for physics, and bounded.
        let full = product.above.len() + product.below.len() >= 8;
        match self.build.get(value) {
            Op::Mul(a, b) if !full && self.at(value).is_some() => {
                self.factors(a, inverted, product);
                self.factors(b, inverted, product);
            }
            Op::Div(a, b) if !full && self.at(value).is_some() => {
                self.factors(a, inverted, product);
                self.factors(b, !inverted, product);
            }
            _ if inverted && self.is_early(value) => {
                let one = self.op(Op::Real(1f64.to_bits()));
                let inverse = self.op(Op::Div(one, value));
                product.above.push(inverse);
            }
            _ if inverted => product.below.push(value),
            _ => product.above.push(value),
        }
    }

    /// The product of all: always of the two that are ready first.
    fn multiplied(&mut self, mut factors: Vec<Value>) -> Option<Value> {
        while factors.len() > 1 {
            factors.sort_by_key(|value| std::cmp::Reverse((self.at(*value), *value)));
            let (a, b) = (factors.pop().expect("two"), factors.pop().expect("two"));
            let product = self.op(Op::Mul(a, b));
            factors.push(product);
        }
        factors.pop()
    }

    /// A sum that is affine in a late value L, as what it is without L, plus C · L.
    fn split(&mut self, sum: Value) -> Value {
        // Down the operand that is ready last, as long as the result is affine in it.
        let mut links: Vec<(Op, Value)> = Vec::new();
        let mut late = sum;
        while links.len() < 16 {
            let op = self.build.get(late);
            late = match op {
                Op::Neg(a) => a,
                Op::Add(a, b) | Op::Sub(a, b) => {
                    if self.at(a) > self.at(b) {
                        a
                    } else {
                        b
                    }
                }
                Op::Mul(a, b) if self.is_early(a) => b,
                Op::Mul(a, b) if self.is_early(b) => a,
                _ => break,
            };
            links.push((op, late));
            if self.is_early(late) {
                return sum;
            }
        }
        let whole = self.split_at(sum, &links);
        if self.at(whole) < self.at(sum) {
            return whole;
        }
        // Where all is affine, what is on the way down is as late as the last. Some operations stand twice then, for what is
        // split there is read elsewhere, too: it is to be worth them.
        let parts: Vec<Value> = (1..links.len()).map(|length| self.split_at(sum, &links[..length])).collect();
        let soonest = parts.into_iter().min_by_key(|part| self.at(*part)).unwrap_or(sum);
        let spared = self.at(sum).zip(self.at(soonest)).map_or(0, |(sum, soonest)| sum - soonest);
        if spared >= WORTH { soonest } else { sum }
    }

    /// A sum split at the last of these links, each an operation that is affine in its operand.
    fn split_at(&mut self, sum: Value, links: &[(Op, Value)]) -> Value {
        let Some((_, late)) = links.last() else { return sum };
        let (mut rest, mut factor, mut negative): (Option<Value>, Option<Value>, bool) = (None, None, false);
        for (op, operand) in links.iter().rev() {
            let operand = *operand;
            match *op {
                Op::Neg(_) => {
                    rest = rest.map(|rest| self.op(Op::Neg(rest)));
                    negative = !negative;
                }
                Op::Add(a, b) => {
                    let other = if operand == a { b } else { a };
                    rest = Some(rest.map_or(other, |rest| self.op(Op::Add(rest, other))));
                }
                Op::Sub(a, b) if operand == a => {
                    rest = Some(match rest {
                        Some(rest) => self.op(Op::Sub(rest, b)),
                        None => self.op(Op::Neg(b)),
                    });
                }
                Op::Sub(a, _) => {
                    rest = Some(rest.map_or(a, |rest| self.op(Op::Sub(a, rest))));
                    negative = !negative;
                }
                Op::Mul(a, b) => {
                    let constant = if operand == a { b } else { a };
                    rest = rest.map(|rest| self.op(Op::Mul(constant, rest)));
                    factor = Some(factor.map_or(constant, |factor| self.op(Op::Mul(factor, constant))));
                }
                _ => unreachable!("links are affine"),
            }
        }
        let Some(rest) = rest else { return sum };
        let product = factor.map_or(*late, |factor| self.op(Op::Mul(factor, *late)));
        self.op(if negative { Op::Sub(rest, product) } else { Op::Add(rest, product) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::expr::{Real, Shared};
    use crate::ir::random::Random;
    use abi::Layout;

    /// Three parameters, two states.
    fn layout() -> Layout {
        Layout::new([3, 0, 2, 0, 0, 0, 0, 0, 0, 0])
    }

    fn built(next: impl for<'a> Fn([Real<'a>; 3], [Real<'a>; 2]) -> [Real<'a>; 2]) -> Func {
        let layout = layout();
        let build = Shared::new(Build::new("step"));
        let load = |slot| Real::new(&build, build.borrow_mut().load(slot));
        let p = [0, 1, 2].map(|k| load(layout.params.slot(k)));
        let next = next(p, [0, 1].map(|k| load(layout.states.slot(k)))).map(|x| x.value);
        let mut build = build.into_inner();
        next.into_iter().enumerate().for_each(|(k, x)| build.store(layout.states.slot(k), x));
        build.finish()
    }

    #[track_caller]
    fn check(func: &Func, expected: &str) {
        let listing = reassociate(func, false).to_string();
        let found: Vec<&str> = listing.lines().skip(1).map(str::trim).collect();
        assert_eq!(found.join("; "), expected);
    }

    #[test]
    fn a_divisor_that_is_constant_becomes_a_factor() {
        check(
            &built(|[p, ..], [x, y]| [x / p, y]),
            "v0 = load 3; v1 = load 6; v2 = 1.0; v3 = div v2 v0; v4 = mul v1 v3; store 6 = v4",
        );
    }

    #[test]
    fn what_has_time_keeps_its_order() {
        // The second state is there long before the first: its division and its sum stay as they are.
        let func = built(|[p, q, _], [x, y]| [(-(x * x).of(Unary::Exp)).of(Unary::Exp), y / p + q * (x * x - x)]);
        assert_eq!(reassociate(&func, false).to_string(), func.to_string());
    }

    #[test]
    fn late_factors_come_last_and_the_late_divisor_after_them() {
        // p · |x| / g · y with g from x: one division after g.
        let func = built(|[p, q, _], [x, y]| {
            let g = q + (x * x).of(Unary::Exp);
            [p * x.abs() / g * y, y]
        });
        let listing = reassociate(&func, false).to_string();
        let last: Vec<&str> = listing.lines().rev().take(2).collect();
        assert!(last[1].contains("= div"), "{listing}");
    }

    #[test]
    fn what_is_affine_in_something_late_is_split() {
        // x + p (y − q exp(x)): the exponential enters last, with p q before it.
        let func = built(|[p, q, _], [x, y]| [x + p * (y - q * x.of(Unary::Exp)), y]);
        let listing = reassociate(&func, false).to_string();
        let expected = "v0 = load 3; v1 = load 4; v2 = load 6; v3 = load 7; v4 = exp v2; v5 = mul v0 v3; \
                        v6 = mul v0 v1; v7 = add v2 v5; v8 = mul v4 v6; v9 = sub v7 v8; store 6 = v9";
        let found: Vec<&str> = listing.lines().skip(1).map(str::trim).collect();
        assert_eq!(found.join("; "), expected);
    }

    #[test]
    fn time_is_there_before_the_states() {
        // z + h (v − p |v| / g z) with v and g of time: 1/g and z + h v are computed ahead, and one fused product is left.
        let layout = layout();
        let build = Shared::new(Build::new("step"));
        let load = |slot| Real::new(&build, build.borrow_mut().load(slot));
        let (t, h, p, z) =
            (load(Slot::TIME), load(Slot::STEP), load(layout.params.slot(0)), load(layout.states.slot(0)));
        let v = t.of(Unary::Sin);
        let g = 1.0 + (-(v * v)).of(Unary::Exp);
        let next = (z + h * (v - p * v.abs() / g * z)).value;
        let mut build = build.into_inner();
        build.store(layout.states.slot(0), next);
        let func = crate::opt::contract::contract(&reassociate(&build.finish(), false), &layout);
        assert!(critical_path(&func) <= 11, "{func}");
    }

    #[test]
    fn where_all_is_affine_a_sum_is_split_on_the_way_down() {
        // An observer of place and speed, both iterated: r = v + 2 p (q − X) + m (x − X), X' = x + h r, V' = v + h (q − X).
        let func = built(|[p, q, m], [x, v]| {
            let (mut place, mut speed) = (x, v);
            for _ in 0..3 {
                let rate = speed + 2.0 * p * (q - place) + m * (x - place);
                (place, speed) = (x + 1e-3 * rate, v + 1e-3 * (p * p * (q - place)));
            }
            [place, speed]
        });
        let [plain, regrouped] = [func.clone(), reassociate(&func, false)].map(|func| critical_path(&func));
        assert!(regrouped + 9 <= plain, "{plain} cycles, {regrouped} regrouped");
    }

    /// The same algebra: values agree up to rounding.
    #[test]
    fn values_stay_the_same_up_to_rounding() {
        let func = built(|[p, q, m], [x, y]| {
            let g = 1.0 + p * (-(x * x)).of(Unary::Exp);
            let late = q * x.abs() / g * y;
            let force = p * y + q * (x - late) + 0.4 * x;
            [x + 1e-3 * ((m - force) / m), y + 1e-3 * (x - late)]
        });
        let [one, other] = [&func, &reassociate(&func, false)].map(crate::math::expand);
        let mut random = Random(5);
        for _ in 0..1000 {
            let mut block: Vec<f64> = (0..layout().size()).map(|_| random.within(0.1, 2.0)).collect();
            let mut again = block.clone();
            crate::ir::interpret::run_once(&one, &mut block, &crate::math::POOL);
            crate::ir::interpret::run_once(&other, &mut again, &crate::math::POOL);
            for (a, b) in block.iter().zip(&again) {
                assert!((a - b).abs() <= 4.0 * f64::EPSILON * a.abs(), "{block:?} and {again:?}");
            }
        }
    }
}
