//! Ctrl-C: the only file that knows ctrlc.

/// Calls `handler` at each Ctrl-C from now on. Set once for the process: a second call, and a system without signals, change
/// nothing.
pub fn on_interrupt(handler: impl FnMut() + Send + 'static) {
    let _ = ctrlc::set_handler(handler);
}
