//! The frame of a rig around its instance: drives and devices with their signals, parts that belong to the rig alone,
//! and expressions over all of these.
//!
//! In: a [`Frame`]. Out: [`RigFrame`], which locates its contents in the system. Knows nothing of buses.

use super::*;

/// Everything that a rig adds to the instance it runs.
pub struct Frame<'a> {
    /// The rig as a model, for its name and for suggestions; its statements are not read.
    pub model: &'a ast::Model,
    /// File of the rig.
    pub file: FileId,
    /// Drives and devices.
    pub nodes: Vec<BusNode<'a>>,
    /// Drives and devices with invalid descriptions, which have been reported.
    pub broken: Vec<&'a Name>,
    /// Observers and filters of the rig.
    pub parts: Vec<&'a ast::Part>,
    /// The part that hardware replaces.
    pub hardware: Option<&'a Name>,
    /// Expressions of the rig, with their scopes.
    pub expressions: Vec<(Scope, &'a Expr)>,
}

/// A drive or device. Its inputs are the signals read from the bus.
pub struct BusNode<'a> {
    /// Its name in the rig.
    pub name: &'a Name,
    /// Its description as a model.
    pub model: &'a ast::Model,
    /// File of the description.
    pub file: FileId,
    /// Its declaration in the rig.
    pub instance: &'a ast::Instance,
}

/// Scope of an expression in a rig.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Scope {
    /// Drives, devices and parts of the rig, then names of the instance it runs.
    Rig,
    /// As `Rig`, for a condition, which may contain crossings.
    Condition,
    /// Names of the part that hardware replaces, then as `Rig`.
    Part,
}

/// Location of a frame in the system.
pub struct RigFrame {
    /// The rig itself.
    pub rig: InstanceId,
    /// Its drives and devices, in order.
    pub nodes: Vec<InstanceId>,
    /// The part that hardware replaces; `None` if there is no such part, which has been reported.
    pub hardware: Option<InstanceId>,
    /// The node of each expression.
    pub expressions: Vec<ExprId>,
}

impl<'a> Flattener<'a> {
    /// Instantiates a frame around the first instance.
    pub(super) fn surround(&mut self, frame: &Frame<'a>, overrides: &[Change<'a>]) -> RigFrame {
        let top = InstanceId(0);
        let names = self.tree(top).names.clone();
        let rig = self.scope(frame.model, frame.file, names);
        let env = Env { instance: Some(rig), ..Env::file(frame.file) };
        let mine = |name: &Name| -> Vec<Change<'a>> {
            let to = overrides.iter().filter(|change| change.path[0].name.text == name.text);
            to.map(|change| Change { path: &change.path[1..], ..change.clone() }).collect()
        };
        let mut nodes = Vec::new();
        for node in &frame.nodes {
            let made = Instantiation {
                path: node.name.text.clone(),
                rotary: false,
                span: node.instance.model.span,
                args: args_of(&node.instance.args, &env),
                overrides: mine(node.name).into_iter().filter(|change| !change.path.is_empty()).collect(),
            };
            let id = self.instantiate(node.model, node.file, made, false);
            self.instances[id.0 as usize].on_bus = true;
            self.bind(rig, &node.name.text, Binding::Part(id));
            nodes.push(id);
        }
        for name in &frame.broken {
            self.bind(rig, &name.text, Binding::Broken);
        }
        for part in &frame.parts {
            if let Some(id) = self.part(rig, part, &env, String::new(), mine(&part.name)) {
                self.bind(rig, &part.name.text, Binding::Part(id));
            }
        }
        let hardware = frame.hardware.and_then(|name| match self.tree(top).names.get(name.text.as_str()) {
            Some(Binding::Part(part)) => Some(*part),
            Some(Binding::Broken) => None,
            _ => {
                self.unknown_part(top, name);
                None
            }
        });
        RigFrame { rig, nodes, hardware, expressions: Vec::new() }
    }

    /// An instance without quantities of its own, which only provides these names.
    fn scope(&mut self, model: &'a ast::Model, file: FileId, names: HashMap<&'a str, Binding>) -> InstanceId {
        let id = InstanceId(self.system.instances.len() as u32);
        let info = InstanceInfo {
            path: String::new(),
            model: model.name.text.clone(),
            rotary: false,
            span: model.name.span,
            allows: Vec::new(),
        };
        self.system.instances.push(info);
        let tree = Tree {
            model,
            file,
            names,
            args: Vec::new(),
            alone: false,
            defaults: false,
            on_bus: false,
            scope: true,
            locals: Rc::default(),
        };
        self.instances.push(tree);
        id
    }

    /// Reads the expressions of a frame.
    pub(super) fn framed(&mut self, frame: &Frame<'a>, framed: &mut RigFrame) {
        let rig = Env { instance: Some(framed.rig), ..Env::file(frame.file) };
        let inside = match framed.hardware {
            Some(part) => {
                let mut names = self.tree(framed.rig).names.clone();
                names.extend(self.tree(part).names.iter().map(|(name, binding)| (*name, binding.clone())));
                let model = self.tree(part).model;
                Env { instance: Some(self.scope(model, frame.file, names)), ..rig.clone() }
            }
            None => rig.clone(),
        };
        for (scope, expr) in &frame.expressions {
            let env = match scope {
                Scope::Rig => &rig,
                Scope::Condition => &Env { instants: true, ..rig.clone() },
                Scope::Part => &inside,
            };
            let read = self.expr(expr, env);
            framed.expressions.push(read);
        }
    }
}
