//! The model under test: its source, its instance, its ports.
//!
//! In: a model's name with arguments and where to look for it. Out: a [`Subject`], or why it cannot be tested.

use crate::compile::{Loaded, Lookup, Space};
use crate::equations::{self, expression};
use abi::Instance;
use abi::description::Kind;
use abi::unit::{Dimension, Unit};
use grammar::ast::{self, BindValue, DeclarationKind, Item, Statement};
use grammar::span::FileId;

/// Where a model comes from.
#[derive(Clone, PartialEq, Debug)]
pub enum Origin {
    /// The library.
    Library,
    /// A user's file: its path as the battery imports it.
    File(String),
}

/// A model under test.
#[derive(Clone, Debug)]
pub struct Subject {
    /// The model's name: `LuGre`.
    pub model: String,
    /// The argument for a bench's slot: `LuGre(vd = 10 mm/s)`, with `rotary` if the user wrote it.
    pub instance: Written,
    /// The source of its text.
    pub origin: Origin,
    /// The lines before the first experiment of the battery.
    pub imports: String,
    /// Doc comment.
    pub doc: Option<String>,
    /// Equations, in symbols.
    pub equations: Vec<(String, String)>,
    /// Whether velocities are angular.
    pub rotary: bool,
    /// Whether it has an input for the external force, and whether it requires it.
    pub external: External,
    /// Inputs other than the velocity and the external force, each with the value at which it is held, as written.
    pub held: Vec<(String, String)>,
    /// Its parameters with the values of this instance.
    pub params: Vec<Param>,
    /// Number of continuous states.
    pub states: usize,
    pub regimes: Vec<String>,
    /// Regimes of its own, without those of its parts.
    pub own_regimes: Vec<String>,
    /// The shortest period of its sampled code, in s.
    pub period: Option<f64>,
}

/// The port `F_ext`.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum External {
    /// The model has none.
    Absent,
    /// It has a default.
    Optional,
    /// It must be given.
    Required,
}

/// A parameter and its value.
#[derive(Clone, PartialEq, Debug)]
pub struct Param {
    /// Path, such as `Fc` or `law.Fc`.
    pub path: String,
    /// In SI.
    pub value: f64,
    /// The declared unit.
    pub unit: Unit,
    /// The declared range, as in the text: `> 0`; may be empty.
    pub range: String,
    /// Doc comment.
    pub doc: Option<String>,
}

/// An instance as text, with replaceable arguments.
#[derive(Clone, PartialEq, Debug)]
pub struct Written {
    rotary: bool,
    model: String,
    args: Vec<(String, Argument)>,
}

#[derive(Clone, PartialEq, Debug)]
enum Argument {
    Value(String),
    Model(Written),
}

impl Written {
    /// Parses `LuGre`, `LuGre(vd = 10 mm/s)`, `rotary LuGre()`.
    ///
    /// # Errors
    /// What is wrong with it, in words.
    pub fn read(text: &str) -> Result<Written, String> {
        let text = if text.contains('(') { text.trim().to_string() } else { format!("{}()", text.trim()) };
        let (instance, errors) = grammar::parse::parse_instance(FileId(0), &text);
        match (instance, errors.iter().find(|error| error.is_error())) {
            (Some(instance), None) => Ok(Written::of(&instance, &text)),
            (_, Some(error)) => Err(format!("`{text}`: {}", error.message)),
            (None, None) => Err(format!("`{text}` is not a model with arguments, such as `LuGre(Fs = 2 N)`")),
        }
    }

    fn of(instance: &ast::Instance, text: &str) -> Written {
        let argument = |bind: &ast::Bind| {
            let value = match &bind.value {
                BindValue::Instance(instance) => Argument::Model(Written::of(instance, text)),
                BindValue::Expr(_) => {
                    let whole = &text[bind.span.range()];
                    Argument::Value(whole.split_once('=').map_or(whole, |(_, value)| value).trim().into())
                }
            };
            (bind.name.text.clone(), value)
        };
        Written {
            rotary: instance.rotary,
            model: instance.model.text.clone(),
            args: instance.args.iter().map(argument).collect(),
        }
    }

    /// Whether it is written as the rotary twin of a translational model.
    pub fn is_rotary(&self) -> bool {
        self.rotary
    }

    /// The model's name.
    pub fn model(&self) -> &str {
        &self.model
    }

    /// Sets an argument to another value: `Fs`, or `law.Fs` of a part that is an argument itself.
    ///
    /// # Errors
    /// Why the path is wrong, in words.
    pub fn set(&mut self, path: &str, value: &str) -> Result<(), String> {
        match path.split_once('.') {
            None => {
                let value = match value.trim_start().starts_with(|c: char| c.is_ascii_uppercase()) {
                    true => Argument::Model(Written::read(value)?),
                    false => Argument::Value(value.into()),
                };
                match self.args.iter_mut().find(|(name, _)| name == path) {
                    Some((_, old)) => *old = value,
                    None => self.args.push((path.into(), value)),
                }
                Ok(())
            }
            Some((first, rest)) => match self.args.iter_mut().find(|(name, _)| name == first) {
                Some((_, Argument::Model(part))) => part.set(rest, value),
                Some(_) | None => Err(format!(
                    "--set {path}: give the part `{first}` as an argument first, for example '{}({first} = Tustin())'",
                    self.model
                )),
            },
        }
    }

    /// The text with further arguments, unless it has them itself.
    pub fn with(&self, more: &[(&str, &str)]) -> String {
        let mut written = self.clone();
        for (name, value) in more {
            if !written.args.iter().any(|(given, _)| given == name) {
                written.args.push((name.to_string(), Argument::Value(value.to_string())));
            }
        }
        written.to_string()
    }

    /// The model that was passed for a slot.
    fn slot(&self, part: &str) -> Option<&str> {
        self.args.iter().find_map(|(name, argument)| match argument {
            Argument::Model(model) if name == part => Some(model.model.as_str()),
            _ => None,
        })
    }

    /// A short form for legends: without empty parentheses.
    pub fn label(&self) -> String {
        let text = self.to_string();
        text.strip_suffix("()").map_or(text.clone(), str::to_string)
    }
}

impl std::fmt::Display for Written {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}{}(", if self.rotary { "rotary " } else { "" }, self.model)?;
        for (i, (name, value)) in self.args.iter().enumerate() {
            let comma = if i > 0 { ", " } else { "" };
            match value {
                Argument::Value(value) => write!(f, "{comma}{name} = {value}")?,
                Argument::Model(model) => write!(f, "{comma}{name} = {model}")?,
            }
        }
        f.write_str(")")
    }
}

/// A model's syntax tree, if it is visible from the file.
pub fn model<'a>(loaded: &'a Loaded, name: &str) -> Option<(FileId, &'a ast::Model)> {
    match loaded.find(loaded.root(), Space::Type, name) {
        Lookup::Found(item, Item::Model(model)) => Some((item.file, model)),
        Lookup::Found(..) | Lookup::Ambiguous(..) | Lookup::Missing => None,
    }
}

/// The inputs of a model that have no default.
pub fn open_inputs(model: &ast::Model) -> Vec<&str> {
    inputs(model).filter(|(_, optional)| !optional).map(|(name, _)| name).collect()
}

/// Names of the inputs, and whether they have a default.
fn inputs(model: &ast::Model) -> impl Iterator<Item = (&str, bool)> {
    declarations(model)
        .filter(|declaration| declaration.kind == DeclarationKind::Input)
        .map(|declaration| (declaration.name.text.as_str(), declaration.value.is_some()))
}

fn declarations(model: &ast::Model) -> impl Iterator<Item = &ast::Declaration> {
    model.body.iter().filter_map(|statement| match statement {
        Statement::Declaration(declaration) => Some(declaration),
        _ => None,
    })
}

/// Whether a model has an input `v` and an output `F`: the ports of a friction model, without a check of units.
pub fn looks_like_friction(model: &ast::Model) -> bool {
    inputs(model).any(|(name, _)| name == "v")
        && declarations(model).any(|d| d.kind == DeclarationKind::Output && d.name.text == "F")
}

/// The equations of a model, followed by those of its parts, each kind of part once.
pub fn equations(loaded: &Loaded, found: &ast::Model, written: &Written) -> Vec<(String, String)> {
    let mut lines = equations::equations(found);
    let mut told: Vec<&str> = Vec::new();
    for statement in &found.body {
        let Statement::Part(part) = statement else { continue };
        let (slot, own) = (equations::symbol(&part.name.text), &part.instance.model.text);
        let name = written.slot(&part.name.text).unwrap_or(own);
        // A slot shows the model that was passed for it, not the default.
        if let Some((_, right)) = lines.iter_mut().find(|(left, right)| *left == slot && right == own) {
            *right = name.to_string();
        }
        if let Some((_, part)) = model(loaded, name).filter(|_| !told.contains(&name)) {
            told.push(name);
            lines.push((String::new(), String::new()));
            lines.push((format!("{name}:"), String::new()));
            lines.extend(equations::equations(part));
        }
    }
    lines
}

/// How a model uses the external force.
pub fn external(model: &ast::Model) -> External {
    match inputs(model).find(|(name, _)| *name == "F_ext") {
        None => External::Absent,
        Some((_, true)) => External::Optional,
        Some((_, false)) => External::Required,
    }
}

/// The inputs beside `v` and `F_ext`, and the values at which they are held: as given, or their defaults.
pub fn held(loaded: &Loaded, model: &ast::Model, written: &Written) -> Vec<(String, String)> {
    let inputs = declarations(model).filter(|declaration| declaration.kind == DeclarationKind::Input);
    let others = inputs.filter(|declaration| !matches!(declaration.name.text.as_str(), "v" | "F_ext"));
    let value = |declaration: &ast::Declaration| {
        let name = &declaration.name.text;
        let given = written.args.iter().find(|(given, _)| given == name).map(|(_, argument)| match argument {
            Argument::Value(value) => value.clone(),
            Argument::Model(model) => model.to_string(),
        });
        let default =
            || declaration.value.as_ref().map(|value| format!("{} (default)", loaded.files.slice(value.span)));
        Some((name.clone(), given.or_else(default)?))
    };
    others.filter_map(value).collect()
}

/// Checks that the ports of a model are those of a friction model; returns whether it is rotary.
///
/// # Errors
/// Which port does not match, in words.
pub fn rotary(model: &ast::Model, written: &Written, instance: &Instance) -> Result<bool, String> {
    // A connected input is no longer a separate quantity, so its unit is read from the declaration.
    let declared = declarations(model).find(|declaration| declaration.name.text == "v");
    let v = declared.and_then(|v| Unit::parse(&v.unit.as_ref()?.text).ok()).map(|unit| unit.dimension);
    let force = instance.description().quantity("F").map(|quantity| quantity.unit.dimension);
    let unit = |text: &str| Some(Unit::parse(text).expect("it is known").dimension);
    let turned = (v == unit("m/s") && written.rotary, v == unit("rad/s"));
    match (turned, force == unit("N"), force == unit("N·m")) {
        ((false, false), true, _) if v == unit("m/s") => Ok(false),
        ((true, _) | (_, true), _, true) => Ok(true),
        _ => {
            let words = |of: Option<Dimension>| of.map_or("missing".into(), |dimension| dimension.describe());
            let (v, force) = (words(v), words(force));
            Err(format!("`v` is {v} and `F` is {force}; a friction model turns a velocity into a force"))
        }
    }
}

/// The range after `in`, in symbols: `> 0`, `0.01 … 0.99`.
pub fn range(range: &ast::Range) -> String {
    match range {
        ast::Range::Between(low, high) => format!("{} … {}", expression(low), expression(high)),
        ast::Range::Bound(op, limit) => {
            let sign = match op.text() {
                "<=" => "≤",
                ">=" => "≥",
                other => other,
            };
            format!("{sign} {}", expression(limit))
        }
    }
}

/// The parameters of a compiled model and of its parts.
pub fn params(model: &ast::Model, instance: &Instance) -> Vec<Param> {
    let stated = |path: &str| {
        let declaration = declarations(model).find(|declaration| declaration.name.text == path)?;
        Some(declaration.range.as_ref().map_or(String::new(), range))
    };
    let numbers = |quantity: &abi::description::Quantity| {
        let text = |value: f64| crate::quantity::show(value, &quantity.unit, 6);
        match quantity.range {
            (low, high) if low.is_finite() && high.is_finite() => format!("{} … {}", text(low), text(high)),
            (low, _) if low.is_finite() => format!("≥ {}", text(low)),
            (_, high) if high.is_finite() => format!("≤ {}", text(high)),
            _ => String::new(),
        }
    };
    let of_kind = instance.description().quantities.iter().filter(|quantity| quantity.kind == Kind::Param);
    let param = |quantity: &abi::description::Quantity| Param {
        path: quantity.path.clone(),
        value: instance.get(quantity.slot),
        unit: quantity.unit.clone(),
        range: stated(&quantity.path).unwrap_or_else(|| numbers(quantity)),
        doc: quantity.doc.clone(),
    };
    of_kind.map(param).collect()
}

/// The shortest period in s of sampled code.
pub fn period(instance: &Instance) -> Option<f64> {
    let mut started = instance.clone();
    started.start(1e-3);
    let periods = started.description().ticks.iter().map(|tick| started.get(tick.period));
    periods.filter(|period| *period > 0.0).min_by(f64::total_cmp)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_kept_and_changed() {
        let mut written = Written::read("Sticking(law = Tustin(vs = 2 mm/s), peak = 1.2)").unwrap();
        written.set("law.vs", "3 mm/s").unwrap();
        written.set("B", "10 N·s/m").unwrap();
        assert_eq!(written.to_string(), "Sticking(law = Tustin(vs = 3 mm/s), peak = 1.2, B = 10 N·s/m)");
        assert_eq!(Written::read("rotary LuGre").unwrap().to_string(), "rotary LuGre()");
        assert_eq!(Written::read("LuGre()").unwrap().label(), "LuGre");
        assert!(written.set("other.vs", "1").is_err() && Written::read("3 +").is_err());
    }
}
