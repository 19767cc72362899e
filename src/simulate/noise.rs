//! Procedural noise, filtered by the footprint of whatever looks at it.
//!
//! Gradient noise on an integer lattice (Perlin 2002: quintic fade, twelve edge directions), summed over octaves. An
//! octave whose wavelength comes near the footprint of the sample fades out, so that the sum is band-limited: what
//! could only alias is left out.

/// A well-mixed 32-bit hash of a lattice point.
#[inline]
pub fn hash(x: i32, y: i32, z: i32, seed: u32) -> u32 {
    let mut h = seed
        ^ (x as u32).wrapping_mul(0x9E37_79B1)
        ^ (y as u32).wrapping_mul(0x85EB_CA77)
        ^ (z as u32).wrapping_mul(0xC2B2_AE3D);
    h ^= h >> 15;
    h = h.wrapping_mul(0x2C1B_3C6D);
    h ^= h >> 12;
    h = h.wrapping_mul(0x297A_2D39);
    h ^ (h >> 15)
}

/// A hash as a number in [−1, 1).
#[inline]
pub fn signed(h: u32) -> f32 {
    (h >> 8) as f32 * (2.0 / 16_777_216.0) - 1.0
}

/// The largest integer not above `x`, and what is left. Rounding by conversion: without SSE 4.1, `floor` is a call.
#[inline]
pub fn split(x: f64) -> (i32, f64) {
    let whole = x as i32;
    let whole = whole - i32::from(x < f64::from(whole));
    (whole, x - f64::from(whole))
}

/// The Hermite step from 0 at `a` to 1 at `b`.
#[inline]
pub fn smoothstep(a: f32, b: f32, x: f32) -> f32 {
    let t = ((x - a) / (b - a)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// The weight of a pattern of the given wavelength under a footprint: 1 when well resolved, 0 from just above the
/// sampling limit on.
#[inline]
pub fn resolved(footprint: f32, wavelength: f32) -> f32 {
    1.0 - smoothstep(0.3, 0.7, footprint / wavelength)
}

#[inline]
fn fade(t: f32) -> f32 {
    t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
}

/// The directions of the gradients: the middles of a cube's twelve edges, four of them twice.
#[rustfmt::skip]
const DIRECTIONS: [[f32; 4]; 16] = [
    [1.0, 1.0, 0.0, 0.0], [-1.0, 1.0, 0.0, 0.0], [1.0, -1.0, 0.0, 0.0], [-1.0, -1.0, 0.0, 0.0],
    [1.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 1.0, 0.0], [1.0, 0.0, -1.0, 0.0], [-1.0, 0.0, -1.0, 0.0],
    [0.0, 1.0, 1.0, 0.0], [0.0, -1.0, 1.0, 0.0], [0.0, 1.0, -1.0, 0.0], [0.0, -1.0, -1.0, 0.0],
    [1.0, 1.0, 0.0, 0.0], [-1.0, 1.0, 0.0, 0.0], [0.0, -1.0, 1.0, 0.0], [0.0, -1.0, -1.0, 0.0],
];

#[inline]
fn slope(h: u32, x: f32, y: f32, z: f32) -> f32 {
    // A table, not branches: the hash is random, and so would be every branch.
    let d = &DIRECTIONS[(h >> 28) as usize];
    d[0] * x + d[1] * y + d[2] * z
}

#[inline]
fn mix(a: f32, b: f32, t: f32) -> f32 {
    a + t * (b - a)
}

/// Gradient noise at a point in lattice units: continuous with two derivatives, mean 0, about ±1.
#[inline]
pub fn gradient(p: [f64; 3], seed: u32) -> f32 {
    let ((i, x), (j, y), (k, z)) = (split(p[0]), split(p[1]), split(p[2]));
    let (x, y, z) = (x as f32, y as f32, z as f32);
    let (u, v, w) = (fade(x), fade(y), fade(z));
    // One multiplication after the products is mixing enough for the four bits that are used.
    let row = |v: i32, factor: u32| [(v as u32).wrapping_mul(factor), (v as u32).wrapping_add(1).wrapping_mul(factor)];
    let (hx, hy, hz) = (row(i, 0x9E37_79B1), row(j, 0x85EB_CA77), row(k, 0xC2B2_AE3D));
    let corner = |di: usize, dj: usize, dk: usize| {
        let h = hx[di] ^ hy[dj] ^ hz[dk] ^ seed;
        let h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
        slope(h ^ (h << 13), x - di as f32, y - dj as f32, z - dk as f32)
    };
    mix(
        mix(mix(corner(0, 0, 0), corner(1, 0, 0), u), mix(corner(0, 1, 0), corner(1, 1, 0), u), v),
        mix(mix(corner(0, 0, 1), corner(1, 0, 1), u), mix(corner(0, 1, 1), corner(1, 1, 1), u), v),
        w,
    )
}

/// Fractal sum of `octaves` octaves, each of half the wavelength and `gain` times the amplitude of the last.
///
/// `p` and `footprint` are in units of the first octave's wavelength.
#[inline]
pub fn fractal(p: [f64; 3], footprint: f32, octaves: u32, gain: f32, seed: u32) -> f32 {
    let (mut sum, mut amplitude, mut frequency) = (0.0, 1.0, 1.0_f64);
    for octave in 0..octaves {
        let weight = resolved(footprint * frequency as f32, 1.0);
        if weight <= 0.0 {
            break;
        }
        let q = [p[0] * frequency, p[1] * frequency, p[2] * frequency];
        sum += weight * amplitude * gradient(q, seed.wrapping_add(octave.wrapping_mul(0x68E3_1DA4)));
        amplitude *= gain;
        // Not exactly 2: the lattices of the octaves must not share their zeros.
        frequency *= 2.03;
    }
    sum
}

/// The part of a footprint of width `w` about `x` that pulses of width `duty` and period 1 cover: a box filter, exact.
#[inline]
pub fn pulse_coverage(x: f32, w: f32, duty: f32) -> f32 {
    let integral = |x: f32| {
        let (whole, part) = split(f64::from(x));
        whole as f32 * duty + (part as f32).min(duty)
    };
    let w = w.max(1e-5);
    ((integral(x + 0.5 * w) - integral(x - 0.5 * w)) / w).clamp(0.0, 1.0)
}

/// The part of a footprint of width `w` about `x` above `edge`.
#[inline]
pub fn step_coverage(x: f32, w: f32, edge: f32) -> f32 {
    ((x - edge) / w.max(1e-6) + 0.5).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_continuous_across_lattice_planes_and_has_zero_mean() {
        let mut sum = 0.0;
        for i in 0..4000 {
            let p = [f64::from(i) * 0.37, f64::from(i) * 0.11, 2.5];
            sum += f64::from(gradient(p, 7));
            let on_plane = [p[0].floor(), p[1], p[2]];
            let below = [on_plane[0] - 1e-6, p[1], p[2]];
            assert!((gradient(on_plane, 7) - gradient(below, 7)).abs() < 1e-4);
        }
        assert!((sum / 4000.0).abs() < 0.03, "mean {}", sum / 4000.0);
    }

    #[test]
    fn what_cannot_be_resolved_is_left_out() {
        let p = [0.3, 0.4, 0.5];
        assert_eq!(fractal(p, 1.0, 6, 0.5, 1), 0.0);
        let coarse = fractal(p, 0.2, 6, 0.5, 1);
        assert_eq!(coarse, fractal(p, 0.2, 2, 0.5, 1), "octaves below the footprint do not contribute");
        assert_ne!(coarse, fractal(p, 0.0, 6, 0.5, 1));
    }

    #[test]
    fn coverage_is_the_box_filtered_pulse() {
        for (x, w, duty) in [(0.3_f32, 0.2_f32, 0.35_f32), (1.02, 0.5, 0.1), (0.7, 3.3, 0.25), (-0.4, 0.9, 0.5)] {
            let n = 20_000;
            let inside = (0..n)
                .filter(|&i| {
                    let s = x + w * ((i as f32 + 0.5) / n as f32 - 0.5);
                    s - s.floor() < duty
                })
                .count();
            let expected = inside as f32 / n as f32;
            assert!((pulse_coverage(x, w, duty) - expected).abs() < 1e-3);
        }
    }
}
