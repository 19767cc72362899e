//! The simulator's scene.

use nalgebra::Vector3;
use numpy::{PyArray1, PyArray2, PyArray3};
use pyo3::prelude::*;

use super::arrays::{Input, owned, owned_rows, points2, points3, vector};
use super::geometry::PyView;
use crate::error::Error;
use crate::simulate::{LAYER_COLUMNS, LIGHTING_COLUMNS, MATERIAL_COLUMNS, PRIMITIVE_COLUMNS, Painting, Scene, Tables};

#[pyclass(frozen, name = "SimulatedScene", module = "colourreg_rs._core")]
struct PyScene(Scene);

type Hits<'py> = (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<i32>>, Bound<'py, PyArray2<f64>>);

#[pymethods]
impl PyScene {
    #[new]
    fn new(
        py: Python<'_>,
        primitives: &Bound<'_, PyAny>,
        primitive_materials: &Bound<'_, PyAny>,
        materials: &Bound<'_, PyAny>,
        layers: &Bound<'_, PyAny>,
        paintings: Vec<Bound<'_, PyAny>>,
        lighting: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let primitives = Input::<f64>::new(primitives, "primitives", &[None, Some(PRIMITIVE_COLUMNS)])?;
        let primitive_materials = Input::<i64>::new(primitive_materials, "primitive_materials", &[None])?;
        let materials = Input::<f64>::new(materials, "materials", &[None, Some(MATERIAL_COLUMNS)])?;
        let layers = Input::<f64>::new(layers, "layers", &[None, Some(LAYER_COLUMNS)])?;
        let lighting = vector::<LIGHTING_COLUMNS>(lighting, "lighting")?;
        let mut painted = Vec::with_capacity(paintings.len());
        for (i, painting) in paintings.iter().enumerate() {
            let name = format!("paintings[{i}]");
            let input = Input::<u8>::new(painting, &name, &[None, None, Some(5)])?;
            let &[height, width, _] = input.shape() else {
                return Err(Error::invalid(format!("{name} is not an image")).into());
            };
            let painting = Painting::new(input.values()?, width, height)
                .ok_or_else(|| Error::invalid(format!("{name} is empty: {width} x {height}")))?;
            painted.push(painting);
        }
        let tables = Tables {
            primitives: primitives.rows()?,
            primitive_materials: primitive_materials.values()?,
            materials: materials.rows()?,
            layers: layers.rows()?,
            lighting: &lighting,
        };
        Ok(Self(py.detach(|| tables.scene(painted))?))
    }

    fn __len__(&self) -> usize {
        self.0.len()
    }

    fn light(&self, py: Python<'_>) {
        py.detach(|| {
            self.0.light_map();
        });
    }

    fn cast<'py>(&self, py: Python<'py>, origin: &Bound<'py, PyAny>, rays: &Bound<'py, PyAny>) -> PyResult<Hits<'py>> {
        let (origin, rays) = (Vector3::from(vector::<3>(origin, "origin")?), points3(rays, "rays")?);
        let rays = rays.rows::<3>()?;
        let (distance, primitive, normal) = py.detach(|| {
            let hits = self.0.cast(&origin, rays);
            (
                hits.iter().map(|h| h.distance).collect(),
                hits.iter().map(|h| h.primitive).collect(),
                hits.iter().map(|h| h.normal.into()).collect(),
            )
        });
        Ok((PyArray1::from_vec(py, distance), PyArray1::from_vec(py, primitive), owned_rows::<f64, 3>(py, normal)?))
    }

    fn sees<'py>(
        &self,
        py: Python<'py>,
        origin: &Bound<'py, PyAny>,
        points: &Bound<'py, PyAny>,
        tolerance: f64,
    ) -> PyResult<Bound<'py, PyArray1<bool>>> {
        let (origin, points) = (Vector3::from(vector::<3>(origin, "origin")?), points3(points, "points")?);
        let points = points.rows::<3>()?;
        Ok(PyArray1::from_vec(py, py.detach(|| self.0.sees(&origin, points, tolerance))))
    }

    fn reflectance<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
        primitives: &Bound<'py, PyAny>,
        footprints: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let points = points3(points, "points")?;
        let points = points.rows::<3>()?;
        let primitives = Input::<i32>::new(primitives, "primitives", &[Some(points.len())])?;
        let footprints = Input::<f64>::new(footprints, "footprints", &[Some(points.len())])?;
        let (primitives, footprints) = (primitives.values()?, footprints.values()?);
        owned_rows(py, py.detach(|| self.0.reflectance(points, primitives, footprints)))
    }

    fn picture<'py>(
        &self,
        py: Python<'py>,
        view: &PyView,
        first_row: usize,
        last_row: usize,
        samples: usize,
    ) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let (width, height) = (view.0.camera.width as usize, view.0.camera.height as usize);
        if first_row > last_row || last_row > height {
            let message = format!("rows {first_row} to {last_row} of a picture of {height} rows");
            return Err(Error::invalid(message).into());
        }
        let rows = first_row..last_row;
        let centre = view.0.pose.centre;
        let light = py.detach(|| self.0.picture(&centre, &|x, y| ray(view, x, y), width, rows, samples));
        owned(py, light.into_flattened(), [last_row - first_row, width, 3])
    }

    fn radiance_at<'py>(
        &self,
        py: Python<'py>,
        view: &PyView,
        xy: &Bound<'py, PyAny>,
        sigma: f64,
        own_surface: bool,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let xy = points2(xy, "xy")?;
        let xy = xy.rows::<2>()?;
        let centre = view.0.pose.centre;
        owned_rows(py, py.detach(|| self.0.radiance_at(&centre, &|x, y| ray(view, x, y), xy, sigma, own_surface)))
    }
}

fn ray(view: &PyView, x: f64, y: f64) -> Option<Vector3<f64>> {
    view.0.ray(&[x, y])
}

pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<PyScene>()
}
