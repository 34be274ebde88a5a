//! A simulation that changes under the hand.

use crate::browser::{Page, browser};
use crate::{Panel, STICK_SLIP, folder, fric};
use std::fs;
use std::time::{Duration, Instant};

/// The description of a canvas for screen readers.
fn summary(page: &Page, canvas: usize) -> String {
    page.text(&format!(
        "document.querySelectorAll('.plot canvas[role=img]')[{canvas}].getAttribute('aria-label') ?? ''"
    ))
}

/// Selector of the slider of a parameter.
fn slider(path: &str) -> String {
    format!("input[type=range][aria-label='{path}, slider']")
}

fn field(page: &Page, path: &str) -> String {
    page.text(&format!(
        "[...document.querySelectorAll('.knob')].find(k => k.querySelector('b').textContent === {path:?}).querySelector('input').value"
    ))
}

/// Opens an experiment, and waits for its curves.
pub fn open(panel: &Panel) -> Page {
    let page = browser().page(&panel.link);
    page.wait("document.querySelectorAll('.plot canvas[role=img]').length > 0");
    page.wait("[...document.querySelectorAll('.plot canvas[role=img]')].every(c => / to .* at the end/.test(c.getAttribute('aria-label')))");
    page
}

#[test]
fn a_dragged_parameter_changes_the_limit_cycle() {
    let panel = Panel::open(&[STICK_SLIP]);
    let page = open(&panel);
    assert_eq!(page.text("document.getElementById('title').textContent"), "stick_slip");
    page.wait("document.querySelectorAll('#judged .yes').length === 2");
    // The key has left the address bar.
    assert_eq!(page.text("location.href"), format!("{}/", panel.origin()));
    page.shot("what-if-light");

    let (before, first) = (summary(&page, 0), field(&page, "fr.Fs"));
    assert!(first.ends_with(" N"), "{first}");
    let [x, y, width, _] = page.place(&slider("fr.Fs"));
    page.mouse("mousePressed", x, y, 1);
    // Under the hand, before the release.
    (1..=8).for_each(|i| page.mouse("mouseMoved", x + 0.02 * f64::from(i) * width, y, 1));
    // Where a run is short, the picture changes before the release (see the next test for how soon). On a machine that is
    // too busy for that, the release makes the run.
    let changed = format!("document.querySelector('.plot canvas[role=img]').getAttribute('aria-label') !== {before:?}");
    let begun = Instant::now();
    while page.value(&changed) != true && begun.elapsed() < Duration::from_secs(5) {
        std::thread::sleep(Duration::from_millis(50));
    }
    page.mouse("mouseReleased", x + 0.16 * width, y, 0);
    page.wait(&changed);
    page.wait("document.getElementById('set').value.includes('fr.Fs = ')");
    assert_ne!(field(&page, "fr.Fs"), first);
    page.wait("document.querySelectorAll('#judged .no').length > 0");
    page.shot("what-if-dragged");

    // The text is what `fric run` takes: it gives the same verdicts.
    let set = page.text("document.getElementById('set').value");
    let value = set.strip_prefix("--set '").and_then(|set| set.strip_suffix('\'')).expect("one option");
    let output =
        fric().args(["run", STICK_SLIP, "stick_slip", "--json", "--no-error", "--set", value]).output().unwrap();
    let ran: serde_json::Value = serde_json::from_slice(&output.stdout).expect("one object");
    let verdicts: Vec<bool> =
        ran["expects"].as_array().unwrap().iter().map(|one| one["holds"].as_bool().unwrap()).collect();
    let shown = page.value("[...document.querySelectorAll('#judged li')].map(li => li.className === 'yes')");
    assert_eq!(serde_json::json!(verdicts), shown);

    // Kept as A, changed, back to A, and undone.
    page.value("[...document.querySelectorAll('#kept button')][0].click()");
    page.wait("[...document.querySelectorAll('#kept button')].some(b => b.textContent === 'to A')");
    let kept = field(&page, "fr.Fs");
    page.click(&slider("fr.Fs"));
    page.key("ArrowRight");
    page.wait(&format!("![...document.querySelectorAll('.knob input')].some(i => i.value === {kept:?})"));
    page.wait("document.querySelectorAll('#legend span').length === 2");
    page.shot("what-if-kept");
    page.value("[...document.querySelectorAll('#kept button')].find(b => b.textContent === 'to A').click()");
    page.wait(&format!("[...document.querySelectorAll('.knob input')].some(i => i.value === {kept:?})"));
    page.click("#text");
    page.wait(&format!("[...document.querySelectorAll('.knob input')].some(i => i.value === {first:?})"));
    page.wait("document.getElementById('set').value === 'nothing is changed'");
    page.click("#undo");
    page.wait(&format!("[...document.querySelectorAll('.knob input')].some(i => i.value === {kept:?})"));

    // Typed in another unit; and a value that the text refuses changes nothing.
    let row = "[...document.querySelectorAll('.knob')].find(k => k.querySelector('b').textContent === 'fr.Fs')";
    let typed = |text: &str| {
        page.value(&format!("(() => {{ const f = {row}.querySelector('input'); f.focus(); f.select(); }})()"));
        page.typed(text);
        page.key("Enter");
    };
    typed("1700 mN");
    page.wait("document.getElementById('set').value.includes('1.7 N')");
    for (wrong, why) in [("-1 N", "fr.Fs"), ("3 s", "not"), ("<img src=x>", "does not begin with a number")] {
        typed(wrong);
        page.wait(&format!("!{row}.querySelector('.refused').hidden && {row}.textContent.includes({why:?})"));
        assert!(page.text("document.getElementById('set').value").contains("1.7 N"), "{wrong}");
    }
    page.shot("what-if-refused");

    assert_eq!(page.complaints(), [""; 0]);
    let own = page.requests().into_iter().filter(|url| {
        !url.starts_with(panel.origin())
            && !url.starts_with(&panel.origin().replace("http", "ws"))
            && !url.starts_with("data:")
    });
    assert_eq!(own.collect::<Vec<_>>(), [""; 0]);
}

/// Prints how long it takes from a touch to the picture, and what that is made of. The bound is loose: other tests run beside this one.
#[test]
fn a_touch_is_a_picture_soon() {
    let panel = Panel::open(&[STICK_SLIP, "stick_slip"]);
    let page = open(&panel);
    page.value(&format!("document.querySelector({:?}).scrollIntoView()", slider("fr.Fs")));
    // A touch; then frame by frame until the picture of the first canvas differs.
    let times = page.value(&format!(
        "(async () => {{
            const slider = document.querySelector({:?}), canvas = document.querySelector('.plot canvas[role=img]'), times = [];
            const picture = () => {{
                const d = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
                let h = 0;
                for (let i = 3; i < d.length; i += 4) h = (h * 31 + d[i]) | 0;
                return h;
            }};
            let sent = 0, came = 0, socket = null;
            const send = WebSocket.prototype.send;
            WebSocket.prototype.send = function (line) {{
                if (this !== socket) this.addEventListener('message', e => {{ if (typeof e.data !== 'string') came ||= performance.now(); }});
                socket = this;
                if (line.includes('set ')) sent = performance.now();
                send.call(this, line);
            }};
            for (let i = 0; i < 21; i++) {{
                came = 0;
                const before = picture(), begun = performance.now();
                slider.value = String(Number(slider.value) + 40);
                slider.dispatchEvent(new Event('input', {{ bubbles: true }}));
                slider.dispatchEvent(new Event('change', {{ bubbles: true }}));
                while (picture() === before && performance.now() - begun < 2000) await new Promise(requestAnimationFrame);
                const drawn = performance.now(), words = document.getElementById('sentence').textContent;
                times.push([drawn - begun, sent - begun, came - sent, drawn - came, parseFloat((/([0-9.]+) ms/.exec(words) ?? [])[1])]);
                await new Promise(done => setTimeout(done, 50));
            }}
            return times;
        }})()",
        slider("fr.Fs")
    ));
    let sorted = |part: usize| {
        let all = times.as_array().unwrap().iter().map(|one| one[part].as_f64().unwrap_or(f64::NAN));
        let mut all: Vec<f64> = all.collect();
        all.sort_by(f64::total_cmp);
        all
    };
    let whole = sorted(0);
    println!(
        "from a touch to the picture: median {:.0} ms, {:.0} to {:.0} ms; medians: to the line {:.1}, to the frame {:.1} \
         (the run {:.1} of it), to the picture {:.1} ms",
        whole[10],
        whole[0],
        whole[20],
        sorted(1)[10],
        sorted(2)[10],
        sorted(4)[10],
        sorted(3)[10]
    );
    assert!(whole[10] < 2000.0, "{whole:?}");
}

#[test]
fn a_saved_text_is_read_again_and_changed_parameters_stay() {
    let folder = folder("reload");
    let file = folder.join("decay.fric");
    let text = |more: &str| {
        format!(
            "model Decay {{\n  param T = 1 s in > 0\n  param b = 0.5 in 0 .. 1\n{more}  state x = 1\n  dx/dt = -x / T\n  output y = b * x\n}}\n\n\
             experiment fall {{\n  run Decay() for 3 s\n  plot x, y\n  expect final(y) < 0.1\n}}\n"
        )
    };
    fs::write(&file, text("")).unwrap();
    let panel = Panel::open(&[file.to_str().unwrap()]);
    let page = open(&panel);
    page.click(&slider("b"));
    page.key("ArrowRight");
    page.wait("document.getElementById('set').value.includes('b = 0.505')");
    fs::write(&file, text("  param extra = 2\n")).unwrap();
    page.wait("document.querySelectorAll('.knob').length === 3");
    assert!(page.text("document.getElementById('set').value").contains("b = 0.505"));
    // A mistake is shown with its position, and the last picture stays.
    fs::write(&file, text("  oops\n")).unwrap();
    page.wait("!document.getElementById('problem').hidden");
    assert!(page.text("document.getElementById('problem').textContent").contains(":4:"));
    assert_eq!(page.value("document.querySelectorAll('.knob').length"), 3);
    page.shot("what-if-mistake");
    fs::write(&file, text("")).unwrap();
    page.wait("document.getElementById('problem').hidden && document.querySelectorAll('.knob').length === 2");
    // The window of time: zoomed, moved, back.
    page.value("document.activeElement.blur()");
    page.key("+");
    page.wait("/0.75 s to 2.25 s/.test(document.querySelector('.plot canvas[role=img]').getAttribute('aria-label'))");
    page.key("ArrowRight");
    page.wait("/1.05 s to 2.55 s/.test(document.querySelector('.plot canvas[role=img]').getAttribute('aria-label'))");
    page.key("Home");
    page.wait("/0 s to 3 s/.test(document.querySelector('.plot canvas[role=img]').getAttribute('aria-label'))");
    // The panel ends: the page says so.
    drop(panel);
    page.wait("document.getElementById('sentence').textContent.startsWith('not connected')");
}

#[test]
fn other_experiments_and_several_models_are_a_press_away() {
    let folder = folder("models");
    let file = folder.join("three.fric");
    let example = crate::root().join(STICK_SLIP);
    let text = format!(
        "import std.friction\nimport {:?}\n\nexperiment three {{\n  run Pull() for 20 s\n  sweep fr = LuGre(), Karnopp(), Dahl()\n  plot x [m]\n  plot v [m/s]\n  plot fr.F [N] against v [m/s]\n}}\n\n\
         experiment one {{\n  run Pull() for 5 s\n  plot x [m]\n}}\n",
        example.to_str().unwrap()
    );
    fs::write(&file, text).unwrap();
    let panel = Panel::open(&[file.to_str().unwrap()]);
    let page = open(&panel);
    page.wait("document.querySelector('.names').children.length === 3");
    page.shot("what-if-three-models");
    page.value("[...document.querySelectorAll('#choices button')][1].click()");
    page.wait(
        "document.getElementById('title').textContent === 'one' && document.querySelectorAll('.plot').length === 1",
    );
    page.wait("/0 s to 5 s/.test(document.querySelector('.plot canvas[role=img]').getAttribute('aria-label'))");
    assert_eq!(page.complaints(), [""; 0]);
}

/// Random pieces of a curve that grows, some of which overlap the ones before or leave a gap: the whole has each column as
/// it came last, none before the window is missing, and nothing stands after a piece.
///
/// Mutants tried: a store that is never made larger; a piece that is put after the columns that it replaces.
#[test]
fn newer_columns_join_the_older_ones() {
    let panel = Panel::open(&[STICK_SLIP, "stick_slip"]);
    let page = open(&panel);
    let wrong = page.value(
        r"import('./link.js').then(({ joined }) => {
            for (let seed = 1; seed <= 300; seed++) {
                let s = BigInt(seed);
                const below = n => { s = (s * 6364136223846793005n + 1442695040888963407n) & ((1n << 64n) - 1n); return Number((s >> 33n) % BigInt(n)); };
                const first = below(50);
                let wanted = new Map(), curve, end = first, from = 0;
                for (let step = 0; step < 60; step++) {
                    const start = step ? Math.max(first, end - below(3)) + (below(20) === 0 ? 5 : 0) : first, count = 1 + below(6);
                    const fresh = { view: 0, curve: 0, cycles: 10, first: start, x: new Float64Array(2 * count), y: new Float64Array(2 * count) };
                    for (let i = 0; i < 2 * count; i++) { fresh.x[i] = 10 * (start + i / 2); fresh.y[i] = below(1000); }
                    from = Math.max(from, 10 * (start - 30));
                    // What does not touch begins anew.
                    if (start > end || curve && start <= curve.first) wanted = new Map();
                    curve = joined(curve, fresh, from);
                    for (let i = 0; i < 2 * count; i++) wanted.set(2 * start + i, fresh.y[i]);
                    for (const k of [...wanted.keys()]) if (k >= 2 * (start + count)) wanted.delete(k);
                    end = start + count;
                    const about = `seed ${seed}, step ${step}`;
                    for (let i = 0; i < curve.x.length; i++) {
                        const k = 2 * curve.first + i;
                        if (wanted.get(k) !== curve.y[i] || curve.x[i] !== 5 * k) return `${about}: place ${k} has ${curve.y[i]}`;
                    }
                    if (curve.first + curve.x.length / 2 !== end) return `${about}: it ends at another column`;
                    if ([...wanted.keys()].filter(k => 5 * k >= from).length > curve.x.filter(x => x >= from).length) return `${about}: a column is missing`;
                }
            }
            return '';
        })",
    );
    assert_eq!(wrong, "");
}

#[test]
fn another_model_stands_in_a_slot_by_one_press() {
    let panel = Panel::open(&[STICK_SLIP, "stick_slip"]);
    let page = open(&panel);
    let all = "[...document.querySelectorAll('#models button')]";
    let press = |model: &str| {
        page.value(&format!("{all}.find(b => b.textContent === '{model}').click()"));
        page.wait(&format!(
            "{all}.filter(b => b.getAttribute('aria-pressed') === 'true').map(b => b.textContent).join() === '{model}'"
        ));
        page.wait("[...document.querySelectorAll('#times .plot canvas[role=img]')].every(c => / to .* at the end/.test(c.getAttribute('aria-label')))");
    };
    page.wait(&format!("{all}.length > 5"));
    let models = page.value(&format!("{all}.map(b => b.textContent)"));
    for model in ["LuGre", "Karnopp", "Dahl"] {
        assert!(models.as_array().unwrap().iter().any(|one| one == model), "{models}");
    }
    let set = || page.text("document.getElementById('set').value");
    assert_eq!(
        page.value(&format!("{all}.filter(b => b.getAttribute('aria-pressed') === 'true').length")),
        serde_json::json!(1)
    );
    press("LuGre");
    let before = summary(&page, 1);
    press("Karnopp");
    assert_eq!(set(), "--set 'fr = Karnopp()'");
    // The run with the model of the text lies behind, in grey, and the numbers are those of `fric run`.
    page.wait("document.getElementById('legend').textContent.includes('as the text')");
    assert_ne!(summary(&page, 1), before);
    let output = fric()
        .args(["run", STICK_SLIP, "stick_slip", "--json", "--no-error", "--set", "fr = Karnopp()"])
        .output()
        .unwrap();
    let ran: serde_json::Value = serde_json::from_slice(&output.stdout).expect("one object");
    let verdicts: Vec<bool> =
        ran["expects"].as_array().unwrap().iter().map(|one| one["holds"].as_bool().unwrap()).collect();
    let shown = page.value("[...document.querySelectorAll('#judged li')].map(li => li.className === 'yes')");
    assert_eq!(serde_json::json!(verdicts), shown);
    page.shot("what-if-other-model");
    // Kept as A, another model, and back with it.
    page.value("[...document.querySelectorAll('#kept button')][0].click()");
    page.wait("[...document.querySelectorAll('#kept button')].some(b => b.textContent === 'to A')");
    press("Dahl");
    page.wait("document.getElementById('legend').textContent.includes('A')");
    page.value("[...document.querySelectorAll('#kept button')].find(b => b.textContent === 'to A').click()");
    page.wait("document.getElementById('set').value === \"--set 'fr = Karnopp()'\"");
    page.value("document.getElementById('text').click()");
    page.wait("document.getElementById('set').value === 'nothing is changed'");
    page.wait(&format!(
        "document.querySelectorAll('.plot canvas[role=img]')[1].getAttribute('aria-label') === {before:?}"
    ));
    assert_eq!(page.complaints(), [""; 0]);
}
