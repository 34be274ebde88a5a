//! One viewer: a page that is connected.
//!
//! A viewer is a cursor, not a queue. For each view the server keeps only the version of the curves that the page has; a
//! frame goes out when the page has drawn an earlier one, and carries all that has changed since. So a slow page gets
//! fewer frames of the same curves, a hidden one gets two and then none, and none costs memory.
//!
//! One thread reads and one writes, so a line is read while data cannot be written. Both sides have their own
//! `WebSocket` over the same stream; that of the reader writes nothing, and replies to pings go through the writer.

use crate::frame::Frame;
use crate::key::Key;
use crate::line::{self, Crossing, Line, View};
use crate::measures;
use crate::rows;
use crate::subject::{Page, Subject};
use serde_json::{Value, json};
use std::collections::{BTreeMap, VecDeque};
use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tungstenite::protocol::frame::coding::CloseCode;
use tungstenite::protocol::{CloseFrame, Role, WebSocketConfig};
use tungstenite::{Message, WebSocket};

/// Time for the key after the connection.
const PATIENCE: Duration = Duration::from_secs(2);
/// Time in which a write must make progress.
const DEAF: Duration = Duration::from_secs(30);
/// Frames that the page has not drawn yet.
const AHEAD: u32 = 2;
/// Lines in a second.
const LINES: u32 = 200;
/// Answers that wait to be written.
const ANSWERS: usize = 256;

/// A stream that only reads.
struct Reading {
    stream: TcpStream,
    /// Until when the key must have come; none once it has. A stranger that sends a byte now and then would otherwise
    /// keep its place for ever.
    until: Option<Instant>,
}

impl Read for Reading {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        if let Some(until) = self.until {
            let left = until.checked_duration_since(Instant::now()).filter(|left| !left.is_zero());
            self.stream.set_read_timeout(Some(left.ok_or(io::ErrorKind::TimedOut)?))?;
        }
        self.stream.read(bytes)
    }
}

impl Write for Reading {
    /// What the reader's side would write by itself, such as a pong, is dropped: the writer's side sends it.
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        Ok(bytes.len())
    }
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// What the writer has to do.
#[derive(Default)]
struct Desk {
    messages: VecDeque<Message>,
    /// The views, each with the version that the page has.
    views: BTreeMap<u16, (View, Option<u64>)>,
    sent: u32,
    acked: u32,
    /// Something may have changed.
    news: bool,
    over: bool,
}

/// One viewer.
#[derive(Default)]
pub struct Viewer {
    guest: bool,
    /// Its number, once it is known.
    number: AtomicU64,
    desk: Mutex<Desk>,
    wake: Condvar,
}

fn config() -> WebSocketConfig {
    WebSocketConfig::default()
        .max_message_size(Some(line::LONGEST))
        .max_frame_size(Some(line::LONGEST))
        .read_buffer_size(2 * line::LONGEST)
        .write_buffer_size(0)
        .max_write_buffer_size(usize::MAX)
}

impl Viewer {
    /// A connection that has not shown its key. `guest`: through the link for others.
    pub fn new(guest: bool) -> Viewer {
        Viewer { guest, ..Viewer::default() }
    }

    /// Who it is, once it is known.
    pub fn page(&self) -> Page {
        Page { number: self.number.load(Ordering::Relaxed), guest: self.guest }
    }

    fn desk(&self) -> MutexGuard<'_, Desk> {
        self.desk.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Tells it that something may have changed.
    pub fn ring(&self) {
        self.desk().news = true;
        self.wake.notify_one();
    }

    fn push(&self, message: Message) {
        let mut desk = self.desk();
        if desk.messages.len() == ANSWERS {
            desk.over = true;
        } else {
            desk.messages.push_back(message);
        }
        self.wake.notify_one();
    }

    fn end(&self, code: CloseCode, why: &str) {
        let frame = CloseFrame { code, reason: why.to_string().into() };
        self.push(Message::Close(Some(frame)));
        self.desk().over = true;
        self.wake.notify_one();
    }

    /// Reads until the connection ends. `rest`: bytes that came with the request. `known` is called once the key was
    /// right; false: there is no room.
    pub fn read(
        &self,
        stream: TcpStream,
        rest: Vec<u8>,
        key: &Key,
        subject: &dyn Subject,
        known: &mut dyn FnMut() -> bool,
    ) {
        let reading = Reading { stream, until: Some(Instant::now() + PATIENCE) };
        let mut socket = WebSocket::from_partially_read(reading, rest, Role::Server, Some(config()));
        let (mut first, mut second, mut lines) = (true, Instant::now(), 0);
        loop {
            let message = match socket.read() {
                Ok(message) => message,
                Err(tungstenite::Error::Capacity(_)) => return self.end(CloseCode::Size, "a message has at most 4 kB"),
                Err(_) if first => return self.end(CloseCode::Policy, "the key comes first, within 2 s"),
                Err(_) => return self.end(CloseCode::Normal, ""),
            };
            if second.elapsed() >= Duration::from_secs(1) {
                (second, lines) = (Instant::now(), 0);
            }
            lines += 1;
            if lines > LINES {
                return self.end(CloseCode::Policy, "at most 200 messages a second");
            }
            let text = match message {
                Message::Text(text) => text,
                Message::Ping(payload) => {
                    self.push(Message::Pong(payload));
                    continue;
                }
                Message::Pong(_) => continue,
                Message::Close(_) => return self.end(CloseCode::Normal, ""),
                Message::Binary(_) | Message::Frame(_) => {
                    return self.end(CloseCode::Unsupported, "messages are lines");
                }
            };
            if first {
                match line::read(&text) {
                    Ok(Line::Key(given)) if key.is(given) => {}
                    _ => return self.end(CloseCode::Policy, "wrong key"),
                }
                if !known() {
                    return self.end(CloseCode::Again, "too many viewers");
                }
                let reading = socket.get_mut();
                reading.until = None;
                if reading.stream.set_read_timeout(None).is_err() {
                    return self.end(CloseCode::Error, "the connection cannot be used");
                }
                first = false;
                self.ring();
                continue;
            }
            self.obey(&text, subject);
        }
    }

    fn obey(&self, text: &str, subject: &dyn Subject) {
        let (number, result) = match line::read(text) {
            Ok(Line::Say(number, words)) if self.guest && !line::stops(words) => {
                (Some(number), Err("this link is for looking, and for stop: whoever printed it operates".into()))
            }
            Ok(Line::Say(number, words)) => (Some(number), subject.say(self.page(), words)),
            Ok(Line::Here) => return subject.here(self.page()),
            Ok(Line::View(view)) => {
                let mut desk = self.desk();
                desk.views.insert(view.id, (view, None));
                desk.news = true;
                drop(desk);
                return self.wake.notify_one();
            }
            Ok(Line::Drop(id)) => {
                self.desk().views.remove(&id);
                return;
            }
            Ok(Line::Ack(frame)) => {
                let mut desk = self.desk();
                // A frame that was never sent is not drawn either.
                if frame <= desk.sent {
                    desk.acked = desk.acked.max(frame);
                    desk.news = true;
                }
                drop(desk);
                self.wake.notify_one();
                return subject.drew(self.page());
            }
            Ok(Line::Between(number, from, to, curves)) => {
                let measured = curves.iter().map(|curve| {
                    let mut points = |each: &mut dyn FnMut(f64, f64) -> bool| subject.points(*curve, from, each);
                    json!(measures::measures(&mut points, from, to))
                });
                let measured: Vec<Value> = measured.collect();
                let told = json!({ "kind": "measures", "number": number, "curves": curves, "measures": measured });
                return self.push(Message::text(told.to_string()));
            }
            Ok(Line::Csv(number, from, to, curves)) => match rows::rows(subject, from, to, &curves) {
                Ok(rows) => {
                    let told = json!({ "kind": "csv", "number": number, "curves": curves, "rows": rows });
                    return self.push(Message::text(told.to_string()));
                }
                Err(why) => (None, Err(why)),
            },
            Ok(Line::Find(number, Crossing { curve, rises, level, after })) => {
                let mut points = |each: &mut dyn FnMut(f64, f64) -> bool| subject.points(curve, after, each);
                let t = measures::crossing(&mut points, rises, level, after);
                // After the search: what came meanwhile is searched the next time.
                let told = json!({ "kind": "found", "number": number, "t": t });
                return self.push(Message::text(told.to_string()));
            }
            Ok(Line::Key(_)) => (None, Err("the key is known".into())),
            Err(why) => (None, Err(why)),
        };
        let answer = match result {
            Ok(words) => json!({ "kind": "answer", "number": number, "ok": words }),
            Err(why) => json!({ "kind": "answer", "number": number, "refused": crate::words::clean(&why) }),
        };
        self.push(Message::text(answer.to_string()));
    }

    /// Writes until the viewer ends. Data go out only once `is_known`.
    pub fn write(&self, stream: TcpStream, subject: &dyn Subject, is_known: &dyn Fn() -> bool) {
        let _ = stream.set_write_timeout(Some(DEAF));
        let closing = stream.try_clone();
        let mut socket = WebSocket::from_raw_socket(stream, Role::Server, Some(config()));
        let (mut hello, mut state) = (None, None);
        'run: loop {
            let (messages, over, free) = {
                let mut desk = self.desk();
                while desk.messages.is_empty() && !desk.over && !desk.news {
                    desk = self.wake.wait(desk).unwrap_or_else(PoisonError::into_inner);
                }
                desk.news = false;
                (std::mem::take(&mut desk.messages), desk.over, desk.sent - desk.acked < AHEAD)
            };
            for message in messages {
                if socket.send(message).is_err() {
                    break 'run;
                }
            }
            if over {
                break;
            }
            if !free || !is_known() {
                continue;
            }
            let numbers = subject.numbers();
            if hello != Some(numbers.0) {
                let (number, value) = subject.hello();
                hello = Some(number);
                state = None;
                // Its numbers of signals mean others now: the page asks anew.
                self.desk().views.clear();
                let Page { number: page, guest } = self.page();
                let told = json!({ "kind": "hello", "number": number, "page": page, "guest": guest, "is": value });
                let text = told.to_string();
                if socket.send(Message::text(text)).is_err() {
                    break;
                }
            }
            // The version first: what changes meanwhile goes out again, rather than never.
            let version = subject.version();
            let changed = state != Some(numbers.1);
            if changed {
                let (number, value) = subject.state();
                state = Some(number);
                let text = json!({ "kind": "state", "number": number, "is": value }).to_string();
                if socket.send(Message::text(text)).is_err() {
                    break;
                }
            }
            let (views, frame_number) = {
                let mut desk = self.desk();
                let next = desk.sent + 1;
                let views: Vec<(View, Option<u64>)> = desk.views.values().cloned().collect();
                for (_, since) in desk.views.values_mut() {
                    *since = Some(version);
                }
                (views, next)
            };
            let mut frame = Frame::new(frame_number, subject.newest());
            for (view, since) in &views {
                if *since != Some(version) {
                    subject.blocks(view, *since, &mut frame);
                }
            }
            if changed || !frame.is_empty() {
                self.desk().sent = frame_number;
                if socket.send(Message::binary(frame.bytes())).is_err() {
                    break;
                }
            }
        }
        if let Ok(stream) = closing {
            let _ = stream.shutdown(Shutdown::Both);
        }
        self.desk().over = true;
    }
}

/// All viewers, and the number of the latest.
#[derive(Default)]
struct Room {
    viewers: Mutex<Vec<Arc<Viewer>>>,
    numbers: AtomicU64,
}

/// Wakes all viewers.
#[derive(Clone, Default)]
pub struct Bell(Arc<Room>);

impl Bell {
    fn all(&self) -> MutexGuard<'_, Vec<Arc<Viewer>>> {
        self.0.viewers.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Says that something of the subject may have changed.
    pub fn ring(&self) {
        let all = self.all().clone();
        all.iter().for_each(|viewer| viewer.ring());
    }

    /// Number of viewers.
    pub fn viewers(&self) -> usize {
        self.all().len()
    }

    /// Adds one and gives it its number, if there is room: guests take none from others.
    pub(crate) fn add(&self, viewer: &Arc<Viewer>, most: usize) -> bool {
        let mut all = self.all();
        let room = all.iter().filter(|other| other.guest == viewer.guest).count() < most;
        if room {
            viewer.number.store(self.0.numbers.fetch_add(1, Ordering::Relaxed) + 1, Ordering::Relaxed);
            all.push(viewer.clone());
        }
        room
    }

    pub(crate) fn remove(&self, viewer: &Arc<Viewer>) {
        self.all().retain(|other| !Arc::ptr_eq(other, viewer));
    }
}
