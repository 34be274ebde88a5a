//! Traffic as text in the format of `candump -L`: `(1436509052.249713) can0 181#AABB`.
//!
//! In: frames and times, or lines. Out: lines, or frames and times, or a message about the error in a line.

use super::Frame;
use std::fmt;

/// A frame of a log.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct LoggedFrame {
    /// Time in ns since 1970, or since the origin of the log.
    pub time_ns: u64,
    /// The interface that received it.
    pub interface: String,
    /// The frame.
    pub frame: Frame,
}

impl fmt::Display for LoggedFrame {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let (seconds, micros) = (self.time_ns / 1_000_000_000, self.time_ns / 1000 % 1_000_000);
        write!(f, "({seconds:010}.{micros:06}) {} {}", self.interface, self.frame)
    }
}

/// Parses a line. None: an empty line, a comment, or an error frame, which is no traffic. Error: the message.
pub fn entry(line: &str) -> Result<Option<LoggedFrame>, String> {
    let line = line.trim();
    if line.is_empty() || line.starts_with('#') {
        return Ok(None);
    }
    // Only the direction may follow the frame.
    let mut words = line.split_ascii_whitespace();
    let (Some(time), Some(interface), Some(frame)) = (words.next(), words.next(), words.next()) else {
        return Err(
            "a line of `candump -L` has a time, an interface and a frame: (1436509052.249713) can0 181#AABB".into()
        );
    };
    let time_ns = time
        .strip_prefix('(')
        .and_then(|time| time.strip_suffix(')'))
        .and_then(nanoseconds)
        .ok_or_else(|| format!("`{time}` is no time: (1436509052.249713)"))?;
    Ok(parse_frame(frame)?.map(|frame| LoggedFrame { time_ns, interface: interface.into(), frame }))
}

/// Parses decimal seconds without floating point, which has no resolution of nanoseconds for times since 1970.
fn nanoseconds(text: &str) -> Option<u64> {
    let (seconds, fraction) = text.split_once('.').unwrap_or((text, "0"));
    let digits = fraction.len();
    if digits == 0 || digits > 9 || !fraction.bytes().all(|digit| digit.is_ascii_digit()) {
        return None;
    }
    let seconds: u64 = seconds.parse().ok()?;
    let fraction: u64 = fraction.parse().ok()?;
    seconds.checked_mul(1_000_000_000)?.checked_add(fraction * 10u64.pow(9 - digits as u32))
}

/// Flag of an error frame in an identifier of eight digits.
const ERROR_FRAME: u32 = 0x2000_0000;

/// Parses a frame in the format of `cansend`: `181#AABB`, `00000181#`, `701#R1`. None: an error frame.
pub fn parse_frame(text: &str) -> Result<Option<Frame>, String> {
    let wrong = |what: &str| format!("`{text}` is no frame: {what}");
    let (id, data) = text.split_once('#').ok_or_else(|| wrong("write 181#AABB"))?;
    let extended = match id.len() {
        3 => false,
        8 => true,
        _ => return Err(wrong("an identifier has 3 or 8 hexadecimal digits")),
    };
    let number = u32::from_str_radix(id, 16).map_err(|_| wrong("an identifier has 3 or 8 hexadecimal digits"))?;
    if extended && number & ERROR_FRAME != 0 {
        return Ok(None);
    }
    if number >= if extended { 1 << 29 } else { 0x800 } {
        return Err(wrong("its identifier has more than 11 or 29 bits"));
    }
    if data.starts_with('#') {
        return Err(wrong("this is CAN FD, and only classical frames are known here"));
    }
    if let Some(length) = data.strip_prefix(['R', 'r']) {
        let length = if length.is_empty() { "0" } else { length };
        let length =
            length.parse().ok().filter(|&length| length <= 8).ok_or_else(|| wrong("it asks for 0 to 8 bytes: R8"))?;
        return Ok(Some(if extended { Frame::remote_extended(number, length) } else { Frame::remote(number, length) }));
    }
    let digits: Vec<u8> = data.bytes().filter(|&byte| byte != b'.').collect();
    if digits.len() % 2 == 1 || digits.len() > 16 {
        return Err(wrong("its data are 0 to 8 bytes of two digits"));
    }
    let byte = |pair: &[u8]| std::str::from_utf8(pair).ok().and_then(|pair| u8::from_str_radix(pair, 16).ok());
    let data: Option<Vec<u8>> = digits.chunks(2).map(byte).collect();
    let data = data.ok_or_else(|| wrong("its data are 0 to 8 bytes of two digits"))?;
    Ok(Some(if extended { Frame::extended(number, &data) } else { Frame::new(number, &data) }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_read_and_written() {
        for line in [
            "(1436509052.249713) vcan0 044#2A366C2BBA",
            "(0000000000.000000) can0 080#",
            "(1436509052.000001) can1 18DAF110#01",
            "(1436509052.000001) can1 701#R1",
            "(1436509052.000001) can1 00000701#R",
        ] {
            assert_eq!(entry(line).expect("a line").expect("a frame").to_string(), line);
        }
        let more = entry("(12.5) can0 181#11.22 R").expect("a line").expect("a frame");
        assert_eq!((more.time_ns, more.frame), (12_500_000_000, Frame::new(0x181, &[0x11, 0x22])));
        assert_eq!(entry("  "), Ok(None));
        assert_eq!(entry("(1.0) can0 20000004#0001000000000000"), Ok(None), "an error frame");
    }

    #[test]
    fn errors_of_a_line_are_reported() {
        for (line, said) in [
            ("can0 181#", "has a time, an interface and a frame"),
            ("(12) can0", "has a time, an interface and a frame"),
            ("(x) can0 181#", "`(x)` is no time"),
            ("(1.0) can0 181", "write 181#AABB"),
            ("(1.0) can0 18#", "3 or 8 hexadecimal digits"),
            ("(1.0) can0 FFF#", "more than 11 or 29 bits"),
            ("(1.0) can0 181##0AA", "CAN FD"),
            ("(1.0) can0 181#A", "two digits"),
            ("(1.0) can0 181#001122334455667788", "two digits"),
            ("(1.0) can0 181#éé", "two digits"),
            ("(1.0) can0 181#R9", "0 to 8 bytes: R8"),
        ] {
            let error = entry(line).expect_err(line);
            assert!(error.contains(said), "{line}: {error}");
        }
    }
}
