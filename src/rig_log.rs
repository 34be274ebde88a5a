//! Logs of rigs: opened, with the rig compiled from the texts in them; and as a table, for `data` of experiments.
//!
//! In: the path of a log. Out: a reader with the rig that wrote it, or columns with units as CSV text. Knows no terminal.

use crate::compile::{self, Changes, CompiledRig, Loaded, Options};
use crate::source_snapshot::Kept;
use abi::unit::Unit;
use grammar::diagnostic::Diagnostic;
use panel::follow;
use runtime::hil::control::Control;
use runtime::hil::trace::{self, Cycle, Shape};
use runtime::hil::words;
use runtime::record::log::Reader;
use std::path::Path;

/// A log, and the rig that wrote it.
pub struct Opened {
    pub reader: Reader,
    pub ready: CompiledRig,
    /// All that a cycle computes, as it was before the first one.
    pub control: Control,
}

/// Why a log cannot be opened.
pub struct Refused {
    /// In words.
    pub why: String,
    /// What is wrong with the texts in it, if that is the reason.
    pub texts: Option<(Box<Loaded>, Vec<Diagnostic>)>,
}

impl From<&str> for Refused {
    fn from(why: &str) -> Refused {
        String::from(why).into()
    }
}

impl From<String> for Refused {
    fn from(why: String) -> Refused {
        Refused { why, texts: None }
    }
}

/// Opens a log.
///
/// # Errors
/// Why not.
pub fn open(path: &Path, interpret: bool) -> Result<Opened, Refused> {
    let reader = Reader::open(path)?;
    let head = reader.head.clone();
    let needed = ["rig", "file", "source", "set"].map(|section| head.text(section));
    let [Some(rig), Some(file), Some(source), Some(set)] = needed else {
        return Err("its head lacks the text of the rig".into());
    };
    let kept = Kept(&head);
    let broken = |loaded: Loaded, found| {
        let texts = Some((Box::new(loaded), found));
        Refused { why: "the rig in it does not compile".into(), texts }
    };
    let mut loaded = compile::load(file, source, &kept);
    if loaded.diagnostics.iter().any(Diagnostic::is_error) {
        let found = loaded.diagnostics.clone();
        return Err(broken(loaded, found));
    }
    let changes = Changes { set: set.lines().map(str::to_string).collect(), ..Changes::default() };
    let options = Options { changes, interpret };
    let ready = match compile::rig(&mut loaded, &kept, rig, &options, &mut Vec::new()) {
        Ok(ready) => ready,
        Err(found) => return Err(broken(loaded, found)),
    };
    let control = follow::control(&head, &ready.rig, &ready.control, &ready.plant)?;
    Ok(Opened { reader, ready, control })
}

/// Most bytes of a log as a table in memory.
const MOST_BYTES: usize = 256 << 20;

/// The cycles of a log as CSV text: `t`, the readings of sensors and drives, what was requested and permitted of each
/// output, and the quantities under `record`, each with its unit.
///
/// # Errors
/// Why not, in words.
pub fn table(path: &Path) -> Result<String, String> {
    let Opened { mut reader, ready, control } = open(path, true).map_err(|refused| refused.why)?;
    let rig = &ready.rig;
    let mut headings: Vec<(String, Unit)> = vec![("t".into(), Unit::parse("s").expect("the second is known"))];
    headings.extend(control.signals().map(|signal| (words::signal(rig, signal), words::unit(rig, signal))));
    for output in &rig.outputs {
        let (name, unit) = (words::signal(rig, output.signal), words::unit(rig, output.signal));
        headings.extend(["requested", "permitted"].map(|word| (format!("{name} {word}"), unit.clone())));
    }
    headings.extend(rig.record.iter().map(|series| (series.label.clone(), series.unit.clone())));
    // A recorded quantity may be a reading: of one name, the first.
    let first = |i: usize| headings[..i].iter().all(|(name, _)| *name != headings[i].0);
    let shown: Vec<bool> = (0..headings.len()).map(first).collect();
    let mut out = String::new();
    let mut line = |cells: &mut dyn Iterator<Item = String>| {
        let cells: Vec<String> = cells.zip(&shown).filter(|(_, shown)| **shown).map(|(cell, _)| cell).collect();
        out.push_str(&cells.join(";"));
        out.push('\n');
        out.len()
    };
    line(&mut headings.iter().map(|(name, unit)| match unit.text.is_empty() {
        true => name.clone(),
        false => format!("{name} [{unit}]"),
    }));
    let shape = Shape::of(rig, &control);
    while let Some(message) = reader.message().map_err(|error| error.to_string())? {
        if message.kind != trace::CYCLE {
            continue;
        }
        let Some(cycle) = Cycle::read(shape, &message.words) else {
            return Err("it holds a cycle that is not of its rig".into());
        };
        let mut row = vec![cycle.due_ns as f64 * 1e-9];
        row.extend(cycle.readings.iter().map(|reading| reading.value));
        row.extend(cycle.requests.iter().zip(&cycle.permitted).flat_map(|(asked, permitted)| [*asked, *permitted]));
        row.extend(rig.record.iter().zip(&cycle.recorded).map(|(series, si)| series.unit.from_si(*si)));
        if line(&mut row.iter().map(|value| format!("{value:?}"))) > MOST_BYTES {
            let log = path.display();
            return Err(format!(
                "its table is larger than {} MB: `fric replay {log} --csv log.csv` writes it to cut out \
                a part",
                MOST_BYTES >> 20
            ));
        }
    }
    reader.ending("it").map(|_| out)
}
