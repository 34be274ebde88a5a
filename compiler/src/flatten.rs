//! Makes one flat [`System`] of an instance with all its parts.
//!
//! First every name of the whole tree is declared, then every expression is read, so that order never matters.
//! Checks what concerns names: unknown ones, arguments, slots, and that each quantity is defined exactly once.

use crate::names::nearest;
use crate::resolve::{ItemRef, Loaded, Lookup, RESERVED, Space, declared_twice, reserved};
use crate::source::Sources;
use crate::system::*;
use abi::unit::{Angle, Dimension, Unit};
use grammar::ast::{self, BinaryOp, DeclarationKind, Expr, ExprKind, Item, Name, Statement, Target, UnaryOp};
use grammar::diagnostic::Diagnostic;
use grammar::span::{FileId, Span};
use std::collections::HashMap;
use std::rc::Rc;

/// Most quantities of one instance with all its parts.
pub const MOST_VARS: usize = 2_000_000;
/// Deepest nesting of parts in parts, and of functions in functions.
const DEEPEST: usize = 64;

/// What is made from: a model with arguments, as an experiment or a check asks for it.
pub struct Request<'a> {
    /// The model, or nothing for a model on its own with its inputs free.
    pub instance: Instance<'a>,
    /// Changes from outside, by path: they win over what the text says.
    pub overrides: Vec<Override<'a>>,
    /// Expressions over the names of the instance that are wanted as quantities: plots and expectations.
    pub observed: Vec<&'a Expr>,
    /// Recordings that may be read as `data.NAME`: the number of the table.
    pub data: Vec<(String, Table, Unit)>,
}

/// The instance of a [`Request`].
pub enum Instance<'a> {
    /// As written in a `run`; arguments are read in the scope of the file.
    Written(&'a ast::Instance, FileId),
    /// A model on its own: inputs come from outside, parameters without a default stay open.
    Alone(&'a ast::Model, FileId),
}

/// A change from outside: `fr.Fs = 2 N`, `fr = LuGre()`.
#[derive(Clone)]
pub struct Override<'a> {
    /// The path.
    pub path: &'a ast::Path,
    /// The value, read in the scope of the file.
    pub value: OverrideValue<'a>,
    /// The file.
    pub file: FileId,
}

/// The value of an [`Override`].
#[derive(Clone, Copy)]
pub enum OverrideValue<'a> {
    /// A value.
    Expr(&'a Expr),
    /// A model for a slot.
    Instance(&'a ast::Instance),
}

/// The flat system, the observed expressions in it, and what is wrong.
pub struct Flat {
    /// The system; complete only if there are no errors.
    pub system: System,
    /// One node for each observed expression.
    pub observed: Vec<ExprId>,
    /// What is wrong.
    pub diagnostics: Vec<Diagnostic>,
}

/// Flattens an instance.
pub fn flatten(loaded: &Loaded, sources: &dyn Sources, request: &Request) -> Flat {
    let mut f = Flattener::new(loaded, sources);
    for (name, table, unit) in &request.data {
        let number = f.system.tables.len() as u32;
        f.system.tables.push(table.clone());
        f.data.insert(name.clone(), (number, unit.clone()));
    }
    let overrides: Vec<Change> = request
        .overrides
        .iter()
        .map(|o| Change { path: &o.path.segments, span: o.path.span, value: o.value, env: Env::file(o.file) })
        .collect();
    match &request.instance {
        Instance::Written(instance, file) => {
            let env = Env::file(*file);
            f.written(instance, &env, overrides);
        }
        Instance::Alone(model, file) => {
            let made = Making { path: String::new(), rotary: false, span: model.name.span, args: Vec::new(), overrides };
            f.instantiate(model, *file, made, true);
        }
    }
    for index in 0..f.instances.len() {
        f.define(InstanceId(index as u32));
    }
    for arg in std::mem::take(&mut f.dropped) {
        if let ArgValue::Expr(expr) = arg.value {
            f.expr(expr, &arg.env);
        }
    }
    let observed = match f.instances.first().map(|top| top.file) {
        Some(_) => {
            let file = match &request.instance {
                Instance::Written(_, file) | Instance::Alone(_, file) => *file,
            };
            let env = Env { instance: Some(InstanceId(0)), outside: true, ..Env::file(file) };
            request.observed.iter().map(|expr| f.expr(expr, &env)).collect()
        }
        None => Vec::new(),
    };
    Flat { system: f.system, observed, diagnostics: f.diagnostics }
}

/// Reads a function, constant or table on its own: a function's arguments come from outside.
pub fn flatten_item(loaded: &Loaded, sources: &dyn Sources, file: FileId, item: &Item) -> Flat {
    let mut f = Flattener::new(loaded, sources);
    let env = Env::file(file);
    let observed = match item {
        Item::Function(function) => {
            let mut locals = Vec::new();
            for arg in &function.args {
                let unit = match &arg.unit {
                    None => Some(Unit::none()),
                    Some(unit) => f.unit(unit, false, None),
                };
                let Some(unit) = unit else { continue };
                let argument = Node::Number { value: f64::NAN, dimension: Some(unit.dimension), angle: unit.angle };
                locals.push((arg.name.text.clone(), f.system.push(argument, arg.name.span)));
            }
            if let Lookup::Found(item, _) = loaded.find(file, Space::Function, &function.name.text) {
                f.functions.push(item);
            }
            let value = f.expr(&function.body, &Env { locals: Rc::new(locals), ..env });
            match function.unit.as_ref().and_then(|unit| f.unit(unit, false, None)) {
                Some(unit) => {
                    let role = Role::Result { function: function.name.text.clone() };
                    vec![f.system.push(Node::Fits { value, dimension: unit.dimension, role }, function.body.span)]
                }
                None => vec![value],
            }
        }
        Item::Const(constant) => f.constant(&constant.name, &env).into_iter().collect(),
        Item::Table(table) => {
            crate::tables::read(loaded, sources, file, table, &mut f.diagnostics);
            Vec::new()
        }
        _ => Vec::new(),
    };
    Flat { system: f.system, observed, diagnostics: f.diagnostics }
}

struct Flattener<'a> {
    loaded: &'a Loaded,
    sources: &'a dyn Sources,
    system: System,
    diagnostics: Vec<Diagnostic>,
    /// Runs along with `system.instances`.
    instances: Vec<Tree<'a>>,
    /// Functions being expanded: to find circles.
    functions: Vec<ItemRef>,
    tables: HashMap<ItemRef, Option<u32>>,
    consts: HashMap<(ItemRef, bool), ExprId>,
    open_consts: Vec<ItemRef>,
    /// Models being instantiated: to find circles.
    models: Vec<ItemRef>,
    /// Wiring of slots that the present model has no port for: another model may read it.
    dropped: Vec<Arg<'a>>,
    /// Quantities whose definition was refused, and reported.
    refused: Vec<VarId>,
    data: HashMap<String, (u32, Unit)>,
}

/// What is known of an instance besides [`InstanceInfo`].
struct Tree<'a> {
    model: &'a ast::Model,
    file: FileId,
    names: HashMap<&'a str, Binding>,
    args: Vec<Arg<'a>>,
    alone: bool,
    locals: Locals,
}

/// What a name of an instance means.
#[derive(Clone)]
enum Binding {
    Var(VarId),
    Part(InstanceId),
    Parts(Rc<Vec<InstanceId>>, i64),
    Regime(AutomatonId, u32),
    /// Declared, but not usable: reported.
    Broken,
}

type Locals = Rc<Vec<(String, ExprId)>>;

/// Where an expression is read.
#[derive(Clone)]
struct Env {
    file: FileId,
    instance: Option<InstanceId>,
    rotary: bool,
    locals: Locals,
    /// Read from outside the model, by an experiment: lets are visible, measures are allowed.
    outside: bool,
    /// In an equation rather than a declaration: E0109 looks there.
    equation: bool,
    /// In the condition of a transition or event: crossings may stand there.
    instants: bool,
}

impl Env {
    fn file(file: FileId) -> Env {
        Env { file, instance: None, rotary: false, locals: Rc::default(), outside: false, equation: false, instants: false }
    }
}

/// An argument of an instance.
#[derive(Clone)]
struct Arg<'a> {
    name: &'a str,
    span: Span,
    value: ArgValue<'a>,
    env: Env,
    overriding: bool,
}

#[derive(Clone, Copy)]
enum ArgValue<'a> {
    Expr(&'a Expr),
    Instance(&'a ast::Instance),
}

/// A change from outside on its way down the tree.
#[derive(Clone)]
struct Change<'a> {
    path: &'a [ast::Segment],
    span: Span,
    value: OverrideValue<'a>,
    env: Env,
}

/// How an instance is made.
struct Making<'a> {
    path: String,
    rotary: bool,
    span: Span,
    args: Vec<Arg<'a>>,
    overrides: Vec<Change<'a>>,
}

impl<'a> Flattener<'a> {
    fn new(loaded: &'a Loaded, sources: &'a dyn Sources) -> Flattener<'a> {
        Flattener {
            loaded,
            sources,
            system: System::default(),
            diagnostics: Vec::new(),
            instances: Vec::new(),
            functions: Vec::new(),
            tables: HashMap::new(),
            consts: HashMap::new(),
            open_consts: Vec::new(),
            models: Vec::new(),
            refused: Vec::new(),
            dropped: Vec::new(),
            data: HashMap::new(),
        }
    }

    fn report(&mut self, diagnostic: Diagnostic) {
        self.diagnostics.push(diagnostic);
    }

    // ---- the tree of instances

    /// An instance as written, at the top.
    fn written(&mut self, instance: &'a ast::Instance, env: &Env, overrides: Vec<Change<'a>>) -> Option<InstanceId> {
        let (item, model) = self.model(env.file, &instance.model)?;
        let made = Making {
            path: String::new(),
            rotary: instance.rotary,
            span: instance.model.span,
            args: args_of(&instance.args, env),
            overrides,
        };
        Some(self.instantiate(model, item.file, made, false))
    }

    /// The model of this name, or a report.
    fn model(&mut self, file: FileId, name: &Name) -> Option<(ItemRef, &'a ast::Model)> {
        let loaded = self.loaded;
        match loaded.find(file, Space::Type, &name.text) {
            Lookup::Found(item, Item::Model(model)) => return Some((item, model)),
            Lookup::Found(_, item) => {
                let what = match item {
                    Item::Interface(_) => "an interface: it has no equations",
                    _ => "a device: it stands in a rig",
                };
                let error = Diagnostic::error("E0201", format!("`{}` is not a model", name.text)).label(name.span, what);
                self.report(error.help("name a model that fits it"));
            }
            Lookup::Ambiguous(a, b) => self.ambiguous(name, a, b),
            Lookup::Missing => {
                let models = loaded.visible(file, Space::Type);
                let near = nearest(&name.text, models.iter().copied().filter(|m| self.is_model(file, m)));
                let mut error = Diagnostic::error("E0201", format!("there is no model `{}`", name.text))
                    .label(name.span, "not declared and not imported");
                if let Some(near) = near {
                    error = error.help(format!("did you mean `{near}`?"));
                } else if let Some(module) = self.module_with(&name.text) {
                    error = error.help(format!("add `import {module}`"));
                } else {
                    error = error.help("declare it in this file, or import the file or library module that has it");
                }
                self.report(error);
            }
        }
        None
    }

    fn is_model(&self, file: FileId, name: &str) -> bool {
        matches!(self.loaded.find(file, Space::Type, name), Lookup::Found(_, Item::Model(_)))
    }

    /// The library module that has an item of this name.
    fn module_with(&self, name: &str) -> Option<String> {
        let head = |text: &str| {
            ["model", "fn", "table", "const", "interface"].iter().any(|word| {
                text.lines().any(|line| {
                    line.strip_prefix(word)
                        .and_then(|rest| rest.trim_start().strip_prefix(name))
                        .is_some_and(|rest| !rest.starts_with(|c: char| c.is_ascii_alphanumeric() || c == '_'))
                })
            })
        };
        let modules = self.sources.modules();
        modules.into_iter().find(|m| self.sources.library(m).unwrap_or_default().iter().any(|(_, text)| head(text)))
    }

    fn ambiguous(&mut self, name: &Name, a: ItemRef, b: ItemRef) {
        let file = |item: ItemRef| self.loaded.files.get(item.file).name.clone();
        let error = Diagnostic::error("E0202", format!("two imports define `{}`", name.text))
            .label(name.span, format!("in {} and in {}", file(a), file(b)))
            .help("import only one of them, or declare it in this file");
        self.report(error);
    }

    fn instantiate(&mut self, model: &'a ast::Model, file: FileId, made: Making<'a>, alone: bool) -> InstanceId {
        let id = InstanceId(self.system.instances.len() as u32);
        let allows = model.body.iter().filter_map(|s| match s {
            Statement::Allow(allow) => Some(allow.lint.text.clone()),
            _ => None,
        });
        self.system.instances.push(InstanceInfo {
            path: made.path.clone(),
            model: model.name.text.clone(),
            rotary: made.rotary,
            span: made.span,
            allows: allows.collect(),
        });
        let mut args = made.args;
        let mut deeper: Vec<Change<'a>> = Vec::new();
        for change in made.overrides {
            match change.path {
                [only] if only.index.is_none() => {
                    args.retain(|arg| arg.name != only.name.text);
                    let value = match change.value {
                        OverrideValue::Expr(expr) => ArgValue::Expr(expr),
                        OverrideValue::Instance(instance) => ArgValue::Instance(instance),
                    };
                    let env = change.env.clone();
                    args.push(Arg { name: &only.name.text, span: change.span, value, env, overriding: true });
                }
                _ => deeper.push(change),
            }
        }
        self.instances.push(Tree { model, file, names: HashMap::new(), args, alone, locals: Rc::default() });
        self.declare(id);
        self.parts(id, deeper);
        self.check_arguments(id);
        id
    }

    fn tree(&self, id: InstanceId) -> &Tree<'a> {
        &self.instances[id.0 as usize]
    }

    /// Declares the quantities and regimes of an instance.
    fn declare(&mut self, id: InstanceId) {
        let model = self.tree(id).model;
        let mut first: HashMap<&'a str, Span> = HashMap::new();
        for statement in &model.body {
            match statement {
                Statement::Declaration(declaration) => self.declaration(id, declaration, &mut first),
                Statement::Every(every) => {
                    for statement in &every.body {
                        if let ast::EveryStatement::Declaration(declaration) = statement {
                            self.declaration(id, declaration, &mut first);
                        }
                    }
                }
                Statement::Part(part) => {
                    if self.new_name(&part.name, &mut first) {
                        self.bind(id, &part.name.text, Binding::Broken);
                    }
                }
                _ => {}
            }
        }
        let modes: Vec<&'a ast::Mode> = modes(model).collect();
        if modes.is_empty() {
            return;
        }
        let automaton = AutomatonId(self.system.automata.len() as u32);
        let initial: Vec<usize> = (0..modes.len()).filter(|&k| modes[k].initial.is_some()).collect();
        match initial.as_slice() {
            [_] => {}
            [] => {
                let error = Diagnostic::error("E0310", "no regime is the one to start in")
                    .label(modes[0].head, "the first of them")
                    .help(format!("write `mode {} initial {{`", modes[0].name.text));
                self.report(error);
            }
            [a, b, ..] => {
                let error = Diagnostic::error("E0310", "two regimes are marked `initial`")
                    .label(modes[*b].head, "again here")
                    .label(modes[*a].head, "first here")
                    .help("a model starts in one regime: remove one `initial`");
                self.report(error);
            }
        }
        let mut regimes = Vec::new();
        for (k, mode) in modes.iter().enumerate() {
            regimes.push(Regime { name: mode.name.text.clone(), span: mode.head, transitions: Vec::new() });
            if self.new_name(&mode.name, &mut first) {
                self.bind(id, &mode.name.text, Binding::Regime(automaton, k as u32));
            }
        }
        let initial = initial.first().copied().unwrap_or(0) as u32;
        self.system.automata.push(Automaton { instance: id, regimes, initial });
    }

    /// Whether the name may be declared here.
    fn new_name(&mut self, name: &'a Name, first: &mut HashMap<&'a str, Span>) -> bool {
        if RESERVED.contains(&name.text.as_str()) {
            self.report(reserved(name));
            return false;
        }
        match first.get(name.text.as_str()) {
            Some(&span) => {
                self.report(declared_twice(name, span));
                false
            }
            None => {
                first.insert(&name.text, name.span);
                true
            }
        }
    }

    fn bind(&mut self, id: InstanceId, name: &'a str, binding: Binding) {
        self.instances[id.0 as usize].names.insert(name, binding);
    }

    fn declaration(&mut self, id: InstanceId, declaration: &'a ast::Declaration, first: &mut HashMap<&'a str, Span>) {
        let name = &declaration.name;
        if !self.new_name(name, first) {
            return;
        }
        let kind = match declaration.kind {
            DeclarationKind::Param => VarKind::Param,
            DeclarationKind::Input => VarKind::Input,
            DeclarationKind::Output => VarKind::Output,
            DeclarationKind::State => VarKind::State,
            DeclarationKind::Let => VarKind::Let,
        };
        let rotary = self.system.instance(id).rotary;
        let unit = declaration.unit.as_ref().and_then(|unit| Some((self.unit(unit, rotary, Some(id))?, self.bracketed(unit.span))));
        let shown = match &declaration.value {
            Some(Expr { kind: ExprKind::Number { unit: Some(unit), .. }, .. }) => Unit::parse(&unit.text).ok(),
            _ => None,
        };
        let shown = if rotary { shown.map(|unit| unit.rotary()) } else { shown };
        let path = joined(&self.system.instance(id).path, &name.text);
        let var = self.add_var(Var {
            path,
            name: name.text.clone(),
            span: name.span,
            instance: id,
            kind,
            unit,
            shown,
            range: VarRange::default(),
            range_span: None,
            definition: Definition::Missing,
            doc: declaration.doc.clone(),
        });
        self.bind(id, &name.text, Binding::Var(var));
    }

    fn add_var(&mut self, var: Var) -> VarId {
        self.system.vars.push(var);
        VarId(self.system.vars.len() as u32 - 1)
    }

    /// The span of a declared unit with its brackets.
    fn bracketed(&self, span: Span) -> Span {
        let text = self.loaded.files.get(span.file).text.as_bytes();
        let (before, behind) = ((span.start as usize).wrapping_sub(1), span.end as usize);
        match (text.get(before), text.get(behind)) {
            (Some(b'['), Some(b']')) => Span::new(span.file, before, behind + 1),
            _ => span,
        }
    }

    /// The span of a bound with its operator: `>= 0`.
    fn with_operator(&self, span: Span) -> Span {
        let before = &self.loaded.files.get(span.file).text[..span.start as usize];
        let operator = before.trim_end().trim_end_matches(['<', '>', '=']);
        Span::new(span.file, operator.len(), span.end as usize)
    }

    /// A unit as written, mapped for a rotary instance; or a report.
    fn unit(&mut self, unit: &ast::UnitText, rotary: bool, owner: Option<InstanceId>) -> Option<Unit> {
        match Unit::parse(&unit.text) {
            Ok(parsed) => {
                if rotary && parsed.angle == Angle::Angle {
                    self.not_rotary(owner, unit.span, "speaks of an angle already");
                    return None;
                }
                Some(if rotary { parsed.rotary() } else { parsed })
            }
            Err(part) => {
                self.report(unknown_unit(unit, &part));
                None
            }
        }
    }

    fn not_rotary(&mut self, owner: Option<InstanceId>, span: Span, why: &str) {
        if let Some(id) = owner {
            if self.system.strangers.contains(&id) {
                return;
            }
            self.system.strangers.push(id);
        }
        let error = Diagnostic::error("E0109", "this model cannot be made rotary")
            .label(span, why)
            .help("`rotary` maps m to rad and kg to kg·m^2 throughout: only a model in straight units has a rotary twin");
        self.report(error);
    }

    /// Makes the parts of an instance.
    fn parts(&mut self, id: InstanceId, changes: Vec<Change<'a>>) {
        let model = self.tree(id).model;
        let env = self.env(id);
        for statement in &model.body {
            let Statement::Part(part) = statement else { continue };
            let mine = |change: &&Change<'a>| change.path[0].name.text == part.name.text;
            let changes: Vec<Change<'a>> = changes.iter().filter(mine).cloned().collect();
            match &part.repeat {
                None => {
                    let changes = changes.into_iter().map(|c| Change { path: &c.path[1..], ..c }).collect();
                    if let Some(made) = self.part(id, part, &env, String::new(), changes) {
                        self.bind(id, &part.name.text, Binding::Part(made));
                    }
                }
                Some(repeat) => self.repeated(id, part, repeat, &env, changes),
            }
        }
        for change in &changes {
            let head = &change.path[0].name;
            if !matches!(self.tree(id).names.get(head.text.as_str()), Some(Binding::Part(_) | Binding::Parts(..))) {
                self.unknown_part(id, head);
            }
        }
    }

    fn unknown_part(&mut self, id: InstanceId, name: &Name) {
        let model = self.tree(id).model;
        let parts = model.body.iter().filter_map(|s| match s {
            Statement::Part(part) => Some(part.name.text.as_str()),
            _ => None,
        });
        let mut error = Diagnostic::error("E0204", format!("{} has no part `{}`", model.name.text, name.text))
            .label(name.span, "not a part");
        if let Some(near) = nearest(&name.text, parts) {
            error = error.help(format!("did you mean `{near}`?"));
        }
        self.report(error);
    }

    fn repeated(
        &mut self,
        id: InstanceId,
        part: &'a ast::Part,
        repeat: &'a ast::Repeat,
        env: &Env,
        changes: Vec<Change<'a>>,
    ) {
        // Read as expressions too, so that what they mention counts as read.
        self.expr(&repeat.first, env);
        self.expr(&repeat.last, env);
        let bounds = (self.whole(&repeat.first, env), self.whole(&repeat.last, env));
        let (Some(first), Some(last)) = bounds else { return };
        if last < first || (last - first) as usize >= MOST_VARS {
            let error = Diagnostic::error("E0502", format!("`{}` cannot repeat from {first} to {last}", part.name.text))
                .label(repeat.span, "this range")
                .help(format!("the last index is at least the first, and there are at most {MOST_VARS} quantities"));
            self.report(error);
            return;
        }
        let mut made = Vec::new();
        for i in first..=last {
            let index = self.system.push(
                Node::Number { value: i as f64, dimension: Some(Dimension::NONE), angle: Angle::Silent },
                repeat.index.span,
            );
            let mut locals = (*env.locals).clone();
            locals.push((repeat.index.text.clone(), index));
            let env = Env { locals: Rc::new(locals), ..env.clone() };
            let chosen = |change: &&Change<'a>| change.path[0].index.is_none_or(|index| i64::from(index) == i);
            let changes = changes.iter().filter(chosen).map(|c| Change { path: &c.path[1..], ..c.clone() }).collect();
            match self.part(id, part, &env, format!("[{i}]"), changes) {
                Some(part) => made.push(part),
                None => return,
            }
            if self.system.vars.len() > MOST_VARS {
                let error = Diagnostic::error("E0502", format!("more than {MOST_VARS} quantities"))
                    .label(repeat.span, "made here")
                    .help("a program of this size is refused; use fewer elements");
                self.report(error);
                return;
            }
        }
        self.bind(id, &part.name.text, Binding::Parts(Rc::new(made), first));
    }

    /// Makes one part, with another model in a slot if a change or an argument says so.
    fn part(
        &mut self,
        id: InstanceId,
        part: &'a ast::Part,
        env: &Env,
        index: String,
        mut changes: Vec<Change<'a>>,
    ) -> Option<InstanceId> {
        let path = joined(&self.system.instance(id).path, &format!("{}{index}", part.name.text));
        let mut chosen: (&'a ast::Instance, Env) = (&part.instance, env.clone());
        let mut replaced = false;
        let argument = self.tree(id).args.iter().find(|arg| arg.name == part.name.text).cloned();
        if let Some(arg) = argument {
            match arg.value {
                ArgValue::Instance(instance) => {
                    if part.slot.is_none() {
                        let owner = &self.tree(id).model.name.text;
                        let error = Diagnostic::error("E0205", format!("`{}` of {owner} is not a slot", part.name.text))
                            .label(arg.span, "another model cannot be put here")
                            .label(part.name.span, "declared without an interface")
                            .help(format!("a slot is declared as `part {} : INTERFACE = …`", part.name.text));
                        self.report(error);
                    } else {
                        chosen = (instance, arg.env);
                        replaced = true;
                    }
                }
                ArgValue::Expr(_) => {
                    let error = Diagnostic::error("E0205", format!("`{}` is a part: it takes a model", part.name.text))
                        .label(arg.span, "a value")
                        .help(format!("write `{} = Model(…)`", part.name.text));
                    self.report(error);
                }
            }
        }
        changes.retain(|change| !change.path.is_empty());
        let (instance, instance_env) = chosen;
        let (item, model) = self.model(instance_env.file, &instance.model)?;
        if self.models.contains(&item) || self.models.len() >= DEEPEST {
            let error = Diagnostic::error("E0211", format!("{} contains itself", model.name.text))
                .label(instance.model.span, "here it is made again")
                .help("a part cannot contain the model that it belongs to");
            self.report(error);
            return None;
        }
        let parent_rotary = self.system.instance(id).rotary;
        let rotary = instance.rotary || instance_env.rotary;
        if replaced && parent_rotary && !rotary {
            let error = Diagnostic::error("E0108", format!("{} is straight, but the slot is rotary", model.name.text))
                .label(instance.model.span, "a straight model")
                .help(format!("write `rotary {}(…)`", model.name.text));
            self.report(error);
        }
        let mut args = args_of(&instance.args, &instance_env);
        if let Some(slot) = &part.slot {
            let wiring = args_of(&part.instance.args, env);
            let file = self.tree(id).file;
            let slot_rotary = slot.rotary || parent_rotary;
            let ports = self.interface(file, slot)?;
            self.check_fit(model, item.file, instance, rotary, ports, slot, slot_rotary);
            let has = |name: &str| {
                declarations(model).any(|d| d.kind == DeclarationKind::Input && d.name.text == name)
            };
            let port = |name: &str| ports.ports.iter().any(|port| port.name.text == name);
            if replaced {
                let given: Vec<&str> = args.iter().map(|arg| arg.name).collect();
                args.extend(wiring.into_iter().filter(|arg| port(arg.name) && !given.contains(&arg.name)));
            }
            // A slot drops its wiring for a model that lacks an optional port.
            let (kept, dropped) = args.into_iter().partition(|arg| !port(arg.name) || has(arg.name));
            args = kept;
            self.dropped.extend::<Vec<_>>(dropped);
        }
        self.models.push(item);
        let made = Making { path, rotary, span: instance.model.span, args, overrides: changes };
        let made = self.instantiate(model, item.file, made, false);
        self.models.pop();
        Some(made)
    }

    fn interface(&mut self, file: FileId, slot: &'a ast::SlotType) -> Option<&'a ast::Interface> {
        let loaded = self.loaded;
        match loaded.find(file, Space::Type, &slot.interface.text) {
            Lookup::Found(_, Item::Interface(interface)) => return Some(interface),
            Lookup::Ambiguous(a, b) => self.ambiguous(&slot.interface, a, b),
            Lookup::Found(..) | Lookup::Missing => {
                let mut error = Diagnostic::error("E0201", format!("there is no interface `{}`", slot.interface.text))
                    .label(slot.interface.span, "not declared and not imported");
                let names = loaded.visible(file, Space::Type);
                let interface = |name: &&str| matches!(loaded.find(file, Space::Type, name), Lookup::Found(_, Item::Interface(_)));
                if let Some(near) = nearest(&slot.interface.text, names.into_iter().filter(interface)) {
                    error = error.help(format!("did you mean `{near}`?"));
                } else if let Some(module) = self.module_with(&slot.interface.text) {
                    error = error.help(format!("add `import {module}`"));
                }
                self.report(error);
            }
        }
        None
    }

    /// Whether a model has the ports of an interface.
    #[allow(clippy::too_many_arguments)]
    fn check_fit(
        &mut self,
        model: &'a ast::Model,
        _model_file: FileId,
        instance: &'a ast::Instance,
        rotary: bool,
        interface: &'a ast::Interface,
        slot: &'a ast::SlotType,
        slot_rotary: bool,
    ) {
        for port in &interface.ports {
            let found = declarations(model).find(|d| d.name.text == port.name.text);
            let dimension = |unit: &Option<ast::UnitText>, rotary: bool| {
                let unit = Unit::parse(&unit.as_ref()?.text).ok()?;
                Some(if rotary { unit.dimension.rotary() } else { unit.dimension })
            };
            let wanted = port.unit.as_ref().map_or(String::new(), |unit| format!(" [{}]", unit.text));
            let wanted = format!("{} {}{wanted}", port.kind.word(), port.name.text);
            let name = &model.name.text;
            let problem = match found {
                None if port.value.is_some() => continue,
                None => format!("it has no `{wanted}`"),
                Some(d) if d.kind != port.kind => format!("its `{}` is {} `{}`", d.name.text, article(d.kind.word()), d.kind.word()),
                Some(d) => match (dimension(&d.unit, rotary), dimension(&port.unit, slot_rotary)) {
                    (Some(has), Some(needs)) if has != needs => {
                        if has.rotary() == needs || needs.rotary() == has {
                            let (model_is, help) = if slot_rotary {
                                ("straight", format!("write `rotary {name}(…)`"))
                            } else {
                                ("rotary", format!("write `{name}(…)` without `rotary`"))
                            };
                            let error = Diagnostic::error("E0108", format!("{name} is {model_is} here, the slot is not"))
                                .label(instance.model.span, format!("its `{}` is in {}", d.name.text, Unit::si(has)))
                                .label(slot.interface.span, format!("expects {}", Unit::si(needs)));
                            self.report(error.help(help));
                            return;
                        }
                        format!("its `{}` is {}, not {}", d.name.text, has.describe(), needs.describe())
                    }
                    _ => continue,
                },
            };
            let error = Diagnostic::error("E0206", format!("{name} does not fit {}", interface.name.text))
                .label(instance.model.span, problem)
                .label(slot.interface.span, format!("asks for `{wanted}`"))
                .help(format!("a model fits {} when it has its ports with these units; add `{wanted}`", interface.name.text));
            self.report(error);
            return;
        }
    }

    /// Every argument must name a port, parameter or slot.
    fn check_arguments(&mut self, id: InstanceId) {
        let tree = self.tree(id);
        let model = tree.model;
        let mut seen: HashMap<&str, Span> = HashMap::new();
        let mut errors = Vec::new();
        for arg in &tree.args {
            if let Some(first) = seen.insert(arg.name, arg.span) {
                let name = Name { text: arg.name.into(), span: arg.span };
                errors.push(
                    Diagnostic::error("E0205", format!("`{}` is given twice", name.text))
                        .label(arg.span, "again here")
                        .label(first, "first here")
                        .help("remove one of them"),
                );
                continue;
            }
            let declared = declarations(model).find(|d| d.name.text == arg.name);
            let part = model.body.iter().any(|s| matches!(s, Statement::Part(part) if part.name.text == arg.name));
            let message = match declared {
                _ if part => continue,
                Some(d) if matches!(d.kind, DeclarationKind::Param | DeclarationKind::Input) => match arg.value {
                    ArgValue::Expr(_) => continue,
                    ArgValue::Instance(_) => format!("`{}` of {} takes a value, not a model", arg.name, model.name.text),
                },
                Some(d) => {
                    let kind = d.kind.word();
                    format!("`{}` is {} {kind} of {}: it cannot be given", arg.name, article(kind), model.name.text)
                }
                None => format!("{} has no `{}`", model.name.text, arg.name),
            };
            let mut error = Diagnostic::error("E0205", message).label(arg.span, "no such argument");
            let takes: Vec<&str> = declarations(model)
                .filter(|d| matches!(d.kind, DeclarationKind::Param | DeclarationKind::Input))
                .map(|d| d.name.text.as_str())
                .collect();
            error = match nearest(arg.name, takes.iter().copied()) {
                Some(near) => error.help(format!("did you mean `{near}`?")),
                None if takes.is_empty() => error.help(format!("{} takes no arguments", model.name.text)),
                None => error.help(format!("{} takes {}", model.name.text, takes.join(", "))),
            };
            errors.push(error);
        }
        self.diagnostics.extend(errors);
    }

    fn env(&self, id: InstanceId) -> Env {
        let tree = self.tree(id);
        Env {
            file: tree.file,
            instance: Some(id),
            rotary: self.system.instance(id).rotary,
            locals: tree.locals.clone(),
            outside: false,
            equation: false,
            instants: false,
        }
    }

    /// A whole number known before anything is compiled: a bound of a repetition.
    fn whole(&mut self, expr: &'a Expr, env: &Env) -> Option<i64> {
        match self.early(expr, env, 0) {
            Some(value) if value.fract() == 0.0 && value.abs() < 1e9 => Some(value as i64),
            _ => {
                let error = Diagnostic::error("E0502", "a repetition needs whole numbers that are known here")
                    .label(expr.span, "not a whole number, or not constant")
                    .help("write a number, a constant or a param, as in `[i in 1 .. 4]`");
                self.report(error);
                None
            }
        }
    }

    /// Value of simple arithmetic over numbers, constants and parameters.
    fn early(&self, expr: &'a Expr, env: &Env, depth: usize) -> Option<f64> {
        if depth > DEEPEST {
            return None;
        }
        let value = |e: &'a Expr| self.early(e, env, depth + 1);
        match &expr.kind {
            ExprKind::Number { value, unit: None } => Some(*value),
            ExprKind::Unary(UnaryOp::Negate, a) => Some(-value(a)?),
            ExprKind::Binary(op, _, a, b) => {
                let (a, b) = (value(a)?, value(b)?);
                match op {
                    BinaryOp::Add => Some(a + b),
                    BinaryOp::Subtract => Some(a - b),
                    BinaryOp::Multiply => Some(a * b),
                    BinaryOp::Divide => Some(a / b),
                    _ => None,
                }
            }
            ExprKind::Path(path) => {
                let name = path.single()?.text.as_str();
                if let Some((_, node)) = env.locals.iter().find(|(local, _)| local == name) {
                    return match self.system.node(*node) {
                        Node::Number { value, .. } => Some(*value),
                        _ => None,
                    };
                }
                if let Some(id) = env.instance {
                    let tree = self.tree(id);
                    if let Some(declaration) = declarations(tree.model).find(|d| d.name.text == name) {
                        if let Some(arg) = tree.args.iter().find(|arg| arg.name == name) {
                            let ArgValue::Expr(expr) = arg.value else { return None };
                            return self.early(expr, &arg.env, depth + 1);
                        }
                        let parameter = declaration.kind == DeclarationKind::Param;
                        return self.early(declaration.value.as_ref().filter(|_| parameter)?, env, depth + 1);
                    }
                }
                match self.loaded.find(env.file, Space::Const, name) {
                    Lookup::Found(item, Item::Const(c)) => self.early(&c.value, &Env::file(item.file), depth + 1),
                    _ => None,
                }
            }
            _ => None,
        }
    }

    // ---- the equations

    /// Reads all expressions of an instance.
    fn define(&mut self, id: InstanceId) {
        let model = self.tree(id).model;
        let env = self.env(id);
        let equations = Env { equation: true, ..env.clone() };
        // Where each quantity is defined: to find two.
        let mut defined: HashMap<VarId, Span> = HashMap::new();
        for declaration in declarations(model) {
            self.define_declaration(id, declaration, &env, &mut defined);
        }
        let mut rates: Vec<(VarId, Rate)> = Vec::new();
        for statement in &model.body {
            match statement {
                Statement::Equation(equation) => self.equation(id, equation, &equations, &mut defined, &mut rates),
                Statement::Every(every) => self.every(id, every, &equations, &mut defined),
                Statement::When(when) => {
                    let condition = self.expr(&when.condition, &Env { instants: true, ..equations.clone() });
                    let resets = self.resets(id, &when.resets, &equations);
                    self.system.events.push(Event { instance: id, condition, resets, span: when.span });
                }
                Statement::Require(require) => {
                    let condition = self.expr(&require.condition, &env);
                    let message = require.message.as_ref().map(|message| message.text.clone());
                    self.system.requires.push(Require { instance: id, condition, message, span: require.condition.span });
                }
                Statement::Storage(storage) => {
                    let energy = self.expr(&storage.energy, &equations);
                    self.system.storages.push((id, energy));
                }
                Statement::Declaration(_) | Statement::Part(_) | Statement::Mode(_) | Statement::Allow(_) => {}
            }
        }
        self.regimes(id, &equations, &mut defined, &mut rates);
        self.rates(rates);
        self.undefined(id, &defined);
    }

    fn var_named(&self, id: InstanceId, name: &str) -> Option<VarId> {
        match self.tree(id).names.get(name) {
            Some(Binding::Var(var)) => Some(*var),
            _ => None,
        }
    }

    fn define_declaration(
        &mut self,
        id: InstanceId,
        declaration: &'a ast::Declaration,
        env: &Env,
        defined: &mut HashMap<VarId, Span>,
    ) {
        let name = &declaration.name;
        let Some(var) = self.var_named(id, &name.text) else { return };
        if self.system.var(var).span != name.span {
            return; // Declared twice: the first one counts.
        }
        if let Some(range) = &declaration.range {
            let (range, span) = self.range(range, env);
            let var = &mut self.system.vars[var.0 as usize];
            (var.range, var.range_span) = (range, Some(span));
        }
        let given = match declaration.kind {
            DeclarationKind::Param | DeclarationKind::Input => {
                self.tree(id).args.iter().find(|arg| arg.name == name.text).cloned()
            }
            DeclarationKind::Output | DeclarationKind::State | DeclarationKind::Let => None,
        };
        let definition = match (given, &declaration.value) {
            (Some(Arg { value: ArgValue::Expr(expr), env, span, overriding, .. }), _) => {
                let value = self.expr(expr, &env);
                let model = self.system.instance(id).span;
                let origin = if overriding { Origin::Override } else { Origin::Argument { model, bind: span } };
                Definition::Value(value, origin)
            }
            (Some(_), _) => Definition::Missing, // Reported with the arguments.
            (None, _) if declaration.kind == DeclarationKind::Input && self.tree(id).alone => Definition::Free,
            (None, Some(value)) => {
                let value = match declaration.kind {
                    DeclarationKind::Output | DeclarationKind::Let => {
                        self.expr(value, &Env { equation: true, ..env.clone() })
                    }
                    _ => self.expr(value, env),
                };
                match declaration.kind {
                    DeclarationKind::State => {
                        Definition::Continuous { initial: value, rate: value, path: None, span: name.span }
                    }
                    DeclarationKind::Output | DeclarationKind::Let => {
                        defined.insert(var, name.span);
                        Definition::Value(value, Origin::Equation(name.span))
                    }
                    DeclarationKind::Param | DeclarationKind::Input => Definition::Value(value, Origin::Default),
                }
            }
            (None, None) => match declaration.kind {
                DeclarationKind::Param | DeclarationKind::Input if !self.tree(id).alone => {
                    let info = self.system.instance(id);
                    let model = self.tree(id).model;
                    let unit = declaration.unit.as_ref().map_or("…".to_string(), |unit| format!("… {}", unit.text));
                    let kind = declaration.kind.word();
                    let message = format!("{} needs a value for its {kind} `{}`", model.name.text, name.text);
                    let error = Diagnostic::error("E0203", message)
                        .label(info.span, format!("`{}` is not given", name.text))
                        .label(name.span, "declared without a default")
                        .help(format!("write `{}({} = {unit})`", model.name.text, name.text));
                    self.report(error);
                    Definition::Missing
                }
                DeclarationKind::Param | DeclarationKind::Input => Definition::Free,
                DeclarationKind::State => {
                    let error = Diagnostic::error("E0303", format!("nothing says where `{}` starts", name.text))
                        .label(name.span, "a state needs an initial value")
                        .help(format!("write `state {} = 0`", name.text));
                    self.report(error);
                    let zero = self.system.push(zero(), name.span);
                    Definition::Continuous { initial: zero, rate: zero, path: None, span: name.span }
                }
                DeclarationKind::Output | DeclarationKind::Let => Definition::Missing,
            },
        };
        self.system.vars[var.0 as usize].definition = definition;
    }

    fn range(&mut self, range: &'a ast::Range, env: &Env) -> (VarRange, Span) {
        match range {
            ast::Range::Between(low, high) => {
                let (l, h) = (self.expr(low, env), self.expr(high, env));
                (VarRange { low: Some((l, false)), high: Some((h, false)) }, low.span.to(high.span))
            }
            ast::Range::Bound(op, bound) => {
                let value = self.expr(bound, env);
                let strict = matches!(op, BinaryOp::Less | BinaryOp::Greater);
                let range = match op {
                    BinaryOp::Less | BinaryOp::LessEqual => VarRange { low: None, high: Some((value, strict)) },
                    _ => VarRange { low: Some((value, strict)), high: None },
                };
                (range, self.with_operator(bound.span))
            }
        }
    }

    fn equation(
        &mut self,
        id: InstanceId,
        equation: &'a ast::Equation,
        env: &Env,
        defined: &mut HashMap<VarId, Span>,
        rates: &mut Vec<(VarId, Rate)>,
    ) {
        let Some((var, wanted)) = self.target(id, &equation.target) else {
            self.expr(&equation.value, env);
            return;
        };
        let value = self.expr(&equation.value, env);
        if !self.once(var, equation.target.span(), defined) {
            return;
        }
        match wanted {
            Wanted::Value => {
                let origin = Origin::Equation(equation.target.span());
                self.system.vars[var.0 as usize].definition = Definition::Value(value, origin);
            }
            Wanted::Rate { along } => rates.push((var, Rate { value, along, span: equation.target.span() })),
            Wanted::Next => {
                self.refused.push(var);
                let error = Diagnostic::error("E0308", "`next` belongs inside an `every` block")
                    .label(equation.target.span(), "when is the next tick?")
                    .help(format!("write `every Ts {{ next({}) = … }}`", equation.target.name().text));
                self.report(error);
            }
        }
    }

    /// The quantity that an equation defines, and how.
    fn target(&mut self, id: InstanceId, target: &'a Target) -> Option<(VarId, Wanted)> {
        let name = target.name();
        let var = match self.tree(id).names.get(name.text.as_str()) {
            Some(Binding::Var(var)) => *var,
            Some(Binding::Broken) => return None,
            Some(_) => {
                let error = Diagnostic::error("E0301", format!("`{}` is no quantity: it cannot be defined", name.text))
                    .label(target.span(), "a part or a regime");
                self.report(error);
                return None;
            }
            None => {
                self.unknown(id, name);
                return None;
            }
        };
        let kind = self.system.var(var).kind;
        let declared = self.system.var(var).span;
        let wanted = self.wanted(id, target, var, kind, declared);
        if wanted.is_none() {
            self.refused.push(var);
        }
        wanted
    }

    fn wanted(
        &mut self,
        id: InstanceId,
        target: &'a Target,
        var: VarId,
        kind: VarKind,
        declared: Span,
    ) -> Option<(VarId, Wanted)> {
        let name = target.name();
        match (target, kind) {
            (Target::Name(_), VarKind::Output | VarKind::Let) => Some((var, Wanted::Value)),
            (Target::Next { .. }, VarKind::State) => Some((var, Wanted::Next)),
            (Target::Derivative { along, .. }, VarKind::State) => {
                if along.text == "t" {
                    return Some((var, Wanted::Rate { along: None }));
                }
                match self.var_named(id, &along.text) {
                    Some(path) if self.system.var(path).kind == VarKind::State => {
                        Some((var, Wanted::Rate { along: Some((path, along.span)) }))
                    }
                    _ => {
                        let error = Diagnostic::error(
                            "E0307",
                            format!("`{}` cannot change along `{}`: that is no state", name.text, along.text),
                        )
                        .label(target.span(), format!("how fast does `{}` change?", along.text))
                        .help(format!("declare a state for it: `state {0} = 0` with `d{0}/dt = …`", along.text));
                        self.report(error);
                        None
                    }
                }
            }
            (Target::Name(_), VarKind::State) => {
                let error = Diagnostic::error("E0301", format!("`{}` is a state: it has no equation of its own", name.text))
                    .label(target.span(), "a state changes, it is not computed")
                    .label(declared, "declared here")
                    .help(format!("say how it changes, `d{0}/dt = …`, or declare it as `let {0} = …`", name.text));
                self.report(error);
                None
            }
            (Target::Name(_), _) => {
                let kind = kind.word();
                let error = Diagnostic::error("E0301", format!("`{}` is {} {kind}: its value comes from outside", name.text, article(kind)))
                    .label(target.span(), "a second definition")
                    .label(declared, "declared here")
                    .help("give what is computed here another name, and declare it with `let`");
                self.report(error);
                None
            }
            (Target::Derivative { .. } | Target::Next { .. }, _) => {
                let error = Diagnostic::error("E0307", format!("`{}` is no state", name.text))
                    .label(target.span(), "only a state changes in time")
                    .label(declared, format!("declared as {}", kind.word()))
                    .help(format!("declare it as `state {} = 0`", name.text));
                self.report(error);
                None
            }
        }
    }

    /// Notes a definition; reports a second one.
    fn once(&mut self, var: VarId, span: Span, defined: &mut HashMap<VarId, Span>) -> bool {
        match defined.insert(var, span) {
            None => true,
            Some(first) => {
                defined.insert(var, first);
                let name = &self.system.var(var).name;
                let is_next = |span: Span| self.loaded.files.slice(span).starts_with("next");
                if is_next(span) != is_next(first) {
                    let error = Diagnostic::error("E0304", format!("`{name}` changes in time and at ticks"))
                        .label(span, "again here")
                        .label(first, "first here")
                        .help(format!("a state is continuous, `d{name}/dt = …`, or sampled, `next({name}) = …`: keep one"));
                    self.report(error);
                    return false;
                }
                let name = &self.system.var(var).name;
                let error = Diagnostic::error("E0301", format!("`{name}` is defined twice"))
                    .label(span, "again here")
                    .label(first, "first here")
                    .help("each quantity has one equation: remove one, or join them with `if … then … else …`");
                self.report(error);
                false
            }
        }
    }

    fn every(&mut self, id: InstanceId, every: &'a ast::Every, env: &Env, defined: &mut HashMap<VarId, Span>) {
        let period = self.expr(&every.period, &Env { equation: false, ..env.clone() });
        let block = BlockId(self.system.blocks.len() as u32);
        self.system.blocks.push(Block { instance: id, period, span: every.span });
        for statement in &every.body {
            match statement {
                ast::EveryStatement::Declaration(declaration) => {
                    let Some(var) = self.var_named(id, &declaration.name.text) else { continue };
                    if declaration.kind == DeclarationKind::Let
                        && let Definition::Value(value, origin) = self.system.var(var).definition
                    {
                        self.system.vars[var.0 as usize].definition = Definition::Held { value, block, origin };
                    }
                }
                ast::EveryStatement::Equation(equation) => {
                    let value = self.expr(&equation.value, env);
                    let span = equation.target.span();
                    let Some((var, wanted)) = self.target(id, &equation.target) else { continue };
                    match wanted {
                        Wanted::Value => {
                            if self.once(var, span, defined) {
                                let origin = Origin::Equation(span);
                                self.system.vars[var.0 as usize].definition = Definition::Held { value, block, origin };
                            }
                        }
                        Wanted::Next => {
                            if self.once(var, span, defined)
                                && let Definition::Continuous { initial, .. } = self.system.var(var).definition
                            {
                                self.system.vars[var.0 as usize].definition = Definition::Sampled { initial, next: value, block };
                            }
                        }
                        Wanted::Rate { .. } => {
                            self.refused.push(var);
                            let name = &equation.target.name().text;
                            let error = Diagnostic::error("E0308", "a derivative does not belong inside `every`")
                                .label(span, "sampled code changes at ticks only")
                                .help(format!("write `next({name}) = …`, or move the equation out of the block"));
                            self.report(error);
                        }
                    }
                }
            }
        }
    }

    fn resets(&mut self, id: InstanceId, resets: &'a [ast::Reset], env: &Env) -> Vec<(VarId, ExprId)> {
        let mut out = Vec::new();
        for reset in resets {
            let value = self.expr(&reset.value, env);
            match self.var_named(id, &reset.name.text) {
                Some(var) if self.system.var(var).kind == VarKind::State => out.push((var, value)),
                Some(var) => {
                    let error = Diagnostic::error("E0307", format!("`{}` is no state: it cannot be reset", reset.name.text))
                        .label(reset.name.span, "only a state keeps a value")
                        .label(self.system.var(var).span, "declared here");
                    self.report(error);
                }
                None => self.unknown(id, &reset.name),
            }
        }
        out
    }

    fn regimes(
        &mut self,
        id: InstanceId,
        env: &Env,
        defined: &mut HashMap<VarId, Span>,
        rates: &mut Vec<(VarId, Rate)>,
    ) {
        let model = self.tree(id).model;
        let modes: Vec<&'a ast::Mode> = modes(model).collect();
        let Some(automaton) = self.system.automata.iter().position(|a| a.instance == id) else { return };
        /// One definition in one regime.
        struct InMode {
            var: VarId,
            along: Option<Option<(VarId, Span)>>,
            value: ExprId,
            span: Span,
            statement: Span,
        }
        let mut by_mode: Vec<Vec<InMode>> = Vec::new();
        for mode in &modes {
            let mut here: Vec<InMode> = Vec::new();
            for equation in &mode.equations {
                let value = self.expr(&equation.value, env);
                let span = equation.target.span();
                let Some((var, wanted)) = self.target(id, &equation.target) else { continue };
                if let Some(first) = here.iter().find(|other| other.var == var) {
                    let mut one = HashMap::from([(var, first.span)]);
                    self.once(var, span, &mut one);
                    continue;
                }
                let along = match wanted {
                    Wanted::Value => None,
                    Wanted::Rate { along } => Some(along),
                    Wanted::Next => {
                        self.refused.push(var);
                        let error = Diagnostic::error("E0308", "`next` belongs inside an `every` block")
                            .label(span, "a regime is continuous")
                            .help("write an `every` block beside the regimes; a regime's name can be used in it as a condition");
                        self.report(error);
                        continue;
                    }
                };
                here.push(InMode { var, along, value, span, statement: head(equation) });
            }
            by_mode.push(here);
        }
        let transitions: Vec<Vec<Transition>> = modes.iter().map(|mode| self.transitions(id, mode, &modes, env)).collect();
        for (regime, transitions) in self.system.automata[automaton].regimes.iter_mut().zip(transitions) {
            regime.transitions = transitions;
        }
        let mut vars: Vec<(VarId, Span)> = Vec::new();
        for here in &by_mode {
            for one in here {
                if !vars.iter().any(|(var, _)| *var == one.var) {
                    vars.push((one.var, one.span));
                }
            }
        }
        for (var, span) in vars {
            let mut complete = true;
            for (mode, here) in modes.iter().zip(&by_mode) {
                if here.iter().any(|one| one.var == var) {
                    continue;
                }
                complete = false;
                let (other, first) = modes
                    .iter()
                    .zip(&by_mode)
                    .find_map(|(mode, here)| Some((mode, here.iter().find(|one| one.var == var)?)))
                    .expect("some regime defines it");
                let name = &self.system.var(var).name;
                let text = self.loaded.files.slice(first.span).to_string();
                let error = Diagnostic::error("E0305", format!("regime `{}` does not say what `{name}` is", mode.name.text))
                    .label(first.statement, format!("`{}` defines {name}", other.name.text))
                    .label(mode.head, format!("`{}` does not", mode.name.text))
                    .help(format!("every regime defines the same quantities; add `{text} = ...` to `{}`", mode.name.text));
                self.report(error);
                break;
            }
            if !complete {
                defined.entry(var).or_insert(span);
                self.system.vars[var.0 as usize].definition = match self.system.var(var).definition.clone() {
                    Definition::Missing => {
                        let error = self.system.push(Node::Error, span);
                        Definition::Value(error, Origin::Equation(span))
                    }
                    other => other,
                };
                continue;
            }
            if !self.once(var, span, defined) {
                continue;
            }
            let ones: Vec<(Option<Option<(VarId, Span)>>, ExprId)> = by_mode
                .iter()
                .map(|here| here.iter().find(|one| one.var == var).map(|one| (one.along, one.value)).expect("complete"))
                .collect();
            let mut value = ones.last().expect("there is a regime").1;
            for k in (0..ones.len() - 1).rev() {
                let active = self.system.push(Node::InRegime(AutomatonId(automaton as u32), k as u32), span);
                value = self.system.push(Node::If(active, ones[k].1, value), span);
            }
            match ones[0].0 {
                None => {
                    self.system.vars[var.0 as usize].definition = Definition::Value(value, Origin::Equation(span));
                }
                Some(along) => rates.push((var, Rate { value, along, span })),
            }
        }
    }

    fn transitions(&mut self, id: InstanceId, mode: &'a ast::Mode, modes: &[&'a ast::Mode], env: &Env) -> Vec<Transition> {
        let mut out = Vec::new();
        for go in &mode.transitions {
            let condition = self.expr(&go.condition, &Env { instants: true, ..env.clone() });
            let resets = self.resets(id, &go.resets, env);
            match modes.iter().position(|other| other.name.text == go.target.text) {
                Some(target) => out.push(Transition { target: target as u32, condition, resets, span: go.span }),
                None => {
                    let mut error = Diagnostic::error("E0310", format!("there is no regime `{}`", go.target.text))
                        .label(go.target.span, "not a `mode` of this model");
                    if let Some(near) = nearest(&go.target.text, modes.iter().map(|mode| mode.name.text.as_str())) {
                        error = error.help(format!("did you mean `{near}`?"));
                    }
                    self.report(error);
                }
            }
        }
        out
    }

    /// Turns rates into definitions of states; those along a path are multiplied by the speed of the path.
    fn rates(&mut self, rates: Vec<(VarId, Rate)>) {
        // Those along time first, then those whose path is done.
        let mut waiting: Vec<(VarId, Rate)> = Vec::new();
        for (var, rate) in rates {
            match rate.along {
                None => self.set_rate(var, rate.value, None, rate.span),
                Some(_) => waiting.push((var, rate)),
            }
        }
        loop {
            let blocked: Vec<VarId> = waiting.iter().map(|(var, _)| *var).collect();
            let (ready, rest): (Vec<_>, Vec<_>) = waiting.into_iter().partition(|(_, rate)| {
                let (path, _) = rate.along.expect("it waits for its path");
                !blocked.contains(&path)
            });
            waiting = rest;
            if ready.is_empty() {
                break;
            }
            for (var, rate) in ready {
                let (path, _) = rate.along.expect("it waited for its path");
                let product = match self.system.var(path).definition {
                    Definition::Continuous { initial, rate: speed, .. } if initial != speed => {
                        self.times_speed(rate.value, speed, rate.span)
                    }
                    _ => rate.value, // Reported: the path has no equation.
                };
                self.set_rate(var, product, Some((rate.value, path)), rate.span);
            }
        }
        if let Some((var, rate)) = waiting.first() {
            let (path, along) = rate.along.expect("it waits for its path");
            let (a, b) = (self.system.var(*var).name.clone(), self.system.var(path).name.clone());
            let error = Diagnostic::error("E0403", "paths in a circle")
                .label(rate.span, format!("`{a}` changes along `{b}`"))
                .label(along, format!("and `{b}` along `{a}`, directly or by others"))
                .help("one of them must change along time: `ds/dt = …`");
            self.report(error);
            for (var, rate) in waiting {
                let unknown = self.system.push(Node::Error, rate.span);
                self.set_rate(var, unknown, None, rate.span);
            }
        }
    }

    fn set_rate(&mut self, var: VarId, value: ExprId, path: Option<(ExprId, VarId)>, span: Span) {
        let definition = &mut self.system.vars[var.0 as usize].definition;
        if let Definition::Continuous { initial, .. } = *definition {
            // A state that stays where it starts has its initial value as its rate no longer.
            *definition = Definition::Continuous { initial, rate: value, path, span };
        }
    }

    /// `value · speed`, with `sign(v)` taken in where the speed is `abs(v)`, so that nothing jumps in time.
    fn times_speed(&mut self, value: ExprId, speed: ExprId, span: Span) -> ExprId {
        let inner = match self.system.node(speed) {
            Node::Call(Builtin::Abs, args) => args[0],
            _ => return self.system.push(Node::Binary(BinaryOp::Multiply, value, speed), span),
        };
        let span = self.system.span(value);
        if !self.has_sign(value, inner) {
            return self.system.push(Node::Binary(BinaryOp::Multiply, value, speed), span);
        }
        let node = match self.system.node(value).clone() {
            Node::Call(Builtin::Sign, _) => return inner,
            Node::Negate(a) => Node::Negate(self.times_speed(a, speed, span)),
            Node::Binary(op @ (BinaryOp::Add | BinaryOp::Subtract), a, b) => {
                Node::Binary(op, self.times_speed(a, speed, span), self.times_speed(b, speed, span))
            }
            Node::Binary(BinaryOp::Multiply, a, b) if self.has_sign(a, inner) => {
                Node::Binary(BinaryOp::Multiply, self.times_speed(a, speed, span), b)
            }
            Node::Binary(BinaryOp::Multiply, a, b) => Node::Binary(BinaryOp::Multiply, a, self.times_speed(b, speed, span)),
            Node::Binary(BinaryOp::Divide, a, b) if self.has_sign(a, inner) => {
                Node::Binary(BinaryOp::Divide, self.times_speed(a, speed, span), b)
            }
            Node::If(c, a, b) => Node::If(c, self.times_speed(a, speed, span), self.times_speed(b, speed, span)),
            Node::Fits { value: a, .. } => return self.times_speed(a, speed, span),
            Node::Var(var) => match self.system.var(var).definition {
                Definition::Value(value, _) => return self.times_speed(value, speed, span),
                _ => Node::Binary(BinaryOp::Multiply, value, speed),
            },
            _ => Node::Binary(BinaryOp::Multiply, value, speed),
        };
        self.system.push(node, span)
    }

    /// Whether `sign(inner)` stands in the expression as a factor that can be reached.
    fn has_sign(&self, value: ExprId, inner: ExprId) -> bool {
        match self.system.node(value) {
            Node::Call(Builtin::Sign, args) => self.same(args[0], inner),
            Node::Negate(a) | Node::Fits { value: a, .. } => self.has_sign(*a, inner),
            Node::Binary(BinaryOp::Add | BinaryOp::Subtract | BinaryOp::Multiply, a, b) => {
                self.has_sign(*a, inner) || self.has_sign(*b, inner)
            }
            Node::Binary(BinaryOp::Divide, a, _) => self.has_sign(*a, inner),
            Node::If(_, a, b) => self.has_sign(*a, inner) || self.has_sign(*b, inner),
            Node::Var(var) => match self.system.var(*var).definition {
                Definition::Value(value, _) if self.system.var(*var).kind == VarKind::Let => self.has_sign(value, inner),
                _ => false,
            },
            _ => false,
        }
    }

    /// Whether two expressions are written alike.
    fn same(&self, a: ExprId, b: ExprId) -> bool {
        if a == b {
            return true;
        }
        match (self.system.node(a), self.system.node(b)) {
            (Node::Var(a), Node::Var(b)) => a == b,
            (Node::Negate(a), Node::Negate(b)) => self.same(*a, *b),
            (Node::Binary(op, a, b), Node::Binary(other, c, d)) => op == other && self.same(*a, *c) && self.same(*b, *d),
            _ => false,
        }
    }

    /// Reports quantities that nothing defines.
    fn undefined(&mut self, id: InstanceId, defined: &HashMap<VarId, Span>) {
        let model = self.tree(id).model;
        for declaration in declarations(model) {
            let Some(var) = self.var_named(id, &declaration.name.text) else { continue };
            let span = declaration.name.span;
            if defined.contains_key(&var) || self.refused.contains(&var) || self.system.var(var).span != span {
                continue;
            }
            let name = &declaration.name.text;
            let error = Diagnostic::error("E0303", format!("nothing determines `{name}`"));
            let error = match declaration.kind {
                DeclarationKind::Param | DeclarationKind::Input => continue,
                DeclarationKind::State => {
                    let unit = declaration.unit.as_ref().and_then(|unit| Unit::parse(&unit.text).ok());
                    let per_second = |unit: Unit| unit.dimension.times(Dimension::of([0, 0, -1, 0, 0]));
                    let unit = unit.map_or(String::new(), |unit| format!(" (in {})", Unit::si(per_second(unit))));
                    error.label(span, "a state needs one equation for how it changes").help(format!(
                        "add `d{name}/dt = ...`{unit} for a state in continuous time,\nor `next({name}) = ...` inside an `every` block for a sampled one"
                    ))
                }
                DeclarationKind::Output | DeclarationKind::Let => {
                    error.label(span, "declared, but without an equation").help(format!("add `{name} = ...`"))
                }
            };
            self.report(error);
        }
    }

    // ---- expressions

    /// E0204
    fn unknown(&mut self, id: InstanceId, name: &Name) {
        let tree = self.tree(id);
        let model = tree.model;
        let error = Diagnostic::error("E0204", format!("there is no `{}` in {}", name.text, model.name.text))
            .label(name.span, "not declared");
        let all = declarations(model).map(|d| d.name.text.as_str());
        let parts = model.body.iter().filter_map(|s| match s {
            Statement::Part(part) => Some(part.name.text.as_str()),
            Statement::Mode(mode) => Some(mode.name.text.as_str()),
            _ => None,
        });
        let consts = self.loaded.visible(tree.file, Space::Const);
        let error = match nearest(&name.text, all.chain(parts).chain(consts)) {
            Some(near) => match declarations(model).find(|d| d.name.text == near) {
                Some(d) => error.help(format!("did you mean `{near}` ({})?", self.described(d))),
                None => error.help(format!("did you mean `{near}`?")),
            },
            None if name.text == "time" => error.help("time is `t`"),
            None => error.help(format!("declare it, for example `param {} = …` or `let {} = …`", name.text, name.text)),
        };
        self.report(error);
    }

    /// `param, N/m, line 4`
    fn described(&self, declaration: &ast::Declaration) -> String {
        let unit = declaration.unit.as_ref().or(match &declaration.value {
            Some(Expr { kind: ExprKind::Number { unit, .. }, .. }) => unit.as_ref(),
            _ => None,
        });
        let unit = unit.map_or(String::new(), |unit| format!("{}, ", unit.text));
        format!("{}, {unit}line {}", declaration.kind.word(), self.loaded.files.line(declaration.name.span))
    }

    fn error(&mut self, span: Span) -> ExprId {
        self.system.push(Node::Error, span)
    }

    /// Reads an expression.
    fn expr(&mut self, expr: &'a Expr, env: &Env) -> ExprId {
        // Long sums and products lean to the left: walk down without recursion.
        let mut spine: Vec<(&'a Expr, BinaryOp, Span, &'a Expr)> = Vec::new();
        let mut first = expr;
        while let ExprKind::Binary(op, op_span, left, right) = &first.kind {
            spine.push((first, *op, *op_span, right));
            first = left;
        }
        let mut value = self.operand(first, env);
        while let Some((whole, op, _, right)) = spine.pop() {
            let right = self.expr(right, env);
            value = self.binary(op, value, right, whole.span, env);
        }
        value
    }

    fn binary(&mut self, op: BinaryOp, a: ExprId, b: ExprId, span: Span, env: &Env) -> ExprId {
        let node = match op {
            BinaryOp::Crosses | BinaryOp::Rises | BinaryOp::Falls if !env.instants => {
                let error = Diagnostic::error("E0308", format!("`{}` is an instant, not a value", op.text()))
                    .label(span, "true at one instant only")
                    .help("it belongs in `go … when …` and `when …`; for a value compare with `<` or `>`");
                self.report(error);
                Node::Error
            }
            BinaryOp::Crosses | BinaryOp::Rises | BinaryOp::Falls => {
                let difference = self.system.push(Node::Binary(BinaryOp::Subtract, a, b), span);
                self.system.crossings.push(Crossing { kind: op, difference });
                Node::Crossing(self.system.crossings.len() as u32 - 1)
            }
            op => Node::Binary(op, a, b),
        };
        self.system.push(node, span)
    }

    fn operand(&mut self, expr: &'a Expr, env: &Env) -> ExprId {
        let span = expr.span;
        let node = match &expr.kind {
            ExprKind::Number { value, unit } => return self.number(*value, unit.as_ref(), span, env),
            ExprKind::Path(path) => return self.path(path, env),
            ExprKind::Derivative { of, along } => return self.derivative(of, along, span, env),
            ExprKind::Call { function, args } => return self.call(function, args, span, env),
            ExprKind::Unary(UnaryOp::Negate, a) => Node::Negate(self.expr(a, env)),
            ExprKind::Unary(UnaryOp::Not, a) => Node::Not(self.expr(a, env)),
            ExprKind::If(c, a, b) => Node::If(self.expr(c, env), self.expr(a, env), self.expr(b, env)),
            ExprKind::Hole => Node::Hole,
            ExprKind::Error => Node::Error,
            ExprKind::Binary(..) => return self.expr(expr, env),
        };
        self.system.push(node, span)
    }

    fn number(&mut self, value: f64, unit: Option<&'a ast::UnitText>, span: Span, env: &Env) -> ExprId {
        let node = match unit {
            None if value == 0.0 => zero(),
            None => Node::Number { value, dimension: Some(Dimension::NONE), angle: Angle::Silent },
            Some(text) => match Unit::parse(&text.text) {
                Err(part) => {
                    self.report(unknown_unit(text, &part));
                    Node::Error
                }
                Ok(unit) => {
                    let value = value * unit.scale;
                    if env.rotary {
                        if unit.angle == Angle::Angle {
                            self.not_rotary(env.instance, span, "speaks of an angle already");
                        } else if env.equation && unit.dimension.rotary() != unit.dimension {
                            self.not_rotary(env.instance, span, "a constant with a straight unit inside an equation");
                        }
                    }
                    let dimension = if env.rotary { unit.dimension.rotary() } else { unit.dimension };
                    Node::Number { value, dimension: Some(dimension), angle: unit.angle }
                }
            },
        };
        self.system.push(node, span)
    }

    fn path(&mut self, path: &'a ast::Path, env: &Env) -> ExprId {
        let head = &path.segments[0];
        if let Some(name) = path.single() {
            if let Some((_, node)) = env.locals.iter().rev().find(|(local, _)| *local == name.text) {
                return *node;
            }
            let fixed = match name.text.as_str() {
                "t" => Some(Node::Time),
                "pi" => Some(Node::Number {
                    value: std::f64::consts::PI,
                    dimension: Some(Dimension::NONE),
                    angle: Angle::Silent,
                }),
                "inf" => Some(Node::Number { value: f64::INFINITY, dimension: None, angle: Angle::Silent }),
                "true" => Some(Node::Bool(true)),
                "false" => Some(Node::Bool(false)),
                _ => None,
            };
            if let Some(node) = fixed {
                return self.system.push(node, path.span);
            }
        }
        if head.name.text == "data" && env.instance.is_none_or(|_| env.outside) && path.segments.len() == 2 {
            return self.recording(path);
        }
        if let Some(id) = env.instance
            && let Some(binding) = self.tree(id).names.get(head.name.text.as_str()).cloned()
        {
            return self.through(id, binding, path, env);
        }
        if path.segments.len() == 1 && head.index.is_none() {
            if let Some(node) = self.constant(&head.name, env) {
                return node;
            }
        }
        match env.instance {
            Some(id) => self.unknown(id, &head.name),
            None => {
                let visible = self.loaded.visible(env.file, Space::Const);
                let error = Diagnostic::error("E0204", format!("there is no `{}` here", head.name.text))
                    .label(head.name.span, "not declared");
                let error = match nearest(&head.name.text, visible) {
                    Some(near) => error.help(format!("did you mean `{near}`?")),
                    None => error.help("constants, functions and `t` can be used here"),
                };
                self.report(error);
            }
        }
        self.error(path.span)
    }

    fn recording(&mut self, path: &'a ast::Path) -> ExprId {
        let column = &path.segments[1].name;
        match self.data.get(&column.text) {
            Some((table, _)) => {
                let table = *table;
                let time = self.system.push(Node::Time, path.span);
                self.system.push(Node::Table(table, time), path.span)
            }
            None => {
                let mut names: Vec<&String> = self.data.keys().collect();
                names.sort_unstable();
                let error = Diagnostic::error("E0903", format!("there is no column `{}`", column.text))
                    .label(column.span, "not in the recording");
                let error = match nearest(&column.text, names.iter().map(|name| name.as_str())) {
                    Some(near) => error.help(format!("did you mean `data.{near}`?")),
                    None => error.help("columns are named in `data \"file.csv\" (t [s], x [mm])`"),
                };
                self.report(error);
                self.error(path.span)
            }
        }
    }

    /// Follows a path from a name of an instance down its parts.
    fn through(&mut self, id: InstanceId, binding: Binding, path: &'a ast::Path, env: &Env) -> ExprId {
        let (mut id, mut binding) = (id, binding);
        for k in 0..path.segments.len() {
            let segment = &path.segments[k];
            let last = k + 1 == path.segments.len();
            let part = match (&binding, segment.index) {
                (Binding::Part(part), None) => *part,
                (Binding::Parts(parts, first), Some(index)) => {
                    match usize::try_from(i64::from(index) - first).ok().and_then(|i| parts.get(i)) {
                        Some(part) => *part,
                        None => {
                            let last = first + parts.len() as i64 - 1;
                            let name = &segment.name.text;
                            let error = Diagnostic::error("E0204", format!("there is no `{name}[{index}]`"))
                                .label(path.span, format!("`{name}` goes from {first} to {last}"));
                            self.report(error);
                            return self.error(path.span);
                        }
                    }
                }
                (Binding::Parts(..), None) => {
                    let name = &segment.name.text;
                    let error = Diagnostic::error("E0204", format!("`{name}` is several parts"))
                        .label(path.span, "which one?")
                        .help(format!("write `{name}[1].…` for one, or `sum({name}.…)`, `min(…)`, `max(…)` over all"));
                    self.report(error);
                    return self.error(path.span);
                }
                (_, Some(_)) => {
                    let error = Diagnostic::error("E0204", format!("`{}` is no array of parts", segment.name.text))
                        .label(path.span, "it has no index");
                    self.report(error);
                    return self.error(path.span);
                }
                (Binding::Var(var), None) if last => return self.variable(*var, k > 0, path, env),
                (Binding::Regime(automaton, regime), None) if last => {
                    let node = Node::InRegime(*automaton, *regime);
                    return self.system.push(node, path.span);
                }
                (Binding::Broken, None) => return self.error(path.span),
                (_, None) => {
                    let error = Diagnostic::error("E0204", format!("`{}` has no parts", segment.name.text))
                        .label(path.span, "nothing can follow the dot");
                    self.report(error);
                    return self.error(path.span);
                }
            };
            if last {
                let name = &segment.name.text;
                let error = Diagnostic::error("E0204", format!("`{name}` is a part, not a quantity"))
                    .label(path.span, "which quantity of it?")
                    .help(format!("write `{name}.` and the name of one of its outputs, states or params"));
                self.report(error);
                return self.error(path.span);
            }
            let next = &path.segments[k + 1].name;
            match self.tree(part).names.get(next.text.as_str()).cloned() {
                Some(next) => (id, binding) = (part, next),
                None => {
                    self.unknown(part, next);
                    return self.error(path.span);
                }
            }
        }
        unreachable!("path of instance {id:?} ended without a quantity")
    }

    fn variable(&mut self, var: VarId, from_outside: bool, path: &'a ast::Path, env: &Env) -> ExprId {
        let declared = self.system.var(var);
        if from_outside && declared.kind == VarKind::Let && !env.outside {
            let model = &self.system.instance(declared.instance).model;
            let error = Diagnostic::error("E0208", format!("`{}` is private to {model}", declared.name))
                .label(path.span, "a `let` cannot be read from outside")
                .label(declared.span, "declared here")
                .help(format!("make it an output: `output {}`", declared.name));
            self.report(error);
            return self.error(path.span);
        }
        self.system.push(Node::Var(var), path.span)
    }

    fn constant(&mut self, name: &'a Name, env: &Env) -> Option<ExprId> {
        match self.loaded.find(env.file, Space::Const, &name.text) {
            Lookup::Found(item, Item::Const(constant)) => {
                if let Some(&node) = self.consts.get(&(item, env.rotary)) {
                    return Some(node);
                }
                if self.open_consts.contains(&item) {
                    let error = Diagnostic::error("E0211", format!("`{}` is defined by itself", name.text))
                        .label(name.span, "used in its own value");
                    self.report(error);
                    return Some(self.error(name.span));
                }
                self.open_consts.push(item);
                let inner = Env { rotary: env.rotary, equation: env.equation, ..Env::file(item.file) };
                let mut value = self.expr(&constant.value, &inner);
                if let Some(unit) = &constant.unit
                    && let Some(unit) = self.unit(unit, env.rotary, env.instance)
                {
                    let role = Role::Result { function: name.text.clone() };
                    value = self.system.push(Node::Fits { value, dimension: unit.dimension, role }, constant.value.span);
                }
                self.open_consts.pop();
                self.consts.insert((item, env.rotary), value);
                Some(value)
            }
            Lookup::Ambiguous(a, b) => {
                self.ambiguous(name, a, b);
                Some(self.error(name.span))
            }
            _ => None,
        }
    }

    fn derivative(&mut self, of: &'a Name, along: &'a Name, span: Span, env: &Env) -> ExprId {
        let var = env.instance.and_then(|id| self.var_named(id, &of.text));
        let path = env.instance.and_then(|id| self.var_named(id, &along.text));
        let node = match (var, path) {
            (Some(var), _) if along.text == "t" => Node::Rate(var),
            (Some(var), Some(_)) => Node::PathRate(var),
            _ => {
                let error = Diagnostic::error("E0307", format!("there is no derivative `d{}/d{}` here", of.text, along.text))
                    .label(span, "not a state of this model")
                    .help("to watch a derivative, give the model an output for it");
                self.report(error);
                Node::Error
            }
        };
        self.system.push(node, span)
    }

    fn call(&mut self, function: &'a Name, args: &'a [Expr], span: Span, env: &Env) -> ExprId {
        if let ("sum" | "min" | "max", [Expr { kind: ExprKind::Path(path), .. }]) = (function.text.as_str(), args)
            && let Some(folded) = self.fold(function, path, span, env)
        {
            return folded;
        }
        if env.outside
            && let Some((measure, wanted)) = MeasureName::named(&function.text)
            && args.len() == wanted
        {
            let value = self.expr(&args[0], env);
            let second = args.get(1).map(|arg| self.expr(arg, env));
            return self.system.push(Node::Measure(measure, value, second), span);
        }
        match self.loaded.find(env.file, Space::Function, &function.text) {
            Lookup::Found(item, Item::Function(f)) => return self.expand(item, f, function, args, span, env),
            Lookup::Found(item, Item::Table(table)) => return self.table(item, table, function, args, span, env),
            Lookup::Found(..) => {}
            Lookup::Ambiguous(a, b) => {
                self.ambiguous(function, a, b);
                return self.error(span);
            }
            Lookup::Missing => {}
        }
        let values: Vec<ExprId> = args.iter().map(|arg| self.expr(arg, env)).collect();
        match Builtin::named(&function.text) {
            Some((builtin, wanted)) if wanted == values.len() => self.builtin(builtin, values, span),
            Some((_, wanted)) => {
                self.wrong_count(function, wanted, args.len());
                self.error(span)
            }
            None if function.text == "delay" => {
                let error = Diagnostic::error("E0905", "`delay` is not available yet").label(function.span, "reserved");
                self.report(error.help("a first-order lag comes close: `dy/dt = (x - y) / T`"));
                self.error(span)
            }
            None if MeasureName::named(&function.text).is_some() => {
                let error = Diagnostic::error("E0901", format!("`{}` is a measure: it belongs in `expect`", function.text))
                    .label(function.span, "needs the whole course of a quantity")
                    .help(format!("write `expect {}(…) < …` in an experiment", function.text));
                self.report(error);
                self.error(span)
            }
            None => {
                self.unknown_function(function, env);
                self.error(span)
            }
        }
    }

    fn builtin(&mut self, builtin: Builtin, values: Vec<ExprId>, span: Span) -> ExprId {
        match builtin {
            Builtin::Step | Builtin::Ramp => self.system.corners.push(values[0]),
            Builtin::Pulse => {
                let end = self.system.push(Node::Binary(BinaryOp::Add, values[0], values[1]), span);
                self.system.corners.extend([values[0], end]);
            }
            _ => {}
        }
        self.system.push(Node::Call(builtin, values.into()), span)
    }

    fn wrong_count(&mut self, function: &Name, wanted: usize, got: usize) {
        let plural = if wanted == 1 { "" } else { "s" };
        let error = Diagnostic::error("E0207", format!("`{}` takes {wanted} argument{plural}, not {got}", function.text))
            .label(function.span, format!("{got} given"));
        self.report(error);
    }

    fn unknown_function(&mut self, function: &Name, env: &Env) {
        let mut error = Diagnostic::error("E0204", format!("there is no function `{}`", function.text))
            .label(function.span, "not declared");
        let loaded = self.loaded;
        let mut known = loaded.visible(env.file, Space::Function);
        for name in Builtin::names() {
            known.push(name);
        }
        let help = match function.text.as_str() {
            "der" | "diff" | "ddt" => Some("a derivative is written `dz/dt`".to_string()),
            "sgn" | "signum" => Some("write `sign(…)`".into()),
            "ln" => Some("write `log(…)`: the natural logarithm".into()),
            "pow" => Some("write `a ^ b`".into()),
            "sat" | "limit" | "saturate" => Some("write `clamp(x, low, high)`".into()),
            "fabs" => Some("write `abs(…)`".into()),
            name => nearest(name, known).map(|near| format!("did you mean `{near}`?")),
        };
        if let Some(help) = help.or_else(|| self.module_with(&function.text).map(|m| format!("add `import {m}`"))) {
            error = error.help(help);
        }
        self.report(error);
    }

    /// `sum(el.f)`: folds an array of parts in the order of the index. Nothing if the path has no array.
    fn fold(&mut self, function: &'a Name, path: &'a ast::Path, span: Span, env: &Env) -> Option<ExprId> {
        let id = env.instance?;
        let mut binding = self.tree(id).names.get(path.segments[0].name.text.as_str())?.clone();
        let mut at = 0;
        let parts = loop {
            let segment = &path.segments[at];
            match (&binding, segment.index) {
                (Binding::Broken, _) => return Some(self.error(span)),
                (Binding::Parts(parts, _), None) => break parts.clone(),
                (Binding::Parts(parts, first), Some(index)) => {
                    let part = *parts.get(usize::try_from(i64::from(index) - first).ok()?)?;
                    at += 1;
                    binding = self.tree(part).names.get(path.segments.get(at)?.name.text.as_str())?.clone();
                }
                (Binding::Part(part), None) => {
                    at += 1;
                    binding = self.tree(*part).names.get(path.segments.get(at)?.name.text.as_str())?.clone();
                }
                _ => return None,
            }
        };
        let rest: Vec<&ast::Segment> = path.segments[at + 1..].iter().collect();
        let mut values = Vec::new();
        for part in parts.iter() {
            let mut instance = *part;
            for (k, segment) in rest.iter().enumerate() {
                match self.tree(instance).names.get(segment.name.text.as_str()).cloned() {
                    Some(Binding::Part(inner)) if k + 1 < rest.len() => instance = inner,
                    Some(Binding::Var(var)) if k + 1 == rest.len() => values.push(self.variable(var, true, path, env)),
                    Some(Binding::Regime(automaton, regime)) if k + 1 == rest.len() => {
                        values.push(self.system.push(Node::InRegime(automaton, regime), path.span));
                    }
                    _ => {
                        self.unknown(instance, &segment.name);
                        return Some(self.error(span));
                    }
                }
            }
        }
        let mut all = values.into_iter();
        let mut result = all.next()?;
        for value in all {
            let node = match function.text.as_str() {
                "sum" => Node::Binary(BinaryOp::Add, result, value),
                "min" => Node::Call(Builtin::Min, [result, value].into()),
                _ => Node::Call(Builtin::Max, [result, value].into()),
            };
            result = self.system.push(node, span);
        }
        Some(result)
    }

    /// A function of the text, expanded in place.
    fn expand(
        &mut self,
        item: ItemRef,
        function: &'a ast::Function,
        name: &'a Name,
        args: &'a [Expr],
        span: Span,
        env: &Env,
    ) -> ExprId {
        let mut locals = Vec::new();
        for (arg, expr) in function.args.iter().zip(args) {
            let value = self.expr(expr, env);
            let dimension = match &arg.unit {
                None => Some(Dimension::NONE),
                Some(unit) => self.unit(unit, env.rotary, env.instance).map(|unit| unit.dimension),
            };
            let value = match dimension {
                Some(dimension) => {
                    let role = Role::Argument { function: function.name.text.clone(), name: arg.name.text.clone() };
                    self.system.push(Node::Fits { value, dimension, role }, expr.span)
                }
                None => value,
            };
            locals.push((arg.name.text.clone(), value));
        }
        if function.args.len() != args.len() {
            self.wrong_count(name, function.args.len(), args.len());
            return self.error(span);
        }
        if self.functions.contains(&item) || self.functions.len() >= DEEPEST {
            let error = Diagnostic::error("E0211", format!("`{}` calls itself", function.name.text))
                .label(function.name.span, "directly or by others")
                .help("functions are not recursive: a step must take a bounded time");
            self.report(error);
            return self.error(span);
        }
        self.functions.push(item);
        let inner = Env {
            locals: Rc::new(locals),
            rotary: env.rotary,
            equation: env.equation,
            ..Env::file(item.file)
        };
        let body = self.expr(&function.body, &inner);
        self.functions.pop();
        match function.unit.as_ref().and_then(|unit| self.unit(unit, env.rotary, env.instance)) {
            Some(unit) => {
                let role = Role::Result { function: function.name.text.clone() };
                self.system.push(Node::Fits { value: body, dimension: unit.dimension, role }, span)
            }
            None => body,
        }
    }

    fn table(
        &mut self,
        item: ItemRef,
        table: &'a ast::Table,
        name: &'a Name,
        args: &'a [Expr],
        span: Span,
        env: &Env,
    ) -> ExprId {
        let [arg] = args else {
            self.wrong_count(name, 1, args.len());
            return self.error(span);
        };
        let x = self.expr(arg, env);
        if !self.tables.contains_key(&item) {
            let made = crate::tables::read(self.loaded, self.sources, item.file, table, &mut self.diagnostics);
            let number = made.map(|table| {
                self.system.tables.push(table);
                self.system.tables.len() as u32 - 1
            });
            self.tables.insert(item, number);
        }
        match self.tables[&item] {
            Some(number) => self.system.push(Node::Table(number, x), span),
            None => self.error(span),
        }
    }
}

/// The beginning of an equation: enough to know it by, `F = clamp` of `F = clamp(F_ext, -Fs, Fs)`.
fn head(equation: &ast::Equation) -> Span {
    let mut first = &equation.value;
    while let ExprKind::Binary(_, _, left, _) = &first.kind {
        first = left;
    }
    let end = match &first.kind {
        ExprKind::Call { function, .. } => function.span,
        _ => first.span,
    };
    equation.target.span().to(end)
}

/// How an equation gives its quantity a value.
enum Wanted {
    Value,
    Rate { along: Option<(VarId, Span)> },
    Next,
}

/// The right side of a derivative equation.
struct Rate {
    value: ExprId,
    along: Option<(VarId, Span)>,
    span: Span,
}

fn zero() -> Node {
    Node::Number { value: 0.0, dimension: None, angle: Angle::Silent }
}

fn joined(path: &str, name: &str) -> String {
    if path.is_empty() { name.to_string() } else { format!("{path}.{name}") }
}

fn article(word: &str) -> &'static str {
    if word.starts_with(['a', 'e', 'i', 'o', 'u']) { "an" } else { "a" }
}

fn unknown_unit(unit: &ast::UnitText, part: &str) -> Diagnostic {
    let known = ["m", "mm", "um", "kg", "g", "s", "ms", "N", "J", "W", "rad", "deg", "rev", "rpm", "Hz", "min", "h", "K", "A", "V"];
    let error = Diagnostic::error("E0102", format!("unknown unit `{part}`")).label(unit.span, "not a unit that fric knows");
    match nearest(part, known) {
        Some(near) => error.help(format!("did you mean `{near}`?")),
        None => error.help("units are m g s min h A K N J W Pa V Ohm Hz rad deg rev rpm bit %, with G M k m u n before them"),
    }
}

fn args_of<'a>(args: &'a [ast::Bind], env: &Env) -> Vec<Arg<'a>> {
    let arg = |bind: &'a ast::Bind| Arg {
        name: &bind.name.text,
        span: bind.span,
        value: match &bind.value {
            ast::BindValue::Expr(expr) => ArgValue::Expr(expr),
            ast::BindValue::Instance(instance) => ArgValue::Instance(instance),
        },
        env: env.clone(),
        overriding: false,
    };
    args.iter().map(arg).collect()
}

/// All declarations of a model, those inside `every` included.
fn declarations(model: &ast::Model) -> impl Iterator<Item = &ast::Declaration> {
    model.body.iter().flat_map(|statement| {
        let (one, many): (Option<&ast::Declaration>, &[ast::EveryStatement]) = match statement {
            Statement::Declaration(declaration) => (Some(declaration), &[]),
            Statement::Every(every) => (None, &every.body),
            _ => (None, &[]),
        };
        one.into_iter().chain(many.iter().filter_map(|statement| match statement {
            ast::EveryStatement::Declaration(declaration) => Some(declaration),
            ast::EveryStatement::Equation(_) => None,
        }))
    })
}

fn modes(model: &ast::Model) -> impl Iterator<Item = &ast::Mode> {
    model.body.iter().filter_map(|statement| match statement {
        Statement::Mode(mode) => Some(mode),
        _ => None,
    })
}
