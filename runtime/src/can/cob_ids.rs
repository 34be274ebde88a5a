//! Meaning of frames in CANopen, as short texts for people who watch traffic.
//!
//! In: a frame. Out: `TPDO1 of node 1`, `SDO of node 5: read 6041:00`, or nothing for frames that CANopen does not
//! define. Knows no object dictionary and no state of any node. Source: CiA 301.

use super::Frame;

/// Meaning of a frame in CANopen, if there is one.
pub fn canopen(frame: &Frame) -> Option<String> {
    if frame.is_extended() {
        return None;
    }
    let (id, data) = (frame.id(), frame.data());
    let node = id & 0x7F;
    let whole = |index: usize| u16::from_le_bytes([data[index], data[index + 1]]);
    match (id & !0x7F, node) {
        (0x000, 0) => {
            let [command, target] = *data else { return None };
            let command = match command {
                0x01 => "start",
                0x02 => "stop",
                0x80 => "to pre-operational",
                0x81 => "reset node",
                0x82 => "reset communication",
                _ => return None,
            };
            Some(if target == 0 { format!("NMT: {command}, all") } else { format!("NMT: {command}, node {target}") })
        }
        (0x080, 0) => Some("SYNC".into()),
        (0x080, _) if data.len() == 8 => match whole(0) {
            0 => Some(format!("EMCY of node {node}: cleared")),
            code => Some(format!("EMCY of node {node}: {code:04X}, error register {:02X}", data[2])),
        },
        (0x180 | 0x280 | 0x380 | 0x480, 1..) => Some(format!("TPDO{} of node {node}", (id - 0x80) >> 8)),
        (0x200 | 0x300 | 0x400 | 0x500, 1..) => Some(format!("RPDO{} of node {node}", (id - 0x100) >> 8)),
        (0x580 | 0x600, 1..) if data.len() == 8 => {
            let object = || format!("{:04X}:{:02X}", whole(1), data[3]);
            let asked = id & !0x7F == 0x600;
            let what = match (asked, data[0] >> 5) {
                (_, 4) => {
                    let code = u32::from_le_bytes([data[4], data[5], data[6], data[7]]);
                    format!("abort {}, {code:08X}", object())
                }
                (true, 2) => format!("read {}", object()),
                (true, 1) => format!("write {}", object()),
                (false, 2) => format!("{} read", object()),
                (false, 3) => format!("{} written", object()),
                _ => "segment".into(),
            };
            Some(format!("SDO of node {node}: {what}"))
        }
        (0x700, 1..) if frame.is_remote() => Some(format!("guard request to node {node}")),
        (0x700, 1..) => {
            let [state] = *data else { return None };
            let state = match state & 0x7F {
                0x00 => "boot-up",
                0x04 => "stopped",
                0x05 => "operational",
                0x7F => "pre-operational",
                _ => return None,
            };
            Some(format!("heartbeat of node {node}: {state}"))
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_have_names() {
        for (frame, name) in [
            (Frame::new(0x000, &[1, 0]), "NMT: start, all"),
            (Frame::new(0x000, &[0x82, 5]), "NMT: reset communication, node 5"),
            (Frame::new(0x080, &[]), "SYNC"),
            (Frame::new(0x085, &[0x10, 0x23, 2, 0, 0, 0, 0, 0]), "EMCY of node 5: 2310, error register 02"),
            (Frame::new(0x085, &[0; 8]), "EMCY of node 5: cleared"),
            (Frame::new(0x181, &[]), "TPDO1 of node 1"),
            (Frame::new(0x4FF, &[]), "TPDO4 of node 127"),
            (Frame::new(0x201, &[]), "RPDO1 of node 1"),
            (Frame::new(0x505, &[]), "RPDO4 of node 5"),
            (Frame::new(0x605, &[0x40, 0x41, 0x60, 0, 0, 0, 0, 0]), "SDO of node 5: read 6041:00"),
            (Frame::new(0x605, &[0x2B, 0x40, 0x60, 0, 6, 0, 0, 0]), "SDO of node 5: write 6040:00"),
            (Frame::new(0x585, &[0x4B, 0x41, 0x60, 0, 6, 0, 0, 0]), "SDO of node 5: 6041:00 read"),
            (Frame::new(0x585, &[0x60, 0x40, 0x60, 0, 0, 0, 0, 0]), "SDO of node 5: 6040:00 written"),
            (Frame::new(0x585, &[0x80, 0x40, 0x60, 1, 0x11, 0, 9, 6]), "SDO of node 5: abort 6040:01, 06090011"),
            (Frame::new(0x701, &[5]), "heartbeat of node 1: operational"),
            (Frame::new(0x701, &[0x85]), "heartbeat of node 1: operational"),
            (Frame::remote(0x701, 1), "guard request to node 1"),
        ] {
            assert_eq!(canopen(&frame).as_deref(), Some(name), "{frame}");
        }
    }

    #[test]
    fn frames_outside_of_canopen_have_no_name() {
        for frame in [
            Frame::extended(0x181, &[]),
            Frame::new(0x000, &[]),
            Frame::new(0x000, &[1]),
            Frame::new(0x605, &[0x40]),
            Frame::new(0x085, &[1]),
            Frame::new(0x701, &[]),
            Frame::new(0x7E5, &[0; 8]),
            Frame::new(0x123, &[0; 8]),
        ] {
            assert_eq!(canopen(&frame), None, "{frame}");
        }
    }
}
