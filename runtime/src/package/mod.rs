//! A rig packed for the computer that runs it: one file that is intact or refused.
//!
//! In: named sections of bytes (compiled programs, the rig's plan, sources) and their origin. Out: the bytes of a file;
//! or the sections of a file, once every bit of it has been verified. Equal content results in equal bytes. Does not
//! know the meaning of the sections.
//!
//! ```text
//!    0  "FRICPKG\n"
//!    8  version          u32       12  number of sections  u32      16  total length  u64
//!   24  SHA-256 of everything, with these 32 bytes as zeros
//!   56  manifest: fric version, target, rig (text: u32 length and bytes); then for each section
//!       its name (text), offset and length (u64), SHA-256
//!       sections one after the other, in the order of their names
//! ```
//! The hash detects every accidental change of a file. A signature beside it proves its origin, see [`signature`].

pub mod contents;
pub mod signature;

use abi::encode::{Encode, Malformed, Reader};
use abi::foreign::{is_name, is_plain};
use abi::image::{sha256, sha256_without};
use std::fmt;

/// The first bytes. The line feed reveals a transfer in text mode.
pub const MAGIC: [u8; 8] = *b"FRICPKG\n";
/// Version of the format.
pub const VERSION: u32 = 1;
/// Extension of a package's file name.
pub const EXTENSION: &str = "fricpkg";
/// Size limit, so that no package can exhaust the memory of a rig's computer.
pub const MOST_BYTES: u64 = 256 << 20;

const HASH: std::ops::Range<usize> = 24..56;

/// A package.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Package {
    /// The version of `fric` that made it.
    pub fric: String,
    /// Processor family and operating system: `x86_64-linux`.
    pub target: String,
    /// Name of the rig.
    pub rig: String,
    /// In the order of their names, which are unique.
    pub sections: Vec<Section>,
}

/// Named bytes.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Section {
    /// `control`, `plant`, `rig`, `source/rtfs.fric`.
    pub name: String,
    /// The content.
    pub bytes: Vec<u8>,
}

/// Reason to refuse a package.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Refusal {
    /// It does not begin like a package.
    NotAPackage,
    /// It has another version of the format.
    Version(u32),
    /// Its length differs from the one in its header.
    Length {
        /// Length in the header, bytes.
        said: u64,
        /// Length of the file, bytes.
        found: u64,
    },
    /// Its hash is wrong.
    Changed,
    /// Its hash is right but its content is invalid: its maker made an error.
    Malformed(String),
    /// It is for another processor or operating system.
    Target {
        /// Its target.
        said: String,
        /// This computer.
        here: String,
    },
    /// A section is missing.
    Missing(String),
    /// It was made by another version of `fric`, whose plans may have another meaning.
    Maker {
        /// Version of its maker.
        said: String,
        /// Version of this program.
        here: String,
    },
    /// It is not signed, or not by a trusted key.
    Signature(String),
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Refusal::NotAPackage => write!(f, "it is no package: `fric build RIG.fric -o NAME.{EXTENSION}` makes one"),
            Refusal::Version(found) => {
                write!(f, "it is of version {found} of the format, and this program reads version {VERSION}")
            }
            Refusal::Length { said, found } => write!(f, "it has {found} bytes of {said}: the copy is not whole"),
            Refusal::Changed => write!(f, "it is not as it was made: its hash differs; copy or build it again"),
            Refusal::Malformed(why) => write!(f, "it is whole and makes no sense: {why}"),
            Refusal::Target { said, here } => {
                write!(f, "it is for {said}, and this is {here}: build it with `--target {here}`")
            }
            Refusal::Missing(name) => write!(f, "its section `{name}` is missing"),
            Refusal::Maker { said, here } => {
                write!(f, "fric {said} made it, and this is fric-rig {here}: bring both to one version")
            }
            Refusal::Signature(why) => f.write_str(why),
        }
    }
}

impl std::error::Error for Refusal {}

impl From<Malformed> for Refusal {
    fn from(why: Malformed) -> Refusal {
        Refusal::Malformed(why.0)
    }
}

/// Processor family and operating system of this program: `x86_64-linux`.
pub fn here() -> String {
    format!("{}-{}", std::env::consts::ARCH, std::env::consts::OS)
}

/// SHA-256 of some bytes in hexadecimal digits.
pub fn hash(bytes: &[u8]) -> String {
    sha256(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

impl Package {
    /// Adds a section.
    ///
    /// # Panics
    /// If there is a section of that name: the caller has added it twice.
    pub fn add(&mut self, name: &str, bytes: Vec<u8>) {
        let at = self.sections.partition_point(|section| section.name.as_str() < name);
        assert!(self.sections.get(at).is_none_or(|section| section.name != name), "two sections `{name}`");
        self.sections.insert(at, Section { name: name.into(), bytes });
    }

    /// The bytes of a section.
    ///
    /// # Errors
    /// If there is none of that name.
    pub fn section(&self, name: &str) -> Result<&[u8], Refusal> {
        let found = self.sections.iter().find(|section| section.name == name);
        found.map(|section| &section.bytes[..]).ok_or_else(|| Refusal::Missing(name.into()))
    }

    /// Encodes the file.
    pub fn to_bytes(&self) -> Vec<u8> {
        let table = |offsets: &[u64]| {
            let mut out = Vec::new();
            for text in [&self.fric, &self.target, &self.rig] {
                text.encode(&mut out);
            }
            for (section, offset) in self.sections.iter().zip(offsets) {
                section.name.encode(&mut out);
                offset.encode(&mut out);
                (section.bytes.len() as u64).encode(&mut out);
                out.extend(sha256(&section.bytes));
            }
            out
        };
        let mut at = (HASH.end + table(&vec![0; self.sections.len()]).len()) as u64;
        let mut offsets = Vec::new();
        for section in &self.sections {
            offsets.push(at);
            at += section.bytes.len() as u64;
        }
        let mut out = MAGIC.to_vec();
        out.extend(VERSION.to_le_bytes());
        out.extend((self.sections.len() as u32).to_le_bytes());
        out.extend(at.to_le_bytes());
        out.extend([0; 32]);
        out.extend(table(&offsets));
        for section in &self.sections {
            out.extend(&section.bytes);
        }
        let hash = sha256(&out);
        out[HASH].copy_from_slice(&hash);
        out
    }

    /// Decodes a file.
    ///
    /// # Errors
    /// Any difference, even of one bit, from the output of [`Package::to_bytes`].
    pub fn read(bytes: &[u8]) -> Result<Package, Refusal> {
        let (Some(magic), Some(version)) = (bytes.get(..8), bytes.get(8..12)) else {
            return Err(Refusal::NotAPackage);
        };
        if magic != MAGIC {
            return Err(Refusal::NotAPackage);
        }
        let version = u32::from_le_bytes(version.try_into().expect("four bytes"));
        if version != VERSION {
            return Err(Refusal::Version(version));
        }
        let short = |said| Refusal::Length { said, found: bytes.len() as u64 };
        let head = bytes.get(12..HASH.end).ok_or(short(HASH.end as u64))?;
        let count = u32::from_le_bytes(head[..4].try_into().expect("four bytes"));
        let said = u64::from_le_bytes(head[4..12].try_into().expect("eight bytes"));
        if said != bytes.len() as u64 {
            return Err(short(said));
        }
        if sha256_without(bytes, HASH)[..] != bytes[HASH] {
            return Err(Refusal::Changed);
        }
        let mut reader = Reader::new(&bytes[HASH.end..]);
        let mut text = || String::decode(&mut reader);
        let mut package = Package { fric: text()?, target: text()?, rig: text()?, sections: Vec::new() };
        package.named()?;
        let mut expected = None;
        for _ in 0..count {
            let name = String::decode(&mut reader)?;
            // Names become parts of file names, and are displayed: `source/std.friction.lugre.fric`.
            let inside = |part: &str| is_plain(part) && !matches!(part, "" | "." | "..") && !part.contains('\\');
            if !name.split('/').all(inside) {
                return Err(Refusal::Malformed(format!("a section is called {name:?}")));
            }
            let (offset, length) = (u64::decode(&mut reader)?, u64::decode(&mut reader)?);
            let hash: &[u8] = reader.take(32)?;
            // Sections follow each other without gaps, so that every byte belongs to exactly one.
            let next = *expected.get_or_insert(offset);
            let content = offset.checked_add(length).and_then(|end| bytes.get(offset as usize..end as usize));
            let Some(content) = content.filter(|_| offset == next) else {
                return Err(Refusal::Malformed(format!("section `{name}` does not lie where it should")));
            };
            if package.sections.last().is_some_and(|last| last.name >= name) {
                return Err(Refusal::Malformed(format!("section `{name}` is out of order")));
            }
            if sha256(content)[..] != *hash {
                return Err(Refusal::Malformed(format!("section `{name}` has another hash than the table says")));
            }
            expected = Some(offset + length);
            package.sections.push(Section { name, bytes: content.to_vec() });
        }
        if expected.unwrap_or(bytes.len() as u64) != bytes.len() as u64 {
            return Err(Refusal::Malformed("there is more behind the last section".into()));
        }
        Ok(package)
    }

    /// Checks its texts: the rig's name must be fit for a file name, the other texts for display.
    fn named(&self) -> Result<(), Refusal> {
        let Package { fric, target, rig, .. } = self;
        if !is_name(rig) {
            return Err(Refusal::Malformed(format!("its rig is called {rig:?}, which is no name")));
        }
        match [fric, target].into_iter().find(|text| !is_plain(text)) {
            Some(text) => Err(Refusal::Malformed(format!("it says that it was made by or for {text:?}"))),
            None => Ok(()),
        }
    }

    /// Checks that this machine and this version can run it.
    ///
    /// # Errors
    /// The mismatch.
    pub fn fits(&self, fric: &str) -> Result<(), Refusal> {
        if self.target != here() {
            return Err(Refusal::Target { said: self.target.clone(), here: here() });
        }
        if self.fric != fric {
            return Err(Refusal::Maker { said: self.fric.clone(), here: fric.into() });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn package() -> Package {
        let mut package = Package { fric: "1.2.3".into(), target: here(), rig: "rtfs".into(), sections: Vec::new() };
        package.add("source/rtfs.fric", b"rig rtfs {}\n".to_vec());
        package.add("control", (0..=255).collect());
        package.add("plant", Vec::new());
        package
    }

    #[test]
    fn a_package_survives_encoding_and_equal_content_gives_equal_bytes() {
        let bytes = package().to_bytes();
        assert_eq!(Package::read(&bytes), Ok(package()));
        assert_eq!(bytes, package().to_bytes());
        let empty = Package { rig: "empty".into(), ..Package::default() };
        assert_eq!(Package::read(&empty.to_bytes()), Ok(empty));
        let names: Vec<String> = package().sections.into_iter().map(|section| section.name).collect();
        assert_eq!(names, ["control", "plant", "source/rtfs.fric"]);
    }

    #[test]
    fn any_flipped_bit_is_refused() {
        let bytes = package().to_bytes();
        for at in 0..bytes.len() {
            for bit in 0..8 {
                let mut changed = bytes.clone();
                changed[at] ^= 1 << bit;
                assert!(Package::read(&changed).is_err(), "byte {at}, bit {bit}");
            }
        }
    }

    #[test]
    fn a_truncated_or_extended_package_is_refused() {
        let bytes = package().to_bytes();
        for length in 0..bytes.len() {
            assert!(Package::read(&bytes[..length]).is_err(), "{length} bytes");
        }
        let longer = [&bytes[..], b"x"].concat();
        let (said, found) = (bytes.len() as u64, longer.len() as u64);
        assert_eq!(Package::read(&longer), Err(Refusal::Length { said, found }));
    }

    /// With a right hash, invalid content is a different error.
    #[test]
    fn an_inconsistent_table_is_refused() {
        let mut bytes = package().to_bytes();
        let rehash = |bytes: &mut Vec<u8>| {
            bytes[HASH].fill(0);
            let hash = sha256(bytes);
            bytes[HASH].copy_from_slice(&hash);
        };
        bytes[12] = 2;
        rehash(&mut bytes);
        assert!(matches!(Package::read(&bytes), Err(Refusal::Malformed(_))));
        let mut other = package().to_bytes();
        let last = other.len() - 1;
        other[last] ^= 1;
        rehash(&mut other);
        let why = Package::read(&other).unwrap_err().to_string();
        assert!(why.contains("source/rtfs.fric") && why.contains("another hash"), "{why}");
    }

    /// The name of a package becomes part of a file name, and its texts are displayed.
    #[test]
    fn names_that_escape_a_folder_or_control_a_terminal_are_refused() {
        let why = |package: &Package| Package::read(&package.to_bytes()).unwrap_err().to_string();
        for rig in ["", "../../x", "/etc/x", "a\u{1b}[2J", ".x", "-x"] {
            let told = why(&Package { rig: rig.into(), ..package() });
            assert!(told.contains("which is no name") && is_plain(&told), "{rig:?}: {told}");
        }
        let told = why(&Package { fric: "1\u{1b}]0;x\u{7}".into(), ..package() });
        assert!(told.contains("made by or for") && is_plain(&told), "{told}");
        for name in ["source/../../x", "/control", "source//x", "a\u{7}", "source/..", "a\\b"] {
            let mut package = package();
            package.add(name, Vec::new());
            let told = why(&package);
            assert!(told.contains("a section is called") && is_plain(&told), "{name:?}: {told}");
        }
    }

    #[test]
    fn another_target_or_maker_is_refused_with_a_message() {
        let package = package();
        assert_eq!(package.fits("1.2.3"), Ok(()));
        let why = package.fits("2.0.0").unwrap_err().to_string();
        assert_eq!(why, "fric 1.2.3 made it, and this is fric-rig 2.0.0: bring both to one version");
        let other = Package { target: "s390x-linux".into(), ..package };
        assert!(other.fits("1.2.3").unwrap_err().to_string().starts_with("it is for s390x-linux, and this is "));
        assert_eq!(other.section("rig").unwrap_err().to_string(), "its section `rig` is missing");
    }
}
