//! Expressions: resolves names to quantities, expands functions in place, and converts numbers to SI units.
//!
//! In: syntax trees of expressions and an [`Env`]. Out: nodes of the arena. Knows nothing of units beyond literals.

use super::*;

/// The longest end of a text of characters that `belongs` accepts.
fn last_run(text: &str, belongs: impl Fn(char) -> bool) -> &str {
    &text[text.trim_end_matches(belongs).len()..]
}

/// `an input`, `a param`
fn kind_with_article(kind: DeclarationKind) -> String {
    let word = kind.word();
    format!("{} {word}", if word.starts_with(['i', 'o']) { "an" } else { "a" })
}

/// The state whose derivative a name such as `vdot` or `v_dot` of other languages means.
fn dotted(name: &str) -> Option<&str> {
    ["_dot", "dot", "_d", "Dot"].iter().find_map(|ending| name.strip_suffix(ending)).filter(|state| !state.is_empty())
}

/// Limit on the quantities of a model that a message lists.
const MOST_LISTED: usize = 12;

impl<'a> Flattener<'a> {
    /// E0204 for the left side of an equation: a derivative in the notation of another language, or a quantity that is
    /// not declared, which is reported once for all its equations and uses.
    pub(super) fn unknown_target(&mut self, id: InstanceId, name: &Name) {
        let derivative = dotted(&name.text).and_then(|state| Some((state, self.var_named(id, state)?)));
        if let Some((state, var)) = derivative {
            // It lacks its equation for the same reason.
            self.refused.push(var);
            let model = &self.tree(id).model.name.text;
            let error = Diagnostic::error("E0204", format!("there is no `{}` in {model}", name.text));
            let error = error.label(name.span, "not declared");
            self.report(error.help(format!("the derivative of `{state}` is written `d{state}/dt`")));
            return;
        }
        let tree = self.tree(id);
        let (model, file) = (tree.model, tree.file);
        let near = nearest(&name.text, declarations(model).map(|declared| declared.name.text.as_str())).is_some();
        if near || name.span.file != file || self.explained(name, file) || self.system.strangers.contains(&id) {
            return self.unknown(id, name);
        }
        let key = (id, name.text.clone());
        if !self.undeclared.contains(&key) {
            self.undeclared.push(key);
            let error = Diagnostic::error("E0204", format!("there is no `{}` in {}", name.text, model.name.text));
            let error = error.label(name.span, "not declared");
            self.report(error.help(format!("write `let {} = …`, or `output` if others read it", name.text)));
        }
    }

    /// E0204: an unknown name.
    pub(super) fn unknown(&mut self, id: InstanceId, name: &Name) {
        let tree = self.tree(id);
        let model = tree.model;
        // Its equation lacks the declaration, and is reported.
        let is_defined = model.body.iter().any(|statement| match statement {
            Statement::Equation(ast::Equation { target: Target::Name(target), .. }) => {
                target.text == name.text && target.span != name.span
            }
            _ => false,
        });
        let near = || nearest(&name.text, declarations(model).map(|declared| declared.name.text.as_str())).is_some();
        if is_defined && name.span.file == tree.file && !near() {
            return;
        }
        if self.explained(name, tree.file) || self.system.strangers.contains(&id) {
            return;
        }
        let error = Diagnostic::error("E0204", format!("there is no `{}` in {}", name.text, model.name.text))
            .label(name.span, "not declared");
        let all = declarations(model).map(|d| d.name.text.as_str());
        let parts = model.body.iter().filter_map(|s| match s {
            Statement::Part(part) => Some(part.name.text.as_str()),
            Statement::Mode(mode) => Some(mode.name.text.as_str()),
            _ => None,
        });
        let consts = self.loaded.visible(tree.file, Space::Const);
        let file = tree.file;
        self.unknowns += 1;
        let near = match self.unknowns <= MOST_SUGGESTIONS {
            true => nearest(&name.text, all.chain(parts).chain(consts)),
            false => None,
        };
        let error = match near {
            Some(near) => match declarations(model).find(|d| d.name.text == near) {
                Some(d) => error.help(format!("did you mean `{near}` ({})?", self.described(d))),
                None => error.help(format!("did you mean `{near}`?")),
            },
            None if name.text == "time" => error.help("time is `t`"),
            // The user cannot add declarations to a model of another file from here, so its own names are listed.
            None if name.span.file != file || self.loaded.files.get(file).library => {
                let mut known: Vec<&str> = declarations(model).map(|d| d.name.text.as_str()).collect();
                let more = known.len().saturating_sub(MOST_LISTED);
                known.truncate(MOST_LISTED);
                let more = if more > 0 { format!(" and {more} more") } else { String::new() };
                match known.is_empty() {
                    true => error.help(format!("nothing of this name is known here; quantities of a part are `part.{}`", name.text)),
                    false => error.help(format!("{} has {}{more}", model.name.text, known.join(", "))),
                }
            }
            None if dotted(&name.text).is_some_and(|state| declarations(model).any(|d| d.name.text == state)) => {
                let state = dotted(&name.text).unwrap_or_default();
                error.help(format!("the derivative of `{state}` is written `d{state}/dt`"))
            }
            None if name.text == "s" => error.help(
                "a unit stands right after its number: `2 N/s`; a transfer function is written as equations, `dy/dt = (u - y) / T`;\nfor a quantity of this name declare it, `param s = …`",
            ),
            None if Unit::parse(&name.text).is_ok() => error.help(format!(
                "a unit stands right after its number, without parentheses: `2 N/{0}`; for a quantity of this name declare it, `param {0} = …`",
                name.text
            )),
            None => error.help(format!("declare it, for example `param {} = …` or `let {} = …`", name.text, name.text)),
        };
        self.report(error);
    }

    /// Whether an error already explains the unknown name: its declaration could not be used, or it is the denominator
    /// of a derivative that has been reported.
    pub(super) fn explained(&self, name: &Name, file: FileId) -> bool {
        let lost = &self.loaded.files.get(file).ast.lost;
        lost.contains(&name.text) || self.derivatives_read.contains(&name.span)
    }

    /// Reports `fr.dz/dt`, where `z` is a quantity of a part: the parser reads it as a division, but a derivative is
    /// meant.
    fn derivative_of_part(&mut self, part: InstanceId, path: &ast::Path, name: &Name, env: &Env) -> bool {
        let state = name.text.strip_prefix('d').filter(|state| self.tree(part).names.contains_key(*state));
        let (Some(state), Some((along, place))) = (state, self.below(name)) else { return false };
        let model = &self.tree(part).model.name.text;
        let derivative = format!("{}/{along}", name.text);
        let error = Diagnostic::error("E0204", format!("`{derivative}` of {model} cannot be read from outside"))
            .label(name.span.to(place), "a derivative of a part")
            .help(match env.outside {
                true => {
                    let text = self.loaded.files.slice(path.span);
                    let owner = text.strip_suffix(name.text.as_str()).unwrap_or_default();
                    format!("write `slope({owner}{state})`")
                }
                false => format!("give {model} an output, `output rate_of_{state} = {derivative}`, and read that"),
            });
        self.derivatives_read.push(place);
        self.report(error);
        true
    }

    /// The denominator of a derivative such as `dv/dt` that begins with this name, and its span.
    fn below(&self, name: &Name) -> Option<(&'a str, Span)> {
        let loaded: &'a Loaded = self.loaded;
        let text = &loaded.files.get(name.span.file).text;
        let below = text[name.span.end as usize..].strip_prefix('/').filter(|below| below.starts_with('d'))?;
        let length = below.find(|c: char| !c.is_ascii_alphanumeric() && c != '_').unwrap_or(below.len());
        let start = name.span.end as usize + 1;
        Some((&below[..length], Span::new(name.span.file, start, start + length)))
    }

    /// Reports `dv/dt` for a declared `v` that is no state.
    fn derivative_of_no_state(&mut self, id: InstanceId, name: &Name) -> bool {
        let Some(of) = name.text.strip_prefix('d') else { return false };
        let Some(kind) = declarations(self.tree(id).model).find(|d| d.name.text == of).map(|d| d.kind) else {
            return false;
        };
        let Some((along, place)) = self.below(name).filter(|(along, _)| *along == "dt") else { return false };
        let error = Diagnostic::error("E0307", format!("`{of}` is {}, only a state has a derivative", kind_with_article(kind)))
            .label(name.span.to(place), "no such derivative")
            .help(match kind {
                DeclarationKind::Input => format!(
                    "let the model that knows it give it: `input rate_of_{of} [...]`, and there `output rate_of_{of} = d{of}/{along}`"
                ),
                _ => format!("write out how fast `{of}` changes, or declare a state for it"),
            });
        self.derivatives_read.push(place);
        self.report(error);
        true
    }

    /// Reports `9.81 m / s^2`: after the blanks the parser reads a name instead of a unit.
    fn spaced_unit(&mut self, name: &Name) -> bool {
        let text = &self.loaded.files.get(name.span.file).text;
        let (before, behind) = (&text[..name.span.start as usize], &text[name.span.end as usize..]);
        let Some(front) = before.trim_end_matches(' ').strip_suffix(['/', '*']) else { return false };
        let sign = if before.trim_end_matches(' ').ends_with('/') { '/' } else { '·' };
        let front = front.trim_end_matches(' ');
        let word = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_');
        let unit = last_run(front, |c| word(c) || matches!(c, '/' | '·' | '^'));
        let unit_start = front.len() - unit.len();
        let number = last_run(front[..unit_start].trim_end_matches(' '), word);
        let power = behind
            .strip_prefix('^')
            .map_or("", |power| &behind[..1 + power.find(|c: char| !c.is_ascii_digit()).unwrap_or(power.len())]);
        let whole = format!("{unit}{sign}{}{power}", name.text);
        let spaced = number.parse::<f64>().is_ok() && Unit::parse(unit).is_ok() && Unit::parse(&whole).is_ok();
        if !spaced {
            return false;
        }
        let (start, end) = (unit_start, name.span.end as usize + power.len());
        let error = Diagnostic::error("E0110", "a unit is written without spaces")
            .label(
                Span::new(name.span.file, start, end),
                format!("reads as {number} {unit}, and then a name `{}`", name.text),
            )
            .help(format!("write `{number} {whole}`"));
        self.report(error);
        true
    }

    /// `param, N/m, line 4`
    pub(super) fn described(&self, declaration: &ast::Declaration) -> String {
        let unit = declaration.unit.as_ref().or(match &declaration.value {
            Some(Expr { kind: ExprKind::Number { unit, .. }, .. }) => unit.as_ref(),
            _ => None,
        });
        let unit = unit.map_or(String::new(), |unit| format!("{}, ", unit.text));
        format!("{}, {unit}line {}", declaration.kind.word(), self.loaded.files.line(declaration.name.span))
    }

    pub(super) fn error(&mut self, span: Span) -> ExprId {
        self.system.push(Node::Error, span)
    }

    /// Reads an expression; returns its node.
    pub(super) fn expr(&mut self, expr: &'a Expr, env: &Env) -> ExprId {
        // Long sums and products nest to the left: descends without recursion.
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

    pub(super) fn binary(&mut self, op: BinaryOp, a: ExprId, b: ExprId, span: Span, env: &Env) -> ExprId {
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

    pub(super) fn operand(&mut self, expr: &'a Expr, env: &Env) -> ExprId {
        let span = expr.span;
        let node = match &expr.kind {
            ExprKind::Number { value, unit } => return self.number(*value, unit.as_ref(), span, env),
            ExprKind::Path(path) => return self.path(path, env),
            ExprKind::Derivative { of, along } => return self.derivative(of, along, span, env),
            ExprKind::Call { function, args, window } => {
                return self.call(function, args, window.as_deref(), span, env);
            }
            ExprKind::Unary(UnaryOp::Negate, a) => Node::Negate(self.expr(a, env)),
            ExprKind::Unary(UnaryOp::Not, a) => Node::Not(self.expr(a, env)),
            ExprKind::If(c, a, b) => Node::If(self.expr(c, env), self.expr(a, env), self.expr(b, env)),
            ExprKind::Hole => Node::Hole,
            ExprKind::Error => Node::Error,
            ExprKind::Binary(..) => return self.expr(expr, env),
        };
        self.system.push(node, span)
    }

    pub(super) fn number(&mut self, value: f64, unit: Option<&'a ast::UnitText>, span: Span, env: &Env) -> ExprId {
        let node = match unit {
            None if value == 0.0 => zero(),
            None => Node::Number { value, dimension: Some(Dimension::NONE), angle: Angle::Silent },
            Some(text) => match Unit::parse(&text.text) {
                Err(part) => {
                    let is_name = env.instance.is_some_and(|id| self.tree(id).names.contains_key(part.as_str()));
                    let error = match read_on(text, &part).filter(|_| is_name) {
                        Some(error) => error,
                        None => unknown_unit(text, &part),
                    };
                    self.report(error);
                    Node::Error
                }
                Ok(unit) => {
                    let value = unit.to_si(value);
                    if env.rotary {
                        if unit.angle == Angle::Angle {
                            self.not_rotary(env.instance, span, NotRotary::Angle);
                        } else if env.equation && unit.dimension.rotary() != unit.dimension {
                            self.not_rotary(env.instance, span, NotRotary::StraightConstant);
                        }
                    }
                    let dimension = if env.rotary { unit.dimension.rotary() } else { unit.dimension };
                    Node::Number { value, dimension: Some(dimension), angle: unit.angle }
                }
            },
        };
        self.system.push(node, span)
    }

    pub(super) fn path(&mut self, path: &'a ast::Path, env: &Env) -> ExprId {
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
        if let Some(name) = path.single()
            && let Some(node) = self.constant(name, env)
        {
            return node;
        }
        match env.instance {
            Some(id) if path.single().is_some() && self.derivative_of_no_state(id, &head.name) => {}
            Some(_) | None if self.spaced_unit(&head.name) => {}
            Some(id) => self.unknown(id, &head.name),
            None if self.explained(&head.name, env.file) => {}
            None => {
                let visible = self.loaded.visible(env.file, Space::Const);
                let error = Diagnostic::error("E0204", format!("there is no `{}` here", head.name.text))
                    .label(head.name.span, "not declared");
                let error = match nearest(&head.name.text, visible) {
                    Some(near) => error.help(format!("did you mean `{near}`?")),
                    None => error.help(format!(
                        "constants, functions and `t` can be used here; what `sweep` or `--set` changes is a `param` of a model\naround it: `model Driven {{ param {} = …  part bench = … }}`, and `run Driven()`",
                        head.name.text
                    )),
                };
                self.report(error);
            }
        }
        self.error(path.span)
    }

    pub(super) fn recording(&mut self, path: &'a ast::Path) -> ExprId {
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

    /// Follows a path from a name of an instance through its parts.
    pub(super) fn through(&mut self, id: InstanceId, binding: Binding, path: &'a ast::Path, env: &Env) -> ExprId {
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
                    if k + 2 < path.segments.len() || !self.derivative_of_part(part, path, next, env) {
                        self.unknown(part, next);
                    }
                    return self.error(path.span);
                }
            }
        }
        unreachable!("path of instance {id:?} ended without a quantity")
    }

    pub(super) fn variable(&mut self, var: VarId, from_outside: bool, path: &'a ast::Path, env: &Env) -> ExprId {
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

    pub(super) fn constant(&mut self, name: &'a Name, env: &Env) -> Option<ExprId> {
        match self.loaded.find(env.file, Space::Const, &name.text) {
            Lookup::Found(item, Item::Const(constant)) => {
                if let Some(&node) = self.consts.get(&(item, env.rotary)) {
                    return Some(node);
                }
                if self.open_consts.contains(&item) {
                    let error = Diagnostic::error("E0211", format!("`{}` is defined by itself", name.text))
                        .recurring(Recurring::Name)
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
                    value = self.system.push(Node::Fits { value, unit: Box::new(unit), role }, constant.value.span);
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

    pub(super) fn derivative(&mut self, of: &'a Name, along: &'a Name, span: Span, env: &Env) -> ExprId {
        let var = env.instance.and_then(|id| self.var_named(id, &of.text));
        let path = env.instance.and_then(|id| self.var_named(id, &along.text));
        let node = match (var, path) {
            (Some(var), _) if along.text == "t" => Node::Rate(var),
            (Some(var), Some(_)) => Node::PathRate(var),
            _ => {
                let error =
                    Diagnostic::error("E0307", format!("there is no derivative `d{}/d{}` here", of.text, along.text))
                        .label(span, "not a state of this model")
                        .help("to watch the derivative of `x` in an experiment, write `slope(x)`");
                self.report(error);
                Node::Error
            }
        };
        self.system.push(node, span)
    }

    /// Reads a measure. `first(a rises b)` is the first instant at which `a >= b` becomes true after it was false.
    fn measure(
        &mut self,
        mut measure: MeasureName,
        args: &'a [Expr],
        window: Option<&'a ast::Window>,
        span: Span,
        env: &Env,
    ) -> ExprId {
        let value = match (&args[0].kind, measure) {
            (
                ExprKind::Binary(op @ (BinaryOp::Rises | BinaryOp::Falls | BinaryOp::Crosses), _, a, b),
                MeasureName::First | MeasureName::Count,
            ) => {
                let (a, b) = (self.expr(a, env), self.expr(b, env));
                measure = match (measure, *op == BinaryOp::Crosses) {
                    (MeasureName::Count, false) => MeasureName::CountRises,
                    (MeasureName::Count, true) => MeasureName::CountTurns,
                    (_, false) => MeasureName::Rises,
                    (_, true) => MeasureName::Turns,
                };
                let op = if *op == BinaryOp::Falls { BinaryOp::LessEqual } else { BinaryOp::GreaterEqual };
                self.system.push(Node::Binary(op, a, b), args[0].span)
            }
            _ => self.expr(&args[0], env),
        };
        let second = args.get(1).map(|arg| self.expr(arg, env));
        let mut edge = |edge: Option<&'a Expr>| edge.map(|edge| self.expr(edge, env));
        let window = window.map_or_else(Window::default, |window| Window {
            after: edge(window.after.as_ref()),
            before: edge(window.before.as_ref()),
        });
        self.system.push(Node::Measure(measure, value, second, window), span)
    }

    pub(super) fn call(
        &mut self,
        function: &'a Name,
        args: &'a [Expr],
        window: Option<&'a ast::Window>,
        span: Span,
        env: &Env,
    ) -> ExprId {
        if let ("sum" | "min" | "max", [Expr { kind: ExprKind::Path(path), .. }]) = (function.text.as_str(), args)
            && let Some(folded) = self.fold(function, path, span, env)
        {
            return folded;
        }
        // Names of measures that were added later yield to the user's own functions.
        let late = ["count", "duration", "peaks", "peak", "slope"].contains(&function.text.as_str());
        let own = late && matches!(self.loaded.find(env.file, Space::Function, &function.text), Lookup::Found(..));
        if env.outside
            && !own
            && let Some((measure, wanted)) = MeasureName::named(&function.text)
            && args.len() == wanted
        {
            return self.measure(measure, args, window, span, env);
        }
        if let Some(window) = window {
            let edge = window.after.as_ref().or(window.before.as_ref()).map_or(span, |edge| edge.span);
            let error = Diagnostic::error("E0901", format!("`{}` has no window: it is no measure here", function.text))
                .label(edge, "a part of a run");
            self.report(error.help("measures in `expect` have one: `expect max(x after 1 s) < 2 mm`"));
            return self.error(span);
        }
        if function.text == "slope" && !own {
            return match args {
                [of] => {
                    let of = self.expr(of, env);
                    // An argument of the run may be the derivative of a signal or of a recording.
                    let of_signal = env.instance.is_none() && self.of_time_alone(of);
                    if !(env.outside || of_signal) {
                        let error = Diagnostic::error("E0901", "`slope` belongs in an experiment")
                            .label(function.span, "follows equations that a model may not know of")
                            .help("in a model the derivative of a state is written `dx/dt`");
                        self.report(error);
                        return self.error(span);
                    }
                    self.slope(of, span)
                }
                _ => {
                    self.wrong_count(function, 1, args.len());
                    self.error(span)
                }
            };
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
        if self.indexed(function, args, env) {
            return self.error(span);
        }
        let values: Vec<ExprId> = args.iter().map(|arg| self.expr(arg, env)).collect();
        match Builtin::named(&function.text) {
            Some(builtin) if builtin.signature().arguments.len() == values.len() => self.builtin(builtin, values, span),
            Some(builtin) => {
                self.wrong_count(function, builtin.signature().arguments.len(), args.len());
                self.error(span)
            }
            None if MeasureName::named(&function.text).is_some() => {
                let of = args.first().map_or("…".into(), |arg| self.loaded.files.slice(arg.span).to_string());
                let error =
                    Diagnostic::error("E0901", format!("`{}` is a measure: it belongs in `expect`", function.text))
                        .label(function.span, "needs the whole course of a quantity")
                        .help(match function.text.as_str() {
                            "integral" => format!(
                                "as a quantity it is a state: `state i [m] = 0`, with its unit, and `di/dt = {of}`;\nover a whole run `show integral({of})` in an experiment"
                            ),
                            name => format!("write `expect {name}({of}) < …` in an experiment"),
                        });
                self.report(error);
                self.error(span)
            }
            None => {
                self.unknown_function(function, args, env);
                self.error(span)
            }
        }
    }

    pub(super) fn builtin(&mut self, builtin: Builtin, values: Vec<ExprId>, span: Span) -> ExprId {
        match builtin {
            Builtin::Step | Builtin::Ramp => self.system.corners.push(values[0]),
            Builtin::Pulse => {
                let end = self.system.push(Node::Binary(BinaryOp::Add, values[0], values[1]), span);
                self.system.corners.extend([values[0], end]);
            }
            _ => {}
        }
        let call = self.system.push(Node::Call(builtin, values.into()), span);
        if builtin == Builtin::Delay {
            self.system.delays.push(call);
        }
        call
    }

    pub(super) fn wrong_count(&mut self, function: &Name, wanted: usize, got: usize) {
        let plural = if wanted == 1 { "" } else { "s" };
        let error =
            Diagnostic::error("E0207", format!("`{}` takes {wanted} argument{plural}, not {got}", function.text))
                .label(function.span, format!("{got} given"));
        let builtin = Builtin::named(&function.text).map(|builtin| builtin.signature());
        self.report(match builtin.filter(|signature| signature.arguments.len() == wanted) {
            Some(signature) => error.help(format!("write `{signature}`: {}", signature.doc)),
            None => error,
        });
    }

    /// Reports `x(1)` and `y(k-1)`, where the name is a quantity and no function.
    fn indexed(&mut self, function: &Name, args: &[Expr], env: &Env) -> bool {
        let is_quantity = env
            .instance
            .is_some_and(|id| matches!(self.tree(id).names.get(function.text.as_str()), Some(Binding::Var(_))));
        let [arg] = args else { return false };
        if !is_quantity || Builtin::named(&function.text).is_some() || MeasureName::named(&function.text).is_some() {
            return false;
        }
        let (name, index) = (&function.text, self.loaded.files.slice(arg.span).replace(' ', ""));
        let counter = |letter: &char| matches!(letter, 'k' | 'n' | 'i' | 't');
        let earlier = index.starts_with(|c: char| counter(&c)) && index.contains('-');
        let help = if earlier {
            format!(
                "the value of a tick before is a state: `state {name}1 [m] = 0`, and `next({name}1) = {name}` in the `every` block;\nwrite `{name}1` in place of `{name}({index})`. `delay({name}, 5 ms)` reaches back in continuous time"
            )
        } else if index.parse::<f64>().is_ok() || index.starts_with(|c: char| counter(&c)) {
            format!("each name is one number: write `{name}`; the value at a time is a measure, `at({name}, 1 s)`")
        } else {
            format!("to multiply write `{name} * ({})`", self.loaded.files.slice(arg.span))
        };
        let error = Diagnostic::error("E0204", format!("`{name}` is a quantity, not a function"));
        self.report(error.label(function.span.to(arg.span), "reads as a call").help(help));
        true
    }

    pub(super) fn unknown_function(&mut self, function: &Name, args: &[Expr], env: &Env) {
        if self.explained(function, env.file) {
            return;
        }
        if function.text == "thin" {
            let error = Diagnostic::error("E0901", "`thin` stands directly in an `rms` of `minimise`")
                .label(function.span, "not here");
            return self.report(
                error.help("write `minimise rms(thin(F - data.F, 10))`; it takes a difference and a number of rows"),
            );
        }
        let mut error = Diagnostic::error("E0204", format!("there is no function `{}`", function.text))
            .label(function.span, "not declared");
        let loaded = self.loaded;
        self.unknowns += 1;
        if self.unknowns > MOST_SUGGESTIONS {
            return self.report(error);
        }
        // The help speaks of what the text gives to the function.
        let given = |k: usize, other: &str| {
            let text =
                args.get(k).map(|arg| loaded.files.slice(arg.span).split_whitespace().collect::<Vec<_>>().join(" "));
            text.filter(|text| text.len() <= 40).unwrap_or_else(|| other.to_string())
        };
        let x = given(0, "x");
        let is_name = x.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
        let earlier = if is_name { format!("{x}1") } else { "x1".into() };
        let mut known = loaded.visible(env.file, Space::Function);
        Builtin::all().for_each(|builtin| known.push(builtin.name()));
        let help = match function.text.as_str() {
            "der" | "diff" | "ddt" if is_name => Some(format!(
                "the derivative of a state is written `d{x}/dt`; of another quantity `slope({x})`, in `expect`, `show` and `plot`"
            )),
            "der" | "diff" | "ddt" => Some("a derivative is written `dz/dt`".to_string()),
            "sgn" | "signum" => Some(format!("write `sign({x})`")),
            "ln" => Some(format!("write `log({x})`: the natural logarithm")),
            "smooth" | "filtfilt" | "lowpass" => Some(
                "a filter makes a column of a recording: `let data.q = smooth(data.x, 60 Hz)` in an experiment or a fit".into(),
            ),
            "log10" => Some(format!("write `log({x}) / log(10)`")),
            "pow" | "power" => Some(format!("write `({x})^({})`", given(1, "n"))),
            "sat" | "limit" | "saturate" | "saturation" => Some(format!(
                "write `clamp({x}, {}, {})` with its lower and its upper limit",
                given(1, "-1 N"),
                given(2, "1 N")
            )),
            "fabs" | "norm" => Some(format!("write `abs({x})`")),
            "mod" | "rem" | "fmod" => {
                let y = given(1, "y");
                Some(format!("write `{x} - {y} * floor(({x}) / ({y}))`"))
            }
            "round" => Some(format!("write `floor({x} + 0.5)`")),
            "ceil" => Some(format!("write `-floor(-({x}))`")),
            "heaviside" | "stepfun" => Some("write `if x > 0 then 1 else 0`; over time `step(1 s, 2 N)`".into()),
            "sum" | "total" => Some("`sum` adds a quantity of several parts: `part el[i in 1 .. 4] = Model(k = i * 1 N/m)`, then `sum(el.f)`; a fixed sum is written out".into()),
            "prev" | "pre" | "last" | "memory" | "unitdelay" | "UnitDelay" => Some(format!(
                "a state keeps a value until the next tick: `state {earlier} [m] = 0`, with the unit of `{x}`, and\n`every 1 ms {{ next({earlier}) = {x} }}`; then `{earlier}` is `{x}` one tick before"
            )),
            "integ" | "int" | "integrate" | "cumtrapz" => {
                Some(format!("an integral is a state: `state i [m] = 0`, with its unit, and `di/dt = {x}`"))
            }
            "interp1" | "interp" | "lookup" | "lut" => Some(format!(
                "a curve of points stands outside of models, `table curve(v [m/s]) [N] = linear {{ 0 m/s: 1 N, 1 m/s: 2 N }}`;\nits value here is `curve({})`",
                given(args.len().saturating_sub(1), "v")
            )),
            name @ ("linspace" | "logspace" | "colon") => {
                let (spacing, count) = (if name == "logspace" { "log" } else { "lin" }, given(2, "5"));
                Some(format!(
                    "values of a sweep: `{x} .. {} {spacing} {count}`, with a unit at both ends as in\n`sweep v = 1 mm/s .. 10 mm/s {spacing} {count}`; points of a curve are a `table`",
                    given(1, "10")
                ))
            }
            "overshoot" => Some(format!("write `max({x}) / final({x}) - 1`, a measure of an experiment")),
            "risetime" | "rise_time" => Some(format!(
                "write `first({x} > 0.9 m) - first({x} > 0.1 m)` with the unit of `{x}`, a measure of an experiment"
            )),
            "settlingtime" | "settling_time" | "stepinfo" => Some(format!(
                "write `settling({x}, 1 mm)` with the band in the unit of `{x}`, a measure of an experiment"
            )),
            "uniform" | "normal" | "gauss" | "lognormal" => {
                Some("a distribution is drawn by `fric sweep FILE EXPERIMENT --vary 'k ~ uniform(1 N/m, 2 N/m)'`; a random signal is `noise(1 N, 1 ms, 1)`".into())
            }
            "rand" | "randn" | "random" => Some("write `noise(1 N, 1 ms, 1)`: amplitude, hold time, seed".into()),
            name => nearest(name, known).map(|near| format!("did you mean `{near}`?")),
        };
        if let Some(help) = help.or_else(|| self.module_with(&function.text).map(|m| format!("add `import {m}`"))) {
            error = error.help(help);
        }
        self.report(error);
    }

    /// `sum(el.f)`: folds an array of parts in index order. Returns `None` if the path contains no array.
    pub(super) fn fold(&mut self, function: &'a Name, path: &'a ast::Path, span: Span, env: &Env) -> Option<ExprId> {
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

    /// Expands a call of a user's function in place.
    pub(super) fn expand(
        &mut self,
        item: ItemRef,
        function: &'a ast::Function,
        name: &'a Name,
        args: &'a [Expr],
        span: Span,
        env: &Env,
    ) -> ExprId {
        let values: Vec<ExprId> = args.iter().map(|expr| self.expr(expr, env)).collect();
        let key = (item, values.clone(), env.rotary, env.equation);
        if let Some(&known) = self.expansions.get(&key) {
            return known;
        }
        let mut locals = Vec::new();
        for ((arg, expr), value) in function.args.iter().zip(args).zip(values) {
            let unit = match &arg.unit {
                None => Some(Unit::none()),
                Some(unit) => self.unit(unit, env.rotary, env.instance),
            };
            let role = Role::Argument { function: function.name.text.clone(), name: arg.name.text.clone() };
            locals.push((arg.name.text.clone(), self.fitting(value, unit, role, expr.span)));
        }
        if function.args.len() != args.len() {
            self.wrong_count(name, function.args.len(), args.len());
            return self.error(span);
        }
        if self.functions.contains(&item) || self.functions.len() >= DEEPEST {
            let error = match self.functions.contains(&item) {
                true => Diagnostic::error("E0211", format!("`{}` calls itself", function.name.text))
                    .recurring(Recurring::Call)
                    .label(function.name.span, "directly or by others")
                    .help("functions are not recursive: a step must take a bounded time"),
                false => Diagnostic::error("E0211", format!("functions are nested more than {DEEPEST} deep"))
                    .recurring(Recurring::Depth)
                    .label(function.name.span, "called from so deep")
                    .help("write some of them out"),
            };
            self.report(error);
            return self.error(span);
        }
        if self.full(span) {
            return self.error(span);
        }
        self.functions.push(item);
        let inner = Env { locals: Rc::new(locals), rotary: env.rotary, equation: env.equation, ..Env::file(item.file) };
        let body = self.expr(&function.body, &inner);
        self.functions.pop();
        let unit = function.unit.as_ref().and_then(|unit| self.unit(unit, env.rotary, env.instance));
        let role = Role::Result { function: function.name.text.clone() };
        let result = self.fitting(body, unit, role, span);
        self.expansions.insert(key, result);
        result
    }

    /// The value with a check of its dimension, if there is one.
    fn fitting(&mut self, value: ExprId, unit: Option<Unit>, role: Role, span: Span) -> ExprId {
        match unit {
            Some(unit) => self.system.push(Node::Fits { value, unit: Box::new(unit), role }, span),
            None => value,
        }
    }

    pub(super) fn table(
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
        let key = (item, env.rotary);
        if !self.tables.contains_key(&key) {
            let made =
                crate::frontend::tables::read(self.loaded, self.sources, item.file, table, &mut self.diagnostics);
            let number = made.map(|mut table| {
                if env.rotary {
                    // The rotary twin has the same numbers with mapped dimensions.
                    table.x_unit = table.x_unit.rotary();
                    table.y_unit = table.y_unit.rotary();
                }
                self.system.tables.push(table);
                self.system.tables.len() as u32 - 1
            });
            self.tables.insert(key, number);
        }
        match self.tables[&key] {
            Some(number) => self.system.push(Node::Table(number, x), span),
            None => self.error(span),
        }
    }
}
