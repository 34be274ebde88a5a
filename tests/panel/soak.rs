//! Many signals for a long time, before many viewers.
//!
//! `FRIC_SOAK`: for how many seconds; 600 for the full test.

use crate::browser::browser;
use crate::client::Client;
use crate::{Panel, folder, fric};
use serde_json::json;
use std::fs;
use std::process::{Child, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// A rig with simulated drives in wall-clock time, until dropped.
struct Rig(Child);

impl Drop for Rig {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Resident memory in bytes, and processor time in s.
fn of_process(pid: u32) -> (f64, f64) {
    let number = |text: Option<&str>| text.and_then(|text| text.parse::<f64>().ok()).unwrap_or(f64::NAN);
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:")?.trim().strip_suffix(" kB"));
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    let mut words = stat.rsplit_once(") ").map_or("", |(_, rest)| rest).split(' ').skip(11);
    let ticks = number(words.next()) + number(words.next());
    (number(resident) * 1024.0, ticks / 100.0)
}

/// Processor time of a process and of those that it has started, in s.
fn of_tree(pid: u32) -> f64 {
    let children = fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    let children = children.filter_map(|task| fs::read_to_string(task.path().join("children")).ok());
    let all: Vec<u32> =
        children.flat_map(|text| text.split(' ').filter_map(|pid| pid.parse().ok()).collect::<Vec<_>>()).collect();
    of_process(pid).1 + all.into_iter().map(of_tree).sum::<f64>()
}

#[test]
fn memory_is_flat_before_ten_viewers_of_which_one_is_deaf() {
    let seconds: f64 = std::env::var("FRIC_SOAK").ok().and_then(|text| text.parse().ok()).unwrap_or(25.0);
    let folder = folder("soak");
    let log = folder.join("soak.friclog");
    // The rig of the example with so many recorded quantities that there are 40 curves in all.
    let example = fs::read_to_string(crate::root().join("examples/rtfs/rtfs.fric")).unwrap();
    let more: Vec<String> = (1..=26).map(|i| format!("{i} * body.x [deg]")).collect();
    let text =
        example.replace("shaft.torque [N·m]\n", &format!("shaft.torque [N·m]\n  record   {}\n", more.join(", ")));
    fs::create_dir_all(folder.join("rig")).unwrap();
    for entry in fs::read_dir(crate::root().join("examples/rtfs")).unwrap().flatten() {
        let _ = fs::copy(entry.path(), folder.join("rig").join(entry.file_name()));
    }
    let file = folder.join("rig/rtfs.fric");
    fs::write(&file, text).unwrap();
    let mut command = fric();
    command.args(["hil", "--sim", "--arm", "--count-overruns", "--quiet"]).arg(&file).args(["rtfs", "--log"]).arg(&log);
    let rig = command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("fric starts");
    let mut rig = Rig(rig);
    let begun = Instant::now();
    while fs::metadata(&log).map_or(0, |log| log.len()) < 4096 {
        assert!(rig.0.try_wait().unwrap().is_none() && begun.elapsed() < Duration::from_secs(60), "no log");
        std::thread::sleep(Duration::from_millis(20));
    }
    // Memory for some seconds of curves, so that it is full soon.
    let panel = Panel::open(&[log.to_str().unwrap(), "--keep", "10MB"]);
    let page = browser().page(&panel.link);
    page.wait("document.querySelectorAll('.plot').length > 10");
    let signals = page.value("document.querySelectorAll('.names li').length").as_u64().unwrap();
    assert!(signals >= 40, "{signals} curves");
    page.value(
        "(() => { const c = document.querySelector('.stack canvas').getContext('2d'), clear = c.clearRect.bind(c); \
         window.drawn = 0; c.clearRect = (...all) => { window.drawn++; clear(...all); }; })()",
    );
    let views: Vec<String> =
        (0..10).map(|i| format!("view {i} {},{},{},{} last 20 1200", 4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 3)).collect();
    let over = Arc::new(AtomicBool::new(false));
    let frames = Arc::new(AtomicU64::new(0));
    let readers: Vec<_> = (0..8)
        .map(|i| {
            let (mut client, over, frames) =
                (Client::connect(panel.address(), panel.key(), &views), over.clone(), frames.clone());
            client.0.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
            std::thread::spawn(move || {
                while !over.load(Ordering::Relaxed) {
                    let Some((opcode, bytes)) = client.message() else { break };
                    if opcode == 2 {
                        frames.fetch_add(1, Ordering::Relaxed);
                        // One of them is slow.
                        if i == 0 {
                            std::thread::sleep(Duration::from_millis(700));
                        }
                        client.say(&format!("ack {}", u32::from_le_bytes(bytes[..4].try_into().unwrap())));
                    }
                }
            })
        })
        .collect();
    let deaf = Client::connect(panel.address(), panel.key(), &views);
    let heap = || {
        page.call("HeapProfiler.enable", json!({}));
        page.call("HeapProfiler.collectGarbage", json!({}));
        page.call("Runtime.getHeapUsage", json!({}))["usedSize"].as_f64().unwrap()
    };
    // The window of 20 s and the curves in memory are full after a while.
    std::thread::sleep(Duration::from_secs_f64(0.5 * seconds.min(60.0)));
    let (begun, first) = (Instant::now(), (heap(), of_process(panel.child.id()), of_process(rig.0.id())));
    let spent = of_tree(browser().pid());
    page.call("Performance.enable", json!({}));
    let tasks = || {
        let all = page.call("Performance.getMetrics", json!({}))["metrics"].clone();
        ["ScriptDuration", "LayoutDuration", "RecalcStyleDuration", "TaskDuration"].map(|name| {
            let found = all.as_array().unwrap().iter().find(|one| one["name"] == name);
            found.and_then(|one| one["value"].as_f64()).unwrap_or(f64::NAN)
        })
    };
    let before = tasks();
    let drawn = page.value("window.drawn").as_f64().unwrap();
    let (mut least, mut most) = (f64::INFINITY, 0.0_f64);
    while begun.elapsed().as_secs_f64() < 0.5 * seconds + 0.5 * (seconds - 60.0).max(0.0) {
        std::thread::sleep(Duration::from_secs_f64((seconds / 10.0).min(30.0)));
        let resident = of_process(panel.child.id()).0;
        (least, most) = (least.min(resident), most.max(resident));
    }
    let elapsed = begun.elapsed().as_secs_f64();
    let spent = of_tree(browser().pid()) - spent;
    let after = tasks();
    let last = (heap(), of_process(panel.child.id()), of_process(rig.0.id()));
    let drawn = (page.value("window.drawn").as_f64().unwrap() - drawn) / elapsed;
    println!(
        "{signals} curves at 1 kHz for {elapsed:.0} s, 10 viewers: page heap {:.2} to {:.2} MB, panel {:.1} to {:.1} MB \
         ({:.1} to {:.1} between), {:.1} % of a core, rig {:.1} %; {drawn:.1} pictures/s, {:.1} ms of \
         the browser's processor time a picture, {:.1} frames/s to each of 8 others",
        first.0 * 1e-6,
        last.0 * 1e-6,
        first.1.0 * 1e-6,
        last.1.0 * 1e-6,
        least * 1e-6,
        most * 1e-6,
        100.0 * (last.1.1 - first.1.1) / elapsed,
        100.0 * (last.2.1 - first.2.1) / elapsed,
        1e3 * spent / (drawn * elapsed),
        frames.load(Ordering::Relaxed) as f64 / 8.0 / elapsed,
    );
    let each = |i: usize| 1e3 * (after[i] - before[i]) / (drawn * elapsed);
    println!(
        "a picture: {:.1} ms of script, {:.1} of layout, {:.1} of style, {:.1} of all tasks of the page's thread",
        each(0),
        each(1),
        each(2),
        each(3)
    );
    // What fills up does so before; what leaks a frame for each picture would be much larger.
    assert!(last.0 < first.0 + 1e6, "the page's heap grows from {} to {}", first.0, last.0);
    assert!(last.1.0 < first.1.0 + 6e6, "the panel grows from {} to {}", first.1.0, last.1.0);
    assert!(drawn > 0.5, "{drawn} pictures a second");
    assert!(frames.load(Ordering::Relaxed) > 16, "the others get frames");
    assert!(rig.0.try_wait().unwrap().is_none(), "the rig runs on");
    assert_eq!(page.complaints(), [""; 0]);
    over.store(true, Ordering::Relaxed);
    drop(deaf);
    drop(panel);
    readers.into_iter().for_each(|reader| reader.join().unwrap());
}
