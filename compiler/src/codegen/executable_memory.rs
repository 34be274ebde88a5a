//! Memory of this process that holds machine code.
//!
//! It is written first and made executable afterwards, never both at once, and is given back when its last owner goes.

use super::target::here;
use super::unsupported::Unsupported;
use crate::codegen::emit::signature;
use cranelift_codegen::isa::OwnedTargetIsa;
use cranelift_jit::{JITBuilder, JITModule};
use cranelift_module::Module;
use std::sync::Mutex;

/// The memory of code.
pub struct Memory(Mutex<Option<JITModule>>);

impl Memory {
    /// For code of this processor, none yet.
    pub fn new(isa: &OwnedTargetIsa) -> Memory {
        let no_calls = Box::new(|call| unreachable!("the code calls nothing, so not {call:?}"));
        Memory(Mutex::new(Some(JITModule::new(JITBuilder::with_isa(isa.clone(), no_calls)))))
    }

    /// Where code is declared and written before it can be executed.
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

/// Code that was made elsewhere, where it can be executed; given back with its last owner.
pub struct Executable {
    _memory: Memory,
    address: usize,
}

impl Executable {
    /// The code, beginning at a multiple of `alignment` bytes.
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

    /// Where it begins.
    pub fn address(&self) -> *const u8 {
        self.address as *const u8
    }
}
