//! `slope(x)`: symbolic differentiation of an expression with respect to time, for experiments.
//!
//! In: an expression over the quantities of a flat system whose equations have been read. Out: its derivative by the
//! rules of calculus, down to the rates of states, or the subexpression without a known derivative. The derivative
//! holds between events. Where a quantity jumps it has none, so `sign`, `floor`, ticks and noise are refused rather
//! than differentiated to 0.
//!
//! The derivative of a recording is another recording, of second-order differences of neighbouring samples.

use super::*;
use crate::functions::{Term, Unary};

/// Limit on the depth of the chain of quantities and operations.
const DEEPEST_CHAIN: usize = 400;

/// A derivative; `None` if it is 0.
type Slope = Option<ExprId>;

/// A subexpression without a known derivative, and the reason.
type Unknown = (Span, String);

/// Memo of derivatives.
#[derive(Default)]
struct Derivatives {
    exprs: HashMap<ExprId, Slope>,
    /// Current depth of recursion.
    depth: usize,
}

impl<'a> Flattener<'a> {
    /// The derivative of an expression as an expression; reports an error if it is unknown.
    pub(super) fn slope(&mut self, of: ExprId, span: Span) -> ExprId {
        let slope = self.rate(of, &mut Derivatives::default()).map(|slope| match slope {
            // Copied, so that its span is that of the call.
            Some(slope) => self.system.push(self.system.node(slope).clone(), span),
            None => self.system.push(zero(), span),
        });
        slope.unwrap_or_else(|(place, why)| {
            let error = Diagnostic::error("E0307", "the derivative of this is not known").label(span, "asked for here");
            let error = if place == span { error } else { error.label(place, &why) };
            self.report(error.help(format!("{why}; `slope` follows equations down to the rates of states")));
            self.error(span)
        })
    }

    fn rate(&mut self, id: ExprId, known: &mut Derivatives) -> Result<Slope, Unknown> {
        if let Some(slope) = known.exprs.get(&id) {
            return Ok(*slope);
        }
        if known.depth >= DEEPEST_CHAIN || self.full(self.system.span(id)) {
            return Err((self.system.span(id), "it follows from too many quantities".into()));
        }
        known.depth += 1;
        let slope = self.rate_of(id, known);
        known.depth -= 1;
        known.exprs.insert(id, slope.clone()?);
        slope
    }

    fn rate_of(&mut self, id: ExprId, known: &mut Derivatives) -> Result<Slope, Unknown> {
        let span = self.system.span(id);
        let unknown = |why: &str| Err((span, why.to_string()));
        match self.system.node(id).clone() {
            Node::Number { .. } | Node::Bool(_) => Ok(None),
            Node::Hole | Node::Error => Ok(Some(id)),
            Node::Time => Ok(Some(self.plain(1.0, span))),
            Node::Var(var) => self.rate_of_var(var, span, known),
            Node::Rate(var) => match self.system.var(var).definition {
                Definition::Continuous { rate, .. } => self.rate(rate, known),
                _ => Ok(Some(id)), // Reported with the units.
            },
            Node::PathRate(_) => unknown("a derivative along another quantity"),
            Node::Negate(a) => {
                let a = self.rate(a, known)?;
                Ok(a.map(|a| self.system.push(Node::Negate(a), span)))
            }
            Node::Binary(op, a, b) => self.rate_of_binary(op, a, b, span, known),
            Node::If(condition, a, b) => match (self.rate(a, known)?, self.rate(b, known)?) {
                (None, None) => Ok(None),
                (a, b) => {
                    let [a, b] = [a, b].map(|slope| slope.unwrap_or_else(|| self.system.push(zero(), span)));
                    Ok(Some(self.system.push(Node::If(condition, a, b), span)))
                }
            },
            Node::Fits { value, .. } => self.rate(value, known),
            Node::Call(builtin, args) => self.rate_of_call(id, builtin, &args, span, known),
            Node::Table(table, at) if self.data.values().any(|(recorded, _)| *recorded == table) => {
                let derivative = self.recorded_slope(table);
                Ok(Some(self.system.push(Node::Table(derivative, at), span)))
            }
            Node::Table(_, x) => match self.rate(x, known)? {
                None => Ok(None),
                Some(_) => unknown("a table or a recording"),
            },
            Node::Not(_) | Node::InRegime(..) | Node::Crossing(_) => unknown("a condition is true or false"),
            Node::Measure(..) => unknown("a measure is one number"),
        }
    }

    /// Whether an expression reads time, recordings and numbers only.
    pub(super) fn of_time_alone(&self, id: ExprId) -> bool {
        let node = self.system.node(id);
        !matches!(node, Node::Var(_) | Node::Rate(_) | Node::PathRate(_) | Node::InRegime(..) | Node::Measure(..))
            && node.operands().all(|operand| self.of_time_alone(operand))
    }

    /// The table of the derivative of a recording.
    fn recorded_slope(&mut self, table: u32) -> u32 {
        let of = &self.system.tables[table as usize];
        let name = format!("{}'", of.name);
        if let Some(known) = self.system.tables.iter().position(|table| table.name == name) {
            return known as u32;
        }
        let y_unit = Unit::si(of.y_unit.dimension.over(of.x_unit.dimension));
        let y = if of.held { vec![0.0; of.x.len()] } else { differences(&of.x, &of.y) }.into();
        let table = Table { name, x_unit: of.x_unit.clone(), y_unit, smooth: false, held: of.held, x: of.x.clone(), y };
        self.system.tables.push(table);
        self.system.tables.len() as u32 - 1
    }

    fn rate_of_var(&mut self, var: VarId, span: Span, known: &mut Derivatives) -> Result<Slope, Unknown> {
        let declared = self.system.var(var);
        let name = &declared.path;
        match (&declared.definition, declared.kind) {
            (_, VarKind::Param) => Ok(None),
            (Definition::Value(value, _), _) => {
                let value = *value;
                self.rate(value, known)
            }
            (Definition::Continuous { .. }, _) => Ok(Some(self.system.push(Node::Rate(var), span))),
            (Definition::Sampled { .. } | Definition::Held { .. }, _) => {
                Err((span, format!("`{name}` changes at ticks only")))
            }
            (Definition::Free, _) => Err((span, format!("`{name}` comes from outside"))),
            (Definition::Missing, _) => Ok(Some(self.error(span))),
        }
    }

    fn rate_of_binary(
        &mut self,
        op: BinaryOp,
        a: ExprId,
        b: ExprId,
        span: Span,
        known: &mut Derivatives,
    ) -> Result<Slope, Unknown> {
        let (da, db) = match op {
            BinaryOp::Add | BinaryOp::Subtract | BinaryOp::Multiply | BinaryOp::Divide | BinaryOp::Power => {
                (self.rate(a, known)?, self.rate(b, known)?)
            }
            _ => return Err((span, "a condition is true or false".into())),
        };
        Ok(match (op, da, db) {
            (_, None, None) => None,
            (BinaryOp::Add, Some(slope), None) | (BinaryOp::Add, None, Some(slope)) => Some(slope),
            (BinaryOp::Subtract, Some(slope), None) => Some(slope),
            (BinaryOp::Subtract, None, Some(slope)) => Some(self.system.push(Node::Negate(slope), span)),
            (BinaryOp::Multiply, ..) => {
                let left = da.map(|da| self.operation(BinaryOp::Multiply, da, b, span));
                let right = db.map(|db| self.operation(BinaryOp::Multiply, a, db, span));
                self.sum(left, right, span)
            }
            // (a/b)′ = (a′ − (a/b) b′) / b
            (BinaryOp::Divide, ..) => {
                let ratio = self.operation(BinaryOp::Divide, a, b, span);
                let less = db.map(|db| self.operation(BinaryOp::Multiply, ratio, db, span));
                let less = less.map(|less| self.system.push(Node::Negate(less), span));
                let above = self.sum(da, less, span);
                above.map(|above| self.operation(BinaryOp::Divide, above, b, span))
            }
            (BinaryOp::Power, Some(da), None) => {
                let below = match self.system.literal(b) {
                    Some(exponent) => self.plain(exponent - 1.0, span),
                    None => {
                        let one = self.plain(1.0, span);
                        self.operation(BinaryOp::Subtract, b, one, span)
                    }
                };
                let power = self.operation(BinaryOp::Power, a, below, span);
                let slope = self.operation(BinaryOp::Multiply, b, power, span);
                Some(self.operation(BinaryOp::Multiply, slope, da, span))
            }
            (BinaryOp::Power, ..) => return Err((span, "an exponent that changes".into())),
            (op, Some(da), Some(db)) => Some(self.operation(op, da, db, span)),
            _ => unreachable!("{op:?} has been looked at"),
        })
    }

    fn rate_of_call(
        &mut self,
        id: ExprId,
        builtin: Builtin,
        args: &[ExprId],
        span: Span,
        known: &mut Derivatives,
    ) -> Result<Slope, Unknown> {
        let unknown = |why: &str| Err((span, why.to_string()));
        // Signals that depend on time even if their arguments are constant.
        match builtin {
            Builtin::Step | Builtin::Pulse | Builtin::Square => return unknown("this signal jumps"),
            Builtin::Noise | Builtin::Random => return unknown("chance has no derivative"),
            Builtin::Chirp => return unknown("a chirp"),
            Builtin::Delay => return unknown("what is delayed"),
            _ => {}
        }
        let mut slopes = Vec::new();
        for arg in args {
            slopes.push(self.rate(*arg, known)?);
        }
        let call = |f: &mut Self, builtin, args: &[ExprId]| f.system.push(Node::Call(builtin, args.into()), span);
        use BinaryOp::{Divide, LessEqual, Multiply};
        match builtin {
            Builtin::Ramp if slopes.iter().all(Option::is_none) => {
                let time = self.system.push(Node::Time, span);
                let before = self.operation(BinaryOp::Less, time, args[0], span);
                let zero = self.system.push(zero(), span);
                return Ok(Some(self.system.push(Node::If(before, zero, args[2]), span)));
            }
            Builtin::Sine if slopes.iter().all(Option::is_none) => {
                let (time, turn) = (self.system.push(Node::Time, span), self.plain(std::f64::consts::TAU, span));
                let rate = self.operation(Multiply, turn, args[1], span);
                let phase = self.operation(Multiply, rate, time, span);
                let cosine = call(self, Builtin::Unary(Unary::Cos), &[phase]);
                let size = self.operation(Multiply, args[0], rate, span);
                return Ok(Some(self.operation(Multiply, size, cosine, span)));
            }
            Builtin::Ramp | Builtin::Sine => return unknown("a signal whose own numbers change"),
            _ => {}
        }
        if slopes.iter().all(Option::is_none) {
            return Ok(None);
        }
        let choice = |f: &mut Self, at_most: ExprId, than: ExprId, a: Slope, b: Slope| {
            let condition = f.operation(LessEqual, at_most, than, span);
            let [a, b] = [a, b].map(|slope| slope.unwrap_or_else(|| f.system.push(zero(), span)));
            f.system.push(Node::If(condition, a, b), span)
        };
        Ok(match builtin {
            Builtin::Min => Some(choice(self, args[0], args[1], slopes[0], slopes[1])),
            Builtin::Max => Some(choice(self, args[0], args[1], slopes[1], slopes[0])),
            Builtin::Clamp => {
                let upper = choice(self, args[2], args[0], slopes[2], slopes[0]);
                Some(choice(self, args[0], args[1], slopes[1], Some(upper)))
            }
            Builtin::Sign | Builtin::Floor => return unknown("this jumps"),
            Builtin::Abs => {
                let sign = call(self, Builtin::Sign, &[args[0]]);
                slopes[0].map(|slope| self.operation(Multiply, sign, slope, span))
            }
            Builtin::Sqrt => {
                let two = self.plain(2.0, span);
                let twice = self.operation(Multiply, two, id, span);
                slopes[0].map(|slope| self.operation(Divide, slope, twice, span))
            }
            Builtin::Unary(function) => {
                let factor = self.term(function.row().derivative, id, args, span);
                slopes[0].map(|slope| self.operation(Multiply, factor, slope, span))
            }
            Builtin::Binary(function) => {
                let mut slope = None;
                for (k, derivative) in function.row().derivatives.into_iter().enumerate() {
                    if let Some(of_argument) = slopes[k] {
                        let factor = self.term(derivative, id, args, span);
                        let part = self.operation(Multiply, factor, of_argument, span);
                        slope = self.sum(slope, Some(part), span);
                    }
                }
                slope
            }
            Builtin::Step
            | Builtin::Ramp
            | Builtin::Pulse
            | Builtin::Sine
            | Builtin::Square
            | Builtin::Chirp
            | Builtin::Noise
            | Builtin::Random
            | Builtin::Delay => unreachable!("signals have been looked at"),
        })
    }

    /// A term of a derivative as an expression. `f`: the call of the function, with these arguments.
    fn term(&mut self, term: &Term, f: ExprId, args: &[ExprId], span: Span) -> ExprId {
        let mut part = |term: &Term| self.term(term, f, args, span);
        let node = match *term {
            Term::X => return args[0],
            Term::Y => return args[1],
            Term::F => return f,
            // Zero fits every unit.
            Term::Number(0.0) => zero(),
            Term::Number(number) => return self.plain(number, span),
            Term::Negate(a) => Node::Negate(part(a)),
            Term::Sum(a, b) => Node::Binary(BinaryOp::Add, part(a), part(b)),
            Term::Difference(a, b) => Node::Binary(BinaryOp::Subtract, part(a), part(b)),
            Term::Product(a, b) => Node::Binary(BinaryOp::Multiply, part(a), part(b)),
            Term::Quotient(a, b) => Node::Binary(BinaryOp::Divide, part(a), part(b)),
            Term::Fused(a, b, c) => {
                let (a, b, c) = (part(a), part(b), part(c));
                let product = self.operation(BinaryOp::Multiply, a, b, span);
                Node::Binary(BinaryOp::Add, product, c)
            }
            Term::Root(a) => Node::Call(Builtin::Sqrt, [part(a)].into()),
            Term::Call(function, a) => Node::Call(Builtin::Unary(function), [part(a)].into()),
            Term::IfPositive(a, b, c) => {
                let (a, b, c) = (part(a), part(b), part(c));
                let zero = self.system.push(zero(), span);
                Node::If(self.operation(BinaryOp::Greater, a, zero, span), b, c)
            }
            Term::IfEqual(a, number, b, c) => {
                let (a, b, c) = (part(a), part(b), part(c));
                let number = self.plain(number, span);
                Node::If(self.operation(BinaryOp::Equal, a, number, span), b, c)
            }
        };
        self.system.push(node, span)
    }

    fn operation(&mut self, op: BinaryOp, a: ExprId, b: ExprId, span: Span) -> ExprId {
        self.system.push(Node::Binary(op, a, b), span)
    }

    fn sum(&mut self, a: Slope, b: Slope, span: Span) -> Slope {
        match (a, b) {
            (Some(a), Some(b)) => Some(self.operation(BinaryOp::Add, a, b, span)),
            (a, b) => a.or(b),
        }
    }

    fn plain(&mut self, value: f64, span: Span) -> ExprId {
        self.system.push(Node::Number { value, dimension: Some(Dimension::NONE), angle: Angle::Silent }, span)
    }
}

/// Derivatives at the samples `x`: of the parabola through a sample and its two neighbours (Fornberg, Math. Comp. 51,
/// 1988, for three points at any distances), at the ends of the line through the last two.
fn differences(x: &[f64], y: &[f64]) -> Vec<f64> {
    let secant = |k: usize| (y[k + 1] - y[k]) / (x[k + 1] - x[k]);
    let last = x.len() - 1;
    let at = |k: usize| match k {
        _ if last == 0 => 0.0,
        0 => secant(0),
        k if k == last => secant(k - 1),
        k => {
            let (before, after) = (x[k] - x[k - 1], x[k + 1] - x[k]);
            (secant(k - 1) * after + secant(k) * before) / (before + after)
        }
    };
    (0..=last).map(at).collect()
}

#[cfg(test)]
mod tests {
    use super::differences;
    use crate::ir::random::Random;

    /// Exact for parabolas at any distances; second order for a sine.
    #[test]
    fn differences_of_parabolas_are_exact() {
        let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(5);
        let mut random = Random(seed);
        for case in 0..200 {
            let mut x = vec![random.within(-1.0, 1.0)];
            for k in 0..20 {
                x.push(x[k] + random.within(0.01, 0.2));
            }
            let [a, b, c] = [0; 3].map(|_| random.within(-2.0, 2.0));
            let y: Vec<f64> = x.iter().map(|x| a + b * x + c * x * x).collect();
            for (k, slope) in differences(&x, &y).iter().enumerate().skip(1).take(x.len() - 2) {
                let exact = b + 2.0 * c * x[k];
                assert!((slope - exact).abs() < 1e-11, "seed {seed}, case {case}: {slope} for {exact}");
            }
        }
        println!("seed {seed}");
        assert_eq!(differences(&[1.0], &[3.0]), [0.0]);
        assert_eq!(differences(&[1.0, 3.0], &[3.0, 4.0]), [0.5, 0.5]);
    }
}
