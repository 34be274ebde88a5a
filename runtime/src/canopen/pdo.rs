//! Process data objects (PDO): their mapping, and how it is configured in a drive.

use super::{Object, ObjectDictionary};

/// Bit 31 of a PDO's COB-ID: disabled.
pub const OFF: u32 = 0x8000_0000;
/// Bit 30: no remote request.
pub const NO_REMOTE: u32 = 0x4000_0000;
/// Most objects in a PDO, of whole bytes.
pub const MOST: usize = 8;

/// One object in a PDO.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Mapped {
    /// The object.
    pub object: Object,
    /// Its length in bits: whole bytes.
    pub bits: u8,
}

impl Mapped {
    /// The entry in objects 1600 and 1A00.
    pub fn word(self) -> u32 {
        u32::from(self.object.0) << 16 | u32::from(self.object.1) << 8 | u32::from(self.bits)
    }

    /// Decodes an entry of objects 1600 and 1A00.
    pub fn of(word: u32) -> Mapped {
        Mapped { object: Object((word >> 16) as u16, (word >> 8) as u8), bits: word as u8 }
    }
}

/// Direction from the device's point of view.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[allow(missing_docs)]
pub enum Direction {
    Receive,
    Transmit,
}

/// Configuration of one PDO.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Pdo {
    /// Direction.
    pub direction: Direction,
    /// Number from 1.
    pub number: u8,
    /// COB-ID; with [`OFF`] set: disabled.
    pub cob_id: u32,
    /// Transmission type: 1 to 240 with each n-th SYNC, 255 immediately.
    pub kind: u8,
    map: [Mapped; MOST],
    count: u8,
}

impl Pdo {
    /// A PDO with these objects, its COB-ID from the predefined connection set.
    ///
    /// # Panics
    /// If they need more than 8 bytes: an error of the caller.
    pub fn new(direction: Direction, number: u8, node: u8, kind: u8, objects: &[Mapped]) -> Pdo {
        assert!((1..=4).contains(&number), "PDO {number} has no predefined identifier");
        let bits: u32 = objects.iter().map(|mapped| u32::from(mapped.bits)).sum();
        assert!(bits <= 64, "{bits} bits in a PDO");
        let base = match direction {
            Direction::Transmit => 0x180,
            Direction::Receive => 0x200,
        };
        let cob_id = base + 0x100 * u32::from(number - 1) + u32::from(node);
        let mut map = [Mapped { object: Object(0, 0), bits: 0 }; MOST];
        map[..objects.len()].copy_from_slice(objects);
        Pdo { direction, number, cob_id, kind, map, count: objects.len() as u8 }
    }

    /// The mapped objects.
    pub fn map(&self) -> &[Mapped] {
        &self.map[..self.count.into()]
    }

    /// Length of the data, bytes.
    pub fn length(&self) -> usize {
        self.map().iter().map(|mapped| usize::from(mapped.bits / 8)).sum()
    }

    /// First byte of an object.
    pub fn place(&self, object: Object) -> Option<usize> {
        let before = self.map().iter().position(|mapped| mapped.object == object)?;
        Some(self.map[..before].iter().map(|mapped| usize::from(mapped.bits / 8)).sum())
    }

    /// Index of the communication parameters: 1400 or 1800 and following.
    pub fn communication(&self) -> u16 {
        self.base(0x1400)
    }

    /// Index of the mapping parameters: 1600 or 1A00 and following.
    pub fn mapping(&self) -> u16 {
        self.base(0x1600)
    }

    fn base(&self, first: u16) -> u16 {
        let transmit = if self.direction == Direction::Transmit { 0x400 } else { 0 };
        first + transmit + u16::from(self.number - 1)
    }

    /// Objects to write, in the order that the standard requires: disable, unmap, map, type, enable.
    pub fn configuration(&self) -> Vec<(Object, u32, u8)> {
        let (communication, mapping) = (self.communication(), self.mapping());
        let mut writes = vec![(Object(communication, 1), self.cob_id | OFF, 4), (Object(mapping, 0), 0, 1)];
        for (i, mapped) in self.map().iter().enumerate() {
            writes.push((Object(mapping, i as u8 + 1), mapped.word(), 4));
        }
        writes.push((Object(mapping, 0), self.count.into(), 1));
        writes.push((Object(communication, 2), self.kind.into(), 1));
        writes.push((Object(communication, 1), self.cob_id, 4));
        writes
    }

    /// Objects to read back, with their expected values and masks.
    pub fn read_back(&self) -> Vec<(Object, u32, u32)> {
        let (communication, mapping) = (self.communication(), self.mapping());
        let mut reads = vec![
            (Object(communication, 1), self.cob_id, !NO_REMOTE),
            (Object(communication, 2), self.kind.into(), 0xFF),
            (Object(mapping, 0), self.count.into(), 0xFF),
        ];
        for (i, mapped) in self.map().iter().enumerate() {
            reads.push((Object(mapping, i as u8 + 1), mapped.word(), u32::MAX));
        }
        reads
    }
}

/// Packs mapped objects into the data of a frame; returns their number of bytes.
pub fn pack(map: &[Mapped], objects: &ObjectDictionary, data: &mut [u8; 8]) -> usize {
    let mut at = 0;
    for mapped in map {
        let size = usize::from(mapped.bits / 8);
        let bytes = objects.entry(mapped.object).map_or(&[][..], |entry| entry.bytes());
        data[at..at + bytes.len().min(size)].copy_from_slice(&bytes[..bytes.len().min(size)]);
        at += size;
    }
    at
}

/// Unpacks mapped objects from the data of a frame. Values outside an object's range are ignored.
pub fn unpack(map: &[Mapped], objects: &mut ObjectDictionary, data: &[u8]) {
    let mut at = 0;
    for mapped in map {
        let size = usize::from(mapped.bits / 8);
        if let Some(bytes) = data.get(at..at + size) {
            // Refused values have no effect: a PDO has no answer.
            let _ = objects.write(mapped.object, bytes);
        }
        at += size;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn torque() -> Pdo {
        let map = [Mapped { object: Object(0x6040, 0), bits: 16 }, Mapped { object: Object(0x6071, 0), bits: 16 }];
        Pdo::new(Direction::Receive, 1, 3, 255, &map)
    }

    #[test]
    fn it_is_configured_in_the_order_of_the_standard() {
        assert_eq!(
            torque().configuration(),
            [
                (Object(0x1400, 1), 0x8000_0203, 4),
                (Object(0x1600, 0), 0, 1),
                (Object(0x1600, 1), 0x6040_0010, 4),
                (Object(0x1600, 2), 0x6071_0010, 4),
                (Object(0x1600, 0), 2, 1),
                (Object(0x1400, 2), 255, 1),
                (Object(0x1400, 1), 0x203, 4),
            ]
        );
        let position = [Mapped { object: Object(0x6064, 0), bits: 32 }];
        let second = Pdo::new(Direction::Transmit, 2, 3, 1, &position);
        assert_eq!((second.cob_id, second.communication(), second.mapping()), (0x283, 0x1801, 0x1A01));
        assert_eq!(Mapped::of(0x6064_0020), position[0]);
    }

    #[test]
    fn objects_have_their_place() {
        let pdo = torque();
        assert_eq!((pdo.length(), pdo.place(Object(0x6071, 0)), pdo.place(Object(0x6064, 0))), (4, Some(2), None));
    }
}
