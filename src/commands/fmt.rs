//! `fric fmt`: rewrites texts in the canonical layout.

use super::End;
use crate::args::Fmt;
use crate::compile::SourceFile;
use crate::terminal::Terminal;
use crate::{project, report};
use std::path::Path;
use std::sync::Arc;

pub fn fmt(args: &Fmt, terminal: &mut Terminal) -> End {
    let mut end = End::Fine;
    let files = match project::expanded(&args.files) {
        Ok(files) => files,
        Err(message) => {
            terminal.error(&message);
            return End::Failed;
        }
    };
    for path in &files {
        let input = path == Path::new("-");
        let name = if input { "standard input".into() } else { path.display().to_string() };
        let read = if input { project::read_input() } else { project::read(path) };
        let formatted = read.map_err(|reason| format!("cannot read {name}: {reason}")).map(|text| {
            let formatted = formatted(&name, &text, args.width, terminal);
            formatted.map(|formatted| (formatted != text, formatted))
        });
        let done = match formatted {
            // Its problems have been reported.
            Ok(None) => Err(None),
            Ok(Some((changed, _))) if args.check => {
                if changed {
                    terminal.line(&name);
                }
                if changed { Err(None) } else { Ok(()) }
            }
            Ok(Some((_, formatted))) if input => {
                terminal.print(&formatted);
                Ok(())
            }
            Ok(Some((false, _))) => Ok(()),
            Ok(Some((true, formatted))) => {
                let written = project::write(path, formatted.as_bytes());
                written.map_err(|error| Some(format!("cannot write {name}: {error}")))
            }
            Err(message) => Err(Some(message)),
        };
        if let Err(message) = done {
            end = End::Failed;
            if let Some(message) = message {
                terminal.error(&message);
            }
        }
    }
    end
}

/// The text in its canonical layout; none if it does not parse, which is reported.
fn formatted(name: &str, text: &str, width: u16, terminal: &Terminal) -> Option<String> {
    match grammar::format::format(text, usize::from(width)) {
        Ok(formatted) => Some(formatted),
        Err(diagnostics) => {
            let files = [SourceFile { name: name.into(), text: text.into(), ast: Arc::default(), library: false }];
            terminal.report(&report::full(&files, &diagnostics, terminal.error_colour()));
            None
        }
    }
}
