//! Control points of one photo for the benches of the estimators: seeded, all over the photo, 5 to 35 m away, with noise of
//! 0.5 px, and blunders anywhere in the photo.
#![allow(dead_code, reason = "each bench uses its part")]

use colourreg::geometry::{Camera, Model, Pose, View, rotation_exp};
use nalgebra::Vector3;

/// The photo's size.
pub const SIZE: (u32, u32) = (6000, 4000);

/// A linear congruential generator: the same numbers on every machine.
pub struct Uniform(pub u64);

impl Uniform {
    /// In (0, 1).
    pub fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }
}

/// A camera with distortion at map coordinates.
pub fn view(distorted: bool) -> View {
    let d = if distorted { 1.0 } else { 0.0 };
    let params = [4200.0, 4200.0, 2999.5, 1999.5, -0.05 * d, 0.01 * d, 5e-4 * d, -3e-4 * d, 0.0];
    let camera = Camera::new(Model::OpenCv, SIZE.0, SIZE.1, &params).unwrap();
    let rotation = rotation_exp(&Vector3::new(0.2, -0.3, 0.1));
    View::new(camera, Pose { rotation, centre: Vector3::new(4.5e5, 5.8e6, 120.0) })
}

/// `n` points and their pixels, of which every `1 / blunders`th is a blunder.
pub fn points(view: &View, n: usize, blunders: f64) -> (Vec<[f64; 3]>, Vec<[f64; 2]>) {
    let mut random = Uniform(7);
    let anywhere =
        move |random: &mut Uniform| [f64::from(SIZE.0) * random.next() - 0.5, f64::from(SIZE.1) * random.next() - 0.5];
    (0..n)
        .map(|_| {
            let pixel = anywhere(&mut random);
            let depth = 5.0 + 30.0 * random.next();
            let xyz: [f64; 3] = (view.pose.centre + view.ray(&pixel).unwrap() * depth).into();
            let measured = if random.next() < blunders {
                anywhere(&mut random)
            } else {
                pixel.map(|v| v + 0.5 * 3.46 * (random.next() - 0.5))
            };
            (xyz, measured)
        })
        .unzip()
}
