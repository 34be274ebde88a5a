//! Values of many runs at the same instants, some rows of all runs after the other.
//!
//! In: runs of one model, instants and slots. Out: for each run the values at the next instants, with the bits of
//! [`sample`](crate::engine::sample). The runs advance together, in lanes where there are enough to fill them, so that memory
//! does not grow with the number of instants: only runs whose adaptive steps differ are ahead of each other.

use crate::engine::lanes::{Next, Together};
use crate::engine::{Continue, Failure, bare, failed, start};
use crate::run::observe::{Observer, Probe};
use crate::run::stepper::{self, Stepper};
use abi::lanes::Lanes;
use abi::plan::Experiment;
use abi::{Instance, Slot};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Lanes are worth their steps from this part of them on. AVX-512: a fixed step in all 24 takes the time of four runs alone,
/// an adaptive one in all 16 that of three, besides what each run takes.
const LEAST_PART: usize = 4;

/// Why a run has no values at some instants.
#[derive(Debug)]
pub enum Missing {
    /// It ended before them.
    Ended,
    /// It failed.
    Failed(Box<Failure>),
}

/// Runs that are read some rows after the other.
pub struct Tiles {
    groups: Vec<Group>,
    /// Instants that have not been read.
    left: usize,
    slots: usize,
    threads: usize,
    stop: Option<Arc<AtomicBool>>,
}

/// Runs that advance in one thread.
struct Group {
    course: Course,
    /// The values of runs that have ended, and how they did.
    ended: Vec<Option<(Probe, Result<(), Failure>)>>,
}

enum Course {
    /// In lanes. Runs that have not begun, and what they are read at.
    Lanes(Box<Together<usize>>, std::vec::IntoIter<(Instance, Experiment)>, (Arc<[f64]>, Vec<Slot>)),
    /// One run; none once it has ended.
    Alone(Option<Box<dyn Stepper>>),
}

impl Tiles {
    /// Begins runs, to be read in these slots at instants in s, ascending. `lanes`: code for many of them, if there is any.
    ///
    /// # Panics
    /// As [`run`](crate::engine::run). The dry run of a rig is none of these.
    pub fn new(
        lanes: Option<&Lanes>,
        runs: Vec<(Instance, Experiment)>,
        (instants, slots): (&Arc<[f64]>, &[Slot]),
        threads: usize,
    ) -> Tiles {
        let mut groups = Vec::new();
        let mut left = runs.into_iter();
        let width = lanes.map_or(1, Lanes::width);
        while left.len() > 0 {
            let some: Vec<(Instance, Experiment)> = left.by_ref().take(width).collect();
            match lanes.filter(|_| some.len() >= width.div_ceil(LEAST_PART).max(2)) {
                Some(lanes) => {
                    let ended = some.iter().map(|_| None).collect();
                    let read = (instants.clone(), slots.to_vec());
                    groups.push(Group {
                        course: Course::Lanes(Box::new(Together::new(lanes)), some.into_iter(), read),
                        ended,
                    });
                }
                None => groups.extend(some.into_iter().map(|one| Group::alone(one, instants, slots))),
            }
        }
        Tiles { groups, left: instants.len(), slots: slots.len(), threads, stop: None }
    }

    /// Lets all runs fail soon after this is set.
    pub fn stop_by(self, stop: Option<Arc<AtomicBool>>) -> Tiles {
        Tiles { stop, ..self }
    }

    /// The values at the next instants, at most so many: row-major, for each run in the order in which they were given. A
    /// run that has failed once has no further values. Empty at the end.
    pub fn next(&mut self, rows: usize) -> Vec<Result<Vec<f64>, Missing>> {
        let rows = rows.min(self.left);
        if rows == 0 {
            return Vec::new();
        }
        // A run that fails after the last instant fails.
        let is_last = rows == self.left;
        self.left -= rows;
        let wanted = rows * self.slots;
        let share = self.groups.len().div_ceil(self.threads.max(1));
        let stop = self.stop.as_deref();
        let read = |groups: &mut [Group]| -> Vec<Result<Vec<f64>, Missing>> {
            let mut watch = |_: f64| match stop.is_some_and(|stop| stop.load(Ordering::Relaxed)) {
                true => Continue::Break(()),
                false => Continue::Continue(()),
            };
            groups.iter_mut().flat_map(|group| group.read((rows, wanted), is_last, &mut watch)).collect()
        };
        if self.groups.len() <= share {
            return read(&mut self.groups);
        }
        std::thread::scope(|scope| {
            let shares = self.groups.chunks_mut(share);
            let running: Vec<_> = shares.map(|groups| scope.spawn(move || read(groups))).collect();
            running.into_iter().flat_map(|one| one.join().expect("a run does not panic")).collect()
        })
    }
}

impl Group {
    fn alone((instance, experiment): (Instance, Experiment), instants: &Arc<[f64]>, slots: &[Slot]) -> Group {
        let experiment = bare(&experiment);
        match start(instance, &experiment, Observer::probing(&experiment, instants, slots), &mut |_| ()) {
            Ok(course) => Group { course: Course::Alone(Some(course)), ended: vec![None] },
            Err(ended) => {
                let (rest, stop) = *ended;
                let ended = vec![Some((rest.observer.probe, Err(failed(stop))))];
                Group { course: Course::Alone(None), ended }
            }
        }
    }

    /// The next rows of its runs, so many and as many values. `to_end`: these are the last ones.
    fn read(
        &mut self,
        (rows, wanted): (usize, usize),
        to_end: bool,
        watch: &mut dyn FnMut(f64) -> Continue,
    ) -> Vec<Result<Vec<f64>, Missing>> {
        let Group { course, ended } = self;
        let has_enough = |probe: &Probe| !to_end && probe.rows() >= rows;
        match course {
            Course::Lanes(together, waiting, (instants, slots)) => {
                let mut number = ended.len() - waiting.len();
                loop {
                    let lacks = together.courses().any(|(_, course)| !has_enough(course.probe()));
                    if waiting.len() == 0 && !lacks {
                        break;
                    }
                    let mut next = |_| match waiting.next() {
                        Some((instance, experiment)) => {
                            number += 1;
                            Next::Run(number - 1, Box::new((instance, bare(&experiment))))
                        }
                        None => Next::Nothing,
                    };
                    let mut give = |number: usize, rest: stepper::Rest, result: Result<(), _>| {
                        ended[number] = Some((rest.observer.probe, result.map_err(failed)));
                    };
                    let observer = |experiment: &Experiment| Observer::probing(experiment, instants, slots);
                    together.round(&observer, &mut next, &mut give, watch);
                }
            }
            Course::Alone(running) => {
                if let Some(course) = running {
                    let result = stepper::until(&mut **course, &mut |probe| has_enough(probe), watch);
                    let result = match result {
                        Ok(false) => None,
                        Ok(true) => Some(Ok(())),
                        Err(stop) => Some(Err(failed(stop))),
                    };
                    if let Some(result) = result {
                        let rest = running.take().expect("it was running").rest();
                        ended[0] = Some((rest.observer.probe, result));
                    }
                }
            }
        }
        let mut values: Vec<Result<Vec<f64>, Missing>> = ended.iter().map(|_| Err(Missing::Ended)).collect();
        match course {
            Course::Lanes(together, ..) => {
                together.courses().for_each(|(number, course)| values[*number] = Ok(course.probe().draw(rows)));
            }
            Course::Alone(running) => {
                running.iter_mut().for_each(|course| values[0] = Ok(course.probe().draw(rows)));
            }
        }
        for (values, ended) in values.iter_mut().zip(ended) {
            let Some((probe, result)) = ended else { continue };
            *values = match result {
                // All rows of a run that fails before the end of these are lost, as they are if it fails in the next.
                Err(failure) => Err(Missing::Failed(Box::new(failure.clone()))),
                Ok(()) if probe.rows() < rows => Err(Missing::Ended),
                Ok(()) => Ok(probe.draw(rows)),
            };
        }
        debug_assert!(values.iter().flatten().all(|values| values.len() == wanted), "{wanted} values");
        values
    }
}
