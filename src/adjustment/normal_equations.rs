//! Normal equations of a few parameters: summed point by point, scaled to a unit diagonal, reduced to the tangent space
//! of the constraints, and judged by their eigenvalues.

use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::gauss_helmert::{Constraints, PointFit, Priors};
use crate::error::{Error, Result};
use crate::estimation::MAX_FREE;

/// Smallest eigenvalue of the scaled normal matrix that is not yet rounding. Its square root is the part of a parameter
/// that the other parameters cannot imitate.
pub(super) const SINGULAR: f64 = 1e-12;
/// The same for an iteration that did not converge: below this, weak determination is why.
pub(super) const TOO_WEAK: f64 = 1e-6;

/// N = Σ Aᵀ W⁻¹ A, g = Σ Aᵀ W⁻¹ w, and the objective Σ wᵀ W⁻¹ w.
#[derive(Debug, Clone)]
pub(super) struct NormalEquations {
    u: usize,
    matrix: [[f64; MAX_FREE]; MAX_FREE],
    gradient: [f64; MAX_FREE],
    pub objective: f64,
}

impl NormalEquations {
    pub fn zeros(u: usize) -> Self {
        Self { u, matrix: [[0.0; MAX_FREE]; MAX_FREE], gradient: [0.0; MAX_FREE], objective: 0.0 }
    }

    /// Adds one point, to the upper triangle.
    pub fn add_point<const C: usize, const M: usize>(&mut self, point: &PointFit<C, M>) {
        let weighted = point.weight * point.misclosure;
        for i in 0..C {
            self.objective += point.misclosure[i] * weighted[i];
            let a = &point.design[i];
            let mut wa = [0.0; MAX_FREE];
            for j in 0..C {
                let w = point.weight[(i, j)];
                for k in 0..self.u {
                    wa[k] += w * point.design[j][k];
                }
            }
            for k in 0..self.u {
                self.gradient[k] += a[k] * weighted[i];
                for m in k..self.u {
                    self.matrix[k][m] += a[k] * wa[m];
                }
            }
        }
    }

    pub fn add(&mut self, other: &Self) {
        self.objective += other.objective;
        for k in 0..self.u {
            self.gradient[k] += other.gradient[k];
            for m in 0..self.u {
                self.matrix[k][m] += other.matrix[k][m];
            }
        }
    }

    /// Fills the lower triangle.
    pub fn mirror(&mut self) {
        for k in 0..self.u {
            for m in 0..k {
                self.matrix[k][m] = self.matrix[m][k];
            }
        }
    }

    pub fn add_priors(&mut self, priors: &Priors) {
        let weighted = priors.jacobian.transpose() * &priors.weight;
        let n = &weighted * &priors.jacobian;
        let g = &weighted * &priors.residual;
        self.objective += priors.residual.dot(&(&priors.weight * &priors.residual));
        for k in 0..self.u {
            self.gradient[k] += g[k];
            for m in 0..self.u {
                self.matrix[k][m] += n[(k, m)];
            }
        }
    }

    /// One over the roots of the diagonal: a parameter's standard deviation if it were alone.
    pub fn scale(&self) -> DVector<f64> {
        DVector::from_fn(self.u, |k, _| {
            let n = self.matrix[k][k];
            if n > 0.0 { 1.0 / n.sqrt() } else { 1.0 }
        })
    }

    /// √(dᵀ N d)
    pub fn length(&self, d: &DVector<f64>) -> f64 {
        let sum: f64 = (0..self.u).map(|k| (0..self.u).map(|m| d[k] * self.matrix[k][m] * d[m]).sum::<f64>()).sum();
        sum.max(0.0).sqrt()
    }
}

/// The scaled normal matrix in the tangent space of the constraints, decomposed.
pub(super) struct Reduced {
    /// diag(scale) · Z, columns spanning the tangent space.
    basis: DMatrix<f64>,
    eigen: SymmetricEigen<f64, nalgebra::Dyn>,
}

impl Reduced {
    pub fn new(normal: &NormalEquations, constraints: Option<&Constraints>) -> Result<Self> {
        let u = normal.u;
        let scale = normal.scale();
        let mut basis = match constraints {
            Some(c) if !c.value.is_empty() => null_space(&scaled_rows(&c.jacobian, &scale)?)?,
            _ => DMatrix::identity(u, u),
        };
        for mut column in basis.column_iter_mut() {
            column.component_mul_assign(&scale);
        }
        let n = DMatrix::from_fn(u, u, |k, m| normal.matrix[k][m]);
        let small = basis.transpose() * n * &basis;
        let eigen = SymmetricEigen::try_new((&small + small.transpose()) * 0.5, 1e-15, 10_000)
            .ok_or_else(|| Error::Internal("the normal matrix has no eigenvalues".into()))?;
        Ok(Self { basis, eigen })
    }

    pub fn smallest_eigenvalue(&self) -> f64 {
        self.eigen.eigenvalues.iter().copied().fold(f64::INFINITY, f64::min)
    }

    /// The step −(N + λ diag N)⁻¹ g inside the constraints. Where N is singular to rounding, a little damping is added.
    pub fn solve(&self, normal: &NormalEquations, damping: f64) -> DVector<f64> {
        let gradient = DVector::from_fn(normal.u, |k, _| normal.gradient[k]);
        let largest = self.eigen.eigenvalues.iter().copied().fold(0.0, f64::max);
        let floor = if self.smallest_eigenvalue() < SINGULAR * largest { 1e-8 * largest } else { 0.0 };
        let rotated = self.eigen.eigenvectors.transpose() * (self.basis.transpose() * gradient);
        let y = DVector::from_fn(rotated.len(), |k, _| {
            let e = self.eigen.eigenvalues[k].max(0.0) + damping.max(floor);
            if e > 0.0 { -rotated[k] / e } else { 0.0 }
        });
        &self.basis * (&self.eigen.eigenvectors * y)
    }

    /// N⁻¹ in the tangent space.
    pub fn inverse(&self) -> DMatrix<f64> {
        let mut half = &self.basis * &self.eigen.eigenvectors;
        for (k, mut column) in half.column_iter_mut().enumerate() {
            column /= self.eigen.eigenvalues[k].sqrt();
        }
        &half * half.transpose()
    }

    /// An error that names the parameters which cannot be told apart.
    pub fn refuse_singular(&self, names: &[String], limit: f64) -> Result<()> {
        let (mut place, mut smallest, mut largest) = (0, f64::INFINITY, 0.0f64);
        for (k, e) in self.eigen.eigenvalues.iter().enumerate() {
            largest = largest.max(*e);
            if *e < smallest {
                (place, smallest) = (k, *e);
            }
        }
        if smallest > limit * largest {
            return Ok(());
        }
        // In scaled units the eigenvector says how much each parameter takes part.
        let direction = &self.basis * self.eigen.eigenvectors.column(place);
        let norms: Vec<f64> = (0..names.len()).map(|k| self.basis.row(k).norm()).collect();
        let share = |k: usize| if norms[k] > 0.0 { (direction[k] / norms[k]).abs() } else { 0.0 };
        let most = (0..names.len()).map(share).fold(0.0, f64::max);
        let involved: Vec<&str> =
            names.iter().enumerate().filter(|(k, _)| share(*k) > 0.2 * most).map(|(_, n)| n.as_str()).collect();
        Err(Error::Degenerate {
            what: format!("the points do not determine {}", involved.join(", ")),
            quantity: "smallest over largest eigenvalue of the scaled normal matrix",
            value: smallest / largest,
            limit,
            remedy: "spread the points over the photo and in depth, add some, or free fewer parameters",
        })
    }

    /// The smallest step (in scaled parameters) that fulfils linearised constraints, and its length relative to one.
    pub fn constraint_step(c: &Constraints, scale: &DVector<f64>) -> Result<(DVector<f64>, f64)> {
        let rows = scaled_rows(&c.jacobian, scale)?;
        let mut value = c.value.clone();
        for (i, v) in value.iter_mut().enumerate() {
            *v /= row_norm(&c.jacobian, scale, i);
        }
        let gram = &rows * rows.transpose();
        let multipliers = gram.lu().solve(&value).ok_or_else(dependent)?;
        let mut step = -(rows.transpose() * multipliers);
        let size = step.norm();
        step.component_mul_assign(scale);
        Ok((step, size))
    }
}

fn dependent() -> Error {
    Error::invalid("the constraints contradict or repeat each other: give each of them once")
}

fn row_norm(jacobian: &DMatrix<f64>, scale: &DVector<f64>, i: usize) -> f64 {
    (0..scale.len()).map(|k| (jacobian[(i, k)] * scale[k]).powi(2)).sum::<f64>().sqrt()
}

/// Rows in scaled parameters, of unit length.
fn scaled_rows(jacobian: &DMatrix<f64>, scale: &DVector<f64>) -> Result<DMatrix<f64>> {
    let mut rows = jacobian.clone();
    for i in 0..rows.nrows() {
        let norm = row_norm(jacobian, scale, i);
        if norm == 0.0 || !norm.is_finite() {
            return Err(Error::invalid(format!("constraint {} holds no free parameter", i + 1)));
        }
        for k in 0..scale.len() {
            rows[(i, k)] *= scale[k] / norm;
        }
    }
    Ok(rows)
}

/// An orthonormal basis of the vectors that the rows send to zero.
fn null_space(rows: &DMatrix<f64>) -> Result<DMatrix<f64>> {
    let (m, u) = rows.shape();
    if m >= u {
        return Err(Error::invalid(format!("{m} constraints leave nothing of {u} free parameters")));
    }
    let eigen = SymmetricEigen::new(rows.transpose() * rows);
    let mut order: Vec<usize> = (0..u).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    if eigen.eigenvalues[order[u - m]] < 1e-10 {
        return Err(dependent());
    }
    Ok(DMatrix::from_fn(u, u - m, |i, k| eigen.eigenvectors[(i, order[k])]))
}
