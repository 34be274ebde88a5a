//! `fric new`: creates a folder with a first model and its experiment.

use super::End;
use crate::args::New;
use crate::project;
use crate::terminal::Terminal;
use std::fs;

/// The files and their texts.
const FILES: [(&str, &str); 2] = [("model.fric", include_str!("new/model.fric")), (".gitignore", "/out\n")];

pub fn new(args: &New, terminal: &mut Terminal) -> End {
    let folder = args.dir.display();
    match fs::read_dir(&args.dir).map(|mut entries| entries.next().is_some()) {
        Ok(true) => {
            terminal.error(&format!("{folder} is not empty; nothing was changed"));
            return End::Failed;
        }
        Ok(false) => {}
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
        Err(error) => {
            terminal.error(&format!("cannot use {folder}: {error}"));
            return End::Failed;
        }
    }
    for (name, text) in FILES {
        let path = args.dir.join(name);
        if let Err(error) = project::write(&path, text.as_bytes()) {
            terminal.error(&format!("cannot write {}: {error}", path.display()));
            return End::Failed;
        }
    }
    let model = args.dir.join("model.fric");
    terminal.line(&format!("wrote {}; run it with: fric run {}", model.display(), model.display()));
    End::Fine
}
