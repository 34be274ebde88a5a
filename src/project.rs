//! Reads texts from disk and from the embedded library, and writes files atomically.
//!
//! In: paths and imports. Out: texts, or the reason in words why there is none. Knows nothing of the language.

use runtime::record::blocks;
use std::fs;
use std::io::{self, Write};
use std::path::{Component, Path, PathBuf};
use std::sync::OnceLock;

/// The library: dotted name of each file (`std.friction.lugre`) and its text, sorted by name.
const LIBRARY: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/library.rs"));

/// The library: dotted name and text of each file.
pub fn library() -> &'static [(&'static str, &'static str)] {
    LIBRARY
}

/// Longest accepted text; a longer file was not written by hand.
const MOST_BYTES: u64 = 64 << 20;
/// Largest accepted recording: 10⁷ rows of ten columns.
const MOST_OF_RECORDING: u64 = 1 << 30;

/// The name of the standard input, and of the standard output, in the place of a file.
const STANDARD: &str = "-";

/// Whether a path stands for the standard input or output.
pub fn is_standard(path: &Path) -> bool {
    path == Path::new(STANDARD)
}

/// Reads a text; `-` is the standard input.
///
/// # Errors
/// Why not, in words.
pub fn read(path: &Path) -> Result<String, String> {
    if is_standard(path) {
        // It can be read once only.
        static INPUT: OnceLock<Result<String, String>> = OnceLock::new();
        return INPUT.get_or_init(read_input).clone();
    }
    text(read_bytes(path, MOST_BYTES)?)
}

fn read_bytes(path: &Path, most: u64) -> Result<Vec<u8>, String> {
    let about = |error: io::Error| match error.kind() {
        io::ErrorKind::NotFound => "there is no such file".to_string(),
        io::ErrorKind::PermissionDenied => "it may not be read (permission denied)".into(),
        io::ErrorKind::IsADirectory => "it is a folder, not a file".into(),
        _ => error.to_string(),
    };
    let metadata = fs::metadata(path).map_err(about)?;
    if metadata.is_dir() {
        return Err("it is a folder, not a file".into());
    }
    if metadata.len() > most {
        return Err(format!("it is larger than {} MB", most >> 20));
    }
    fs::read(path).map_err(about)
}

/// Reads the text on the standard input.
///
/// # Errors
/// Why not, in words.
pub fn read_input() -> Result<String, String> {
    let mut bytes = Vec::new();
    let mut input = io::Read::take(io::stdin().lock(), MOST_BYTES);
    io::Read::read_to_end(&mut input, &mut bytes).map_err(|error| error.to_string())?;
    text(bytes)
}

fn text(bytes: Vec<u8>) -> Result<String, String> {
    if let Some(at) = bytes.iter().position(|byte| *byte == 0) {
        return Err(format!("it is not a text: byte {at} is zero"));
    }
    String::from_utf8(bytes).map_err(|error| {
        let at = error.utf8_error().valid_up_to();
        let line = error.as_bytes()[..at].iter().filter(|byte| **byte == b'\n').count() + 1;
        format!("it is not a text in UTF-8: line {line}, byte {at} of the file")
    })
}

/// Resolves the imports of a text for the compiler, on disk.
pub struct Disk;

impl crate::compile::Sources for Disk {
    /// A library name refers to its file, or to all files of its folder.
    fn library(&self, module: &str) -> Option<Vec<(String, String)>> {
        let inside = |file: &str| file == module || file.strip_prefix(module).is_some_and(|rest| rest.starts_with('.'));
        let found: Vec<(String, String)> = LIBRARY
            .iter()
            .filter(|(file, _)| inside(file))
            .map(|(file, text)| (format!("{file}.fric"), (*text).to_string()))
            .collect();
        (!found.is_empty()).then_some(found)
    }

    /// `grammar` tests it.
    fn library_is_sound(&self) -> bool {
        true
    }

    fn modules(&self) -> Vec<String> {
        let folder = |file: &str| file.match_indices('.').nth(1).map_or(file, |(at, _)| &file[..at]).to_string();
        let mut folders: Vec<String> = LIBRARY.iter().map(|(file, _)| folder(file)).collect();
        folders.dedup();
        folders
    }

    fn file(&self, from: &str, path: &str) -> Result<(String, String), String> {
        let (path, bytes) = bytes_named(from, path)?;
        if bytes.starts_with(blocks::MAGIC) {
            let log = path.display();
            return Err(format!(
                "it is the log of a rig: give it the ending .friclog, or make a table of it by `fric replay {log} --csv log.csv`"
            ));
        }
        Ok((path.display().to_string(), text(bytes)?))
    }
}

/// The path of a file that the text `from` names, and its bytes.
///
/// # Errors
/// Why it cannot be read, in words.
pub fn bytes_named(from: &str, path: &str) -> Result<(PathBuf, Vec<u8>), String> {
    let path = path_named(from, path)?;
    let is_text = path.extension().is_some_and(|ending| ending == "fric");
    let bytes = read_bytes(&path, if is_text { MOST_BYTES } else { MOST_OF_RECORDING })?;
    Ok((path, bytes))
}

/// The path of a file that the text `from` names; it may be missing.
///
/// # Errors
/// That it is a pipe or a device.
pub fn path_named(from: &str, path: &str) -> Result<PathBuf, String> {
    let folder = Path::new(from).parent().unwrap_or(Path::new(""));
    let path = tidy(&folder.join(path));
    // A pipe named on the command line is intentional; one named in an import would block `check` for ever.
    if fs::metadata(&path).is_ok_and(|found| !found.is_file() && !found.is_dir()) {
        return Err("it is a pipe or a device, not a file".into());
    }
    Ok(path)
}

/// The path without `.` and `folder/..`, so that one file has one name.
fn tidy(path: &Path) -> PathBuf {
    let mut out = PathBuf::new();
    for part in path.components() {
        match part {
            Component::CurDir => {}
            Component::ParentDir if matches!(out.components().next_back(), Some(Component::Normal(_))) => {
                out.pop();
            }
            part => out.push(part),
        }
    }
    out
}

/// The path of a file as seen from a folder.
pub fn relative(file: &Path, folder: &Path) -> String {
    let whole = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    let (file, folder) = (whole(file), whole(folder));
    let (file, folder): (Vec<Component>, Vec<Component>) = (file.components().collect(), folder.components().collect());
    let common = file.iter().zip(&folder).take_while(|(a, b)| a == b).count();
    let up = std::iter::repeat_n("..".to_string(), folder.len() - common);
    let down = file[common..].iter().map(|part| part.as_os_str().to_string_lossy().into_owned());
    up.chain(down).collect::<Vec<_>>().join("/")
}

/// All `.fric` files in a folder and its subfolders, sorted by name. Hidden and generated files are skipped: names that
/// begin with a dot, and folders called `target` or `out`.
///
/// # Errors
/// Why a folder cannot be read.
pub fn texts_in(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    let mut entries: Vec<PathBuf> = fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<io::Result<_>>()?;
    entries.sort();
    for path in entries {
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        // A link to a folder may lead back here.
        let folder = path.is_dir() && !path.is_symlink();
        if name.starts_with('.') || folder && matches!(name.as_str(), "target" | "out") {
            continue;
        }
        if folder {
            found.extend(texts_in(&path)?);
        } else if path.extension().is_some_and(|extension| extension == "fric") {
            found.push(path);
        }
    }
    Ok(found)
}

/// The files given to a command, with each folder replaced by the texts in it.
///
/// # Errors
/// Which folder cannot be read, and why, in words.
pub fn expanded(paths: &[PathBuf]) -> Result<Vec<PathBuf>, String> {
    let mut files = Vec::new();
    for path in paths {
        if path.is_dir() {
            files.extend(texts_in(path).map_err(|error| format!("cannot read {}: {error}", path.display()))?);
        } else {
            files.push(path.clone());
        }
    }
    Ok(files)
}

/// Creates the folder of a file, if it is missing.
///
/// # Errors
/// Why not.
pub fn make_folder_of(path: &Path) -> io::Result<()> {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => fs::create_dir_all(folder),
        Some(_) | None => Ok(()),
    }
}

/// Writes a file atomically: into a temporary file beside it, which is on the disk before it is renamed.
///
/// # Errors
/// Why not; an existing file of that name is then unchanged.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    write_with(path, &mut |out| out.write_all(bytes), true)
}

/// As [`write()`], for bytes that need not be in memory together: `content` writes them.
///
/// # Errors
/// As `write`, and those of `content`.
pub fn write_by(path: &Path, content: &mut Content) -> io::Result<()> {
    let buffered = &mut |out: &mut dyn Write| {
        let mut out = io::BufWriter::new(out);
        content(&mut out)?;
        out.flush()
    };
    write_with(path, buffered, true)
}

/// As [`write()`], but does not wait for the disk, which takes longer than many a run: for results, which the same command
/// makes again if the power fails meanwhile.
///
/// # Errors
/// As `write`.
pub fn write_result(path: &Path, bytes: &[u8]) -> io::Result<()> {
    write_with(path, &mut |out| out.write_all(bytes), false)
}

/// Writes what a file holds.
pub type Content<'c> = dyn FnMut(&mut dyn Write) -> io::Result<()> + 'c;

fn write_with(path: &Path, content: &mut Content, synced: bool) -> io::Result<()> {
    make_folder_of(path)?;
    match fs::metadata(path) {
        // A pipe or a device is written directly; it must not be replaced by a file.
        Ok(old) if !old.is_file() => content(&mut fs::OpenOptions::new().write(true).open(path)?),
        // The new file has the permissions of the old one, and is never readable by anybody else, even briefly.
        Ok(old) => replace(path, content, 0o600, Some(old.permissions()), synced),
        Err(_) => replace(path, content, 0o666, None, synced),
    }
}

/// Writes a new file that is readable only by its owner from the first byte on.
///
/// # Errors
/// Why not, or that the file exists already.
pub fn write_secret(path: &Path, bytes: &[u8]) -> io::Result<()> {
    if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        let mut private = fs::DirBuilder::new();
        #[cfg(unix)]
        std::os::unix::fs::DirBuilderExt::mode(&mut private, 0o700);
        private.recursive(true).create(folder)?;
    }
    if fs::symlink_metadata(path).is_ok() {
        return Err(io::ErrorKind::AlreadyExists.into());
    }
    replace(path, &mut |out| out.write_all(bytes), 0o600, None, true)
}

/// Writes a temporary file with this mode, then sets its permissions and renames it. `synced`: waits for the disk before.
fn replace(
    path: &Path,
    content: &mut Content,
    mode: u32,
    permissions: Option<fs::Permissions>,
    synced: bool,
) -> io::Result<()> {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let neighbour = path.with_file_name(format!(".{name}.{}", std::process::id()));
    // A file of that name was left by a killed process, or is a symbolic link set as a trap: never write through it.
    let _ = fs::remove_file(&neighbour);
    let mut options = fs::OpenOptions::new();
    options.write(true).create_new(true);
    // Elsewhere a file has the permissions of its folder; those of a user's own folders exclude other users.
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, mode);
    #[cfg(not(unix))]
    let _ = mode;
    let written = options
        .open(&neighbour)
        .and_then(|mut file| content(&mut file).and_then(|()| if synced { file.sync_all() } else { Ok(()) }))
        .and_then(|()| permissions.map_or(Ok(()), |permissions| fs::set_permissions(&neighbour, permissions)))
        .and_then(|()| fs::rename(&neighbour, path));
    if written.is_err() {
        let _ = fs::remove_file(&neighbour);
    }
    written
}

#[cfg(test)]
#[cfg(unix)]
mod tests {
    use super::*;
    use std::os::unix::fs::{MetadataExt, PermissionsExt};

    /// A secret, and a file that is readable only by its owner, are never readable by others, not even in part in a
    /// temporary file.
    #[test]
    fn a_secret_is_never_readable_by_others() {
        let folder = tempfile::tempdir().unwrap();
        let (key, text) = (folder.path().join("keys/a.key"), folder.path().join("a.fric"));
        fs::write(&text, "x").unwrap();
        fs::set_permissions(&text, fs::Permissions::from_mode(0o600)).unwrap();
        let over = std::sync::atomic::AtomicBool::new(false);
        let open = std::thread::scope(|scope| {
            let watch = scope.spawn(|| {
                let mut open = Vec::new();
                let look = |at: &Path, open: &mut Vec<_>| {
                    for entry in fs::read_dir(at).into_iter().flatten().flatten() {
                        let found = entry.metadata().ok().filter(|it| it.is_file() && it.mode() & 0o077 != 0);
                        open.extend(found.map(|it| (entry.path(), it.mode())));
                    }
                };
                while !over.load(std::sync::atomic::Ordering::Relaxed) {
                    look(folder.path(), &mut open);
                    look(&folder.path().join("keys"), &mut open);
                }
                open
            });
            let long = vec![b'k'; 1 << 16];
            for _ in 0..100 {
                write_secret(&key, &long).unwrap();
                assert!(write_secret(&key, &long).is_err(), "a key is not written over");
                fs::remove_file(&key).unwrap();
                write(&text, &long).unwrap();
            }
            over.store(true, std::sync::atomic::Ordering::Relaxed);
            watch.join().unwrap()
        });
        assert!(open.is_empty(), "{open:?}");
        assert_eq!(fs::metadata(folder.path().join("keys")).unwrap().mode() & 0o777, 0o700);
    }

    #[test]
    fn a_link_at_the_name_of_the_temporary_file_is_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let (path, victim) = (folder.path().join("a"), folder.path().join("victim"));
        fs::write(&victim, "as it was").unwrap();
        std::os::unix::fs::symlink(&victim, folder.path().join(format!(".a.{}", std::process::id()))).unwrap();
        write(&path, b"new").unwrap();
        assert_eq!((fs::read(&path).unwrap(), fs::read(&victim).unwrap()), (b"new".to_vec(), b"as it was".to_vec()));
    }

    #[test]
    fn a_file_that_is_not_text_is_refused_with_the_position() {
        assert_eq!(text(b"a\0b".to_vec()).unwrap_err(), "it is not a text: byte 1 is zero");
        assert_eq!(text(b"a\nb\xff".to_vec()).unwrap_err(), "it is not a text in UTF-8: line 2, byte 3 of the file");
    }
}
