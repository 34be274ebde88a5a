//! Common mistakes: recognises them in a statement that could not be parsed, and suggests what was probably meant.
//!
//! In: the marks of one statement and the position at which parsing stopped. Out: one diagnostic in terms of the text.
//! Knows nothing of grammar rules; the expected tokens come as words.

use crate::diagnostic::{Diagnostic, WordMistake};
use crate::span::Span;
use crate::split::{Piece, Source};
use crate::tokens::{TokenKind, is_keyword};

/// Position at which parsing a piece stopped, and what was expected there, in words.
pub(crate) struct Stop {
    /// The mark that did not match; the end of the piece if something is missing after it.
    pub at: usize,
    pub expected: Vec<String>,
}

/// The diagnostic for an unreadable piece.
pub(crate) fn explain(source: &Source, piece: Piece, stop: &Stop) -> Diagnostic {
    let finders = [
        foreign_statement,
        borrowed,
        unit_in_parentheses,
        character,
        head,
        operator,
        condition,
        habit,
        branching,
        branch,
        unit,
        bare_unit,
        reserved,
        missing,
        neighbours,
        model_name,
    ];
    finders.iter().find_map(|find| find(source, piece, stop)).unwrap_or_else(|| plain(source, piece, stop))
}

/// Reports an unclosed or superfluous bracket of `piece`. Braces are matched in `split`.
pub(crate) fn brackets(source: &Source, piece: Piece) -> Option<Diagnostic> {
    let mut open: Vec<usize> = Vec::new();
    for at in piece.start..piece.end {
        if source.kind(at) != Some(TokenKind::Symbol) {
            continue;
        }
        match source.word(at) {
            "(" | "[" => open.push(at),
            close @ (")" | "]") => {
                let wanted = if close == ")" { "(" } else { "[" };
                match open.pop() {
                    Some(before) if source.word(before) == wanted => {}
                    Some(before) => return Some(unclosed(source, before, at - 1)),
                    None => {
                        return Some(
                            Diagnostic::error("E0002", format!("one `{close}` too many"))
                                .label(source.span(at), format!("no `{wanted}` belongs to it"))
                                .help(format!("remove it, or add `{wanted}` before it")),
                        );
                    }
                }
            }
            _ => {}
        }
    }
    open.last().map(|&before| unclosed(source, before, piece.end - 1))
}

fn unclosed(source: &Source, open: usize, last: usize) -> Diagnostic {
    let (bracket, close) = if source.word(open) == "(" { ("(", ")") } else { ("[", "]") };
    let called = open > 0 && source.glued(open) && source.kind(open - 1) == Some(TokenKind::Word);
    let mut tail =
        source.text[source.marks[open - called as usize].token.start..source.marks[last].token.end].to_string();
    let help = if tail.len() > 40 || tail.contains('\n') {
        format!("add `{close}`")
    } else {
        tail.push_str(close);
        format!("add `{close}`, for example `{tail}`")
    };
    Diagnostic::error("E0002", format!("this `{bracket}` is not closed"))
        .label(source.span(open), format!("no `{close}` belongs to it"))
        .help(help)
}

/// The nesting depth of brackets and conditions, and the first mark beyond `limit`.
pub(crate) fn depth(source: &Source, piece: Piece, limit: usize) -> (usize, Option<usize>) {
    // For each open bracket the number of conditions in it so far, each of which is nested in the preceding one.
    let mut open = vec![0usize];
    let (mut depth, mut deepest) = (0, 0);
    for at in piece.start..piece.end {
        match source.word(at) {
            "(" | "[" | "{" => {
                open.push(1);
                depth += 1;
            }
            ")" | "]" | "}" if open.len() > 1 => depth -= open.pop().unwrap_or(0),
            "if" => {
                *open.last_mut().expect("the outermost stays") += 1;
                depth += 1;
            }
            "," if open.len() > 1 => {
                let ifs = open.last_mut().expect("the outermost stays");
                depth -= *ifs - 1;
                *ifs = 1;
            }
            _ => {}
        }
        deepest = deepest.max(depth);
        if depth > limit {
            return (depth, Some(at));
        }
    }
    (deepest, None)
}

/// Whether `word` is a known unit, with or without a prefix.
pub(crate) fn is_unit(word: &str) -> bool {
    const UNITS: [&str; 20] = [
        "m", "g", "s", "A", "K", "N", "J", "W", "Pa", "V", "Ohm", "Ω", "Hz", "rad", "deg", "rev", "rpm", "bit", "min",
        "h",
    ];
    const PREFIXES: [char; 8] = ['G', 'M', 'k', 'm', 'u', 'n', 'µ', 'μ'];
    let known = |word: &str| UNITS.contains(&word);
    matches!(word, "%" | "°" | "cm" | "Nm")
        || known(word)
        || word.strip_prefix(PREFIXES).is_some_and(|rest| known(rest) || rest == "Nm")
}

/// Whether a word could be a name: it contains no character of a unit.
fn is_name(word: &str) -> bool {
    word.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
}

/// Reports a character that the language does not use.
fn character(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    // A bracket with an invalid character in it fails as a whole.
    let end = match source.is_symbol(stop.at, "[") {
        true => (stop.at..piece.end).find(|&at| source.is_symbol(at, "]")).unwrap_or(stop.at),
        false => stop.at,
    };
    let at = (piece.start..piece.end.min(end + 1))
        .rev()
        .find(|&at| matches!(source.kind(at), Some(TokenKind::Unknown | TokenKind::OpenText)))?;
    if source.kind(at) == Some(TokenKind::OpenText) {
        return Some(
            Diagnostic::error("E0002", "this text is not closed")
                .label(source.span(at), "no `\"` before the end of the line")
                .help("add `\"`"),
        );
    }
    let found = source.word(at).chars().next()?;
    // Full-width forms of ASCII characters.
    if let '\u{ff01}'..='\u{ff5e}' = found {
        let plain = char::from_u32(found as u32 - 0xff01 + 0x21).filter(|_| !found.is_alphanumeric());
        if let Some(plain) = plain {
            return Some(
                Diagnostic::error("E0001", format!("`{found}` has no place here"))
                    .label(source.span(at), "")
                    .help(format!("write the narrow `{plain}`")),
            );
        }
    }
    if found.is_alphabetic() {
        return Some(foreign(source, piece, at));
    }
    if found == '\'' && at == piece.start + 1 && source.glued(at) && source.kind(at - 1) == Some(TokenKind::Word) {
        return Some(
            Diagnostic::error("E0001", "a derivative is written as on paper")
                .label(source.span(at - 1).to(source.span(at)), "")
                .help(format!("write `d{}/dt`", source.word(at - 1))),
        );
    }
    if found == '\'' && at > piece.start && source.glued(at) && matches!(source.word(at - 1), ")" | "]") {
        return Some(
            Diagnostic::error("E0001", "there are no arrays: nothing to transpose")
                .label(source.span(at), "")
                .help("leave `'` out; several equal parts are `part el[i in 1 .. 4] = Model(k = i)`"),
        );
    }
    let instead = match found {
        '−' | '–' | '—' => "write `-`",
        '×' | '⋅' | '∙' | '•' => "write `*`; between units `·`",
        '·' => "between values write `*`; in a unit `·` has no blank around it",
        '÷' => "write `/`",
        '²' => "write `^2`",
        '⁻' | '¹' => "powers are written `^2`, and what is divided by stands after `/`: `m/s^2`",
        '³' => "write `^3`",
        '≤' => "write `<=`",
        '≥' => "write `>=`",
        '≠' => "write `!=`",
        '&' => "write `and`",
        '|' => "write `or`; for the magnitude `abs(x)`",
        '!' => "write `not`",
        '\'' => "a derivative is written `dz/dt`, text in double quotes `\"`",
        '“' | '”' | '„' => "text stands in plain double quotes, `\"`",
        '#' => "a comment begins with `//`",
        '%' if source.marks[at].first_on_line => "a comment begins with `//`",
        '%' => "a comment begins with `//`; as a unit `%` stands after its number",
        '@' => "a function is declared outside of models: `fn g(v [m/s]) [N] = ...`",
        '~' => "write `not`; `!=` means different",
        '\u{a0}' | '\u{2009}' | '\u{202f}' | '\u{200b}' => "write a plain space",
        _ => "remove it",
    };
    let hidden =
        matches!(found, '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202f}' | '\u{2060}'..='\u{206f}' | '\u{feff}');
    let shown = if found.is_control() || found.is_whitespace() || hidden {
        format!("the character U+{:04X}", found as u32)
    } else {
        format!("`{found}`")
    };
    Some(Diagnostic::error("E0001", format!("{shown} has no place here")).label(source.span(at), "").help(instead))
}

/// Reports a name with letters that names cannot contain: the whole name, and how it can be written.
fn foreign(source: &Source, piece: Piece, at: usize) -> Diagnostic {
    let letters = |at: usize| {
        let foreign = source.kind(at) == Some(TokenKind::Unknown)
            && source.word(at).chars().all(|c| c.is_alphanumeric() || plain_letters(c).is_some());
        foreign || matches!(source.kind(at), Some(TokenKind::Word | TokenKind::Number))
    };
    let (mut first, mut last) = (at, at);
    while first > piece.start && source.glued(first) && letters(first - 1) {
        first -= 1;
    }
    while last + 1 < piece.end && source.glued(last + 1) && letters(last + 1) {
        last += 1;
    }
    let word = slice(source, first, last);
    let plain: Option<String> = word
        .chars()
        .map(|c| if c.is_ascii() { Some(c.to_string()) } else { plain_letters(c).map(str::to_string) })
        .collect();
    let made_of = "names are made of the letters a to z, digits and `_`";
    let help = match plain {
        Some(plain) => format!("write `{plain}`: {made_of}"),
        None => format!("{made_of}: `sigma0`, `omega`"),
    };
    Diagnostic::error("E0001", format!("`{word}` is no name here"))
        .label(source.span(first).to(source.span(last)), "")
        .help(help)
        .about_word(WordMistake::ForeignName)
}

/// A letter of another alphabet, transliterated to ASCII.
fn plain_letters(letter: char) -> Option<&'static str> {
    const GREEK: [&str; 25] = [
        "alpha", "beta", "gamma", "delta", "epsilon", "zeta", "eta", "theta", "iota", "kappa", "lambda", "mu", "nu",
        "xi", "omicron", "pi", "rho", "sigma", "sigma", "tau", "upsilon", "phi", "chi", "psi", "omega",
    ];
    Some(match letter {
        'α'..='ω' => GREEK[letter as usize - 'α' as usize],
        'µ' => "mu",
        'Γ' => "Gamma",
        'Δ' => "Delta",
        'Θ' => "Theta",
        'Λ' => "Lambda",
        'Φ' => "Phi",
        'Ψ' => "Psi",
        'Σ' => "Sigma",
        'Ω' => "Omega",
        'ä' | 'æ' => "ae",
        'ö' | 'ø' | 'œ' => "oe",
        'ü' => "ue",
        'ß' => "ss",
        'Ä' => "Ae",
        'Ö' | 'Ø' => "Oe",
        'Ü' => "Ue",
        'à'..='å' => "a",
        'ç' => "c",
        'è'..='ë' => "e",
        'ì'..='ï' => "i",
        'ñ' => "n",
        'ò'..='õ' => "o",
        'ù'..='û' => "u",
        'ý' | 'ÿ' => "y",
        'À'..='Å' => "A",
        'Ç' => "C",
        'È'..='Ë' => "E",
        'Ñ' => "N",
        'Ò'..='Õ' => "O",
        'Ù'..='Û' => "U",
        '₀' => "0",
        '₁' => "1",
        '₂' => "2",
        '₃' => "3",
        '₄' => "4",
        _ => return None,
    })
}

/// Reports `/* … */`, the comment of many other languages.
pub(crate) fn block_comment(source: &Source) -> Option<Diagnostic> {
    let span = *source.block_comments.first()?;
    Some(
        Diagnostic::error("E0001", "a comment goes from `//` to the end of its line")
            .label(span, "no comment here")
            .help("begin each of its lines with `//`"),
    )
}

/// Reports the head of a statement: a declaration with a keyword of another language, an assignment, a derivative in
/// another notation.
fn head(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    let first = piece.start;
    let word = source.word(first);
    let derivative = |of: &str| format!("write `d{of}/dt = ...`");
    if source.kind(first) != Some(TokenKind::Word) {
        return None;
    }
    let named = source.kind(first + 1) == Some(TokenKind::Word) && first + 1 < piece.end;
    if named && !is_keyword(word) && stop.at <= first + 1 {
        let right = match word {
            "var" | "def" | "real" | "Real" | "float" | "double" | "auto" | "local" | "variable" | "signal" | "val" => {
                "let"
            }
            "parameter" | "parameters" | "params" | "Parameter" => "param",
            "constant" | "final" => "const",
            "inputs" | "in" => "input",
            "outputs" | "out" => "output",
            "states" => "state",
            "assert" | "requires" => "require",
            "function" | "func" | "fun" => "fn",
            "class" | "block" | "system" => "model",
            "test" => "experiment",
            "include" | "use" | "using" => "import",
            "parts" | "component" => "part",
            "case" | "regime" => "mode",
            _ => "",
        };
        if !right.is_empty() {
            return Some(
                Diagnostic::error("E0001", format!("`{word}` begins no statement here"))
                    .label(source.span(first), format!("expected `{right}`"))
                    .help(format!("write `{right} {}`", source.word(first + 1))),
            );
        }
    }
    if let Some(at) = (first + 1..piece.end).find(|&at| source.is_symbol(at, ":=")) {
        return Some(
            Diagnostic::error("E0001", "an equation is written with `=`")
                .label(source.span(at), "")
                .help(format!("write `{} = ...`", slice(source, first, at - 1))),
        );
    }
    if source.is_symbol(first + 1, "==") && !is_keyword(word) {
        return Some(
            Diagnostic::error("E0001", "an equation is written with one `=`")
                .label(source.span(first + 1), "compares two values")
                .help(format!("write `{word} = ...`")),
        );
    }
    if source.is_symbol(first + 1, "(") && source.is_symbol(first + 3, ")") && !is_keyword(word) {
        let of = source.word(first + 2);
        if matches!(word, "der" | "diff" | "ddt" | "dot" | "D") && source.kind(first + 2) == Some(TokenKind::Word) {
            return Some(
                Diagnostic::error("E0001", "a derivative is written as on paper")
                    .label(source.span(first).to(source.span(first + 3)), "")
                    .help(derivative(of)),
            );
        }
    }
    if source.is_symbol(first + 1, "/")
        && let Some(of) = word.strip_prefix("d2").filter(|of| !of.is_empty())
        && source.word(first + 2).starts_with("dt")
    {
        return Some(
            Diagnostic::error("E0001", "an equation has a first derivative on its left")
                .label(source.span(first).to(source.span(first + 2)), "a second derivative")
                .help(format!("make it two states: `d{of}/dt = v` and `dv/dt = ...`")),
        );
    }
    spaced_derivative(source, piece).map(|(span, of, along)| {
        Diagnostic::error("E0003", "a derivative is written without spaces")
            .label(span, "reads as a division")
            .help(format!("write `{of}/{along} = ...`"))
    })
}

/// The span and both words of `dz / dt =` at the start of a piece.
pub(crate) fn spaced_derivative<'t>(source: &Source<'t>, piece: Piece) -> Option<(Span, &'t str, &'t str)> {
    let first = piece.start;
    let word = |at: usize| {
        source.kind(at) == Some(TokenKind::Word) && source.word(at).len() > 1 && source.word(at).starts_with('d')
    };
    let shape = first + 3 < piece.end
        && word(first)
        && source.is_symbol(first + 1, "/")
        && word(first + 2)
        && source.is_symbol(first + 3, "=")
        && !(source.glued(first + 1) && source.glued(first + 2));
    shape.then(|| (source.span(first).to(source.span(first + 2)), source.word(first), source.word(first + 2)))
}

/// Reports operators of other languages.
fn operator(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    let at = stop.at;
    if at >= piece.end {
        return None;
    }
    let (before, here) = (if at > piece.start { source.word(at - 1) } else { "" }, source.word(at));
    let instead = match (before, here) {
        ("*", "*") => "a power is written `^`",
        ("+", "-") | ("-", "-") | ("+", "+") | ("-", "+") => "write the second sign in parentheses, or leave it out",
        (_, "+-") => "`+-` gives a tolerance in `expect`; to subtract write `-`",
        (_, "~=") => "`~=` compares in `expect` only, with `+-`; `!=` means different",
        ("not", "not") => "two `not` cancel: leave both out",
        _ => return None,
    };
    Some(Diagnostic::error("E0001", format!("`{here}` does not fit here")).label(source.span(at), "").help(instead))
}

/// Statements of MATLAB, Python and Modelica that have no counterpart under their name: words that begin one, what is
/// said about it, and what to write.
const FOREIGN: &[(&[&str], &str, &str)] = &[
    (
        &["while", "repeat", "do"],
        "there are no loops",
        "an equation that holds under a condition is a choice:\n`dv/dt = if v > 0 m/s then u / m else 0 m/s^2`; regimes that remember are `mode`s",
    ),
    (
        &["for", "foreach", "loop"],
        "there are no loops",
        "time needs none: every equation holds at every instant. For several equal parts write\n`part el[i in 1 .. 4] = Model(k = i)` and `sum(el.f)`, for several runs `sweep`",
    ),
    (
        &["switch", "case", "otherwise"],
        "a choice is a value, not a statement: every equation holds at all times",
        "write `let F = if v > 0 m/s then a else if v < 0 m/s then b else c`; regimes that remember are `mode`s",
    ),
    (
        &["persistent", "global", "static"],
        "what keeps its value is a state",
        "in sampled code write `state y [m] = 0` and `every 1 ms { next(y) = … }`: `y` is the value of the last sample;\nwhat never changes is a `param` of a model, or for the whole file `const g = 9.81 m/s^2`",
    ),
    (
        &["disp", "fprintf", "printf", "print", "display", "sprintf"],
        "an experiment says what it shows by `show`",
        "write `show max(F)`; its value is printed after the run",
    ),
    (
        &["subplot", "figure", "hold", "tiledlayout", "nexttile"],
        "how a figure looks is said by `plot`",
        "leave the line out: each `plot` is a panel, and `plot F, u` draws two curves into one;\npanels side by side: `fric run FILE --plot fig.pdf --columns 2`",
    ),
    (
        &["xlabel", "ylabel", "legend", "title"],
        "how a figure looks is said by `plot`",
        "leave the line out: axes have the names and units of what they show;\n`plot F as \"friction\" title \"…\"` names a curve and its panel",
    ),
    (
        &["axis", "xlim", "ylim", "grid", "semilogx", "semilogy", "loglog", "yyaxis", "saveas", "exportgraphics"],
        "how a figure looks is said by `plot`",
        "write `plot F [N] as \"friction\" in 0 N .. 2 N against v log after 1 s title \"…\"`, and a `plot` for each panel;\nsize, columns and file are options: `fric run FILE --plot fig.pdf --size 85x60mm --columns 2`",
    ),
    (
        &["clear", "clc", "close", "clearvars", "format", "warning", "addpath", "tic", "toc", "rng", "pause", "more"],
        "nothing has to be prepared: each run starts anew",
        "leave the line out",
    ),
];

/// Reports statements that begin with a word of another language.
fn foreign_statement(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    let first = piece.start;
    if first >= piece.end || source.kind(first) != Some(TokenKind::Word) || stop.at > first + 1 {
        return None;
    }
    let (word, next) = (source.word(first), source.word(first + 1));
    if matches!(next, "=" | "." | "/" | "[") {
        return None;
    }
    let error = |message: &str, to: usize| {
        Diagnostic::error("E0001", message).label(source.span(first).to(source.span(to)), "")
    };
    // `function F = coulomb(v)`
    if word == "function" && source.is_symbol(first + 2, "=") && source.is_symbol(first + 4, "(") {
        let close = (first + 4..source.marks.len()).find(|&mark| source.is_symbol(mark, ")"))?;
        let args: Vec<&str> = (first + 5..close).map(|mark| source.word(mark)).filter(|word| *word != ",").collect();
        let args: Vec<String> = args.iter().map(|arg| format!("{arg} [m/s]")).collect();
        let help = format!(
            "write `fn {}({}) [N] = …`, with the units of arguments and result; what has states is a `model`",
            source.word(first + 3),
            args.join(", ")
        );
        return Some(error("a function is one expression, without a body", close).help(help));
    }
    // `assert(max(F) < 2)`
    if word == "assert" && next == "(" {
        let close =
            (first + 2..piece.end).rev().find(|&mark| source.is_symbol(mark, ")")).filter(|&close| close > first + 2);
        let inner = close.map_or("max(F) < 2 N", |close| slice(source, first + 2, close - 1));
        // A measure is of an experiment alone.
        let also = if inner.contains('(') { String::new() } else { format!(", in a model `require {inner}, \"why\"`") };
        let help = format!("in an experiment write `expect {inner}`{also}; numbers carry their unit: `2 N`");
        return Some(error("what must hold is an `expect`", first).help(help));
    }
    // `parameter Real k = 2`
    if matches!(next, "Real" | "Integer" | "Boolean") && source.kind(first + 2) == Some(TokenKind::Word) {
        let name = source.word(first + 2);
        let help = match word {
            "parameter" | "constant" => format!("write `param {name} = 2 N/m`: its unit is that of its value"),
            "input" | "output" => format!("write `{word} {name} [m/s]`, with its unit"),
            _ => return None,
        };
        return Some(error("a quantity has a unit, and no type", first + 1).help(help));
    }
    let (_, message, help) = FOREIGN.iter().find(|(words, ..)| words.contains(&word))?;
    let block =
        matches!(word, "while" | "for" | "foreach" | "loop" | "repeat" | "do" | "switch" | "case" | "otherwise");
    let inner = (source.is_symbol(first + 1, "(") && matches!(word, "disp" | "print" | "display"))
        .then(|| (first + 2..piece.end).rev().find(|&mark| source.is_symbol(mark, ")")))
        .flatten()
        .filter(|&close| close > first + 2)
        .map(|close| slice(source, first + 2, close - 1));
    let help = match (word, inner) {
        (_, Some(inner)) if is_short(inner) => format!("write `show {inner}`; its value is printed after the run"),
        ("while", _) => match choice(source, first).filter(|help| is_short(help)) {
            Some(written) => format!(
                "an equation that holds under a condition is a choice: `{written}`;\nregimes that remember are `mode`s"
            ),
            None => help.to_string(),
        },
        _ => help.to_string(),
    };
    let error = error(message, first).help(help);
    Some(if block { error.about_word(WordMistake::Block) } else { error })
}

/// Reports whole constructs of MATLAB, Python and Modelica, for which there is another way here. The list with more of
/// them is in docs/from-matlab.md.
fn borrowed(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    let (first, at) = (piece.start, stop.at);
    if first >= piece.end {
        return None;
    }
    let begin = source.word(first);
    let error = |message: &str, from: usize, to: usize, help: String| {
        Some(Diagnostic::error("E0001", message).label(source.span(from).to(source.span(to)), "").help(help))
    };
    let word = |at: usize| source.kind(at) == Some(TokenKind::Word);
    // `x .* y`
    if let Some(dot) = [Some(at), at.checked_sub(1)]
        .into_iter()
        .flatten()
        .find(|&at| at + 1 < piece.end && source.is_symbol(at, ".") && matches!(source.word(at + 1), "*" | "/" | "^"))
        && dot > first
        && source.glued(dot + 1)
    {
        let sign = source.word(dot + 1);
        return error("there are no arrays: each name is one number", dot, dot + 1, format!("write `{sign}`"));
    }
    // `...` at the end of a line
    if let Some(dots) = [Some(at), at.checked_sub(1)]
        .into_iter()
        .flatten()
        .find(|&at| at + 1 < source.marks.len() && source.word(at) == ".." && source.word(at + 1).starts_with('.'))
    {
        let message = "a statement goes on in the next line by itself";
        return error(message, dots, dots + 1, "leave `...` out: line breaks have no meaning".into());
    }
    // `tf([1], [0.1 1])`
    const TRANSFERS: [&str; 5] = ["tf", "ss", "zpk", "pid", "c2d"];
    if let Some(call) = (first..piece.end.min(at + 1))
        .find(|&mark| TRANSFERS.contains(&source.word(mark)) && source.is_symbol(mark + 1, "("))
    {
        let help = "1/(T s + 1) is `state y [m] = 0` and `dy/dt = (u - y) / T`; `LowPass` and `Notch` of `std.signal` and `PID` of\n`std.control` are parts: `part f = LowPass(u = x, f = 10 Hz)`";
        return error("a transfer function is written as equations", call, call, help.into());
    }
    // `1:1:10`
    if begin == "sweep" && source.word(at) == ":" {
        let number = |at: usize| (source.kind(at) == Some(TokenKind::Number)).then(|| source.word(at));
        let third = source.is_symbol(at + 2, ":").then(|| number(at + 3)).flatten();
        let written = match (number(at - 1), number(at + 1), third) {
            (Some(from), Some(step), Some(to)) => format!("{from} .. {to} by {step}"),
            (Some(from), Some(to), None) => format!("{from} .. {to} by 1"),
            _ => "1 .. 10 by 1".into(),
        };
        let help = format!(
            "write `{written}`, with the unit at each number as in `1 mm .. 10 mm by 1 mm`;\n`lin 5` and `log 5` in place of `by` give five values"
        );
        return error("a range of values is written with `..`", at, at, help);
    }
    // `g = @(v) Fc * sign(v)`
    let at_sign = (first..piece.end.min(at + 2)).find(|&mark| source.word(mark) == "@");
    if let Some(handle) = at_sign.filter(|&mark| source.is_symbol(mark + 1, "(")) {
        let close = (handle..piece.end).find(|&mark| source.is_symbol(mark, ")"))?;
        let name = if source.is_symbol(first + 1, "=") { begin } else { "g" };
        let args = slice(source, handle + 1, close);
        let body = if close + 1 < piece.end { slice(source, close + 1, piece.end - 1) } else { "..." };
        let body = if is_short(body) { body } else { "..." };
        let help = format!(
            "write it outside of models, with the unit of each argument, as in `v [m/s]`: `fn {name}{args} = {body}`;\nit sees its arguments and what is `const`"
        );
        return error("a function has a name and is declared by `fn`", handle, close, help);
    }
    // `[t, y] = ode45(...)`
    const SOLVERS: [&str; 12] = [
        "ode45",
        "ode23",
        "ode15s",
        "ode23s",
        "ode23t",
        "ode113",
        "odeint",
        "solve_ivp",
        "lsim",
        "sim",
        "simulate",
        "ode",
    ];
    let solver = (first..piece.end)
        .find(|&mark| SOLVERS.contains(&source.word(mark)) && source.is_symbol(mark + 1, "("))
        .filter(|&mark| stop.at <= mark && (stop.at + 1..=mark).all(|mark| !source.marks[mark].first_on_line));
    if let Some(solver) = solver {
        let help = "write `experiment e { run Model() for 10 s  plot x }`; it chooses its steps itself, or by `solver rk4 step 1 ms`";
        return error("a model is run by an experiment", solver, solver, help.into());
    }
    // `plot(t, y)`
    if begin == "plot" && source.is_symbol(first + 1, "(") && source.is_symbol(at, ",") {
        let (x, y) = (slice(source, first + 2, at - 1), operand_at(source, at + 1));
        let help = match x {
            "t" | "time" => format!("over time write `plot {y}`"),
            x => format!("write `plot {y} against {x}`"),
        };
        return error("`plot` names what is drawn, without brackets", first, at, help);
    }
    // `[1 2 3] N/m`: a row of numbers.
    let open = (first..piece.end.min(at + 1)).rev().find(|&mark| source.is_symbol(mark, "["))?;
    let close = (open..piece.end).find(|&mark| source.is_symbol(mark, "]"))?;
    let number = |mark: usize| matches!(source.kind(mark), Some(TokenKind::Number | TokenKind::Unit));
    let numbers = close > open + 2
        && (open + 1..close).all(|mark| number(mark) || matches!(source.word(mark), "," | "-" | ";"))
        && (open + 1..close).filter(|&mark| source.kind(mark) == Some(TokenKind::Number)).count() > 1;
    let declared = word(first) && matches!(begin, "part" | "input" | "output") && open == first + 2;
    if numbers && !declared && at <= close + 1 {
        if begin == "table" {
            let help = "write each point as `x: y`: `= linear { 0 m/s: 1 N, 1 m/s: 2 N }`, or name a file: `= linear \"curve.csv\"`";
            return error("points of a table stand in braces", open, close, help.into());
        }
        let help = "several equal parts are `part el[i in 1 .. 3] = Model(k = i * 1 N/m)`, points of a curve a `table`,\nand the values of a sweep `sweep k = 1 N/m, 2 N/m`";
        return error("there are no arrays: each name is one number", open, close, help.into());
    }
    None
}

/// Reports notations of other languages that are written differently here.
fn habit(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    let (first, at) = (piece.start, stop.at);
    if at <= first || at >= piece.end {
        return None;
    }
    let (begin, before, here) = (source.word(first), source.word(at - 1), source.word(at));
    let error = |message: &str, from: usize, to: usize| {
        Diagnostic::error("E0001", message).label(source.span(from).to(source.span(to)), "")
    };
    let word = |at: usize| source.kind(at) == Some(TokenKind::Word);
    let number = |at: usize| source.kind(at) == Some(TokenKind::Number);
    let declares = matches!(begin, "param" | "input" | "output" | "state" | "let" | "const");
    if here == "," && number(at - 1) && number(at + 1) && source.glued(at) && source.glued(at + 1) {
        let written = format!("{before}.{}", source.word(at + 1));
        return Some(error("the decimal sign is a point", at - 1, at + 1).help(format!("write `{written}`")));
    }
    if declares && at == first + 2 && here == ":" {
        let help = format!("write `{begin} {before} = ...`, or a unit: `{begin} {before} [m]`");
        return Some(error("a value stands after `=`", at, at).help(help));
    }
    if declares && at == first + 1 && here == "[" {
        let close = (at..piece.end).find(|&mark| source.is_symbol(mark, "]"))?;
        let name = if word(close + 1) { source.word(close + 1) } else { "name" };
        let help = format!("write `{begin} {name} {}`", slice(source, at, close));
        return Some(error("the unit stands after the name", at, close).help(help));
    }
    if let Some(at) = [at - 1, at].into_iter().find(|&at| matches!(source.word(at), "elseif" | "elif" | "elsif")) {
        let message = format!("`{}` is two words", source.word(at));
        return Some(error(&message, at, at).help("write `else if`"));
    }
    if here == "?" {
        let from = (first..at).find(|&mark| source.is_symbol(mark, "=")).map_or(first, |sign| sign + 1);
        let colon = (at + 1..piece.end).find(|&mark| source.is_symbol(mark, ":"));
        let parts = colon.filter(|&colon| from < at && at + 1 < colon && colon + 1 < piece.end).map(|colon| {
            let part = |first: usize, last: usize| slice(source, first, last);
            format!(
                "write `if {} then {} else {}`",
                part(from, at - 1),
                part(at + 1, colon - 1),
                part(colon + 1, piece.end - 1)
            )
        });
        let help = parts.filter(|help| is_short(help)).unwrap_or("write `if condition then a else b`".into());
        return Some(error("a choice is written in words", at, at).help(help));
    }
    if matches!(here, "for" | "while" | "foreach" | "loop" | "repeat") && source.marks[at].first_on_line {
        let help = "every equation holds at every instant; for several equal parts write\n`part el[i in 1 .. 4] = Model(k = i)` and `sum(el.f)`";
        return Some(error("there are no loops", at, at).help(help).about_word(WordMistake::Block));
    }
    if begin == "fn" && here == "{" {
        let help = format!("write `{} = ...`; several steps are several functions", slice(source, first, at - 1));
        return Some(error("a function is one expression", at, at).help(help));
    }
    if begin == "part" && before == "[" && number(at) {
        let (name, last) = (source.word(first + 1), at);
        return Some(
            error("several parts have an index", at - 1, last).help(format!("write `{name}[i in 1 .. {here}]`")),
        );
    }
    // An argument without its name: `LuGre(10 mm/s)`.
    let value = matches!(source.kind(at), Some(TokenKind::Number)) || here == "-";
    if value && matches!(before, "(" | ",") && stop.expected.iter().any(|expected| expected == "a name") {
        let open = (first..at).rev().find(|&mark| source.is_symbol(mark, "(")).filter(|&mark| mark > first);
        let model = open.map_or("Model", |open| source.word(open - 1));
        let given = operand_at(source, at);
        let help = format!("write `NAME = {given}` with the name of an input or param; `fric doc {model}` lists them");
        return Some(error("an argument has a name", at, at).help(help));
    }
    // An argument without its name: `LuGre(v)`.
    let named = stop.expected.iter().any(|expected| expected == "`=`");
    if named && matches!(here, "," | ")") && word(at - 1) && matches!(source.word(at - 2), "(" | ",") {
        let help = format!("write `{before} = {before}`, the name of the model's input or param before its value");
        return Some(error("an argument has a name", at - 1, at - 1).help(help));
    }
    let text = source.kind(at) == Some(TokenKind::Text);
    if text && begin == "require" && stop.expected.iter().any(|expected| expected == "`,`") {
        return Some(error("a comma stands before the message", at, at).help(format!("write `, {here}`")));
    }
    if begin == "table" && here == "," && stop.expected.iter().any(|expected| expected == "`:`") {
        let help = "write each point as `x: y`, and commas between them";
        return Some(error("a colon stands between the values of a point", at, at).help(help));
    }
    None
}

/// Reports a missing end of a statement.
fn missing(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    let last = piece.end - 1;
    if stop.at < piece.end || last <= piece.start {
        return None;
    }
    let expects = |what: &str| stop.expected.iter().any(|expected| expected == what);
    let (wanted, help) = match source.word(piece.start) {
        "part" if expects("`(`") && source.kind(last) == Some(TokenKind::Word) => {
            ("`(`", format!("write `{}()`, with arguments in the brackets", source.word(last)))
        }
        "plot" if source.is_word(last, "against") => {
            let help = "in a file write `sweep v = 1 mm/s .. 20 mm/s lin 40` and `plot final(F) against v`; a range after `against` is for the prompt";
            ("a quantity", help.to_string())
        }
        "sweep" if expects("`by`") => ("`by`", "add how far apart the values are: `by ...`".to_string()),
        _ => return None,
    };
    let message = format!("expected {wanted} here");
    Some(Diagnostic::error("E0001", message).label(source.span(last), "after this").help(help))
}

/// Reports a unit with blanks: `2 N m`, `[N m]`.
fn unit(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    let at = stop.at;
    if at <= piece.start || at >= piece.end {
        return None;
    }
    let unit_word = |at: usize| at < piece.end && source.kind(at) == Some(TokenKind::Word) && is_unit(source.word(at));
    let same_line = |at: usize| !source.marks[at].first_on_line;
    let number = (piece.start..at).rev().find(|&mark| source.kind(mark) == Some(TokenKind::Number));
    if let Some(number) = number.filter(|&number| number + 2 == at && source.kind(at - 1) == Some(TokenKind::Unit))
        && unit_word(at)
        && same_line(at)
    {
        // Up to the end of the unit: further words, and what is glued to them by a sign.
        let mut last = at;
        loop {
            let sign = last + 1 < piece.end
                && source.glued(last + 1)
                && matches!(source.word(last + 1), "/" | "*" | "·" | "^");
            let power = source.word(last + 1) == "^" && source.kind(last + 2) == Some(TokenKind::Number);
            last += match () {
                () if last + 1 < piece.end && unit_word(last + 1) && same_line(last + 1) => 1,
                () if last + 2 < piece.end && sign && source.glued(last + 2) && (unit_word(last + 2) || power) => 2,
                () => break,
            };
        }
        let (value, unit, stray) = (source.word(number), source.word(at - 1), source.word(at));
        let mut whole = unit.to_string();
        for mark in at..=last {
            if !source.glued(mark) {
                whole.push('·');
            }
            whole.push_str(source.word(mark));
        }
        return Some(
                Diagnostic::error("E0110", "a unit is written without spaces")
                    .label(
                        source.span(at - 1).to(source.span(last)),
                        format!("reads as {value} {unit}, followed by a stray name `{stray}`"),
                    )
                    .help(format!(
                        "write `{value} {whole}` (or `{value} {}`). To multiply by a variable `{stray}`, write `{value} {unit} * {stray}`",
                        whole.replace('·', "*"),
                    )),
            );
    }
    // In brackets: between the brackets are only unit words and signs.
    let open = (piece.start..at + 1).rev().find(|&mark| source.is_symbol(mark, "["))?;
    let close = (open..piece.end).find(|&mark| source.is_symbol(mark, "]"))?;
    let inside: Vec<&str> = (open + 1..close).map(|mark| source.word(mark)).collect();
    let sign = |word: &str| matches!(word, "·" | "*" | "/");
    let units = inside.len() > 1
        && inside.iter().all(|word| {
            sign(word) || word.split(['·', '*', '/', '^']).all(|part| is_unit(part) || part.parse::<i32>().is_ok())
        });
    if !units || at > close {
        return None;
    }
    let mut joined = String::new();
    for word in inside {
        if !joined.is_empty() && !sign(word) && !joined.ends_with(['·', '*', '/']) {
            joined.push('·');
        }
        joined.push_str(word);
    }
    Some(
        Diagnostic::error("E0110", "a unit is written without spaces")
            .label(source.span(open + 1).to(source.span(close - 1)), "")
            .help(format!("write `[{joined}]`")),
    )
}

/// Reports `=` in a comparison.
fn condition(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    let at = stop.at;
    // There must be an operand after the word that begins the statement.
    if at <= piece.start + 1 || at >= piece.end || !source.is_symbol(at, "=") {
        return None;
    }
    let compares = matches!(source.word(piece.start), "require" | "when" | "go" | "expect" | "stop")
        || (piece.start..at).any(|mark| source.is_word(mark, "if"));
    if !compares {
        return None;
    }
    let error = Diagnostic::error("E0001", "a comparison is written `==`").label(source.span(at), "`=` defines");
    let measured = source.is_word(piece.start, "expect") && at + 1 < piece.end;
    let right = if at + 1 < piece.end { operand_at(source, at + 1) } else { "...".to_string() };
    Some(error.help(match measured {
        // Measures are real numbers, so a comparison to the last bit is hardly intended.
        true => {
            let left = slice(source, piece.start + 1, at - 1);
            format!("a measure is compared with a tolerance: `expect {left} ~= {right} +- 1 %`")
        }
        false => format!("write `{} == {right}`", operand_before(source, piece, at)),
    }))
}

/// Reports `if`, `else`, `end` as statements.
fn branching(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    // `else` and `end` do not begin a piece, but end the statement before them.
    let ends = stop.at < piece.end
        && source.marks[stop.at].first_on_line
        && matches!(source.word(stop.at), "else" | "elseif" | "end" | "endif" | "endfunction");
    let first = if ends { stop.at } else { piece.start };
    let (mistake, message, help) = match source.word(first) {
        "if" | "else" | "elseif" => {
            let written = choice(source, first).filter(|help| is_short(help));
            (
                WordMistake::Block,
                "a choice is a value, not a statement: every equation holds at all times",
                format!(
                    "write `{}`; states that switch are a `mode`",
                    written.unwrap_or("F = if v > 0 m/s then a else b".into())
                ),
            )
        }
        "end" | "endif" | "endfunction" if first + 1 >= piece.end || ends || source.marks[first + 1].first_on_line => {
            (WordMistake::BlockEnd, "a block ends with `}`", "remove it, or write `}`".into())
        }
        _ => return None,
    };
    Some(Diagnostic::error("E0001", message).label(source.span(first), "").help(help).about_word(mistake))
}

/// The last mark of the line on which a mark stands.
fn line_end(source: &Source, at: usize) -> usize {
    (at + 1..source.marks.len()).find(|&mark| source.marks[mark].first_on_line).unwrap_or(source.marks.len()) - 1
}

/// `NAME = VALUE` on the line of a mark.
fn assignment<'t>(source: &Source<'t>, at: usize) -> Option<(&'t str, &'t str)> {
    let end = line_end(source, at);
    let sign = (at..end).find(|&mark| source.is_symbol(mark, "="))?;
    let value_end = if source.word(end) == ";" { end - 1 } else { end };
    (sign > at && value_end > sign).then(|| (slice(source, at, sign - 1), slice(source, sign + 1, value_end)))
}

/// The choice that a statement `if`, or a loop `while`, with one equation in each branch means: `let F = if v > 0 m/s then
/// Fc else -Fc`.
fn choice(source: &Source, first: usize) -> Option<String> {
    let end = line_end(source, first);
    if !matches!(source.word(first), "if" | "while") || end <= first {
        return None;
    }
    let condition = slice(source, first + 1, end).trim_end_matches(',');
    let Some((name, yes)) = (end + 1 < source.marks.len()).then(|| assignment(source, end + 1)).flatten() else {
        return Some(format!("F = if {condition} then a else b"));
    };
    let is_declared = (1..source.marks.len())
        .any(|mark| source.word(mark) == name && matches!(source.word(mark - 1), "let" | "output"));
    let declared = if name.contains('/') || is_declared { "" } else { "let " };
    let after = line_end(source, end + 1) + 1;
    let other = (source.marks.len() > after + 1 && source.is_word(after, "else"))
        .then(|| assignment(source, after + 1))
        .flatten()
        .filter(|(other, _)| *other == name);
    Some(format!("{declared}{name} = if {condition} then {yes} else {}", other.map_or("…", |(_, no)| no)))
}

/// Whether a help fits into a line or two.
fn is_short(help: &str) -> bool {
    help.len() <= 110 && !help.contains('\n')
}

/// Reports `if` without `then` or `else`.
fn branch(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    let missing = ["then", "else"].into_iter().find(|word| stop.expected.contains(&format!("`{word}`")))?;
    let condition = (piece.start..stop.at).rev().find(|&at| source.is_word(at, "if"))?;
    // If the word occurs later, the mistake is before it.
    if (stop.at..piece.end).any(|at| source.is_word(at, missing)) {
        return None;
    }
    let asked = slice(source, condition, stop.at.max(condition + 2) - 1);
    let (message, help) = match missing {
        "then" if is_short(asked) => ("`if` needs a `then`", format!("write `{asked} then a else b`")),
        "then" => ("`if` needs a `then`", "write `if c then a else b`".into()),
        _ => ("`if` needs an `else`", "both cases have a value: add `else ...`".into()),
    };
    let end = source.span(stop.at.max(piece.start + 1) - 1);
    Some(
        Diagnostic::error("E0001", message)
            .label(source.span(condition).to(end), format!("`{missing}` is missing after this"))
            .help(help),
    )
}

/// Reports a keyword in the place of a name.
fn reserved(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    let at = stop.at;
    if at >= piece.end || source.kind(at) != Some(TokenKind::Word) || !is_keyword(source.word(at)) {
        return None;
    }
    let word = source.word(at);
    let named = stop.expected.iter().any(|expected| expected == "a name");
    let value = stop.expected.iter().any(|expected| expected == "a value");
    (named || value && !matches!(word, "then" | "else" | "in" | "and" | "or")).then(|| {
        Diagnostic::error("E0001", format!("`{word}` is a word of the language"))
            .about_word(WordMistake::Reserved)
            .label(source.span(at), if named { "expected a name" } else { "expected a value" })
            .help(format!("as a name write for example `{word}_`"))
    })
}

/// Reports two operands without an operator between them.
fn neighbours(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    let at = stop.at;
    if at <= piece.start || at >= piece.end || !stop.expected.iter().any(|expected| expected == "an operator") {
        return None;
    }
    let begins = match source.kind(at) {
        Some(TokenKind::Word) => !is_keyword(source.word(at)),
        Some(TokenKind::Number) => true,
        Some(TokenKind::Symbol) => source.word(at) == "(",
        _ => false,
    };
    if !begins || !source.ends_operand(at - 1) || source.kind(at - 1) == Some(TokenKind::Text) {
        return None;
    }
    // `2 k x`: the word in the place of a unit is not a unit.
    let at = match source.kind(at - 1) {
        Some(TokenKind::Unit)
            if at - 1 > piece.start && !is_unit(source.word(at - 1)) && is_name(source.word(at - 1)) =>
        {
            at - 1
        }
        _ => at,
    };
    let left = operand_before(source, piece, at);
    if let word @ ("after" | "before") = source.word(at) {
        let error =
            Diagnostic::error("E0111", format!("`{word}` begins a window, which belongs to the whole expectation"));
        let help = format!("write it after the comparison: `expect first(…) < 10 s {word} 9 s`");
        return Some(error.label(source.span(at), "").help(help));
    }
    // `run M() for 1 s set k = 1 N/m`
    if source.word(at) == "set" && source.kind(at + 1) == Some(TokenKind::Word) {
        let name = source.word(at + 1);
        return Some(Diagnostic::error("E0001", "there is no statement `set`").label(source.span(at), "").help(
            format!("give `{name}` where the model is run, `run M({name} = ...)`, or in a `sweep {name} = ...`"),
        ));
    }
    if left == "inf" {
        let error = Diagnostic::error("E0111", "`inf` has no unit");
        return Some(error.label(source.span(at), "").help("leave the unit out: `inf` fits every quantity"));
    }
    let right = operand_at(source, at);
    Some(
        Diagnostic::error("E0111", format!("an operator is missing before `{}`", source.word(at)))
            .label(source.span(at), "")
            .help(format!("to multiply write `{left} * {right}`")),
    )
}

/// Reports parentheses in a unit, such as `1 1/(N·m)` or `[N/(m*s)]`: a unit is read from left to right.
fn unit_in_parentheses(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    if piece.start >= piece.end {
        return None;
    }
    let (begin, end) = (source.marks[piece.start].token.start, source.marks[piece.end - 1].token.end);
    let text = &source.text[begin..end];
    let power = |atom: &str| atom.split('^').next().is_some_and(is_unit);
    text.match_indices("/(").find_map(|(slash, _)| {
        let sign = |c: char| c.is_alphanumeric() || matches!(c, '·' | '*' | '/' | '^' | '%' | '°');
        let first =
            text[..slash].rfind(|c| !sign(c)).map_or(0, |at| at + text[at..].chars().next().map_or(1, char::len_utf8));
        let close = slash + text[slash..].find(')')?;
        let (above, below) = (&text[first..slash], &text[slash + 2..close]);
        let below: Vec<&str> = below.split(['·', '*']).map(str::trim).collect();
        let units =
            above.split(['·', '*', '/']).all(|atom| atom == "1" || power(atom)) && below.iter().all(|atom| power(atom));
        let from = (piece.start..piece.end).find(|&mark| source.marks[mark].token.end > begin + first)?;
        let to = (piece.start..piece.end).rfind(|&mark| source.marks[mark].token.start <= begin + close)?;
        if !units || above.is_empty() || !(from.saturating_sub(1)..=to + 1).contains(&stop.at) {
            return None;
        }
        let error =
            Diagnostic::error("E0001", "a unit has no parentheses").label(source.span(from).to(source.span(to)), "");
        Some(error.help(format!("it is read from left to right: write `{above}/{}`", below.join("/"))))
    })
}

/// Reports the unit of a declaration without brackets: `input v m/s`.
fn bare_unit(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    let at = stop.at;
    if at != piece.start + 2
        || at >= piece.end
        || !stop.expected.iter().any(|expected| expected == "a unit in brackets")
    {
        return None;
    }
    let first = if source.is_symbol(at, "(") { at + 1 } else { at };
    let end = (first..piece.end).find(|&mark| {
        !is_unit(source.word(mark)) && !matches!(source.word(mark), "/" | "*" | "·" | "^" | "1" | "2" | "3")
    });
    let end = end.unwrap_or(piece.end);
    let close = if first > at && source.is_symbol(end, ")") { end } else { end - 1 };
    (end > first && is_unit(source.word(first))).then(|| {
        Diagnostic::error("E0001", "the unit of a declaration stands in brackets")
            .label(source.span(at).to(source.span(close)), "")
            .help(format!(
                "write `{} [{}]`",
                slice(source, piece.start, piece.start + 1),
                slice(source, first, end - 1)
            ))
    })
}

/// Reports the name of a model that begins with a lower-case letter.
fn model_name(source: &Source, piece: Piece, stop: &Stop) -> Option<Diagnostic> {
    let at = stop.at;
    if at >= piece.end || source.kind(at) != Some(TokenKind::Word) {
        return None;
    }
    stop.expected.iter().find(|expected| *expected == CAPITAL)?;
    let word = source.word(at).trim_start_matches('_');
    let mut letters = word.chars();
    let capital: String = letters.next().map(|c| c.to_ascii_uppercase()).into_iter().chain(letters).collect();
    Some(
        Diagnostic::error("E0001", "names of models, interfaces and devices begin with a capital letter")
            .label(source.span(at), "")
            .help(format!("write `{capital}`")),
    )
}

/// The entry of `expected` for a name that begins with a capital letter.
pub(crate) const CAPITAL: &str = "a name with a capital letter";

/// The general message for an unrecognised mistake: the token found, and what was expected.
fn plain(source: &Source, piece: Piece, stop: &Stop) -> Diagnostic {
    let mut expected = stop.expected.clone();
    // An operator is always possible where an expression may continue; what may follow the expression is more helpful.
    if expected.len() > 1 {
        expected.retain(|word| word != "an operator");
    }
    if expected.iter().any(|word| word == "a value") {
        expected.retain(|word| !matches!(word.as_str(), "a name" | "`(`"));
    }
    for vague in ["the next statement", "a unit"] {
        if expected.len() > 1 {
            expected.retain(|word| word != vague);
        }
    }
    let wanted = match expected.as_slice() {
        [] => String::new(),
        [one] => format!("expected {one}"),
        _ if stop.at == piece.start => "expected a statement".to_string(),
        [most @ .., last] if most.len() < 4 => format!("expected {} or {last}", most.join(", ")),
        _ => String::new(),
    };
    if stop.at >= piece.end {
        let message =
            if wanted.is_empty() { "something is missing here".to_string() } else { format!("{wanted} here") };
        return Diagnostic::error("E0001", message).label(source.span(piece.end - 1), "after this");
    }
    let found = source.word(stop.at);
    let shown: String = found.chars().take(30).collect();
    Diagnostic::error("E0001", format!("`{shown}` does not fit here"))
        .label(source.span(stop.at), wanted)
        .about_word(WordMistake::Misfit)
}

/// The operand that begins at `at`, as far as a message needs it: a number with sign and unit, a path, a call.
pub(crate) fn operand_at(source: &Source, at: usize) -> String {
    let mut last = at;
    if source.is_symbol(last, "-") {
        last += 1;
    }
    let first = last;
    if source.kind(last) == Some(TokenKind::Number) && source.kind(last + 1) == Some(TokenKind::Unit) {
        last += 1;
    }
    while source.is_symbol(last + 1, ".") && source.kind(last + 2) == Some(TokenKind::Word) {
        last += 2;
    }
    if last >= source.marks.len() {
        return String::new();
    }
    let called = source.kind(first) == Some(TokenKind::Word) && source.is_symbol(last + 1, "(");
    let text = slice(source, at, last);
    match source.word(first) {
        "(" => format!("{}...)", slice(source, at, first)),
        _ if called => format!("{text}(...)"),
        _ => text.to_string(),
    }
}

/// The operand that ends before `at`, if it is short enough for a message.
fn operand_before(source: &Source, piece: Piece, at: usize) -> String {
    let last = at - 1;
    let mut first = last;
    if source.kind(last) == Some(TokenKind::Unit) && last > piece.start {
        first = last - 1;
    }
    while first > piece.start + 1 && source.is_symbol(first - 1, ".") {
        first -= 2;
    }
    if matches!(source.word(last), ")" | "]") { "(...)".to_string() } else { slice(source, first, last).to_string() }
}

fn slice<'t>(source: &Source<'t>, first: usize, last: usize) -> &'t str {
    &source.text[source.marks[first].token.start..source.marks[last].token.end]
}
