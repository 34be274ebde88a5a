//! Changes from outside: settings and statements of the command line, as syntax trees of a text of their own.

use super::{Change, Changes};
use crate::analysis::linearise::Ports;
use crate::frontend::flatten::{Override, OverrideValue};
use crate::frontend::resolve::Loaded;
use abi::plan::Method;
use grammar::ast::{self, ExperimentStatement, Expr};
use grammar::diagnostic::Diagnostic;
use grammar::span::FileId;

/// Additional statements of an experiment, each from a text of its own.
pub(super) fn also(
    loaded: &mut Loaded,
    texts: &[String],
    diagnostics: &mut Vec<Diagnostic>,
) -> Vec<ExperimentStatement> {
    let mut out = Vec::new();
    for text in texts {
        let id = loaded.add_text("--also", text);
        let (statements, errors) = grammar::parse::parse_statements(id, text);
        out.extend(statements);
        diagnostics.extend(errors);
    }
    out
}

/// The changes of the command line, parsed.
pub(super) struct CommandLine {
    pub(super) set: Vec<Set>,
    pub(super) method: Option<Method>,
    pub(super) step: Option<f64>,
    pub(super) tol: Option<f64>,
    pub(super) duration: Option<f64>,
    pub(super) vary: Vec<String>,
    pub(super) ports: Option<Ports>,
    pub(super) held: bool,
}

/// `PATH = VALUE`
pub(super) struct Set {
    pub(super) path: ast::Path,
    pub(super) expr: Option<Expr>,
    pub(super) instance: Option<ast::Instance>,
}

/// Changes of values from outside, parsed.
pub struct Overrides(Vec<Set>);

impl Overrides {
    /// The changes one by one.
    pub fn iter(&self) -> impl Iterator<Item = ChangeOf<'_>> {
        self.0.iter().map(|set| ChangeOf(CommandLine::change(set)))
    }
}

/// One change of [`Overrides`].
pub struct ChangeOf<'a>(Change<'a>);

impl<'a> ChangeOf<'a> {
    /// The change as an override for flattening. Names in its value are resolved in the scope of this file.
    pub fn override_in(&self, file: FileId) -> Override<'a> {
        self.0.in_file(file)
    }
}

/// Parses changes of values from outside.
pub fn overrides(loaded: &mut Loaded, changes: &Changes, diagnostics: &mut Vec<Diagnostic>) -> Overrides {
    Overrides(CommandLine::read(loaded, changes, diagnostics).set)
}

impl CommandLine {
    pub(super) fn read(loaded: &mut Loaded, changes: &Changes, diagnostics: &mut Vec<Diagnostic>) -> CommandLine {
        let mut set = Vec::new();
        for text in &changes.set {
            let id = loaded.add_text("--set", text);
            match text.split_once('=') {
                Some((path, value)) if looks_like_instance(value) => {
                    // Parsed with blanks in place of the path, so that spans remain correct.
                    let (found, errors) = grammar::parse::parse_path(id, path);
                    diagnostics.extend(errors);
                    let blanks = " ".repeat(path.len() + 1);
                    let (instance, errors) = grammar::parse::parse_instance(id, &format!("{blanks}{value}"));
                    diagnostics.extend(errors);
                    if let (Some(path), Some(instance)) = (found, instance) {
                        set.push(Set { path, expr: None, instance: Some(instance) });
                    }
                }
                _ => {
                    let (setting, errors) = grammar::parse::parse_setting(id, text);
                    diagnostics.extend(errors);
                    if let Some((path, expr)) = setting {
                        set.push(Set { path, expr: Some(expr), instance: None });
                    }
                }
            }
        }
        let Changes { method, step, tol, duration, vary, ports, held, .. } = changes.clone();
        CommandLine { set, method, step, tol, duration, vary, ports, held }
    }

    pub(super) fn change(set: &Set) -> Change<'_> {
        let value = match (&set.expr, &set.instance) {
            (_, Some(instance)) => OverrideValue::Instance(instance),
            (Some(expr), None) => OverrideValue::Expr(expr),
            (None, None) => unreachable!("a setting has a value"),
        };
        Change { path: &set.path, value }
    }
}

fn looks_like_instance(value: &str) -> bool {
    let value = value.trim_start().trim_start_matches("rotary ").trim_start();
    let name = value.trim_start_matches(|c: char| c.is_ascii_alphanumeric() || c == '_');
    value.starts_with(|c: char| c.is_ascii_uppercase()) && name.trim_start().starts_with('(')
}
