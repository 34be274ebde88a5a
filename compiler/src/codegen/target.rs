//! Compiles one function for one target with Cranelift.
//!
//! In: a verified, expanded function. Out: position-independent bytes: without symbols, without calls except to the
//! function's own pieces, all relocations resolved. It does not know where the bytes will be placed.

use super::unsupported::Unsupported;
use crate::codegen::emit::Emitter;
use crate::codegen::emit_f64x2;
use crate::codegen::form_loop::is_idempotent;
use crate::codegen::forms::{Context as Passes, Form, Options};
use crate::codegen::passes;
use crate::ir::Func;
use crate::ir::cfg::{BlockId, Cfg, Entry, Inst, Rows};
use abi::Layout;
use abi::image::{Feature, Target};
use cranelift_codegen::binemit::Reloc;
use cranelift_codegen::ir::{self as cranelift, ExternalName};
use cranelift_codegen::isa::{self, OwnedTargetIsa, TargetIsa};
use cranelift_codegen::settings::{Configurable, Flags, builder};
use cranelift_codegen::{CodegenError, Context, FinalizedMachReloc, FinalizedRelocTarget};
use cranelift_frontend::FunctionBuilderContext;
use std::sync::OnceLock;

/// Compiles functions one after the other; keeps Cranelift's buffers from one to the next.
pub struct FunctionCompiler<'a> {
    isa: &'a dyn TargetIsa,
    context: Context,
    builder: FunctionBuilderContext,
    options: Options,
}

/// Machine code of a function, and its alignment.
pub struct Bytes {
    /// The instructions, followed by their constants.
    pub code: Vec<u8>,
    /// In bytes, a power of two.
    pub alignment: usize,
}

/// Machine code of a step whose entry runs a single iteration with [hoisted](FunctionCompiler::prepared) parameter
/// expressions.
pub struct PreparedBytes {
    /// The code of all parts.
    pub bytes: Bytes,
    /// Offset in bytes of the entry that runs any number of iterations; it needs no hoisted values.
    pub loop_offset: usize,
    /// Computes the hoisted values; none if there are none.
    pub prepare: Option<Bytes>,
    /// Number of hoisted values, stored after the block.
    pub len: usize,
}

/// The code of a function, linked from one or more parts.
struct Parts {
    all: Bytes,
    /// Offset in bytes of the entry that runs any number of iterations.
    loop_offset: usize,
}

impl<'a> FunctionCompiler<'a> {
    /// A compiler for this processor or target.
    pub fn new(isa: &'a OwnedTargetIsa) -> FunctionCompiler<'a> {
        FunctionCompiler {
            isa: &**isa,
            context: Context::new(),
            builder: FunctionBuilderContext::new(),
            options: Options::default(),
        }
    }

    /// Compiles with other settings than the usual ones.
    pub(super) fn set_options(&mut self, options: &Options) {
        self.options = options.clone();
    }

    /// Compiles a function; its entry, with the signature of [`abi::table::Entry`], is at offset 0.
    ///
    /// # Panics
    /// If the code calls anything except its own pieces: a mistake of `emit`.
    pub fn function(&mut self, func: &Func) -> Result<Bytes, Unsupported> {
        let graphs = self.graphs(func, None)?;
        Ok(self.parts(func, &graphs)?.all)
    }

    /// Compiles a step for single iterations whose expressions of parameters and step length are hoisted, see
    /// `hoist_params`. `layout`: that of the blocks. None if single iterations have no code of their own.
    pub fn prepared(&mut self, func: &Func, layout: &Layout) -> Result<Option<PreparedBytes>, Unsupported> {
        if self.is_long(func) || is_idempotent(func) {
            return Ok(None);
        }
        let graphs = self.graphs(func, Some(layout))?;
        let single = &graphs[0];
        let Parts { all: bytes, loop_offset } = self.parts(func, &graphs)?;
        let (mut prepare, mut len) = (None, 0);
        if let Some(entry) = single.prepare {
            let blocks = single.order(entry);
            let stores = blocks.iter().flat_map(|block| &single.blocks[block.index()].insts);
            len = stores.filter(|inst| matches!(inst, Inst::Store(..))).count();
            prepare = Some(self.entry(func, single, (entry, Entry::Several), 0)?);
        }
        Ok(Some(PreparedBytes { bytes, loop_offset, prepare, len }))
    }

    /// Compiles the remaining loop of a distributed step, with the signature of
    /// [`RemainingEntry`](abi::distributed_step::RemainingEntry), or, if the graph has rows, of
    /// [`RemainingFollowEntry`](abi::distributed_step::RemainingFollowEntry). It reads values that the leading loop has
    /// computed, one for each of `lanes` steps.
    pub fn remaining_loop(&mut self, func: &Func, graph: &Cfg, lanes: usize) -> Result<Bytes, Unsupported> {
        self.entry(func, graph, (BlockId(0), Entry::Several), lanes)
    }

    /// Compiles the loop of a step over rows of inputs and outputs, with the signature of [`abi::follow::FollowEntry`].
    ///
    /// # Errors
    /// If the step is divided into pieces.
    pub fn on_rows(&mut self, func: &Func, rows: Rows) -> Result<Bytes, Unsupported> {
        if self.is_long(func) {
            return Err(Unsupported(format!("`{}` is divided into pieces", func.name)));
        }
        let graph = passes::run_on_rows(func, rows, Form::Loop, &Passes { layout: None, options: &self.options });
        self.entry(func, &graph, (BlockId(0), Entry::Several), 0)
    }

    /// Compiles one function of a graph that calls no pieces.
    fn entry(&mut self, func: &Func, graph: &Cfg, entry: (BlockId, Entry), lanes: usize) -> Result<Bytes, Unsupported> {
        self.context.clear();
        Emitter::new(graph, self.isa, lanes).emit(entry, &mut self.context.func, &mut self.builder);
        self.compile_context(func)
    }

    /// Whether a function is divided into pieces.
    fn is_long(&self, func: &Func) -> bool {
        func.ops.len() > self.options.lengths.max_function
    }

    /// The graphs of a function: that of a single iteration, if it has code of its own, and that of any number.
    fn graphs(&self, func: &Func, layout: Option<&Layout>) -> Result<Vec<Cfg>, Unsupported> {
        let context = Passes { layout, options: &self.options };
        let graph = |form, called| passes::run(func, form, called, &context);
        if self.is_long(func) {
            let long = graph(Form::Long, Entry::Several);
            return if long.pieces.is_empty() { Err(too_large(func)) } else { Ok(vec![long]) };
        }
        if is_idempotent(func) {
            return Ok(vec![graph(Form::Once, Entry::Several)]);
        }
        let called = if layout.is_some() { Entry::Single } else { Entry::SingleOrSeveral };
        Ok(vec![graph(Form::Single, called), graph(Form::Loop, Entry::Several)])
    }

    /// Compiles and links all parts of a function, in the order of its graphs and their pieces.
    fn parts(&mut self, func: &Func, graphs: &[Cfg]) -> Result<Parts, Unsupported> {
        let mut all = Bytes { code: Vec::new(), alignment: 1 };
        let mut begins: Vec<usize> = Vec::new();
        let mut calls: Vec<(usize, Call)> = Vec::new();
        self.each_part(graphs, |_, isa, context| {
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
            // The caller is always the first part.
            call.resolve(&mut all.code, at, begins[call.piece + 1]).ok_or_else(|| too_large(func))?;
        }
        Ok(Parts { all, loop_offset: if graphs.len() > 1 { begins[1] } else { 0 } })
    }

    /// Compiles a function for lanes of two; also returns how many doubles it uses after the blocks.
    pub fn pairs(&mut self, func: &Func, layout: &Layout, vectors: usize) -> Result<(Bytes, usize), Unsupported> {
        self.context.clear();
        let scratch = emit_f64x2::emit(func, layout, vectors, &mut self.context.func, &mut self.builder, self.isa)?;
        Ok((self.compile_context(func)?, scratch))
    }

    /// Compiles the function in the context, which must not contain calls.
    fn compile_context(&mut self, func: &Func) -> Result<Bytes, Unsupported> {
        let FunctionCompiler { isa, context, .. } = self;
        let compiled = context.compile(*isa, &mut Default::default()).map_err(|error| refused(func, &error.inner))?;
        assert!(compiled.buffer.relocs().is_empty(), "{} needs relocations", func.name);
        Ok(Bytes { code: compiled.code_buffer().to_vec(), alignment: compiled.buffer.alignment as usize })
    }

    /// The Cranelift IR of a function.
    pub fn clif(&mut self, func: &Func) -> Result<String, Unsupported> {
        let (graphs, mut text) = (self.graphs(func, None)?, String::new());
        self.each_part(&graphs, |what, _, context| {
            text += &what;
            text += &context.func.display().to_string();
            Ok(())
        })?;
        Ok(text)
    }

    /// The assembly of a function, as Cranelift prints it.
    pub fn assembly(&mut self, func: &Func) -> Result<String, Unsupported> {
        let (graphs, mut text) = (self.graphs(func, None)?, String::new());
        self.each_part(&graphs, |what, isa, context| {
            context.set_disasm(true);
            let compiled = context.compile(isa, &mut Default::default());
            text += &what;
            text += compiled.map_err(|error| refused(func, &error.inner))?.vcode.as_deref().unwrap_or_default();
            Ok(())
        })?;
        Ok(text)
    }

    /// Emits each part of a function as Cranelift IR and passes it to `part`, with a comment line that names it, empty if
    /// there is only one.
    fn each_part(
        &mut self,
        graphs: &[Cfg],
        mut part: impl FnMut(String, &dyn TargetIsa, &mut Context) -> Result<(), Unsupported>,
    ) -> Result<(), Unsupported> {
        let FunctionCompiler { isa, context, builder, .. } = self;
        for graph in graphs {
            let mut emitter = Emitter::new(graph, *isa, 0);
            let entries = graph.entries().filter(|(entry, _)| Some(*entry) != graph.prepare);
            for (number, (entry, called)) in entries.enumerate() {
                let what = match called {
                    Entry::Single | Entry::SingleOrSeveral => title(SINGLE_TITLE),
                    Entry::Several if graphs.len() > 1 => title("any number of iterations"),
                    Entry::Several if !graph.pieces.is_empty() => title("the loop around its pieces"),
                    Entry::Several => String::new(),
                    Entry::Piece => title(&format!("piece {}", number - 1)),
                };
                context.clear();
                emitter.emit((entry, called), &mut context.func, builder);
                part(what, *isa, context)?;
            }
        }
        Ok(())
    }
}

/// A comment line before a part of a listing.
fn title(what: &str) -> String {
    format!("; {what}\n")
}

/// Title of the part for a single iteration.
const SINGLE_TITLE: &str = "one iteration, or go on to more";

/// A call of a piece, to be resolved.
struct Call {
    kind: Reloc,
    piece: usize,
    addend: i64,
}

impl Call {
    /// The call that a relocation stands for; none if it is no call.
    fn of(relocation: &FinalizedMachReloc, func: &cranelift::Function) -> Option<Call> {
        let FinalizedRelocTarget::ExternalName(ExternalName::User(name)) = relocation.target else { return None };
        let piece = func.params.user_named_funcs()[name].index as usize;
        let known = matches!(relocation.kind, Reloc::X86CallPCRel4 | Reloc::Arm64Call);
        known.then_some(Call { kind: relocation.kind, piece, addend: relocation.addend })
    }

    /// Writes the distance from the call at byte `at` to byte `to` into the code; none if it is out of range.
    fn resolve(&self, code: &mut [u8], at: usize, to: usize) -> Option<()> {
        let distance = to as i64 + self.addend - at as i64;
        let field = &mut code[at..at + 4];
        let instruction = u32::from_le_bytes(field.try_into().expect("four bytes"));
        let resolved = match self.kind {
            Reloc::X86CallPCRel4 => i32::try_from(distance).ok()? as u32,
            // A 26-bit field that counts instructions of 4 bytes.
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

/// The most numbers of a vector, where it is limited.
static MOST_LANES: OnceLock<usize> = OnceLock::new();

/// Lets the process stand in for a processor with narrower vectors, from the first code that is compiled on: vectors of at
/// most so many numbers, 1 for scalar code alone, 0 for none, so that everything is interpreted.
pub fn limit_lanes(most: usize) {
    let _ = MOST_LANES.set(most);
}

/// The most numbers that a vector may have.
pub fn most_lanes() -> usize {
    MOST_LANES.get().copied().unwrap_or(usize::MAX)
}

/// The processor that this program runs on, with all features it has.
pub fn here() -> Result<&'static OwnedTargetIsa, Unsupported> {
    static HERE: OnceLock<Result<OwnedTargetIsa, Unsupported>> = OnceLock::new();
    HERE.get_or_init(native).as_ref().map_err(Clone::clone)
}

fn native() -> Result<OwnedTargetIsa, Unsupported> {
    if most_lanes() == 0 {
        return Err(Unsupported("FRIC_LANES=0 asks for the interpreter".into()));
    }
    // Without these features fma, floor and nearest would become library calls.
    #[cfg(target_arch = "x86_64")]
    for feature in [Feature::Fma, Feature::Sse41] {
        if !feature.here() {
            return Err(Unsupported(format!("this processor lacks {}", feature.name())));
        }
    }
    let native = cranelift_native::builder().map_err(|what| Unsupported(what.into()))?;
    native.finish(flags()).map_err(|what| Unsupported(what.to_string()))
}

/// A target with features beyond those it requires.
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
        // Our own passes have already shared, folded and ordered the operations. With its optimiser on, Cranelift
        // merges equal constants and moves computations to their uses: that raises register pressure and causes spills.
        ("opt_level", "none"),
        ("is_pic", "false"),
        // A frame larger than a page is probed page by page, inline.
        ("enable_probestack", "true"),
        ("probestack_strategy", "inline"),
        ("unwind_info", "false"),
        ("enable_verifier", if cfg!(debug_assertions) { "true" } else { "false" }),
    ] {
        flags.set(flag, setting).expect("a flag of this version");
    }
    Flags::new(flags)
}
