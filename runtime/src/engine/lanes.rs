//! Runs of one model in the SIMD lanes of one program: each call advances all lanes.
//!
//! In: runs, delivered one by one. Out: the outcome of each, bit-identical to running it alone. When a run needs
//! attention, its block is copied out of the lane and back; when a run ends, its lane takes the next one.

use crate::engine::{Failure, Outcome, ended, start};
use crate::run::observe::Observer;
use crate::run::outcome::{Continue, Stop};
use crate::run::stepper::{Rest, Stepper};
use crate::stretch::copy_column;
use abi::lanes::{Batch, Lanes};
use abi::plan::Experiment;
use abi::{Instance, Slot};
use std::sync::Arc;

/// The answer to a request for another run.
pub enum Next<T> {
    /// A run, with a tag that its outcome is returned with.
    Run(T, Box<(Instance, Experiment)>),
    /// None at present.
    Later,
    /// None any more.
    Nothing,
}

/// Most steps of all lanes in one call, and the limit of that number as a fraction (1/16) of the steps since a run last
/// needed attention: when the loop is left early, the step at which it is left is computed twice.
const MOST: u64 = 4096;
const PART: u64 = 16;

/// Most steps between two looks at a run that reads each of them.
const ROWS: u64 = 128;

/// What runs that read every step read: the values of some slots after each of the last steps, step by step, slot by slot,
/// lane by lane. A run reads its steps when it is looked at, however many there are by then.
struct Series {
    /// The slots; all such runs read the same, because they have the same plan.
    slots: Vec<Slot>,
    rows: Vec<f64>,
    /// The rows of the last call.
    latest: Vec<f64>,
    width: usize,
    /// The common step count before the first row.
    first: u64,
}

impl Series {
    /// Makes some steps and adds a row for each; returns their number.
    fn advance(&mut self, batch: &mut Batch, pool: &[f64], count: u64) -> u64 {
        let done = batch.advance_and_read(pool, count, &self.slots, &mut self.latest);
        self.latest.truncate(done as usize * self.slots.len() * self.width);
        match self.rows.is_empty() {
            true => std::mem::swap(&mut self.rows, &mut self.latest),
            false => self.rows.extend_from_slice(&self.latest),
        }
        done
    }

    /// Writes the values of a slot in one lane after each of the first steps since a step count.
    fn read(&self, since: u64, slot: usize, lane: usize, column: &mut [f64]) {
        let row = self.slots.len() * self.width;
        let begin = (since - self.first) as usize * row + slot * self.width + lane;
        copy_column(&self.rows[begin..], row, column);
    }
}

/// The number of calls until a run needs attention, if it would be `left` without a series.
fn calls(course: &dyn Stepper, left: u64) -> u64 {
    course.series().map_or(left, |(_, most)| most)
}

/// Runs everything that `next` delivers, in lanes; the solver of all runs must call the function of these lanes. Passes
/// each outcome to `give`. `next` receives whether runs are in progress; if none is, it must not answer
/// [`Next::Later`].
///
/// # Panics
/// As [`engine::run`](crate::engine::run).
pub fn run<T>(
    lanes: &Lanes,
    next: &mut dyn FnMut(bool) -> Next<T>,
    give: &mut dyn FnMut(T, Result<Outcome, Failure>),
    watch: &mut dyn FnMut(f64) -> Continue,
) {
    let mut ended = |tag, rest, result| give(tag, ended(rest, result));
    let mut together = Together::new(lanes);
    while together.round(&Observer::new, next, &mut ended, watch) {}
}

/// Passes the parts of a run that has ended to the caller.
pub(crate) type Give<'g, T> = dyn FnMut(T, Rest, Result<(), Stop>) + 'g;

/// Runs in progress.
pub(crate) struct Together<T> {
    batch: Batch,
    all: Vec<Option<Lane<T>>>,
    /// Idle lanes whose contents may end a step with a status.
    astray: Vec<bool>,
    pool: Option<Arc<[f64]>>,
    /// Steps since a run last needed attention, and those of all.
    calm: u64,
    total: u64,
    /// Whether there may be further runs.
    more: bool,
    series: Series,
}

impl<T> Together<T> {
    /// Without runs yet.
    pub(crate) fn new(lanes: &Lanes) -> Together<T> {
        let batch = Batch::new(lanes.clone());
        let all = (0..batch.width()).map(|_| None).collect();
        let astray = vec![true; batch.width()];
        let [rows, latest] = [(); 2].map(|()| Vec::new());
        let series = Series { slots: Vec::new(), rows, latest, width: batch.width(), first: 0 };
        Together { batch, all, astray, pool: None, calm: 0, total: 0, more: true, series }
    }

    /// The runs in progress.
    pub(crate) fn courses(&mut self) -> impl Iterator<Item = (&T, &mut dyn Stepper)> {
        self.all.iter_mut().flatten().map(|lane| (&lane.tag, &mut *lane.course as &mut dyn Stepper))
    }

    /// Fills idle lanes, each run with an observer of its own, and makes some steps of all. Returns whether there were any.
    pub(crate) fn round(
        &mut self,
        observer: &dyn Fn(&Experiment) -> Observer,
        next: &mut dyn FnMut(bool) -> Next<T>,
        give: &mut Give<T>,
        watch: &mut dyn FnMut(f64) -> Continue,
    ) -> bool {
        let Together { batch, all, astray, pool, calm, total, more, series } = self;
        let stride = (*calm / PART).clamp(1, MOST);
        for lane in 0..all.len() {
            while *more && all[lane].is_none() {
                match next(all.iter().any(Option::is_some)) {
                    Next::Run(tag, what) => {
                        let observer = observer(&what.1);
                        all[lane] = begin(tag, *what, observer, batch, (lane, *total), give, watch);
                    }
                    Next::Later => break,
                    Next::Nothing => *more = false,
                }
            }
        }
        let Some(model) = all.iter().position(Option::is_some) else { return false };
        // An idle lane computes a copy of an active one, so that it never ends a call early.
        for lane in 0..all.len() {
            if all[lane].is_none() && astray[lane] && stride > 1 {
                batch.copy_lane(model, lane);
                astray[lane] = false;
            }
        }
        let next = all.iter().flatten().map(|lane| lane.until).min().expect("there is one");
        let course = &mut all[model].as_mut().expect("there is one").course;
        let pool = pool.get_or_insert_with(|| course.instance().description().pool.clone());
        let count = (next - *total).min(stride);
        let unread = all.iter().flatten().filter(|lane| lane.reads_each).map(|lane| lane.since).min();
        let done = match unread {
            Some(since) => {
                if series.slots.is_empty() {
                    let slots = all.iter().flatten().find_map(|lane| Some(lane.course.series()?.0.to_vec()));
                    series.slots = slots.expect("a run reads them");
                }
                if since == *total {
                    series.first = since;
                    series.rows.clear();
                }
                series.advance(batch, pool, count.min(ROWS - (*total - series.first)))
            }
            None => batch.advance(pool, count),
        };
        *total += done;
        let is_full = unread.is_some() && *total - series.first == ROWS;
        let mut looked = false;
        for (number, place) in all.iter_mut().enumerate() {
            let status = batch.status(number);
            let Some(lane) = place else {
                astray[number] |= status != 0;
                continue;
            };
            if status == 0 && lane.until > *total && !(lane.reads_each && is_full) {
                continue;
            }
            looked |= status != 0;
            if let Some(result) = lane.look(batch, (number, *total), status, series, watch) {
                let lane = place.take().expect("it was there");
                astray[number] = true;
                give(lane.tag, lane.course.rest(), result);
            }
        }
        *calm = if looked { 0 } else { *calm + done };
        true
    }
}

/// A run in a lane.
struct Lane<T> {
    tag: T,
    course: Box<dyn Stepper>,
    /// The common step count at which the run was last inspected, and the one at which it must be inspected next.
    since: u64,
    until: u64,
    /// Whether it has a series now.
    reads_each: bool,
}

/// Loads a run into a lane at this step count; none if it has already ended.
fn begin<T>(
    tag: T,
    (instance, experiment): (Instance, Experiment),
    observer: Observer,
    batch: &mut Batch,
    (number, total): (usize, u64),
    give: &mut Give<T>,
    watch: &mut dyn FnMut(f64) -> Continue,
) -> Option<Lane<T>> {
    let mut course = match start(instance, &experiment, observer, &mut |_| ()) {
        Ok(course) => course,
        Err(failed) => {
            let (rest, stop) = *failed;
            give(tag, rest, Err(stop));
            return None;
        }
    };
    let left_out = course.instance().left_out().len();
    assert_eq!(left_out, batch.left_out().len(), "lanes and run leave out the same outputs");
    match course.next(watch) {
        Ok(Some(left)) => {
            batch.load(number, course.instance().block());
            let until = total.saturating_add(calls(&*course, left));
            let reads_each = course.series().is_some();
            Some(Lane { tag, course, since: total, until, reads_each })
        }
        result => {
            give(tag, course.rest(), result.map(|_| ()));
            None
        }
    }
}

impl<T> Lane<T> {
    /// Lets the run process the block in its lane at this step count and continue to its next call; returns how it
    /// ended, if it has.
    fn look(
        &mut self,
        batch: &mut Batch,
        (number, total): (usize, u64),
        status: u64,
        series: &Series,
        watch: &mut dyn FnMut(f64) -> Continue,
    ) -> Option<Result<(), Stop>> {
        let since = std::mem::replace(&mut self.since, total);
        let done = total - since;
        if let Some((slots, _)) = self.course.series() {
            assert_eq!(slots, series.slots, "all runs in lanes read the same slots");
            if let Err(stop) = self.course.show(done, &|slot, column| series.read(since, slot, number, column)) {
                return Some(Err(stop));
            }
        }
        self.course.fetch(done, status, &|slots, block| batch.save_part(number, slots, block));
        if let Err(stop) = self.course.take(done, status) {
            return Some(Err(stop));
        }
        match self.course.next(watch) {
            Ok(Some(left)) => {
                self.until = total.saturating_add(calls(&*self.course, left));
                self.reads_each = self.course.series().is_some();
                self.course.bring(&mut |slots, block| batch.load_part(number, slots, block));
                None
            }
            result => Some(result.map(|_| ())),
        }
    }
}
