//! The description of a compiled model: its quantities, and the slots of the block that hold their values.

use crate::unit::Unit;

/// Index of a number in the block.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub struct Slot(pub u32);

impl Slot {
    /// Time `t`, in s. The code stores it if an equation of the model uses it; otherwise the caller does, with
    /// [`keep_clock`](crate::table::keep_clock).
    pub const TIME: Slot = Slot(0);
    /// Length of a fixed step `h`, in s.
    pub const STEP: Slot = Slot(1);
    /// Number of fixed steps since the start, an integer. `t = COUNT · STEP`, never a running sum. After a single step,
    /// the caller stores it, like time.
    pub const COUNT: Slot = Slot(2);
    /// Number of slots before the first segment.
    pub const FIXED: u32 = 3;

    /// As an index of the block.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

/// Consecutive slots with one purpose.
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

    /// Whether the slot is in this segment.
    pub fn contains(self, slot: Slot) -> bool {
        (self.start..self.start + self.len).contains(&slot.0)
    }

    /// As a range of block indices.
    pub fn range(self) -> std::ops::Range<usize> {
        self.start as usize..(self.start + self.len) as usize
    }
}

/// The segments of a block, in this order, after the fixed slots.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Layout {
    /// Parameters: constant during a step.
    pub params: Segment,
    /// Inputs from outside: held during a step.
    pub inputs: Segment,
    /// Continuous states x.
    pub states: Segment,
    /// Sampled states, held outputs, tick counters, delayed values, and the memory of crossings.
    pub memory: Segment,
    /// Active regime of each automaton, an integer.
    pub regimes: Segment,
    /// Outputs and observed quantities, written by `Outputs` and `Step`.
    pub outputs: Segment,
    /// dx/dt, written by `Derivatives`.
    pub derivatives: Segment,
    /// Switching functions, written by `Roots`.
    pub roots: Segment,
    /// ∂f/∂x, row-major n × n or only the entries of the [coupling](Description::coupling), written by `Jacobian`; then
    /// ∂f/∂t, n entries.
    pub jacobian: Segment,
    /// For each sampled block whether it is due (1 or 0), read by `Tick`.
    pub due: Segment,
    /// A trial of one adaptive step: see [`Trial`](crate::rosenbrock::layout::Trial). Empty without `Rosenbrock`.
    pub trial: Segment,
    /// Samples of delayed quantities in fixed steps: one ring for each [`Delay`]. Empty until the step length is known.
    pub rings: Segment,
}

impl Layout {
    /// Number of slots of the block.
    pub fn size(&self) -> usize {
        let segments = [self.due, self.trial, self.rings];
        segments.map(|segment| segment.start + segment.len).into_iter().fold(Slot::FIXED, u32::max) as usize
    }

    /// The same layout with `len` slots for rings.
    pub fn with_rings(self, len: u32) -> Layout {
        let start = Layout { rings: Segment::default(), ..self.clone() }.size() as u32;
        Layout { rings: Segment { start, len }, ..self }
    }

    /// Lengths of the segments that [`Layout::new`] takes, in the order of the fields.
    pub fn lens(&self) -> [u32; 10] {
        let Layout { params, inputs, states, memory, regimes, outputs, derivatives, roots, jacobian, due, .. } = self;
        [params, inputs, states, memory, regimes, outputs, derivatives, roots, jacobian, due].map(|segment| segment.len)
    }

    /// A layout of consecutive segments with these lengths, in the order of the fields.
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

/// The role of a quantity in its model.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Kind {
    /// Constant during a step.
    Param,
    /// Set from outside.
    Input,
    /// Continuous state.
    State,
    /// State that only changes at ticks.
    SampledState,
    /// Computed, visible outside the model.
    Output,
    /// Computed, private to the model.
    Let,
    /// True while this regime is active.
    Regime,
    /// An expression that an experiment or a rig observes.
    Observed,
}

/// A named quantity.
#[derive(Clone, PartialEq, Debug)]
pub struct Quantity {
    /// Dotted path as the user writes it: `fr.F`, `el[2].f`. For `Observed`: the expression as written.
    pub path: String,
    /// Its role.
    pub kind: Kind,
    /// The unit in which it is declared and displayed. Values in the block are SI.
    pub unit: Unit,
    /// Whether it is a Boolean: 1 or 0.
    pub boolean: bool,
    /// Slot of its value. Outputs and lets are valid after `Outputs` or `Step`.
    pub slot: Slot,
    /// Declared range in SI, infinite if open.
    pub range: (f64, f64),
    /// The doc comment of the model text.
    pub doc: Option<String>,
}

/// A block of sampled code.
#[derive(Clone, PartialEq, Debug)]
pub struct Tick {
    /// Slot of its period in s, written by `Start`.
    pub period: Slot,
    /// Slot of its due flag, in the segment `due`.
    pub due: Slot,
}

/// `delay(x, T)`: the value of x a time T ago, interpolated linearly between samples. Functions of the model read it as
/// `past + weight · (x − past)`. The caller provides past and weight; a fixed step computes them from its ring.
#[derive(Clone, PartialEq, Debug)]
pub struct Delay {
    /// Slot of T in s, in the segment `memory`, written by `Start`.
    pub time: Slot,
    /// Smallest and largest T in s.
    pub range: (f64, f64),
    /// Slot of the distance from the delayed instant t − T to the newest sample, for t at the end of a step; in fixed
    /// steps, at least 0. In the segment `memory`, written by `Start` if there is a ring.
    pub back: Slot,
    /// Slot of x: its own, or one of the segment `outputs`.
    pub source: Slot,
    /// Slot of the past value, in the segment `memory`.
    pub past: Slot,
    /// Slot of the weight of the present x, 0 to 1; 0 if T is at least one step. At the end of a fixed step it is
    /// constant, and written by `Start`. `None` if no step may be longer than the smallest T: the present x is then not
    /// needed.
    pub weight: Option<Slot>,
    /// Slot of the slope of the past value over time, per s: for ∂f/∂t.
    pub slope: Slot,
    /// The ring buffer. Its length is a power of two, and sample k, taken at the end of step k, is in slot k mod
    /// length. Empty until the step length is known.
    pub ring: Segment,
}

/// An automaton: its regimes in the order of the text.
#[derive(Clone, PartialEq, Debug)]
pub struct Automaton {
    /// Path of the part that it belongs to; empty for the whole model.
    pub path: String,
    /// Names of the regimes.
    pub regimes: Vec<String>,
    /// Slot of the index of the active regime, in the segment `regimes`.
    pub slot: Slot,
}

/// The smallest positive number that a range `in > 0` allows, in SI. No measured quantity is smaller, and products and
/// quotients of a few such numbers do not underflow.
pub const TINY: f64 = 1e-40;

/// A range that is checked at run time. A step that leaves it returns the number of the guard, counted from 1.
#[derive(Clone, PartialEq, Debug)]
pub struct Guard {
    /// Path of the quantity.
    pub path: String,
    /// Slot of its value.
    pub slot: Slot,
    /// Smallest and largest value in SI, as declared. A bound of [`TINY`] means that the range excludes 0.
    pub range: (f64, f64),
    /// The unit for messages.
    pub unit: Unit,
}

impl Guard {
    /// Both bounds in words. `show`: formats a value in SI.
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
    /// Whether a transition or an event depends on it, and not only a branch.
    pub decides: bool,
    /// Whether the derivatives are continuous there and only have a kink, as |x| at 0; otherwise they may jump.
    pub bends: bool,
    /// Whether only observed quantities change their branch there: no state or regime depends on it.
    pub observed: bool,
}

/// Everything that is known of a compiled model besides its code.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Description {
    /// The instance as written: `Servo(r = 1 m)`.
    pub name: String,
    /// The layout of its block.
    pub layout: Layout,
    /// Every quantity, in the order of the text; parts after their owner.
    pub quantities: Vec<Quantity>,
    /// Sampled blocks, in the order in which they run if they are due together.
    pub ticks: Vec<Tick>,
    /// Automata.
    pub automata: Vec<Automaton>,
    /// Delayed quantities.
    pub delays: Vec<Delay>,
    /// Guards; `status = k + 1` refers to guard k.
    pub guards: Vec<Guard>,
    /// Switching surfaces.
    pub roots: Vec<Root>,
    /// For a model with many states, the entries (row, column) of ∂f/∂x that are not always 0, sorted by row and
    /// column. `Jacobian` then writes these entries consecutively, followed by ∂f/∂t. Empty if it writes all entries.
    pub coupling: std::sync::Arc<[(u32, u32)]>,
    /// Constants and tables that generated code reads by index.
    pub pool: std::sync::Arc<[f64]>,
}

impl Description {
    /// The quantity with this path.
    pub fn quantity(&self, path: &str) -> Option<&Quantity> {
        self.quantities.iter().find(|quantity| quantity.path == path)
    }

    /// Every slot that the description refers to.
    pub fn slots(&self) -> impl Iterator<Item = Slot> {
        let quantities = self.quantities.iter().map(|quantity| quantity.slot);
        let ticks = self.ticks.iter().flat_map(|tick| [tick.period, tick.due]);
        let automata = self.automata.iter().map(|automaton| automaton.slot);
        let delays = self.delays.iter().flat_map(|delay| {
            // An empty ring has no slot.
            let ring = (delay.ring.len > 0).then(|| delay.ring.slot(delay.ring.len as usize - 1));
            let each = [delay.time, delay.back, delay.source, delay.past, delay.slope];
            each.into_iter().chain(delay.weight).chain(ring)
        });
        quantities.chain(ticks).chain(automata).chain(delays).chain(self.guards.iter().map(|guard| guard.slot))
    }
}
