//! A hostile page in the operator's browser, and texts that somebody else has written.

use crate::browser::browser;
use crate::what_if::open;
use crate::{Panel, STICK_SLIP, folder};
use serde_json::json;
use std::fs;
use std::io::{Read, Write};
use std::net::TcpListener;

/// A server of somebody else that answers everything with an empty page; its port.
fn elsewhere() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    std::thread::spawn(move || {
        for mut stream in listener.incoming().flatten() {
            let mut bytes = [0; 4096];
            let _ = stream.read(&mut bytes);
            let body = "<!doctype html><title>elsewhere</title><body></body>";
            let head = "HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nConnection: close\r\nContent-Length:";
            let _ = stream.write_all(format!("{head} {}\r\n\r\n{body}", body.len()).as_bytes());
        }
    });
    port
}

/// A script that tries to open a socket and to use it with a key.
fn try_socket(host: &str, key: &str) -> String {
    format!(
        "new Promise(done => {{
            const s = new WebSocket('ws://{host}/socket');
            s.onopen = () => s.send('key {key}');
            s.onmessage = () => done('told');
            s.onclose = s.onerror = () => done('closed');
        }})"
    )
}

#[test]
fn pages_of_others_get_neither_page_nor_socket() {
    let panel = Panel::open(&[STICK_SLIP, "stick_slip"]);
    let (port, key) = (panel.port(), panel.key());
    let other = elsewhere();
    let page = browser().page(&format!("http://127.0.0.1:{other}/"));
    page.wait("document.title === 'elsewhere'");
    // Another port of the same computer is another origin; the key would not help it.
    for host in [format!("127.0.0.1:{port}"), format!("localhost:{port}")] {
        assert_eq!(page.value(&try_socket(&host, key)), "closed", "{host}");
    }
    // It cannot read the page either, nor frame it.
    let read = page
        .value(&format!("fetch('http://127.0.0.1:{port}/').then(r => r.text()).then(() => 'read', () => 'refused')"));
    assert_eq!(read, "refused");
    page.value(&format!(
        "new Promise(done => {{ const f = document.createElement('iframe'); f.onload = done; f.src = 'http://127.0.0.1:{port}/'; document.body.append(f); }}).then(() => 1)"
    ));
    let framed = page.value("(() => { try { return document.querySelector('iframe').contentDocument !== null; } catch { return false; } })()");
    assert_eq!(framed, json!(false));

    // Names that lead to 127.0.0.1 (DNS rebinding): the page is not there, so no script of ours runs under them.
    for host in ["evil.test", "127.evil.test"] {
        let page = browser().page(&format!("http://{host}:{port}/"));
        page.wait("document.readyState === 'complete' && document.body");
        let text = page.text("document.body.textContent");
        assert!(text.contains("only at the address in its link"), "{host}: {text}");
        assert_eq!(page.value(&try_socket(&format!("{host}:{port}"), key)), "closed", "{host}");
        assert_eq!(page.value(&try_socket(&format!("127.0.0.1:{port}"), key)), "closed", "{host}");
    }
    // A file from the disk.
    let file = folder("hostile").join("page.html");
    fs::write(&file, "<!doctype html><title>file</title>").unwrap();
    let page = browser().page(&format!("file://{}", file.display()));
    page.wait("document.title === 'file'");
    assert_eq!(page.value(&try_socket(&format!("127.0.0.1:{port}"), key)), "closed");

    // Our own page with the wrong key, and with none.
    for link in [format!("http://127.0.0.1:{port}/#{}", "0".repeat(32)), format!("http://localhost:{port}/")] {
        let page = browser().page(&link);
        page.wait("document.getElementById('sentence')?.textContent.startsWith('this link is from an earlier start')");
        assert_eq!(page.value("document.querySelectorAll('.plot').length"), 0);
    }
    // Both names of this computer are ours.
    let page = browser().page(&format!("http://localhost:{port}/#{key}"));
    page.wait("document.querySelectorAll('.plot').length > 0");
    // A reload keeps the key; it has left the address.
    page.call("Page.reload", json!({}));
    page.wait("document.querySelectorAll('.plot').length > 0");
}

#[test]
fn texts_of_others_stay_text() {
    let folder = folder("markup");
    let file = folder.join("markup.fric");
    let text = "model Markup {\n  param T = 1 s in > 0   /// <img src=x onerror=\"window.hacked = 1\"> \u{202e}drawkcab\n  \
        state x = 1\n  dx/dt = -x / T\n}\n\nexperiment e {\n  run Markup() for 1 s\n  plot x\n  expect final(x) < 1, \"<script>window.hacked = 1</script>\"\n}\n";
    fs::write(&file, text.replace(", \"<script>window.hacked = 1</script>\"", "")).unwrap();
    let panel = Panel::open(&[file.to_str().unwrap()]);
    let page = open(&panel);
    let knob = page.text("document.querySelector('.knob').textContent");
    assert!(knob.contains("<img src=x onerror") && knob.contains("\\u{202e}drawkcab"), "{knob}");
    assert_eq!(page.value("window.hacked ?? document.querySelectorAll('img, script:not([src])').length"), 0);
    // Saved, it is text as well.
    let report = folder.join("report.html");
    let output =
        crate::fric().args(["panel", file.to_str().unwrap(), "--save", report.to_str().unwrap()]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = browser().page(&format!("file://{}", report.display()));
    page.wait("document.querySelectorAll('.plot').length > 0");
    assert_eq!(page.value("window.hacked ?? document.querySelectorAll('img').length"), 0);
}
