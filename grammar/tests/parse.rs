//! What a text becomes, and what is said about a wrong one.

#[path = "../../abi/src/random.rs"]
#[allow(dead_code, reason = "the generator has more")]
mod random;
mod samples;

use grammar::ast::*;
use grammar::diagnostic::Diagnostic;
use grammar::parse::{Parsed, parse, parse_expr, parse_instance, parse_path, parse_setting};
use grammar::span::FileId;
use samples::SAMPLES;

/// Reads `text`; every label must lie inside it.
fn read(text: &str) -> Parsed {
    let parsed = parse(FileId(0), text);
    for diagnostic in &parsed.diagnostics {
        assert!(!diagnostic.labels.is_empty(), "{diagnostic:?}");
        for label in &diagnostic.labels {
            assert!(text.get(label.span.range()).is_some(), "{diagnostic:?} in {text:?}");
        }
    }
    parsed
}

/// One line for each diagnostic: code, the marked text, message, first label, help.
fn say(text: &str, diagnostics: &[Diagnostic]) -> Vec<String> {
    diagnostics
        .iter()
        .map(|d| {
            let help = d.help.as_deref().map_or(String::new(), |help| format!(" | {}", help.replace('\n', " / ")));
            format!("{} `{}` {} ({}){help}", d.code, &text[d.span().range()], d.message, d.labels[0].text)
        })
        .collect()
}

#[track_caller]
fn says(text: &str, wanted: &[&str]) {
    assert_eq!(say(text, &read(text).diagnostics), wanted, "\n{text}");
}

/// Says it in the body of a model that declares a few names.
#[track_caller]
fn model_says(body: &str, wanted: &[&str]) {
    says(&format!("model M {{\n  state z [m] = 0 m\n  param k = 1\n{body}\n  let last = 1\n}}\n"), wanted);
}

#[test]
fn samples_are_read_without_complaint() {
    for (name, text) in SAMPLES {
        says(text, &[]);
        assert!(!read(text).file.items.is_empty(), "{name}");
    }
}

// ---- trees

/// An expression in prefix form; what could not be read is `!`.
fn prefix(expr: &Expr) -> String {
    match &expr.kind {
        ExprKind::Number { value, unit } => {
            format!("{value}{}", unit.as_ref().map_or(String::new(), |unit| format!("[{}]", unit.text)))
        }
        ExprKind::Path(path) => {
            let segments = path.segments.iter().map(|segment| {
                format!("{}{}", segment.name.text, segment.index.map_or(String::new(), |index| format!("[{index}]")))
            });
            segments.collect::<Vec<_>>().join(".")
        }
        ExprKind::Derivative { of, along } => format!("D({},{})", of.text, along.text),
        ExprKind::Call { function, args, window } => {
            let edge = |word: &str, edge: &Option<Expr>| {
                edge.as_ref().map(|edge| format!(" {word} {}", prefix(edge))).unwrap_or_default()
            };
            let window = window.as_ref().map(|w| edge("after", &w.after) + &edge("before", &w.before));
            let args = args.iter().map(prefix).collect::<Vec<_>>().join(" ");
            format!("{}({args}{})", function.text, window.unwrap_or_default())
        }
        ExprKind::Unary(UnaryOp::Negate, a) => format!("(neg {})", prefix(a)),
        ExprKind::Unary(UnaryOp::Not, a) => format!("(not {})", prefix(a)),
        ExprKind::Binary(operator, _, a, b) => format!("({} {} {})", operator.text(), prefix(a), prefix(b)),
        ExprKind::If(a, b, c) => format!("(if {} {} {})", prefix(a), prefix(b), prefix(c)),
        ExprKind::Hole => "?".to_string(),
        ExprKind::Error => "!".to_string(),
    }
}

#[track_caller]
fn tree(text: &str, wanted: &str) {
    let (expr, diagnostics) = parse_expr(FileId(0), text);
    assert_eq!(say(text, &diagnostics), [""; 0], "{text}");
    assert_eq!(prefix(&expr), wanted, "{text}");
    assert!(text.get(expr.span.range()).is_some());
}

#[test]
fn operators_bind_as_on_paper() {
    tree("a - b - c", "(- (- a b) c)");
    tree("a / b * c", "(* (/ a b) c)");
    tree("a + b * c^d", "(+ a (* b (^ c d)))");
    tree("a^b^c", "(^ a (^ b c))");
    tree("-x^2", "(neg (^ x 2))");
    tree("-a * b", "(* (neg a) b)");
    tree("a^-b^c * d", "(* (^ a (neg (^ b c))) d)");
    tree("a - -b", "(- a (neg b))");
    tree("not a < b and c or d", "(or (and (not (< a b)) c) d)");
    tree("a or b and c", "(or a (and b c))");
    tree("a + 1 <= b * 2", "(<= (+ a 1) (* b 2))");
    tree("v falls 0 or v < -v_hold", "(or (falls v 0) (< v (neg v_hold)))");
    tree("if a then b else if c then d else e", "(if a b (if c d e))");
    tree("(if a then b else c) + (d)", "(+ (if a b c) d)");
    tree("clamp(u, -Fs, Fs) - el[2].f * ?", "(- clamp(u (neg Fs) Fs) (* el[2].f ?))");
}

#[test]
fn numbers_carry_the_unit_that_follows() {
    tree("5e-4 1/s", "0.0005[1/s]");
    tree("2 N*m * m", "(* 2[N*m] m)");
    tree("2 N * m", "(* 2[N] m)");
    tree("30 % + 0x200", "(+ 30[%] 512)");
    tree("1 rev / 65536", "(/ 1[rev] 65536)");
}

#[test]
fn spans_cover_what_was_written() {
    let (text, diagnostics) = ("(a + b) * -c", vec![]);
    let (expr, found) = parse_expr(FileId(0), text);
    assert_eq!(found, diagnostics);
    assert_eq!(&text[expr.span.range()], text);
    let ExprKind::Binary(BinaryOp::Multiply, operator, sum, negated) = &expr.kind else { panic!("{expr:?}") };
    assert_eq!((&text[operator.range()], &text[sum.span.range()], &text[negated.span.range()]), ("*", "a + b", "-c"));
}

/// What an expression is in a model with states z, z_hat, d, s, xf, v and params k, x, s1.
#[track_caller]
fn in_model(text: &str, wanted: &str) {
    let whole = format!(
        "model M {{ state z = 0 m state z_hat = 0 m state d = 0 m state s = 0 m state xf = 0 N state v = 0 m/s \
         param k = 1 param x = 1 param s1 = 1 let y = {text} }}"
    );
    let parsed = parse(FileId(0), &whole);
    let Item::Model(model) = &parsed.file.items[0] else { panic!("no model") };
    let Some(Statement::Declaration(Declaration { value: Some(value), .. })) = model.body.last() else {
        panic!("no let")
    };
    let codes: Vec<&str> = parsed.diagnostics.iter().map(|diagnostic| diagnostic.code).collect();
    assert_eq!(format!("{}{}", prefix(value), codes.join(" ")), wanted, "{text}");
}

#[test]
fn a_ratio_is_a_derivative_or_a_division() {
    in_model("dz/dt", "D(z,t)");
    in_model("dz_hat/dt", "D(z_hat,t)");
    in_model("dd/dt", "D(d,t)");
    in_model("dxf/ds", "D(xf,s)");
    in_model("s1*dz/dt*k", "(* (* s1 D(z,t)) k)");
    in_model("-dz/dt", "(neg D(z,t))");
    in_model("dz/dt/k", "(/ D(z,t) k)");
    in_model("delta/depth", "(/ delta depth)");
    in_model("d1/d2", "(/ d1 d2)");
    in_model("d/dt", "(/ d dt)");
    in_model("din/dt", "(/ din dt)");
    in_model("fr.dz/dt", "(/ fr.dz dt)");
    in_model("dz/dt.x", "(/ dz dt.x)");
    in_model("dz/dt(x)", "(/ dz dt(x))");
    in_model("dz / dt", "(/ dz dt)");
    in_model("dk/dt", "(/ dk dt)");
    in_model("dz/du", "(/ dz du)");
    // As if written with spaces, whatever stands around it.
    in_model("a*delta/depth", "(/ (* a delta) depth)");
    in_model("a/delta/depth", "(/ (/ a delta) depth)");
    in_model("delta/depth^2", "(/ delta (^ depth 2))");
    in_model("a^delta/depth", "(/ (^ a delta) depth)");
    in_model("-delta/depth", "(/ (neg delta) depth)");
    // A derivative that is divided by, raised to a power or used as an exponent stands in parentheses.
    in_model("k / (dz/dt)", "(/ k D(z,t))");
    in_model("(dz/dt)^2", "(^ D(z,t) 2)");
    in_model("k / dz/dt", "(/ k !)E0212");
    in_model("dz/dt^2", "(^ ! 2)E0212");
    in_model("2^dz/dt", "(^ 2 !)E0212");
    in_model("2^-dz/dt", "(^ 2 (neg !))E0212");
    in_model("10 dz/dt", "!E0102");
    in_model("10 dz/du", "10[dz/du]");
    // Outside of models it is always a division.
    tree("dz/dt", "(/ dz dt)");
}

#[test]
fn a_derivative_that_could_be_a_division_is_an_error() {
    let both = "/ for the derivative give `dz` or `dt` another name";
    says(
        "const dt = 1\nmodel M {\n  state z = 0 m\n  let dz = z\n  let a = dz/dt\n  let b = dz / dt\n}",
        &[&format!(
            "E0209 `dz/dt` `dz/dt` can be a derivative or a division (`dz` and `dt` are declared, and so is the state `z`) \
             | for the division write `dz / dt`, with spaces; {both}"
        )],
    );
    says(
        include_str!("data/errors/E0209.fric"),
        &[
            "E0209 `dx/dy` `dx/dy` can be a derivative or a division (`dx` and `dy` are declared, and so are the state `x` and `y`) \
           | for the division write `dx / dy`, with spaces; / for the derivative give `dx` or `dy` another name",
        ],
    );
}

#[test]
fn documentation_belongs_to_its_line_or_to_what_follows() {
    let text = "/// lost\n\n/// One.\n///\n/// Two.\nmodel M { /// three\n  param a = 1 /// of a\n  /// of b\n  param b = 2\n  \
                // of nothing\n  let c = a\n    + b /// of c\n}\n/// e\nexperiment e { run M() }";
    let file = read(text).file;
    let Item::Model(model) = &file.items[0] else { panic!("no model") };
    assert_eq!(model.doc.as_deref(), Some("One.\n\nTwo.\nthree"));
    let docs = model.body.iter().map(|statement| match statement {
        Statement::Declaration(declaration) => declaration.doc.as_deref(),
        other => panic!("{other:?}"),
    });
    assert_eq!(docs.collect::<Vec<_>>(), [Some("of a"), Some("of b"), Some("of c")]);
    let Item::Experiment(experiment) = &file.items[1] else { panic!("no experiment") };
    assert_eq!(experiment.doc.as_deref(), Some("e"));
}

#[test]
fn statements_need_no_line_of_their_own() {
    let text = "model M { state z [m] = 0 dz/dt = v output F [N] = 2 u = 3 x = k next(i) = 4 }";
    let Item::Model(model) = &parse(FileId(0), text).file.items[0] else { panic!("no model") };
    assert_eq!(model.body.len(), 6);
    says(text, &[]);
    says("rig r { rate = 1 N rate 1 ms stop when stop, \"x\" overrun stop overrun hold 2 run = 3 run M() }", &[]);
    says("experiment e { plot run, data.x expect step > 0 data \"a\" (_, x [m]) plot rate run M() }", &[]);
}

#[test]
fn parts_of_a_text_can_be_read_alone() {
    let instance = parse_instance(FileId(0), "rotary LuGre(vd = 10 mm/s, fr = KFM())").0.unwrap();
    assert!(instance.rotary && instance.model.text == "LuGre" && instance.args.len() == 2);
    assert_eq!(parse_path(FileId(0), "fr.Fs").0.unwrap().segments.len(), 2);
    let (path, value) = parse_setting(FileId(0), "fr.Fs=2N").0.unwrap();
    assert_eq!((path.segments.len(), prefix(&value).as_str()), (2, "2[N]"));
    for text in ["", "  ", "LuGre", "a b", "(", "Fs 2", "// a"] {
        let (_, found) = parse_instance(FileId(0), text);
        assert_eq!(found.len(), 1, "{text}");
        assert_eq!(parse_setting(FileId(0), text).1.len(), 1, "{text}");
    }
}

// ---- mistakes

#[test]
fn golden_messages_of_the_reader() {
    says(
        include_str!("data/errors/E0110.fric"),
        &["E0110 `N m` a unit is written without spaces (reads as 2 N, followed by a stray name `m`) \
           | write `2 N·m` (or `2 N*m`). To multiply by a variable `m`, write `2 N * m`"],
    );
    for entry in std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/errors")).unwrap() {
        let path = entry.unwrap().path();
        let text = std::fs::read_to_string(&path).unwrap();
        let codes: Vec<_> = read(&text).diagnostics.iter().map(|diagnostic| diagnostic.code).collect();
        let code = path.file_stem().unwrap().to_str().unwrap();
        let wanted: &[&str] = if matches!(code, "E0110" | "E0209") { &[code] } else { &[] };
        assert_eq!(codes, wanted);
    }
}

#[test]
fn common_slips_get_an_answer_to_paste() {
    model_says("param T [N m] = 2 N", &["E0110 `N m` a unit is written without spaces () | write `[N·m]`"]);
    model_says(
        "let a = if k > 0 then 1",
        &[
            "E0001 `if k > 0 then 1` `if` needs an `else` (`else` is missing after this) | both cases have a value: add `else ...`",
        ],
    );
    model_says(
        "let a = if k > 0 1 else 2",
        &["E0001 `if k > 0` `if` needs a `then` (`then` is missing after this) | write `if k > 0 then a else b`"],
    );
    model_says("require k = 2", &["E0001 `=` a comparison is written `==` (`=` defines) | write `k == 2`"]);
    model_says(
        "let a = if k = 2 then 3 else 4",
        &["E0001 `=` a comparison is written `==` (`=` defines) | write `k == 2`"],
    );
    model_says(
        "let a = max(k, 1",
        &["E0002 `(` this `(` is not closed (no `)` belongs to it) | add `)`, for example `max(k, 1)`"],
    );
    model_says(
        "let a = k + 1)",
        &["E0002 `)` one `)` too many (no `(` belongs to it) | remove it, or add `(` before it"],
    );
    model_says(
        "let a = 1 < k < 2",
        &["E0004 `<` comparisons cannot be chained (a second comparison) | write `1 < k and k < 2`"],
    );
    model_says(
        "dz / dt = k",
        &["E0003 `dz / dt` a derivative is written without spaces (reads as a division) | write `dz/dt = ...`"],
    );
    model_says("der(z) = k", &["E0001 `der(z)` a derivative is written as on paper () | write `dz/dt = ...`"]);
    model_says("let a = der(z)", &["E0001 `der(z)` a derivative is written as on paper () | write `dz/dt`"]);
    model_says("let a = time * 2", &["E0204 `time` there is no `time`: time is called `t` (not declared) | write `t`"]);
    model_says("F == 2", &["E0001 `==` an equation is written with one `=` (compares two values) | write `F = ...`"]);
    model_says("F := 2 + 3", &["E0001 `:=` an equation is written with `=` () | write `F = ...`"]);
    model_says(
        "let a = 1;\nlet b = 2;",
        &[
            "E0001 `;` a statement ends without `;` () | leave out every `;`: the next statement begins with its own head",
        ],
    );
    model_says("var x = 3", &["E0001 `var` `var` begins no statement here (expected `let`) | write `let x`"]);
    model_says(
        "parameter x = 3",
        &["E0001 `parameter` `parameter` begins no statement here (expected `param`) | write `param x`"],
    );
    model_says(
        "let a = 2 k",
        &["E0111 `k` an operator is missing before `k` (reads as a unit) | to multiply write `2 * k`"],
    );
    model_says(
        "let a = 2 sin(k)",
        &["E0111 `sin` an operator is missing before `sin` () | to multiply write `2 * sin(...)`"],
    );
    model_says("let a = k z", &["E0111 `z` an operator is missing before `z` () | to multiply write `k * z`"]);
    model_says("let a = k ** 2", &["E0001 `*` `*` does not fit here () | a power is written `^`"]);
    model_says("let a = k && z", &["E0001 `&` `&` has no place here () | write `and`"]);
    model_says(
        "let mode = 3",
        &["E0001 `mode` `mode` is a word of the language (expected a name) | as a name write for example `mode_`"],
    );
    model_says("input v m/s", &["E0001 `m/s` the unit of a declaration stands in brackets () | write `input v [m/s]`"]);
    model_says("let a = k +", &["E0001 `+` expected a value here (after this)"]);
    model_says(
        "part fr = lugre",
        &["E0001 `lugre` expected `(` here (after this) | write `lugre()`, with arguments in the brackets"],
    );
    model_says(
        "let a = 1e999",
        &["E0001 `1e999` this number is too large (more than 1.8e308) | without a bound write `inf`"],
    );
    says(
        "model lugre { }",
        &["E0001 `lugre` names of models, interfaces and devices begin with a capital letter () | write `Lugre`"],
    );
    says(
        "param x = 3",
        &["E0001 `param` `param` stands inside a model (outside of all items) | for the whole file write `const`"],
    );
    says("model A { } }", &["E0002 `}` one `}` too many () | remove one of the two"]);
}

#[test]
fn ten_mistakes_are_ten_messages_and_the_rest_survives() {
    let bad = [
        "param T = 2 N m",
        "let a = (1",
        "b = 1 +",
        "dx / dt = 3",
        "require b = 2",
        "let c = 1 < 2 < 3",
        "let e = if b then 1",
        "let f = b z",
        "when b { }",
        "part p = lugre",
    ];
    let mut text = "model M {\n".to_string();
    for (number, line) in bad.iter().enumerate() {
        text += &format!("  {line}\n  let good{number} = {number}\n");
    }
    text += "}\nmodel After { }\n";
    let parsed = read(&text);
    let lines: Vec<usize> = parsed
        .diagnostics
        .iter()
        .map(|diagnostic| text[..diagnostic.span().start as usize].matches('\n').count())
        .collect();
    assert_eq!(lines, (1..20).step_by(2).collect::<Vec<_>>(), "{:#?}", say(&text, &parsed.diagnostics));
    let [Item::Model(model), Item::Model(_)] = parsed.file.items.as_slice() else { panic!("no two models") };
    let good = model.body.iter().filter(|statement| {
        matches!(statement, Statement::Declaration(Declaration { name, .. }) if name.text.starts_with("good"))
    });
    assert_eq!(good.count(), 10);
}

#[test]
fn a_missing_brace_is_one_mistake() {
    let whole = include_str!("data/02_kfm.fric");
    for (place, _) in whole.match_indices('}') {
        let text = format!("{}{}", &whole[..place], &whole[place + 1..]);
        let parsed = read(&text);
        assert_eq!(parsed.diagnostics.len(), 1, "{:#?}\n{text}", say(&text, &parsed.diagnostics));
        assert_eq!(parsed.diagnostics[0].code, "E0002");
        assert_eq!(parsed.file.items.len(), read(whole).file.items.len(), "{text}");
    }
}

// ---- texts that nobody would write

/// Reads `text` on a small stack and within a second.
fn survives(text: String) -> Parsed {
    let started = std::time::Instant::now();
    let parsed = std::thread::Builder::new().stack_size(2 << 20).spawn(move || read(&text)).unwrap().join().unwrap();
    // Generous for a slow machine without optimisation; what must not happen is quadratic time.
    assert!(started.elapsed().as_secs() < 20, "{:?}", started.elapsed());
    assert!(parsed.diagnostics.len() <= grammar::parse::DIAGNOSTIC_LIMIT);
    parsed
}

#[test]
fn a_million_brackets_are_one_mistake() {
    // Without optimisation a row of 64 KiB shows the same.
    let size = if cfg!(debug_assertions) { 1 << 16 } else { 1 << 20 };
    for unit in
        ["(", "-", "not ", "if ", "f(", "[", "{", "a^", "1 + (", "d/d", "if a then b else ", "-(", "F(x = ", "}", ")"]
    {
        let row = unit.repeat(size / unit.len());
        for text in [format!("model M {{\n  let a = {row}\n}}\n"), row.clone(), format!("const a = {row}")] {
            // `let a =` before a brace too many is a mistake of its own.
            let wanted = if unit == "}" && text.starts_with("model") { 2 } else { 1 };
            let parsed = survives(text);
            assert_eq!(
                parsed.diagnostics.len(),
                wanted,
                "{unit}: {:?}",
                &parsed.diagnostics[..3.min(parsed.diagnostics.len())]
            );
        }
    }
}

#[test]
fn nesting_is_read_to_its_limit() {
    for (open, middle, close) in [
        ("(", "a", ")"),
        ("f(", "a", ")"),
        ("-(", "a", ")"),
        ("if a then b else ", "c", ""),
        ("(if a then b else ", "c", ")"),
    ] {
        let levels = if open.starts_with("(if") { 128 } else { 256 };
        let text = |n: usize| format!("const x = {}{middle}{}", open.repeat(n), close.repeat(n));
        assert_eq!(survives(text(levels)).diagnostics, [], "{open}");
        assert_eq!(survives(text(levels + 1)).diagnostics.len(), 1, "{open}");
    }
}

#[test]
fn long_sums_are_read_to_their_limit() {
    for operator in [" + ", " * ", " and ", "^"] {
        let text = |n: usize| format!("model M {{ let x = {} }}", vec!["a"; n].join(operator));
        assert_eq!(survives(text(1000)).diagnostics, []);
        let found = survives(text(100_000)).diagnostics;
        assert_eq!(found.len(), 1);
        assert!(found[0].message.contains("more than 1000"), "{found:?}");
    }
}

#[test]
fn odd_texts_are_read() {
    for text in [
        "",
        "\u{feff}",
        "\0",
        "\0\u{1}\u{7f}",
        "\r\n\r\n",
        "\t",
        "//",
        "///",
        "\"",
        "é",
        "\u{202e}",
        "🦀",
        "model M { let 🦀 = 1 }",
    ] {
        read(text);
        parse_expr(FileId(0), text);
    }
    let text = include_str!("data/05_lugre.fric");
    let bare = |text: &str| {
        let parsed = read(text);
        assert_eq!(say(text, &parsed.diagnostics), [""; 0]);
        parsed.file.items.len()
    };
    assert_eq!(bare(&text.replace('\n', "\r\n")), bare(text));
    assert_eq!(bare(&format!("\u{feff}{text}")), bare(text));
    assert_eq!(bare(&text.replace(' ', "\t")), bare(text));
    bare("const a = 2 µm\nconst b = 3 °\nconst c = 4 kΩ\nconst d = 5 N*m\nconst e = 6 Nm\nconst f = 7 N·m");
}

/// A generator; the field is its state, at first the seed.
struct Chance(u64);

impl Chance {
    fn below(&mut self, bound: usize) -> usize {
        random::below(&mut self.0, bound)
    }
}

/// A few changes of tokens or bytes.
fn mutate(text: &str, chance: &mut Chance) -> String {
    let mut text = text.to_string();
    for _ in 0..1 + chance.below(4) {
        let tokens = grammar::tokens::tokens(&text);
        if tokens.is_empty() {
            break;
        }
        let (one, other) = (tokens[chance.below(tokens.len())], tokens[chance.below(tokens.len())]);
        let (a, b) = (one.text(&text).to_string(), other.text(&text).to_string());
        match chance.below(6) {
            0 => text.replace_range(one.start..one.end, ""),
            1 => text.insert_str(one.start, &a),
            2 => text.replace_range(one.start..one.end, &b),
            3 => text.insert_str(one.start, &b),
            4 => {
                let mut bytes = text.into_bytes();
                bytes[chance.below(one.end).max(one.start)] = chance.below(256) as u8;
                text = String::from_utf8_lossy(&bytes).into_owned();
            }
            _ => text.truncate(one.start),
        }
    }
    text
}

#[test]
fn no_mutation_of_a_sample_is_too_much() {
    let rounds = std::env::var("FRIC_MUTATIONS").ok().and_then(|rounds| rounds.parse().ok()).unwrap_or(2000);
    for seed in 0..rounds {
        let mut chance = Chance(seed);
        let text = mutate(SAMPLES[chance.below(SAMPLES.len())].1, &mut chance);
        if std::panic::catch_unwind(|| read(&text)).is_err() {
            panic!("seed {seed}:\n{text}");
        }
    }
}
