//! What is free: the parameters of a view that an estimate may change, their order, and their design columns.
//!
//! Order and meaning are those of every covariance: `rx ry rz` is a small rotation vector applied on the left
//! (`R ← exp([δ]×) R`), `cx_world cy_world cz_world` the projection centre, then camera parameters by name.

use nalgebra::Vector3;

use crate::error::{Error, Result};
use crate::geometry::{Camera, MAX_PARAMS, Model, View, ViewJacobian};

/// The names of the pose's six parameters, in order.
pub const POSE_NAMES: [&str; 6] = ["rx", "ry", "rz", "cx_world", "cy_world", "cz_world"];

/// The largest number of free parameters: the pose, every parameter of a camera, and a skew.
pub const MAX_FREE: usize = 6 + MAX_PARAMS + 1;

/// One free parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Parameter {
    /// `rx ry rz` (0..3) and `cx_world cy_world cz_world` (3..6).
    Pose(usize),
    /// `f`: fx, with fy following in its ratio to fx.
    Focal,
    /// `aspect`: fy / fx, with fx keeping its value.
    Aspect,
    /// One parameter of the camera, by its place in the model's order.
    Camera(usize),
    /// `skew` of a DLT matrix's camera, pixels.
    Skew,
}

/// The free parameters of views of one camera model, in the order of every covariance.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FreeSet {
    model: Model,
    parameters: Vec<Parameter>,
}

impl FreeSet {
    /// From names: `pose`, `f`, `aspect`, `pp`, `distortion`, and single parameters. Naming one twice is no error;
    /// sets that contradict each other (`f` and `fx`) are.
    pub fn parse<S: AsRef<str>>(model: Model, names: &[S]) -> Result<Self> {
        let mut found = Vec::new();
        for name in names.iter().map(|n| n.as_ref().trim()) {
            found.extend(parameters_of(model, name)?);
        }
        let has = |p: &Parameter| found.contains(p);
        for (whole, word) in [(Parameter::Focal, "f"), (Parameter::Aspect, "aspect")] {
            for (i, part) in ["fx", "fy"].into_iter().enumerate() {
                if has(&whole) && has(&Parameter::Camera(i)) {
                    return Err(Error::invalid(format!(
                        "`{word}` and `{part}` cannot both be free: name `f` (and `aspect`), or `fx` and `fy`"
                    )));
                }
            }
        }
        Ok(Self::ordered(model, &found))
    }

    /// The pose alone.
    pub fn pose(model: Model) -> Self {
        Self { model, parameters: (0..6).map(Parameter::Pose).collect() }
    }

    /// The eleven parameters of a DLT matrix as camera and pose (fx fy cx cy and skew), and distortion terms of
    /// k1 k2 p1 p2 k3. Views are those of [`View::from_dlt`].
    pub fn dlt<S: AsRef<str>>(distortion: &[S]) -> Result<Self> {
        let mut found: Vec<Parameter> = (0..6).map(Parameter::Pose).chain((0..4).map(Parameter::Camera)).collect();
        found.push(Parameter::Skew);
        for name in distortion.iter().map(|n| n.as_ref().trim()) {
            let place = Model::OpenCv.parameters().iter().position(|&n| n == name).filter(|&i| i >= 4);
            found.push(Parameter::Camera(place.ok_or_else(|| {
                Error::invalid(format!("a DLT has no distortion term `{name}`: it takes any of k1 k2 p1 p2 k3"))
            })?));
        }
        Ok(Self::ordered(Model::OpenCv, &found))
    }

    fn ordered(model: Model, found: &[Parameter]) -> Self {
        let mut all: Vec<Parameter> = (0..6).map(Parameter::Pose).collect();
        all.extend([Parameter::Focal, Parameter::Aspect]);
        all.extend((0..4).map(Parameter::Camera));
        all.push(Parameter::Skew);
        all.extend((4..MAX_PARAMS).map(Parameter::Camera));
        all.retain(|p| found.contains(p));
        Self { model, parameters: all }
    }

    /// The camera model that the set is of.
    pub fn model(&self) -> Model {
        self.model
    }

    /// How many parameters are free.
    pub fn len(&self) -> usize {
        self.parameters.len()
    }

    /// Whether nothing is free.
    pub fn is_empty(&self) -> bool {
        self.parameters.is_empty()
    }

    /// The parameters in order.
    pub fn parameters(&self) -> &[Parameter] {
        &self.parameters
    }

    /// Whether exactly the six parameters of the pose are free.
    pub fn is_pose(&self) -> bool {
        self.parameters.len() == 6 && self.parameters.iter().enumerate().all(|(i, p)| *p == Parameter::Pose(i))
    }

    /// Whether a parameter of the camera is free.
    pub fn frees_camera(&self) -> bool {
        self.parameters.iter().any(|p| !matches!(p, Parameter::Pose(_)))
    }

    /// The names in order.
    pub fn names(&self) -> Vec<&'static str> {
        self.parameters.iter().map(|p| name_of(self.model, *p)).collect()
    }

    /// The place of a parameter by its name.
    pub fn position(&self, name: &str) -> Option<usize> {
        self.parameters.iter().position(|p| name_of(self.model, *p) == name)
    }

    /// Which of `rx ry rz` (0..3) the parameter at a place is.
    pub fn rotation_axis(&self, place: usize) -> Option<usize> {
        match self.parameters.get(place) {
            Some(Parameter::Pose(i)) if *i < 3 => Some(*i),
            _ => None,
        }
    }

    /// The place of `rx ry rz` (0..3) in the set.
    pub fn rotation_place(&self, axis: usize) -> Option<usize> {
        self.parameters.iter().position(|p| *p == Parameter::Pose(axis))
    }

    /// The set without the parameters at these places.
    pub fn without(&self, places: &[usize]) -> Self {
        let kept = self.parameters.iter().enumerate().filter(|(i, _)| !places.contains(i));
        Self { model: self.model, parameters: kept.map(|(_, p)| *p).collect() }
    }

    /// The present values, in order. The rotation vector is zero by its definition: it is counted from `view` itself.
    pub fn values(&self, view: &View) -> Vec<f64> {
        let camera = view.camera.params();
        self.parameters
            .iter()
            .map(|p| match *p {
                Parameter::Pose(i) if i < 3 => 0.0,
                Parameter::Pose(i) => view.pose.centre[i - 3],
                Parameter::Focal => camera[0],
                Parameter::Aspect => camera[1] / camera[0],
                Parameter::Camera(i) => camera[i],
                Parameter::Skew => view.camera.skew(),
            })
            .collect()
    }

    /// The view after `delta` was added to the free parameters; refused where the camera becomes impossible.
    pub fn apply(&self, view: &View, delta: &[f64]) -> Result<View> {
        if delta.len() != self.parameters.len() {
            return Err(Error::Internal(format!("{} steps for {} free parameters", delta.len(), self.len())));
        }
        let mut turn = Vector3::zeros();
        let mut shift = Vector3::zeros();
        let mut camera = [0.0; MAX_PARAMS];
        let given = view.camera.params();
        camera[..given.len()].copy_from_slice(&given);
        let mut skew = view.camera.skew();
        let mut aspect = if given.is_empty() { 1.0 } else { given[1] / given[0] };
        let mut camera_changes = false;
        let mut aspect_rules = false;
        for (p, d) in self.parameters.iter().zip(delta) {
            camera_changes |= !matches!(p, Parameter::Pose(_));
            match *p {
                Parameter::Pose(i) if i < 3 => turn[i] = *d,
                Parameter::Pose(i) => shift[i - 3] = *d,
                Parameter::Focal => {
                    camera[0] += d;
                    aspect_rules = true;
                }
                Parameter::Aspect => {
                    aspect += d;
                    aspect_rules = true;
                }
                Parameter::Camera(i) => camera[i] += d,
                Parameter::Skew => skew += d,
            }
        }
        if aspect_rules {
            camera[1] = aspect * camera[0];
        }
        let pose = view.pose.perturbed(&turn, &shift);
        if !pose.centre.iter().chain(pose.rotation.iter()).all(|v| v.is_finite()) {
            return Err(Error::invalid("the step leads to a pose that is not finite"));
        }
        let camera = if camera_changes {
            let (width, height) = (view.camera.width, view.camera.height);
            Camera::new(view.camera.model(), width, height, &camera[..given.len()])?.with_skew(skew)
        } else {
            view.camera
        };
        Ok(View { camera, pose })
    }

    /// The two design rows d(x, y)/d(free parameters) of a point, from its derivatives at the same `view`, into the
    /// first [`FreeSet::len`] places of `rows`.
    #[inline]
    pub fn columns(&self, view: &View, j: &ViewJacobian, rows: &mut [[f64; MAX_FREE]; 2]) {
        // The set is ordered and without repetition: a sixth that is the pose's sixth means that all six are there.
        let whole_pose = self.parameters.get(5) == Some(&Parameter::Pose(5));
        let first = if whole_pose {
            rows[0][..6].copy_from_slice(&j.d_pose[0]);
            rows[1][..6].copy_from_slice(&j.d_pose[1]);
            6
        } else {
            0
        };
        for (k, p) in self.parameters.iter().enumerate().skip(first) {
            for (i, row) in rows.iter_mut().enumerate() {
                row[k] = match *p {
                    Parameter::Pose(m) => j.d_pose[i][m],
                    Parameter::Camera(m) => j.d_params[i][m],
                    other => {
                        let [fx, fy, _, cy] = view.camera.affine();
                        match other {
                            Parameter::Focal => j.d_params[i][0] + fy / fx * j.d_params[i][1],
                            Parameter::Aspect => fx * j.d_params[i][1],
                            // x = fx·xd + s·yd + cx
                            _ => [(j.xy[1] - cy) / fy, 0.0][i],
                        }
                    }
                };
            }
        }
    }
}

fn name_of(model: Model, parameter: Parameter) -> &'static str {
    match parameter {
        Parameter::Pose(i) => POSE_NAMES[i],
        Parameter::Focal => "f",
        Parameter::Aspect => "aspect",
        Parameter::Camera(i) => model.parameters().get(i).copied().unwrap_or("?"),
        Parameter::Skew => "skew",
    }
}

/// What one word of a free set stands for.
fn parameters_of(model: Model, name: &str) -> Result<Vec<Parameter>> {
    if name == "pose" {
        return Ok((0..6).map(Parameter::Pose).collect());
    }
    if let Some(i) = POSE_NAMES.iter().position(|&n| n == name) {
        return Ok(vec![Parameter::Pose(i)]);
    }
    let own = model.parameters();
    let places = |words: &[&str]| -> Vec<Parameter> {
        words.iter().filter_map(|w| own.iter().position(|n| n == w)).map(Parameter::Camera).collect()
    };
    let found = match name {
        "f" | "aspect" if own.is_empty() => Vec::new(),
        "f" => vec![Parameter::Focal],
        "aspect" => vec![Parameter::Aspect],
        "pp" => places(&["cx", "cy"]),
        "distortion" if model == Model::OpenCvFisheye => places(&["k1", "k2", "k3", "k4"]),
        "distortion" => places(&["k1", "k2", "p1", "p2"]),
        _ => places(&[name]),
    };
    if found.is_empty() {
        let remedy = match name {
            "skew" => "; a skew is estimated by a DLT".into(),
            "distortion" if model == Model::Pinhole => "; give the camera as OPENCV".into(),
            _ => format!(
                ": name pose, {}or single ones of {}",
                if own.is_empty() { "" } else { "f, aspect, pp, distortion, " },
                POSE_NAMES.iter().chain(own).copied().collect::<Vec<_>>().join(" ")
            ),
        };
        return Err(Error::invalid(format!("`{name}` cannot be free in a camera of model {}{remedy}", model.name())));
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Pose, rotation_exp};

    fn view(model: Model) -> View {
        let all = [1500.0, 1480.0, 990.0, 760.0, -0.05, 0.01, 1e-3, -5e-4, 2e-3, 0.01, 0.002, -0.001];
        let camera = Camera::new(model, 2000, 1500, &all[..model.parameters().len()]).unwrap();
        let pose = Pose { rotation: rotation_exp(&Vector3::new(0.1, -0.2, 0.3)), centre: Vector3::new(1.0, 2.0, -3.0) };
        View::new(camera, pose)
    }

    #[test]
    fn names_come_in_the_order_of_every_covariance() {
        let set = FreeSet::parse(Model::OpenCv, &["k3", "distortion", "pp", "f", "pose", "cx"]).unwrap();
        let names =
            ["rx", "ry", "rz", "cx_world", "cy_world", "cz_world", "f", "cx", "cy", "k1", "k2", "p1", "p2", "k3"];
        assert_eq!(set.names(), names);
        assert_eq!(FreeSet::parse(Model::OpenCv, &set.names()).unwrap(), set);
        let fisheye = FreeSet::parse(Model::OpenCvFisheye, &["distortion"]).unwrap();
        assert_eq!(fisheye.names(), ["k1", "k2", "k3", "k4"]);
        let dlt = FreeSet::dlt(&["k3", "k1"]).unwrap();
        assert_eq!(dlt.names()[6..], ["fx", "fy", "cx", "cy", "skew", "k1", "k3"]);
    }

    #[test]
    fn contradictions_and_strangers_are_refused_in_a_line() {
        let message = |model, names: &[&str]| FreeSet::parse(model, names).unwrap_err().to_string();
        assert!(message(Model::OpenCv, &["f", "fy"]).contains("`f` and `fy`"));
        assert!(message(Model::OpenCv, &["aspect", "fx"]).contains("`aspect` and `fx`"));
        assert!(message(Model::OpenCv, &["k4"]).contains("`k4` cannot be free in a camera of model OPENCV"));
        assert!(message(Model::Pinhole, &["distortion"]).contains("give the camera as OPENCV"));
        assert!(message(Model::Equirectangular, &["f"]).contains("EQUIRECTANGULAR"));
        assert!(message(Model::OpenCv, &["skew"]).contains("DLT"));
        assert!(FreeSet::dlt(&["k4"]).unwrap_err().to_string().contains("k4"));
    }

    #[test]
    fn columns_are_the_derivatives_of_apply() {
        let sets = [
            FreeSet::parse(Model::FullOpenCv, &["pose", "f", "aspect", "pp", "distortion", "k5"]).unwrap(),
            FreeSet::parse(Model::OpenCvFisheye, &["rz", "cy_world", "fx", "fy", "distortion"]).unwrap(),
            FreeSet::parse(Model::Pinhole, &["pose", "f"]).unwrap(),
            FreeSet::parse(Model::Equirectangular, &["pose"]).unwrap(),
            FreeSet::dlt(&["k1", "p2"]).unwrap(),
        ];
        let point = [2.5, 0.5, 7.0];
        for set in sets {
            let mut v = view(set.model());
            if set.position("skew").is_some() {
                v.camera = v.camera.with_skew(3.0);
            }
            let mut rows = [[0.0; MAX_FREE]; 2];
            set.columns(&v, &v.project_with_jacobian(&point).unwrap(), &mut rows);
            for (k, name) in set.names().into_iter().enumerate() {
                let h = if matches!(name, "f" | "fx" | "fy" | "cx" | "cy" | "skew") { 1e-2 } else { 1e-5 };
                let at = |s: f64| {
                    let mut d = vec![0.0; set.len()];
                    d[k] = s * h;
                    set.apply(&v, &d).unwrap().project(&point).unwrap().0
                };
                let (plus, minus) = (at(1.0), at(-1.0));
                for i in 0..2 {
                    let numeric = (plus[i] - minus[i]) / (2.0 * h);
                    assert!(
                        (rows[i][k] - numeric).abs() < 1e-5 * (1.0 + numeric.abs()),
                        "{name}: {} {numeric}",
                        rows[i][k]
                    );
                }
            }
        }
    }

    #[test]
    fn values_move_by_the_step() {
        let set = FreeSet::parse(Model::OpenCv, &["pose", "f", "aspect", "cx", "k1"]).unwrap();
        let v = view(Model::OpenCv);
        let step: Vec<f64> = (0..set.len()).map(|i| if i < 3 { 0.0 } else { 0.01 * i as f64 }).collect();
        let moved = set.values(&set.apply(&v, &step).unwrap());
        for ((a, b), d) in set.values(&v).iter().zip(&moved).zip(&step) {
            assert!((a + d - b).abs() < 1e-12);
        }
        let only_f = FreeSet::parse(Model::OpenCv, &["f"]).unwrap();
        let params = only_f.apply(&v, &[150.0]).unwrap().camera.params();
        assert!((params[0] - 1650.0).abs() < 1e-9 && (params[1] - 1628.0).abs() < 1e-9);
        assert!(only_f.apply(&v, &[-2000.0]).is_err());
    }
}
