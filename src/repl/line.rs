//! Input lines: from a terminal with an editor, or from a file or pipe. The only file that uses rustyline.
//!
//! In: a session for completion. Out: complete inputs, over several lines where a bracket is open. Knows only the names
//! of commands.

use super::command::{COMMANDS, incomplete};
use super::complete::{candidates, hint, wants_file};
use super::session::Session;
use grammar::tokens::{TokenKind, is_keyword, tokens};
use rustyline::completion::{Completer, FilenameCompleter, Pair};
use rustyline::config::{BellStyle, CompletionType};
use rustyline::error::ReadlineError;
use rustyline::highlight::{CmdKind, Highlighter};
use rustyline::hint::Hinter;
use rustyline::history::FileHistory;
use rustyline::validate::{ValidationContext, ValidationResult, Validator};
use rustyline::{Config, Context, Helper};
use std::borrow::Cow;
use std::cell::RefCell;
use std::io::{BufRead, Stdin};
use std::path::PathBuf;
use std::rc::Rc;

/// The prompts before a first line and before a continuation line.
pub const PROMPT: &str = "fric> ";
const MORE: &str = "  ... ";
/// Longest history.
const MOST_HISTORY: usize = 10_000;

/// The result of reading.
pub enum Input {
    /// One input, possibly of several lines.
    Text(String),
    /// Ctrl-C at the prompt.
    Interrupted,
    /// End of the input.
    End,
}

/// Reads inputs.
pub enum Editor {
    /// From a terminal.
    Terminal(Box<rustyline::Editor<Help, FileHistory>>, Option<PathBuf>),
    /// From a file or a pipe.
    Piped(Stdin),
}

impl Editor {
    /// An editor for a terminal: with history, completion, highlighting and hints.
    pub fn terminal(session: Rc<RefCell<Session>>, colour: bool) -> Result<Editor, String> {
        let config = Config::builder()
            .max_history_size(MOST_HISTORY)
            .and_then(|config| config.history_ignore_dups(true))
            .map_err(|error| error.to_string())?
            .completion_type(CompletionType::List)
            .completion_show_all_if_ambiguous(true)
            .bell_style(BellStyle::None)
            .build();
        let mut editor = rustyline::Editor::with_config(config).map_err(|error| error.to_string())?;
        editor.set_helper(Some(Help { session, colour, files: FilenameCompleter::new() }));
        let history = history_file();
        if let Some(path) = &history {
            // The first session has no history yet.
            let _ = editor.load_history(path);
        }
        Ok(Editor::Terminal(Box::new(editor), history))
    }

    /// An editor for piped input.
    pub fn piped() -> Editor {
        Editor::Piped(std::io::stdin())
    }

    /// The next input.
    ///
    /// # Errors
    /// Why nothing can be read.
    pub fn read(&mut self) -> Result<Input, String> {
        match self {
            Editor::Terminal(editor, history) => match editor.readline(PROMPT) {
                Ok(text) => {
                    if !text.trim().is_empty() {
                        let _ = editor.add_history_entry(text.as_str());
                        if let Some(path) = history {
                            // Failing to write the history is no reason to stop.
                            let _ = make_folder(path).and_then(|()| editor.append_history(path).map_err(|_| ()));
                        }
                    }
                    Ok(Input::Text(text))
                }
                Err(ReadlineError::Interrupted) => Ok(Input::Interrupted),
                Err(ReadlineError::Eof) => Ok(Input::End),
                Err(error) => Err(error.to_string()),
            },
            Editor::Piped(input) => {
                let mut text = String::new();
                loop {
                    let before = text.len();
                    let read = input.lock().read_line(&mut text).map_err(|error| error.to_string())?;
                    if read == 0 {
                        return Ok(if text.trim().is_empty() { Input::End } else { Input::Text(text) });
                    }
                    // Indented lines of a transcript are continuation lines, as in the terminal.
                    if text[before..].trim().is_empty() && before > 0 || !incomplete(&text) {
                        return Ok(Input::Text(text));
                    }
                }
            }
        }
    }
}

fn make_folder(path: &std::path::Path) -> Result<(), ()> {
    path.parent().map_or(Ok(()), |folder| std::fs::create_dir_all(folder).map_err(|_| ()))
}

/// `$XDG_STATE_HOME/fric/history`, else `~/.local/state/fric/history`.
fn history_file() -> Option<PathBuf> {
    let absolute = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let state = absolute("XDG_STATE_HOME").or_else(|| Some(std::env::home_dir()?.join(".local").join("state")))?;
    Some(state.join("fric").join("history"))
}

/// The input with the prompts before its lines, as a terminal shows it.
pub fn as_typed(text: &str) -> String {
    let lines = text.trim_end().lines().enumerate();
    lines.map(|(k, line)| format!("{}{line}\n", if k == 0 { PROMPT } else { MORE })).collect()
}

/// Completion, hints, highlighting, and the check whether an input is complete.
pub struct Help {
    session: Rc<RefCell<Session>>,
    colour: bool,
    files: FilenameCompleter,
}

impl Helper for Help {}

impl Completer for Help {
    type Candidate = Pair;

    fn complete(&self, line: &str, cursor: usize, context: &Context<'_>) -> rustyline::Result<(usize, Vec<Pair>)> {
        if wants_file(line, cursor) {
            return self.files.complete(line, cursor, context);
        }
        let (start, found) = candidates(&self.session.borrow(), line, cursor);
        let pair = |candidate: super::Candidate| Pair { display: candidate.shown, replacement: candidate.text };
        Ok((start, found.into_iter().map(pair).collect()))
    }
}

/// A hint after the cursor that is only displayed: no key inserts it.
pub struct Note(String);

impl rustyline::hint::Hint for Note {
    fn display(&self) -> &str {
        &self.0
    }

    fn completion(&self) -> Option<&str> {
        None
    }
}

impl Hinter for Help {
    type Hint = Note;

    fn hint(&self, line: &str, cursor: usize, _: &Context<'_>) -> Option<Note> {
        // Without colour a hint could not be distinguished from the input.
        if cursor < line.len() || !self.colour { None } else { hint(&self.session.borrow(), line).map(Note) }
    }
}

impl Highlighter for Help {
    fn highlight<'l>(&self, line: &'l str, _: usize) -> Cow<'l, str> {
        if !self.colour {
            return Cow::Borrowed(line);
        }
        let mut out = String::new();
        for (k, token) in tokens(line).into_iter().enumerate() {
            let word = token.text(line);
            let command = k == 0 && COMMANDS.iter().any(|(name, ..)| *name == word);
            let code = match token.kind {
                TokenKind::Word if command => "1",
                TokenKind::Word if is_keyword(word) => "35",
                TokenKind::Word if word.starts_with(|c: char| c.is_ascii_uppercase()) => "36",
                TokenKind::Number => "33",
                TokenKind::Unit => "32",
                TokenKind::Text => "32",
                TokenKind::Comment | TokenKind::Doc => "2",
                TokenKind::OpenText | TokenKind::Unknown => "31",
                _ => "",
            };
            if code.is_empty() {
                out += word;
            } else {
                out += &format!("\x1b[{code}m{word}\x1b[0m");
            }
        }
        Cow::Owned(out)
    }

    fn highlight_prompt<'b, 's: 'b, 'p: 'b>(&'s self, prompt: &'p str, _: bool) -> Cow<'b, str> {
        if self.colour { Cow::Owned(format!("\x1b[1;34m{prompt}\x1b[0m")) } else { Cow::Borrowed(prompt) }
    }

    fn highlight_hint<'h>(&self, hint: &'h str) -> Cow<'h, str> {
        Cow::Owned(format!("\x1b[2m{hint}\x1b[0m"))
    }

    fn highlight_char(&self, _: &str, _: usize, _: CmdKind) -> bool {
        self.colour
    }
}

impl Validator for Help {
    fn validate(&self, context: &mut ValidationContext) -> rustyline::Result<ValidationResult> {
        let whole = !incomplete(context.input()) || context.input().ends_with("\n\n");
        Ok(if whole { ValidationResult::Valid(None) } else { ValidationResult::Incomplete })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_transcript_shows_what_was_typed() {
        assert_eq!(as_typed("model M {\n  input v [m/s]\n}\n"), "fric> model M {\n  ...   input v [m/s]\n  ... }\n");
    }
}
