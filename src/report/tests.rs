use super::*;
use std::sync::Arc;

fn file(name: &str, text: &str) -> SourceFile {
    SourceFile { name: name.into(), text: text.into(), ast: Arc::default(), library: false }
}

/// The span of `words` in line `line` (from 1) of the `n`-th file.
fn at(files: &[SourceFile], n: usize, line: usize, words: &str) -> Span {
    let text = &files[n].text;
    let from: usize = text.split_inclusive('\n').take(line - 1).map(str::len).sum();
    let start = from + text[from..].find(words).unwrap_or_else(|| panic!("no `{words}` in line {line}"));
    Span::new(FileId(n as u32), start, start + words.len())
}

#[test]
fn places_in_odd_texts_are_found() {
    let text = "\u{feff}model A {\r\n\tlet\tb = \u{1b}[31mé·x\r\n}\r\n";
    let files = [file("a.fric", text)];
    let diagnostic = Diagnostic::error("E0204", "there is no `x`").label(at(&files, 0, 2, "x"), "here");
    let shown = full(&files, std::slice::from_ref(&diagnostic), false);
    assert_eq!(
        shown,
        "E0204

  × there is no `x`
   ╭─[a.fric:2:17]
 2 │     let b = ␛[31mé·x
   ·                    ┬
   ·                    ╰── here
   ╰────
",
        "{shown}"
    );
    assert_eq!(short(&files, &[diagnostic]), "a.fric:2:17: E0204 there is no `x`\n");

    let mark = Diagnostic::error("E0001", "expected an item").label(Span::new(FileId(0), 0, 3), "here");
    assert!(
        full(&files, std::slice::from_ref(&mark), false).contains(" 1 │ model A {\n"),
        "{}",
        full(&files, &[mark], false)
    );
}

#[test]
fn a_place_at_the_end_of_a_text_is_shown() {
    for text in ["", "model A {", "model A {\n", "\u{feff}", "\n\n\n", "é"] {
        let files = [file("a.fric", text)];
        let end = Span::new(FileId(0), text.len(), text.len());
        let diagnostic = Diagnostic::error("E0002", "`{` is never closed").label(end, "the text ends here");
        let shown = full(&files, &[diagnostic], false);
        assert!(shown.contains("the text ends here"), "{text:?}:\n{shown}");
    }
}

#[test]
fn a_place_outside_the_text_does_no_harm() {
    let files = [file("a.fric", "é\né\n")];
    for (start, end) in [(1, 2), (100, 200), (4, 5), (0, 100)] {
        let diagnostic = Diagnostic::error("E0001", "odd").label(Span::new(FileId(0), start, end), "here");
        full(&files, std::slice::from_ref(&diagnostic), true);
        short(&files, std::slice::from_ref(&diagnostic));
        json(&files, &[diagnostic]);
    }
    let nowhere = Diagnostic::error("E0001", "odd").label(Span::new(FileId(7), 0, 1), "here").help("none");
    assert_eq!(full(&files, &[nowhere], false), "E0001\n\n  × odd\n  help: none\n");
}

#[test]
fn a_very_long_line_is_cut_around_its_label() {
    let text = format!("let a = {} + b{}\n", "x + ".repeat(200_000), " + y".repeat(100_000));
    let files = [file("a.fric", &text)];
    let diagnostic = Diagnostic::error("E0204", "there is no `b`").label(at(&files, 0, 1, "b"), "not declared");
    let shown = full(&files, &[diagnostic], false);
    assert!(shown.contains("…") && shown.contains("+ b + y") && shown.contains("a.fric:1:800012"), "{shown}");
    assert!(shown.lines().all(|line| line.chars().count() < 200), "{shown}");
}

#[test]
fn a_label_over_many_lines_marks_the_first() {
    let text = format!("model A {{\n{}}}\n", "let a = 1\n".repeat(50));
    let files = [file("a.fric", &text)];
    let all = Span::new(FileId(0), 0, text.len());
    let shown = full(&files, &[Diagnostic::error("E0000", "odd").label(all, "all of it")], false);
    assert!(shown.lines().count() < 10 && shown.contains("all of it"), "{shown}");
    let few = Span::new(FileId(0), 0, at(&files, 0, 3, "let a = 1").end as usize);
    let shown = full(&files, &[Diagnostic::error("E0000", "odd").label(few, "three lines")], false);
    assert!(shown.contains(" 3 │") && shown.contains("three lines"), "{shown}");
}

#[test]
fn labels_in_two_files_are_two_excerpts_before_the_help() {
    let files = [file("a.fric", "part fr = LuGre(Fc = 2 N)\n"), file("std.friction", "\nrequire Fs >= Fc\n")];
    let diagnostic = Diagnostic::error("E0501", "`Fs` is smaller than `Fc`")
        .label(at(&files, 0, 1, "Fc = 2 N"), "set here")
        .label(at(&files, 1, 2, "Fs >= Fc"), "required here")
        .help("set Fs as well");
    assert_eq!(
        full(&files, &[diagnostic], false),
        "E0501

  × `Fs` is smaller than `Fc`
   ╭─[a.fric:1:17]
 1 │ part fr = LuGre(Fc = 2 N)
   ·                 ────┬───
   ·                     ╰── set here
   ╰────
   ╭─[std.friction:2:9]
 2 │ require Fs >= Fc
   ·         ────┬───
   ·             ╰── required here
   ╰────
  help: set Fs as well
"
    );
}

#[test]
fn ten_of_a_file_are_shown_and_the_rest_counted() {
    let files = [file("a.fric", &"x\n".repeat(42)), file("b.fric", "y")];
    let mut all: Vec<Diagnostic> = (0..42)
        .rev()
        .map(|line| {
            let span = Span::new(FileId(0), 2 * line, 2 * line + 1);
            Diagnostic::error("E0001", format!("mistake {line}")).label(span, "")
        })
        .collect();
    all.push(Diagnostic::error("E0002", "in b").label(Span::new(FileId(1), 0, 1), ""));
    let shown = full(&files, &all, false);
    assert!(shown.contains("mistake 9\n") && !shown.contains("mistake 10\n"), "{shown}");
    assert!(shown.contains("\n… and 32 more in a.fric\n") && shown.contains("in b"), "{shown}");
    assert_eq!(short(&files, &all).lines().count(), 43);
}

#[test]
fn colour_is_given_only_when_asked_for() {
    let files = [file("a.fric", "x")];
    let all = [Diagnostic::error("E0001", "odd").label(Span::new(FileId(0), 0, 1), "here")];
    assert!(full(&files, &all, true).contains('\x1b'));
    assert!(!full(&files, &all, false).contains('\x1b'));
}

#[test]
fn json_has_every_place() {
    let files = [file("a.fric", "a\nbé c\n")];
    let all =
        [Diagnostic::warning("W0201", "`c` is never read").label(at(&files, 0, 2, "c"), "here").help("remove it")];
    let expected = r#"[{"code":"W0201","severity":"warning","message":"`c` is never read","labels":[{"file":"a.fric","line":2,"column":4,"end_line":2,"end_column":5,"start":6,"end":7,"text":"here"}],"help":"remove it"}]"#;
    assert_eq!(json(&files, &all).to_string(), expected);
}

#[test]
fn twenty_thousand_errors_are_reported_without_delay() {
    let files = [file("a.fric", &"x;".repeat(20_000))];
    let all: Vec<Diagnostic> = (0..20_000)
        .map(|i| Diagnostic::error("E0001", "odd").label(Span::new(FileId(0), 2 * i, 2 * i + 1), ""))
        .collect();
    assert!(short(&files, &all).ends_with("\na.fric:1:39999: E0001 odd\n"));
    assert_eq!(json(&files, &all).as_array().unwrap().len(), 20_000);
    assert_eq!(full(&files, &all, false).lines().last(), Some("… and 19990 more in a.fric"));
}
