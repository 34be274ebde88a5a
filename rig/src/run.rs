//! Runs a packed rig, with the drives on its buses or with simulated ones.
//!
//! In: a verified package. Out: recordings, and the result of the run. Another package is taken over between two
//! cycles, and only while no drive has torque.

use crate::packed::{self, Open};
use crate::store::Store;
use crate::words;
use abi::rig::Rig;
use runtime::can::Bus;
use runtime::can::sim::Simulation;
use runtime::hil::chair::{Chair, PageLine, Seats};
use runtime::hil::cycle::{Attention, Command, End, Gauges};
use runtime::hil::line::{self, Door, Line};
use runtime::hil::live::Judge;
use runtime::hil::operator::{Answer, Operator, Reason, Stamp, Stopper};
use runtime::hil::origin::{Origin, Seat};
use runtime::hil::session::{self, Drives, Session, Setup};
use runtime::hil::simulated::World;
use runtime::hil::{emergency, watches};
use runtime::realtime::clock::Clock;
use runtime::record::log::{Sections, Settings, Sink};
use runtime::record::parts::{self, Limits};
use std::collections::BTreeSet;
use std::fs;
use std::io::{BufRead, BufReader, Read, Take, Write};
use std::net::{Shutdown, SocketAddr};
use std::os::unix::net::{UnixListener, UnixStream};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU16, AtomicUsize, Ordering};
use std::sync::mpsc::{self, SyncSender};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Interval at which the state is written and the installed package checked.
const LOOK: Duration = Duration::from_millis(100);

/// Arguments of a run.
pub struct RunArguments<'a> {
    /// A package; none: the current one of the store.
    pub package: Option<&'a Path>,
    /// Folder of the trusted public keys.
    pub trusted: &'a Path,
    /// Whether it may run on real buses without a trusted signature.
    pub allow_unsigned: bool,
    /// Folder of packages, logs, state.
    pub dir: &'a Path,
    /// Simulated buses, drives and devices.
    pub sim: bool,
    /// In simulated time, as fast as the computation.
    pub fast: bool,
    /// Only the checks of the start-up.
    pub check: bool,
    /// Time for which the model runs, s.
    pub duration: Option<f64>,
    /// `can0=ADDRESS`.
    pub buses: &'a [(String, String)],
    /// File of the recording.
    pub log: Option<&'a Path>,
    /// Its size limits.
    pub limits: Limits,
    /// Port of a panel, which is a process of its own; none: no panel.
    pub panel: Option<u16>,
    /// Address at which others may look at it.
    pub share: Option<SocketAddr>,
    /// Time for which no page of any panel need be drawn, s; none: for ever.
    pub dead_man: Option<f64>,
}

/// Result of a run.
pub enum Ended {
    /// It ended as requested.
    Asked,
    /// The safety supervisor or a condition stopped it; the reason.
    Stopped(String),
    /// It had passed its start-up checks and was waiting for its operator when it failed; the reason.
    Lost(String),
    /// Another package has been installed and may be taken over now.
    Replaced,
}

/// Runs until the end; returns the exit code.
pub fn run(wanted: &RunArguments) -> Result<u8, String> {
    let store = Store::at(wanted.dir);
    if wanted.package.is_none() && store.current_target().is_none() {
        let current = wanted.dir.join("current");
        return Err(format!("nothing is installed in {}: there is no {}", wanted.dir.display(), current.display()));
    }
    // Only one rig may run in a folder, because its socket and its state are there. In simulated time it has neither.
    let _alone = (!wanted.fast).then(|| store.lock()).transpose()?;
    emergency::guard();
    let mut fell_back = false;
    loop {
        let installed = || store.current_target().unwrap_or_else(|| "current".into());
        let target = wanted.package.map_or_else(installed, Path::to_path_buf);
        let path = if wanted.package.is_some() { target.clone() } else { wanted.dir.join(&target) };
        let ended = packed::open(&path, wanted.trusted).and_then(|open| once(wanted, &open, &store, &target, &path));
        let ended = match ended {
            Ok(ended) => ended,
            // The previous package runs instead; if that does not start either, nothing runs.
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
            // The rig had started: only a person may decide whether an older package takes its place.
            Ended::Lost(why) => return Err(format!("refused: {why}")),
            Ended::Replaced => {
                fell_back = false;
                words::print("another package is installed: taking it over\n");
            }
        }
    }
}

/// `package`: the file of `open`.
fn once(wanted: &RunArguments, open: &Open, store: &Store, target: &Path, package: &Path) -> Result<Ended, String> {
    if wanted.fast && wanted.duration.is_none() && !wanted.check {
        return Err(session::FAST_WITHOUT_END.into());
    }
    let mut rig = open.contents.rig.clone();
    session::readdress(&mut rig, wanted.buses)?;
    open.may_run(&rig.buses, wanted.sim, wanted.allow_unsigned)?;
    let control = open.program("control")?;
    let judge = open.judge(&control)?;
    let drives = Drives::of(&rig, wanted.sim, wanted.fast);
    let log = log(wanted, open, &rig, drives)?;
    let path = match &log.0.sink {
        Sink::File(path, _) | Sink::BlackBox(path, _) => path.clone(),
    };
    let mut options = session::options(&rig, &open.program("plant")?, drives)?;
    options.checks_only = wanted.check;
    options.duration_ns = wanted.duration.map(|seconds| (seconds * 1e9).round() as u64);
    // In simulated time the duration of a step does not matter.
    if let Some(why) = watches::too_slow(&rig, &control).filter(|_| !drives.is_fast()) {
        return Err(format!("refused: {why}"));
    }
    let _world;
    let (clock, buses): (Box<dyn Clock>, Vec<Box<dyn Bus>>) = match drives {
        Drives::Simulated(pace) => {
            let mut made = World::new(&rig, Some(open.program("plant")?), pace, 1)?;
            let both = (made.clock(), made.masters());
            _world = made;
            both
        }
        Drives::Real => {
            let time = Simulation::real_time();
            let buses = session::buses(&rig, &time)?;
            (Box::new(time), buses)
        }
    };
    // Before this thread is set up for real time: a child inherits its processors.
    let _panel = wanted.panel.map(|port| beside(wanted, port)).transpose()?;
    let facts = Facts {
        log: absolute(&path),
        started: log.1.text("started").unwrap_or_default().to_string(),
        package: absolute(package),
    };
    let setup = Setup {
        rig: &rig,
        control,
        drives,
        options,
        log: Some(log),
        judge: Some(judge.clone()),
        needs_real_time: "this computer gives no real time: `fric-rig doctor` says why",
    };
    let mut session = Session::start(setup, clock, buses)?;
    words::print(&format!(
        "{}: {} Hz, {}\n",
        rig.name,
        1e9 / rig.period_ns as f64,
        if drives.are_simulated() { "simulated drives" } else { "drives on their buses" }
    ));
    for lack in watches::missing_monitors(&rig) {
        words::print(&format!("  note: {lack}\n"));
    }
    let attention = wanted.dead_man.map(|limit| Arc::new(Attention::new(Duration::from_secs_f64(limit))));
    if let Some(attention) = &attention {
        session.hil.attended_by(attention.clone());
    }
    let operator = session.operator().filter(|_| !drives.is_fast());
    let gauges = session.hil.gauges();
    let attendant = operator.map(|operator| {
        Attendant::new(wanted, store, target, (gauges, attention), operator.by_the_wall(), judge, facts)
    });
    let end = session.run();
    attendant.iter().for_each(|attendant| attendant.tell_end(&end.words()));
    let replaced = attendant.as_ref().is_some_and(|attendant| attendant.replaced.load(Ordering::Relaxed));
    drop(attendant);
    let finished = session.finish();
    words::print(&finished.counts.lines().map(|line| format!("  {line}\n")).collect::<String>());
    match finished.log {
        Ok(Some(summary)) => words::print(&format!("  wrote {}\n", summary.words(&path))),
        Ok(None) => {}
        Err(error) => return Err(format!("the log {} is not whole: {error}", path.display())),
    }
    // An operator who stops a rig while another package waits wants that package to run next, unless the process itself
    // is to end.
    let waits = wanted.package.is_none() && store.current_target().is_some_and(|current| current != target);
    let goes_on = waits && wanted.duration.is_none() && !wanted.check && emergency::requested_stop().is_none();
    match end {
        End::Asked if replaced || goes_on => Ok(Ended::Replaced),
        End::Asked => Ok(Ended::Asked),
        End::Refused(why) if finished.has_started => Ok(Ended::Lost(why)),
        End::Refused(why) => Err(format!("refused: {why}")),
        End::Stopped(_, why) => Ok(Ended::Stopped(why)),
    }
}

/// File and head of the recording; the head contains everything that a replay needs.
fn log(wanted: &RunArguments, open: &Open, rig: &Rig, drives: Drives) -> Result<(Settings, Sections), String> {
    let head = open.head();
    let head = head.with("started", session::started(drives)).with("package", runtime::package::hash(&open.bytes));
    let path = match wanted.log {
        Some(path) => path.to_path_buf(),
        None => {
            let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
            wanted.dir.join("log").join(format!("{}-{}.friclog", rig.name, now.as_millis()))
        }
    };
    Ok((session::log_settings(rig, Sink::File(path, wanted.limits), drives), head))
}

/// The same place from every folder.
fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf())
}

/// Starts the panel of a run, in a process of its own. It ends by itself once the run has ended and nobody looks.
fn beside(wanted: &RunArguments, port: u16) -> Result<Child, String> {
    let about = |error: std::io::Error| format!("no panel: {error}");
    let mut command = std::process::Command::new(std::env::current_exe().map_err(about)?);
    command.args(["panel", "--of-run", "--port", &port.to_string(), "--dir"]).arg(wanted.dir);
    command.arg("--trusted").arg(wanted.trusted);
    if let Some(share) = wanted.share {
        command.args(["--share", &share.to_string()]);
    }
    // In a process group of its own: Ctrl-C stops the rig, and the panel shows how it ended.
    command.process_group(0).stdin(Stdio::piped()).spawn().map_err(about)
}

/// Threads beside the cycle: they write the state, accept commands, and detect that another package has been installed.
struct Attendant {
    over: Arc<AtomicBool>,
    replaced: Arc<AtomicBool>,
    desk: Arc<Desk>,
    threads: Vec<std::thread::JoinHandle<()>>,
    dir: PathBuf,
}

impl Attendant {
    fn new(
        wanted: &RunArguments,
        store: &Store,
        target: &Path,
        (gauges, attention): (Arc<Gauges>, Option<Arc<Attention>>),
        operator: Operator,
        judge: Judge,
        facts: Facts,
    ) -> Attendant {
        let [over, replaced] = [(); 2].map(|()| Arc::new(AtomicBool::new(false)));
        let stopper = operator.stopper();
        let (gauges_told, ended, panels) = (gauges.clone(), Mutex::default(), AtomicUsize::new(0));
        let operator = Mutex::new(operator);
        let desk = Arc::new(Desk {
            operator,
            stopper: stopper.clone(),
            judge,
            facts,
            gauges: gauges_told,
            attention,
            ended,
            panels,
            numbers: AtomicU16::new(0),
            chair: Mutex::default(),
        });
        let dir = wanted.dir.to_path_buf();
        let mut threads = Vec::new();
        {
            let [over, replaced] = [&over, &replaced].map(Arc::clone);
            let dir = dir.clone();
            let installed = wanted.package.is_none().then(|| store.clone());
            let target = target.to_path_buf();
            threads.push(std::thread::spawn(move || {
                while !over.load(Ordering::Relaxed) {
                    tell(&dir, &target, &gauges);
                    let idle = gauges.stage.get().is_idle();
                    let other =
                        installed.as_ref().is_some_and(|store| store.current_target().as_ref() != Some(&target));
                    if other && idle && !replaced.swap(true, Ordering::Relaxed) {
                        // The rig ends with the cycle that accepts the command: no drive has torque then.
                        stopper.stop(Origin::Program);
                    }
                    std::thread::sleep(LOOK);
                }
            }));
        }
        let socket = socket(&dir);
        let _ = fs::remove_file(&socket);
        if let Ok(listener) = UnixListener::bind(&socket) {
            let (over, desk) = (over.clone(), desk.clone());
            threads.push(std::thread::spawn(move || {
                for stream in listener.incoming().flatten() {
                    if over.load(Ordering::Relaxed) {
                        break;
                    }
                    // A client that connects and sends nothing must not block the others.
                    let desk = desk.clone();
                    std::thread::spawn(move || desk.attend(&stream));
                }
            }));
        }
        Attendant { over, replaced, desk, threads, dir }
    }

    /// Tells all panels how the run ended.
    fn tell_end(&self, words: &str) {
        *self.desk.ended.lock().unwrap_or_else(PoisonError::into_inner) = Some(words.into());
        let begun = Instant::now();
        while self.desk.panels.load(Ordering::Relaxed) > 0 && begun.elapsed() < 2 * DEAF {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

impl Drop for Attendant {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        // Wakes the thread that waits for connections.
        let _ = UnixStream::connect(socket(&self.dir));
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
        let _ = fs::remove_file(socket(&self.dir));
        let _ = fs::remove_file(self.dir.join("state"));
    }
}

/// The socket of the rig that runs in a folder.
pub fn socket(dir: &Path) -> PathBuf {
    dir.join("control")
}

/// Writes the state to the file that `status` reads.
fn tell(dir: &Path, target: &Path, gauges: &Gauges) {
    let number = |gauge: &std::sync::atomic::AtomicU64| gauge.load(Ordering::Relaxed);
    let text = format!(
        "{}: {}, {} cycles, late {} us at most, {} missed{}\n",
        target.display(),
        gauges.stage.get(),
        number(&gauges.cycles),
        number(&gauges.late_ns_max) / 1000,
        number(&gauges.missed),
        parts::warning(number(&gauges.log_free)).map_or(String::new(), |warning| format!("; {warning}")),
    );
    let fresh = dir.join(".state");
    // A full disk is no reason to disturb the cycle.
    let _ = fs::write(&fresh, text).and_then(|()| fs::rename(&fresh, dir.join("state")));
}

/// Merges the commands of all clients of the control socket.
struct Desk {
    operator: Mutex<Operator>,
    stopper: Stopper,
    judge: Judge,
    facts: Facts,
    gauges: Arc<Gauges>,
    attention: Option<Arc<Attention>>,
    /// How the run ended.
    ended: Mutex<Option<String>>,
    /// Panels that are connected.
    panels: AtomicUsize,
    /// The number of the latest panel.
    numbers: AtomicU16,
    /// Which page of all panels operates the rig.
    chair: Mutex<Chair>,
}

/// A command of a panel that waits to be carried out.
struct Waiting {
    number: u64,
    stamp: Stamp,
    origin: Origin,
    line: Line,
}

/// What a panel must know to find the log of a run.
struct Facts {
    /// The first file of its log.
    log: PathBuf,
    /// As in the head of the log.
    started: String,
    package: PathBuf,
}

/// Panels at the same time.
const PANELS: usize = 8;
/// Commands of a panel that wait; more are refused. A stop never waits.
const WAITING: usize = 16;
/// Time in which a line to a panel must be taken.
const DEAF: Duration = Duration::from_millis(200);
/// Intervals at which the stage is polled, and at which the time is sent.
const TOLD: (Duration, Duration) = (Duration::from_millis(20), Duration::from_millis(100));

/// Tells a panel something; false if it does not listen.
fn tell_panel(to: &Mutex<&UnixStream>, line: &str) -> bool {
    let clean: String = line.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    let mut to = to.lock().unwrap_or_else(PoisonError::into_inner);
    to.write_all(format!("{clean}\n").as_bytes()).is_ok()
}

/// Time within which a connected client must send its command.
const SPEAKS: Duration = Duration::from_secs(1);

impl Desk {
    /// Receives one command and sends its answer.
    fn attend(&self, stream: &UnixStream) {
        let mut line = String::new();
        let _ = stream.set_read_timeout(Some(SPEAKS));
        let mut lines = BufReader::new(stream.take(MOST_SAID));
        if lines.read_line(&mut line).is_err() || line.trim().is_empty() {
            return;
        }
        if line.trim() == "attend" {
            return self.attend_panel(stream, lines);
        }
        let (given, words) = line::stamped(&line);
        let given = given.map(|ns| ns.parse().map(Stamp::Wall).map_err(|_| format!("`@{ns}` is no time of its clock")));
        let said = Line::read(words).and_then(|line| line.at(Door::Say)).and_then(|line| match (line, given) {
            // A stop is obeyed with any time.
            (Line::Stop, _) => self.carry_out(&Line::Stop, Stamp::wall(), Origin::Say),
            (line, given) => self.carry_out(&line, given.unwrap_or(Ok(Stamp::wall()))?, Origin::Say),
        });
        let said = match said {
            Ok(Some(cycle)) => format!("ok {cycle}\n"),
            Ok(None) => "ok\n".into(),
            Err(why) => format!("refused {why}\n"),
        };
        let _ = (&*stream).write_all(said.as_bytes());
    }

    /// Serves a panel until the run or the connection ends.
    fn attend_panel(&self, stream: &UnixStream, lines: BufReader<Take<&UnixStream>>) {
        let to = Mutex::new(stream);
        if self.panels.fetch_add(1, Ordering::Relaxed) < PANELS {
            let _ = stream.set_read_timeout(None);
            let _ = stream.set_write_timeout(Some(DEAF));
            let Facts { log, started, package } = &self.facts;
            let facts = format!("log {}\nstarted {started}\npackage {}", log.display(), package.display());
            if facts.lines().all(|line| tell_panel(&to, line)) {
                let (send, queue) = mpsc::sync_channel(WAITING);
                let gone = AtomicBool::new(false);
                let (gone, to) = (&gone, &to);
                let panel = self.numbers.fetch_add(1, Ordering::Relaxed) + 1;
                std::thread::scope(|scope| {
                    scope.spawn(move || self.tell_stage(to, panel, gone));
                    scope.spawn(move || self.answer(to, &queue));
                    let pages = self.listen(lines, to, panel, &send);
                    gone.store(true, Ordering::Relaxed);
                    drop(send);
                    // With the connection, its pages are gone.
                    let (mut chair, now) = (self.chair(), Instant::now());
                    pages.into_iter().for_each(|page| chair.left(Seat { panel, page }, now));
                });
            }
        } else {
            tell_panel(&to, &format!("refused {PANELS} panels are connected already"));
        }
        self.panels.fetch_sub(1, Ordering::Relaxed);
    }

    /// Tells the stage, the time and the end of the run.
    fn tell_stage(&self, to: &Mutex<&UnixStream>, panel: u16, gone: &AtomicBool) {
        let (mut last, mut told, mut energy, mut seats) = (String::new(), None::<Instant>, (0.0, 0), Seats::default());
        tell_panel(to, &format!("you {panel}"));
        while !gone.load(Ordering::Relaxed) {
            let ended = self.ended.lock().unwrap_or_else(PoisonError::into_inner).clone();
            let stage = self.gauges.stage.get();
            let line = format!("stage {} {stage}", stage.awaits());
            let mut heard = line == last || tell_panel(to, &line);
            last = line;
            if told.is_none_or(|told| told.elapsed() >= TOLD.1) {
                let Stamp::Wall(ns) = Stamp::wall() else { unreachable!("that is what it gives") };
                heard &= tell_panel(to, &format!("now {ns}"));
                told = Some(Instant::now());
            }
            if self.gauges.energy() != energy {
                energy = self.gauges.energy();
                heard &= tell_panel(to, &format!("energy {} {}", energy.0, energy.1));
            }
            let now = self.chair().seats();
            if now != seats {
                seats = now;
                heard &= tell_panel(to, &format!("chair {seats}"));
            }
            if let Some(words) = &ended {
                tell_panel(to, &format!("over {words}"));
            }
            if ended.is_some() || !heard {
                let _ = to.lock().unwrap_or_else(PoisonError::into_inner).shutdown(Shutdown::Both);
                return;
            }
            std::thread::sleep(TOLD.0);
        }
    }

    fn chair(&self) -> MutexGuard<'_, Chair> {
        self.chair.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads what pages of a panel say, until it ends; returns the pages. A stop is carried out here, whatever waits.
    fn listen(
        &self,
        mut lines: BufReader<Take<&UnixStream>>,
        to: &Mutex<&UnixStream>,
        panel: u16,
        send: &SyncSender<Waiting>,
    ) -> BTreeSet<u32> {
        let (mut text, mut pages) = (String::new(), BTreeSet::new());
        loop {
            text.clear();
            lines.get_mut().set_limit(MOST_SAID);
            if !lines.read_line(&mut text).is_ok_and(|n| n > 0) {
                return pages;
            }
            let (seat, now) = (|page| Seat { panel, page }, Instant::now());
            let (number, page, given_ns, words) = match PageLine::read(text.trim()) {
                None => continue,
                Some(PageLine::Seen) => {
                    self.attention.iter().for_each(|attention| attention.seen());
                    continue;
                }
                Some(PageLine::Here(page)) => {
                    pages.insert(page);
                    self.chair().heard(seat(page), now);
                    continue;
                }
                Some(PageLine::Left(page)) => {
                    pages.remove(&page);
                    self.chair().left(seat(page), now);
                    continue;
                }
                Some(PageLine::Command { number, page, given_ns, words }) => (number, page, given_ns, words),
            };
            let refuse = |why: &str| _ = tell_panel(to, &format!("refused {number} {why}"));
            let line = match Line::read(words).and_then(|line| line.at(Door::Page)) {
                Ok(Line::Stop) => {
                    self.stopper.stop(Origin::Page(seat(page)));
                    tell_panel(to, &format!("ok {number}"));
                    continue;
                }
                Ok(line) => line,
                Err(why) => {
                    refuse(&why);
                    continue;
                }
            };
            pages.insert(page);
            let mut chair = self.chair();
            let seats = chair.says(seat(page), &line, now);
            let only = seats.is_some();
            let may = seats.unwrap_or_else(|| chair.command(seat(page), now));
            drop(chair);
            match may {
                Err(why) => refuse(&why),
                Ok(()) if only => _ = tell_panel(to, &format!("ok {number}")),
                Ok(()) => {
                    let stamp = given_ns.map_or_else(Stamp::wall, Stamp::Wall);
                    let said = Waiting { number, stamp, origin: Origin::Page(seat(page)), line };
                    if send.try_send(said).is_err() {
                        refuse(&format!("{WAITING} commands wait already: say it again"));
                    }
                }
            }
        }
    }

    /// Carries out commands in their order.
    fn answer(&self, to: &Mutex<&UnixStream>, queue: &mpsc::Receiver<Waiting>) {
        for Waiting { number, stamp, origin, line } in queue {
            match self.carry_out(&line, stamp, origin) {
                Ok(Some(cycle)) => tell_panel(to, &format!("ok {number} {cycle}")),
                Ok(None) => tell_panel(to, &format!("ok {number}")),
                Err(why) => tell_panel(to, &format!("refused {number} {why}")),
            };
        }
    }

    /// Executes a command that was given at this time. Returns the cycle of the log that took it, if one did.
    fn carry_out(&self, said: &Line, stamp: Stamp, origin: Origin) -> Result<Option<u64>, String> {
        let command = match said {
            Line::Enable => Command::Enable,
            Line::Arm => Command::Arm,
            Line::Set(wanted) => Command::Set(self.judge.read(wanted)?),
            Line::Mark(mark) => Command::Mark(*mark),
            // Clients do not wait for each other.
            Line::Stop => {
                self.stopper.stop(origin);
                return Ok(None);
            }
            Line::Again => return Err(line::RUNS.into()),
            // Refused where they are read, and of the chair alone.
            Line::Reset | Line::Show | Line::Help | Line::Quit | Line::Take | Line::Give | Line::Refuse => {
                return said.clone().at(Door::Say).map(|_| None);
            }
        };
        let operator = || self.operator.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let refused = |why: Reason| match why {
            Reason::Set(objection) => self.judge.words(&objection),
            why => why.words(),
        };
        let ticket = {
            let mut operator = operator();
            operator.speaks_for(origin);
            operator.say_at(command, stamp).map_err(refused)?
        };
        loop {
            // Other clients can send meanwhile.
            let answer = operator().answer(ticket);
            match answer {
                Some(Answer::Taken(cycle)) => return Ok(cycle),
                Some(Answer::Refused(why)) => return Err(refused(why)),
                None => std::thread::sleep(Duration::from_millis(2)),
            }
        }
    }
}

/// Longest command, bytes.
pub const MOST_SAID: u64 = 1 << 16;

/// Sends a command to the running rig.
pub fn say(dir: &Path, what: &Line) -> Result<String, String> {
    let about = |error: std::io::Error| format!("no rig runs in {}: {error}", dir.display());
    let Stamp::Wall(now_ns) = Stamp::wall() else { unreachable!("that is what it gives") };
    let mut stream = UnixStream::connect(socket(dir)).map_err(about)?;
    let _ = stream.set_read_timeout(Some(TELLS));
    stream.write_all(format!("@{now_ns} {what}\n").as_bytes()).map_err(about)?;
    let mut line = String::new();
    if BufReader::new(&stream).read_line(&mut line).is_err() || line.trim().is_empty() {
        return Err(format!("the rig in {} did not answer: {what} is not known to act", dir.display()));
    }
    let taken = match line.trim() {
        "ok" => String::new(),
        line => match line.strip_prefix("ok ") {
            Some(cycle) => format!("  by cycle {cycle} of the log\n"),
            None => {
                let why = line.strip_prefix("refused ").unwrap_or(line);
                return Err(format!("`{what}` is refused: {why}"));
            }
        },
    };
    match what {
        // A stability check requires the compiler.
        Line::Set(_) => Ok(format!(
            "{what}\n{taken}  not judged: whether the fixed step (E0702) and the contacts are stable with it; `fric predict --set` is\n"
        )),
        _ => Ok(format!("{what}\n{taken}")),
    }
}

/// Polling interval of the state for a follower, and longest interval between two outputs.
const FOLLOWS: (Duration, Duration) = (Duration::from_millis(50), Duration::from_secs(1));

/// Prints the state of the running rig: at once when its stage changes, otherwise once per second; until the rig ends,
/// or nobody reads the output any more.
///
/// # Errors
/// If no rig runs.
pub fn follow(dir: &Path) -> Result<String, String> {
    let read = || fs::read_to_string(dir.join("state")).ok();
    // The stage is between the package and the counters.
    let stage =
        |state: &str| state.split(" cycles").next().and_then(|head| head.rsplit_once(", ")).map(|it| it.0.to_string());
    let store = Store::at(dir);
    let mut last: Option<(String, std::time::Instant)> = None;
    while store.is_locked() {
        // During the change of packages there is no state for a moment.
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

/// Time for which a newly started rig is monitored.
const FIRST: Duration = Duration::from_secs(1);
/// Time within which it must report the package it runs, and within which a rig that runs already must take over
/// another.
const TELLS: Duration = Duration::from_secs(10);
/// Message of a rig that returns to the previous package.
const NOT_STARTED: &str = "the new package does not start: ";

/// Signatures that a rig to be started trusts.
#[derive(Clone, Copy)]
pub struct Trust<'a> {
    /// As [`RunArguments::trusted`].
    pub trusted: &'a Path,
    /// As [`RunArguments::allow_unsigned`].
    pub allow_unsigned: bool,
}

/// Starts the current package in a process of its own, which outlives this one. `hash`: of the package that must be the
/// current one; `limits`: size limits of its logs.
///
/// # Errors
/// The message of the rig, if it ended within its first second or runs another package than the current one.
pub fn start(dir: &Path, hash: Option<&str>, trust: Trust, limits: Limits) -> Result<String, String> {
    let store = Store::at(dir);
    let Some(current) = store.current_target() else {
        return Err(format!("nothing is installed in {}", dir.display()));
    };
    // A running rig may have tried that package and returned to the previous one before this request.
    let asked = hash.map_or_else(|| current.clone(), Store::target);
    let out = dir.join("log").join("rig.out");
    let about = |error: std::io::Error| format!("cannot start a rig in {}: {error}", dir.display());
    let mut child = None;
    if UnixStream::connect(socket(dir)).is_err() && current == asked {
        // State of a killed process.
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
            // Unless another process has started one at the same time.
            if !store.is_locked() {
                return Err(format!("it does not start ({status}): {}; {}", said(&out), back(&store, &asked)));
            }
            child = None;
        }
        if store.current_target().as_ref() != Some(&asked) {
            // Only once the rig accepts connections do others see that it runs, and start no second one beside it.
            while UnixStream::connect(socket(dir)).is_err() && begun.elapsed() < TELLS {
                if child.as_mut().is_some_and(|child| !matches!(child.try_wait(), Ok(None))) {
                    break;
                }
                std::thread::sleep(Duration::from_millis(20));
            }
            // A rig started by another process writes its output elsewhere.
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

/// The package named in the state.
fn runs(dir: &Path) -> Option<PathBuf> {
    let state = fs::read_to_string(dir.join("state")).ok()?;
    state.split_once(": ").map(|(target, _)| PathBuf::from(target))
}

/// Reason why the rig did not start, from its output.
fn said(out: &Path) -> String {
    let said = fs::read_to_string(out).unwrap_or_default();
    let why = said.lines().rev().find_map(|line| line.split_once(NOT_STARTED).map(|(_, why)| why));
    let error = || said.lines().rev().find_map(|line| line.strip_prefix("error: "));
    why.or_else(error).or_else(|| said.trim().lines().last()).unwrap_or_default().to_string()
}

/// Returns to the package before the one that does not start, unless the rig has done so itself.
fn back(store: &Store, asked: &Path) -> String {
    match store.current_target() {
        Some(current) if current != asked => format!("back to {}", current.display()),
        _ => match store.fall_back() {
            Ok(said) => said.trim().to_string(),
            Err(why) => format!("and there is nothing to go back to: {why}"),
        },
    }
}
