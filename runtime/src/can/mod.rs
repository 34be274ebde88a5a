//! CAN frames, and the [`Bus`] trait for all kinds of buses.
//!
//! In: addresses and frames. Out: frames, timestamps and events of the bus. Knows no drive and no model.

pub mod cob_ids;
pub mod frame_length;

pub mod address;
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub mod descriptor;
#[cfg(all(feature = "hardware", target_os = "linux"))]
mod text_stream;

pub mod sim;

#[cfg(all(feature = "hardware", target_os = "linux"))]
pub mod slcan;
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub mod socketcan;
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub mod socketcand;

pub mod log;
pub mod replay;

#[cfg(all(feature = "hardware", target_os = "linux"))]
pub mod bridge;

#[cfg(all(feature = "hardware", target_os = "linux"))]
use address::Address;
#[cfg(all(feature = "hardware", target_os = "linux"))]
use sim::{Join, Simulation};
use std::fmt;

/// A file descriptor of the operating system, as in the standard library of Unix systems.
pub type Descriptor = i32;

/// One classical CAN frame.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Frame {
    id: u32,
    extended: bool,
    remote: bool,
    length: u8,
    data: [u8; 8],
}

impl Frame {
    /// A data frame with an 11-bit identifier.
    ///
    /// # Panics
    /// If the identifier or the data is too long: an error of the caller.
    pub fn new(id: u32, data: &[u8]) -> Frame {
        assert!(id < 0x800, "identifier {id:#x} has more than 11 bits");
        Frame::any(id, false, data)
    }

    /// A data frame with a 29-bit identifier.
    ///
    /// # Panics
    /// If the identifier or the data is too long: an error of the caller.
    pub fn extended(id: u32, data: &[u8]) -> Frame {
        assert!(id < 1 << 29, "identifier {id:#x} has more than 29 bits");
        Frame::any(id, true, data)
    }

    /// A remote frame with an 11-bit identifier that requests `length` bytes.
    ///
    /// # Panics
    /// If the identifier or the length is too long: an error of the caller.
    pub fn remote(id: u32, length: u8) -> Frame {
        assert!(id < 0x800 && length <= 8, "identifier {id:#x} or length {length} is too long");
        Frame { id, extended: false, remote: true, length, data: [0; 8] }
    }

    /// A remote frame with a 29-bit identifier that requests `length` bytes.
    ///
    /// # Panics
    /// If the identifier or the length is too long: an error of the caller.
    pub fn remote_extended(id: u32, length: u8) -> Frame {
        assert!(id < 1 << 29 && length <= 8, "identifier {id:#x} or length {length} is too long");
        Frame { id, extended: true, remote: true, length, data: [0; 8] }
    }

    fn any(id: u32, extended: bool, bytes: &[u8]) -> Frame {
        assert!(bytes.len() <= 8, "{} data bytes, at most 8 fit", bytes.len());
        let mut data = [0; 8];
        data[..bytes.len()].copy_from_slice(bytes);
        Frame { id, extended, remote: false, length: bytes.len() as u8, data }
    }

    /// The identifier: 11 bits, or 29 if [`is_extended`](Frame::is_extended).
    pub fn id(&self) -> u32 {
        self.id
    }

    /// Whether the identifier has 29 bits.
    pub fn is_extended(&self) -> bool {
        self.extended
    }

    /// Whether it requests data instead of carrying data.
    pub fn is_remote(&self) -> bool {
        self.remote
    }

    /// Number of data bytes, or of requested bytes.
    pub fn length(&self) -> u8 {
        self.length
    }

    /// The data; empty in a remote frame.
    pub fn data(&self) -> &[u8] {
        if self.remote { &[] } else { &self.data[..self.length as usize] }
    }
}

/// In the format of `candump` and `cansend`: `181#AABB`, `080#`, `701#R1`.
impl fmt::Display for Frame {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self.extended {
            true => write!(f, "{:08X}#", self.id)?,
            false => write!(f, "{:03X}#", self.id)?,
        }
        if self.remote {
            return if self.length > 0 { write!(f, "R{}", self.length) } else { write!(f, "R") };
        }
        self.data().iter().try_for_each(|byte| write!(f, "{byte:02X}"))
    }
}

impl fmt::Debug for Frame {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{self}")
    }
}

/// Acceptance filter for received frames.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub enum Filter {
    /// All frames.
    #[default]
    All,
    /// Frames with exactly these identifiers; [`Filter::EXTENDED`] is added to those of 29 bits.
    Only(Vec<u32>),
}

impl Filter {
    /// Flag of an identifier of 29 bits.
    pub const EXTENDED: u32 = 1 << 31;

    /// Whether a frame passes the filter.
    pub fn accepts(&self, frame: &Frame) -> bool {
        let extended = if frame.is_extended() { Filter::EXTENDED } else { 0 };
        match self {
            Filter::All => true,
            Filter::Only(ids) => ids.contains(&(frame.id() | extended)),
        }
    }
}

/// A frame or event received from a bus.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Received {
    /// A frame, and the time of its arrival.
    Frame(Frame, u64),
    /// An event of the bus itself, and its time.
    Event(Event, u64),
}

/// Event of a bus. Error frames are events, never frames.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Event {
    /// An error counter exceeds 96.
    Warning,
    /// An error counter exceeds 127: error passive, other nodes no longer see our error flags.
    Passive,
    /// The transmit error counter exceeds 255: bus-off, we no longer take part.
    BusOff,
    /// Active again after [`Event::BusOff`].
    Restarted,
    /// No node acknowledged our frame.
    NotAcknowledged,
    /// This many frames were lost before they were read.
    Lost(u32),
    /// Any other error frame.
    Error,
    /// The interface went down, or the other end closed the connection.
    Down,
}

/// Reason why a bus refused a frame.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Refused {
    /// The transmit queue is full: a fault of the bus, never a reason to wait.
    Full,
    /// Bus-off, interface down, or the other end is gone.
    Down,
    /// This bus cannot send it: a remote frame over socketcand, any frame over a listen-only bus.
    Unable,
}

/// Health of a bus.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Health {
    /// State of the controller, as it reports it.
    pub state: State,
    /// Transmit error counter.
    pub transmit_errors: u16,
    /// Receive error counter.
    pub receive_errors: u16,
    /// Received frames that were lost.
    pub lost: u64,
    /// Frames to send that were refused.
    pub refused: u64,
}

/// State of a controller.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
#[allow(missing_docs)]
pub enum State {
    #[default]
    Active,
    Passive,
    BusOff,
    Down,
}

/// A bus. None of its methods allocates, and only [`wait`](Bus::wait) blocks.
pub trait Bus {
    /// Queues a frame without waiting for its transmission. Our own frames are not received back.
    fn send(&mut self, frame: Frame) -> Result<(), Refused>;

    /// The next received frame or event, if any.
    fn receive(&mut self) -> Option<Received>;

    /// Waits until something can be received or the clock reaches `until_ns`; returns whether something arrived. On a
    /// text protocol that may be an answer or a part of a frame, from which [`receive`](Bus::receive) returns nothing
    /// yet.
    fn wait(&mut self, until_ns: u64) -> bool;

    /// Its health.
    fn health(&self) -> Health;

    /// A descriptor that becomes readable when something has arrived; none where no kernel is involved.
    fn descriptor(&self) -> Option<Descriptor> {
        None
    }

    /// Encodes a frame so that another thread or a signal handler can send it at any time, whatever this bus is doing.
    /// None where no kernel is involved.
    fn prepare(&self, frame: Frame) -> Option<Prepared> {
        let _ = frame;
        None
    }
}

/// A frame as bytes for one write(2). Valid as long as the bus that made it.
#[derive(Clone, Copy, Debug)]
pub struct Prepared {
    fd: Descriptor,
    bytes: [u8; 64],
    length: u8,
}

impl Prepared {
    #[cfg(all(feature = "hardware", target_os = "linux"))]
    pub(crate) fn new(fd: Descriptor, from: &[u8]) -> Prepared {
        let mut bytes = [0; 64];
        bytes[..from.len()].copy_from_slice(from);
        Prepared { fd, bytes, length: from.len() as u8 }
    }

    /// Sends the frame: one async-signal-safe system call, no allocation, no lock. False if it was refused.
    pub fn send(&self) -> bool {
        let bytes = &self.bytes[..usize::from(self.length)];
        #[cfg(all(feature = "hardware", target_os = "linux"))]
        return descriptor::write(self.fd, bytes) == descriptor::Moved::Bytes(bytes.len());
        #[cfg(not(all(feature = "hardware", target_os = "linux")))]
        unreachable!("no bus of this build has the descriptor {} for {bytes:02X?}", self.fd);
    }
}

/// Options for opening a bus.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Options {
    /// Bit rate, bits per second: set for a simulated bus and an adapter. That of a kernel interface is checked against
    /// it and never set.
    pub bit_rate: Option<u32>,
    /// Acceptance filter.
    pub filter: Filter,
    /// Never send.
    pub listen_only: bool,
}

/// Reason why a bus cannot be opened.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct CannotOpen {
    /// The address of the bus.
    pub address: String,
    /// The problem.
    pub reason: String,
    /// Its remedy.
    pub remedy: Option<String>,
}

/// The first line names the problem, the second one its remedy.
impl fmt::Display for CannotOpen {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}: {}", self.address, self.reason)?;
        self.remedy.iter().try_for_each(|remedy| write!(f, "\n  mend: {remedy}"))
    }
}

/// Default bit rate of a simulated bus, bits per second.
#[cfg(all(feature = "hardware", target_os = "linux"))]
const BIT_RATE: u32 = 1_000_000;

/// Opens a bus of any kind. `name`: name of our node on a simulated bus.
///
/// Real buses use the clock of `world` for timestamps, which must therefore be a real clock: a simulated one cannot
/// wait for them.
#[cfg(all(feature = "hardware", target_os = "linux"))]
pub fn open(address: &Address, options: &Options, world: &Simulation, name: &str) -> Result<Box<dyn Bus>, CannotOpen> {
    let clock = || {
        world.monotonic().ok_or_else(|| CannotOpen {
            address: address.to_string(),
            reason: "a real bus does not wait for simulated time".into(),
            remedy: Some("sim:NAME, or real time".into()),
        })
    };
    Ok(match address {
        Address::Sim(bus) => {
            let bus = world.bus(bus, options.bit_rate.unwrap_or(BIT_RATE));
            let Options { bit_rate, filter, listen_only } = options.clone();
            Box::new(bus.join(name, Join { bit_rate, filter, listen_only }))
        }
        Address::SocketCan(interface) => Box::new(socketcan::SocketCan::open(interface, options, clock()?)?),
        Address::Slcan { path, bit_rate } => {
            let options = Options { bit_rate: bit_rate.or(options.bit_rate), ..options.clone() };
            Box::new(slcan::Slcan::open(path, &options, clock()?)?)
        }
        Address::Socketcand { host, port, interface } => {
            Box::new(socketcand::Client::open(host, *port, interface, options, clock()?)?)
        }
        Address::Replay(path) => Box::new(replay::Replay::open(path, options, world.clone())?),
    })
}
