//! Statistics of generated programs and their results: they show if a generator degenerates.
//!
//! Counts by name, so that they can be added, and stored in a file.

use crate::back_ends::Agreed;
use crate::case::Case;
use compiler::ir::Op;
use std::collections::BTreeMap;

/// Counts by name; the text before `/` is a group. Each length is counted separately (`length/000083`), so that
/// quantiles of a sum are exact.
#[derive(Clone, Default, PartialEq, Eq, Debug)]
pub struct Distribution(BTreeMap<String, u64>);

impl Distribution {
    /// Adds `n` to a count.
    pub fn add(&mut self, name: &str, n: usize) {
        match self.0.get_mut(name) {
            Some(count) => *count += n as u64,
            None => drop(self.0.insert(name.to_string(), n as u64)),
        }
    }

    /// How often.
    pub fn count(&self, name: &str) -> u64 {
        self.0.get(name).copied().unwrap_or(0)
    }

    /// Names and counts of a group, the most frequent first.
    pub fn group<'a>(&'a self, group: &str) -> Vec<(&'a str, u64)> {
        let inside = |(name, count): (&'a String, &'a u64)| {
            name.split_once('/').filter(|(own, _)| *own == group).map(|(_, rest)| (rest, *count))
        };
        let mut found: Vec<(&str, u64)> = self.0.iter().filter_map(inside).collect();
        found.sort_by_key(|(name, count)| (std::cmp::Reverse(*count), *name));
        found
    }

    /// One line each: `COUNT NAME`.
    pub fn to_lines(&self) -> String {
        self.0.iter().map(|(name, count)| format!("{count} {name}\n")).collect()
    }

    /// None if the lines were not written by [`Distribution::to_lines`].
    pub fn from_lines<'t>(lines: impl Iterator<Item = &'t str>) -> Option<Distribution> {
        let one = |line: &str| {
            let (count, name) = line.split_once(' ')?;
            Some((name.to_string(), count.parse().ok()?))
        };
        Some(Distribution(lines.map(one).collect::<Option<_>>()?))
    }

    /// Counts a case and the common result of its back ends.
    pub fn see(&mut self, case: &Case, agreed: &Agreed) {
        self.add("programs", 1);
        for mark in &case.marks {
            self.add(mark, 1);
        }
        for width in &agreed.lanes {
            self.add(&format!("lanes/{width}"), 1);
        }
        for (function, func) in &case.functions {
            self.add(&format!("function/{}", function.name()), 1);
            self.add(&format!("length/{:06}", func.ops.len()), 1);
            for op in &func.ops {
                self.add(kind(*op), 1);
            }
        }
        let mut changed = 0;
        for ((status, block), run) in agreed.results.iter().zip(&case.runs) {
            self.add("runs", 1);
            self.add("runs stopped", usize::from(*status != 0));
            changed += usize::from(block.iter().zip(&run.start).any(|(a, b)| a.to_bits() != b.to_bits()));
            let count = |of: fn(&f64) -> bool| block.iter().filter(|x| of(x)).count();
            self.add("values", block.len());
            self.add("value/zero", count(|x| *x == 0.0));
            self.add("value/NaN", count(|x| x.is_nan()));
            self.add("value/infinite", count(|x| x.is_infinite()));
            self.add("value/subnormal", count(|x| x.is_subnormal()));
        }
        self.add("runs that change something", changed);
        // A program whose runs all end alike does not depend on its inputs.
        let distinct = |a: &[f64], b: &[f64]| a.iter().zip(b).any(|(a, b)| a.to_bits() != b.to_bits());
        self.add(
            "programs with distinct results",
            usize::from(agreed.results.windows(2).any(|two| distinct(&two[0].1, &two[1].1))),
        );
    }

    /// The report, in words.
    pub fn told(&self, what: &str) -> String {
        let share = |n: u64, of: u64| format!("{:.1} %", 100.0 * n as f64 / of.max(1) as f64);
        let shares = |group: &str, of: u64| {
            let all: Vec<String> =
                self.group(group).iter().map(|(name, n)| format!("{name} {}", share(*n, of))).collect();
            all.join(", ")
        };
        let (programs, runs) = (self.count("programs"), self.count("runs"));
        let mut out = format!("{what}: {programs} programs, {runs} runs, equal on every back end\n");
        let mut line = |name: &str, text: String| {
            if !text.is_empty() {
                out += &format!("  {name}: {text}\n");
            }
        };
        let (seeds, kept) = (self.count("seeds"), self.count("seeds kept"));
        if seeds > 0 {
            let others = or_none(shares("fell", seeds));
            line("seeds", format!("{seeds}, of which {} gave programs; the others: {others}", share(kept, seeds)));
        }
        line("changed by", shares("mutation", kept));
        if let of @ [most, .., least] = &self.group("of")[..] {
            let [most, least] = [most, least].map(|(name, n)| format!("{name} {}", share(*n, kept)));
            line("of", format!("{} texts, from {least} to {most}", of.len()));
        }
        line("methods", shares("method", programs));
        line("programs with", shares("with", programs));
        line("elementary functions, of programs", shares("elementary", programs));
        line("lanes, of programs", or_none(shares("lanes", programs)));
        line(
            "functions",
            self.group("function").iter().map(|(name, n)| format!("{n} {name}")).collect::<Vec<_>>().join(", "),
        );
        let (median, most, largest) = (self.length(0.5), self.length(0.95), self.length(1.0));
        line("operations a function", format!("median {median}, 95 % {most}, most {largest}"));
        line("operations", shares("operation", self.group("operation").iter().map(|(_, n)| n).sum()));
        let changed = share(self.count("runs that change something"), runs);
        let distinct = share(self.count("programs with distinct results"), programs);
        let stopped = share(self.count("runs stopped"), runs);
        line(
            "runs",
            format!(
                "{changed} change something, {stopped} end with a status; {distinct} of programs end differently from different blocks"
            ),
        );
        line("values", shares("value", self.count("values")));
        out
    }

    /// The length that this fraction of all functions does not exceed.
    fn length(&self, part: f64) -> u64 {
        let mut lengths: Vec<(u64, u64)> =
            self.group("length").iter().map(|(name, n)| (name.parse().expect("a number"), *n)).collect();
        lengths.sort_unstable();
        let total: u64 = lengths.iter().map(|(_, n)| n).sum();
        let mut left = (total.saturating_sub(1) as f64 * part) as u64;
        for (length, n) in lengths {
            if left < n {
                return length;
            }
            left -= n;
        }
        0
    }
}

fn or_none(text: String) -> String {
    if text.is_empty() { "none".into() } else { text }
}

fn kind(op: Op) -> &'static str {
    match op {
        Op::Real(_) | Op::Int(_) | Op::Bool(_) => "operation/constant",
        Op::Load(_) => "operation/load",
        Op::Pool { .. } => "operation/table",
        Op::Ring { .. } => "operation/ring",
        Op::Add(..) | Op::Sub(..) => "operation/sum",
        Op::Mul(..) => "operation/product",
        Op::Div(..) => "operation/quotient",
        Op::Neg(_) | Op::Abs(_) => "operation/sign",
        Op::Sqrt(_) => "operation/root",
        Op::Fma(..) => "operation/fma",
        Op::Floor(_) | Op::Nearest(_) => "operation/rounding",
        Op::Unary(..) | Op::Binary(..) => "operation/elementary",
        Op::Less(..) | Op::LessEqual(..) | Op::Equal(..) => "operation/comparison",
        Op::And(..) | Op::Or(..) | Op::Not(_) => "operation/logic",
        Op::Select(..) => "operation/select",
        Op::IntAdd(..) | Op::IntSub(..) | Op::IntMul(..) | Op::IntAnd(..) | Op::IntOr(..) | Op::IntXor(..) => {
            "operation/integer"
        }
        Op::ShiftLeft(..) | Op::ShiftRight(..) | Op::ShiftRightSigned(..) => "operation/shift",
        Op::IntLess(..) | Op::IntEqual(..) => "operation/integer comparison",
        Op::ToBits(_) | Op::FromBits(_) | Op::ToInt(_) | Op::ToReal(_) => "operation/conversion",
    }
}
