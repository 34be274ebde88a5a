//! The log of a rig: a thread of its own writes the messages of the cycle to a file.
//!
//! In: messages of 64-bit words from the cycle, through a wait-free queue. Out: a file of blocks (see [`blocks`]) with
//! a head, messages and a tail. Knows nothing of the meaning of the words.
//!
//! A block is closed after a fixed number of messages of kind [`CYCLE`], not after a time, so two equal runs write
//! equal files. If the queue is full, the message is dropped and counted, and the next one that fits carries the number
//! of those missing. After an error of the file the thread continues to empty the queue and counts the messages: each
//! message is either in the file or counted.
//!
//! The thread packs each block (differences, then deflate) and begins a new file once the last one is long enough (see
//! [`parts`]). A new file begins with the same head and a message of kind [`STATE`], so each can be read alone.

use super::blocks::{self, Block, BlockReader, BlockWriter, End, LONGEST as BLOCK_LONGEST};
use super::claim::Claim;
use super::packed;
use super::parts::{self, Disk, Limits};
use crate::spsc::{Receiver, Sender, queue};
use std::collections::VecDeque;
use std::fs::{self, File};
use std::io::{self, BufReader, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Kinds of blocks.
const TAIL: u32 = 3;
const PACKED: u32 = 4;
const PACKED_HEAD: u32 = 5;
/// Kinds that only older logs have: head and messages that are not compressed.
const HEAD: u32 = 1;
const MESSAGES: u32 = 2;
/// Name of the section in the head of each file after the first: number of the part, checksum of the first head.
const PART: &str = "part";

/// Kind of message: one cycle.
pub const CYCLE: u32 = 1;
/// Kind of message: everything on which the next cycle depends. A new file begins with one.
pub const STATE: u32 = 2;
/// Kind of message: the number of messages dropped here.
pub const LOST: u32 = 0;

/// Capacity of the queue in words: some seconds of a rig.
const QUEUE: usize = 1 << 20;
/// Longest message in words; a longer one is a programming error.
const LONGEST: usize = 1 << 16;

/// Named texts and bytes: the contents of head and tail.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Sections(pub Vec<(String, Vec<u8>)>);

impl Sections {
    /// Adds a section.
    pub fn with(mut self, name: &str, bytes: impl Into<Vec<u8>>) -> Sections {
        self.0.push((name.into(), bytes.into()));
        self
    }

    /// The first section of this name.
    pub fn get(&self, name: &str) -> Option<&[u8]> {
        self.0.iter().find(|(known, _)| known == name).map(|(_, bytes)| bytes.as_slice())
    }

    /// The first section of this name, if it is a text.
    pub fn text(&self, name: &str) -> Option<&str> {
        std::str::from_utf8(self.get(name)?).ok()
    }

    fn bytes(&self) -> Vec<u8> {
        let mut out = Vec::new();
        for part in self.0.iter().flat_map(|(name, bytes)| [name.as_bytes(), bytes]) {
            out.extend((part.len() as u32).to_le_bytes());
            out.extend(part);
        }
        out
    }

    fn read(mut bytes: &[u8]) -> Option<Sections> {
        let mut part = || {
            let (length, rest) = bytes.split_first_chunk::<4>()?;
            let (part, rest) = rest.split_at_checked(u32::from_le_bytes(*length) as usize)?;
            bytes = rest;
            Some((part.to_vec(), rest.is_empty()))
        };
        let mut all = Vec::new();
        loop {
            let (name, _) = part()?;
            let (bytes, last) = part()?;
            all.push((String::from_utf8(name).ok()?, bytes));
            if last {
                return Some(Sections(all));
            }
        }
    }
}

/// Destination of a log.
pub enum Sink {
    /// This file, and the parts that follow it.
    File(PathBuf, Limits),
    /// A black box: the last blocks, this many, are kept in memory, and written to this file only if the run ends with
    /// a stop.
    BlackBox(PathBuf, usize),
    /// As `File`, on a disk that may fail, with a queue of this many words.
    #[cfg(test)]
    On(Box<dyn Disk>, PathBuf, Limits, usize),
}

impl Sink {
    /// Capacity of the queue in words.
    fn queue(&self) -> usize {
        match self {
            Sink::File(..) | Sink::BlackBox(..) => QUEUE,
            #[cfg(test)]
            Sink::On(.., words) => *words,
        }
    }
}

/// How a log is written.
pub struct Settings {
    /// Its destination.
    pub sink: Sink,
    /// Cycles per block.
    pub cycles_per_block: u32,
    /// Whether the caller waits when the queue is full. Only where time is simulated; never for a rig.
    pub patient: bool,
}

/// The cycle's end of the queue.
pub struct Log {
    queue: Sender<u64>,
    shared: Arc<Shared>,
    patient: bool,
    /// Only the last blocks are kept: older messages are in no file, and do not count as missing.
    boxed: bool,
    /// Messages dropped since the last one that fitted.
    lost: u64,
    /// Total of messages dropped because the queue was full.
    dropped: u64,
    thread: Option<JoinHandle<io::Result<()>>>,
}

#[derive(Default)]
struct Shared {
    /// No more messages will come.
    over: AtomicBool,
    /// Messages that reached the thread but will be in no file.
    lost: AtomicU64,
    /// Bytes written.
    written: AtomicU64,
    /// Free bytes on the disk at the last check.
    free: AtomicU64,
    /// Files begun.
    parts: AtomicU64,
    /// Old logs removed to make room.
    removed: AtomicU64,
}

/// Totals of a log at its end.
#[derive(Debug)]
pub struct Summary {
    /// Messages that are not in the files because the queue was full.
    pub dropped: u64,
    /// Bytes of all files.
    pub bytes: u64,
    /// Number of files.
    pub parts: u64,
    /// Old logs that were removed, to stay within [`Limits::keep`].
    pub removed: u64,
}

impl Summary {
    /// Describes which files were written and which older ones removed.
    pub fn words(&self, first: &Path) -> String {
        let size = parts::size(self.bytes);
        let files = match u32::try_from(self.parts).unwrap_or(u32::MAX) {
            0 | 1 => first.display().to_string(),
            last => format!("{} … {}", first.display(), parts::path(first, last).display()),
        };
        match self.removed {
            0 => format!("{files} ({size})"),
            removed => format!("{files} ({size}); {removed} old logs were removed to make room"),
        }
    }
}

impl Log {
    /// Begins a log.
    ///
    /// # Errors
    /// Those of the file.
    pub fn begin(settings: Settings, head: &Sections) -> io::Result<Log> {
        let (queue, end) = queue(settings.sink.queue());
        let boxed = matches!(settings.sink, Sink::BlackBox(..));
        let shared = Arc::new(Shared::default());
        let mut carrier = Carrier::new(settings.sink, settings.cycles_per_block, end, shared.clone())?;
        carrier.keep_head(&head.bytes())?;
        let thread = std::thread::Builder::new().name("fric log".into()).spawn(move || carrier.carry())?;
        Ok(Log { queue, shared, patient: settings.patient, boxed, lost: 0, dropped: 0, thread: Some(thread) })
    }

    /// Appends a message. Neither waits nor allocates, unless `patient`.
    ///
    /// # Panics
    /// If the message is longer than that of any cycle.
    pub fn push(&mut self, kind: u32, words: &[u64]) {
        assert!(words.len() < LONGEST, "a message of {} words", words.len());
        let needed = words.len() + 1 + if self.lost > 0 { 2 } else { 0 };
        // The thread empties the queue even if its file fails.
        while self.patient && self.queue.free() < needed && !self.queue.is_abandoned() {
            std::thread::sleep(Duration::from_micros(100));
        }
        if self.queue.free() < needed {
            self.lost += 1;
            self.dropped += 1;
            return;
        }
        let mut put = |words: &[u64]| assert!(self.queue.push_all(words), "the places were counted");
        if self.lost > 0 {
            put(&[word(LOST, 1), self.lost]);
            self.lost = 0;
        }
        put(&[word(kind, words.len())]);
        put(words);
    }

    /// Free bytes on the disk of the log at the last check.
    pub fn free(&self) -> u64 {
        self.shared.free.load(Ordering::Relaxed)
    }

    /// Messages so far that are and will be in no file.
    pub fn dropped(&self) -> u64 {
        self.dropped + self.shared.lost.load(Ordering::Relaxed)
    }

    /// Ends the log. `stopped`: a black box is written out.
    ///
    /// # Errors
    /// Why the file could not be written, and how many messages it lacks.
    pub fn end(mut self, tail: &Sections, stopped: bool) -> io::Result<Summary> {
        let words = pack(&tail.bytes());
        self.patient = true;
        for piece in words.chunks(LONGEST / 2) {
            self.push(TAIL_PART, piece);
        }
        self.push(TAIL_END, &[tail.bytes().len() as u64, u64::from(stopped)]);
        self.shared.over.store(true, Ordering::Release);
        let thread = self.thread.take().expect("a log ends once");
        let carried = thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        let dropped = self.dropped();
        carried.map_err(|error| match self.boxed {
            true => error,
            false => io::Error::new(error.kind(), format!("{error}; {dropped} messages are not in it")),
        })?;
        let [bytes, parts, removed] =
            [&self.shared.written, &self.shared.parts, &self.shared.removed].map(|count| count.load(Ordering::Relaxed));
        Ok(Summary { dropped, bytes, parts, removed })
    }
}

/// A log that is dropped without `end`: its messages so far are written, without a tail.
impl Drop for Log {
    fn drop(&mut self) {
        self.shared.over.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Kinds of messages that do not reach a file as such.
const TAIL_PART: u32 = u32::MAX - 1;
const TAIL_END: u32 = u32::MAX;

/// Number of the caller's messages among these words; the log's own messages do not count.
fn records(words: &[u64]) -> u64 {
    u64::from(![LOST, TAIL_PART, TAIL_END].contains(&((words[0] >> 32) as u32)))
}

fn word(kind: u32, length: usize) -> u64 {
    u64::from(kind) << 32 | length as u64
}

/// Bytes as words, the last one padded with zeros.
fn pack(bytes: &[u8]) -> Vec<u64> {
    let word = |chunk: &[u8]| {
        let mut whole = [0; 8];
        whole[..chunk.len()].copy_from_slice(chunk);
        u64::from_le_bytes(whole)
    };
    bytes.chunks(8).map(word).collect()
}

/// The state of the writing thread.
struct Carrier {
    queue: Receiver<u64>,
    shared: Arc<Shared>,
    out: Out,
    cycles_per_block: u32,
    cycles: u32,
    block: Vec<u8>,
    /// Messages in the open block.
    held: u64,
    tail: Vec<u8>,
}

enum Out {
    File(Parts),
    Ring { path: PathBuf, head: Vec<u8>, blocks: VecDeque<Vec<u8>>, most: usize },
}

/// The files of a log.
struct Parts {
    first: PathBuf,
    limits: Limits,
    disk: Box<dyn Disk>,
    writer: BlockWriter<Box<dyn Write + Send>>,
    /// Excludes other processes from writing a log of this name.
    _claim: Option<Claim>,
    /// Number of the file being written, from 1.
    number: u32,
    /// Bytes in it.
    bytes: u64,
    head: Vec<u8>,
}

impl Parts {
    fn begin(disk: Box<dyn Disk>, first: PathBuf, mut limits: Limits) -> io::Result<Parts> {
        if let Some(keep) = limits.keep {
            limits.part = limits.part.min(keep / 4);
        }
        parts::make_folder_of(&first)?;
        let claim = Claim::on(&first)?;
        let writer = BlockWriter::new(disk.create(&first, 1)?)?;
        Ok(Parts { _claim: claim, first, limits, disk, writer, number: 1, bytes: 0, head: Vec::new() })
    }

    /// Begins the next file, with the head and the number of the part.
    fn next(&mut self) -> io::Result<()> {
        self.number += 1;
        self.bytes = 0;
        self.writer = BlockWriter::new(self.disk.create(&self.first, self.number)?)?;
        let part = format!("{} {:08x}", self.number, blocks::mark(&self.head));
        let head = Sections::read(&self.head).unwrap_or_default().with(PART, part);
        self.write(PACKED_HEAD, &packed::pack_bytes(&head.bytes()))?;
        Ok(())
    }

    /// Appends a block; returns its bytes in the file.
    fn write(&mut self, kind: u32, bytes: &[u8]) -> io::Result<u64> {
        self.writer.write(kind, bytes)?;
        let added = bytes.len() as u64 + blocks::OVERHEAD;
        self.bytes += added;
        Ok(added)
    }

    /// Removes old logs if the total size is limited; returns how many files.
    fn make_room(&self) -> io::Result<u64> {
        // Reserve room for this file: one part, and as much again for its head and its growth until the next state.
        let room = |keep: u64| keep.saturating_sub(2 * self.limits.part);
        let current = parts::path(&self.first, self.number);
        self.limits.keep.map_or(Ok(0), |keep| parts::remove_oldest(&current, room(keep)))
    }

    /// Free bytes on the disk; an error if the log must not take more.
    fn free(&self) -> io::Result<u64> {
        let free = self.disk.free(&parts::path(&self.first, self.number))?;
        if free < self.limits.reserve {
            let (free, reserve) = (free / 1_000_000, self.limits.reserve / 1_000_000);
            let why = format!("the disk has {free} MB free, and the last {reserve} MB are left to others");
            return Err(io::Error::new(io::ErrorKind::StorageFull, why));
        }
        Ok(free)
    }
}

impl Carrier {
    fn new(sink: Sink, cycles_per_block: u32, queue: Receiver<u64>, shared: Arc<Shared>) -> io::Result<Carrier> {
        let out = match sink {
            Sink::File(path, limits) => Out::File(Parts::begin(Box::new(parts::System), path, limits)?),
            #[cfg(test)]
            Sink::On(disk, path, limits, _) => Out::File(Parts::begin(disk, path, limits)?),
            Sink::BlackBox(path, most) => Out::Ring { path, head: Vec::new(), blocks: VecDeque::new(), most },
        };
        shared.parts.store(1, Ordering::Relaxed);
        let (block, tail) = (Vec::new(), Vec::new());
        let carrier = Carrier { queue, shared, out, cycles_per_block, cycles: 0, block, held: 0, tail };
        carrier.make_room()?;
        carrier.look_at_disk()?;
        Ok(carrier)
    }

    fn make_room(&self) -> io::Result<()> {
        if let Out::File(parts) = &self.out {
            self.shared.removed.fetch_add(parts.make_room()?, Ordering::Relaxed);
        }
        Ok(())
    }

    fn look_at_disk(&self) -> io::Result<()> {
        if let Out::File(parts) = &self.out {
            self.shared.free.store(parts.free()?, Ordering::Relaxed);
        }
        Ok(())
    }

    /// Writes until the log ends; after an error, only counts messages.
    fn carry(mut self) -> io::Result<()> {
        let mut words = Vec::new();
        let mut carried = Ok(());
        loop {
            let over = self.shared.over.load(Ordering::Acquire);
            while let Some(first) = self.queue.first() {
                words.clear();
                if !self.queue.take((first & 0xffff_ffff) as usize + 1, &mut words) {
                    break;
                }
                if carried.is_ok() {
                    carried = self.take(&words);
                } else {
                    self.held += records(&words);
                }
                self.give_up(&carried);
            }
            if over && carried.is_ok() {
                carried = self.close();
                self.give_up(&carried);
            }
            if over {
                return carried;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// After an error, counts the messages in memory as lost.
    fn give_up(&mut self, carried: &io::Result<()>) {
        if carried.is_err() {
            self.shared.lost.fetch_add(std::mem::take(&mut self.held), Ordering::Relaxed);
        }
    }

    fn take(&mut self, words: &[u64]) -> io::Result<()> {
        let kind = (words[0] >> 32) as u32;
        match kind {
            TAIL_PART => self.tail.extend(words[1..].iter().flat_map(|word| word.to_le_bytes())),
            TAIL_END => {
                self.close()?;
                let mut tail = std::mem::take(&mut self.tail);
                tail.truncate(words[1] as usize);
                self.keep(TAIL, tail)?;
                if words[2] != 0 {
                    self.write_out()?;
                }
            }
            _ => {
                let rolls = matches!(&self.out, Out::File(parts) if kind == STATE && parts.bytes >= parts.limits.part);
                let rolled = if rolls { self.next_part() } else { Ok(()) };
                self.held += records(words);
                rolled?;
                self.block.extend(words.iter().flat_map(|word| word.to_le_bytes()));
                self.cycles += u32::from(kind == CYCLE);
                if self.cycles >= self.cycles_per_block {
                    self.close()?;
                }
            }
        }
        Ok(())
    }

    /// Closes the open block.
    fn close(&mut self) -> io::Result<()> {
        self.cycles = 0;
        let block = std::mem::take(&mut self.block);
        if block.is_empty() { Ok(()) } else { self.keep(PACKED, packed::pack(&block)) }
    }

    /// Ends this file and begins the next one.
    fn next_part(&mut self) -> io::Result<()> {
        self.close()?;
        let Out::File(parts) = &mut self.out else { return Ok(()) };
        parts.next()?;
        self.shared.written.fetch_add(parts.bytes, Ordering::Relaxed);
        self.shared.parts.fetch_add(1, Ordering::Relaxed);
        self.make_room()
    }

    fn keep_head(&mut self, head: &[u8]) -> io::Result<()> {
        if let Out::File(parts) = &mut self.out {
            parts.head = head.to_vec();
        }
        self.keep(PACKED_HEAD, packed::pack_bytes(head))
    }

    fn keep(&mut self, kind: u32, bytes: Vec<u8>) -> io::Result<()> {
        match &mut self.out {
            Out::File(parts) => {
                let added = parts.write(kind, &bytes)?;
                // From here on they are in the file, even if the disk fails later.
                self.held = if kind == PACKED { 0 } else { self.held };
                self.shared.written.fetch_add(added, Ordering::Relaxed);
                self.look_at_disk()?;
            }
            Out::Ring { head, blocks, most, .. } => match kind {
                PACKED_HEAD => *head = bytes,
                PACKED => {
                    self.held = 0;
                    blocks.push_back(bytes);
                    if blocks.len() > *most {
                        blocks.pop_front();
                    }
                }
                _ => self.tail = bytes,
            },
        }
        Ok(())
    }

    /// Writes a black box.
    fn write_out(&self) -> io::Result<()> {
        let Out::Ring { path, head, blocks: kept, .. } = &self.out else { return Ok(()) };
        parts::make_folder_of(path)?;
        let _claim = Claim::on(path)?;
        let mut writer = BlockWriter::new(File::create(path)?)?;
        let all = [(PACKED_HEAD, head)].into_iter().chain(kept.iter().map(|block| (PACKED, block)));
        for (kind, bytes) in all.chain([(TAIL, &self.tail)]) {
            writer.write(kind, bytes)?;
            self.shared.written.fetch_add(bytes.len() as u64 + blocks::OVERHEAD, Ordering::Relaxed);
        }
        Ok(())
    }
}

/// One message.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Message {
    /// Its kind.
    pub kind: u32,
    /// Its words.
    pub words: Vec<u64>,
}

/// Reads a log from the beginning of a file, and continues through the files that follow it.
pub struct Reader {
    blocks: BlockReader<BufReader<File>>,
    /// The head of the log.
    pub head: Sections,
    tail: Option<Sections>,
    bytes: Vec<u8>,
    at: usize,
    /// The file being read, the number of its part, and the checksum that all parts of the log share.
    path: PathBuf,
    number: u32,
    mark: u32,
    /// The next file was there when this one was last looked at.
    complete: bool,
}

impl Reader {
    /// Opens a log, or a later part of one.
    ///
    /// # Errors
    /// Why not, in words.
    pub fn open(path: &Path) -> Result<Reader, String> {
        let (blocks, head) = Reader::begin(path)?;
        let bytes = head.bytes();
        let (number, mark) = part_of(&head).unwrap_or((1, blocks::mark(&bytes)));
        let path = path.to_path_buf();
        Ok(Reader { blocks, head, tail: None, bytes: Vec::new(), at: 0, path, number, mark, complete: false })
    }

    fn begin(path: &Path) -> Result<(BlockReader<BufReader<File>>, Sections), String> {
        let file = File::open(path).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => "there is no such file".to_string(),
            _ => error.to_string(),
        })?;
        let blocks = BlockReader::new(BufReader::new(file)).map_err(|error| error.to_string())?;
        let Some(mut blocks) = blocks else { return Err("it is not a log of fric".into()) };
        let first = blocks.block().map_err(|error| error.to_string())?;
        let bytes = first.and_then(|Block { kind, bytes }| match kind {
            PACKED_HEAD => packed::unpack_bytes(&bytes, BLOCK_LONGEST as usize),
            HEAD => Some(bytes),
            _ => None,
        });
        let head = bytes.and_then(|bytes| Sections::read(&bytes));
        let Some(head) = head else { return Err("its head is cut off or damaged".into()) };
        Ok((blocks, head))
    }

    /// Continues with the next file of the log; false if there is none.
    fn follow(&mut self) -> io::Result<bool> {
        let path = parts::following(&self.path, self.number);
        let Ok((blocks, head)) = Reader::begin(&path) else { return Ok(false) };
        if part_of(&head) != Some((self.number + 1, self.mark)) {
            return Ok(false);
        }
        if self.complete {
            (self.blocks, self.path, self.number, self.complete) = (blocks, path, self.number + 1, false);
        } else {
            // This file may have grown since its end was read, and is complete only now that the next one exists.
            self.complete = true;
            self.blocks.resume()?;
        }
        Ok(true)
    }

    /// Lets [`Reader::message`] return messages that were written since it returned none.
    ///
    /// # Errors
    /// Those of the file.
    pub fn resume(&mut self) -> io::Result<()> {
        if self.tail.is_none() {
            self.blocks.resume()?;
        }
        Ok(())
    }

    /// The next message; none at the end of the readable part.
    ///
    /// # Errors
    /// Those of the file.
    pub fn message(&mut self) -> io::Result<Option<Message>> {
        while self.at == self.bytes.len() {
            match self.blocks.block()? {
                None => {
                    let goes_on = self.tail.is_none() && self.blocks.end() == Some(End::Whole) && self.follow()?;
                    if !goes_on {
                        return Ok(None);
                    }
                }
                Some(Block { kind: MESSAGES, bytes }) => (self.bytes, self.at) = (bytes, 0),
                Some(Block { kind: PACKED, bytes }) => {
                    let unpacked = packed::unpack(&bytes, BLOCK_LONGEST as usize);
                    let odd = || io::Error::other("a block of the log cannot be unpacked");
                    (self.bytes, self.at) = (unpacked.ok_or_else(odd)?, 0);
                }
                Some(Block { kind: TAIL, bytes }) => self.tail = Sections::read(&bytes),
                Some(_) => {}
            }
        }
        let word = |at: usize| {
            let bytes = self.bytes.get(at..at + 8)?;
            Some(u64::from_le_bytes(bytes.try_into().expect("eight bytes")))
        };
        let whole = || {
            let first = word(self.at)?;
            let length = (first & 0xffff_ffff) as usize;
            let words: Option<Vec<u64>> = (1..=length).map(|i| word(self.at + 8 * i)).collect();
            Some(Message { kind: (first >> 32) as u32, words: words? })
        };
        let message = whole().ok_or_else(|| io::Error::other("a block of the log does not hold whole messages"))?;
        self.at += 8 * (message.words.len() + 1);
        Ok(Some(message))
    }

    /// The file being read.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The tail; none if it has not been reached or was never written.
    pub fn tail(&self) -> Option<&Sections> {
        self.tail.as_ref()
    }

    /// How the file ends, once there is no further message.
    pub fn end(&self) -> Option<End> {
        self.blocks.end()
    }

    /// How the log ends, in words, once it was read to its end. `name`: how to call it.
    ///
    /// # Errors
    /// Where it is damaged.
    pub fn ending(&self, name: &str) -> Result<String, String> {
        match self.end() {
            Some(End::Cut { at }) => Ok(format!("{name} is cut off at byte {at}: the writer was killed")),
            Some(End::Damaged { at }) => Err(format!("{name} is damaged at byte {at}")),
            Some(End::Whole) | None => Ok(match self.tail().and_then(|tail| tail.text("end")) {
                Some(end) => format!("it ended {end}"),
                None => "it was not ended: the writer was killed".into(),
            }),
        }
    }
}

/// The newest file of the log of a run, which its head calls `started`; none if there is none yet. `first`: where the
/// first one is, or was before it was removed to make room.
pub fn newest_part(first: &Path, started: &str) -> Option<PathBuf> {
    let folder = first.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let number = |entry: fs::DirEntry| {
        let name = entry.file_name().to_string_lossy().into_owned();
        let numbers = name.rsplit('.').take(2).filter_map(|part| part.parse::<u32>().ok());
        let number = numbers.chain([1]).find(|number| parts::path(first, *number).file_name() == Some(name.as_ref()));
        number.filter(|number| *number > 0)
    };
    let mut numbers: Vec<u32> = fs::read_dir(folder).ok()?.flatten().filter_map(number).collect();
    numbers.sort_unstable_by(|a, b| b.cmp(a));
    let ours = |path: &PathBuf| Reader::open(path).is_ok_and(|reader| reader.head.text("started") == Some(started));
    numbers.into_iter().map(|number| parts::path(first, number)).find(ours)
}

/// Part number and checksum in the head of a file after the first.
fn part_of(head: &Sections) -> Option<(u32, u32)> {
    let (number, mark) = head.text(PART)?.split_once(' ')?;
    Some((number.parse().ok().filter(|number| *number > 1)?, u32::from_str_radix(mark, 16).ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;

    fn head() -> Sections {
        Sections::default().with("rig", "r").with("empty", "").with("bytes", [0, 255, 3])
    }

    fn settings(sink: Sink) -> Settings {
        Settings { sink, cycles_per_block: 10, patient: true }
    }

    fn messages(reader: &mut Reader) -> Vec<Message> {
        std::iter::from_fn(|| reader.message().unwrap()).collect()
    }

    #[test]
    fn sections_survive_the_round_trip() {
        assert_eq!(Sections::read(&head().bytes()), Some(head()));
        let bytes = head().bytes();
        for cut in 0..bytes.len() {
            assert_ne!(Sections::read(&bytes[..cut]), Some(head()), "cut at {cut}");
        }
        assert_eq!(head().text("rig"), Some("r"));
        assert_eq!((head().text("bytes"), head().get("none")), (None, None));
    }

    #[test]
    fn messages_reach_the_file_in_order() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        let mut log = Log::begin(settings(Sink::File(path.clone(), Limits::default())), &head()).unwrap();
        for k in 0..1000u64 {
            log.push(CYCLE, &[k, !k]);
            if k % 100 == 0 {
                log.push(2, &vec![k; 300]);
            }
        }
        let tail = Sections::default().with("end", "as asked");
        let summary = log.end(&tail, false).unwrap();
        assert_eq!(summary.dropped, 0);
        let mut reader = Reader::open(&path).unwrap();
        assert_eq!(reader.head, head());
        let found = messages(&mut reader);
        assert_eq!(found.len(), 1010);
        assert_eq!(found[0], Message { kind: CYCLE, words: vec![0, !0] });
        assert_eq!(found[1], Message { kind: 2, words: vec![0; 300] });
        assert_eq!(found[1009], Message { kind: CYCLE, words: vec![999, !999] });
        assert_eq!((reader.tail(), reader.end()), (Some(&tail), Some(End::Whole)));
    }

    /// A reader that follows a log while it is written, in several files, at random instants: it finds each message once,
    /// in order.
    #[test]
    fn a_growing_log_is_read_as_it_is_written() {
        for seed in 1..=20 {
            let mut chance = Chance(seed);
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("log.friclog");
            let limits = Limits { part: 600, ..Limits::default() };
            let mut log = Log::begin(settings(Sink::File(path.clone(), limits)), &head()).unwrap();
            let (mut reader, mut found, mut k) = (None, Vec::new(), 0_u64);
            let mut look = |reader: &mut Option<Reader>| {
                if reader.is_none() {
                    *reader = Reader::open(&path).ok();
                }
                let Some(reader) = reader else { return };
                reader.resume().unwrap();
                found.extend(messages(reader).into_iter().filter(|message| message.kind == CYCLE).map(|m| m.words[0]));
            };
            while k < 1000 {
                for _ in 0..=chance.below(40) {
                    if k % 50 == 0 {
                        log.push(STATE, &[k; 20]);
                    }
                    // Words that do not compress, so that files become long enough to end.
                    log.push(CYCLE, &[k, chance.number(), chance.number()]);
                    k += 1;
                }
                if chance.below(3) == 0 {
                    std::thread::sleep(Duration::from_millis(6));
                }
                look(&mut reader);
            }
            log.end(&Sections::default().with("end", "as asked"), false).unwrap();
            look(&mut reader);
            let reader = reader.unwrap();
            assert!(reader.tail().is_some() && reader.number > 3, "seed {seed}: {} files", reader.number);
            assert_eq!(found, (0..k).collect::<Vec<u64>>(), "seed {seed}");
        }
    }

    #[test]
    fn two_equal_runs_leave_equal_files() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str, pause: bool| {
            let path = folder.path().join(name);
            let mut log = Log::begin(settings(Sink::File(path.clone(), Limits::default())), &head()).unwrap();
            for k in 0..200u64 {
                log.push(CYCLE, &[k]);
                if pause && k % 37 == 0 {
                    std::thread::sleep(Duration::from_millis(7));
                }
            }
            log.end(&Sections::default().with("end", ""), false).unwrap();
            std::fs::read(path).unwrap()
        };
        assert_eq!(file("a", false), file("b", true));
    }

    #[test]
    fn a_full_queue_drops_messages_and_logs_their_number() {
        let (queue, mut end) = queue(16);
        let shared = Arc::new(Shared::default());
        let mut log = Log { queue, shared, patient: false, boxed: false, lost: 0, dropped: 0, thread: None };
        for k in 0..6 {
            log.push(CYCLE, &[k, k, k]);
        }
        assert_eq!(log.dropped(), 2);
        let mut all = Vec::new();
        assert!(end.take(16, &mut all));
        assert_eq!(all[12..], [word(CYCLE, 3), 3, 3, 3]);
        log.push(CYCLE, &[6, 6, 6]);
        all.clear();
        assert!(end.take(6, &mut all));
        assert_eq!(all, [word(LOST, 1), 2, word(CYCLE, 3), 6, 6, 6]);
    }

    #[test]
    fn a_black_box_holds_the_last_blocks_of_a_run_that_was_stopped() {
        let folder = tempfile::tempdir().unwrap();
        let run = |stopped| {
            let path = folder.path().join(format!("box-{stopped}"));
            let mut log = Log::begin(settings(Sink::BlackBox(path.clone(), 3)), &head()).unwrap();
            (0..95).for_each(|k| log.push(CYCLE, &[k]));
            log.end(&Sections::default().with("cause", "x"), stopped).unwrap();
            path
        };
        assert!(!run(false).exists());
        let mut reader = Reader::open(&run(true)).unwrap();
        let found = messages(&mut reader);
        assert_eq!(found.first().unwrap().words, [70]);
        assert_eq!(found.last().unwrap().words, [94]);
        assert_eq!(reader.tail().unwrap().text("cause"), Some("x"));
    }

    #[test]
    fn an_unfinished_log_is_readable_up_to_its_end() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        let mut log = Log::begin(settings(Sink::File(path.clone(), Limits::default())), &head()).unwrap();
        (0..25).for_each(|k| log.push(CYCLE, &[k]));
        drop(log);
        let mut reader = Reader::open(&path).unwrap();
        assert_eq!(messages(&mut reader).len(), 25);
        assert_eq!((reader.tail(), reader.end()), (None, Some(End::Whole)));
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() - 1]).unwrap();
        let mut reader = Reader::open(&path).unwrap();
        assert_eq!(messages(&mut reader).len(), 20);
        assert!(matches!(reader.end(), Some(End::Cut { .. })));
    }

    /// Writes random messages, with a state now and then, into parts of `limits`; returns the first file and the
    /// messages.
    fn in_parts(folder: &Path, seed: u64, limits: Limits) -> (PathBuf, Vec<Message>) {
        let (mut chance, path) = (Chance(seed), folder.join(format!("{seed}.friclog")));
        let mut log = Log::begin(settings(Sink::File(path.clone(), limits)), &head()).unwrap();
        let mut written = Vec::new();
        for k in 0..200 + chance.below(400) {
            let kind = if chance.below(17) == 0 { STATE } else { CYCLE };
            let words: Vec<u64> = [k].into_iter().chain((0..chance.below(20)).map(|_| chance.number())).collect();
            log.push(kind, &words);
            written.push(Message { kind, words });
        }
        if chance.below(4) > 0 {
            log.end(&Sections::default().with("end", "as asked"), false).unwrap();
        }
        (path, written)
    }

    #[test]
    fn parts_are_read_as_one_log_and_each_from_its_own_beginning() {
        let folder = tempfile::tempdir().unwrap();
        let mut most = 0;
        for seed in 0..40 {
            let limits = Limits { part: 2000 + 500 * (seed % 9), ..Limits::default() };
            let (path, written) = in_parts(folder.path(), seed, limits);
            assert_eq!(messages(&mut Reader::open(&path).unwrap()), written, "seed {seed}");
            let mut at = 0;
            for number in (2..).take_while(|number| parts::path(&path, *number).exists()) {
                let found = messages(&mut Reader::open(&parts::path(&path, number)).unwrap());
                assert_eq!(found, written[written.len() - found.len()..], "seed {seed}, part {number}");
                assert_eq!(found[0].kind, STATE, "seed {seed}, part {number}");
                assert!(written.len() - found.len() > at, "seed {seed}: a part without a message");
                (at, most) = (written.len() - found.len(), most.max(number));
            }
        }
        assert!(most > 5, "{most} parts at most");
    }

    #[test]
    fn a_truncated_part_ends_the_log_and_a_part_of_another_log_is_ignored() {
        let folder = tempfile::tempdir().unwrap();
        let limits = Limits { part: 3000, ..Limits::default() };
        let (path, written) = in_parts(folder.path(), 1, limits);
        let second = parts::path(&path, 2);
        let bytes = std::fs::read(&second).unwrap();
        std::fs::write(&second, &bytes[..bytes.len() - 1]).unwrap();
        let mut reader = Reader::open(&path).unwrap();
        let found = messages(&mut reader);
        assert!(!found.is_empty() && found == written[..found.len()]);
        assert!(matches!(reader.end(), Some(End::Cut { .. })));
        assert_eq!(reader.path(), second);
        std::fs::write(&second, bytes).unwrap();
        // The same parts after another head.
        let other = folder.path().join("other.friclog");
        let mut log =
            Log::begin(settings(Sink::File(other.clone(), limits)), &Sections::default().with("a", "b")).unwrap();
        log.push(CYCLE, &[1]);
        drop(log);
        std::fs::copy(&second, parts::path(&other, 2)).unwrap();
        assert_eq!(messages(&mut Reader::open(&other).unwrap()).len(), 1);
    }

    #[test]
    fn all_parts_together_stay_within_the_limit() {
        let folder = tempfile::tempdir().unwrap();
        let keep = 40_000;
        let path = folder.path().join("a.friclog");
        let limits = Limits { keep: Some(keep), ..Limits::default() };
        let mut log = Log::begin(settings(Sink::File(path.clone(), limits)), &head()).unwrap();
        let mut chance = Chance(7);
        for k in 0..3000 {
            log.push(if k % 20 == 0 { STATE } else { CYCLE }, &std::array::from_fn::<u64, 8, _>(|_| chance.number()));
            if k % 100 == 0 {
                let sizes = std::fs::read_dir(folder.path()).unwrap().flatten().filter_map(|file| file.metadata().ok());
                assert!(sizes.map(|file| file.len()).sum::<u64>() <= keep);
            }
        }
        let summary = log.end(&Sections::default().with("end", "x"), false).unwrap();
        assert!(summary.parts > 10 && summary.removed > 10 && !path.exists(), "{summary:?}");
        let last = parts::path(&path, summary.parts as u32);
        assert!(Reader::open(&last).is_ok());
    }

    #[test]
    fn a_disk_that_is_nearly_full_gets_no_log() {
        let folder = tempfile::tempdir().unwrap();
        let limits = Limits { reserve: u64::MAX, ..Limits::default() };
        let begun = Log::begin(settings(Sink::File(folder.path().join("a.friclog"), limits)), &head());
        assert_eq!(begun.err().unwrap().kind(), io::ErrorKind::StorageFull);
    }

    #[test]
    fn only_one_process_writes_a_log() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        let mut first = Log::begin(settings(Sink::File(path.clone(), Limits::default())), &head()).unwrap();
        (0..25).for_each(|k| first.push(CYCLE, &[k]));
        let why = Log::begin(settings(Sink::File(path.clone(), Limits::default())), &head()).err().unwrap().to_string();
        assert!(why.contains("another process writes this file"), "{why}");
        // Also after it continues in another file and the first is gone.
        std::fs::remove_file(&path).unwrap();
        assert!(Log::begin(settings(Sink::File(path.clone(), Limits::default())), &head()).is_err() && !path.exists());
        std::fs::write(&path, []).unwrap();
        first.end(&Sections::default().with("end", "as asked"), false).unwrap();
        // It is free again, and a device is never locked.
        assert!(Log::begin(settings(Sink::File(path, Limits::default())), &head()).is_ok());
        let null = || Log::begin(settings(Sink::File("/dev/null".into(), Limits::default())), &head());
        let both = (null(), null());
        assert!(both.0.is_ok() && both.1.is_ok());
    }

    #[test]
    fn a_file_that_is_not_a_log_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x");
        let why = |path: &Path| Reader::open(path).err().unwrap();
        assert_eq!(why(&path), "there is no such file");
        std::fs::write(&path, "k,t\n1,2\n").unwrap();
        assert_eq!(why(&path), "it is not a log of fric");
        std::fs::write(&path, super::super::blocks::MAGIC).unwrap();
        assert_eq!(why(&path), "its head is cut off or damaged");
    }
}
