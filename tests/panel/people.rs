//! The page for everybody: keyboard alone, screen readers, contrast, small and dark screens, reports.

use crate::browser::{Page, browser};
use crate::operated::{Rig, replayed, sentence};
use crate::what_if::open;
use crate::{Panel, STICK_SLIP, folder, fric};
use serde_json::{Value, json};

#[test]
fn everything_can_be_done_with_the_keyboard_alone() {
    let panel = Panel::open(&[STICK_SLIP]);
    let page = open(&panel);
    every_control_is_reached(&page);
    // A slider by arrows: ten positions, with Shift one.
    page.value("document.querySelector('input[type=range]').focus()");
    let at = || page.value("Number(document.querySelector('input[type=range]').value)").as_f64().unwrap();
    let begin = at();
    page.key("ArrowRight");
    page.wait("document.getElementById('set').value.startsWith('--set')");
    assert_eq!(at(), begin + 10.0);
    let told = page.text("document.querySelector('input[type=range]').getAttribute('aria-valuetext')");
    assert!(told.contains(' '), "{told}");
    page.key("t");
    page.wait("document.querySelectorAll('#table td').length > 40");
    page.key("u");
    page.wait("document.getElementById('set').value === 'nothing is changed'");
    // Cursors are sliders too.
    page.key("c");
    page.wait("document.querySelectorAll('#cursors tbody tr').length === 5");
    let between = || page.text("document.querySelector('#cursors th').textContent");
    assert!(between().starts_with("13.333 s to 26.667 s: Δt 13.333 s"), "{}", between());
    page.value("document.querySelector('#cursors input').focus()");
    page.key("ArrowRight");
    page.wait("document.querySelector('#cursors th').textContent.startsWith('13.36 s')");
}

/// The focus before the first control.
fn to_the_top(page: &Page) {
    page.value("(() => { const e = document.getElementById('title'); e.tabIndex = -1; e.focus(); e.removeAttribute('tabindex'); })()");
}

/// Tab reaches every control, in the order of the page, and each shows that it has the focus.
fn every_control_is_reached(page: &Page) {
    to_the_top(page);
    let controls = page
        .value("[...document.querySelectorAll('button:not(:disabled), input')].filter(e => e.checkVisibility()).length")
        .as_u64()
        .unwrap();
    let mut seen = Vec::new();
    for _ in 0..controls + 8 {
        page.key("Tab");
        let here = page.value(
            "(() => { const e = document.activeElement, s = getComputedStyle(e); \
             return e === document.body ? null : [[...document.querySelectorAll('*')].indexOf(e), e.tagName, s.outlineStyle]; })()",
        );
        // After the last one the focus leaves the page, or begins anew.
        if here.is_null() || seen.first().is_some_and(|first| here[0] == *first) {
            break;
        }
        assert_ne!(here[2], "none", "{here}");
        seen.push(here[0].as_u64().unwrap());
    }
    assert!(seen.is_sorted(), "the order of Tab is that of the page: {seen:?}");
    assert!(seen.len() as u64 >= controls, "{} of {controls}", seen.len());
}

#[test]
fn every_control_has_a_name() {
    let panel = Panel::open(&[STICK_SLIP]);
    let page = open(&panel);
    let roles = names(&page);
    for role in ["button", "slider", "textbox"] {
        assert!(roles.iter().filter(|one| *one == role).count() >= 5, "{role}: {roles:?}");
    }
    assert!(roles.iter().any(|role| role.starts_with("im")), "{roles:?}");
}

/// The roles of what is on the page, each of which has a name.
fn names(page: &Page) -> Vec<String> {
    let tree = page.call("Accessibility.getFullAXTree", json!({}));
    let of = |node: &Value, name: &str| node[name]["value"].as_str().unwrap_or_default().to_string();
    let mut roles = Vec::new();
    for node in tree["nodes"].as_array().unwrap().iter().filter(|node| node["ignored"] != json!(true)) {
        let (role, name) = (of(node, "role"), of(node, "name"));
        if [
            "button", "slider", "textbox", "checkbox", "img", "image", "heading", "toolbar", "group", "combobox",
            "meter",
        ]
        .contains(&role.as_str())
        {
            assert!(!name.trim().is_empty(), "{role} without a name: {node}");
            roles.push(role);
        }
    }
    roles
}

/// Texts whose contrast with what is under them is less than 4.5, or 3 for large ones (WCAG 2.2, 1.4.3), and curves with
/// less than 3 (1.4.11).
fn faint(page: &Page) -> Value {
    page.value(
        r"(() => {
            const parse = c => { const m = c.match(/[\d.]+/g).map(Number); return m.length < 4 ? [...m, 1] : m; };
            const probe = document.createElement('canvas').getContext('2d', { willReadFrequently: true });
            const rgb = c => { probe.clearRect(0, 0, 1, 1); probe.fillStyle = c; probe.fillRect(0, 0, 1, 1); return [...probe.getImageData(0, 0, 1, 1).data]; };
            const light = c => { const [r, g, b] = c.slice(0, 3).map(v => v / 255).map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4); return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
            const contrast = (a, b) => { const [x, y] = [light(a), light(b)].sort((p, q) => q - p); return (x + 0.05) / (y + 0.05); };
            const under = e => { for (; e; e = e.parentElement) { const c = parse(getComputedStyle(e).backgroundColor); if (c[3] === 1) return c; } return [255, 255, 255, 1]; };
            const bad = [];
            const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
            let n = 0;
            while (walk.nextNode()) {
                const e = walk.currentNode.parentElement, s = getComputedStyle(e);
                if (!walk.currentNode.data.trim() || e.closest('script') || !e.checkVisibility() || e.closest('button:disabled')) continue;
                n++;
                const c = contrast(parse(s.color), under(e)), size = parseFloat(s.fontSize);
                if (c < (size >= 24 || size >= 18.66 && s.fontWeight >= 700 ? 3 : 4.5)) bad.push([walk.currentNode.data, c]);
            }
            const root = getComputedStyle(document.documentElement);
            for (const name of ['--c0', '--c1', '--c2', '--c3', '--ghost', '--good', '--warning', '--bad']) {
                for (const ground of ['--card', '--ground']) {
                    const c = contrast(rgb(root.getPropertyValue(name)), rgb(root.getPropertyValue(ground)));
                    if (c < 3) bad.push([name, ground, c]);
                }
            }
            if (n < 30) bad.push(['only', n, 'texts']);
            return bad;
        })()",
    )
}

#[test]
fn contrast_is_enough_in_light_and_dark() {
    let panel = Panel::open(&[STICK_SLIP]);
    let page = open(&panel);
    for scheme in ["light", "dark"] {
        page.media("prefers-color-scheme", scheme);
        page.wait(&format!("matchMedia('(prefers-color-scheme: {scheme})').matches"));
        page.key("ArrowRight");
        assert_eq!(faint(&page), json!([]), "{scheme}");
    }
    page.value("new Promise(done => requestAnimationFrame(() => setTimeout(() => done(true), 100)))");
    page.shot("what-if-dark");
    // The measure finds what it looks for.
    page.value("document.getElementById('title').style.color = '#333638'");
    assert_ne!(faint(&page), json!([]));
}

#[test]
fn forced_colours_show_text_curves_and_what_is_pressed() {
    let panel = Panel::open(&[STICK_SLIP]);
    let page = open(&panel);
    page.media("forced-colors", "active");
    page.wait("matchMedia('(forced-colors: active)').matches");
    page.key("ArrowRight");
    page.value("new Promise(done => requestAnimationFrame(() => setTimeout(() => done(true), 200)))");
    page.shot("what-if-forced");
    assert_eq!(faint(&page), json!([]));
    // What is pressed is known by more than a colour that is no longer there.
    let widths = page.value(
        "[true, false].map(on => [...document.querySelectorAll(`button[aria-pressed=\"${on}\"]`)]
         .filter(e => e.checkVisibility()).map(e => getComputedStyle(e).borderTopWidth))",
    );
    let [pressed, others] = [&widths[0], &widths[1]].map(|all| all.as_array().expect("a list").clone());
    assert!(!others.is_empty() && others.iter().all(|width| *width == "1px"), "{widths}");
    assert!(!pressed.is_empty() && pressed.iter().all(|width| *width == "3px"), "{widths}");
}

/// Targets that are not large enough for a thumb.
fn small(page: &Page) -> Value {
    page.value(
        "[...document.querySelectorAll('button, input, select')].filter(e => e.checkVisibility()).map(e => [e.id || e.textContent || e.type, e.getBoundingClientRect()])
         .filter(([, b]) => b.height < 40 && b.height !== 24).map(([name, b]) => [name, b.height])",
    )
}

#[test]
fn a_small_screen_needs_no_sideways_scrolling() {
    let panel = Panel::open(&[STICK_SLIP]);
    let page = open(&panel);
    page.size(390, 844);
    page.wait("innerWidth === 390");
    page.value("new Promise(done => requestAnimationFrame(() => setTimeout(() => done(true), 200)))");
    page.shot("what-if-small");
    assert_eq!(page.value("document.documentElement.scrollWidth"), 390);
    assert_eq!(small(&page), json!([]));
    page.value("document.getElementById('knobs').scrollIntoView()");
    page.value("new Promise(done => requestAnimationFrame(() => setTimeout(() => done(true), 200)))");
    page.shot("what-if-small-knobs");
}

#[test]
fn a_report_needs_nothing_else() {
    let folder = folder("report");
    let report = folder.join("stick_slip.html");
    let output = fric()
        .args(["panel", STICK_SLIP, "stick_slip", "--set", "fr.Fs=1.7 N", "--save"])
        .arg(&report)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = browser().page("about:blank");
    page.call(
        "Network.emulateNetworkConditions",
        json!({ "offline": true, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0 }),
    );
    page.go(&format!("file://{}", report.display()));
    page.wait("document.querySelectorAll('.plot').length === 3");
    page.wait("/ to .* at the end/.test(document.querySelector('.plot canvas[role=img]').getAttribute('aria-label'))");
    page.wait("document.querySelectorAll('#judged li').length === 2");
    page.shot("report");
    // It zooms.
    page.key("+");
    page.wait("/10 s to 30 s/.test(document.querySelector('.plot canvas[role=img]').getAttribute('aria-label'))");
    assert_eq!(page.complaints(), [""; 0]);
    let others = page
        .requests()
        .into_iter()
        .filter(|url| !url.starts_with("file:") && !url.starts_with("data:") && url != "about:blank");
    assert_eq!(others.collect::<Vec<_>>(), [""; 0]);
}

#[test]
fn less_motion_is_four_pictures_a_second() {
    let panel = Panel::open(&[STICK_SLIP, "stick_slip"]);
    let page = open(&panel);
    page.media("prefers-reduced-motion", "reduce");
    let drawn = page.value(
        "(async () => {
            const canvas = document.querySelector('.plot canvas[role=img]'), own = canvas.getContext('2d'), slider = document.querySelector('input[type=range]');
            let drawn = 0;
            const clear = own.clearRect.bind(own);
            own.clearRect = (...all) => { drawn++; clear(...all); };
            const begun = performance.now();
            while (performance.now() - begun < 2000) {
                slider.value = String(Number(slider.value) + 3);
                slider.dispatchEvent(new Event('input', { bubbles: true }));
                await new Promise(requestAnimationFrame);
            }
            return drawn;
        })()",
    );
    let drawn = drawn.as_u64().unwrap();
    assert!((1..=10).contains(&drawn), "{drawn} pictures in 2 s");
}

#[test]
fn the_page_of_a_rig_is_for_everybody() {
    let mut rig = Rig::start("people", &[]);
    let page = browser().page(&rig.link);
    sentence(&page, "armed, the model runs");
    page.wait(
        "document.querySelectorAll('.knob').length > 5 && document.querySelectorAll('#happened button').length > 0",
    );
    page.wait("document.querySelectorAll('#drives li').length > 3 && !document.getElementById('late').hidden");
    // With everything open that can be opened.
    page.value("document.activeElement.blur()");
    page.key("t");
    page.key("c");
    page.wait("document.querySelectorAll('#table td').length > 40 && document.querySelectorAll('#cursors td button').length > 3");
    page.value("document.getElementById('triggered').click()");
    let roles = names(&page);
    for (role, least) in [("button", 10), ("slider", 8), ("textbox", 8), ("combobox", 4), ("meter", 2)] {
        assert!(roles.iter().filter(|one| *one == role).count() >= least, "{role}: {roles:?}");
    }
    // A screen reader hears the state of the rig, and faults at once.
    assert_eq!(
        page.value(
            "['sentence', 'problem', 'chair', 'taken'].map(id => document.getElementById(id).getAttribute('role'))"
        ),
        json!(["status", "alert", "status", "status"])
    );
    for scheme in ["dark", "light"] {
        page.media("prefers-color-scheme", scheme);
        page.wait(&format!("matchMedia('(prefers-color-scheme: {scheme})').matches"));
        assert_eq!(faint(&page), json!([]), "{scheme}");
    }
    page.size(390, 844);
    page.wait("innerWidth === 390");
    page.value("new Promise(done => requestAnimationFrame(() => setTimeout(() => done(true), 300)))");
    assert_eq!(page.value("document.documentElement.scrollWidth"), 390);
    assert_eq!(small(&page), json!([]));
    page.size(1400, 900);
    page.value("document.getElementById('triggered').click()");
    page.value("document.activeElement.blur()");
    page.key("t");
    page.key("c");
    // While the picture moves, Tab still reaches every control in its order.
    every_control_is_reached(&page);
    // A parameter, a mark and the stop, by keys alone.
    page.value("document.activeElement.blur()");
    let to = |selector: &str| {
        let there = format!("document.activeElement.matches({selector:?})");
        for _ in 0..60 {
            page.key("Tab");
            if page.value(&there) == json!(true) {
                return;
            }
        }
        panic!("Tab does not reach {selector}");
    };
    let path = page.text("document.querySelector('.knob b').textContent");
    let set = || {
        to_the_top(&page);
        to(".knob input[type=range]");
        page.key("ArrowRight");
        page.wait("!document.getElementById('apply').disabled");
        to("#apply");
        page.key("Enter");
    };
    page.again(&set, &format!("document.getElementById('happened').textContent.includes('{path} = ')"));
    let mark = || {
        page.value("document.activeElement.blur()");
        page.key("m");
        page.typed("by keys alone");
        page.key("Enter");
    };
    page.again(&mark, "document.getElementById('happened').textContent.includes('by keys alone')");
    page.key("Escape");
    sentence(&page, "ended as asked");
    assert_eq!(rig.code(), 0);
    replayed(&rig.log);
    // It has asked nobody else for anything.
    let origin = rig.link.split_once("/#").unwrap().0.to_string();
    let own = [format!("{origin}/"), origin.replace("http", "ws") + "/", "data:,".into()];
    let others: Vec<String> =
        page.requests().into_iter().filter(|url| !own.iter().any(|own| url.starts_with(own.as_str()))).collect();
    assert_eq!(others, [""; 0]);
    assert_eq!(page.complaints(), [""; 0]);
}
