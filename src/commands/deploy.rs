//! `fric deploy`, `fric fetch-log`: installs a rig on the computer that runs it, and fetches its recordings.
//!
//! All checks happen before anything changes on that computer: the package is built for its processor, copied beside
//! the installed one, verified by the computer itself, and activated in one step. If interrupted at any point, the rig
//! keeps running its old package.

use super::End;
use crate::args::{Deploy, FetchLog, Host};
use crate::project;
use crate::signing::{self, Signing};
use crate::ssh::{Failed, Remote};
use crate::terminal::Terminal;
use abi::foreign::is_component;
use runtime::package::signature::{EXTENSION as SIGNATURE, beside};
use runtime::package::{MOST_BYTES, Package, hash};
use runtime::record::parts;
use std::fs;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

pub fn deploy(args: &Deploy, terminal: &mut Terminal) -> End {
    match deployed(args, terminal) {
        Ok(()) => End::Fine,
        Err(why) => {
            terminal.error(&why);
            End::Failed
        }
    }
}

fn deployed(args: &Deploy, terminal: &mut Terminal) -> Result<(), String> {
    let Host { host, options, rig, dir } = &args.host;
    let remote = Remote::new(host, options);
    let target = remote.run(&[rig, "target"]).map_err(|why| no_rig(&remote, rig, &why))?.trim().to_string();
    terminal.line(&format!("{host} is {target}"));
    let key = signing(args, terminal)?;
    let Packed { bytes, signature } = packed(args, &target, key.as_ref(), terminal)?;
    let package = Package::read(&bytes).map_err(|why| why.to_string())?;
    if package.target != target {
        return Err(format!("the package is for {}, and {host} is {target}: build it for that", package.target));
    }
    let contents = package.contents().map_err(|why| why.to_string())?;
    let simulated = contents.rig.buses.iter().all(|bus| bus.address.starts_with("sim:"));
    let trusted: Vec<&str> = args.trusted.iter().flat_map(|folder| ["--trusted", folder.as_str()]).collect();
    if let Some(key) = &key {
        register(args, &remote, key, &trusted, simulated, terminal)?;
    }
    // In a new folder beside the installed packages that nobody else can write to.
    let name = format!("{}-{}.{}", package.rig, &hash(&bytes)[..12], runtime::package::EXTENSION);
    let staging = Staging::new(&name, &bytes, signature.as_deref())?;
    let failed = |what: &str| {
        let host = host.clone();
        let what = what.to_string();
        move |why: Failed| format!("{host}: {what}: {}; what was installed there is as it was", why.words())
    };
    let incoming = format!("{dir}/incoming");
    remote.run(&["mkdir", "-p", &incoming]).map_err(failed("no folder for packages"))?;
    let made = remote.run(&["mktemp", "-d", "-p", &incoming, "XXXXXXXXXX"]);
    let folder = made.map_err(failed("no folder for packages"))?.trim().to_string();
    let arrived = There { remote: &remote, folder };
    let path = format!("{}/{name}", arrived.folder);
    remote.send(&staging.files(), &arrived.folder).map_err(failed("the copy did not arrive"))?;
    let allowed = args.allow_unsigned.then_some("--allow-unsigned");
    let with = |words: &[&str]| -> Vec<String> {
        words.iter().chain(&trusted).copied().chain(allowed).map(str::to_string).collect()
    };
    let run = |words: &[String]| remote.run(&words.iter().map(String::as_str).collect::<Vec<_>>());
    let checked = run(&with(&[rig, "check", &path])).map_err(failed("the package is refused"))?;
    terminal.print(&checked);
    if let Ok(found) = remote.run(&[rig, "doctor"]) {
        terminal.print(&found);
    }
    let mut install = with(&[rig, "install", &path, "--dir", dir]);
    install.extend(args.allow_older.then(|| "--allow-older".into()));
    let installed = run(&install).map_err(failed("it could not be installed"))?;
    terminal.print(&installed);
    // The installed package is kept under its hash; the copy is no longer needed.
    drop(arrived);
    if args.start {
        let mut words = with(&[rig, "start", "--hash", &hash(&bytes), "--dir", dir]);
        for (option, size) in [("--roll", args.roll), ("--keep", args.keep)] {
            words.extend(size.into_iter().flat_map(|size| [option.into(), parts::option(size)]));
        }
        start(args, &remote, &words, terminal)?;
    }
    Ok(())
}

/// A folder on the other computer, removed on drop.
struct There<'a> {
    remote: &'a Remote,
    folder: String,
}

impl Drop for There<'_> {
    fn drop(&mut self) {
        let _ = self.remote.run(&["rm", "-rf", "--", &self.folder]);
    }
}

/// The signing key: the one named on the command line, else the user's own, created on first use. None if nothing is to
/// be signed.
fn signing(args: &Deploy, terminal: &mut Terminal) -> Result<Option<Named>, String> {
    let signed = is_package(&args.file) && beside(&args.file).exists();
    if let Some(path) = &args.sign {
        let name = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        return Ok(Some(Named { name, key: Signing::open(path)? }));
    }
    if args.allow_unsigned || signed {
        return Ok(None);
    }
    let variable = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let folder = variable("XDG_CONFIG_HOME").or_else(|| std::env::home_dir().map(|home| home.join(".config")));
    let folder = folder.ok_or("no home to keep a key in: name one with --sign, `fric key new` makes it")?.join("fric");
    let path = folder.join("deploy.key");
    if !path.exists() {
        let (secret, public) = signing::new_pair().map_err(|why| format!("cannot make a key: {why}"))?;
        project::write_secret(&path, secret.as_bytes())
            .and_then(|()| project::write(&path.with_extension("pub"), public.as_bytes()))
            .map_err(|error| format!("cannot write {}: {error}", path.display()))?;
        terminal.line(&format!("made a key to sign packages with: {}, keep it to yourself", path.display()));
    }
    let key = Signing::open(&path)?;
    // Two people may have the same name: a part of the key makes the name unique.
    let letters = |text: &str| text.chars().filter(char::is_ascii_alphanumeric).take(32).collect::<String>();
    let user = variable("USER").map(|user| letters(&user.to_string_lossy())).filter(|user| !user.is_empty());
    let name = format!("{}-{}", user.unwrap_or("fric".into()), &hash(key.public().as_bytes())[..8]);
    Ok(Some(Named { name, key }))
}

/// A key and the name under which the rig's computer knows it.
struct Named {
    name: String,
    key: Signing,
}

/// Registers a key with the rig's computer if that trusts no key yet; reports it.
fn register(
    args: &Deploy,
    remote: &Remote,
    Named { name, key }: &Named,
    trusted: &[&str],
    simulated: bool,
    terminal: &mut Terminal,
) -> Result<(), String> {
    let Host { host, rig, .. } = &args.host;
    let public = key.public();
    let known = remote.run(&[&[rig.as_str(), "trust"], trusted].concat());
    let known = known.map_err(|why| format!("{host}: the keys that it trusts are not known: {}", why.words()))?;
    let names: Vec<&str> = known.lines().filter_map(|line| Some(line.split_once(' ')?.0)).collect();
    if known.lines().any(|line| line.split_once(' ').is_some_and(|(_, key)| key == public)) {
        return Ok(());
    }
    let by_hand = [&["sudo", rig.as_str(), "trust", name, public.as_str()], trusted].concat().join(" ");
    if !names.is_empty() {
        return Err(format!(
            "{host} trusts {} only, and not your key {name}: whoever looks after it registers it there with\n  {by_hand}",
            names.join(", ")
        ));
    }
    match remote.run(&[&[rig.as_str(), "trust", name, &public, "--first"], trusted].concat()) {
        Ok(said) => {
            terminal.print(&format!("{host}: {said}"));
            Ok(())
        }
        Err(why) if simulated => {
            terminal.line(&format!(
                "{host}: your key {name} is not registered: {}; a rig on simulated buses runs all the same, a real one \
                 needs\n  {by_hand}",
                why.words()
            ));
            Ok(())
        }
        Err(why) => Err(format!(
            "{host}: your key {name} could not be registered: {}; do it there, once, with\n  {by_hand}",
            why.words()
        )),
    }
}

/// Starts the installed package and reports its state. If it fails to start, the computer itself returns to the
/// previous package.
fn start(args: &Deploy, remote: &Remote, words: &[String], terminal: &mut Terminal) -> Result<(), String> {
    let Host { host, rig, dir, .. } = &args.host;
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let said = remote.run(&words).map_err(|why| format!("{host}: {}", why.words()))?;
    terminal.print(&said);
    if args.follow || std::io::stdout().is_terminal() {
        // Ctrl-C ends only the display: the deployment is done.
        crate::interrupt::on_interrupt(|| ENOUGH.store(true, Ordering::Relaxed));
        let followed = remote.follow(&[rig, "status", "--follow", "--dir", dir], &mut |line| terminal.line(line));
        return match followed {
            Err(why) if !ENOUGH.load(Ordering::Relaxed) => Err(format!("{host}: {}", why.words())),
            Ok(()) | Err(_) => Ok(()),
        };
    }
    Ok(())
}

/// Set by Ctrl-C once the rig runs.
static ENOUGH: AtomicBool = AtomicBool::new(false);

fn no_rig(remote: &Remote, rig: &str, why: &Failed) -> String {
    match why {
        Failed::Exit(127, _) => format!(
            "{} has no `{rig}`: copy target/release/fric-rig onto its path, or name it with --rig",
            remote.host()
        ),
        why => format!("{}: {}", remote.host(), why.words()),
    }
}

/// A package and its signature.
struct Packed {
    bytes: Vec<u8>,
    signature: Option<String>,
}

fn is_package(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == runtime::package::EXTENSION)
}

/// The package and its signature: read from a file, or built for the computer.
fn packed(args: &Deploy, target: &str, key: Option<&Named>, terminal: &mut Terminal) -> Result<Packed, String> {
    let path = &args.file;
    let key = key.map(|named| &named.key);
    if !is_package(path) {
        let wanted = crate::commands::shared::package::Wanted {
            name: args.name.as_deref(),
            target,
            features: &[],
            set: &args.set,
            key,
        };
        let (bytes, signature) = crate::commands::shared::package::packed(path, &wanted, terminal)?;
        return Ok(Packed { bytes, signature });
    }
    if args.name.is_some() || !args.set.all.is_empty() {
        return Err(format!("{} is a package: it goes as it was built and set", path.display()));
    }
    let about = |why: &dyn std::fmt::Display| format!("{}: {why}", path.display());
    let found = fs::metadata(path).map_err(|error| about(&error))?;
    if !found.is_file() || found.len() > MOST_BYTES {
        return Err(about(&"it is no file of the size of a package"));
    }
    let bytes = fs::read(path).map_err(|error| about(&error))?;
    let package = Package::read(&bytes).map_err(|why| about(&why))?;
    let signature = match key {
        Some(key) => Some(crate::commands::shared::package::signed(key, &package, &bytes)?),
        None => fs::read_to_string(beside(path)).ok(),
    };
    Ok(Packed { bytes, signature })
}

/// A local folder with the files to send: new, readable only by its owner, removed on drop.
struct Staging {
    _folder: tempfile::TempDir,
    paths: Vec<PathBuf>,
}

impl Staging {
    fn new(name: &str, bytes: &[u8], signature: Option<&str>) -> Result<Staging, String> {
        let mut private = tempfile::Builder::new();
        private.prefix("fric-deploy-");
        #[cfg(unix)]
        private.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o700));
        let folder = private.tempdir();
        let folder = folder.map_err(|error| format!("no folder for the package: {error}"))?;
        let mut paths = Vec::new();
        let beside = format!("{name}.{SIGNATURE}");
        for (name, bytes) in [(name, Some(bytes)), (&beside, signature.map(str::as_bytes))] {
            let Some(bytes) = bytes else { continue };
            let path = folder.path().join(name);
            project::write(&path, bytes).map_err(|error| format!("cannot write {}: {error}", path.display()))?;
            paths.push(path);
        }
        Ok(Staging { _folder: folder, paths })
    }

    fn files(&self) -> Vec<&Path> {
        self.paths.iter().map(PathBuf::as_path).collect()
    }
}

pub fn fetch_log(args: &FetchLog, terminal: &mut Terminal) -> End {
    let Host { host, options, dir, .. } = &args.host;
    let remote = Remote::new(host, options);
    let folder = format!("{dir}/log");
    let listed = match remote.run(&["ls", "-1t", &folder]) {
        Ok(listed) => listed,
        Err(why) => {
            terminal.error(&format!("{host}: there are no logs in {folder}: {}", why.words()));
            return End::Failed;
        }
    };
    // Reject names that are paths, because they could leave the folder on either computer.
    let (all, odd): (Vec<&str>, Vec<&str>) =
        listed.lines().filter(|name| name.ends_with(".friclog")).partition(|name| is_component(name));
    for name in odd {
        terminal.error(&format!("{host} says that it has a log `{name}`: that is no name of one, it stays there"));
    }
    // A long log consists of several files; the newest comes first.
    let whole = |name: &str| all.iter().rev().copied().filter(|other| of_log(other) == of_log(name)).collect();
    let wanted: Vec<&str> = match &args.log {
        Some(name) if all.contains(&name.as_str()) => whole(name),
        Some(name) => {
            terminal.error(&format!("{host} has no log `{name}`; it has {}", all.join(", ")));
            return End::Failed;
        }
        None if args.all => all,
        None => all.first().map(|newest| whole(newest)).unwrap_or_default(),
    };
    if wanted.is_empty() {
        terminal.error(&format!("{host} has no log in {folder}"));
        return End::Failed;
    }
    for name in wanted {
        let to = args.out.join(name);
        if let Err(why) = fetched(&remote, &format!("{folder}/{name}"), &to) {
            terminal.error(&format!("cannot fetch {name}: {why}"));
            return End::Failed;
        }
        terminal.line(&format!("wrote {}", to.display()));
    }
    End::Fine
}

/// The log that a file belongs to: `rtfs` for `rtfs.friclog` and for `rtfs.2.friclog`.
fn of_log(name: &str) -> &str {
    let stem = name.strip_suffix(".friclog").unwrap_or(name);
    match stem.rsplit_once('.') {
        Some((log, part)) if !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit()) => log,
        _ => stem,
    }
}

/// Copies a file here, atomically.
fn fetched(remote: &Remote, from: &str, to: &Path) -> Result<(), String> {
    let about = |error: std::io::Error| error.to_string();
    project::make_folder_of(to).map_err(about)?;
    let folder = to.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let staging = tempfile::Builder::new().prefix(".fetching-").tempdir_in(folder).map_err(about)?;
    let part = staging.path().join("log");
    remote.fetch(from, &part).map_err(|why| why.words())?;
    if !fs::symlink_metadata(&part).map_err(about)?.is_file() {
        return Err("it is no file".into());
    }
    fs::rename(&part, to).map_err(about)
}
