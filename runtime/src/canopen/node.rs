//! A CANopen node: the commanded side.
//!
//! In: frames and the time. Out: frames, and [`Happening`]s for its device. It holds the object dictionary, follows NMT
//! commands, answers SDO requests, sends and receives PDOs, produces and monitors heartbeats, answers node guarding.
//! The device interprets the objects.

use super::object::Entry;
use super::pdo::{self, Direction, Mapped};
use super::sdo::{Objects, Server};
use super::service::{Emergency, NmtState, Service};
use super::{Abort, Access, Nmt, Object, ObjectDictionary, Send, Type};
use crate::can::Frame;

/// PDOs per direction.
const PDOS: usize = 4;
/// Most nodes whose heartbeat can be monitored.
const CONSUMERS: usize = 4;
/// Emergencies kept in object 1003.
const HISTORY: u8 = 8;

/// Event that a node reports to its device.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Happening {
    /// SYNC has arrived: sample, then call [`Node::answer_sync`].
    Sync,
    /// An RPDO has changed the dictionary; its number from 1.
    Rpdo(u8),
    /// An object was written by SDO.
    Written(Object),
    /// NMT changed the node's state.
    State(NmtState),
    /// The node was reset; its dictionary is as after power-on (only objects below 2000 for a reset of communication).
    Reset(Nmt),
    /// A monitored message is missing.
    Lost(Loss),
}

/// The missing message.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Loss {
    /// The heartbeat of this node.
    Heartbeat(u8),
    /// Guard requests.
    Guarding,
    /// This RPDO, number from 1.
    Rpdo(u8),
}

/// One PDO as configured in the dictionary.
#[derive(Clone, Copy, Debug)]
struct Slot {
    id: Option<u32>,
    kind: u8,
    map: [Mapped; pdo::MOST],
    count: usize,
    /// Length of the data, bytes.
    length: usize,
    /// Event timer, ns; 0: none.
    timer_ns: u64,
    /// Time at which the timer expires, if it runs.
    due_ns: Option<u64>,
    /// SYNCs since the last transmission.
    syncs: u8,
    /// Data received and waiting for SYNC, or data sent last.
    data: [u8; 8],
    waiting: bool,
}

const NOTHING: Slot = Slot {
    id: None,
    kind: 255,
    map: [Mapped { object: Object(0, 0), bits: 0 }; pdo::MOST],
    count: 0,
    length: 0,
    timer_ns: 0,
    due_ns: None,
    syncs: 0,
    data: [0; 8],
    waiting: false,
};

impl Slot {
    fn map(&self) -> &[Mapped] {
        &self.map[..self.count]
    }
}

/// A node on a bus.
#[derive(Clone, Debug)]
pub struct Node {
    id: u8,
    /// Its objects.
    pub objects: ObjectDictionary,
    factory: ObjectDictionary,
    state: NmtState,
    /// Time from a reset to the boot-up message, ns.
    boot_ns: u64,
    boots_at_ns: Option<u64>,
    server: Server,
    receive: [Slot; PDOS],
    transmit: [Slot; PDOS],
    heartbeat_due_ns: Option<u64>,
    /// Deadline of each monitored heartbeat, once the first one has arrived.
    consumers: [Option<u64>; CONSUMERS],
    /// Shortest heartbeat consumer time that the device accepts, ms.
    least_consumer_ms: u16,
    guard_toggle: bool,
    guard_deadline_ns: Option<u64>,
}

impl Node {
    /// A node that boots at time 0. `objects`: the device's own; missing communication objects are added.
    pub fn new(id: u8, objects: ObjectDictionary, boot_ns: u64, least_consumer_ms: u16) -> Node {
        let mut all = communication(id);
        for entry in objects.entries() {
            all.add(entry.clone());
        }
        let mut node = Node {
            id,
            factory: all.clone(),
            objects: all,
            state: NmtState::BootUp,
            boot_ns,
            boots_at_ns: Some(boot_ns),
            server: Server::new(id),
            receive: [NOTHING; PDOS],
            transmit: [NOTHING; PDOS],
            heartbeat_due_ns: None,
            consumers: [None; CONSUMERS],
            least_consumer_ms,
            guard_toggle: false,
            guard_deadline_ns: None,
        };
        node.take_over_pdos();
        node
    }

    /// Removes the event timers of RPDOs (objects 1400:5 and following), which not every device has.
    pub fn without_deadlines(&mut self) {
        for i in 0..PDOS as u16 {
            self.objects.remove(Object(0x1400 + i, 5));
            self.factory.remove(Object(0x1400 + i, 5));
        }
    }

    /// Its node id.
    pub fn id(&self) -> u8 {
        self.id
    }

    /// Its NMT state.
    pub fn state(&self) -> NmtState {
        self.state
    }

    /// Changes the state without a command, for example after a communication error.
    pub fn go(&mut self, state: NmtState) {
        self.state = state;
        for slot in self.receive.iter_mut().chain(&mut self.transmit) {
            (slot.due_ns, slot.syncs, slot.waiting) = (None, 0, false);
        }
    }

    /// Resets all objects for [`Nmt::ResetNode`], or those below 2000 for a reset of communication.
    pub fn reset(&mut self, command: Nmt, now_ns: u64) {
        for entry in self.factory.entries() {
            if command == Nmt::ResetNode || entry.object.0 < 0x2000 {
                self.objects.add(entry.clone());
            }
        }
        self.server.reset();
        self.go(NmtState::BootUp);
        self.take_over_pdos();
        (self.heartbeat_due_ns, self.guard_deadline_ns, self.guard_toggle) = (None, None, false);
        self.consumers = [None; CONSUMERS];
        self.boots_at_ns = Some(now_ns + self.boot_ns);
    }

    /// Signals an error: error register, history, object 603F where it exists, EMCY message.
    pub fn emergency(&mut self, code: u16, register: u8, send: Send) {
        self.objects.set(Object(0x1001, 0), register.into());
        if code != 0 {
            let count = self.objects.get(Object(0x1003, 0)).unwrap_or(0).min(i64::from(HISTORY) - 1) as u8;
            for sub in (1..=count).rev() {
                let older = self.objects.get(Object(0x1003, sub)).unwrap_or(0);
                self.objects.set(Object(0x1003, sub + 1), older);
            }
            self.objects.set(Object(0x1003, 1), code.into());
            self.objects.set(Object(0x1003, 0), i64::from(count) + 1);
        }
        if self.objects.entry(Object(0x603F, 0)).is_some() {
            self.objects.set(Object(0x603F, 0), code.into());
        }
        if matches!(self.state, NmtState::PreOperational | NmtState::Operational) {
            send(Emergency { code, register, vendor: [0; 5] }.frame(self.id));
        }
    }

    /// Time at which [`poll`](Node::poll) is next due.
    pub fn due_ns(&self) -> u64 {
        let timers = self.receive.iter().chain(&self.transmit).filter_map(|slot| slot.due_ns);
        let others = [self.boots_at_ns, self.heartbeat_due_ns, self.guard_deadline_ns];
        timers.chain(others.into_iter().flatten()).chain(self.consumers.into_iter().flatten()).min().unwrap_or(u64::MAX)
    }

    /// Receives a frame of its bus.
    pub fn receive(&mut self, frame: &Frame, now_ns: u64, send: Send) -> Option<Happening> {
        if self.state == NmtState::BootUp {
            return None;
        }
        let happening = match Service::of(frame) {
            Service::Nmt(Some(command), node) if node == 0 || node == self.id => Some(self.command(command, now_ns)),
            Service::Sync(_) if self.state == NmtState::Operational => {
                for slot in &mut self.receive {
                    if slot.waiting {
                        slot.waiting = false;
                        pdo::unpack(&slot.map[..slot.count], &mut self.objects, &slot.data[..slot.length]);
                    }
                }
                Some(Happening::Sync)
            }
            Service::SdoRequest(node) if node == self.id && self.state != NmtState::Stopped => {
                let before = self.heartbeat_ms();
                let mut written = None;
                let mut served = Served {
                    objects: &mut self.objects,
                    operational: self.state == NmtState::Operational,
                    least_consumer_ms: self.least_consumer_ms,
                    written: &mut written,
                };
                self.server.receive(frame, &mut served, send);
                if let Some(object) = written {
                    self.take_over(object, before, now_ns);
                }
                written.map(Happening::Written)
            }
            Service::Heartbeat(node, Some(_), _) => {
                self.watch(node, now_ns);
                None
            }
            Service::GuardRequest(node) if node == self.id => {
                if self.heartbeat_ms() == 0 {
                    let toggle = if self.guard_toggle { 0x80 } else { 0 };
                    send(Frame::new(0x700 + u32::from(self.id), &[self.state as u8 | toggle]));
                    self.guard_toggle = !self.guard_toggle;
                }
                let life = self.number(0x100C, 0) * self.number(0x100D, 0);
                self.guard_deadline_ns = (life > 0).then(|| now_ns + life * 1_000_000);
                None
            }
            _ => None,
        };
        happening.or_else(|| self.take_process_data(frame, now_ns, send))
    }

    fn command(&mut self, command: Nmt, now_ns: u64) -> Happening {
        match command {
            Nmt::ResetNode | Nmt::ResetCommunication => {
                self.reset(command, now_ns);
                return Happening::Reset(command);
            }
            Nmt::Start => self.go(NmtState::Operational),
            Nmt::Stop => self.go(NmtState::Stopped),
            Nmt::PreOperational => self.go(NmtState::PreOperational),
        }
        Happening::State(self.state)
    }

    fn number(&self, index: u16, sub: u8) -> u64 {
        self.objects.get(Object(index, sub)).unwrap_or(0).max(0) as u64
    }

    fn heartbeat_ms(&self) -> u64 {
        self.number(0x1017, 0)
    }

    /// Notes a heartbeat of another node.
    fn watch(&mut self, node: u8, now_ns: u64) {
        for i in 0..CONSUMERS {
            let entry = self.number(0x1016, i as u8 + 1);
            let (watched, time_ms) = ((entry >> 16) as u8 & 0x7F, entry & 0xFFFF);
            if watched == node && time_ms > 0 {
                self.consumers[i] = Some(now_ns + time_ms * 1_000_000);
            }
        }
    }

    fn take_process_data(&mut self, frame: &Frame, now_ns: u64, send: Send) -> Option<Happening> {
        if self.state != NmtState::Operational || frame.is_extended() || frame.is_remote() {
            return None;
        }
        let at = self.receive.iter().position(|slot| slot.id == Some(frame.id()))?;
        let slot = &mut self.receive[at];
        slot.due_ns = (slot.timer_ns > 0).then(|| now_ns + slot.timer_ns);
        if frame.data().len() < slot.length {
            self.emergency(0x8210, 0x11, send);
            return None;
        }
        slot.data[..frame.data().len()].copy_from_slice(frame.data());
        if slot.kind <= 240 {
            slot.waiting = true;
            return None;
        }
        pdo::unpack(&slot.map[..slot.count], &mut self.objects, &slot.data[..slot.length]);
        Some(Happening::Rpdo(at as u8 + 1))
    }

    /// Sends the PDOs that are due with the SYNC that has just arrived.
    pub fn answer_sync(&mut self, send: Send) {
        for slot in &mut self.transmit {
            let (Some(id), 0..=240) = (slot.id, slot.kind) else { continue };
            let mut data = [0; 8];
            let length = pdo::pack(&slot.map[..slot.count], &self.objects, &mut data);
            slot.syncs = slot.syncs.saturating_add(1);
            // Type 0: with a SYNC, but only after a change.
            let due = if slot.kind == 0 { data != slot.data } else { slot.syncs >= slot.kind };
            if due {
                (slot.syncs, slot.data) = (0, data);
                send(Frame::new(id, &data[..length]));
            }
        }
    }

    /// Executes one thing that is due; must be called until it returns none.
    pub fn poll(&mut self, now_ns: u64, send: Send) -> Option<Happening> {
        let over = |due: Option<u64>| due.is_some_and(|due| due <= now_ns);
        if over(self.boots_at_ns) {
            self.boots_at_ns = None;
            send(NmtState::BootUp.heartbeat(self.id));
            self.go(NmtState::PreOperational);
            self.heartbeat_due_ns = self.next_heartbeat(now_ns);
            return Some(Happening::State(self.state));
        }
        if over(self.heartbeat_due_ns) {
            send(self.state.heartbeat(self.id));
            let due = self.heartbeat_due_ns.unwrap_or(now_ns);
            self.heartbeat_due_ns = self.next_heartbeat(due);
        }
        for slot in 0..PDOS {
            if over(self.receive[slot].due_ns) {
                self.receive[slot].due_ns = None;
                return Some(Happening::Lost(Loss::Rpdo(slot as u8 + 1)));
            }
        }
        for i in 0..CONSUMERS {
            if over(self.consumers[i]) {
                self.consumers[i] = None;
                let node = (self.number(0x1016, i as u8 + 1) >> 16) as u8 & 0x7F;
                return Some(Happening::Lost(Loss::Heartbeat(node)));
            }
        }
        if over(self.guard_deadline_ns) {
            self.guard_deadline_ns = None;
            return Some(Happening::Lost(Loss::Guarding));
        }
        if self.state == NmtState::Operational {
            self.send_events(now_ns, send);
        }
        None
    }

    /// PDOs of type 254 and 255: sent on change or when their timer expires.
    fn send_events(&mut self, now_ns: u64, send: Send) {
        for slot in &mut self.transmit {
            let (Some(id), 254..) = (slot.id, slot.kind) else { continue };
            let mut data = [0; 8];
            let length = pdo::pack(slot.map(), &self.objects, &mut data);
            let timer = slot.due_ns.is_some_and(|due| due <= now_ns);
            if timer || data != slot.data || !slot.waiting {
                (slot.data, slot.waiting) = (data, true);
                slot.due_ns = (slot.timer_ns > 0).then(|| now_ns + slot.timer_ns);
                send(Frame::new(id, &data[..length]));
            }
        }
    }

    fn next_heartbeat(&self, from_ns: u64) -> Option<u64> {
        let period = self.heartbeat_ms();
        (period > 0).then(|| from_ns + period * 1_000_000)
    }

    /// Updates timers and PDOs after a communication object was written.
    fn take_over(&mut self, object: Object, heartbeat_before: u64, now_ns: u64) {
        match object.0 {
            0x1017 if self.heartbeat_ms() != heartbeat_before => self.heartbeat_due_ns = self.next_heartbeat(now_ns),
            0x1016 => self.consumers = [None; CONSUMERS],
            0x100C | 0x100D => self.guard_deadline_ns = None,
            0x1400..=0x1BFF => self.take_over_pdos(),
            _ => {}
        }
    }

    fn take_over_pdos(&mut self) {
        for i in 0..PDOS {
            self.receive[i] = self.slot(Direction::Receive, i as u16);
            self.transmit[i] = self.slot(Direction::Transmit, i as u16);
        }
    }

    fn slot(&self, direction: Direction, i: u16) -> Slot {
        let base = if direction == Direction::Receive { 0x1400 } else { 0x1800 };
        let cob_id = self.number(base + i, 1) as u32;
        let count = self.number(base + 0x200 + i, 0).min(pdo::MOST as u64) as usize;
        let mut slot = NOTHING;
        slot.id = (cob_id & pdo::OFF == 0 && count > 0).then_some(cob_id & 0x7FF);
        (slot.kind, slot.count) = (self.number(base + i, 2) as u8, count);
        slot.timer_ns = self.number(base + i, 5) * 1_000_000;
        for at in 0..count {
            slot.map[at] = Mapped::of(self.number(base + 0x200 + i, at as u8 + 1) as u32);
            slot.length += usize::from(slot.map[at].bits / 8);
        }
        slot
    }
}

/// The dictionary for SDO access, with the rules for communication objects.
struct Served<'a> {
    objects: &'a mut ObjectDictionary,
    operational: bool,
    least_consumer_ms: u16,
    written: &'a mut Option<Object>,
}

impl Objects for Served<'_> {
    fn read(&mut self, object: Object) -> Result<&[u8], Abort> {
        self.objects.read(object)
    }

    fn write(&mut self, object: Object, bytes: &[u8]) -> Result<(), Abort> {
        self.objects.may_write(object, bytes)?;
        let value = Type::U32.number(&bytes[..bytes.len().min(4)]) as u32;
        match object {
            Object(0x1003, 0) if value != 0 => return Err(Abort::VALUE),
            Object(0x1016, _) => {
                let (node, time_ms) = (value >> 16, value & 0xFFFF);
                if node > 127 {
                    return Err(Abort::VALUE);
                }
                if node != 0 && time_ms != 0 && time_ms < self.least_consumer_ms.into() {
                    return Err(Abort::TOO_LOW);
                }
            }
            Object(index @ (0x1400..=0x15FF | 0x1800..=0x19FF), 1) => {
                let before = self.objects.get(Object(index, 1)).unwrap_or(0) as u32;
                if value & pdo::OFF == 0 && value & 0x2000_0000 != 0 {
                    return Err(Abort::VALUE);
                }
                // An identifier may change only while the PDO is disabled.
                if before & pdo::OFF == 0 && value & pdo::OFF == 0 && (before ^ value) & 0x1FFF_FFFF != 0 {
                    return Err(Abort::VALUE);
                }
            }
            Object(index @ (0x1600..=0x17FF | 0x1A00..=0x1BFF), sub) => self.may_map(index, sub, value)?,
            _ => {}
        }
        self.objects.write(object, bytes)?;
        *self.written = Some(object);
        Ok(())
    }
}

impl Served<'_> {
    /// The rules of CiA 301, 7.5.2.36: only while the PDO is disabled; entries only while their number is 0.
    fn may_map(&self, index: u16, sub: u8, value: u32) -> Result<(), Abort> {
        let cob_id = self.objects.get(Object(index - 0x200, 1)).unwrap_or(0) as u32;
        if cob_id & pdo::OFF == 0 {
            return Err(if self.operational { Abort::STATE } else { Abort::ACCESS });
        }
        if sub == 0 {
            if value > pdo::MOST as u32 {
                return Err(Abort::MAP_LENGTH);
            }
            let bits = (1..=value).map(|at| {
                let word = self.objects.get(Object(index, at as u8)).unwrap_or(0);
                u32::from(Mapped::of(word as u32).bits)
            });
            return if bits.sum::<u32>() > 64 { Err(Abort::MAP_LENGTH) } else { Ok(()) };
        }
        if self.objects.get(Object(index, 0)) != Some(0) {
            return Err(Abort::ACCESS);
        }
        if value == 0 {
            return Ok(());
        }
        let mapped = Mapped::of(value);
        match self.objects.entry(mapped.object) {
            None => Err(Abort::NO_OBJECT),
            Some(entry) if !entry.mappable => Err(Abort::NOT_MAPPABLE),
            Some(entry) if entry.kind.size().map(|size| size * 8) != Some(mapped.bits.into()) => {
                Err(Abort::NOT_MAPPABLE)
            }
            Some(_) => Ok(()),
        }
    }
}

/// The objects of every node.
fn communication(id: u8) -> ObjectDictionary {
    use Access::{Constant, ReadOnly, ReadWrite};
    use Type::{U8, U16, U32};
    let mut objects = ObjectDictionary::new();
    let mut add = |index, sub, name: &str, kind, access, value: u32| {
        objects.add(Entry::number(Object(index, sub), name, kind, access, value.into()));
    };
    let node = u32::from(id);
    add(0x1000, 0, "device type", U32, Constant, 0);
    add(0x1001, 0, "error register", U8, ReadOnly, 0);
    add(0x1003, 0, "number of errors", U8, ReadWrite, 0);
    for sub in 1..=HISTORY {
        add(0x1003, sub, "error", U32, ReadOnly, 0);
    }
    add(0x1005, 0, "COB-ID SYNC", U32, ReadWrite, 0x80);
    add(0x1006, 0, "communication cycle period", U32, ReadWrite, 0);
    add(0x100C, 0, "guard time", U16, ReadWrite, 0);
    add(0x100D, 0, "life time factor", U8, ReadWrite, 0);
    add(0x1014, 0, "COB-ID EMCY", U32, ReadWrite, 0x80 + node);
    add(0x1016, 0, "heartbeat consumers", U8, Constant, CONSUMERS as u32);
    for sub in 1..=CONSUMERS as u8 {
        add(0x1016, sub, "consumer heartbeat time", U32, ReadWrite, 0);
    }
    add(0x1017, 0, "producer heartbeat time", U16, ReadWrite, 0);
    add(0x1018, 0, "identity", U8, Constant, 4);
    for (sub, name) in [(1, "vendor"), (2, "product"), (3, "revision"), (4, "serial number")] {
        add(0x1018, sub, name, U32, Constant, 0);
    }
    add(0x1029, 0, "error behaviour", U8, Constant, 1);
    add(0x1029, 1, "communication error", U8, ReadWrite, 0);
    for i in 0..PDOS as u16 {
        let id = 0x100 * u32::from(i) + node;
        for (base, first, name) in [(0x1400, 0x200, "RPDO"), (0x1800, 0x180, "TPDO")] {
            add(base + i, 0, name, U8, Constant, 5);
            add(base + i, 1, "COB-ID", U32, ReadWrite, (first + id) | pdo::OFF);
            add(base + i, 2, "transmission type", U8, ReadWrite, 255);
            add(base + i, 3, "inhibit time", U16, ReadWrite, 0);
            add(base + i, 5, "event timer", U16, ReadWrite, 0);
            for sub in 0..=pdo::MOST as u8 {
                let kind = if sub == 0 { U8 } else { U32 };
                add(base + 0x200 + i, sub, "mapped object", kind, ReadWrite, 0);
            }
        }
    }
    objects
}

#[cfg(test)]
mod tests {
    use super::super::pdo::Pdo;
    use super::super::sdo::{Client, Failure, Outcome};
    use super::super::service;
    use super::*;

    const MS: u64 = 1_000_000;

    fn device() -> Node {
        let mut objects = ObjectDictionary::new();
        for (index, kind) in [(0x6040, Type::U16), (0x6041, Type::U16), (0x6071, Type::I16), (0x6064, Type::I32)] {
            objects.add(Entry::number(Object(index, 0), "", kind, Access::ReadWrite, 0).mapped());
        }
        objects.add(Entry::number(Object(0x6065, 0), "not to be mapped", Type::U32, Access::ReadWrite, 0));
        let mut node = Node::new(3, objects, 10 * MS, 5);
        let mut sent = Vec::new();
        assert_eq!(node.due_ns(), 10 * MS);
        assert_eq!(node.poll(10 * MS, &mut |frame| sent.push(frame)), Some(Happening::State(NmtState::PreOperational)));
        assert_eq!(sent, [Frame::new(0x703, &[0])]);
        node
    }

    fn write(node: &mut Node, object: Object, value: u32, size: usize) -> Outcome {
        let mut client = Client::new(3, 1);
        let (mut requests, mut answers) = (Vec::new(), Vec::new());
        client.write(object, &value.to_le_bytes()[..size], 0, &mut |frame| requests.push(frame));
        node.receive(&requests[0], 0, &mut |frame| answers.push(frame));
        client.receive(&answers[0], 0, &mut |_| {});
        client.outcome()
    }

    fn map(node: &mut Node, pdo: Pdo) {
        for (object, value, size) in pdo.configuration() {
            assert_eq!(write(node, object, value, size.into()), Outcome::Done, "{object} = {value:#x}");
        }
        for (object, value, bits) in pdo.read_back() {
            assert_eq!(node.objects.get(object).map(|read| read as u32 & bits), Some(value), "{object}");
        }
    }

    fn mapped(index: u16, bits: u8) -> Mapped {
        Mapped { object: Object(index, 0), bits }
    }

    fn start(node: &mut Node) {
        let started = node.receive(&Nmt::Start.frame(0), 0, &mut |_| {});
        assert_eq!(started, Some(Happening::State(NmtState::Operational)));
    }

    #[test]
    fn process_data_travel_as_mapped() {
        let mut node = device();
        map(&mut node, Pdo::new(Direction::Receive, 1, 3, 255, &[mapped(0x6040, 16), mapped(0x6071, 16)]));
        map(&mut node, Pdo::new(Direction::Transmit, 1, 3, 1, &[mapped(0x6041, 16), mapped(0x6064, 32)]));
        let command = Frame::new(0x203, &[0x0F, 0, 0x9C, 0xFF]);
        assert_eq!(node.receive(&command, 0, &mut |_| {}), None, "not before it is operational");
        start(&mut node);
        assert_eq!(node.receive(&command, 0, &mut |_| {}), Some(Happening::Rpdo(1)));
        assert_eq!(node.objects.get(Object(0x6071, 0)), Some(-100));
        node.objects.set(Object(0x6064, 0), -2);
        let mut sent = Vec::new();
        assert_eq!(node.receive(&service::sync(None), 0, &mut |_| {}), Some(Happening::Sync));
        node.answer_sync(&mut |frame| sent.push(frame));
        assert_eq!(sent, [Frame::new(0x183, &[0, 0, 0xFE, 0xFF, 0xFF, 0xFF])]);
    }

    #[test]
    fn a_synchronous_command_waits_for_sync() {
        let mut node = device();
        map(&mut node, Pdo::new(Direction::Receive, 1, 3, 1, &[mapped(0x6071, 16)]));
        start(&mut node);
        assert_eq!(node.receive(&Frame::new(0x203, &[7, 0]), 0, &mut |_| {}), None);
        assert_eq!(node.objects.get(Object(0x6071, 0)), Some(0));
        node.receive(&service::sync(None), 0, &mut |_| {});
        assert_eq!(node.objects.get(Object(0x6071, 0)), Some(7));
    }

    #[test]
    fn a_short_pdo_is_an_emergency() {
        let mut node = device();
        map(&mut node, Pdo::new(Direction::Receive, 1, 3, 255, &[mapped(0x6040, 16), mapped(0x6071, 16)]));
        start(&mut node);
        let mut sent = Vec::new();
        node.receive(&Frame::new(0x203, &[0x0F, 0]), 0, &mut |frame| sent.push(frame));
        assert_eq!(
            Service::of(&sent[0]),
            Service::Emergency(3, Emergency { code: 0x8210, register: 0x11, vendor: [0; 5] })
        );
        assert_eq!(node.objects.get(Object(0x6040, 0)), Some(0));
        assert_eq!((node.objects.get(Object(0x1003, 0)), node.objects.get(Object(0x1003, 1))), (Some(1), Some(0x8210)));
    }

    #[test]
    fn mapping_follows_the_rules_of_the_standard() {
        let mut node = device();
        let refused = |abort| Outcome::Failed(Failure::Aborted(abort));
        let entry = Object(0x1600, 1);
        assert_eq!(write(&mut node, entry, mapped(0x6066, 32).word(), 4), refused(Abort::NO_OBJECT));
        assert_eq!(write(&mut node, entry, mapped(0x6065, 32).word(), 4), refused(Abort::NOT_MAPPABLE));
        assert_eq!(write(&mut node, entry, mapped(0x6064, 16).word(), 4), refused(Abort::NOT_MAPPABLE));
        for sub in 1..=3 {
            assert_eq!(write(&mut node, Object(0x1600, sub), mapped(0x6064, 32).word(), 4), Outcome::Done);
        }
        assert_eq!(write(&mut node, Object(0x1600, 0), 3, 1), refused(Abort::MAP_LENGTH));
        assert_eq!(write(&mut node, Object(0x1600, 0), 9, 1), refused(Abort::MAP_LENGTH));
        assert_eq!(write(&mut node, Object(0x1600, 0), 2, 1), Outcome::Done);
        assert_eq!(write(&mut node, entry, 0, 4), refused(Abort::ACCESS), "the number must be 0");
        assert_eq!(write(&mut node, Object(0x1400, 1), 0x203, 4), Outcome::Done);
        assert_eq!(write(&mut node, Object(0x1400, 1), 0x204, 4), refused(Abort::VALUE), "it must be off");
        assert_eq!(write(&mut node, Object(0x1600, 0), 0, 1), refused(Abort::ACCESS));
        start(&mut node);
        assert_eq!(write(&mut node, Object(0x1600, 0), 0, 1), refused(Abort::STATE));
        assert_eq!(write(&mut node, Object(0x1016, 1), 0x7F_0004, 4), refused(Abort::TOO_LOW));
        assert_eq!(write(&mut node, Object(0x1003, 0), 1, 1), refused(Abort::VALUE));
        // A reset of communication restores all of it.
        let reset = node.receive(&Nmt::ResetCommunication.frame(3), 0, &mut |_| {});
        assert_eq!(reset, Some(Happening::Reset(Nmt::ResetCommunication)));
        assert_eq!(node.objects.get(Object(0x1600, 0)), Some(0));
    }

    #[test]
    fn heartbeats_are_produced_and_monitored() {
        let mut node = device();
        assert_eq!(write(&mut node, Object(0x1017, 0), 20, 2), Outcome::Done);
        assert_eq!(write(&mut node, Object(0x1016, 1), 0x7F_0005, 4), Outcome::Done);
        let mut sent = Vec::new();
        assert_eq!(node.poll(19 * MS, &mut |frame| sent.push(frame)), None);
        assert_eq!(node.poll(20 * MS, &mut |frame| sent.push(frame)), None);
        assert_eq!(sent, [Frame::new(0x703, &[0x7F])]);
        // Monitoring begins with the first heartbeat.
        node.receive(&NmtState::Operational.heartbeat(0x7F), 21 * MS, &mut |_| {});
        assert_eq!(node.due_ns(), 26 * MS);
        assert_eq!(node.poll(26 * MS - 1, &mut |_| {}), None);
        assert_eq!(node.poll(26 * MS, &mut |_| {}), Some(Happening::Lost(Loss::Heartbeat(0x7F))));
        assert_eq!(node.poll(40 * MS - 1, &mut |_| {}), None, "told once");
    }

    #[test]
    fn guarding_is_answered_and_monitored() {
        let mut node = device();
        write(&mut node, Object(0x100C, 0), 10, 2);
        write(&mut node, Object(0x100D, 0), 2, 1);
        let mut sent = Vec::new();
        for _ in 0..2 {
            node.receive(&service::guard_request(3), 100 * MS, &mut |frame| sent.push(frame));
        }
        assert_eq!(sent, [Frame::new(0x703, &[0x7F]), Frame::new(0x703, &[0xFF])]);
        assert_eq!(node.poll(120 * MS, &mut |_| {}), Some(Happening::Lost(Loss::Guarding)));
    }

    #[test]
    fn an_rpdo_has_a_deadline() {
        let mut node = device();
        map(&mut node, Pdo::new(Direction::Receive, 1, 3, 255, &[mapped(0x6071, 16)]));
        write(&mut node, Object(0x1400, 5), 4, 2);
        start(&mut node);
        assert_eq!(node.poll(1000 * MS, &mut |_| {}), None, "it starts with the first");
        node.receive(&Frame::new(0x203, &[7, 0]), 1000 * MS, &mut |_| {});
        assert_eq!(node.poll(1004 * MS, &mut |_| {}), Some(Happening::Lost(Loss::Rpdo(1))));
    }

    #[test]
    fn a_stopped_node_accepts_only_nmt() {
        let mut node = device();
        node.receive(&Nmt::Stop.frame(3), 0, &mut |_| {});
        let request = Frame::new(0x603, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]);
        assert_eq!(node.receive(&request, 0, &mut |_| panic!("no answer")), None);
        assert_eq!(node.receive(&Nmt::Start.frame(4), 0, &mut |_| {}), None, "meant for another");
        start(&mut node);
    }
}
