//! The C that `cargo bench --bench abi` measures against (`benches/library/models.c`) is the library of today: each
//! model has C or a reason for having none, the C names ports that the model has, and it makes the same steps.
//!
//! Mutants tried by hand, each fails: a port renamed in the library or in the C, a model renamed, a state or an output
//! missing in the C, another coefficient in the C.

#[path = "../benches/gcc.rs"]
#[allow(dead_code, reason = "the benches use more of it")]
mod gcc;
#[path = "../benches/library/hand.rs"]
#[allow(dead_code, reason = "the bench uses more of it")]
mod hand;
mod support;

use abi::Instance;
use abi::plan::Method;
use compiler::{Changes, NoSources};
use hand::{COMPARED, Hand, LEFT_OUT, Pair};
use std::sync::Arc;

/// The library as one text.
fn library() -> compiler::Loaded {
    let texts = support::texts_below(&support::root().join("stdlib-models"));
    let lines = texts.iter().flat_map(|(_, text)| text.lines()).filter(|line| !line.starts_with("import "));
    compiler::load("library.fric", &lines.map(|line| format!("{line}\n")).collect::<String>(), &NoSources)
}

fn compared(loaded: &mut compiler::Loaded, name: &str, hand: &Hand) -> Result<(), String> {
    let built = compiler::build(loaded, &NoSources, name, &Changes::default(), &mut Vec::new());
    let mut program = built.map_err(|found| format!("{name}: {found:?}"))?.program;
    program.size_rings(hand::step_length(name));
    let functions = compiler::functions(&program, Method::Expo);
    let (code, _) = compiler::code(&functions, &program.description, true);
    let mut ours = Instance::new(Arc::new(program.description), code, &program.params);
    Pair::new(name, hand, &mut ours)?.agrees(&mut ours, COMPARED)
}

#[test]
fn each_model_of_the_library_makes_the_steps_of_its_c() {
    let built = gcc::built("library/models.c");
    let hands = hand::hands(&built);
    let mut loaded = library();
    let models: Vec<String> = loaded.models().iter().map(|model| model.name.text.clone()).collect();
    assert!(models.len() > 90, "the library is read: {models:?}");
    let mut found = Vec::new();
    for name in &models {
        let hand = hands.iter().find(|hand| hand.name() == *name);
        match (hand, LEFT_OUT.iter().any(|(left_out, _)| left_out == name)) {
            (Some(hand), false) => found.extend(compared(&mut loaded, name, hand).err()),
            (None, true) => {}
            (None, false) => found.push(format!("models.c has no C for {name}, and LEFT_OUT no reason")),
            (Some(_), true) => found.push(format!("{name} has C, and a reason in LEFT_OUT for having none")),
        }
    }
    let named = hands.iter().map(|hand| hand.name()).chain(LEFT_OUT.iter().map(|(name, _)| name.to_string()));
    found.extend(named.filter(|name| !models.contains(name)).map(|name| format!("the library has no {name}")));
    assert!(found.is_empty(), "{} differences:\n{}", found.len(), found.join("\n"));
}
