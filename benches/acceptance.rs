//! Whether fits find the parameters of known contacts from far starts: `cargo bench --bench acceptance [-- SEEDS] [NAME]`,
//! 20 seeds and all rows by default.
//!
//! Each row is a recording that `fric run` makes, with noise of a printed seed, and a fit whose starts lie anywhere in
//! ranges of a factor of ten each way. Prints in how many of the seeds every value lies within four of its standard
//! deviations, these deviations, and the seeds that failed. Stick-slip alone does not determine its bristle: there the
//! combinations and profiles are printed instead, with ranges of a factor of a hundred.

#![allow(clippy::disallowed_methods, reason = "recordings are made with the platform's functions")]

#[path = "../tests/support/moved_contact.rs"]
mod moved_contact;
#[path = "../tests/support/recordings_of_contacts.rs"]
mod recordings_of_contacts;

use moved_contact::{CONTACT, Chance, moved};
use recordings_of_contacts::{KNOWN, Known, MASSES, far, found, fric, made, tap};
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// A recording: the file, its columns, its rows without noise, and the deviation of the noise of the last column.
struct Recording {
    file: &'static str,
    columns: &'static str,
    rows: Vec<Vec<f64>>,
    noise: f64,
}

/// A row of the table.
struct Row {
    name: &'static str,
    unknowns: Vec<Known>,
    recordings: Vec<Recording>,
    /// The statements of the fit but `vary`.
    fit: &'static str,
}

fn contact(prefix: &str) -> Vec<Known> {
    let leak = |name: &str| -> &'static str { format!("{prefix}{name}").leak() };
    CONTACT.iter().map(|(name, unit, value)| (leak(name), *unit, *value)).collect()
}

/// A run of a model of [`MASSES`], its position in the unit of the recording.
fn positions(folder: &Path, run: &str, rest: &str) -> Vec<Vec<f64>> {
    made(folder, &format!("{MASSES}experiment e {{ run {run} {rest} solver adaptive tol 1e-10 }}\n"))
}

fn rows(folder: &Path) -> Vec<Row> {
    let of_contact = || moved().into_iter().map(|(t, v, force)| vec![t, v, force]).collect::<Vec<_>>();
    let pulled = |contact: &str| Recording {
        file: "pull.csv",
        columns: "t [s],x [mm]",
        rows: positions(folder, &format!("Pull(fr = {contact})"), "for 30 s record x [mm] every 20 ms"),
        noise: 2.0,
    };
    let forces: Vec<String> = (0..=2000).map(|k| format!("{:.3},{:e}\n", 1e-3 * f64::from(k), tap(k))).collect();
    fs::write(folder.join("u.csv"), "t [s],u [N]\n".to_string() + &forces.concat()).expect("it can be written");
    let presliding = || {
        let run = format!("Tap(u = data.u, fr = {KNOWN})");
        let made = positions(folder, &run, "data \"u.csv\" (t [s], u [N]) record x [um] every 1 ms");
        let rows = made.iter().enumerate().map(|(k, row)| vec![row[0], tap(k as u32), row[1]]).collect();
        Recording { file: "tap.csv", columns: "t [s],u [N],x [um]", rows, noise: 0.1 }
    };
    let element = || {
        let text = "import std.friction\nexperiment e { run MaxwellElement(v = data.v, k = 1e5 N/m, W = 1 N) data \"v.csv\" (t [s], v [m/s]) solver adaptive tol 1e-10 record F [N] every 1 ms }\n";
        let speeds: Vec<String> = moved().iter().map(|(t, v, _)| format!("{t:.4},{v:e}\n")).collect();
        fs::write(folder.join("v.csv"), "t [s],v [m/s]\n".to_string() + &speeds.concat()).expect("it can be written");
        let made = made(folder, text);
        let rows = moved().iter().zip(&made).map(|((t, v, _), row)| vec![*t, *v, row[1]]).collect();
        Recording { file: "v.csv", columns: "t [s],v [m/s],F [N]", rows, noise: 5e-3 }
    };
    let two = vec![("fr.Fc", "N", 1.0), ("fr.Fs", "N", 1.5)];
    let pull = "run Pull() data \"pull.csv\" (t [s], x [mm]) minimise rms(x - data.x) / 2 mm";
    vec![
        Row {
            name: "moved",
            unknowns: contact(""),
            recordings: vec![Recording {
                file: "moved.csv",
                columns: "t [s],v [m/s],F [N]",
                rows: of_contact(),
                noise: 5e-3,
            }],
            fit: "run LuGre(v = data.v) data \"moved.csv\" (t [s], v [m/s], F [N]) minimise rms(F - data.F)",
        },
        Row {
            name: "presliding+slip",
            unknowns: contact(""),
            recordings: vec![presliding(), pulled(KNOWN)],
            fit: "case slow { run Tap(u = data.u, fr = LuGre(sigma0 = sigma0, sigma1 = sigma1, sigma2 = sigma2, Fc = Fc, Fs = Fs, vs = vs)) data \"tap.csv\" (t [s], u [N], x [um]) minimise rms(x - data.x) / 0.1 um }
  case slip { run Pull(fr = LuGre(sigma0 = sigma0, sigma1 = sigma1, sigma2 = sigma2, Fc = Fc, Fs = Fs, vs = vs)) data \"pull.csv\" (t [s], x [mm]) minimise rms(x - data.x) / 2 mm }",
        },
        Row { name: "KFM", unknowns: two.clone(), recordings: vec![pulled("KFM()")], fit: pull },
        Row {
            name: "Karnopp",
            unknowns: two,
            recordings: vec![pulled("Karnopp()")],
            fit: "run Pull(fr = Karnopp()) data \"pull.csv\" (t [s], x [mm]) minimise rms(x - data.x) / 2 mm",
        },
        Row {
            name: "Maxwell",
            unknowns: vec![("k", "N/m", 1e5), ("W", "N", 1.0)],
            recordings: vec![element()],
            fit: "run MaxwellElement(v = data.v) data \"v.csv\" (t [s], v [m/s], F [N]) minimise rms(F - data.F)",
        },
        Row {
            name: "slip",
            unknowns: contact("fr."),
            recordings: vec![pulled(KNOWN)],
            fit: "run Pull(fr = LuGre()) data \"pull.csv\" (t [s], x [mm]) minimise rms(x - data.x) / 2 mm",
        },
    ]
}

/// The answer of a row for a seed.
fn answer(folder: &Path, row: &Row, seed: u64, options: &[&str]) -> Result<Value, String> {
    let mut chance = Chance(seed);
    for recording in &row.recordings {
        let line = |row: &Vec<f64>| {
            let (last, before) = row.split_last().expect("it has columns");
            let before: String = before.iter().map(|cell| format!("{cell:e},")).collect();
            format!("{before}{:e}\n", last + recording.noise * chance.normal())
        };
        let lines: String = recording.rows.iter().map(line).collect();
        fs::write(folder.join(recording.file), format!("{}\n{lines}", recording.columns)).expect("it can be written");
    }
    // What is open is seen in ranges that hold the ends of the profiles.
    let vary = far(&mut chance, &row.unknowns, if row.name == "slip" { 2.0 } else { 1.0 });
    let text = format!("{MASSES}fit f {{\n  vary {vary}\n  {}\n}}\n", row.fit);
    fs::write(folder.join("f.fric"), text).expect("it can be written");
    let output = fric(folder, &[&["fit", "f.fric", "--json"], options].concat());
    serde_json::from_slice(&output.stdout).map_err(|_| String::from_utf8_lossy(&output.stderr).into_owned())
}

/// In how many seeds all values are found, and how exactly.
fn identified(folder: &Path, row: &Row, seeds: u64) {
    let (mut held, mut missed, mut deviations) = (0, Vec::new(), vec![0.0; row.unknowns.len()]);
    let (mut ended, mut followed) = (0, 0);
    let begin = Instant::now();
    for seed in 0..seeds {
        let answer = answer(folder, row, seed, &["--pieces", "1", "--profile", "none"]);
        let all = answer.as_ref().map(found).unwrap_or_default();
        let starts = |what: &str| answer.as_ref().map_or(0, |answer| answer["starts"][what].as_u64().unwrap_or(0));
        (ended, followed) = (ended + starts("ended_here"), followed + starts("followed"));
        let near =
            |((at, sd), (_, _, truth)): (&(f64, f64), &Known)| (at - truth).abs() < 4.0 * sd && *sd < 0.1 * truth;
        if all.len() == row.unknowns.len() && all.iter().zip(&row.unknowns).all(near) {
            held += 1;
            for (sum, ((_, sd), (_, _, truth))) in deviations.iter_mut().zip(all.iter().zip(&row.unknowns)) {
                *sum += 100.0 * sd / truth;
            }
        } else {
            let said = answer.err().unwrap_or_else(|| format!("{all:?}"));
            missed.push(format!("  seed {seed}: {said}"));
        }
    }
    let mean = |(sum, (name, ..)): (&f64, &Known)| format!("{name} {:.3}", sum / f64::from(held.max(1)));
    let deviations: Vec<String> = deviations.iter().zip(&row.unknowns).map(mean).collect();
    let each = begin.elapsed().as_secs_f64() / seeds as f64;
    println!(
        "{:<16} {held} of {seeds}   sd in %: {}   {ended} of {followed} searches ended in the best minimum; {each:.2} s each",
        row.name,
        deviations.join(", ")
    );
    missed.iter().for_each(|line| println!("{line}"));
}

/// What stick-slip alone says of a bristle.
fn undetermined(folder: &Path, row: &Row, seeds: u64) {
    for seed in 0..seeds {
        let answer = match answer(folder, row, seed, &["--pieces", "1"]) {
            Ok(answer) => answer,
            Err(why) => {
                println!("{:<16} seed {seed}: {why}", row.name);
                continue;
            }
        };
        let open = answer["undetermined"].as_array().map_or(0, Vec::len);
        let of = |name: &str| {
            let all = answer["parameters"].as_array().into_iter().flatten();
            let one = all.into_iter().find(|one| one["path"] == format!("fr.{name}"))?;
            Some(one.clone())
        };
        let profile = |name: &str| {
            let one = of(name).unwrap_or_default();
            let ends = &one["profile"]["interval"];
            let (low, high) = (&ends[0], &ends[1]);
            format!("{name} {low} .. {high}")
        };
        let sliding = of("Fc").unwrap_or_default();
        let number = |what: &str| sliding[what].as_f64().unwrap_or(f64::NAN);
        println!(
            "{:<16} seed {seed}: {open} combinations; profiles {}, {}, {} (null: not bounded); Fc off by {:.1} sd",
            row.name,
            profile("vs"),
            profile("sigma0"),
            profile("sigma1"),
            (number("value") - 1.0) / number("sd")
        );
    }
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).filter(|arg| !arg.starts_with('-')).collect();
    let seeds: u64 = args.iter().filter_map(|arg| arg.parse().ok()).next().unwrap_or(20);
    let named: Vec<&String> = args.iter().filter(|arg| arg.parse::<u64>().is_err()).collect();
    let folder: PathBuf = Path::new(env!("CARGO_TARGET_TMPDIR")).join("acceptance");
    fs::create_dir_all(&folder).expect("the target folder can be written");
    for row in rows(&folder) {
        if named.is_empty() || named.iter().any(|name| **name == row.name) {
            match row.name {
                "slip" => undetermined(&folder, &row, seeds),
                _ => identified(&folder, &row, seeds),
            }
        }
    }
}
