//! A view's covariance carried on: to pixels, check points, the whole photo, surfaces, and the next control point.

use nalgebra::Matrix2;
use numpy::{PyArray1, PyArray2, PyArray3};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::adjustment::view_covariance;
use super::arrays::{Input, Output, owned, owned_rows, points2, points3};
use super::colour::PyLocalPlanes;
use super::geometry::PyView;
use crate::adjustment::{
    Candidate, Criterion, ObjectNoise, RootMeanSquare, ScannerModel, Slopes, SurfaceSigma, check_points, next_points,
    photo_grid, predicted_errors,
};
use crate::error::Error;

fn flat(m: &Matrix2<f64>) -> [f64; 4] {
    [m[(0, 0)], m[(0, 1)], m[(1, 0)], m[(1, 1)]]
}

type Predicted<'py> = (Bound<'py, PyArray2<f64>>, Bound<'py, PyArray3<f64>>);

#[pyfunction]
fn predict<'py>(
    py: Python<'py>,
    view: &PyView,
    names: Vec<String>,
    covariance: &Bound<'py, PyAny>,
    xyz: &Bound<'py, PyAny>,
) -> PyResult<Predicted<'py>> {
    let covariance = view_covariance(view, &names, covariance)?;
    let input = points3(xyz, "xyz")?;
    let points = input.rows::<3>()?;
    let one = |p: &[f64; 3]| match view.0.project_with_jacobian(p) {
        Some(j) => (j.xy, flat(&covariance.pixel_covariance(&view.0, &j))),
        None => ([f64::NAN; 2], [f64::NAN; 4]),
    };
    let (xy, all): (Vec<[f64; 2]>, Vec<[f64; 4]>) = py.detach(|| points.iter().map(one).unzip());
    Ok((owned_rows(py, xy)?, owned(py, all.into_flattened(), [points.len(), 2, 2])?))
}

#[pyfunction]
#[pyo3(signature = (view, names, covariance, depth, columns=25, rows=19))]
fn predicted_error_map<'py>(
    py: Python<'py>,
    view: &PyView,
    names: Vec<String>,
    covariance: &Bound<'py, PyAny>,
    depth: f64,
    columns: usize,
    rows: usize,
) -> PyResult<Bound<'py, PyDict>> {
    let covariance = view_covariance(view, &names, covariance)?;
    let grid = photo_grid(&view.0, columns, rows, true);
    let found = py.detach(|| predicted_errors(&view.0, &covariance, &grid, depth))?;
    let number =
        |f: fn(&crate::adjustment::PredictedError) -> f64| owned(py, found.iter().map(f).collect(), [rows, columns]);
    let out = PyDict::new(py);
    let xy: Vec<f64> = found.iter().flat_map(|p| p.xy).collect();
    out.set_item("xy", owned(py, xy, [rows, columns, 2])?)?;
    let xyz: Vec<f64> = found.iter().flat_map(|p| p.xyz).collect();
    out.set_item("xyz", owned(py, xyz, [rows, columns, 3])?)?;
    let all: Vec<f64> = found.iter().flat_map(|p| flat(&p.covariance)).collect();
    out.set_item("covariance", owned(py, all, [rows, columns, 2, 2])?)?;
    out.set_item("sigma_px", number(|p| p.sigma_px)?)?;
    out.set_item("largest_px", number(|p| p.largest_px)?)?;
    out.set_item("sigma_object", number(|p| p.sigma_object)?)?;
    out.set_item("sigma_angle", number(|p| p.sigma_angle)?)?;
    Ok(out)
}

fn root_mean_square<'py, const D: usize>(py: Python<'py>, r: &RootMeanSquare<D>) -> PyResult<Bound<'py, PyDict>> {
    let out = PyDict::new(py);
    out.set_item("rms", r.rms)?;
    out.set_item("rmse", r.rmse)?;
    out.set_item("axes", r.axes.to_vec())?;
    Ok(out)
}

#[pyfunction]
#[pyo3(name = "check_points", signature = (view, xyz, xy, cov_xyz, cov_xy, *, names=None, covariance=None, scale=1.0, dof=None))]
#[allow(clippy::too_many_arguments, reason = "keywords in Python")]
fn check_points_py<'py>(
    py: Python<'py>,
    view: &PyView,
    xyz: &Bound<'py, PyAny>,
    xy: &Bound<'py, PyAny>,
    cov_xyz: &Bound<'py, PyAny>,
    cov_xy: &Bound<'py, PyAny>,
    names: Option<Vec<String>>,
    covariance: Option<&Bound<'py, PyAny>>,
    scale: f64,
    dof: Option<usize>,
) -> PyResult<Bound<'py, PyDict>> {
    let (xyz, xy) = (points3(xyz, "xyz")?, points2(xy, "xy")?);
    let n = xyz.shape()[0];
    let cov_xyz = Input::<f64>::new(cov_xyz, "cov_xyz", &[Some(n), Some(3), Some(3)])?;
    let cov_xy = Input::<f64>::new(cov_xy, "cov_xy", &[Some(n), Some(2), Some(2)])?;
    let covariance = match (names, covariance) {
        (Some(names), Some(matrix)) => Some(view_covariance(view, &names, matrix)?),
        (None, None) => None,
        _ => return Err(Error::invalid("names and covariance are given together or not at all").into()),
    };
    let (xyz, xy) = (xyz.rows::<3>()?, xy.rows::<2>()?);
    let (cov_xyz, cov_xy) = (cov_xyz.matrices::<3>()?, cov_xy.matrices::<2>()?);
    let report = py.detach(|| check_points(&view.0, covariance.as_ref(), xyz, xy, cov_xyz, cov_xy, scale, dof))?;
    let out = PyDict::new(py);
    out.set_item("residuals", owned_rows(py, report.points.iter().map(|p| p.residual).collect())?)?;
    let all: Vec<f64> = report.points.iter().flat_map(|p| flat(&p.covariance)).collect();
    out.set_item("covariance", owned(py, all, [n, 2, 2])?)?;
    out.set_item("offsets", owned_rows(py, report.points.iter().map(|p| p.offset).collect())?)?;
    out.set_item("statistic", PyArray1::from_iter(py, report.points.iter().map(|p| p.statistic)))?;
    out.set_item("p_value", PyArray1::from_iter(py, report.points.iter().map(|p| p.p_value)))?;
    out.set_item("joint_statistic", report.statistic)?;
    out.set_item("joint_p_value", report.p_value)?;
    out.set_item("pixels", root_mean_square(py, &report.pixels)?)?;
    out.set_item("object", root_mean_square(py, &report.object)?)?;
    Ok(out)
}

#[pyfunction]
#[pyo3(name = "next_points", signature = (view, names, covariance, candidates, cov_xyz, cov_xy, targets, *, criterion="mean", count=1))]
#[allow(clippy::too_many_arguments, reason = "keywords in Python")]
fn next_points_py<'py>(
    py: Python<'py>,
    view: &PyView,
    names: Vec<String>,
    covariance: &Bound<'py, PyAny>,
    candidates: &Bound<'py, PyAny>,
    cov_xyz: &Bound<'py, PyAny>,
    cov_xy: &Bound<'py, PyAny>,
    targets: &Bound<'py, PyAny>,
    criterion: &str,
    count: usize,
) -> PyResult<Bound<'py, PyDict>> {
    let covariance = view_covariance(view, &names, covariance)?;
    let criterion = match criterion {
        "mean" => Criterion::Mean,
        "largest" => Criterion::Largest,
        other => return Err(Error::invalid(format!("criterion {other:?} is neither mean nor largest")).into()),
    };
    let (places, targets) = (points3(candidates, "candidates")?, points3(targets, "targets")?);
    let n = places.shape()[0];
    let cov_xyz = Input::<f64>::new(cov_xyz, "cov_xyz", &[Some(n), Some(3), Some(3)])?;
    let cov_xy = Input::<f64>::new(cov_xy, "cov_xy", &[Some(n), Some(2), Some(2)])?;
    let candidates: Vec<Candidate> = places
        .rows::<3>()?
        .iter()
        .zip(cov_xyz.matrices::<3>()?.iter().zip(cov_xy.matrices::<2>()?))
        .map(|(xyz, (a, b))| Candidate { xyz: *xyz, covariance_xyz: *a, covariance_xy: *b })
        .collect();
    let targets = targets.rows::<3>()?;
    let found = py.detach(|| next_points(&view.0, &covariance, &candidates, targets, criterion, count))?;
    let out = PyDict::new(py);
    let advice = &found.advice;
    out.set_item("candidate", advice.iter().map(|a| a.candidate).collect::<Vec<_>>())?;
    out.set_item("xy", owned_rows(py, advice.iter().map(|a| a.xy).collect())?)?;
    out.set_item("mean_px", owned_rows(py, advice.iter().map(|a| a.mean_px).collect())?)?;
    out.set_item("largest_px", owned_rows(py, advice.iter().map(|a| a.largest_px).collect())?)?;
    out.set_item("candidates_mean_px", PyArray1::from_vec(py, found.mean_px))?;
    out.set_item("candidates_largest_px", PyArray1::from_vec(py, found.largest_px))?;
    Ok(out)
}

#[pyclass(frozen, name = "SurfaceSigma", module = "colourreg_rs._core")]
struct PySurfaceSigma(SurfaceSigma);

#[pymethods]
impl PySurfaceSigma {
    #[new]
    #[pyo3(signature = (view, names, covariance, *, sigma_image, sigma_xyz=0.0, scanner=None))]
    fn new(
        py: Python<'_>,
        view: &PyView,
        names: Vec<String>,
        covariance: &Bound<'_, PyAny>,
        sigma_image: f64,
        sigma_xyz: f64,
        scanner: Option<([f64; 3], f64, f64, f64)>,
    ) -> PyResult<Self> {
        let covariance = view_covariance(view, &names, covariance)?;
        let object = match scanner {
            Some((station, range, h, v)) => ObjectNoise::Scanner(ScannerModel::new(station, range, h, v)?),
            None => ObjectNoise::Isotropic(sigma_xyz),
        };
        Ok(Self(py.detach(|| SurfaceSigma::new(&view.0, &covariance, sigma_image, object))?))
    }

    #[getter]
    fn exact_share(&self) -> f64 {
        self.0.exact_share()
    }

    #[pyo3(signature = (xyz, *, normals=None, planes=None))]
    fn at<'py>(
        &self,
        py: Python<'py>,
        xyz: &Bound<'py, PyAny>,
        normals: Option<&Bound<'py, PyAny>>,
        planes: Option<PyRef<'py, PyLocalPlanes>>,
    ) -> PyResult<Bound<'py, PyArray1<f32>>> {
        let input = points3(xyz, "xyz")?;
        let points = input.rows::<3>()?;
        let normals = normals.map(|n| Input::<f64>::new(n, "normals", &[Some(points.len()), Some(3)])).transpose()?;
        let normals = normals.as_ref().map(Input::rows::<3>).transpose()?;
        let mut out = vec![0.0f32; points.len()];
        let slopes = Slopes { normals, planes: planes.as_ref().map(|p| &p.0) };
        py.detach(|| self.0.fill(points, slopes, &mut out))?;
        Ok(PyArray1::from_vec(py, out))
    }

    fn exact<'py>(
        &self,
        py: Python<'py>,
        xyz: &Bound<'py, PyAny>,
        normals: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let input = points3(xyz, "xyz")?;
        let points = input.rows::<3>()?;
        let normals = normals.map(|n| Input::<f64>::new(n, "normals", &[Some(points.len()), Some(3)])).transpose()?;
        let normals = normals.as_ref().map(Input::rows::<3>).transpose()?;
        let one = |i: usize| self.0.exact(&points[i], normals.map(|n| &n[i]));
        Ok(PyArray1::from_vec(py, py.detach(|| (0..points.len()).map(one).collect())))
    }

    #[pyo3(signature = (xyz, source, number, out, *, normals=None, planes=None))]
    #[allow(clippy::too_many_arguments, reason = "keywords in Python")]
    fn fill_where<'py>(
        &self,
        py: Python<'py>,
        xyz: &Bound<'py, PyAny>,
        source: &Bound<'py, PyAny>,
        number: u16,
        out: &Bound<'py, PyAny>,
        normals: Option<&Bound<'py, PyAny>>,
        planes: Option<PyRef<'py, PyLocalPlanes>>,
    ) -> PyResult<()> {
        let input = points3(xyz, "xyz")?;
        let points = input.rows::<3>()?;
        let n = Some(points.len());
        let source = Input::<u16>::new(source, "source", &[n])?;
        let normals = normals.map(|a| Input::<f64>::new(a, "normals", &[n, Some(3)])).transpose()?;
        let normals = normals.as_ref().map(Input::rows::<3>).transpose()?;
        let mut out = Output::<f32>::new(out, "out", &[n])?;
        let (source, out) = (source.values()?, out.values()?);
        let slopes = Slopes { normals, planes: planes.as_ref().map(|p| &p.0) };
        Ok(py.detach(|| self.0.fill_where(points, slopes, source, number, out))?)
    }
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PySurfaceSigma>()?;
    m.add_function(wrap_pyfunction!(predict, m)?)?;
    m.add_function(wrap_pyfunction!(predicted_error_map, m)?)?;
    m.add_function(wrap_pyfunction!(check_points_py, m)?)?;
    m.add_function(wrap_pyfunction!(next_points_py, m)?)
}
