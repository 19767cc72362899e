//! Starting views from nothing: P3P on triples that are spread over the photo, judged on the other points.
//!
//! No blunders are expected here; that is what `ransac` is for. Where the focal length is unknown, P3P is tried for focal
//! lengths on a logarithmic grid, and the fit that follows frees it.

use nalgebra::Vector3;

use super::batch::LANES;
use super::fit::fit_plainly;
use super::levenberg::Limits;
use super::observations::Observations;
use super::p3p::p3p;
use super::parameters::FreeSet;
use crate::geometry::{Camera, Model, Pose, View};

/// Points that a candidate is judged on.
const JUDGES: usize = 200;
/// Spread points of which triples are made.
const CORNERS: usize = 8;
/// Triples that are solved.
const TRIPLES: usize = 10;
/// Candidates that are refined.
const REFINED: usize = 4;

/// A candidate whose cost after a few steps is this many times the best one's is given up.
const HOPELESS: f64 = 30.0;

/// The same before any step, where there are [`MANY`] points: residuals a hundred times those of the best start. P3P fits
/// three points, so that a second view which fits all of them nearly as well has starts about as good as the first's. A
/// start better than one sigma counts as one sigma: without noise the true view would rule out all others here.
const NO_START: f64 = 1e4;
/// See [`NO_START`].
const MANY: usize = 10;

/// Twice the log-likelihood ratio beyond which a candidate is ruled out.
const RULED_OUT: f64 = 30.0;

/// A refined candidate.
#[derive(Debug, Clone, Copy)]
pub(super) struct Candidate {
    pub view: View,
    /// Mean squared misclosure on the judging points, sigmas².
    pub cost: f64,
}

/// Cameras to try where the focal length is free: the given one, and a grid of fields of view from 150° to 5°.
pub(super) fn cameras_to_try(camera: &Camera, free: &FreeSet) -> Vec<Camera> {
    let focal_is_free = ["f", "fx", "fy"].iter().any(|name| free.position(name).is_some());
    let mut all = vec![*camera];
    if focal_is_free {
        let (narrowest, widest) = if camera.model() == Model::OpenCvFisheye { (3.0, 0.12) } else { (11.0, 0.15) };
        all.extend(focal_grid(camera, widest, narrowest, 18));
    }
    all
}

/// The camera with focal lengths between two multiples of the photo's longer side.
pub(super) fn focal_grid(camera: &Camera, from: f64, to: f64, count: usize) -> Vec<Camera> {
    let params = camera.params();
    let side = f64::from(camera.width.max(camera.height));
    (0..count)
        .filter_map(|i| {
            let f = side * from * (to / from).powf(i as f64 / (count - 1) as f64);
            let mut p = params.clone();
            p[1] *= f / p[0];
            p[0] = f;
            Camera::new(camera.model(), camera.width, camera.height, &p).ok().map(|c| c.with_skew(camera.skew()))
        })
        .collect()
}

/// Refined candidates, the best first; distinct from each other. Empty where nothing sees all the judging points.
pub(super) fn search(observations: &Observations, camera: &Camera, free: &FreeSet) -> Vec<Candidate> {
    let n = observations.len();
    let judges: Vec<usize> = if n <= JUDGES { (0..n).collect() } else { (0..JUDGES).map(|i| i * n / JUDGES).collect() };
    let judged = observations.select(&judges);
    let corners = spread(&judged.xy, CORNERS);
    let triples = spread_triples(&judged, &corners);
    let size = f64::from(camera.width.max(camera.height));
    let cap = (0.5 * size / judged.precision.typical_sigma()).powi(2);
    let cameras = cameras_to_try(camera, free);
    let mut enough = f64::INFINITY;
    let mut found: Vec<(f64, &Camera, Pose)> = Vec::with_capacity(4 * TRIPLES * cameras.len());
    for camera in &cameras {
        // Corners come again in many triples, and undoing a distortion is an iteration.
        let seen: Vec<Option<Vector3<f64>>> = corners.iter().map(|&i| camera.unproject(&judged.xy[i])).collect();
        for triple in &triples {
            let [Some(a), Some(b), Some(c)] = triple.map(|k| seen[k]) else { continue };
            for pose in p3p(&triple.map(|k| judged.xyz[corners[k]]), &[a, b, c]).iter() {
                if let Some(cost) = capped_cost(&judged, &View::new(*camera, *pose), cap, enough) {
                    if judged.len() >= MANY {
                        enough = enough.min(NO_START * cost.max(1.0));
                    }
                    found.push((cost, camera, *pose));
                }
            }
        }
    }
    let mut order: Vec<usize> = (0..found.len()).collect();
    order.sort_by(|&a, &b| found[a].0.total_cmp(&found[b].0));
    let mut distinct: Vec<(&Camera, &Pose)> = Vec::with_capacity(REFINED);
    for (cost, camera, pose) in order.iter().map(|&i| &found[i]) {
        if distinct.len() == REFINED || *cost > enough {
            break;
        }
        if !distinct.iter().any(|(_, d)| alike(d, pose, 0.05)) {
            distinct.push((camera, pose));
        }
    }
    let limits = Limits { iterations: 50, step: 1e-4, ..Limits::default() };
    let first_look = Limits { iterations: 4, ..limits };
    let mut refined: Vec<Candidate> = Vec::new();
    // The pose first, so that a wrong focal length does not run away with it.
    let pose = FreeSet::pose(camera.model());
    for (camera, start) in distinct {
        let Some(mut fitted) = fit_plainly(&judged, &pose, &View::new(*camera, *start), &first_look) else { continue };
        let best = refined.iter().map(|r| r.cost).fold(f64::INFINITY, f64::min) * judged.len() as f64;
        if free.is_pose() && fitted.normal.cost > HOPELESS * best {
            continue;
        }
        if !fitted.stop.converged() {
            fitted = fit_plainly(&judged, &pose, &fitted.state, &limits).unwrap_or(fitted);
        }
        if !free.is_pose() && 2 * judged.len() >= free.len() {
            fitted = fit_plainly(&judged, free, &fitted.state, &limits).unwrap_or(fitted);
        }
        let candidate = Candidate { view: fitted.state, cost: fitted.normal.cost / judged.len() as f64 };
        match refined.iter_mut().find(|d| alike(&d.view.pose, &candidate.view.pose, 0.01)) {
            Some(known) if candidate.cost < known.cost => *known = candidate,
            Some(_) => {}
            None => refined.push(candidate),
        }
    }
    refined.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    refined
}

/// The best of the candidates, and those that may turn out as good on all points: the likelihood of the judging points
/// rules the others out, whether the sigmas are right or unknown.
pub(super) fn plausible(candidates: &[Candidate], n: usize) -> impl Iterator<Item = &Candidate> {
    let judges = n.min(JUDGES) as f64;
    let best = candidates.iter().map(|c| c.cost).fold(f64::INFINITY, f64::min);
    candidates.iter().filter(move |c| {
        let known = judges * (c.cost - best);
        let unknown = (2.0 * judges - 6.0).max(1.0) * (c.cost / best).ln();
        // A cost that is not known rules nothing out.
        !(known > RULED_OUT && unknown > RULED_OUT)
    })
}

/// Whether two poses see the points from nearly the same place: turned by less than `limit`, the centre moved by less
/// than that part of the distance to the points' centroid, which is the origin of their local frame.
pub(super) fn alike(a: &Pose, b: &Pose, limit: f64) -> bool {
    let (turn, shift) = a.difference(b);
    turn.norm() < limit && shift.norm() < limit * a.centre.norm().max(b.centre.norm())
}

/// The mean squared misclosure, each at most `cap`; `None` where it comes to more than `enough`.
fn capped_cost(observations: &Observations, view: &View, cap: f64, enough: f64) -> Option<f64> {
    let n = observations.len() as f64;
    let mut sum = 0.0;
    let mut add = |square: f64| {
        sum += square.min(cap);
        (sum <= enough * n).then_some(())
    };
    if let Some((flat, sigma)) = observations.flat(view) {
        let mut left = observations.len();
        for batch in observations.batches() {
            let squares = flat.squares(batch);
            squares.iter().take(left).try_for_each(|s| add(s / (sigma * sigma)))?;
            left = left.saturating_sub(LANES);
        }
    } else {
        (0..observations.len()).try_for_each(|i| add(observations.square(view, i)))?;
    }
    Some(sum / n)
}

/// Triples of corners, by their places among them, the largest triangles first.
fn spread_triples(observations: &Observations, corners: &[usize]) -> Vec<[usize; 3]> {
    let mut triples = Vec::new();
    for i in 0..corners.len() {
        for j in i + 1..corners.len() {
            for k in j + 1..corners.len() {
                triples.push(([i, j, k], triangle(observations, [corners[i], corners[j], corners[k]])));
            }
        }
    }
    triples.sort_by(|p, q| q.1.total_cmp(&p.1));
    triples.truncate(TRIPLES);
    triples.into_iter().map(|t| t.0).collect()
}

/// The area in the photo, times how far the three are from one line in space.
fn triangle(o: &Observations, [i, j, k]: [usize; 3]) -> f64 {
    let (p, q, r) = (o.xy[i], o.xy[j], o.xy[k]);
    let area = ((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])).abs();
    let (p, q, r) = (Vector3::from(o.xyz[i]), Vector3::from(o.xyz[j]), Vector3::from(o.xyz[k]));
    let longest = (q - p).norm_squared().max((r - p).norm_squared()).max((r - q).norm_squared());
    area * (q - p).cross(&(r - p)).norm() / longest.max(f64::MIN_POSITIVE)
}

/// Up to `count` points, each the farthest from those before it.
pub(super) fn spread(xy: &[[f64; 2]], count: usize) -> Vec<usize> {
    let n = xy.len() as f64;
    let mean = xy.iter().fold([0.0; 2], |m, p| [m[0] + p[0] / n, m[1] + p[1] / n]);
    let square = |p: &[f64; 2], q: &[f64; 2]| (p[0] - q[0]).powi(2) + (p[1] - q[1]).powi(2);
    let mut chosen: Vec<usize> = Vec::new();
    let mut distance: Vec<f64> = xy.iter().map(|p| square(p, &mean)).collect();
    while chosen.len() < count.min(xy.len()) {
        let Some((next, &far)) = distance.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1)) else { break };
        if far <= 0.0 && !chosen.is_empty() {
            break;
        }
        if chosen.is_empty() {
            distance = xy.iter().map(|p| square(p, &xy[next])).collect();
        } else {
            for (d, p) in distance.iter_mut().zip(xy) {
                *d = d.min(square(p, &xy[next]));
            }
        }
        chosen.push(next);
    }
    chosen
}

/// The rotation that turns directions from a known centre into those of the pixels (Kabsch); `None` where the points do
/// not determine it.
pub(super) fn turn_about(view: &View, observations: &Observations) -> Option<View> {
    let mut sum = nalgebra::Matrix3::zeros();
    for (p, q) in observations.xyz.iter().zip(&observations.xy) {
        let seen = view.camera.unproject(q)?;
        let there = (Vector3::from(*p) - view.pose.centre).try_normalize(0.0)?;
        sum += seen * there.transpose();
    }
    let svd = sum.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let mut s = svd.singular_values.as_slice().to_vec();
    s.sort_by(|a, b| b.total_cmp(a));
    if s[1] < 1e-9 * s[0] {
        return None;
    }
    let flip = nalgebra::Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    Some(View::new(view.camera, Pose { rotation: u * flip * v_t, centre: view.pose.centre }))
}
