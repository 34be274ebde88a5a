//! A model as one position-independent image, for a processor of any make from a machine of any make.
//!
//! In: the functions of a model. Out: an [`Image`]: their code one behind the other, with nothing left to be resolved.
//! The code reads its tables through the pointer to the pool that each call is given.

use super::target::{FunctionCompiler, with};
use super::unsupported::Unsupported;
use crate::ir::Func;
use crate::ir::verify::{Stage, verify};
use abi::image::{Feature, Image, Target};
use abi::{Description, Function};

/// The image of a model: `params` are the defaults of its parameters, SI, as many as its layout has. `more`: what its code
/// uses besides what any code for the target needs.
///
/// # Panics
/// If the target has no such features, or a function is not sound or not expanded: a mistake of the passes before.
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
        // A line of the cache for each function; the gaps trap on x86-64 and are undefined on 64-bit Arm.
        let gap = if target == Target::X86_64 { 0xcc } else { 0 };
        code.resize(code.len().next_multiple_of(bytes.alignment.max(64)), gap);
        entries[*function as usize] = Some(code.len() as u64);
        code.extend(bytes.code);
    }
    let (description, params) = (description.clone(), params.to_vec());
    // In the order of their bits: what is read again is what was written.
    let uses = |feature: &Feature| target.needs().contains(feature) || more.contains(feature);
    let features = Feature::ALL.into_iter().filter(uses).collect();
    Ok(Image { target, features, description, params, code, entries })
}
