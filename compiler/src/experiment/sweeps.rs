//! Sweeps: the grid of each quantity, the combinations of all, and the cases that expectations name.

use super::command_line::CommandLine;
use super::{Change, MOST_VARIANTS, Statements, one_line};
use crate::codegen::elementary::ElementaryFunction;
use crate::frontend::flatten::OverrideValue;
use crate::frontend::literals::quantity;
use crate::frontend::resolve::Loaded;
use crate::ir::Binary;
use grammar::ast::{self, Expr, Spacing, SweepOver};
use grammar::diagnostic::Diagnostic;
use grammar::span::Span;

/// The values of each sweep over a grid, `first .. last by step`, as literals.
pub(super) fn grids(loaded: &Loaded, parts: &Statements, diagnostics: &mut Vec<Diagnostic>) -> Vec<Vec<Expr>> {
    let mut out = Vec::new();
    for sweep in &parts.sweeps {
        let mut values = Vec::new();
        if let SweepOver::Grid { first, last, spacing } = &sweep.over {
            match grid(first, last, spacing) {
                Ok((numbers, unit)) => {
                    let literal = |value: f64| Expr {
                        kind: ast::ExprKind::Number { value, unit: unit.clone() },
                        span: first.span,
                    };
                    values.extend(numbers.into_iter().map(literal));
                }
                Err((message, help)) => {
                    let text = loaded.files.slice(sweep.span).lines().next().unwrap_or_default();
                    diagnostics.push(Diagnostic::error("E0902", message).label(sweep.span, text).help(help));
                }
            }
        }
        out.push(values);
    }
    out
}

/// The numbers of a grid in the unit of its first value, and that unit.
///
/// # Errors
/// What is wrong with it, and how to write it.
type Grid = Result<(Vec<f64>, Option<ast::UnitText>), (&'static str, &'static str)>;

fn grid(first: &Expr, last: &Expr, spacing: &Spacing) -> Grid {
    const ENDS: (&str, &str) = (
        "a sweep goes from a number to a number by a positive step",
        "all three in units of one kind: `sweep fr.Fs = 1 N .. 2 N by 0.25 N`",
    );
    let (Some((a, unit, text)), Some((b, other, _))) = (quantity(first), quantity(last)) else { return Err(ENDS) };
    if unit.dimension != other.dimension {
        return Err(ENDS);
    }
    let (number, log) = match spacing {
        Spacing::By(step) => {
            let Some((h, third, _)) = quantity(step) else { return Err(ENDS) };
            if unit.dimension != third.dimension || h <= 0.0 {
                return Err(ENDS);
            }
            let count = ((b - a) / h + 1e-9).floor().clamp(-1.0, MOST_VARIANTS as f64) as i64;
            let value = |k: i64| rounded(unit.from_si(a + k as f64 * h));
            return Ok(((0..=count).map(value).collect(), text));
        }
        Spacing::Lin(number) => (number, false),
        Spacing::Log(number) => (number, true),
    };
    let count = quantity(number)
        .filter(|(n, unit, _)| unit.text.is_empty() && n.fract() == 0.0 && *n >= 2.0 && *n <= MOST_VARIANTS as f64);
    let Some((count, ..)) = count else {
        return Err(("the number of values is a whole number from 2 on", "write for example `1 N/s .. 50 N/s log 10`"));
    };
    if log && !(a * b > 0.0 && (b / a).is_finite()) {
        return Err((
            "a logarithmic grid has ends of one sign, and neither is 0",
            "write `lin` in place of `log`, or begin above 0",
        ));
    }
    let count = count as usize;
    Ok((spaced(count, a, b, log).into_iter().map(|value| rounded(unit.from_si(value))).collect(), text))
}

/// `count` numbers from `a` to `b`, both included: in equal ratios if `log`, else at equal distances.
pub fn spaced(count: usize, a: f64, b: f64, log: bool) -> Vec<f64> {
    let power = log.then(|| ElementaryFunction::binary(Binary::Pow));
    let value = |k: usize| {
        let part = k as f64 / (count.max(2) - 1) as f64;
        match (k, &power) {
            (0, _) => a,
            (k, _) if k + 1 == count => b,
            (_, Some(power)) => a * power.of_both(b / a, part),
            (_, None) => a + (b - a) * part,
        }
    };
    (0..count).map(value).collect()
}

/// A number rounded to twelve digits, which removes the rounding errors of `a + k·h`.
fn rounded(x: f64) -> f64 {
    format!("{x:.11e}").parse().unwrap_or(x)
}

/// All combinations of the sweeps, the last sweep varying fastest, each with the text of its value.
pub(super) fn combinations<'a>(
    parts: &Statements<'a>,
    grids: &'a [Vec<Expr>],
) -> Vec<Vec<(Change<'a>, Option<String>)>> {
    let mut out: Vec<Vec<(Change<'a>, Option<String>)>> = vec![Vec::new()];
    for (sweep, grid) in parts.sweeps.iter().zip(grids) {
        let path = &sweep.path;
        let values: Vec<(Change<'a>, Option<String>)> = match &sweep.over {
            SweepOver::Instances(all) => {
                all.iter().map(|one| (Change { path, value: OverrideValue::Instance(one) }, None)).collect()
            }
            SweepOver::Values(all) => {
                all.iter().map(|one| (Change { path, value: OverrideValue::Expr(one) }, None)).collect()
            }
            SweepOver::Grid { .. } => grid
                .iter()
                .map(|one| {
                    let text = match &one.kind {
                        ast::ExprKind::Number { value, unit: Some(unit) } => format!("{value} {}", unit.text),
                        ast::ExprKind::Number { value, unit: None } => format!("{value}"),
                        _ => unreachable!("a grid holds numbers"),
                    };
                    (Change { path, value: OverrideValue::Expr(one) }, Some(text))
                })
                .collect(),
        };
        if out.len().saturating_mul(values.len()) > MOST_VARIANTS {
            return vec![Vec::new(); MOST_VARIANTS + 1];
        }
        out = out
            .iter()
            .flat_map(|before| {
                values
                    .iter()
                    .map(|value| before.iter().cloned().chain([value.clone()]).collect::<Vec<_>>())
                    .collect::<Vec<_>>()
            })
            .collect();
    }
    out
}

pub(super) fn same_path(a: &ast::Path, b: &ast::Path) -> bool {
    a.segments.len() == b.segments.len() && is_part_of(a, b)
}

/// Whether a path begins with all segments of another one: `fr` and `fr.Fs` are part of `fr`.
pub(super) fn is_part_of(path: &ast::Path, of: &ast::Path) -> bool {
    let is_same = |(a, b): (&ast::Segment, &ast::Segment)| a.name.text == b.name.text && a.index == b.index;
    path.segments.len() >= of.segments.len() && path.segments.iter().zip(&of.segments).all(is_same)
}

/// Whether a value of a sweep is the one that a case names: the same number, or else the same text.
pub(super) fn meets(loaded: &Loaded, case: &ast::Case, value: OverrideValue) -> bool {
    let plain = |span: Span| loaded.files.slice(span).split_whitespace().collect::<String>();
    match (&case.value, value) {
        (ast::BindValue::Expr(wanted), OverrideValue::Expr(value)) => match (quantity(wanted), quantity(value)) {
            (Some((a, unit, _)), Some((b, other, _))) => {
                unit.dimension == other.dimension && (a - b).abs() <= 1e-9 * a.abs().max(b.abs())
            }
            _ => plain(wanted.span) == plain(value.span),
        },
        (ast::BindValue::Instance(wanted), OverrideValue::Instance(value)) => plain(wanted.span) == plain(value.span),
        (ast::BindValue::Expr(_), OverrideValue::Instance(_))
        | (ast::BindValue::Instance(_), OverrideValue::Expr(_)) => false,
    }
}

/// Errors about expectations for a case that no sweep has. A value that is set or varied from outside replaces the sweep,
/// and the expectation then applies to that value or to none.
pub(super) fn unmatched_cases(
    loaded: &Loaded,
    parts: &Statements,
    combinations: &[Vec<(Change, Option<String>)>],
    given: &CommandLine,
) -> Vec<Diagnostic> {
    let mut errors = Vec::new();
    for case in parts.expects.iter().flat_map(|expect| &expect.cases) {
        let text = loaded.files.slice(case.path.span);
        let outside = given.set.iter().any(|set| same_path(&set.path, &case.path))
            || given.vary.iter().any(|path| *path == text.split_whitespace().collect::<String>());
        if outside {
            continue;
        }
        let swept = || combinations.iter().flatten().filter(|(change, _)| same_path(change.path, &case.path));
        if swept().any(|(change, _)| meets(loaded, case, change.value)) {
            continue;
        }
        let mut values: Vec<String> = Vec::new();
        for (change, shown) in swept() {
            let value = shown.clone().unwrap_or_else(|| match change.value {
                OverrideValue::Expr(expr) => one_line(loaded.files.slice(expr.span)),
                OverrideValue::Instance(instance) => one_line(loaded.files.slice(instance.span)),
            });
            if !values.contains(&value) && values.len() < 12 {
                values.push(value);
            }
        }
        let (message, help) = match values.is_empty() {
            true => (
                format!("this experiment does not sweep `{text}`"),
                format!("`for` names a case of a sweep: add `sweep {text} = …`, or leave it out"),
            ),
            false => (
                format!("no case of the sweep is `{}`", one_line(loaded.files.slice(case.span))),
                format!("the sweep has {text} = {}", values.join(", ")),
            ),
        };
        errors.push(Diagnostic::error("E0902", message).label(case.span, "no such case").help(help));
    }
    errors
}

/// `fr = LuGre(), k = 2 N/m`; of a sweep over several quantities together `x.k, y.k = 2 N/m`.
pub(super) fn label(loaded: &Loaded, parts: &Statements, combination: &[(Change, Option<String>)]) -> String {
    let one = |(change, text): &(Change, Option<String>)| {
        let value = text.clone().unwrap_or_else(|| match change.value {
            OverrideValue::Expr(expr) => loaded.files.slice(expr.span).to_string(),
            OverrideValue::Instance(instance) => one_line(loaded.files.slice(instance.span)),
        });
        let sweep = parts.sweeps.iter().find(|sweep| std::ptr::eq(&sweep.path, change.path));
        let also = sweep.map_or(&[][..], |sweep| &sweep.also[..]);
        let paths = std::iter::once(change.path).chain(also).map(|path| loaded.files.slice(path.span));
        format!("{} = {value}", paths.collect::<Vec<_>>().join(", "))
    };
    combination.iter().map(one).collect::<Vec<_>>().join(", ")
}
