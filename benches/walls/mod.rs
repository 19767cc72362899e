//! What the benches of points and pixels share: walls at four distances, scanned in columns, before a camera of 12 MP.
#![allow(dead_code, reason = "not every bench uses all of it")]

use colourreg::geometry::{Camera, Model, Pose, View};

const COLUMNS: usize = 2310;
const ROWS: usize = 1730;

/// The camera, with distortion.
pub fn view() -> View {
    let params = [2900.0, 2900.0, 1999.5, 1499.5, -0.05, 0.01, 5e-4, -3e-4, 0.001];
    View::new(Camera::new(Model::OpenCv, 4000, 3000, &params).unwrap(), Pose::identity())
}

/// Four million points, each nearer wall before a part of the farther ones, in the order of the scan.
pub fn points() -> Vec<[f64; 3]> {
    (0..COLUMNS * ROWS)
        .map(|i| {
            let x = -0.72 + 1.44 * (i / ROWS) as f64 / COLUMNS as f64;
            let y = -0.54 + 1.08 * (i % ROWS) as f64 / ROWS as f64;
            let z = 8.0 + 6.0 * ((9.0 * (x + 0.72)) as usize % 4) as f64 + 0.2 * (20.0 * y).floor();
            [x * z, y * z, z]
        })
        .collect()
}

/// Every point once, in an order that no cache follows.
pub fn shuffled(points: &[[f64; 3]]) -> Vec<[f64; 3]> {
    let (n, step) = (points.len(), 1_234_577);
    (0..n).map(|i| points[(i * step) % n]).collect()
}
