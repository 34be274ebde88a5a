//! A contact that is moved with a known velocity, and noise: what fits are tried on.

use std::f64::consts::{PI, TAU};

/// SplitMix64.
pub struct Chance(pub u64);

impl Chance {
    pub fn fraction(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    pub fn normal(&mut self) -> f64 {
        let (a, b) = (1.0 - self.fraction(), self.fraction());
        (-2.0 * a.ln()).sqrt() * (TAU * b).cos()
    }
}

/// Names, units and true values of the contact.
pub const CONTACT: [(&str, &str, f64); 6] = [
    ("sigma0", "N/m", 1e5),
    ("sigma1", "N·s/m", 316.0),
    ("sigma2", "N·s/m", 0.4),
    ("Fc", "N", 1.0),
    ("Fs", "N", 1.5),
    ("vs", "m/s", 1e-3),
];

/// Force of a LuGre contact that is moved with a known velocity: slow and small, then faster, with a vibration, at
/// 1 kHz for 4 s. The velocity is linear between rows, and the bristle has twenty exact steps from row to row.
pub fn moved() -> Vec<(f64, f64, f64)> {
    let velocity = |t: f64| {
        let slow = if t < 1.0 {
            TAU * 4.0 * 4e-6 * (TAU * 4.0 * t).cos()
        } else if t < 2.0 {
            2e-3 * (TAU * 2.0 * t).sin()
        } else {
            50e-3 * (PI * (t - 2.0)).sin()
        };
        slow + TAU * 60.0 * 1e-6 * (TAU * 60.0 * t).cos()
    };
    let [sigma0, sigma1, sigma2, fc, fs, vs] = CONTACT.map(|(_, _, value)| value);
    let rate = |v: f64| sigma0 * v.abs() / (fc + (fs - fc) * (-(v / vs) * (v / vs)).exp());
    let (h, parts, mut z) = (1e-3, 20, 0.0);
    let mut rows = Vec::new();
    for k in 0..=4000 {
        let (t, v) = (f64::from(k) * h, velocity(f64::from(k) * h));
        rows.push((t, v, sigma0 * z + sigma1 * (v - rate(v) * z) + sigma2 * v));
        let next = velocity(f64::from(k + 1) * h);
        for i in 0..parts {
            let v = v + (next - v) * (f64::from(i) + 0.5) / f64::from(parts);
            let (a, h) = (rate(v), h / f64::from(parts));
            z = if a * h > 1e-12 { z * (-a * h).exp() + v * (-(-a * h).exp_m1()) / a } else { z + v * h };
        }
    }
    rows
}
