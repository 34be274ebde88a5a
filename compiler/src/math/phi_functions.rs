//! The φ-functions of exponential integrators: φ(q) = (e^q − 1)/q and φ2(q) = (e^q − 1 − q)/q², for q ≤ 0.
//!
//! In: the product q of step length and rate constant of a relaxing state. Out: both functions, before elementary
//! functions are expanded.
//!
//! Source: Hochbruck, Ostermann, *Exponential integrators*, Acta Numerica 2010, sec. 2.1.

use super::polynomial;
use crate::ir::Unary;
use crate::ir::expr::Real;

/// φ2 on −1/2 ≤ q ≤ 0; error 2^-56.
const NEAR: [f64; 11] = [
    0.5,
    0.16666666666666666,
    0.04166666666666657,
    0.008333333333326714,
    0.0013888888887191144,
    0.00019841269619958116,
    2.4801570708685034e-05,
    2.7556560284190343e-06,
    2.7535758041413485e-07,
    2.4679326789245743e-08,
    1.7245982496880484e-09,
];

/// φ(q) within 2 ulp and φ2(q) within 8 ulp, for q ≤ 0. NaN stays NaN.
pub fn phis(q: Real) -> [Real; 2] {
    // Near 0, φ comes from the series of φ2. Elsewhere both come from the exponential, which is then far from 1, so
    // that the differences do not cancel.
    let near = q.above(-0.5);
    let series = polynomial(q, &NEAR);
    let phi = (q.of(Unary::Exp) - 1.0) / q;
    let phi2 = (phi - 1.0) / q;
    [near.choose(q.fma(series, 1.0), phi), near.choose(series, phi2)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::build::Build;
    use crate::ir::expr::Shared;
    use crate::ir::interpret::run_once;
    use crate::math::{POOL, expand};
    use abi::Slot;

    #[test]
    fn both_against_their_definitions() {
        let build = Shared::new(Build::new("phis"));
        let q = Real::new(&build, build.borrow_mut().load(Slot(3)));
        let [phi, phi2] = phis(q).map(|x| x.value);
        let mut build = build.into_inner();
        build.store(Slot(4), phi);
        build.store(Slot(5), phi2);
        let func = expand(&build.finish());
        let at = |q: f64| {
            let mut block = [0.0, 0.0, 0.0, q, 0.0, 0.0];
            run_once(&func, &mut block, &POOL);
            [block[4], block[5]]
        };
        assert_eq!(at(0.0), [1.0, 0.5]);
        assert_eq!(at(f64::NEG_INFINITY), [0.0, 0.0]);
        assert!(at(f64::NAN).iter().all(|x| x.is_nan()));
        for k in 1..200_000 {
            let q = -f64::from(k).powi(2) * 1e-9;
            let [phi, phi2] = at(q);
            let exact = core_math::expm1(q) / q;
            assert!((phi - exact).abs() <= 4.0 * f64::EPSILON * exact, "φ({q}) = {phi} and not {exact}");
            // The Taylor series, with enough terms.
            let mut series = 0.0;
            for n in (2..40).rev() {
                series = (1.0 + series * q) / f64::from(n);
            }
            let exact2 = if q > -1.0 { series } else { (exact - 1.0) / q };
            assert!((phi2 - exact2).abs() <= 8.0 * f64::EPSILON * exact2, "φ2({q}) = {phi2} and not {exact2}");
        }
    }
}
