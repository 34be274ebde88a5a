//! Mutates texts of the library from a seed: numbers become edge cases, operators, functions and names are exchanged,
//! terms are removed or doubled, expressions are wrapped, conditions negated. A mutant is kept if it checks and differs
//! as a program.

use crate::campaign::Made;
use crate::texts::{self, Fallen};
use abi::plan::Method;
use compiler::functions::{Builtin, Units};
use compiler::ir::program::Program;
use compiler::ir::random::Random;
use grammar::ast::{
    BinaryOp, Bind, BindValue, Declaration, EveryStatement, ExperimentStatement, Expr, ExprKind, Instance, Item, Range,
    Statement, SweepOver, TablePoints,
};
use grammar::span::Span;
use std::collections::{HashMap, HashSet};
use std::sync::{LazyLock, Mutex};

/// The library's texts with experiments, and the places that can be mutated in each.
static TEXTS: LazyLock<Vec<Original>> = LazyLock::new(|| {
    let all = crate::library().into_iter().map(|(name, text)| Original::new(name, text));
    all.filter(|original| !original.experiments.is_empty()).collect()
});

/// A text of the library and its places.
struct Original {
    name: String,
    text: String,
    experiments: Vec<Experiment>,
    places: Vec<Place>,
    names: Vec<Known>,
}

/// An experiment and the places that it may depend on: its own, and those of the items that it uses, transitively.
struct Experiment {
    name: String,
    places: Vec<usize>,
}

/// A name that is declared in a model.
struct Known {
    name: String,
    item: usize,
    /// As written, after the name or after its value.
    unit: Option<String>,
}

/// An expression that can be changed.
struct Place {
    span: Span,
    what: What,
    /// Number of the item that it is in.
    item: usize,
}

/// The syntax at a place, as far as mutations depend on it.
#[derive(Clone)]
enum What {
    /// The unit as written.
    Number(Option<String>),
    /// One name.
    Name,
    /// The name of the function.
    Call(String, Span),
    /// Operator, its place, both sides.
    Binary(BinaryOp, Span, Span, Span),
    Other,
}

/// A replacement at a place.
type Edit = (Span, String);

/// The program of a mutated text, or why there is none.
pub fn mutant(seed: u64) -> Result<Made, Fallen> {
    let mut random = Random(seed ^ 0x6D75_7461_6E74);
    let original = &TEXTS[random.below(TEXTS.len())];
    let experiment = &original.experiments[random.below(original.experiments.len())];
    let (text, ways) = original.changed(experiment, &mut random);
    let experiment = &experiment.name;
    let method = Method::ALL[seed as usize % Method::ALL.len()];
    let (variants, step) =
        texts::read(&original.name, &text, experiment, method).map_err(|found| texts::fallen(&found))?;
    let which = random.below(variants.len());
    let program = &variants[which].program;
    if original.programs(experiment, method).get(which).is_some_and(|own| same(own, program)) {
        return Err("the same program".into());
    }
    let step =
        step * [1.0, 1.0, 1.0, 0.5, 7.0, 1e-9][random.below(if program.description.delays.is_empty() { 6 } else { 1 })];
    let name = format!("{}, {experiment}, changed with seed {seed}", original.name);
    let case = texts::case(&name, &text, program, method, step, &mut random)?;
    let marks = ways.into_iter().map(|way| format!("mutation/{way}")).chain([format!("of/{}", original.name)]);
    let marks = marks.collect::<std::collections::BTreeSet<String>>().into_iter().collect();
    Ok(Made { cases: vec![case], marks })
}

/// Whether the code and the values of two programs are equal.
fn same(a: &Program, b: &Program) -> bool {
    let params = |program: &Program| program.params.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    params(a) == params(b)
        && (&a.start, &a.outputs, &a.derivatives) == (&b.start, &b.outputs, &b.derivatives)
        && (&a.tick, &a.transitions, &a.roots) == (&b.tick, &b.transitions, &b.roots)
        && a.description.pool == b.description.pool
}

impl Original {
    fn new(name: String, text: String) -> Original {
        let loaded = compiler::load(&name, &text, &crate::support::Texts::default());
        let file = loaded.files.get(loaded.root()).ast.clone();
        let mut found = Found::default();
        let mut items: Vec<(Option<String>, HashSet<&str>)> = Vec::new();
        for item in file.items() {
            found.item(item);
            let (name, span) = named(item);
            let words = text[span.range()].split(|sign: char| !sign.is_ascii_alphanumeric() && sign != '_');
            items.push((name, words.collect()));
            found.at += 1;
        }
        // A span excludes parentheses, which a mutation must keep balanced.
        found.places.retain(|place| balanced(&text[place.span.range()]));
        let mut experiments = Vec::new();
        for (first, item) in file.items().enumerate() {
            let Item::Experiment(experiment) = item else { continue };
            let mut reached = vec![first];
            let mut next = 0;
            while let Some(at) = reached.get(next).copied() {
                let named = |(_, (name, _)): &(usize, &(Option<String>, HashSet<&str>))| {
                    name.as_ref().is_some_and(|name| items[at].1.contains(name.as_str()))
                };
                let more: Vec<usize> = items.iter().enumerate().filter(named).map(|(other, _)| other).collect();
                reached.extend(more.into_iter().filter(|other| !reached.contains(other)).collect::<Vec<_>>());
                next += 1;
            }
            let inside = found.places.iter().enumerate().filter(|(_, place)| reached.contains(&place.item));
            let places: Vec<usize> = inside.map(|(place, _)| place).collect();
            // An experiment on a model of another text with all its defaults has nothing to mutate.
            if !places.is_empty() {
                experiments.push(Experiment { name: experiment.name.text.clone(), places });
            }
        }
        drop(items);
        Original { name, text, experiments, places: found.places, names: found.names }
    }

    /// All combinations of an experiment in its original form.
    fn programs(&self, experiment: &str, method: Method) -> Vec<Program> {
        type Key = (String, String, Method);
        static KNOWN: LazyLock<Mutex<HashMap<Key, Vec<Program>>>> = LazyLock::new(Default::default);
        let key = (self.name.clone(), experiment.to_string(), method);
        let mut known = KNOWN.lock().unwrap();
        let made = known.entry(key).or_insert_with(|| {
            let read = texts::read(&self.name, &self.text, experiment, method);
            let (variants, _) = read.unwrap_or_else(|errors| panic!("{}, {experiment}: {errors:?}", self.name));
            variants.into_iter().map(|variant| variant.program).collect()
        });
        made.clone()
    }

    /// The text with one to four mutations that do not overlap, and their kinds.
    fn changed(&self, experiment: &Experiment, random: &mut Random) -> (String, Vec<&'static str>) {
        let mut edits: Vec<Edit> = Vec::new();
        let mut ways = Vec::new();
        for _ in 0..1 + random.below(4) {
            let place = &self.places[experiment.places[random.below(experiment.places.len())]];
            let (span, instead, way) = self.change(place, random);
            if edits.iter().all(|(other, _)| span.end <= other.start || other.end <= span.start) {
                edits.push((span, instead));
                ways.push(way);
            }
        }
        edits.sort_by_key(|(span, _)| std::cmp::Reverse(span.start));
        let mut text = self.text.clone();
        for (span, instead) in edits {
            text.replace_range(span.range(), &instead);
        }
        (text, ways)
    }

    fn change(&self, place: &Place, random: &mut Random) -> (Span, String, &'static str) {
        let own = |span: Span| &self.text[span.range()];
        let here = own(place.span);
        // Mutations that suit any expression.
        if random.below(4) == 0 {
            let (instead, way) = match (&place.what, random.below(7)) {
                (What::Binary(op, ..), _) if is_truth(*op) => (format!("(not ({here}))"), "turned"),
                (_, 0) => (format!("abs({here})"), "wrapped"),
                (_, 1) => (format!("(-({here}))"), "turned"),
                (_, 2) => (format!("min({here}, -({here}))"), "wrapped"),
                (_, 3) => (format!("max({here}, 0.3 * ({here}))"), "wrapped"),
                (_, 4) => (format!("(if t > 1 ms then {here} else 2 * ({here}))"), "chosen"),
                (_, 5) => (format!("(({here}) * (1 + 0.1 * sin(t * 30 1/s)))"), "swung"),
                _ => (format!("delay({here}, {} ms)", [1, 3, 10][random.below(3)]), "delayed"),
            };
            return (place.span, instead, way);
        }
        match &place.what {
            What::Number(unit) => {
                let number = match random.below(3) {
                    0 => EDGES[random.below(EDGES.len())].to_string(),
                    _ => {
                        let digits = here.strip_suffix(unit.as_deref().unwrap_or_default()).unwrap_or(here).trim();
                        let by = [0.5, 2.0, 1e-3, 1e3, 0.999_999, 1e-9, 1e9, 3.0][random.below(8)];
                        digits.parse::<f64>().map_or_else(|_| "1".into(), |value| format!("{:e}", value * by))
                    }
                };
                (
                    place.span,
                    [number.as_str(), unit.as_deref().unwrap_or_default()].join(" ").trim_end().into(),
                    "number",
                )
            }
            What::Name => {
                let near = || self.names.iter().filter(|known| known.item == place.item);
                let unit = near().find(|known| known.name == here).and_then(|known| known.unit.as_ref());
                let fit: Vec<&str> = near()
                    .filter(|known| known.name != here && known.unit.as_ref() == unit)
                    .map(|known| known.name.as_str())
                    .collect();
                let other = if fit.is_empty() { here } else { fit[random.below(fit.len())] };
                (place.span, other.into(), "name")
            }
            What::Call(function, at) => {
                let alike = alike(function);
                let other = if alike.is_empty() { function.as_str() } else { alike[random.below(alike.len())] };
                (*at, other.into(), "function")
            }
            What::Binary(op, at, left, right) => {
                let (left, right) = (own(*left), own(*right));
                match random.below(4) {
                    0 if sums(*op) || is_truth(*op) && !compares(*op) => {
                        let kept = if random.below(2) == 0 { left } else { right };
                        (place.span, format!("({kept})"), "term dropped")
                    }
                    1 if sums(*op) => (place.span, format!("({here} {} {right})", op.text()), "term doubled"),
                    2 if compares(*op) => (place.span, format!("({right}) {} ({left})", op.text()), "sides exchanged"),
                    _ => (*at, instead(*op, random).into(), "operator"),
                }
            }
            What::Other => (place.span, format!("(0.5 * ({here}))"), "wrapped"),
        }
    }
}

/// Numbers for which differences in arithmetic are most likely.
const EDGES: [&str; 14] = [
    "0",
    "1",
    "2",
    "0.5",
    "-1",
    "5e-324",
    "2.2250738585072014e-308",
    "1e308",
    "1e-160",
    "1e160",
    "4503599627370496.5",
    "1e-12",
    "1e12",
    "709.9",
];

/// The functions that may replace a function: with as many arguments of the same units, and folds for a fold. `sign` and
/// `sqrt` also replace `abs`, although their results have other units.
fn alike(function: &str) -> Vec<&'static str> {
    match (function, Builtin::named(function)) {
        ("sum", _) => vec!["sum", "min", "max"],
        ("abs" | "sign" | "sqrt", _) => vec!["abs", "sign", "sqrt"],
        (_, Some(builtin)) => {
            let units = |builtin: Builtin| {
                let signature = builtin.signature();
                let arguments: Vec<Units> = signature.arguments.iter().map(|(_, units)| *units).collect();
                (arguments, signature.result)
            };
            let wanted = units(builtin);
            Builtin::all().filter(|other| units(*other) == wanted).map(Builtin::name).collect()
        }
        (_, None) => Vec::new(),
    }
}

fn sums(op: BinaryOp) -> bool {
    matches!(op, BinaryOp::Add | BinaryOp::Subtract)
}

fn compares(op: BinaryOp) -> bool {
    is_truth(op) && !matches!(op, BinaryOp::And | BinaryOp::Or)
}

fn is_truth(op: BinaryOp) -> bool {
    use BinaryOp::*;
    match op {
        Add | Subtract | Multiply | Divide | Power => false,
        Less | LessEqual | Greater | GreaterEqual | Equal | NotEqual | And | Or | Crosses | Rises | Falls => true,
    }
}

/// Another operator of the same kind.
fn instead(op: BinaryOp, random: &mut Random) -> &'static str {
    use BinaryOp::*;
    match op {
        Add => "-",
        Subtract => "+",
        Multiply => "/",
        Divide => "*",
        Power => "*",
        And => "or",
        Or => "and",
        Equal => "!=",
        NotEqual => "==",
        Less | LessEqual | Greater | GreaterEqual => ["<", "<=", ">", ">="][random.below(4)],
        Crosses | Rises | Falls => ["crosses", "rises", "falls", ">", "<"][random.below(5)],
    }
}

/// The name of an item, if others can refer to it, and its span.
fn named(item: &Item) -> (Option<String>, Span) {
    match item {
        Item::Import(item) => (None, item.span),
        Item::Const(item) => (Some(item.name.text.clone()), item.span),
        Item::Function(item) => (Some(item.name.text.clone()), item.span),
        Item::Table(item) => (Some(item.name.text.clone()), item.span),
        Item::Interface(item) => (Some(item.name.text.clone()), item.span),
        Item::Model(item) => (Some(item.name.text.clone()), item.span),
        Item::Variant(item) => (Some(item.name.text.clone()), item.span),
        Item::Experiment(item) => (None, item.span),
        Item::Fit(item) => (None, item.span),
        Item::Device(item) => (Some(item.name.text.clone()), item.span),
        Item::Rig(item) => (Some(item.name.text.clone()), item.span),
    }
}

/// Whether parentheses are balanced.
fn balanced(text: &str) -> bool {
    let mut open = 0;
    for sign in text.chars() {
        open += match sign {
            '(' => 1,
            ')' => -1,
            _ => 0,
        };
        if open < 0 {
            return false;
        }
    }
    open == 0
}

/// The places of a text.
#[derive(Default)]
struct Found {
    places: Vec<Place>,
    names: Vec<Known>,
    /// Number of the item that is looked through.
    at: usize,
}

impl Found {
    fn item(&mut self, item: &Item) {
        match item {
            Item::Const(constant) => self.expr(&constant.value),
            Item::Function(function) => self.expr(&function.body),
            Item::Table(table) => {
                if let TablePoints::Listed(points) = &table.points {
                    points.iter().for_each(|(_, value)| self.expr(value));
                }
            }
            Item::Model(model) => model.body.iter().for_each(|statement| self.statement(statement)),
            Item::Variant(variant) => self.instance(&variant.instance),
            Item::Experiment(experiment) => {
                for statement in &experiment.body {
                    match statement {
                        ExperimentStatement::Run(run) => self.instance(&run.instance),
                        ExperimentStatement::Sweep(sweep) => {
                            if let SweepOver::Instances(instances) = &sweep.over {
                                instances.iter().for_each(|instance| self.instance(instance));
                            }
                        }
                        ExperimentStatement::Solver(_)
                        | ExperimentStatement::Data(_)
                        | ExperimentStatement::Derived(_)
                        | ExperimentStatement::Plot(_)
                        | ExperimentStatement::Tune(..)
                        | ExperimentStatement::Expect(_)
                        | ExperimentStatement::Record(_)
                        | ExperimentStatement::Allow(_) => {}
                    }
                }
            }
            Item::Import(_) | Item::Interface(_) | Item::Fit(_) | Item::Device(_) | Item::Rig(_) => {}
        }
    }

    fn statement(&mut self, statement: &Statement) {
        match statement {
            Statement::Declaration(declaration) => self.declaration(declaration),
            Statement::Equation(equation) => self.expr(&equation.value),
            Statement::Part(part) => self.instance(&part.instance),
            Statement::Every(every) => {
                for statement in &every.body {
                    match statement {
                        EveryStatement::Declaration(declaration) => self.declaration(declaration),
                        EveryStatement::Equation(equation) => self.expr(&equation.value),
                    }
                }
            }
            Statement::Mode(mode) => {
                mode.equations.iter().for_each(|equation| self.expr(&equation.value));
                for go in &mode.transitions {
                    self.expr(&go.condition);
                    go.resets.iter().for_each(|reset| self.expr(&reset.value));
                }
            }
            Statement::When(when) => {
                self.expr(&when.condition);
                when.resets.iter().for_each(|reset| self.expr(&reset.value));
            }
            Statement::Require(_) | Statement::Storage(_) | Statement::Allow(_) => {}
        }
    }

    fn declaration(&mut self, declaration: &Declaration) {
        let behind = match declaration.value.as_ref().map(|value| &value.kind) {
            Some(ExprKind::Number { unit, .. }) => unit.as_ref(),
            _ => None,
        };
        let unit = declaration.unit.as_ref().or(behind).map(|unit| unit.text.clone());
        self.names.push(Known { name: declaration.name.text.clone(), item: self.at, unit });
        declaration.value.iter().for_each(|value| self.expr(value));
        match &declaration.range {
            Some(Range::Between(low, high)) => [low, high].into_iter().for_each(|bound| self.expr(bound)),
            Some(Range::Bound(_, bound)) => self.expr(bound),
            None => {}
        }
    }

    fn instance(&mut self, instance: &Instance) {
        for Bind { value, .. } in &instance.args {
            match value {
                BindValue::Expr(expr) => self.expr(expr),
                BindValue::Instance(instance) => self.instance(instance),
            }
        }
    }

    fn expr(&mut self, expr: &Expr) {
        let what = match &expr.kind {
            ExprKind::Number { unit, .. } => What::Number(unit.as_ref().map(|unit| unit.text.clone())),
            ExprKind::Path(path) => match path.single() {
                Some(_) => What::Name,
                None => What::Other,
            },
            ExprKind::Call { function, args, .. } => {
                args.iter().for_each(|arg| self.expr(arg));
                What::Call(function.text.clone(), function.span)
            }
            ExprKind::Unary(_, of) => {
                self.expr(of);
                What::Other
            }
            ExprKind::Binary(op, at, left, right) => {
                self.expr(left);
                self.expr(right);
                What::Binary(*op, *at, left.span, right.span)
            }
            ExprKind::If(condition, then, otherwise) => {
                [condition, then, otherwise].into_iter().for_each(|part| self.expr(part));
                What::Other
            }
            ExprKind::Derivative { .. } => What::Other,
            ExprKind::Hole | ExprKind::Error => return,
        };
        self.places.push(Place { span: expr.span, what, item: self.at });
    }
}
