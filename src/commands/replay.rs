//! `fric replay`: recomputes a rig's log, and exports it.

use super::End;
use crate::args::Replay as Args;
use crate::commands::shared::rig_log::{self, Opened};
use crate::parquet::{self, Holds};
use crate::terminal::Terminal;
use crate::{project, quantity};
use abi::rig::Rig;
use abi::{Description, Slot};
use runtime::hil::control::Control;
use runtime::hil::origin::Origin;
use runtime::hil::replay::{Replay, Stopped, What};
use runtime::hil::trace::{self, Cycle, Passed, Shape};
use runtime::hil::words;
use runtime::record::log::Message;
use std::fmt::Write;
use std::path::Path;

pub fn replay(args: &Args, terminal: &mut Terminal) -> End {
    let name = args.log.display().to_string();
    let fail = |terminal: &mut Terminal, why: &str| {
        terminal.error(&format!("{name}: {why}"));
        End::Failed
    };
    let Opened { mut reader, ready, control } = match rig_log::open(&args.log, args.interpret, terminal) {
        Ok(opened) => opened,
        Err(why) => return fail(terminal, &why),
    };
    let rig = &ready.rig.name;
    let mut exports = Exports::new(args, &ready.rig, &control);
    let mut replay = Replay::new(&ready.rig, control);
    let (mut stopped, mut marks) = (None, Vec::new());
    let mut changes: Vec<String> = Vec::new();
    loop {
        let message = match reader.message() {
            Ok(Some(message)) => message,
            Ok(None) => break,
            Err(error) => return fail(terminal, &error.to_string()),
        };
        exports.hear(&message);
        if let (trace::MARK, Some((due_ns, words))) = (message.kind, trace::read_mark(&message.words)) {
            marks.push(format!("  mark at {:.3} s: {words}{}", due_ns as f64 * 1e-9, exports.by(due_ns, "mark")));
        }
        if let (trace::COMMAND, Some((due_ns, name @ ("enable" | "arm" | "stop"), origin))) =
            (message.kind, trace::read_command(&message.words))
        {
            marks.push(format!("  {name} at {:.3} s, by {origin}", due_ns as f64 * 1e-9));
        }
        if stopped.is_none() {
            stopped = replay.message(&message).err();
        }
        let time = replay.model_time().filter(|_| stopped.is_none());
        exports.add(&message, time);
        changes.extend(exports.changes(&message, time, replay.model().description()));
    }
    if let Err(why) = exports.write(args, terminal) {
        return fail(terminal, &why);
    }
    // A log may continue in further files; the end to report is that of the last file read.
    let last = if reader.path() == args.log { "it".into() } else { reader.path().display().to_string() };
    let ends = match reader.ending(&last) {
        Ok(ends) => ends,
        Err(why) => return fail(terminal, &why),
    };
    let found = replay.found();
    match stopped {
        Some(Stopped::Unreadable { k }) => fail(terminal, &format!("what it holds of cycle {k} is not of this rig")),
        Some(Stopped::Differs(difference)) => {
            let what = differing(&ready.rig, difference.what);
            let (recorded, computed) = (difference.recorded, difference.computed);
            fail(
                terminal,
                &format!(
                    "cycle {}: {what} was {recorded:?} and is {computed:?} now, {} cycles before agree",
                    difference.k,
                    quantity::count(found.cycles - 1)
                ),
            )
        }
        None if found.cycles == 0 => fail(terminal, "it holds no cycle that can be computed"),
        None => {
            terminal.line(&format!(
                "{rig}: {} cycles and {} states agree to the bit; {ends}",
                quantity::count(found.cycles),
                quantity::count(found.states)
            ));
            marks.iter().for_each(|mark| terminal.line(mark));
            for change in changes.iter().take(MOST_CHANGES) {
                terminal.line(&format!("  {change}"));
            }
            if changes.len() > MOST_CHANGES {
                terminal.line(&format!("  and {} further changes", changes.len() - MOST_CHANGES));
            }
            if found.skipped + found.lost > 0 {
                terminal.line(&format!(
                    "  {} messages were lost when it was written; {} cycles could not be computed",
                    quantity::count(found.lost),
                    quantity::count(found.skipped)
                ));
            }
            End::Fine
        }
    }
}

/// Most changes of parameters that are listed.
const MOST_CHANGES: usize = 50;

/// Describes a number of a cycle that differs.
fn differing(rig: &Rig, what: What) -> String {
    let output = |i: usize| words::signal(rig, rig.outputs[i].signal);
    match what {
        What::Request(i) => format!("the request for {}", output(i)),
        What::Permitted(i) => format!("what was permitted of {}", output(i)),
        What::Clamps(i) => format!("why {} was clamped", output(i)),
        What::Order => "what the drives were told".into(),
        What::Recorded(i) => format!("`{}`", rig.record[i].label),
        What::State => "the state of model and safety".into(),
    }
}

/// Tables made of a log.
struct Exports {
    rig: Rig,
    shape: Shape,
    columns: Vec<(String, Holds)>,
    /// Its cycles, if a table of them is requested.
    cycles: Option<String>,
    candump: Option<String>,
    /// Commands since the last cycle: when, their names, and who gave them.
    said: Vec<(u64, &'static str, Origin)>,
}

impl Exports {
    fn new(args: &Args, rig: &Rig, control: &Control) -> Exports {
        let mut columns = Vec::new();
        let mut column = |name: String, holds| columns.push((name.replace(',', ";"), holds));
        for (name, holds) in [
            ("k", Holds::Integers),
            ("t [s]", Holds::Numbers),
            ("model t [s]", Holds::Numbers),
            ("late [s]", Holds::Numbers),
            ("ticks", Holds::Integers),
            ("order", Holds::Words),
        ] {
            column(name.into(), holds);
        }
        for signal in control.signals() {
            let name = words::signal(rig, signal);
            column(name.clone(), Holds::Numbers);
            column(format!("{name} age"), Holds::Integers);
        }
        for output in &rig.outputs {
            let name = words::signal(rig, output.signal);
            column(format!("{name} requested"), Holds::Numbers);
            column(format!("{name} permitted"), Holds::Numbers);
            column(format!("{name} clamped"), Holds::Integers);
        }
        for series in &rig.record {
            let unit = if series.unit.text.is_empty() { String::new() } else { format!(" [{}]", series.unit) };
            column(format!("{}{unit}", series.label), Holds::Numbers);
        }
        // At the end, where it moves no other column.
        column("commands".into(), Holds::Words);
        let names: Vec<&str> = columns.iter().map(|(name, _)| name.as_str()).collect();
        let cycles = (args.csv.is_some() || args.parquet.is_some()).then(|| names.join(",") + "\n");
        let candump = args.candump.as_ref().map(|_| String::new());
        Exports { rig: rig.clone(), shape: Shape::of(rig, control), columns, cycles, candump, said: Vec::new() }
    }

    /// Notes who gave a command.
    fn hear(&mut self, message: &Message) {
        if let (trace::COMMAND, Some(said)) = (message.kind, trace::read_command(&message.words)) {
            // More than a cycle can have are of cycles that were lost.
            if self.said.len() == 256 {
                self.said.remove(0);
            }
            self.said.push(said);
        }
    }

    /// Who gave this command at this time, as the end of a sentence; empty where the log does not say.
    fn by(&self, due_ns: u64, name: &str) -> String {
        let found = self.said.iter().find(|(then_ns, said, _)| (*then_ns, *said) == (due_ns, name));
        found.map_or(String::new(), |(_, _, origin)| format!(", by {origin}"))
    }

    /// Parameters that a cycle changed, in words. `time`: that of the model, in s.
    fn changes(&self, message: &Message, time: Option<f64>, model: &Description) -> Vec<String> {
        let cycle = (message.kind == trace::CYCLE).then(|| Cycle::read(self.shape, &message.words)).flatten();
        let Some(cycle) = cycle else { return Vec::new() };
        let when = match time {
            Some(time) => format!("in cycle {}, at {} of the model", cycle.k, quantity::duration(time, 4)),
            None => format!("in cycle {}, when the model did not run", cycle.k),
        };
        let words = |(slot, si): &(Slot, f64)| {
            let found = model.quantities.iter().find(|quantity| quantity.slot == *slot)?;
            let value = abi::format::quantity(*si, &found.unit, 6);
            Some(format!("set {} = {value} {when}{}", found.path, self.by(cycle.due_ns, "set")))
        };
        cycle.set.iter().filter_map(words).collect()
    }

    /// Adds a message; `time`: that of the model after it, in s.
    fn add(&mut self, message: &Message, time: Option<f64>) {
        if let (Some(rows), trace::CYCLE) = (&mut self.cycles, message.kind)
            && let Some(cycle) = Cycle::read(self.shape, &message.words)
        {
            let Cycle { k, due_ns, late_ns, ticks, order, .. } = cycle;
            let (due, late) = (due_ns as f64 * 1e-9, f64::from(late_ns) * 1e-9);
            let _ = write!(rows, "{k},{due:?},{:?},{late:?},{ticks},{order:?}", time.unwrap_or(f64::NAN));
            for reading in &cycle.readings {
                let _ = write!(rows, ",{:?},{}", reading.value, reading.age);
            }
            for i in 0..self.rig.outputs.len() {
                let _ = write!(rows, ",{:?},{:?},{}", cycle.requests[i], cycle.permitted[i], cycle.clamps[i].0);
            }
            for (series, si) in self.rig.record.iter().zip(&cycle.recorded) {
                let _ = write!(rows, ",{:?}", series.unit.from_si(*si));
            }
            let own = self.said.iter().filter(|(then_ns, ..)| *then_ns == due_ns);
            let own: Vec<String> = own.map(|(_, name, origin)| format!("{name} by {origin}")).collect();
            let _ = write!(rows, ",{}", own.join("; "));
            rows.push('\n');
        }
        if let (Some(candump), trace::FRAMES) = (&mut self.candump, message.kind) {
            for Passed { stamp_ns, bus, frame, .. } in Passed::read(&message.words).into_iter().flatten() {
                let name = self.rig.buses.get(usize::from(bus)).map_or("can", |bus| &bus.name);
                let (seconds, micros) = (stamp_ns / 1_000_000_000, stamp_ns % 1_000_000_000 / 1000);
                let _ = writeln!(candump, "({seconds:010}.{micros:06}) {name} {frame}");
            }
        }
    }

    fn write(&self, args: &Args, terminal: &mut Terminal) -> Result<(), String> {
        let mut save = |path: &Path, bytes: &[u8]| {
            project::write(path, bytes).map_err(|error| format!("cannot write {}: {error}", path.display()))?;
            terminal.line(&format!("wrote {}", path.display()));
            Ok::<(), String>(())
        };
        if let (Some(path), Some(rows)) = (&args.csv, &self.cycles) {
            save(path, rows.as_bytes())?;
        }
        if let (Some(path), Some(rows)) = (&args.parquet, &self.cycles) {
            let mut bytes = Vec::new();
            parquet::from_csv(rows.as_bytes(), true, &self.columns, &mut bytes)
                .map_err(|error| format!("cannot write {}: {error}", path.display()))?;
            save(path, &bytes)?;
        }
        if let (Some(path), Some(frames)) = (&args.candump, &self.candump) {
            save(path, frames.as_bytes())?;
        }
        Ok(())
    }
}
