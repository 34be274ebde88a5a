//! The operator's panel: a page in the browser, and the server beside it.
//!
//! In: a [`Subject`](subject::Subject), such as a simulation that changes under the hand, a recording or a rig, and
//! connections of browsers. Out: a page, curves thinned to the pixels of each viewer, and lines for the subject. Knows
//! neither the language nor the compiler; opens no file but logs, and no connection to anywhere else.

pub mod key;
pub mod words;
pub mod frame;
pub mod history;
pub mod thin;
pub mod measures;
pub mod line;
pub mod subject;
pub mod rows;
pub mod page;
pub mod report;
mod http;
mod viewer;
pub mod server;
pub mod knob;
pub mod sheet;
pub mod twin;
pub mod steady;
pub mod recording;
pub mod follow;
pub mod operated;
