//! C11 source of a model, readable, and with the bits of every other back end.
//!
//! In: expanded functions and the description of the model. Out: one file that includes only standard headers and
//! compiles without warnings under `gcc -std=c11 -Wall -Wextra -pedantic`. It must be compiled without contraction of
//! products and sums (`-ffp-contract=off`, which `-std=c11` implies with gcc): where the model contracts, `fma` is
//! explicit. A value that is used once is written inline; a value that is used more often, or stored, gets a name.

use crate::ir::hash::{HashMap, HashSet};
use crate::ir::{Func, Op, Type, Value, verify};
use abi::description::{Kind, TINY};
use abi::format::significant;
use abi::unit::Unit;
use abi::{Description, Function, Slot};
use std::collections::BTreeSet;
use std::fmt::Write;

/// Maximum length of an inline expression, in characters.
const MAX_INLINE: usize = 72;

/// The file. `functions`: expanded; `params`: the defaults of the parameters in SI units.
///
/// # Panics
/// If a function does not verify or is not expanded: a mistake of an earlier pass.
pub fn source(functions: &[(Function, Func)], description: &Description, params: &[f64]) -> String {
    written(functions, description, params, Form::Alone).1
}

/// The two files of a model.
pub struct Files {
    /// Their name, without ending.
    pub name: String,
    /// `NAME.c`
    pub source: String,
    /// `NAME.h`: the instance as a struct, whose fields carry unit and range, and the functions.
    pub header: String,
}

/// As [`source`], with a header: functions take the instance in place of its block.
///
/// # Panics
/// As [`source`].
pub fn files(functions: &[(Function, Func)], description: &Description, params: &[f64]) -> Files {
    let (names, source) = written(functions, description, params, Form::Headed);
    let header = header(functions, description, &names);
    Files { name: names.prefix, source, header }
}

/// What functions take.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Form {
    /// The block.
    Alone,
    /// The instance, which a header declares.
    Headed,
}

impl Form {
    /// The first parameter of each function.
    fn parameter(self, prefix: &str) -> String {
        match self {
            Form::Alone => "double *block".into(),
            Form::Headed => format!("{prefix}_t *m"),
        }
    }

    /// The first line of each function.
    fn begin(self, used: bool) -> &'static str {
        match (self, used) {
            (Form::Alone, true) => "",
            (Form::Alone, false) => "    (void)block;\n",
            (Form::Headed, true) => "    double *const block = m->block;\n",
            (Form::Headed, false) => "    (void)m;\n",
        }
    }
}

fn written(functions: &[(Function, Func)], description: &Description, params: &[f64], form: Form) -> (Names, String) {
    let names = Names::new(description);
    let mut helpers = BTreeSet::new();
    let mut tables = BTreeSet::new();
    let mut bodies = String::new();
    for (function, func) in functions {
        let mut writer = Writer::new(func, &names, &mut helpers, &mut tables);
        bodies += &writer.function(*function, form);
    }
    let mut out = heading(description, &names, timeless(functions), form);
    if form == Form::Headed {
        out += &same_layout(&names);
    }
    for helper in &helpers {
        out += &format!("\n{}\n", helper.source());
    }
    for (base, len) in &tables {
        let entries = &description.pool[*base as usize..(base + len) as usize];
        out += &format!("\nstatic const double {}[{len}] = {{\n", table(*base, *len));
        for row in entries.chunks(4) {
            let row: Vec<String> = row.iter().map(|entry| real(*entry)).collect();
            out += &format!("    {},\n", row.join(", "));
        }
        out += "};\n";
    }
    let prefix = &names.prefix;
    let parameter = form.parameter(prefix);
    if form == Form::Alone {
        for (function, _) in functions {
            out += &format!("\nuint64_t {};", signature(prefix, *function, form));
        }
        out += &format!("\nvoid {prefix}_defaults({parameter});\n");
    }
    out += &format!("\n/* Zeros, and the defaults of the parameters. */\nvoid {prefix}_defaults({parameter})\n{{\n");
    out += form.begin(true);
    out += &format!("    for (int k = 0; k < {}; k++) block[k] = 0.0;\n", names.count());
    for (k, value) in params.iter().enumerate() {
        out += &format!("    block[{}] = {};\n", names.slot(description.layout.params.slot(k)), real(*value));
    }
    let out = out + "}\n" + &bodies;
    (names, out)
}

/// Whether no step stores the time.
fn timeless(functions: &[(Function, Func)]) -> bool {
    let step = functions.iter().find(|(function, _)| *function == Function::Step);
    step.is_some_and(|(_, func)| func.stores.iter().all(|(slot, _)| *slot != Slot::TIME))
}

/// The purpose of a function, for a comment in the file.
fn purpose(function: Function) -> &'static str {
    match function {
        Function::Start => "Parameters and inputs -> states, memory and regimes at t = 0.",
        Function::Outputs => "-> outputs.",
        Function::Derivatives => "-> derivatives.",
        Function::Jacobian => "-> derivatives of the derivatives by the states, row by row, then by time.",
        Function::Roots => "-> switching surfaces.",
        Function::Tick => "Runs the sampled blocks that are due.",
        Function::Transitions => "One transition of each automaton, events and resets.",
        Function::Step => {
            "Up to count fixed steps, with their ticks, transitions, outputs and guards.\n   \
             Returns 0, or the number of the guard that stopped it."
        }
        Function::Rosenbrock => {
            "Tries an adaptive step. Returns 0 if it is settled, 1 where the elimination met too small a pivot,\n   \
             2 where somebody has to look at it."
        }
    }
}

fn signature(prefix: &str, function: Function, form: Form) -> String {
    let parameter = form.parameter(prefix);
    match function {
        Function::Step => format!("{prefix}_step({parameter}, uint64_t count)"),
        other => format!("{prefix}_{}({parameter})", other.name()),
    }
}

/// The header: the instance and the functions.
fn header(functions: &[(Function, Func)], description: &Description, names: &Names) -> String {
    let prefix = &names.prefix;
    let guard = format!("{}_H", prefix.to_uppercase());
    let mut out = format!(
        "/* {}\n\n   All numbers are in SI units. To begin:\n\n     {prefix}_t m;\n     {prefix}_defaults(&m);\n     \
         m.h = 0.001;                 the step in s, and parameters that differ\n     {prefix}_start(&m);\n\n   \
         then at each step: set the inputs, call {prefix}_step(&m, 1), read the outputs.\n   \
         Compile {prefix}.c with -std=c11 or -ffp-contract=off, without -ffast-math, and link with -lm: then every bit\n   \
         is that of the simulation. */\n",
        comment(&description.name),
    );
    out += &format!("#ifndef {guard}\n#define {guard}\n\n#include <stdint.h>\n\n");
    out += "#ifdef __cplusplus\nextern \"C\" {\n#endif\n\n";
    out += "/* An instance: its numbers by name, and as the block that the functions work on. */\n";
    out += "typedef union {\n    struct {\n";
    let notes = notes(description, timeless(functions), true);
    let fields = fields(names, &notes);
    let width = fields.iter().map(|(field, _)| field.len()).max().unwrap_or(0);
    for (field, note) in &fields {
        match note {
            Some(note) => writeln!(out, "        double {field:<width$}  /* {note} */"),
            None => writeln!(out, "        double {field}"),
        }
        .expect("writing to a string does not fail");
    }
    out += &format!("    }};\n    double block[{}];\n}} {prefix}_t;\n\n", names.slots.len());
    out += &format!("/* Zeros, and the defaults of the parameters. */\nvoid {prefix}_defaults({prefix}_t *m);\n");
    for (function, _) in functions {
        let comment = purpose(*function);
        out += &format!("\n/* {comment} */\nuint64_t {};\n", signature(prefix, *function, Form::Headed));
    }
    let has_step = functions.iter().any(|(function, _)| *function == Function::Step);
    if has_step && !description.guards.is_empty() {
        out += "\n/* What a step returns: the number of the first quantity that is not finite or has left its range.\n";
        for (k, guard) in description.guards.iter().enumerate() {
            let range = range(guard.range).unwrap_or_else(|| "finite".into());
            let unit = Unit::si(guard.unit.dimension).text;
            let unit = if unit.is_empty() || range == "finite" { String::new() } else { format!(" {unit}") };
            out += &format!("   {:>4}  {}: {range}{unit}\n", k + 1, comment(&guard.path));
        }
        out += "*/\n";
    }
    out + "\n#ifdef __cplusplus\n}\n#endif\n\n#endif\n"
}

/// A range in SI units in words; `None` if it is open.
pub(super) fn range((low, high): (f64, f64)) -> Option<String> {
    let number = |x: f64| if x.abs() == TINY { "0".to_string() } else { significant(x, 6) };
    Some(match (low.is_finite(), high.is_finite()) {
        (true, true) => format!("{} .. {}", number(low), number(high)),
        (true, false) if low == TINY => "above 0".into(),
        (true, false) => format!("from {}", number(low)),
        (false, true) if high == -TINY => "below 0".into(),
        (false, true) => format!("up to {}", number(high)),
        (false, false) => return None,
    })
}

/// The fields of the struct with their notes; runs of slots without a name are arrays.
fn fields(names: &Names, notes: &HashMap<Slot, String>) -> Vec<(String, Option<String>)> {
    let mut out = Vec::new();
    let mut at = 0;
    while at < names.slots.len() {
        let nameless = |at: usize| names.nameless.get(at).copied().unwrap_or(false);
        let run = (at..names.slots.len()).take_while(|&at| nameless(at)).count();
        if run > 1 {
            out.push((format!("memory_{at}[{run}];"), None));
            at += run;
            continue;
        }
        out.push((format!("{};", field(names, at)), notes.get(&Slot(at as u32)).cloned()));
        at += 1;
    }
    out
}

/// An assertion for the C compiler that the last named field lies where the functions look for it.
fn same_layout(names: &Names) -> String {
    let named = |at: &usize| !names.nameless[*at];
    let Some(last) = (0..names.slots.len()).rev().find(named) else { return String::new() };
    let (prefix, slot) = (&names.prefix, &names.slots[last]);
    let field = field(names, last);
    format!(
        "\n_Static_assert(offsetof({prefix}_t, {field}) == {slot} * sizeof(double), \"the struct is the block\");\n"
    )
}

/// The name of a field.
fn field(names: &Names, at: usize) -> String {
    let name = &names.slots[at][names.prefix.len() + 1..];
    if RESERVED.contains(&name) { format!("{name}_") } else { name.to_string() }
}

/// Words of C and C++ that no field may have as its name.
const RESERVED: [&str; 62] = [
    "auto",
    "break",
    "case",
    "char",
    "const",
    "continue",
    "default",
    "do",
    "double",
    "else",
    "enum",
    "extern",
    "float",
    "for",
    "goto",
    "if",
    "inline",
    "int",
    "long",
    "register",
    "restrict",
    "return",
    "short",
    "signed",
    "sizeof",
    "static",
    "struct",
    "switch",
    "typedef",
    "union",
    "unsigned",
    "void",
    "volatile",
    "while",
    "and",
    "bool",
    "catch",
    "class",
    "delete",
    "explicit",
    "export",
    "false",
    "friend",
    "mutable",
    "namespace",
    "new",
    "not",
    "operator",
    "or",
    "private",
    "protected",
    "public",
    "template",
    "this",
    "throw",
    "true",
    "try",
    "typename",
    "using",
    "virtual",
    "xor",
    "block",
];

/// Notes on the slots of a block; `ranges`: with their ranges.
fn notes(description: &Description, timeless: bool, ranges: bool) -> HashMap<Slot, String> {
    let mut notes: HashMap<Slot, String> = HashMap::default();
    for quantity in &description.quantities {
        let doc = quantity.doc.as_ref().and_then(|doc| doc.lines().next()).unwrap_or_default();
        let unit = if quantity.boolean { "true 1, false 0".into() } else { Unit::si(quantity.unit.dimension).text };
        let range = range(quantity.range).filter(|_| ranges && !quantity.boolean).unwrap_or_default();
        let what = [kind(quantity.kind), &unit, &range, doc].map(str::trim).into_iter().filter(|part| !part.is_empty());
        notes.entry(quantity.slot).or_insert_with(|| comment(&what.collect::<Vec<_>>().join(", ")));
    }
    let time = if timeless { "time, s: for you to keep, no equation reads it" } else { "time, s" };
    for (slot, note) in [(Slot::TIME, time), (Slot::STEP, "fixed step, s"), (Slot::COUNT, "steps since the start")] {
        notes.insert(slot, note.into());
    }
    notes
}

/// The head of the file: how to use the code, and the layout of the block. `timeless`: no step stores the time.
fn heading(description: &Description, names: &Names, timeless: bool, form: Form) -> String {
    let prefix = &names.prefix;
    let mut out = match form {
        Form::Headed => format!("/* {}: see {prefix}.h */\n", comment(&description.name)),
        Form::Alone => format!(
            "/* {}\n\n   The numbers of an instance lie in a block of {} doubles, SI units, at the places named below.\n   \
         To begin: {prefix}_defaults(block), set what differs, block[{}] = step in s, {prefix}_start(block).\n   \
         Compile with -std=c11 or -ffp-contract=off, and without -ffast-math: then every bit is that of the\n   \
         simulation. Link with -lm. */\n",
            comment(&description.name),
            description.layout.size(),
            names.slot(Slot::STEP),
        ),
    };
    if form == Form::Headed {
        out += &format!("#include \"{prefix}.h\"\n");
    }
    if form == Form::Headed {
        out += "#include <stddef.h>\n";
    }
    out += "#include <float.h>\n#include <math.h>\n#include <stdint.h>\n#include <string.h>\n\n";
    out += "#ifdef __FAST_MATH__\n#error \"-ffast-math would change the results\"\n#endif\n";
    out += "#if FLT_EVAL_METHOD != 0\n#error \"doubles must be computed as doubles\"\n#endif\n";
    out += "\n/* Places of the block. */\nenum {\n";
    let notes = notes(description, timeless, false);
    let width = names.slots.iter().map(String::len).max().unwrap_or(0);
    for (at, name) in names.slots.iter().enumerate() {
        let notes = notes.get(&Slot(at as u32));
        match notes {
            Some(notes) => writeln!(out, "    {name:<width$} = {at},  /* {notes} */"),
            None => writeln!(out, "    {name:<width$} = {at},"),
        }
        .expect("writing to a string does not fail");
    }
    out += &format!("    {:<width$} = {}\n}};\n", names.count(), names.slots.len());
    out
}

fn kind(kind: Kind) -> &'static str {
    match kind {
        Kind::Param => "parameter",
        Kind::Input => "input",
        Kind::State => "state",
        Kind::SampledState => "sampled state",
        Kind::Output => "output",
        Kind::Let | Kind::Observed => "",
        Kind::Regime => "regime",
    }
}

/// Text without the markers that begin or end a C comment.
pub(super) fn comment(text: &str) -> String {
    text.replace("*/", "* /").replace("/*", "/ *").replace(['\n', '\r'], " ")
}

/// C names of the slots of a block, and the prefix of all functions.
struct Names {
    prefix: String,
    slots: Vec<String>,
    /// Which of them belong to no quantity.
    nameless: Vec<bool>,
}

impl Names {
    fn new(description: &Description) -> Names {
        let model: String = description.name.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
        let prefix = match identifier(&model).to_lowercase() {
            name if name.starts_with(|c: char| c.is_ascii_alphabetic()) => name,
            name => format!("model_{name}"),
        };
        let layout = &description.layout;
        let mut wanted: Vec<Option<String>> = vec![None; layout.size()];
        for (slot, name) in [(Slot::TIME, "t"), (Slot::STEP, "h"), (Slot::COUNT, "steps")] {
            wanted[slot.index()] = Some(name.into());
        }
        for quantity in &description.quantities {
            wanted[quantity.slot.index()].get_or_insert_with(|| identifier(&quantity.path));
        }
        for (k, state) in layout.states.range().enumerate() {
            let rate = (k < layout.derivatives.len as usize).then(|| layout.derivatives.slot(k));
            if let Some((rate, name)) = rate.zip(wanted[state].clone()) {
                wanted[rate.index()] = Some(format!("d_{name}"));
            }
        }
        // Different paths may have become the same identifier.
        let mut taken = HashSet::from_iter(["slots".to_string()]);
        let name = |(at, wanted): (usize, Option<String>)| {
            let wanted = wanted.unwrap_or_else(|| format!("slot_{at}"));
            let name = if taken.contains(&wanted) { format!("{wanted}_{at}") } else { wanted };
            taken.insert(name.clone());
            format!("{}_{name}", prefix.to_uppercase())
        };
        let nameless = wanted.iter().map(Option::is_none).collect();
        let slots = wanted.into_iter().enumerate().map(name).collect();
        Names { prefix, slots, nameless }
    }

    fn slot(&self, slot: Slot) -> &str {
        &self.slots[slot.index()]
    }

    fn count(&self) -> String {
        format!("{}_slots", self.prefix.to_uppercase())
    }

    /// Name of the variable for the next value of a slot.
    fn next(&self, slot: Slot) -> String {
        self.slots[slot.index()].replacen(&self.prefix.to_uppercase(), "new", 1)
    }
}

/// A C identifier: ASCII letters and digits stay, Greek letters are spelled out, all others become underscores.
pub(super) fn identifier(path: &str) -> String {
    const GREEK: [(char, &str); 12] = [
        ('α', "alpha"),
        ('β', "beta"),
        ('γ', "gamma"),
        ('δ', "delta"),
        ('θ', "theta"),
        ('λ', "lambda"),
        ('μ', "mu"),
        ('µ', "mu"),
        ('σ', "sigma"),
        ('τ', "tau"),
        ('φ', "phi"),
        ('ω', "omega"),
    ];
    let spelled = path.chars().map(|c| match GREEK.iter().find(|(letter, _)| *letter == c) {
        Some((_, name)) => (*name).to_string(),
        None if c.is_ascii_alphanumeric() => c.to_string(),
        None => "_".into(),
    });
    let joined: String = spelled.collect();
    let name = joined.split('_').filter(|part| !part.is_empty()).collect::<Vec<_>>().join("_");
    if name.is_empty() { "x".into() } else { name }
}

/// The C literal of a real.
fn real(x: f64) -> String {
    match x {
        x if x.is_nan() => "(double)NAN".into(),
        f64::INFINITY => "(double)INFINITY".into(),
        f64::NEG_INFINITY => "(-(double)INFINITY)".into(),
        x if x.is_sign_negative() => format!("({x:?})"),
        x => format!("{x:?}"),
    }
}

fn table(base: u32, len: u32) -> String {
    format!("table_{base}_{len}")
}

/// C functions that are emitted only if the code calls them.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Helper {
    ToBits,
    FromBits,
    ToInt,
    ToReal,
    ShiftSigned,
    Less,
    Entry,
    Inside,
}

impl Helper {
    fn source(self) -> &'static str {
        match self {
            Helper::ToBits => {
                "static inline uint64_t bits_of(double x)\n{\n    uint64_t n;\n    memcpy(&n, &x, sizeof n);\n    return n;\n}"
            }
            Helper::FromBits => {
                "static inline double real_of(uint64_t n)\n{\n    double x;\n    memcpy(&x, &n, sizeof x);\n    return x;\n}"
            }
            Helper::ToInt => {
                "/* Towards zero; what is too large the nearest integer, NaN 0. */\n\
                 static inline uint64_t truncated(double x)\n{\n    if (!(x < 9223372036854775808.0)) return x > 0.0 ? \
                 UINT64_C(0x7fffffffffffffff) : 0;\n    if (x < -9223372036854775808.0) return \
                 UINT64_C(0x8000000000000000);\n    return (uint64_t)(int64_t)x;\n}"
            }
            Helper::ToReal => {
                "static inline double as_real(uint64_t n)\n{\n    int64_t s;\n    memcpy(&s, &n, sizeof s);\n    return \
                 (double)s;\n}"
            }
            Helper::ShiftSigned => {
                "/* To the right, the sign comes in; 0 <= by <= 63. */\n\
                 static inline uint64_t shifted(uint64_t n, int by)\n{\n    return n >> 63 ? ~(~n >> by) : n >> by;\n}"
            }
            Helper::Less => {
                "/* As signed integers. */\nstatic inline int is_less(uint64_t a, uint64_t b)\n{\n    const uint64_t \
                 sign = UINT64_C(1) << 63;\n    return (a ^ sign) < (b ^ sign);\n}"
            }
            Helper::Inside => {
                "/* What is beyond the last is the last. */\nstatic inline uint64_t inside(uint64_t last, uint64_t k)\n{\n    \
                 return k < last ? k : last;\n}"
            }
            Helper::Entry => {
                "/* What is beyond the last entry is the last. */\n\
                 static inline double entry(const double *table, uint64_t last, uint64_t k)\n{\n    return table[k < \
                 last ? k : last];\n}"
            }
        }
    }
}

/// Generates one C function.
struct Writer<'a> {
    func: &'a Func,
    names: &'a Names,
    types: Vec<Type>,
    uses: Vec<usize>,
    /// Names of values that are stored.
    stored: HashMap<Value, String>,
    /// Values that always get a name: those written to rings, which must be computed before anything is stored, and
    /// those that gcc miscompiles or warns about when they are inline.
    always_named: HashSet<Value>,
    /// The text for each value where it is used.
    text: Vec<String>,
    helpers: &'a mut BTreeSet<Helper>,
    tables: &'a mut BTreeSet<(u32, u32)>,
}

impl<'a> Writer<'a> {
    fn new(
        func: &'a Func,
        names: &'a Names,
        helpers: &'a mut BTreeSet<Helper>,
        tables: &'a mut BTreeSet<(u32, u32)>,
    ) -> Writer<'a> {
        let types = verify::types(func).expect("the function is sound");
        let mut uses = vec![0; func.ops.len()];
        for (op, live) in func.ops.iter().zip(func.live()) {
            if live {
                op.each_operand(|operand| uses[operand.index()] += 1);
            }
        }
        let mut stored = HashMap::default();
        for (slot, value) in &func.stores {
            stored.entry(*value).or_insert_with(|| names.next(*slot));
        }
        let written = func.writes.iter().flat_map(|write| [write.index, write.value]);
        // gcc 12 turns `0.0 - x` into `-x` where it sees that x is never −0, as with `fabs(y)` or `c ? 1.0 : 0.0`; for
        // x = 0 that returns −0. It also warns about `71 == (2 & n)`, which is always false. It does not see through a
        // named variable.
        let op = |value: Value| func.ops[value.index()];
        let misread_by_gcc = func.ops.iter().flat_map(|of| match *of {
            Op::Sub(a, b) if op(a) == Op::Real(0.0f64.to_bits()) => vec![b],
            Op::IntEqual(a, b) => {
                let masked = |value: &Value| matches!(op(*value), Op::IntAnd(..) | Op::IntOr(..));
                [a, b].into_iter().filter(masked).collect()
            }
            _ => Vec::new(),
        });
        let always_named = written.chain(misread_by_gcc).collect();
        Writer {
            func,
            names,
            types,
            uses,
            stored,
            always_named,
            text: vec![String::new(); func.ops.len()],
            helpers,
            tables,
        }
    }

    fn function(&mut self, function: Function, form: Form) -> String {
        let repeated = function == Function::Step;
        let indent = if repeated { "        " } else { "    " };
        let mut body = String::new();
        let live = self.func.live();
        for i in (0..self.func.ops.len()).filter(|i| live[*i]) {
            let (value, op) = (Value(i as u32), self.func.ops[i]);
            let written = self.expression(op);
            let constant = matches!(op, Op::Real(_) | Op::Int(_) | Op::Bool(_));
            let is_used_once = self.uses[i] == 1 || self.uses[i] == 0 && self.func.status == Some(value);
            let named = self.stored.contains_key(&value) || self.always_named.contains(&value);
            let short = is_used_once && written.len() <= MAX_INLINE && !named;
            self.text[i] = if constant {
                written
            } else if short || matches!(op, Op::Load(_)) && !named {
                match op {
                    Op::Load(_) | Op::Pool { .. } | Op::Ring { .. } => written,
                    _ if written.ends_with(')') && is_call(&written) => written,
                    _ => format!("({written})"),
                }
            } else {
                let of = match self.types[i] {
                    Type::Real => "double",
                    Type::Int => "uint64_t",
                    Type::Bool => "int",
                };
                let name = self.stored.get(&value).cloned().unwrap_or_else(|| format!("v{i}"));
                writeln!(body, "{indent}const {of} {name} = {written};").expect("writing to a string does not fail");
                name
            };
        }
        let status = self.func.status.map(|status| self.text[status.index()].clone());
        if let Some(status) = &status {
            // Before the stores: the status depends on the values before them.
            writeln!(body, "{indent}const uint64_t status = {status};").expect("writing to a string does not fail");
        }
        for (slot, value) in &self.func.stores {
            let (slot, value) = (self.names.slot(*slot), &self.text[value.index()]);
            writeln!(body, "{indent}block[{slot}] = {value};").expect("writing to a string does not fail");
        }
        for write in &self.func.writes {
            self.helpers.insert(Helper::Inside);
            let (base, last) = (self.names.slot(write.base), write.len - 1);
            let [index, value] = [write.index, write.value].map(|value| &self.text[value.index()]);
            writeln!(body, "{indent}block[{base} + inside({last}, {index})] = {value};")
                .expect("writing to a string does not fail");
        }
        let mut out =
            format!("\n/* {} */\nuint64_t {}\n{{\n", purpose(function), signature(&self.names.prefix, function, form));
        out += form.begin(body.contains("block"));
        match (repeated, status.is_some()) {
            (true, true) => {
                out += &format!(
                    "    for (; count; count--) {{\n{body}{indent}if (status) return status;\n    }}\n    return 0;\n"
                )
            }
            (true, false) => out += &format!("    for (; count; count--) {{\n{body}    }}\n    return 0;\n"),
            (false, true) => out += &format!("{body}    return status;\n"),
            (false, false) => out += &format!("{body}    return 0;\n"),
        }
        out + "}\n"
    }

    fn call_helper(&mut self, helper: Helper, call: String) -> String {
        self.helpers.insert(helper);
        call
    }

    fn expression(&mut self, op: Op) -> String {
        let t = |value: Value| self.text[value.index()].clone();
        match op {
            Op::Real(bits) => real(f64::from_bits(bits)),
            Op::Int(n) => format!("UINT64_C({})", n as u64),
            Op::Bool(truth) => u8::from(truth).to_string(),
            Op::Load(slot) => format!("block[{}]", self.names.slot(slot)),
            Op::Pool { base, len, index } => {
                let (table, index) = (table(base, len), t(index));
                self.tables.insert((base, len));
                self.call_helper(Helper::Entry, format!("entry({table}, {}, {index})", len - 1))
            }
            Op::Ring { base, len, index } => {
                let (base, index) = (self.names.slot(base), t(index));
                self.call_helper(Helper::Entry, format!("entry(block + {base}, {}, {index})", len - 1))
            }
            Op::Add(a, b) | Op::IntAdd(a, b) => format!("{} + {}", t(a), t(b)),
            Op::Sub(a, b) | Op::IntSub(a, b) => format!("{} - {}", t(a), t(b)),
            Op::Mul(a, b) | Op::IntMul(a, b) => format!("{} * {}", t(a), t(b)),
            Op::Div(a, b) => format!("{} / {}", t(a), t(b)),
            Op::Neg(a) => format!("-{}", t(a)),
            Op::Abs(a) => format!("fabs({})", without_parentheses(&t(a))),
            Op::Sqrt(a) => format!("sqrt({})", without_parentheses(&t(a))),
            Op::Fma(a, b, c) => format!(
                "fma({}, {}, {})",
                without_parentheses(&t(a)),
                without_parentheses(&t(b)),
                without_parentheses(&t(c))
            ),
            Op::Floor(a) => format!("floor({})", without_parentheses(&t(a))),
            Op::Nearest(a) => format!("nearbyint({})", without_parentheses(&t(a))),
            Op::Unary(..) | Op::Binary(..) => unreachable!("elementary functions are expanded"),
            Op::Less(a, b) => format!("{} < {}", t(a), t(b)),
            Op::LessEqual(a, b) => format!("{} <= {}", t(a), t(b)),
            Op::Equal(a, b) | Op::IntEqual(a, b) => format!("{} == {}", t(a), t(b)),
            Op::And(a, b) | Op::IntAnd(a, b) => format!("{} & {}", t(a), t(b)),
            Op::Or(a, b) | Op::IntOr(a, b) => format!("{} | {}", t(a), t(b)),
            Op::IntXor(a, b) => format!("{} ^ {}", t(a), t(b)),
            Op::Not(a) => format!("!{}", t(a)),
            Op::Select(a, b, c) => format!("{} ? {} : {}", t(a), t(b), t(c)),
            Op::ShiftLeft(a, n) => format!("{} << {n}", t(a)),
            Op::ShiftRight(a, n) => format!("{} >> {n}", t(a)),
            Op::ShiftRightSigned(a, n) => {
                let call = format!("shifted({}, {n})", without_parentheses(&t(a)));
                self.call_helper(Helper::ShiftSigned, call)
            }
            Op::IntLess(a, b) => {
                let call = format!("is_less({}, {})", without_parentheses(&t(a)), without_parentheses(&t(b)));
                self.call_helper(Helper::Less, call)
            }
            Op::ToBits(a) => {
                let call = format!("bits_of({})", without_parentheses(&t(a)));
                self.call_helper(Helper::ToBits, call)
            }
            Op::FromBits(a) => {
                let call = format!("real_of({})", without_parentheses(&t(a)));
                self.call_helper(Helper::FromBits, call)
            }
            Op::ToInt(a) => {
                let call = format!("truncated({})", without_parentheses(&t(a)));
                self.call_helper(Helper::ToInt, call)
            }
            Op::ToReal(a) => {
                let call = format!("as_real({})", without_parentheses(&t(a)));
                self.call_helper(Helper::ToReal, call)
            }
        }
    }
}

/// Whether an expression is a single call.
fn is_call(text: &str) -> bool {
    let Some(open) = text.find('(') else { return false };
    open > 0
        && text[..open].chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
        && closing_parenthesis(text, open) == Some(text.len() - 1)
}

/// An expression without parentheses around the whole, for use as an argument.
fn without_parentheses(text: &str) -> &str {
    if text.starts_with('(') && closing_parenthesis(text, 0) == Some(text.len() - 1) {
        &text[1..text.len() - 1]
    } else {
        text
    }
}

/// The position of the parenthesis that closes the one at `open`.
fn closing_parenthesis(text: &str, open: usize) -> Option<usize> {
    let mut depth = 0;
    text.bytes().enumerate().skip(open).find_map(|(at, byte)| {
        depth += match byte {
            b'(' => 1,
            b')' => -1,
            _ => 0,
        };
        (depth == 0).then_some(at)
    })
}
