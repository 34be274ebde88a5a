//! Interfaces of a real kernel: the bus contract, states, errors, and the information about an interface. Needs a
//! kernel with CAN and the right to create interfaces: `runner` provides both.

mod contract;
mod rig;

use abi::rig::Overrun;
use contract::Pair;
use runtime::can::socketcan::{self, SocketCan};
use runtime::can::{Bus, Event, Frame, Options, Received, Refused, State};
use runtime::hil::cycle::{End, Hil, Options as HilOptions};
use runtime::realtime::clock::{Clock, Monotonic};
use runtime::safety::Cause;
use std::process::Command;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};

const RATE: u32 = 1_000_000;

/// There are two cards, and many tests.
static CARDS: Mutex<()> = Mutex::new(());

/// A new virtual interface for each pair.
fn fresh() -> String {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let name = format!("vcan{}", NEXT.fetch_add(1, Ordering::Relaxed));
    socketcan::make_virtual(&name).expect("the kernel has vcan");
    name
}

fn open(name: &str) -> SocketCan {
    SocketCan::open(name, &Options::default(), Monotonic::new()).expect("it is up")
}

/// The cards of the virtual machine of `tests/can`, for one test at a time.
///
/// # Panics
/// On another machine: what cannot run must not pass.
fn cards() -> std::sync::MutexGuard<'static, ()> {
    let guest = std::env::var("GUEST").is_ok();
    assert!(guest, "needs two CAN cards: without FRIC_CAN=host these tests run in the guest that has them");
    CARDS.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

#[test]
fn a_virtual_interface_keeps_the_contract() {
    contract::check("vcan", &|options| {
        let (name, clock) = (fresh(), Monotonic::new());
        let near = SocketCan::open(&name, options, clock).expect("it is up");
        let far = SocketCan::open(&name, &Options::default(), clock).expect("it is up");
        let part = move |_| socketcan::take_down(&name).expect("we may");
        Pair {
            near: Box::new(near),
            far: Box::new(far),
            now_ns: Box::new(move || clock.now_ns()),
            part: Box::new(part),
        }
    });
}

#[test]
fn two_cards_keep_the_contract() {
    let _cards = cards();
    contract::check("SJA1000", &|options| {
        for name in ["can0", "can1"] {
            // Down first: a bit rate can be set only before an interface is up.
            socketcan::take_down(name).expect("we may");
            socketcan::take_up(name, Some(RATE)).expect("the driver is loaded");
        }
        let clock = Monotonic::new();
        let near = SocketCan::open("can0", options, clock).expect("it is up");
        let far = SocketCan::open("can1", &Options::default(), clock).expect("it is up");
        let part = |_| socketcan::take_down("can0").expect("we may");
        Pair {
            near: Box::new(near),
            far: Box::new(far),
            now_ns: Box::new(move || clock.now_ns()),
            part: Box::new(part),
        }
    });
}

#[test]
fn an_interface_is_compared_and_never_set() {
    let clock = Monotonic::new();
    let refused = |name: &str, rate| {
        let options = Options { bit_rate: Some(rate), ..Options::default() };
        SocketCan::open(name, &options, clock).err().expect("refused").to_string()
    };
    assert!(refused("can77", RATE).contains("socketcan:can77: there is no interface can77"));
    assert!(refused("can77", RATE).contains("mend: "));
    let name = fresh();
    assert_eq!(socketcan::inspect(&name).map(|interface| (interface.up, interface.bit_rate)), Ok((true, None)));
    socketcan::take_down(&name).expect("we may");
    assert!(refused(&name, RATE).contains(&format!("it is down\n  mend: ip link set {name} up")));

    let _cards = cards();
    socketcan::take_down("can0").expect("we may");
    socketcan::take_up("can0", Some(500_000)).expect("the driver is loaded");
    let said = refused("can0", RATE);
    assert!(said.contains("it runs at 500000 bit/s, and 1000000 bit/s are asked for"), "{said}");
    assert!(said.contains("mend: ip link set can0 down && ip link set can0 up type can bitrate 1000000"), "{said}");
    let interface = socketcan::inspect("can0").expect("it is there");
    assert_eq!(interface.bit_rate, Some(500_000), "looked at, not set");
    assert_eq!((interface.state, interface.restart_ms, interface.queue), (Some(State::Active), Some(0), Some(10)));
}

/// Puts an error frame on a virtual bus, as a driver would.
fn inject(name: &str, class: u32, data: [u8; 8]) {
    let index = {
        let name = std::ffi::CString::new(name).expect("no zero in it");
        // SAFETY: the name ends in zero and outlives the call.
        unsafe { libc::if_nametoindex(name.as_ptr()) }
    };
    // SAFETY: takes no pointers.
    let fd = unsafe { libc::socket(libc::PF_CAN, libc::SOCK_RAW, libc::CAN_RAW) };
    // SAFETY: all bytes 0 is a valid address; its family and interface are set below.
    let mut address: libc::sockaddr_can = unsafe { std::mem::zeroed() };
    address.can_family = libc::AF_CAN as u16;
    address.can_ifindex = index as i32;
    let mut bytes = [0u8; 16];
    bytes[..4].copy_from_slice(&(class | libc::CAN_ERR_FLAG).to_ne_bytes());
    bytes[4] = 8;
    bytes[8..].copy_from_slice(&data);
    // SAFETY: address and bytes are valid for their lengths and outlive the calls; the descriptor is closed once.
    let written = unsafe {
        let length = size_of_val(&address) as libc::socklen_t;
        assert_eq!(libc::bind(fd, (&raw const address).cast(), length), 0);
        let written = libc::write(fd, bytes.as_ptr().cast(), bytes.len());
        libc::close(fd);
        written
    };
    assert_eq!(written, 16);
}

#[test]
fn error_frames_are_events_and_never_frames() {
    let name = fresh();
    let mut bus = open(&name);
    let mut say = |class: u32, data: [u8; 8]| {
        inject(&name, class, data);
        let got = bus.receive();
        let Some(Received::Event(event, _)) = got else { panic!("{class:#x} {data:?} gives {got:?}") };
        (event, bus.health())
    };
    let controller = |flags: u8| [0, flags, 0, 0, 0, 0, 0, 0];
    assert_eq!(say(libc::CAN_ERR_CRTL, controller(0x0C)).0, Event::Warning);
    let (event, health) = say(libc::CAN_ERR_CRTL | 0x200, [0, 0x30, 0, 0, 0, 0, 130, 140]);
    assert_eq!((event, health.state), (Event::Passive, State::Passive));
    assert_eq!((health.transmit_errors, health.receive_errors), (130, 140));
    assert_eq!(say(libc::CAN_ERR_ACK, [0; 8]).0, Event::NotAcknowledged);
    assert_eq!(say(libc::CAN_ERR_PROT, [0; 8]).0, Event::Error);
    let (event, health) = say(libc::CAN_ERR_CRTL, controller(0x01));
    assert_eq!((event, health.lost), (Event::Lost(1), 1));
    let (event, health) = say(libc::CAN_ERR_BUSOFF, [0; 8]);
    assert_eq!((event, health.state), (Event::BusOff, State::BusOff));
    let (event, health) = say(libc::CAN_ERR_RESTARTED, [0; 8]);
    assert_eq!((event, health.state, health.lost), (Event::Restarted, State::Active, 1));
}

#[test]
fn an_interface_that_comes_back_works_again() {
    let name = fresh();
    let (mut near, mut far) = (open(&name), open(&name));
    socketcan::take_down(&name).expect("we may");
    assert!(matches!(near.receive(), Some(Received::Event(Event::Down, _))));
    assert_eq!(near.receive(), None, "told once");
    assert_eq!(near.send(Frame::new(1, &[])), Err(Refused::Down));
    socketcan::take_up(&name, None).expect("we may");
    far.send(Frame::new(1, &[])).expect("it is up");
    assert!(matches!(near.receive(), Some(Received::Frame(..))));
    assert_eq!(near.health().state, State::Active);
}

/// A time stamp is the kernel's: the age of a frame, not the time at which it is read.
#[test]
fn frames_are_stamped_when_they_come() {
    let (name, clock) = (fresh(), Monotonic::new());
    let mut near = SocketCan::open(&name, &Options::default(), clock).expect("it is up");
    let mut far = open(&name);
    let before_ns = clock.now_ns();
    far.send(Frame::new(1, &[])).expect("it is up");
    let after_ns = clock.now_ns();
    clock.sleep_until(after_ns + 50_000_000);
    let Some(Received::Frame(_, stamp_ns)) = near.receive() else { panic!("no frame came") };
    assert!((before_ns..=after_ns + 1_000_000).contains(&stamp_ns), "{before_ns} {stamp_ns} {after_ns}");
}

#[test]
fn prepared_frames_arrive() {
    let name = fresh();
    let (near, mut far) = (open(&name), open(&name));
    let stop = Frame::new(0x201, &[2, 0, 0, 0]);
    let prepared = near.prepare(stop).expect("an interface can");
    assert!(std::thread::spawn(move || prepared.send()).join().expect("it ends"));
    assert!(matches!(far.receive(), Some(Received::Frame(frame, _)) if frame == stop));
}

/// Frames faster than they can be read, through two cards. Every missing frame has been reported.
#[test]
fn a_flood_is_read_or_its_loss_is_reported() {
    let _cards = cards();
    for name in ["can0", "can1"] {
        socketcan::take_down(name).expect("we may");
        socketcan::take_up(name, Some(RATE)).expect("the driver is loaded");
    }
    let (mut near, mut far) = (open("can0"), open("can1"));
    let clock = Monotonic::new();
    let sent = 20_000u32;
    let flood = std::thread::spawn(move || {
        for k in 0..sent {
            while far.send(Frame::new(0x100, &k.to_le_bytes())).is_err() {
                std::hint::spin_loop();
            }
        }
        far
    });
    let (mut read, mut lost, mut last) = (0, 0, None);
    while near.wait(clock.now_ns() + 2_000_000_000) {
        while let Some(received) = near.receive() {
            match received {
                Received::Frame(frame, _) => {
                    let k = u32::from_le_bytes(frame.data().try_into().expect("four bytes"));
                    assert!(last < Some(k), "{k} after {last:?}");
                    (read, last) = (read + 1, Some(k));
                }
                Received::Event(Event::Lost(frames), _) => lost += frames,
                Received::Event(..) => {}
            }
        }
    }
    let _far = flood.join().expect("all was sent");
    println!("flood: {read} of {sent} read, {lost} told as lost");
    assert!(read > sent / 2 && (read == sent || lost > 0), "{read} read, {lost} told as lost");
}

/// The kernel's own gateway between two virtual buses, with rules. `-e`: forwarded frames can be read by sockets there.
fn gateway(rules: &[&[&str]]) {
    let run = |args: &[&str]| {
        let output = Command::new("cangw").args(args).output().unwrap_or_else(|error| panic!("cangw: {error}"));
        assert!(output.status.success(), "cangw {args:?}: {}", String::from_utf8_lossy(&output.stderr));
    };
    run(&["-F"]);
    rules.iter().for_each(|rule| run(rule));
}

/// A rig at 50 Hz on one side of a gateway, its drives on the other, until it has been armed for a while; then the
/// rules change. Returns why it stopped, and after how many cycles; no drive has torque then.
fn through_a_gateway(changed: impl Fn(&str, &str)) -> (Cause, u64) {
    let (near, far) = (fresh(), fresh());
    gateway(&[&["-A", "-e", "-s", &near, "-d", &far], &["-A", "-e", "-s", &far, "-d", &near]]);
    let mut asked = rig::pulsed(20_000_000);
    // A busy host may cause overruns of its own.
    asked.rig.overrun = Overrun::Hold(50);
    let over = Arc::new(AtomicBool::new(false));
    let drives = {
        let (rig, far, over) = (asked.rig.clone(), far.clone(), over.clone());
        std::thread::spawn(move || rig::drives(&rig, &far, None, &over))
    };
    let mut options = HilOptions { arms_itself: true, duration_ns: Some(60_000_000_000), ..HilOptions::default() };
    options.start.missed = 0.2;
    let buses: Vec<Box<dyn Bus>> = vec![Box::new(open(&near))];
    let made = Hil::new(&asked.rig, asked.program.clone(), Box::new(Monotonic::new()), buses, options, None);
    let (mut hil, _operator) = made.expect("it can be started");
    while hil.counts().cycles < 20 {
        hil.cycle();
        assert_eq!(hil.ended(), None, "before anything was changed");
    }
    changed(&near, &far);
    let (since, mut noticed) = (hil.counts().all, None);
    while hil.ended().is_none() {
        hil.cycle();
        let cause = hil.control().and_then(|control| control.supervisor().cause());
        noticed = noticed.or(cause.map(|cause| (cause, hil.counts().all - since)));
        assert!(hil.counts().all - since < 500, "it goes on");
    }
    assert!(matches!(hil.ended(), Some(End::Stopped(..))), "{:?}", hil.ended());
    over.store(true, Ordering::Relaxed);
    assert!(!drives.join().expect("the drives end"), "a drive still has torque");
    noticed.expect("a stop has its cause")
}

/// Rows of the fault campaign on a kernel: frames that a rule drops, a data word that a rule rewrites, an interface
/// that goes down.
#[test]
fn a_rig_stops_when_the_kernel_drops_or_rewrites_its_frames() {
    let _cards = cards();
    let (cause, after) = through_a_gateway(|near, far| {
        let all_but = ["-A", "-e", "-s", far, "-d", near, "-f", "183~7FF"];
        gateway(&[&["-A", "-e", "-s", near, "-d", far], &all_but]);
    });
    assert!(matches!(cause, Cause::Lost(_)) && after <= 5, "dropped: {cause:?} after {after} cycles");
    let (cause, after) = through_a_gateway(|near, far| {
        let rewritten = ["-A", "-e", "-s", far, "-d", near, "-f", "183:7FF", "-m", "SET:D:183.8.0800000000000000"];
        let others = ["-A", "-e", "-s", far, "-d", near, "-f", "183~7FF"];
        gateway(&[&["-A", "-e", "-s", near, "-d", far], &rewritten, &others]);
    });
    assert!(matches!(cause, Cause::Drive(0)) && after <= 5, "rewritten: {cause:?} after {after} cycles");
    let (cause, after) = through_a_gateway(|near, _| socketcan::take_down(near).expect("we may"));
    assert!(matches!(cause, Cause::Bus(0)) && after <= 3, "down: {cause:?} after {after} cycles");
}
