//! Append-only files of blocks that remain readable however the writer ends.
//!
//! In: blocks of bytes with a kind. Out: a file of which every prefix is readable: all complete blocks, and the
//! position of the first incomplete one. Knows nothing of the contents of blocks.
//!
//! ```text
//! file   "fric log 1\n", then blocks
//! block  length u32 · kind u32 · checksum u32 · length bytes            all little-endian
//! ```
//! The checksum (CRC-32) covers the number of the block, length, kind and bytes, so that a flipped bit, a missing block
//! and a block out of order are all detected.

use std::io::{self, Read, Seek, SeekFrom, Write};

/// The first bytes of such a file.
pub const MAGIC: &[u8] = b"fric log 1\n";
/// A longer block was not written by this module.
pub const LONGEST: u32 = 1 << 28;

/// Bytes of a block's header.
pub const OVERHEAD: u64 = 12;

/// Identifies a head: its CRC-32.
pub fn mark(bytes: &[u8]) -> u32 {
    crc32fast::hash(bytes)
}

/// One block.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Block {
    /// The kind of its contents.
    pub kind: u32,
    /// The contents.
    pub bytes: Vec<u8>,
}

/// Writes blocks.
pub struct BlockWriter<W: Write> {
    out: W,
    number: u64,
}

impl<W: Write> BlockWriter<W> {
    /// Begins a file.
    ///
    /// # Errors
    /// Those of the file.
    pub fn new(mut out: W) -> io::Result<BlockWriter<W>> {
        out.write_all(MAGIC)?;
        Ok(BlockWriter { out, number: 0 })
    }

    /// Appends a block and passes it to the operating system.
    ///
    /// # Errors
    /// Those of the file.
    pub fn write(&mut self, kind: u32, bytes: &[u8]) -> io::Result<()> {
        let length = u32::try_from(bytes.len()).ok().filter(|length| *length <= LONGEST);
        let length = length.unwrap_or_else(|| panic!("a block of {} bytes", bytes.len()));
        let mut whole = Vec::with_capacity(bytes.len() + 12);
        whole.extend(length.to_le_bytes());
        whole.extend(kind.to_le_bytes());
        whole.extend(checksum(self.number, length, kind, bytes).to_le_bytes());
        whole.extend(bytes);
        self.number += 1;
        // One write call per block: a process killed between two calls leaves complete blocks.
        self.out.write_all(&whole)?;
        self.out.flush()
    }
}

fn checksum(number: u64, length: u32, kind: u32, bytes: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&number.to_le_bytes());
    hasher.update(&length.to_le_bytes());
    hasher.update(&kind.to_le_bytes());
    hasher.update(bytes);
    hasher.finalize()
}

/// How the readable part of a file ends.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum End {
    /// A complete block, at the end of the file.
    Whole,
    /// The last block is truncated: the writer was killed, or the file is still being written.
    Cut {
        /// Byte offset of the block.
        at: u64,
    },
    /// The checksum of a block does not match.
    Damaged {
        /// Byte offset of the block.
        at: u64,
    },
}

/// Reads blocks.
pub struct BlockReader<R: Read> {
    input: R,
    number: u64,
    at: u64,
    end: Option<End>,
}

impl<R: Read> BlockReader<R> {
    /// Opens a file. None if it is not a file of blocks.
    ///
    /// # Errors
    /// Those of the file.
    pub fn new(mut input: R) -> io::Result<Option<BlockReader<R>>> {
        let mut magic = Vec::new();
        (&mut input).take(MAGIC.len() as u64).read_to_end(&mut magic)?;
        let at = MAGIC.len() as u64;
        Ok((magic == MAGIC).then_some(BlockReader { input, number: 0, at, end: None }))
    }

    /// The next block; none at the end of the readable part: see [`BlockReader::end`].
    ///
    /// # Errors
    /// Those of the file.
    pub fn block(&mut self) -> io::Result<Option<Block>> {
        if self.end.is_some() {
            return Ok(None);
        }
        let mut head = Vec::with_capacity(12);
        (&mut self.input).take(12).read_to_end(&mut head)?;
        if head.is_empty() {
            self.end = Some(End::Whole);
            return Ok(None);
        }
        let Ok(head) = <[u8; 12]>::try_from(head) else { return Ok(self.stop(End::Cut { at: self.at })) };
        let word = |i: usize| u32::from_le_bytes([head[i], head[i + 1], head[i + 2], head[i + 3]]);
        let (length, kind, expected) = (word(0), word(4), word(8));
        if length > LONGEST {
            return Ok(self.stop(End::Damaged { at: self.at }));
        }
        let mut bytes = Vec::new();
        (&mut self.input).take(u64::from(length)).read_to_end(&mut bytes)?;
        if bytes.len() < length as usize {
            return Ok(self.stop(End::Cut { at: self.at }));
        }
        if checksum(self.number, length, kind, &bytes) != expected {
            return Ok(self.stop(End::Damaged { at: self.at }));
        }
        self.number += 1;
        self.at += 12 + u64::from(length);
        Ok(Some(Block { kind, bytes }))
    }

    /// How the file ended, once there is no further block.
    pub fn end(&self) -> Option<End> {
        self.end
    }

    fn stop(&mut self, end: End) -> Option<Block> {
        self.end = Some(end);
        None
    }
}

impl<R: Read + Seek> BlockReader<R> {
    /// Lets [`BlockReader::block`] return blocks that were written since it returned none. After damage nothing is
    /// readable.
    ///
    /// # Errors
    /// Those of the file.
    pub fn resume(&mut self) -> io::Result<()> {
        if let Some(End::Whole | End::Cut { .. }) = self.end {
            self.input.seek(SeekFrom::Start(self.at))?;
            self.end = None;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file() -> (Vec<u8>, Vec<Block>) {
        let blocks: Vec<Block> =
            (0..5).map(|i: u8| Block { kind: u32::from(i % 3), bytes: vec![i; 7 * usize::from(i)] }).collect();
        let mut file = Vec::new();
        let mut writer = BlockWriter::new(&mut file).unwrap();
        blocks.iter().for_each(|block| writer.write(block.kind, &block.bytes).unwrap());
        (file, blocks)
    }

    fn read(mut file: &[u8]) -> Option<(Vec<Block>, End)> {
        let mut reader = BlockReader::new(&mut file).unwrap()?;
        let mut blocks = Vec::new();
        while let Some(block) = reader.block().unwrap() {
            blocks.push(block);
        }
        assert_eq!(reader.block().unwrap(), None, "an end stays one");
        Some((blocks, reader.end().unwrap()))
    }

    #[test]
    fn blocks_survive_the_round_trip() {
        let (file, blocks) = file();
        assert_eq!(read(&file), Some((blocks, End::Whole)));
        assert_eq!(read(b"something else"), None);
        assert_eq!(read(b""), None);
    }

    #[test]
    fn a_file_truncated_at_any_byte_reads_as_a_prefix() {
        let (file, blocks) = file();
        let mut longest = 0;
        for cut in MAGIC.len()..file.len() {
            let (found, end) = read(&file[..cut]).unwrap();
            assert_eq!(found, blocks[..found.len()], "cut at {cut}");
            assert!(found.len() >= longest, "a longer file holds as much");
            longest = found.len();
            let whole = matches!(end, End::Whole);
            let begins: u64 = found.iter().map(|block| block.bytes.len() as u64 + 12).sum::<u64>() + MAGIC.len() as u64;
            assert_eq!(whole, begins == cut as u64, "cut at {cut}: {end:?}");
            if !whole {
                assert_eq!(end, End::Cut { at: begins });
            }
        }
        assert_eq!(longest, 4);
    }

    #[test]
    fn a_flipped_bit_is_noticed() {
        let (file, blocks) = file();
        for byte in 0..file.len() {
            for bit in 0..8 {
                let mut flipped = file.clone();
                flipped[byte] ^= 1 << bit;
                let Some((found, end)) = read(&flipped) else {
                    assert!(byte < MAGIC.len());
                    continue;
                };
                assert_eq!(found, blocks[..found.len()], "byte {byte} bit {bit}");
                assert!(found.len() < blocks.len() && end != End::Whole, "byte {byte} bit {bit}: {end:?}");
            }
        }
    }

    #[test]
    fn a_missing_block_and_one_out_of_place_are_noticed() {
        let one = |kind| {
            let mut file = Vec::new();
            BlockWriter::new(&mut file).unwrap().write(kind, b"abc").unwrap();
            file.split_off(MAGIC.len())
        };
        let mut swapped = MAGIC.to_vec();
        swapped.extend(one(1));
        swapped.extend(one(2));
        assert_eq!(read(&swapped).unwrap().0.len(), 1, "the second was a first");
    }
}
