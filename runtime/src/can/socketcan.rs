//! SocketCAN: raw sockets of Linux on a kernel interface.
//!
//! In: frames. Out: frames with the kernel's timestamps, error frames as events, and counts of all losses. Only this
//! file uses the crate `socketcan`. It does not configure an interface to open it, but inspects it and reports how to
//! fix it.

use super::descriptor;
use super::{Bus, CannotOpen, Event, Filter, Frame, Health, Options, Prepared, Received, Refused, State};
use crate::realtime::clock::{Clock, Monotonic};
use ::socketcan::{CanFilter, CanInterface, CanSocket, Socket, SocketOptions, nl};
use std::io;
use std::os::fd::{AsRawFd, RawFd};

/// Size of the receive buffer, bytes: some 10,000 frames with the kernel's metadata.
const BUFFER: libc::c_int = 8 << 20;

/// A raw socket on an interface.
pub struct SocketCan {
    socket: CanSocket,
    clock: Monotonic,
    health: Health,
    /// Number of frames that the socket has dropped since it was opened, as counted by the kernel.
    dropped: u32,
    /// A frame received after a loss; the loss is reported first.
    held: Option<Received>,
    listen_only: bool,
    /// Whether the loss of the interface has been reported.
    down_told: bool,
}

/// The kernel's information about an interface.
#[derive(Clone, PartialEq, Debug)]
pub struct Interface {
    /// Whether it is up.
    pub up: bool,
    /// Bit rate, bits per second; none for a virtual interface.
    pub bit_rate: Option<u32>,
    /// State of its controller; none for a virtual interface.
    pub state: Option<State>,
    /// Time after which it restarts automatically from bus-off, ms; 0: never, which is right for a rig.
    pub restart_ms: Option<u32>,
    /// Transmit and receive error counter.
    pub errors: Option<(u16, u16)>,
    /// Length of the kernel's transmit queue, frames. 10 is right: a long queue hides a bus that accepts nothing.
    pub queue: Option<u32>,
}

/// Inspects an interface. Error: it does not exist, or the kernel has no CAN support or gives no information.
pub fn inspect(name: &str) -> Result<Interface, String> {
    let class = std::path::Path::new("/sys/class/net").join(name);
    if !class.exists() {
        return Err(format!("there is no interface {name}"));
    }
    let details = CanInterface::open(name).and_then(|interface| interface.details());
    let details = details.map_err(|error| format!("the kernel doesn't tell of {name}: {error}"))?;
    let state = details.can.state.map(|state| match state {
        nl::CanState::ErrorActive | nl::CanState::ErrorWarning => State::Active,
        nl::CanState::ErrorPassive => State::Passive,
        nl::CanState::BusOff => State::BusOff,
        nl::CanState::Stopped | nl::CanState::Sleeping => State::Down,
    });
    let queue = std::fs::read_to_string(class.join("tx_queue_len")).ok();
    Ok(Interface {
        up: details.is_up,
        bit_rate: details.can.bit_timing.map(|timing| timing.bitrate).filter(|&rate| rate > 0),
        state,
        restart_ms: details.can.restart_ms,
        errors: details.can.berr_counter.map(|counter| (counter.txerr, counter.rxerr)),
        queue: queue.and_then(|text| text.trim().parse().ok()),
    })
}

/// Creates a virtual interface and takes it up: needs CAP_NET_ADMIN, for tests and gateways.
pub fn make_virtual(name: &str) -> Result<(), String> {
    let made = CanInterface::create_vcan(name, None).and_then(|interface| interface.bring_up());
    made.map_err(|error| format!("cannot make {name}: {error}"))
}

/// Sets the bit rate of an interface and takes it up: needs CAP_NET_ADMIN.
pub fn take_up(name: &str, bit_rate: Option<u32>) -> Result<(), String> {
    let set = || -> Result<(), ::socketcan::Error> {
        let interface = CanInterface::open(name)?;
        if let Some(bit_rate) = bit_rate {
            interface.set_bitrate(bit_rate, None)?;
        }
        interface.bring_up()
    };
    set().map_err(|error| format!("cannot take {name} up: {error}"))
}

/// Takes an interface down: needs CAP_NET_ADMIN.
pub fn take_down(name: &str) -> Result<(), String> {
    let set = CanInterface::open(name).and_then(|interface| interface.bring_down());
    set.map_err(|error| format!("cannot take {name} down: {error}"))
}

impl SocketCan {
    /// Opens an interface, which must be up and have the requested bit rate.
    pub fn open(name: &str, options: &Options, clock: Monotonic) -> Result<SocketCan, CannotOpen> {
        let cannot = |reason: String, remedy: String| CannotOpen {
            address: format!("socketcan:{name}"),
            reason,
            remedy: Some(remedy),
        };
        let rate = options.bit_rate.unwrap_or(1_000_000);
        let up = format!("ip link set {name} up type can bitrate {rate} restart-ms 0");
        let interface = inspect(name).map_err(|reason| {
            let virtually = format!("ip link add dev {name} type vcan && ip link set {name} up");
            cannot(reason, format!("for a real one load its driver, for a virtual one `{virtually}`"))
        })?;
        if !interface.up {
            return Err(cannot("it is down".into(), up));
        }
        if let (Some(is), Some(wanted)) = (interface.bit_rate, options.bit_rate)
            && is != wanted
        {
            let reason = format!("it runs at {is} bit/s, and {wanted} bit/s are asked for");
            return Err(cannot(reason, format!("ip link set {name} down && {up}")));
        }
        let opened = SocketCan::socket(name, options, clock);
        opened.map_err(|error| cannot(error.to_string(), "a kernel with CAN_RAW: modprobe can-raw".into()))
    }

    fn socket(name: &str, options: &Options, clock: Monotonic) -> io::Result<SocketCan> {
        let socket = CanSocket::open(name)?;
        socket.set_nonblocking(true)?;
        match &options.filter {
            Filter::All => socket.set_filter_accept_all()?,
            // An empty list of filters means no frame at all, as requested.
            Filter::Only(ids) => {
                let exactly = |&id: &u32| match id & Filter::EXTENDED {
                    0 => CanFilter::new(id, libc::CAN_SFF_MASK | libc::CAN_EFF_FLAG),
                    _ => CanFilter::new(id, libc::CAN_EFF_MASK | libc::CAN_EFF_FLAG),
                };
                socket.set_filters(&ids.iter().map(exactly).collect::<Vec<_>>())?;
            }
        }
        // Error frames are off by default, and a bus that is off would then look like a silent one.
        socket.set_error_filter_accept_all()?;
        socket.set_recv_timestamp(true)?;
        socket.set_socket_option_int(libc::SOL_SOCKET, libc::SO_RXQ_OVFL, 1)?;
        // Exceeding the system's limit requires CAP_NET_ADMIN.
        if socket.set_socket_option_int(libc::SOL_SOCKET, libc::SO_RCVBUFFORCE, BUFFER).is_err() {
            socket.set_socket_option_int(libc::SOL_SOCKET, libc::SO_RCVBUF, BUFFER)?;
        }
        let listen_only = options.listen_only;
        Ok(SocketCan {
            socket,
            clock,
            health: Health::default(),
            dropped: 0,
            held: None,
            listen_only,
            down_told: false,
        })
    }

    /// One message from the kernel: a frame, its timestamp, and the number of frames dropped so far.
    fn message(&mut self) -> io::Result<(libc::can_frame, u64, u32)> {
        // SAFETY: all bytes 0 is a valid frame.
        let mut frame: libc::can_frame = unsafe { std::mem::zeroed() };
        let mut part = libc::iovec { iov_base: (&raw mut frame).cast(), iov_len: size_of::<libc::can_frame>() };
        // Elements of eight bytes, so that the headers in it are aligned.
        let mut control = [0u64; 16];
        // SAFETY: all bytes 0 is a valid header: no name, no parts.
        let mut header: libc::msghdr = unsafe { std::mem::zeroed() };
        header.msg_iov = &mut part;
        header.msg_iovlen = 1;
        header.msg_control = control.as_mut_ptr().cast();
        header.msg_controllen = size_of_val(&control) as _;
        // SAFETY: the header points to a frame and a buffer that outlive the call, with their true lengths.
        let read = unsafe { libc::recvmsg(self.socket.as_raw_fd(), &mut header, libc::MSG_DONTWAIT) };
        if read < 0 {
            return Err(io::Error::last_os_error());
        }
        let (mut stamp, mut dropped) = (None, self.dropped);
        // SAFETY: the kernel has filled the header; the macros stay within its control buffer.
        let mut note = unsafe { libc::CMSG_FIRSTHDR(&header) };
        while !note.is_null() {
            // SAFETY: a control message returned by the macros is complete and lies within the buffer.
            let (kind, data) = unsafe { ((*note).cmsg_type, libc::CMSG_DATA(note)) };
            match kind {
                // SAFETY: a control message of this kind contains a timespec, possibly unaligned.
                libc::SCM_TIMESTAMPNS => stamp = Some(unsafe { data.cast::<libc::timespec>().read_unaligned() }),
                // SAFETY: a control message of this kind contains 32 bits, possibly unaligned.
                libc::SO_RXQ_OVFL => dropped = unsafe { data.cast::<u32>().read_unaligned() },
                _ => {}
            }
            // SAFETY: as above; null after the last one.
            note = unsafe { libc::CMSG_NXTHDR(&header, note) };
        }
        Ok((frame, stamp.map_or_else(|| self.clock.now_ns(), |stamp| self.stamp_ns(stamp)), dropped))
    }

    /// Converts a timestamp of the kernel, which is wall-clock time, by its age, which is the same on every clock.
    fn stamp_ns(&self, stamp: libc::timespec) -> u64 {
        let mut day = libc::timespec { tv_sec: 0, tv_nsec: 0 };
        // SAFETY: the time is written by the call and outlives it.
        unsafe { libc::clock_gettime(libc::CLOCK_REALTIME, &mut day) };
        let now_ns = self.clock.now_ns();
        let ns = |time: libc::timespec| i128::from(time.tv_sec) * 1_000_000_000 + i128::from(time.tv_nsec);
        // If the wall clock was set meanwhile, the frame must not come from the future.
        let age_ns = u64::try_from(ns(day) - ns(stamp)).unwrap_or(0);
        now_ns.saturating_sub(age_ns)
    }

    /// Frames dropped since the last received frame: the counter arrives with frames, so the end of a burst needs a
    /// query of its own.
    fn dropped_behind(&mut self) -> Option<Received> {
        let mut memory = [0u32; MEMINFO];
        let mut length = size_of_val(&memory) as libc::socklen_t;
        // SAFETY: the array is written up to its length, and both outlive the call.
        let told = unsafe {
            let (level, name) = (libc::SOL_SOCKET, libc::SO_MEMINFO);
            libc::getsockopt(self.socket.as_raw_fd(), level, name, memory.as_mut_ptr().cast(), &mut length)
        };
        let dropped = if told == 0 { memory[MEMINFO - 1] } else { self.dropped };
        let lost = self.lost(dropped);
        (lost > 0).then(|| Received::Event(Event::Lost(lost), self.clock.now_ns()))
    }

    /// Number of frames dropped since the last call; adds it to the health.
    fn lost(&mut self, dropped: u32) -> u32 {
        let lost = dropped.wrapping_sub(self.dropped);
        self.dropped = dropped;
        self.health.lost += u64::from(lost);
        lost
    }

    fn down(&mut self) -> Option<Received> {
        self.health.state = State::Down;
        let told = std::mem::replace(&mut self.down_told, true);
        (!told).then(|| Received::Event(Event::Down, self.clock.now_ns()))
    }

    /// The event of an error frame; updates the health. None: not worth reporting.
    fn event(&mut self, frame: &libc::can_frame) -> Option<Event> {
        let class = frame.can_id & libc::CAN_ERR_MASK;
        let controller = libc::c_int::from(frame.data[1]);
        let is = |flag: libc::c_int| class & libc::CAN_ERR_CRTL != 0 && controller & flag != 0;
        if class & CAN_ERR_CNT != 0 {
            (self.health.transmit_errors, self.health.receive_errors) = (frame.data[6].into(), frame.data[7].into());
        }
        if class & libc::CAN_ERR_BUSOFF != 0 {
            self.health.state = State::BusOff;
            return Some(Event::BusOff);
        }
        if class & libc::CAN_ERR_RESTARTED != 0 {
            self.health = Health { lost: self.health.lost, refused: self.health.refused, ..Health::default() };
            return Some(Event::Restarted);
        }
        if is(libc::CAN_ERR_CRTL_RX_PASSIVE | libc::CAN_ERR_CRTL_TX_PASSIVE) {
            self.health.state = State::Passive;
            return Some(Event::Passive);
        }
        if is(libc::CAN_ERR_CRTL_RX_OVERFLOW) {
            // The controller does not report how many.
            self.health.lost += 1;
            return Some(Event::Lost(1));
        }
        if is(libc::CAN_ERR_CRTL_RX_WARNING | libc::CAN_ERR_CRTL_TX_WARNING) {
            self.health.state = State::Active;
            return Some(Event::Warning);
        }
        if is(libc::CAN_ERR_CRTL_ACTIVE) {
            self.health.state = State::Active;
            return None;
        }
        if class & libc::CAN_ERR_ACK != 0 {
            return Some(Event::NotAcknowledged);
        }
        // Lost arbitration, and counters alone, are no errors.
        (class & !(libc::CAN_ERR_LOSTARB | CAN_ERR_CNT) != 0).then_some(Event::Error)
    }
}

/// Number of values of SO_MEMINFO; the last one counts dropped frames.
const MEMINFO: usize = libc::SK_MEMINFO_DROPS as usize + 1;

/// Flag: the last two bytes hold error counters. Newer than the libc crate.
const CAN_ERR_CNT: u32 = 0x200;

impl Bus for SocketCan {
    fn send(&mut self, frame: Frame) -> Result<(), Refused> {
        if self.listen_only {
            return Err(Refused::Unable);
        }
        let bytes = encode(&frame);
        let fd = self.socket.as_raw_fd();
        // SAFETY: the bytes are valid for their length and outlive the call.
        let write = || unsafe { libc::write(fd, bytes.as_ptr().cast(), bytes.len()) } == bytes.len() as isize;
        let full = |error: &io::Error| matches!(error.raw_os_error(), Some(libc::ENOBUFS | libc::EAGAIN | libc::EINTR));
        // A socket stores the error that its interface was down, and a write returns it even after the interface is up
        // again.
        if write() || !full(&io::Error::last_os_error()) && write() {
            return Ok(());
        }
        self.health.refused += 1;
        // The queue of the interface, or the socket's own.
        if full(&io::Error::last_os_error()) {
            return Err(Refused::Full);
        }
        self.health.state = State::Down;
        Err(Refused::Down)
    }

    fn receive(&mut self) -> Option<Received> {
        if let Some(held) = self.held.take() {
            return Some(held);
        }
        loop {
            let (frame, stamp_ns, dropped) = match self.message() {
                Ok(message) => message,
                Err(error) => match error.raw_os_error() {
                    Some(libc::EAGAIN | libc::EINTR) => return self.dropped_behind(),
                    _ => return self.down(),
                },
            };
            let error = frame.can_id & libc::CAN_ERR_FLAG != 0;
            let received = if error {
                self.event(&frame).map(|event| Received::Event(event, stamp_ns))
            } else {
                if self.health.state == State::Down {
                    (self.health.state, self.down_told) = (State::Active, false);
                }
                Some(Received::Frame(decode(&frame), stamp_ns))
            };
            let lost = self.lost(dropped);
            if lost > 0 {
                self.held = received;
                return Some(Received::Event(Event::Lost(lost), stamp_ns));
            }
            if received.is_some() {
                return received;
            }
        }
    }

    fn wait(&mut self, until_ns: u64) -> bool {
        self.held.is_some()
            || descriptor::wait(&mut [descriptor::readable(self.socket.as_raw_fd())], &self.clock, until_ns)
    }

    fn health(&self) -> Health {
        self.health
    }

    fn descriptor(&self) -> Option<RawFd> {
        Some(self.socket.as_raw_fd())
    }

    fn prepare(&self, frame: Frame) -> Option<Prepared> {
        Some(Prepared::new(self.socket.as_raw_fd(), &encode(&frame)))
    }
}

/// Encodes a frame as the kernel's `struct can_frame`.
fn encode(frame: &Frame) -> [u8; size_of::<libc::can_frame>()] {
    let mut bytes = [0; size_of::<libc::can_frame>()];
    let extended = if frame.is_extended() { libc::CAN_EFF_FLAG } else { 0 };
    let remote = if frame.is_remote() { libc::CAN_RTR_FLAG } else { 0 };
    bytes[..4].copy_from_slice(&(frame.id() | extended | remote).to_ne_bytes());
    bytes[4] = frame.length();
    bytes[8..8 + frame.data().len()].copy_from_slice(frame.data());
    bytes
}

fn decode(frame: &libc::can_frame) -> Frame {
    let extended = frame.can_id & libc::CAN_EFF_FLAG != 0;
    let id = frame.can_id & if extended { libc::CAN_EFF_MASK } else { libc::CAN_SFF_MASK };
    let length = frame.can_dlc.min(8);
    match (frame.can_id & libc::CAN_RTR_FLAG != 0, extended) {
        (true, true) => Frame::remote_extended(id, length),
        (true, false) => Frame::remote(id, length),
        (false, true) => Frame::extended(id, &frame.data[..usize::from(length)]),
        (false, false) => Frame::new(id, &frame.data[..usize::from(length)]),
    }
}
