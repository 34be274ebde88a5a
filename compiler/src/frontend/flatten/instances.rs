//! The instance tree: instantiates models and their parts, binds arguments and slots, and declares every name.
//!
//! In: models of a [`Loaded`]. Out: instances and declared quantities. Knows nothing of equations.

use super::*;

/// A model that a name stands for.
pub(super) struct Found<'a> {
    pub(super) item: ItemRef,
    pub(super) model: &'a ast::Model,
    /// The variants on the way to it, with their files: the named one first.
    variants: Vec<(FileId, &'a ast::Instance)>,
    /// Whether one of them is the rotary twin.
    pub(super) rotary: bool,
}

impl<'a> Found<'a> {
    /// The arguments of an instance of it, in `env`, with those of its variants, and the changes of its parts. The
    /// arguments of the instance take precedence.
    fn with(&self, instance: &'a ast::Instance, env: &Env) -> (Vec<Arg<'a>>, Vec<Change<'a>>) {
        let mut args = args_of(&instance.args, env);
        let mut changes = changes_of(&instance.args, env);
        for (file, variant) in &self.variants {
            let given: Vec<&str> = args.iter().map(|arg| arg.name).collect();
            let more = args_of(&variant.args, &Env::file(*file)).into_iter();
            let more: Vec<Arg> = more.filter(|arg| !given.contains(&arg.name)).collect();
            args.extend(more);
            let mut all = changes_of(&variant.args, &Env::file(*file));
            all.append(&mut changes);
            changes = all;
        }
        (args, changes)
    }
}

/// Most arguments of a model that a message lists beside a suggestion.
const MOST_TAKEN: usize = 12;

impl<'a> Flattener<'a> {
    /// Instantiates the root as written in the text. `alone`: its inputs may stay open.
    pub(super) fn written(
        &mut self,
        instance: &'a ast::Instance,
        env: &Env,
        overrides: Vec<Change<'a>>,
        alone: bool,
    ) -> Option<InstanceId> {
        let found = self.model(env.file, &instance.model)?;
        let (args, mut changes) = found.with(instance, env);
        changes.extend(overrides);
        let made = Instantiation {
            path: String::new(),
            rotary: instance.rotary || found.rotary,
            span: instance.model.span,
            args,
            overrides: changes,
        };
        Some(self.instantiate(found.model, found.item.file, made, alone))
    }

    /// Finds the model of this name, or reports why not. The model of a variant is the one that it names, with its
    /// arguments.
    pub(super) fn model(&mut self, file: FileId, name: &Name) -> Option<Found<'a>> {
        let (mut file, mut name, mut variants, mut rotary) = (file, name, Vec::new(), false);
        let loaded = self.loaded;
        loop {
            let (item, variant) = match loaded.find(file, Space::Type, &name.text) {
                Lookup::Found(item, Item::Variant(variant)) => (item, variant),
                _ => {
                    let (item, model) = self.written_model(file, name)?;
                    return Some(Found { item, model, variants, rotary });
                }
            };
            if variants.len() >= DEEPEST {
                let error = Diagnostic::error("E0211", format!("{} is a variant of itself", variant.name.text))
                    .recurring(Recurring::Part)
                    .label(variant.name.span, "leads back to itself")
                    .help("one of them names a model with equations");
                self.report(error);
                return None;
            }
            rotary |= variant.instance.rotary;
            variants.push((item.file, &variant.instance));
            (file, name) = (item.file, &variant.instance.model);
        }
    }

    /// Finds the model of this name that has equations of its own, or reports why not.
    fn written_model(&mut self, file: FileId, name: &Name) -> Option<(ItemRef, &'a ast::Model)> {
        let loaded = self.loaded;
        match loaded.find(file, Space::Type, &name.text) {
            Lookup::Found(item, Item::Model(model)) => return Some((item, model)),
            Lookup::Found(_, item) => {
                let what = match item {
                    Item::Interface(_) => "an interface: it has no equations",
                    _ => "a device: it stands in a rig",
                };
                let error =
                    Diagnostic::error("E0201", format!("`{}` is not a model", name.text)).label(name.span, what);
                self.report(error.help("name a model that fits it"));
            }
            Lookup::Ambiguous(a, b) => self.ambiguous(name, a, b),
            Lookup::Missing if self.explained(name, file) => {}
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

    pub(super) fn is_model(&self, file: FileId, name: &str) -> bool {
        matches!(self.loaded.find(file, Space::Type, name), Lookup::Found(_, Item::Model(_) | Item::Variant(_)))
    }

    /// The library module that has an item of this name.
    pub(super) fn module_with(&self, name: &str) -> Option<String> {
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

    pub(super) fn ambiguous(&mut self, name: &Name, a: ItemRef, b: ItemRef) {
        let file = |item: ItemRef| self.loaded.files.get(item.file).name.clone();
        let error = Diagnostic::error("E0202", format!("two imports define `{}`", name.text))
            .label(name.span, format!("in {} and in {}", file(a), file(b)))
            .help("import only one of them, or declare it in this file");
        self.report(error);
    }

    pub(super) fn instantiate(
        &mut self,
        model: &'a ast::Model,
        file: FileId,
        made: Instantiation<'a>,
        alone: bool,
    ) -> InstanceId {
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
        let (names, locals) = (HashMap::default(), Rc::default());
        self.instances.push(Tree {
            model,
            file,
            names,
            args,
            alone,
            defaults: false,
            on_bus: false,
            scope: false,
            locals,
        });
        self.declare(id);
        self.parts(id, deeper);
        self.check_arguments(id);
        id
    }

    pub(super) fn tree(&self, id: InstanceId) -> &Tree<'a> {
        &self.instances[id.0 as usize]
    }

    /// Declares the quantities and regimes of an instance.
    pub(super) fn declare(&mut self, id: InstanceId) {
        let model = self.tree(id).model;
        let mut first: HashMap<&'a str, Span> = HashMap::default();
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
                Statement::Part(part) => match self.new_name(&part.name, &mut first) {
                    true => self.bind(id, &part.name.text, Binding::Broken),
                    false => self.refused_parts.push(part.name.span),
                },
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

    /// Whether the name may be declared in this scope; reports it otherwise.
    pub(super) fn new_name(&mut self, name: &'a Name, first: &mut HashMap<&'a str, Span>) -> bool {
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

    pub(super) fn bind(&mut self, id: InstanceId, name: &'a str, binding: Binding) {
        self.instances[id.0 as usize].names.insert(name, binding);
    }

    pub(super) fn declaration(
        &mut self,
        id: InstanceId,
        declaration: &'a ast::Declaration,
        first: &mut HashMap<&'a str, Span>,
    ) {
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
        let unit = declaration
            .unit
            .as_ref()
            .and_then(|unit| Some((self.unit(unit, rotary, Some(id))?, self.bracketed(unit.span))));
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
            unreadable: declaration.unit.is_some() && unit.is_none() || self.loaded.misread(declaration.span),
            unit,
            shown,
            range: VarRange::default(),
            range_span: None,
            definition: Definition::Missing,
            doc: declaration.doc.clone(),
        });
        self.bind(id, &name.text, Binding::Var(var));
    }

    /// Adds a parameter of the root beside its own; returns its name with a node that reads it.
    pub(super) fn declare_unknown(&mut self, declared: &Declared) -> (String, ExprId) {
        let (name, unit, place) = (&declared.name, declared.unit.clone(), declared.name.span);
        let (dimension, angle) = unit.as_ref().map_or((None, Angle::Silent), |unit| (Some(unit.dimension), unit.angle));
        let number = Node::Number { value: declared.value, dimension, angle };
        let value = self.system.push(number, place);
        let var = self.add_var(Var {
            path: declared.path.clone(),
            name: name.text.clone(),
            span: place,
            instance: InstanceId(0),
            kind: VarKind::Param,
            unreadable: unit.is_none(),
            unit: unit.map(|unit| (unit, place)),
            shown: None,
            range: VarRange::default(),
            range_span: None,
            definition: Definition::Value(value, Origin::Default),
            doc: None,
        });
        (name.text.clone(), self.system.push(Node::Var(var), place))
    }

    pub(super) fn add_var(&mut self, var: Var) -> VarId {
        self.system.vars.push(var);
        VarId(self.system.vars.len() as u32 - 1)
    }

    /// The span of a declared unit including its brackets.
    pub(super) fn bracketed(&self, span: Span) -> Span {
        let text = self.loaded.files.get(span.file).text.as_bytes();
        let (before, behind) = ((span.start as usize).wrapping_sub(1), span.end as usize);
        match (text.get(before), text.get(behind)) {
            (Some(b'['), Some(b']')) => Span::new(span.file, before, behind + 1),
            _ => span,
        }
    }

    /// The span of a bound including its operator: `>= 0`.
    pub(super) fn with_operator(&self, span: Span) -> Span {
        let before = &self.loaded.files.get(span.file).text[..span.start as usize];
        let operator = before.trim_end().trim_end_matches(['<', '>', '=']);
        Span::new(span.file, operator.len(), span.end as usize)
    }

    /// Reads a unit and maps it for a rotary instance. Reports an error if there is none.
    pub(super) fn unit(&mut self, unit: &ast::UnitText, rotary: bool, owner: Option<InstanceId>) -> Option<Unit> {
        match Unit::parse(&unit.text) {
            Ok(parsed) => {
                if rotary && parsed.angle == Angle::Angle {
                    self.not_rotary(owner, unit.span, NotRotary::Angle);
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

    pub(super) fn not_rotary(&mut self, owner: Option<InstanceId>, span: Span, why: NotRotary) {
        if let Some(id) = owner {
            if self.system.strangers.contains(&id) {
                return;
            }
            self.system.strangers.push(id);
        }
        let (label, help) = match why {
            NotRotary::Angle => (
                "speaks of an angle already",
                "leave out `rotary`: a model in rad and N·m is rotary as it is, and fits a rotary slot",
            ),
            NotRotary::StraightConstant => (
                "a constant with a straight unit inside an equation",
                "`rotary` maps m to rad and kg to kg·m^2 throughout: only a model in straight units has a rotary twin",
            ),
        };
        let error = Diagnostic::error("E0109", "this model cannot be made rotary").label(span, label).help(help);
        self.report(error);
    }

    /// Instantiates the parts of an instance.
    pub(super) fn parts(&mut self, id: InstanceId, changes: Vec<Change<'a>>) {
        let model = self.tree(id).model;
        let env = self.env(id);
        for statement in &model.body {
            let Statement::Part(part) = statement else { continue };
            if self.refused_parts.contains(&part.name.span) {
                continue;
            }
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

    pub(super) fn unknown_part(&mut self, id: InstanceId, name: &Name) {
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

    pub(super) fn repeated(
        &mut self,
        id: InstanceId,
        part: &'a ast::Part,
        repeat: &'a ast::Repeat,
        env: &Env,
        changes: Vec<Change<'a>>,
    ) {
        // Also read as expressions, so that their parameters count as used.
        let counts = [self.expr(&repeat.first, env), self.expr(&repeat.last, env)];
        self.system.counts.extend(counts);
        let bounds = (self.whole(&repeat.first, env), self.whole(&repeat.last, env));
        let (Some(first), Some(last)) = bounds else { return };
        if last < first || (last - first) as usize >= MOST_VARS {
            let error =
                Diagnostic::error("E0502", format!("`{}` cannot repeat from {first} to {last}", part.name.text))
                    .label(repeat.span, "this range")
                    .help(format!(
                        "the last index is at least the first, and there are at most {MOST_VARS} quantities"
                    ));
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
        }
        self.bind(id, &part.name.text, Binding::Parts(Rc::new(made), first));
    }

    /// Instantiates one part; a change or an argument may put another model into its slot.
    pub(super) fn part(
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
                        let error =
                            Diagnostic::error("E0205", format!("`{}` of {owner} is not a slot", part.name.text))
                                .label(arg.span, "another model cannot be put here")
                                .label(part.name.span, "declared without an interface")
                                .help(format!(
                                    "a slot is declared as `part {0} : INTERFACE = …`; what is inside of `{0}` is changed by its path, `sweep {0}.NAME = …` or `--set {0}.NAME=…`",
                                    part.name.text
                                ));
                        self.report(error);
                    } else {
                        chosen = (instance, arg.env);
                        replaced = true;
                    }
                }
                ArgValue::Expr(expr) => {
                    let word = self.loaded.files.slice(expr.span);
                    let model = self.loaded.find(arg.env.file, Space::Type, word);
                    let model = if matches!(model, Lookup::Found(_, Item::Model(_) | Item::Variant(_))) {
                        word
                    } else {
                        "Model"
                    };
                    let between = if model == word { "" } else { "…" };
                    let error = Diagnostic::error("E0205", format!("`{}` is a part: it takes a model", part.name.text))
                        .label(arg.span, if model == word { "a model is made by `()`" } else { "a value" })
                        .help(format!("write `{} = {model}({between})`", part.name.text));
                    self.report(error);
                }
            }
        }
        changes.retain(|change| !change.path.is_empty());
        let (instance, instance_env) = chosen;
        let found = self.model(instance_env.file, &instance.model)?;
        let (item, model) = (found.item, found.model);
        if self.models.len() >= DEEPEST && !self.models.contains(&item) {
            let error = Diagnostic::error("E0211", format!("parts are nested more than {DEEPEST} deep"))
                .recurring(Recurring::Depth)
                .label(instance.model.span, "one too deep")
                .help("make parts of the same model side by side, as an array or by name");
            self.report(error);
            return None;
        }
        if self.models.contains(&item) {
            let error = Diagnostic::error("E0211", format!("{} contains itself", model.name.text))
                .recurring(Recurring::Part)
                .label(instance.model.span, "here it is made again")
                .help("a part cannot contain the model that it belongs to");
            self.report(error);
            return None;
        }
        let parent_rotary = self.system.instance(id).rotary;
        let rotary = instance.rotary || instance_env.rotary || found.rotary;
        if self.full(part.repeat.as_ref().map_or(instance.model.span, |repeat| repeat.span)) {
            return None;
        }
        let (mut args, mut inner) = found.with(instance, &instance_env);
        inner.extend(changes);
        let changes = inner;
        let mut fits = true;
        if let Some(slot) = &part.slot {
            let wiring = args_of(&part.instance.args, env);
            let file = self.tree(id).file;
            let slot_rotary = slot.rotary || parent_rotary;
            let ports = self.interface(file, slot)?;
            fits = self.check_fit(model, instance, rotary, ports, slot, slot_rotary);
            let has = |name: &str| declarations(model).any(|d| d.kind == DeclarationKind::Input && d.name.text == name);
            let port = |name: &str| ports.ports.iter().any(|port| port.name.text == name);
            if replaced {
                let given: Vec<&str> = args.iter().map(|arg| arg.name).collect();
                args.extend(wiring.into_iter().filter(|arg| port(arg.name) && !given.contains(&arg.name)));
            }
            // Arguments for optional ports that this model lacks are dropped.
            let (kept, dropped) = args.into_iter().partition(|arg| !port(arg.name) || has(arg.name));
            args = kept;
            self.dropped.extend::<Vec<_>>(dropped);
        }
        self.models.push(item);
        let made = Instantiation { path, rotary, span: instance.model.span, args, overrides: changes };
        let made = self.instantiate(model, item.file, made, false);
        self.models.pop();
        if !fits {
            // Missing ports and mismatched units have been reported.
            self.system.strangers.push(made);
        }
        Some(made)
    }

    pub(super) fn interface(&mut self, file: FileId, slot: &'a ast::SlotType) -> Option<&'a ast::Interface> {
        let loaded = self.loaded;
        match loaded.find(file, Space::Type, &slot.interface.text) {
            Lookup::Found(_, Item::Interface(interface)) => return Some(interface),
            Lookup::Ambiguous(a, b) => self.ambiguous(&slot.interface, a, b),
            Lookup::Missing if self.explained(&slot.interface, file) => {}
            Lookup::Found(..) | Lookup::Missing => {
                let mut error = Diagnostic::error("E0201", format!("there is no interface `{}`", slot.interface.text))
                    .label(slot.interface.span, "not declared and not imported");
                let names = loaded.visible(file, Space::Type);
                let interface =
                    |name: &&str| matches!(loaded.find(file, Space::Type, name), Lookup::Found(_, Item::Interface(_)));
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

    /// Whether a model has the ports of an interface; reports the differences.
    #[allow(clippy::too_many_arguments)]
    pub(super) fn check_fit(
        &mut self,
        model: &'a ast::Model,
        instance: &'a ast::Instance,
        rotary: bool,
        interface: &'a ast::Interface,
        slot: &'a ast::SlotType,
        slot_rotary: bool,
    ) -> bool {
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
                Some(d) if d.kind != port.kind => {
                    format!("its `{}` is {} `{}`", d.name.text, article(d.kind.word()), d.kind.word())
                }
                Some(d) => match (dimension(&d.unit, rotary), dimension(&port.unit, slot_rotary)) {
                    (Some(has), Some(needs)) if has != needs => {
                        if has.rotary() == needs || needs.rotary() == has {
                            let (model_is, help) = if slot_rotary {
                                ("straight", format!("write `rotary {name}(…)`"))
                            } else {
                                ("rotary", format!("write `{name}(…)` without `rotary`"))
                            };
                            let error =
                                Diagnostic::error("E0108", format!("{name} is {model_is} here, the slot is not"))
                                    .label(
                                        instance.model.span,
                                        format!("its `{}` is in {}", d.name.text, Unit::si(has)),
                                    )
                                    .label(slot.interface.span, format!("expects {}", Unit::si(needs)));
                            self.report(error.help(help));
                            return false;
                        }
                        format!("its `{}` is {}, not {}", d.name.text, has.describe(), needs.describe())
                    }
                    _ => continue,
                },
            };
            let error = Diagnostic::error("E0206", format!("{name} does not fit {}", interface.name.text))
                .label(instance.model.span, problem)
                .label(slot.interface.span, format!("asks for `{wanted}`"))
                .help(format!(
                    "a model fits {} when it has its ports with these units; add `{wanted}`",
                    interface.name.text
                ));
            self.report(error);
            return false;
        }
        true
    }

    /// Checks that every argument names a port, a parameter, a slot, or a state (for its start value).
    pub(super) fn check_arguments(&mut self, id: InstanceId) {
        let tree = self.tree(id);
        let model = tree.model;
        let mut seen: HashMap<&str, Span> = HashMap::default();
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
            let owner = &model.name.text;
            let message = match declared {
                _ if part => continue,
                Some(d) if takes(d.kind) => match arg.value {
                    ArgValue::Expr(_) => continue,
                    ArgValue::Instance(_) if d.kind == DeclarationKind::State => {
                        format!("state `{}` of {owner} takes its start value, not a model", arg.name)
                    }
                    ArgValue::Instance(_) => format!("`{}` of {owner} takes a value, not a model", arg.name),
                },
                Some(d) => {
                    let kind = d.kind.word();
                    format!("`{}` is {} {kind} of {owner}: it cannot be given", arg.name, article(kind))
                }
                None if modes(model).any(|mode| mode.name.text == arg.name) => {
                    let error = Diagnostic::error("E0205", format!("`{}` is a regime of {owner}: it cannot be given", arg.name))
                        .label(arg.span, "no such argument")
                        .help("a model starts in its `initial` regime and leaves it at once where a `go` says so: give states and inputs that it asks for");
                    errors.push(error);
                    continue;
                }
                None => format!("{owner} has no `{}`", arg.name),
            };
            let mut error = Diagnostic::error("E0205", message).label(arg.span, "no such argument");
            let given = |state: bool| {
                let of_kind = move |d: &&ast::Declaration| takes(d.kind) && (d.kind == DeclarationKind::State) == state;
                declarations(model).filter(of_kind).map(|d| d.name.text.as_str()).collect::<Vec<_>>()
            };
            let (values, states) = (given(false), given(true));
            let near = nearest(arg.name, values.iter().chain(&states).copied());
            // `Fcoul` for `Fc`: a name that goes on.
            let begun = |known: &&&str| known.len() >= 2 && arg.name.starts_with(**known);
            let near = near.or(values.iter().chain(&states).filter(begun).max_by_key(|known| known.len()).copied());
            error = match (near, &*values, &*states) {
                // A short name is near to many: all arguments are listed.
                (Some(near), [_, _, ..], _)
                    if values.len() <= MOST_TAKEN && (arg.name.len() <= 3 || arg.name.starts_with(near)) =>
                {
                    error.help(format!("did you mean `{near}`? {owner} takes {}", values.join(", ")))
                }
                (Some(near), ..) => error.help(format!("did you mean `{near}`?")),
                (None, [], []) => error.help(format!("{owner} takes no arguments")),
                (None, _, []) => error.help(format!("{owner} takes {}", values.join(", "))),
                (None, [], _) => error.help(format!("{owner} takes start values of {}", states.join(", "))),
                (None, ..) => {
                    error.help(format!("{owner} takes {}; start values of {}", values.join(", "), states.join(", ")))
                }
            };
            errors.push(error);
        }
        self.diagnostics.extend(errors);
    }

    /// Whether an unknown argument is a likely misspelling of this name.
    pub(super) fn misspelt(&self, id: InstanceId, name: &str) -> bool {
        let tree = self.tree(id);
        let taken = || declarations(tree.model).filter(|d| takes(d.kind)).map(|d| d.name.text.as_str());
        let names = |text: &str| tree.names.contains_key(text);
        tree.args.iter().any(|arg| !names(arg.name) && nearest(arg.name, taken()) == Some(name))
    }

    pub(super) fn env(&self, id: InstanceId) -> Env {
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

    /// A whole number known at compile time: a bound of a repetition.
    pub(super) fn whole(&mut self, expr: &'a Expr, env: &Env) -> Option<i64> {
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

    /// Evaluates simple arithmetic over numbers, constants and parameters at compile time.
    pub(super) fn early(&mut self, expr: &'a Expr, env: &Env, depth: usize) -> Option<f64> {
        if depth > DEEPEST {
            return None;
        }
        let mut value = |e: &'a Expr| self.early(e, env, depth + 1);
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
                        // A state does not keep its start value.
                        let keeps = declaration.kind != DeclarationKind::State;
                        let arg = tree.args.iter().find(|arg| keeps && arg.name == name);
                        let arg = arg.map(|arg| (arg.value, arg.env.clone()));
                        self.system.structural.push(joined(&self.system.instance(id).path, name));
                        if let Some((value, env)) = arg {
                            let ArgValue::Expr(expr) = value else { return None };
                            return self.early(expr, &env, depth + 1);
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
}

/// Whether an argument may name it. The argument of a state is its start value.
fn takes(kind: DeclarationKind) -> bool {
    match kind {
        DeclarationKind::Param | DeclarationKind::Input | DeclarationKind::State => true,
        DeclarationKind::Output | DeclarationKind::Let => false,
    }
}
