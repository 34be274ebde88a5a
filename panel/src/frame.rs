//! Frames of curves, as the page reads them: little-endian, each part a multiple of 8 bytes.
//!
//! | part | content |
//! |---|---|
//! | frame | u32 number · u32 blocks · f64 newest time, s |
//! | block | u16 kind · u16 view · u32 curve · u32 cycles a column · u32 count · f64 first · f64 base · count × (f32, f32) |
//!
//! The pairs are relative to `base`, an f64 near the values: over 4 m of travel a plain f32 would have steps of 0.24 µm.

/// Kind of a block: for each column the two extremes of a curve in the order of time; `first` is the number of the
/// first column.
pub const COLUMNS: u16 = 1;
/// Kind of a block: points, x − `first` and y − `base`.
pub const PATH: u16 = 2;

/// Bytes before the blocks, and before the pairs of a block.
const HEAD: usize = 16;

/// A frame under construction.
pub struct Frame {
    bytes: Vec<u8>,
    blocks: u32,
}

/// What a block says besides its pairs.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Block {
    /// [`COLUMNS`] or [`PATH`].
    pub kind: u16,
    /// The view that it answers.
    pub view: u16,
    /// The curve: see [`Subject::blocks`](crate::subject::Subject::blocks).
    pub curve: u32,
    /// Cycles a column.
    pub cycles: u32,
    /// Number of the first column, or the x of the path's first point.
    pub first: f64,
}

impl Frame {
    /// An empty frame. `newest`: the end of the data, s.
    pub fn new(number: u32, newest: f64) -> Frame {
        let mut bytes = Vec::with_capacity(1 << 15);
        bytes.extend(number.to_le_bytes());
        bytes.extend(0_u32.to_le_bytes());
        bytes.extend(newest.to_le_bytes());
        Frame { bytes, blocks: 0 }
    }

    /// Appends a block of columns: pairs of values.
    pub fn columns(&mut self, block: Block, pairs: &[(f64, f64)]) {
        let base = pairs.iter().map(|pair| pair.0).find(|value| value.is_finite()).unwrap_or(0.0);
        self.block(block, base, pairs.iter().map(|(a, b)| (a - base, b - base)), pairs.len());
    }

    /// Appends a block of points (x, y); a y that is not finite is a gap.
    pub fn path(&mut self, block: Block, points: &[(f64, f64)]) {
        let base = points.iter().map(|point| point.1).find(|value| value.is_finite()).unwrap_or(0.0);
        self.block(block, base, points.iter().map(|(x, y)| (x - block.first, y - base)), points.len());
    }

    fn block(&mut self, block: Block, base: f64, pairs: impl Iterator<Item = (f64, f64)>, count: usize) {
        let count = u32::try_from(count).expect("a view has at most a few thousand columns");
        self.bytes.extend(block.kind.to_le_bytes());
        self.bytes.extend(block.view.to_le_bytes());
        self.bytes.extend([block.curve, block.cycles, count].into_iter().flat_map(u32::to_le_bytes));
        self.bytes.extend([block.first, base].into_iter().flat_map(f64::to_le_bytes));
        self.bytes.extend(pairs.flat_map(|(a, b)| [a as f32, b as f32]).flat_map(f32::to_le_bytes));
        self.blocks += 1;
        self.bytes[4..8].copy_from_slice(&self.blocks.to_le_bytes());
    }

    /// Whether it has no block.
    pub fn is_empty(&self) -> bool {
        self.bytes.len() == HEAD
    }

    /// The bytes.
    pub fn bytes(self) -> Vec<u8> {
        self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_keep_a_ten_millionth_of_their_span() {
        let pairs: Vec<(f64, f64)> =
            (0..100).map(|i| (4.0 + 1e-6 * f64::from(i), 4.0 + 1.5e-6 * f64::from(i))).collect();
        let mut frame = Frame::new(7, 1.5);
        assert!(frame.is_empty());
        frame.columns(Block { kind: COLUMNS, view: 3, curve: 9, cycles: 50, first: 12.0 }, &pairs);
        frame
            .path(Block { kind: PATH, view: 4, curve: 1, cycles: 0, first: 1e6 }, &[(1e6, 1.0), (1e6 + 1.0, f64::NAN)]);
        let bytes = frame.bytes();
        assert_eq!(bytes.len(), 16 + 32 + 800 + 32 + 16);
        let u32_at = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        let f64_at = |at: usize| f64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
        let f32_at = |at: usize| f64::from(f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()));
        assert_eq!((u32_at(0), u32_at(4), f64_at(8)), (7, 2, 1.5));
        assert_eq!((u32_at(16), u32_at(20), u32_at(24), u32_at(28)), (1 | 3 << 16, 9, 50, 100));
        assert_eq!((f64_at(32), f64_at(40)), (12.0, 4.0));
        for (i, (a, b)) in pairs.iter().enumerate() {
            let at = 48 + 8 * i;
            assert!((f64_at(40) + f32_at(at) - a).abs() < 1.5e-4 * 1e-7, "{a}");
            assert!((f64_at(40) + f32_at(at + 4) - b).abs() < 1.5e-4 * 1e-7, "{b}");
        }
        let second = 48 + 800;
        assert_eq!((f64_at(second + 16), f32_at(second + 40), f32_at(second + 36)), (1e6, 1.0, 0.0));
        assert!(f32_at(second + 44).is_nan());
    }
}
