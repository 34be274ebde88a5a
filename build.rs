//! Embeds the library: every `.fric` file below `stdlib-models/` by its dotted name, `std.friction.lugre`.

use std::path::Path;
use std::{env, fs};

fn main() {
    let root = Path::new(&env::var("CARGO_MANIFEST_DIR").expect("cargo sets it")).join("stdlib-models");
    println!("cargo::rerun-if-changed=stdlib-models");
    let mut files = Vec::new();
    collect(&root, "std", &mut files);
    files.sort();
    let entries: Vec<String> =
        files.iter().map(|(name, path)| format!("    ({name:?}, include_str!({path:?})),\n")).collect();
    let out = Path::new(&env::var("OUT_DIR").expect("cargo sets it")).join("library.rs");
    fs::write(out, format!("&[\n{}]\n", entries.concat())).expect("the build folder can be written");
}

/// Adds the dotted names and paths of the files below `folder`; of a folder that is not there, none.
fn collect(folder: &Path, name: &str, files: &mut Vec<(String, String)>) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for path in entries.flatten().map(|entry| entry.path()) {
        let Some(stem) = path.file_stem().and_then(|stem| stem.to_str()) else { continue };
        let name = format!("{name}.{stem}");
        if path.is_dir() {
            collect(&path, &name, files);
        } else if path.extension().is_some_and(|extension| extension == "fric") {
            files.push((name, path.display().to_string()));
        }
    }
}
