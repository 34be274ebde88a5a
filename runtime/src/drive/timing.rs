//! Timing of commands: the share of a drive's `delay` that is not the drive's own.
//!
//! In: a rig. Out: times of its cycle, ns. The `delay` of a rig's text counts from the reading of the shaft, at SYNC,
//! to the first effect of the command that answers it: waiting for answers, computation, transfer on the bus, and the
//! drive's own delay. A SIL run, the stability prediction and the predictor therefore use `delay` and no clock.

use abi::rig::{Kind, Rig};

/// Bit rate of a bus if the rig names none.
const BIT_RATE: u64 = 1_000_000;
/// Longest frame with a control word and a torque, in bits with the interframe space.
const COMMAND_BITS: u64 = 95;
/// A SYNC frame, in bits: the drives read the shaft at its end.
const SYNC_BITS: u64 = 47;

/// Time from the begin of a cycle to its computation, in which answers are awaited. If all drives act on the next SYNC,
/// it is most of the period. Otherwise it suffices for the answers of some drives at 1 Mbit/s and 1 kHz.
pub fn collect_ns(rig: &Rig) -> u64 {
    let at_sync = rig.nodes.iter().all(|node| match &node.kind {
        Kind::Cia402(drive) => !node.moves || drive.at_sync,
        Kind::Frames(_) => true,
    });
    rig.period_ns * if at_sync { 85 } else { 55 } / 100
}

/// Time from a reading to the arrival of the command that answers it at a node: commands are sent in the order of the
/// text.
pub fn transit_ns(rig: &Rig, node: usize) -> u64 {
    let bus = rig.nodes[node].bus;
    let speaks = |node: &&abi::rig::Node| node.bus == bus && node.moves && matches!(node.kind, Kind::Cia402(_));
    let before = rig.nodes[..=node].iter().filter(speaks).count() as u64;
    let rate = match rig.buses[bus].bit_rate {
        0 => BIT_RATE,
        rate => rate.into(),
    };
    (collect_ns(rig) + before * COMMAND_BITS * 1_000_000_000 / rate).saturating_sub(SYNC_BITS * 1_000_000_000 / rate)
}
