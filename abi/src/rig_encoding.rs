//! Serialisation of rigs, for packages and logs.

use crate::encode::{Encode, Malformed, Reader};
use crate::plan::{Method, Series};
use crate::rig::{
    Bus, Cia402, Curves, DriveLimits, Field, Format, Input, Kind, Message, Mode, Node, Output, Overrun, Plant, Rig,
    Signal, SignalKind, Stop,
};
use crate::{encode_enums, encode_structs};

encode_enums! {
    Mode { Torque = 0, Speed = 1, Position = 2 }
    Format { Unsigned = 0, Signed = 1, Float32 = 2, Float64 = 3 }
}

encode_structs! {
    Series { label, slot, unit, boolean }
    Rig {
        name, period_ns, method, steps, buses, nodes, inputs, outputs, watchdog_ns, overrun, stops, record, plots,
        predict, needs_look, plant,
    }
    Curves { series, against }
    Bus { name, address, bit_rate }
    Node { name, bus, kind, moves, delay, lag, timeout_ns, within }
    DriveLimits { max_speed, travel, max_power }
    Cia402 {
        node, rated_torque, mode, count, speed_unit, max_torque, max_speed, travel, max_power, at_sync, profile,
    }
    Signal { node, what }
    Message { name, id, extended, length, send, period_ns, fields }
    Field { name, start_bit, bits, big_endian, format, scale, offset, start, unit, multiplexed }
    Input { signal, slot, start, needed }
    Output { signal, slot, low, high, slew, safe }
    Stop { slot, condition, why }
    Plant { applied, seen, inertia }
}

impl Encode for Method {
    fn encode(&self, out: &mut Vec<u8>) {
        out.push(self.row().code);
    }

    fn decode(reader: &mut Reader) -> Result<Method, Malformed> {
        let code = u8::decode(reader)?;
        let method = Method::ALL.into_iter().find(|method| method.row().code == code);
        method.ok_or_else(|| Malformed(format!("{code} is no method")))
    }
}

/// Encoded as an optional number of ticks: none for `stop`.
impl Encode for Overrun {
    fn encode(&self, out: &mut Vec<u8>) {
        match self {
            Overrun::Stop => None,
            Overrun::Hold(ticks) => Some(*ticks),
        }
        .encode(out);
    }

    fn decode(reader: &mut Reader) -> Result<Overrun, Malformed> {
        Ok(Option::<u32>::decode(reader)?.map_or(Overrun::Stop, Overrun::Hold))
    }
}

impl Encode for Kind {
    fn encode(&self, out: &mut Vec<u8>) {
        match self {
            Kind::Cia402(drive) => {
                out.push(0);
                drive.encode(out);
            }
            Kind::Frames(messages) => {
                out.push(1);
                messages.encode(out);
            }
        }
    }

    fn decode(reader: &mut Reader) -> Result<Kind, Malformed> {
        match u8::decode(reader)? {
            0 => Cia402::decode(reader).map(Kind::Cia402),
            1 => Vec::decode(reader).map(Kind::Frames),
            other => Err(Malformed(format!("{other} is no way to speak"))),
        }
    }
}

impl Encode for SignalKind {
    fn encode(&self, out: &mut Vec<u8>) {
        match self {
            SignalKind::Torque => out.push(0),
            SignalKind::Speed => out.push(1),
            SignalKind::Position => out.push(2),
            SignalKind::Enabled => out.push(3),
            SignalKind::Fault => out.push(4),
            SignalKind::Limited => out.push(5),
            SignalKind::Field(message, field) => {
                out.push(6);
                (*message, *field).encode(out);
            }
        }
    }

    fn decode(reader: &mut Reader) -> Result<SignalKind, Malformed> {
        Ok(match u8::decode(reader)? {
            0 => SignalKind::Torque,
            1 => SignalKind::Speed,
            2 => SignalKind::Position,
            3 => SignalKind::Enabled,
            4 => SignalKind::Fault,
            5 => SignalKind::Limited,
            6 => {
                let (message, field) = <(usize, usize)>::decode(reader)?;
                SignalKind::Field(message, field)
            }
            other => return Err(Malformed(format!("{other} is no signal"))),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Slot;
    use crate::unit::Unit;

    fn rig() -> Rig {
        let drive = Cia402 {
            node: 3,
            rated_torque: 4.0,
            mode: Mode::Torque,
            count: 1e-4,
            speed_unit: 0.1,
            max_torque: Some(3.0),
            max_speed: None,
            travel: Some((-1.0, 1.0)),
            max_power: None,
            at_sync: true,
            profile: "cia402".into(),
        };
        let field = Field {
            name: "T".into(),
            start_bit: 300,
            bits: 16,
            big_endian: true,
            format: Format::Signed,
            scale: 0.01,
            offset: -1.0,
            start: 0.0,
            unit: Unit::parse("N·m").unwrap(),
            multiplexed: Some((2, 7)),
        };
        let message = Message {
            name: "Shaft".into(),
            id: 0x18ff_0102,
            extended: true,
            length: 8,
            send: false,
            period_ns: 1_000_000,
            fields: vec![field],
        };
        let node = |name: &str, kind| Node {
            name: name.into(),
            bus: 0,
            kind,
            moves: true,
            delay: 1e-3,
            lag: 0.0,
            timeout_ns: 3_000_000,
            within: DriveLimits { max_speed: Some(100.0), travel: Some((-1.0, 1.0)), max_power: None },
        };
        let signal = |node, what| Signal { node, what };
        let series = Series { label: "x".into(), slot: Slot(9), unit: Unit::parse("mm").unwrap(), boolean: false };
        Rig {
            name: "rtfs".into(),
            period_ns: 1_000_000,
            method: Method::Expo,
            steps: 2,
            buses: vec![Bus { name: "can0".into(), address: "sim:bench".into(), bit_rate: 1_000_000 }],
            nodes: vec![node("load", Kind::Cia402(drive)), node("shaft", Kind::Frames(vec![message]))],
            inputs: vec![Input { signal: signal(1, SignalKind::Field(0, 0)), slot: Slot(4), start: 0.5, needed: true }],
            outputs: vec![Output {
                signal: signal(0, SignalKind::Torque),
                slot: Slot(5),
                low: -1.0,
                high: f64::INFINITY,
                slew: 200.0,
                safe: 0.0,
            }],
            watchdog_ns: 5_000_000,
            overrun: Overrun::Hold(3),
            stops: vec![Stop { slot: Slot(6), condition: "x > 1 m".into(), why: "too far".into() }],
            record: vec![series.clone(), series],
            plots: vec![Curves { series: vec![0, 1], against: None }, Curves { series: vec![0], against: Some(1) }],
            predict: Some(0),
            needs_look: true,
            plant: Plant {
                applied: vec![(signal(0, SignalKind::Torque), Slot(3))],
                seen: vec![(signal(0, SignalKind::Position), Slot(7))],
                inertia: None,
            },
        }
    }

    #[test]
    fn a_rig_round_trips() {
        let bytes = rig().to_bytes();
        assert_eq!(Rig::from_bytes(&bytes), Ok(rig()));
        let stopping = Rig { overrun: Overrun::Stop, predict: None, ..rig() };
        assert_eq!(Rig::from_bytes(&stopping.to_bytes()), Ok(stopping));
    }

    #[test]
    fn a_truncated_rig_is_an_error() {
        let bytes = rig().to_bytes();
        for length in 0..bytes.len() {
            assert!(Rig::from_bytes(&bytes[..length]).is_err(), "{length} bytes");
        }
    }
}
