//! The stages of a search that have ended, from which an interrupted search goes on.
//!
//! A search is a fixed sequence of stages, each with a result that depends on those before it alone. So one that takes
//! results that have been kept, in their order, and computes the rest ends with the same bits.

use crate::fit::noise::Noise;

/// The result of a stage.
#[derive(Clone, PartialEq, Debug)]
pub struct Stage {
    /// Its numbers, to the bit.
    pub numbers: Vec<f64>,
    /// Causes of failed runs so far, each after its number.
    pub words: Vec<String>,
}

/// Where the results of stages are kept.
pub trait Journal {
    /// The result of the next stage, from an earlier search; none once all have been taken.
    fn next(&mut self) -> Option<Stage>;

    /// Keeps the result of a stage.
    fn note(&mut self, stage: &Stage);
}

/// Reads numbers one after the other.
pub struct Numbers<'a>(pub &'a [f64]);

impl Numbers<'_> {
    /// The next number.
    pub fn one(&mut self) -> Option<f64> {
        let (first, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(*first)
    }

    /// The next so many numbers.
    pub fn some(&mut self, count: usize) -> Option<Vec<f64>> {
        let (some, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(some.to_vec())
    }

    /// A list, after its length.
    pub fn list(&mut self) -> Option<Vec<f64>> {
        let count = self.one()?;
        self.some(count as usize)
    }

    /// A model of noise, as [`of_noise`] writes it.
    pub fn noise(&mut self) -> Option<Noise> {
        let (variance, innovation, bound) = (self.one()?, self.one()?, self.one()?);
        let (coefficients, gaps) = (self.list()?, self.list()?);
        let gaps = gaps.into_iter().map(|row| row as usize).collect();
        Some(Noise { coefficients, variance, innovation, gaps, bound })
    }
}

/// A list as numbers: its length before it.
pub fn of_list(list: &[f64]) -> Vec<f64> {
    [&[list.len() as f64], list].concat()
}

/// A model of noise as numbers.
pub fn of_noise(noise: &Noise) -> Vec<f64> {
    let gaps: Vec<f64> = noise.gaps.iter().map(|row| *row as f64).collect();
    [vec![noise.variance, noise.innovation, noise.bound], of_list(&noise.coefficients), of_list(&gaps)].concat()
}
