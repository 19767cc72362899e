//! Tables of a view's uncertainty over its rays, from which the figure of a point is interpolated.
//!
//! In the coordinates (u, v) = (X, Y)/Z of the ray and w = 1/Z the covariance of the shift in (u, v) is *exactly* a
//! parabola in w, `A + B (w − w₀) + C (w − w₀)²`. C is that of the projection centre's position and has a closed form;
//! A and B are smooth functions of (u, v) and are interpolated biquadratically. The parabola is written about the plane
//! w₀(u, v) near which the view is known best, where rotation and position compensate each other: there nothing cancels.
//!
//! Every cell of the grid is compared with the exact formula when it is made, at any depth and in several directions;
//! where they differ by more than [`TOLERANCE`] (about a pole of a panorama, at the edge of a lens's field) the cell
//! asks for the exact formula. Cameras that see more than half a sphere have six grids, on the faces of a cube.

use nalgebra::{DMatrix, Matrix2, Matrix2x3, Matrix3, Vector2, Vector3};
use rayon::prelude::*;

use super::view_covariance::ViewCovariance;
use crate::estimation::{MAX_FREE, Parameter};
use crate::geometry::{CUBE_FACES, Depth, View, cube_face, forward_field};

/// The largest relative difference of a sigma from the exact formula's at the places where a cell is compared.
pub const TOLERANCE: f64 = 2e-3;
/// Nodes per side of a face's grid, tried in turn. The largest still fits about into a core's own cache.
const GRIDS: [usize; 5] = [9, 17, 33, 65, 129];

/// E F G of a symmetric 2×2 matrix, of A and of B, each padded to half a vector.
pub(super) type Node = [f32; 8];

/// How a cell of the grid is to be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cell {
    /// Interpolated.
    Interpolated,
    /// By the exact formula.
    Exact,
    /// Not in the photo.
    Outside,
}

/// One of the six pyramids about the projection centre, or the only one.
#[derive(Debug, Clone)]
pub(super) struct Face {
    /// Axes of u, v and depth in the camera frame.
    pub axes: [usize; 3],
    /// The sign of the depth's axis.
    pub sign: f32,
    low: [f32; 2],
    /// Nodes per unit.
    density: [f32; 2],
    /// Nodes per side.
    side: usize,
    nodes: Vec<Node>,
    /// Each of 2 × 2 node intervals.
    cells: Vec<Cell>,
    /// w₀ = plane · (u, v, 1)
    plane: [f32; 3],
    /// The position's covariance in this face's axes: 11 12 22 13 23 33.
    position: [f32; 6],
}

impl Face {
    /// How many cells are of a kind.
    pub fn count(&self, kind: Cell) -> usize {
        self.cells.iter().filter(|c| **c == kind).count()
    }

    /// Places of a ray on the grid, in nodes; outside the grid they are out of 0 … `last`.
    #[inline(always)]
    pub fn place(&self, u: f32, v: f32) -> [f32; 2] {
        [(u - self.low[0]) * self.density[0], (v - self.low[1]) * self.density[1]]
    }

    /// The largest place.
    #[inline(always)]
    pub fn last(&self) -> f32 {
        (self.side - 1) as f32
    }

    /// The kind of a cell, by its two numbers.
    #[inline(always)]
    pub fn kind(&self, [i, j]: [usize; 2]) -> Cell {
        self.cells[j * ((self.side - 1) / 2) + i]
    }

    /// A and B in a cell, with the weights of its nodes. All eight lanes at once.
    #[inline(always)]
    pub fn sums(&self, [i, j]: [usize; 2], x: [f32; 3], y: [f32; 3]) -> Node {
        let mut sum: Node = [0.0; 8];
        let nodes = &self.nodes[2 * j * self.side + 2 * i..][..2 * self.side + 3];
        for (row, wy) in y.iter().enumerate() {
            let nodes = &nodes[row * self.side..][..3];
            for lane in 0..8 {
                sum[lane] += wy * (x[0] * nodes[0][lane] + x[1] * nodes[1][lane] + x[2] * nodes[2][lane]);
            }
        }
        sum
    }

    /// How far w lies from the plane about which the parabola is written.
    #[inline(always)]
    pub fn height(&self, u: f32, v: f32, w: f32) -> f32 {
        w - (self.plane[0] * u + self.plane[1] * v + self.plane[2])
    }

    /// E F G of the part that is interpolated of the shift in (u, v), at a height; the last number means nothing.
    #[inline(always)]
    pub fn interpolated(&self, cell: [usize; 2], x: [f32; 3], y: [f32; 3], height: f32) -> [f32; 4] {
        let sum = self.sums(cell, x, y);
        std::array::from_fn(|k| sum[k] + height * sum[4 + k])
    }

    /// E F G of the shift in (u, v) with the part that has a closed form.
    #[inline(always)]
    pub fn shift(&self, part: [f32; 3], u: f32, v: f32, height: f32) -> [f32; 3] {
        let [c11, c12, c22, c13, c23, c33] = self.position;
        let square = height * height;
        [
            part[0] + square * (c11 - 2.0 * u * c13 + u * u * c33),
            part[1] + square * (c12 - u * c23 - v * c13 + u * v * c33),
            part[2] + square * (c22 - 2.0 * v * c23 + v * v * c33),
        ]
    }

    /// Whether the interpolated coefficients give the same figure as the true ones, at any depth.
    fn agrees(&self, cell: [usize; 2], u: f64, v: f64, truth: &[Matrix2<f64>; 3]) -> bool {
        let [a, b] = self.place(u as f32, v as f32);
        let (x, y) = (weights(a - 2.0 * cell[0] as f32), weights(b - 2.0 * cell[1] as f32));
        let w0 = f64::from(self.plane[0]) * u + f64::from(self.plane[1]) * v + f64::from(self.plane[2]);
        // The depth at which the far and the near part are equal is the parabola's own unit.
        let natural = (truth[0].trace() / truth[2].trace()).sqrt();
        let unit = if natural.is_finite() && natural > 0.0 { natural } else { 1.0 };
        let steps = [-30.0, -10.0, -3.0, -1.0, -0.3, 0.0, 0.3, 1.0, 3.0, 10.0, 30.0];
        let depths = steps.iter().map(|s| s * unit).chain([-w0, w0]);
        depths.filter(|dw| w0 + dw >= 0.0).all(|dw| {
            let (u, v) = (u as f32, v as f32);
            let height = self.height(u, v, (w0 + dw) as f32);
            let [e, f, g, _] = self.interpolated(cell, x, y, height);
            let [e, f, g] = self.shift([e, f, g], u, v, height).map(f64::from);
            let t = truth[0] + truth[1] * dw + truth[2] * (dw * dw);
            // A slanted surface weighs some direction: each must agree.
            [[1.0, 0.0], [0.0, 1.0], [0.7, 0.7], [0.7, -0.7]].iter().all(|[p, q]| {
                let d = Vector2::new(*p, *q);
                let exact = d.dot(&(t * d));
                let found = e * p * p + 2.0 * f * p * q + g * q * q;
                (found - exact).abs() <= 2.0 * TOLERANCE * exact
            })
        })
    }
}

/// Lagrange's weights of the nodes 0, 1, 2 at t.
#[inline(always)]
pub(super) fn weights(t: f32) -> [f32; 3] {
    [0.5 * (t - 1.0) * (t - 2.0), t * (2.0 - t), 0.5 * t * (t - 1.0)]
}

/// The tables of a view: one for a camera that looks forward, six for one that looks around.
pub(super) fn make_faces(view: &View, covariance: &ViewCovariance, image_variance: f64) -> Vec<Face> {
    let make = |axes: [usize; 3], sign: f64, low: [f64; 2], high: [f64; 2]| {
        let maker = Maker::new(view, covariance, image_variance, axes, sign, low, high);
        maker.finest(&GRIDS)
    };
    match view.camera.depth_kind() {
        Depth::AlongAxis => {
            let (low, high) = forward_field(view);
            vec![make([0, 1, 2], 1.0, low, high)]
        }
        Depth::Range => {
            let faces = (0..CUBE_FACES).map(cube_face);
            faces.map(|(axes, sign)| make(axes, sign, [-1.0; 2], [1.0; 2])).collect()
        }
    }
}

/// What one face is made from.
struct Maker<'a> {
    /// In the projection centre's own frame: no digits are lost to large coordinates.
    view: View,
    covariance: &'a ViewCovariance,
    image_variance: f64,
    axes: [usize; 3],
    sign: f64,
    low: [f64; 2],
    high: [f64; 2],
    plane: [f64; 3],
}

impl<'a> Maker<'a> {
    fn new(
        view: &View,
        covariance: &'a ViewCovariance,
        image_variance: f64,
        axes: [usize; 3],
        sign: f64,
        low: [f64; 2],
        high: [f64; 2],
    ) -> Self {
        let mut view = *view;
        view.pose.centre = Vector3::zeros();
        let mut this = Self { view, covariance, image_variance, axes, sign, low, high, plane: [0.0; 3] };
        this.plane = this.best_plane();
        this
    }

    /// The ray of (u, v) in the camera frame.
    fn ray(&self, u: f64, v: f64) -> Vector3<f64> {
        let mut p = Vector3::zeros();
        p[self.axes[0]] = u;
        p[self.axes[1]] = v;
        p[self.axes[2]] = self.sign;
        p
    }

    fn terms(&self, u: f64, v: f64) -> Option<RayTerms> {
        let view = &self.view;
        let world = view.pose.rotation.transpose() * self.ray(u, v);
        let j = view.project_with_jacobian(&world.into())?;
        let free = self.covariance.free();
        let mut rows = [[0.0; MAX_FREE]; 2];
        free.columns(view, &j, &mut rows);
        let by_camera = Matrix2x3::from_fn(|i, k| j.d_xyz[i][k]) * view.pose.rotation.transpose();
        let by_uv = Matrix2::from_columns(&[by_camera.column(self.axes[0]), by_camera.column(self.axes[1])]);
        let inverse = by_uv.try_inverse().filter(|m| m.iter().all(|x| x.is_finite()))?;
        let (mut far, mut near) = ([[0.0; MAX_FREE]; 2], [[0.0; MAX_FREE]; 2]);
        for (k, p) in free.parameters().iter().enumerate() {
            let part = if matches!(p, Parameter::Pose(3..)) { &mut near } else { &mut far };
            for i in 0..2 {
                part[i][k] = inverse[(i, 0)] * rows[0][k] + inverse[(i, 1)] * rows[1][k];
            }
        }
        Some(RayTerms { far, near, noise: inverse * inverse.transpose() * self.image_variance })
    }

    /// A, B, C at a ray.
    fn coefficients(&self, u: f64, v: f64) -> Option<[Matrix2<f64>; 3]> {
        let w0 = self.plane[0] * u + self.plane[1] * v + self.plane[2];
        Some(self.terms(u, v)?.about(self.covariance.matrix(), w0))
    }

    /// The plane w₀ near which the view's part is smallest.
    fn best_plane(&self) -> [f64; 3] {
        let mut normal = Matrix3::<f64>::zeros();
        let mut right = Vector3::zeros();
        for place in 0..25 {
            let at =
                |i: usize, axis: usize| self.low[axis] + (0.1 + 0.2 * i as f64) * (self.high[axis] - self.low[axis]);
            let (u, v) = (at(place % 5, 0), at(place / 5, 1));
            let Some(terms) = self.terms(u, v) else { continue };
            let [_, twice_cross, square] = terms.about(self.covariance.matrix(), 0.0).map(|m| m.trace());
            if square > 0.0 {
                let row = Vector3::new(u, v, 1.0);
                normal += row * row.transpose();
                right += row * (-0.5 * twice_cross / square);
            }
        }
        // To the tables' own precision, so that both agree on where w₀ lies.
        normal.try_inverse().map_or([0.0; 3], |inverse| (inverse * right).map(|x| f64::from(x as f32)).into())
    }

    /// The position's covariance in this face's axes; missing parameters are known.
    fn position(&self) -> [f32; 6] {
        let free = self.covariance.free();
        let place = |k: usize| free.parameters().iter().position(|p| *p == Parameter::Pose(3 + k));
        let world = Matrix3::from_fn(|i, k| place(i).zip(place(k)).map_or(0.0, |p| self.covariance.matrix()[p]));
        let r = self.view.pose.rotation;
        let camera = r * world * r.transpose();
        let sign = |a: usize| if a == 2 { self.sign } else { 1.0 };
        let at = |a: usize, b: usize| (camera[(self.axes[a], self.axes[b])] * sign(a) * sign(b)) as f32;
        [at(0, 0), at(0, 1), at(1, 1), at(0, 2), at(1, 2), at(2, 2)]
    }

    /// The coarsest grid that nowhere asks for the exact formula, or the finest.
    fn finest(&self, sides: &[usize]) -> Face {
        let (last, coarser) = sides.split_last().unwrap_or((&9, &[]));
        for side in coarser {
            let face = self.grid(*side);
            if face.count(Cell::Exact) == 0 {
                return face;
            }
        }
        self.grid(*last)
    }

    fn grid(&self, side: usize) -> Face {
        let density = [0, 1].map(|a| (side - 1) as f64 / (self.high[a] - self.low[a]));
        let at = |i: f64, j: f64| (self.low[0] + i / density[0], self.low[1] + j / density[1]);
        let node = |place: usize| {
            let (u, v) = at((place % side) as f64, (place / side) as f64);
            self.coefficients(u, v).map_or([f32::NAN; 8], |[a, b, _]| {
                let e = |m: &Matrix2<f64>| [m[(0, 0)] as f32, m[(0, 1)] as f32, m[(1, 1)] as f32];
                let ([a1, a2, a3], [b1, b2, b3]) = (e(&a), e(&b));
                [a1, a2, a3, 0.0, b1, b2, b3, 0.0]
            })
        };
        let cells = (side - 1) / 2;
        let mut face = Face {
            axes: self.axes,
            sign: self.sign as f32,
            low: self.low.map(|x| x as f32),
            density: density.map(|x| x as f32),
            side,
            nodes: (0..side * side).into_par_iter().with_min_len(64).map(node).collect(),
            cells: Vec::new(),
            plane: self.plane.map(|x| x as f32),
            position: self.position(),
        };
        let judge = |cell: usize| {
            let (ci, cj) = (cell % cells, cell / cells);
            let mut kind = Cell::Outside;
            // Midway between nodes is where interpolation is farthest from the truth.
            for (a, b) in [(0.5, 0.5), (1.5, 0.5), (0.5, 1.5), (1.5, 1.5), (1.0, 0.5), (0.5, 1.0)] {
                let (u, v) = at(2.0 * ci as f64 + a, 2.0 * cj as f64 + b);
                if self.is_in_the_photo(u, v, &density) {
                    let good = self.coefficients(u, v).is_some_and(|truth| face.agrees([ci, cj], u, v, &truth));
                    if !good {
                        return Cell::Exact;
                    }
                    kind = Cell::Interpolated;
                }
            }
            kind
        };
        face.cells = (0..cells * cells).into_par_iter().with_min_len(16).map(judge).collect();
        face
    }

    /// Whether a ray, or one a node away, falls into the photo.
    fn is_in_the_photo(&self, u: f64, v: f64, density: &[f64; 2]) -> bool {
        let seen = |a: f64, b: f64| {
            let ray = self.ray(u + a / density[0], v + b / density[1]);
            self.view.camera.project(&ray).is_some_and(|xy| self.view.camera.contains(&xy))
        };
        seen(0.0, 0.0) || [-1.0, 0.0, 1.0].iter().any(|a| [-1.0, 0.0, 1.0].iter().any(|b| seen(*a, *b)))
    }
}

/// Rows of the shift in (u, v) by the parameters: those of the position act with 1/Z, the others at any depth.
struct RayTerms {
    far: [[f64; MAX_FREE]; 2],
    near: [[f64; MAX_FREE]; 2],
    noise: Matrix2<f64>,
}

impl RayTerms {
    /// A, B, C of `A + B (w − w₀) + C (w − w₀)²`.
    fn about(&self, sigma: &DMatrix<f64>, w0: f64) -> [Matrix2<f64>; 3] {
        let here: [[f64; MAX_FREE]; 2] =
            std::array::from_fn(|i| std::array::from_fn(|k| self.far[i][k] + w0 * self.near[i][k]));
        let weigh = |rows: &[[f64; MAX_FREE]; 2]| {
            let mut weighted = [[0.0; MAX_FREE]; 2];
            for (k, column) in sigma.column_iter().enumerate() {
                for i in 0..2 {
                    weighted[i][k] = column.iter().zip(&rows[i]).map(|(s, a)| s * a).sum();
                }
            }
            weighted
        };
        let (by_here, by_near) = (weigh(&here), weigh(&self.near));
        let product = |a: &[[f64; MAX_FREE]; 2], b: &[[f64; MAX_FREE]; 2]| {
            Matrix2::from_fn(|i, j| a[i].iter().zip(&b[j]).map(|(x, y)| x * y).sum())
        };
        let cross = product(&by_here, &self.near);
        [product(&by_here, &here) + self.noise, cross + cross.transpose(), product(&by_near, &self.near)]
    }
}
