//! Clients that others have written, as they speak with the panel: Python's `websockets`.
//!
//! The package comes from a package index, so it may not be available. This test has its own `main`: what could not be
//! tried is counted in its last line, and passes for nothing.

#[path = "panel/opened.rs"]
mod opened;

use opened::{Panel, STICK_SLIP, root};
use std::fs;
use std::path::PathBuf;
use std::process::{Command, ExitCode};

const PACKAGE: &str = "websockets==15.0.1";

const CLIENT: &str = r#"
import asyncio, json, struct, sys, websockets

async def main(port, key):
    own = f"http://127.0.0.1:{port}"
    async with websockets.connect(f"ws://127.0.0.1:{port}/socket", origin=own, compression=None) as ws:
        await ws.send(f"key {key}")
        hello, state = json.loads(await ws.recv()), json.loads(await ws.recv())
        assert hello["kind"] == "hello" and hello["is"]["title"] == "stick_slip", hello
        assert state["kind"] == "state" and all(v["holds"] for v in state["is"]["run"]["verdicts"]), state
        first = await ws.recv()
        assert struct.unpack_from("<II", first) == (1, 0)
        await ws.send("ack 1")
        await ws.send("view 0 0 10 30 200")
        pong = await ws.ping()
        await asyncio.wait_for(pong, 10)
        frame = await ws.recv()
        number, blocks, newest = struct.unpack_from("<IId", frame)
        assert (number, newest) == (2, 40.0) and blocks == 2, (number, blocks, newest)
        at = 16
        for _ in range(blocks):
            kind, view, curve, cycles, count, x0, base = struct.unpack_from("<HHIIIdd", frame, at)
            pairs = struct.unpack_from(f"<{2 * count}f", frame, at + 32)
            xs = [x0 + x for x in pairs[::2]]
            assert kind == 2 and view == 0 and xs == sorted(xs) and xs[0] <= 10 and xs[-1] >= 30, (kind, xs[:3], xs[-3:])
            assert count <= 4 * 202, count
            at += 32 + 8 * count
        assert at == len(frame), (at, len(frame))
        await ws.send("ack 2")
        for line, part in [("1 set fr.Fs = 1.7 N", "ok"), ("2 set fr.Fs = 3 s", "refused"), ("3 stop", "refused")]:
            await ws.send(line)
            while True:
                answer = await ws.recv()
                if isinstance(answer, str) and json.loads(answer)["kind"] == "answer":
                    break
                if isinstance(answer, bytes):
                    await ws.send(f"ack {struct.unpack_from('<I', answer)[0]}")
            answer = json.loads(answer)
            assert answer["number"] == int(line[0]) and part in answer, answer
    for origin in [None, "http://evil.test", f"http://127.0.0.1:{port}.evil.test"]:
        try:
            await websockets.connect(f"ws://127.0.0.1:{port}/socket", origin=origin)
            raise SystemExit(f"{origin} was let in")
        except websockets.exceptions.InvalidStatus as refused:
            assert refused.response.status_code == 403, refused
    print("fine")

asyncio.run(main(int(sys.argv[1]), sys.argv[2]))
"#;

/// A Python that has the package, from an earlier run or made now.
///
/// # Errors
/// Why there is none.
fn python() -> Result<PathBuf, String> {
    let folder = root().join("target/panel-peer");
    let (python, complete) = (folder.join("bin/python"), folder.join("complete"));
    if fs::read_to_string(&complete).is_ok_and(|text| text == PACKAGE) {
        return Ok(python);
    }
    let run = |command: &mut Command, what: &str| match command.output() {
        Ok(output) if output.status.success() => Ok(()),
        Ok(output) => {
            let said = String::from_utf8_lossy(&output.stderr).into_owned();
            Err(format!("{what}: {}", said.trim().lines().last().unwrap_or("it failed without a word")))
        }
        Err(error) => Err(format!("{what}: {error}")),
    };
    run(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&folder), "no environment of Python")?;
    let pip = ["-m", "pip", "install", "-q", "--disable-pip-version-check", "--retries", "1"];
    run(Command::new(&python).args(pip).arg(PACKAGE), &format!("no {PACKAGE} from a package index"))?;
    fs::write(&complete, PACKAGE).map_err(|error| format!("{}: {error}", complete.display()))?;
    Ok(python)
}

fn websockets() -> Result<(), String> {
    let python = python()?;
    let panel = Panel::open(&[STICK_SLIP, "stick_slip"]);
    let output = Command::new(&python).args(["-c", CLIENT, &panel.port().to_string(), panel.key()]).output();
    let output = output.expect("it was found a moment ago");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(String::from_utf8_lossy(&output.stdout).trim(), "fine");
    Ok(())
}

fn main() -> ExitCode {
    // Test runners ask for the list of tests first.
    if std::env::args().any(|argument| argument == "--list") {
        return ExitCode::SUCCESS;
    }
    let (mut spoke, mut skipped) = (0, 0);
    match websockets() {
        Ok(()) => {
            spoke += 1;
            println!("speaks: {PACKAGE}");
        }
        Err(why) => {
            skipped += 1;
            println!("SKIPPED: {why}");
        }
    }
    println!("clients of others: {spoke} speak with the panel, {skipped} skipped");
    ExitCode::SUCCESS
}
