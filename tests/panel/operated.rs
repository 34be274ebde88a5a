//! The panel beside a running rig.

use crate::browser::{Page, browser};
use crate::{folder, fric};
use serde_json::json;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Rigs run one at a time: each has a cycle of 1 ms.
static TURN: Mutex<()> = Mutex::new(());

/// `fric hil --sim --panel`, until dropped.
struct Rig {
    _turn: MutexGuard<'static, ()>,
    child: Child,
    _prompt: ChildStdin,
    log: PathBuf,
    link: String,
    told: std::thread::JoinHandle<String>,
}

impl Rig {
    /// With simulated drives in its own process: it arms itself.
    fn start(name: &str, more: &[&str]) -> Rig {
        Rig::begin(name, &[&["--sim"], more].concat())
    }

    fn begin(name: &str, more: &[&str]) -> Rig {
        let turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        let log = folder(name).join("rtfs.friclog");
        let mut command = fric();
        command.args(["hil", "examples/rtfs/rtfs.fric", "--panel", "--no-open", "--port", "0"]);
        command.args(["--count-overruns", "--log"]).arg(&log).args(more);
        let mut child =
            command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("fric starts");
        let mut lines = BufReader::new(child.stdout.take().expect("piped"));
        let mut link = String::new();
        while !link.starts_with("panel  ") {
            link.clear();
            assert!(lines.read_line(&mut link).expect("a line") > 0, "no link");
        }
        let told = std::thread::spawn(move || {
            let mut all = String::new();
            let _ = lines.read_to_string(&mut all);
            all
        });
        let prompt = child.stdin.take().expect("piped");
        Rig { _turn: turn, child, _prompt: prompt, log, link: link.trim()[7..].into(), told }
    }

    /// Waits for its end.
    fn code(&mut self) -> i32 {
        let begun = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().expect("it is ours") {
                return status.code().unwrap_or(-1);
            }
            assert!(begun.elapsed() < Duration::from_secs(60), "the rig does not end");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// The panel's process.
    fn panel(&self) -> u32 {
        let children = format!("/proc/{0}/task/{0}/children", self.child.id());
        let found = std::fs::read_to_string(children).expect("a process has children");
        found.split_whitespace().next().and_then(|pid| pid.parse().ok()).expect("the panel runs")
    }
}

/// Simulated drives as a program of their own, until dropped.
struct Drives(Child);

impl Drop for Drives {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn sentence(page: &Page, text: &str) {
    page.wait(&format!("document.getElementById('sentence')?.textContent.startsWith({text:?})"));
}

/// The rig's log, recomputed: `fric replay` and the table of its values.
fn replayed(log: &Path) -> String {
    let csv = log.with_extension("csv");
    let output = fric().arg("replay").arg(log).arg("--csv").arg(&csv).output().unwrap();
    let told = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{told}{}", String::from_utf8_lossy(&output.stderr));
    told
}

#[test]
fn a_rig_is_armed_set_and_stopped_from_the_page() {
    let mut rig = Rig::start("operated", &[]);
    let page = browser().page(&rig.link);
    // It arms itself with simulated drives; otherwise the buttons do.
    sentence(&page, "armed, the model runs");
    page.wait("document.querySelectorAll('.plot').length > 3 && document.querySelectorAll('.knob').length > 5");
    let row = |path: &str| {
        format!("[...document.querySelectorAll('.knob')].find(k => k.querySelector('b').textContent === '{path}')")
    };
    let (first, second) = (row("fr.Fs"), row("fr.Fc"));
    let field = |row: &str| page.text(&format!("{row}.querySelector('input').value"));
    let typed = |row: &str, text: &str| {
        page.value(&format!("(() => {{ const f = {row}.querySelector('input'); f.focus(); f.select(); }})()"));
        page.typed(text);
    };
    // Two changes are prepared, and sent as one set.
    let happened = |what: &str| format!("document.getElementById('happened').textContent.includes('{what}')");
    let both = || {
        typed(&first, "0.45 N·m");
        page.key("Tab");
        page.wait(&format!("!{first}.querySelector('.now').hidden"));
        page.wait("document.getElementById('apply').textContent.startsWith('Apply 1')");
        typed(&second, "0.29 N·m");
        page.shot("rig-staged");
        page.key("Enter");
    };
    page.again(&both, &happened("fr.Fs = 0.45 N·m"));
    page.wait(&happened("fr.Fc = 0.29 N·m"));
    page.wait(&format!("{first}.querySelector('input').value === '0.45 N·m'"));
    // A set that a start would refuse is refused with its reason, and changes nothing.
    let wrong = || {
        typed(&first, "-1 N·m");
        page.key("Enter");
    };
    page.again(&wrong, "document.getElementById('problem').textContent.includes('E0502')");
    let why = page.text("document.getElementById('problem').textContent");
    assert!(why.contains("“set fr.Fs = -1 N·m” is refused"), "{why}");
    page.wait(&format!("{first}.querySelector('input').value === '0.45 N·m'"));
    assert_eq!(field(&second), "0.29 N·m");
    page.value("document.activeElement.blur()");
    page.shot("rig-armed");
    page.media("prefers-color-scheme", "dark");
    page.size(390, 844);
    page.wait("new Promise(done => requestAnimationFrame(() => setTimeout(() => done(true), 300)))");
    assert_eq!(page.value("document.documentElement.scrollWidth"), json!(390));
    let [.., width, height] = page.place("#stop");
    assert!(width >= 150.0 && height >= 60.0, "{width} x {height}");
    page.shot("rig-small-dark");
    // Esc stops, also in a field, from any viewer.
    let other = browser().page(&rig.link);
    sentence(&other, "armed");
    other.value("document.querySelector('.knob input').focus()");
    other.key("Escape");
    sentence(&other, "ended as asked");
    sentence(&page, "ended as asked");
    assert_eq!(rig.code(), 0);
    page.wait("document.getElementById('happened').textContent.includes('asked to stop')");
    page.shot("rig-ended");
    assert_eq!(page.complaints(), [""; 0]);
    replayed(&rig.log);
    let told = std::mem::replace(&mut rig.told, std::thread::spawn(String::new)).join().unwrap();
    assert!(told.contains("panel: set fr.Fs = 0.45 N·m, fr.Fc = 0.29 N·m"), "{told}");
}

#[test]
fn the_rig_does_not_notice_the_end_of_its_panel_and_the_page_notices_that_of_the_rig() {
    let mut rig = Rig::start("panel-killed", &["--for", "6s"]);
    let page = browser().page(&rig.link);
    sentence(&page, "armed");
    let killed = std::process::Command::new("kill").args(["-9", &rig.panel().to_string()]).status().unwrap();
    assert!(killed.success());
    sentence(&page, "not connected");
    assert_eq!(rig.code(), 0);
    replayed(&rig.log);
    drop(rig);

    let mut rig = Rig::start("rig-killed", &[]);
    let page = browser().page(&rig.link);
    sentence(&page, "armed");
    let panel = rig.panel();
    let _ = rig.child.kill();
    let begun = Instant::now();
    sentence(&page, "the process of the rig was killed");
    assert!(begun.elapsed() < Duration::from_secs(10), "{:?}", begun.elapsed());
    // The panel stays as long as a page shows it, and then ends by itself.
    drop(page);
    let begun = Instant::now();
    while Path::new(&format!("/proc/{panel}/cmdline")).exists()
        && !std::fs::read(format!("/proc/{panel}/cmdline")).unwrap_or_default().is_empty()
    {
        assert!(begun.elapsed() < Duration::from_secs(60), "the panel remains");
        std::thread::sleep(Duration::from_millis(100));
    }
}

#[test]
fn old_commands_of_a_page_are_refused_and_its_stop_is_not() {
    let mut rig = Rig::start("old", &[]);
    let page = browser().page(&rig.link);
    sentence(&page, "armed");
    // A client of its own on the page's connection: commands with pictures of any age.
    let answer = |line: &str| {
        page.text(&format!(
            "new Promise(done => {{
                const s = new WebSocket(`ws://${{location.host}}/socket`);
                s.onopen = () => {{ s.send('key ' + sessionStorage.getItem('key')); s.send({:?}); }};
                s.onmessage = e => {{ if (typeof e.data === 'string' && JSON.parse(e.data).kind === 'answer') {{ done(e.data); s.close(); }} }};
                s.onclose = () => done('closed');
            }})",
            format!("7 {line}")
        ))
    };
    for line in
        ["set fr.Fs = 0.5 N·m", "@0 set fr.Fs = 0.5 N·m", "@1e9 arm", "@nan arm", "@0 enable", "@-1 arm", "reset"]
    {
        let told = answer(line);
        assert!(told.contains("refused"), "{line}: {told}");
    }
    assert!(!page.text("document.getElementById('happened').textContent").contains("fr.Fs"));
    // Stop with the oldest picture there is.
    assert!(answer("@0 stop").contains("\"ok\""));
    sentence(&page, "ended as asked");
    assert_eq!(rig.code(), 0);
}

#[test]
fn the_buttons_enable_and_arm_a_rig() {
    // Drives as a program of their own: the rig waits for its operator.
    let mut drives = fric();
    drives.args(["drives", "examples/rtfs/rtfs.fric", "--tcp", "0"]).stdin(Stdio::null()).stdout(Stdio::null());
    let mut drives = Drives(drives.stderr(Stdio::piped()).spawn().expect("fric starts"));
    let mut said = String::new();
    BufReader::new(drives.0.stderr.take().expect("piped")).read_line(&mut said).expect("a line");
    let port = said.split("port ").nth(1).and_then(|rest| rest.split(|c: char| !c.is_ascii_digit()).next());
    let bus = format!("can0=socketcand:127.0.0.1:{}/can0", port.unwrap_or_else(|| panic!("{said}")));
    let mut rig = Rig::begin("buttons", &["--bus", &bus, "--accept-jitter", "--accept-unstable"]);
    let page = browser().page(&rig.link);
    sentence(&page, "waiting to be enabled");
    let next = |text: &str| {
        page.wait(&format!(
            "!document.getElementById('next').hidden && document.getElementById('next').textContent === {text:?}"
        ));
    };
    next("Enable");
    page.shot("rig-waits");
    for _ in 0..20 {
        page.click("#next");
        std::thread::sleep(Duration::from_millis(500));
        if page.text("document.getElementById('sentence').textContent") != "waiting to be enabled" {
            break;
        }
    }
    sentence(&page, "waiting to be armed");
    // One press does not arm, and neither do two that are far apart.
    next("Arm");
    page.click("#next");
    next("Press again to arm");
    std::thread::sleep(Duration::from_millis(3500));
    next("Arm");
    page.click("#next");
    next("Press again to arm");
    assert!(page.text("document.getElementById('sentence').textContent").starts_with("waiting to be armed"));
    page.click("#next");
    sentence(&page, "armed");
    page.wait("document.getElementById('next').hidden");
    page.click("#stop");
    sentence(&page, "ended as asked");
    assert_eq!(rig.code(), 0);
    assert_eq!(page.complaints(), [""; 0]);
}

/// A client of its own on the page's connection, as `client`: it draws what comes, and `ask(line)` gives the time in ms to
/// the answer of the panel, or of the rig where that answers.
const CLIENT: &str = r#"new Promise(ready => {
    const s = new WebSocket(`ws://${location.host}/socket`), waits = new Map(), rigs = new Map();
    let number = 0, end = 0;
    s.binaryType = 'arraybuffer';
    s.onopen = () => { s.send('key ' + sessionStorage.getItem('key')); setTimeout(() => s.send('view 0 0 last 5 100'), 300); };
    s.onmessage = e => {
        if (typeof e.data !== 'string') {
            end = new DataView(e.data).getFloat64(8, true);
            s.send('ack ' + new DataView(e.data).getUint32(0, true));
            if (end > 0) ready(true);
            return;
        }
        const m = JSON.parse(e.data);
        if (m.kind === 'answer' && waits.has(m.number)) {
            const done = waits.get(m.number);
            if (m.refused || !done.rig) { done.resolve([performance.now() - done.begun, m.refused ?? '']); waits.delete(m.number); }
            else rigs.set(Number(m.ok), m.number);
        }
        const told = m.kind === 'state' ? m.is.answer : null, own = told && rigs.get(told.number);
        if (own !== null && waits.has(own)) {
            const done = waits.get(own);
            waits.delete(own);
            done.resolve([performance.now() - done.begun, told.refused ?? '']);
        }
    };
    window.client = {
        socket: s,
        say: line => s.send(`${++number} @${end} ${line}`),
        ask: (line, rig) => new Promise(resolve => {
            waits.set(++number, { resolve, rig, begun: performance.now() });
            s.send(`${number} @${end} ${line}`);
        }),
    };
})"#;

/// Prints how long a command takes to the cycle that answers it, and what that is made of. The bound is loose: other tests
/// run beside this one.
#[test]
fn a_command_reaches_the_next_cycle_soon() {
    let rig = Rig::start("soon", &[]);
    let page = browser().page(&rig.link);
    sentence(&page, "armed");
    page.value(CLIENT);
    let median = |line: &str, of_rig: bool| {
        let times = page.value(&format!(
            "(async () => {{ const all = []; for (let i = 0; i < 31; i++) {{ \
                 all.push((await client.ask({line:?}.replace('#', String(0.42 + 0.001 * (i % 2))), {of_rig}))[0]); \
                 await new Promise(done => setTimeout(done, 60)); }} return all.sort((a, b) => a - b); }})()"
        ));
        let times: Vec<f64> = times.as_array().unwrap().iter().map(|time| time.as_f64().unwrap()).collect();
        (times[times.len() / 2], times[0], times[times.len() - 1])
    };
    let page_and_panel = median("nothing", false);
    let and_cycle = median("enable", true);
    let set = median("set fr.Fs = # N·m", true);
    for (what, (median, least, most)) in [
        ("page, panel, page", page_and_panel),
        ("page, panel, prompt, next cycle and back", and_cycle),
        ("the same with a set, which is compiled and judged before", set),
    ] {
        println!("{what}: median {median:.1} ms, {least:.1} to {most:.1} ms");
    }
    assert!(set.0 < 2000.0, "{set:?}");
}

#[test]
fn a_stop_is_obeyed_with_a_full_queue_and_before_a_deaf_flood() {
    let mut rig = Rig::start("flood", &[]);
    let (one, other) = (browser().page(&rig.link), browser().page(&rig.link));
    sentence(&one, "armed");
    sentence(&other, "armed");
    // A program that holds the key, floods the panel and reads nothing of what it says.
    let address = rig.link.trim_start_matches("http://").split_once("/#").expect("a key").0.to_string();
    let mut deaf = crate::soak::Client::connect(&address, rig.link.split_once('#').expect("a key").1, &[]);
    for number in 0..150 {
        deaf.say(&format!("{number} @0 set fr.Fs = 0.5 N·m"));
    }
    // More commands than may wait: the rest is refused at once.
    one.value(CLIENT);
    let refused = one.value(
        "(async () => { const all = []; for (let i = 0; i < 60; i++) all.push(client.ask('set fr.Fs = 0.43 N·m', true)); \
         const first = await Promise.race([Promise.all(all), new Promise(done => setTimeout(() => done(all), 3000))]); \
         return Promise.all(all.map(one => Promise.race([one.then(a => a[1]), Promise.resolve('waits')]))); })()",
    );
    let refused: Vec<&str> = refused.as_array().unwrap().iter().filter_map(|why| why.as_str()).collect();
    println!(
        "{} of {} answered as full",
        refused.iter().filter(|why| why.contains("wait already")).count(),
        refused.len()
    );
    one.value("for (let i = 0; i < 60; i++) client.say('set fr.Fs = 0.44 N·m')");
    other.key("Escape");
    sentence(&other, "ended as asked");
    assert_eq!(rig.code(), 0);
    sentence(&one, "ended as asked");
    replayed(&rig.log);
    drop(deaf);
}

#[test]
fn a_rig_that_a_fault_stops_says_why() {
    let mut rig = Rig::start("fault", &["--inject", "load fault 0x2310 at 6 s"]);
    let page = browser().page(&rig.link);
    sentence(&page, "armed");
    sentence(&page, "stopped: ");
    assert_eq!(rig.code(), 3);
    let why = page.text("document.getElementById('sentence').textContent");
    assert!(why.contains("load"), "{why}");
    assert!(page.text("document.title").starts_with('▲'));
    page.wait("document.querySelector('#drives .light.bad')");
    page.wait("new Promise(done => requestAnimationFrame(() => setTimeout(() => done(true), 300)))");
    page.shot("rig-fault");
    // What it cannot do any more it does not offer.
    page.wait("document.getElementById('next').hidden");
    page.media("prefers-color-scheme", "dark");
    page.wait("new Promise(done => requestAnimationFrame(() => setTimeout(() => done(true), 300)))");
    page.shot("rig-fault-dark");
    assert_eq!(page.complaints(), [""; 0]);
}
