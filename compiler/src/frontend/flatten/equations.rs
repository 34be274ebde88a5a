//! Equations: reads all definitions of an instance and checks that each quantity is defined exactly once in every
//! regime, by an expression, by a rate, or at ticks.
//!
//! In: declared instances. Out: definitions in the [`System`]. Knows nothing of units.

use super::*;

impl<'a> Flattener<'a> {
    /// Reads all expressions of an instance.
    pub(super) fn define(&mut self, id: InstanceId) {
        let model = self.tree(id).model;
        let env = self.env(id);
        let equations = Env { equation: true, ..env.clone() };
        // Where each quantity is defined, to report second definitions.
        let mut defined: HashMap<VarId, Span> = HashMap::default();
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
                    self.system.requires.push(Require {
                        instance: id,
                        condition,
                        message,
                        span: require.condition.span,
                    });
                }
                Statement::Storage(storage) => {
                    let energy = self.expr(&storage.energy, &equations);
                    self.system.storages.push((id, energy));
                }
                Statement::Allow(allow) => self.lint(&allow.lint),
                Statement::Declaration(_) | Statement::Part(_) | Statement::Mode(_) => {}
            }
        }
        self.regimes(id, &equations, &mut defined, &mut rates);
        self.rates(rates);
        self.undefined(id, &defined);
    }

    pub(super) fn lint(&mut self, lint: &Name) {
        if let Some(error) = unknown_lint(lint) {
            self.report(error);
        }
    }

    pub(super) fn var_named(&self, id: InstanceId, name: &str) -> Option<VarId> {
        match self.tree(id).names.get(name) {
            Some(Binding::Var(var)) => Some(*var),
            _ => None,
        }
    }

    pub(super) fn define_declaration(
        &mut self,
        id: InstanceId,
        declaration: &'a ast::Declaration,
        env: &Env,
        defined: &mut HashMap<VarId, Span>,
    ) {
        let name = &declaration.name;
        let Some(var) = self.var_named(id, &name.text) else { return };
        if self.system.var(var).span != name.span {
            return; // Declared twice, reported; the first declaration is used.
        }
        if let Some(range) = &declaration.range {
            let (range, span) = self.range(range, env);
            let var = &mut self.system.vars[var.0 as usize];
            (var.range, var.range_span) = (range, Some(span));
        }
        let given = match declaration.kind {
            DeclarationKind::Param | DeclarationKind::Input | DeclarationKind::State => {
                self.tree(id).args.iter().find(|arg| arg.name == name.text).cloned()
            }
            DeclarationKind::Output | DeclarationKind::Let => None,
        };
        let definition = match (given, &declaration.value) {
            (Some(Arg { value: ArgValue::Expr(expr), env, span, overriding, .. }), _) => {
                let value = self.expr(expr, &env);
                let model = self.system.instance(id).span;
                let origin = if overriding { Origin::Override } else { Origin::Argument { model, bind: span } };
                match declaration.kind {
                    DeclarationKind::State => {
                        self.system.starts.push((var, origin));
                        Definition::Continuous { initial: value, rate: value, path: None, span: name.span }
                    }
                    _ => Definition::Value(value, origin),
                }
            }
            (Some(_), _) if declaration.kind != DeclarationKind::State => Definition::Missing, // Reported with the arguments.
            (Some(_), None) => Definition::Missing,
            (Some(_), Some(value)) => {
                let value = self.expr(value, env);
                Definition::Continuous { initial: value, rate: value, path: None, span: name.span }
            }
            (None, value)
                if declaration.kind == DeclarationKind::Input
                    && self.tree(id).alone
                    && (value.is_none() || !self.tree(id).defaults) =>
            {
                Definition::Free
            }
            (None, _) if declaration.kind == DeclarationKind::Input && self.tree(id).on_bus => Definition::Free,
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
                // The misspelt argument has been reported.
                DeclarationKind::Param | DeclarationKind::Input if self.misspelt(id, &name.text) => Definition::Missing,
                // A model that does not match its slot has been reported there.
                DeclarationKind::Param | DeclarationKind::Input if self.system.strangers.contains(&id) => {
                    Definition::Missing
                }
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
                        .help(match &declaration.unit {
                            Some(unit) => format!("write `state {} [{}] = 0`", name.text, unit.text),
                            None => format!("write `state {} = 0`", name.text),
                        });
                    self.report(error);
                    let zero = self.system.push(zero(), name.span);
                    Definition::Continuous { initial: zero, rate: zero, path: None, span: name.span }
                }
                DeclarationKind::Output | DeclarationKind::Let => Definition::Missing,
            },
        };
        self.system.vars[var.0 as usize].definition = definition;
    }

    pub(super) fn range(&mut self, range: &'a ast::Range, env: &Env) -> (VarRange, Span) {
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

    pub(super) fn equation(
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
            DefinitionKind::Value => {
                let origin = Origin::Equation(equation.target.span());
                self.system.vars[var.0 as usize].definition = Definition::Value(value, origin);
            }
            DefinitionKind::Rate { along } => rates.push((var, Rate { value, along, span: equation.target.span() })),
            DefinitionKind::Next => {
                self.refused.push(var);
                let error = Diagnostic::error("E0308", "`next` belongs inside an `every` block")
                    .label(equation.target.span(), "when is the next tick?")
                    .help(format!("write `every Ts {{ next({}) = … }}`", equation.target.name().text));
                self.report(error);
            }
        }
    }

    /// The quantity that an equation defines, and the kind of definition.
    pub(super) fn target(&mut self, id: InstanceId, target: &'a Target) -> Option<(VarId, DefinitionKind)> {
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
                self.unknown_target(id, name);
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

    pub(super) fn wanted(
        &mut self,
        id: InstanceId,
        target: &'a Target,
        var: VarId,
        kind: VarKind,
        declared: Span,
    ) -> Option<(VarId, DefinitionKind)> {
        let name = target.name();
        match (target, kind) {
            (Target::Name(_), VarKind::Output | VarKind::Let) => Some((var, DefinitionKind::Value)),
            (Target::Next { .. }, VarKind::State) => Some((var, DefinitionKind::Next)),
            (Target::Derivative { along, .. }, VarKind::State) => {
                if along.text == "t" {
                    return Some((var, DefinitionKind::Rate { along: None }));
                }
                match self.var_named(id, &along.text) {
                    Some(path) if self.system.var(path).kind == VarKind::State => {
                        Some((var, DefinitionKind::Rate { along: Some((path, along.span)) }))
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
                let error =
                    Diagnostic::error("E0301", format!("`{}` is a state: it has no equation of its own", name.text))
                        .label(target.span(), "a state changes, it is not computed")
                        .label(declared, "declared here")
                        .help(format!("say how it changes, `d{0}/dt = …`, or declare it as `let {0} = …`", name.text));
                self.report(error);
                None
            }
            (Target::Name(_), _) => {
                let kind = kind.word();
                let error = Diagnostic::error(
                    "E0301",
                    format!("`{}` is {} {kind}: its value comes from outside", name.text, article(kind)),
                )
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

    /// Records a definition. Reports a second one and returns false.
    pub(super) fn once(&mut self, var: VarId, span: Span, defined: &mut HashMap<VarId, Span>) -> bool {
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
                        .help(format!(
                            "a state is continuous, `d{name}/dt = …`, or sampled, `next({name}) = …`: keep one"
                        ));
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

    pub(super) fn every(
        &mut self,
        id: InstanceId,
        every: &'a ast::Every,
        env: &Env,
        defined: &mut HashMap<VarId, Span>,
    ) {
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
                        DefinitionKind::Value => {
                            if self.once(var, span, defined) {
                                let origin = Origin::Equation(span);
                                self.system.vars[var.0 as usize].definition = Definition::Held { value, block, origin };
                            }
                        }
                        DefinitionKind::Next => {
                            if self.once(var, span, defined)
                                && let Definition::Continuous { initial, .. } = self.system.var(var).definition
                            {
                                self.system.vars[var.0 as usize].definition =
                                    Definition::Sampled { initial, next: value, block };
                            }
                        }
                        DefinitionKind::Rate { .. } => {
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

    pub(super) fn resets(&mut self, id: InstanceId, resets: &'a [ast::Reset], env: &Env) -> Vec<(VarId, ExprId)> {
        let mut out = Vec::new();
        for reset in resets {
            let value = self.expr(&reset.value, env);
            match self.var_named(id, &reset.name.text) {
                Some(var) if matches!(self.system.var(var).kind, VarKind::State | VarKind::Input) => {
                    self.system.reset_places.push((value, reset.name.span));
                    out.push((var, value));
                }
                Some(var) => {
                    let error =
                        Diagnostic::error("E0307", format!("`{}` is no state: it cannot be reset", reset.name.text))
                            .label(reset.name.span, "only a state keeps a value, or an input that is one elsewhere")
                            .label(self.system.var(var).span, "declared here");
                    self.report(error);
                }
                None => self.unknown(id, &reset.name),
            }
        }
        out
    }

    pub(super) fn regimes(
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
            along: Option<PathVariable>,
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
                    let mut one = HashMap::from_iter([(var, first.span)]);
                    self.once(var, span, &mut one);
                    continue;
                }
                let along = match wanted {
                    DefinitionKind::Value => None,
                    DefinitionKind::Rate { along } => Some(along),
                    DefinitionKind::Next => {
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
        let transitions: Vec<Vec<Transition>> =
            modes.iter().map(|mode| self.transitions(id, mode, &modes, env)).collect();
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
                let error =
                    Diagnostic::error("E0305", format!("regime `{}` does not say what `{name}` is", mode.name.text))
                        .label(first.statement, format!("`{}` defines {name}", other.name.text))
                        .label(mode.head, format!("`{}` does not", mode.name.text))
                        .help(format!(
                            "every regime defines the same quantities; add `{text} = ...` to `{}`",
                            mode.name.text
                        ));
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
            let ones: Vec<(Option<PathVariable>, ExprId)> = by_mode
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

    pub(super) fn transitions(
        &mut self,
        id: InstanceId,
        mode: &'a ast::Mode,
        modes: &[&'a ast::Mode],
        env: &Env,
    ) -> Vec<Transition> {
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

    /// Turns rates into definitions of states. Rates along a path are multiplied by the rate of the path variable.
    pub(super) fn rates(&mut self, rates: Vec<(VarId, Rate)>) {
        // First the rates along time, then repeatedly those whose path variable has its rate.
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
                    _ => rate.value, // The path variable has no equation, which has been reported.
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

    pub(super) fn set_rate(&mut self, var: VarId, value: ExprId, path: Option<(ExprId, VarId)>, span: Span) {
        let definition = &mut self.system.vars[var.0 as usize].definition;
        if let Definition::Continuous { initial, .. } = *definition {
            // Replaces the provisional definition, in which a state's initial value serves as its rate.
            *definition = Definition::Continuous { initial, rate: value, path, span };
        }
    }

    /// `value · speed`. Merges `sign(v)` with a speed of `abs(v)`, so that the product has no jump in time.
    pub(super) fn times_speed(&mut self, value: ExprId, speed: ExprId, span: Span) -> ExprId {
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
            Node::Binary(BinaryOp::Multiply, a, b) => {
                Node::Binary(BinaryOp::Multiply, a, self.times_speed(b, speed, span))
            }
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

    /// Whether `sign(inner)` occurs in the expression as a factor that can be merged.
    pub(super) fn has_sign(&self, value: ExprId, inner: ExprId) -> bool {
        match self.system.node(value) {
            Node::Call(Builtin::Sign, args) => self.same(args[0], inner),
            Node::Negate(a) | Node::Fits { value: a, .. } => self.has_sign(*a, inner),
            Node::Binary(BinaryOp::Add | BinaryOp::Subtract | BinaryOp::Multiply, a, b) => {
                self.has_sign(*a, inner) || self.has_sign(*b, inner)
            }
            Node::Binary(BinaryOp::Divide, a, _) => self.has_sign(*a, inner),
            Node::If(_, a, b) => self.has_sign(*a, inner) || self.has_sign(*b, inner),
            Node::Var(var) => match self.system.var(*var).definition {
                Definition::Value(value, _) if self.system.var(*var).kind == VarKind::Let => {
                    self.has_sign(value, inner)
                }
                _ => false,
            },
            _ => false,
        }
    }

    /// Whether two expressions have the same structure.
    pub(super) fn same(&self, a: ExprId, b: ExprId) -> bool {
        if a == b {
            return true;
        }
        match (self.system.node(a), self.system.node(b)) {
            (Node::Var(a), Node::Var(b)) => a == b,
            (Node::Negate(a), Node::Negate(b)) => self.same(*a, *b),
            (Node::Binary(op, a, b), Node::Binary(other, c, d)) => {
                op == other && self.same(*a, *c) && self.same(*b, *d)
            }
            _ => false,
        }
    }

    /// Reports quantities without a definition.
    pub(super) fn undefined(&mut self, id: InstanceId, defined: &HashMap<VarId, Span>) {
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
}
