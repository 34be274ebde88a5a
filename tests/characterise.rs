//! The battery on models with known results: published break-away forces, and the table of phenomena.

use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A folder for one test, empty at its start.
fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).unwrap();
    path
}

fn fric(folder: &Path, args: &[&str]) -> String {
    let output = Command::new(env!("CARGO_BIN_EXE_fric")).args(args).current_dir(folder).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{args:?}: {error}");
    String::from_utf8(output.stdout).unwrap()
}

/// The `--json` output for a model.
fn answers(name: &str, model: &str) -> Value {
    let folder = folder(name);
    serde_json::from_str(&fric(&folder, &["characterise", model, "--json"])).unwrap()
}

fn number(answers: &Value, test: &str, name: &str) -> f64 {
    let tests = answers["tests"].as_array().unwrap();
    let test = tests.iter().find(|one| one["key"] == test).unwrap();
    let numbers = test["numbers"].as_array().unwrap();
    let found = numbers.iter().find(|one| one["name"] == name || one["key"] == name);
    found.unwrap_or_else(|| panic!("no {name} in {test}"))["value"].as_f64().unwrap()
}

/// Verdicts in the order of `keys`: `+` shown, `-` not shown, `.` not applicable, `?` could not be run, `~` not proven.
fn verdicts(answers: &Value, keys: &[&str]) -> String {
    let phenomena = answers["phenomena"].as_array().unwrap();
    let mark = |key: &&str| match phenomena.iter().find(|one| one["key"] == *key).unwrap()["seen"].as_str().unwrap() {
        "shown" => '+',
        "not-shown" => '-',
        "not-run" => '?',
        "not-proven" => '~',
        _ => '.',
    };
    keys.iter().map(mark).collect()
}

/// The rows of the table in the catalogue of models, in its order.
const TABLE: [&str; 8] = [
    "holds",
    "stiction_peak",
    "stribeck",
    "presliding",
    "return_point_memory",
    "lag",
    "varying_break_away",
    "rate_independent",
];

#[test]
fn lugre_breaks_away_as_published_and_drifts() {
    let lugre = answers("lugre", "LuGre");
    // The published values; verified once with other code to four decimals.
    for (rate, force) in [("at 1 N/s", 1.4324), ("at 50 N/s", 1.0075)] {
        let seen = number(&lugre, "break_away", rate);
        assert!((seen - force).abs() < 1e-4, "{rate}: {seen}");
    }
    // 0.6 + 0.3 sin(2πt) N: 6.09 µm a cycle.
    let drift = number(&lugre, "drift", "drift");
    assert!((drift - 6.09e-6).abs() < 0.01e-6, "{drift}");
    assert!((number(&lugre, "steady", "stribeck_speed") - 1e-3).abs() < 0.05e-3);
    // The coast-down of the solvers' tests: 0.394793 m.
    assert!((number(&lugre, "coast_down", "stop_distance") - 0.394793).abs() < 1e-5);
    assert_eq!(verdicts(&lugre, &TABLE), "++++-++-");
    assert_eq!(verdicts(&lugre, &["no_drift", "dissipative", "stick_slip", "symmetric"]), "--++");
    let fading = answers("lugre_vd", "LuGre(vd = 10 mm/s)");
    assert_eq!(verdicts(&fading, &["dissipative"]), "+");
}

#[test]
fn the_table_of_phenomena_matches_the_catalogue() {
    assert_eq!(verdicts(&answers("kfm", "KFM"), &TABLE), "++--.--.");
    assert_eq!(verdicts(&answers("karnopp", "Karnopp"), &TABLE), "++--.--.");
    // Its break-away force depends on the history: the overshoot after a reversal is twice that from rest.
    let bliman_sorine = answers("bliman_sorine", "BlimanSorine");
    assert_eq!(verdicts(&bliman_sorine, &TABLE), "++-+--++");
    let overshoot = |key| number(&bliman_sorine, "reversal", key);
    assert!((overshoot("reversal_overshoot") / overshoot("virgin_overshoot") - 2.0).abs() < 1e-3);
    // Tustin's law as used in the paper can hold; the bare map jumps at rest and cannot.
    assert_eq!(verdicts(&answers("tustin_held", "Sticking(law = Tustin())"), &TABLE), "+++-.--.");
    assert_eq!(verdicts(&answers("tustin", "Tustin"), &TABLE), "?++?.-?.");
}

/// The models of the table that have presliding.
#[test]
fn the_table_of_phenomena_goes_on_with_bristles_and_elements() {
    // Dahl's break-away force is the same at every rate: a mass that oscillates on the bristle has not broken away.
    let dahl = answers("dahl", "Dahl");
    assert_eq!(verdicts(&dahl, &TABLE), "+--+---+");
    // And it does not stick again: without a peak the mass only touches rest.
    assert_eq!(verdicts(&dahl, &["stick_slip", "hysteresis", "dissipative"]), "-++");
    // Return-point memory is that of its elastic part, here the inner loop to a half and back.
    assert_eq!(verdicts(&answers("elasto_plastic", "ElastoPlastic"), &TABLE), "+++++++-");
    let gms = answers("gms", "GMS");
    assert_eq!(verdicts(&gms, &TABLE), "+++++++-");
    assert_eq!(verdicts(&gms, &["stick_slip", "no_drift", "symmetric"]), "+++");
}

/// Drift under a load that oscillates below break-away: Dahl, Bouc–Wen and LuGre drift, elasto-plastic and Maxwell slip
/// elements do not (Dupont, Hayward, Armstrong, Altpeter 2002). Dahl's force is Fc (1 − exp(−σ x/Fc)), so 99 % of it is
/// reached at x = ln(100) Fc/σ; so is that of Bouc–Wen with exponent 1.
#[test]
fn drift_and_travel_are_those_of_the_literature() {
    let exponential = 4.605_170_186e-5 * 1.000_2;
    for (model, drifts, travel) in [
        ("Dahl", "+-", Some(exponential)),
        ("BoucWen", "+-", Some(exponential)),
        ("ElastoPlastic", "++", None),
        ("MaxwellSlip", "++", None),
        ("KFM", "++", Some(0.0)),
    ] {
        let seen = answers(&format!("drift_{model}"), model);
        assert_eq!(verdicts(&seen, &["holds", "no_drift"]), drifts, "{model}");
        let found = seen["scales"]["break_away_travel"].as_f64().unwrap();
        if let Some(travel) = travel {
            assert!((found - travel).abs() <= 1e-3 * travel, "{model}: {found:e}");
        }
    }
}

/// Five elements with yield surfaces as people write them (Iwan): no cross where nothing was wrong, no fallback at rest.
#[test]
fn elements_with_yield_surfaces_are_characterised() {
    let folder = folder("iwan");
    let text = "model Jenkins {\n  input v [m/s]\n  param k = 8 N/mm in > 0\n  param phi = 0.5 N in > 0\n\
        state z [um] = 0\n  dz/dt = if abs(k * z) < phi or v * z < 0 then v else 0\n  output f [N] = k * z\n}\n\
        model Iwan {\n  input v [m/s]\n  part el[i in 1 .. 5] = Jenkins(v = v, phi = i * 0.05 N)\n  output F [N] = sum(el.f)\n}\n";
    fs::write(folder.join("iwan.fric"), text).unwrap();
    let seen: Value = serde_json::from_str(&fric(&folder, &["characterise", "iwan.fric", "Iwan", "--json"])).unwrap();
    let keys =
        ["holds", "no_drift", "presliding", "hysteresis", "return_point_memory", "rate_independent", "dissipative"];
    assert_eq!(verdicts(&seen, &keys), "++++++~", "{seen}");
    // The last element yields at 0.25 N / 8 N/mm; 99 % of the force, 0.7425 N, is reached 7.5 mN / 8 N/mm before.
    let travel = seen["scales"]["break_away_travel"].as_f64().unwrap();
    assert!((travel - (31.25e-6 - 0.9375e-6)).abs() < 1e-9, "{travel:e}");
    assert_eq!(seen["notes"].as_array().unwrap().len(), 0, "{}", seen["notes"]);
}

/// What `check`, `explain`, `characterise` and its LaTeX say of dissipation agree. LuGre with its stored energy is passive
/// for σ2 ≥ σ1 (Fs − Fc)/Fc and not otherwise (Barahanov, Ortega 2000); without a `storage` nothing is proved.
///
/// Mutant tried by hand: what is not proved counts as shown.
#[test]
fn all_commands_agree_on_dissipation() {
    let folder = folder("dissipation");
    let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(2);
    let mut random = compiler::ir::random::Random(seed);
    let (mut text, mut expected) = (String::new(), Vec::new());
    for case in 0..6 {
        let (fc, excess) = (random.within(0.5, 20.0), random.within(0.1, 1.0));
        let (sigma0, sigma1) = (fc / random.within(5e-6, 5e-5), random.within(50.0, 500.0));
        let needed = sigma1 * excess;
        let (times, storage) = [(2.0, true), (0.2, true), (2.0, false)][case % 3];
        expected.push(if storage { Some(times > 1.0) } else { None });
        text += &format!(
            "model M{case} {{\n  input v [m/s]\n  param sigma0 = {sigma0} N/m in > 0\n  param Fc = {fc} N in > 0\n  \
             param Fs = {} N in > 0\n  require Fs >= Fc\n  let g = Fc + (Fs - Fc) * exp(-(v / 1 mm/s)^2)\n  \
             state z [um] = 0 in -Fs / sigma0 .. Fs / sigma0\n  dz/dt = v - sigma0 * abs(v) / g * z\n  \
             output F [N] = sigma0 * z + {sigma1} N·s/m * dz/dt + {} N·s/m * v\n{}}}\n",
            fc * (1.0 + excess),
            times * needed,
            if storage { "  storage 0.5 * sigma0 * z^2\n" } else { "" }
        );
    }
    fs::write(folder.join("m.fric"), text).unwrap();
    let command = |args: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_fric")).args(args).current_dir(&folder).output().unwrap();
        String::from_utf8(output.stdout).unwrap()
    };
    let warnings: Value = serde_json::from_str(&command(&["check", "m.fric", "--json"])).unwrap();
    for (case, passive) in expected.into_iter().enumerate() {
        let name = format!("M{case}");
        let explained: Value = serde_json::from_str(&command(&["explain", "m.fric", &name, "--json"])).unwrap();
        let words = explained["dissipation"].as_str().unwrap().to_string();
        let seen: Value =
            serde_json::from_str(&fric(&folder, &["characterise", "m.fric", &name, "--json", "--out", &name])).unwrap();
        let row = seen["phenomena"].as_array().unwrap().iter().find(|row| row["key"] == "dissipative").unwrap().clone();
        let tex = fs::read_to_string(folder.join(&name).join("report.tex")).unwrap();
        let mark = tex.lines().find(|line| line.starts_with("dissipative & ")).unwrap().to_string();
        let told = format!("seed {seed}, {name}: {words}; {row}; {mark}");
        assert!(row["why"].as_str().unwrap().starts_with(&words), "{told}");
        let (begin, verdict, sign) = match (passive, words.starts_with("proved")) {
            (Some(false), _) => ("fails", "not-shown", "\\times"),
            (Some(true), true) => ("proved", "shown", "\\checkmark"),
            (Some(true) | None, _) => ("not proven", "not-proven", "\\circ"),
        };
        assert!(words.starts_with(begin) && row["seen"] == verdict && mark.contains(sign), "{told}");
    }
    let pushing = warnings.as_array().unwrap().iter().filter(|one| one["code"] == "W0703").count();
    assert_eq!(pushing, 2, "{warnings}");
}

/// A family over an input; the report of one lists what was held.
///
/// Mutant tried by hand: each member has its own bench.
#[test]
fn a_family_goes_over_an_input() {
    let folder = folder("family");
    let text = "model Loaded {\n  input v [m/s]\n  input N [N] = 10 N in > 0\n  param mu = 0.3 in > 0\n\
        param k = 1e5 N/m in > 0\n  state z [um] = 0\n  dz/dt = v - k * abs(v) / (mu * N) * z\n  output F [N] = k * z\n}\n";
    fs::write(folder.join("loaded.fric"), text).unwrap();
    let alone = fric(&folder, &["characterise", "loaded.fric", "Loaded"]);
    assert!(alone.contains("these inputs were held: N = 10 N (default)"), "{alone}");
    let family = fric(&folder, &["characterise", "loaded.fric", "Loaded", "--over", "N = 5 N, 20 N", "--json"]);
    let forces: Vec<f64> = family
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap()["scales"]["break_away_force"].as_f64().unwrap())
        .collect();
    assert!((forces[0] - 1.5).abs() < 0.01 && (forces[1] - 6.0).abs() < 0.03, "{forces:?}");
    // One bench for members whose forces differ forty-fold: mass, pull speeds and force rates, and the page says so.
    let over = ["characterise", "LoadedLuGre", "--over", "Fn = 1 N, 7 N, 40 N", "--json", "--out", "loads"];
    let members: Vec<Value> =
        fric(&folder, &over).lines().map(|line| serde_json::from_str::<Value>(line).unwrap()).collect();
    let bench = |seen: &Value| {
        let rates =
            seen["tests"][1]["numbers"].as_array().unwrap().iter().map(|n| n["name"].as_str().unwrap().to_string());
        let pulls = ["slowest_pull", "fastest_pull"].map(|key| number(seen, "stick_slip", key));
        (seen["scales"]["mass"].as_f64().unwrap(), pulls, rates.collect::<Vec<_>>(), seen["bench"].clone())
    };
    assert!(members.len() == 3 && members.iter().all(|one| bench(one) == bench(&members[0])), "{members:?}");
    assert!(members.iter().all(|one| verdicts(one, &["stick_slip"]) == "+"), "{members:?}");
    let page = fs::read_to_string(folder.join("loads/compare.html")).unwrap();
    assert!(page.contains("One bench for all: mass 10 kg"));
    assert_self_contained(&fs::read_to_string(folder.join("out/Loaded/compare.html")).unwrap());
}

#[test]
fn rotary_twins_give_the_same_numbers() {
    let (straight, rotary) = (answers("straight", "LuGre"), answers("rotary", "rotary LuGre"));
    assert_eq!(rotary["rotary"], true);
    for rate in ["1", "50"] {
        let force = number(&straight, "break_away", &format!("at {rate} N/s"));
        let torque = number(&rotary, "break_away", &format!("at {rate} N·m/s"));
        assert_eq!(force.to_bits(), torque.to_bits());
    }
}

/// A model as a beginner writes it, in a file of its own.
const MINE: &str = r#"
/// My first contact.
model Mine {
  input  v [m/s]
  param  Fc = 2 N        in > 0   /// Coulomb friction
  param  k  = 1e5 N/m    in > 0   /// stiffness
  state  f [N] = 0
  df/dt = k * v - k * abs(v) / Fc * f
  output F [N] = f
}

/// No friction: another port.
model Spring {
  input  x [m]
  output F [N] = 3 N/m * x
}
"#;

/// A page loads nothing from outside.
fn assert_self_contained(page: &str) {
    // Allowed: namespace names, and clip paths within the page itself.
    let outside = page.replace("http://www.w3.org/2000/svg", "").replace("url(#", "");
    for request in ["http:", "https:", "src=", "<script", "<link", "<iframe", "<object", "@import", "url(", "//cdn"] {
        assert!(!outside.contains(request), "{request}");
    }
}

#[test]
fn a_users_model_gets_a_page_a_battery_and_tables() {
    let folder = folder("mine");
    fs::write(folder.join("mine.fric"), MINE).unwrap();
    let words = fric(&folder, &["characterise", "mine.fric", "--set", "Fc=3N", "--out", "report"]);
    assert!(words.contains("Mine(Fc = 3N)") && words.contains("slides with 3 N"), "{words}");
    let page = fs::read_to_string(folder.join("report/report.html")).unwrap();
    assert!(page.contains("My first contact.") && page.contains("Coulomb friction"));
    assert_self_contained(&page);
    assert!(fs::read_to_string(folder.join("report/steady.csv")).unwrap().starts_with("curve,|v| [m/s],|F| [N]\n"));
    // The battery is an ordinary text.
    let again = fric(&folder, &["run", "report/battery.fric", "hold", "--quiet", "--out", "again"]);
    assert_eq!(again, "");
    // The same bytes again.
    fric(&folder, &["characterise", "mine.fric", "--set", "Fc=3N", "--out", "report"]);
    assert_eq!(fs::read_to_string(folder.join("report/report.html")).unwrap(), page);
}

/// A model sampled once a millisecond has steps that divide its period.
#[test]
fn a_sampled_model_is_stepped_by_its_period() {
    let clip = answers("clip", "KFMClip");
    assert_eq!(verdicts(&clip, &["holds", "no_drift", "stiction_peak", "stick_slip"]), "++++");
    assert!((number(&clip, "break_away", "at 1 N/s") - 1.5).abs() < 2e-3);
}

#[test]
fn a_model_that_cannot_be_characterised_is_refused_with_a_reason() {
    let folder = folder("refused");
    fs::write(folder.join("mine.fric"), MINE).unwrap();
    let refused = |args: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_fric")).args(args).current_dir(&folder).output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        String::from_utf8(output.stderr).unwrap()
    };
    assert!(refused(&["characterise", "LuGree"]).contains("did you mean `LuGre`?"));
    assert!(refused(&["characterise", "mine.fric", "Spring"]).contains("no friction model"));
    assert!(refused(&["characterise", "absent.fric"]).contains("there is no such file"));
    // What `fric check` refuses is not run.
    let unsafe_text =
        "model Mine {\n  input v [m/s]\n  param vs = 1 mm/s\n  output F [N] = 1 N * v / (abs(v) + vs)\n}\n";
    fs::write(folder.join("unsafe.fric"), unsafe_text).unwrap();
    assert!(refused(&["characterise", "unsafe.fric"]).contains("E0601"));
    assert!(refused(&["compare", "Dahl", "unsafe.fric"]).contains("E0601"));
}

#[test]
fn models_share_axes_on_one_page() {
    let folder = folder("compare");
    let words = fric(&folder, &["compare", "KFM", "BlimanSorine", "--out", "page"]);
    assert!(words.contains("1 KFM") && words.contains("2 BlimanSorine"), "{words}");
    let page = fs::read_to_string(folder.join("page/compare.html")).unwrap();
    assert!(page.contains("with the history") && page.matches("<svg").count() > 10);
    assert_self_contained(&page);
}

/// A force that jumps back and forth at rest would hide the loops of the others.
#[test]
fn a_model_that_chatters_is_not_drawn_over_others() {
    let folder = folder("chatters");
    fric(&folder, &["compare", "Coulomb", "Dahl", "--out", "page"]);
    let page = fs::read_to_string(folder.join("page/compare.html")).unwrap();
    assert!(page.contains("Coulomb is not drawn over x: at rest its force jumps to and fro"));
    assert_self_contained(&page);
    // Numbers in mathematical notation: no exponents among the verdicts and scales.
    let head = page.split("<h2>Tests</h2>").next().unwrap().split("</style>").nth(1).unwrap();
    let digit = |c: Option<char>| c.is_some_and(|c| c.is_ascii_digit());
    let exponents = head
        .match_indices("e-")
        .filter(|(at, _)| digit(head[..*at].chars().next_back()) && digit(head[at + 2..].chars().next()));
    assert_eq!(exponents.count(), 0, "{head}");
}

/// All output files of a command, byte by byte, twice; in a new folder each time.
#[test]
fn two_runs_leave_the_same_bytes() {
    let text = "import std.interfaces\nimport std.friction\nimport std.bench\nimport std.plant\n\
        experiment slip {\n  run SpringBench(fr = LuGre()) for 10 s\n  plot x [m]\n  expect max(v) > 0 m/s\n}\n";
    let both: Vec<Vec<Vec<u8>>> = ["bytes-a", "bytes-b"]
        .map(|name| {
            let folder = folder(name);
            fs::write(folder.join("m.fric"), text).unwrap();
            fric(&folder, &["run", "m.fric", "slip", "-q", "--csv", "r.csv", "--out", "run"]);
            let json = fric(&folder, &["characterise", "KFM", "--json", "--out", "page"]);
            fric(&folder, &["compare", "KFM", "Dahl", "--out", "side"]);
            let threads = if name == "bytes-a" { "1" } else { "2" };
            let vary = ["sweep", "m.fric", "slip", "--vary", "fr.Fs = 1.2 N .. 1.6 N by 0.2 N", "-q", "--out", "s.csv"];
            fric(&folder, &[&vary[..], &["--threads", threads]].concat());
            let files = ["r.csv", "page/report.html", "page/steady.csv", "side/compare.html", "s.csv"];
            let mut bytes: Vec<Vec<u8>> = files.iter().map(|file| fs::read(folder.join(file)).unwrap()).collect();
            bytes.push(json.into_bytes());
            bytes
        })
        .into();
    assert!(both[0].iter().all(|file| !file.is_empty()));
    assert!(both[0] == both[1]);
}

#[test]
fn the_page_of_the_library_is_up_to_date() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    fric(root, &["doc", "--check"]);
}
