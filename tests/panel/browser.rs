//! A headless Chromium from Debian's packages, spoken to through two pipes: messages are JSON, each ended by a zero
//! byte. One browser for all tests but those that kill theirs, a page for each.

use crate::debian;
use ct_codecs::{Base64, Decoder};
use serde_json::{Value, json};
use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

/// Time for anything that a browser does, on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);

pub struct Browser {
    to: Mutex<File>,
    next: AtomicU64,
    heard: Arc<Heard>,
    child: Mutex<Child>,
}

/// What a browser has said.
#[derive(Default)]
struct Heard {
    waiting: Mutex<HashMap<u64, Sender<Value>>>,
    events: Mutex<HashMap<String, Vec<Value>>>,
}

/// A folder with every library of the packages, for LD_LIBRARY_PATH.
fn libraries(folder: &Path, found: &mut Vec<PathBuf>) {
    let mut own = false;
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() && !path.is_symlink() {
            libraries(&path, found);
        }
        own |= path.file_name().is_some_and(|name| name.to_string_lossy().contains(".so"));
    }
    if own {
        found.push(folder.to_path_buf());
    }
}

/// A folder for a browser of this run. Those of runs that have ended go.
fn own_folder() -> PathBuf {
    static ALL: OnceLock<PathBuf> = OnceLock::new();
    static NUMBER: AtomicU64 = AtomicU64::new(0);
    let own = ALL.get_or_init(folder_of_run).join(NUMBER.fetch_add(1, Ordering::Relaxed).to_string());
    fs::create_dir_all(&own).expect("a temporary folder");
    own
}

fn folder_of_run() -> PathBuf {
    let all = std::env::temp_dir();
    for entry in fs::read_dir(&all).expect("a temporary folder").flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let run = name.strip_prefix("fric-browser-").and_then(|run| run.parse::<u32>().ok());
        if run.is_some_and(|run| !Path::new(&format!("/proc/{run}")).exists()) {
            let _ = fs::remove_dir_all(entry.path());
        }
    }
    let own = all.join(format!("fric-browser-{}", std::process::id()));
    let _ = fs::remove_dir_all(&own);
    fs::create_dir_all(&own).expect("a temporary folder");
    own
}

/// A browser of its own.
pub fn start() -> Browser {
    const WANTED: &str = "the page of the panel is tested in Chromium";
    let (program, paths) = match debian::on_path("chromium-headless-shell") {
        Some(program) => (program, Vec::new()),
        None => {
            let folder = debian::unpacked_with_dependencies("chromium", "chromium-headless-shell", WANTED);
            let mut paths = Vec::new();
            libraries(&folder, &mut paths);
            (folder.join("usr/lib/chromium/chromium-headless-shell"), paths)
        }
    };
    let here = own_folder();
    let (to, from) = (here.join("to"), here.join("from"));
    debian::done(Command::new("mkfifo").args([&to, &from]), "mkfifo");
    let libraries = std::env::join_paths(paths).expect("paths without colons");
    let child = Command::new("sh")
        .args(["-c", r#"exec "$@" 3<"$0/to" 4>"$0/from""#])
        .arg(&here)
        .arg(program)
        .args(["--no-sandbox", "--remote-debugging-pipe", "--disable-gpu", "--force-color-profile=srgb"])
        .args(["--host-resolver-rules=MAP *.test 127.0.0.1", "--hide-scrollbars"])
        .arg(format!("--user-data-dir={}", here.join("profile").display()))
        .arg("about:blank")
        .env("LD_LIBRARY_PATH", libraries)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("sh starts");
    // In the order in which the shell opens them. It ends when its pipe ends, with this process.
    let to = fs::OpenOptions::new().write(true).open(to).expect("the pipe opens");
    let mut from = File::open(from).expect("the pipe opens");
    let heard = Arc::new(Heard::default());
    let hears = heard.clone();
    std::thread::spawn(move || {
        let (mut bytes, mut piece) = (Vec::new(), vec![0; 1 << 16]);
        while let Ok(n) = from.read(&mut piece) {
            if n == 0 {
                break;
            }
            bytes.extend_from_slice(&piece[..n]);
            while let Some(end) = bytes.iter().position(|byte| *byte == 0) {
                let message: Vec<u8> = bytes.drain(..=end).collect();
                let message: Value = serde_json::from_slice(&message[..end]).expect("JSON");
                hears.take(message);
            }
        }
    });
    Browser { to: Mutex::new(to), next: AtomicU64::new(1), heard, child: Mutex::new(child) }
}

pub fn browser() -> &'static Browser {
    static ONE: OnceLock<Browser> = OnceLock::new();
    ONE.get_or_init(start)
}

impl Heard {
    fn take(&self, message: Value) {
        if let Some(id) = message["id"].as_u64() {
            if let Some(waiting) = self.waiting.lock().unwrap().remove(&id) {
                let _ = waiting.send(message);
            }
        } else if let Some(session) = message["sessionId"].as_str() {
            self.events.lock().unwrap().entry(session.into()).or_default().push(message);
        }
    }
}

impl Browser {
    /// Its process.
    pub fn pid(&self) -> u32 {
        self.child.lock().unwrap().id()
    }

    /// Kills it.
    pub fn kill(&self) {
        let mut child = self.child.lock().unwrap();
        child.kill().and_then(|()| child.wait()).expect("it is ours");
    }

    fn call(&self, session: Option<&str>, method: &str, params: Value) -> Value {
        let id = self.next.fetch_add(1, Ordering::Relaxed);
        let (sender, receiver): (_, Receiver<Value>) = channel();
        self.heard.waiting.lock().unwrap().insert(id, sender);
        let mut message = json!({ "id": id, "method": method, "params": params });
        if let Some(session) = session {
            message["sessionId"] = json!(session);
        }
        let mut bytes = message.to_string().into_bytes();
        bytes.push(0);
        self.to.lock().unwrap().write_all(&bytes).expect("the browser listens");
        let answer = receiver.recv_timeout(PATIENCE).unwrap_or_else(|_| panic!("no answer to {method}"));
        assert!(answer.get("error").is_none(), "{method}: {answer}");
        answer["result"].clone()
    }

    /// A page of its own, with storage of its own.
    pub fn page(&'static self, url: &str) -> Page {
        let context = self.call(None, "Target.createBrowserContext", json!({}))["browserContextId"].clone();
        let blank = json!({ "url": "about:blank", "browserContextId": context, "width": 1400, "height": 900 });
        let target = self.call(None, "Target.createTarget", blank)["targetId"].as_str().expect("an id").to_string();
        let attached = self.call(None, "Target.attachToTarget", json!({ "targetId": target, "flatten": true }));
        let page = Page { browser: self, target, session: attached["sessionId"].as_str().expect("an id").into() };
        for domain in ["Page", "Runtime", "Network", "Log", "DOM", "Accessibility"] {
            page.call(&format!("{domain}.enable"), json!({}));
        }
        page.size(1400, 900);
        page.go(url);
        page
    }
}

pub struct Page {
    browser: &'static Browser,
    target: String,
    session: String,
}

impl Drop for Page {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            self.browser.call(None, "Target.closeTarget", json!({ "targetId": self.target }));
        }
    }
}

impl Page {
    pub fn call(&self, method: &str, params: Value) -> Value {
        self.browser.call(Some(&self.session), method, params)
    }

    pub fn go(&self, url: &str) {
        self.call("Page.navigate", json!({ "url": url }));
    }

    pub fn size(&self, width: u32, height: u32) {
        let mobile = width < 500;
        let size = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile });
        self.call("Emulation.setDeviceMetricsOverride", size);
    }

    pub fn media(&self, name: &str, value: &str) {
        let features = json!({ "features": [{ "name": name, "value": value }] });
        self.call("Emulation.setEmulatedMedia", features);
    }

    /// The value of an expression in the page; promises are awaited.
    pub fn value(&self, expression: &str) -> Value {
        let params = json!({ "expression": expression, "awaitPromise": true, "returnByValue": true });
        let result = self.call("Runtime.evaluate", params);
        assert!(result.get("exceptionDetails").is_none(), "{expression}: {result}");
        result["result"]["value"].clone()
    }

    pub fn text(&self, expression: &str) -> String {
        let value = self.value(expression);
        value.as_str().unwrap_or_else(|| panic!("{expression} is {value}")).into()
    }

    /// Waits until an expression is true.
    #[track_caller]
    pub fn wait(&self, expression: &str) {
        let begun = Instant::now();
        while self.value(&format!("!!({expression})")) != json!(true) {
            if begun.elapsed() > PATIENCE {
                self.shot("failed");
                panic!("{expression} does not come true; {:?}", self.complaints());
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Does what an operator does, until it has an effect. On a busy machine the picture may be too old for a command,
    /// which is refused then: an operator gives it again.
    #[track_caller]
    pub fn again(&self, act: &dyn Fn(), effect: &str) {
        for _ in 0..20 {
            act();
            let begun = Instant::now();
            while begun.elapsed() < Duration::from_secs(3) {
                if self.value(&format!("!!({effect})")) == true {
                    return;
                }
                std::thread::sleep(Duration::from_millis(50));
            }
        }
        self.wait(effect);
    }

    fn events(&self, method: &str) -> Vec<Value> {
        let events = self.browser.heard.events.lock().unwrap();
        let own = events.get(&self.session).into_iter().flatten();
        own.filter(|event| event["method"] == method).map(|event| event["params"].clone()).collect()
    }

    /// Errors and warnings on the console, and exceptions.
    pub fn complaints(&self) -> Vec<String> {
        let thrown = self.events("Runtime.exceptionThrown").into_iter().map(|event| event.to_string());
        let logged = self.events("Log.entryAdded").into_iter().map(|event| event["entry"]["text"].to_string());
        let called = self.events("Runtime.consoleAPICalled").into_iter().map(|event| event["args"].to_string());
        thrown.chain(logged).chain(called).collect()
    }

    /// Addresses of all requests and sockets.
    pub fn requests(&self) -> Vec<String> {
        let of = |value: &Value| value.as_str().unwrap_or_default().to_string();
        let requests = self.events("Network.requestWillBeSent");
        let sockets = self.events("Network.webSocketCreated");
        let requests = requests.iter().map(|event| of(&event["request"]["url"]));
        requests.chain(sockets.iter().map(|event| of(&event["url"]))).collect()
    }

    pub fn mouse(&self, kind: &str, x: f64, y: f64, buttons: u32) {
        let button = if buttons > 0 || kind == "mouseReleased" { "left" } else { "none" };
        let event = json!({ "type": kind, "x": x, "y": y, "button": button, "buttons": buttons, "clickCount": 1 });
        self.call("Input.dispatchMouseEvent", event);
    }

    /// Centre and size of an element.
    pub fn place(&self, selector: &str) -> [f64; 4] {
        let found = self.value(&format!(
            "(() => {{ const e = document.querySelector({selector:?}); e.scrollIntoView({{ block: 'center' }}); \
             const b = e.getBoundingClientRect(); return [b.x + b.width / 2, b.y + b.height / 2, b.width, b.height]; }})()"
        ));
        std::array::from_fn(|i| found[i].as_f64().expect("a number"))
    }

    pub fn click(&self, selector: &str) {
        let [x, y, ..] = self.place(selector);
        self.mouse("mousePressed", x, y, 1);
        self.mouse("mouseReleased", x, y, 0);
    }

    /// Presses a key: `Tab`, `ArrowRight`, `t`.
    pub fn key(&self, key: &str) {
        let code = match key {
            "Tab" => 9,
            "Enter" => 13,
            "Escape" => 27,
            "Home" => 36,
            "ArrowLeft" => 37,
            "ArrowUp" => 38,
            "ArrowRight" => 39,
            "ArrowDown" => 40,
            other => u32::from(other.to_uppercase().bytes().next().unwrap_or(0)),
        };
        let text = match key {
            "Enter" => "\r",
            key if key.chars().count() == 1 => key,
            _ => "",
        };
        let down = if text.is_empty() { "rawKeyDown" } else { "keyDown" };
        for kind in [down, "keyUp"] {
            let text = if kind == "keyUp" { "" } else { text };
            self.call(
                "Input.dispatchKeyEvent",
                json!({ "type": kind, "key": key, "code": key, "windowsVirtualKeyCode": code, "text": text }),
            );
        }
    }

    pub fn typed(&self, text: &str) {
        self.call("Input.insertText", json!({ "text": text }));
    }

    /// Leaves a picture in target/panel/.
    pub fn shot(&self, name: &str) {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().expect("target").join("panel");
        fs::create_dir_all(&folder).expect("target can be written");
        let whole = json!({ "format": "png", "captureBeyondViewport": false });
        let data = self.call("Page.captureScreenshot", whole)["data"].as_str().expect("a picture").to_string();
        let bytes = Base64::decode_to_vec(data, None).expect("base64");
        fs::write(folder.join(format!("{name}.png")), bytes).expect("target can be written");
    }
}
