//! Runs of one model in the lanes of one program: each call of its code makes a step of all of them.
//!
//! In: runs, handed over one by one. Out: what became of each, to the bit as it would be alone. A run whose step is
//! to be looked at leaves its lane for as long as that takes and comes back; a lane whose run has ended takes the next one.

use crate::engine::{Failure, Outcome, ended, start};
use crate::run::observe::Observer;
use crate::run::outcome::{Continue, Stop};
use crate::run::stepper::Stepper;
use abi::Instance;
use abi::lanes::{Batch, Lanes};
use abi::plan::Experiment;

/// What there is to do for a lane that is free.
pub enum Next<T> {
    /// This run; what its outcome is to be given with.
    Run(T, Box<(Instance, Experiment)>),
    /// Nothing yet.
    Later,
    /// Nothing any more.
    Nothing,
}

/// Steps of all lanes in one call, at most; and the part that this may be of those since a run was last looked at: the step
/// at which the loop is left before its end is made twice.
const MOST: u64 = 4096;
const PART: u64 = 16;

/// Runs what `next` hands over in lanes, which must be of the function that the solver of all of them calls, until nothing
/// is left; each outcome goes to `give`. `next` is told whether runs are under way: if not, it must not put off.
///
/// # Panics
/// As [`engine::run`](crate::engine::run).
pub fn run<T>(
    lanes: &Lanes,
    next: &mut dyn FnMut(bool) -> Next<T>,
    give: &mut dyn FnMut(T, Result<Outcome, Failure>),
    watch: &mut dyn FnMut(f64) -> Continue,
) {
    let mut batch = Batch::new(lanes.clone());
    let mut all: Vec<Option<Lane<T>>> = (0..batch.width()).map(|_| None).collect();
    // Which lanes without a run do what no run does.
    let mut astray = vec![true; batch.width()];
    let mut pool = None;
    let (mut calm, mut total, mut more) = (0, 0, true);
    loop {
        let stride = (calm / PART).clamp(1, MOST);
        for lane in 0..all.len() {
            while more && all[lane].is_none() {
                match next(all.iter().any(Option::is_some)) {
                    Next::Run(tag, what) => all[lane] = begin(tag, *what, &mut batch, (lane, total), give, watch),
                    Next::Later => break,
                    Next::Nothing => more = false,
                }
            }
        }
        let Some(model) = all.iter().position(Option::is_some) else { break };
        // A lane without a run does what another one does, so that no step ends for its sake.
        for lane in 0..all.len() {
            if all[lane].is_none() && astray[lane] && stride > 1 {
                batch.copy_lane(model, lane);
                astray[lane] = false;
            }
        }
        let next = all.iter().flatten().map(|lane| lane.until).min().expect("there is one");
        let course = &mut all[model].as_mut().expect("there is one").course;
        let pool = pool.get_or_insert_with(|| course.instance().description().pool.clone());
        let done = batch.advance(pool, (next - total).min(stride));
        total += done;
        let mut looked = false;
        for (number, place) in all.iter_mut().enumerate() {
            let status = batch.status(number);
            let Some(lane) = place else {
                astray[number] |= status != 0;
                continue;
            };
            if status == 0 && lane.until > total {
                continue;
            }
            looked |= status != 0;
            if let Some(result) = lane.look(&mut batch, (number, total), status, watch) {
                let lane = place.take().expect("it was there");
                astray[number] = true;
                give(lane.tag, ended(lane.course.rest(), result));
            }
        }
        calm = if looked { 0 } else { calm + done };
    }
}

/// A run in its lane.
struct Lane<T> {
    tag: T,
    course: Box<dyn Stepper>,
    /// Number of the step, of all that the lanes make, behind which it was looked at last, and behind which it must be again.
    since: u64,
    until: u64,
}

/// Puts a run into a lane, behind so many steps; none if it has ended already.
fn begin<T>(
    tag: T,
    (instance, experiment): (Instance, Experiment),
    batch: &mut Batch,
    (number, total): (usize, u64),
    give: &mut dyn FnMut(T, Result<Outcome, Failure>),
    watch: &mut dyn FnMut(f64) -> Continue,
) -> Option<Lane<T>> {
    let mut course = match start(instance, &experiment, Observer::new(&experiment), &mut |_| ()) {
        Ok(course) => course,
        Err(failed) => {
            let (rest, stop) = *failed;
            give(tag, ended(rest, Err(stop)));
            return None;
        }
    };
    match course.next(watch) {
        Ok(Some(left)) => {
            batch.load(number, course.instance().block());
            Some(Lane { tag, course, since: total, until: total.saturating_add(left) })
        }
        result => {
            give(tag, ended(course.rest(), result.map(|_| ())));
            None
        }
    }
}

impl<T> Lane<T> {
    /// Lets the run look at what was left in its lane behind so many steps and go on to its next call; how it ended, if it has.
    fn look(
        &mut self,
        batch: &mut Batch,
        (number, total): (usize, u64),
        status: u64,
        watch: &mut dyn FnMut(f64) -> Continue,
    ) -> Option<Result<(), Stop>> {
        let done = total - std::mem::replace(&mut self.since, total);
        self.course.fetch(done, status, &|slots, block| batch.save_part(number, slots, block));
        if let Err(stop) = self.course.take(done, status) {
            return Some(Err(stop));
        }
        match self.course.next(watch) {
            Ok(Some(left)) => {
                self.until = total.saturating_add(left);
                self.course.bring(&mut |slots, block| batch.load_part(number, slots, block));
                None
            }
            result => Some(result.map(|_| ())),
        }
    }
}
