//! Serialisation: values as bytes, and back.
//!
//! Equal values have equal bytes on every machine. Bytes that do not encode a value of the type are an error. Integers
//! and reals are little endian; a list is its length (32 bits) followed by its entries; a struct is its fields in
//! order. There are no versions: a file format has to store its own.

use crate::description::{Automaton, Delay, Guard, Kind, Layout, Quantity, Root, Segment, Slot, Tick};
use crate::unit::{Angle, Dimension, Ratio, Unit};
use std::fmt;
use std::sync::Arc;

/// Why bytes do not encode the expected value.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Malformed(pub String);

impl fmt::Display for Malformed {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Malformed {}

/// Reads bytes from the beginning.
pub struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    /// A reader at the first byte.
    pub fn new(bytes: &'a [u8]) -> Reader<'a> {
        Reader { bytes, at: 0 }
    }

    /// The next `count` bytes.
    ///
    /// # Errors
    /// If fewer remain.
    pub fn take(&mut self, count: usize) -> Result<&'a [u8], Malformed> {
        let rest = &self.bytes[self.at..];
        let taken = rest.get(..count).ok_or_else(|| {
            Malformed(format!("{count} bytes are needed at byte {}, {} are left", self.at, rest.len()))
        })?;
        self.at += count;
        Ok(taken)
    }

    /// Number of remaining bytes.
    pub fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], Malformed> {
        Ok(self.take(N)?.try_into().expect("as many as were asked for"))
    }

    fn wrong<T>(&self, what: impl fmt::Display) -> Result<T, Malformed> {
        Err(Malformed(format!("{what}, before byte {}", self.at)))
    }
}

/// A type with an encoding in bytes.
pub trait Encode: Sized {
    /// Appends the bytes of the value.
    fn encode(&self, out: &mut Vec<u8>);

    /// Reads a value.
    ///
    /// # Errors
    /// Where and why the bytes do not encode one.
    fn decode(reader: &mut Reader) -> Result<Self, Malformed>;

    /// The bytes of the value.
    fn to_bytes(&self) -> Vec<u8> {
        let mut out = Vec::new();
        self.encode(&mut out);
        out
    }

    /// The value that all of these bytes encode.
    ///
    /// # Errors
    /// Where and why they do not encode one.
    fn from_bytes(bytes: &[u8]) -> Result<Self, Malformed> {
        let mut reader = Reader::new(bytes);
        let value = Self::decode(&mut reader)?;
        match reader.left() {
            0 => Ok(value),
            left => Err(Malformed(format!("{left} bytes too many"))),
        }
    }
}

macro_rules! numbers {
    ($($number:ty),*) => {$(
        impl Encode for $number {
            fn encode(&self, out: &mut Vec<u8>) {
                out.extend(self.to_le_bytes());
            }

            fn decode(reader: &mut Reader) -> Result<Self, Malformed> {
                Ok(<$number>::from_le_bytes(reader.array()?))
            }
        }
    )*};
}

numbers!(u8, u16, u32, u64, i32, f64);

/// Encoded as 64 bits.
impl Encode for usize {
    fn encode(&self, out: &mut Vec<u8>) {
        (*self as u64).encode(out);
    }

    fn decode(reader: &mut Reader) -> Result<usize, Malformed> {
        let number = u64::decode(reader)?;
        usize::try_from(number).or_else(|_| reader.wrong(format!("{number} is no index")))
    }
}

/// Reads the length of a list. Each entry takes at least one byte, so a length that is too large is detected at once.
fn length(reader: &mut Reader) -> Result<usize, Malformed> {
    let len = u32::decode(reader)? as usize;
    if len > reader.left() {
        reader.wrong(format!("a list of {len} entries is longer than what is left"))
    } else {
        Ok(len)
    }
}

impl Encode for bool {
    fn encode(&self, out: &mut Vec<u8>) {
        out.push(u8::from(*self));
    }

    fn decode(reader: &mut Reader) -> Result<bool, Malformed> {
        match u8::decode(reader)? {
            0 => Ok(false),
            1 => Ok(true),
            other => reader.wrong(format!("{other} is neither true nor false")),
        }
    }
}

impl Encode for String {
    fn encode(&self, out: &mut Vec<u8>) {
        (self.len() as u32).encode(out);
        out.extend(self.as_bytes());
    }

    fn decode(reader: &mut Reader) -> Result<String, Malformed> {
        let len = length(reader)?;
        match std::str::from_utf8(reader.take(len)?) {
            Ok(text) => Ok(text.to_string()),
            Err(_) => reader.wrong("a text is not UTF-8"),
        }
    }
}

impl<T: Encode> Encode for Vec<T> {
    fn encode(&self, out: &mut Vec<u8>) {
        (self.len() as u32).encode(out);
        self.iter().for_each(|entry| entry.encode(out));
    }

    fn decode(reader: &mut Reader) -> Result<Vec<T>, Malformed> {
        (0..length(reader)?).map(|_| T::decode(reader)).collect()
    }
}

impl<T: Encode> Encode for Option<T> {
    fn encode(&self, out: &mut Vec<u8>) {
        self.is_some().encode(out);
        self.iter().for_each(|value| value.encode(out));
    }

    fn decode(reader: &mut Reader) -> Result<Option<T>, Malformed> {
        Ok(if bool::decode(reader)? { Some(T::decode(reader)?) } else { None })
    }
}

impl<T: Encode> Encode for Box<T> {
    fn encode(&self, out: &mut Vec<u8>) {
        (**self).encode(out);
    }

    fn decode(reader: &mut Reader) -> Result<Box<T>, Malformed> {
        T::decode(reader).map(Box::new)
    }
}

impl<A: Encode, B: Encode> Encode for (A, B) {
    fn encode(&self, out: &mut Vec<u8>) {
        self.0.encode(out);
        self.1.encode(out);
    }

    fn decode(reader: &mut Reader) -> Result<(A, B), Malformed> {
        Ok((A::decode(reader)?, B::decode(reader)?))
    }
}

impl Encode for Arc<[f64]> {
    fn encode(&self, out: &mut Vec<u8>) {
        self.to_vec().encode(out);
    }

    fn decode(reader: &mut Reader) -> Result<Arc<[f64]>, Malformed> {
        Vec::decode(reader).map(Arc::from)
    }
}

/// Implements [`Encode`](crate::encode::Encode) for structs of encodable fields: `encode_structs! { Segment { start, len } … }`.
#[macro_export]
macro_rules! encode_structs {
    ($($name:ty { $($field:ident),* $(,)? })*) => {$(
        impl $crate::encode::Encode for $name {
            fn encode(&self, out: &mut Vec<u8>) {
                $($crate::encode::Encode::encode(&self.$field, out);)*
            }

            fn decode(reader: &mut $crate::encode::Reader) -> Result<Self, $crate::encode::Malformed> {
                $(let $field = $crate::encode::Encode::decode(reader)?;)*
                Ok(Self { $($field),* })
            }
        }
    )*};
}

/// Implements [`Encode`](crate::encode::Encode) for enums without fields, one byte each: `encode_enums! { Kind { Param = 0, Input = 1 } … }`.
/// The numbers must never change.
#[macro_export]
macro_rules! encode_enums {
    ($($name:ty { $($variant:ident = $number:literal),* $(,)? })*) => {$(
        impl $crate::encode::Encode for $name {
            fn encode(&self, out: &mut Vec<u8>) {
                out.push(match self { $(<$name>::$variant => $number),* });
            }

            fn decode(reader: &mut $crate::encode::Reader) -> Result<Self, $crate::encode::Malformed> {
                match <u8 as $crate::encode::Encode>::decode(reader)? {
                    $($number => Ok(<$name>::$variant),)*
                    other => Err($crate::encode::Malformed(format!("{other} is no {}", stringify!($name)))),
                }
            }
        }
    )*};
}

impl Encode for Slot {
    fn encode(&self, out: &mut Vec<u8>) {
        self.0.encode(out);
    }

    fn decode(reader: &mut Reader) -> Result<Slot, Malformed> {
        u32::decode(reader).map(Slot)
    }
}

/// Encoded as the lengths of its consecutive segments.
impl Encode for Layout {
    fn encode(&self, out: &mut Vec<u8>) {
        self.lens().iter().chain([&self.trial.len, &self.rings.len]).for_each(|len| len.encode(out));
    }

    fn decode(reader: &mut Reader) -> Result<Layout, Malformed> {
        let mut lens = [0; 10];
        for len in &mut lens {
            *len = u32::decode(reader)?;
        }
        let (trial, rings) = (u32::decode(reader)?, u32::decode(reader)?);
        let all = lens.iter().chain([&trial, &rings]);
        let size = all.fold(Slot::FIXED.into(), |sum: u64, len| sum + u64::from(*len));
        // Generated code addresses the block with 32-bit byte offsets.
        if size > i32::MAX as u64 / 8 {
            return reader.wrong(format!("a block of {size} slots is too large"));
        }
        let layout = Layout::new(lens);
        // The length of a trial follows from the other lengths and the number of guards. The limit on states prevents
        // overflow.
        let least = (lens[2] < 1 << 14).then(|| layout.clone().with_trial(0).trial.len);
        match least.and_then(|least| trial.checked_sub(least)) {
            _ if trial == 0 => Ok(layout.with_rings(rings)),
            Some(bounds) if bounds % 2 == 0 => Ok(layout.with_trial(bounds / 2).with_rings(rings)),
            _ => reader.wrong(format!("a trial step of {} states has not {trial} slots", lens[2])),
        }
    }
}

impl Encode for Dimension {
    fn encode(&self, out: &mut Vec<u8>) {
        self.0.iter().for_each(|exponent| exponent.parts().encode(out));
    }

    fn decode(reader: &mut Reader) -> Result<Dimension, Malformed> {
        let mut exponents = [Ratio::ZERO; 5];
        for exponent in &mut exponents {
            let (num, den) = <(i32, i32)>::decode(reader)?;
            let fits = den > 0 && num != i32::MIN && Ratio::new(num.into(), den.into()).parts() == (num, den);
            if !fits {
                return reader.wrong(format!("{num}/{den} is no fraction in lowest terms"));
            }
            *exponent = Ratio::new(num.into(), den.into());
        }
        Ok(Dimension(exponents))
    }
}

encode_enums! {
    Angle { Silent = 0, Angle = 1, Rate = 2, Cycles = 3 }
    Kind { Param = 0, Input = 1, State = 2, SampledState = 3, Output = 4, Let = 5, Regime = 6, Observed = 7 }
}

encode_structs! {
    Unit { dimension, scale, text, angle }
    Quantity { path, kind, unit, boolean, slot, range, doc }
    Tick { period, due }
    Automaton { path, regimes, slot }
    Segment { start, len }
    Delay { time, range, back, source, past, weight, slope, ring }
    Guard { path, slot, range, unit }
    Root { text, decides, bends, observed }
}

/// The coupling of the Jacobian is not encoded: files only contain code for fixed steps.
impl Encode for crate::description::Description {
    fn encode(&self, out: &mut Vec<u8>) {
        let Self { name, layout, quantities, ticks, automata, delays, guards, roots, coupling: _, pool } = self;
        name.encode(out);
        layout.encode(out);
        quantities.encode(out);
        ticks.encode(out);
        automata.encode(out);
        delays.encode(out);
        guards.encode(out);
        roots.encode(out);
        pool.encode(out);
    }

    fn decode(reader: &mut Reader) -> Result<Self, Malformed> {
        Ok(Self {
            name: Encode::decode(reader)?,
            layout: Encode::decode(reader)?,
            quantities: Encode::decode(reader)?,
            ticks: Encode::decode(reader)?,
            automata: Encode::decode(reader)?,
            delays: Encode::decode(reader)?,
            guards: Encode::decode(reader)?,
            roots: Encode::decode(reader)?,
            coupling: [].into(),
            pool: Encode::decode(reader)?,
        })
    }
}
