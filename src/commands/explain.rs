//! `fric explain`: the page of an error or a warning.

use super::End;
use crate::args::Explain;
use crate::project;
use crate::terminal::Terminal;

/// Every code has a section: `## E0101 units differ`.
const PAGES: &str = include_str!("../../docs/errors.md");

pub fn explain(args: &Explain, terminal: &mut Terminal) -> End {
    let code = args.code.trim().to_uppercase();
    if let Some(page) = page(&code) {
        terminal.print(page);
        return End::Fine;
    }
    let help = match project::nearest(&code, codes()) {
        Some(near) => format!("did you mean {near}?"),
        None => "codes look like E0101 or W0703".into(),
    };
    terminal.error(&format!("there is no page about `{}`; {help}", args.code));
    End::Failed
}

/// From the heading of a code to the next heading.
fn page(code: &str) -> Option<&'static str> {
    let start = headings().find(|at| PAGES[*at..].strip_prefix("## ").is_some_and(|rest| word(rest) == code))?;
    let end = headings().find(|at| *at > start).unwrap_or(PAGES.len());
    Some(&PAGES[start..end])
}

/// Where headings of the second level begin, outside blocks of code.
fn headings() -> impl Iterator<Item = usize> {
    let mut at = 0;
    let mut inside = false;
    PAGES.split_inclusive('\n').filter_map(move |line| {
        let start = at;
        at += line.len();
        inside ^= line.starts_with("```");
        (!inside && line.starts_with("## ")).then_some(start)
    })
}

fn codes() -> impl Iterator<Item = &'static str> {
    headings().map(|at| word(&PAGES[at + 3..]))
}

fn word(text: &str) -> &str {
    text.split_whitespace().next().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_has_one_page() {
        let mut all: Vec<&str> = codes().collect();
        assert!(all.iter().all(|code| code.len() == 5 && code.starts_with(['E', 'W'])), "{all:?}");
        let count = all.len();
        all.sort_unstable();
        all.dedup();
        assert_eq!(all.len(), count);
        for code in all {
            assert!(page(code).unwrap().lines().count() > 2, "{code}");
        }
        assert!(page("E9999").is_none());
    }
}
