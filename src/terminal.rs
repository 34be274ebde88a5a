//! Standard output and standard error: colour, width, and closed pipes.

use std::io::{self, ErrorKind, IsTerminal, Write};

/// Columns if the width is unknown.
const WIDTH: usize = 80;

/// All output goes through here.
///
/// If the reader of a pipe has gone, further output is dropped silently and the work continues, so that files are
/// written and the exit code is correct.
pub struct Terminal {
    closed: bool,
    colour: bool,
    error_colour: bool,
    /// What was printed, for those who want it as a text.
    kept: Option<Vec<u8>>,
}

/// How words are highlighted.
#[derive(Clone, Copy)]
pub enum Style {
    /// Headings.
    Bold,
    /// Success.
    Good,
    /// Failure.
    Bad,
}

impl Terminal {
    /// The terminal of the process.
    pub fn new() -> Terminal {
        let wanted = std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty())
            && std::env::var_os("TERM").is_none_or(|term| term != "dumb");
        Terminal {
            closed: false,
            colour: wanted && io::stdout().is_terminal(),
            error_colour: wanted && io::stderr().is_terminal(),
            kept: None,
        }
    }

    /// What `print` prints, without colour.
    pub fn text(print: impl FnOnce(&mut Terminal)) -> String {
        let mut terminal = Terminal { closed: false, colour: false, error_colour: false, kept: Some(Vec::new()) };
        print(&mut terminal);
        String::from_utf8_lossy(&terminal.kept.unwrap_or_default()).into_owned()
    }

    /// Whether standard output may have colour.
    pub fn colour(&self) -> bool {
        self.colour
    }

    /// Whether standard error may have colour.
    pub fn error_colour(&self) -> bool {
        self.error_colour
    }

    /// Columns for plots: those of the terminal, at most 100.
    pub fn width(&self) -> usize {
        match terminal_size::terminal_size_of(io::stdout()) {
            Some((terminal_size::Width(width), _)) => usize::from(width).min(100),
            None => WIDTH,
        }
    }

    /// Words in a style, if standard output may have colour.
    pub fn styled(&self, style: Style, words: &str) -> String {
        styled(self.colour, style, words)
    }

    /// Prints to the standard output.
    pub fn print(&mut self, text: &str) {
        self.bytes(text.as_bytes());
    }

    /// Writes the contents of a file to the standard output.
    pub fn bytes(&mut self, bytes: &[u8]) {
        if let Some(kept) = &mut self.kept {
            return kept.extend(bytes);
        }
        if self.closed {
            return;
        }
        let mut out = io::stdout().lock();
        if let Err(error) = out.write_all(bytes).and_then(|()| out.flush()) {
            self.closed = true;
            // A full disk is reported, a closed pipe is not.
            if error.kind() != ErrorKind::BrokenPipe {
                self.report(&format!("cannot print: {error}\n"));
            }
        }
    }

    /// Prints a line to the standard output.
    pub fn line(&mut self, text: &str) {
        self.print(&format!("{text}\n"));
    }

    /// Prints to the standard error. If that is closed too, the text is lost.
    pub fn report(&self, text: &str) {
        let _ = io::stderr().lock().write_all(text.as_bytes());
    }

    /// Reports a failure that has no position in a text.
    pub fn error(&self, message: &str) {
        self.report(&format!("{} {message}\n", styled(self.error_colour, Style::Bad, "error:")));
    }
}

fn styled(colour: bool, style: Style, words: &str) -> String {
    let code = match style {
        Style::Bold => "1",
        Style::Good => "32",
        Style::Bad => "1;31",
    };
    if colour { format!("\x1b[{code}m{words}\x1b[0m") } else { words.into() }
}
