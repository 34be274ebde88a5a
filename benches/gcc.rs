//! Hand-written C as a shared library: the reference for generated code.

use libloading::Library;
use std::path::{Path, PathBuf};
use std::process::Command;

/// `benches/SOURCE` by gcc -O3 -march=native, loaded.
#[allow(dead_code, reason = "not every bench has one place only")]
pub fn built(source: &str) -> Library {
    let [library] = built_at(source, [0]);
    library
}

/// The same for another target: `-mavx2 -mfma` in place of `-march=native`.
#[allow(dead_code, reason = "most benches are for this processor")]
pub fn built_for(source: &str, target: &[&str]) -> Library {
    let library = room(source, &format!("{}.so", target.concat()));
    let how = [&["-O3", "-shared", "-fPIC", "-Wall", "-Wextra", "-pedantic"], target].concat();
    gcc("-std=gnu17", &library, &how, &[&in_benches(source)]);
    // SAFETY: the library runs no code when it is loaded.
    unsafe { Library::new(&library) }.expect("the library loads")
}

/// The same at several offsets in bytes.
#[allow(dead_code, reason = "not every bench has several places")]
pub fn built_at<const N: usize>(source: &str, leads: [usize; N]) -> [Library; N] {
    let object = room(source, "o");
    gcc("-c", &object, &["-O3", "-march=native", "-fPIC", "-Wall", "-Wextra", "-pedantic"], &[&in_benches(source)]);
    leads.map(|lead| {
        let before = room(source, &format!("{lead}.s"));
        let skip = if lead > 0 { format!(".skip {lead}\n") } else { String::new() };
        let text = format!(".text\n{skip}.section .note.GNU-stack\n");
        std::fs::write(&before, text).expect("there is room for it");
        let library = room(source, &format!("{lead}.so"));
        gcc("-shared", &library, &[], &[&before, &object]);
        // SAFETY: the library runs no code when it is loaded.
        unsafe { Library::new(&library) }.expect("the library loads")
    })
}

fn in_benches(source: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("benches").join(source)
}

/// The path of a product of a source, by extension.
fn room(source: &str, ending: &str) -> PathBuf {
    let name = in_benches(source).with_extension(ending);
    Path::new(env!("CARGO_TARGET_TMPDIR")).join(name.file_name().expect("a source has a name"))
}

fn gcc(what: &str, out: &Path, how: &[&str], of: &[&Path]) {
    let status = Command::new("gcc").arg(what).args(how).arg("-o").arg(out).args(of).arg("-lm").status();
    assert!(status.expect("gcc runs").success(), "{} is built", out.display());
}
