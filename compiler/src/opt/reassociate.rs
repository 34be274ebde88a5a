//! Reassociation: regroups sums and products to shorten the loop-carried critical path of a step.
//!
//! In: a step function, before elementary functions are expanded. Out: the same algebra, grouped such that the operand
//! that is ready last enters last. One instance is bound by latency, not by throughput: the length of the dependency
//! chain from the states of one step to the states of the next determines its speed. Regrouping changes how results are
//! rounded. The pass therefore runs before every back end, so that all of them compute the same bits.
//!
//! Only chains longer than the shortest achievable critical path are regrouped. All other sums keep the order of the
//! source text, and so keep their exact cancellations. There are four rewrites:
//!
//! - x / p → x · (1/p), if p is loop-invariant or depends on time alone. 1/p is then computed outside the loop.
//! - Factors are multiplied in the order in which they are ready: invariants first, late factors last, and one division
//!   by the product of the late divisors at the end. `sigma0 * abs(v) / g * z` → `(sigma0 |v| z) / g`.
//! - An expression f that is affine in a late value L is split: f(L) → f(0) + C L, where C is invariant or depends on
//!   time alone: v + h (u − (σ0 z + σ1 (w − L)))/m → [v + h (u − (σ0 z + σ1 w))/m] + (h σ1/m) L.
//! - A sum that one state enters more than once is collapsed if it is affine in this state, with coefficients that depend
//!   on no state: z + h (v − C z) → (1 − h C) z + h v. All stages of a method become one fused product, and loop
//!   distribution computes the coefficients ahead.
//!
//! Sources: Briggs, Cooper, *Effective Partial Redundancy Elimination*, 1994 (reassociation by rank); Parker,
//! *Combinatorial Merging and Huffman's Algorithm*, 1979 (operands that are ready first are combined first).

use crate::ir::build::Build;
use crate::ir::hash::{HashMap, HashSet};
use crate::ir::{Func, Op, Value};
use crate::opt::twins::Twins;
use abi::Slot;

/// When a value is ready, in processor cycles after the start of an iteration. `None`: the value is loop-invariant.
type Ready = Option<i32>;

/// When time is ready: long before the iteration, because it depends on no state. Values that depend on time alone are
/// also ready before cycle 0, and keep their order.
const EARLY: i32 = i32::MIN / 2;

/// Smallest gain, in cycles, for which a sum is split in the middle of an affine chain: the latency of two additions.
const MIN_GAIN: i32 = 6;

/// Most operations from a state to a sum that is collapsed: bounds the recursion.
const MOST_LINKS: u32 = 100;

/// Regroups a function that runs in a loop. `balanced`: opposite forces of equal size must cancel to exactly 0, which a
/// contact at rest needs; sums are then not split.
pub fn reassociate(func: &Func, balanced: bool) -> Func {
    let carried = carried(func);
    let (after, twins) = (after(func, &carried), Twins::of(func));
    // The first pass regroups every chain and finds the shortest critical path; the second regroups only longer chains.
    let (_, shortest) = rebuild(func, Pass::new(func, &carried, balanced), &after, twins.clone(), 0);
    rebuild(func, Pass::new(func, &carried, balanced), &after, twins, shortest).0
}

/// The loop-carried slots: an iteration loads what the previous one stored. Time and the step count are excluded,
/// because they depend on no state.
pub(super) fn carried(func: &Func) -> HashSet<Slot> {
    let stored: HashSet<Slot> = func.stores.iter().map(|(slot, _)| *slot).collect();
    let is_carried = |slot: &Slot| stored.contains(slot) && ![Slot::TIME, Slot::COUNT].contains(slot);
    func.loads().into_iter().filter(is_carried).collect()
}

/// Rebuilds the function, regroups the chains longer than `critical_path` cycles, and returns it with its own critical
/// path, in cycles.
fn rebuild(func: &Func, mut pass: Pass, after: &[Ready], mut twins: Twins, critical_path: i32) -> (Func, i32) {
    let mut values: Vec<Value> = Vec::with_capacity(func.ops.len());
    for (op, after) in func.ops.iter().zip(after) {
        if let Some(twin) = twins.copy(&values, &mut pass.build) {
            pass.record_ready();
            values.push(twin);
            continue;
        }
        let op = op.map(|operand| values[operand.index()]);
        let plain = pass.op(op);
        let long = after.zip(pass.ready_at(plain)).is_some_and(|(after, ready)| ready + after > critical_path);
        values.push(if long { pass.earlier(plain) } else { plain });
    }
    let stored = func.stores.iter().filter(|(slot, _)| pass.carried.contains(slot));
    let longest = stored.filter_map(|(_, value)| pass.ready_at(values[value.index()])).fold(0, i32::max);
    (pass.build.finish_as(func, &values), longest)
}

/// For each operation, the latency in cycles from its value to a loop-carried result. `None`: no such result needs it.
fn after(func: &Func, results: &HashSet<Slot>) -> Vec<Ready> {
    let mut after = vec![None; func.ops.len()];
    for (slot, value) in &func.stores {
        if results.contains(slot) {
            after[value.index()] = Some(0);
        }
    }
    for i in (0..func.ops.len()).rev() {
        if let Some(cycles) = after[i] {
            let through = Some(cycles + latency(func.ops[i]));
            func.ops[i].each_operand(|operand| after[operand.index()] = after[operand.index()].max(through));
        }
    }
    after
}

/// Latency, in cycles, of the longest chain from a loop-carried load to a loop-carried store.
pub fn critical_path(func: &Func) -> u32 {
    let carried = carried(func);
    let mut ready: Vec<Ready> = Vec::with_capacity(func.ops.len());
    for op in &func.ops {
        let mut last = matches!(op, Op::Load(slot) if carried.contains(slot)).then_some(0);
        op.each_operand(|operand| last = last.max(ready[operand.index()]));
        ready.push(last.map(|last| last + latency(*op)));
    }
    let stored = func.stores.iter().filter(|(slot, _)| carried.contains(slot));
    stored.filter_map(|(_, value)| ready[value.index()]).fold(0, i32::max).cast_unsigned()
}

/// Approximate latency on current processors, in cycles. Only the order of magnitude matters.
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
        Op::Unary(function, _) => function.row().latency,
        Op::Binary(function, ..) => function.row().latency,
    }
}

struct Pass<'a> {
    build: Build,
    /// For each value of the builder, when it is ready.
    ready: Vec<Ready>,
    /// For each value of the builder, the state in which it is affine.
    affine: Vec<Option<Affine>>,
    carried: &'a HashSet<Slot>,
    balanced: bool,
}

/// A value is C x + B, where x is a state at the start of the iteration, and C and B depend on no state.
#[derive(Clone, Copy)]
struct Affine {
    /// x
    state: Value,
    /// Whether x enters more than once.
    repeated: bool,
    /// Number of operations on the longest path from x.
    links: u32,
}

/// A product of values divided by a product of values.
#[derive(Default)]
struct Product {
    numerator: Vec<Value>,
    denominator: Vec<Value>,
}

impl<'a> Pass<'a> {
    fn new(func: &Func, carried: &'a HashSet<Slot>, balanced: bool) -> Pass<'a> {
        let build = Build::roomy(&func.name, func.ops.len());
        Pass { build, ready: Vec::new(), affine: Vec::new(), carried, balanced }
    }

    fn op(&mut self, op: Op) -> Value {
        let value = self.build.op(op);
        self.record_ready();
        value
    }

    /// Records when the values added since the last call are ready.
    fn record_ready(&mut self) {
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
            self.affine.push(self.affine_in(op));
        }
    }

    /// The state in which the result of an operation is affine.
    fn affine_in(&self, op: Op) -> Option<Affine> {
        let of = |value: Value| self.affine[value.index()];
        let found = match op {
            Op::Load(slot) if self.carried.contains(&slot) => {
                // The number of this operation, whose entry is about to be made.
                Some(Affine { state: Value(self.affine.len() as u32), repeated: false, links: 0 })
            }
            Op::Neg(a) => of(a),
            Op::Mul(a, b) if self.is_early(a) => of(b),
            Op::Mul(a, b) | Op::Add(a, b) | Op::Sub(a, b) if self.is_early(b) => of(a),
            Op::Add(a, b) | Op::Sub(a, b) if self.is_early(a) => of(b),
            Op::Add(a, b) | Op::Sub(a, b) => {
                let both = of(a).zip(of(b)).filter(|(a, b)| a.state == b.state);
                both.map(|(a, b)| Affine { repeated: true, links: a.links.max(b.links), ..a })
            }
            Op::Fma(a, b, offset) if self.is_early(offset) => {
                of(a).filter(|_| self.is_early(b)).or(of(b).filter(|_| self.is_early(a)))
            }
            _ => None,
        };
        found.map(|found| Affine { links: found.links + 1, ..found }).filter(|found| found.links <= MOST_LINKS)
    }

    fn ready_at(&self, value: Value) -> Ready {
        self.ready[value.index()]
    }

    /// Whether the value depends on no state: it is loop-invariant or depends on time alone.
    fn is_early(&self, value: Value) -> bool {
        self.ready_at(value).is_none_or(|ready| ready < 0)
    }

    /// Returns the value, or an equivalent one that is ready earlier.
    fn earlier(&mut self, plain: Value) -> Value {
        let other = match self.build.get(plain) {
            Op::Mul(..) | Op::Div(..) => self.product(plain),
            Op::Add(..) | Op::Sub(..) if self.balanced => plain,
            Op::Add(..) | Op::Sub(..) if self.affine[plain.index()].is_some_and(|affine| affine.repeated) => {
                self.collapse(plain)
            }
            Op::Add(..) | Op::Sub(..) => self.split(plain),
            _ => plain,
        };
        if self.ready_at(other) < self.ready_at(plain) { other } else { plain }
    }

    /// Computes a value that is affine in a state by one fused product, which is more exact than any other order.
    fn collapse(&mut self, value: Value) -> Value {
        let state = self.affine[value.index()].expect("it is affine").state;
        let [factor, offset] = self.coefficients(value, &mut HashMap::default());
        let factor = factor.expect("it depends on the state");
        match offset {
            Some(offset) => self.op(Op::Fma(factor, state, offset)),
            None => self.op(Op::Mul(factor, state)),
        }
    }

    /// C and B of an affine value C x + B; `None` for 0.
    fn coefficients(&mut self, value: Value, known: &mut HashMap<Value, [Option<Value>; 2]>) -> [Option<Value>; 2] {
        if self.is_early(value) {
            return [None, Some(value)];
        }
        if let Some(known) = known.get(&value) {
            return *known;
        }
        let one = self.op(Op::Real(1f64.to_bits()));
        let found = match self.build.get(value) {
            Op::Neg(a) => self.coefficients(a, known).map(|part| part.map(|part| self.op(Op::Neg(part)))),
            Op::Mul(a, b) => {
                let (by, of) = if self.is_early(a) { (a, b) } else { (b, a) };
                self.coefficients(of, known).map(|part| part.map(|part| self.op(Op::Mul(part, by))))
            }
            op @ (Op::Add(a, b) | Op::Sub(a, b)) => {
                let [of_a, of_b] = [a, b].map(|operand| self.coefficients(operand, known));
                let combined = |k: usize| match (of_a[k], of_b[k]) {
                    (Some(x), Some(y)) => Some(self.op(op.map(|operand| if operand == a { x } else { y }))),
                    (None, Some(y)) if matches!(op, Op::Sub(..)) => Some(self.op(Op::Neg(y))),
                    (x, y) => x.or(y),
                };
                [0, 1].map(combined)
            }
            Op::Fma(a, b, offset) => {
                let (factor, of) = if self.is_early(a) { (a, b) } else { (b, a) };
                let [c, b] = self.coefficients(of, known).map(|part| part.map(|part| self.op(Op::Mul(part, factor))));
                [c, Some(b.map_or(offset, |b| self.op(Op::Add(b, offset))))]
            }
            _ => [Some(one), None],
        };
        known.insert(value, found);
        found
    }

    /// Rebuilds a product so that its factors are multiplied in the order in which they are ready.
    fn product(&mut self, value: Value) -> Value {
        let mut product = Product::default();
        self.factors(value, false, &mut product);
        let numerator = self.multiply(product.numerator);
        match self.multiply(product.denominator) {
            None => numerator.expect("a product has a factor"),
            Some(denominator) => {
                let numerator = numerator.unwrap_or_else(|| self.op(Op::Real(1f64.to_bits())));
                self.op(Op::Div(numerator, denominator))
            }
        }
    }

    /// Collects the factors of a product. Each divisor that depends on no state becomes a factor, its inverse.
    fn factors(&mut self, value: Value, inverted: bool, product: &mut Product) {
        // Eight factors are enough for formulas of physics, and bound the recursion.
        let full = product.numerator.len() + product.denominator.len() >= 8;
        match self.build.get(value) {
            Op::Mul(a, b) if !full && self.ready_at(value).is_some() => {
                self.factors(a, inverted, product);
                self.factors(b, inverted, product);
            }
            Op::Div(a, b) if !full && self.ready_at(value).is_some() => {
                self.factors(a, inverted, product);
                self.factors(b, !inverted, product);
            }
            _ if inverted && self.is_early(value) => {
                let one = self.op(Op::Real(1f64.to_bits()));
                let inverse = self.op(Op::Div(one, value));
                product.numerator.push(inverse);
            }
            _ if inverted => product.denominator.push(value),
            _ => product.numerator.push(value),
        }
    }

    /// Multiplies all factors; each multiplication takes the two that are ready first.
    fn multiply(&mut self, mut factors: Vec<Value>) -> Option<Value> {
        while factors.len() > 1 {
            factors.sort_by_key(|value| std::cmp::Reverse((self.ready_at(*value), *value)));
            let (a, b) = (factors.pop().expect("two"), factors.pop().expect("two"));
            let product = self.op(Op::Mul(a, b));
            factors.push(product);
        }
        factors.pop()
    }

    /// Splits a sum that is affine in a late value L into the sum without L, plus C · L.
    fn split(&mut self, sum: Value) -> Value {
        // Follow the operand that is ready last, as long as the result is affine in it.
        let mut links: Vec<(Op, Value)> = Vec::new();
        let mut late = sum;
        while links.len() < 16 {
            let op = self.build.get(late);
            late = match op {
                Op::Neg(a) => a,
                Op::Add(a, b) | Op::Sub(a, b) => {
                    if self.ready_at(a) > self.ready_at(b) {
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
        if self.ready_at(whole) < self.ready_at(sum) {
            return whole;
        }
        // A split at the end of the chain gains nothing if the addends on the way are as late as the last value, as in a
        // chain that is affine throughout. A split in the middle may still gain. It duplicates operations, because the
        // values on the way have other uses, so the gain must justify them.
        let parts: Vec<Value> = (1..links.len()).map(|length| self.split_at(sum, &links[..length])).collect();
        let earliest = parts.into_iter().min_by_key(|part| self.ready_at(*part)).unwrap_or(sum);
        let gain = self.ready_at(sum).zip(self.ready_at(earliest)).map_or(0, |(sum, earliest)| sum - earliest);
        if gain >= MIN_GAIN { earliest } else { sum }
    }

    /// Splits a sum at the value of the last link. Each link is an operation and the operand in which it is affine.
    fn split_at(&mut self, sum: Value, links: &[(Op, Value)]) -> Value {
        let Some((_, late)) = links.last() else { return sum };
        let (mut offset, mut factor, mut negated): (Option<Value>, Option<Value>, bool) = (None, None, false);
        for (op, operand) in links.iter().rev() {
            let operand = *operand;
            match *op {
                Op::Neg(_) => {
                    offset = offset.map(|offset| self.op(Op::Neg(offset)));
                    negated = !negated;
                }
                Op::Add(a, b) => {
                    let other = if operand == a { b } else { a };
                    offset = Some(offset.map_or(other, |offset| self.op(Op::Add(offset, other))));
                }
                Op::Sub(a, b) if operand == a => {
                    offset = Some(match offset {
                        Some(offset) => self.op(Op::Sub(offset, b)),
                        None => self.op(Op::Neg(b)),
                    });
                }
                Op::Sub(a, _) => {
                    offset = Some(offset.map_or(a, |offset| self.op(Op::Sub(a, offset))));
                    negated = !negated;
                }
                Op::Mul(a, b) => {
                    let constant = if operand == a { b } else { a };
                    offset = offset.map(|offset| self.op(Op::Mul(constant, offset)));
                    factor = Some(factor.map_or(constant, |factor| self.op(Op::Mul(factor, constant))));
                }
                _ => unreachable!("links are affine"),
            }
        }
        let Some(offset) = offset else { return sum };
        let product = factor.map_or(*late, |factor| self.op(Op::Mul(factor, *late)));
        self.op(if negated { Op::Sub(offset, product) } else { Op::Add(offset, product) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::Unary;
    use crate::ir::expr::{Real, Shared};
    use crate::ir::random::Random;
    use abi::Layout;

    /// A block with three parameters and two states.
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

    #[test]
    fn a_chain_that_is_affine_throughout_is_split_in_the_middle() {
        // An observer of position and speed, iterated:
        // r = v + 2 p (q − X) + m (x − X), X' = x + h r, V' = v + h (q − X).
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

    /// rk4 of z' = v − C z, where v and C depend on parameters.
    fn stages() -> Func {
        built(|[v, c, h], [z, y]| {
            let h = 0.01 * h;
            let rate = |z| v - c * z;
            let k1 = rate(z);
            let k2 = rate(z + 0.5 * h * k1);
            let k3 = rate(z + 0.5 * h * k2);
            let k4 = rate(z + h * k3);
            [z + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4), y]
        })
    }

    #[test]
    fn stages_that_are_affine_in_one_state_become_one_fused_product() {
        let func = stages();
        let [plain, regrouped] = [&func, &reassociate(&func, false)].map(critical_path);
        assert_eq!(regrouped, 4, "{plain} cycles before");
        // Where equal forces must cancel, sums keep their order.
        assert!(critical_path(&reassociate(&func, true)) > 20);
    }

    /// Both functions have the same algebra, so their results agree up to rounding.
    #[test]
    fn values_agree_up_to_rounding() {
        let late = built(|[p, q, m], [x, y]| {
            let g = 1.0 + p * (-(x * x)).of(Unary::Exp);
            let late = q * x.abs() / g * y;
            let force = p * y + q * (x - late) + 0.4 * x;
            [x + 1e-3 * ((m - force) / m), y + 1e-3 * (x - late)]
        });
        for func in [late, stages()] {
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
}
