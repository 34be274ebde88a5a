//! `fric`, `fric repl`: an interactive session.

use super::End;
use crate::args::{Characterise, Repl};
use crate::commands::shared::session::{
    catch_interrupts, forget_interrupt, run_figure, show_run, stop_on_interrupt, tell_fault,
};
use crate::compile::Explanation;
use crate::plot::{self, Axis, Curve, Figure, Panel};
use crate::repl::{self, COMMANDS, Cut, Editor, Fault, Input, LineKind, PromptCommand, Ran, Session, Value, plain};
use crate::terminal::{Style, Terminal};
use crate::{diagram, equations, project, report, results};
use abi::unit::Unit;
use runtime::engine::Cause;
use runtime::run::verdict::Verdict;
use std::cell::RefCell;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::rc::Rc;

pub fn repl(args: &Repl, terminal: &mut Terminal) -> End {
    let session = Rc::new(RefCell::new(Session::default()));
    let typed = std::io::stdin().is_terminal();
    let mut end = End::Fine;
    if let Some(file) = &args.file {
        let shown = session.borrow_mut().add_file(&file.display().to_string());
        match shown {
            Ok(words) => terminal.line(&words),
            Err(fault) => {
                tell_fault(&fault, terminal);
                end = End::Failed;
                if !typed && !args.keep_going {
                    return end;
                }
            }
        }
    }
    let editor = if typed { Editor::terminal(session.clone(), terminal.colour()) } else { Ok(Editor::piped()) };
    let mut editor = match editor {
        Ok(editor) => editor,
        Err(why) => {
            terminal.error(&format!("cannot use this terminal: {why}"));
            return End::Failed;
        }
    };
    if typed {
        terminal.line(&format!("fric {}; `help` lists commands, Ctrl-D ends", env!("CARGO_PKG_VERSION")));
    }
    catch_interrupts();
    loop {
        let text = match editor.read() {
            Ok(Input::Text(text)) => text,
            Ok(Input::Interrupted) => continue,
            // In an interactive session, errors have been seen, so the exit code is 0.
            Ok(Input::End) => return if typed { End::Fine } else { end },
            Err(why) => {
                terminal.error(&format!("cannot read on: {why}"));
                return End::Failed;
            }
        };
        forget_interrupt();
        if args.echo && !typed {
            terminal.print(&repl::as_typed(&text));
        }
        let mut rest = repl::inputs(&text).into_iter();
        while let Some(input) = rest.next() {
            let mut at = Prompt { session: &mut session.borrow_mut(), terminal };
            match at.line(input) {
                Ok(Next::Quit) => return if typed { End::Fine } else { end },
                Ok(Next::Line) => continue,
                Ok(Next::Missed) => end = End::Failed,
                Err(fault) => {
                    tell_fault(&fault, terminal);
                    end = End::Failed;
                }
            }
            // Pasted lines after an error may depend on the failed one.
            if rest.any(|line| !line.trim().is_empty()) {
                terminal.error("the lines behind it were not done");
            }
            break;
        }
        if end == End::Failed && !typed && !args.keep_going {
            return end;
        }
    }
}

/// What follows a line.
enum Next {
    Line,
    /// An expectation did not hold.
    Missed,
    Quit,
}

/// Commands of the shell that the prompt does not have.
const COMMAND_LINE: [&str; 16] = [
    "linearise",
    "linearize",
    "sweep",
    "test",
    "check",
    "build",
    "hil",
    "predict",
    "replay",
    "fmt",
    "compare",
    "bench",
    "new",
    "deploy",
    "fit",
    "panel",
];

/// Executes lines.
struct Prompt<'a> {
    session: &'a mut Session,
    terminal: &'a mut Terminal,
}

impl Prompt<'_> {
    fn line(&mut self, text: &str) -> Result<Next, Fault> {
        let text = text.trim_end();
        let line = repl::read(text);
        let brings = match &line {
            LineKind::Nothing => return Ok(Next::Line),
            LineKind::Command(command, _) => matches!(
                command,
                PromptCommand::Run
                    | PromptCommand::Explain
                    | PromptCommand::Doc
                    | PromptCommand::Diagram
                    | PromptCommand::Plot
                    | PromptCommand::Expect
            ),
            LineKind::Item | LineKind::Instance(..) | LineKind::Setting(..) => true,
            LineKind::Expression => false,
        };
        if brings {
            let brought = self.session.bring_in(text);
            if !brought.is_empty() {
                self.terminal.line(&format!("(uses {})", brought.join(", ")));
            }
        }
        match line {
            LineKind::Nothing => {}
            LineKind::Item => {
                if let Some(warnings) = self.session.add_item(text)? {
                    tell_fault(&warnings, self.terminal);
                }
            }
            LineKind::Instance(name, begin) => {
                let words = self.session.add_part(&name, &text[begin..])?;
                self.terminal.line(&words);
            }
            LineKind::Setting(path, begin) if !path.contains(['.', '[']) && self.session.is_free(&path) => {
                let value = self.session.set_variable(&path, &text[begin..])?;
                let tail = format!(".{path}");
                let meant =
                    self.session.quantities().find(|q| q.path.ends_with(&tail) && matches!(q.kind, "param" | "input"));
                let meant = meant.map_or(String::new(), |q| {
                    format!("   (a variable; `{} = {}` sets the {})", q.path, text[begin..].trim(), q.kind)
                });
                self.terminal.line(&format!("{path} = {}{meant}", plain(&value)));
            }
            LineKind::Setting(path, _) => self.session.set(&path, text)?,
            LineKind::Expression => {
                if let Some(values) = self.session.part_values(text.trim()) {
                    self.values(values?);
                    return Ok(Next::Line);
                }
                if let Some(near) = self.misspelt(text) {
                    return Err(Fault::Words(near));
                }
                let value = self.session.value(text)?;
                self.session.answer(&value);
                self.terminal.line(&plain(&value));
            }
            LineKind::Command(command, rest) => return self.command(command, rest.trim()),
        }
        Ok(Next::Line)
    }

    /// Prints the quantities of a part with their values.
    fn values(&mut self, values: Vec<(crate::compile::QuantityInfo, Value)>) {
        let width = values.iter().map(|(q, _)| q.path.chars().count()).max().unwrap_or(0);
        for (q, value) in values {
            self.terminal.line(&format!("  {:<6} {:width$}  {}", q.kind, q.path, plain(&value)));
        }
    }

    /// Two words in sequence are no expression: suggest a command.
    fn misspelt(&self, text: &str) -> Option<String> {
        let mut words = text.split_whitespace();
        let (first, second) = (words.next()?, words.next());
        if matches!(first, "for" | "while") && second.is_some() {
            let help = "several values are a `sweep` in an experiment, a curve is `plot f.F against f.v = 0 .. 1 m/s`";
            return Some(format!("there are no loops; {help}"));
        }
        // `sweep` is both: as a statement it has a `=`.
        let is_statement = matches!(first, "record" | "data") || first == "sweep" && text.contains('=');
        if second.is_some() && is_statement {
            return Some(format!("`{first}` stands in an experiment of a file: `use FILE`, then `run NAME`"));
        }
        if second.is_some() && COMMAND_LINE.contains(&first) {
            return Some(format!(
                "`{first}` is a command of the shell: `fric {first} FILE …`; `fric {first} --help` says how"
            ));
        }
        let word = |word: &str| word.chars().all(|c| c.is_alphanumeric() || c == '_' || c == '.' || c == '"');
        let command = word(first) && first.starts_with(char::is_alphabetic) && second.is_none_or(word);
        let near = repl::meant(first).filter(|_| command)?;
        let known = self.session.quantities().any(|q| q.path == first)
            || self.session.instances().iter().any(|(name, _)| name == first);
        (!known && (second.is_some() || near.len() > 3))
            .then(|| format!("there is no command `{first}`; did you mean `{near}`? (`help` lists them)"))
    }

    fn command(&mut self, command: PromptCommand, rest: &str) -> Result<Next, Fault> {
        match command {
            PromptCommand::Quit => return Ok(Next::Quit),
            PromptCommand::Help => self.help(rest)?,
            PromptCommand::Use => {
                let words = self.session.add_file(rest)?;
                self.terminal.line(&words);
            }
            PromptCommand::Run => return self.run(rest),
            PromptCommand::Step => self.step(rest)?,
            PromptCommand::Plot => self.plot(rest)?,
            PromptCommand::Expect => return self.expect(rest),
            PromptCommand::Explain => self.explain(rest)?,
            PromptCommand::Show => {
                if rest.is_empty() {
                    return Err("show what? `show f`, `show max(x)`".into());
                }
                match self.session.part_values(rest) {
                    Some(values) => self.values(values?),
                    None => {
                        let value = self.session.value(rest)?;
                        self.session.answer(&value);
                        self.terminal.line(&plain(&value));
                    }
                }
            }
            PromptCommand::Unit => self.unit(rest)?,
            PromptCommand::Doc => self.doc(rest)?,
            PromptCommand::Deps => self.deps(rest)?,
            PromptCommand::Diagram => self.diagram(rest)?,
            PromptCommand::Names => self.names(),
            PromptCommand::Lints => self.lints(),
            PromptCommand::Why => match super::explain::page_of(rest) {
                Some(page) => self.terminal.print(page),
                None => return Err(Fault::Words(super::explain::no_page(rest))),
            },
            PromptCommand::Watch => {
                let (file, name) = split_file(rest);
                if file.is_empty() {
                    return Err("watch what? `watch \"FILE.fric\" [EXPERIMENT]`".into());
                }
                return match super::watch::follow(&file, &name, false, self.session, self.terminal) {
                    End::Fine => Ok(Next::Line),
                    End::Failed | End::Misused | End::Stopped => Ok(Next::Missed),
                };
            }
            PromptCommand::Characterise => self.characterise(rest)?,
            PromptCommand::Save => self.save(rest)?,
        }
        Ok(Next::Line)
    }

    fn help(&mut self, rest: &str) -> Result<(), Fault> {
        let mut last = "";
        let wanted = |name: &str| rest.is_empty() || name == rest;
        let mut lines = Vec::new();
        for (name, usage, words) in COMMANDS {
            last = if name.is_empty() { last } else { name };
            if wanted(last) {
                lines.push((*usage, *words));
            }
        }
        if lines.is_empty() {
            return Err(Fault::Words(format!("there is no command `{rest}`; `help` lists them")));
        }
        let width = lines.iter().map(|(usage, _)| usage.chars().count()).max().unwrap_or(0);
        if rest.is_empty() {
            self.terminal
                .line("A line is an expression, a setting, an instance, an item of the language, or a command:");
            for (example, words) in [
                ("10 mm * 2 N/m", "its value, with its unit; `ans` is the last one"),
                ("f = LuGre(vd = 10 mm/s)", "an instance of a model, of yours or of the library"),
                ("f.Fs = 1 N", "sets a parameter, an input or a slot"),
                ("x = 3 mm", "a variable: later lines may use it"),
                ("f", "the values of an instance"),
                ("model M { … }", "any item; a bracket that is open goes on on the next line"),
            ] {
                self.terminal.line(&format!("  {example:width$}  {words}"));
            }
            self.terminal.line("");
        }
        for (usage, words) in lines {
            self.terminal.line(&format!("  {usage:width$}  {words}"));
        }
        Ok(())
    }

    fn run(&mut self, rest: &str) -> Result<Next, Fault> {
        let (name, length) = match rest.rsplit_once(" for ") {
            Some((name, length)) => (name.trim(), Some(length)),
            None => match rest.strip_prefix("for ") {
                Some(length) => ("", Some(length)),
                None => (rest, None),
            },
        };
        let duration = length.map(|length| self.time(length, "run NAME for 20 s")).transpose()?;
        let ran = self.session.run(name, duration, &stop_on_interrupt)?;
        let held = show_run(&ran, true, self.terminal);
        stopped(&ran)?;
        Ok(if held { Next::Line } else { Next::Missed })
    }

    /// Parses a positive time.
    fn time(&mut self, text: &str, example: &str) -> Result<f64, Fault> {
        let value = self.session.value(text)?;
        let second = Unit::parse("s").expect("the second is known");
        if value.boolean || value.unit.dimension != second.dimension {
            let unit = if value.unit.dimension.is_none() { "a number".into() } else { value.unit.dimension.describe() };
            return Err(Fault::Words(format!("a time is needed, not {unit}: `{example}`")));
        }
        match value.si {
            t if t > 0.0 && t.is_finite() => Ok(t),
            _ => Err(Fault::Words(format!("a time greater than 0 is needed: `{example}`"))),
        }
    }

    fn step(&mut self, rest: &str) -> Result<(), Fault> {
        if rest.is_empty() {
            return Err("a step of what length? `step 1 ms`".into());
        }
        let h = self.time(rest, "step 1 ms")?;
        let (time, all) = self.session.step(h)?;
        self.terminal.line(&format!("t = {}", abi::format::time(time)));
        let width = all.iter().map(|shown| shown.path.chars().count()).max().unwrap_or(0);
        for shown in all {
            let now = plain(&shown.now);
            let kind = shown.kind;
            let line = match &shown.before {
                Some(before) if plain(before) != now => {
                    format!("  {kind:<6} {:width$}  {} → {now}", shown.path, plain(before))
                }
                _ => format!("  {kind:<6} {:width$}  {now}", shown.path),
            };
            self.terminal.line(&line);
        }
        Ok(())
    }

    fn plot(&mut self, rest: &str) -> Result<(), Fault> {
        if rest.is_empty() {
            return Err("plot what? `plot f.F`, `plot f.F against f.v = -5 mm/s .. 5 mm/s steady`".into());
        }
        let (what, file) = repl::cut_to(rest)?;
        let drawn = match over(what) {
            Some((shows, path, from, to, steady)) => {
                let cut = self.session.cut(shows, &path, (from, to), steady, &mut stop_on_interrupt)?;
                cut_figure(&cut, steady)
            }
            None => {
                let ran = self.session.again(&format!("plot {what}"), false, &stop_on_interrupt)?;
                stopped(&ran)?;
                run_figure(&ran, true).ok_or("there is nothing to draw")?
            }
        };
        match file {
            Some(file) => {
                let path = PathBuf::from(file);
                let kind = plot::Kind::of(&path).ok_or("the name of a plot ends in .svg, .png or .pdf")?;
                let bytes = plot::picture(&drawn, &plot::Look::default(), kind);
                project::write(&path, &bytes).map_err(|error| format!("cannot write {file}: {error}"))?;
                self.terminal.line(&format!("wrote {file}"));
            }
            None => self.terminal.print(&plot::terminal(&drawn, self.terminal.width(), self.terminal.colour())),
        }
        Ok(())
    }

    fn expect(&mut self, rest: &str) -> Result<Next, Fault> {
        if rest.is_empty() {
            return Err("expect what? `expect max(x) < 1 mm`".into());
        }
        let ran = self.session.again(&format!("expect {rest}"), true, &stop_on_interrupt)?;
        stopped(&ran)?;
        let mut held = true;
        for (case, result) in ran.cases.iter().zip(&ran.results) {
            let Ok(outcome) = result else { continue };
            let last = &outcome.verdicts[outcome.verdicts.len().saturating_sub(1)..];
            if !case.label.is_empty() {
                self.terminal.line(&format!("  {}", case.label));
            }
            held &= last.iter().all(Verdict::passed);
            let words = results::verdicts(self.terminal, last, outcome.estimate.as_ref(), None, "");
            self.terminal.print(&words);
        }
        Ok(if held { Next::Line } else { Next::Missed })
    }

    fn explain(&mut self, rest: &str) -> Result<(), Fault> {
        if rest.is_empty() {
            return Err("explain what? `explain f.z`, `explain LuGre`, `why E0401`".into());
        }
        let (explanation, path) = match self.session.explained(rest) {
            // `explain` of codes and lints works as on the command line.
            Err(Fault::Words(words)) => match super::explain::page_of(rest) {
                Some(page) => {
                    self.terminal.print(page);
                    return Ok(());
                }
                None => return Err(Fault::Words(words)),
            },
            other => other?,
        };
        match path {
            Some(path) if !path.is_empty() => self.quantity(&explanation, &path),
            _ => super::explain::tell(&explanation, &[], self.terminal),
        }
        Ok(())
    }

    /// Explains a quantity: what it is, where its value comes from, how it is integrated.
    fn quantity(&mut self, explanation: &Explanation, path: &str) {
        let Some(q) = explanation.quantities.iter().find(|q| q.path == path) else { return };
        let unit = if q.unit.is_empty() { String::new() } else { format!(" [{}]", q.unit) };
        let range = q.range.as_ref().map_or(String::new(), |range| format!(", in {range}"));
        let doc = q.doc.as_ref().map_or(String::new(), |doc| format!("   {}", doc.lines().next().unwrap_or_default()));
        self.terminal.line(&format!("{path}: {}{unit}{range}{doc}", q.kind));
        let (owner, name) = path.rsplit_once('.').map_or(("", path), |(owner, name)| (owner, name));
        let derivative = if owner.is_empty() { format!("d{name}/") } else { format!("{owner}.d{name}/") };
        for (left, right) in
            explanation.equations.iter().filter(|(left, _)| left == path || left.starts_with(&derivative))
        {
            let left = left.strip_prefix(owner).map_or(left.as_str(), |left| left.trim_start_matches('.'));
            self.terminal.line(&format!("  {left} = {right}"));
        }
        for state in explanation.states.iter().filter(|state| state.path == path) {
            self.terminal.line(&format!("  {}", state.words()));
        }
        if let Ok(value) = self.session.value(path) {
            self.terminal.line(&format!("  now {}", plain(&value)));
        }
    }

    fn unit(&mut self, rest: &str) -> Result<(), Fault> {
        if rest.is_empty() {
            return Err("the unit of what? `unit f.g`, `unit 2 N/m * 1 mm`".into());
        }
        let value = self.session.value(rest)?;
        let words = match value {
            Value { boolean: true, .. } => "true or false".to_string(),
            Value { unit, .. } if unit.text.is_empty() => format!("1   {}", unit.dimension.describe()),
            Value { unit, .. } => format!("{unit}   {}", unit.dimension.describe()),
        };
        self.terminal.line(&words);
        Ok(())
    }

    fn doc(&mut self, rest: &str) -> Result<(), Fault> {
        let Some(model) = self.session.model(rest) else {
            return Err(self.session.no_model(rest));
        };
        self.terminal.line(&self.terminal.styled(Style::Bold, &model.name.text));
        for line in model.doc.iter().flat_map(|doc| doc.lines()) {
            self.terminal.line(&format!("  {line}"));
        }
        let all = equations::equations(&model);
        let width = all.iter().map(|(left, _)| left.chars().count()).max().unwrap_or(0);
        self.terminal.line("");
        for (left, right) in all {
            let line = if right.is_empty() { format!("  {left}") } else { format!("    {left:width$} = {right}") };
            self.terminal.line(&line);
        }
        let (explanation, _) = self.session.explained(&model.name.text.clone())?;
        let shown: Vec<_> =
            explanation.quantities.iter().filter(|q| q.kind != "let" && !q.path.contains('.')).collect();
        let width = shown.iter().map(|q| q.path.chars().count()).max().unwrap_or(0);
        let units = shown.iter().map(|q| q.unit.chars().count()).max().unwrap_or(0);
        let default = |path: &str| {
            let given = explanation.equations.iter().find(|(left, _)| {
                left == path && explanation.quantities.iter().any(|q| q.path == path && q.kind == "param")
            });
            given.map_or(String::new(), |(_, value)| format!("= {value}"))
        };
        let defaults = shown.iter().map(|q| default(&q.path).chars().count()).max().unwrap_or(0);
        self.terminal.line("");
        for q in shown {
            let doc = q.doc.as_deref().unwrap_or_default().lines().next().unwrap_or_default();
            let value = default(&q.path);
            let line = format!("  {:<6} {:width$}  {:units$}  {value:defaults$}  {doc}", q.kind, q.path, q.unit);
            self.terminal.line(line.trim_end());
        }
        Ok(())
    }

    fn deps(&mut self, rest: &str) -> Result<(), Fault> {
        let (explanation, path) = self.session.explained(rest)?;
        let Some(path) = path.filter(|path| !path.is_empty()) else {
            return Err(Fault::Words(format!("`{rest}` is a whole: name a quantity of it, as in `deps {rest}.F`")));
        };
        let mut shown = Vec::new();
        self.needs(&explanation, &path, 0, &mut shown);
        Ok(())
    }

    /// Prints a quantity and, indented below it, its dependencies; each is expanded once.
    fn needs(&mut self, explanation: &Explanation, path: &str, depth: usize, shown: &mut Vec<String>) {
        let q = explanation.quantities.iter().find(|q| q.path == path);
        let (kind, unit) = q.map_or(("", ""), |q| (q.kind, q.unit.as_str()));
        let again = shown.iter().any(|other| other == path);
        let needs = explanation.needs.iter().find(|(of, _)| of == path).map_or(&[][..], |(_, needs)| needs);
        let mark = if again && !needs.is_empty() { "  …" } else { "" };
        let unit = if unit.is_empty() { String::new() } else { format!(" [{unit}]") };
        self.terminal.line(&format!("{}{path}  {kind}{unit}{mark}", "  ".repeat(depth)));
        if again {
            return;
        }
        shown.push(path.into());
        for needed in needs {
            self.needs(explanation, needed, depth + 1, shown);
        }
    }

    fn diagram(&mut self, rest: &str) -> Result<(), Fault> {
        let (name, file) = repl::cut_to(rest)?;
        let Some(model) = self.session.model(name) else {
            return Err(self.session.no_model(name));
        };
        match file {
            None => self.terminal.print(&diagram::text(&model)),
            Some(file) if file.ends_with(".svg") => {
                project::write(Path::new(file), diagram::svg(&model).as_bytes())
                    .map_err(|error| format!("cannot write {file}: {error}"))?;
                self.terminal.line(&format!("wrote {file}"));
            }
            Some(_) => return Err("a diagram is written as .svg".into()),
        }
        Ok(())
    }

    fn names(&mut self) {
        let instances = self.session.instances();
        for (name, instance) in &instances {
            self.terminal.line(&format!("{name} = {instance}"));
        }
        for (name, text) in self.session.variables() {
            self.terminal.line(&format!("{name} = {text}"));
        }
        let (models, experiments) = (self.session.models(), self.session.experiments());
        if !models.is_empty() {
            self.terminal.line(&format!("models: {}", models.join(", ")));
        }
        if !experiments.is_empty() {
            self.terminal.line(&format!("experiments: {}", experiments.join(", ")));
        }
        let staged = self.session.staged();
        if let Some((name, quantities)) = &staged {
            self.terminal.line(&format!("of {name}, run last: {}", quantities.join(", ")));
        }
        if instances.is_empty() && models.is_empty() && experiments.is_empty() && staged.is_none() {
            self.terminal.line("nothing yet: `f = LuGre()` makes an instance, `use \"FILE.fric\"` brings a file");
        }
    }

    fn lints(&mut self) {
        let all = self.session.lints();
        if all.is_empty() {
            self.terminal.line("no warnings");
        }
        for (files, found) in all {
            let shown = report::full(&files, &found, self.terminal.colour());
            self.terminal.print(&shown);
        }
    }

    fn characterise(&mut self, rest: &str) -> Result<(), Fault> {
        let instance = self.session.instances().into_iter().find(|(name, _)| name == rest).map(|(_, what)| what);
        let what = instance.unwrap_or_else(|| rest.to_string());
        if what.is_empty() {
            return Err("characterise what? `characterise LuGre(vd = 10 mm/s)`".into());
        }
        let name = what.trim_start_matches("rotary ").split('(').next().unwrap_or_default().trim().to_string();
        let args = match self.session.origin(&name) {
            Some(file) => Characterise {
                what: file,
                models: vec![what],
                set: Vec::new(),
                over: None,
                out: None,
                json: false,
                figures: Default::default(),
            },
            None => Characterise {
                what,
                models: Vec::new(),
                set: Vec::new(),
                over: None,
                out: None,
                json: false,
                figures: Default::default(),
            },
        };
        match super::characterise::characterise(&args, self.terminal) {
            End::Fine => Ok(()),
            End::Failed | End::Misused | End::Stopped => Err("it could not be characterised".into()),
        }
    }

    fn save(&mut self, rest: &str) -> Result<(), Fault> {
        let name = rest.trim_matches('"');
        let path = Path::new(name);
        if !name.ends_with(".fric") {
            return Err("save to which file? `save try.fric`".into());
        }
        if path.exists() {
            return Err(Fault::Words(format!("{name} is there already: choose another name, or remove it first")));
        }
        let stem = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        let legal: String = stem.chars().map(|c| if c.is_ascii_alphanumeric() || c == '_' { c } else { '_' }).collect();
        let legal = if legal.starts_with(|c: char| c.is_ascii_alphabetic()) { legal } else { format!("s{legal}") };
        let folder = path.parent().unwrap_or(Path::new(""));
        let text = self.session.written(&legal.to_ascii_lowercase(), folder)?;
        project::write(path, text.as_bytes()).map_err(|error| format!("cannot write {name}: {error}"))?;
        self.terminal.line(&format!("wrote {name}; `fric test {name}` runs it"));
        Ok(())
    }
}

/// Splits a file name, quoted or not, from what follows it.
fn split_file(rest: &str) -> (String, String) {
    let cut = match rest.strip_prefix('"') {
        Some(rest) => rest.split_once('"'),
        None => rest.split_once(' '),
    };
    let (file, name) = cut.unwrap_or((rest.trim_matches('"'), ""));
    (file.trim().into(), name.trim().into())
}

/// Splits `EXPR against PATH = A .. B [steady]`, if a line has this form.
fn over(text: &str) -> Option<(&str, String, &str, &str, bool)> {
    let tokens: Vec<_> = grammar::tokens::tokens(text).into_iter().filter(|token| !token.is_trivia()).collect();
    let at = |word: &str, from: usize| (from..tokens.len()).find(|k| tokens[*k].text(text) == word);
    let against = at("against", 0)?;
    let equals = at("=", against)?;
    let dots = at("..", equals)?;
    let last = tokens.last()?;
    let steady = last.text(text) == "steady";
    let end = if steady { last.start } else { text.len() };
    let path = text[tokens[against].end..tokens[equals].start].split_whitespace().collect();
    let from = text[tokens[equals].end..tokens[dots].start].trim();
    Some((text[..tokens[against].start].trim(), path, from, text[tokens[dots].end..end].trim(), steady))
}

/// A failed run as a fault; an interrupted one is not a fault.
fn stopped(ran: &Ran) -> Result<(), Fault> {
    match ran.results.iter().find_map(|result| result.as_ref().err()) {
        Some(failure) if failure.cause == Cause::Stopped => {
            Err(Fault::Words(format!("stopped at {}; the session goes on", abi::format::time(failure.time))))
        }
        Some(failure) => Err(Fault::Stopped(Box::new(failure.clone()))),
        None => Ok(()),
    }
}

/// A curve over an input or a parameter as a figure: quantities of one unit share axes.
fn cut_figure(cut: &Cut, steady: bool) -> Figure {
    let (name, unit) = &cut.over;
    let x = Axis { name: name.clone(), unit: unit.text.clone(), ..Axis::default() };
    let mut panels: Vec<Panel> = Vec::new();
    for (series, points) in cut.series.iter().zip(&cut.curves) {
        let points = points.iter().map(|(x, y)| (unit.from_si(*x), series.unit.from_si(*y))).collect();
        let curve = Curve { name: series.label.clone(), points, ..Curve::default() };
        let own = series.unit.text.clone();
        match panels.iter_mut().find(|panel| panel.y.unit == own && !series.boolean) {
            Some(panel) => {
                panel.y.name += &format!(", {}", series.label);
                panel.curves.push(curve);
            }
            None => {
                let y = Axis { name: series.label.clone(), unit: own, ..Axis::default() };
                panels.push(Panel { x: x.clone(), y, curves: vec![curve], ..Panel::default() });
            }
        }
    }
    let labels: Vec<&str> = cut.series.iter().map(|series| series.label.as_str()).collect();
    let subtitle = if steady { "each point at rest" } else { "states as they are" };
    Figure { title: format!("{} against {name}", labels.join(", ")), subtitle: subtitle.into(), panels }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plots_against_a_quantity_are_distinguished_from_plots_over_time() {
        let read = over("f.F against f.v = -5 mm/s .. 5 mm/s steady");
        assert_eq!(read, Some(("f.F", "f.v".to_string(), "-5 mm/s", "5 mm/s", true)));
        let read = over("f.F, f.g against f.Fs = 1 N .. 2 N");
        assert_eq!(read, Some(("f.F, f.g", "f.Fs".to_string(), "1 N", "2 N", false)));
        assert_eq!(over("fr.F [N] against body.v [mm/s]"), None);
        assert_eq!(over("x"), None);
    }

    #[test]
    fn files_may_be_quoted() {
        assert_eq!(split_file("\"a b.fric\" pull"), ("a b.fric".into(), "pull".into()));
        assert_eq!(split_file("a.fric pull"), ("a.fric".into(), "pull".into()));
        assert_eq!(split_file("a.fric"), ("a.fric".into(), String::new()));
    }
}
