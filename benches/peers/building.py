"""A made-up building for the comparisons of kernels: walls at four distances, scanned in columns, before one camera.

Points are in the scan's frame and the camera stands and looks somewhere in it, as everywhere where a scan is coloured:
every program has to turn and shift each point first, each in the way that is usual there.
"""

from __future__ import annotations

from typing import Any

import numpy as np

PARAMS = {"f": 0.725, "k1": -0.05, "k2": 0.01, "p1": 5e-4, "p2": -3e-4, "k3": 0.001}


def _looking(azimuth: float, elevation: float) -> np.ndarray:
    """World to camera for a level camera that looks there, radians."""
    (sa, ca), (se, ce) = ((np.sin(v), np.cos(v)) for v in (azimuth, elevation))
    return np.array([[ca, -sa, 0.0], [se * sa, se * ca, -ce], [ce * sa, ce * ca, se]])


#: From the scan's frame into the camera's: ROTATION · X + TRANSLATION.
ROTATION = _looking(0.7, 0.1)
CENTRE = np.array([31.25, -12.5, 4.75])
TRANSLATION = -ROTATION @ CENTRE


def cloud(points: int, order: str = "as scanned", half: tuple[float, float] = (0.66, 0.44)) -> np.ndarray:
    """(N, 3), the scan's frame: each nearer wall hides a part of the farther ones. ``order``: as scanned, or shuffled.

    ``half``: how far to the side and up the scan goes, in parts of the depth.
    """
    rng = np.random.default_rng(1)
    rows = int(np.sqrt(points * 3 / 4))
    x, y = np.meshgrid(
        np.linspace(-half[0], half[0], points // rows), np.linspace(-half[1], half[1], rows), indexing="ij"
    )
    x, y = x.ravel(), y.ravel()
    depth = 8.0 + 6.0 * (np.floor(9 * (x + 0.72)).astype(int) % 4) + 0.2 * np.floor(20 * y)
    depth += rng.normal(0, 0.002, len(depth))
    xyz = np.stack([x * depth, y * depth, depth], axis=1)
    xyz = xyz @ ROTATION + CENTRE
    return np.ascontiguousarray(xyz[rng.permutation(len(xyz))] if order == "shuffled" else xyz)


def camera(width: int, height: int) -> np.ndarray:
    """fx fy cx cy k1 k2 p1 p2 k3."""
    p = PARAMS
    f = p["f"] * width
    return np.array([f, f, (width - 1) / 2, (height - 1) / 2, p["k1"], p["k2"], p["p1"], p["p2"], p["k3"]])


def view(width: int, height: int) -> Any:
    """The camera, for colourreg."""
    from colourreg_rs import _core

    return _core.View.canonical("OPENCV", width, height, camera(width, height), ROTATION, TRANSLATION)


def project(xyz: np.ndarray, params: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """In NumPy, as one writes it: column, row, depth (strided)."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = params
    in_camera = xyz @ ROTATION.T + TRANSLATION
    z = in_camera[:, 2]
    x, y = in_camera[:, 0] / z, in_camera[:, 1] / z
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return fx * u + cx, fy * v + cy, z


def opencv_places(xyz: np.ndarray, params: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """By OpenCV's projectPoints: (N, 2) pixels, and the depths, which it does not give."""
    import cv2

    matrix = np.array([[params[0], 0, params[2]], [0, params[1], params[3]], [0, 0, 1]])
    xy = cv2.projectPoints(xyz, cv2.Rodrigues(ROTATION)[0], TRANSLATION, matrix, params[4:])[0][:, 0]
    return xy, xyz @ ROTATION[2] + TRANSLATION[2]


def numba_place(width: int, height: int) -> Any:
    """For numba's kernels, inlined into their loops: a point's column, row and depth."""
    import numba

    fx, fy, cx, cy, k1, k2, p1, p2, k3 = camera(width, height).tolist()
    (r11, r12, r13), (r21, r22, r23), (r31, r32, r33) = ROTATION.tolist()
    t1, t2, t3 = TRANSLATION.tolist()

    @numba.njit(inline="always", fastmath=True)
    def place(x: float, y: float, z: float) -> Any:
        depth = r31 * x + r32 * y + r33 * z + t3
        a = (r11 * x + r12 * y + r13 * z + t1) / depth
        b = (r21 * x + r22 * y + r23 * z + t2) / depth
        r2 = a * a + b * b
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = fx * (a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)) + cx
        return u, fy * (b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b) + cy, depth

    return place
