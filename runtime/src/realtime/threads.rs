//! Set-up of real-time threads on Linux, and what the system refused.
//!
//! In: wishes. Out: a set-up thread, and for each refusal its reason and remedy. Knows no bus and no model. Must be
//! called before the first cycle, never in one.

use std::fmt;
use std::fs::{self, File};
use std::io::{self, Write};

/// Wishes of a loop.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Wishes {
    /// Priority under SCHED_FIFO, 1 to 99. It must be above threads that may wait, and below threads that the loop
    /// waits for: 80 suits a loop whose interrupt threads have 85 and whose watchdog has 90.
    pub priority: i32,
    /// The core to stay on; any if none.
    pub core: Option<usize>,
    /// Whether to lock all memory of the process.
    pub memory: bool,
    /// Whether to keep processors out of deep sleep states.
    pub awake: bool,
}

impl Default for Wishes {
    fn default() -> Wishes {
        Wishes { priority: 80, core: None, memory: true, awake: true }
    }
}

impl Wishes {
    /// Those of the cycle of a rig: the defaults, on a core reserved for it if there is one.
    pub fn of_cycle() -> Wishes {
        Wishes { core: isolated_core(), ..Wishes::default() }
    }
}

/// A wish that can be refused.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum What {
    /// mlockall: no page of the process is fetched during a cycle.
    Memory,
    /// SCHED_FIFO: no thread of lower priority delays the loop.
    Priority,
    /// Affinity to one core.
    Core,
    /// `/dev/cpu_dma_latency` held at 0: no deep sleep state to wake from.
    Awake,
    /// Timer slack of 1 ns instead of the default 50 µs. SCHED_FIFO has none; it matters where SCHED_FIFO is refused.
    Slack,
}

/// A wish that was refused.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct RefusedWish {
    /// The wish.
    pub what: What,
    /// The kernel's message.
    pub reason: String,
    /// The command or setting that permits it.
    pub remedy: &'static str,
}

impl fmt::Display for RefusedWish {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{:?}: {}; {}", self.what, self.reason, self.remedy)
    }
}

/// A thread that has been set up. Dropping it restores priority, core and processor sleep; memory stays locked.
#[derive(Debug)]
pub struct RealTime {
    refused: Vec<RefusedWish>,
    priority_set: bool,
    cores_before: Option<libc::cpu_set_t>,
    // The kernel honours the request while the file is open.
    _awake: Option<File>,
}

/// Size of the stack touched in advance, bytes.
const STACK: usize = 512 * 1024;

/// Sets up the calling thread: locks the memory of the process, touches its stack, then requests the rest. Threads that
/// it starts later begin with ordinary priority.
pub fn enter(wishes: &Wishes) -> RealTime {
    let mut refused = Vec::new();
    let mut ask = |what: What, result: io::Result<()>, remedy| match result {
        Ok(()) => true,
        Err(error) => {
            refused.push(RefusedWish { what, reason: error.to_string(), remedy });
            false
        }
    };
    if wishes.memory {
        ask(What::Memory, lock_memory(), "ulimit -l unlimited, or LimitMEMLOCK=infinity in its unit");
    }
    touch_stack();
    ask(What::Slack, timer_slack(), "a kernel with PR_SET_TIMERSLACK");
    let cores_before = wishes.core.and_then(|core| {
        let before = cores();
        let only_one = "name a core that `cat /sys/devices/system/cpu/online` shows";
        ask(What::Core, stay_on(core), only_one).then_some(before).flatten()
    });
    let limits = "ulimit -r 95, or LimitRTPRIO=95 in its unit, or setcap cap_sys_nice,cap_ipc_lock=ep on the program";
    let priority_set = ask(What::Priority, fifo(wishes.priority), limits);
    let awake = wishes.awake.then(hold_awake).and_then(|held| match held {
        Ok(file) => Some(file),
        Err(error) => {
            ask(What::Awake, Err(error), "setfacl -m u:$USER:rw /dev/cpu_dma_latency");
            None
        }
    });
    RealTime { refused, priority_set, cores_before, _awake: awake }
}

/// Sets up the calling thread as one that must run even if the thread that started it hangs: on another core if that
/// one is bound to a single core and there is another, and with this priority if the system permits it.
pub fn stand_by(priority: i32) {
    if let Some(now) = cores() {
        // SAFETY: all bytes 0 is an empty set.
        let mut others: libc::cpu_set_t = unsafe { std::mem::zeroed() };
        for core in 0..8 * size_of::<libc::cpu_set_t>() {
            // SAFETY: the core lies within both sets.
            unsafe {
                if !libc::CPU_ISSET(core, &now) {
                    libc::CPU_SET(core, &mut others);
                }
            }
        }
        // SAFETY: the kernel has filled the set, which is only counted.
        if unsafe { libc::CPU_COUNT(&now) } == 1 {
            // If the set contains no core of this machine, the call is refused and the affinity stays unchanged.
            // SAFETY: the set is valid and outlives the call; 0 is the calling thread.
            unsafe { libc::sched_setaffinity(0, size_of::<libc::cpu_set_t>(), &others) };
        }
    }
    let _ = fifo(priority);
}

impl RealTime {
    /// The refused wishes; a real drive requires that there are none.
    pub fn refused(&self) -> &[RefusedWish] {
        &self.refused
    }
}

impl Drop for RealTime {
    fn drop(&mut self) {
        if self.priority_set {
            let ordinary = libc::sched_param { sched_priority: 0 };
            // SAFETY: the parameter is valid and outlives the call; 0 is the calling thread.
            unsafe { libc::sched_setscheduler(0, libc::SCHED_OTHER, &ordinary) };
        }
        if let Some(cores) = self.cores_before {
            // SAFETY: the set is valid and outlives the call; 0 is the calling thread.
            unsafe { libc::sched_setaffinity(0, size_of::<libc::cpu_set_t>(), &cores) };
        }
    }
}

/// Page faults and preemptions of the calling thread since its start.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Interruptions {
    /// Minor and major page faults.
    pub page_faults: u64,
    /// Number of involuntary context switches.
    pub preemptions: u64,
}

/// Page faults and preemptions of the calling thread so far: the difference over a run should be 0.
pub fn interruptions() -> Interruptions {
    // SAFETY: all bytes 0 is a valid rusage.
    let mut usage: libc::rusage = unsafe { std::mem::zeroed() };
    // SAFETY: `usage` is written by the call and outlives it.
    let done = unsafe { libc::getrusage(libc::RUSAGE_THREAD, &mut usage) };
    assert_eq!(done, 0, "every Linux counts for a thread");
    Interruptions { page_faults: (usage.ru_minflt + usage.ru_majflt) as u64, preemptions: usage.ru_nivcsw as u64 }
}

/// The first core reserved by `isolcpus=`, if this thread may use it.
pub fn isolated_core() -> Option<usize> {
    let list = fs::read_to_string("/sys/devices/system/cpu/isolated").ok()?;
    let first: String = list.chars().take_while(char::is_ascii_digit).collect();
    first.parse().ok()
}

fn checked(result: libc::c_int) -> io::Result<()> {
    if result == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

fn lock_memory() -> io::Result<()> {
    // SAFETY: takes no pointers.
    checked(unsafe { libc::mlockall(libc::MCL_CURRENT | libc::MCL_FUTURE) })
}

/// Touches the stack that the loop may need, so that no call in it causes a page fault.
#[inline(never)]
fn touch_stack() {
    let mut stack = [0u8; STACK];
    for page in stack.chunks_mut(4096) {
        // SAFETY: a plain store into a page of this function's own array; volatile, so that it is not optimised away.
        unsafe { std::ptr::write_volatile(&mut page[0], 1) };
    }
    std::hint::black_box(&stack);
}

fn timer_slack() -> io::Result<()> {
    // SAFETY: takes no pointers.
    checked(unsafe { libc::prctl(libc::PR_SET_TIMERSLACK, 1 as libc::c_ulong) })
}

fn fifo(priority: i32) -> io::Result<()> {
    let wish = libc::sched_param { sched_priority: priority };
    // SAFETY: the parameter is valid and outlives the call; 0 is the calling thread.
    checked(unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK, &wish) })
}

fn cores() -> Option<libc::cpu_set_t> {
    // SAFETY: all bytes 0 is an empty set.
    let mut set: libc::cpu_set_t = unsafe { std::mem::zeroed() };
    // SAFETY: the set is written by the call and outlives it; 0 is the calling thread.
    checked(unsafe { libc::sched_getaffinity(0, size_of::<libc::cpu_set_t>(), &mut set) }).ok().map(|()| set)
}

fn stay_on(core: usize) -> io::Result<()> {
    // CPU_SET ignores cores beyond the set, and the kernel refuses an empty set.
    // SAFETY: all bytes 0 is an empty set.
    let mut set: libc::cpu_set_t = unsafe { std::mem::zeroed() };
    if core < 8 * size_of::<libc::cpu_set_t>() {
        // SAFETY: the core lies within the set.
        unsafe { libc::CPU_SET(core, &mut set) };
    }
    // SAFETY: the set is valid and outlives the call; 0 is the calling thread.
    checked(unsafe { libc::sched_setaffinity(0, size_of::<libc::cpu_set_t>(), &set) })
}

fn hold_awake() -> io::Result<File> {
    let mut file = fs::OpenOptions::new().write(true).open("/dev/cpu_dma_latency")?;
    file.write_all(&0i32.to_ne_bytes())?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_are_reported_with_their_remedy() {
        // In a thread of its own, so that granted wishes end with it.
        let refused = std::thread::spawn(|| {
            let wishes = Wishes { priority: 1000, core: Some(100_000), memory: false, awake: false };
            enter(&wishes).refused().to_vec()
        });
        let refused = refused.join().expect("asking does not panic");
        let find = |what| refused.iter().find(|refusal| refusal.what == what).expect("refused by every kernel");
        assert!(find(What::Core).reason.contains("Invalid argument"), "{refused:?}");
        assert!(find(What::Priority).remedy.contains("LimitRTPRIO=95"), "{refused:?}");
        assert!(
            !refused.iter().any(|refusal| refusal.what == What::Slack || refusal.what == What::Awake),
            "{refused:?}"
        );
    }

    #[test]
    fn granted_wishes_are_released() {
        std::thread::spawn(|| {
            // SAFETY: takes no pointers; 0 is the calling thread.
            let policy = || unsafe { libc::sched_getscheduler(0) } & !libc::SCHED_RESET_ON_FORK;
            let set = enter(&Wishes { awake: false, memory: false, core: Some(0), ..Wishes::default() });
            let refused = set.refused().iter().any(|refusal| refusal.what == What::Priority);
            assert_eq!(policy() == libc::SCHED_FIFO, !refused);
            drop(set);
            assert_eq!(policy(), libc::SCHED_OTHER);
        })
        .join()
        .expect("asking does not panic");
    }

    #[test]
    fn a_page_fetched_is_counted() {
        let before = interruptions().page_faults;
        // So much memory never comes from pages that the process has used before.
        let mut fresh = vec![0u8; 64 << 20];
        (0..fresh.len()).step_by(4096).for_each(|at| fresh[at] = 1);
        std::hint::black_box(&fresh);
        assert!(interruptions().page_faults > before, "fresh memory has pages to map");
    }
}
