//! Factors 2π that are lost, over random models: a value of which is known what it counts goes through sums, choices,
//! functions, parts and conversions, and W0107 is reported exactly where it meets something that counts otherwise.
//! `FRIC_SEED`, `FRIC_RUNS` (default 400).

mod support;

use compiler::ir::random::Random;
use support::{Texts, checked, line, number};

#[derive(Clone, Copy, PartialEq, Debug)]
enum Counts {
    Turns,
    Angle,
    Rate,
    Speed,
}

use Counts::{Angle, Rate, Speed, Turns};

/// A model under construction.
struct Text<'r> {
    random: &'r mut Random,
    lines: Vec<String>,
}

impl Text<'_> {
    fn of(&mut self, all: &[&str]) -> String {
        all[self.random.below(all.len())].to_string()
    }

    /// A quantity that counts this, as it is declared.
    fn source(&mut self, counts: Counts) -> String {
        match counts {
            Rate => self.of(&["f", "f2", "5 Hz", "2 kHz", "max(f, 1 Hz)"]),
            Speed => self.of(&["w", "n", "n2", "3 rad/s", "300 rpm", "rot.w"]),
            Angle => self.of(&["phi", "30 deg", "asin(0.5)", "1.5 rad", "rot.w * t"]),
            Turns => {
                let rate = self.expression(Rate, 0);
                format!("{rate} * t")
            }
        }
    }

    /// A `let` with this value: other multiples of π than 2π are not judged, so products do not nest.
    fn named(&mut self, value: &str) -> String {
        let name = format!("l{}", self.lines.len());
        self.lines.push(format!("let {name} = {value}"));
        name
    }

    fn converted(&mut self, from: Counts, depth: u32) -> String {
        let value = self.expression(from, depth - 1);
        self.named(&value)
    }

    /// An expression that counts this, by a random way.
    fn expression(&mut self, counts: Counts, depth: u32) -> String {
        if depth == 0 {
            return self.source(counts);
        }
        let a = self.expression(counts, depth - 1);
        match self.random.below(12) {
            0 => format!("(-({a}))"),
            1 => format!("abs({a})"),
            2 => format!("({a} + {})", self.source(counts)),
            3 => format!("min({a}, {})", self.source(counts)),
            4 => format!("(if x > 1 m then {a} else {})", self.source(counts)),
            5 => format!("(2 * {})", self.named(&a)),
            6 => format!("{} / 3", self.named(&a)),
            7 => self.named(&a),
            8 if counts == Speed => format!("(2 * pi * {})", self.converted(Rate, depth)),
            8 if counts == Rate => format!("{} / (2 * pi)", self.converted(Speed, depth)),
            8 if counts == Angle => format!("({} * 2 * pi)", self.converted(Turns, depth)),
            9 if counts == Angle => format!("{} * t", self.converted(Speed, depth)),
            9 if matches!(counts, Rate | Speed) => {
                let (name, model) =
                    (format!("p{}", self.lines.len()), if counts == Rate { "OfRate" } else { "OfSpeed" });
                self.lines.push(format!("part {name} = {model}(x = {a})"));
                format!("{name}.y")
            }
            10 if counts == Rate => format!("of_rate({a})"),
            10 if counts == Speed => format!("of_speed({a})"),
            _ => format!("clamp({a}, {}, {})", self.source(counts), self.source(counts)),
        }
    }
}

const AROUND: &str = "fn of_rate(r [Hz]) [Hz] = 2 * r
fn of_speed(r [rad/s]) [rad/s] = r
model OfRate { input x [Hz]  output y [Hz] = x }
model OfSpeed { input x [rad/s]  output y [rpm] = x }
model Rotor { state angle [rad] = 0  dangle/dt = 1 rad/s  output w = dangle/dt }
";

/// Mutants tried by hand: `2 * pi` makes no speed of a rate, and a `let` counts nothing (case 3 of seed 1); arguments of
/// functions are not read (case 95); `sin` takes what it gets (case 1).
#[test]
fn a_lost_factor_is_reported_and_nothing_else() {
    let (seed, runs) = (number("FRIC_SEED").unwrap_or(1), number("FRIC_RUNS").unwrap_or(400));
    let mut random = Random(seed);
    let mut told = [0, 0];
    for number in 0..runs {
        let is_rate = random.below(3) > 0;
        let pair = if is_rate { [Rate, Speed] } else { [Turns, Angle] };
        let (has, wants) = (pair[random.below(2)], pair[random.below(2)]);
        let depth = random.below(4) as u32;
        let mut text = Text { random: &mut random, lines: Vec::new() };
        let value = text.expression(has, depth);
        let sink = match (wants, text.random.below(4)) {
            (Turns | Angle, _) => None,
            (Rate, 0) => Some(format!("output o [m] = sine(1 mm, {value})")),
            (Rate, 1) => Some(format!("output o [Hz] = {value}")),
            (Rate, 2) => Some(format!("part last = OfRate(x = {value})  output o [Hz] = last.y")),
            (Rate, _) => Some(format!("output o = if {value} > f then 1 else 0")),
            (Speed, 0) => Some(format!("output o [rpm] = {value}")),
            (Speed, 1) => Some(format!("output o [rad/s] = of_speed({value})")),
            (Speed, 2) => Some(format!("state o [deg] = 0  do/dt = {value}")),
            (Speed, _) => Some(format!("output o [rad/s] = w - ({value})")),
        };
        // An angle fits everywhere where a number of revolutions does not.
        let (sink, wants) = sink.map_or((format!("output o = sin({value})"), Angle), |sink| (sink, wants));
        let lines = text.lines.join("\n  ");
        let all = format!(
            "{AROUND}model M {{
  input f [Hz]
  param f2 = 7 Hz
  input w [rad/s]
  input n [rpm]
  param n2 = 100 rpm
  input phi [deg]
  input x [m]
  part rot = Rotor()
  {lines}
  {sink}
  allow unused \"any of them\"
}}
"
        );
        let place = format!("seed {seed}, case {number}: {has:?} where {wants:?} is wanted\n{all}");
        let (loaded, found) = checked("a.fric", &all, &Texts::default());
        let found: Vec<String> = found.iter().map(|diagnostic| line(&loaded, diagnostic)).collect();
        let expected = usize::from(has != wants);
        assert_eq!(found.len(), expected, "{place}{found:#?}");
        assert!(found.iter().all(|one| one.contains("W0107")), "{place}{found:#?}");
        told[expected] += 1;
    }
    assert!(runs < 100 || told.iter().all(|count| *count > runs / 5), "{told:?}");
}
