"""A made-up building for the comparisons of kernels: walls at four distances, scanned in columns, before one camera."""

from __future__ import annotations

from typing import Any

import numpy as np

PARAMS = {"f": 0.725, "k1": -0.05, "k2": 0.01, "p1": 5e-4, "p2": -3e-4, "k3": 0.001}


def cloud(points: int, order: str = "as scanned", half: tuple[float, float] = (0.66, 0.44)) -> np.ndarray:
    """(N, 3), camera frame: each nearer wall hides a part of the farther ones. ``order``: as scanned, or shuffled.

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
    return np.ascontiguousarray(xyz[rng.permutation(len(xyz))] if order == "shuffled" else xyz)


def camera(width: int, height: int) -> np.ndarray:
    """fx fy cx cy k1 k2 p1 p2 k3."""
    p = PARAMS
    f = p["f"] * width
    return np.array([f, f, (width - 1) / 2, (height - 1) / 2, p["k1"], p["k2"], p["p1"], p["p2"], p["k3"]])


def view(width: int, height: int) -> Any:
    """The camera in the origin, for colourreg."""
    from colourreg_rs import _core

    return _core.View.canonical("OPENCV", width, height, camera(width, height), np.eye(3), np.zeros(3))


def project(xyz: np.ndarray, params: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """In NumPy, as one writes it: column, row, depth."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = params
    z = xyz[:, 2]
    x, y = xyz[:, 0] / z, xyz[:, 1] / z
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return fx * u + cx, fy * v + cy, z
