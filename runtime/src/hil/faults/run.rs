//! Runs one script in simulated time: start, rest, motion, a change of parameters, stop, and optionally a second
//! program.
//!
//! In: a [`Script`]. Out: a summary of the run, or the first property it violated.

use super::broken::Broken;
use super::invariants::{CLAMPED_NS, Judge, RAMP, STANDSTILL_NS, Violation};
use super::rigs::TWINS;
use super::space::{EVER, Fault, Ill, MS, Only, Phase, Script, What};
use super::wire::{Tap, Traffic};
use crate::can::sim::{BusFaultKind as Planting, Fault as Planted, Join, Port};
use crate::can::{Bus, Frame, Received};
use crate::canopen::object::Entry;
use crate::canopen::{Access, NmtState, Object, ObjectDictionary};
use crate::drive::fault_injection::{Effect, Hook, Start};
use crate::drive::polarity_check::SignTest;
use crate::drive::simulated::Behaviour;
use crate::drive::simulated_plant::SimulatedBench;
use crate::drive::state::Times;
use crate::drive::{self, Step};
use crate::hil::control::{self, Control};
use crate::hil::cycle::{Command, End, Hil, Operator, Options};
use crate::hil::live::{self, Set};
use crate::hil::operator::{Answer, Reason, Stamp, Ticket};
use crate::hil::replay::Replay;
use crate::hil::simulated::{BENCH, MASTER, Pace, World};
use crate::hil::trace;
use crate::hil::watches::Bounds;
use crate::realtime::clock::Clock;
use crate::record::log::Message;
use crate::safety::Cause;
use abi::rig::Rig;
use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::Rc;

/// Step of the simulated shaft, ns: it is a rigid body, and drives follow their lag exactly for any step.
const STEP_NS: u64 = 100_000;
/// Durations of the phases, ns.
const MOVING_NS: u64 = 110 * MS;
const CHANGE_NS: u64 = 30 * MS;
/// Longest duration of a start, ns.
const START_NS: u64 = 60_000 * MS;
/// Longest time from a stop to the end of the program, and the time observed after it, ns.
const END_NS: u64 = 3_000 * MS;
const AFTER_NS: u64 = 120 * MS;

/// Summary of a run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Passed {
    /// Number of times that each phase began, in the order of [`Phase::ALL`].
    pub phases: [u32; Phase::ALL.len()],
    /// Checked cycles.
    pub cycles: u64,
    /// The cause of the first stop.
    pub cause: Option<Cause>,
    /// A hash of all permitted outputs and torques.
    pub hash: u64,
}

/// A running script.
struct ScriptRun<'a> {
    script: &'a Script,
    rig: Rig,
    made: (abi::Instance, abi::Instance),
    world: World,
    traffic: Rc<RefCell<Traffic>>,
    /// Ports that listen on each bus and never send.
    witnesses: Vec<Port>,
    /// Intervals without cycles: begin, end, and the length of each pause, ns.
    frozen: Vec<(u64, u64, u64)>,
    foreign: Vec<(u64, usize, u32)>,
    down: Vec<(u64, usize)>,
    others: Vec<Port>,
    passed: Passed,
    words: Vec<u64>,
    /// The second program is running.
    second: bool,
}

/// Runs a script; a panic of our own code is a failure like any other.
pub fn run(script: &Script) -> Result<Passed, Violation> {
    catch_unwind(AssertUnwindSafe(|| ScriptRun::new(script).all())).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<String>().cloned();
        let text = text.or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_string()));
        Err(Violation { broken: Broken::Panic, at_ns: 0, text: text.unwrap_or_default() })
    })
}

fn options(script: &Script) -> Options {
    let start = drive::Options {
        listen_ns: 5 * MS,
        steady_ns: 10 * MS,
        sign_test: if script.tested { SignTest::Push } else { SignTest::Skip },
        timeout_test: script.tested,
        ..drive::Options::default()
    };
    let control = control::Options {
        ramp_ns: RAMP * MS,
        clamped_ns: CLAMPED_NS,
        standstill_ns: STANDSTILL_NS,
        blend_ns: 10 * MS,
        ..control::Options::default()
    };
    let only_simulated = (script.only != Only::Any).then(|| "it arms itself".to_string());
    Options { control, start, arms_itself: true, only_simulated, ..Options::default() }
}

/// Makes the first drive claim another identity than that of our simulated drives.
fn imitate(objects: &mut ObjectDictionary, only: Only) {
    match only {
        Only::OtherName => {
            objects.add(Entry::text(Object(0x1008, 0), "device name", Access::Constant, "fric imitated", 14))
        }
        _ => objects.set(Object(0x1018, 1), 0x0123),
    }
}

/// Drives that boot fast, because their times are not under test.
pub fn behaviour() -> Behaviour {
    let times = Times { switch_on_ns: MS, enable_ns: 5 * MS, disable_ns: 2 * MS, start_ns: MS };
    Behaviour { boot_ns: 5 * MS, times, ..Behaviour::default() }
}

impl<'a> ScriptRun<'a> {
    fn new(script: &'a Script) -> ScriptRun<'a> {
        let (rig, control, plant) = script.rig.build();
        let bench = SimulatedBench::with(&rig, Some(plant.clone()), script.seed, |_| behaviour()).unwrap();
        let bench = bench.in_steps_of(STEP_NS);
        let world = World::around(&rig, bench, Pace::Fast, script.seed).unwrap();
        let join = || Join { listen_only: true, ..Join::default() };
        let witnesses = (0..rig.buses.len()).map(|bus| world.bus(bus).join("witness", join())).collect();
        ScriptRun {
            script,
            witnesses,
            rig,
            made: (control, plant),
            world,
            traffic: Traffic::new(),
            frozen: Vec::new(),
            foreign: Vec::new(),
            down: Vec::new(),
            others: Vec::new(),
            passed: Passed { hash: 0xcbf2_9ce4_8422_2325, ..Passed::default() },
            words: Vec::with_capacity(1 << 12),
            second: false,
        }
    }

    fn now(&self) -> u64 {
        self.world.simulation().now_ns()
    }

    fn broken(&self, broken: Broken, text: impl Into<String>) -> Violation {
        Violation { broken, at_ns: self.now(), text: text.into() }
    }

    fn all(mut self) -> Result<Passed, Violation> {
        self.program(false)?;
        if self.script.again {
            self.second = true;
            self.program(true)?;
        }
        Ok(self.passed)
    }

    /// Runs one program from its start to its end.
    fn program(&mut self, again: bool) -> Result<(), Violation> {
        let buses = (0..self.rig.buses.len()).map(|bus| {
            let port = self.world.bus(bus).port(MASTER);
            Box::new(Tap { port, bus, traffic: self.traffic.clone() }) as Box<dyn Bus>
        });
        let (clock, buses) = (self.world.clock(), buses.collect());
        let made = Hil::new(&self.rig, self.made.0.clone(), clock, buses, options(self.script), None);
        let checks = super::rigs::judge(&self.made.0);
        let (mut hil, operator) = match made {
            Ok(made) => made,
            // Refused before anything is sent.
            Err(_) if self.script.rig.safe != 0.0 => return Ok(()),
            Err(why) => return Err(self.broken(Broken::Needless, why)),
        };
        let (judge, rig) = (Judge::new(self.script, &self.rig), self.rig.clone());
        hil.judged_by(checks.clone());
        let (said, replay) = (Vec::new(), None);
        let mut program = Program { hil, operator, judge, rig: &rig, replay, checks, said, patience: 0, twin: 0.0 };
        self.enter(if again { Phase::Again } else { Phase::StartUp });
        self.go(&mut program, again)?;
        // The process has ended: a drive that still has torque is stopped by its own time-out.
        let Program { hil, judge, .. } = program;
        let gone_ns = self.now();
        drop(hil);
        while self.now() < gone_ns + AFTER_NS {
            let next = self.now() + MS;
            self.world.simulation().run_to(next);
            judge.judge_rest(&self.world, next)?;
        }
        judge.judge_gone(&self.world, self.now())
    }

    fn go(&mut self, program: &mut Program, again: bool) -> Result<(), Violation> {
        let begun = self.now();
        while program.hil.ended().is_none() && program.hil.step() < Step::Sync {
            self.cycle(program)?;
            self.limit(begun, START_NS)?;
        }
        if !again {
            self.enter(Phase::Enabling);
        }
        while program.hil.ended().is_none() && program.hil.step() != Step::Armed {
            self.cycle(program)?;
            self.limit(begun, START_NS)?;
            if program.judge.tripped_ns().is_some() {
                self.end(program)?;
                return self.needless(program);
            }
        }
        if !again {
            self.enter(Phase::Rest);
        }
        self.lasts(program, (super::rigs::REST * 1e9) as u64)?;
        if !again {
            self.enter(Phase::Moving);
        }
        self.lasts(program, MOVING_NS)?;
        if !again && program.judge.tripped_ns().is_none() {
            self.narrow(program)?;
            self.change(program);
            self.enter(Phase::Change);
        }
        self.lasts(program, CHANGE_NS)?;
        if program.hil.ended().is_none() && program.judge.tripped_ns().is_none() {
            self.needless(program)?;
            if !again {
                self.enter(Phase::Stopping);
            }
            program.operator.push(Command::Stop);
        } else {
            self.needless(program)?;
        }
        self.end(program)
    }

    fn limit(&self, since: u64, limit: u64) -> Result<(), Violation> {
        let long = self.now() - since > limit;
        if long { Err(self.broken(Broken::Endless, format!("{} ms", limit / MS))) } else { Ok(()) }
    }

    /// Continues for a time, unless a stop begins.
    fn lasts(&mut self, program: &mut Program, ns: u64) -> Result<(), Violation> {
        let until = self.now() + ns;
        while self.now() < until && program.hil.ended().is_none() && program.judge.tripped_ns().is_none() {
            self.cycle(program)?;
        }
        Ok(())
    }

    /// Continues to the end of a program that stops.
    fn end(&mut self, program: &mut Program) -> Result<(), Violation> {
        let begun = self.now();
        while program.hil.ended().is_none() {
            self.cycle(program)?;
            self.limit(begun, END_NS)?;
        }
        Ok(())
    }

    /// Checks that a stop has a reason: a fault, or a rig that requests too much.
    fn needless(&self, program: &Program) -> Result<(), Violation> {
        let made = &self.script.rig;
        let asks =
            made.swing > 1.0 || made.speed < 100.0 || made.travel > 0.0 || made.power > 0.0 || made.no_number > 0.0;
        let asks = asks || made.safe != 0.0 || made.far || self.script.only != Only::Any;
        let harmless = match self.script.faults[..] {
            [] => true,
            [fault] => harmless(&fault),
            _ => false,
        };
        match program.hil.ended() {
            _ if asks || !harmless => Ok(()),
            Some(End::Refused(why)) => Err(self.broken(Broken::Needless, why.clone())),
            _ => match program.hil.control().and_then(|control| control.supervisor().cause()) {
                Some(cause) => Err(self.broken(Broken::Needless, format!("{cause:?}"))),
                None => Ok(()),
            },
        }
    }

    /// Checks that limits wider than those in force are refused.
    fn narrow(&mut self, program: &mut Program) -> Result<(), Violation> {
        let Some(supervisor) = program.hil.supervisor_mut() else { return Ok(()) };
        let limits = supervisor.outputs()[0];
        if supervisor.narrow(0, 1.1 * limits.low, 1.1 * limits.high, limits.slew).is_ok() {
            return Err(self.broken(Broken::Widened, "limits were widened"));
        }
        Ok(())
    }

    /// Submits sets of parameters: several with two consistent values each, one with inconsistent values, and one that
    /// is too old.
    fn change(&mut self, program: &mut Program) {
        let Some(control) = program.hil.control() else { return };
        let slots = TWINS.map(|i| control.model().description().layout.params.slot(i));
        let set = |first: f64, second: f64| {
            let set = Set::new(&[(slots[0], first), (slots[1], second)]).expect("two values are a set");
            Command::Set(set)
        };
        let (torn, old) = (program.operator.say(set(70.0, 90.0)), Stamp::Wall(0));
        let old = program.operator.say_at(set(80.0, 81.0), old);
        program.said.extend([torn, old].into_iter().flatten().map(|ticket| (ticket, None)));
        for k in 1..=self.script.sets {
            let value = f64::from(k);
            // Without a free place a set is refused at once, with an error.
            if let Ok(ticket) = program.operator.say(set(value, value + 1.0)) {
                program.said.push((ticket, Some(value)));
            }
        }
        program.patience = program.said.len() as u32 + 3;
    }

    /// Begins a phase and plants its faults.
    fn enter(&mut self, phase: Phase) {
        let at = Phase::ALL.iter().position(|other| *other == phase).expect("all phases are listed");
        self.passed.phases[at] += 1;
        for fault in self.script.faults.iter().filter(|fault| fault.phase == phase) {
            self.plant(fault);
        }
    }

    fn plant(&mut self, fault: &Fault) {
        let from = self.now() + fault.after;
        let until = from.saturating_add(fault.lasts);
        match fault.what {
            What::Frame(bus, id, ill) => {
                let kind = match ill {
                    Ill::Refused => Planting::Full,
                    Ill::Lost => Planting::Drop,
                    Ill::Late(by) => Planting::Delay(by),
                    Ill::Doubled => Planting::Duplicate,
                    Ill::Swapped => Planting::Reorder,
                    Ill::Corrupted => Planting::Corrupt,
                    Ill::Stale => Planting::Stale,
                    Ill::Disturbed => Planting::Disturb,
                };
                let planted = Planted::new(kind).id(id).from(from).until(until);
                self.world.bus(bus).plant(super::space::sender(id), planted);
            }
            What::Node(node, effect) => {
                let lasts_ns = (fault.lasts != EVER).then_some(fault.lasts);
                self.world.bench().hook(Hook { node, effect, start: Start::At(from), lasts_ns });
            }
            What::Short(bus) => self.world.bus(bus).short(from, until),
            What::Unplugged(bus) => self.world.bus(bus).unplug(MASTER, from, until),
            What::Alone(bus) => self.world.bus(bus).unplug(BENCH, from, until),
            What::Babble(bus) => self.world.bus(bus).babble(BENCH, Frame::new(0x001, &[]), 0, from, until),
            What::Down(bus) => self.down.push((from, bus)),
            What::Foreign(bus, id) => self.foreign.push((from, bus, id)),
            What::Frozen(each) => self.frozen.push((from, from + fault.lasts.min(100 * MS), each)),
            What::Overrun(bus, percent) => {
                let planted = Planted::new(Planting::Overrun).chance(f64::from(percent) / 100.0);
                self.world.bus(bus).plant(MASTER, planted.from(from).until(until));
            }
            What::NoNumber(node, which) => {
                // 1/0 is infinite, and 0/0 is NaN.
                let effect = Effect::Value(1, 0, f64::from(which) / 0.0);
                let lasts_ns = (fault.lasts != EVER).then_some(fault.lasts);
                self.world.bench().hook(Hook { node, effect, start: Start::At(from), lasts_ns });
            }
        }
    }

    /// Applies the faults that the buses and drives do not apply themselves.
    fn disturb(&mut self) {
        let now = self.now();
        let due = |at: u64| at <= now;
        for (_, bus) in self.down.extract_if(.., |(at, _)| due(*at)) {
            self.world.bus(bus).take_down(MASTER);
        }
        for (_, bus, id) in self.foreign.extract_if(.., |(at, ..)| due(*at)) {
            let mut port = self.world.bus(bus).port("foreign");
            let data: &[u8] = match id {
                0x000 => &[1, 3],
                0x080 => &[],
                _ => &[0x06, 0, 0x40, 1, 0, 0, 0, 0],
            };
            // On a bus that is down nobody receives it either.
            let _ = port.send(Frame::new(id, data));
            self.others.push(port);
        }
        let frozen = self.frozen.iter().filter(|(from, until, _)| due(*from) && now < *until);
        if let Some(each) = frozen.map(|(.., each)| *each).max() {
            self.world.simulation().run_to(now + each);
        }
    }

    fn cycle(&mut self, program: &mut Program) -> Result<(), Violation> {
        self.disturb();
        if self.is_strange() && program.hil.step() <= Step::Identity {
            // A reset restores the drive's identity.
            imitate(self.world.bench().drive(0).unwrap().objects(), self.script.only);
        }
        self.traffic.borrow_mut().clear();
        let settled = program.hil.step() >= Step::Sync && program.hil.control().is_some();
        let asked = super::heap::asked();
        program.hil.cycle();
        let asked = super::heap::asked() - asked;
        // A simulated drive that boots allocates its dictionary anew.
        let mut bench = self.world.bench();
        let mut drives = (0..self.rig.nodes.len()).filter_map(|node| Some(bench.drive(node)?.node().state()));
        let boots = drives.any(|state| state == NmtState::BootUp);
        drop(bench);
        if settled && asked > 0 && program.hil.ended().is_none() && !boots {
            return Err(self.broken(Broken::Heap, format!("{asked} pieces while {}", program.hil.step())));
        }
        self.passed.cycles += 1;
        for (bus, witness) in self.witnesses.iter_mut().enumerate() {
            while let Some(received) = witness.receive() {
                if let Received::Frame(frame, stamp_ns) = received {
                    program.judge.heard(&self.rig, bus, &frame, stamp_ns);
                }
            }
        }
        program.judge.tick(&program.hil, &self.world, &self.rig, &self.traffic.borrow())?;
        self.judge_permission(program)?;
        self.note(program);
        self.judge_sets(program)?;
        self.replay(program)
    }

    /// Whether the first drive claims another identity.
    fn is_strange(&self) -> bool {
        match self.script.only {
            Only::Any | Only::Simulated => false,
            Only::OtherVendor | Only::OtherName => true,
            Only::OtherLater => self.second,
        }
    }

    /// Checks that no drive is enabled under options for simulated drives only, unless it has proved to be simulated.
    fn judge_permission(&self, program: &Program) -> Result<(), Violation> {
        let framed = self.script.rig.sort == super::rigs::Sort::FramesServo && self.script.only != Only::Any;
        if (framed || self.is_strange()) && program.hil.step() > Step::AwaitEnable && program.hil.step() < Step::Stopped
        {
            return Err(
                self.broken(Broken::Permission, format!("{} with a drive that is not ours", program.hil.step()))
            );
        }
        Ok(())
    }

    fn note(&mut self, program: &Program) {
        let mut mix = |word: u64| self.passed.hash = (self.passed.hash ^ word).wrapping_mul(0x0100_0000_01b3);
        let Some(control) = program.hil.control() else { return };
        control.supervisor().permitted().iter().for_each(|value| mix(value.to_bits()));
        let bench = self.world.bench();
        (0..self.rig.nodes.len()).for_each(|node| mix(bench.shaft(node).torque.to_bits()));
        self.passed.cause = self.passed.cause.or(control.supervisor().cause());
    }

    /// Checks that a set is accepted as a whole or refused, that it is answered in time, and that the last accepted one
    /// acts.
    fn judge_sets(&self, program: &mut Program) -> Result<(), Violation> {
        let stops = program.judge.tripped_ns().is_some() || program.hil.ended().is_some();
        let Some(control) = program.hil.control() else { return Ok(()) };
        let model = control.model();
        let [first, second] = TWINS.map(|i| model.get(model.description().layout.params.slot(i)));
        if second != first + 1.0 || program.checks.holds(model.block()).is_err() {
            return Err(
                self.broken(Broken::Set, format!("half a set, or one that breaks a condition: {first}, {second}"))
            );
        }
        program.patience = program.patience.saturating_sub(1);
        let mut waits = Vec::new();
        for (ticket, value) in std::mem::take(&mut program.said) {
            match (program.operator.answer(ticket), value) {
                (Some(Answer::Taken(_)), Some(value)) => program.twin = value,
                (Some(Answer::Taken(_)), None) => {
                    return Err(self.broken(Broken::Set, "a set was taken that is torn, or from long ago"));
                }
                (Some(Answer::Refused(why)), Some(_)) if !stops && why != Reason::Stopping => {
                    return Err(self.broken(Broken::Set, format!("a set that fits was refused: {why:?}")));
                }
                (Some(Answer::Refused(_)), _) => {}
                (None, _) if program.patience == 0 && !stops => {
                    return Err(self.broken(Broken::Set, "a set vanished: nobody answers"));
                }
                (None, value) => waits.push((ticket, value)),
            }
        }
        program.said = waits;
        if first != program.twin {
            return Err(self.broken(Broken::Set, format!("the set of {} was taken, and {first} acts", program.twin)));
        }
        Ok(())
    }

    /// Replays the log message of this cycle through a second instance of the same code.
    fn replay(&mut self, program: &mut Program) -> Result<(), Violation> {
        if program.hil.control().is_none() {
            return Ok(());
        }
        if program.replay.is_none() {
            let bounds = (0..self.rig.nodes.len()).map(|node| {
                let limits = program.hil.fieldbus().limits(node);
                Bounds { torque: limits.map(|limits| limits.torque), speed: limits.map(|limits| limits.speed) }
            });
            let bounds: Vec<Bounds> = bounds.collect();
            let options = options(self.script).control;
            let twin = Control::new(&self.rig, self.made.0.clone(), None, &bounds, options).unwrap();
            program.replay = Some(Replay::new(program.rig, twin));
        }
        let Some(replay) = &mut program.replay else { return Ok(()) };
        let mut words = std::mem::take(&mut self.words);
        words.clear();
        program.hil.last().write(&mut words);
        let message = Message { kind: trace::CYCLE, words };
        let found = replay.message(&message);
        self.words = message.words;
        found.map_err(|stopped| self.broken(Broken::Replay, format!("{stopped:?}")))
    }
}

/// One program on the buses.
struct Program<'a> {
    hil: Hil,
    operator: Operator,
    judge: Judge,
    rig: &'a Rig,
    replay: Option<Replay<'a>>,
    /// Conditions on the parameters.
    checks: live::Judge,
    /// Sets without an answer; the value of each set that must be accepted.
    said: Vec<(Ticket, Option<f64>)>,
    /// Cycles within which they must be answered.
    patience: u32,
    /// Value of the set that acts.
    twin: f64,
}

/// Whether a rig must tolerate a fault without a stop: one answer that is lost or doubled.
fn harmless(fault: &Fault) -> bool {
    let answer = |id: u32| (0x180..0x200).contains(&id) || (0x280..0x300).contains(&id);
    match fault.what {
        // A doubled frame delays the next ones: twice as long is tolerated.
        What::Frame(_, id, Ill::Doubled) => answer(id) && fault.lasts <= 2 * MS,
        What::Frame(_, id, Ill::Lost | Ill::Refused) => answer(id) && fault.lasts <= MS,
        _ => false,
    }
}
