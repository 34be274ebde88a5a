//! Tables and equations of studies as LaTeX, for a paper.
//!
//! In: one or more [`Study`] values. Out: text to `\input`; it needs the packages amsmath, amssymb and booktabs, and
//! textcomp before LaTeX of 2020.

use super::page::scale_rows;
use super::phenomena::Seen;
use super::study::Study;
use super::subject::Subject;
use crate::quantity::show;
use abi::unit::Unit;
use std::fmt::Write;

/// Equations and parameters of each model, and the phenomena and scales of all.
pub fn tables(studies: &[Study]) -> String {
    let mut out = format!(
        "% Written by fric {}. Needs \\usepackage{{amsmath, amssymb, booktabs}}, and textcomp before LaTeX of 2020.\n\n",
        env!("CARGO_PKG_VERSION")
    );
    if let Some(bench) = studies.iter().find_map(|study| study.bench.as_ref()) {
        let _ = writeln!(out, "% {bench}\n");
    }
    studies.iter().for_each(|study| out += &model(&study.label, &study.subject));
    let columns = "l".repeat(studies.len() + 1);
    let heads: String = studies.iter().map(|study| format!(" & {}", text(&study.label))).collect();
    let _ = write!(out, "% phenomena\n\\begin{{tabular}}{{{columns}}}\n\\toprule\nphenomenon{heads} \\\\\n\\midrule\n");
    for (row, finding) in studies.first().map_or(&[][..], |study| &study.findings).iter().enumerate() {
        out += &text(finding.name);
        for study in studies {
            out += match study.findings.get(row).map(|finding| finding.seen) {
                Some(Seen::Shown) => " & $\\checkmark$",
                Some(Seen::NotShown) => " & $\\times$",
                Some(Seen::NotRun) => " & ?",
                Some(Seen::NotProven) => " & $\\circ$",
                Some(Seen::NotApplicable) | None => " & --",
            };
        }
        out += " \\\\\n";
    }
    out += "\\bottomrule\n\\end{tabular}\n\n";
    let _ = write!(out, "% scales\n\\begin{{tabular}}{{{columns}}}\n\\toprule\nscale{heads} \\\\\n\\midrule\n");
    for k in 0..studies.first().map_or(0, |study| scale_rows(study).len()) {
        out += &text(scale_rows(&studies[0])[k].0);
        studies.iter().for_each(|study| out += &format!(" & {}", quantity(&scale_rows(study)[k].1)));
        out += " \\\\\n";
    }
    out + "\\bottomrule\n\\end{tabular}\n"
}

/// Equations and parameters of a model.
pub fn model(label: &str, subject: &Subject) -> String {
    let label = label.replace('\n', " ");
    let mut out = format!("% {label}: equations\n{}\n", equations(&subject.equations));
    if !subject.params.is_empty() {
        let _ = writeln!(out, "% {label}: parameters");
        out += "\\begin{tabular}{lll}\n\\toprule\nparameter & value & meaning \\\\\n\\midrule\n";
        for param in &subject.params {
            let value = if param.value == f64::INFINITY { "∞".into() } else { show(param.value, &param.unit, 6) };
            let name = param.path.split('.').map(crate::equations::symbol).collect::<Vec<_>>().join(".");
            let doc = param.doc.as_deref().unwrap_or_default();
            let _ = writeln!(out, "${}$ & {} & {} \\\\", math(&name), quantity(&value), text(doc.trim()));
        }
        out += "\\bottomrule\n\\end{tabular}\n\n";
    }
    out
}

/// Equations as `align*`; a heading such as `in stick:` is text.
fn equations(equations: &[(String, String)]) -> String {
    if equations.is_empty() {
        return String::new();
    }
    let line = |(left, right): &(String, String)| match (right.is_empty(), left.contains('→') || left.contains("when "))
    {
        (true, _) => format!("  & \\text{{{}}}", text(left)),
        (false, true) => format!("  & {} \\quad {}", math(left), math(right)),
        (false, false) => format!("  {} &= {}", math(left), math(right)),
    };
    let lines: Vec<String> =
        equations.iter().filter(|(left, right)| !(left.is_empty() && right.is_empty())).map(line).collect();
    format!("\\begin{{align*}}\n{}\n\\end{{align*}}\n", lines.join(" \\\\\n"))
}

/// Number and unit: `1.5 N·s/m` as `1.5\,\mathrm{N\cdot s/m}`.
fn quantity(shown: &str) -> String {
    match shown.trim() {
        "∞" => "$\\infty$".into(),
        shown => match measured(&shown.replace('−', "-")) {
            Some((tex, "")) => format!("${tex}$"),
            Some(_) | None => text(shown),
        },
    }
}

/// A number at the begin of a text with the unit after it, if it has one, and the rest of the text.
fn measured(formula: &str) -> Option<(String, &str)> {
    let sign = usize::from(formula.starts_with('-'));
    let digits = |from: usize| formula[from..].find(|c: char| !c.is_ascii_digit()).map_or(formula.len(), |n| from + n);
    let mut end = digits(sign);
    if end == sign {
        return None;
    }
    if formula[end..].starts_with('.') && digits(end + 1) > end + 1 {
        end = digits(end + 1);
    }
    let mantissa = &formula[..end];
    // The exponent of `1.5e-7`; an `e` before anything else belongs to a name.
    let power = formula[end..].strip_prefix('e').and_then(|rest| {
        let from = formula.len() - rest.len();
        let from = from + usize::from(rest.starts_with(['-', '+']));
        let to = digits(from);
        (to > from).then(|| (formula[end + 1..to].trim_start_matches('+'), to))
    });
    let number = match power {
        Some((power, to)) => {
            end = to;
            let factor = format!("10^{{{power}}}");
            match mantissa {
                "1" => factor,
                "-1" => format!("-{factor}"),
                _ => format!("{mantissa} \\cdot {factor}"),
            }
        }
        None => mantissa.to_string(),
    };
    let Some(rest) = formula[end..].strip_prefix(' ') else { return Some((number, &formula[end..])) };
    let in_unit = |(at, c): &(usize, char)| {
        c.is_alphanumeric() || "·*/^%°⁻".contains(*c) || *c == '-' && rest[..*at].ends_with('^')
    };
    let unit = rest.char_indices().find(|at| !in_unit(at)).map_or(rest, |(at, _)| &rest[..at]);
    match Unit::parse(&plain_unit(unit)) {
        Ok(_) if !unit.is_empty() && unit != "1" => {
            Some((format!("{number}\\,{}", upright(unit)), &rest[unit.len()..]))
        }
        _ => Some((number, &formula[end..])),
    }
}

/// Superscript digits of a unit as the language writes them: `m²` as `m^2`.
fn plain_unit(unit: &str) -> String {
    let mut out = String::new();
    for c in unit.chars() {
        let digit = if c == '⁻' { Some('-') } else { raised(c) };
        if digit.is_some() && !out.ends_with(|c: char| c == '^' || c == '-' || c.is_ascii_digit() && out.contains('^'))
        {
            out.push('^');
        }
        out.push(digit.unwrap_or(c));
    }
    out
}

/// The digit of a superscript digit.
fn raised(c: char) -> Option<char> {
    const RAISED: &str = "⁰¹²³⁴⁵⁶⁷⁸⁹";
    RAISED.chars().zip('0'..='9').find(|(raised, _)| *raised == c).map(|(_, digit)| digit)
}

/// A unit in upright letters: `N·s²/m` as `\mathrm{N\cdot s^{2}/m}`. The letter µ of formulas is italic in every font; that
/// of text is not.
fn upright(unit: &str) -> String {
    let mut out = String::new();
    let mut chars = unit.chars().peekable();
    while let Some(c) = chars.next() {
        match c {
            '·' | '*' => out += "\\cdot ",
            'µ' | 'μ' => out += "\\text{\\textmu}",
            'Ω' => out += "\\Omega ",
            '°' => out += "{}^{\\circ}",
            '%' => out += "\\%",
            '^' | '⁻' | '⁰'..='⁹' | '¹' | '²' | '³' => {
                let mut power: String = if c == '^' { String::new() } else { plain_unit(&c.to_string())[1..].into() };
                while let Some(digit) = chars.peek().and_then(|c| match c {
                    '-' | '⁻' => Some('-'),
                    c => raised(*c).or(Some(*c).filter(char::is_ascii_digit)),
                }) {
                    power.push(digit);
                    chars.next();
                }
                let _ = write!(out, "^{{{power}}}");
            }
            c => out.push(c),
        }
    }
    format!("\\mathrm{{{}}}", out.trim_end())
}

/// Characters that have a command of their own in formulas.
fn letter(c: char) -> Option<String> {
    const COMMANDS: [(char, &str); 42] = [
        ('α', "\\alpha "),
        ('β', "\\beta "),
        ('γ', "\\gamma "),
        ('δ', "\\delta "),
        ('ε', "\\varepsilon "),
        ('ζ', "\\zeta "),
        ('η', "\\eta "),
        ('θ', "\\theta "),
        ('κ', "\\kappa "),
        ('λ', "\\lambda "),
        ('μ', "\\mu "),
        ('µ', "\\mu "),
        ('ν', "\\nu "),
        ('ξ', "\\xi "),
        ('ρ', "\\rho "),
        ('σ', "\\sigma "),
        ('τ', "\\tau "),
        ('φ', "\\varphi "),
        ('ψ', "\\psi "),
        ('ω', "\\omega "),
        ('π', "\\pi "),
        ('·', "\\cdot "),
        ('−', "-"),
        ('≤', "\\le "),
        ('≥', "\\ge "),
        ('≠', "\\ne "),
        ('∞', "\\infty "),
        ('→', "\\to "),
        ('…', "\\dots "),
        ('√', "\\surd "),
        ('°', "^\\circ "),
        ('Ω', "\\Omega "),
        ('%', "\\%"),
        ('&', "\\&"),
        ('#', "\\#"),
        ('$', "\\$"),
        ('{', "\\{"),
        ('}', "\\}"),
        ('~', "\\sim "),
        ('^', "\\hat{}"),
        ('\\', "\\backslash "),
        ('|', "\\vert "),
    ];
    const RAISED: &str = "⁰¹²³⁴⁵⁶⁷⁸⁹";
    const LOWERED: &str = "₀₁₂₃₄₅₆₇₈₉";
    if c == '⁻' {
        return Some("^{-}".into());
    }
    if let Some(digit) = LOWERED.chars().position(|low| low == c) {
        return Some(format!("_{{{digit}}}"));
    }
    if let Some(digit) = RAISED.chars().position(|raised| raised == c) {
        return Some(format!("^{{{digit}}}"));
    }
    COMMANDS.iter().find(|(known, _)| *known == c).map(|(_, command)| (*command).into())
}

/// A formula in the symbols of print as LaTeX: names of several letters upright, tails as subscripts.
fn math(formula: &str) -> String {
    const FUNCTIONS: [&str; 12] =
        ["exp", "sin", "cos", "tan", "sinh", "cosh", "tanh", "min", "max", "log", "arctan", "arcsin"];
    const WORDS: [&str; 10] = ["if", "else", "and", "or", "not", "when", "then", "crosses", "rises", "falls"];
    const LOWERED: &str = "₀₁₂₃₄₅₆₇₈₉";
    let chars: Vec<char> = formula.chars().collect();
    let mut out = String::new();
    let mut at = 0;
    while at < chars.len() {
        let c = chars[at];
        if c.is_ascii_digit() {
            let rest: String = chars[at..].iter().collect();
            if let Some((tex, after)) = measured(&rest) {
                at += rest.chars().count() - after.chars().count();
                out += &tex;
                continue;
            }
        }
        if !(c.is_alphabetic()) {
            // An exponent of several digits is one group: 10⁻¹² is 10^{-12}.
            let mut raised = String::new();
            while at < chars.len()
                && let Some(command) = letter(chars[at]).filter(|command| command.starts_with("^{"))
            {
                raised += command.trim_start_matches("^{").trim_end_matches('}');
                at += 1;
            }
            if raised.is_empty() {
                out += &letter(c).unwrap_or_else(|| c.to_string());
                at += 1;
            } else {
                let _ = write!(out, "^{{{raised}}}");
            }
            continue;
        }
        let end = (at..chars.len()).find(|k| !(chars[*k].is_alphanumeric() || chars[*k] == '_')).unwrap_or(chars.len());
        // Digits of a subscript count as alphanumeric.
        let name: String = chars[at..end].iter().collect();
        at = end;
        if FUNCTIONS.contains(&name.as_str()) {
            let _ = write!(out, "\\{name}");
            continue;
        }
        if WORDS.contains(&name.as_str()) {
            let _ = write!(out, "\\text{{ {name} }}");
            continue;
        }
        // Functions of the language, and parts.
        if chars.get(at) == Some(&'(') {
            let upright: String = name
                .chars()
                .map(|c| match LOWERED.chars().position(|low| low == c) {
                    Some(digit) => digit.to_string(),
                    None if c == '_' => "\\_".into(),
                    None => letter(c).unwrap_or_else(|| c.to_string()),
                })
                .collect();
            let _ = write!(out, "\\operatorname{{{}}}", upright.trim_end());
            continue;
        }
        let is_part = matches!(chars.get(at), Some('.' | '['));
        let lowered: String = name
            .chars()
            .filter_map(|c| LOWERED.chars().position(|low| low == c))
            .map(|digit| digit.to_string())
            .collect();
        let plain: String = name.chars().filter(|c| !LOWERED.contains(*c)).collect();
        let (stem, tail) = plain.split_once('_').unwrap_or((&plain, ""));
        // `dz` of a derivative, a symbol of one letter with a letter or digit behind it, a word.
        let split = |stem: &str| {
            let mut letters = stem.chars();
            let first: String = letters.next().map(|c| letter(c).unwrap_or_else(|| c.to_string())).unwrap_or_default();
            (first.trim_end().to_string(), letters.collect::<String>())
        };
        let (first, rest) = split(stem);
        let followed = chars.get(at) == Some(&'/') || out.ends_with('/');
        if first == "d" && !rest.is_empty() && followed {
            let _ = write!(out, "\\mathrm{{d}}{}", math(&name[1..]));
            continue;
        }
        // Letters behind the first one, in words or subscripts.
        let ascii =
            |part: &str| -> String { part.chars().map(|c| letter(c).unwrap_or_else(|| c.to_string())).collect() };
        let (head, low) = match rest.chars().count() {
            0 => (first, String::new()),
            1..=2 if !is_part => (first, rest),
            _ => (format!("\\mathrm{{{}}}", ascii(stem)), String::new()),
        };
        let (head, low, tail) = (head, ascii(&low), ascii(&tail.replace('_', ",")));
        let parts: Vec<&str> =
            [low.as_str(), tail.as_str(), lowered.as_str()].into_iter().filter(|p| !p.is_empty()).collect();
        out += &head;
        if !parts.is_empty() {
            let _ = write!(out, "_{{\\mathrm{{{}}}}}", parts.join(","));
        }
        // A command must not run into a following letter.
        if parts.is_empty() && head.starts_with('\\') && head.chars().skip(1).all(|c| c.is_ascii_alphabetic()) {
            out.push(' ');
        }
    }
    out
}

/// Plain text: special characters escaped, symbols as formulas.
fn text(words: &str) -> String {
    let mut out = String::new();
    for c in words.chars() {
        match c {
            '&' | '%' | '$' | '#' | '_' | '{' | '}' => {
                out.push('\\');
                out.push(c);
            }
            '~' => out += "\\textasciitilde{}",
            '^' => out += "\\textasciicircum{}",
            '\\' => out += "\\textbackslash{}",
            '–' => out += "--",
            'µ' | 'μ' => out += "\\textmu{}",
            '`' => {}
            c => match letter(c) {
                Some(command) if !c.is_ascii() => {
                    let _ = write!(out, "${}$", command.trim_end());
                }
                _ => out.push(c),
            },
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formulas_are_those_of_a_paper() {
        assert_eq!(math("v − σ₀ · |v| / g · z"), "v - \\sigma_{\\mathrm{0}} \\cdot  \\vert v\\vert  / g \\cdot  z");
        assert_eq!(math("dz/dt"), "\\mathrm{d}z/\\mathrm{d}t");
        assert_eq!(math("exp(−(v / vd)²)"), "\\exp(-(v / v_{\\mathrm{d}})^{2})");
        assert_eq!(math("F_ext > Fs and v ≥ 0"), "F_{\\mathrm{ext}} > F_{\\mathrm{s}} \\text{ and } v \\ge  0");
        assert_eq!(math("10⁻¹²"), "10^{-12}");
        assert_eq!(math("v / 0.01 mm/s · 20 K"), "v / 0.01\\,\\mathrm{mm/s} \\cdot  20\\,\\mathrm{K}");
        assert_eq!(
            math("0 if 1.5e-3 < x, else 2 m"),
            "0 \\text{ if } 1.5 \\cdot 10^{-3} < x, \\text{ else } 2\\,\\mathrm{m}"
        );
        assert_eq!(math("sgn(f) − f / limit"), "\\operatorname{sgn}(f) - f / \\mathrm{limit}");
    }

    #[test]
    fn text_has_no_active_characters() {
        assert_eq!(text("50 % of F_c & σ"), "50 \\% of F\\_c \\& $\\sigma$");
        assert_eq!(quantity("316 N·s/m"), "$316\\,\\mathrm{N\\cdot s/m}$");
        assert_eq!(quantity("25 µm"), "$25\\,\\mathrm{\\text{\\textmu}m}$");
        assert_eq!(quantity("-1e-7 m/s²"), "$-10^{-7}\\,\\mathrm{m/s^{2}}$");
        assert_eq!(quantity("∞"), "$\\infty$");
        assert_eq!(quantity("2"), "$2$");
    }

    /// What a strict LaTeX accepts, for random formulas of symbols.
    #[test]
    fn random_formulas_are_sound() {
        const PIECES: [&str; 22] = [
            "σ₀",
            "dz/dt",
            "F_ext",
            "|v|",
            "(",
            ")",
            " · ",
            " + 2²",
            " / x⁻¹",
            " if ",
            "x_b_max",
            "exp(",
            "v",
            "Fs",
            " ≤ ",
            "tanh(",
            "el[1].f",
            "…",
            "1.5e-3",
            "a₁₂",
            "0.01 mm/s",
            "20 K",
        ];
        let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(41);
        let mut random = compiler::ir::random::Random(seed);
        for case in 0..500 {
            let formula: String =
                (0..1 + random.below(9)).map(|_| PIECES[random.below(PIECES.len())]).collect::<Vec<_>>().join(" · ");
            let tex = math(&formula);
            let found = strict::strict(&format!("${tex}$"));
            assert!(found.is_ok(), "seed {seed}, case {case}: {formula}: {tex}: {found:?}");
        }
    }

    /// Every unit of the language, alone and in products, quotients and powers, is upright wherever a text with it can
    /// stand: in a formula, as a value of a table, in a label. Nothing of it is left among the letters of formulas.
    ///
    /// Mutant tried by hand: a number is read without its unit.
    #[test]
    fn every_unit_is_upright_everywhere() {
        let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(4);
        let mut random = compiler::ir::random::Random(seed);
        let names: Vec<String> = abi::unit::symbols().collect();
        assert!(names.len() > 60, "{}", names.len());
        let factor = |name: &str, random: &mut compiler::ir::random::Random| match random.below(4) {
            0 => format!("{name}^2"),
            1 => format!("{name}^3"),
            _ => name.to_string(),
        };
        let mut units = names.clone();
        for _ in 0..400 {
            let pick = |random: &mut compiler::ir::random::Random| {
                let name = names[random.below(names.len())].clone();
                factor(&name, random)
            };
            let (a, b, c) = (pick(&mut random), pick(&mut random), pick(&mut random));
            units.push(
                [format!("{a}·{b}"), format!("{a}/{b}"), format!("{a}·{b}/{c}"), format!("1/{a}")][random.below(4)]
                    .clone(),
            );
        }
        // Upright groups and spaces are taken out: digits, signs and the symbols of the formula are left.
        let left = |tex: &str| {
            let (mut out, mut rest) = (String::new(), tex);
            while let Some((before, after)) = rest.split_once("\\mathrm{") {
                out += before;
                let mut depth = 1;
                let end = after.find(|c| {
                    depth += i32::from(c == '{') - i32::from(c == '}');
                    depth == 0
                });
                rest = &after[end.expect("it is closed") + 1..];
            }
            (out + rest).replace("\\,", "").replace("\\cdot", "").replace(' ', "")
        };
        for unit in units.iter().filter(|unit| Unit::parse(unit).is_ok()) {
            let parsed = Unit::parse(unit).unwrap();
            let value = show(2.5 * parsed.scale, &parsed, 6);
            let table = quantity(&value);
            let number: String = value.split(' ').next().unwrap().replace('−', "-");
            assert!(value.split(' ').nth(1).is_none() || table.contains("\\mathrm{"), "{unit}: {table}");
            assert!(strict::strict(&table).is_ok(), "{unit}: {table}: {:?}", strict::strict(&table));
            assert_eq!(left(&table).replace('$', ""), number, "{unit}: {table}");
            let (expr, errors) = grammar::parse::parse_expr(
                grammar::span::FileId(0),
                &format!("(v - 0.01 {unit}) * x / 3 {unit} + 20 {unit}"),
            );
            assert!(errors.is_empty(), "{unit}: {errors:?}");
            let formula = math(&crate::equations::expression(&expr));
            assert_eq!(left(&formula), "(v-0.01)x/(3)+20", "{unit}: {formula}");
            assert!(strict::strict(&format!("${formula}$")).is_ok(), "{unit}: {formula}");
            let label = text(&format!("M(k = 2 {unit})"));
            assert!(strict::strict(&label).is_ok(), "{unit}: {label}");
            assert!(!label.contains("$\\mu$"), "{unit}: {label}");
        }
    }

    #[test]
    fn the_strict_reader_finds_what_latex_refuses() {
        for wrong in [
            "$x",
            "$x^2^3$",
            "$x_a_b$",
            "{",
            "a_b",
            "$\\unknown x$",
            "\\alpha",
            "10 & 3",
            "a & b",
            "$\\mathrm x$",
            "§",
            "\\begin{tabular}{ll}\na & b & c \\\\\n\\end{tabular}",
            "\\begin{align*}\nx &= 1\n\n\\end{align*}",
            "#",
            "\\begin{align*}x\\end{tabular}",
            "$\\text{a$",
            "\\end{align*}",
            "$a & b$",
        ] {
            assert!(strict::strict(wrong).is_err(), "{wrong}");
        }
        for right in [
            "$x_{a}^{2}$",
            "50 \\% $\\mathrm{N\\cdot s^{2}}$",
            "% a comment {\nwords",
            "$\\text{ if $x$ }$",
            "${}^{\\circ}$",
            "\\begin{tabular}{ll}\n\\toprule\na & b \\\\\n\\bottomrule\n\\end{tabular}",
            "\\begin{align*}\n  x &= 1 \\\\\n  & \\text{a}\n\\end{align*}",
        ] {
            assert_eq!(strict::strict(right), Ok(()), "{right}");
        }
    }
}

/// A reader of LaTeX that accepts what these texts need and nothing else: for tests.
#[cfg(test)]
pub mod strict {
    #[derive(Clone, Copy, PartialEq, Debug)]
    enum Mode {
        Text,
        Math,
    }

    const IN_TEXT: [&str; 13] = [
        "textbackslash",
        "textasciitilde",
        "textasciicircum",
        "textmu",
        "toprule",
        "midrule",
        "bottomrule",
        "&",
        "%",
        "$",
        "#",
        "_",
        "{",
    ];
    const IN_MATH: [&str; 60] = [
        "alpha",
        "beta",
        "gamma",
        "delta",
        "varepsilon",
        "zeta",
        "eta",
        "theta",
        "kappa",
        "lambda",
        "mu",
        "nu",
        "xi",
        "rho",
        "sigma",
        "tau",
        "varphi",
        "psi",
        "omega",
        "pi",
        "cdot",
        "le",
        "ge",
        "ne",
        "infty",
        "to",
        "dots",
        "surd",
        "circ",
        "Omega",
        "sim",
        "backslash",
        "vert",
        "checkmark",
        "times",
        "quad",
        ",",
        "exp",
        "sin",
        "cos",
        "tan",
        "sinh",
        "cosh",
        "tanh",
        "min",
        "max",
        "log",
        "arctan",
        "arcsin",
        "%",
        "&",
        "#",
        "$",
        "{",
        "}",
        "_",
        "mathrm",
        "text",
        "operatorname",
        "hat",
    ];
    const WITH_ARGUMENT: [&str; 4] = ["mathrm", "text", "operatorname", "hat"];

    struct Reader<'a> {
        chars: Vec<char>,
        at: usize,
        text: &'a str,
    }

    /// Whether a text would be set without an error by LaTeX with amsmath, amssymb and booktabs.
    pub fn strict(text: &str) -> Result<(), String> {
        if let Some(c) = text.chars().find(|c| !c.is_ascii()) {
            return Err(format!("`{c}` is no ASCII"));
        }
        let mut reader = Reader { chars: text.chars().collect(), at: 0, text };
        reader.read(Mode::Text, None, None)?;
        if reader.at < reader.chars.len() { Err(reader.wrong("ends what did not begin")) } else { Ok(()) }
    }

    impl Reader<'_> {
        fn wrong(&self, why: &str) -> String {
            let from = self.at.saturating_sub(20).min(self.text.len());
            format!("{why} after `{}`", &self.text[from..self.at.min(self.text.len())])
        }

        fn next(&self) -> Option<char> {
            self.chars.get(self.at).copied()
        }

        fn command(&mut self) -> Result<String, String> {
            self.at += 1;
            let begin = self.at;
            while self.next().is_some_and(|c| c.is_ascii_alphabetic()) {
                self.at += 1;
            }
            if self.at == begin {
                let c = self.next().ok_or("a lone backslash")?;
                self.at += 1;
                return Ok(c.to_string());
            }
            Ok(self.chars[begin..self.at].iter().collect())
        }

        fn braced(&mut self, mode: Mode) -> Result<(), String> {
            if self.next() != Some('{') {
                return Err(self.wrong("an argument in braces is missing"));
            }
            self.at += 1;
            self.read(mode, Some('}'), None)?;
            if self.next() != Some('}') {
                return Err(self.wrong("a brace is open"));
            }
            self.at += 1;
            Ok(())
        }

        fn name(&mut self) -> Result<String, String> {
            if self.next() != Some('{') {
                return Err(self.wrong("a name in braces is missing"));
            }
            let begin = self.at + 1;
            while self.next().is_some_and(|c| c != '}') {
                self.at += 1;
            }
            self.at += 1;
            Ok(self.chars.get(begin..self.at - 1).ok_or("a brace is open")?.iter().collect())
        }

        /// Reads until `end`, or until the `\end` of an environment with `columns`, which it leaves unread.
        fn read(&mut self, mode: Mode, end: Option<char>, columns: Option<usize>) -> Result<(), String> {
            // Whether the last nucleus has a superscript and a subscript already.
            let mut scripts = (false, false);
            let mut cells = 1;
            while let Some(c) = self.next() {
                if Some(c) == end {
                    return Ok(());
                }
                match c {
                    '%' => {
                        while self.next().is_some_and(|c| c != '\n') {
                            self.at += 1;
                        }
                    }
                    '}' => return Err(self.wrong("a brace that was not opened")),
                    '{' => {
                        scripts = (false, false);
                        self.braced(mode)?;
                    }
                    '$' if mode == Mode::Math => return Err(self.wrong("`$` within a formula")),
                    '$' => {
                        self.at += 1;
                        self.read(Mode::Math, Some('$'), None)?;
                        if self.next() != Some('$') {
                            return Err(self.wrong("a formula is open"));
                        }
                        self.at += 1;
                    }
                    '^' | '_' if mode == Mode::Text => return Err(self.wrong("a script outside of a formula")),
                    '^' | '_' => {
                        let seen = if c == '^' { &mut scripts.0 } else { &mut scripts.1 };
                        if std::mem::replace(seen, true) {
                            return Err(self.wrong("a double script"));
                        }
                        self.at += 1;
                        self.braced(mode)?;
                    }
                    '&' => {
                        let Some(most) = columns else { return Err(self.wrong("`&` outside of a table")) };
                        cells += 1;
                        if cells > most {
                            return Err(self.wrong("too many cells"));
                        }
                        self.at += 1;
                        scripts = (false, false);
                    }
                    '#' => return Err(self.wrong("`#`")),
                    '\n' if mode == Mode::Math
                        && self.text[self.at + 1..].trim_start_matches(' ').starts_with('\n') =>
                    {
                        return Err(self.wrong("an empty line in a formula"));
                    }
                    '\\' => {
                        let begin = self.at;
                        let name = self.command()?;
                        match name.as_str() {
                            "end" if columns.is_some() => {
                                self.at = begin;
                                return Ok(());
                            }
                            "end" => return Err(self.wrong("an environment that did not begin")),
                            "begin" if mode == Mode::Text => {
                                let name = self.name()?;
                                let (mode, columns) = match name.as_str() {
                                    "align*" => (Mode::Math, 2),
                                    "tabular" => (Mode::Text, self.name()?.len()),
                                    _ => return Err(self.wrong("an unknown environment")),
                                };
                                self.read(mode, None, Some(columns))?;
                                if self.next() != Some('\\') || self.command()? != "end" || self.name()? != name {
                                    return Err(self.wrong("another environment ends"));
                                }
                            }
                            "\\" if columns.is_some() => (cells, scripts) = (1, (false, false)),
                            command => {
                                let known: &[&str] = if mode == Mode::Math { &IN_MATH } else { &IN_TEXT };
                                if !(known.contains(&command) || mode == Mode::Text && command == "}") {
                                    return Err(self.wrong("an unknown command"));
                                }
                                if WITH_ARGUMENT.contains(&command) {
                                    self.braced(if command == "text" { Mode::Text } else { mode })?;
                                }
                                scripts = (false, false);
                            }
                        }
                    }
                    c => {
                        if !c.is_whitespace() {
                            scripts = (false, false);
                        }
                        self.at += 1;
                    }
                }
            }
            match end {
                Some(_) => Err(self.wrong("something is open")),
                None => Ok(()),
            }
        }
    }
}
