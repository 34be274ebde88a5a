//! The other services: NMT, SYNC, heartbeat, node guarding, emergency; and the classification of frames.

use crate::can::Frame;
use std::fmt;

/// An NMT command.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[allow(missing_docs)]
pub enum Nmt {
    Start = 0x01,
    Stop = 0x02,
    PreOperational = 0x80,
    ResetNode = 0x81,
    ResetCommunication = 0x82,
}

impl Nmt {
    /// The frame of the command for a node; node 0 addresses all.
    pub fn frame(self, node: u8) -> Frame {
        Frame::new(0x000, &[self as u8, node])
    }

    fn of(byte: u8) -> Option<Nmt> {
        [Nmt::Start, Nmt::Stop, Nmt::PreOperational, Nmt::ResetNode, Nmt::ResetCommunication]
            .into_iter()
            .find(|command| *command as u8 == byte)
    }
}

/// NMT state of a node, as in its heartbeat.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
#[allow(missing_docs)]
pub enum NmtState {
    #[default]
    BootUp = 0x00,
    Stopped = 0x04,
    Operational = 0x05,
    PreOperational = 0x7F,
}

impl NmtState {
    /// The state in the byte of a heartbeat or guard answer, without the toggle bit.
    pub fn of(byte: u8) -> Option<NmtState> {
        [NmtState::BootUp, NmtState::Stopped, NmtState::Operational, NmtState::PreOperational]
            .into_iter()
            .find(|state| *state as u8 == byte & 0x7F)
    }

    /// The heartbeat of a node in this state.
    pub fn heartbeat(self, node: u8) -> Frame {
        Frame::new(0x700 + u32::from(node), &[self as u8])
    }
}

impl fmt::Display for NmtState {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            NmtState::BootUp => "booting",
            NmtState::Stopped => "stopped",
            NmtState::Operational => "operational",
            NmtState::PreOperational => "pre-operational",
        })
    }
}

/// The SYNC frame; with a counter from 1 if the network uses one.
pub fn sync(counter: Option<u8>) -> Frame {
    match counter {
        None => Frame::new(0x080, &[]),
        Some(count) => Frame::new(0x080, &[count]),
    }
}

/// Requests the state of a node: node guarding.
pub fn guard_request(node: u8) -> Frame {
    Frame::remote(0x700 + u32::from(node), 1)
}

/// Emergency message: a device reports an error, or its end (code 0).
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Emergency {
    /// Error code.
    pub code: u16,
    /// Error register, object 1001.
    pub register: u8,
    /// Five manufacturer-specific bytes.
    pub vendor: [u8; 5],
}

impl Emergency {
    /// The frame of a node.
    pub fn frame(&self, node: u8) -> Frame {
        let [low, high] = self.code.to_le_bytes();
        let [a, b, c, d, e] = self.vendor;
        Frame::new(0x080 + u32::from(node), &[low, high, self.register, a, b, c, d, e])
    }

    /// Meaning of the code.
    pub fn meaning(&self) -> &'static str {
        error_meaning(self.code)
    }
}

/// Meaning of an error code of an emergency or of object 603F: CiA 301 table 26, CiA 402-2 table 20.
pub fn error_meaning(code: u16) -> &'static str {
    match code {
        0x0000 => "no error",
        0x2310 => "continuous over-current",
        0x2320 => "short circuit or earth leakage",
        0x3110 => "mains over-voltage",
        0x3120 => "mains under-voltage",
        0x3210 => "DC link over-voltage",
        0x3220 => "DC link under-voltage",
        0x4210 => "device over-temperature",
        0x4310 => "drive over-temperature",
        0x5441 | 0x5442 => "safe torque off",
        0x7121 => "motor blocked",
        0x7300..=0x73FF => "sensor fault",
        0x7500 => "communication",
        0x8110 => "CAN overrun: objects lost",
        0x8120 => "CAN in error passive mode",
        0x8130 => "life guard or heartbeat error",
        0x8140 => "recovered from bus-off",
        0x8150 => "identifier collision",
        0x8210 => "PDO not processed: length error",
        0x8220 => "PDO length exceeded",
        0x8240 => "unexpected SYNC length",
        0x8250 => "RPDO time-out",
        0x8400 => "velocity speed control",
        0x8500 => "position control",
        0x8611 => "following error",
        _ => match code >> 8 {
            0x10 => "generic error",
            0x20..=0x2F => "current",
            0x30..=0x3F => "voltage",
            0x40..=0x4F => "temperature",
            0x50..=0x5F => "device hardware",
            0x60..=0x6F => "device software",
            0x70..=0x7F => "additional modules",
            0x80..=0x8F => "monitoring",
            0x90..=0x9F => "external error",
            0xF0..=0xFE => "additional functions",
            0xFF => "of the maker",
            _ => "reserved",
        },
    }
}

/// Kind of a frame in the predefined connection set.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Service {
    /// NMT: command, node (0: all).
    Nmt(Option<Nmt>, u8),
    /// SYNC, with its counter if it has one.
    Sync(Option<u8>),
    /// Emergency of a node.
    Emergency(u8, Emergency),
    /// Process data from a node: node, number from 1.
    Tpdo(u8, u8),
    /// Process data to a node: node, number from 1.
    Rpdo(u8, u8),
    /// Answer of a node's SDO server.
    SdoAnswer(u8),
    /// Request to a node's SDO server.
    SdoRequest(u8),
    /// Heartbeat or guard answer of a node: state, toggle bit.
    Heartbeat(u8, Option<NmtState>, bool),
    /// Request for the state of a node.
    GuardRequest(u8),
    /// Timestamp, and all other frames outside of the set.
    Other,
}

impl Service {
    /// Classifies a frame.
    pub fn of(frame: &Frame) -> Service {
        if frame.is_extended() {
            return Service::Other;
        }
        let (node, data) = ((frame.id() & 0x7F) as u8, frame.data());
        match (frame.id() & 0x780, node) {
            (0x700, 1..) if frame.is_remote() => Service::GuardRequest(node),
            _ if frame.is_remote() => Service::Other,
            (0x000, 0) => match *data {
                [command, node] => Service::Nmt(Nmt::of(command), node),
                _ => Service::Other,
            },
            (0x080, 0) => Service::Sync(data.first().copied()),
            (0x080, _) => match *data {
                [low, high, register, ref vendor @ ..] => {
                    let mut emergency = Emergency { code: u16::from_le_bytes([low, high]), register, vendor: [0; 5] };
                    emergency.vendor[..vendor.len()].copy_from_slice(vendor);
                    Service::Emergency(node, emergency)
                }
                _ => Service::Other,
            },
            (0x180 | 0x280 | 0x380 | 0x480, 1..) => Service::Tpdo(node, ((frame.id() >> 8) & 7) as u8),
            (0x200 | 0x300 | 0x400 | 0x500, 1..) => Service::Rpdo(node, ((frame.id() >> 8) & 7) as u8 - 1),
            (0x580, 1..) => Service::SdoAnswer(node),
            (0x600, 1..) => Service::SdoRequest(node),
            (0x700, 1..) => match data.first() {
                Some(&byte) => Service::Heartbeat(node, NmtState::of(byte), byte & 0x80 != 0),
                None => Service::Other,
            },
            _ => Service::Other,
        }
    }
}

impl fmt::Display for Service {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Service::Nmt(command, node) => {
                let command = match command {
                    Some(Nmt::Start) => "start",
                    Some(Nmt::Stop) => "stop",
                    Some(Nmt::PreOperational) => "pre-operational",
                    Some(Nmt::ResetNode) => "reset node",
                    Some(Nmt::ResetCommunication) => "reset communication",
                    None => "unknown command",
                };
                match node {
                    0 => write!(f, "NMT {command}, all nodes"),
                    node => write!(f, "NMT {command}, node {node}"),
                }
            }
            Service::Sync(None) => write!(f, "SYNC"),
            Service::Sync(Some(count)) => write!(f, "SYNC {count}"),
            Service::Emergency(node, emergency) => {
                write!(f, "EMCY of node {node}: 0x{:04X} {}", emergency.code, emergency.meaning())
            }
            Service::Tpdo(node, number) => write!(f, "TPDO{number} of node {node}"),
            Service::Rpdo(node, number) => write!(f, "RPDO{number} to node {node}"),
            Service::SdoAnswer(node) => write!(f, "SDO answer of node {node}"),
            Service::SdoRequest(node) => write!(f, "SDO request to node {node}"),
            Service::Heartbeat(node, Some(state), _) => write!(f, "node {node} is {state}"),
            Service::Heartbeat(node, None, _) => write!(f, "heartbeat of node {node}"),
            Service::GuardRequest(node) => write!(f, "guard request to node {node}"),
            Service::Other => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_identifier_has_its_service() {
        for node in [1u8, 3, 127] {
            let id = u32::from(node);
            for (base, service) in [
                (0x180, Service::Tpdo(node, 1)),
                (0x280, Service::Tpdo(node, 2)),
                (0x380, Service::Tpdo(node, 3)),
                (0x480, Service::Tpdo(node, 4)),
                (0x200, Service::Rpdo(node, 1)),
                (0x300, Service::Rpdo(node, 2)),
                (0x400, Service::Rpdo(node, 3)),
                (0x500, Service::Rpdo(node, 4)),
                (0x580, Service::SdoAnswer(node)),
                (0x600, Service::SdoRequest(node)),
            ] {
                assert_eq!(Service::of(&Frame::new(base + id, &[0; 8])), service);
            }
            let emergency = Emergency { code: 0x8130, register: 0x11, vendor: [1, 2, 3, 4, 5] };
            assert_eq!(Service::of(&emergency.frame(node)), Service::Emergency(node, emergency));
            for state in [NmtState::BootUp, NmtState::Stopped, NmtState::Operational, NmtState::PreOperational] {
                assert_eq!(Service::of(&state.heartbeat(node)), Service::Heartbeat(node, Some(state), false));
            }
            assert_eq!(Service::of(&guard_request(node)), Service::GuardRequest(node));
            assert_eq!(
                Service::of(&Nmt::ResetCommunication.frame(node)),
                Service::Nmt(Some(Nmt::ResetCommunication), node)
            );
        }
        assert_eq!(Service::of(&sync(None)), Service::Sync(None));
        assert_eq!(Service::of(&sync(Some(240))), Service::Sync(Some(240)));
        assert_eq!(Service::of(&Frame::extended(0x181, &[])), Service::Other);
        assert_eq!(Service::of(&Frame::new(0x100, &[1])), Service::Other, "time stamp");
        assert_eq!(Service::of(&Frame::new(0x083, &[1])), Service::Other, "an emergency has at least 3 bytes");
        assert_eq!(Service::of(&Frame::remote(0x183, 8)), Service::Other);
    }

    #[test]
    fn services_have_a_text() {
        assert_eq!(Service::Nmt(Some(Nmt::Start), 0).to_string(), "NMT start, all nodes");
        let emergency = Emergency { code: 0x8130, register: 0x11, vendor: [0; 5] };
        assert_eq!(
            Service::Emergency(4, emergency).to_string(),
            "EMCY of node 4: 0x8130 life guard or heartbeat error"
        );
        assert_eq!(error_meaning(0x3299), "voltage");
        assert_eq!(error_meaning(0xFF12), "of the maker");
    }
}
