//! The properties of the fault space, by name.

/// A property that a run can violate.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Broken {
    /// A torque on the bus exceeds its limit.
    WireLimit,
    /// A torque on the shaft exceeds its limit.
    ShaftLimit,
    /// A command is outside its limits, exceeds its slew, or is not finite.
    Permitted,
    /// A drive's power exceeds its limit.
    Power,
    /// Outputs do not ramp up from their safe values.
    Ramp,
    /// A drive does not apply the permitted value, and no stop is under way.
    Follow,
    /// Torque before arming.
    BeforeArm,
    /// Torque after the time bound of a stop, or increasing torque during the stop.
    AfterStop,
    /// A frame that the bus refused did not stop the rig in the next cycle.
    Refused,
    /// A drive stays enabled although no set-points reach it.
    Deadline,
    /// More successive cycles missed a tick than the rig permits, and no stop is under way.
    Overrun,
    /// A position on the bus lies on the wrong side because its counts overflowed.
    Wrapped,
    /// A drive that is not simulated was enabled under options for simulated drives only.
    Permission,
    /// The rig uses a speed that the shaft does not have, and no stop is under way.
    Blind,
    /// Motion after a stop without the operator.
    Latch,
    /// The speed is beyond its limit, and no stop is under way.
    Speed,
    /// The position is beyond its limit, and no stop is under way.
    Travel,
    /// The shaft accelerates against its torque, and no stop is under way.
    RunAway,
    /// A request was outside its limits for too long, and no stop is under way.
    Clamped,
    /// The model's request is not finite, and no stop is under way.
    NoNumber,
    /// Limits were widened.
    Widened,
    /// A set of parameters was accepted in part, or vanished.
    Set,
    /// A replay of the same readings computes other outputs.
    Replay,
    /// A cycle allocated on the heap.
    Heap,
    /// A stop without a reason.
    Needless,
    /// The run does not end.
    Endless,
    /// The rig accepts a reading that is further off than the shaft can be.
    Jump,
    /// Three successive implausible readings, and no quick stop is under way.
    Odd,
    /// The rig accepts a reading that is not finite.
    Infinite,
    /// Position and speed of a drive disagree, and no quick stop is under way.
    Agree,
    /// A frame arrived that only another master sends, and no quick stop is under way.
    Foreign,
    /// Frames were lost in three successive cycles, and no stop is under way.
    Overload,
    /// A drive reports that it does not follow, and no stop is under way.
    Shown,
    /// Our own code panicked.
    Panic,
}
