//! Seeds of one kind of program in batches, until there are as many programs as wanted; what was done is kept in a file,
//! so that a campaign goes on where it was interrupted and its report is that of one that never was.

use crate::back_ends::compare;
use crate::case::Case;
use crate::report::Distribution;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

/// A way to make programs of seeds.
pub struct Kind {
    /// For reports.
    pub title: &'static str,
    /// Name of its progress.
    pub name: &'static str,
    /// Seeds of a batch.
    pub batch: u64,
    /// How gcc optimises: long lines take it long.
    pub level: &'static str,
    /// Programs of a seed, or why there are none: text that does not check.
    pub make: fn(u64) -> Result<Made, String>,
}

/// What a seed gives.
pub struct Made {
    /// Its programs.
    pub cases: Vec<Case>,
    /// What the report should count besides.
    pub marks: Vec<String>,
}

/// A campaign under way.
pub struct Campaign<'k> {
    kind: &'k Kind,
    progress: Option<PathBuf>,
    next: u64,
    /// All that was seen since its beginning, before interruptions too.
    pub seen: Distribution,
}

impl<'k> Campaign<'k> {
    /// Begins, or goes on where the file says that it was left. Without a file it is not kept.
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

    /// Batches until there are `goal` programs, at most so many batches.
    pub fn go(&mut self, goal: u64, most_batches: usize) {
        for _ in 0..most_batches {
            if self.seen.count("programs") >= goal {
                return;
            }
            self.batch();
            let Some(path) = &self.progress else { continue };
            // Under another name until it is whole.
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
