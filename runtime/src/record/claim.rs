//! Exclusive write access to a file, across processes.
//!
//! In: a path. Out: a locked file, or the information that another process holds it. If the file itself may be renamed
//! or removed meanwhile, a lock file beside it is locked. The operating system releases the lock however the process
//! ends.

use same_file::Handle;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

/// Opens a file, created if missing, and locks it; none if another process has locked it.
///
/// # Errors
/// Those of the file.
pub fn open_alone(path: &Path) -> io::Result<Option<File>> {
    loop {
        let file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Ok(None),
            Err(TryLockError::Error(error)) => return Err(error),
        }
        // A process that has ended meanwhile may have removed its lock file: a lock on the removed file excludes
        // nobody.
        let ours = Handle::from_file(file.try_clone()?)?;
        if Handle::from_path(path).is_ok_and(|there| there == ours) {
            return Ok(Some(file));
        }
    }
}

/// Whether a process has locked a file.
pub fn is_locked(path: &Path) -> bool {
    let file = File::open(path);
    file.is_ok_and(|file| matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock)))
}

/// The lock file of a claim.
fn lock_file(path: &Path) -> PathBuf {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    path.with_file_name(format!(".{name}.lock"))
}

/// Whether a process holds the claim on a file.
pub fn is_claimed(path: &Path) -> bool {
    is_locked(&lock_file(path))
}

/// Exclusive write access to a file and to files named after it.
pub struct Claim {
    lock: PathBuf,
    _file: File,
}

impl Claim {
    /// Acquires it with a lock file `.NAME.lock` beside the file, removed at the end. None for a pipe or a device,
    /// which keeps no contents to protect.
    ///
    /// # Errors
    /// If another process holds it, or those of the lock file.
    pub fn on(path: &Path) -> io::Result<Option<Claim>> {
        if fs::metadata(path).is_ok_and(|found| !found.is_file()) {
            return Ok(None);
        }
        let lock = lock_file(path);
        match open_alone(&lock)? {
            Some(file) => Ok(Some(Claim { lock, _file: file })),
            None => {
                let why = "another process writes this file; give this one another name";
                Err(io::Error::new(io::ErrorKind::ResourceBusy, why))
            }
        }
    }
}

/// Removes the lock file before releasing the lock on it.
impl Drop for Claim {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.lock);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_process_holds_the_claim_until_it_ends() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.friclog");
        let first = Claim::on(&path).unwrap();
        let why = Claim::on(&path).err().unwrap();
        assert_eq!(why.kind(), io::ErrorKind::ResourceBusy);
        assert!(is_claimed(&path) && !is_claimed(&folder.path().join("b.friclog")));
        assert!(Claim::on(&folder.path().join("b.friclog")).unwrap().is_some());
        drop(first);
        assert!(!is_claimed(&path));
        assert!(Claim::on(&path).unwrap().is_some());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0, "nothing is left behind");
        assert!(Claim::on(Path::new("/dev/null")).unwrap().is_none());
    }

    /// Many threads, repeatedly: never two owners at once.
    #[test]
    fn never_two_have_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        let (inside, taken) = (std::sync::atomic::AtomicU32::new(0), std::sync::atomic::AtomicU32::new(0));
        let order = std::sync::atomic::Ordering::SeqCst;
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    for _ in 0..75 {
                        let claim = loop {
                            match Claim::on(&path) {
                                Ok(claim) => break claim,
                                Err(_) => std::thread::yield_now(),
                            }
                        };
                        assert_eq!(inside.fetch_add(1, order), 0);
                        taken.fetch_add(1, order);
                        inside.fetch_sub(1, order);
                        drop(claim);
                    }
                });
            }
        });
        assert_eq!(taken.load(order), 300, "each of four threads has it 75 times");
    }
}
