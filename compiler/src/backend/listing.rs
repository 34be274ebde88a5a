//! Machine code of our own as text, with the disassembler of `iced-x86`.
//!
//! In: instructions of x86-64, and the constants behind them. Out: a line for each instruction, indented, as Cranelift's; what
//! is jumped to is named by its place, and behind what reads a constant stands its value.

use iced_x86::{Decoder, DecoderOptions, Formatter, GasFormatter, Instruction, Mnemonic, OpKind};
use std::collections::BTreeSet;

/// The first `len` bytes of `code`; a jump whose distance stands at one of `to_others` leads elsewhere.
pub fn listing(code: &[u8], len: usize, to_others: &[usize]) -> String {
    let instructions: Vec<Instruction> = Decoder::new(64, &code[..len], DecoderOptions::NONE).into_iter().collect();
    let jumps = |instruction: &Instruction| instruction.op0_kind() == OpKind::NearBranch64;
    let leaves = |instruction: &Instruction| to_others.contains(&(instruction.next_ip() as usize - 4));
    let targets: BTreeSet<u64> =
        instructions.iter().filter(|it| jumps(it) && !leaves(it)).map(Instruction::near_branch_target).collect();
    let mut formatter = GasFormatter::new();
    let options = formatter.options_mut();
    options.set_rip_relative_addresses(true);
    options.set_uppercase_hex(false);
    options.set_space_after_operand_separator(true);
    let (mut text, mut line) = (String::new(), String::new());
    for instruction in &instructions {
        if targets.contains(&instruction.ip()) {
            text += &format!("at {:#x}:\n", instruction.ip());
        }
        line.clear();
        if jumps(instruction) {
            formatter.format_mnemonic(instruction, &mut line);
            line += &if leaves(instruction) {
                " (to any number of iterations)".to_string()
            } else {
                format!(" (at {:#x})", instruction.near_branch_target())
            };
        } else {
            formatter.format(instruction, &mut line);
            if let Some(number) = constant(instruction, code) {
                line += &format!("  ; {number}");
            }
        }
        text += &format!("  {line}\n");
    }
    text
}

/// What an instruction reads from behind the code: a real, or the bits of a mask.
fn constant(instruction: &Instruction, code: &[u8]) -> Option<String> {
    if !instruction.is_ip_rel_memory_operand() {
        return None;
    }
    let at = usize::try_from(instruction.ip_rel_memory_address()).ok()?;
    let bits = u64::from_le_bytes(code.get(at..at + 8)?.try_into().ok()?);
    Some(match instruction.mnemonic() {
        Mnemonic::Vandpd | Mnemonic::Vandnpd | Mnemonic::Vorpd | Mnemonic::Vxorpd => format!("{bits:#018x}"),
        _ => format!("{:?}", f64::from_bits(bits)),
    })
}

#[cfg(test)]
mod tests {
    use super::listing;

    #[test]
    fn jumps_say_where_and_constants_what() {
        // cmp rdx, 1; jne others; vaddsd xmm0, xmm1, [rip+9]; je +1; nop; ret; and 2.5.
        let mut code = vec![0x48, 0x83, 0xfa, 1, 0x0f, 0x85, 0, 0, 0, 0];
        code.extend([0xc5, 0xf3, 0x58, 0x05, 4, 0, 0, 0, 0x74, 1, 0x90, 0xc3]);
        let len = code.len();
        code.extend(2.5f64.to_le_bytes());
        let lines = [
            "  cmp $1, %rdx",
            "  jne (to any number of iterations)",
            "  vaddsd 4(%rip), %xmm1, %xmm0  ; 2.5",
            "  je (at 0x15)",
            "  nop",
            "at 0x15:",
            "  ret",
            "",
        ];
        assert_eq!(listing(&code, len, &[6]), lines.join("\n"));
    }
}
