//! Positions and labels of the ticks of an axis.
//!
//! Uses decimal exponents parsed from printed numbers, so that no logarithm is off by one at a power of ten.

/// An axis with its ticks.
#[derive(Clone, PartialEq, Debug)]
pub struct Scale {
    /// Lower end.
    pub from: f64,
    /// Upper end.
    pub to: f64,
    /// Ascending, between the ends.
    pub ticks: Vec<Tick>,
    /// The factor or offset omitted from the labels: `×10⁻⁶`, `+3.3068`; often empty.
    pub note: String,
}

/// A tick of an axis.
#[derive(Clone, PartialEq, Debug)]
pub struct Tick {
    /// Its value.
    pub at: f64,
    /// Its label.
    pub label: String,
}

impl Scale {
    /// From `from` to `to` with about `count` ticks at multiples of 1, 2 or 5 times a power of ten.
    pub fn new(from: f64, to: f64, count: usize) -> Scale {
        let (from, to) = opened(from, to);
        let step = step(from, to, count);
        let (first, last) = ((from / step - 1e-9).ceil(), (to / step + 1e-9).floor());
        let places: Vec<f64> = (0..=(last - first).clamp(0.0, 100.0) as u64)
            .map(|i| ((first + i as f64) * step).clamp(from, to))
            .collect();
        let largest = from.abs().max(to.abs());

        // More than six digits: labels are relative to a round number near the lower end.
        let round = ten_to(exponent(to - from) + 1);
        let base = if largest > 1e5 * step { (from / round).floor() * round } else { 0.0 };
        let largest = if base == 0.0 { largest } else { to - base };
        // Very large or small: labels omit a power of ten.
        let power = match exponent(largest) {
            0..5 => 0,
            -3..0 => 0,
            e => 3 * e.div_euclid(3),
        };
        let decimals = (power - exponent(step)).max(0) as usize;
        let label = |at: f64| {
            let number = format!("{:.decimals$}", (at - base) / ten_to(power));
            if number.trim_start_matches('-').chars().all(|c| c == '0' || c == '.') { "0".into() } else { number }
        };
        let ticks = places.into_iter().map(|at| Tick { at, label: label(at) }).collect();
        let mut note = String::new();
        if power != 0 {
            note = format!("×10{}", raised(power));
        }
        if base != 0.0 {
            let (digits, size) = (-exponent(round), exponent(base));
            let number = if (-5..6).contains(&size) {
                format!("{base:.*}", digits.max(0) as usize)
            } else {
                format!("{base:.*e}", (digits + size).max(0) as usize)
            };
            note += if number.starts_with('-') { "" } else { "+" };
            note += &number;
        }
        Scale { from, to, ticks, note }
    }

    /// A logarithmic axis between two exponents of ten: ticks at powers of ten, and at 2 and 5 where there are few.
    pub fn decades(from: f64, to: f64, count: usize) -> Scale {
        /// Decimal logarithms of 2 and 5.
        const BETWEEN: [(&str, f64); 2] = [("2", std::f64::consts::LOG10_2), ("5", 1.0 - std::f64::consts::LOG10_2)];
        let (from, to) = opened(from, to);
        let (first, last) = (from.floor() as i32, to.ceil() as i32);
        let every = ((last - first).max(1) as usize).div_ceil(count.max(1)) as i32;
        let few = to - from < 2.0;
        // All labels of an axis are decimals, or all are powers of ten.
        let labelled = |exponent: &i32| f64::from(*exponent) >= from - 1e-9 && f64::from(*exponent) <= to + 1e-9;
        let decimals = (first..=last).filter(labelled).all(|exponent| (-2..4).contains(&exponent));
        let mut ticks = Vec::new();
        for exponent in first..=last {
            if exponent % every == 0 {
                let label = match exponent {
                    exponent if decimals => format!("{}", ten_to(exponent)),
                    0 => "1".into(),
                    1 => "10".into(),
                    exponent => format!("10{}", raised(exponent)),
                };
                ticks.push(Tick { at: f64::from(exponent), label });
            }
            for (digit, part) in BETWEEN.iter().filter(|_| few) {
                let label = match exponent {
                    0 => (*digit).into(),
                    -3..4 if decimals => {
                        // Rounded, because a product such as 5 · 0.001 is not the nearest double.
                        let places = (-exponent).max(0) as usize;
                        format!("{:.places$}", digit.parse::<f64>().expect("a digit") * ten_to(exponent))
                    }
                    exponent => format!("{digit}·10{}", raised(exponent)),
                };
                ticks.push(Tick { at: f64::from(exponent) + part, label });
            }
        }
        ticks.retain(|tick| tick.at >= from - 1e-9 && tick.at <= to + 1e-9);
        Scale { from, to, ticks, note: String::new() }
    }

    /// Relative position of a value, 0 at the lower end and 1 at the upper one.
    pub fn position(&self, value: f64) -> f64 {
        // Halved, so that the difference of huge ends stays finite.
        (value / 2.0 - self.from / 2.0) / (self.to / 2.0 - self.from / 2.0)
    }
}

/// Slightly more than the range of the values, so that no curve runs along the frame.
pub fn padded((min, max): (f64, f64), part: f64) -> (f64, f64) {
    let (from, to) = opened(min, max);
    let pad = (to / 2.0 - from / 2.0) * 2.0 * part;
    let (lower, upper) = (from - pad, to + pad);
    if lower.is_finite() && upper.is_finite() { (lower, upper) } else { (from, to) }
}

/// Widens an interval to a width that can be drawn.
fn opened(from: f64, to: f64) -> (f64, f64) {
    // Beyond this, differences overflow.
    let (from, to) = (from.clamp(-1e300, 1e300), to.clamp(-1e300, 1e300));
    let largest = from.abs().max(to.abs());
    if to - from > largest * 1e-12 && to - from > 1e-300 {
        return (from, to);
    }
    let half = if largest < 1e-290 { 1.0 } else { largest * 0.1 };
    (from - half, to + half)
}

/// 1, 2 or 5 times a power of ten that divides the interval into about `count` parts.
fn step(from: f64, to: f64, count: usize) -> f64 {
    let wanted = count.max(1) as f64;
    let power = exponent((to - from) / wanted);
    let steps = [power - 1, power, power + 1].into_iter().flat_map(|e| [1.0, 2.0, 5.0].map(|m| m * ten_to(e)));
    // Too many parts are worse than too few.
    let badness = |step: f64| {
        let parts = (to - from) / step;
        if parts > wanted { 1.3 * (parts / wanted - 1.0) } else { wanted / parts - 1.0 }
    };
    steps.min_by(|a, b| badness(*a).total_cmp(&badness(*b))).expect("there are nine steps")
}

/// The exponent of a number in scientific notation; 0 for 0.
pub fn exponent(x: f64) -> i32 {
    let text = format!("{x:e}");
    text.split_once('e').and_then(|(_, exponent)| exponent.parse().ok()).unwrap_or(0)
}

/// The double nearest to a power of ten.
pub fn ten_to(exponent: i32) -> f64 {
    format!("1e{exponent}").parse().expect("a power of ten is a number")
}

/// An exponent in superscript digits.
pub fn raised(exponent: i32) -> String {
    let raise = |c: char| match c {
        '-' => '⁻',
        '1' => '¹',
        '2' => '²',
        '3' => '³',
        digit => char::from_u32('⁰' as u32 + (digit as u32 - '0' as u32)).unwrap_or(digit),
    };
    exponent.to_string().chars().map(raise).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(from: f64, to: f64, count: usize) -> (Vec<String>, String) {
        let scale = Scale::new(from, to, count);
        (scale.ticks.into_iter().map(|tick| tick.label).collect(), scale.note)
    }

    #[test]
    fn ticks_are_round_numbers() {
        assert_eq!(labels(0.0, 40.0, 5).0, ["0", "10", "20", "30", "40"]);
        assert_eq!(labels(-0.21, 1.63, 5).0, ["0", "0.5", "1.0", "1.5"]);
        assert_eq!(labels(-1.5, 1.5, 4).0, ["-1", "0", "1"]);
        assert_eq!(labels(0.0, 0.0153, 4).0, ["0", "0.005", "0.010", "0.015"]);
        assert_eq!(labels(0.0, 99999.0, 2).0, ["0", "50000"]);
    }

    #[test]
    fn decades_are_powers_of_ten() {
        let labels = |from: f64, to: f64, count: usize| {
            Scale::decades(from, to, count).ticks.into_iter().map(|tick| tick.label).collect::<Vec<_>>()
        };
        assert_eq!(labels(-6.0, 0.0, 8), ["10⁻⁶", "10⁻⁵", "10⁻⁴", "10⁻³", "10⁻²", "10⁻¹", "1"]);
        assert_eq!(labels(-2.0, 1.0, 8), ["0.01", "0.1", "1", "10"]);
        assert_eq!(labels(-0.05, 1.05, 8), ["1", "2", "5", "10"]);
        assert_eq!(labels(-1.5, -0.5, 4), ["0.05", "0.1", "0.2"]);
    }

    #[test]
    fn large_and_small_numbers_leave_out_a_power() {
        assert_eq!(
            labels(0.0, 1.5e-6, 3),
            (vec!["0".into(), "0.5".into(), "1.0".into(), "1.5".into()], "×10⁻⁶".into())
        );
        assert_eq!(labels(0.0, 3e7, 3), (vec!["0".into(), "10".into(), "20".into(), "30".into()], "×10⁶".into()));
    }

    #[test]
    fn a_narrow_range_counts_from_a_round_number() {
        let (ticks, note) = labels(3.3067920, 3.3067926, 3);
        assert_eq!(note, "×10⁻⁹+3.306792");
        assert_eq!(ticks, ["0", "200", "400", "600"]);
    }

    #[test]
    fn odd_ranges_still_have_a_scale() {
        for (from, to) in [(0.0, 0.0), (5.0, 5.0), (-1e308, 1e308), (1e-320, 2e-320), (1.0, 1.0 + 1e-16), (-3.0, -3.0)]
        {
            let scale = Scale::new(from, to, 5);
            assert!(scale.to > scale.from && !scale.ticks.is_empty(), "{from} {to}: {scale:?}");
            assert!(scale.ticks.len() < 14, "{from} {to}: {scale:?}");
            assert!((0.0..=1.0).contains(&scale.position(scale.ticks[0].at)), "{from} {to}: {scale:?}");
        }
    }
}
