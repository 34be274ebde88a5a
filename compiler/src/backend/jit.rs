//! Machine code in memory, made for the processor it runs on.
//!
//! The memory is written first and made executable afterwards, never both at once, and is given back when the last
//! clone of the code goes. The code has no symbols, calls nothing and needs no relocation.

use super::clif;
use crate::ir::Func;
use crate::ir::verify::{Stage, verify};
use abi::table::{Entry, Machine};
use abi::{Function, Layout};
use cranelift_codegen::isa::OwnedTargetIsa;
use cranelift_codegen::settings::{Configurable, Flags, builder};
use cranelift_codegen::{CodegenError, Context};
use cranelift_frontend::FunctionBuilderContext;
use cranelift_jit::{JITBuilder, JITModule};
use cranelift_module::Module;
use std::fmt;
use std::sync::{Arc, Mutex, OnceLock};

/// Why there is no machine code: run the interpreter, and say so.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Unsupported(pub String);

impl fmt::Display for Unsupported {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Unsupported {}

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
    let (entries, memory, stats) = generate(funcs, layout, pool_len)?;
    // SAFETY: the entries live as long as `memory`; `verify` has checked that every slot lies in the layout and
    // every table in the pool, the index of a table is held inside it, and code without calls does not unwind.
    let machine = unsafe { Machine::new(entries, layout.size(), pool_len, Arc::new(memory)) };
    Ok((machine, stats))
}

type Entries = [Option<Entry>; Function::ALL.len()];

fn generate(
    funcs: &[(Function, Func)],
    layout: &Layout,
    pool_len: usize,
) -> Result<(Entries, Memory, Stats), Unsupported> {
    let mut memory = Memory::new(processor(Effort::Speed)?);
    let module = memory.module();
    let mut context = Context::new();
    let mut builder = FunctionBuilderContext::new();
    let mut stats = Stats::default();
    let mut ids = Vec::new();
    for (function, func) in funcs {
        verify(func, layout, pool_len, Stage::Expanded).unwrap_or_else(|fault| panic!("{fault}"));
        // Cranelift's own passes make one value of equal constants and compute where the result is used: in a function
        // of a thousand operations this fills the registers, and what does not fit goes through memory.
        let isa = processor(if *function == Function::Rosenbrock { Effort::Order } else { Effort::Speed })?;
        context.clear();
        clif::emit(func, &mut context.func, &mut builder, &**isa);
        let compiled = context.compile(&**isa, &mut Default::default()).map_err(|error| refused(func, &error.inner))?;
        assert!(compiled.buffer.relocs().is_empty(), "{} needs relocations", func.name);
        let failed = |error| Unsupported(format!("no memory for the code of `{}`: {error}", func.name));
        let id = module.declare_anonymous_function(&clif::signature(&**isa)).map_err(failed)?;
        let (code, alignment) = (compiled.code_buffer(), u64::from(compiled.buffer.alignment));
        module.define_function_bytes(id, alignment, code, &[]).map_err(failed)?;
        stats.functions.push((*function, func.ops.len(), code.len()));
        ids.push((*function, id));
    }
    let failed = |error| Unsupported(format!("the code cannot be made executable: {error}"));
    module.finalize_definitions().map_err(failed)?;
    let mut entries = [None; Function::ALL.len()];
    for (function, id) in ids {
        let address = module.get_finalized_function(id);
        // SAFETY: `address` is the beginning of code that was compiled with the signature of `Entry`.
        entries[function as usize] = Some(unsafe { std::mem::transmute::<*const u8, Entry>(address) });
    }
    Ok((entries, memory, stats))
}

fn refused(func: &Func, error: &CodegenError) -> Unsupported {
    let ops = func.ops.len();
    match error {
        CodegenError::CodeTooLarge | CodegenError::ImplLimitExceeded => {
            Unsupported(format!("`{}` is too large for machine code: {ops} operations", func.name))
        }
        error => Unsupported(format!("no machine code for `{}` of {ops} operations: {error}", func.name)),
    }
}

/// What Cranelift does with the order of operations.
#[derive(Clone, Copy)]
enum Effort {
    /// Shares, hoists, and sinks them to their use.
    Speed,
    /// Keeps it.
    Order,
}

/// What to generate for: this processor.
fn processor(effort: Effort) -> Result<&'static OwnedTargetIsa, Unsupported> {
    static ISA: [OnceLock<Result<OwnedTargetIsa, Unsupported>>; 2] = [const { OnceLock::new() }; 2];
    let (isa, level) = match effort {
        Effort::Speed => (&ISA[0], "speed"),
        Effort::Order => (&ISA[1], "none"),
    };
    isa.get_or_init(|| {
        if let Some(lacks) = lacking() {
            return Err(Unsupported(format!("this processor lacks {lacks}")));
        }
        let mut flags = builder();
        for (flag, setting) in [
            ("opt_level", level),
            ("is_pic", "false"),
            // A frame larger than a page is touched page by page, in line.
            ("enable_probestack", "true"),
            ("probestack_strategy", "inline"),
            ("unwind_info", "false"),
            ("enable_verifier", if cfg!(debug_assertions) { "true" } else { "false" }),
        ] {
            flags.set(flag, setting).expect("a flag of this version");
        }
        let native = cranelift_native::builder().map_err(|what| Unsupported(what.into()))?;
        native.finish(Flags::new(flags)).map_err(|what| Unsupported(what.to_string()))
    })
    .as_ref()
    .map_err(Clone::clone)
}

/// Instructions that are needed and not there. Without them fma, floor and nearest would be calls.
fn lacking() -> Option<&'static str> {
    #[cfg(target_arch = "x86_64")]
    for (there, name) in [
        (std::arch::is_x86_feature_detected!("fma"), "fused multiply-add (FMA)"),
        (std::arch::is_x86_feature_detected!("sse4.1"), "rounding (SSE4.1)"),
    ] {
        if !there {
            return Some(name);
        }
    }
    None
}

/// The memory of the code.
struct Memory(Mutex<Option<JITModule>>);

impl Memory {
    fn new(isa: &OwnedTargetIsa) -> Memory {
        let no_calls = Box::new(|call| unreachable!("the code calls nothing, so not {call:?}"));
        Memory(Mutex::new(Some(JITModule::new(JITBuilder::with_isa(isa.clone(), no_calls)))))
    }

    fn module(&mut self) -> &mut JITModule {
        self.0.get_mut().expect("nothing panics here").as_mut().expect("taken by drop only")
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        let module = self.0.get_mut().ok().and_then(Option::take);
        if let Some(module) = module {
            // SAFETY: this is the last owner: `Machine` keeps it alive as long as an entry can be called.
            unsafe { module.free_memory() }
        }
    }
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

    #[test]
    fn code_is_never_writable_and_is_given_back_with_its_last_clone() {
        let layout = Layout::new([0, 0, 1, 0, 0, 0, 0, 0, 0, 0]);
        let mut build = Build::new("f");
        let x = build.load(Slot(3));
        let next = build.add(x, x);
        build.store(Slot(3), next);
        let (entries, memory, stats) = generate(&[(Function::Step, build.finish())], &layout, 0).unwrap();
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
        assert!(!executable(), "nobody needs the code any more");
    }
}
