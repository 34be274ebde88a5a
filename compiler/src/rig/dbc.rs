//! DBC files: messages and signals by name. The only place that knows the crate that reads them.
//!
//! In: a text. Out: its [`Message`]s, with the place of every name in that text. A signal's start bit is as the file counts
//! it; its unit is what people write in such files, turned into ours where we know it.

use abi::rig::Format;
use abi::unit::Unit;
use can_dbc::{AttributeValue, ByteOrder, Dbc, MessageId, MultiplexIndicator, SignalExtendedValueType, ValueType};
use grammar::span::{FileId, Span};

/// One message of a file.
#[derive(Clone, PartialEq, Debug)]
pub struct Message {
    /// Its name.
    pub name: String,
    /// Where the name stands in the file.
    pub span: Span,
    /// The identifier.
    pub id: u32,
    /// 29-bit rather than 11-bit.
    pub extended: bool,
    /// Number of data bytes.
    pub length: u64,
    /// `GenMsgCycleTime`, ns; 0 where the file names none.
    pub period_ns: u64,
    /// What it carries.
    pub signals: Vec<Signal>,
    /// Why we cannot tell which signals are in a frame, if we cannot: the signal, and words.
    pub unclear: Option<(usize, String)>,
}

/// One signal of a message.
#[derive(Clone, PartialEq, Debug)]
pub struct Signal {
    /// Its name.
    pub name: String,
    /// Where the name stands in the file.
    pub span: Span,
    /// As the file counts.
    pub start_bit: u64,
    /// Number of bits.
    pub bits: u64,
    /// Most significant byte first.
    pub big_endian: bool,
    /// How the bits are read.
    pub format: Format,
    /// Of the number in the file's unit: raw · factor + offset.
    pub factor: f64,
    /// See `factor`.
    pub offset: f64,
    /// The unit as the file writes it.
    pub unit_text: String,
    /// The unit, if we know it.
    pub unit: Option<Unit>,
    /// What is added to a number in `unit`: 273.15 for degrees Celsius, shown in K.
    pub unit_offset: f64,
    /// Present only while the signal of this number, a switch, has this raw value.
    pub present_at: Option<(usize, u64)>,
}

/// Reads a file whose text has this number.
///
/// # Errors
/// What is wrong, and where.
pub fn read(file: FileId, text: &str) -> Result<Vec<Message>, (String, Span)> {
    let dbc = Dbc::try_from(text).map_err(|error| {
        // The first line of the parser's words says what it wanted; the place is in `--> LINE:COLUMN`.
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

/// Which signals of a message are present only while which other has which raw value.
///
/// # Errors
/// The signal of which the file does not say that, or more than we can do, and why.
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
        // Where there are several switches, a line of its own names the one.
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
    // A switch may hang on another one, but none on itself.
    for &(k, _) in &out {
        let above = |at: usize| out.iter().find(|(signal, _)| *signal == at).map(|(_, (switch, _))| *switch);
        if std::iter::successors(Some(k), |at| above(*at)).take(signals.len() + 1).count() > signals.len() {
            return Err((k, format!("the switch of `{}` is switched by itself", signals[k].name)));
        }
    }
    Ok(out)
}

/// What people write for units in such files: the unit, and what is added to a number in it.
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

/// Where `BO_ id name` begins, and where the name stands.
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

/// Where the name of a signal stands behind the begin of its message.
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
