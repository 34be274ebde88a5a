//! Typesets equations in mathematical notation: `σ₀ z + σ₁ dz/dt` for `sigma0 * z + sigma1 * dz/dt`.
//!
//! In: the syntax tree of a model. Out: lines of text. The notation changes, not the expression: symbols, superscript
//! exponents, and bars for `abs`.

use grammar::ast::{
    BinaryOp, DeclarationKind, Equation, Every, EveryStatement, Expr, ExprKind, Mode, Model, Path, Reset, Statement,
    Target, UnaryOp,
};

/// The equations of a model, left and right side, in the order of the text. Each regime has a heading, with an empty
/// right side.
pub fn equations(model: &Model) -> Vec<(String, String)> {
    let mut lines = Vec::new();
    for statement in &model.body {
        match statement {
            Statement::Declaration(declaration) => {
                let value = declaration.value.as_ref();
                let computed = matches!(declaration.kind, DeclarationKind::Let | DeclarationKind::Output);
                if let Some(value) = value.filter(|_| computed) {
                    lines.push((symbol(&declaration.name.text), expression(value)));
                }
            }
            Statement::Equation(equation) => lines.push(sides(equation)),
            Statement::Part(part) => {
                let repeat = part.repeat.as_ref().map_or(String::new(), |repeat| {
                    format!(", {} = {} … {}", repeat.index.text, expression(&repeat.first), expression(&repeat.last))
                });
                lines.push((symbol(&part.name.text), format!("{}{repeat}", part.instance.model.text)));
            }
            Statement::Every(every) => sampled(every, &mut lines),
            Statement::Mode(mode) => {
                // Regimes with the same equations are one group, where the first of them stands.
                let same = together(model, mode);
                if same.first().is_none_or(|first| !std::ptr::eq(*first, mode)) {
                    continue;
                }
                let names: Vec<&str> = same.iter().map(|mode| mode.name.text.as_str()).collect();
                lines.push((format!("in {}:", names.join(", ")), String::new()));
                lines.extend(mode.equations.iter().map(sides));
                for mode in &same {
                    let from = if same.len() > 1 { format!("{} ", mode.name.text) } else { String::new() };
                    for go in &mode.transitions {
                        let resets = match &go.resets[..] {
                            [] => String::new(),
                            some => format!(", then {}", reset(some)),
                        };
                        let condition = expression(&go.condition);
                        lines.push((format!("{from}→ {}", go.target.text), format!("when {condition}{resets}")));
                    }
                }
            }
            Statement::When(when) => {
                lines.push((format!("when {}", expression(&when.condition)), reset(&when.resets)));
            }
            Statement::Require(_) | Statement::Storage(_) | Statement::Allow(_) => {}
        }
    }
    lines
}

/// The regimes of a model with the equations of this one, itself among them.
fn together<'a>(model: &'a Model, mode: &Mode) -> Vec<&'a Mode> {
    let written = |mode: &Mode| mode.equations.iter().map(sides).collect::<Vec<_>>();
    let own = written(mode);
    let modes = model.body.iter().filter_map(|statement| match statement {
        Statement::Mode(mode) => Some(mode),
        _ => None,
    });
    modes.filter(|other| written(other) == own).collect()
}

/// The resets of a transition: `slip := 0, Ea := left`.
fn reset(resets: &[Reset]) -> String {
    let one = |reset: &Reset| format!("{} := {}", symbol(&reset.name.text), expression(&reset.value));
    resets.iter().map(one).collect::<Vec<_>>().join(", ")
}

/// One line for each equation, aligned at the equals signs.
pub fn lines(equations: &[(String, String)]) -> String {
    let aligned =
        |(left, right): &&(String, String)| !(right.is_empty() || left.contains('→') || left.starts_with("when"));
    let width = equations.iter().filter(aligned).map(|(left, _)| left.chars().count()).max();
    let mut text = String::new();
    for (left, right) in equations {
        match (right.is_empty(), left.contains('→') || left.starts_with("when")) {
            (true, _) => text += &format!("{left}\n"),
            (false, true) => text += &format!("{left} {right}\n"),
            (false, false) => text += &format!("{left:width$} = {right}\n", width = width.unwrap_or(0).min(12)),
        }
    }
    text
}

fn sampled(every: &Every, lines: &mut Vec<(String, String)>) {
    lines.push((format!("every {}:", expression(&every.period)), String::new()));
    for statement in &every.body {
        match statement {
            EveryStatement::Declaration(declaration) => {
                if let Some(value) = &declaration.value {
                    lines.push((symbol(&declaration.name.text), expression(value)));
                }
            }
            EveryStatement::Equation(equation) => lines.push(sides(equation)),
        }
    }
}

fn sides(equation: &Equation) -> (String, String) {
    let left = match &equation.target {
        Target::Name(name) => symbol(&name.text),
        Target::Derivative { of, along, .. } => derivative(&of.text, &along.text),
        Target::Next { name, .. } => format!("{}⁺", symbol(&name.text)),
    };
    (left, expression(&equation.value))
}

fn derivative(of: &str, along: &str) -> String {
    format!("d{}/d{}", symbol(of), symbol(along))
}

/// Binding strength of an operator as it is printed; higher binds tighter.
fn tightness(expr: &Expr) -> u8 {
    match &expr.kind {
        ExprKind::If(..) => 0,
        ExprKind::Binary(op, ..) => op.binds(),
        // Like a product in print: a − (−b), a · (−b).
        ExprKind::Unary(UnaryOp::Negate, _) => BinaryOp::Multiply.binds(),
        ExprKind::Unary(UnaryOp::Not, _) => UnaryOp::Not.binds(),
        // `dz/dt` squared, or as a divisor, needs parentheses.
        ExprKind::Derivative { .. } => 6,
        ExprKind::Number { unit: Some(_), .. } => 6,
        ExprKind::Number { .. } | ExprKind::Path(_) | ExprKind::Call { .. } | ExprKind::Hole | ExprKind::Error => 9,
    }
}

/// An expression, in parentheses unless it binds at least as tightly as `least`.
fn inside(expr: &Expr, least: u8) -> String {
    let text = expression(expr);
    if tightness(expr) >= least { text } else { format!("({text})") }
}

/// An expression in symbols.
pub fn expression(expr: &Expr) -> String {
    match &expr.kind {
        ExprKind::Number { value, unit } => {
            let number = crate::quantity::significant(*value, 15);
            match unit {
                Some(unit) => format!("{number} {}", unit_text(&unit.text)),
                None => number,
            }
        }
        ExprKind::Path(path) => path_text(path),
        ExprKind::Derivative { of, along } => derivative(&of.text, &along.text),
        ExprKind::Call { function, args, .. } => {
            let shown: Vec<String> = args.iter().map(expression).collect();
            match (function.text.as_str(), shown.as_slice()) {
                ("abs", [x]) => format!("|{x}|"),
                ("sqrt", [x]) => match tightness(&args[0]) {
                    9 => format!("√{x}"),
                    _ => format!("√({x})"),
                },
                ("sign", [x]) => format!("sgn({x})"),
                (name, _) => format!("{name}({})", shown.join(", ")),
            }
        }
        ExprKind::Unary(UnaryOp::Negate, x) => format!("−{}", inside(x, 6)),
        ExprKind::Unary(UnaryOp::Not, x) => format!("not {}", inside(x, 4)),
        ExprKind::Binary(op, _, a, b) => binary(*op, a, b),
        ExprKind::If(condition, yes, no) => {
            format!("{} if {}, else {}", inside(yes, 1), expression(condition), expression(no))
        }
        ExprKind::Hole => "?".into(),
        ExprKind::Error => "…".into(),
    }
}

fn binary(op: BinaryOp, a: &Expr, b: &Expr) -> String {
    let joined = |sign: &str, left: u8, right: u8| format!("{}{sign}{}", inside(a, left), inside(b, right));
    match op {
        BinaryOp::Add => joined(" + ", 5, 5),
        BinaryOp::Subtract => joined(" − ", 5, 6),
        BinaryOp::Multiply => joined(" · ", 6, 7),
        BinaryOp::Divide => joined(" / ", 6, 7),
        BinaryOp::Power => match exponent(b) {
            Some(raised) => format!("{}{raised}", inside(a, 9)),
            None => format!("{}^{}", inside(a, 9), inside(b, 9)),
        },
        BinaryOp::Less => joined(" < ", 5, 5),
        BinaryOp::LessEqual => joined(" ≤ ", 5, 5),
        BinaryOp::Greater => joined(" > ", 5, 5),
        BinaryOp::GreaterEqual => joined(" ≥ ", 5, 5),
        BinaryOp::Equal => joined(" = ", 5, 5),
        BinaryOp::NotEqual => joined(" ≠ ", 5, 5),
        BinaryOp::And => joined(" and ", 2, 3),
        BinaryOp::Or => {
            // `and` binds tighter than `or`, but parentheses make that obvious.
            let side = |x: &Expr, least: u8| match &x.kind {
                ExprKind::Binary(BinaryOp::And, ..) => format!("({})", expression(x)),
                _ => inside(x, least),
            };
            format!("{} or {}", side(a, 1), side(b, 2))
        }
        BinaryOp::Crosses => joined(" crosses ", 5, 5),
        BinaryOp::Rises => joined(" rises through ", 5, 5),
        BinaryOp::Falls => joined(" falls through ", 5, 5),
    }
}

/// A whole number as superscript digits.
fn exponent(expr: &Expr) -> Option<String> {
    let raised = |value: f64| {
        (value.fract() == 0.0 && (0.0..100.0).contains(&value)).then(|| {
            value.to_string().chars().map(|c| digit(c, &['⁰', '¹', '²', '³', '⁴', '⁵', '⁶', '⁷', '⁸', '⁹'])).collect()
        })
    };
    match &expr.kind {
        ExprKind::Number { value, unit: None } => raised(*value),
        ExprKind::Unary(UnaryOp::Negate, x) => exponent(x).map(|digits: String| format!("⁻{digits}")),
        _ => None,
    }
}

fn digit(c: char, forms: &[char; 10]) -> char {
    c.to_digit(10).map_or(c, |digit| forms[digit as usize])
}

fn path_text(path: &Path) -> String {
    let segments: Vec<String> = path
        .segments
        .iter()
        .map(|segment| {
            let index = segment.index.map_or(String::new(), |index| format!("[{index}]"));
            format!("{}{index}", symbol(&segment.name.text))
        })
        .collect();
    match segments.as_slice() {
        [one] if one == "inf" => "∞".into(),
        segments => segments.join("."),
    }
}

/// A unit in mathematical notation.
fn unit_text(unit: &str) -> String {
    let mut text = String::new();
    let mut chars = unit.chars().peekable();
    while let Some(c) = chars.next() {
        match (c, chars.peek()) {
            ('^', Some('2')) => {
                chars.next();
                text.push('²');
            }
            ('^', Some('3')) => {
                chars.next();
                text.push('³');
            }
            ('u', Some('m' | 's' | 'r' | 'N')) => text.push('µ'),
            _ => text.push(c),
        }
    }
    text
}

/// A name as a symbol: Greek letters and subscript digits.
pub fn symbol(name: &str) -> String {
    const GREEK: [(&str, &str); 21] = [
        ("alpha", "α"),
        ("beta", "β"),
        ("gamma", "γ"),
        ("delta", "δ"),
        ("epsilon", "ε"),
        ("eps", "ε"),
        ("zeta", "ζ"),
        ("theta", "θ"),
        ("eta", "η"),
        ("kappa", "κ"),
        ("lambda", "λ"),
        ("mu", "μ"),
        ("nu", "ν"),
        ("xi", "ξ"),
        ("rho", "ρ"),
        ("sigma", "σ"),
        ("tau", "τ"),
        ("phi", "φ"),
        ("psi", "ψ"),
        ("omega", "ω"),
        ("pi", "π"),
    ];
    let (stem, digits) = name.split_at(name.trim_end_matches(|c: char| c.is_ascii_digit()).len());
    let (stem, tail) = stem.split_once('_').map_or((stem, String::new()), |(stem, tail)| (stem, format!("_{tail}")));
    let stem = GREEK.iter().find(|(word, _)| *word == stem).map_or(stem, |(_, letter)| letter);
    let lowered: String =
        digits.chars().map(|c| digit(c, &['₀', '₁', '₂', '₃', '₄', '₅', '₆', '₇', '₈', '₉'])).collect();
    format!("{stem}{tail}{lowered}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use grammar::span::FileId;

    #[test]
    fn expressions_look_like_the_paper() {
        let shown = |text: &str| expression(&grammar::parse::parse_expr(FileId(0), text).0);
        assert_eq!(shown("v - sigma0 * abs(v) / g * z"), "v − σ₀ · |v| / g · z");
        assert_eq!(shown("Fc + (Fs - Fc) * exp(-(v / vs)^2)"), "Fc + (Fs − Fc) · exp(−(v / vs)²)");
        assert_eq!(shown("a - (b - c)"), "a − (b − c)");
        assert_eq!(shown("a / (b * c)"), "a / (b · c)");
        assert_eq!(shown("if abs(v) < Dv then 0 else 10 um/s"), "0 if |v| < Dv, else 10 µm/s");
        assert_eq!(shown("(a + b)^-1 * 3 N·s^2/m^2"), "(a + b)⁻¹ · (3 N·s²/m²)");
        assert_eq!(shown("u > Fs and v >= 0 or v > vh"), "(u > Fs and v ≥ 0) or v > vh");
        assert_eq!(symbol("eps_f"), "ε_f");
        assert_eq!(symbol("Fc"), "Fc");
    }
}
