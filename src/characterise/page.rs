//! The report: one self-contained HTML page.
//!
//! In: one or more [`Study`] values. Out: a page. Figures are inline SVG; the page loads nothing and runs no script.

use super::measured::{Graph, Test, shown};
use super::phenomena::Seen;
use super::study::{Study, figure};
use crate::equations;
use crate::plot;
use crate::quantity::{show, significant};
use std::fmt::Write;

/// Width of a figure in px: two fit side by side on a laptop.
const WIDE: f64 = 560.0;

const STYLE: &str = "
:root { color: #1f2328; background: #fff; font: 15px/1.5 Roboto, 'Helvetica Neue', Arial, sans-serif; }
body { max-width: 1180px; margin: 0 auto; padding: 28px 24px 60px; }
h1 { font-size: 27px; font-weight: 500; margin: 0 0 4px; }
h2 { font-size: 19px; font-weight: 500; margin: 38px 0 10px; padding-top: 14px; border-top: 1px solid #d8dee4; }
h3 { font-size: 16px; font-weight: 500; margin: 0 0 2px; }
p { margin: 0 0 8px; max-width: 80ch; }
.faint, figcaption, .how { color: #59636e; }
.how { font-size: 13.5px; margin-bottom: 6px; }
table { border-collapse: collapse; font-size: 14px; margin: 6px 0 12px; }
th { text-align: left; font-weight: 500; border-bottom: 1.5px solid #1f2328; padding: 3px 18px 4px 0; vertical-align: bottom; }
td { border-bottom: 1px solid #e4e7eb; padding: 4px 18px 4px 0; vertical-align: top; }
td.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
td.v { white-space: nowrap; }
.mark { display: inline-block; width: 1.3em; font-weight: 700; }
.yes .mark { color: #00694b; } .no .mark { color: #a34700; } .na { color: #59636e; }
.small { font-size: 12.5px; color: #59636e; line-height: 1.35; }
.tests { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 34px 36px; grid-auto-flow: dense; align-items: start; }
.wide { grid-column: 1 / -1; display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 0 36px; }
.wide > header { grid-column: 1 / -1; }
section { break-inside: avoid; }
svg { width: 100%; height: auto; display: block; }
.numbers { font-size: 13px; columns: 1; }
.numbers td { padding: 2px 14px 2px 0; }
.two { columns: 2; column-gap: 36px; }
pre { font: 13px/1.45 'Roboto Mono', Menlo, Consolas, 'DejaVu Sans Mono', monospace; background: #f6f8fa; padding: 12px 14px; overflow-x: auto; margin: 6px 0 12px; }
.quiet { background: none; padding: 2px 14px; color: #1f2328; }
code { font: 0.9em 'Roboto Mono', Menlo, Consolas, 'DejaVu Sans Mono', monospace; background: #f6f8fa; padding: 1px 4px; }
.numbers table { margin: 0; }
.top { display: grid; grid-template-columns: minmax(0, 3fr) minmax(0, 2fr); gap: 0 48px; align-items: start; }
.note { border-left: 3px solid #d55e00; padding: 4px 12px; margin: 10px 0; max-width: 90ch; }
.reason { border-left: 3px solid #c3cad2; padding: 3px 12px; color: #59636e; margin: 8px 0; }
details > summary { cursor: pointer; color: #0072b2; }
@media (max-width: 900px) { .tests, .wide, .top { grid-template-columns: 1fr; } }
@media print { body { max-width: none; padding: 0; } h2 { break-after: avoid; } details { display: none; } }
";

/// The page for one model.
pub fn report(study: &Study) -> String {
    let mut body = String::new();
    let subject = &study.subject;
    let _ = writeln!(body, "<h1>{}</h1>", escaped(&study.label));
    let _ = writeln!(
        body,
        "<p class=\"faint\">Friction model{}, characterised by fric {} ({}, compiled to machine code). Every curve and number below was \
         computed from runs of the battery at the end of this page; nothing is taken from what the model says of \
         itself.</p>",
        if subject.rotary { " of rotary motion" } else { "" },
        env!("CARGO_PKG_VERSION"),
        match &subject.origin {
            super::subject::Origin::Library => "library of the same version".to_string(),
            super::subject::Origin::File(path) => format!("model from {}", escaped(path)),
        }
    );
    for note in &study.notes {
        let _ = writeln!(body, "<p class=\"note\">{}</p>", words(note));
    }

    body += "<div class=\"top\">\n<div>\n<h2>Phenomena</h2>\n<table>\n\
             <tr><th>phenomenon</th><th>seen</th><th>behind it</th></tr>\n";
    for finding in &study.findings {
        let _ = writeln!(
            body,
            "<tr class=\"{}\"><td>{}</td><td class=\"v\">{}{}</td><td>{}</td></tr>",
            class(finding.seen),
            finding.name,
            mark(finding.seen),
            finding.seen.words(),
            words(&finding.why)
        );
    }
    body += "</table>\n</div>\n<div>\n<h2>Parameters</h2>\n";
    body += &parameters(study);
    body += &scales(study);
    body += "</div>\n</div>\n";

    body += "<h2>Model</h2>\n";
    if let Some(doc) = &subject.doc {
        body += &prose(doc);
    }
    let _ = writeln!(body, "<pre>{}</pre>", escaped(&equations::lines(&subject.equations)));

    body += "<h2>Tests</h2>\n<div class=\"tests\">\n";
    for test in &study.tests {
        body += &section(test, &[study]);
    }
    body += "</div>\n";
    body += "<h2>The battery</h2>\n<p>Save it beside the model and run it with <code>fric run</code>, or change it first.</p>\n";
    let _ =
        write!(body, "<details><summary>battery.fric</summary>\n<pre>{}</pre></details>\n", escaped(&study.battery));
    page(&study.label, &body)
}

/// The page of several models side by side.
pub fn comparison(studies: &[Study]) -> String {
    let mut body = String::from("<h1>Friction models side by side</h1>\n");
    let _ = writeln!(
        body,
        "<p class=\"faint\">{}; characterised by fric {}. Every verdict comes from runs, with the numbers behind \
         it.</p>",
        escaped(&studies.iter().map(|study| study.label.as_str()).collect::<Vec<_>>().join(", ")),
        env!("CARGO_PKG_VERSION")
    );
    if let Some(bench) = studies.iter().find_map(|study| study.bench.as_ref()) {
        let _ = writeln!(body, "<p class=\"note\">{}.</p>", words(&capital(bench)));
    }
    for study in studies {
        for note in &study.notes {
            let _ = writeln!(body, "<p class=\"note\">{}: {}</p>", escaped(&study.label), words(note));
        }
    }
    body += "<h2>Phenomena</h2>\n<table>\n<tr><th>phenomenon</th>";
    for study in studies {
        let _ = write!(body, "<th>{}</th>", escaped(&study.label));
    }
    body += "</tr>\n";
    for (i, finding) in studies.first().map_or(&[][..], |study| &study.findings).iter().enumerate() {
        let _ = write!(body, "<tr><td>{}</td>", finding.name);
        for study in studies {
            let finding = &study.findings[i];
            let _ = write!(
                body,
                "<td class=\"{}\">{}{}<div class=\"small\">{}</div></td>",
                class(finding.seen),
                mark(finding.seen),
                finding.seen.words(),
                words(&finding.why)
            );
        }
        body += "</tr>\n";
    }
    body += "</table>\n<h2>Scales</h2>\n<table>\n<tr><th>measured first</th>";
    for study in studies {
        let _ = write!(body, "<th>{}</th>", escaped(&study.label));
    }
    body += "</tr>\n";
    for i in 0..4 {
        let _ = write!(body, "<tr><td>{}</td>", scale_rows(&studies[0])[i].0);
        for study in studies {
            let _ = write!(body, "<td>{}</td>", scale_rows(study)[i].1);
        }
        body += "</tr>\n";
    }
    body += "</table>\n<h2>Tests</h2>\n<div class=\"tests\">\n";
    let all: Vec<&Study> = studies.iter().collect();
    for test in studies.first().map_or(&[][..], |study| &study.tests) {
        body += &section(test, &all);
    }
    body += "</div>\n";
    page("Friction models side by side", &body)
}

pub fn page(title: &str, body: &str) -> String {
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <title>{}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n{body}</body>\n</html>\n",
        escaped(title)
    )
}

/// Graphs of one kind: of each model its number, its label and the graph.
type Group<'a> = Vec<(usize, &'a str, &'a Graph)>;

/// The graphs of one test that share a figure, and in words why others are missing.
fn groups<'a>(test: &Test, studies: &[&'a Study]) -> (Vec<Group<'a>>, String) {
    let found: Vec<(&'a Study, &'a Test)> = studies
        .iter()
        .filter_map(|study| Some((*study, study.tests.iter().find(|other| other.key == test.key)?)))
        .collect();
    let mut graphs: Vec<Group> = Vec::new();
    let mut reasons = String::new();
    for (study, test) in &found {
        let number = studies.iter().position(|other| std::ptr::eq(*other, *study)).unwrap_or_default();
        match &test.result {
            Ok(own) => {
                for graph in own {
                    if let Some(why) = graph.alone.as_ref().filter(|_| studies.len() > 1) {
                        let _ = writeln!(
                            reasons,
                            "<p class=\"reason\">{} is not drawn over {}: {}</p>",
                            escaped(&study.label),
                            escaped(&graph.x.0),
                            escaped(why)
                        );
                        continue;
                    }
                    match graphs.iter_mut().find(|group| group[0].2.key == graph.key && group[0].2.x.1 == graph.x.1) {
                        Some(group) => group.push((number, &study.label, graph)),
                        None => graphs.push(vec![(number, &study.label, graph)]),
                    }
                }
            }
            Err(why) => {
                let who = if studies.len() > 1 { format!("{}: ", study.label) } else { String::new() };
                let _ = writeln!(reasons, "<p class=\"reason\">{}not available: {}</p>", escaped(&who), escaped(why));
            }
        }
    }
    (graphs, reasons)
}

/// Every figure of the studies, each with a name for its file.
pub fn figures(studies: &[&Study]) -> Vec<(String, plot::Figure)> {
    let tests = studies.first().map_or(&[][..], |study| &study.tests);
    let mut out: Vec<(String, plot::Figure)> = Vec::new();
    for test in tests {
        for group in groups(test, studies).0 {
            let key = group[0].2.key.to_string();
            // Graphs of one kind in two units have one name.
            let again = out.iter().filter(|(name, _)| *name == key || name.starts_with(&format!("{key}-"))).count();
            let name = if again == 0 { key } else { format!("{key}-{}", again + 1) };
            out.push((name, figure(&group, studies.len())));
        }
    }
    out
}

/// What was done in a test, in a sentence; for several models that differ in it, one for each.
fn caption(found: &[(&Study, &Test)]) -> String {
    match found {
        [] => String::new(),
        [(_, first), others @ ..] if others.iter().all(|(_, test)| test.how == first.how) => escaped(&first.how),
        all => {
            let one = |(study, test): &(&Study, &Test)| format!("{}: {}", escaped(&study.label), escaped(&test.how));
            all.iter().map(one).collect::<Vec<_>>().join("<br>")
        }
    }
}

/// One test: its figures, and its numbers if the page is for one model only.
fn section(test: &Test, studies: &[&Study]) -> String {
    let found: Vec<(&Study, &Test)> = studies
        .iter()
        .filter_map(|study| Some((*study, study.tests.iter().find(|other| other.key == test.key)?)))
        .collect();
    let (graphs, reasons) = groups(test, studies);
    let wide = graphs.len() > 1;
    let mut out = format!("<section{}>\n<header><h3>{}</h3>\n", if wide { " class=\"wide\"" } else { "" }, test.title);
    let _ = writeln!(out, "<p class=\"how\">{}</p>", caption(&found));
    out += "</header>\n";
    for group in &graphs {
        let id = format!("{}-", group[0].2.key);
        let drawn = figure(group, studies.len());
        let _ = writeln!(
            out,
            "<figure style=\"margin:0\">{}</figure>",
            plot::inline(&drawn, &plot::Look::default(), WIDE, &id)
        );
    }
    out += &reasons;
    if let [(_, test)] = found[..]
        && !test.numbers.is_empty()
    {
        let many = if test.numbers.len() > 6 { " two" } else { "" };
        let _ = write!(out, "<div class=\"numbers{many}\"><table>");
        for number in &test.numbers {
            let _ = write!(out, "<tr><td>{}</td><td class=\"n\">{}</td></tr>", escaped(&number.name), number.shown());
        }
        out += "</table></div>\n";
    }
    out + "</section>\n"
}

fn parameters(study: &Study) -> String {
    if study.subject.params.is_empty() {
        return "<p class=\"faint\">none</p>\n".into();
    }
    let mut out = String::from(
        "<table>\n<tr><th>parameter</th><th style=\"text-align:right\">value</th><th>range</th><th>meaning</th></tr>\n",
    );
    for param in &study.subject.params {
        let _ = writeln!(
            out,
            "<tr><td>{}</td><td class=\"n\">{}</td><td>{}</td><td>{}</td></tr>",
            escaped(&param.path),
            value(param.value, &param.unit),
            escaped(&param.range),
            escaped(param.doc.as_deref().unwrap_or_default())
        );
    }
    out + "</table>\n"
}

pub(super) fn scale_rows(study: &Study) -> [(&'static str, String); 4] {
    let scales = &study.scales;
    [
        ("break-away force of a slow ramp, F_b", shown(scales.f_b, study.units.force)),
        ("travel to 99 % of it, x_b", shown(scales.travel, study.units.length)),
        ("least force of sliding, F_c", shown(scales.f_c, study.units.force)),
        ("speed scale, v_s", shown(scales.v_s, study.units.speed)),
    ]
}

fn scales(study: &Study) -> String {
    let mut out = String::from("<p>The battery is laid out with scales that were measured first:</p>\n<table>\n");
    for (name, value) in scale_rows(study) {
        let _ = writeln!(out, "<tr><td>{name}</td><td class=\"n\">{value}</td></tr>");
    }
    let _ = write!(
        out,
        "<tr><td>mass on the benches</td><td class=\"n\">{} {}</td></tr>\n</table>\n",
        significant(study.mass, 3),
        study.units.mass.replace("^2", "²")
    );
    out
}

/// A parameter's value; infinity as ∞.
fn value(si: f64, unit: &abi::unit::Unit) -> String {
    if si == f64::INFINITY { "∞".into() } else { show(si, unit, 6) }
}

/// A doc comment: paragraphs, and indented lines verbatim.
fn prose(doc: &str) -> String {
    let mut out = String::new();
    for block in doc.trim_matches('\n').split("\n\n") {
        let set_in = |line: &str| line.starts_with("  ");
        let (mut text, mut lines) = (String::new(), String::new());
        for line in block.lines() {
            if set_in(line) {
                lines += &format!("{}\n", escaped(line.trim_end()));
            } else {
                text += &format!("{} ", line.trim());
            }
        }
        if !text.is_empty() {
            out += &format!("<p>{}</p>\n", words(text.trim()));
        }
        if !lines.is_empty() {
            out += &format!("<pre class=\"quiet\">{lines}</pre>\n");
        }
    }
    out
}

/// A line of text, with backticks as code.
pub fn words(text: &str) -> String {
    let parts = text.split('`').enumerate();
    let part = |(i, part): (usize, &str)| match i % 2 {
        1 => format!("<code>{}</code>", escaped(part)),
        _ => escaped(part),
    };
    parts.map(part).collect()
}

fn class(seen: Seen) -> &'static str {
    match seen {
        Seen::Shown => "yes",
        Seen::NotShown => "no",
        Seen::NotApplicable | Seen::NotRun | Seen::NotProven => "na",
    }
}

fn mark(seen: Seen) -> &'static str {
    match seen {
        Seen::Shown => "<span class=\"mark\">✓</span>",
        Seen::NotShown => "<span class=\"mark\">✗</span>",
        Seen::NotApplicable => "<span class=\"mark\">–</span>",
        Seen::NotRun => "<span class=\"mark\">?</span>",
        Seen::NotProven => "<span class=\"mark\">○</span>",
    }
}

/// A sentence from a clause.
fn capital(clause: &str) -> String {
    let mut letters = clause.chars();
    letters.next().map_or(String::new(), |first| first.to_uppercase().chain(letters).collect())
}

pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
