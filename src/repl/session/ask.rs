//! Queries that do not run the session: values, quantities, meanings of names.
//!
//! In: expressions, names, paths. Out: values, trees, explanations. Changes nothing.

use super::words::{Value, literal, model_of};
use super::{Fault, Session, Setup, Subject, TEXT, Used, begin, found};
use crate::compile::{self, Case, Changes, Explanation, Loaded, Lookup, QuantityInfo, SourceFile, Space};
use abi::unit::{Dimension, Unit};
use grammar::ast::{self, Item};
use grammar::diagnostic::Diagnostic;
use grammar::tokens::{TokenKind, tokens};
use runtime::engine::{self, Continue};
use std::sync::Arc;

impl Session {
    /// The present value of an expression.
    pub fn value(&mut self, text: &str) -> Result<Value, Fault> {
        let text = self.with_values(text)?;
        let what = self.meant(&text).unwrap_or(Subject::Session);
        let case = match self.now(&what, &[format!("plot {text}")], &text) {
            // A measure, or its window, which lies outside of the second that a query takes.
            Err(Fault::Found(files, errors)) if errors.iter().any(|error| matches!(error.code, "E0901" | "E0902")) => {
                return self.measured(&what, &text).unwrap_or(Err(Fault::Found(files, unplotted(errors))));
            }
            Err(Fault::Found(files, errors)) => return Err(Fault::Found(unplot(files, &text), unplotted(errors))),
            other => other?,
        };
        let series = case.experiment.plots.last().and_then(|plot| plot.series.first());
        let series = series.ok_or_else(|| Fault::Words("that is no expression".into()))?;
        let si = case.instance.get(series.slot);
        Ok(Value { si, unit: series.unit.clone(), boolean: series.boolean })
    }

    /// The first case of `what`, in its present state.
    pub(super) fn now(&self, what: &Subject, also: &[String], typed: &str) -> Result<Case, Fault> {
        let (mut loaded, name) = self.loaded(what, "");
        // A query needs no expectations, and no long run.
        let setup = Setup { also: Vec::new(), duration: Some(1.0), ..self.setup(what).clone() };
        let (cases, _) = self
            .compiled_in(&mut loaded, &name, &setup, also, true)
            .map_err(|errors| found(&loaded, &errors, typed, None))?;
        let mut case = cases.into_iter().next().expect("there is a case");
        begin(&mut case.instance, setup.live.as_ref(), 0.0);
        Ok(case)
    }

    /// A measure over the last run, such as `max(fr.F)`.
    pub(super) fn measured(&mut self, what: &Subject, text: &str) -> Option<Result<Value, Fault>> {
        self.setup(what).duration.or_else(|| matches!(what, Subject::Experiment(..)).then_some(1.0))?;
        let setup = Setup { also: vec![format!("show {text}")], ..self.setup(what).clone() };
        let (mut loaded, name) = self.loaded(what, "");
        let cases = self.compiled_in(&mut loaded, &name, &setup, &[], false);
        let (cases, _) = match cases {
            Ok(cases) => cases,
            Err(_) => return None,
        };
        let case = cases.into_iter().next()?;
        let outcome = engine::run(case.instance, &case.experiment, &mut |_| Continue::Continue(()));
        let outcome = match outcome {
            Ok(outcome) => outcome,
            Err(failure) => return Some(Err(Fault::Stopped(Box::new(failure)))),
        };
        let verdict = outcome.verdicts.last()?;
        if let Some(problem) = &verdict.problem {
            return Some(Err(Fault::Words(problem.clone())));
        }
        let shown = verdict.shown.as_ref()?;
        Some(Ok(Value { si: shown.value, unit: shown.unit.clone(), boolean: false }))
    }

    /// Stores a value for `ans`.
    pub fn answer(&mut self, value: &Value) {
        self.ans = Some(value.clone());
    }

    /// The text with `ans` replaced by the last value, and variables by theirs. A quantity of the last run or of an
    /// instance takes precedence over a variable of its name.
    pub(super) fn with_values(&self, text: &str) -> Result<String, Fault> {
        let mut out = String::new();
        let mut after_dot = false;
        let all = tokens(text);
        for (k, token) in all.iter().enumerate() {
            let word = token.text(text);
            let next = all[k + 1..].iter().find(|token| !token.is_trivia()).map(|token| token.text(text));
            // `x.y`, `x(…)`, and `x = …` of an argument name something else.
            let named = after_dot || matches!(next, Some("." | "(" | "="));
            let variable =
                || self.variables.iter().find(|(name, ..)| name == word && self.quantities().all(|q| q.path != word));
            if token.kind == TokenKind::Word && word == "ans" && !after_dot {
                let value = self.ans.as_ref().ok_or("there is no `ans` yet: it is the last value shown")?;
                out += &literal(value);
            } else if let (TokenKind::Word, false, Some((_, _, value))) = (token.kind, named, variable()) {
                out += &literal(value);
            } else {
                out += word;
            }
            after_dot = word == "." || (after_dot && token.is_trivia());
        }
        Ok(out)
    }

    /// `x = 3 mm`: a value with a name, for later lines.
    pub fn set_variable(&mut self, name: &str, text: &str) -> Result<Value, Fault> {
        let value = self.value(text)?;
        self.variables.retain(|(other, ..)| other != name);
        self.variables.push((name.into(), text.trim().into(), value.clone()));
        Ok(value)
    }

    /// Variables, each with its value as typed.
    pub fn variables(&self) -> impl Iterator<Item = (&str, &str)> {
        self.variables.iter().map(|(name, text, _)| (name.as_str(), text.as_str()))
    }

    /// Whether a name is free for a variable: it is no quantity, instance or constant.
    pub fn is_free(&self, name: &str) -> bool {
        let part =
            |path: &str| path == name || path.strip_prefix(name).is_some_and(|rest| rest.starts_with(['.', '[']));
        !self.own_constant(name)
            && self.quantities().all(|q| !part(&q.path))
            && self.parts.iter().all(|p| p.name != name)
    }

    /// The quantities of an instance or a part with their present values; none if there is no part of this name.
    pub fn part_values(&self, name: &str) -> Option<Result<Vec<(QuantityInfo, Value)>, Fault>> {
        let what = self.meant(name).unwrap_or_else(|| self.current());
        let prefix = format!("{name}.");
        let known = self.setup(&what).known.clone();
        let listed: Vec<QuantityInfo> = known.iter().filter(|q| q.path.starts_with(&prefix)).cloned().collect();
        if listed.is_empty() || known.iter().any(|q| q.path == name) {
            return None;
        }
        let paths: Vec<&str> = listed.iter().map(|q| q.path.as_str()).collect();
        Some(self.now(&what, &[format!("plot {}", paths.join(", "))], name).map(|case| {
            let series = case.experiment.plots.last().map_or(&[][..], |plot| &plot.series[..]);
            let value = |series: &abi::plan::Series| Value {
                si: case.instance.get(series.slot),
                unit: series.unit.clone(),
                boolean: series.boolean,
            };
            listed.into_iter().zip(series.iter().map(value)).collect()
        }))
    }

    /// The dimension that fits in place of `?` in a line.
    pub fn wanted(&self, line: &str) -> Option<Dimension> {
        let what = self.meant(line).unwrap_or(Subject::Session);
        let (mut loaded, name) = self.loaded(&what, "");
        let setup = Setup { also: Vec::new(), duration: Some(1.0), ..self.setup(&what).clone() };
        let errors = self.compiled_in(&mut loaded, &name, &setup, &[format!("plot {line}")], true).err()?;
        let hole = errors.iter().find(|error| error.code == "E0112")?;
        Unit::parse(&hole.labels.first()?.text).ok().map(|unit| unit.dimension)
    }

    /// Quantities for completion: those of the instances, then those of the last run.
    pub fn quantities(&self) -> impl Iterator<Item = &QuantityInfo> {
        let staged = self.stage.as_ref().map_or(&[][..], |(_, setup)| &setup.known);
        self.bench.known.iter().chain(staged)
    }

    /// Every quantity of `what`; empty if it does not compile in its present form.
    pub(super) fn listed(&self, what: &Subject, setup: &Setup) -> Arc<[QuantityInfo]> {
        let (mut loaded, name) = self.loaded(what, "");
        let changes = Changes { set: setup.set.clone(), unjudged: true, ..Changes::default() };
        compile::quantities(&mut loaded, &crate::disk::Disk, &name, &changes).unwrap_or_default().into()
    }

    /// Explains a quantity, a part, an experiment or a model: the explanation, and the path within it; no path for a
    /// model, an empty one for another whole. The last run and the instances take precedence over models of the same
    /// name.
    pub fn explained(&mut self, name: &str) -> Result<(Explanation, Option<String>), Fault> {
        let what = self.meant(name).unwrap_or_else(|| self.current());
        let known = self.setup(&what).known.clone();
        let prefix = format!("{name}.");
        if known.iter().any(|q| q.path == name) {
            return Ok((self.explained_run(&what, name)?, Some(name.to_string())));
        }
        if self.parts.iter().any(|part| part.name == name) || known.iter().any(|q| q.path.starts_with(&prefix)) {
            let mut explanation = self.explained_run(&what, name)?;
            explanation.model = name.to_string();
            explanation.quantities.retain(|q| q.path.starts_with(&prefix));
            explanation.equations.retain(|(left, _)| left.contains(&prefix));
            explanation.states.retain(|state| state.path.starts_with(&prefix));
            return Ok((explanation, Some(String::new())));
        }
        let head = name.split(['.', '[']).next().unwrap_or(name);
        let own = compile::load(TEXT, &self.text("", "").0, &crate::disk::Disk);
        let texts = [&own].into_iter().chain(self.used.iter().rev().map(|used| &used.loaded));
        for loaded in texts.clone() {
            if let Lookup::Found(item, Item::Model(_)) = loaded.find(loaded.root(), Space::Type, head) {
                let explanation = compile::explain_in(loaded, &crate::disk::Disk, head, item.file);
                return explanation
                    .map(|explanation| (explanation, None))
                    .map_err(|errors| found(loaded, &errors, name, None));
            }
        }
        if self.experiments().iter().any(|experiment| experiment == name) {
            let what = self.experiment(name)?;
            return Ok((self.explained_run(&what, name)?, Some(String::new())));
        }
        let experiments = self.experiments();
        let quantities = known.iter().map(|q| q.path.as_str());
        let visible = texts.flat_map(|loaded| loaded.visible(loaded.root(), Space::Type));
        let names = quantities.chain(visible).chain(experiments.iter().map(String::as_str));
        let help = match compile::nearest(name, names) {
            Some(near) => format!("did you mean `{near}`?"),
            None if known.is_empty() && !experiments.is_empty() => {
                format!("quantities of an experiment are known once it has been run, `run {}`", experiments[0])
            }
            None => "`names` shows what there is".into(),
        };
        Err(Fault::Words(format!("there is no quantity, part, model or experiment `{name}` here; {help}")))
    }

    fn explained_run(&self, what: &Subject, typed: &str) -> Result<Explanation, Fault> {
        let (mut loaded, experiment) = self.loaded(what, "");
        // Settings belong to the last run, or to the instances.
        let set = match &self.stage {
            Some((staged, setup)) if staged == what => setup.set.clone(),
            _ if *what == Subject::Session => self.bench.set.clone(),
            _ => Vec::new(),
        };
        let changes = Changes { set, unjudged: true, ..Changes::default() };
        compile::explain_run(&mut loaded, &crate::disk::Disk, &experiment, &changes)
            .map_err(|errors| found(&loaded, &errors, typed, None))
    }

    /// The message that there is no model of this name, with suggestions.
    pub fn no_model(&self, name: &str) -> Fault {
        let known = self.quantities().any(|q| q.path == name || q.path.starts_with(&format!("{name}.")));
        Fault::Words(if self.experiments().iter().any(|experiment| experiment == name) {
            format!("`{name}` is an experiment; `explain {name}` shows what it runs")
        } else if known {
            format!("`{name}` is no model; `explain {name}` says what it is")
        } else {
            let models = self.models();
            match compile::nearest(name, models.iter().map(String::as_str)) {
                Some(near) => format!("there is no model `{name}`; did you mean `{near}`?"),
                None => format!("there is no model `{name}`; `names` shows what there is"),
            }
        })
    }

    /// The syntax tree of a visible model, from the session or from a file in use.
    pub fn model(&self, name: &str) -> Option<ast::Model> {
        let name = self.parts.iter().find(|part| part.name == name).map_or(name, |part| &part.instance);
        let name = &model_of(name);
        let own = compile::load(TEXT, &self.items.join("\n"), &crate::disk::Disk);
        let texts = [&own].into_iter().chain(self.used.iter().rev().map(|used| &used.loaded));
        texts.into_iter().find_map(|loaded| match loaded.find(loaded.root(), Space::Type, name) {
            Lookup::Found(_, Item::Model(model)) => Some(model.clone()),
            _ => None,
        })
    }

    /// Visible models and interfaces.
    pub fn models(&self) -> Vec<String> {
        let own = compile::load(TEXT, &self.items.join("\n"), &crate::disk::Disk);
        own.visible(own.root(), Space::Type).into_iter().map(str::to_string).collect()
    }

    /// Names of instances, each with its definition.
    pub fn instances(&self) -> Vec<(String, String)> {
        self.parts.iter().map(|part| (part.name.clone(), part.instance.clone())).collect()
    }

    /// The place of an experiment with this name: among the session's own, or in the file in use, last first.
    pub(super) fn experiment(&self, name: &str) -> Result<Subject, Fault> {
        let own = compile::load(TEXT, &self.items.join("\n"), &crate::disk::Disk);
        if own.experiments().iter().any(|experiment| experiment.name == name) {
            return Ok(Subject::Experiment(None, name.into()));
        }
        let has = |used: &Used| used.loaded.experiments().iter().any(|experiment| experiment.name == name);
        if let Some(file) = self.used.iter().rposition(has) {
            return Ok(Subject::Experiment(Some(file), name.into()));
        }
        let experiments = self.experiments();
        let known = experiments.iter().map(String::as_str).chain(self.parts.iter().map(|part| part.name.as_str()));
        let help = match compile::nearest(name, known.clone()) {
            Some(near) => format!("did you mean `{near}`?"),
            None if known.clone().next().is_none() => "`use \"FILE.fric\"` brings experiments".into(),
            None => format!("there are {}", known.collect::<Vec<_>>().join(", ")),
        };
        Err(Fault::Words(format!("there is no experiment or instance `{name}`; {help}")))
    }

    /// The last run other than of the instances: its name, and its quantities without parameters.
    pub fn staged(&self) -> Option<(String, Vec<String>)> {
        let (what, setup) = self.stage.as_ref()?;
        let name = match what {
            Subject::Experiment(_, name) => name.clone(),
            Subject::Typed(instance) => instance.clone(),
            Subject::Session => return None,
        };
        let read = setup.known.iter().filter(|q| q.kind != "param");
        Some((name, read.map(|q| q.path.clone()).collect()))
    }

    /// Names of all experiments.
    pub fn experiments(&self) -> Vec<String> {
        let own = compile::load(TEXT, &self.items.join("\n"), &crate::disk::Disk);
        let of = |loaded: &Loaded| loaded.experiments().into_iter().map(|experiment| experiment.name);
        of(&own).chain(self.used.iter().flatten_experiments()).collect()
    }

    /// Names of the experiments of a file in use.
    pub fn experiments_of(&self, path: &str) -> Vec<String> {
        self.used.iter().filter(|used| used.path == path).flatten_experiments()
    }

    /// Imports of the session as lines, and an instance as typed: for the battery.
    pub fn origin(&self, model: &str) -> Option<String> {
        let has = |used: &&Used| used.loaded.models().iter().any(|one| one.name.text == model);
        self.used.iter().rev().find(has).map(|used| used.path.clone())
    }

    /// The files on disk that a file in use consists of.
    pub fn files_of(&self, path: &str) -> Vec<String> {
        let used = self.used.iter().find(|used| used.path == path);
        let files = used.map_or(Vec::new(), |used| used.loaded.files.0.clone());
        files.into_iter().filter(|file| !file.library && !file.name.starts_with("--")).map(|file| file.name).collect()
    }

    /// The warnings of each file in use.
    pub fn lints(&self) -> Vec<(Vec<SourceFile>, Vec<Diagnostic>)> {
        let of = |used: &Used| {
            let mut loaded = used.loaded.clone();
            let found = compile::check(&mut loaded, &crate::disk::Disk);
            (loaded.files.0, found)
        };
        let (text, ..) = self.text("", "");
        let own = Used { path: TEXT.into(), loaded: compile::load(TEXT, &text, &crate::disk::Disk) };
        self.used.iter().chain([&own]).map(of).filter(|(_, found)| !found.is_empty()).collect()
    }
}

/// For [`Session::experiments`].
trait Experiments {
    fn flatten_experiments(self) -> Vec<String>;
}

impl<'a, I: Iterator<Item = &'a Used>> Experiments for I {
    fn flatten_experiments(self) -> Vec<String> {
        self.flat_map(|used| used.loaded.experiments().into_iter().map(|experiment| experiment.name)).collect()
    }
}

/// The expression was compiled as `plot EXPR`: the report shows only the expression.
pub(super) fn unplot(mut files: Vec<SourceFile>, text: &str) -> Vec<SourceFile> {
    for file in files.iter_mut().filter(|file| file.text.strip_prefix("plot ") == Some(text)) {
        file.text = text.into();
    }
    files
}

/// Maps positions in `plot EXPR` to positions in the expression.
pub(super) fn unplotted(errors: Vec<Diagnostic>) -> Vec<Diagnostic> {
    let moved = |mut error: Diagnostic| {
        for label in &mut error.labels {
            label.span.start = label.span.start.saturating_sub(5);
            label.span.end = label.span.end.saturating_sub(5);
        }
        error
    };
    errors.into_iter().map(moved).collect()
}
