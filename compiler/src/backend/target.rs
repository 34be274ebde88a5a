//! What processor code is made for, and the code of one function for it.
//!
//! In: a sound, expanded function. Out: bytes that can lie anywhere: no symbols, no calls, no relocation.

use super::clif;
use crate::ir::Func;
use abi::image::{Feature, Target};
use cranelift_codegen::isa::{self, OwnedTargetIsa, TargetIsa};
use cranelift_codegen::settings::{Configurable, Flags, builder};
use cranelift_codegen::{CodegenError, Context};
use cranelift_frontend::FunctionBuilderContext;
use std::fmt;
use std::sync::OnceLock;

/// Why there is no machine code: run the interpreter, and say so.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Unsupported(pub String);

impl fmt::Display for Unsupported {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Unsupported {}

/// Makes code, function by function; what it needs on the way is kept for the next.
pub struct Coder<'a> {
    isa: &'a dyn TargetIsa,
    context: Context,
    builder: FunctionBuilderContext,
}

/// Code of a function, and the power of two at a multiple of which it must begin.
pub struct Bytes {
    /// The instructions, and constants behind them.
    pub code: Vec<u8>,
    /// In bytes.
    pub alignment: usize,
}

impl<'a> Coder<'a> {
    /// For this processor or target.
    pub fn new(isa: &'a OwnedTargetIsa) -> Coder<'a> {
        Coder { isa: &**isa, context: Context::new(), builder: FunctionBuilderContext::new() }
    }

    /// The code of a function with the signature of [`abi::table::Entry`].
    ///
    /// # Panics
    /// If the code needs a relocation: a mistake of `clif`.
    pub fn function(&mut self, func: &Func) -> Result<Bytes, Unsupported> {
        self.emit(func);
        let Coder { isa, context, .. } = self;
        let compiled = context.compile(*isa, &mut Default::default()).map_err(|error| refused(func, &error.inner))?;
        assert!(compiled.buffer.relocs().is_empty(), "{} needs relocations", func.name);
        Ok(Bytes { code: compiled.code_buffer().to_vec(), alignment: compiled.buffer.alignment as usize })
    }

    /// The function as Cranelift's own IR.
    pub fn clif(&mut self, func: &Func) -> String {
        self.emit(func);
        self.context.func.display().to_string()
    }

    /// The function as assembly, as Cranelift writes it.
    pub fn assembly(&mut self, func: &Func) -> Result<String, Unsupported> {
        self.emit(func);
        self.context.set_disasm(true);
        let Coder { isa, context, .. } = self;
        let compiled = context.compile(*isa, &mut Default::default()).map_err(|error| refused(func, &error.inner))?;
        let text = compiled.vcode.clone().unwrap_or_default();
        self.context.set_disasm(false);
        Ok(text)
    }

    fn emit(&mut self, func: &Func) {
        self.context.clear();
        clif::emit(func, &mut self.context.func, &mut self.builder, self.isa);
    }
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

/// The processor this program runs on, with all it has.
pub fn here() -> Result<&'static OwnedTargetIsa, Unsupported> {
    static ISA: OnceLock<Result<OwnedTargetIsa, Unsupported>> = OnceLock::new();
    ISA.get_or_init(|| native("speed")).as_ref().map_err(Clone::clone)
}

/// The same for functions of many hundred operations, which it keeps in their order. Else Cranelift makes one value of
/// equal constants and computes things where their result is used: this fills the registers, and what does not fit goes
/// through memory.
pub fn in_order() -> Result<&'static OwnedTargetIsa, Unsupported> {
    static ISA: OnceLock<Result<OwnedTargetIsa, Unsupported>> = OnceLock::new();
    ISA.get_or_init(|| native("none")).as_ref().map_err(Clone::clone)
}

fn native(level: &str) -> Result<OwnedTargetIsa, Unsupported> {
    // Without them fma, floor and nearest would be calls.
    #[cfg(target_arch = "x86_64")]
    for feature in [Feature::Fma, Feature::Sse41] {
        if !feature.here() {
            return Err(Unsupported(format!("this processor lacks {}", feature.name())));
        }
    }
    let native = cranelift_native::builder().map_err(|what| Unsupported(what.into()))?;
    native.finish(flags(level)).map_err(|what| Unsupported(what.to_string()))
}

/// A target, with nothing but what it [needs](Target::needs).
pub fn of(target: Target) -> &'static OwnedTargetIsa {
    static X86_64: OnceLock<OwnedTargetIsa> = OnceLock::new();
    static AARCH64: OnceLock<OwnedTargetIsa> = OnceLock::new();
    let isa = match target {
        Target::X86_64 => &X86_64,
        Target::Aarch64 => &AARCH64,
    };
    isa.get_or_init(|| with(target, &[]))
}

/// A target with more than it needs.
pub fn with(target: Target, more: &[Feature]) -> OwnedTargetIsa {
    let triple = match target {
        Target::X86_64 => "x86_64-unknown-linux-gnu",
        Target::Aarch64 => "aarch64-unknown-linux-gnu",
    };
    let mut isa = isa::lookup_by_name(triple).expect("the back end is compiled in");
    for feature in target.needs().iter().chain(more) {
        let flag = match feature {
            Feature::Sse3 => "has_sse3",
            Feature::Ssse3 => "has_ssse3",
            Feature::Sse41 => "has_sse41",
            Feature::Sse42 => "has_sse42",
            Feature::Avx => "has_avx",
            Feature::Fma => "has_fma",
            Feature::Avx2 => "has_avx2",
            Feature::Bmi1 => "has_bmi1",
            Feature::Bmi2 => "has_bmi2",
            Feature::Lzcnt => "has_lzcnt",
            Feature::Popcnt => "has_popcnt",
        };
        isa.enable(flag).expect("a flag of this version");
    }
    isa.finish(flags("speed")).expect("flags that fit together")
}

fn flags(level: &str) -> Flags {
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
    Flags::new(flags)
}
