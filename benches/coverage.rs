//! How often the intervals of a fit hold the truth: `cargo bench --bench coverage [-- DRAWS]`, 200 by default.
//!
//! A contact is moved with a known velocity, as in `tests/fits.rs`; its force is fitted under four kinds of noise, each
//! with so many draws. Prints for each parameter how many of a hundred 95 % intervals hold its true value. A binomial
//! share of 200 draws scatters by 1.5 about 95.

#![allow(clippy::disallowed_methods, reason = "recordings are made with the platform's functions")]

#[path = "../tests/support/moved_contact.rs"]
mod moved_contact;

use moved_contact::{CONTACT, Chance, moved};
use std::fs;
use std::path::Path;
use std::process::Command;

/// Standard deviation of the noise in N.
const NOISE: f64 = 5e-3;
/// Correlation of coloured noise from row to row.
const COLOUR: f64 = 0.9;

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    White,
    Coloured,
    /// Readings are whole multiples of three standard deviations.
    Steps,
    /// Two recordings, each with an offset of its own.
    Offsets,
}

fn recording(rows: &[(f64, f64, f64)], kind: Kind, offset: f64, chance: &mut Chance) -> String {
    let mut past = chance.normal();
    let mut noise = || match kind {
        Kind::Coloured => {
            past = COLOUR * past + (1.0 - COLOUR * COLOUR).sqrt() * chance.normal();
            NOISE * past
        }
        Kind::White | Kind::Steps | Kind::Offsets => NOISE * chance.normal(),
    };
    let mut line = |(t, v, force): &(f64, f64, f64)| {
        let read = force + offset + noise();
        let step = 3.0 * NOISE;
        let read = if kind == Kind::Steps { (read / step).round() * step } else { read };
        format!("{t:.4},{v:e},{read:e}\n")
    };
    "t [s],v [m/s],F [N]\n".to_string() + &rows.iter().map(&mut line).collect::<String>()
}

fn text(kind: Kind) -> String {
    let offsets = kind == Kind::Offsets;
    let part = if offsets { "contact." } else { "" };
    let vary = CONTACT.iter().map(|(name, unit, value)| {
        format!("{part}{name} = {value} {unit} in {} {unit} .. {} {unit}", 0.1 * value, 10.0 * value)
    });
    let mut vary: Vec<String> = vary.collect();
    let (run, data) = if offsets { ("Bench", "\"r0.csv\", \"r1.csv\"") } else { ("LuGre", "\"r0.csv\"") };
    if offsets {
        vary.push("o = 0 N in -1 N .. 1 N each".into());
    }
    format!(
        "import std.friction\nmodel Bench {{\n  input v [m/s]\n  param o = 0 N in -1 N .. 1 N\n  part contact = LuGre(v = v)\n  output F [N] = contact.F + o\n}}\nfit f {{\n  run {run}(v = data.v)\n  data {data} (t [s], v [m/s], F [N])\n  vary {}\n  minimise rms(F - data.F)\n}}\n",
        vary.join(", ")
    )
}

fn main() {
    let draws: u64 = std::env::args().filter_map(|arg| arg.parse().ok()).next().unwrap_or(200);
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("coverage");
    fs::create_dir_all(&folder).expect("the target folder can be written");
    let rows = moved();
    println!("{draws} draws each: how many of a hundred 95 % intervals hold the true value");
    print!("{:<12}", "noise");
    CONTACT.iter().for_each(|(name, ..)| print!("{name:>8}"));
    println!("{:>8}", "offset");
    let kinds = [
        ("white", Kind::White),
        ("AR(1) 0.9", Kind::Coloured),
        ("steps of 3σ", Kind::Steps),
        ("offsets", Kind::Offsets),
    ];
    for (name, kind) in kinds {
        fs::write(folder.join("f.fric"), text(kind)).expect("it can be written");
        let mut held = [0u64; 7];
        for seed in 0..draws {
            let mut chance = Chance(seed);
            let offsets: Vec<f64> = match kind {
                Kind::Offsets => (0..2).map(|_| chance.fraction() - 0.5).collect(),
                Kind::White | Kind::Coloured | Kind::Steps => vec![0.0],
            };
            for (k, offset) in offsets.iter().enumerate() {
                let data = recording(&rows, kind, *offset, &mut chance);
                fs::write(folder.join(format!("r{k}.csv")), data).expect("it can be written");
            }
            let mut command = Command::new(env!("CARGO_BIN_EXE_fric"));
            command.current_dir(&folder).args(["fit", "f.fric", "--json", "--starts", "1", "--pieces", "1"]);
            let output = command.output().expect("the command runs");
            let answer: serde_json::Value = serde_json::from_slice(&output.stdout).expect("it prints its answer");
            let all = answer["parameters"].as_array().expect("it has parameters");
            let truth = CONTACT.iter().map(|(_, _, value)| *value).chain(offsets);
            for (k, (found, truth)) in all.iter().zip(truth).enumerate() {
                let scale = if found["unit"] == "mm/s" { 1e-3 } else { 1.0 };
                let [low, high] = [0, 1].map(|end| scale * found["interval"][end].as_f64().unwrap_or(f64::NAN));
                held[k.min(6)] += u64::from((low..=high).contains(&truth));
            }
        }
        print!("{name:<12}");
        held[..6].iter().for_each(|held| print!("{:>8.1}", 100.0 * *held as f64 / draws as f64));
        match kind {
            Kind::Offsets => println!("{:>8.1}", 100.0 * held[6] as f64 / (2 * draws) as f64),
            Kind::White | Kind::Coloured | Kind::Steps => println!(),
        }
    }
}
