//! What a panel shows and obeys: the one trait between the server and a simulation, a recording, or a rig.

use crate::frame::Frame;
use crate::line::View;
use serde_json::Value;

/// A page that is connected.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Page {
    /// Its number, from 1, in the order of coming.
    pub number: u64,
    /// It came through the link for others: it looks, and may stop a rig.
    pub guest: bool,
}

/// Something that a panel shows. All methods are called from several threads, and none may wait for long.
pub trait Subject: Send + Sync {
    /// What does not change while it is shown: its name, signals, plots, parameters; and its number, which changes when
    /// this does. Every viewer gets it again then.
    fn hello(&self) -> (u64, Value);

    /// What changes now and then, such as the values of parameters and verdicts, and its number.
    fn state(&self) -> (u64, Value);

    /// The numbers of both, without making them: they are asked for with every frame.
    fn numbers(&self) -> (u64, u64);

    /// A number that grows whenever any curve changes.
    fn version(&self) -> u64;

    /// The end of the data, s.
    fn newest(&self) -> f64;

    /// Appends the curves of a view that have changed after version `since`; all of them if none.
    fn blocks(&self, view: &View, since: Option<u64>, frame: &mut Frame);

    /// Calls `each` with the points of a curve from one instant on, s, in its unit and in the order of time, with one
    /// point before it, until it returns false.
    fn points(&self, curve: u32, from: f64, each: &mut dyn FnMut(f64, f64) -> bool);

    /// Obeys the words of a page; those of a guest are `stop`.
    ///
    /// # Errors
    /// Why not.
    fn say(&self, page: Page, words: &str) -> Result<String, String>;

    /// A page shows that it is there, at least once a second.
    fn here(&self, _page: Page) {}

    /// A page has drawn a picture.
    fn drew(&self, _page: Page) {}

    /// A page has gone.
    fn left(&self, _page: Page) {}
}
