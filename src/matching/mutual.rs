//! Mutual information of a template and the photo at each shift: the likeness that assumes nothing about how the grey
//! values of the two correspond, only that they do. Normalised as 2 I(a, b) / (H(a) + H(b)), so that 1 is a function in
//! both directions and 0 independence.

use super::channels::Channels;
use super::correlation::{Placement, Surface};

/// Scores of every shift. Plane 0 of both holds bin numbers 0 … bins − 1.
///
/// `None` where the template does not lie wholly in the picture. The second value is the number of known pixels, the
/// third their share of the template.
pub(super) fn search(
    sci: &Channels,
    photo: &Channels,
    at: &Placement,
    bins: usize,
    least_known: f32,
) -> Option<(Surface, f32, f32)> {
    let (half, radius) = (at.half as isize, at.radius as isize);
    let (w, h) = (sci.weight.width as isize, sci.weight.height as isize);
    let (x, y) = (at.x as isize, at.y as isize);
    if x < half || y < half || x + half >= w || y + half >= h {
        return None;
    }
    let side = 2 * at.half + 1;
    let mut template = Vec::with_capacity(side * side);
    for v in y - half..=y + half {
        for u in x - half..=x + half {
            if sci.weight.at(u as usize, v as usize) > 0.0 {
                template.push((u, v, sci.planes[0].at(u as usize, v as usize) as usize));
            }
        }
    }
    let shifts = 2 * at.radius + 1;
    let mut scores = vec![f32::NAN; shifts * shifts];
    let known = template.len() as f32;
    let share = known / (side * side) as f32;
    if share >= least_known {
        let mut joint = vec![0u32; bins * bins];
        for (i, score) in scores.iter_mut().enumerate() {
            let (dx, dy) = ((i % shifts) as isize - radius, (i / shifts) as isize - radius);
            joint.fill(0);
            let mut count = 0u32;
            for &(u, v, bin) in &template {
                let (px, py) = (u + dx, v + dy);
                if px >= 0 && py >= 0 && px < w && py < h && photo.weight.at(px as usize, py as usize) > 0.0 {
                    joint[bin * bins + photo.planes[0].at(px as usize, py as usize) as usize] += 1;
                    count += 1;
                }
            }
            if count as f32 >= at.least_overlap * known && count > 0 {
                *score = normalised_information(&joint, bins, count);
            }
        }
    }
    Some((Surface { radius: at.radius, scores }, known, share))
}

fn normalised_information(joint: &[u32], bins: usize, count: u32) -> f32 {
    let total = f64::from(count);
    let entropy = |counts: &mut dyn Iterator<Item = u32>| -> f64 {
        counts.filter(|c| *c > 0).map(|c| f64::from(c) / total).map(|p| -p * p.ln()).sum()
    };
    let of_both = entropy(&mut joint.iter().copied());
    let of_rows = entropy(&mut joint.chunks(bins).map(|row| row.iter().sum()));
    let of_columns = entropy(&mut (0..bins).map(|c| joint.iter().skip(c).step_by(bins).sum()));
    let sum = of_rows + of_columns;
    if sum > 0.0 { (2.0 * (sum - of_both) / sum) as f32 } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_relabelling_is_certain_and_independence_is_nothing() {
        let relabelled = [0, 30, 0, 10, 0, 0, 0, 0, 20];
        assert!((normalised_information(&relabelled, 3, 60) - 1.0).abs() < 1e-6);
        let independent = [4, 6, 2, 6, 9, 3, 2, 3, 1];
        assert!(normalised_information(&independent, 3, 36).abs() < 1e-6);
    }
}
