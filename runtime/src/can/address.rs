//! Addresses of buses as text.
//!
//! In: `sim:bench`, `socketcan:can0` or just `can0`, `slcan:/dev/ttyACM0@1000000`, `socketcand:host:29536/can0`,
//! `replay:file.log`. Out: an [`Address`], or a message about the error in the text.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

/// Address of a bus.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Address {
    /// A simulated bus within the process, by name.
    Sim(String),
    /// A kernel interface.
    SocketCan(String),
    /// A serial adapter, or a pseudo-terminal with the same protocol.
    Slcan {
        /// The terminal.
        path: PathBuf,
        /// Bit rate on the CAN side, bits per second; none: the rig's.
        bit_rate: Option<u32>,
    },
    /// A TCP gateway.
    Socketcand {
        /// Host name or number.
        host: String,
        /// Port, 29536 by convention.
        port: u16,
        /// Name of the bus at the gateway.
        interface: String,
    },
    /// A log of candump.
    Replay(PathBuf),
}

/// Default port of socketcand.
pub const SOCKETCAND_PORT: u16 = 29_536;

/// All kinds with an example, for messages.
const KINDS: &str = "sim:bench, can0 (or socketcan:can0), slcan:/dev/ttyACM0@1000000, socketcand:host:29536/can0 or \
                     replay:file.log";

impl FromStr for Address {
    type Err = String;

    fn from_str(text: &str) -> Result<Address, String> {
        let some = |rest: &str, what: &str| match rest {
            "" => Err(format!("`{text}` lacks {what}")),
            rest => Ok(rest.to_string()),
        };
        match text.split_once(':') {
            Some(("sim", name)) => Ok(Address::Sim(some(name, "the name of a simulated bus: sim:bench")?)),
            Some(("socketcan", name)) => interface(text, name),
            Some(("slcan", rest)) => {
                let (path, bit_rate) = match rest.rsplit_once('@') {
                    Some((path, bit_rate)) => (path, Some(slcan_bit_rate(bit_rate)?)),
                    None => (rest, None),
                };
                Ok(Address::Slcan { path: some(path, "a terminal: slcan:/dev/ttyACM0@1000000")?.into(), bit_rate })
            }
            Some(("socketcand", rest)) => {
                let (server, name) = rest.split_once('/').unwrap_or((rest, ""));
                let (host, port) = match server.rsplit_once(':') {
                    Some((host, port)) => {
                        let wrong = |_| format!("`{port}` in `{text}` is no TCP port: 1 to 65535");
                        (host, port.parse().map_err(wrong)?)
                    }
                    None => (server, SOCKETCAND_PORT),
                };
                Ok(Address::Socketcand {
                    host: some(host, "a host: socketcand:host:29536/can0")?,
                    port,
                    interface: some(name, "the gateway's name of the bus: socketcand:host:29536/can0")?,
                })
            }
            Some(("replay", path)) => Ok(Address::Replay(some(path, "a log: replay:file.log")?.into())),
            Some((kind, _)) => Err(format!("`{kind}` is no kind of bus; there are {KINDS}")),
            None => interface(text, text),
        }
    }
}

/// A kernel interface: its name has at most 15 bytes, without `/` and white space.
fn interface(text: &str, name: &str) -> Result<Address, String> {
    let fits = !name.is_empty() && name.len() < 16 && !name.contains(|c: char| c == '/' || c.is_whitespace());
    if fits {
        Ok(Address::SocketCan(name.into()))
    } else {
        Err(format!("`{text}` is no address of a bus; there are {KINDS}"))
    }
}

/// Bit rates of the slcan commands `S0` to `S8`.
pub const SLCAN_BIT_RATES: [u32; 9] = [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 750_000, 1_000_000];

fn slcan_bit_rate(text: &str) -> Result<u32, String> {
    let known = text.parse().ok().filter(|rate| SLCAN_BIT_RATES.contains(rate));
    known.ok_or_else(|| {
        let rates: Vec<String> = SLCAN_BIT_RATES.iter().map(u32::to_string).collect();
        format!("`{text}` is no bit rate of slcan; there are {}", rates.join(", "))
    })
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Address::Sim(name) => write!(f, "sim:{name}"),
            Address::SocketCan(name) => write!(f, "socketcan:{name}"),
            Address::Slcan { path, bit_rate: Some(bit_rate) } => write!(f, "slcan:{}@{bit_rate}", path.display()),
            Address::Slcan { path, bit_rate: None } => write!(f, "slcan:{}", path.display()),
            Address::Socketcand { host, port, interface } => write!(f, "socketcand:{host}:{port}/{interface}"),
            Address::Replay(path) => write!(f, "replay:{}", path.display()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_survive_formatting_and_parsing() {
        for (text, written) in [
            ("can0", "socketcan:can0"),
            ("socketcan:vcan1", "socketcan:vcan1"),
            ("sim:bench", "sim:bench"),
            ("slcan:/dev/ttyACM0@1000000", "slcan:/dev/ttyACM0@1000000"),
            ("slcan:/tmp/a@b@500000", "slcan:/tmp/a@b@500000"),
            ("slcan:/dev/ttyACM0", "slcan:/dev/ttyACM0"),
            ("socketcand:bench/can0", "socketcand:bench:29536/can0"),
            ("socketcand:127.0.0.1:4000/can0", "socketcand:127.0.0.1:4000/can0"),
            ("replay:a b.log", "replay:a b.log"),
        ] {
            let address: Address = text.parse().expect("an address");
            assert_eq!(address.to_string(), written);
            assert_eq!(written.parse(), Ok(address));
        }
    }

    #[test]
    fn errors_of_an_address_are_reported() {
        for (text, said) in [
            ("", "no address of a bus"),
            ("sim:", "lacks the name"),
            ("a/b", "no address of a bus"),
            ("vector:0", "`vector` is no kind of bus; there are sim:bench"),
            ("slcan:/dev/ttyACM0@1e6", "no bit rate of slcan; there are 10000"),
            ("slcan:@500000", "lacks a terminal"),
            ("socketcand:host:99999/can0", "`99999` in `socketcand:host:99999/can0` is no TCP port"),
            ("socketcand:host", "lacks the gateway's name"),
            ("replay:", "lacks a log"),
        ] {
            let error = text.parse::<Address>().expect_err(text);
            assert!(error.contains(said), "{text}: {error}");
        }
    }
}
