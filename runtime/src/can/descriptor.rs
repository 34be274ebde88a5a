//! Non-blocking I/O on file descriptors.
//!
//! In: an open descriptor and bytes. Out: bytes, nothing yet, or that the other end is gone. Contains the system calls
//! that the buses share, and no protocol.

use crate::realtime::clock::{Clock, Monotonic};
use std::io;
use std::os::fd::RawFd;

/// Result of a read or a write.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Moved {
    /// This many bytes were transferred.
    Bytes(usize),
    /// None at present.
    Later,
    /// The other end or the descriptor is closed.
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

/// Reads the available bytes.
pub(super) fn read(fd: RawFd, into: &mut [u8]) -> Moved {
    if into.is_empty() {
        return Moved::Later;
    }
    // SAFETY: the buffer is valid for its length and outlives the call.
    moved(unsafe { libc::read(fd, into.as_mut_ptr().cast(), into.len()) })
}

/// Writes as many bytes as the descriptor accepts.
pub(super) fn write(fd: RawFd, bytes: &[u8]) -> Moved {
    if bytes.is_empty() {
        return Moved::Bytes(0);
    }
    // SAFETY: the bytes are valid for their length and outlive the call.
    moved(unsafe { libc::write(fd, bytes.as_ptr().cast(), bytes.len()) })
}

/// Makes a descriptor non-blocking.
pub(super) fn unblock(fd: RawFd) -> io::Result<()> {
    // SAFETY: takes no pointers.
    let flags = unsafe { libc::fcntl(fd, libc::F_GETFL) };
    // SAFETY: takes no pointers.
    let set = |flags: libc::c_int| unsafe { libc::fcntl(fd, libc::F_SETFL, flags) };
    if flags < 0 || set(flags | libc::O_NONBLOCK) < 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// An entry of [`wait`] for reading.
pub fn readable(fd: RawFd) -> libc::pollfd {
    libc::pollfd { fd, events: libc::POLLIN, revents: 0 }
}

/// Waits until one of the descriptors is ready or the clock reaches `until_ns`; returns whether one is.
pub fn wait(descriptors: &mut [libc::pollfd], clock: &Monotonic, until_ns: u64) -> bool {
    loop {
        let left_ns = until_ns.saturating_sub(clock.now_ns());
        let seconds = i64::try_from(left_ns / 1_000_000_000).unwrap_or(i64::MAX);
        let left = libc::timespec { tv_sec: seconds, tv_nsec: (left_ns % 1_000_000_000) as i64 };
        // SAFETY: the descriptors and the time are valid and outlive the call; no signal mask is given.
        let found = unsafe {
            libc::ppoll(descriptors.as_mut_ptr(), descriptors.len() as libc::nfds_t, &left, std::ptr::null())
        };
        // After an interruption by a signal it waits for the remaining time.
        if found >= 0 || left_ns == 0 {
            return found > 0;
        }
    }
}

/// Buffer of bytes to send.
pub(super) struct Outgoing {
    bytes: Box<[u8]>,
    length: usize,
}

impl Outgoing {
    pub fn new(capacity: usize) -> Outgoing {
        Outgoing { bytes: vec![0; capacity].into(), length: 0 }
    }

    /// Appends a whole message, or nothing if it does not fit.
    pub fn push(&mut self, message: &[u8]) -> bool {
        let end = self.length + message.len();
        let fits = end <= self.bytes.len();
        if fits {
            self.bytes[self.length..end].copy_from_slice(message);
            self.length = end;
        }
        fits
    }

    /// Writes as many bytes as the descriptor accepts; returns false if it is closed.
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

/// Buffer of received bytes, which is split into messages.
pub(super) struct Incoming {
    bytes: Box<[u8]>,
    begin: usize,
    end: usize,
}

impl Incoming {
    pub fn new(capacity: usize) -> Incoming {
        Incoming { bytes: vec![0; capacity].into(), begin: 0, end: 0 }
    }

    /// Reads as many bytes as fit.
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

    /// The bytes before the next end mark; consumes the mark too.
    pub fn message(&mut self, end: impl Fn(u8) -> bool) -> Option<&[u8]> {
        let at = self.bytes[self.begin..self.end].iter().position(|&byte| end(byte))?;
        let message = self.begin..self.begin + at;
        self.begin += at + 1;
        Some(&self.bytes[message])
    }

    /// Whether there is a complete message.
    pub fn has_message(&self, end: impl Fn(u8) -> bool) -> bool {
        self.bytes[self.begin..self.end].iter().any(|&byte| end(byte))
    }

    /// Number of bytes without an end mark.
    pub fn unfinished(&self) -> usize {
        self.end - self.begin
    }

    /// Discards all bytes.
    pub fn discard(&mut self) {
        (self.begin, self.end) = (0, 0);
    }
}

/// Waits until a stream is readable or the clock reaches `until_ns`, and meanwhile writes as many bytes as the other
/// end accepts; returns whether the stream is readable.
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
