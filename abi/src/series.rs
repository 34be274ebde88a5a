//! Methods, solver settings and recorded series, which experiments and rigs share.

use crate::description::Slot;
use crate::unit::Unit;

/// What is known of a method of time integration.
pub struct MethodRow {
    /// Name after the keyword `solver`.
    pub name: &'static str,
    /// Number in files, which never changes.
    pub code: u8,
    /// Order: halving the step divides the error by 2^order. For adaptive runs, that of the estimate.
    pub order: u32,
    /// Length of its steps.
    pub steps: Steps,
}

/// How a method chooses its steps.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Steps {
    /// All are equally long, and explicit: too long a step for a fast state is unstable.
    Explicit,
    /// All are equally long. Linear states that relax are stable for any step.
    Relaxing,
    /// As long as the tolerance permits.
    Adaptive,
}

macro_rules! methods {
    ($($case:ident { name: $name:literal, code: $code:literal, order: $order:literal, steps: $steps:ident })*) => {
        /// A method of time integration.
        #[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
        #[allow(missing_docs)]
        pub enum Method { $($case),* }

        impl Method {
            /// All methods.
            pub const ALL: [Method; [$($name),*].len()] = [$(Method::$case),*];

            /// Its row of the table.
            pub fn row(self) -> &'static MethodRow {
                match self {
                    $(Method::$case => &MethodRow {
                        name: $name,
                        code: $code,
                        order: $order,
                        steps: Steps::$steps,
                    }),*
                }
            }
        }
    };
}

methods! {
    Euler { name: "euler", code: 0, order: 1, steps: Explicit }
    Rk4 { name: "rk4", code: 1, order: 4, steps: Explicit }
    Expo { name: "expo", code: 2, order: 2, steps: Relaxing }
    Implicit { name: "implicit", code: 3, order: 2, steps: Relaxing }
    Adaptive { name: "adaptive", code: 4, order: 2, steps: Adaptive }
}

impl Method {
    /// The name after the keyword `solver`.
    pub fn name(self) -> &'static str {
        self.row().name
    }

    /// The method with this name.
    pub fn named(name: &str) -> Option<Method> {
        Method::ALL.into_iter().find(|method| method.name() == name)
    }

    /// Whether all its steps are equally long.
    pub fn is_fixed(self) -> bool {
        self.row().steps != Steps::Adaptive
    }

    /// The methods with steps of fixed length.
    pub fn fixed() -> impl Iterator<Item = Method> + Clone {
        Method::ALL.into_iter().filter(|method| method.is_fixed())
    }

    /// Names of methods for messages.
    pub fn list(methods: impl IntoIterator<Item = Method>) -> String {
        methods.into_iter().map(Method::name).collect::<Vec<_>>().join(", ")
    }
}

/// The solver of an experiment.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Solver {
    /// The method.
    pub method: Method,
    /// Fixed step in s; 0 for an adaptive run.
    pub step: f64,
    /// Relative tolerance of an adaptive run.
    pub tol: f64,
    /// Minimum number of parts of an adaptive run: no step is longer than the duration divided by it.
    pub parts: f64,
}

/// Default for [`Solver::parts`].
pub const PARTS: f64 = 50.0;

/// A plotted or recorded quantity.
#[derive(Clone, PartialEq, Debug)]
pub struct Series {
    /// As written: `body.v`.
    pub label: String,
    /// Slot of its value after a step, in SI.
    pub slot: Slot,
    /// The unit in which it is displayed.
    pub unit: Unit,
    /// Whether it is a Boolean.
    pub boolean: bool,
}
