//! Python source of a model as a pure function, for numpy, jax, casadi and sympy.
//!
//! In: a program without delays, sampled blocks, events and resets, before its elementary functions are expanded. Out: a
//! module with `f(t, x, u, p) -> dx, y`, which other libraries differentiate, compile and optimise. Its values agree with
//! those of the other back ends within rounding, not to the bit. One writer serves all dialects; a `Spelling` has what
//! they write differently.

use super::c::{comment, identifier, range};
use crate::ir::build::{Build, Env};
use crate::ir::hash::{HashMap, HashSet};
use crate::ir::program::Program;
use crate::ir::{Func, Op, Type, Value, sign_of, verify};
use abi::description::{Automaton, Kind, Quantity, Segment};
use abi::unit::Unit;
use abi::{Description, Slot};
use std::ops::Range;

/// Maximum length of an inline expression, in characters.
const MAX_INLINE: usize = 60;

/// Maximum length of a line of names.
const MAX_LINE: usize = 100;

/// A library for which source is written.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Dialect {
    /// Arrays of doubles.
    Numpy,
    /// Gradients, vectors of instances, other processors.
    Jax,
    /// Symbolic functions for optimal control.
    Casadi,
    /// Formulas for papers.
    Sympy,
}

impl Dialect {
    /// All of them.
    pub const ALL: [Dialect; 4] = [Dialect::Numpy, Dialect::Jax, Dialect::Casadi, Dialect::Sympy];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Dialect::Numpy => "numpy",
            Dialect::Jax => "jax",
            Dialect::Casadi => "casadi",
            Dialect::Sympy => "sympy",
        }
    }

    /// Whether an array can be read at a computed index, as tables need it.
    pub fn has_tables(self) -> bool {
        matches!(self, Dialect::Numpy | Dialect::Jax)
    }

    /// Whether there are integers of 64 bits that wrap, from which random numbers are made.
    pub fn has_random(self) -> bool {
        self == Dialect::Numpy
    }

    fn spelling(self) -> &'static Spelling {
        match self {
            Dialect::Numpy => &NUMPY,
            Dialect::Jax => &JAX,
            Dialect::Casadi => &CASADI,
            Dialect::Sympy => &SYMPY,
        }
    }
}

/// What a dialect writes in its own way. In templates, `@` is the name of the library, and `{0}`, `{1}`, `{2}` are the
/// operands.
struct Spelling {
    library: &'static str,
    import: &'static str,
    /// What callers should know.
    note: &'static str,
    select: &'static str,
    select_truth: &'static str,
    and: &'static str,
    or: &'static str,
    not: &'static str,
    /// A comparison of numbers; `None`: by `==`.
    equal: Option<&'static str>,
    abs: &'static str,
    nearest: &'static str,
    truths: [&'static str; 2],
    infinity: &'static str,
    int: &'static str,
    /// Whether whole numbers are written as integers, which symbolic mathematics keeps exact.
    whole: bool,
    /// Functions that are not called by their name in the language.
    functions: &'static [(&'static str, &'static str)],
    /// The function that makes a result of its rows.
    vector: &'static str,
}

const NUMPY: Spelling = Spelling {
    library: "np",
    import: "import numpy as np",
    note: "Rows of x, u and p may be arrays, which are broadcast.",
    select: "@.where({0}, {1}, {2})",
    select_truth: "@.where({0}, {1}, {2})",
    and: "@.logical_and({0}, {1})",
    or: "@.logical_or({0}, {1})",
    not: "@.logical_not({0})",
    equal: None,
    abs: "@.abs({0})",
    nearest: "@.round({0})",
    truths: ["False", "True"],
    infinity: "@.inf",
    int: "@.uint64({0})",
    whole: false,
    functions: &[
        ("asin", "@.arcsin({0})"),
        ("acos", "@.arccos({0})"),
        ("atan", "@.arctan({0})"),
        ("atan2", "@.arctan2({0}, {1})"),
        ("pow", "@.power({0}, {1})"),
    ],
    vector: "def _vector(*rows):\n    return @.stack(@.broadcast_arrays(*rows)) if rows else @.zeros(0)\n",
};

const JAX: Spelling = Spelling {
    library: "jnp",
    import: "import jax.numpy as jnp",
    note: "Needs jax.config.update(\"jax_enable_x64\", True) for doubles; without it all is computed in 32 bits.",
    int: "{0}",
    ..NUMPY
};

const CASADI: Spelling = Spelling {
    library: "ca",
    import: "import casadi as ca",
    note: "All functions are casadi.Function.",
    select: "@.if_else({0}, {1}, {2})",
    select_truth: "@.if_else({0}, {1}, {2})",
    and: "@.logic_and({0}, {1})",
    or: "@.logic_or({0}, {1})",
    not: "@.logic_not({0})",
    abs: "@.fabs({0})",
    // The IEEE remainder is that to the nearest integer, ties to even.
    nearest: "({0} - @.remainder({0}, 1.0))",
    truths: ["@.SX(0)", "@.SX(1)"],
    functions: &[("pow", "@.power({0}, {1})")],
    vector: "def _vector(*rows):\n    return @.SX(@.vertcat(*rows)) if rows else @.SX(0, 1)\n\n\n\
             def _made(name, function, names, takes, gives):\n    \
             # t is a symbol, all others are lists of them.\n    \
             symbols = [@.SX.sym(one) if one == \"t\" else [@.SX.sym(row) for row in one] for one in names]\n    \
             results = function(*symbols)\n    \
             results = list(results) if isinstance(results, tuple) else [results]\n    \
             vectors = [_vector(*one) if isinstance(one, list) else one for one in symbols]\n    \
             return @.Function(name, vectors, results, takes, gives)\n",
    ..NUMPY
};

const SYMPY: Spelling = Spelling {
    library: "sp",
    import: "import sympy as sp",
    note: "dx, y = f() are formulas in the symbols t, x, u and p.",
    select: "@.Piecewise(({1}, {0}), ({2}, True))",
    select_truth: "@.ITE({0}, {1}, {2})",
    and: "@.And({0}, {1})",
    or: "@.Or({0}, {1})",
    not: "@.Not({0})",
    equal: Some("@.Eq({0}, {1})"),
    abs: "@.Abs({0})",
    nearest: "@.floor({0} + @.Rational(1, 2))",
    truths: ["@.false", "@.true"],
    infinity: "@.oo",
    whole: true,
    functions: &[
        ("expm1", "(@.exp({0}) - 1)"),
        ("log1p", "@.log(1 + ({0}))"),
        ("hypot", "@.sqrt(({0})**2 + ({1})**2)"),
        ("pow", "@.Pow({0}, {1})"),
    ],
    vector: "def _vector(*rows):\n    return @.Matrix(rows)\n",
    ..NUMPY
};

impl Spelling {
    fn write(&self, template: &str, operands: &[&str]) -> String {
        let mut out = template.replace('@', self.library);
        for (k, operand) in operands.iter().enumerate() {
            out = out.replace(&format!("{{{k}}}"), operand);
        }
        out
    }

    fn call(&self, name: &str, operands: &[&str]) -> String {
        match self.functions.iter().find(|(known, _)| *known == name) {
            Some((_, template)) => self.write(template, operands),
            None => format!("{}.{name}({})", self.library, operands.join(", ")),
        }
    }

    /// A literal.
    fn real(&self, x: f64) -> Text {
        let size = match x.abs() {
            size if size.is_nan() => return Text::atom(format!("{}.nan", self.library)),
            f64::INFINITY => self.write(self.infinity, &[]),
            size if self.whole && size.fract() == 0.0 && size < 1e15 => format!("{size}"),
            size => format!("{size:?}"),
        };
        let is_negative = x.is_sign_negative() && !(self.whole && x == 0.0);
        if is_negative { Text { text: format!("-{size}"), level: SIGN } } else { Text::atom(size) }
    }
}

/// How tightly an expression binds.
type Level = u8;
const COMPARISON: Level = 0;
const SUM: Level = 1;
const PRODUCT: Level = 2;
const SIGN: Level = 3;
const ATOM: Level = 4;

/// An expression.
#[derive(Clone, Default)]
struct Text {
    text: String,
    level: Level,
}

impl Text {
    fn atom(text: String) -> Text {
        Text { text, level: ATOM }
    }

    /// As an operand of something that binds as tightly as this.
    fn within(&self, level: Level) -> String {
        if self.level < level { format!("({})", self.text) } else { self.text.clone() }
    }
}

/// An argument of a function: its name, and the slots of its rows with their names.
struct Argument {
    name: &'static str,
    rows: Vec<(Slot, String)>,
}

/// Values that a function returns together, with the names of its rows.
struct Returned {
    rows: Vec<(Value, String)>,
}

/// The module of a model.
///
/// # Panics
/// If the program has a delay, a sampled block, an event or a reset, or what the dialect does not have: the caller has
/// checked that.
pub fn source(program: &Program, dialect: Dialect) -> String {
    let (description, spelling) = (&program.description, dialect.spelling());
    let layout = &description.layout;
    let names = Names::new(description, spelling);
    let rows = |segment: Segment| segment.range().map(|slot| (Slot(slot as u32), names.of(slot))).collect::<Vec<_>>();
    let argument = |name: &'static str, segment: Segment| Argument { name, rows: rows(segment) };
    let all = || {
        let mut all = vec![
            Argument { name: "t", rows: vec![(Slot::TIME, "t".into())] },
            argument("x", layout.states),
            argument("u", layout.inputs),
            argument("p", layout.params),
        ];
        if layout.regimes.len > 0 {
            all.push(argument("q", layout.regimes));
        }
        all
    };
    let numbers = numbers_of_tables(program);
    let mut functions = String::new();
    let mut add =
        |name: &str, doc: &str, arguments: Vec<Argument>, funcs: &[&Func], results: &[Vec<(Slot, String)>]| {
            let mut build = Build::new(name).with_pool(description.pool.clone());
            let mut env = Env::default();
            for func in funcs {
                build.inline(func, &mut env);
            }
            let read = |(slot, name): &(Slot, String), build: &mut Build| (build.read(*slot, &env), name.clone());
            let results: Vec<Returned> = results
                .iter()
                .map(|rows| Returned { rows: rows.iter().map(|row| read(row, &mut build)).collect() })
                .collect();
            let ops = build.into_ops();
            let mut body = Body::new(&ops, &names, &arguments, dialect, numbers.start);
            functions += &body.function(name, doc, &arguments, &results);
        };
    let states = rows(layout.states);
    let rates =
        layout.derivatives.range().zip(&states).map(|(slot, (_, name))| (Slot(slot as u32), format!("d_{name}")));
    let outputs = outputs(description).map(|quantity| (quantity.slot, names.of(quantity.slot.index())));
    let results = [rates.collect(), outputs.collect()];
    add("f", "Rates of the states and outputs, in SI.", all(), &[&program.derivatives, &program.outputs], &results);
    let mut begin = vec![states];
    if layout.regimes.len > 0 {
        begin.push(rows(layout.regimes));
    }
    let begins = if begin.len() > 1 { "States and regimes at t = 0." } else { "States at t = 0." };
    let given = vec![argument("u", layout.inputs), argument("p", layout.params)];
    add("start", begins, given, &[&program.start], &begin);
    if let Some(transitions) = program.transitions.as_ref().filter(|_| layout.regimes.len > 0) {
        let next = "Regimes after at most one transition of each part.";
        add("transitions", next, all(), &[transitions], &[rows(layout.regimes)]);
    }
    let mut out = heading(description, &program.params, dialect);
    if !numbers.is_empty() {
        let entries: Vec<String> = description.pool[numbers].iter().map(|entry| spelling.real(*entry).text).collect();
        let lines: Vec<String> = entries.chunks(4).map(|row| format!("    {},\n", row.join(", "))).collect();
        out += &format!("POOL = {}.array([\n{}])\n\n", spelling.library, lines.concat());
    }
    if dialect == Dialect::Sympy {
        out += &symbols(description, &names);
    }
    out + "\n" + &spelling.write(spelling.vector, &[]) + &functions
}

/// Where the numbers of all tables are in the pool.
fn numbers_of_tables(program: &Program) -> Range<usize> {
    let funcs =
        [Some(&program.derivatives), Some(&program.outputs), Some(&program.start), program.transitions.as_ref()];
    let read = funcs.into_iter().flatten().flat_map(|func| &func.ops).filter_map(|op| match op {
        Op::Pool { base, len, .. } => Some(*base as usize..(base + len) as usize),
        _ => None,
    });
    read.reduce(|all, one| all.start.min(one.start)..all.end.max(one.end)).unwrap_or(0..0)
}

/// Outputs in their order.
fn outputs(description: &Description) -> impl Iterator<Item = &Quantity> {
    description.quantities.iter().filter(|quantity| quantity.kind == Kind::Output)
}

/// The quantities of a segment; `None` for a slot without a name.
fn quantities(description: &Description, segment: Segment) -> impl Iterator<Item = Option<&Quantity>> {
    let of = |slot: usize| description.quantities.iter().find(|quantity| quantity.slot.index() == slot);
    segment.range().map(of)
}

/// The head of the module: what it is, and the names of all rows.
fn heading(description: &Description, params: &[f64], dialect: Dialect) -> String {
    let (layout, spelling) = (&description.layout, dialect.spelling());
    let has_regimes = layout.regimes.len > 0;
    let arguments = if has_regimes { "t, x, u, p, q" } else { "t, x, u, p" };
    let mut out = format!(
        "# {}: the model as a pure function for {}.\n#\n#   dx, y = f({arguments})\n#\n\
         # t: time in s; x: states; u: inputs; p: parameters; dx: rates of the states; y: outputs. All numbers are in SI,\n\
         # and rows have the order of the names below. start(u, p) gives the states at t = 0. Ranges are not checked.\n",
        comment(&description.name),
        dialect.name(),
    );
    if has_regimes {
        out += "# q: the regime of each part, counted from 0. transitions(t, x, u, p, q) gives the regimes after t.\n";
    }
    out += &format!("# {}\n\n{}\n\n", spelling.note, spelling.import);
    let table = |name: &str, all: Vec<Option<&Quantity>>| {
        let row = |quantity: Option<&Quantity>| match quantity {
            Some(quantity) => format!("    {:?},{}\n", quantity.path, about(quantity)),
            None => "    \"\",\n".into(),
        };
        match all.is_empty() {
            true => format!("{name} = ()\n"),
            false => format!("{name} = (\n{})\n", all.into_iter().map(row).collect::<String>()),
        }
    };
    out += &table("STATES", quantities(description, layout.states).collect());
    out += &table("INPUTS", quantities(description, layout.inputs).collect());
    out += &table("OUTPUTS", outputs(description).map(Some).collect());
    out += &table("PARAMS", quantities(description, layout.params).collect());
    let defaults = params.iter().zip(quantities(description, layout.params));
    let default = |(value, quantity): (&f64, Option<&Quantity>)| {
        let name = quantity.map_or(String::new(), |quantity| format!("  # {}", comment(&quantity.path)));
        format!("    {},{name}\n", spelling.real(*value).text)
    };
    out += &match params {
        [] => "DEFAULTS = ()\n".to_string(),
        _ => format!("DEFAULTS = (\n{})\n", defaults.map(default).collect::<String>()),
    };
    if has_regimes {
        let regimes = |automaton: &Automaton| {
            format!(
                "    ({:?}, {}),\n",
                automaton.path,
                tuple(automaton.regimes.iter().map(|name| format!("{name:?}")))
            )
        };
        out += &format!("REGIMES = (\n{})\n", description.automata.iter().map(regimes).collect::<String>());
    }
    out + "\n"
}

/// Unit, range and first line of the documentation of a quantity, as a comment.
fn about(quantity: &Quantity) -> String {
    let unit = match quantity.boolean {
        true => "true 1, false 0".into(),
        false => Unit::si(quantity.unit.dimension).text,
    };
    let within = range(quantity.range).filter(|_| !quantity.boolean).unwrap_or_default();
    let doc = quantity.doc.as_ref().and_then(|doc| doc.lines().next()).unwrap_or_default();
    let all: Vec<&str> = [&unit, &within, doc].map(str::trim).into_iter().filter(|part| !part.is_empty()).collect();
    if all.is_empty() { String::new() } else { format!("  # {}", comment(&all.join(", "))) }
}

/// The symbols of formulas.
fn symbols(description: &Description, names: &Names) -> String {
    let layout = &description.layout;
    let mut out = String::from("t = sp.Symbol(\"t\", real=True)\n");
    let segments = [("x", layout.states), ("u", layout.inputs), ("p", layout.params), ("q", layout.regimes)];
    for (name, segment) in segments.into_iter().filter(|(name, segment)| *name != "q" || segment.len > 0) {
        let all = tuple(segment.range().map(|slot| format!("{:?}", names.symbols[slot])));
        out += &format!("{name} = tuple(sp.Symbol(name, real=True) for name in {all})\n");
    }
    out + "\n"
}

/// Names of slots.
struct Names {
    /// As variables.
    slots: Vec<String>,
    /// As symbols of formulas: `sigma0_fr` for `fr.sigma0`, which is set with subscripts.
    symbols: Vec<String>,
    taken: HashSet<String>,
}

/// Words of Python, and names of the module, that no variable may have.
const RESERVED: [&str; 42] = [
    "False",
    "None",
    "True",
    "and",
    "as",
    "assert",
    "async",
    "await",
    "break",
    "class",
    "continue",
    "def",
    "del",
    "elif",
    "else",
    "except",
    "finally",
    "for",
    "from",
    "global",
    "if",
    "import",
    "in",
    "is",
    "lambda",
    "nonlocal",
    "not",
    "or",
    "pass",
    "raise",
    "return",
    "try",
    "while",
    "with",
    "yield",
    "float",
    "tuple",
    "one",
    "t",
    "f",
    "start",
    "transitions",
];

impl Names {
    fn new(description: &Description, spelling: &Spelling) -> Names {
        let size = description.layout.size();
        let mut taken: HashSet<String> = RESERVED.iter().map(|word| word.to_string()).collect();
        taken.extend(["POOL", "STATES", "INPUTS", "OUTPUTS", "PARAMS", "DEFAULTS", "REGIMES"].map(String::from));
        taken.insert(spelling.library.into());
        let mut paths: Vec<String> = vec![String::new(); size];
        for quantity in &description.quantities {
            let path = &mut paths[quantity.slot.index()];
            if path.is_empty() {
                *path = quantity.path.clone();
            }
        }
        for automaton in &description.automata {
            let path = &mut paths[automaton.slot.index()];
            *path = if automaton.path.is_empty() { "regime".into() } else { format!("{}.regime", automaton.path) };
        }
        let mut slots = Vec::with_capacity(size);
        for path in &paths {
            let mut name = identifier(path);
            while taken.contains(&name) {
                name.push('_');
            }
            // Slots without a name are many, and none is an argument.
            if !path.is_empty() {
                taken.insert(name.clone());
            }
            slots.push(name);
        }
        let mut symbols: Vec<String> = Vec::with_capacity(size);
        let mut known = HashSet::default();
        for path in &paths {
            let mut parts: Vec<String> = path.split('.').map(identifier).collect();
            parts.rotate_right(1);
            let mut symbol = parts.join("_");
            if !path.is_empty() && !known.insert(symbol.clone()) {
                symbol = path.clone();
            }
            symbols.push(symbol);
        }
        Names { slots, symbols, taken }
    }

    fn of(&self, slot: usize) -> String {
        self.slots[slot].clone()
    }
}

/// Writes one function.
struct Body<'a> {
    ops: &'a [Op],
    dialect: Dialect,
    spelling: &'static Spelling,
    types: Vec<Type>,
    /// The names of what is loaded.
    loads: HashMap<Slot, String>,
    taken: HashSet<String>,
    text: Vec<Text>,
    /// Where the numbers of tables begin in the pool.
    tables: usize,
}

impl<'a> Body<'a> {
    fn new(ops: &'a [Op], names: &Names, arguments: &[Argument], dialect: Dialect, tables: usize) -> Body<'a> {
        let types = verify::types_of(ops).expect("the function is sound");
        let loads = arguments.iter().flat_map(|argument| argument.rows.iter().cloned()).collect();
        let text = vec![Text::default(); ops.len()];
        Body { ops, dialect, spelling: dialect.spelling(), types, loads, taken: names.taken.clone(), text, tables }
    }

    /// The sign of a value is one operation here.
    fn operands(&self, op: Op) -> Vec<Value> {
        if let Some(x) = sign_of(op, |value| self.ops[value.index()]) {
            return vec![x];
        }
        let mut operands = Vec::new();
        op.each_operand(|operand| operands.push(operand));
        operands
    }

    /// A name that is not taken yet.
    fn fresh(&mut self, wanted: &str) -> String {
        let mut name = wanted.to_string();
        while self.taken.contains(&name) {
            name.push('_');
        }
        self.taken.insert(name.clone());
        name
    }

    fn function(&mut self, name: &str, doc: &str, arguments: &[Argument], results: &[Returned]) -> String {
        let mut uses = vec![0; self.ops.len()];
        results.iter().flat_map(|result| &result.rows).for_each(|(value, _)| uses[value.index()] += 1);
        for k in (0..self.ops.len()).rev() {
            if uses[k] > 0 {
                self.operands(self.ops[k]).into_iter().for_each(|operand| uses[operand.index()] += 1);
            }
        }
        let mut returned: HashMap<Value, String> = HashMap::default();
        for (value, name) in results.iter().flat_map(|result| &result.rows) {
            returned.entry(*value).or_insert_with(|| name.clone());
        }
        let mut body = String::new();
        let indent = if self.dialect == Dialect::Numpy { "        " } else { "    " };
        let mut count = 0;
        for k in (0..self.ops.len()).filter(|k| uses[*k] > 0) {
            let (value, op) = (Value(k as u32), self.ops[k]);
            let written = self.expression(op);
            let leaf = op.is_constant() || matches!(op, Op::Load(_));
            let short = uses[k] == 1 && written.text.len() <= MAX_INLINE && !returned.contains_key(&value);
            self.text[k] = match leaf || short {
                true => written,
                false => {
                    let name = match returned.get(&value) {
                        // An output has its name in the table of names already.
                        Some(name) if !self.loads.values().any(|loaded| loaded == name) => name.clone(),
                        _ => {
                            count += 1;
                            self.fresh(&format!("v{count}"))
                        }
                    };
                    body += &format!("{indent}{name} = {}\n", written.text);
                    Text::atom(name)
                }
            };
        }
        let vector = |result: &Returned| {
            let rows: Vec<&str> = result.rows.iter().map(|(value, _)| self.text[value.index()].text.as_str()).collect();
            let inline = format!("_vector({})", rows.join(", "));
            match inline.len() > MAX_LINE {
                true => format!(
                    "_vector(\n{}{indent})",
                    rows.iter().map(|row| format!("{indent}    {row},\n")).collect::<String>()
                ),
                false => inline,
            }
        };
        let returns = results.iter().map(vector).collect::<Vec<_>>().join(", ");
        self.defined(name, doc, arguments, results.len(), &format!("{body}{indent}return {returns}\n"))
    }

    /// The function with its arguments taken apart.
    fn defined(&self, name: &str, doc: &str, arguments: &[Argument], results: usize, body: &str) -> String {
        let has_regimes = arguments.iter().any(|argument| argument.name == "q");
        let list = |each: &dyn Fn(&Argument) -> String| arguments.iter().map(each).collect::<Vec<_>>().join(", ");
        let parameters = list(&|argument| match (self.dialect, argument.name) {
            (Dialect::Sympy, name) => format!("{name}={name}"),
            (Dialect::Numpy | Dialect::Jax, "p") if !has_regimes => "p=DEFAULTS".into(),
            (_, name) => name.into(),
        });
        let symbolic = if self.dialect == Dialect::Casadi { "_" } else { "" };
        let mut out = format!("\n\ndef {symbolic}{name}({parameters}):\n    \"\"\"{doc}\"\"\"\n");
        let all = list(&|argument| argument.name.into());
        match self.dialect {
            Dialect::Numpy | Dialect::Jax => {
                let library = self.spelling.library;
                out += &format!("    {all} = ({library}.asarray(one, dtype=float) for one in ({all}))\n");
            }
            Dialect::Sympy => {
                out += &format!("    {all} = (sp.sympify(one) for one in ({all}))\n");
            }
            Dialect::Casadi => {}
        }
        let apart: Vec<&Argument> = arguments.iter().filter(|argument| argument.name != "t").collect();
        let names = |argument: &&Argument| tuple(argument.rows.iter().map(|(_, name)| name.clone()));
        let groups: Vec<String> = apart.iter().map(names).collect();
        let whole: Vec<&str> = apart.iter().map(|argument| argument.name).collect();
        out += &format!("    {} = {}\n", groups.join(", "), whole.join(", "));
        if self.dialect == Dialect::Numpy {
            out += "    with np.errstate(all=\"ignore\"):\n";
        }
        out += body;
        if self.dialect == Dialect::Casadi {
            out += &self.symbolic(name, arguments, results);
        }
        out
    }

    /// The `casadi.Function` that is made of a function of symbols.
    fn symbolic(&self, name: &str, arguments: &[Argument], results: usize) -> String {
        let names: Vec<String> = arguments.iter().map(|argument| format!("{:?}", argument.name)).collect();
        let symbols = arguments.iter().map(|argument| match argument.name {
            "t" => "    \"t\",\n".to_string(),
            _ => format!("    {},\n", tuple(argument.rows.iter().map(|(_, name)| format!("{name:?}")))),
        });
        let given = match (name, results) {
            ("f", _) => "\"dx\", \"y\"",
            ("start", 1) => "\"x\"",
            ("start", _) => "\"x\", \"q\"",
            _ => "\"q_next\"",
        };
        let symbols: String = symbols.collect();
        format!("\n\n{name} = _made({name:?}, _{name}, [\n{symbols}], [{}], [{given}])\n", names.join(", "))
    }

    fn expression(&mut self, op: Op) -> Text {
        let spelling = self.spelling;
        if let Some(x) = sign_of(op, |value| self.ops[value.index()]) {
            return Text::atom(spelling.call("sign", &[&self.text[x.index()].text]));
        }
        let t = |value: Value| self.text[value.index()].text.as_str();
        let within = |value: Value, level: Level| self.text[value.index()].within(level);
        let two = |a: Value, sign: &str, b: Value, level: Level, right: Level| Text {
            text: format!("{} {sign} {}", within(a, level), within(b, right)),
            level,
        };
        let written = |template: &str, operands: &[&str]| Text::atom(spelling.write(template, operands));
        let compared = |a: Value, sign: &str, b: Value| Text {
            text: format!("{} {sign} {}", within(a, SUM), within(b, SUM)),
            level: COMPARISON,
        };
        match op {
            Op::Real(bits) => spelling.real(f64::from_bits(bits)),
            Op::Int(n) => written(spelling.int, &[&(n as u64).to_string()]),
            Op::Bool(truth) => written(spelling.truths[usize::from(truth)], &[]),
            Op::Load(slot) => {
                let name = self.loads.get(&slot).unwrap_or_else(|| panic!("slot {} is no argument", slot.0));
                Text::atom(name.clone())
            }
            Op::Pool { base, len, index } => {
                let int = |n: usize| spelling.write(spelling.int, &[&n.to_string()]);
                let (first, last) = (int(base as usize - self.tables), int(len as usize - 1));
                written("POOL[{0} + @.minimum({1}, {2})]", &[&first, t(index), &last])
            }
            Op::Add(a, b) => two(a, "+", b, SUM, PRODUCT),
            Op::Sub(a, b) => two(a, "-", b, SUM, PRODUCT),
            Op::Mul(a, b) => two(a, "*", b, PRODUCT, SIGN),
            Op::Div(a, b) => two(a, "/", b, PRODUCT, SIGN),
            Op::Neg(a) => Text { text: format!("-{}", within(a, ATOM)), level: SIGN },
            Op::Abs(a) => written(spelling.abs, &[t(a)]),
            Op::Sqrt(a) => Text::atom(spelling.call("sqrt", &[t(a)])),
            Op::Fma(a, b, c) => Text {
                text: format!("{} * {} + {}", within(a, PRODUCT), within(b, SIGN), within(c, PRODUCT)),
                level: SUM,
            },
            Op::Floor(a) => Text::atom(spelling.call("floor", &[t(a)])),
            Op::Nearest(a) => written(spelling.nearest, &[&within(a, PRODUCT)]),
            Op::Unary(function, a) => Text::atom(spelling.call(function.row().name, &[t(a)])),
            Op::Binary(function, a, b) => Text::atom(spelling.call(function.row().name, &[t(a), t(b)])),
            Op::Less(a, b) => compared(a, "<", b),
            Op::LessEqual(a, b) => compared(a, "<=", b),
            Op::Equal(a, b) => match spelling.equal {
                Some(template) => written(template, &[t(a), t(b)]),
                None => compared(a, "==", b),
            },
            Op::And(a, b) => written(spelling.and, &[t(a), t(b)]),
            Op::Or(a, b) => written(spelling.or, &[t(a), t(b)]),
            Op::Not(a) => written(spelling.not, &[t(a)]),
            Op::Select(c, a, b) => match self.types[a.index()] {
                Type::Bool => written(spelling.select_truth, &[t(c), t(a), t(b)]),
                Type::Real | Type::Int => written(spelling.select, &[t(c), t(a), t(b)]),
            },
            Op::IntAdd(a, b) => Text::atom(format!("({} + {})", t(a), t(b))),
            Op::IntSub(a, b) => Text::atom(format!("({} - {})", t(a), t(b))),
            Op::IntMul(a, b) => Text::atom(format!("({} * {})", t(a), t(b))),
            Op::IntAnd(a, b) => Text::atom(format!("({} & {})", t(a), t(b))),
            Op::IntOr(a, b) => Text::atom(format!("({} | {})", t(a), t(b))),
            Op::IntXor(a, b) => Text::atom(format!("({} ^ {})", t(a), t(b))),
            Op::ShiftLeft(a, n) => {
                Text::atom(format!("({} << {})", t(a), spelling.write(spelling.int, &[&n.to_string()])))
            }
            Op::ShiftRight(a, n) => {
                Text::atom(format!("({} >> {})", t(a), spelling.write(spelling.int, &[&n.to_string()])))
            }
            Op::ToInt(a) => written("@.asarray({0}).astype(@.int64).astype(@.uint64)", &[t(a)]),
            Op::ToReal(a) => written("@.asarray({0}).astype(@.int64).astype(float)", &[t(a)]),
            Op::IntEqual(a, b) => compared(a, "==", b),
            Op::Ring { .. } | Op::ShiftRightSigned(..) | Op::IntLess(..) | Op::ToBits(_) | Op::FromBits(_) => {
                unreachable!("only delays and expanded functions have it")
            }
        }
    }
}

/// A tuple, of several lines if it is long.
fn tuple(all: impl Iterator<Item = String>) -> String {
    let all: Vec<String> = all.collect();
    let mut out = String::from("(");
    let mut line = 4;
    for (k, one) in all.iter().enumerate() {
        if line + one.len() > MAX_LINE {
            out = format!("{}\n        ", out.trim_end());
            line = 8;
        }
        let last = k + 1 == all.len();
        out += &format!(
            "{one}{}",
            if !last {
                ", "
            } else if k == 0 {
                ","
            } else {
                ""
            }
        );
        line += one.len() + 2;
    }
    out + ")"
}
