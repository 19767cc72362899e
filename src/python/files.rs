//! What reading and writing files leaves to the core: rows of bytes, and the LZF decompression.

use numpy::PyArray1;
use pyo3::prelude::*;

use super::arrays::{Input, Output, vector};
use crate::lzf;
use crate::records::{self, Column};

#[pyfunction]
fn scaled_xyz<'py>(
    py: Python<'py>,
    records: &Bound<'py, PyAny>,
    scale: &Bound<'py, PyAny>,
    offset: &Bound<'py, PyAny>,
    out: &Bound<'py, PyAny>,
) -> PyResult<()> {
    let records = Input::<u8>::new(records, "records", &[None, None])?;
    let (scale, offset) = (vector::<3>(scale, "scale")?, vector::<3>(offset, "offset")?);
    let (rows, length, bytes) = (records.shape()[0], records.shape()[1], records.values()?);
    let mut out = Output::<f64>::new(out, "out", &[Some(rows), Some(3)])?;
    let xyz = out.rows::<3>()?;
    py.detach(|| records::scaled_xyz(bytes, length, scale, offset, xyz))?;
    Ok(())
}

#[pyfunction]
fn patch_records<'py>(
    py: Python<'py>,
    records: &Bound<'py, PyAny>,
    split: usize,
    gap: usize,
    columns: Vec<(usize, Bound<'py, PyAny>)>,
    out: &Bound<'py, PyAny>,
) -> PyResult<()> {
    let records = Input::<u8>::new(records, "records", &[None, None])?;
    let (length, bytes) = (records.shape()[1], records.values()?);
    let inputs = columns
        .iter()
        .map(|(at, values)| Ok((*at, Input::<u8>::new(values, "columns", &[None, None])?)))
        .collect::<PyResult<Vec<_>>>()?;
    let columns = inputs
        .iter()
        .map(|(at, input)| Ok(Column { at: *at, width: input.shape()[1], values: input.values()? }))
        .collect::<PyResult<Vec<_>>>()?;
    let mut out = Output::<u8>::new(out, "out", &[None, None])?;
    let new_length = out.shape()[1];
    let new = out.values()?;
    py.detach(|| records::patch(bytes, length, split, gap, &columns, new_length, new))?;
    Ok(())
}

#[pyfunction]
fn lzf_decompress<'py>(py: Python<'py>, data: &Bound<'py, PyAny>, size: usize) -> PyResult<Bound<'py, PyArray1<u8>>> {
    let data = Input::<u8>::new(data, "data", &[None])?;
    let bytes = data.values()?;
    Ok(PyArray1::from_vec(py, py.detach(|| lzf::decompress(bytes, size))?))
}

/// Adds this module's functions to the Python module.
pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(scaled_xyz, m)?)?;
    m.add_function(wrap_pyfunction!(patch_records, m)?)?;
    m.add_function(wrap_pyfunction!(lzf_decompress, m)?)?;
    Ok(())
}
