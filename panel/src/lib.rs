//! The operator's panel: a page in the browser, and the server beside it.
//!
//! In: a [`Subject`](subject::Subject), such as a simulation that changes under the hand or a recording, and
//! connections of browsers. Out: a page, curves thinned to the pixels of each viewer, and lines for the subject. Knows
//! neither the language nor the compiler; opens no file, and no connection to anywhere else.

pub mod key;
pub mod words;
pub mod frame;
pub mod history;
pub mod thin;
pub mod line;
pub mod subject;
pub mod page;
pub mod report;
mod http;
mod viewer;
pub mod server;
