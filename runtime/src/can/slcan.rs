//! The slcan protocol: frames as lines of text on a terminal, for serial adapters and pseudo-terminals with the same
//! protocol.
//!
//! In: frames. Out: frames, with the time at which they were read. Both ends are here: [`Slcan::open`] connects to an
//! adapter, [`Slcan::door`] is one. The protocol does not report bus errors.
//!
//! A line ends in CR. `t1232AABB` is a frame with 11-bit identifier 123 and two bytes, `T` has 8 digits of identifier,
//! `r` and `R` are remote. Commands: `S0`…`S8` bit rate, `O` open, `L` listen, `C` close, `V` version, `N` serial
//! number, `F` flags, `Z1` timestamps. An adapter answers frames by `z` or `Z`, commands by an empty line, and refuses
//! by BEL.

use super::address::SLCAN_BIT_RATES;
use super::descriptor;
use super::text_stream::{MessageShape, TextStream};
use super::{Bus, CannotOpen, Filter, Frame, Health, Options, Prepared, Received, Refused, State};
use crate::realtime::clock::{Clock, Monotonic};
use std::fs::{File, OpenOptions};
use std::io;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd, RawFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

/// Capacity for bytes to send, some 150 frames: a full buffer means that the terminal accepts nothing.
const OUTGOING: usize = 4096;

/// Capacity for received bytes: a burst of 2,000 frames fits.
const INCOMING: usize = 128 * 1024;

/// Length of the longest line: `T`, identifier, length, data, timestamp, CR.
const LINE: usize = 1 + 8 + 1 + 16 + 4 + 1;

const CR: u8 = b'\r';
const BEL: u8 = 7;

/// A line ends in CR; BEL is a line of its own.
fn is_end(byte: u8) -> bool {
    byte == CR || byte == BEL
}

/// One end of a terminal.
pub struct Slcan {
    stream: TextStream<OwnedFd>,
    side: Side,
    filter: Filter,
}

enum Side {
    /// An adapter is at the other end.
    Computer { listen_only: bool },
    /// A computer is at the other end; we are the adapter.
    Adapter(Adapter),
}

struct Adapter {
    open: bool,
    listen_only: bool,
    stamps: bool,
    /// Our own handle of the computer's end: without it the terminal would hang up whenever no program has it open.
    _end: File,
    /// Path of the computer's end, and a link to it with a constant name.
    path: PathBuf,
    link: Option<PathBuf>,
}

impl Slcan {
    /// Opens an adapter and its bus.
    pub fn open(path: &Path, options: &Options, clock: Monotonic) -> Result<Slcan, CannotOpen> {
        let cannot = |reason: String, remedy: &str| CannotOpen {
            address: format!("slcan:{}", path.display()),
            reason,
            remedy: Some(remedy.into()),
        };
        let bit_rate = options.bit_rate.ok_or_else(|| {
            cannot(
                "an adapter must be told its bit rate".into(),
                "write it behind the path: slcan:/dev/ttyACM0@1000000",
            )
        })?;
        let code = SLCAN_BIT_RATES.iter().position(|&rate| rate == bit_rate);
        let code = code.ok_or_else(|| {
            cannot(
                format!("slcan has no {bit_rate} bit/s"),
                "10000, 20000, 50000, 100000, 125000, 250000, 500000, 750000 or 1000000",
            )
        })?;
        let flags = libc::O_NOCTTY | libc::O_NONBLOCK;
        let opened = OpenOptions::new().read(true).write(true).custom_flags(flags).open(path);
        let opened = opened.and_then(|file| make_raw(file.as_raw_fd()).map(|()| file));
        let file = opened.map_err(|error| {
            let remedy = match error.raw_os_error() {
                Some(libc::EACCES) => "join the group that owns it, mostly: sudo usermod -aG dialout $USER",
                Some(libc::ENOTTY) => "name a terminal: /dev/ttyACM0, or the path of a `fric bus --pty` door",
                _ => "look with `ls /dev/ttyACM* /dev/ttyUSB*` where it is",
            };
            cannot(error.to_string(), remedy)
        })?;
        let side = Side::Computer { listen_only: options.listen_only };
        let mut bus = Slcan::new(file.into(), clock, side, options.filter.clone());
        // An empty line terminates any partial line; the bus is closed first, because an open bus refuses a bit rate.
        let open = if options.listen_only { 'L' } else { 'O' };
        bus.stream.outgoing.push(format!("\r\rC\rS{code}\r{open}\r").as_bytes());
        bus.stream.flush();
        Ok(bus)
    }

    /// Creates a pseudo-terminal that behaves like an adapter; `link` becomes a symbolic link to it, until this is
    /// dropped.
    pub fn door(link: Option<&Path>, clock: Monotonic) -> Result<Slcan, CannotOpen> {
        let cannot = |error: io::Error| CannotOpen {
            address: link.map_or("a pseudo-terminal".into(), |link| link.display().to_string()),
            reason: error.to_string(),
            remedy: Some("name a path that does not exist yet, in a folder that can be written".into()),
        };
        let (fd, path) = pseudo_terminal().map_err(cannot)?;
        // Both ends raw: otherwise the terminal would convert CR to LF and echo its input.
        let ends = make_raw(fd.as_raw_fd())
            .and_then(|()| OpenOptions::new().read(true).write(true).custom_flags(libc::O_NOCTTY).open(&path));
        let end = ends.and_then(|end| make_raw(end.as_raw_fd()).map(|()| end)).map_err(cannot)?;
        descriptor::unblock(fd.as_raw_fd()).map_err(cannot)?;
        if let Some(link) = link {
            // The link of a killed process is dangling, and may be removed.
            if link.is_symlink() && !link.exists() {
                std::fs::remove_file(link).map_err(cannot)?;
            }
            std::os::unix::fs::symlink(&path, link).map_err(cannot)?;
        }
        let link = link.map(Path::to_path_buf);
        let adapter = Adapter { open: false, listen_only: false, stamps: false, _end: end, path, link };
        Ok(Slcan::new(fd, clock, Side::Adapter(adapter), Filter::All))
    }

    fn new(fd: OwnedFd, clock: Monotonic, side: Side, filter: Filter) -> Slcan {
        let shape = MessageShape { is_end, unfinished: 4 * LINE, incoming: INCOMING, outgoing: OUTGOING };
        Slcan { stream: TextStream::new(fd, clock, shape), side, filter }
    }

    /// Path of the computer's end of a door.
    pub fn path(&self) -> Option<&Path> {
        match &self.side {
            Side::Computer { .. } => None,
            Side::Adapter(adapter) => Some(&adapter.path),
        }
    }

    /// The next frame among the received lines; an adapter executes and answers commands on the way.
    fn next(&mut self) -> Option<Received> {
        loop {
            let now_ns = self.stream.clock.now_ns();
            let line = self.stream.incoming.message(is_end)?;
            // Answers to frames precede the next frame without a separator.
            let line = line.trim_ascii_start();
            let frame = decode(line);
            match &mut self.side {
                Side::Computer { .. } => {
                    if let Some(frame) = frame.filter(|frame| self.filter.accepts(frame)) {
                        return Some(Received::Frame(frame, now_ns));
                    }
                }
                Side::Adapter(adapter) => {
                    let answer: &[u8] = match (frame, line) {
                        (Some(frame), _) if adapter.open && !adapter.listen_only => {
                            let answer = if frame.is_extended() { b"Z\r" } else { b"z\r" };
                            if !self.stream.outgoing.push(answer) {
                                self.stream.health.refused += 1;
                            }
                            return Some(Received::Frame(frame, now_ns));
                        }
                        (Some(_), _) => &[BEL],
                        (None, line) => adapter.command(line),
                    };
                    // An answer that does not fit is for a computer that reads nothing.
                    self.stream.outgoing.push(answer);
                }
            }
        }
    }
}

impl Adapter {
    /// Executes a command and returns the answer.
    fn command(&mut self, line: &[u8]) -> &'static [u8] {
        match line {
            [] => b"",
            [b'O'] => {
                (self.open, self.listen_only) = (true, false);
                b"\r"
            }
            [b'L'] => {
                (self.open, self.listen_only) = (true, true);
                b"\r"
            }
            [b'C'] => {
                self.open = false;
                b"\r"
            }
            [b'S', b'0'..=b'8'] => b"\r",
            // Bit timing registers, acceptance code and mask have no meaning here.
            [b's', ..] | [b'M', ..] | [b'm', ..] => b"\r",
            [b'Z', on @ (b'0' | b'1')] => {
                self.stamps = *on == b'1';
                b"\r"
            }
            [b'V'] => b"V1013\r",
            [b'N'] => b"N0001\r",
            [b'F'] => b"F00\r",
            _ => &[BEL],
        }
    }
}

impl Bus for Slcan {
    fn send(&mut self, frame: Frame) -> Result<(), Refused> {
        let stamp = match &self.side {
            // Nobody has opened the bus, so the frame has no recipient.
            Side::Adapter(adapter) if !adapter.open => return Ok(()),
            Side::Adapter(adapter) => adapter.stamps.then(|| (self.stream.clock.now_ns() / 1_000_000 % 60_000) as u16),
            Side::Computer { listen_only: true } => return Err(Refused::Unable),
            Side::Computer { listen_only: false } => None,
        };
        let mut line = [0; LINE];
        let length = encode(&frame, stamp, &mut line);
        self.stream.send(&line[..length])
    }

    fn receive(&mut self) -> Option<Received> {
        let received = loop {
            if let Some(received) = self.next().or_else(|| self.stream.tidy()) {
                break Some(received);
            }
            match self.stream.fill() {
                Ok(true) => {}
                Ok(false) => break None,
                Err(gone) => break gone,
            }
        };
        if !self.stream.outgoing.is_empty() && !self.stream.flush() {
            self.stream.health.state = State::Down;
        }
        received
    }

    fn wait(&mut self, until_ns: u64) -> bool {
        self.stream.wait(until_ns)
    }

    fn health(&self) -> Health {
        self.stream.health
    }

    fn descriptor(&self) -> Option<RawFd> {
        Some(self.stream.fd())
    }

    /// Begins with an empty line, which terminates a partially written line.
    fn prepare(&self, frame: Frame) -> Option<Prepared> {
        let mut line = [CR; 1 + LINE];
        let mut text = [0; LINE];
        let length = encode(&frame, None, &mut text);
        line[1..=length].copy_from_slice(&text[..length]);
        Some(Prepared::new(self.stream.fd(), &line[..=length]))
    }
}

impl Drop for Slcan {
    fn drop(&mut self) {
        match &self.side {
            Side::Computer { .. } => {
                self.stream.outgoing.push(b"C\r");
                self.stream.flush();
            }
            Side::Adapter(Adapter { link: Some(link), path, .. }) => {
                // Another process may have replaced the link.
                if std::fs::read_link(link).is_ok_and(|target| target == *path) {
                    let _ = std::fs::remove_file(link);
                }
            }
            Side::Adapter(_) => {}
        }
    }
}

/// Encodes a frame as a line; returns its length.
fn encode(frame: &Frame, stamp: Option<u16>, line: &mut [u8; LINE]) -> usize {
    let mut at = 0;
    let mut put = |value: u32, digits: u32| {
        for digit in (0..digits).rev() {
            line[at] = b"0123456789ABCDEF"[(value >> (4 * digit) & 0xF) as usize];
            at += 1;
        }
    };
    // The letter is written last, over the leading zero.
    put(0, 1);
    put(frame.id(), if frame.is_extended() { 8 } else { 3 });
    put(frame.length().into(), 1);
    frame.data().iter().for_each(|&byte| put(byte.into(), 2));
    if let Some(stamp) = stamp {
        put(stamp.into(), 4);
    }
    line[0] = match (frame.is_remote(), frame.is_extended()) {
        (false, false) => b't',
        (false, true) => b'T',
        (true, false) => b'r',
        (true, true) => b'R',
    };
    line[at] = CR;
    at + 1
}

/// Decodes the frame of a line; ignores a timestamp after it.
fn decode(line: &[u8]) -> Option<Frame> {
    let (&letter, rest) = line.split_first()?;
    let (extended, remote) = match letter {
        b't' => (false, false),
        b'T' => (true, false),
        b'r' => (false, true),
        b'R' => (true, true),
        _ => return None,
    };
    let (id, rest) = rest.split_at_checked(if extended { 8 } else { 3 })?;
    let id = number(id).filter(|&id| id < if extended { 1 << 29 } else { 0x800 })?;
    let (length, rest) = rest.split_at_checked(1)?;
    let length = number(length).filter(|&length| length <= 8)? as usize;
    if remote {
        let length = length as u8;
        let whole = rest.is_empty() || rest.len() == 4;
        return whole.then(|| if extended { Frame::remote_extended(id, length) } else { Frame::remote(id, length) });
    }
    let (digits, stamp) = rest.split_at_checked(2 * length)?;
    if !stamp.is_empty() && stamp.len() != 4 {
        return None;
    }
    let mut data = [0; 8];
    for (byte, digits) in data.iter_mut().zip(digits.chunks(2)) {
        *byte = number(digits)? as u8;
    }
    Some(if extended { Frame::extended(id, &data[..length]) } else { Frame::new(id, &data[..length]) })
}

/// Parses a hexadecimal number.
fn number(digits: &[u8]) -> Option<u32> {
    digits.iter().try_fold(0, |number, &digit| Some(number << 4 | char::from(digit).to_digit(16)?))
}

/// Sets a terminal to raw mode.
fn make_raw(fd: RawFd) -> io::Result<()> {
    // SAFETY: all bytes 0 is a valid termios.
    let mut settings: libc::termios = unsafe { std::mem::zeroed() };
    // SAFETY: the settings are written by the call and outlive it.
    if unsafe { libc::tcgetattr(fd, &mut settings) } != 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: both calls get valid settings. The speed concerns only a real serial line. It is set in the fields
    // directly, because the symbol of the function for it is not available to a static program.
    let set = unsafe {
        libc::cfmakeraw(&mut settings);
        settings.c_cflag = (settings.c_cflag & !libc::CBAUD) | libc::B115200 | libc::CLOCAL | libc::CREAD;
        (settings.c_ispeed, settings.c_ospeed) = (libc::B115200, libc::B115200);
        libc::tcsetattr(fd, libc::TCSANOW, &settings)
    };
    if set == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

/// A pseudo-terminal: the descriptor of the adapter's end, and the path of the computer's end.
fn pseudo_terminal() -> io::Result<(OwnedFd, PathBuf)> {
    // SAFETY: takes no pointers.
    let fd = unsafe { libc::posix_openpt(libc::O_RDWR | libc::O_NOCTTY | libc::O_CLOEXEC) };
    if fd < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: a fresh descriptor that nobody else owns.
    let fd = unsafe { OwnedFd::from_raw_fd(fd) };
    let mut name = [0u8; 128];
    // SAFETY: the buffer is valid for its length and outlives the calls.
    let named = unsafe {
        libc::grantpt(fd.as_raw_fd()) == 0
            && libc::unlockpt(fd.as_raw_fd()) == 0
            && libc::ptsname_r(fd.as_raw_fd(), name.as_mut_ptr().cast(), name.len()) == 0
    };
    if !named {
        return Err(io::Error::last_os_error());
    }
    let length = name.iter().position(|&byte| byte == 0).unwrap_or(name.len());
    Ok((fd, PathBuf::from(String::from_utf8_lossy(&name[..length]).into_owned())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_a_line() {
        for (frame, text) in [
            (Frame::new(0x123, &[0xAA, 0xBB]), "t1232AABB\r"),
            (Frame::new(0x080, &[]), "t0800\r"),
            (Frame::extended(0x18DA_F110, &[1]), "T18DAF110101\r"),
            (Frame::remote(0x701, 1), "r7011\r"),
            (Frame::remote_extended(0x12345, 0), "R000123450\r"),
        ] {
            let mut line = [0; LINE];
            let length = encode(&frame, None, &mut line);
            assert_eq!(String::from_utf8_lossy(&line[..length]), text);
            assert_eq!(decode(&line[..length - 1]), Some(frame));
            let length = encode(&frame, Some(0xEA5F), &mut line);
            assert_eq!(decode(&line[..length - 1]), Some(frame), "a time stamp behind it");
        }
    }

    #[test]
    fn what_is_no_frame_is_none() {
        for line in
            ["", "t", "t12", "t123", "t1239", "t1231A", "t1231AAB", "tXYZ0", "t8000", "TFFFFFFFF0", "z", "V1013"]
        {
            assert_eq!(decode(line.as_bytes()), None, "{line}");
        }
    }

    #[test]
    fn an_adapter_answers_the_commands_of_a_computer() {
        let mut door = Slcan::door(None, Monotonic::new()).expect("a pseudo-terminal");
        let path = door.path().expect("a door has a path").to_path_buf();
        let mut computer = OpenOptions::new().read(true).write(true).open(path).expect("it opens");
        use std::io::{Read, Write};
        descriptor::unblock(computer.as_raw_fd()).expect("a descriptor");
        let clock = Monotonic::new();
        // The kernel transfers bytes between the ends asynchronously: the available bytes may be only a part.
        let mut says = |text: &str, frames: usize, answer: &str| {
            computer.write_all(text.as_bytes()).expect("written");
            let until_ns = clock.now_ns() + 10_000_000_000;
            let (mut got, mut answered) = (0, String::new());
            while (got < frames || answered.len() < answer.len()) && clock.now_ns() < until_ns {
                got += std::iter::from_fn(|| door.receive()).count();
                let mut more = [0; 64];
                let length = computer.read(&mut more).unwrap_or(0);
                answered += &String::from_utf8_lossy(&more[..length]);
            }
            assert_eq!((got, answered.as_str()), (frames, answer), "{text:?}");
        };
        // The sequence of python-can: closed twice, an empty line, opened twice.
        says("C\rS8\r\rO\rO\r", 0, "\r\r\r\r");
        says("V\rN\rF\r", 0, "V1013\rN0001\rF00\r");
        says("t0800\rT000000010\r", 2, "z\rZ\r");
        says("quatsch\r", 0, "\u{7}");
        // Nothing is sent on a closed bus, nor on a listen-only one.
        says("C\rt0800\r", 0, "\r\u{7}");
        says("L\rt0800\r", 0, "\r\u{7}");
    }

    #[test]
    fn a_link_exists_as_long_as_its_door() {
        let folder = tempfile::tempdir().expect("a folder");
        let link = folder.path().join("can0");
        let door = Slcan::door(Some(&link), Monotonic::new()).expect("a door");
        assert_eq!(std::fs::read_link(&link).expect("a link"), door.path().expect("a path"));
        let again = Slcan::door(Some(&link), Monotonic::new()).err().expect("the name is taken");
        assert!(again.to_string().contains("can0: File exists"), "{again}");
        drop(door);
        assert!(!link.is_symlink());
    }
}
