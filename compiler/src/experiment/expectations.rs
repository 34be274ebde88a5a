//! Expectations: measures over a run, formulas of them, and the unit in which each is shown.

use super::{PlanNumber, Reader, one_line};
use crate::codegen::elementary::ElementaryFunction;
use crate::frontend::system::*;
use crate::ir::Binary;
use abi::plan::{self, Formula, MeasureKind};
use abi::unit::Unit;
use grammar::ast::{self, BinaryOp, Expr};
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;
use std::sync::Arc;

/// Indices of an expectation's expressions among the observed ones.
#[derive(Clone, Copy)]
pub(super) struct ExpectAt {
    pub(super) value: usize,
    pub(super) near: Option<(usize, usize)>,
    pub(super) after: Option<usize>,
    pub(super) before: Option<usize>,
}

impl Reader<'_> {
    /// Display unit of a side of a comparison: that of its measure, otherwise SI.
    pub(super) fn side_unit(&self, id: ExprId) -> Unit {
        let boolean = self.types.boolean[id.0 as usize];
        let otherwise = || if boolean { Unit::none() } else { Unit::si(self.dimension(id)) };
        self.unit_of_measures(id).unwrap_or_else(otherwise)
    }

    /// The unit of a measure, of its multiples, and of sums of measures with the same unit.
    pub(super) fn unit_of_measures(&self, id: ExprId) -> Option<Unit> {
        let number =
            |id: &ExprId| matches!(self.system.node(*id), Node::Number { .. }) && self.dimension(*id).is_none();
        match self.system.node(id) {
            Node::Measure(name, value, ..) => Some(self.measure_unit(*name, id, *value)),
            Node::Negate(a) => self.unit_of_measures(*a),
            Node::Call(Builtin::Abs, args) => self.unit_of_measures(args[0]),
            Node::Binary(BinaryOp::Multiply, a, b) if number(a) => self.unit_of_measures(*b),
            Node::Binary(BinaryOp::Multiply | BinaryOp::Divide, a, b) if number(b) => self.unit_of_measures(*a),
            Node::Binary(BinaryOp::Add | BinaryOp::Subtract, a, b) => {
                self.unit_of_measures(*a).filter(|unit| self.unit_of_measures(*b).as_ref() == Some(unit))
            }
            _ => None,
        }
    }

    pub(super) fn show(&mut self, show: &ast::Show, expr: ExprId) -> usize {
        let unit = show.unit.as_ref().and_then(|text| self.unit_for(expr, text));
        self.want(expr, unit)
    }

    pub(super) fn expect(
        &mut self,
        expect: &ast::Expect,
        at: &ExpectAt,
        nodes: &[ExprId],
        duration: f64,
    ) -> Option<plan::Expect> {
        let text = self.loaded.files.slice(expect.span);
        let text = one_line(text.strip_prefix("expect").or(text.strip_prefix("show")).unwrap_or(text));
        let mut measures = Vec::new();
        let value = self.formula(nodes[at.value], &mut measures)?;
        let condition = match at.near {
            None if expect.shows.is_some() => {
                let unit = expect.shows.as_ref().and_then(Option::as_ref);
                let unit = match unit {
                    Some(text) => self.unit_for(nodes[at.value], text)?,
                    None => self.side_unit(nodes[at.value]),
                };
                Formula::Shown(unit, Box::new(value))
            }
            None => {
                if !self.types.boolean[nodes[at.value].0 as usize] {
                    let error = Diagnostic::error("E0901", "an expectation is a condition")
                        .label(self.system.span(nodes[at.value]), "neither true nor false");
                    let window = self.window_first(expect);
                    self.diagnostics.push(match window {
                        Some(help) => error.help(help),
                        None => error.help("compare it: `expect max(F) < 2 N`, `expect final(x) ~= 1 m +- 1 %`"),
                    });
                    return None;
                }
                value
            }
            Some((target, tolerance)) => {
                let (value_node, target_node, tolerance_node) = (nodes[at.value], nodes[target], nodes[tolerance]);
                let relative = self.loaded.files.slice(self.system.span(tolerance_node)).trim_end().ends_with('%');
                let any = |node: ExprId| matches!(self.system.node(node), Node::Number { dimension: None, .. });
                for (node, skip) in [(target_node, false), (tolerance_node, relative)] {
                    if !skip && !any(node) && self.dimension(node) != self.dimension(value_node) {
                        let (found, wanted) = (self.dimension(node), self.dimension(value_node));
                        let text = self.loaded.files.slice(self.system.span(node));
                        let error = match found.is_none() {
                            true => Diagnostic::error("E0103", format!("`{text}` needs a unit"))
                                .label(self.system.span(node), "a pure number")
                                .help(format!("write `{text} {}`", Unit::si(wanted))),
                            false => {
                                let message = format!("cannot compare {} with {}", wanted.describe(), found.describe());
                                Diagnostic::error("E0101", message)
                                    .label(self.system.span(node), Unit::si(found).to_string())
                                    .label(self.system.span(value_node), Unit::si(wanted).to_string())
                            }
                        };
                        self.diagnostics.push(error);
                        return None;
                    }
                }
                let target = self.formula(target_node, &mut measures)?;
                let tolerance = self.formula(tolerance_node, &mut measures)?;
                let (value, target, tolerance) = (Box::new(value), Box::new(target), Box::new(tolerance));
                self.shown_in(value_node, target_node, Formula::Near { value, target, tolerance, relative })
            }
        };
        let mut at = *at;
        // A window that begins or ends with an event belongs to each measure.
        for before in [false, true] {
            let end = if before { &mut at.before } else { &mut at.after };
            let Some(node) = end.map(|end| nodes[end]).filter(|node| self.measured(*node)) else { continue };
            *end = None;
            let place = if before { PlanNumber::Before(self.expect) } else { PlanNumber::After(self.expect) };
            let edge = self.edge(node, place)?;
            let event = one_line(self.loaded.files.slice(self.system.span(node)));
            for measure in &mut measures {
                let own = if before { &mut measure.window.before } else { &mut measure.window.after };
                if matches!(own, plan::Edge::Open) {
                    *own = edge;
                    // The same measure over the whole run is another number.
                    measure.text += &format!(" {} {event}", if before { "before" } else { "after" });
                }
            }
        }
        for (at, place) in [(at.after, PlanNumber::After(self.expect)), (at.before, PlanNumber::Before(self.expect))] {
            self.places.extend(at.map(|at| (place, nodes[at])));
        }
        let mut edge = |at: Option<usize>, default: f64| match at {
            Some(at) if self.constant(nodes[at]) == 0.0 => 0.0,
            Some(at) => self.time(nodes[at], "a window"),
            None => default,
        };
        let (after, before) = (edge(at.after, 0.0), edge(at.before, duration).min(duration));
        if after > before || (after == before && after > 0.0 && at.after.is_some() && after > duration) {
            let error = Diagnostic::error("E0902", "the window of this expectation is empty")
                .label(expect.span, format!("from {after} s to {before} s"))
                .help(format!("the run takes {duration} s"));
            self.diagnostics.push(error);
            return None;
        }
        Some(plan::Expect { text, measures, condition, after, before })
    }

    /// Suggestion for `expect max(x) after 5 s < 1 m`, where the window precedes the comparison: the corrected
    /// expectation.
    fn window_first(&mut self, expect: &ast::Expect) -> Option<String> {
        let compares =
            |op| matches!(op, BinaryOp::Less | BinaryOp::LessEqual | BinaryOp::Greater | BinaryOp::GreaterEqual);
        let compared = |edge: &&Expr| matches!(&edge.kind, ast::ExprKind::Binary(op, ..) if compares(*op));
        let (word, edge) = match (expect.after.as_ref().filter(compared), expect.before.as_ref().filter(compared)) {
            (Some(edge), _) => ("after", edge),
            (None, Some(edge)) => ("before", edge),
            (None, None) => return None,
        };
        let ast::ExprKind::Binary(op, _, time, limit) = &edge.kind else { return None };
        // The error about the comparison of a time is a consequence of the same mistake.
        let edge = edge.span;
        self.diagnostics.retain(|d| d.span().start < edge.start || d.span().end > edge.end);
        let [value, time, limit] = [expect.value.span, time.span, limit.span].map(|span| self.loaded.files.slice(span));
        Some(format!("the window comes after the comparison: `expect {value} {} {limit} {word} {time}`", op.text()))
    }

    /// Translates arithmetic over measures. The slot of a measure is the index of the measured expression among those
    /// requested.
    pub(super) fn formula(&mut self, id: ExprId, measures: &mut Vec<plan::Measure>) -> Option<Formula> {
        let node = self.system.node(id).clone();
        if !self.measured(id) {
            if self.types.boolean[id.0 as usize] {
                if let Node::Binary(op, a, b) = node
                    && !matches!(op, BinaryOp::And | BinaryOp::Or)
                {
                    let (a, b) = (self.formula(a, measures)?, self.formula(b, measures)?);
                    return Some(compare(op, a, b));
                }
                // A condition without a measure means its value at the end.
                return Some(self.measure(id, id, MeasureKind::Final, plan::Window::default(), measures));
            }
            if let Some(value) = self.system.literal(id) {
                return Some(Formula::Number(value));
            }
            if self.varies(id) {
                // Constant within a run, but not the same in all runs.
                return Some(self.measure(id, id, MeasureKind::Final, plan::Window::default(), measures));
            }
            let value = self.constant(id);
            if !value.is_nan() {
                return Some(Formula::Number(value));
            }
            // A chain of comparisons, for example, has been reported.
            let span = self.system.span(id);
            let meets = |other: Span| other.file == span.file && other.start < span.end && span.start < other.end;
            let mut reported = self.loaded.diagnostics.iter().filter(|d| d.is_error()).flat_map(|d| &d.labels);
            if reported.any(|label| meets(label.span)) {
                return None;
            }
            let text = one_line(self.loaded.files.slice(self.system.span(id)));
            let error = Diagnostic::error("E0901", format!("`{text}` changes during the run: which value is meant?"))
                .label(self.system.span(id), "not a measure")
                .help(format!("write `final({text})`, `max({text})`, `at({text}, 1 s)` or another measure"));
            self.diagnostics.push(error);
            return None;
        }
        let pair = |reader: &mut Self, a, b, measures: &mut Vec<plan::Measure>| {
            Some((Box::new(reader.formula(a, measures)?), Box::new(reader.formula(b, measures)?)))
        };
        match node {
            Node::Measure(name, value, second, window) => {
                let moment = match second {
                    Some(second) if self.measured(second) => Some(self.moment(second)?),
                    _ => None,
                };
                if let Some(second) = second.filter(|_| moment.is_none()) {
                    self.places.push((PlanNumber::Second(self.expect, measures.len()), second));
                }
                let second = second.map(|second| if moment.is_some() { f64::NAN } else { self.constant(second) });
                if second.is_some_and(f64::is_nan) && moment.is_none() {
                    return self.unknown_before(id);
                }
                let after =
                    window.after.map(|edge| self.edge(edge, PlanNumber::MeasureAfter(self.expect, measures.len())));
                let before =
                    window.before.map(|e| self.edge(e, PlanNumber::MeasureBefore(self.expect, measures.len())));
                let open = || Some(plan::Edge::Open);
                let window = plan::Window { after: after.unwrap_or_else(open)?, before: before.unwrap_or_else(open)? };
                if name == MeasureName::Time {
                    return match *self.system.node(value) {
                        Node::Measure(MeasureName::Peak, of, Some(number), inner) if inner == Window::default() => {
                            self.places.push((PlanNumber::Second(self.expect, measures.len()), number));
                            let kind = MeasureKind::TimeOfPeak(self.number_of_peak(number)?);
                            Some(self.measure(id, of, kind, window, measures))
                        }
                        Node::Measure(MeasureName::Max, of, None, inner) if inner == Window::default() => {
                            Some(self.measure(id, of, MeasureKind::TimeOfGreatest, window, measures))
                        }
                        Node::Measure(MeasureName::Min, of, None, inner) if inner == Window::default() => {
                            Some(self.measure(id, of, MeasureKind::TimeOfLeast, window, measures))
                        }
                        _ => {
                            let error = Diagnostic::error(
                                "E0901",
                                "`time` is of an extremum: `time(max(x))`, `time(min(x))`, `time(peak(x, 2))`",
                            )
                            .label(self.system.span(value), "happens at no one instant");
                            let help = "a window stands in `time` itself: `time(max(x) after 1 s)`; when a condition first holds is `first(x > 0)`";
                            self.diagnostics.push(error.help(help));
                            None
                        }
                    };
                }
                let kind = match name {
                    MeasureName::Min => MeasureKind::Min,
                    MeasureName::Max => MeasureKind::Max,
                    MeasureName::Mean => MeasureKind::Mean,
                    MeasureName::Rms => MeasureKind::Rms,
                    MeasureName::Integral => MeasureKind::Integral,
                    MeasureName::Final => MeasureKind::Final,
                    MeasureName::PeakToPeak => MeasureKind::PeakToPeak,
                    MeasureName::Crossings => MeasureKind::Crossings,
                    MeasureName::Period => MeasureKind::Period,
                    MeasureName::First => MeasureKind::First,
                    MeasureName::Rises => MeasureKind::Rises,
                    MeasureName::Turns => MeasureKind::Turns,
                    MeasureName::Time => unreachable!("it is of a measure"),
                    MeasureName::Count => MeasureKind::Count,
                    MeasureName::CountRises => MeasureKind::CountRises,
                    MeasureName::CountTurns => MeasureKind::CountTurns,
                    MeasureName::Duration => MeasureKind::Duration,
                    MeasureName::Peaks => MeasureKind::Peaks,
                    MeasureName::Peak if moment.is_some() => return self.unknown_before(id),
                    MeasureName::Peak => {
                        let Node::Measure(_, _, Some(number), _) = *self.system.node(id) else { unreachable!() };
                        MeasureKind::Peak(self.number_of_peak(number)?)
                    }
                    MeasureName::At if moment.is_some() => MeasureKind::AtMoment(moment?),
                    MeasureName::At => MeasureKind::At(second.expect("`at` has two arguments")),
                    MeasureName::Settling => MeasureKind::Settling(second.expect("`settling` has two arguments")),
                };
                if self.measured(value) {
                    let error = Diagnostic::error("E0901", "a measure of a measure")
                        .label(self.system.span(id), "the inner one is a single number already");
                    self.diagnostics.push(error);
                    return None;
                }
                Some(self.measure(id, value, kind, window, measures))
            }
            Node::Negate(a) => Some(Formula::Negate(Box::new(self.formula(a, measures)?))),
            Node::Not(a) => Some(Formula::Not(Box::new(self.formula(a, measures)?))),
            Node::Binary(op, left, right) => {
                let (a, b) = pair(self, left, right, measures)?;
                Some(match op {
                    BinaryOp::Add => Formula::Add(a, b),
                    BinaryOp::Subtract => Formula::Subtract(a, b),
                    BinaryOp::Multiply => Formula::Multiply(a, b),
                    BinaryOp::Divide => Formula::Divide(a, b),
                    BinaryOp::And => Formula::And(a, b),
                    BinaryOp::Or => Formula::Or(a, b),
                    BinaryOp::Power => {
                        let alone = ElementaryFunction::binary(Binary::Pow);
                        let at = Arc::new(move |x: f64, y: f64| alone.of_both(x, y));
                        Formula::Function(plan::Elementary { name: "^", at }, vec![*a, *b])
                    }
                    op => self.shown_in(left, right, compare(op, *a, *b)),
                })
            }
            Node::Call(Builtin::Abs, args) => Some(Formula::Abs(Box::new(self.formula(args[0], measures)?))),
            Node::Call(Builtin::Sqrt, args) => Some(Formula::Sqrt(Box::new(self.formula(args[0], measures)?))),
            Node::Call(Builtin::Unary(function), args) => {
                let alone = ElementaryFunction::unary(function);
                let function = plan::Elementary { name: function.name(), at: Arc::new(move |x, _| alone.at(x)) };
                Some(Formula::Function(function, vec![self.formula(args[0], measures)?]))
            }
            Node::Call(Builtin::Min, args) => pair(self, args[0], args[1], measures).map(|(a, b)| Formula::Min(a, b)),
            Node::Call(Builtin::Max, args) => pair(self, args[0], args[1], measures).map(|(a, b)| Formula::Max(a, b)),
            _ => {
                let error = Diagnostic::error("E0901", "this cannot be computed from measures")
                    .label(self.system.span(id), "not arithmetic")
                    .help("use + - * / ^ abs sqrt min max exp log sin cos tan and the like, and comparisons, around measures");
                self.diagnostics.push(error);
                None
            }
        }
    }

    fn measure(
        &mut self,
        whole: ExprId,
        value: ExprId,
        kind: MeasureKind,
        window: plan::Window,
        measures: &mut Vec<plan::Measure>,
    ) -> Formula {
        let text = one_line(self.loaded.files.slice(self.system.span(whole)));
        let unit = match self.system.node(whole) {
            Node::Measure(name, ..) => self.measure_unit(*name, whole, value),
            // A condition, measured at the end.
            _ => self.own_unit(value),
        };
        let at = self.want(value, None);
        measures.push(plan::Measure { text, kind, slot: abi::Slot(at as u32), unit, window });
        Formula::Measure(measures.len() - 1)
    }

    /// An instant that is known only during the run, for `at(x, …)`.
    fn moment(&mut self, id: ExprId) -> Option<plan::Moment> {
        let node = self.system.node(id).clone();
        let inner = match node {
            Node::Measure(MeasureName::Time, of, None, Window { after: None, before: None }) => {
                self.system.node(of).clone()
            }
            ref other => other.clone(),
        };
        let is_time = matches!(node, Node::Measure(MeasureName::Time, ..));
        match inner {
            Node::Measure(name, of, None, Window { after: None, before: None }) if !self.measured(of) => {
                let make = match (name, is_time) {
                    (MeasureName::First, false) => plan::Moment::First,
                    (MeasureName::Rises, false) => plan::Moment::Rises,
                    (MeasureName::Max, true) => plan::Moment::Greatest,
                    (MeasureName::Min, true) => plan::Moment::Least,
                    _ => return self.unknown_before(id),
                };
                Some(make(abi::Slot(self.want(of, None) as u32)))
            }
            _ => self.unknown_before(id),
        }
    }

    /// An end of a measure's window: a time, or the first instant of a condition.
    fn edge(&mut self, id: ExprId, place: PlanNumber) -> Option<plan::Edge> {
        match *self.system.node(id) {
            Node::Measure(MeasureName::First, of, None, Window { after: None, before: None }) if !self.measured(of) => {
                Some(plan::Edge::First(abi::Slot(self.want(of, None) as u32)))
            }
            _ if self.measured(id) => self.unknown_before(id),
            _ => {
                self.places.push((place, id));
                let time = if self.constant(id) == 0.0 { 0.0 } else { self.time(id, "a window") };
                Some(plan::Edge::At(time))
            }
        }
    }

    /// The index of a peak.
    fn number_of_peak(&mut self, id: ExprId) -> Option<f64> {
        let number = self.constant(id);
        if is_number_of_peak(number) {
            return Some(number);
        }
        let error = Diagnostic::error("E0901", "peaks have the numbers 1, 2, 3 and so on")
            .label(self.system.span(id), if number.is_nan() { "not constant".to_string() } else { format!("{number}") })
            .help("write `peak(x, 1)` for the first one; `peaks(x)` is how many there are");
        self.diagnostics.push(error);
        None
    }

    fn unknown_before<T>(&mut self, id: ExprId) -> Option<T> {
        let error = Diagnostic::error("E0901", "this instant or window is not known before the run")
            .label(self.system.span(id), "follows from the run");
        let help =
            "a time such as `1 s`, `first(v > 0)` or, in `at`, `time(max(x))` can stand here, each without a window";
        self.diagnostics.push(error.help(help));
        None
    }

    /// A comparison with its display unit: that of a quantity written on one side, else that of a measure that forms a
    /// whole side, else SI.
    fn shown_in(&self, left: ExprId, right: ExprId, comparison: Formula) -> Formula {
        let dimension = self.dimension(left);
        let written = |id: ExprId| {
            let text = self.loaded.files.slice(self.system.span(id));
            let unit = text.trim_start_matches(|c: char| c.is_ascii_digit() || "+-. ".contains(c));
            // `5e-4 m`: the rest of the exponent is not a unit; the unit follows the last blank.
            let unit = if unit.starts_with(['e', 'E']) { unit.rsplit(' ').next().unwrap_or(unit) } else { unit };
            let number = matches!(self.system.node(id), Node::Number { .. } | Node::Negate(_));
            Unit::parse(unit.trim()).ok().filter(|unit| number && !unit.text.is_empty() && unit.dimension == dimension)
        };
        let measure = |id: ExprId| self.unit_of_measures(id);
        let unit = written(right).or(written(left)).or(measure(left)).or(measure(right));
        let boolean = self.types.boolean[left.0 as usize];
        let unit = unit.unwrap_or_else(|| if boolean { Unit::none() } else { Unit::si(dimension) });
        Formula::In(unit, Box::new(comparison))
    }

    /// The display unit of a measure.
    pub(super) fn measure_unit(&self, name: MeasureName, whole: ExprId, value: ExprId) -> Unit {
        match name {
            // An integral of power is an energy; a torque has the same dimension.
            MeasureName::Integral if Unit::si(self.dimension(value)).text == "W" => {
                Unit::parse("J").expect("the joule is known")
            }
            MeasureName::Integral => Unit::si(self.dimension(whole)),
            MeasureName::Crossings
            | MeasureName::Count
            | MeasureName::CountRises
            | MeasureName::CountTurns
            | MeasureName::Peaks => Unit::none(),
            MeasureName::Duration
            | MeasureName::Period
            | MeasureName::Settling
            | MeasureName::First
            | MeasureName::Rises
            | MeasureName::Turns
            | MeasureName::Time => Unit::parse("s").expect("the second is known"),
            MeasureName::Min
            | MeasureName::Max
            | MeasureName::Mean
            | MeasureName::Rms
            | MeasureName::Final
            | MeasureName::At
            | MeasureName::Peak
            | MeasureName::PeakToPeak => self.own_unit(value),
        }
    }

    pub(super) fn measured(&self, id: ExprId) -> bool {
        let node = self.system.node(id);
        matches!(node, Node::Measure(..)) || node.operands().any(|operand| self.measured(operand))
    }
}

/// Whether the number is a valid index of a peak: 1, 2, 3, …
pub fn is_number_of_peak(number: f64) -> bool {
    number >= 1.0 && number.fract() == 0.0 && number < 1e9
}

fn compare(op: BinaryOp, a: Formula, b: Formula) -> Formula {
    let (a, b) = (Box::new(a), Box::new(b));
    match op {
        BinaryOp::Less => Formula::Less(a, b),
        BinaryOp::LessEqual => Formula::LessEqual(a, b),
        BinaryOp::Greater => Formula::Greater(a, b),
        BinaryOp::GreaterEqual => Formula::GreaterEqual(a, b),
        BinaryOp::NotEqual => Formula::Not(Box::new(equal(a, b))),
        _ => equal(a, b),
    }
}

fn equal(a: Box<Formula>, b: Box<Formula>) -> Formula {
    Formula::Near { value: a, target: b, tolerance: Box::new(Formula::Number(0.0)), relative: false }
}
