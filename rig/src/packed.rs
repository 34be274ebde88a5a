//! Packages as they are opened for running: verified first, in every respect, and only then looked into.
//!
//! In: a file, trusted keys. Out: an [`Open`] package, or why it is refused.

use abi::Instance;
use abi::encode::Encode;
use abi::image::Image;
use abi::rig::Rig;
use runtime::package::signature::{Trusted, beside};
use runtime::package::{MOST_BYTES, Package, hash};
use std::fs;
use std::path::Path;

/// Of this program: packages are made by the same one.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// A package that may run here.
pub struct Open {
    /// Its bytes as they lie in the file, and those of its signature.
    pub bytes: Vec<u8>,
    /// The text of its signature, if there is one beside it.
    pub signature: Option<String>,
    /// Its content.
    pub package: Package,
    /// Who signed it, if signatures are asked for.
    pub signer: Option<String>,
}

/// Reads and verifies a package.
///
/// # Errors
/// Why it is refused, in words.
pub fn open(path: &Path, trusted: &Path) -> Result<Open, String> {
    let about = |why: &dyn std::fmt::Display| format!("{}: {why}", path.display());
    let size = fs::metadata(path).map_err(|error| about(&error))?.len();
    if size > MOST_BYTES {
        return Err(about(&format!("{size} bytes are more than any package has")));
    }
    let bytes = fs::read(path).map_err(|error| about(&error))?;
    let signature = match fs::read_to_string(beside(path)) {
        Ok(text) => Some(text),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => None,
        Err(error) => return Err(format!("{}: {error}", beside(path).display())),
    };
    // First who made it, then what it is: nothing of an unknown maker is looked into.
    let keys = Trusted::in_folder(trusted)?;
    let signer = keys.signer(&bytes, signature.as_deref()).map_err(|why| about(&why))?.map(str::to_string);
    let package = Package::read(&bytes).map_err(|why| about(&why))?;
    package.fits(VERSION).map_err(|why| about(&why))?;
    for name in ["control", "plant"] {
        let bytes = package.section(name).map_err(|why| about(&why))?;
        let image = Image::read(bytes).map_err(|why| about(&format!("its program `{name}`: {why}")))?;
        image.fits().map_err(|why| about(&format!("its program `{name}`: {why}")))?;
    }
    let open = Open { bytes, signature, package, signer };
    open.rig().map_err(|why| about(&why))?;
    Ok(open)
}

impl Open {
    /// The plan of the rig.
    ///
    /// # Errors
    /// Why its section makes no sense.
    pub fn rig(&self) -> Result<Rig, String> {
        let bytes = self.package.section("rig").map_err(|why| why.to_string())?;
        Rig::from_bytes(bytes).map_err(|why| format!("the plan of its rig: {why}"))
    }

    /// One of its programs, ready to start: `control` or `plant`.
    ///
    /// # Errors
    /// Why it cannot be loaded.
    pub fn program(&self, name: &str) -> Result<Instance, String> {
        let bytes = self.package.section(name).map_err(|why| why.to_string())?;
        // SAFETY: the bytes are those that `fric build` wrote, as every hash says, and where keys are trusted as a
        // signature says; who installs a package on a computer without keys vouches for it.
        let model = unsafe { runtime::blob::load(bytes) };
        model.map(|model| model.instance()).map_err(|why| format!("its program `{name}`: {why}"))
    }

    /// In words.
    pub fn describe(&self) -> String {
        let Package { fric, target, rig, sections } = &self.package;
        let signer = match (&self.signer, &self.signature) {
            (Some(name), _) => format!("signed by {name}"),
            (None, Some(_)) => "signed; no key is trusted here, so the signature was not checked".into(),
            (None, None) => "not signed; no key is trusted here".into(),
        };
        let sources = sections.iter().filter(|section| section.name.starts_with("source/")).count();
        format!(
            "{rig}: fits this computer ({target}, fric {fric})\n  {} bytes, {sources} sources, {signer}\n  SHA-256 {}\n",
            self.bytes.len(),
            hash(&self.bytes)
        )
    }
}
