//! `fric doctor`: what this machine and its buses lack for a rig, with a command to fix each.

use super::{End, load, reported};
use crate::args::{Doctor as Args, LookedAt};
use crate::compile::{self, Options, Stopwatch};
use crate::terminal::{Style, Terminal};
use runtime::can::address::Address;
use runtime::can::sim::Simulation;
use runtime::can::{self, Filter, Received, State, cob_ids, socketcan};
use runtime::realtime::clock::Clock;
use runtime::realtime::host_check::{Finding, Host, Verdict};
use std::path::Path;

/// How long a bus is observed for another master.
const LISTEN_NS: u64 = 1_000_000_000;

pub fn doctor(args: &Args, terminal: &mut Terminal) -> End {
    let host = Host::default();
    let mut found = host.findings();
    let mut buses: Vec<(Address, Option<u32>)> = Vec::new();
    for target in &args.targets {
        match target {
            LookedAt::Bus(address) => buses.push((address.clone(), args.bit_rate)),
            LookedAt::Rigs(path) => match of_rigs(path, terminal) {
                Ok(more) => buses.extend(more),
                Err(end) => return end,
            },
        }
    }
    for (address, bit_rate) in &buses {
        if let Address::SocketCan(name) = address {
            found.extend(host.interrupt(name, args.priority));
            let of_it = interface(name, *bit_rate);
            let forbids = of_it.iter().any(|finding| matches!(finding.verdict, Verdict::Forbids(_)));
            found.extend(of_it);
            // A bus that cannot be opened has been reported.
            if forbids {
                continue;
            }
        }
        // A simulated bus in this process has no other participants.
        if !matches!(address, Address::Sim(_)) {
            found.push(traffic(address, *bit_rate));
        }
    }
    let widest = found.iter().map(|finding| finding.topic.chars().count()).max().unwrap_or(0);
    let widest_says = found.iter().map(|finding| finding.says.chars().count()).max().unwrap_or(0).min(60);
    for finding in &found {
        let verdict = match &finding.verdict {
            Verdict::Good => terminal.styled(Style::Good, "ok"),
            Verdict::Poor => "as it is".into(),
            Verdict::Mend(line) => format!("mend: {line}"),
            Verdict::Forbids(line) => format!("{} mend: {line}", terminal.styled(Style::Bad, "forbids the rig;")),
        };
        terminal.line(&format!("{:<widest$}  {:<widest_says$}  {verdict}", finding.topic, finding.says));
    }
    let forbidden = found.iter().any(|finding| matches!(finding.verdict, Verdict::Forbids(_)));
    if forbidden { End::Failed } else { End::Fine }
}

/// The buses of all rigs in a text; reports problems in it.
fn of_rigs(path: &Path, terminal: &Terminal) -> Result<Vec<(Address, Option<u32>)>, End> {
    let mut loaded = load(path, terminal, &mut Stopwatch::start("read")).ok_or(End::Failed)?;
    let rigs: Vec<String> = loaded.rigs().iter().map(|rig| rig.name.text.clone()).collect();
    if rigs.is_empty() {
        terminal.error(&format!("{} has no rig", path.display()));
        return Err(End::Failed);
    }
    let mut buses = Vec::new();
    for rig in rigs {
        let ready = compile::rig(&mut loaded, &crate::disk::Disk, &rig, &Options::default(), &mut Vec::new());
        let ready = ready.map_err(|diagnostics| {
            reported(&loaded, &diagnostics, terminal);
            End::Failed
        })?;
        for bus in ready.rig.buses {
            let address: Address = bus.address.parse().map_err(|why: String| {
                terminal.error(&format!("bus `{}` of rig `{rig}`: {why}", bus.name));
                End::Failed
            })?;
            let known = (address, Some(bus.bit_rate).filter(|&bit_rate| bit_rate > 0));
            if !buses.contains(&known) {
                buses.push(known);
            }
        }
    }
    Ok(buses)
}

/// What the kernel reports about an interface.
fn interface(name: &str, wanted: Option<u32>) -> Vec<Finding> {
    let up = format!("ip link set {name} up type can bitrate {} restart-ms 0", wanted.unwrap_or(1_000_000));
    let found = match socketcan::inspect(name) {
        Ok(found) => found,
        Err(reason) => {
            let mend = format!("modprobe its driver, or for a virtual one: ip link add dev {name} type vcan");
            return vec![Finding::new(name, reason, Verdict::Forbids(mend))];
        }
    };
    let again = format!("ip link set {name} down && {up}");
    let mut all = Vec::new();
    let rate = found.bit_rate.map_or("virtual".into(), |rate| format!("{rate} bit/s"));
    all.push(match (found.up, found.state) {
        (false, _) => Finding::new(name, "down", Verdict::Forbids(up)),
        (true, Some(State::BusOff | State::Down)) => {
            Finding::new(name, format!("{rate}, bus-off"), Verdict::Forbids(again))
        }
        (true, Some(State::Passive)) => {
            let errors = found.errors.unwrap_or_default();
            let says = format!("{rate}, error passive: {} sending, {} receiving", errors.0, errors.1);
            Finding::new(name, says, Verdict::Forbids("look at cable, termination and bit rate of all nodes".into()))
        }
        (true, _) if wanted.is_some() && found.bit_rate.is_some() && found.bit_rate != wanted => {
            let says = format!("{rate}, and {} bit/s are asked for", wanted.unwrap_or_default());
            Finding::new(name, says, Verdict::Forbids(again))
        }
        (true, state) => {
            let active = if state == Some(State::Active) { ", active" } else { "" };
            Finding::new(name, format!("{rate}{active}"), Verdict::Good)
        }
    });
    if let Some(restart_ms) = found.restart_ms.filter(|&restart_ms| restart_ms > 0) {
        let mend = Verdict::Mend(format!("ip link set {name} type can restart-ms 0"));
        all.push(Finding::new(name, format!("comes back from bus-off by itself after {restart_ms} ms"), mend));
    }
    if let Some(queue) = found.queue.filter(|&queue| queue > 10) {
        let mend = Verdict::Mend(format!("ip link set {name} txqueuelen 10"));
        all.push(Finding::new(name, format!("queues {queue} frames, which hides a bus that takes none"), mend));
    }
    all
}

/// Whether there is another master on the bus: SYNC, NMT, requests or heartbeats before we have sent anything.
fn traffic(address: &Address, bit_rate: Option<u32>) -> Finding {
    let topic = address.to_string();
    let world = Simulation::real_time();
    let ours = [0x000, 0x080].into_iter().chain(0x601..=0x67F).chain(0x200..0x280).collect();
    let options = can::Options { bit_rate, filter: Filter::Only(ours), listen_only: true };
    let mut bus = match can::open(address, &options, &world, "doctor") {
        Ok(bus) => bus,
        Err(cannot) => {
            let mend = cannot.remedy.unwrap_or_else(|| "see docs/bus.md".into());
            return Finding::new(&topic, cannot.reason, Verdict::Forbids(mend));
        }
    };
    let until_ns = world.now_ns() + LISTEN_NS;
    while bus.wait(until_ns) {
        while let Some(received) = bus.receive() {
            if let Received::Frame(frame, _) = received {
                let what = cob_ids::canopen(&frame).unwrap_or_else(|| frame.to_string());
                let mend = Verdict::Forbids("stop the other master".into());
                return Finding::new(&topic, format!("somebody else commands: {what}"), mend);
            }
        }
    }
    Finding::new(&topic, "no other master within 1 s", Verdict::Good)
}
