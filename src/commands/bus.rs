//! `fric bus`: bridges buses of any kind, opens doors to them, and prints their traffic.

use super::{End, load, reported};
use crate::args::Bus as Args;
use crate::compile::{self, Stopwatch};
use crate::quantity;
use crate::terminal::Terminal;
use abi::rig::{Kind, Message};
use runtime::can::address::Address;
use runtime::can::bridge::Hub;
use runtime::can::log::LoggedFrame;
use runtime::can::sim::Simulation;
use runtime::can::slcan::Slcan;
use runtime::can::socketcand::Server;
use runtime::can::{self, CannotOpen, Event, Filter, Frame, Options, Received, cob_ids};
use runtime::canopen::eds;
use runtime::drive::frames;
use runtime::realtime::clock::Clock;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

/// Set by Ctrl-C.
static STOP: AtomicBool = AtomicBool::new(false);

/// How often Ctrl-C is checked on a silent bus.
const LOOK_NS: u64 = 50_000_000;

pub fn bus(args: &Args, terminal: &mut Terminal) -> End {
    crate::interrupt::on_interrupt(|| STOP.store(true, Ordering::Relaxed));
    let mut known = Known::default();
    for path in &args.names {
        if let Err(end) = known.read(path, terminal) {
            return end;
        }
    }
    match run(args, &known, terminal) {
        Ok(()) => End::Fine,
        Err(cannot) => {
            terminal.error(&cannot.to_string());
            End::Failed
        }
    }
}

fn run(args: &Args, known: &Known, terminal: &mut Terminal) -> Result<(), CannotOpen> {
    let world = Simulation::real_time();
    let clock = world.monotonic().expect("this world's time is real");
    let options = Options { bit_rate: args.bit_rate, ..Options::default() };
    let mut hub = Hub::new();
    let mut listeners = Vec::new();
    for address in &args.addresses {
        let name = address.to_string();
        let name = name.strip_prefix("socketcan:").unwrap_or(&name);
        hub.join(name, can::open(address, &options, &world, name)?);
        if matches!(address, Address::Sim(_)) {
            // Frames that come through a door must be acknowledged, or they would be repeated for ever.
            let deaf = Options { filter: Filter::Only(Vec::new()), ..options.clone() };
            listeners.push(can::open(address, &deaf, &world, "listener")?);
        }
    }
    for path in &args.pty {
        let door = Slcan::door(Some(path), clock)?;
        hub.join(&path.display().to_string(), Box::new(door));
    }
    let mut server = args.tcp.map(|port| Server::listen(port, args.everywhere, clock)).transpose()?;
    let mut joined: Vec<String> = hub.members().iter().map(|member| member.name.clone()).collect();
    joined.extend(server.as_ref().map(|server| format!("TCP port {}", server.port())));
    terminal.report(&format!("joined: {}\n", joined.join(", ")));

    // Times in logs count from 1970, on the screen from the start.
    let day_ns = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |day| day.as_nanos() as u64);
    let origin_ns = day_ns.saturating_sub(clock.now_ns());
    let until_ns = args.duration.map_or(u64::MAX, |seconds| clock.now_ns().saturating_add((seconds * 1e9) as u64));
    let also: Vec<i32> = server.iter().map(Server::descriptor).collect();
    let (mut frames, mut clients) = (0u64, 0);
    let mut page = String::new();
    while !STOP.load(Ordering::Relaxed) && clock.now_ns() < until_ns {
        while let Some(connection) = server.as_mut().and_then(Server::accept) {
            clients += 1;
            hub.admit(&format!("tcp{clients}"), Box::new(connection));
        }
        page.clear();
        let passed = hub.pass_on(|from, received| {
            frames += u64::from(matches!(received, Received::Frame(..)));
            if args.log {
                log_line(&mut page, from, received, origin_ns);
            } else if !args.quiet {
                traffic_line(&mut page, from, received, known);
            }
        });
        if !page.is_empty() {
            terminal.print(&page);
        }
        if !passed {
            hub.wait(&world, &also, until_ns.min(clock.now_ns() + LOOK_NS));
        }
    }
    let lost: Vec<String> = hub
        .members()
        .iter()
        .filter(|member| member.lost > 0)
        .map(|member| format!(", {} did not take {}", member.name, member.lost))
        .collect();
    terminal.report(&format!("{frames} frames{}\n", lost.concat()));
    Ok(())
}

/// A frame in the format of candump, with its CANopen meaning.
fn traffic_line(page: &mut String, from: &str, received: &Received, known: &Known) {
    let seconds = |ns: u64| format!("({:03}.{:06})", ns / 1_000_000_000, ns / 1000 % 1_000_000);
    match received {
        Received::Frame(frame, at_ns) => {
            let id = if frame.is_extended() { format!("{:08X}", frame.id()) } else { format!("{:03X}", frame.id()) };
            let data: String = match frame.is_remote() {
                true => "remote request".into(),
                false => frame.data().iter().map(|byte| format!("{byte:02X} ")).collect(),
            };
            let name = known.name(frame);
            let line = format!("{}  {from}  {id:>8}  [{}]  {data:<24} {name}", seconds(*at_ns), frame.length());
            let _ = writeln!(page, "{}", line.trim_end());
        }
        Received::Event(event, at_ns) => {
            let _ = writeln!(page, "{}  {from}  {}", seconds(*at_ns), describe(*event));
        }
    }
}

/// The names that rigs and DBC files give to frames.
#[derive(Default)]
struct Known {
    /// By identifier, and whether it has 29 bits: the sender or receiver, and the message.
    messages: BTreeMap<(u32, bool), (String, Message)>,
    /// Names of drives by their node number.
    drives: BTreeMap<u32, String>,
    /// Names of objects in a data sheet, by index and sub-index as shown.
    objects: BTreeMap<String, String>,
}

impl Known {
    fn read(&mut self, path: &Path, terminal: &Terminal) -> Result<(), End> {
        let failed = |why: String| {
            terminal.error(&format!("{}: {why}", path.display()));
            End::Failed
        };
        if path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("dbc")) {
            let bytes = std::fs::read(path).map_err(|error| failed(error.to_string()))?;
            let messages = compile::dbc_messages(&String::from_utf8_lossy(&bytes)).map_err(failed)?;
            for message in messages {
                self.messages.insert((message.id, message.extended), (message.name.clone(), message));
            }
            return Ok(());
        }
        if path
            .extension()
            .is_some_and(|extension| ["eds", "dcf"].iter().any(|kind| extension.eq_ignore_ascii_case(kind)))
        {
            let bytes = std::fs::read(path).map_err(|error| failed(error.to_string()))?;
            let sheet = eds::read(&String::from_utf8_lossy(&bytes), 1);
            let sheet = sheet.map_err(|mistakes| failed(mistakes[0].to_string()))?;
            self.objects.extend(sheet.entries().iter().map(|entry| (entry.object.to_string(), entry.name.clone())));
            return Ok(());
        }
        let mut loaded = load(path, terminal, &mut Stopwatch::start("read")).ok_or(End::Failed)?;
        let rigs: Vec<String> = loaded.rigs().iter().map(|rig| rig.name.text.clone()).collect();
        if rigs.is_empty() {
            return Err(failed("it has no rig".into()));
        }
        for rig in rigs {
            let options = compile::Options::default();
            let ready = compile::rig(&mut loaded, &crate::disk::Disk, &rig, &options, &mut Vec::new());
            let ready = ready.map_err(|found| {
                reported(&loaded, &found, terminal);
                End::Failed
            })?;
            for node in ready.rig.nodes {
                match node.kind {
                    Kind::Cia402(drive) => _ = self.drives.insert(drive.node.into(), node.name),
                    Kind::Frames(messages) => {
                        for message in messages {
                            self.messages.insert((message.id, message.extended), (node.name.clone(), message));
                        }
                    }
                }
            }
        }
        Ok(())
    }

    /// The node and content of a frame: by rig and DBC file, else by CANopen.
    fn name(&self, frame: &Frame) -> String {
        if let Some((who, message)) = self.messages.get(&(frame.id(), frame.is_extended()))
            && !frame.is_remote()
        {
            let field = |(k, field): (usize, &abi::rig::Field)| {
                let si = frames::read(message, k, frame.data())?;
                Some(format!("{} = {}", field.name, quantity::show(si, &field.unit, 4)))
            };
            let values: Vec<String> = message.fields.iter().enumerate().filter_map(field).collect();
            return format!("{who}: {}", values.join(", "));
        }
        let mut name = cob_ids::canopen(frame).unwrap_or_default();
        let object = name.split(' ').find_map(|word| self.objects.get_key_value(word.trim_end_matches(',')));
        if let (Some((object, says)), true) = (object, name.starts_with("SDO")) {
            name = name.replace(object, &format!("{object} ({says})"));
        }
        match self.drives.get(&(frame.id() & 0x7F)).filter(|_| frame.id() >= 0x80) {
            Some(drive) => name.replace(&format!("node {}", frame.id() & 0x7F), drive),
            None => name,
        }
    }
}

fn log_line(page: &mut String, from: &str, received: &Received, origin_ns: u64) {
    if let Received::Frame(frame, at_ns) = received {
        // Readers of logs end a name at white space.
        let interface = from.replace(char::is_whitespace, "_");
        let _ = writeln!(page, "{}", LoggedFrame { time_ns: origin_ns + at_ns, interface, frame: *frame });
    }
}

fn describe(event: Event) -> String {
    match event {
        Event::Warning => "warning: more than 96 errors".into(),
        Event::Passive => "error passive: more than 127 errors".into(),
        Event::BusOff => "bus-off: it takes no part any more".into(),
        Event::Restarted => "restarted".into(),
        Event::NotAcknowledged => "nobody acknowledges: is anybody there, at this bit rate?".into(),
        Event::Lost(count) => format!("{count} frames lost"),
        Event::Error => "error on the bus".into(),
        Event::Down => "down: its other end is gone".into(),
    }
}
