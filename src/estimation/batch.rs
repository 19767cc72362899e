//! Eight points at a time through a camera with polynomial distortion: what the searches and the usual fits spend their
//! time on.
//!
//! The loops over lanes become vector instructions: two lanes wide on any x86-64, four where the machine has AVX2, which
//! is asked once. No fused operations: the bits are the same either way.

use crate::geometry::View;

/// Points in a batch.
pub(super) const LANES: usize = 8;

type Lane = [f64; LANES];

/// Eight points: X, Y, Z, x, y. Places beyond the last point are NaN.
#[derive(Debug, Clone, Copy)]
pub(super) struct Batch {
    world: [Lane; 3],
    pixel: [Lane; 2],
}

/// Points in batches.
pub(super) fn batches(xyz: &[[f64; 3]], xy: &[[f64; 2]]) -> Vec<Batch> {
    let one = |(p, q): (&[[f64; 3]], &[[f64; 2]])| {
        let mut batch = Batch { world: [[f64::NAN; LANES]; 3], pixel: [[f64::NAN; LANES]; 2] };
        for (i, (p, q)) in p.iter().zip(q).enumerate() {
            for k in 0..3 {
                batch.world[k][i] = p[k];
            }
            for k in 0..2 {
                batch.pixel[k][i] = q[k];
            }
        }
        batch
    };
    xyz.chunks(LANES).zip(xy.chunks(LANES)).map(one).collect()
}

/// A view with its numbers spread out; `None` for cameras without a polynomial.
#[derive(Debug, Clone, Copy)]
pub(super) struct FlatView {
    r: [f64; 9],
    c: [f64; 3],
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    skew: f64,
    k: [f64; 8],
    max_r2: f64,
    rational: bool,
}

/// Sums of the normal equations of a pose over some batches.
#[derive(Debug, Clone, Copy)]
pub(super) struct PoseSums {
    /// The upper triangle of JᵀJ, row by row.
    pub n: [f64; 21],
    /// Jᵀv.
    pub g: [f64; 6],
    /// vᵀv.
    pub cost: f64,
    /// Points that the view sees.
    pub visible: usize,
}

impl FlatView {
    pub fn new(view: &View) -> Option<Self> {
        let (k, max_r2) = view.camera.polynomial()?;
        let [fx, fy, cx, cy] = view.camera.affine();
        let m = &view.pose.rotation;
        let r = std::array::from_fn(|i| m[(i / 3, i % 3)]);
        let rational = k[5..] != [0.0; 3];
        Some(Self { r, c: view.pose.centre.into(), fx, fy, cx, cy, skew: view.camera.skew(), k, max_r2, rational })
    }

    /// The squared distance, px², between projected and measured pixel of each point; infinite where not visible.
    #[inline]
    pub fn squares(&self, batch: &Batch) -> Lane {
        #[cfg(target_arch = "x86_64")]
        if has_avx2() {
            // SAFETY: the machine has AVX2.
            return unsafe { self.squares_avx2(batch) };
        }
        self.squares_any(batch)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn squares_avx2(&self, batch: &Batch) -> Lane {
        self.squares_any(batch)
    }

    #[inline(always)]
    fn squares_any(&self, batch: &Batch) -> Lane {
        if self.rational { self.squares_of::<true>(batch) } else { self.squares_of::<false>(batch) }
    }

    #[inline(always)]
    fn squares_of<const RATIONAL: bool>(&self, batch: &Batch) -> Lane {
        let [dx, dy] = self.differences_of::<RATIONAL>(batch, f64::INFINITY);
        std::array::from_fn(|i| dx[i] * dx[i] + dy[i] * dy[i])
    }

    /// Projected minus measured pixel of each point, px; NaN where not visible.
    #[inline]
    pub fn differences(&self, batch: &Batch) -> [Lane; 2] {
        #[cfg(target_arch = "x86_64")]
        if has_avx2() {
            // SAFETY: the machine has AVX2.
            return unsafe { self.differences_avx2(batch) };
        }
        self.differences_any(batch)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn differences_avx2(&self, batch: &Batch) -> [Lane; 2] {
        self.differences_any(batch)
    }

    #[inline(always)]
    fn differences_any(&self, batch: &Batch) -> [Lane; 2] {
        if self.rational {
            self.differences_of::<true>(batch, f64::NAN)
        } else {
            self.differences_of::<false>(batch, f64::NAN)
        }
    }

    /// `unseen` is what points get that are not visible.
    #[inline(always)]
    fn differences_of<const RATIONAL: bool>(&self, batch: &Batch, unseen: f64) -> [Lane; 2] {
        let mut out = [[0.0; LANES]; 2];
        for i in 0..LANES {
            let [px, py, pz] = self.camera_point(batch, i);
            let iz = 1.0 / pz;
            let (x, y) = (px * iz, py * iz);
            let r2 = x * x + y * y;
            let (xd, yd) = self.distort::<RATIONAL>(x, y, r2);
            let dx = self.fx * xd + self.skew * yd + self.cx - batch.pixel[0][i];
            let dy = self.fy * yd + self.cy - batch.pixel[1][i];
            let visible = pz > 0.0 && r2 <= self.max_r2;
            out[0][i] = if visible { dx } else { unseen };
            out[1][i] = if visible { dy } else { unseen };
        }
        out
    }

    #[inline(always)]
    fn camera_point(&self, batch: &Batch, i: usize) -> [f64; 3] {
        let [wx, wy, wz] =
            [batch.world[0][i] - self.c[0], batch.world[1][i] - self.c[1], batch.world[2][i] - self.c[2]];
        let r = &self.r;
        [r[0] * wx + r[1] * wy + r[2] * wz, r[3] * wx + r[4] * wy + r[5] * wz, r[6] * wx + r[7] * wy + r[8] * wz]
    }

    #[inline(always)]
    fn distort<const RATIONAL: bool>(&self, x: f64, y: f64, r2: f64) -> (f64, f64) {
        let [k1, k2, p1, p2, k3, k4, k5, k6] = self.k;
        let mut g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        if RATIONAL {
            g /= 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
        }
        let xy2 = 2.0 * x * y;
        (x * g + p1 * xy2 + p2 * (r2 + 2.0 * x * x), y * g + p1 * (r2 + 2.0 * y * y) + p2 * xy2)
    }

    /// The normal equations of the pose over batches of `count` points in all.
    pub fn pose_sums(&self, batches: &[Batch], count: usize) -> PoseSums {
        #[cfg(target_arch = "x86_64")]
        if has_avx2() {
            // SAFETY: the machine has AVX2.
            return unsafe { self.pose_sums_avx2(batches, count) };
        }
        self.pose_sums_any(batches, count)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn pose_sums_avx2(&self, batches: &[Batch], count: usize) -> PoseSums {
        self.pose_sums_any(batches, count)
    }

    #[inline(always)]
    fn pose_sums_any(&self, batches: &[Batch], count: usize) -> PoseSums {
        if self.rational {
            self.pose_sums_of::<true>(batches, count)
        } else {
            self.pose_sums_of::<false>(batches, count)
        }
    }

    #[inline(always)]
    fn pose_sums_of<const RATIONAL: bool>(&self, batches: &[Batch], count: usize) -> PoseSums {
        let mut n = [[0.0; LANES]; 21];
        let mut g = [[0.0; LANES]; 6];
        let mut cost = [0.0; LANES];
        let mut seen = [0.0; LANES];
        let [k1, k2, p1, p2, k3, k4, k5, k6] = self.k;
        for (index, batch) in batches.iter().enumerate() {
            let last = count - index * LANES;
            // Design rows of x and of y, and the misclosures, lane by lane.
            let mut rows = [[[0.0; LANES]; 6]; 2];
            let mut v = [[0.0; LANES]; 2];
            for i in 0..LANES {
                let [px, py, pz] = self.camera_point(batch, i);
                let iz = 1.0 / pz;
                let (x, y) = (px * iz, py * iz);
                let r2 = x * x + y * y;
                let (xd, yd) = self.distort::<RATIONAL>(x, y, r2);
                let (g, dg) = if RATIONAL {
                    let d = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
                    let g = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * d;
                    (g, (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3) - g * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) * d)
                } else {
                    (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
                };
                let (tx, ty) = (2.0 * (p1 * x + p2 * y), 2.0 * (p1 * y + p2 * x));
                let xx = g + 2.0 * x * x * dg + ty + 4.0 * p2 * x;
                let xy = 2.0 * x * y * dg + tx;
                let yy = g + 2.0 * y * y * dg + ty + 4.0 * p1 * y;
                let visible = pz > 0.0 && r2 <= self.max_r2 && i < last;
                let keep = |value: f64| if visible { value } else { 0.0 };
                v[0][i] = keep(self.fx * xd + self.skew * yd + self.cx - batch.pixel[0][i]);
                v[1][i] = keep(self.fy * yd + self.cy - batch.pixel[1][i]);
                seen[i] += keep(1.0);
                let by_plane =
                    [[self.fx * xx + self.skew * xy, self.fx * xy + self.skew * yy], [self.fy * xy, self.fy * yy]];
                for (row, [a, b]) in rows.iter_mut().zip(by_plane) {
                    let (a, b, c) = (a * iz, b * iz, -(a * x + b * y) * iz);
                    let r = &self.r;
                    row[0][i] = keep(py * c - pz * b);
                    row[1][i] = keep(pz * a - px * c);
                    row[2][i] = keep(px * b - py * a);
                    row[3][i] = keep(-(a * r[0] + b * r[3] + c * r[6]));
                    row[4][i] = keep(-(a * r[1] + b * r[4] + c * r[7]));
                    row[5][i] = keep(-(a * r[2] + b * r[5] + c * r[8]));
                }
            }
            for i in 0..LANES {
                cost[i] += v[0][i] * v[0][i] + v[1][i] * v[1][i];
            }
            let mut place = 0;
            for a in 0..6 {
                for i in 0..LANES {
                    g[a][i] += rows[0][a][i] * v[0][i] + rows[1][a][i] * v[1][i];
                }
                for b in a..6 {
                    for i in 0..LANES {
                        n[place][i] += rows[0][a][i] * rows[0][b][i] + rows[1][a][i] * rows[1][b][i];
                    }
                    place += 1;
                }
            }
        }
        let sum = |lane: &Lane| lane.iter().sum::<f64>();
        PoseSums {
            n: std::array::from_fn(|i| sum(&n[i])),
            g: std::array::from_fn(|i| sum(&g[i])),
            cost: sum(&cost),
            visible: sum(&seen) as usize,
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn has_avx2() -> bool {
    // The standard library remembers the answer.
    std::arch::is_x86_feature_detected!("avx2")
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::estimation::Random;
    use crate::geometry::{Camera, Model, Pose, rotation_exp};

    fn view(model: Model, terms: usize) -> View {
        let all = [1500.0, 1480.0, 990.0, 760.0, -0.05, 0.01, 1e-3, -5e-4, 2e-3, 0.01, 0.002, -0.001];
        let camera = Camera::new(model, 2000, 1500, &all[..4 + terms]).unwrap().with_skew(2.0);
        let pose = Pose { rotation: rotation_exp(&Vector3::new(0.1, -0.2, 0.3)), centre: Vector3::new(1.0, 2.0, -3.0) };
        View::new(camera, pose)
    }

    #[test]
    fn batches_say_the_same_as_single_points() {
        let mut random = Random::new(4);
        for (model, terms) in [(Model::Pinhole, 0), (Model::OpenCv, 5), (Model::FullOpenCv, 8)] {
            let view = view(model, terms);
            // 21 points: two batches and a part; some behind the camera.
            let xyz: Vec<[f64; 3]> = (0..21).map(|_| [0, 1, 2].map(|_| 8.0 * random.normal())).collect();
            let xy: Vec<[f64; 2]> = (0..21).map(|_| [2000.0 * random.uniform(), 1500.0 * random.uniform()]).collect();
            let flat = FlatView::new(&view).unwrap();
            let packed = batches(&xyz, &xy);
            let (mut cost, mut visible, mut g, mut n) = (0.0, 0, [0.0; 6], [0.0; 21]);
            for i in 0..21 {
                let square = flat.squares(&packed[i / LANES])[i % LANES];
                match view.project_with_pose_jacobian(&xyz[i]) {
                    Some((p, rows)) => {
                        let v = [p[0] - xy[i][0], p[1] - xy[i][1]];
                        let expected = v[0] * v[0] + v[1] * v[1];
                        assert!((square - expected).abs() <= 1e-10 * expected);
                        let full = view.project_with_jacobian(&xyz[i]).unwrap();
                        for (a, b) in rows.iter().flatten().zip(full.d_pose.iter().flatten()) {
                            assert!((a - b).abs() <= 1e-10 * (1.0 + b.abs()));
                        }
                        visible += 1;
                        cost += expected;
                        let mut place = 0;
                        for a in 0..6 {
                            g[a] += rows[0][a] * v[0] + rows[1][a] * v[1];
                            for b in a..6 {
                                n[place] += rows[0][a] * rows[0][b] + rows[1][a] * rows[1][b];
                                place += 1;
                            }
                        }
                    }
                    None => assert_eq!(square, f64::INFINITY),
                }
            }
            assert!(visible > 3 && visible < 21);
            let sums = flat.pose_sums(&packed, 21);
            assert_eq!(sums.visible, visible);
            assert!((sums.cost / cost - 1.0).abs() < 1e-12);
            let size = n.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
            assert!(sums.n.iter().zip(n).all(|(a, b)| (a - b).abs() < 1e-11 * size));
            assert!(sums.g.iter().zip(g).all(|(a, b)| (a - b).abs() < 1e-10 * (size * cost).sqrt()));
        }
    }

    #[test]
    fn other_cameras_have_no_batches() {
        let camera = Camera::new(Model::Equirectangular, 200, 100, &[]).unwrap();
        assert!(FlatView::new(&View::new(camera, Pose::identity())).is_none());
    }
}
