//! A client that speaks the protocol of a panel by hand. Also for the gate beside a rig (`tests/can/panel.rs`).

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

/// A program of others that speaks the panel's protocol by hand.
pub struct Client(pub TcpStream);

impl Client {
    /// Connects to a panel at this address.
    pub fn connect(own: &str, key: &str, views: &[String]) -> Client {
        let mut stream = TcpStream::connect(own).unwrap();
        let request = format!(
            "GET /socket HTTP/1.1\r\nHost: {own}\r\nOrigin: http://{own}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
             Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        );
        stream.write_all(request.as_bytes()).unwrap();
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            stream.read_exact(&mut byte).unwrap();
            head.push(byte[0]);
        }
        let mut client = Client(stream);
        client.say(&format!("key {key}"));
        // What asks before the panel has said what there is asks in vain.
        std::thread::sleep(Duration::from_millis(300));
        views.iter().for_each(|view| client.say(view));
        client
    }

    /// Says a line.
    pub fn say(&mut self, line: &str) {
        let mut bytes = vec![0x81];
        match u8::try_from(line.len()) {
            Ok(short) if short < 126 => bytes.push(0x80 | short),
            _ => bytes.extend([0x80 | 126, (line.len() >> 8) as u8, line.len() as u8]),
        }
        bytes.extend([0; 4]);
        bytes.extend(line.as_bytes());
        let _ = self.0.write_all(&bytes);
    }

    /// Reads a message: its opcode and its bytes; none at the end.
    pub fn message(&mut self) -> Option<(u8, Vec<u8>)> {
        let mut head = [0; 2];
        self.0.read_exact(&mut head).ok()?;
        let length = match head[1] & 0x7f {
            126 => {
                let mut more = [0; 2];
                self.0.read_exact(&mut more).ok()?;
                usize::from(u16::from_be_bytes(more))
            }
            127 => {
                let mut more = [0; 8];
                self.0.read_exact(&mut more).ok()?;
                u64::from_be_bytes(more) as usize
            }
            short => usize::from(short),
        };
        let mut bytes = vec![0; length];
        self.0.read_exact(&mut bytes).ok()?;
        Some((head[0] & 15, bytes))
    }
}
