//! Serves the simulated drives and devices of a rig in real time, on buses that other programs can reach.
//!
//! In: a rig, the part of its system that the hardware replaces, doors. Out: frames at the doors, and messages about
//! state changes of the drives. Knows neither terminals nor files, except the links of pseudo-terminals.

use super::attend;
use crate::can;
use crate::can::address::Address;
use crate::can::bridge::Hub;
use crate::can::sim::{SimBus, Simulation};
use crate::can::slcan::Slcan;
use crate::can::socketcand::Server;
use crate::canopen::eds;
use crate::drive::fault_injection;
use crate::drive::simulated_plant::SimulatedBench;
use crate::realtime::clock::Clock;
use crate::realtime::threads::{self, Wishes};
use abi::Instance;
use abi::rig::{Kind, Rig};
use std::path::PathBuf;

/// Polling interval for the end and for state changes on a silent bus.
const LOOK_NS: u64 = 20_000_000;
/// Bit rate of a bus if the rig names none.
const BIT_RATE: u32 = 1_000_000;

/// Doors, and faults to inject.
#[derive(Clone, Debug, Default)]
pub struct Doors {
    /// Addresses of buses in place of the rig's: name and address.
    pub buses: Vec<(String, String)>,
    /// Pseudo-terminals that behave like an slcan adapter: links to them.
    pub pty: Vec<PathBuf>,
    /// A TCP port that behaves like socketcand; 0 for a free one.
    pub tcp: Option<u16>,
    /// Data sheets of drives, for objects that their simulation does not have.
    pub sheets: Vec<Sheet>,
    /// Faults, in the syntax of [`fault_injection::read`].
    pub inject: Vec<String>,
    /// Seed of all random numbers.
    pub seed: u64,
}

/// The data sheet (EDS) of a drive.
#[derive(Clone, Debug)]
pub struct Sheet {
    /// The drive's name in the rig.
    pub drive: String,
    /// Origin of the text, for messages.
    pub file: String,
    /// The text.
    pub text: String,
}

/// Reason why nothing is served.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Refused {
    /// The arguments are wrong.
    Misused(String),
    /// A bus or a port failed.
    Failed(String),
}

/// Priority under SCHED_FIFO; a rig's loop has 80.
const PRIORITY: i32 = 79;

/// A simulated bus for each bus of a rig, connected with the doors, and the drives on them.
pub struct Served {
    world: Simulation,
    buses: Vec<SimBus>,
    hubs: Vec<Hub>,
    server: Option<Server>,
    bench: SimulatedBench,
    joined: Vec<String>,
}

impl Served {
    /// Opens the doors. `plant`: the program of the part that hardware replaces, if it is simulated.
    ///
    /// # Errors
    /// Wrong arguments, or a bus or port that failed.
    pub fn open(rig: &Rig, plant: Option<Instance>, doors: &Doors) -> Result<Served, Refused> {
        let (misused, failed) = (Refused::Misused, Refused::Failed);
        let mut addresses: Vec<(&str, &str)> =
            rig.buses.iter().map(|bus| (bus.name.as_str(), bus.address.as_str())).collect();
        let opens = !doors.pty.is_empty() || doors.tcp.is_some();
        if opens && rig.buses.len() > 1 {
            return Err(misused("doors open to a rig's only bus; this one has several: use --bus for each".into()));
        }
        for (bus, address) in &doors.buses {
            let Some(at) = addresses.iter().position(|(name, _)| name == bus) else {
                let names: Vec<&str> = addresses.iter().map(|(name, _)| *name).collect();
                return Err(misused(format!("the rig has no bus `{bus}`; it has {}", names.join(", "))));
            };
            addresses[at].1 = address;
        }
        let mut bench = SimulatedBench::new(rig, plant, doors.seed).map_err(failed)?;
        for Sheet { drive, file, text } in &doors.sheets {
            let at = rig.nodes.iter().position(|node| node.name == *drive);
            let Some((at, Kind::Cia402(config))) = at.map(|at| (at, &rig.nodes[at].kind)) else {
                let all = rig.nodes.iter().filter(|node| matches!(node.kind, Kind::Cia402(_)));
                let all: Vec<&str> = all.map(|node| node.name.as_str()).collect();
                return Err(misused(format!("the rig has no drive `{drive}`; it has {}", all.join(", "))));
            };
            let sheet = eds::read(text, config.node).map_err(|mistakes| {
                let mut first: Vec<String> = mistakes.iter().take(3).map(ToString::to_string).collect();
                if mistakes.len() > first.len() {
                    first.push(format!("and {} more", mistakes.len() - first.len()));
                }
                failed(format!("{file} is no data sheet: {}", first.join("; ")))
            })?;
            let objects = bench.drive(at).expect("it is a drive").objects();
            // The simulation takes precedence for its own objects.
            for entry in sheet.entries() {
                if objects.entry(entry.object).is_none() {
                    objects.add(entry.clone());
                }
            }
        }
        for text in &doors.inject {
            let hook = fault_injection::read(text, rig).map_err(|why| misused(format!("--inject '{text}': {why}")))?;
            if matches!(hook.start, fault_injection::Start::OfRun(_)) {
                return Err(misused(format!(
                    "--inject '{text}': drives know no time of the model; give one since power-on"
                )));
            }
            bench.hook(hook);
        }
        let world = Simulation::real_time();
        let clock = world.monotonic().expect("this world's time is real");
        let (mut buses, mut hubs, mut joined) = (Vec::new(), Vec::new(), Vec::new());
        for (bus, (name, address)) in rig.buses.iter().zip(&addresses) {
            let rate = if bus.bit_rate == 0 { BIT_RATE } else { bus.bit_rate };
            let simulated = world.bus(name, rate);
            let mut hub = Hub::new();
            hub.join(name, Box::new(simulated.port("outside")));
            let parsed = address.parse::<Address>().map_err(misused)?;
            // An explicit door replaces the address of the rig's text, but not an address in the arguments.
            let asked = doors.buses.iter().any(|(bus, _)| bus == name);
            let inside = matches!(parsed, Address::Sim(_));
            if !inside && (asked || !opens) {
                let options = can::Options { bit_rate: Some(rate), ..can::Options::default() };
                let outside = can::open(&parsed, &options, &world, "drives");
                hub.join(address, outside.map_err(|why| failed(format!("bus `{name}`: {why}")))?);
                joined.push(format!("{name} on {address}"));
            } else if !opens {
                return Err(misused(format!(
                    "nobody can hear these drives: `{address}` is inside this process; give --bus {name}=ADDRESS, \
                     --pty PATH or --tcp PORT, or run the rig with --sim"
                )));
            }
            buses.push(simulated);
            hubs.push(hub);
        }
        for path in &doors.pty {
            let door = Slcan::door(Some(path), clock).map_err(|why| failed(why.to_string()))?;
            hubs[0].join(&path.display().to_string(), Box::new(door));
            joined.push(format!("{} on {}", addresses[0].0, path.display()));
        }
        let server = doors.tcp.map(|port| Server::listen(port, false, clock)).transpose();
        let server = server.map_err(|why| failed(why.to_string()))?;
        joined.extend(server.iter().map(|server| format!("{} on TCP port {}", addresses[0].0, server.port())));
        Ok(Served { world, buses, hubs, server, bench, joined })
    }

    /// Names of the drives and of their doors, as text.
    pub fn describe(&self, rig: &Rig) -> String {
        let names: Vec<&str> = rig.nodes.iter().map(|node| node.name.as_str()).collect();
        format!("simulated: {}; {}", names.join(", "), self.joined.join(", "))
    }

    /// Runs the drives for this time, s, or until `over`; reports their state changes to `told`.
    pub fn serve(self, rig: &Rig, duration: Option<f64>, over: &dyn Fn() -> bool, told: &mut dyn FnMut(&str)) {
        let Served { world, buses, mut hubs, mut server, bench, .. } = self;
        // A drive keeps its timing on a busy computer: if permitted, it runs at a priority just below that of a loop
        // beside it.
        let _real_time = threads::enter(&Wishes { priority: PRIORITY, core: None, memory: false, awake: false });
        let bench = attend(&world, &buses, rig, bench);
        let until_ns = duration.map_or(u64::MAX, |seconds| world.now_ns().saturating_add((seconds * 1e9) as u64));
        let also: Vec<i32> = server.iter().map(Server::descriptor).collect();
        let mut states = vec![None; rig.nodes.len()];
        let mut clients = 0;
        while !over() && world.now_ns() < until_ns {
            while let Some(connection) = server.as_mut().and_then(Server::accept) {
                clients += 1;
                hubs[0].admit(&format!("tcp{clients}"), Box::new(connection));
            }
            let mut passed = false;
            for hub in &mut hubs {
                passed |= hub.pass_on(|_, _| {});
            }
            for (node, last) in states.iter_mut().enumerate() {
                let state = bench.borrow_mut().drive(node).map(|drive| (drive.node().state(), drive.state()));
                if let Some((nmt, state)) = state.filter(|state| *last != Some(*state)) {
                    *last = Some((nmt, state));
                    let seconds = world.now_ns() as f64 * 1e-9;
                    told(&format!("{seconds:8.3} s  {}: {nmt}, {state}", rig.nodes[node].name));
                }
            }
            if !passed {
                let look_ns = until_ns.min(world.now_ns() + LOOK_NS);
                match hubs.as_mut_slice() {
                    [one] => one.wait(&world, &also, look_ns),
                    // With several buses none may wait for another.
                    _ => world.run_to(until_ns.min(world.now_ns() + LOOK_NS / 100)),
                }
            }
        }
    }
}
