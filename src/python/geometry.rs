//! Views, projection and its inverse.

use nalgebra::{Matrix3, Vector3};
use numpy::{PyArray1, PyArray2, PyArray3};
use pyo3::prelude::*;
use pyo3::types::PyType;

use super::arrays::{Input, Output, matrix, owned, owned_rows, points2, points3, vector};
use crate::geometry::{self, Camera, DltParts, Frustum, Model, Pose};

#[pyclass(frozen, name = "View", module = "colourreg_rs._core")]
pub(super) struct PyView(pub geometry::View);

#[pymethods]
impl PyView {
    #[classmethod]
    fn canonical(
        _cls: &Bound<'_, PyType>,
        model: &str,
        width: u32,
        height: u32,
        params: &Bound<'_, PyAny>,
        rotation: &Bound<'_, PyAny>,
        translation: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let params = Input::<f64>::new(params, "params", &[None])?;
        let camera = Camera::new(Model::from_name(model)?, width, height, params.values()?)?;
        let rotation = matrix::<3, 3>(rotation, "rotation")?;
        let pose = Pose::from_rotation_translation(
            Matrix3::from_fn(|i, j| rotation[i][j]),
            Vector3::from(vector::<3>(translation, "translation")?),
        )?;
        Ok(Self(geometry::View::new(camera, pose)))
    }

    fn check_plausible(&self) -> PyResult<()> {
        Ok(self.0.camera.check_plausible()?)
    }

    #[classmethod]
    fn dlt(
        _cls: &Bound<'_, PyType>,
        p: &Bound<'_, PyAny>,
        width: u32,
        height: u32,
        distortion: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let (p, distortion) = (matrix::<3, 4>(p, "P")?, vector::<5>(distortion, "distortion")?);
        Ok(Self(geometry::View::from_dlt(&p, width, height, &distortion)?))
    }

    #[getter]
    fn model(&self) -> &'static str {
        self.0.camera.model().name()
    }

    #[getter]
    fn width(&self) -> u32 {
        self.0.camera.width
    }

    #[getter]
    fn height(&self) -> u32 {
        self.0.camera.height
    }

    #[getter]
    fn params<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_vec(py, self.0.camera.params())
    }

    #[getter]
    fn skew(&self) -> f64 {
        self.0.camera.skew()
    }

    #[getter]
    fn rotation<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let r = &self.0.pose.rotation;
        owned_rows(py, (0..3).map(|i| [r[(i, 0)], r[(i, 1)], r[(i, 2)]]).collect())
    }

    #[getter]
    fn centre<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, self.0.pose.centre.as_slice())
    }

    #[getter]
    fn translation<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, self.0.pose.translation().as_slice())
    }

    #[getter]
    fn max_angle(&self) -> f64 {
        self.0.camera.max_angle()
    }

    fn meets(&self, py: Python<'_>, xyz: &Bound<'_, PyAny>) -> PyResult<bool> {
        let input = points3(xyz, "xyz")?;
        let points = input.rows::<3>()?;
        Ok(py.detach(|| Frustum::new(&self.0, 0.0).meets(points)))
    }

    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f64>>>> {
        self.0.matrix().map(|p| owned_rows(py, p.to_vec())).transpose()
    }
}

type Projected<'py> = (Bound<'py, PyAny>, Bound<'py, PyAny>);

#[pyfunction]
#[pyo3(signature = (view, xyz, *, out_xy=None, out_depth=None))]
fn project<'py>(
    py: Python<'py>,
    view: &PyView,
    xyz: &Bound<'py, PyAny>,
    out_xy: Option<Bound<'py, PyAny>>,
    out_depth: Option<Bound<'py, PyAny>>,
) -> PyResult<Projected<'py>> {
    let input = points3(xyz, "xyz")?;
    let points = input.rows::<3>()?;
    match (out_xy, out_depth) {
        (Some(xy), Some(depth)) => {
            let mut xy_out = Output::<f64>::new(&xy, "out_xy", &[Some(points.len()), Some(2)])?;
            let mut depth_out = Output::<f64>::new(&depth, "out_depth", &[Some(points.len())])?;
            let (rows, values) = (xy_out.rows::<2>()?, depth_out.values()?);
            py.detach(|| geometry::project_into(&view.0, points, rows, values))?;
            Ok((xy, depth))
        }
        (None, None) => {
            // In numpy's own memory, which it asks the system for in large pages: those of a Rust vector are touched one
            // by one, at three times the cost of the arithmetic.
            let xy = PyArray2::<f64>::zeros(py, [points.len(), 2], false).into_any();
            let depth = PyArray1::<f64>::zeros(py, points.len(), false).into_any();
            let mut xy_out = Output::<f64>::new(&xy, "xy", &[Some(points.len()), Some(2)])?;
            let mut depth_out = Output::<f64>::new(&depth, "depth", &[Some(points.len())])?;
            let (rows, values) = (xy_out.rows::<2>()?, depth_out.values()?);
            py.detach(|| geometry::project_into(&view.0, points, rows, values))?;
            drop((xy_out, depth_out));
            Ok((xy, depth))
        }
        _ => Err(pyo3::exceptions::PyValueError::new_err("out_xy and out_depth are given together or not at all")),
    }
}

#[pyfunction]
fn unproject<'py>(py: Python<'py>, view: &PyView, xy: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let input = points2(xy, "xy")?;
    let pixels = input.rows::<2>()?;
    owned_rows(py, py.detach(|| geometry::unproject(&view.0, pixels)))
}

type Jacobians<'py> =
    (Bound<'py, PyArray2<f64>>, Bound<'py, PyArray3<f64>>, Bound<'py, PyArray3<f64>>, Bound<'py, PyArray3<f64>>);

#[pyfunction]
fn project_jacobians<'py>(py: Python<'py>, view: &PyView, xyz: &Bound<'py, PyAny>) -> PyResult<Jacobians<'py>> {
    let input = points3(xyz, "xyz")?;
    let points = input.rows::<3>()?;
    let (n, k) = (points.len(), view.0.camera.model().parameters().len());
    let (xy, d_xyz, d_pose, d_params) = py.detach(|| {
        let mut xy = Vec::with_capacity(n);
        let (mut d_xyz, mut d_pose) = (Vec::with_capacity(6 * n), Vec::with_capacity(12 * n));
        let mut d_params = Vec::with_capacity(2 * k * n);
        for p in points {
            match view.0.project_with_jacobian(p) {
                Some(j) => {
                    xy.push(j.xy);
                    d_xyz.extend(j.d_xyz.iter().flatten());
                    d_pose.extend(j.d_pose.iter().flatten());
                    d_params.extend(j.d_params.iter().flat_map(|row| &row[..k]));
                }
                None => {
                    xy.push([f64::NAN; 2]);
                    d_xyz.extend([f64::NAN; 6]);
                    d_pose.extend([f64::NAN; 12]);
                    d_params.extend(std::iter::repeat_n(f64::NAN, 2 * k));
                }
            }
        }
        (xy, d_xyz, d_pose, d_params)
    });
    Ok((
        owned_rows(py, xy)?,
        owned(py, d_xyz, [n, 2, 3])?,
        owned(py, d_pose, [n, 2, 6])?,
        owned(py, d_params, [n, 2, k])?,
    ))
}

type Decomposition<'py> =
    (Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<f64>>, Bound<'py, PyArray1<f64>>, Bound<'py, PyArray2<f64>>);

#[pyfunction]
fn decompose_dlt<'py>(py: Python<'py>, p: &Bound<'py, PyAny>) -> PyResult<Decomposition<'py>> {
    let parts = DltParts::from_matrix(&matrix::<3, 4>(p, "P")?)?;
    let rows = |m: &Matrix3<f64>| (0..3).map(|i| [m[(i, 0)], m[(i, 1)], m[(i, 2)]]).collect::<Vec<_>>();
    Ok((
        owned_rows(py, rows(&parts.calibration))?,
        owned_rows(py, rows(&parts.rotation))?,
        PyArray1::from_slice(py, parts.centre.as_slice()),
        owned_rows(py, parts.scaled.to_vec())?,
    ))
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyView>()?;
    m.add_function(wrap_pyfunction!(project, m)?)?;
    m.add_function(wrap_pyfunction!(unproject, m)?)?;
    m.add_function(wrap_pyfunction!(project_jacobians, m)?)?;
    m.add_function(wrap_pyfunction!(decompose_dlt, m)?)
}
