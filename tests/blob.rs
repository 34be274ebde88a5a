//! Compiled models as files: a loaded model runs bit-identical to one compiled in memory, and an unsuitable file is
//! refused.

mod support;

use abi::Instance;
use abi::image::{Image, Refusal, Target};
use abi::plan::Method;
use compiler::codegen::image::image;
use compiler::{Changes, experiment, functions};
use runtime::image::{Model, load};
use support::Texts;

const SERVO: &str = "import std.interfaces
import std.friction
import std.control
import std.plant

experiment hunting {
  run    Servo(r = 1 m) for 1 s
  solver rk4 step 10 us
  plot x
}
";

/// The servo as an image for a target, and as an instance in memory.
fn servo(target: Target) -> (Image, Instance) {
    let sources = Texts::default();
    let mut loaded = compiler::load("servo.fric", SERVO, &sources);
    let changes = Changes { method: Some(Method::Expo), step: Some(1e-5), any_step: true, ..Changes::default() };
    let variants = experiment::read(&mut loaded, &sources, "hunting", &changes, &mut Vec::new(), &mut |_| ());
    let program = variants.expect("the servo compiles").remove(0).program;
    let functions = functions(&program, Method::Expo);
    let image = image(&functions, &program.description, &program.params, target, &[]).expect("code for any target");
    let (code, notes) = compiler::code(&functions, &program.description, false);
    assert_eq!(notes, [""; 0]);
    (image, Instance::new(program.description.clone().into(), code, &program.params))
}

fn loaded(image: &Image) -> Result<Model, Refusal> {
    // SAFETY: the compiler has just made it.
    unsafe { load(&image.to_bytes()) }
}

fn here() -> Target {
    Target::here().expect("tests run where code is made for")
}

#[test]
fn a_loaded_model_runs_bit_identical_to_a_compiled_one() {
    let (image, mut compiled) = servo(here());
    let model = loaded(&image).unwrap();
    assert_eq!(*model.description, **compiled.description());
    let mut found = model.instance();
    assert_eq!([found.start(1e-5), compiled.start(1e-5)], [0, 0]);
    assert_eq!([found.advance(20_000), compiled.advance(20_000)], [0, 0]);
    let bits = |instance: &Instance| instance.block().iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    assert_eq!(bits(&found), bits(&compiled));
    assert!(found.get(found.description().quantity("x").unwrap().slot) > 1e-3, "the servo moves");
}

#[test]
fn equal_models_give_equal_bytes() {
    for target in Target::ALL {
        assert_eq!(servo(target).0.to_bytes(), servo(target).0.to_bytes());
    }
}

#[test]
fn an_unsuitable_image_is_refused() {
    let (image, _) = servo(here());
    let mut bytes = image.to_bytes();
    let middle = bytes.len() - image.code.len() / 2;
    bytes[middle] ^= 0x10;
    // SAFETY: it is refused before anything in it runs.
    assert_eq!(unsafe { load(&bytes) }.err(), Some(Refusal::Changed));
    let other = Target::ALL.into_iter().find(|target| *target != here()).unwrap();
    let refusal = loaded(&servo(other).0).err().unwrap();
    assert_eq!(refusal, Refusal::Target { made_for: other });
}
