//! Runs a packed rig: against the drives on its buses, or against simulated ones.
//!
//! In: a package that has been verified. Out: recordings, and how it ended. Another package is taken over between two
//! cycles, while no drive has torque, and never otherwise.

use crate::packed::{self, Open};
use crate::store::Store;
use crate::words;
use abi::rig::Rig;
use runtime::can::address::Address;
use runtime::can::sim::Simulation;
use runtime::can::{self, Bus};
use runtime::drive::polarity_check::SignTest;
use runtime::hil::cycle::{Command, End, Gauges, Hil, Options, look_ahead};
use runtime::hil::live::Judge;
use runtime::hil::operator::{Answer, NO_RESET, Operator, Stamp, Stopper, Why};
use runtime::hil::simulated::{MASTER, Pace, World, holds_and_pushes};
use runtime::hil::{emergency, watches, words as told};
use runtime::realtime::clock::Clock;
use runtime::realtime::threads::{self, Wishes};
use runtime::record::log::{Sections, Settings, Sink};
use runtime::record::parts::{self, Limits};
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// Cycles whose loss a killed process may cost, as a time.
const BLOCK_NS: u64 = 100_000_000;
/// How often the state is told and the installed package looked at.
const LOOK: Duration = Duration::from_millis(100);
/// [`Gauges::stage`] from which on drives may have torque, and the one of torque off after a stop.
const ENABLE: u64 = runtime::drive::Step::Enable as u64;
const TORQUE_OFF: u64 = 103;

/// What to run, and how.
pub struct Wanted<'a> {
    /// A package, or the current one of the store.
    pub package: Option<&'a Path>,
    /// Folder of the public keys that are trusted.
    pub trusted: &'a Path,
    /// It may run on real buses though no trusted key has signed it.
    pub allow_unsigned: bool,
    /// Packages, logs, state.
    pub dir: &'a Path,
    /// Simulated buses, drives and devices.
    pub sim: bool,
    /// As fast as it computes, where it is simulated.
    pub fast: bool,
    /// The checks of the start-up only.
    pub check: bool,
    /// Time the model runs, s.
    pub duration: Option<f64>,
    /// `can0=ADDRESS`.
    pub buses: &'a [(String, String)],
    /// The recording.
    pub log: Option<&'a Path>,
    /// How large it may become.
    pub limits: Limits,
}

/// How it ended.
pub enum Ended {
    /// As asked.
    Asked,
    /// By safety or a condition: why.
    Stopped(String),
    /// It had passed its start-up checks and waited for its operator, and what it waited with was lost: why.
    Lost(String),
    /// Another package has been installed and may be taken over now.
    Replaced,
}

/// Runs until it ends; gives the exit code.
pub fn run(wanted: &Wanted) -> Result<u8, String> {
    let store = Store::at(wanted.dir);
    if wanted.package.is_none() && store.current_target().is_none() {
        let current = wanted.dir.join("current");
        return Err(format!("nothing is installed in {}: there is no {}", wanted.dir.display(), current.display()));
    }
    // One rig in a folder: its socket and its state are there. In simulated time there is neither.
    let _alone = (!wanted.fast).then(|| store.lock()).transpose()?;
    emergency::guard();
    let mut fell_back = false;
    loop {
        let installed = || store.current_target().unwrap_or_else(|| "current".into());
        let target = wanted.package.map_or_else(installed, Path::to_path_buf);
        let path = if wanted.package.is_some() { target.clone() } else { wanted.dir.join(&target) };
        let ended = packed::open(&path, wanted.trusted).and_then(|open| once(wanted, &open, &store, &target));
        let ended = match ended {
            Ok(ended) => ended,
            // What runs instead is what ran before it; if that does not start either, nothing runs.
            Err(why) if wanted.package.is_none() && !fell_back && store.took_over() => {
                words::error(&format!("{NOT_STARTED}{why}"));
                words::error(&store.fall_back()?);
                fell_back = true;
                continue;
            }
            Err(why) => return Err(why),
        };
        match ended {
            Ended::Asked => return Ok(0),
            Ended::Stopped(why) => {
                words::error(&format!("stopped: {why}"));
                return Ok(3);
            }
            // It did start: whether an older package shall take its place is for a person to say.
            Ended::Lost(why) => return Err(format!("refused: {why}")),
            Ended::Replaced => {
                fell_back = false;
                words::print("another package is installed: taking it over\n");
            }
        }
    }
}

fn once(wanted: &Wanted, open: &Open, store: &Store, target: &Path) -> Result<Ended, String> {
    if wanted.fast && wanted.duration.is_none() && !wanted.check {
        return Err("--fast needs --for TIME: simulated time has no operator who would end the run".into());
    }
    let mut rig = open.contents.rig.clone();
    for (bus, address) in wanted.buses {
        let Some(known) = rig.buses.iter_mut().find(|known| known.name == *bus) else {
            let names: Vec<&str> = rig.buses.iter().map(|bus| bus.name.as_str()).collect();
            return Err(format!("rig `{}` has no bus `{bus}`; it has {}", rig.name, names.join(", ")));
        };
        known.address.clone_from(address);
    }
    open.may_run(&rig.buses, wanted.sim, wanted.allow_unsigned)?;
    let control = open.program("control")?;
    let judge = open.judge(&control)?;
    let log = log(wanted, open, &rig)?;
    let path = match &log.0.sink {
        Sink::File(path, _) | Sink::BlackBox(path, _) => path.clone(),
    };
    let simulated = wanted.sim || rig.buses.iter().all(|bus| bus.address.starts_with("sim:"));
    let mut options = Options { arms_itself: simulated, checks_only: wanted.check, ..Options::default() };
    options.start.simulated = simulated;
    // What is late between this process and itself says nothing of the drives.
    options.start.missed = if simulated { 0.05 } else { 0.0 };
    if simulated && holds_and_pushes(&rig) {
        options.start.sign_test = SignTest::Skip;
    }
    options.duration_ns = wanted.duration.map(|seconds| (seconds * 1e9).round() as u64);
    options.look = look_ahead(&rig, &open.program("plant")?)?;
    options.control.needs_look = rig.needs_look;
    let fast = simulated && wanted.fast;
    // Simulated time stands still meanwhile.
    if let Some(why) = watches::too_slow(&rig, &control).filter(|_| !fast) {
        return Err(format!("refused: {why}"));
    }
    let world;
    let (clock, buses): (Box<dyn Clock>, Vec<Box<dyn Bus>>) = if simulated {
        let pace = if fast { Pace::Fast } else { Pace::Wall };
        let mut made = World::new(&rig, Some(open.program("plant")?), pace, 1)?;
        let both = (made.clock(), made.masters());
        world = Some(made);
        both
    } else {
        world = None;
        let time = Simulation::real_time();
        let buses = buses(&rig, &time)?;
        (Box::new(time), buses)
    };
    let real_time = (!fast)
        .then(|| threads::enter(&Wishes { priority: 80, core: threads::isolated_core(), memory: true, awake: true }));
    let refused: Vec<String> = real_time.iter().flat_map(|it| it.refused()).map(|it| format!("{it:?}")).collect();
    if !simulated && !refused.is_empty() {
        options.only_simulated = Some("this computer gives no real time: `fric-rig doctor` says why".into());
    }
    let (mut hil, operator) = Hil::new(&rig, control, clock, buses, options, Some(log))?;
    hil.judged_by(judge.clone());
    if !fast {
        let watchdog = emergency::Watchdog::new(Duration::from_nanos(rig.watchdog_ns), emergency::send);
        hil.watched_by(watchdog.map_err(|error| format!("no watchdog: {error}"))?);
        hil.prepare_emergency();
    }
    words::print(&format!(
        "{}: {} Hz, {}\n",
        rig.name,
        1e9 / rig.period_ns as f64,
        if simulated { "simulated drives" } else { "drives on their buses" }
    ));
    for lack in watches::lacking(&rig) {
        words::print(&format!("  note: {lack}\n"));
    }
    let attendant = (!fast).then(|| Attendant::new(wanted, store, target, hil.gauges(), operator.by_the_wall(), judge));
    let end = hil.run();
    let seen =
        |flag: fn(&Attendant) -> &AtomicBool| attendant.as_ref().is_some_and(|it| flag(it).load(Ordering::Relaxed));
    let (replaced, waited) = (seen(|it| &it.replaced), seen(|it| &it.waited));
    drop(attendant);
    drop(real_time);
    drop(world);
    let counts = told::counts(hil.counts());
    let written = hil.finish();
    words::print(&counts.lines().map(|line| format!("  {line}\n")).collect::<String>());
    match written {
        Ok(Some(summary)) => words::print(&format!("  wrote {}\n", summary.words(&path))),
        Ok(None) => {}
        Err(error) => return Err(format!("the log {} is not whole: {error}", path.display())),
    }
    // Whoever stops a rig for which another package waits wants that one next, unless the process itself is to end.
    let waits = wanted.package.is_none() && store.current_target().is_some_and(|current| current != target);
    let goes_on = waits && wanted.duration.is_none() && !wanted.check && emergency::asked().is_none();
    match end {
        End::Asked if replaced || goes_on => Ok(Ended::Replaced),
        End::Asked => Ok(Ended::Asked),
        End::Refused(why) if waited => Ok(Ended::Lost(why)),
        End::Refused(why) => Err(format!("refused: {why}")),
        End::Stopped(_, why) => Ok(Ended::Stopped(why)),
    }
}

/// The buses of this computer.
fn buses(rig: &Rig, time: &Simulation) -> Result<Vec<Box<dyn Bus>>, String> {
    let open = |bus: &abi::rig::Bus| {
        let options = can::Options { bit_rate: Some(bus.bit_rate).filter(|rate| *rate > 0), ..can::Options::default() };
        let address = bus.address.parse::<Address>().map_err(|why| why.to_string());
        address
            .and_then(|address| can::open(&address, &options, time, MASTER).map_err(|why| why.to_string()))
            .map_err(|why| format!("bus `{}`: {why}; --bus {}=ADDRESS puts another under it", bus.name, bus.name))
    };
    rig.buses.iter().map(open).collect()
}

/// Where the recording goes, and its head: all that a replay needs.
fn log(wanted: &Wanted, open: &Open, rig: &Rig) -> Result<(Settings, Sections), String> {
    let mut head = open.head();
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let repeatable = wanted.fast && wanted.sim;
    let started =
        if repeatable { String::new() } else { format!("{}.{:09} s since 1970", now.as_secs(), now.subsec_nanos()) };
    head = head.with("started", started).with("package", runtime::package::hash(&open.bytes));
    let path = match wanted.log {
        Some(path) => path.to_path_buf(),
        None => wanted.dir.join("log").join(format!("{}-{}.friclog", rig.name, now.as_millis())),
    };
    let cycles_per_block = u32::try_from((BLOCK_NS / rig.period_ns).max(1)).unwrap_or(u32::MAX);
    let settings = Settings { sink: Sink::File(path, wanted.limits), cycles_per_block, patient: repeatable };
    Ok((settings, head))
}

/// Threads beside the cycle: they tell the state, take commands, and see that another package has been installed.
struct Attendant {
    over: Arc<AtomicBool>,
    replaced: Arc<AtomicBool>,
    /// Whether the rig has been seen to wait for its operator.
    waited: Arc<AtomicBool>,
    threads: Vec<std::thread::JoinHandle<()>>,
    dir: PathBuf,
}

impl Attendant {
    fn new(
        wanted: &Wanted,
        store: &Store,
        target: &Path,
        gauges: Arc<Gauges>,
        operator: Operator,
        judge: Judge,
    ) -> Attendant {
        let [over, replaced, waited] = [(); 3].map(|()| Arc::new(AtomicBool::new(false)));
        let stopper = operator.stopper();
        let desk = Arc::new(Desk { operator: Mutex::new(operator), stopper: stopper.clone(), judge });
        let dir = wanted.dir.to_path_buf();
        let mut threads = Vec::new();
        {
            let [over, replaced, waited] = [&over, &replaced, &waited].map(Arc::clone);
            let dir = dir.clone();
            let installed = wanted.package.is_none().then(|| store.clone());
            let target = target.to_path_buf();
            threads.push(std::thread::spawn(move || {
                while !over.load(Ordering::Relaxed) {
                    tell(&dir, &target, &gauges);
                    let stage = gauges.stage.load(Ordering::Relaxed);
                    waited.fetch_or(stage >= ENABLE, Ordering::Relaxed);
                    let idle = stage < ENABLE || stage == TORQUE_OFF;
                    let other =
                        installed.as_ref().is_some_and(|store| store.current_target().as_ref() != Some(&target));
                    if other && idle && !replaced.swap(true, Ordering::Relaxed) {
                        // It ends with the cycle that takes the command: no drive has torque then.
                        stopper.stop();
                    }
                    std::thread::sleep(LOOK);
                }
            }));
        }
        let socket = socket(&dir);
        let _ = fs::remove_file(&socket);
        if let Ok(listener) = UnixListener::bind(&socket) {
            let over = over.clone();
            threads.push(std::thread::spawn(move || {
                for stream in listener.incoming().flatten() {
                    if over.load(Ordering::Relaxed) {
                        break;
                    }
                    // Who connects and says nothing keeps nobody waiting.
                    let desk = desk.clone();
                    std::thread::spawn(move || desk.attend(&stream));
                }
            }));
        }
        Attendant { over, replaced, waited, threads, dir }
    }
}

impl Drop for Attendant {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        // Wakes the one that waits for somebody to call.
        let _ = UnixStream::connect(socket(&self.dir));
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
        let _ = fs::remove_file(socket(&self.dir));
        let _ = fs::remove_file(self.dir.join("state"));
    }
}

fn socket(dir: &Path) -> PathBuf {
    dir.join("control")
}

/// Writes the state where `status` reads it.
fn tell(dir: &Path, target: &Path, gauges: &Gauges) {
    let number = |gauge: &std::sync::atomic::AtomicU64| gauge.load(Ordering::Relaxed);
    let text = format!(
        "{}: {}, {} cycles, late {} us at most, {} missed{}\n",
        target.display(),
        told::stage(number(&gauges.stage)),
        number(&gauges.cycles),
        number(&gauges.late_ns_max) / 1000,
        number(&gauges.missed),
        parts::warning(number(&gauges.log_free)).map_or(String::new(), |warning| format!("; {warning}")),
    );
    let fresh = dir.join(".state");
    // A disk that is full is no reason to disturb the cycle.
    let _ = fs::write(&fresh, text).and_then(|()| fs::rename(&fresh, dir.join("state")));
}

/// Merges the commands of all clients of the control socket.
struct Desk {
    operator: Mutex<Operator>,
    stopper: Stopper,
    judge: Judge,
}

/// How long somebody who has connected may take to say what he wants.
const SPEAKS: Duration = Duration::from_secs(1);

impl Desk {
    /// Takes one command and says what became of it.
    fn attend(&self, stream: &UnixStream) {
        let mut line = String::new();
        let _ = stream.set_read_timeout(Some(SPEAKS));
        if BufReader::new(stream.take(MOST_SAID)).read_line(&mut line).is_err() || line.trim().is_empty() {
            return;
        }
        let said = self.carry_out(line.trim());
        let _ = (&*stream).write_all(format!("{}\n", said.err().unwrap_or_else(|| "ok".into())).as_bytes());
    }

    /// `@NS COMMAND`: a command and when it was said, by the monotonic clock of this computer.
    fn carry_out(&self, line: &str) -> Result<(), String> {
        let stamped = line.strip_prefix('@').and_then(|rest| rest.split_once(' '));
        let (stamp, said) = match stamped.and_then(|(ns, said)| Some((Stamp::Wall(ns.parse().ok()?), said))) {
            Some(both) => both,
            None => (Stamp::wall(), line),
        };
        let command = match said {
            "enable" => Command::Enable,
            "arm" => Command::Arm,
            "reset" => return Err(format!("refused: {NO_RESET}")),
            // Speakers do not wait for each other.
            "stop" => {
                self.stopper.stop();
                return Ok(());
            }
            _ => match said.strip_prefix("set ") {
                Some(set) => Command::Set(self.judge.read(set)?),
                None => return Err("say enable, arm, set PATH = VALUE or stop".into()),
            },
        };
        let operator = || self.operator.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let refused = |why: Why| match why {
            Why::Set(objection) => format!("refused: {}", self.judge.words(&objection)),
            why => format!("refused: {}", why.words()),
        };
        let ticket = operator().say_at(command, stamp).map_err(refused)?;
        loop {
            // Others speak meanwhile.
            let answer = operator().answer(ticket);
            match answer {
                Some(Answer::Taken) => return Ok(()),
                Some(Answer::Refused(why)) => return Err(refused(why)),
                None => std::thread::sleep(Duration::from_millis(2)),
            }
        }
    }
}

/// Most bytes of a command.
const MOST_SAID: u64 = 1 << 16;

/// Says something to the rig that runs.
pub fn say(dir: &Path, what: &str) -> Result<String, String> {
    let about = |error: std::io::Error| format!("no rig runs in {}: {error}", dir.display());
    let Stamp::Wall(now_ns) = Stamp::wall() else { unreachable!("that is what it gives") };
    let mut stream = UnixStream::connect(socket(dir)).map_err(about)?;
    let _ = stream.set_read_timeout(Some(TELLS));
    stream.write_all(format!("@{now_ns} {what}\n").as_bytes()).map_err(about)?;
    let mut line = String::new();
    if BufReader::new(&stream).read_line(&mut line).is_err() || line.trim().is_empty() {
        return Err(format!("the rig in {} did not answer: {what} is not known to act", dir.display()));
    }
    match line.trim() {
        // Stability takes a compiler.
        "ok" if what.starts_with("set ") => Ok(format!(
            "{what}\n  not judged: whether the fixed step (E0702) and the contacts are stable with it; `fric predict --set` is\n"
        )),
        "ok" => Ok(format!("{what}\n")),
        why => Err(why.into()),
    }
}

/// How often the state is looked at for somebody who follows it, and how often it is told at least.
const FOLLOWS: (Duration, Duration) = (Duration::from_millis(50), Duration::from_secs(1));

/// Tells the state of the rig that runs: at once when it goes on to another stage, else once a second; until it ends, or
/// nobody reads any more.
///
/// # Errors
/// If none runs.
pub fn follow(dir: &Path) -> Result<String, String> {
    let read = || fs::read_to_string(dir.join("state")).ok();
    // The stage stands between the package and the counters.
    let stage =
        |state: &str| state.split(" cycles").next().and_then(|head| head.rsplit_once(", ")).map(|it| it.0.to_string());
    let store = Store::at(dir);
    let mut last: Option<(String, std::time::Instant)> = None;
    while store.is_locked() {
        // Between two packages there is none for a moment.
        let state = read().unwrap_or_default();
        let now = stage(&state).unwrap_or_default();
        if !state.is_empty() && last.as_ref().is_none_or(|(before, told)| *before != now || told.elapsed() >= FOLLOWS.1)
        {
            if !words::is_read(&state) {
                return Ok(String::new());
            }
            last = Some((now, std::time::Instant::now()));
        }
        std::thread::sleep(FOLLOWS.0);
    }
    if last.is_none() {
        return Err(format!("no rig runs in {}", dir.display()));
    }
    Ok(format!("the rig has ended; {} says how, if `start` started it\n", dir.join("log").join("rig.out").display()))
}

/// How long a rig that was just started is looked at.
const FIRST: Duration = Duration::from_secs(1);
/// How long it may take to tell which package it runs, and one that runs already to take another over.
const TELLS: Duration = Duration::from_secs(10);
/// What the rig says when it goes back.
const NOT_STARTED: &str = "the new package does not start: ";

/// Whom a rig that is started trusts.
#[derive(Clone, Copy)]
pub struct Trust<'a> {
    /// As [`Wanted::trusted`].
    pub trusted: &'a Path,
    /// As [`Wanted::allow_unsigned`].
    pub allow_unsigned: bool,
}

/// Starts the current package in a process of its own, which outlives this one. `hash`: of the package that must be it;
/// `limits`: how large its logs may become.
///
/// # Errors
/// What the rig said if it ended within its first second, or runs another package than the current one.
pub fn start(dir: &Path, hash: Option<&str>, trust: Trust, limits: Limits) -> Result<String, String> {
    let store = Store::at(dir);
    let Some(current) = store.current_target() else {
        return Err(format!("nothing is installed in {}", dir.display()));
    };
    // A rig that runs may have tried it and gone back before anybody asked.
    let asked = hash.map_or_else(|| current.clone(), Store::target);
    let out = dir.join("log").join("rig.out");
    let about = |error: std::io::Error| format!("cannot start a rig in {}: {error}", dir.display());
    let mut child = None;
    if UnixStream::connect(socket(dir)).is_err() && current == asked {
        // That of a process that was killed.
        let _ = fs::remove_file(dir.join("state"));
        let file = fs::File::create(&out).map_err(about)?;
        let program = std::env::current_exe().map_err(about)?;
        let mut command = std::process::Command::new(program);
        command.arg("run").arg("--dir").arg(dir).arg("--trusted").arg(trust.trusted);
        command.args(trust.allow_unsigned.then_some("--allow-unsigned")).stdin(std::process::Stdio::null());
        command.arg("--roll").arg(parts::option(limits.part));
        limits.keep.map(|keep| command.arg("--keep").arg(parts::option(keep)));
        command.stdout(file.try_clone().map_err(about)?).stderr(file);
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        child = Some(command.spawn().map_err(about)?);
    }
    let begun = std::time::Instant::now();
    loop {
        if let Some(one) = &mut child
            && let Some(status) = one.try_wait().map_err(about)?
        {
            // Unless somebody else started one in the same moment.
            if !store.is_locked() {
                return Err(format!("it does not start ({status}): {}; {}", said(&out), back(&store, &asked)));
            }
            child = None;
        }
        if store.current_target().as_ref() != Some(&asked) {
            // Only once it can be spoken to is it seen that a rig runs, and no second one started beside it.
            while UnixStream::connect(socket(dir)).is_err() && begun.elapsed() < TELLS {
                if child.as_mut().is_some_and(|child| !matches!(child.try_wait(), Ok(None))) {
                    break;
                }
                std::thread::sleep(Duration::from_millis(20));
            }
            // What was started by somebody else writes elsewhere.
            let why = if child.is_some() { said(&out) } else { "the rig that runs told why".into() };
            return Err(format!("it does not start: {why}; {}", back(&store, &asked)));
        }
        let runs = runs(dir).is_some_and(|runs| runs == asked);
        match &child {
            Some(child) if runs && begun.elapsed() >= FIRST => return Ok(format!("started, process {}\n", child.id())),
            None if runs && begun.elapsed() >= FIRST => return Ok("it runs\n".into()),
            Some(_) if begun.elapsed() > TELLS => {
                return Err(format!("it does not say that it runs; {} may tell more", out.display()));
            }
            None if begun.elapsed() > TELLS => {
                return Ok("a rig runs already: it takes the package over as soon as no drive has torque\n".into());
            }
            _ => std::thread::sleep(Duration::from_millis(20)),
        }
    }
}

/// The package that the state tells of.
fn runs(dir: &Path) -> Option<PathBuf> {
    let state = fs::read_to_string(dir.join("state")).ok()?;
    state.split_once(": ").map(|(target, _)| PathBuf::from(target))
}

/// Why the rig did not start, from what it said.
fn said(out: &Path) -> String {
    let said = fs::read_to_string(out).unwrap_or_default();
    let why = said.lines().rev().find_map(|line| line.split_once(NOT_STARTED).map(|(_, why)| why));
    let error = || said.lines().rev().find_map(|line| line.strip_prefix("error: "));
    why.or_else(error).or_else(|| said.trim().lines().last()).unwrap_or_default().to_string()
}

/// Goes back to the package before the one that does not start, unless the rig has done so itself.
fn back(store: &Store, asked: &Path) -> String {
    match store.current_target() {
        Some(current) if current != asked => format!("back to {}", current.display()),
        _ => match store.fall_back() {
            Ok(said) => said.trim().to_string(),
            Err(why) => format!("and there is nothing to go back to: {why}"),
        },
    }
}
