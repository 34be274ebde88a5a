//! What can be typed: every command, option and value in one tree.
//!
//! Help, completions and the man page are made from it. Values with units are read here, so that a wrong one is wrong
//! usage and not a failed run.

use crate::compile::{self, Changes, Emit, Idle};
use crate::plot::{self, Figure, Lines};
use crate::quantity;
use crate::vary::{self, Vary};
use abi::image::{Feature, Target};
use abi::plan::Method;
use abi::unit::{Dimension, Unit};
use clap::{CommandFactory, Parser, Subcommand, ValueHint};
use runtime::can::address::Address;
use std::path::PathBuf;

/// A small equation language for friction models, controllers and the rigs they run on.
#[derive(Parser, Debug)]
#[command(name = "fric", version, after_help = EXIT_CODES)]
pub struct Args {
    /// What to do; a session at the prompt if nothing is said.
    #[command(subcommand)]
    pub command: Option<Command>,
}

/// The arguments, the name of the program first; ends the process with a message if they are wrong, or if they ask for help.
pub fn parse(arguments: impl IntoIterator<Item = std::ffi::OsString>) -> Args {
    Args::parse_from(arguments)
}

/// A script that completes the commands and options in a shell.
pub fn completions(shell: clap_complete::Shell) -> String {
    let mut out = Vec::new();
    clap_complete::generate(shell, &mut Args::command(), "fric", &mut out);
    String::from_utf8_lossy(&out).into_owned()
}

/// The manual page of the program, or of one of its commands.
pub fn man(command: Option<&str>) -> String {
    let (mut out, mut tree) = (Vec::new(), Args::command());
    // Only a built command tree knows the full name `fric run`.
    tree.build();
    let page = command.and_then(|name| tree.find_subcommand(name)).unwrap_or(&tree).clone();
    let name = command.map_or("fric".into(), |name| format!("fric-{name}"));
    let rendered = clap_mangen::Man::new(page).title(name).render(&mut out);
    rendered.expect("writing to memory does not fail");
    String::from_utf8_lossy(&out).into_owned()
}

/// The manual pages of the program and of all its commands: name of the file, and page.
pub fn man_pages() -> Vec<(String, String)> {
    let commands = Args::command();
    let names = commands.get_subcommands().map(|command| command.get_name().to_string());
    let page = |name: String| (format!("fric-{name}.1"), man(Some(&name)));
    std::iter::once(("fric.1".to_string(), man(None))).chain(names.map(page)).collect()
}

const EXIT_CODES: &str = "Exit codes: 0 fine, 1 the input or an expectation failed, 2 wrong usage,\n\
    3 a rig was stopped by safety or a condition of its own.\n\
    Colour and progress appear on a terminal only; NO_COLOR=1 turns colour off.";

/// One command.
#[derive(Subcommand, Debug)]
pub enum Command {
    /// Compile and run experiments, draw their plots, check what they expect
    Run(Run),
    /// Run every experiment that has an `expect`; last line: `N passed, N failed`
    Test(Test),
    /// Run an experiment many times under other parameters: grids and Monte Carlo
    Sweep(Sweep),
    /// Find the parameters with which a model follows a recording, with intervals
    Fit(Fit),
    /// Design the motion that makes the unknowns of a fit most certain, within limits
    Excite(Excite),
    /// A, B, C, D and the modes of a model or an experiment at a point
    Linearise(Linearise),
    /// Time the step of an experiment: alone, in lanes, on all cores
    Bench(Bench),
    /// Export a model as C, machine code or a function for Python, or a rig as a package
    Build(Build),
    /// Run a rig against the drives on its buses, or with --sim against simulated ones
    Hil(Hil),
    /// Predict whether a rig is stable, and its accuracy, before anything moves
    Predict(Predict),
    /// Recompute a rig's log and compare every output, to the bit
    Replay(Replay),
    /// Report errors and warnings without running anything
    Check(Check),
    /// Rewrite files in the one canonical layout
    Fmt(Fmt),
    /// Explain an error code with an example, or a model
    Explain(Explain),
    /// Characterise a friction model by the standard battery and write a report
    Characterise(Characterise),
    /// Compare several friction models by the battery, on shared axes
    Compare(Compare),
    /// Write the reference page of the library's models from its text
    Doc(Doc),
    /// Simulate the drives and devices of a rig on a bus that other programs can reach
    Drives(Drives),
    /// Interactive prompt; also what `fric` alone starts
    Repl(Repl),
    /// Rerun an experiment at each save, with its states carried over
    Watch(Watch),
    /// See a simulation change under the hand, or look through a recording, in a browser
    Panel(Panel),
    /// Show everything in a package, and verify it
    Inspect(Inspect),
    /// Create keys to sign packages with
    Key {
        /// What to do
        #[command(subcommand)]
        command: Key,
    },
    /// Install a rig on the computer that runs it: build, copy, check there, swap atomically
    Deploy(Deploy),
    /// Copy recordings from the computer that runs a rig
    FetchLog(FetchLog),
    /// Bridge CAN buses, open ports to them, and print their traffic
    Bus(Bus),
    /// Check this machine for real time, with the command that fixes each problem
    Doctor(Doctor),
    /// Measure the wake-up latency of a loop like that of a rig
    BenchRt(BenchRt),
    /// Create a folder with a first model and its experiment
    New(New),
    /// Print completions for a shell
    Completions {
        /// Which shell
        shell: clap_complete::Shell,
    },
    /// Print the manual page of fric, or of one of its commands
    Man {
        /// Such as run
        #[arg(value_parser = [
            "run", "test", "sweep", "fit", "excite", "linearise", "bench", "build", "hil", "replay", "check", "fmt", "explain",
            "characterise", "compare", "doc", "repl", "watch", "panel", "inspect", "key", "deploy", "fetch-log", "drives",
            "bus", "doctor", "predict", "bench-rt", "new", "completions",
        ])]
        command: Option<String>,
        /// Write the pages of fric and of all its commands into this folder: fric.1, fric-run.1, …
        #[arg(long, value_name = "DIR", conflicts_with = "command", value_hint = ValueHint::DirPath)]
        dir: Option<PathBuf>,
    },
}

/// What of a text is changed before it is compiled.
#[derive(clap::Args, Clone, Debug)]
pub struct Set {
    /// Change a parameter, an input, the start value of a state or a slot: `fr.Fs=2N`, `fr.z=1um`, `fr=Karnopp()`
    #[arg(long = "set", value_name = "PATH=VALUE", value_parser = setting)]
    pub all: Vec<(String, String)>,
}

impl Set {
    /// As the compiler reads them: `fr.Fs=2N`.
    pub fn texts(&self) -> Vec<String> {
        self.all.iter().map(|(path, value)| format!("{path}={value}")).collect()
    }

    /// The changes that they are.
    pub fn changes(&self) -> Changes {
        Changes { set: self.texts(), ..Changes::default() }
    }
}

/// Changes, and how steps are made.
#[derive(clap::Args, Debug)]
pub struct Stepped {
    /// Changes to the text
    #[command(flatten)]
    pub set: Set,
    /// Solver in place of the experiment's own
    #[arg(long, value_name = "NAME", value_parser = solver)]
    pub solver: Option<Method>,
    /// Fixed step, such as 10us
    #[arg(long, value_name = "TIME", value_parser = positive_time)]
    pub step: Option<f64>,
}

/// Why one of these options would be without effect on a run by this method: steps are fixed or adaptive. `given`: the
/// method of the command line.
fn without_effect(
    name: &str,
    method: Method,
    (given, step, tol): (Option<Method>, Option<f64>, Option<f64>),
) -> Option<String> {
    match (compile::idle(method, step, tol)?, given) {
        (Idle::Step, Some(_)) => {
            Some("--step is for fixed steps, and `--solver adaptive` chooses its own: leave one of them out".into())
        }
        (Idle::Step, None) => Some(format!(
            "--step is for fixed steps, and `{name}` is run by adaptive ones: add `--solver expo`, which is exact for \
             bristles and filters, or another of {}; or leave it out",
            Method::list(Method::fixed())
        )),
        (Idle::Tolerance, _) => Some(format!(
            "--tol is for adaptive steps, and `{name}` takes fixed ones of `{}`: add `--solver adaptive`, or leave it out",
            method.name()
        )),
    }
}

impl Stepped {
    /// Why one of them would be without effect on an experiment that is run by this method.
    pub fn without_effect(&self, name: &str, method: Method) -> Option<String> {
        without_effect(name, method, (self.solver, self.step, None))
    }

    /// The same of them and a tolerance.
    pub fn without_effect_and(&self, tol: Option<f64>, name: &str, method: Method) -> Option<String> {
        without_effect(name, method, (self.solver, self.step, tol))
    }

    /// The changes to an experiment that they are.
    pub fn changes(&self) -> Changes {
        Changes { method: self.solver, step: self.step, ..self.set.changes() }
    }
}

/// All that can be changed of an experiment.
#[derive(clap::Args, Debug)]
pub struct Changed {
    /// Changes to the text, and the solver
    #[command(flatten)]
    pub stepped: Stepped,
    /// Relative tolerance of an adaptive run, such as 1e-8
    #[arg(long, value_name = "NUMBER", value_parser = tolerance)]
    pub tol: Option<f64>,
    /// Simulated time, such as 20s
    #[arg(long = "for", value_name = "TIME", value_parser = positive_time)]
    pub duration: Option<f64>,
}

impl Changed {
    /// The changes to an experiment that they are.
    pub fn changes(&self) -> Changes {
        Changes { tol: self.tol, duration: self.duration, ..self.stepped.changes() }
    }
}

/// How far results may be off, and how they are shown.
#[derive(clap::Args, Clone, Copy, Debug)]
pub struct Trust {
    /// Leave out the companion runs that estimate the numerical error of each measure
    #[arg(long)]
    pub no_error: bool,
    /// Show up to this many significant digits [default: 6, and 9 where an error stands beside them]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=17))]
    pub digits: Option<u8>,
}

/// Timings.
#[derive(clap::Args, Clone, Copy, Debug)]
pub struct Timed {
    /// Print the time of each stage to the standard error
    #[arg(long)]
    pub timings: bool,
}

/// How a figure is drawn.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct Look {
    /// Size of the figure in print, such as 85x60mm; it then has no title unless --title says one
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = size)]
    pub size: Option<(f64, f64)>,
    /// Size of its letters, such as 8pt [default: 10pt, and 8pt with --size]
    #[arg(long, value_name = "SIZE", value_parser = font)]
    pub font: Option<f64>,
    /// What tells its curves apart; dashes and grey have markers too [default: colour]
    #[arg(long, value_name = "WITH", value_parser = ["colour", "dashes", "grey"])]
    pub lines: Option<String>,
    /// Panels side by side [default: 1]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=6))]
    pub columns: Option<u8>,
    /// Its title in place of name and solver; "" for none, and no names of experiments over its panels
    #[arg(long, value_name = "TEXT")]
    pub title: Option<String>,
}

/// Figures of a report as files.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct Figures {
    /// Write each figure of the page as a file beside it
    #[arg(long, value_name = "KIND", value_parser = ["pdf", "svg", "png"])]
    pub figures: Option<String>,
    /// How they are drawn
    #[command(flatten)]
    pub look: Look,
}

impl Figures {
    /// Name and bytes of each file, if any are requested.
    pub fn files(&self, drawn: impl FnOnce() -> Vec<(String, Figure)>) -> Vec<(String, Vec<u8>)> {
        let Some(ending) = &self.figures else { return Vec::new() };
        let file = |(name, figure): (String, Figure)| {
            let name = format!("{name}.{ending}");
            let kind = plot::Kind::of(std::path::Path::new(&name)).unwrap_or(plot::Kind::Svg);
            let bytes = plot::picture(&self.look.titled(figure), &self.look.look(), kind);
            (name, bytes)
        };
        drawn().into_iter().map(file).collect()
    }
}

impl Look {
    /// The first of these options that is given: without a figure it would be without effect.
    pub fn given(&self) -> Option<&'static str> {
        let given = [
            (self.size.is_some(), "--size"),
            (self.font.is_some(), "--font"),
            (self.lines.is_some(), "--lines"),
            (self.columns.is_some(), "--columns"),
            (self.title.is_some(), "--title"),
        ];
        given.into_iter().find(|(given, _)| *given).map(|(_, option)| option)
    }

    /// Why an option is without effect where no figure is written; `remedy`: the option that writes one.
    pub fn unused(&self, drawn: bool, remedy: &str) -> Option<String> {
        let option = self.given().filter(|_| !drawn)?;
        Some(format!("{option} is for a figure, and none is written: add {remedy}"))
    }

    /// As the renderers read it.
    pub fn look(&self) -> plot::Look {
        let usual = plot::Look::default();
        let font = self.font.unwrap_or(if self.size.is_some() { 8.0 / 0.75 } else { usual.font });
        let columns = self.columns.map_or(usual.columns, usize::from);
        let lines = match self.lines.as_deref() {
            Some("dashes") => Lines::Dashes,
            Some("grey") => Lines::Grey,
            Some(_) | None => usual.lines,
        };
        plot::Look { size: self.size, font, lines, columns }
    }

    /// A figure with the title that it is given; in print it has none by default.
    pub fn titled(&self, figure: Figure) -> Figure {
        match (&self.title, self.size) {
            (Some(title), _) => Figure { title: title.clone(), subtitle: String::new(), ..figure },
            (None, Some(_)) => Figure { title: String::new(), subtitle: String::new(), ..figure },
            (None, None) => figure,
        }
    }
}

/// `fric run`
#[derive(clap::Args, Debug)]
pub struct Run {
    /// The text to run; `-` is the standard input
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// Experiments in it; all if none is named
    pub experiments: Vec<String>,
    /// Changes to the experiment
    #[command(flatten)]
    pub changed: Changed,
    /// Folder for a plot (SVG) and the data (CSV) of each experiment [default: out, unless --plot, --data or --json]
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub out: Option<PathBuf>,
    /// Write the plot of one experiment to this file: .svg, .png or .pdf; `-` is the standard output
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath, value_parser = picture)]
    pub plot: Option<PathBuf>,
    /// How it is drawn
    #[command(flatten)]
    pub look: Look,
    /// Write the data of one experiment, a row for each step: .csv, .parquet, .mat (MATLAB) or .npz (NumPy); `-` is the standard output, as CSV
    #[arg(long, alias = "csv", value_name = "FILE", value_hint = ValueHint::FilePath, value_parser = data)]
    pub data: Option<PathBuf>,
    /// Show the plot that was written with the program that the desktop has for it
    #[arg(long)]
    pub open: bool,
    /// Interval between rows of the data, such as 1ms, instead of one row per step
    #[arg(long, value_name = "TIME", value_parser = positive_time)]
    pub every: Option<f64>,
    /// Only as many rows of the data as a plot needs: some thousands, with every minimum and maximum
    #[arg(long, conflicts_with = "every")]
    pub thin: bool,
    /// Print one JSON object per run, one a line, instead of text and plots
    #[arg(long)]
    pub json: bool,
    /// Repeat it with another solver and print the difference of the two
    #[arg(long)]
    pub cross: bool,
    /// Numerical errors
    #[command(flatten)]
    pub trust: Trust,
    /// Print failures only
    #[arg(long, short, conflicts_with = "json")]
    pub quiet: bool,
    /// Interpret instead of compiling to machine code: same bits, slower
    #[arg(long)]
    pub interpret: bool,
    /// Timings
    #[command(flatten)]
    pub timed: Timed,
}

/// `fric test`
#[derive(clap::Args, Debug)]
pub struct Test {
    /// Texts, or folders to look through for them
    #[arg(required = true, value_name = "FILE|DIR", value_hint = ValueHint::AnyPath)]
    pub paths: Vec<PathBuf>,
    /// Repeat each with another solver: its expectations must hold there too
    #[arg(long)]
    pub cross: bool,
    /// Numerical errors
    #[command(flatten)]
    pub trust: Trust,
    /// Print failures and the last line only
    #[arg(long, short)]
    pub quiet: bool,
    /// Interpret instead of compiling to machine code: same bits, slower
    #[arg(long)]
    pub interpret: bool,
    /// Timings
    #[command(flatten)]
    pub timed: Timed,
}

/// Options that a plan contains.
const PLANNED: [&str; 13] =
    ["design", "keep", "vary", "best", "runs", "seed", "all", "solver", "step", "tol", "duration", "shard", "resume"];
/// Options of a sweep that runs.
const RUNNING: [&str; 9] = ["out", "resume", "shard", "threads", "plot", "no_error", "interpret", "unit", "join"];

/// What a sweep keeps of its runs.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, clap::ValueEnum)]
pub enum Keep {
    /// A row for each run
    #[default]
    Rows,
    /// For each point of the grids and each measure: mean, deviation, quantiles, a histogram, the outermost rows
    Summary,
    /// The table, and beside it the statistics as .json
    Both,
}

impl Keep {
    /// Whether there is a table.
    pub fn rows(self) -> bool {
        self != Keep::Summary
    }

    /// Whether there are statistics.
    pub fn statistics(self) -> bool {
        self != Keep::Rows
    }

    /// Its name as it is typed.
    pub fn name(self) -> &'static str {
        match self {
            Keep::Rows => "rows",
            Keep::Summary => "summary",
            Keep::Both => "both",
        }
    }

    /// All of them.
    pub const ALL: [Keep; 3] = [Keep::Rows, Keep::Summary, Keep::Both];
}

/// `fric sweep`
#[derive(clap::Args, Debug)]
pub struct Sweep {
    /// The text; with --unit and --join the plan
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// The experiment in it to run; with --join the files of the units
    #[arg(value_name = "EXPERIMENT", value_hint = ValueHint::AnyPath)]
    pub rest: Vec<PathBuf>,
    /// What changes: 'fr.Fs = 1 N .. 2 N by 0.1 N', 'k = 1 N/m .. 100 N/m log 9', 'm = 1 kg, 2 kg'; 'fr.Fs = ±20 %' of its
    /// value, also 'lin 5'; 'x.k, y.k = 1 N/m, 2 N/m' together; 'fr = LuGre(), Dahl()' for a slot; 'fr.vs ~ lognormal(1 mm/s,
    /// 0.2)', also normal, uniform, '~ ±20 %'
    #[arg(long, value_name = "CHANGE", value_parser = vary::parse)]
    pub vary: Vec<Vary>,
    /// Runs of your own: a table .csv with a column for each quantity, such as `fr.Fs [N]`, and a row for each combination
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub design: Option<PathBuf>,
    /// Print the K best rows: '5 by rms(e)', '3 by greatest period(x)'; of distributions by the mean, or '5 by p95 rms(e)'
    #[arg(long, value_name = "K by MEASURE", num_args = 1..=5)]
    pub best: Vec<String>,
    /// Draws of the distributions, at each point of the grids [default: 100]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1_000_000_000))]
    pub runs: Option<u64>,
    /// Seed of all random numbers [default: 1]
    #[arg(long, value_name = "NUMBER")]
    pub seed: Option<u64>,
    /// The table to write: .csv or .parquet; without ending a dataset, a folder of Parquet files; with --unit any name
    /// [default: sweep.csv, with --keep summary sweep.json, with --unit runs-A-B.fricunit]
    #[arg(long, short, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub out: Option<PathBuf>,
    /// What is kept: the rows; or statistics alone, as .json, for more runs than a disk holds; or both
    #[arg(long, value_name = "WHAT", value_enum)]
    pub keep: Option<Keep>,
    /// Continue an unfinished table
    #[arg(long)]
    pub resume: bool,
    /// Run it on a cluster, dask://host:8786 or ray://host:10001; for the command of the Python package
    #[arg(long, value_name = "ADDRESS")]
    pub on: Option<String>,
    /// Compute one of N parts; the tables of all parts in order are that of the whole
    #[arg(long, value_name = "I/N", value_parser = shard)]
    pub shard: Option<(u64, u64)>,
    /// Write the sweep as a plan, a file with all that it needs, and run nothing
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath, conflicts_with_all = RUNNING)]
    pub plan: Option<PathBuf>,
    /// Run a part of a plan, on any machine: runs 0..1000, unit 2/8 of 8 from 0 on, or %j/8 in an array of tasks
    #[arg(long, value_name = "A..B | J/N", conflicts_with_all = PLANNED, conflicts_with_all = ["join", "plan", "plot"])]
    pub unit: Option<String>,
    /// Join the units of a plan: the same bytes as the sweep on one machine
    #[arg(long, conflicts_with_all = PLANNED, conflicts_with = "plan")]
    pub join: bool,
    /// Print the runs that no unit has, as ranges for --unit
    #[arg(long, requires = "join")]
    pub missing: bool,
    /// Threads [default: one for each core]
    #[arg(long, value_name = "N", value_parser = threads)]
    pub threads: Option<usize>,
    /// Plot measures over a parameter: .svg, .png or .pdf
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath, value_parser = picture)]
    pub plot: Option<PathBuf>,
    /// How it is drawn
    #[command(flatten)]
    pub look: Look,
    /// Measure to plot, as written: 'period(x)' [default: all]
    #[arg(long, value_name = "MEASURE", requires = "plot")]
    pub show: Option<String>,
    /// Parameter of the horizontal axis [default: the first]
    #[arg(long, value_name = "PATH", requires = "plot")]
    pub against: Option<String>,
    /// Changes to the experiment
    #[command(flatten)]
    pub changed: Changed,
    /// Leave out the companion runs that estimate the numerical errors of ten of the runs
    #[arg(long)]
    pub no_error: bool,
    /// Print nothing but errors
    #[arg(long, short)]
    pub quiet: bool,
    /// Interpret instead of compiling to machine code: same bits, slower
    #[arg(long)]
    pub interpret: bool,
}

/// Probability with which an interval of a fit holds the true value, if none is given.
pub const LEVEL: f64 = 0.95;
/// Number of starts of a fit, if none is given.
pub const STARTS: usize = 64;
/// The same, if the model has regimes.
pub const STARTS_WITH_REGIMES: usize = 256;
/// Pieces into which the recordings of a fit are divided.
pub const PIECES: usize = 4;

/// `fric fit`
#[derive(clap::Args, Debug)]
pub struct Fit {
    /// The text; or a recording alone, such as bench.csv with the heading `t [s],v [mm/s],F [N]`: then the standard laws
    /// are fitted and ranked
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// The fits in it to find the parameters of [default: all]
    #[arg(value_name = "FIT")]
    pub fits: Vec<String>,
    /// Fit other recordings with the same columns
    #[arg(long, value_name = "FILE,…", value_delimiter = ',', value_hint = ValueHint::FilePath)]
    pub data: Vec<PathBuf>,
    /// Probability with which an interval holds the true value
    #[arg(long, value_name = "PERCENT", default_value = "95%", value_parser = level)]
    pub level: f64,
    /// Number of starts that are judged: the one in the text, and others all over the ranges [default: 64, or 256 if the
    /// model has regimes]
    #[arg(long, value_name = "N", value_parser = starts)]
    pub starts: Option<usize>,
    /// Seed of the other starts
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// Judge the values as they are written, and search for nothing
    #[arg(long)]
    pub check: bool,
    /// Parameters whose profile is computed: how the misfit grows when the parameter is held and the others are fitted
    /// again; or all, or none [default: those that end at a bound, or that the data do not determine]
    #[arg(long, value_name = "PATH,…|all|none", value_delimiter = ',')]
    pub profile: Vec<String>,
    /// Pieces of the recordings that are also fitted each, to see whether the values drift; 1 for none
    #[arg(long, value_name = "K", default_value_t = PIECES, value_parser = pieces)]
    pub pieces: usize,
    /// Let differences beyond 1.345 standard deviations count by their size and not by its square (Huber): outliers then
    /// decide little
    #[arg(long)]
    pub robust: bool,
    /// Threads; the answer does not depend on their number [default: one for each processor]
    #[arg(long, value_name = "N", value_parser = threads)]
    pub threads: Option<usize>,
    /// Go on with a fit that was interrupted, from its last stage: the answer has the same bytes
    #[arg(long)]
    pub resume: bool,
    /// Write NAME.html too: figures of residuals and profiles, with every number
    #[arg(long)]
    pub report: bool,
    /// What of the text is changed, and how steps are made
    #[command(flatten)]
    pub stepped: Stepped,
    /// Relative tolerance of an adaptive run, such as 1e-9
    #[arg(long, value_name = "NUMBER", value_parser = tolerance)]
    pub tol: Option<f64>,
    /// Folder of the files that are written: NAME.fric with the values found, NAME.json, NAME.csv and, of what the fit plots, NAME.svg
    #[arg(long, value_name = "DIR", default_value = "out", value_hint = ValueHint::DirPath)]
    pub out: PathBuf,
    /// One JSON object for each fit, and no files
    #[arg(long)]
    pub json: bool,
    /// Warnings count as failures
    #[arg(long)]
    pub strict: bool,
    /// Print nothing but errors
    #[arg(long, short)]
    pub quiet: bool,
    /// Interpret instead of making machine code: slow, for comparison
    #[arg(long)]
    pub interpret: bool,
}

/// `fric excite`
#[derive(clap::Args, Debug)]
pub struct Excite {
    /// The text
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// The fit whose unknowns are to be determined; its recording need not exist [default: the only one]
    #[arg(value_name = "FIT")]
    pub fit: Option<String>,
    /// How long the motion is, after one period in which it is faded in
    #[arg(long = "for", value_name = "TIME", value_parser = positive_time)]
    pub duration: f64,
    /// Limits of what moves, such as 'x = -2 mm .. 2 mm' and 'v = -50 mm/s .. 50 mm/s', at least one; and of any quantity of
    /// the model, such as 'fr.F = -2 N .. 2 N'
    #[arg(long = "limit", value_name = "NAME = LOW .. HIGH", required = true)]
    pub limits: Vec<String>,
    /// Number of harmonics of the lowest frequency
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = harmonics)]
    pub harmonics: usize,
    /// The lowest frequency
    #[arg(long, value_name = "FREQUENCY", default_value = "1Hz", value_parser = any_frequency)]
    pub base: f64,
    /// Rows in each second of the recording
    #[arg(long, value_name = "FREQUENCY", default_value = "1kHz", value_parser = frequency)]
    pub rate: f64,
    /// Values of a fit so far, out/NAME.json: the next best experiment [default: 8 sets of values all over the ranges]
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub known: Option<PathBuf>,
    /// Motions that are judged
    #[arg(long, value_name = "N", default_value_t = 600)]
    pub evaluations: usize,
    /// Seed of the motions and of the sets of values
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// Threads; the answer does not depend on their number [default: one for each processor]
    #[arg(long, value_name = "N", value_parser = threads)]
    pub threads: Option<usize>,
    /// The text that is written, with a model `Excite`; beside it a table of the same name, .csv
    #[arg(long, short, value_name = "FILE", default_value = "excite.fric", value_hint = ValueHint::FilePath)]
    pub output: PathBuf,
    /// One JSON object in place of words
    #[arg(long)]
    pub json: bool,
    /// Print nothing but errors
    #[arg(long, short)]
    pub quiet: bool,
}

/// `fric linearise`
#[derive(clap::Args, Debug)]
pub struct Linearise {
    /// The text
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// A model, with its inputs free, or an experiment
    #[arg(value_name = "MODEL|EXPERIMENT")]
    pub name: String,
    /// States, free inputs, parameters and regimes at the point: 'v=0.1m/s,fr.z=2um,fr=stick'
    #[arg(long, value_name = "PATH=VALUE,…", value_delimiter = ',', value_parser = setting)]
    pub at: Vec<(String, String)>,
    /// Time; of an experiment: where its run is then [default: the start]
    #[arg(long, value_name = "TIME", value_parser = positive_time)]
    pub time: Option<f64>,
    /// Where everything has come to rest, in place of --time
    #[arg(long, conflicts_with = "time")]
    pub rest: bool,
    /// Inputs, also of parts [default: those of the whole]
    #[arg(long, value_name = "PATH,…", value_delimiter = ',')]
    pub inputs: Vec<String>,
    /// Outputs, or other quantities [default: the outputs of the whole]
    #[arg(long, value_name = "PATH,…", value_delimiter = ',')]
    pub outputs: Vec<String>,
    /// Parameters: P and Q are the derivatives of rates and outputs with respect to them
    #[arg(long, value_name = "PATH,…", value_delimiter = ',')]
    pub params: Vec<String>,
    /// Break the loop at this output of a controller, such as ctl.u: the matrices of the open loop through its sampled
    /// code and the hold, and the margins of the closed loop
    #[arg(long = "loop", value_name = "PATH", conflicts_with_all = ["inputs", "outputs", "params"])]
    pub broken: Option<String>,
    /// Print the margins of the loop alone, without its matrices
    #[arg(long, requires = "broken")]
    pub margins: bool,
    /// Draw gain and phase of the loop (.svg, .png, .pdf), or write them (.csv)
    #[arg(long, value_name = "FILE", requires = "broken", value_hint = ValueHint::FilePath, value_parser = bode)]
    pub bode: Option<PathBuf>,
    /// Time that the controller takes, from reading its inputs until its output acts
    #[arg(long, value_name = "TIME", requires = "broken", value_parser = positive_time)]
    pub delay: Option<f64>,
    /// How the diagram of --bode is drawn
    #[command(flatten)]
    pub look: Look,
    /// Changes to the text
    #[command(flatten)]
    pub set: Set,
    /// Print a JSON object
    #[arg(long)]
    pub json: bool,
    /// Write A, B, C, D, and P and Q if there are any, to a file: .npz, .mat or .json
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath, value_parser = matrices)]
    pub out: Option<PathBuf>,
}

/// `fric bench`
#[derive(clap::Args, Debug)]
pub struct Bench {
    /// The text
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// The experiment in it to time
    pub experiment: String,
    /// Changes to the experiment
    #[command(flatten)]
    pub stepped: Stepped,
    /// Print a JSON object
    #[arg(long)]
    pub json: bool,
}

/// `fric build`
#[derive(clap::Args, Debug)]
pub struct Build {
    /// The text
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// A model, with its inputs free, an experiment, or a rig; the only one if none is named
    #[arg(value_name = "MODEL|EXPERIMENT|RIG")]
    pub name: Option<String>,
    /// Form of the output of a model or an experiment; a rig becomes a package
    #[arg(long, value_name = "WHAT", value_enum)]
    pub emit: Option<Emit>,
    /// File to write [default: the standard output]; a folder, such as c/, gets C code with a header
    #[arg(long, short, value_name = "FILE|FOLDER/", value_hint = ValueHint::AnyPath)]
    pub out: Option<PathBuf>,
    /// Sign a package with a secret key, into a file beside it
    #[arg(long, value_name = "FILE.key", value_hint = ValueHint::FilePath)]
    pub sign: Option<PathBuf>,
    /// Processor: x86_64 or aarch64, also written x86_64-linux [default: this one]
    #[arg(long, value_name = "NAME", value_parser = target)]
    pub target: Option<Target>,
    /// Instruction set extensions that the code may use: avx2, bmi1, bmi2, lzcnt, popcnt; it then runs only on processors
    /// that have them, with the same bits
    #[arg(long, value_name = "NAME,…", value_delimiter = ',', value_parser = feature)]
    pub features: Vec<Feature>,
    /// Changes to the text, and the solver
    #[command(flatten)]
    pub stepped: Stepped,
}

/// `fric hil`
#[derive(clap::Args, Debug)]
#[command(after_help = HIL_HELP)]
pub struct Hil {
    /// The text
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// The rig in it; the only one if none is named
    pub rig: Option<String>,
    /// Time the model runs, such as 60s [default: until it is stopped]
    #[arg(long = "for", value_name = "TIME", value_parser = positive_time)]
    pub duration: Option<f64>,
    /// Simulate buses, drives and devices in the process; arms itself
    #[arg(long)]
    pub sim: bool,
    /// Simulated time: as fast as possible, with the same bits every time; needs --for, --check or --identify
    #[arg(long)]
    pub fast: bool,
    /// Give a bus of the rig another address: `can0=socketcan:can1`, `can0=slcan:/dev/ttyACM0@1000000`
    #[arg(long, value_name = "BUS=ADDRESS", value_parser = setting)]
    pub bus: Vec<(String, String)>,
    /// Changes to the text
    #[command(flatten)]
    pub set: Set,
    /// Inject faults into simulated drives and devices: 'panel.enable = 0 at 5 s' after power-on, or 'at 5 s of run'
    #[arg(long, value_name = "FAULT")]
    pub inject: Vec<String>,
    /// Do the checks of the start-up and stop before arming
    #[arg(long)]
    pub check: bool,
    /// Measure delay, lag and inertia by torque pulses instead of running the model; prints text to paste
    #[arg(long, conflicts_with = "check")]
    pub identify: bool,
    /// Enable and arm without an operator: simulated drives only
    #[arg(long)]
    pub arm: bool,
    /// Run although the loop is predicted to be unstable: simulated drives only
    #[arg(long)]
    pub accept_unstable: bool,
    /// Stop when a contact returns more energy than it can store [default: count it]
    #[arg(long)]
    pub stop_on_energy: bool,
    /// Run although the host has no real-time scheduling: simulated drives only
    #[arg(long)]
    pub accept_jitter: bool,
    /// Count missed ticks and continue: simulated drives only
    #[arg(long)]
    pub count_overruns: bool,
    /// The log [default: out/RIG.friclog]
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub log: Option<PathBuf>,
    /// Begin a new file, RIG.2.friclog, after this many bytes of log
    #[arg(long, value_name = "SIZE", value_parser = runtime::record::parts::bytes, default_value = "256MB")]
    pub roll: u64,
    /// Remove the oldest logs in the folder of the log, so that all together have at most this many bytes [default: keep all]
    #[arg(long, value_name = "SIZE", value_parser = runtime::record::parts::bytes, conflicts_with = "no_log")]
    pub keep: Option<u64>,
    /// Keep only the last ten seconds, written if the safety supervisor stops the rig
    #[arg(long, conflicts_with = "log")]
    pub no_log: bool,
    /// Open a panel beside the rig, in a process of its own: curves, parameters, enable, arm and stop, in a browser
    #[arg(long, conflicts_with_all = ["no_log", "fast", "check", "identify"])]
    pub panel: bool,
    /// Port of the panel on this computer; if it is taken, the next free one
    #[arg(long, value_name = "PORT", requires = "panel", default_value_t = panel::server::PORT)]
    pub port: u16,
    /// Print the panel's link, and open no browser
    #[arg(long, requires = "panel")]
    pub no_open: bool,
    /// Others may look at the panel at this address of this computer, and stop the rig: they have a link of their own
    #[arg(long, value_name = "ADDR:PORT", requires = "panel", value_parser = listening)]
    pub share: Option<std::net::SocketAddr>,
    /// Stop the rig if no page of the panel has been drawn for this time, such as 2s; it is armed only once one is
    #[arg(long, value_name = "TIME", requires = "panel", value_parser = dead_man)]
    pub dead_man: Option<f64>,
    /// Seed of all random numbers of a simulation
    #[arg(long, value_name = "NUMBER", default_value_t = 1)]
    pub seed: u64,
    /// Print failures only
    #[arg(long, short)]
    pub quiet: bool,
    /// Interpret instead of compiling to machine code: same bits, slower
    #[arg(long)]
    pub interpret: bool,
}

const HIL_HELP: &str = "While it runs, type: enable, arm, set PATH = VALUE, mark WORDS, show, help, stop.\n\
    Exit codes: 0 ended as asked (Ctrl-C included), 1 refused or bad input, 2 wrong usage, 3 stopped by safety.";

/// `fric predict`
#[derive(clap::Args, Debug)]
pub struct Predict {
    /// The text
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// A dry run to compare with one whose drives act at once; without it only stability and resolution
    pub experiment: Option<String>,
    /// The rig [default: that of the experiment, or the only one]
    #[arg(long, value_name = "RIG")]
    pub rig: Option<String>,
    /// Changes to the text
    #[command(flatten)]
    pub set: Set,
    /// One JSON object
    #[arg(long)]
    pub json: bool,
}

/// `fric replay`
#[derive(clap::Args, Debug)]
pub struct Replay {
    /// A log of `fric hil`
    #[arg(value_hint = ValueHint::FilePath)]
    pub log: PathBuf,
    /// Write its cycles as a table
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub csv: Option<PathBuf>,
    /// Write the same table as Parquet
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub parquet: Option<PathBuf>,
    /// Write its frames as candump -L does; `replay:FILE` is a bus that reads it
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub candump: Option<PathBuf>,
    /// Interpret instead of compiling to machine code: same bits, slower
    #[arg(long)]
    pub interpret: bool,
}

/// `fric check`
#[derive(clap::Args, Debug)]
pub struct Check {
    /// Texts
    #[arg(required = true, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub files: Vec<PathBuf>,
    /// Print a JSON array of what was found
    #[arg(long)]
    pub json: bool,
    /// Print one line each: `file:line:column: E0101 message`
    #[arg(long, conflicts_with = "json")]
    pub short: bool,
    /// Timings
    #[command(flatten)]
    pub timed: Timed,
}

/// `fric fmt`
#[derive(clap::Args, Debug)]
pub struct Fmt {
    /// Texts; `-` reads one from the standard input and prints the result
    #[arg(required = true, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub files: Vec<PathBuf>,
    /// Change nothing; fail and name the files that would change
    #[arg(long)]
    pub check: bool,
    /// Columns to fit into
    #[arg(long, value_name = "COLUMNS", default_value_t = 120, value_parser = clap::value_parser!(u16).range(40..=1000))]
    pub width: u16,
}

/// `fric explain`
#[derive(clap::Args, Debug)]
pub struct Explain {
    /// A code such as E0101, or a file
    #[arg(value_name = "CODE|FILE")]
    pub subject: String,
    /// Models, experiments or rigs of the file to explain; all models if none is named
    #[arg(value_name = "NAME")]
    pub names: Vec<String>,
    /// How long a fixed step takes on this machine: the worst of a million calls
    #[arg(long)]
    pub step: bool,
    /// One JSON object per model
    #[arg(long)]
    pub json: bool,
}

/// `fric characterise`
#[derive(clap::Args, Debug)]
pub struct Characterise {
    /// A model of the library with arguments, `LuGre(vd = 10 mm/s)`, or a .fric file
    #[arg(value_name = "MODEL|FILE", value_hint = ValueHint::FilePath)]
    pub what: String,
    /// Models of the file, with arguments; all that fit if none is named
    #[arg(value_name = "MODEL")]
    pub models: Vec<String>,
    /// Change a parameter: `Fs=2N`
    #[arg(long = "set", value_name = "NAME=VALUE", value_parser = setting)]
    pub set: Vec<(String, String)>,
    /// The same model with several values of an input or a parameter, side by side: 'N = 5 N, 10 N, 50 N'
    #[arg(long, value_name = "PATH = VALUES", value_parser = vary::parse)]
    pub over: Option<Vary>,
    /// Folder for the report, the battery and the tables, also as LaTeX [default: out/MODEL]
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub out: Option<PathBuf>,
    /// Figures as files of their own
    #[command(flatten)]
    pub figures: Figures,
    /// Print one JSON object per model, one a line, instead of text
    #[arg(long)]
    pub json: bool,
}

/// `fric compare`
#[derive(clap::Args, Debug)]
pub struct Compare {
    /// Models of the library with arguments, or .fric files
    #[arg(required = true, value_name = "MODEL|FILE", value_hint = ValueHint::FilePath)]
    pub models: Vec<String>,
    /// Folder for the page and its tables as LaTeX [default: out/compare]
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub out: Option<PathBuf>,
    /// Figures as files of their own
    #[command(flatten)]
    pub figures: Figures,
    /// Print one JSON object per model, one a line, instead of text
    #[arg(long)]
    pub json: bool,
}

/// `fric doc`
#[derive(clap::Args, Debug)]
pub struct Doc {
    /// Write the page only, and leave the plots as they are
    #[arg(long, conflicts_with = "check")]
    pub keep_plots: bool,
    /// The page; plots go into the folder of the same name
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath, default_value = "docs/models.md")]
    pub out: PathBuf,
    /// Write nothing; fail if the page would change
    #[arg(long)]
    pub check: bool,
}

/// `fric drives`
#[derive(clap::Args, Debug)]
pub struct Drives {
    /// The text
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// The rig in it; the only one if none is named
    pub rig: Option<String>,
    /// Serve them at another address: `can0=socketcan:can1`, `can0=slcan:/dev/ttyACM0@1000000`
    #[arg(long, value_name = "BUS=ADDRESS", value_parser = setting)]
    pub bus: Vec<(String, String)>,
    /// Open a pseudo-terminal with the slcan protocol, and a link to it at this path
    #[arg(long, value_name = "PATH", value_hint = ValueHint::FilePath)]
    pub pty: Vec<PathBuf>,
    /// Open a TCP port with the socketcand protocol, 0 for a free one
    #[arg(long, value_name = "PORT")]
    pub tcp: Option<u16>,
    /// Inject faults: 'load fault 0x2310 at 3 s', 'panel.enable = 0 at 5 s'
    #[arg(long, value_name = "FAULT")]
    pub inject: Vec<String>,
    /// Add the objects of a data sheet (EDS, DCF) to a drive: `load=servo.eds`
    #[arg(long, value_name = "DRIVE=FILE", value_parser = sheet)]
    pub eds: Vec<(String, String)>,
    /// Changes to the text
    #[command(flatten)]
    pub set: Set,
    /// Seed of all random numbers
    #[arg(long, value_name = "NUMBER", default_value_t = 1)]
    pub seed: u64,
    /// End after this time, such as 10s [default: Ctrl-C]
    #[arg(long = "for", value_name = "TIME", value_parser = positive_time)]
    pub duration: Option<f64>,
    /// Do not print changes of their states
    #[arg(long, short)]
    pub quiet: bool,
}

/// `fric repl`
#[derive(clap::Args, Debug, Default)]
pub struct Repl {
    /// A text to use from the beginning
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: Option<PathBuf>,
    /// Continue after an error in lines from a pipe; the exit code is still 1
    #[arg(long)]
    pub keep_going: bool,
    /// Print each line from a pipe before its result, as a terminal shows it
    #[arg(long)]
    pub echo: bool,
}

/// `fric bus`
#[derive(clap::Args, Debug)]
#[command(after_help = BUS_ADDRESSES)]
pub struct Bus {
    /// Buses to join, such as can0, sim:bench, slcan:/dev/ttyACM0@1000000, socketcand:host/can0
    #[arg(value_name = "ADDRESS", required_unless_present_any = ["pty", "tcp"], value_parser = address)]
    pub addresses: Vec<Address>,
    /// Open a pseudo-terminal with the slcan protocol, and a link to it at this path
    #[arg(long, value_name = "PATH", value_hint = ValueHint::FilePath)]
    pub pty: Vec<PathBuf>,
    /// Open a TCP port with the socketcand protocol, 0 for a free one
    #[arg(long, value_name = "PORT")]
    pub tcp: Option<u16>,
    /// Accept connections to the TCP port from other machines
    #[arg(long, requires = "tcp")]
    pub everywhere: bool,
    /// Bit rate of buses whose address has none: simulated ones get it, interfaces are compared with it
    #[arg(long, value_name = "BITS", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub bit_rate: Option<u32>,
    /// Name frames and signals by this text with rigs, DBC file, or data sheet (EDS, DCF); repeatable
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub names: Vec<PathBuf>,
    /// Print traffic as `candump -L` does, for `replay:`
    #[arg(long)]
    pub log: bool,
    /// Bridge without printing traffic
    #[arg(long, short, conflicts_with = "log")]
    pub quiet: bool,
    /// End after this time, such as 10s [default: Ctrl-C]
    #[arg(long = "for", value_name = "TIME", value_parser = positive_time)]
    pub duration: Option<f64>,
}

const BUS_ADDRESSES: &str = "Addresses:\n  \
    can0, socketcan:can0         an interface of the kernel\n  \
    sim:NAME                     a bus in this process\n  \
    slcan:PATH@BITRATE           a serial adapter\n  \
    socketcand:HOST:PORT/NAME    a TCP gateway\n  \
    replay:FILE                  a log of candump -L";

/// `fric doctor`
#[derive(clap::Args, Debug)]
pub struct Doctor {
    /// Rigs whose buses to check too, and buses such as can0
    #[arg(value_name = "RIG.fric|ADDRESS", value_hint = ValueHint::FilePath, value_parser = looked_at)]
    pub targets: Vec<LookedAt>,
    /// Expected bit rate of the buses named here
    #[arg(long, value_name = "BITS", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub bit_rate: Option<u32>,
    /// Priority of the loop that will run
    #[arg(long, value_name = "N", default_value_t = 80, value_parser = clap::value_parser!(i32).range(1..=99))]
    pub priority: i32,
}

/// What `fric doctor` looks at besides the machine.
#[cfg_attr(not(all(feature = "hardware", target_os = "linux")), allow(dead_code, reason = "read by `doctor` alone"))]
#[derive(Clone, Debug)]
pub enum LookedAt {
    /// The buses of the rigs in a text.
    Rigs(PathBuf),
    /// A bus.
    Bus(Address),
}

/// `fric bench-rt`
#[derive(clap::Args, Debug)]
pub struct BenchRt {
    /// A text with a rig: its own cycle with its model and simulated drives, instead of one SYNC and its echo
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: Option<PathBuf>,
    /// The rig in it [default: the only one]
    #[arg(requires = "file")]
    pub rig: Option<String>,
    /// Cycles a second, such as 1kHz; a rig has its own
    #[arg(long, value_name = "FREQUENCY", default_value = "1kHz", value_parser = frequency, conflicts_with = "file")]
    pub rate: f64,
    /// How long to run
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=86_400))]
    pub seconds: u64,
    /// Core to run on [default: an isolated one, if there is any]
    #[arg(long, value_name = "N")]
    pub core: Option<usize>,
    /// Priority under SCHED_FIFO
    #[arg(long, value_name = "N", default_value_t = 80, value_parser = clap::value_parser!(i32).range(1..=99))]
    pub priority: i32,
}

/// `fric watch`
#[derive(clap::Args, Debug)]
pub struct Watch {
    /// The text; what it imports is watched too
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// The experiment in it to run; not needed if it is the only one
    pub experiment: Option<String>,
    /// Run from the start each time
    #[arg(long)]
    pub restart: bool,
}

/// `fric panel`
#[derive(clap::Args, Debug)]
pub struct Panel {
    /// A text with experiments, a log of `fric hil`, or USER@HOST: the rig that `fric-rig` runs there, through ssh
    #[arg(value_name = "FILE|LOG|USER@HOST", value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// Experiments of the text to offer; all if none is named
    pub experiments: Vec<String>,
    /// What of the experiment is changed
    #[command(flatten)]
    pub changed: Changed,
    /// Port on this computer; if it is taken, the next free one
    #[arg(long, value_name = "PORT", default_value_t = panel::server::PORT)]
    pub port: u16,
    /// Curves of a recording in memory; what is older is left out
    #[arg(long, value_name = "SIZE", value_parser = runtime::record::parts::bytes, default_value = "256MB")]
    pub keep: u64,
    /// Print the link, and open no browser
    #[arg(long)]
    pub no_open: bool,
    /// Others may look at this address of this computer, and stop a rig: they have a link of their own
    #[arg(long, value_name = "ADDR:PORT", conflicts_with = "save", value_parser = listening)]
    pub share: Option<std::net::SocketAddr>,
    /// With USER@HOST: option for ssh, such as Port=2222
    #[arg(short = 'o', value_name = "NAME=VALUE")]
    pub options: Vec<String>,
    /// With USER@HOST: the program there
    #[arg(long, value_name = "COMMAND", default_value = "fric-rig")]
    pub rig: String,
    /// With USER@HOST: folder of packages and logs there
    #[arg(long, value_name = "DIR", default_value = "/var/lib/fric")]
    pub dir: String,
    /// The log is that of a rig that this process is beside: the section `started` of its head
    #[arg(long, hide = true, conflicts_with = "save")]
    pub of_rig: Option<String>,
    /// Write what the page would show into one HTML file that needs nothing else, and serve nothing
    #[arg(long, value_name = "FILE.html", value_hint = ValueHint::FilePath)]
    pub save: Option<PathBuf>,
    /// Interpret instead of making machine code: slow, for comparison
    #[arg(long)]
    pub interpret: bool,
}

/// `fric inspect`
#[derive(clap::Args, Debug)]
pub struct Inspect {
    /// The package
    #[arg(value_name = "FILE.fricpkg", value_hint = ValueHint::FilePath)]
    pub package: PathBuf,
    /// Folder with public keys: the package must be signed by one of them
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub trusted: Option<PathBuf>,
    /// Print its source texts
    #[arg(long)]
    pub sources: bool,
    /// Extract all its sections into a folder
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub extract: Option<PathBuf>,
}

/// `fric key`
#[derive(Subcommand, Debug)]
pub enum Key {
    /// Create a pair: NAME.key to sign with, NAME.pub to be trusted
    New(KeyNew),
}

/// `fric key new`
#[derive(clap::Args, Debug)]
pub struct KeyNew {
    /// Name of the two files, without their endings
    #[arg(value_hint = ValueHint::FilePath)]
    pub name: PathBuf,
}

/// Another computer, and where things lie there.
#[derive(clap::Args, Debug)]
pub struct Host {
    /// As ssh takes it
    #[arg(value_name = "USER@HOST", value_hint = ValueHint::Hostname, value_parser = host)]
    pub host: String,
    /// Option for ssh and scp, such as Port=2222
    #[arg(short = 'o', value_name = "NAME=VALUE")]
    pub options: Vec<String>,
    /// The program there
    #[arg(long, value_name = "COMMAND", default_value = "fric-rig")]
    pub rig: String,
    /// Folder of packages and logs there
    #[arg(long, value_name = "DIR", default_value = "/var/lib/fric")]
    pub dir: String,
}

/// `fric deploy`
#[derive(clap::Args, Debug)]
pub struct Deploy {
    /// Where to
    #[command(flatten)]
    pub host: Host,
    /// A text with a rig, or a package
    #[arg(value_name = "RIG.fric|FILE.fricpkg", value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// The rig in the text; not needed if it is the only one
    #[arg(value_name = "RIG")]
    pub name: Option<String>,
    /// Changes to the text
    #[command(flatten)]
    pub set: Set,
    /// Sign the package with this secret key [default: a key of yours, made on first use; a rig that trusts no key yet gets its
    /// public one]
    #[arg(long, value_name = "FILE.key", value_hint = ValueHint::FilePath)]
    pub sign: Option<PathBuf>,
    /// Do not sign it, and permit it on real buses there; not where keys are trusted
    #[arg(long, conflicts_with = "sign")]
    pub allow_unsigned: bool,
    /// Install it even if it was signed before the one that is installed there
    #[arg(long)]
    pub allow_older: bool,
    /// Folder with the trusted keys there [default: /etc/fric/trusted]
    #[arg(long, value_name = "DIR")]
    pub trusted: Option<String>,
    /// Start it there, and return to the previous package if it refuses; on a terminal, then print its state until Ctrl-C,
    /// which does not end the rig
    #[arg(long)]
    pub start: bool,
    /// Print its state until Ctrl-C even if the output is no terminal
    #[arg(long, requires = "start")]
    pub follow: bool,
    /// For its start: begin a new file after this many bytes of log [default: 256MB]
    #[arg(long, requires = "start", value_name = "SIZE", value_parser = runtime::record::parts::bytes)]
    pub roll: Option<u64>,
    /// For its start: remove its oldest logs, so that all together have at most this many bytes [default: keep all]
    #[arg(long, requires = "start", value_name = "SIZE", value_parser = runtime::record::parts::bytes)]
    pub keep: Option<u64>,
}

/// `fric fetch-log`
#[derive(clap::Args, Debug)]
pub struct FetchLog {
    /// Where from
    #[command(flatten)]
    pub host: Host,
    /// Which one, with all its parts [default: the newest]
    pub log: Option<String>,
    /// All of them
    #[arg(long, conflicts_with = "log")]
    pub all: bool,
    /// Folder to write to
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath, default_value = "out")]
    pub out: PathBuf,
}

/// `fric new`
#[derive(clap::Args, Debug)]
pub struct New {
    /// Folder to create; it must be empty
    #[arg(value_hint = ValueHint::DirPath)]
    pub dir: PathBuf,
}

fn setting(text: &str) -> Result<(String, String), String> {
    pair(text).ok_or("write it as PATH=VALUE, for example fr.Fs=2N".into())
}

/// A drive and its data sheet.
fn sheet(text: &str) -> Result<(String, String), String> {
    pair(text).ok_or("write it as DRIVE=FILE, for example load=servo.eds".into())
}

/// What stands on both sides of the first `=`.
fn pair(text: &str) -> Option<(String, String)> {
    let (left, right) = text.split_once('=')?;
    let (left, right) = (left.trim(), right.trim());
    (!left.is_empty() && !right.is_empty()).then(|| (left.into(), right.into()))
}

/// What begins with a dash would be an option of ssh.
fn host(text: &str) -> Result<String, String> {
    if text.is_empty() || text.starts_with('-') { Err("write it as USER@HOST".into()) } else { Ok(text.into()) }
}

fn solver(text: &str) -> Result<Method, String> {
    Method::named(text).ok_or_else(|| format!("the solvers are {}", Method::list(Method::ALL)))
}

fn target(text: &str) -> Result<Target, String> {
    let names = || Target::ALL.map(Target::name).join(", ");
    Target::named(text.strip_suffix("-linux").unwrap_or(text)).ok_or_else(|| format!("code is made for {}", names()))
}

fn feature(text: &str) -> Result<Feature, String> {
    let names = || Feature::ALL.map(|feature| feature.name().to_ascii_lowercase()).join(", ");
    Feature::named(text.trim()).ok_or_else(|| format!("the features are {}", names()))
}

fn positive_time(text: &str) -> Result<f64, String> {
    let (value, unit) = quantity::parse(text)?;
    let second = Unit::parse("s").expect("the second is known").dimension;
    match unit.dimension {
        dimension if dimension == second => {}
        Dimension::NONE if unit.text.is_empty() => return Err(format!("a time needs its unit, for example {text}s")),
        dimension => return Err(format!("a time is needed, not {}", dimension.describe())),
    }
    if value > 0.0 && value.is_finite() { Ok(value) } else { Err("a time greater than 0 is needed".into()) }
}

/// An address at which others may look.
fn listening(text: &str) -> Result<std::net::SocketAddr, String> {
    text.parse().map_err(|_| "write an address of this computer with a port, for example 192.168.1.20:7421".into())
}

/// The time of a dead man's switch. Logs are written ten times a second, so a picture may be some tenths of a second old.
fn dead_man(text: &str) -> Result<f64, String> {
    let time = positive_time(text)?;
    if time >= 0.5 { Ok(time) } else { Err("0.5 s or more is needed: pictures come ten times a second at best".into()) }
}

fn address(text: &str) -> Result<Address, String> {
    text.parse()
}

fn looked_at(text: &str) -> Result<LookedAt, String> {
    if text.ends_with(".fric") { Ok(LookedAt::Rigs(text.into())) } else { address(text).map(LookedAt::Bus) }
}

/// 1 Hz to 20 kHz.
fn frequency(text: &str) -> Result<f64, String> {
    let (value, unit) = quantity::parse(text)?;
    let hertz = Unit::parse("Hz").expect("the hertz is known").dimension;
    if unit.dimension != hertz {
        return Err("a frequency is needed, for example 1kHz".into());
    }
    if (1.0..=20e3).contains(&value) { Ok(value) } else { Err("a frequency from 1 Hz to 20 kHz is needed".into()) }
}

fn any_frequency(text: &str) -> Result<f64, String> {
    let (value, unit) = quantity::parse(text)?;
    let hertz = Unit::parse("Hz").expect("the hertz is known").dimension;
    if unit.dimension == hertz && value > 0.0 && value.is_finite() {
        return Ok(value);
    }
    Err("a frequency is needed, for example 0.5Hz".into())
}

fn harmonics(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(harmonics) if (1..=50).contains(&harmonics) => Ok(harmonics),
        _ => Err("a number from 1 to 50 is needed".into()),
    }
}

fn tolerance(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(tol) if tol > 0.0 && tol < 1.0 => Ok(tol),
        _ => Err("a number between 0 and 1 is needed, for example 1e-8".into()),
    }
}

fn pieces(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(pieces) if (1..=100).contains(&pieces) => Ok(pieces),
        _ => Err("a number from 1 to 100 is needed".into()),
    }
}

fn starts(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(starts) if (1..=100_000).contains(&starts) => Ok(starts),
        _ => Err("a number from 1 to 100000 is needed".into()),
    }
}

fn level(text: &str) -> Result<f64, String> {
    let (number, percent) = match text.strip_suffix('%') {
        Some(number) => (number, true),
        None => (text, false),
    };
    match number.trim().parse::<f64>().map(|level| if percent { level / 100.0 } else { level }) {
        Ok(level) if (0.5..=0.9999).contains(&level) => Ok(level),
        _ => Err("a probability from 50% to 99.99% is needed, for example 95%".into()),
    }
}

fn threads(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(threads) if (1..=1024).contains(&threads) => Ok(threads),
        _ => Err("a number from 1 to 1024 is needed".into()),
    }
}

fn matrices(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension().and_then(|extension| extension.to_str()) {
        Some("npz" | "mat" | "json") => Ok(path),
        _ => Err("the name ends in .npz (NumPy), .mat (MATLAB) or .json".into()),
    }
}

/// A length in px, 96 to the inch, from a number and the unit of a length; `pt` is the point of PostScript.
fn px(number: &str, unit: &str) -> Result<f64, String> {
    let number: f64 = number.trim().parse().map_err(|_| format!("`{number}` is no number"))?;
    let inches = match unit {
        "mm" => 1.0 / 25.4,
        "cm" => 1.0 / 2.54,
        "in" => 1.0,
        "pt" => 1.0 / 72.0,
        "px" => 1.0 / 96.0,
        _ => return Err("lengths are in mm, cm, in, pt or px".into()),
    };
    Ok(96.0 * number * inches)
}

/// `85x60mm`: width and height in px.
fn size(text: &str) -> Result<(f64, f64), String> {
    let text = text.replace('×', "x").replace(' ', "");
    // `px` has an x of its own.
    let split = text.split_at_checked(text.len().saturating_sub(2)).ok_or("write it as 85x60mm")?;
    let (numbers, unit) = split;
    let (width, height) = numbers.split_once('x').ok_or("write width and height, as in 85x60mm")?;
    let width = width.trim_end_matches(unit);
    let (width, height) = (px(width, unit)?, px(height, unit)?);
    let (least, most) = (px("20", "mm")?, px("2000", "mm")?);
    if [width, height].iter().all(|side| (least..=most).contains(side)) {
        Ok((width, height))
    } else {
        Err("a figure is from 20 mm to 2 m wide and tall".into())
    }
}

/// `8pt`: a size of letters in px.
fn font(text: &str) -> Result<f64, String> {
    let text = text.trim();
    let (number, unit) = text.split_at_checked(text.len().saturating_sub(2)).ok_or("write it as 8pt")?;
    let size = px(number, unit)?;
    let (least, most) = (px("3", "pt")?, px("72", "pt")?);
    if (least..=most).contains(&size) { Ok(size) } else { Err("letters are from 3pt to 72pt tall".into()) }
}

fn picture(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension().and_then(|extension| extension.to_str()) {
        Some("svg" | "png" | "pdf") => Ok(path),
        None if text == "-" => Ok(path),
        _ => Err("the name of a plot ends in .svg, .png or .pdf".into()),
    }
}

/// A name of a Bode diagram.
fn bode(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension().and_then(|extension| extension.to_str()) {
        Some("svg" | "png" | "pdf" | "csv") => Ok(path),
        _ => Err("the name of a Bode diagram ends in .svg, .png, .pdf, or .csv for its numbers".into()),
    }
}

/// A name of a recording.
fn data(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension().and_then(|extension| extension.to_str()).map(str::to_ascii_lowercase).as_deref() {
        Some("csv" | "parquet" | "mat" | "npz") => Ok(path),
        None if text == "-" => Ok(path),
        _ => Err("the name of the data ends in .csv, .parquet, .mat (MATLAB) or .npz (NumPy)".into()),
    }
}

/// `2/8`: the second of eight.
fn shard(text: &str) -> Result<(u64, u64), String> {
    let read = text.split_once('/').and_then(|(i, n)| Some((i.trim().parse().ok()?, n.trim().parse().ok()?)));
    match read {
        Some((i, n)) if (1..=n).contains(&i) => Ok((i, n)),
        Some(_) | None => Err("write it as I/N, from 1/N to N/N".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn shards_are_counted_from_one() {
        assert_eq!(shard("2/8"), Ok((2, 8)));
        assert!(shard("0/8").is_err() && shard("9/8").is_err() && shard("3").is_err() && shard("1/0").is_err());
    }

    #[test]
    fn sizes_of_figures_are_lengths() {
        let close = |found: Result<(f64, f64), String>, width: f64, height: f64| {
            let (w, h) = found.unwrap();
            assert!((w - width).abs() < 1e-9 && (h - height).abs() < 1e-9, "{w} {h}");
        };
        close(size("85x60mm"), 85.0 * 96.0 / 25.4, 60.0 * 96.0 / 25.4);
        close(size("85mm x 60mm"), 85.0 * 96.0 / 25.4, 60.0 * 96.0 / 25.4);
        close(size("3.5×2in"), 336.0, 192.0);
        close(size("800x600px"), 800.0, 600.0);
        for wrong in ["85mm", "85x60", "0x60mm", "85x-60mm", "1e9x60mm", "NaNxNaNmm", "xmm", "", "é"] {
            assert!(size(wrong).is_err(), "{wrong}");
        }
        assert!((font("9pt").unwrap() - 12.0).abs() < 1e-9);
        assert!(font("900pt").is_err() && font("9").is_err() && font("").is_err());
    }

    #[test]
    fn the_tree_is_sound() {
        Args::command().debug_assert();
    }

    #[test]
    fn every_command_has_its_manual_page() {
        for command in Args::command().get_subcommands().map(|command| command.get_name().to_string()) {
            let read = Args::try_parse_from(["fric", "man", &command]);
            assert_eq!(read.is_ok(), command != "man", "{command}");
        }
    }

    #[test]
    fn times_carry_units() {
        assert_eq!(positive_time("10us"), Ok(1e-5));
        assert_eq!(positive_time("1.5 min"), Ok(90.0));
        assert_eq!(positive_time("10").unwrap_err(), "a time needs its unit, for example 10s");
        assert_eq!(positive_time("3N").unwrap_err(), "a time is needed, not a force");
        assert!(positive_time("0s").is_err() && positive_time("-1s").is_err() && positive_time("infs").is_err());
    }

    #[test]
    fn settings_split_at_the_first_equals_sign() {
        assert_eq!(setting("fr=LuGre(Fs = 2 N)"), Ok(("fr".into(), "LuGre(Fs = 2 N)".into())));
        assert!(setting("fr.Fs").is_err() && setting("=2").is_err() && setting("fr.Fs=").is_err());
    }

    /// Words of a command line, quotes taken off, up to a comment or a pipe.
    fn words(line: &str) -> Vec<String> {
        let (mut words, mut word, mut quote): (Vec<String>, Option<String>, Option<char>) = (Vec::new(), None, None);
        for c in line.chars() {
            match (quote, c) {
                (Some(open), c) if c == open => quote = None,
                (None, '\'' | '"') => {
                    quote = Some(c);
                    word.get_or_insert_default();
                }
                (None, '#' | '|' | '>' | '&' | '<') if word.is_none() => break,
                (None, c) if c.is_whitespace() => words.extend(word.take()),
                (_, c) => word.get_or_insert_default().push(c),
            }
        }
        words.extend(word);
        words
    }

    /// Every command of the documents is one that this program takes.
    ///
    /// Mutant tried by hand: `--over` has another name.
    #[test]
    fn commands_in_the_documents_are_read() {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
        let mut files: Vec<PathBuf> =
            std::fs::read_dir(root.join("docs")).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.extend(["README.md", "examples/README.md"].map(|name| root.join(name)));
        files.retain(|path| path.extension().is_some_and(|ending| ending == "md"));
        files.sort();
        let (mut read, mut wrong) = (0, Vec::new());
        for file in files {
            let text = std::fs::read_to_string(&file).unwrap();
            let (mut fenced, mut line_number) = (false, 0);
            // A line that ends with `\\` goes on.
            for line in text.replace("\\\n", " ").lines() {
                line_number += 1;
                if line.trim_start().starts_with("```") {
                    fenced = !fenced;
                    continue;
                }
                let line = line.trim_start_matches("$ ");
                if !fenced || !line.starts_with("fric ") {
                    continue;
                }
                let words = words(line);
                // Forms, not commands: `fric bus ADDRESS …`.
                let form = |word: &String| {
                    word.contains(['…', '[', '<']) || word.len() > 2 && word.chars().all(|c| c.is_ascii_uppercase())
                };
                if words.iter().skip(1).any(form) {
                    continue;
                }
                read += 1;
                if let Err(error) = Args::try_parse_from(&words)
                    && !matches!(
                        error.kind(),
                        clap::error::ErrorKind::DisplayHelp | clap::error::ErrorKind::DisplayVersion
                    )
                {
                    let why = error.to_string();
                    wrong.push(format!(
                        "{}:{line_number}: {line}: {}",
                        file.display(),
                        why.lines().next().unwrap_or_default()
                    ));
                }
            }
        }
        assert!(read > 40, "{read}");
        assert!(wrong.is_empty(), "{} of {read}:\n{}", wrong.len(), wrong.join("\n"));
    }
}
