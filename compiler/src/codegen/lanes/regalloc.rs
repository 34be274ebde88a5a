//! Linear register allocation for a straight line, together with the emission of its instructions.
//!
//! In: selected nodes and their order. Out: instructions in an [`Assembler`], for several interleaved vectors. The next
//! use of each value is known, so if no register is free, the value with the furthest next use is evicted, preferably
//! one that is in memory already. Loads, constants and hoisted values are in memory; most instructions can read one
//! operand from there. A memory operand that is read again, as constants are by each vector, is loaded into a register
//! if one is free.
//!
//! Source: Belady, *A Study of Replacement Algorithms for a Virtual-Storage Computer*, 1966.

use crate::codegen::lanes::assembler::{Assembler, Base, Instruction, Place, Vectors, ZEROING, instructions as i};
use crate::codegen::lanes::isel::{Direction, MachineOp, NodeId, Nodes, Signs};
use crate::ir::hash::HashMap;
use crate::math;
use std::ops::Range;

/// The place of a node's vectors in memory: group `index` of vectors after `begin` bytes.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Home {
    pub base: Base,
    pub begin: usize,
    pub index: usize,
}

/// The memory operand for vector `k` of the group `index` after `begin` bytes.
pub fn place_in(base: Base, begin: usize, index: usize, vectors: usize, k: usize, width: Vectors) -> Place {
    Place::Memory(base, (begin + (index * vectors + k) * width.bytes() as usize) as i32)
}

/// One vector of a node. Nodes that all vectors share have the first one only.
#[derive(Clone, Copy)]
struct VirtualRegister {
    node: NodeId,
    k: usize,
}

/// Where the nodes of a straight line are read.
struct Uses {
    /// For each node the range of `positions` with its reads that are still to come.
    rest: Vec<Range<u32>>,
    /// The positions of all reads, node by node, for each node ascending.
    positions: Vec<u32>,
}

impl Uses {
    fn new(nodes: &Nodes, order: &[NodeId]) -> Uses {
        let reads = |node: &NodeId| nodes.nodes[node.index()].operands();
        let mut rest = vec![0..0; nodes.nodes.len()];
        order.iter().flat_map(reads).for_each(|read| rest[read.index()].end += 1);
        let mut all = 0;
        for Range { start, end } in &mut rest {
            (*start, all) = (all, all + *end);
            *end = *start;
        }
        let mut positions = vec![0; all as usize];
        for (at, node) in order.iter().enumerate() {
            for read in reads(node) {
                let end = &mut rest[read.index()].end;
                positions[*end as usize] = at as u32;
                *end += 1;
            }
        }
        Uses { rest, positions }
    }

    /// The positions where a node is read that have not been [passed](Uses::pass), ascending.
    fn of(&self, node: NodeId) -> &[u32] {
        let Range { start, end } = self.rest[node.index()];
        &self.positions[start as usize..end as usize]
    }

    /// Drops the reads of these nodes at a position whose code has been emitted.
    fn pass(&mut self, at: usize, nodes: impl Iterator<Item = NodeId>) {
        for node in nodes {
            while self.of(node).first() == Some(&(at as u32)) {
                self.rest[node.index()].start += 1;
            }
        }
    }
}

/// What a register holds. An eviction compares all registers, so the next use is kept and not searched for each time.
#[derive(Clone, Copy)]
struct Held {
    virtual_register: VirtualRegister,
    next_use: Option<usize>,
    is_in_memory: bool,
}

/// Register allocation and emission of one straight line.
pub struct RegisterAllocator<'a> {
    code: &'a mut Assembler,
    nodes: &'a Nodes,
    order: &'a [NodeId],
    homes: &'a [Option<Home>],
    width: Vectors,
    vectors: usize,
    uses: Uses,
    /// A node that is live to the end of the line.
    pinned: Option<NodeId>,
    /// The register that holds each virtual register, or none, by [`index`](Self::index).
    register: Vec<Option<u8>>,
    /// The spill slot of each virtual register, or none, by the same.
    spills: Vec<Option<u32>>,
    free_spills: Vec<u32>,
    freed_by_instruction: Vec<u32>,
    spilled: usize,
    /// The spill slots begin so many bytes after this base.
    spills_at: (Base, usize),
    vector_of: Vec<Option<Held>>,
    mask_of: Vec<Option<Held>>,
    /// Registers that the current instruction reads or writes, which must not be evicted: a bit for each vector register,
    /// and a bit for each mask register.
    locked: [u32; 2],
    /// The current position in the order, and the current vector.
    now: (usize, usize),
}

impl<'a> RegisterAllocator<'a> {
    /// An allocator without any values in registers. Spill slots begin at `spills_at` bytes after a base.
    pub fn new(
        code: &'a mut Assembler,
        nodes: &'a Nodes,
        order: &'a [NodeId],
        homes: &'a [Option<Home>],
        width: Vectors,
        vectors: usize,
        spills_at: (Base, usize),
    ) -> RegisterAllocator<'a> {
        RegisterAllocator {
            code,
            nodes,
            order,
            homes,
            width,
            vectors,
            uses: Uses::new(nodes, order),
            pinned: None,
            register: vec![None; nodes.nodes.len() * vectors],
            spills: vec![None; nodes.nodes.len() * vectors],
            free_spills: Vec::new(),
            freed_by_instruction: Vec::new(),
            spilled: 0,
            spills_at,
            vector_of: vec![None; width.registers() as usize],
            mask_of: vec![None; 8],
            locked: [0; 2],
            now: (0, 0),
        }
    }

    /// Keeps a node live to the end of the line.
    pub fn pin(&mut self, node: NodeId) {
        self.pinned = Some(node);
    }

    /// The largest number of spill slots used at a time.
    pub fn spilled(&self) -> usize {
        self.spilled
    }

    /// Emits all nodes in order. `stores` says where a node is to be stored as soon as it is computed. Nodes of
    /// `stored_last` that are not in the order are stored at the end.
    pub fn write(&mut self, stores: &HashMap<NodeId, Vec<Home>>, stored_last: &[NodeId]) {
        let order = self.order;
        let mut is_done = vec![false; self.nodes.nodes.len()];
        let homes = |node: NodeId| stores.get(&node).map_or(&[][..], Vec::as_slice);
        for (at, node) in order.iter().enumerate() {
            is_done[node.index()] = true;
            for k in 0..self.vectors {
                self.now = (at, k);
                self.node(*node);
                for home in homes(*node) {
                    let register = self.in_register(*node);
                    self.store(*node, register, self.at_home(*home, k));
                }
                self.end_instruction(*node);
            }
            self.uses.pass(at, self.op(*node).operands());
        }
        for node in stored_last {
            if std::mem::replace(&mut is_done[node.index()], true) {
                continue;
            }
            for k in 0..self.vectors {
                self.now = (order.len(), k);
                let register = self.in_register(*node);
                for home in homes(*node) {
                    self.store(*node, register, self.at_home(*home, k));
                }
                self.end_instruction(*node);
            }
        }
    }

    /// Emits a jump that is taken if any lane of a mask is set, at the end of the line; the target is still open.
    /// Returns the position of its displacement.
    pub fn branch_if_any(&mut self, mask: NodeId) -> usize {
        self.now = (self.order.len(), 0);
        let all = self.in_register(mask);
        let locked = self.locked;
        for k in 1..self.vectors {
            self.now.1 = k;
            match self.width {
                Vectors::Avx512 => {
                    let more = self.in_register(mask);
                    self.code.mask(i::KORB, all, all, Place::Register(more));
                }
                Vectors::Scalar => unreachable!("a single lane is one vector"),
                Vectors::Avx | Vectors::Avx2 => {
                    let more = self.operand(mask);
                    self.code.vector(i::VORPD, all, all, more, None);
                }
            }
            self.locked = locked;
        }
        match self.width {
            Vectors::Avx512 => self.code.mask(i::KORTESTB, all, 0, Place::Register(all)),
            Vectors::Scalar => unreachable!("baseline code has no loop"),
            Vectors::Avx | Vectors::Avx2 => {
                let l = u8::from(self.width == Vectors::Avx2);
                self.code.raw(&[0xc4, 0x41 | (!all >> 3 & 1) << 5, 0x79 | l << 2, 0x50, 0xd0 | all & 7]);
                self.code.raw(&[0x45, 0x85, 0xd2]); // test r10d, r10d
            }
        }
        self.code.jump(&[0x0f, 0x85])
    }

    fn virtual_register(&self, node: NodeId) -> VirtualRegister {
        VirtualRegister { node, k: if self.op(node).is_shared() { 0 } else { self.now.1 } }
    }

    /// Its place in tables of all virtual registers.
    fn index(&self, VirtualRegister { node, k }: VirtualRegister) -> usize {
        node.index() * self.vectors + k
    }

    fn op(&self, node: NodeId) -> MachineOp {
        self.nodes.nodes[node.index()]
    }

    fn is_mask(&self, node: NodeId) -> bool {
        self.op(node).is_mask(self.width)
    }

    /// Position of the next use of a virtual register after the current instruction; larger is later.
    fn next_use(&self, VirtualRegister { node, k }: VirtualRegister) -> Option<usize> {
        let (at, now) = self.now;
        // Which vector reads it at a place: its own, or the next one if all share it. Beyond the last one: none.
        let reader = |place: usize| match self.op(node).is_shared() {
            false => k,
            true if place == at => now + 1,
            true => 0,
        };
        let is_to_come = |place: usize| place > at || place == at && (now + 1..self.vectors).contains(&reader(place));
        let mut places = self.uses.of(node).iter().map(|place| *place as usize);
        let pinned = (self.pinned == Some(node)).then_some(self.order.len() + 1);
        let place = places.find(|place| is_to_come(*place)).or(pinned)?;
        Some(place * self.vectors + reader(place))
    }

    fn at_home(&self, home: Home, k: usize) -> Place {
        place_in(home.base, home.begin, home.index, self.vectors, k, self.width)
    }

    /// A free spill slot.
    fn free_spill_slot(&mut self) -> u32 {
        self.free_spills.pop().unwrap_or_else(|| {
            self.spilled += 1;
            self.spilled as u32 - 1
        })
    }

    fn spill_operand(&self, number: u32) -> Place {
        let (base, begin) = self.spills_at;
        Place::Memory(base, (begin + number as usize * self.width.bytes() as usize) as i32)
    }

    /// A register or memory operand for a node. A value in memory that is read again is loaded first, if a register is
    /// free until then: processors execute more arithmetic instructions than loads per cycle.
    fn operand(&mut self, node: NodeId) -> Place {
        let virtual_register = self.virtual_register(node);
        let mask = self.is_mask(node);
        if let Some(register) = self.register[self.index(virtual_register)] {
            self.lock(mask, register);
            return Place::Register(register);
        }
        let place = self.memory_operand(node);
        if mask || !self.next_use(virtual_register).is_some_and(|next| self.is_room_until(next)) {
            return place;
        }
        Place::Register(self.load_into_register(node, place))
    }

    /// As [`operand`](Self::operand), for an instruction that has no scalar form: a single lane must be in a register, since
    /// the instruction would read the memory of a pair.
    fn operand_of(&mut self, instruction: Instruction, node: NodeId) -> Place {
        match self.operand(node) {
            place @ Place::Memory(..) if self.width == Vectors::Scalar && instruction.scalar().is_none() => {
                Place::Register(self.load_into_register(node, place))
            }
            place => place,
        }
    }

    /// Loads a node from memory into a register.
    fn load_into_register(&mut self, node: NodeId, place: Place) -> u8 {
        let mask = self.is_mask(node);
        let register = self.allocate(mask);
        self.load(node, register, place);
        let virtual_register = self.virtual_register(node);
        self.assign(virtual_register, mask, register);
        register
    }

    /// Whether a vector register is free, or holds a value that is in memory too and has a later next use than `next`.
    fn is_room_until(&self, next: usize) -> bool {
        let later = |held: Held| held.is_in_memory && held.next_use.is_none_or(|other| other > next);
        let fits =
            |(register, held): (usize, &Option<Held>)| !self.is_locked(false, register) && held.is_none_or(later);
        self.vector_of.iter().enumerate().any(fits)
    }

    /// Whether a virtual register can be read from memory.
    fn is_in_memory(&self, virtual_register: VirtualRegister) -> bool {
        let node = virtual_register.node;
        self.op(node).is_shared()
            || self.homes[node.index()].is_some()
            || self.spills[self.index(virtual_register)].is_some()
    }

    fn memory_operand(&mut self, node: NodeId) -> Place {
        match self.op(node) {
            MachineOp::Constant(bits) => return Place::Constant(bits),
            MachineOp::TableRow(table, second) => return self.code.row(table.row(second)),
            _ => {}
        }
        if let Some(number) = self.spills[self.index(self.virtual_register(node))] {
            return self.spill_operand(number);
        }
        let home = self.homes[node.index()].unwrap_or_else(|| panic!("{:?} lies nowhere", self.op(node)));
        self.at_home(home, self.now.1)
    }

    /// The register of a node, which is loaded if necessary.
    fn in_register(&mut self, node: NodeId) -> u8 {
        match self.operand(node) {
            Place::Register(register) => register,
            place => self.load_into_register(node, place),
        }
    }

    fn load(&mut self, node: NodeId, register: u8, place: Place) {
        match place {
            _ if self.is_mask(node) => self.code.mask(i::KMOVB_LOAD, register, 0, place),
            Place::Constant(_) if self.width == Vectors::Avx512 => {
                self.code.vector(i::VBROADCASTSD, register, 0, place, None);
            }
            Place::Memory(Base::Inputs, _) => self.code.vector(i::VMOVUPD_LOAD, register, 0, place, None),
            place => self.code.vector(i::VMOVAPD_LOAD, register, 0, place, None),
        }
    }

    fn store(&mut self, node: NodeId, register: u8, place: Place) {
        if self.is_mask(node) {
            self.code.mask(i::KMOVB_STORE, register, 0, place);
        } else if let Place::Memory(Base::Outputs, _) = place {
            self.code.vector(i::VMOVUPD_STORE, register, 0, place, None);
        } else {
            self.code.vector(i::VMOVAPD_STORE, register, 0, place, None);
        }
    }

    fn assign(&mut self, virtual_register: VirtualRegister, mask: bool, register: u8) {
        let index = self.index(virtual_register);
        self.register[index] = Some(register);
        let (next_use, is_in_memory) = (self.next_use(virtual_register), self.is_in_memory(virtual_register));
        self.held_in(mask)[register as usize] = Some(Held { virtual_register, next_use, is_in_memory });
    }

    /// A register without a value, after an eviction if necessary. It is locked to the end of the current instruction.
    fn allocate(&mut self, mask: bool) -> u8 {
        let table = if mask { &self.mask_of } else { &self.vector_of };
        // Mask register 0 encodes "no mask".
        let first = usize::from(mask);
        let unlocked = || (first..table.len()).filter(|register| !self.is_locked(mask, *register));
        let free = unlocked().find(|register| table[*register].is_none());
        let register = free.unwrap_or_else(|| {
            // Evicting a value that is in memory needs no store, so the distance to its next use counts double.
            let last = unlocked().max_by_key(|register| {
                let held = table[*register].expect("none is free");
                let wait = |next: usize| (next - self.now.0 * self.vectors) * if held.is_in_memory { 2 } else { 1 };
                held.next_use.map_or(usize::MAX, wait)
            });
            last.expect("an instruction locks fewer registers than there are")
        });
        if free.is_none() {
            self.spill(mask, register as u8);
        }
        self.lock(mask, register as u8);
        register as u8
    }

    /// Evicts a register; its value is stored if it is read later and not in memory.
    fn spill(&mut self, mask: bool, register: u8) {
        let held = self.held_in(mask)[register as usize].take();
        let Held { virtual_register, next_use, is_in_memory } = held.expect("a value is in it");
        let index = self.index(virtual_register);
        self.register[index] = None;
        if next_use.is_some() && !is_in_memory {
            let number = self.free_spill_slot();
            self.spills[index] = Some(number);
            self.store(virtual_register.node, register, self.spill_operand(number));
        }
    }

    /// Frees the register and the spill slot of a value that is not read any more.
    fn release(&mut self, node: NodeId) {
        let virtual_register = self.virtual_register(node);
        if self.next_use(virtual_register).is_some() {
            return;
        }
        let index = self.index(virtual_register);
        if let Some(register) = self.register[index].take() {
            let mask = self.is_mask(node);
            self.held_in(mask)[register as usize] = None;
            self.locked[usize::from(mask)] &= !(1 << register);
        }
        if let Some(number) = self.spills[index].take() {
            // The current instruction may still read the slot.
            self.freed_by_instruction.push(number);
        }
    }

    /// Ends the current instruction.
    fn end_instruction(&mut self, node: NodeId) {
        self.locked = [0; 2];
        self.release(node);
        self.free_spills.append(&mut self.freed_by_instruction);
    }

    /// A register for the result; it may be that of an operand that is not read any more.
    fn result(&mut self, node: NodeId) -> u8 {
        self.op(node).operands().for_each(|operand| self.release(operand));
        self.fresh_register(node)
    }

    /// A register for the result, different from those of the operands.
    fn fresh_register(&mut self, node: NodeId) -> u8 {
        let mask = self.is_mask(node);
        let register = self.allocate(mask);
        let virtual_register = self.virtual_register(node);
        self.assign(virtual_register, mask, register);
        register
    }

    /// Begins an instruction that reads these operands: locks their registers, so that loading another operand does not
    /// evict them.
    fn begin_instruction(&mut self, operands: impl Iterator<Item = NodeId>) {
        for operand in operands {
            let virtual_register = self.virtual_register(operand);
            if let Some(register) = self.register[self.index(virtual_register)] {
                let (mask, next_use) = (self.is_mask(operand), self.next_use(virtual_register));
                self.lock(mask, register);
                let held = self.held_in(mask)[register as usize].as_mut();
                held.expect("the operand is in it").next_use = next_use;
            }
        }
    }

    fn lock(&mut self, mask: bool, register: u8) {
        self.locked[usize::from(mask)] |= 1 << register;
    }

    fn is_locked(&self, mask: bool, register: usize) -> bool {
        self.locked[usize::from(mask)] & 1 << register != 0
    }

    /// What the registers hold: those for vectors or those for masks.
    fn held_in(&mut self, mask: bool) -> &mut [Option<Held>] {
        if mask { &mut self.mask_of } else { &mut self.vector_of }
    }

    fn node(&mut self, node: NodeId) {
        let op = self.op(node);
        self.begin_instruction(op.operands());
        let index = self.index(self.virtual_register(node));
        if self.register[index].is_some() || self.spills[index].is_some() {
            // Already computed, together with an earlier node.
            return op.operands().for_each(|operand| self.release(operand));
        }
        match op {
            MachineOp::Load(_) | MachineOp::Constant(_) | MachineOp::TableRow(..) => unreachable!("they lie in memory"),
            MachineOp::Binary(i::VPMULLQ, _, a, b) if self.width == Vectors::Scalar => {
                let [a, b] = [a, b].map(|operand| self.in_register(operand));
                let to = self.result(node);
                self.code.integer_product(to, a, b);
            }
            MachineOp::Unary(instruction @ (i::VCVTTPD2QQ | i::VCVTQQ2PD), _, a) if self.width == Vectors::Scalar => {
                let from = self.in_register(a);
                let to = self.result(node);
                match instruction {
                    i::VCVTTPD2QQ => self.code.integer_of(to, from),
                    _ => self.code.real_of(to, from),
                }
            }
            MachineOp::Binary(instruction, exchange, a, b) => self.two(node, instruction, exchange, a, b),
            MachineOp::Unary(instruction, immediate, a) => {
                let last = self.operand_of(instruction, a);
                let to = self.result(node);
                self.code.vector(instruction, to, 0, last, immediate);
            }
            MachineOp::Fma { signs, a, b, c } => self.fma(node, signs, a, b, c),
            MachineOp::Shift(direction, a, n) => {
                let from = self.in_register(a);
                let to = self.result(node);
                let (instruction, digit) = match direction {
                    Direction::Left => (i::SHIFT, 6),
                    Direction::Right => (i::SHIFT, 2),
                    Direction::RightSigned => (i::VPSRAQ, 4),
                };
                self.code.vector(instruction, digit, to, Place::Register(from), Some(n));
            }
            MachineOp::Compare(predicate, a, b) => {
                let (first, last, predicate) = match (self.operand(a), self.operand(b)) {
                    (Place::Register(a), last) => (a, last, predicate),
                    (last, Place::Register(b)) => (b, last, predicate.with_operands_exchanged()),
                    (_, last) => (self.in_register(a), last, predicate),
                };
                let to = self.result(node);
                self.code.vector(i::VCMPPD, to, first, last, Some(predicate as u8));
            }
            MachineOp::CompareInt(predicate, a, b) if self.width == Vectors::Avx512 => {
                let first = self.in_register(a);
                let last = self.operand(b);
                let to = self.result(node);
                self.code.vector(i::VPCMPQ, to, first, last, Some(predicate));
            }
            MachineOp::TestBits(a, b) => self.two(node, i::VPTESTMQ, true, a, b),
            MachineOp::CompareInt(predicate, a, b) => {
                // There is no instruction for less: a < b is b > a.
                let instruction = if predicate == 0 { i::VPCMPEQQ } else { i::VPCMPGTQ };
                let first = self.in_register(b);
                let last = self.operand_of(instruction, a);
                let to = self.result(node);
                self.code.vector(instruction, to, first, last, None);
            }
            MachineOp::Mask(truth) => {
                let to = self.result(node);
                let instruction = if truth { i::KXNORB } else { i::KXORB };
                self.code.mask(instruction, to, to, Place::Register(to));
            }
            MachineOp::MaskAnd(a, b) | MachineOp::MaskOr(a, b) => {
                let (a, b) = (self.in_register(a), self.in_register(b));
                let to = self.result(node);
                let instruction = if matches!(op, MachineOp::MaskAnd(..)) { i::KANDB } else { i::KORB };
                self.code.mask(instruction, to, a, Place::Register(b));
            }
            MachineOp::MaskNot(a) => {
                let from = self.in_register(a);
                let to = self.result(node);
                self.code.mask(i::KNOTB, to, 0, Place::Register(from));
            }
            MachineOp::MaskSelect(when, a, b) => {
                let [when, a, b] = [when, a, b].map(|operand| self.in_register(operand));
                let other = self.allocate(true);
                let to = self.fresh_register(node);
                self.code.mask(i::KANDNB, other, when, Place::Register(b));
                self.code.mask(i::KANDB, to, when, Place::Register(a));
                self.code.mask(i::KORB, to, to, Place::Register(other));
                op.operands().for_each(|operand| self.release(operand));
            }
            MachineOp::Scale(when, a, b) => {
                let mask = self.in_register(when);
                let first = self.in_register(a);
                let last = self.operand(b);
                let to = self.result(node);
                self.code.masked(i::VSCALEFPD, to, first, last, None, mask | ZEROING);
            }
            MachineOp::Select(when, a, b) => {
                let mask = self.in_register(when);
                let other = self.in_register(b);
                let chosen = self.operand_of(i::VBLENDVPD, a);
                let to = self.result(node);
                match self.width {
                    Vectors::Avx512 => self.code.masked(i::VBLENDMPD, to, other, chosen, None, mask),
                    _ => self.code.vector(i::VBLENDVPD, to, other, chosen, Some(mask << 4)),
                }
            }
            MachineOp::Permute(first, second, index) => {
                let by = self.in_register(index);
                let [first, second] = [first, second].map(|row| self.operand(row));
                let to = self.fresh_register(node);
                self.code.vector(i::VMOVAPD_LOAD, to, 0, first, None);
                self.code.vector(i::VPERMT2PD, to, by, second, None);
                op.operands().for_each(|operand| self.release(operand));
            }
            MachineOp::Gather { base, index, .. } if self.width == Vectors::Avx512 => {
                let from = self.in_register(index);
                let mask = self.allocate(true);
                let to = self.fresh_register(node);
                self.code.mask(i::KXNORB, mask, mask, Place::Register(mask));
                // Lanes that are masked off keep their old content. Clearing the register breaks this false dependency.
                self.code.vector(i::VXORPD, to, to, Place::Register(to), None);
                self.code.gather(to, from, mask, 8 * base as i32);
                self.release(index);
            }
            MachineOp::Gather { base, index, .. } if self.width == Vectors::Scalar => {
                self.look_up_one(node, index, (Base::Pool, 8 * base as i32));
            }
            MachineOp::Ring(base, index) => self.look_up_one(node, index, (Base::Block, 8 * base.0 as i32)),
            MachineOp::Write(base, index, value) => {
                let [index, value] = [index, value].map(|operand| self.in_register(operand));
                self.code.write_one(value, index, (Base::Block, 8 * base.0 as i32));
                op.operands().for_each(|operand| self.release(operand));
            }
            MachineOp::Gather { index, .. } => {
                // Up to four tables that are read at the same index are looked up together.
                let same =
                    |other: &&NodeId| matches!(self.op(**other), MachineOp::Gather { index: at, .. } if at == index);
                let all: Vec<NodeId> = self.order[self.now.0..].iter().filter(same).take(4).copied().collect();
                self.look_up(&all, index);
                self.release(index);
            }
        }
    }

    /// Loads the entry of a table at an index, for a single lane.
    fn look_up_one(&mut self, node: NodeId, index: NodeId, table: (Base, i32)) {
        let from = self.in_register(index);
        let to = self.result(node);
        self.code.look_up_one(to, from, table);
    }

    /// Loads entries of tables at the same index. Two tables of elementary functions, whose contents are known here,
    /// are interleaved, so that one load fetches both entries.
    fn look_up(&mut self, all: &[NodeId], index: NodeId) {
        let nodes = self.nodes;
        let table = |node: &NodeId| match self.op(*node) {
            MachineOp::Gather { base, len, .. } => base as usize..(base + len) as usize,
            _ => unreachable!("all are alike"),
        };
        let tables: Vec<_> = all.iter().map(table).collect();
        let both = |two: &[Range<usize>]| {
            let known = |table: &Range<usize>| nodes.pooled && table.end <= math::POOL.len();
            matches!(two, [a, b] if a.len() == b.len() && known(a) && known(b))
        };
        let scale = if tables.chunks(2).any(both) { 4 } else { 8 };
        let from = self.in_register(index);
        let half = self.allocate(false);
        let number = self.free_spill_slot();
        let place = self.spill_operand(number);
        self.freed_by_instruction.push(number);
        let Place::Memory(base, offset) = place else { unreachable!("it lies in memory") };
        match scale {
            4 => {
                self.code.vector(i::VPADDQ, half, from, Place::Register(from), None);
                self.code.vector(i::VMOVAPD_STORE, half, 0, place, None);
            }
            _ => self.code.vector(i::VMOVAPD_STORE, from, 0, place, None),
        }
        for (two, tables) in all.chunks(2).zip(tables.chunks(2)) {
            let to: Vec<u8> = two.iter().map(|node| self.fresh_register(*node)).collect();
            if let ([first, second], true) = (to.as_slice(), both(tables)) {
                let entries = tables[0].clone().zip(tables[1].clone()).flat_map(|(a, b)| [a, b]);
                let displacement = self.code.table(entries.map(|at| math::POOL[at].to_bits()).collect());
                self.code.look_up_two([*first, *second], (base, offset), displacement, half);
            } else {
                for (to, table) in to.into_iter().zip(tables) {
                    self.code.look_up(to, (base, offset), scale, 8 * table.start as i32, half);
                }
            }
        }
    }

    fn two(&mut self, node: NodeId, instruction: Instruction, exchange: bool, a: NodeId, b: NodeId) {
        let (first, last) = match (self.operand_of(instruction, a), self.operand_of(instruction, b)) {
            (Place::Register(a), last) => (a, last),
            (last, Place::Register(b)) if exchange => (b, last),
            _ if a == b => {
                let both = self.in_register(a);
                (both, Place::Register(both))
            }
            (_, last) => (self.in_register(a), last),
        };
        let to = self.result(node);
        if instruction == i::VFIXUPIMMPD {
            // The instruction reads its destination. Copying the operand there avoids a false dependency on the old
            // content.
            if to != first && last != Place::Register(to) {
                self.code.vector(i::VMOVAPD_LOAD, to, 0, Place::Register(first), None);
            }
            return self.code.vector(instruction, to, first, last, Some(0));
        }
        self.code.vector(instruction, to, first, last, None);
    }

    /// The instruction overwrites one of its three operands, and one of the others may be in memory.
    fn fma(&mut self, node: NodeId, signs: Signs, a: NodeId, b: NodeId, c: NodeId) {
        let all = [a, b, c];
        let places = all.map(|operand| self.operand(operand));
        let held = |k: usize| matches!(places[k], Place::Register(_));
        let is_dead =
            |allocator: &Self, k: usize| held(k) && allocator.next_use(allocator.virtual_register(all[k])).is_none();
        // Overwrite an operand that is dead; else one that has to be loaded in any case; else a copy.
        let over = [2, 0, 1]
            .into_iter()
            .find(|k| is_dead(self, *k))
            .or_else(|| [2, 0, 1].into_iter().find(|k| !held(*k)))
            .unwrap_or(2);
        let others: [usize; 2] = [[1, 2], [0, 2], [0, 1]][over];
        // One of the other two may stay in memory.
        let mut read = others.map(|k| places[k]);
        if !held(others[0]) && !held(others[1]) {
            read[0] = Place::Register(self.in_register(all[others[0]]));
            if all[others[0]] == all[others[1]] {
                read[1] = read[0];
            }
        }
        let (to, owned) = match places[over] {
            Place::Register(register) if is_dead(self, over) => (register, true),
            place => {
                let to = self.allocate(false);
                match place {
                    Place::Register(_) => self.code.vector(i::VMOVAPD_LOAD, to, 0, place, None),
                    place => self.load(all[over], to, place),
                }
                (to, false)
            }
        };
        let [Place::Register(_), _] = read else {
            let read = [read[1], read[0]];
            return self.fused(node, signs, over, [others[1], others[0]], read, to, owned);
        };
        self.fused(node, signs, over, others, read, to, owned);
    }

    /// Emits the instruction; the first of `read` is a register.
    #[allow(clippy::too_many_arguments)]
    fn fused(
        &mut self,
        node: NodeId,
        signs: Signs,
        over: usize,
        others: [usize; 2],
        read: [Place; 2],
        to: u8,
        owned: bool,
    ) {
        let Place::Register(second) = read[0] else { unreachable!("one of two is a register") };
        let form = match (over, others[0]) {
            (2, _) => i::VFMADD231PD,
            // The register operand is c.
            (_, 2) => i::VFMADD132PD,
            (_, _) => i::VFMADD213PD,
        };
        let form = Instruction(form.0, form.1, form.2, form.3 + signs as u8);
        self.code.vector(form, to, second, read[1], None);
        self.op(node).operands().for_each(|operand| self.release(operand));
        let virtual_register = self.virtual_register(node);
        debug_assert!(!owned || self.vector_of[to as usize].is_none(), "the operand has been released");
        self.assign(virtual_register, false, to);
    }
}
