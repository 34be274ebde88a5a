//! Adaptive runs: a stiff and an explicit method of order five, dense output, events, ticks.
//!
//! In: a model that offers derivatives, and if it can its Jacobian, switching surfaces, transitions and sampled
//! blocks. Out: its points, shown to an observer. [`linear`] solves small systems, [`sparse`] large ones, [`jacobian`] says
//! how fast a model is, [`rosenbrock`], [`fused`] and [`explicit`] make one [`Step`](step::Step) each, [`history`] keeps what is delayed, [`surfaces`] finds where one
//! crosses a switching surface,
//! [`points`] shows it, and [`adaptive`] chooses and joins steps.

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
