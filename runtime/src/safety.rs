//! Safety supervisor: the last stage before the bus. It limits every output and decides how a rig stops.
//!
//! In: the model's requests, measured speeds and positions, faults reported by any other part. Out: the permitted
//! outputs, and a command to the drives (follow, quick stop, disable). Knows neither buses nor models.
//!
//! It decides in the same cycle in which the measurements arrive. A trip latches: no transition leaves it. Limits can
//! be narrowed while the rig runs, never widened. Nothing is allocated after [`Supervisor::new`], and the file contains
//! no unsafe code.
//!
//! Software is not the safety function of a machine: the emergency stop acts by wire on the safe torque off (STO) of
//! the drives. This supervisor is a layer before that.

#![forbid(unsafe_code)]

#[cfg(all(feature = "mutants", not(debug_assertions)))]
compile_error!("mutants switch protections off: they are for tests, never for an optimised build");

/// Limits of one output, in the output's own SI unit.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct OutputLimits {
    /// Lowest permitted value.
    pub low: f64,
    /// Highest permitted value.
    pub high: f64,
    /// Highest rate of change per second; infinite: no limit.
    pub slew: f64,
    /// Target value of every stop, between `low` and `high`.
    pub safe: f64,
    /// Index of the drive that this output commands, if any.
    pub drive: Option<usize>,
    /// Whether the output is a torque in N·m; then its power is torque times speed.
    pub torque: bool,
}

/// Limits of one drive; infinite where there is no limit.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct DriveLimits {
    /// Highest speed, rad/s.
    pub speed: f64,
    /// Permitted range of positions, rad.
    pub travel: (f64, f64),
    /// Highest power, W.
    pub power: f64,
}

/// Measured speed and position of one drive, where known; SI.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Measured {
    /// rad/s
    pub speed: Option<f64>,
    /// rad
    pub position: Option<f64>,
}

/// Time-outs, in cycles.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Timeouts {
    /// Ramp after arming, in which outputs rise from their safe values.
    pub ramp: u32,
    /// Longest unbroken time for which an output may be outside its limits before a controlled stop.
    pub clamped: u32,
    /// Longest time from a controlled stop to the quick stop, and from there to disabled, whatever is measured.
    pub standstill: u32,
}

/// Why a rig stops.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Cause {
    /// The operator or a signal of the operating system requested the stop.
    Asked,
    /// The model's request for this output is not finite.
    NotFinite(usize),
    /// The model left a declared range; the number of its guard, from 1.
    Guard(u64),
    /// This output was outside its limits for too long.
    Clamped(usize),
    /// A stop condition of the rig holds; its index.
    Condition(usize),
    /// This many ticks were missed.
    Overrun(u32),
    /// A drive is faster than permitted, rad/s.
    Speed(usize, f64),
    /// A drive is outside its travel, rad.
    Travel(usize, f64),
    /// The shaft accelerates against the applied torque (a sign is wrong); a drive whose speed rose too far.
    RunAway(usize),
    /// A signal was missing for too long; its index among the signals read.
    Lost(usize),
    /// A signal was implausible for too long.
    Implausible(usize),
    /// A drive reports another mode of operation than requested, or does not follow its commands.
    NotFollowing(usize),
    /// A drive is in fault, stopped by itself, stopped answering or restarted; see its status.
    Drive(usize),
    /// A bus does not work; see its event.
    Bus(usize),
    /// Set-points are at risk because this bus loses frames.
    Overload(usize),
    /// Another participant sends commands; bus and identifier of its frame.
    Foreign(usize, u32),
    /// A contact returned more energy than friction can store (passivity observer).
    Energy,
    /// The shaft deviates from its model, and the loop is stable only with the predictor.
    Unpredictable,
    /// The cycle did not end in time.
    Watchdog,
    /// Nobody watches the rig any more (dead man's switch).
    Unwatched,
}

/// How a rig stops.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub enum Reaction {
    /// Outputs move to their safe values at their slew rate, then as [`Reaction::Quick`].
    Controlled,
    /// Quick stop of all drives at once; disabled at standstill or after a time-out.
    Quick,
}

impl Cause {
    /// The reaction to this cause.
    pub fn reaction(self) -> Reaction {
        match self {
            Cause::Asked
            | Cause::NotFinite(_)
            | Cause::Guard(_)
            | Cause::Clamped(_)
            | Cause::Condition(_)
            | Cause::Overrun(_)
            | Cause::NotFollowing(_)
            | Cause::Overload(_)
            | Cause::Energy
            | Cause::Unpredictable
            | Cause::Unwatched => Reaction::Controlled,
            Cause::Speed(..)
            | Cause::Travel(..)
            | Cause::RunAway(_)
            | Cause::Lost(_)
            | Cause::Implausible(_)
            | Cause::Drive(_)
            | Cause::Bus(_)
            | Cause::Foreign(..)
            | Cause::Watchdog => Reaction::Quick,
        }
    }
}

impl Cause {
    /// Encodes the cause as two words, never both 0: kind and index, then a value.
    pub fn to_words(self) -> [u64; 2] {
        let (kind, index, value) = match self {
            Cause::Asked => (1, 0, 0),
            Cause::NotFinite(i) => (2, i, 0),
            Cause::Guard(status) => (3, 0, status),
            Cause::Clamped(i) => (4, i, 0),
            Cause::Condition(i) => (5, i, 0),
            Cause::Overrun(missed) => (6, 0, u64::from(missed)),
            Cause::Speed(i, speed) => (7, i, speed.to_bits()),
            Cause::Travel(i, position) => (8, i, position.to_bits()),
            Cause::RunAway(i) => (9, i, 0),
            Cause::Lost(i) => (10, i, 0),
            Cause::Implausible(i) => (11, i, 0),
            Cause::NotFollowing(i) => (12, i, 0),
            Cause::Drive(i) => (13, i, 0),
            Cause::Bus(i) => (14, i, 0),
            Cause::Overload(i) => (15, i, 0),
            Cause::Foreign(i, id) => (16, i, u64::from(id)),
            Cause::Energy => (17, 0, 0),
            Cause::Watchdog => (18, 0, 0),
            Cause::Unpredictable => (19, 0, 0),
            Cause::Unwatched => (20, 0, 0),
        };
        [kind << 32 | index as u64, value]
    }

    /// Decodes the words of [`Cause::to_words`]. None if they encode no cause.
    pub fn from_words([first, value]: [u64; 2]) -> Option<Cause> {
        let (i, small) = ((first & 0xffff_ffff) as usize, u32::try_from(value).ok());
        Some(match first >> 32 {
            1 => Cause::Asked,
            2 => Cause::NotFinite(i),
            3 => Cause::Guard(value),
            4 => Cause::Clamped(i),
            5 => Cause::Condition(i),
            6 => Cause::Overrun(small?),
            7 => Cause::Speed(i, f64::from_bits(value)),
            8 => Cause::Travel(i, f64::from_bits(value)),
            9 => Cause::RunAway(i),
            10 => Cause::Lost(i),
            11 => Cause::Implausible(i),
            12 => Cause::NotFollowing(i),
            13 => Cause::Drive(i),
            14 => Cause::Bus(i),
            15 => Cause::Overload(i),
            16 => Cause::Foreign(i, small?),
            17 => Cause::Energy,
            18 => Cause::Watchdog,
            19 => Cause::Unpredictable,
            20 => Cause::Unwatched,
            _ => return None,
        })
    }
}

/// Command of the safety stage to the state machines of the drives.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum DriveCommand {
    /// Not armed: enabled drives receive their safe values.
    Wait,
    /// Follow the permitted outputs.
    Follow,
    /// Quick stop.
    QuickStop,
    /// Disable the power stage.
    Disable,
}

/// Reasons why an output differs from its request, as bits; several may hold at once.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Clamps(pub u8);

impl Clamps {
    /// The request is outside `low .. high`.
    pub const RANGE: Clamps = Clamps(1);
    /// The request changes faster than the slew limit.
    pub const SLEW: Clamps = Clamps(2);
    /// The request exceeds the power limit.
    pub const POWER: Clamps = Clamps(4);

    /// Whether any of the reasons in `other` holds.
    pub fn has(self, other: Clamps) -> bool {
        self.0 & other.0 != 0
    }

    fn add(&mut self, other: Clamps) {
        self.0 |= other.0;
    }
}

/// Why a set of limits is refused.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Refused {
    /// Not `low <= safe <= high`, or one of them is NaN.
    Range(usize),
    /// The slew of an output is not above 0, so it could never be stopped.
    Slew(usize),
    /// Speed, travel or power of a drive is negative or NaN.
    Drive(usize),
    /// An output that commands a drive has no finite range.
    Unbounded(usize),
    /// An output names a drive that does not exist.
    NoDrive(usize),
    /// The limits are wider than those in force.
    Wider(usize),
}

/// State machine of the supervisor, from idle through armed to disabled.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Stage {
    Idle,
    /// Cycles since arming.
    Armed(u32),
    /// Cycles in this stage.
    Slewing(u32),
    /// Cycles in this stage.
    Quick(u32),
    Disabled,
}

/// A protection that mutation tests can switch off, to show that a test then fails.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[allow(missing_docs)]
pub enum Protection {
    Finite,
    Range,
    Slew,
    Power,
    Speed,
    Travel,
    RunAway,
    Clamped,
    Ramp,
    Latch,
    Narrow,
    Report,
    Kept,
    Followed,
    Silence,
    Behind,
    Rounding,
    Wrap,
    Table,
    OwnStack,
    Permission,
    Idle,
    Deadline,
    Judged,
    Old,
    Late,
    Patient,
    Recorded,
    Reused,
    Unhurried,
    Counted,
    Plain,
    Energy,
    Loop,
    Bites,
    Hushed,
    Life,
    Jump,
    Odd,
    Infinite,
    Agree,
    Foreign,
    Overload,
    Shown,
}

impl Protection {
    /// All protections, with their names in the environment variable `FRIC_MUTANT`.
    pub const ALL: [(&'static str, Protection); 44] = [
        ("finite", Protection::Finite),
        ("range", Protection::Range),
        ("slew", Protection::Slew),
        ("power", Protection::Power),
        ("speed", Protection::Speed),
        ("travel", Protection::Travel),
        ("run-away", Protection::RunAway),
        ("clamped", Protection::Clamped),
        ("ramp", Protection::Ramp),
        ("latch", Protection::Latch),
        ("narrow", Protection::Narrow),
        ("report", Protection::Report),
        ("kept", Protection::Kept),
        ("followed", Protection::Followed),
        ("silence", Protection::Silence),
        ("behind", Protection::Behind),
        ("rounding", Protection::Rounding),
        ("wrap", Protection::Wrap),
        ("table", Protection::Table),
        ("own-stack", Protection::OwnStack),
        ("permission", Protection::Permission),
        ("idle", Protection::Idle),
        ("deadline", Protection::Deadline),
        ("judged", Protection::Judged),
        ("old", Protection::Old),
        ("late", Protection::Late),
        ("patient", Protection::Patient),
        ("recorded", Protection::Recorded),
        ("reused", Protection::Reused),
        ("unhurried", Protection::Unhurried),
        ("counted", Protection::Counted),
        ("plain", Protection::Plain),
        ("energy", Protection::Energy),
        ("loop", Protection::Loop),
        ("bites", Protection::Bites),
        ("hushed", Protection::Hushed),
        ("life", Protection::Life),
        ("jump", Protection::Jump),
        ("odd", Protection::Odd),
        ("infinite", Protection::Infinite),
        ("agree", Protection::Agree),
        ("foreign", Protection::Foreign),
        ("overload", Protection::Overload),
        ("shown", Protection::Shown),
    ];
}

/// Share of the speed limit by which a shaft may accelerate against its torque before it counts as a run-away.
const RUN_AWAY: f64 = 0.1;
/// Share of the speed limit below which a drive counts as being at standstill.
const STANDSTILL: f64 = 0.01;

/// Supervises the outputs of one rig.
pub struct Supervisor {
    outputs: Vec<OutputLimits>,
    drives: Vec<DriveLimits>,
    patience: Timeouts,
    /// Period of a cycle, s.
    period: f64,
    stage: Stage,
    cause: Option<Cause>,
    permitted: Vec<f64>,
    clamps: Vec<Clamps>,
    /// Unbroken number of cycles for which each output has been outside its range or power limit.
    clamped: Vec<u32>,
    /// Lowest speed of each drive since the torque began to brake the shaft, as a share of its limit.
    least: Vec<f64>,
    #[cfg(feature = "mutants")]
    missing: Option<Protection>,
}

impl Supervisor {
    /// A supervisor of these outputs and drives; `period_ns`: period of a cycle.
    ///
    /// # Errors
    /// Limits that contradict each other or cannot be enforced.
    pub fn new(
        outputs: &[OutputLimits],
        drives: &[DriveLimits],
        patience: Timeouts,
        period_ns: u64,
    ) -> Result<Supervisor, Refused> {
        for (i, drive) in drives.iter().enumerate() {
            let (low, high) = drive.travel;
            if !(drive.speed >= 0.0 && drive.power >= 0.0 && low <= high) {
                return Err(Refused::Drive(i));
            }
        }
        for (i, output) in outputs.iter().enumerate() {
            let OutputLimits { low, high, slew, safe, drive, .. } = *output;
            if !(low <= safe && safe <= high && safe.is_finite()) {
                return Err(Refused::Range(i));
            }
            if slew.is_nan() || slew <= 0.0 {
                return Err(Refused::Slew(i));
            }
            if drive.is_some() && !(low.is_finite() && high.is_finite()) {
                return Err(Refused::Unbounded(i));
            }
            if drive.is_some_and(|drive| drive >= drives.len()) {
                return Err(Refused::NoDrive(i));
            }
        }
        Ok(Supervisor {
            permitted: outputs.iter().map(|output| output.safe).collect(),
            clamps: vec![Clamps::default(); outputs.len()],
            clamped: vec![0; outputs.len()],
            least: vec![f64::INFINITY; drives.len()],
            outputs: outputs.to_vec(),
            drives: drives.to_vec(),
            patience,
            period: period_ns as f64 * 1e-9,
            stage: Stage::Idle,
            cause: None,
            #[cfg(feature = "mutants")]
            missing: missing(),
        })
    }

    /// The permitted outputs, one value per output.
    pub fn permitted(&self) -> &[f64] {
        &self.permitted
    }

    /// Reasons why outputs differ from their requests, one entry per output.
    pub fn clamps(&self) -> &[Clamps] {
        &self.clamps
    }

    /// The limits in force.
    pub fn outputs(&self) -> &[OutputLimits] {
        &self.outputs
    }

    /// The first cause of the stop, if the rig stops or has stopped.
    pub fn cause(&self) -> Option<Cause> {
        self.cause
    }

    /// Whether the outputs follow the requests.
    pub fn is_armed(&self) -> bool {
        matches!(self.stage, Stage::Armed(_))
    }

    /// Whether the stop is complete.
    pub fn is_disabled(&self) -> bool {
        self.stage == Stage::Disabled
    }

    /// Arms the rig: outputs follow the requests from now on and ramp up from their safe values. Returns false, and
    /// changes nothing, while a trip is latched.
    pub fn arm(&mut self) -> bool {
        let free = matches!(self.stage, Stage::Idle | Stage::Armed(_)) && self.cause.is_none();
        if free {
            self.stage = Stage::Armed(0);
        }
        free
    }

    /// Narrows the limits of an output.
    ///
    /// # Errors
    /// Limits that are wider than those in force, or that exclude the safe value.
    pub fn narrow(&mut self, i: usize, low: f64, high: f64, slew: f64) -> Result<(), Refused> {
        let now = self.outputs[i];
        if !(low <= now.safe && now.safe <= high) {
            return Err(Refused::Range(i));
        }
        if slew.is_nan() || slew <= 0.0 {
            return Err(Refused::Slew(i));
        }
        if (low < now.low || high > now.high || slew > now.slew) && self.on(Protection::Narrow) {
            return Err(Refused::Wider(i));
        }
        self.outputs[i] = OutputLimits { low, high, slew, ..now };
        Ok(())
    }

    /// Stops the rig in this cycle. The first cause is kept; a more severe reaction replaces the current one.
    pub fn trip(&mut self, cause: Cause) {
        if !self.on(Protection::Report) {
            return;
        }
        let stage = match (self.stage, cause.reaction()) {
            (Stage::Idle, _) => Stage::Quick(0),
            (Stage::Armed(_), Reaction::Controlled) => Stage::Slewing(0),
            (Stage::Armed(_) | Stage::Slewing(_), Reaction::Quick) => Stage::Quick(0),
            (Stage::Slewing(_) | Stage::Quick(_) | Stage::Disabled, _) => self.stage,
        };
        self.stage = stage;
        self.cause = self.cause.or(Some(cause));
    }

    /// One cycle: checks measurements and requests, updates [`Supervisor::permitted`], and returns the command to the
    /// drives.
    ///
    /// `requests`: one value per output. `seen`: measurements, one entry per drive.
    pub fn judge(&mut self, requests: &[f64], seen: &[Measured]) -> DriveCommand {
        assert_eq!((requests.len(), seen.len()), (self.outputs.len(), self.drives.len()), "outputs and drives");
        if !self.on(Protection::Latch) && matches!(self.stage, Stage::Slewing(_) | Stage::Quick(_)) {
            self.stage = Stage::Armed(self.patience.ramp);
        }
        self.watch(seen);
        if let Stage::Armed(for_cycles) = self.stage {
            if self.on(Protection::Finite)
                && let Some(i) = requests.iter().position(|request| !request.is_finite())
            {
                self.trip(Cause::NotFinite(i));
            } else {
                self.stage = Stage::Armed(for_cycles.saturating_add(1));
                self.follow(requests, seen, for_cycles);
            }
        }
        match self.stage {
            Stage::Idle => {
                self.rest();
                DriveCommand::Wait
            }
            Stage::Armed(_) => DriveCommand::Follow,
            Stage::Slewing(for_cycles) => {
                let over = self.slew_to_safe() || for_cycles >= self.patience.standstill;
                self.stage = if over { Stage::Quick(0) } else { Stage::Slewing(for_cycles + 1) };
                DriveCommand::Follow
            }
            Stage::Quick(for_cycles) => {
                self.rest();
                let still = self.drives.iter().zip(seen).all(|(limits, seen)| {
                    seen.speed.is_some_and(|speed| limits.speed.is_finite() && speed.abs() <= STANDSTILL * limits.speed)
                });
                let over = for_cycles > 0 && still || for_cycles >= self.patience.standstill;
                self.stage = if over { Stage::Disabled } else { Stage::Quick(for_cycles + 1) };
                DriveCommand::QuickStop
            }
            Stage::Disabled => {
                self.rest();
                DriveCommand::Disable
            }
        }
    }

    /// Trips on measurements that are outside the limits of a drive.
    fn watch(&mut self, seen: &[Measured]) {
        for (i, seen) in seen.iter().enumerate() {
            // Written so that NaN counts as outside.
            let DriveLimits { speed: most, travel: (low, high), .. } = self.drives[i];
            let slow = seen.speed.is_none_or(|speed| speed.abs() <= most);
            if !slow && self.on(Protection::Speed) {
                self.trip(Cause::Speed(i, seen.speed.unwrap_or_default()));
            }
            let inside = seen.position.is_none_or(|position| low <= position && position <= high);
            if !inside && self.on(Protection::Travel) {
                self.trip(Cause::Travel(i, seen.position.unwrap_or_default()));
            }
        }
        if self.is_armed() && self.on(Protection::RunAway) {
            self.watch_run_away(seen);
        }
    }

    /// Trips on a run-away: torque that takes power out of the shaft cannot accelerate it, unless a sign is wrong.
    ///
    /// The sum of torque times speed over all drives of the shaft does not depend on the sign convention of each drive.
    fn watch_run_away(&mut self, seen: &[Measured]) {
        let power: f64 = (self.outputs.iter().zip(&self.permitted))
            .filter(|(output, _)| output.torque)
            .filter_map(|(output, torque)| Some(torque * seen[output.drive?].speed?))
            .sum();
        for (i, seen) in seen.iter().enumerate() {
            let limit = self.drives[i].speed;
            let Some(speed) = seen.speed.filter(|_| limit.is_finite()) else { continue };
            let part = speed.abs() / limit;
            self.least[i] = if power < 0.0 { part.min(self.least[i]) } else { part };
            if part > self.least[i] + RUN_AWAY {
                self.trip(Cause::RunAway(i));
            }
        }
    }

    /// Limits the requests to range, ramp, slew and power.
    fn follow(&mut self, requests: &[f64], seen: &[Measured], for_cycles: u32) {
        if let Some(i) = self.clamped.iter().position(|cycles| *cycles > self.patience.clamped)
            && self.on(Protection::Clamped)
        {
            return self.trip(Cause::Clamped(i));
        }
        for (i, request) in requests.iter().enumerate() {
            let (limits, last) = (self.outputs[i], self.permitted[i]);
            let mut clamps = Clamps::default();
            let mut value = *request;
            if self.on(Protection::Range) && !(limits.low <= value && value <= limits.high) {
                clamps.add(Clamps::RANGE);
                value = value.clamp(limits.low, limits.high);
            }
            if for_cycles < self.patience.ramp && self.on(Protection::Ramp) {
                // The ramp scales the clamped value, not the request: a request beyond its range would rise sooner.
                value = limits.safe + (value - limits.safe) * f64::from(for_cycles) / f64::from(self.patience.ramp);
            }
            let most = limits.slew * self.period;
            if self.on(Protection::Slew) && (value - last).abs() > most {
                clamps.add(Clamps::SLEW);
                value = if value > last { last + most } else { last - most };
            }
            if let Some(most) = self.power_limit(limits, seen)
                && value.abs() > most
                && self.on(Protection::Power)
            {
                clamps.add(Clamps::POWER);
                value = most.copysign(value);
            }
            if self.on(Protection::Range) {
                // Limits may have been narrowed around the last value: the range takes precedence over the slew.
                value = value.clamp(limits.low, limits.high);
            }
            self.permitted[i] = value;
            self.clamps[i] = clamps;
            let beyond = clamps.has(Clamps::RANGE) || clamps.has(Clamps::POWER);
            self.clamped[i] = if beyond { self.clamped[i].saturating_add(1) } else { 0 };
        }
    }

    /// Highest torque at the measured speed of the drive of this output, N·m; none where there is no such limit.
    fn power_limit(&self, limits: OutputLimits, seen: &[Measured]) -> Option<f64> {
        let drive = limits.drive.filter(|_| limits.torque)?;
        Some(self.drives[drive].power / seen[drive].speed?.abs())
    }

    /// Moves outputs towards their safe values at their slew rate; returns whether all have arrived.
    fn slew_to_safe(&mut self) -> bool {
        let mut there = true;
        for (i, limits) in self.outputs.iter().enumerate() {
            let most = limits.slew * self.period;
            let way = limits.safe - self.permitted[i];
            let step = if way.abs() > most { most.copysign(way) } else { way };
            self.permitted[i] = if step == way { limits.safe } else { self.permitted[i] + step };
            self.clamps[i] = Clamps::default();
            there &= self.permitted[i] == limits.safe;
        }
        there
    }

    /// Sets all outputs to their safe values.
    fn rest(&mut self) {
        for (i, limits) in self.outputs.iter().enumerate() {
            self.permitted[i] = limits.safe;
            self.clamps[i] = Clamps::default();
            self.clamped[i] = 0;
        }
    }

    /// Appends the complete state as words, from which [`Supervisor::restore`] continues.
    pub fn save(&self, words: &mut Vec<u64>) {
        let (stage, cycles) = match self.stage {
            Stage::Idle => (0, 0),
            Stage::Armed(cycles) => (1, cycles),
            Stage::Slewing(cycles) => (2, cycles),
            Stage::Quick(cycles) => (3, cycles),
            Stage::Disabled => (4, 0),
        };
        words.extend([stage, u64::from(cycles)]);
        words.extend(self.cause.map_or([0, 0], Cause::to_words));
        words.extend(self.permitted.iter().chain(&self.least).map(|x| x.to_bits()));
        words.extend(self.clamped.iter().map(|cycles| u64::from(*cycles)));
    }

    /// Restores the state that [`Supervisor::save`] wrote; limits are not part of it. Returns None, and changes
    /// nothing, if the words do not fit.
    pub fn restore(&mut self, words: &mut dyn Iterator<Item = u64>) -> Option<()> {
        let (stage, cycles) = (words.next()?, u32::try_from(words.next()?).ok()?);
        let stage = match stage {
            0 => Stage::Idle,
            1 => Stage::Armed(cycles),
            2 => Stage::Slewing(cycles),
            3 => Stage::Quick(cycles),
            4 => Stage::Disabled,
            _ => return None,
        };
        let cause = match [words.next()?, words.next()?] {
            [0, 0] => None,
            words => Some(Cause::from_words(words)?),
        };
        let numbers = self.permitted.len() + self.least.len();
        let numbers: Option<Vec<f64>> = (0..numbers).map(|_| words.next().map(f64::from_bits)).collect();
        let clamped = (0..self.clamped.len()).map(|_| u32::try_from(words.next()?).ok());
        let (numbers, clamped) = (numbers?, clamped.collect::<Option<Vec<u32>>>()?);
        let (permitted, least) = numbers.split_at(self.permitted.len());
        (self.stage, self.cause) = (stage, cause);
        self.permitted.copy_from_slice(permitted);
        self.least.copy_from_slice(least);
        self.clamped.copy_from_slice(&clamped);
        Some(())
    }

    /// Whether a protection is active: always, except in mutation tests.
    #[cfg(not(feature = "mutants"))]
    #[allow(clippy::unused_self)]
    fn on(&self, _: Protection) -> bool {
        true
    }

    #[cfg(feature = "mutants")]
    fn on(&self, protection: Protection) -> bool {
        self.missing != Some(protection)
    }
}

/// Whether a protection outside of the supervisor is active: always, except in mutation tests.
#[cfg(not(feature = "mutants"))]
#[inline(always)]
pub fn is_present(_: Protection) -> bool {
    true
}

/// Whether a protection outside of the supervisor is active: all except the one that `FRIC_MUTANT` names.
#[cfg(feature = "mutants")]
pub fn is_present(protection: Protection) -> bool {
    static MISSING: std::sync::OnceLock<Option<Protection>> = std::sync::OnceLock::new();
    *MISSING.get_or_init(missing) != Some(protection)
}

/// The protection that `FRIC_MUTANT` switches off.
///
/// # Panics
/// If it names no protection: a test that switches nothing off would prove nothing.
#[cfg(feature = "mutants")]
fn missing() -> Option<Protection> {
    let name = std::env::var("FRIC_MUTANT").ok()?;
    let found = Protection::ALL.iter().find(|(known, _)| *known == name);
    Some(found.unwrap_or_else(|| panic!("FRIC_MUTANT={name} names no protection")).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: OutputLimits =
        OutputLimits { low: -1.0, high: 2.0, slew: 100.0, safe: 0.0, drive: Some(0), torque: true };
    const FREE: OutputLimits = OutputLimits { slew: f64::INFINITY, ..LIMITS };
    const DRIVE: DriveLimits = DriveLimits { speed: 100.0, travel: (-10.0, 10.0), power: 50.0 };
    const PATIENCE: Timeouts = Timeouts { ramp: 0, clamped: 3, standstill: 5 };

    /// An armed supervisor of one output and one drive, period 1 ms.
    fn armed(output: OutputLimits, patience: Timeouts) -> Supervisor {
        let mut supervisor = Supervisor::new(&[output], &[DRIVE], patience, 1_000_000).unwrap();
        assert!(supervisor.arm());
        supervisor
    }

    fn at(speed: f64) -> [Measured; 1] {
        [Measured { speed: Some(speed), position: Some(0.0) }]
    }

    /// Passes one request at a speed; returns the permitted value.
    fn sent(supervisor: &mut Supervisor, request: f64, speed: f64) -> f64 {
        supervisor.judge(&[request], &at(speed));
        supervisor.permitted()[0]
    }

    #[test]
    fn outputs_stay_at_safe_values_before_arming() {
        let mut supervisor = Supervisor::new(&[LIMITS], &[DRIVE], PATIENCE, 1_000_000).unwrap();
        assert_eq!(supervisor.judge(&[1.5], &at(0.0)), DriveCommand::Wait);
        assert_eq!(supervisor.permitted(), [0.0]);
        assert!(!supervisor.is_armed());
    }

    #[test]
    fn a_request_within_its_limits_is_permitted_unchanged() {
        let odd = OutputLimits { safe: 0.1, ..FREE };
        let mut supervisor = armed(odd, PATIENCE);
        for request in [0.3, -0.999, 1.0 / 3.0, 2.0, -1.0, f64::MIN_POSITIVE] {
            assert_eq!(sent(&mut supervisor, request, 1.0).to_bits(), request.to_bits());
            assert_eq!(supervisor.clamps(), [Clamps::default()]);
        }
    }

    #[test]
    fn range_slew_and_power_limit_the_output() {
        let mut free = armed(FREE, PATIENCE);
        assert_eq!(sent(&mut free, 5.0, 0.0), 2.0);
        assert!(free.clamps()[0].has(Clamps::RANGE));
        assert_eq!(sent(&mut free, -5.0, 0.0), -1.0);
        assert_eq!(sent(&mut free, 2.0, -50.0), 1.0);
        assert_eq!(free.clamps()[0], Clamps::POWER);
        assert_eq!(sent(&mut free, -1.0, 100.0), -0.5);
        let mut slow = armed(LIMITS, PATIENCE);
        assert_eq!(sent(&mut slow, 1.0, 0.0), 0.1);
        assert_eq!(slow.clamps()[0], Clamps::SLEW);
        assert_eq!(sent(&mut slow, 0.15, 0.0), 0.15);
        assert_eq!(sent(&mut slow, -1.0, 0.0), 0.15 - 0.1);
        let mut unmeasured = armed(FREE, PATIENCE);
        unmeasured.judge(&[2.0], &[Measured::default()]);
        assert_eq!(unmeasured.permitted(), [2.0], "no speed, no power");
    }

    #[test]
    fn outputs_ramp_up_from_safe_values() {
        let patience = Timeouts { ramp: 4, ..PATIENCE };
        let mut supervisor = armed(FREE, patience);
        let seen: Vec<f64> = (0..6).map(|_| sent(&mut supervisor, 1.0, 0.0)).collect();
        assert_eq!(seen, [0.0, 0.25, 0.5, 0.75, 1.0, 1.0]);
    }

    #[test]
    fn a_request_that_is_not_finite_trips_in_the_same_cycle() {
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            let mut supervisor = armed(LIMITS, PATIENCE);
            sent(&mut supervisor, 0.1, 0.0);
            sent(&mut supervisor, 0.15, 0.0);
            assert_eq!(supervisor.judge(&[bad], &at(0.0)), DriveCommand::Follow);
            assert_eq!(supervisor.permitted(), [0.15 - 0.1], "on its way to safe within its slew");
            assert_eq!(supervisor.cause(), Some(Cause::NotFinite(0)));
            assert_eq!(supervisor.judge(&[0.5], &at(0.0)), DriveCommand::Follow);
            assert_eq!(supervisor.permitted(), [0.0]);
            assert_eq!(supervisor.judge(&[0.5], &at(0.0)), DriveCommand::QuickStop);
        }
    }

    #[test]
    fn excess_speed_or_travel_or_nan_causes_a_quick_stop() {
        let mut fast = armed(FREE, PATIENCE);
        assert_eq!(fast.judge(&[1.0], &at(-100.1)), DriveCommand::QuickStop);
        assert_eq!((fast.permitted(), fast.cause()), (&[0.0][..], Some(Cause::Speed(0, -100.1))));
        let mut far = armed(FREE, PATIENCE);
        assert_eq!(far.judge(&[1.0], &[Measured { position: Some(10.1), speed: None }]), DriveCommand::QuickStop);
        assert_eq!(far.cause(), Some(Cause::Travel(0, 10.1)));
        let mut odd = armed(FREE, PATIENCE);
        assert_eq!(odd.judge(&[1.0], &at(f64::NAN)), DriveCommand::QuickStop);
    }

    #[test]
    fn acceleration_against_the_torque_is_a_run_away() {
        let mut supervisor = armed(FREE, PATIENCE);
        let mut last = DriveCommand::Follow;
        let mut speed = 1.0;
        while last == DriveCommand::Follow {
            last = supervisor.judge(&[-0.5], &at(speed));
            speed += 1.0;
            assert!(speed < 100.0, "never noticed");
        }
        assert_eq!(supervisor.cause(), Some(Cause::RunAway(0)));
        // Torque acts from the first cycle and counts from the second: 2 → 12 rad/s is a tenth of the limit.
        assert!(speed < 15.0, "noticed at {speed}");
        let mut pushed = armed(FREE, PATIENCE);
        for speed in 0..99 {
            assert_eq!(
                pushed.judge(&[0.5], &at(f64::from(speed))),
                DriveCommand::Follow,
                "with the torque is no run-away"
            );
        }
        for speed in (1..99).rev() {
            assert_eq!(pushed.judge(&[-0.5], &at(f64::from(speed))), DriveCommand::Follow, "braking is no run-away");
        }
    }

    #[test]
    fn a_load_that_brakes_a_servo_is_no_run_away() {
        let outputs = [FREE, OutputLimits { drive: Some(1), ..FREE }];
        let mut supervisor = Supervisor::new(&outputs, &[DRIVE, DRIVE], PATIENCE, 1_000_000).unwrap();
        supervisor.arm();
        for speed in 0..50 {
            // The second drive has the opposite sign convention.
            let seen = [at(f64::from(speed))[0], at(-f64::from(speed))[0]];
            assert_eq!(supervisor.judge(&[0.6, 0.4], &seen), DriveCommand::Follow);
        }
    }

    #[test]
    fn an_output_clamped_for_too_long_causes_a_stop() {
        let mut supervisor = armed(LIMITS, PATIENCE);
        for _ in 0..4 {
            assert_eq!(supervisor.judge(&[9.0], &at(0.0)), DriveCommand::Follow);
        }
        assert_eq!(supervisor.permitted(), [0.4]);
        supervisor.judge(&[9.0], &at(0.0));
        assert_eq!(supervisor.cause(), Some(Cause::Clamped(0)));
        assert!((supervisor.permitted()[0] - 0.3).abs() < 1e-15, "{:?}", supervisor.permitted());
        let mut now_and_then = armed(FREE, PATIENCE);
        for k in 0..40 {
            let request = if k % 3 == 0 { 1.0 } else { 9.0 };
            assert_eq!(now_and_then.judge(&[request], &at(0.0)), DriveCommand::Follow);
        }
    }

    #[test]
    fn a_trip_latches() {
        let mut supervisor = armed(FREE, PATIENCE);
        supervisor.trip(Cause::Lost(3));
        for cycle in 0..6 {
            assert!(!supervisor.arm());
            assert_eq!(supervisor.judge(&[1.0], &at(50.0)), DriveCommand::QuickStop, "cycle {cycle}");
            assert_eq!(supervisor.permitted(), [0.0]);
        }
        assert_eq!(supervisor.judge(&[1.0], &at(50.0)), DriveCommand::Disable, "after its time, still turning");
        assert!(!supervisor.arm(), "latched");
        supervisor.trip(Cause::Bus(0));
        assert_eq!(supervisor.cause(), Some(Cause::Lost(3)), "the first cause is kept");
        assert!(supervisor.is_disabled() && !supervisor.arm());
        assert_eq!(supervisor.judge(&[1.0], &at(0.0)), DriveCommand::Disable, "at rest, and for good");
    }

    #[test]
    fn drives_at_standstill_are_disabled_at_once() {
        let mut supervisor = armed(FREE, PATIENCE);
        supervisor.trip(Cause::Drive(0));
        assert_eq!(supervisor.judge(&[1.0], &at(0.5)), DriveCommand::QuickStop);
        assert_eq!(supervisor.judge(&[1.0], &at(0.5)), DriveCommand::QuickStop, "two stop frames at least");
        assert_eq!(supervisor.judge(&[1.0], &at(0.5)), DriveCommand::Disable);
    }

    #[test]
    fn a_more_severe_cause_replaces_a_controlled_stop() {
        let mut supervisor = armed(LIMITS, PATIENCE);
        for _ in 0..10 {
            sent(&mut supervisor, 1.0, 0.0);
        }
        supervisor.trip(Cause::Asked);
        assert_eq!(supervisor.judge(&[1.0], &at(0.0)), DriveCommand::Follow);
        assert!(supervisor.permitted()[0] > 0.8);
        supervisor.trip(Cause::Energy);
        assert_eq!(supervisor.judge(&[1.0], &at(0.0)), DriveCommand::Follow);
        supervisor.trip(Cause::Foreign(0, 0x80));
        assert_eq!(supervisor.judge(&[1.0], &at(0.0)), DriveCommand::QuickStop);
        assert_eq!(supervisor.cause(), Some(Cause::Asked));
    }

    #[test]
    fn a_very_slow_slew_ends_at_the_time_out() {
        let mut supervisor = armed(OutputLimits { slew: 1e-3, ..LIMITS }, PATIENCE);
        supervisor.outputs[0].slew = f64::INFINITY;
        sent(&mut supervisor, 1.0, 0.0);
        supervisor.outputs[0].slew = 1e-3;
        supervisor.trip(Cause::Asked);
        let orders: Vec<DriveCommand> = (0..8).map(|_| supervisor.judge(&[1.0], &at(0.0))).collect();
        assert_eq!(orders[..6], [DriveCommand::Follow; 6]);
        assert_eq!(orders[6..], [DriveCommand::QuickStop; 2]);
    }

    #[test]
    fn a_trip_before_arming_stops_too() {
        let mut supervisor = Supervisor::new(&[LIMITS], &[DRIVE], PATIENCE, 1_000_000).unwrap();
        supervisor.trip(Cause::Watchdog);
        assert!(!supervisor.arm());
        assert_eq!(supervisor.judge(&[0.0], &at(0.0)), DriveCommand::QuickStop);
    }

    #[test]
    fn limits_can_be_narrowed_but_not_widened() {
        let mut supervisor = armed(FREE, PATIENCE);
        assert_eq!(sent(&mut supervisor, 1.9, 0.0), 1.9);
        assert_eq!(supervisor.narrow(0, -0.5, 0.5, 10.0), Ok(()));
        assert_eq!(sent(&mut supervisor, 1.9, 0.0), 0.5, "the new range wins over the new slew");
        for (low, high, slew) in [(-0.6, 0.5, 10.0), (-0.5, 0.6, 10.0), (-0.5, 0.5, 11.0)] {
            assert_eq!(supervisor.narrow(0, low, high, slew), Err(Refused::Wider(0)));
        }
        for (low, high) in [(0.1, 0.5), (-0.5, -0.1), (f64::NAN, 0.5), (-0.5, f64::NAN)] {
            assert_eq!(supervisor.narrow(0, low, high, 10.0), Err(Refused::Range(0)));
        }
        for slew in [0.0, -1.0, f64::NAN] {
            assert_eq!(supervisor.narrow(0, -0.5, 0.5, slew), Err(Refused::Slew(0)));
        }
        assert_eq!(supervisor.outputs()[0], OutputLimits { low: -0.5, high: 0.5, slew: 10.0, ..FREE });
    }

    #[test]
    fn contradictory_limits_are_refused() {
        let refused = |output, drive| Supervisor::new(&[output], &[drive], PATIENCE, 1_000_000).err();
        let range = |low, high, safe| refused(OutputLimits { low, high, safe, ..LIMITS }, DRIVE);
        assert_eq!(range(1.0, -1.0, 0.0), Some(Refused::Range(0)));
        assert_eq!(range(-1.0, 1.0, 2.0), Some(Refused::Range(0)));
        assert_eq!(range(f64::NAN, 1.0, 0.0), Some(Refused::Range(0)));
        assert_eq!(range(-1.0, f64::INFINITY, 0.0), Some(Refused::Unbounded(0)));
        assert_eq!(refused(OutputLimits { slew: 0.0, ..LIMITS }, DRIVE), Some(Refused::Slew(0)));
        assert_eq!(refused(OutputLimits { slew: f64::NAN, ..LIMITS }, DRIVE), Some(Refused::Slew(0)));
        assert_eq!(refused(OutputLimits { drive: Some(1), ..LIMITS }, DRIVE), Some(Refused::NoDrive(0)));
        assert_eq!(refused(LIMITS, DriveLimits { speed: f64::NAN, ..DRIVE }), Some(Refused::Drive(0)));
        assert_eq!(refused(LIMITS, DriveLimits { power: -1.0, ..DRIVE }), Some(Refused::Drive(0)));
        assert_eq!(refused(LIMITS, DriveLimits { travel: (1.0, 0.0), ..DRIVE }), Some(Refused::Drive(0)));
        let lamp = OutputLimits { low: f64::NEG_INFINITY, high: f64::INFINITY, drive: None, torque: false, ..LIMITS };
        assert_eq!(refused(lamp, DRIVE), None, "a lamp needs no bounds");
    }

    #[test]
    fn what_is_saved_goes_on_as_before() {
        let mut first = armed(LIMITS, PATIENCE);
        for k in 0..40 {
            let mut words = Vec::new();
            first.save(&mut words);
            let mut second = armed(LIMITS, PATIENCE);
            assert_eq!(second.restore(&mut words.iter().copied()), Some(()));
            assert_eq!(second.restore(&mut words[1..].iter().copied()), None, "short of a word");
            if k == 20 {
                first.trip(Cause::Travel(0, 1.5));
                second.trip(Cause::Travel(0, 1.5));
            }
            let request = f64::from(k % 7);
            assert_eq!(first.judge(&[request], &at(30.0)), second.judge(&[request], &at(30.0)), "cycle {k}");
            assert_eq!((first.permitted(), first.cause()), (second.permitted(), second.cause()));
        }
        assert!(first.is_disabled());
    }

    #[test]
    fn every_cause_has_one_reaction() {
        let quick = [
            Cause::Speed(0, 1.0),
            Cause::Travel(0, 1.0),
            Cause::RunAway(0),
            Cause::Lost(0),
            Cause::Implausible(0),
            Cause::Drive(0),
            Cause::Bus(0),
            Cause::Foreign(0, 0),
            Cause::Watchdog,
        ];
        let controlled = [
            Cause::Asked,
            Cause::NotFinite(0),
            Cause::Guard(1),
            Cause::Clamped(0),
            Cause::Condition(0),
            Cause::Overrun(1),
            Cause::NotFollowing(0),
            Cause::Overload(0),
            Cause::Energy,
            Cause::Unpredictable,
            Cause::Unwatched,
        ];
        for cause in quick.iter().chain(&controlled) {
            assert_eq!(Cause::from_words(cause.to_words()), Some(*cause));
        }
        assert_eq!(Cause::from_words([0, 0]), None);
        assert!(quick.iter().all(|cause| cause.reaction() == Reaction::Quick));
        assert!(controlled.iter().all(|cause| cause.reaction() == Reaction::Controlled));
    }
}
