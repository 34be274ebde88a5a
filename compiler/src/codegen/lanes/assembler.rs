//! Vector instructions of x86-64 as bytes: VEX with 128 and 256 bits, EVEX with 512 bits.
//!
//! In: an instruction, its registers, a register or a place in memory. Out: bytes, with constants behind the code that
//! is reached relative to the instruction. Knows nothing of programs.
//! Source: Intel 64 and IA-32 Architectures Software Developer's Manual, volume 2, sections 2.3 and 2.7.

use std::collections::HashMap;

/// Which vectors.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Vectors {
    /// Two lanes of 64 bits in 16 registers: AVX and FMA.
    Avx,
    /// Four lanes of 64 bits in 16 registers: AVX2 and FMA.
    Avx2,
    /// Eight lanes of 64 bits in 32 registers, and masks: AVX-512 F and DQ.
    Avx512,
}

impl Vectors {
    /// Lanes of a vector.
    pub fn lanes(self) -> usize {
        match self {
            Vectors::Avx => 2,
            Vectors::Avx2 => 4,
            Vectors::Avx512 => 8,
        }
    }

    /// Bytes of a vector.
    pub fn bytes(self) -> i32 {
        8 * self.lanes() as i32
    }

    /// Vector registers.
    pub fn registers(self) -> u8 {
        match self {
            Vectors::Avx | Vectors::Avx2 => 16,
            Vectors::Avx512 => 32,
        }
    }
}

/// A general register that holds an address.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Base {
    /// rdi: the block.
    Block = 7,
    /// rsi: the pool.
    Pool = 6,
    /// rcx: the statuses.
    Statuses = 1,
    /// r8: what an iteration begins with.
    Before = 8,
    /// r9: what it ends with.
    After = 9,
}

/// The last operand of an instruction.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Place {
    /// A vector or mask register.
    Register(u8),
    /// A vector in memory.
    Memory(Base, i32),
    /// A constant in every lane, by its bits.
    Constant(u64),
    /// A vector of constants, by its number; see [`Assembler::row`].
    Row(usize),
}

/// Instruction: mandatory prefix (0: none, 1: 66, 2: F3, 3: F2), map (1: 0F, 2: 0F 38, 3: 0F 3A), W of the EVEX form and
/// of the VEX form, opcode.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Instruction(pub u8, pub u8, pub [u8; 2], pub u8);

#[rustfmt::skip]
#[allow(missing_docs)]
pub mod instructions {
    use super::Instruction;
    pub const ADD: Instruction = Instruction(1, 1, [1, 0], 0x58);
    pub const MUL: Instruction = Instruction(1, 1, [1, 0], 0x59);
    pub const SUB: Instruction = Instruction(1, 1, [1, 0], 0x5c);
    pub const MIN: Instruction = Instruction(1, 1, [1, 0], 0x5d);
    pub const DIV: Instruction = Instruction(1, 1, [1, 0], 0x5e);
    pub const MAX: Instruction = Instruction(1, 1, [1, 0], 0x5f);
    pub const SQRT: Instruction = Instruction(1, 1, [1, 0], 0x51);
    pub const AND: Instruction = Instruction(1, 1, [1, 0], 0x54);
    /// ¬v ∧ rm
    pub const AND_NOT: Instruction = Instruction(1, 1, [1, 0], 0x55);
    pub const OR: Instruction = Instruction(1, 1, [1, 0], 0x56);
    pub const XOR: Instruction = Instruction(1, 1, [1, 0], 0x57);
    pub const COMPARE: Instruction = Instruction(1, 1, [1, 0], 0xc2);
    pub const LOAD: Instruction = Instruction(1, 1, [1, 0], 0x28);
    pub const STORE: Instruction = Instruction(1, 1, [1, 0], 0x29);
    pub const BROADCAST: Instruction = Instruction(1, 2, [1, 0], 0x19);
    /// VRNDSCALEPD as EVEX, VROUNDPD as VEX.
    pub const ROUND: Instruction = Instruction(1, 3, [1, 0], 0x09);
    /// d = d · rm + v
    pub const FMA_132: Instruction = Instruction(1, 2, [1, 1], 0x98);
    /// d = v · d + rm
    pub const FMA_213: Instruction = Instruction(1, 2, [1, 1], 0xa8);
    /// d = v · rm + d
    pub const FMA_231: Instruction = Instruction(1, 2, [1, 1], 0xb8);
    pub const GATHER: Instruction = Instruction(1, 2, [1, 1], 0x93);
    pub const INT_ADD: Instruction = Instruction(1, 1, [1, 0], 0xd4);
    pub const INT_SUB: Instruction = Instruction(1, 1, [1, 0], 0xfb);
    /// By a constant: /2 right, /4 right with the sign (as opcode 72), /6 left.
    pub const SHIFT: Instruction = Instruction(1, 1, [1, 0], 0x73);
    pub const SHIFT_SIGNED: Instruction = Instruction(1, 1, [1, 0], 0x72);
    /// VEX only.
    pub const INSERT_HALF: Instruction = Instruction(1, 3, [0, 0], 0x18);
    /// Of each two lanes the first, or the second: v's, then rm's.
    pub const FIRST_OF_TWO: Instruction = Instruction(1, 1, [1, 0], 0x14);
    pub const SECOND_OF_TWO: Instruction = Instruction(1, 1, [1, 0], 0x15);
    /// Of one number, from memory.
    pub const LOAD_FIRST: Instruction = Instruction(3, 1, [0, 0], 0x10);
    pub const LOAD_SECOND: Instruction = Instruction(1, 1, [0, 0], 0x16);
    pub const INT_EQUAL: Instruction = Instruction(1, 2, [1, 0], 0x29);
    pub const INT_GREATER: Instruction = Instruction(1, 2, [1, 0], 0x37);
    pub const BLEND_BY_SIGN: Instruction = Instruction(1, 3, [0, 0], 0x4b);
    /// EVEX only.
    pub const BLEND: Instruction = Instruction(1, 2, [1, 0], 0x65);
    /// By what kind of number v is, as the bits of rm say for each kind. The immediate is 0: no exceptions.
    pub const BY_KIND: Instruction = Instruction(1, 3, [1, 0], 0x54);
    /// v · 2^⌊rm⌋
    pub const SCALE: Instruction = Instruction(1, 2, [1, 0], 0x2c);
    /// From the two vectors d and rm, d first, by the low bits of v.
    pub const PERMUTE_TWO: Instruction = Instruction(1, 2, [1, 0], 0x7f);
    /// A mask: where v and rm have a bit in common.
    pub const INT_TEST: Instruction = Instruction(1, 2, [1, 0], 0x27);
    pub const INT_MUL: Instruction = Instruction(1, 2, [1, 0], 0x40);
    pub const INT_MIN_UNSIGNED: Instruction = Instruction(1, 2, [1, 0], 0x3b);
    pub const INT_COMPARE: Instruction = Instruction(1, 3, [1, 0], 0x1f);
    pub const TO_INT: Instruction = Instruction(1, 1, [1, 0], 0x7a);
    pub const TO_REAL: Instruction = Instruction(2, 1, [1, 0], 0xe6);
    /// Of masks, as VEX; the number is L.
    pub const MASK_AND: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x41), 1);
    pub const MASK_AND_NOT: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x42), 1);
    pub const MASK_NOT: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x44), 0);
    pub const MASK_OR: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x45), 1);
    pub const MASK_NOT_XOR: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x46), 1);
    pub const MASK_XOR: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x47), 1);
    pub const MASK_TEST: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x98), 0);
    pub const MASK_LOAD: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x90), 0);
    pub const MASK_STORE: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x91), 0);
}

/// Code under way.
pub struct Assembler {
    width: Vectors,
    bytes: Vec<u8>,
    /// Constants in the order of their first use, and where each is wanted: the place of a distance, and the end of its
    /// instruction.
    constants: Vec<u64>,
    numbers: HashMap<u64, usize>,
    wanted: Vec<(usize, usize, usize)>,
    /// The same of vectors of constants.
    rows: Vec<[u64; 8]>,
    wanted_rows: Vec<(usize, usize, usize)>,
    /// Tables behind the code, and where the distance to them is wanted, if r11 is to hold their address.
    tables: Vec<Vec<u64>>,
    wanted_tables: Option<usize>,
}

/// Beside the number of a mask register: where that does not hold, the result is 0, and not what it was.
pub const ZEROING: u8 = 1 << 7;

impl Assembler {
    pub fn new(width: Vectors) -> Assembler {
        Assembler {
            width,
            bytes: Vec::new(),
            constants: Vec::new(),
            numbers: HashMap::new(),
            wanted: Vec::new(),
            rows: Vec::new(),
            wanted_rows: Vec::new(),
            tables: Vec::new(),
            wanted_tables: None,
        }
    }

    /// An instruction without a mask: `reg` and `second` as their operands stand in the manual.
    pub fn vector(&mut self, what: Instruction, reg: u8, second: u8, last: Place, immediate: Option<u8>) {
        self.masked(what, reg, second, last, immediate, 0);
    }

    /// An instruction with a mask register, perhaps with [`ZEROING`]; 0: none. VEX has no masks.
    pub fn masked(&mut self, what: Instruction, reg: u8, second: u8, last: Place, immediate: Option<u8>, mask: u8) {
        match self.width {
            Vectors::Avx512 => {
                self.evex(what, reg, second, last, mask);
                self.operand(reg, last, immediate, self.width.bytes());
            }
            Vectors::Avx | Vectors::Avx2 => {
                assert_eq!(mask, 0, "VEX has no masks");
                self.vex(what, reg, second, last, u8::from(self.width == Vectors::Avx2));
                self.operand(reg, last, immediate, 1);
            }
        }
    }

    /// An instruction on mask registers.
    pub fn mask(&mut self, (what, l): (Instruction, u8), reg: u8, second: u8, last: Place) {
        self.vex(what, reg, second, last, l);
        self.operand(reg, last, None, 1);
    }

    /// Entries of the table at `offset` bytes of the pool, at the indices in a vector, where a mask register is set. EVEX
    /// only; the mask is used up.
    pub fn gather(&mut self, to: u8, index: u8, mask: u8, offset: i32) {
        let Instruction(pp, map, w, opcode) = instructions::GATHER;
        let bit = |register: u8, n: u8| (!register >> n) & 1;
        let p0 = bit(to, 3) << 7 | bit(index, 3) << 6 | 1 << 5 | bit(to, 4) << 4 | map;
        let p1 = w[0] << 7 | 0xf << 3 | 1 << 2 | pp;
        let p2 = 2 << 5 | bit(index, 4) << 3 | mask;
        self.bytes.extend([0x62, p0, p1, p2, opcode]);
        self.entry_of(to, index, offset);
    }

    /// Entries of a table of the pool, `distance` bytes behind its beginning, at the numbers in a vector in memory, each
    /// times `scale` bytes; `half` is overwritten. VEX only, and lane by lane through r10: its gathering instruction takes
    /// longer.
    pub fn look_up(&mut self, to: u8, numbers: (Base, i32), scale: u8, distance: i32, half: u8) {
        let pool = (Base::Pool as u8, scale, distance);
        for (upper, into) in [to, half].into_iter().enumerate().take(self.width.lanes() / 2) {
            self.number(numbers, 2 * upper);
            self.entry(instructions::LOAD_FIRST, into, 0, 0, pool);
            self.number(numbers, 2 * upper + 1);
            self.entry(instructions::LOAD_SECOND, into, into, 0, pool);
        }
        if self.width == Vectors::Avx2 {
            self.vector(instructions::INSERT_HALF, to, to, Place::Register(half), Some(1));
        }
    }

    /// Entries of the two tables that lie side by side `distance` bytes behind r11, at half the numbers in a vector in memory;
    /// `half` is overwritten. VEX only, after [`Assembler::reach_tables`].
    pub fn look_up_two(&mut self, [first, second]: [u8; 2], numbers: (Base, i32), distance: i32, half: u8) {
        let table = (11, 8, distance);
        for (lane, into) in [half, second].into_iter().enumerate() {
            self.number(numbers, lane);
            self.entry(instructions::LOAD, into, 0, 0, table);
            if self.width == Vectors::Avx2 {
                self.number(numbers, lane + 2);
                self.entry(instructions::INSERT_HALF, into, into, 1, table);
                self.bytes.push(1);
            }
        }
        self.vector(instructions::FIRST_OF_TWO, first, half, Place::Register(second), None);
        self.vector(instructions::SECOND_OF_TWO, second, half, Place::Register(second), None);
    }

    /// A number of a vector in memory, to r10.
    fn number(&mut self, (base, offset): (Base, i32), lane: usize) {
        self.bytes.extend([0x4c | base as u8 >> 3, 0x8b]);
        self.address(2 << 3, base, offset + 8 * lane as i32, 1);
    }

    /// A VEX instruction on the entry of a table, behind a register and a distance, whose number r10 holds.
    fn entry(
        &mut self,
        Instruction(pp, map, w, opcode): Instruction,
        reg: u8,
        second: u8,
        l: u8,
        (base, scale, distance): (u8, u8, i32),
    ) {
        let p0 = (!reg >> 3 & 1) << 7 | (!base >> 3 & 1) << 5 | map;
        self.bytes.extend([0xc4, p0, w[1] << 7 | (!second & 15) << 3 | l << 2 | pp, opcode]);
        let (reg, index) = ((reg & 7) << 3, (scale.trailing_zeros() as u8) << 6 | 2 << 3 | base & 7);
        match i8::try_from(distance) {
            Ok(distance) => self.bytes.extend([0x44 | reg, index, distance as u8]),
            Err(_) => {
                self.bytes.extend([0x84 | reg, index]);
                self.bytes.extend(distance.to_le_bytes());
            }
        }
    }

    /// The operand: base and index scaled by 8, with a distance of 32 bits.
    fn entry_of(&mut self, reg: u8, index: u8, offset: i32) {
        self.bytes.extend([0x84 | (reg & 7) << 3, 0xc0 | (index & 7) << 3 | Base::Pool as u8]);
        self.bytes.extend(offset.to_le_bytes());
    }

    fn evex(&mut self, Instruction(pp, map, w, opcode): Instruction, reg: u8, second: u8, last: Place, mask: u8) {
        let bit = |register: u8, n: u8| (!register >> n) & 1;
        let (x, b, broadcast) = match last {
            Place::Register(register) => (bit(register, 4), bit(register, 3), 0),
            Place::Memory(base, _) => (1, bit(base as u8, 3), 0),
            Place::Constant(_) => {
                (1, 1, u8::from(self.width == Vectors::Avx512 && opcode != instructions::BROADCAST.3))
            }
            Place::Row(_) => (1, 1, 0),
        };
        let p0 = bit(reg, 3) << 7 | x << 6 | b << 5 | bit(reg, 4) << 4 | map;
        let p1 = w[0] << 7 | (!second & 15) << 3 | 1 << 2 | pp;
        let p2 = 2 << 5 | broadcast << 4 | bit(second, 4) << 3 | mask;
        self.bytes.extend([0x62, p0, p1, p2, opcode]);
    }

    fn vex(&mut self, Instruction(pp, map, w, opcode): Instruction, reg: u8, second: u8, last: Place, l: u8) {
        let b = match last {
            Place::Register(register) => !register >> 3 & 1,
            Place::Memory(base, _) => !(base as u8) >> 3 & 1,
            Place::Constant(_) | Place::Row(_) => 1,
        };
        let r = (!reg >> 3 & 1) << 7;
        let rest = (!second & 15) << 3 | l << 2 | pp;
        match (map, w[1], b) {
            (1, 0, 1) => self.bytes.extend([0xc5, r | rest, opcode]),
            _ => self.bytes.extend([0xc4, r | 1 << 6 | b << 5 | map, w[1] << 7 | rest, opcode]),
        }
    }

    /// The last operand, and what follows it. A short distance counts in units.
    fn operand(&mut self, reg: u8, last: Place, immediate: Option<u8>, unit: i32) {
        let reg = (reg & 7) << 3;
        match last {
            Place::Register(register) => self.bytes.push(0xc0 | reg | register & 7),
            Place::Memory(base, offset) => self.address(reg, base, offset, unit),
            Place::Constant(bits) => {
                let next = self.constants.len();
                let number = *self.numbers.entry(bits).or_insert(next);
                if number == next {
                    self.constants.push(bits);
                }
                let at = self.distance(reg);
                self.wanted.push((at, at + 4 + usize::from(immediate.is_some()), number));
            }
            Place::Row(number) => {
                let at = self.distance(reg);
                self.wanted_rows.push((at, at + 4 + usize::from(immediate.is_some()), number));
            }
        }
        self.bytes.extend(immediate);
    }

    /// An operand at a distance from a base: none, or one byte of units, or four bytes.
    fn address(&mut self, reg: u8, base: Base, offset: i32, unit: i32) {
        let base = base as u8 & 7;
        match i8::try_from(offset / unit) {
            Ok(0) if offset == 0 => self.bytes.push(reg | base),
            Ok(units) if offset % unit == 0 => self.bytes.extend([0x40 | reg | base, units as u8]),
            _ => {
                self.bytes.push(0x80 | reg | base);
                self.bytes.extend(offset.to_le_bytes());
            }
        }
    }

    /// An operand behind the code; gives where its distance stands.
    fn distance(&mut self, reg: u8) -> usize {
        self.bytes.push(0x05 | reg);
        self.bytes.extend([0; 4]);
        self.bytes.len() - 4
    }

    /// A vector of eight constants behind the code.
    pub fn row(&mut self, row: [u64; 8]) -> Place {
        let known = self.rows.iter().position(|known| *known == row);
        Place::Row(known.unwrap_or_else(|| {
            self.rows.push(row);
            self.rows.len() - 1
        }))
    }

    /// A table behind the code; gives its distance from the first.
    pub fn table(&mut self, table: Vec<u64>) -> i32 {
        let known = self.tables.iter().position(|known| *known == table);
        let number = known.unwrap_or_else(|| {
            self.tables.push(table);
            self.tables.len() - 1
        });
        8 * self.tables[..number].iter().map(Vec::len).sum::<usize>() as i32
    }

    /// Lets r11 be the address of the first table.
    pub fn reach_tables(&mut self) {
        self.plain(&[0x4c, 0x8d, 0x1d]); // lea r11, [rip + distance]
        self.wanted_tables = Some(self.bytes.len());
        self.plain(&[0; 4]);
    }

    /// Instructions without vectors, as bytes.
    pub fn plain(&mut self, bytes: &[u8]) {
        self.bytes.extend(bytes);
    }

    /// Where the next instruction begins.
    pub fn here(&self) -> usize {
        self.bytes.len()
    }

    /// A jump whose target is not yet known; `opcode` takes a distance of 32 bits.
    pub fn jump(&mut self, opcode: &[u8]) -> usize {
        self.bytes.extend(opcode);
        self.bytes.extend([0; 4]);
        self.bytes.len() - 4
    }

    /// Lets a jump lead to a place.
    pub fn lead(&mut self, jump: usize, to: usize) {
        let distance = i32::try_from(to as i64 - (jump as i64 + 4)).expect("code is shorter than 2 GiB");
        self.bytes[jump..jump + 4].copy_from_slice(&distance.to_le_bytes());
    }

    /// The code and, behind it, its constants: to lie at a multiple of 64.
    pub fn finish(mut self) -> Vec<u8> {
        // EVEX spreads one number over the lanes as it reads it.
        let copies = match self.width {
            Vectors::Avx512 => 1,
            width => width.lanes(),
        };
        self.bytes.resize(self.bytes.len().next_multiple_of(64), 0xcc);
        let begin = self.bytes.len();
        for (at, end, number) in std::mem::take(&mut self.wanted) {
            let distance = i32::try_from(begin + 8 * copies * number - end).expect("code is shorter than 2 GiB");
            self.bytes[at..at + 4].copy_from_slice(&distance.to_le_bytes());
        }
        for bits in &self.constants {
            for _ in 0..copies {
                self.bytes.extend(bits.to_le_bytes());
            }
        }
        self.bytes.resize(self.bytes.len().next_multiple_of(64), 0xcc);
        let begin = self.bytes.len();
        for (at, end, number) in std::mem::take(&mut self.wanted_rows) {
            let distance = i32::try_from(begin + 64 * number - end).expect("code is shorter than 2 GiB");
            self.bytes[at..at + 4].copy_from_slice(&distance.to_le_bytes());
        }
        self.bytes.extend(self.rows.iter().flatten().flat_map(|bits| bits.to_le_bytes()));
        if let Some(at) = self.wanted_tables {
            let distance = i32::try_from(self.bytes.len() - (at + 4)).expect("code is shorter than 2 GiB");
            self.bytes[at..at + 4].copy_from_slice(&distance.to_le_bytes());
        }
        self.bytes.extend(self.tables.iter().flatten().flat_map(|bits| bits.to_le_bytes()));
        self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::instructions::*;
    use super::*;

    #[track_caller]
    fn check(width: Vectors, write: impl Fn(&mut Assembler), expected: &[u8]) {
        let mut code = Assembler::new(width);
        write(&mut code);
        assert_eq!(code.bytes, expected, "{:02x?}", code.bytes);
    }

    /// Against the GNU assembler's bytes.
    #[test]
    fn instructions_have_the_bytes_of_the_manual() {
        let look_up = [
            [0x4c, 0x8b, 0x97, 0, 1, 0, 0].as_slice(),
            &[0xc4, 0x21, 0x7b, 0x10, 0x4c, 0x96, 0x40],
            &[0x4c, 0x8b, 0x97, 8, 1, 0, 0],
            &[0xc4, 0x21, 0x31, 0x16, 0x4c, 0x96, 0x40],
            &[0x4c, 0x8b, 0x97, 16, 1, 0, 0],
            &[0xc4, 0xa1, 0x7b, 0x10, 0x5c, 0x96, 0x40],
            &[0x4c, 0x8b, 0x97, 24, 1, 0, 0],
            &[0xc4, 0xa1, 0x61, 0x16, 0x5c, 0x96, 0x40],
            &[0xc4, 0x63, 0x35, 0x18, 0xcb, 1],
        ]
        .concat();
        let look_up_two = [
            [0x4c, 0x8b, 0x97, 0, 1, 0, 0].as_slice(),
            &[0xc4, 0x81, 0x79, 0x28, 0x5c, 0xd3, 0x40],
            &[0x4c, 0x8b, 0x97, 8, 1, 0, 0],
            &[0xc4, 0x81, 0x79, 0x28, 0x64, 0xd3, 0x40],
            &[0xc5, 0x61, 0x14, 0xcc],
            &[0xc5, 0xe1, 0x15, 0xe4],
        ]
        .concat();
        // vaddpd zmm17, zmm2, zmm30
        check(
            Vectors::Avx512,
            |c| c.vector(ADD, 17, 2, Place::Register(30), None),
            &[0x62, 0x81, 0xed, 0x48, 0x58, 0xce],
        );
        // vfmadd231pd ymm9, ymm1, [r8+0x100]
        check(
            Vectors::Avx2,
            |c| c.vector(FMA_231, 9, 1, Place::Memory(Base::Before, 0x100), None),
            &[0xc4, 0x42, 0xf5, 0xb8, 0x88, 0, 1, 0, 0],
        );
        // vaddpd ymm9, ymm1, [r8]; vmovapd [rcx-0x20], ymm1; vaddpd zmm1, zmm2, [r8+0x1fc0]
        check(
            Vectors::Avx2,
            |c| c.vector(ADD, 9, 1, Place::Memory(Base::Before, 0), None),
            &[0xc4, 0x41, 0x75, 0x58, 0x08],
        );
        check(
            Vectors::Avx2,
            |c| c.vector(STORE, 1, 0, Place::Memory(Base::Statuses, -0x20), None),
            &[0xc5, 0xfd, 0x29, 0x49, 0xe0],
        );
        check(
            Vectors::Avx512,
            |c| c.vector(ADD, 1, 2, Place::Memory(Base::Before, 0x1fc0), None),
            &[0x62, 0xd1, 0xed, 0x48, 0x58, 0x48, 0x7f],
        );
        // vblendmpd zmm1{k3}, zmm2, zmm4
        check(
            Vectors::Avx512,
            |c| c.masked(BLEND, 1, 2, Place::Register(4), None, 3),
            &[0x62, 0xf2, 0xed, 0x4b, 0x65, 0xcc],
        );
        // mov r10, [rdi+0x100]; vmovsd xmm9, [rsi+r10*4+0x40]; mov r10, [rdi+0x108]; vmovhpd xmm9, xmm9, [rsi+r10*4+0x40];
        // …; vinsertf128 ymm9, ymm9, xmm3, 1
        check(Vectors::Avx2, |c| c.look_up(9, (Base::Block, 0x100), 4, 0x40, 3), &look_up);
        // mov r10, [rdi+0x100]; vmovapd xmm3, [r11+r10*8+0x40]; mov r10, [rdi+0x108]; vmovapd xmm4, [r11+r10*8+0x40];
        // vunpcklpd xmm9, xmm3, xmm4; vunpckhpd xmm4, xmm3, xmm4
        check(Vectors::Avx, |c| c.look_up_two([9, 4], (Base::Block, 0x100), 0x40, 3), &look_up_two);
        // vgatherqpd zmm17{k2}, [rsi+zmm26*8+0x200]
        check(Vectors::Avx512, |c| c.gather(17, 26, 2, 0x200), &[0x62, 0xa2, 0xfd, 0x42, 0x93, 0x8c, 0xd6, 0, 2, 0, 0]);
        // vrndscalepd zmm3, zmm20, 9
        check(
            Vectors::Avx512,
            |c| c.vector(ROUND, 3, 0, Place::Register(20), Some(9)),
            &[0x62, 0xb3, 0xfd, 0x48, 0x09, 0xdc, 0x09],
        );
        // vpsraq zmm18, zmm5, 7: the register it goes to stands where the second operand does.
        check(
            Vectors::Avx512,
            |c| c.vector(SHIFT_SIGNED, 4, 18, Place::Register(5), Some(7)),
            &[0x62, 0xf1, 0xed, 0x40, 0x72, 0xe5, 0x07],
        );
        // vblendvpd ymm1, ymm2, ymm3, ymm4
        check(
            Vectors::Avx2,
            |c| c.vector(BLEND_BY_SIGN, 1, 2, Place::Register(3), Some(4 << 4)),
            &[0xc4, 0xe3, 0x6d, 0x4b, 0xcb, 0x40],
        );
        // kandnb k1, k2, k3
        check(Vectors::Avx512, |c| c.mask(MASK_AND_NOT, 1, 2, Place::Register(3)), &[0xc5, 0xed, 0x42, 0xcb]);
        // vcvtqq2pd zmm1, zmm2
        check(
            Vectors::Avx512,
            |c| c.vector(TO_REAL, 1, 0, Place::Register(2), None),
            &[0x62, 0xf1, 0xfe, 0x48, 0xe6, 0xca],
        );
        // korb k1, k2, k3
        check(Vectors::Avx512, |c| c.mask(MASK_OR, 1, 2, Place::Register(3)), &[0xc5, 0xed, 0x45, 0xcb]);
    }
}
