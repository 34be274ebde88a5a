//! Vectorised code for many instances of one model: each lane of a vector is an instance, with the bits of a single
//! instance.
//!
//! In: a step, expanded or not. Out: [`Lanes`]. On x86-64 the passes here generate the code: `isel`, `schedule`,
//! `regalloc`, `assembler`; lanes of two for any processor come from Cranelift, see `emit_f64x2`. Several vectors
//! are interleaved operation by operation to hide latency. Loop invariants are hoisted; values that only the last step
//! needs, such as outputs, are computed in the last step only. Carried slots alternate between two areas, so that a
//! step in which a lane fails can be repeated in full, with statuses.
//!
//! [`baseline`] generates scalar code for a single instance by the same passes, without a loop.
//!
//! A loop over [rows](with_rows) also reads inputs from a row and writes outputs to one in each step.
//!
//! ```text
//! entry:  compute the loop invariants; copy the carried slots to the first area
//! loop:   if this is the last step: go to final
//!         compute the carried slots, from one area to the other; if a lane fails: go to final
//!         exchange the areas; go to loop
//! final:  compute everything, from the area to the block, with statuses; return the number of steps done
//! ```

mod assembler;
mod isel;
mod schedule;
mod regalloc;
pub mod baseline;

use super::target::{FunctionCompiler, here, most_lanes};
use super::unsupported::Unsupported;
use crate::codegen::executable_memory::Executable;
use crate::codegen::lanes::assembler::{Assembler, Base, Vectors};
use crate::codegen::lanes::isel::{MachineOp, NodeId, select};
use crate::codegen::lanes::regalloc::{Home, RegisterAllocator, place_in};
use crate::codegen::loop_plan::{LoopPlan, plan};
use crate::ir::cfg::Rows;
use crate::ir::hash::HashMap;
use crate::ir::verify::{Stage, verify};
use crate::ir::{Func, Unary};
use crate::math;
use abi::lanes::{FollowLanes, FollowLanesEntry, Lanes, LanesEntry};
use abi::{Layout, Slot};
use std::borrow::Cow;
use std::sync::Arc;

/// Kind of vector.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Width {
    /// Two lanes: any processor that there is machine code for, through Cranelift.
    Pairs,
    /// Two lanes: AVX and FMA.
    Avx,
    /// Four lanes: AVX2 and FMA.
    Avx2,
    /// Eight lanes: AVX-512 F and DQ.
    Avx512,
}

impl Width {
    /// All widths, ascending.
    pub const ALL: [Width; 4] = [Width::Pairs, Width::Avx, Width::Avx2, Width::Avx512];

    /// The widest of this processor.
    pub fn here() -> Option<Width> {
        Width::here_all().next()
    }

    /// The widths of this processor, the widest first.
    pub fn here_all() -> impl Iterator<Item = Width> {
        Width::ALL.into_iter().rev().filter(|width| width.is_here())
    }

    /// Whether this processor has it, and the calling convention of the generated code, and it is not
    /// [too wide](super::target::limit_lanes).
    pub fn is_here(self) -> bool {
        let has = match self.vectors_of_x64() {
            Some(vectors) => vectors.are_here(),
            None => here().is_ok(),
        };
        has && self.lanes() <= most_lanes()
    }

    /// Lanes of a vector.
    pub fn lanes(self) -> usize {
        self.vectors_of_x64().map_or(crate::codegen::emit_f64x2::LANES, Vectors::lanes)
    }

    /// Number of interleaved vectors that is fastest on current processors.
    pub fn vectors(self) -> usize {
        match self {
            Width::Pairs => 2,
            Width::Avx => 4,
            Width::Avx2 | Width::Avx512 => 3,
        }
    }

    /// The name that its vendor uses; for reports.
    pub fn name(self) -> &'static str {
        match self {
            Width::Pairs => "pairs",
            Width::Avx => "AVX",
            Width::Avx2 => "AVX2",
            Width::Avx512 => "AVX-512",
        }
    }

    /// The kind of vector for our own assembler; none: Cranelift.
    fn vectors_of_x64(self) -> Option<Vectors> {
        match self {
            Width::Pairs => None,
            Width::Avx => Some(Vectors::Avx),
            Width::Avx2 => Some(Vectors::Avx2),
            Width::Avx512 => Some(Vectors::Avx512),
        }
    }
}

impl Vectors {
    #[cfg(all(target_arch = "x86_64", unix))]
    fn are_here(self) -> bool {
        match self {
            Vectors::Scalar | Vectors::Avx => {
                std::arch::is_x86_feature_detected!("avx") && std::arch::is_x86_feature_detected!("fma")
            }
            Vectors::Avx2 => std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma"),
            Vectors::Avx512 => {
                std::arch::is_x86_feature_detected!("avx512f") && std::arch::is_x86_feature_detected!("avx512dq")
            }
        }
    }

    #[cfg(not(all(target_arch = "x86_64", unix)))]
    fn are_here(self) -> bool {
        false
    }
}

/// Compiles a step for many instances, in the widest vectors of this processor that have instructions for all
/// operations.
///
/// # Errors
/// The reason why the widest vectors do not, if no others do either.
///
/// # Panics
/// As [`compile`].
pub fn widest(func: &Func, layout: &Layout, pool_len: usize) -> Result<Lanes, Unsupported> {
    let mut refused = None;
    for width in Width::here_all() {
        match compile(func, layout, pool_len, width, width.vectors()) {
            Ok(lanes) => return Ok(lanes),
            Err(why) => refused = refused.or(Some(why)),
        }
    }
    Err(refused.unwrap_or_else(|| Unsupported("there is no machine code for this processor".into())))
}

/// Compiles a step for `vectors` interleaved vectors of instances.
///
/// # Errors
/// If this processor does not have the width, or the width has no instruction for an operation.
///
/// # Panics
/// As [`bytes`].
pub fn compile(
    func: &Func,
    layout: &Layout,
    pool_len: usize,
    width: Width,
    vectors: usize,
) -> Result<Lanes, Unsupported> {
    if !width.is_here() {
        return Err(Unsupported(format!("this processor lacks {}", width.name())));
    }
    let Bytes { code, alignment, scratch } = bytes(func, layout, pool_len, width, vectors, None)?;
    let executable = Executable::new(&code, alignment)?;
    // SAFETY: `address` is the start of code with the signature of `LanesEntry`.
    let entry = unsafe { std::mem::transmute::<*const u8, LanesEntry>(executable.address()) };
    let lanes = vectors * width.lanes();
    let name = format!("{} × {vectors}", width.name());
    // SAFETY: the entry lives as long as the memory; `verify` has checked that every slot lies in the layout and every
    // table in the pool, indices are clamped, and `scratch` counts what the code needs beyond the block.
    Ok(unsafe { Lanes::new(entry, lanes, layout.size(), scratch, pool_len, name, Arc::new(executable)) })
}

/// Adds to the code of a step for many instances a loop over rows of inputs and outputs, for the same vectors.
///
/// # Errors
/// If these vectors have no such loop.
///
/// # Panics
/// As [`bytes`].
pub fn with_rows(
    lanes: Lanes,
    func: &Func,
    layout: &Layout,
    pool_len: usize,
    (width, vectors): (Width, usize),
    rows: &Rows,
) -> Result<Lanes, Unsupported> {
    assert_eq!(lanes.width(), vectors * width.lanes(), "the same vectors");
    let Bytes { code, alignment, scratch } = bytes(func, layout, pool_len, width, vectors, Some(rows))?;
    let executable = Executable::new(&code, alignment)?;
    // SAFETY: `address` is the start of code with the signature of `FollowLanesEntry`.
    let entry = unsafe { std::mem::transmute::<*const u8, FollowLanesEntry>(executable.address()) };
    let is_stored = |slot: &Slot| func.stores.iter().any(|(stored, _)| stored == slot);
    let stored = rows.outputs.iter().map(is_stored).collect();
    let (inputs, outputs) = (rows.inputs.clone(), rows.outputs.clone());
    let code = FollowLanes { entry, inputs, outputs, stored, scratch, memory: Arc::new(executable) };
    // SAFETY: as for the step; a row has the numbers of all lanes for each column.
    Ok(unsafe { lanes.with_rows(code) })
}

/// Machine code of a step for many instances, not yet executable.
pub struct Bytes {
    /// The instructions, followed by constants; the entry is at offset 0.
    pub code: Vec<u8>,
    /// Required alignment in bytes.
    pub alignment: u64,
    /// Doubles that the code uses after the blocks.
    pub scratch: usize,
}

/// Generates the code of [`compile`] or, with rows, of [`with_rows`], for any processor that has the width.
///
/// # Errors
/// If the width has no instruction for an operation, or no loop over rows.
///
/// # Panics
/// If the function does not verify: a mistake of an earlier pass.
pub fn bytes(
    func: &Func,
    layout: &Layout,
    pool_len: usize,
    width: Width,
    vectors: usize,
    rows: Option<&Rows>,
) -> Result<Bytes, Unsupported> {
    let own: &[Unary] = match width {
        Width::Avx512 => &[Unary::Exp],
        Width::Avx2 | Width::Avx | Width::Pairs => &[],
    };
    let (func, pooled) = expanded(func, layout, pool_len, |func| math::expand_for_lanes(func, own));
    let func = &*func;
    match width.vectors_of_x64() {
        Some(own) => {
            let (code, scratch) = generate(func, layout, own, vectors, pooled, rows)?;
            Ok(Bytes { code, alignment: 64, scratch })
        }
        None if rows.is_some() => Err(Unsupported("pairs have no loop over rows".into())),
        None => {
            let (bytes, scratch) = FunctionCompiler::new(here()?).pairs(func, layout, vectors)?;
            Ok(Bytes { code: bytes.code, alignment: bytes.alignment as u64, scratch })
        }
    }
}

/// Expands the elementary functions of a function, and verifies the result. Also returns whether there are any: then the
/// pool must begin with their tables, as that of every model does. A function without any works with any pool.
fn expanded<'f>(
    func: &'f Func,
    layout: &Layout,
    pool_len: usize,
    expand: impl FnOnce(&Func) -> Func,
) -> (Cow<'f, Func>, bool) {
    let pooled = func.has_elementary_functions();
    let func = if pooled { Cow::Owned(expand(func)) } else { Cow::Borrowed(func) };
    verify(&func, layout, pool_len, Stage::Lowered).unwrap_or_else(|fault| panic!("{fault}"));
    (func, pooled)
}

/// Generates the code; also returns the number of doubles it needs after the blocks. `pooled`: the pool begins with the
/// tables of the elementary functions.
fn generate(
    func: &Func,
    layout: &Layout,
    width: Vectors,
    vectors: usize,
    pooled: bool,
    rows: Option<&Rows>,
) -> Result<(Vec<u8>, usize), Unsupported> {
    let nodes = select(func, width, pooled)?;
    let vector = width.bytes() as usize;
    let LoopPlan {
        carried,
        recorded,
        hoisted,
        prologue,
        body: body_order,
        last: final_order,
        areas,
        hoisted_at,
        end: spills_at,
    } = plan(&nodes, layout.size(), vectors * vector, rows);
    let column = |slot: Slot| rows.and_then(|rows| rows.inputs.iter().position(|input| *input == slot));
    let to_rows = || {
        let home = |column| Home { base: Base::Outputs, begin: 0, index: column };
        recorded.iter().map(move |(column, node)| (*node, home(*column)))
    };
    let mut homes: Vec<Option<Home>> = vec![None; nodes.nodes.len()];
    for (index, node) in nodes.nodes.iter().enumerate() {
        if let MachineOp::Load(slot) = node {
            let home = match (carried.iter().position(|(known, _)| known == slot), column(*slot)) {
                (Some(index), _) => Home { base: Base::Before, begin: 0, index },
                (None, Some(index)) => Home { base: Base::Inputs, begin: 0, index },
                (None, None) => Home { base: Base::Block, begin: 0, index: slot.index() },
            };
            homes[index] = Some(home);
        }
    }
    let mut code = Assembler::new(width);
    let none = {
        code.raw(&[0x48, 0x85, 0xd2]); // test rdx, rdx
        code.jump(&[0x0f, 0x84]) // jz
    };
    if rows.is_some() {
        code.raw(&[0x41, 0x56, 0x41, 0x57]); // push r14; push r15
        code.raw(&[0x4d, 0x89, 0xc6, 0x4d, 0x89, 0xcf]); // mov r14, r8; mov r15, r9
    }
    if width != Vectors::Avx512 {
        code.load_table_address();
    }
    let mut spill_slots = 0;
    let hoisted_home = |index| Home { base: Base::Block, begin: hoisted_at, index };
    let store_hoisted = hoisted.iter().enumerate().map(|(index, node)| (*node, hoisted_home(index)));
    let mut body =
        RegisterAllocator::new(&mut code, &nodes, &prologue, &homes, width, vectors, (Base::Block, spills_at));
    body.write(&by_node(store_hoisted), &[]);
    spill_slots = spill_slots.max(body.spilled());
    for (index, node) in hoisted.iter().enumerate() {
        homes[node.index()] = Some(hoisted_home(index));
    }
    for (index, (slot, _)) in carried.iter().enumerate() {
        for k in 0..vectors {
            let place = |begin, index| place_in(Base::Block, begin, index, vectors, k, width);
            code.copy(place(0, slot.index()), place(areas[0], index));
        }
    }
    for (area, opcode) in areas.into_iter().zip([0x87, 0x8f]) {
        code.raw(&[0x4c, 0x8d, opcode]); // lea r8 or r9, [rdi + area]
        code.raw(&(area as i32).to_le_bytes());
    }
    code.raw(&[0x31, 0xc0]); // xor eax, eax
    code.raw(&[0x48, 0xff, 0xca]); // dec rdx
    let top = code.position();
    code.raw(&[0x48, 0x39, 0xd0]); // cmp rax, rdx
    let mut to_final = vec![code.jump(&[0x0f, 0x83])]; // jae
    let is_loop = !carried.is_empty() || rows.is_some();
    if is_loop {
        let after = |index| Home { base: Base::After, begin: 0, index };
        let to_area = carried.iter().enumerate().map(|(index, (_, next))| (*next, after(index)));
        let all = carried.iter().map(|(_, node)| *node).chain(recorded.iter().map(|(_, node)| *node));
        let carried_values: Vec<NodeId> = all.collect();
        let mut body =
            RegisterAllocator::new(&mut code, &nodes, &body_order, &homes, width, vectors, (Base::Block, spills_at));
        if let Some(failed) = nodes.failed {
            body.pin(failed);
        }
        body.write(&by_node(to_area.chain(to_rows())), &carried_values);
        if let Some(failed) = nodes.failed {
            to_final.push(body.branch_if_any(failed));
        }
        spill_slots = spill_slots.max(body.spilled());
        code.raw(&[0x48, 0xff, 0xc0]); // inc rax
        code.raw(&[0x4d, 0x87, 0xc8]); // xchg r8, r9
        if let Some(rows) = rows {
            for (opcode, columns) in [(0xc6, rows.inputs.len()), (0xc7, rows.outputs.len())] {
                code.raw(&[0x49, 0x81, opcode]); // add r14 or r15, the distance of two rows
                code.raw(&((columns * vectors * vector) as i32).to_le_bytes());
            }
        }
        let again = code.jump(&[0xe9]);
        code.bind(again, top);
    }
    let last = code.position();
    to_final.into_iter().for_each(|jump| code.bind(jump, last));
    let to_block =
        nodes.stores.iter().map(|(slot, node)| (*node, Home { base: Base::Block, begin: 0, index: slot.index() }));
    let to_status = nodes.status.map(|node| (node, Home { base: Base::Statuses, begin: 0, index: 0 }));
    let mut body =
        RegisterAllocator::new(&mut code, &nodes, &final_order, &homes, width, vectors, (Base::Block, spills_at));
    body.write(&by_node(to_block.chain(to_status).chain(to_rows())), &nodes.results().collect::<Vec<_>>());
    spill_slots = spill_slots.max(body.spilled());
    if !is_loop {
        code.raw(&[0x48, 0x89, 0xd0]); // mov rax, rdx
    }
    if rows.is_some() {
        code.raw(&[0x41, 0x5f, 0x41, 0x5e]); // pop r15; pop r14
    }
    code.raw(&[0x48, 0xff, 0xc0, 0xc5, 0xf8, 0x77, 0xc3]); // inc rax; vzeroupper; ret
    let end = code.position();
    code.bind(none, end);
    code.raw(&[0x31, 0xc0, 0xc5, 0xf8, 0x77, 0xc3]); // xor eax, eax; vzeroupper; ret
    let scratch = (spills_at + spill_slots * vector) / 8 - layout.size() * vectors * width.lanes();
    let addressed = (spills_at + spill_slots * vector) as u64;
    if addressed > i32::MAX as u64 {
        return Err(Unsupported(format!("`{}` is too large for lanes: {} operations", func.name, func.ops.len())));
    }
    Ok((code.finish(), scratch))
}

/// Groups stores by the node that is stored.
fn by_node(stores: impl Iterator<Item = (NodeId, Home)>) -> HashMap<NodeId, Vec<Home>> {
    let mut of: HashMap<NodeId, Vec<Home>> = HashMap::default();
    stores.for_each(|(node, home)| of.entry(node).or_default().push(home));
    of
}
