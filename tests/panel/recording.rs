//! Recordings of rigs.

use crate::browser::{Page, browser};
use crate::{Panel, folder, fric};
use serde_json::json;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Stdio};
use std::time::{Duration, Instant};

/// A log of the rig of the example in simulated time.
fn log(name: &str, seconds: u32) -> PathBuf {
    let path = folder(name).join("rtfs.friclog");
    let time = format!("{seconds}s");
    let output = fric()
        .args(["hil", "examples/rtfs/rtfs.fric", "--sim", "--fast", "--for", &time, "--log"])
        .arg(&path)
        .output()
        .unwrap();
    assert!(path.exists(), "{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    path
}

/// The points of the curve that stands under force (signal 2) over speed (signal 1).
const STEADY: &str = r"new Promise(done => {
    const s = new WebSocket(`ws://${location.host}/socket`);
    s.binaryType = 'arraybuffer';
    s.onopen = () => { s.send('key ' + sessionStorage.getItem('key')); setTimeout(() => s.send('path 0 1,2 all'), 300); };
    s.onmessage = e => {
        if (typeof e.data === 'string') return;
        const d = new DataView(e.data);
        s.send('ack ' + d.getUint32(0, true));
        for (let at = 16, block = 0; block < d.getUint32(4, true); block++) {
            const [curve, count] = [d.getUint32(at + 4, true), d.getUint32(at + 12, true)];
            const [x, y] = [d.getFloat64(at + 16, true), d.getFloat64(at + 24, true)];
            at += 32;
            const points = Array.from({ length: count }, (_, i) => [x + d.getFloat32(at + 8 * i, true), y + d.getFloat32(at + 8 * i + 4, true)]);
            if (curve !== 2) { s.close(); done(points); }
            at += 8 * count;
        }
    };
})";

#[test]
fn a_recording_is_looked_through() {
    let path = log("recording", 4);
    let panel = Panel::open(&[path.to_str().unwrap()]);
    let page = browser().page(&panel.link);
    page.wait("document.querySelectorAll('.plot').length > 3");
    page.wait("[...document.querySelectorAll('.plot canvas[role=img]')].every(c => / to .* at the end/.test(c.getAttribute('aria-label')))");
    assert_eq!(page.text("document.getElementById('title').textContent"), "rtfs");
    let sentence = page.text("document.getElementById('sentence').textContent");
    assert!(sentence.starts_with("recording: ") && sentence.contains("cycles; it ended"), "{sentence}");
    assert!(page.text("document.getElementById('happened').textContent").contains("armed: the model runs"));
    assert!(page.text("document.getElementById('late').textContent").contains("0 missed"));
    page.shot("recording");
    // Zoomed in, each cycle is a point: the values are those of the exported table.
    let csv = path.with_extension("csv");
    let output = fric().args(["replay", path.to_str().unwrap(), "--csv"]).arg(&csv).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let table = fs::read_to_string(&csv).unwrap();
    let mut lines = table.lines();
    let at = lines.next().unwrap().split(',').position(|name| name == "body.x [deg]").expect("a column");
    let rows: Vec<(f64, f64)> = lines
        .map(|line| {
            let cells: Vec<&str> = line.split(',').collect();
            (cells[1].parse().unwrap(), cells[at].parse().unwrap())
        })
        .collect();
    let extremes = rows.iter().fold((f64::MAX, f64::MIN), |(low, high), row| (low.min(row.1), high.max(row.1)));
    let told = page.text("document.querySelector('.plot canvas[role=img]').getAttribute('aria-label')");
    let number = |word: &str| word.replace('−', "-").parse::<f64>().unwrap_or(f64::NAN);
    let words: Vec<f64> = told.split([' ', ',', ';']).map(number).filter(|x| x.is_finite()).collect();
    for wanted in [extremes.0, extremes.1, rows.last().unwrap().1] {
        assert!(words.iter().any(|word| (word - wanted).abs() <= 1e-3 * wanted.abs().max(1e-6)), "{wanted} in {told}");
    }
    // The model, anew from each full state, is near the rig; alone from arming on it is further away.
    page.wait("!document.getElementById('free').hidden");
    let differs = |page: &Page| -> f64 {
        let told = page.text(
            "[...document.querySelectorAll('.names li')].find(li => li.textContent.startsWith(' body.x') || li.textContent.startsWith('body.x')).querySelector('small').textContent",
        );
        number(told.trim().trim_start_matches("(differs by ").trim_end_matches(" rms)"))
    };
    page.wait("document.querySelector('.names small').textContent !== ''");
    let anew = differs(&page);
    assert!(anew < 0.05, "{anew} deg");
    page.value("document.getElementById('free').click()");
    page.wait("document.getElementById('legend').textContent.includes('from arming on')");
    page.value("new Promise(done => requestAnimationFrame(() => setTimeout(() => done(true), 300)))");
    let free = differs(&page);
    println!("body.x differs by {anew} deg from the model anew each second, by {free} from that from arming on");
    assert!(free > anew, "{free} {anew}");
    page.shot("recording-free");
    // The contact in the plane: its steady curve is that of the text's formula, at the speeds of the recording.
    page.wait("document.getElementById('legend').textContent.includes('steady curve')");
    let curve = page.value(STEADY);
    let points: Vec<(f64, f64)> =
        curve.as_array().unwrap().iter().filter_map(|point| Some((point[0].as_f64()?, point[1].as_f64()?))).collect();
    #[allow(clippy::disallowed_methods, reason = "compared within a tolerance, not to the bit")]
    for (rpm, force) in &points {
        let v: f64 = rpm * std::f64::consts::PI / 30.0;
        let wanted = v.signum() * (0.28 + 0.14 * (-(v / 0.01).powi(2)).exp()) + 0.018 * v;
        assert!((force - wanted).abs() < 0.01 * 0.42, "{force} N·m at {v} rad/s, and {wanted} by the formula");
    }
    let ends = points.iter().fold((0.0_f64, 0.0_f64), |(low, high), point| (low.min(point.0), high.max(point.0)));
    assert!(points.len() > 40 && ends.0 < -50.0 && ends.1 > 50.0, "{} points, {ends:?} rpm", points.len());
    // One press each: over the position, and speed over position.
    let press = |name: &str| {
        let all = "[...document.querySelectorAll('#planes .presses button')]";
        page.value(&format!("{all}.find(b => b.textContent === '{name}').click()"));
        page.wait(&format!("document.querySelector('#planes .names').textContent.includes('{name}')"));
        page.wait(
            "/ to .* at the end/.test(document.querySelector('#planes canvas[role=img]').getAttribute('aria-label'))",
        );
        let pressed = page
            .value(&format!("{all}.filter(b => b.getAttribute('aria-pressed') === 'true').map(b => b.textContent)"));
        assert_eq!(pressed, json!([name]));
        page.text("document.querySelector('#planes canvas[role=img]').getAttribute('aria-label')")
    };
    assert!(press("fr.F over body.x").starts_with("fr.F, "));
    page.place("#planes .stack");
    page.shot("recording-hysteresis");
    assert!(press("body.v over body.x").starts_with("body.v, "));
    page.shot("recording-limit-cycle");
    assert!(press("fr.F over body.v").starts_with("fr.F, "));
    page.value("document.getElementById('free').click()");
    // An event leads to its time.
    page.value("document.querySelector('#happened button').click()");
    page.wait("!/, 0 s to /.test(document.querySelector('.plot canvas[role=img]').getAttribute('aria-label'))");
    page.media("prefers-color-scheme", "dark");
    page.value("new Promise(done => requestAnimationFrame(() => setTimeout(() => done(true), 200)))");
    page.shot("recording-event-dark");
    // A recording obeys nobody, and needs no control for it.
    assert_eq!(page.value("document.getElementById('knobs').hidden"), json!(true));
    assert_eq!(page.complaints(), [""; 0]);
    let report = path.with_extension("html");
    let output = fric().args(["panel", path.to_str().unwrap(), "--save"]).arg(&report).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = browser().page(&format!("file://{}", report.display()));
    page.wait("document.querySelectorAll('.plot').length > 3");
    page.wait("/ to .* at the end/.test(document.querySelector('.plot canvas[role=img]').getAttribute('aria-label'))");
    assert_eq!(page.complaints(), [""; 0]);
}

#[test]
fn a_log_cut_off_by_a_crash_is_a_recording_too() {
    let path = log("cut", 1);
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() * 3 / 4]).unwrap();
    let panel = Panel::open(&[path.to_str().unwrap()]);
    let page = browser().page(&panel.link);
    page.wait("document.getElementById('sentence')?.textContent.includes('cut off at byte')");
    page.wait("document.querySelectorAll('.plot').length > 3");
    drop(panel);
    // One that is no log of anything is refused with its reason.
    fs::write(&path, &bytes[..40]).unwrap();
    let output = fric().args(["panel", path.to_str().unwrap(), "--no-open"]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("head is cut off or damaged"));
    let output = fric().args(["panel", "nowhere.fric", "--no-open"]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("cannot read nowhere.fric: there is no such file"));
    // The plant of a rig is another program: that its parameters have no effect must not look like a result.
    let output = fric().args(["panel", "examples/rtfs/rtfs.fric", "--no-open"]).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("a rig cannot be varied yet"));
}

/// A rig with simulated drives in wall-clock time, until dropped.
struct Running(Child, ChildStdin);

impl Running {
    fn start(log: &Path) -> Running {
        let mut command = fric();
        command.args(["hil", "examples/rtfs/rtfs.fric", "--sim", "--arm", "--count-overruns", "--quiet"]);
        command.arg("--log").arg(log).stdin(Stdio::piped());
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("fric starts");
        let prompt = child.stdin.take().expect("piped");
        let running = Running(child, prompt);
        // Its head is written with its first block, when the start-up has asked the drives.
        let begun = Instant::now();
        while fs::metadata(log).map_or(0, |log| log.len()) < 4096 {
            assert!(begun.elapsed() < Duration::from_secs(60), "no log");
            std::thread::sleep(Duration::from_millis(20));
        }
        running
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The end of the window in the text for screen readers, s.
fn to(page: &Page) -> f64 {
    let told = page.text("document.querySelector('.plot canvas[role=img]').getAttribute('aria-label') ?? ''");
    let to = told.split(" s to ").nth(1).and_then(|rest| rest.split(" s,").next()?.parse().ok());
    to.unwrap_or(f64::NAN)
}

#[test]
fn a_rig_that_runs_is_followed_through_its_log() {
    let path = folder("live").join("rtfs.friclog");
    let mut rig = Running::start(&path);
    let panel = Panel::open(&[path.to_str().unwrap()]);
    let page = browser().page(&panel.link);
    page.wait("document.getElementById('sentence')?.textContent.includes('more comes')");
    page.wait("/ to .* at the end/.test(document.querySelector('.plot canvas[role=img]').getAttribute('aria-label'))");
    let first = to(&page);
    page.wait("document.getElementById('happened').textContent.includes('armed: the model runs')");
    let later = |than: f64| {
        let begun = Instant::now();
        while to(&page).partial_cmp(&(than + 0.5)) != Some(std::cmp::Ordering::Greater) {
            assert!(begun.elapsed() < Duration::from_secs(30), "the picture stands still at {}", to(&page));
            std::thread::sleep(Duration::from_millis(50));
        }
    };
    later(first);
    page.shot("recording-grows");
    // The space bar holds the picture, while more comes.
    page.value("document.activeElement.blur()");
    page.key(" ");
    // The text for screen readers follows with up to half a second, or later on a busy machine.
    let (begun, mut held) = (Instant::now(), to(&page));
    loop {
        std::thread::sleep(Duration::from_millis(1200));
        let now = to(&page);
        if now == held {
            break;
        }
        held = now;
        assert!(begun.elapsed() < Duration::from_secs(30), "the picture goes on at {held}");
    }
    page.key("Home");
    later(held);
    // The end is that of the whole recording, and so are its curves.
    rig.1.write_all(b"stop\n").expect("the rig listens");
    assert!(rig.0.wait().unwrap().success());
    page.wait("document.getElementById('sentence').textContent.includes('it ended as asked')");
    page.key("Home");
    let csv = path.with_extension("csv");
    let output = fric().args(["replay", path.to_str().unwrap(), "--csv"]).arg(&csv).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let last = fs::read_to_string(&csv).unwrap();
    let last: f64 = last.lines().last().and_then(|line| line.split(',').nth(1)?.parse().ok()).expect("a row");
    page.wait(&format!(
        "Math.abs(Number(document.querySelector('.plot canvas[role=img]').getAttribute('aria-label').split(' s to ')[1].split(' s,')[0]) - {last}) < 0.01"
    ));
    assert_eq!(page.complaints(), [""; 0]);

    // One whose writer is killed is a recording that was not ended.
    let path = folder("killed").join("rtfs.friclog");
    let mut rig = Running::start(&path);
    let panel = Panel::open(&[path.to_str().unwrap()]);
    let page = browser().page(&panel.link);
    page.wait("document.getElementById('sentence')?.textContent.includes('more comes')");
    let _ = rig.0.kill();
    let killed = Instant::now();
    page.wait("/killed/.test(document.getElementById('sentence').textContent)");
    assert!(killed.elapsed() < Duration::from_secs(20), "{:?}", killed.elapsed());
}

#[test]
fn cursors_measure_all_points_and_a_trigger_finds_the_cycle() {
    let path = log("cursors", 4);
    let csv = path.with_extension("csv");
    let output = fric().args(["replay", path.to_str().unwrap(), "--csv"]).arg(&csv).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let table = fs::read_to_string(&csv).unwrap();
    let mut lines = table.lines();
    let at = lines.next().unwrap().split(',').position(|name| name == "body.v [rpm]").expect("a column");
    let rows: Vec<(f64, f64)> = lines
        .map(|line| {
            let cells: Vec<&str> = line.split(',').collect();
            (cells[1].parse().unwrap(), cells[at].parse().unwrap())
        })
        .collect();
    let panel = Panel::open(&[path.to_str().unwrap()]);
    let page = browser().page(&panel.link);
    page.wait("/ to .* at the end/.test(document.querySelector('.plot canvas[role=img]')?.getAttribute('aria-label'))");
    page.key("c");
    let number = |text: &str| text.replace('−', "-").parse::<f64>().unwrap_or(f64::NAN);
    let row =
        "[...document.querySelectorAll('#cursors tbody tr')].find(r => r.textContent.startsWith('body.v in rpm'))";
    // Means and the root of the mean square come from the panel.
    page.wait(&format!("{row} && !isNaN(parseFloat({row}.cells[4].textContent.replace('−', '-')))"));
    let cells = page.value(&format!("[...{row}.cells].map(c => c.textContent)"));
    let cells: Vec<f64> = cells.as_array().unwrap().iter().map(|cell| number(cell.as_str().unwrap())).collect();
    let head = page.text("document.querySelector('#cursors th').textContent");
    let times: Vec<f64> = head.split([' ', ':']).map(number).filter(|x| x.is_finite()).collect();
    let inside: Vec<&(f64, f64)> = rows.iter().filter(|row| (times[0]..=times[1]).contains(&row.0)).collect();
    let of = |f: fn(f64, f64) -> f64, begin: f64| inside.iter().fold(begin, |sum, row| f(sum, row.1));
    let n = inside.len() as f64;
    let (low, high) = (of(f64::min, f64::MAX), of(f64::max, f64::MIN));
    let (mean, rms) = (of(|sum, y| sum + y, 0.0) / n, (of(|sum, y| sum + y * y, 0.0) / n).sqrt());
    for (what, found, wanted) in
        [("min", cells[2], low), ("max", cells[3], high), ("mean", cells[4], mean), ("rms", cells[5], rms)]
    {
        assert!((found - wanted).abs() < 5e-3 * (high - low), "{what}: {found}, not {wanted}; {head} {cells:?}");
    }
    assert!((cells[6] - (high - low)).abs() < 1e-3 * (high - low), "{cells:?}");

    // The table between the cursors is that of the export, to the bit.
    page.value("URL.createObjectURL = blob => { blob.text().then(text => { window.csv = text; }); return 'data:,'; }");
    page.value(
        "[...document.querySelectorAll('#cursors > button')].find(b => b.textContent.startsWith('CSV')).click()",
    );
    page.wait("window.csv");
    let written = page.text("window.csv");
    let mut written = written.lines();
    let names: Vec<&str> = written.next().unwrap().split(',').collect();
    let place = names.iter().position(|name| *name == "body.v [rpm]").expect("a column");
    let written: Vec<(f64, f64)> = written
        .map(|line| {
            let cells: Vec<&str> = line.split(',').collect();
            assert_eq!(cells.len(), names.len(), "{line}");
            (cells[0].parse().unwrap(), cells[place].parse().unwrap())
        })
        .collect();
    assert!(written.len() > 1000 && written.len().abs_diff(inside.len()) <= 2, "{} {}", written.len(), inside.len());
    for (t, y) in &written {
        let wanted = rows.iter().find(|row| (row.0 - t).abs() < 1e-6).expect("a row of the export");
        assert_eq!(y.to_bits(), wanted.1.to_bits(), "at {t} s");
    }

    // The first rise above 20 rpm, and the next ones, each at its cycle.
    let rises: Vec<f64> =
        rows.windows(2).filter(|pair| pair[0].1 < 20.0 && pair[1].1 >= 20.0).map(|pair| pair[1].0).collect();
    assert!(!rises.is_empty());
    page.value("document.getElementById('triggered').click()");
    page.value(
        "(() => { const [signal, way] = document.querySelectorAll('#trigger select'); \
         signal.value = [...signal.options].find(o => o.text === 'body.v in rpm').value; way.value = 'rises'; \
         const level = document.querySelector('#trigger input'); level.value = '20'; level.dispatchEvent(new Event('change')); })()",
    );
    for wanted in &rises {
        let told = format!(
            "Math.abs(parseFloat(document.querySelector('#trigger output').textContent.slice(3)) - {wanted}) < 2e-6"
        );
        page.wait(&told);
        page.shot("recording-trigger");
        page.value("[...document.querySelectorAll('#trigger button')].at(-1).click()");
    }
    assert_eq!(page.complaints(), [""; 0]);
}
