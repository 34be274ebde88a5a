//! Frames and the one way they travel: a [`Bus`], whatever is behind it.
//!
//! In: addresses and frames. Out: frames, stamps and events of the bus. Knows no drive and no model.

pub mod cob_ids;
pub mod frame_length;

pub mod address;
pub mod descriptor;

pub mod sim;

pub mod slcan;
pub mod socketcan;
pub mod socketcand;

pub mod log;
pub mod replay;

pub mod bridge;

use address::Address;
use sim::{Join, Simulation};
use std::fmt;
use std::os::fd::RawFd;

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
    /// If the identifier or the data is too long: a mistake of the caller.
    pub fn new(id: u32, data: &[u8]) -> Frame {
        assert!(id < 0x800, "identifier {id:#x} has more than 11 bits");
        Frame::any(id, false, data)
    }

    /// A data frame with a 29-bit identifier.
    ///
    /// # Panics
    /// If the identifier or the data is too long: a mistake of the caller.
    pub fn extended(id: u32, data: &[u8]) -> Frame {
        assert!(id < 1 << 29, "identifier {id:#x} has more than 29 bits");
        Frame::any(id, true, data)
    }

    /// A remote frame with an 11-bit identifier that asks for `length` bytes.
    ///
    /// # Panics
    /// If the identifier or the length is too long: a mistake of the caller.
    pub fn remote(id: u32, length: u8) -> Frame {
        assert!(id < 0x800 && length <= 8, "identifier {id:#x} or length {length} is too long");
        Frame { id, extended: false, remote: true, length, data: [0; 8] }
    }

    /// A remote frame with a 29-bit identifier that asks for `length` bytes.
    ///
    /// # Panics
    /// If the identifier or the length is too long: a mistake of the caller.
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

    /// Whether it asks for data instead of carrying them.
    pub fn is_remote(&self) -> bool {
        self.remote
    }

    /// Number of data bytes, or of bytes asked for.
    pub fn length(&self) -> u8 {
        self.length
    }

    /// The data; nothing in a remote frame.
    pub fn data(&self) -> &[u8] {
        if self.remote { &[] } else { &self.data[..self.length as usize] }
    }
}

/// As `candump` and `cansend` write it: `181#AABB`, `080#`, `701#R1`.
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

/// Which frames come in.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub enum Filter {
    /// All of them.
    #[default]
    All,
    /// Those with exactly these identifiers, 29-bit ones with [`Filter::EXTENDED`] added.
    Only(Vec<u32>),
}

impl Filter {
    /// Marks an identifier of 29 bits.
    pub const EXTENDED: u32 = 1 << 31;

    /// Whether a frame comes in.
    pub fn accepts(&self, frame: &Frame) -> bool {
        let extended = if frame.is_extended() { Filter::EXTENDED } else { 0 };
        match self {
            Filter::All => true,
            Filter::Only(ids) => ids.contains(&(frame.id() | extended)),
        }
    }
}

/// What came from a bus.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Received {
    /// A frame, and when it came.
    Frame(Frame, u64),
    /// The bus has something to say of itself.
    Event(Event, u64),
}

/// What a bus says of itself. Error frames are events, never frames.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Event {
    /// More than 96 errors of one kind counted.
    Warning,
    /// Error counters above 127: nobody hears our error flags any more.
    Passive,
    /// Counter above 255: we no longer take part.
    BusOff,
    /// Active again after [`Event::BusOff`].
    Restarted,
    /// Nobody acknowledged a frame of ours.
    NotAcknowledged,
    /// This many frames were lost before we read them.
    Lost(u32),
    /// Any other error frame.
    Error,
    /// The interface went down or the other end closed.
    Down,
}

/// Why a frame was not taken.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Refused {
    /// The queue towards the bus is full: a fault of the bus, never a reason to wait.
    Full,
    /// Bus-off, interface down, other end gone.
    Down,
    /// Nothing that this bus carries: a remote frame over socketcand, anything over one that only listens.
    Unable,
}

/// How a bus is.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Health {
    /// As the controller tells it.
    pub state: State,
    /// Transmit error counter.
    pub transmit_errors: u16,
    /// Receive error counter.
    pub receive_errors: u16,
    /// Frames lost on their way to us.
    pub lost: u64,
    /// Frames of ours that were refused.
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

/// A bus. None of its calls allocates, and only [`wait`](Bus::wait) waits.
pub trait Bus {
    /// Hands over a frame; does not wait for it to be sent. Own frames don't come back.
    fn send(&mut self, frame: Frame) -> Result<(), Refused>;

    /// The next thing that came, if any.
    fn receive(&mut self) -> Option<Received>;

    /// Waits until something can be received or the clock shows `until_ns`; says whether something came. On a line of text that
    /// may be an answer, or a part of a frame, of which [`receive`](Bus::receive) makes nothing yet.
    fn wait(&mut self, until_ns: u64) -> bool;

    /// How it is.
    fn health(&self) -> Health;

    /// What becomes readable when something came; none where no kernel is involved.
    fn descriptor(&self) -> Option<RawFd> {
        None
    }

    /// A frame made ready to be sent by another thread or by a signal handler, whatever this bus is in the middle of. None
    /// where no kernel is involved.
    fn prepare(&self, frame: Frame) -> Option<Prepared> {
        let _ = frame;
        None
    }
}

/// A frame as the bytes that one write(2) sends. Valid as long as the bus that made it.
#[derive(Clone, Copy, Debug)]
pub struct Prepared {
    fd: RawFd,
    bytes: [u8; 64],
    length: u8,
}

impl Prepared {
    pub(crate) fn new(fd: RawFd, from: &[u8]) -> Prepared {
        let mut bytes = [0; 64];
        bytes[..from.len()].copy_from_slice(from);
        Prepared { fd, bytes, length: from.len() as u8 }
    }

    /// Sends it: one system call that is allowed in a signal handler, no allocation, no lock. False if it was not taken.
    pub fn send(&self) -> bool {
        let bytes = &self.bytes[..usize::from(self.length)];
        descriptor::write(self.fd, bytes) == descriptor::Moved::Bytes(bytes.len())
    }
}

/// How a bus is opened.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Options {
    /// Bits a second: what a simulated bus gets and an adapter is told. An interface of the kernel is compared with it
    /// and never set.
    pub bit_rate: Option<u32>,
    /// What is received.
    pub filter: Filter,
    /// Never to send.
    pub listen_only: bool,
}

/// Why a bus can't be opened.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct CannotOpen {
    /// Which one.
    pub address: String,
    /// What is wrong.
    pub reason: String,
    /// What to do about it.
    pub remedy: Option<String>,
}

/// The first line says what is wrong, the second what mends it.
impl fmt::Display for CannotOpen {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}: {}", self.address, self.reason)?;
        self.remedy.iter().try_for_each(|remedy| write!(f, "\n  mend: {remedy}"))
    }
}

/// Bits a second of a simulated bus that nobody gave any.
const BIT_RATE: u32 = 1_000_000;

/// Opens a bus, whatever its kind. `name` is how the node is called on a simulated one.
///
/// Real buses stamp with the clock of the world, which therefore must be real: a simulated time can't wait for them.
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
