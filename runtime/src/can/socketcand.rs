//! The socketcand protocol: frames as text messages over TCP.
//!
//! In: frames. Out: frames, with the time at which they were read. Both ends are here: [`Client`] connects to a
//! gateway, [`Server`] is one. The protocol has no remote frames and does not report bus errors.
//!
//! The server sends `< hi >`; the client sends `< open can0 >` and `< rawmode >`, each answered by `< ok >`. Then the
//! client sends frames as `< send 123 2 aa b >` and receives them as `< frame 123 1700000000.123456 AABB >`.

use super::text_stream::{MessageShape, TextStream};
use super::{Bus, CannotOpen, Filter, Frame, Health, Options, Prepared, Received, Refused};
use crate::realtime::clock::{Clock, Monotonic};
use std::io::{self, Cursor, Read, Write};
use std::net::{TcpListener, TcpStream, ToSocketAddrs};
use std::os::fd::{AsRawFd, RawFd};
use std::time::{Duration, SystemTime};

/// Capacity for bytes to send, in addition to the kernel's buffer: a few hundred frames.
const OUTGOING: usize = 16 * 1024;

/// Capacity for received bytes: a burst of 2,000 frames fits.
const INCOMING: usize = 256 * 1024;

/// An incomplete message of this length is discarded, as by socketcand.
const UNFINISHED: usize = 200;

/// Length of the longest message, a frame with 8 bytes.
const MESSAGE: usize = 80;

/// Longest time for a gateway to answer.
const PATIENCE: Duration = Duration::from_secs(2);

/// Time after rawmode in which a client may still read the answer: some clients read each answer by one call and
/// compare it as a whole, so that a frame right after it would break the handshake.
const PAUSE_NS: u64 = 20_000_000;

/// A TCP stream of messages.
type Stream = TextStream<TcpStream>;

fn is_end(byte: u8) -> bool {
    byte == b'>'
}

fn stream_of(tcp: TcpStream, clock: Monotonic) -> io::Result<Stream> {
    tcp.set_nonblocking(true)?;
    tcp.set_nodelay(true)?;
    acknowledge_at_once(&tcp);
    Ok(TextStream::new(
        tcp,
        clock,
        MessageShape { is_end, unfinished: UNFINISHED, incoming: INCOMING, outgoing: OUTGOING },
    ))
}

/// Requests an immediate TCP acknowledgement, because the other end may hold back its next message until then. The
/// kernel delays acknowledgements unless this is requested after every read: 44 ms become 0.3.
fn acknowledge_at_once(tcp: &TcpStream) {
    let on: libc::c_int = 1;
    // SAFETY: the option is valid for its length and outlives the call. A refusal only costs time.
    unsafe {
        libc::setsockopt(
            tcp.as_raw_fd(),
            libc::IPPROTO_TCP,
            libc::TCP_QUICKACK,
            (&raw const on).cast(),
            size_of_val(&on) as libc::socklen_t,
        )
    };
}

/// Reads more bytes; the loss of the connection is returned as an event.
fn fill(stream: &mut Stream) -> Result<bool, Option<Received>> {
    let filled = stream.fill()?;
    if filled {
        acknowledge_at_once(&stream.descriptor);
    }
    Ok(filled)
}

/// A connection to a gateway.
pub struct Client {
    stream: Stream,
    filter: Filter,
    listen_only: bool,
    /// A second connection for emergency frames, on which no message can be incomplete.
    emergency: TcpStream,
}

impl Client {
    /// Connects to a gateway and opens its bus.
    pub fn open(
        host: &str,
        port: u16,
        interface: &str,
        options: &Options,
        clock: Monotonic,
    ) -> Result<Client, CannotOpen> {
        let connect = || -> Result<Client, String> {
            let stream = greeted(host, port, interface, true)?;
            let emergency = greeted(host, port, interface, false)?;
            let quiet = |error: io::Error| error.to_string();
            emergency.set_nodelay(true).map_err(quiet)?;
            emergency.set_nonblocking(true).map_err(quiet)?;
            let stream = stream_of(stream, clock).map_err(quiet)?;
            Ok(Client { stream, filter: options.filter.clone(), listen_only: options.listen_only, emergency })
        };
        connect().map_err(|reason| CannotOpen {
            address: format!("socketcand:{host}:{port}/{interface}"),
            reason,
            remedy: Some(format!(
                "a gateway there: `socketcand -i {interface}` or `fric bus {interface} --tcp {port}`"
            )),
        })
    }
}

/// Connects and performs the handshake.
fn greeted(host: &str, port: u16, interface: &str, raw: bool) -> Result<TcpStream, String> {
    let addresses = (host, port).to_socket_addrs().map_err(|error| error.to_string())?;
    let mut tried = Err(io::Error::from(io::ErrorKind::AddrNotAvailable));
    for address in addresses {
        tried = TcpStream::connect_timeout(&address, PATIENCE);
        if tried.is_ok() {
            break;
        }
    }
    let mut tcp = tried.map_err(|error| error.to_string())?;
    tcp.set_read_timeout(Some(PATIENCE)).map_err(|error| error.to_string())?;
    let mut expect = |say: &str, answer: &str| {
        tcp.write_all(say.as_bytes()).map_err(|error| error.to_string())?;
        let mut heard = Vec::new();
        let mut byte = [0];
        // One byte at a time, because the bytes after the answer must not be read yet.
        while !heard.ends_with(b">") && heard.len() < UNFINISHED {
            match tcp.read(&mut byte) {
                Ok(0) => return Err("it closed the connection".to_string()),
                Ok(_) => heard.push(byte[0]),
                Err(_) => return Err(format!("it does not say `{answer}` within 2 s")),
            }
        }
        let heard = String::from_utf8_lossy(&heard);
        if heard.trim() == answer { Ok(()) } else { Err(format!("it says `{}` in place of `{answer}`", heard.trim())) }
    };
    expect("", "< hi >")?;
    expect(&format!("< open {interface} >"), "< ok >")?;
    if raw {
        expect("< rawmode >", "< ok >")?;
    }
    Ok(tcp)
}

impl Bus for Client {
    fn send(&mut self, frame: Frame) -> Result<(), Refused> {
        if frame.is_remote() || self.listen_only {
            return Err(Refused::Unable);
        }
        let mut message = [0; MESSAGE];
        let length = encode_send(&frame, &mut message);
        self.stream.send(&message[..length])
    }

    fn receive(&mut self) -> Option<Received> {
        loop {
            while let Some(message) = self.stream.incoming.message(is_end) {
                if let Some(frame) = decode_frame(message).filter(|frame| self.filter.accepts(frame)) {
                    return Some(Received::Frame(frame, self.stream.clock.now_ns()));
                }
            }
            if let Some(lost) = self.stream.tidy() {
                return Some(lost);
            }
            match fill(&mut self.stream) {
                Ok(true) => {}
                Ok(false) => return None,
                Err(gone) => return gone,
            }
        }
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

    fn prepare(&self, frame: Frame) -> Option<Prepared> {
        let mut message = [0; MESSAGE];
        let length = encode_send(&frame, &mut message);
        (!frame.is_remote()).then(|| Prepared::new(self.emergency.as_raw_fd(), &message[..length]))
    }
}

/// A gateway that accepts clients.
pub struct Server {
    listener: TcpListener,
    clock: Monotonic,
}

impl Server {
    /// Listens on a port of this machine, 0 for a free one; on all its networks if `everywhere`.
    pub fn listen(port: u16, everywhere: bool, clock: Monotonic) -> Result<Server, CannotOpen> {
        let host = if everywhere { "0.0.0.0" } else { "127.0.0.1" };
        let listener = TcpListener::bind((host, port)).and_then(|listener| {
            listener.set_nonblocking(true)?;
            Ok(listener)
        });
        let listener = listener.map_err(|error| CannotOpen {
            address: format!("TCP port {port}"),
            reason: error.to_string(),
            remedy: Some("another port, or 0 for any that is free".into()),
        })?;
        Ok(Server { listener, clock })
    }

    /// The port it listens on.
    pub fn port(&self) -> u16 {
        self.listener.local_addr().map_or(0, |address| address.port())
    }

    /// A descriptor that is readable when a client connects.
    pub fn descriptor(&self) -> RawFd {
        self.listener.as_raw_fd()
    }

    /// The next client, if one has connected.
    pub fn accept(&mut self) -> Option<Connection> {
        let (tcp, _) = self.listener.accept().ok()?;
        let mut stream = stream_of(tcp, self.clock).ok()?;
        stream.send(b"< hi >").ok()?;
        Some(Connection { stream, phase: Handshake::Greeted })
    }
}

/// A connected client.
pub struct Connection {
    stream: Stream,
    phase: Handshake,
}

/// Progress of the handshake.
#[derive(Clone, Copy, PartialEq)]
enum Handshake {
    Greeted,
    /// The client may send, and receives nothing.
    Opened,
    /// The client receives all frames from this time on.
    Raw(u64),
}

impl Connection {
    /// Executes a message; returns its frame, if it has one.
    fn heard(&mut self) -> Option<Option<Frame>> {
        let now_ns = self.stream.clock.now_ns();
        let message = self.stream.incoming.message(is_end)?;
        let text = std::str::from_utf8(message).unwrap_or_default().trim_start_matches(['<', ' ', '\n', '\r']);
        let mut words = text.split_ascii_whitespace();
        let answer: &[u8] = match (words.next(), self.phase) {
            (Some("open"), Handshake::Greeted) if words.next().is_some() => {
                self.phase = Handshake::Opened;
                b"< ok >"
            }
            (Some("rawmode"), Handshake::Opened) => {
                self.phase = Handshake::Raw(now_ns + PAUSE_NS);
                b"< ok >"
            }
            (Some("echo"), _) => b"< echo >",
            (Some("send"), Handshake::Opened | Handshake::Raw(_)) => match decode_send(words) {
                Some(frame) => {
                    // A client that sends has read the answers: frames may follow immediately.
                    if let Handshake::Raw(from_ns) = &mut self.phase {
                        *from_ns = 0;
                    }
                    return Some(Some(frame));
                }
                None => b"< error could not send frame >",
            },
            _ => b"< error unknown command >",
        };
        // An answer that does not fit is for a client that reads nothing.
        let _ = self.stream.send(answer);
        Some(None)
    }
}

impl Bus for Connection {
    fn send(&mut self, frame: Frame) -> Result<(), Refused> {
        match self.phase {
            Handshake::Raw(from_ns) if self.stream.clock.now_ns() >= from_ns => {}
            // The client does not receive yet.
            Handshake::Greeted | Handshake::Opened | Handshake::Raw(_) => return Ok(()),
        }
        if frame.is_remote() {
            return Err(Refused::Unable);
        }
        let mut message = [0; MESSAGE];
        let length = encode_frame(&frame, &mut message);
        self.stream.send(&message[..length])
    }

    fn receive(&mut self) -> Option<Received> {
        loop {
            while let Some(heard) = self.heard() {
                if let Some(frame) = heard {
                    return Some(Received::Frame(frame, self.stream.clock.now_ns()));
                }
            }
            if let Some(lost) = self.stream.tidy() {
                return Some(lost);
            }
            match fill(&mut self.stream) {
                Ok(true) => {}
                Ok(false) => {
                    self.stream.flush();
                    return None;
                }
                Err(gone) => return gone,
            }
        }
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
}

/// Encodes `< send 123 2 aa b >`, bytes without leading zeros; returns its length.
fn encode_send(frame: &Frame, message: &mut [u8; MESSAGE]) -> usize {
    let mut text = Cursor::new(&mut message[..]);
    let id = frame.id();
    let mut put = || -> io::Result<()> {
        if frame.is_extended() {
            write!(text, "< send {id:08X} ")?
        } else {
            write!(text, "< send {id:03X} ")?
        }
        write!(text, "{} ", frame.data().len())?;
        frame.data().iter().try_for_each(|byte| write!(text, "{byte:x} "))?;
        write!(text, ">")
    };
    put().expect("the longest message fits");
    text.position() as usize
}

/// Encodes `< frame 123 1700000000.123456 AABB >`; without data the field is empty, with two spaces. Returns its
/// length.
fn encode_frame(frame: &Frame, message: &mut [u8; MESSAGE]) -> usize {
    let mut text = Cursor::new(&mut message[..]);
    let id = frame.id();
    let day = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    let mut put = || -> io::Result<()> {
        if frame.is_extended() {
            write!(text, "< frame {id:08X} ")?
        } else {
            write!(text, "< frame {id:03X} ")?
        }
        write!(text, "{}.{:06} ", day.as_secs(), day.subsec_micros())?;
        frame.data().iter().try_for_each(|byte| write!(text, "{byte:02X}"))?;
        write!(text, " >")
    };
    put().expect("the longest message fits");
    text.position() as usize
}

/// Decodes the frame of `123 2 aa b`.
fn decode_send<'t>(mut words: impl Iterator<Item = &'t str>) -> Option<Frame> {
    let id = words.next()?;
    let length: usize = words.next()?.parse().ok().filter(|&length| length <= 8)?;
    let mut data = [0; 8];
    for byte in &mut data[..length] {
        *byte = u8::from_str_radix(words.next()?, 16).ok()?;
    }
    if words.next().is_some() {
        return None;
    }
    identified(id, &data[..length])
}

/// Decodes the frame of `< frame 123 1700000000.123456 AABB `.
fn decode_frame(message: &[u8]) -> Option<Frame> {
    let text = std::str::from_utf8(message).ok()?.trim_start_matches(['<', ' ', '\n', '\r']);
    let mut words = text.split_ascii_whitespace();
    if words.next() != Some("frame") {
        return None;
    }
    let (id, _stamp) = (words.next()?, words.next()?);
    let (mut data, mut length) = ([0; 8], 0);
    for digits in words.flat_map(|word| word.as_bytes().chunks(2)) {
        *data.get_mut(length)? = u8::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok()?;
        length += 1;
    }
    identified(id, &data[..length])
}

/// Three digits of identifier are 11 bits, eight are 29.
fn identified(digits: &str, data: &[u8]) -> Option<Frame> {
    let id = u32::from_str_radix(digits, 16).ok()?;
    match digits.len() {
        8 => (id < 1 << 29).then(|| Frame::extended(id, data)),
        _ => (id < 0x800).then(|| Frame::new(id, data)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_messages_both_ways() {
        for (frame, sent) in [
            (Frame::new(0x123, &[0xAA, 0x0B]), "< send 123 2 aa b >"),
            (Frame::new(0x080, &[]), "< send 080 0 >"),
            (Frame::extended(0x1234, &[0]), "< send 00001234 1 0 >"),
        ] {
            let mut message = [0; MESSAGE];
            let length = encode_send(&frame, &mut message);
            assert_eq!(String::from_utf8_lossy(&message[..length]), sent);
            assert_eq!(decode_send(sent.trim_end_matches('>').split_ascii_whitespace().skip(2)), Some(frame));
            let length = encode_frame(&frame, &mut message);
            assert_eq!(decode_frame(&message[..length - 1]), Some(frame));
        }
        let mut message = [0; MESSAGE];
        let length = encode_frame(&Frame::new(0x080, &[]), &mut message);
        assert!(message[..length].ends_with(b"  >"), "an empty field keeps its space");
    }

    #[test]
    fn what_is_no_frame_is_none() {
        for text in [
            "< frame 123 1.0 AABBCCDDEEFF00112 ",
            "< frame XYZ 1.0 AA ",
            "< frame 1234 1.0 AA ",
            "< ok ",
            "< frame 123",
        ] {
            assert_eq!(decode_frame(text.as_bytes()), None, "{text}");
        }
        for text in ["123 2 aa", "123 9 1 2 3 4 5 6 7 8 9", "123 1 100", "800 0", "123 1 a b", "FFFFFFFF 0"] {
            assert_eq!(decode_send(text.split(' ')), None, "{text}");
        }
    }

    /// The answer to a client's first frame may arrive before the pause after the handshake has ended.
    #[test]
    fn a_client_that_sends_at_once_receives_the_answer() {
        let clock = Monotonic::new();
        let mut server = Server::listen(0, false, clock).expect("a port");
        let mut tcp = TcpStream::connect(("127.0.0.1", server.port())).expect("it listens");
        tcp.set_read_timeout(Some(Duration::from_secs(10))).expect("more than 0");
        let mut connection = loop {
            if let Some(connection) = server.accept() {
                break connection;
            }
        };
        let mut tell = tcp.try_clone().expect("a second handle");
        let mut read = |length: usize| {
            let mut bytes = vec![0; length];
            tcp.read_exact(&mut bytes).expect("an answer");
            String::from_utf8(bytes).expect("a text")
        };
        assert_eq!(read(6), "< hi >");
        let mut hears = |text: &[u8]| {
            tell.write_all(text).expect("written");
            while !connection.wait(clock.now_ns() + 1_000_000_000) {}
            connection.receive()
        };
        for message in [&b"< open can0 >"[..], b"< rawmode >"] {
            assert_eq!(hears(message), None);
            assert_eq!(read(6), "< ok >");
        }
        let asked = Frame::new(0x123, &[]);
        assert!(matches!(hears(b"< send 123 0 >"), Some(Received::Frame(frame, _)) if frame == asked));
        connection.send(Frame::new(0x222, &[1])).expect("it listens");
        assert_eq!(read(11), "< frame 222");
    }

    #[test]
    fn a_gateway_with_unexpected_answers_is_refused() {
        let listener = TcpListener::bind(("127.0.0.1", 0)).expect("a port");
        let port = listener.local_addr().expect("an address").port();
        let other = std::thread::spawn(move || {
            let (mut tcp, _) = listener.accept().expect("a client");
            tcp.write_all(b"< hello >").expect("written");
        });
        let refused =
            Client::open("127.0.0.1", port, "can0", &Options::default(), Monotonic::new()).err().expect("refused");
        assert!(refused.to_string().contains("it says `< hello >` in place of `< hi >`"), "{refused}");
        other.join().expect("it ends");
    }
}
