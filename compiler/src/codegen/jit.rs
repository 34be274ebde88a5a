//! Machine code in the memory of this process, for the processor it runs on.
//!
//! In: verified, expanded functions. Out: a [`Machine`]. The memory is written first and then made executable, never
//! both at once, and is freed when the last clone of the code is dropped. The code has no symbols, calls nothing except
//! its own pieces and needs no relocation at run time.

use super::target::{Bytes, FunctionCompiler, here};
use crate::codegen::emit::signature;
use crate::codegen::executable_memory::{Executable, Memory};
use crate::codegen::forms::{Context, Form, Options};
use crate::codegen::lanes::{self, Width};
use crate::codegen::passes;
use crate::ir::Func;
use crate::ir::cfg::{Cfg, Entry as Called, Leading, Rows};
use crate::ir::verify::{Stage, verify};
use abi::distributed_step::{DistributedFollow, DistributedStep, LeadingLoop, RemainingEntry, RemainingFollowEntry};
use abi::follow::{Follow, FollowEntry};
use abi::table::{Entry, Machine, Prepared};
use abi::{Function, Layout, Slot};
use cranelift_module::Module;
use std::sync::Arc;

pub use super::unsupported::Unsupported;

/// Size of the compiled code.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Stats {
    /// For each function, in the given order: the function, its number of operations, its number of bytes.
    pub functions: Vec<(Function, usize, usize)>,
}

/// Compiles functions that work on blocks of this layout and a pool of `pool_len` doubles.
///
/// # Panics
/// If a function does not verify or is not expanded: a mistake of an earlier pass.
pub fn compile(funcs: &[(Function, Func)], layout: &Layout, pool_len: usize) -> Result<(Machine, Stats), Unsupported> {
    compile_with(funcs, layout, pool_len, &Options::default(), false)
}

/// Compiles as [`compile`] does, and also a single step with [hoisted parameter expressions](abi::table::Prepared). For
/// callers that reserve room for those after the block, as [`Instance`](abi::Instance) does.
///
/// # Panics
/// As `compile`.
pub fn compile_prepared(
    funcs: &[(Function, Func)],
    layout: &Layout,
    pool_len: usize,
) -> Result<(Machine, Stats), Unsupported> {
    compile_with(funcs, layout, pool_len, &Options::default(), true)
}

/// Compiles with given settings; `prepares`: also a single step with hoisted parameter expressions.
///
/// # Panics
/// As `compile`.
pub fn compile_with(
    funcs: &[(Function, Func)],
    layout: &Layout,
    pool_len: usize,
    options: &Options,
    prepares: bool,
) -> Result<(Machine, Stats), Unsupported> {
    let (entries, prepared, memory, stats) = generate(funcs, layout, pool_len, options, prepares)?;
    // SAFETY: the entries live as long as `memory`; `verify` has checked that every slot lies in the layout and every
    // table in the pool, table indices are clamped to the table, and code without calls does not unwind.
    let machine = unsafe { Machine::new(entries, layout.size(), pool_len, Arc::new(memory)) };
    let machine = match prepared {
        // SAFETY: it is the same step, from the same memory; `len` counts what it accesses after the block.
        Some(prepared) => unsafe { machine.with_prepared(prepared) },
        None => machine,
    };
    // Loop distribution does not pay for an outlined step: its leading loop would again be one long straight line.
    let step = funcs
        .iter()
        .find(|(function, func)| *function == Function::Step && func.ops.len() <= options.lengths.max_function);
    let machine = match step.and_then(|(_, step)| distributed(step, layout, pool_len, options)) {
        // SAFETY: it is the same step, distributed over two loops.
        Some(ahead) => unsafe { machine.with_distributed(ahead) },
        None => machine,
    };
    Ok((machine, stats))
}

/// Compiles a distributed step; none if distribution does not pay or this processor has no lanes. The lanes of the leading
/// loop are successive instants of time.
fn distributed(step: &Func, layout: &Layout, pool_len: usize, options: &Options) -> Option<DistributedStep> {
    let graph = passes::run(step, Form::Distributed, Called::Several, &Context { layout: Some(layout), options });
    let leading = leading(graph.leading.as_ref()?, pool_len)?;
    let (entry, executable) = remaining(step, &graph, &leading)?;
    // SAFETY: `entry` is the start of code with the signature of `RemainingEntry`.
    let entry = unsafe { std::mem::transmute::<*const u8, RemainingEntry>(entry) };
    // SAFETY: the entry lives as long as its memory; `loop_distribution` keeps every access to block and pool as it was in
    // the step, which is verified, and loads one output of the leading loop for each of its values; code without calls does
    // not unwind.
    unsafe { DistributedStep::new(leading, entry, executable) }
}

/// Compiles a leading loop for the widest vectors that have its instructions.
fn leading(leading: &Leading, pool_len: usize) -> Option<LeadingLoop> {
    let Leading { invariants, instants, layout, loads, columns, .. } = leading;
    let reads = instants.loads();
    let (once, instants) = Width::here_all().find_map(|width| {
        let lanes = |func: &Func| lanes::compile(func, layout, pool_len, width, width.vectors()).ok();
        let instants = lanes(instants)?;
        match invariants {
            Some(invariants) => Some((Some(lanes(invariants)?), instants)),
            None => Some((None, instants)),
        }
    })?;
    let is_timed = [Slot::TIME, Slot::COUNT].iter().any(|slot| reads.contains(slot));
    Some(LeadingLoop {
        once,
        instants,
        layout: layout.clone(),
        loads: loads.clone(),
        columns: columns.clone(),
        is_timed,
    })
}

/// Compiles the remaining loop that goes with a leading one; returns the address of its entry, and its memory.
fn remaining(step: &Func, graph: &Cfg, leading: &LeadingLoop) -> Option<(*const u8, Arc<Executable>)> {
    let mut compiler = FunctionCompiler::new(here().ok()?);
    let bytes = compiler.remaining_loop(step, graph, leading.instants.width()).ok()?;
    let executable = Executable::new(&bytes.code, bytes.alignment as u64).ok()?;
    Some((executable.address(), Arc::new(executable)))
}

/// Compiles the loop of a fixed step over rows of inputs and outputs.
///
/// # Errors
/// If there is no machine code for this processor, or the step is too long.
///
/// # Panics
/// As [`compile`], and as [`Follow::new`].
pub fn follow(
    step: &Func,
    layout: &Layout,
    pool_len: usize,
    inputs: &[Slot],
    outputs: &[Slot],
) -> Result<Follow, Unsupported> {
    verify(step, layout, pool_len, Stage::Expanded).unwrap_or_else(|fault| panic!("{fault}"));
    let follow = Follow::new(layout, inputs, outputs);
    let rows = Rows { inputs: inputs.to_vec(), outputs: outputs.to_vec() };
    let bytes = FunctionCompiler::new(here()?).on_rows(step, rows.clone())?;
    let executable = Executable::new(&bytes.code, bytes.alignment as u64)?;
    // SAFETY: `address` is the start of code with the signature of `FollowEntry`.
    let entry = unsafe { std::mem::transmute::<*const u8, FollowEntry>(executable.address()) };
    // SAFETY: the entry lives as long as its memory; every access to block and pool is that of the step, which is verified,
    // and `form_loop` makes one column for each input and output; code without calls does not unwind.
    let follow = unsafe { follow.with_code(entry, layout.size(), pool_len, Arc::new(executable)) };
    let options = Options::default();
    let context = Context { layout: Some(layout), options: &options };
    let graph = passes::run_on_rows(step, rows, Form::Distributed, &context);
    let ahead = graph.leading.as_ref().and_then(|found| {
        let leading = leading(found, pool_len)?;
        let (entry, executable) = remaining(step, &graph, &leading)?;
        // SAFETY: `entry` is the start of code with the signature of `RemainingFollowEntry`.
        let entry = unsafe { std::mem::transmute::<*const u8, RemainingFollowEntry>(entry) };
        // SAFETY: as for the step.
        Some((unsafe { DistributedFollow::new(leading, entry) }?, executable))
    });
    Ok(match ahead {
        // SAFETY: it is the same loop, and lives as long as its memory.
        Some((ahead, memory)) => unsafe { follow.with_distributed(ahead, memory) },
        None => follow,
    })
}

type Entries = [Option<Entry>; Function::ALL.len()];

fn generate(
    funcs: &[(Function, Func)],
    layout: &Layout,
    pool_len: usize,
    options: &Options,
    prepares: bool,
) -> Result<(Entries, Option<Prepared>, Memory, Stats), Unsupported> {
    let isa = here()?;
    let mut memory = Memory::new(isa);
    let module = memory.module();
    let mut compiler = FunctionCompiler::new(isa);
    compiler.set_options(options);
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
        let prepared = if prepares && *function == Function::Step { compiler.prepared(func, layout)? } else { None };
        let (id, at, len) = match prepared {
            Some(prepared) => {
                let id = define(&prepared.bytes)?;
                let prepare = prepared.prepare.as_ref().map(&mut define).transpose()?;
                single = Some((id, prepare, prepared.len));
                (id, prepared.loop_offset, prepared.bytes.code.len())
            }
            None => {
                let bytes = compiler.function(func)?;
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
        // SAFETY: `address` is the start of code that was compiled with the signature of `Entry`.
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

    /// Address ranges of this process with the given permissions.
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

    /// Compiles code and drops it; returns whether its memory is no longer executable then. Tests that run at the same
    /// time may have mapped the same address again.
    fn is_freed() -> bool {
        let layout = Layout::new([0, 0, 1, 0, 0, 0, 0, 0, 0, 0]);
        let mut build = Build::new("f");
        let x = build.load(Slot(3));
        let next = build.add(x, x);
        build.store(Slot(3), next);
        let (entries, _, memory, stats) =
            generate(&[(Function::Step, build.finish())], &layout, 0, &Options::default(), false).unwrap();
        assert_eq!(stats.functions.len(), 1);
        let address = entries[Function::Step as usize].unwrap() as usize;
        let executable = || mapped("r-xp").iter().any(|range| range.contains(&address));
        // SAFETY: these are the entries that `compile` would pass.
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
    fn code_is_never_writable_and_executable_and_is_freed_with_its_last_clone() {
        assert!((0..20).any(|_| is_freed()), "nobody needs the code any more");
    }
}
