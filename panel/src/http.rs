//! Requests of browsers: which are answered, and with what.
//!
//! In: the head of a request. Out: a file of the page, a socket, or a refusal. The page holds no data; a socket shows
//! none before it has sent the key. A page of somebody else in the same browser reaches 127.0.0.1 too, also under a
//! name of its own (DNS rebinding), so `Host` and `Origin` must be exactly ours. The only file that uses the httparse
//! crate.

use crate::page::{self, File};
use std::io::{self, Read};
use std::net::TcpStream;
use std::time::{Duration, Instant};
use tungstenite::handshake::derive_accept_key;

/// Longest head of a request.
const LONGEST: usize = 8192;
/// Time for a whole head.
const PATIENCE: Duration = Duration::from_secs(2);

/// What a request gets.
pub enum Answer {
    /// A file of the page.
    File(&'static File),
    /// A socket: the value of `Sec-WebSocket-Accept`.
    Socket(String),
    /// A refusal: status line and a sentence.
    Refused(&'static str, &'static str),
}

/// The head of a request.
pub struct Head {
    /// Its bytes, with the empty line that ends it.
    pub bytes: Vec<u8>,
    /// What came after it.
    pub rest: Vec<u8>,
}

/// Reads a head.
///
/// # Errors
/// Of the connection. A head that is malformed, too long or too slow is answered with the inner error.
pub fn head(stream: &mut TcpStream) -> io::Result<Result<Head, Answer>> {
    let begun = Instant::now();
    let mut bytes = Vec::new();
    let mut piece = [0; 2048];
    loop {
        let Some(left) = PATIENCE.checked_sub(begun.elapsed()).filter(|left| !left.is_zero()) else {
            return Ok(Err(Answer::Refused("408 Request Timeout", "a request is sent within 2 s")));
        };
        stream.set_read_timeout(Some(left))?;
        let n = match stream.read(&mut piece) {
            Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(n) => n,
            Err(error) if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => continue,
            Err(error) => return Err(error),
        };
        bytes.extend_from_slice(&piece[..n]);
        if let Some(end) = bytes.windows(4).position(|four| four == b"\r\n\r\n") {
            let rest = bytes.split_off(end + 4);
            return Ok(Ok(Head { bytes, rest }));
        }
        if bytes.len() > LONGEST {
            return Ok(Err(Answer::Refused(
                "431 Request Header Fields Too Large",
                "the head of a request has at most 8 kB",
            )));
        }
    }
}

/// Judges a head. `ours`: the names, with their ports, under which the page is asked for.
pub fn answer(head: &[u8], ours: &[String]) -> Answer {
    const BAD: &str = "400 Bad Request";
    let mut headers = [httparse::EMPTY_HEADER; 64];
    let mut request = httparse::Request::new(&mut headers);
    if !request.parse(head).is_ok_and(|status| status.is_complete()) {
        return Answer::Refused(BAD, "this is not a request");
    }
    // The value of a header that is there once; two of the same could be read in two ways.
    let one = |name: &str| {
        let mut all = request.headers.iter().filter(|header| header.name.eq_ignore_ascii_case(name));
        match (all.next(), all.next()) {
            (Some(header), None) => std::str::from_utf8(header.value).ok().map(str::trim),
            _ => None,
        }
    };
    if !one("host").is_some_and(|host| ours.iter().any(|own| own == host)) {
        return Answer::Refused("421 Misdirected Request", "this panel is only at the address in its link");
    }
    if request.method != Some("GET") {
        return Answer::Refused("405 Method Not Allowed", "a panel answers GET");
    }
    let path = request.path.unwrap_or_default();
    if path != "/socket" {
        return match page::file(path) {
            Some(file) => Answer::File(file),
            None => Answer::Refused("404 Not Found", "there is no such file"),
        };
    }
    if !one("origin").is_some_and(|origin| ours.iter().any(|own| origin == format!("http://{own}"))) {
        return Answer::Refused("403 Forbidden", "a socket is for the page of this panel");
    }
    let has = |name: &str, wanted: &str| {
        one(name).is_some_and(|value| value.split(',').any(|word| word.trim().eq_ignore_ascii_case(wanted)))
    };
    match one("sec-websocket-key") {
        Some(key)
            if has("upgrade", "websocket") && has("connection", "upgrade") && has("sec-websocket-version", "13") =>
        {
            Answer::Socket(derive_accept_key(key.as_bytes()))
        }
        _ => Answer::Refused(BAD, "this address is for sockets"),
    }
}

/// The bytes of a response.
pub fn response(answer: &Answer) -> Vec<u8> {
    const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; \
        img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
    let (status, media, bytes) = match answer {
        Answer::Socket(accept) => {
            return format!(
                "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: {accept}\r\n\r\n"
            )
            .into_bytes();
        }
        Answer::File(file) => ("200 OK", file.media, file.bytes),
        Answer::Refused(status, words) => (*status, "text/plain; charset=utf-8", words.as_bytes()),
    };
    let mut out = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {media}\r\nContent-Length: {}\r\nConnection: close\r\n\
         Content-Security-Policy: {POLICY}\r\nX-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n\
         Cache-Control: no-store\r\nCross-Origin-Opener-Policy: same-origin\r\n\
         Cross-Origin-Resource-Policy: same-origin\r\n\r\n",
        bytes.len()
    )
    .into_bytes();
    out.extend_from_slice(bytes);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ours() -> [String; 2] {
        ["127.0.0.1:7420", "localhost:7420"].map(String::from)
    }

    fn status(head: &str) -> String {
        match answer(head.as_bytes(), &ours()) {
            Answer::File(file) => file.path.into(),
            Answer::Socket(accept) => accept,
            Answer::Refused(status, _) => status[..3].into(),
        }
    }

    fn get(path: &str, headers: &str) -> String {
        status(&format!("GET {path} HTTP/1.1\r\n{headers}\r\n"))
    }

    const OWN: &str = "Host: 127.0.0.1:7420\r\n";
    /// Key and accept value of RFC 6455, section 1.3.
    const SOCKET: &str = "Upgrade: websocket\r\nConnection: keep-alive, Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n";

    #[test]
    fn only_our_own_name_is_answered() {
        assert_eq!(get("/", OWN), "/page.html");
        assert_eq!(get("/main.js", "host: localhost:7420\r\n"), "/main.js");
        for host in [
            "127.0.0.1",
            "127.0.0.1:7421",
            "localhost",
            "127.evil.test:7420",
            "evil.test:7420",
            "127.0.0.1:7420.evil.test",
            "[::1]:7420",
            "",
        ] {
            assert_eq!(get("/", &format!("Host: {host}\r\n")), "421", "{host}");
            assert_eq!(get("/socket", &format!("Host: {host}\r\nOrigin: http://{host}\r\n{SOCKET}")), "421", "{host}");
        }
        assert_eq!(get("/", ""), "421");
        assert_eq!(get("/", &format!("{OWN}Host: evil.test\r\n")), "421");
    }

    #[test]
    fn only_our_own_page_gets_a_socket() {
        let with = |origin: &str| get("/socket", &format!("{OWN}{origin}{SOCKET}"));
        assert_eq!(with("Origin: http://127.0.0.1:7420\r\n"), "s3pPLMBiTxaQ9kYGzzhZRbK+xOo=");
        assert_eq!(with("Origin: http://localhost:7420\r\n"), "s3pPLMBiTxaQ9kYGzzhZRbK+xOo=");
        for origin in [
            "http://127.0.0.1:7421",
            "http://localhost",
            "https://127.0.0.1:7420",
            "file://",
            "null",
            "http://127.evil.test:7420",
        ] {
            assert_eq!(with(&format!("Origin: {origin}\r\n")), "403", "{origin}");
        }
        assert_eq!(with(""), "403");
        assert_eq!(with("Origin: http://127.0.0.1:7420\r\nOrigin: http://evil.test\r\n"), "403");
        let own = format!("{OWN}Origin: http://127.0.0.1:7420\r\n");
        assert_eq!(get("/socket", &own), "400");
        assert_eq!(get("/socket", &format!("{own}{}", SOCKET.replace("13", "12"))), "400");
    }

    #[test]
    fn other_requests_are_refused() {
        assert_eq!(status(&format!("POST / HTTP/1.1\r\n{OWN}\r\n")), "405");
        for path in
            ["/../Cargo.toml", "/page", "//page.html", "/%70age.html", "http://127.0.0.1:7420/", "/page.html?key=1"]
        {
            assert_eq!(get(path, OWN), "404", "{path}");
        }
        for head in ["", "GET", "GET / HTTP/9\r\n\r\n", "\0\r\n\r\n", "GET / HTTP/1.1\r\nHost\r\n\r\n"] {
            assert_eq!(status(head), "400", "{head:?}");
        }
        let many = "a: b\r\n".repeat(65);
        assert_eq!(get("/", &format!("{many}{OWN}")), "400");
    }

    /// A generator of the tests.
    struct Chance(u64);

    impl Chance {
        fn below(&mut self, n: usize) -> usize {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (self.0 >> 33) as usize % n
        }

        fn one<'a>(&mut self, of: &[&'a str]) -> &'a str {
            of[self.below(of.len())]
        }

        /// A text with up to two small changes; half of them have none.
        fn changed(&mut self, text: &str) -> String {
            const SIGNS: &[u8] = b"0127.:/aeLlo[]@%-#? \tx";
            let mut bytes = text.as_bytes().to_vec();
            for _ in 0..self.below(4).saturating_sub(1) {
                let (at, sign) = (self.below(bytes.len()), SIGNS[self.below(SIGNS.len())]);
                match self.below(4) {
                    0 => bytes.insert(at, sign),
                    1 => bytes[at] = sign,
                    2 if bytes.len() > 1 => drop(bytes.remove(at)),
                    _ => bytes.push(sign),
                }
            }
            String::from_utf8(bytes).unwrap()
        }
    }

    /// Random requests, judged by what they were made of: one `Host` that is exactly ours, and for a socket one `Origin`
    /// that is exactly ours. Names that begin, end or look like ours are among the changes.
    #[test]
    fn a_request_is_answered_if_and_only_if_its_host_and_origin_are_exactly_ours() {
        const NAMES: [&str; 2] = ["127.0.0.1:7420", "localhost:7420"];
        const ODD: [&str; 12] = [
            "127.0.0.1",
            "localhost",
            "localhost:7421",
            "127.0.0.1:07420",
            "127.1:7420",
            "2130706433:7420",
            "0.0.0.0:7420",
            "[::1]:7420",
            "127.evil.test:7420",
            "127.0.0.1:7420.evil.test",
            "user@127.0.0.1:7420",
            "LOCALHOST:7420",
        ];
        let mut answered = [0; 3];
        for seed in 1..=30_000 {
            let mut chance = Chance(seed);
            let name = |chance: &mut Chance| match chance.below(4) {
                0 => chance.one(&ODD).to_string(),
                _ => {
                    let own = chance.one(&NAMES);
                    chance.changed(own)
                }
            };
            let number = |chance: &mut Chance| [1, 1, 1, 1, 1, 1, 0, 2][chance.below(8)];
            let hosts: Vec<String> = (0..number(&mut chance)).map(|_| name(&mut chance)).collect();
            let origin = |chance: &mut Chance| match chance.below(8) {
                0 => chance
                    .one(&["null", "file://", "https://127.0.0.1:7420", "http://", "http://127.0.0.1:7420/"])
                    .into(),
                1 => {
                    let own = format!("http://{}", chance.one(&NAMES));
                    chance.changed(&own)
                }
                _ => format!("http://{}", name(chance)),
            };
            let origins: Vec<String> = (0..number(&mut chance)).map(|_| origin(&mut chance)).collect();
            let path = chance.one(&["/", "/main.js", "/socket", "/socket", "/socket", "/none"]);
            let mut lines: Vec<String> = Vec::new();
            for host in &hosts {
                lines.push(format!("{}: {host}", chance.one(&["Host", "host", "HOST"])));
            }
            lines.extend(origins.iter().map(|origin| format!("Origin: {origin}")));
            let upgrades = chance.below(8) > 0;
            if upgrades {
                lines.extend(SOCKET.trim_end().split("\r\n").map(str::to_string));
            }
            for at in (1..lines.len()).rev() {
                lines.swap(at, chance.below(at + 1));
            }
            let ours = |given: &[String], before: &str| match given {
                [one] => NAMES.iter().any(|name| one.trim_matches([' ', '\t']) == format!("{before}{name}")),
                _ => false,
            };
            let wanted = match path {
                _ if !ours(&hosts, "") => "421",
                "/" => "/page.html",
                "/main.js" => "/main.js",
                "/none" => "404",
                _ if !ours(&origins, "http://") => "403",
                _ if !upgrades => "400",
                _ => "s3pPLMBiTxaQ9kYGzzhZRbK+xOo=",
            };
            let head = format!("GET {path} HTTP/1.1\r\n{}\r\n\r\n", lines.join("\r\n"));
            assert_eq!(status(&head), wanted, "seed {seed}: {head}");
            answered[match wanted.len() {
                3 => 0,
                28 => 2,
                _ => 1,
            }] += 1;
        }
        assert!(answered.iter().all(|n| *n > 500), "{answered:?}: refused, files, sockets");
    }

    /// Bytes that no browser sends: no panic, and no socket unless our origin is still there.
    #[test]
    fn no_head_of_random_bytes_panics_or_opens_a_socket() {
        let whole = format!("GET /socket HTTP/1.1\r\n{OWN}Origin: http://127.0.0.1:7420\r\n{SOCKET}\r\n").into_bytes();
        for seed in 1..=30_000 {
            let mut chance = Chance(seed);
            let mut bytes = whole.clone();
            for _ in 0..1 + chance.below(3) {
                let at = chance.below(bytes.len());
                match chance.below(3) {
                    0 if at > 0 => bytes.truncate(at),
                    1 => bytes[at] = chance.below(256) as u8,
                    _ => bytes.insert(at, chance.below(256) as u8),
                }
            }
            if let Answer::Socket(_) = answer(&bytes, &ours()) {
                let text = String::from_utf8_lossy(&bytes).to_ascii_lowercase();
                let origin = text.lines().find_map(|line| line.strip_prefix("origin:")).map(str::trim);
                assert_eq!(origin, Some("http://127.0.0.1:7420"), "seed {seed}");
            }
        }
    }

    #[test]
    fn responses_forbid_everything_that_the_page_does_not_need() {
        let text =
            String::from_utf8(response(&answer(format!("GET / HTTP/1.1\r\n{OWN}\r\n").as_bytes(), &ours()))).unwrap();
        for header in
            ["default-src 'none'", "frame-ancestors 'none'", "nosniff", "no-referrer", "no-store", "Connection: close"]
        {
            assert!(text.contains(header), "{header}");
        }
    }
}
