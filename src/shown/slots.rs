//! The slots of an experiment's model, and the models that fit them.
//!
//! In: a loaded text and an experiment. Out: for each slot its path, the model in it, and those in sight that could stand
//! there. A model fits if it has the ports of the interface; whether it also compiles there is known once it has been
//! chosen.

use crate::compile::{Loaded, Lookup, Space};
use grammar::ast::{
    BindValue, DeclarationKind, ExperimentStatement, Instance, Interface, Item, Model, Path, Statement,
};
use grammar::span::FileId;
use serde_json::{Value, json};

/// Parts within parts that are looked into.
const DEPTH: usize = 4;

/// A slot.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Slot {
    /// `fr`, `axis.fr`.
    pub path: String,
    /// The interface that it asks for.
    pub interface: String,
    /// Whether it is in the rotary units of its interface.
    rotary: bool,
    /// The model in it, by the text.
    pub own: String,
    /// The models that fit, by name.
    pub fits: Vec<String>,
}

impl Slot {
    /// For the page.
    pub fn json(&self) -> Value {
        json!({ "path": self.path, "interface": self.interface, "fits": self.fits })
    }

    /// What `--set` takes to put a model there.
    pub fn set(&self, model: &str) -> String {
        format!("{} = {}{model}()", self.path, if self.rotary { "rotary " } else { "" })
    }
}

/// The slots of the model that an experiment runs, in the order of the text. Those over which it sweeps are not among
/// them, nor are those of a model that runs in rotary units as a whole.
pub fn slots(loaded: &Loaded, experiment: &str) -> Vec<Slot> {
    let Lookup::Found(_, Item::Experiment(found)) = loaded.find(loaded.root(), Space::Experiment, experiment) else {
        return Vec::new();
    };
    let run = found.body.iter().find_map(|statement| match statement {
        ExperimentStatement::Run(run) => Some(&run.instance),
        _ => None,
    });
    let swept = found.body.iter().flat_map(|statement| match statement {
        ExperimentStatement::Sweep(sweep) => std::iter::once(&sweep.path).chain(&sweep.also).map(text).collect(),
        _ => Vec::new(),
    });
    let swept: Vec<String> = swept.collect();
    let Some(run) = run.filter(|run| !run.rotary) else { return Vec::new() };
    let mut all = Vec::new();
    inside(loaded, loaded.root(), run, "", DEPTH, &mut all);
    all.retain(|slot| slot.fits.len() > 1 && swept.iter().all(|path| *path != slot.path));
    all
}

fn text(path: &Path) -> String {
    path.segments.iter().map(|segment| segment.name.text.as_str()).collect::<Vec<_>>().join(".")
}

/// The model of an instance, and the file that declares it; that of a variant is the model that it varies.
fn model<'a>(loaded: &'a Loaded, file: FileId, name: &str, depth: usize) -> Option<(&'a Model, FileId)> {
    match loaded.find(file, Space::Type, name) {
        Lookup::Found(item, Item::Model(model)) => Some((model, item.file)),
        Lookup::Found(item, Item::Variant(variant)) if depth > 0 => {
            model(loaded, item.file, &variant.instance.model.text, depth - 1)
        }
        _ => None,
    }
}

fn inside(loaded: &Loaded, file: FileId, run: &Instance, prefix: &str, depth: usize, all: &mut Vec<Slot>) {
    let Some((model, file)) = model(loaded, file, &run.model.text, DEPTH).filter(|_| depth > 0) else { return };
    for statement in &model.body {
        let Statement::Part(part) = statement else { continue };
        let (name, path) = (&part.name.text, format!("{prefix}{}", part.name.text));
        if part.repeat.is_some() || part.instance.rotary && part.slot.is_none() {
            continue;
        }
        let Some(slot) = &part.slot else {
            inside(loaded, file, &part.instance, &format!("{path}."), depth - 1, all);
            continue;
        };
        let given = run.args.iter().find_map(|bind| match &bind.value {
            BindValue::Instance(instance) if text(&bind.path()) == *name => Some(instance),
            _ => None,
        });
        let Lookup::Found(_, Item::Interface(interface)) = loaded.find(file, Space::Type, &slot.interface.text) else {
            continue;
        };
        all.push(Slot {
            path,
            interface: interface.name.text.clone(),
            rotary: slot.rotary,
            own: given.unwrap_or(&part.instance).model.text.clone(),
            fits: fitting(loaded, interface),
        });
    }
}

/// The models that the text can name and that fit an interface, sorted.
fn fitting(loaded: &Loaded, interface: &Interface) -> Vec<String> {
    let fits = |name: &&str| {
        let Some((model, _)) = model(loaded, loaded.root(), name, DEPTH) else { return false };
        let declarations = || {
            model.body.iter().filter_map(|statement| match statement {
                Statement::Declaration(declaration) => Some(declaration),
                _ => None,
            })
        };
        let required = interface.ports.iter().filter(|port| port.value.is_none());
        let has = |port: &grammar::ast::Declaration| {
            declarations().any(|own| own.name.text == port.name.text && own.kind == port.kind)
        };
        let mut inputs = declarations().filter(|own| own.kind == DeclarationKind::Input && own.value.is_none());
        let knows =
            |input: &grammar::ast::Declaration| interface.ports.iter().any(|port| port.name.text == input.name.text);
        required.into_iter().all(has) && inputs.all(knows)
    };
    let names = loaded.visible(loaded.root(), Space::Type);
    names.into_iter().filter(fits).map(str::to_string).collect()
}
