//! Text listing of a control-flow graph, and its parser.
//!
//! ```text
//! step, single:
//!   v1 = 0.5
//! b0 body:
//!   v0 = load 4
//!   v2 = mul v0 v1
//!   store 4 = v2
//!   branch v3 b1 b2(v2)
//! b1 cold:
//!   v2 = reload 4
//!   return v4
//! ```
//!
//! Operations that no block computes, constants above all, stand before the first block. The listing is exact, except that
//! a leading loop, which is straight-line code, is only shown as comments.

use super::cfg::{Area, Block, BlockId, Cfg, Count, Entry, Inst, Part, Place, Target, Terminator};
use super::parse::{Line, ParseError, unexpected};
use super::{Op, Value, Write};
use crate::ir::hash::{HashMap, HashSet};
use abi::Slot;
use std::fmt;

const ENTRIES: [(Entry, &str); 4] = [
    (Entry::Single, "single"),
    (Entry::SingleOrSeveral, "single_or_several"),
    (Entry::Several, "several"),
    (Entry::Piece, "piece"),
];
const PARTS: [(Part, &str); 3] = [(Part::Prologue, "prologue"), (Part::Body, "body"), (Part::Cold, "cold")];

fn name<T: PartialEq>(names: &[(T, &'static str)], of: &T) -> &'static str {
    names.iter().find(|(known, _)| known == of).expect("it has a name").1
}

impl fmt::Display for BlockId {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "b{}", self.0)
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self.area {
            Area::Block => write!(f, "{}", self.index)?,
            Area::Scratch => write!(f, "scratch {}", self.index)?,
            Area::Leading => write!(f, "leading {}", self.index)?,
            Area::Inputs => write!(f, "inputs {}", self.index)?,
            Area::Outputs => write!(f, "outputs {}", self.index)?,
        }
        if self.stride == 0 { Ok(()) } else { write!(f, " stride {}", self.stride) }
    }
}

fn values(f: &mut fmt::Formatter, values: &[Value]) -> fmt::Result {
    let all: Vec<String> = values.iter().map(Value::to_string).collect();
    if all.is_empty() { Ok(()) } else { write!(f, "({})", all.join(", ")) }
}

impl fmt::Display for Target {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}", self.block)?;
        values(f, &self.args)
    }
}

impl fmt::Display for Terminator {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Terminator::Jump(target) => write!(f, "jump {target}"),
            Terminator::Branch { when, yes, no } => write!(f, "branch {when} {yes} {no}"),
            Terminator::Switch { slot, cases, default } => {
                write!(f, "switch {}", slot.0)?;
                cases.iter().try_for_each(|(bits, block)| write!(f, " {bits:#x} {block}"))?;
                write!(f, " else {default}")
            }
            Terminator::Repeat { count: Count::Call, again, done } => write!(f, "repeat {again} {done}"),
            Terminator::Repeat { count: Count::Fixed(count), again, done } => {
                write!(f, "repeat {count} {again} {done}")
            }
            Terminator::Return(None) => write!(f, "return"),
            Terminator::Return(Some(status)) => write!(f, "return {status}"),
        }
    }
}

impl fmt::Display for Cfg {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "{}, {}:", self.name, name(&ENTRIES, &self.called))?;
        self.prepare.iter().try_for_each(|block| writeln!(f, "  prepare {block}"))?;
        self.pieces.iter().try_for_each(|block| writeln!(f, "  piece {block}"))?;
        if self.scratch_len > 0 {
            writeln!(f, "  scratch {}", self.scratch_len)?;
        }
        let insts = self.blocks.iter().flat_map(|block| &block.insts);
        let computed: HashSet<Value> =
            insts.filter_map(|inst| if let Inst::Compute(value) = inst { Some(*value) } else { None }).collect();
        for (value, op) in (0..).map(Value).zip(&self.ops).filter(|(value, _)| !computed.contains(value)) {
            writeln!(f, "  {value} = {op}")?;
        }
        for (number, block) in (0..).map(BlockId).zip(&self.blocks) {
            write!(f, "{number} {}", name(&PARTS, &block.part))?;
            values(f, &block.params)?;
            writeln!(f, ":")?;
            for inst in &block.insts {
                match inst {
                    Inst::Compute(value) => writeln!(f, "  {value} = {}", self.op(*value))?,
                    Inst::Reload(value, place) => writeln!(f, "  {value} = reload {place}")?,
                    Inst::Store(place, value) => writeln!(f, "  store {place} = {value}")?,
                    Inst::Write(Write { base, len, index, value }) => {
                        writeln!(f, "  write {}[{index} < {len}] = {value}", base.0)?;
                    }
                    Inst::Call(piece) => writeln!(f, "  call {piece}")?,
                }
            }
            writeln!(f, "  {}", block.end)?;
        }
        if let Some(leading) = &self.leading {
            let parts = leading.invariants.iter().chain([&leading.instants]);
            let text: String = parts.map(|func| func.to_string()).collect();
            text.lines().try_for_each(|line| writeln!(f, "; {line}"))?;
        }
        Ok(())
    }
}

/// Parses the listing of one graph.
///
/// # Errors
/// The first line that is not of this form.
pub fn parse_cfg(text: &str) -> Result<Cfg, ParseError> {
    let code = |line: &str| line.split(';').next().is_some_and(|code| !code.trim().is_empty());
    let mut lines = text.lines().zip(1..).filter(|(line, _)| code(line));
    let fault = |line: usize, cause: String| ParseError { line, cause };
    let (header, number) = lines.next().ok_or_else(|| fault(1, "no function: its name is missing".into()))?;
    let named = header.trim_end().strip_suffix(':').and_then(|header| header.rsplit_once(", "));
    let called = named.and_then(|(_, called)| ENTRIES.iter().find(|(_, known)| *known == called));
    let (Some((name, _)), Some((called, _))) = (named, called) else {
        let all = ENTRIES.map(|(_, name)| format!("`{name}`")).join(", ");
        return Err(fault(number, format!("expected a name, a comma, one of {all}, and `:`, not `{header}`")));
    };
    let mut cfg = Cfg::new(name, *called);
    let mut ops: HashMap<Value, (Op, usize)> = HashMap::default();
    let mut last = number;
    for (line, number) in lines {
        last = number;
        read(Line::of(line), &mut cfg, &mut ops, number).map_err(|cause| fault(number, cause))?;
    }
    if let Some(block) = cfg.blocks.iter().position(|block| block.end == UNFINISHED) {
        return Err(fault(last, format!("b{block} has no end, such as `return`")));
    }
    for value in (0..ops.len() as u32).map(Value) {
        let (op, _) = ops.get(&value).ok_or_else(|| fault(last, format!("{value} is missing")))?;
        cfg.ops.push(*op);
    }
    Ok(cfg)
}

/// The end of a block whose end has not been read.
const UNFINISHED: Terminator = Terminator::Return(Some(Value(u32::MAX)));

fn read(mut line: Line, cfg: &mut Cfg, ops: &mut HashMap<Value, (Op, usize)>, number: usize) -> Result<(), String> {
    let first = line.token();
    if let Some(block) = block_id(first) {
        if block.index() != cfg.blocks.len() {
            return Err(unexpected(&format!("`b{}`", cfg.blocks.len()), first));
        }
        let part = line.token();
        let known = PARTS.iter().find(|(_, name)| *name == part);
        let (part, _) = *known.ok_or_else(|| unexpected("`prologue`, `body` or `cold`", part))?;
        let params = arguments(&mut line)?;
        line.expect(":")?;
        cfg.block(Block { part, params, insts: Vec::new(), end: UNFINISHED });
        return line.end();
    }
    let Some(block) = cfg.blocks.last_mut() else {
        match first {
            "prepare" => cfg.prepare = Some(block_of(&mut line)?),
            "piece" => cfg.pieces.push(block_of(&mut line)?),
            "scratch" => cfg.scratch_len = line.number("the number of scratch slots")?,
            _ => _ = definition(first, &mut line, ops, number)?,
        }
        return line.end();
    };
    if block.end != UNFINISHED {
        return Err(format!("`{first}` follows the end of its block"));
    }
    let inst = match first {
        "store" => {
            let place = place(&mut line)?;
            line.expect("=")?;
            Inst::Store(place, line.value()?)
        }
        "write" => {
            let (base, index, len) = line.entry()?;
            line.expect("=")?;
            Inst::Write(Write { base: Slot(base), len, index, value: line.value()? })
        }
        "call" => Inst::Call(line.number("the number of a piece")?),
        "jump" | "branch" | "switch" | "repeat" | "return" => {
            block.end = end(first, &mut line)?;
            return line.end();
        }
        _ => definition(first, &mut line, ops, number)?,
    };
    block.insts.push(inst);
    line.end()
}

/// `vN = …`: an operation, or a value that is read back.
fn definition(
    first: &str,
    line: &mut Line,
    ops: &mut HashMap<Value, (Op, usize)>,
    number: usize,
) -> Result<Inst, String> {
    let value = super::parse::value(first).ok_or_else(|| unexpected("a value or an instruction", first))?;
    line.expect("=")?;
    if line.peek() == "reload" {
        line.token();
        return Ok(Inst::Reload(value, place(line)?));
    }
    let op = line.op()?;
    match ops.insert(value, (op, number)) {
        Some((known, before)) if known != op => Err(format!("{value} is `{known}` in line {before}")),
        _ => Ok(Inst::Compute(value)),
    }
}

fn block_id(token: &str) -> Option<BlockId> {
    token.strip_prefix('b')?.parse().ok().map(BlockId)
}

fn block_of(line: &mut Line) -> Result<BlockId, String> {
    let token = line.token();
    block_id(token).ok_or_else(|| unexpected("a block", token))
}

/// `(v1, v2)`, or nothing.
fn arguments(line: &mut Line) -> Result<Vec<Value>, String> {
    let mut values = Vec::new();
    if line.peek() == "(" {
        line.token();
        loop {
            values.push(line.value()?);
            match line.token() {
                ")" => break,
                "," => {}
                token => return Err(unexpected("`,` or `)`", token)),
            }
        }
    }
    Ok(values)
}

fn target(line: &mut Line) -> Result<Target, String> {
    Ok(Target { block: block_of(line)?, args: arguments(line)? })
}

fn place(line: &mut Line) -> Result<Place, String> {
    let area = match line.peek() {
        "scratch" => Area::Scratch,
        "leading" => Area::Leading,
        "inputs" => Area::Inputs,
        "outputs" => Area::Outputs,
        _ => Area::Block,
    };
    if area != Area::Block {
        line.token();
    }
    let index = line.number("a slot")?;
    let mut stride = 0;
    if line.peek() == "stride" {
        line.token();
        stride = line.number("a stride")?;
    }
    Ok(Place { area, index, stride })
}

fn end(first: &str, line: &mut Line) -> Result<Terminator, String> {
    Ok(match first {
        "jump" => Terminator::Jump(target(line)?),
        "branch" => Terminator::Branch { when: line.value()?, yes: target(line)?, no: target(line)? },
        "switch" => {
            let slot = line.slot()?;
            let mut cases = Vec::new();
            loop {
                match line.token() {
                    "else" => break,
                    token => {
                        let bits = token.strip_prefix("0x").and_then(|digits| u64::from_str_radix(digits, 16).ok());
                        let bits = bits.ok_or_else(|| unexpected("the bits of a number or `else`", token))?;
                        cases.push((bits, block_of(line)?));
                    }
                }
            }
            Terminator::Switch { slot, cases, default: block_of(line)? }
        }
        "repeat" => {
            let count = match block_id(line.peek()) {
                Some(_) => Count::Call,
                None => Count::Fixed(line.number("a number of iterations or a block")?),
            };
            Terminator::Repeat { count, again: target(line)?, done: target(line)? }
        }
        _ if line.peek().is_empty() => Terminator::Return(None),
        _ => Terminator::Return(Some(line.value()?)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "step, several:
  prepare b5
  piece b6
  scratch 4
  v1 = 1.5
  v6 = int 0
b0 prologue:
  v0 = load 3
  jump b1(v0)
b1 body(v0):
  v2 = mul v0 v1
  v3 = less v0 v2
  call 0
  branch v3 b2 b3
b2 cold:
  v2 = reload 4
  v4 = to_int v2
  branch v4 b4(v4) b3
b3 body:
  store scratch 1 = v3
  switch 4 0x0 b4 0x3ff0000000000000 b5 else b3
b4 prologue(v4):
  return v4
b5 body:
  v5 = reload scratch 2 stride -3
  write 7[v6 < 2] = v5
  repeat 12 b5 b4(v6)
b6 body:
  store 3 stride 2 = v1
  repeat b6 b7
b7 body:
  return
";

    #[test]
    fn a_listing_is_read_back() {
        let text = TEXT.replace("  v6 = int 0\n", "  v5 = load 9\n  v6 = int 0\n");
        let cfg = parse_cfg(&text).unwrap();
        assert_eq!(cfg.to_string(), text);
        assert_eq!(parse_cfg(&format!("; a loop\n\n{text}")), Ok(cfg));
    }

    #[test]
    fn errors_say_line_and_cause() {
        let named = "line 1: expected a name, a comma, one of `single`, `single_or_several`, `several`, `piece`, and `:`, \
                     not `f:`";
        for (text, expected) in [
            ("", "line 1: no function: its name is missing"),
            ("f:\n", named),
            ("f, single:\nb1 body:\n", "line 2: expected `b0`, not `b1`"),
            ("f, single:\nb0 bdy:\n", "line 2: expected `prologue`, `body` or `cold`, not `bdy`"),
            ("f, single:\nb0 body:\n  jmp b0\n", "line 3: expected a value or an instruction, not `jmp`"),
            ("f, single:\nb0 body:\n  jump\n", "line 3: expected a block, but the line ends"),
            ("f, single:\nb0 body:\n  jump b0(v1\n", "line 3: expected `,` or `)`, but the line ends"),
            ("f, single:\nb0 body:\n  return\n  call 0\n", "line 4: `call` follows the end of its block"),
            ("f, single:\nb0 body:\n  v0 = load 3\n", "line 3: b0 has no end, such as `return`"),
            ("f, single:\n  v0 = 1.0\nb0 body:\n  v0 = 2.0\n  return\n", "line 4: v0 is `1.0` in line 2"),
            ("f, single:\nb0 body:\n  v1 = 2.0\n  return\n", "line 4: v0 is missing"),
            (
                "f, single:\nb0 body:\n  switch 4 1 b0 else b0\n",
                "line 3: expected the bits of a number or `else`, not `1`",
            ),
        ] {
            assert_eq!(parse_cfg(text).unwrap_err().to_string(), expected, "{text}");
        }
    }
}
