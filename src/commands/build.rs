//! `fric build`: writes a model as C, as a machine-code image, or as an intermediate form of the compiler.

use super::{End, load, reported};
use crate::args::Build;
use crate::compile::{self, Emit, Stopwatch};
use crate::project;
use crate::terminal::Terminal;
use grammar::ast::Statement;
use grammar::diagnostic::Diagnostic;
use std::path::Path;

pub fn build(args: &Build, terminal: &mut Terminal) -> End {
    let packs =
        args.out.as_ref().is_some_and(|out| out.extension().is_some_and(|it| it == runtime::package::EXTENSION));
    let folder = args.out.as_ref().filter(|out| out.is_dir() || out.to_string_lossy().ends_with('/'));
    let emit = match (args.emit.or(folder.map(|_| Emit::C)), packs) {
        (None, true) => return crate::commands::shared::package::build(args, terminal),
        (Some(emit), false) if args.sign.is_none() => emit,
        (Some(_), false) => {
            terminal.error("--sign is for packages: a rig, with --out NAME.fricpkg");
            return End::Misused;
        }
        (Some(_), true) => {
            terminal.error("a package holds a rig: leave --emit out, or give --out another ending");
            return End::Misused;
        }
        (None, false) => {
            terminal.error(
                "make what? --emit c, ir, passes, clif, asm or blob; numpy, jax, casadi or sympy; C with a header with --out FOLDER/; a rig becomes a package with --out NAME.fricpkg",
            );
            return End::Misused;
        }
    };
    if let Some(folder) = folder.filter(|_| emit != Emit::C) {
        terminal.error(&format!("{} is a folder: only C code goes into one; name a file", folder.display()));
        return End::Misused;
    }
    if !args.features.is_empty() && !matches!(emit, Emit::Blob | Emit::Asm) {
        terminal.error("--features is for machine code: --emit blob or asm, or a package");
        return End::Misused;
    }
    let Some(mut loaded) = load(&args.file, terminal, &mut Stopwatch::start("read")) else { return End::Failed };
    let models: Vec<String> = loaded.models().into_iter().map(|model| model.name.text.clone()).collect();
    let experiments: Vec<String> = loaded.experiments().into_iter().map(|experiment| experiment.name).collect();
    let all = || models.iter().chain(&experiments).map(String::as_str);
    let file = args.file.display();
    let name = match (&args.name, &models[..], &experiments[..]) {
        (Some(name), ..) if all().any(|known| known == name) => name.clone(),
        (Some(name), ..) => {
            let help = match (of_part(&loaded, name), compile::nearest(name, all())) {
                (Some((owner, model)), _) if models.contains(&model) => {
                    format!("that is a part of `{owner}`, a `{model}`: `fric build {file} {model}`")
                }
                (Some((owner, model)), _) => format!(
                    "that is a part of `{owner}`, a `{model}` of another file: write `model Mine = {model}()` with its \
                     arguments into this one, and build `Mine`"
                ),
                (None, Some(near)) => format!("did you mean `{near}`?"),
                (None, None) => format!("it has {}", all().collect::<Vec<_>>().join(", ")),
            };
            terminal.error(&format!("{file} has no model or experiment `{name}`; {help}"));
            return End::Failed;
        }
        (None, [only], _) | (None, [], [only]) => only.clone(),
        (None, [], []) => {
            terminal.error(&format!("{file} has no model and no experiment"));
            return End::Failed;
        }
        (None, ..) => {
            let all: Vec<&str> = all().collect();
            terminal.error(&format!("which of {file}? Name one of {}", all.join(", ")));
            return End::Misused;
        }
    };
    if emit == Emit::Blob && args.out.is_none() {
        terminal.error("an image is no text for a terminal: give it a file with --out");
        return End::Misused;
    }
    let changes = args.stepped.changes();
    let mut found = Vec::new();
    if let Some(dialect) = emit.dialect() {
        if args.stepped.solver.is_some() || args.stepped.step.is_some() || args.target.is_some() {
            let name = dialect.name();
            terminal.error(&format!(
                "a function for {name} has no steps and no processor: leave --solver, --step and --target out"
            ));
            return End::Misused;
        }
        return match compile::python(&mut loaded, &crate::disk::Disk, &name, &changes, dialect, &mut found) {
            Ok(text) => {
                if !found.is_empty() {
                    reported(&loaded, &found, terminal);
                }
                written(args.out.as_deref(), text.as_bytes(), terminal)
            }
            Err(diagnostics) => {
                reported(&loaded, &diagnostics, terminal);
                End::Failed
            }
        };
    }
    let built = match compile::build(&mut loaded, &crate::disk::Disk, &name, &changes, &mut found) {
        Ok(built) => built,
        Err(diagnostics) => {
            reported(&loaded, &diagnostics, terminal);
            return End::Failed;
        }
    };
    found.retain(|diagnostic| !Diagnostic::is_error(diagnostic));
    if !found.is_empty() {
        reported(&loaded, &found, terminal);
    }
    let method = built.solver.map(|solver| solver.method).or(args.stepped.solver);
    if let Some(why) = method.and_then(|method| args.stepped.without_effect(&name, method)) {
        terminal.error(&why);
        return End::Misused;
    }
    let delays = &built.program.description.delays;
    if args.stepped.step.is_none() && compile::unsized_delays(&built, args.stepped.solver) {
        let each = if delays.len() == 1 { "a `delay`".into() } else { format!("{} `delay`s", delays.len()) };
        terminal.error(&format!("`{name}` has {each}: how much of the past is kept depends on the step; give it with --step, such as --step 1ms"));
        return End::Misused;
    }
    if let Some(folder) = folder {
        return in_folder(folder, compile::c_files(&built, args.stepped.solver), terminal);
    }
    let bytes = match compile::emit(&built, emit, args.stepped.solver, args.target, &args.features) {
        Ok(bytes) => bytes,
        Err(why) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    written(args.out.as_deref(), &bytes, terminal)
}

/// Writes what was made into a file, or to the standard output.
fn written(out: Option<&Path>, bytes: &[u8], terminal: &mut Terminal) -> End {
    let Some(out) = out else {
        terminal.print(std::str::from_utf8(bytes).expect("all but images are texts"));
        return End::Fine;
    };
    if let Err(error) = project::write(out, bytes) {
        terminal.error(&format!("cannot write {}: {error}", out.display()));
        return End::Failed;
    }
    terminal.report(&format!("wrote {}, {} bytes\n", out.display(), crate::quantity::count(bytes.len() as u64)));
    End::Fine
}

/// The model that has a part of this name, or of its last segment, and the model of that part.
fn of_part(loaded: &compile::Loaded, path: &str) -> Option<(String, String)> {
    let name = path.rsplit('.').next()?;
    loaded.models().into_iter().find_map(|model| {
        let part = model.body.iter().find_map(|statement| match statement {
            Statement::Part(part) if part.name.text == name => Some(part),
            _ => None,
        })?;
        Some((model.name.text.clone(), part.instance.model.text.clone()))
    })
}

/// Writes C code and its header into a folder.
fn in_folder(folder: &Path, files: Result<compile::CFiles, String>, terminal: &Terminal) -> End {
    let files = match files {
        Ok(files) => files,
        Err(why) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    let mut written = Vec::new();
    for (ending, text) in [("c", &files.source), ("h", &files.header)] {
        let path = folder.join(format!("{}.{ending}", files.name));
        if let Err(error) = project::write(&path, text.as_bytes()) {
            terminal.error(&format!("cannot write {}: {error}", path.display()));
            return End::Failed;
        }
        written.push(path.display().to_string());
    }
    terminal.report(&format!("wrote {}\n", written.join(" and ")));
    End::Fine
}
