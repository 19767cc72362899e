//! The colour position error of a block of points: rays for all, then the tables, then the surfaces, each step in loops
//! that the compiler turns into vector instructions. Single precision suffices behind the difference to the centre.

use super::propagation::{MIN_COSINE, ObjectNoise, Slopes, SurfaceSigma};
use super::sigma_tables::{Cell, Face, Node, weights};

/// Points per block: all steps' arrays stay in the innermost cache.
pub(super) const BLOCK: usize = 128;

/// One coordinate of every point, side by side.
type Lane = [f32; BLOCK];

/// A scanner in the camera frame.
struct Station {
    /// From the projection centre.
    offset: [f32; 3],
    up: [f32; 3],
    /// Range, horizontal and vertical angle.
    sigmas: [f32; 3],
}

/// One sigma per axis on the surface for up to [`BLOCK`] points.
pub(super) fn fill_block(sigma: &SurfaceSigma, faces: &[Face], xyz: &[[f64; 3]], slopes: Slopes<'_>, out: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has the instructions that the function is compiled for.
        unsafe { fill_block_avx2(sigma, faces, xyz, slopes, out) };
        return;
    }
    fill_block_anywhere(sigma, faces, xyz, slopes, out);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn fill_block_avx2(sigma: &SurfaceSigma, faces: &[Face], xyz: &[[f64; 3]], slopes: Slopes<'_>, out: &mut [f32]) {
    fill_block_anywhere(sigma, faces, xyz, slopes, out);
}

#[inline(always)]
fn fill_block_anywhere(sigma: &SurfaceSigma, faces: &[Face], xyz: &[[f64; 3]], slopes: Slopes<'_>, out: &mut [f32]) {
    let n = xyz.len().min(out.len()).min(BLOCK);
    let pose = &sigma.view.pose;
    let rotation: [[f32; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|k| pose.rotation[(i, k)] as f32));
    let turn = |d: [f32; 3]| -> [f32; 3] {
        std::array::from_fn(|i| rotation[i][0] * d[0] + rotation[i][1] * d[1] + rotation[i][2] * d[2])
    };

    // Into the camera frame; the difference is formed in double precision.
    let mut ray: [Lane; 3] = [[0.0; BLOCK]; 3];
    for (i, p) in xyz[..n].iter().enumerate() {
        let d = [0, 1, 2].map(|a| (p[a] - pose.centre[a]) as f32);
        let q = turn(d);
        for a in 0..3 {
            ray[a][i] = q[a];
        }
    }
    let mut normal: [Lane; 3] = [[0.0; BLOCK]; 3];
    if let Some(normals) = slopes.normals {
        for (i, p) in normals[..n].iter().enumerate() {
            let q = turn(p.map(|x| x as f32));
            for a in 0..3 {
                normal[a][i] = q[a];
            }
        }
    }
    if let Some(planes) = slopes.planes {
        // All places first: the memory has time to bring what lies in them.
        let mut cells = [None; BLOCK];
        for i in 0..n {
            cells[i] = planes.locate(pick(&ray, i));
        }
        for i in 0..n {
            if !is_direction(pick(&normal, i))
                && let Some(cell) = cells[i]
                && let Some(found) = planes.normal_in(cell, pick(&ray, i))
            {
                for a in 0..3 {
                    normal[a][i] = found[a];
                }
            }
        }
    }
    let station = match sigma.object {
        ObjectNoise::Isotropic(_) => None,
        ObjectNoise::Scanner(s) => Some(Station {
            offset: turn([0, 1, 2].map(|a| (s.station[a] - pose.centre[a]) as f32)),
            up: turn([0.0, 0.0, 1.0]),
            sigmas: [s.sigma_range as f32, s.sigma_horizontal as f32, s.sigma_vertical as f32],
        }),
    };
    let mut beam: [Lane; 3] = [[0.0; BLOCK]; 3];
    let mut up: [Lane; 3] = [[0.0; BLOCK]; 3];
    if let Some(station) = &station {
        for a in 0..3 {
            for i in 0..n {
                beam[a][i] = ray[a][i] - station.offset[a];
                up[a][i] = station.up[a];
            }
        }
    }

    // Onto the faces: axes are renamed so that the third is the depth.
    let mut face = [0u8; BLOCK];
    if faces.len() > 1 {
        for i in 0..n {
            let size = [ray[0][i].abs(), ray[1][i].abs(), ray[2][i].abs()];
            let k = if size[0] >= size[1] && size[0] >= size[2] {
                0
            } else if size[1] >= size[2] {
                1
            } else {
                2
            };
            let negative = ray[k][i] < 0.0;
            face[i] = (2 * k + usize::from(negative)) as u8;
            let table = &faces[usize::from(face[i])];
            for lanes in [&mut ray, &mut normal, &mut beam, &mut up] {
                let q = table.axes.map(|a| lanes[a][i]);
                (lanes[0][i], lanes[1][i], lanes[2][i]) = (q[0], q[1], table.sign * q[2]);
            }
        }
    }

    // Rays with unit depth. Loops over whole blocks, however many points there are: their length is known.
    let (mut u, mut v, mut w): (Lane, Lane, Lane) = ([0.0; BLOCK], [0.0; BLOCK], [0.0; BLOCK]);
    for i in 0..BLOCK {
        w[i] = 1.0 / ray[2][i];
        u[i] = ray[0][i] * w[i];
        v[i] = ray[1][i] * w[i];
    }

    // The view's part: places on the tables, then the tables' cells, then the parabola in 1/Z.
    let Some(only) = faces.first() else { return out[..n].fill(f32::NAN) };
    let table = |i: usize| faces.get(usize::from(face[i])).unwrap_or(only);
    let several = faces.len() > 1;
    let mut places = Places::new();
    for i in 0..BLOCK {
        places.locate(i, if several { table(i) } else { only }, u[i], v[i], w[i]);
    }
    let mut sums: [Node; BLOCK] = [[f32::NAN; 8]; BLOCK];
    let mut to_do = [0u8; BLOCK];
    let mut open = 0;
    for i in 0..n {
        if !places.inside[i] {
            continue;
        }
        let table = if several { table(i) } else { only };
        let cell = [places.cell[0][i] as usize, places.cell[1][i] as usize];
        match table.kind(cell) {
            Cell::Interpolated => sums[i] = table.sums(cell, pick(&places.x, i), pick(&places.y, i)),
            Cell::Exact => {
                to_do[open] = i as u8;
                open += 1;
            }
            Cell::Outside => {}
        }
    }
    let mut part: [Lane; 3] = [[0.0; BLOCK]; 3];
    for i in 0..BLOCK {
        let efg = if several { table(i) } else { only }.shift(&sums[i], u[i], v[i], w[i]);
        (part[0][i], part[1][i], part[2][i]) = (efg[0], efg[1], efg[2]);
    }

    // Along the ray onto the surface.
    let own = match sigma.object {
        ObjectNoise::Isotropic(s) => (s * s) as f32,
        ObjectNoise::Scanner(_) => 0.0,
    };
    let min_cosine = MIN_COSINE as f32;
    let mut variance: Lane = [0.0; BLOCK];
    // m = n / (n · D) with the ray D = (u, v, 1)
    let mut m: [Lane; 3] = [[0.0; BLOCK]; 3];
    for i in 0..BLOCK {
        let (u, v, z) = (u[i], v[i], ray[2][i]);
        let square = u * u + v * v + 1.0;
        let (n1, n2, n3) = (normal[0][i], normal[1][i], normal[2][i]);
        let length2 = n1 * n1 + n2 * n2 + n3 * n3;
        // Without a normal the surface faces the camera.
        let has_normal = length2 > 0.0 && length2 < f32::MAX;
        let n1 = if has_normal { n1 } else { u };
        let n2 = if has_normal { n2 } else { v };
        let n3 = if has_normal { n3 } else { 1.0 };
        let length2 = if has_normal { length2 } else { square } * square;
        let along = n1 * u + n2 * v + n3;
        let least = min_cosine * length2.sqrt();
        let along = if along.abs() >= least { along } else { least };
        let inverse = 1.0 / along;
        let (m1, m2) = (n1 * inverse, n2 * inverse);
        // KᵀK of the map K from a shift in the plane Z = const to the surface.
        let k11 = 1.0 - 2.0 * u * m1 + m1 * m1 * square;
        let k12 = m1 * m2 * square - u * m2 - v * m1;
        let k22 = 1.0 - 2.0 * v * m2 + m2 * m2 * square;
        variance[i] = z * z * (part[0][i] * k11 + 2.0 * part[1][i] * k12 + part[2][i] * k22)
            + own * (1.0 + length2 * inverse * inverse);
        (m[0][i], m[1][i], m[2][i]) = (m1, m2, n3 * inverse);
    }
    if let Some(station) = &station {
        let [range, horizontal, vertical] = station.sigmas.map(|s| s * s);
        for i in 0..BLOCK {
            let b = [beam[0][i], beam[1][i], beam[2][i]];
            let level = cross(&[up[0][i], up[1][i], up[2][i]], &b);
            let steep = cross(&b, &level);
            let range2 = dot(&b, &b).max(f32::MIN_POSITIVE);
            let level2 = dot(&level, &level).max(f32::MIN_POSITIVE);
            let onto = |a: &[f32; 3]| {
                let along = a[0] * m[0][i] + a[1] * m[1][i] + a[2] * m[2][i];
                let on = [a[0] - u[i] * along, a[1] - v[i] * along, a[2] - along];
                dot(&on, &on)
            };
            variance[i] += range * onto(&b) / range2 + horizontal * onto(&level) + vertical * onto(&steep) / level2;
        }
    }
    for x in &mut variance {
        // Rounding may leave a little below zero; NaN stays.
        let half = 0.5 * *x;
        *x = if half < 0.0 { 0.0 } else { half }.sqrt();
    }
    out[..n].copy_from_slice(&variance[..n]);
    for i in to_do[..open].iter().map(|i| usize::from(*i)) {
        out[i] = sigma.exact(&xyz[i], slopes.normal(pose, i, &xyz[i]).as_ref()) as f32;
    }
}

/// Whether these are the components of a normal: some have none.
#[inline(always)]
pub(super) fn is_direction(n: [f32; 3]) -> bool {
    let square = dot(&n, &n);
    square > 0.0 && square < f32::MAX
}

/// Where the rays meet their tables.
struct Places {
    /// The cell's two numbers.
    cell: [[i32; BLOCK]; 2],
    /// Weights of the cell's nodes.
    x: [Lane; 3],
    y: [Lane; 3],
    inside: [bool; BLOCK],
}

impl Places {
    #[inline(always)]
    fn new() -> Self {
        Self { cell: [[0; BLOCK]; 2], x: [[0.0; BLOCK]; 3], y: [[0.0; BLOCK]; 3], inside: [false; BLOCK] }
    }

    #[inline(always)]
    fn locate(&mut self, i: usize, table: &Face, u: f32, v: f32, w: f32) {
        let [a, b] = table.place(u, v);
        let last = table.last();
        self.inside[i] = (a >= 0.0) & (a <= last) & (b >= 0.0) & (b <= last) & (w > 0.0);
        let highest = last * 0.5 - 1.0;
        let (ci, cj) = ((a * 0.5).clamp(0.0, highest) as i32, (b * 0.5).clamp(0.0, highest) as i32);
        (self.cell[0][i], self.cell[1][i]) = (ci, cj);
        let (x, y) = (weights(a - (2 * ci) as f32), weights(b - (2 * cj) as f32));
        (self.x[0][i], self.x[1][i], self.x[2][i]) = (x[0], x[1], x[2]);
        (self.y[0][i], self.y[1][i], self.y[2][i]) = (y[0], y[1], y[2]);
    }
}

/// One point's values; by reference, since mapping the array by value would copy whole lanes for each point.
#[inline(always)]
fn pick(lanes: &[Lane; 3], i: usize) -> [f32; 3] {
    [lanes[0][i], lanes[1][i], lanes[2][i]]
}

#[inline(always)]
fn dot(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn cross(a: &[f32; 3], b: &[f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
