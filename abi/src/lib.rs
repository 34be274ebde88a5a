//! The interface of a compiled model: the contract between the compiler, which generates code, and the runtime, which
//! runs it.
//!
//! All numbers of a model are in one flat block of `f64`, addressed by [`Slot`]s. Every function of the model reads and
//! writes that block and nothing else. Knows neither the language nor any solver.

/// Declares a type of functions in compiled code. On x86-64 they have the calling convention of the System V ABI, on
/// Windows too: the code is the same on all systems.
macro_rules! compiled {
    ($(#[$attribute:meta])* pub type $name:ident = fn($($argument:ident: $type:ty),*);) => {
        $(#[$attribute])*
        #[cfg(not(all(windows, target_arch = "x86_64")))]
        pub type $name = unsafe extern "C" fn($($argument: $type),*) -> u64;

        $(#[$attribute])*
        #[cfg(all(windows, target_arch = "x86_64"))]
        pub type $name = unsafe extern "sysv64" fn($($argument: $type),*) -> u64;
    };
}

pub mod random;
pub mod unit;
pub mod format;
pub mod foreign;
pub mod description;
pub mod rosenbrock;
pub mod lanes;
pub mod rows;
pub mod distributed_step;
pub mod follow;
pub mod table;
pub mod series;
pub mod instance;
pub mod rig;
pub mod plan;
pub mod encode;
pub mod rig_encoding;
pub mod live;
pub mod image;
pub mod fits;

pub use description::{Description, Layout, Slot};
pub use instance::{Instance, Slice};
pub use table::{Code, Function};
