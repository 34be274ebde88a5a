//! `fric doc`: a page on all models of the library, generated from the library's text.
//!
//! In: the embedded library. Out: `docs/models.md`, and characteristic plots in a folder of the same name beside it.
//! The page includes the plots that exist, so it can be compared without running anything.

use super::End;
use super::characterise::fitted;
use crate::args::Doc;
use crate::characterise::subject::{self, Written};
use crate::characterise::{Extent, drawn, study};
use crate::terminal::Terminal;
use crate::{compile, equations, plot, project};
use grammar::ast::{Declaration, DeclarationKind, Function, Interface, Item, Model, Statement};
use std::path::Path;

/// Graphs in a model's section.
const SHOWN: [(&str, &str); 2] = [("steady", "steady friction against velocity"), ("presliding", "presliding loops")];

pub fn doc(args: &Doc, terminal: &mut Terminal) -> End {
    let folder = args.out.with_extension("");
    if args.check {
        let there = project::read(&args.out).unwrap_or_default();
        if there == page(&folder) {
            return End::Fine;
        }
        terminal.error(&format!("{} is not what the library says; run `fric doc`", args.out.display()));
        return End::Failed;
    }
    if !args.keep_plots
        && let Err(why) = plots(&folder, terminal)
    {
        terminal.error(&why);
        return End::Failed;
    }
    if let Err(error) = project::write(&args.out, page(&folder).as_bytes()) {
        terminal.error(&format!("cannot write {}: {error}", args.out.display()));
        return End::Failed;
    }
    terminal.line(&format!("wrote {}", args.out.display()));
    End::Fine
}

/// Draws the characteristic plots of the friction models, where they have them with their default parameters.
fn plots(folder: &Path, terminal: &mut Terminal) -> Result<(), String> {
    for (_, items) in library().into_iter().filter(|(module, _)| module.starts_with("std.friction.")) {
        for model in items.iter().filter_map(|item| match item {
            Item::Model(model) if subject::looks_like_friction(model) => Some(model),
            _ => None,
        }) {
            let name = &model.name.text;
            let battery = folder.join("battery.fric").display().to_string();
            let studied = Written::read(name)
                .and_then(|written| fitted(written, None, folder, &crate::disk::Disk))
                .and_then(|subject| study(subject, &battery, &crate::disk::Disk, Extent::Sketch));
            let studied = match studied {
                Ok(studied) => studied,
                Err(why) => {
                    let why = why.lines().find(|line| !line.trim().is_empty()).unwrap_or_default();
                    terminal.line(&format!("no plots of {name}: {why}"));
                    continue;
                }
            };
            for (key, _) in SHOWN {
                let Some(figure) = drawn(&studied, key) else { continue };
                let path = folder.join(format!("{name}-{key}.svg"));
                let svg = plot::inline(&figure, &plot::Look::default(), 560.0, "axes");
                project::write(&path, svg.as_bytes())
                    .map_err(|error| format!("cannot write {}: {error}", path.display()))?;
            }
        }
    }
    Ok(())
}

/// Every file of the library by its dotted name, with its items.
fn library() -> Vec<(String, Vec<Item>)> {
    let items = |(module, text): &(&'static str, &'static str)| {
        let loaded = compile::load(module, text, &crate::disk::Disk);
        (module.to_string(), loaded.files.get(loaded.root()).ast.items().cloned().collect())
    };
    project::library().iter().map(items).collect()
}

/// The page. `folder` is read only for the list of existing plots.
fn page(folder: &Path) -> String {
    let mut out = String::from(
        "# The library\n\n\
         Made by `fric doc` from the library's own text; `fric characterise NAME` gives the full report of a friction \
         model.\nEvery equation is what is computed, in the symbols of print: `sigma0` is σ₀, `abs(v)` is |v|.\n\n",
    );
    let library = library();
    /// A file of the library: its dotted name, its items.
    type File = (String, Vec<Item>);
    let mut folders: Vec<(&str, Vec<&File>)> = Vec::new();
    for file in &library {
        let group = file.0.split('.').nth(1).unwrap_or_default();
        match folders.last_mut() {
            Some((last, files)) if *last == group => files.push(file),
            _ => folders.push((group, vec![file])),
        }
    }
    for (group, files) in &folders {
        let models = files.iter().flat_map(|(_, items)| items).filter_map(|item| match item {
            Item::Model(model) => Some(format!(
                "| [{0}](#{1}) | {2} |\n",
                model.name.text,
                model.name.text.to_lowercase(),
                first_sentence(model.doc.as_deref().unwrap_or_default()).replace('|', "\\|")
            )),
            _ => None,
        });
        let models: String = models.collect();
        if !models.is_empty() {
            out += &format!("| {group} | |\n|---|---|\n{models}\n");
        }
    }
    for (group, files) in &folders {
        out += &format!("## std.{group}\n\n");
        for (module, items) in files {
            for item in items {
                match item {
                    Item::Model(model) => out += &model_section(model, module, folder),
                    Item::Interface(interface) => out += &interface_section(interface),
                    Item::Function(function) => out += &function_section(function),
                    _ => {}
                }
            }
        }
    }
    out.trim_end().to_string() + "\n"
}

/// The first sentence of a doc comment.
fn first_sentence(doc: &str) -> String {
    let paragraph = doc.trim().split("\n\n").next().unwrap_or_default();
    let words: Vec<&str> = paragraph.split_whitespace().collect();
    let last = words.iter().position(|word| word.ends_with('.')).map_or(words.len(), |at| at + 1);
    words[..last].join(" ").trim_end_matches('.').to_string()
}

/// A doc comment as Markdown: indented lines stay verbatim.
fn prose(doc: Option<&String>) -> String {
    let Some(doc) = doc else { return String::new() };
    let (mut out, mut set_in) = (String::new(), false);
    for line in doc.trim_matches('\n').lines() {
        let inside = line.starts_with("  ") || (set_in && line.trim().is_empty());
        if inside != set_in {
            if !inside {
                // The blank line after an indented part belongs outside.
                out = out.trim_end().to_string() + "\n";
            }
            out += if inside { "```text\n" } else { "```\n" };
            set_in = inside;
        }
        out += line.trim_end();
        out.push('\n');
    }
    if set_in {
        out = out.trim_end().to_string() + "\n```\n";
    }
    // A code fence needs lines of its own.
    let mut text = String::new();
    let mut open = false;
    for line in out.lines() {
        let fence = line.starts_with("```");
        if fence && !open && !text.ends_with("\n\n") && !text.is_empty() {
            text.push('\n');
        }
        text += line;
        text.push('\n');
        if fence {
            open = !open;
            if !open {
                text.push('\n');
            }
        }
    }
    text.trim_end().to_string().replace("\n\n\n", "\n\n") + "\n\n"
}

fn model_section(model: &Model, module: &str, folder: &Path) -> String {
    let name = &model.name.text;
    let mut out = format!("### {name}\n\n`import {module}`\n\n{}", prose(model.doc.as_ref()));
    let lines = equations::lines(&equations::equations(model));
    if !lines.is_empty() {
        out += &format!("```text\n{lines}```\n\n");
    }
    let declarations: Vec<&Declaration> = model
        .body
        .iter()
        .filter_map(|statement| match statement {
            Statement::Declaration(declaration) => Some(declaration),
            _ => None,
        })
        .collect();
    out += &table("parameter", "default", declarations.iter().filter(|d| d.kind == DeclarationKind::Param));
    out += &table("input", "default", declarations.iter().filter(|d| d.kind == DeclarationKind::Input));
    out += &table("state", "start", declarations.iter().filter(|d| d.kind == DeclarationKind::State));
    let outputs = declarations.iter().filter(|declaration| declaration.kind == DeclarationKind::Output);
    let outputs: Vec<String> = outputs
        .map(|declaration| {
            let unit = declaration.unit.as_ref().map_or(String::new(), |unit| format!(" [{}]", unit.text));
            let doc = declaration.doc.as_ref().map_or(String::new(), |doc| format!(" ({})", doc.trim()));
            format!("`{}{unit}`{doc}", declaration.name.text)
        })
        .collect();
    if !outputs.is_empty() {
        out += &format!("Outputs: {}\n\n", outputs.join(", "));
    }
    let there = SHOWN.iter().filter(|(key, _)| folder.join(format!("{name}-{key}.svg")).is_file());
    let beside = folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let images: Vec<String> = there
        .map(|(key, words)| format!("<img src=\"{beside}/{name}-{key}.svg\" width=\"49%\" alt=\"{name}: {words}\">"))
        .collect();
    if !images.is_empty() {
        out += &format!("{}\n\n", images.join("\n"));
    }
    out
}

fn table<'a>(kind: &str, value: &str, rows: impl Iterator<Item = &'a &'a Declaration>) -> String {
    let rows: Vec<String> = rows
        .map(|declaration| {
            let unit = declaration.unit.as_ref().map_or(String::new(), |unit| format!(" [{}]", unit.text));
            let value = declaration.value.as_ref().map_or(String::new(), equations::expression);
            let range = declaration.range.as_ref().map_or(String::new(), subject::range);
            let doc = declaration.doc.as_deref().unwrap_or_default().trim();
            let cells = [value, range, doc.to_string()].map(|cell| cell.replace('|', "\\|"));
            format!("| `{}`{unit} | {} |\n", declaration.name.text, cells.join(" | "))
        })
        .collect();
    if rows.is_empty() {
        return String::new();
    }
    format!("| {kind} | {value} | range | meaning |\n|---|---|---|---|\n{}\n", rows.concat())
}

fn interface_section(interface: &Interface) -> String {
    let ports = interface.ports.iter().collect::<Vec<_>>();
    let side = |kind| ports.iter().filter(move |port| port.kind == kind);
    format!(
        "### interface {}\n\n{}{}{}",
        interface.name.text,
        prose(interface.doc.as_ref()),
        table("input", "default", side(DeclarationKind::Input)),
        table("output", "", side(DeclarationKind::Output))
    )
}

fn function_section(function: &Function) -> String {
    let unit =
        |unit: &Option<grammar::ast::UnitText>| unit.as_ref().map_or(String::new(), |unit| format!(" [{}]", unit.text));
    let args = function
        .args
        .iter()
        .map(|argument| format!("{}{}", equations::symbol(&argument.name.text), unit(&argument.unit)));
    format!(
        "### fn {}\n\n{}```text\n{}({}){} = {}\n```\n\n",
        function.name.text,
        prose(function.doc.as_ref()),
        function.name.text,
        args.collect::<Vec<_>>().join(", "),
        unit(&function.unit),
        equations::expression(&function.body)
    )
}
