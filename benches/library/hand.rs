//! Models of the library in C, written by hand (`models.c`): their ports, and a comparison with the model itself.
//!
//! In: the library and the C, compiled by gcc. Out: both with the same inputs, parameters and initial values, and
//! whether they agree. The bench times what agrees; `tests/models_in_c.rs` checks that all of it does.

use abi::description::Kind;
use abi::{Description, Instance, Slot};
use std::ffi::{CStr, c_char};
use std::sync::Arc;

/// Length of the input sequence, which then repeats.
pub const COURSE: usize = 4096;
/// Rows of the input sequence after which it begins again; a round may run that far beyond its end.
pub const BEYOND: usize = 1200;
/// Steps for which both must agree.
pub const COMPARED: usize = 20_000;
/// Largest difference of a quantity, relative to its largest value so far.
const TOLERANCE: f64 = 1e-9;

/// Models without C, and why.
pub const LEFT_OUT: &[(&str, &str)] = &[
    ("ForceBench", "a mass around the contact in its slot, not a model to call by itself"),
    ("BandedBench", "a mass with a dead band around the contact in its slot"),
    ("ObserverBench", "a mass around the observer in its slot"),
    ("SpeedBench", "hands its speed to the contact in its slot"),
    ("SpringBench", "a spring around the contact in its slot"),
    ("Servo", "a whole closed loop: benches/step.rs has it"),
    ("TrackingServo", "a whole closed loop"),
    ("Pull", "a whole closed loop"),
    ("Hold", "a whole closed loop"),
    ("Trapezoid", "a function of time alone, which C here does not get"),
    ("SCurve", "a function of time alone, which C here does not get"),
    ("LowPass", "two coupled states and constant coefficients, like SpeedObserver"),
    ("Notch", "two coupled states and constant coefficients, like SpeedObserver"),
];

/// The step length at which a model is called, s: a sampled one at its own rate.
pub fn step_length(name: &str) -> f64 {
    if name == "DriveTorqueSampled" { 0.5e-3 } else { 1e-3 }
}

/// A model in C: the names of its ports, which map numbers to slots, and its step.
#[repr(C)]
pub struct Hand {
    name: *const c_char,
    inputs: *const c_char,
    params: *const c_char,
    states: *const c_char,
    outputs: *const c_char,
    pub step: unsafe extern "C" fn(*mut f64, *const f64, *const f64, *mut f64, f64),
    /// The same with guards.
    pub checked: unsafe extern "C" fn(*mut f64, *const f64, *const f64, *mut f64, f64) -> i64,
    /// Which states it guards, as a bit mask.
    watched: u64,
    number_of_outputs: u64,
}

/// All models of the compiled source.
pub fn hands(library: &libloading::Library) -> Vec<&Hand> {
    // SAFETY: the table is in the source.
    let table = unsafe { library.get::<*const Hand>(b"models") }.expect("the source has a table");
    // SAFETY: the table ends with an entry without a name.
    (0..).map(|k| unsafe { &*table.add(k) }).take_while(|hand| !hand.name.is_null()).collect()
}

impl Hand {
    pub fn name(&self) -> String {
        words(self.name).concat()
    }
}

fn words(text: *const c_char) -> Vec<String> {
    // SAFETY: the table holds C strings, which live as long as the library.
    let text = unsafe { CStr::from_ptr(text) }.to_str().expect("names are ASCII");
    text.split_whitespace().map(String::from).collect()
}

/// The meaning of a name of a state in C.
enum State {
    /// In the block.
    Slot(Slot),
    /// C's own state, with the initial value of an input (`.v`) or 0 (`.`).
    Own(f64),
}

/// A model of the library and its C, at the same instant.
pub struct Pair<'h> {
    name: String,
    hand: &'h Hand,
    description: Arc<Description>,
    /// Step length, s.
    pub h: f64,
    pub inputs: Vec<Slot>,
    pub outputs: Vec<Slot>,
    pub params: Vec<f64>,
    /// The states of the C.
    pub x: Vec<f64>,
    /// Its states that the model has, too, with their slots.
    in_block: Vec<(usize, Slot)>,
    /// The inputs at each instant, one after the other.
    pub course: Vec<f64>,
}

impl<'h> Pair<'h> {
    /// Starts the model with the first row of inputs.
    ///
    /// # Errors
    /// A port of the C that the model does not have, or one that the C lacks.
    pub fn new(name: &str, hand: &'h Hand, ours: &mut Instance) -> Result<Pair<'h>, String> {
        let h = step_length(name);
        let description = ours.description().clone();
        let layout = &description.layout;
        let find = |path: &String| {
            let quantity = description.quantity(path);
            quantity.map(|quantity| quantity.slot).ok_or_else(|| format!("{name} has no {path}: models.c names it"))
        };
        let slots = |names: &[String]| names.iter().map(find).collect::<Result<Vec<Slot>, String>>();
        let names = words(hand.inputs);
        let inputs = slots(&names)?;
        let in_order = inputs.iter().enumerate().all(|(k, slot)| *slot == layout.inputs.slot(k));
        if !in_order || inputs.len() != layout.inputs.len as usize {
            return Err(format!("{name}: the inputs of models.c, {names:?}, are not those of the text, in its order"));
        }
        let course = course(name, &names);
        ours.block_mut()[layout.inputs.range()].copy_from_slice(&course[..inputs.len()]);
        let status = ours.start(h);
        if status != 0 {
            return Err(format!("{name} does not start: status {status}"));
        }
        let params = slots(&words(hand.params))?.into_iter().map(|slot| ours.get(slot)).collect();
        let names = words(hand.states);
        let states: Vec<State> =
            names.iter().map(|path| state(&description, path, ours)).collect::<Option<_>>().ok_or_else(|| {
                let missing = names.iter().find(|path| state(&description, path, ours).is_none());
                format!("{name} has no state {}: models.c names it", missing.expect("one is missing"))
            })?;
        let outputs = slots(&words(hand.outputs))?;
        let slot_of = |state: &State| match state {
            State::Slot(slot) => Some(*slot),
            State::Own(_) => None,
        };
        let in_block: Vec<(usize, Slot)> =
            states.iter().enumerate().filter_map(|(k, state)| Some((k, slot_of(state)?))).collect();
        for quantity in &description.quantities {
            let known = match quantity.kind {
                Kind::State | Kind::SampledState => in_block.iter().any(|(_, slot)| *slot == quantity.slot),
                // Outputs of parts are inner quantities.
                Kind::Output => quantity.path.contains('.') || outputs.contains(&quantity.slot),
                _ => true,
            };
            if !known {
                return Err(format!("{name} in models.c lacks {:?} {}", quantity.kind, quantity.path));
            }
        }
        let own = names.iter().enumerate().filter(|(_, path)| !path.starts_with(['.', '@']));
        let watched = own.fold(0u64, |all, (k, _)| all | 1 << k);
        if (hand.watched, hand.number_of_outputs) != (watched, outputs.len() as u64) {
            return Err(format!(
                "{name} in models.c guards the states {:#x} and {} outputs, not {watched:#x} and {}: all of its own",
                hand.watched,
                hand.number_of_outputs,
                outputs.len()
            ));
        }
        let begin = |state: &State| match state {
            State::Slot(slot) => ours.get(*slot),
            State::Own(begin) => *begin,
        };
        let x = states.iter().map(begin).collect();
        Ok(Pair { name: name.to_string(), hand, h, inputs, outputs, params, x, in_block, course, description })
    }

    /// Inputs at an instant.
    fn row(&self, k: usize) -> &[f64] {
        &self.course[k % COURSE * self.inputs.len()..][..self.inputs.len()]
    }

    /// Runs both for some steps.
    ///
    /// # Errors
    /// The first step after which a state or an output differs, with both values.
    pub fn agrees(&mut self, ours: &mut Instance, steps: usize) -> Result<(), String> {
        let (name, inputs) = (&self.name, self.description.layout.inputs.range());
        let mut out = vec![0.0; self.outputs.len()];
        let mut largest = vec![0.0f64; self.in_block.len() + out.len()];
        for k in 1..steps {
            ours.block_mut()[inputs.clone()].copy_from_slice(self.row(k));
            let status = ours.advance(1);
            if status != 0 {
                return Err(format!("{name} at step {k}: {:?}", self.description.guards.get(status as usize - 1)));
            }
            let (x, row) = (self.x.as_mut_ptr(), self.row(k).as_ptr());
            // SAFETY: the arrays are as long as the names that the source gives.
            unsafe { (self.hand.step)(x, self.params.as_ptr(), row, out.as_mut_ptr(), self.h) };
            let states = self.in_block.iter().map(|(k, slot)| (self.x[*k], *slot));
            let outputs = out.iter().copied().zip(self.outputs.iter().copied());
            for ((c, slot), largest) in states.chain(outputs).zip(&mut largest) {
                let own = ours.get(slot);
                *largest = largest.max(own.abs());
                let differs = (c - own).abs() > TOLERANCE * *largest || c.is_nan() != own.is_nan();
                if differs {
                    let quantity = self.description.quantities.iter().find(|quantity| quantity.slot == slot);
                    let path = quantity.map_or("a mode or the step count", |quantity| quantity.path.as_str());
                    return Err(format!("{name} at step {k}, inputs {:?}: {path} is {own:e}, in C {c:e}", self.row(k)));
                }
            }
        }
        Ok(())
    }
}

/// The state of a name in C; `None` if the model has none of this name.
fn state(description: &Description, path: &str, ours: &Instance) -> Option<State> {
    if path == "@count" {
        return Some(State::Slot(Slot::COUNT));
    }
    if let Some(part) = path.strip_prefix("@mode") {
        let part = part.trim_start_matches(':');
        return description.automata.iter().find(|automaton| automaton.path == part).map(|it| State::Slot(it.slot));
    }
    let slot = |path: &str| description.quantity(path).map(|quantity| quantity.slot);
    match path.strip_prefix('.') {
        Some("") => Some(State::Own(0.0)),
        Some(input) => slot(input).map(|slot| State::Own(ours.get(slot))),
        None => slot(path).map(State::Slot),
    }
}

/// The inputs at each instant, one after the other: through zero and over the whole working range of contacts.
fn course(name: &str, inputs: &[String]) -> Vec<f64> {
    let mut course = Vec::new();
    for k in (0..COURSE).chain(0..BEYOND) {
        for (number, input) in inputs.iter().enumerate() {
            let angle = std::f64::consts::TAU * k as f64 / COURSE as f64;
            // The platform's sine is good enough for inputs.
            #[allow(clippy::disallowed_methods)]
            let wave = |cycles: f64| (cycles * angle + 0.3 + number as f64).sin();
            let mixed = 0.7 * wave(7.0) + 0.3 * wave(31.0);
            course.push(match input.as_str() {
                // Pushed against each stop in turn until it rests there: if it kept rebounding, the impacts would
                // amplify differences of rounding.
                "u" if name == "StoppedAxis" => 50.0 * wave(1.0).signum(),
                // Beyond both stops.
                "x" if name == "EndStops" => 0.15 * mixed,
                "v" | "v_d" => 5e-3 * mixed,
                "de" => 1e-3 * mixed,
                "v0" => 1e-3 + 0.5e-3 * mixed,
                "limit" => 0.4 + 0.1 * mixed,
                "e" => 20e-6 * mixed,
                "r" | "y" | "x" => 3e-3 * mixed,
                "rest" => 1.5 + mixed,
                "Fn" | "F_l" | "Fl" => 1.5 + mixed,
                "T" => 50.0 + 40.0 * mixed,
                "u" | "u_in" | "F_ext" | "F_m" | "F_e" | "F_motor" | "F_load" => 2.0 * mixed,
                // Above the stiction between two masses.
                "F1" | "F2" => 6.0 * mixed,
                other => panic!("{name}: what does the input `{other}` do?"),
            });
        }
    }
    course
}
