//! The `fric-rig` command, for the computer beside the drives.
//!
//! In: a package that `fric build` made. Out: a running rig, or the reason of a refusal. Contains no compiler: the
//! package was checked and compiled elsewhere, and is refused if a single bit of it has changed since.

#![deny(clippy::print_stdout, clippy::print_stderr, reason = "a closed pipe must not panic: see words.rs")]

mod words;

mod packed;

mod store;

mod trust;

mod doctor;

mod run;

mod drives;

mod panel;

use clap::{Parser, Subcommand, ValueHint};
use runtime::drive::serve::Doors;
use runtime::hil::line::{Door, Line};
use runtime::record::parts;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;

/// Checks and runs packed rigs
#[derive(Parser, Debug)]
#[command(name = "fric-rig", version, arg_required_else_help = true, after_help = EXIT_CODES)]
struct Args {
    #[command(subcommand)]
    command: Command,
}

const EXIT_CODES: &str =
    "Exit codes: 0 ended as asked, 1 refused or bad input, 2 wrong usage, 3 stopped by safety or a `stop` condition.";

#[derive(Subcommand, Debug)]
enum Command {
    /// Verify a package: its hashes, its target, its version, and its signature if keys are trusted
    Check(Check),
    /// Run the current package, or the one named; nothing moves before `say enable`, `say arm`
    Run(RunArgs),
    /// Run the current package in the background; fails if it ends within its first second
    Start(Start),
    /// Simulate the drives and devices of a package on a bus that other programs can reach
    Drives(Drives),
    /// Show the running rig in a browser on this computer, with its commands
    Panel(PanelArgs),
    /// Send the running rig to `fric panel USER@HOST`, and its commands here, on the standard streams
    Feed(Store),
    /// Command the running rig: enable, arm, set PATH = VALUE, mark WORDS or stop
    Say(Say),
    /// Check this computer for real time, and print what to change
    Doctor,
    /// Make a package the current one; the previous one is kept for `rollback`
    Install(Install),
    /// Make the previous package the current one again
    Rollback(Store),
    /// Print what is installed, and what runs
    Status(Status),
    /// Show the keys that are trusted, or register one: packages must then be signed
    Trust(Register),
    /// Print the target that packages must be built for
    Target,
}

#[derive(clap::Args, Debug)]
struct Check {
    /// The package
    #[arg(value_name = "FILE.fricpkg", value_hint = ValueHint::FilePath)]
    package: PathBuf,
    #[command(flatten)]
    trust: Trust,
}

#[derive(clap::Args, Debug)]
struct Keys {
    /// Folder with the public keys that are trusted; with one in it, packages must be signed
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath, default_value = runtime::package::signature::TRUSTED)]
    trusted: PathBuf,
}

#[derive(clap::Args, Debug)]
struct Trust {
    #[command(flatten)]
    keys: Keys,
    /// Run it on real buses without a trusted signature; where keys are trusted, one of them must have signed it
    #[arg(long)]
    allow_unsigned: bool,
}

#[derive(clap::Args, Debug)]
struct Register {
    /// Name of the key; without it, those that are trusted are shown
    #[arg(requires = "key")]
    name: Option<String>,
    /// The public key: the last line of a file that ends in .pub
    key: Option<String>,
    /// Only if no key is trusted yet
    #[arg(long, requires = "name")]
    first: bool,
    #[command(flatten)]
    keys: Keys,
}

#[derive(clap::Args, Debug)]
struct RunArgs {
    /// The package [default: the one that is installed]
    #[arg(value_name = "FILE.fricpkg", value_hint = ValueHint::FilePath)]
    package: Option<PathBuf>,
    /// Simulated buses, drives and devices; arms itself
    #[arg(long)]
    sim: bool,
    /// Simulated time: as fast as possible, with the same bits every time; needs --for or --check
    #[arg(long, requires = "sim")]
    fast: bool,
    /// Do the checks of the start-up and stop before arming
    #[arg(long)]
    check: bool,
    /// Time the model runs, such as 60s [default: until it is stopped]
    #[arg(long = "for", value_name = "TIME", value_parser = seconds)]
    duration: Option<f64>,
    /// Give a bus of the rig another address: can0=socketcan:can1
    #[arg(long, value_name = "BUS=ADDRESS", value_parser = address)]
    bus: Vec<(String, String)>,
    /// The log [default: DIR/log/RIG-TIME.friclog]
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    log: Option<PathBuf>,
    /// Open a panel for browsers beside it, in a process of its own
    #[arg(long, conflicts_with_all = ["fast", "check"])]
    panel: bool,
    /// Port of the panel on this computer; if it is taken, the next free one
    #[arg(long, value_name = "PORT", requires = "panel", default_value_t = ::panel::server::PORT)]
    port: u16,
    /// Others may look at the panel at this address of this computer, and stop the rig: they have a link of their own
    #[arg(long, value_name = "ADDR:PORT", requires = "panel", value_parser = listening)]
    share: Option<SocketAddr>,
    /// Stop the rig if no page of any panel has been drawn for this time, such as 2s; it is armed only once one is
    #[arg(long, value_name = "TIME", value_parser = dead_man, conflicts_with_all = ["fast", "check"])]
    dead_man: Option<f64>,
    #[command(flatten)]
    sizes: Sizes,
    #[command(flatten)]
    store: Store,
    #[command(flatten)]
    trust: Trust,
}

#[derive(clap::Args, Debug)]
struct PanelArgs {
    /// Port on this computer; if it is taken, the next free one
    #[arg(long, value_name = "PORT", default_value_t = ::panel::server::PORT)]
    port: u16,
    /// Others may look at this address of this computer, and stop the rig: they have a link of their own
    #[arg(long, value_name = "ADDR:PORT", value_parser = listening)]
    share: Option<SocketAddr>,
    /// Curves in memory; what is older is left out
    #[arg(long, value_name = "SIZE", value_parser = parts::bytes, default_value = "256MB")]
    keep: u64,
    /// It is the child of `run --panel`
    #[arg(long, hide = true)]
    of_run: bool,
    #[command(flatten)]
    store: Store,
    #[command(flatten)]
    keys: Keys,
}

#[derive(clap::Args, Debug)]
struct Sizes {
    /// Begin a new file, RIG-TIME.2.friclog, after this many bytes of log
    #[arg(long, value_name = "SIZE", value_parser = parts::bytes, default_value = "256MB")]
    roll: u64,
    /// Remove the oldest logs in the folder of the log, so that all together have at most this many bytes [default: keep all]
    #[arg(long, value_name = "SIZE", value_parser = parts::bytes)]
    keep: Option<u64>,
}

impl Sizes {
    fn limits(&self) -> parts::Limits {
        parts::Limits { part: self.roll, keep: self.keep, ..Default::default() }
    }
}

#[derive(clap::Args, Debug)]
struct Drives {
    /// The package
    #[arg(value_name = "FILE.fricpkg", value_hint = ValueHint::FilePath)]
    package: PathBuf,
    /// Serve them at another address: can0=socketcan:can1
    #[arg(long, value_name = "BUS=ADDRESS", value_parser = address)]
    bus: Vec<(String, String)>,
    /// Open a pseudo-terminal with the slcan protocol, and a link to it at this path
    #[arg(long, value_name = "PATH", value_hint = ValueHint::FilePath)]
    pty: Vec<PathBuf>,
    /// Open a TCP port with the socketcand protocol, 0 for a free one
    #[arg(long, value_name = "PORT")]
    tcp: Option<u16>,
    /// Inject faults: 'load fault 0x2310 at 3 s', 'panel.enable = 0 at 5 s'
    #[arg(long, value_name = "FAULT")]
    inject: Vec<String>,
    /// Seed of all random numbers
    #[arg(long, value_name = "NUMBER", default_value_t = 1)]
    seed: u64,
    /// End after this time, such as 10s [default: Ctrl-C]
    #[arg(long = "for", value_name = "TIME", value_parser = seconds)]
    duration: Option<f64>,
    /// Do not print changes of their states
    #[arg(long, short)]
    quiet: bool,
    #[command(flatten)]
    keys: Keys,
}

#[derive(clap::Args, Debug)]
struct Say {
    /// enable, arm, stop; or a set of parameters, `set fr.Fs = 0.5 N·m, fr.Fc = 0.3 N·m`: it is applied as a whole or refused; `mark WORDS` writes
    /// words into its log
    #[arg(value_name = "COMMAND", required = true, allow_negative_numbers = true)]
    what: Vec<String>,
    #[command(flatten)]
    store: Store,
}

#[derive(clap::Args, Debug)]
struct Install {
    /// The package
    #[arg(value_name = "FILE.fricpkg", value_hint = ValueHint::FilePath)]
    package: PathBuf,
    /// Install it even if it was signed before the one that is installed
    #[arg(long)]
    allow_older: bool,
    #[command(flatten)]
    store: Store,
    #[command(flatten)]
    trust: Trust,
}

#[derive(clap::Args, Debug)]
struct Start {
    /// SHA-256 of the package that must be the current one: else the rig has gone back from it
    #[arg(long)]
    hash: Option<String>,
    #[command(flatten)]
    sizes: Sizes,
    #[command(flatten)]
    store: Store,
    #[command(flatten)]
    trust: Trust,
}

#[derive(clap::Args, Debug)]
struct Status {
    /// Go on telling the state of the rig that runs until it ends, or Ctrl-C; that does not end the rig
    #[arg(long)]
    follow: bool,
    #[command(flatten)]
    store: Store,
}

#[derive(clap::Args, Debug)]
struct Store {
    /// Folder of the packages and logs
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath, default_value = store::DEFAULT)]
    dir: PathBuf,
}

/// Parses a time with its unit: `60s`, `500 ms`.
fn seconds(text: &str) -> Result<f64, String> {
    let at = text.find(|c: char| c.is_ascii_alphabetic()).ok_or("a time needs its unit, for example 60s")?;
    let unit = abi::unit::Unit::parse(text[at..].trim()).map_err(|part| format!("`{part}` is not a known unit"))?;
    let number: f64 = text[..at].trim().parse().map_err(|_| format!("`{}` is not a number", &text[..at]))?;
    let second = abi::unit::Unit::parse("s").expect("the second is known");
    match unit.to_si(number) {
        t if unit.dimension == second.dimension && t > 0.0 && t.is_finite() => Ok(t),
        _ => Err("a time greater than 0 is needed, for example 60s".into()),
    }
}

/// An address at which others may look.
fn listening(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| "write an address of this computer with a port, for example 192.168.1.20:7421".into())
}

/// The time of a dead man's switch. Logs are written ten times a second, so a picture may be some tenths of a second old.
fn dead_man(text: &str) -> Result<f64, String> {
    let time = seconds(text)?;
    if time >= 0.5 { Ok(time) } else { Err("0.5 s or more is needed: pictures come ten times a second at best".into()) }
}

fn address(text: &str) -> Result<(String, String), String> {
    let (bus, address) = text.split_once('=').ok_or("write it as BUS=ADDRESS, for example can0=socketcan:can1")?;
    Ok((bus.into(), address.into()))
}

/// Opens a package that may run here, on the buses that it names.
fn opened(package: &std::path::Path, trust: &Trust) -> Result<packed::Open, String> {
    let open = packed::open(package, &trust.keys.trusted)?;
    let may = open.may_run(&open.contents.rig.buses, false, trust.allow_unsigned);
    may.map_err(|why| format!("{}: {why}", package.display()))?;
    Ok(open)
}

/// Makes a package the current one.
fn installed(args: &Install) -> Result<String, String> {
    let open = opened(&args.package, &args.trust)?;
    let store = store::Store::at(&args.store.dir);
    if let Some(current) = store.current().filter(|_| !args.allow_older) {
        let newer = packed::not_older(&open, &current, &args.trust.keys.trusted);
        newer.map_err(|why| format!("{}: {why}", args.package.display()))?;
    }
    store.install(&open.package.rig, &open.bytes, open.signature.as_deref())
}

/// Serves the drives of a package.
fn served(args: &Drives) -> Result<u8, String> {
    let open = packed::open(&args.package, &args.keys.trusted)?;
    let doors = Doors {
        buses: args.bus.clone(),
        pty: args.pty.clone(),
        tcp: args.tcp,
        sheets: Vec::new(),
        inject: args.inject.clone(),
        seed: args.seed,
    };
    drives::drives(&open, &doors, args.duration, args.quiet)
}

/// Runs a package.
fn ran(args: &RunArgs) -> Result<u8, String> {
    let wanted = run::RunArguments {
        package: args.package.as_deref(),
        trusted: &args.trust.keys.trusted,
        allow_unsigned: args.trust.allow_unsigned,
        dir: &args.store.dir,
        sim: args.sim,
        fast: args.fast,
        check: args.check,
        duration: args.duration,
        buses: &args.bus,
        log: args.log.as_deref(),
        limits: args.sizes.limits(),
        panel: args.panel.then_some(args.port),
        share: args.share,
        dead_man: args.dead_man,
    };
    run::run(&wanted)
}

/// The exit code of a command that runs for a while: its own one, or that of a failure.
fn ended(code: Result<u8, String>) -> ExitCode {
    match code {
        Ok(code) => ExitCode::from(code),
        Err(why) => {
            words::error(&why);
            ExitCode::from(1)
        }
    }
}

fn main() -> ExitCode {
    let args = Args::parse();
    let done = match &args.command {
        Command::Check(check) => opened(&check.package, &check.trust).map(|open| open.describe()),
        Command::Run(run) if run.fast && !run.check && run.duration.is_none() => {
            // Nobody can send `stop` to it, and hours of simulated time fill a disk within minutes.
            words::error("--fast needs --for: how much simulated time? For example `--for 60s`");
            return ExitCode::from(2);
        }
        Command::Run(run) => return ended(ran(run)),
        Command::Drives(drives) => return ended(served(drives)),
        Command::Panel(args) => {
            let PanelArgs { port, share, keep, of_run, store, keys } = args;
            let (dir, trusted) = (&store.dir, &keys.trusted);
            return ended(panel::panel(&panel::PanelArguments {
                dir,
                trusted,
                port: *port,
                share: *share,
                keep: *keep,
                of_run: *of_run,
            }));
        }
        Command::Feed(store) => return ended(panel::feed(&store.dir)),
        Command::Start(start) => {
            let trust = run::Trust { trusted: &start.trust.keys.trusted, allow_unsigned: start.trust.allow_unsigned };
            run::start(&start.store.dir, start.hash.as_deref(), trust, start.sizes.limits())
        }
        Command::Say(say) => {
            let text = say.what.join(" ");
            let refused = |why: &String| format!("`{}` is refused: {why}", text.trim());
            match Line::read(&text).map_err(|why| refused(&why)) {
                Ok(line) => {
                    line.at(Door::Say).map_err(|why| refused(&why)).and_then(|line| run::say(&say.store.dir, &line))
                }
                Err(why) => {
                    words::error(&why);
                    return ExitCode::from(2);
                }
            }
        }
        Command::Doctor => Ok(doctor::doctor()),
        Command::Install(install) => installed(install),
        Command::Rollback(store) => store::Store::at(&store.dir).rollback(),
        Command::Status(status) if status.follow => run::follow(&status.store.dir),
        Command::Status(status) => store::Store::at(&status.store.dir).status(),
        Command::Trust(Register { name: Some(name), key: Some(key), first, keys }) => {
            trust::register(&keys.trusted, name, key, *first)
        }
        Command::Trust(Register { keys, .. }) => trust::keys(&keys.trusted),
        Command::Target => Ok(format!("{}\n", runtime::package::here())),
    };
    match done {
        Ok(text) => {
            words::print(&text);
            ExitCode::SUCCESS
        }
        Err(why) => {
            words::error(&why);
            ExitCode::from(1)
        }
    }
}
