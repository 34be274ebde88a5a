//! Factors 2π and 180/π that are lost in silence: angles and speeds of rotation beside revolutions and their rates.
//!
//! In: a flat and typed [`System`]. Out: W0107. Radians are pure numbers, so units alone tell neither 6 rad/s from 6 Hz
//! nor 30 from 30 deg. What a quantity counts follows from its declared unit, and is carried through sums, arguments,
//! functions and products with `2 * pi`; where it is not certain, nothing is reported.

use crate::frontend::source::Files;
use crate::frontend::system::*;
use crate::frontend::turns::{self, Counts, counted, scaled};
use crate::frontend::units::Types;
use crate::functions::{Unary, Units};
use crate::ir::hash::HashSet;
use abi::format::three_digits;
use abi::unit::{Angle, Dimension, Unit};
use grammar::ast::{BinaryOp, ExperimentStatement, Item};
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;
use std::f64::consts::PI;

const TIME: Dimension = Dimension::of([0, 0, 1, 0, 0]);
const RATE: Dimension = Dimension::of([0, 0, -1, 0, 0]);
const LENGTH: Dimension = Dimension::of([0, 1, 0, 0, 0]);
const TAU: f64 = 2.0 * PI;
/// Relative distance at which a written factor counts as 2π: `6.28` is meant.
const NEAR: f64 = 1e-3;
/// Longest chain of definitions that is followed.
const DEEPEST: u32 = 200;

/// Reports W0107.
pub fn check(system: &System, types: &Types, files: &Files, diagnostics: &mut Vec<Diagnostic>) {
    let named = |unit: &Unit| !matches!(counted(unit), Counts::Unknown);
    let vars = system.vars.iter().any(|var| var.unit.as_ref().is_some_and(|(unit, _)| named(unit)));
    let nodes = |node: &Node| match node {
        Node::Number { angle, .. } => matches!(angle, Angle::Angle | Angle::Cycles),
        Node::Call(builtin, _) => angular(*builtin) || periodic(*builtin).is_some(),
        _ => false,
    };
    if !vars && !system.nodes.iter().any(nodes) {
        return;
    }
    let mut reader = Reader::new(system, types, files);
    // Products inside of products are judged as a whole.
    let mut inner = HashSet::default();
    for node in &system.nodes {
        if let Node::Binary(BinaryOp::Multiply | BinaryOp::Divide, a, b) = node {
            inner.extend([*a, *b]);
        }
    }
    for index in 0..system.nodes.len() {
        let id = ExprId(index as u32);
        reader.node(id, inner.contains(&id));
    }
    for id in system.var_ids() {
        reader.definition(id);
    }
    diagnostics.append(&mut reader.found);
}

/// The warning about a quantity that an experiment shows in a unit which counts something else.
pub fn shown_in(
    system: &System,
    types: &Types,
    files: &Files,
    (expr, unit): (ExprId, &Unit),
    place: Span,
) -> Option<Diagnostic> {
    let mut reader = Reader::new(system, types, files);
    let text = reader.text(expr).to_string();
    match (reader.of(expr), counted(unit)) {
        (Counts::Rate, Counts::Speed) => Some(
            Diagnostic::warning("W0107", format!("`{text}` is a rate, and {unit} are an angle per second"))
                .label(place, "the numbers are those of rad/s, without 2π")
                .label(system.span(expr), "counts revolutions or periods")
                .help("show it in Hz, or multiply it by `2 * pi`"),
        ),
        (Counts::Speed, Counts::Rate) => Some(
            Diagnostic::warning("W0107", format!("`{text}` is an angle per second, and Hz count revolutions"))
                .label(place, "the numbers are those of rad/s: 6.28 for one revolution a second")
                .label(system.span(expr), "an angle per second")
                .help(format!("show it in rev/s or rpm, or write `{} / (2 * pi)`", factor_text(&text))),
        ),
        _ => None,
    }
}

/// Functions of an angle.
fn angular(builtin: Builtin) -> bool {
    matches!(builtin, Builtin::Unary(Unary::Sin | Unary::Cos | Unary::Tan))
}

/// The arguments of a signal that are frequencies.
fn periodic(builtin: Builtin) -> Option<&'static [(&'static str, Units)]> {
    matches!(builtin, Builtin::Sine | Builtin::Square | Builtin::Chirp).then(|| builtin.signature().arguments)
}

/// A text as a factor of a product.
fn factor_text(text: &str) -> String {
    let (mut depth, mut loose) = (0, false);
    for (k, c) in text.char_indices() {
        match c {
            '(' => depth += 1,
            ')' => depth -= 1,
            '+' | '-' if depth == 0 && k > 0 => loose |= text[..k].ends_with(' '),
            _ => {}
        }
    }
    if loose || text.starts_with("if ") { format!("({text})") } else { text.to_string() }
}

fn near(x: f64, y: f64) -> bool {
    (x / y - 1.0).abs() < NEAR
}

/// A product: its constant, the factors that are no constants, with their exponents 1 and −1.
struct Product {
    constant: f64,
    /// Whether π is written in it.
    pi: bool,
    factors: Vec<(ExprId, i32)>,
}

struct Reader<'a> {
    system: &'a System,
    types: &'a Types,
    files: &'a Files,
    of_nodes: Vec<Option<Counts>>,
    of_vars: Vec<Option<Counts>>,
    depth: u32,
    found: Vec<Diagnostic>,
}

impl<'a> Reader<'a> {
    fn new(system: &'a System, types: &'a Types, files: &'a Files) -> Reader<'a> {
        let (of_nodes, of_vars) = (vec![None; system.nodes.len()], vec![None; system.vars.len()]);
        Reader { system, types, files, of_nodes, of_vars, depth: 0, found: Vec::new() }
    }

    fn text(&self, id: ExprId) -> &'a str {
        self.files.slice(self.system.span(id))
    }

    fn dimension(&self, id: ExprId) -> Option<Dimension> {
        self.types.nodes[id.0 as usize]
    }

    /// The unit that a declaration states, in brackets or by its number.
    fn declared(&self, var: VarId) -> Option<&'a Unit> {
        let var = self.system.var(var);
        var.unit.as_ref().map(|(unit, _)| unit).or(var.shown.as_ref())
    }

    /// The unit in which a plain quantity is declared, also within a measure or a magnitude.
    fn unit(&self, id: ExprId) -> Option<(&'a Unit, VarId)> {
        match self.system.node(id) {
            Node::Var(var) => Some((self.declared(*var)?, *var)),
            Node::Negate(a) | Node::Fits { value: a, .. } | Node::Measure(_, a, ..) => self.unit(*a),
            Node::Call(Builtin::Abs, args) => self.unit(args[0]),
            _ => None,
        }
    }

    /// A number that is written without a unit, other than 0.
    fn bare(&self, id: ExprId) -> Option<f64> {
        match self.system.node(id) {
            Node::Number { value, dimension: Some(Dimension::NONE), angle: Angle::Silent } => {
                self.text(id).parse::<f64>().is_ok().then_some(*value)
            }
            Node::Negate(a) => Some(-self.bare(*a)?),
            _ => None,
        }
    }

    // ---- what an expression counts

    fn of(&mut self, id: ExprId) -> Counts {
        if let Some(known) = self.of_nodes[id.0 as usize] {
            return known;
        }
        if self.depth > DEEPEST {
            return Counts::Unknown;
        }
        self.depth += 1;
        let found = self.counts(id);
        self.depth -= 1;
        self.of_nodes[id.0 as usize] = Some(found);
        found
    }

    fn of_var(&mut self, id: VarId) -> Counts {
        if let Some(known) = self.of_vars[id.0 as usize] {
            return known;
        }
        self.of_vars[id.0 as usize] = Some(Counts::Unknown); // if it depends on itself
        let found = match (self.declared(id), &self.system.var(id).definition) {
            (Some(unit), _) => counted(unit),
            (None, Definition::Value(value, _) | Definition::Held { value, .. }) => self.of(*value),
            (None, Definition::Continuous { initial, .. } | Definition::Sampled { initial, .. }) => self.of(*initial),
            (None, Definition::Free | Definition::Missing) => Counts::Unknown,
        };
        self.of_vars[id.0 as usize] = Some(found);
        found
    }

    fn counts(&mut self, id: ExprId) -> Counts {
        match self.system.node(id) {
            Node::Number { dimension, angle, .. } => match (angle, *dimension) {
                (Angle::Cycles, Some(RATE)) => Counts::Rate,
                (Angle::Angle, Some(RATE)) => Counts::Speed,
                (Angle::Angle, Some(Dimension::NONE)) => Counts::Angle,
                _ => Counts::Unknown,
            },
            Node::Var(var) => self.of_var(*var),
            Node::Rate(var) => match self.of_var(*var) {
                Counts::Angle => Counts::Speed,
                Counts::Turns => Counts::Rate,
                _ => Counts::Unknown,
            },
            Node::Negate(a) => self.of(*a),
            Node::Fits { value, unit, .. } => match counted(unit) {
                Counts::Unknown => self.of(*value),
                stated => stated,
            },
            Node::If(_, a, b) => self.joined(&[*a, *b]),
            Node::Measure(measure, a, ..) => match measure {
                MeasureName::Min
                | MeasureName::Max
                | MeasureName::Mean
                | MeasureName::Rms
                | MeasureName::Final
                | MeasureName::At
                | MeasureName::PeakToPeak
                | MeasureName::Peak => self.of(*a),
                MeasureName::Integral
                | MeasureName::Crossings
                | MeasureName::Period
                | MeasureName::Settling
                | MeasureName::First
                | MeasureName::Rises
                | MeasureName::Turns
                | MeasureName::Time
                | MeasureName::Count
                | MeasureName::CountRises
                | MeasureName::CountTurns
                | MeasureName::Duration
                | MeasureName::Peaks => Counts::Unknown,
            },
            Node::Binary(BinaryOp::Add | BinaryOp::Subtract, a, b) => self.joined(&[*a, *b]),
            Node::Binary(BinaryOp::Multiply | BinaryOp::Divide, ..) => {
                let product = self.product(id);
                self.of_product(&product)
            }
            Node::Call(builtin, args) => match builtin {
                Builtin::Unary(Unary::Asin | Unary::Acos | Unary::Atan) => Counts::Angle,
                Builtin::Binary(_) if builtin.name() == "atan2" => Counts::Angle,
                _ if builtin.signature().result == Units::Same => {
                    let alike = builtin.signature().arguments.iter().zip(args);
                    let alike: Vec<ExprId> =
                        alike.filter(|((_, units), _)| *units == Units::Same).map(|(_, id)| *id).collect();
                    self.joined(&alike)
                }
                _ => Counts::Unknown,
            },
            Node::Table(table, _) => counted(&self.system.tables[*table as usize].y_unit),
            Node::Bool(_)
            | Node::Time
            | Node::PathRate(_)
            | Node::Not(_)
            | Node::Binary(..)
            | Node::InRegime(..)
            | Node::Crossing(_)
            | Node::Hole
            | Node::Error => Counts::Unknown,
        }
    }

    /// What a sum counts: what those addends count of which it is known, if they agree.
    fn joined(&mut self, addends: &[ExprId]) -> Counts {
        let mut known: Vec<Counts> = addends.iter().map(|id| self.of(*id)).collect();
        known.retain(|counts| *counts != Counts::Unknown);
        known.dedup();
        if let [one] = known[..] { one } else { Counts::Unknown }
    }

    fn product(&self, id: ExprId) -> Product {
        let mut out = Product { constant: 1.0, pi: false, factors: Vec::new() };
        let mut stack = vec![(id, 1)];
        while let Some((id, exponent)) = stack.pop() {
            match self.system.node(id) {
                Node::Binary(BinaryOp::Multiply, a, b) => stack.extend([(*b, exponent), (*a, exponent)]),
                Node::Binary(BinaryOp::Divide, a, b) => stack.extend([(*b, -exponent), (*a, exponent)]),
                Node::Negate(a) => {
                    out.constant = -out.constant;
                    stack.push((*a, exponent));
                }
                Node::Number { value, dimension: Some(Dimension::NONE), angle: Angle::Silent } => {
                    out.constant *= if exponent > 0 { *value } else { 1.0 / value };
                    out.pi |= *value == PI;
                }
                _ => out.factors.push((id, exponent)),
            }
        }
        out
    }

    fn of_product(&mut self, product: &Product) -> Counts {
        let constant = product.constant.abs();
        let (mut counting, mut rest) = (None, Dimension::NONE);
        for &(id, exponent) in &product.factors {
            let Some(dimension) = self.dimension(id) else { return Counts::Unknown };
            match self.of(id) {
                // A gear ratio, or a factor 2π with a name.
                Counts::Unknown if dimension.is_none() => return Counts::Unknown,
                Counts::Unknown if exponent > 0 => rest = rest.times(dimension),
                Counts::Unknown => rest = rest.over(dimension),
                counts if exponent > 0 && counting.is_none() => counting = Some(counts),
                _ => return Counts::Unknown,
            }
        }
        let counts = match (counting, rest) {
            (Some(counts), Dimension::NONE) => counts,
            (Some(Counts::Rate), TIME) => Counts::Turns,
            (Some(Counts::Speed), TIME) => Counts::Angle,
            (Some(Counts::Turns), RATE) => Counts::Rate,
            (Some(Counts::Angle), RATE) => Counts::Speed,
            _ => return Counts::Unknown,
        };
        // 2π makes an angle of a number of revolutions; other multiples of π are not judged.
        match counts {
            Counts::Turns if near(constant, TAU) => Counts::Angle,
            Counts::Rate if near(constant, TAU) => Counts::Speed,
            Counts::Angle if near(constant, 1.0 / TAU) => Counts::Turns,
            Counts::Speed if near(constant, 1.0 / TAU) => Counts::Rate,
            _ if product.pi || near(constant, 180.0 / PI) || near(constant, PI / 180.0) => Counts::Unknown,
            _ => counts,
        }
    }

    /// The only factor of a product that counts something, and whether all others are pure numbers, times and lengths.
    fn only(&mut self, product: &Product) -> Option<(ExprId, Counts)> {
        let mut only = None;
        for &(id, exponent) in &product.factors {
            let dimension = self.dimension(id)?;
            match self.of(id) {
                Counts::Unknown if [Dimension::NONE, TIME, LENGTH].contains(&dimension) => {}
                counts if counts != Counts::Unknown && exponent > 0 && only.is_none() => only = Some((id, counts)),
                _ => return None,
            }
        }
        only
    }

    // ---- what is reported

    fn report(&mut self, message: String, labels: &[(Span, String)], help: String) {
        let mut warning = Diagnostic::warning("W0107", message);
        for (place, text) in labels {
            warning = warning.label(*place, text.clone());
        }
        self.found.push(warning.help(help));
    }

    fn node(&mut self, id: ExprId, inner: bool) {
        match self.system.node(id).clone() {
            Node::Binary(BinaryOp::Multiply | BinaryOp::Divide, ..) if !inner => self.twice(id),
            Node::Binary(
                BinaryOp::Add
                | BinaryOp::Subtract
                | BinaryOp::Less
                | BinaryOp::LessEqual
                | BinaryOp::Greater
                | BinaryOp::GreaterEqual
                | BinaryOp::Equal
                | BinaryOp::NotEqual,
                a,
                b,
            ) => self.beside(a, b),
            Node::If(_, a, b) => self.beside(a, b),
            Node::Call(builtin, args) if angular(builtin) => self.angle_of(builtin, args[0]),
            Node::Call(builtin, args) => {
                if let Some(arguments) = periodic(builtin) {
                    for ((name, units), arg) in arguments.iter().zip(&args) {
                        if *units == Units::Frequency {
                            self.frequency(builtin, name, *arg);
                        }
                    }
                }
                let same =
                    builtin.signature().arguments.iter().zip(&args).filter(|((_, units), _)| *units == Units::Same);
                let same: Vec<ExprId> = same.map(|(_, arg)| *arg).collect();
                for pair in same.windows(2) {
                    self.beside(pair[0], pair[1]);
                }
            }
            Node::Fits { value, unit, role } => {
                let what = match &role {
                    Role::Argument { function, name } => format!("`{name}` of `{function}`"),
                    Role::Result { function } => format!("`{function}`"),
                };
                self.given(&what, &unit, None, value);
            }
            Node::Table(table, x) => {
                let table = &self.system.tables[table as usize];
                self.given(&format!("the argument of `{}`", table.name), &table.x_unit, None, x);
            }
            Node::Measure(MeasureName::Settling, a, Some(b), _) => self.beside(a, b),
            _ => {}
        }
    }

    /// A sum, a comparison or a choice of two quantities that count different things, or of an angle and a number.
    fn beside(&mut self, a: ExprId, b: ExprId) {
        for (a, b) in [(a, b), (b, a)] {
            // 1/s beside a speed of rotation: only as written, since a bandwidth is in 1/s as well.
            let plain = |id: ExprId| match self.system.node(id) {
                Node::Number { angle, dimension: Some(RATE), .. } => Some(*angle),
                Node::Var(var) => self.system.var(*var).unit.as_ref().map(|(unit, _)| unit.angle),
                _ => None,
            };
            let written = (plain(a), plain(b)) == (Some(Angle::Rate), Some(Angle::Angle));
            if written || (self.of(a), self.of(b)) == (Counts::Rate, Counts::Speed) {
                return self.rate_met(a, self.system.span(b));
            }
            if let (Some(number), Some((unit, var))) = (self.bare(a), self.unit(b).filter(|(unit, _)| scaled(unit))) {
                let declared = self.system.var(var).unit.as_ref().map_or(self.system.var(var).span, |(_, span)| *span);
                return self.no_unit(a, number, unit, declared);
            }
        }
    }

    /// A rate where a speed of rotation is declared, or beside one.
    fn rate_met(&mut self, rate: ExprId, angle: Span) {
        let text = self.text(rate).to_string();
        let number = text.split(|c: char| c.is_ascii_alphabetic() || c == ' ').next().unwrap_or_default();
        let labels =
            [(angle, "an angular velocity".to_string()), (self.system.span(rate), "a rate, without an angle".into())];
        match self.system.node(rate) {
            Node::Number { value, .. } if text.ends_with("Hz") => {
                let exact = three_digits(value * TAU);
                let number = if text.ends_with(" Hz") { number.to_string() } else { value.to_string() };
                self.report(
                    format!("{text} is {number} rad/s here, not {number} revolutions per second"),
                    &labels,
                    format!("write `{number} rev/s` ({exact} rad/s), or `{number} rad/s` if that is what you mean"),
                );
            }
            _ => {
                let help = match text.contains('\n') {
                    true => "multiply it by `2 * pi` if it counts revolutions, or write its unit as rev/s".into(),
                    false => format!(
                        "if it counts revolutions, write `2 * pi * {}`, or state its unit as rev/s",
                        factor_text(&text)
                    ),
                };
                self.report("a rate meets an angular velocity".into(), &labels, help);
            }
        }
    }

    /// A bare number where an angle is declared in degrees or revolutions.
    fn no_unit(&mut self, number: ExprId, value: f64, unit: &Unit, declared: Span) {
        self.found.push(turns::bare_angle((self.text(number), value, self.system.span(number)), unit, declared));
    }

    /// A frequency of a signal.
    fn frequency(&mut self, builtin: Builtin, name: &str, arg: ExprId) {
        if self.of(arg) == Counts::Speed {
            let message =
                format!("`{name}` of `{}` counts periods per second, this is an angle per second", builtin.name());
            self.speed_met(message, arg, None);
        }
    }

    /// An angle per second where a rate is meant.
    fn speed_met(&mut self, message: String, speed: ExprId, declared: Option<Span>) {
        let text = self.text(speed).to_string();
        let (label, help) = match self.system.node(speed) {
            Node::Number { value, .. } => {
                let number = three_digits(*value);
                (
                    format!("{number} Hz here"),
                    format!("write `{} Hz`, or `{number} Hz` if that is what you mean", three_digits(value / TAU)),
                )
            }
            _ => ("an angle per second".into(), format!("divide it: `{} / (2 * pi)`", factor_text(&text))),
        };
        let labels = std::iter::once((self.system.span(speed), label));
        let labels: Vec<_> =
            labels.chain(declared.map(|place| (place, "counts periods or revolutions".into()))).collect();
        self.report(message, &labels, help);
    }

    /// Whether it stands in an `expect`: closed forms have cosines of many radians.
    fn is_expected(&self, id: ExprId) -> bool {
        let span = self.system.span(id);
        let experiments = self.files.get(span.file).ast.items().filter_map(|item| match item {
            Item::Experiment(experiment) => Some(&experiment.body),
            _ => None,
        });
        experiments.flatten().any(|statement| match statement {
            ExperimentStatement::Expect(expect) => span.is_within(expect.span),
            _ => false,
        })
    }

    /// Reports an argument of `sin`, `cos` or `tan` that is not in rad.
    fn angle_of(&mut self, builtin: Builtin, arg: ExprId) {
        let (name, text) = (builtin.name(), self.text(arg).to_string());
        if let Some(number) = self.bare(arg).filter(|number| number.abs() > TAU && !self.is_expected(arg)) {
            self.report(
                format!("`{name}({text})` takes {text} rad, which is {}°", three_digits(number.to_degrees())),
                &[(self.system.span(arg), "an angle in rad".into())],
                format!("write `{name}({text} deg)` for degrees; `{name}({text} rad)` says that radians are meant"),
            );
        } else if self.of(arg) == Counts::Turns {
            self.report(
                format!("`{name}` takes an angle, this counts periods"),
                &[(self.system.span(arg), "a rate times a time".into())],
                format!("write `{name}(2 * pi * {})`", factor_text(&text)),
            );
        }
    }

    /// A product that converts what is in SI already.
    fn twice(&mut self, id: ExprId) {
        let product = self.product(id);
        let constant = product.constant.abs();
        let by_turn = near(constant, TAU) || near(constant, TAU / 60.0);
        if !by_turn && !near(constant, PI / 180.0) {
            return;
        }
        let Some((factor, counts)) = self.only(&product) else { return };
        let text = self.text(factor).to_string();
        let (si, what) = match counts {
            Counts::Speed if by_turn => ("rad/s", if near(constant, TAU) { "2 * pi" } else { "2 * pi / 60" }),
            Counts::Angle if !by_turn && product.factors.len() == 1 => ("rad", "pi / 180"),
            _ => return,
        };
        let declared = match self.unit(factor) {
            Some((unit, _)) if unit.scale != 1.0 => format!("shown in {unit}, and computed in {si}"),
            _ => format!("is in {si}"),
        };
        self.report(
            format!("`{text}` is in {si} already: the factor `{what}` comes twice"),
            &[(self.system.span(id), format!("converts to {si}")), (self.system.span(factor), declared)],
            format!("leave out `{what}`: units are converted where numbers are read and shown"),
        );
    }

    /// The value of something with a declared unit.
    fn given(&mut self, what: &str, unit: &Unit, declared: Option<Span>, value: ExprId) {
        let found = self.of(value);
        let wanted = counted(unit);
        let place = declared.unwrap_or(self.system.span(value));
        // A value in 1/s as such is judged only where it is written.
        let written = matches!(self.system.node(value), Node::Number { angle: Angle::Rate, .. });
        let named = match self.system.node(value) {
            Node::Var(var) => self.system.var(*var).unit.as_ref().is_some_and(|(unit, _)| unit.angle == Angle::Rate),
            _ => false,
        };
        match (wanted, found) {
            (Counts::Speed, Counts::Rate) => self.rate_met(value, place),
            (Counts::Speed, _) if written || named => self.rate_met(value, place),
            (Counts::Rate, Counts::Speed) => {
                self.speed_met(format!("{what} is in {unit}, this is an angle per second"), value, declared);
            }
            (Counts::Angle, Counts::Turns) => {
                let text = self.text(value).to_string();
                self.report(
                    format!("{what} is an angle, this counts revolutions"),
                    &[(self.system.span(value), "a rate times a time".into()), (place, format!("in {unit}"))],
                    format!("write `2 * pi * {}`", factor_text(&text)),
                );
            }
            (Counts::Angle, _) if scaled(unit) => {
                if let Some(number) = self.bare(value) {
                    return self.no_unit(value, number, unit, place);
                }
            }
            _ => {}
        }
        self.shown_twice(what, unit, place, value);
    }

    /// A conversion to the declared unit, in which the quantity is shown anyway.
    fn shown_twice(&mut self, what: &str, unit: &Unit, place: Span, value: ExprId) {
        let wanted = counted(unit);
        let (factor, si) = match wanted {
            Counts::Angle => (180.0 / PI, "rad"),
            Counts::Speed => (30.0 / PI, "rad/s"),
            Counts::Unknown | Counts::Turns | Counts::Rate => return,
        };
        if !matches!(self.system.node(value), Node::Binary(BinaryOp::Multiply | BinaryOp::Divide, ..)) {
            return;
        }
        let product = self.product(value);
        if !near(product.constant.abs(), factor) || product.factors.len() != 1 {
            return;
        }
        if let Some((inner, _)) = self.only(&product).filter(|(_, counts)| *counts == wanted) {
            let text = self.text(inner).to_string();
            self.report(
                format!("{what} is shown in {unit} without a factor"),
                &[
                    (self.system.span(value), format!("{} times too large", three_digits(factor))),
                    (place, format!("in {unit}")),
                ],
                format!("write `{text}` alone: values are in {si}, and are converted where they are shown"),
            );
        }
    }

    fn definition(&mut self, id: VarId) {
        let var = self.system.var(id);
        let Some(unit) = self.declared(id) else { return };
        // The number that states the unit of a declaration.
        let place = |value: ExprId| match &var.unit {
            Some((_, span)) => Some(*span),
            None if self.system.span(value) != var.span => Some(var.span),
            None => None,
        };
        let mut values: Vec<(ExprId, Option<Span>)> = Vec::new();
        match &var.definition {
            Definition::Missing | Definition::Free => {}
            Definition::Value(value, _) | Definition::Held { value, .. } => values.push((*value, place(*value))),
            Definition::Continuous { initial, rate, .. } => {
                values.push((*initial, place(*initial)));
                if counted(unit) == Counts::Angle && rate != initial && self.of(*rate) == Counts::Rate {
                    self.rate_met(*rate, var.span);
                }
            }
            Definition::Sampled { initial, next, .. } => {
                values.extend([(*initial, place(*initial)), (*next, place(*next))])
            }
        }
        values.extend([var.range.low, var.range.high].into_iter().flatten().map(|(bound, _)| (bound, place(bound))));
        for (value, place) in values {
            self.given(&format!("`{}`", var.name), unit, place, value);
        }
    }
}
