//! Estimates parameters from recordings: maximum likelihood of the output error, with a model of the noise.
//!
//! In: unknowns with their ranges, and a function that runs the model and returns what it computes minus what was
//! measured, row by row. Out: values, intervals, correlations, and what the data do not determine. Knows neither
//! models nor files.

pub mod unknowns;
pub mod quantiles;
pub mod least_squares;
pub mod trust_region;
pub mod loss;
pub mod noise;
pub mod sandwich;
pub mod journal;
pub mod estimate;
pub mod statistics;
pub mod ranking;
pub mod information;
pub mod cma_es;

pub use estimate::{
    Answer, Combination, Estimator, Finer, Item, Minima, Question, Residuals, Rows, Runs, Tile, Trouble, Way, fit,
};
pub use journal::{Journal, Stage};
pub use noise::Noise;
pub use trust_region::{Ended, Limits};
pub use unknowns::{Elementary, Unknown};
