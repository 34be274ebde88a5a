//! Another computer, through the system's own ssh and scp: its keys, its agent, its configuration.
//!
//! In: a host and options, commands, files. Out: what the command printed, or why it failed. What another computer says is
//! not to be trusted with a terminal: what would act on one arrives as an escape. Knows no packages.

use abi::foreign::shown;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Output, Stdio};

/// A computer that ssh reaches.
pub struct Remote {
    host: String,
    options: Vec<String>,
}

/// Why a command on another computer failed.
pub enum Failed {
    /// It could not be reached, or the command is not there.
    Unreachable(String),
    /// The command ran and failed: its exit code and what it reported.
    Exit(i32, String),
}

impl Failed {
    /// In words.
    pub fn words(&self) -> String {
        match self {
            Failed::Unreachable(why) => why.clone(),
            Failed::Exit(_, said) if !said.trim().is_empty() => {
                said.trim().lines().last().unwrap_or_default().trim_start_matches("error: ").to_string()
            }
            Failed::Exit(code, _) => format!("it ended with exit code {code}"),
        }
    }
}

impl Remote {
    /// `host`: as ssh takes it. `options`: as behind `-o`, such as `Port=2222`.
    pub fn new(host: &str, options: &[String]) -> Remote {
        Remote { host: host.into(), options: options.iter().flat_map(|one| ["-o".into(), one.clone()]).collect() }
    }

    /// The host.
    pub fn host(&self) -> &str {
        &self.host
    }

    /// Runs a command there; gives what it printed.
    ///
    /// # Errors
    /// Why it failed.
    pub fn run(&self, words: &[&str]) -> Result<String, Failed> {
        done("ssh", &mut self.command(words))
    }

    /// Runs a command there that goes on for a while; `told` gets each line as it comes. Ctrl-C ends ssh too.
    ///
    /// # Errors
    /// Why it failed.
    pub fn follow(&self, words: &[&str], told: &mut dyn FnMut(&str)) -> Result<(), Failed> {
        let failed = |error: std::io::Error| Failed::Unreachable(format!("cannot run ssh: {error}"));
        let mut command = self.command(words);
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().map_err(failed)?;
        let lines = BufReader::new(child.stdout.take().expect("it is piped")).lines();
        lines.map_while(Result::ok).for_each(|line| told(&shown(&line)));
        ended("ssh", child.wait_with_output().map_err(failed)?).map(|_| ())
    }

    fn command(&self, words: &[&str]) -> Command {
        let line = words.iter().map(|word| quoted(word)).collect::<Vec<_>>().join(" ");
        let mut command = Command::new("ssh");
        // Nobody answers questions here: without a key that works, it fails and says so.
        command.args(["-o", "BatchMode=yes"]).args(&self.options).arg("--").arg(&self.host).arg(line);
        command
    }

    /// Copies files there, into a folder that exists.
    ///
    /// # Errors
    /// Why it failed.
    pub fn send(&self, files: &[&Path], folder: &str) -> Result<(), Failed> {
        let mut command = Command::new("scp");
        command.args(["-q", "-o", "BatchMode=yes"]).args(&self.options).arg("--").args(files);
        command.arg(format!("{}:{folder}/", self.host));
        done("scp", &mut command).map(|_| ())
    }

    /// Copies a file from there.
    ///
    /// # Errors
    /// Why it failed.
    pub fn fetch(&self, file: &str, to: &Path) -> Result<(), Failed> {
        let mut command = Command::new("scp");
        command.args(["-q", "-o", "BatchMode=yes"]).args(&self.options).arg("--");
        command.arg(format!("{}:{file}", self.host)).arg(to);
        done("scp", &mut command).map(|_| ())
    }
}

fn done(what: &str, command: &mut Command) -> Result<String, Failed> {
    let output = command
        .stdin(Stdio::null())
        .output()
        .map_err(|error| Failed::Unreachable(format!("cannot run {what}: {error}")))?;
    ended(what, output)
}

/// What a command printed that has ended.
fn ended(what: &str, output: Output) -> Result<String, Failed> {
    let said = shown(String::from_utf8_lossy(&output.stderr).trim()).into_owned();
    match output.status.code() {
        Some(0) => Ok(shown(&String::from_utf8_lossy(&output.stdout)).into_owned()),
        // ssh's own failures.
        Some(255) => Err(Failed::Unreachable(said)),
        Some(code) => Err(Failed::Exit(code, said)),
        None => Err(Failed::Unreachable(format!("{what} was ended: {}", output.status))),
    }
}

/// A word that the shell there takes as it is.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.' | '/' | '=' | ':' | ',' | '+');
    if !word.is_empty() && word.chars().all(plain) { word.into() } else { format!("'{}'", word.replace('\'', "'\\''")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_reach_the_other_shell_as_they_are() {
        assert_eq!(quoted("/var/lib/fric"), "/var/lib/fric");
        assert_eq!(quoted("a b"), "'a b'");
        assert_eq!(quoted("it's; rm"), "'it'\\''s; rm'");
        assert_eq!(quoted(""), "''");
    }
}
