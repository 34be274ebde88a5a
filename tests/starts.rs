//! An initial value from outside, in a call, with `--set` or with `--vary`, is equivalent to the same text with that
//! value in the state's declaration, to the bit: over the states of the library's experiments and all methods.
//!
//! Mutants tried by hand, each fails with seed 1: a value in the call is ignored, or one of `--set`; one of `--vary`
//! leaves the initial value as written, or does so for sampled states.
//!
//! `FRIC_SEED`, `FRIC_RUNS` (default 60 states).

mod support;

use abi::description::Kind;
use abi::plan::Method;
use compiler::ir::random::Random;
use compiler::{Changes, Loaded, Options};
use grammar::ast::{DeclarationKind, EveryStatement, ExperimentStatement, Item, Statement};
use runtime::engine::Continue;
use support::{Texts, number};

/// Every state and output at the end as bits, or the error.
type End = Result<Vec<(String, u64)>, String>;

fn loaded(text: &str) -> Loaded {
    compiler::load("a.fric", text, &Texts::default())
}

fn end_of(instance: abi::Instance, experiment: &abi::plan::Experiment) -> End {
    let (instance, outcome) =
        runtime::engine::run_on(instance, experiment, &mut |_| (), &mut |_| Continue::Continue(()));
    outcome.map_err(|failure| failure.to_string())?;
    let kept = |kind| matches!(kind, Kind::State | Kind::SampledState | Kind::Output);
    let quantities = &instance.description().quantities;
    let bits = |q: &abi::description::Quantity| (q.path.clone(), instance.get(q.slot).to_bits());
    Ok(quantities.iter().filter(|q| kept(q.kind)).map(bits).collect())
}

/// The only case of an experiment with changes; an error by its code and message.
fn case(text: &str, name: &str, changes: Changes) -> Result<compiler::Case, String> {
    let options = Options { changes, interpret: true };
    let cases = compiler::compile(&mut loaded(text), &Texts::default(), name, &options, &mut Vec::new(), &mut |_| ());
    let cases =
        cases.map_err(|found| found.iter().map(|d| format!("{} {}; ", d.code, d.message)).collect::<String>())?;
    cases.into_iter().next().ok_or_else(|| "no case".into())
}

fn compiled(text: &str, name: &str, changes: Changes) -> End {
    let case = case(text, name, changes)?;
    end_of(case.instance, &case.experiment)
}

/// As in `fric sweep`, which first assigns a number to an initial value that is computed from others.
fn varied(text: &str, name: &str, path: &str, value: f64, typical: &str, method: Method) -> End {
    let changes = Changes { vary: vec![path.into()], set: vec![format!("{path}={typical}")], ..of(method) };
    let options = Options { changes, interpret: true };
    let cases = compiler::varying(&mut loaded(text), &Texts::default(), name, &options, &mut Vec::new());
    let cases = cases.map_err(|found| format!("{found:?}"))?;
    let param = cases[0].param(path).expect("a state can be varied");
    let fitted = cases[0].at(&[(param.slot, value)])?;
    end_of(fitted.instance, &fitted.experiment)
}

fn of(method: Method) -> Changes {
    let step = (method != Method::Adaptive).then_some(1e-3);
    Changes { method: Some(method), step, duration: Some(0.02), any_step: true, ..Changes::default() }
}

/// The range of a state's initial value in its model, and the offset for an argument of the experiment's `run`.
fn places(loaded: &Loaded, experiment: &str, state: &str) -> Option<(std::ops::Range<usize>, usize)> {
    let ast = &loaded.files.get(loaded.root()).ast;
    let instance = ast.items().find_map(|item| match item {
        Item::Experiment(one) if one.name.text == experiment => one.body.iter().find_map(|statement| match statement {
            ExperimentStatement::Run(run) => Some(&run.instance),
            _ => None,
        }),
        _ => None,
    })?;
    let model = ast.items().find_map(|item| match item {
        Item::Model(model) if model.name.text == instance.model.text => Some(model),
        _ => None,
    })?;
    if instance.args.iter().any(|arg| arg.name.text == state) || instance.rotary {
        return None;
    }
    let declared = model.body.iter().flat_map(|statement| match statement {
        Statement::Declaration(one) => vec![one],
        Statement::Every(every) => every
            .body
            .iter()
            .filter_map(|statement| match statement {
                EveryStatement::Declaration(one) => Some(one),
                EveryStatement::Equation(_) => None,
            })
            .collect(),
        _ => Vec::new(),
    });
    let declaration = declared.into_iter().find(|d| d.kind == DeclarationKind::State && d.name.text == state)?;
    let value = declaration.value.as_ref()?.span;
    let text = &loaded.files.get(loaded.root()).text;
    let open = text[instance.model.span.end as usize..].find('(')? + instance.model.span.end as usize + 1;
    Some((value.start as usize..value.end as usize, open))
}

#[test]
fn an_initial_value_from_outside_equals_one_in_the_text() {
    let (seed, runs) = (number("FRIC_SEED").unwrap_or(1), number("FRIC_RUNS").unwrap_or(60));
    let mut random = Random(seed);
    let texts = support::texts_below(&support::root().join("stdlib-models"));
    let (mut compared, mut refused, mut moved) = (0, 0, 0);
    while compared < runs {
        let (path, text) = &texts[random.below(texts.len())];
        let read = loaded(text);
        let experiments = read.experiments();
        if experiments.is_empty() {
            continue;
        }
        let name = &experiments[random.below(experiments.len())].name;
        let method = Method::ALL[random.below(Method::ALL.len())];
        let Ok(plain) = case(text, name, of(method)) else { continue };
        let description = plain.instance.description().clone();
        let is_state = |kind| matches!(kind, Kind::State | Kind::SampledState);
        let states: Vec<_> = description.quantities.iter().filter(|q| is_state(q.kind) && !q.boolean).collect();
        let top: Vec<_> = states.iter().filter_map(|q| Some((*q, places(&read, name, &q.path)?))).collect();
        if top.is_empty() {
            continue;
        }
        let (state, (value_at, argument_at)) = &top[random.below(top.len())];
        let mut begun = plain.instance.clone();
        begun.start(1e-3);
        let as_written = begun.get(state.slot);
        // Mostly inside the declared range, sometimes outside.
        let (low, high) = state.range;
        let size = if (high - low).is_finite() { 0.6 * (high - low) } else { state.unit.to_si(2.0) };
        let middle = if (high - low).is_finite() { 0.5 * (low + high) } else { 0.0 };
        let number = state.unit.from_si(middle + size * random.within(-1.0, 1.0));
        let value = format!("{number:e} {}", if state.unit.text == "1" { "" } else { &state.unit.text });
        let mut written = text.clone();
        written.replace_range(value_at.clone(), &value);
        let mut called = text.clone();
        called.insert_str(*argument_at, &format!("{} = {value}, ", state.path));
        let set = Changes { set: vec![format!("{}={value}", state.path)], ..of(method) };

        let place = format!("seed {seed}: {} {name}, {} = {value}, {}", path.display(), state.path, method.name());
        let expected = compiled(&written, name, of(method));
        let by_call = compiled(&called, name, of(method));
        let by_set = compiled(text, name, set);
        let typical = format!("{:e} {}", state.unit.from_si(as_written), &value[value.find(' ').unwrap() + 1..]);
        let by_vary = varied(text, name, &state.path, state.unit.to_si(number), &typical, method);
        compared += 1;
        match &expected {
            Ok(end) => {
                assert_eq!(by_call.as_ref(), Ok(end), "at the call, {place}");
                assert_eq!(by_set.as_ref(), Ok(end), "--set, {place}");
                assert_eq!(by_vary.as_ref(), Ok(end), "--vary, {place}");
                moved += u64::from(compiled(text, name, of(method)).as_ref() != Ok(end));
            }
            Err(why) => {
                refused += 1;
                assert_eq!(by_call.as_ref(), Err(why), "at the call, {place}");
                assert_eq!(by_set.as_ref(), Err(why), "--set, {place}");
                assert!(by_vary.is_err(), "--vary, {place}: {why}");
            }
        }
    }
    println!("seed {seed}: {compared} states compared, {moved} with another end, {refused} refused");
    assert!(moved * 2 > compared, "{moved} of {compared} start values matter: nothing is tested");
}

/// In a part of a part, an element of an array, a slot's new model and a rotary twin.
#[test]
fn initial_values_of_nested_states() {
    let text = "
import std.bench
import std.friction
model Cell { param T = 1 s in > 0  state x [m] = 0 in -1 m .. 1 m  dx/dt = -x / T  output o [m] = x }
model Cells {
  param x0 = 3 mm
  part c[i in 1 .. 3] = Cell(x = x0 * i)
  part d = Cell(T = 2 s)
  output s [m] = sum(c.o) + d.o
}
experiment cells { run Cells(x0 = 1 mm) for 1 s }
experiment slot { run ForceBench(u = 0.1 N, fr = LuGre(z = 1 um)) for 1 ms }
experiment turned { run rotary Cell(x = 5 mrad) for 1 ms }
";
    let starts = |name: &str, set: &[&str]| {
        let changes = Changes { set: set.iter().map(|one| one.to_string()).collect(), ..Changes::default() };
        let mut instance = case(text, name, changes).unwrap_or_else(|why| panic!("{why}")).instance;
        instance.start(1e-3);
        let values: Vec<(String, f64)> = instance
            .description()
            .quantities
            .iter()
            .filter(|q| q.kind == Kind::State)
            .map(|q| (q.path.clone(), instance.get(q.slot)))
            .collect();
        move |path: &str| values.iter().find(|(found, _)| found == path).unwrap_or_else(|| panic!("no {path}")).1
    };
    let cells = starts("cells", &[]);
    assert_eq!([cells("c[1].x"), cells("c[2].x"), cells("c[3].x"), cells("d.x")], [1e-3, 2e-3, 3e-3, 0.0]);
    let cells = starts("cells", &["c[2].x=7 mm", "d.x=4 mm", "x0=2 mm"]);
    assert_eq!([cells("c[1].x"), cells("c[2].x"), cells("c[3].x"), cells("d.x")], [2e-3, 7e-3, 6e-3, 4e-3]);
    assert_eq!(starts("slot", &[])("fr.z"), 1e-6);
    assert_eq!(starts("slot", &["fr.z=2 um"])("fr.z"), 2e-6);
    assert_eq!(starts("slot", &["fr=Dahl(z = 3 mN)"])("fr.z"), 3e-3);
    assert_eq!(starts("slot", &["fr=Dahl()"])("fr.z"), 0.0);
    assert_eq!(starts("turned", &[])("x"), 5e-3);
}
