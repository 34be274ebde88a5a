//! The same program for many instances at once, in vectors: a straight line with a loop around it, and the bits of a
//! single instance in every lane. The vectors of x86-64 have an encoder of their own here, of two lanes too; pairs of any
//! processor are Cranelift's.
//!
//! In: a step, expanded or not. Out: [`Lanes`]. Several vectors go side by side, operation by operation, because one alone waits
//! for itself. What no step changes is computed before the loop; what only the last step leaves behind (outputs) is
//! computed in the last step. Two areas hold what one step hands to the next, in turn, so that a step at which a lane
//! fails can be done again in full, with its status.
//!
//! ```text
//! entry:  compute what no step changes; copy the carried slots to the first area
//! loop:   if this is the last step: final
//!         carried slots, from one area to the other; if a lane fails: final
//!         exchange the areas; loop
//! final:  everything, from the area to the block, with statuses; return the number of steps done
//! ```

mod assembler;
mod isel;
mod schedule;
mod regalloc;

use super::target::{FunctionCompiler, here};
use super::unsupported::Unsupported;
use crate::codegen::executable_memory::Executable;
use crate::codegen::lanes::assembler::{Assembler, Base, Vectors, instructions};
use crate::codegen::lanes::isel::{MachineOp, Node, Nodes, select};
use crate::codegen::lanes::regalloc::{Home, RegisterAllocator, place_in};
use crate::codegen::lanes::schedule::schedule;
use crate::ir::verify::{Stage, verify};
use crate::ir::{Func, Op, Unary};
use crate::math;
use abi::lanes::{Lanes, LanesEntry};
use abi::{Layout, Slot};
use std::collections::{HashMap, HashSet};
use std::sync::Arc;

/// Which vectors.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Width {
    /// Two lanes: any processor that there is machine code for.
    Pairs,
    /// Two lanes: AVX and FMA.
    Avx,
    /// Four lanes: AVX2 and FMA.
    Avx2,
    /// Eight lanes: AVX-512 F and DQ.
    Avx512,
}

impl Width {
    /// All of them, ascending.
    pub const ALL: [Width; 4] = [Width::Pairs, Width::Avx, Width::Avx2, Width::Avx512];

    /// The widest of this processor.
    pub fn here() -> Option<Width> {
        Width::here_all().next()
    }

    /// Those of this processor, the widest first.
    pub fn here_all() -> impl Iterator<Item = Width> {
        Width::ALL.into_iter().rev().filter(|width| width.is_here())
    }

    /// Whether this processor has it, with the calling convention that the code is made for.
    pub fn is_here(self) -> bool {
        match self.own() {
            Some(vectors) => vectors.are_here(),
            None => here().is_ok(),
        }
    }

    /// Lanes of a vector.
    pub fn lanes(self) -> usize {
        self.own().map_or(crate::codegen::emit_f64x2::LANES, Vectors::lanes)
    }

    /// Vectors side by side that pay on current processors.
    pub fn vectors(self) -> usize {
        match self {
            Width::Pairs => 2,
            Width::Avx => 4,
            Width::Avx2 | Width::Avx512 => 3,
        }
    }

    /// As its maker calls it.
    pub fn name(self) -> &'static str {
        match self {
            Width::Pairs => "pairs",
            Width::Avx => "AVX",
            Width::Avx2 => "AVX2",
            Width::Avx512 => "AVX-512",
        }
    }

    /// Vectors of our own encoder.
    fn own(self) -> Option<Vectors> {
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
            Vectors::Avx => std::arch::is_x86_feature_detected!("avx") && std::arch::is_x86_feature_detected!("fma"),
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

/// Machine code of a step for many instances, in the widest vectors of this processor that have instructions for it.
///
/// # Errors
/// Why the widest have none, if no others have.
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

/// Machine code of a step for as many instances as `vectors` vectors have lanes.
///
/// # Errors
/// If this processor does not have the width, or the width no instruction for an operation.
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
    let Bytes { code, alignment, scratch } = bytes(func, layout, pool_len, width, vectors)?;
    let executable = Executable::new(&code, alignment)?;
    // SAFETY: `address` is the beginning of code with the signature of `LanesEntry`.
    let entry = unsafe { std::mem::transmute::<*const u8, LanesEntry>(executable.address()) };
    let lanes = vectors * width.lanes();
    let name = format!("{} × {vectors}", width.name());
    // SAFETY: the entry lives as long as the memory; `verify` has checked that every slot lies in the layout and every
    // table in the pool, indices are held inside, and what the code needs beyond the block is `scratch`.
    Ok(unsafe { Lanes::new(entry, lanes, layout.size(), scratch, pool_len, name, Arc::new(executable)) })
}

/// The machine code of a step for many instances, before it is made executable.
pub struct Bytes {
    /// The instructions; they begin with the entry.
    pub code: Vec<u8>,
    /// Bytes to a multiple of which the entry must lie.
    pub alignment: u64,
    /// Doubles that the code uses after the blocks.
    pub scratch: usize,
}

/// The instructions of [`compile`], for a processor that has the width; this one need not.
///
/// # Errors
/// If the width has no instruction for an operation.
///
/// # Panics
/// If the function is not sound: a mistake of the passes before.
pub fn bytes(
    func: &Func,
    layout: &Layout,
    pool_len: usize,
    width: Width,
    vectors: usize,
) -> Result<Bytes, Unsupported> {
    verify(func, layout, pool_len, Stage::Lowered).unwrap_or_else(|fault| panic!("{fault}"));
    let own: &[Unary] = match width {
        Width::Avx512 => &[Unary::Exp],
        Width::Avx2 | Width::Avx | Width::Pairs => &[],
    };
    // Expanding works on the pool that every model begins with; what needs none may run with any.
    let elementary = func.ops.iter().any(|op| matches!(op, Op::Unary(..) | Op::Binary(..)));
    let expanded = elementary.then(|| math::expand_for_lanes(func, own));
    let func = expanded.as_ref().unwrap_or(func);
    match width.own() {
        Some(own) => {
            let (code, scratch) = generate(func, layout, own, vectors, elementary)?;
            Ok(Bytes { code, alignment: 64, scratch })
        }
        None => {
            let (bytes, scratch) = FunctionCompiler::new(here()?).pairs(func, layout, vectors)?;
            Ok(Bytes { code: bytes.code, alignment: bytes.alignment as u64, scratch })
        }
    }
}

/// The code, and the numbers it needs behind the block. `pooled`: the pool begins with the tables of the elementary functions.
fn generate(
    func: &Func,
    layout: &Layout,
    width: Vectors,
    vectors: usize,
    pooled: bool,
) -> Result<(Vec<u8>, usize), Unsupported> {
    let nodes = select(func, width, pooled)?;
    let stored: HashSet<Slot> = func.stores.iter().map(|(slot, _)| *slot).collect();
    let loaded: HashSet<Slot> = func.loads().into_iter().collect();
    let carried: Vec<(Slot, Node)> = nodes.stores.iter().copied().filter(|(slot, _)| loaded.contains(slot)).collect();
    // A step that hands nothing on is done once, and nothing before it.
    let varies = if carried.is_empty() { vec![true; nodes.nodes.len()] } else { varying(&nodes, &stored) };

    // Behind the block: two areas of what is carried, what is computed once, what registers have no room for.
    let vector = width.bytes() as usize;
    let areas = [0, 1].map(|area| (layout.size() + area * carried.len()) * vectors * vector);
    let mut roots: Vec<Node> = carried.iter().map(|(_, node)| *node).chain(nodes.failed).collect();
    let fast = schedule(&nodes, &roots, &varies);
    roots = nodes.stores.iter().map(|(_, node)| *node).chain(nodes.status).collect();
    let full = schedule(&nodes, &roots, &varies);
    let once = needed_once(&nodes, &[&fast, &full], nodes.failed, &varies);
    let once_at = areas[1] + carried.len() * vectors * vector;
    let before = schedule(&nodes, &once, &varies.iter().map(|varies| !varies).collect::<Vec<_>>());
    let spills_at = once_at + once.len() * vectors * vector;

    let mut homes: HashMap<Node, Home> = HashMap::new();
    for (index, node) in nodes.nodes.iter().enumerate() {
        if let MachineOp::Load(slot) = node {
            let home = match carried.iter().position(|(known, _)| known == slot) {
                Some(index) => Home { base: Base::Before, begin: 0, index },
                None => Home { base: Base::Block, begin: 0, index: slot.index() },
            };
            homes.insert(Node(index as u32), home);
        }
    }
    let mut code = Assembler::new(width);
    let none = {
        code.plain(&[0x48, 0x85, 0xd2]); // test rdx, rdx
        code.jump(&[0x0f, 0x84]) // jz
    };
    if width != Vectors::Avx512 {
        code.reach_tables();
    }
    let mut most = 0;
    let store_once = |node: Node| {
        once.iter().position(|known| *known == node).map(|index| Home { base: Base::Block, begin: once_at, index })
    };
    let mut body = RegisterAllocator::new(&mut code, &nodes, &before, &homes, width, vectors, spills_at);
    body.write(&|node| store_once(node).into_iter().collect(), &[]);
    most = most.max(body.spilled());
    for (index, node) in once.iter().enumerate() {
        homes.insert(*node, Home { base: Base::Block, begin: once_at, index });
    }
    for (index, (slot, _)) in carried.iter().enumerate() {
        for k in 0..vectors {
            code.vector(instructions::LOAD, 0, 0, place_in(Base::Block, 0, slot.index(), vectors, k, width), None);
            code.vector(instructions::STORE, 0, 0, place_in(Base::Block, areas[0], index, vectors, k, width), None);
        }
    }
    for (area, opcode) in areas.into_iter().zip([0x87, 0x8f]) {
        code.plain(&[0x4c, 0x8d, opcode]); // lea r8 or r9, [rdi + area]
        code.plain(&(area as i32).to_le_bytes());
    }
    code.plain(&[0x31, 0xc0]); // xor eax, eax
    code.plain(&[0x48, 0xff, 0xca]); // dec rdx
    let top = code.here();
    code.plain(&[0x48, 0x39, 0xd0]); // cmp rax, rdx
    let mut to_final = vec![code.jump(&[0x0f, 0x83])]; // jae
    if !carried.is_empty() {
        let to_area = |node: Node| {
            let of = carried.iter().enumerate().filter(|(_, (_, next))| *next == node);
            of.map(|(index, _)| Home { base: Base::After, begin: 0, index }).collect()
        };
        let rest: Vec<Node> = carried.iter().map(|(_, node)| *node).collect();
        let mut body = RegisterAllocator::new(&mut code, &nodes, &fast, &homes, width, vectors, spills_at);
        if let Some(failed) = nodes.failed {
            body.pin(failed);
        }
        body.write(&to_area, &rest);
        if let Some(failed) = nodes.failed {
            to_final.push(body.test(failed));
        }
        most = most.max(body.spilled());
        code.plain(&[0x48, 0xff, 0xc0]); // inc rax
        code.plain(&[0x4d, 0x87, 0xc8]); // xchg r8, r9
        let again = code.jump(&[0xe9]);
        code.lead(again, top);
    }
    let last = code.here();
    to_final.into_iter().for_each(|jump| code.lead(jump, last));
    let to_block = |node: Node| {
        let stores = nodes.stores.iter().filter(|(_, value)| *value == node);
        let mut homes: Vec<Home> =
            stores.map(|(slot, _)| Home { base: Base::Block, begin: 0, index: slot.index() }).collect();
        homes.extend((nodes.status == Some(node)).then_some(Home { base: Base::Statuses, begin: 0, index: 0 }));
        homes
    };
    let mut body = RegisterAllocator::new(&mut code, &nodes, &full, &homes, width, vectors, spills_at);
    body.write(&to_block, &roots);
    most = most.max(body.spilled());
    if carried.is_empty() {
        code.plain(&[0x48, 0x89, 0xd0]); // mov rax, rdx
    }
    code.plain(&[0x48, 0xff, 0xc0, 0xc5, 0xf8, 0x77, 0xc3]); // inc rax; vzeroupper; ret
    let end = code.here();
    code.lead(none, end);
    code.plain(&[0x31, 0xc0, 0xc5, 0xf8, 0x77, 0xc3]); // xor eax, eax; vzeroupper; ret
    let scratch = (spills_at + most * vector) / 8 - layout.size() * vectors * width.lanes();
    let addressed = (spills_at + most * vector) as u64;
    if addressed > i32::MAX as u64 {
        return Err(Unsupported(format!("`{}` is too large for lanes: {} operations", func.name, func.ops.len())));
    }
    Ok((code.finish(), scratch))
}

/// For each node, whether a step can change it.
fn varying(nodes: &Nodes, stored: &HashSet<Slot>) -> Vec<bool> {
    let mut varies: Vec<bool> = Vec::with_capacity(nodes.nodes.len());
    for node in &nodes.nodes {
        let own = matches!(node, MachineOp::Load(slot) if stored.contains(slot));
        varies.push(own || node.operands().any(|operand| varies[operand.index()]));
    }
    varies
}

/// What no step changes and some step reads, loads and constants apart.
fn needed_once(nodes: &Nodes, orders: &[&[Node]], failed: Option<Node>, varies: &[bool]) -> Vec<Node> {
    let of_order = |node: &Node| nodes.nodes[node.index()].operands().collect::<Vec<_>>();
    let read = orders.iter().flat_map(|order| order.iter().flat_map(of_order));
    let stored = nodes.stores.iter().map(|(_, node)| *node).chain(nodes.status).chain(failed);
    let mut seen = HashSet::new();
    read.chain(stored)
        .filter(|node| !varies[node.index()])
        .filter(|node| !nodes.nodes[node.index()].is_leaf())
        .filter(|node| seen.insert(*node))
        .collect()
}
