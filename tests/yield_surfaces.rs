//! Sliders written as people write them, `if abs(k * z) < phi or v * z < 0 then v else 0`, against the stop operator in
//! closed form, over random sliders, motions and tolerances with printed seeds.

#[path = "support/mod.rs"]
mod support;

use compiler::ir::random::Random;
use compiler::{Changes, Options};
use runtime::engine::{Continue, run};
use support::Texts;

/// Ways to write the same slider.
const FORMS: [&str; 5] = [
    "if abs(k * z) < phi or v * z < 0 then v else 0",
    "if abs(k * z) >= phi and v * z > 0 then 0 else v",
    "if abs(z) < phi / k or v * z < 0 then v else 0",
    "if abs(k * z) < phi then v else if v * z < 0 then v else 0",
    "v * (if k * z >= phi and v > 0 or k * z <= -phi and v < 0 then 0 else 1)",
];

/// A motion x(t) as a sum of three sines: amplitudes in m, frequencies in Hz, phases.
struct Motion([(f64, f64, f64); 3]);

impl Motion {
    #[allow(clippy::disallowed_methods, reason = "compared within the tolerance of a run, not to the bit")]
    fn x(&self, t: f64) -> f64 {
        self.0.iter().map(|(a, f, p)| a * ((2.0 * std::f64::consts::PI * f * t + p).sin() - p.sin())).sum()
    }

    fn v(&self) -> String {
        let term =
            |(a, f, p): &(f64, f64, f64)| format!("{a:?} m * 2 * pi * {f:?} Hz * cos(2 * pi * {f:?} Hz * t + {p:?})");
        self.0.iter().map(term).collect::<Vec<_>>().join(" + ")
    }

    /// The stop operator for each of these limits: z follows x and is clamped, exactly so between the turns of x. Errors of
    /// the grid are of second order in its spacing, at the turns only: 1e-12 m at each.
    fn sliders(&self, limits: &[f64], end: f64) -> Vec<f64> {
        const POINTS: usize = 100_000;
        let (mut z, mut before) = (vec![0.0_f64; limits.len()], self.x(0.0));
        for k in 1..=POINTS {
            let x = self.x(end * k as f64 / POINTS as f64);
            z.iter_mut().zip(limits).for_each(|(z, limit)| *z = (*z + x - before).clamp(-limit, *limit));
            before = x;
        }
        z
    }
}

#[test]
fn sliders_follow_the_stop_operator() {
    let number = |name: &str| std::env::var(name).ok().and_then(|text| text.parse::<u64>().ok());
    let first = number("FRIC_SEED").unwrap_or(1);
    let seeds = first..first + number("FRIC_CASES").unwrap_or(60);
    println!("seeds {seeds:?}");
    let sources = Texts::default();
    let mut yielded = 0;
    for seed in seeds {
        let mut random = Random(seed);
        let mut motion = Motion([(0.0, 1.0, 0.0); 3]);
        for part in motion.0.iter_mut().take(1 + random.below(3)) {
            *part = (random.within(2e-6, 2e-5), [1.0, 3.0, 7.0, 10.0][random.below(4)], random.within(0.0, 6.0));
        }
        let limits: Vec<f64> = (0..1 + random.below(5)).map(|_| random.within(1e-6, 2.5e-5)).collect();
        let tol = [1e-5, 1e-6, 1e-7, 1e-8, 1e-9][random.below(5)];
        let mut text = String::from("model Sliders {\n  input v [m/s]\n  param k = 42 N/mm\n");
        for (i, limit) in limits.iter().enumerate() {
            let rate =
                FORMS[random.below(FORMS.len())].replace("phi", &format!("phi{i}")).replace('z', &format!("z{i}"));
            text += &format!("  param phi{i} = {:?} N\n  state z{i} [um] = 0\n  dz{i}/dt = {rate}\n", 42e3 * limit);
            text += &format!("  output f{i} [N] = k * z{i}\n");
        }
        text +=
            &format!("}}\nexperiment e {{\n  run Sliders(v = {}) for 1 s\n  solver adaptive tol {tol:?}\n", motion.v());
        text += &(0..limits.len()).map(|i| format!("  show final(z{i})\n")).collect::<String>();
        text += "}\n";
        let mut loaded = compiler::load("sliders.fric", &text, &sources);
        let options = Options { changes: Changes::default(), interpret: seed % 2 == 0 };
        let cases = compiler::compile(&mut loaded, &sources, "e", &options, &mut Vec::new(), &mut |_| ());
        let case = cases.unwrap_or_else(|found| panic!("seed {seed}: {found:?}\n{text}")).remove(0);
        let outcome = run(case.instance, &case.experiment, &mut |_| Continue::Continue(()));
        let outcome = outcome.unwrap_or_else(|failure| panic!("seed {seed}: {failure}\n{text}"));
        // One more never yields.
        let exact = motion.sliders(&[&limits[..], &[f64::INFINITY]].concat(), 1.0);
        for (i, limit) in limits.iter().enumerate() {
            let z = outcome.verdicts[i].shown.as_ref().unwrap().value;
            let exact_z = exact[i];
            let allowed = 100.0 * tol * limit + 1e-10;
            assert!(
                (z - exact_z).abs() <= allowed,
                "seed {seed}, z{i}: {z:e}, exactly {exact_z:e}, tol {tol:e}\n{text}"
            );
            yielded += u32::from(exact[limits.len()] != exact_z);
        }
    }
    println!("{yielded} sliders yielded");
    assert!(yielded > 20, "{yielded}");
}
