//! What a compiled model says of itself: its quantities, and where in the block their values lie.

use crate::unit::Unit;

/// A place in the block.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub struct Slot(pub u32);

impl Slot {
    /// Time `t`, in s. Code of a model in whose equations it stands keeps it; all else is told by
    /// [`keep_clock`](crate::table::keep_clock).
    pub const TIME: Slot = Slot(0);
    /// Fixed step `h`, in s.
    pub const STEP: Slot = Slot(1);
    /// Number of fixed steps done since the start: a whole number. `t = COUNT · STEP`, never a running sum. Of a single step
    /// it is told as time is.
    pub const COUNT: Slot = Slot(2);
    /// Number of slots before the first segment.
    pub const FIXED: u32 = 3;

    /// As an index of the block.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

/// Consecutive slots of one purpose.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Segment {
    /// First slot.
    pub start: u32,
    /// Number of slots.
    pub len: u32,
}

impl Segment {
    /// The slot of the `i`-th entry.
    pub fn slot(self, i: usize) -> Slot {
        assert!(i < self.len as usize, "entry {i} of a segment of {}", self.len);
        Slot(self.start + i as u32)
    }

    /// Whether the slot lies in this segment.
    pub fn contains(self, slot: Slot) -> bool {
        (self.start..self.start + self.len).contains(&slot.0)
    }

    /// As a range of block indices.
    pub fn range(self) -> std::ops::Range<usize> {
        self.start as usize..(self.start + self.len) as usize
    }
}

/// The segments of a block, in this order, behind the fixed slots.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Layout {
    /// Parameters: constant during a step.
    pub params: Segment,
    /// Inputs that come from outside: held during a step.
    pub inputs: Segment,
    /// Continuous states x.
    pub states: Segment,
    /// Sampled states, held outputs, tick counters, what is delayed, crossing memory.
    pub memory: Segment,
    /// Active regime of each automaton: a whole number.
    pub regimes: Segment,
    /// Outputs and observed quantities, written by `Outputs` and `Step`.
    pub outputs: Segment,
    /// dx/dt, written by `Derivatives`.
    pub derivatives: Segment,
    /// Switching surfaces, written by `Roots`.
    pub roots: Segment,
    /// ∂f/∂x, row-major n × n or the entries of the [coupling](Description::coupling), written by `Jacobian`; then ∂f/∂t,
    /// n entries.
    pub jacobian: Segment,
    /// For each sampled block: is it due (1) or not (0), read by `Tick`.
    pub due: Segment,
    /// One adaptive step that is tried: see [`Trial`](crate::rosenbrock::layout::Trial). Empty where `Rosenbrock` is not there.
    pub trial: Segment,
    /// Samples of what is delayed, of fixed steps: a ring for each [`Delay`]. Empty until the step is known.
    pub rings: Segment,
}

impl Layout {
    /// Number of slots of the block.
    pub fn size(&self) -> usize {
        let segments = [self.due, self.trial, self.rings];
        segments.map(|segment| segment.start + segment.len).into_iter().fold(Slot::FIXED, u32::max) as usize
    }

    /// The same with so many slots for rings.
    pub fn with_rings(self, len: u32) -> Layout {
        let start = Layout { rings: Segment::default(), ..self.clone() }.size() as u32;
        Layout { rings: Segment { start, len }, ..self }
    }

    /// Lengths of the segments that [`Layout::new`] takes, in the order of the fields.
    pub fn lens(&self) -> [u32; 10] {
        let Layout { params, inputs, states, memory, regimes, outputs, derivatives, roots, jacobian, due, .. } = self;
        [params, inputs, states, memory, regimes, outputs, derivatives, roots, jacobian, due].map(|segment| segment.len)
    }

    /// Puts segments of these lengths one behind the other; the order of the arguments is that of the fields.
    pub fn new(lens: [u32; 10]) -> Layout {
        let mut next = Slot::FIXED;
        let mut take = |len: u32| {
            let segment = Segment { start: next, len };
            next += len;
            segment
        };
        let [params, inputs, states, memory, regimes, outputs, derivatives, roots, jacobian, due] = lens;
        Layout {
            params: take(params),
            inputs: take(inputs),
            states: take(states),
            memory: take(memory),
            regimes: take(regimes),
            outputs: take(outputs),
            derivatives: take(derivatives),
            roots: take(roots),
            jacobian: take(jacobian),
            due: take(due),
            trial: Segment::default(),
            rings: take(0),
        }
    }
}

/// What a quantity is to its model.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Kind {
    /// Constant during a step.
    Param,
    /// From outside.
    Input,
    /// Continuous state.
    State,
    /// State that changes at ticks only.
    SampledState,
    /// Computed, visible from outside.
    Output,
    /// Computed, private.
    Let,
    /// True while this regime is active.
    Regime,
    /// An expression that an experiment or a rig asked for.
    Observed,
}

/// A named quantity.
#[derive(Clone, PartialEq, Debug)]
pub struct Quantity {
    /// Dotted path as the user writes it: `fr.F`, `el[2].f`. For `Observed`: the expression as written.
    pub path: String,
    /// What it is.
    pub kind: Kind,
    /// The unit it is declared and shown in. Values in the block are SI.
    pub unit: Unit,
    /// Whether it is true (1) or false (0) rather than a quantity.
    pub boolean: bool,
    /// Where its value lies. Of outputs and lets, after `Outputs` or `Step`.
    pub slot: Slot,
    /// Declared range in SI, infinite where open.
    pub range: (f64, f64),
    /// The doc comment.
    pub doc: Option<String>,
}

/// A block of sampled code.
#[derive(Clone, PartialEq, Debug)]
pub struct Tick {
    /// Slot of its period in s, written by `Start`.
    pub period: Slot,
    /// Slot that says whether it is due, in the segment `due`.
    pub due: Slot,
}

/// `delay(x, T)`: x as it was T ago, on straight lines between samples. Functions of the model read it as
/// `past + weight · (x − past)`; whoever runs them puts past and weight in place, a fixed step from its ring.
#[derive(Clone, PartialEq, Debug)]
pub struct Delay {
    /// Slot of T in s, in the segment `memory`, written by `Start`.
    pub time: Slot,
    /// Least and greatest T in s.
    pub range: (f64, f64),
    /// Slot of how many fixed steps T lies before the newest sample at the end of a step, no less than 0, in the segment
    /// `memory`, written by `Start` if there is a ring.
    pub back: Slot,
    /// Slot of x: its own, or one of the segment `outputs`.
    pub source: Slot,
    /// Slot of the value before, in the segment `memory`.
    pub past: Slot,
    /// Slot of the part of the way from there to the present x, 0 to 1; 0 where T is no shorter than a step. At the end of
    /// fixed steps it is always the same, and written by `Start`. None where no step may be longer than the least T: then x at
    /// this instant is not needed.
    pub weight: Option<Slot>,
    /// Slot of the slope of the value before along time, per s: for ∂f/∂t.
    pub slope: Slot,
    /// First slot and number of slots of its ring, a power of two: sample k, at the end of step k, lies in slot
    /// k mod number. Empty until the step is known.
    pub ring: Segment,
}

/// One automaton: its regimes in the order of the text.
#[derive(Clone, PartialEq, Debug)]
pub struct Automaton {
    /// Path of the part that it belongs to; empty for the whole.
    pub path: String,
    /// Names of the regimes.
    pub regimes: Vec<String>,
    /// Slot of the number of the active one, in the segment `regimes`.
    pub slot: Slot,
}

/// The least number above 0 that a range `in > 0` allows, in SI: nothing that is measured is smaller, and products and
/// quotients of some such numbers are no zero of a double.
pub const TINY: f64 = 1e-40;

/// A range that is watched while running. A step that leaves it returns the number of the guard, counted from 1.
#[derive(Clone, PartialEq, Debug)]
pub struct Guard {
    /// Path of the quantity.
    pub path: String,
    /// Where its value lies.
    pub slot: Slot,
    /// Smallest and largest value in SI, as declared; a bound of [`TINY`] is that of a range without its zero.
    pub range: (f64, f64),
    /// For messages.
    pub unit: Unit,
}

impl Guard {
    /// Both bounds in words, each shown by `show` from its value in SI.
    pub fn bounds(&self, show: impl Fn(f64) -> String) -> (String, String) {
        let side = |bound: f64, word: &str| match bound.abs() == TINY {
            true => format!("{word} {}", show(0.0)),
            false => show(bound),
        };
        (side(self.range.0, "above"), side(self.range.1, "below"))
    }
}

/// A switching surface of an adaptive run.
#[derive(Clone, PartialEq, Debug)]
pub struct Root {
    /// The condition as written, with its part: `fr: v < -v_hold`.
    pub text: String,
    /// Whether a transition or an event depends on it, rather than a branch only.
    pub decides: bool,
    /// Whether derivatives at most bend there, as at x = 0 with |x|; else they may jump.
    pub bends: bool,
    /// Whether only observed quantities change their branch there: neither states nor regimes depend on it.
    pub observed: bool,
}

/// All that is known of a compiled model besides its code.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Description {
    /// The instance as written: `Servo(r = 1 m)`.
    pub name: String,
    /// Where the values lie.
    pub layout: Layout,
    /// Every quantity, parts after their owner, in the order of the text.
    pub quantities: Vec<Quantity>,
    /// Sampled blocks, in the order in which they run when due together.
    pub ticks: Vec<Tick>,
    /// Automata.
    pub automata: Vec<Automaton>,
    /// What is delayed.
    pub delays: Vec<Delay>,
    /// Watched ranges; `status = k + 1` names guard k.
    pub guards: Vec<Guard>,
    /// Switching surfaces.
    pub roots: Vec<Root>,
    /// Of a model with many states: the entries (row, column) of ∂f/∂x that are not always 0, by rows and then columns.
    /// `Jacobian` then writes these one behind the other, and ∂f/∂t behind them. Empty where it writes all entries.
    pub coupling: std::sync::Arc<[(u32, u32)]>,
    /// Constants that generated code reads by index: tables.
    pub pool: std::sync::Arc<[f64]>,
}

impl Description {
    /// The quantity of this path.
    pub fn quantity(&self, path: &str) -> Option<&Quantity> {
        self.quantities.iter().find(|quantity| quantity.path == path)
    }

    /// Every slot that is named in it.
    pub fn slots(&self) -> impl Iterator<Item = Slot> {
        let quantities = self.quantities.iter().map(|quantity| quantity.slot);
        let ticks = self.ticks.iter().flat_map(|tick| [tick.period, tick.due]);
        let automata = self.automata.iter().map(|automaton| automaton.slot);
        let delays = self.delays.iter().flat_map(|delay| {
            // An empty ring lies nowhere.
            let ring = (delay.ring.len > 0).then(|| delay.ring.slot(delay.ring.len as usize - 1));
            let each = [delay.time, delay.back, delay.source, delay.past, delay.slope];
            each.into_iter().chain(delay.weight).chain(ring)
        });
        quantities.chain(ticks).chain(automata).chain(delays).chain(self.guards.iter().map(|guard| guard.slot))
    }
}
