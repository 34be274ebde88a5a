//! Parser: reads the listing of a function, as [`print`](super::print) writes it.
//!
//! In: the text of one function. Out: the function, bit by bit the one that was printed, or the first error with its
//! line. Blank lines and comments, from `;` to the end of a line, are ignored. The parser checks the form of the text only;
//! [`verify`](super::verify) checks that values exist and types match.

use super::{Binary, Func, Op, Unary, Value, Write};
use crate::ir::hash::HashMap;
use abi::{Layout, Slot};
use std::fmt;
use std::str::FromStr;
use std::sync::LazyLock;

/// Why a text is not the listing of a function.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct ParseError {
    /// The line, from 1.
    pub line: usize,
    /// What is wrong with it.
    pub cause: String,
}

impl fmt::Display for ParseError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "line {}: {}", self.line, self.cause)
    }
}

/// Parses the listing of one function.
///
/// # Errors
/// The first line that is not of this form.
pub fn parse(text: &str) -> Result<Func, ParseError> {
    let code = |line: &str| line.split(';').next().is_some_and(|code| !code.trim().is_empty());
    let mut lines = text.lines().zip(1..).filter(|(line, _)| code(line));
    let Some((header, number)) = lines.next() else {
        return Err(ParseError { line: 1, cause: "no function: its name and `:` are missing".into() });
    };
    let Some(name) = header.strip_suffix(':') else {
        return Err(ParseError {
            line: number,
            cause: format!("expected the name of a function and `:`, not `{header}`"),
        });
    };
    let mut func = Func { name: name.into(), ..Func::default() };
    let mut section = Section::Operations;
    for (line, number) in lines {
        Line::of(line).read(&mut func, &mut section).map_err(|cause| ParseError { line: number, cause })?;
    }
    Ok(func)
}

/// Parses the segments of a block as test files write them: `params 1, states 2`.
///
/// # Errors
/// What is no segment or no length.
pub fn parse_layout(text: &str) -> Result<Layout, String> {
    const SEGMENTS: [&str; 10] =
        ["params", "inputs", "states", "memory", "regimes", "outputs", "derivatives", "roots", "jacobian", "due"];
    let (mut lens, mut rings) = ([0; 10], 0);
    for part in text.split(", ") {
        let (name, len) = part.split_once(' ').ok_or(format!("expected a segment and its length, not `{part}`"))?;
        let len: u32 = len.parse().map_err(|_| format!("`{len}` is no length"))?;
        match SEGMENTS.iter().position(|segment| *segment == name) {
            Some(at) => lens[at] = len,
            None if name == "rings" => rings = len,
            None => return Err(format!("no segment `{name}`")),
        }
    }
    Ok(Layout::new(lens).with_rings(rings))
}

/// The sections of a listing, in their order.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
enum Section {
    Operations,
    Stores,
    Writes,
    Status,
}

/// The operations that have a name, under it; their operands are placeholders. The names are those of the printer.
/// A new operation needs a line here.
static NAMED: LazyLock<HashMap<String, Op>> = LazyLock::new(|| {
    let v = Value(0);
    let arithmetic = [
        Op::Add(v, v),
        Op::Sub(v, v),
        Op::Mul(v, v),
        Op::Div(v, v),
        Op::Neg(v),
        Op::Abs(v),
        Op::Sqrt(v),
        Op::Fma(v, v, v),
        Op::Floor(v),
        Op::Nearest(v),
        Op::Less(v, v),
        Op::LessEqual(v, v),
        Op::Equal(v, v),
        Op::And(v, v),
        Op::Or(v, v),
        Op::Not(v),
        Op::Select(v, v, v),
        Op::IntAdd(v, v),
        Op::IntSub(v, v),
        Op::IntMul(v, v),
        Op::IntAnd(v, v),
        Op::IntOr(v, v),
        Op::IntXor(v, v),
        Op::ShiftLeft(v, 0),
        Op::ShiftRight(v, 0),
        Op::ShiftRightSigned(v, 0),
        Op::IntLess(v, v),
        Op::IntEqual(v, v),
        Op::ToBits(v),
        Op::FromBits(v),
        Op::ToInt(v),
        Op::ToReal(v),
    ];
    let elementary = Unary::ALL.map(|function| Op::Unary(function, v)).into_iter();
    let elementary = elementary.chain(Binary::ALL.map(|function| Op::Binary(function, v, v)));
    let name = |op: &Op| op.to_string().split(' ').next().expect("a text has a first word").to_string();
    arithmetic.into_iter().chain(elementary).map(|op| (name(&op), op)).collect()
});

/// The unread rest of a line. Its tokens are words and single other characters.
pub(super) struct Line<'t> {
    rest: &'t str,
}

impl<'t> Line<'t> {
    pub(super) fn of(line: &'t str) -> Line<'t> {
        Line { rest: line.split(';').next().unwrap_or_default() }
    }

    /// The next token; empty at the end of the line.
    pub(super) fn token(&mut self) -> &'t str {
        let rest = self.rest.trim_start();
        let is_word = |c: char| c.is_alphanumeric() || ['_', '.', '+', '-'].contains(&c);
        let word = rest.find(|c| !is_word(c)).unwrap_or(rest.len());
        // A character that belongs to no word is a token by itself.
        let length = if word > 0 { word } else { rest.chars().next().map_or(0, char::len_utf8) };
        let (token, rest) = rest.split_at(length);
        self.rest = rest;
        token
    }

    /// The next token, which stays unread.
    pub(super) fn peek(&self) -> &'t str {
        Line { rest: self.rest }.token()
    }

    pub(super) fn expect(&mut self, expected: &str) -> Result<(), String> {
        let token = self.token();
        if token == expected { Ok(()) } else { Err(unexpected(&format!("`{expected}`"), token)) }
    }

    /// An integer; `kind` names it in messages.
    pub(super) fn number<T: FromStr>(&mut self, kind: &str) -> Result<T, String> {
        let token = self.token();
        token.parse().ok().filter(|_| !token.starts_with('+')).ok_or_else(|| unexpected(kind, token))
    }

    pub(super) fn slot(&mut self) -> Result<Slot, String> {
        self.number("a slot").map(Slot)
    }

    pub(super) fn value(&mut self) -> Result<Value, String> {
        let token = self.token();
        value(token).ok_or_else(|| unexpected("a value", token))
    }

    /// `BASE[INDEX < LEN]`, of a table or a ring.
    pub(super) fn entry(&mut self) -> Result<(u32, Value, u32), String> {
        let base = self.number("the first entry")?;
        self.expect("[")?;
        let index = self.value()?;
        self.expect("<")?;
        let len = self.number("the number of entries")?;
        self.expect("]")?;
        Ok((base, index, len))
    }

    pub(super) fn end(&mut self) -> Result<(), String> {
        match self.token() {
            "" => Ok(()),
            token => Err(unexpected("the end of the line", token)),
        }
    }

    /// Reads the line and adds its content to the function.
    fn read(mut self, func: &mut Func, section: &mut Section) -> Result<(), String> {
        let first = self.token();
        let own = match first {
            "store" => Section::Stores,
            "write" => Section::Writes,
            "status" => Section::Status,
            _ => Section::Operations,
        };
        if own < *section || func.status.is_some() {
            return Err(format!("`{first}` follows the section of {section:?}").to_lowercase());
        }
        *section = own;
        match own {
            Section::Operations => {
                let next = Value(func.ops.len() as u32);
                if value(first) != Some(next) {
                    return Err(unexpected(&format!("`{next}`, `store`, `write` or `status`"), first));
                }
                self.expect("=")?;
                func.ops.push(self.op()?);
            }
            Section::Stores => {
                let slot = self.slot()?;
                self.expect("=")?;
                func.stores.push((slot, self.value()?));
            }
            Section::Writes => {
                let (base, index, len) = self.entry()?;
                self.expect("=")?;
                func.writes.push(Write { base: Slot(base), len, index, value: self.value()? });
            }
            Section::Status => func.status = Some(self.value()?),
        }
        self.end()
    }

    /// The operation after `vN =`.
    pub(super) fn op(&mut self) -> Result<Op, String> {
        Ok(match self.token() {
            "int" => Op::Int(self.number("an integer")?),
            "true" => Op::Bool(true),
            "false" => Op::Bool(false),
            "load" => Op::Load(self.slot()?),
            "pool" => {
                let (base, index, len) = self.entry()?;
                Op::Pool { base, len, index }
            }
            "ring" => {
                let (base, index, len) = self.entry()?;
                Op::Ring { base: Slot(base), len, index }
            }
            "NaN" => Op::Real(self.nan()?),
            word if let Some(op) = NAMED.get(word) => self.operands(*op)?,
            word => match word.parse::<f64>() {
                Ok(number) if !number.is_nan() => Op::Real(number.to_bits()),
                _ => return Err(unexpected("an operation or a number", word)),
            },
        })
    }

    /// An operation of this kind with the operands that follow.
    fn operands(&mut self, kind: Op) -> Result<Op, String> {
        let mut missing = None;
        let op = kind.map(|operand| match self.value() {
            Ok(value) => value,
            Err(cause) => {
                missing.get_or_insert(cause);
                operand
            }
        });
        if let Some(cause) = missing {
            return Err(cause);
        }
        Ok(match op {
            Op::ShiftLeft(a, _) => Op::ShiftLeft(a, self.number("a shift")?),
            Op::ShiftRight(a, _) => Op::ShiftRight(a, self.number("a shift")?),
            Op::ShiftRightSigned(a, _) => Op::ShiftRightSigned(a, self.number("a shift")?),
            op => op,
        })
    }

    /// The bits of a NaN: those that follow in hexadecimal, else those of `f64::NAN`.
    fn nan(&mut self) -> Result<u64, String> {
        let bits = match self.token() {
            "" => return Ok(f64::NAN.to_bits()),
            token => token.strip_prefix("0x").and_then(|digits| u64::from_str_radix(digits, 16).ok()),
        };
        bits.filter(|bits| f64::from_bits(*bits).is_nan()).ok_or_else(|| "these are no bits of a NaN".into())
    }
}

/// `vN`
pub(super) fn value(token: &str) -> Option<Value> {
    let digits = token.strip_prefix('v').filter(|digits| !digits.starts_with('+'))?;
    digits.parse().ok().map(Value)
}

/// The message that something else was expected.
pub(super) fn unexpected(expected: &str, token: &str) -> String {
    match token {
        "" => format!("expected {expected}, but the line ends"),
        token => format!("expected {expected}, not `{token}`"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::random::{self, REALS, Random};
    use crate::ir::verify::{Stage, verify};

    /// A generated function, now and then with elementary functions and special reals in place of other reals.
    fn generated(seed: u64) -> Func {
        let mut random = Random(seed);
        let len = 20 + random.below(80);
        let mut func = random::func(&mut random, len);
        for at in 0..func.ops.len() {
            let nan = random.bits() | f64::INFINITY.to_bits() | 1;
            func.ops[at] = match func.ops[at] {
                Op::Add(a, b) if random.below(3) == 0 => Op::Binary(Binary::ALL[random.below(3)], a, b),
                Op::Neg(a) => Op::Unary(Unary::ALL[random.below(Unary::ALL.len())], a),
                Op::Real(_) if random.below(4) == 0 => Op::Real(nan),
                Op::Real(_) if random.below(3) == 0 => Op::Real(random.bits() & 0x800f_ffff_ffff_ffff),
                op => op,
            };
        }
        func
    }

    /// Mutants tried by hand: the printer shows NaN without bits, reals with 15 digits, a ring from its second slot.
    #[test]
    fn a_printed_function_is_read_back_to_the_bit() {
        for seed in 0..2000 {
            let func = generated(seed);
            let listing = func.to_string();
            assert_eq!(parse(&listing), Ok(func), "seed {seed}\n{listing}");
        }
    }

    #[test]
    fn each_real_is_read_back_to_the_bit() {
        let mut random = Random(1);
        let special = [f64::NAN.to_bits(), (-f64::NAN).to_bits(), f64::INFINITY.to_bits() + 1, u64::MAX, 1, 1 << 63];
        let reals = REALS.iter().map(|real| real.to_bits()).chain(special);
        for bits in reals.chain((0..100_000).map(|_| random.bits())) {
            let func = Func { name: "f".into(), ops: vec![Op::Real(bits)], ..Func::default() };
            assert_eq!(parse(&func.to_string()), Ok(func), "{bits:#x}");
        }
    }

    /// A damaged text gives an error with one of its lines, or a function that `verify` can judge.
    #[test]
    fn damaged_listings_never_panic() {
        const OTHER: &[char] = &['v', '0', '9', '-', '.', '=', '[', ']', '<', ' ', '\n', ';', 'e', 'x', ':', 'µ'];
        let (layout, mut errors, mut accepted, mut sound) = (random::layout(), 0, 0, 0);
        for seed in 0..3000 {
            let mut random = Random(seed);
            let listing = generated(seed % 40).to_string();
            let mut text: Vec<char> = listing.chars().collect();
            let at = random.below(text.len());
            match random.below(4) {
                0 => drop(text.remove(at)),
                1 => text[at] = OTHER[random.below(OTHER.len())],
                2 => text.insert(at, OTHER[random.below(OTHER.len())]),
                _ => {
                    let mut lines: Vec<&str> = listing.lines().collect();
                    let (one, other) = (random.below(lines.len()), random.below(lines.len()));
                    lines.swap(one, other);
                    text = lines.join("\n").chars().collect();
                }
            }
            let text: String = text.into_iter().collect();
            match parse(&text) {
                Err(error) => {
                    assert!((1..=text.lines().count()).contains(&error.line), "seed {seed}: {error}\n{text}");
                    errors += 1;
                }
                Ok(func) => {
                    assert_eq!(parse(&func.to_string()).as_ref(), Ok(&func), "seed {seed}\n{text}");
                    sound += usize::from(verify(&func, &layout, random::POOL_LEN, Stage::Lowered).is_ok());
                    accepted += 1;
                }
            }
        }
        assert!(errors > 1000 && sound > 300 && accepted > sound, "{errors} errors, {sound} sound of {accepted}");
    }

    #[test]
    fn errors_say_line_and_cause() {
        for (text, expected) in [
            ("", "line 1: no function: its name and `:` are missing"),
            ("step\n", "line 1: expected the name of a function and `:`, not `step`"),
            ("f:\n  v0 = load 3\n  v2 = neg v0\n", "line 3: expected `v1`, `store`, `write` or `status`, not `v2`"),
            ("f:\n\n  v0 = load x\n", "line 3: expected a slot, not `x`"),
            ("f:\n  v0 = load -1\n", "line 2: expected a slot, not `-1`"),
            ("f:\n  v0 = lod 3\n", "line 2: expected an operation or a number, not `lod`"),
            ("f:\n  v0 = add v1\n", "line 2: expected a value, but the line ends"),
            ("f:\n  v0 = neg v1 v2\n", "line 2: expected the end of the line, not `v2`"),
            ("f:\n  v0 = pool 3[v1 v2]\n", "line 2: expected `<`, not `v2`"),
            ("f:\n  v0 = NaN 0x1\n", "line 2: these are no bits of a NaN"),
            ("f:\n  store 3 = v0\n  v0 = 1.0\n", "line 3: `v0` follows the section of stores"),
            ("f:\n  status v0\n  status v0\n", "line 3: `status` follows the section of status"),
        ] {
            assert_eq!(parse(text).unwrap_err().to_string(), expected);
        }
    }

    #[test]
    fn comments_and_blank_lines_are_ignored() {
        let func = parse("; a constant\nf:\n\n  v0 = 2.0 ; stored below\n  store 4 = v0\n").unwrap();
        assert_eq!(func.to_string(), "f:\n  v0 = 2.0\n  store 4 = v0\n");
    }
}
