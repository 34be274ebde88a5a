//! Service data objects (SDO): one object is read or written at a time, up to 4 bytes in one frame (expedited), longer
//! ones in segments of 7.
//!
//! A [`Client`] sends requests, a [`Server`] answers them. Block transfer is not supported; a server refuses it as the
//! standard requires.

use super::{Abort, Object, ObjectDictionary, Send};
use crate::can::Frame;
use std::fmt;

/// Length of the longest object that can be transferred, bytes.
pub const LONGEST: usize = 256;

/// Storage that a server reads and writes.
pub trait Objects {
    /// The bytes of an object.
    fn read(&mut self, object: Object) -> Result<&[u8], Abort>;
    /// Writes all bytes of an object, or changes nothing.
    fn write(&mut self, object: Object, bytes: &[u8]) -> Result<(), Abort>;
}

impl Objects for ObjectDictionary {
    fn read(&mut self, object: Object) -> Result<&[u8], Abort> {
        ObjectDictionary::read(self, object)
    }

    fn write(&mut self, object: Object, bytes: &[u8]) -> Result<(), Abort> {
        ObjectDictionary::write(self, object, bytes)
    }
}

/// Reason for the failure of a transfer.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Failure {
    /// The server or the client aborted it.
    Aborted(Abort),
    /// No answer in time.
    Silence,
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Failure::Aborted(abort) => abort.fmt(f),
            Failure::Silence => f.write_str("no answer in time"),
        }
    }
}

/// State of a request.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Outcome {
    /// There is no request.
    Idle,
    /// The transfer is in progress.
    Busy,
    /// It succeeded; [`Client::data`] holds the bytes read.
    Done,
    /// It failed.
    Failed(Failure),
}

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum TransferStage {
    Rest,
    /// Waits for the answer to a read request.
    Read,
    /// Waits for the answer to a write request.
    Write,
    /// Waits for a segment with this toggle bit.
    ReadSegment(bool),
    /// Waits for the answer to a segment with this toggle bit.
    WriteSegment(bool),
}

fn frame(id: u32, command: u8, object: Object, tail: u32) -> Frame {
    let ([a, b], [c, d, e, f]) = (object.0.to_le_bytes(), tail.to_le_bytes());
    Frame::new(id, &[command, a, b, object.1, c, d, e, f])
}

fn word(data: &[u8; 8]) -> u32 {
    u32::from_le_bytes([data[4], data[5], data[6], data[7]])
}

fn object(data: &[u8; 8]) -> Object {
    Object(u16::from_le_bytes([data[1], data[2]]), data[3])
}

/// A segment of up to 7 bytes after its command byte; `last` if no more follow.
fn segment(id: u32, toggle: bool, bytes: &[u8], last: bool) -> Frame {
    let mut data = [0; 8];
    data[0] = u8::from(toggle) << 4 | (7 - bytes.len() as u8) << 1 | u8::from(last);
    data[1..=bytes.len()].copy_from_slice(bytes);
    Frame::new(id, &data)
}

/// SDO client for one node.
#[derive(Clone, Debug)]
pub struct Client {
    node: u8,
    timeout_ns: u64,
    stage: TransferStage,
    outcome: Outcome,
    object: Object,
    buffer: [u8; LONGEST],
    length: usize,
    /// Number of bytes of the buffer that have been sent or received.
    moved: usize,
    deadline_ns: u64,
}

impl Client {
    /// A client of `node` that waits for each answer at most `timeout_ns`.
    pub fn new(node: u8, timeout_ns: u64) -> Client {
        Client {
            node,
            timeout_ns,
            stage: TransferStage::Rest,
            outcome: Outcome::Idle,
            object: Object(0, 0),
            buffer: [0; LONGEST],
            length: 0,
            moved: 0,
            deadline_ns: 0,
        }
    }

    fn request(&self) -> u32 {
        0x600 + u32::from(self.node)
    }

    /// Requests the bytes of an object. An unfinished request is discarded.
    pub fn read(&mut self, object: Object, now_ns: u64, send: Send) {
        self.begin(TransferStage::Read, object, now_ns);
        send(frame(self.request(), 0x40, object, 0));
    }

    /// Requests to write these bytes.
    ///
    /// # Panics
    /// If there are none or more than [`LONGEST`]: an error of the caller.
    pub fn write(&mut self, object: Object, bytes: &[u8], now_ns: u64, send: Send) {
        assert!((1..=LONGEST).contains(&bytes.len()), "{} bytes to {object}", bytes.len());
        self.begin(TransferStage::Write, object, now_ns);
        self.buffer[..bytes.len()].copy_from_slice(bytes);
        self.length = bytes.len();
        if bytes.len() <= 4 {
            let mut tail = [0; 4];
            tail[..bytes.len()].copy_from_slice(bytes);
            let command = 0x23 | (4 - bytes.len() as u8) << 2;
            send(frame(self.request(), command, object, u32::from_le_bytes(tail)));
        } else {
            send(frame(self.request(), 0x21, object, bytes.len() as u32));
        }
    }

    fn begin(&mut self, stage: TransferStage, object: Object, now_ns: u64) {
        (self.stage, self.outcome, self.object) = (stage, Outcome::Busy, object);
        (self.length, self.moved, self.deadline_ns) = (0, 0, now_ns + self.timeout_ns);
    }

    /// State of the last request.
    pub fn outcome(&self) -> Outcome {
        self.outcome
    }

    /// The object of the last request.
    pub fn object(&self) -> Object {
        self.object
    }

    /// The bytes read.
    pub fn data(&self) -> &[u8] {
        &self.buffer[..self.length]
    }

    fn end(&mut self, outcome: Outcome) {
        (self.stage, self.outcome) = (TransferStage::Rest, outcome);
    }

    fn abort(&mut self, abort: Abort, send: Send) {
        send(frame(self.request(), 0x80, self.object, abort.0));
        self.end(Outcome::Failed(Failure::Aborted(abort)));
    }

    /// Checks the time-out: an overdue answer fails the request.
    pub fn poll(&mut self, now_ns: u64, send: Send) {
        if self.stage != TransferStage::Rest && now_ns >= self.deadline_ns {
            self.abort(Abort::TIMED_OUT, send);
            self.outcome = Outcome::Failed(Failure::Silence);
        }
    }

    /// Receives an answer of the server. Unexpected answers are ignored.
    pub fn receive(&mut self, answer: &Frame, now_ns: u64, send: Send) {
        let Ok(data) = <&[u8; 8]>::try_from(answer.data()) else { return };
        if answer.id() != 0x580 + u32::from(self.node) || self.stage == TransferStage::Rest {
            return;
        }
        if data[0] == 0x80 {
            if object(data) == self.object {
                self.end(Outcome::Failed(Failure::Aborted(Abort(word(data)))));
            }
            return;
        }
        self.deadline_ns = now_ns + self.timeout_ns;
        match self.stage {
            TransferStage::Rest => {}
            TransferStage::Read | TransferStage::Write if object(data) != self.object => {}
            TransferStage::Read => match data[0] {
                command if command & 0xE2 == 0x42 => {
                    self.length = if command & 1 == 1 { 4 - usize::from(command >> 2 & 3) } else { 4 };
                    self.buffer[..self.length].copy_from_slice(&data[4..4 + self.length]);
                    self.end(Outcome::Done);
                }
                command if command & 0xE2 == 0x40 => {
                    if command & 1 == 1 && word(data) as usize > LONGEST {
                        return self.abort(Abort::MEMORY, send);
                    }
                    self.stage = TransferStage::ReadSegment(false);
                    send(Frame::new(self.request(), &[0x60, 0, 0, 0, 0, 0, 0, 0]));
                }
                _ => self.abort(Abort::COMMAND, send),
            },
            TransferStage::ReadSegment(toggle) => {
                if data[0] & 0xE0 != 0 {
                    return self.abort(Abort::COMMAND, send);
                }
                if (data[0] & 0x10 != 0) != toggle {
                    return self.abort(Abort::TOGGLE, send);
                }
                let count = 7 - usize::from(data[0] >> 1 & 7);
                if self.moved + count > LONGEST {
                    return self.abort(Abort::MEMORY, send);
                }
                self.buffer[self.moved..self.moved + count].copy_from_slice(&data[1..1 + count]);
                self.moved += count;
                if data[0] & 1 == 1 {
                    self.length = self.moved;
                    return self.end(Outcome::Done);
                }
                self.stage = TransferStage::ReadSegment(!toggle);
                send(Frame::new(self.request(), &[0x60 | u8::from(!toggle) << 4, 0, 0, 0, 0, 0, 0, 0]));
            }
            TransferStage::Write => match data[0] {
                0x60 if self.length <= 4 => self.end(Outcome::Done),
                0x60 => self.send_segment(false, send),
                _ => self.abort(Abort::COMMAND, send),
            },
            TransferStage::WriteSegment(toggle) => match data[0] {
                command if command & 0xEF != 0x20 => self.abort(Abort::COMMAND, send),
                command if (command & 0x10 != 0) != toggle => self.abort(Abort::TOGGLE, send),
                _ if self.moved == self.length => self.end(Outcome::Done),
                _ => self.send_segment(!toggle, send),
            },
        }
    }

    fn send_segment(&mut self, toggle: bool, send: Send) {
        let end = self.length.min(self.moved + 7);
        send(segment(self.request(), toggle, &self.buffer[self.moved..end], end == self.length));
        self.moved = end;
        self.stage = TransferStage::WriteSegment(toggle);
    }
}

/// SDO server of one node.
#[derive(Clone, Debug)]
pub struct Server {
    node: u8,
    stage: TransferStage,
    object: Object,
    buffer: [u8; LONGEST],
    length: usize,
    moved: usize,
}

impl Server {
    /// A server of `node`.
    pub fn new(node: u8) -> Server {
        Server { node, stage: TransferStage::Rest, object: Object(0, 0), buffer: [0; LONGEST], length: 0, moved: 0 }
    }

    fn answer(&self) -> u32 {
        0x580 + u32::from(self.node)
    }

    /// Discards a transfer in progress, because the node was reset.
    pub fn reset(&mut self) {
        self.stage = TransferStage::Rest;
    }

    fn abort(&mut self, object: Object, abort: Abort, send: Send) {
        self.stage = TransferStage::Rest;
        send(frame(self.answer(), 0x80, object, abort.0));
    }

    /// Receives a request and answers it.
    pub fn receive(&mut self, request: &Frame, objects: &mut dyn Objects, send: Send) {
        let Ok(data) = <&[u8; 8]>::try_from(request.data()) else { return };
        if request.id() != 0x600 + u32::from(self.node) {
            return;
        }
        match data[0] >> 5 {
            _ if data[0] == 0x80 => self.stage = TransferStage::Rest,
            0 => self.take_segment(data, objects, send),
            1 => self.begin_write(data, objects, send),
            2 => self.begin_read(object(data), objects, send),
            3 => self.give_segment(data, send),
            _ => self.abort(object(data), Abort::COMMAND, send),
        }
    }

    fn begin_read(&mut self, object: Object, objects: &mut dyn Objects, send: Send) {
        self.stage = TransferStage::Rest;
        let bytes = match objects.read(object) {
            Ok(bytes) if bytes.len() > LONGEST => return self.abort(object, Abort::MEMORY, send),
            Ok(bytes) => bytes,
            Err(abort) => return self.abort(object, abort, send),
        };
        let length = bytes.len();
        if (1..=4).contains(&length) {
            let mut tail = [0; 4];
            tail[..length].copy_from_slice(bytes);
            send(frame(self.answer(), 0x43 | (4 - length as u8) << 2, object, u32::from_le_bytes(tail)));
        } else {
            self.buffer[..length].copy_from_slice(bytes);
            (self.object, self.length, self.moved) = (object, length, 0);
            self.stage = TransferStage::ReadSegment(false);
            send(frame(self.answer(), 0x41, object, length as u32));
        }
    }

    fn give_segment(&mut self, data: &[u8; 8], send: Send) {
        let asked = data[0] & 0x10 != 0;
        match self.stage {
            TransferStage::ReadSegment(toggle) if toggle == asked => {
                let end = self.length.min(self.moved + 7);
                let last = end == self.length;
                send(segment(self.answer(), toggle, &self.buffer[self.moved..end], last));
                self.moved = end;
                self.stage = if last { TransferStage::Rest } else { TransferStage::ReadSegment(!toggle) };
            }
            TransferStage::ReadSegment(_) => self.abort(self.object, Abort::TOGGLE, send),
            _ => self.abort(Object(0, 0), Abort::COMMAND, send),
        }
    }

    fn begin_write(&mut self, data: &[u8; 8], objects: &mut dyn Objects, send: Send) {
        self.stage = TransferStage::Rest;
        let object = object(data);
        let (expedited, sized) = (data[0] & 2 != 0, data[0] & 1 != 0);
        if expedited {
            // If the client does not give the number of bytes, the object's length applies.
            let length = match sized {
                true => 4 - usize::from(data[0] >> 2 & 3),
                false => objects.read(object).map_or(4, <[u8]>::len).min(4),
            };
            return match objects.write(object, &data[4..4 + length]) {
                Ok(()) => send(frame(self.answer(), 0x60, object, 0)),
                Err(abort) => self.abort(object, abort, send),
            };
        }
        if sized && word(data) as usize > LONGEST {
            return self.abort(object, Abort::MEMORY, send);
        }
        (self.object, self.length, self.moved) = (object, if sized { word(data) as usize } else { 0 }, 0);
        self.stage = TransferStage::WriteSegment(false);
        send(frame(self.answer(), 0x60, object, 0));
    }

    fn take_segment(&mut self, data: &[u8; 8], objects: &mut dyn Objects, send: Send) {
        let object = self.object;
        let toggle = match self.stage {
            TransferStage::WriteSegment(toggle) if toggle == (data[0] & 0x10 != 0) => toggle,
            TransferStage::WriteSegment(_) => return self.abort(object, Abort::TOGGLE, send),
            _ => return self.abort(Object(0, 0), Abort::COMMAND, send),
        };
        let count = 7 - usize::from(data[0] >> 1 & 7);
        if self.moved + count > LONGEST {
            return self.abort(object, Abort::MEMORY, send);
        }
        self.buffer[self.moved..self.moved + count].copy_from_slice(&data[1..1 + count]);
        self.moved += count;
        if data[0] & 1 == 1 {
            if self.length != 0 && self.length != self.moved {
                return self.abort(object, Abort::LENGTH, send);
            }
            if let Err(abort) = objects.write(object, &self.buffer[..self.moved]) {
                return self.abort(object, abort, send);
            }
            self.stage = TransferStage::Rest;
        } else {
            self.stage = TransferStage::WriteSegment(!toggle);
        }
        send(Frame::new(self.answer(), &[0x20 | u8::from(toggle) << 4, 0, 0, 0, 0, 0, 0, 0]));
    }
}

#[cfg(test)]
mod tests {
    use super::super::object::{Access, Entry, Type};
    use super::*;
    use std::collections::VecDeque;

    fn dictionary() -> ObjectDictionary {
        let mut objects = ObjectDictionary::new();
        objects.add(Entry::number(Object(0x1000, 0), "device type", Type::U32, Access::Constant, 0x20192));
        objects.add(Entry::number(Object(0x6040, 0), "control word", Type::U16, Access::ReadWrite, 0));
        objects.add(Entry::number(Object(0x6060, 0), "mode", Type::I8, Access::ReadWrite, 0).within(-1, 10));
        objects.add(Entry::number(Object(0x2000, 0), "position", Type::I64, Access::ReadWrite, 0));
        objects.add(Entry::text(Object(0x1008, 0), "name", Access::ReadWrite, "fric simulated drive", 200));
        objects.add(Entry::text(Object(0x100A, 0), "empty", Access::ReadWrite, "", 200));
        objects
    }

    /// A client and a server on a simulated connection; `bend` may change or drop frames.
    struct Wire {
        client: Client,
        server: Server,
        objects: ObjectDictionary,
        frames: usize,
    }

    impl Wire {
        fn new() -> Wire {
            Wire { client: Client::new(5, 1_000_000), server: Server::new(5), objects: dictionary(), frames: 0 }
        }

        fn run(
            &mut self,
            begin: impl FnOnce(&mut Client, Send),
            mut bend: impl FnMut(usize, Frame) -> Option<Frame>,
        ) -> Outcome {
            let mut open = VecDeque::new();
            begin(&mut self.client, &mut |frame| open.push_back(frame));
            while let Some(frame) = open.pop_front() {
                let Some(frame) = bend(self.frames, frame) else { continue };
                self.frames += 1;
                self.server.receive(&frame, &mut self.objects, &mut |answer| open.push_back(answer));
                self.client.receive(&frame, 0, &mut |request| open.push_back(request));
            }
            self.client.outcome()
        }

        fn read(&mut self, object: Object) -> Outcome {
            self.run(|client, send| client.read(object, 0, send), |_, frame| Some(frame))
        }

        fn write(&mut self, object: Object, bytes: &[u8]) -> Outcome {
            self.run(|client, send| client.write(object, bytes, 0, send), |_, frame| Some(frame))
        }
    }

    #[test]
    fn every_length_is_transferred_in_both_directions() {
        let mut wire = Wire::new();
        for length in 1..=200u8 {
            let bytes: Vec<u8> = (0..length).map(|i| i.wrapping_mul(7).wrapping_add(length)).collect();
            wire.frames = 0;
            assert_eq!(wire.write(Object(0x1008, 0), &bytes), Outcome::Done, "write {length}");
            assert_eq!(wire.objects.read(Object(0x1008, 0)), Ok(&bytes[..]));
            assert_eq!(wire.read(Object(0x1008, 0)), Outcome::Done, "read {length}");
            assert_eq!(wire.client.data(), bytes);
            let segments = if length <= 4 { 0 } else { usize::from(length).div_ceil(7) };
            assert_eq!(wire.frames, 4 + 4 * segments);
        }
        assert_eq!(wire.read(Object(0x100A, 0)), Outcome::Done);
        assert_eq!(wire.client.data(), b"");
    }

    #[test]
    fn the_frames_match_the_standard() {
        let mut sent = Vec::new();
        let mut client = Client::new(3, 1);
        client.write(Object(0x6040, 0), &[0x0F, 0], 0, &mut |frame| sent.push(frame.to_string()));
        client.read(Object(0x1018, 1), 0, &mut |frame| sent.push(frame.to_string()));
        client.write(Object(0x6060, 0), &[10], 0, &mut |frame| sent.push(frame.to_string()));
        client.write(Object(0x1016, 1), &[5, 0, 1, 0], 0, &mut |frame| sent.push(frame.to_string()));
        client.write(Object(0x1008, 0), b"eight by", 0, &mut |frame| sent.push(frame.to_string()));
        assert_eq!(
            sent,
            [
                "603#2B4060000F000000",
                "603#4018100100000000",
                "603#2F6060000A000000",
                "603#2316100105000100",
                "603#2108100008000000",
            ]
        );
    }

    #[test]
    fn every_abort_reaches_the_client() {
        let mut wire = Wire::new();
        let failed = |abort| Outcome::Failed(Failure::Aborted(abort));
        assert_eq!(wire.write(Object(0x1000, 0), &[0; 4]), failed(Abort::READ_ONLY));
        assert_eq!(wire.write(Object(0x6040, 0), &[0]), failed(Abort::TOO_SHORT));
        assert_eq!(wire.write(Object(0x6040, 0), &[0; 6]), failed(Abort::TOO_LONG));
        assert_eq!(wire.write(Object(0x6060, 0), &[11]), failed(Abort::TOO_HIGH));
        assert_eq!(wire.read(Object(0x6061, 0)), failed(Abort::NO_OBJECT));
        assert_eq!(wire.read(Object(0x6060, 1)), failed(Abort::NO_SUB));
        // Every abort code of a server is reported unchanged.
        for &abort in Abort::ALL {
            let mut client = Client::new(5, 1);
            client.read(Object(0x1008, 0), 0, &mut |_| {});
            client.receive(&frame(0x585, 0x80, Object(0x1008, 0), abort.0), 0, &mut |_| panic!("nothing to answer"));
            assert_eq!(client.outcome(), failed(abort));
        }
    }

    #[test]
    fn a_lost_or_corrupted_frame_ends_the_transfer() {
        // Loss of each frame of a segmented read and write: the request times out, and the next one works.
        for writes in [false, true] {
            for lost in 0..8 {
                let mut wire = Wire::new();
                let begin = |client: &mut Client, send: Send| match writes {
                    true => client.write(Object(0x1008, 0), b"twenty bytes of text", 0, send),
                    false => client.read(Object(0x1008, 0), 0, send),
                };
                let mut seen = 0;
                let outcome = wire.run(begin, |_, frame| {
                    seen += 1;
                    (seen != lost + 1).then_some(frame)
                });
                assert_eq!(outcome, Outcome::Busy, "frame {lost}");
                let mut aborted = None;
                wire.client.poll(999_999, &mut |_| panic!("too early"));
                wire.client.poll(1_000_000, &mut |frame| aborted = Some(frame));
                assert_eq!(wire.client.outcome(), Outcome::Failed(Failure::Silence));
                let aborted = aborted.expect("the server is told");
                wire.server.receive(&aborted, &mut wire.objects, &mut |_| panic!("an abort has no answer"));
                assert_eq!(wire.read(Object(0x1000, 0)), Outcome::Done);
            }
        }
    }

    #[test]
    fn a_doubled_segment_is_detected() {
        let mut wire = Wire::new();
        let mut open = Vec::new();
        wire.client.read(Object(0x1008, 0), 0, &mut |frame| open.push(frame));
        let mut answers = Vec::new();
        wire.server.receive(&open[0], &mut wire.objects, &mut |frame| answers.push(frame));
        wire.client.receive(&answers[0], 0, &mut |frame| open.push(frame));
        wire.server.receive(&open[1], &mut wire.objects, &mut |frame| answers.push(frame));
        // The request for the first segment is repeated.
        wire.server.receive(&open[1], &mut wire.objects, &mut |frame| answers.push(frame));
        assert_eq!(answers[2], frame(0x585, 0x80, Object(0x1008, 0), Abort::TOGGLE.0));
        // The same on the client's side.
        wire.client.receive(&answers[1], 0, &mut |_| {});
        wire.client.receive(&answers[1], 0, &mut |frame| open.push(frame));
        assert_eq!(wire.client.outcome(), Outcome::Failed(Failure::Aborted(Abort::TOGGLE)));
    }

    #[test]
    fn requests_out_of_order_are_refused() {
        let mut wire = Wire::new();
        let mut answer = |data: [u8; 8]| {
            let mut answers = Vec::new();
            wire.server.receive(&Frame::new(0x605, &data), &mut wire.objects, &mut |frame| answers.push(frame));
            answers
        };
        assert_eq!(answer([0x60, 0, 0, 0, 0, 0, 0, 0]), [frame(0x585, 0x80, Object(0, 0), Abort::COMMAND.0)]);
        assert_eq!(answer([0x00, 0, 0, 0, 0, 0, 0, 0]), [frame(0x585, 0x80, Object(0, 0), Abort::COMMAND.0)]);
        let block = answer([0xC0, 0x08, 0x10, 0, 0, 0, 0, 0]);
        assert_eq!(block, [frame(0x585, 0x80, Object(0x1008, 0), Abort::COMMAND.0)], "block transfer");
        let long = answer([0x21, 0x08, 0x10, 0, 1, 1, 0, 0]);
        assert_eq!(long, [frame(0x585, 0x80, Object(0x1008, 0), Abort::MEMORY.0)]);
        // Announces 10 bytes, sends 3.
        answer([0x21, 0x08, 0x10, 0, 10, 0, 0, 0]);
        let short = answer([0x09, 1, 2, 3, 0, 0, 0, 0]);
        assert_eq!(short, [frame(0x585, 0x80, Object(0x1008, 0), Abort::LENGTH.0)]);
        // A client that does not give the number of bytes.
        assert_eq!(answer([0x22, 0x40, 0x60, 0, 6, 0, 0, 0]), [frame(0x585, 0x60, Object(0x6040, 0), 0)]);
        assert_eq!(wire.objects.get(Object(0x6040, 0)), Some(6));
    }
}
