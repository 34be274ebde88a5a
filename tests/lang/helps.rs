//! Suggestions of diagnostics are accepted: each error, the text of its help, and the program with the help applied.

use super::support::{Texts, checked, line};

const IMPORTS: &str =
    "import std.bench\nimport std.friction\nimport std.control\nimport std.plant\nimport std.observer\n";

/// An error, its help, and the text with the help applied. One error gives one message.
const SLIPS: &[(&str, &str, &str)] = &[
    // A unit is read from left to right.
    (
        "model A { input v [rad/s]  input a [N·m]  input b [N·m]\n  part g = rotary GearM6(v = v, F_m = a, F_e = b, Keq = 0.006 1/N·m)\n  output o [N·m] = g.F }",
        "write `0.006 1/N/m`",
        "model A { input v [rad/s]  input a [N·m]  input b [N·m]\n  part g = rotary GearM6(v = v, F_m = a, F_e = b, Keq = 0.006 1/N/m)\n  output o [N·m] = g.F }",
    ),
    (
        "model A { state v [m/s] = 0  dv/dt = 1 m/s·s  output o [m/s] = v }",
        "write `1 m/s/s`",
        "model A { state v [m/s] = 0  dv/dt = 1 m/s/s  output o [m/s] = v }",
    ),
    (
        "model A { param K = 1 1/(N·m)  output T [N·m] = 1 / K }",
        "write `1/N/m`",
        "model A { param K = 1 1/N/m in > 0 1/N/m  output T [N·m] = 1 / K }",
    ),
    (
        "model A { input a [m/(s*s)]  output o [m/s^2] = a }",
        "write `m/s/s`",
        "model A { input a [m/s/s]  output o [m/s^2] = a }",
    ),
    (
        "model A { param K = 5 1/s  output o [1/s] = K * 2 / s }",
        "a unit stands right after its number",
        "model A { param K = 5 1/s  output o [1/s] = K * 2 }",
    ),
    (
        "model A { input v [m/s] = inf m/s  output o [m/s] = v }",
        "leave the unit out",
        "model A { input v [m/s] = inf  output o [m/s] = v }",
    ),
    // Parts, slots and their arguments.
    (
        "experiment e { run SpringBench(fr = LuGre) for 1 s  expect max(x) < 1 m }",
        "write `fr = LuGre()`",
        "experiment e { run SpringBench(fr = LuGre()) for 1 s  expect max(x) < 1 m }",
    ),
    (
        "experiment e { run SpringBench(fr.Fv = 2 N·s/m) for 1 s  expect max(x) < 1 m }",
        "`sweep fr.Fv = ...` in an experiment",
        "experiment e { run SpringBench() for 1 s  sweep fr.Fv = 2 N·s/m  expect max(x) < 1 m }",
    ),
    (
        "model A { part b = ForceBench(u = 1 N)  output x [m] = b.x }\nexperiment e { run A(b = ForceBench(fr = LuGre())) for 1 s  expect max(x) < 1 m }",
        "`sweep b.NAME = …`",
        "model A { part b = ForceBench(u = 1 N)  output x [m] = b.x }\nexperiment e { run A() for 1 s  sweep b.fr = LuGre()  expect max(x) < 1 m }",
    ),
    (
        "experiment e { run SpringBench(fr = PID()) for 1 s  expect max(x) < 1 m }",
        "add `input v [m/s]`",
        "experiment e { run SpringBench(fr = Coulomb()) for 1 s  expect max(x) < 1 m }",
    ),
    (
        "experiment e { run SpringBench() for 1 s  expect first(fr.stick) < 1 s }",
        "Viscous has v, Fv, F",
        "experiment e { run SpringBench() for 1 s  expect max(fr.F) < 1 N }",
    ),
    // Experiments.
    (
        "experiment e { run SpringBench() for 9 s  expect max(x) after 5 s < 1 m }",
        "`expect max(x) < 1 m after 5 s`",
        "experiment e { run SpringBench() for 9 s  expect max(x) < 1 m after 5 s }",
    ),
    (
        "experiment e { run SpringBench() for 1 s  expect max(x) = 1 m }",
        "`expect max(x) ~= 1 m +- 1 %`",
        "experiment e { run SpringBench() for 1 s  expect max(x) ~= 1 m +- 1 % }",
    ),
];

#[test]
fn the_help_of_a_diagnostic_is_accepted() {
    let sources = Texts::default();
    for (wrong, help, right) in SLIPS {
        let (loaded, found) = checked("wrong.fric", &format!("{IMPORTS}{wrong}\n"), &sources);
        let lines: Vec<String> = found.iter().map(|one| format!("{}: {:?}", line(&loaded, one), one.help)).collect();
        assert!(lines.iter().any(|line| line.contains(help)), "{wrong}\n  {help}\n  {lines:#?}");
        let errors = found.iter().filter(|one| one.is_error()).count();
        assert_eq!(errors, 1, "one mistake, one message: {wrong}\n{lines:#?}");
        let (loaded, found) = checked("right.fric", &format!("{IMPORTS}{right}\n"), &sources);
        let lines: Vec<String> = found.iter().filter(|one| one.is_error()).map(|one| line(&loaded, one)).collect();
        assert!(lines.is_empty(), "{right}\n{lines:#?}");
    }
}
