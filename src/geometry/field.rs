//! What part of the plane at depth one a camera that looks forward images.

use super::view::View;

/// Places on each side of the photo that are looked at.
const STEPS: u32 = 64;
/// What is added at the border, as a part of the field.
const MARGIN: f64 = 0.02;

/// The photo's border in (X, Y)/Z with a margin: the smallest and the largest of both. For cameras whose depth is along the
/// axis.
pub fn forward_field(view: &View) -> ([f64; 2], [f64; 2]) {
    let (width, height) = (f64::from(view.camera.width), f64::from(view.camera.height));
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for i in 0..=STEPS {
        let t = f64::from(i) / f64::from(STEPS);
        let (x, y) = (t * width - 0.5, t * height - 0.5);
        for pixel in [[x, -0.5], [x, height - 0.5], [-0.5, y], [width - 0.5, y], [x, 0.5 * height]] {
            let Some(d) = view.camera.unproject(&pixel).filter(|d| d.z > 0.0) else { continue };
            for (axis, value) in [d.x / d.z, d.y / d.z].into_iter().enumerate() {
                low[axis] = low[axis].min(value);
                high[axis] = high[axis].max(value);
            }
        }
    }
    // Where the photo reaches beyond the lens's field, the field's edge is the border.
    let edge = view.camera.max_angle().tan().clamp(0.0, 1e3);
    for axis in 0..2 {
        if low[axis] >= high[axis] {
            (low[axis], high[axis]) = (-edge, edge);
        }
        let margin = MARGIN * (high[axis] - low[axis]);
        (low[axis], high[axis]) = (low[axis] - margin, high[axis] + margin);
    }
    (low, high)
}
