//! The only map from the core's errors to Python's exceptions.

use pyo3::create_exception;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;

use crate::error::Error;

create_exception!(colourreg_rs._core, ColourregError, PyException, "The base of every error of colourreg.");
create_exception!(colourreg_rs._core, InvalidInputError, ColourregError, "The values given cannot be worked with.");
create_exception!(colourreg_rs._core, DegenerateError, ColourregError, "The values do not determine what was asked.");
create_exception!(colourreg_rs._core, NotConvergedError, ColourregError, "An iteration ended without a result.");
create_exception!(colourreg_rs._core, InternalError, ColourregError, "A defect of colourreg.");

impl From<Error> for PyErr {
    fn from(error: Error) -> Self {
        let message = error.to_string();
        match error {
            Error::InvalidInput(_) => InvalidInputError::new_err(message),
            Error::Degenerate { .. } => DegenerateError::new_err(message),
            Error::NotConverged { .. } => NotConvergedError::new_err(message),
            Error::Internal(_) => InternalError::new_err(message),
        }
    }
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = m.py();
    m.add("ColourregError", py.get_type::<ColourregError>())?;
    m.add("InvalidInputError", py.get_type::<InvalidInputError>())?;
    m.add("DegenerateError", py.get_type::<DegenerateError>())?;
    m.add("NotConvergedError", py.get_type::<NotConvergedError>())?;
    m.add("InternalError", py.get_type::<InternalError>())
}
