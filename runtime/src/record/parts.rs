//! A log in several files: their names, how many are kept, and the free space for them.
//!
//! In: the path of a log and its size limits. Out: files, opened one after the other. Knows nothing of their contents.
//!
//! The first part has the requested name, `rtfs.friclog`; those that follow have their number before the extension,
//! `rtfs.2.friclog`, `rtfs.3.friclog`, …

use super::claim::is_locked;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Free space below which a running rig reports it: some hours of a log at 1 kHz.
const LITTLE: u64 = 1_000_000_000;

/// The file extension of logs.
pub const ENDING: &str = "friclog";

/// Size limits of a log.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Limits {
    /// Size in bytes after which the next part begins; at most a quarter of `keep`.
    pub part: u64,
    /// Total bytes of all logs in the folder; the oldest files are removed. None: all are kept.
    pub keep: Option<u64>,
    /// Bytes of the disk that a log leaves free; it stops growing there.
    pub reserve: u64,
}

impl Default for Limits {
    /// Parts of 256 MB, all of them kept; 64 MB of the disk are reserved.
    fn default() -> Limits {
        Limits { part: 256_000_000, keep: None, reserve: 64_000_000 }
    }
}

/// The storage of a log's files.
pub trait Disk: Send {
    /// Opens part `number` of the log whose first part is `first`.
    ///
    /// # Errors
    /// Those of the files.
    fn create(&self, first: &Path, number: u32) -> io::Result<Box<dyn Write + Send>>;
    /// Free bytes on the disk of this file.
    ///
    /// # Errors
    /// Those of the operating system.
    fn free(&self, path: &Path) -> io::Result<u64>;
}

/// The file system of the operating system.
pub struct System;

impl Disk for System {
    fn create(&self, first: &Path, number: u32) -> io::Result<Box<dyn Write + Send>> {
        Ok(Box::new(create(first, number)?))
    }
    fn free(&self, path: &Path) -> io::Result<u64> {
        free(path)
    }
}

/// Parses a number of bytes: `256MB`, `10 GB`, `1.5 TB`; powers of 1000.
///
/// # Errors
/// What is wrong with it, in words.
pub fn bytes(text: &str) -> Result<u64, String> {
    let text = text.trim();
    let (number, unit) = text.split_at(text.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(text.len()));
    let factor = match unit {
        "kB" | "KB" => 1e3,
        "MB" => 1e6,
        "GB" => 1e9,
        "TB" => 1e12,
        _ => return Err("write a size with its unit, such as 256MB or 10GB".into()),
    };
    match number.trim().parse::<f64>() {
        Ok(number) if number > 0.0 && number * factor <= 1e18 => Ok((number * factor).round() as u64),
        _ => Err(format!("`{number}` is no size: write 256MB or 10GB")),
    }
}

/// A number of bytes as the text of an option that [`bytes`] parses.
pub fn option(bytes: u64) -> String {
    format!("{}kB", bytes as f64 / 1e3)
}

/// Formats a number of bytes: `12.3 MB`, `45.2 GB`.
pub fn size(bytes: u64) -> String {
    match bytes as f64 {
        bytes if bytes < 1e9 => format!("{:.1} MB", bytes * 1e-6),
        bytes => format!("{:.1} GB", bytes * 1e-9),
    }
}

/// A warning about little free space for a log; none if there is enough, or if it is unknown (0).
pub fn warning(free: u64) -> Option<String> {
    (0 < free && free < LITTLE).then(|| format!("the log has {} left on its disk", size(free)))
}

/// The path of part `number` (from 1) of the log whose first part is `first`.
pub fn path(first: &Path, number: u32) -> PathBuf {
    match (number, first.extension()) {
        (0 | 1, _) => first.to_path_buf(),
        (_, Some(ending)) => first.with_extension(format!("{number}.{}", ending.to_string_lossy())),
        (_, None) => first.with_extension(number.to_string()),
    }
}

/// The path of the part after part `number` at this path.
pub fn following(this: &Path, number: u32) -> PathBuf {
    let name = this.file_name().unwrap_or_default().to_string_lossy();
    let (stem, ending) = name.rsplit_once('.').map_or((&*name, None), |(stem, ending)| (stem, Some(ending)));
    let first = match (stem.strip_suffix(&format!(".{number}")), ending) {
        _ if number <= 1 => name.to_string(),
        (Some(stem), Some(ending)) => format!("{stem}.{ending}"),
        (None, Some(ending)) if ending == number.to_string() => stem.to_string(),
        _ => name.to_string(),
    };
    path(&this.with_file_name(first), number + 1)
}

/// Creates the folder of a file, if it is missing.
///
/// # Errors
/// Those of the operating system.
pub fn make_folder_of(path: &Path) -> io::Result<()> {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => fs::create_dir_all(folder),
        _ => Ok(()),
    }
}

/// Opens part `number`. The first part removes the parts of an earlier log of its name, so that a reader does not take
/// them for parts of this one.
///
/// # Errors
/// Those of the files.
pub fn create(first: &Path, number: u32) -> io::Result<File> {
    let file = File::create(path(first, number))?;
    // A lock keeps other logs from removing it: see `remove_oldest`. A device cannot be locked, and need not be.
    let _ = file.try_lock();
    if number == 1 {
        for old in (2..).map(|number| path(first, number)).take_while(|old| old.is_file()) {
            fs::remove_file(old)?;
        }
    }
    Ok(file)
}

/// Removes the oldest logs in the folder of `current` until all together have at most `keep` bytes. The current part
/// stays, and so does one that another process is writing. Returns how many files were removed.
///
/// # Errors
/// Those of the files.
pub fn remove_oldest(current: &Path, keep: u64) -> io::Result<u64> {
    let folder = match current.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let mut logs: Vec<(SystemTime, PathBuf, u64)> = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let (path, metadata) = (entry.path(), entry.metadata()?);
        if metadata.is_file() && path.extension().is_some_and(|ending| ending == ENDING) {
            logs.push((metadata.modified()?, path, metadata.len()));
        }
    }
    logs.sort();
    let mut total: u64 = logs.iter().map(|(_, _, bytes)| bytes).sum();
    let mut removed = 0;
    for (_, path, bytes) in logs {
        if total <= keep {
            break;
        }
        if path.file_name() != current.file_name() && !is_locked(&path) {
            fs::remove_file(&path)?;
            (total, removed) = (total - bytes, removed + 1);
        }
    }
    Ok(removed)
}

/// Free bytes on the disk of this file or folder.
///
/// # Errors
/// Those of the operating system.
#[cfg(unix)]
pub fn free(path: &Path) -> io::Result<u64> {
    let disk = rustix::fs::statvfs(path)?;
    Ok(disk.f_bavail * disk.f_frsize)
}

/// Rigs, which write logs, run on Linux.
///
/// # Errors
/// Always: the number is unknown here.
#[cfg(not(unix))]
pub fn free(_: &Path) -> io::Result<u64> {
    Err(io::ErrorKind::Unsupported.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn each_part_names_the_next() {
        for first in ["out/rtfs.friclog", "a.2.friclog", "log", "x.y.friclog"].map(Path::new) {
            let mut this = path(first, 1);
            assert_eq!(this, first);
            for number in 1..12 {
                this = following(&this, number);
                assert_eq!(this, path(first, number + 1));
            }
        }
        assert_eq!(path(Path::new("out/rtfs.friclog"), 3), Path::new("out/rtfs.3.friclog"));
    }

    #[test]
    fn a_new_log_removes_the_parts_of_an_old_one() {
        let folder = tempfile::tempdir().unwrap();
        let first = folder.path().join("a.friclog");
        (1..=3).for_each(|number| drop(create(&first, number).unwrap()));
        fs::write(folder.path().join("b.2.friclog"), "").unwrap();
        create(&first, 1).unwrap();
        let mut names: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        assert_eq!(names, ["a.friclog", "b.2.friclog"]);
    }

    #[test]
    fn only_the_oldest_logs_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let named = |name: &str| folder.path().join(name);
        let now = SystemTime::now();
        for (age, name) in (0..).zip(["now.friclog", "c.friclog", "b.friclog", "a.friclog", "notes.txt"]) {
            fs::write(named(name), [0; 100]).unwrap();
            let file = File::options().write(true).open(named(name)).unwrap();
            file.set_modified(now - Duration::from_secs(100 * age)).unwrap();
        }
        assert_eq!(remove_oldest(&named("now.friclog"), 400).unwrap(), 0);
        // A file that is being written stays, however old.
        let written = File::open(named("a.friclog")).unwrap();
        written.try_lock().unwrap();
        assert_eq!(remove_oldest(&named("now.friclog"), 399).unwrap(), 1);
        assert!(named("a.friclog").exists() && !named("b.friclog").exists());
        drop(written);
        fs::write(named("b.friclog"), [0; 100]).unwrap();
        File::options()
            .write(true)
            .open(named("b.friclog"))
            .unwrap()
            .set_modified(now - Duration::from_secs(200))
            .unwrap();
        assert_eq!(remove_oldest(&named("now.friclog"), 299).unwrap(), 2);
        assert!(!named("a.friclog").exists() && !named("b.friclog").exists() && named("c.friclog").exists());
        assert_eq!(remove_oldest(&named("now.friclog"), 0).unwrap(), 1);
        assert!(named("now.friclog").exists() && named("notes.txt").exists());
    }

    #[test]
    fn sizes_have_units() {
        assert_eq!(
            ["256MB", " 1.5 GB ", "2TB", "1kB"].map(bytes),
            [256_000_000, 1_500_000_000, 2_000_000_000_000, 1000].map(Ok)
        );
        for size in [1, 999, 1500, 256_000_000, 12_345_678_901] {
            assert_eq!(bytes(&option(size)), Ok(size));
        }
        for wrong in ["", "12", "MB", "-1 MB", "0 GB", "nan GB", "inf TB", "1e20 TB", "3 mB", "3 MBs"] {
            assert!(bytes(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_disk_has_room() {
        assert!(free(tempfile::tempdir().unwrap().path()).unwrap() > 0);
        assert!(free(Path::new("nowhere/at/all")).is_err());
    }
}
