//! Handling of Ctrl-C: the only file that uses the ctrlc crate.

/// Calls `handler` at each Ctrl-C from now on. Can be set once per process: a second call, and a call on a system
/// without signals, has no effect.
pub fn on_interrupt(handler: impl FnMut() + Send + 'static) {
    let _ = ctrlc::set_handler(handler);
}
