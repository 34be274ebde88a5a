//! What people say to a rig that runs: one grammar for the prompt of `fric hil`, for `fric-rig say`, and for the pages of
//! a panel.
//!
//! In: a line. Out: what it asks for, or why it is no command: the word, what was expected, and what to write instead.
//! Knows no parameter: their values stay text until a [`Judge`](super::live::Judge) reads them.
//!
//! ```text
//! enable | arm | stop | reset | set PATH = VALUE, … | mark WORDS   everywhere; `reset` is always refused
//! again                                                           at the prompt and on pages
//! show | help | quit                                              at the prompt
//! take | give | refuse                                            on pages
//! ```

use std::fmt;
use std::str::from_utf8;

/// Most bytes of a line: a page's message, which also has a number and a time, has at most 4096.
pub const LONGEST: usize = 4000;
/// Most bytes of a mark.
pub const MARK_MOST: usize = 96;

/// Reason why `reset` is always refused.
pub const NO_RESET: &str = "a stop is final: the rig ends as soon as its drives are at rest. Start it again, so that drives \
                            are identified and tested anew";
/// Reason why `again` is refused before the end of a run.
pub const RUNS: &str = "the rig runs: stop it first";

/// What can be said, for messages.
const SAY: &str = "say enable, arm, set PATH = VALUE, mark WORDS or stop";
/// An example, for messages.
const EXAMPLE: &str = "write `set PATH = VALUE`, for example `set fr.Fs = 2 N`";

/// A parameter and its new value, as they were typed.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Assignment {
    /// Dotted path: `fr.Fs`.
    pub path: String,
    /// The value: `2 N`.
    pub value: String,
}

/// Words of an operator for the log.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Mark {
    bytes: [u8; MARK_MOST],
    len: usize,
}

impl Mark {
    /// A mark of these words.
    ///
    /// # Errors
    /// Why they are none.
    pub fn new(words: &str) -> Result<Mark, String> {
        let words = words.trim();
        if words.is_empty() {
            return Err("a mark has words: `mark second bearing`".into());
        }
        if words.len() > MARK_MOST || words.chars().any(char::is_control) {
            return Err(format!("a mark is a line of at most {MARK_MOST} bytes, and this one has {}", words.len()));
        }
        let mut bytes = [0; MARK_MOST];
        bytes[..words.len()].copy_from_slice(words.as_bytes());
        Ok(Mark { bytes, len: words.len() })
    }

    /// Its bytes.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

/// Where a line is said.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Door {
    /// At the prompt of `fric hil`.
    Prompt,
    /// By `fric-rig say`.
    Say,
    /// On a page of a panel.
    Page,
}

/// A line.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Line {
    /// Enable the drives, at zero command.
    Enable,
    /// Connect the outputs to the model.
    Arm,
    /// Controlled stop.
    Stop,
    /// Go on after a stop.
    Reset,
    /// New values of parameters, as one set.
    Set(Vec<Assignment>),
    /// Words for the log.
    Mark(Mark),
    /// The next run.
    Again,
    /// The parameters that may change, with their values.
    Show,
    /// What can be said.
    Help,
    /// Stop, and end the program.
    Quit,
    /// A page asks to operate the rig.
    Take,
    /// It lets the page that asks operate it.
    Give,
    /// It does not.
    Refuse,
}

/// The commands of one word.
const ALONE: [Line; 11] = [
    Line::Enable,
    Line::Arm,
    Line::Stop,
    Line::Reset,
    Line::Again,
    Line::Show,
    Line::Help,
    Line::Quit,
    Line::Take,
    Line::Give,
    Line::Refuse,
];

impl Line {
    /// Its first word.
    pub fn word(&self) -> &'static str {
        match self {
            Line::Enable => "enable",
            Line::Arm => "arm",
            Line::Stop => "stop",
            Line::Reset => "reset",
            Line::Set(_) => "set",
            Line::Mark(_) => "mark",
            Line::Again => "again",
            Line::Show => "show",
            Line::Help => "help",
            Line::Quit => "quit",
            Line::Take => "take",
            Line::Give => "give",
            Line::Refuse => "refuse",
        }
    }

    /// Reads a line.
    ///
    /// # Errors
    /// Why it is none.
    pub fn read(text: &str) -> Result<Line, String> {
        let text = text.trim();
        if let Some(odd) = text.chars().find(|c| c.is_control()) {
            return Err(format!("a command is one line of text, and this one contains `{}`", odd.escape_debug()));
        }
        let (word, rest) = text.split_once(' ').map_or((text, ""), |(word, rest)| (word, rest.trim()));
        let line = match word {
            "" => return Err(format!("nothing was said: {SAY}")),
            "set" if rest.is_empty() => return Err(format!("`set` names no parameter: {EXAMPLE}")),
            "set" => Line::Set(assignments(rest)?),
            "mark" => Line::Mark(Mark::new(rest)?),
            _ => match ALONE.into_iter().find(|line| line.word() == word) {
                Some(line) if rest.is_empty() => line,
                Some(_) => {
                    return Err(format!("`{word}` stands alone, and `{}` comes after it: say `{word}`", short(rest)));
                }
                None => return Err(unknown(word)),
            },
        };
        let len = line.to_string().len();
        if len > LONGEST {
            return Err(format!("a command has at most {LONGEST} bytes, and this one has {len}: say it in parts"));
        }
        Ok(line)
    }

    /// The same line, if it has a meaning here.
    ///
    /// # Errors
    /// Why it has none.
    pub fn at(self, door: Door) -> Result<Line, String> {
        let word = self.word();
        match (&self, door) {
            (Line::Reset, _) => Err(NO_RESET.into()),
            (Line::Show | Line::Help | Line::Quit, Door::Say | Door::Page) => {
                Err(format!("`{word}` is for the prompt of `fric hil`: {SAY}"))
            }
            (Line::Take | Line::Give | Line::Refuse, Door::Prompt | Door::Say) => Err(format!(
                "`{word}` is for the pages of a panel, one of which operates the rig: here nobody need ask"
            )),
            (Line::Again, Door::Say) => {
                Err("`again` is for `fric hil --panel`: say stop, then `fric-rig start`".into())
            }
            _ => Ok(self),
        }
    }

    /// Whether it waits for a cycle: then it is refused if it is old, and a page must operate the rig to say it.
    pub fn waits(&self) -> bool {
        match self {
            Line::Enable | Line::Arm | Line::Set(_) | Line::Mark(_) => true,
            Line::Stop | Line::Reset | Line::Again | Line::Show | Line::Help | Line::Quit => false,
            Line::Take | Line::Give | Line::Refuse => false,
        }
    }
}

impl fmt::Display for Line {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.word())?;
        match self {
            Line::Set(all) => {
                for (k, Assignment { path, value }) in all.iter().enumerate() {
                    write!(f, "{} {path} = {value}", if k == 0 { "" } else { "," })?;
                }
                Ok(())
            }
            Line::Mark(mark) => write!(f, " {}", from_utf8(mark.bytes()).expect("it was made from text")),
            Line::Enable | Line::Arm | Line::Stop | Line::Reset | Line::Again => Ok(()),
            Line::Show | Line::Help | Line::Quit | Line::Take | Line::Give | Line::Refuse => Ok(()),
        }
    }
}

/// Reads `PATH = VALUE, …`.
///
/// # Errors
/// What is wrong with it.
pub fn assignments(text: &str) -> Result<Vec<Assignment>, String> {
    let one = |one: &str| match one.split_once('=').map(|(path, value)| (path.trim(), value.trim())) {
        None if one.trim().is_empty() => {
            Err("a comma stands between two values: write `set PATH = VALUE, PATH = VALUE`".into())
        }
        None => Err(format!("`{}` has no value: {EXAMPLE}", short(one.trim()))),
        Some(("", value)) => Err(format!("`= {}` has no parameter before it: {EXAMPLE}", short(value))),
        Some((path, "")) => Err(format!("`{} =` has no value after it: {EXAMPLE}", short(path))),
        Some((path, value)) => Ok(Assignment { path: path.into(), value: value.into() }),
    };
    text.split(',').map(one).collect()
}

/// Splits `@TIME WORDS`: a time that was seen before the words were said, and the words.
pub fn stamped(text: &str) -> (Option<&str>, &str) {
    match text.trim().strip_prefix('@').and_then(|rest| rest.split_once(' ')) {
        Some((time, words)) => (Some(time), words.trim()),
        None => (None, text.trim()),
    }
}

/// What is wrong with a first word.
fn unknown(word: &str) -> String {
    let words = ALONE.iter().map(Line::word).chain(["set", "mark"]);
    let near = words.map(|known| (distance(&word.to_lowercase(), known), known)).min().filter(|(far, _)| *far <= 1);
    match near {
        Some((_, near)) => format!("`{}` is no command; did you mean `{near}`?", short(word)),
        None => format!("`{}` is no command: {SAY}", short(word)),
    }
}

/// The beginning of a text, for messages.
fn short(text: &str) -> String {
    const MOST: usize = 40;
    let begin: String = text.chars().take(MOST).collect();
    format!("{}{}", begin.escape_debug(), if begin.len() < text.len() { "…" } else { "" })
}

/// Levenshtein distance of two names: insertions, deletions and substitutions of a character.
pub(super) fn distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.chars().enumerate() {
        let mut corner = std::mem::replace(&mut row[0], i + 1);
        for (j, y) in b.iter().enumerate() {
            let changed = corner + usize::from(x != *y);
            corner = row[j + 1];
            row[j + 1] = changed.min(corner + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;

    const PARTS: &[&str] = &[
        "enable",
        "arm",
        "stop",
        "reset",
        "again",
        "set",
        "set ",
        "mark",
        "mark ",
        "show",
        "help",
        "quit",
        "take",
        "give",
        "refuse",
        " ",
        "  ",
        ",",
        "=",
        "fr.Fs",
        "fr.Fs = 2 N",
        "d=0.1 N·m·s/rad",
        "second bearing",
        "1e3",
        "@12",
        "@",
        "STOP",
        "stpo",
        "\t",
        "\n",
        "\r",
        "\u{202e}",
        "\u{7}",
        "\u{a0}",
        "µ",
        "\u{301}",
        "-",
        "0",
    ];

    /// One to `most` of these letters.
    fn word(chance: &mut Chance, most: u64, letters: &str) -> String {
        let letters: Vec<char> = letters.chars().collect();
        (0..1 + chance.below(most)).map(|_| letters[chance.below(letters.len() as u64) as usize]).collect()
    }

    /// A line that keeps the grammar, and what it must say.
    fn valid(chance: &mut Chance) -> (String, Line) {
        let pick = chance.below(13) as usize;
        if let Some(line) = ALONE.get(pick) {
            return (line.word().into(), line.clone());
        }
        if pick == 11 {
            let words = word(chance, 20, "ab c=,@µ");
            return match Mark::new(&words) {
                Ok(mark) => (format!("mark {words}"), Line::Mark(mark)),
                Err(_) => ("mark x".into(), Line::Mark(Mark::new("x").unwrap())),
            };
        }
        let all: Vec<(String, String)> =
            (0..1 + chance.below(5)).map(|_| (word(chance, 8, "abF.[0]"), word(chance, 8, "0123.e-Nm·/"))).collect();
        let gaps = ["", " ", "  "];
        let mut gap = || gaps[chance.below(3) as usize];
        let texts: Vec<String> =
            all.iter().map(|(path, value)| format!("{}{path}{}={}{value}{}", gap(), gap(), gap(), gap())).collect();
        let line = all.into_iter().map(|(path, value)| Assignment { path, value }).collect();
        (format!("set {}", texts.join(",")), Line::Set(line))
    }

    /// Any text: parts of lines in any order, or a valid line with characters changed, left out or added.
    fn any(chance: &mut Chance) -> String {
        if chance.below(2) == 0 {
            return (0..chance.below(7)).map(|_| PARTS[chance.below(PARTS.len() as u64) as usize]).collect();
        }
        let mut text: Vec<char> = valid(chance).0.chars().collect();
        for _ in 0..=chance.below(3) {
            let at = chance.below(text.len() as u64 + 1) as usize;
            let other = PARTS[chance.below(PARTS.len() as u64) as usize].chars().next().unwrap_or(' ');
            match chance.below(3) {
                0 if at < text.len() => text[at] = other,
                1 if at < text.len() => _ = text.remove(at),
                _ => text.insert(at, other),
            }
        }
        text.into_iter().collect()
    }

    /// Valid lines say what they were made of; any text is a line that is printed and read again to the same, or is
    /// refused with its reason, in one line. `FRIC_SEED`: another seed, `FRIC_RUNS`: more lines.
    #[test]
    fn what_is_read_is_printed_and_read_again_to_the_same() {
        let number = |name: &str, plain| std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(plain);
        let (seed, runs): (u64, u64) = (number("FRIC_SEED", 1), number("FRIC_RUNS", 50_000));
        let mut counts = [0; 3];
        for seed in seed..seed + runs {
            let mut chance = Chance(seed);
            let (text, line) = valid(&mut chance);
            assert_eq!(Line::read(&text), Ok(line), "seed {seed}: {text:?}");
            let text = any(&mut chance);
            match Line::read(&text) {
                Ok(line) => {
                    let printed = line.to_string();
                    assert_eq!(Line::read(&printed).as_ref(), Ok(&line), "seed {seed}: {text:?}");
                    assert!(
                        !printed.chars().any(char::is_control) && printed.len() <= LONGEST,
                        "seed {seed}: {text:?}"
                    );
                    // What follows a word of its own is never dropped.
                    let words = |text: &str| text.split_whitespace().map(str::to_string).collect::<String>();
                    assert_eq!(words(&printed), words(&text), "seed {seed}: {text:?}");
                    counts[usize::from(matches!(line, Line::Set(_)))] += 1;
                }
                Err(why) => {
                    let odd = |c: char| c.is_control() || ('\u{202a}'..='\u{202e}').contains(&c);
                    assert!(why.len() > 20 && why.len() < 250 && !why.contains(odd), "seed {seed}: {text:?}: {why:?}");
                    // It says what to write.
                    let helps = ["say ", "write ", "did you mean", "`mark second bearing`", "one line of text"];
                    assert!(helps.iter().any(|help| why.contains(help)), "seed {seed}: {text:?}: {why}");
                    counts[2] += 1;
                }
            }
        }
        assert!(runs < 1000 || counts.iter().all(|count| *count > 50), "{counts:?}");
    }

    #[test]
    fn every_refusal_names_the_word_and_the_remedy() {
        for (text, why) in [
            ("", "nothing was said: say enable, arm, set PATH = VALUE, mark WORDS or stop"),
            ("hello there", "`hello` is no command: say enable"),
            ("STOP", "`STOP` is no command; did you mean `stop`?"),
            ("stopp", "did you mean `stop`?"),
            ("enable now", "`enable` stands alone, and `now` comes after it: say `enable`"),
            ("set", "`set` names no parameter: write `set PATH = VALUE`, for example `set fr.Fs = 2 N`"),
            ("set fr.Fs 2 N", "`fr.Fs 2 N` has no value"),
            ("set = 2 N", "`= 2 N` has no parameter before it"),
            ("set fr.Fs =", "`fr.Fs =` has no value after it"),
            ("set a = 1,", "a comma stands between two values"),
            ("mark", "a mark has words"),
            ("stop\nenable", "this one contains `\\n`"),
            ("\u{202e}pots", "`\\u{202e}pots` is no command"),
        ] {
            let found = Line::read(text);
            assert!(found.as_ref().is_err_and(|found| found.contains(why)), "{text:?}: {found:?}");
        }
        assert!(Line::read(&format!("mark {}", "x".repeat(97))).is_err_and(|why| why.contains("at most 96 bytes")));
        let long = format!("set {}", vec!["a = 1"; 1000].join(", "));
        assert!(Line::read(&long).is_err_and(|why| why.contains("at most 4000 bytes")));
        assert!(Line::read(&"x".repeat(70_000)).is_err_and(|why| why.len() < 200));
    }

    #[test]
    fn each_line_has_its_doors() {
        let doors = [Door::Prompt, Door::Say, Door::Page];
        let mut all = ALONE.to_vec();
        all.extend(["set a = 1", "mark x"].map(|text| Line::read(text).unwrap()));
        for line in all {
            let here = doors.map(|door| line.clone().at(door).is_ok());
            let wanted = match &line {
                Line::Enable | Line::Arm | Line::Stop | Line::Set(_) | Line::Mark(_) => [true; 3],
                Line::Reset => [false; 3],
                Line::Again => [true, false, true],
                Line::Show | Line::Help | Line::Quit => [true, false, false],
                Line::Take | Line::Give | Line::Refuse => [false, false, true],
            };
            assert_eq!(here, wanted, "{line}");
        }
    }
}
