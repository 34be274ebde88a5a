//! Changing parameters of a rig during a run, compared with a start with the same values: random rigs, random sets.
//!
//! `FRIC_RUNS`: how many rigs; `FRIC_SEED`: one of them. A failure prints the seed, the text and the smallest failing
//! set.

mod support;

use abi::description::Slot;
use abi::live::Tunable;
use compiler::{Changes, CompiledRig, Loaded, NoSources, Options};
use runtime::hil::line::assignments;
use runtime::hil::live::{Judge, Objection, TOLD};
use runtime::rng::Chance;

/// A rig whose friction has random parameters, some computed from others.
fn text(chance: &mut Chance) -> String {
    let mut params = String::new();
    let mut names: Vec<String> = Vec::new();
    let value = |chance: &mut Chance| [0.1, 0.2, 0.25, 0.3, 0.5, 1.0][chance.below(6) as usize];
    for k in 0..2 + chance.below(4) {
        let name = format!("p{k}");
        let other = |chance: &mut Chance| names[chance.below(names.len() as u64) as usize].clone();
        let dependent = !names.is_empty() && chance.below(3) == 0;
        let given = match dependent {
            true => format!("{} * {}", [0.5, 1.0, 1.5][chance.below(3) as usize], other(chance)),
            false => format!("{} N", value(chance)),
        };
        let bound = |chance: &mut Chance| match names.is_empty() || chance.below(3) > 0 {
            true => format!("{} N", 2.0 * value(chance)),
            false => format!("{} * {}", [1.0, 2.0, 4.0][chance.below(3) as usize], other(chance)),
        };
        let range = match chance.below(6) {
            0 => String::new(),
            1 => "in > 0".into(),
            2 => "in >= 0".into(),
            3 => format!("in < {}", bound(chance)),
            4 => format!("in 0 N .. {}", bound(chance)),
            _ => format!("in {} .. 4 N", [0.0, 0.05, 0.1][chance.below(3) as usize]).replace(" .. ", " N .. "),
        };
        params += &format!("  param {name} = {given} {range}\n");
        names.push(name);
    }
    let any = |chance: &mut Chance| names[chance.below(names.len() as u64) as usize].clone();
    let mut more = String::new();
    for _ in 0..chance.below(3) {
        let (a, b) = (any(chance), any(chance));
        more += &match chance.below(3) {
            0 => format!("  require {a} >= 0.5 * {b}\n"),
            1 => format!("  require {a} + {b} < 3 N, \"too strong\"\n"),
            _ => format!("  require {a} < 2 N or {b} > 0.2 N\n"),
        };
    }
    let sum = names.join(" + ");
    let watched = if chance.below(3) == 0 { format!("in -9 N .. 9 * {}", any(chance)) } else { String::new() };
    let limit = if chance.below(3) == 0 { "most" } else { "1 N·m" };
    let solver = ["", "  solver euler\n", "  solver rk4 step 0.5 ms\n"][chance.below(3) as usize];
    let (start, lamp) = (any(chance), [0.0, 1.0, 7.0][chance.below(3) as usize]);
    format!(
        "model Rub {{
  input v [m/s]
{params}{more}  param vs = 10 mm/s in > 0
  param Ts = 1 ms in > 0
  param n = 2 in 1 .. 5
  param gain = 1 in 0 .. 2
  param k = 1 N·s/m in >= 0
  param tau = 1 s in > 0
  state z [N] = 0.1 * {start} in -100 N .. 100 N
  dz/dt = ({sum}) * v / vs / 1 s - z / tau
  part q[i in 1 .. n] = Bit(v = v)
  every Ts {{ state held [m/s] = 0\n next(held) = v }}
  output F [N] {watched} = gain * tanh(v / vs) * ({sum}) + z + q[1].F + k * held * n * Ts / 1 ms
}}
model Bit {{ input v [m/s]\n param c = 1 N·s/m in >= 0\n output F [N] = c * v }}
model Body {{
  input F [N]
  param m = 0.01 kg in > 0
  state x [m] = 0
  state v [m/s] = 0
  dx/dt = v
  dv/dt = F / m
}}
model Whole {{
  param lamp = {lamp} in 0 .. 300
  param most = 1 N in 0 N .. 3 N
  part fr = Rub(v = body.v)
  part body = Body(F = -fr.F)
}}
device Panel {{
  param node = 32 in 1 .. 127
  read enable [1] = 1 at 0x180 + node byte 0 as u8
  send lamp [1] = 0 at 0x200 + node byte 0 as u8
}}
rig bench {{
  run rotary Whole()
  rate 1 ms
{solver}  bus can0 = can(\"can0\", 1 Mbit/s)
  drive load = cia402(can0, node = 3, T_rated = 4 N·m, mode = torque, count = 1 rev / 262144, speed_unit = 0.01 rpm,
                      delay = 0.8 ms, lag = 0.6 ms, timeout = 3 ms)
  device panel = Panel(can0, timeout = 100 ms)
  hardware body {{
    load.torque = F limit -{limit} .. {limit}
    v = load.speed
    x = load.position
  }}
  panel.lamp = lamp
  safe load.torque = 0 N·m
}}
"
    )
}

fn start(text: &str, set: &[String]) -> Result<CompiledRig, Vec<grammar::diagnostic::Diagnostic>> {
    start_of(&mut compiler::load("bench.fric", text, &NoSources), set)
}

fn start_of(loaded: &mut Loaded, set: &[String]) -> Result<CompiledRig, Vec<grammar::diagnostic::Diagnostic>> {
    let changes = Changes { set: set.to_vec(), ..Changes::default() };
    let options = Options { changes, interpret: true };
    compiler::rig(loaded, &NoSources, "bench", &options, &mut Vec::new())
}

/// `PATH = VALUE`, often at a bound, sometimes of a wrong dimension.
fn assignment(chance: &mut Chance, path: &str, unit: &str) -> String {
    let number =
        [0.0, 0.0, 0.1, 0.2, 0.25, 0.3, 0.5, 1.0, 2.0, 4.0, -0.5, 0.05, 0.15, 300.0][chance.below(14) as usize];
    // Often shorter than the step.
    let number = if path.ends_with("tau") { number * [1.0, 1e-3, 1e-4][chance.below(3) as usize] } else { number };
    let (number, unit) = match chance.below(12) {
        0 => (number * 1e3, format!("m{unit}")),
        1 => (number, "s".into()),
        2 => (number, String::new()),
        3 => (number, "furlong".into()),
        _ => (number, unit.to_string()),
    };
    let unit = if unit == "m" { "" } else { &unit };
    format!("{path} = {number} {unit}").trim_end().to_string()
}

/// The two messages about a set, if they differ.
fn differ(text: &str, ready: &CompiledRig, set: &[String]) -> Result<Outcome, String> {
    let mut judge = Judge::new(ready.live.clone(), ready.judge.clone(), &ready.control).unwrap();
    let other = start(text, set);
    let codes = |found: &[grammar::diagnostic::Diagnostic]| {
        let mut codes: Vec<&str> = found.iter().filter(|d| d.is_error()).map(|d| d.code).collect();
        codes.sort_unstable();
        codes.dedup();
        codes
    };
    let values = match assignments(&set.join(", ")).and_then(|all| judge.read(&all)) {
        Ok(values) => values,
        Err(why) if why.starts_with("only a start") => return Ok(Outcome::Start),
        Err(why) => {
            let code = why.split(':').next().unwrap_or_default();
            return match &other {
                Err(found) if codes(found).contains(&code) => Ok(Outcome::Unread),
                Err(found) => Err(format!("live: {why}; start: {found:#?}")),
                Ok(_) => Err(format!("live: {why}; the start takes it")),
            };
        }
    };
    let verdict = judge.judge(ready.control.block(), values.values());
    // What a start checks beyond the conditions on parameters, by the programs of the rig that runs.
    let mut changed = ready.clone();
    changed.set(values.values());
    let loaded = compiler::load("bench.fric", text, &NoSources);
    let errors = if verdict.is_ok() { changed.start_errors(&loaded.files) } else { Vec::new() };
    if !errors.is_empty() {
        let words = |found: &[grammar::diagnostic::Diagnostic]| -> Vec<String> {
            found.iter().filter(|d| d.is_error()).map(|d| format!("{}: {}", d.code, d.message)).collect()
        };
        return match other {
            Err(found) if words(&found) == words(&errors) => Ok(Outcome::Unstable),
            Err(found) => Err(format!("live: {errors:#?}; start: {found:#?}")),
            Ok(_) => Err(format!("live: {errors:#?}; the start takes it")),
        };
    }
    match (verdict, other) {
        (Ok(()), Ok(other)) => {
            let ranges = |ready: &CompiledRig| -> Vec<(f64, f64)> {
                ready.program.description.quantities.iter().map(|quantity| quantity.range).collect()
            };
            if changed.program.params != other.program.params || ranges(&changed) != ranges(&other) {
                return Err("the programs that are analysed differ".into());
            }
            same_rig(ready, values.values(), &other).map(|()| Outcome::Taken)
        }
        (Err(objection), Err(found)) => {
            let (live, start) = (judge.codes(&objection), codes(&found));
            let Objection::Broken(_, count) = objection else { return Err(format!("{objection:?}")) };
            let same = live == start || count as usize > TOLD && live.iter().all(|code| start.contains(code));
            let said = judge.words(&objection);
            // For each message, the words that a start reports.
            let worded = found.iter().filter(|d| d.is_error()).any(|d| said.contains(&d.message));
            match same && worded {
                true => Ok(Outcome::Refused),
                false => Err(format!("live: {live:?} {said}; start: {found:#?}")),
            }
        }
        (Ok(()), Err(found)) => Err(format!("live takes it; start: {found:#?}")),
        (Err(objection), Ok(_)) => Err(format!("live: {}; the start takes it", judge.words(&objection))),
    }
}

#[derive(PartialEq, Eq, Hash, Debug)]
enum Outcome {
    Taken,
    Refused,
    Unread,
    Start,
    /// The fixed step is not stable, or `tune` goes beyond a range.
    Unstable,
}

/// A rig with a set of parameters equals the rig that starts with them: its plan, its ranges, each step to the bit.
fn same_rig(ready: &CompiledRig, set: &[(Slot, f64)], other: &CompiledRig) -> Result<(), String> {
    if ready.rig != other.rig {
        return Err("the plans differ".into());
    }
    let guards = |ready: &CompiledRig| ready.control.description().guards.clone();
    if guards(ready) != guards(other) {
        return Err("the ranges that are watched differ".into());
    }
    if ready.plant.block() != other.plant.block() {
        return Err("the plants differ".into());
    }
    let (mut live, mut fresh) = (ready.control.clone(), other.control.clone());
    set.iter().for_each(|(slot, value)| live.set(*slot, *value));
    let inputs = live.description().layout.inputs;
    let step = ready.rig.period_ns as f64 * 1e-9;
    let mut statuses = [live.start(step), fresh.start(step)];
    for k in 0..20 {
        for i in 0..inputs.len as usize {
            let value = 0.01 * f64::from(k) - 0.05 * i as f64;
            live.set(inputs.slot(i), value);
            fresh.set(inputs.slot(i), value);
        }
        let apart = live.block().iter().zip(fresh.block()).position(|(a, b)| a.to_bits() != b.to_bits());
        if let Some(slot) = apart.filter(|_| statuses == [0, 0]) {
            return Err(format!("step {k}: slot {slot} is {} and {}", live.block()[slot], fresh.block()[slot]));
        }
        if statuses[0] != statuses[1] {
            return Err(format!("step {k}: status {statuses:?}"));
        }
        statuses = [live.advance(1), fresh.advance(1)];
    }
    Ok(())
}

/// Mutants tried: the parameters of the program that is analysed stay those of the start; its ranges do.
#[test]
fn a_set_is_validated_like_a_start_with_the_same_values() {
    let number = |name: &str| std::env::var(name).ok().and_then(|text| text.parse::<u64>().ok());
    let runs = number("FRIC_RUNS").unwrap_or(60);
    let seeds: Vec<u64> = number("FRIC_SEED").map_or((0..runs).collect(), |seed| vec![seed]);
    let mut counts = std::collections::HashMap::new();
    let mut rigs = 0;
    for seed in seeds {
        let mut chance = Chance(seed);
        let text = text(&mut chance);
        let Ok(ready) = start(&text, &[]) else { continue };
        rigs += 1;
        let named = |live: bool| -> Vec<(String, String)> {
            let params = ready.live.params.iter().filter(|param| matches!(param.place, Tunable::Live(..)) == live);
            params.map(|param| (param.path.clone(), param.unit.text.clone())).collect()
        };
        let (may, start_only) = (named(true), named(false));
        for _ in 0..12 {
            let mut set: Vec<String> = Vec::new();
            for _ in 0..1 + chance.below(3) {
                let params = if chance.below(20) == 0 { &start_only } else { &may };
                // The one on which the stability of a step depends, more often than others.
                let at = params.iter().position(|(path, _)| path == "fr.tau").filter(|_| chance.below(4) == 0);
                let (path, unit) = &params[at.unwrap_or(chance.below(params.len() as u64) as usize)];
                let one = assignment(&mut chance, path, unit);
                if !set.iter().any(|other| other.starts_with(&format!("{path} "))) {
                    set.push(one);
                }
            }
            match differ(&text, &ready, &set) {
                Ok(outcome) => *counts.entry(outcome).or_insert(0) += 1,
                Err(mut why) => {
                    // Shrink the set as long as it still differs.
                    while let Some((k, less)) = (0..set.len()).filter(|_| set.len() > 1).find_map(|k| {
                        let fewer: Vec<String> =
                            set.iter().enumerate().filter(|(i, _)| *i != k).map(|(_, one)| one.clone()).collect();
                        differ(&text, &ready, &fewer).err().map(|why| (k, why))
                    }) {
                        set.remove(k);
                        why = less;
                    }
                    panic!("seed {seed}: set {}\n{why}\n{text}", set.join(", "));
                }
            }
        }
    }
    println!("{rigs} rigs, {counts:?}");
    if runs > 20 && number("FRIC_SEED").is_none() {
        for outcome in [Outcome::Taken, Outcome::Refused, Outcome::Unread, Outcome::Start, Outcome::Unstable] {
            assert!(counts.get(&outcome).is_some_and(|n| *n > 5), "{outcome:?}: {counts:?}");
        }
    }
}

/// Whether a parameter may change is decided by where it is used.
#[test]
fn parameters_that_only_a_start_reads_say_why() {
    let ready = (0..100).find_map(|seed| start(&text(&mut Chance(seed)), &[]).ok());
    let ready = ready.unwrap_or_else(|| panic!("{:#?}", start(&text(&mut Chance(0)), &[]).err()));
    let why = |path: &str| match &ready.live.param(path).unwrap_or_else(|| panic!("no {path}")).place {
        Tunable::Live(..) => "live".to_string(),
        Tunable::Start(why) => why.clone(),
    };
    assert_eq!(why("fr.gain"), "live");
    assert_eq!(why("fr.Ts"), "a period follows from it");
    assert_eq!(why("fr.n"), "the number of parts follows from it");
    assert_eq!(why("body.m"), "it belongs to `body`, which the drives replace");
    assert_eq!(why("load.T_rated"), "it describes a drive or device");
    assert_eq!(why("fr.z"), "it is a state, which is given a value at the start only");
    assert_eq!(why("body.x"), "it belongs to `body`, which the drives replace");
}

/// The initial value of a state is set at the start, is checked there, and is refused during the run.
#[test]
fn a_start_value_is_set_at_the_start_only() {
    let text =
        text(&mut Chance((0..100).find(|seed| start(&text(&mut Chance(*seed)), &[]).is_ok()).expect("one starts")));
    let mut ready = start(&text, &["fr.z = 0.5 N·m".into()]).expect("it lies in the range");
    let z = ready.control.description().quantity("fr.z").expect("the control has it").slot;
    ready.control.start(1e-3);
    assert_eq!(ready.control.get(z), 0.5);
    let found = start(&text, &["fr.z = 500 N·m".into()]).err().expect("it lies beyond the range");
    assert!(found.iter().any(|d| d.code == "E0502" && d.message.contains("`z` of Rub")), "{found:#?}");
    let judge = Judge::new(ready.live.clone(), ready.judge.clone(), &ready.control).unwrap();
    let said = judge.read(&assignments("fr.z = 0.5 N·m").unwrap()).unwrap_err();
    let why = "only a start reads `fr.z`: it is a state, which is given a value at the start only";
    assert_eq!(said, format!("{why}; start with `--set fr.z=0.5 N·m`"));
}
