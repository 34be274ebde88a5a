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
    // Habits of MATLAB and Python: docs/from-matlab.md.
    (
        "model A { input v [m/s]  output F [N] = 300 N*s/m*v }",
        "put a blank before the `*`: `N*s/m * v`",
        "model A { input v [m/s]  output F [N] = 300 N*s/m * v }",
    ),
    (
        "model A { input v [m/s]  output F [N] = 316 Ns/m * v }",
        "between units write `·`: `N·s/m`",
        "model A { input v [m/s]  output F [N] = 316 N·s/m * v }",
    ),
    (
        "model A { input v [m/s]  output F [N] = 0.4 N s/m * v }",
        "write `0.4 N·s/m`",
        "model A { input v [m/s]  output F [N] = 0.4 N·s/m * v }",
    ),
    (
        "model A { input v [m/s]  param k = 2 N·s/m  output F [N] = k .* v }",
        "write `*`",
        "model A { input v [m/s]  param k = 2 N·s/m  output F [N] = k * v }",
    ),
    (
        "model A { input v [m/s]  param k = [1 2 3] N·s/m\n  output F [N] = 1 N·s/m * v }",
        "the values of a sweep `sweep k = 1 N/m, 2 N/m`",
        "model A { input v [m/s]  param k = 1 N·s/m\n  output F [N] = k * v }",
    ),
    (
        "model A {\n  input v [m/s] % the velocity\n  output F [N] = 1 N·s/m * v\n}",
        "a comment begins with `//`",
        "model A {\n  input v [m/s] // the velocity\n  output F [N] = 1 N·s/m * v\n}",
    ),
    (
        "model A {\n  input v [m/s]\n  output F [N]\n  if v > 0 m/s\n    F = 1 N\n  else\n    F = -1 N\n  end\n}",
        "write `F = if v > 0 m/s then 1 N else -1 N`",
        "model A {\n  input v [m/s]\n  output F [N]\n  F = if v > 0 m/s then 1 N else -1 N\n}",
    ),
    (
        "model A {\n  input v [m/s]\n  output F [N] = v > 0 m/s ? 1 N : 2 N\n}",
        "write `if v > 0 m/s then 1 N else 2 N`",
        "model A {\n  input v [m/s]\n  output F [N] = if v > 0 m/s then 1 N else 2 N\n}",
    ),
    (
        "model A {\n  param Fc = 1 N in > 0\n  param Fs = 2 N in > 0\n  input w [1] in 0 .. 1\n  output y [1/N] = 1 / (Fc + (Fs - Fc) * w)\n}",
        "write `require Fs >= Fc`",
        "model A {\n  param Fc = 1 N in > 0\n  param Fs = 2 N in > 0\n  require Fs >= Fc\n  input w [1] in 0 .. 1\n  output y [1/N] = 1 / (Fc + (Fs - Fc) * w)\n}",
    ),
    (
        "model A { input v [m/s]  output F [N] = if 0 m/s < v < 1 mm/s then 1 N else 2 N }",
        "write `0 m/s < v and v < 1 mm/s`",
        "model A { input v [m/s]  output F [N] = if 0 m/s < v and v < 1 mm/s then 1 N else 2 N }",
    ),
    (
        "experiment e {\n  run SpringBench() for 1 s\n  plot(t, x)\n}",
        "over time write `plot x`",
        "experiment e {\n  run SpringBench() for 1 s\n  plot x\n}",
    ),
    (
        "experiment e {\n  run SpringBench() for 1 s\n  plot(v, F)\n}",
        "write `plot F against v`",
        "experiment e {\n  run SpringBench() for 1 s\n  plot F against v\n}",
    ),
    (
        "experiment e {\n  run SpringBench() for 1 s\n  [t, x] = ode45(f, 10)\n}",
        "it chooses its steps itself",
        "experiment e {\n  run SpringBench() for 1 s\n  plot x\n}",
    ),
    (
        "experiment e { run SpringBench() for 1 s  expect max(F) = 1 N }",
        "`expect max(F) ~= 1 N +- 1 %`",
        "experiment e { run SpringBench() for 1 s  expect max(F) ~= 1 N +- 1 % }",
    ),
    (
        "model A { input x [m]  output y [m] = prev(x) }",
        "`every 1 ms { next(x1) = x }`",
        "model A { input x [m]  state x1 [m] = 0  every 1 ms { next(x1) = x }  output y [m] = x1 }",
    ),
    (
        "model A { param chi = 0.5  let norm = 0.2^(1 + chi)  part b = Coulomb(v = 1 m/s, Fc = norm * 1 N)  output F [N] = b.F }",
        "write `param norm` in place of `let norm`",
        "model A { param chi = 0.5  param norm = 0.2^(1 + chi)  part b = Coulomb(v = 1 m/s, Fc = norm * 1 N)  output F [N] = b.F }",
    ),
    // What can be zero is named, and no velocity is declared positive.
    (
        "model A { input v [m/s]  input T [K] = 300 K  param alpha = 0.01 1/K  let soft = 1 - alpha * (T - 293 K)  output F [N] = 1 N·s/m * v / soft }",
        "`max(1 - alpha * (T - 293 K), 0.001)`",
        "model A { input v [m/s]  input T [K] = 300 K  param alpha = 0.01 1/K  let soft = max(1 - alpha * (T - 293 K), 0.001)  output F [N] = 1 N·s/m * v / soft }",
    ),
    (
        "model A { input v [m/s]  output P [N] = 1 W / v }",
        "`if abs(v) > 0.001 m/s then … / v else …`",
        "model A { input v [m/s]  output P [N] = if abs(v) > 0.001 m/s then 1 W / v else 0 N }",
    ),
    // An unknown warning is allowed nowhere.
    (
        "experiment e { run SpringBench() for 1 s  plot x  allow chater \"why\" }",
        "did you mean `chatter`?",
        "experiment e { run SpringBench() for 1 s  plot x  allow chatter \"why\" }",
    ),
    // Sweeps and their cases.
    (
        "experiment e { run SpringBench() for 1 s  sweep vp = 0 m/s .. 1 m/s log 3  expect max(x) < 1 m }",
        "write `lin` in place of `log`",
        "experiment e { run SpringBench() for 1 s  sweep vp = 0 m/s .. 1 m/s lin 3  expect max(x) < 9 m }",
    ),
    (
        "experiment e { run SpringBench() for 1 s  sweep vp = 0.1 m/s, 0.2 m/s  expect max(x) < 1 m for vp = 0.3 m/s }",
        "the sweep has vp = 0.1 m/s, 0.2 m/s",
        "experiment e { run SpringBench() for 1 s  sweep vp = 0.1 m/s, 0.2 m/s  expect max(x) < 1 m for vp = 200 mm/s }",
    ),
    // Parts, slots and their arguments.
    (
        "experiment e { run SpringBench(fr = LuGre) for 1 s  expect max(x) < 1 m }",
        "write `fr = LuGre()`",
        "experiment e { run SpringBench(fr = LuGre()) for 1 s  expect max(x) < 1 m }",
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
