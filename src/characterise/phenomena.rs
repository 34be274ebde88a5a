//! Decides which friction phenomena a model shows.
//!
//! In: the numbers that the tests extracted from the curves. Out: a verdict for each phenomenon with its evidence.
//! Documentation of the model is not used.

use super::battery::Scales;
use super::measured::{Number, Test, plain};
use super::subject::{External, Subject};
use crate::compile::Verdict;

/// A phenomenon and whether the model shows it.
#[derive(Clone, PartialEq, Debug)]
pub struct Finding {
    /// Identifier for programs: `return_point_memory`.
    pub key: &'static str,
    /// Name in the report.
    pub name: &'static str,
    /// The verdict.
    pub seen: Seen,
    /// The evidence, or the reason.
    pub why: String,
}

/// A verdict.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Seen {
    /// It was seen.
    Shown,
    /// It was tested for and not seen.
    NotShown,
    /// It does not apply to this model.
    NotApplicable,
    /// It was not seen, but its experiment could not be run as it is: a fixed step took its place.
    NotRun,
    /// It holds in every run, which is no proof.
    NotProven,
}

impl Seen {
    /// The verdict in words.
    pub fn words(self) -> &'static str {
        match self {
            Seen::Shown => "shown",
            Seen::NotShown => "not shown",
            Seen::NotApplicable => "not applicable",
            Seen::NotRun => "could not be run",
            Seen::NotProven => "not proven",
        }
    }

    /// The verdict in JSON.
    pub fn key(self) -> &'static str {
        match self {
            Seen::Shown => "shown",
            Seen::NotShown => "not-shown",
            Seen::NotApplicable => "not-applicable",
            Seen::NotRun => "not-run",
            Seen::NotProven => "not-proven",
        }
    }
}

/// All findings, in the order of the table. `dissipation`: the verdict of the analysis that `fric check` and `fric
/// explain` report too, none for rotary motion; `stepped`: experiments that could not be run adaptively and were run with a
/// fixed step instead; `chatter`: what turned without end in them.
pub fn findings(
    subject: &Subject,
    scales: &Scales,
    tests: &[Test],
    dissipation: Option<Verdict>,
    stepped: &[String],
    chatter: Option<&str>,
) -> Vec<Finding> {
    let look = Looked { subject, scales, tests, dissipation, stepped, chatter };
    vec![
        look.finding("holds", "holds a load at rest", Looked::holds),
        look.finding("no_drift", "keeps its place when shaken", Looked::no_drift),
        look.finding("stiction_peak", "stiction peak", Looked::stiction_peak),
        look.finding("stribeck", "Stribeck curve", Looked::stribeck),
        look.finding("viscous", "viscous friction", Looked::viscous),
        look.finding("presliding", "presliding displacement", Looked::presliding),
        look.finding("hysteresis", "presliding hysteresis", Looked::hysteresis),
        look.finding("return_point_memory", "return-point memory", Looked::memory),
        look.finding("lag", "frictional lag", Looked::lag),
        look.finding("varying_break_away", "varying break-away", Looked::varying),
        look.finding("stick_slip", "stick-slip on a spring", Looked::stick_slip),
        look.finding("rate_independent", "rate independent", Looked::rate_independent),
        look.finding("dissipative", "dissipative", Looked::dissipative),
        look.finding("symmetric", "symmetric", Looked::symmetric),
    ]
}

struct Looked<'a> {
    subject: &'a Subject,
    scales: &'a Scales,
    tests: &'a [Test],
    dissipation: Option<Verdict>,
    stepped: &'a [String],
    chatter: Option<&'a str>,
}

/// The experiments from which a verdict comes, by the beginning of their names.
fn experiments(key: &str) -> &'static [&'static str] {
    match key {
        "holds" => &["hold"],
        "no_drift" => &["hold", "drift"],
        "stiction_peak" => &["break_away"],
        "presliding" | "hysteresis" | "return_point_memory" => &["hold", "presliding"],
        "lag" => &["lag"],
        "varying_break_away" => &["break_away", "reversal"],
        "stick_slip" => &["stick_slip"],
        "rate_independent" => &["rate"],
        "dissipative" => &["closed_path"],
        "stribeck" | "viscous" | "symmetric" => &["steady"],
        key => unreachable!("no phenomenon {key}"),
    }
}

type Answer = (Seen, String);

const NO_PRESLIDING: &str = "no presliding";

fn when(shown: bool, why: String) -> Answer {
    (if shown { Seen::Shown } else { Seen::NotShown }, why)
}

impl Looked<'_> {
    fn finding(&self, key: &'static str, name: &'static str, look: fn(&Self) -> Answer) -> Finding {
        let (seen, why) = look(self);
        // What a fixed step shows of a model that cannot be run is no evidence against it.
        if seen != Seen::Shown
            && self.is_stepped(experiments(key))
            && !(seen == Seen::NotApplicable && self.is_static())
        {
            let cause = match self.chatter {
                Some(chatter) => format!("{chatter} without end"),
                None => "it takes too many steps".into(),
            };
            let why = why.strip_prefix(NO_PRESLIDING).map_or(format!("; with a fixed step: {why}"), |_| String::new());
            return Finding { key, name, seen: Seen::NotRun, why: format!("{cause}{why}") };
        }
        Finding { key, name, seen, why }
    }

    /// Whether one of these experiments could only be run with a fixed step.
    fn is_stepped(&self, experiments: &[&str]) -> bool {
        let one = |name: &String| {
            let digits = |rest: &str| rest.is_empty() || rest.starts_with('_');
            experiments.iter().any(|begin| name.strip_prefix(begin).is_some_and(digits))
        };
        self.stepped.iter().any(one)
    }

    fn test(&self, key: &str) -> Result<&Test, Answer> {
        let test = self.tests.iter().find(|test| test.key == key).expect("every test has its place");
        match &test.result {
            Ok(_) => Ok(test),
            Err(why) => Err((Seen::NotApplicable, why.lines().next().unwrap_or_default().to_string())),
        }
    }

    fn all<'t>(test: &'t Test, key: &str) -> Vec<&'t Number> {
        test.numbers.iter().filter(|number| number.key == key).collect()
    }

    fn number<'t>(test: &'t Test, key: &str) -> Option<&'t Number> {
        test.numbers.iter().find(|number| number.key == key)
    }

    /// A static map without memory: memory phenomena do not apply to it.
    fn is_static(&self) -> bool {
        self.subject.states == 0 && self.subject.regimes.is_empty()
    }

    fn holds(&self) -> Answer {
        let test = match self.test("hold") {
            Ok(test) => test,
            Err(answer) => return answer,
        };
        if self.is_stepped(&["hold"]) && self.subject.external == External::Absent {
            return (Seen::NotShown, "the force jumps to and fro at rest".into());
        }
        let (moved, creep) = (Self::number(test, "held_peak_to_peak"), Self::number(test, "creep_speed"));
        let (Some(moved), Some(creep)) = (moved, creep) else { return (Seen::NotApplicable, "not measured".into()) };
        let needs = if self.subject.external == External::Absent && self.is_static() {
            "; to hold it would need F_ext"
        } else {
            ""
        };
        match moved.value < 1e-9 {
            true => when(true, format!("moves {} in 90 s", moved.shown())),
            false => when(false, format!("creeps at {}{needs}", creep.shown())),
        }
    }

    fn no_drift(&self) -> Answer {
        let (holds, why) = self.holds();
        if holds != Seen::Shown {
            return (
                Seen::NotApplicable,
                format!("does not hold a load: {}", why.split(':').next().unwrap_or_default()),
            );
        }
        let test = match self.test("drift") {
            Ok(test) => test,
            Err(answer) => return answer,
        };
        let (Some(drift), Some(swing)) = (Self::number(test, "drift"), Self::number(test, "swing")) else {
            return (Seen::NotApplicable, "not measured".into());
        };
        // A trend is more than the tolerance of the run leaves of a cycle.
        let trend = drift.value.abs() >= 1e-9_f64.max(1e-5 * swing.value.abs());
        when(!trend, format!("drifts {} in a cycle of {}", drift.shown(), swing.shown()))
    }

    fn stiction_peak(&self) -> Answer {
        let test = match self.test("break_away") {
            Ok(test) => test,
            Err(answer) => return answer,
        };
        let highest = Self::all(test, "break_away_force").into_iter().max_by(|a, b| a.value.total_cmp(&b.value));
        let Some(highest) = highest else { return (Seen::NotApplicable, "never let go".into()) };
        if self.scales.f_c < 1e-6 * self.scales.f_ref {
            return (Seen::NotApplicable, "no dry friction: the force goes to zero with the speed".into());
        }
        let sliding = Number { value: self.scales.f_c, ..highest.clone() };
        let why = format!("lets go at up to {}, slides with {}", highest.shown(), sliding.shown());
        // The viscous part at the sliding speed does not count as stiction.
        let viscous =
            self.test("steady").ok().and_then(|test| Self::number(test, "viscous_slope")).map_or(0.0, |n| n.value);
        when(highest.value > 1.02 * self.scales.f_c + viscous.abs() * self.scales.v_slip && self.scales.f_c > 0.0, why)
    }

    fn stribeck(&self) -> Answer {
        let test = match self.test("steady") {
            Ok(test) => test,
            Err(answer) => return answer,
        };
        let (peak, low) = (Self::number(test, "steady_peak"), Self::number(test, "sliding_force"));
        let (Some(peak), Some(low), Some(points)) = (peak, low, Self::number(test, "stribeck_points")) else {
            return (Seen::NotApplicable, "not measured".into());
        };
        match (Self::number(test, "stribeck_speed"), peak.value > 1.01 * low.value) {
            (Some(speed), true) => {
                when(true, format!("falls from {} to {}, 1/e at {}", peak.shown(), low.shown(), speed.shown()))
            }
            (None, true) if points.value >= 3.0 => {
                when(false, format!("falls from {} to {}, within its own noise", peak.shown(), low.shown()))
            }
            (None, true) if points.value > 0.0 => {
                when(false, format!("jumps from {} to {}", peak.shown(), low.shown()))
            }
            (Some(_) | None, _) => when(false, "the force of steady sliding never falls with speed".into()),
        }
    }

    fn viscous(&self) -> Answer {
        let test = match self.test("steady") {
            Ok(test) => test,
            Err(answer) => return answer,
        };
        let Some(slope) = Self::number(test, "viscous_slope") else {
            return (Seen::NotApplicable, "not measured".into());
        };
        let part = slope.value * self.scales.v_max / self.scales.f_ref;
        when(part > 1e-3, format!("slope {}", slope.shown()))
    }

    fn presliding(&self) -> Answer {
        if self.is_stepped(&["hold", "presliding"]) {
            return (Seen::NotShown, "at rest the force jumps to and fro".into());
        }
        let test = match self.test("presliding") {
            Ok(test) => test,
            Err(answer) => return answer,
        };
        if self.holds().0 != Seen::Shown {
            return (Seen::NotShown, "what moves below break-away is creep: it does not come to rest".into());
        }
        let Some(travel) = Self::number(test, "presliding_travel") else {
            return (Seen::NotApplicable, "not measured".into());
        };
        let why = match Self::number(test, "stiffness") {
            Some(stiffness) if travel.value > 1e-9 => {
                format!("moves {} within ±30 %, {}", travel.shown(), stiffness.shown())
            }
            Some(_) | None => format!("moves {} within ±30 %", travel.shown()),
        };
        when(travel.value > 1e-8, why)
    }

    fn hysteresis(&self) -> Answer {
        if self.presliding().0 != Seen::Shown {
            return (Seen::NotApplicable, NO_PRESLIDING.into());
        }
        let area = self.test("presliding").ok().and_then(|test| Self::number(test, "loop_area"));
        let Some(area) = area else { return (Seen::NotApplicable, "not measured".into()) };
        let gap = self.test("presliding").ok().and_then(|test| Self::number(test, "loop_gap"));
        let open = match gap.filter(|gap| gap.value > 0.01) {
            Some(gap) => format!(", and moves on by {} of its travel", gap.shown()),
            None => String::new(),
        };
        when(area.value > 0.005, format!("the loop fills {} of its box{open}", area.shown()))
    }

    fn memory(&self) -> Answer {
        let (hysteresis, why) = self.hysteresis();
        match hysteresis {
            Seen::Shown => {}
            Seen::NotShown => return (Seen::NotApplicable, format!("elastic, so every loop closes: {why}")),
            Seen::NotApplicable | Seen::NotRun | Seen::NotProven => return (Seen::NotApplicable, why),
        }
        let error = self.test("presliding").ok().and_then(|test| Self::number(test, "memory_error"));
        let Some(error) = error else { return (Seen::NotApplicable, "not measured".into()) };
        when(error.value < 0.01, format!("the inner loop misses its start by {} of its width", error.shown()))
    }

    fn lag(&self) -> Answer {
        let test = match self.test("lag") {
            Ok(test) => test,
            Err(answer) => return answer,
        };
        let widest = Self::all(test, "lag").into_iter().max_by(|a, b| a.value.abs().total_cmp(&b.value.abs()));
        let Some(widest) = widest else { return (Seen::NotApplicable, "not measured".into()) };
        let size = self.scales.f_c.max(self.scales.f_b);
        let wide = Number { value: widest.value.abs(), ..widest.clone() }.shown();
        match widest.value > 0.005 * size {
            true => when(true, format!("loop up to {wide} wide")),
            false if widest.value < -0.005 * size => {
                when(false, format!("F is higher while the speed falls, by up to {wide}"))
            }
            false => when(false, format!("F at rising and at falling speed differ by {wide} at most")),
        }
    }

    fn varying(&self) -> Answer {
        let test = match self.test("break_away") {
            Ok(test) => test,
            Err(answer) => return answer,
        };
        let forces = Self::all(test, "break_away_force");
        let Some(change) = Self::number(test, "break_away_change") else {
            return (Seen::NotApplicable, "not measured".into());
        };
        let (Some(slow), Some(fast)) = (forces.first(), forces.last()) else {
            return (Seen::NotApplicable, "never let go".into());
        };
        let overshoot = |key| {
            let test = self.test("reversal").ok()?;
            Some(Self::number(test, key)?.value)
        };
        let viscous =
            self.test("steady").ok().and_then(|test| Self::number(test, "viscous_slope")).map_or(0.0, |n| n.value);
        if change.value > 0.02 + viscous.abs() * self.scales.v_slip / slow.value && !self.is_stepped(&["break_away"]) {
            return when(
                true,
                format!("with the rate: {} {}, {} {}", slow.shown(), slow.name, fast.shown(), fast.name),
            );
        }
        if let (Some(first), Some(second)) = (overshoot("virgin_overshoot"), overshoot("reversal_overshoot"))
            && second > 0.02 * self.scales.f_b
            && second > 1.05 * first
        {
            let ratio = plain((100.0 * second / first.max(1e-300)).round() / 100.0);
            return when(
                true,
                format!("with the history: the overshoot after a reversal is {ratio} times that from rest"),
            );
        }
        when(false, format!("{} at every rate, within {}", slow.shown(), change.shown()))
    }

    fn stick_slip(&self) -> Answer {
        let test = match self.test("stick_slip") {
            Ok(test) => test,
            Err(answer) => return answer,
        };
        match (Self::number(test, "stick_slip_up_to"), Self::number(test, "stick_slip_gone")) {
            (Some(up_to), Some(gone)) => {
                when(true, format!("up to {}, smooth from {} on", up_to.shown(), gone.shown()))
            }
            (Some(up_to), None) => when(true, format!("up to {}, the fastest pull", up_to.shown())),
            (None, _) => {
                let ends = [Self::number(test, "slowest_pull"), Self::number(test, "fastest_pull")];
                let [slowest, fastest] = ends.map(|end| end.map_or("?".into(), Number::shown));
                when(false, format!("slides without sticking at every pull speed from {slowest} to {fastest}"))
            }
        }
    }

    fn rate_independent(&self) -> Answer {
        if self.is_static() || !self.subject.regimes.is_empty() && self.presliding().0 != Seen::Shown {
            return (Seen::NotApplicable, "no memory of the path".into());
        }
        let test = match self.test("rate") {
            Ok(test) => test,
            Err(answer) => return answer,
        };
        let Some(part) = Self::number(test, "rate_difference_part") else {
            return (Seen::NotApplicable, "not measured".into());
        };
        when(part.value < 2e-3, format!("differs by {} from 0.1 to 10 times the speed", part.shown()))
    }

    fn dissipative(&self) -> Answer {
        let test = match self.test("dissipation") {
            Ok(test) => test,
            Err(answer) => return answer,
        };
        let Some(least) = Self::number(test, "least_work") else { return (Seen::NotApplicable, "not measured".into()) };
        let told = match &self.dissipation {
            Some(verdict) => verdict.words(),
            None => "not proven: the analysis is for straight motion".into(),
        };
        if let Some(Verdict::Fails(_)) = self.dissipation {
            return when(false, told);
        }
        // Smaller values are rounding errors of the sum over the steps of a run.
        let greatest = Self::number(test, "greatest_work").map_or(0.0, |number| number.value);
        if least.value < -1e-9 * greatest {
            return when(false, format!("gives out {} on a closed path", least.shown()));
        }
        let seen = match self.dissipation {
            Some(Verdict::Proved) => Seen::Shown,
            _ => Seen::NotProven,
        };
        (seen, format!("{told}; least work of six closed paths {}", least.shown()))
    }

    fn symmetric(&self) -> Answer {
        let test = match self.test("steady") {
            Ok(test) => test,
            Err(answer) => return answer,
        };
        let Some(asymmetry) = Self::number(test, "asymmetry") else {
            return (Seen::NotApplicable, "not measured".into());
        };
        match asymmetry.value == 0.0 {
            true => when(true, "both directions agree to the last bit".into()),
            false => {
                when(asymmetry.value < 1e-9 * self.scales.f_ref, format!("directions differ by {}", asymmetry.shown()))
            }
        }
    }
}
