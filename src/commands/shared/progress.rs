//! The progress bar of long commands, on the standard error of a terminal.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// A bar of so many steps, or none that is visible. `rest`: what stands after the bar, as indicatif's template.
pub fn bar(steps: u64, rest: &str, quiet: bool) -> Bar {
    let target = if quiet { ProgressDrawTarget::hidden() } else { ProgressDrawTarget::stderr() };
    let bar = ProgressBar::with_draw_target(Some(steps), target);
    if let Ok(style) = ProgressStyle::with_template(&format!("  {{bar:40}} {rest}")) {
        bar.set_style(style.progress_chars("━╸ "));
    }
    Bar(bar)
}

/// A progress bar.
pub struct Bar(ProgressBar);

impl Bar {
    /// Draws it at a step.
    pub fn at(&self, step: u64) {
        self.0.set_position(step);
    }

    /// Removes it.
    pub fn clear(&self) {
        self.0.finish_and_clear();
    }
}
