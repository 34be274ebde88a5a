//! Mirror symmetry: moved by −v, an odd friction model answers −F, to the bit.
//!
//! Two runs of one compiled program: its order of evaluation is one, so every rounding has its mirror image.

#[path = "../src/project.rs"]
#[expect(dead_code, reason = "the command uses more of it")]
mod project;

mod compile {
    pub use compiler::Sources;
}

use abi::Instance;
use compiler::{Options, load};

/// Odd models of the library. GearEfficiency is not odd by design (the load drives), PositionDependent not by its ripple.
const ODD: &str = "Coulomb(), CoulombViscous(), StribeckGauss(), StribeckLorentz(), Tustin(), KFM(), KFMSmooth(), \
    Karnopp(), BlimanSorine(), LuGre(), LuGre(vd = 10 mm/s), Dahl(), ElastoPlastic(), MaxwellSlip(), GMS(), \
    LeuvenModified(), BoucWen(), Gonthier(), BrownMcPhee(), Makkar(), BengisuAkay(), Threlfall(), Ambrosio()";

/// The cases of an experiment that moves every odd model by `v`.
fn moved(v: &str, solver: &str) -> Vec<(String, Instance)> {
    let text = format!(
        "import std.interfaces\nimport std.friction\n\
         model Probe {{\n  input v [m/s]\n  part fr : Friction = LuGre(v = v)\n  output F [N] = fr.F\n}}\n\
         experiment e {{\n  run Probe(v = {v}) for 2 s\n  solver {solver}\n  sweep fr = {ODD}\n}}\n"
    );
    let mut loaded = load("probe.fric", &text, &project::Disk);
    let (mut warnings, options) = (Vec::new(), Options::default());
    let cases = compiler::compile(&mut loaded, &project::Disk, "e", &options, &mut warnings, &mut |_| ());
    let cases = cases.unwrap_or_else(|errors| panic!("{errors:#?}"));
    cases.into_iter().map(|case| (case.label, case.instance)).collect()
}

fn mirrored(solver: &str, h: f64, steps: u32) {
    let plus = moved("chirp(2 mm/s, 1 Hz, 20 Hz, 2 s)", solver);
    let minus = moved("-chirp(2 mm/s, 1 Hz, 20 Hz, 2 s)", solver);
    for ((label, mut a), (_, mut b)) in plus.into_iter().zip(minus) {
        let slot = a.description().quantity("F").expect("the probe has an output F").slot;
        (a.start(h), b.start(h));
        let mut moved = false;
        for step in 0..steps {
            (a.advance(1), b.advance(1));
            let (one, other) = (a.get(slot), -b.get(slot));
            assert!(one == other, "{label}, {solver}, step {step}: {one:e} and {other:e}");
            moved |= one != 0.0;
        }
        assert!(moved, "{label} never resists");
    }
}

#[test]
fn odd_models_answer_in_mirror_image() {
    mirrored("expo step 1 ms", 1e-3, 2000);
    mirrored("implicit step 1 ms", 1e-3, 2000);
    mirrored("rk4 step 10 us", 1e-5, 20_000);
}
