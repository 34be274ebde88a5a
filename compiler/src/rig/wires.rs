//! Wires of the part that hardware replaces. As written, they compute commands from the part's inputs, and the part's
//! outputs from signals. Inverted, they drive the part alone from what the drives apply, and compute what the drives
//! measure.
//!
//! In: the system, its frame and the wires. Out: the definitions of both systems, or diagnostics. Knows nothing of
//! buses.

use super::*;

impl RigReader<'_, '_> {
    /// The quantities of the part that wires define.
    pub(super) fn gives(
        &mut self,
        system: &mut System,
        framed: &RigFrame,
        lists: &ExprIndices,
        part: InstanceId,
    ) -> Vec<PartOutput> {
        let Some(hardware) = self.statements.hardware else { return Vec::new() };
        let mut out: Vec<PartOutput> = Vec::new();
        for (wire, value) in &lists.gives {
            let wire = &hardware.wires[*wire];
            let name = &wire.path.segments[0].name;
            let info = system.instance(part);
            let model = info.model.clone();
            let own = |id: &VarId| system.var(*id).instance == part;
            let found = system.var_ids().filter(own).find(|id| system.var(*id).name == name.text);
            let Some(found) = found else {
                let names = system.var_ids().filter(own).map(|id| system.var(id)).filter(|var| given_kind(var.kind));
                let names: Vec<&str> = names.map(|var| var.name.as_str()).collect();
                let near = crate::frontend::names::nearest(&name.text, names.iter().copied());
                let error = Diagnostic::error("E0204", format!("there is no `{}` in {model}", name.text))
                    .label(name.span, "not an output or state of the part");
                let help = match near {
                    Some(near) => format!("did you mean `{near}`?"),
                    None => format!("the part gives {}", names.join(", ")),
                };
                self.report(error.help(help));
                continue;
            };
            let var = system.var(found);
            if !given_kind(var.kind) {
                let error = Diagnostic::error("E0801", format!("`{}` is {} of {model}", name.text, a_kind(var.kind)))
                    .label(name.span, "the part does not give it")
                    .label(var.span, "declared here");
                let help = match var.kind {
                    VarKind::Input => format!("a drive takes it: `drive.torque = {}`", name.text),
                    _ => "give outputs and states".to_string(),
                };
                self.report(error.help(help));
                continue;
            }
            if let Some(first) = out.iter().find(|give| give.var == found) {
                let error = Diagnostic::error("E0801", format!("`{}` is given twice", name.text))
                    .label(name.span, "again here")
                    .label(first.span, "first here");
                self.report(error.help("remove one, or take the mean of both"));
                continue;
            }
            let node = framed.expressions[*value];
            let moving = mentioned(system, node).into_iter().find(|id| {
                let var = system.var(*id);
                let signal = framed.nodes.contains(&var.instance);
                let of_rig =
                    self.statements.parts.iter().any(|part| var.path.starts_with(&format!("{}.", part.name.text)));
                var.kind != VarKind::Param && !signal && !of_rig
            });
            if let Some(moving) = moving {
                let message = format!("`{}` is measured: it is made of signals", name.text);
                let error = Diagnostic::error("E0801", message)
                    .label(system.span(node), format!("`{}` is computed", system.var(moving).path));
                self.report(error.help("read drives and devices here, or a `part` of the rig that observes them"));
                continue;
            }
            out.push(PartOutput { var: found, value: *value, span: wire.path.span });
        }
        out
    }

    /// Checks that every input of the part is sent to a drive, and that every drive has a command.
    pub(super) fn unsent(&mut self, system: &System, framed: &RigFrame, lists: &ExprIndices, part: InstanceId) {
        let Some(hardware) = self.statements.hardware else { return };
        let inputs: Vec<VarId> = system
            .var_ids()
            .filter(|id| system.var(*id).instance == part && system.var(*id).kind == VarKind::Input)
            .collect();
        let mut sent: Vec<(VarId, Span)> = Vec::new();
        for send in lists.sends.iter().filter(|send| send.inside) {
            let value = framed.expressions[send.value];
            for id in mentioned(system, value) {
                let var = system.var(id);
                if var.kind == VarKind::Param {
                    continue;
                }
                if !inputs.contains(&id) {
                    let message = format!("`{}` is no input of the part", var.path);
                    let error = Diagnostic::error("E0801", message)
                        .label(system.span(value), "a command is made of the inputs of the part")
                        .label(hardware.part.span, format!("{} is replaced", system.instance(part).model));
                    let names: Vec<&str> = inputs.iter().map(|id| system.var(*id).name.as_str()).collect();
                    self.report(error.help(format!("its inputs are {}", names.join(", "))));
                    continue;
                }
                match sent.iter().find(|(known, _)| *known == id) {
                    Some((_, first)) => {
                        let error = Diagnostic::error("E0801", format!("`{}` is sent twice", var.name))
                            .label(send.path, "again here")
                            .label(*first, "first here");
                        self.report(error.help(
                            "each input of the part goes to one drive: what it does twice, the shaft feels twice",
                        ));
                    }
                    None => sent.push((id, send.path)),
                }
            }
        }
        let wrong = self.hardware_is_wrong();
        for id in inputs.into_iter().filter(|_| !wrong) {
            let var = system.var(id);
            let silent = matches!(var.definition, Definition::Value(_, Origin::Default));
            if !silent && !sent.iter().any(|(known, _)| *known == id) {
                let message = format!("`{}` of the hardware part goes nowhere", var.name);
                let error = Diagnostic::error("E0801", message)
                    .label(hardware.part.span, "no wire sends it")
                    .label(var.span, "an input of the part");
                let drive = self.descriptions.iter().find(|node| node.statement.moves);
                let drive = drive.map_or("drive", |drive| &drive.name.text);
                self.report(error.help(format!("add `{drive}.torque = {}` to `hardware`", var.name)));
            }
        }
        for (k, node) in self.descriptions.iter().enumerate().filter(|(_, node)| node.statement.moves) {
            if !wrong && !lists.sends.iter().any(|send| send.node == k) {
                let name = &node.name.text;
                let error = Diagnostic::error("E0801", format!("nothing commands drive `{name}`"))
                    .label(node.name.span, "it would turn freely");
                let help = "wire it in `hardware`; what only talks is a `device`";
                self.diagnostics.push(error.help(help));
            }
        }
        for send in lists.sends.iter().filter(|send| send.inside && !self.descriptions[send.node].statement.moves) {
            let node = &self.descriptions[send.node].statement;
            let error = Diagnostic::error(
                "E0801",
                format!("`{}` moves the part, but is declared as a `device`", node.name.text),
            )
            .label(node.kind.span, "not supervised, and without a safe value")
            .label(send.path, "takes the place of the part");
            self.diagnostics
                .push(error.help(format!("write `drive {} = …`, and give it a `safe` value", node.name.text)));
        }
        for send in lists.sends.iter().filter(|send| send.safe.is_none()) {
            if self.descriptions[send.node].statement.moves {
                let text = self.files.slice(send.path).to_string();
                let zero = if send.unit.text.is_empty() { "0".into() } else { format!("0 {}", send.unit) };
                let error = Diagnostic::error("E0803", format!("`{text}` has no safe value"))
                    .label(send.path, "what is sent when the rig stops?");
                self.report(error.help(format!("add `safe {text} = {zero}`")));
            }
        }
    }

    /// The plant: the part alone. Each of its inputs follows from what the drive applies, and each signal of a drive
    /// from the outputs of the part.
    pub(super) fn plant(
        &mut self,
        system: &System,
        framed: &RigFrame,
        lists: &ExprIndices,
        commands: &[VarId],
        gives: &[PartOutput],
        of_part: &dyn Fn(&System, VarId) -> bool,
    ) -> Option<PlantSystem> {
        let mut plant = system.clone();
        let mut applied = Vec::new();
        let mut failed = false;
        for (send, command) in lists.sends.iter().zip(commands).filter(|(send, _)| send.inside) {
            let value = framed.expressions[send.value];
            let span = system.span(value);
            let input = |id: VarId| system.var(id).kind == VarKind::Input && of_part(system, id);
            if !mentioned(system, value).into_iter().any(input) {
                continue; // Independent of the inputs of the part, so it does not act on the part.
            }
            let form = affine(&mut plant, value, &input);
            let Some(mut form) = form.filter(|form| !form.terms.is_empty()) else {
                let text = self.files.slice(send.path).to_string();
                let error = Diagnostic::error("E0801", format!("`{text}` cannot be read backwards"))
                    .label(span, "not a sum of multiples of inputs");
                let help = "what a drive applies must say what the part gets: send inputs with a sign, a gear ratio, an offset";
                self.report(error.help(help));
                failed = true;
                continue;
            };
            // One drive serves several inputs: the part receives their sum through the first of them.
            for (other, _) in form.terms.split_off(1) {
                let none = plant.push(nothing(), span);
                plant.vars[other.0 as usize].definition = Definition::Value(none, Origin::Default);
            }
            // The commanded and the applied quantity have the same name.
            let signal = self.applied_signal(&mut plant, framed, send, *command);
            let signal_value = plant.push(Node::Var(signal), span);
            let solution = solved(&mut plant, &form, signal_value, span);
            let (Some(solution), Some((target, _))) = (solution, form.terms.first()) else { continue };
            plant.vars[target.0 as usize].definition = Definition::Value(solution, Origin::Default);
            applied.push(signal);
        }
        if failed {
            return None;
        }
        let mut seen: Vec<VarId> = Vec::new();
        let signal = |plant: &System, id: VarId| {
            let var = plant.var(id);
            framed.nodes.contains(&var.instance) && var.kind == VarKind::Input
        };
        for give in gives {
            let value = framed.expressions[give.value];
            let span = system.span(value);
            let direct = mentioned(system, value)
                .into_iter()
                .all(|id| signal(system, id) || system.var(id).kind == VarKind::Param);
            if !direct {
                continue; // Computed by a part of the rig, whose inputs are defined elsewhere or reported.
            }
            let form = affine(&mut plant, value, &|id| signal(system, id));
            let Some(form) = form.filter(|form| !form.terms.is_empty()) else {
                let text = self.files.slice(give.span).to_string();
                let error = Diagnostic::error("E0801", format!("`{text}` cannot be read backwards"))
                    .label(span, "not a sum of multiples of signals");
                let help = "what the part does must say what its encoders see: plain arithmetic of signals, or a `part` of the rig";
                self.report(error.help(help));
                failed = true;
                continue;
            };
            let given = plant.push(Node::Var(give.var), span);
            let Some(solution) = solved(&mut plant, &form, given, span) else { continue };
            for (id, _) in &form.terms {
                if !seen.contains(id) && !applied.contains(id) {
                    plant.vars[id.0 as usize].definition = Definition::Value(solution, Origin::Default);
                    seen.push(*id);
                }
            }
        }
        if failed {
            return None;
        }
        self.same_shaft(&mut plant, framed, &mut seen, &applied);
        let states = system.var_ids().filter(|id| of_part(system, *id) && system.var(*id).kind == VarKind::State);
        let seen_read: Vec<ExprId> = seen.iter().map(|id| plant.push(Node::Var(*id), self.rig.span)).collect();
        let pruned = pruned(&plant, states, &seen_read);
        applied.retain(|id| lives(&pruned, *id) || matches!(pruned.var(*id).definition, Definition::Free));
        // Any other input of the part would have to come from the control program.
        let foreign = pruned.var_ids().find(|id| {
            let var = pruned.var(*id);
            let framing = framed.nodes.contains(&var.instance) || var.instance == framed.rig;
            !framing && !of_part(system, *id) && lives(&pruned, *id) && var.kind != VarKind::Param
        });
        if let Some(foreign) = foreign.filter(|_| !self.hardware_is_wrong())
            && let Some(hardware) = self.statements.hardware
        {
            let message =
                format!("the hardware part needs `{}`, which no drive brings to it", pruned.var(foreign).path);
            let error = Diagnostic::error("E0801", message)
                .label(hardware.part.span, "replaced by drives")
                .label(pruned.var(foreign).span, "computed here");
            self.report(error.help("wire the input of the part that takes it"));
            return None;
        }
        Some(PlantSystem { system: pruned, applied, seen, seen_read })
    }

    /// The quantity that a drive applies: its own measurement of the command, or for a device a quantity of its own.
    fn applied_signal(&mut self, plant: &mut System, framed: &RigFrame, send: &OutputCommand, command: VarId) -> VarId {
        let node = framed.nodes[send.node];
        let name = self.files.slice(send.path).rsplit('.').next().unwrap_or_default().trim().to_string();
        let own = plant.var_ids().find(|id| {
            let var = plant.var(*id);
            var.instance == node && var.kind == VarKind::Input && var.name == name
        });
        match own {
            Some(own) => own,
            None => {
                // There is no measurement, so the command itself becomes an input.
                let var = &mut plant.vars[command.0 as usize];
                (var.kind, var.definition) = (VarKind::Input, Definition::Free);
                command
            }
        }
    }

    /// All drives of one rig turn the same shaft: speed and position without a wire equal those of the drive that has
    /// them.
    fn same_shaft(&mut self, plant: &mut System, framed: &RigFrame, seen: &mut Vec<VarId>, applied: &[VarId]) {
        for name in ["speed", "position"] {
            let Some(known) = seen.iter().copied().find(|id| plant.var(*id).name == name) else { continue };
            for (k, node) in self.descriptions.iter().enumerate() {
                if !matches!(node.protocol, Protocol::Cia402 { .. }) {
                    continue;
                }
                let mine = plant.var_ids().find(|id| {
                    let var = plant.var(*id);
                    var.instance == framed.nodes[k] && var.name == name && var.kind == VarKind::Input
                });
                if let Some(mine) = mine.filter(|mine| !seen.contains(mine) && !applied.contains(mine)) {
                    let value = plant.push(Node::Var(known), node.name.span);
                    plant.vars[mine.0 as usize].definition = Definition::Value(value, Origin::Default);
                    seen.push(mine);
                }
            }
        }
    }

    /// E0801: the rest of the system or the rig reads a quantity of the part for which there is no wire.
    pub(super) fn not_given(
        &mut self,
        control: &System,
        system: &System,
        part: InstanceId,
        of_part: &dyn Fn(&System, VarId) -> bool,
    ) {
        let Some(hardware) = self.statements.hardware.filter(|_| !self.hardware_is_wrong()) else { return };
        for id in system.var_ids().filter(|id| of_part(system, *id) && given_kind(system.var(*id).kind)) {
            if lives(control, id) {
                continue;
            }
            let read = (0..control.nodes.len() as u32).map(ExprId).find(|node| {
                matches!(control.node(*node), Node::Var(var) | Node::Rate(var) | Node::PathRate(var) if *var == id)
            });
            if let Some(read) = read {
                let var = system.var(id);
                let inside = var.instance == part;
                let error = Diagnostic::error("E0801", format!("`{}` is used, but nothing measures it", var.path))
                    .label(hardware.part.span, "no wire gives it")
                    .label(control.span(read), "used here");
                self.report(match inside {
                    true => error.help(format!("add `{} = drive.position` or another signal to `hardware`", var.name)),
                    false => error.help("what lies inside of the hardware cannot be seen: use what is wired"),
                });
            }
        }
    }
}

fn given_kind(kind: VarKind) -> bool {
    matches!(kind, VarKind::Output | VarKind::State)
}

fn a_kind(kind: VarKind) -> &'static str {
    match kind {
        VarKind::Param => "a param",
        VarKind::Input => "an input",
        VarKind::Output => "an output",
        VarKind::State => "a state",
        VarKind::Let => "private: a `let`",
        VarKind::Observed => "an expression",
    }
}
