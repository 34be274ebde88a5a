//! The state machine of CiA 402: the drive's side and the master's side.
//!
//! In: status words and control words. Out: states, transitions, and the one command that leads a step towards a goal.
//! Knows no object and no frame. Source: CiA 402-2, section 6.

use std::fmt;

/// Control words. The upper bits, which depend on the mode, are 0.
pub mod control {
    /// Leads to "ready to switch on".
    pub const SHUTDOWN: u16 = 0x06;
    /// Leads to "switched on".
    pub const SWITCH_ON: u16 = 0x07;
    /// Leads to "operation enabled".
    pub const ENABLE: u16 = 0x0F;
    /// Stops on the ramp of object 6085.
    pub const QUICK_STOP: u16 = 0x02;
    /// Disables the torque.
    pub const DISABLE_VOLTAGE: u16 = 0x00;
    /// Its rising edge resets a fault.
    pub const FAULT_RESET: u16 = 0x80;
}

/// Bits of the status word besides the state.
pub mod status {
    /// The voltage is on.
    pub const VOLTAGE: u16 = 1 << 4;
    /// A warning is present.
    pub const WARNING: u16 = 1 << 7;
    /// The control word is processed.
    pub const REMOTE: u16 = 1 << 9;
    /// Target reached.
    pub const TARGET: u16 = 1 << 10;
    /// An internal limit is active.
    pub const LIMIT: u16 = 1 << 11;
    /// In the cyclic synchronous modes: the drive follows the command.
    pub const FOLLOWS: u16 = 1 << 12;
}

/// State of a drive.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
#[allow(missing_docs)]
pub enum State {
    #[default]
    NotReady,
    SwitchOnDisabled,
    Ready,
    SwitchedOn,
    Enabled,
    QuickStop,
    FaultReaction,
    Fault,
}

impl State {
    /// The state in a status word; none if the bits match no state of the standard.
    pub fn of(status: u16) -> Option<State> {
        match (status & 0x6F, status & 0x4F) {
            (0x21, _) => Some(State::Ready),
            (0x23, _) => Some(State::SwitchedOn),
            (0x27, _) => Some(State::Enabled),
            (0x07, _) => Some(State::QuickStop),
            (_, 0x00) => Some(State::NotReady),
            (_, 0x40) => Some(State::SwitchOnDisabled),
            (_, 0x08) => Some(State::Fault),
            (_, 0x0F) => Some(State::FaultReaction),
            _ => None,
        }
    }

    /// The state's bits in the status word.
    pub fn bits(self) -> u16 {
        match self {
            State::NotReady => 0x00,
            State::SwitchOnDisabled => 0x40,
            State::Ready => 0x21,
            State::SwitchedOn => 0x23,
            State::Enabled => 0x27,
            State::QuickStop => 0x07,
            State::FaultReaction => 0x0F,
            State::Fault => 0x08,
        }
    }

    /// Whether the motor can have torque.
    pub fn powered(self) -> bool {
        matches!(self, State::Enabled | State::QuickStop | State::FaultReaction)
    }
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            State::NotReady => "not ready to switch on",
            State::SwitchOnDisabled => "switch on disabled",
            State::Ready => "ready to switch on",
            State::SwitchedOn => "switched on",
            State::Enabled => "operation enabled",
            State::QuickStop => "quick stop active",
            State::FaultReaction => "fault reaction active",
            State::Fault => "fault",
        })
    }
}

/// Target of a master for a drive.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum Goal {
    /// Without torque.
    #[default]
    Off,
    /// Following commands.
    Enabled,
    /// Stopped on its ramp.
    Stopped,
}

/// The control word that leads from a state one step towards the goal; `reset`: a fault may be reset now.
///
/// The word must be sent in each cycle until the state has changed. The rising edge of its bit resets a fault, so
/// `reset` must alternate.
pub fn towards(goal: Goal, state: State, reset: bool) -> u16 {
    match (goal, state) {
        (_, State::Fault) if reset => control::FAULT_RESET,
        (_, State::Fault | State::FaultReaction | State::NotReady) => control::DISABLE_VOLTAGE,
        (Goal::Enabled, State::SwitchOnDisabled) => control::SHUTDOWN,
        (Goal::Enabled, State::Ready) => control::SWITCH_ON,
        (Goal::Enabled, State::SwitchedOn | State::Enabled) => control::ENABLE,
        // A stopped drive must first lose its torque: it never continues by itself.
        (Goal::Enabled, State::QuickStop) => control::DISABLE_VOLTAGE,
        (Goal::Stopped, State::Enabled | State::QuickStop) => control::QUICK_STOP,
        (Goal::Stopped, State::SwitchOnDisabled | State::Ready | State::SwitchedOn) => control::DISABLE_VOLTAGE,
        (Goal::Off, _) => control::DISABLE_VOLTAGE,
    }
}

/// A command, as encoded by the lower bits of a control word.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum ControlCommand {
    Shutdown,
    SwitchOn,
    Enable,
    QuickStop,
    DisableVoltage,
}

impl ControlCommand {
    fn of(word: u16) -> ControlCommand {
        match word & 0x0F {
            word if word & 0x02 == 0 => ControlCommand::DisableVoltage,
            word if word & 0x04 == 0 => ControlCommand::QuickStop,
            word if word & 0x01 == 0 => ControlCommand::Shutdown,
            word if word & 0x08 == 0 => ControlCommand::SwitchOn,
            _ => ControlCommand::Enable,
        }
    }
}

/// Durations of a drive's transitions, ns.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Times {
    /// Power stage on: "ready" to "switched on".
    pub switch_on_ns: u64,
    /// Magnetisation and brake release: "switched on" to "operation enabled".
    pub enable_ns: u64,
    /// Brake engagement: out of "operation enabled" by command.
    pub disable_ns: u64,
    /// Self-test after power-on and after a fault reset.
    pub start_ns: u64,
}

/// The drive's side of the state machine.
#[derive(Clone, Debug)]
pub struct Machine {
    state: State,
    times: Times,
    /// A transition in progress: its target state and the time of its end.
    pending: Option<(State, u64)>,
    /// The last control word, for the detection of rising edges.
    word: u16,
    /// Object 605A: 1 to 3 lead to "switch on disabled", 5 to 8 stay in "quick stop active", 0 disables the torque.
    pub quick_stop_option: i16,
}

impl Machine {
    /// A machine that leaves "not ready" by itself after its self-test.
    pub fn new(times: Times, now_ns: u64) -> Machine {
        let pending = Some((State::SwitchOnDisabled, now_ns + times.start_ns));
        Machine { state: State::NotReady, times, pending, word: 0, quick_stop_option: 2 }
    }

    /// Its state.
    pub fn state(&self) -> State {
        self.state
    }

    /// Time of the next transition by itself.
    pub fn due_ns(&self) -> u64 {
        self.pending.map_or(u64::MAX, |(_, due)| due)
    }

    /// Completes transitions that are due; returns whether the state has changed.
    pub fn advance(&mut self, now_ns: u64) -> bool {
        match self.pending {
            Some((state, due)) if due <= now_ns => {
                (self.state, self.pending) = (state, None);
                true
            }
            _ => false,
        }
    }

    fn go(&mut self, state: State, after_ns: u64, now_ns: u64) {
        if after_ns == 0 {
            (self.state, self.pending) = (state, None);
        } else if self.pending.is_none_or(|(to, _)| to != state) {
            self.pending = Some((state, now_ns + after_ns));
        }
    }

    /// Processes a control word; returns whether it reset a fault. `cleared`: the cause of the fault has gone.
    pub fn command(&mut self, word: u16, cleared: bool, now_ns: u64) -> bool {
        let edge = word & !self.word & control::FAULT_RESET != 0;
        self.word = word;
        let times = self.times;
        match (self.state, ControlCommand::of(word)) {
            (State::Fault, _) => {
                if edge && cleared {
                    self.go(State::SwitchOnDisabled, times.start_ns, now_ns); // transition 15
                    return true;
                }
            }
            (State::NotReady | State::FaultReaction, _) => {}
            (State::SwitchOnDisabled, ControlCommand::Shutdown) => self.go(State::Ready, 0, now_ns), // 2
            (State::SwitchOnDisabled, _) => {}
            (State::Ready, ControlCommand::SwitchOn | ControlCommand::Enable) => {
                self.go(State::SwitchedOn, times.switch_on_ns, now_ns); // 3
            }
            (State::SwitchedOn, ControlCommand::Enable) => self.go(State::Enabled, times.enable_ns, now_ns), // 4
            (State::Enabled, ControlCommand::SwitchOn) => self.go(State::SwitchedOn, times.disable_ns, now_ns), // 5
            (State::SwitchedOn | State::Enabled, ControlCommand::Shutdown) => {
                let after = if self.state == State::Enabled { times.disable_ns } else { 0 };
                self.go(State::Ready, after, now_ns); // 6, 8
            }
            (State::Ready | State::SwitchedOn, ControlCommand::QuickStop | ControlCommand::DisableVoltage)
            | (State::Enabled | State::QuickStop, ControlCommand::DisableVoltage) => {
                self.go(State::SwitchOnDisabled, 0, now_ns); // 7, 9, 10, 12
            }
            (State::Enabled, ControlCommand::QuickStop) if self.quick_stop_option == 0 => {
                self.go(State::SwitchOnDisabled, 0, now_ns);
            }
            (State::Enabled, ControlCommand::QuickStop) => self.go(State::QuickStop, 0, now_ns), // 11
            (State::QuickStop, ControlCommand::Enable) if self.quick_stop_option >= 5 => {
                self.go(State::Enabled, 0, now_ns)
            } // 16
            // A command to stay, or one without meaning in this state, cancels a transition in progress.
            (State::Ready, ControlCommand::Shutdown)
            | (State::SwitchedOn, ControlCommand::SwitchOn)
            | (State::Enabled, ControlCommand::Enable) => self.pending = None,
            (State::QuickStop, _) => {}
        }
        false
    }

    /// Notes the end of the quick stop: options 1 to 3 then disable the torque.
    pub fn stopped(&mut self) {
        if self.state == State::QuickStop && self.quick_stop_option < 5 {
            (self.state, self.pending) = (State::SwitchOnDisabled, None); // 12
        }
    }

    /// Stops on the ramp, for example because of 6007 = 3.
    pub fn quick_stop(&mut self) {
        match self.state {
            State::Enabled => (self.state, self.pending) = (State::QuickStop, None),
            State::Ready | State::SwitchedOn => self.disable(),
            State::NotReady | State::SwitchOnDisabled | State::QuickStop | State::FaultReaction | State::Fault => {}
        }
    }

    /// Disables the torque, for example because of 6007 = 2.
    pub fn disable(&mut self) {
        match self.state {
            State::Ready | State::SwitchedOn | State::Enabled | State::QuickStop => {
                (self.state, self.pending) = (State::SwitchOnDisabled, None);
            }
            State::NotReady | State::SwitchOnDisabled | State::FaultReaction | State::Fault => {}
        }
    }

    /// Enters the fault state, through the fault reaction if the motor can have torque.
    pub fn fault(&mut self, reaction_ns: u64, now_ns: u64) {
        match self.state {
            State::Fault | State::FaultReaction => {}
            state if state.powered() && reaction_ns > 0 => {
                self.state = State::FaultReaction; // 13
                self.pending = Some((State::Fault, now_ns + reaction_ns)); // 14
            }
            _ => (self.state, self.pending) = (State::Fault, None),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const INSTANT: Times = Times { switch_on_ns: 0, enable_ns: 0, disable_ns: 0, start_ns: 0 };
    const STATES: [State; 8] = [
        State::NotReady,
        State::SwitchOnDisabled,
        State::Ready,
        State::SwitchedOn,
        State::Enabled,
        State::QuickStop,
        State::FaultReaction,
        State::Fault,
    ];

    fn at(state: State) -> Machine {
        Machine { state, times: INSTANT, pending: None, word: 0, quick_stop_option: 2 }
    }

    fn after(state: State, word: u16) -> State {
        let mut machine = at(state);
        machine.command(word, true, 0);
        machine.advance(0);
        machine.state()
    }

    #[test]
    fn every_transition_is_that_of_the_standard() {
        use State::*;
        use control::*;
        // Rows: states in the order of `STATES`; columns: commands.
        let commands = [SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP, DISABLE_VOLTAGE, FAULT_RESET];
        let table = [
            [NotReady, NotReady, NotReady, NotReady, NotReady, NotReady],
            [Ready, SwitchOnDisabled, SwitchOnDisabled, SwitchOnDisabled, SwitchOnDisabled, SwitchOnDisabled],
            [Ready, SwitchedOn, SwitchedOn, SwitchOnDisabled, SwitchOnDisabled, SwitchOnDisabled],
            [Ready, SwitchedOn, Enabled, SwitchOnDisabled, SwitchOnDisabled, SwitchOnDisabled],
            [Ready, SwitchedOn, Enabled, QuickStop, SwitchOnDisabled, SwitchOnDisabled],
            [QuickStop, QuickStop, QuickStop, QuickStop, SwitchOnDisabled, SwitchOnDisabled],
            [FaultReaction, FaultReaction, FaultReaction, FaultReaction, FaultReaction, FaultReaction],
            [Fault, Fault, Fault, Fault, Fault, SwitchOnDisabled],
        ];
        for (state, row) in STATES.into_iter().zip(table) {
            for (word, expected) in commands.into_iter().zip(row) {
                assert_eq!(after(state, word), expected, "{state}, control word {word:#04x}");
            }
        }
    }

    #[test]
    fn the_state_depends_only_on_its_bits_of_the_status_word() {
        for state in STATES {
            for other in 0..=u16::MAX {
                let status = state.bits() | other & !0x6F;
                assert_eq!(State::of(status), Some(state));
            }
        }
        // Bit 5 is ignored in the four states without it.
        assert_eq!(State::of(0x28), Some(State::Fault));
        assert_eq!(State::of(0x60), Some(State::SwitchOnDisabled));
        assert_eq!(State::of(0x01), None);
    }

    #[test]
    fn a_master_never_skips_a_state() {
        for goal in [Goal::Off, Goal::Enabled, Goal::Stopped] {
            for start in STATES {
                let mut machine = at(start);
                let mut path = vec![start];
                for cycle in 0..8 {
                    machine.command(towards(goal, machine.state(), cycle % 2 == 0), true, cycle);
                    machine.advance(cycle);
                    path.push(machine.state());
                }
                let end = *path.last().unwrap();
                match (goal, start) {
                    (_, State::NotReady | State::FaultReaction) => assert_eq!(end, start),
                    (Goal::Enabled, _) => {
                        assert_eq!(end, State::Enabled, "{path:?}");
                        let ready = path.iter().position(|state| *state == State::Ready);
                        let on = path.iter().position(|state| *state == State::SwitchedOn);
                        assert!(start == State::Enabled || on.is_some() && (ready < on || start == State::SwitchedOn));
                    }
                    (Goal::Stopped, State::Enabled | State::QuickStop) => assert_eq!(end, State::QuickStop),
                    (Goal::Off | Goal::Stopped, _) => assert_eq!(end, State::SwitchOnDisabled, "{path:?}"),
                }
            }
        }
    }

    #[test]
    fn a_fault_needs_a_rising_edge_and_its_cause_gone() {
        let mut machine = at(State::Fault);
        assert!(!machine.command(control::FAULT_RESET, false, 0), "the cause is still there");
        assert!(!machine.command(control::FAULT_RESET, true, 0), "no edge");
        machine.command(0, true, 0);
        assert!(machine.command(control::FAULT_RESET, true, 0));
        assert_eq!(machine.state(), State::SwitchOnDisabled);
    }

    #[test]
    fn transitions_take_time_and_can_be_cancelled() {
        let times = Times { switch_on_ns: 10, enable_ns: 20, disable_ns: 5, start_ns: 100 };
        let mut machine = Machine::new(times, 0);
        assert!(!machine.advance(99) && machine.advance(100));
        machine.command(control::SHUTDOWN, true, 100);
        machine.command(control::SWITCH_ON, true, 100);
        machine.command(control::SWITCH_ON, true, 105);
        assert_eq!((machine.state(), machine.due_ns()), (State::Ready, 110), "said twice, it takes no longer");
        assert!(machine.advance(110));
        machine.command(control::ENABLE, true, 110);
        machine.command(control::SWITCH_ON, true, 120);
        assert!(!machine.advance(1000) && machine.state() == State::SwitchedOn, "taken back");
        machine.command(control::ENABLE, true, 1000);
        assert!(machine.advance(1020) && machine.state() == State::Enabled);
        machine.fault(7, 1020);
        assert_eq!(machine.state(), State::FaultReaction);
        assert!(machine.advance(1027) && machine.state() == State::Fault);
    }

    #[test]
    fn a_quick_stop_ends_as_its_option_says() {
        for (option, end) in [(1, State::SwitchOnDisabled), (2, State::SwitchOnDisabled), (6, State::QuickStop)] {
            let mut machine = at(State::Enabled);
            machine.quick_stop_option = option;
            machine.command(control::QUICK_STOP, true, 0);
            assert_eq!(machine.state(), State::QuickStop);
            machine.stopped();
            assert_eq!(machine.state(), end);
            machine.command(control::ENABLE, true, 0);
            assert_eq!(machine.state() == State::Enabled, option >= 5, "only options 5 to 8 go on");
        }
        let mut machine = at(State::Enabled);
        machine.quick_stop_option = 0;
        machine.command(control::QUICK_STOP, true, 0);
        assert_eq!(machine.state(), State::SwitchOnDisabled);
    }
}
