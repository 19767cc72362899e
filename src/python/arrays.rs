//! The only place that looks at how numpy arrays lie in memory.
//!
//! Inputs are borrowed under numpy's read-only guard, outputs are owned vectors that move out: nothing is copied. The
//! facade makes arrays C-contiguous float64 once; here they are only checked, and refused with name, dtype and shape.

use numpy::{
    Element, PyArray, PyArray1, PyArrayDescrMethods, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn,
    PyReadwriteArrayDyn, PyUntypedArray, PyUntypedArrayMethods, dtype, ndarray::Dimension,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;

/// What is wrong with the layout of an argument, if anything. `None` in `shape` stands for any number.
fn check<T: Element>(array: &Bound<'_, PyAny>, name: &str, shape: &[Option<usize>]) -> PyResult<()> {
    let wanted = || {
        let sizes: Vec<String> = shape.iter().map(|n| n.map_or("N".into(), |n| n.to_string())).collect();
        format!("a C-contiguous {} array of shape ({})", dtype::<T>(array.py()), sizes.join(", "))
    };
    let Ok(untyped) = array.cast::<PyUntypedArray>() else {
        let kind = array.get_type().name()?;
        return Err(PyTypeError::new_err(format!("{name} must be {}, not {kind}", wanted())));
    };
    let found = || format!("{} of shape {:?}", untyped.dtype(), untyped.shape());
    if !untyped.dtype().is_equiv_to(&dtype::<T>(array.py())) {
        return Err(PyTypeError::new_err(format!("{name} must be {}, not {}", wanted(), found())));
    }
    let fits =
        untyped.ndim() == shape.len() && untyped.shape().iter().zip(shape).all(|(a, b)| b.is_none_or(|b| *a == b));
    if !fits {
        return Err(PyValueError::new_err(format!("{name} must be {}, not {}", wanted(), found())));
    }
    if !untyped.is_c_contiguous() {
        return Err(PyValueError::new_err(format!(
            "{name} must be {}; this one is strided or in Fortran order",
            wanted()
        )));
    }
    Ok(())
}

/// A borrowed array whose layout was checked.
pub(super) struct Input<'py, T: Element>(PyReadonlyArrayDyn<'py, T>);

impl<'py, T: Element> Input<'py, T> {
    /// Checks dtype, shape and C order; `None` in `shape` stands for any number.
    pub fn new(array: &Bound<'py, PyAny>, name: &str, shape: &[Option<usize>]) -> PyResult<Self> {
        check::<T>(array, name, shape)?;
        let typed = array.cast::<PyArrayDyn<T>>().map_err(PyErr::from)?;
        typed.try_readonly().map(Self).map_err(|e| PyValueError::new_err(format!("{name}: {e}")))
    }

    /// All values in C order.
    pub fn values(&self) -> PyResult<&[T]> {
        self.0.as_slice().map_err(|e| PyValueError::new_err(e.to_string()))
    }

    /// Rows of a fixed length.
    pub fn rows<const N: usize>(&self) -> PyResult<&[[T; N]]> {
        Ok(self.values()?.as_chunks::<N>().0)
    }

    /// Square matrices, one after the other.
    pub fn matrices<const N: usize>(&self) -> PyResult<&[[[T; N]; N]]> {
        Ok(self.rows::<N>()?.as_chunks::<N>().0)
    }

    /// The shape.
    pub fn shape(&self) -> &[usize] {
        self.0.shape()
    }
}

/// Whether an argument is an array of this dtype, where two are possible.
pub(super) fn holds<T: Element>(array: &Bound<'_, PyAny>) -> bool {
    array.cast::<PyUntypedArray>().is_ok_and(|a| a.dtype().is_equiv_to(&dtype::<T>(array.py())))
}

/// (N, 3) float64.
pub(super) fn points3<'py>(array: &Bound<'py, PyAny>, name: &str) -> PyResult<Input<'py, f64>> {
    Input::new(array, name, &[None, Some(3)])
}

/// (N, 2) float64.
pub(super) fn points2<'py>(array: &Bound<'py, PyAny>, name: &str) -> PyResult<Input<'py, f64>> {
    Input::new(array, name, &[None, Some(2)])
}

/// A small float64 matrix of a fixed shape, by value.
pub(super) fn matrix<const R: usize, const C: usize>(array: &Bound<'_, PyAny>, name: &str) -> PyResult<[[f64; C]; R]> {
    let input = Input::<f64>::new(array, name, &[Some(R), Some(C)])?;
    let rows = input.rows::<C>()?;
    Ok(std::array::from_fn(|i| rows[i]))
}

/// A small float64 vector of a fixed length, by value.
pub(super) fn vector<const N: usize>(array: &Bound<'_, PyAny>, name: &str) -> PyResult<[f64; N]> {
    let input = Input::<f64>::new(array, name, &[Some(N)])?;
    let values = input.values()?;
    Ok(std::array::from_fn(|i| values[i]))
}

/// An array of the caller's that is written into.
pub(super) struct Output<'py, T: Element>(PyReadwriteArrayDyn<'py, T>);

impl<'py, T: Element> Output<'py, T> {
    /// Checks dtype, shape, C order, and that it can be written and is not borrowed elsewhere.
    pub fn new(array: &Bound<'py, PyAny>, name: &str, shape: &[Option<usize>]) -> PyResult<Self> {
        check::<T>(array, name, shape)?;
        let typed = array.cast::<PyArrayDyn<T>>().map_err(PyErr::from)?;
        typed.try_readwrite().map(Self).map_err(|e| PyValueError::new_err(format!("{name}: {e}")))
    }

    /// The shape.
    pub fn shape(&self) -> &[usize] {
        self.0.shape()
    }

    /// All values in C order.
    pub fn values(&mut self) -> PyResult<&mut [T]> {
        self.0.as_slice_mut().map_err(|e| PyValueError::new_err(e.to_string()))
    }

    /// Rows of a fixed length.
    pub fn rows<const N: usize>(&mut self) -> PyResult<&mut [[T; N]]> {
        Ok(self.values()?.as_chunks_mut::<N>().0)
    }
}

/// A vector becomes an array of the given shape; its memory moves, nothing is copied.
pub(super) fn owned<'py, T: Element, D: Dimension>(
    py: Python<'py>,
    values: Vec<T>,
    shape: impl numpy::ndarray::IntoDimension<Dim = D>,
) -> PyResult<Bound<'py, PyArray<T, D>>> {
    PyArray1::from_vec(py, values).reshape(shape)
}

/// Rows of a fixed length become an (N, R) array; nothing is copied.
pub(super) fn owned_rows<'py, T: Element, const R: usize>(
    py: Python<'py>,
    rows: Vec<[T; R]>,
) -> PyResult<Bound<'py, numpy::PyArray2<T>>> {
    let n = rows.len();
    owned(py, rows.into_flattened(), [n, R])
}
