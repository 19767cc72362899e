//! ViewConditions as the condition of an adjustment: a control point's pixel and world coordinates against a view.
//!
//! `f = π(X) − (x, y)`: two conditions on the five observations (x, y, X, Y, Z). The free parameters are any of pose and
//! camera, and those of a DLT matrix as camera with skew and pose, which is the same eleven-dimensional family as the
//! twelve elements under ‖(h31 h32 h33)‖ = 1.

use nalgebra::{DMatrix, DVector, Matrix2x3, Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::gauss_helmert::{Conditions, Constraints, Design, Linearised, Observed, Priors};
use crate::error::{Error, Result};
use crate::estimation::{FreeSet, MAX_FREE, Parameter};
use crate::geometry::{View, rotation_log, skew_matrix};

/// A priori knowledge of some free parameters. Rotation components are the rotation vector from the starting view.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterPriors {
    /// Which parameters, by name.
    pub names: Vec<String>,
    /// Their values.
    pub values: Vec<f64>,
    /// Their covariance, positive definite.
    pub covariance: DMatrix<f64>,
}

/// An equation that the parameters of a view obey exactly.
#[derive(Debug, Clone, PartialEq)]
pub enum ViewConstraint {
    /// Σ coefficient · parameter = value, parameters by name.
    Linear {
        /// Names and coefficients.
        terms: Vec<(String, f64)>,
        /// The right-hand side.
        value: f64,
    },
    /// The projection centre lies at a known distance from a known point: a lever arm, or the scanner's tripod.
    CentreDistance {
        /// World frame.
        point: [f64; 3],
        /// In the world's unit.
        distance: f64,
    },
}

/// The conditions of a set of control points seen in one view, in a frame whose origin is near the points.
pub struct ViewConditions {
    free: FreeSet,
    origin: Vector3<f64>,
    start: View,
    prior_places: Vec<usize>,
    prior_values: DVector<f64>,
    prior_weight: DMatrix<f64>,
    constraints: Vec<PlacedConstraint>,
}

enum PlacedConstraint {
    Linear { terms: Vec<(usize, f64)>, value: f64 },
    CentreDistance { point: Vector3<f64>, distance: f64 },
}

impl ViewConditions {
    /// For points around `origin`, starting from a view in the world frame.
    pub fn new(free: FreeSet, start: &View, origin: Vector3<f64>) -> Result<Self> {
        if free.is_empty() {
            return Err(Error::invalid("nothing is free: name at least one parameter to estimate"));
        }
        if free.model() != start.camera.model() {
            return Err(Error::Internal("the free set is of another camera model".into()));
        }
        let mut this = Self {
            free,
            origin,
            start: *start,
            prior_places: Vec::new(),
            prior_values: DVector::zeros(0),
            prior_weight: DMatrix::zeros(0, 0),
            constraints: Vec::new(),
        };
        this.start = this.to_local(start);
        Ok(this)
    }

    /// The free parameters.
    pub fn free(&self) -> &FreeSet {
        &self.free
    }

    /// A view of the world frame in the frame of the computation.
    pub fn to_local(&self, view: &View) -> View {
        let mut local = *view;
        local.pose.centre -= self.origin;
        local
    }

    /// And back.
    pub fn to_world(&self, local: &View) -> View {
        let mut view = *local;
        view.pose.centre += self.origin;
        view
    }

    /// The observations of one control point: pixel, world point, and their covariances.
    pub fn observed(
        &self,
        xy: &[f64; 2],
        covariance_xy: &[[f64; 2]; 2],
        xyz: &[f64; 3],
        covariance_xyz: &[[f64; 3]; 3],
    ) -> Observed<5> {
        let mut value = SVector::<f64, 5>::zeros();
        let mut covariance = SMatrix::<f64, 5, 5>::zeros();
        for i in 0..2 {
            value[i] = xy[i];
            for j in 0..2 {
                covariance[(i, j)] = covariance_xy[i][j];
            }
        }
        for i in 0..3 {
            value[2 + i] = xyz[i] - self.origin[i];
            for j in 0..3 {
                covariance[(2 + i, 2 + j)] = covariance_xyz[i][j];
            }
        }
        Observed { value, covariance }
    }

    fn place(&self, name: &str, what: &str) -> Result<usize> {
        self.free.position(name).ok_or_else(|| {
            Error::invalid(format!("{what} on `{name}`, which is not free: free are {}", self.free.names().join(" ")))
        })
    }

    /// With a priori knowledge of free parameters.
    pub fn with_priors(mut self, priors: &ParameterPriors) -> Result<Self> {
        let k = priors.names.len();
        if priors.values.len() != k || priors.covariance.shape() != (k, k) {
            return Err(Error::invalid(format!(
                "{k} names of priors, {} values, and a covariance of {} by {}",
                priors.values.len(),
                priors.covariance.nrows(),
                priors.covariance.ncols()
            )));
        }
        self.prior_places = priors.names.iter().map(|n| self.place(n, "a prior")).collect::<Result<_>>()?;
        self.prior_values = DVector::from_fn(k, |i, _| match self.free.parameters()[self.prior_places[i]] {
            Parameter::Pose(m) if m >= 3 => priors.values[i] - self.origin[m - 3],
            _ => priors.values[i],
        });
        let repeated = (0..k).any(|i| self.prior_places[..i].contains(&self.prior_places[i]));
        if repeated || !priors.values.iter().chain(priors.covariance.iter()).all(|v| v.is_finite()) {
            return Err(Error::invalid("priors name a parameter twice, or hold values that are not finite"));
        }
        // Scaled to a unit diagonal first: sigmas of pixels and of radians differ by many powers of ten.
        let sigma = priors.covariance.diagonal().map(f64::sqrt);
        let correlation = DMatrix::from_fn(k, k, |i, j| priors.covariance[(i, j)] / (sigma[i] * sigma[j]));
        let inverse = correlation.clone().cholesky().map(|c| c.inverse()).ok_or_else(|| {
            Error::invalid("the priors' covariance is not positive definite: to hold a parameter, do not free it")
        })?;
        self.prior_weight = DMatrix::from_fn(k, k, |i, j| inverse[(i, j)] / (sigma[i] * sigma[j]));
        Ok(self)
    }

    /// With equations that the estimate has to obey.
    pub fn with_constraints(mut self, constraints: &[ViewConstraint]) -> Result<Self> {
        for c in constraints {
            let placed = match c {
                ViewConstraint::Linear { terms, value } => {
                    let mut value = *value;
                    let mut places = Vec::with_capacity(terms.len());
                    for (name, coefficient) in terms {
                        let place = self.place(name, "a constraint")?;
                        if let Parameter::Pose(m) = self.free.parameters()[place]
                            && m >= 3
                        {
                            value -= coefficient * self.origin[m - 3];
                        }
                        places.push((place, *coefficient));
                    }
                    PlacedConstraint::Linear { terms: places, value }
                }
                ViewConstraint::CentreDistance { point, distance } => {
                    if !(*distance > 0.0 && distance.is_finite() && point.iter().all(|v| v.is_finite())) {
                        return Err(Error::invalid(format!(
                            "a distance of {distance} cannot hold a projection centre"
                        )));
                    }
                    PlacedConstraint::CentreDistance { point: Vector3::from(*point) - self.origin, distance: *distance }
                }
            };
            self.constraints.push(placed);
        }
        Ok(self)
    }

    /// The parameters' values counted from the start: rotation vector, centre, camera; and d(values)/d(step).
    fn values(&self, view: &View) -> (DVector<f64>, DMatrix<f64>) {
        let turn = rotation_log(&(view.pose.rotation * self.start.pose.rotation.transpose()));
        let by_turn = inverse_left_jacobian(&turn);
        let u = self.free.len();
        let mut values = DVector::from_vec(self.free.values(view));
        let mut jacobian = DMatrix::identity(u, u);
        for (i, p) in self.free.parameters().iter().enumerate() {
            if let Parameter::Pose(m @ 0..3) = *p {
                values[i] = turn[m];
                for (k, q) in self.free.parameters().iter().enumerate() {
                    if let Parameter::Pose(n @ 0..3) = *q {
                        jacobian[(i, k)] = by_turn[(m, n)];
                    }
                }
            }
        }
        (values, jacobian)
    }
}

/// d(log(exp(δ) exp(φ)))/dδ at δ = 0.
fn inverse_left_jacobian(phi: &Vector3<f64>) -> Matrix3<f64> {
    let angle = phi.norm();
    let k = skew_matrix(phi);
    let c = if angle < 1e-3 {
        1.0 / 12.0 + angle * angle / 720.0
    } else {
        (1.0 - 0.5 * angle / (0.5 * angle).tan()) / (angle * angle)
    };
    Matrix3::identity() - k * 0.5 + k * k * c
}

impl Conditions<2, 5> for ViewConditions {
    type State = View;

    fn names(&self) -> Vec<String> {
        self.free.names().into_iter().map(String::from).collect()
    }

    fn linearise(&self, state: &View, l: &SVector<f64, 5>, design: Option<&mut Design<2>>) -> Option<Linearised<2, 5>> {
        let j = state.project_with_jacobian(&[l[2], l[3], l[4]])?;
        if let Some(rows) = design {
            self.free.columns(state, &j, rows);
        }
        let mut f = Vector2::new(j.xy[0] - l[0], j.xy[1] - l[1]);
        if state.camera.model() == crate::geometry::Model::Equirectangular {
            // A panorama has no border at longitude π: the shorter way round counts.
            let width = f64::from(state.camera.width);
            f.x -= (f.x / width).round() * width;
        }
        let d_xyz = Matrix2x3::from_fn(|i, k| j.d_xyz[i][k]);
        let mut b = SMatrix::<f64, 2, 5>::zeros();
        b[(0, 0)] = -1.0;
        b[(1, 1)] = -1.0;
        b.fixed_view_mut::<2, 3>(0, 2).copy_from(&d_xyz);
        Some((f, b))
    }

    fn apply(&self, state: &View, delta: &[f64]) -> Result<View> {
        let mut view = self.free.apply(state, delta)?;
        view.pose = view.pose.orthonormalised();
        Ok(view)
    }

    fn priors(&self, state: &View) -> Option<Priors> {
        if self.prior_places.is_empty() {
            return None;
        }
        let (values, jacobian) = self.values(state);
        let k = self.prior_places.len();
        Some(Priors {
            residual: DVector::from_fn(k, |i, _| values[self.prior_places[i]] - self.prior_values[i]),
            jacobian: DMatrix::from_fn(k, values.len(), |i, m| jacobian[(self.prior_places[i], m)]),
            weight: self.prior_weight.clone(),
        })
    }

    fn constraints(&self, state: &View) -> Option<Constraints> {
        if self.constraints.is_empty() {
            return None;
        }
        let (values, by_step) = self.values(state);
        let (m, u) = (self.constraints.len(), values.len());
        let mut value = DVector::zeros(m);
        let mut jacobian = DMatrix::zeros(m, u);
        for (i, c) in self.constraints.iter().enumerate() {
            match c {
                PlacedConstraint::Linear { terms, value: target } => {
                    value[i] = -target;
                    for (place, coefficient) in terms {
                        value[i] += coefficient * values[*place];
                        for k in 0..u {
                            jacobian[(i, k)] += coefficient * by_step[(*place, k)];
                        }
                    }
                }
                PlacedConstraint::CentreDistance { point, distance } => {
                    let arm = state.pose.centre - point;
                    let length = arm.norm();
                    value[i] = length - distance;
                    for (k, p) in self.free.parameters().iter().enumerate() {
                        if let Parameter::Pose(axis @ 3..) = *p
                            && length > 0.0
                        {
                            jacobian[(i, k)] = arm[axis - 3] / length;
                        }
                    }
                }
            }
        }
        Some(Constraints { value, jacobian })
    }
}

/// Rows d(x, y)/d(free parameters) of a world point that no observation belongs to; `None` where it is not visible.
pub fn design_of(free: &FreeSet, view: &View, xyz: &[f64; 3]) -> Option<DMatrix<f64>> {
    let mut rows = [[0.0; MAX_FREE]; 2];
    free.columns(view, &view.project_with_jacobian(xyz)?, &mut rows);
    Some(DMatrix::from_fn(2, free.len(), |i, k| rows[i][k]))
}
