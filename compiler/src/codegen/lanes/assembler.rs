//! Assembler for vector instructions of x86-64: VEX encoding with 128 and 256 bits, EVEX with 512 bits.
//!
//! In: instructions with registers, memory operands and constants. Out: bytes, followed by the constants, which are
//! addressed relative to the instruction pointer. It knows nothing of programs.
//!
//! Source: Intel 64 and IA-32 Architectures Software Developer's Manual, volume 2, sections 2.3 and 2.7.

use crate::ir::hash::HashMap;

/// Kind of vector.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Vectors {
    /// One lane of 64 bits in 16 registers: AVX and FMA.
    Scalar,
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
            Vectors::Scalar => 1,
            Vectors::Avx => 2,
            Vectors::Avx2 => 4,
            Vectors::Avx512 => 8,
        }
    }

    /// Bytes of a vector.
    pub fn bytes(self) -> i32 {
        8 * self.lanes() as i32
    }

    /// Number of vector registers.
    pub fn registers(self) -> u8 {
        match self {
            Vectors::Scalar | Vectors::Avx | Vectors::Avx2 => 16,
            Vectors::Avx512 => 32,
        }
    }
}

/// A general register that holds an address; the number is that of the register.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Base {
    /// rdi: the block.
    Block = 7,
    /// rsi: the pool.
    Pool = 6,
    /// rdx: scratch space.
    Scratch = 2,
    /// rcx: the statuses.
    Statuses = 1,
    /// r8: the carried slots at the start of an iteration.
    Before = 8,
    /// r9: the carried slots at its end.
    After = 9,
    /// r14: the row of inputs.
    Inputs = 14,
    /// r15: the row of outputs.
    Outputs = 15,
}

/// The last operand of an instruction.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Place {
    /// A vector or mask register.
    Register(u8),
    /// A vector in memory, at an offset in bytes.
    Memory(Base, i32),
    /// A constant in every lane, by its bits.
    Constant(u64),
    /// A vector of eight constants, by its index; see [`Assembler::row`].
    Row(usize),
}

/// An instruction: mandatory prefix (0: none, 1: 66, 2: F3, 3: F2), opcode map (1: 0F, 2: 0F 38, 3: 0F 3A), W bit of
/// the EVEX and of the VEX form, opcode. In the comments d is the destination, v the second and rm the last operand.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Instruction(pub u8, pub u8, pub [u8; 2], pub u8);

impl Instruction {
    /// The scalar form of a packed instruction: it computes one double, and reads 8 bytes of memory where the packed form
    /// reads a vector. `None` for operations on bits and on integers, which have no scalar form.
    pub fn scalar(self) -> Option<Instruction> {
        let Instruction(prefix, map, w, opcode) = self;
        match (prefix, map, opcode) {
            // Moves from and to memory that need no alignment, arithmetic, comparisons.
            (1, 1, 0x10 | 0x11 | 0x51 | 0x58 | 0x59 | 0x5c..=0x5f | 0xc2) => Some(Instruction(3, map, w, opcode)),
            (1, 1, 0x28 | 0x29) => Some(Instruction(3, map, w, opcode - 0x18)),
            (1, 3, 0x09) => Some(Instruction(prefix, map, w, 0x0b)),
            (1, 2, 0x98..=0xbf) => Some(Instruction(prefix, map, w, opcode + 1)),
            _ => None,
        }
    }
}

#[rustfmt::skip]
#[allow(missing_docs)]
pub mod instructions {
    use super::Instruction;
    pub const VADDPD: Instruction = Instruction(1, 1, [1, 0], 0x58);
    pub const VMULPD: Instruction = Instruction(1, 1, [1, 0], 0x59);
    pub const VSUBPD: Instruction = Instruction(1, 1, [1, 0], 0x5c);
    pub const VMINPD: Instruction = Instruction(1, 1, [1, 0], 0x5d);
    pub const VDIVPD: Instruction = Instruction(1, 1, [1, 0], 0x5e);
    pub const VMAXPD: Instruction = Instruction(1, 1, [1, 0], 0x5f);
    pub const VSQRTPD: Instruction = Instruction(1, 1, [1, 0], 0x51);
    pub const VANDPD: Instruction = Instruction(1, 1, [1, 0], 0x54);
    /// ¬v ∧ rm
    pub const VANDNPD: Instruction = Instruction(1, 1, [1, 0], 0x55);
    pub const VORPD: Instruction = Instruction(1, 1, [1, 0], 0x56);
    pub const VXORPD: Instruction = Instruction(1, 1, [1, 0], 0x57);
    pub const VCMPPD: Instruction = Instruction(1, 1, [1, 0], 0xc2);
    pub const VMOVAPD_LOAD: Instruction = Instruction(1, 1, [1, 0], 0x28);
    pub const VMOVAPD_STORE: Instruction = Instruction(1, 1, [1, 0], 0x29);
    /// Memory operands need no alignment.
    pub const VMOVUPD_LOAD: Instruction = Instruction(1, 1, [1, 0], 0x10);
    pub const VMOVUPD_STORE: Instruction = Instruction(1, 1, [1, 0], 0x11);
    pub const VBROADCASTSD: Instruction = Instruction(1, 2, [1, 0], 0x19);
    /// VRNDSCALEPD in its EVEX form.
    pub const VROUNDPD: Instruction = Instruction(1, 3, [1, 0], 0x09);
    /// d = d · rm + v
    pub const VFMADD132PD: Instruction = Instruction(1, 2, [1, 1], 0x98);
    /// d = v · d + rm
    pub const VFMADD213PD: Instruction = Instruction(1, 2, [1, 1], 0xa8);
    /// d = v · rm + d
    pub const VFMADD231PD: Instruction = Instruction(1, 2, [1, 1], 0xb8);
    pub const VGATHERQPD: Instruction = Instruction(1, 2, [1, 1], 0x93);
    pub const VPADDQ: Instruction = Instruction(1, 1, [1, 0], 0xd4);
    pub const VPSUBQ: Instruction = Instruction(1, 1, [1, 0], 0xfb);
    /// By a constant: VPSRLQ with reg field 2, VPSLLQ with reg field 6.
    pub const SHIFT: Instruction = Instruction(1, 1, [1, 0], 0x73);
    /// By a constant; the reg field is 4.
    pub const VPSRAQ: Instruction = Instruction(1, 1, [1, 0], 0x72);
    /// VEX only.
    pub const VINSERTF128: Instruction = Instruction(1, 3, [0, 0], 0x18);
    /// The low lane of each pair, from v and from rm.
    pub const VUNPCKLPD: Instruction = Instruction(1, 1, [1, 0], 0x14);
    pub const VUNPCKHPD: Instruction = Instruction(1, 1, [1, 0], 0x15);
    /// A single double from memory, into the low lane.
    pub const VMOVSD: Instruction = Instruction(3, 1, [0, 0], 0x10);
    pub const VMOVHPD: Instruction = Instruction(1, 1, [0, 0], 0x16);
    /// The low lane to memory.
    pub const VMOVSD_STORE: Instruction = Instruction(3, 1, [0, 0], 0x11);
    /// Copies between the low lane of reg and the general register rm. VEX only, as the conversions that follow.
    pub const VMOVQ_FROM_GENERAL: Instruction = Instruction(1, 1, [1, 1], 0x6e);
    pub const VMOVQ_TO_GENERAL: Instruction = Instruction(1, 1, [1, 1], 0x7e);
    /// Converts the integer in the general register rm to a double; the upper lane is copied from v.
    pub const VCVTSI2SD: Instruction = Instruction(3, 1, [1, 1], 0x2a);
    /// Converts a double, without its fraction, to an integer in the general register reg.
    pub const VCVTTSD2SI: Instruction = Instruction(3, 1, [1, 1], 0x2c);
    pub const VPCMPEQQ: Instruction = Instruction(1, 2, [1, 0], 0x29);
    pub const VPCMPGTQ: Instruction = Instruction(1, 2, [1, 0], 0x37);
    pub const VBLENDVPD: Instruction = Instruction(1, 3, [0, 0], 0x4b);
    /// EVEX only.
    pub const VBLENDMPD: Instruction = Instruction(1, 2, [1, 0], 0x65);
    /// Replaces v according to its class (NaN, zero, infinity, sign), by the response table in rm. The immediate is 0:
    /// no exceptions.
    pub const VFIXUPIMMPD: Instruction = Instruction(1, 3, [1, 0], 0x54);
    /// v · 2^⌊rm⌋
    pub const VSCALEFPD: Instruction = Instruction(1, 2, [1, 0], 0x2c);
    /// Permutes the lanes of the two tables d and rm, d first, by the low bits of v.
    pub const VPERMT2PD: Instruction = Instruction(1, 2, [1, 0], 0x7f);
    /// A mask: whether v and rm have a set bit in common.
    pub const VPTESTMQ: Instruction = Instruction(1, 2, [1, 0], 0x27);
    pub const VPMULLQ: Instruction = Instruction(1, 2, [1, 0], 0x40);
    pub const VPMINUQ: Instruction = Instruction(1, 2, [1, 0], 0x3b);
    pub const VPCMPQ: Instruction = Instruction(1, 3, [1, 0], 0x1f);
    pub const VCVTTPD2QQ: Instruction = Instruction(1, 1, [1, 0], 0x7a);
    pub const VCVTQQ2PD: Instruction = Instruction(2, 1, [1, 0], 0xe6);
    /// Instructions on mask registers, in VEX encoding; the number is the L bit.
    pub const KANDB: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x41), 1);
    pub const KANDNB: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x42), 1);
    pub const KNOTB: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x44), 0);
    pub const KORB: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x45), 1);
    pub const KXNORB: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x46), 1);
    pub const KXORB: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x47), 1);
    pub const KORTESTB: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x98), 0);
    pub const KMOVB_LOAD: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x90), 0);
    pub const KMOVB_STORE: (Instruction, u8) = (Instruction(1, 1, [0, 0], 0x91), 0);
}

/// Code and constants emitted so far.
pub struct Assembler {
    width: Vectors,
    bytes: Vec<u8>,
    /// Constants in the order of their first use, as bits.
    constants: Vec<u64>,
    /// The index of each constant.
    indices: HashMap<u64, usize>,
    /// References to constants: position of the displacement, end of the instruction, index.
    references: Vec<(usize, usize, usize)>,
    /// Vectors of constants.
    rows: Vec<[u64; 8]>,
    /// References to these, as above.
    row_references: Vec<(usize, usize, usize)>,
    /// Tables after the constants.
    tables: Vec<Vec<u64>>,
    /// Position of the displacement in the instruction that loads the address of the tables, if there is one.
    table_reference: Option<usize>,
}

/// General registers that no base needs.
const R10: u8 = 10;
const R11: u8 = 11;

/// Added to the number of a mask register: lanes that are masked off become 0 instead of keeping their content.
pub const ZEROING: u8 = 1 << 7;

impl Assembler {
    pub fn new(width: Vectors) -> Assembler {
        Assembler {
            width,
            bytes: Vec::new(),
            constants: Vec::new(),
            indices: HashMap::default(),
            references: Vec::new(),
            rows: Vec::new(),
            row_references: Vec::new(),
            tables: Vec::new(),
            table_reference: None,
        }
    }

    /// Emits an instruction without a mask. `reg` and `second`: the operands in the order of the manual.
    pub fn vector(&mut self, instruction: Instruction, reg: u8, second: u8, last: Place, immediate: Option<u8>) {
        self.masked(instruction, reg, second, last, immediate, 0);
    }

    /// Emits an instruction with a mask register, perhaps with [`ZEROING`]; 0 means no mask. VEX has no masks.
    pub fn masked(
        &mut self,
        instruction: Instruction,
        reg: u8,
        second: u8,
        last: Place,
        immediate: Option<u8>,
        mask: u8,
    ) {
        match self.width {
            Vectors::Avx512 => {
                self.evex(instruction, reg, second, last, mask);
                self.operand(reg, last, immediate, self.width.bytes());
            }
            Vectors::Avx | Vectors::Avx2 => {
                assert_eq!(mask, 0, "VEX has no masks");
                self.vex(instruction, reg, second, last, u8::from(self.width == Vectors::Avx2));
                self.operand(reg, last, immediate, 1);
            }
            Vectors::Scalar => self.scalar(instruction, reg, second, last, immediate),
        }
    }

    /// Emits an instruction on one lane.
    fn scalar(&mut self, instruction: Instruction, reg: u8, second: u8, last: Place, immediate: Option<u8>) {
        let is_move = matches!(instruction, instructions::VMOVAPD_LOAD | instructions::VMOVAPD_STORE);
        let form = instruction.scalar().filter(|_| !is_move || !matches!(last, Place::Register(_)));
        let second = match (instruction, last) {
            // These take the upper lane, which nobody reads, from another register.
            (instructions::VSQRTPD | instructions::VROUNDPD, Place::Register(last)) => last,
            (instructions::VSQRTPD | instructions::VROUNDPD, _) => reg,
            _ => second,
        };
        self.vex(form.unwrap_or(instruction), reg, second, last, 0);
        self.operand(reg, last, immediate, 1);
    }

    /// Copies a vector from memory to memory, through register 0.
    pub fn copy(&mut self, from: Place, to: Place) {
        self.vector(instructions::VMOVAPD_LOAD, 0, 0, from, None);
        self.vector(instructions::VMOVAPD_STORE, 0, 0, to, None);
    }

    /// Emits an instruction on mask registers.
    pub fn mask(&mut self, (instruction, l): (Instruction, u8), reg: u8, second: u8, last: Place) {
        self.vex(instruction, reg, second, last, l);
        self.operand(reg, last, None, 1);
    }

    /// Gathers entries of the table at `offset` bytes of the pool, at the indices in a vector, in lanes where a mask is
    /// set. The instruction clears the mask. EVEX only.
    pub fn gather(&mut self, to: u8, index: u8, mask: u8, offset: i32) {
        let Instruction(pp, map, w, opcode) = instructions::VGATHERQPD;
        let bit = |register: u8, n: u8| (!register >> n) & 1;
        let p0 = bit(to, 3) << 7 | bit(index, 3) << 6 | 1 << 5 | bit(to, 4) << 4 | map;
        let p1 = w[0] << 7 | 0xf << 3 | 1 << 2 | pp;
        let p2 = 2 << 5 | bit(index, 4) << 3 | mask;
        self.bytes.extend([0x62, p0, p1, p2, opcode]);
        self.gather_operand(to, index, offset);
    }

    /// Loads entries of a table of the pool, `displacement` bytes after its start, at the indices in a vector in memory; an
    /// index is multiplied by `scale` bytes. Overwrites `half`. VEX only, lane by lane through r10, which is faster
    /// than the gather instruction.
    pub fn look_up(&mut self, to: u8, indices: (Base, i32), scale: u8, displacement: i32, half: u8) {
        let pool = (Base::Pool as u8, scale, displacement);
        for (upper, into) in [to, half].into_iter().enumerate().take(self.width.lanes() / 2) {
            self.load_index(indices, 2 * upper);
            self.table_entry(instructions::VMOVSD, into, 0, 0, pool);
            self.load_index(indices, 2 * upper + 1);
            self.table_entry(instructions::VMOVHPD, into, into, 0, pool);
        }
        if self.width == Vectors::Avx2 {
            self.vector(instructions::VINSERTF128, to, to, Place::Register(half), Some(1));
        }
    }

    /// Loads the entry of a table at an index. `table`: where it begins, in bytes. Scalar only.
    pub fn look_up_one(&mut self, to: u8, index: u8, (base, displacement): (Base, i32)) {
        self.copy_to_general(R10, index);
        self.table_entry(instructions::VMOVSD, to, 0, 0, (base as u8, 8, displacement));
    }

    /// Writes an entry. Scalar only.
    pub fn write_one(&mut self, value: u8, index: u8, (base, displacement): (Base, i32)) {
        self.copy_to_general(R10, index);
        self.table_entry(instructions::VMOVSD_STORE, value, 0, 0, (base as u8, 8, displacement));
    }

    /// The product of two integers, modulo 2^64. Scalar only.
    pub fn integer_product(&mut self, to: u8, a: u8, b: u8) {
        self.copy_to_general(R10, a);
        self.copy_to_general(R11, b);
        self.raw(&[0x4d, 0x0f, 0xaf, 0xd3]); // imul r10, r11
        self.copy_from_general(to, R10);
    }

    /// A real without its fraction as an integer; the least integer for NaN and out of range. Scalar only.
    pub fn integer_of(&mut self, to: u8, from: u8) {
        self.vex(instructions::VCVTTSD2SI, R10, 0, Place::Register(from), 0);
        self.bytes.push(0xc0 | (R10 & 7) << 3 | from & 7);
        self.copy_from_general(to, R10);
    }

    /// An integer as a real. Scalar only.
    pub fn real_of(&mut self, to: u8, from: u8) {
        self.copy_to_general(R10, from);
        // The upper lane, which nobody reads, is taken from a register that is ready.
        self.vex(instructions::VCVTSI2SD, to, from, Place::Register(R10), 0);
        self.bytes.push(0xc0 | (to & 7) << 3 | R10 & 7);
    }

    /// Copies a lane to a general register.
    fn copy_to_general(&mut self, to: u8, from: u8) {
        self.vex(instructions::VMOVQ_TO_GENERAL, from, 0, Place::Register(to), 0);
        self.bytes.push(0xc0 | (from & 7) << 3 | to & 7);
    }

    /// Copies a general register to a lane.
    fn copy_from_general(&mut self, to: u8, from: u8) {
        self.vex(instructions::VMOVQ_FROM_GENERAL, to, 0, Place::Register(from), 0);
        self.bytes.push(0xc0 | (to & 7) << 3 | from & 7);
    }

    /// Loads entries of two interleaved tables, `displacement` bytes after r11, at the indices in a vector in memory, which are
    /// already multiplied by 2. Overwrites `half`. VEX only, after [`Assembler::load_table_address`].
    pub fn look_up_two(&mut self, [first, second]: [u8; 2], indices: (Base, i32), displacement: i32, half: u8) {
        let table = (11, 8, displacement);
        for (lane, into) in [half, second].into_iter().enumerate() {
            self.load_index(indices, lane);
            self.table_entry(instructions::VMOVAPD_LOAD, into, 0, 0, table);
            if self.width == Vectors::Avx2 {
                self.load_index(indices, lane + 2);
                self.table_entry(instructions::VINSERTF128, into, into, 1, table);
                self.bytes.push(1);
            }
        }
        self.vector(instructions::VUNPCKLPD, first, half, Place::Register(second), None);
        self.vector(instructions::VUNPCKHPD, second, half, Place::Register(second), None);
    }

    /// Loads one lane of a vector in memory, an index, into r10.
    fn load_index(&mut self, (base, offset): (Base, i32), lane: usize) {
        self.bytes.extend([0x4c | base as u8 >> 3, 0x8b]);
        self.memory_operand(2 << 3, base, offset + 8 * lane as i32, 1);
    }

    /// Emits a VEX instruction on the table entry at a base register, plus a displacement, plus r10 times the scale.
    fn table_entry(
        &mut self,
        Instruction(pp, map, w, opcode): Instruction,
        reg: u8,
        second: u8,
        l: u8,
        (base, scale, displacement): (u8, u8, i32),
    ) {
        let p0 = (!reg >> 3 & 1) << 7 | (!base >> 3 & 1) << 5 | map;
        self.bytes.extend([0xc4, p0, w[1] << 7 | (!second & 15) << 3 | l << 2 | pp, opcode]);
        let (reg, index) = ((reg & 7) << 3, (scale.trailing_zeros() as u8) << 6 | 2 << 3 | base & 7);
        match i8::try_from(displacement) {
            Ok(displacement) => self.bytes.extend([0x44 | reg, index, displacement as u8]),
            Err(_) => {
                self.bytes.extend([0x84 | reg, index]);
                self.bytes.extend(displacement.to_le_bytes());
            }
        }
    }

    /// Encodes a memory operand in the pool: a vector of indices scaled by 8, and a displacement of 32 bits.
    fn gather_operand(&mut self, reg: u8, index: u8, offset: i32) {
        self.bytes.extend([0x84 | (reg & 7) << 3, 0xc0 | (index & 7) << 3 | Base::Pool as u8]);
        self.bytes.extend(offset.to_le_bytes());
    }

    fn evex(&mut self, Instruction(pp, map, w, opcode): Instruction, reg: u8, second: u8, last: Place, mask: u8) {
        let bit = |register: u8, n: u8| (!register >> n) & 1;
        let (x, b, broadcast) = match last {
            Place::Register(register) => (bit(register, 4), bit(register, 3), 0),
            Place::Memory(base, _) => (1, bit(base as u8, 3), 0),
            Place::Constant(_) => {
                (1, 1, u8::from(self.width == Vectors::Avx512 && opcode != instructions::VBROADCASTSD.3))
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

    /// Encodes the last operand and the immediate. `unit`: bytes that a displacement of 8 bits counts (disp8·N in EVEX,
    /// 1 in VEX).
    fn operand(&mut self, reg: u8, last: Place, immediate: Option<u8>, unit: i32) {
        let reg = (reg & 7) << 3;
        match last {
            Place::Register(register) => self.bytes.push(0xc0 | reg | register & 7),
            Place::Memory(base, offset) => self.memory_operand(reg, base, offset, unit),
            Place::Constant(bits) => {
                let next = self.constants.len();
                let number = *self.indices.entry(bits).or_insert(next);
                if number == next {
                    self.constants.push(bits);
                }
                let at = self.rip_relative(reg);
                self.references.push((at, at + 4 + usize::from(immediate.is_some()), number));
            }
            Place::Row(number) => {
                let at = self.rip_relative(reg);
                self.row_references.push((at, at + 4 + usize::from(immediate.is_some()), number));
            }
        }
        self.bytes.extend(immediate);
    }

    /// Encodes a memory operand: no displacement, one byte in units of `unit`, or four bytes.
    fn memory_operand(&mut self, reg: u8, base: Base, offset: i32, unit: i32) {
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

    /// Encodes an operand relative to the instruction pointer; returns the position of its displacement.
    fn rip_relative(&mut self, reg: u8) -> usize {
        self.bytes.push(0x05 | reg);
        self.bytes.extend([0; 4]);
        self.bytes.len() - 4
    }

    /// Adds a vector of eight constants after the code.
    pub fn row(&mut self, row: [u64; 8]) -> Place {
        let known = self.rows.iter().position(|known| *known == row);
        Place::Row(known.unwrap_or_else(|| {
            self.rows.push(row);
            self.rows.len() - 1
        }))
    }

    /// Adds a table after the code; returns its offset in bytes from the first table.
    pub fn table(&mut self, table: Vec<u64>) -> i32 {
        let known = self.tables.iter().position(|known| *known == table);
        let number = known.unwrap_or_else(|| {
            self.tables.push(table);
            self.tables.len() - 1
        });
        8 * self.tables[..number].iter().map(Vec::len).sum::<usize>() as i32
    }

    /// Loads the address of the first table into r11.
    pub fn load_table_address(&mut self) {
        self.raw(&[0x4c, 0x8d, 0x1d]); // lea r11, [rip + displacement]
        self.table_reference = Some(self.bytes.len());
        self.raw(&[0; 4]);
    }

    /// Emits the bytes of scalar instructions.
    pub fn raw(&mut self, bytes: &[u8]) {
        self.bytes.extend(bytes);
    }

    /// The current position.
    pub fn position(&self) -> usize {
        self.bytes.len()
    }

    /// Emits a jump with an open target; `opcode` takes a displacement of 32 bits. Returns the position of the
    /// displacement.
    pub fn jump(&mut self, opcode: &[u8]) -> usize {
        self.bytes.extend(opcode);
        self.bytes.extend([0; 4]);
        self.bytes.len() - 4
    }

    /// Sets the target of a jump.
    pub fn bind(&mut self, jump: usize, to: usize) {
        let displacement = i32::try_from(to as i64 - (jump as i64 + 4)).expect("code is shorter than 2 GiB");
        self.bytes[jump..jump + 4].copy_from_slice(&displacement.to_le_bytes());
    }

    /// The code followed by its constants; must be placed at a multiple of 64 bytes.
    pub fn finish(mut self) -> Vec<u8> {
        // EVEX broadcasts one double from memory; VEX needs a full vector.
        let copies = match self.width {
            Vectors::Avx512 => 1,
            // Operations on bits and on integers have no scalar form, so they read two doubles.
            Vectors::Scalar => 2,
            width => width.lanes(),
        };
        self.bytes.resize(self.bytes.len().next_multiple_of(64), 0xcc);
        let begin = self.bytes.len();
        for (at, end, number) in std::mem::take(&mut self.references) {
            let displacement = i32::try_from(begin + 8 * copies * number - end).expect("code is shorter than 2 GiB");
            self.bytes[at..at + 4].copy_from_slice(&displacement.to_le_bytes());
        }
        for bits in &self.constants {
            for _ in 0..copies {
                self.bytes.extend(bits.to_le_bytes());
            }
        }
        self.bytes.resize(self.bytes.len().next_multiple_of(64), 0xcc);
        let begin = self.bytes.len();
        for (at, end, number) in std::mem::take(&mut self.row_references) {
            let displacement = i32::try_from(begin + 64 * number - end).expect("code is shorter than 2 GiB");
            self.bytes[at..at + 4].copy_from_slice(&displacement.to_le_bytes());
        }
        self.bytes.extend(self.rows.iter().flatten().flat_map(|bits| bits.to_le_bytes()));
        if let Some(at) = self.table_reference {
            let displacement = i32::try_from(self.bytes.len() - (at + 4)).expect("code is shorter than 2 GiB");
            self.bytes[at..at + 4].copy_from_slice(&displacement.to_le_bytes());
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

    /// Expected bytes are from the GNU assembler.
    #[test]
    fn instructions_have_the_bytes_of_gnu_as() {
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
            |c| c.vector(VADDPD, 17, 2, Place::Register(30), None),
            &[0x62, 0x81, 0xed, 0x48, 0x58, 0xce],
        );
        // vfmadd231pd ymm9, ymm1, [r8+0x100]
        check(
            Vectors::Avx2,
            |c| c.vector(VFMADD231PD, 9, 1, Place::Memory(Base::Before, 0x100), None),
            &[0xc4, 0x42, 0xf5, 0xb8, 0x88, 0, 1, 0, 0],
        );
        // vaddpd ymm9, ymm1, [r8]; vmovapd [rcx-0x20], ymm1; vaddpd zmm1, zmm2, [r8+0x1fc0]
        check(
            Vectors::Avx2,
            |c| c.vector(VADDPD, 9, 1, Place::Memory(Base::Before, 0), None),
            &[0xc4, 0x41, 0x75, 0x58, 0x08],
        );
        check(
            Vectors::Avx2,
            |c| c.vector(VMOVAPD_STORE, 1, 0, Place::Memory(Base::Statuses, -0x20), None),
            &[0xc5, 0xfd, 0x29, 0x49, 0xe0],
        );
        check(
            Vectors::Avx512,
            |c| c.vector(VADDPD, 1, 2, Place::Memory(Base::Before, 0x1fc0), None),
            &[0x62, 0xd1, 0xed, 0x48, 0x58, 0x48, 0x7f],
        );
        // vblendmpd zmm1{k3}, zmm2, zmm4
        check(
            Vectors::Avx512,
            |c| c.masked(VBLENDMPD, 1, 2, Place::Register(4), None, 3),
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
            |c| c.vector(VROUNDPD, 3, 0, Place::Register(20), Some(9)),
            &[0x62, 0xb3, 0xfd, 0x48, 0x09, 0xdc, 0x09],
        );
        // vpsraq zmm18, zmm5, 7: the destination is encoded where other instructions have the second operand.
        check(
            Vectors::Avx512,
            |c| c.vector(VPSRAQ, 4, 18, Place::Register(5), Some(7)),
            &[0x62, 0xf1, 0xed, 0x40, 0x72, 0xe5, 0x07],
        );
        // vblendvpd ymm1, ymm2, ymm3, ymm4
        check(
            Vectors::Avx2,
            |c| c.vector(VBLENDVPD, 1, 2, Place::Register(3), Some(4 << 4)),
            &[0xc4, 0xe3, 0x6d, 0x4b, 0xcb, 0x40],
        );
        // kandnb k1, k2, k3
        check(Vectors::Avx512, |c| c.mask(KANDNB, 1, 2, Place::Register(3)), &[0xc5, 0xed, 0x42, 0xcb]);
        // vcvtqq2pd zmm1, zmm2
        check(
            Vectors::Avx512,
            |c| c.vector(VCVTQQ2PD, 1, 0, Place::Register(2), None),
            &[0x62, 0xf1, 0xfe, 0x48, 0xe6, 0xca],
        );
        // korb k1, k2, k3
        check(Vectors::Avx512, |c| c.mask(KORB, 1, 2, Place::Register(3)), &[0xc5, 0xed, 0x45, 0xcb]);
    }

    /// Expected bytes are from the GNU assembler.
    #[test]
    fn a_single_lane_has_the_bytes_of_gnu_as() {
        // vmovq r10, xmm9; vmovsd xmm3, [rsi+r10*8+0x40]
        let look_up = [0xc4, 0x41, 0xf9, 0x7e, 0xca, 0xc4, 0xa1, 0x7b, 0x10, 0x5c, 0xd6, 0x40];
        check(Vectors::Scalar, |c| c.look_up_one(3, 9, (Base::Pool, 0x40)), &look_up);
        // vmovq r10, xmm1; vmovsd [rdi+r10*8+0x400], xmm12
        let write = [0xc4, 0xc1, 0xf9, 0x7e, 0xca, 0xc4, 0x21, 0x7b, 0x11, 0xa4, 0xd7, 0, 4, 0, 0];
        check(Vectors::Scalar, |c| c.write_one(12, 1, (Base::Block, 0x400)), &write);
        // vmovq r10, xmm2; vmovq r11, xmm13; imul r10, r11; vmovq xmm8, r10
        let product = [
            [0xc4, 0xc1, 0xf9, 0x7e, 0xd2].as_slice(),
            &[0xc4, 0x41, 0xf9, 0x7e, 0xeb],
            &[0x4d, 0x0f, 0xaf, 0xd3],
            &[0xc4, 0x41, 0xf9, 0x6e, 0xc2],
        ]
        .concat();
        check(Vectors::Scalar, |c| c.integer_product(8, 2, 13), &product);
        // vcvttsd2si r10, xmm11; vmovq xmm4, r10
        let integer = [0xc4, 0x41, 0xfb, 0x2c, 0xd3, 0xc4, 0xc1, 0xf9, 0x6e, 0xe2];
        check(Vectors::Scalar, |c| c.integer_of(4, 11), &integer);
        // vmovq r10, xmm5; vcvtsi2sd xmm9, xmm5, r10
        let real = [0xc4, 0xc1, 0xf9, 0x7e, 0xea, 0xc4, 0x41, 0xd3, 0x2a, 0xca];
        check(Vectors::Scalar, |c| c.real_of(9, 5), &real);
        let one = |instruction, reg, second, last, immediate: Option<u8>, expected: &[u8]| {
            check(Vectors::Scalar, |c| c.vector(instruction, reg, second, last, immediate), expected);
        };
        // vaddsd xmm9, xmm1, [rdx+0x18]; vfnmadd231sd xmm9, xmm1, xmm2; vcmplt_oqsd xmm1, xmm2, xmm3
        one(VADDPD, 9, 1, Place::Memory(Base::Scratch, 0x18), None, &[0xc5, 0x73, 0x58, 0x4a, 0x18]);
        let negated = Instruction(1, 2, [1, 1], VFMADD231PD.3 + 4);
        one(negated, 9, 1, Place::Register(2), None, &[0xc4, 0x62, 0xf1, 0xbd, 0xca]);
        one(VCMPPD, 1, 2, Place::Register(3), Some(0x11), &[0xc5, 0xeb, 0xc2, 0xcb, 0x11]);
        // vsqrtsd xmm9, xmm12, xmm12; vroundsd xmm1, xmm1, [rdi+8], 9
        one(VSQRTPD, 9, 0, Place::Register(12), None, &[0xc4, 0x41, 0x1b, 0x51, 0xcc]);
        one(VROUNDPD, 1, 0, Place::Memory(Base::Block, 8), Some(9), &[0xc4, 0xe3, 0x71, 0x0b, 0x4f, 8, 9]);
        // vmovsd xmm2, [rdi+0x10]; vmovsd [rdx+0x10], xmm10; vmovapd xmm10, xmm2; vandpd xmm1, xmm2, xmm3
        one(VMOVAPD_LOAD, 2, 0, Place::Memory(Base::Block, 16), None, &[0xc5, 0xfb, 0x10, 0x57, 0x10]);
        one(VMOVAPD_STORE, 10, 0, Place::Memory(Base::Scratch, 16), None, &[0xc5, 0x7b, 0x11, 0x52, 0x10]);
        one(VMOVAPD_LOAD, 10, 0, Place::Register(2), None, &[0xc5, 0x79, 0x28, 0xd2]);
        one(VANDPD, 1, 2, Place::Register(3), None, &[0xc5, 0xe9, 0x54, 0xcb]);
    }
}
