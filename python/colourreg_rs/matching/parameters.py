"""A view's parameters by name, as covariances count them: the rotation vector on the left, the projection centre, the
camera's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .. import _core
from ..model import FloatArray, Pose, View

_POSE = ("rx", "ry", "rz", "cx_world", "cy_world", "cz_world")


def design(view: View, names: Sequence[str], xyz: FloatArray) -> FloatArray:
    """Derivatives of pixels (N, 2, U) by the named parameters, as covariances count them; NaN where not visible."""
    _, _, pose, params = _core.project_jacobians(view.core, xyz)
    camera = view.camera
    assert camera is not None
    order = list(camera.params)

    def column(name: str) -> FloatArray:
        if name in _POSE:
            return pose[:, :, _POSE.index(name)]
        if name in ("f", "aspect"):
            fx, fy = (params[:, :, order.index(n)] for n in ("fx", "fy"))
            if name == "aspect":
                return fy * camera.params["fx"]
            return fx + fy * (camera.params["fy"] / camera.params["fx"])
        return params[:, :, order.index(name)]

    return np.stack([column(name) for name in names], axis=2)


def value_of(view: View, name: str) -> float:
    """The present value of a parameter; of a rotation 0, since its vector counts from the view's own."""
    camera, pose = view.camera, view.pose
    assert camera is not None and pose is not None
    if name in _POSE[:3]:
        return 0.0
    if name in _POSE:
        return float(pose.centre[_POSE.index(name) - 3])
    if name == "f":
        return camera.params["fx"]
    if name == "aspect":
        return camera.params["fy"] / camera.params["fx"]
    return camera.params[name]


def stepped(view: View, names: Sequence[str], step: FloatArray) -> View:
    """The view with its named parameters changed, as covariances count them."""
    camera, pose = view.camera, view.pose
    assert camera is not None and pose is not None
    by_name = dict(zip(names, step.tolist(), strict=True))
    turn = [by_name.pop(n, 0.0) for n in ("rx", "ry", "rz")]
    shift = np.array([by_name.pop(n, 0.0) for n in ("cx_world", "cy_world", "cz_world")])
    params = dict(camera.params)
    for name, change in by_name.items():
        if name == "f":
            ratio = params["fy"] / params["fx"]
            params["fx"] += change
            params["fy"] += change * ratio
        elif name == "aspect":
            params["fy"] += change * params["fx"]
        else:
            params[name] += change
    rotation = _turned(np.array(turn)) @ pose.rotation
    return replace(view, camera=replace(camera, params=params), pose=Pose.from_centre(rotation, pose.centre + shift))


def _turned(vector: FloatArray) -> FloatArray:
    """The rotation matrix of a rotation vector (Rodrigues' formula)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # sin(a) / a and (1 - cos(a)) / a², which are 1 and 1/2 at 0.
    half = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * cross + half * cross @ cross)
