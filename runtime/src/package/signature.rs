//! Signatures beside packages, in the format of minisign: the stock tool checks them too. The only file that knows
//! `minisign_verify`.
//!
//! In: the bytes of a package and of its signature, keys that are trusted. Out: the key that signed it, or a refusal.

use super::Refusal;
use minisign_verify::{PublicKey, Signature};
use std::fs;
use std::path::{Path, PathBuf};

/// What is appended to the name of a package for that of its signature.
pub const EXTENSION: &str = "minisig";
/// Where the keys lie that a rig's computer trusts: files that end in `.pub`.
pub const TRUSTED: &str = "/etc/fric/trusted";

/// The signature's file beside a package's: `rtfs.fricpkg.minisig`.
pub fn beside(package: &Path) -> PathBuf {
    let mut name = package.file_name().map(|name| name.to_os_string()).unwrap_or_default();
    name.push(format!(".{EXTENSION}"));
    package.with_file_name(name)
}

/// Keys that are trusted.
pub struct Trusted(Vec<(String, PublicKey)>);

impl Trusted {
    /// The keys in a folder, by the names of their files. There are none if there is no folder.
    ///
    /// # Errors
    /// The key that cannot be read, and why: a key that is meant to protect must not be passed over.
    pub fn in_folder(folder: &Path) -> Result<Trusted, String> {
        let entries = match fs::read_dir(folder) {
            Ok(entries) => entries,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Trusted(Vec::new())),
            Err(error) => return Err(format!("cannot read the trusted keys in {}: {error}", folder.display())),
        };
        let mut keys = Vec::new();
        for entry in entries {
            let path = entry.map_err(|error| format!("cannot read {}: {error}", folder.display()))?.path();
            if path.extension().is_none_or(|extension| extension != "pub") {
                continue;
            }
            let text = fs::read_to_string(&path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
            let key = PublicKey::decode(&text)
                .map_err(|why| format!("{} is no public key of minisign: {why}", path.display()))?;
            let name = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
            keys.push((name, key));
        }
        keys.sort_by(|a, b| a.0.cmp(&b.0));
        Ok(Trusted(keys))
    }

    /// Whether none is trusted: then signatures are not asked for.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The name of the key that signed some bytes; none if no key is trusted.
    ///
    /// # Errors
    /// If keys are trusted and none of them signed it.
    pub fn signer(&self, bytes: &[u8], signature: Option<&str>) -> Result<Option<&str>, Refusal> {
        if self.is_empty() {
            return Ok(None);
        }
        let names = || self.0.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>().join(", ");
        let Some(text) = signature else {
            return Err(Refusal::Signature(format!(
                "it is not signed, and this computer trusts {} only: build it with `--sign KEY`",
                names()
            )));
        };
        let signature = Signature::decode(text)
            .map_err(|why| Refusal::Signature(format!("its signature cannot be read: {why}")))?;
        for (name, key) in &self.0 {
            if key.verify(bytes, &signature, false).is_ok() {
                return Ok(Some(name));
            }
        }
        Err(Refusal::Signature(format!("its signature is not that of {}, whom this computer trusts", names())))
    }
}
