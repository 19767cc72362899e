//! The covariance of a view's parameters: by name, from a DLT's elements, and carried to pixels.

use nalgebra::{DMatrix, Matrix2, Matrix3, SMatrix, SVector, Vector3};

use crate::error::{Error, Result};
use crate::estimation::{FreeSet, MAX_FREE};
use crate::geometry::{Model, View, ViewJacobian, skew_matrix};

/// The names of a DLT matrix's elements, scaled to ‖(h31 h32 h33)‖ = 1, row by row.
pub const DLT_NAMES: [&str; 12] = ["h11", "h12", "h13", "h14", "h21", "h22", "h23", "h24", "h31", "h32", "h33", "h34"];

/// How many of [`FreeSet::dlt`]'s parameters the twelve elements stand for: pose, fx fy cx cy, skew.
const DLT_FREE: usize = 11;

/// Parameters that are uncertain, and how. What is not named is known.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewCovariance {
    free: FreeSet,
    matrix: DMatrix<f64>,
}

impl ViewCovariance {
    /// In the order of a free set.
    pub fn new(free: FreeSet, matrix: DMatrix<f64>) -> Result<Self> {
        let n = free.len();
        if matrix.shape() != (n, n) {
            return Err(Error::invalid(format!(
                "a covariance of {} by {} for {n} parameters ({})",
                matrix.nrows(),
                matrix.ncols(),
                free.names().join(" ")
            )));
        }
        if !matrix.iter().all(|v| v.is_finite()) {
            return Err(Error::invalid("the covariance of the view holds values that are not finite"));
        }
        if let Some(k) = (0..n).find(|&k| matrix[(k, k)] < 0.0) {
            return Err(Error::invalid(format!(
                "the variance of {} is negative: {:.3e}",
                free.names()[k],
                matrix[(k, k)]
            )));
        }
        let symmetric = (&matrix + matrix.transpose()) * 0.5;
        Ok(Self { free, matrix: symmetric })
    }

    /// From names in any order: those of the pose and the camera, or `h11` … `h34` of a DLT matrix with its distortion
    /// terms. The elements' covariance is turned into that of camera, skew and pose, which are the same eleven.
    pub fn from_names<S: AsRef<str>>(view: &View, names: &[S], matrix: &DMatrix<f64>) -> Result<Self> {
        let names: Vec<&str> = names.iter().map(|n| n.as_ref().trim()).collect();
        let k = names.len();
        if matrix.shape() != (k, k) {
            return Err(Error::invalid(format!(
                "{k} names of parameters and a covariance of {} by {}",
                matrix.nrows(),
                matrix.ncols()
            )));
        }
        if let Some(i) = (0..k).find(|&i| names[..i].contains(&names[i])) {
            return Err(Error::invalid(format!("the covariance names {} twice", names[i])));
        }
        let elements: Vec<Option<usize>> = DLT_NAMES.iter().map(|h| names.iter().position(|n| n == h)).collect();
        if elements.iter().any(Option::is_some) {
            let Some(elements) = elements.into_iter().collect::<Option<Vec<usize>>>() else {
                return Err(Error::invalid("a DLT's covariance names all of h11 … h34"));
            };
            return Self::from_dlt_elements(view, &names, &elements, matrix);
        }
        let free = if names.contains(&"skew") {
            FreeSet::dlt(&names.iter().filter(|n| is_dlt_distortion(n)).collect::<Vec<_>>())?
        } else {
            FreeSet::parse(view.camera.model(), &names)?
        };
        let places: Vec<Option<usize>> = free.names().iter().map(|n| names.iter().position(|m| m == n)).collect();
        if let Some(stranger) = names.iter().find(|n| !free.names().contains(n)) {
            return Err(Error::invalid(format!("the covariance names {stranger}, which is no single parameter")));
        }
        let at = |i: Option<usize>, j: Option<usize>| i.zip(j).map_or(0.0, |p| matrix[p]);
        Self::new(free.clone(), DMatrix::from_fn(free.len(), free.len(), |i, j| at(places[i], places[j])))
    }

    fn from_dlt_elements(view: &View, names: &[&str], elements: &[usize], matrix: &DMatrix<f64>) -> Result<Self> {
        if let Some(other) = names.iter().find(|n| !DLT_NAMES.contains(n) && !is_dlt_distortion(n)) {
            return Err(Error::invalid(format!("a DLT's covariance cannot hold {other} beside h11 … h34")));
        }
        let terms: Vec<&str> = names.iter().copied().filter(|n| is_dlt_distortion(n)).collect();
        let free = FreeSet::dlt(&terms)?;
        let by_elements = parameters_by_dlt_elements(view)?;
        let mut map = DMatrix::zeros(free.len(), names.len());
        for k in 0..DLT_FREE {
            for (e, column) in elements.iter().enumerate() {
                map[(k, *column)] = by_elements[(k, e)];
            }
        }
        for (i, name) in names.iter().enumerate() {
            if let Some(k) = free.position(name) {
                map[(k, i)] = 1.0;
            }
        }
        Self::new(free, &map * matrix * map.transpose())
    }

    /// The uncertain parameters.
    pub fn free(&self) -> &FreeSet {
        &self.free
    }

    /// Their covariance, in the free set's order.
    pub fn matrix(&self) -> &DMatrix<f64> {
        &self.matrix
    }

    /// The covariance as one of `h11` … `h34` and the distortion terms; `None` where the parameters are not a DLT's.
    pub fn dlt_elements(&self, view: &View) -> Option<(Vec<&'static str>, DMatrix<f64>)> {
        let names = self.free.names();
        self.free.position("skew")?;
        let terms = &names[DLT_FREE..];
        let mut map = DMatrix::zeros(DLT_NAMES.len() + terms.len(), names.len());
        map.view_mut((0, 0), (DLT_NAMES.len(), DLT_FREE)).copy_from(&dlt_elements_by_parameters(view));
        for i in 0..terms.len() {
            map[(DLT_NAMES.len() + i, DLT_FREE + i)] = 1.0;
        }
        let all = DLT_NAMES.iter().chain(terms).copied().collect();
        Some((all, &map * &self.matrix * map.transpose()))
    }

    /// J Σ Jᵀ for a pixel whose derivatives are given, px².
    pub fn pixel_covariance(&self, view: &View, j: &ViewJacobian) -> Matrix2<f64> {
        let u = self.free.len();
        let mut rows = [[0.0; MAX_FREE]; 2];
        self.free.columns(view, j, &mut rows);
        let mut weighted = [[0.0; MAX_FREE]; 2];
        for (out, row) in weighted.iter_mut().zip(&rows) {
            for m in 0..u {
                // Columns lie one after the other in memory; the matrix is symmetric.
                out[m] = self.matrix.column(m).iter().zip(row).map(|(s, a)| s * a).sum();
            }
        }
        Matrix2::from_fn(|i, k| (0..u).map(|m| weighted[i][m] * rows[k][m]).sum())
    }
}

fn is_dlt_distortion(name: &str) -> bool {
    Model::OpenCv.parameters()[4..].contains(&name)
}

fn calibration(view: &View) -> Matrix3<f64> {
    let p = view.camera.params();
    Matrix3::new(p[0], view.camera.skew(), p[2], 0.0, p[1], p[3], 0.0, 0.0, 1.0)
}

/// ∂(h11 … h34)/∂(pose, fx fy cx cy, skew) of `H = K [R | −R C]`.
fn dlt_elements_by_parameters(view: &View) -> DMatrix<f64> {
    let (k, r, c) = (calibration(view), view.pose.rotation, view.pose.centre);
    let mut columns = Vec::with_capacity(DLT_FREE);
    let with_centre = |m: Matrix3<f64>| (m, -(m * c));
    for axis in 0..3 {
        columns.push(with_centre(k * skew_matrix(&Vector3::ith(axis, 1.0)) * r));
    }
    for axis in 0..3 {
        columns.push((Matrix3::zeros(), -(k * r).column(axis).into_owned()));
    }
    for (i, j) in [(0, 0), (1, 1), (0, 2), (1, 2), (0, 1)] {
        let mut d = Matrix3::zeros();
        d[(i, j)] = 1.0;
        columns.push(with_centre(d * r));
    }
    DMatrix::from_fn(12, DLT_FREE, |e, p| {
        let (m, p4) = &columns[p];
        if e % 4 == 3 { p4[e / 4] } else { m[(e / 4, e % 4)] }
    })
}

/// The inverse of it, ∂(pose, fx fy cx cy, skew)/∂(h11 … h34): with `S = K⁻¹ δM Rᵀ = K⁻¹ δK + [δ]×`, whose second term is
/// antisymmetric and whose first is upper triangular. Formed in the frame of the projection centre, where the fourth
/// column is `−K R δC`, so that large coordinates cost no digits.
fn parameters_by_dlt_elements(view: &View) -> Result<SMatrix<f64, DLT_FREE, 12>> {
    let (k, r, c) = (calibration(view), view.pose.rotation, view.pose.centre);
    let k_inverse = k.try_inverse().ok_or_else(|| Error::invalid("the DLT matrix has no camera"))?;
    let m_inverse = r.transpose() * k_inverse;
    let mut map = SMatrix::<f64, DLT_FREE, 12>::zeros();
    for e in 0..12 {
        let mut dm = Matrix3::zeros();
        let mut p4 = Vector3::zeros();
        if e % 4 == 3 {
            p4[e / 4] = 1.0;
        } else {
            dm[(e / 4, e % 4)] = 1.0;
            // h4 + M C of the moved matrix: the fourth column seen from the projection centre.
            p4[e / 4] = c[e % 4];
        }
        let s = k_inverse * dm * r.transpose();
        // A change of the matrix's scale is no change of the view.
        let growth = s[(2, 2)];
        let turn = Vector3::new(s[(2, 1)], -s[(2, 0)], s[(1, 0)]);
        let d_k = k * (s - skew_matrix(&turn) - Matrix3::identity() * growth);
        let d_c = -(m_inverse * p4);
        let column = [
            turn.x,
            turn.y,
            turn.z,
            d_c.x,
            d_c.y,
            d_c.z,
            d_k[(0, 0)],
            d_k[(1, 1)],
            d_k[(0, 2)],
            d_k[(1, 2)],
            d_k[(0, 1)],
        ];
        map.set_column(e, &SVector::from(column));
    }
    Ok(map)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Camera, Pose, rotation_exp};

    fn dlt_view(centre: Vector3<f64>) -> View {
        let camera = Camera::new(Model::OpenCv, 4000, 3000, &[3100.0, 3060.0, 1980.0, 1510.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let pose = Pose { rotation: rotation_exp(&Vector3::new(0.4, -0.8, 0.3)), centre };
        View::new(camera.unwrap().with_skew(4.0), pose)
    }

    #[test]
    fn elements_and_parameters_are_two_names_of_one_thing() {
        let view = dlt_view(Vector3::new(3.0, -4.0, 1.5));
        let there = dlt_elements_by_parameters(&view);
        let back = parameters_by_dlt_elements(&view).unwrap();
        let identity = DMatrix::from_fn(11, 12, |i, j| back[(i, j)]) * there;
        assert!((identity - DMatrix::identity(11, 11)).amax() < 1e-9);
    }

    #[test]
    fn elements_move_as_their_derivatives_say() {
        let view = dlt_view(Vector3::new(3.0, -4.0, 1.5));
        let free = FreeSet::dlt::<&str>(&[]).unwrap();
        let there = dlt_elements_by_parameters(&view);
        let flat = |v: &View| v.matrix().unwrap().into_iter().flatten().collect::<Vec<f64>>();
        for (p, name) in free.names().into_iter().enumerate() {
            let h = if p < 6 { 1e-6 } else { 1e-2 };
            let mut d = vec![0.0; 11];
            d[p] = h;
            let plus = flat(&free.apply(&view, &d).unwrap());
            d[p] = -h;
            let minus = flat(&free.apply(&view, &d).unwrap());
            for e in 0..12 {
                let numeric = (plus[e] - minus[e]) / (2.0 * h);
                assert!((there[(e, p)] - numeric).abs() < 1e-5 * (1.0 + numeric.abs()), "{name} {}", DLT_NAMES[e]);
            }
        }
    }

    #[test]
    fn a_dlt_covariance_survives_its_elements_at_large_coordinates() {
        let view = dlt_view(Vector3::new(456_789.0, 5_812_345.0, 143.0));
        let free = FreeSet::dlt(&["k1"]).unwrap();
        let sigma = [1e-4, 2e-4, 3e-4, 0.01, 0.02, 0.01, 3.0, 3.0, 4.0, 5.0, 0.5, 1e-3];
        let matrix = DMatrix::from_fn(12, 12, |i, j| sigma[i] * sigma[j] * if i == j { 1.0 } else { 0.3 });
        let given = ViewCovariance::new(free, matrix.clone()).unwrap();
        let (names, elements) = given.dlt_elements(&view).unwrap();
        let back = ViewCovariance::from_names(&view, &names, &elements).unwrap();
        for i in 0..12 {
            for j in 0..12 {
                let error = (back.matrix()[(i, j)] - matrix[(i, j)]).abs();
                assert!(error < 1e-4 * sigma[i] * sigma[j], "{i} {j} {error:e}");
            }
        }
    }

    #[test]
    fn names_come_in_any_order_and_strangers_are_refused() {
        let view = dlt_view(Vector3::zeros());
        let m = DMatrix::from_row_slice(2, 2, &[4.0, 1.0, 1.0, 9.0]);
        let c = ViewCovariance::from_names(&view, &["cx", "rx"], &m).unwrap();
        assert_eq!(c.free().names(), ["rx", "cx"]);
        assert_eq!(c.matrix().as_slice(), [9.0, 1.0, 1.0, 4.0]);
        for (names, word) in [(["cx", "pose"], "pose"), (["h11", "h12"], "all of"), (["cx", "cx"], "twice")] {
            let error = ViewCovariance::from_names(&view, &names, &m).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        }
    }
}
