//! Conversion between SI values and the integers of drives.
//!
//! Measured values are rounded to nearest, commands towards zero, so that no command on the bus exceeds the permitted
//! value.

use crate::safety::{Protection, is_present};

/// Encoding of a signal as an integer: the value of one step, and the range.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Scale {
    /// Value of one step, SI; never 0.
    pub step: f64,
    /// Lowest number that may be sent.
    pub low: i64,
    /// Highest number that may be sent.
    pub high: i64,
}

impl Scale {
    /// Steps in a signed number of this many bits.
    pub fn signed(step: f64, bits: u32) -> Scale {
        Scale { step, low: -1 << (bits - 1), high: (1 << (bits - 1)) - 1 }
    }

    /// The number nearest to a value. NaN becomes 0; a value outside the range is clamped.
    pub fn number(&self, value: f64) -> i64 {
        ((value / self.step).round() as i64).clamp(self.low, self.high)
    }

    /// The number for a command: the greatest one in magnitude whose value does not exceed the command. NaN becomes 0;
    /// a value outside the range is clamped.
    pub fn command(&self, value: f64) -> i64 {
        let number = self.number(value);
        if beyond(self.value(number), value, value) && is_present(Protection::Rounding) {
            return (number - number.signum()).clamp(self.low, self.high);
        }
        number
    }

    /// The value of a number, SI.
    pub fn value(&self, number: i64) -> f64 {
        number as f64 * self.step
    }
}

/// Whether a value on the bus exceeds the permitted one by more than the rounding error of a product or sum of numbers
/// of magnitude `size`.
pub fn beyond(wire: f64, permitted: f64, size: f64) -> bool {
    wire.abs() > permitted.abs() + 2.0 * f64::EPSILON * size.abs()
}

/// A 32-bit position, extended beyond its overflow.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Counter {
    last: Option<i32>,
    /// Counts since the origin.
    total: i64,
}

impl Counter {
    /// Takes the next reading: between two readings less than half of all counts pass.
    pub fn read(&mut self, counts: i32) {
        if let Some(last) = self.last {
            self.total += i64::from(counts.wrapping_sub(last));
        }
        self.last = Some(counts);
    }

    /// Makes the last reading the origin.
    pub fn rest(&mut self) {
        self.total = 0;
    }

    /// Counts since the origin.
    pub fn total(&self) -> i64 {
        self.total
    }

    /// The number for a position command of this many counts since the origin. A number beyond 32 bits does not wrap,
    /// because the drive would turn the other way: the nearest number in the right direction is returned instead, with
    /// false.
    pub fn number(&self, total: i64) -> (i32, bool) {
        let way = total.saturating_sub(self.total);
        if !is_present(Protection::Wrap) {
            return (self.last.unwrap_or(0).wrapping_add(way as i32), true);
        }
        let number = i64::from(self.last.unwrap_or(0)).saturating_add(way);
        let nearest = number.clamp(i32::MIN.into(), i32::MAX.into());
        (nearest as i32, nearest == number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;

    #[test]
    fn torque_is_encoded_in_thousandths_of_rated_torque() {
        let torque = Scale::signed(4.0 / 1000.0, 16);
        assert_eq!(torque.number(2.0), 500);
        assert_eq!(torque.number(-0.0021), -1);
        assert_eq!(torque.value(-250), -1.0);
        assert_eq!((torque.number(f64::INFINITY), torque.number(-1e300)), (32767, -32768));
        assert_eq!(torque.number(f64::NAN), 0);
        assert_eq!(Scale::signed(1.0, 32).number(1e12), i64::from(i32::MAX));
    }

    #[test]
    fn a_position_continues_beyond_its_overflow() {
        let mut counter = Counter::default();
        let mut truth = i64::from(i32::MAX) - 5;
        counter.read(truth as i32);
        counter.rest();
        for step in [3, 3, 3, -20, 1_000_000_000, 2_000_000_000, -2_000_000_000] {
            truth += step;
            counter.read(truth as i32);
            assert_eq!(counter.total(), truth - (i64::from(i32::MAX) - 5));
        }
        let last = i64::from(truth as i32);
        assert_eq!(counter.number(counter.total() + 7), ((last + 7) as i32, true));
    }

    #[test]
    fn a_position_command_never_wraps() {
        let mut random = Chance(7);
        let mut wrapped = 0;
        for case in 0..20_000 {
            let mut counter = Counter::default();
            let mut random_i32 = || random.between(-2_147_483_648.0, 2_147_483_647.0) as i32;
            counter.read(random_i32());
            counter.rest();
            let last = i64::from(random_i32());
            counter.read(last as i32);
            let way = random.between(-1e10, 1e10) as i64;
            let (number, whole) = counter.number(counter.total() + way);
            let moved = i64::from(number) - last;
            assert!(moved == 0 || moved.signum() == way.signum(), "case {case}: {way} from {last} became {number}");
            assert_eq!(whole, moved == way, "case {case}: {way} from {last} became {number}");
            wrapped += u32::from(!whole);
        }
        assert!(wrapped > 1000, "{wrapped}");
        assert!(!Counter::default().number(i64::MAX).1 && !Counter::default().number(i64::MIN).1);
    }

    #[test]
    fn an_encoded_command_is_within_one_step_below_the_permitted_value() {
        let mut random = Chance(11);
        for case in 0..100_000 {
            let step = 10f64.powf(random.between(-9.0, 3.0)) * [1.0, -1.0][random.below(2) as usize];
            let bits = [8, 16, 32][random.below(3) as usize];
            let scale = Scale::signed(step, bits);
            // Any value, a value on a step, and the neighbours of that.
            let most = 2f64.powi(bits as i32 - 1) - 1.0;
            let value = match random.below(3) {
                0 => random.between(-1.0, 1.0) * most * step,
                1 => (random.between(-1.0, 1.0) * most).round() * step,
                _ => ((random.between(-1.0, 1.0) * most).round() * step).next_up(),
            };
            let wire = scale.value(scale.command(value));
            let slack = 4.0 * f64::EPSILON * value.abs();
            assert!(wire.abs() <= value.abs() + slack, "case {case}: {value} in steps of {step} became {wire}");
            assert!(wire * value >= 0.0, "case {case}: {value} became {wire}");
            assert!((value - wire).abs() <= step.abs() + slack, "case {case}: {value} became {wire}");
        }
        let tight = Scale::signed(3.0 / 1000.0, 16);
        assert_eq!((tight.command(0.2), tight.command(-0.2), tight.command(0.3)), (66, -66, 100));
        assert_eq!((tight.command(f64::NAN), tight.command(f64::INFINITY)), (0, 32767));
    }
}
