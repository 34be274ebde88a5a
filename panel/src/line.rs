//! Lines of a page.
//!
//! In: one message. Out: what it asks for, or why it is not a line. A line about curves is for the server, any other one
//! for the subject.
//!
//! ```text
//! key KEY                                 first message of a socket
//! view ID SIGNAL,… FROM TO COLUMNS        curves over time, s; `all` in place of FROM TO: everything there is;
//!                                         `last SECONDS`: the newest, also while more comes
//! path ID SIGNAL,SIGNAL FROM TO           the second over the first
//! drop ID                                 of either
//! between NUMBER FROM TO CURVE,…          what `expect` measures between two instants, s
//! csv NUMBER FROM TO CURVE,…              the points of curves between two instants, s, as the rows of a table
//! find NUMBER CURVE rises|falls VALUE FROM  when the curve first passes a value after that instant
//! ack FRAME                               this frame is drawn
//! here                                    the page is there; at least once a second
//! NUMBER WORDS                            for the subject; answered under this number
//! ```

use runtime::hil::line::{self as rig, stamped};

/// Most views of a page, and most signals of one.
pub const VIEWS: u16 = 32;
/// Most signals of a view.
pub const SIGNALS: usize = 64;
/// Most columns of a view.
pub const COLUMNS: u32 = 4096;
/// Most curves that are measured at once.
pub const MEASURED: usize = 16;
/// Most bytes of a message.
pub const LONGEST: usize = 4096;

/// A window of time, s.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Window {
    /// All there is.
    All,
    /// From one time to a later one.
    Span(f64, f64),
    /// This long, up to the newest.
    Last(f64),
}

impl Window {
    /// Its ends in data from `begin` to `end`.
    pub fn within(self, begin: f64, end: f64) -> (f64, f64) {
        match self {
            Window::All => (begin, end),
            Window::Span(from, to) => (from, to),
            Window::Last(seconds) => (end - seconds, end),
        }
    }
}

/// What a page wants to see.
#[derive(Clone, PartialEq, Debug)]
pub struct View {
    /// Its number.
    pub id: u16,
    /// The signals.
    pub signals: Vec<u32>,
    /// The window.
    pub window: Window,
    /// Columns of the picture; none for a path, whose second signal stands over its first.
    pub columns: Option<u32>,
}

/// A curve that passes a value.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Crossing {
    /// The curve.
    pub curve: u32,
    /// From below, and not from above.
    pub rises: bool,
    /// The value, in the curve's unit.
    pub level: f64,
    /// After this instant, s.
    pub after: f64,
}

/// A line.
#[derive(Clone, PartialEq, Debug)]
pub enum Line<'a> {
    /// The key.
    Key(&'a str),
    /// Begin or change a view.
    View(View),
    /// End a view.
    Drop(u16),
    /// Measures of curves from one instant to another, answered under this number.
    Between(u32, f64, f64, Vec<u32>),
    /// Points of curves from one instant to another as rows, answered under this number.
    Csv(u32, f64, f64, Vec<u32>),
    /// When a curve first passes a value after an instant, answered under this number.
    Find(u32, Crossing),
    /// This frame is drawn.
    Ack(u32),
    /// The page is there.
    Here,
    /// Words for the subject.
    Say(u32, &'a str),
}

/// Reads a line.
///
/// # Errors
/// What is wrong with it.
pub fn read(text: &str) -> Result<Line<'_>, String> {
    if text.len() > LONGEST {
        return Err(format!("a line has at most {LONGEST} bytes"));
    }
    let text = text.trim();
    let (word, rest) = text.split_once(' ').map_or((text, ""), |(word, rest)| (word, rest.trim()));
    let words: Vec<&str> = rest.split_ascii_whitespace().collect();
    match (word, words.as_slice()) {
        ("key", [key]) => Ok(Line::Key(key)),
        ("view", [id, signals, window @ .., columns]) => {
            let columns = number(columns, "a number of columns")?;
            if !(1..=COLUMNS).contains(&columns) {
                return Err(format!("a view has 1 to {COLUMNS} columns, not {columns}"));
            }
            Ok(Line::View(view(id, signals, window, Some(columns))?))
        }
        ("path", [id, signals, window @ ..]) => {
            let view = view(id, signals, window, None)?;
            if view.signals.len() != 2 {
                return Err("a path has two signals".into());
            }
            Ok(Line::View(view))
        }
        ("drop", [id]) => Ok(Line::Drop(number(id, "the number of a view")?)),
        ("here", []) => Ok(Line::Here),
        ("ack", [frame]) => Ok(Line::Ack(number(frame, "the number of a frame")?)),
        (word @ ("between" | "csv"), [number, from, to, curves]) => {
            let (number, curves) = (self::number(number, "a number")?, curves.split(','));
            let curves: Vec<u32> = curves.map(|one| self::number(one, "a curve")).collect::<Result<_, _>>()?;
            let most = if word == "csv" { SIGNALS } else { MEASURED };
            if curves.len() > most {
                return Err(format!("at most {most} curves are measured or written at once"));
            }
            let (from, to) = (instant(from)?, instant(to)?);
            if from >= to {
                return Err(format!("a window goes from one time to a later one, not from {from} to {to}"));
            }
            Ok(if word == "csv" {
                Line::Csv(number, from, to, curves)
            } else {
                Line::Between(number, from, to, curves)
            })
        }
        ("find", [number, curve, way @ ("rises" | "falls"), level, after]) => {
            let (curve, rises) = (self::number(curve, "a curve")?, *way == "rises");
            let crossing = Crossing { curve, rises, level: instant(level)?, after: instant(after)? };
            Ok(Line::Find(self::number(number, "a number")?, crossing))
        }
        ("key" | "view" | "path" | "drop" | "ack" | "between" | "csv" | "find" | "here", _) => {
            Err(format!("`{word}` needs other words after it"))
        }
        (number, [_, ..]) if number.bytes().all(|byte| byte.is_ascii_digit()) => {
            Ok(Line::Say(self::number(number, "a number")?, rest))
        }
        _ => {
            Err("a line begins with `view`, `path`, `drop`, `between`, `csv`, `find`, `ack`, `here`, or a number"
                .into())
        }
    }
}

/// Words for a rig: the end of the data that the page has seen, s, and the command.
pub fn seen(words: &str) -> (Option<f64>, &str) {
    let (seen, words) = stamped(words);
    (seen.and_then(|seen| seen.parse().ok()), words)
}

/// Whether the words stop a rig.
pub fn stops(words: &str) -> bool {
    rig::Line::read(seen(words).1) == Ok(rig::Line::Stop)
}

/// A finite number.
fn instant(text: &str) -> Result<f64, String> {
    let value: f64 = number(text, "a number")?;
    if value.is_finite() { Ok(value) } else { Err(format!("{value} is no finite number")) }
}

fn number<T: std::str::FromStr>(text: &str, what: &str) -> Result<T, String> {
    text.parse().map_err(|_| format!("`{}` is not {what}", text.escape_debug()))
}

fn view(id: &str, signals: &str, window: &[&str], columns: Option<u32>) -> Result<View, String> {
    let id: u16 = number(id, "the number of a view")?;
    if id >= VIEWS {
        return Err(format!("views have the numbers 0 to {}", VIEWS - 1));
    }
    let signals: Vec<u32> = signals.split(',').map(|one| number(one, "a signal")).collect::<Result<_, _>>()?;
    if signals.len() > SIGNALS {
        return Err(format!("a view has at most {SIGNALS} signals"));
    }
    let window = match window {
        ["all"] => Window::All,
        ["last", seconds] => {
            let seconds: f64 = number(seconds, "a time in s")?;
            if !(seconds.is_finite() && seconds > 0.0) {
                return Err(format!("the newest part lasts longer than 0 s, not {seconds} s"));
            }
            Window::Last(seconds)
        }
        [from, to] => {
            let (from, to): (f64, f64) = (number(from, "a time in s")?, number(to, "a time in s")?);
            if !(from.is_finite() && to.is_finite() && from < to) {
                return Err(format!("a window goes from one time to a later one, not from {from} to {to}"));
            }
            Window::Span(from, to)
        }
        _ => return Err("a window is `all`, `last SECONDS`, or FROM TO in s".into()),
    };
    Ok(View { id, signals, window, columns })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_a_page_are_read() {
        let view =
            |id, signals: &[u32], window, columns| Line::View(View { id, signals: signals.to_vec(), window, columns });
        assert_eq!(read("key 0123"), Ok(Line::Key("0123")));
        assert_eq!(read("view 2 0,3,7 all 1200"), Ok(view(2, &[0, 3, 7], Window::All, Some(1200))));
        assert_eq!(read("view 0 4 -1.5 2e1 600"), Ok(view(0, &[4], Window::Span(-1.5, 20.0), Some(600))));
        assert_eq!(read("path 5 1,2 0 10"), Ok(view(5, &[1, 2], Window::Span(0.0, 10.0), None)));
        assert_eq!(read("view 1 2 last 24 600"), Ok(view(1, &[2], Window::Last(24.0), Some(600))));
        assert_eq!(read("ack 17"), Ok(Line::Ack(17)));
        assert_eq!(read("here"), Ok(Line::Here));
        assert_eq!(
            (seen("@1.5 arm"), seen("@x stop"), seen("stop")),
            ((Some(1.5), "arm"), (None, "stop"), (None, "stop"))
        );
        assert_eq!(read("between 4 1.5 2e1 0,3"), Ok(Line::Between(4, 1.5, 20.0, vec![0, 3])));
        assert_eq!(read("csv 4 1.5 2e1 7"), Ok(Line::Csv(4, 1.5, 20.0, vec![7])));
        let crossing = Crossing { curve: 2, rises: false, level: -0.5, after: 3.0 };
        assert_eq!(read("find 9 2 falls -0.5 3"), Ok(Line::Find(9, crossing)));
        assert_eq!(read("drop 3\n"), Ok(Line::Drop(3)));
        assert_eq!(read("12 set fr.Fs = 0.31 N, m = 2 kg"), Ok(Line::Say(12, "set fr.Fs = 0.31 N, m = 2 kg")));
    }

    #[test]
    fn every_refusal_says_why() {
        for (line, why) in [
            ("", "a line begins with"),
            ("hello there", "a line begins with"),
            ("7", "a line begins with"),
            ("99999999999 stop", "is not a number"),
            ("-1 stop", "a line begins with"),
            ("key", "`key` needs other words"),
            ("view 1 0 all", "is not a number of columns"),
            ("view 1 0 all 0", "1 to 4096 columns, not 0"),
            ("view 1 0 all 4097", "1 to 4096 columns, not 4097"),
            ("view 32 0 all 10", "0 to 31"),
            ("view x 0 all 10", "`x` is not the number of a view"),
            ("view 1 0,,1 all 10", "`` is not a signal"),
            ("view 1 0 1 1 10", "from one time to a later one"),
            ("view 1 0 0 inf 10", "from one time to a later one"),
            ("view 1 0 nan 1 10", "from one time to a later one"),
            ("view 1 0 1 10", "a window is `all`"),
            ("view 1 0 last 0 10", "longer than 0 s"),
            ("view 1 0 last inf 10", "longer than 0 s"),
            ("view 1 0 last 10", "a window is `all`"),
            ("path 1 0 all", "a path has two signals"),
            ("between 1 2 1 0", "from one time to a later one"),
            ("between 1 0 inf 0", "no finite number"),
            ("between 1 0 1 0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16", "at most 16 curves"),
            ("find 1 0 up 1 0", "`find` needs other words"),
            ("find 1 0 rises nan 0", "no finite number"),
            ("path 1 0,1,2 all", "a path has two signals"),
            ("ack -1", "`-1` is not the number of a frame"),
            ("here 1", "`here` needs other words"),
            ("drop \u{202e}", "`\\u{202e}` is not the number of a view"),
        ] {
            let found = read(line);
            assert!(found.as_ref().is_err_and(|found| found.contains(why)), "{line}: {found:?}");
        }
        let many = format!("view 1 {} all 10", ["0"; SIGNALS + 1].join(","));
        assert!(read(&many).is_err_and(|why| why.contains("at most 64 signals")));
        assert!(read(&"1 ".repeat(3000)).is_err_and(|why| why.contains("at most 4096 bytes")));
    }

    /// Random lines of words that the grammar knows, and of others: what is read keeps the limits, and is printed and
    /// read again to the same.
    #[test]
    fn what_is_read_keeps_the_limits() {
        const WORDS: &[&str] = &[
            "key",
            "view",
            "path",
            "drop",
            "here",
            "ack",
            "between",
            "csv",
            "find",
            "rises",
            "falls",
            "all",
            "last",
            "0",
            "1",
            "31",
            "32",
            "65536",
            "-1",
            "1e3",
            "nan",
            "inf",
            "0,1",
            "0,1,2",
            ",",
            "4096",
            "4097",
            "4294967296",
            "set",
            "fr.Fs",
            "=",
            "\u{202e}",
            "\t",
            "  ",
        ];
        let mut read_lines = 0;
        for seed in 1..=50_000_u64 {
            let mut state = seed;
            let mut below = |n: usize| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 33) as usize % n
            };
            let first = WORDS[below(12)];
            let more: Vec<&str> = (0..below(6)).map(|_| WORDS[below(WORDS.len())]).collect();
            let line = format!("{first} {}", more.join(" "));
            let again = match read(&line) {
                Ok(Line::View(view)) => {
                    assert!(view.id < VIEWS && view.signals.len() <= SIGNALS, "seed {seed}: {line}");
                    assert!(view.columns.is_none_or(|n| (1..=COLUMNS).contains(&n)), "seed {seed}: {line}");
                    assert!(view.columns.is_some() || view.signals.len() == 2, "seed {seed}: {line}");
                    let window = match view.window {
                        Window::All => "all".into(),
                        Window::Span(from, to) => format!("{from} {to}"),
                        Window::Last(seconds) => format!("last {seconds}"),
                    };
                    let signals: Vec<String> = view.signals.iter().map(u32::to_string).collect();
                    let (id, signals) = (view.id, signals.join(","));
                    match view.columns {
                        Some(columns) => format!("view {id} {signals} {window} {columns}"),
                        None => format!("path {id} {signals} {window}"),
                    }
                }
                Ok(Line::Between(number, from, to, curves)) => {
                    assert!(from < to && curves.len() <= MEASURED, "seed {seed}: {line}");
                    let curves: Vec<String> = curves.iter().map(u32::to_string).collect();
                    format!("between {number} {from} {to} {}", curves.join(","))
                }
                Ok(Line::Csv(number, from, to, curves)) => {
                    assert!(from < to && curves.len() <= SIGNALS, "seed {seed}: {line}");
                    let curves: Vec<String> = curves.iter().map(u32::to_string).collect();
                    format!("csv {number} {from} {to} {}", curves.join(","))
                }
                Ok(Line::Find(number, Crossing { curve, rises, level, after })) => {
                    format!("find {number} {curve} {} {level} {after}", if rises { "rises" } else { "falls" })
                }
                Ok(Line::Drop(id)) => format!("drop {id}"),
                Ok(Line::Ack(frame)) => format!("ack {frame}"),
                Ok(Line::Here) => "here".into(),
                Ok(Line::Key(key)) => format!("key {key}"),
                Ok(Line::Say(number, words)) => format!("{number} {words}"),
                Err(why) => {
                    assert!(why.len() > 10 && why == crate::words::clean(&why), "seed {seed}: {line}: {why:?}");
                    continue;
                }
            };
            read_lines += 1;
            assert_eq!(read(&again), read(&line), "seed {seed}: {line}");
        }
        assert!(read_lines > 1000, "{read_lines}");
    }
}
