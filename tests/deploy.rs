//! Packages and the way to the rig's computer: built twice to the same bytes, refused if a bit differs, deployed over a
//! real sshd on this machine, rolled back, run, and the recording replayed to the bit.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::LazyLock;
use std::time::{Duration, Instant};

/// A rig on a simulated bus: it needs no hardware and arms itself.
const RIG: &str = r#"
import std.friction
import std.control
import std.plant

rig rtfs {
  run rotary Servo(
        r   = step(0 s, 1 rad),
        m   = 0.012 kg·m^2,
        pid = rotary PIDDiscrete(Kp = 1.2 N·m/rad, Ti = 0.2 s, Td = 80 ms,
                                 N = 10, u_max = 2 N·m, Ts = 1 ms),
        fr  = rotary LuGre(sigma0 = 260 N·m/rad, sigma1 = 1.2 N·m·s/rad,
                           sigma2 = 0.018 N·m·s/rad, Fc = 0.28 N·m,
                           Fs = 0.42 N·m, vs = 0.01 rad/s, vd = 0.1 rad/s))
  rate     1 ms
  bus      can0  = BUS
  drive    load  = cia402(can0, node = 3, T_rated = 4 N·m, mode = torque,
                          count = 1 rev / 262144, speed_unit = 0.01 rpm,
                          delay = 0.8 ms, lag = 0.6 ms, timeout = 3 ms)
  drive    servo = cia402(can0, node = 4, T_rated = 4 N·m, mode = torque,
                          count = 1 rev / 262144, speed_unit = 0.01 rpm,
                          delay = 0.8 ms, lag = 0.6 ms, timeout = 3 ms)
  hardware body {
    servo.torque = F_motor         limit -2 N·m .. 2 N·m
    load.torque  = -F_load         limit -1 N·m .. 1 N·m  slew 200 N·m/s
    v            = load.speed
    x            = servo.position
  }
  watchdog 50 ms
  overrun  hold 20
  safe     load.torque = 0 N·m, servo.torque = 0 N·m
  stop     when abs(body.v) > 150 rad/s, "overspeed"
  record   body.x [deg], fr.F [N·m]
}
"#;

fn text(bus: &str) -> String {
    RIG.replace("BUS", bus)
}

/// A folder of its own for one test, empty at its start.
fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("deploy-{name}"));
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).unwrap();
    path
}

fn fric(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_fric")).current_dir(folder).args(args).output().unwrap()
}

fn said(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

#[track_caller]
fn fine(folder: &Path, args: &[&str]) -> String {
    let output = fric(folder, args);
    assert!(output.status.success(), "fric {args:?}\n{}", said(&output));
    said(&output)
}

#[track_caller]
fn fails(folder: &Path, args: &[&str], why: &str) {
    let output = fric(folder, args);
    let told = said(&output);
    assert!(output.status.code() == Some(1) && told.contains(why), "fric {args:?}\n{told}");
}

/// The small program, built beside this one.
static FRIC_RIG: LazyLock<PathBuf> = LazyLock::new(|| {
    let beside = Path::new(env!("CARGO_BIN_EXE_fric")).with_file_name("fric-rig");
    if !beside.exists() {
        let mut build = Command::new(env!("CARGO"));
        build.current_dir(env!("CARGO_MANIFEST_DIR")).args(["build", "--offline", "-p", "fric-rig"]);
        assert!(build.status().unwrap().success(), "fric-rig is needed for this test and cannot be built");
    }
    beside
});

#[test]
fn two_builds_give_equal_bytes_and_no_bit_may_differ() {
    let folder = folder("bits");
    fs::write(folder.join("rig.fric"), text("sim(\"bench\")")).unwrap();
    for name in ["a.fricpkg", "b.fricpkg"] {
        fine(&folder, &["build", "rig.fric", "--target", "x86_64-linux", "-o", name]);
    }
    let bytes = fs::read(folder.join("a.fricpkg")).unwrap();
    assert!(bytes == fs::read(folder.join("b.fricpkg")).unwrap(), "two builds differ");
    let shown = fine(&folder, &["inspect", "a.fricpkg"]);
    for word in ["rtfs", "x86_64-linux", "control", "plant", "source/rig.fric", "source/std.friction.lugre.fric"] {
        assert!(shown.contains(word), "{word}\n{shown}");
    }
    assert!(fine(&folder, &["inspect", "--sources", "a.fricpkg"]).contains("overspeed"));
    assert!(runtime::package::Package::read(&bytes).is_ok());
    // Positions all over the file, each with another bit: the same every time.
    let mut at = 1usize;
    for k in 0..500 {
        at = (at * 48_271 + k) % bytes.len();
        let mut changed = bytes.clone();
        changed[at] ^= 1 << (k % 8);
        assert!(runtime::package::Package::read(&changed).is_err(), "byte {at}, bit {}", k % 8);
    }
    fs::write(folder.join("half.fricpkg"), &bytes[..bytes.len() / 2]).unwrap();
    fails(&folder, &["inspect", "half.fricpkg"], "the copy is not whole");
    let arm = fine(&folder, &["build", "rig.fric", "--target", "aarch64-linux", "-o", "arm.fricpkg"]);
    assert!(arm.contains("for aarch64-linux"), "{arm}");
    assert!(fine(&folder, &["inspect", "arm.fricpkg"]).contains("bytes of code for aarch64"));
}

#[test]
fn a_package_is_signed_and_its_signer_named() {
    let folder = folder("signed");
    fs::write(folder.join("rig.fric"), text("sim(\"bench\")")).unwrap();
    fine(&folder, &["key", "new", "keys/anna"]);
    fails(&folder, &["key", "new", "keys/anna"], "is there already: a key is not written over");
    fine(&folder, &["build", "rig.fric", "--sign", "keys/anna.key", "-o", "a.fricpkg"]);
    assert!(fine(&folder, &["inspect", "--trusted", "keys", "a.fricpkg"]).contains("signed by anna"));
    fine(&folder, &["build", "rig.fric", "-o", "a.fricpkg"]);
    fails(
        &folder,
        &["inspect", "--trusted", "keys", "a.fricpkg"],
        "it is not signed, and this computer trusts anna only",
    );
}

#[test]
fn what_cannot_be_packed_is_told() {
    let folder = folder("told");
    fs::write(folder.join("rig.fric"), text("sim(\"bench\")")).unwrap();
    fs::write(folder.join("model.fric"), "model M {\n  output F [N] = 1 N\n}\n").unwrap();
    fails(&folder, &["build", "model.fric", "-o", "a.fricpkg"], "model.fric has no rig");
    fails(&folder, &["build", "rig.fric", "rtfz", "-o", "a.fricpkg"], "has no rig `rtfz`; did you mean `rtfs`?");
    fails(&folder, &["build", "rig.fric", "--sign", "none.key", "-o", "a.fricpkg"], "cannot read none.key");
    assert!(!folder.join("a.fricpkg").exists(), "nothing is written where something is wrong");
}

/// A real sshd on a port of its own, with keys of its own; ended when it goes.
struct Sshd {
    child: Child,
    options: Vec<String>,
}

/// Unpacks Debian's server beside the build, where none is installed.
fn server() -> (PathBuf, PathBuf) {
    let installed = Path::new("/usr/sbin/sshd");
    if installed.exists() {
        return (installed.into(), "/usr/lib/openssh/sftp-server".into());
    }
    let cache = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/sshd");
    let sshd = cache.join("root/usr/sbin/sshd");
    if !sshd.exists() {
        fs::create_dir_all(&cache).unwrap();
        let script = "apt-get download openssh-server openssh-sftp-server libwrap0 || \
                      { apt-get update && apt-get download openssh-server openssh-sftp-server libwrap0; } && \
                      for d in *.deb; do dpkg-deb -x $d root; done";
        let done = Command::new("sh").args(["-c", script]).current_dir(&cache).output().unwrap();
        assert!(sshd.exists(), "this test needs openssh-server and could not get it:\n{}", said(&done));
    }
    (sshd, cache.join("root/usr/lib/openssh/sftp-server"))
}

impl Sshd {
    fn start(folder: &Path) -> Sshd {
        let (sshd, sftp) = server();
        for key in ["host", "user"] {
            let file = folder.join(key);
            let made = Command::new("ssh-keygen").args(["-q", "-t", "ed25519", "-N", "", "-f"]).arg(&file).status();
            assert!(made.unwrap().success(), "this test needs ssh-keygen");
        }
        let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = free.local_addr().unwrap().port();
        drop(free);
        let path = |name: &str| folder.join(name).display().to_string();
        let config = format!(
            "Port {port}\nListenAddress 127.0.0.1\nHostKey {}\nAuthorizedKeysFile {}\nStrictModes no\nUsePAM no\n\
             PidFile none\nSubsystem sftp {}\n",
            path("host"),
            path("user.pub"),
            sftp.display()
        );
        fs::write(folder.join("sshd_config"), config).unwrap();
        let libraries = sshd.parent().unwrap().join("../lib/x86_64-linux-gnu");
        // A server of root wants a user and a folder of its own: in a view of the file system that only it has.
        let script = "set -e; sshd=$1; dir=$2; \
                      if [ $(id -u) = 0 ] && ! { getent passwd sshd && [ -d /run/sshd ]; } >/dev/null; then \
                        { cat /etc/passwd; echo 'sshd:x:74:65534::/run/sshd:/usr/sbin/nologin'; } > $dir/passwd; \
                        exec unshare -m sh -c \"mount --bind $dir/passwd /etc/passwd && mount -t tmpfs tmpfs /run && \
                          mkdir /run/sshd && exec $sshd -D -e -f $dir/sshd_config\"; \
                      fi; exec $sshd -D -e -f $dir/sshd_config";
        let log = fs::File::create(folder.join("sshd.log")).unwrap();
        let child = Command::new("sh")
            .args(["-c", script, "sh"])
            .arg(&sshd)
            .arg(folder)
            .env("LD_LIBRARY_PATH", libraries)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .unwrap();
        let options = [
            format!("Port={port}"),
            format!("IdentityFile={}", path("user")),
            "IdentitiesOnly=yes".into(),
            "StrictHostKeyChecking=no".into(),
            format!("UserKnownHostsFile={}", path("known_hosts")),
            "LogLevel=ERROR".into(),
        ];
        let sshd = Sshd { child, options: options.into_iter().flat_map(|one| ["-o".to_string(), one]).collect() };
        let begun = Instant::now();
        while std::net::TcpStream::connect(("127.0.0.1", port)).is_err() {
            let log = || fs::read_to_string(folder.join("sshd.log")).unwrap_or_default();
            assert!(begun.elapsed() < Duration::from_secs(20), "sshd does not listen:\n{}", log());
            std::thread::sleep(Duration::from_millis(20));
        }
        sshd
    }
}

impl Drop for Sshd {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn a_rig_is_deployed_run_and_replayed_and_what_is_wrong_changes_nothing() {
    let folder = folder("ssh");
    let there = folder.join("there");
    fs::write(folder.join("rig.fric"), text("sim(\"bench\")")).unwrap();
    fs::write(folder.join("bad.fric"), text("can(\"nosuchcan\", 1 Mbit/s)")).unwrap();
    let sshd = Sshd::start(&folder);
    let user = String::from_utf8(Command::new("id").arg("-un").output().unwrap().stdout).unwrap();
    let host = format!("{}@127.0.0.1", user.trim());
    let (rig, dir) = (FRIC_RIG.display().to_string(), there.display().to_string());
    let trusted = folder.join("trusted").display().to_string();
    let with = |command: &'static str, more: &[&str]| -> Vec<String> {
        let mut all = vec![command.to_string(), host.clone()];
        all.extend(more.iter().map(|word| word.to_string()));
        all.extend(sshd.options.iter().cloned());
        all.extend(["--rig".into(), rig.clone(), "--dir".into(), dir.clone()]);
        all
    };
    let words = |all: &[String]| all.iter().map(|word| word.to_string()).collect::<Vec<_>>();
    let run = |all: Vec<String>| {
        let all = words(&all);
        fric(&folder, &all.iter().map(String::as_str).collect::<Vec<_>>())
    };
    let local = |args: &[&str]| Command::new(&*FRIC_RIG).args(args).args(["--dir", &dir]).output().unwrap();
    let current = || fs::read_link(there.join("current")).ok();

    // With a trusted key there, what is not signed is refused, and nothing is installed.
    fine(&folder, &["key", "new", "trusted/anna"]);
    let refused = run(with("deploy", &["rig.fric", "--trusted", &trusted]));
    assert!(!refused.status.success() && said(&refused).contains("it is not signed"), "{}", said(&refused));
    assert!(said(&refused).contains("what was installed there is as it was") && current().is_none());

    let deployed = run(with("deploy", &["rig.fric", "--trusted", &trusted, "--sign", "trusted/anna.key"]));
    assert!(deployed.status.success(), "{}", said(&deployed));
    assert!(said(&deployed).contains("signed by anna"), "{}", said(&deployed));
    let first = current().expect("it is installed");

    // A truncated copy is never started.
    let bytes = fs::read(there.join(&first)).unwrap();
    let half = there.join("incoming/half.fricpkg");
    fs::write(&half, &bytes[..bytes.len() * 2 / 3]).unwrap();
    let refused = local(&["install", &half.display().to_string()]);
    assert!(said(&refused).contains("the copy is not whole") && current().as_ref() == Some(&first));

    // One that is whole and does not start gives way to the one before.
    let refused = run(with("deploy", &["bad.fric", "--start"]));
    assert!(!refused.status.success(), "{}", said(&refused));
    assert!(said(&refused).contains("it does not start") && said(&refused).contains("back to "), "{}", said(&refused));
    assert_eq!(current().as_ref(), Some(&first));

    // The good one starts and runs by itself on its simulated drives.
    let started = local(&["start"]);
    assert!(started.status.success(), "{}", said(&started));
    let begun = Instant::now();
    loop {
        let status = said(&local(&["status"]));
        if status.contains(" cycles") && !status.contains(" 0 cycles") {
            break;
        }
        let out = fs::read_to_string(there.join("log/rig.out")).unwrap_or_default();
        assert!(begun.elapsed() < Duration::from_secs(60), "it does not get to run:\n{status}\n{out}");
        std::thread::sleep(Duration::from_millis(200));
    }
    assert!(local(&["say", "stop"]).status.success());
    let begun = Instant::now();
    while there.join("state").exists() {
        assert!(begun.elapsed() < Duration::from_secs(30), "it does not stop");
        std::thread::sleep(Duration::from_millis(50));
    }
    std::thread::sleep(Duration::from_millis(500));
    let fetched = run(with("fetch-log", &[]));
    assert!(fetched.status.success(), "{}", said(&fetched));
    let log = fs::read_dir(folder.join("out")).unwrap().next().unwrap().unwrap().path();
    let replayed = fine(&folder, &["replay", &log.display().to_string()]);
    assert!(replayed.contains("agree") || replayed.contains("the same"), "{replayed}");

    // What is not reached says so.
    let nobody = run(vec!["fetch-log".into(), host.clone(), "-o".into(), "Port=1".into()]);
    assert!(!nobody.status.success() && said(&nobody).contains("there are no logs"), "{}", said(&nobody));
}
