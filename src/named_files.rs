//! Sources that read each file once, so that a text can be sent elsewhere together with the files that it names.
//!
//! In: files that were read elsewhere; the disk, if it may be read. Out: the answers that a compilation needs, and all
//! files that it asked for.

use crate::compile::Sources;
use crate::disk::Disk;
use std::sync::{Arc, Mutex, PoisonError};

/// A file that a text names: the name of that text, the path as written there, the name and the text of the file.
pub type NamedFile = (String, String, String, String);

/// Files that are given or were read before, then the disk.
#[derive(Clone, Default)]
pub struct NamedFiles {
    known: Arc<Mutex<Vec<NamedFile>>>,
    closed: bool,
}

impl NamedFiles {
    /// These files; others are read from the disk and kept.
    pub fn new(files: Vec<NamedFile>) -> NamedFiles {
        NamedFiles { known: Arc::new(Mutex::new(files)), closed: false }
    }

    /// These files alone: the disk is not read.
    pub fn closed(files: Vec<NamedFile>) -> NamedFiles {
        NamedFiles { closed: true, ..NamedFiles::new(files) }
    }

    /// All that are known by now.
    pub fn all(&self) -> Vec<NamedFile> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Sources for NamedFiles {
    fn library(&self, module: &str) -> Option<Vec<(String, String)>> {
        Disk.library(module)
    }

    fn modules(&self) -> Vec<String> {
        Disk.modules()
    }

    fn library_is_sound(&self) -> bool {
        Disk.library_is_sound()
    }

    fn file(&self, from: &str, path: &str) -> Result<(String, String), String> {
        let mut all = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, _, name, text)) = all.iter().find(|file| file.0 == from && file.1 == path) {
            return Ok((name.clone(), text.clone()));
        }
        if self.closed {
            return Err("it was not sent with the text".into());
        }
        let (name, text) = Disk.file(from, path)?;
        all.push((from.into(), path.into(), name.clone(), text.clone()));
        Ok((name, text))
    }
}
