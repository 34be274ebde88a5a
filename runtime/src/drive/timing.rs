//! When a command reaches a drive: what of its `delay` is not the drive's own.
//!
//! In: a rig. Out: times of its cycle, ns. The `delay` of a rig's text counts from the reading of the shaft, at SYNC, to
//! the first effect of the command that answers it: waiting for answers, computing, the way over the bus and what the
//! drive itself needs. So `delay`, not a clock, is what a dry run, a prediction and the look ahead go by.

use abi::rig::{Kind, Rig};

/// Bit rate of a bus where the rig names none.
const BIT_RATE: u64 = 1_000_000;
/// Longest frame of a control word and a torque, in bits with the gap behind it.
const COMMAND_BITS: u64 = 95;
/// A SYNC frame: the drives read the shaft at its end.
const SYNC_BITS: u64 = 47;

/// From the begin of a cycle to its computing: answers are waited for until then. All drives wait for the next SYNC: there
/// is time. Otherwise the answers of some drives at 1 Mbit/s and 1 kHz.
pub fn collect_ns(rig: &Rig) -> u64 {
    let at_sync = rig.nodes.iter().all(|node| match &node.kind {
        Kind::Cia402(drive) => !node.moves || drive.at_sync,
        Kind::Frames(_) => true,
    });
    rig.period_ns * if at_sync { 85 } else { 55 } / 100
}

/// From a reading to the arrival of the command that answers it at a node: drives are told in the order of the text.
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
