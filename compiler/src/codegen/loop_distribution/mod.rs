//! Loop distribution: one loop over steps becomes two, a vectorised leading loop for everything that depends on time
//! alone, and a remaining loop for the states.
//!
//! In: a step. Out: the two loops, if they are faster and this processor has lanes. The lanes of the leading loop are
//! successive instants of time. Only for many steps per call and code in memory: images run in real time, one step per
//! call.
//!
//! Source: Kennedy, Allen, *Optimizing Compilers for Modern Architectures*, 2001, ch. 5.

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

/// Distributes a step that is verified and expanded; none if that does not pay or is not possible.
pub fn compile(step: &Func, layout: &Layout, pool_len: usize) -> Option<Ahead> {
    let Distribution { invariants, leading, remaining, layout: own, loads } = split(step, layout.size())?;
    let (invariants, leading) = Width::here_all().find_map(|width| {
        let lanes = |func: &Func| lanes::compile(func, &own, pool_len, width, width.vectors()).ok();
        let leading = lanes(&leading)?;
        match &invariants {
            Some(invariants) => Some((Some(lanes(invariants)?), leading)),
            None => Some((None, leading)),
        }
    })?;
    let bytes = FunctionCompiler::new(here().ok()?).remaining_loop(&remaining, layout.size(), leading.width()).ok()?;
    let executable = Executable::new(&bytes.code, bytes.alignment as u64).ok()?;
    // SAFETY: `address` is the start of code with the signature of `RestEntry`.
    let entry = unsafe { std::mem::transmute::<*const u8, RestEntry>(executable.address()) };
    // SAFETY: the entry lives as long as its memory; `split` keeps every access to block and pool as it was in the
    // step, which is verified, and loads one output of `own` for each distributed value; code without calls does not
    // unwind.
    unsafe { Ahead::new(invariants, leading, own, loads, entry, Arc::new(executable)) }
}
