//! TO BE DELETED: stands in for the compiler until it is there. Every experiment runs the same stick-slip model.

use abi::description::{Description, Kind, Layout, Quantity, Slot};
use abi::plan::{Expect, Experiment, Formula, Measure, MeasureKind, Method, Plot, Series, Solver};
use abi::table::Interpret;
use abi::unit::Unit;
use abi::{Code, Function, Instance};
use grammar::ast::{ExperimentStatement, File, ImportSource, Item};
use grammar::diagnostic::Diagnostic;
use grammar::span::{FileId, Span};
use std::sync::Arc;

pub struct SourceFile {
    pub name: String,
    pub text: Arc<str>,
}

pub trait Sources {
    fn import(&self, from: &str, what: &ImportSource) -> Result<(String, String), String>;
}

pub struct Loaded {
    pub files: Vec<SourceFile>,
    pub diagnostics: Vec<Diagnostic>,
    tree: File,
}

pub struct ExperimentInfo {
    pub name: String,
    pub span: Span,
    pub has_expect: bool,
}

#[derive(Default)]
pub struct Options {
    pub set: Vec<(String, String)>,
    pub method: Option<Method>,
    pub step: Option<f64>,
    pub tol: Option<f64>,
    pub duration: Option<f64>,
    pub interpret: bool,
}

pub struct Case {
    pub label: String,
    pub instance: Instance,
    pub experiment: Experiment,
    pub notes: Vec<String>,
}

pub fn load(name: &str, text: String, sources: &dyn Sources) -> Loaded {
    let mut parsed = grammar::parse::parse(FileId(0), &text);
    for item in &parsed.file.items {
        if let Item::Import(import) = item
            && let Err(reason) = sources.import(name, &import.source)
        {
            parsed.diagnostics.push(Diagnostic::error("E0201", reason).label(import.span, ""));
        }
    }
    let files = vec![SourceFile { name: name.into(), text: text.into() }];
    Loaded { files, diagnostics: parsed.diagnostics, tree: parsed.file }
}

impl Loaded {
    pub fn experiments(&self) -> Vec<ExperimentInfo> {
        let experiment = |item: &Item| match item {
            Item::Experiment(experiment) => Some(ExperimentInfo {
                name: experiment.name.text.clone(),
                span: experiment.span,
                has_expect: experiment.body.iter().any(|s| matches!(s, ExperimentStatement::Expect(_))),
            }),
            _ => None,
        };
        self.tree.items.iter().filter_map(experiment).collect()
    }
}

pub fn check(_: &Loaded) -> Vec<Diagnostic> {
    Vec::new()
}

pub fn format(text: &str, _width: usize) -> String {
    let lines: Vec<&str> = text.lines().map(str::trim_end).collect();
    format!("{}\n", lines.join("\n").trim_end())
}

pub fn compile(
    _: &Loaded,
    experiment: &str,
    options: &Options,
    on_stage: &mut dyn FnMut(&'static str),
) -> Result<Vec<Case>, Vec<Diagnostic>> {
    on_stage("flatten");
    on_stage("machine code");
    let unit = |text: &str| Unit::parse(text).unwrap();
    let quantity = |path: &str, kind, text: &str, slot: u32, boolean| Quantity {
        path: path.into(),
        kind,
        unit: unit(text),
        boolean,
        slot: Slot(slot),
        range: (f64::NEG_INFINITY, f64::INFINITY),
        doc: None,
    };
    let layout = Layout::new([1, 0, 3, 0, 0, 4, 3, 0, 0, 0]);
    let description = Arc::new(Description {
        name: "Pull(k = 2 N/m)".into(),
        quantities: vec![
            quantity("k", Kind::Param, "N/m", 3, false),
            quantity("body.x", Kind::State, "m", 4, false),
            quantity("body.v", Kind::State, "mm/s", 5, false),
            quantity("fr.z", Kind::State, "um", 6, false),
            quantity("x", Kind::Output, "m", 7, false),
            quantity("pulled", Kind::Output, "m", 8, false),
            quantity("fr.F", Kind::Output, "N", 9, false),
            quantity("fr.stick", Kind::Output, "1", 10, true),
        ],
        layout,
        ..Description::default()
    });
    let series = |label: &str, text: &str, slot: u32, boolean| Series {
        label: label.into(),
        slot: Slot(slot),
        unit: unit(text),
        boolean,
    };
    let solver = Solver { method: options.method.unwrap_or(Method::Rk4), step: options.step.unwrap_or(1e-5), tol: 0.0 };
    let limit = if experiment.contains("fail") { 1.2 } else { 1.6 };
    let plan = Experiment {
        name: experiment.into(),
        duration: options.duration.unwrap_or(20.0),
        solver,
        plots: vec![
            Plot {
                series: vec![
                    series("x", "m", 7, false),
                    series("pulled", "m", 8, false),
                    series("fr.stick", "1", 10, true),
                ],
                against: None,
            },
            Plot { series: vec![series("fr.F", "N", 9, false)], against: Some(series("body.v", "mm/s", 5, false)) },
        ],
        expects: vec![
            Expect {
                text: format!("max(fr.F) < {limit} N"),
                measures: vec![Measure {
                    text: "max(fr.F)".into(),
                    kind: MeasureKind::Max,
                    slot: Slot(9),
                    unit: unit("N"),
                }],
                condition: Formula::Less(Box::new(Formula::Measure(0)), Box::new(Formula::Number(limit))),
                after: 0.0,
                before: f64::INFINITY,
            },
            Expect {
                text: "period(body.v) ~= 6.36 s +- 1 %".into(),
                measures: vec![Measure {
                    text: "period(body.v)".into(),
                    kind: MeasureKind::Period,
                    slot: Slot(5),
                    unit: unit("s"),
                }],
                condition: Formula::Near {
                    value: Box::new(Formula::Measure(0)),
                    target: Box::new(Formula::Number(6.36)),
                    tolerance: Box::new(Formula::Number(0.01)),
                    relative: true,
                },
                after: 0.0,
                before: f64::INFINITY,
            },
        ],
        corners: vec![],
    };
    let stiffness: Vec<f64> = if experiment.contains("sweep") { vec![2.0, 4.0, 8.0] } else { vec![2.0] };
    let several = stiffness.len() > 1;
    Ok(stiffness
        .into_iter()
        .map(|k| Case {
            label: if several { format!("k = {k} N/m") } else { String::new() },
            instance: Instance::new(description.clone(), Code::Interpreted(Arc::new(Pull)), &[k]),
            experiment: plan.clone(),
            notes: vec!["this is the stand-in for the compiler".into()],
        })
        .collect())
}

struct Pull;

impl Pull {
    fn slopes(t: f64, k: f64, [x, v, z]: [f64; 3]) -> ([f64; 3], f64) {
        let g = 1.0 + 0.5 * (-(v / 1e-3) * (v / 1e-3)).exp();
        let dz = v - 1e5 * v.abs() / g * z;
        let f = 1e5 * z + 316.2278 * dz + 0.4 * v;
        ([v, k * (0.1 * t - x) - f, dz], f)
    }
}

impl Interpret for Pull {
    fn call(&self, function: Function, block: &mut [f64], _: &[f64], count: u64) -> u64 {
        match function {
            Function::Start => block[4..7].fill(0.0),
            Function::Step => {
                for _ in 0..count {
                    let (h, k) = (block[1], block[3]);
                    let t = block[2] * h;
                    let at = |s: &[f64]| [s[4], s[5], s[6]];
                    let x = at(block);
                    let add = |x: [f64; 3], d: [f64; 3], h: f64| std::array::from_fn(|i| x[i] + h * d[i]);
                    let (a, _) = Pull::slopes(t, k, x);
                    let (b, _) = Pull::slopes(t + h / 2.0, k, add(x, a, h / 2.0));
                    let (c, _) = Pull::slopes(t + h / 2.0, k, add(x, b, h / 2.0));
                    let (d, _) = Pull::slopes(t + h, k, add(x, c, h));
                    for i in 0..3 {
                        block[4 + i] += h / 6.0 * (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i]);
                    }
                    block[2] += 1.0;
                    block[0] = block[2] * h;
                    self.call(Function::Outputs, block, &[], 1);
                }
            }
            _ => {
                let (_, f) = Pull::slopes(block[0], block[3], [block[4], block[5], block[6]]);
                block[7] = block[4];
                block[8] = 0.1 * block[0];
                block[9] = f;
                block[10] = f64::from(block[5].abs() < 1e-3);
            }
        }
        0
    }

    fn has(&self, function: Function) -> bool {
        matches!(function, Function::Start | Function::Outputs | Function::Step)
    }
}
