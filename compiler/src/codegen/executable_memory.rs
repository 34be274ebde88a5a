//! Memory of this process for machine code.
//!
//! In: bytes. Out: their executable address. The memory is written first and then made executable, never both at once,
//! and is freed when its last owner is dropped.

use super::target::here;
use super::unsupported::Unsupported;
use crate::codegen::emit::signature;
use cranelift_codegen::isa::OwnedTargetIsa;
use cranelift_jit::{JITBuilder, JITModule};
use cranelift_module::Module;
use std::sync::Mutex;

/// Memory for machine code, freed on drop.
pub struct Memory(Mutex<Option<JITModule>>);

impl Memory {
    /// Empty memory for code of this processor.
    pub fn new(isa: &OwnedTargetIsa) -> Memory {
        let no_calls = Box::new(|call| unreachable!("the code calls nothing, so not {call:?}"));
        Memory(Mutex::new(Some(JITModule::new(JITBuilder::with_isa(isa.clone(), no_calls)))))
    }

    /// The Cranelift module to which functions are added before they become executable.
    pub fn module(&mut self) -> &mut JITModule {
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

/// Executable code that was generated without Cranelift's module; freed on drop.
pub struct Executable {
    _memory: Memory,
    address: usize,
}

impl Executable {
    /// Makes code executable, at a multiple of `alignment` bytes.
    pub fn new(code: &[u8], alignment: u64) -> Result<Executable, Unsupported> {
        let isa = here()?;
        let mut memory = Memory::new(isa);
        let module = memory.module();
        let failed = |error: cranelift_module::ModuleError| Unsupported(format!("no memory for code: {error}"));
        let id = module.declare_anonymous_function(&signature(&**isa)).map_err(failed)?;
        module.define_function_bytes(id, alignment, code, &[]).map_err(failed)?;
        module.finalize_definitions().map_err(failed)?;
        let address = module.get_finalized_function(id) as usize;
        Ok(Executable { _memory: memory, address })
    }

    /// The start of the code.
    pub fn address(&self) -> *const u8 {
        self.address as *const u8
    }
}
