//! Changes to a session: items, files in use, instances, settings.
//!
//! In: lines as typed. Out: the changed session, or the old one if a line has errors. Changes are described in words.

use super::words::{counted, with_inputs};
use super::{EXPERIMENT, Fault, MODEL, PromptPart, Session, Subject, TEXT, Used, found, run};
use crate::compile::{self, Loaded, Lookup, Space};
use crate::project;
use grammar::ast::{self, DeclarationKind, Item, Statement};
use grammar::diagnostic::Diagnostic;
use grammar::span::FileId;
use grammar::tokens::{TokenKind, tokens};
use std::path::Path;

impl Session {
    /// Imports the modules of the library that define the names of a line which are undefined here; returns their
    /// names.
    pub fn bring_in(&mut self, line: &str) -> Vec<String> {
        let mut brought = Vec::new();
        for token in tokens(line).into_iter().filter(|token| token.kind == TokenKind::Word) {
            let name = token.text(line);
            if !name.starts_with(|c: char| c.is_ascii_uppercase()) || self.defines(name) {
                continue;
            }
            if let Some(module) = library_module(name) {
                self.items.push(format!("import {module}"));
                brought.push(module.to_string());
            }
        }
        brought
    }

    /// Whether a model, interface or device of this name is visible.
    pub(super) fn defines(&self, name: &str) -> bool {
        if self.items.is_empty() {
            return false;
        }
        let loaded = compile::load(TEXT, &self.items.join("\n"), &crate::disk::Disk);
        !matches!(loaded.find(loaded.root(), Space::Type, name), Lookup::Missing)
    }

    /// Adds an item as typed; replaces an earlier one of the same name. Returns warnings.
    pub fn add_item(&mut self, item: &str) -> Result<Option<Fault>, Fault> {
        let mut next = self.clone();
        let head = |text: &str| -> Vec<String> {
            let words = tokens(text).into_iter().filter(|token| !token.is_trivia());
            words.take(2).map(|token| token.text(text).to_string()).collect()
        };
        let own = head(item);
        if own.first().is_none_or(|word| word != "import") {
            next.items.retain(|other| head(other) != own);
        }
        next.items.push(item.trim_end().to_string());
        let (text, at, _) = next.text("", "");
        let mut loaded = compile::load(TEXT, &text, &crate::disk::Disk);
        let diagnostics: Vec<Diagnostic> = compile::check(&mut loaded, &crate::disk::Disk)
            .into_iter()
            .filter(|found| concerns(&loaded, found))
            .collect();
        if diagnostics.iter().any(Diagnostic::is_error) {
            return Err(found(&loaded, &diagnostics, item, Some(at)));
        }
        *self = next;
        let typed = |found: &Diagnostic| found.span().start as usize >= at;
        let warnings: Vec<Diagnostic> = diagnostics.into_iter().filter(typed).collect();
        Ok((!warnings.is_empty()).then(|| found(&loaded, &warnings, item, Some(at))))
    }

    /// Uses a file, or a module of the library; describes its contents.
    pub fn add_file(&mut self, name: &str) -> Result<String, Fault> {
        let name = name.trim();
        let bare = name.trim_matches('"');
        if bare.is_empty() {
            return Err("use what? `use \"servo.fric\"`, or a module of the library: `use std.friction`".into());
        }
        let library = bare.starts_with("std.") || bare == "std";
        let import = if library { format!("import {bare}") } else { format!("import \"{bare}\"") };
        let mut next = self.clone();
        next.items.retain(|item| *item != import);
        next.items.push(import.clone());
        let (text, at, _) = next.text("", "");
        let loaded = compile::load(TEXT, &text, &crate::disk::Disk);
        if loaded.has_errors() {
            return Err(found(&loaded, &loaded.diagnostics, &import, Some(at)));
        }
        let alone = compile::load(TEXT, &import, &crate::disk::Disk);
        let mut models: Vec<&str> = alone.visible(alone.root(), Space::Type);
        if !library {
            let path = Path::new(bare);
            let text = project::read(path).map_err(|why| Fault::Words(format!("cannot read {bare}: {why}")))?;
            let loaded = compile::load(bare, &text, &crate::disk::Disk);
            next.used.retain(|used| used.path != bare);
            next.used.push(Used { path: bare.into(), loaded });
        }
        *self = next;
        models.sort_unstable();
        let mut words = if models.is_empty() { "no models".into() } else { models.join(", ") };
        if let Some(used) = self.used.last().filter(|_| !library) {
            let experiments = used.loaded.experiments().len();
            let warnings = self.lints().iter().map(|(_, found)| found.len()).sum::<usize>();
            words += &format!("; {}", counted(experiments, "experiment"));
            if warnings > 0 {
                words += &format!("   ({}: `lints` shows them)", counted(warnings, "warning"));
            }
        }
        Ok(words)
    }

    /// Creates an instance, or replaces one: states continue, matched by name and unit. Returns a line about it.
    pub fn add_part(&mut self, name: &str, instance: &str) -> Result<String, Fault> {
        let instance = self.with_values(instance)?;
        let instance =
            if instance.contains('(') { instance.trim().to_string() } else { format!("{}()", instance.trim()) };
        let mut next = self.clone();
        let (model, given) = {
            let (read, errors) = grammar::parse::parse_instance(FileId(0), &instance);
            match read {
                Some(read) if errors.is_empty() => {
                    (read.model.text, read.args.into_iter().map(|arg| arg.name.text).collect::<Vec<_>>())
                }
                _ => {
                    let mut loaded = compile::load(TEXT, "", &crate::disk::Disk);
                    loaded.files.0[0].text = instance.as_str().into();
                    return Err(found(&loaded, &errors, &instance, Some(0)));
                }
            }
        };
        let loaded = compile::load(TEXT, &self.text("", "").0, &crate::disk::Disk);
        let open = match loaded.find(loaded.root(), Space::Type, &model) {
            Lookup::Found(_, Item::Model(model)) => open_inputs(model)
                .into_iter()
                .filter(|input| !given.iter().any(|name| name == input))
                .map(str::to_string)
                .collect(),
            _ => Vec::new(),
        };
        let prefix = format!("{name}.");
        next.bench.set.retain(|set| !set.starts_with(&prefix));
        next.bench.also.retain(|_| false);
        next.parts.retain(|part| part.name != name);
        next.parts.push(PromptPart { name: name.into(), instance: instance.clone(), open: open.clone() });
        let (text, _, at) = next.text("", &run(MODEL, 1.0));
        let typed = with_inputs(&instance, open.iter().map(|name| (name.as_str(), "0")));
        let mut loaded = compile::load(TEXT, &text, &crate::disk::Disk);
        let case = next.compiled_in(&mut loaded, EXPERIMENT, &next.bench, &[], true);
        let (case, _) = case.map_err(|mut errors| {
            // Suggest models of the library as well as those in use.
            for error in errors.iter_mut().filter(|error| error.code == "E0201") {
                if let Some(near) = compile::nearest(&model, library_models()) {
                    error.help = Some(format!("did you mean `{near}`?"));
                }
            }
            found(&loaded, &errors, &typed, Some(at))
        })?;
        drop(case);
        next.at_bench = true;
        next.bench.known = next.listed(&Subject::Session, &next.bench);
        *self = next;
        let known = self.bench.known.clone();
        let count = |kind: &str| known.iter().filter(|q| q.kind == kind && q.path.starts_with(&prefix)).count();
        let mut words =
            format!("{name}: {model}, {}, {}", counted(count("state"), "state"), counted(count("param"), "parameter"));
        if let Some(first) = open.first() {
            let all: Vec<String> = open.iter().map(|input| format!("{name}.{input}")).collect();
            let input = format!("{name}.{first}");
            let unit = known.iter().find(|q| q.path == input).map_or("", |q| &q.unit);
            words += &format!("; {} = 0 until you set it, as in `{} = 1 {unit}`", all.join(" = "), all[0]);
        }
        Ok(words)
    }

    /// Sets a parameter, an input or a slot of an instance or of the last run.
    pub fn set(&mut self, path: &str, setting: &str) -> Result<(), Fault> {
        let setting = &match setting.split_once('=') {
            Some((left, value)) => format!("{left}={}", self.with_values(value)?),
            None => setting.to_string(),
        };
        let what = self.meant(path);
        let Some(what) = what else {
            let head = path.split('.').next().unwrap_or(path);
            let names = self.parts.iter().map(|part| part.name.as_str());
            let help = match compile::nearest(head, names) {
                Some(near) => format!("did you mean `{near}`?"),
                None => {
                    format!("`{head} = Model()` makes an instance, `use \"FILE.fric\"` and `run NAME` bring a system")
                }
            };
            return Err(Fault::Words(format!("there is no `{head}` here to set; {help}")));
        };
        let mut setup = self.setup(&what).clone();
        let same = |other: &String| {
            let left: String = other.split('=').next().unwrap_or_default().split_whitespace().collect();
            left == path
        };
        setup.set.retain(|other| !same(other));
        setup.set.push(setting.to_string());
        let (mut loaded, name) = self.loaded(&what, "");
        let cases = self.compiled_in(&mut loaded, &name, &setup, &[], true);
        cases.map_err(|errors| found(&loaded, &errors, setting, None))?;
        self.at_bench = what == Subject::Session;
        *self.setup_mut(&what) = setup;
        if grammar::parse::parse_setting(FileId(0), setting).0.is_none() {
            // Another model in a slot has other quantities.
            self.setup_mut(&what).known = self.listed(&what, self.setup(&what));
        }
        Ok(())
    }

    /// Reloads the files in use.
    pub fn reload(&mut self) -> Result<(), Fault> {
        let mut next = self.clone();
        for used in &mut next.used {
            let text = project::read(Path::new(&used.path))
                .map_err(|why| Fault::Words(format!("cannot read {}: {why}", used.path)))?;
            used.loaded = compile::load(&used.path, &text, &crate::disk::Disk);
            if used.loaded.has_errors() {
                let found = used.loaded.diagnostics.clone();
                return Err(Fault::Found(used.loaded.files.0.clone(), found));
            }
        }
        *self = next;
        Ok(())
    }
}

/// Whether a diagnostic is about the session's text, not about the model that is composed here.
pub(super) fn concerns(loaded: &Loaded, found: &Diagnostic) -> bool {
    let text = &loaded.files.get(loaded.root()).text;
    let own = text.find(&format!("model {MODEL} {{")).unwrap_or(text.len());
    found.is_error() || (found.span().file == loaded.root() && (found.span().start as usize) < own)
}

/// Inputs of a model without a default.
pub(super) fn open_inputs(model: &ast::Model) -> Vec<&str> {
    let inputs = model.body.iter().filter_map(|statement| match statement {
        Statement::Declaration(d) if d.kind == DeclarationKind::Input && d.value.is_none() => {
            Some(d.name.text.as_str())
        }
        _ => None,
    });
    inputs.collect()
}

/// The module of the library that defines a model or interface: `std.friction.lugre`.
pub(super) fn library_module(name: &str) -> Option<&'static str> {
    let defines = |text: &str| {
        ["model", "interface"].iter().any(|word| {
            let head = format!("{word} {name}");
            text.match_indices(&head).any(|(at, _)| {
                let begins = at == 0 || text[..at].ends_with('\n');
                begins && !text[at + head.len()..].starts_with(|c: char| c.is_alphanumeric() || c == '_')
            })
        })
    };
    project::library().iter().find(|(_, text)| defines(text)).map(|(module, _)| *module)
}

/// Names of the models of the library.
pub fn library_models() -> Vec<&'static str> {
    let of = |text: &'static str| {
        text.lines().filter_map(|line| {
            let name = line.strip_prefix("model ")?;
            Some(&name[..name.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(name.len())])
        })
    };
    project::library().iter().flat_map(|(_, text)| of(text)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_of_the_library_are_found_by_name() {
        assert_eq!(library_module("LuGre"), Some("std.friction.lugre"));
        assert_eq!(library_module("Nonsense"), None);
        assert!(library_models().contains(&"Karnopp"));
    }
}
