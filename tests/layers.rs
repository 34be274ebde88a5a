//! The structure that docs/architecture.md promises: crates know only the crates below them, and a module of a crate
//! uses only modules that its `lib.rs` declares above it.

use std::fs;
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// The Rust files of a module: `name.rs`, or everything below `name/`.
fn files(folder: &Path, module: &str) -> Vec<PathBuf> {
    let (file, folder) = (folder.join(format!("{module}.rs")), folder.join(module));
    let mut found: Vec<PathBuf> = file.is_file().then_some(file).into_iter().collect();
    let mut open = vec![folder];
    while let Some(folder) = open.pop() {
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                found.push(path);
            }
        }
    }
    assert!(!found.is_empty(), "no file of module {module}");
    found.retain(|path| !only_for_tests(path));
    found
}

/// Whether the module beside a file declares it for tests only.
fn only_for_tests(path: &Path) -> bool {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let parent = path.parent().map(|folder| folder.join("mod.rs")).and_then(|parent| fs::read_to_string(parent).ok());
    parent.is_some_and(|text| text.contains(&format!("#[cfg(test)]\nmod {stem};")))
}

/// The text without comments and tests.
fn code(path: &Path) -> String {
    let text = fs::read_to_string(path).expect("a source file is a text");
    let text = text.split("#[cfg(test)]").next().unwrap_or_default();
    let without_comment = |line: &str| line.split("//").next().unwrap_or_default().to_string();
    text.lines().map(without_comment).collect::<Vec<_>>().join("\n")
}

/// First words behind each `prefix` in a text.
fn words_behind<'t>(text: &'t str, prefix: &'t str) -> impl Iterator<Item = &'t str> {
    text.match_indices(prefix).map(move |(at, _)| {
        let rest = &text[at + prefix.len()..];
        &rest[..rest.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(rest.len())]
    })
}

#[test]
fn modules_use_only_modules_above_them() {
    for crate_name in ["grammar", "abi", "compiler", "runtime"] {
        let folder = root().join(crate_name).join("src");
        let lib = fs::read_to_string(folder.join("lib.rs")).expect("a crate has a lib.rs");
        let declared = |line: &str| {
            let line = line.trim().strip_prefix("pub ").unwrap_or(line.trim());
            line.strip_prefix("mod ")?.strip_suffix(';').map(str::to_string)
        };
        let modules: Vec<String> =
            lib.split("#[cfg(test)]").next().unwrap_or_default().lines().filter_map(declared).collect();
        assert!(!modules.is_empty(), "{crate_name} declares its modules in lib.rs");
        for (at, module) in modules.iter().enumerate() {
            for file in files(&folder, module) {
                let text = code(&file);
                for used in words_behind(&text, "crate::") {
                    let place = modules.iter().position(|other| other == used);
                    assert!(
                        place.is_none_or(|place| place <= at),
                        "{} uses `{used}`, which lib.rs declares below `{module}`",
                        file.display()
                    );
                }
            }
        }
    }
}

#[test]
fn crates_know_only_the_crates_below_them() {
    let below: [(&str, &[&str]); 4] =
        [("grammar", &[]), ("abi", &[]), ("compiler", &["grammar", "abi"]), ("runtime", &["abi"])];
    for (crate_name, allowed) in below {
        let manifest = fs::read_to_string(root().join(crate_name).join("Cargo.toml")).expect("a crate has a manifest");
        for other in ["grammar", "abi", "compiler", "runtime", "fric"] {
            let depends = manifest
                .lines()
                .any(|line| line.starts_with(&format!("{other}.workspace")) || line.starts_with(&format!("{other} =")));
            assert!(!depends || allowed.contains(&other), "{crate_name} depends on {other}");
        }
    }
}

#[test]
fn outside_crates_have_one_home() {
    let homes = [
        ("crc32fast", "runtime/src/record/blocks.rs"),
        ("miniz_oxide", "runtime/src/record/packed.rs"),
        ("rustix", "runtime/src/record/parts.rs"),
        ("pest", "grammar/src/parse.rs"),
        ("rtrb", "runtime/src/queue.rs"),
        ("cranelift_codegen", "compiler/src/backend/"),
        ("cranelift_jit", "compiler/src/backend/"),
        ("sha2", "abi/src/image.rs"),
        ("memmap2", "runtime/src/blob.rs"),
        ("::socketcan", "runtime/src/can/socketcan.rs"),
        ("miette", "src/report.rs"),
        ("::parquet", "src/parquet.rs"),
        ("resvg", "src/plot/png.rs"),
        ("rustyline", "src/repl/line.rs"),
    ];
    let mut sources = Vec::new();
    for folder in ["src", "grammar/src", "abi/src", "compiler/src", "runtime/src"] {
        let mut open = vec![root().join(folder)];
        while let Some(folder) = open.pop() {
            for path in fs::read_dir(folder).expect("a source folder").flatten().map(|entry| entry.path()) {
                if path.is_dir() {
                    open.push(path);
                } else if path.extension().is_some_and(|extension| extension == "rs") {
                    sources.push(path);
                }
            }
        }
    }
    for path in sources {
        // Their homes bear the names of the crates.
        let text = code(&path).replace("can::socketcan", "").replace("crate::parquet", "");
        let name = path.strip_prefix(root()).expect("a source of this project").display().to_string();
        for (outside, home) in homes {
            let used = text.contains(&format!("use {outside}")) || text.contains(&format!("{outside}::"));
            assert!(!used || name.starts_with(home), "{name} uses {outside}, whose home is {home}");
        }
    }
}
