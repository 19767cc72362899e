//! What can go wrong, by kind, each with the values that show it.

/// The result of everything in the core that can fail.
pub type Result<T> = std::result::Result<T, Error>;

/// Why a computation was refused or did not end.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// The caller's values cannot be worked with: a wrong size, a value that is not finite, an impossible camera.
    #[error("{0}")]
    InvalidInput(String),

    /// The values are in order, but do not determine what was asked for.
    #[error("{what}: {quantity} is {value:.3e}, the limit is {limit:.3e}; {remedy}")]
    Degenerate {
        /// What cannot be determined.
        what: String,
        /// The name of the figure that says so.
        quantity: &'static str,
        /// The figure.
        value: f64,
        /// What it would have to reach, or stay below.
        limit: f64,
        /// What the user can do about it.
        remedy: &'static str,
    },

    /// An iteration ended without an answer that can be trusted.
    #[error("{what} did not converge in {iterations} iterations: {detail}")]
    NotConverged {
        /// The iteration.
        what: &'static str,
        /// How many steps it was given.
        iterations: usize,
        /// The figures it ended with.
        detail: String,
    },

    /// A defect of this library.
    #[error("internal error, please report it: {0}")]
    Internal(String),
}

impl Error {
    /// An [`Error::InvalidInput`] from anything that can be a string.
    pub fn invalid(message: impl Into<String>) -> Self {
        Self::InvalidInput(message.into())
    }
}
