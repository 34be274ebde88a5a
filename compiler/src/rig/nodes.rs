//! Drives and devices as models: their arguments are parameters, and the signals read from the bus are inputs.
//! Arguments and signals thus have units, ranges, defaults and suggestions like any quantity.
//!
//! In: the statements of a rig and the descriptions that they name. Out: a [`Description`] for each. Knows nothing of
//! identifiers on the bus.

use super::dbc;
use crate::frontend::names::nearest;
use crate::frontend::resolve::{Loaded, Lookup, Space};
use crate::frontend::source::Sources;
use abi::rig::{Format, Mode, SignalKind};
use abi::unit::Unit;
use grammar::ast::{self, BinaryOp, Declaration, DeclarationKind, Expr, ExprKind, Item, Name, UnitText};
use grammar::diagnostic::Diagnostic;
use grammar::span::{FileId, Span};

/// The arguments and signals of every CiA 402 drive. An argument that is not given is read from the drive.
const CIA402: &str = "\
/// A drive that speaks CANopen with the profile CiA 402.
model Cia402 {
  param node [1]              in 1 .. 127      /// node id
  param T_rated [N·m]         in > 0           /// rated torque, as object 6076
  param count [rad]           in > 0           /// one step of object 6064
  param speed_unit [rad/s]    in > 0           /// one step of object 606C
  param delay [s]     = 0     in 0 .. 1 s      /// dead time from command to torque
  param lag [s]       = 0     in 0 .. 1 s      /// time constant of the torque loop
  param timeout [s]   = 0     in >= 0          /// age at which a signal is lost; 0: three ticks
  param T_max [N·m]   = inf   in > 0           /// greatest torque; inf: object 6072
  param speed_max [rad/s] = inf in > 0         /// greatest speed; inf: object 6080
  param power_max [W] = inf   in > 0           /// greatest power; inf: T_max · speed_max
  param travel_low [rad] = -inf                /// permitted positions
  param travel_high [rad] = inf                /// permitted positions
  input torque [N·m]                           /// torque at the shaft
  input speed [rad/s]                          /// speed of the shaft
  input position [rad]                         /// counted from enabling
  input enabled_bit [1]                        /// follows commands
  input fault_bit [1]                          /// reports a fault
  input limited_bit [1]                        /// reports an internal limit
  output enabled = enabled_bit > 0.5
  output fault   = fault_bit > 0.5
  output limited = limited_bit > 0.5
}
";

/// Built-in drive profiles.
pub const PROFILES: [&str; 3] = ["cia402", "fc302", "vlt5000"];

/// A drive or device of a rig with its description.
pub struct Description {
    /// Name in the rig.
    pub name: Name,
    /// Its statement in the rig.
    pub statement: ast::DriveDecl,
    /// Its description as a model.
    pub model: ast::Model,
    /// File of the model.
    pub file: FileId,
    /// The instance with the arguments of the rig.
    pub instance: ast::Instance,
    /// Protocol of the node.
    pub protocol: Protocol,
}

/// Protocol of a node.
pub enum Protocol {
    /// CANopen with the profile CiA 402.
    Cia402 {
        /// The commanded quantity.
        mode: Mode,
        /// Whether commands take effect at the next SYNC.
        at_sync: bool,
        /// Name of the profile: `cia402`, `fc302`, `vlt5000`.
        profile: String,
    },
    /// Frames described by hand.
    Frames(Vec<ast::FrameSignal>),
    /// Messages of a DBC file.
    Dbc(Vec<dbc::Message>),
}

impl Description {
    /// The readable signals: name of the input, and which signal it is. A signal described by hand is identified by its
    /// index in the text, because its message is not known before identifiers are.
    pub fn reads(&self) -> Vec<(&str, SignalRef)> {
        match &self.protocol {
            Protocol::Cia402 { .. } => {
                CIA402_SIGNALS.iter().map(|(name, what)| (*name, SignalRef::Cia402(*what))).collect()
            }
            Protocol::Frames(signals) => {
                let read = signals.iter().enumerate().filter(|(_, signal)| !signal.send);
                read.map(|(k, signal)| (signal.name.text.as_str(), SignalRef::Written(k))).collect()
            }
            Protocol::Dbc(messages) => {
                fields(messages).map(|(m, f, s)| (s.name.as_str(), SignalRef::Field(m, f))).collect()
            }
        }
    }

    /// Unit, identity and span of a signal that can be commanded.
    ///
    /// # Errors
    /// The names of all signals that can be commanded, if this is none of them.
    pub fn sends(&self, name: &str) -> Result<(Option<Unit>, SignalRef, Span), Vec<String>> {
        match &self.protocol {
            Protocol::Cia402 { mode, .. } => {
                let (text, unit, what) = match mode {
                    Mode::Torque => ("torque", "N·m", SignalKind::Torque),
                    Mode::Speed => ("speed", "rad/s", SignalKind::Speed),
                    Mode::Position => ("position", "rad", SignalKind::Position),
                };
                match name == text {
                    true => Ok((Unit::parse(unit).ok(), SignalRef::Cia402(what), self.name.span)),
                    false => Err(vec![text.into()]),
                }
            }
            Protocol::Frames(signals) => {
                let sent = signals.iter().enumerate().filter(|(_, signal)| signal.send);
                let mut names = Vec::new();
                for (k, signal) in sent {
                    if signal.name.text == name {
                        let unit = signal.unit.as_ref().and_then(|unit| Unit::parse(&unit.text).ok());
                        return Ok((Some(unit.unwrap_or_default()), SignalRef::Written(k), signal.name.span));
                    }
                    names.push(signal.name.text.clone());
                }
                Err(names)
            }
            Protocol::Dbc(messages) => {
                let found = fields(messages).find(|(_, _, signal)| signal.name == name);
                match found {
                    Some((m, f, signal)) => {
                        Ok((Some(signal.unit.clone().unwrap_or_default()), SignalRef::Field(m, f), signal.span))
                    }
                    None => Err(fields(messages).map(|(_, _, signal)| signal.name.clone()).collect()),
                }
            }
        }
    }
}

/// Identity of a signal before identifiers are known.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum SignalRef {
    /// A CiA 402 signal.
    Cia402(SignalKind),
    /// The signal of this index in a description by hand.
    Written(usize),
    /// Message and field of a DBC file.
    Field(usize, usize),
}

const CIA402_SIGNALS: [(&str, SignalKind); 6] = [
    ("torque", SignalKind::Torque),
    ("speed", SignalKind::Speed),
    ("position", SignalKind::Position),
    ("enabled_bit", SignalKind::Enabled),
    ("fault_bit", SignalKind::Fault),
    ("limited_bit", SignalKind::Limited),
];

fn fields(messages: &[dbc::Message]) -> impl Iterator<Item = (usize, usize, &dbc::Signal)> {
    let of =
        |(m, message): (usize, &'_ dbc::Message)| (0..message.signals.len()).map(move |f| (m, f)).collect::<Vec<_>>();
    let all: Vec<(usize, usize)> = messages.iter().enumerate().flat_map(of).collect();
    all.into_iter().map(|(m, f)| (m, f, &messages[m].signals[f]))
}

/// Describes the drives and devices of a rig. Omits those with errors, which it reports.
pub fn describe(
    loaded: &mut Loaded,
    sources: &dyn Sources,
    file: FileId,
    rig: &ast::Rig,
    diagnostics: &mut Vec<Diagnostic>,
) -> Vec<Description> {
    let statements: Vec<&ast::DriveDecl> = rig
        .body
        .iter()
        .filter_map(|statement| match statement {
            ast::RigStatement::Drive(drive) => Some(drive),
            _ => None,
        })
        .collect();
    let mut cia402 = None;
    let mut files = Vec::new();
    statements
        .into_iter()
        .filter_map(|statement| {
            let mut reader = Describer { loaded: &mut *loaded, sources, diagnostics: &mut *diagnostics };
            match PROFILES.contains(&statement.kind.text.as_str()) {
                true => {
                    let known = cia402.get_or_insert_with(|| reader.cia402());
                    let known = known.clone();
                    Some(reader.drive(statement, known))
                }
                false => reader.device(statement, file, &mut files),
            }
        })
        .collect()
}

struct Describer<'a> {
    loaded: &'a mut Loaded,
    sources: &'a dyn Sources,
    diagnostics: &'a mut Vec<Diagnostic>,
}

impl Describer<'_> {
    fn cia402(&mut self) -> (FileId, ast::Model) {
        let file = self.loaded.add_text("cia402", CIA402);
        let parsed = grammar::parse::parse(file, CIA402);
        match parsed.file.items.into_iter().next() {
            Some(Item::Model(model)) => (file, model),
            _ => unreachable!("the description of a drive is a model"),
        }
    }

    fn drive(&mut self, statement: &ast::DriveDecl, (file, mut model): (FileId, ast::Model)) -> Description {
        model.name.text = statement.kind.text.clone();
        let mut mode = None;
        let mut at_sync = false;
        let mut args = Vec::new();
        for (name, value) in &statement.args {
            let mut word = |words: &[&'static str], what: &str| {
                let given = match value {
                    ast::DriveArg::Expr(Expr { kind: ExprKind::Path(path), .. }) => path.single(),
                    _ => None,
                };
                let span = match value {
                    ast::DriveArg::Expr(expr) => expr.span,
                    ast::DriveArg::Range(low, high) => low.span.to(high.span),
                };
                let found = given.and_then(|given| words.iter().position(|word| *word == given.text));
                if found.is_none() {
                    let error = Diagnostic::error("E0205", format!("there is no such {what} of a drive"))
                        .label(span, "not known");
                    self.diagnostics.push(match given.and_then(|given| nearest(&given.text, words.iter().copied())) {
                        Some(near) => error.help(format!("did you mean `{near}`?")),
                        None => error.help(format!("write {}", words.join(" or "))),
                    });
                }
                found.map(|found| words[found])
            };
            match (name.text.as_str(), value) {
                ("mode", _) => {
                    let found = word(&["torque", "speed", "position"], "mode");
                    mode = Some(match found {
                        Some("speed") => Mode::Speed,
                        Some("position") => Mode::Position,
                        _ => Mode::Torque,
                    });
                }
                ("apply", _) => at_sync = word(&["at_once", "at_sync"], "way to apply a command") == Some("at_sync"),
                ("travel", ast::DriveArg::Range(low, high)) => {
                    args.push(bind("travel_low", name.span, low));
                    args.push(bind("travel_high", name.span, high));
                }
                ("travel", ast::DriveArg::Expr(expr)) => {
                    let error = Diagnostic::error("E0205", "`travel` is a range").label(expr.span, "one end only");
                    self.diagnostics.push(error.help("write `travel = -1 rad .. 1 rad`"));
                }
                (_, ast::DriveArg::Range(low, high)) => self.no_range(name, low.span.to(high.span)),
                (_, ast::DriveArg::Expr(expr)) => args.push(bind(&name.text, name.span, expr)),
            }
        }
        self.no_signals(&model, &args, statement);
        if mode.is_none() {
            let message = format!("what does `{}` follow?", statement.name.text);
            let error = Diagnostic::error("E0203", message).label(statement.kind.span, "`mode` is not given");
            self.diagnostics.push(error.help("add `mode = torque`, `mode = speed` or `mode = position`"));
        }
        let protocol =
            Protocol::Cia402 { mode: mode.unwrap_or(Mode::Torque), at_sync, profile: statement.kind.text.clone() };
        described(statement, model, file, args, protocol)
    }

    fn no_range(&mut self, name: &Name, span: Span) {
        let error = Diagnostic::error("E0205", format!("`{}` takes one value", name.text)).label(span, "a range");
        self.diagnostics.push(error.help("only `travel` takes a range"));
    }

    /// Reports arguments for signals, which come from the bus.
    fn no_signals(&mut self, model: &ast::Model, args: &[ast::Bind], statement: &ast::DriveDecl) {
        for arg in args {
            let input = model.body.iter().any(|one| {
                matches!(one, ast::Statement::Declaration(d)
                    if d.kind == DeclarationKind::Input && d.name.text == arg.name.text)
            });
            if input {
                let message = format!("`{}` of `{}` comes from the bus", arg.name.text, statement.name.text);
                let error = Diagnostic::error("E0205", message).label(arg.span, "cannot be given");
                self.diagnostics.push(error.help("read it where the rig needs it"));
            }
        }
    }

    fn device(
        &mut self,
        statement: &ast::DriveDecl,
        file: FileId,
        files: &mut Vec<(String, FileId, Vec<dbc::Message>)>,
    ) -> Option<Description> {
        let kind = &statement.kind;
        let found = match self.loaded.find(file, Space::Type, &kind.text) {
            Lookup::Found(item, Item::Device(device)) => Some((item.file, device.clone())),
            Lookup::Found(_, _) => {
                let error = Diagnostic::error("E0201", format!("`{}` is not a device", kind.text))
                    .label(kind.span, "a model or an interface");
                self.diagnostics.push(error.help("a rig's drives and devices are described by `device NAME { … }`"));
                None
            }
            Lookup::Ambiguous(a, b) => {
                let file = |item: crate::frontend::resolve::ItemRef| self.loaded.files.get(item.file).name.clone();
                let error = Diagnostic::error("E0202", format!("two imports define `{}`", kind.text))
                    .label(kind.span, format!("in {} and in {}", file(a), file(b)));
                self.diagnostics.push(error.help("import only one of them"));
                None
            }
            Lookup::Missing => {
                let error = Diagnostic::error("E0201", format!("there is no device `{}`", kind.text))
                    .label(kind.span, "not declared and not imported");
                let names = self.loaded.visible(file, Space::Type).into_iter().chain(PROFILES);
                self.diagnostics.push(match nearest(&kind.text, names) {
                    Some(near) => error.help(format!("did you mean `{near}`?")),
                    None => error.help(format!("known drives are {}", PROFILES.join(", "))),
                });
                None
            }
        };
        let (home, device) = found?;
        let mut args = Vec::new();
        for (name, value) in &statement.args {
            match value {
                ast::DriveArg::Expr(expr) => args.push(bind(&name.text, name.span, expr)),
                ast::DriveArg::Range(low, high) if statement.moves && name.text == "travel" => {
                    args.push(bind("travel_low", name.span, low));
                    args.push(bind("travel_high", name.span, high));
                }
                ast::DriveArg::Range(low, high) => self.no_range(name, low.span.to(high.span)),
            }
        }
        let (body, protocol) = match &device.body {
            ast::DeviceBody::Frames { params, frames } => {
                (self.by_hand(params, frames), Protocol::Frames(frames.clone()))
            }
            ast::DeviceBody::Dbc { file: path, messages } => {
                let messages = self.messages(home, path, messages, files)?;
                (self.by_dbc(&messages), Protocol::Dbc(messages))
            }
        };
        let mut body: Vec<ast::Statement> = body.into_iter().map(ast::Statement::Declaration).collect();
        let taken = |body: &[ast::Statement], name: &str| {
            body.iter().any(|one| matches!(one, ast::Statement::Declaration(d) if d.name.text == name))
        };
        // Limits of a drive; a limit that the drive does not state is not monitored.
        let within = [
            ("speed_max", "rad/s", false),
            ("power_max", "W", false),
            ("travel_low", "rad", true),
            ("travel_high", "rad", false),
        ];
        for (name, unit, below) in within.into_iter().filter(|_| statement.moves) {
            if !taken(&body, name) {
                let value = infinite(below, device.name.span);
                let mut one = declared(DeclarationKind::Param, name, Some(unit), Some(value), device.name.span);
                let above = |span| ast::Range::Bound(BinaryOp::Greater, number(0.0, None, span));
                one.range = (unit != "rad").then(|| above(device.name.span));
                body.push(ast::Statement::Declaration(one));
            }
        }
        for name in ["delay", "lag", "timeout"] {
            if !taken(&body, name) {
                let zero = number(0.0, None, device.name.span);
                let at_least = ast::Range::Bound(BinaryOp::GreaterEqual, number(0.0, None, device.name.span));
                let mut one = declared(DeclarationKind::Param, name, Some("s"), Some(zero), device.name.span);
                one.range = Some(at_least);
                body.push(ast::Statement::Declaration(one));
            }
        }
        let model = ast::Model { name: device.name.clone(), body, doc: device.doc.clone(), span: device.span };
        self.no_signals(&model, &args, statement);
        Some(described(statement, model, home, args, protocol))
    }

    /// Parameters as written, followed by the position and format of each signal as hidden parameters, whose names
    /// contain a blank.
    fn by_hand(&mut self, params: &[Declaration], frames: &[ast::FrameSignal]) -> Vec<Declaration> {
        let mut out = params.to_vec();
        for signal in frames {
            let unit = signal.unit.clone();
            let span = signal.name.span;
            let hidden = |what: &str, unit: Option<UnitText>, value: Expr| Declaration {
                kind: DeclarationKind::Param,
                name: Name { text: format!("{} {what}", signal.name.text), span },
                unit: Some(unit.unwrap_or(UnitText { text: "1".into(), span })),
                value: Some(value),
                range: None,
                doc: None,
                span,
            };
            out.push(hidden("identifier", None, signal.identifier.clone()));
            out.push(hidden("byte", None, signal.byte.clone()));
            let one = number(1.0, unit.clone(), span);
            out.push(hidden("scale", unit.clone(), signal.scale.clone().unwrap_or(one)));
            let zero = number(0.0, None, span);
            out.push(hidden("start", unit.clone(), signal.start.clone().unwrap_or(zero)));
            if format_of(&signal.format.text).is_none() {
                let error = Diagnostic::error("E0201", format!("there is no format `{}`", signal.format.text))
                    .label(signal.format.span, "not known");
                self.diagnostics.push(match nearest(&signal.format.text, FORMATS.iter().map(|(name, ..)| *name)) {
                    Some(near) => error.help(format!("did you mean `{near}`?")),
                    None => error.help("formats are u8 i8 u16 i16 u32 i32 f32, big-endian with `_be` behind them"),
                });
            }
            if !signal.send {
                out.push(Declaration {
                    kind: DeclarationKind::Input,
                    name: signal.name.clone(),
                    unit,
                    value: None,
                    range: None,
                    doc: signal.doc.clone(),
                    span: signal.span,
                });
            }
        }
        out
    }

    /// The messages that a device names, from its DBC file.
    fn messages(
        &mut self,
        home: FileId,
        path: &ast::Text,
        names: &[Name],
        files: &mut Vec<(String, FileId, Vec<dbc::Message>)>,
    ) -> Option<Vec<dbc::Message>> {
        let from = self.loaded.files.get(home).name.clone();
        let (name, text) = match self.sources.file(&from, &path.text) {
            Ok(found) => found,
            Err(reason) => {
                let error = Diagnostic::error("E0201", format!("cannot read \"{}\"", path.text))
                    .label(path.span, reason)
                    .help("the path is relative to the file that names it");
                self.diagnostics.push(error);
                return None;
            }
        };
        if !files.iter().any(|(known, ..)| *known == name) {
            let file = self.loaded.add_text(&name, &text);
            match dbc::read(file, &text) {
                Ok(messages) => files.push((name.clone(), file, messages)),
                Err((why, span)) => {
                    let error = Diagnostic::error("E0807", format!("\"{}\" cannot be read as a DBC file", path.text))
                        .label(path.span, "named here")
                        .label(span, why);
                    self.diagnostics.push(error.help("the second place is where reading ended"));
                    return None;
                }
            }
        }
        let (_, _, all) = files.iter().find(|(known, ..)| *known == name)?;
        let mut out: Vec<dbc::Message> = Vec::new();
        for name in names {
            match all.iter().find(|message| message.name == name.text) {
                Some(message) => {
                    if let Some((signal, why)) = &message.unclear {
                        let error = Diagnostic::error("E0807", format!("in {}, {why}", name.text))
                            .label(name.span, "asked for here")
                            .label(message.signals[*signal].span, "described here");
                        self.diagnostics
                            .push(error.help("one switch, or SG_MUL_VAL_ with one value for each signal, can be read"));
                    }
                    out.push(message.clone());
                }
                None => {
                    let error = Diagnostic::error("E0807", format!("\"{}\" has no message `{}`", path.text, name.text))
                        .label(name.span, "not in the file");
                    let known: Vec<&str> = all.iter().map(|message| message.name.as_str()).collect();
                    self.diagnostics.push(match nearest(&name.text, known.iter().copied()) {
                        Some(near) => error.help(format!("did you mean `{near}`?")),
                        None if known.is_empty() => error.help("there is no message in it"),
                        None => error.help(format!("it has {}", few(&known))),
                    });
                }
            }
        }
        let mut seen: Vec<(&str, &str)> = Vec::new();
        for message in &out {
            for signal in &message.signals {
                if let Some((other, _)) = seen.iter().find(|(_, known)| *known == signal.name) {
                    let why = format!("{other} and {} both have a signal `{}`", message.name, signal.name);
                    let error = Diagnostic::error("E0202", why).label(path.span, "in this file");
                    self.diagnostics.push(error.label(signal.span, "again here").help("make a device of each message"));
                    return None;
                }
                seen.push((&message.name, &signal.name));
            }
        }
        (out.len() == names.len()).then_some(out)
    }

    /// Inputs in the units of the DBC file.
    fn by_dbc(&mut self, messages: &[dbc::Message]) -> Vec<Declaration> {
        let one = |(_, _, signal): (usize, usize, &dbc::Signal)| {
            let unit = signal.unit.as_ref().map(|unit| unit.text.as_str()).filter(|unit| !unit.is_empty());
            declared(DeclarationKind::Input, &signal.name, unit.or(Some("1")), None, signal.span)
        };
        fields(messages).map(one).collect()
    }
}

/// At most eight of the names.
fn few(names: &[&str]) -> String {
    match names {
        [first @ .., _] if names.len() > 8 => format!("{}, …", first[..8].join(", ")),
        all => all.join(", "),
    }
}

fn described(
    statement: &ast::DriveDecl,
    model: ast::Model,
    file: FileId,
    args: Vec<ast::Bind>,
    protocol: Protocol,
) -> Description {
    let instance = ast::Instance { rotary: false, model: statement.kind.clone(), args, span: statement.kind.span };
    Description { name: statement.name.clone(), statement: statement.clone(), model, file, instance, protocol }
}

fn bind(name: &str, span: Span, value: &Expr) -> ast::Bind {
    let whole = span.to(value.span);
    ast::Bind {
        name: Name { text: name.into(), span },
        inner: None,
        value: ast::BindValue::Expr(value.clone()),
        span: whole,
    }
}

fn number(value: f64, unit: Option<UnitText>, span: Span) -> Expr {
    Expr { kind: ExprKind::Number { value, unit }, span }
}

/// `inf` or `-inf`, which match every unit.
fn infinite(below: bool, span: Span) -> Expr {
    let name = Name { text: "inf".into(), span };
    let path = ast::Path { segments: vec![ast::Segment { name, index: None }], span };
    let above = Expr { kind: ExprKind::Path(path), span };
    let kind = match below {
        true => ExprKind::Unary(ast::UnaryOp::Negate, Box::new(above)),
        false => return above,
    };
    Expr { kind, span }
}

fn declared(kind: DeclarationKind, name: &str, unit: Option<&str>, value: Option<Expr>, span: Span) -> Declaration {
    let unit = unit.map(|text| UnitText { text: text.into(), span });
    Declaration { kind, name: Name { text: name.into(), span }, unit, value, range: None, doc: None, span }
}

/// Formats of frames described by hand: name, bits, interpretation.
const FORMATS: &[(&str, u16, Format)] = &[
    ("u8", 8, Format::Unsigned),
    ("i8", 8, Format::Signed),
    ("u16", 16, Format::Unsigned),
    ("i16", 16, Format::Signed),
    ("u32", 32, Format::Unsigned),
    ("i32", 32, Format::Signed),
    ("f32", 32, Format::Float32),
];

/// Number of bits, interpretation, and whether the most significant byte comes first.
pub fn format_of(text: &str) -> Option<(u16, Format, bool)> {
    let (plain, big_endian) = match text.strip_suffix("_be") {
        Some(plain) => (plain, true),
        None => (text, false),
    };
    FORMATS.iter().find(|(name, ..)| *name == plain).map(|(_, bits, format)| (*bits, *format, big_endian))
}
