//! Why a plan cannot be used by this build.

use std::fmt;

/// What is wrong with a plan, to follow its name.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Unusable {
    /// It is no plan, or not all of one.
    NotWhole,
    /// Another version wrote it: that, the kind of its plans, and the kind of ours.
    Version(String, u64, u64),
    /// A build of this version wrote it that has another library of models.
    Library,
}

impl Unusable {
    /// The version that wrote the plan, if that is why.
    pub fn written_by(&self) -> Option<&str> {
        match self {
            Unusable::NotWhole => None,
            Unusable::Version(written, ..) => Some(written),
            Unusable::Library => Some(env!("CARGO_PKG_VERSION")),
        }
    }
}

impl fmt::Display for Unusable {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let here = env!("CARGO_PKG_VERSION");
        match self {
            Unusable::NotWhole => {
                f.write_str("is no whole plan of a sweep: `fric sweep FILE EXPERIMENT … --plan NAME` writes one")
            }
            Unusable::Version(written, kind, ours) => write!(
                f,
                "was written by fric {written} (plans of kind {kind}), and this is fric {here} (kind {ours}), whose rows may \
                 differ: install the same version everywhere, or write the plan again"
            ),
            Unusable::Library => write!(
                f,
                "was written by a fric {here} with another library of models: install the same build everywhere, or write the \
                 plan again"
            ),
        }
    }
}
