//! Length of a frame on the bus in bits, by constructing its bits.
//!
//! In: a frame. Out: its length in bits, including stuff bits and interframe space. Source: ISO 11898-1:2015, 10.4 and
//! 10.5.

use super::Frame;

/// Bits after the stuffed region: CRC delimiter, acknowledge slot and delimiter, end of frame, interframe space.
const TAIL: u32 = 1 + 2 + 7 + SPACE;

/// Interframe space: recessive bits between frames.
pub const SPACE: u32 = 3;

/// CRC-15 of CAN: x¹⁵ + x¹⁴ + x¹⁰ + x⁸ + x⁷ + x⁴ + x³ + 1.
const POLYNOMIAL: u16 = 0x4599;

/// Length of a frame in bits, including the interframe space.
pub fn bits(frame: &Frame) -> u32 {
    let mut string = Bits::of(frame);
    let crc = string.crc();
    string.push(crc.into(), 15);
    string.length + string.stuffing() + TAIL
}

/// Length of the longest frame with this many data bytes: a stuff bit after the first five and then after every four
/// bits.
pub fn bits_at_most(extended: bool, bytes: u8) -> u32 {
    let region = if extended { 54 } else { 34 } + 8 * u32::from(bytes);
    region + (region - 1) / 4 + TAIL
}

/// Arbitration key of frames that start together: the dominant bit is 0, so the lowest key wins.
pub fn arbitration(frame: &Frame) -> u32 {
    let remote = u32::from(frame.is_remote());
    match frame.is_extended() {
        // Base identifier, RTR, IDE.
        false => frame.id() << 21 | remote << 20,
        // Base identifier, SRR, IDE, identifier extension, RTR.
        true => (frame.id() >> 18) << 21 | 0b11 << 19 | (frame.id() & 0x3FFFF) << 1 | remote,
    }
}

/// A string of up to 128 bits, the first one highest. The longest stuffed region has 54 + 64 bits.
struct Bits {
    bits: u128,
    length: u32,
}

impl Bits {
    /// The bits from the start of the frame to the end of its data.
    fn of(frame: &Frame) -> Bits {
        let mut string = Bits { bits: 0, length: 0 };
        let remote = u64::from(frame.is_remote());
        string.push(0, 1);
        match frame.is_extended() {
            // RTR, IDE, r0.
            false => {
                string.push(frame.id().into(), 11);
                string.push(remote << 2, 3);
            }
            // SRR, IDE; RTR, r1, r0.
            true => {
                string.push((frame.id() >> 18).into(), 11);
                string.push(0b11, 2);
                string.push((frame.id() & 0x3FFFF).into(), 18);
                string.push(remote << 2, 3);
            }
        }
        string.push(frame.length().into(), 4);
        frame.data().iter().for_each(|&byte| string.push(byte.into(), 8));
        string
    }

    fn push(&mut self, value: u64, length: u32) {
        self.bits = self.bits << length | u128::from(value);
        self.length += length;
    }

    fn each(&self) -> impl Iterator<Item = u16> {
        (0..self.length).rev().map(|at| (self.bits >> at & 1) as u16)
    }

    fn crc(&self) -> u16 {
        self.each().fold(0, |crc, bit| {
            let next = bit ^ crc >> 14 & 1;
            (crc << 1 ^ if next == 1 { POLYNOMIAL } else { 0 }) & 0x7FFF
        })
    }

    /// Number of stuff bits: after five equal bits an opposite one is inserted, which counts as the first of the next
    /// five.
    fn stuffing(&self) -> u32 {
        let (mut stuffed, mut run, mut last) = (0, 0, 2);
        for bit in self.each() {
            run = if bit == last { run + 1 } else { 1 };
            last = bit;
            if run == 5 {
                (stuffed, run, last) = (stuffed + 1, 1, 1 - bit);
            }
        }
        stuffed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_47_bits_8_a_byte_and_its_stuffing() {
        // 0x555 alternates, so only the run of reserved bits and length needs stuffing.
        let plain = |frame: &Frame| 47 + 8 * u32::from(frame.length()) + if frame.is_extended() { 20 } else { 0 };
        for frame in [Frame::new(0x555, &[]), Frame::new(0x2AA, &[0x55; 8]), Frame::extended(0x15555555, &[0xAA; 3])] {
            let extra = bits(&frame) - plain(&frame);
            assert!(extra <= 4, "{frame}: {extra} stuff bits");
        }
        // SOF and eleven dominant identifier bits, RTR, IDE, r0, length 0, CRC 0: 34 equal bits. The first stuff bit is
        // inserted after five bits, then one after every five more, since each stuff bit breaks the run.
        assert_eq!(bits(&Frame::new(0, &[])), 47 + 34 / 5);
    }

    #[test]
    fn no_frame_is_longer_than_the_bound() {
        let mut seed = 1u64;
        let mut next = || {
            seed = seed.wrapping_mul(0x5851_F42D_4C95_7F2D).wrapping_add(1);
            seed >> 33
        };
        for _ in 0..20_000 {
            let bytes: Vec<u8> =
                (0..next() % 9).map(|_| [0, 0xFF, 0x1F, 0xE0, next() as u8][(next() % 5) as usize]).collect();
            let (id, extended) = (next() as u32, next() % 2 == 0);
            let frame =
                if extended { Frame::extended(id >> 3 & 0x1FFF_FFFF, &bytes) } else { Frame::new(id & 0x7FF, &bytes) };
            let (least, most) = (
                47 + 8 * bytes.len() as u32 + if extended { 20 } else { 0 },
                bits_at_most(extended, bytes.len() as u8),
            );
            assert!((least..=most).contains(&bits(&frame)), "{frame}: {} of {least}..{most} bits", bits(&frame));
        }
        assert_eq!([0, 2, 4, 6, 8].map(|bytes| bits_at_most(false, bytes)), [55, 75, 95, 115, 135]);
    }

    #[test]
    fn the_crc_is_that_of_can() {
        // Check value of CRC-15/CAN: the CRC of the text "123456789".
        let mut string = Bits { bits: 0, length: 0 };
        b"123456789".iter().for_each(|&digit| string.push(digit.into(), 8));
        assert_eq!(string.crc(), 0x059E);
    }

    #[test]
    fn the_dominant_bit_wins() {
        let order = [
            Frame::new(0x080, &[]),
            Frame::remote(0x080, 0),
            Frame::extended(0x080 << 18, &[]),
            Frame::extended(0x080 << 18 | 1, &[]),
            Frame::new(0x081, &[]),
        ];
        assert!(order.is_sorted_by_key(arbitration));
    }
}
