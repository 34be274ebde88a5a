//! `fric drives`: simulates the drives and devices of a rig on a bus that other programs can reach.

use super::{End, chosen_rig, load, reported};
use crate::args::Drives as Args;
use crate::compile::{self, Options, Stopwatch};
use crate::terminal::Terminal;
use runtime::drive::serve::{Doors, Refused, Served, Sheet};
use std::sync::atomic::{AtomicBool, Ordering};

/// Set by Ctrl-C.
static STOP: AtomicBool = AtomicBool::new(false);

pub fn drives(args: &Args, terminal: &mut Terminal) -> End {
    let Some(mut loaded) = load(&args.file, terminal, &mut Stopwatch::start("read")) else { return End::Failed };
    let name = match chosen_rig(&args.file, args.rig.as_deref(), &loaded) {
        Ok(name) => name,
        Err(why) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    let options = Options { changes: args.set.changes(), ..Options::default() };
    let ready = match compile::rig(&mut loaded, &crate::disk::Disk, &name, &options, &mut Vec::new()) {
        Ok(ready) => ready,
        Err(diagnostics) => {
            reported(&loaded, &diagnostics, terminal);
            return End::Failed;
        }
    };
    drop(loaded);
    let mut sheets = Vec::new();
    for (drive, file) in &args.eds {
        match std::fs::read(file) {
            Ok(bytes) => sheets.push(Sheet {
                drive: drive.clone(),
                file: file.clone(),
                text: String::from_utf8_lossy(&bytes).into_owned(),
            }),
            Err(error) => {
                terminal.error(&format!("{file}: {error}"));
                return End::Failed;
            }
        }
    }
    let doors = Doors {
        sheets,
        buses: args.bus.clone(),
        pty: args.pty.clone(),
        tcp: args.tcp,
        inject: args.inject.clone(),
        seed: args.seed,
    };
    let served = match Served::open(&ready.rig, Some(ready.plant.clone()), &doors) {
        Ok(served) => served,
        Err(Refused::Misused(why)) => {
            terminal.error(&why);
            return End::Misused;
        }
        Err(Refused::Failed(why)) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    crate::interrupt::on_interrupt(|| STOP.store(true, Ordering::Relaxed));
    terminal.report(&format!("{}\n", served.describe(&ready.rig)));
    let mut told = |line: &str| {
        if !args.quiet {
            terminal.line(line);
        }
    };
    served.serve(&ready.rig, args.duration, &|| STOP.load(Ordering::Relaxed), &mut told);
    End::Fine
}
