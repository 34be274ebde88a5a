//! Signals in frames that are described field by field, by hand or by a DBC file.
//!
//! In: a [`Field`] and the data of a frame. Out: its value, SI, and the reverse. Source of the bit numbering: the DBC
//! format, little-endian ("Intel") and big-endian ("Motorola").

use super::units::beyond;
use crate::safety::{Protection, is_present};
use abi::rig::{Field, Format, Message};

/// Position of the k-th bit of a field, counted from its least significant bit: byte, and bit within the byte.
fn place(field: &Field, k: u16) -> (usize, u16) {
    if !field.big_endian {
        let bit = field.start_bit + k;
        return ((bit / 8).into(), bit % 8);
    }
    // A big-endian field starts at its most significant bit and continues downwards in a byte, then at the top of the
    // next byte.
    let from_start = field.bits - 1 - k;
    let linear = (field.start_bit / 8) * 8 + (7 - field.start_bit % 8) + from_start;
    ((linear / 8).into(), 7 - linear % 8)
}

/// The raw bits of a field; none if the frame is too short for it.
fn raw(field: &Field, data: &[u8]) -> Option<u64> {
    let mut raw = 0;
    for k in 0..field.bits {
        let (byte, bit) = place(field, k);
        raw |= u64::from(data.get(byte)? >> bit & 1) << k;
    }
    Some(raw)
}

/// Whether a frame contains a field: its multiplexer, if it has one, is present and has the right value.
fn present(message: &Message, field: usize, data: &[u8]) -> bool {
    let mut at = field;
    // A multiplexer may itself be multiplexed; no chain is longer than the message.
    for _ in 0..=message.fields.len() {
        let Some((switch, value)) = message.fields[at].multiplexed else { return true };
        if raw(&message.fields[switch], data) != Some(value) {
            return false;
        }
        at = switch;
    }
    false
}

/// The value of a field, SI; none if the frame is too short or does not contain the field (multiplexing). A float may
/// be infinite or NaN.
pub fn read(message: &Message, field: usize, data: &[u8]) -> Option<f64> {
    if !present(message, field, data) {
        return None;
    }
    let field = &message.fields[field];
    let raw = raw(field, data)?;
    let number = match field.format {
        Format::Unsigned => raw as f64,
        Format::Signed => {
            let unused = 64 - u32::from(field.bits);
            ((raw << unused) as i64 >> unused) as f64
        }
        Format::Float32 => f32::from_bits(raw as u32).into(),
        Format::Float64 => f64::from_bits(raw),
    };
    Some(number * field.scale + field.offset)
}

/// Encodes a value, SI, into the data of a frame. It is rounded towards zero, so that the encoded value never exceeds
/// the permitted one, and clamped to the range of the bits. If an offset makes 0 unrepresentable, the step nearest to 0
/// may exceed a value between steps.
pub fn write(field: &Field, value: f64, data: &mut [u8; 8]) {
    let steps = (value - field.offset) / field.scale;
    let unused = 64 - u32::from(field.bits);
    let raw = match field.format {
        // A cast of a float saturates, and converts NaN to 0.
        Format::Unsigned => (whole(field, steps, value) as u64).min(u64::MAX >> unused),
        Format::Signed => (whole(field, steps, value) as i64).clamp(i64::MIN >> unused, i64::MAX >> unused) as u64,
        Format::Float32 => u64::from(single(field, steps, value).to_bits()),
        Format::Float64 => steps.to_bits(),
    };
    for k in 0..field.bits {
        let (byte, bit) = place(field, k);
        if let Some(byte) = data.get_mut(byte) {
            *byte = *byte & !(1 << bit) | ((raw >> k & 1) as u8) << bit;
        }
    }
}

/// Whether the value of this many steps exceeds the permitted value, SI.
fn is_beyond(field: &Field, steps: f64, value: f64) -> bool {
    let size = value.abs() + field.offset.abs();
    beyond(steps * field.scale + field.offset, value, size) && is_present(Protection::Rounding)
}

/// The nearest integer number of steps, or its neighbour towards 0 SI if the nearest exceeds the value and the
/// neighbour does not.
fn whole(field: &Field, steps: f64, value: f64) -> f64 {
    let nearest = steps.round();
    let towards = nearest - (value * field.scale).signum();
    if is_beyond(field, nearest, value) && !is_beyond(field, towards, value) { towards } else { nearest }
}

/// The same for the steps of a 32-bit float.
fn single(field: &Field, steps: f64, value: f64) -> f32 {
    let nearest = steps as f32;
    let towards = if value * field.scale > 0.0 { nearest.next_down() } else { nearest.next_up() };
    let moves = is_beyond(field, nearest.into(), value) && !is_beyond(field, towards.into(), value);
    if moves { towards } else { nearest }
}

/// Encodes the values of all fields, SI, into the data of a frame. Of fields that share bits, those are encoded whose
/// multiplexer has their value. Bits outside of all fields become 0.
pub fn fill(message: &Message, value: impl Fn(usize) -> f64, data: &mut [u8; 8]) {
    *data = [0; 8];
    let switches = |field: usize| {
        let above = |at: &usize| message.fields[*at].multiplexed.map(|(switch, _)| switch);
        std::iter::successors(Some(field), above).take(message.fields.len() + 1).count()
    };
    // Multiplexers before their fields.
    for depth in 1..=message.fields.len() {
        let mut deeper = false;
        for (k, field) in message.fields.iter().enumerate() {
            let its = switches(k);
            deeper |= its > depth;
            if its == depth && present(message, k, data) {
                write(field, value(k), data);
            }
        }
        if !deeper {
            break;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;
    use abi::unit::Unit;

    fn field(start_bit: u16, bits: u16, big_endian: bool, format: Format) -> Field {
        Field {
            name: String::new(),
            start_bit,
            bits,
            big_endian,
            format,
            scale: 1.0,
            offset: 0.0,
            start: 0.0,
            unit: Unit::none(),
            multiplexed: None,
        }
    }

    fn message(fields: Vec<Field>) -> Message {
        Message { name: String::new(), id: 1, extended: false, length: 8, send: false, period_ns: 0, fields }
    }

    fn value(field: Field, data: &[u8]) -> Option<f64> {
        read(&message(vec![field]), 0, data)
    }

    #[test]
    fn bit_numbering_matches_the_formats() {
        let data = [0x12, 0x34, 0x56, 0x78, 0x9A, 0xBC, 0xDE, 0xF0];
        let unsigned = |start, bits, big| value(field(start, bits, big, Format::Unsigned), &data);
        assert_eq!(unsigned(0, 16, false), Some(f64::from(0x3412)));
        assert_eq!(unsigned(7, 16, true), Some(f64::from(0x1234)));
        assert_eq!(unsigned(4, 12, false), Some(f64::from(0x341)));
        assert_eq!(unsigned(3, 12, true), Some(f64::from(0x234)));
        assert_eq!(unsigned(11, 10, true), Some(f64::from(0x456 >> 2)));
        assert_eq!(unsigned(0, 1, false), Some(0.0));
        assert_eq!(unsigned(1, 1, true), Some(1.0));
        assert_eq!(unsigned(56, 8, false), Some(f64::from(0xF0)));
        let signed = |start, bits, big| value(field(start, bits, big, Format::Signed), &data);
        assert_eq!(signed(56, 8, false), Some(-16.0));
        assert_eq!(signed(39, 16, true), Some(f64::from(0x9ABCu16 as i16)));
        assert_eq!(value(field(0, 64, false, Format::Signed), &data), Some(0xF0DE_BC9A_7856_3412u64 as i64 as f64));
    }

    #[test]
    fn what_is_written_is_read() {
        for big_endian in [false, true] {
            for (bits, format) in
                [(7, Format::Signed), (13, Format::Unsigned), (32, Format::Float32), (64, Format::Float64)]
            {
                let start = if big_endian { 7 } else { 0 };
                let mut field = field(start, bits, big_endian, format);
                (field.scale, field.offset) = (0.5, 10.0);
                for wanted in [10.0, 11.5, 12.0, 20.5] {
                    let mut data = [0xFF; 8];
                    write(&field, wanted, &mut data);
                    assert_eq!(value(field.clone(), &data), Some(wanted), "{bits} bits {format:?}");
                }
            }
        }
    }

    #[test]
    fn the_encoded_value_never_exceeds_the_permitted_one() {
        let mut random = Chance(5);
        for case in 0..50_000 {
            let (bits, format) = [
                (8, Format::Signed),
                (16, Format::Signed),
                (12, Format::Unsigned),
                (32, Format::Float32),
                (64, Format::Float64),
            ][random.below(5) as usize];
            let mut field = field(0, bits, false, format);
            field.scale = 10f64.powf(random.between(-6.0, 3.0)) * [1.0, -1.0][random.below(2) as usize];
            let most = 2f64.powi(i32::from(bits.min(16)) - 1) - 1.0;
            let sign = if format == Format::Unsigned { field.scale.signum() } else { 1.0 };
            let share = random.between(if format == Format::Unsigned { 0.0 } else { -1.0 }, 1.0);
            // Offsets by whole steps, so that 0 is representable.
            field.offset =
                if format == Format::Unsigned { 0.0 } else { field.scale * f64::from(random.below(5) as u32) };
            let value = share * sign * (most - 8.0) * field.scale.abs();
            let mut data = [0; 8];
            write(&field, value, &mut data);
            let wire = read(&message(vec![field.clone()]), 0, &data).unwrap();
            let slack = 8.0 * f64::EPSILON * (value.abs() + field.offset.abs());
            assert!(wire.abs() <= value.abs() + slack, "case {case}: {value} became {wire} ({field:?})");
            assert!(
                (value - wire).abs() <= field.scale.abs() + slack,
                "case {case}: {value} became {wire} ({field:?})"
            );
        }
    }

    #[test]
    fn neighbouring_bits_stay_and_values_are_clamped() {
        let mut data = [0; 8];
        write(&field(4, 8, false, Format::Signed), 1e9, &mut data);
        assert_eq!(data[..2], [0xF0, 0x07]);
        write(&field(4, 8, false, Format::Signed), -1e9, &mut data);
        assert_eq!(data[..2], [0x00, 0x08]);
        write(&field(0, 4, false, Format::Unsigned), f64::NAN, &mut data);
        write(&field(12, 4, false, Format::Unsigned), 99.0, &mut data);
        assert_eq!(data[..2], [0x00, 0xF8]);
    }

    #[test]
    fn fields_that_share_bits_are_written_according_to_their_multiplexer() {
        let byte = |k: u16| field(8 * k, 8, false, Format::Unsigned);
        let mut message = message(vec![byte(2), byte(1), byte(2), byte(0), byte(3)]);
        // Field 3 multiplexes 0 and 1; field 1 multiplexes 2 and 4.
        message.fields[0].multiplexed = Some((3, 0));
        message.fields[1].multiplexed = Some((3, 1));
        message.fields[2].multiplexed = Some((1, 7));
        message.fields[4].multiplexed = Some((1, 8));
        let filled = |values: [f64; 5]| {
            let mut data = [0xFF; 8];
            fill(&message, |k| values[k], &mut data);
            data
        };
        assert_eq!(filled([5.0, 7.0, 6.0, 0.0, 9.0]), [0, 0, 5, 0, 0, 0, 0, 0]);
        assert_eq!(filled([5.0, 7.0, 6.0, 1.0, 9.0]), [1, 7, 6, 0, 0, 0, 0, 0]);
        assert_eq!(filled([5.0, 8.0, 6.0, 1.0, 9.0]), [1, 8, 0, 9, 0, 0, 0, 0]);
        assert_eq!(filled([5.0, 8.0, 6.0, 2.0, 9.0]), [2, 0, 0, 0, 0, 0, 0, 0]);
        // A field whose multiplexer is absent is absent too.
        assert_eq!(read(&message, 2, &[0, 7, 6, 0]), None);
        assert_eq!(read(&message, 2, &[1, 7, 6, 0]), Some(6.0));
    }

    #[test]
    fn short_frames_and_other_multiplexers_have_no_value() {
        let mut two = message(vec![field(0, 8, false, Format::Unsigned), field(8, 8, false, Format::Unsigned)]);
        two.fields[1].multiplexed = Some((0, 2));
        assert_eq!(read(&two, 1, &[2, 7]), Some(7.0));
        assert_eq!(read(&two, 1, &[1, 7]), None);
        assert_eq!(read(&two, 1, &[2]), None);
    }

    /// The plausibility check of readings handles NaN and infinity, in one place.
    #[test]
    fn a_float_that_is_not_finite_is_decoded_unchanged() {
        let told = |number: f32| value(field(0, 32, false, Format::Float32), &number.to_bits().to_le_bytes()).unwrap();
        assert!(told(f32::NAN).is_nan());
        assert_eq!([f32::INFINITY, f32::NEG_INFINITY].map(told), [f64::INFINITY, f64::NEG_INFINITY]);
    }
}
