use super::*;
use crate::frame::{Block, Frame, PATH};
use crate::line::{self, View};
use crate::subject::Page;
use runtime::rng::Chance;
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::sync::Mutex;
use std::sync::atomic::AtomicU64;
use std::time::Instant;
use tungstenite::protocol::Role;
use tungstenite::{Message, WebSocket};

/// A subject whose only curve is its version.
#[derive(Default)]
struct Counting {
    version: AtomicU64,
    said: Mutex<Vec<String>>,
}

impl Subject for Counting {
    fn hello(&self) -> (u64, Value) {
        (1, json!({ "title": "counting" }))
    }
    fn state(&self) -> (u64, Value) {
        (1, json!({}))
    }
    fn numbers(&self) -> (u64, u64) {
        (self.hello().0, self.state().0)
    }
    fn version(&self) -> u64 {
        self.version.load(Ordering::SeqCst)
    }
    fn newest(&self) -> f64 {
        0.0
    }
    fn blocks(&self, view: &View, _: Option<u64>, frame: &mut Frame) {
        let points = vec![(0.0, self.version() as f64); 4000];
        frame.path(Block { kind: PATH, view: view.id, curve: 0, cycles: 0, first: 0.0 }, &points);
    }
    /// A ramp that starts anew each second.
    fn points(&self, curve: u32, from: f64, each: &mut dyn FnMut(f64, f64) -> bool) {
        let first = (from * 100.0).max(0.0) as u32;
        (first.saturating_sub(1)..500)
            .take_while(|_| curve == 0)
            .all(|k| each(f64::from(k) / 100.0, f64::from(k % 100)));
    }
    fn say(&self, page: Page, words: &str) -> Result<String, String> {
        assert!(!page.guest || line::stops(words), "{words}");
        self.said.lock().unwrap().push(words.into());
        if words == "no" { Err("not \u{202e}now".into()) } else { Ok("yes".into()) }
    }
}

struct Open {
    subject: Arc<Counting>,
    bell: Bell,
    port: u16,
    key: String,
}

fn open() -> Open {
    let (subject, bell) = (Arc::new(Counting::default()), Bell::default());
    let panel = Panel::open(0, subject.clone(), bell.clone()).unwrap();
    let link = panel.link();
    let (port, key) =
        (link.split(['/', ':']).nth(4).unwrap().parse().unwrap(), link.split_once('#').unwrap().1.to_string());
    thread::spawn(move || panel.serve());
    Open { subject, bell, port, key }
}

impl Open {
    fn stream(&self, request: &str) -> TcpStream {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        stream
    }

    /// The whole answer to a request.
    fn get(&self, path: &str) -> String {
        let mut stream = self.stream(&format!("GET {path} HTTP/1.1\r\nHost: localhost:{}\r\n\r\n", self.port));
        let mut text = String::new();
        stream.read_to_string(&mut text).unwrap();
        text
    }

    fn socket(&self, first: &str) -> WebSocket<TcpStream> {
        let own = format!("127.0.0.1:{}", self.port);
        let mut stream = self.stream(&format!(
            "GET /socket HTTP/1.1\r\nHost: {own}\r\nOrigin: http://{own}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
             Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        ));
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            stream.read_exact(&mut byte).unwrap();
            head.push(byte[0]);
        }
        assert!(head.starts_with(b"HTTP/1.1 101 "), "{}", String::from_utf8_lossy(&head));
        let mut socket = WebSocket::from_raw_socket(stream, Role::Client, None);
        if !first.is_empty() {
            socket.send(Message::text(first)).unwrap();
        }
        socket
    }

    fn viewer(&self) -> WebSocket<TcpStream> {
        let mut socket = self.socket(&format!("key {}", self.key));
        assert!(text(&mut socket).contains("\"hello\"") && text(&mut socket).contains("\"state\""));
        assert_eq!(number(&frame(&mut socket)), 1);
        socket
    }
}

fn text(socket: &mut WebSocket<TcpStream>) -> String {
    loop {
        match socket.read().unwrap() {
            Message::Text(text) => return text.as_str().into(),
            Message::Close(why) => return format!("closed: {why:?}"),
            _ => {}
        }
    }
}

fn frame(socket: &mut WebSocket<TcpStream>) -> Vec<u8> {
    loop {
        if let Message::Binary(bytes) = socket.read().unwrap() {
            return bytes.to_vec();
        }
    }
}

fn number(frame: &[u8]) -> u32 {
    u32::from_le_bytes(frame[..4].try_into().unwrap())
}

fn value(frame: &[u8]) -> f64 {
    f64::from_le_bytes(frame[40..48].try_into().unwrap())
}

#[test]
fn the_page_is_served_and_holds_no_key() {
    let open = open();
    for file in crate::page::FILES {
        let text = open.get(file.path);
        assert!(text.starts_with("HTTP/1.1 200 OK\r\n"), "{}", file.path);
        assert!(text.ends_with(std::str::from_utf8(file.bytes).unwrap()) && !text.contains(&open.key));
    }
    assert!(open.get("/key").starts_with("HTTP/1.1 404 "));
}

#[test]
fn without_the_key_nothing_is_told_and_nothing_obeyed() {
    let open = open();
    let half = &open.key[..16];
    for first in
        ["key wrong".into(), format!("key {half}"), "1 yes".to_string(), "key".into(), "view 0 0 all 10".into()]
    {
        let mut socket = open.socket(&first);
        // Lines after the wrong first one are not read either.
        let _ = socket.send(Message::text(format!("key {}", open.key)));
        let _ = socket.send(Message::text("2 yes"));
        let told = text(&mut socket);
        assert!(told.starts_with("closed: ") && told.contains("wrong key"), "{first}: {told}");
    }
    assert!(open.subject.said.lock().unwrap().is_empty());
    // One that says nothing is left after two seconds.
    let begun = Instant::now();
    let mut silent = open.socket("");
    assert!(matches!(silent.read(), Ok(Message::Close(_)) | Err(_)));
    assert!((1..10).contains(&begun.elapsed().as_secs()), "{:?}", begun.elapsed());
    // And so is one that sends the head of a message, and then a byte now and then.
    let mut slow = open.socket("");
    let begun = Instant::now();
    let stream = slow.get_mut();
    let mut byte = [0];
    stream.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
    let _ = stream.write_all(&[0x81, 0x80 | 100, 0, 0, 0, 0]);
    let left = (0..90).any(|_| {
        let _ = stream.write_all(b"k");
        stream.read(&mut byte).is_ok()
    });
    assert!(left && begun.elapsed().as_secs() < 8, "{:?}", begun.elapsed());
}

/// The door for others has a name and a key of its own: neither key opens the other door, and a guest's lines but `stop`
/// are refused whatever stands before and around them.
///
/// Mutants tried: one key for both doors; the names of one door at the other; `stop` as a prefix; no check at all.
#[test]
fn guests_look_and_may_stop_and_no_more() {
    let (subject, bell) = (Arc::new(Counting::default()), Bell::default());
    let panel = Panel::open(0, subject.clone(), bell.clone()).unwrap();
    let panel = panel.shared_at("127.0.0.1:0".parse().unwrap()).unwrap();
    let [own, share] = [panel.link(), panel.share_link().unwrap()].map(|link| {
        let (address, key) = link.trim_start_matches("http://").split_once("/#").unwrap();
        (address.rsplit_once(':').unwrap().1.parse::<u16>().unwrap(), key.to_string())
    });
    assert!(own.0 != share.0 && own.1 != share.1);
    thread::spawn(move || panel.serve());
    let door = |port, key: &str| Open { subject: subject.clone(), bell: bell.clone(), port, key: key.into() };
    for (port, key) in [(own.0, &share.1), (share.0, &own.1)] {
        let told = text(&mut door(port, key).socket(&format!("key {key}")));
        assert!(told.contains("wrong key"), "{told}");
    }
    // `localhost` is a name of the own door only.
    assert!(door(own.0, "").get("/").starts_with("HTTP/1.1 200 "));
    assert!(door(share.0, "").get("/").starts_with("HTTP/1.1 421 "));
    let mut guest = door(share.0, &share.1).viewer();
    for line in [
        "1 yes",
        "1 @0 set a = 1",
        "1 @0 arm",
        "1 stop now",
        "1 nonstop",
        "1 @stop",
        "1 take",
        "1 @0 @0 stop",
        "1 again",
    ] {
        guest.send(Message::text(line)).unwrap();
        let told = text(&mut guest);
        assert!(told.contains("this link is for looking"), "{line}: {told}");
    }
    assert_eq!(*subject.said.lock().unwrap(), [""; 0]);
    for line in ["1 stop", "2 @0 stop", "3 @-9 stop", "4 @nan stop"] {
        guest.send(Message::text(line)).unwrap();
        assert!(text(&mut guest).contains("\"ok\""), "{line}");
    }
    assert_eq!(subject.said.lock().unwrap().len(), 4);
    // It looks.
    guest.send(Message::text("ack 1")).unwrap();
    guest.send(Message::text("view 0 0 all 10")).unwrap();
    assert_eq!(number(&frame(&mut guest)), 2);
    // Both have their numbers, in the order of coming.
    assert_eq!(bell.viewers(), 1);
    let mut socket = door(own.0, &own.1).socket(&format!("key {}", own.1));
    let told = text(&mut socket);
    assert!(told.contains("\"page\":2") && told.contains("\"guest\":false"), "{told}");
    let refused = Panel::open(0, subject, bell).unwrap().shared_at("0.0.0.0:0".parse().unwrap());
    assert!(refused.err().is_some_and(|why| why.contains("name one of this computer")));
}

/// Frames of the protocol and what is nearly such: final or not, with or without reserved bits, any opcode, masked or not,
/// and any length.
fn frames(seed: u64) -> Vec<u8> {
    let mut chance = Chance(seed);
    let mut below = |n: u64| chance.below(n);
    let mut bytes = Vec::new();
    for _ in 0..1 + below(4) {
        let text: &[u8] = match below(4) {
            0 => b"1 yes",
            1 => b"view 0 0 all 10",
            2 => b"key 00000000000000000000000000000000",
            _ => b"ack 1",
        };
        let (first, masked) = ((below(256) as u8) & if below(2) == 0 { 0xff } else { 0x81 }, below(8) > 0);
        let length = if below(4) == 0 { below(126) as u8 } else { text.len() as u8 };
        bytes.extend([first, length | if masked { 0x80 } else { 0 }]);
        if masked {
            bytes.extend([0; 4]);
        }
        bytes.extend(text);
        if below(3) == 0 {
            bytes.push(below(256) as u8);
        }
    }
    bytes
}

/// Sends bytes and no more; returns everything that comes back.
fn answer_to(socket: &mut WebSocket<TcpStream>, bytes: &[u8]) -> String {
    let stream = socket.get_mut();
    let _ = stream.write_all(bytes);
    let _ = stream.shutdown(Shutdown::Write);
    let mut told = Vec::new();
    let _ = stream.read_to_end(&mut told);
    String::from_utf8_lossy(&told).into_owned()
}

/// Whatever comes before the right key: whole frames of every kind, broken ones, and bytes that are no frames. None of
/// it is obeyed, the stranger receives no data, and the panel continues to serve.
#[test]
fn nothing_before_the_key_is_obeyed() {
    let open = open();
    for seed in 1..=80 {
        let told = answer_to(&mut open.socket(""), &frames(seed));
        assert!(!told.contains("hello") && !told.contains("state") && !told.contains("answer"), "seed {seed}: {told}");
        assert_eq!(*open.subject.said.lock().unwrap(), [""; 0], "seed {seed}");
    }
    open.viewer();
}

/// A viewer that sends anything ends its own connection at most.
#[test]
fn no_bytes_end_the_server() {
    let open = open();
    let mut watching = open.viewer();
    let mut obeyed = 0;
    for seed in 1..=200 {
        answer_to(&mut open.viewer(), &frames(seed));
        obeyed += open.subject.said.lock().unwrap().drain(..).filter(|words| words == "yes").count();
        if seed % 20 == 0 {
            watching.send(Message::text(format!("{seed} yes"))).expect("it is connected");
            assert_eq!(text(&mut watching), format!(r#"{{"kind":"answer","number":{seed},"ok":"yes"}}"#));
        }
    }
    assert!(obeyed > 10, "{obeyed} of the frames are lines");
}

#[test]
fn strangers_do_not_keep_viewers_out() {
    let open = open();
    let strangers: Vec<TcpStream> = (0..40).map(|_| open.stream("GET / HTT")).collect();
    let mut refused = String::new();
    open.stream("").read_to_string(&mut refused).unwrap();
    assert!(refused.starts_with("HTTP/1.1 503 "), "{refused}");
    drop(strangers);
    let served = (0..100).any(|_| {
        thread::sleep(Duration::from_millis(50));
        open.get("/").starts_with("HTTP/1.1 200 ")
    });
    assert!(served, "nobody is left, and the page is still refused");
}

#[test]
fn lines_are_answered_under_their_numbers() {
    let open = open();
    let mut socket = open.viewer();
    for (line, answer) in [
        ("17 yes sir", r#"{"kind":"answer","number":17,"ok":"yes"}"#),
        ("4 no", r#"{"kind":"answer","number":4,"refused":"not \\u{202e}now"}"#),
        ("view 99 0 all 10", r#"{"kind":"answer","number":null,"refused":"views have the numbers 0 to 31"}"#),
    ] {
        socket.send(Message::text(line)).unwrap();
        assert_eq!(text(&mut socket), answer);
    }
    assert_eq!(*open.subject.said.lock().unwrap(), ["yes sir", "no"]);
    socket.send(Message::Ping(vec![1, 2].into())).unwrap();
    assert_eq!(socket.read().unwrap(), Message::Pong(vec![1, 2].into()));
}

#[test]
fn what_is_no_line_ends_the_connection() {
    let open = open();
    for message in [Message::binary(vec![0; 10]), Message::text("1 ".repeat(2500))] {
        let mut socket = open.viewer();
        socket.send(message).unwrap();
        let told = text(&mut socket);
        assert!(told.starts_with("closed: "), "{told}");
    }
    let mut flood = open.viewer();
    for i in 0..2000 {
        if flood.send(Message::text(format!("{i} yes"))).is_err() {
            break;
        }
    }
    let told = std::iter::repeat_with(|| flood.read()).find(|message| !matches!(message, Ok(Message::Text(_))));
    assert!(matches!(told, Some(Ok(Message::Close(_)) | Err(_))));
    assert!(open.subject.said.lock().unwrap().len() <= LINES_OF_TWO_SECONDS);
}

const LINES_OF_TWO_SECONDS: usize = 400;

#[test]
fn a_viewer_is_a_cursor_and_not_a_queue() {
    let open = open();
    let mut slow = open.viewer();
    let mut deaf = open.viewer();
    for socket in [&mut slow, &mut deaf] {
        socket.send(Message::text("ack 1")).unwrap();
        socket.send(Message::text("view 0 0 all 1000")).unwrap();
    }
    assert_eq!(number(&frame(&mut slow)), 2);
    // A hundred viewers' worth of changes: none is sent twice, and at most two frames wait for an ack.
    for _ in 0..500 {
        open.subject.version.fetch_add(1, Ordering::SeqCst);
        open.bell.ring();
        thread::sleep(Duration::from_millis(1));
    }
    let third = frame(&mut slow);
    assert_eq!(number(&third), 3);
    slow.get_ref().set_read_timeout(Some(Duration::from_millis(300))).unwrap();
    assert!(slow.read().is_err(), "a third frame without an ack");
    slow.get_ref().set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    // An ack of a frame that was never sent changes nothing.
    slow.send(Message::text("ack 4000000000")).unwrap();
    slow.send(Message::text("ack 3")).unwrap();
    let fourth = frame(&mut slow);
    assert_eq!((number(&fourth), value(&fourth)), (4, 500.0), "the newest, and all between left out");
    // It is level: nothing more comes.
    slow.send(Message::text("ack 4")).unwrap();
    slow.get_ref().set_read_timeout(Some(Duration::from_millis(300))).unwrap();
    assert!(slow.read().is_err());
    // The deaf one has two frames, and hears again where it left off.
    assert_eq!((number(&frame(&mut deaf)), number(&frame(&mut deaf))), (2, 3));
    assert_eq!(open.bell.viewers(), 2);
    drop(deaf);
    let alone = (0..200).any(|_| {
        thread::sleep(Duration::from_millis(20));
        open.bell.ring();
        open.bell.viewers() == 1
    });
    assert!(alone, "a viewer that has gone is still counted");
}
