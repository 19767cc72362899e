//! Nearest neighbours.

use std::sync::{Mutex, MutexGuard};

use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;
use rayon::prelude::*;

use super::arrays::{Input, owned, points2, points3};
use crate::error::{Error, Result};
use crate::memory::fresh;
use crate::neighbours::{Approach, NONE, Neighbour, Neighbours, Within};

enum Index {
    Plane(Neighbours<2>),
    Space(Neighbours<3>),
}

#[pyclass(frozen, name = "Neighbours", module = "colourreg_rs._core")]
pub(super) struct PyNeighbours(Index);

/// Indices with −1 where there is no neighbour, and distances.
fn columns(found: &[Neighbour]) -> (Vec<i64>, Vec<f64>) {
    let (mut index, mut distance) = (fresh(found.len()), fresh(found.len()));
    let one = |((i, d), n): ((&mut i64, &mut f64), &Neighbour)| {
        *i = if n.index == NONE { -1 } else { i64::from(n.index) };
        *d = n.distance2.sqrt();
    };
    index.par_iter_mut().zip(distance.par_iter_mut()).zip(found).with_min_len(8192).for_each(one);
    (index, distance)
}

/// Runs one of the core's batch searches, whatever the dimension.
macro_rules! search {
    ($self:expr, $py:expr, $queries:expr, |$index:ident, $rows:ident| $search:expr) => {
        match &$self.0 {
            Index::Plane($index) => {
                let input = points2($queries, "queries")?;
                let $rows = input.rows::<2>()?;
                $py.detach(|| $search)
            }
            Index::Space($index) => {
                let input = points3($queries, "queries")?;
                let $rows = input.rows::<3>()?;
                $py.detach(|| $search)
            }
        }
    };
}

type Column<'py> = (Bound<'py, PyArray1<i64>>, Bound<'py, PyArray1<f64>>);
type Rows<'py> = (Bound<'py, PyArray2<i64>>, Bound<'py, PyArray2<f64>>);
type Lists<'py> = (Bound<'py, PyArray1<i64>>, Bound<'py, PyArray1<i64>>, Bound<'py, PyArray1<f64>>);

#[pymethods]
impl PyNeighbours {
    #[new]
    fn new(py: Python<'_>, points: &Bound<'_, PyAny>) -> PyResult<Self> {
        let plane: bool = points.getattr("shape").is_ok_and(|s| s.extract::<(usize, usize)>().is_ok_and(|s| s.1 == 2));
        if plane {
            let input: Input<'_, f64> = points2(points, "points")?;
            let rows = input.rows::<2>()?;
            return Ok(Self(Index::Plane(py.detach(|| Neighbours::new(rows))?)));
        }
        let input = points3(points, "points")?;
        let rows = input.rows::<3>()?;
        Ok(Self(Index::Space(py.detach(|| Neighbours::new(rows))?)))
    }

    fn __len__(&self) -> usize {
        match &self.0 {
            Index::Plane(index) => index.len(),
            Index::Space(index) => index.len(),
        }
    }

    #[pyo3(signature = (queries, max_distance=f64::INFINITY))]
    fn nearest<'py>(&self, py: Python<'py>, queries: &Bound<'py, PyAny>, max_distance: f64) -> PyResult<Column<'py>> {
        let (index, distance) = search!(self, py, queries, |index, rows| {
            index.nearest(rows, max_distance).map(|found| columns(&found))
        })?;
        Ok((PyArray1::from_vec(py, index), PyArray1::from_vec(py, distance)))
    }

    #[pyo3(signature = (queries, k, max_distance=f64::INFINITY))]
    fn k_nearest<'py>(
        &self,
        py: Python<'py>,
        queries: &Bound<'py, PyAny>,
        k: usize,
        max_distance: f64,
    ) -> PyResult<Rows<'py>> {
        let (index, distance) = search!(self, py, queries, |index, rows| {
            index.k_nearest(rows, k, max_distance).map(|found| columns(&found))
        })?;
        let n = index.len() / k;
        Ok((owned(py, index, [n, k])?, owned(py, distance, [n, k])?))
    }

    fn within<'py>(&self, py: Python<'py>, queries: &Bound<'py, PyAny>, max_distance: f64) -> PyResult<Lists<'py>> {
        let found: Result<Within> = search!(self, py, queries, |index, rows| index.within(rows, max_distance));
        let Within { offsets, neighbours } = found?;
        let (index, distance) = columns(&neighbours);
        let offsets = offsets.into_iter().map(|o| o as i64).collect();
        Ok((PyArray1::from_vec(py, offsets), PyArray1::from_vec(py, index), PyArray1::from_vec(py, distance)))
    }
}

#[pyclass(frozen, name = "Approach", module = "colourreg_rs._core")]
pub(super) struct PyApproach(Mutex<Approach>);

impl PyApproach {
    fn lock(&self) -> Result<MutexGuard<'_, Approach>> {
        self.0.lock().map_err(|_| Error::Internal("a thread panicked while adding".into()))
    }
}

#[pymethods]
impl PyApproach {
    #[new]
    fn new(places: &Bound<'_, PyAny>) -> PyResult<Self> {
        let input = points3(places, "places")?;
        Ok(Self(Mutex::new(Approach::new(input.rows::<3>()?)?)))
    }

    fn add(&self, py: Python<'_>, xyz: &Bound<'_, PyAny>) -> PyResult<()> {
        let input = points3(xyz, "xyz")?;
        let points = input.rows::<3>()?;
        py.detach(|| {
            self.lock()?.add(points);
            Ok(())
        })
    }

    fn distances<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        Ok(PyArray1::from_vec(py, self.lock()?.distances()))
    }

    fn spacings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        Ok(PyArray1::from_vec(py, self.lock()?.spacings()))
    }
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyNeighbours>()?;
    m.add_class::<PyApproach>()
}
