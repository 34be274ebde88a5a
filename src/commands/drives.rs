//! `fric drives`: the drives and devices of a rig, simulated, on a bus that other programs can reach.

use super::{End, chosen_rig, load, reported};
use crate::args::Drives as Args;
use crate::compile::{self, Options, Ready, Stopwatch};
use crate::project;
use crate::terminal::Terminal;
use abi::rig::Kind;
use runtime::can::address::Address;
use runtime::can::hub::Hub;
use runtime::can::sim::{SimBus, Simulation};
use runtime::can::slcan::Slcan;
use runtime::can::socketcand::Server;
use runtime::can::{self};
use runtime::canopen::eds;
use runtime::clock::Clock;
use runtime::drive::{Bench, attend, hooks};
use std::sync::atomic::{AtomicBool, Ordering};

/// Ctrl-C.
static STOP: AtomicBool = AtomicBool::new(false);

/// How soon Ctrl-C is heard, and changes of state are told, on a silent bus.
const LOOK_NS: u64 = 20_000_000;
/// Bit rate of a bus whose rig names none.
const BIT_RATE: u32 = 1_000_000;

pub fn drives(args: &Args, terminal: &mut Terminal) -> End {
    let Some(mut loaded) = load(&args.file, terminal, &mut Stopwatch::start("read")) else { return End::Failed };
    let name = match chosen_rig(&args.file, args.rig.as_deref(), &loaded) {
        Ok(name) => name,
        Err(why) => {
            terminal.error(&why);
            return End::Failed;
        }
    };
    let options = Options { changes: args.set.changes(), ..Options::default() };
    let ready = match compile::rig(&mut loaded, &project::Disk, &name, &options, &mut Vec::new()) {
        Ok(ready) => ready,
        Err(diagnostics) => {
            reported(&loaded, &diagnostics, terminal);
            return End::Failed;
        }
    };
    drop(loaded);
    let served = match open(args, &ready) {
        Ok(served) => served,
        Err((why, end)) => {
            terminal.error(&why);
            return end;
        }
    };
    let _ = ctrlc::set_handler(|| STOP.store(true, Ordering::Relaxed));
    serve(args, &ready, served, terminal);
    End::Fine
}

/// What runs: a simulated bus for each of the rig, joined with ways to the outside.
struct Served {
    world: Simulation,
    buses: Vec<SimBus>,
    hubs: Vec<Hub>,
    server: Option<Server>,
    bench: Bench,
    joined: Vec<String>,
}

fn open(args: &Args, ready: &Ready) -> Result<Served, (String, End)> {
    let rig = &ready.rig;
    let misused = |why: String| (why, End::Misused);
    let failed = |why: String| (why, End::Failed);
    let mut addresses: Vec<(&str, &str)> =
        rig.buses.iter().map(|bus| (bus.name.as_str(), bus.address.as_str())).collect();
    let doors = !args.pty.is_empty() || args.tcp.is_some();
    if doors && rig.buses.len() > 1 {
        return Err(misused("doors open to a rig's only bus; this one has several: use --bus for each".into()));
    }
    for (bus, address) in &args.bus {
        let Some(at) = addresses.iter().position(|(name, _)| name == bus) else {
            let names: Vec<&str> = addresses.iter().map(|(name, _)| *name).collect();
            return Err(misused(format!("the rig has no bus `{bus}`; it has {}", names.join(", "))));
        };
        addresses[at].1 = address;
    }
    let mut bench = Bench::new(rig, Some(ready.plant.clone()), args.seed).map_err(failed)?;
    for (name, path) in &args.eds {
        let at = rig.nodes.iter().position(|node| node.name == *name);
        let Some((at, Kind::Cia402(config))) = at.map(|at| (at, &rig.nodes[at].kind)) else {
            return Err(misused(format!("the rig has no drive `{name}`")));
        };
        let bytes = std::fs::read(path).map_err(|error| failed(format!("{path}: {error}")))?;
        let sheet = eds::read(&String::from_utf8_lossy(&bytes), config.node).map_err(|mistakes| {
            let all: Vec<String> = mistakes.iter().map(ToString::to_string).collect();
            failed(format!("{path} is no data sheet: {}", all.join("; ")))
        })?;
        let objects = bench.drive(at).expect("it is a drive").objects();
        // What the drive simulates it knows better.
        for entry in
            sheet.entries().iter().filter(|entry| objects.entry(entry.object).is_none()).cloned().collect::<Vec<_>>()
        {
            objects.add(entry);
        }
    }
    for text in &args.inject {
        bench.hook(hooks::read(text, rig).map_err(|why| misused(format!("--inject '{text}': {why}")))?);
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
        // A door replaces the address of the rig's text, not one that was asked for.
        let asked = args.bus.iter().any(|(bus, _)| bus == name);
        let inside = matches!(parsed, Address::Sim(_));
        if !inside && (asked || !doors) {
            let options = can::Options { bit_rate: Some(rate), ..can::Options::default() };
            let outside = can::open(&parsed, &options, &world, "drives");
            hub.join(address, outside.map_err(|why| failed(format!("bus `{name}`: {why}")))?);
            joined.push(format!("{name} on {address}"));
        } else if !doors {
            return Err(misused(format!(
                "nobody can hear these drives: `{address}` is inside this process; give --bus {name}=ADDRESS, --pty \
                 PATH or --tcp PORT, or run the rig with `fric hil --sim`"
            )));
        }
        buses.push(simulated);
        hubs.push(hub);
    }
    for path in &args.pty {
        let door = Slcan::door(Some(path), clock).map_err(|why| failed(why.to_string()))?;
        hubs[0].join(&path.display().to_string(), Box::new(door));
        joined.push(format!("{} on {}", addresses[0].0, path.display()));
    }
    let server = args.tcp.map(|port| Server::listen(port, false, clock)).transpose();
    let server = server.map_err(|why| failed(why.to_string()))?;
    joined.extend(server.iter().map(|server| format!("{} on TCP port {}", addresses[0].0, server.port())));
    Ok(Served { world, buses, hubs, server, bench, joined })
}

/// Lets them live until they are told to end, and tells how their states change.
fn serve(args: &Args, ready: &Ready, served: Served, terminal: &mut Terminal) {
    let Served { world, buses, mut hubs, mut server, bench, joined } = served;
    let rig = &ready.rig;
    let bench = attend(&world, &buses, rig, bench);
    let names: Vec<&str> = rig.nodes.iter().map(|node| node.name.as_str()).collect();
    terminal.report(&format!("simulated: {}; {}\n", names.join(", "), joined.join(", ")));
    let until_ns = args.duration.map_or(u64::MAX, |seconds| world.now_ns().saturating_add((seconds * 1e9) as u64));
    let also: Vec<i32> = server.iter().map(Server::descriptor).collect();
    let mut states = vec![None; rig.nodes.len()];
    let mut clients = 0;
    while !STOP.load(Ordering::Relaxed) && world.now_ns() < until_ns {
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
                if !args.quiet {
                    let seconds = world.now_ns() as f64 * 1e-9;
                    terminal.line(&format!("{seconds:8.3} s  {}: {nmt}, {state}", names[node]));
                }
            }
        }
        if !passed {
            let look_ns = until_ns.min(world.now_ns() + LOOK_NS);
            match hubs.as_mut_slice() {
                [one] => one.wait(&world, &also, look_ns),
                // Several at once: none of them may wait for another.
                _ => world.run_to(until_ns.min(world.now_ns() + LOOK_NS / 100)),
            }
        }
    }
}
