//! What is known of a view before its estimate: values with a sigma, which act like observations, and held ones.

use nalgebra::{Matrix3, Vector3};

use super::parameters::{FreeSet, MAX_FREE};
use crate::error::{Error, Result};
use crate::geometry::{View, rotation_exp, rotation_log, skew_matrix};

/// What was known of a parameter before.
#[derive(Debug, Clone, PartialEq)]
pub struct Prior {
    /// As in the free set; `rx ry rz` count from the rotation of the view given.
    pub name: String,
    /// In the parameter's unit, world coordinates for the projection centre.
    pub value: f64,
    /// Zero holds the parameter at its value.
    pub sigma: f64,
}

/// A free parameter that was known before, with its sigma. Acts like an observation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PriorTerm {
    /// Its place in the free set.
    pub place: usize,
    /// In the local frame; for `rx ry rz` a rotation vector counted from the reference.
    pub value: f64,
    /// Greater than zero.
    pub sigma: f64,
}

/// Prior knowledge of a view.
#[derive(Debug, Clone)]
pub(super) struct Priors {
    pub terms: Vec<PriorTerm>,
    /// What rotation priors count from.
    pub reference: Matrix3<f64>,
}

impl Default for Priors {
    fn default() -> Self {
        Self { terms: Vec::new(), reference: Matrix3::identity() }
    }
}

impl Priors {
    /// Misclosure in sigmas and its derivatives by the free parameters, for each term.
    pub fn rows(&self, free: &FreeSet, view: &View) -> Vec<(f64, [f64; MAX_FREE])> {
        if self.terms.is_empty() {
            return Vec::new();
        }
        let values = free.values(view);
        let turn = rotation_log(&(view.pose.rotation * self.reference.transpose()));
        let by_turn = inverse_left_jacobian(&turn);
        self.terms
            .iter()
            .map(|t| {
                let mut row = [0.0; MAX_FREE];
                let value = match free.rotation_axis(t.place) {
                    Some(axis) => {
                        for k in 0..3 {
                            if let Some(place) = free.rotation_place(k) {
                                row[place] = by_turn[(axis, k)] / t.sigma;
                            }
                        }
                        turn[axis]
                    }
                    None => {
                        row[t.place] = 1.0 / t.sigma;
                        values[t.place]
                    }
                };
                ((value - t.value) / t.sigma, row)
            })
            .collect()
    }
}

/// d log(exp(δ) R) / dδ at log R = ω.
fn inverse_left_jacobian(w: &Vector3<f64>) -> Matrix3<f64> {
    let theta2 = w.norm_squared();
    let theta = theta2.sqrt();
    let k = skew_matrix(w);
    let c = if theta < 1e-3 { 1.0 / 12.0 + theta2 / 720.0 } else { (1.0 - 0.5 * theta / (0.5 * theta).tan()) / theta2 };
    Matrix3::identity() - k * 0.5 + k * k * c
}

/// A prior as a term of the problem; held ones keep only their value.
pub(super) fn resolve(prior: &Prior, free: &FreeSet, view: &View, origin: &Vector3<f64>) -> Result<PriorTerm> {
    let Prior { name, value, sigma } = prior;
    if !value.is_finite() || !sigma.is_finite() || *sigma < 0.0 {
        return Err(Error::invalid(format!("prior of `{name}`: {value} ± {sigma} is not possible")));
    }
    let place = match free.position(name) {
        Some(place) => place,
        None if *sigma == 0.0 => {
            // Held and not free: the value must still be one that the view has, and that nothing else moves.
            FreeSet::parse(view.camera.model(), &[name])?;
            if let Some(whole) = ["f", "aspect"].iter().find(|w| free.position(w).is_some())
                && matches!(name.as_str(), "fx" | "fy")
            {
                return Err(Error::invalid(format!(
                    "`{name}` cannot be held while `{whole}` is free, which moves it: hold `f`, or free fx and fy by name"
                )));
            }
            0
        }
        None => {
            return Err(Error::invalid(format!(
                "`{name}` has a prior with a sigma, but is not free: the free parameters are {}",
                free.names().join(" ")
            )));
        }
    };
    let shift = ["cx_world", "cy_world", "cz_world"].iter().position(|n| n == name).map_or(0.0, |k| origin[k]);
    Ok(PriorTerm { place, value: value - shift, sigma: *sigma })
}

/// The view with parameters set to values (local frame).
pub(super) fn set_values(view: &View, values: &[(String, f64)], reference: &Matrix3<f64>) -> Result<View> {
    let mut view = *view;
    let mut turn = Vector3::zeros();
    let mut turns = false;
    for (name, value) in values {
        if let Some(axis) = ["rx", "ry", "rz"].iter().position(|n| n == name) {
            turn[axis] = *value;
            turns = true;
            continue;
        }
        let one = FreeSet::parse(view.camera.model(), &[name])?;
        if one.len() != 1 {
            return Err(Error::invalid(format!(
                "`{name}` is a group: give a prior for each of {}",
                one.names().join(" ")
            )));
        }
        view = one.apply(&view, &[value - one.values(&view)[0]])?;
    }
    if turns {
        view.pose.rotation = rotation_exp(&turn) * reference;
    }
    Ok(view)
}
