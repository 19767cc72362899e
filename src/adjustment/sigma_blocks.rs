//! The colour position error of a block of points: rays for all, then the tables, then the surfaces, each step in loops
//! that the compiler turns into vector instructions. Single precision suffices behind the difference to the centre.

use super::propagation::{MIN_COSINE, ObjectNoise, Slopes, SurfaceSigma};
use super::sigma_tables::{Cell, Face, weights};
use crate::geometry::cube_face_of;

/// Points per block: all steps' arrays stay in the innermost cache.
pub(super) const BLOCK: usize = 128;
/// Points whose coordinates fill whole vectors.
const FOUR: usize = 4;

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

/// Room for the steps, of one block after the other. What stands behind the last point of a block is of an earlier one, and
/// nothing is made of it.
pub(super) struct Room {
    /// From the projection centre, world frame, point by point.
    arm: [[f32; 3]; BLOCK],
    /// In the camera frame, then in that of the face.
    ray: [Lane; 3],
    normal: [Lane; 3],
    beam: [Lane; 3],
    up: [Lane; 3],
    face: [u8; BLOCK],
    /// (X, Y)/Z and 1/Z.
    u: Lane,
    v: Lane,
    w: Lane,
    /// Above the plane of the tables' parabola.
    height: Lane,
    /// Where the planes of the surface are.
    cell: [u32; BLOCK],
    places: Places,
    /// What the tables say.
    part: [[f32; 4]; BLOCK],
    /// n / (n · D) with the ray D = (u, v, 1)
    m: [Lane; 3],
    variance: Lane,
}

impl Room {
    pub fn new() -> Self {
        let (lane, lanes) = ([0.0; BLOCK], [[0.0; BLOCK]; 3]);
        Self {
            arm: [[0.0; 3]; BLOCK],
            ray: lanes,
            normal: lanes,
            beam: lanes,
            up: lanes,
            face: [0; BLOCK],
            u: lane,
            v: lane,
            w: lane,
            height: lane,
            cell: [0; BLOCK],
            places: Places::new(),
            part: [[0.0; 4]; BLOCK],
            m: lanes,
            variance: lane,
        }
    }
}

/// One sigma per axis on the surface for up to [`BLOCK`] points. Planes have as many faces as the tables.
pub(super) fn fill_block(
    sigma: &SurfaceSigma,
    faces: &[Face],
    room: &mut Room,
    xyz: &[[f64; 3]],
    slopes: Slopes<'_>,
    out: &mut [f32],
) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has the instructions that the function is compiled for.
        unsafe { fill_block_avx2(sigma, faces, room, xyz, slopes, out) };
        return;
    }
    fill_block_here(sigma, faces, room, xyz, slopes, out);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn fill_block_avx2(
    sigma: &SurfaceSigma,
    faces: &[Face],
    room: &mut Room,
    xyz: &[[f64; 3]],
    slopes: Slopes<'_>,
    out: &mut [f32],
) {
    fill_block_here(sigma, faces, room, xyz, slopes, out);
}

#[inline(always)]
fn fill_block_here(
    sigma: &SurfaceSigma,
    faces: &[Face],
    room: &mut Room,
    xyz: &[[f64; 3]],
    slopes: Slopes<'_>,
    out: &mut [f32],
) {
    match faces {
        [_] => fill_block_on::<false>(sigma, faces, room, xyz, slopes, out),
        _ => fill_block_on::<true>(sigma, faces, room, xyz, slopes, out),
    }
}

/// On one face, or several.
#[inline(always)]
fn fill_block_on<const SEVERAL: bool>(
    sigma: &SurfaceSigma,
    faces: &[Face],
    room: &mut Room,
    xyz: &[[f64; 3]],
    slopes: Slopes<'_>,
    out: &mut [f32],
) {
    let n = xyz.len().min(out.len()).min(BLOCK);
    let Some(only) = faces.first() else { return out[..n].fill(f32::NAN) };
    let Room { arm, ray, normal, beam, up, face, u, v, w, height, cell, places, part, m, variance } = room;
    let pose = &sigma.view.pose;
    let rotation: [[f32; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|k| pose.rotation[(i, k)] as f32));
    let turn = |d: [f32; 3]| -> [f32; 3] {
        std::array::from_fn(|i| rotation[i][0] * d[0] + rotation[i][1] * d[1] + rotation[i][2] * d[2])
    };

    // Into the camera frame; the difference is formed in double precision.
    let centre: [f64; 3 * FOUR] = std::array::from_fn(|k| pose.centre[k % 3]);
    let (fours, rest) = xyz[..n].as_chunks::<FOUR>();
    for (points, arms) in fours.iter().zip(arm.as_chunks_mut::<FOUR>().0) {
        let (points, arms) = (points.as_flattened(), arms.as_flattened_mut());
        for k in 0..3 * FOUR {
            arms[k] = (points[k] - centre[k]) as f32;
        }
    }
    for (p, arm) in rest.iter().zip(&mut arm[n - rest.len()..]) {
        *arm = [0, 1, 2].map(|a| (p[a] - pose.centre[a]) as f32);
    }
    for i in 0..BLOCK {
        let q = turn(arm[i]);
        (ray[0][i], ray[1][i], ray[2][i]) = (q[0], q[1], q[2]);
    }
    if let Some(normals) = slopes.normals {
        for (i, p) in normals[..n].iter().enumerate() {
            let q = turn(p.map(|x| x as f32));
            (normal[0][i], normal[1][i], normal[2][i]) = (q[0], q[1], q[2]);
        }
    } else {
        *normal = [[0.0; BLOCK]; 3];
    }
    let station = match sigma.object {
        ObjectNoise::Isotropic(_) => None,
        ObjectNoise::Scanner(s) => Some(Station {
            offset: turn([0, 1, 2].map(|a| (s.station[a] - pose.centre[a]) as f32)),
            up: turn([0.0, 0.0, 1.0]),
            sigmas: [s.sigma_range as f32, s.sigma_horizontal as f32, s.sigma_vertical as f32],
        }),
    };
    if let Some(station) = &station {
        for a in 0..3 {
            for i in 0..n {
                beam[a][i] = ray[a][i] - station.offset[a];
                up[a][i] = station.up[a];
            }
        }
    }

    // Onto the faces: axes are renamed so that the third is the depth.
    if SEVERAL {
        for i in 0..n {
            let number = cube_face_of(pick(ray, i));
            face[i] = number as u8;
            let table = &faces[number];
            for lanes in [&mut *ray, &mut *normal, &mut *beam, &mut *up] {
                let q = table.axes.map(|a| lanes[a][i]);
                (lanes[0][i], lanes[1][i], lanes[2][i]) = (q[0], q[1], table.sign * q[2]);
            }
        }
    }
    let number = |i: usize| if SEVERAL { usize::from(face[i]) } else { 0 };
    let table = |i: usize| if SEVERAL { faces.get(number(i)).unwrap_or(only) } else { only };

    // Rays with unit depth. Loops over whole blocks, however many points there are: their length is known.
    for i in 0..BLOCK {
        w[i] = 1.0 / ray[2][i];
        u[i] = ray[0][i] * w[i];
        v[i] = ray[1][i] * w[i];
    }
    // Places on the surfaces' planes.
    let planes = slopes.planes;
    if let Some(planes) = planes {
        if SEVERAL {
            for i in 0..n {
                cell[i] = planes.face(number(i)).cell(u[i], v[i], w[i]);
            }
        } else {
            let face = planes.face(0);
            for i in 0..BLOCK {
                cell[i] = face.cell(u[i], v[i], w[i]);
            }
        }
    }

    // The view's part: places on the tables, then the tables' cells, then the parabola in 1/Z.
    for i in 0..BLOCK {
        places.locate(i, table(i), u[i], v[i], w[i]);
        height[i] = table(i).height(u[i], v[i], w[i]);
    }
    let mut to_do = [0u8; BLOCK];
    let mut open = 0;
    for i in 0..n {
        // The memory has time to bring it; many at once it would refuse.
        if let Some(planes) = planes {
            planes.face(number(i)).fetch(cell[i]);
        }
        let at = [places.cell[0][i] as usize, places.cell[1][i] as usize];
        part[i] = match if places.inside[i] { table(i).kind(at) } else { Cell::Outside } {
            Cell::Interpolated => table(i).interpolated(at, pick(&places.x, i), pick(&places.y, i), height[i]),
            Cell::Exact => {
                to_do[open] = i as u8;
                open += 1;
                [f32::NAN; 4]
            }
            Cell::Outside => [f32::NAN; 4],
        };
    }
    if let Some(planes) = planes {
        for i in 0..n {
            if (slopes.normals.is_none() || !is_direction(pick(normal, i)))
                && let Some(found) = planes.face(number(i)).normal(cell[i], u[i], v[i], w[i])
            {
                (normal[0][i], normal[1][i], normal[2][i]) = (found[0], found[1], found[2]);
            }
        }
    }

    // Along the ray onto the surface.
    let own = match sigma.object {
        ObjectNoise::Isotropic(s) => (s * s) as f32,
        ObjectNoise::Scanner(_) => 0.0,
    };
    let min_cosine = MIN_COSINE as f32;
    for i in 0..BLOCK {
        let [e, f, g, _] = part[i];
        let [e, f, g] = table(i).shift([e, f, g], u[i], v[i], height[i]);
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
        variance[i] = z * z * (e * k11 + 2.0 * f * k12 + g * k22) + own * (1.0 + length2 * inverse * inverse);
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
    for x in variance.iter_mut() {
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
        // Comparisons that turn NaN into 0.
        let within = |x: f32| {
            let x = if x > 0.0 { x } else { 0.0 };
            if x < highest { x } else { highest }
        };
        // SAFETY: both are between 0 and half a side.
        let (ci, cj) =
            unsafe { (within(a * 0.5).to_int_unchecked::<i32>(), within(b * 0.5).to_int_unchecked::<i32>()) };
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
