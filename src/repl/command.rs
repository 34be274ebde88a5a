//! Classifies a line: a command, an item of the language, an instance, a setting or an expression.
//!
//! In: a line. Out: a [`LineKind`]. Knows no session: names are not resolved here.

use grammar::tokens::{TokenKind, tokens};

/// Commands: name, usage, effect.
pub const COMMANDS: &[(&str, &str, &str)] = &[
    ("use", "use \"FILE.fric\" | use std.friction", "brings in the models and experiments of a file or the library"),
    ("run", "run NAME [for 20 s]", "runs an experiment, an instance, or Model(…) from its start"),
    ("step", "step 1 ms", "one fixed step by hand; shows every quantity"),
    ("plot", "plot EXPR, … [against EXPR] [to FILE.svg]", "draws over the last run"),
    (
        "",
        "plot EXPR against PATH = A .. B [steady]",
        "draws over an input or a parameter; steady: at rest at each point",
    ),
    ("expect", "expect max(x) < 1 mm", "checks the last run now; `save` writes it"),
    ("explain", "explain f.z | explain LuGre", "unit, range, equation, how it is stepped"),
    ("show", "show f | show max(x)", "the values of an instance, or of an expression; its name alone does the same"),
    ("unit", "unit f.g", "the unit of a quantity or an expression"),
    ("doc", "doc LuGre", "ports, parameters and equations of a model"),
    ("deps", "deps f.F", "what a quantity needs, down to inputs and parameters"),
    ("diagram", "diagram Servo [to FILE.svg]", "the parts of a model and their connections"),
    ("names", "names", "what is there: instances, models, experiments"),
    ("lints", "lints", "warnings of the files in use"),
    ("why", "why E0401", "what an error or a warning means, with an example"),
    ("watch", "watch \"FILE.fric\" [NAME]", "runs on each save, states carried over; Ctrl-C ends it"),
    ("characterise", "characterise LuGre(vd = 10 mm/s)", "puts a friction model through the standard battery"),
    ("save", "save FILE.fric", "writes instances, settings and expectations as an experiment"),
    ("help", "help [COMMAND]", "this list"),
    ("quit", "quit", "ends the session; so does Ctrl-D"),
];

/// Keywords that begin an item.
const ITEMS: &[&str] = &["import", "const", "fn", "table", "interface", "model", "experiment", "fit", "device", "rig"];

/// A command.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[allow(missing_docs)]
pub enum PromptCommand {
    Use,
    Run,
    Step,
    Plot,
    Expect,
    Explain,
    Show,
    Unit,
    Doc,
    Deps,
    Diagram,
    Names,
    Lints,
    Why,
    Watch,
    Characterise,
    Save,
    Help,
    Quit,
}

impl PromptCommand {
    fn named(word: &str) -> Option<PromptCommand> {
        Some(match word {
            "use" => PromptCommand::Use,
            "run" => PromptCommand::Run,
            "step" => PromptCommand::Step,
            "plot" => PromptCommand::Plot,
            "expect" => PromptCommand::Expect,
            "explain" => PromptCommand::Explain,
            "show" => PromptCommand::Show,
            "unit" => PromptCommand::Unit,
            "doc" => PromptCommand::Doc,
            "deps" => PromptCommand::Deps,
            "diagram" => PromptCommand::Diagram,
            "names" => PromptCommand::Names,
            "lints" => PromptCommand::Lints,
            "why" => PromptCommand::Why,
            "watch" => PromptCommand::Watch,
            "characterise" | "characterize" => PromptCommand::Characterise,
            "save" => PromptCommand::Save,
            "help" => PromptCommand::Help,
            "quit" | "exit" => PromptCommand::Quit,
            _ => return None,
        })
    }
}

/// The kind of a line.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum LineKind {
    /// Blanks and comments.
    Nothing,
    /// A command, and the text after its name.
    Command(PromptCommand, String),
    /// `model M { … }`, `const k = 2 N/m`.
    Item,
    /// `f = LuGre(vd = 10 mm/s)`: the name, and the offset of the instance.
    Instance(String, usize),
    /// `f.Fs = 1 N`: the path, and the offset of the value.
    Setting(String, usize),
    /// `10 mm * 2 N/m`
    Expression,
}

/// Classifies a line.
pub fn read(line: &str) -> LineKind {
    let words: Vec<_> = tokens(line).into_iter().filter(|token| !token.is_trivia()).collect();
    let Some(first) = words.first() else { return LineKind::Nothing };
    let word = first.text(line);
    let next = words.get(1).map(|token| token.text(line));
    if let Some(command) = PromptCommand::named(word) {
        let glued = words.get(1).is_some_and(|token| token.start == first.end);
        let name = matches!(next, Some("=" | ".")) || (glued && next == Some("("));
        if !name {
            return LineKind::Command(command, line[first.end..].trim().to_string());
        }
    }
    if ITEMS.contains(&word) {
        return LineKind::Item;
    }
    let Some(equals) = words.iter().position(|token| token.text(line) == "=") else { return LineKind::Expression };
    let path = &words[..equals];
    // `for i = 1:3`: two words in a row are no path.
    let apart = |pair: &[grammar::tokens::Token]| pair.iter().all(|token| token.kind == TokenKind::Word);
    if path.windows(2).any(apart) {
        return LineKind::Expression;
    }
    let of_a_path = |at: usize| match path[at].kind {
        TokenKind::Word | TokenKind::Number => true,
        TokenKind::Symbol => matches!(path[at].text(line), "." | "[" | "]"),
        _ => false,
    };
    if equals == 0 || path[0].kind != TokenKind::Word || !(0..path.len()).all(of_a_path) {
        return LineKind::Expression;
    }
    let left: String = path.iter().map(|token| token.text(line)).collect();
    let begin = words.get(equals + 1).map_or(line.len(), |token| token.start);
    let behind = &words[equals + 1..];
    let behind = if behind.first().is_some_and(|token| token.text(line) == "rotary") { &behind[1..] } else { behind };
    let model = behind.first().is_some_and(|token| {
        token.kind == TokenKind::Word && token.text(line).starts_with(|c: char| c.is_ascii_uppercase())
    });
    let called = behind.get(1).is_some_and(|token| token.text(line) == "(");
    match model && (called || behind.len() == 1) && !left.contains('.') {
        true => LineKind::Instance(left, begin),
        false => LineKind::Setting(left, begin),
    }
}

/// Whether more lines must follow: a bracket is open, or an operator lacks its right operand.
pub fn incomplete(text: &str) -> bool {
    let mut depth = 0i64;
    let mut last = "";
    for token in tokens(text) {
        if token.is_trivia() {
            continue;
        }
        last = token.text(text);
        if token.kind == TokenKind::Symbol {
            match last {
                "(" | "{" | "[" => depth += 1,
                ")" | "}" | "]" => depth -= 1,
                _ => {}
            }
        }
    }
    let waits = matches!(last, "+" | "-" | "*" | "/" | "^" | "," | "=" | "<" | ">" | "<=" | ">=" | "and" | "or");
    depth > 0 || (depth == 0 && waits && !text.ends_with("\n\n"))
}

/// Splits a text of several lines, as a terminal delivers pasted text, into inputs; each continues until it is
/// complete.
pub fn inputs(text: &str) -> Vec<&str> {
    let mut found = Vec::new();
    let (mut begin, mut end) = (0, 0);
    for line in text.split_inclusive('\n') {
        end += line.len();
        if !incomplete(&text[begin..end]) {
            found.push(&text[begin..end]);
            begin = end;
        }
    }
    if begin < text.len() {
        found.push(&text[begin..]);
    }
    found
}

/// Splits `… to FILE.svg` off the end of a command: returns the text before it, and the file.
///
/// # Errors
/// What is wrong with the name of the file.
pub fn cut_to(rest: &str) -> Result<(&str, Option<&str>), String> {
    let words: Vec<_> = tokens(rest).into_iter().filter(|token| token.text(rest) == "to").collect();
    let Some(word) = words.last() else { return Ok((rest, None)) };
    let file = rest[word.end..].trim().trim_matches('"');
    match file.rsplit_once('.') {
        _ if file.is_empty() => Err("to which file? `to x.svg`, `to x.png` or `to x.pdf`".into()),
        Some((_, "svg" | "png" | "pdf")) => Ok((rest[..word.start].trim_end(), Some(file))),
        _ => Err(format!("the name of a picture ends in .svg, .png or .pdf, not `{file}`")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_classified() {
        let instance = |name: &str, at| LineKind::Instance(name.into(), at);
        let setting = |path: &str, at| LineKind::Setting(path.into(), at);
        assert_eq!(read("  // nothing"), LineKind::Nothing);
        assert_eq!(read("10 mm * 2 N/m"), LineKind::Expression);
        assert_eq!(read("f = LuGre(vd = 10 mm/s)"), instance("f", 4));
        assert_eq!(read("f = rotary LuGre()"), instance("f", 4));
        assert_eq!(read("f = LuGre"), instance("f", 4));
        assert_eq!(read("f.Fs = 1 N"), setting("f.Fs", 7));
        assert_eq!(read("f.el[2].k = 1 N/m"), setting("f.el[2].k", 12));
        assert_eq!(read("s.fr = Karnopp()"), setting("s.fr", 7));
        assert_eq!(read("f.F == 1 N"), LineKind::Expression);
        assert_eq!(read("model M {"), LineKind::Item);
        assert_eq!(read("run hunting for 20 s"), LineKind::Command(PromptCommand::Run, "hunting for 20 s".into()));
        assert_eq!(read("step(1 s, 2 N)"), LineKind::Expression);
        assert_eq!(read("plot (f.F)"), LineKind::Command(PromptCommand::Plot, "(f.F)".into()));
        assert_eq!(read("unit = LuGre()"), instance("unit", 7));
    }

    #[test]
    fn open_brackets_and_waiting_operators_ask_for_more() {
        assert!(incomplete("model M {\n  input v [m/s]"));
        assert!(!incomplete("model M {\n  input v [m/s]\n}"));
        assert!(incomplete("f.F +"));
        assert!(!incomplete("f.F + 1 N") && !incomplete("f.F)"));
    }

    #[test]
    fn pasted_text_is_split_into_inputs() {
        let text = "const m = 2 kg\nmodel M {\n  input v [m/s]\n}\n1 N +\n2 N\nf(";
        assert_eq!(inputs(text), ["const m = 2 kg\n", "model M {\n  input v [m/s]\n}\n", "1 N +\n2 N\n", "f("]);
        assert_eq!(inputs("1 N"), ["1 N"]);
        assert_eq!(inputs(""), [""; 0]);
    }

    #[test]
    fn files_are_split_off() {
        assert_eq!(cut_to("x, v to a.svg"), Ok(("x, v", Some("a.svg"))));
        assert_eq!(cut_to("x to \"out/a.png\""), Ok(("x", Some("out/a.png"))));
        assert_eq!(cut_to("x to a.pdf"), Ok(("x", Some("a.pdf"))));
        assert_eq!(cut_to("x"), Ok(("x", None)));
        assert!(cut_to("x to a.gif").is_err() && cut_to("x to ").is_err());
    }

    #[test]
    fn every_command_that_is_listed_is_known() {
        for (name, ..) in COMMANDS.iter().filter(|(name, ..)| !name.is_empty()) {
            assert!(PromptCommand::named(name).is_some(), "{name}");
        }
    }
}
