//! A node that communicates in described frames: transducers, switches, devices without a drive profile.
//!
//! In: its frames, commands. Out: its signals, the frames to send.

use super::frames;
use crate::can::Frame;
use crate::canopen::Send;
use crate::drive::faults::{Reading, TroubleKind};
use abi::rig::Message;

/// Longest interval between two frames of ours if the text names none.
const PERIOD_NS: u64 = 100_000_000;

/// One message with its values.
#[derive(Clone, Debug)]
struct DeviceMessage {
    message: Message,
    values: Vec<Reading>,
    /// Safe values, SI.
    safe: Vec<f64>,
    /// Data of the last frame sent.
    sent: [u8; 8],
    due_ns: u64,
    fresh: bool,
}

/// State of a device.
#[derive(Clone, Debug)]
pub struct Device {
    lines: Vec<DeviceMessage>,
    moves: bool,
}

fn frame(message: &Message, data: &[u8; 8]) -> Frame {
    let data = &data[..message.length.into()];
    if message.extended { Frame::extended(message.id, data) } else { Frame::new(message.id, data) }
}

impl Device {
    /// A device of a rig. `moves`: it is a drive, to which we send in each tick. `safe`: its safe values, by message
    /// and field.
    pub fn new(messages: &[Message], moves: bool, safe: &[(usize, usize, f64)]) -> Result<Device, String> {
        for message in messages {
            if message.length > 8 || message.id >= if message.extended { 1 << 29 } else { 0x800 } {
                return Err(format!("message `{}` has no possible identifier or length", message.name));
            }
            for field in &message.fields {
                let last = if field.big_endian {
                    (field.start_bit / 8) * 8 + (7 - field.start_bit % 8) + field.bits
                } else {
                    field.start_bit + field.bits
                };
                if field.bits == 0 || field.bits > 64 || last > u16::from(message.length) * 8 {
                    return Err(format!("signal `{}` does not fit message `{}`", field.name, message.name));
                }
            }
        }
        let line = |(at, message): (usize, &Message)| {
            let mut safe_values: Vec<f64> = message.fields.iter().map(|field| field.start).collect();
            for &(_, field, value) in safe.iter().filter(|(message, ..)| *message == at) {
                safe_values[field] = value;
            }
            // We send to a drive in each tick, from the first one on: its safe values at first.
            let begins = if moves && message.send { safe_values.clone() } else { Vec::new() };
            let start = |(k, field): (usize, &abi::rig::Field)| begins.get(k).copied().unwrap_or(field.start);
            DeviceMessage {
                message: message.clone(),
                values: message.fields.iter().enumerate().map(start).map(Reading::none).collect(),
                safe: safe_values,
                sent: [0; 8],
                due_ns: 0,
                fresh: false,
            }
        };
        Ok(Device { lines: messages.iter().enumerate().map(line).collect(), moves })
    }

    /// Whether a frame is one of its messages.
    pub fn owns(&self, frame: &Frame) -> bool {
        self.lines.iter().any(|line| line.message.id == frame.id() && line.message.extended == frame.is_extended())
    }

    /// Receives a frame of its bus.
    pub(super) fn receive(&mut self, frame: &Frame, stamp_ns: u64, tell: &mut dyn FnMut(TroubleKind)) {
        for line in &mut self.lines {
            let message = &line.message;
            if message.send || message.id != frame.id() || message.extended != frame.is_extended() {
                continue;
            }
            if frame.data().len() < message.length.into() {
                tell(TroubleKind::Short(frame.id()));
            }
            for field in 0..message.fields.len() {
                // A field that this frame does not contain keeps its value and ages.
                if let Some(value) = frames::read(message, field, frame.data()) {
                    line.values[field] = Reading { value, stamp_ns, age: 0 };
                }
            }
        }
    }

    /// A signal of the device.
    pub fn reading(&self, message: usize, field: usize) -> Option<Reading> {
        self.lines.get(message)?.values.get(field).copied()
    }

    /// A safe value of the device.
    pub(super) fn safe(&self, message: usize, field: usize) -> f64 {
        self.lines.get(message).and_then(|line| line.safe.get(field)).copied().unwrap_or(0.0)
    }

    /// Begins a tick: all readings age by one tick.
    pub(super) fn begin(&mut self) {
        for reading in self.lines.iter_mut().flat_map(|line| &mut line.values) {
            reading.age = reading.age.saturating_add(1);
        }
    }

    /// Sets the value of a signal that is sent, SI.
    pub fn command(&mut self, message: usize, field: usize, value: f64) {
        self.lines[message].values[field].value = value;
    }

    /// Sets all sent signals to their safe values.
    pub(super) fn rest(&mut self) {
        for line in self.lines.iter_mut().filter(|line| line.message.send) {
            for (reading, safe) in line.values.iter_mut().zip(&line.safe) {
                reading.value = *safe;
            }
        }
    }

    /// Sends messages that have changed or are due; to a drive in each tick.
    pub(super) fn send_commands(&mut self, now_ns: u64, send: Send) {
        for line in self.lines.iter_mut().filter(|line| line.message.send) {
            let mut data = [0; 8];
            frames::fill(&line.message, |field| line.values[field].value, &mut data);
            if self.moves || data != line.sent || now_ns >= line.due_ns || !line.fresh {
                let period = if line.message.period_ns > 0 { line.message.period_ns } else { PERIOD_NS };
                (line.sent, line.due_ns, line.fresh) = (data, now_ns + period, true);
                send(frame(&line.message, &data));
            }
        }
    }

    /// The frames with the safe values.
    pub(super) fn stop_frames(&self) -> impl Iterator<Item = Frame> + '_ {
        self.lines.iter().filter(|line| line.message.send).map(|line| {
            let mut data = [0; 8];
            frames::fill(&line.message, |field| line.safe[field], &mut data);
            frame(&line.message, &data)
        })
    }
}
