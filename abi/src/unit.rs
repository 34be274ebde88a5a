//! Dimensions, as exponents of SI base units, and units, as scales in which numbers are written.

use std::fmt;

/// An exact fraction in lowest terms with a positive denominator.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Ratio {
    num: i32,
    den: i32,
}

impl Ratio {
    /// 0
    pub const ZERO: Ratio = Ratio { num: 0, den: 1 };
    /// 1
    pub const ONE: Ratio = Ratio { num: 1, den: 1 };

    /// Represents every fraction whose lowest terms do not fit 32 bits. Exponents in physics are small; code that
    /// parses one must check [`Ratio::is_beyond`].
    pub const BEYOND: Ratio = Ratio { num: i32::MAX, den: 1 };

    /// `num / den`
    ///
    /// # Panics
    /// If `den` is 0.
    pub fn new(num: i64, den: i64) -> Ratio {
        assert!(den != 0, "{num}/0 is no fraction");
        let (mut a, mut b) = (num.unsigned_abs(), den.unsigned_abs());
        while b != 0 {
            (a, b) = (b, a % b);
        }
        let divisor = i128::from(a.max(1)) * i128::from(den.signum());
        // i32::MIN is excluded, because its negative does not fit.
        let fit = |n: i64| i32::try_from(i128::from(n) / divisor).ok().filter(|n| *n != i32::MIN);
        match (fit(num), fit(den)) {
            (Some(num), Some(den)) => Ratio { num, den },
            _ => Ratio::BEYOND,
        }
    }

    /// Whether it is [`Ratio::BEYOND`].
    pub fn is_beyond(self) -> bool {
        self == Ratio::BEYOND
    }

    /// The integer `n`.
    pub fn whole(n: i32) -> Ratio {
        Ratio { num: n, den: 1 }
    }

    /// Numerator and denominator.
    pub fn parts(self) -> (i32, i32) {
        (self.num, self.den)
    }

    /// Whether it is 0.
    pub fn is_zero(self) -> bool {
        self.num == 0
    }

    /// The fraction with a denominator of at most 12 that equals `x` up to 1e-12, if there is one.
    pub fn approximate(x: f64) -> Option<Ratio> {
        (1..=12i64).find_map(|den| {
            let num = (x * den as f64).round();
            (num.abs() < 1e6 && (num / den as f64 - x).abs() < 1e-12).then(|| Ratio::new(num as i64, den))
        })
    }
}

impl std::ops::Add for Ratio {
    type Output = Ratio;
    fn add(self, o: Ratio) -> Ratio {
        if self.is_beyond() || o.is_beyond() {
            return Ratio::BEYOND;
        }
        let (a, b, c, d) = (self.num as i64, self.den as i64, o.num as i64, o.den as i64);
        Ratio::new(a * d + c * b, b * d)
    }
}

impl std::ops::Neg for Ratio {
    type Output = Ratio;
    fn neg(self) -> Ratio {
        if self.is_beyond() {
            return self;
        }
        Ratio { num: -self.num, den: self.den }
    }
}

impl std::ops::Mul for Ratio {
    type Output = Ratio;
    fn mul(self, o: Ratio) -> Ratio {
        if self.is_zero() || o.is_zero() {
            return Ratio::ZERO;
        }
        if self.is_beyond() || o.is_beyond() {
            return Ratio::BEYOND;
        }
        Ratio::new(self.num as i64 * o.num as i64, self.den as i64 * o.den as i64)
    }
}

impl fmt::Display for Ratio {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self.den {
            1 => write!(f, "{}", self.num),
            den => write!(f, "{}/{}", self.num, den),
        }
    }
}

impl fmt::Debug for Ratio {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// Exponents of kg, m, s, A, K.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Debug)]
pub struct Dimension(pub [Ratio; 5]);

impl Dimension {
    /// Dimensionless.
    pub const NONE: Dimension = Dimension([Ratio::ZERO; 5]);

    /// Integer exponents of kg, m, s, A, K.
    pub const fn of(exponents: [i32; 5]) -> Dimension {
        let mut out = [Ratio::ZERO; 5];
        let mut i = 0;
        while i < 5 {
            out[i] = Ratio { num: exponents[i], den: 1 };
            i += 1;
        }
        Dimension(out)
    }

    /// The dimension of a product.
    pub fn times(self, other: Dimension) -> Dimension {
        Dimension(std::array::from_fn(|i| self.0[i] + other.0[i]))
    }

    /// The dimension of a quotient.
    pub fn over(self, other: Dimension) -> Dimension {
        self.times(other.power(Ratio::whole(-1)))
    }

    /// The dimension of a power.
    pub fn power(self, exponent: Ratio) -> Dimension {
        Dimension(self.0.map(|e| e * exponent))
    }

    /// The rotary twin: m → 1 (rad), kg → kg·m². It is a homomorphism: products map to products.
    pub fn rotary(self) -> Dimension {
        let [kg, _, s, a, k] = self.0;
        Dimension([kg, kg + kg, s, a, k])
    }

    /// Whether a nonzero command of this dimension causes motion: force, torque, velocity, angular velocity,
    /// acceleration, current.
    pub fn moves(self) -> bool {
        let kinds: [[i32; 5]; 7] = [
            [1, 1, -2, 0, 0],
            [1, 2, -2, 0, 0],
            [0, 1, -1, 0, 0],
            [0, 0, -1, 0, 0],
            [0, 1, -2, 0, 0],
            [0, 0, -2, 0, 0],
            [0, 0, 0, 1, 0],
        ];
        kinds.iter().any(|exponents| Dimension::of(*exponents) == self)
    }

    /// Whether an exponent is [`Ratio::BEYOND`].
    pub fn is_beyond(self) -> bool {
        self.0.iter().any(|exponent| exponent.is_beyond())
    }

    /// Whether it is dimensionless.
    pub fn is_none(self) -> bool {
        self == Dimension::NONE
    }

    /// The usual name of such a quantity: `a force`, `a velocity`; `a quantity in kg·m` if it has none.
    pub fn describe(self) -> String {
        match KINDS.iter().find(|(_, exponents)| Dimension::of(*exponents) == self) {
            Some((name, _)) => (*name).to_string(),
            None => format!("a quantity in {}", Unit::si(self)),
        }
    }
}

/// Names of kinds of quantity, with exponents of kg, m, s, A, K.
const KINDS: &[(&str, [i32; 5])] = &[
    ("a pure number", [0, 0, 0, 0, 0]),
    ("a length", [0, 1, 0, 0, 0]),
    ("a velocity", [0, 1, -1, 0, 0]),
    ("an acceleration", [0, 1, -2, 0, 0]),
    ("a time", [0, 0, 1, 0, 0]),
    ("a rate", [0, 0, -1, 0, 0]),
    ("a mass", [1, 0, 0, 0, 0]),
    ("a force", [1, 1, -2, 0, 0]),
    ("a torque or energy", [1, 2, -2, 0, 0]),
    ("a power", [1, 2, -3, 0, 0]),
    ("a stiffness", [1, 0, -2, 0, 0]),
    ("a viscous coefficient", [1, 0, -1, 0, 0]),
    ("an inertia", [1, 2, 0, 0, 0]),
    ("a current", [0, 0, 0, 1, 0]),
    ("a temperature", [0, 0, 0, 0, 1]),
    ("a pressure", [1, -1, -2, 0, 0]),
];

/// Whether a unit mentions angles. This tag belongs to units as written, not to dimensions.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug, Default)]
pub enum Angle {
    /// No angle.
    #[default]
    Silent,
    /// Contains rad, deg, rev or rpm.
    Angle,
    /// 1/s without an angle.
    Rate,
    /// Hz: periods or revolutions per second.
    Cycles,
}

/// A unit as written. `value in SI = scale · number`.
#[derive(Clone, PartialEq, Debug)]
pub struct Unit {
    /// The dimension of its quantities.
    pub dimension: Dimension,
    /// SI value of one unit.
    pub scale: f64,
    /// As displayed: `N·s/m`, `µm`; empty if dimensionless.
    pub text: String,
    /// Whether it mentions angles.
    pub angle: Angle,
}

impl Default for Unit {
    fn default() -> Unit {
        Unit::none()
    }
}

/// Known units: symbol, SI scale, exponents, whether prefixes are allowed, angle tag.
const UNITS: &[(&str, f64, [i32; 5], bool, Angle)] = &[
    ("m", 1.0, [0, 1, 0, 0, 0], true, Angle::Silent),
    ("g", 1e-3, [1, 0, 0, 0, 0], true, Angle::Silent),
    ("s", 1.0, [0, 0, 1, 0, 0], true, Angle::Silent),
    ("min", 60.0, [0, 0, 1, 0, 0], false, Angle::Silent),
    ("h", 3600.0, [0, 0, 1, 0, 0], false, Angle::Silent),
    ("A", 1.0, [0, 0, 0, 1, 0], true, Angle::Silent),
    ("K", 1.0, [0, 0, 0, 0, 1], true, Angle::Silent),
    ("N", 1.0, [1, 1, -2, 0, 0], true, Angle::Silent),
    ("J", 1.0, [1, 2, -2, 0, 0], true, Angle::Silent),
    ("W", 1.0, [1, 2, -3, 0, 0], true, Angle::Silent),
    ("Pa", 1.0, [1, -1, -2, 0, 0], true, Angle::Silent),
    ("V", 1.0, [1, 2, -3, -1, 0], true, Angle::Silent),
    ("Ohm", 1.0, [1, 2, -3, -2, 0], true, Angle::Silent),
    ("Hz", 1.0, [0, 0, -1, 0, 0], true, Angle::Cycles),
    ("rad", 1.0, [0, 0, 0, 0, 0], true, Angle::Angle),
    ("deg", std::f64::consts::PI / 180.0, [0, 0, 0, 0, 0], true, Angle::Angle),
    ("rev", 2.0 * std::f64::consts::PI, [0, 0, 0, 0, 0], false, Angle::Angle),
    ("rpm", 2.0 * std::f64::consts::PI / 60.0, [0, 0, -1, 0, 0], false, Angle::Angle),
    ("bit", 1.0, [0, 0, 0, 0, 0], true, Angle::Silent),
    ("%", 1e-2, [0, 0, 0, 0, 0], false, Angle::Silent),
];

/// Prefixes. `c` is only allowed with `m`.
const PREFIXES: &[(&str, f64)] = &[("G", 1e9), ("M", 1e6), ("k", 1e3), ("m", 1e-3), ("u", 1e-6), ("n", 1e-9)];

/// Largest exponent of a factor as written: no real unit needs a larger one.
const MOST_EXPONENT: u32 = 99;

/// The symbols of all units, with all their prefixes.
pub fn symbols() -> impl Iterator<Item = String> {
    UNITS.iter().flat_map(|(symbol, _, _, prefixed, _)| {
        let with = PREFIXES.iter().filter(|_| *prefixed).map(move |(prefix, _)| format!("{prefix}{symbol}"));
        std::iter::once((*symbol).to_string()).chain(with)
    })
}

impl Unit {
    /// Dimensionless.
    pub fn none() -> Unit {
        Unit { dimension: Dimension::NONE, scale: 1.0, text: String::new(), angle: Angle::Silent }
    }

    /// The SI unit of a dimension, by its usual name if there is one: `N·s/m` rather than `kg/s`.
    pub fn si(dimension: Dimension) -> Unit {
        Unit { dimension, scale: 1.0, text: si_text(dimension), angle: Angle::Silent }
    }

    /// Parses a unit as written, without brackets: `N·s/m`, `1/s`, `µm`, `kg*m^2`, `1`.
    ///
    /// # Errors
    /// The unknown part of the text.
    pub fn parse(text: &str) -> Result<Unit, String> {
        let mut unit = Unit::none();
        let mut parts: Vec<(i32, String)> = Vec::new();
        let mut sign = 1;
        let mut atom = String::new();
        let mut take = |atom: &mut String, sign: i32| -> Result<(), String> {
            let (one, shown, exponent) = parse_atom(atom)?;
            if !(shown.is_empty()) {
                parts.push((sign * exponent, shown));
            }
            let exponent = Ratio::whole(sign * exponent);
            unit.dimension = unit.dimension.times(one.dimension.power(exponent));
            let (n, _) = exponent.parts();
            for _ in 0..n.unsigned_abs() {
                if n > 0 { unit.scale *= one.scale } else { unit.scale /= one.scale }
            }
            if one.angle == Angle::Angle || unit.angle == Angle::Silent {
                unit.angle = one.angle;
            }
            atom.clear();
            Ok(())
        };
        for c in text.chars() {
            match c {
                '·' | '*' => {
                    take(&mut atom, sign)?;
                    // Left to right: `N/m·s` is (N/m)·s.
                    sign = 1;
                }
                '/' => {
                    take(&mut atom, sign)?;
                    sign = -1;
                }
                c => atom.push(c),
            }
        }
        take(&mut atom, sign)?;
        // A unit whose scale underflows or overflows is useless.
        if !unit.scale.is_normal() || unit.dimension.is_beyond() {
            return Err(text.to_string());
        }
        unit.text = joined(&parts);
        if unit.angle == Angle::Silent && unit.dimension == Dimension::of([0, 0, -1, 0, 0]) {
            unit.angle = Angle::Rate;
        }
        Ok(unit)
    }

    /// Converts a value in SI to a number in this unit.
    pub fn from_si(&self, si: f64) -> f64 {
        match self.divisor() {
            Some(divisor) => si * divisor,
            None => si / self.scale,
        }
    }

    /// Converts a number in this unit to a value in SI. `20 us` becomes the double nearest to 2e-5.
    pub fn to_si(&self, number: f64) -> f64 {
        match self.divisor() {
            Some(divisor) => number / divisor,
            None => number * self.scale,
        }
    }

    /// The number of these units in one SI unit, if it is an integer. Division by 1000 rounds once, but multiplication
    /// by 0.001 rounds twice.
    fn divisor(&self) -> Option<f64> {
        let divisor = (1.0 / self.scale).round();
        (self.scale < 1.0 && (divisor * self.scale - 1.0).abs() < 1e-14).then_some(divisor)
    }

    /// The unit of the rotary twin of a quantity with this unit: `um` → `µrad`, `N` → `N·m`.
    pub fn rotary(&self) -> Unit {
        let dimension = self.dimension.rotary();
        if dimension == self.dimension {
            return self.clone();
        }
        // The prefix is kept if the unit is a single symbol with a twin.
        let [_, length, ..] = self.dimension.0;
        let prefix = PREFIXES.iter().find(|(_, scale)| *scale == self.scale).map_or("", |(prefix, _)| *prefix);
        let mut text = si_text(dimension);
        if dimension == Dimension::NONE {
            text = if length == Ratio::ONE { "rad".into() } else { format!("rad^{length}") };
        } else if dimension == Dimension::of([0, 0, -1, 0, 0]) {
            text = "rad/s".into();
        } else if dimension == Dimension::of([0, 0, -2, 0, 0]) {
            text = "rad/s^2".into();
        } else if length == Ratio::ZERO && self.dimension.0[0] == Ratio::ONE {
            // Stiffness and damping are per rad.
            text = match self.dimension.0[2].parts() {
                (-2, 1) => "N·m/rad".into(),
                (-1, 1) => "N·m·s/rad".into(),
                _ => text,
            };
        }
        let scale = if prefix.is_empty() { 1.0 } else { self.scale };
        Unit { dimension, scale, text: format!("{}{text}", prefix.replace('u', "µ")), angle: Angle::Angle }
    }
}

impl fmt::Display for Unit {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(if self.text.is_empty() { "1" } else { &self.text })
    }
}

/// Parses one factor of a unit: the unit without its exponent, its text, its exponent.
fn parse_atom(atom: &str) -> Result<(Unit, String, i32), String> {
    let (word, exponent) = match atom.split_once('^') {
        Some((word, exponent)) => {
            let exponent = exponent.parse::<i32>().ok().filter(|exponent| exponent.unsigned_abs() <= MOST_EXPONENT);
            (word, exponent.ok_or_else(|| atom.to_string())?)
        }
        None => (atom, 1),
    };
    if word == "1" {
        return Ok((Unit::none(), String::new(), 1));
    }
    let plain = word.replace(['µ', 'μ'], "u").replace('°', "deg").replace('Ω', "Ohm");
    if plain == "Nm" {
        let one = Unit { dimension: Dimension::of([1, 2, -2, 0, 0]), ..Unit::none() };
        return Ok((one, "N·m".into(), exponent));
    }
    let known = |symbol: &str| UNITS.iter().find(|(name, ..)| *name == symbol);
    let (scale, &(_, unit_scale, exponents, _, angle)) = match known(&plain) {
        Some(unit) => (1.0, unit),
        None if plain == "cm" => (1e-2, known("m").expect("the metre is known")),
        None => PREFIXES
            .iter()
            .find_map(|(prefix, scale)| {
                let unit = known(plain.strip_prefix(prefix)?)?;
                unit.3.then_some((*scale, unit))
            })
            .ok_or_else(|| word.to_string())?,
    };
    let one = Unit { dimension: Dimension::of(exponents), scale: scale * unit_scale, text: String::new(), angle };
    let shown = match plain.strip_prefix('u') {
        Some(rest) if scale == 1e-6 => format!("µ{rest}"),
        _ => plain,
    };
    Ok((one, shown, exponent))
}

/// Joins factors to a text such as `N·s/m`. Each factor in the denominator has its own slash: `N/m/s` is N/(m·s).
fn joined(parts: &[(i32, String)]) -> String {
    let mut text = String::new();
    let power = |exponent: i32| if exponent.abs() == 1 { String::new() } else { format!("^{}", exponent.abs()) };
    for (exponent, name) in parts.iter().filter(|(exponent, _)| *exponent > 0) {
        if !text.is_empty() {
            text.push('·');
        }
        text += &format!("{name}{}", power(*exponent));
    }
    for (exponent, name) in parts.iter().filter(|(exponent, _)| *exponent < 0) {
        if text.is_empty() {
            text.push('1');
        }
        text += &format!("/{name}{}", power(*exponent));
    }
    text
}

/// The text for a dimension: a usual combination if there is one, otherwise base units.
fn si_text(dimension: Dimension) -> String {
    const NAMED: &[(&str, [i32; 5])] = &[
        ("", [0, 0, 0, 0, 0]),
        ("N", [1, 1, -2, 0, 0]),
        ("N·m", [1, 2, -2, 0, 0]),
        ("W", [1, 2, -3, 0, 0]),
        ("Pa", [1, -1, -2, 0, 0]),
        ("N/m", [1, 0, -2, 0, 0]),
        ("N·s/m", [1, 0, -1, 0, 0]),
        ("N·s", [1, 1, -1, 0, 0]),
        ("N/s", [1, 1, -3, 0, 0]),
        ("N·m·s", [1, 2, -1, 0, 0]),
        ("V", [1, 2, -3, -1, 0]),
        ("Ohm", [1, 2, -3, -2, 0]),
        ("1/N", [-1, -1, 2, 0, 0]),
        ("1/N/m", [-1, -2, 2, 0, 0]),
        ("m/N", [-1, 0, 2, 0, 0]),
        ("m/N/s", [-1, 0, 1, 0, 0]),
    ];
    if let Some((text, _)) = NAMED.iter().find(|(_, exponents)| Dimension::of(*exponents) == dimension) {
        return (*text).into();
    }
    let mut text = String::new();
    let factor = |name: &str, exponent: Ratio| match exponent.parts() {
        (1, 1) => name.to_string(),
        (n, 1) => format!("{name}^{n}"),
        _ => format!("{name}^({exponent})"),
    };
    let named = ["kg", "m", "s", "A", "K"].into_iter().zip(dimension.0);
    for (name, exponent) in named.clone().filter(|(_, e)| e.parts().0 > 0) {
        if !text.is_empty() {
            text.push('·');
        }
        text += &factor(name, exponent);
    }
    for (name, exponent) in named.filter(|(_, e)| e.parts().0 < 0) {
        if text.is_empty() {
            text.push('1');
        }
        text += &format!("/{}", factor(name, -exponent));
    }
    text
}

/// Why a text is not a quantity.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum NoQuantity {
    /// It does not begin with a number.
    Number(String),
    /// The text after the number is not a unit: the unknown part.
    Unit(String),
}

impl fmt::Display for NoQuantity {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            NoQuantity::Number(text) => write!(f, "`{text}` does not begin with a number"),
            NoQuantity::Unit(part) => write!(f, "`{part}` is not a known unit"),
        }
    }
}

/// Parses a number and its unit: `10us`, `2 N`, `1e-3`.
///
/// # Errors
/// Why the text is not a quantity.
pub fn quantity(text: &str) -> Result<(f64, Unit), NoQuantity> {
    let text = text.trim();
    // The longest prefix that is a number: an `e` may belong to an exponent or to a unit.
    let starts = (1..=text.len()).rev().filter(|end| text.is_char_boundary(*end)).map(|end| &text[..end]);
    let read = |start: &str| match start.ends_with(|c: char| c.is_ascii_digit() || c == '.') {
        true => start.parse::<f64>().ok().map(|number| (number, start.len())),
        false => None,
    };
    let (number, end) = starts.filter_map(read).next().ok_or_else(|| NoQuantity::Number(text.into()))?;
    let unit = match text[end..].trim() {
        "" => Unit::none(),
        unit => Unit::parse(unit).map_err(NoQuantity::Unit)?,
    };
    Ok((number, unit))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(text: &str) -> (f64, String) {
        let unit = Unit::parse(text).unwrap();
        (unit.scale, unit.text)
    }

    /// No exponent causes a panic or a long computation: the result is exact or BEYOND.
    #[test]
    fn exponents_are_exact_or_beyond() {
        let large = [1, -1, 2, 12, 99_999, -99_999, i64::from(i32::MAX), i64::from(i32::MIN), i64::MAX, i64::MIN];
        let all: Vec<Ratio> = large.iter().flat_map(|num| large.iter().map(|den| Ratio::new(*num, *den))).collect();
        for a in &all {
            assert!(a.parts().1 > 0 && (-*a).parts().1 > 0);
            for b in &all {
                let exact = |num: i128, den: i128| (num, den);
                let ((p, q), (r, s)) = (a.parts(), b.parts());
                let [p, q, r, s] = [p, q, r, s].map(i128::from);
                for (found, (num, den)) in [(*a + *b, exact(p * s + r * q, q * s)), (*a * *b, exact(p * r, q * s))] {
                    let (n, d) = found.parts();
                    let holds = found.is_beyond() || i128::from(n) * den == num * i128::from(d);
                    assert!(holds, "{a:?}, {b:?}: {found:?}");
                }
            }
        }
        assert_eq!(Ratio::new(99_999, 1) * Ratio::new(99_999, 1), Ratio::BEYOND);
        assert_eq!(Ratio::BEYOND * Ratio::ZERO, Ratio::ZERO);
        for text in
            ["m^2000000000", "m^-2147483648", "1/m^-2147483648", "km^99·km^99·km^99·km^99", "1/km^99/km^99/km^99/km^99"]
        {
            assert!(Unit::parse(text).is_err(), "{text}");
        }
        assert_eq!(Unit::parse("m^99").unwrap().dimension.0[1], Ratio::whole(99));
    }

    #[test]
    fn units_read_left_to_right() {
        assert_eq!(shown("N·s/m"), (1.0, "N·s/m".into()));
        assert_eq!(shown("N/m·s"), (1.0, "N·s/m".into()));
        assert_eq!(
            Unit::parse("N/m/s").unwrap().dimension,
            Unit::parse("N").unwrap().dimension.over(Unit::parse("m·s").unwrap().dimension)
        );
        assert_eq!(shown("um"), (1e-6, "µm".into()));
        assert_eq!(shown("µm"), (1e-6, "µm".into()));
        assert_eq!(shown("kg*m^2"), (1.0, "kg·m^2".into()));
        assert_eq!(shown("1/s"), (1.0, "1/s".into()));
        assert_eq!(shown("Nm"), (1.0, "N·m".into()));
        assert_eq!(shown("%"), (0.01, "%".into()));
        assert_eq!(shown("1"), (1.0, String::new()));
        assert_eq!(shown("mm/s"), (1e-3, "mm/s".into()));
        assert_eq!(shown("cm"), (1e-2, "cm".into()));
        assert_eq!(shown("Mbit/s"), (1e6, "Mbit/s".into()));
        assert_eq!(Unit::parse("furlong").unwrap_err(), "furlong");
        assert_eq!(Unit::parse("N·foo").unwrap_err(), "foo");
    }

    #[test]
    fn the_rotary_twin_is_a_homomorphism_on_names_too() {
        let twin = |text: &str| Unit::parse(text).unwrap().rotary().text;
        assert_eq!(twin("m/s"), "rad/s");
        assert_eq!(twin("um"), "µrad");
        assert_eq!(twin("N"), "N·m");
        assert_eq!(twin("N/m"), "N·m/rad");
        assert_eq!(twin("N·s/m"), "N·m·s/rad");
        assert_eq!(twin("kg"), "kg·m^2");
        assert_eq!(twin("s"), "s");
        let (a, b) = (Unit::parse("N/m").unwrap().dimension, Unit::parse("m").unwrap().dimension);
        assert_eq!(a.times(b).rotary(), a.rotary().times(b.rotary()));
    }

    #[test]
    fn every_known_unit_shows_as_it_reads() {
        for (name, scale, ..) in UNITS {
            let unit = Unit::parse(name).unwrap();
            assert_eq!((unit.scale, unit.text.as_str()), (*scale, *name));
        }
    }
}
