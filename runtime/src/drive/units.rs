//! SI values and the whole numbers that drives speak.

/// How a signal is told in whole numbers: one step of it, SI, and its least and greatest number.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Scale {
    /// SI value of one step; never 0.
    pub step: f64,
    /// Least number that may be sent.
    pub low: i64,
    /// Greatest number that may be sent.
    pub high: i64,
}

impl Scale {
    /// Steps in a signed number of so many bits.
    pub fn signed(step: f64, bits: u32) -> Scale {
        Scale { step, low: -1 << (bits - 1), high: (1 << (bits - 1)) - 1 }
    }

    /// The number nearest to a value. What is no number gives 0, what doesn't fit the nearest that does.
    pub fn number(&self, value: f64) -> i64 {
        ((value / self.step).round() as i64).clamp(self.low, self.high)
    }

    /// The value of a number, SI.
    pub fn value(&self, number: i64) -> f64 {
        number as f64 * self.step
    }
}

/// A position told in 32 bits, continued beyond them.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Counter {
    last: Option<i32>,
    /// Counts since the origin.
    total: i64,
}

impl Counter {
    /// Takes the next reading: between two, less than half of all counts have gone by.
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

    /// The number that stands for so many counts since the origin, for a drive that takes positions.
    pub fn number(&self, total: i64) -> i32 {
        self.last.unwrap_or(0).wrapping_add((total - self.total) as i32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn torque_is_told_in_thousandths_of_rated_torque() {
        let torque = Scale::signed(4.0 / 1000.0, 16);
        assert_eq!(torque.number(2.0), 500);
        assert_eq!(torque.number(-0.0021), -1);
        assert_eq!(torque.value(-250), -1.0);
        assert_eq!((torque.number(f64::INFINITY), torque.number(-1e300)), (32767, -32768));
        assert_eq!(torque.number(f64::NAN), 0);
        assert_eq!(Scale::signed(1.0, 32).number(1e12), i64::from(i32::MAX));
    }

    #[test]
    fn a_position_goes_on_where_its_number_wraps() {
        let mut counter = Counter::default();
        let mut truth = i64::from(i32::MAX) - 5;
        counter.read(truth as i32);
        counter.rest();
        for step in [3, 3, 3, -20, 1_000_000_000, 2_000_000_000, -2_000_000_000] {
            truth += step;
            counter.read(truth as i32);
            assert_eq!(counter.total(), truth - (i64::from(i32::MAX) - 5));
        }
        assert_eq!(counter.number(counter.total() + 7), (truth + 7) as i32);
    }
}
