//! `expo`: exponential Euler with the rates of the middle of the step.
//!
//! Source: Hochbruck, Ostermann, *Exponential integrators*, Acta Numerica 2010.

use super::Model;
use crate::ir::expr::{Real, Truth};
use crate::ir::hash::HashMap;
use crate::ir::{Func, Op, Value};
use crate::math::phi_functions;
use crate::numerics::autodiff;
use crate::numerics::state_partition::Shape;
use crate::numerics::switching_conditions::SwitchingConditions;
use abi::Slot;
use std::collections::BTreeSet;

impl<'a> Model<'a> {
    /// Exponential integrator: exact for a state that relaxes, dx/dt = b − a x. Every other state is linearised in
    /// itself. X is the mean over the step; the rates of other states see this value.
    ///
    ///   x' = x + h φ(h a) f,  X = x + h φ2(h a) f              f, a = min(∂f/∂x, 0) at (t, x)
    ///   three times: r = f + a (x − X), and r in place of f    f, a at (t + h/2, X)
    ///
    /// States are stepped after those that they depend on. The iteration depends on the shape of the rate:
    ///
    /// - Affine in its own state: r is the same for every X, so one evaluation at (t + h/2, x) is enough.
    /// - Piecewise affine: the switching conditions are evaluated near the state's value in the middle of the step, which
    ///   is x + h f/(2 − h a). The rest is as in the affine case.
    /// - States that depend on each other and are jointly affine use the matrix exponential.
    pub(super) fn expo(&self) -> Vec<Real<'a>> {
        let layout = &self.program.description.layout;
        let stored: HashMap<Slot, Value> = self.program.derivatives.stores.iter().copied().collect();
        let (mut next, mut middle) = (self.x.clone(), self.x.clone());
        for group in &self.coupling.groups {
            let states = &group.states;
            let rates = self.rates_of(states, &stored);
            match group.shape {
                Shape::Affine => self.affine(&rates, &HashMap::default(), states, &mut next, &mut middle),
                Shape::PiecewiseAffine => {
                    let own: Vec<Slot> = states.iter().map(|k| layout.states.slot(*k)).collect();
                    let asking = SwitchingConditions::of(&rates, &own);
                    let answers = self.answers(&asking, states, &middle);
                    self.affine(&asking.rates, &answers, states, &mut next, &mut middle);
                }
                Shape::Nonlinear => self.iterated(&rates, states, &mut next, &mut middle),
                Shape::Linear => self.linear(&rates, states, &stored, &mut next, &mut middle),
            }
        }
        next
    }

    /// Steps states whose rates are affine for fixed `answers` (the results of their switching conditions).
    fn affine(
        &self,
        rates: &Func,
        answers: &HashMap<Value, Value>,
        states: &[usize],
        next: &mut [Real<'a>],
        middle: &mut [Real<'a>],
    ) {
        for (k, (f, a)) in states.iter().zip(self.relaxation(rates, answers, 0.5, middle, states)) {
            [next[*k], middle[*k]] = self.relaxed(self.x[*k], f, a);
        }
    }

    /// The results of the switching conditions near the middle of the step.
    fn answers(&self, asking: &SwitchingConditions, states: &[usize], middle: &[Real<'a>]) -> HashMap<Value, Value> {
        let mut mid_step = middle.to_vec();
        for (k, (f, a)) in states.iter().zip(self.relaxation(&asking.rates, &HashMap::default(), 0.5, middle, states)) {
            mid_step[*k] = self.x[*k] + self.to_middle(a) * f;
        }
        let env = self.env_for(&asking.rates, 0.5, &mid_step);
        asking.answers(&mut self.build.borrow_mut(), &env)
    }

    /// h/(2 − min(h a, 0)): h/2 for the slope 0, and at most the distance to the rest point for a steep slope.
    fn to_middle(&self, a: Option<Real<'a>>) -> Real<'a> {
        match (self.nonzero(a), self.split_slope(a)) {
            (None, _) => 0.5 * self.h,
            (_, Some((condition, [yes, no]))) => condition.choose(self.to_middle(Some(yes)), self.to_middle(Some(no))),
            (Some(a), None) => self.h / (2.0 - self.falling(self.h * a)),
        }
    }

    /// The state at the end of the step and its mean, for a rate that is affine with the slope `a` and has the value f
    /// at x.
    fn relaxed(&self, x: Real<'a>, f: Real<'a>, a: Option<Real<'a>>) -> [Real<'a>; 2] {
        match (self.nonzero(a), self.split_slope(a)) {
            (None, _) => [1.0, 0.5].map(|part| self.added(x, part * self.h, f)),
            (_, Some((condition, sides))) => {
                let [yes, no] = [true, false].map(|truth| {
                    let a = sides[usize::from(!truth)];
                    self.relaxed(x, self.simplified(f, condition, truth), Some(a))
                });
                [0, 1].map(|k| condition.choose(yes[k], no[k]))
            }
            (Some(a), None) => {
                let r = self.once(f, a);
                self.phis(Some(a)).map(|phi| x + self.h * phi * r)
            }
        }
    }

    /// x + h f, without the operations if f is 0, or a select with a branch that is 0.
    fn added(&self, x: Real<'a>, h: Real<'a>, f: Real<'a>) -> Real<'a> {
        let op = self.build.borrow().get(f.value);
        let zero = |value: Value| self.build.borrow().constant(value) == Some(0.0);
        match op {
            _ if zero(f.value) => x,
            Op::Select(condition, yes, no) if zero(yes) || zero(no) => {
                let [yes, no] = [yes, no].map(|side| self.added(x, h, f.same(side)));
                Truth::new(self.build, condition).choose(yes, no)
            }
            _ => x + h * f,
        }
    }

    /// The slope, unless it is the constant 0.
    fn nonzero(&self, a: Option<Real<'a>>) -> Option<Real<'a>> {
        a.filter(|a| self.build.borrow().constant(a.value) != Some(0.0))
    }

    /// Splits a slope that is a select, if one side is 0, or if it selects among a few slopes that do not depend on a
    /// state. The φ-functions of each side are then hoisted out of the step loop, or are only computed if the side is
    /// selected.
    fn split_slope(&self, a: Option<Real<'a>>) -> Option<(Truth<'a>, [Real<'a>; 2])> {
        let a = a?;
        let op = self.build.borrow().get(a.value);
        let Op::Select(condition, yes, no) = op else { return None };
        let sides = [yes, no].map(|side| a.same(side));
        let level = sides.iter().any(|side| self.nonzero(Some(*side)).is_none());
        let chosen = !self.is_given(a.value) && self.is_chosen(a.value);
        (level || chosen).then(|| (Truth::new(self.build, condition), sides))
    }

    /// Simplifies a value for a condition that is known to be `truth`.
    fn simplified(&self, value: Real<'a>, condition: Truth<'a>, truth: bool) -> Real<'a> {
        match self.build.borrow().get(value.value) {
            Op::Select(selector, yes, no) if selector == condition.value => value.same(if truth { yes } else { no }),
            _ => value,
        }
    }

    /// Steps states by fixed-point iteration: rates and slopes are evaluated again at each new X.
    fn iterated(&self, rates: &Func, states: &[usize], next: &mut [Real<'a>], middle: &mut [Real<'a>]) {
        for round in 0..4 {
            let (c, at) = if round == 0 { (0.0, &self.x[..]) } else { (0.5, &*middle) };
            let mut moved = Vec::with_capacity(states.len());
            for (k, (f, a)) in states.iter().zip(self.relaxation(rates, &HashMap::default(), c, at, states)) {
                let x = self.x[*k];
                let r = match a {
                    Some(a) if round > 0 => f + self.falling(a) * (x - middle[*k]),
                    _ => f,
                };
                moved.push((*k, self.phis(a).map(|phi| x + self.h * phi * r)));
            }
            // States that depend on these use the X at which the last rates were evaluated.
            let last = round == 3;
            for (k, [end, mean]) in moved {
                next[k] = end;
                middle[k] = if last { middle[k] } else { mean };
            }
        }
    }

    /// Matrix exponential for dx/dt = A x + b(t), where b is the straight line through its values at the two Gauss
    /// points: the Taylor series of the exact solution and of its mean, each term computed from the previous one.
    ///
    ///   c1 = h (f̄ − Δ/2),  c2 = h (A c1 + Δ)/2,  ck+1 = h A ck/(k + 1),  x' = x + Σ ck,  X = x + Σ ck/(k + 1)
    ///   f̄ = (f⁺ + f⁻)/2,  Δ = √3 (f⁺ − f⁻)       f⁺, f⁻ at (t + (1/2 ± √3/6) h, x)
    ///
    /// If the last term exceeds 1e-6 of the sum of their sizes, h A is too large for the series, and the states are
    /// iterated.
    fn linear(
        &self,
        rates: &Func,
        states: &[usize],
        stored: &HashMap<Slot, Value>,
        next: &mut [Real<'a>],
        middle: &mut [Real<'a>],
    ) {
        const TERMS: u32 = 16;
        let (h, layout, root) = (self.h, &self.program.description.layout, 3f64.sqrt());
        let own: Vec<Slot> = states.iter().map(|k| layout.states.slot(*k)).collect();
        let mut mean = middle.to_vec();
        for slot in rates.loads().into_iter().filter(|slot| layout.states.contains(*slot) && !own.contains(slot)) {
            let k = slot.index() - layout.states.start as usize;
            if !self.coupling.fades[k] {
                // For a state that integrates others, the mean of a parabola: from its rate at the start and both end
                // values.
                let f = self.relaxation(&self.rates_of(&[k], stored), &HashMap::default(), 0.0, &self.x, &[k])[0].0;
                mean[k] = self.x[k] + (0.5 * h * f + (next[k] - self.x[k] - h * f) / 3.0);
            }
        }
        let values = |side: f64| {
            let at: Vec<Real> = (0..self.x.len())
                .map(|k| match states.contains(&k) {
                    true => self.x[k],
                    false => mean[k] + side * root / 6.0 * (next[k] - self.x[k]),
                })
                .collect();
            let mut env = self.env_for(rates, 0.5 + side * root / 6.0, &at);
            let gradients = autodiff::inline(self.build, rates, &mut env, &own);
            let rate = |k: &usize| {
                let slot = layout.derivatives.slot(*k);
                Real::new(self.build, self.build.borrow_mut().read(slot, &env))
            };
            (states.iter().map(rate).collect::<Vec<_>>(), gradients)
        };
        let ((before, gradients), (after, _)) = (values(-1.0), values(1.0));
        let matrix: Vec<Vec<(usize, Real)>> = states
            .iter()
            .map(|k| {
                let row = gradients.get(&layout.derivatives.slot(*k)).cloned().unwrap_or_default();
                row.into_iter().map(|(j, a)| (j as usize, h * Real::new(self.build, a))).collect()
            })
            .collect();
        let slope: Vec<Option<Real>> = before
            .iter()
            .zip(&after)
            .map(|(before, after)| (before.value != after.value).then(|| h * (root * (*after - *before))))
            .collect();
        let mut term: Vec<Option<Real>> = (0..states.len())
            .map(|i| {
                Some(match slope[i] {
                    Some(slope) => h * (0.5 * (before[i] + after[i])) - 0.5 * slope,
                    None => h * before[i],
                })
            })
            .collect();
        let added = |a: Option<Real<'a>>, b: Option<Real<'a>>| match (a, b) {
            (Some(a), Some(b)) => Some(a + b),
            (a, b) => a.or(b),
        };
        let mut end = term.clone();
        let mut inside: Vec<Option<Real>> = term.iter().map(|term| term.map(|term| 0.5 * term)).collect();
        let mut size: Vec<Option<Real>> = term.iter().map(|term| term.map(Real::abs)).collect();
        for k in 2..=TERMS {
            let of_row = |row: &Vec<(usize, Real<'a>)>| {
                row.iter().filter_map(|(j, a)| term[*j].map(|term| *a * term)).reduce(|a, b| a + b)
            };
            let mut following: Vec<Option<Real>> = matrix.iter().map(of_row).collect();
            if k == 2 {
                following = following.into_iter().zip(&slope).map(|(term, slope)| added(term, *slope)).collect();
            }
            term = following.into_iter().map(|term| term.map(|term| 1.0 / f64::from(k) * term)).collect();
            for i in 0..states.len() {
                end[i] = added(end[i], term[i]);
                inside[i] = added(inside[i], term[i].map(|term| 1.0 / f64::from(k + 1) * term));
                size[i] = added(size[i], term[i].map(Real::abs));
            }
        }
        let small = |(term, size): (&Option<Real<'a>>, &Option<Real<'a>>)| {
            term.zip(*size).map(|(term, size)| term.abs().not_above(1e-6 * size))
        };
        let converges = term.iter().zip(&size).filter_map(small).reduce(|a, b| a & b);
        let (mut other_next, mut other_middle) = (next.to_vec(), middle.to_vec());
        if converges.is_some() {
            self.iterated(rates, states, &mut other_next, &mut other_middle);
        }
        for (i, k) in states.iter().enumerate() {
            let moved = |way: Option<Real<'a>>| way.map_or(self.x[*k], |way| self.x[*k] + way);
            let (at_end, at_mean) = (moved(end[i]), moved(inside[i]));
            (next[*k], middle[*k]) = match converges {
                Some(truth) => (truth.choose(at_end, other_next[*k]), truth.choose(at_mean, other_middle[*k])),
                None => (at_end, at_mean),
            };
        }
    }

    /// The result of the fixed-point iteration for an affine rate with the value `f` at x and the slope `a`. This is f
    /// itself, unless the state grows (a > 0): then X = x + h r/2 with r = f + a (X − x), iterated.
    fn once(&self, f: Real<'a>, a: Real<'a>) -> Real<'a> {
        let half = 0.5 * self.h;
        let mut r = f;
        for _ in 0..3 {
            r = f + a * (half * r);
        }
        a.above(0.0).choose(r, f)
    }

    /// The function of the rates of these states alone: only the operations that they need.
    fn rates_of(&self, states: &[usize], stored: &HashMap<Slot, Value>) -> Func {
        let func = &self.program.derivatives;
        let slots = states.iter().map(|k| self.program.description.layout.derivatives.slot(*k));
        let stores: Vec<(Slot, Value)> = slots.filter_map(|slot| Some((slot, *stored.get(&slot)?))).collect();
        let mut needed = BTreeSet::new();
        let mut open: Vec<Value> = stores.iter().map(|(_, value)| *value).collect();
        while let Some(value) = open.pop() {
            if needed.insert(value) {
                func.op(value).each_operand(|operand| open.push(operand));
            }
        }
        let number: HashMap<Value, Value> =
            needed.iter().enumerate().map(|(number, value)| (*value, Value(number as u32))).collect();
        let ops = needed.iter().map(|value| func.op(*value).map(|operand| number[&operand])).collect();
        let stores = stores.into_iter().map(|(slot, value)| (slot, number[&value])).collect();
        Func { name: func.name.clone(), ops, stores, ..Func::default() }
    }

    /// For each of these states f, and ∂f/∂x with respect to itself; `None` if f does not depend on it.
    fn relaxation(
        &self,
        rates: &Func,
        answers: &HashMap<Value, Value>,
        c: f64,
        x: &[Real<'a>],
        states: &[usize],
    ) -> Vec<(Real<'a>, Option<Real<'a>>)> {
        let layout = &self.program.description.layout;
        let mut env = self.env_for(rates, c, x);
        let slots: Vec<Slot> = states.iter().map(|k| layout.states.slot(*k)).collect();
        let gradients = autodiff::inline_given(self.build, rates, &mut env, &slots, answers);
        let of = |(direction, k): (usize, &usize)| {
            let slot = layout.derivatives.slot(*k);
            let f = Real::new(self.build, self.build.borrow_mut().read(slot, &env));
            let own = gradients.get(&slot).and_then(|gradient| autodiff::entry(gradient, direction as u32));
            (f, own.map(|a| Real::new(self.build, self.chosen(a, 8))))
        };
        states.iter().enumerate().map(of).collect()
    }

    /// min(a, 0)
    fn falling(&self, a: Real<'a>) -> Real<'a> {
        a.below(0.0).choose(a, 0.0)
    }

    /// φ(q) = (e^q − 1)/q and φ2(q) = (e^q − 1 − q)/q² for q = min(h a, 0); φ(0) = 1, φ2(0) = 1/2.
    fn phis(&self, a: Option<Real<'a>>) -> [Real<'a>; 2] {
        match (self.nonzero(a), self.split_slope(a)) {
            (Some(a), None) if self.build.borrow().constant(a.value).is_none_or(|a| a < 0.0) => {
                phi_functions::phis(self.falling(self.h * a))
            }
            (Some(_), Some((condition, [yes, no]))) => {
                let [yes, no] = [yes, no].map(|side| self.phis(Some(side)));
                [0, 1].map(|k| condition.choose(yes[k], no[k]))
            }
            _ => [1.0, 0.5].map(|phi| self.h.constant(phi)),
        }
    }
}
