"""Errors put in by hand: what separates the true view from the one that one starts from, and spoils control points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from .. import _core
from ..errors import InvalidInputError
from ..model import Camera, ControlPoint, FloatArray, Pose, Role, View
from .scene import Scene


@dataclass(frozen=True)
class Disturbance:
    """The true view is the approximate one with these errors added.

    ``rotation`` (radians, a small rotation vector in the camera frame) and ``translation`` (metres, of the projection
    centre along the scene's axes) are vectors, or a number: an error of that size in a random direction.
    ``principal_point`` in pixels, ``focal`` as a factor less one, ``distortion`` added to the named terms. Control
    points get Gaussian errors of ``point_sigma_xy`` pixels and ``point_sigma_xyz`` metres per coordinate, and a share
    of ``blunders`` are off by ``blunder_size`` (least, most) pixels.
    """

    rotation: float | Sequence[float] = np.radians(0.5)
    translation: float | Sequence[float] = 0.02
    principal_point: tuple[float, float] = (0.0, 0.0)
    focal: float = 0.0
    distortion: Mapping[str, float] = field(default_factory=dict)
    point_sigma_xy: float = 0.3
    point_sigma_xyz: float = 0.002
    blunders: float = 0.0
    blunder_size: tuple[float, float] = (20.0, 80.0)
    control_points: int = 12
    check_points: int = 6

    def true_camera(self, approximate: Camera) -> Camera:
        """The camera with its errors."""
        if approximate.model == "EQUIRECTANGULAR":
            if self.focal or any(self.principal_point) or self.distortion:
                raise InvalidInputError("an EQUIRECTANGULAR camera has no principal point, focal length or distortion")
            return approximate
        p = approximate.params
        unknown = sorted(set(self.distortion) - set(p))
        if unknown:
            raise InvalidInputError(f"{approximate.model} has no term {', '.join(unknown)} to disturb")
        return approximate.with_params(
            **{
                "fx": p["fx"] * (1 + self.focal),
                "fy": p["fy"] * (1 + self.focal),
                "cx": p["cx"] + self.principal_point[0],
                "cy": p["cy"] + self.principal_point[1],
                **{name: p[name] + value for name, value in self.distortion.items()},
            }
        )

    def true_pose(self, approximate: Pose, rng: np.random.Generator) -> Pose:
        """The pose with its errors."""
        turn, shift = _vector(self.rotation, rng), _vector(self.translation, rng)
        return Pose.from_centre(_rotation(turn) @ approximate.rotation, approximate.centre + shift)

    def control(
        self, scene: Scene, view: View, candidates: Mapping[str, FloatArray], rng: np.random.Generator
    ) -> tuple[tuple[ControlPoint, ...], tuple[ControlPoint, ...], tuple[str, ...]]:
        """Measured and true control points among those that the photo shows, spread over it; names of the blunders."""
        if not candidates:
            return (), (), ()
        names, xyz = list(candidates), np.array(list(candidates.values()))
        xy, _ = _core.project(view.core, xyz)
        seen = np.flatnonzero(scene.visible(view, xyz, tolerance=0.02))
        chosen = seen[_spread(xy[seen], self.control_points + self.check_points)]
        # The first of a spread selection lie outermost: every third becomes a check point, so that both are spread.
        n_check = min(self.check_points, max(len(chosen) - self.control_points, len(chosen) // 3))
        checks = set(chosen[2::3][:n_check].tolist())
        control = [i for i in chosen if i not in checks]
        n_blunders = round(self.blunders * len(control))
        spoiled = set(rng.choice(control, n_blunders, replace=False).tolist()) if n_blunders else set()
        measured, true = [], []
        for i in chosen.tolist():
            at = xy[i] + rng.normal(0.0, 1.0, 2) * self.point_sigma_xy
            if i in spoiled:
                angle, size = rng.uniform(0, 2 * np.pi), rng.uniform(*self.blunder_size)
                off = size * np.array([np.cos(angle), np.sin(angle)])
                # Nobody points beside the photo.
                limit = np.array([view.core.width, view.core.height]) - 0.5
                at = at + np.where((at + off >= -0.5) & (at + off < limit), off, -off)
            role: Role = "check" if i in checks else "control"
            measured.append(
                ControlPoint(
                    names[i],
                    xyz[i] + rng.normal(0.0, 1.0, 3) * self.point_sigma_xyz,
                    at,
                    role,
                    sigma_xyz=np.full(3, self.point_sigma_xyz) if self.point_sigma_xyz > 0 else None,
                    sigma_xy=np.full(2, self.point_sigma_xy) if self.point_sigma_xy > 0 else None,
                )
            )
            true.append(ControlPoint(names[i], xyz[i], xy[i], role))
        return tuple(measured), tuple(true), tuple(sorted(names[i] for i in spoiled))


def _vector(value: float | Sequence[float], rng: np.random.Generator) -> FloatArray:
    direction = rng.normal(0.0, 1.0, 3)
    if isinstance(value, int | float):
        return np.asarray(float(value) * direction / np.linalg.norm(direction))
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (3,):
        raise InvalidInputError(f"a disturbance is a number or three, not {value!r}")
    return vector


def _rotation(vector: FloatArray) -> FloatArray:
    """The rotation matrix of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k))


def _spread(xy: FloatArray, count: int) -> FloatArray:
    """Indices of up to ``count`` points that lie far from one another: each next one farthest from those before."""
    if len(xy) == 0:
        return np.zeros(0, dtype=np.int64)
    chosen = [int(np.argmax(((xy - xy.mean(axis=0)) ** 2).sum(axis=1)))]
    distance = ((xy - xy[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < min(count, len(xy)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, ((xy - xy[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(chosen)
