//! The panel beside a running rig.

use crate::browser::{self, Page, browser};
use crate::client::Client;
use crate::{folder, fric};
use serde_json::json;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Stdio};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Rigs run one at a time: each has a cycle of 1 ms.
static TURN: Mutex<()> = Mutex::new(());

/// `fric hil --sim --panel`, until dropped.
pub struct Rig {
    _turn: MutexGuard<'static, ()>,
    child: Child,
    prompt: ChildStdin,
    pub log: PathBuf,
    pub link: String,
    told: Arc<Mutex<String>>,
}

impl Rig {
    /// With simulated drives in its own process: it arms itself.
    pub fn start(name: &str, more: &[&str]) -> Rig {
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
        let told = Arc::new(Mutex::new(String::new()));
        let all = told.clone();
        std::thread::spawn(move || {
            for line in lines.lines().map_while(Result::ok) {
                *all.lock().unwrap() += &format!("{line}\n");
            }
        });
        let prompt = child.stdin.take().expect("piped");
        Rig { _turn: turn, child, prompt, log, link: link.trim()[7..].into(), told }
    }

    fn told(&self) -> String {
        self.told.lock().unwrap().clone()
    }

    /// Waits for the end of its run, and then does not want another one.
    pub fn code(&mut self) -> i32 {
        let (begun, mut said) = (Instant::now(), false);
        loop {
            if let Some(status) = self.child.try_wait().expect("it is ours") {
                return status.code().unwrap_or(-1);
            }
            if !said && self.told().ends_with("type again or quit\n") {
                said = true;
                let _ = self.prompt.write_all(b"quit\n");
            }
            assert!(begun.elapsed() < Duration::from_secs(60), "the rig does not end");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// The link for others.
    fn share(&self) -> String {
        let begun = Instant::now();
        loop {
            if let Some(link) = self.told().lines().find_map(|line| line.strip_prefix("share  ")) {
                return link.into();
            }
            assert!(begun.elapsed() < Duration::from_secs(60), "no link for others");
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

pub fn sentence(page: &Page, text: &str) {
    page.wait(&format!("document.getElementById('sentence')?.textContent.startsWith({text:?})"));
}

/// The rig's log, recomputed: `fric replay` and the table of its values.
pub fn replayed(log: &Path) -> String {
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
    // The answer names the cycle, and so does the log.
    let taken = page.text("document.getElementById('taken').textContent");
    let cycle = taken.rsplit_once("taken by cycle ").expect("a cycle").1.to_string();
    // What was changed can be copied, kept, and prepared again.
    page.wait("document.getElementById('set').value === \"--set 'fr.Fc = 0.29 N·m' --set 'fr.Fs = 0.45 N·m'\"");
    let button =
        |text: &str| format!("[...document.querySelectorAll('#kept button')].find(b => b.textContent === '{text}')");
    page.value(&format!("{}.click()", button("keep A")));
    // Its curves stand still over what goes on, and can be hidden.
    page.wait("document.getElementById('legend').textContent.endsWith('A')");
    page.value("document.activeElement.blur()");
    page.key(" ");
    let picture = || {
        page.value("new Promise(done => requestAnimationFrame(() => setTimeout(() => done(true), 300)))");
        page.text("document.querySelector('#times .stack canvas').toDataURL()")
    };
    let ghosts = || page.value(&format!("{}.click()", button("curves of A")));
    let with = picture();
    ghosts();
    let without = picture();
    ghosts();
    page.shot("rig-ghost");
    // The range of a canvas may have followed meanwhile.
    assert!(with != without && picture() != without);
    page.key("Home");
    let back = || {
        typed(&first, "0.47 N·m");
        page.key("Enter");
    };
    page.again(&back, &happened("fr.Fs = 0.47 N·m"));
    page.wait(&format!("{first}.querySelector('input').value === '0.47 N·m'"));
    page.value(&format!("{}.click()", button("prepare A")));
    page.wait("document.getElementById('apply').textContent.startsWith('Apply 1')");
    assert_eq!(field(&first), "0.45 N·m");
    let apply = || {
        page.value(&format!("{}.click()", button("prepare A")));
        page.value("document.getElementById('apply').click()");
    };
    page.again(&apply, "document.getElementById('happened').textContent.split('fr.Fs = 0.45 N·m').length === 3");
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
    page.value("new Promise(done => requestAnimationFrame(() => setTimeout(() => done(true), 300)))");
    assert_eq!(page.value("document.documentElement.scrollWidth"), json!(390));
    let [.., width, height] = page.place("#stop");
    assert!(width >= 150.0 && height >= 60.0, "{width} x {height}");
    page.shot("rig-small-dark");
    // How much of the energy of its contact came back, and whether commands look ahead.
    page.wait("!document.getElementById('energy').hidden");
    let energy = "document.getElementById('energy').textContent";
    assert!(page.text(energy).ends_with("commands look ahead where the rig says so"), "{}", page.text(energy));
    assert_eq!(page.text("document.getElementById('energy').className"), "");
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
    let log = replayed(&rig.log);
    assert!(log.contains(&format!("set fr.Fs = 0.45 N·m in cycle {cycle}, at")), "{cycle}: {log}");
    let told = rig.told();
    assert!(told.contains("panel, page 1: set fr.Fs = 0.45 N·m, fr.Fc = 0.29 N·m"), "{told}");
    // The share is that which the end of the run counts.
    let share = |text: &str| text.split("at most ").nth(1)?.split(' ').next()?.parse::<f64>().ok();
    let counted = told.lines().find(|line| line.contains("of the stored energy came back")).and_then(share);
    let (shown, counted) = (share(&page.text(energy)).expect("a share"), counted.expect("a share"));
    assert!(counted > 0.0 && (shown - counted).abs() < 0.02, "{shown} {counted}");
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
    // 2 s are wanted; the bound is for machines that do something else.
    println!("the end of the rig is on the page after {:?}", begun.elapsed());
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
pub const CLIENT: &str = r#"new Promise(ready => {
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
        for (const told of m.kind === 'state' ? m.is.answers : []) {
            const own = rigs.get(told.number), done = waits.get(own);
            if (!done) continue;
            waits.delete(own);
            done.resolve([performance.now() - done.begun, told.refused ?? '', told.cycle]);
        }
    };
    window.client = {
        socket: s,
        say: line => s.send(`${++number} @${end} ${line}`),
        old: line => s.send(`${++number} @${end - 5} ${line}`),
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
        ("the same with a set, which is judged before", set),
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
    let mut deaf = Client::connect(&address, rig.link.split_once('#').expect("a key").1, &[]);
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
fn the_rig_does_not_notice_a_killed_browser_and_full_sockets() {
    let mut rig = Rig::start("unnoticed", &[]);
    let page = browser().page(&rig.link);
    sentence(&page, "armed");
    // Programs that ask for all there is, again and again, and read nothing of it: their sockets are full soon.
    let (address, key) = rig.link.trim_start_matches("http://").split_once("/#").expect("a key");
    let views: Vec<String> = (0..10).map(|i| format!("view {i} 0,1,2,3,4,5,6,7 0 60 4096")).collect();
    let mut deaf: Vec<Client> = (0..5).map(|_| Client::connect(address, key, &views)).collect();
    let other = Box::leak(Box::new(browser::start()));
    let killed = other.page(&rig.link);
    sentence(&killed, "armed");
    killed.wait("document.querySelectorAll('.knob').length > 5");
    for round in 0..20 {
        for client in &mut deaf {
            client.say(&format!("ack {}", 2 * round));
            views.iter().for_each(|view| client.say(view));
        }
        if round == 10 {
            other.kill();
            // Its page cannot be closed any more.
            std::thread::sleep(Duration::from_millis(100));
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    std::mem::forget(killed);
    let set = || {
        page.value("(() => { const f = document.querySelector('.knob input'); f.focus(); f.select(); })()");
        page.typed("2.5");
        page.key("Enter");
    };
    let path = page.text("document.querySelector('.knob b').textContent");
    page.again(&set, &format!("document.getElementById('happened').textContent.includes('{path} = 2.5')"));
    page.key("Escape");
    sentence(&page, "ended as asked");
    assert_eq!(rig.code(), 0);
    let told = rig.told();
    assert!(told.contains("log      0 messages dropped"), "{told}");
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
    page.value("new Promise(done => requestAnimationFrame(() => setTimeout(() => done(true), 300)))");
    page.shot("rig-fault");
    // What it cannot do any more it does not offer.
    page.wait("document.getElementById('next').textContent === 'Start again'");
    page.media("prefers-color-scheme", "dark");
    page.value("new Promise(done => requestAnimationFrame(() => setTimeout(() => done(true), 300)))");
    page.shot("rig-fault-dark");
    assert_eq!(page.complaints(), [""; 0]);
}

#[test]
fn one_page_operates_and_others_watch() {
    let mut rig = Rig::start("chair", &["--share", "127.0.0.1:0"]);
    let (one, two) = (browser().page(&rig.link), browser().page(&rig.link));
    let guest = browser().page(&rig.share());
    for page in [&one, &two, &guest] {
        sentence(page, "armed");
        page.wait("document.querySelectorAll('.knob').length > 5");
    }
    let chair = |page: &Page, text: &str| {
        page.wait(&format!("document.getElementById('chair').textContent.includes({text:?})"));
    };
    let press = |page: &Page, text: &str| {
        let button = format!("[...document.querySelectorAll('#chair button')].find(b => b.textContent === {text:?})");
        page.wait(&button);
        page.value(&format!("{button}.click()"));
    };
    let set = |page: &Page, value: &str| {
        page.value("(() => { const f = document.querySelector('.knob input'); f.focus(); f.select(); })()");
        page.typed(value);
        page.key("Enter");
    };
    let path = one.text("document.querySelector('.knob b').textContent");
    let unit = one.text("document.querySelector('.knob input').value").split_once(' ').map(|it| it.1.to_string());
    let own = |value: &str| [value, unit.as_deref().unwrap_or_default()].join(" ").trim().to_string();
    let happened =
        |value: &str| format!("document.getElementById('happened').textContent.includes('{path} = {}')", own(value));
    // Nobody operates before the first command; that takes the chair, and all see it.
    assert_eq!(one.value("document.getElementById('chair').hidden"), json!(true));
    one.again(&|| set(&one, &own("2.5")), &happened("2.5"));
    chair(&one, "you operate");
    chair(&two, "operates");
    chair(&guest, "you look on");
    two.again(
        &|| set(&two, &own("2.25")),
        "[...document.querySelectorAll('.knob .refused')].some(r => /operates this rig: take over/.test(r.textContent))",
    );
    assert!(two.value("document.getElementById('apply').disabled").as_bool().unwrap());
    one.shot("rig-operates");
    // Asked, refused; asked again, given.
    press(&two, "Take over");
    chair(&one, "asks to operate");
    one.shot("rig-asked");
    press(&one, "Refuse");
    chair(&two, "has refused");
    two.shot("rig-refused");
    press(&two, "Take over");
    press(&one, "Hand over");
    chair(&two, "you operate");
    chair(&one, "operates");
    two.again(&|| set(&two, &own("2.25")), &happened("2.25"));
    // Without an answer it is granted after five seconds.
    let begun = Instant::now();
    press(&one, "Take over");
    chair(&one, "you operate");
    assert!(begun.elapsed() > Duration::from_secs(4), "{:?}", begun.elapsed());
    // A page that closes leaves the chair.
    drop(one);
    two.wait("document.getElementById('chair').hidden");
    two.again(&|| set(&two, &own("2.75")), &happened("2.75"));
    // Others cannot even say so: not through the page, nor with its key.
    assert_eq!(
        guest.value("[...document.querySelectorAll('.knob input')].some(i => !i.disabled) || !document.getElementById('stages').hidden || !document.getElementById('next').hidden"),
        json!(false)
    );
    guest.value(CLIENT);
    for line in ["set fr.Fs = 0.5 N·m", "arm", "take", "mark here", "again", "nothing"] {
        let told = guest.text(&format!("client.ask({line:?}, false).then(a => a[1])"));
        assert!(told.contains("this link is for looking"), "{line}: {told}");
    }
    // They may stop it, while another page operates.
    guest.key("Escape");
    for page in [&two, &guest] {
        sentence(page, "ended as asked");
        assert_eq!(page.complaints(), [""; 0]);
    }
    assert_eq!(rig.code(), 0);
    replayed(&rig.log);
}

/// Random sets of several pages, some of which are old, in disorder, or of pages that do not operate; the chair goes from
/// one to another meanwhile. Each set that is answered with a cycle is in the log in that cycle, no other one is there, and
/// the log replays to the bit. `FRIC_SEED` repeats one.
#[test]
fn the_log_has_each_set_of_many_pages_at_the_cycle_that_is_answered() {
    let seed = std::env::var("FRIC_SEED")
        .ok()
        .and_then(|text| text.parse::<u64>().ok())
        .unwrap_or_else(|| std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_secs());
    println!("FRIC_SEED={seed}");
    let mut rig = Rig::start("many", &[]);
    let page = browser().page(&rig.link);
    sentence(&page, "armed");
    page.value("window.clients = []");
    for _ in 0..4 {
        page.value(&format!("{CLIENT}.then(() => window.clients.push(window.client))"));
    }
    let told = page.value(&format!(
        r"(async () => {{
            let state = {seed}n;
            const below = n => {{ state = (state * 6364136223846793005n + 1442695040888963407n) & (2n ** 64n - 1n); return Number((state >> 33n) % BigInt(n)); }};
            const all = [];
            let current = 0;
            await clients[0].ask('take', false);
            for (let i = 0; i < 60; i++) {{
                const client = clients[below(4) ? current : below(4)], turn = below(12);
                const params = [['fr.Fs', 0.42 + 0.001 * below(100), 'N·m'], ['fr.Fc', 0.2 + 0.001 * below(80), 'N·m'], ['fr.sigma2', 0.01 + 0.0001 * below(90), 'N·m·s/rad']];
                const [path, value, unit] = params[below(turn === 4 ? 2 : 3)], text = `${{path}} = ${{value.toFixed(4)}} ${{unit}}`;
                const asks = line => all.push(client.ask(line, true).then(a => [line, a[1], a[2] ?? null]));
                if (turn < 2) {{
                    const next = below(4);
                    await clients[next].ask('take', false);
                    await clients[current].ask(turn ? 'give' : 'refuse', false);
                    if (turn) current = next;
                }}
                else if (turn === 2) asks('set fr.Fs = 0.1 N·m, fr.Fc = 0.2 N·m');
                else if (turn === 3) client.old('set fr.Fs = 0.5 N·m');
                else if (turn === 4) asks(`set ${{text}}, fr.sigma2 = ${{(0.01 + 0.0001 * below(90)).toFixed(4)}} N·m·s/rad`);
                else asks(`set ${{text}}`);
                await new Promise(done => setTimeout(done, [0, 5, 60, 150][below(4)]));
            }}
            return Promise.all(all.map(one => Promise.race([one, new Promise(done => setTimeout(() => done(null), 30000))])));
        }})()",
    ));
    let told: Vec<_> = told.as_array().unwrap().iter().map(|one| one.as_array().expect("an answer").clone()).collect();
    page.key("Escape");
    sentence(&page, "ended as asked");
    assert_eq!(rig.code(), 0);
    let log = replayed(&rig.log);
    let mut wanted = Vec::new();
    let mut refused = 0;
    for one in &told {
        let (line, why) = (one[0].as_str().unwrap(), one[1].as_str().unwrap());
        match one[2].as_u64() {
            Some(cycle) => {
                assert_eq!(why, "", "{line}");
                wanted.extend(line.trim_start_matches("set ").split(", ").map(|set| {
                    let (path, value) = set.split_once(" = ").unwrap();
                    let (number, unit) = value.split_once(' ').unwrap();
                    format!("set {path} = {} {unit} in cycle {cycle},", number.parse::<f64>().unwrap())
                }));
            }
            None => {
                assert_ne!(why, "", "{line}");
                refused += 1;
            }
        }
    }
    println!("{} of {} sets were taken, {refused} refused", told.len() - refused, told.len());
    let listed: Vec<&str> = log.lines().filter(|line| line.trim().starts_with("set ")).collect();
    let mut open = wanted.clone();
    assert!(listed.iter().all(|line| line.contains(", by page ")), "{listed:?}");
    let table = std::fs::read_to_string(rig.log.with_extension("csv")).unwrap();
    let by_pages =
        table.lines().filter(|row| row.rsplit(',').next().is_some_and(|it| it.starts_with("set by page "))).count();
    assert!(by_pages > 0 && table.lines().next().unwrap().ends_with(",commands"), "{by_pages} of {}", listed.len());
    for line in &listed {
        let at = open.iter().position(|wanted| line.trim().starts_with(wanted.as_str()));
        open.remove(at.unwrap_or_else(|| panic!("`{line}` was not answered: {wanted:?}")));
    }
    let more = log.lines().find_map(|line| line.trim().strip_prefix("and ")?.split(' ').next()?.parse().ok());
    assert_eq!(
        open.len(),
        more.unwrap_or(0),
        "answered, and not in the log: {open:?}
{log}"
    );
    assert!(refused > 0 && wanted.len() > 5, "{told:?}");
}

#[test]
fn a_rig_is_started_again_from_its_page() {
    let mut rig = Rig::start("again", &[]);
    let (page, other) = (browser().page(&rig.link), browser().page(&rig.link));
    let again =
        "!document.getElementById('next').hidden && document.getElementById('next').textContent === 'Start again'";
    for run in 1..=2 {
        for page in [&page, &other] {
            sentence(page, "armed");
            page.wait("document.querySelectorAll('.knob').length > 5");
        }
        // The curves of this run begin with it.
        page.wait(
            "/ to .* at the end/.test(document.querySelector('.plot canvas[role=img]')?.getAttribute('aria-label'))",
        );
        std::thread::sleep(Duration::from_millis(700));
        page.key("Escape");
        for page in [&page, &other] {
            sentence(page, "ended as asked");
            page.wait(again);
        }
        page.shot("rig-again");
        assert_eq!(
            page.value("document.getElementById('happened').textContent.split('asked to stop').length - 1"),
            json!(1)
        );
        if run == 1 {
            page.click("#next");
            page.wait("!document.getElementById('sentence').textContent.startsWith('ended')");
        }
    }
    assert_eq!(rig.code(), 0);
    replayed(&rig.log);
    let second = rig.log.with_file_name("rtfs-2.friclog");
    replayed(&second);
    assert_eq!(page.complaints(), [""; 0]);
}

#[test]
fn a_rig_with_a_dead_mans_switch_stops_when_nobody_watches() {
    let mut rig = Rig::start("dead-man", &["--dead-man", "2s"]);
    // It is armed only once a page shows it.
    std::thread::sleep(Duration::from_secs(3));
    let page = browser().page(&rig.link);
    sentence(&page, "armed");
    std::thread::sleep(Duration::from_secs(3));
    let now = page.text("document.getElementById('sentence').textContent");
    assert!(now.starts_with("armed"), "{now}");
    // A frozen tab draws nothing.
    page.call("Page.setWebLifecycleState", json!({ "state": "frozen" }));
    std::thread::sleep(Duration::from_millis(3500));
    let other = browser().page(&rig.link);
    sentence(&other, "stopped: nobody watches");
    drop(page);
    assert_eq!(rig.code(), 3);
    assert!(replayed(&rig.log).contains("nobody watches"));
}
