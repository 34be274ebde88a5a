//! Adaptive runs: a stiff and an explicit method of order five, dense output, events, ticks.
//!
//! In: a model with derivatives and, where it has them, its Jacobian, switching surfaces, transitions and sampled
//! blocks. Out: its points, passed to an observer. [`linear`] solves small linear systems and [`sparse`] large ones;
//! [`jacobian`] estimates eigenvalues; [`rosenbrock`], [`fused`] and [`explicit`] compute one [`Step`](step::Step)
//! each; [`history`] stores delayed quantities; [`surfaces`] locates crossings of switching surfaces; [`points`]
//! selects the points to show; and [`adaptive`] drives the run.

pub(crate) mod linear;
pub(crate) mod sparse;
pub(crate) mod jacobian;
pub(crate) mod history;
pub(crate) mod step;

pub(crate) mod explicit;
pub(crate) mod fused;
pub(crate) mod rosenbrock;

pub(crate) mod points;
pub(crate) mod surfaces;

pub(crate) mod adaptive;

#[cfg(test)]
mod order;
#[cfg(test)]
mod runs;
