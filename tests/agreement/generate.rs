//! Generates random well-typed texts from a seed: models that use the whole language, with consistent units, and an
//! experiment.
//!
//! Each expression is generated for a unit, from names in scope: earlier declarations only, so that there are no
//! cycles. Numbers are often edge cases: zeros, subnormals, overflow.

use abi::plan::Method;
use compiler::functions::{Domain, Unary};
use compiler::ir::random::Random;

/// Exponents of kg, m and s.
type Unit = [i8; 3];

const NUMBER: Unit = [0, 0, 0];
const TIME: Unit = [0, 0, 1];

/// Units of quantities, each with the ways to write it.
const UNITS: [(Unit, &[&str]); 13] = [
    (NUMBER, &["", "", "", "%", "rad", "deg"]),
    ([0, 1, 0], &["m", "mm", "um", "cm"]),
    (TIME, &["s", "ms", "us", "min"]),
    ([1, 0, 0], &["kg", "g"]),
    ([0, 1, -1], &["m/s", "mm/s", "um/s"]),
    ([0, 1, -2], &["m/s^2"]),
    ([1, 1, -2], &["N", "mN", "kN", "N"]),
    ([1, 0, -2], &["N/m", "N/mm"]),
    ([1, 0, -1], &["N·s/m", "kg/s"]),
    ([1, 2, -2], &["J", "N·m", "mJ"]),
    ([1, 2, -3], &["W", "kW"]),
    ([0, 0, -1], &["1/s", "Hz", "1/ms"]),
    ([1, 1, -1], &["N·s"]),
];

/// Steps of the experiments: as written, and in us.
const STEPS: [(&str, u32); 4] = [("1 ms", 1000), ("0.1 ms", 100), ("10 us", 10), ("50 ms", 50_000)];

/// A generated text, the step of its experiment in s, and whether its top model may be built with its inputs open.
pub struct Text {
    /// Contains a model `Top` and an experiment `e`.
    pub text: String,
    /// In s.
    pub step: f64,
}

/// A text from a seed.
pub fn text(seed: u64) -> Text {
    let mut random = Random(seed);
    let (step, step_us) = STEPS[random.below(STEPS.len())];
    let (past, noise) = (random.below(4) == 0, random.below(4) == 0);
    let (functions, models) = (Vec::new(), Vec::new());
    let mut writer = Writer { random, out: String::new(), step_us, names: 0, functions, models, past, noise };
    for _ in 0..writer.below(3) {
        writer.table();
    }
    for _ in 0..writer.below(3) {
        writer.function();
    }
    for _ in 0..writer.below(3) {
        let name = writer.name("Part");
        let model = writer.model(&name, 2);
        writer.models.push(model);
    }
    let top = writer.model("Top", 3);
    writer.experiment(&top, step);
    Text { text: writer.out, step: f64::from(step_us) * 1e-6 }
}

/// A callable: a table or a function.
#[derive(Clone)]
struct Callable {
    name: String,
    args: Vec<Unit>,
    gives: Unit,
}

/// The interface of a model.
#[derive(Clone)]
struct Model {
    name: String,
    inputs: Vec<(String, Unit)>,
    params: Vec<(String, Unit)>,
    outputs: Vec<(String, Unit)>,
    truths: Vec<String>,
}

/// The names that an expression may use.
#[derive(Clone, Default)]
struct Scope {
    quantities: Vec<(String, Unit)>,
    truths: Vec<String>,
    /// Paths through all elements of an array of parts, for `sum` and its like.
    folds: Vec<(String, Unit)>,
    /// Whether `t`, signals and noise are allowed.
    time: bool,
    /// Whether `delay` is allowed.
    past: bool,
}

struct Writer {
    random: Random,
    out: String,
    /// Step of the experiment in us: periods are multiples of it, dead times no shorter.
    step_us: u32,
    names: usize,
    functions: Vec<Callable>,
    models: Vec<Model>,
    /// Whether anything is delayed: such a model has no code for lanes.
    past: bool,
    /// Whether there is noise, which needs integer products that AVX2 lacks: no AVX2 lanes.
    noise: bool,
}

impl Writer {
    fn below(&mut self, n: usize) -> usize {
        self.random.below(n)
    }

    /// True with probability 1/n.
    fn once_in(&mut self, n: usize) -> bool {
        self.below(n) == 0
    }

    fn one<'a, T>(&mut self, of: &'a [T]) -> &'a T {
        &of[self.below(of.len())]
    }

    fn name(&mut self, stem: &str) -> String {
        self.names += 1;
        format!("{stem}{}", self.names)
    }

    fn line(&mut self, text: &str) {
        self.out += text;
        self.out.push('\n');
    }

    fn unit(&mut self) -> Unit {
        let at = self.below(UNITS.len());
        UNITS[at].0
    }

    /// A unit as it is written after a number; empty for dimensionless numbers.
    fn written(&mut self, unit: Unit) -> String {
        if let Some((_, ways)) = UNITS.iter().find(|(known, _)| *known == unit) {
            return (*self.one(ways)).to_string();
        }
        let power = |(symbol, exponent): (&str, i8)| match exponent {
            1 => symbol.to_string(),
            more => format!("{symbol}^{more}"),
        };
        let all = ["kg", "m", "s"].into_iter().zip(unit);
        let over: Vec<String> = all.clone().filter(|(_, exponent)| *exponent > 0).map(power).collect();
        let under = all.filter(|(_, exponent)| *exponent < 0).map(|(symbol, exponent)| power((symbol, -exponent)));
        let over = if over.is_empty() { "1".into() } else { over.join("·") };
        over + &under.map(|power| format!("/{power}")).collect::<String>()
    }

    /// A unit as in a declaration, in brackets.
    fn declared(&mut self, unit: Unit) -> String {
        let written = self.written(unit);
        format!("[{}]", if written.is_empty() || written == "%" { "1" } else { &written })
    }

    /// A non-negative number with its unit.
    fn literal(&mut self, unit: Unit) -> String {
        let number = match self.below(20) {
            0 => ["0", "1e-12", "1e12", "5e-324", "2.2250738585072014e-308", "1e308", "4503599627370496.5", "1e-160"]
                [self.below(8)]
            .to_string(),
            1 => "0".into(),
            2 | 3 => (1 + self.below(9)).to_string(),
            4 => format!("{:e}", self.random.within(0.0, 1.0)),
            _ => format!("{:.3}", self.random.within(0.01, 20.0)),
        };
        match self.written(unit) {
            unit if unit.is_empty() => number,
            unit => format!("{number} {unit}"),
        }
    }

    /// A positive number of ordinary size.
    fn moderate(&mut self, unit: Unit) -> String {
        let number = self.random.within(0.05, 9.0);
        match self.written(unit) {
            unit if unit.is_empty() => format!("{number:.2}"),
            unit => format!("{number:.2} {unit}"),
        }
    }

    /// A time of `n` steps.
    fn steps(&self, n: usize) -> String {
        format!("{} us", n * self.step_us as usize)
    }

    /// A quantity of this unit in scope, or a number.
    fn leaf(&mut self, scope: &Scope, unit: Unit) -> String {
        let fit: Vec<&(String, Unit)> = scope.quantities.iter().filter(|(_, own)| *own == unit).collect();
        if !fit.is_empty() && !self.once_in(5) {
            // Mostly the most recent names, so that dependency chains get long.
            let from = if self.once_in(2) { 0 } else { fit.len().saturating_sub(3) };
            return fit[from + self.below(fit.len() - from)].0.clone();
        }
        match unit {
            TIME if scope.time && self.once_in(3) => "t".into(),
            NUMBER if self.once_in(12) => "pi".into(),
            _ => self.literal(unit),
        }
    }

    /// Any quantity in scope, or a number of ordinary size.
    fn any(&mut self, scope: &Scope) -> (String, Unit) {
        if scope.quantities.is_empty() || self.once_in(6) {
            let unit = self.unit();
            return (self.moderate(unit), unit);
        }
        self.one(&scope.quantities).clone()
    }

    /// An expression of a unit, in parentheses where it has operators.
    fn real(&mut self, scope: &Scope, unit: Unit, depth: usize) -> String {
        if depth == 0 || self.once_in(7) {
            return self.leaf(scope, unit);
        }
        let d = depth - 1;
        match self.below(30) {
            0..=4 => {
                let (a, b) = (self.real(scope, unit, d), self.real(scope, unit, d));
                format!("({a} {} {b})", ["+", "-"][self.below(2)])
            }
            5..=8 => {
                let (factor, own) = self.any(scope);
                let rest = over(unit, own);
                if !small(rest) {
                    return self.leaf(scope, unit);
                }
                format!("({} * {factor})", self.real(scope, rest, d))
            }
            9 | 10 => {
                let (divisor, own) = self.any(scope);
                let rest = times(unit, own);
                if !small(rest) {
                    return self.leaf(scope, unit);
                }
                format!("({} / {divisor})", self.real(scope, rest, d))
            }
            11 => {
                let (a, b) = (self.real(scope, unit, d), self.real(scope, NUMBER, d));
                format!("({a} / (1 + {b}^2))")
            }
            12 => format!("(-{})", self.real(scope, unit, d)),
            13 => format!("abs({})", self.real(scope, unit, d)),
            14 | 15 => {
                let (a, b) = (self.real(scope, unit, d), self.real(scope, unit, d));
                format!("{}({a}, {b})", ["min", "max", "hypot"][self.below(3)])
            }
            16 => {
                let (a, bound) = (self.real(scope, unit, d), self.moderate(unit));
                format!("clamp({a}, -{bound}, {bound})")
            }
            17..=19 => {
                let c = self.truth(scope, d.min(2));
                let (a, b) = (self.real(scope, unit, d), self.real(scope, unit, d));
                format!("(if {c} then {a} else {b})")
            }
            20 => {
                let square = times(unit, unit);
                if !small(square) {
                    return self.leaf(scope, unit);
                }
                format!("sqrt(abs({}))", self.real(scope, square, d))
            }
            21 if scope.past => {
                let a = self.real(scope, unit, d);
                let time = match self.below(3) {
                    0 => self.steps(1),
                    1 => format!(
                        "{} us",
                        self.step_us as usize * (1 + self.below(12)) + self.below(self.step_us as usize)
                    ),
                    _ => {
                        let n = 1 + self.below(40);
                        self.steps(n)
                    }
                };
                format!("delay({a}, {time})")
            }
            22 | 23 if !self.functions.is_empty() => {
                let all = self.functions.clone();
                let f = self.one(&all).clone();
                let args: Vec<String> = f.args.iter().map(|arg| self.real(scope, *arg, d.min(2))).collect();
                let call = format!("{}({})", f.name, args.join(", "));
                match over(unit, f.gives) {
                    NUMBER => call,
                    rest if small(rest) => format!("({call} * {})", self.real(scope, rest, d)),
                    _ => self.leaf(scope, unit),
                }
            }
            24 if scope.time => self.signal(unit),
            25 | 26 if scope.time && self.noise => {
                let (height, each) = (self.moderate(unit), 1 + self.below(5));
                format!("noise({height}, {}, {})", self.steps(each), self.below(100))
            }
            27 => {
                let fit: Vec<&(String, Unit)> = scope.folds.iter().filter(|(_, own)| *own == unit).collect();
                if fit.is_empty() {
                    return self.real(scope, unit, d);
                }
                let path = fit[self.below(fit.len())].0.clone();
                format!("{}({path})", ["sum", "min", "max"][self.below(3)])
            }
            _ if unit == NUMBER => self.number(scope, d),
            _ => format!("({} * {})", self.real(scope, unit, d), self.number(scope, d)),
        }
    }

    /// A dimensionless number from a function.
    fn number(&mut self, scope: &Scope, depth: usize) -> String {
        let x = |writer: &mut Writer| writer.real(scope, NUMBER, depth);
        match self.below(18) {
            0 => format!("exp(-{}^2)", x(self)),
            1..=11 => {
                let function = Unary::ALL[self.below(Unary::ALL.len())];
                let Domain { low, high, .. } = function.row().domain;
                let x = x(self);
                match (low.is_finite(), high.is_finite()) {
                    (_, true) => format!("{}(clamp({x}, {low}, {high}))", function.name()),
                    (true, false) => format!("{}(abs({x}) + {low})", function.name()),
                    (false, false) => format!("{}({x})", function.name()),
                }
            }
            12 => format!("floor({})", x(self)),
            13 => format!("(abs({})^{})", x(self), ["2", "3", "0.5", "1.7", "-1"][self.below(5)]),
            14 => format!("(abs({})^{})", x(self), x(self)),
            15 => {
                let (a, unit) = self.any(scope);
                format!("sign({} - {a})", self.real(scope, unit, depth))
            }
            16 => {
                let (a, unit) = self.any(scope);
                format!("atan2({}, {a})", self.real(scope, unit, depth))
            }
            _ => {
                let (a, unit) = self.any(scope);
                format!("({} / {a})", self.real(scope, unit, depth))
            }
        }
    }

    /// A signal of time, or noise.
    fn signal(&mut self, unit: Unit) -> String {
        let height = self.moderate(unit);
        let frequency = format!("{} Hz", [0.5, 3.0, 40.0, 700.0][self.below(4)]);
        let (early, later) = (self.below(6), 1 + self.below(20));
        let (early, later) = (self.steps(early), self.steps(later));
        match self.below(8) {
            0 | 1 => format!("sine({height}, {frequency})"),
            2 => format!("square({height}, {frequency})"),
            3 => format!("step({early}, {height})"),
            4 => {
                let slope = over(unit, TIME);
                let slope = if small(slope) { self.moderate(slope) } else { return height };
                format!("ramp({early}, {height}, {slope})")
            }
            5 => format!("pulse({early}, {later}, {height})"),
            6 => format!("chirp({height}, 1 Hz, {frequency}, 1 s)"),
            _ => height,
        }
    }

    /// A condition.
    fn truth(&mut self, scope: &Scope, depth: usize) -> String {
        match self.below(8) {
            0 if !scope.truths.is_empty() => self.one(&scope.truths).clone(),
            1 if depth > 0 => {
                let (a, b) = (self.truth(scope, depth - 1), self.truth(scope, depth - 1));
                format!("({a} {} {b})", ["and", "or"][self.below(2)])
            }
            2 if depth > 0 => format!("(not {})", self.truth(scope, depth - 1)),
            _ => {
                let (a, unit) = self.any(scope);
                format!("({a} {} {})", ["<", "<=", ">", ">="][self.below(4)], self.real(scope, unit, depth))
            }
        }
    }

    /// A condition for a transition or an event: a level or a crossing.
    fn instant(&mut self, scope: &Scope) -> String {
        if self.once_in(2) {
            return self.truth(scope, 2);
        }
        let (a, unit) = self.any(scope);
        format!("{a} {} {}", ["crosses", "rises", "falls"][self.below(3)], self.real(scope, unit, 1))
    }

    fn table(&mut self) {
        let (name, of, gives) = (self.name("table_"), self.unit(), self.unit());
        let (of_written, gives_written) = (self.declared(of), self.declared(gives));
        let plain = |brackets: &str| brackets.trim_matches(['[', ']']).to_string();
        let behind = |brackets: &str| match plain(brackets) {
            unit if unit == "1" => String::new(),
            unit => format!(" {unit}"),
        };
        let mut x = self.random.within(-2.0, 1.0);
        let mut points = Vec::new();
        for _ in 0..2 + self.below(6) {
            let y = self.random.within(-5.0, 5.0);
            points.push(format!("{x:.3}{}: {y:.3}{}", behind(&of_written), behind(&gives_written)));
            x += self.random.within(0.01, 2.0);
        }
        let shape = ["linear", "smooth"][self.below(2)];
        let points = points.join(", ");
        self.line(&format!("table {name}(x {of_written}) {gives_written} = {shape} {{ {points} }}"));
        self.functions.push(Callable { name, args: vec![of], gives });
    }

    fn function(&mut self) {
        let (name, gives) = (self.name("f"), self.unit());
        let args: Vec<Unit> = (0..1 + self.below(3)).map(|_| self.unit()).collect();
        let quantities: Vec<(String, Unit)> =
            ["a", "b", "c"].into_iter().zip(&args).map(|(name, unit)| (name.to_string(), *unit)).collect();
        let written: Vec<String> =
            quantities.iter().map(|(name, unit)| format!("{name} {}", self.declared(*unit))).collect();
        let body = self.real(&Scope { quantities, ..Scope::default() }, gives, 3);
        let gives_written = self.declared(gives);
        self.line(&format!("fn {name}({}) {gives_written} = {body}", written.join(", ")));
        self.functions.push(Callable { name, args, gives });
    }

    /// A model with up to `most` items of each kind.
    fn model(&mut self, name: &str, most: usize) -> Model {
        let before = self.out.len();
        let mut model = Model { name: name.into(), inputs: vec![], params: vec![], outputs: vec![], truths: vec![] };
        let mut scope = Scope { time: true, past: self.past, ..Scope::default() };
        self.line(&format!("model {name} {{"));
        for _ in 0..1 + self.below(most) {
            let (name, unit) = (self.name("p"), self.unit());
            let (brackets, value) = (self.declared(unit), self.moderate(unit));
            let range = match self.below(4) {
                0 => "  in > 0".to_string(),
                1 => format!("  in 0.001 * {value} .. 1e6 * {value}"),
                _ => String::new(),
            };
            let sign = if range.is_empty() && self.once_in(4) { "-" } else { "" };
            let value = if range.is_empty() && self.once_in(4) { self.literal(unit) } else { value };
            let brackets = if self.once_in(2) { String::new() } else { format!(" {brackets}") };
            self.line(&format!("  param {name}{brackets} = {sign}{value}{range}"));
            model.params.push((name.clone(), unit));
            scope.quantities.push((name, unit));
        }
        for _ in 0..self.below(most) {
            let (name, unit) = (self.name("u"), self.unit());
            let brackets = self.declared(unit);
            self.line(&format!("  input {name} {brackets}"));
            model.inputs.push((name.clone(), unit));
            scope.quantities.push((name, unit));
        }
        let mut states = self.states(&mut scope, most);
        self.sampled(&mut scope, &mut model);
        if !self.models.is_empty() {
            for _ in 0..self.below(3) {
                self.part(&mut scope, before);
            }
        }
        self.lets(&mut scope, most);
        self.automaton(&mut scope, &mut model, &mut states);
        self.lets(&mut scope, most);
        self.derivatives(&mut scope, &states);
        for _ in 0..1 + self.below(most) {
            self.output(&mut scope, &mut model);
        }
        self.line("}");
        model
    }

    /// Continuous states: their names, units, and whether their derivative has been defined.
    fn states(&mut self, scope: &mut Scope, most: usize) -> Vec<(String, Unit, bool)> {
        let mut states = Vec::new();
        for _ in 0..self.below(most + 1) {
            let (name, unit) = (self.name("x"), self.unit());
            let brackets = self.declared(unit);
            let own: Vec<String> =
                scope.quantities.iter().filter(|(_, other)| *other == unit).map(|(name, _)| name.clone()).collect();
            let value = match self.below(4) {
                0 if !own.is_empty() => self.one(&own).clone(),
                1 => self.moderate(unit),
                _ => "0".into(),
            };
            let range = match self.below(6) {
                0 if value == "0" => {
                    let bound = self.moderate(unit);
                    format!("  in -{bound} .. {bound}")
                }
                1 if value == "0" => format!("  in >= -1000 * {}", self.moderate(unit)),
                _ => String::new(),
            };
            self.line(&format!("  state {name} {brackets} = {value}{range}"));
            states.push((name, unit, false));
        }
        scope.quantities.extend(states.iter().map(|(name, unit, _)| (name.clone(), *unit)));
        states
    }

    /// Blocks of sampled code with memory.
    fn sampled(&mut self, scope: &mut Scope, model: &mut Model) {
        for _ in 0..[0, 0, 1, 1, 2][self.below(5)] {
            let period = 1 + self.below(7);
            let mut period = self.steps(period);
            if self.once_in(3) {
                let name = self.name("Ts");
                self.line(&format!("  param {name} = {period}  in > 0"));
                period = name;
            }
            let mut memory = Vec::new();
            for _ in 0..1 + self.below(2) {
                let (name, unit) = (self.name("n"), self.unit());
                let brackets = self.declared(unit);
                let value = if self.once_in(2) { "0".into() } else { self.moderate(unit) };
                self.line(&format!("  state {name} {brackets} = {value}"));
                memory.push((name, unit));
            }
            let (held, unit) = (self.name("h"), self.unit());
            let brackets = self.declared(unit);
            self.line(&format!("  output {held} {brackets}"));
            let mut inside = Scope { past: false, ..scope.clone() };
            inside.quantities.extend(memory.iter().cloned());
            self.line(&format!("  every {period} {{"));
            if self.once_in(2) {
                let (name, unit) = (self.name("e"), self.unit());
                let (brackets, value) = (self.declared(unit), self.real(&inside, unit, 3));
                self.line(&format!("    let {name} {brackets} = {value}"));
                inside.quantities.push((name, unit));
            }
            let value = self.real(&inside, unit, 2);
            self.line(&format!("    {held} = {value}"));
            for (name, unit) in &memory {
                let value = self.real(&inside, *unit, 2);
                self.line(&format!("    next({name}) = {value}"));
            }
            self.line("  }");
            scope.quantities.extend(memory);
            scope.quantities.push((held.clone(), unit));
            model.outputs.push((held, unit));
        }
    }

    /// A part, sometimes an array, sometimes in a slot.
    fn part(&mut self, scope: &mut Scope, before: usize) {
        let models = self.models.clone();
        let of = self.one(&models).clone();
        let name = self.name("part_");
        let array = self.once_in(3);
        let mut args: Vec<String> = Vec::new();
        for (input, unit) in &of.inputs {
            args.push(format!("{input} = {}", self.real(scope, *unit, 2)));
        }
        for (param, unit) in &of.params {
            if self.once_in(3) {
                let by = if array && self.once_in(2) { " / i" } else { "" };
                args.push(format!("{param} = {}{by}", self.moderate(*unit)));
            }
        }
        let args = args.join(", ");
        let mut slot = String::new();
        if self.once_in(3) {
            let interface = self.name("Slot");
            let ports: Vec<String> = of
                .inputs
                .iter()
                .map(|port| ("input", port))
                .chain(of.outputs.iter().map(|port| ("output", port)))
                .map(|(word, (name, unit))| format!("{word} {name} {}", self.declared(*unit)))
                .collect();
            let item = format!("interface {interface} {{ {} }}\n", ports.join("  "));
            self.out.insert_str(before, &item);
            slot = format!(" : {interface}");
        }
        if array {
            let n = 2 + self.below(3);
            self.line(&format!("  part {name}[i in 1 .. {n}]{slot} = {}({args})", of.name));
            for (output, unit) in &of.outputs {
                scope.folds.push((format!("{name}.{output}"), *unit));
                scope.quantities.push((format!("{name}[{}].{output}", 1 + self.below(n)), *unit));
            }
            return;
        }
        self.line(&format!("  part {name}{slot} = {}({args})", of.name));
        scope.quantities.extend(of.outputs.iter().map(|(output, unit)| (format!("{name}.{output}"), *unit)));
        if slot.is_empty() {
            scope.truths.extend(of.truths.iter().map(|truth| format!("{name}.{truth}")));
        }
    }

    fn lets(&mut self, scope: &mut Scope, most: usize) {
        for _ in 0..self.below(most) {
            if self.once_in(5) {
                let name = self.name("b");
                let value = self.truth(scope, 2);
                self.line(&format!("  let {name} = {value}"));
                scope.truths.push(name);
                continue;
            }
            let (name, unit) = (self.name("l"), self.unit());
            let (brackets, value) = (self.declared(unit), self.real(scope, unit, 3));
            self.line(&format!("  let {name} {brackets} = {value}"));
            scope.quantities.push((name, unit));
        }
    }

    /// Regimes that define an output and some of the states, and events.
    fn automaton(&mut self, scope: &mut Scope, model: &mut Model, states: &mut [(String, Unit, bool)]) {
        let instants = Scope { past: false, ..scope.clone() };
        let resets = |writer: &mut Writer, states: &[(String, Unit, bool)]| -> String {
            let mut out = String::new();
            for (name, unit, _) in states {
                if writer.once_in(2) {
                    out += &format!("reset({name}) = {} ", writer.real(&instants, *unit, 2));
                }
            }
            if out.is_empty() { out } else { format!(" {{ {out}}}") }
        };
        if self.once_in(3) {
            let resets = resets(self, states);
            if !resets.is_empty() {
                let condition = self.instant(&instants);
                self.line(&format!("  when {condition}{resets}"));
            }
        }
        if !self.once_in(2) {
            return;
        }
        let (output, unit) = (self.name("r"), self.unit());
        let brackets = self.declared(unit);
        self.line(&format!("  output {output} {brackets}"));
        let modes: Vec<String> = (0..2 + self.below(2)).map(|_| self.name("mode_")).collect();
        let own: Vec<bool> = states.iter().map(|_| self.once_in(2)).collect();
        for (k, mode) in modes.iter().enumerate() {
            self.line(&format!("  mode {mode}{} {{", if k == 0 { " initial" } else { "" }));
            let value = self.real(scope, unit, 3);
            self.line(&format!("    {output} = {value}"));
            for ((name, unit, _), _) in states.iter().zip(&own).filter(|(_, own)| **own) {
                let value = self.rate(scope, name, *unit);
                self.line(&format!("    d{name}/dt = {value}"));
            }
            for other in 0..1 + self.below(2) {
                let (target, condition) = (modes[(k + 1 + other) % modes.len()].clone(), self.instant(&instants));
                let resets = if self.once_in(3) { resets(self, states) } else { String::new() };
                self.line(&format!("    go {target} when {condition}{resets}"));
            }
            self.line("  }");
        }
        for (state, own) in states.iter_mut().zip(own) {
            state.2 |= own;
        }
        scope.quantities.push((output.clone(), unit));
        scope.truths.extend(modes.iter().cloned());
        model.outputs.push((output, unit));
        model.truths.extend(modes);
    }

    /// The right-hand side of a derivative: a relaxation, or any expression.
    fn rate(&mut self, scope: &Scope, name: &str, unit: Unit) -> String {
        match self.below(3) {
            0 => format!("({} - {name}) / {}", self.real(scope, unit, 2), self.moderate(TIME)),
            1 => format!(
                "{} - {name} * abs({})",
                self.real(scope, over(unit, TIME), 2),
                self.real(scope, over(NUMBER, TIME), 2)
            ),
            _ => self.real(scope, over(unit, TIME), 3),
        }
    }

    /// The derivatives of the remaining states, by time or by each other; later statements may use what is defined.
    fn derivatives(&mut self, scope: &mut Scope, states: &[(String, Unit, bool)]) {
        for (k, (name, unit, done)) in states.iter().enumerate() {
            if *done {
                continue;
            }
            if k > 0 && self.once_in(8) {
                let (along, path, _) = &states[k - 1];
                let rate = over(*unit, *path);
                if small(rate) {
                    let value = self.real(scope, rate, 2);
                    self.line(&format!("  d{name}/d{along} = {value}"));
                    continue;
                }
            }
            let value = self.rate(scope, name, *unit);
            self.line(&format!("  d{name}/dt = {value}"));
            scope.quantities.push((format!("(d{name}/dt)"), over(*unit, TIME)));
        }
    }

    fn output(&mut self, scope: &mut Scope, model: &mut Model) {
        let name = self.name("y");
        if self.once_in(6) {
            let value = self.truth(scope, 2);
            self.line(&format!("  output {name} = {value}"));
            model.truths.push(name);
            return;
        }
        let unit = self.unit();
        let (brackets, value) = (self.declared(unit), self.real(scope, unit, 3));
        self.line(&format!("  output {name} {brackets} = {value}"));
        scope.quantities.push((name.clone(), unit));
        model.outputs.push((name, unit));
    }

    fn experiment(&mut self, top: &Model, step: &str) {
        let outside = Scope { time: true, ..Scope::default() };
        let mut args: Vec<String> = Vec::new();
        for (input, unit) in &top.inputs {
            let value = if self.once_in(2) { self.signal(*unit) } else { self.real(&outside, *unit, 2) };
            args.push(format!("{input} = {value}"));
        }
        let solver = Method::fixed().nth(self.below(Method::fixed().count())).expect("a fixed step").name();
        self.line(&format!(
            "experiment e {{\n  run    Top({}) for 1 s\n  solver {solver} step {step}",
            args.join(", ")
        ));
        let mut inside = outside;
        inside.quantities = top.outputs.iter().chain(&top.params).cloned().collect();
        inside.truths = top.truths.clone();
        for _ in 0..self.below(3) {
            let unit = self.unit();
            let value = self.real(&inside, unit, 2);
            self.line(&format!("  plot   {value}"));
        }
        if self.once_in(2) {
            let (a, unit) = self.any(&inside);
            let bound = self.moderate(unit);
            let measure = ["min", "max", "mean", "rms", "final"][self.below(5)];
            self.line(&format!("  expect {measure}({a}) < {bound}"));
        }
        self.line("}");
    }
}

fn times(a: Unit, b: Unit) -> Unit {
    std::array::from_fn(|k| a[k] + b[k])
}

fn over(a: Unit, b: Unit) -> Unit {
    std::array::from_fn(|k| a[k] - b[k])
}

/// Whether exponents are small enough to be written by hand.
fn small(unit: Unit) -> bool {
    unit.iter().all(|exponent| exponent.abs() <= 6)
}
