"""How fast do 10 million points get their colours from 24 megapixels in memory: what hides what, then bilinear samples?

Points are in the scan's frame, and all bring them into the camera's first. Peers: the idiom that people paste together
of NumPy and OpenCV (``projectPoints``, ``minimum.at``, tolerance of 1 %, ``remap``), the same with pose and projection
written in NumPy, and the same fused in a parallel numba kernel with a depth buffer for each thread. They hide only what
falls into the same pixel; colourreg makes surfaces of the points, so that walls hide what shines through between their
points, which is more work. Each in a process of its own on the same input, as scanned and shuffled, after a call with
a thousandth of the points, since numba has to be called once before: for all of them threads stand ready and memory has
been touched then. Limits: the photo is made up.

    python -m benches.peers.colouring [--points 10000000] [--repeats 3]
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
TOLERANCE = 0.01


def photo() -> np.ndarray:
    yy, xx = np.mgrid[0:HEIGHT, 0:WIDTH]
    return np.stack([(xx // 24) % 256, (yy // 16) % 256, ((xx + yy) // 40) % 256], 2).astype(np.uint8)


def _timed(points: str, order: str, run: Callable[[np.ndarray, np.ndarray], Any], scale: int = 1) -> float:
    xyz, image = building.cloud(int(points), order), photo()
    run(np.ascontiguousarray(xyz[::1000]), image)
    forget_peak()
    began = time.perf_counter()
    rgb, seen = run(xyz, image)
    seconds = time.perf_counter() - began
    # Whoever is seen has the photo's colour: the ramps tell where it was taken.
    u, v, _ = building.project(np.ascontiguousarray(xyz[::1000]), building.camera(WIDTH, HEIGHT))
    ok = np.asarray(seen[::1000], bool) & (u > 30) & (u < WIDTH - 30) & (v > 30) & (v < HEIGHT - 30)
    red = np.asarray(rgb[::1000][:, 0], float)[ok] / scale
    assert ok.sum() > len(ok) // 4
    assert np.median(np.abs(red - (u[ok] // 24) % 256)) <= 1
    return seconds


def colourreg(points: str, order: str) -> float:
    from colourreg_rs import _core

    def run(xyz: np.ndarray, image: np.ndarray) -> Any:
        buffer = _core.DepthBuffer(building.view(WIDTH, HEIGHT))
        buffer.add(xyz)
        rgb, source = _core.colour_points([buffer.finish()], [image], xyz)
        return rgb, source

    return _timed(points, order, run, scale=256)


def opencv_places(xyz: np.ndarray, params: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    xy, depth = building.opencv_places(xyz, params)
    return xy[:, 0], xy[:, 1], depth


def numpy_opencv(points: str, order: str) -> float:
    return _idiom(points, order, opencv_places)


def numpy_remap(points: str, order: str) -> float:
    return _idiom(points, order, building.project)


def _idiom(points: str, order: str, project: Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]) -> float:
    import cv2

    def run(xyz: np.ndarray, image: np.ndarray) -> Any:
        u, v, z = project(xyz, building.camera(WIDTH, HEIGHT))
        column, row = np.rint(u).astype(np.int64), np.rint(v).astype(np.int64)
        inside = (z > 0) & (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
        cell = row[inside] * WIDTH + column[inside]
        depth = np.full(WIDTH * HEIGHT, np.inf)
        np.minimum.at(depth, cell, z[inside])
        seen = np.zeros(len(xyz), bool)
        seen[inside] = z[inside] <= depth[cell] * (1 + TOLERANCE)
        rgb = np.zeros((len(xyz), 3), np.uint8)
        # remap takes pictures of at most 32,767 rows: the list is folded.
        at = np.flatnonzero(seen)
        fold = 4096
        padded = np.resize(at, -(-len(at) // fold) * fold)
        maps = [w[padded].astype(np.float32).reshape(-1, fold) for w in (u, v)]
        sampled = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).reshape(-1, 3)
        rgb[at] = sampled[: len(at)]
        return rgb, seen

    return _timed(points, order, run)


def numba_fused(points: str, order: str) -> float:
    import numba

    place = building.numba_place(WIDTH, HEIGHT)

    @numba.njit(parallel=True, fastmath=True)
    def kernel(xyz: Any, image: Any, depths: Any, rgb: Any, seen: Any) -> None:
        n, workers = len(xyz), depths.shape[0]
        for w in numba.prange(workers):
            for i in range(w * n // workers, (w + 1) * n // workers):
                u, v, z = place(xyz[i, 0], xyz[i, 1], xyz[i, 2])
                if z > 0:
                    c, r = int(np.rint(u)), int(np.rint(v))
                    if 0 <= c < WIDTH and 0 <= r < HEIGHT and z < depths[w, r, c]:
                        depths[w, r, c] = z
        for r in numba.prange(HEIGHT):
            for w in range(1, workers):
                for c in range(WIDTH):
                    depths[0, r, c] = min(depths[0, r, c], depths[w, r, c])
        for i in numba.prange(n):
            u, v, z = place(xyz[i, 0], xyz[i, 1], xyz[i, 2])
            seen[i] = False
            if z > 0:
                c, r = int(np.rint(u)), int(np.rint(v))
                if 0 <= c < WIDTH and 0 <= r < HEIGHT and z <= depths[0, r, c] * (1 + TOLERANCE):
                    seen[i] = True
                    c0, r0 = min(max(int(u), 0), WIDTH - 2), min(max(int(v), 0), HEIGHT - 2)
                    a, b = min(max(u - c0, 0.0), 1.0), min(max(v - r0, 0.0), 1.0)
                    for k in range(3):
                        top = image[r0, c0, k] * (1 - a) + image[r0, c0 + 1, k] * a
                        low = image[r0 + 1, c0, k] * (1 - a) + image[r0 + 1, c0 + 1, k] * a
                        rgb[i, k] = np.uint8(top * (1 - b) + low * b + 0.5)

    def run(xyz: np.ndarray, image: np.ndarray) -> Any:
        depths = np.full((numba.get_num_threads(), HEIGHT, WIDTH), np.inf, np.float32)
        rgb, seen = np.zeros((len(xyz), 3), np.uint8), np.empty(len(xyz), np.bool_)
        kernel(xyz, image, depths, rgb, seen)
        return rgb, seen

    return _timed(points, order, run)


def main() -> None:
    options = parser(__doc__ or "").parse_args()
    contenders: dict[str, Callable[..., float]] = {
        "colourreg": colourreg,
        "NumPy + OpenCV": numpy_opencv,
        "NumPy, OpenCV for remap only": numpy_remap,
        "numba, parallel and fused": numba_fused,
    }
    for module, names in {"cv2": list(contenders)[1:3], "numba": list(contenders)[3:]}.items():
        if importlib.util.find_spec(module) is None:
            print(f"{module} is not installed and left out")
            for name in names:
                del contenders[name]
    for order in ("as scanned", "shuffled"):
        print(f"\ncolour {options.points / 1e6:g} M points from {WIDTH * HEIGHT / 1e6:g} MP, points {order}")
        compare(contenders, [str(options.points), order], options.repeats)


if __name__ == "__main__":
    main()
