//! Mirror symmetry: moved by −v, an odd friction model returns −F, to the bit.
//!
//! Two runs of one compiled program: its order of evaluation is fixed, so every rounding has its mirror image.

#[path = "../src/project.rs"]
#[allow(dead_code, unused_imports, reason = "the command uses more of it")]
mod project;

mod compile {
    pub use compiler::Sources;
}

use compiler::{Options, load};

/// Odd models of the library. GearEfficiency is not odd by design (the load drives), PositionDependent not because of
/// its ripple, Bristles not because of its random positions.
const ODD: &str = "Coulomb(), CoulombViscous(), StribeckGauss(), StribeckLorentz(), Tustin(), KFM(), KFMSmooth(), \
    KFMSmooth(soft = AtanSign()), KFMSmooth(soft = RootSign()), KFMSmooth(soft = ClampSign()), KFMDwell(), Karnopp(), BlimanSorine(), LuGre(), LuGre(vd = 10 mm/s), Dahl(), ElastoPlastic(), MaxwellSlip(), GMS(), \
    LeuvenModified(), BoucWen(), BrownMcPhee(), Makkar(), BengisuAkay(), Threlfall(), Ambrosio(), Gonthier(), \
    BoPavelescu(), Viscous(), ViscousPowers(), BreakAwayTanh(), Smoothed(), Sticking(), TableFriction(), \
    PointsFriction(), LoadedStribeck(), LoadedLuGre(), LuGreCurve(), LuGreAsymmetric(), BlimanSorine1(), DahlPower(), \
    ResetIntegrator(), Armstrong(), BristleMass(), RateState(), GearM1(), GearM2(), \
    GearM3(F_m = 3 N), GearM4(F_m = 3 N), GearM5(F_m = 3 N), GearM6(F_m = 3 N), MaxwellElement(), Asymmetric(), \
    BittencourtGunnarsson()";

/// Moves every odd model back and forth, and with the opposite sign: one program, its amplitude negated.
fn mirrored(solver: &str, h: f64, steps: u32) {
    let text = format!(
        "import std.interfaces\nimport std.friction\n\
         model Probe {{\n  param A = 2 mm/s\n  part fr : Friction = LuGre(v = chirp(A, 1 Hz, 20 Hz, 2 s))\n  \
         output F [N] = fr.F\n}}\n\
         experiment e {{\n  run Probe() for 2 s\n  solver {solver}\n  sweep fr = {ODD}\n}}\n"
    );
    let mut loaded = load("probe.fric", &text, &project::Disk);
    let (mut warnings, options) = (Vec::new(), Options::default());
    let cases = compiler::compile(&mut loaded, &project::Disk, "e", &options, &mut warnings, &mut |_| ());
    for case in cases.unwrap_or_else(|errors| panic!("{errors:#?}")) {
        let (mut a, mut b) = (case.instance.clone(), case.instance);
        let slot = |path: &str| a.description().quantity(path).expect("the probe has it").slot;
        let (amplitude, force) = (slot("A"), slot("F"));
        b.set(amplitude, -b.get(amplitude));
        a.start(h);
        b.start(h);
        let mut moved = false;
        for step in 0..steps {
            a.advance(1);
            b.advance(1);
            let (one, other) = (a.get(force), -b.get(force));
            assert!(one == other, "{}, {solver}, step {step}: {one:e} and {other:e}", case.label);
            moved |= one != 0.0;
        }
        assert!(moved, "{} never resists", case.label);
    }
}

#[test]
fn odd_models_have_mirror_symmetry() {
    mirrored("expo step 1 ms", 1e-3, 2000);
    mirrored("implicit step 1 ms", 1e-3, 2000);
    mirrored("rk4 step 10 us", 1e-5, 20_000);
}
