//! Emergency stop frames, for the case that the cycle fails: sent by the watchdog's thread, after a panic, or in a
//! signal handler.
//!
//! In: frames that their buses have encoded beforehand. Out: write(2) and nothing else, so that sending is
//! async-signal-safe, on a stack of its own. Knows no drive.
//!
//! There is one rig in a process, hence one table of frames.

use crate::can::Prepared;
use crate::realtime::clock::{Clock, Monotonic};
use crate::realtime::threads;
use crate::safety::{Protection, is_present};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI32, AtomicPtr, AtomicU32, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// The active table. It is never freed, because a handler may be reading it.
static TABLE: AtomicPtr<Vec<Prepared>> = AtomicPtr::new(std::ptr::null_mut());
/// Number of the signal that requested a stop; 0 for none.
static ASKED: AtomicI32 = AtomicI32::new(0);
/// Number of times that the table was sent.
static SENT: AtomicU32 = AtomicU32::new(0);

/// Number of threads and handlers that are sending the table.
static SENDING: AtomicU32 = AtomicU32::new(0);

/// An active table, until this is dropped. The buses that made its frames must outlive it: it holds their descriptors,
/// and after them the same numbers may belong to any file.
#[derive(Debug)]
pub struct EmergencyTable(*mut Vec<Prepared>);

impl Drop for EmergencyTable {
    fn drop(&mut self) {
        if !is_present(Protection::Table) {
            return;
        }
        // Another table may be active already.
        let _ = TABLE.compare_exchange(self.0, std::ptr::null_mut(), Ordering::SeqCst, Ordering::SeqCst);
        // A sender that has just read the pointer writes a few frames and finishes, or ends the process.
        while SENDING.load(Ordering::SeqCst) > 0 {
            std::thread::yield_now();
        }
    }
}

/// Activates a table of frames.
pub fn prepare(frames: Vec<Prepared>) -> EmergencyTable {
    let table = Box::into_raw(Box::new(frames));
    TABLE.store(table, Ordering::SeqCst);
    EmergencyTable(table)
}

/// Sends the table three times, because a frame may be lost. Calls only write(2), so it is safe in any thread or
/// handler.
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

/// Number of times that the table was sent in this process.
pub fn sent() -> u32 {
    SENT.load(Ordering::Relaxed)
}

/// The signal that requested a stop: SIGINT, SIGTERM or SIGHUP. The cycle then ends the run; a second signal ends the
/// process.
pub fn requested_stop() -> Option<i32> {
    Some(ASKED.load(Ordering::Relaxed)).filter(|signal| *signal != 0)
}

/// Size of the stack on which handlers run, bytes.
const STACK: usize = 64 * 1024;

/// Gives the handlers of the calling thread a stack of their own: a cycle that has overflowed its stack leaves no room
/// for them. The stack is never freed, because a handler may be running on it.
///
/// # Errors
/// If the system refuses it.
pub fn own_stack() -> std::io::Result<()> {
    let stack = Box::leak(vec![0u8; STACK].into_boxed_slice());
    let stack = libc::stack_t { ss_sp: stack.as_mut_ptr().cast(), ss_flags: 0, ss_size: STACK };
    // SAFETY: the stack is valid for ever and has no other user; the old stack is not queried.
    match unsafe { libc::sigaltstack(&stack, std::ptr::null_mut()) } {
        0 => Ok(()),
        _ => Err(std::io::Error::last_os_error()),
    }
}

/// Installs the handlers: from now on the table is sent before the process dies of a panic or a fault, and requests to
/// stop are noted. Must be called by the thread that runs the cycle, because a fault of that thread is handled on a
/// stack of its own.
///
/// # Panics
/// If the system provides no such stack: a rig without handlers would not match its documentation.
pub fn guard() {
    let stack = own_stack();
    assert!(stack.is_ok(), "no stack for signal handlers: {stack:?}");
    let handler = |signal: libc::c_int, handler: extern "C" fn(libc::c_int)| {
        // SAFETY: the action is completely initialised, and both handlers below call only async-signal-safe functions.
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
    // SAFETY: both calls are async-signal-safe; the default action ends the process with its proper status.
    unsafe {
        libc::signal(signal, libc::SIG_DFL);
        libc::raise(signal);
    }
}

/// Watchdog: checks in a thread of its own that cycles end in time.
pub struct Watchdog {
    shared: Arc<Shared>,
    clock: Monotonic,
    thread: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    /// Time at which the last cycle ended, ns; 0 before the first.
    beat_ns: AtomicU64,
    /// It has acted; from now on the cycle must send nothing but stop frames.
    bitten: AtomicBool,
    /// It is active, because drives are enabled.
    awake: AtomicBool,
    over: AtomicBool,
}

/// Decision of the watchdog at some moment.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum WatchdogDecision {
    /// Its time-out has passed: it acts.
    Bites,
    /// It waits for this time, ns.
    Waits(u64),
}

/// Decision at `now_ns`; `beat_ns`: end of the last cycle; `bitten_ns`: the beat after which the watchdog has already
/// acted.
fn look(now_ns: u64, beat_ns: u64, awake: bool, bitten_ns: u64, patience_ns: u64) -> WatchdogDecision {
    let left = (beat_ns + patience_ns).saturating_sub(now_ns);
    match left {
        0 if awake && beat_ns > 0 && beat_ns != bitten_ns => WatchdogDecision::Bites,
        // A later beat cannot time out before this.
        0 => WatchdogDecision::Waits(patience_ns),
        left => WatchdogDecision::Waits(left),
    }
}

/// Priority of the watchdog's thread: above that of the cycle, which may hang.
const PRIORITY: i32 = 90;

impl Watchdog {
    /// A watchdog with this time-out, active from the first [`Watchdog::beat`] on. `stop` is called as soon as the last
    /// beat is that old, and again after every later beat that times out.
    ///
    /// # Errors
    /// If the system provides no thread.
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
                    WatchdogDecision::Bites => {
                        bitten_ns = beat_ns;
                        if is_present(Protection::Bites) {
                            watching.bitten.store(true, Ordering::Release);
                            stop();
                        }
                    }
                    WatchdogDecision::Waits(ns) => std::thread::park_timeout(Duration::from_nanos(ns)),
                }
            }
        })?;
        Ok(Watchdog { shared, clock, thread: Some(thread) })
    }

    /// Notes the end of a cycle. Returns false if the watchdog has acted: nothing but stop frames may be sent then.
    pub fn beat(&self) -> bool {
        self.shared.beat_ns.store(self.clock.now_ns().max(1), Ordering::Release);
        !self.shared.bitten.load(Ordering::Acquire)
    }

    /// Whether the watchdog has acted: must be checked immediately before anything is sent.
    pub fn has_fired(&self) -> bool {
        self.shared.bitten.load(Ordering::Acquire)
    }

    /// Activates or deactivates the watchdog; it is active only while drives are enabled.
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
    fn the_watchdog_acts_when_cycles_stop_and_not_before() {
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
        while !watchdog.has_fired() {
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

    /// A rig that is replaced closes its buses, and another file receives the number of their descriptor.
    #[test]
    fn a_table_is_withdrawn_before_its_descriptors_close() {
        let _serial = TESTS.lock();
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let bus = File::create(path("bus")).unwrap();
        let number = bus.as_raw_fd();
        // In the order of a rig's fields: the table is dropped first.
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
        // Dropping the first table must not withdraw the next rig's table.
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
    fn the_watchdog_acts_at_its_time_out_whenever_it_checked_last() {
        let patience = 5_000_000;
        for beat in 1..50_000u64 {
            let beat_ns = beat * 997;
            // Whenever it was woken before, it checks again no later than the time-out of this beat, and acts then.
            for woken_ns in [beat_ns, beat_ns + 1, beat_ns + patience / 3, beat_ns + patience - 1] {
                let WatchdogDecision::Waits(ns) = look(woken_ns, beat_ns, true, 0, patience) else {
                    panic!("too early: {beat}")
                };
                assert_eq!(woken_ns + ns, beat_ns + patience);
            }
            assert_eq!(look(beat_ns + patience, beat_ns, true, 0, patience), WatchdogDecision::Bites);
            assert_eq!(look(beat_ns + patience, beat_ns, false, 0, patience), WatchdogDecision::Waits(patience));
            assert_eq!(
                look(beat_ns + patience, beat_ns, true, beat_ns, patience),
                WatchdogDecision::Waits(patience),
                "once a beat"
            );
        }
        assert_eq!(look(77, 0, true, 0, patience), WatchdogDecision::Waits(patience - 77), "before the first beat");
        assert_eq!(look(patience, 0, true, 0, patience), WatchdogDecision::Waits(patience), "before the first beat");
    }

    /// An endless recursion of the cycle; `FRIC_OVERFLOW` names the file for its stop frames.
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
            // A thread whose handler stack is not the one that Rust's runtime installed.
            guard();
            return println!("{}", deeper(0));
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
