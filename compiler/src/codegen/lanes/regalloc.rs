//! Nodes as instructions, several vectors side by side, with registers given out on the way.
//!
//! The line is straight, so it is known when each value is read next: where registers run out, the one that is read last
//! gives way (Belady), sooner if it need not be stored. Loads, constants and what was computed before the loop lie in memory;
//! most instructions read one operand from there, and what is read again, as constants are by each vector, is loaded while
//! registers are free.

use crate::codegen::lanes::assembler::{Assembler, Base, Instruction, Place, Vectors, ZEROING, instructions as i};
use crate::codegen::lanes::isel::{Direction, MachineOp, Node, Nodes, Signs};
use crate::math;
use std::collections::HashMap;
use std::ops::Range;

/// Where a node's vectors lie in memory: the `index`-th group of vectors behind `begin` bytes.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Home {
    pub base: Base,
    pub begin: usize,
    pub index: usize,
}

/// What the vectors of one node have in memory.
pub fn place_in(base: Base, begin: usize, index: usize, vectors: usize, k: usize, width: Vectors) -> Place {
    Place::Memory(base, (begin + (index * vectors + k) * width.bytes() as usize) as i32)
}

/// One vector of a node; what is the same in every vector has but the first.
type VirtualRegister = usize;

/// A straight line being written.
pub struct RegisterAllocator<'a> {
    code: &'a mut Assembler,
    nodes: &'a Nodes,
    order: &'a [Node],
    homes: &'a HashMap<Node, Home>,
    width: Vectors,
    vectors: usize,
    /// For each node the places of the order where it is read, ascending.
    uses: HashMap<Node, Vec<usize>>,
    /// Register of each copy.
    register: HashMap<VirtualRegister, u8>,
    /// Numbers of the places in memory of those that had to give way.
    spills: HashMap<VirtualRegister, usize>,
    free_spills: Vec<usize>,
    left_spills: Vec<usize>,
    spilled: usize,
    spills_at: usize,
    vector_of: Vec<Option<VirtualRegister>>,
    mask_of: Vec<Option<VirtualRegister>>,
    /// Registers that the instruction being written needs.
    locked: Vec<(bool, u8)>,
    /// The place in the order, and the vector.
    now: (usize, usize),
}

impl<'a> RegisterAllocator<'a> {
    /// An empty one; registers that give way are stored behind `spills_at` bytes of the block.
    pub fn new(
        code: &'a mut Assembler,
        nodes: &'a Nodes,
        order: &'a [Node],
        homes: &'a HashMap<Node, Home>,
        width: Vectors,
        vectors: usize,
        spills_at: usize,
    ) -> RegisterAllocator<'a> {
        let mut uses: HashMap<Node, Vec<usize>> = HashMap::new();
        for (at, node) in order.iter().enumerate() {
            for operand in nodes.nodes[node.index()].operands() {
                uses.entry(operand).or_default().push(at);
            }
        }
        RegisterAllocator {
            code,
            nodes,
            order,
            homes,
            width,
            vectors,
            uses,
            register: HashMap::new(),
            spills: HashMap::new(),
            free_spills: Vec::new(),
            left_spills: Vec::new(),
            spilled: 0,
            spills_at,
            vector_of: vec![None; width.registers() as usize],
            mask_of: vec![None; 8],
            locked: Vec::new(),
            now: (0, 0),
        }
    }

    /// Keeps a node to the end.
    pub fn pin(&mut self, node: Node) {
        self.uses.entry(node).or_default().push(self.order.len() + 1);
    }

    /// Most vectors that lay in memory at a time.
    pub fn spilled(&self) -> usize {
        self.spilled
    }

    /// Writes all nodes of the order; `stores` says where a node goes as soon as it is there. Nodes of `rest` that are not
    /// in the order go there at the end.
    pub fn write(&mut self, stores: &dyn Fn(Node) -> Vec<Home>, rest: &[Node]) {
        let order = self.order;
        for (at, node) in order.iter().enumerate() {
            let homes = stores(*node);
            for k in 0..self.vectors {
                self.now = (at, k);
                self.node(*node);
                for home in &homes {
                    let register = self.in_register(*node);
                    self.store(*node, register, self.at_home(*home, k));
                }
                self.done(*node);
            }
        }
        let mut seen: Vec<Node> = order.to_vec();
        for node in rest {
            if seen.contains(node) {
                continue;
            }
            seen.push(*node);
            for k in 0..self.vectors {
                self.now = (order.len(), k);
                let register = self.in_register(*node);
                for home in stores(*node) {
                    self.store(*node, register, self.at_home(home, k));
                }
                self.done(*node);
            }
        }
    }

    /// A jump that is taken if a mask has a lane; its target is open. It ends the line.
    pub fn test(&mut self, mask: Node) -> usize {
        self.now = (self.order.len(), 0);
        let all = self.in_register(mask);
        for k in 1..self.vectors {
            self.now.1 = k;
            match self.width {
                Vectors::Avx512 => {
                    let more = self.in_register(mask);
                    self.code.mask(i::MASK_OR, all, all, Place::Register(more));
                }
                Vectors::Avx | Vectors::Avx2 => {
                    let more = self.place(mask);
                    self.code.vector(i::OR, all, all, more, None);
                }
            }
            self.locked.truncate(1);
        }
        match self.width {
            Vectors::Avx512 => self.code.mask(i::MASK_TEST, all, 0, Place::Register(all)),
            Vectors::Avx | Vectors::Avx2 => {
                let l = u8::from(self.width == Vectors::Avx2);
                self.code.plain(&[0xc4, 0x41 | (!all >> 3 & 1) << 5, 0x79 | l << 2, 0x50, 0xd0 | all & 7]);
                self.code.plain(&[0x45, 0x85, 0xd2]); // test r10d, r10d
            }
        }
        self.code.jump(&[0x0f, 0x85])
    }

    fn copy(&self, node: Node) -> VirtualRegister {
        node.index() * self.vectors + if self.what(node).is_shared() { 0 } else { self.now.1 }
    }

    fn what(&self, node: Node) -> MachineOp {
        self.nodes.nodes[node.index()]
    }

    fn is_mask(&self, node: Node) -> bool {
        self.what(node).is_mask(self.width)
    }

    /// When a copy is read next, after now; later is larger.
    fn next_use(&self, copy: VirtualRegister) -> Option<usize> {
        let (node, k) = (Node((copy / self.vectors) as u32), copy % self.vectors);
        let (at, now) = self.now;
        let uses = self.uses.get(&node)?;
        if self.what(node).is_shared() {
            let first = uses.partition_point(|place| *place < at || *place == at && now + 1 == self.vectors);
            return uses.get(first).map(|place| place * self.vectors + if *place == at { now + 1 } else { 0 });
        }
        let first = uses.partition_point(|place| *place < at || *place == at && k <= now);
        uses.get(first).map(|place| place * self.vectors + k)
    }

    fn at_home(&self, home: Home, k: usize) -> Place {
        place_in(home.base, home.begin, home.index, self.vectors, k, self.width)
    }

    /// The number of a place in memory that nobody needs.
    fn spill_number(&mut self) -> usize {
        self.free_spills.pop().unwrap_or_else(|| {
            self.spilled += 1;
            self.spilled - 1
        })
    }

    fn spill_place(&self, number: usize) -> Place {
        Place::Memory(Base::Block, (self.spills_at + number * self.width.bytes() as usize) as i32)
    }

    /// Where a node can be read: its register, or memory. What is read again is loaded, for the processor adds faster than it
    /// reads, if there is a register that nobody needs before.
    fn place(&mut self, node: Node) -> Place {
        let copy = self.copy(node);
        let mask = self.is_mask(node);
        if let Some(register) = self.register.get(&copy) {
            let register = *register;
            self.locked.push((mask, register));
            return Place::Register(register);
        }
        let place = self.memory(node);
        if mask || !self.next_use(copy).is_some_and(|next| self.is_room_until(next)) {
            return place;
        }
        Place::Register(self.loaded(node, place))
    }

    /// A register for a node that lies somewhere else.
    fn loaded(&mut self, node: Node, place: Place) -> u8 {
        let mask = self.is_mask(node);
        let register = self.allocate(mask);
        self.load(node, register, place);
        let copy = self.copy(node);
        self.own(copy, mask, register);
        register
    }

    /// Whether a vector register is free, or holds what lies in memory too and is read later.
    fn is_room_until(&self, next: usize) -> bool {
        (0..self.vector_of.len()).any(|register| {
            let later =
                |copy: VirtualRegister| self.is_in_memory(copy) && self.next_use(copy).is_none_or(|other| other > next);
            !self.locked.contains(&(false, register as u8)) && self.vector_of[register].is_none_or(later)
        })
    }

    /// Whether a copy can be read from memory.
    fn is_in_memory(&self, copy: VirtualRegister) -> bool {
        let node = Node((copy / self.vectors) as u32);
        self.what(node).is_shared() || self.homes.contains_key(&node) || self.spills.contains_key(&copy)
    }

    fn memory(&mut self, node: Node) -> Place {
        match self.what(node) {
            MachineOp::Constant(bits) => return Place::Constant(bits),
            MachineOp::Row(table, second) => return self.code.row(table.row(second)),
            _ => {}
        }
        if let Some(number) = self.spills.get(&self.copy(node)) {
            return self.spill_place(*number);
        }
        let home = self.homes.get(&node).unwrap_or_else(|| panic!("{:?} lies nowhere", self.what(node)));
        self.at_home(*home, self.now.1)
    }

    /// The node's register, loaded if it lies in memory.
    fn in_register(&mut self, node: Node) -> u8 {
        match self.place(node) {
            Place::Register(register) => register,
            place => self.loaded(node, place),
        }
    }

    fn load(&mut self, node: Node, register: u8, place: Place) {
        match place {
            _ if self.is_mask(node) => self.code.mask(i::MASK_LOAD, register, 0, place),
            Place::Constant(_) if self.width == Vectors::Avx512 => {
                self.code.vector(i::BROADCAST, register, 0, place, None);
            }
            place => self.code.vector(i::LOAD, register, 0, place, None),
        }
    }

    fn store(&mut self, node: Node, register: u8, place: Place) {
        if self.is_mask(node) {
            self.code.mask(i::MASK_STORE, register, 0, place);
        } else {
            self.code.vector(i::STORE, register, 0, place, None);
        }
    }

    fn own(&mut self, copy: VirtualRegister, mask: bool, register: u8) {
        self.register.insert(copy, register);
        let table = if mask { &mut self.mask_of } else { &mut self.vector_of };
        table[register as usize] = Some(copy);
    }

    /// A register that nobody owns; locked until the instruction is done.
    fn allocate(&mut self, mask: bool) -> u8 {
        let table = if mask { &self.mask_of } else { &self.vector_of };
        // Mask register 0 means no mask.
        let first = usize::from(mask);
        let locked = |register: usize| self.locked.contains(&(mask, register as u8));
        let free = (first..table.len()).find(|register| table[*register].is_none() && !locked(*register));
        let register = free.unwrap_or_else(|| {
            let candidates = (first..table.len()).filter(|register| !locked(*register));
            // What has to be stored first is worth more.
            let last = candidates.max_by_key(|register| {
                let copy = table[*register].expect("none is free");
                let wait =
                    |next: usize| (next - self.now.0 * self.vectors) * if self.is_in_memory(copy) { 2 } else { 1 };
                self.next_use(copy).map_or(usize::MAX, wait)
            });
            last.expect("an instruction locks fewer registers than there are")
        });
        if free.is_none() {
            self.spill(mask, register as u8);
        }
        self.locked.push((mask, register as u8));
        register as u8
    }

    /// Frees a register; what is read later and lies nowhere else is stored.
    fn spill(&mut self, mask: bool, register: u8) {
        let table = if mask { &mut self.mask_of } else { &mut self.vector_of };
        let copy = table[register as usize].take().expect("somebody owns it");
        self.register.remove(&copy);
        let node = Node((copy / self.vectors) as u32);
        if self.next_use(copy).is_some() && !self.is_in_memory(copy) {
            let number = self.spill_number();
            self.spills.insert(copy, number);
            self.store(node, register, self.spill_place(number));
        }
    }

    /// Frees the register and the memory of a copy that is not read any more.
    fn release(&mut self, node: Node) {
        let copy = self.copy(node);
        if self.next_use(copy).is_some() {
            return;
        }
        if let Some(register) = self.register.remove(&copy) {
            let mask = self.is_mask(node);
            let table = if mask { &mut self.mask_of } else { &mut self.vector_of };
            table[register as usize] = None;
            self.locked.retain(|locked| *locked != (mask, register));
        }
        if let Some(number) = self.spills.remove(&copy) {
            // The instruction may read it from there yet.
            self.left_spills.push(number);
        }
    }

    /// The instruction for this copy is written.
    fn done(&mut self, node: Node) {
        self.locked.clear();
        self.release(node);
        self.free_spills.append(&mut self.left_spills);
    }

    /// Registers for a result, those of operands that are not read any more among them.
    fn result(&mut self, node: Node) -> u8 {
        self.what(node).operands().for_each(|operand| self.release(operand));
        self.fresh_register(node)
    }

    /// A register for a result, none of the operands' own.
    fn fresh_register(&mut self, node: Node) -> u8 {
        let mask = self.is_mask(node);
        let register = self.allocate(mask);
        let copy = self.copy(node);
        self.own(copy, mask, register);
        register
    }

    /// What an instruction reads does not give way to what it loads.
    fn lock(&mut self, operands: impl Iterator<Item = Node>) {
        for operand in operands {
            if let Some(register) = self.register.get(&self.copy(operand)) {
                self.locked.push((self.is_mask(operand), *register));
            }
        }
    }

    fn node(&mut self, node: Node) {
        let what = self.what(node);
        let copy = self.copy(node);
        if self.register.contains_key(&copy) || self.spills.contains_key(&copy) {
            // It came with another.
            return what.operands().for_each(|operand| self.release(operand));
        }
        self.lock(what.operands());
        match what {
            MachineOp::Load(_) | MachineOp::Constant(_) | MachineOp::Row(..) => unreachable!("they lie in memory"),
            MachineOp::Two(instruction, exchange, a, b) => self.two(node, instruction, exchange, a, b),
            MachineOp::One(instruction, immediate, a) => {
                let last = self.place(a);
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
                    Direction::RightSigned => (i::SHIFT_SIGNED, 4),
                };
                self.code.vector(instruction, digit, to, Place::Register(from), Some(n));
            }
            MachineOp::Compare(predicate, a, b) => {
                let (first, last, predicate) = match (self.place(a), self.place(b)) {
                    (Place::Register(a), last) => (a, last, predicate),
                    (last, Place::Register(b)) => (b, last, predicate.turned()),
                    (_, last) => (self.in_register(a), last, predicate),
                };
                let to = self.result(node);
                self.code.vector(i::COMPARE, to, first, last, Some(predicate as u8));
            }
            MachineOp::CompareInt(predicate, a, b) if self.width == Vectors::Avx512 => {
                let first = self.in_register(a);
                let last = self.place(b);
                let to = self.result(node);
                self.code.vector(i::INT_COMPARE, to, first, last, Some(predicate));
            }
            MachineOp::TestBits(a, b) => self.two(node, i::INT_TEST, true, a, b),
            MachineOp::CompareInt(predicate, a, b) => {
                // a < b is b > a.
                let instruction = if predicate == 0 { i::INT_EQUAL } else { i::INT_GREATER };
                let first = self.in_register(b);
                let last = self.place(a);
                let to = self.result(node);
                self.code.vector(instruction, to, first, last, None);
            }
            MachineOp::Mask(truth) => {
                let to = self.result(node);
                let instruction = if truth { i::MASK_NOT_XOR } else { i::MASK_XOR };
                self.code.mask(instruction, to, to, Place::Register(to));
            }
            MachineOp::MaskAnd(a, b) | MachineOp::MaskOr(a, b) => {
                let (a, b) = (self.in_register(a), self.in_register(b));
                let to = self.result(node);
                let instruction = if matches!(what, MachineOp::MaskAnd(..)) { i::MASK_AND } else { i::MASK_OR };
                self.code.mask(instruction, to, a, Place::Register(b));
            }
            MachineOp::MaskNot(a) => {
                let from = self.in_register(a);
                let to = self.result(node);
                self.code.mask(i::MASK_NOT, to, 0, Place::Register(from));
            }
            MachineOp::MaskSelect(when, a, b) => {
                let [when, a, b] = [when, a, b].map(|operand| self.in_register(operand));
                let other = self.allocate(true);
                let to = self.fresh_register(node);
                self.code.mask(i::MASK_AND_NOT, other, when, Place::Register(b));
                self.code.mask(i::MASK_AND, to, when, Place::Register(a));
                self.code.mask(i::MASK_OR, to, to, Place::Register(other));
                what.operands().for_each(|operand| self.release(operand));
            }
            MachineOp::Scale(when, a, b) => {
                let mask = self.in_register(when);
                let first = self.in_register(a);
                let last = self.place(b);
                let to = self.result(node);
                self.code.masked(i::SCALE, to, first, last, None, mask | ZEROING);
            }
            MachineOp::Select(when, a, b) => {
                let mask = self.in_register(when);
                let other = self.in_register(b);
                let chosen = self.place(a);
                let to = self.result(node);
                match self.width {
                    Vectors::Avx512 => self.code.masked(i::BLEND, to, other, chosen, None, mask),
                    Vectors::Avx | Vectors::Avx2 => {
                        self.code.vector(i::BLEND_BY_SIGN, to, other, chosen, Some(mask << 4))
                    }
                }
            }
            MachineOp::Permute(first, second, index) => {
                let by = self.in_register(index);
                let [first, second] = [first, second].map(|row| self.place(row));
                let to = self.fresh_register(node);
                self.code.vector(i::LOAD, to, 0, first, None);
                self.code.vector(i::PERMUTE_TWO, to, by, second, None);
                what.operands().for_each(|operand| self.release(operand));
            }
            MachineOp::Gather { base, index, .. } if self.width == Vectors::Avx512 => {
                let from = self.in_register(index);
                let mask = self.allocate(true);
                let to = self.fresh_register(node);
                self.code.mask(i::MASK_NOT_XOR, mask, mask, Place::Register(mask));
                // It keeps lanes that the mask leaves out, so it would wait for whatever was there.
                self.code.vector(i::XOR, to, to, Place::Register(to), None);
                self.code.gather(to, from, mask, 8 * base as i32);
                self.release(index);
            }
            MachineOp::Gather { index, .. } => {
                // All tables that are read at the same place, at once.
                let same =
                    |other: &&Node| matches!(self.what(**other), MachineOp::Gather { index: at, .. } if at == index);
                let all: Vec<Node> = self.order[self.now.0..].iter().filter(same).take(4).copied().collect();
                self.look_up(&all, index);
                self.release(index);
            }
        }
    }

    /// Entries of tables at the same place: of two tables of elementary functions, which are known here, both by one load.
    fn look_up(&mut self, all: &[Node], index: Node) {
        let nodes = self.nodes;
        let table = |node: &Node| match self.what(*node) {
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
        let number = self.spill_number();
        let place = self.spill_place(number);
        self.left_spills.push(number);
        let Place::Memory(base, offset) = place else { unreachable!("it lies in memory") };
        match scale {
            4 => {
                self.code.vector(i::INT_ADD, half, from, Place::Register(from), None);
                self.code.vector(i::STORE, half, 0, place, None);
            }
            _ => self.code.vector(i::STORE, from, 0, place, None),
        }
        for (two, tables) in all.chunks(2).zip(tables.chunks(2)) {
            let to: Vec<u8> = two.iter().map(|node| self.fresh_register(*node)).collect();
            if let ([first, second], true) = (to.as_slice(), both(tables)) {
                let entries = tables[0].clone().zip(tables[1].clone()).flat_map(|(a, b)| [a, b]);
                let distance = self.code.table(entries.map(|at| math::POOL[at].to_bits()).collect());
                self.code.look_up_two([*first, *second], (base, offset), distance, half);
            } else {
                for (to, table) in to.into_iter().zip(tables) {
                    self.code.look_up(to, (base, offset), scale, 8 * table.start as i32, half);
                }
            }
        }
    }

    fn two(&mut self, node: Node, instruction: Instruction, exchange: bool, a: Node, b: Node) {
        let (first, last) = match (self.place(a), self.place(b)) {
            (Place::Register(a), last) => (a, last),
            (last, Place::Register(b)) if exchange => (b, last),
            _ if a == b => {
                let both = self.in_register(a);
                (both, Place::Register(both))
            }
            (_, last) => (self.in_register(a), last),
        };
        let to = self.result(node);
        if instruction == i::BY_KIND {
            // It waits for what the result's register held: that is to be what it needs anyway.
            if to != first && last != Place::Register(to) {
                self.code.vector(i::LOAD, to, 0, Place::Register(first), None);
            }
            return self.code.vector(instruction, to, first, last, Some(0));
        }
        self.code.vector(instruction, to, first, last, None);
    }

    /// One of three operands is overwritten, one may lie in memory.
    fn fma(&mut self, node: Node, signs: Signs, a: Node, b: Node, c: Node) {
        let all = [a, b, c];
        let places = all.map(|operand| self.place(operand));
        let held = |k: usize| matches!(places[k], Place::Register(_));
        let dies = |body: &Self, k: usize| held(k) && body.next_use(body.copy(all[k])).is_none();
        // What is not read any more is overwritten; else what has to be loaded; else a copy.
        let over = [2, 0, 1]
            .into_iter()
            .find(|k| dies(self, *k))
            .or_else(|| [2, 0, 1].into_iter().find(|k| !held(*k)))
            .unwrap_or(2);
        let others: [usize; 2] = [[1, 2], [0, 2], [0, 1]][over];
        // Of the others one may stay in memory.
        let mut read = others.map(|k| places[k]);
        if !held(others[0]) && !held(others[1]) {
            read[0] = Place::Register(self.in_register(all[others[0]]));
            if all[others[0]] == all[others[1]] {
                read[1] = read[0];
            }
        }
        let (to, owned) = match places[over] {
            Place::Register(register) if dies(self, over) => (register, true),
            place => {
                let to = self.allocate(false);
                match place {
                    Place::Register(_) => self.code.vector(i::LOAD, to, 0, place, None),
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

    /// The first of `read` is a register.
    #[allow(clippy::too_many_arguments)]
    fn fused(
        &mut self,
        node: Node,
        signs: Signs,
        over: usize,
        others: [usize; 2],
        read: [Place; 2],
        to: u8,
        owned: bool,
    ) {
        let Place::Register(second) = read[0] else { unreachable!("one of two is a register") };
        let form = match (over, others[0]) {
            (2, _) => i::FMA_231,
            // The register is c.
            (_, 2) => i::FMA_132,
            (_, _) => i::FMA_213,
        };
        let form = Instruction(form.0, form.1, form.2, form.3 + signs as u8);
        self.code.vector(form, to, second, read[1], None);
        self.what(node).operands().for_each(|operand| self.release(operand));
        let copy = self.copy(node);
        debug_assert!(!owned || self.vector_of[to as usize].is_none(), "the operand has been released");
        self.own(copy, false, to);
    }
}
