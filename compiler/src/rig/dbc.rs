//! DBC files: messages and signals by name. The only module that uses the `can_dbc` crate.
//!
//! In: a text. Out: its [`Message`]s, with the span of every name. Start bits are counted as in the file. Units are
//! converted from the notations common in such files, if they are known.

use abi::rig::Format;
use abi::unit::Unit;
use can_dbc::{AttributeValue, ByteOrder, Dbc, MessageId, MultiplexIndicator, SignalExtendedValueType, ValueType};
use grammar::span::{FileId, Span};

/// One message of a file.
#[derive(Clone, PartialEq, Debug)]
pub struct Message {
    /// Its name.
    pub name: String,
    /// Span of the name in the file.
    pub span: Span,
    /// CAN identifier.
    pub id: u32,
    /// Whether the identifier has 29 bits rather than 11.
    pub extended: bool,
    /// Number of data bytes.
    pub length: u64,
    /// `GenMsgCycleTime` in ns; 0 if the file has none.
    pub period_ns: u64,
    /// Signals of the message.
    pub signals: Vec<Signal>,
    /// If the signals present in a frame cannot be determined: the index of the signal, and the reason.
    pub unclear: Option<(usize, String)>,
}

/// One signal of a message.
#[derive(Clone, PartialEq, Debug)]
pub struct Signal {
    /// Its name.
    pub name: String,
    /// Span of the name in the file.
    pub span: Span,
    /// Start bit as counted in the file.
    pub start_bit: u64,
    /// Number of bits.
    pub bits: u64,
    /// Whether the most significant byte comes first.
    pub big_endian: bool,
    /// Interpretation of the bits.
    pub format: Format,
    /// Factor of the value in the file's unit: raw · factor + offset.
    pub factor: f64,
    /// See `factor`.
    pub offset: f64,
    /// The unit as written in the file.
    pub unit_text: String,
    /// The unit, if it is known.
    pub unit: Option<Unit>,
    /// Added to a number in `unit`: 273.15 for degrees Celsius, which are displayed in K.
    pub unit_offset: f64,
    /// For a multiplexed signal: the index of its switch, and the raw value of the switch at which it is present.
    pub present_at: Option<(usize, u64)>,
}

/// Reads the DBC file with this id.
///
/// # Errors
/// The error and its span.
pub fn read(file: FileId, text: &str) -> Result<Vec<Message>, (String, Span)> {
    let dbc = Dbc::try_from(text).map_err(|error| {
        // The first line of the parser's message says what it expected; the position follows as `--> LINE:COLUMN`.
        let words = error.to_string();
        let place = words.split("--> ").nth(1).and_then(|rest| {
            let (line, rest) = rest.split_once(':')?;
            let column: String = rest.chars().take_while(char::is_ascii_digit).collect();
            Some((line.trim().parse::<usize>().ok()?, column.parse::<usize>().ok()?))
        });
        let (line, column) = place.unwrap_or((1, 1));
        let start: usize = text.split_inclusive('\n').take(line.saturating_sub(1)).map(str::len).sum();
        let rest = &text[start.min(text.len())..];
        let here = rest.chars().take(column.saturating_sub(1)).map(char::len_utf8).sum::<usize>();
        let at = (start + here).min(text.len());
        let wanted = words.lines().rev().find_map(|line| line.trim().strip_prefix("= ").map(str::to_string));
        (wanted.unwrap_or_else(|| "not as DBC files are written".into()), Span::new(file, at, at))
    })?;
    let mut messages = Vec::new();
    for message in &dbc.messages {
        let (id, extended) = match message.id {
            MessageId::Standard(id) => (u32::from(id), false),
            MessageId::Extended(id) => (id, true),
        };
        let raw = message.id.raw();
        let Some((block, span)) = place_of_message(file, text, raw, &message.name) else {
            let why = format!("the identifier of {} has more than 11 bits and no mark of 29", message.name);
            return Err((why, Span::new(file, 0, 0)));
        };
        let period_ms = match dbc.resolved_message_attribute(message.id, "GenMsgCycleTime") {
            Some(AttributeValue::Uint(ms)) => *ms as f64,
            Some(AttributeValue::Int(ms)) => *ms as f64,
            Some(AttributeValue::Double(ms)) => *ms,
            Some(AttributeValue::String(_)) | None => 0.0,
        };
        let signals = message.signals.iter().map(|signal| {
            let float = dbc.extended_value_type_for_signal(message.id, &signal.name);
            let format = match (float, signal.value_type) {
                (Some(SignalExtendedValueType::IEEEfloat32Bit), _) => Format::Float32,
                (Some(SignalExtendedValueType::IEEEdouble64bit), _) => Format::Float64,
                (_, ValueType::Signed) => Format::Signed,
                (_, ValueType::Unsigned) => Format::Unsigned,
            };
            let (unit, unit_offset) = known_unit(&signal.unit);
            Signal {
                name: signal.name.clone(),
                span: place_of_signal(file, text, block, &signal.name),
                start_bit: signal.start_bit,
                bits: signal.size,
                big_endian: signal.byte_order == ByteOrder::BigEndian,
                format,
                factor: signal.factor,
                offset: signal.offset,
                unit_text: signal.unit.clone(),
                unit,
                unit_offset,
                present_at: None,
            }
        });
        let mut signals: Vec<Signal> = signals.collect();
        let unclear = match switched(&dbc, message) {
            Ok(switched) => {
                switched.into_iter().for_each(|(k, present_at)| signals[k].present_at = Some(present_at));
                None
            }
            Err(unclear) => Some(unclear),
        };
        messages.push(Message {
            name: message.name.clone(),
            span,
            id,
            extended,
            length: message.size,
            period_ns: (period_ms.max(0.0) * 1e6).round() as u64,
            signals,
            unclear,
        });
    }
    Ok(messages)
}

/// For each multiplexed signal, its switch and the raw value of the switch at which it is present.
///
/// # Errors
/// The signal whose switch is undetermined or unsupported, and the reason.
#[allow(clippy::type_complexity, reason = "a signal, its switch and the value of that")]
fn switched(dbc: &Dbc, message: &can_dbc::Message) -> Result<Vec<(usize, (usize, u64))>, (usize, String)> {
    let signals = &message.signals;
    let is_switch = |signal: &can_dbc::Signal| {
        let indicator = signal.multiplexer_indicator;
        matches!(indicator, MultiplexIndicator::Multiplexor | MultiplexIndicator::MultiplexorAndMultiplexedSignal(_))
    };
    let switches: Vec<usize> = (0..signals.len()).filter(|k| is_switch(&signals[*k])).collect();
    let mut out = Vec::new();
    for (k, signal) in signals.iter().enumerate() {
        let value = match signal.multiplexer_indicator {
            MultiplexIndicator::Plain | MultiplexIndicator::Multiplexor => continue,
            MultiplexIndicator::MultiplexedSignal(value)
            | MultiplexIndicator::MultiplexorAndMultiplexedSignal(value) => value,
        };
        let name = &signal.name;
        // With several switches, a separate line of the file names the switch.
        let extended = dbc.extended_multiplex.iter().find(|e| e.message_id == message.id && e.signal_name == *name);
        let (switch, value) = match extended {
            Some(extended) => {
                let [one] = &extended.mappings[..] else {
                    return Err((k, format!("`{name}` is present at several values of its switch")));
                };
                if one.min_value != one.max_value {
                    return Err((k, format!("`{name}` is present at several values of its switch")));
                }
                let wanted = &extended.multiplexor_signal_name;
                let switch = signals.iter().position(|signal| signal.name == *wanted);
                (switch.ok_or_else(|| (k, format!("the switch `{wanted}` of `{name}` is missing")))?, one.min_value)
            }
            None => match switches[..] {
                [switch] if switch != k => (switch, value),
                [] => return Err((k, format!("`{name}` is multiplexed, but its message has no switch"))),
                _ => return Err((k, format!("`{name}` is multiplexed, but no SG_MUL_VAL_ says by which switch"))),
            },
        };
        out.push((k, (switch, value)));
    }
    // Switches may depend on each other, but not in a cycle.
    for &(k, _) in &out {
        let above = |at: usize| out.iter().find(|(signal, _)| *signal == at).map(|(_, (switch, _))| *switch);
        if std::iter::successors(Some(k), |at| above(*at)).take(signals.len() + 1).count() > signals.len() {
            return Err((k, format!("the switch of `{}` is switched by itself", signals[k].name)));
        }
    }
    Ok(out)
}

/// The unit for a common notation, and the offset to add to a number in it.
fn known_unit(text: &str) -> (Option<Unit>, f64) {
    let text = text.trim();
    let ours = match text {
        "" => return (None, 0.0),
        "degC" | "°C" | "C" | "Celsius" => return (Unit::parse("K").ok(), 273.15),
        "Nm" => "N·m",
        "1/min" | "U/min" | "rev/min" | "RPM" => "rpm",
        "°" | "Deg" | "degree" | "degrees" => "deg",
        "°/s" => "deg/s",
        "km/h" | "kph" => "km/h",
        "sec" => "s",
        "msec" => "ms",
        "Amp" | "Amps" => "A",
        "Volt" => "V",
        "ohm" => "Ohm",
        "percent" => "%",
        other => other,
    };
    (Unit::parse(ours).ok(), 0.0)
}

/// The offset of `BO_ id name`, and the span of the name.
fn place_of_message(file: FileId, text: &str, raw: u32, name: &str) -> Option<(usize, Span)> {
    let mut start = 0;
    for line in text.split_inclusive('\n') {
        let mut words = line.split_whitespace();
        if words.next() == Some("BO_") && words.next().and_then(|id| id.parse().ok()) == Some(raw) {
            let at = line.find(name).map_or(start, |at| start + at);
            return Some((start, Span::new(file, at, at + name.len())));
        }
        start += line.len();
    }
    None
}

/// The span of a signal's name after the start of its message.
fn place_of_signal(file: FileId, text: &str, block: usize, name: &str) -> Span {
    let mut start = block;
    for line in text[block..].split_inclusive('\n') {
        let mut words = line.split_whitespace();
        if words.next() == Some("SG_") && words.next().map(|word| word.trim_end_matches(':')) == Some(name) {
            let at = line.find("SG_").map_or(0, |at| at + 3);
            let at = start + at + line[at..].find(name).unwrap_or(0);
            return Span::new(file, at, at + name.len());
        }
        start += line.len();
    }
    Span::new(file, block, block)
}
