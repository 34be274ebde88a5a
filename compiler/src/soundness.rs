//! Soundness test on random texts: a text that `check` accepts neither divides by 0 nor leaves the domain of a
//! function, for numbers within the declared ranges.
//!
//! A text consists of quantities with ranges, `require` statements, `let`s, a part with an argument, branches, and an
//! output. An accepted text is evaluated at the ends of the ranges and at random numbers between them, in two ways: by
//! the interpreter, whose output must be finite, and by an independent evaluator, which sees each divisor. Exempt are
//! results too large for a double, and instants at which a guarded range is left. `FRIC_SEED` sets the seed,
//! `FRIC_RUNS` the number of texts (default 600).

use crate::functions::{Binary, Builtin, Domain, Shape, Unary};
use crate::interval::{Interval, planted};
use crate::ir::random::Random;
use crate::ranges::reach::HUGE;
use abi::description::TINY;
use std::fmt::Write;
use std::rc::Rc;

// ---- texts

type Node = Rc<E>;

/// An expression.
#[derive(Clone, Debug)]
enum E {
    Number(f64),
    /// A quantity.
    Quantity(usize),
    /// A `let`.
    Let(usize),
    /// The output of the part.
    Part,
    Negate(Node),
    Op(char, Node, Node),
    Power(Node, f64),
    Raised(Node, Node),
    Call(&'static str, Vec<Node>),
    If(Rc<C>, Node, Node),
}

/// A condition.
#[derive(Clone, Debug)]
enum C {
    Compare(&'static str, Node, Node),
    Not(Rc<C>),
    Both(Rc<C>, Rc<C>),
    Either(Rc<C>, Rc<C>),
}

/// Lower and upper bound, each with whether it is strict.
type Bounds = (Option<(f64, bool)>, Option<(f64, bool)>);

#[derive(Clone, Debug)]
struct Text {
    /// Parameters and inputs: whether it is a parameter, its default, its range.
    quantities: Vec<(bool, f64, Bounds)>,
    /// `large >= small`
    requires: Vec<(&'static str, Node, Node)>,
    lets: Vec<Node>,
    /// The argument of the part's input, the range of that input, and the part's output, in which `Quantity(0)` is the
    /// input.
    part: Option<(Node, Bounds, Node)>,
    output: Node,
}

fn range(bounds: Bounds) -> String {
    match bounds {
        (Some((0.0, true)), None) => " in > 0".into(),
        (Some((low, false)), None) => format!(" in >= {low}"),
        (Some((low, true)), None) => format!(" in > {low}"),
        (None, Some((high, true))) => format!(" in < {high}"),
        (None, Some((high, false))) => format!(" in <= {high}"),
        (Some((low, _)), Some((high, _))) => format!(" in {low} .. {high}"),
        (None, None) => String::new(),
    }
}

impl Text {
    fn show(&self) -> String {
        let mut out = String::new();
        if let Some((_, bounds, body)) = &self.part {
            let body = shown(body, &|_| "a".into());
            writeln!(out, "model P {{\n  input a [1]{}\n  output b = {body}\n}}", range(*bounds)).unwrap();
        }
        writeln!(out, "model A {{").unwrap();
        for (k, (param, default, bounds)) in self.quantities.iter().enumerate() {
            let (word, unit) = if *param { ("param", "") } else { ("input", " [1]") };
            writeln!(out, "  {word} x{k}{unit} = {default}{}", range(*bounds)).unwrap();
        }
        let name = |k: usize| format!("x{k}");
        for (op, a, b) in &self.requires {
            writeln!(out, "  require {} {op} {}", shown(a, &name), shown(b, &name)).unwrap();
        }
        for (k, value) in self.lets.iter().enumerate() {
            writeln!(out, "  let l{k} = {}", shown(value, &name)).unwrap();
        }
        if let Some((argument, ..)) = &self.part {
            writeln!(out, "  part q = P(a = {})", shown(argument, &name)).unwrap();
        }
        writeln!(out, "  output o = {}\n}}", shown(&self.output, &name)).unwrap();
        out
    }
}

fn shown(e: &E, name: &dyn Fn(usize) -> String) -> String {
    let of = |e: &Node| shown(e, name);
    match e {
        E::Number(x) if *x < 0.0 => format!("({x})"),
        E::Number(x) => format!("{x}"),
        E::Quantity(k) => name(*k),
        E::Let(k) => format!("l{k}"),
        E::Part => "q.b".into(),
        E::Negate(a) => format!("(-{})", of(a)),
        E::Op(op, a, b) => format!("({} {op} {})", of(a), of(b)),
        E::Power(a, n) => format!("({})^({n})", of(a)),
        E::Raised(a, b) => format!("({})^({})", of(a), of(b)),
        E::Call(f, args) => format!("{f}({})", args.iter().map(of).collect::<Vec<_>>().join(", ")),
        E::If(c, a, b) => format!("(if {} then {} else {})", condition(c, name), of(a), of(b)),
    }
}

fn condition(c: &C, name: &dyn Fn(usize) -> String) -> String {
    match c {
        C::Compare(op, a, b) => format!("({} {op} {})", shown(a, name), shown(b, name)),
        C::Not(a) => format!("(not {})", condition(a, name)),
        C::Both(a, b) => format!("({} and {})", condition(a, name), condition(b, name)),
        C::Either(a, b) => format!("({} or {})", condition(a, name), condition(b, name)),
    }
}

// ---- random texts

struct Maker {
    random: Random,
    quantities: usize,
    lets: usize,
    part: bool,
}

/// Names of the functions of one argument that have a domain, or that have none.
fn of_one_argument(has_domain: bool) -> Vec<&'static str> {
    let fits = |builtin: &Builtin| {
        let domain = builtin.domain().map_or(Domain::ALL, |(_, domain)| domain);
        builtin.signature().arguments.len() == 1 && has_domain == (domain != Domain::ALL)
    };
    Builtin::all().filter(fits).map(Builtin::name).collect()
}

const NUMBERS: &[f64] = &[0.0, 1.0, 2.0, 3.0, 0.5, 1.7, 1e-3, 1e3, 1e-17, 40.0];

impl Maker {
    fn pick<T: Copy>(&mut self, of: &[T]) -> T {
        of[self.random.below(of.len())]
    }

    fn number(&mut self) -> f64 {
        let x = self.pick(NUMBERS);
        if self.random.below(4) == 0 { -x } else { x }
    }

    fn bounds(&mut self) -> (f64, Bounds) {
        match self.random.below(9) {
            0 | 1 => (1.0, (Some((0.0, true)), None)),
            2 => (1.0, (Some((0.0, false)), None)),
            3 => (-1.0, (None, Some((0.0, true)))),
            4 => (-1.0, (None, Some((0.0, false)))),
            5 => (2.0, (Some((1.0, false)), Some((3.0, false)))),
            6 => (0.2, (Some((-0.5, false)), Some((0.5, false)))),
            7 => (2.0, (Some((1.0, true)), None)),
            _ => (1.0, (None, None)),
        }
    }

    fn leaf(&mut self) -> Node {
        Rc::new(match self.random.below(8) {
            0 | 1 => E::Number(self.number()),
            2 if self.lets > 0 => E::Let(self.random.below(self.lets)),
            3 if self.part => E::Part,
            _ => E::Quantity(self.random.below(self.quantities)),
        })
    }

    fn condition(&mut self, deep: u32) -> C {
        match self.random.below(8) {
            0 if deep > 0 => C::Not(Rc::new(self.condition(deep - 1))),
            1 if deep > 0 => C::Both(Rc::new(self.condition(deep - 1)), Rc::new(self.condition(deep - 1))),
            2 | 3 if deep > 0 => C::Either(Rc::new(self.condition(deep - 1)), Rc::new(self.condition(deep - 1))),
            _ => {
                let leaf = self.leaf();
                let side = match self.random.below(4) {
                    0 => Rc::new(E::Call("abs", vec![leaf])),
                    1 => Rc::new(E::Power(leaf, 2.0)),
                    _ => leaf,
                };
                let other = if self.random.below(4) == 0 { self.leaf() } else { Rc::new(E::Number(self.number())) };
                C::Compare(self.pick(&["<", "<=", ">", ">=", ">", "<"]), side, other)
            }
        }
    }

    fn expr(&mut self, deep: u32) -> Node {
        if deep == 0 {
            return self.leaf();
        }
        let d = deep - 1;
        Rc::new(match self.random.below(22) {
            0 | 1 => E::Op(self.pick(&['+', '-', '*']), self.expr(d), self.expr(d)),
            2..=5 => E::Op('/', self.expr(d), self.expr(d)),
            6 => E::Negate(self.expr(d)),
            7 => E::Power(self.expr(d), self.pick(&[2.0, 3.0, -1.0, -2.0, -3.0, 0.5, -0.5, 7.0, -20.0])),
            8 => E::Raised(self.expr(d), self.leaf()),
            9 => E::Call(self.pick(&of_one_argument(true)), vec![self.expr(d)]),
            10 | 11 => E::Call(self.pick(&of_one_argument(false)), vec![self.expr(d)]),
            12 => E::Call(self.pick(&["min", "max", "hypot"]), vec![self.expr(d), self.expr(d)]),
            13 => E::Op('+', Rc::new(E::Number(1.0)), Rc::new(E::Power(self.expr(d), 2.0))),
            14 => E::Call("exp", vec![Rc::new(E::Negate(Rc::new(E::Power(self.leaf(), 2.0))))]),
            15 => {
                let (a, b, k) = (self.leaf(), self.leaf(), self.leaf());
                let k = Rc::new(E::Call("exp", vec![Rc::new(E::Negate(Rc::new(E::Power(k, 2.0))))]));
                E::Op('+', a.clone(), Rc::new(E::Op('*', Rc::new(E::Op('-', b, a)), k)))
            }
            16..=19 => E::If(Rc::new(self.condition(2)), self.expr(d), self.expr(d)),
            _ => E::Op('-', self.leaf(), self.leaf()),
        })
    }

    fn text(&mut self) -> Text {
        self.quantities = 1 + self.random.below(3);
        (self.lets, self.part) = (0, false);
        let quantities: Vec<(bool, f64, Bounds)> = (0..self.quantities)
            .map(|_| {
                let (default, bounds) = self.bounds();
                (self.random.below(2) == 0, default, bounds)
            })
            .collect();
        let params: Vec<usize> = (0..quantities.len()).filter(|k| quantities[*k].0).collect();
        let mut requires = Vec::new();
        if params.len() > 1 && self.random.below(2) == 0 {
            let factor = self.pick(&[1.0, 2.0]);
            let small = Rc::new(E::Op('*', Rc::new(E::Number(factor)), Rc::new(E::Quantity(params[0]))));
            let small = if factor == 1.0 { Rc::new(E::Quantity(params[0])) } else { small };
            requires.push((self.pick(&[">=", ">"]), Rc::new(E::Quantity(params[1])), small));
        }
        let mut lets = Vec::new();
        for _ in 0..self.random.below(3) {
            lets.push(self.expr(1));
            self.lets = lets.len();
        }
        let part = (self.random.below(3) == 0).then(|| {
            let argument = self.expr(1);
            let (_, bounds) = self.bounds();
            let outer = (std::mem::replace(&mut self.quantities, 1), std::mem::replace(&mut self.lets, 0));
            let body = self.expr(2);
            (self.quantities, self.lets) = outer;
            (argument, bounds, body)
        });
        self.part = part.is_some();
        let output = self.expr(3);
        Text { quantities, requires, lets, part, output }
    }
}

// ---- values

/// Observations of an evaluation.
#[derive(Default)]
struct Met {
    /// A divisor of 0, or an argument outside its domain.
    bad: Option<String>,
    /// A result too large for a double.
    large: bool,
    /// A guarded range was left by more than its tolerance.
    watched: bool,
    /// A guarded range was left.
    near: bool,
}

struct Values<'a> {
    text: &'a Text,
    numbers: &'a [f64],
    met: Met,
}

impl Values<'_> {
    fn judged(&mut self, x: f64, what: impl FnOnce() -> String, bad: bool) -> f64 {
        if bad && !self.met.large && self.met.bad.is_none() {
            self.met.bad = Some(what());
        }
        self.met.large |= x.is_infinite() && !bad;
        x
    }

    #[allow(clippy::disallowed_methods, reason = "an evaluator beside the compiler's")]
    fn value(&mut self, e: &E, numbers: &[f64]) -> f64 {
        match e {
            E::Number(x) => *x,
            E::Quantity(k) => numbers[*k],
            E::Let(k) => {
                let value = self.text.lets[*k].clone();
                self.value(&value, self.numbers)
            }
            E::Part => {
                let (argument, bounds, body) = self.text.part.clone().expect("there is a part");
                let a = self.value(&argument, self.numbers);
                // A value proven to be positive may be nearer to 0 than the least value of a range declared as `> 0`.
                let within = |(bound, strict): (f64, bool)| if strict { bound.next_up() } else { bound };
                let least = bounds.0.map_or(f64::NEG_INFINITY, within);
                let most = bounds.1.map_or(f64::INFINITY, |(high, strict)| -within((-high, strict)));
                // Guards have a tolerance of a millionth.
                let slack = 1e-6 * if (most - least).is_finite() { most - least } else { a.abs() };
                self.met.watched |= a < least - slack || a > most + slack;
                self.met.near |= a < least || a > most;
                self.value(&body, &[a])
            }
            E::Negate(a) => -self.value(a, numbers),
            E::Op(op, a, b) => {
                let (x, y) = (self.value(a, numbers), self.value(b, numbers));
                match op {
                    '+' => self.judged(x + y, String::new, false),
                    '-' => self.judged(x - y, String::new, false),
                    '*' => self.judged(x * y, String::new, false),
                    _ => self.judged(x / y, || format!("{x:e} / {y:e}"), y == 0.0),
                }
            }
            E::Power(a, n) => {
                let x = self.value(a, numbers);
                if n.fract() == 0.0 {
                    let mut power = 1.0;
                    for _ in 0..n.abs() as u32 {
                        power *= x;
                    }
                    let power = self.judged(power, String::new, false);
                    match *n < 0.0 {
                        true => self.judged(1.0 / power, || format!("{x:e}^{n}"), power == 0.0),
                        false => power,
                    }
                } else {
                    self.judged(x.powf(*n), || format!("{x:e}^{n}"), x < 0.0 || x == 0.0 && *n < 0.0)
                }
            }
            E::Raised(a, b) => {
                let (x, n) = (self.value(a, numbers), self.value(b, numbers));
                let literal = matches!(**b, E::Number(n) if n.fract() == 0.0);
                self.judged(x.powf(n), || format!("{x:e}^{n:e}"), x < 0.0 && !literal || x == 0.0 && n < 0.0)
            }
            E::Call(f, args) => {
                let args: Vec<f64> = args.iter().map(|arg| self.value(arg, numbers)).collect();
                let x = args[0];
                let (value, bad) = match *f {
                    "sqrt" => (x.sqrt(), x < 0.0),
                    "abs" => (x.abs(), false),
                    "sign" => (if x == 0.0 { 0.0 } else { x.signum() }, false),
                    "floor" => (x.floor(), false),
                    "min" => (x.min(args[1]), false),
                    "max" => (x.max(args[1]), false),
                    "hypot" => (x.hypot(args[1]), false),
                    name => {
                        let Some(Builtin::Unary(function)) = Builtin::named(name) else { unreachable!("{name}") };
                        let value = match function {
                            // The compiler's are those of 0 there.
                            Unary::Sin | Unary::Cos | Unary::Tan if x.abs() > 1e12 => (function.row().value)(0.0),
                            _ => (function.row().value)(x),
                        };
                        // Outside its domain a function is not a number; at its ends it may be infinite.
                        (value, value.is_nan() || value.is_infinite() && x.abs() <= 1.0)
                    }
                };
                self.judged(value, || format!("{f}({x:e})"), bad)
            }
            E::If(c, a, b) => {
                let holds = self.holds(c, numbers);
                self.value(if holds { a } else { b }, numbers)
            }
        }
    }

    fn holds(&mut self, c: &C, numbers: &[f64]) -> bool {
        match c {
            C::Compare(op, a, b) => compare(op, self.value(a, numbers), self.value(b, numbers)),
            C::Not(a) => !self.holds(a, numbers),
            // Both sides are evaluated: a condition does not short-circuit.
            C::Both(a, b) => self.holds(a, numbers) & self.holds(b, numbers),
            C::Either(a, b) => self.holds(a, numbers) | self.holds(b, numbers),
        }
    }
}

fn compare(op: &str, a: f64, b: f64) -> bool {
    match op {
        "<" => a < b,
        "<=" => a <= b,
        ">" => a > b,
        _ => a >= b,
    }
}

/// A number of a range, often one of its ends.
fn sample(random: &mut Random, (low, high): Bounds) -> f64 {
    let least = low.map_or(-HUGE, |(low, strict)| crate::ranges::reach::least(low, strict));
    let most = high.map_or(HUGE, |(high, strict)| crate::ranges::reach::greatest(high, strict));
    let edges = [
        least,
        most,
        least.next_up(),
        most.next_down(),
        0.0,
        -0.0,
        f64::from_bits(1),
        -f64::from_bits(1),
        1e-310,
        1e-300,
        1e-162,
        -1e-162,
        TINY,
        -TINY,
        1e-17,
        -1e-17,
        1.0,
        -1.0,
        1.0_f64.next_down(),
        2.0,
        3.0,
        0.5,
        40.0,
        -40.0,
        1e20,
        HUGE,
        -HUGE,
    ];
    for _ in 0..8 {
        let x = match random.below(3) {
            0 => edges[random.below(edges.len())],
            1 => random.within(-4.0, 4.0),
            _ => {
                let x = random.within(1.0, 10.0) * [1e-30, 1e-9, 1e-3, 1.0, 1e3, 1e9, 1e30][random.below(7)];
                if random.below(2) == 0 { x } else { -x }
            }
        };
        if x >= least && x <= most {
            return x;
        }
    }
    least.max(most.min(1.0))
}

// ---- the property

/// The violation by an accepted text, if there is one, and whether the text is accepted.
fn wrong(text: &Text, seed: u64) -> (Option<String>, bool) {
    let shown = text.show();
    let mut loaded = crate::load("a.fric", &shown, &crate::NoSources);
    let accepted =
        !loaded.has_errors() && !crate::check_declarations(&loaded, &crate::NoSources).iter().any(|d| d.is_error());
    if !accepted {
        return (None, false);
    }
    let built = crate::build(&mut loaded, &crate::NoSources, "A", &crate::Changes::default(), &mut Vec::new());
    let Ok(built) = built else { return (None, false) };
    let (description, outputs) = (&built.program.description, crate::math::expand(&built.program.outputs));
    let slot = |path: &str| description.quantity(path).map(|quantity| quantity.slot.0 as usize);
    let output = slot("o").expect("it has an output");
    let slots: Vec<Option<usize>> = (0..text.quantities.len()).map(|k| slot(&format!("x{k}"))).collect();
    let mut random = Random(seed);
    for _ in 0..60 {
        let numbers: Vec<f64> = text.quantities.iter().map(|(_, _, bounds)| sample(&mut random, *bounds)).collect();
        let mut values = Values { text, numbers: &numbers, met: Met::default() };
        let kept = text.requires.iter().all(|(op, a, b)| {
            let (a, b) = (values.value(a, &numbers), values.value(b, &numbers));
            compare(op, a, b)
        });
        if !kept {
            continue;
        }
        values.met = Met::default();
        let expected = values.value(&text.output, &numbers);
        // Values that are computed whether or not the output depends on them.
        for value in &text.lets {
            values.value(value, &numbers);
        }
        if text.part.is_some() {
            values.value(&E::Part, &numbers);
        }
        let met = values.met;
        let mut block = vec![0.0; description.layout.size()];
        for (k, slot) in slots.iter().enumerate() {
            if let Some(slot) = slot {
                block[*slot] = numbers[k];
            }
        }
        crate::ir::interpret::run_once(&outputs, &mut block, &description.pool);
        let left = description.guards.iter().any(|guard| {
            let x = block[guard.slot.0 as usize];
            guard.path != "o" && !(x >= guard.range.0 && x <= guard.range.1)
        });
        if met.watched && !left && !met.large {
            return (Some(format!("nobody notices that `q.a` leaves its range at {numbers:?}")), true);
        }
        if left || met.large || met.near {
            continue;
        }
        if let Some(bad) = met.bad {
            return (Some(format!("{bad} at {numbers:?}")), true);
        }
        let found = block[output];
        if !found.is_finite() {
            return (Some(format!("{found} instead of {expected:e} at {numbers:?}")), true);
        }
    }
    (None, true)
}

/// Smaller expressions that can replace an expression, for shrinking.
fn smaller(e: &Node) -> Vec<Node> {
    let mut out: Vec<Node> = vec![];
    let mut with = |parts: Vec<&Node>, build: &dyn Fn(Vec<Node>) -> E| {
        out.extend(parts.iter().map(|part| (*part).clone()));
        for (k, part) in parts.iter().enumerate() {
            for other in smaller(part) {
                let mut parts: Vec<Node> = parts.iter().map(|part| (*part).clone()).collect();
                parts[k] = other;
                out.push(Rc::new(build(parts)));
            }
        }
    };
    match &**e {
        E::Number(x) if *x == 1.0 || *x == 0.0 => {}
        E::Number(_) | E::Quantity(_) | E::Let(_) | E::Part => out.push(Rc::new(E::Number(1.0))),
        E::Negate(a) => with(vec![a], &|p| E::Negate(p[0].clone())),
        E::Op(op, a, b) => with(vec![a, b], &|p| E::Op(*op, p[0].clone(), p[1].clone())),
        E::Power(a, n) => with(vec![a], &|p| E::Power(p[0].clone(), *n)),
        E::Raised(a, b) => with(vec![a, b], &|p| E::Raised(p[0].clone(), p[1].clone())),
        E::Call(f, args) => with(args.iter().collect(), &|p| E::Call(f, p)),
        E::If(c, a, b) => {
            with(vec![a, b], &|p| E::If(c.clone(), p[0].clone(), p[1].clone()));
            if let C::Not(d) | C::Both(d, _) | C::Either(d, _) = &**c {
                out.push(Rc::new(E::If(d.clone(), a.clone(), b.clone())));
            }
        }
    }
    out
}

/// Shrinks a text to a smaller one with a violation.
fn shrunk(mut text: Text, seed: u64) -> (Text, String) {
    let mut message = wrong(&text, seed).0.expect("it is wrong");
    'again: loop {
        let mut tries: Vec<Text> = Vec::new();
        for k in 0..text.requires.len() {
            let mut less = text.clone();
            less.requires.remove(k);
            tries.push(less);
        }
        tries.extend(smaller(&text.output).into_iter().map(|output| Text { output, ..text.clone() }));
        for k in 0..text.lets.len() {
            for other in smaller(&text.lets[k]) {
                let mut less = text.clone();
                less.lets[k] = other;
                tries.push(less);
            }
        }
        if let Some((argument, bounds, body)) = &text.part {
            tries.extend(
                smaller(argument).into_iter().map(|a| Text { part: Some((a, *bounds, body.clone())), ..text.clone() }),
            );
            tries.extend(
                smaller(body).into_iter().map(|b| Text { part: Some((argument.clone(), *bounds, b)), ..text.clone() }),
            );
        }
        for less in tries {
            if let Some(words) = wrong(&less, seed).0 {
                (text, message) = (less, words);
                continue 'again;
            }
        }
        return (text, message);
    }
}

fn from_environment(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).ok().and_then(|value| value.parse().ok()).unwrap_or(otherwise)
}

/// The first of `runs` texts that is accepted and has a violation, with its index, and the number of accepted texts.
fn search(seed: u64, runs: u64) -> (Option<(u64, Text, String)>, u64) {
    let mut accepted = 0;
    for run in 0..runs {
        let of_run = seed.wrapping_add(run.wrapping_mul(abi::random::GAMMA));
        let text = Maker { random: Random(of_run), quantities: 1, lets: 0, part: false }.text();
        let (found, fits) = wrong(&text, of_run);
        accepted += u64::from(fits);
        if found.is_some() {
            let (text, message) = shrunk(text, of_run);
            return (Some((run, text, message)), accepted);
        }
    }
    (None, accepted)
}

#[test]
fn accepted_texts_yield_finite_outputs() {
    let (seed, runs) = (from_environment("FRIC_SEED", 1), from_environment("FRIC_RUNS", 600));
    let (found, accepted) = search(seed, runs);
    if let Some((run, text, message)) = found {
        panic!("seed {seed}, text {run}: {message}\n{}", text.show());
    }
    println!("seed {seed}: {accepted} of {runs} texts are accepted");
    assert!(accepted * 10 > runs, "only {accepted} of {runs} texts are accepted: nothing is tested");
}

#[test]
fn injected_faults_are_detected() {
    let seed = from_environment("FRIC_SEED", 1);
    let mut missed = Vec::new();
    for name in planted::ALL.iter().filter(|name| **name != "ends do not round") {
        planted::plant(name);
        let (found, _) = search(seed, 6000);
        planted::plant("");
        match found {
            Some((run, text, message)) => println!("{name}: text {run}, {message}\n{}", text.show()),
            None => missed.push(*name),
        }
    }
    assert!(missed.is_empty(), "seed {seed}: not found: {missed:?}");
}

/// The compiler's elementary functions lie in their images by interval arithmetic, on which proofs rely, to the last
/// bit.
#[test]
fn elementary_functions_lie_in_their_images() {
    in_their_images();
}

#[test]
fn wrong_limits_of_elementary_functions_are_detected() {
    for fault in ["exponentials are never zero", "tanh never reaches 1"] {
        planted::plant(fault);
        let found = std::panic::catch_unwind(in_their_images);
        planted::plant("");
        assert!(found.is_err(), "{fault}");
    }
}

fn in_their_images() {
    use crate::ir::build::Build;
    use abi::Slot;
    let mut build = Build::new("images").with_pool(crate::math::POOL.as_slice().into());
    let (x, y) = (build.load(Slot(0)), build.load(Slot(1)));
    let of_one = Unary::ALL.map(|function| build.unary(function, x));
    let of_two = Binary::ALL.map(|function| build.binary(function, x, y));
    for (k, value) in of_one.into_iter().chain(of_two).enumerate() {
        build.store(Slot(2 + k as u32), value);
    }
    let func = crate::math::expand(&build.finish());
    let seed = from_environment("FRIC_SEED", 7);
    let mut random = Random(seed);
    for case in 0..20_000 {
        let mut number = || match random.below(3) {
            0 => random.within(-1.0, 1.0) * [1e-300, 1e-17, 1e-16, 1e-8, 1e-3, 1.0][random.below(6)],
            1 => random.within(-750.0, 750.0) * [1.0, 0.05, 0.004][random.below(3)],
            _ => random.real(),
        };
        let (x, y, ends) = (number(), number(), [number(), number()]);
        if x.is_nan() || y.is_nan() {
            continue;
        }
        let mut block = [0.0; 2 + Unary::ALL.len() + Binary::ALL.len()];
        (block[0], block[1]) = (x, y);
        crate::ir::interpret::run_once(&func, &mut block, crate::math::pool());
        let check = |name: &str, image: Interval, value: f64, x: Interval, y: Interval| {
            let inside = value >= image.low && value <= image.high && value.abs() >= image.away;
            assert!(inside, "seed {seed}, case {case}: {name} of {x:?}, {y:?}: {value:e} in {image:?}");
        };
        // The images of the numbers alone, and of intervals that hold them.
        let [wide_x, wide_y] =
            [(x, ends[0]), (y, ends[1])].map(|(x, end)| Interval::point(x).hull(Interval::closed(end, end)));
        for (at_x, at_y) in [(Interval::point(x), Interval::point(y)), (wide_x, wide_y)] {
            for (k, function) in Unary::ALL.into_iter().enumerate() {
                let row = function.row();
                if row.domain.holds(Interval::point(x)) && (x.is_finite() || row.shape != Shape::Other) {
                    check(row.name, function.image(at_x), block[2 + k], at_x, at_y);
                }
            }
            for (k, function) in Binary::ALL.into_iter().enumerate() {
                let value = block[2 + Unary::ALL.len() + k];
                if !value.is_nan() {
                    check(function.name(), (function.row().image)(at_x, at_y), value, at_x, at_y);
                }
            }
        }
    }
}
