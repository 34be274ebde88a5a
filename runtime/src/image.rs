//! Loads a compiled model from a file: no compiler, no linker, no relocation.
//!
//! In: the bytes of an [`Image`]. Out: the model, or why it is refused. Its code is copied to memory that is then made
//! executable and read-only. The memory is released with the last instance.

use abi::image::{Image, Refusal};
use abi::table::{Code, Entry, Machine};
use abi::{Description, Instance};
use memmap2::{Mmap, MmapMut};
use std::sync::Arc;

/// A compiled model.
#[derive(Clone)]
pub struct Model {
    /// Its parameters, inputs, states and outputs.
    pub description: Arc<Description>,
    /// Default values of its parameters, SI.
    pub params: Vec<f64>,
    /// Its functions.
    pub code: Code,
}

impl Model {
    /// An instance with all parameters at their defaults.
    pub fn instance(&self) -> Instance {
        Instance::new(self.description.clone(), self.code.clone(), &self.params)
    }
}

/// Reads a file that the compiler wrote with `--emit blob`.
///
/// # Errors
/// If the image is truncated, was changed, or is for another processor.
///
/// # Safety
/// The code in the image is executed as it is. Accidental changes are detected and refused. The caller must know that
/// the origin of the image is trustworthy, by a signature or because it made the image itself.
pub unsafe fn load(bytes: &[u8]) -> Result<Model, Refusal> {
    let image = Image::read(bytes)?;
    image.fits()?;
    let code = executable(&image.code).map_err(|error| Refusal::Memory(error.to_string()))?;
    // SAFETY: `Image::read` has checked that every entry point lies in the code. The caller vouches that the code there
    // has the signature of `Entry`, stays within a block of this size and a constant pool of this length, and does not
    // unwind.
    let machine = unsafe {
        let begin = code.as_ptr();
        let entries =
            image.entries.map(|at| at.map(|at| std::mem::transmute::<*const u8, Entry>(begin.add(at as usize))));
        let (slots, pool_len) = (image.description.layout.size(), image.description.pool.len());
        Machine::new(entries, slots, pool_len, Arc::new(code))
    };
    Ok(Model { description: Arc::new(image.description), params: image.params, code: Code::Machine(machine) })
}

/// Maps memory for the code: writable first, then executable, never both.
fn executable(code: &[u8]) -> std::io::Result<Mmap> {
    let mut memory = MmapMut::map_anon(code.len().max(1))?;
    memory[..code.len()].copy_from_slice(code);
    let memory = memory.make_exec()?;
    seen_by_instruction_fetch(&memory);
    Ok(memory)
}

/// x86-64 keeps instruction fetch coherent with data writes.
#[cfg(target_arch = "x86_64")]
fn seen_by_instruction_fetch(_: &[u8]) {}

/// Arm does not: clean the data cache to the point of unification, then invalidate the instruction cache.
#[cfg(target_arch = "aarch64")]
fn seen_by_instruction_fetch(code: &[u8]) {
    let (begin, end) = (code.as_ptr() as usize, code.as_ptr() as usize + code.len());
    // SAFETY: these instructions change no value; the smallest line of any cache is at least 16 bytes long.
    unsafe {
        for at in (begin & !15..end).step_by(16) {
            std::arch::asm!("dc cvau, {at}", at = in(reg) at, options(nostack, preserves_flags));
        }
        std::arch::asm!("dsb ish", options(nostack, preserves_flags));
        for at in (begin & !15..end).step_by(16) {
            std::arch::asm!("ic ivau, {at}", at = in(reg) at, options(nostack, preserves_flags));
        }
        std::arch::asm!("dsb ish", "isb", options(nostack, preserves_flags));
    }
}

#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
fn seen_by_instruction_fetch(_: &[u8]) {
    unreachable!("no image fits another processor")
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;
    use abi::image::Target;
    use abi::{Function, Layout};

    /// An image whose step returns its count as the status.
    fn image() -> Image {
        let target = Target::here().expect("tests run where code is made for");
        let code = match target {
            // mov rax, rdx; ret
            Target::X86_64 => vec![0x48, 0x89, 0xd0, 0xc3],
            // mov x0, x2; ret
            Target::Aarch64 => vec![0xe0, 0x03, 0x02, 0xaa, 0xc0, 0x03, 0x5f, 0xd6],
        };
        let layout = Layout::new([1, 0, 1, 0, 0, 0, 0, 0, 0, 0]);
        let description = Description { layout, ..Description::default() };
        let mut entries = [None; Function::ALL.len()];
        entries[Function::Step as usize] = Some(0);
        Image { target, features: Vec::new(), description, params: vec![2.5], code, entries }
    }

    #[test]
    fn a_model_runs_and_has_its_defaults() {
        // SAFETY: the code is the two instructions above.
        let model = unsafe { load(&image().to_bytes()) }.unwrap();
        let mut instance = model.instance();
        assert_eq!(instance.get(instance.description().layout.params.slot(0)), 2.5);
        assert_eq!(instance.advance(42), 42);
        assert!(!instance.has(Function::Jacobian));
    }

    /// Permissions of the memory at an address; none where there is no memory.
    fn permissions(address: usize) -> Option<String> {
        let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
        maps.lines().find_map(|line| {
            let (range, rest) = line.split_once(' ')?;
            let (from, to) = range.split_once('-')?;
            let [from, to] = [from, to].map(|hex| usize::from_str_radix(hex, 16).unwrap());
            (from..to).contains(&address).then(|| rest[..4].to_string())
        })
    }

    #[test]
    fn code_is_executable_and_not_writable() {
        let memory = executable(&image().code).unwrap();
        assert_eq!(permissions(memory.as_ptr() as usize).as_deref(), Some("r-xp"));
        let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
        assert!(!maps.lines().any(|line| line.split(' ').nth(1).is_some_and(|p| p.contains('w') && p.contains('x'))));
    }

    #[test]
    fn any_bytes_are_loaded_or_refused() {
        for len in 0..300 {
            // SAFETY: none of these is an image: they are refused before anything runs.
            assert!(unsafe { load(&image().to_bytes()[..len]) }.is_err());
        }
    }
}
