//! Runs seeds of one kind of program in batches, up to a number of programs. Progress is stored in a file, so an
//! interrupted campaign can be resumed and produces the same report.

use crate::back_ends::compare;
use crate::case::Case;
use crate::report::Distribution;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

/// A generator of programs from seeds.
pub struct Kind {
    /// Title in reports.
    pub title: &'static str,
    /// Name of its progress file.
    pub name: &'static str,
    /// Seeds per batch.
    pub batch: u64,
    /// Optimisation level of gcc, which takes long for long functions.
    pub level: &'static str,
    /// The programs of a seed, or why there are none: text that does not check.
    pub make: fn(u64) -> Result<Made, String>,
}

/// The programs of a seed.
pub struct Made {
    /// Its programs.
    pub cases: Vec<Case>,
    /// Additional marks to count in the report.
    pub marks: Vec<String>,
}

/// A campaign in progress.
pub struct Campaign<'k> {
    kind: &'k Kind,
    progress: Option<PathBuf>,
    next: u64,
    /// Everything counted since its beginning, including before interruptions.
    pub seen: Distribution,
}

impl<'k> Campaign<'k> {
    /// Begins, or resumes from the file. Without a file, progress is not stored.
    pub fn begin(kind: &'k Kind, progress: Option<&Path>) -> Campaign<'k> {
        let mut campaign =
            Campaign { kind, progress: progress.map(Path::to_path_buf), next: 0, seen: Distribution::default() };
        if let Some(text) = progress.and_then(|path| fs::read_to_string(path).ok()) {
            let mut lines = text.lines();
            let next = lines.next().and_then(|line| line.strip_prefix("next seed ")?.parse().ok());
            let read = next.zip(Distribution::from_lines(lines));
            let (next, seen) = read.unwrap_or_else(|| {
                panic!("{} holds no progress: remove it to begin again", campaign.progress.as_ref().unwrap().display())
            });
            (campaign.next, campaign.seen) = (next, seen);
        }
        campaign
    }

    /// Runs batches until there are `goal` programs, at most `most_batches`.
    pub fn go(&mut self, goal: u64, most_batches: usize) {
        for _ in 0..most_batches {
            if self.seen.count("programs") >= goal {
                return;
            }
            self.batch();
            let Some(path) = &self.progress else { continue };
            // Written under a temporary name and then renamed.
            let begun = path.with_extension("begun");
            fs::write(&begun, format!("next seed {}\n{}", self.next, self.seen.to_lines()))
                .expect("target/ can be written");
            fs::rename(&begun, path).expect("target/ can be written");
            println!("{}: {} of {goal}, seeds up to {}", self.kind.title, self.seen.count("programs"), self.next);
        }
    }

    fn batch(&mut self) {
        let mut cases = Vec::new();
        let end = self.next + self.kind.batch;
        for seed in self.next..end {
            let made = catch_unwind(AssertUnwindSafe(|| (self.kind.make)(seed)));
            let made = made.unwrap_or_else(|_| panic!("{}, seed {seed}: the compiler panics", self.kind.title));
            self.seen.add("seeds", 1);
            match made {
                Ok(made) => {
                    self.seen.add("seeds kept", 1);
                    made.marks.iter().for_each(|mark| self.seen.add(mark, 1));
                    cases.extend(made.cases);
                }
                Err(why) => self.seen.add(&format!("fell/{why}"), 1),
            }
        }
        for (case, agreed) in cases.iter().zip(&compare(&cases, self.kind.level)) {
            self.seen.see(case, agreed);
        }
        self.next = end;
    }
}
