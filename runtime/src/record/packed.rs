//! Compresses messages of a log to an eighth of their bytes.
//!
//! In: a block of messages, each a word of kind and length followed by that many 64-bit words. Out: the block
//! compressed, and the reverse. Knows neither files nor the meaning of the words.
//!
//! From cycle to cycle most words of a message change little. So each word is replaced by its wrapping difference to
//! the word at the same place of the previous message of the same kind in the block, and the result is deflated (RFC
//! 1951). A block is self-contained: nothing before it is needed to decompress it.

use miniz_oxide::deflate::compress_to_vec;
use miniz_oxide::inflate::decompress_to_vec_with_limit;
use std::collections::BTreeMap;

/// A compromise of speed and size: 100 MB/s of messages, and 2 % more bytes than the slowest level.
const LEVEL: u8 = 6;

/// Compresses texts.
pub fn pack_bytes(bytes: &[u8]) -> Vec<u8> {
    compress_to_vec(bytes, LEVEL)
}

/// Decompresses texts to at most `most` bytes. None if they are longer, or were not compressed here.
pub fn unpack_bytes(packed: &[u8], most: usize) -> Option<Vec<u8>> {
    decompress_to_vec_with_limit(packed, most).ok()
}

/// Compresses a block of complete messages.
pub fn pack(block: &[u8]) -> Vec<u8> {
    let mut bytes = block.to_vec();
    let whole = through(&mut bytes, |word, last| (word.wrapping_sub(last), word));
    debug_assert!(whole, "a block holds whole messages");
    pack_bytes(&bytes)
}

/// Decompresses a block to at most `most` bytes. None if it is longer, or was not made by [`pack`].
pub fn unpack(packed: &[u8], most: usize) -> Option<Vec<u8>> {
    let mut bytes = unpack_bytes(packed, most)?;
    through(&mut bytes, |word, last| {
        let word = word.wrapping_add(last);
        (word, word)
    })
    .then_some(bytes)
}

/// Replaces each word of every message except the first. `change` receives the word and the original word at the same
/// place of the previous message of the same kind (0 if that was shorter), and returns the replacement and the original
/// word. Returns whether the bytes are complete messages.
fn through(bytes: &mut [u8], change: impl Fn(u64, u64) -> (u64, u64)) -> bool {
    let (words, rest) = bytes.as_chunks_mut::<8>();
    let mut last: BTreeMap<u32, Vec<u64>> = BTreeMap::new();
    let mut words = words.iter_mut();
    while let Some(first) = words.next() {
        let first = u64::from_le_bytes(*first);
        let (kind, length) = ((first >> 32) as u32, (first & 0xffff_ffff) as usize);
        if length > words.len() {
            return false;
        }
        let last = last.entry(kind).or_default();
        last.resize(length, 0);
        for (word, last) in words.by_ref().take(length).zip(last) {
            let (changed, original) = change(u64::from_le_bytes(*word), *last);
            *word = changed.to_le_bytes();
            *last = original;
        }
    }
    rest.is_empty()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;

    fn block(chance: &mut Chance) -> Vec<u8> {
        let mut words: Vec<u64> = Vec::new();
        for _ in 0..chance.below(40) {
            let length = chance.below(9);
            words.push(chance.below(3) << 32 | length);
            words.extend((0..length).map(|_| match chance.below(3) {
                0 => chance.below(5),
                1 => (chance.below(1000) as f64).to_bits(),
                _ => u64::MAX - chance.below(2),
            }));
        }
        words.iter().flat_map(|word| word.to_le_bytes()).collect()
    }

    #[test]
    fn any_block_survives_the_round_trip() {
        for seed in 0..500 {
            let block = block(&mut Chance(seed));
            let packed = pack(&block);
            assert_eq!(unpack(&packed, block.len()).as_ref(), Some(&block), "seed {seed}");
            if let Some(less) = block.len().checked_sub(1) {
                assert_eq!(unpack(&packed, less), None, "seed {seed}: a limit is a limit");
            }
        }
    }

    #[test]
    fn foreign_bytes_do_not_unpack() {
        for seed in 0..500 {
            let mut chance = Chance(seed);
            let block = block(&mut chance);
            let mut packed = pack(&block);
            let at = chance.below(packed.len() as u64) as usize;
            packed[at] ^= 1 << chance.below(8);
            // The checksum of the block detects this earlier; here it must only not panic.
            let _ = unpack(&packed, 1 << 16);
        }
        assert_eq!(unpack(&compress_to_vec(&[1, 0, 0, 0, 0, 0, 0, 0], 1), 100), None, "a message that is cut off");
        assert_eq!(unpack(&compress_to_vec(&[0; 9], 1), 100), None, "not whole words");
    }
}
