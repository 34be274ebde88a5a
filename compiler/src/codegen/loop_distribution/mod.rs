//! Lets what depends on time alone go ahead of the steps: its lanes are instants.
//!
//! In: a step. Out: the same step in two parts, if that is quicker and this processor has lanes for it. Only for many steps
//! in one call, in memory: an image is stepped in real time, once a call.

mod split;

use super::target::{FunctionCompiler, here};
use crate::codegen::executable_memory::Executable;
use crate::codegen::lanes::{self, Width};
use crate::ir::Func;
use abi::Layout;
use abi::ahead::{Ahead, RestEntry};
use split::Distribution;
pub use split::split;
use std::sync::Arc;

/// The parts of a step that is sound and expanded, if it is worth them.
pub fn compile(step: &Func, layout: &Layout, pool_len: usize) -> Option<Ahead> {
    let Distribution { once, instants, rest, layout: own, loads } = split(step, layout.size())?;
    let (once, instants) = Width::here_all().find_map(|width| {
        let lanes = |func: &Func| lanes::compile(func, &own, pool_len, width, width.vectors()).ok();
        let instants = lanes(&instants)?;
        match &once {
            Some(once) => Some((Some(lanes(once)?), instants)),
            None => Some((None, instants)),
        }
    })?;
    let bytes = FunctionCompiler::new(here().ok()?).rest(&rest, layout.size(), instants.width()).ok()?;
    let executable = Executable::new(&bytes.code, bytes.alignment as u64).ok()?;
    // SAFETY: `address` is the beginning of code with the signature of `RestEntry`.
    let entry = unsafe { std::mem::transmute::<*const u8, RestEntry>(executable.address()) };
    // SAFETY: the entry lives as long as its memory; `split` leaves every access to block and pool as it was in the step,
    // which is sound, and reads an output of `own` for each number that goes ahead; code without calls does not unwind.
    unsafe { Ahead::new(once, instants, own, loads, entry, Arc::new(executable)) }
}
