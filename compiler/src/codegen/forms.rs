//! The forms of code that a function may need, and the settings of a compilation.

use crate::codegen::outline::Lengths;
use abi::Layout;

/// A form of code for a function.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Form {
    /// One iteration, for callers that make one step a call.
    Single,
    /// One iteration of a function that changes nothing it reads, however often it is called for.
    Once,
    /// Any number of iterations.
    Loop,
    /// Any number of iterations of a long function.
    Long,
    /// Many steps, with a leading loop for what depends on time alone.
    Distributed,
}

/// Settings of a compilation.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// When functions are outlined.
    pub lengths: Lengths,
    /// Names of passes to leave out: for measurements.
    pub off: Vec<String>,
}

impl Options {
    /// All passes but one.
    pub fn without(name: &str) -> Options {
        let mut options = Options { off: vec![name.into()], ..Options::default() };
        if name == "outline" {
            options.lengths.max_function = usize::MAX;
        }
        options
    }
}

/// What a pass may know besides the graph.
#[derive(Clone, Copy)]
pub struct Context<'a> {
    /// The layout of the blocks. None in images: their callers may write parameters at any time and reserve no memory after
    /// the block.
    pub layout: Option<&'a Layout>,
    /// The settings.
    pub options: &'a Options,
}
