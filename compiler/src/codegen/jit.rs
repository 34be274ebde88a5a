//! Machine code in memory, made for the processor it runs on.
//!
//! The memory is written first and made executable afterwards, never both at once, and is given back when the last
//! clone of the code goes. The code has no symbols, calls nothing but its own pieces and needs no relocation.

use super::target::{Bytes, FunctionCompiler, here};
use crate::codegen::emit::signature;
use crate::codegen::executable_memory::Memory;
use crate::codegen::loop_distribution;
use crate::codegen::outline::Lengths;
use crate::ir::Func;
use crate::ir::verify::{Stage, verify};
use abi::table::{Entry, Machine, Prepared};
use abi::{Function, Layout};
use cranelift_module::Module;
use std::sync::Arc;

pub use super::unsupported::Unsupported;

/// Size of the code made.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Stats {
    /// For each function, in the order given: which, its operations, its bytes.
    pub functions: Vec<(Function, usize, usize)>,
}

/// Makes machine code of functions that work on blocks of this layout with a pool of this length.
///
/// # Panics
/// If a function is not sound or not expanded: a mistake of the passes before.
pub fn compile(funcs: &[(Function, Func)], layout: &Layout, pool_len: usize) -> Result<(Machine, Stats), Unsupported> {
    cut_at(funcs, layout, pool_len, Lengths::USUAL, false)
}

/// The same for whoever makes single steps and has room behind the block for what they find
/// [prepared](abi::table::Prepared): an [`Instance`](abi::Instance).
///
/// # Panics
/// As `compile`.
pub fn compile_prepared(
    funcs: &[(Function, Func)],
    layout: &Layout,
    pool_len: usize,
) -> Result<(Machine, Stats), Unsupported> {
    cut_at(funcs, layout, pool_len, Lengths::USUAL, true)
}

/// The same, with functions cut into pieces of these lengths.
pub(super) fn cut_at(
    funcs: &[(Function, Func)],
    layout: &Layout,
    pool_len: usize,
    lengths: Lengths,
    prepares: bool,
) -> Result<(Machine, Stats), Unsupported> {
    let (entries, prepared, memory, stats) = generate(funcs, layout, pool_len, lengths, prepares)?;
    // SAFETY: the entries live as long as `memory`; `verify` has checked that every slot lies in the layout and
    // every table in the pool, the index of a table is held inside it, and code without calls does not unwind.
    let machine = unsafe { Machine::new(entries, layout.size(), pool_len, Arc::new(memory)) };
    let machine = match prepared {
        // SAFETY: it is the step again, from the same memory; what it accesses behind the block is counted.
        Some(prepared) => unsafe { machine.with_prepared(prepared) },
        None => machine,
    };
    // A step in pieces goes ahead no faster: its instants would be one long line again.
    let step = funcs.iter().find(|(function, func)| *function == Function::Step && func.ops.len() <= lengths.whole);
    let machine = match step.and_then(|(_, step)| loop_distribution::compile(step, layout, pool_len)) {
        // SAFETY: it is the step again, in two parts.
        Some(ahead) => unsafe { machine.with_ahead(ahead) },
        None => machine,
    };
    Ok((machine, stats))
}

type Entries = [Option<Entry>; Function::ALL.len()];

fn generate(
    funcs: &[(Function, Func)],
    layout: &Layout,
    pool_len: usize,
    lengths: Lengths,
    prepares: bool,
) -> Result<(Entries, Option<Prepared>, Memory, Stats), Unsupported> {
    let isa = here()?;
    let mut memory = Memory::new(isa);
    let module = memory.module();
    let mut coder = FunctionCompiler::new(isa);
    coder.cut_at(lengths);
    let mut stats = Stats::default();
    let mut ids = Vec::new();
    let mut single = None;
    for (function, func) in funcs {
        verify(func, layout, pool_len, Stage::Expanded).unwrap_or_else(|fault| panic!("{fault}"));
        let failed = |error| Unsupported(format!("no memory for the code of `{}`: {error}", func.name));
        let mut define = |bytes: &Bytes| {
            let id = module.declare_anonymous_function(&signature(&**isa)).map_err(failed)?;
            module.define_function_bytes(id, bytes.alignment as u64, &bytes.code, &[]).map_err(failed)?;
            Ok(id)
        };
        let prepared = if prepares && *function == Function::Step { coder.prepared(func, layout)? } else { None };
        let (id, at, len) = match prepared {
            Some(prepared) => {
                let id = define(&prepared.bytes)?;
                let prepare = prepared.prepare.as_ref().map(&mut define).transpose()?;
                single = Some((id, prepare, prepared.len));
                (id, prepared.many, prepared.bytes.code.len())
            }
            None => {
                let bytes = coder.function(func)?;
                (define(&bytes)?, 0, bytes.code.len())
            }
        };
        stats.functions.push((*function, func.ops.len(), len));
        ids.push((*function, id, at));
    }
    let failed = |error| Unsupported(format!("the code cannot be made executable: {error}"));
    module.finalize_definitions().map_err(failed)?;
    let entry = |id, at: usize| {
        let address = module.get_finalized_function(id).wrapping_add(at);
        // SAFETY: `address` is the beginning of code that was compiled with the signature of `Entry`.
        unsafe { std::mem::transmute::<*const u8, Entry>(address) }
    };
    let mut entries = [None; Function::ALL.len()];
    ids.into_iter().for_each(|(function, id, at)| entries[function as usize] = Some(entry(id, at)));
    let prepared = single.map(|(step, prepare, len)| Prepared {
        prepare: prepare.map(|id| entry(id, 0)),
        step: entry(step, 0),
        len,
    });
    Ok((entries, prepared, memory, stats))
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;
    use crate::ir::build::Build;
    use abi::Slot;

    /// Ranges of this process's memory whose permissions are these.
    fn mapped(permissions: &str) -> Vec<std::ops::Range<usize>> {
        let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
        let range = |line: &str| {
            let mut words = line.split_whitespace();
            let (from, to) = words.next()?.split_once('-')?;
            let parse = |hex| usize::from_str_radix(hex, 16).unwrap();
            (words.next()? == permissions).then(|| parse(from)..parse(to))
        };
        maps.lines().filter_map(range).collect()
    }

    /// Makes code and gives it back; whether it is nowhere then. Tests beside this one may get the same memory for theirs.
    fn is_given_back() -> bool {
        let layout = Layout::new([0, 0, 1, 0, 0, 0, 0, 0, 0, 0]);
        let mut build = Build::new("f");
        let x = build.load(Slot(3));
        let next = build.add(x, x);
        build.store(Slot(3), next);
        let (entries, _, memory, stats) =
            generate(&[(Function::Step, build.finish())], &layout, 0, Lengths::USUAL, false).unwrap();
        assert_eq!(stats.functions.len(), 1);
        let address = entries[Function::Step as usize].unwrap() as usize;
        let executable = || mapped("r-xp").iter().any(|range| range.contains(&address));
        // SAFETY: these are the entries that `compile` hands over.
        let machine = unsafe { Machine::new(entries, layout.size(), 0, Arc::new(memory)) };
        assert!(executable());
        assert_eq!(mapped("rwxp"), []);
        let clone = machine.clone();
        drop(machine);
        assert!(executable(), "a clone keeps the code");
        drop(clone);
        !executable()
    }

    #[test]
    fn code_is_never_writable_and_is_given_back_with_its_last_clone() {
        assert!((0..20).any(|_| is_given_back()), "nobody needs the code any more");
    }
}
