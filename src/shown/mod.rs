//! What a panel shows: experiments that run anew at every touch, recordings of rigs, and rigs that run.
//!
//! In: compiled experiments, or a log. Out: a [`Subject`](panel::subject::Subject) each, whose curves, parameters and
//! verdicts the crate `panel` brings to browsers.

mod knob;
mod sheet;
pub mod what_if;
pub mod recording;
pub mod operated;
