"""Set-ups whose truth is known, shared by the tests of the adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from colourreg_rs import Camera, Pose, View, _core

CAMERA = Camera(
    "OPENCV",
    4000,
    3000,
    {"fx": 3000.0, "fy": 3000.0, "cx": 1990.0, "cy": 1510.0, "k1": -0.06, "k2": 0.02, "p1": 5e-4, "p2": -3e-4},
)
POSE = Pose.from_centre(cv2.Rodrigues(np.array([0.2, -0.4, 0.1]))[0], [12.0, -7.0, 3.0])
CALIBRATION = ["pose", "f", "pp", "distortion"]


def covariances(n: int, sigma: float, size: int) -> np.ndarray:
    return np.tile(np.eye(size) * sigma**2, (n, 1, 1))


@dataclass
class Case:
    """Control points with the truth: exact world points and pixels, and the sigmas of the noise."""

    view: View
    xyz: np.ndarray
    xy: np.ndarray
    sigma_xy: float
    sigma_xyz: float

    def noisy(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        return (
            self.xyz + self.sigma_xyz * rng.standard_normal(self.xyz.shape),
            self.xy + self.sigma_xy * rng.standard_normal(self.xy.shape),
        )

    def adjust(self, xyz: np.ndarray, xy: np.ndarray, free: list[str], **keywords) -> _core.Adjustment:
        n = len(xyz)
        cov = covariances(n, self.sigma_xyz, 3), covariances(n, self.sigma_xy, 2)
        return _core.adjust(self.view.core, xyz, xy, *cov, free, **keywords)


def case(
    n: int,
    rng: np.random.Generator,
    *,
    sigma_xy: float = 0.5,
    sigma_xyz: float = 0.003,
    camera: Camera = CAMERA,
    pose: Pose = POSE,
    depths: tuple[float, float] = (6.0, 18.0),
    view: View | None = None,
) -> Case:
    """``n`` points spread over the photo and in depth, as a careful person would choose them."""
    view = view or View("case", None, camera, pose)
    columns = int(np.ceil(np.sqrt(n * 4 / 3)))
    rows = int(np.ceil(n / columns))
    cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2)[:n]
    width, height = view.image_size
    xy = (cells + 0.15 + 0.7 * rng.random((n, 2))) / [columns, rows] * [width, height]
    rays = _core.unproject(view.core, np.ascontiguousarray(xy))
    xyz = np.ascontiguousarray(view.core.centre + rays * rng.uniform(*depths, (n, 1)))
    return Case(view, xyz, _core.project(view.core, xyz)[0], sigma_xy, sigma_xyz)


def dlt_case(n: int, rng: np.random.Generator, **keywords) -> Case:
    """The same for a photo without distortion, as a DLT view."""
    pinhole = Camera("PINHOLE", 4000, 3000, {k: CAMERA.params[k] for k in ("fx", "fy", "cx", "cy")})
    matrix = View("p", None, pinhole, POSE).core.matrix()
    return case(n, rng, view=View("dlt", None, dlt=matrix, size=(4000, 3000)), **keywords)


def errors_of(result: _core.Adjustment, truth: View) -> np.ndarray:
    """Estimate minus truth, in the adjustment's parameters. The rotation is a vector applied on the left."""
    core = result.view
    values = dict(zip(result.names, result.values, strict=True))
    turn = cv2.Rodrigues(core.rotation @ truth.core.rotation.T)[0].ravel()
    exact = dict(zip(("rx", "ry", "rz"), -turn, strict=True))
    exact |= dict(zip(("cx_world", "cy_world", "cz_world"), truth.core.centre, strict=True))
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    exact |= dict(zip(names, truth.core.params, strict=False))
    exact |= {"f": truth.core.params[0], "skew": truth.core.skew}
    return np.array([values[name] - exact[name] for name in result.names])


def squared_distance(error: np.ndarray, covariance: np.ndarray) -> float:
    """Mahalanobis, in units of the sigmas so that pixels and radians mix without loss."""
    sigma = np.sqrt(np.diag(covariance))
    return float((error / sigma) @ np.linalg.solve(covariance / np.outer(sigma, sigma), error / sigma))
