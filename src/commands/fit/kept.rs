//! The stages of fits in files, from which `--resume` goes on after an interruption.
//!
//! In: the question of a fit, and the results of its stages as they end. Out: those that an earlier process has kept of
//! the same question. A line holds a stage, its numbers as bits; [`Unfinished`] says which lines are whole.

use crate::args;
use crate::compile::{self, Loaded};
use crate::project;
use crate::terminal::Terminal;
use crate::unfinished::{Hash, Mark, Unfinished, begun_otherwise};
use runtime::fit::{Journal, Stage};
use std::collections::VecDeque;
use std::fmt::Write as _;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// First line of a file.
const HEADER: &[u8] = b"stages of fric fit\n";

/// The files of all fits of a command, which end together: a fit that has its answer need not be repeated if a later one
/// is interrupted.
pub struct Keeping<'a> {
    args: &'a args::Fit,
    all: Vec<Kept>,
}

impl<'a> Keeping<'a> {
    /// Without fits yet.
    pub fn new(args: &'a args::Fit) -> Keeping<'a> {
        Keeping { args, all: Vec::new() }
    }

    /// Keeps the stages of a fit beside its answer, and with `--resume` goes on with those that are there. None if the
    /// answer has no files, or if another process fits there.
    ///
    /// # Errors
    /// Why an earlier fit cannot be resumed, in words.
    pub fn begin(
        &mut self,
        loaded: &Loaded,
        name: &str,
        compiled: &[compile::Fit],
        terminal: &Terminal,
    ) -> Result<Option<Kept>, String> {
        let args = self.args;
        if args.check || args.json && !args.resume {
            return Ok(None);
        }
        let path = args.out.join(format!("{name}.stages"));
        let kept = Kept::begin(&path, &asked(args, loaded, name, compiled), args.resume, terminal)?;
        self.all.extend(kept.clone());
        Ok(kept)
    }

    /// All fits have ended: their stages are of no further use.
    pub fn finish(self, terminal: &Terminal) {
        for kept in self.all {
            let (path, fault) = kept.stages().finish();
            if let Some(error) = fault {
                terminal.report(&format!("the stages of a fit could not be kept in {}: {error}\n", path.display()));
            }
        }
    }
}

/// What a fit must share with one that it resumes.
fn asked(args: &args::Fit, loaded: &Loaded, name: &str, compiled: &[compile::Fit]) -> String {
    let judged = compiled.iter().flat_map(|fit| &fit.judged);
    let asks = compiled.iter().chain(judged).flat_map(|fit| &fit.parts).map(|part| &part.asks);
    let columns = asks.flat_map(|asks| asks.columns.iter().map(|(_, _, values)| values).chain([&asks.rows]));
    let mut asked = format!("fric {}, texts {:016x}\n", env!("CARGO_PKG_VERSION"), Hash::of_texts(loaded));
    let _ =
        writeln!(asked, "fit {name}, recordings {:016x}", Hash::of_numbers(columns.flat_map(|column| column.iter())));
    for set in args.stepped.set.texts() {
        let _ = writeln!(asked, "--set {set}");
    }
    let solver = args.stepped.solver.map(|method| method.name());
    for (option, value) in [
        ("solver", solver.map(str::to_string)),
        ("step", args.stepped.step.map(|step| step.to_string())),
        ("tol", args.tol.map(|tol| tol.to_string())),
        ("starts", args.starts.map(|starts| starts.to_string())),
        ("profile", (!args.profile.is_empty()).then(|| args.profile.join(","))),
        ("robust", args.robust.then(String::new)),
        ("interpret", args.interpret.then(String::new)),
    ] {
        if let Some(value) = value {
            let _ = writeln!(asked, "--{option} {value}");
        }
    }
    let _ = writeln!(asked, "--level {} --seed {} --pieces {}", args.level, args.seed, args.pieces);
    asked
}

/// The stages of a fit. Copies write to the same file.
#[derive(Clone)]
pub struct Kept(Arc<Mutex<Stages>>);

struct Stages {
    path: PathBuf,
    /// None once the fit has ended.
    unfinished: Option<Unfinished>,
    file: File,
    mark: Mark,
    /// What an earlier process has kept.
    earlier: VecDeque<Stage>,
    /// Why later stages are not kept.
    fault: Option<io::Error>,
}

impl Kept {
    fn stages(&self) -> MutexGuard<'_, Stages> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn begin(path: &Path, asked: &str, resume: bool, terminal: &Terminal) -> Result<Option<Kept>, String> {
        let told = |error: io::Error| format!("cannot keep the stages of a fit in {}: {error}", path.display());
        project::make_folder_of(path).map_err(told)?;
        let mut unfinished = match Unfinished::claim(path) {
            Ok(unfinished) => unfinished,
            Err(why) if resume => return Err(why),
            Err(_) => return Ok(None),
        };
        let made = |unfinished, file, mark, earlier| {
            let path = path.to_path_buf();
            let unfinished = Some(unfinished);
            Ok(Some(Kept(Arc::new(Mutex::new(Stages { path, unfinished, file, mark, earlier, fault: None })))))
        };
        let start = Mark::after(HEADER);
        let before = unfinished.before().map(str::to_string).filter(|_| resume);
        if let Some(before) = &before {
            if before != asked.trim_end() {
                return Err(begun_otherwise(path, "another question", (before, asked), "leave --resume out"));
            }
            let sound = unfinished.sound(path, HEADER, &|_, line| stage(line).is_some()).map_err(told)?;
            if let Some(fault) = &sound.fault {
                let path = path.display();
                terminal.report(&format!("{fault} of {path} is not as it was written: the fit goes on before it\n"));
            }
            if sound.mark.bytes >= start.bytes {
                let lines = BufReader::new(File::open(path).map_err(told)?).lines().skip(1);
                let lines: Vec<String> = lines.collect::<Result<_, _>>().map_err(told)?;
                let earlier = lines.iter().map_while(|line| stage(line)).collect();
                let file = OpenOptions::new().append(true).open(path).map_err(told)?;
                return made(unfinished, file, sound.mark, earlier);
            }
        }
        let mut file = File::create(path).map_err(told)?;
        file.write_all(HEADER).and_then(|()| unfinished.begin(asked)).map_err(told)?;
        made(unfinished, file, start, VecDeque::new())
    }
}

impl Stages {
    /// Removes the file. Returns its path, and why stages were not kept.
    fn finish(&mut self) -> (PathBuf, Option<io::Error>) {
        let _ = fs::remove_file(&self.path);
        if let Some(unfinished) = self.unfinished.take() {
            unfinished.finish();
        }
        (self.path.clone(), self.fault.take())
    }
}

impl Journal for Kept {
    fn next(&mut self) -> Option<Stage> {
        self.stages().earlier.pop_front()
    }

    fn note(&mut self, stage: &Stage) {
        let stages = &mut *self.stages();
        let Some(unfinished) = stages.unfinished.as_mut().filter(|_| stages.fault.is_none()) else { return };
        let line = line(stage);
        stages.mark = stages.mark.and(line.as_bytes());
        let written = stages.file.write_all(line.as_bytes()).and_then(|()| unfinished.note(stages.mark));
        stages.fault = written.err();
    }
}

/// A stage as a line: its numbers, then its words, each after a tab.
fn line(stage: &Stage) -> String {
    let numbers: Vec<String> = stage.numbers.iter().map(|number| format!("{:x}", number.to_bits())).collect();
    let words: String = stage.words.iter().map(|word| format!("\t{}", word.replace(['\t', '\n', '\r'], " "))).collect();
    format!("{}{words}\n", numbers.join(" "))
}

/// The stage of a line.
fn stage(line: &str) -> Option<Stage> {
    let mut parts = line.split('\t');
    let numbers = parts.next()?.split(' ').map(|bits| Some(f64::from_bits(u64::from_str_radix(bits, 16).ok()?)));
    Some(Stage { numbers: numbers.collect::<Option<_>>()?, words: parts.map(str::to_string).collect() })
}
