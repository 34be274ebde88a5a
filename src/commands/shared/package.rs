//! Builds a rig as a package: compiled for a processor, with its source texts, optionally signed.

use crate::args::{Build, Set};
use crate::commands::{End, chosen_rig, load_from};
use crate::compile::{self, Stopwatch};
use crate::signing::Signing;
use crate::source_snapshot::Keeping;
use crate::terminal::Terminal;
use crate::{loop_stability, project, report};
use abi::encode::Encode;
use abi::image::Feature;
use abi::rig::Rig;
use runtime::package::signature::{beside, comment};
use runtime::package::{Package, here};
use runtime::record::log::Sections;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

/// `fric build RIG.fric -o NAME.fricpkg`
pub(in crate::commands) fn build(args: &Build, terminal: &mut Terminal) -> End {
    let target = args.target.map_or_else(here, |target| format!("{}-linux", target.name()));
    let out = args.out.as_deref().expect("a package has a name");
    if args.stepped.solver.is_some() || args.stepped.step.is_some() {
        terminal.error("a rig has its own step and solver: change them in its text");
        return End::Misused;
    }
    let built = args.sign.as_deref().map(Signing::open).transpose().and_then(|key| {
        let wanted = Wanted {
            name: args.name.as_deref(),
            target: &target,
            features: &args.features,
            set: &args.stepped.set,
            key: key.as_ref(),
        };
        packed(&args.file, &wanted, terminal)
    });
    let (bytes, signature) = match built {
        Ok(packed) => packed,
        Err(why) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    let beside = beside(out);
    let written = match &signature {
        Some(text) => project::write(&beside, text.as_bytes()),
        // A signature of an earlier package would be invalid.
        None if beside.exists() => std::fs::remove_file(&beside),
        None => Ok(()),
    };
    if let Err(error) = written.and_then(|()| project::write(out, &bytes)) {
        terminal.error(&format!("cannot write {}: {error}", out.display()));
        return End::Failed;
    }
    let signed =
        if signature.is_some() { format!(", signed beside it in {}", beside.display()) } else { String::new() };
    let size = crate::quantity::count(bytes.len() as u64);
    terminal.report(&format!("wrote {}, {size} bytes, for {target}{signed}\n", out.display()));
    End::Fine
}

/// What to pack, and how.
pub(in crate::commands) struct Wanted<'a> {
    /// The rig; the only one of the text if none is named.
    pub name: Option<&'a str>,
    /// The target, such as `aarch64-linux`.
    pub target: &'a str,
    /// Instruction set extensions that its code may use.
    pub features: &'a [Feature],
    /// Parameters and slots that are changed.
    pub set: &'a Set,
    /// The key to sign with.
    pub key: Option<&'a Signing>,
}

/// The bytes of a package and its signature.
///
/// # Errors
/// Why there is none; diagnostics are reported directly, and the message is then empty.
pub(in crate::commands) fn packed(
    file: &Path,
    wanted: &Wanted,
    terminal: &mut Terminal,
) -> Result<(Vec<u8>, Option<String>), String> {
    let Wanted { name, target, features, set, key } = *wanted;
    let reported = || "the rig was not built".to_string();
    let keeping = Keeping::new(&crate::disk::Disk);
    let mut loaded = load_from(file, &keeping, terminal, &mut Stopwatch::start("read")).ok_or_else(reported)?;
    let name = chosen_rig(file, name, &loaded)?;
    let mut found = Vec::new();
    let built = compile::packed_rig(&mut loaded, &keeping, &name, target, features, set.changes(), &mut found);
    if !found.is_empty() {
        terminal.report(&report::full(&loaded.files.0, &found, terminal.error_colour()));
    }
    let built = built.map_err(|why| why.unwrap_or_else(reported))?;
    let mut package =
        Package { fric: env!("CARGO_PKG_VERSION").into(), target: target.into(), rig: name, sections: Vec::new() };
    // The rig's computer has no compiler to analyse stability with.
    let (against, needs_look) = loop_stability::objections(&built.ready);
    if !against.is_empty() {
        return Err(format!("refused: {}; `fric predict` says what would help", against.join("; ")));
    }
    let plan = Rig { needs_look, ..built.ready.rig };
    package.add("rig", plan.to_bytes());
    package.add("control", built.control);
    package.add("plant", built.plant);
    package.add("live", built.live);
    package.add("judge", built.judge);
    // The head of each of its logs, so that a recording can be replayed anywhere.
    let root = loaded.files.get(loaded.root());
    let head = Sections::default()
        .with("fric", package.fric.as_str())
        .with("target", target)
        .with("rig", package.rig.as_str())
        .with("file", root.name.as_str())
        .with("source", root.text.as_bytes())
        .with("set", set.texts().join("\n"));
    package.add("head", keeping.into(head).0.to_bytes());
    for source in loaded.files.0.iter().filter(|source| !source.name.starts_with("--")) {
        let name = format!("source/{}", tidy(&source.name));
        if package.section(&name).is_err() {
            package.add(&name, source.text.as_bytes().to_vec());
        }
    }
    let bytes = package.to_bytes();
    // A package that its target would refuse is not written.
    Package::read(&bytes)
        .and_then(|package| package.contents())
        .map_err(|why| format!("the package would be refused, which is a mistake of fric: {why}"))?;
    let signature = key.map(|key| signed(key, &package, &bytes)).transpose()?;
    Ok((bytes, signature))
}

/// A signature of a package, made now.
///
/// # Errors
/// Why there is none.
pub(in crate::commands) fn signed(key: &Signing, package: &Package, bytes: &[u8]) -> Result<String, String> {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let what = format!("rig {}, {}, fric {}", package.rig, package.target, package.fric);
    key.sign(bytes, &comment(&what, now.as_secs()))
}

/// The name of a text without its folder, so that a rig packs to the same bytes wherever its files are.
fn tidy(name: &str) -> String {
    Path::new(name).file_name().map_or_else(|| name.to_string(), |name| name.to_string_lossy().into_owned())
}
