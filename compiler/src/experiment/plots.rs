//! Plots: curves and measures with their units, axes and windows, and the recording that they are drawn against.

use super::expectations::ExpectAt;
use super::{Reader, Statements, one_line};
use crate::frontend::system::*;
use abi::plan;
use abi::unit::Unit;
use grammar::ast;
use grammar::diagnostic::Diagnostic;

/// The same of a quantity of a plot.
pub(super) struct CurveAt {
    pub(super) value: usize,
    pub(super) range: Option<(usize, usize)>,
}

/// A plot whose quantities are indices of observed expressions.
pub(super) struct PlotAt {
    pub(super) series: Vec<usize>,
    pub(super) against: Option<usize>,
    pub(super) view: plan::View,
}

impl Reader<'_> {
    /// Tells that a run reads a recording outside of its times, where it is held.
    pub(super) fn recording_ends(
        &mut self,
        parts: &Statements,
        data: &[(String, Table, Unit)],
        duration: f64,
        told: &[Diagnostic],
    ) {
        let (Some(statement), Some((_, table, _))) = (parts.data, data.first()) else { return };
        let (Some(&from), Some(&to)) = (table.x.first(), table.x.last()) else { return };
        // A grid of decimals may end a rounding error before the duration.
        let ends = to < duration * (1.0 - 1e-9);
        if parts.allowed.contains(&"recording-ends") || !(ends || from > 0.0) {
            return;
        }
        let time = |t: f64| format!("{} s", abi::format::three_digits(t));
        let (message, label) = match (from > 0.0, ends) {
            (false, _) => ("the recording ends before the run".to_string(), format!("ends at {}", time(to))),
            (true, false) => ("the recording begins after the run".to_string(), format!("begins at {}", time(from))),
            (true, true) => {
                ("the recording covers only a part of the run".to_string(), format!("{} to {}", time(from), time(to)))
            }
        };
        let label = format!("{label}; outside, its first and last rows are held");
        let warning = Diagnostic::warning("W0901", message)
            .label(statement.file.span, label)
            .label(parts.run.span, format!("from 0 s to {}", time(duration)));
        let help = match from > 0.0 {
            true => "subtract the first time from `t` in the file, or `allow recording-ends \"…\"`".to_string(),
            false => format!("run `for {}`, or leave `for` out: then the run ends with the recording", time(to)),
        };
        // The cases of a sweep read the same recording.
        if !told.iter().any(|one| one.code == warning.code && one.span() == warning.span()) {
            self.diagnostics.push(warning.help(help));
        }
    }

    /// Reads a plot; `across` a parameter, its measures become shown expectations.
    pub(super) fn plot(
        &mut self,
        plot: &ast::Plot,
        (curves, against): (&[CurveAt], Option<&CurveAt>),
        window: (Option<usize>, Option<usize>),
        nodes: &[ExprId],
        duration: f64,
        expects: &mut Vec<Option<plan::Expect>>,
    ) -> Option<PlotAt> {
        let mut time = |at: Option<usize>| match at {
            Some(at) if self.constant(nodes[at]) == 0.0 => Some(0.0),
            at => at.map(|at| self.time(nodes[at], "a window")),
        };
        let (after, before) = (time(window.0), time(window.1));
        let (from, to) = (after.unwrap_or(0.0), before.unwrap_or(duration).min(duration));
        if from >= to && (after.is_some() || before.is_some()) {
            let error = Diagnostic::error("E0902", "the window of this plot is empty")
                .label(plot.span, format!("from {from} s to {to} s"));
            self.diagnostics.push(error.help(format!("the run takes {duration} s")));
            return None;
        }
        let looks = plot.curves.iter().zip(curves).map(|(curve, at)| self.look(curve, at, nodes)).collect();
        let x = plot.against.as_ref().zip(against).map(|(curve, at)| self.look(curve, at, nodes)).unwrap_or_default();
        let title = plot.title.as_ref().map(|title| title.text.clone());
        let mut view = plan::View { title, after, before, looks, x, across: None };
        let measures = curves.iter().filter(|at| self.measured(nodes[at.value])).count();
        if measures == 0 {
            let series = plot.curves.iter().zip(curves);
            let series = series.map(|(curve, at)| self.show(&curve.show, nodes[at.value])).collect();
            let against = plot.against.as_ref().zip(against);
            let against = against.map(|(curve, at)| self.show(&curve.show, nodes[at.value]));
            return Some(PlotAt { series, against, view });
        }
        let measured = curves.iter().find(|at| self.measured(nodes[at.value]));
        let span = self.system.span(nodes[measured.expect("there is one").value]);
        let Some((parameter, at)) = plot.against.as_ref().zip(against) else {
            let error = Diagnostic::error("E0901", "a measure is one number for the whole run")
                .label(span, "plotted over time");
            let help = "test it with `expect`, or plot it against what a `sweep` varies: `plot max(F) against vp`";
            self.diagnostics.push(error.help(help));
            return None;
        };
        if measures < curves.len() {
            let other = curves.iter().find(|at| !self.measured(nodes[at.value])).expect("there is one");
            let error = Diagnostic::error("E0901", "a plot shows measures or quantities, not both")
                .label(span, "one number for the whole run")
                .label(self.system.span(nodes[other.value]), "a number at each time");
            self.diagnostics.push(error.help("write two `plot`s"));
            return None;
        }
        let value = self.constant(nodes[at.value]);
        if !value.is_finite() || self.measured(nodes[at.value]) {
            let error = Diagnostic::error("E0901", "a measure is plotted against a parameter")
                .label(self.system.span(nodes[at.value]), "not one number that is known before the run");
            self.diagnostics.push(error.help("`sweep` a parameter, and write its path here"));
            return None;
        }
        let unit = parameter.show.unit.as_ref().and_then(|text| self.unit_for(nodes[at.value], text));
        let unit = unit.unwrap_or_else(|| self.own_unit(nodes[at.value]));
        let label = one_line(self.loaded.files.slice(parameter.show.value.span));
        let mut across = plan::Across { measures: Vec::new(), label, value, unit };
        for (curve, at) in plot.curves.iter().zip(curves) {
            let shown = ast::Expect {
                value: curve.show.value.clone(),
                near: None,
                shows: Some(curve.show.unit.clone()),
                after: plot.after.clone(),
                before: plot.before.clone(),
                cases: Vec::new(),
                span: curve.show.span,
            };
            let at = ExpectAt { value: at.value, near: None, after: window.0, before: window.1 };
            self.expect = expects.len();
            let expect = self.expect(&shown, &at, nodes, duration);
            across.measures.push(expects.len());
            expects.push(expect);
        }
        view.across = Some(across);
        Some(PlotAt { series: Vec::new(), against: None, view })
    }

    /// How a quantity of a plot looks.
    fn look(&mut self, curve: &ast::Curve, at: &CurveAt, nodes: &[ExprId]) -> plan::Look {
        let node = nodes[at.value];
        let range = at.range.and_then(|(from, to)| self.axis_range(node, curve.log, nodes[from], nodes[to]));
        plan::Look {
            label: curve.label.as_ref().map(|label| label.text.clone()),
            range,
            logarithmic: curve.log,
            recorded: self.is_recorded(node) == Some(true),
        }
    }

    /// The ends of an axis, in SI; 0 fits every unit.
    fn axis_range(&mut self, of: ExprId, log: bool, from: ExprId, to: ExprId) -> Option<(f64, f64)> {
        let wanted = self.dimension(of);
        for end in [from, to] {
            let (found, value, span) = (self.dimension(end), self.constant(end), self.system.span(end));
            let text = self.loaded.files.slice(span);
            let error = if !value.is_finite() {
                Diagnostic::error("E0902", "the ends of an axis are known before the run").label(span, "not constant")
            } else if found == wanted || value == 0.0 {
                continue;
            } else if found.is_none() {
                Diagnostic::error("E0103", format!("`{text}` needs a unit"))
                    .label(span, "a pure number")
                    .help(format!("write `{text} {}`", Unit::si(wanted)))
            } else {
                let message = format!("an axis of {} does not end at {}", wanted.describe(), found.describe());
                Diagnostic::error("E0101", message)
                    .label(span, Unit::si(found).to_string())
                    .label(self.system.span(of), Unit::si(wanted).to_string())
            };
            self.diagnostics.push(error);
            return None;
        }
        let (low, high) = (self.constant(from), self.constant(to));
        let problem = match (low < high, log && low <= 0.0) {
            (false, _) => "an axis goes from its lower to its upper end",
            (true, true) => "a logarithmic axis begins above 0",
            (true, false) => return Some((low, high)),
        };
        let label = format!("from {low} to {high} in SI");
        self.diagnostics.push(Diagnostic::error("E0902", problem).label(self.system.span(from), label));
        None
    }

    /// Whether an expression reads a recording; `None` if it reads a quantity of the model.
    pub(super) fn is_recorded(&self, id: ExprId) -> Option<bool> {
        match self.system.node(id) {
            Node::Var(_) | Node::Rate(_) | Node::InRegime(..) => None,
            Node::Table(table, at) if matches!(self.system.node(*at), Node::Time) => {
                Some(self.system.tables[*table as usize].is_recorded())
            }
            node => node.operands().try_fold(false, |any, operand| Some(any | self.is_recorded(operand)?)),
        }
    }
}
