//! Stop frames that are sent when nothing else works any more: by a thread of its own, by a panic, by a signal.
//!
//! In: frames made ready beforehand by their buses. Out: write(2), and nothing else, so that it is right in a signal
//! handler too, on a stack of its own. Knows no drive.
//!
//! There is one rig in a process, hence one table.

use crate::can::Prepared;
use crate::realtime::clock::{Clock, Monotonic};
use crate::realtime::threads;
use crate::safety::{Protection, is_present};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI32, AtomicPtr, AtomicU32, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// The table in force. It is never freed: a handler may be reading it.
static TABLE: AtomicPtr<Vec<Prepared>> = AtomicPtr::new(std::ptr::null_mut());
/// Number of the signal that asked for a stop, 0 for none.
static ASKED: AtomicI32 = AtomicI32::new(0);
/// How often the table was sent.
static SENT: AtomicU32 = AtomicU32::new(0);

/// How many threads and handlers are sending the table.
static SENDING: AtomicU32 = AtomicU32::new(0);

/// A table in force, until this is dropped. The buses that made its frames must outlive it: their descriptors are in it, and
/// after them the same numbers may belong to any file.
#[derive(Debug)]
pub struct Table(*mut Vec<Prepared>);

impl Drop for Table {
    fn drop(&mut self) {
        if !is_present(Protection::Table) {
            return;
        }
        // Another one may be in force already.
        let _ = TABLE.compare_exchange(self.0, std::ptr::null_mut(), Ordering::SeqCst, Ordering::SeqCst);
        // Somebody who has just read it writes a few frames and is done, or ends the process.
        while SENDING.load(Ordering::SeqCst) > 0 {
            std::thread::yield_now();
        }
    }
}

/// Puts a table in force.
pub fn prepare(frames: Vec<Prepared>) -> Table {
    let table = Box::into_raw(Box::new(frames));
    TABLE.store(table, Ordering::SeqCst);
    Table(table)
}

/// Sends the table, three times: a frame may be lost. Only write(2): safe wherever a rig may end.
pub fn send() {
    SENDING.fetch_add(1, Ordering::SeqCst);
    let table = TABLE.load(Ordering::SeqCst);
    // SAFETY: the pointer is null or came from `prepare`, which leaks it.
    if let Some(frames) = unsafe { table.as_ref() } {
        for frame in [frames, frames, frames].into_iter().flatten() {
            frame.send();
        }
        SENT.fetch_add(1, Ordering::Relaxed);
    }
    SENDING.fetch_sub(1, Ordering::SeqCst);
}

/// How often the table was sent in this process.
pub fn sent() -> u32 {
    SENT.load(Ordering::Relaxed)
}

/// The signal that asked for a stop: SIGINT, SIGTERM, SIGHUP. The cycle ends the run; a second one ends the process.
pub fn asked() -> Option<i32> {
    Some(ASKED.load(Ordering::Relaxed)).filter(|signal| *signal != 0)
}

/// Bytes of the stack on which handlers run.
const STACK: usize = 64 * 1024;

/// Gives the handlers of the calling thread a stack of their own: a cycle that has used up its stack has none left for them.
/// It is never given back, since a handler may be running on it.
///
/// # Errors
/// If the system does not take it.
pub fn own_stack() -> std::io::Result<()> {
    let stack = Box::leak(vec![0u8; STACK].into_boxed_slice());
    let stack = libc::stack_t { ss_sp: stack.as_mut_ptr().cast(), ss_flags: 0, ss_size: STACK };
    // SAFETY: the stack is valid for ever and nobody else's; the old one is not asked for.
    match unsafe { libc::sigaltstack(&stack, std::ptr::null_mut()) } {
        0 => Ok(()),
        _ => Err(std::io::Error::last_os_error()),
    }
}

/// From now on the table is sent before the process dies of a panic or a fault, and requests to stop are kept. To be called by
/// the thread that runs the cycle: a fault of it is handled on a stack of its own.
///
/// # Panics
/// If the system has no such stack: a rig without handlers would not be what its documentation says.
pub fn guard() {
    let stack = own_stack();
    assert!(stack.is_ok(), "no stack for signal handlers: {stack:?}");
    let handler = |signal: libc::c_int, handler: extern "C" fn(libc::c_int)| {
        // SAFETY: the action is whole, and both handlers below use only what may be used in a handler.
        unsafe {
            let mut action: libc::sigaction = std::mem::zeroed();
            action.sa_sigaction = handler as *const () as usize;
            action.sa_flags = if is_present(Protection::OwnStack) { libc::SA_ONSTACK } else { 0 };
            libc::sigemptyset(&mut action.sa_mask);
            libc::sigaction(signal, &action, std::ptr::null_mut());
        }
    };
    for signal in [libc::SIGINT, libc::SIGTERM, libc::SIGHUP] {
        handler(signal, ask);
    }
    for signal in [libc::SIGSEGV, libc::SIGBUS, libc::SIGILL, libc::SIGFPE, libc::SIGABRT] {
        handler(signal, die);
    }
    let before = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        send();
        before(info);
    }));
}

extern "C" fn ask(signal: libc::c_int) {
    if ASKED.swap(signal, Ordering::Relaxed) != 0 {
        die(signal);
    }
}

extern "C" fn die(signal: libc::c_int) {
    send();
    // SAFETY: both may be called in a handler; the default action ends the process with its proper status.
    unsafe {
        libc::signal(signal, libc::SIG_DFL);
        libc::raise(signal);
    }
}

/// Watches that cycles end in time.
pub struct Watchdog {
    shared: Arc<Shared>,
    clock: Monotonic,
    thread: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    /// When the last cycle ended, ns; 0 before the first.
    beat_ns: AtomicU64,
    /// It has sent the table; the cycle must not send anything but stop frames any more.
    bitten: AtomicBool,
    /// It watches: drives are enabled.
    awake: AtomicBool,
    over: AtomicBool,
}

/// What a watchdog does at a moment.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Look {
    /// Its patience is over.
    Bites,
    /// Nothing, for so many ns.
    Waits(u64),
}

/// What it does at `now_ns`, if the last beat was then. `bitten_ns`: the beat after which it has bitten already.
fn look(now_ns: u64, beat_ns: u64, awake: bool, bitten_ns: u64, patience_ns: u64) -> Look {
    let left = (beat_ns + patience_ns).saturating_sub(now_ns);
    match left {
        0 if awake && beat_ns > 0 && beat_ns != bitten_ns => Look::Bites,
        // No beat that comes later can have an end before this.
        0 => Look::Waits(patience_ns),
        left => Look::Waits(left),
    }
}

/// Priority of the watchdog's thread: above the cycle's, which may hang.
const PRIORITY: i32 = 90;

impl Watchdog {
    /// Watches with this patience, from the first [`Watchdog::beat`] on. `stop` is called as soon as the last beat is so long
    /// ago, and again after every late one.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn new(patience: Duration, stop: impl Fn() + Send + 'static) -> std::io::Result<Watchdog> {
        let shared = Arc::new(Shared::default());
        let (watching, clock) = (shared.clone(), Monotonic::new());
        let patience_ns = u64::try_from(patience.as_nanos()).unwrap_or(u64::MAX / 2);
        let thread = std::thread::Builder::new().name("fric watchdog".into()).spawn(move || {
            threads::stand_by(PRIORITY);
            let mut bitten_ns = 0;
            while !watching.over.load(Ordering::Acquire) {
                let beat_ns = watching.beat_ns.load(Ordering::Acquire);
                let awake = watching.awake.load(Ordering::Acquire);
                match look(clock.now_ns(), beat_ns, awake, bitten_ns, patience_ns) {
                    Look::Bites => {
                        bitten_ns = beat_ns;
                        if is_present(Protection::Bites) {
                            watching.bitten.store(true, Ordering::Release);
                            stop();
                        }
                    }
                    Look::Waits(ns) => std::thread::park_timeout(Duration::from_nanos(ns)),
                }
            }
        })?;
        Ok(Watchdog { shared, clock, thread: Some(thread) })
    }

    /// A cycle has ended. False if the watchdog has stopped the drives: nothing may be sent but stop frames.
    pub fn beat(&self) -> bool {
        self.shared.beat_ns.store(self.clock.now_ns().max(1), Ordering::Release);
        !self.shared.bitten.load(Ordering::Acquire)
    }

    /// Whether it has stopped the drives: to be asked immediately before anything is sent.
    pub fn has_bitten(&self) -> bool {
        self.shared.bitten.load(Ordering::Acquire)
    }

    /// Whether it watches: only while drives are enabled.
    pub fn watch(&self, awake: bool) {
        self.shared.awake.store(awake, Ordering::Release);
    }
}

impl Drop for Watchdog {
    fn drop(&mut self) {
        self.shared.over.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;
    use std::io::Read;
    use std::os::fd::AsRawFd;
    use std::sync::Mutex;

    /// There is one table in a process.
    static TESTS: Mutex<()> = Mutex::new(());

    #[test]
    fn a_watchdog_bites_when_cycles_stop_and_not_before() {
        let bites = Arc::new(AtomicU32::new(0));
        let count = bites.clone();
        let stop = move || {
            count.fetch_add(1, Ordering::Relaxed);
        };
        let watchdog = Watchdog::new(Duration::from_millis(600), stop).unwrap();
        std::thread::sleep(Duration::from_millis(100));
        assert_eq!(bites.load(Ordering::Relaxed), 0, "it sleeps until it is told to watch");
        watchdog.watch(true);
        for _ in 0..100 {
            assert!(watchdog.beat());
            std::thread::sleep(Duration::from_millis(10));
        }
        assert_eq!(bites.load(Ordering::Relaxed), 0);
        while !watchdog.has_bitten() {
            std::thread::sleep(Duration::from_millis(10));
        }
        assert!(!watchdog.beat(), "a late cycle learns of it");
    }

    #[test]
    fn a_table_is_written_three_times_and_closed_descriptors_do_no_harm() {
        let (mut reader, writer) = std::io::pipe().unwrap();
        let _serial = TESTS.lock();
        let table = prepare(vec![Prepared::new(writer.as_raw_fd(), b"stop;"), Prepared::new(-1, b"nowhere")]);
        send();
        drop(table);
        send();
        drop(writer);
        let mut text = String::new();
        reader.read_to_string(&mut text).unwrap();
        assert_eq!(text, "stop;stop;stop;");
        assert!(sent() >= 1);
        let table = prepare(vec![Prepared::new(File::open("/dev/null").unwrap().as_raw_fd(), b"closed")]);
        send();
        drop(table);
    }

    /// A rig that is replaced closes its buses, and another file gets the number of their descriptor.
    #[test]
    fn a_table_is_taken_back_before_its_descriptors_close() {
        let _serial = TESTS.lock();
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let bus = File::create(path("bus")).unwrap();
        let number = bus.as_raw_fd();
        // As the fields of a rig: the table goes first.
        let rig = (prepare(vec![Prepared::new(number, b"stop;")]), bus);
        drop(rig);
        let mut others = Vec::new();
        while others.last().is_none_or(|file: &File| file.as_raw_fd() < number) {
            others.push(File::create(path(&format!("other {}", others.len()))).unwrap());
        }
        send();
        drop(others);
        for entry in std::fs::read_dir(folder.path()).unwrap() {
            assert_eq!(std::fs::read(entry.unwrap().path()).unwrap(), b"", "stop frames in somebody's file");
        }
        // The next rig's table is not taken back with the first one's.
        let (mut reader, writer) = std::io::pipe().unwrap();
        let first = prepare(Vec::new());
        let second = prepare(vec![Prepared::new(writer.as_raw_fd(), b"stop;")]);
        drop(first);
        send();
        drop((second, writer));
        let mut text = String::new();
        reader.read_to_string(&mut text).unwrap();
        assert_eq!(text, "stop;stop;stop;");
    }

    #[test]
    fn a_watchdog_bites_at_its_time_whenever_it_looked_last() {
        let patience = 5_000_000;
        for beat in 1..50_000u64 {
            let beat_ns = beat * 997;
            // However it was woken before, it looks again no later than this beat's end, and bites then.
            for woken_ns in [beat_ns, beat_ns + 1, beat_ns + patience / 3, beat_ns + patience - 1] {
                let Look::Waits(ns) = look(woken_ns, beat_ns, true, 0, patience) else { panic!("too early: {beat}") };
                assert_eq!(woken_ns + ns, beat_ns + patience);
            }
            assert_eq!(look(beat_ns + patience, beat_ns, true, 0, patience), Look::Bites);
            assert_eq!(look(beat_ns + patience, beat_ns, false, 0, patience), Look::Waits(patience));
            assert_eq!(
                look(beat_ns + patience, beat_ns, true, beat_ns, patience),
                Look::Waits(patience),
                "once a beat"
            );
        }
        assert_eq!(look(77, 0, true, 0, patience), Look::Waits(patience - 77), "before the first beat");
        assert_eq!(look(patience, 0, true, 0, patience), Look::Waits(patience), "before the first beat");
    }

    /// A cycle that calls itself for ever; `FRIC_OVERFLOW` names where its stop frames go.
    #[test]
    fn a_stack_that_overflows_sends_the_stop_frames() {
        #[inline(never)]
        fn deeper(n: u64) -> u64 {
            let more = std::hint::black_box([n; 64]);
            if n == u64::MAX { more[0] } else { deeper(n + 1) + more[63] }
        }
        if let Some(path) = std::env::var_os("FRIC_OVERFLOW") {
            let file = File::create(path).unwrap();
            let _table = prepare(vec![Prepared::new(file.as_raw_fd(), b"stop;")]);
            // A thread whose own handler stack is not the one that the language gave it.
            guard();
            println!("{}", deeper(0));
            return;
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("frames");
        let mut child = std::process::Command::new(std::env::current_exe().unwrap());
        child.args(["--exact", "hil::emergency::tests::a_stack_that_overflows_sends_the_stop_frames"]);
        let out = child.env("FRIC_OVERFLOW", &path).output().unwrap();
        assert!(!out.status.success());
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "stop;stop;stop;", "{:?}", out.status);
    }
}
