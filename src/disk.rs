//! What a text names, on disk: further texts, and files of columns that are no text, logs of rigs among them, which are
//! read as CSV.

use crate::compile::Sources;
use crate::project;
use crate::recording_files::{self, Format};
use crate::rig_log;
use runtime::record::parts::ENDING as LOG;
use std::path::Path;

/// Resolves the imports, tables and recordings of a text for the compiler.
pub struct Disk;

impl Sources for Disk {
    fn library(&self, module: &str) -> Option<Vec<(String, String)>> {
        project::Disk.library(module)
    }

    fn modules(&self) -> Vec<String> {
        project::Disk.modules()
    }

    fn library_is_sound(&self) -> bool {
        project::Disk.library_is_sound()
    }

    fn file(&self, from: &str, path: &str) -> Result<(String, String), String> {
        match Format::of(Path::new(path)) {
            None if Path::new(path).extension().is_some_and(|ending| ending == LOG) => {
                let path = project::path_named(from, path)?;
                Ok((path.display().to_string(), rig_log::table(&path)?))
            }
            None | Some(Format::Csv) => match recording_files::conversion(Path::new(path)) {
                Some(how) => Err(how),
                None => project::Disk.file(from, path),
            },
            Some(format) => {
                let (path, bytes) = project::bytes_named(from, path)?;
                Ok((path.display().to_string(), recording_files::text(bytes, format)?))
            }
        }
    }
}
