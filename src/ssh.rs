//! Runs commands on another computer through the system's ssh and scp, with the user's keys, agent and configuration.
//!
//! In: a host and options, commands, files. Out: what the command printed, or why it failed. Output of another computer
//! is not trusted with a terminal: control characters are escaped. Knows nothing of packages.

use abi::foreign::shown;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

/// A computer that is reached by ssh.
pub struct Remote {
    host: String,
    options: Vec<String>,
}

/// Why a remote command failed.
pub enum Failed {
    /// The host could not be reached, or the command is missing there.
    Unreachable(String),
    /// The command ran and failed: its exit code and its error output.
    Exit(i32, String),
}

impl Failed {
    /// The failure in words.
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
    /// `host`: as ssh accepts it. `options`: as after `-o`, such as `Port=2222`.
    pub fn new(host: &str, options: &[String]) -> Remote {
        Remote { host: host.into(), options: options.iter().flat_map(|one| ["-o".into(), one.clone()]).collect() }
    }

    /// The host.
    pub fn host(&self) -> &str {
        &self.host
    }

    /// Runs a command there; returns its output.
    ///
    /// # Errors
    /// Why it failed.
    pub fn run(&self, words: &[&str]) -> Result<String, Failed> {
        done("ssh", &mut self.command(words))
    }

    /// Runs a long command there; passes each line of output to `told`. Ctrl-C also ends ssh.
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

    /// Starts a command there that is spoken with through its standard streams. What it says on the standard error is
    /// seen here.
    ///
    /// # Errors
    /// Why it failed.
    pub fn start(&self, words: &[&str]) -> Result<Child, Failed> {
        let mut command = self.command(words);
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        command.spawn().map_err(|error| Failed::Unreachable(format!("cannot run ssh: {error}")))
    }

    fn command(&self, words: &[&str]) -> Command {
        let line = words.iter().map(|word| quoted(word)).collect::<Vec<_>>().join(" ");
        let mut command = Command::new("ssh");
        // No interactive questions: without a working key, ssh fails with a message.
        command.args(["-o", "BatchMode=yes"]).args(&self.options).arg("--").arg(&self.host).arg(line);
        command
    }

    /// Copies files to a folder that exists there.
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

/// The output of a command that has ended, or its failure.
fn ended(what: &str, output: Output) -> Result<String, Failed> {
    let said = shown(String::from_utf8_lossy(&output.stderr).trim()).into_owned();
    match output.status.code() {
        Some(0) => Ok(shown(&String::from_utf8_lossy(&output.stdout)).into_owned()),
        // Exit code of ssh's own failures.
        Some(255) => Err(Failed::Unreachable(said)),
        Some(code) => Err(Failed::Exit(code, said)),
        None => Err(Failed::Unreachable(format!("{what} was ended: {}", output.status))),
    }
}

/// A word quoted for the remote shell.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.' | '/' | '=' | ':' | ',' | '+');
    if !word.is_empty() && word.chars().all(plain) { word.into() } else { format!("'{}'", word.replace('\'', "'\\''")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_reach_the_remote_shell_unchanged() {
        assert_eq!(quoted("/var/lib/fric"), "/var/lib/fric");
        assert_eq!(quoted("a b"), "'a b'");
        assert_eq!(quoted("it's; rm"), "'it'\\''s; rm'");
        assert_eq!(quoted(""), "''");
    }
}
