//! `fric deploy`, `fric fetch-log`: a rig onto the computer that runs it, and its recordings back.
//!
//! Everything that can be refused is refused before anything changes there: the package is built for that computer,
//! copied beside what is installed, checked by the computer itself, and made current in one step. Interrupted at any
//! point, the rig keeps running what it ran.

use super::End;
use crate::args::{Deploy, FetchLog, Host};
use crate::project;
use crate::remote::{Failed, Remote};
use crate::terminal::Terminal;
use runtime::package::signature::{EXTENSION as SIGNATURE, beside};
use runtime::package::{Package, hash};
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
    let (bytes, signature) = packed(args, &target, terminal)?;
    let package = Package::read(&bytes).map_err(|why| why.to_string())?;
    if package.target != target {
        return Err(format!("the package is for {}, and {host} is {target}: build it for that", package.target));
    }
    // Beside what is installed, under a name of its own.
    let name = format!("{}-{}.{}", package.rig, &hash(&bytes)[..12], runtime::package::EXTENSION);
    let folder = format!("{dir}/incoming");
    let arrived = format!("{folder}/{name}");
    let staging = Staging::new(&name, &bytes, signature.as_deref())?;
    let failed = |what: &str| {
        let host = host.clone();
        let what = what.to_string();
        move |why: Failed| format!("{host}: {what}: {}; what was installed there is as it was", why.words())
    };
    remote.run(&["mkdir", "-p", &folder]).map_err(failed("no folder for packages"))?;
    remote.send(&staging.files(), &folder).map_err(failed("the copy did not arrive"))?;
    let trusted: Vec<&str> = args.trusted.iter().flat_map(|folder| ["--trusted", folder.as_str()]).collect();
    let check = [&[rig.as_str(), "check", &arrived], &trusted[..]].concat();
    let checked = remote.run(&check).map_err(failed("the package is refused"))?;
    terminal.print(&checked);
    if let Ok(found) = remote.run(&[rig, "doctor"]) {
        terminal.print(&found);
    }
    let install = [&[rig.as_str(), "install", &arrived, "--dir", dir], &trusted[..]].concat();
    let installed = remote.run(&install).map_err(failed("it could not be installed"))?;
    terminal.print(&installed);
    // What has been installed is kept under its hash; the copy has done its work.
    let signed = format!("{arrived}.{SIGNATURE}");
    let _ = remote.run(&["rm", "-f", &arrived, &signed]);
    if args.start {
        start(args, &remote, &hash(&bytes), terminal)?;
    }
    Ok(())
}

/// Starts what has been installed, and tells its state; if it refuses, the computer itself goes back to what was there.
fn start(args: &Deploy, remote: &Remote, hash: &str, terminal: &mut Terminal) -> Result<(), String> {
    let Host { host, rig, dir, .. } = &args.host;
    let said =
        remote.run(&[rig, "start", "--hash", hash, "--dir", dir]).map_err(|why| format!("{host}: {}", why.words()))?;
    terminal.print(&said);
    if args.follow || std::io::stdout().is_terminal() {
        // Whoever has seen enough presses Ctrl-C: what was asked for is done.
        let _ = ctrlc::set_handler(|| ENOUGH.store(true, Ordering::Relaxed));
        let followed = remote.follow(&[rig, "status", "--follow", "--dir", dir], &mut |line| terminal.line(line));
        return match followed {
            Err(why) if !ENOUGH.load(Ordering::Relaxed) => Err(format!("{host}: {}", why.words())),
            Ok(()) | Err(_) => Ok(()),
        };
    }
    Ok(())
}

/// Ctrl-C, once the rig runs.
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

/// The package and its signature: read, or built for the computer.
fn packed(args: &Deploy, target: &str, terminal: &mut Terminal) -> Result<(Vec<u8>, Option<String>), String> {
    let path = &args.file;
    if path.extension().is_some_and(|extension| extension == runtime::package::EXTENSION) {
        if args.name.is_some() || args.sign.is_some() || !args.set.all.is_empty() {
            return Err(format!("{} is a package: it goes as it was built, signed and set", path.display()));
        }
        let bytes = fs::read(path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
        return Ok((bytes, fs::read_to_string(beside(path)).ok()));
    }
    let wanted = super::pack::Wanted {
        name: args.name.as_deref(),
        target,
        features: &[],
        set: &args.set,
        key: args.sign.as_deref(),
    };
    super::pack::packed(path, &wanted, terminal)
}

/// A folder of this computer with the files to send, removed when it goes.
struct Staging {
    folder: PathBuf,
    paths: Vec<PathBuf>,
}

impl Staging {
    fn new(name: &str, bytes: &[u8], signature: Option<&str>) -> Result<Staging, String> {
        let folder = std::env::temp_dir().join(format!("fric-deploy-{}", std::process::id()));
        let mut staging = Staging { folder, paths: Vec::new() };
        let files = [(name.to_string(), bytes), (format!("{name}.{SIGNATURE}"), signature.unwrap_or("").as_bytes())];
        for (name, bytes) in files.into_iter().take(1 + usize::from(signature.is_some())) {
            let path = staging.folder.join(&name);
            project::write(&path, bytes).map_err(|error| format!("cannot write {}: {error}", path.display()))?;
            staging.paths.push(path);
        }
        Ok(staging)
    }

    fn files(&self) -> Vec<&Path> {
        self.paths.iter().map(PathBuf::as_path).collect()
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.folder);
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
    let all: Vec<&str> = listed.lines().filter(|name| name.ends_with(".friclog")).collect();
    let wanted: Vec<&str> = match &args.log {
        Some(name) if all.contains(&name.as_str()) => vec![name],
        Some(name) => {
            terminal.error(&format!("{host} has no log `{name}`; it has {}", all.join(", ")));
            return End::Failed;
        }
        None if args.all => all,
        None => all.into_iter().take(1).collect(),
    };
    if wanted.is_empty() {
        terminal.error(&format!("{host} has no log in {folder}"));
        return End::Failed;
    }
    for name in wanted {
        let to = args.out.join(name);
        let fetched = project::make_folder_of(&to)
            .map_err(|error| error.to_string())
            .and_then(|()| remote.fetch(&format!("{folder}/{name}"), &to).map_err(|why| why.words()));
        if let Err(why) = fetched {
            terminal.error(&format!("cannot fetch {name}: {why}"));
            return End::Failed;
        }
        terminal.line(&format!("wrote {}", to.display()));
    }
    End::Fine
}
