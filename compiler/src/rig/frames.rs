//! Frames on the buses: messages of devices, identifiers, and bus load.
//!
//! In: descriptions of nodes. Out: messages with their fields, and diagnostics. Knows nothing of timing within a cycle.
//!
//! Source of the bits of a frame: ISO 11898-1. The worst case with bit stuffing is 55 + 10 n for n data bytes, and 25
//! more with a 29-bit identifier.

use super::dbc;
use super::nodes::{Description, Protocol, SignalRef, format_of};
use abi::rig::{Field, Kind, Message, Rig, SignalKind};
use abi::unit::Unit;
use grammar::diagnostic::Diagnostic;
use grammar::span::{FileId, Span};

/// Heartbeat period of a drive, s.
const DRIVE_HEARTBEAT: f64 = 20e-3;
/// Repetition period of a frame whose content does not change, s.
const REPEATED: f64 = 100e-3;
/// Share of a bus above which frames arrive late in bursts: a warning.
const BUSY: f64 = 0.80;
/// Share of a bus that cannot be reached.
const FULL: f64 = 0.95;

/// Messages of a node, and the location of each of its signals.
#[derive(Default)]
pub struct MessageLayout {
    /// Its messages.
    pub messages: Vec<Message>,
    /// For each signal described by hand: message and field.
    pub fields: Vec<(usize, usize)>,
}

/// Lays out the messages of a device described by hand. `value`: the value of a hidden parameter by name.
pub fn by_hand(
    description: &Description,
    value: &dyn Fn(&str) -> f64,
    diagnostics: &mut Vec<Diagnostic>,
) -> MessageLayout {
    let Protocol::Frames(signals) = &description.protocol else { return MessageLayout::default() };
    let mut laid = MessageLayout::default();
    for signal in signals {
        let name = &signal.name.text;
        let get = |what: &str| value(&format!("{name} {what}"));
        let (id, byte) = (get("identifier"), get("byte"));
        let (bits, format, big_endian) =
            format_of(&signal.format.text).unwrap_or((8, abi::rig::Format::Unsigned, false));
        let mut refuse = |span: Span, message: String, help: &str| {
            diagnostics.push(Diagnostic::error("E0802", message).label(span, "does not fit").help(help));
        };
        if !(id.fract() == 0.0 && (0.0..=f64::from(0x1FFF_FFFFu32)).contains(&id)) {
            let message = format!("{id} is no identifier of a frame");
            refuse(signal.identifier.span, message, "11 bits, 0 to 0x7FF, or 29 bits, up to 0x1FFFFFFF");
        }
        let bytes = f64::from(bits / 8);
        if !(byte.fract() == 0.0 && byte >= 0.0 && byte + bytes <= 8.0) {
            let message = format!("`{name}` does not fit into a frame of 8 bytes");
            refuse(signal.byte.span, message, "the first byte is 0; i16 and u16 take two bytes, 32 bits take four");
        }
        let scale = get("scale");
        if !(scale.is_finite() && scale != 0.0) {
            let span = signal.scale.as_ref().map_or(signal.name.span, |scale| scale.span);
            refuse(span, format!("one step of `{name}` is {scale}"), "give the value of one step");
        }
        let (id, byte) = (id.clamp(0.0, 536_870_911.0) as u32, byte.clamp(0.0, 7.0) as u16);
        let at = laid.messages.iter().position(|message| message.id == id && message.send == signal.send);
        let at = at.unwrap_or_else(|| {
            laid.messages.push(Message {
                name: name.clone(),
                id,
                extended: id > 0x7FF,
                length: 0,
                send: signal.send,
                period_ns: 0,
                fields: Vec::new(),
            });
            laid.messages.len() - 1
        });
        let message = &mut laid.messages[at];
        let bytes = |field: &Field| field.start_bit / 8..field.start_bit / 8 + field.bits / 8;
        let mine = byte..byte + bits / 8;
        let shared = message.fields.iter().find(|field| bytes(field).start < mine.end && mine.start < bytes(field).end);
        if let Some(other) = shared.filter(|_| signal.send) {
            let text = format!("`{name}` lies on top of `{}`", other.name);
            let error = Diagnostic::error("E0802", text).label(signal.byte.span, format!("byte {byte} is taken"));
            diagnostics.push(error.help("signals of one message stand side by side: give it a byte behind"));
        }
        message.length = message.length.max((byte + bits / 8).min(8) as u8);
        let start = get("start");
        message.fields.push(Field {
            name: name.clone(),
            start_bit: byte * 8 + if big_endian { 7 } else { 0 },
            bits,
            big_endian,
            format,
            scale,
            offset: 0.0,
            start: if start.is_finite() { start } else { 0.0 },
            unit: signal.unit.as_ref().and_then(|unit| Unit::parse(&unit.text).ok()).unwrap_or_default(),
            multiplexed: None,
        });
        laid.fields.push((at, laid.messages[at].fields.len() - 1));
    }
    laid
}

/// Lays out the messages of a DBC file. Messages with a commanded signal are sent.
pub fn by_dbc(
    messages: &[dbc::Message],
    sent: &dyn Fn(usize) -> bool,
    diagnostics: &mut Vec<Diagnostic>,
) -> MessageLayout {
    let mut laid = MessageLayout::default();
    for (m, message) in messages.iter().enumerate() {
        let mut refuse = |span: Span, why: String| {
            diagnostics.push(Diagnostic::error("E0802", why).label(span, "in the DBC file"));
        };
        if message.length > 8 {
            refuse(message.span, format!("{} has {} bytes: a CAN frame has at most 8", message.name, message.length));
        }
        if !message.extended && message.id > 0x7FF {
            refuse(message.span, format!("{} has the identifier {:#x}, more than 11 bits", message.name, message.id));
        }
        let field = |signal: &dbc::Signal| {
            let unit = signal.unit.clone().unwrap_or_default();
            let offset = unit.scale * signal.offset + signal.unit_offset;
            Field {
                name: signal.name.clone(),
                start_bit: signal.start_bit.min(63) as u16,
                bits: signal.bits.min(64) as u16,
                big_endian: signal.big_endian,
                format: signal.format,
                scale: unit.scale * signal.factor,
                offset,
                start: 0.0,
                unit,
                multiplexed: signal.present_at,
            }
        };
        for signal in &message.signals {
            if !inside(signal, message.length) {
                refuse(
                    signal.span,
                    format!("`{}` does not fit into the {} bytes of {}", signal.name, message.length, message.name),
                );
            }
            if signal.factor == 0.0 {
                refuse(signal.span, format!("one step of `{}` is 0", signal.name));
            }
        }
        laid.messages.push(Message {
            name: message.name.clone(),
            id: message.id,
            extended: message.extended,
            length: message.length.min(8) as u8,
            send: sent(m),
            period_ns: message.period_ns,
            fields: message.signals.iter().map(field).collect(),
        });
    }
    laid
}

/// The messages of a DBC file that can be read, for callers that decode frames.
///
/// # Errors
/// The error in the file, in words.
pub fn of_dbc(text: &str) -> Result<Vec<Message>, String> {
    let mut messages = dbc::read(FileId(0), text).map_err(|(why, span)| {
        let line = text[..span.start as usize].lines().count().max(1);
        format!("line {line}: {why}")
    })?;
    messages.retain(|message| message.unclear.is_none());
    let mut found = Vec::new();
    let laid = by_dbc(&messages, &|_| false, &mut found);
    match found.first() {
        Some(first) => Err(first.message.clone()),
        None => Ok(laid.messages),
    }
}

/// Whether all bits of a signal lie within the frame. A big-endian signal starts at its most significant bit, continues
/// downwards within a byte, and then at the top of the next byte.
fn inside(signal: &dbc::Signal, length: u64) -> bool {
    let (byte, bit) = (signal.start_bit / 8, signal.start_bit % 8);
    let last = match signal.big_endian {
        true => byte * 8 + (7 - bit) + signal.bits,
        false => signal.start_bit + signal.bits,
    };
    signal.bits >= 1 && signal.bits <= 64 && last <= length * 8
}

/// The location of a signal.
pub fn what(read: SignalRef, laid: &MessageLayout) -> SignalKind {
    match read {
        SignalRef::Cia402(what) => what,
        SignalRef::Written(k) => laid.fields.get(k).map_or(SignalKind::Field(0, 0), |(m, f)| SignalKind::Field(*m, *f)),
        SignalRef::Field(m, f) => SignalKind::Field(m, f),
    }
}

/// Least and greatest SI value that a field can represent.
pub fn carries(field: &Field) -> (f64, f64) {
    let top = |bits: u16| (1u128 << bits) as f64;
    let (low, high) = match field.format {
        abi::rig::Format::Unsigned => (0.0, top(field.bits) - 1.0),
        abi::rig::Format::Signed => (-top(field.bits - 1), top(field.bits - 1) - 1.0),
        abi::rig::Format::Float32 => (f64::from(f32::MIN), f64::from(f32::MAX)),
        abi::rig::Format::Float64 => (f64::MIN, f64::MAX),
    };
    let (a, b) = (low * field.scale + field.offset, high * field.scale + field.offset);
    (a.min(b), a.max(b))
}

/// A node from the view of its bus.
pub struct OnBus<'a> {
    /// Its description.
    pub description: &'a Description,
    /// Index of its bus.
    pub bus: usize,
    /// CANopen node id, if it has one.
    pub node: Option<u8>,
    /// Its messages.
    pub messages: &'a [Message],
}

/// Reports identifiers that two nodes of one bus use.
pub fn identifiers(nodes: &[OnBus], diagnostics: &mut Vec<Diagnostic>) {
    let mut taken: Vec<(usize, u32, bool, &Description, String)> = Vec::new();
    for node in nodes {
        let mut ids: Vec<(u32, bool, String)> = Vec::new();
        if let Some(id) = node.node {
            let services = [
                (0x080, "EMCY"),
                (0x180, "TPDO 1"),
                (0x200, "RPDO 1"),
                (0x280, "TPDO 2"),
                (0x300, "RPDO 2"),
                (0x580, "SDO answer"),
                (0x600, "SDO request"),
                (0x700, "heartbeat"),
            ];
            ids.extend(
                services.iter().map(|(base, service)| (base + u32::from(id), false, format!("{service} of node {id}"))),
            );
        }
        ids.extend(
            node.messages.iter().map(|message| (message.id, message.extended, format!("message {}", message.name))),
        );
        let canopen = nodes.iter().any(|other| other.bus == node.bus && other.node.is_some());
        for (id, extended, use_) in ids {
            let reserved = match id {
                0x000 => Some("NMT"),
                0x080 => Some("SYNC"),
                _ => None,
            };
            let span = node.description.statement.kind.span;
            if let Some(service) = reserved.filter(|_| canopen && !extended) {
                let message = format!("identifier {id:#05x} belongs to {service} where CANopen drives are on the bus");
                let error = Diagnostic::error("E0804", message).label(span, use_);
                diagnostics.push(error.help("give the device an identifier of its own, or a bus of its own"));
                continue;
            }
            let claimed = taken.iter().find(|(bus, known, long, ..)| (*bus, *known, *long) == (node.bus, id, extended));
            if let Some((_, _, _, other, first)) = claimed {
                let same = std::ptr::eq(*other, node.description);
                let both_drives = node.node.is_some()
                    && nodes.iter().any(|n| std::ptr::eq(n.description, *other) && n.node == node.node);
                let message = match both_drives && !same {
                    true => format!("node {} is used twice on this bus", node.node.unwrap_or(0)),
                    false => format!("identifier {id:#05x} is used twice on this bus"),
                };
                let help = match both_drives {
                    true => "give each drive a node id of its own",
                    false => "give one of them another identifier, or a bus of its own",
                };
                let error = Diagnostic::error("E0804", message)
                    .label(span, use_)
                    .label(other.statement.kind.span, first.clone());
                diagnostics.push(error.help(help));
                break;
            }
            taken.push((node.bus, id, extended, node.description, use_));
        }
    }
}

/// Worst-case load of a bus in bits per second.
pub fn load(rig: &Rig, bus: usize) -> f64 {
    let bits = |bytes: u8, extended: bool| 55.0 + 10.0 * f64::from(bytes) + if extended { 25.0 } else { 0.0 };
    let (period, watchdog) = (rig.period_ns as f64 * 1e-9, rig.watchdog_ns as f64 * 1e-9);
    let mut sum = 0.0;
    let mut canopen = false;
    for (n, node) in rig.nodes.iter().enumerate().filter(|(_, node)| node.bus == bus) {
        let messages = match &node.kind {
            Kind::Cia402(_) => {
                canopen = true;
                // Output: target and control word. Input: status, torque and speed in one frame, position in another.
                sum += (bits(4, false) + bits(8, false) + bits(4, false)) / period + bits(1, false) / DRIVE_HEARTBEAT;
                continue;
            }
            Kind::Frames(messages) => messages,
        };
        for (m, message) in messages.iter().enumerate() {
            let commanded = rig.outputs.iter().any(|output| {
                output.signal.node == n && matches!(output.signal.what, SignalKind::Field(k, _) if k == m)
            });
            let every = match (message.send, message.period_ns) {
                (_, ns) if ns > 0 => ns as f64 * 1e-9,
                (true, _) if commanded && node.moves => period,
                (true, _) => REPEATED,
                (false, _) if node.timeout_ns > 0 => node.timeout_ns as f64 * 1e-9 / 3.0,
                (false, _) => REPEATED,
            };
            sum += bits(message.length, message.extended) / every;
        }
    }
    if canopen {
        sum += bits(0, false) / period + bits(1, false) / (0.5 * watchdog);
    }
    sum
}

/// Reports a bus whose load is too high.
pub fn crowded(name: &str, span: Span, load: f64, rate: f64, diagnostics: &mut Vec<Diagnostic>) {
    let share = load / rate;
    if rate <= 0.0 || share <= BUSY {
        return;
    }
    let percent = (100.0 * share).round();
    let message = format!("`{name}` is {percent} % full in the worst case");
    let help = "a slower `rate`, a faster bus, or a second bus for one of the drives";
    let found = match share > FULL {
        true => Diagnostic::error("E0805", message).label(span, format!("more than {} %", 100.0 * FULL)),
        false => Diagnostic::warning("W0805", message).label(span, "frames will wait for each other"),
    };
    diagnostics.push(found.help(help));
}
