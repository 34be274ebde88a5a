//! The battery as text: experiments with the benches of the library and the model under test.
//!
//! In: a [`Subject`] and the [`Scales`] measured so far. Out: a text. Numbers in it are in SI with at most four digits,
//! so that users can read and change it.

use super::subject::{External, Subject};
use crate::quantity::significant;
use std::fmt::Write;

/// Scales that are measured before the battery is generated. SI; translational or rotary.
#[derive(Clone, PartialEq, Debug)]
pub struct Scales {
    /// Force at a fast steady speed.
    pub f_ref: f64,
    /// Mass on the benches that have one: a power of ten for which these forces cause about 1 m/s².
    pub mass: f64,
    /// Break-away force under a slow ramp.
    pub f_b: f64,
    /// Displacement at the greatest force before it slides: the size of motions. A contact without a peak still gains
    /// force while its mass accelerates.
    pub x_b: f64,
    /// Displacement at which the force first reaches 99 % of `f_b`: the travel at break-away.
    pub travel: f64,
    /// Least sliding friction after the peak.
    pub f_c: f64,
    /// Speed at which the excess over `f_c` has decayed to 1/e; else a hundredth of the greatest speed.
    pub v_s: f64,
    /// Force per displacement at a tenth of `f_b`; infinite for a contact that does not move before it slides.
    pub stiffness: f64,
    /// Speed that counts as sliding.
    pub v_slip: f64,
    /// Greatest speed of the grid.
    pub v_max: f64,
}

/// The scales of one bench for several members of a family: the middle between the least and the greatest in ratio.
pub fn family(members: &[&Scales]) -> Option<Scales> {
    let first = members.first()?;
    let middle = |of: fn(&Scales) -> f64| {
        let ends = members.iter().map(|member| of(member));
        let (low, high) = ends.fold((f64::INFINITY, 0.0_f64), |(low, high), x| (low.min(x), high.max(x)));
        // Members of one value keep its bits.
        if low == high { low } else { root(low * high) }
    };
    let f_ref = middle(|scales| scales.f_ref);
    Some(Scales {
        f_ref,
        mass: power_near(f_ref),
        f_b: middle(|scales| scales.f_b),
        x_b: middle(|scales| scales.x_b),
        travel: middle(|scales| scales.travel),
        f_c: middle(|scales| scales.f_c),
        v_s: middle(|scales| scales.v_s),
        stiffness: members.iter().map(|member| member.stiffness).fold(f64::INFINITY, f64::min),
        v_slip: 0.0,
        v_max: first.v_max,
    })
}

/// The speed from which each of these contacts slides, on one bench. Sliding is ten times the Stribeck speed: 10 mm/s
/// for the textbook's 1 mm/s. A mass that oscillates on a contact which still holds does not slide: under a ramp of rate
/// r it oscillates with up to 2 r/k.
pub fn sliding_speed(members: &[&Scales], bench: &Layout) -> f64 {
    let fastest = bench.rates().into_iter().fold(0.0, f64::max);
    let one = |scales: &&Scales| (10.0 * scales.v_s).max(4.0 * fastest / scales.stiffness);
    round(members.iter().map(one).fold(0.0, f64::max))
}

/// The path of a slow force on the presliding bench: to its amplitude and to and fro, so that the last loop is closed,
/// and for a large one an inner loop after it.
pub struct Presliding {
    /// Amplitude of the force.
    pub amplitude: f64,
    /// Its rate.
    pub rate: f64,
    stops: Vec<f64>,
}

impl Presliding {
    /// Begin and end of the closed loop, s: from the amplitude to its negative and back, after one such loop and a half.
    pub fn loop_times(&self) -> (f64, f64) {
        (self.time(5.0), self.time(9.0))
    }

    /// The inner loop, s: at half of the amplitude on the way up, at its turn at no force, and back.
    pub fn inner_times(&self) -> [f64; 3] {
        [12.5, 13.0, 13.5].map(|path| self.time(path))
    }

    /// The time at which the force has travelled a path, in amplitudes.
    fn time(&self, path: f64) -> f64 {
        path * self.amplitude / self.rate
    }
}

/// Names of units.
#[derive(Clone, Copy, Debug)]
#[allow(missing_docs)]
pub struct Units {
    pub force: &'static str,
    pub length: &'static str,
    pub speed: &'static str,
    pub mass: &'static str,
    pub stiffness: &'static str,
    pub damping: &'static str,
    pub rate: &'static str,
    bench: &'static str,
}

const STRAIGHT: Units = Units {
    force: "N",
    length: "m",
    speed: "m/s",
    mass: "kg",
    stiffness: "N/m",
    damping: "N·s/m",
    rate: "N/s",
    bench: "",
};
const ROTARY: Units = Units {
    force: "N·m",
    length: "rad",
    speed: "rad/s",
    mass: "kg·m^2",
    stiffness: "N·m/rad",
    damping: "N·m·s/rad",
    rate: "N·m/s",
    bench: "rotary ",
};

impl Units {
    /// Those of translational or rotary motion.
    pub fn of(rotary: bool) -> Units {
        if rotary { ROTARY } else { STRAIGHT }
    }
}

/// Path in break-away travels after which a contact has forgotten its start: e^−30 is 1e-13.
const FORGOTTEN: f64 = 30.0;

/// The experiment on drift: when its oscillation has become periodic, and its end, s.
pub const DRIFT: (f64, f64) = (12.0, 32.0);

/// One experiment of the battery.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Name of the experiment.
    pub name: String,
    doc: String,
    run: String,
    /// In s.
    duration: f64,
    solver: Option<String>,
    sweep: Option<String>,
    plots: Vec<String>,
    expects: Vec<String>,
    /// Greatest fixed step in s for a model that chatters, and the intended number of steps.
    longest: f64,
    fine: f64,
}

impl Entry {
    fn new(name: impl Into<String>, doc: impl Into<String>, run: String, duration: f64) -> Entry {
        Entry {
            name: name.into(),
            doc: doc.into(),
            run,
            duration,
            solver: None,
            sweep: None,
            plots: Vec::new(),
            expects: Vec::new(),
            longest: 1e-3,
            fine: 1e5,
        }
    }

    /// Moved at constant speed: the step affects only how far the contact moves within it.
    fn steady(self) -> Entry {
        Entry { longest: f64::INFINITY, fine: 2.5e4, ..self }
    }

    /// With the most steps possible, if it must run with fixed ones: a reference for others.
    fn finest(self) -> Entry {
        Entry { fine: 3e5, ..self }
    }

    fn plot(mut self, plot: impl Into<String>) -> Entry {
        self.plots.push(plot.into());
        self
    }

    fn expect(mut self, expect: String) -> Entry {
        self.expects.push(expect);
        self
    }

    fn solver(mut self, solver: impl Into<String>) -> Entry {
        self.solver = Some(solver.into());
        self
    }

    /// Switches to a fixed step, because an adaptive run finds an endless sequence of events in it. At most 300,000
    /// steps, unless the model itself samples faster; `period` in s is its sampling period, and becomes a whole number
    /// of steps.
    pub fn step_fixed(&mut self, period: Option<f64>) {
        const STEPS: [f64; 15] =
            [0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5, 1e-5];
        let wanted = (self.duration / self.fine).clamp(1e-5, self.longest.max(self.duration / 3e5));
        let step = match period {
            Some(period) => {
                let parts = [1.0, 2.0, 4.0, 5.0, 10.0, 20.0, 50.0, 100.0].map(|parts| period / parts);
                parts.into_iter().find(|step| *step <= wanted * 1.000001).unwrap_or(period / 100.0)
            }
            None => STEPS.into_iter().find(|step| *step <= wanted * 1.000001).unwrap_or(1e-5),
        };
        self.solver = Some(format!("expo step {} s", n(step)));
        // A whole number of steps.
        self.duration = (self.duration / step).ceil() * step;
    }

    /// The length of its steps in s, if fixed.
    pub fn step(&self) -> Option<f64> {
        let text = self.solver.as_ref()?.strip_prefix("expo step ")?;
        text.strip_suffix(" s")?.parse().ok()
    }

    /// Whether the solver is adaptive.
    pub fn adaptive(&self) -> bool {
        self.solver.as_ref().is_none_or(|solver| solver.starts_with("adaptive"))
    }

    fn text(&self) -> String {
        let mut text = format!(
            "/// {}\nexperiment {} {{\n  run    {} for {} s\n",
            self.doc,
            self.name,
            self.run,
            n(self.duration)
        );
        if let Some(solver) = &self.solver {
            let _ = writeln!(text, "  solver {solver}");
        }
        if let Some(sweep) = &self.sweep {
            let _ = writeln!(text, "  sweep  {sweep}");
        }
        for plot in &self.plots {
            let _ = writeln!(text, "  plot   {plot}");
        }
        for expect in &self.expects {
            let _ = writeln!(text, "  expect {expect}");
        }
        text + "}\n"
    }
}

/// The whole text.
pub fn text(imports: &str, head: &str, entries: &[Entry]) -> String {
    let entries: Vec<String> = entries.iter().map(Entry::text).collect();
    format!("{imports}\n{head}\n{}", entries.join("\n"))
}

/// Formats with four digits, enough for a number that only sizes an experiment.
pub fn n(x: f64) -> String {
    significant(x, 6)
}

/// Rounds to two digits.
pub fn round(x: f64) -> f64 {
    significant(x, 2).parse().expect("a printed number reads back")
}

/// Generates the experiments for a model under test.
pub struct Layout<'a> {
    subject: &'a Subject,
    /// Units of the model.
    pub units: Units,
    /// Those of the model.
    scales: Scales,
    /// Those for which its benches are laid out: the same, unless several models share them.
    bench: Scales,
}

impl<'a> Layout<'a> {
    /// A generator with the scales known so far.
    pub fn new(subject: &'a Subject, scales: Scales) -> Layout<'a> {
        Layout { subject, units: Units::of(subject.rotary), bench: scales.clone(), scales }
    }

    /// The same on a bench with other scales.
    pub fn on(self, bench: Scales) -> Layout<'a> {
        Layout { bench, ..self }
    }

    /// The scales for which the benches are laid out.
    pub fn bench(&self) -> &Scales {
        &self.bench
    }

    /// The force on the presliding bench, to a part of the break-away force.
    pub fn presliding(&self, part: f64) -> Presliding {
        let a = round_down(part * self.scales.f_b);
        let mut stops = vec![0.0, a, -a, a, -a, a];
        if part > 0.5 {
            stops.extend([-a, 0.5 * a, 0.0, a]);
        }
        Presliding { amplitude: a, rate: round(0.2 * self.scales.f_b), stops }
    }

    /// Cycles of the test of losses at this amplitude; the last is measured.
    pub fn cycles(&self, amplitude: f64) -> f64 {
        self.rounds(4.0 * amplitude) + 1.0
    }

    /// Rounds of an oscillation with a path of this length a round, until the contact has forgotten its start: its
    /// transient along the path has decayed as in [`Layout::steady`].
    fn rounds(&self, path: f64) -> f64 {
        (FORGOTTEN * self.scales.x_b / path).ceil().clamp(2.0, 200.0)
    }

    /// The model's own regimes.
    pub fn own_regimes(&self) -> &[String] {
        &self.subject.own_regimes
    }

    /// The argument for a bench that prescribes the speed and has no force of its own. A speed drive pushes as hard as
    /// needed, so a contact with an input for the external force receives more than it can hold.
    fn moved(&self, v: &str) -> String {
        let push = format!("{} {} * sign({v})", n(100.0 * power_near(self.scales.f_ref)), self.units.force);
        match self.subject.external {
            External::Required | External::Optional => self.subject.instance.with(&[("F_ext", &push)]),
            External::Absent => self.subject.instance.to_string(),
        }
    }

    /// The argument for a bench with a mass.
    fn pushed(&self) -> String {
        self.subject.instance.to_string()
    }

    fn force_bench(&self, u: &str, more: &str) -> String {
        let Units { bench, mass, .. } = self.units;
        format!("{bench}ForceBench(u = {u}, m = {} {mass}{more}, fr = {})", n(self.bench.mass), self.pushed())
    }

    fn speed_bench(&self, v: &str) -> String {
        format!("{}SpeedBench(v = {v}, fr = {})", self.units.bench, self.moved(v))
    }

    /// Models that the experiments share.
    pub fn head(&self) -> String {
        let Units { speed, force, damping, length, .. } = self.units;
        let mut text = format!(
            "/// The contact at one speed, as a parameter: a sweep over it is one program.\n\
             model Sliding {{\n  param  speed = 0 {speed}\n  part   bench = {}\n  output F [{force}] = bench.F\n\
             \x20 output x [{length}] = bench.x\n}}\n",
            self.speed_bench("speed")
        );
        if self.scales.f_b > 0.0 {
            let d = round(0.01 * self.bench.f_b / self.bench.v_s);
            let _ = write!(
                text,
                "\n/// From 0 to 1 within a time, along half a cosine.\n\
                 fn eased(now [s], begin [s], length [s]) = (1 - cos(pi * clamp((now - begin) / length, 0, 1))) / 2\n\n\
                 /// A mass with a little damping from outside, so that what is seen is the contact\n\
                 /// and not the ringing of a mass on a spring without loss.\n\
                 model Damped {{\n  input  u [{force}]\n  param  d = {} {damping}\n  part   bench = {}\n\
                 \x20 output F [{force}] = bench.F\n  output x [{length}] = bench.x\n  output v [{speed}] = bench.v\n}}\n",
                n(d),
                self.force_bench("u - d * bench.v", "")
            );
        }
        text
    }

    fn show_force(&self) -> String {
        format!("F [{}]", self.units.force)
    }

    /// Measures the friction at a fast speed, to scale applied forces.
    pub fn scale_sliding(&self) -> Entry {
        let run = format!("Sliding(speed = {} {})", n(0.1 * self.scales.v_max), self.units.speed);
        Entry::new("scale_sliding", "The size of the force, from sliding fast.", run, 20.0)
            .plot(self.show_force())
            .steady()
    }

    /// Measures force and displacement at break-away, for a ramp of `f_ref` per second.
    pub fn scale_break_away(&self, times: f64) -> Entry {
        let Units { force, rate, length, speed, .. } = self.units;
        let rate_ref = round(self.scales.f_ref * times);
        let u = format!("ramp(0 s, 0 {force}, {} {rate})", n(rate_ref));
        Entry::new(
            "scale_break_away",
            "Break-away force and presliding travel, from a slow ramp.",
            self.force_bench(&u, ""),
            6.0,
        )
        .plot(format!("F [{force}]"))
        .plot(format!("x [{length}]"))
        .plot(format!("v [{speed}]"))
    }

    /// Steady friction against velocity: a sweep for each decade, in both directions.
    pub fn steady(&self) -> Vec<Entry> {
        const GRID: [f64; 8] = [1.0, 1.3, 1.8, 2.4, 3.2, 4.2, 5.6, 7.5];
        let Units { speed, .. } = self.units;
        let decade = |k: i32| {
            let low = self.scales.v_max * power(-k);
            let grid = if k == 0 { &GRID[..1] } else { &GRID[..] };
            let speeds = grid.iter().flat_map(|g| [g * low, -g * low]).map(|v| format!("{} {speed}", n(v)));
            let speeds: Vec<String> = speeds.collect();
            let travel = (FORGOTTEN * self.scales.x_b).max(1e-3 * self.scales.v_max);
            let mut entry = Entry::new(
                format!("steady_{}", 7 - k),
                format!("Steady friction from {} {speed} on, both directions.", n(low)),
                "Sliding()".into(),
                round(travel / low + 5.0),
            );
            entry.sweep = Some(format!("speed = {}", speeds.join(", ")));
            entry.plot(self.show_force()).steady()
        };
        (0..=6).rev().map(decade).collect()
    }

    /// Rates of the break-away ramps: three decades.
    pub fn rates(&self) -> Vec<f64> {
        let unit = power_near(self.bench.f_ref);
        [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0].map(|rate| rate * unit).to_vec()
    }

    /// Frequencies of the lag loops in Hz.
    pub fn lag_frequencies(&self) -> [f64; 3] {
        let middle = if self.bench.x_b > 1e-4 * self.bench.v_s { self.bench.v_s / self.bench.x_b / 60.0 } else { 1.0 };
        let middle = power_near(middle.clamp(0.1, 10.0));
        [0.1 * middle, middle, 10.0 * middle]
    }

    /// Speeds of the far end of the spring.
    pub fn pull_speeds(&self) -> Vec<f64> {
        let unit = power_near(self.bench.f_b / self.bench.mass * 0.07);
        [0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0].map(|speed| speed * 10.0 * unit).to_vec()
    }

    /// Amplitudes of the cycles whose loss is measured.
    pub fn amplitudes(&self) -> Vec<f64> {
        let unit = self.path();
        [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0].map(|x| x * unit).to_vec()
    }

    /// A path that shows whether friction depends on the path's history.
    pub fn path(&self) -> f64 {
        round(self.bench.x_b.max(1e-3 * self.bench.v_s))
    }

    /// The steps of the step-size sweep in s.
    pub fn steps(&self) -> [f64; 6] {
        [1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4]
    }

    /// Speed of the cycles on a path.
    pub fn cycle_speed(&self) -> f64 {
        round(0.1 * self.bench.v_s)
    }

    /// Everything after the scales and the steady curve.
    pub fn rest(&self) -> Vec<Entry> {
        let mut entries = Vec::new();
        let Units { force, length, speed, rate, stiffness, mass, .. } = self.units;
        let (s, bench) = (&self.scales, &self.bench);
        let (f_b, m) = (s.f_b, bench.mass);
        let motion = |entry: Entry| {
            entry.plot(format!("F [{force}]")).plot(format!("x [{length}]")).plot(format!("v [{speed}]"))
        };

        // For a model with regimes, plots over time are shaded by regime.
        let shaded = |entry: Entry, slot: &str| {
            let regimes = self.subject.own_regimes.iter();
            regimes.fold(entry, |entry, regime| entry.plot(format!("{slot}.{regime}")))
        };

        for (i, r) in self.rates().into_iter().enumerate() {
            let u = format!("ramp(0 s, 0 {force}, {} {rate})", n(r));
            let duration = round(1.3 * f_b / r + 2.0 * root(2.0 * m * s.v_slip / r));
            entries.push(motion(Entry::new(
                format!("break_away_{}", i + 1),
                format!("Pushed by a force that rises at {} {rate}.", n(r)),
                self.force_bench(&u, ""),
                duration,
            )));
        }

        for (name, part) in [("small", 0.3), ("large", 0.95)] {
            let path = self.presliding(part);
            let (u, duration) = eased(&path.stops, path.rate, force);
            let (from, to) = path.loop_times();
            entries.push(
                motion(Entry::new(
                    format!("presliding_{name}"),
                    format!("To {} % of the break-away force and back, slowly.", n(part * 100.0)),
                    format!("Damped(u = {u})"),
                    duration,
                ))
                .solver("adaptive tol 1e-8")
                .expect(format!("integral(F * v) >= 0 J after {} s before {} s", n(from), n(to))),
            );
        }

        for (i, f) in self.lag_frequencies().into_iter().enumerate() {
            let v_s = bench.v_s;
            let v = format!("{} {speed} + sine({} {speed}, {} Hz)", n(1.5 * v_s), n(v_s), n(f));
            let run_in = 200.0 * s.x_b / (1.5 * v_s);
            let cycles = (run_in * f).ceil() + 2.0;
            entries.push(
                Entry::new(
                    format!("lag_{}", i + 1),
                    format!("A speed that rises and falls at {} Hz and keeps its sign.", n(f)),
                    self.speed_bench(&v),
                    cycles / f,
                )
                .plot(format!("F [{force}]"))
                .plot(format!("v [{speed}]")),
            );
        }

        let v = self.cycle_speed();
        let run = (60.0 * s.x_b).max(20.0 * self.path());
        let turn = round(run / v);
        entries.push(
            Entry::new(
                "reversal",
                "From rest at a slow speed, and then back.",
                self.speed_bench(&format!("{} {speed} - step({} s, {} {speed})", n(v), n(turn), n(2.0 * v))),
                2.0 * turn,
            )
            .plot(format!("F [{force}]"))
            .plot(format!("x [{length}]")),
        );

        let path = 3.0 * self.path();
        for (i, times) in [0.1, 1.0, 10.0].into_iter().enumerate() {
            let v = v * times;
            let f = v / (2.0 * std::f64::consts::PI * path);
            let f = round(f);
            entries.push(
                Entry::new(
                    format!("rate_{}", i + 1),
                    format!("The same path at {} times the speed.", n(times)),
                    self.speed_bench(&format!("sine({} {speed}, {} Hz)", n(v), n(f))),
                    2.0 / f,
                )
                .plot(format!("F [{force}]"))
                .plot(format!("x [{length}]")),
            );
        }

        for (i, x) in self.amplitudes().into_iter().enumerate() {
            let f = round(v / (2.0 * std::f64::consts::PI * x));
            let cycles = self.cycles(x);
            entries.push(
                Entry::new(
                    format!("energy_{}", i + 1),
                    format!("Loss of a cycle of {} {length} to either side.", n(x)),
                    self.speed_bench(&format!("sine({} {speed}, {} Hz)", n(2.0 * std::f64::consts::PI * f * x), n(f))),
                    cycles / f,
                )
                .plot(format!("F [{force}]"))
                .plot(format!("x [{length}]"))
                .expect(format!("integral(F * v) >= 0 J after {} s", n((cycles - 1.0) / f))),
            );
        }

        for seed in 0..6_u32 {
            let part = |k: u32| {
                // Speeds over two decades by a fixed rule: the same motions everywhere.
                let turn = f64::from((seed * 7 + k * 5 + 3) % 11) / 10.0;
                round(0.3 * bench.v_s * (1.0 + 99.0 * turn * turn * turn))
            };
            let v = format!(
                "sine({} {speed}, 1 Hz) + sine({} {speed}, 2 Hz) - sine({} {speed}, 5 Hz)",
                n(part(0)),
                n(part(1)),
                n(part(2))
            );
            // The mean of |v| is at least half of the greatest amplitude.
            let rounds = self.rounds(0.5 * part(0).max(part(1)).max(part(2)));
            entries.push(
                Entry::new(
                    format!("closed_path_{}", seed + 1),
                    "An irregular motion on a closed path: its last round takes no energy out of the contact.",
                    self.speed_bench(&v),
                    rounds + 1.0,
                )
                .plot(format!("F [{force}]"))
                .plot(format!("v [{speed}]"))
                .expect(format!("integral(F * v) >= 0 J after {} s", n(rounds))),
            );
        }

        let k = 2.0 * m;
        let frequency = root(k / m);
        for (i, vp) in self.pull_speeds().into_iter().enumerate() {
            let loading = f_b / (k * vp);
            let duration = round(3.0 * loading + 40.0 / frequency);
            let pulled = motion(Entry::new(
                format!("stick_slip_{}", i + 1),
                format!("Pulled at {} {speed} through a spring of {} {stiffness}.", n(vp), n(k)),
                format!(
                    "{}SpringBench(m = {} {mass}, k = {} {stiffness}, vp = {} {speed}, fr = {})",
                    self.units.bench,
                    n(m),
                    n(k),
                    n(vp),
                    self.pushed()
                ),
                duration,
            ));
            entries.push(shaded(pulled, "fr"));
        }

        let v0 = round(bench.f_c.max(0.1 * bench.f_b) / m);
        let thrown = motion(Entry::new(
            "coast_down",
            format!("Thrown at {} {speed}, left alone.", n(v0)),
            self.force_bench(&format!("0 {force}"), &format!(", v_start = {} {speed}", n(v0))),
            2.0,
        ));
        entries.push(shaded(thrown, "fr"));

        // A load that the contact can hold, if it can hold any.
        let load = if s.f_c > 0.01 * f_b { s.f_c } else { f_b };
        let (lifted, shaken) = (n(round(0.6 * load)), n(round(0.3 * load)));
        entries.push(shaded(
            motion(Entry::new(
                "drift",
                "A constant load, applied gently, with a small oscillation: both together below break-away.",
                format!(
                    "Damped(u = if t < 2 s then {lifted} {force} * (1 - cos(pi * t / 2 s)) / 2 \
                     else {lifted} {force} + {shaken} {force} * sin(2 * pi * 1 Hz * (t - 2 s)))"
                ),
                DRIFT.1,
            ))
            .solver("adaptive tol 1e-8"),
            "bench.fr",
        ));
        let half = round(0.5 * load);
        entries.push(shaded(
            motion(Entry::new(
                "hold",
                "Half of what it slides with, applied gently and held for 100 s.",
                format!(
                    "Damped(u = if t < 2 s then {h} {force} * (1 - cos(pi * t / 2 s)) / 2 else {h} {force})",
                    h = n(half)
                ),
                102.0,
            ))
            .solver("adaptive tol 1e-9")
            .expect(format!("peak_to_peak(x) < 1e-9 {length} after 12 s")),
            "bench.fr",
        ));

        let vp = self.pull_speeds()[2];
        let pulled = format!(
            "{}SpringBench(m = {} {mass}, k = {} {stiffness}, vp = {} {speed}, fr = {})",
            self.units.bench,
            n(m),
            n(k),
            n(vp),
            self.pushed()
        );
        let duration = round_up_to(f_b / (k * vp) * 2.0 + 5.0, 0.02);
        entries.push(motion(
            Entry::new("steps_reference", "The reference of the step-size sweep.", pulled.clone(), duration)
                .solver("adaptive tol 1e-9")
                .finest(),
        ));
        for (i, h) in self.steps().into_iter().enumerate() {
            entries.push(motion(
                Entry::new(
                    format!("steps_{}", i + 1),
                    format!("The same with a fixed step of {} s.", n(h)),
                    pulled.clone(),
                    duration,
                )
                .solver(format!("expo step {} s", n(h))),
            ));
        }
        entries
    }
}

/// A force that passes through `stops` at a mean rate, slowly at each of them, so that no mass rings where the force turns;
/// and the duration.
fn eased(stops: &[f64], rate: f64, force: &str) -> (String, f64) {
    let (mut text, mut at) = (String::new(), 0.0);
    for pair in stops.windows(2) {
        let (change, time) = (pair[1] - pair[0], (pair[1] - pair[0]).abs() / rate);
        let sign = match (text.is_empty(), change > 0.0) {
            (true, true) => "",
            (true, false) => "-",
            (false, true) => " + ",
            (false, false) => " - ",
        };
        let _ = write!(text, "{sign}{} {force} * eased(t, {} s, {} s)", n(change.abs()), n(at), n(time));
        at += time;
    }
    (text, at)
}

/// 10^k.
fn power(k: i32) -> f64 {
    format!("1e{k}").parse().expect("a power of ten")
}

/// The power of ten nearest to a positive number on a logarithmic scale.
pub fn power_near(x: f64) -> f64 {
    let text = format!("{x:e}");
    let (digits, exponent) = text.split_once('e').expect("written with an exponent");
    let (digits, exponent): (f64, i32) = (digits.parse().expect("digits"), exponent.parse().expect("an exponent"));
    power(if digits > 3.162 { exponent + 1 } else { exponent })
}

/// Square root: correctly rounded on every machine, so allowed here.
fn root(x: f64) -> f64 {
    x.sqrt()
}

/// Rounded down to two digits.
fn round_down(x: f64) -> f64 {
    let rounded = round(x);
    if rounded > x { round(x * 0.99) } else { rounded }
}

/// A whole number of steps, at least x.
fn round_up_to(x: f64, step: f64) -> f64 {
    (x / step).ceil().max(1.0) * step
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_is_a_sum_of_eased_steps() {
        let (text, end) = eased(&[0.0, 1.0, -1.0], 0.5, "N");
        assert_eq!(text, "1 N * eased(t, 0 s, 2 s) - 2 N * eased(t, 2 s, 4 s)");
        assert_eq!(end, 6.0);
    }

    #[test]
    fn powers_are_near_in_ratio() {
        assert_eq!([1.4, 3.2, 30.0, 0.04].map(power_near), [1.0, 10.0, 10.0, 0.1]);
    }
}
