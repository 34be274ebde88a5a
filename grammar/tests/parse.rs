//! What a text becomes, and what is said about a wrong one.

use grammar::ast::*;
use grammar::diagnostic::Diagnostic;
use grammar::parse::{Parsed, parse, parse_expr, parse_instance, parse_path, parse_setting};
use grammar::span::FileId;

const SAMPLES: [(&str, &str); 11] = [
    ("00", include_str!("data/00_interfaces.fric")),
    ("01", include_str!("data/01_tustin.fric")),
    ("02", include_str!("data/02_kfm.fric")),
    ("03", include_str!("data/03_karnopp.fric")),
    ("04", include_str!("data/04_bliman_sorine.fric")),
    ("05", include_str!("data/05_lugre.fric")),
    ("06", include_str!("data/06_lugre_observer.fric")),
    ("07", include_str!("data/07_pid.fric")),
    ("08", include_str!("data/08_servo_sil.fric")),
    ("09", include_str!("data/09_rig_hil.fric")),
    ("10", include_str!("data/10_gms.fric")),
];

/// Reads `text`; every label must lie inside it.
fn read(text: &str) -> Parsed {
    let parsed = parse(FileId(0), text);
    for diagnostic in &parsed.diagnostics {
        assert!(!diagnostic.labels.is_empty(), "{diagnostic:?}");
        for label in &diagnostic.labels {
            assert!(text.get(label.span.range()).is_some(), "{diagnostic:?} in {text:?}");
        }
    }
    parsed
}

/// One line for each diagnostic: code, the marked text, message, first label, help.
fn say(text: &str, diagnostics: &[Diagnostic]) -> Vec<String> {
    diagnostics
        .iter()
        .map(|d| {
            let help = d.help.as_deref().map_or(String::new(), |help| format!(" | {}", help.replace('\n', " / ")));
            format!("{} `{}` {} ({}){help}", d.code, &text[d.span().range()], d.message, d.labels[0].text)
        })
        .collect()
}

#[track_caller]
fn says(text: &str, wanted: &[&str]) {
    assert_eq!(say(text, &read(text).diagnostics), wanted, "\n{text}");
}

/// Says it in the body of a model that declares a few names.
#[track_caller]
fn model_says(body: &str, wanted: &[&str]) {
    says(&format!("model M {{\n  state z [m] = 0 m\n  param k = 1\n{body}\n  let last = 1\n}}\n"), wanted);
}

#[test]
fn samples_are_read_without_complaint() {
    for (name, text) in SAMPLES {
        says(text, &[]);
        assert!(!read(text).file.items.is_empty(), "{name}");
    }
}
