//! The Python module `colourreg_rs._core`: a list of what it holds. Wrappers only; the work is done in the core.

mod adjustment;
mod arrays;
mod backproject;
mod codecs;
mod colour;
mod colour_sigma;
mod dlt;
mod errors;
mod estimation;
mod files;
mod geometry;
mod icp;
mod matching;
mod neighbours;
mod render;
mod render_sci;
mod similarity;
mod simulate;

use pyo3::prelude::*;

#[pymodule]
fn _core(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add("__version__", env!("CARGO_PKG_VERSION"))?;
    m.add("debug_build", cfg!(debug_assertions))?;
    errors::register(m)?;
    codecs::register(m)?;
    files::register(m)?;
    geometry::register(m)?;
    backproject::register(m)?;
    adjustment::register(m)?;
    colour_sigma::register(m)?;
    render::register(m)?;
    render_sci::register(m)?;
    colour::register(m)?;
    simulate::register(m)?;
    estimation::register(m)?;
    dlt::register(m)?;
    matching::register(m)?;
    icp::register(m)?;
    neighbours::register(m)?;
    similarity::register(m)?;
    Ok(())
}
