//! The normalised information distance between the intensity of visible points and the photo, with its gradient by the
//! view: NID = 2 − (H(a) + H(b)) / H(a, b), 0 when each determines the other, 1 when they say nothing of each other.
//!
//! Source: Stewart and Newman, LAPS: localisation using appearance of prior structure, ICRA 2012. The photo is
//! interpolated and its grey values are shared among bins by cubic B-splines, so that the distance is twice
//! differentiable in the view. Assumes that the set of visible points does not change while a view is refined.

use rayon::prelude::*;

use super::plane::Plane;
use super::spline::spline;
use crate::error::{Error, Result};
use crate::geometry::View;

/// Points per task; partial histograms are added in the order of the tasks.
const BLOCK: usize = 8192;

/// The distance at one view.
#[derive(Debug, Clone, PartialEq)]
pub struct Information {
    /// 0 to 1.
    pub distance: f64,
    /// By rotation vector on the left and projection centre.
    pub gradient: [f64; 6],
    /// How many points lay in the photo.
    pub points: usize,
}

/// Grey values prepared for the distance.
#[derive(Debug, Clone)]
pub struct InformationPhoto {
    /// B-spline coefficients of the photo, scaled to bins: 0 … bins − 3 between the first and the last full spline.
    coefficients: Plane,
    bins: usize,
}

impl InformationPhoto {
    /// From grey values, which are stretched by rank first: all bins are in use then, whatever the exposure.
    pub fn new(image: &Plane, bins: usize) -> Result<Self> {
        if !(4..=64).contains(&bins) {
            return Err(Error::invalid(format!("the information distance takes 4 to 64 bins, not {bins}")));
        }
        let top = (bins - 3) as f32;
        let ranks = Plane::new(image.width, image.height, ranks(&image.values))?.map(|v| v * top);
        Ok(Self { coefficients: ranks, bins })
    }

    /// Bins of the joint histogram, each way.
    pub fn bins(&self) -> usize {
        self.bins
    }

    /// The value and its derivative by x and y; `None` within two pixels of the border. The samples themselves serve as
    /// coefficients: that blurs a little and never rings.
    fn sample(&self, x: f64, y: f64) -> Option<(f64, [f64; 2])> {
        let p = &self.coefficients;
        let (fx, fy) = (x.floor(), y.floor());
        if !(fx >= 1.0 && fy >= 1.0 && fx + 2.0 < p.width as f64 && fy + 2.0 < p.height as f64) {
            return None;
        }
        let (column, row) = (fx as usize - 1, fy as usize - 1);
        let (wx, dx) = spline(x - fx);
        let (wy, dy) = spline(y - fy);
        let (mut value, mut by_x, mut by_y) = (0.0, 0.0, 0.0);
        for j in 0..4 {
            let line = &p.row(row + j)[column..column + 4];
            let (mut sum, mut slope) = (0.0, 0.0);
            for i in 0..4 {
                sum += wx[i] * f64::from(line[i]);
                slope += dx[i] * f64::from(line[i]);
            }
            value += wy[j] * sum;
            by_x += wy[j] * slope;
            by_y += dy[j] * sum;
        }
        Some((value, [by_x, by_y]))
    }
}

/// Ranks in 0 … 1; equal values share the middle of their ranks.
pub fn ranks(values: &[f32]) -> Vec<f32> {
    let mut order: Vec<u32> = (0..values.len() as u32).collect();
    order.par_sort_unstable_by(|a, b| values[*a as usize].total_cmp(&values[*b as usize]).then(a.cmp(b)));
    let mut out = vec![0.0; values.len()];
    let scale = 1.0 / (values.len().max(2) - 1) as f64;
    let mut start = 0;
    while start < order.len() {
        let value = values[order[start] as usize];
        let end = start + order[start..].iter().take_while(|i| values[**i as usize] == value).count().max(1);
        let rank = (0.5 * (start + end - 1) as f64 * scale) as f32;
        for i in &order[start..end] {
            out[*i as usize] = rank;
        }
        start = end;
    }
    out
}

struct Histogram {
    joint: Vec<f64>,
    /// d(joint)/d(pose), bin by bin.
    slopes: Vec<[f64; 6]>,
    points: usize,
}

impl Histogram {
    fn new(bins: usize) -> Self {
        Self { joint: vec![0.0; bins * bins], slopes: vec![[0.0; 6]; bins * bins], points: 0 }
    }

    fn add(&mut self, other: &Self) {
        for (a, b) in self.joint.iter_mut().zip(&other.joint) {
            *a += b;
        }
        for (a, b) in self.slopes.iter_mut().zip(&other.slopes) {
            for (a, b) in a.iter_mut().zip(b) {
                *a += b;
            }
        }
        self.points += other.points;
    }
}

/// The distance and its gradient. `intensity` holds ranks in 0 … 1 of the visible points `xyz`.
pub fn information_distance(
    view: &View,
    xyz: &[[f64; 3]],
    intensity: &[f32],
    photo: &InformationPhoto,
) -> Result<Information> {
    if xyz.len() != intensity.len() {
        return Err(Error::invalid(format!("{} points have {} intensities", xyz.len(), intensity.len())));
    }
    let (camera, plane) = (&view.camera, &photo.coefficients);
    if camera.width as usize != plane.width || camera.height as usize != plane.height {
        return Err(Error::invalid(format!(
            "the photo of {} × {} pixels is not that of the camera, {} × {}",
            plane.width, plane.height, camera.width, camera.height
        )));
    }
    let bins = photo.bins;
    let parts: Vec<Histogram> = xyz
        .par_chunks(BLOCK)
        .zip(intensity.par_chunks(BLOCK))
        .map(|(points, values)| {
            let mut part = Histogram::new(bins);
            for (p, v) in points.iter().zip(values) {
                put(&mut part, view, p, *v, photo);
            }
            part
        })
        .collect();
    let mut all = Histogram::new(bins);
    parts.iter().for_each(|part| all.add(part));
    if all.points < 100 {
        return Err(Error::Degenerate {
            what: "too few points lie in the photo to compare it with the cloud".into(),
            quantity: "points in the photo",
            value: all.points as f64,
            limit: 100.0,
            remedy: "check the approximate view",
        });
    }
    Ok(evaluate(&all, bins))
}

fn put(part: &mut Histogram, view: &View, p: &[f64; 3], value: f32, photo: &InformationPhoto) {
    let Some(j) = view.project_with_jacobian(p) else { return };
    let Some((grey, by_pixel)) = photo.sample(j.xy[0], j.xy[1]) else { return };
    let bins = photo.bins;
    let place = |v: f64| {
        let v = v.clamp(0.0, (bins - 3) as f64 - 1e-9);
        (v.floor() as usize, v - v.floor())
    };
    let (a, s) = place(f64::from(value) * (bins - 3) as f64);
    let (b, t) = place(grey);
    let ((wa, _), (wb, db)) = (spline(s), spline(t));
    let by_pose: [f64; 6] = std::array::from_fn(|k| by_pixel[0] * j.d_pose[0][k] + by_pixel[1] * j.d_pose[1][k]);
    for i in 0..4 {
        for k in 0..4 {
            let cell = (a + i) * bins + b + k;
            part.joint[cell] += wa[i] * wb[k];
            let slope = wa[i] * db[k];
            for (total, by) in part.slopes[cell].iter_mut().zip(&by_pose) {
                *total += slope * by;
            }
        }
    }
    part.points += 1;
}

fn evaluate(all: &Histogram, bins: usize) -> Information {
    let total = all.points as f64;
    let plus_log = |p: f64| if p > 0.0 { p.ln() + 1.0 } else { 0.0 };
    let entropy = |p: f64| if p > 0.0 { -p * p.ln() } else { 0.0 };
    let joint: Vec<f64> = all.joint.iter().map(|v| v / total).collect();
    let of_rows: f64 = joint.chunks(bins).map(|row| entropy(row.iter().sum())).sum();
    let columns: Vec<f64> = (0..bins).map(|c| joint.iter().skip(c).step_by(bins).sum()).collect();
    let of_columns: f64 = columns.iter().map(|p| entropy(*p)).sum();
    let of_both: f64 = joint.iter().map(|p| entropy(*p)).sum();
    // The intensity's own entropy does not depend on the view: its bins' sums stay.
    let (mut d_columns, mut d_both) = ([0.0; 6], [0.0; 6]);
    for (cell, slopes) in all.slopes.iter().enumerate() {
        let (by_joint, by_column) = (plus_log(joint[cell]), plus_log(columns[cell % bins]));
        for k in 0..6 {
            d_both[k] -= by_joint * slopes[k] / total;
            d_columns[k] -= by_column * slopes[k] / total;
        }
    }
    let sum = of_rows + of_columns;
    let gradient = std::array::from_fn(|k| (sum * d_both[k] / of_both - d_columns[k]) / of_both);
    Information { distance: 2.0 - sum / of_both, gradient, points: all.points }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::geometry::{Camera, Model, Pose};

    fn pattern(x: f64, y: f64) -> f64 {
        (0.09 * x + 0.5).sin() + (0.11 * y - 0.02 * x).cos() + (0.05 * (x + y)).sin()
    }

    fn scene() -> (View, Vec<[f64; 3]>, Vec<f32>, InformationPhoto) {
        let camera = Camera::new(Model::Pinhole, 200, 150, &[180.0, 180.0, 99.5, 74.5]).unwrap();
        let pose = Pose { rotation: nalgebra::Matrix3::identity(), centre: Vector3::zeros() };
        let view = View::new(camera, pose);
        let image = Plane::by_rows(200, 150, |y, row| {
            for (x, v) in row.iter_mut().enumerate() {
                *v = (-pattern(x as f64, y as f64)).exp() as f32;
            }
        });
        let (mut xyz, mut values) = (Vec::new(), Vec::new());
        for y in (10..140).step_by(2) {
            for x in (10..190).step_by(2) {
                let ray = camera.unproject(&[x as f64 + 0.3, y as f64 - 0.2]).unwrap();
                let depth = 5.0 + 0.02 * x as f64 + 0.5 * (0.1 * y as f64).sin();
                let p = ray * (depth / ray.z);
                xyz.push([p.x, p.y, p.z]);
                values.push(pattern(x as f64 + 0.3, y as f64 - 0.2) as f32);
            }
        }
        let values = ranks(&values);
        (view, xyz, values, InformationPhoto::new(&image, 16).unwrap())
    }

    #[test]
    fn the_gradient_agrees_with_differences() {
        let (view, xyz, values, photo) = scene();
        let moved = View::new(
            view.camera,
            view.pose.perturbed(&Vector3::new(0.004, -0.006, 0.003), &Vector3::new(0.02, -0.01, 0.03)),
        );
        let at = information_distance(&moved, &xyz, &values, &photo).unwrap();
        for k in 0..6 {
            let h = 1e-6;
            let difference = |s: f64| {
                let mut d = [0.0; 6];
                d[k] = s * h;
                let pose = moved.pose.perturbed(&Vector3::new(d[0], d[1], d[2]), &Vector3::new(d[3], d[4], d[5]));
                information_distance(&View::new(view.camera, pose), &xyz, &values, &photo).unwrap().distance
            };
            let numeric = (difference(1.0) - difference(-1.0)) / (2.0 * h);
            assert!(
                (at.gradient[k] - numeric).abs() < 1e-4 * (1.0 + numeric.abs()),
                "{k}: {} {numeric}",
                at.gradient[k]
            );
        }
    }

    #[test]
    fn the_distance_is_least_at_the_truth_and_small_there() {
        let (view, xyz, values, photo) = scene();
        let at_truth = information_distance(&view, &xyz, &values, &photo).unwrap();
        assert!(at_truth.distance < 0.7, "{}", at_truth.distance);
        for d in [[0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.02], [0.0, -0.008, 0.01]] {
            let pose = view.pose.perturbed(&Vector3::from(d), &Vector3::zeros());
            let aside = information_distance(&View::new(view.camera, pose), &xyz, &values, &photo).unwrap();
            assert!(aside.distance > at_truth.distance + 0.01, "{d:?}");
        }
    }

    #[test]
    fn the_result_does_not_depend_on_the_number_of_threads() {
        let (view, xyz, values, photo) = scene();
        let run = |n| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
            pool.install(|| information_distance(&view, &xyz, &values, &photo).unwrap())
        };
        assert_eq!(run(1), run(3));
    }

    #[test]
    fn equal_values_share_a_rank() {
        assert_eq!(ranks(&[3.0, 1.0, 3.0, 9.0, 0.0]), [0.625, 0.25, 0.625, 1.0, 0.0]);
    }
}
