//! The log of a rig: what a cycle leaves behind, carried to a file by a thread of its own.
//!
//! In: messages of 64-bit words from the cycle, through a queue that never waits. Out: a file of blocks (see
//! [`blocks`](super::blocks)) with a head, messages and a tail. Knows nothing of what the words mean.
//!
//! A block is closed after a fixed number of messages of kind [`CYCLE`], not after a time: so two equal runs leave equal
//! files. A full queue drops the message and counts it, and the next one that fits says how many are missing.

use super::blocks::{Block, BlockReader, BlockWriter, End};
use crate::queue::{Receiver, Sender, queue};
use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, BufReader};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Kinds of blocks.
const HEAD: u32 = 1;
const MESSAGES: u32 = 2;
const TAIL: u32 = 3;

/// Kind of message: one cycle.
pub const CYCLE: u32 = 1;
/// Kind of message: so many messages were dropped here.
pub const LOST: u32 = 0;

/// Words that fit the queue: some seconds of a rig.
const QUEUE: usize = 1 << 20;
/// Messages longer than this are a mistake.
const LONGEST: usize = 1 << 16;

/// Named texts and bytes: what stands in head and tail.
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

/// Where a log goes.
pub enum Sink {
    /// Into this file, whole.
    File(PathBuf),
    /// So many blocks are kept, and written to this file only if the run ends with a stop: a black box.
    BlackBox(PathBuf, usize),
}

/// How a log is kept.
pub struct Settings {
    /// Where it goes.
    pub sink: Sink,
    /// Cycles in a block.
    pub cycles_per_block: u32,
    /// A full queue makes the caller wait. For time that stands meanwhile; never for a rig.
    pub patient: bool,
}

/// The end of the queue that the cycle holds.
pub struct Log {
    queue: Sender<u64>,
    shared: Arc<Shared>,
    patient: bool,
    /// Messages dropped since the last that fitted.
    lost: u64,
    /// All messages dropped.
    dropped: u64,
    thread: Option<JoinHandle<io::Result<()>>>,
}

#[derive(Default)]
struct Shared {
    /// Nothing more will come.
    over: AtomicBool,
    /// The file no longer takes anything.
    broken: AtomicBool,
    /// Bytes written.
    written: AtomicU64,
}

/// What is left to say at the end.
#[derive(Debug)]
pub struct Summary {
    /// Messages that were dropped because the queue was full.
    pub dropped: u64,
    /// Bytes of the file.
    pub bytes: u64,
}

impl Log {
    /// Begins a log.
    ///
    /// # Errors
    /// Those of the file.
    pub fn begin(settings: Settings, head: &Sections) -> io::Result<Log> {
        let (queue, end) = queue(QUEUE);
        let shared = Arc::new(Shared::default());
        let mut carrier = Carrier::new(settings.sink, settings.cycles_per_block, end, shared.clone())?;
        carrier.keep(HEAD, head.bytes())?;
        let thread = std::thread::Builder::new().name("fric log".into()).spawn(move || carrier.carry())?;
        Ok(Log { queue, shared, patient: settings.patient, lost: 0, dropped: 0, thread: Some(thread) })
    }

    /// Appends a message. Neither waits nor allocates, unless it is patient.
    ///
    /// # Panics
    /// If the message is longer than any cycle's.
    pub fn push(&mut self, kind: u32, words: &[u64]) {
        assert!(words.len() < LONGEST, "a message of {} words", words.len());
        let needed = words.len() + 1 + if self.lost > 0 { 2 } else { 0 };
        while self.patient && self.queue.free() < needed && !self.shared.broken.load(Ordering::Relaxed) {
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

    /// Messages dropped until now.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Ends the log. `stopped`: a black box is written out.
    ///
    /// # Errors
    /// What kept the file from being written.
    pub fn end(mut self, tail: &Sections, stopped: bool) -> io::Result<Summary> {
        let words = pack(&tail.bytes());
        let dropped = self.dropped;
        self.patient = true;
        for piece in words.chunks(LONGEST / 2) {
            self.push(TAIL_PART, piece);
        }
        self.push(TAIL_END, &[tail.bytes().len() as u64, u64::from(stopped)]);
        self.shared.over.store(true, Ordering::Release);
        let thread = self.thread.take().expect("a log ends once");
        thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        Ok(Summary { dropped, bytes: self.shared.written.load(Ordering::Relaxed) })
    }
}

/// A log that is dropped was not ended: what has come is written, without a tail.
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

fn word(kind: u32, length: usize) -> u64 {
    u64::from(kind) << 32 | length as u64
}

/// Bytes as words, the last filled up with zeros.
fn pack(bytes: &[u8]) -> Vec<u64> {
    let word = |chunk: &[u8]| {
        let mut whole = [0; 8];
        whole[..chunk.len()].copy_from_slice(chunk);
        u64::from_le_bytes(whole)
    };
    bytes.chunks(8).map(word).collect()
}

/// The thread's side.
struct Carrier {
    queue: Receiver<u64>,
    shared: Arc<Shared>,
    out: Out,
    cycles_per_block: u32,
    cycles: u32,
    block: Vec<u8>,
    tail: Vec<u8>,
}

enum Out {
    File(BlockWriter<File>),
    Ring { path: PathBuf, head: Vec<u8>, blocks: VecDeque<Vec<u8>>, most: usize },
}

impl Carrier {
    fn new(sink: Sink, cycles_per_block: u32, queue: Receiver<u64>, shared: Arc<Shared>) -> io::Result<Carrier> {
        let out = match sink {
            Sink::File(path) => Out::File(BlockWriter::new(File::create(path)?)?),
            Sink::BlackBox(path, most) => Out::Ring { path, head: Vec::new(), blocks: VecDeque::new(), most },
        };
        let (block, tail) = (Vec::new(), Vec::new());
        Ok(Carrier { queue, shared, out, cycles_per_block, cycles: 0, block, tail })
    }

    /// Carries until all is over.
    fn carry(mut self) -> io::Result<()> {
        let mut words = Vec::new();
        loop {
            let over = self.shared.over.load(Ordering::Acquire);
            while let Some(first) = self.queue.first() {
                words.clear();
                if !self.queue.take((first & 0xffff_ffff) as usize + 1, &mut words) {
                    break;
                }
                if let Err(error) = self.take(&words) {
                    self.shared.broken.store(true, Ordering::Relaxed);
                    return Err(error);
                }
            }
            if over {
                return self.close();
            }
            std::thread::sleep(Duration::from_millis(5));
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
                self.block.extend(words.iter().flat_map(|word| word.to_le_bytes()));
                self.cycles += u32::from(kind == CYCLE);
                if self.cycles >= self.cycles_per_block {
                    self.close()?;
                }
            }
        }
        Ok(())
    }

    /// Closes the block under way.
    fn close(&mut self) -> io::Result<()> {
        self.cycles = 0;
        let block = std::mem::take(&mut self.block);
        if block.is_empty() { Ok(()) } else { self.keep(MESSAGES, block) }
    }

    fn keep(&mut self, kind: u32, bytes: Vec<u8>) -> io::Result<()> {
        match &mut self.out {
            Out::File(writer) => {
                writer.write(kind, &bytes)?;
                self.shared.written.fetch_add(bytes.len() as u64 + 12, Ordering::Relaxed);
            }
            Out::Ring { head, blocks, most, .. } => match kind {
                HEAD => *head = bytes,
                MESSAGES => {
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
    fn write_out(&mut self) -> io::Result<()> {
        let Out::Ring { path, head, blocks, .. } = &self.out else { return Ok(()) };
        let mut writer = BlockWriter::new(File::create(path)?)?;
        writer.write(HEAD, head)?;
        for block in blocks {
            writer.write(MESSAGES, block)?;
        }
        writer.write(TAIL, &self.tail)
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

/// Reads a log from its beginning.
pub struct Reader {
    blocks: BlockReader<BufReader<File>>,
    /// What stands at its beginning.
    pub head: Sections,
    tail: Option<Sections>,
    bytes: Vec<u8>,
    at: usize,
}

impl Reader {
    /// Opens a log.
    ///
    /// # Errors
    /// Why not, in words.
    pub fn open(path: &Path) -> Result<Reader, String> {
        let file = File::open(path).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => "there is no such file".to_string(),
            _ => error.to_string(),
        })?;
        let blocks = BlockReader::new(BufReader::new(file)).map_err(|error| error.to_string())?;
        let Some(mut blocks) = blocks else { return Err("it is not a log of fric".into()) };
        let first = blocks.block().map_err(|error| error.to_string())?;
        let head = first.filter(|block| block.kind == HEAD).and_then(|block| Sections::read(&block.bytes));
        let Some(head) = head else { return Err("its head is cut off or damaged".into()) };
        Ok(Reader { blocks, head, tail: None, bytes: Vec::new(), at: 0 })
    }

    /// The next message; none at the end of what can be read.
    ///
    /// # Errors
    /// Those of the file.
    pub fn message(&mut self) -> io::Result<Option<Message>> {
        while self.at == self.bytes.len() {
            match self.blocks.block()? {
                None => return Ok(None),
                Some(Block { kind: MESSAGES, bytes }) => (self.bytes, self.at) = (bytes, 0),
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

    /// What stands at its end; none if it has not been reached or was never written.
    pub fn tail(&self) -> Option<&Sections> {
        self.tail.as_ref()
    }

    /// How the file ends, once there is no further message.
    pub fn end(&self) -> Option<End> {
        self.blocks.end()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn sections_come_back() {
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
        let mut log = Log::begin(settings(Sink::File(path.clone())), &head()).unwrap();
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

    #[test]
    fn two_equal_runs_leave_equal_files() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str, pause: bool| {
            let path = folder.path().join(name);
            let mut log = Log::begin(settings(Sink::File(path.clone())), &head()).unwrap();
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
    fn a_full_queue_drops_counts_and_says_so() {
        let (queue, mut end) = queue(16);
        let shared = Arc::new(Shared::default());
        let mut log = Log { queue, shared, patient: false, lost: 0, dropped: 0, thread: None };
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
    fn a_log_that_was_not_ended_is_read_as_far_as_it_goes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        let mut log = Log::begin(settings(Sink::File(path.clone())), &head()).unwrap();
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

    #[test]
    fn what_is_no_log_is_refused() {
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
