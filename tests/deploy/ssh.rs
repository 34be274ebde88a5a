//! Deployment over a real sshd on this machine: deployed, run, rolled back, interrupted.

use crate::{FRIC_RIG, debian, fine, folder, fric, said, unhurried};
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// A real sshd on a port of its own, with keys of its own; ended on drop.
struct Sshd {
    child: Child,
    options: Vec<String>,
}

/// The server and the program that copies files, installed or unpacked.
fn server() -> (PathBuf, PathBuf) {
    let installed = Path::new("/usr/sbin/sshd");
    if installed.exists() {
        return (installed.into(), "/usr/lib/openssh/sftp-server".into());
    }
    let packages = ["openssh-server", "openssh-sftp-server", "libwrap0"];
    let usr =
        debian::unpacked("sshd-tools", &packages, &[], "deployment cannot be tried: there is no sshd").join("usr");
    (usr.join("sbin/sshd"), usr.join("lib/openssh/sftp-server"))
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
        // As root, sshd needs a user and a folder: provide them in a private mount namespace.
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

/// The rig's computer: reached over ssh, and inspected directly.
pub struct There {
    folder: PathBuf,
    pub dir: PathBuf,
    pub host: String,
    sshd: Sshd,
}

impl There {
    pub fn new(folder: PathBuf) -> There {
        let sshd = Sshd::start(&folder);
        let user = String::from_utf8(Command::new("id").arg("-un").output().unwrap().stdout).unwrap();
        There { dir: folder.join("there"), host: format!("{}@127.0.0.1", user.trim()), sshd, folder }
    }

    /// `fric deploy HOST …`, `fric fetch-log HOST …`
    pub fn words(&self, command: &str, more: &[&str]) -> Vec<String> {
        let mut all = vec![command.to_string(), self.host.clone()];
        all.extend(more.iter().map(|word| word.to_string()));
        all.extend(self.sshd.options.iter().cloned());
        all.extend(["--rig".into(), FRIC_RIG.display().to_string(), "--dir".into(), self.dir.display().to_string()]);
        if command == "deploy" && !more.contains(&"--trusted") {
            all.extend(["--trusted".into(), self.folder.join("known").display().to_string()]);
        }
        all
    }

    fn over_ssh(&self, command: &str, more: &[&str]) -> Output {
        let words = self.words(command, more);
        fric(&self.folder, &words.iter().map(String::as_str).collect::<Vec<_>>())
    }

    #[track_caller]
    fn deploys(&self, more: &[&str]) -> String {
        let output = self.over_ssh("deploy", more);
        assert!(output.status.success(), "deploy {more:?}\n{}\n{}", said(&output), self.out());
        said(&output)
    }

    /// `fric-rig …`, as typed on that computer.
    fn local(&self, args: &[&str]) -> Output {
        Command::new(&*FRIC_RIG).args(args).arg("--dir").arg(&self.dir).output().unwrap()
    }

    #[track_caller]
    fn says(&self, what: &str) {
        let output = self.local(&["say", what]);
        assert!(output.status.success(), "{what}: {}\n{}", said(&output), self.out());
    }

    pub fn current(&self) -> Option<PathBuf> {
        fs::read_link(self.dir.join("current")).ok()
    }

    /// The output of a rig started by `start`.
    fn out(&self) -> String {
        fs::read_to_string(self.dir.join("log/rig.out")).unwrap_or_default()
    }

    /// The state that the running rig reports: package, stage, cycles; empty if none runs.
    fn state(&self) -> (String, String, u64) {
        let status = said(&self.local(&["status"]));
        let Some(state) = status.lines().find_map(|line| line.strip_prefix("runs: ")) else {
            return Default::default();
        };
        let (package, rest) = state.split_once(": ").expect("a package");
        let (head, _) = rest.split_once(" cycles").expect("cycles");
        let (stage, cycles) = head.rsplit_once(", ").expect("a stage");
        (package.into(), stage.into(), cycles.parse().expect("a number"))
    }

    /// Waits until the rig reports a state.
    #[track_caller]
    fn wait(&self, what: &str, mut holds: impl FnMut(&(String, String, u64)) -> bool) -> (String, String, u64) {
        let begun = Instant::now();
        loop {
            let state = self.state();
            if holds(&state) {
                return state;
            }
            assert!(begun.elapsed() < Duration::from_secs(90), "not {what}: {state:?}\n{}", self.out());
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Ends the rig and waits until it has ended.
    #[track_caller]
    fn ends(&self) {
        self.says("stop");
        self.wait("ended", |state| state.0.is_empty());
    }
}

impl Drop for There {
    fn drop(&mut self) {
        // A failed test leaves no rig running.
        let process = fs::read_to_string(self.dir.join("lock")).unwrap_or_default();
        if !self.state().0.is_empty() && !process.trim().is_empty() {
            let _ = Command::new("kill").args(["-9", process.trim()]).status();
        }
    }
}

#[test]
fn a_bad_package_changes_nothing_on_the_target() {
    let folder = folder("ssh");
    fs::write(folder.join("rig.fric"), unhurried("sim(\"bench\")")).unwrap();
    fs::write(folder.join("bad.fric"), unhurried("can(\"nosuchcan\", 1 Mbit/s)")).unwrap();
    let there = There::new(folder.clone());
    let trusted = folder.join("trusted").display().to_string();

    // With a trusted key there, an unsigned package is refused, and nothing is installed.
    fine(&folder, &["key", "new", "trusted/anna"]);
    let refused = there.over_ssh("deploy", &["rig.fric", "--trusted", &trusted]);
    let told = said(&refused);
    assert!(!refused.status.success() && told.contains("made a key to sign packages with"), "{told}");
    assert!(told.contains(" trusts anna only, and not your key ") && told.contains(" trust "), "{told}");
    let refused = there.over_ssh("deploy", &["rig.fric", "--trusted", &trusted, "--allow-unsigned"]);
    assert!(!refused.status.success() && said(&refused).contains("it is not signed"), "{}", said(&refused));
    assert!(said(&refused).contains("what was installed there is as it was") && there.current().is_none());
    let nothing = there.local(&["run"]);
    assert!(said(&nothing).contains("nothing is installed in "), "{}", said(&nothing));

    let deployed = there.deploys(&["rig.fric", "--trusted", &trusted, "--sign", "trusted/anna.key"]);
    assert!(deployed.contains("signed by anna"), "{deployed}");
    let first = there.current().expect("it is installed");

    // A truncated copy is never started.
    let bytes = fs::read(there.dir.join(&first)).unwrap();
    let half = there.dir.join("incoming/half.fricpkg");
    fs::write(&half, &bytes[..bytes.len() * 2 / 3]).unwrap();
    for command in ["check", "install", "run"] {
        let dir = if command == "check" { &[][..] } else { &["--dir", there.dir.to_str().unwrap()] };
        let refused = Command::new(&*FRIC_RIG).arg(command).arg(&half).args(dir).output().unwrap();
        assert_eq!(refused.status.code(), Some(1), "{command}");
        assert!(said(&refused).contains("the copy is not whole"), "{command}: {}", said(&refused));
    }
    assert_eq!(there.current().as_ref(), Some(&first));

    // A complete one that does not start is replaced by the previous one.
    let refused = there.over_ssh("deploy", &["bad.fric", "--start"]);
    assert!(!refused.status.success(), "{}", said(&refused));
    assert!(said(&refused).contains(": registered key "), "{}", said(&refused));
    assert!(said(&refused).contains("it does not start") && said(&refused).contains("back to "), "{}", said(&refused));
    assert_eq!(there.current().as_ref(), Some(&first));

    // The good one starts and runs by itself with its simulated drives; another one is refused at the same time.
    let started = there.local(&["start", "--roll", "1.5MB", "--keep", "20MB"]);
    assert!(started.status.success(), "{}", said(&started));
    there.wait("running", |state| state.2 > 10);
    // The size limits of logs reach the running process.
    let process = said(&started).lines().find_map(|line| line.strip_prefix("started, process ").map(str::to_string));
    let words = fs::read_to_string(format!("/proc/{}/cmdline", process.unwrap().trim())).unwrap().replace('\0', " ");
    assert!(words.contains("--roll 1500kB") && words.contains("--keep 20000kB"), "{words}");
    let reset = there.local(&["say", "reset"]);
    assert!(reset.status.code() == Some(1) && said(&reset).contains("a stop is final"), "{}", said(&reset));
    let second = there.local(&["run"]);
    assert!(second.status.code() == Some(1) && said(&second).contains("a rig runs in "), "{}", said(&second));
    assert!(said(&there.local(&["start"])).contains("it runs"));
    there.ends();

    // An unreachable host is reported.
    let nobody = fric(&folder, &["fetch-log", &there.host, "-o", "Port=1"]);
    assert!(!nobody.status.success() && said(&nobody).contains("there are no logs"), "{}", said(&nobody));
}

/// `fric-rig drives`, until dropped.
struct Drives(Child);

impl Drop for Drives {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// From one computer to the drives: built here, deployed over ssh, run with simulated drives over socketcand, and every
/// recording replayed here to the bit. A second package is activated only once no drive has torque.
#[test]
fn a_rig_is_deployed_run_over_socketcand_and_replayed_to_the_bit() {
    let folder = folder("socketcand");
    let free = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = free.local_addr().unwrap().port();
    drop(free);
    let rig = unhurried(&format!("socketcand(\"127.0.0.1:{port}/can0\", 1 Mbit/s)"));
    fs::write(folder.join("rig.fric"), &rig).unwrap();
    fs::write(folder.join("other.fric"), rig.replace("1 rad)", "0.5 rad)")).unwrap();
    fs::write(folder.join("bad.fric"), rig.replace(&format!("127.0.0.1:{port}"), "127.0.0.1:1")).unwrap();
    // The drives on the bus: the plant of the same package, by `fric-rig`.
    fine(&folder, &["build", "rig.fric", "-o", "rig.fricpkg"]);
    let drives = Command::new(&*FRIC_RIG)
        .current_dir(&folder)
        .args(["drives", "rig.fricpkg", "--quiet", "--tcp", &port.to_string()])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let _drives = Drives(drives);
    let there = There::new(folder.clone());

    let told = there.deploys(&["rig.fric", "--start"]);
    assert!(told.contains("made a key to sign packages with") && told.contains(": registered key "), "{told}");
    assert!(told.contains("fits this computer") && told.contains("started, process "), "{told}");
    let first = there.current().unwrap();
    let name = |path: &Path| path.display().to_string();
    there.wait("waiting for the operator", |state| state.0 == name(&first) && state.1.contains("enable"));
    there.says("enable");
    there.wait("waiting to be armed", |state| state.1.contains("arm"));
    there.says("arm");
    let (_, _, cycles) = there.wait("running", |state| state.2 > 20);

    // Parameters change according to the package: as a whole, or refused with the message of a start.
    let taken = there.local(&["say", "set fr.Fs = 0.5 N·m, fr.Fc = 0.3 N·m"]);
    assert!(taken.status.success() && said(&taken).contains("not judged: whether the fixed step"), "{}", said(&taken));
    for (set, why) in [
        ("set fr.vs = 0 rad/s", "E0502: `vs` of LuGre must be above 0 mrad/s"),
        ("set fr.Fs = 0.29 N·m", "E0501: `Fs` is smaller than `Fc`"),
        ("set pid.Ts = 1.5 ms", "only a start reads `pid.Ts`: a period follows from it"),
        ("set fr.Fs = 0.5 N·m, fr.Fx = 1 N·m", "there is no parameter `fr.Fx`"),
        ("arm", "it has no effect now: the rig is armed"),
    ] {
        let output = there.local(&["say", set]);
        assert!(!output.status.success() && said(&output).contains(why), "{set}: {}", said(&output));
    }

    // Its panel on this computer, through ssh: the link comes once the rig has answered.
    let mut panel = Command::new(env!("CARGO_BIN_EXE_fric"))
        .current_dir(&folder)
        .args(there.words("panel", &["--no-open", "--port", "0"]))
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut link = String::new();
    let read = BufReader::new(panel.stdout.take().unwrap()).read_line(&mut link);
    let _ = panel.kill();
    let _ = panel.wait();
    assert!(read.is_ok() && link.starts_with("panel  http://127.0.0.1:"), "{read:?} {link}");

    // Another package while drives have torque: installed, but not activated.
    let told = there.deploys(&["other.fric", "--start"]);
    assert!(!told.contains("made a key") && !told.contains("registered"), "only the first time: {told}");
    assert!(told.contains("it takes the package over as soon as no drive has torque"), "{told}");
    let second = there.current().unwrap();
    assert_ne!(first, second);
    let (runs, _, later) = there.state();
    assert!(runs == name(&first) && later > cycles, "{runs} runs, {later} cycles after {cycles}");
    // Torque off: now it is.
    there.says("stop");
    there.wait("taken over", |state| state.0 == name(&second) && state.1.contains("enable"));

    // At rest a package is activated at once, and one that cannot start is replaced by the previous one.
    let refused = there.over_ssh("deploy", &["bad.fric", "--start"]);
    let told = said(&refused);
    assert!(!refused.status.success() && told.contains("back to "), "{told}\n{}", there.out());
    assert_eq!(there.current().as_ref(), Some(&second), "{told}\n{}", there.out());
    there.wait("back", |state| state.0 == name(&second) && state.1.contains("enable"));
    there.says("enable");
    there.wait("waiting to be armed", |state| state.1.contains("arm"));
    there.says("arm");
    there.wait("running", |state| state.2 > 20);
    there.ends();

    let fetched = there.over_ssh("fetch-log", &["--all"]);
    assert!(fetched.status.success(), "{}", said(&fetched));
    let logs: Vec<PathBuf> = fs::read_dir(folder.join("out")).unwrap().map(|entry| entry.unwrap().path()).collect();
    assert!(logs.len() >= 2, "{logs:?}");
    let mut whole = 0;
    for log in logs {
        let replayed = fine(&folder, &["replay", &log.display().to_string()]);
        assert!(replayed.contains("agree") || replayed.contains("the same"), "{replayed}");
        whole += usize::from(replayed.contains("cycles"));
    }
    assert!(whole >= 2);
}

/// `FRIC_INTERRUPTS=100 cargo test --test deploy interrupted` kills that many.
#[test]
fn a_deployment_that_is_interrupted_leaves_the_rig_running_what_it_ran() {
    let tries: u32 = std::env::var("FRIC_INTERRUPTS").map_or(4, |n| n.parse().expect("a number"));
    let folder = folder("interrupted");
    let rig = unhurried("sim(\"bench\")");
    fs::write(folder.join("rig.fric"), &rig).unwrap();
    let there = There::new(folder.clone());
    there.deploys(&["rig.fric", "--start"]);
    let first = there.current().unwrap().display().to_string();
    let (_, _, mut cycles) = there.wait("running", |state| state.2 > 0);
    // The duration of a complete one, without its start.
    let begun = Instant::now();
    fs::write(folder.join("next.fric"), format!("// whole\n{rig}")).unwrap();
    there.deploys(&["next.fric"]);
    let whole = begun.elapsed();
    for k in 0..tries {
        fs::write(folder.join("next.fric"), format!("// try {k}\n{rig}")).unwrap();
        let words = there.words("deploy", &["next.fric", "--start"]);
        let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
        command.current_dir(&folder).args(words).stdout(Stdio::null()).stderr(Stdio::null());
        command.env("XDG_CONFIG_HOME", folder.join("config"));
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut child = command.spawn().unwrap();
        // Spread over this duration by the golden ratio, and slightly beyond.
        let part = (f64::from(k) * 0.618_034 + 0.3).fract() * 1.1;
        std::thread::sleep(whole.mul_f64(part));
        // Including its ssh and scp.
        let _ = Command::new("kill").args(["-9", "--", &format!("-{}", child.id())]).status();
        let _ = child.wait();

        let (runs, stage, now) = there.wait("going on", |state| state.2 > cycles);
        assert_eq!(runs, first, "try {k}, killed at {part:.2} of {whole:?}: {stage}");
        cycles = now;
        let current = there.dir.join(there.current().expect("there is one"));
        let checked = Command::new(&*FRIC_RIG).arg("check").arg(&current).output().unwrap();
        assert!(checked.status.success(), "try {k}: {}", said(&checked));
    }
    // The next complete one succeeds, whatever the interrupted ones left.
    fs::write(folder.join("next.fric"), format!("// at last\n{rig}")).unwrap();
    there.deploys(&["next.fric"]);
    let last = there.current().unwrap().display().to_string();
    assert_eq!(there.state().0, first);
    there.says("stop");
    there.wait("taken over", |state| state.0 == last);
    there.ends();
}

/// The state is reported for as long as the rig runs, and no longer.
#[test]
fn a_started_rig_is_followed_until_it_ends() {
    let folder = folder("followed");
    fs::write(folder.join("rig.fric"), unhurried("sim(\"bench\")")).unwrap();
    let there = There::new(folder.clone());
    let words = there.words("deploy", &["rig.fric", "--start", "--follow"]);
    let log = fs::File::create(folder.join("followed")).unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_fric"))
        .current_dir(&folder)
        .env("XDG_CONFIG_HOME", folder.join("config"))
        .args(words)
        .stdout(log)
        .spawn()
        .unwrap();
    let told = || fs::read_to_string(folder.join("followed")).unwrap();
    let package = || there.current().map_or("nothing".into(), |current| format!("{}: ", current.display()));
    let begun = Instant::now();
    while told().matches(&package()).count() < 3 {
        assert!(begun.elapsed() < Duration::from_secs(90), "{}\n{}", told(), there.out());
        std::thread::sleep(Duration::from_millis(50));
    }
    there.ends();
    let status = child.wait().unwrap();
    assert!(status.success() && told().contains("the rig has ended"), "{status}\n{}", told());
}
