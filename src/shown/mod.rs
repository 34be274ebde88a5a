//! What a panel shows of a text: experiments that run anew at every touch.
//!
//! In: compiled experiments. Out: a [`Subject`](panel::subject::Subject), whose curves, parameters and verdicts the crate
//! `panel` brings to browsers, as it does those of rigs.

mod slots;
mod typed;
pub mod what_if;
