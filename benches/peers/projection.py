"""How fast are 10 million points projected with distortion, pixels and depth in float64?

All turn and shift the points into the camera's frame and give pixels and depths as arrays of their own. Peers: NumPy as
one writes it, OpenCV's projectPoints with its rotation vector (the depths apart, as it gives none), pycolmap's pose and
then its camera, a parallel numba kernel with all of it in its loop (fresh and reused output). The limit of the memory
is what copying as many bytes takes, two threads of NumPy's, into a given array. Each in a process of its own on the
same input, best of three calls after a warm-up, since the first touch of fresh memory is not what is asked; all agree
to 1e-6 px. Limits: coordinates are small, so that nobody loses digits.

    python -m benches.peers.projection [--points 10000000] [--repeats 3]
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
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
        return np.stack([u, v], 1), z.copy()

    return _best(points, run)


def opencv(points: str) -> float:
    params = building.camera(WIDTH, HEIGHT)
    return _best(points, lambda xyz: building.opencv_places(xyz, params))


def pycolmap(points: str) -> float:
    import pycolmap as colmap

    p = building.camera(WIDTH, HEIGHT)
    camera = colmap.Camera(model="FULL_OPENCV", width=WIDTH, height=HEIGHT, params=[*p, 0.0, 0.0, 0.0])
    cam_from_world = colmap.Rigid3d(colmap.Rotation3d(building.ROTATION), building.TRANSLATION)

    def run(xyz: np.ndarray) -> Any:
        in_camera = cam_from_world * xyz
        return camera.img_from_cam(in_camera), in_camera[:, 2].copy()

    return _best(points, run)


def _kernel() -> Any:
    import numba

    place = building.numba_place(WIDTH, HEIGHT)

    @numba.njit(parallel=True, fastmath=True)
    def kernel(xyz: Any, xy: Any, depth: Any) -> None:
        for i in numba.prange(len(xyz)):
            xy[i, 0], xy[i, 1], depth[i] = place(xyz[i, 0], xyz[i, 1], xyz[i, 2])

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


def memory_limit(points: str) -> float:
    """The same bytes, copied into a given array by two threads."""
    source = building.cloud(int(points)).reshape(-1)
    target = np.empty_like(source)
    half = len(source) // 2
    times = []
    with ThreadPoolExecutor(2) as pool:
        for _ in range(4):
            began = time.perf_counter()
            list(pool.map(np.copyto, (target[:half], target[half:]), (source[:half], source[half:])))
            times.append(time.perf_counter() - began)
    return min(times[1:])


def main() -> None:
    options = parser(__doc__ or "").parse_args()
    contenders: dict[str, Callable[..., float]] = {
        "colourreg": colourreg,
        "colourreg, into given arrays": colourreg_reused,
        "NumPy": numpy,
        "cv2.projectPoints": opencv,
        "pycolmap": pycolmap,
        "numba, parallel": numba_fresh,
        "numba, into given arrays": numba_reused,
        "copying as many bytes": memory_limit,
    }
    for name, module in {"cv2.projectPoints": "cv2", "pycolmap": "pycolmap"}.items():
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
