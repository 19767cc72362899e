"""How fast is a synthetic camera image of 10 million points in 12 megapixels, against NumPy, numba and Open3D?

The job: project all points from the scan's frame with pose and distortion, keep the nearest in each pixel, and give its
depth and its intensity; once with footprints of one pixel and once with each point drawn into 3 x 3 pixels, so that
near surfaces hide some of what shines through between their points. What colourreg does by default instead, finding the
surfaces between the points, also holds where gaps are wider than that; it has a row of its own, and so has the whole of
`render_sci`, which corrects and stretches the intensity, fills holes and gives each point's index and place as well.
Points in the order of the scan and shuffled. All contenders run in turn in processes of their own on the same input;
numba's compilation is not timed, nor is any import, and all were called with a thousandth of the points before, as
numba has to be, so that threads stand ready and memory has been touched. Open3D draws one pixel to the point alone.
Depths are compared with NumPy's. Limits: a made-up building of walls at four distances; a machine that does other
things moves all figures, the ratios less.

    python -m benches.peers.sci [--points 10000000] [--repeats 3]
"""

from __future__ import annotations

import importlib.util
import time

import numpy as np

from . import building
from .harness import compare, forget_peak, parser

WIDTH, HEIGHT = 4000, 3000


def cloud(points, order):
    """The building and what a scanner would have measured: (N, 3) in the scan's frame, intensity (N,)."""
    xyz = building.cloud(points, order, half=(0.72, 0.54))
    return xyz, np.random.default_rng(2).integers(0, 65535, len(xyz)).astype(np.float32)


def by_numpy(xyz, intensity, footprint):
    u, v, z = building.project(xyz, building.camera(WIDTH, HEIGHT))
    column, row = np.rint(u).astype(np.int64), np.rint(v).astype(np.int64)
    depth = np.full(WIDTH * HEIGHT, np.inf)
    reach = footprint // 2
    shifts = [(i, j) for j in range(-reach, reach + 1) for i in range(-reach, reach + 1)]
    cells = []
    for i, j in shifts:
        ok = (column + i >= 0) & (column + i < WIDTH) & (row + j >= 0) & (row + j < HEIGHT) & (z > 0)
        cell = (row[ok] + j) * WIDTH + column[ok] + i
        np.minimum.at(depth, cell, z[ok])
        cells.append((cell, ok))
    grey = np.zeros(WIDTH * HEIGHT, np.float32)
    for cell, ok in cells:
        front = depth[cell] == z[ok]
        grey[cell[front]] = intensity[ok][front]
    return depth.reshape(HEIGHT, WIDTH), grey.reshape(HEIGHT, WIDTH)


def by_colourreg(xyz, intensity, footprint):
    from colourreg_rs import PointCloud, draw_points

    return draw_points(PointCloud(xyz, intensity=intensity), bench_view(), splat=footprint)


def by_surfaces(xyz, intensity, footprint):
    from colourreg_rs import _core

    buffer = _core.IndexBuffer(building.view(WIDTH, HEIGHT))
    buffer.add(xyz)
    index, inverse, _ = _core.sci_front(buffer)
    with np.errstate(divide="ignore"):
        depth = np.divide(1.0, inverse, out=inverse)
    grey = intensity[index]  # -1 takes the last one, which the next line takes out
    grey[index < 0] = 0
    return depth, grey


def bench_view():
    from colourreg_rs import Camera, Pose, View

    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    params = dict(zip(names, building.camera(WIDTH, HEIGHT).tolist(), strict=True))
    camera, pose = Camera("OPENCV", WIDTH, HEIGHT, params), Pose(building.ROTATION, building.TRANSLATION)
    return View("bench", None, camera=camera, pose=pose)


def by_render_sci(xyz, intensity, footprint):
    from colourreg_rs import PointCloud, render_sci

    sci = render_sci(PointCloud(xyz, intensity=intensity), bench_view())
    return sci.depth, sci.raw


def numba_kernels():
    import numba

    place = building.numba_place(WIDTH, HEIGHT)

    @numba.njit(parallel=True, fastmath=True)
    def draw(xyz, intensity, reach, depths, greys):
        workers = depths.shape[0]
        n = len(xyz)
        for w in numba.prange(workers):
            depth, grey = depths[w], greys[w]
            for i in range(w * n // workers, (w + 1) * n // workers):
                x, y, z = place(xyz[i, 0], xyz[i, 1], xyz[i, 2])
                if z <= 0:
                    continue
                c, r = int(np.rint(x)), int(np.rint(y))
                for v in range(max(r - reach, 0), min(r + reach + 1, HEIGHT)):
                    for u in range(max(c - reach, 0), min(c + reach + 1, WIDTH)):
                        if z < depth[v, u]:
                            depth[v, u] = z
                            grey[v, u] = intensity[i]
        for v in numba.prange(HEIGHT):
            for w in range(1, workers):
                for u in range(WIDTH):
                    if depths[w, v, u] < depths[0, v, u]:
                        depths[0, v, u] = depths[w, v, u]
                        greys[0, v, u] = greys[w, v, u]

    def run(xyz, intensity, footprint):
        workers = numba.get_num_threads()
        depths = np.full((workers, HEIGHT, WIDTH), np.inf, np.float32)
        greys = np.zeros((workers, HEIGHT, WIDTH), np.float32)
        draw(xyz, intensity, footprint // 2, depths, greys)
        return depths[0], greys[0]

    return run


def _timed(run, points, order, footprint, check=False):
    xyz, intensity = cloud(int(points), order)
    run(np.ascontiguousarray(xyz[::1000]), intensity[::1000].copy(), int(footprint))
    forget_peak()
    begin = time.perf_counter()
    depth, _ = run(xyz, intensity, int(footprint))
    seconds = time.perf_counter() - begin
    if check:
        # Pixels at whose border a point lies may go to the neighbour by rounding.
        want, _ = by_numpy(xyz, intensity, 1)
        seen = np.isfinite(want) & np.isfinite(depth)
        assert seen.sum() > 0.99 * np.isfinite(want).sum(), "other pixels than NumPy's are seen"
        assert (np.abs(depth[seen] - want[seen]) < 1e-4 * want[seen]).mean() > 0.999, "other depths than NumPy's"
    return seconds


def colourreg(points, order, footprint):
    return _timed(by_colourreg, points, order, footprint, check=int(points) <= 2_000_000 and footprint == "1")


def colourreg_surfaces(points, order, footprint):
    return _timed(by_surfaces, points, order, footprint)


def colourreg_render_sci(points, order, footprint):
    return _timed(by_render_sci, points, order, footprint)


def numpy_minimum_at(points, order, footprint):
    return _timed(by_numpy, points, order, footprint)


def numba_private_buffers(points, order, footprint):
    return _timed(numba_kernels(), points, order, footprint)


def by_open3d(xyz, intensity):
    """Seconds with and without the making of its cloud. It knows no distortion and works in float32."""
    import open3d

    fx, fy, cx, cy = building.camera(WIDTH, HEIGHT)[:4]
    intrinsics = open3d.core.Tensor(np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]))
    extrinsics = np.eye(4)
    extrinsics[:3] = np.column_stack([building.ROTATION, building.TRANSLATION])
    extrinsics = open3d.core.Tensor(extrinsics)
    forget_peak()
    begin = time.perf_counter()
    made = open3d.t.geometry.PointCloud(open3d.core.Tensor(xyz.astype(np.float32)))
    made.point.colors = open3d.core.Tensor(np.repeat(intensity[:, None] / np.float32(65535), 3, axis=1))
    at_hand = time.perf_counter()
    image = made.project_to_rgbd_image(WIDTH, HEIGHT, intrinsics, extrinsics, depth_scale=1.0, depth_max=1e4)
    end = time.perf_counter()
    assert (image.depth.as_tensor().numpy() > 0).any(), "Open3D drew nothing"
    return end - begin, end - at_hand


def open3d(points, order, footprint):
    by_open3d(*cloud(int(points) // 1000, order))
    return by_open3d(*cloud(int(points), order))[0]


def open3d_cloud_at_hand(points, order, footprint):
    by_open3d(*cloud(int(points) // 1000, order))
    return by_open3d(*cloud(int(points), order))[1]


def main() -> None:
    arguments = parser((__doc__ or "").splitlines()[0]).parse_args()
    contenders = {"colourreg": colourreg, "numpy minimum.at": numpy_minimum_at}
    if importlib.util.find_spec("numba"):
        contenders["numba"] = numba_private_buffers
    else:
        print("numba is not installed and left out")
    one_pixel = dict(contenders)
    if importlib.util.find_spec("open3d"):
        one_pixel |= {"open3d": open3d, "open3d, its cloud at hand": open3d_cloud_at_hand}
    else:
        print("open3d is not installed and left out")
    ours = {}
    for footprint in ("1", "3"):
        for order in ("scan", "shuffled"):
            what = "one pixel" if footprint == "1" else "3 x 3 pixels"
            print(f"\n{arguments.points:,} points in {WIDTH} x {HEIGHT}, footprints of {what}, in {order} order")
            extra = {"colourreg, surfaces": colourreg_surfaces, "colourreg, render_sci": colourreg_render_sci}
            all_of_them = one_pixel if footprint == "1" else {**contenders, **extra}
            figures = compare(all_of_them, [str(arguments.points), order, footprint], arguments.repeats)
            ours[footprint, order] = figures[0].seconds
    for footprint in ("1", "3"):
        ratio = ours[footprint, "shuffled"] / ours[footprint, "scan"]
        print(f"shuffled / in order, footprint {footprint}: {ratio:.2f}")


if __name__ == "__main__":
    main()
