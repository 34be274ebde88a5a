//! Stop frames that are sent when nothing else works any more: by a thread of its own, by a panic, by a signal.
//!
//! In: frames made ready beforehand by their buses. Out: write(2), and nothing else, so that it is right in a signal
//! handler too. Knows no drive.
//!
//! There is one rig in a process, hence one table.

use crate::can::Prepared;
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

/// Puts a table in force.
pub fn prepare(frames: Vec<Prepared>) {
    TABLE.store(Box::into_raw(Box::new(frames)), Ordering::Release);
}

/// Sends the table, three times: a frame may be lost. Only write(2): safe wherever a rig may end.
pub fn send() {
    let table = TABLE.load(Ordering::Acquire);
    // SAFETY: the pointer is null or came from `prepare`, which leaks it.
    let Some(frames) = (unsafe { table.as_ref() }) else { return };
    for frame in [frames, frames, frames].into_iter().flatten() {
        frame.send();
    }
    SENT.fetch_add(1, Ordering::Relaxed);
}

/// How often the table was sent in this process.
pub fn sent() -> u32 {
    SENT.load(Ordering::Relaxed)
}

/// The signal that asked for a stop: SIGINT, SIGTERM, SIGHUP. The cycle ends the run; a second one ends the process.
pub fn asked() -> Option<i32> {
    Some(ASKED.load(Ordering::Relaxed)).filter(|signal| *signal != 0)
}

/// From now on the table is sent before the process dies of a panic or a fault, and requests to stop are kept.
pub fn guard() {
    let handler = |signal: libc::c_int, handler: extern "C" fn(libc::c_int)| {
        // SAFETY: the action is whole, and both handlers below use only what may be used in a handler.
        unsafe {
            let mut action: libc::sigaction = std::mem::zeroed();
            action.sa_sigaction = handler as *const () as usize;
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
    thread: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    /// Cycles ended.
    beats: AtomicU64,
    /// It has sent the table; the cycle must not send anything but stop frames any more.
    bitten: AtomicBool,
    /// It watches: drives are enabled.
    awake: AtomicBool,
    over: AtomicBool,
}

impl Watchdog {
    /// Watches with this patience, from the first [`Watchdog::beat`] on. `stop` is called without a beat for that long,
    /// and again after every late one.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn new(patience: Duration, stop: impl Fn() + Send + 'static) -> std::io::Result<Watchdog> {
        let shared = Arc::new(Shared::default());
        let watching = shared.clone();
        let thread = std::thread::Builder::new().name("fric watchdog".into()).spawn(move || {
            let mut last = 0;
            while !watching.over.load(Ordering::Acquire) {
                std::thread::park_timeout(patience);
                let beats = watching.beats.load(Ordering::Acquire);
                if beats == last && watching.awake.load(Ordering::Acquire) && !watching.over.load(Ordering::Acquire) {
                    watching.bitten.store(true, Ordering::Release);
                    stop();
                }
                last = beats;
            }
        })?;
        Ok(Watchdog { shared, thread: Some(thread) })
    }

    /// A cycle has ended. False if the watchdog has stopped the drives: nothing may be sent but stop frames.
    pub fn beat(&self) -> bool {
        self.shared.beats.fetch_add(1, Ordering::Release);
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

    /// The operator has reset the trip.
    pub fn reset(&self) {
        self.shared.bitten.store(false, Ordering::Release);
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
        watchdog.reset();
        assert!(watchdog.beat());
    }

    #[test]
    fn a_table_is_written_three_times_and_closed_descriptors_do_no_harm() {
        let (mut reader, writer) = std::io::pipe().unwrap();
        prepare(vec![Prepared::new(writer.as_raw_fd(), b"stop;"), Prepared::new(-1, b"nowhere")]);
        send();
        drop(writer);
        let mut text = String::new();
        reader.read_to_string(&mut text).unwrap();
        assert_eq!(text, "stop;stop;stop;");
        assert!(sent() >= 1);
        prepare(vec![Prepared::new(File::open("/dev/null").unwrap().as_raw_fd(), b"closed")]);
        send();
        prepare(Vec::new());
    }
}
