"""How fast are 10 million points projected with distortion, pixels and depth in float64?

Peers: NumPy as one writes it, OpenCV's projectPoints, pycolmap's camera, a parallel numba kernel (fresh and reused
output). Each in a process of its own on the same input, best of three calls after a warm-up, since the first touch of
fresh memory is not what is asked; all agree to 1e-6 px. Limits: the camera stands in the origin, so that OpenCV and
pycolmap lose no digits; pycolmap gives no depth.

    python -m benches.peers.projection [--points 10000000] [--repeats 3]
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from . import building
from .harness import compare, forget_peak, parser

WIDTH, HEIGHT = 6000, 4000


def _best(points: str, run: Callable[[np.ndarray], Any]) -> float:
    xyz = building.cloud(int(points))
    some = np.ascontiguousarray(xyz[:: max(len(xyz) // 1000, 1)])
    want = np.stack(building.project(some, building.camera(WIDTH, HEIGHT))[:2], 1)
    found = np.asarray(run(some)[0])
    assert np.abs(found - want).max() < 1e-6
    times = []
    forget_peak()
    for _ in range(4):
        began = time.perf_counter()
        run(xyz)
        times.append(time.perf_counter() - began)
    return min(times[1:])


def colourreg(points: str) -> float:
    from colourreg_rs import _core

    view = building.view(WIDTH, HEIGHT)
    return _best(points, lambda xyz: _core.project(view, xyz))


def colourreg_reused(points: str) -> float:
    from colourreg_rs import _core

    view, kept = building.view(WIDTH, HEIGHT), {}

    def run(xyz: np.ndarray) -> Any:
        if len(xyz) not in kept:
            kept[len(xyz)] = np.empty((len(xyz), 2)), np.empty(len(xyz))
        xy, depth = kept[len(xyz)]
        return _core.project(view, xyz, out_xy=xy, out_depth=depth)

    return _best(points, run)


def numpy(points: str) -> float:
    params = building.camera(WIDTH, HEIGHT)

    def run(xyz: np.ndarray) -> Any:
        u, v, z = building.project(xyz, params)
        return np.stack([u, v], 1), z

    return _best(points, run)


def opencv(points: str) -> float:
    import cv2

    p = building.camera(WIDTH, HEIGHT)
    matrix = np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1]])
    zero = np.zeros(3)
    return _best(points, lambda xyz: (cv2.projectPoints(xyz, zero, zero, matrix, p[4:])[0][:, 0], xyz[:, 2].copy()))


def pycolmap(points: str) -> float:
    import pycolmap as colmap

    p = building.camera(WIDTH, HEIGHT)
    camera = colmap.Camera(model="FULL_OPENCV", width=WIDTH, height=HEIGHT, params=[*p, 0.0, 0.0, 0.0])
    return _best(points, lambda xyz: (camera.img_from_cam(xyz), None))


def _kernel() -> Any:
    import numba

    fx, fy, cx, cy, k1, k2, p1, p2, k3 = building.camera(WIDTH, HEIGHT).tolist()

    @numba.njit(parallel=True, fastmath=True)
    def kernel(xyz: Any, xy: Any, depth: Any) -> None:
        for i in numba.prange(len(xyz)):
            z = xyz[i, 2]
            x, y = xyz[i, 0] / z, xyz[i, 1] / z
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            xy[i, 0] = fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx
            xy[i, 1] = fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy
            depth[i] = z

    return kernel


def numba_fresh(points: str) -> float:
    kernel = _kernel()

    def run(xyz: np.ndarray) -> Any:
        xy, depth = np.empty((len(xyz), 2)), np.empty(len(xyz))
        kernel(xyz, xy, depth)
        return xy, depth

    return _best(points, run)


def numba_reused(points: str) -> float:
    kernel, kept = _kernel(), {}

    def run(xyz: np.ndarray) -> Any:
        if len(xyz) not in kept:
            kept[len(xyz)] = np.empty((len(xyz), 2)), np.empty(len(xyz))
        kernel(xyz, *kept[len(xyz)])
        return kept[len(xyz)]

    return _best(points, run)


def main() -> None:
    options = parser(__doc__ or "").parse_args()
    contenders: dict[str, Callable[..., float]] = {
        "colourreg": colourreg,
        "colourreg, into given arrays": colourreg_reused,
        "NumPy": numpy,
        "cv2.projectPoints": opencv,
        "pycolmap, without depth": pycolmap,
        "numba, parallel": numba_fresh,
        "numba, into given arrays": numba_reused,
    }
    for name, module in {"cv2.projectPoints": "cv2", "pycolmap, without depth": "pycolmap"}.items():
        if importlib.util.find_spec(module) is None:
            print(f"{module} is not installed and left out")
            del contenders[name]
    if importlib.util.find_spec("numba") is None:
        print("numba is not installed and left out")
        contenders = {k: v for k, v in contenders.items() if "numba" not in k}
    print(f"\nproject {options.points / 1e6:g} M points, OPENCV camera")
    compare(contenders, [str(options.points)], options.repeats)


if __name__ == "__main__":
    main()
