//! Wraps a step in the loop over steps; the values that one step hands to the next stay in registers.
//!
//! In: a step in one block, and perhaps its leading loop. Out:
//!
//! ```text
//! b0 prologue   loads what is carried; goes to b1
//! b1 body       the step; goes to b3 if its status is not 0, else to b2
//! b2 body       stores what is carried in memory; repeats b1 or goes to b3
//! b3 prologue   stores everything, once per call; returns the status
//! ```
//! Carried slots are parameters of b1 or, if they are many, remain in the block. If the graph has rows, b1 reads the inputs
//! of these from the row of the step, and writes a row of outputs, also where its status is not 0. Source: Lu, Cooper, *Register Promotion
//! in C Programs*, PLDI 1997.

use crate::ir::cfg::{Area, Block, BlockId, Cfg, Count, Entry, Inst, Part, Place, Rows, Target, Terminator};
use crate::ir::hash::{HashMap, HashSet};
use crate::ir::{Func, Op, Value};
use abi::Slot;

/// Maximum number of slots that a loop carries in registers. More would be spilled anyway, and the time of register
/// allocation grows with the square of their number.
pub const MAX_IN_REGISTERS: usize = 24;

/// Whether no iteration reads anything that an iteration writes: then one iteration is enough.
pub fn is_idempotent(func: &Func) -> bool {
    let stored: HashSet<Slot> = func.stores.iter().map(|(slot, _)| *slot).collect();
    func.writes.is_empty() && func.loads().iter().all(|slot| !stored.contains(slot))
}

/// Forms the loop.
pub fn form_loop(cfg: &mut Cfg) {
    let Some(func) = cfg.straight_line(BlockId(0)) else { return };
    let leading = cfg.leading.take();
    // The values of the leading loop are loads from slots after the block.
    let first_leading = leading.as_ref().map(|leading| leading.size);
    let rows = cfg.rows.take();
    *cfg = Cfg { leading, rows: rows.clone(), ..Cfg::straight(&func, Entry::Several) };
    let stored: HashMap<Slot, Value> = func.stores.iter().copied().collect();
    let load = |value: Value| if let Op::Load(slot) = func.op(value) { Some(slot) } else { None };
    let carried: Vec<(Value, Slot, Value)> = (0..func.ops.len() as u32)
        .map(Value)
        .filter_map(|value| load(value).and_then(|slot| Some((value, slot, *stored.get(&slot)?))))
        .collect();
    let in_registers = carried.len() <= MAX_IN_REGISTERS;
    let params: Vec<Value> = if in_registers { carried.iter().map(|(value, ..)| *value).collect() } else { Vec::new() };
    let next = if in_registers { carried.iter().map(|(.., stored)| *stored).collect() } else { Vec::new() };
    let of_leading = |value: Value| load(value).and_then(|slot| slot.0.checked_sub(first_leading? as u32));
    let in_row = |slot: Slot| rows.as_ref().and_then(|rows| rows.inputs.iter().position(|input| *input == slot));
    let from_row = |value: Value| load(value).and_then(in_row).map(|column| row_place(Area::Inputs, column));
    let step = std::mem::take(&mut cfg.blocks[0].insts);
    let mut insts: Vec<Inst> = Vec::new();
    for inst in step {
        match inst {
            Inst::Compute(value) if params.contains(&value) => {}
            Inst::Compute(value) => insts.push(match (of_leading(value), from_row(value)) {
                (Some(index), _) => Inst::Reload(value, Place { area: Area::Leading, index, stride: 1 }),
                (_, Some(place)) => Inst::Reload(value, place),
                (None, None) => Inst::Compute(value),
            }),
            Inst::Store(..) => {}
            other => insts.push(other),
        }
    }
    if let Some(rows) = &rows {
        write_row(cfg, rows, &stored, &params, &mut insts);
    }
    let [head, latch, exit] = [1, 2, 3].map(BlockId);
    let args = params.clone();
    cfg.blocks[0] = Block {
        part: Part::Prologue,
        params: Vec::new(),
        insts: params.iter().copied().map(Inst::Compute).collect(),
        end: Terminator::Jump(Target { block: head, args }),
    };
    let zero = func.status.map(|_| {
        cfg.ops.push(Op::Int(0));
        Value(cfg.ops.len() as u32 - 1)
    });
    let end = match func.status {
        None => Terminator::Jump(latch.into()),
        Some(status) => {
            Terminator::Branch { when: status, yes: Target { block: exit, args: vec![status] }, no: latch.into() }
        }
    };
    cfg.block(Block { part: Part::Body, params, insts, end });
    let store = |(slot, value): (Slot, Value)| Inst::Store(Place::slot(slot), value);
    let in_memory = if in_registers { &[][..] } else { &carried[..] };
    cfg.block(Block {
        part: Part::Body,
        params: Vec::new(),
        insts: in_memory.iter().map(|(_, slot, value)| store((*slot, *value))).collect(),
        end: Terminator::Repeat {
            count: Count::Call,
            again: Target { block: head, args: next },
            done: Target { block: exit, args: zero.into_iter().collect() },
        },
    });
    cfg.block(Block {
        part: Part::Prologue,
        params: func.status.into_iter().collect(),
        insts: func.stores.iter().copied().map(store).collect(),
        end: Terminator::Return(func.status),
    });
}

/// The place of a column in the row of each step.
fn row_place(area: Area, column: usize) -> Place {
    Place { area, index: column as u32, stride: 1 }
}

/// Appends the stores of a row of outputs. `params`: values that the block has as parameters.
fn write_row(cfg: &mut Cfg, rows: &Rows, stored: &HashMap<Slot, Value>, params: &[Value], insts: &mut Vec<Inst>) {
    for (column, slot) in rows.outputs.iter().enumerate() {
        let value = stored.get(slot).copied().unwrap_or_else(|| {
            // A step leaves this slot as it is: an input or a parameter.
            let is_there = |inst: &&Inst| match inst {
                Inst::Compute(value) | Inst::Reload(value, _) => cfg.op(*value) == Op::Load(*slot),
                _ => false,
            };
            if let Some(Inst::Compute(value) | Inst::Reload(value, _)) = insts.iter().find(is_there) {
                return *value;
            }
            debug_assert!(!params.iter().any(|value| cfg.op(*value) == Op::Load(*slot)), "a carried slot is stored");
            cfg.ops.push(Op::Load(*slot));
            let value = Value(cfg.ops.len() as u32 - 1);
            let input = rows.inputs.iter().position(|input| input == slot);
            insts.push(
                input.map_or(Inst::Compute(value), |column| Inst::Reload(value, row_place(Area::Inputs, column))),
            );
            value
        });
        insts.push(Inst::Store(row_place(Area::Outputs, column), value));
    }
}
