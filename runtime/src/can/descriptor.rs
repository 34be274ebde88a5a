//! File descriptors that never make a loop wait but where it asks to.
//!
//! In: an open descriptor and bytes. Out: bytes, nothing yet, or that the other end is gone. The calls of the kernel that
//! the buses share are here, and nothing of any protocol.

use crate::realtime::clock::{Clock, Monotonic};
use std::io;
use std::os::fd::RawFd;

/// What became of a read or a write.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Moved {
    /// So many bytes.
    Bytes(usize),
    /// None for now.
    Later,
    /// The other end is gone, or the descriptor is.
    Gone,
}

fn moved(result: isize) -> Moved {
    match usize::try_from(result) {
        Ok(0) => Moved::Gone,
        Ok(bytes) => Moved::Bytes(bytes),
        Err(_) => match io::Error::last_os_error().raw_os_error() {
            Some(libc::EAGAIN | libc::EINTR | libc::ENOBUFS) => Moved::Later,
            _ => Moved::Gone,
        },
    }
}

/// Reads what is there.
pub(super) fn read(fd: RawFd, into: &mut [u8]) -> Moved {
    if into.is_empty() {
        return Moved::Later;
    }
    // SAFETY: the buffer is valid for its length and outlives the call.
    moved(unsafe { libc::read(fd, into.as_mut_ptr().cast(), into.len()) })
}

/// Writes what fits.
pub(super) fn write(fd: RawFd, bytes: &[u8]) -> Moved {
    if bytes.is_empty() {
        return Moved::Bytes(0);
    }
    // SAFETY: the bytes are valid for their length and outlive the call.
    moved(unsafe { libc::write(fd, bytes.as_ptr().cast(), bytes.len()) })
}

/// Lets reads and writes return at once.
pub(super) fn unblock(fd: RawFd) -> io::Result<()> {
    // SAFETY: takes no pointers.
    let flags = unsafe { libc::fcntl(fd, libc::F_GETFL) };
    // SAFETY: takes no pointers.
    let set = |flags: libc::c_int| unsafe { libc::fcntl(fd, libc::F_SETFL, flags) };
    if flags < 0 || set(flags | libc::O_NONBLOCK) < 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// An entry of [`wait`] for something to read.
pub fn readable(fd: RawFd) -> libc::pollfd {
    libc::pollfd { fd, events: libc::POLLIN, revents: 0 }
}

/// Waits until one of the descriptors has something, or the clock shows `until_ns`; says whether one has.
pub fn wait(descriptors: &mut [libc::pollfd], clock: &Monotonic, until_ns: u64) -> bool {
    loop {
        let left_ns = until_ns.saturating_sub(clock.now_ns());
        let seconds = i64::try_from(left_ns / 1_000_000_000).unwrap_or(i64::MAX);
        let left = libc::timespec { tv_sec: seconds, tv_nsec: (left_ns % 1_000_000_000) as i64 };
        // SAFETY: the descriptors and the time are valid and outlive the call; no signal mask is given.
        let found = unsafe {
            libc::ppoll(descriptors.as_mut_ptr(), descriptors.len() as libc::nfds_t, &left, std::ptr::null())
        };
        // A signal interrupts: what is left is waited for again.
        if found >= 0 || left_ns == 0 {
            return found > 0;
        }
    }
}

/// Bytes on their way out, as many as fit.
pub(super) struct Outgoing {
    bytes: Box<[u8]>,
    length: usize,
}

impl Outgoing {
    pub fn new(capacity: usize) -> Outgoing {
        Outgoing { bytes: vec![0; capacity].into(), length: 0 }
    }

    /// Takes all of a message or, if it does not fit, nothing.
    pub fn push(&mut self, message: &[u8]) -> bool {
        let end = self.length + message.len();
        let fits = end <= self.bytes.len();
        if fits {
            self.bytes[self.length..end].copy_from_slice(message);
            self.length = end;
        }
        fits
    }

    /// Writes what the descriptor takes; says whether it is still there.
    pub fn flush(&mut self, fd: RawFd) -> bool {
        while self.length > 0 {
            match write(fd, &self.bytes[..self.length]) {
                Moved::Bytes(written) => {
                    self.bytes.copy_within(written..self.length, 0);
                    self.length -= written;
                }
                Moved::Later => return true,
                Moved::Gone => {
                    self.length = 0;
                    return false;
                }
            }
        }
        true
    }

    pub fn is_empty(&self) -> bool {
        self.length == 0
    }
}

/// Bytes that came, cut into messages.
pub(super) struct Incoming {
    bytes: Box<[u8]>,
    begin: usize,
    end: usize,
}

impl Incoming {
    pub fn new(capacity: usize) -> Incoming {
        Incoming { bytes: vec![0; capacity].into(), begin: 0, end: 0 }
    }

    /// Reads what fits.
    pub fn fill(&mut self, fd: RawFd) -> Moved {
        if self.begin > 0 && self.end > self.bytes.len() / 2 {
            self.bytes.copy_within(self.begin..self.end, 0);
            (self.begin, self.end) = (0, self.end - self.begin);
        }
        let moved = read(fd, &mut self.bytes[self.end..]);
        if let Moved::Bytes(bytes) = moved {
            self.end += bytes;
        }
        moved
    }

    /// The bytes up to and without the next end mark, which is taken too.
    pub fn message(&mut self, end: impl Fn(u8) -> bool) -> Option<&[u8]> {
        let at = self.bytes[self.begin..self.end].iter().position(|&byte| end(byte))?;
        let message = self.begin..self.begin + at;
        self.begin += at + 1;
        Some(&self.bytes[message])
    }

    /// Whether there is a whole message.
    pub fn has_message(&self, end: impl Fn(u8) -> bool) -> bool {
        self.bytes[self.begin..self.end].iter().any(|&byte| end(byte))
    }

    /// Bytes without an end mark yet.
    pub fn unfinished(&self) -> usize {
        self.end - self.begin
    }

    /// Throws away what is there.
    pub fn discard(&mut self) {
        (self.begin, self.end) = (0, 0);
    }
}

/// Waits on a stream for something to read, or until the clock shows `until_ns`, and writes meanwhile what the other end
/// takes; says whether something can be read.
pub(super) fn wait_stream(fd: RawFd, outgoing: &mut Outgoing, clock: &Monotonic, until_ns: u64) -> bool {
    loop {
        let mut entry = readable(fd);
        if !outgoing.is_empty() {
            entry.events |= libc::POLLOUT;
        }
        let mut entries = [entry];
        if !wait(&mut entries, clock, until_ns) {
            return false;
        }
        if entries[0].revents != libc::POLLOUT || !outgoing.flush(fd) {
            return true;
        }
    }
}
