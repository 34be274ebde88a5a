//! `fric check`: reports problems without running anything.

use super::End;
use crate::args::Check;
use crate::compile::{self, Loaded, Stopwatch};
use crate::terminal::Terminal;
use crate::timings::Timings;
use crate::{project, report};
use grammar::diagnostic::Diagnostic;
use serde_json::Value;
use std::path::Path;

pub fn check(args: &Check, timings: &mut Timings, terminal: &mut Terminal) -> End {
    let mut all = Vec::new();
    let (mut errors, mut warnings, mut unread) = (0, 0, 0);
    let files = match project::expanded(&args.files) {
        Ok(files) => files,
        Err(message) => {
            terminal.error(&message);
            return End::Failed;
        }
    };
    for path in &files {
        let Some((loaded, found)) = found_in(path, timings, terminal) else {
            unread += 1;
            continue;
        };
        errors += found.iter().filter(|diagnostic| diagnostic.is_error()).count();
        warnings += found.iter().filter(|diagnostic| !diagnostic.is_error()).count();
        if args.json {
            if let Value::Array(objects) = report::json(&loaded.files.0, &found) {
                all.extend(objects);
            }
        } else if args.short {
            terminal.print(&report::short(&loaded.files.0, &found));
        } else if !found.is_empty() {
            terminal.line(&report::full(&loaded.files.0, &found, terminal.colour()));
        }
    }
    if args.json {
        terminal.line(&Value::Array(all).to_string());
    } else if !args.short {
        let counted = |n: usize, one: &str| format!("{n} {one}{}", if n == 1 { "" } else { "s" });
        terminal.line(&format!(
            "{}: {}, {}",
            counted(files.len() - unread, "file"),
            counted(errors, "error"),
            counted(warnings, "warning")
        ));
    }
    if errors + unread == 0 { End::Fine } else { End::Failed }
}

/// All diagnostics of a text, without duplicates; none if it cannot be read.
fn found_in(path: &Path, timings: &mut Timings, terminal: &Terminal) -> Option<(Loaded, Vec<Diagnostic>)> {
    let name = path.display().to_string();
    let mut watch = Stopwatch::start("read");
    match project::read(path) {
        Ok(text) => {
            watch.stage("parse");
            let mut loaded = compile::load(&name, &text, &crate::disk::Disk);
            watch.stage("check");
            let found = compile::check(&mut loaded, &crate::disk::Disk);
            timings.add_all(&watch.stop());
            Some((loaded, found))
        }
        Err(reason) => {
            terminal.error(&format!("cannot read {name}: {reason}"));
            None
        }
    }
}
