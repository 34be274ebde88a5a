//! The command from the view of a user or a script: exit codes, output streams, odd input, closed pipes.

use serde_json::Value;
use std::fs;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// A model and three experiments: one that passes, one that fails, one without expectations.
const PULL: &str = r#"
model Contact {
  input  v [m/s]
  param  Fc = 1 N        in > 0
  param  vt = 10 mm/s    in > 0
  output F [N] = Fc * tanh(v / vt)
  allow  creep "it need not hold a load"
}

model Pull {
  param  k  = 2 N/m      in > 0
  part   fr = Contact(v = v)
  state  x [m] = 0
  state  v [mm/s] = 0
  dx/dt  = v
  dv/dt  = (k * (0.1 m/s * t - x) - fr.F) / 1 kg
}

experiment holds {
  run    Pull() for 2 s
  solver rk4 step 1 ms
  plot   x [mm], v [mm/s]
  expect max(fr.F) < 1.1 N
}

experiment breaks {
  run    Pull() for 2 s
  solver rk4 step 1 ms
  expect final(x) > 1 km
}

experiment silent {
  run    Pull() for 2 s
  solver rk4 step 1 ms
  plot   x [mm]
}
"#;

/// A folder for one test, empty at its start.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Folder {
        let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        let _ = fs::remove_dir_all(&path);
        fs::create_dir_all(&path).unwrap();
        Folder(path)
    }

    fn with(self, name: &str, text: impl AsRef<[u8]>) -> Folder {
        fs::write(self.0.join(name), text).unwrap();
        self
    }

    fn fric(&self, args: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
        command.current_dir(&self.0).args(args).env_remove("NO_COLOR").stdin(Stdio::null());
        command
    }

    fn run(&self, args: &[&str]) -> Output {
        self.fric(args).output().unwrap()
    }

    /// Runs the command and checks the exit code and for words in the output; returns both streams.
    #[track_caller]
    fn check(&self, args: &[&str], code: i32, words: &str) -> (String, String) {
        let output = self.run(args);
        let (out, err) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
        assert_eq!(output.status.code(), Some(code), "{args:?}\n{out}\n{err}");
        assert!(out.contains(words) || err.contains(words), "{args:?}: no `{words}` in\n{out}\n{err}");
        assert!(!out.contains('\x1b') && !err.contains('\x1b'), "{args:?}: colour without a terminal");
        (out, err)
    }

    /// Names of the files in a subfolder.
    fn names(&self, below: &str) -> Vec<String> {
        let Ok(entries) = fs::read_dir(self.0.join(below)) else { return Vec::new() };
        let mut names: Vec<String> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }
}

#[test]
fn exit_codes_tell_how_it_went() {
    let folder = Folder::new("exit-codes").with("pull.fric", PULL);
    folder.check(&["run", "pull.fric", "holds"], 0, "✓ max(fr.F) < 1.1 N");
    folder.check(&["run", "pull.fric", "breaks"], 1, "✗ final(x) > 1 km");
    folder.check(&["run", "pull.fric", "hlods"], 1, "did you mean `holds`?");
    folder.check(&["test", "pull.fric"], 1, "1 passed, 1 failed\n");
    folder.check(&["--help"], 0, "Usage: fric");
    folder.check(&["run", "--help"], 0, "--set <PATH=VALUE>");
    folder.check(&["--version"], 0, "fric ");
}

#[test]
fn wrong_usage_and_wrong_input_have_different_exit_codes() {
    let folder = Folder::new("usage").with("pull.fric", PULL);
    folder.check(&["--nothing"], 2, "unexpected argument '--nothing'");
    folder.check(&["rnu"], 2, "unrecognized subcommand 'rnu'");
    folder.check(&["run"], 2, "<FILE>");
    folder.check(&["run", "pull.fric", "--step", "10"], 2, "a time needs its unit, for example 10s");
    folder.check(&["run", "pull.fric", "--step", "1N"], 2, "a time is needed, not a force");
    folder.check(&["run", "pull.fric", "--for=-1s"], 2, "greater than 0");
    folder.check(&["run", "pull.fric", "--solver", "rk5"], 2, "the solvers are euler, rk4, expo, implicit, adaptive");
    folder.check(&["run", "pull.fric", "--set", "k"], 2, "PATH=VALUE");
    folder.check(&["run", "pull.fric", "--tol", "0"], 2, "between 0 and 1");
    folder.check(&["run", "pull.fric", "holds", "--plot", "a.jpg"], 2, ".svg, .png or .pdf");
    folder.check(&["run", "pull.fric", "--data", "a.csv"], 2, "one experiment");
    folder.check(&["run", "pull.fric", "holds", "--data", "a.xls"], 2, ".mat (MATLAB) or .npz (NumPy)");
    assert_eq!(folder.names("."), ["pull.fric"], "wrong usage writes nothing");
}

#[test]
fn the_last_line_of_test_is_a_count() {
    let folder = Folder::new("test-count").with("pull.fric", PULL);
    let (out, _) = folder.check(&["test", "."], 1, "FAILED  breaks");
    assert_eq!(out.lines().last(), Some("1 passed, 1 failed"), "{out}");
    let (out, _) = folder.check(&["test", "-q", "pull.fric"], 1, "breaks");
    assert!(!out.contains("holds"), "{out}");
    let empty = Folder::new("test-nothing").with("a.fric", "const g = 9.81 m/s^2\n");
    let (out, _) = empty.check(&["test", "."], 1, "nothing to test");
    assert_eq!(out, "0 passed, 0 failed\n");
}

#[test]
fn files_are_written_where_they_were_asked_for() {
    let folder = Folder::new("files").with("pull.fric", PULL);
    folder.check(&["run", "pull.fric", "holds"], 0, "wrote out/holds.svg, out/holds.csv");
    assert_eq!(folder.names("out"), ["holds.csv", "holds.svg"]);
    let csv = fs::read_to_string(folder.0.join("out/holds.csv")).unwrap();
    assert!(csv.starts_with("t [s],x [mm],v [mm/s]\n"), "{}", csv.lines().next().unwrap_or_default());
    assert!(csv.lines().count() > 1000);

    folder.check(&["run", "pull.fric", "silent", "--out", "a/b"], 0, "a/b/silent.svg");
    assert_eq!(folder.names("a/b"), ["silent.csv", "silent.svg"]);
    folder.check(&["run", "pull.fric", "holds", "--plot", "p/x.png", "--csv", "c/x.csv"], 0, "p/x.png");
    assert!(fs::read(folder.0.join("p/x.png")).unwrap().starts_with(b"\x89PNG"));
    assert_eq!(folder.names("c"), ["x.csv"]);

    fs::write(folder.0.join("taken"), "").unwrap();
    folder.check(&["run", "pull.fric", "holds", "--out", "taken"], 1, "cannot write taken/holds.svg");
}

#[test]
fn json_is_json_and_writes_no_files_unasked() {
    let folder = Folder::new("json").with("pull.fric", PULL);
    let (out, err) = folder.check(&["run", "pull.fric", "--json"], 1, "");
    assert_eq!(err, "");
    let objects: Vec<Value> = out.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let names: Vec<&str> = objects.iter().map(|object| object["experiment"].as_str().unwrap()).collect();
    assert_eq!(names, ["holds", "breaks", "silent"]);
    assert_eq!((objects[0]["passed"].as_bool(), objects[1]["passed"].as_bool()), (Some(true), Some(false)));
    assert!(objects[0]["steps"].as_u64() == Some(2000) && objects[0]["wall_seconds"].is_number());
    assert!(objects[0]["compile_seconds"].as_object().is_some_and(|stages| !stages.is_empty()));
    let expect = &objects[0]["expects"][0];
    assert_eq!((expect["text"].as_str(), expect["unit"].as_str()), (Some("max(fr.F) < 1.1 N"), Some("N")));
    assert!(objects[0]["finals"]["x"]["unit"] == "mm" && objects[0]["finals"]["x"]["value"].is_number());
    assert_eq!(folder.names("."), ["pull.fric"]);

    let (out, _) = folder.check(&["check", "--json", "pull.fric"], 0, "");
    assert_eq!(serde_json::from_str::<Value>(&out).unwrap(), Value::Array(Vec::new()));
}

#[test]
fn quiet_says_nothing_when_all_is_well() {
    let folder = Folder::new("quiet").with("pull.fric", PULL);
    let (out, err) = folder.check(&["run", "-q", "pull.fric", "holds"], 0, "");
    assert_eq!((out.as_str(), err.as_str()), ("", ""));
    let (out, err) = folder.check(&["run", "-q", "pull.fric", "breaks"], 1, "final(x) > 1 km");
    assert!(out.is_empty() && err.contains('✗'), "{out}{err}");
}

#[test]
fn timings_name_every_stage_and_leave_the_standard_output_as_it_is() {
    let folder = Folder::new("timings").with("pull.fric", PULL);
    let stages = |table: &str| -> Vec<String> {
        let rows = table.lines().skip_while(|line| !line.starts_with("timings")).skip(1);
        rows.map(|row| row.split_whitespace().next().unwrap().to_string()).collect()
    };
    let (out, err) = folder.check(&["run", "--timings", "--json", "pull.fric", "holds"], 0, "");
    assert_eq!(out.lines().count(), 1);
    let compiled = ["arguments", "read", "parse", "models", "names", "flatten", "check", "lower", "code"];
    assert_eq!(stages(&err), [&compiled[..], &["run", "errors", "files", "other", "together"]].concat());
    let (_, err) = folder.check(&["run", "--timings", "--no-error", "pull.fric"], 1, "");
    assert_eq!(stages(&err), [&compiled[..], &["run", "files", "other", "together"]].concat(), "three experiments");
    let (_, err) = folder.check(&["check", "--timings", "pull.fric"], 0, "");
    assert_eq!(stages(&err), ["arguments", "read", "parse", "check", "other", "together"]);
    let (_, err) = folder.check(&["test", "--timings", "pull.fric"], 1, "");
    assert_eq!(stages(&err), [&compiled[..], &["run", "errors", "other", "together"]].concat());
    assert_eq!(folder.check(&["check", "pull.fric"], 0, "").1, "", "only on request");
}

#[test]
fn a_closed_pipe_is_no_failure() {
    let folder = Folder::new("closed-pipe").with("pull.fric", PULL);
    for args in [&["run", "pull.fric", "holds"][..], &["man"], &["completions", "bash"], &["test", "pull.fric"]] {
        let mut child = folder.fric(args).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        drop(child.stdout.take());
        let mut err = String::new();
        child.stderr.take().unwrap().read_to_string(&mut err).unwrap();
        let expected = i32::from(args[0] == "test");
        assert_eq!(child.wait().unwrap().code(), Some(expected), "{args:?}: {err}");
        assert_eq!(err, "", "{args:?}");
    }
    assert_eq!(folder.names("out"), ["holds.csv", "holds.svg"], "files are written all the same");
}

#[test]
fn bad_input_is_a_message_and_never_a_panic() {
    let folder = Folder::new("bad-input")
        .with("empty.fric", "")
        .with("binary.fric", [0x7f, b'E', b'L', b'F', 0, 1, 2])
        .with("latin1.fric", b"model A {\n  // \xe9\n}\n")
        .with("open.fric", "(".repeat(1 << 20))
        .with("deep.fric", format!("const a = {}1{}\n", "(".repeat(100_000), ")".repeat(100_000)))
        .with("words.fric", "once upon a time")
        .with("odd.fric", "\u{feff}model A {\r\n\tinput é [m]\r\n\u{1b}[31m\r\n}\u{202e}");
    fs::create_dir(folder.0.join("folder.fric")).unwrap();
    for (file, words) in [
        ("missing.fric", "there is no such file"),
        ("folder.fric", "it is a folder"),
        ("binary.fric", "byte 4 is zero"),
        ("latin1.fric", "line 2"),
        ("empty.fric", "empty.fric:1:1"),
        ("open.fric", "open.fric:1:"),
        ("deep.fric", "deep.fric:1:"),
        ("words.fric", "words.fric:1:1"),
        ("odd.fric", "odd.fric:"),
    ] {
        let (_, err) = folder.check(&["run", file], 1, words);
        assert!(!err.contains("panicked") && err.len() < 20_000, "{file}: {} bytes of\n{err:.2000}", err.len());
    }
    folder.check(&["check", "empty.fric"], 1, "there is nothing in this file");
    folder.check(&["check", "missing.fric", "words.fric"], 1, "words.fric:1:1");
    let (out, _) = folder.check(&["check", "--short", "words.fric"], 1, "");
    assert!(out.starts_with("words.fric:1:1: E0"), "{out}");
    let (out, _) = folder.check(&["check", "--json", "words.fric"], 1, "");
    let found: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(found[0]["labels"][0]["line"], 1, "{out}");
    folder.check(&["test", "missing.fric"], 1, "0 passed, 1 failed");
    folder.check(&["fmt", "words.fric"], 1, "words.fric:1:1");
    assert_eq!(fs::read_to_string(folder.0.join("words.fric")).unwrap(), "once upon a time", "left as it was");
}

#[test]
fn formatting_reads_standard_input_and_can_only_look() {
    let folder = Folder::new("fmt").with("pull.fric", "const a = 1 N   \n");
    folder.check(&["fmt", "--check", "pull.fric"], 1, "pull.fric");
    assert_eq!(fs::read_to_string(folder.0.join("pull.fric")).unwrap(), "const a = 1 N   \n");
    folder.check(&["fmt", "pull.fric"], 0, "");
    assert_eq!(fs::read_to_string(folder.0.join("pull.fric")).unwrap(), "const a = 1 N\n");
    folder.check(&["fmt", "--check", "pull.fric"], 0, "");

    let mut child = folder.fric(&["fmt", "-"]).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    child.stdin.take().unwrap().write_all(b"const a = 1 N  \n").unwrap();
    let output = child.wait_with_output().unwrap();
    assert_eq!(String::from_utf8(output.stdout).unwrap(), "const a = 1 N\n");
}

#[test]
fn a_code_has_a_page() {
    let folder = Folder::new("explain");
    folder.check(&["explain", "E0101"], 0, "## E0101 units differ");
    folder.check(&["explain", "w0703"], 0, "not-dissipative");
    folder.check(&["explain", "E0100"], 1, "did you mean E01");
}

#[test]
fn a_new_folder_holds_a_model_that_passes() {
    let folder = Folder::new("new");
    folder.check(&["new", "mine"], 0, "fric run mine/model.fric");
    folder.check(&["test", "mine"], 0, "1 passed, 0 failed");
    folder.check(&["fmt", "--check", "mine/model.fric"], 0, "");
    folder.check(&["check", "mine/model.fric"], 0, "0 errors, 0 warnings");
    folder.check(&["new", "mine"], 1, "mine is not empty; nothing was changed");
}

#[test]
fn completions_and_the_man_page_are_printed() {
    let folder = Folder::new("completions");
    for shell in ["bash", "zsh", "fish"] {
        folder.check(&["completions", shell], 0, "explain");
    }
    folder.check(&["man"], 0, ".TH fric 1");
    folder.check(&["man", "run"], 0, "\\-\\-solver");
    folder.check(&["man", "--dir", "man1"], 0, "pages to man1");
    let help = folder.check(&["--help"], 0, "").0;
    let commands: Vec<&str> = help
        .lines()
        .skip_while(|line| *line != "Commands:")
        .skip(1)
        .take_while(|line| !line.is_empty())
        .filter_map(|line| line.strip_prefix("  ").filter(|line| !line.starts_with(' '))?.split(' ').next())
        .filter(|command| *command != "help")
        .collect();
    assert!(commands.len() > 25, "{help}");
    for command in commands {
        let page = fs::read_to_string(folder.0.join(format!("man1/fric-{command}.1"))).unwrap_or_default();
        assert!(page.contains(&format!(".TH fric-{command} 1")), "{command}: {page}");
    }
    assert!(folder.names("man1").contains(&"fric.1".to_string()));
    folder.check(&["man", "run", "--dir", "man1"], 2, "");
    fs::write(folder.0.join("file"), "").unwrap();
    let (_, err) = folder.check(&["man", "--dir", "file/man1"], 1, "");
    assert!(err.contains("cannot write file/man1/fric.1: "), "{err}");
}

#[test]
fn colour_is_for_terminals_and_no_color_turns_it_off() {
    let folder = Folder::new("colour").with("words.fric", "once upon a time");
    // `script` of util-linux provides a terminal.
    let on_terminal = |no_color: &str| {
        let line = format!("{} check words.fric", env!("CARGO_BIN_EXE_fric"));
        let mut command = Command::new("script");
        command.current_dir(&folder.0).args(["-qec", &line, "/dev/null"]).stdin(Stdio::null());
        command.env("TERM", "xterm").env("NO_COLOR", no_color).output().expect("there is `script` of util-linux").stdout
    };
    let (with, without) = (on_terminal(""), on_terminal("1"));
    assert!(with.contains(&0x1b), "{}", String::from_utf8_lossy(&with));
    assert!(!without.contains(&0x1b), "{}", String::from_utf8_lossy(&without));
}

#[test]
fn mistakes_in_models_have_places() {
    let model =
        |body: &str| format!("model A {{ {body} }}\nexperiment e {{ run A() for 10 ms  solver rk4 step 1 ms }}\n");
    let folder = Folder::new("mistakes")
        .with("undefined.fric", model("output F [N] = Fs"))
        .with("cycle.fric", model("let a [N] = b  let b [N] = a  output F [N] = a"))
        .with("duplicate.fric", model("output F [N] = 1 N  F = 2 N"))
        .with("missing.fric", model("state z [um] = 0  output F [N] = 1 N/m * z"))
        .with("nan.fric", model("state z [m] = 0  dz/dt = 1 m/s * sqrt(-1 - z / 1 m)"));
    folder.check(&["run", "undefined.fric"], 1, "there is no `Fs` in A");
    folder.check(&["run", "cycle.fric"], 1, "E0401");
    folder.check(&["run", "duplicate.fric"], 1, "duplicate.fric:1:");
    folder.check(&["run", "missing.fric"], 1, "nothing determines `z`");
    folder.check(&["run", "nan.fric"], 1, "nan.fric:");
    let (out, err) = folder.check(&["run", "--json", "missing.fric"], 1, "E0303");
    let object: Value = serde_json::from_str(&out).unwrap();
    assert_eq!((object["passed"].as_bool(), object["diagnostics"][0]["code"].as_str()), (Some(false), Some("E0303")));
    assert!(err.contains("nothing determines"), "{err}");
}

#[test]
fn a_sweep_is_one_figure_and_a_file_of_data_each() {
    let sweep = "experiment sweeps { run Pull() for 1 s  solver rk4 step 1 ms  sweep k = 1 N/m, 2 N/m  plot x [mm] }";
    let folder = Folder::new("sweep").with("pull.fric", format!("{PULL}{sweep}\n"));
    folder.check(&["run", "pull.fric", "sweeps"], 0, "2 cases");
    assert_eq!(folder.names("out"), ["sweeps-k-1-N-m.csv", "sweeps-k-2-N-m.csv", "sweeps.svg"]);
    let (out, _) = folder.check(&["run", "pull.fric", "sweeps", "--json"], 0, "");
    let cases: Vec<Value> =
        out.lines().map(|line| serde_json::from_str::<Value>(line).unwrap()["case"].take()).collect();
    assert_eq!(cases, ["k = 1 N/m", "k = 2 N/m"]);
    // A setting on the command line replaces the sweep.
    let (out, _) = folder.check(&["run", "pull.fric", "sweeps", "--json", "--set", "k=3 N/m"], 0, "");
    assert_eq!(out.lines().count(), 1, "{out}");
}

#[test]
fn a_model_can_be_exported() {
    let folder = Folder::new("build").with("pull.fric", PULL);
    let (source, _) = folder.check(&["build", "pull.fric", "Contact", "--emit", "c"], 0, "CONTACT_Fc");
    assert!(source.contains("uint64_t contact_step(double *block, uint64_t count)"), "{source}");
    folder.check(&["build", "pull.fric", "holds", "--emit", "c", "-o", "pull.c"], 0, "wrote pull.c");
    let gcc = ["-std=c11", "-Wall", "-Wextra", "-pedantic", "-Werror", "-c", "pull.c", "-o", "pull.o"];
    let built = Command::new("gcc").args(gcc).current_dir(&folder.0).output().expect("gcc runs");
    assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
    for target in ["x86_64", "aarch64"] {
        let out = format!("{target}.bin");
        folder.check(&["build", "pull.fric", "Pull", "--emit", "blob", "--target", target, "-o", &out], 0, "wrote");
        assert!(fs::read(folder.0.join(out)).unwrap().starts_with(b"FRICCODE"));
    }
    folder.check(&["build", "pull.fric", "--emit", "c"], 2, "Name one of Contact, Pull, holds, breaks, silent");
    folder.check(&["build", "pull.fric", "Contakt", "--emit", "c"], 1, "did you mean `Contact`?");
    folder.check(&["build", "pull.fric", "Pull", "--emit", "blob"], 2, "--out");
    folder.check(&["build", "pull.fric", "Pull", "--emit", "c", "--set", "fr.Fz=2N"], 1, "Fz");
    folder.check(&["build", "pull.fric", "Pull", "--emit", "blob", "--target", "z80", "-o", "x"], 2, "x86_64, aarch64");
    assert!(!folder.0.join("x").exists());
}

#[test]
fn a_model_becomes_a_function_for_python() {
    let text = "model M {\n  input u [N]\n  param m = 2 kg in > 0\n  state v [m/s] = 0\n  dv/dt = u / m\n}\n\
                model Jumps {\n  input u [N]\n  state v [m/s] = 0\n  dv/dt = u / 1 kg\n  when v > 1 m/s { reset(v) = 0 }\n}\n\
                experiment pushed { run M(u = 2 N) for 1 s }\n";
    let folder = Folder::new("python").with("m.fric", text);
    for (dialect, word) in
        [("numpy", "import numpy as np"), ("jax", "jax.numpy"), ("casadi", "ca.Function"), ("sympy", "sp.Symbol")]
    {
        let (source, _) = folder.check(&["build", "m.fric", "M", "--emit", dialect], 0, word);
        assert!(source.contains("u / m") && source.contains("\"m\",  # kg, from 0"), "{source}");
        folder.check(&["build", "m.fric", "pushed", "--emit", dialect], 0, "INPUTS = ()");
        folder.check(&["build", "m.fric", "Jumps", "--emit", dialect], 1, "m.fric:11:3");
        folder.check(&["build", "m.fric", "Jumps", "--emit", dialect], 1, "E0911");
    }
    folder.check(&["build", "m.fric", "M", "--emit", "numpy", "-o", "m.py"], 0, "wrote m.py");
    folder.check(&["build", "m.fric", "M", "--emit", "numpy", "-o", "made/"], 2, "only C code");
    folder.check(&["build", "m.fric", "M", "--emit", "numpy", "--solver", "rk4"], 2, "no steps");
    folder.check(&["build", "m.fric", "M", "--emit", "numpy", "--set", "m=0kg"], 1, "m");
    folder.check(&["build", "m.fric", "M", "--emit", "nunpy"], 2, "numpy");
}

/// C code in a folder: two files that compile without warnings, as C and as C++, and compute the bits of the run.
#[test]
fn a_model_goes_into_a_folder_with_its_header() {
    let text =
        PULL.replace("plot   x [mm], v [mm/s]", "record x [m], v [m/s]\n  allow  discretisation \"its own steps\"");
    let folder = Folder::new("headed").with("pull.fric", &text);
    folder.check(&["build", "pull.fric", "holds", "-o", "c/"], 0, "wrote c/pull.c and c/pull.h");
    let header = fs::read_to_string(folder.0.join("c/pull.h")).unwrap();
    for wanted in
        ["double fr_Fc;", "/* parameter, N, from 0 */", "pull_t;", "uint64_t pull_step(pull_t *m, uint64_t count);"]
    {
        assert!(header.contains(wanted), "{wanted}: {header}");
    }
    let main = "#include \"c/pull.h\"\n#include <stdio.h>\nint main(void)\n{\n    pull_t m;\n    pull_defaults(&m);\n    \
                m.h = 0.001;\n    pull_start(&m);\n    for (int k = 0; k < 2000; k++) if (pull_step(&m, 1)) return 1;\n    \
                printf(\"%.17g %.17g\", m.x, m.v);\n    return 0;\n}\n";
    fs::write(folder.0.join("main.c"), main).unwrap();
    fs::write(
        folder.0.join("use.cpp"),
        "#include \"c/pull.h\"\nint main() { pull_t m; pull_defaults(&m); return 0; }\n",
    )
    .unwrap();
    let run = |program: &str, args: &[&str]| {
        let done = Command::new(program).args(args).current_dir(&folder.0).output().expect("it runs");
        assert!(done.status.success(), "{program} {args:?}: {}", String::from_utf8_lossy(&done.stderr));
        String::from_utf8(done.stdout).unwrap()
    };
    let strict = ["-std=c11", "-O2", "-Wall", "-Wextra", "-pedantic", "-Werror"];
    run("gcc", &[&strict[..], &["main.c", "c/pull.c", "-o", "pull", "-lm"]].concat());
    run("g++", &["-std=c++17", "-Wall", "-Wextra", "-Werror", "-c", "use.cpp", "-o", "use.o"]);
    let numbers = |text: &str| -> Vec<f64> {
        text.split([' ', ',']).map(|number| number.trim().parse().expect("a number")).collect()
    };
    let ended = numbers(&run("./pull", &[]));
    folder.check(&["run", "pull.fric", "holds", "--data", "pull.csv"], 0, "wrote pull.csv");
    let rows = fs::read_to_string(folder.0.join("pull.csv")).unwrap();
    assert!(rows.starts_with("t [s],x [m],v [m/s]\n"), "{rows}");
    assert_eq!(numbers(rows.lines().last().unwrap())[1..], ended[..], "the bits of the simulation");
    // A field after a memory without a name, and one whose name C has taken.
    let late = "model Late {\n  input  u [m]\n  output double [m] = delay(u, 5 ms)\n  output z [m] = 2 * double\n}\n";
    fs::write(folder.0.join("late.fric"), late).unwrap();
    folder.check(&["build", "late.fric", "--step", "1ms", "-o", "c"], 0, "wrote c/late.c and c/late.h");
    run("gcc", &[&strict[..], &["-c", "c/late.c", "-o", "late.o"]].concat());
    let header = fs::read_to_string(folder.0.join("c/late.h")).unwrap();
    assert!(header.contains("double memory_") && header.contains("double double_;"), "{header}");
    // Only C goes into a folder, and only what has a step.
    folder.check(&["build", "pull.fric", "holds", "--emit", "ir", "-o", "c/"], 2, "c/ is a folder");
    for out in [&["-o", "c/"][..], &["--emit", "c"]] {
        let all = [&["build", "pull.fric", "Pull", "--solver", "adaptive"], out].concat();
        folder.check(&all, 1, "give it fixed ones, with `--solver rk4`");
    }
}

/// What an experiment records is written without a plot, as often as it says.
#[test]
fn an_experiment_records_without_a_plot() {
    let text = PULL.replace("plot   x [mm], v [mm/s]", "record x [mm], fr.F every 0.5 s");
    let folder = Folder::new("recorded").with("pull.fric", &text);
    let (said, _) = folder.check(&["run", "pull.fric", "holds"], 0, "wrote out/holds.csv");
    assert!(!said.contains("svg"), "{said}");
    let rows = fs::read_to_string(folder.0.join("out/holds.csv")).unwrap();
    let lines: Vec<&str> = rows.lines().collect();
    assert_eq!((lines.len(), lines[0]), (6, "t [s],x [mm],fr.F [N]"), "{rows}");
    folder.check(&["run", "pull.fric", "holds", "--every", "1s", "--data", "-"], 0, "\n2,");
    let (every, _) = folder.check(&["run", "pull.fric", "holds", "--every", "1s", "--data", "-"], 0, "");
    assert_eq!(every.lines().count(), 4, "{every}");
    folder.check(&["run", "pull.fric", "holds", "--plot", "x.svg"], 1, "add `plot` with what to draw");
    folder.check(&["run", "pull.fric", "breaks", "--data", "x.csv"], 1, "add `record` with what to record");
}

/// Listings name the slots of the block, contain one function after the other, and show the code that runs: expanded,
/// fused, without calls except of the function itself for more than one iteration.
#[test]
fn intermediate_forms_are_readable() {
    let folder = Folder::new("listings").with("pull.fric", PULL);
    for (name, method, functions) in [
        ("Pull", "expo", &["start", "outputs", "step"][..]),
        ("holds", "rk4", &["start", "outputs", "step"]),
        ("Pull", "adaptive", &["start", "outputs", "derivatives", "jacobian", "rosenbrock"]),
    ] {
        let listing = |emit: &str, more: &[&str]| {
            let all = ["build", "pull.fric", name, "--emit", emit, "--solver", method];
            folder.check(&[&all[..], more].concat(), 0, "").0
        };
        // The address of the state x, from the header.
        let place = |text: &str, what: &str| -> usize {
            let line = text.lines().find(|line| line.starts_with(';') && line.ends_with(what));
            let line = line.unwrap_or_else(|| panic!("no place of {what}: {text}"));
            line.split_whitespace().nth(1).and_then(|word| word.parse().ok()).expect("a number")
        };

        let ir = listing("ir", &[]);
        assert!(ir.starts_with("; Pull") && ir.contains(&format!(", by {method}.")), "{ir}");
        let titles: Vec<&str> =
            ir.lines().filter_map(|line| line.strip_suffix(':')).filter(|title| !title.starts_with(';')).collect();
        assert_eq!(titles, functions);
        let mut next = 0;
        for line in ir.lines() {
            let Some((value, op)) = line.strip_prefix("  v").and_then(|line| line.split_once(" = ")) else {
                next = if line.starts_with("  ") { next } else { 0 };
                continue;
            };
            assert_eq!(value.parse(), Ok(next), "values are counted: {line}");
            let operands = op.split([' ', '[', ']']).filter_map(|word| word.strip_prefix('v')?.parse::<usize>().ok());
            operands.for_each(|operand| assert!(operand < next, "an operand of a later line: {line}"));
            assert!(!op.starts_with("tanh") && !op.starts_with("exp"), "elementary functions are arithmetic: {line}");
            next += 1;
        }
        assert!(ir.contains(" = fma v"), "{ir}");
        let x = place(&ir, "x [m]");
        assert!(ir.contains(&format!("  store {x} = v")), "something gives x its value: {ir}");

        for (target, fused, store) in [("x86_64", "vfmadd", "(%rdi)"), ("aarch64", "fmadd d", "[x0, #")] {
            let clif = listing("clif", &["--target", target]);
            let titles: Vec<&str> =
                clif.lines().filter_map(|line| line.strip_prefix("; ")).filter(|it| !it.contains(' ')).collect();
            assert_eq!(titles, functions);
            let singles = clif.lines().filter(|line| line.starts_with("; one iteration")).count();
            let begins = |line: &&str| line.starts_with("function") && line.contains("(i64, i64, i64) -> i64");
            assert_eq!(clif.lines().filter(begins).count(), functions.len() + singles, "{clif}");
            assert_eq!(clif.matches("call ").count(), singles, "{clif}");
            assert!(clif.lines().all(|line| !line.contains("fn0 = ") || line.contains("colocated")), "{clif}");
            assert!(singles > 0 && clif.contains(" = fma "), "{clif}");
            assert_eq!(place(&clif, "x [m]"), 8 * x);
            assert!(clif.lines().any(|line| line.contains("store") && line.contains(&format!("+{}", 8 * x))), "{clif}");

            let asm = listing("asm", &["--target", target]);
            let titles: Vec<&str> =
                asm.lines().filter_map(|line| line.strip_prefix("; ")).filter(|it| !it.contains(' ')).collect();
            assert_eq!(titles, functions);
            assert_eq!(place(&asm, "x [m]"), 8 * x);
            assert!(asm.contains(fused), "{target} fuses products and sums: {asm}");
            assert!(asm.lines().any(|line| line.contains(store)), "it writes the block: {asm}");
            let calls = |line: &str| matches!(line.split_whitespace().next(), Some("call" | "callq" | "bl" | "blr"));
            assert_eq!(asm.lines().filter(|line| calls(line)).count(), singles, "it calls nothing else: {asm}");
            let returns = asm.lines().filter(|line| matches!(line.trim(), "ret" | "retq")).count();
            assert!(returns >= functions.len(), "each function ends: {asm}");
        }
    }
    // A single step comes first; one without `exp` and mode is short.
    let law = "model Law {\n  input  v [m/s]\n  param  Fc = 1 N\n  output F [N] = Fc * sign(v) + 3 N\n}\n";
    let folder = folder.with("law.fric", law);
    for target in ["x86_64", "aarch64"] {
        let (asm, _) = folder.check(&["build", "law.fric", "--emit", "asm", "--target", target], 0, "");
        let (_, single) = asm.split_once("; one iteration, or go on to more\n").expect("it has one");
        let (single, _) = single.split_once("; any number of iterations\n").expect("and all others");
        assert!(single.lines().count() < 60, "{single}");
    }
    // Delays are stored in steps.
    let late = "model Late {\n  input  u [N]\n  output y [N] = delay(u, 5 ms)\n}\n";
    let folder = folder.with("late.fric", late);
    for emit in ["ir", "c", "asm"] {
        folder.check(&["build", "late.fric", "--emit", emit], 2, "--step");
    }
    let (ir, _) = folder.check(&["build", "late.fric", "--emit", "ir", "--step", "1ms"], 0, "");
    assert!(ir.contains(" = ring ") && ir.contains("  write "), "{ir}");
    folder.check(&["build", "late.fric", "--emit", "ir", "--solver", "adaptive"], 0, "derivatives:");
    folder.check(&["build", "late.fric", "--emit", "ir", "--step", "10ms"], 1, "longer than this delay");
}

#[test]
fn a_step_can_be_timed() {
    let folder = Folder::new("bench").with("pull.fric", PULL);
    folder.check(&["bench", "pull.fric", "holds"], 0, "one instance:");
    let (out, _) = folder.check(&["bench", "pull.fric", "holds", "--json"], 0, "");
    let object: Value = serde_json::from_str(&out).unwrap();
    assert!(object["ns_per_step"].as_f64().unwrap() > 0.0 && object["operations"].as_u64().unwrap() > 20, "{out}");
    assert!(object["compile_seconds"]["code"].as_f64().unwrap() > 0.0, "{out}");
    folder.check(&["bench", "pull.fric", "hold"], 1, "did you mean `holds`?");
    folder.check(&["bench", "pull.fric", "holds", "--solver", "adaptive"], 2, "--solver expo");
}

#[test]
fn an_experiment_can_be_changed_from_outside() {
    let folder = Folder::new("changes").with("pull.fric", PULL);
    let args = ["run", "pull.fric", "holds", "--json", "--set", "fr.Fc=2N", "--for", "500 ms", "--step", "2ms"];
    let (out, _) = folder.check(&[&args[..], &["--solver", "euler"]].concat(), 0, "");
    let object: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(object["steps"], 250, "{out}");
    assert_eq!((&object["solver"]["method"], &object["solver"]["tol"]), (&Value::from("euler"), &Value::Null));
    folder.check(&["run", "pull.fric", "holds", "--set", "fr.Fz=2N"], 1, "Fz");
    folder.check(&["run", "pull.fric", "holds", "--set", "fr.Fc=2m"], 1, "E01");
    folder.check(&["run", "pull.fric", "holds", "--set", "fr.Fc=2 N +"], 1, "--set");
}

#[test]
fn files_that_would_hold_nothing_are_refused() {
    let folder = Folder::new("nothing").with("pull.fric", PULL);
    for (option, file, does, word) in [("--data", "a.csv", "records", "record"), ("--plot", "a.svg", "draws", "plot")] {
        let (_, err) = folder.check(&["run", "pull.fric", "breaks", option, file], 1, "");
        let wanted = format!("{option} has nothing to write: `breaks` {does} nothing; add `{word}`");
        assert!(err.contains(&wanted), "{err}");
    }
    assert_eq!(folder.names("."), ["pull.fric"]);
    folder.check(&["run", "pull.fric", "breaks", "--out", "a"], 1, "nothing to write: the experiment has no `plot`");
}

/// A text on the command line may be a pipe, because another process writes to it; an import must be a file, or the
/// command would block.
#[test]
fn a_text_that_names_a_pipe_is_refused_at_once() {
    let data = "model M { input v [m/s]  output y [m/s] = v }\n\
                experiment e { data \"pipe\" (t [s], v [m/s])  run M(v = data.v) for 1 s  solver rk4 step 1 ms }\n";
    let import = "import \"pipe\"\n";
    let folder = Folder::new("pipe").with("data.fric", data).with("import.fric", import);
    assert!(Command::new("mkfifo").arg(folder.0.join("pipe")).status().unwrap().success());
    for text in ["data.fric", "import.fric"] {
        let mut child = folder.fric(&["check", text]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let begun = std::time::Instant::now();
        while child.try_wait().unwrap().is_none() {
            if begun.elapsed().as_secs() > 60 {
                let _ = child.kill();
                panic!("{text}: it waits");
            }
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
        let output = child.wait_with_output().unwrap();
        let told = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
        assert!(output.status.code() == Some(1) && told.contains("it is a pipe or a device, not a file"), "{told}");
    }
}

#[test]
fn an_error_that_exceeds_the_margin_makes_the_verdict_undecided() {
    let text = r#"
model Decay {
  state x [m] = 1 m
  dx/dt = -x / 1 s
}
experiment coarse {
  run    Decay() for 1 s
  solver euler step 0.1 s
  expect final(x) ~= 348.7 mm +- 1 mm
}
experiment fine {
  run    Decay() for 1 s
  show   final(x) * 2 [mm]
  expect integral(x * 1 N / 1 s) ~= 0.6321 J +- 1 mJ
  expect final(x) / integral(x) ~= 0.58198 1/s +- 0.1 %
}
"#;
    let folder = Folder::new("undecided").with("decay.fric", text);
    // With ten steps x is 0.349 m, exactly 0.368 m.
    let (out, _) = folder.check(&["run", "decay.fric", "coarse"], 1, "undecided: the error");
    assert!(out.contains("discretisation by adaptive runs, tol 1e-7 and 1e-9, and steps of 50 ms and 25 ms"), "{out}");
    folder.check(&["run", "decay.fric", "coarse", "--no-error"], 0, "348.678 mm, margin");
    folder.check(&["test", "decay.fric"], 1, "1 passed, 1 failed");
    folder.check(&["test", "decay.fric", "--no-error"], 0, "2 passed, 0 failed");
    let (out, _) = folder.check(&["run", "decay.fric", "--json"], 1, "");
    let objects: Vec<Value> = out.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let expect = &objects[0]["expects"][0];
    assert_eq!((&expect["holds"], &expect["decided"], &expect["unit"]), (&true.into(), &false.into(), &"mm".into()));
    let (value, error) = (expect["value"].as_f64().unwrap(), expect["error"].as_f64().unwrap());
    let truth = 367.879_441_171_442_3;
    assert!((value - truth).abs() < 1.5 * error && error < 3.0 * (value - truth).abs(), "{value} {error}");
    let companions = ["adaptive tol 1e-7", "adaptive tol 1e-9", "euler step 50 ms", "euler step 25 ms"];
    assert_eq!(objects[0]["errors"]["companions"], serde_json::json!(companions));
    // The solver that is reported to decide does.
    let decides = objects[0]["errors"]["decides"].as_str().map(|s| s.replace("euler step ", "").replace(' ', ""));
    if let Some(step) = decides {
        let (out, _) = folder.check(&["run", "decay.fric", "coarse", "--step", &step], 1, "");
        assert!(!out.contains("undecided"), "{step}: {out}");
    }
    let shown = &objects[1]["shows"][0];
    assert!((shown["value"].as_f64().unwrap() - 2.0 * truth).abs() < 1e-2 && shown["unit"] == "mm", "{shown}");
    assert_eq!(objects[1]["expects"][0]["unit"], "J");
    assert_eq!(objects[1]["expects"][1]["unit"], "1/s");
    // More digits.
    let (out, _) = folder.check(&["run", "decay.fric", "fine", "--no-error", "--digits", "12"], 0, "");
    assert!(out.contains("735.758882"), "{out}");
}

/// Varied numbers without a unit: one determines the number of parts, which is compiled in, and another an initial
/// state.
#[test]
fn a_sweep_varies_plain_numbers() {
    let text = r#"
model One { output b [1] = 1 }
model Many {
  param  n = 3  in 1 .. 10
  param  follows = 2 * n
  state  x [1] = n
  part   q[i in 1 .. n] = One()
  dx/dt  = -x / 1 s
  output o [1] = sum(q.b)
  output p [1] = x + follows
}
experiment it {
  run    Many() for 10 ms
  expect final(o) > 0
  expect at(p, 0 s) > 0
}
"#;
    let folder = Folder::new("plain").with("many.fric", text);
    let (_, said) = folder.check(&["sweep", "many.fric", "it", "--vary", "n = 2, 5", "--out", "a.csv"], 1, "");
    assert!(said.contains("decides how many parts"), "{said}");
    for (vary, found) in [("x = 4, 5", ["10", "11"]), ("follows = 1, 2", ["4", "5"])] {
        folder.check(&["sweep", "many.fric", "it", "--vary", vary, "--out", "b.csv", "-q"], 0, "");
        let table = fs::read_to_string(folder.0.join("b.csv")).unwrap();
        let rows: Vec<&str> = table.lines().skip(1).collect();
        for (row, found) in rows.iter().zip(found) {
            assert!(row.contains(&format!(",{found},true,ok")), "{vary}: {table}");
        }
    }
}

/// A measure composed of measures is shown in their unit, an integral of a power as an energy.
#[test]
fn measures_are_shown_in_their_own_units() {
    let text = r#"
model Pushed {
  state  x [mm] = 0
  output F [N]   = 2 N
  output v [m/s] = 1 m/s
  dx/dt = v
}
experiment it {
  run  Pushed() for 1 s
  show integral(F * v)
  show 3 * integral(F * v) / 2
  show integral(F * v) - integral(F * v)
  show -final(x)
  show final(x) + max(v) * 1 s
  show integral(F)
  show 2 * final(x) * final(F)
}
"#;
    let folder = Folder::new("units").with("pushed.fric", text);
    let (out, _) = folder.check(&["run", "pushed.fric", "--json", "--no-error"], 0, "");
    let object: Value = serde_json::from_str(out.lines().next().unwrap()).unwrap();
    let shown =
        |k: usize| (object["shows"][k]["value"].as_f64().unwrap(), object["shows"][k]["unit"].as_str().unwrap());
    let expected = [(2.0, "J"), (3.0, "J"), (0.0, "J"), (-1000.0, "mm"), (2.0, "m"), (2.0, "N·s"), (4.0, "N·m")];
    for (k, (value, unit)) in expected.into_iter().enumerate() {
        let found = shown(k);
        assert!((found.0 - value).abs() < 1e-9 && found.1 == unit, "{k}: {found:?}, not {value} {unit}");
    }
}

#[test]
fn data_is_every_step_in_the_format_of_its_name() {
    let folder = Folder::new("data").with("pull.fric", PULL);
    // 20,001 rows, of which a plot needs a part.
    let run = |more: &[&str]| folder.run(&[&["run", "pull.fric", "holds", "--step", "100us"], more].concat());
    let rows = |name: &str| fs::read_to_string(folder.0.join(name)).unwrap().lines().count();
    assert_eq!(run(&["--data", "a.csv"]).status.code(), Some(0));
    assert_eq!(rows("a.csv"), 20_002);
    let done = run(&["--data", "thin.csv", "--thin"]);
    let words = String::from_utf8_lossy(&done.stdout);
    assert!((1000..15_000).contains(&rows("thin.csv")) && words.contains(" of 20,001 steps)"), "{words}");
    let magic: [(&str, &[u8]); 3] = [("a.parquet", b"PAR1"), ("a.mat", b"MATLAB 5.0"), ("a.npz", b"PK")];
    for (name, begin) in magic {
        assert_eq!(run(&["--data", name]).status.code(), Some(0));
        assert!(fs::read(folder.0.join(name)).unwrap().starts_with(begin), "{name}");
    }
    let done = run(&["--data", "a.xls"]);
    assert_eq!(done.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&done.stderr).contains("ends in .csv, .parquet, .mat (MATLAB) or .npz (NumPy)"));
    assert_eq!(run(&["--thin", "--json"]).status.code(), Some(2));
    assert_eq!(run(&["--thin", "--every", "1ms"]).status.code(), Some(2));
    // What was written is a recording for another experiment, whatever the format.
    let again = |name: &str| {
        let text = format!(
            "model Same {{ input v [m/s]  output y [m/s] = v }}\nexperiment same {{\n  run Same(v = data.v)\n  \
             data \"{name}\" (v [m/s] = \"v\", t = \"t\")\n  show final(y)\n}}\n"
        );
        fs::write(folder.0.join("same.fric"), text).unwrap();
        let done = folder.run(&["run", "same.fric", "--json"]);
        assert_eq!(done.status.code(), Some(0), "{name}: {done:?}");
        String::from_utf8_lossy(&done.stdout).split("\"value\":").nth(1).unwrap().split(',').next().unwrap().to_string()
    };
    let csv = again("a.csv");
    for name in ["a.parquet", "a.mat", "a.npz"] {
        assert_eq!(again(name), csv, "{name}");
    }
}

#[test]
fn several_experiments_make_one_figure() {
    let folder = Folder::new("together").with("pull.fric", PULL);
    folder.check(
        &["run", "pull.fric", "holds", "silent", "--plot", "both.svg", "--size", "170x60mm", "--columns", "2"],
        0,
        "wrote both.svg",
    );
    let text = fs::read_to_string(folder.0.join("both.svg")).unwrap();
    assert!(
        text.contains("width=\"170.00mm\" height=\"60.00mm\"") && text.contains(">holds<") && text.contains(">silent<")
    );
    folder.check(
        &["run", "pull.fric", "silent", "--plot", "a.pdf", "--font", "9pt", "--lines", "grey", "--title", ""],
        0,
        "a.pdf",
    );
    assert!(fs::read(folder.0.join("a.pdf")).unwrap().starts_with(b"%PDF"));
    for wrong in [["--size", "85x60"], ["--size", "1x1mm"], ["--font", "8"], ["--lines", "red"], ["--columns", "0"]] {
        let done = folder.run(&[&["run", "pull.fric", "silent", "--plot", "b.pdf"], &wrong[..]].concat());
        assert_eq!(done.status.code(), Some(2), "{wrong:?}");
    }
    assert!(!folder.0.join("b.pdf").exists());
}

/// A figure for a paper is made from one text, and by every format of it.
#[test]
fn the_figure_of_the_example_is_made_from_its_text() {
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/paper-figure");
    let read = |name: &str| fs::read(example.join(name)).unwrap();
    let folder =
        Folder::new("paper").with("p.fric", read("paper_figure.fric")).with("measured.csv", read("measured.csv"));
    let run = |more: &[&str]| {
        let both = ["run", "p.fric", "hysteresis", "break_away", "--no-error", "--size", "174x75mm", "--columns", "2"];
        let done = folder.run(&[&both, more].concat());
        assert_eq!(done.status.code(), Some(0), "{done:?}");
    };
    run(&["--plot", "a.svg"]);
    let svg = fs::read_to_string(folder.0.join("a.svg")).unwrap();
    let words = [
        "(a) hysteresis in presliding",
        "(b) break-away",
        "measured",
        "friction force [N]",
        "displacement [µm]",
        "break-away force [N]",
        "force rate [N/s]",
    ];
    for word in words {
        assert!(svg.contains(&format!(">{word}<")), "{word}: {svg}");
    }
    // The recording is drawn once, although three models run; nothing is called by its expression.
    assert_eq!(svg.matches(">measured<").count(), 1);
    assert!(!svg.contains("fr.F") && !svg.contains("data.F"));
    run(&["--plot", "a.pdf"]);
    let pdf = fs::read(folder.0.join("a.pdf")).unwrap();
    let text = String::from_utf8_lossy(&pdf);
    // 174 mm are 493.23 points.
    assert!(text.contains("/MediaBox [0 0 493.2") && text.contains("/FontFile2"), "{}", &text[..600]);
}

#[test]
fn rows_of_a_csv_lie_on_a_grid() {
    let folder = Folder::new("every").with("pull.fric", PULL);
    let done = folder.run(&["run", "pull.fric", "holds", "--every", "0.1s", "--csv", "a.csv"]);
    assert_eq!(done.status.code(), Some(0), "{done:?}");
    let text = fs::read_to_string(folder.0.join("a.csv")).unwrap();
    let times: Vec<&str> = text.lines().skip(1).map(|row| row.split(',').next().unwrap()).collect();
    assert_eq!((times.len(), times[0], times[3], times[20]), (21, "0", "0.3", "2"), "{text}");
    for (every, code, said) in [
        ("0s", 2, "greater than 0"),
        ("-1ms", 2, "greater than 0"),
        ("1", 2, "needs its unit"),
        ("1mm", 2, "a time is needed"),
        ("nan s", 2, ""),
        ("3s", 1, "too few in a run of 2 s"),
        ("1.5ms", 1, "do not lie on steps of 0.001 s"),
    ] {
        let done = folder.run(&["run", "pull.fric", "holds", &format!("--every={every}"), "--csv", "b.csv"]);
        let words = String::from_utf8_lossy(&done.stderr);
        assert!(done.status.code() == Some(code) && words.contains(said), "{every}: {done:?}");
        assert!(!folder.0.join("b.csv").exists(), "{every} leaves a file");
    }
    let done = folder.run(&["run", "pull.fric", "holds", "--solver", "adaptive", "--every", "100ns", "--csv", "b.csv"]);
    assert!(String::from_utf8_lossy(&done.stderr).contains("20000001 rows are too many"), "{done:?}");
    let done = folder.run(&["run", "pull.fric", "holds", "--every", "1ms", "--json"]);
    assert_eq!(done.status.code(), Some(2), "{done:?}");
}

/// A spring pulled at a speed: its force is k vp t, so each measure of a case has a closed form.
const SPRING: &str = r#"
model Spring {
  param  vp = 0.1 m/s
  param  k = 2 N/m  in > 0
  state  x [m] = 0
  dx/dt  = vp
  output F [N] = k * x
}
"#;

/// `run` refuses what `check` refuses, also for steps given by options; `explain` names the same largest step.
#[test]
fn run_refuses_an_unstable_step() {
    let text = "model Decay { state x [m] = 1 m in -2 m .. 2 m  dx/dt = -x / 10 ms  output y [m] = x }\n\
                experiment e { run Decay() for 1 s  solver euler step 30 ms  plot y }\n";
    let folder = Folder::new("unstable").with("decay.fric", text);
    folder.check(&["check", "decay.fric"], 1, "E0702");
    folder.check(&["run", "decay.fric"], 1, "stable up to a step of 20 ms only");
    assert!(folder.names("out").is_empty(), "nothing is written");
    folder.check(&["run", "decay.fric", "--step", "10ms"], 0, "wrote");
    let (_, said) = folder.check(&["run", "decay.fric", "--solver", "rk4", "--step", "50ms"], 1, "E0702");
    assert!(said.contains("`--solver expo`") && said.contains("28 ms"), "{said}");
    folder.check(&["explain", "decay.fric", "e"], 0, "euler 20 ms, rk4 28 ms, expo any, implicit any");
    folder.check(&["explain", "decay.fric", "f"], 1, "no model, experiment or rig `f`");
    folder.check(&["run", "decay.fric", "--step", "10ms", "--cross"], 0, "largest difference");
}

/// An expectation for one case of a sweep, a logarithmic grid, a window up to an event; the table of all cases.
#[test]
fn a_sweep_answers_its_question() {
    let text = format!(
        "{SPRING}experiment e {{\n  run    Spring() for 1 s\n  sweep  k = 1 N/m .. 100 N/m log 3\n\
         \x20 expect max(F) ~= 1 N +- 1 % for k = 10 N/m\n  show   max(F) before first(x > 50 mm)\n}}\n"
    );
    let folder = Folder::new("cases").with("spring.fric", text);
    let (out, _) = folder.check(&["run", "spring.fric", "--no-error"], 0, "k = 100 N/m");
    let table: Vec<&str> = out.lines().skip_while(|line| !line.trim_start().starts_with("max(F)")).collect();
    let of = |case: &str| {
        let line = table.iter().find(|line| line.trim_start().starts_with(case)).unwrap_or_else(|| panic!("{out}"));
        line[line.find(case).unwrap() + case.len()..].split_whitespace().collect::<Vec<_>>().join(" ")
    };
    // 50 mm are reached half-way; only the middle case is judged.
    assert_eq!([of("k = 1 N/m"), of("k = 100 N/m")], ["0.05 N - -", "5 N - -"].map(str::to_string), "{out}");
    assert_eq!(of("k = 10 N/m"), "0.5 N 1 N ✓", "{out}");

    let vary = ["sweep", "spring.fric", "e", "--no-error", "--set", "k=3N/m", "--vary", "vp = 0.1 m/s .. 1 m/s lin 4"];
    let (out, _) = folder.check(&vary, 0, "vp [m/s]");
    assert!(
        out.contains("run") && out.lines().any(|line| line.split_whitespace().take(3).eq(["3", "1", "0.15"])),
        "{out}"
    );
    let best = ["sweep", "spring.fric", "e", "--no-error", "--set", "k=3N/m", "--vary", "vp = 0.1 m/s .. 1 m/s lin 4"];
    let (out, _) =
        folder.check(&[&best[..], &["--best", "2", "by", "greatest", "final(F) - 1 N"]].concat(), 0, "final(F) - 1 N");
    let rows: Vec<Vec<&str>> = out.lines().map(|line| line.split_whitespace().collect()).collect();
    let ranked: Vec<&str> =
        rows.iter().filter(|row| row.len() > 3 && row[0].parse::<u32>().is_ok()).map(|row| row[0]).collect();
    assert_eq!(ranked, ["3", "2"], "{out}");
    folder.check(&[&best[..], &["--best", "2 by nonsense(F)"]].concat(), 1, "nonsense");
    folder.check(&["sweep", "spring.fric", "e", "--no-error", "-q"], 0, "");
    assert_eq!(
        fs::read_to_string(folder.0.join("sweep.csv")).unwrap().lines().count(),
        4,
        "the experiment's own sweep"
    );
}

/// Two expectations on one measure have one column; arithmetic over measures has one too.
#[test]
fn a_table_has_each_column_once() {
    let text = format!(
        "{SPRING}experiment e {{\n  run    Spring() for 1 s\n  expect max(F) > 0.1 N\n  expect max(F) < 1 N\n\
         \x20 expect max(F) - min(F) < 0.5 N\n  expect max(F) < 0.15 N before 0.5 s\n}}\n"
    );
    let folder = Folder::new("columns").with("spring.fric", text);
    folder.check(&["sweep", "spring.fric", "e", "--no-error", "-q", "--vary", "k = 1 N/m, 2 N/m"], 0, "");
    let table = fs::read_to_string(folder.0.join("sweep.csv")).unwrap();
    let head: Vec<&str> = table.lines().next().unwrap().split(',').collect();
    let mut once = head.clone();
    once.sort_unstable();
    once.dedup();
    assert_eq!(once.len(), head.len(), "{table}");
    let at = |title: &str| head.iter().position(|one| *one == title).unwrap_or_else(|| panic!("no {title}: {table}"));
    let row: Vec<&str> = table.lines().nth(2).unwrap().split(',').collect();
    for (title, value) in [("max(F) [N]", 0.2), ("max(F) - min(F) [N]", 0.2), ("max(F) before 0.5 s [N]", 0.1)] {
        let found: f64 = row[at(title)].parse().unwrap();
        assert!((found - value).abs() < 1e-9, "{title}: {table}");
    }
}

#[test]
fn texts_come_from_a_pipe_and_pictures_go_into_one() {
    let folder = Folder::new("pipes");
    let piped = |args: &[&str], text: &str| {
        let mut child =
            folder.fric(args).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        child.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
        child.wait_with_output().unwrap()
    };
    let picture = piped(&["run", "-", "silent", "--plot", "-"], PULL);
    let svg = String::from_utf8(picture.stdout).unwrap();
    assert!(picture.status.success() && svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"), "{svg}");
    let rise = "model M { state x [mm] = 0  dx/dt = 1 mm/s }
        experiment one { run M() for 1 s  plot x [mm] }
        experiment two { run M() for 2 s  plot x [mm] }";
    let common = piped(&["run", "-", "--plot", "-"], rise);
    let svg = String::from_utf8(common.stdout).unwrap();
    assert!(common.status.success() && svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"), "{svg}");
    assert!(svg.contains(">one<") && svg.contains(">two<") && !folder.0.join("-").exists(), "{svg}");
    let table = piped(&["run", "-", "silent", "--data", "-"], PULL);
    assert!(String::from_utf8(table.stdout).unwrap().starts_with("t [s],x [mm]\n"));
    let failing = piped(&["run", "-", "breaks", "--data", "-"], PULL);
    assert_eq!(failing.status.code(), Some(1), "nothing to write");
    let both = piped(&["run", "-", "silent", "--data", "-", "--plot", "-"], PULL);
    assert_eq!(both.status.code(), Some(2));
    let checked = piped(&["check", "-"], "const a = 1 N + 1 m\n");
    assert_eq!(checked.status.code(), Some(1));
    assert!(String::from_utf8(checked.stdout).unwrap().contains("E0101"));
    assert!(folder.names("out").is_empty());
}

#[test]
fn a_plot_is_opened_by_the_program_of_the_desktop() {
    use std::os::unix::fs::PermissionsExt;
    let folder = Folder::new("open").with("pull.fric", PULL).with("show", "#!/bin/sh\necho \"$1\" > shown\n");
    let opener = folder.0.join("show");
    fs::set_permissions(&opener, fs::Permissions::from_mode(0o755)).unwrap();
    // The program is not waited for; it writes into a pipe, whose reading waits for it.
    let made = Command::new("mkfifo").arg(folder.0.join("shown")).status().unwrap();
    assert!(made.success());
    let run = folder.fric(&["run", "pull.fric", "silent", "--open"]).env("FRIC_OPENER", &opener).output().unwrap();
    assert!(run.status.success());
    assert_eq!(fs::read_to_string(folder.0.join("shown")).unwrap(), "out/silent.svg\n");
    let missing =
        folder.fric(&["run", "pull.fric", "silent", "--open"]).env("FRIC_OPENER", "no-such-program").output().unwrap();
    assert!(missing.status.success() && String::from_utf8_lossy(&missing.stderr).contains("FRIC_OPENER"));
}

/// The window of a plot may depend on what a sweep varies: each curve has its own. Over the phase, all have one shape.
#[test]
fn each_case_of_a_sweep_is_drawn_in_its_own_window() {
    let seed: u64 = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(29);
    println!("FRIC_SEED={seed}");
    let mut state = seed;
    let mut draw = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / (1u64 << 31) as f64
    };
    for round in 0..4 {
        let rates: Vec<String> = (0..4).map(|_| format!("{:.3} Hz", 0.2 + 9.8 * draw())).collect();
        let text = format!(
            "model Turning {{\n  param f = 1 Hz in > 0\n  state n = 0\n  dn/dt = f\n  let y = sin(2 * pi * n)\n}}\n\
             experiment turns {{\n  run Turning() for 3 / f\n  sweep f = {}\n  solver rk4 step 1 ms\n  \
             plot y against n after 1.25 / f before 2.5 / f\n}}\n",
            rates.join(", ")
        );
        let folder = Folder::new("swept-windows").with("turns.fric", &text);
        folder.check(&["run", "turns.fric", "--plot", "turns.svg", "--no-error"], 0, "wrote turns.svg");
        let svg = fs::read_to_string(folder.0.join("turns.svg")).unwrap();
        // The curves are the paths of many points: where each begins and ends.
        let ends: Vec<[f64; 2]> = svg
            .split("<path d=\"M")
            .filter_map(|path| {
                let points: Vec<&str> = path.split('"').next()?.split('L').collect();
                let x = |point: &str| point.split(' ').next()?.parse::<f64>().ok();
                (points.len() > 20).then_some([x(points[0])?, x(points.last()?)?])
            })
            .collect();
        assert_eq!(ends.len(), rates.len(), "round {round}: {text}{svg}");
        // One step of the fastest turn is a hundredth of it.
        let width = ends[0][1] - ends[0][0];
        for [from, to] in &ends {
            assert!(
                (from - ends[0][0]).abs() < 0.02 * width && (to - ends[0][1]).abs() < 0.02 * width,
                "{ends:?}\n{text}"
            );
        }
    }
}

/// Experiments of every kind that an option of `fric run` can meet.
const KINDS: &str = r#"
model Pull {
  param  k  = 2 N/m      in > 0
  param  c  = 0.3 N·s/m  in > 0
  state  x [m] = 0
  state  v [mm/s] = 0
  dx/dt  = v
  dv/dt  = (k * (0.1 m/s * t - x) - c * v) / 1 kg
}
experiment free  { run Pull() for 2 s plot x [mm], v [mm/s] expect max(v) > 0 m/s }
experiment fixed { run Pull() for 2 s solver rk4 step 0.1 ms plot x [mm], v [mm/s] expect max(v) > 0 m/s }
experiment told  { run Pull() for 2 s expect max(v) > 0 m/s }
experiment noted { run Pull() for 2 s solver expo step 1 ms record x, v expect max(v) > 0 m/s }
experiment swept { run Pull() for 2 s sweep k = 1 N/m, 2 N/m plot x [mm], v [mm/s] expect max(v) > 0 m/s }
fit found {
  run  Pull()
  data "f.csv" (t [s], x [mm])
  vary k in 1 N/m .. 3 N/m
  minimise rms(x - data.x)
}
"#;

/// Exit code, words and files of a command.
type Effect = (Option<i32>, String, Vec<(String, Vec<u8>)>);

/// What a command says and writes, without the times that it took.
fn effect(folder: &Folder, args: &[&str]) -> Effect {
    let place = folder.0.join("place");
    let _ = fs::remove_dir_all(&place);
    fs::create_dir_all(&place).unwrap();
    fs::write(place.join("k.fric"), KINDS).unwrap();
    fs::write(place.join("f.csv"), "t [s],x [mm]\n0,0\n0.1,0.03\n0.2,0.26\n0.3,0.88\n0.4,2.05\n0.5,3.94\n").unwrap();
    // A desktop would open figures without a word.
    let opener = ("FRIC_OPENER", "no-such-program");
    let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
    let output = command.current_dir(&place).args(args).env(opener.0, opener.1).output().unwrap();
    let mut said = String::from_utf8(output.stdout).unwrap();
    said += &String::from_utf8(output.stderr).unwrap();
    let timeless = |line: &str| match serde_json::from_str::<Value>(line) {
        Ok(Value::Object(mut object)) => {
            object.retain(|key, _| !key.ends_with("_seconds"));
            Value::Object(object).to_string()
        }
        _ if line.contains("compiled in") || line.contains("runs in") => String::new(),
        _ => line.split(" in ").next().unwrap_or_default().to_string(),
    };
    let said = said.lines().map(timeless).collect::<Vec<_>>().join("\n");
    let mut files = Vec::new();
    let mut folders = vec![place.clone()];
    while let Some(at) = folders.pop() {
        for entry in fs::read_dir(at).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false => files.push((path.display().to_string(), fs::read(&path).unwrap())),
            }
        }
    }
    files.sort();
    (output.status.code(), said, files)
}

/// Every option changes what comes out, or is refused by its name with exit code 2, or is told to be without effect:
/// for each kind of experiment, alone and with others.
///
/// Mutants tried by hand: `--step` of an adaptive run is not refused; looks without a figure are not.
#[test]
fn every_option_has_an_effect_or_a_word() {
    let folder = Folder::new("options");
    let options: [&[&str]; 19] = [
        &["--solver", "euler"],
        &["--step", "0.4ms"],
        &["--tol", "1e-3"],
        &["--for", "1s"],
        &["--set", "k=3N/m"],
        &["--out", "o"],
        &["--plot", "p.svg"],
        &["--size", "85x60mm"],
        &["--font", "20pt"],
        &["--lines", "grey"],
        &["--columns", "2"],
        &["--title", "words"],
        &["--data", "d.csv"],
        &["--every", "7ms"],
        &["--thin"],
        &["--digits", "3"],
        &["--no-error"],
        &["--cross"],
        &["--open"],
    ];
    let mut silent = Vec::new();
    for kind in ["free", "fixed", "told", "noted", "swept"] {
        for others in [&[][..], &["--json"]] {
            let base = [&["run", "k.fric", kind], others].concat();
            let without = effect(&folder, &base);
            for option in options {
                let with = effect(&folder, &[&base[..], option].concat());
                let refused = with.0 == Some(2) && with.1.contains(option[0]);
                let told = with.1.contains(option[0]) && !without.1.contains(option[0]);
                if !(refused || told || with.0 != Some(2) && with != without) {
                    silent.push(format!("run {kind} {others:?} {option:?}: {:?} {}", with.0, with.1));
                }
            }
        }
    }
    // Other commands: the option is refused by its name.
    for args in [
        "fit k.fric found --step 1ms",
        "fit k.fric found --solver rk4 --step 1ms --tol 1e-6",
        "bench k.fric free --step 1ms",
        "build k.fric free --emit ir --step 1ms",
        "sweep k.fric free --vary k=1N/m,2N/m --step 1ms",
        "sweep k.fric fixed --vary k=1N/m,2N/m --tol 1e-3",
        "sweep k.fric fixed --vary k=1N/m,2N/m --seed 2",
        "sweep k.fric fixed --vary k=1N/m,2N/m --runs 20",
        "sweep k.fric fixed --vary k=1N/m,2N/m --size 85x60mm",
        "run k.fric free --solver adaptive --step 1ms",
        "linearise k.fric Pull --font 9pt",
        "characterise Dahl --size 85x60mm",
        "compare Dahl LuGre --title words",
    ] {
        let words: Vec<&str> = args.split(' ').collect();
        let option = words.iter().rev().find(|word| word.starts_with("--")).unwrap();
        let (code, said, _) = effect(&folder, &words);
        if !(code == Some(2) && said.contains(option)) {
            silent.push(format!("{args}: {code:?} {said}"));
        }
    }
    assert!(silent.is_empty(), "{} options are silent:\n{}", silent.len(), silent.join("\n"));
}

/// Rows of a joint sweep, of shares of values, and of models in a slot are those of runs that set the same values.
///
/// Mutant tried by hand: a share of several quantities is taken as the number itself.
#[test]
fn joint_and_relative_sweeps_are_runs_with_these_values() {
    let folder = Folder::new("joint").with("k.fric", KINDS);
    let table = |vary: &str| {
        folder.check(&["sweep", "k.fric", "free", "--vary", vary, "--no-error", "--out", "s.csv"], 0, "");
        let text = fs::read_to_string(folder.0.join("s.csv")).unwrap();
        let rows = text.lines().map(|line| line.split(',').map(str::to_string).collect::<Vec<_>>());
        rows.collect::<Vec<_>>()
    };
    let run = |set: &[String]| {
        let mut args = vec!["run", "k.fric", "free", "--json", "--no-error"];
        set.iter().for_each(|set| args.extend(["--set", set]));
        let (out, _) = folder.check(&args, 0, "");
        let seen: Value = serde_json::from_str(&out).unwrap();
        seen["expects"][0]["readings"][0]["value"].as_f64().unwrap()
    };
    let last = |row: &[String]| row[row.len() - 3].parse::<f64>().unwrap();
    // Both parameters, each by the same share of its own value.
    let rows = table("k,c = ±30 % lin 4");
    for (row, part) in rows[1..].iter().zip([0.7, 0.9, 1.1, 1.3]) {
        let expected = run(&[format!("k={}N/m", 2.0 * part), format!("c={}N·s/m", 0.3 * part)]);
        assert!((last(row) - expected).abs() <= 1e-6 * expected, "{row:?}: {expected}");
    }
    assert_eq!(rows.len(), 5);
    // One parameter, in its own unit.
    for row in &table("c = +-20 %")[1..] {
        let expected = run(&[format!("c={}N·s/m", row[1])]);
        assert!((last(row) - expected).abs() <= 1e-6 * expected, "{row:?}: {expected}");
    }
    // Refused, with what is wrong.
    let refused = |vary: &str, words: &str| folder.check(&["sweep", "k.fric", "free", "--vary", vary], 2, words);
    refused("k, c = 1 N/m, 2 N/m", "`c` is a viscous coefficient, it cannot be a stiffness");
    refused("x = ±20 %", "`x` is 0 m in the text, of which there is no share");
    refused("k = ±20", "no share");
}

/// A label names every quantity that a sweep changes together, and so do the files.
///
/// Mutant tried by hand: the label has the first path alone.
#[test]
fn a_joint_sweep_names_all_its_quantities() {
    let text = KINDS
        .replace("sweep k = 1 N/m, 2 N/m plot", "sweep k, c = 1 N/m, 2 N/m plot")
        .replace("c * v) / 1 kg", "c * v * 1 s) / 1 kg")
        .replace("c  = 0.3 N·s/m", "c  = 0.3 N/m");
    let folder = Folder::new("joint-names").with("k.fric", text);
    folder.check(&["run", "k.fric", "swept", "--out", "o"], 0, "k, c = 2 N/m");
    assert_eq!(folder.names("o"), ["swept-k-c-1-N-m.csv", "swept-k-c-2-N-m.csv", "swept.svg"]);
}

/// What a user's file declares hides what the library has; two files of the user do not hide each other.
///
/// Mutant tried by hand: files and library have one rank (E0202).
#[test]
fn an_imported_file_hides_the_library() {
    let model = |force: &str| format!("model Controller {{ input e [m] output u [N] = {force} * e }}\n");
    let uses = "model Use { input e [m] part c = Controller(e = e) output u [N] = c.u }\n\
                experiment run { run Use(e = 1 m) for 1 s expect final(u) ~= 3 N +- 1 uN }\n";
    let folder = Folder::new("hides")
        .with("mine.fric", model("3 N/m"))
        .with("other.fric", model("4 N/m"))
        .with("a.fric", format!("import std.interfaces\nimport \"mine.fric\"\n{uses}"))
        .with("b.fric", format!("import \"mine.fric\"\nimport std.interfaces\n{uses}"))
        .with("c.fric", format!("import \"mine.fric\"\nimport \"other.fric\"\n{uses}"));
    folder.check(&["test", "a.fric", "b.fric"], 0, "2 passed, 0 failed");
    folder.check(&["check", "c.fric"], 1, "E0202");
}

/// A run that leaves a range only because its fixed steps are too long says so; one that leaves it anyway does not.
///
/// Mutant tried by hand: the comparison with adaptive steps is negated.
#[test]
fn a_step_that_is_too_long_is_named() {
    let text = "model Relaxes {\n  input u [m]\n  param T = 1 ms in > 0\n  state x [m] = -1 m in -1 m .. 1 m\n  dx/dt = (u - x) / T\n}\n\
                experiment steps { run Relaxes(u = 0.9 m) for 1 s solver euler step 1.9 ms plot x }\n\
                experiment far { run Relaxes(u = 2 m * t / 1 s) for 1 s solver rk4 step 1 ms plot x }\n";
    let folder = Folder::new("too-long").with("x.fric", text);
    folder.check(
        &["run", "x.fric", "steps", "-q"],
        1,
        "by adaptive steps it does not: steps of 0.0019 s by euler are too long",
    );
    let (_, far) = folder.check(&["run", "x.fric", "far", "-q"], 1, "left its range");
    assert!(!far.contains("adaptive"), "{far}");
}
