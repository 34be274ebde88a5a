//! A model as one position-independent image, for any supported processor and from any machine.
//!
//! In: the functions of a model. Out: an [`Image`]: their code one after the other, with all references resolved. The
//! code reads its tables through the pointer to the pool that is passed with each call.

use super::target::{FunctionCompiler, with};
use super::unsupported::Unsupported;
use crate::ir::Func;
use crate::ir::verify::{Stage, verify};
use abi::image::{Feature, Image, Target};
use abi::{Description, Function};

/// Compiles the image of a model. `params`: the defaults of its parameters in SI units, as many as its layout has.
/// `more`: features of the processor that the code may use beyond those that the target requires.
///
/// # Panics
/// If the target has no such features, or a function does not verify or is not expanded: a mistake of an earlier pass.
pub fn image(
    functions: &[(Function, Func)],
    description: &Description,
    params: &[f64],
    target: Target,
    more: &[Feature],
) -> Result<Image, Unsupported> {
    assert!(more.iter().all(|feature| target.may_use().contains(feature)), "{more:?} on {}", target.name());
    let isa = with(target, more);
    let mut coder = FunctionCompiler::new(&isa);
    let mut code: Vec<u8> = Vec::new();
    let mut entries = [None; Function::ALL.len()];
    for (function, func) in functions {
        verify(func, &description.layout, description.pool.len(), Stage::Expanded)
            .unwrap_or_else(|fault| panic!("{fault}"));
        let bytes = coder.function(func)?;
        // Functions begin at cache lines. The padding traps on x86-64 and is an undefined instruction on 64-bit Arm.
        let gap = if target == Target::X86_64 { 0xcc } else { 0 };
        code.resize(code.len().next_multiple_of(bytes.alignment.max(64)), gap);
        entries[*function as usize] = Some(code.len() as u64);
        code.extend(bytes.code);
    }
    let (description, params) = (description.clone(), params.to_vec());
    // In the order of their bits, so that an image that is read back is equal.
    let uses = |feature: &Feature| target.needs().contains(feature) || more.contains(feature);
    let features = Feature::ALL.into_iter().filter(uses).collect();
    Ok(Image { target, features, description, params, code, entries })
}
