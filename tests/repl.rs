//! An interactive session in a pseudo-terminal: prompt, completion, plots, errors, history, Ctrl-C; and piped from a
//! script.

use std::fs::{self, File};
use std::io::{Read, Write};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

/// The longest time that anything may take on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);

/// A folder for one test, empty at its start.
fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("repl-{name}"));
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).unwrap();
    path
}

fn fric(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
    command.current_dir(folder).env("XDG_STATE_HOME", folder.join("state")).env("TERM", "xterm");
    command.env_remove("NO_COLOR");
    command
}

/// A session at a terminal of 100 columns.
struct Terminal {
    child: Child,
    keys: File,
    screen: Receiver<Vec<u8>>,
    /// All output so far, without colours and movements of the cursor.
    seen: String,
    /// Position up to which it has been read.
    at: usize,
    /// All output so far, unchanged.
    raw: String,
}

impl Terminal {
    fn new(folder: &Path, args: &[&str]) -> Terminal {
        let size = nix::pty::Winsize { ws_row: 40, ws_col: 100, ws_xpixel: 0, ws_ypixel: 0 };
        let pair = nix::pty::openpty(Some(&size), None).unwrap();
        let inner = || Stdio::from(pair.slave.try_clone().unwrap());
        let mut command = fric(folder);
        command.args(args).stdin(inner()).stdout(inner()).stderr(inner());
        // SAFETY: only system calls that are allowed between fork and exec: a new session with this terminal, so that
        // Ctrl-C reaches it.
        unsafe {
            command.pre_exec(|| {
                nix::unistd::setsid()?;
                if nix::libc::ioctl(0, nix::libc::TIOCSCTTY, 0) != 0 {
                    return Err(std::io::Error::last_os_error());
                }
                Ok(())
            });
        }
        let child = command.spawn().unwrap();
        drop(command);
        drop(pair.slave);
        let keys = File::from(pair.master);
        let mut output = keys.try_clone().unwrap();
        let (send, screen) = channel();
        std::thread::spawn(move || {
            let mut bytes = [0; 4096];
            while let Ok(n) = output.read(&mut bytes) {
                if n == 0 || send.send(bytes[..n].to_vec()).is_err() {
                    break;
                }
            }
        });
        Terminal { child, keys, screen, seen: String::new(), at: 0, raw: String::new() }
    }

    fn send(&mut self, keys: &str) {
        self.keys.write_all(keys.as_bytes()).unwrap();
    }

    /// Waits until a text appears after what was waited for before; returns the output up to it.
    #[track_caller]
    fn wait(&mut self, text: &str) -> String {
        let begun = Instant::now();
        loop {
            if let Some(found) = self.seen[self.at..].find(text) {
                let passed = self.seen[self.at..self.at + found].to_string();
                self.at += found + text.len();
                return passed;
            }
            let left = PATIENCE.saturating_sub(begun.elapsed());
            match self.screen.recv_timeout(left) {
                Ok(bytes) => {
                    self.raw += &String::from_utf8_lossy(&bytes);
                    self.seen += &plain(&String::from_utf8_lossy(&bytes));
                }
                Err(_) => panic!("`{text}` did not come; this came:\n{}", &self.seen[self.at..]),
            }
        }
    }

    /// Sends keys repeatedly until the answer appears.
    #[track_caller]
    fn send_until(&mut self, keys: &str, answer: &str) {
        let begun = Instant::now();
        while !self.seen[self.at..].contains(answer) {
            assert!(begun.elapsed() < PATIENCE, "`{answer}` did not come; this came:\n{}", &self.seen[self.at..]);
            self.send(keys);
            let sent = Instant::now();
            while sent.elapsed() < Duration::from_secs(1) && !self.seen[self.at..].contains(answer) {
                if let Ok(bytes) = self.screen.recv_timeout(Duration::from_millis(100)) {
                    self.seen += &plain(&String::from_utf8_lossy(&bytes));
                }
            }
        }
        self.wait(answer);
    }

    /// Types a line and waits for the prompt after its output.
    #[track_caller]
    fn line(&mut self, text: &str) -> String {
        self.send(&format!("{text}\r"));
        self.wait("\n");
        self.wait("fric> ")
    }

    /// Sends keys that end the program; returns the exit code. They are sent repeatedly: while an answer is being printed,
    /// the terminal's change of mode can discard them.
    fn end(mut self, keys: &str) -> Option<i32> {
        let begun = Instant::now();
        while begun.elapsed() < PATIENCE {
            let _ = self.keys.write_all(keys.as_bytes()); // Fails once the program has ended.
            let sent = Instant::now();
            while sent.elapsed() < Duration::from_secs(1) {
                if let Some(status) = self.child.try_wait().unwrap() {
                    return status.code();
                }
                std::thread::sleep(Duration::from_millis(5));
            }
        }
        panic!("it did not end; this came:\n{}", &self.seen[self.at..]);
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The text without escape sequences and carriage returns.
fn plain(text: &str) -> String {
    let mut out = String::new();
    let mut rest = text.chars().peekable();
    while let Some(c) = rest.next() {
        match c {
            '\x1b' => {
                if rest.next() == Some('[') {
                    while rest.next().is_some_and(|c| !c.is_ascii_alphabetic()) {}
                }
            }
            '\r' => {}
            c => out.push(c),
        }
    }
    out
}

#[test]
fn a_session_is_typed_completed_plotted_and_goes_on_after_errors() {
    let folder = folder("typed");
    let mut at = Terminal::new(&folder, &[]);
    at.wait("fric> ");
    assert!(at.line("10 mm * 2 N/m").contains("20 mN"));
    assert!(at.line("ans / 2").contains("10 mN"));
    let made = at.line("f = LuGre(vd = 10 mm/s)");
    assert!(made.contains("f: LuGre, 1 state, 7 parameters"), "{made}");

    // Completion: one candidate is inserted, several are listed, those with a matching unit first.
    at.send("expl\t");
    at.wait("explain");
    at.send(" f.z\r");
    at.wait("\n");
    let explained = at.wait("fric> ");
    assert!(explained.contains("dz/dt = v - sigma0 * abs(v) / g * z"), "{explained}");
    at.send("f.F + f.\t");
    at.wait("Coulomb friction");
    // After the list, the line is shown again.
    at.wait("fric> f.F + f.");
    at.send("\x03");
    at.wait("\n");
    at.wait("fric> ");

    let plot = at.line("plot f.F against f.v = -5 mm/s .. 5 mm/s steady");
    assert!(plot.contains("f.F [N]") && plot.contains("f.v [mm/s]") && plot.contains('⣀'), "{plot}");
    assert!(at.line("plot f.F against f.v = 0 mm/s .. 5 mm/s steady to stribeck.svg").contains("wrote stribeck.svg"));
    assert!(fs::read_to_string(folder.join("stribeck.svg")).unwrap().contains("f.F against f.v"));

    let wrong = at.line("f.F + 1 m/s");
    assert!(wrong.contains("E0101") && wrong.contains("cannot add a force and a velocity"), "{wrong}");
    assert!(wrong.contains("[input:1:1]") && wrong.contains("1 │ f.F + 1 m/s"), "{wrong}");
    assert!(at.line("f.Fs = 0.5 N").contains("requires Fs >= Fc"));
    assert!(at.line("f.Fs").contains("1.5 N"), "a refused setting changes nothing");
    assert!(at.line("1 N + 1 N").contains("2 N"));

    assert_eq!(at.end("\x04"), Some(0));
}

/// All lines of an input are redrawn at each key, so the test waits for answers, not prompts.
#[test]
fn an_item_is_typed_over_several_lines_or_pasted() {
    let folder = folder("lines");
    let mut at = Terminal::new(&folder, &[]);
    at.wait("fric> ");
    for line in ["model Damper {", "input v [m/s]", "output F [N] = 2 N·s/m * v", "allow creep \"a damper\"", "}"] {
        at.send(&format!("{line}\r"));
    }
    at.send("d = Damper(v = 3 m/s)\r");
    at.wait("d: Damper, 0 states, 0 parameters");
    at.send("d.F\r");
    at.wait("6 N\n");
    // An operator at the end needs its right operand.
    at.send("d.F +\r");
    at.send("1 N\r");
    at.wait("7 N\n");
    // As a terminal delivers pasted text: line ends in it do not submit.
    at.send("\x1b[200~const m = 2 kg\nm / 2\n1 N + 1 m\n5 N\x1b[201~\r");
    at.wait("1 kg\n");
    at.wait("E0101");
    at.wait("the lines behind it were not done");
    at.send("\x1b[200~model Twice {\n  input v [m/s]\n  output F [N] = 4 N·s/m * v\n\x1b[201~");
    at.send("allow creep \"a damper\"\r}\r");
    at.send("e = Twice(v = 1 m/s)\r");
    at.wait("e: Twice, 0 states, 0 parameters");
    // The history returns it as one entry.
    at.send("\x1b[A");
    at.wait("e = Twice(v = 1 m/s)");
    at.send("\x1b[A");
    at.wait("model Twice {");
    at.wait("}");
    at.send("\x03");
    at.send_until("e.F\r", "4 N\n");
    assert_eq!(at.end("\x04"), Some(0));
}

#[test]
fn words_are_coloured_and_what_comes_next_is_hinted() {
    let folder = folder("colours");
    let mut at = Terminal::new(&folder, &[]);
    at.wait("fric> ");
    at.send("f = LuGre(vd = 10 mm/s)");
    at.wait("10 mm/s)");
    for coloured in ["\x1b[36mLuGre\x1b[0m", "\x1b[33m10\x1b[0m", "\x1b[32mmm/s\x1b[0m"] {
        assert!(at.raw.contains(coloured), "{coloured:?} is not in {:?}", at.raw);
    }
    at.send("\r");
    at.wait("f: LuGre, 1 state");
    // Hints are grey and not inserted: Enter submits what was typed.
    at.send("step");
    at.wait("step 1 ms");
    assert!(at.raw.contains("\x1b[2m 1 ms\x1b[0m"), "{:?}", at.raw);
    at.send("\r");
    at.wait("a step of what length? `step 1 ms`");
    at.send("f.Fs");
    at.wait("[N] stiction");
    at.send("\r");
    at.wait("1.5 N\n");
    // A line without anything has no hint.
    at.wait("fric> ");
    at.send("1 N\r");
    at.wait("1 N\n");
    assert!(!at.raw.contains("plot EXPR"), "{:?}", at.raw);
}

#[test]
fn history_is_there_in_the_next_session() {
    let folder = folder("history");
    let mut first = Terminal::new(&folder, &[]);
    first.wait("fric> ");
    assert!(first.line("21 mm * 2").contains("42 mm"));
    assert_eq!(first.end("quit\r"), Some(0));
    let history = fs::read_to_string(folder.join("state/fric/history")).unwrap();
    assert!(history.contains("21 mm * 2"), "{history}");
    let mut second = Terminal::new(&folder, &[]);
    second.wait("fric> ");
    // Up twice, over `quit`.
    second.send("\x1b[A");
    second.wait("quit");
    second.send("\x1b[A");
    second.wait("21 mm * 2");
    second.send("\r");
    second.wait("42 mm");
}

#[test]
fn an_interrupt_stops_a_run_and_keeps_the_session() {
    let folder = folder("interrupt");
    fs::write(
        folder.join("long.fric"),
        "model Long {\n  state x [m] = 0\n  dx/dt = 1 mm/s * cos(x / 1 m)\n}\n\
         experiment long {\n  run Long() for 10000000 s\n  solver rk4 step 10 us\n}\n",
    )
    .unwrap();
    let mut at = Terminal::new(&folder, &["repl", "long.fric"]);
    at.wait("fric> ");
    at.line("7 N");
    at.send("run long\r");
    at.wait("\n");
    at.send_until("\x03", "the session goes on");
    // Input typed ahead of an interrupted prompt is lost, as in a shell.
    at.send_until("ans\r", "7 N\n");
}

/// The output of a piped script.
fn piped(folder: &Path, args: &[&str], script: &str) -> Output {
    let mut command = fric(folder);
    let mut child =
        command.args(args).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    child.stdin.take().unwrap().write_all(script.as_bytes()).unwrap();
    child.wait_with_output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// A steady curve asks only for what it shows to rest: the path travelled grows on.
///
/// Mutant tried by hand: all states must rest (refused).
#[test]
fn a_steady_curve_leaves_other_states_in_motion() {
    let folder = folder("steady");
    let law = "model Own {\n  input  v [m/s]\n  state  s [mm] = 0\n  state  z = 0\n  ds/dt = abs(v)\n  dz/dt = (1 - z) / 0.1 s\n  output F [N] = z * (1 N + 2 N * exp(-(v / 5 mm/s)^2)) * tanh(v / 1 mm/s)\n  allow creep \"smooth\"\n  allow not-dissipative \"as measured\"\n}\n";
    fs::write(folder.join("p.fric"), law).unwrap();
    let curve = |of: &str| {
        piped(&folder, &["repl", "p.fric"], &format!("f = Own()\nplot {of} against f.v = -20 mm/s .. 20 mm/s steady\n"))
    };
    let output = curve("f.F");
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert!(text(&output.stdout).contains("f.F [N]"), "{}", text(&output.stdout));
    let refused = text(&curve("f.s").stderr);
    assert!(refused.contains("`f.s` still moves"), "{refused}");
}

#[test]
fn a_script_ends_at_its_first_error_unless_told_otherwise() {
    let folder = folder("script");
    let script = "1 N + 1 m\n2 N + 2 N\n";
    let ended = piped(&folder, &["repl"], script);
    assert_eq!(ended.status.code(), Some(1));
    assert_eq!(text(&ended.stdout), "");
    assert!(text(&ended.stderr).contains("E0101"));
    let went_on = piped(&folder, &["repl", "--keep-going"], script);
    assert_eq!((went_on.status.code(), text(&went_on.stdout)), (Some(1), "4 N\n".into()));
    let fine = piped(&folder, &[], "2 N + 2 N\nquit\nnonsense");
    assert_eq!((fine.status.code(), text(&fine.stdout)), (Some(0), "4 N\n".into()));
    let missed = piped(&folder, &["repl"], "f = LuGre()\nrun f for 1 ms\nexpect max(f.F) > 1 N\n1 N\n");
    assert_eq!(missed.status.code(), Some(1));
    assert!(
        text(&missed.stdout).contains("✗ max(f.F) > 1 N") && !text(&missed.stdout).ends_with("1 N\n"),
        "{}",
        text(&missed.stdout)
    );
}

/// The first line of each error report.
#[track_caller]
fn says(script: &str, expected: &str) {
    let folder = folder("errors");
    let output = piped(&folder, &["repl", "--keep-going"], script);
    let told = text(&output.stderr);
    assert!(told.contains(expected), "{script}\n{told}\n{}", text(&output.stdout));
    assert_eq!(output.status.code(), Some(1), "{script}");
}

#[test]
fn mistakes_are_named_with_their_remedy() {
    says("run", "for how long? `run f for 2 s`");
    says("run nothing", "there is no experiment or instance `nothing`");
    says("f = LuGre()\nrun f for 2 N", "a time is needed, not a force: `run NAME for 20 s`");
    says("f = LuGre()\nrun f for 0 s", "a time greater than 0 is needed");
    says("step", "a step of what length? `step 1 ms`");
    says("step 1 ms", "there is nothing to step: `f = LuGre()` makes an instance");
    says("plot x", "nothing has been run yet");
    says("f = LuGre()\nplot f.F against f.w = 0 m/s .. 1 m/s", "there is no `f.w` here; did you mean `f.v`?");
    says("f = LuGre()\nplot f.F against f.v = 0 m .. 1 m", "`f.v` is a velocity, in m/s, and 0 m is a length");
    says("f = LuGre()\nplot f.F against f.z = 0 um .. 1 um", "`f.z` is computed: a curve goes over an input");
    says("f = LuGre()\nplot f.F against f.Fs = 0 N .. 2 N", "`f.Fs` must be above 0 N");
    says("f = LuGre()\nplot f.F against f.Fs = 0.5 N .. 2 N", "requires Fs >= Fc");
    says("f = LuGre(Fss = 1 N)", "did you mean `Fs`");
    says("f = LuGree()", "did you mean `LuGre`?");
    says("f.Fs = 1 N", "there is no `f` here to set");
    says("use \"nowhere.fric\"", "there is no such file");
    says("use std.frictoin", "did you mean `std.friction`?");
    says("explain Nothing", "there is no quantity, part, model or experiment `Nothing` here");
    says("doc Nothing", "there is no model `Nothing`");
    says("ans", "there is no `ans` yet");
    says("save try.txt", "`save try.fric`");
    says("save try.fric", "there is nothing to save yet");
    says("f = LuGre()\nplot f.F against f.v = 0 m/s .. 1 m/s to x.gif", "ends in .svg, .png or .pdf");
    says("why E9999", "there is no page about `E9999`");
    says("why chater", "did you mean chatter?");
    says("watch", "watch what?");
}

/// An experiment whose window lies after 1 s, and whose quantities have names like models.
const PULLED: &str = "import std.bench\nimport std.friction\n\nexperiment drawn {\n  run    SpringBench(k = 2 N/m, vp = 0.1 m/s, fr = LuGre()) for 3 s\n  expect max(v) < 9 m/s after 2 s\n}\n";

#[test]
fn the_last_run_can_be_queried_with_any_windows() {
    let folder = folder("asked");
    fs::write(folder.join("p.fric"), PULLED).unwrap();
    let answers = [
        ("names", "of drawn, run last: pull, x, v, F, spring, fr.v"),
        ("x", "µm\n"),
        ("x + 1 m", "m\n"),
        ("unit F", "N   a force"),
        ("fr.z", "µm"),
        ("max(v)", "m/s"),
        ("max(v) after 2 s", "m/s"),
        ("max(v after 2 s) * 2 - min(v)", "m/s"),
        ("explain F", "F: output [N]"),
        ("explain fr.z", "fr.z: state [µm]"),
        ("explain fr", "fr.sigma0"),
        ("explain drawn", "body.dx/dt"),
        ("explain SpringBench", "in this order:"),
        ("explain E0902", "## E0902"),
        ("explain chatter", "## W0705"),
        ("why chatter", "## W0705"),
        ("deps F", "F  output [N]\n  fr.F"),
        ("step 1 ms", "t = "),
    ];
    for (asked, expected) in answers {
        let output = piped(&folder, &["repl"], &format!("use \"p.fric\"\nrun drawn\n{asked}\n"));
        let shown = text(&output.stdout);
        let answer = shown.split_once("margin").map_or("", |(_, rest)| rest);
        assert!(answer.contains(expected), "{asked}: {shown}\n{}", text(&output.stderr));
        assert_eq!(output.status.code(), Some(0), "{asked}: {}", text(&output.stderr));
    }
    for (asked, expected) in [
        ("use \"p.fric\"\nnames", ""),
        ("use \"p.fric\"\nexplain F", "once it has been run, `run drawn`"),
        ("use \"p.fric\"\ndoc drawn", "`drawn` is an experiment; `explain drawn` shows what it runs"),
    ] {
        let output = piped(&folder, &["repl"], asked);
        assert!(text(&output.stderr).contains(expected), "{asked}: {}", text(&output.stderr));
        assert!(!text(&output.stdout).contains("nothing yet"), "{asked}");
    }
}

#[test]
fn a_session_is_saved_as_an_experiment_that_holds() {
    let folder = folder("saved");
    let script =
        "f = LuGre(vd = 10 mm/s)\nf.v = 2 mm/s\nf.Fs = 1.2 N\nrun f for 50 ms\nexpect max(f.F) < 2 N\nsave try.fric\n";
    let output = piped(&folder, &["repl"], script);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let saved = fs::read_to_string(folder.join("try.fric")).unwrap();
    assert!(saved.contains("import std.friction.lugre") && saved.contains("expect max(f.F) < 2 N"), "{saved}");
    assert!(saved.contains("f.Fs = 1.2 N"), "{saved}");
    let tested = fric(&folder).args(["test", "try.fric"]).output().unwrap();
    assert!(tested.status.success(), "{}", text(&tested.stderr));
    assert!(text(&tested.stdout).ends_with("1 passed, 0 failed\n"), "{}", text(&tested.stdout));
}

#[test]
fn a_saved_file_is_run_again_where_it_was() {
    let folder = folder("watch");
    let model = |rate: &str, more: &str| {
        format!(
            "model Fill {{\n  state x [m] = 0\n{more}  dx/dt = {rate}\n  output y [m] = x\n}}\n\
             experiment fill {{\n  run Fill() for 1 s\n  plot y\n  expect final(y) > 0 m\n}}\n"
        )
    };
    fs::write(folder.join("fill.fric"), model("1 m/s", "")).unwrap();
    let mut at = Terminal::new(&folder, &["watch", "fill.fric"]);
    at.wait("final(y) > 0 m");
    at.wait("1 m, margin 1 m");
    at.wait("waiting for fill.fric");
    fs::write(folder.join("fill.fric"), model("2 m/s", "")).unwrap();
    // It continues from 1 m.
    at.wait("3 m, margin 3 m");
    at.wait("waiting for fill.fric");
    fs::write(folder.join("fill.fric"), model("2 N", "")).unwrap();
    at.wait("E0101");
    fs::write(folder.join("fill.fric"), model("1 m/s", "  state w [m] = 0\n  dw/dt = 1 m/s\n")).unwrap();
    at.wait("4 m, margin 4 m");
    at.wait("anew: w");
    at.wait("waiting for fill.fric");
    assert_eq!(at.end("\x03"), Some(0));
}

/// The blocks marked `session` of a page, with their positions.
fn sessions(page: &str) -> Vec<(usize, usize)> {
    let mut found = Vec::new();
    let mut from = 0;
    while let Some(at) = page[from..].find("```session\n") {
        let begin = from + at + "```session\n".len();
        let end = begin + page[begin..].find("```").expect("a block ends");
        found.push((begin, end));
        from = end + 3;
    }
    found
}

/// The output of a session with the inputs of a block.
fn transcript(block: &str) -> String {
    let typed: String = block
        .lines()
        .filter_map(|line| line.strip_prefix("fric> ").or_else(|| line.strip_prefix("  ... ")))
        .map(|line| format!("{line}\n"))
        .collect();
    let folder = folder("pages");
    fs::write(folder.join("typed"), typed).unwrap();
    let script = "exec \"$0\" repl --echo --keep-going < \"$1\" 2>&1";
    let mut command = Command::new("sh");
    command.args(["-c", script, env!("CARGO_BIN_EXE_fric")]).arg(folder.join("typed"));
    let output = command.current_dir(env!("CARGO_MANIFEST_DIR")).output().unwrap();
    let lines: Vec<String> = text(&output.stdout).lines().map(|line| line.trim_end().to_string()).collect();
    lines.join("\n") + "\n"
}

/// `BLESS=1 cargo test --test repl` writes the actual output.
#[test]
fn the_sessions_on_the_pages_print_what_they_show() {
    for name in ["README.md", "docs/repl.md"] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(name);
        let page = fs::read_to_string(&path).unwrap();
        let mut now = String::new();
        let mut from = 0;
        let blocks = sessions(&page);
        assert!(!blocks.is_empty(), "{name} has no session");
        for (begin, end) in blocks {
            now += &page[from..begin];
            now += &transcript(&page[begin..end]);
            from = end;
        }
        now += &page[from..];
        if std::env::var_os("BLESS").is_some() {
            fs::write(&path, &now).unwrap();
        }
        let different = page.lines().zip(now.lines()).find(|(was, is)| was != is);
        assert!(page == now, "{name}: {different:?}; BLESS=1 writes what is printed now");
    }
}

/// Variables, instances by their names, measures in arithmetic, 0 without a unit, and words of other languages.
#[test]
fn the_prompt_accepts_what_people_type() {
    let folder = folder("typed");
    let script = "x = 3 mm\nx * 2\nf = LuGre(vd = 10 mm/s)\nf.v = x / 1 s\nf.v\nf\nrun f for 1 s\n\
                  2 * max(f.F) - max(f.F) - max(f.F)\nmax(f.F) * 0\nFs = 2 N\nnames\n";
    let done = piped(&folder, &["repl"], script);
    let out = text(&done.stdout);
    assert_eq!(done.status.code(), Some(0), "{out}\n{}", text(&done.stderr));
    for line in [
        "x = 3 mm",
        "6 mm",
        "3 mm/s",
        "  param  f.Fs      1.5 N",
        "  state  f.z       0 µm",
        "0 N",
        "Fs = 2 N   (a variable; `f.Fs = 2 N` sets the param)",
    ] {
        assert!(out.lines().any(|one| one == line), "no `{line}` in\n{out}");
    }
    assert!(!out.contains("NaN"), "{out}");
    let cut =
        piped(&folder, &["repl"], "f = LuGre(vd = 10 mm/s)\nplot f.F against f.v = 0 .. 10 mm/s steady to a.svg\n");
    assert_eq!(cut.status.code(), Some(0), "{}", text(&cut.stderr));
    for (line, words) in [
        ("for i = 1:3", "there are no loops"),
        ("linearise f", "`fric linearise FILE …`"),
        ("f = LuGrevd=10 mm/s)", "one `)` too many"),
    ] {
        let said = text(&piped(&folder, &["repl"], line).stderr);
        assert!(said.contains(words), "{line}: {said}");
    }
    let doc = text(&piped(&folder, &["repl"], "doc LuGre\n").stdout);
    assert!(doc.lines().any(|line| line.split_whitespace().take(6).eq(["param", "Fs", "N", "=", "1.5", "N"])), "{doc}");
}

/// A session that runs an experiment of a file which imports another is saved, into another folder too, and runs there.
#[test]
fn a_session_on_imports_of_imports_is_saved() {
    let folder = folder("imports");
    fs::create_dir_all(folder.join("parts")).unwrap();
    fs::write(folder.join("parts/driven.fric"), "model Driven { state x [m] = 0  dx/dt = 1 m/s  output y [m] = x }\n")
        .unwrap();
    let outer =
        "import \"parts/driven.fric\"\nimport std.interfaces\nexperiment moves { run Driven() for 1 s  plot y }\n";
    fs::write(folder.join("outer.fric"), outer).unwrap();
    for to in ["saved.fric", "deep/down/saved.fric"] {
        let script = format!("use \"outer.fric\"\nrun moves\nexpect final(y) > 0.5 m\nsave {to}\n");
        let done = piped(&folder, &["repl"], &script);
        assert_eq!(done.status.code(), Some(0), "{to}: {}", text(&done.stderr));
        let test = fric(&folder).args(["test", to]).output().unwrap();
        assert!(test.status.success(), "{to}: {}{}", text(&test.stdout), text(&test.stderr));
    }
}
