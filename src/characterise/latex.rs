//! Tables and equations of studies as LaTeX, for a paper.
//!
//! In: one or more [`Study`] values. Out: text to `\input`; it needs the packages amsmath, amssymb and booktabs.

use super::page::scale_rows;
use super::phenomena::Seen;
use super::study::Study;
use crate::quantity::show;
use std::fmt::Write;

/// Equations and parameters of each model, and the phenomena and scales of all.
pub fn tables(studies: &[Study]) -> String {
    let mut out = format!(
        "% Written by fric {}. Needs \\usepackage{{amsmath, amssymb, booktabs}}.\n\n",
        env!("CARGO_PKG_VERSION")
    );
    for study in studies {
        let _ = writeln!(out, "% {}: equations", study.label.replace('\n', " "));
        out += &equations(&study.subject.equations);
        out.push('\n');
        if !study.subject.params.is_empty() {
            let _ = writeln!(out, "% {}: parameters", study.label.replace('\n', " "));
            out += "\\begin{tabular}{lll}\n\\toprule\nparameter & value & meaning \\\\\n\\midrule\n";
            for param in &study.subject.params {
                let value = if param.value == f64::INFINITY { "∞".into() } else { show(param.value, &param.unit, 6) };
                let name = param.path.split('.').map(crate::equations::symbol).collect::<Vec<_>>().join(".");
                let doc = param.doc.as_deref().unwrap_or_default();
                let _ = writeln!(out, "${}$ & {} & {} \\\\", math(&name), quantity(&value), text(doc.trim()));
            }
            out += "\\bottomrule\n\\end{tabular}\n\n";
        }
    }
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

/// Equations as `align*`; a heading such as `in stick:` is text.
fn equations(equations: &[(String, String)]) -> String {
    if equations.is_empty() {
        return String::new();
    }
    let line =
        |(left, right): &(String, String)| match (right.is_empty(), left.starts_with('→') || left.contains("when ")) {
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
    let number = |text: &str| text.replace('−', "-").replace('∞', "$\\infty$");
    match shown.split_once(' ') {
        Some((value, unit)) => {
            let unit: String = unit.chars().map(|c| letter(c).unwrap_or_else(|| c.to_string())).collect();
            let value = number(value);
            if value.starts_with('$') { value } else { format!("${value}\\,\\mathrm{{{unit}}}$") }
        }
        None => text(&number(shown)).replace("\\$", "$").replace("\\textbackslash{}", "\\"),
    }
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
        // Letters behind the first one, in words or subscripts.
        let ascii =
            |part: &str| -> String { part.chars().map(|c| letter(c).unwrap_or_else(|| c.to_string())).collect() };
        let (head, low) = match (rest.chars().count(), first.as_str()) {
            (1.., "d") if followed => (format!("\\mathrm{{d}}{}", math(&rest)), String::new()),
            (0, _) => (first, String::new()),
            (1..=2, _) if !is_part => (first, rest),
            (_, _) => (format!("\\mathrm{{{}}}", ascii(stem)), String::new()),
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
        assert_eq!(math("sgn(f) − f / limit"), "\\operatorname{sgn}(f) - f / \\mathrm{limit}");
    }

    #[test]
    fn text_has_no_active_characters() {
        assert_eq!(text("50 % of F_c & σ"), "50 \\% of F\\_c \\& $\\sigma$");
        assert_eq!(quantity("316 N·s/m"), "$316\\,\\mathrm{N\\cdot s/m}$");
        assert_eq!(quantity("25 µm"), "$25\\,\\mathrm{\\mu m}$");
        assert_eq!(quantity("∞"), "$\\infty$");
        assert_eq!(quantity("2"), "2");
    }

    /// Braces are balanced and every environment ends, for random formulas of symbols.
    #[test]
    fn random_formulas_keep_braces_balanced() {
        const PIECES: [&str; 20] = [
            "σ₀", "dz/dt", "F_ext", "|v|", "(", ")", " · ", "²", "⁻¹", " if ", "x_b_max", "exp", "v", "Fs", " ≤ ",
            "tanh", "el[1].f", "…", "1.5e-3", "a₁₂",
        ];
        let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(41);
        let mut random = compiler::ir::random::Random(seed);
        for case in 0..500 {
            let formula: String = (0..1 + random.below(9)).map(|_| PIECES[random.below(PIECES.len())]).collect();
            let tex = math(&formula);
            let count = |c: char| tex.matches(c).count();
            assert_eq!(count('{'), count('}'), "seed {seed}, case {case}: {formula}: {tex}");
            assert!(tex.is_ascii(), "seed {seed}, case {case}: {formula}: {tex}");
        }
    }
}
