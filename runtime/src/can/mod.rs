//! Frames and the one way they travel: a [`Bus`], whatever is behind it.
//!
//! In: addresses and frames. Out: frames, stamps and events of the bus. Knows no drive and no model.

pub mod sim;
pub mod wire;

use std::fmt;

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

    /// Waits until something can be received or the clock shows `until_ns`; says whether something came.
    fn wait(&mut self, until_ns: u64) -> bool;

    /// How it is.
    fn health(&self) -> Health;
}
