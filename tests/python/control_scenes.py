"""Control points seen by random cameras, with their truth: what the tests of the estimators share."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from colourreg_rs import _core
from colourreg_rs.model import PARAMETER_NAMES

UTM = np.array([456_789.0, 5_812_345.0, 143.0])


@dataclass
class Scene:
    view: _core.View
    xyz: np.ndarray
    exact: np.ndarray
    xy: np.ndarray


def random_view(rng: np.random.Generator, model: str = "OPENCV", shift: np.ndarray | float = 0.0) -> _core.View:
    width, height = int(rng.integers(2000, 6000)), int(rng.integers(1500, 4000))
    f = rng.uniform(0.7, 1.6) * max(width, height)
    params = [f, f * rng.uniform(0.98, 1.02), width / 2 + rng.normal(0, 20), height / 2 + rng.normal(0, 20)]
    if model == "OPENCV":
        params += [rng.normal(0, 0.05), rng.normal(0, 0.01), *rng.normal(0, 5e-4, 2), rng.normal(0, 2e-3)]
    elif model == "FULL_OPENCV":
        params += [rng.normal(0, 0.05), rng.normal(0, 0.01), *rng.normal(0, 5e-4, 2), *rng.normal(0, 2e-3, 4)]
    elif model == "OPENCV_FISHEYE":
        params[0] = params[1] = 0.3 * width
        params += [rng.normal(0, 0.02), rng.normal(0, 0.005), rng.normal(0, 1e-3), rng.normal(0, 1e-4)]
    elif model == "EQUIRECTANGULAR":
        width, height, params = 2 * height, height, []
    rotation, _ = cv2.Rodrigues(rng.normal(0, 1.2, 3))
    centre = rng.normal(0, 5, 3) + shift
    array = np.array(params, dtype=np.float64)
    assert len(params) == len(PARAMETER_NAMES[model])
    return _core.View.canonical(model, width, height, array, rotation, -rotation @ centre)


def scene(
    rng: np.random.Generator,
    n: int,
    *,
    noise: float = 0.5,
    model: str = "OPENCV",
    shift: np.ndarray | float = 0.0,
    near: float = 8.0,
    far: float = 40.0,
) -> Scene:
    """``n`` points all over the photo, at random distances."""
    view = random_view(rng, model, shift)
    xyz = np.empty((0, 3))
    while len(xyz) < n:
        px = rng.uniform(0.03, 0.97, (4 * n, 2)) * [view.width, view.height]
        if model == "EQUIRECTANGULAR":
            px[:, 1] = rng.uniform(0.15, 0.85, 4 * n) * view.height
        rays = _core.unproject(view, px)
        rays = rays[np.isfinite(rays).all(1)]
        xyz = np.concatenate([xyz, view.centre + rays * rng.uniform(near, far, (len(rays), 1))])
    xyz = np.ascontiguousarray(xyz[:n])
    exact, _ = _core.project(view, xyz)
    return Scene(view, xyz, exact, exact + rng.normal(0, noise, exact.shape))


def spoil(s: Scene, rng: np.random.Generator, count: int, size: tuple[float, float] | None = None) -> np.ndarray:
    """Makes blunders of ``count`` points, anywhere in the photo or ``size`` pixels away; which they are."""
    bad = np.sort(rng.permutation(len(s.xy))[:count])
    if size is None:
        s.xy[bad] = rng.uniform(0, 1, (count, 2)) * [s.view.width, s.view.height]
    else:
        angle, length = rng.uniform(0, 2 * np.pi, count), rng.uniform(*size, count)
        s.xy[bad] += np.stack([length * np.cos(angle), length * np.sin(angle)], 1)
    return bad


def rotation_vector(rotation: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """The small rotation vector on the left that takes ``reference`` to ``rotation``."""
    return cv2.Rodrigues(rotation @ reference.T)[0][:, 0]


def moved(view: _core.View, names: list[str], delta: np.ndarray) -> _core.View:
    """The view after steps in named parameters, written independently of the core."""
    params = dict(zip(PARAMETER_NAMES[view.model], view.params, strict=True))
    turn, centre, aspect = np.zeros(3), view.centre.copy(), None
    for name, d in zip(names, delta, strict=True):
        if name in ("rx", "ry", "rz"):
            turn["xyz".index(name[1])] = d
        elif name.endswith("_world"):
            centre["xyz".index(name[1])] += d
        elif name == "f":
            aspect = params["fy"] / params["fx"]
            params["fx"] += d
            params["fy"] = aspect * params["fx"]
        else:
            params[name] += d
    rotation = cv2.Rodrigues(turn)[0] @ view.rotation
    array = np.array(list(params.values()))
    return _core.View.canonical(view.model, view.width, view.height, array, rotation, -rotation @ centre)
