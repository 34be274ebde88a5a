//! What processor code is made for, and the code of one function for it.
//!
//! In: a sound, expanded function. Out: bytes that can lie anywhere: no symbols, no calls but of its own pieces, no
//! relocation left.

use super::unsupported::Unsupported;
use crate::codegen::emit::{self, Facts};
use crate::codegen::emit_f64x2;
use crate::codegen::emit_outlined;
use crate::codegen::hoist_params::Hoisted;
use crate::codegen::outline::{Lengths, cut};
use crate::ir::Func;
use crate::ir::build::prune;
use abi::image::{Feature, Target};
use abi::{Layout, Slot};
use cranelift_codegen::binemit::Reloc;
use cranelift_codegen::ir::{self as cranelift, ExternalName};
use cranelift_codegen::isa::{self, OwnedTargetIsa, TargetIsa};
use cranelift_codegen::settings::{Configurable, Flags, builder};
use cranelift_codegen::{CodegenError, Context, FinalizedMachReloc, FinalizedRelocTarget};
use cranelift_frontend::FunctionBuilderContext;
use std::sync::OnceLock;

/// Makes code, function by function; what it needs on the way is kept for the next.
pub struct FunctionCompiler<'a> {
    isa: &'a dyn TargetIsa,
    context: Context,
    builder: FunctionBuilderContext,
    lengths: Lengths,
}

/// Code of a function, and the power of two at a multiple of which it must begin.
pub struct Bytes {
    /// The instructions, and constants behind them.
    pub code: Vec<u8>,
    /// In bytes.
    pub alignment: usize,
}

/// Code of a function that begins with what makes one iteration, where what can be is [prepared](Coder::prepared).
pub struct PreparedBytes {
    /// Of the whole.
    pub bytes: Bytes,
    /// At which byte what makes any number of iterations begins, which needs nothing prepared.
    pub many: usize,
    /// What prepares, if there is anything to.
    pub prepare: Option<Bytes>,
    /// How many numbers lie behind the block.
    pub len: usize,
}

/// The code of a function, of one or several parts.
struct Parts {
    all: Bytes,
    /// At which byte what makes any number of iterations begins.
    many: usize,
}

impl<'a> FunctionCompiler<'a> {
    /// For this processor or target.
    pub fn new(isa: &'a OwnedTargetIsa) -> FunctionCompiler<'a> {
        FunctionCompiler {
            isa: &**isa,
            context: Context::new(),
            builder: FunctionBuilderContext::new(),
            lengths: Lengths::USUAL,
        }
    }

    /// Other lengths of functions and pieces than the usual.
    pub(super) fn cut_at(&mut self, lengths: Lengths) {
        self.lengths = lengths;
    }

    /// The code of a function with the signature of [`abi::table::Entry`], which is its beginning.
    ///
    /// # Panics
    /// If the code calls anything but its own pieces: a mistake of `clif`.
    pub fn function(&mut self, func: &Func) -> Result<Bytes, Unsupported> {
        let single = self.single(func);
        Ok(self.parts(func, single.as_ref(), true)?.all)
    }

    /// The code of a function on blocks of this layout whose single iterations find prepared what hangs on parameters and
    /// the length of the step alone; none where single iterations have no code of their own.
    pub fn prepared(&mut self, func: &Func, layout: &Layout) -> Result<Option<PreparedBytes>, Unsupported> {
        let Some(single) = self.single(func) else { return Ok(None) };
        let Hoisted { prepare, step } = Hoisted::of(&single, layout);
        let len = prepare.stores.len();
        let Parts { all: bytes, many } = self.parts(func, Some(&step), false)?;
        let prepare = if len > 0 { Some(self.plain(&prepare, None)?) } else { None };
        Ok(Some(PreparedBytes { bytes, many, prepare, len }))
    }

    /// The code of a function for any number of iterations, in one piece, as Cranelift makes it.
    fn plain(&mut self, func: &Func, ahead: Option<emit::Distributed>) -> Result<Bytes, Unsupported> {
        self.context.clear();
        emit::emit(func, ahead, &mut self.context.func, &mut self.builder, self.isa);
        self.bytes(func)
    }

    /// All parts of the code of a function: of one iteration, if that has code of its own, and of any number. If it `asks`, that
    /// of one iteration leaves all other counts to the other.
    fn parts(&mut self, func: &Func, single: Option<&Func>, asks: bool) -> Result<Parts, Unsupported> {
        let mut all = Bytes { code: Vec::new(), alignment: 1 };
        let mut begins: Vec<usize> = Vec::new();
        let mut calls: Vec<(usize, Call)> = Vec::new();
        self.each_part(func, single, asks, |_, isa, context| {
            let compiled =
                context.compile(isa, &mut Default::default()).map_err(|error| refused(func, &error.inner))?;
            let alignment = compiled.buffer.alignment as usize;
            all.alignment = all.alignment.max(alignment);
            all.code.resize(all.code.len().next_multiple_of(alignment), 0);
            let begin = all.code.len();
            begins.push(begin);
            all.code.extend(compiled.code_buffer());
            let relocations = compiled.buffer.relocs().to_vec();
            for relocation in relocations {
                let call = Call::of(&relocation, &context.func)
                    .unwrap_or_else(|| panic!("{} needs a relocation: {relocation:?}", func.name));
                calls.push((begin + relocation.offset as usize, call));
            }
            Ok(())
        })?;
        for (at, call) in calls {
            // What calls lies first.
            call.resolve(&mut all.code, at, begins[call.piece + 1]).ok_or_else(|| too_large(func))?;
        }
        Ok(Parts { all, many: if single.is_some() { begins[1] } else { 0 } })
    }

    /// The same with the signature of [`abi::ahead::RestEntry`]: what it loads from slots behind the `size` of a block are
    /// numbers that `lanes` steps have each its own of.
    pub fn rest(&mut self, func: &Func, size: usize, lanes: usize) -> Result<Bytes, Unsupported> {
        self.plain(func, Some(emit::Distributed { first: Slot(size as u32), lanes }))
    }

    /// The code of a function for lanes, and the numbers it needs behind the blocks.
    pub fn pairs(&mut self, func: &Func, layout: &Layout, vectors: usize) -> Result<(Bytes, usize), Unsupported> {
        self.context.clear();
        let scratch = emit_f64x2::emit(func, layout, vectors, &mut self.context.func, &mut self.builder, self.isa)?;
        Ok((self.bytes(func)?, scratch))
    }

    /// Of what was just written and calls nothing.
    fn bytes(&mut self, func: &Func) -> Result<Bytes, Unsupported> {
        let FunctionCompiler { isa, context, .. } = self;
        let compiled = context.compile(*isa, &mut Default::default()).map_err(|error| refused(func, &error.inner))?;
        assert!(compiled.buffer.relocs().is_empty(), "{} needs relocations", func.name);
        Ok(Bytes { code: compiled.code_buffer().to_vec(), alignment: compiled.buffer.alignment as usize })
    }

    /// The function as Cranelift's own IR.
    pub fn clif(&mut self, func: &Func) -> Result<String, Unsupported> {
        let (single, mut text) = (self.single(func), String::new());
        self.each_part(func, single.as_ref(), true, |what, _, context| {
            text += &what;
            text += &context.func.display().to_string();
            Ok(())
        })?;
        Ok(text)
    }

    /// The function as assembly, as Cranelift writes it.
    pub fn assembly(&mut self, func: &Func) -> Result<String, Unsupported> {
        let (single, mut text) = (self.single(func), String::new());
        self.each_part(func, single.as_ref(), true, |what, isa, context| {
            context.set_disasm(true);
            let compiled = context.compile(isa, &mut Default::default());
            text += &what;
            text += compiled.map_err(|error| refused(func, &error.inner))?.vcode.as_deref().unwrap_or_default();
            Ok(())
        })?;
        Ok(text)
    }

    /// What makes a single iteration of a function, if that has code of its own.
    fn single(&self, func: &Func) -> Option<Func> {
        (func.ops.len() <= self.lengths.whole && emit::has_single(func)).then(|| uncounted(func))
    }

    /// Gives the function as Cranelift's own: whole, after its single iteration if there is one, or cut: then the loop first and
    /// the pieces in their order. Of several parts each has a line that says what it is.
    fn each_part(
        &mut self,
        func: &Func,
        single: Option<&Func>,
        asks: bool,
        mut part: impl FnMut(String, &dyn TargetIsa, &mut Context) -> Result<(), Unsupported>,
    ) -> Result<(), Unsupported> {
        let FunctionCompiler { isa, context, builder, lengths } = self;
        if func.ops.len() <= lengths.whole {
            if let Some(single) = single {
                context.clear();
                emit::emit_single(single, asks, &mut context.func, builder, *isa);
                part(title(ONE), *isa, context)?;
            }
            let several = if single.is_some() { title("any number of iterations") } else { String::new() };
            context.clear();
            emit::emit(func, None, &mut context.func, builder, *isa);
            return part(several, *isa, context);
        }
        let facts = Facts::of(func);
        let cut = cut(func, &facts, *lengths).ok_or_else(|| too_large(func))?;
        context.clear();
        emit_outlined::emit_loop(func, &facts, &cut, &mut context.func, builder, *isa);
        part(title("the loop around its pieces"), *isa, context)?;
        let mut values = Vec::new();
        for number in 0..cut.pieces.len() {
            context.clear();
            emit_outlined::emit_piece(func, &facts, (&cut, number), &mut values, &mut context.func, builder, *isa);
            part(title(&format!("piece {number}")), *isa, context)?;
        }
        Ok(())
    }
}

/// The function for a single iteration, which leaves the count to its caller unless something else takes part in it: see
/// [`abi::table::Entry`].
fn uncounted(func: &Func) -> Func {
    let mut uncounted = func.clone();
    uncounted.stores.retain(|(slot, _)| *slot != Slot::COUNT);
    let uncounted = prune(&uncounted);
    if uncounted.loads().contains(&Slot::COUNT) { func.clone() } else { uncounted }
}

/// A line that says what follows.
fn title(what: &str) -> String {
    format!("; {what}\n")
}

/// What comes first of a function of several parts.
const ONE: &str = "one iteration, or go on to more";

/// A call of a piece.
struct Call {
    kind: Reloc,
    piece: usize,
    addend: i64,
}

impl Call {
    /// The call that a relocation stands for, if it does for one.
    fn of(relocation: &FinalizedMachReloc, func: &cranelift::Function) -> Option<Call> {
        let FinalizedRelocTarget::ExternalName(ExternalName::User(name)) = relocation.target else { return None };
        let piece = func.params.user_named_funcs()[name].index as usize;
        let known = matches!(relocation.kind, Reloc::X86CallPCRel4 | Reloc::Arm64Call);
        known.then_some(Call { kind: relocation.kind, piece, addend: relocation.addend })
    }

    /// Puts the distance from the call at byte `at` to what begins at byte `to` into the code; none if it is too far.
    fn resolve(&self, code: &mut [u8], at: usize, to: usize) -> Option<()> {
        let distance = to as i64 + self.addend - at as i64;
        let field = &mut code[at..at + 4];
        let instruction = u32::from_le_bytes(field.try_into().expect("four bytes"));
        let resolved = match self.kind {
            Reloc::X86CallPCRel4 => i32::try_from(distance).ok()? as u32,
            // 26 bits, in words.
            _ => {
                let words = distance / 4;
                (-(1 << 25)..1 << 25).contains(&words).then_some(())?;
                instruction & !0x03ff_ffff | words as u32 & 0x03ff_ffff
            }
        };
        field.copy_from_slice(&resolved.to_le_bytes());
        Some(())
    }
}

fn too_large(func: &Func) -> Unsupported {
    Unsupported(format!("`{}` is too large for machine code: {} operations", func.name, func.ops.len()))
}

fn refused(func: &Func, error: &CodegenError) -> Unsupported {
    match error {
        CodegenError::CodeTooLarge | CodegenError::ImplLimitExceeded => too_large(func),
        error => Unsupported(format!("no machine code for `{}` of {} operations: {error}", func.name, func.ops.len())),
    }
}

/// The processor this program runs on, with all it has.
pub fn here() -> Result<&'static OwnedTargetIsa, Unsupported> {
    static ISA: OnceLock<Result<OwnedTargetIsa, Unsupported>> = OnceLock::new();
    ISA.get_or_init(native).as_ref().map_err(Clone::clone)
}

fn native() -> Result<OwnedTargetIsa, Unsupported> {
    // Without them fma, floor and nearest would be calls.
    #[cfg(target_arch = "x86_64")]
    for feature in [Feature::Fma, Feature::Sse41] {
        if !feature.here() {
            return Err(Unsupported(format!("this processor lacks {}", feature.name())));
        }
    }
    let native = cranelift_native::builder().map_err(|what| Unsupported(what.into()))?;
    native.finish(flags()).map_err(|what| Unsupported(what.to_string()))
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
    isa.finish(flags()).expect("flags that fit together")
}

fn flags() -> Flags {
    let mut flags = builder();
    for (flag, setting) in [
        // Our own passes have shared, folded and ordered. Else Cranelift makes one value of equal constants and computes
        // things where their result is used: this fills the registers, and what does not fit goes through memory.
        ("opt_level", "none"),
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
