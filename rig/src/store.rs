//! Store of installed packages: one is current, the previous one is kept, and a change is atomic.
//!
//! ```text
//! DIR/packages/HASH.fricpkg    every package under its hash, with its signature
//! DIR/current -> packages/…    runs when the rig is started next
//! DIR/previous -> packages/…   target of `rollback`
//! DIR/log/                     recordings
//! DIR/lock                     locked by the rig that runs here
//! ```
//! A package is written under a temporary name, flushed to the disk and renamed; a link is created under a temporary
//! name and renamed over the old one. So after a power failure there is either the old state or the new one.

use runtime::package::hash;
use runtime::package::signature::EXTENSION as SIGNATURE;
use std::fs::{self, File, TryLockError};
use std::io::{self, Write};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Default folder of the packages.
pub const DEFAULT: &str = "/var/lib/fric";

/// Locked by the rig that runs here; contains its process id.
const LOCK: &str = "lock";

/// A folder of packages.
#[derive(Clone)]
pub struct Store {
    dir: PathBuf,
}

impl Store {
    /// A store in a folder, which need not exist yet.
    pub fn at(dir: &Path) -> Store {
        Store { dir: dir.to_path_buf() }
    }

    /// Target of the link for the package with this SHA-256.
    pub fn target(hash: &str) -> PathBuf {
        let name: String = hash.chars().take(32).collect();
        Path::new("packages").join(format!("{name}.{}", runtime::package::EXTENSION))
    }

    /// Makes a verified package the current one. `rig`: its name; `signature`: the text beside it.
    ///
    /// # Errors
    /// A message; the current package is unchanged then.
    pub fn install(&self, rig: &str, bytes: &[u8], signature: Option<&str>) -> Result<String, String> {
        let packages = self.dir.join("packages");
        let about = |path: &Path, error: io::Error| format!("cannot write {}: {error}", path.display());
        for folder in [&packages, &self.dir.join("log")] {
            fs::create_dir_all(folder).map_err(|error| about(folder, error))?;
        }
        let target = Store::target(&hash(bytes));
        let path = self.dir.join(&target);
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        whole(&path, bytes).map_err(|error| about(&path, error))?;
        let beside = packages.join(format!("{name}.{SIGNATURE}"));
        // Without a signature, an older signature of the same bytes does no harm.
        if let Some(text) = signature {
            whole(&beside, text.as_bytes()).map_err(|error| about(&beside, error))?;
        }
        let before = fs::read_link(self.dir.join("current")).ok();
        if before.as_deref() == Some(&target) {
            return Ok(format!("{rig} is the current package already\n"));
        }
        if let Some(before) = &before {
            self.link("previous", before)?;
        }
        self.link("current", &target)?;
        Ok(format!("{rig} is the current package: {name}\n"))
    }

    /// Makes the previous package the current one again.
    ///
    /// # Errors
    /// If there is none, or the operation fails.
    pub fn rollback(&self) -> Result<String, String> {
        let current = self.current_target();
        let said = self.fall_back()?;
        if let Some(current) = current {
            self.link("previous", &current)?;
        }
        Ok(said)
    }

    /// Like [`rollback`](Self::rollback), for a package that does not start: it does not become the previous package,
    /// so that nothing returns to it automatically.
    ///
    /// # Errors
    /// If there is no previous package, or the operation fails.
    pub fn fall_back(&self) -> Result<String, String> {
        let Some(previous) = self.before() else {
            return Err(format!("there is no package before the current one in {}", self.dir.display()));
        };
        if !self.dir.join(&previous).is_file() {
            return Err(format!("{} is gone", previous.display()));
        }
        self.link("current", &previous)?;
        Ok(format!("back to {}\n", previous.display()))
    }

    /// The previous package; none if it is the current one again.
    fn before(&self) -> Option<PathBuf> {
        let previous = fs::read_link(self.dir.join("previous")).ok();
        previous.filter(|previous| Some(previous) != self.current_target().as_ref())
    }

    /// Prevents other rigs in this folder while the file is open: the system releases the lock however the process
    /// ends.
    ///
    /// # Errors
    /// If another rig runs, or the folder cannot be used.
    pub fn lock(&self) -> Result<File, String> {
        let path = self.dir.join(LOCK);
        let about = |error: io::Error| format!("cannot use {}: {error}; --dir names another folder", path.display());
        fs::create_dir_all(&self.dir).map_err(about)?;
        let mut file =
            File::options().read(true).write(true).create(true).truncate(false).open(&path).map_err(about)?;
        let mut looks = 5;
        while let Err(why) = file.try_lock() {
            match why {
                TryLockError::Error(error) => return Err(about(error)),
                // Another process may just be checking whether a rig runs.
                TryLockError::WouldBlock if looks > 0 => {
                    looks -= 1;
                    std::thread::sleep(Duration::from_millis(10));
                }
                TryLockError::WouldBlock => {
                    let process = fs::read_to_string(&path).unwrap_or_default();
                    return Err(format!(
                        "a rig runs in {} already, process {}: `fric-rig status` says which, `fric-rig say stop` ends it",
                        self.dir.display(),
                        process.trim()
                    ));
                }
            }
        }
        file.set_len(0).and_then(|()| writeln!(file, "{}", std::process::id())).map_err(about)?;
        Ok(file)
    }

    /// Whether a rig runs here.
    pub fn is_locked(&self) -> bool {
        let file = File::open(self.dir.join(LOCK));
        file.is_ok_and(|file| matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock)))
    }

    /// Target of the link of the current package.
    pub fn current_target(&self) -> Option<PathBuf> {
        fs::read_link(self.dir.join("current")).ok()
    }

    /// The file of the current package.
    pub fn current(&self) -> Option<PathBuf> {
        self.current_target().map(|target| self.dir.join(target))
    }

    /// Whether there is a previous package to return to.
    pub fn took_over(&self) -> bool {
        self.before().is_some()
    }

    /// Installed packages and the running one, as text.
    ///
    /// # Errors
    /// If nothing is installed.
    pub fn status(&self) -> Result<String, String> {
        let mut words = String::new();
        for (name, target) in [("current", self.current_target()), ("previous", self.before())] {
            if let Some(target) = target {
                words += &format!("{name}: {}\n", target.display());
            }
        }
        // The state of a killed process remains.
        if let Ok(state) = fs::read_to_string(self.dir.join("state"))
            && self.is_locked()
        {
            words += &format!("runs: {state}");
        }
        if words.is_empty() { Err(format!("nothing is installed in {}", self.dir.display())) } else { Ok(words) }
    }

    /// Sets a link to a package atomically.
    fn link(&self, name: &str, target: &Path) -> Result<(), String> {
        let (link, fresh) = (self.dir.join(name), self.dir.join(format!(".{name}.{}", std::process::id())));
        let done = fs::remove_file(&fresh)
            .or_else(|error| if error.kind() == io::ErrorKind::NotFound { Ok(()) } else { Err(error) })
            .and_then(|()| symlink(target, &fresh))
            .and_then(|()| fs::rename(&fresh, &link))
            .and_then(|()| File::open(&self.dir)?.sync_all());
        done.map_err(|error| format!("cannot set {}: {error}", link.display()))
    }
}

/// Writes a file completely or not at all, and flushes it to the disk before it gets its name.
fn whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let fresh = path.with_file_name(format!(".{name}.{}", std::process::id()));
    // A file of that name is from a killed process.
    let _ = fs::remove_file(&fresh);
    let mut file = File::create_new(&fresh)?;
    let written = file.write_all(bytes).and_then(|()| file.sync_all()).and_then(|()| fs::rename(&fresh, path));
    if written.is_err() {
        let _ = fs::remove_file(&fresh);
    }
    written
}

#[cfg(test)]
mod tests {
    use super::*;
    use runtime::package::Package;

    fn packed(rig: &str) -> Vec<u8> {
        Package { rig: rig.into(), ..Package::default() }.to_bytes()
    }

    fn install(store: &Store, rig: &str) -> String {
        store.install(rig, &packed(rig), None).unwrap()
    }

    fn current(dir: &Path) -> Package {
        Package::read(&fs::read(dir.join("current")).unwrap()).unwrap()
    }

    #[test]
    fn the_previous_package_is_kept_and_can_be_restored() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::at(dir.path());
        assert!(store.status().unwrap_err().starts_with("nothing is installed in "));
        assert!(store.rollback().unwrap_err().starts_with("there is no package before"));
        install(&store, "one");
        assert_eq!(current(dir.path()).rig, "one");
        assert!(store.rollback().is_err(), "there was none before the first");
        install(&store, "two");
        assert_eq!(current(dir.path()).rig, "two");
        assert!(install(&store, "two").ends_with("already\n"));
        store.rollback().unwrap();
        assert_eq!(current(dir.path()).rig, "one");
        store.rollback().unwrap();
        assert_eq!(current(dir.path()).rig, "two", "there and back");
        assert_eq!(store.status().unwrap().lines().count(), 2);
        // A package that did not start is not returned to.
        store.fall_back().unwrap();
        assert_eq!(current(dir.path()).rig, "one");
        assert!(!store.took_over() && store.fall_back().is_err() && store.rollback().is_err());
        assert_eq!(store.status().unwrap().lines().count(), 1);
    }

    #[test]
    fn one_rig_runs_in_a_folder() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::at(&dir.path().join("new"));
        assert!(!store.is_locked());
        let held = store.lock().unwrap();
        assert!(store.is_locked());
        let why = store.lock().unwrap_err();
        assert!(why.contains(&format!("already, process {}:", std::process::id())), "{why}");
        drop(held);
        assert!(!store.is_locked() && store.lock().is_ok());
    }

    #[test]
    fn an_interrupted_change_leaves_the_current_package() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::at(dir.path());
        install(&store, "one");
        // Half a copy, and a link that was not renamed any more.
        let half = packed("two");
        fs::write(dir.path().join("packages/.half.fricpkg.1"), &half[..half.len() / 2]).unwrap();
        symlink("packages/.half.fricpkg.1", dir.path().join(format!(".current.{}", std::process::id()))).unwrap();
        assert_eq!(current(dir.path()).rig, "one");
        install(&store, "three");
        assert_eq!(current(dir.path()).rig, "three");
    }
}
