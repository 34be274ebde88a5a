//! C written by hand, as a library: what generated code is measured against.

use std::path::Path;
use std::process::Command;

/// `benches/SOURCE` by gcc -O3 -march=native, loaded; the source may want to know how many bytes to put before its code.
pub fn built(source: &str, lead: usize) -> libloading::Library {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches").join(source);
    let name = source.with_extension(format!("{lead}.so"));
    let library = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name.file_name().expect("a source has a name"));
    let built = Command::new("gcc")
        .args(["-O3", "-march=native", "-shared", "-fPIC", "-Wall", "-Wextra", "-pedantic", "-o"])
        .arg(&library)
        .arg(format!("-DLEAD={lead}"))
        .arg(&source)
        .arg("-lm")
        .status();
    assert!(built.expect("gcc runs").success(), "{} builds", source.display());
    // SAFETY: the library runs no code when it is loaded.
    unsafe { libloading::Library::new(&library) }.expect("the library loads")
}
