//! The canonical form of a text.

#[path = "../../abi/src/random.rs"]
#[allow(dead_code, reason = "the generator has more")]
mod random;
mod samples;

use grammar::format::{canonical_unit, format};
use grammar::parse::parse;
use grammar::span::FileId;
use samples::SAMPLES;

/// Lines that their author laid out by hand: for them the canonical form differs.
const BY_HAND: [&str; 11] = [
    "  input  v [m/s]",
    "  input  v  [m/s]",
    "    go forward  when (F_ext >  Fs and v >= 0) or v >  v_hold or slip >  x_hold",
    "    go backward when (F_ext < -Fs and v <= 0) or v < -v_hold or slip < -x_hold",
    "  output stuck   = abs(v) < Dv",
    "  output F [N]   = if stuck then clamp(F_ext + Fs / Dv * v, -Fs, Fs)",
    "                   else Fc * sign(v) + Fv * v",
    "  dxf/ds = ( f1 * sign(v) - xf) / (eta * eps_f)",
    "  let    g  = stribeck(v, Fc, Fs, vs, 2)",
    "  output v_out [m/s] = if stuck then 0 else v        /// the velocity, dead-banded",
    "  let    e  = r - y",
];

#[test]
fn samples_are_canonical_but_for_a_few_lines() {
    let mut different = Vec::new();
    for (name, text) in SAMPLES {
        let formatted = format(text, 100).unwrap();
        let pairs = text.lines().zip(formatted.lines()).filter(|(a, b)| a != b && !BY_HAND.contains(a));
        different.extend(pairs.map(|(a, b)| format!("{name}\n  {a}\n  {b}")));
        assert_eq!(text.lines().count(), formatted.lines().count());
    }
    assert_eq!(different, [""; 0], "{}", different.join("\n"));
}

#[track_caller]
fn becomes(text: &str, wanted: &str) {
    assert_eq!(format(text, 100).unwrap(), wanted);
    keeps_its_tree(text, 100);
}

#[test]
fn the_names_of_lints_keep_their_hyphens() {
    let model = "model M {\n  allow no-drive-timeout \"x\"\n}\n";
    becomes(model, model);
    becomes(
        "experiment e {\n  run M() for 1 s\n  allow large-step \"slow\"\n}\n",
        "experiment e {\n  run   M() for 1 s\n  allow large-step \"slow\"\n}\n",
    );
}

#[test]
fn a_chain_of_ifs_stands_in_one_column() {
    let chain = "model M {\n  let    F = if a < 1 then 1\n             else if (if b then c else d) < 2 then 2\n             \
                 else if a < 3 then 3\n             else 4\n}\n";
    becomes(chain, chain);
    let nested =
        "model M {\n  let    F = if a then if b then 1\n                       else 2\n             else 3\n}\n";
    becomes(nested, nested);
}

/// The tree without places, with canonical units.
fn shape(text: &str) -> String {
    let parsed = parse(FileId(0), text);
    assert_eq!(parsed.diagnostics, [], "{text}");
    let debug = format!("{:?}", parsed.file);
    let mut shape = String::with_capacity(debug.len() / 2);
    let mut rest = debug.as_str();
    while let Some(at) = rest.find("Span { file") {
        shape.push_str(&rest[..at]);
        rest = &rest[at + rest[at..].find('}').unwrap() + 1..];
    }
    shape.push_str(rest);
    let mut units = String::with_capacity(shape.len());
    let mut rest = shape.as_str();
    while let Some(at) = rest.find("UnitText { text: \"") {
        let from = at + "UnitText { text: \"".len();
        let to = from + rest[from..].find('"').unwrap();
        units.push_str(&rest[..from]);
        units.push_str(&canonical_unit(&rest[from..to]));
        rest = &rest[to..];
    }
    units + rest
}

#[track_caller]
fn keeps_its_tree(text: &str, width: usize) {
    let once = format(text, width).unwrap();
    assert_eq!(shape(text), shape(&once), "\n{text}\n{once}");
    assert_eq!(format(&once, width).unwrap(), once, "formatting it twice, from\n{text}");
}

#[test]
fn blanks_and_units_become_canonical() {
    becomes(
        "model M{param  a=2N*m in>0\nparam Fs=3Nm}",
        "model M {\n  param  a  = 2 N·m        in > 0\n  param  Fs = 3 N·m\n}\n",
    );
    becomes("const a=3 µm+4 N/m*s-(2)^-x", "const a = 3 um + 4 N·s/m - (2)^-x\n");
    becomes(
        "model M { state z = 0 dz/dt = delta/depth*-a  }",
        "model M {\n  state  z = 0\n  dz/dt = delta / depth * -a\n}\n",
    );
    // A hyphen in the name of a warning is no minus sign.
    becomes(
        "model M{allow not-dissipative   \"a - b\"\noutput y=1-2}",
        "model M {\n  allow not-dissipative \"a - b\"\n  output y = 1 - 2\n}\n",
    );
    becomes("\n\n// a\n\n\n// b\nimport   std.friction // c", "// a\n\n// b\nimport std.friction  // c\n");
    becomes(
        "table t(v [m/s])[N]=linear{0 m/s:1 N,1 m/s:2 N}",
        "table t(v [m/s]) [N] = linear { 0 m/s: 1 N, 1 m/s: 2 N }\n",
    );
    for (unit, canonical) in [
        ("N*m", "N·m"),
        ("Nm", "N·m"),
        ("kNm", "kN·m"),
        ("N/m·s", "N·s/m"),
        ("N/m/s", "N/m/s"),
        ("1/s", "1/s"),
        ("µm^2", "um^2"),
        ("°", "deg"),
        ("kΩ", "kOhm"),
        ("1/m·s", "s/m"),
        ("1", "1"),
        ("%", "%"),
        ("nm", "nm"),
    ] {
        assert_eq!(canonical_unit(unit), canonical);
        assert_eq!(canonical_unit(canonical), canonical);
    }
}

#[test]
fn mistakes_are_returned() {
    assert_eq!(format("model M { param T = 2 N m }", 100).unwrap_err()[0].code, "E0110");
}

#[test]
fn long_lines_are_broken_behind_a_comma() {
    becomes(
        "model M { part fr = LuGre(v = body.v, F_ext = pid.u + pid.u + pid.u, sigma0 = 1000 N/m, sigma1 = 1000 N·s/m, vs = 3 mm/s) }",
        "model M {\n  part   fr = LuGre(v = body.v, F_ext = pid.u + pid.u + pid.u, sigma0 = 1000 N/m,\n                    sigma1 = 1000 N·s/m, vs = 3 mm/s)\n}\n",
    );
}

/// A generator; the field is its state, at first the seed.
struct Chance(u64);

impl Chance {
    fn below(&mut self, bound: usize) -> usize {
        random::below(&mut self.0, bound)
    }
}

#[test]
fn trees_survive_and_twice_is_once() {
    let rounds = std::env::var("FRIC_MUTATIONS").ok().and_then(|rounds| rounds.parse().ok()).unwrap_or(300);
    for (_, text) in SAMPLES {
        for width in [40, 80, 100] {
            keeps_its_tree(text, width);
        }
    }
    let mut tried = 0;
    for seed in 0..rounds {
        let mut chance = Chance(seed);
        let mut text = SAMPLES[chance.below(SAMPLES.len())].1.to_string();
        for _ in 0..1 + chance.below(6) {
            let tokens = grammar::tokens::tokens(&text);
            let (one, other) = (tokens[chance.below(tokens.len())], tokens[chance.below(tokens.len())]);
            let (a, b) = (one.text(&text).to_string(), other.text(&text).to_string());
            match chance.below(6) {
                0 if one.is_trivia() => text.replace_range(one.start..one.end, " "),
                1 if one.is_trivia() => text.replace_range(one.start..one.end, "\n"),
                2 if one.is_trivia() => text.replace_range(one.start..one.end, " // why\n"),
                3 => text.replace_range(one.start..one.end, ""),
                4 => text.replace_range(one.start..one.end, &b),
                _ => text.insert_str(one.start, &a),
            }
        }
        if parse(FileId(0), &text).diagnostics.is_empty() {
            tried += 1;
            let width = 40 + chance.below(80);
            if std::panic::catch_unwind(|| keeps_its_tree(&text, width)).is_err() {
                panic!("seed {seed}");
            }
        }
    }
    assert!(tried > rounds / 10, "{tried} of {rounds} can be read");
}

/// A case is a block in a fit; an initial value is written as a call.
#[test]
fn cases_of_fits_are_blocks() {
    becomes(
        "fit f {\nvary initial (z) in -1 um..1 um each,Fc in 1 N .. 2 N\ncase slow { run A(v=data.v) data \"a.csv\",\"b.csv\" (t [s], v [m/s])\nminimise rms(F) validate \"c.csv\" }\n}\n",
        "fit f {\n  vary initial(z) in -1 um .. 1 um each, Fc in 1 N .. 2 N\n  case slow {\n    run      A(v = data.v)\n    data     \"a.csv\", \"b.csv\" (t [s], v [m/s])\n    minimise rms(F)\n    validate \"c.csv\"\n  }\n}\n",
    );
}
