//! The only place that calls the compiler.

use std::sync::Arc;

/// A text that was read.
pub struct SourceFile {
    /// As shown.
    pub name: String,
    /// Its characters.
    pub text: Arc<str>,
}
