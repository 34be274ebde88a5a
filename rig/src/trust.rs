//! Lists and registers the keys that this computer trusts.
//!
//! In: a folder, a name and a public key. Out: the keys in it, or one more. An existing key is never replaced: its file
//! must be removed first.

use abi::foreign::is_component;
use runtime::package::signature::{Trusted, public_key};
use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::Path;

/// The keys of a folder, one per line: name and key.
///
/// # Errors
/// The key that cannot be read.
pub fn keys(folder: &Path) -> Result<String, String> {
    let trusted = Trusted::in_folder(folder)?;
    Ok(trusted.keys().map(|(name, key)| format!("{name} {key}\n")).collect())
}

/// Registers a key. `first`: only if no key is trusted yet.
///
/// # Errors
/// The reason why it is not registered.
pub fn register(folder: &Path, name: &str, key: &str, first: bool) -> Result<String, String> {
    if !is_component(name) {
        return Err(format!("{name:?} is no name of a key: it becomes that of a file"));
    }
    let key = public_key(key)?;
    let trusted = Trusted::in_folder(folder)?;
    if let Some((known, _)) = trusted.keys().find(|(_, known)| *known == key) {
        return Ok(format!("the key is trusted already, as {known}\n"));
    }
    if first && !trusted.is_empty() {
        return Err(format!("{} has a key already; without --first it gets another one", folder.display()));
    }
    let path = folder.join(format!("{name}.pub"));
    let about = |error: std::io::Error| match error.kind() {
        ErrorKind::AlreadyExists => format!("{} is another key; give this one another name", path.display()),
        _ => format!("cannot write {}: {error}", path.display()),
    };
    fs::create_dir_all(folder).map_err(about)?;
    // A key must be read completely or not at all: it is written to a temporary file and linked to its name, which
    // fails if that exists.
    let fresh = folder.join(format!(".{name}.{}", std::process::id()));
    let text = format!("untrusted comment: public key {name}, registered by fric-rig\n{key}\n");
    let written = File::create_new(&fresh)
        .and_then(|mut file| file.write_all(text.as_bytes()).and_then(|()| file.sync_all()))
        .and_then(|()| fs::hard_link(&fresh, &path));
    let _ = fs::remove_file(&fresh);
    written.map_err(about)?;
    Ok(format!("registered key {name}: packages must be signed by a key in {} now\n", folder.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: &str = "RWQf6LRCGA9i53mlYecO4IzT51TGPpvWucNSCh1CBM0QTaLn73Y7GFO3";
    const B: &str = "RWRzSSJW6ESjcrZzrMXKtb7KAoN8B4ZKVpQhVMDdxzX0wCMhmQHpNUjW";

    #[test]
    fn a_key_is_registered_once_and_never_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("trusted");
        assert_eq!(keys(&folder).unwrap(), "");
        assert!(register(&folder, "anna", A, true).unwrap().starts_with("registered key anna"));
        assert_eq!(keys(&folder).unwrap(), format!("anna {A}\n"));
        assert!(register(&folder, "again", A, true).unwrap().contains("trusted already, as anna"));
        assert!(register(&folder, "anna", B, false).unwrap_err().contains("is another key"));
        assert!(register(&folder, "bert", B, true).unwrap_err().contains("has a key already"));
        assert!(register(&folder, "bert", &format!("untrusted comment: x\n{B}\n"), false).is_ok());
        assert_eq!(keys(&folder).unwrap().lines().count(), 2);
        for name in ["../x", "", "a/b", "-x", "a\u{7}"] {
            assert!(register(&folder, name, A, false).unwrap_err().contains("is no name of a key"), "{name:?}");
        }
        assert!(register(&folder, "c", "nonsense", false).unwrap_err().contains("no public key"));
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 2, "nothing half is left");
    }
}
