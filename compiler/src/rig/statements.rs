//! The statements of a rig by kind, and its numbers that must be known before the run.
//!
//! In: a rig's syntax tree. Out: [`Statements`] and [`Expressions`]. Knows nothing of values.

use crate::frontend::flatten::Scope;
use abi::unit::Unit;
use grammar::ast::{self, Expr, Name, RigStatement};
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;

/// The statements of a rig, by kind.
#[derive(Default)]
#[allow(missing_docs)]
pub struct Statements<'a> {
    pub run: Option<&'a ast::Run>,
    pub rate: Option<(&'a Expr, Span)>,
    pub solver: Option<&'a ast::Solver>,
    pub buses: Vec<&'a ast::BusDecl>,
    pub parts: Vec<&'a ast::Part>,
    pub hardware: Option<&'a ast::Hardware>,
    pub wires: Vec<&'a ast::Wire>,
    pub watchdog: Option<(&'a Expr, Span)>,
    pub overrun: Option<(Option<&'a Expr>, Span)>,
    pub predict: Option<(&'a Name, Span)>,
    pub safe: Vec<(&'a ast::Path, &'a Expr)>,
    pub stops: Vec<(&'a Expr, &'a str, Span)>,
    pub records: Vec<&'a ast::Show>,
    pub plots: Vec<&'a ast::Curves>,
    pub tunes: Vec<&'a ast::Tuned>,
    pub allows: Vec<&'a ast::Allow>,
}

impl<'a> Statements<'a> {
    /// Sorts the statements. Reports repeated and missing ones. Returns `None` if the rest would be meaningless.
    pub fn of(rig: &'a ast::Rig, misread: bool, diagnostics: &mut Vec<Diagnostic>) -> Option<Statements<'a>> {
        let mut out = Statements::default();
        let mut first: Vec<(&str, Span)> = Vec::new();
        let mut once = |what: &'static str, span: Span| match first.iter().find(|(known, _)| *known == what) {
            Some((_, before)) => {
                let error = Diagnostic::error("E0301", format!("a rig has one `{what}`"))
                    .label(span, "again here")
                    .label(*before, "first here");
                diagnostics.push(error.help("remove one of them"));
                false
            }
            None => {
                first.push((what, span));
                true
            }
        };
        for statement in &rig.body {
            match statement {
                RigStatement::Run(run) if once("run", run.span) => out.run = Some(run),
                RigStatement::Rate(expr, span) if once("rate", *span) => out.rate = Some((expr, *span)),
                RigStatement::Solver(solver) if once("solver", solver.span) => out.solver = Some(solver),
                RigStatement::Bus(bus) => out.buses.push(bus),
                RigStatement::Part(part) => out.parts.push(part),
                RigStatement::Hardware(part) if once("hardware", part.span) => out.hardware = Some(part),
                RigStatement::Wire(wire) => out.wires.push(wire),
                RigStatement::Watchdog(expr, span) if once("watchdog", *span) => out.watchdog = Some((expr, *span)),
                RigStatement::Overrun(count, span) if once("overrun", *span) => {
                    out.overrun = Some((count.as_ref(), *span));
                }
                RigStatement::Predict(drive, span) if once("predict", *span) => out.predict = Some((drive, *span)),
                RigStatement::Safe(values, _) => out.safe.extend(values.iter().map(|(path, value)| (path, value))),
                RigStatement::Stop { condition, why, span } => out.stops.push((condition, &why.text, *span)),
                RigStatement::Record(shows, _) => out.records.extend(shows),
                RigStatement::Plot(curves) => out.plots.push(curves),
                RigStatement::Tune(all, _) => out.tunes.extend(all),
                RigStatement::Allow(allow) => out.allows.push(allow),
                RigStatement::Run(_)
                | RigStatement::Rate(..)
                | RigStatement::Solver(_)
                | RigStatement::Hardware(_)
                | RigStatement::Watchdog(..)
                | RigStatement::Overrun(..)
                | RigStatement::Predict(..)
                | RigStatement::Drive(_) => {}
            }
        }
        let name = &rig.name.text;
        let missing = [
            (out.run.is_none(), format!("rig `{name}` runs nothing"), "add the system that it is: `run Servo(…)`"),
            (out.rate.is_none(), format!("nothing says how often `{name}` computes"), "add `rate 1 ms`"),
            (
                out.hardware.is_none(),
                format!("nothing of `{name}` is hardware"),
                "add `hardware PART { … }` with the part that the drives replace",
            ),
        ];
        for (missing, message, help) in missing {
            if missing && !misread {
                let error = Diagnostic::error("E0303", message).label(rig.name.span, "in this rig");
                diagnostics.push(error.help(help));
            }
        }
        (out.run.is_some() && out.rate.is_some() && out.hardware.is_some()).then_some(out)
    }
}

/// Expressions that are read in the scope of a rig.
#[derive(Default)]
pub struct Expressions<'a> {
    /// All expressions in the order of reading, with their scopes.
    pub all: Vec<(Scope, &'a Expr)>,
    /// Those that must be constant.
    pub constants: Vec<Constant>,
}

/// A number that must be known before the run.
pub struct Constant {
    /// Index of the expression.
    pub at: usize,
    /// Name for messages.
    pub name: String,
    /// Required unit, and the span that requires it.
    pub unit: Unit,
    /// See `unit`.
    pub span: Span,
}

impl<'a> Expressions<'a> {
    /// Adds an expression; returns its index.
    pub fn read(&mut self, scope: Scope, expr: &'a Expr) -> usize {
        self.all.push((scope, expr));
        self.all.len() - 1
    }

    /// Adds an expression that must be constant; returns its index among the constants.
    pub fn constant(&mut self, scope: Scope, expr: &'a Expr, name: &str, unit: Unit, span: Span) -> usize {
        let at = self.read(scope, expr);
        self.constants.push(Constant { at, name: name.into(), unit, span });
        self.constants.len() - 1
    }
}
