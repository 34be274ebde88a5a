//! Opens packages for running: they are verified completely before their content is decoded.
//!
//! In: a file, trusted keys. Out: an [`Open`] package, or the reason of its refusal.

use abi::Instance;
use abi::rig::Bus;
use runtime::format::utc;
use runtime::hil::live::Judge;
use runtime::package::contents::Contents;
use runtime::package::signature::{Signer, Trusted, beside};
use runtime::package::{MOST_BYTES, Package, hash};
use runtime::record::log::Sections;
use std::fs;
use std::path::Path;

/// Version of this program: packages must be made by the same version.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// A package that may run here.
pub struct Open {
    /// The bytes of its file.
    pub bytes: Vec<u8>,
    /// The text of its signature, if there is one beside it.
    pub signature: Option<String>,
    /// The package.
    pub package: Package,
    /// Its decoded parts.
    pub contents: Contents,
    /// Its signer, if signatures are required.
    pub signer: Option<Signer>,
}

/// The bytes of a package and the text of its signature, if there is one beside it.
fn read(path: &Path) -> Result<(Vec<u8>, Option<String>), String> {
    let about = |why: &dyn std::fmt::Display| format!("{}: {why}", path.display());
    let found = fs::metadata(path).map_err(|error| about(&error))?;
    if !found.is_file() {
        return Err(about(&"it is no file"));
    }
    if found.len() > MOST_BYTES {
        return Err(about(&format!("{} bytes are more than any package has", found.len())));
    }
    let bytes = fs::read(path).map_err(|error| about(&error))?;
    match fs::read_to_string(beside(path)) {
        Ok(text) => Ok((bytes, Some(text))),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok((bytes, None)),
        Err(error) => Err(format!("{}: {error}", beside(path).display())),
    }
}

/// Reads and verifies a package.
///
/// # Errors
/// A message with the reason of its refusal.
pub fn open(path: &Path, trusted: &Path) -> Result<Open, String> {
    let about = |why: &dyn std::fmt::Display| format!("{}: {why}", path.display());
    let (bytes, signature) = read(path)?;
    // The signature is verified first: nothing of an unknown maker is decoded.
    let keys = Trusted::in_folder(trusted)?;
    let signer = keys.signer(&bytes, signature.as_deref()).map_err(|why| about(&why))?;
    let package = Package::read(&bytes).map_err(|why| about(&why))?;
    package.fits(VERSION).map_err(|why| about(&why))?;
    let contents = package.contents().map_err(|why| about(&why))?;
    let programs = [("control", &contents.control), ("plant", &contents.plant), ("judge", &contents.judge)];
    for (name, image) in programs {
        image.fits().map_err(|why| about(&format!("its program `{name}`: {why}")))?;
    }
    Ok(Open { bytes, signature, package, contents, signer })
}

/// Refuses a package that was signed before another one.
///
/// # Errors
/// If the package at `current` is signed by a trusted key, and this one was signed earlier or has no time.
pub fn not_older(open: &Open, current: &Path, trusted: &Path) -> Result<(), String> {
    let Ok((bytes, signature)) = read(current) else { return Ok(()) };
    let installed = Trusted::in_folder(trusted)?.signer(&bytes, signature.as_deref()).ok().flatten();
    let Some(since) = installed.and_then(|signer| signer.signed_s) else { return Ok(()) };
    let signed = open.signer.as_ref().and_then(|signer| signer.signed_s);
    if bytes == open.bytes || signed.is_some_and(|signed| signed >= since) {
        return Ok(());
    }
    let when =
        signed.map_or("its signature does not say when".into(), |signed| format!("it was signed at {}", utc(signed)));
    Err(format!(
        "it is older than the package that is installed: {when}, and that one at {}; --allow-older installs it all the \
         same, `fric-rig rollback` goes back to the package before the current one",
        utc(since)
    ))
}

impl Open {
    /// Refuses to run a package without a trusted signature where a real drive may be moved.
    ///
    /// # Errors
    /// If no trusted key signed it, one of these buses is not simulated, and `allowed` is false.
    pub fn may_run(&self, buses: &[Bus], simulated: bool, allowed: bool) -> Result<(), String> {
        let real = buses.iter().find(|bus| !bus.address.starts_with("sim:"));
        let Some(bus) = real.filter(|_| self.signer.is_none() && !simulated && !allowed) else { return Ok(()) };
        let lacks = match self.signature {
            Some(_) => "this computer trusts no key that could have signed it",
            None => "it is not signed",
        };
        Err(format!(
            "{lacks}, and bus `{}` is {}: only rigs whose buses are all `sim:` run so. `fric deploy` signs a package and \
             registers its key here, `fric-rig trust NAME KEY` registers one by hand; --allow-unsigned runs it all the same",
            bus.name, bus.address
        ))
    }

    /// The head of its logs.
    pub fn head(&self) -> Sections {
        self.contents.head.clone()
    }

    /// The judge of parameter changes at run time.
    ///
    /// # Errors
    /// The reason why it does not match the control program.
    pub fn judge(&self, control: &Instance) -> Result<Judge, String> {
        Judge::new(self.contents.live.clone(), self.program("judge")?, control)
    }

    /// One of its programs, ready to start: `control`, `plant` or `judge`.
    ///
    /// # Errors
    /// The reason why it cannot be loaded.
    pub fn program(&self, name: &str) -> Result<Instance, String> {
        let bytes = self.package.section(name).map_err(|why| why.to_string())?;
        // SAFETY: `fric build` wrote these bytes, as all hashes confirm, and, where keys are trusted, a signature. On a
        // computer without keys the person who installs a package vouches for it.
        let model = unsafe { runtime::image::load(bytes) };
        model.map(|model| model.instance()).map_err(|why| format!("its program `{name}`: {why}"))
    }

    /// Its description as text.
    pub fn describe(&self) -> String {
        let Package { fric, target, rig, sections } = &self.package;
        let signer = match (&self.signer, &self.signature) {
            (Some(Signer { name, signed_s: Some(at) }), _) => format!("signed by {name} at {}", utc(*at)),
            (Some(Signer { name, signed_s: None }), _) => format!("signed by {name}"),
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
