//! Photos that Pillow would narrow to 8 bits without a word: 16-bit PNG, and the LZW strips of 16-bit TIFF.

use numpy::{PyArray1, PyArray3};
use pyo3::prelude::*;

use super::arrays::{Input, owned};
use crate::Error;

fn broken(error: impl std::fmt::Display) -> Error {
    Error::invalid(error.to_string())
}

fn png16(bytes: &[u8], max_pixels: usize) -> Result<(Vec<u16>, [usize; 3]), Error> {
    let mut decoder = png::Decoder::new(std::io::Cursor::new(bytes));
    decoder.set_transformations(png::Transformations::IDENTITY);
    decoder.set_limits(png::Limits { bytes: max_pixels.saturating_mul(8).max(1 << 20) });
    let mut reader = decoder.read_info().map_err(broken)?;
    let (width, height) = (reader.info().width as usize, reader.info().height as usize);
    if width.saturating_mul(height) > max_pixels {
        return Err(Error::invalid(format!("{width} x {height} pixels are more than {max_pixels}")));
    }
    if reader.info().bit_depth != png::BitDepth::Sixteen {
        return Err(Error::invalid(format!("{:?} bits a channel, not 16", reader.info().bit_depth)));
    }
    let channels = reader.info().color_type.samples();
    let Some(size) = reader.output_buffer_size() else { return Err(Error::invalid("the picture is too large")) };
    if size != width * height * channels * 2 {
        return Err(Error::invalid(format!("{size} bytes are not {width} x {height} x {channels} values")));
    }
    let mut buffer = vec![0; size];
    reader.next_frame(&mut buffer).map_err(broken)?;
    let values = buffer.as_chunks::<2>().0.iter().map(|pair| u16::from_be_bytes(*pair)).collect();
    Ok((values, [height, width, channels]))
}

#[pyfunction]
fn decode_png<'py>(
    py: Python<'py>,
    data: &Bound<'py, PyAny>,
    max_pixels: usize,
) -> PyResult<Bound<'py, PyArray3<u16>>> {
    let data = Input::<u8>::new(data, "data", &[None])?;
    let bytes = data.values()?;
    let (values, shape) = py.detach(|| png16(bytes, max_pixels))?;
    owned(py, values, shape)
}

#[pyfunction]
fn decode_lzw<'py>(py: Python<'py>, data: &Bound<'py, PyAny>, size: usize) -> PyResult<Bound<'py, PyArray1<u8>>> {
    let data = Input::<u8>::new(data, "data", &[None])?;
    let bytes = data.values()?;
    let out = py.detach(|| {
        // A code of 9 bits or more stands for at most 4096 bytes.
        if size / 4096 > bytes.len() {
            return Err(Error::invalid(format!("{} compressed bytes cannot hold {size} bytes", bytes.len())));
        }
        let mut out = vec![0; size];
        let mut decoder = weezl::decode::Decoder::with_tiff_size_switch(weezl::BitOrder::Msb, 8);
        let (mut read, mut written) = (0, 0);
        while written < size {
            let step = decoder.decode_bytes(&bytes[read..], &mut out[written..]);
            read += step.consumed_in;
            written += step.consumed_out;
            match step.status {
                Ok(weezl::LzwStatus::Ok) if step.consumed_in + step.consumed_out > 0 => {}
                Ok(_) if written == size => {}
                Ok(_) => return Err(Error::invalid(format!("the data end after {written} of {size} bytes"))),
                Err(error) => return Err(broken(error)),
            }
        }
        Ok(out)
    })?;
    Ok(PyArray1::from_vec(py, out))
}

/// Adds this module's functions to the Python module.
pub(super) fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(decode_png, m)?)?;
    m.add_function(wrap_pyfunction!(decode_lzw, m)?)?;
    Ok(())
}
