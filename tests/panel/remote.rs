//! The panel of a rig that `fric-rig` runs, beside it and from another computer.

use crate::browser::{Page, browser};
use crate::fric_rig::FRIC_RIG;
use crate::operated::CLIENT;
use crate::{folder, fric};
use runtime::hil::line::{Door, Line};
use serde_json::json;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// A rig at a rate that a busy computer keeps, on a simulated bus: it arms itself.
const RIG: &str = r#"
import std.friction
import std.control
import std.plant

rig slow {
  run rotary Servo(
        r   = step(0 s, 1 rad),
        m   = 0.012 kg·m^2,
        pid = rotary PIDDiscrete(Kp = 0.1 N·m/rad, Ti = 0.2 s, Td = 80 ms,
                                 N = 10, u_max = 2 N·m, Ts = 10 ms),
        fr  = rotary LuGre(sigma0 = 2 N·m/rad, sigma1 = 0.05 N·m·s/rad,
                           sigma2 = 0.018 N·m·s/rad, Fc = 0.28 N·m,
                           Fs = 0.42 N·m, vs = 0.01 rad/s, vd = 0.1 rad/s))
  rate     10 ms
  bus      can0  = sim("bench")
  drive    load  = cia402(can0, node = 3, T_rated = 4 N·m, mode = torque,
                          count = 1 rev / 262144, speed_unit = 0.01 rpm,
                          delay = 0.8 ms, lag = 0.6 ms, timeout = 1 s)
  drive    servo = cia402(can0, node = 4, T_rated = 4 N·m, mode = torque,
                          count = 1 rev / 262144, speed_unit = 0.01 rpm,
                          delay = 0.8 ms, lag = 0.6 ms, timeout = 1 s)
  hardware body {
    servo.torque = F_motor         limit -2 N·m .. 2 N·m
    load.torque  = -F_load         limit -1 N·m .. 1 N·m  slew 200 N·m/s
    v            = load.speed
    x            = servo.position
  }
  watchdog 5 s
  overrun  hold 100
  safe     load.torque = 0 N·m, servo.torque = 0 N·m
  stop     when abs(body.v) > 150 rad/s, "overspeed"
  record   fr.F [N·m]
  plot     body.x [deg], r [deg]
  plot     fr.F [N·m] against body.v [rpm]
  tune     fr.vs, fr.Fs in 0.3 N·m .. 0.6 N·m
}
"#;

/// A program that runs, until dropped.
struct Running {
    child: Child,
    link: String,
    told: Option<std::thread::JoinHandle<String>>,
}

impl Running {
    /// Starts a program that prints the link of a panel; what it says afterwards is collected.
    fn start(command: &mut Command, has_panel: bool) -> Running {
        let piped = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
        Running::of(piped.spawn().expect("it starts"), has_panel)
    }

    fn of(mut child: Child, has_panel: bool) -> Running {
        let mut lines = BufReader::new(child.stdout.take().expect("piped"));
        let mut link = String::new();
        while has_panel && !link.starts_with("panel  ") {
            link.clear();
            assert!(lines.read_line(&mut link).expect("a line") > 0, "no link");
        }
        let told = std::thread::spawn(move || {
            let mut all = String::new();
            let _ = lines.read_to_string(&mut all);
            all
        });
        Running { child, link: link.trim().trim_start_matches("panel  ").into(), told: Some(told) }
    }

    fn code(&mut self) -> i32 {
        let begun = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().expect("it is ours") {
                return status.code().unwrap_or(-1);
            }
            assert!(begun.elapsed() < Duration::from_secs(60), "it does not end");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        drop(self.told.take());
    }
}

/// A folder with the packed rig.
fn packed(name: &str) -> PathBuf {
    let folder = folder(name);
    fs::write(folder.join("slow.fric"), RIG).unwrap();
    let output = fric()
        .current_dir(&folder)
        .args(["build", "slow.fric", "-o", "slow.fricpkg"])
        .env("XDG_CONFIG_HOME", folder.join("config"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    folder
}

fn rig(folder: &Path, more: &[&str]) -> Command {
    let mut command = Command::new(&*FRIC_RIG);
    command.current_dir(folder).args(["run", "slow.fricpkg", "--dir", "there", "--log", "slow.friclog"]).args(more);
    command
}

/// An `ssh` that runs the command on this computer.
fn ssh(folder: &Path) -> String {
    let bin = folder.join("bin");
    fs::create_dir_all(&bin).unwrap();
    let script = "#!/bin/sh\nwhile [ \"$1\" != -- ]; do shift; done\nshift 2\nexec sh -c \"exec $*\"\n";
    fs::write(bin.join("ssh"), script).unwrap();
    fs::set_permissions(bin.join("ssh"), fs::Permissions::from_mode(0o755)).unwrap();
    format!("{}:{}", bin.display(), std::env::var("PATH").unwrap_or_default())
}

fn sentence(page: &Page, text: &str) {
    page.wait(&format!("document.getElementById('sentence')?.textContent.startsWith({text:?})"));
}

fn happened(what: &str) -> String {
    format!("document.getElementById('happened').textContent.includes('{what}')")
}

/// Types a value into the field of a parameter, and Enter.
fn typed(page: &Page, path: &str, text: &str) {
    page.value(&format!(
        "(() => {{ const k = [...document.querySelectorAll('.knob')].find(k => k.querySelector('b').textContent === '{path}'); \
         const f = k.querySelector('input'); f.focus(); f.select(); }})()"
    ));
    page.typed(text);
    page.key("Enter");
}

/// What the page of the packed rig shows and does, on whichever computer it is served.
fn operated(page: &Page) {
    sentence(page, "armed, the model runs");
    // `plot` makes the canvases: one over time with both positions, one in the plane; then what nobody plotted.
    page.wait("document.querySelectorAll('#times .plot').length > 1 && document.querySelectorAll('#planes .plot').length === 1");
    let names = page.text("document.querySelector('#times .names').textContent");
    assert!(names.contains("body.x") && names.contains("r "), "{names}");
    // `tune` makes the controls, in its order and within its ends.
    assert_eq!(
        page.value("[...document.querySelectorAll('.knob b')].map(b => b.textContent)"),
        json!(["fr.vs", "fr.Fs"])
    );
    page.again(&|| typed(page, "fr.Fs", "0.5 N·m"), &happened("fr.Fs = 0.5 N·m"));
    page.again(
        &|| typed(page, "fr.Fs", "0.7 N·m"),
        "document.getElementById('problem').textContent.includes('from 0.3 N·m to 0.6 N·m (`tune`), not to 0.7 N·m')",
    );
    // A mark stands in the log at its cycle.
    page.value("document.activeElement.blur()");
    let mark = || {
        page.key("m");
        page.typed("second bearing");
        page.key("Enter");
    };
    page.again(&mark, &happened("second bearing"));
}

fn replayed(log: &Path) -> String {
    let output = fric().arg("replay").arg(log).output().unwrap();
    let told = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{told}{}", String::from_utf8_lossy(&output.stderr));
    assert!(told.contains("second bearing"), "{told}");
    told
}

fn stops_of(parent: u32, name: &str) -> u32 {
    let all =
        fs::read_dir("/proc").unwrap().flatten().filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    let is_child = |pid: &u32| {
        let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
        let rest = stat.rsplit_once(") ").map(|(_, rest)| rest.to_string()).unwrap_or_default();
        let line = fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        rest.split(' ').nth(1) == Some(&parent.to_string()) && line.contains(name)
    };
    all.into_iter().find(is_child).unwrap_or_else(|| panic!("{parent} has no child {name}"))
}

fn signal(pid: u32, name: &str) {
    assert!(Command::new("kill").args([name, &pid.to_string()]).status().unwrap().success());
}

#[test]
fn a_packed_rig_has_its_panel_beside_it() {
    let folder = packed("beside");
    let mut running = Running::start(&mut rig(&folder, &["--sim", "--panel", "--port", "0"]), true);
    let page = browser().page(&running.link);
    operated(&page);
    page.shot("rig-plots");
    // A second panel shows and commands the same rig; the first one's end changes nothing.
    let mut second = Command::new(&*FRIC_RIG);
    second.current_dir(&folder).args(["panel", "--dir", "there", "--port", "0"]);
    let mut second = Running::start(&mut second, true);
    let other = browser().page(&second.link);
    sentence(&other, "armed");
    // One chair for all panels of the rig: the page that operates is one of the first panel.
    let chair = |page: &Page, text: &str| {
        page.wait(&format!("document.getElementById('chair').textContent.includes({text:?})"));
    };
    chair(&page, "you operate");
    chair(&other, "page 1 of panel 1 operates");
    other.wait("document.querySelectorAll('.knob').length === 2");
    other.again(
        &|| typed(&other, "fr.Fs", "0.45 N·m"),
        "document.getElementById('problem').textContent.includes('page 1 of panel 1 operates this rig: take over')",
    );
    let press = |page: &Page, text: &str| {
        let button = format!("[...document.querySelectorAll('#chair button')].find(b => b.textContent === {text:?})");
        page.wait(&button);
        page.value(&format!("{button}.click()"));
    };
    press(&other, "Take over");
    chair(&page, "page 1 of panel 2 asks to operate");
    press(&page, "Refuse");
    chair(&other, "has refused");
    // A line of a program needs no chair, and the log knows it from those of pages.
    let mut say = Command::new(&*FRIC_RIG);
    let said = say.current_dir(&folder).args(["say", "set fr.Fs = 0.41 N·m", "--dir", "there"]).output().unwrap();
    assert!(said.status.success(), "{}", String::from_utf8_lossy(&said.stderr));
    page.wait(&happened("fr.Fs = 0.41 N·m, by fric-rig say"));
    page.wait(&happened("fr.Fs = 0.5 N·m, by page 1 of panel 1"));
    signal(stops_of(running.child.id(), "panel"), "-KILL");
    sentence(&page, "not connected");
    // With its panel the page has left the chair.
    other.wait("document.getElementById('chair').hidden");
    other.again(&|| typed(&other, "fr.Fs", "0.45 N·m"), &happened("fr.Fs = 0.45 N·m, by page 1 of panel 2"));
    chair(&other, "you operate");
    other.key("Escape");
    sentence(&other, "ended as asked");
    other.wait(&happened("stop, by page 1 of panel 2"));
    assert_eq!(running.code(), 0);
    let told = replayed(&folder.join("slow.friclog"));
    for line in [
        "arm at",
        "by the program",
        "second bearing, by page 1 of panel 1",
        "of the model, by fric-rig say",
        "of the model, by page 1 of panel 2",
        "stop at",
    ] {
        assert!(told.contains(line), "{line}: {told}");
    }
    drop(other);
    assert_eq!(second.code(), 0);
    // Where no rig runs, there is no panel.
    let output = Command::new(&*FRIC_RIG).current_dir(&folder).args(["panel", "--dir", "there"]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("no rig runs in there"));
}

#[test]
fn a_rig_on_another_computer_is_operated_through_ssh() {
    let folder = packed("remote");
    let path = ssh(&folder);
    let mut running = Running::start(&mut rig(&folder, &["--sim"]), false);
    let panel = || {
        let mut command = fric();
        command.args(["panel", "anna@rig", "-o", "Port=2222", "--no-open", "--port", "0", "--rig"]).arg(&*FRIC_RIG);
        command.arg("--dir").arg(folder.join("there")).env("PATH", &path);
        command
    };
    let begun = Instant::now();
    while !folder.join("there/control").exists() {
        assert!(begun.elapsed() < Duration::from_secs(60), "the rig does not start");
        std::thread::sleep(Duration::from_millis(20));
    }
    let first = Running::start(&mut panel(), true);
    let page = browser().page(&first.link);
    operated(&page);

    // The link stands still: what is given meanwhile is old when it arrives, and refused; a stop is not.
    let feed = stops_of(first.child.id(), "feed");
    signal(feed, "-STOP");
    std::thread::sleep(Duration::from_millis(300));
    typed(&page, "fr.Fs", "0.55 N·m");
    std::thread::sleep(Duration::from_millis(1500));
    signal(feed, "-CONT");
    page.wait("document.getElementById('problem').textContent.includes('old: say it again')");
    assert_eq!(page.value(&happened("fr.Fs = 0.55 N·m")), json!(false));

    // The connection ends: the page says what that means, and the rig runs on.
    signal(feed, "-KILL");
    sentence(&page, "the connection to anna@rig has ended");
    assert!(page.text("document.getElementById('sentence').textContent").contains("wired stop"));
    drop(page);
    let second = Running::start(&mut panel(), true);
    let page = browser().page(&second.link);
    sentence(&page, "armed");
    let feed = stops_of(second.child.id(), "feed");
    signal(feed, "-STOP");
    page.key("Escape");
    std::thread::sleep(Duration::from_millis(1500));
    signal(feed, "-CONT");
    sentence(&page, "ended as asked");
    assert_eq!(running.code(), 0);
    page.wait(&happened("asked to stop"));
    replayed(&folder.join("slow.friclog"));
    // Nobody answers at the other end.
    let output = panel().output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(told.contains("no rig runs in") && told.contains("anna@rig feeds no panel"), "{told}");
}

/// Texts that are no commands, or none everywhere: parts of commands in any order.
fn refused_lines(seed: u64) -> Vec<String> {
    const PARTS: &[&str] = &[
        "enable",
        "arm",
        "stop",
        "again",
        "reset",
        "set",
        "set ",
        "mark",
        "show",
        "help",
        "take",
        "refuse",
        " ",
        " now",
        "=",
        ",",
        "fr.Fs",
        "fr.Fs = 0.4 N·m",
        "STOP",
        "stpo",
        "halt",
        "@1",
        "-",
        "\u{202e}",
        "\u{7}",
        "µ",
        "9",
    ];
    let mut chance = runtime::rng::Chance(seed);
    let mut all = Vec::new();
    while all.len() < 40 {
        let parts = (0..1 + chance.below(4)).map(|_| PARTS[chance.below(PARTS.len() as u64) as usize]);
        let text = parts.collect::<String>().trim().to_string();
        let refused = |door| Line::read(&text).and_then(|line| line.at(door)).is_err();
        if !text.is_empty() && [Door::Prompt, Door::Say, Door::Page].into_iter().all(refused) && !all.contains(&text) {
            all.push(text);
        }
    }
    all
}

/// Sets that are lines, but that a start would refuse.
const REFUSED_SETS: &[&str] = &[
    "set fr.Fs = -1 N·m",
    "set fr.Fs = 0.1 N·m",
    "set fr.Fs = 1 s",
    "set fr.Fs = 0.5",
    "set fr.Fs = much",
    "set fr.Fs = 0.5 furlong",
    "set fr.Fx = 0.5 N·m",
    "set fr.Fc = 0.3 N·m",
    "set fr.vs = 0 rad/s",
    "set fr.vs = 0.02 rad/s, fr.vs = 0.03 rad/s",
    "set fr.vs = 0.02 rad/s, pid.Ts = 15 ms",
];

/// The prompt of `fric hil`, `fric-rig say` and a page give the same answer to the same text. `FRIC_SEED` gives other texts.
#[test]
fn every_door_gives_the_same_answer_to_the_same_text() {
    let seed = std::env::var("FRIC_SEED").ok().and_then(|text| text.parse().ok()).unwrap_or(5);
    let mut texts = refused_lines(seed);
    texts.extend(REFUSED_SETS.iter().map(|text| text.to_string()));
    let folder = packed("doors");

    let mut hil = fric();
    hil.current_dir(&folder).args(["hil", "slow.fric", "--sim", "--panel", "--no-open", "--port", "0", "--log", "hil"]);
    let piped = hil.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut hil = Running::of(piped.spawn().expect("it starts"), true);
    let page = browser().page(&hil.link);
    sentence(&page, "armed");
    page.value(CLIENT);
    let asked = |text: &str| {
        let told = page.value(&format!("client.ask({}, true).then(answer => answer[1])", json!(text)));
        told.as_str().unwrap_or_else(|| panic!("{text:?}: {told}")).to_string()
    };
    let by_page: Vec<String> = texts.iter().map(|text| asked(text)).collect();
    let mut prompt = hil.child.stdin.take().expect("piped");
    // The panel has the same standard error and stays as long as its page: it is read by lines.
    let (told, errors) = (Arc::new(Mutex::new(String::new())), BufReader::new(hil.child.stderr.take().expect("piped")));
    let all = told.clone();
    std::thread::spawn(move || {
        errors.lines().map_while(Result::ok).for_each(|line| *all.lock().unwrap() += &format!("{line}\n"));
    });
    texts.iter().for_each(|text| writeln!(prompt, "{text}").expect("it reads"));
    writeln!(prompt, "stop").expect("it reads");
    sentence(&page, "ended as asked");
    std::thread::sleep(Duration::from_millis(300));
    writeln!(prompt, "quit").expect("it reads");
    assert_eq!(hil.code(), 0, "{}", told.lock().unwrap());
    std::thread::sleep(Duration::from_millis(300));
    let told = told.lock().unwrap().clone();
    let by_prompt: Vec<&str> = told.lines().filter(|line| line.contains(" is refused: ")).collect();
    // What the page says is printed there too.
    let own = by_prompt.len().checked_sub(texts.len()).unwrap_or_else(|| panic!("{told}"));
    let by_prompt = &by_prompt[own..];

    let running = Running::start(&mut rig(&folder, &["--sim", "--panel", "--port", "0"]), true);
    // Before that a set is refused because of the phase.
    sentence(&browser().page(&running.link), "armed");
    for ((text, by_page), by_prompt) in texts.iter().zip(&by_page).zip(by_prompt) {
        let mut say = Command::new(&*FRIC_RIG);
        let said = say.current_dir(&folder).args(["say", "--dir", "there", "--", text]).output().unwrap();
        let by_say = String::from_utf8_lossy(&said.stderr).trim().to_string();
        let begin = format!("error: `{text}` is refused: ");
        let why = by_prompt.strip_prefix(&begin).unwrap_or_else(|| panic!("{text:?}: {by_prompt}"));
        let read = |door| Line::read(text).and_then(|line| line.at(door));
        match read(Door::Prompt) {
            // Where a line has a meaning elsewhere only, each door says so for itself.
            Err(_) => {
                assert_eq!(read(Door::Prompt).err().as_deref(), Some(why), "{text:?}");
                assert_eq!(read(Door::Page).err(), Some(by_page.clone()), "{text:?}");
                let reason = read(Door::Say).expect_err("it is refused everywhere");
                assert!(by_say.ends_with(&format!("is refused: {reason}")), "{text:?}: {by_say}");
                assert_eq!(said.status.code(), Some(if Line::read(text).is_err() { 2 } else { 1 }), "{text:?}");
            }
            Ok(_) => {
                assert!(!why.is_empty() && by_page == why, "{text:?}: {by_page} {why}");
                assert_eq!((by_say, said.status.code()), (format!("{begin}{why}"), Some(1)));
            }
        }
    }
}
