//! Objects: values of a device that can be read, written and mapped into PDOs.

use super::Abort;
use std::fmt;

/// Index and sub-index of an object.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct Object(pub u16, pub u8);

/// In the format `6040:00`.
impl fmt::Display for Object {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{:04X}:{:02X}", self.0, self.1)
    }
}

/// Data type of an object.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[allow(missing_docs)]
pub enum Type {
    Boolean,
    I8,
    I16,
    I32,
    I64,
    U8,
    U16,
    U32,
    U64,
    F32,
    F64,
    /// Text or bytes of any length.
    Bytes,
}

impl Type {
    /// Number of bytes; none if the length is variable.
    pub fn size(self) -> Option<usize> {
        match self {
            Type::Boolean | Type::I8 | Type::U8 => Some(1),
            Type::I16 | Type::U16 => Some(2),
            Type::I32 | Type::U32 | Type::F32 => Some(4),
            Type::I64 | Type::U64 | Type::F64 => Some(8),
            Type::Bytes => None,
        }
    }

    fn signed(self) -> bool {
        matches!(self, Type::I8 | Type::I16 | Type::I32 | Type::I64)
    }

    /// The number in these bytes, least significant first; floats as their bits.
    pub fn number(self, bytes: &[u8]) -> i64 {
        let bytes = &bytes[..bytes.len().min(8)];
        let mut raw = [0; 8];
        raw[..bytes.len()].copy_from_slice(bytes);
        if self.signed() && bytes.last().is_some_and(|top| top & 0x80 != 0) {
            raw[bytes.len()..].fill(0xFF);
        }
        i64::from_le_bytes(raw)
    }
}

/// Access rights through SDO.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[allow(missing_docs)]
pub enum Access {
    Constant,
    ReadOnly,
    WriteOnly,
    ReadWrite,
}

/// One object with its value.
#[derive(Clone, PartialEq, Debug)]
pub struct Entry {
    /// Its index and sub-index.
    pub object: Object,
    /// Its name, for people.
    pub name: String,
    /// Its data type.
    pub kind: Type,
    /// Its access rights.
    pub access: Access,
    /// Whether it may be mapped into a PDO.
    pub mappable: bool,
    /// Lowest and highest number that may be written.
    pub range: (i64, i64),
    bytes: Vec<u8>,
    capacity: usize,
}

impl Entry {
    /// A number.
    pub fn number(object: Object, name: &str, kind: Type, access: Access, value: i64) -> Entry {
        let size = kind.size().expect("a number has a size");
        Entry {
            object,
            name: name.to_string(),
            kind,
            access,
            mappable: false,
            range: (i64::MIN, i64::MAX),
            bytes: value.to_le_bytes()[..size].to_vec(),
            capacity: size,
        }
    }

    /// A text of up to `capacity` bytes.
    pub fn text(object: Object, name: &str, access: Access, value: &str, capacity: usize) -> Entry {
        let capacity = capacity.max(value.len());
        let mut bytes = Vec::with_capacity(capacity);
        bytes.extend_from_slice(value.as_bytes());
        Entry {
            object,
            name: name.to_string(),
            kind: Type::Bytes,
            access,
            mappable: false,
            range: (i64::MIN, i64::MAX),
            bytes,
            capacity,
        }
    }

    /// The same object, mappable into a PDO.
    pub fn mapped(mut self) -> Entry {
        self.mappable = true;
        self
    }

    /// The same object, restricted to numbers from `low` to `high`.
    pub fn within(mut self, low: i64, high: i64) -> Entry {
        self.range = (low, high);
        self
    }

    /// Its bytes, least significant first.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Its number; floats as their bits.
    pub fn value(&self) -> i64 {
        self.kind.number(&self.bytes)
    }

    /// Whether length and range permit these bytes; access rights are not checked.
    fn admits(&self, bytes: &[u8]) -> Result<(), Abort> {
        match self.kind.size() {
            Some(size) if bytes.len() > size => Err(Abort::TOO_LONG),
            Some(size) if bytes.len() < size => Err(Abort::TOO_SHORT),
            None if bytes.len() > self.capacity => Err(Abort::TOO_LONG),
            None => Ok(()),
            Some(_) => match self.kind.number(bytes) {
                number if number > self.range.1 => Err(Abort::TOO_HIGH),
                number if number < self.range.0 => Err(Abort::TOO_LOW),
                _ => Ok(()),
            },
        }
    }
}

/// Object dictionary, in the order of the indices. Adding allocates; reading and writing does not.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct ObjectDictionary {
    entries: Vec<Entry>,
}

impl ObjectDictionary {
    /// An empty dictionary.
    pub fn new() -> ObjectDictionary {
        ObjectDictionary::default()
    }

    /// Adds an object, or replaces the one with the same index.
    pub fn add(&mut self, entry: Entry) {
        match self.place(entry.object) {
            Ok(at) => self.entries[at] = entry,
            Err(at) => self.entries.insert(at, entry),
        }
    }

    /// Removes an object.
    pub fn remove(&mut self, object: Object) {
        if let Ok(at) = self.place(object) {
            self.entries.remove(at);
        }
    }

    fn place(&self, object: Object) -> Result<usize, usize> {
        self.entries.binary_search_by_key(&object, |entry| entry.object)
    }

    /// All objects, in order.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// The object with this index.
    pub fn entry(&self, object: Object) -> Option<&Entry> {
        self.place(object).ok().map(|at| &self.entries[at])
    }

    fn find(&self, object: Object) -> Result<usize, Abort> {
        self.place(object).map_err(|at| {
            let near = |at: usize| self.entries.get(at).is_some_and(|entry| entry.object.0 == object.0);
            if near(at) || at > 0 && near(at - 1) { Abort::NO_SUB } else { Abort::NO_OBJECT }
        })
    }

    /// The bytes of an object, as read by an SDO client.
    pub fn read(&self, object: Object) -> Result<&[u8], Abort> {
        let entry = &self.entries[self.find(object)?];
        match entry.access {
            Access::WriteOnly => Err(Abort::WRITE_ONLY),
            Access::Constant | Access::ReadOnly | Access::ReadWrite => Ok(&entry.bytes),
        }
    }

    /// Whether an SDO client may write these bytes.
    pub fn may_write(&self, object: Object, bytes: &[u8]) -> Result<(), Abort> {
        let entry = &self.entries[self.find(object)?];
        match entry.access {
            Access::Constant | Access::ReadOnly => Err(Abort::READ_ONLY),
            Access::WriteOnly | Access::ReadWrite => entry.admits(bytes),
        }
    }

    /// Writes as an SDO client: access, length and range are checked first.
    pub fn write(&mut self, object: Object, bytes: &[u8]) -> Result<(), Abort> {
        self.may_write(object, bytes)?;
        let at = self.find(object)?;
        let entry = &mut self.entries[at];
        entry.bytes.clear();
        entry.bytes.extend_from_slice(bytes);
        Ok(())
    }

    /// The number of an object, regardless of access rights; none if there is no such number.
    pub fn get(&self, object: Object) -> Option<i64> {
        self.entry(object).filter(|entry| entry.kind != Type::Bytes).map(Entry::value)
    }

    /// Sets the number of an object, regardless of access rights; a number that does not fit loses its upper bytes.
    ///
    /// # Panics
    /// If there is no such number: an error of the caller.
    pub fn set(&mut self, object: Object, number: i64) {
        let at = self.place(object).unwrap_or_else(|_| panic!("no object {object}"));
        let entry = &mut self.entries[at];
        let size = entry.kind.size().unwrap_or_else(|| panic!("object {object} is no number"));
        entry.bytes.copy_from_slice(&number.to_le_bytes()[..size]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dictionary() -> ObjectDictionary {
        let mut objects = ObjectDictionary::new();
        objects.add(Entry::number(Object(0x6071, 0), "target torque", Type::I16, Access::ReadWrite, 0).mapped());
        objects.add(Entry::number(Object(0x1000, 0), "device type", Type::U32, Access::Constant, 0x20192));
        objects.add(Entry::number(Object(0x1017, 0), "heartbeat", Type::U16, Access::ReadWrite, 0).within(5, 1000));
        objects.add(Entry::number(Object(0x2000, 1), "key", Type::U8, Access::WriteOnly, 0));
        objects.add(Entry::text(Object(0x1008, 0), "name", Access::ReadWrite, "drive", 8));
        objects
    }

    #[test]
    fn each_wrong_access_has_its_abort() {
        let mut objects = dictionary();
        let cases: [(Object, &[u8], Abort); 9] = [
            (Object(0x6071, 0), &[1], Abort::TOO_SHORT),
            (Object(0x6071, 0), &[1, 2, 3], Abort::TOO_LONG),
            (Object(0x6071, 1), &[1, 2], Abort::NO_SUB),
            (Object(0x2000, 0), &[1], Abort::NO_SUB),
            (Object(0x7000, 0), &[1], Abort::NO_OBJECT),
            (Object(0x1000, 0), &[0; 4], Abort::READ_ONLY),
            (Object(0x1017, 0), &[4, 0], Abort::TOO_LOW),
            (Object(0x1017, 0), &[0xE9, 3], Abort::TOO_HIGH),
            (Object(0x1008, 0), b"too long!", Abort::TOO_LONG),
        ];
        let before = objects.clone();
        for (object, bytes, abort) in cases {
            assert_eq!(objects.write(object, bytes), Err(abort), "{object}");
        }
        assert_eq!(objects, before, "a refused write changes nothing");
        assert_eq!(objects.read(Object(0x2000, 1)), Err(Abort::WRITE_ONLY));
        assert_eq!(objects.read(Object(0x5000, 0)), Err(Abort::NO_OBJECT));
    }

    #[test]
    fn numbers_keep_their_sign_and_width() {
        let mut objects = dictionary();
        objects.write(Object(0x6071, 0), &(-300i16).to_le_bytes()).unwrap();
        assert_eq!(objects.get(Object(0x6071, 0)), Some(-300));
        objects.set(Object(0x6071, 0), 0x1_8000);
        assert_eq!(objects.get(Object(0x6071, 0)), Some(-0x8000), "cut to 16 bits");
        objects.write(Object(0x1008, 0), b"").unwrap();
        assert_eq!(objects.read(Object(0x1008, 0)), Ok(&b""[..]));
        assert_eq!(Type::U8.number(&[0xFF]), 255);
        assert_eq!(Type::I64.number(&[0xFF; 8]), -1);
    }

    #[test]
    fn an_abort_has_a_message() {
        assert_eq!(Abort::ALL.len(), 31);
        for abort in Abort::ALL {
            assert!(abort.meaning().is_some_and(|text| abort.to_string().starts_with(text)));
        }
        assert_eq!(Abort(0x0601_0002).to_string(), "attempt to write a read only object (abort code 0x06010002)");
        assert_eq!(Abort(0x0F00_00C0).to_string(), "abort code 0x0F0000C0 of the maker");
    }
}
