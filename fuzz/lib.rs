//! What the targets share: the library for imports, and what every diagnostic must be.

use compiler::Sources;
use grammar::diagnostic::Diagnostic;
use std::path::Path;
use std::sync::LazyLock;
use std::{fs, io};

/// The library on disk, and no other files.
pub struct Library;

static FILES: LazyLock<Vec<(String, String)>> = LazyLock::new(|| {
    let mut files = Vec::new();
    collect(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../stdlib-models"), "std", &mut files)
        .expect("the library is there");
    files.sort();
    files
});

fn collect(folder: &Path, name: &str, files: &mut Vec<(String, String)>) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        let name = format!("{name}.{}", path.file_stem().unwrap_or_default().to_string_lossy());
        match path.is_dir() {
            true => collect(&path, &name, files)?,
            false => files.push((name, fs::read_to_string(&path)?)),
        }
    }
    Ok(())
}

impl Sources for Library {
    fn library(&self, module: &str) -> Option<Vec<(String, String)>> {
        let inside = |file: &str| file == module || file.strip_prefix(module).is_some_and(|rest| rest.starts_with('.'));
        let found: Vec<_> = FILES.iter().filter(|(file, _)| inside(file)).cloned().collect();
        (!found.is_empty()).then_some(found)
    }

    fn modules(&self) -> Vec<String> {
        Vec::new()
    }

    fn file(&self, _: &str, _: &str) -> Result<(String, String), String> {
        Err("there is no such file".into())
    }
}

/// A diagnostic has a code and words, and each of its places lies in its text between characters.
pub fn sound<'t>(diagnostic: &Diagnostic, text: impl Fn(usize) -> Option<&'t str>) {
    let Diagnostic { code, message, labels, .. } = diagnostic;
    assert!(code.len() == 5 && code.starts_with(['E', 'W']) && !message.is_empty() && !labels.is_empty());
    for label in labels {
        let text = text(label.span.file.0 as usize).unwrap_or_else(|| panic!("a place in no text: {diagnostic:?}"));
        assert!(text.get(label.span.range()).is_some(), "a place outside its text: {diagnostic:?}");
    }
}
