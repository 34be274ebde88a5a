//! Real-time gates with exact time: a loop sends SYNC and a set-point and waits for a drive's answer, on a kernel with
//! PREEMPT_RT whose nanoseconds are counted instructions. The same program has the same timing on any host, however
//! busy. Bounds are checked, not values, because each build changes them slightly.
//!
//! Each gate is also shown to fail: with a lock, an allocation, a system call, or memory that is not locked.

mod rig;

use runtime::can::socketcan::{self, SocketCan};
use runtime::can::{Bus, Filter, Frame, Options, Received};
use runtime::hil::counts::Counts;
use runtime::hil::cycle::{End, Hil, Options as HilOptions};
use runtime::realtime::clock::{Clock, Monotonic};
use runtime::realtime::histogram::Histogram;
use runtime::realtime::threads::{self, Wishes};
use runtime::record::log::{Sections, Settings, Sink};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::fs::File;
use std::io::Write;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, Once};
use std::time::Duration;

/// The loop has priority 80, above the drive at 79, which waits for it.
const LOOP: i32 = 80;
const DRIVE: i32 = 79;

/// Name of the gate on wake-up latency.
const LATENESS: &str = "lateness, ns";

/// Largest wake-up latency.
const LATENESS_NS: u64 = 6_000;
/// The same in a whole rig, where a frame of the drives may just be read from a card: well below the twentieth of a
/// period that `fric bench-rt` requires.
const LATENESS_RIG_NS: u64 = 20_000;

/// From before SYNC is sent to after its answer has been read.
const ANSWER_NS: u64 = 110_000;

/// The measurements of a gate.
#[derive(Default)]
struct Outcome {
    lateness: Histogram,
    answer: Histogram,
    /// Cycles without an answer in time, or not finished when the next one begins.
    missed: u64,
    heap_calls: u64,
    page_faults: u64,
    /// System calls other than those to sleep, wait, receive and send on the bus.
    foreign_calls: u64,
}

impl Outcome {
    /// The gates that fail, with their measurements.
    fn red(&self) -> Vec<String> {
        self.red_beyond(LATENESS_NS)
    }

    fn red_beyond(&self, lateness_ns: u64) -> Vec<String> {
        let gates = [
            ("missed cycles", self.missed, 0),
            (LATENESS, self.lateness.max_ns(), lateness_ns),
            ("SYNC to answer, ns", self.answer.max_ns(), ANSWER_NS),
            ("heap calls", self.heap_calls, 0),
            ("page faults", self.page_faults, 0),
            ("foreign system calls", self.foreign_calls, 0),
        ];
        gates
            .iter()
            .filter(|(_, seen, most)| seen > most)
            .map(|(name, seen, most)| format!("{name}: {seen} > {most}"))
            .collect()
    }
}

/// A deliberate violation, once every hundred cycles.
#[derive(Clone, Copy, PartialEq)]
enum Planted {
    Nothing,
    /// A lock that a thread without priority repeatedly holds for three periods.
    Lock,
    Allocation,
    /// A line of a log.
    SystemCall,
    /// Memory that is not locked: new pages are mapped when they are touched.
    Unlocked,
}

struct Plan {
    near: &'static str,
    far: &'static str,
    rate_hz: u64,
    cycles: u64,
    planted: Planted,
    /// Whether a computing thread and a memory-writing thread run at the same time, without priority.
    loaded: bool,
}

/// Waits until all output has left the serial line, because its interrupts come from outside the simulated time.
fn silence() {
    std::io::stdout().flush().expect("somebody reads");
    // SAFETY: takes no pointers.
    unsafe { libc::tcdrain(libc::STDOUT_FILENO) };
}

fn run(plan: &Plan) -> Outcome {
    assert!(
        std::env::var("GUEST").is_ok_and(|guest| guest == "rt-exact"),
        "these gates hold in the guest only: start them as `cargo test`, which goes through tests/can/runner"
    );
    silence();
    // Locked memory belongs to the process: release what an earlier gate locked.
    // SAFETY: takes no pointers.
    unsafe { libc::munlockall() };
    let over = Arc::new(AtomicBool::new(false));
    let drive = {
        let (over, far, memory) = (over.clone(), plan.far, plan.planted != Planted::Unlocked);
        std::thread::spawn(move || answer(far, &over, memory))
    };
    let load: Vec<_> = if plan.loaded { vec![hog(over.clone()), writer(over.clone())] } else { Vec::new() };
    let lock = Arc::new(Mutex::new(0u64));
    let holder = (plan.planted == Planted::Lock).then(|| {
        let (over, lock, period) = (over.clone(), lock.clone(), Duration::from_nanos(1_000_000_000 / plan.rate_hz));
        std::thread::spawn(move || {
            while !over.load(Ordering::Relaxed) {
                let mut held = lock.lock().expect("nobody panics");
                *held += 1;
                std::thread::sleep(3 * period);
            }
        })
    });
    let (near, rate_hz, cycles, planted) = (plan.near, plan.rate_hz, plan.cycles, plan.planted);
    let looping = std::thread::spawn(move || cycle(near, rate_hz, cycles, planted, &lock));
    let outcome = looping.join().expect("the loop ends");
    over.store(true, Ordering::Relaxed);
    drive.join().expect("the drive ends");
    load.into_iter().chain(holder).for_each(|thread| thread.join().expect("it ends"));
    outcome
}

/// The loop of a rig, without its model.
fn cycle(near: &str, rate_hz: u64, cycles: u64, planted: Planted, lock: &Mutex<u64>) -> Outcome {
    let clock = Monotonic::new();
    let options = Options { filter: Filter::Only(vec![0x181]), ..Options::default() };
    let mut bus = SocketCan::open(near, &options, clock).expect("it is up");
    let mut log = File::create("/tmp/log").expect("a guest has a /tmp");
    let memory = planted != Planted::Unlocked;
    let real_time = threads::enter(&Wishes { priority: LOOP, memory, ..Wishes::default() });
    assert_eq!(real_time.refused(), [], "root of the guest may do all of it");
    // The data of a recorder, a page every few cycles. Reserved, and mapped only if memory is locked.
    let mut record: Vec<u64> = Vec::with_capacity(64 * cycles as usize);
    let mut outcome = Outcome::default();
    let period_ns = 1_000_000_000 / rate_hz;
    let origin_ns = clock.now_ns() + 10_000_000;
    // The first cycles warm up what no setting can: a few, whereas a rig has hundreds before it is armed.
    let warm = 20;

    let fd = bus.descriptor().expect("a socket");
    watch_calls(fd);
    let mut faults_before = 0;
    for k in 0..cycles + warm {
        if k == warm {
            outcome = Outcome::default();
            faults_before = threads::interruptions().page_faults;
            FOREIGN.store(0, Ordering::Relaxed);
            HEAP.with(|calls| calls.set(0));
        }
        let due_ns = origin_ns + k * period_ns;
        clock.sleep_until(due_ns);
        let begin_ns = clock.now_ns();
        outcome.lateness.count(begin_ns - due_ns);
        let sent = bus.send(Frame::new(0x080, &[]));

        let mut answered = false;
        while !answered && bus.wait(due_ns + period_ns * 9 / 20) {
            while let Some(received) = bus.receive() {
                answered |= matches!(received, Received::Frame(..));
            }
        }
        if answered {
            outcome.answer.count(clock.now_ns() - begin_ns);
        }
        let set = bus.send(Frame::new(0x201, &[0x0F, 0, 0, 0]));
        record.extend([k, begin_ns, due_ns, 0]);
        if k % 100 == 99 {
            match planted {
                Planted::Nothing | Planted::Unlocked => {}
                Planted::Lock => *lock.lock().expect("nobody panics") += 1,
                Planted::Allocation => drop(std::hint::black_box(Box::new(k))),
                Planted::SystemCall => drop(log.write(b"tick\n")),
            }
        }
        let over_ns = clock.now_ns();
        outcome.missed += u64::from(!answered || sent.is_err() || set.is_err() || over_ns > due_ns + period_ns);
    }
    outcome.heap_calls = HEAP.with(Cell::get);
    outcome.foreign_calls = FOREIGN.load(Ordering::Relaxed);
    outcome.page_faults = threads::interruptions().page_faults - faults_before;
    std::hint::black_box(&record);
    // The loop's thread may make no more calls than a loop may: its resources are leaked until the process ends.
    std::mem::forget((bus, log, real_time, record));
    outcome
}

/// A drive: answers SYNC with status, torque and speed.
fn answer(far: &str, over: &AtomicBool, memory: bool) {
    let clock = Monotonic::new();
    let options = Options { filter: Filter::Only(vec![0x080, 0x201]), ..Options::default() };
    let mut bus = SocketCan::open(far, &options, clock).expect("it is up");
    let real_time = threads::enter(&Wishes { priority: DRIVE, memory, ..Wishes::default() });
    assert_eq!(real_time.refused(), []);
    while !over.load(Ordering::Relaxed) {
        bus.wait(clock.now_ns() + 20_000_000);
        while let Some(received) = bus.receive() {
            if matches!(received, Received::Frame(frame, _) if frame.id() == 0x080) {
                let _ = bus.send(Frame::new(0x181, &[0x27, 0x06, 0, 0, 0, 0, 0, 0]));
            }
        }
    }
}

fn hog(over: Arc<AtomicBool>) -> std::thread::JoinHandle<()> {
    std::thread::spawn(move || {
        let mut x = 1u64;
        while !over.load(Ordering::Relaxed) {
            x = std::hint::black_box(x.wrapping_mul(3));
        }
    })
}

fn writer(over: Arc<AtomicBool>) -> std::thread::JoinHandle<()> {
    std::thread::spawn(move || {
        let mut memory = vec![0u8; 8 << 20];
        while !over.load(Ordering::Relaxed) {
            memory.iter_mut().step_by(64).for_each(|byte| *byte = byte.wrapping_add(1));
            std::hint::black_box(&memory);
        }
    })
}

/// Counts the heap calls of each thread.
struct Counting;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

thread_local! {
    static HEAP: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: everything is the system's; counting neither allocates nor unwinds.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ = HEAP.try_with(|calls| calls.set(calls.get() + 1));
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        let _ = HEAP.try_with(|calls| calls.set(calls.get() + 1));
        // SAFETY: the caller's promise is passed on.
        unsafe { System.dealloc(at, layout) }
    }
}

/// Forbidden system calls of a loop, refused and counted.
static FOREIGN: AtomicU64 = AtomicU64::new(0);

extern "C" fn foreign(_signal: libc::c_int) {
    FOREIGN.fetch_add(1, Ordering::Relaxed);
}

/// From now on this thread may sleep, wait, receive, write to the bus, take locks and end; any other system call is
/// refused and counted.
fn watch_calls(bus: i32) {
    static HANDLER: Once = Once::new();
    HANDLER.call_once(|| {
        // SAFETY: all bytes 0 is a valid action; the handler only counts.
        unsafe {
            let mut action: libc::sigaction = std::mem::zeroed();
            action.sa_sigaction = foreign as extern "C" fn(libc::c_int) as usize;
            assert_eq!(libc::sigaction(libc::SIGSYS, &action, std::ptr::null_mut()), 0);
        }
    });
    let allowed = [
        libc::SYS_clock_nanosleep,
        libc::SYS_clock_gettime,
        libc::SYS_ppoll,
        libc::SYS_recvmsg,
        libc::SYS_getsockopt,
        libc::SYS_futex,
        libc::SYS_rt_sigreturn,
        // Calls of the gate itself, and the end of a thread.
        libc::SYS_getrusage,
        libc::SYS_exit,
        libc::SYS_munmap,
        libc::SYS_madvise,
        libc::SYS_sigaltstack,
        libc::SYS_rt_sigprocmask,
        libc::SYS_rseq,
        libc::SYS_set_robust_list,
    ];
    let load = |offset: u32| filter(libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, offset, 0, 0);
    let equal = |value: u32, yes: u8, no: u8| filter(libc::BPF_JMP | libc::BPF_JEQ | libc::BPF_K, value, yes, no);
    let give = |verdict: u32| filter(libc::BPF_RET | libc::BPF_K, verdict, 0, 0);
    // struct seccomp_data: the number first, the first argument at 16. A write is allowed on the bus alone.
    let mut program = vec![load(0), equal(libc::SYS_write as u32, 0, 3), load(16), equal(bus as u32, 0, 1)];
    program.push(give(libc::SECCOMP_RET_ALLOW));
    for call in allowed {
        program.extend([equal(call as u32, 0, 1), give(libc::SECCOMP_RET_ALLOW)]);
    }
    program.push(give(libc::SECCOMP_RET_TRAP));
    let code = libc::sock_fprog { len: program.len() as u16, filter: program.as_mut_ptr() };
    // SAFETY: the program is valid for its length and outlives the call, which copies it.
    let set = unsafe {
        libc::prctl(libc::PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0
            && libc::prctl(libc::PR_SET_SECCOMP, libc::SECCOMP_MODE_FILTER, &raw const code) == 0
    };
    assert!(set, "the guest's kernel has seccomp: {}", std::io::Error::last_os_error());
    // Its memory is leaked: freeing it could need a system call.
    std::mem::forget(program);
}

fn filter(code: u32, k: u32, yes: u8, no: u8) -> libc::sock_filter {
    libc::sock_filter { code: code as u16, jt: yes, jf: no, k }
}

/// Tests take turns: there is one processor, so one would delay the other.
static TURN: Mutex<()> = Mutex::new(());

fn interfaces() {
    static INTERFACES: Once = Once::new();
    INTERFACES.call_once(|| {
        // Large blocks get new pages each time; otherwise a test could reuse pages that an earlier one has touched.
        // SAFETY: takes no pointers.
        assert_eq!(unsafe { libc::mallopt(libc::M_MMAP_THRESHOLD, 128 << 10) }, 1);
        socketcan::make_virtual("vcan0").expect("the kernel has vcan");
        for card in ["can0", "can1"] {
            socketcan::take_up(card, Some(1_000_000)).expect("the guest has two cards");
        }
    });
}

/// The loop of a whole rig from its start-up on: listening, identification, configuration, enabling, the tests of
/// time-outs and polarity, then `cycles` cycles of the model. Safety and a log included.
fn whole_rig(cycles: u64) -> (Outcome, Counts, Option<End>) {
    let asked = rig::pulsed(1_000_000);
    let clock = Monotonic::new();
    let bus = SocketCan::open("can0", &Options::default(), clock).expect("it is up");
    let fd = bus.descriptor().expect("a socket");
    let options = HilOptions { arms_itself: true, ..HilOptions::default() };
    let log = Settings { sink: Sink::BlackBox("/tmp/black".into(), 10), cycles_per_block: 100, patient: false };
    let real_time = threads::enter(&Wishes { priority: LOOP, ..Wishes::default() });
    assert_eq!(real_time.refused(), [], "root of the guest may do all of it");
    let log = Some((log, Sections::default()));
    let made = Hil::new(&asked.rig, asked.program.clone(), Box::new(clock), vec![Box::new(bus)], options, log);
    let (mut hil, operator) = made.expect("it can be started");
    let (warm, mut faults) = (100, None);
    while hil.ended().is_none() && hil.counts().cycles < cycles {
        hil.cycle();
        if hil.counts().cycles == warm && faults.is_none() {
            faults = Some(threads::interruptions().page_faults);
            watch_calls(fd);
            FOREIGN.store(0, Ordering::Relaxed);
            HEAP.with(|calls| calls.set(0));
        }
    }
    let outcome = Outcome {
        heap_calls: HEAP.with(Cell::get),
        foreign_calls: FOREIGN.load(Ordering::Relaxed),
        page_faults: faults.map_or(u64::MAX, |faults| threads::interruptions().page_faults - faults),
        lateness: hil.counts().late.clone(),
        answer: Histogram::default(),
        missed: hil.counts().missed + hil.counts().stale,
    };
    let (counts, ended) = (hil.counts().clone(), hil.ended().cloned());
    // The loop's thread may make no more calls than a loop may: its resources are leaked until the process ends.
    std::mem::forget((hil, real_time, operator));
    (outcome, counts, ended)
}

/// Two drives, five frames each way per period, the model, the safety and the log, as in `fric hil`. Nothing is missed
/// once the drives may be enabled.
#[test]
fn a_whole_rig_at_1_khz() {
    let _turn = TURN.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    interfaces();
    silence();
    // SAFETY: takes no pointers.
    unsafe { libc::munlockall() };
    let over = Arc::new(AtomicBool::new(false));
    let drives = {
        let over = over.clone();
        std::thread::spawn(move || rig::drives(&rig::pulsed(1_000_000).rig, "can1", Some(DRIVE), &over))
    };
    let looping = std::thread::spawn(|| whole_rig(10_000));
    let (outcome, counts, ended) = looping.join().expect("the loop ends");
    over.store(true, Ordering::Relaxed);
    drives.join().expect("the drives end");
    let figures = [("lateness", &counts.late), ("computing", &counts.compute), ("sending", &counts.send)];
    let figures = figures.map(|(name, times)| {
        format!("{name} µs p50 {} max {}", times.quantile_ns(0.5) as f64 / 1000.0, times.max_ns() as f64 / 1000.0)
    });
    println!(
        "rig: {} cycles of the model and {} before, {}, missed {}, stale {}, heap {}, faults {}, calls {}",
        counts.cycles,
        counts.all - counts.cycles,
        figures.join(", "),
        counts.missed,
        counts.stale,
        outcome.heap_calls,
        outcome.page_faults,
        outcome.foreign_calls,
    );
    assert_eq!((ended, counts.cycles), (None, 10_000), "it goes on");
    assert_eq!(outcome.red_beyond(LATENESS_RIG_NS), [""; 0]);
}

fn gate(name: &str, plan: &Plan) -> Outcome {
    let _turn = TURN.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    interfaces();
    let outcome = run(plan);
    let us = |ns: u64| ns as f64 / 1000.0;
    println!(
        "{name}: {} cycles at {} Hz, lateness µs p50 {} max {}, SYNC to answer µs p50 {} max {}, missed {}, heap {}, faults {}, calls {}",
        plan.cycles,
        plan.rate_hz,
        us(outcome.lateness.quantile_ns(0.5)),
        us(outcome.lateness.max_ns()),
        us(outcome.answer.quantile_ns(0.5)),
        us(outcome.answer.max_ns()),
        outcome.missed,
        outcome.heap_calls,
        outcome.page_faults,
        outcome.foreign_calls,
    );
    outcome
}

/// As [`gate`], but returns the failures. In one measurement of twenty the kernel's own work coincides with a wake-up,
/// 2.7 µs more: latency alone, and nothing else, may be measured a second time.
fn red(name: &str, plan: &Plan) -> Vec<String> {
    let red = gate(name, plan).red();
    if !matches!(&red[..], [only] if only.starts_with(LATENESS)) {
        return red;
    }
    println!("{name}: {}, measured again", red[0]);
    gate(name, plan).red()
}

const CARDS: Plan =
    Plan { near: "can0", far: "can1", rate_hz: 1000, cycles: 10_000, planted: Planted::Nothing, loaded: false };

#[test]
fn two_cards_at_1_khz() {
    assert_eq!(red("cards", &CARDS), [""; 0]);
}

#[test]
fn two_cards_at_4_khz() {
    assert_eq!(red("cards", &Plan { rate_hz: 4000, ..CARDS }), [""; 0]);
}

#[test]
fn a_virtual_bus_at_1_and_4_khz() {
    for rate_hz in [1000, 4000] {
        assert_eq!(red("vcan", &Plan { near: "vcan0", far: "vcan0", rate_hz, ..CARDS }), [""; 0]);
    }
}

#[test]
fn beside_load() {
    assert_eq!(red("loaded", &Plan { cycles: 1000, loaded: true, ..CARDS }), [""; 0]);
}

/// Each protection is effective: without it, the corresponding gate fails.
#[test]
fn each_violation_of_the_loop_fails_its_gate() {
    for (planted, name, gate_name) in [
        (Planted::Lock, "lock", "missed cycles"),
        (Planted::Allocation, "allocation", "heap calls"),
        (Planted::SystemCall, "system call", "foreign system calls"),
        (Planted::Unlocked, "memory not locked", "page faults"),
    ] {
        let red = gate(name, &Plan { planted, cycles: 500, ..CARDS }).red();
        assert!(red.iter().any(|red| red.starts_with(gate_name)), "a {name} is not seen: {red:?}");
    }
}
