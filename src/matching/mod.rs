//! SCI against photo: where a piece of the synthetic camera image lies in the real one.
//!
//! Near-infrared reflectance and daylight look different: leaves are bright, print is gone, shadows are only in the
//! photo. What both share is where edges are and how they run, so that images are compared by their oriented gradients
//! ([`channels`]), with grey values ([`template::Measure::Grey`]) and mutual information as alternatives. What they do
//! not share comes from relief ([`relief()`]), and matches are trusted accordingly. Once the view is nearly right, the
//! points' intensities are explained by the photo's colours at the points' own places ([`regression`]).

pub mod channels;
mod correlation;
mod fourier;
pub mod information;
pub mod interest;
mod mutual;
mod peak;
pub mod plane;
pub mod regression;
mod relief;
mod spline;
pub mod template;

pub use information::{Information, InformationPhoto, information_distance};
pub use interest::{Interest, InterestOptions, interest_points};
pub use plane::Plane;
pub use regression::{Patch, RegressionOptions, RegressionPhoto, regress_patches};
pub use relief::relief;
pub use template::{Features, Match, Measure, Outcome, Scores, TemplateOptions, match_templates, score_templates};
