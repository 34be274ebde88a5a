//! Signatures of packages in the format of minisign, which the minisign tool can verify too. The only file that uses
//! `minisign_verify`.
//!
//! In: the bytes of a package and of its signature, trusted keys. Out: the key that signed it, or a refusal.

use super::Refusal;
use minisign_verify::{PublicKey, Signature};
use std::fs;
use std::path::{Path, PathBuf};

/// Extension that is appended to a package's file name for its signature.
pub const EXTENSION: &str = "minisig";
/// Folder of the keys that a rig's computer trusts: files that end in `.pub`.
pub const TRUSTED: &str = "/etc/fric/trusted";

/// The signature file beside a package: `rtfs.fricpkg.minisig`.
pub fn beside(package: &Path) -> PathBuf {
    let mut name = package.file_name().map(|name| name.to_os_string()).unwrap_or_default();
    name.push(format!(".{EXTENSION}"));
    package.with_file_name(name)
}

/// The trusted keys.
pub struct Trusted(Vec<Key>);

/// A trusted public key.
struct Key {
    /// The name of its file, without the extension.
    name: String,
    /// Its base64 text.
    text: String,
    key: PublicKey,
}

/// The signer of a package, and the time.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Signer {
    /// The name of the key.
    pub name: String,
    /// Time in s since 1970, from the trusted comment, which is signed too; none if the comment has no time.
    pub signed_s: Option<u64>,
}

/// Prefix of the time in the trusted comment of a signature; the minisign tool writes it too.
const TIMESTAMP: &str = "timestamp:";

/// The trusted comment of a new signature. The time is here and not in the package, so that equal texts still result in
/// equal packages; it is signed like the package.
pub fn comment(what: &str, now_s: u64) -> String {
    format!("{what}, {TIMESTAMP}{now_s}")
}

/// The time in a trusted comment.
fn timestamp(comment: &str) -> Option<u64> {
    let (_, rest) = comment.split_once(TIMESTAMP)?;
    let digits = rest.find(|c: char| !c.is_ascii_digit()).map_or(rest, |end| &rest[..end]);
    digits.parse().ok()
}

/// The base64 text of a public key, from the text of its file or alone.
///
/// # Errors
/// If it is no public key of minisign.
pub fn public_key(text: &str) -> Result<String, String> {
    let line = text.lines().map(str::trim).rfind(|line| !line.is_empty()).unwrap_or_default();
    match PublicKey::from_base64(line) {
        Ok(_) => Ok(line.to_string()),
        Err(why) => Err(format!("it is no public key of minisign: {why}")),
    }
}

impl Trusted {
    /// The keys in a folder, with the names of their files. Empty if the folder does not exist.
    ///
    /// # Errors
    /// The key that cannot be read, and the reason: a key that is meant to protect must not be skipped.
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
            let text = public_key(&text).map_err(|why| format!("{}: {why}", path.display()))?;
            keys.push(Key { name, text, key });
        }
        keys.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(Trusted(keys))
    }

    /// Whether no key is trusted: signatures are not required then.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Names and base64 texts of the keys, in the order of the names.
    pub fn keys(&self) -> impl Iterator<Item = (&str, &str)> {
        self.0.iter().map(|key| (key.name.as_str(), key.text.as_str()))
    }

    /// The key that signed some bytes; none if no key is trusted.
    ///
    /// # Errors
    /// If keys are trusted and none of them signed it.
    pub fn signer(&self, bytes: &[u8], signature: Option<&str>) -> Result<Option<Signer>, Refusal> {
        if self.is_empty() {
            return Ok(None);
        }
        let names = || self.0.iter().map(|key| key.name.as_str()).collect::<Vec<_>>().join(", ");
        let Some(text) = signature else {
            return Err(Refusal::Signature(format!(
                "it is not signed, and this computer trusts {} only: `fric deploy` signs it, or `fric build --sign KEY`",
                names()
            )));
        };
        let signature = Signature::decode(text)
            .map_err(|why| Refusal::Signature(format!("its signature cannot be read: {why}")))?;
        if let Some(by) = self.0.iter().find(|key| key.key.verify(bytes, &signature, false).is_ok()) {
            return Ok(Some(Signer { name: by.name.clone(), signed_s: timestamp(signature.trusted_comment()) }));
        }
        Err(Refusal::Signature(format!("its signature is not that of {}, whom this computer trusts", names())))
    }
}
