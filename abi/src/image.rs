//! Images: a compiled model as one flat file with the code of all functions, the constants and the description.
//!
//! The compiler can generate an image for any target on any machine. The runtime maps the code and jumps to it. The
//! code is position-independent, without symbols, calls or relocations, so loading it only has to check that it fits.
//!
//! ```text
//!    0  "FRICCODE"                     104  for each function: offset of its entry in the code, or all ones
//!    8  version          u32           176  SHA-256 of everything, these 32 bytes taken as zeros
//!   12  target           u32           256  sections, each at its alignment, zeros between them:
//!   16  features         u64                description (1), params (8), pool (64), code (4096)
//!   24  length of all    u64
//!   32  slots of a block u64           Numbers are little endian, offsets are from the beginning of the file, and
//!   40  4 sections: offset, length     the code is its end: a page of it can be mapped as it lies.
//! ```
//! The hash detects accidental changes; it does not authenticate the author of the file.

use crate::description::Description;
use crate::encode::{Encode, Malformed, Reader};
use crate::table::Function;
use sha2::{Digest, Sha256};
use std::fmt;

/// The first bytes of an image.
pub const MAGIC: [u8; 8] = *b"FRICCODE";
/// Version of the format and of the calling convention.
pub const VERSION: u32 = 3;
/// Alignment of the code in the file.
pub const PAGE: usize = 4096;

const HEADER: usize = 256;
const HASH: std::ops::Range<usize> = 176..208;
const NO_ENTRY: u64 = u64::MAX;

/// Processor families for which code can be generated. All are little endian with 64 bits.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Target {
    /// x86-64 with the features of [`Target::needs`].
    X86_64,
    /// 64-bit Arm, base instruction set.
    Aarch64,
}

impl Target {
    /// All targets.
    pub const ALL: [Target; 2] = [Target::X86_64, Target::Aarch64];

    /// The name for the option `--target`.
    pub fn name(self) -> &'static str {
        match self {
            Target::X86_64 => "x86_64",
            Target::Aarch64 => "aarch64",
        }
    }

    /// The target with this name.
    pub fn named(name: &str) -> Option<Target> {
        Target::ALL.into_iter().find(|target| target.name() == name)
    }

    /// The target that this program runs on; `None` if it is another processor.
    pub fn here() -> Option<Target> {
        Target::named(std::env::consts::ARCH)
    }

    /// The features that code for this target always uses.
    pub fn needs(self) -> &'static [Feature] {
        match self {
            Target::X86_64 => &Feature::ALL[..6],
            Target::Aarch64 => &[],
        }
    }

    /// The features that code for this target may use on request. It then only runs on processors that have them.
    pub fn may_use(self) -> &'static [Feature] {
        match self {
            Target::X86_64 => &Feature::ALL[6..],
            Target::Aarch64 => &[],
        }
    }

    fn number(self) -> u32 {
        match self {
            Target::X86_64 => 1,
            Target::Aarch64 => 2,
        }
    }
}

/// Instruction sets beyond the base of x86-64. Without FMA and SSE4.1, fused products and roundings would be calls.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
#[allow(missing_docs)]
pub enum Feature {
    Sse3,
    Ssse3,
    Sse41,
    Sse42,
    Avx,
    Fma,
    Avx2,
    Bmi1,
    Bmi2,
    Lzcnt,
    Popcnt,
}

impl Feature {
    /// All features; the index is the bit in the header. Those that x86-64 code always uses come first.
    pub const ALL: [Feature; 11] = [
        Feature::Sse3,
        Feature::Ssse3,
        Feature::Sse41,
        Feature::Sse42,
        Feature::Avx,
        Feature::Fma,
        Feature::Avx2,
        Feature::Bmi1,
        Feature::Bmi2,
        Feature::Lzcnt,
        Feature::Popcnt,
    ];

    /// The feature with this name, in upper or lower case.
    pub fn named(name: &str) -> Option<Feature> {
        Feature::ALL.into_iter().find(|feature| feature.name().eq_ignore_ascii_case(name))
    }

    /// The manufacturer's name.
    pub fn name(self) -> &'static str {
        match self {
            Feature::Sse3 => "SSE3",
            Feature::Ssse3 => "SSSE3",
            Feature::Sse41 => "SSE4.1",
            Feature::Sse42 => "SSE4.2",
            Feature::Avx => "AVX",
            Feature::Fma => "FMA",
            Feature::Avx2 => "AVX2",
            Feature::Bmi1 => "BMI1",
            Feature::Bmi2 => "BMI2",
            Feature::Lzcnt => "LZCNT",
            Feature::Popcnt => "POPCNT",
        }
    }

    /// Whether this processor has it.
    #[cfg(target_arch = "x86_64")]
    pub fn here(self) -> bool {
        match self {
            Feature::Sse3 => std::arch::is_x86_feature_detected!("sse3"),
            Feature::Ssse3 => std::arch::is_x86_feature_detected!("ssse3"),
            Feature::Sse41 => std::arch::is_x86_feature_detected!("sse4.1"),
            Feature::Sse42 => std::arch::is_x86_feature_detected!("sse4.2"),
            Feature::Avx => std::arch::is_x86_feature_detected!("avx"),
            Feature::Fma => std::arch::is_x86_feature_detected!("fma"),
            Feature::Avx2 => std::arch::is_x86_feature_detected!("avx2"),
            Feature::Bmi1 => std::arch::is_x86_feature_detected!("bmi1"),
            Feature::Bmi2 => std::arch::is_x86_feature_detected!("bmi2"),
            Feature::Lzcnt => std::arch::is_x86_feature_detected!("lzcnt"),
            Feature::Popcnt => std::arch::is_x86_feature_detected!("popcnt"),
        }
    }

    /// Whether this processor has it.
    #[cfg(not(target_arch = "x86_64"))]
    pub fn here(self) -> bool {
        false
    }
}

/// Why an image is refused.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Refusal {
    /// It does not begin with [`MAGIC`].
    NotAnImage,
    /// It has another version of the format.
    Version(u32),
    /// Its length differs from the length in its header.
    Length {
        /// Bytes by its header.
        said: u64,
        /// Actual bytes.
        found: u64,
    },
    /// Its hash does not match.
    Changed,
    /// Its hash matches, but its content is invalid: a bug in the program that generated it.
    Malformed(String),
    /// It is for another processor.
    Target {
        /// The processor it is for.
        made_for: Target,
    },
    /// This processor lacks these instruction sets.
    Lacks(Vec<Feature>),
    /// Memory for the code could not be allocated or made executable.
    Memory(String),
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Refusal::NotAnImage => f.write_str("this is no compiled model: it does not begin with FRICCODE"),
            Refusal::Version(found) => write!(
                f,
                "this compiled model has version {found} of the format, this program runs version {VERSION}: build it \
                 again with the compiler of this program"
            ),
            Refusal::Length { said, found } => write!(
                f,
                "this compiled model should have {said} bytes and has {found}: it was not copied whole; copy it again"
            ),
            Refusal::Changed => f.write_str(
                "this compiled model has changed since it was built (its SHA-256 is another): copy or build it again",
            ),
            Refusal::Malformed(what) => write!(f, "this compiled model contradicts itself: {what}"),
            Refusal::Target { made_for } => write!(
                f,
                "this compiled model is for {}, this processor is {}: build it with --target {}",
                made_for.name(),
                std::env::consts::ARCH,
                std::env::consts::ARCH
            ),
            Refusal::Lacks(features) => {
                let names: Vec<&str> = features.iter().map(|feature| feature.name()).collect();
                write!(f, "this compiled model needs {}, which this processor does not have", names.join(", "))
            }
            Refusal::Memory(why) => write!(f, "there is no memory for the code of this compiled model: {why}"),
        }
    }
}

impl std::error::Error for Refusal {}

/// A parsed image.
#[derive(Clone, PartialEq, Debug)]
pub struct Image {
    /// The processor family its code runs on.
    pub target: Target,
    /// The instruction sets its code uses.
    pub features: Vec<Feature>,
    /// Its description, with the pool of constants.
    pub description: Description,
    /// Default values of its parameters, SI, as many as the layout has.
    pub params: Vec<f64>,
    /// Its machine code.
    pub code: Vec<u8>,
    /// Offset of each function in the code, in the order of [`Function::ALL`].
    pub entries: [Option<u64>; Function::ALL.len()],
}

impl Image {
    /// Writes the file.
    ///
    /// # Panics
    /// If the image is inconsistent: a bug in the caller.
    pub fn to_bytes(&self) -> Vec<u8> {
        if let Some(fault) = self.fault() {
            panic!("an image that contradicts itself: {fault}");
        }
        let numbers = |numbers: &[f64]| numbers.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>();
        let pool = numbers(&self.description.pool);
        let bare = Description { pool: Vec::new().into(), ..self.description.clone() };
        let sections = [(bare.to_bytes(), 1), (numbers(&self.params), 8), (pool, 64), (self.code.clone(), PAGE)];
        let mut out = vec![0; HEADER];
        let mut places: Vec<u64> = Vec::new();
        for (section, alignment) in sections {
            out.resize(out.len().next_multiple_of(alignment), 0);
            places.extend([out.len() as u64, section.len() as u64]);
            out.extend(section);
        }
        let features = self.features.iter().fold(0, |bits, feature| bits | 1u64 << *feature as u64);
        let mut header = MAGIC.to_vec();
        VERSION.encode(&mut header);
        self.target.number().encode(&mut header);
        for number in [features, out.len() as u64, self.description.layout.size() as u64] {
            number.encode(&mut header);
        }
        places.iter().for_each(|n| n.encode(&mut header));
        self.entries.iter().for_each(|entry| entry.unwrap_or(NO_ENTRY).encode(&mut header));
        assert_eq!(header.len(), HASH.start, "the header is as long as its description says");
        out[..header.len()].copy_from_slice(&header);
        let hash = hash(&out);
        out[HASH].copy_from_slice(&hash);
        out
    }

    /// Parses a file, and checks its length and hash. [`Image::fits`] checks whether it fits this processor.
    ///
    /// # Errors
    /// Why it cannot be used.
    pub fn read(bytes: &[u8]) -> Result<Image, Refusal> {
        if bytes.get(..MAGIC.len()) != Some(MAGIC.as_slice()) {
            return Err(Refusal::NotAnImage);
        }
        let found = bytes.len() as u64;
        if bytes.len() < HEADER {
            return Err(Refusal::Length { said: HEADER as u64, found });
        }
        let mut header = Reader::new(&bytes[MAGIC.len()..HEADER]);
        let version = u32::decode(&mut header)?;
        if version != VERSION {
            return Err(Refusal::Version(version));
        }
        let target = u32::decode(&mut header)?;
        let mut next = || u64::decode(&mut header);
        let (features, said, slots) = (next()?, next()?, next()?);
        if said != found {
            return Err(Refusal::Length { said, found });
        }
        if bytes[HASH] != hash(bytes) {
            return Err(Refusal::Changed);
        }
        let malformed = |what: String| Refusal::Malformed(what);
        let target = Target::ALL
            .into_iter()
            .find(|known| known.number() == target)
            .ok_or_else(|| malformed(format!("{target} is no target")))?;
        if features >> Feature::ALL.len() != 0 {
            return Err(malformed(format!("features {features:#x} are not all known")));
        }
        let mut sections: [&[u8]; 4] = [&[]; 4];
        for section in &mut sections {
            let (offset, length) = (next()?, next()?);
            let range =
                usize::try_from(offset).ok().zip(offset.checked_add(length).and_then(|e| usize::try_from(e).ok()));
            *section = range
                .and_then(|(begin, end)| bytes.get(begin..end))
                .ok_or_else(|| malformed(format!("a section of {length} bytes at {offset} lies outside")))?;
        }
        let [description, params, pool, code] = sections;
        let mut entries = [None; Function::ALL.len()];
        for entry in &mut entries {
            let offset = next()?;
            *entry = (offset != NO_ENTRY).then_some(offset);
        }
        let numbers = |section: &[u8]| -> Vec<f64> {
            section.chunks_exact(8).map(|bytes| f64::from_le_bytes(bytes.try_into().expect("eight bytes"))).collect()
        };
        let description = Description { pool: numbers(pool).into(), ..Description::from_bytes(description)? };
        if description.layout.size() as u64 != slots {
            return Err(malformed(format!("a block has {} slots, {slots} are told", description.layout.size())));
        }
        let features = Feature::ALL.into_iter().filter(|feature| features >> *feature as u64 & 1 == 1).collect();
        let image = Image { target, features, description, params: numbers(params), code: code.to_vec(), entries };
        image.fault().map_or(Ok(image), |fault| Err(malformed(fault)))
    }

    /// Checks that this processor can run it.
    ///
    /// # Errors
    /// Why it cannot.
    pub fn fits(&self) -> Result<(), Refusal> {
        self.fits_on(Target::here(), Feature::here)
    }

    /// Checks that a processor of this family with these features can run it.
    fn fits_on(&self, target: Option<Target>, has: impl Fn(Feature) -> bool) -> Result<(), Refusal> {
        if target != Some(self.target) {
            return Err(Refusal::Target { made_for: self.target });
        }
        let lacking: Vec<Feature> = self.features.iter().copied().filter(|feature| !has(*feature)).collect();
        if lacking.is_empty() { Ok(()) } else { Err(Refusal::Lacks(lacking)) }
    }

    /// The first inconsistency, as a message.
    fn fault(&self) -> Option<String> {
        let layout = &self.description.layout;
        if self.params.len() != layout.params.len as usize {
            return Some(format!("{} parameters have {} defaults", layout.params.len, self.params.len()));
        }
        let outside = |entry: &u64| *entry >= self.code.len() as u64;
        if let Some(entry) = self.entries.iter().flatten().find(|entry| outside(entry)) {
            return Some(format!("a function begins at byte {entry} of {} bytes of code", self.code.len()));
        }
        self.description
            .slots()
            .find(|slot| slot.index() >= layout.size())
            .map(|slot| format!("slot {} is named in a block of {} slots", slot.0, layout.size()))
    }
}

impl From<Malformed> for Refusal {
    fn from(malformed: Malformed) -> Refusal {
        Refusal::Malformed(malformed.0)
    }
}

/// SHA-256 of some bytes.
pub fn sha256(bytes: &[u8]) -> [u8; 32] {
    Sha256::digest(bytes).into()
}

/// SHA-256 of a file that contains its own hash at `own`; those bytes count as zeros.
///
/// # Panics
/// If the file ends before its hash does: a bug in the caller.
pub fn sha256_without(bytes: &[u8], own: std::ops::Range<usize>) -> [u8; 32] {
    let mut hasher = Sha256::new();
    hasher.update(&bytes[..own.start]);
    hasher.update([0; 32]);
    hasher.update(&bytes[own.end..]);
    hasher.finalize().into()
}

fn hash(bytes: &[u8]) -> [u8; 32] {
    sha256_without(bytes, HASH)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::{Guard, Kind, Layout, Quantity, Slot};
    use crate::unit::Unit;

    fn image() -> Image {
        let layout = Layout::new([2, 1, 3, 0, 0, 1, 3, 0, 0, 0]);
        let unit = Unit::parse("N·s/m").unwrap();
        let quantity = Quantity {
            path: "fr.σ".into(),
            kind: Kind::Param,
            unit: unit.clone(),
            boolean: false,
            slot: Slot(3),
            range: (0.0, f64::INFINITY),
            doc: Some("micro-damping".into()),
        };
        let guard = Guard { path: "z".into(), slot: Slot(6), range: (-1.0, 1.0), unit };
        let description = Description {
            name: "Servo".into(),
            layout,
            quantities: vec![quantity],
            guards: vec![guard],
            pool: vec![1.0, -0.0, 0.1].into(),
            ..Description::default()
        };
        let mut entries = [None; Function::ALL.len()];
        entries[Function::Step as usize] = Some(16);
        let features = Target::X86_64.needs().to_vec();
        Image { target: Target::X86_64, features, description, params: vec![1.0, 2.0], code: vec![0xcc; 40], entries }
    }

    #[test]
    fn images_round_trip_and_equal_images_have_equal_bytes() {
        let bytes = image().to_bytes();
        assert_eq!(Image::read(&bytes), Ok(image()));
        assert_eq!(bytes, image().to_bytes());
        let code_at = u64::from_le_bytes(bytes[88..96].try_into().unwrap()) as usize;
        assert_eq!((code_at % PAGE, &bytes[code_at..]), (0, &[0xcc; 40][..]));
    }

    #[test]
    fn a_flipped_bit_is_found_wherever_it_is() {
        let bytes = image().to_bytes();
        for at in 0..bytes.len() {
            let mut changed = bytes.clone();
            changed[at] ^= 1 << (at % 8);
            assert!(Image::read(&changed).is_err(), "a change of byte {at}");
        }
        let mut changed = bytes.clone();
        *changed.last_mut().unwrap() ^= 1;
        assert_eq!(Image::read(&changed), Err(Refusal::Changed));
    }

    #[test]
    fn truncated_files_and_other_files_have_different_errors() {
        let bytes = image().to_bytes();
        for len in 0..bytes.len() {
            let expected = if len < MAGIC.len() { "no compiled model" } else { "not copied whole" };
            let refusal = Image::read(&bytes[..len]).unwrap_err().to_string();
            assert!(refusal.contains(expected), "{len} bytes: {refusal}");
        }
        assert_eq!(Image::read(b"FRICCOD?"), Err(Refusal::NotAnImage));
        let mut other = bytes;
        other[8] = 9;
        assert_eq!(Image::read(&other), Err(Refusal::Version(9)));
    }

    #[test]
    fn another_processor_is_refused() {
        let other = if Target::here() == Some(Target::X86_64) { Target::Aarch64 } else { Target::X86_64 };
        let refusal = Image { target: other, ..image() }.fits().unwrap_err();
        assert_eq!(refusal, Refusal::Target { made_for: other });
        assert!(refusal.to_string().contains(&format!("is for {}", other.name())), "{refusal}");
    }

    #[test]
    fn a_processor_that_lacks_instructions_is_told_which() {
        let old = |feature| !matches!(feature, Feature::Avx | Feature::Fma);
        let refusal = image().fits_on(Some(Target::X86_64), old).unwrap_err();
        assert_eq!(refusal.to_string(), "this compiled model needs AVX, FMA, which this processor does not have");
        assert_eq!(image().fits_on(Some(Target::X86_64), |_| true), Ok(()));
    }

    /// Valid hashes over invalid content, as a faulty compiler would generate them.
    #[test]
    fn inconsistent_images_are_refused() {
        let resealed = |change: &dyn Fn(&mut Vec<u8>)| {
            let mut bytes = image().to_bytes();
            change(&mut bytes);
            let hash = hash(&bytes);
            bytes[HASH].copy_from_slice(&hash);
            Image::read(&bytes).unwrap_err().to_string()
        };
        let entry = 104 + 8 * Function::Step as usize;
        for (at, value, expected) in [
            (12, 77, "77 is no target"),
            (23, 1, "are not all known"),
            (32, 200, "200 are told"),
            (48, 1, "left"),
            (entry, 200, "begins at byte 200 of 40"),
            (94, 1, "lies outside"),
        ] {
            let found = resealed(&|bytes| bytes[at] = value);
            assert!(found.contains(expected), "byte {at}: {found}");
        }
    }

    /// For any bytes, a description is either read or refused, without a panic.
    #[test]
    fn no_description_causes_a_panic() {
        let bytes = image().description.to_bytes();
        for at in 0..bytes.len() {
            for value in [0, 1, 0x7f, 0x80, 0xff] {
                let mut changed = bytes.clone();
                changed[at] = value;
                if let Ok(description) = Description::from_bytes(&changed) {
                    assert_eq!(description.to_bytes(), changed, "byte {at} as {value}");
                }
            }
        }
    }
}
