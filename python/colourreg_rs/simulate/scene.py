"""A scene in the world: what rays meet, what a photo sees, what it shows there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .. import _core
from ..errors import InvalidInputError
from ..model import FloatArray, Pose, View
from .builder import Parts, compile_scene
from .lighting import Lighting


@dataclass(frozen=True)
class Frame:
    """Where the scene's own frame lies in the world: ``X_world = rotation @ X_scene + offset``."""

    rotation: FloatArray = field(default_factory=lambda: np.eye(3))
    offset: FloatArray = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def turned(cls, yaw: float, offset: Sequence[float] = (0.0, 0.0, 0.0)) -> Frame:
        """A frame turned about the vertical by ``yaw`` radians, with the scene's origin at ``offset``."""
        c, s = np.cos(yaw), np.sin(yaw)
        return cls(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.asarray(offset, dtype=np.float64))

    def to_world(self, points: npt.ArrayLike) -> FloatArray:
        """Scene points (..., 3) in the world."""
        return np.asarray(points, dtype=np.float64) @ self.rotation.T + self.offset

    def to_scene(self, points: npt.ArrayLike) -> FloatArray:
        """World points (..., 3) in the scene."""
        return (np.asarray(points, dtype=np.float64) - self.offset) @ self.rotation

    def pose_in_scene(self, pose: Pose) -> Pose:
        """A pose in the world as one in the scene."""
        return Pose.from_centre(pose.rotation @ self.rotation, self.to_scene(pose.centre))

    def pose_in_world(self, pose: Pose) -> Pose:
        """A pose in the scene as one in the world."""
        return Pose.from_centre(pose.rotation @ self.rotation.T, self.to_world(pose.centre))


class Hits(NamedTuple):
    """Where rays first meet the scene: distance (N,), infinite for none; primitive (N,), −1 for none; unit normal
    (N, 3) on the ray's side, world frame."""

    distance: FloatArray
    primitive: npt.NDArray[np.int32]
    normal: FloatArray


@dataclass(frozen=True)
class Scene:
    """Parts, light, and the frame they stand in. All coordinates of its methods are world coordinates."""

    name: str
    parts: Parts
    lighting: Lighting
    frame: Frame = field(default_factory=Frame)

    @cached_property
    def core(self) -> _core.SimulatedScene:
        """The compiled scene, in its own frame."""
        return compile_scene(self.parts, self.lighting)

    @cached_property
    def object_of_primitive(self) -> npt.NDArray[np.int32]:
        """Number of the object that each primitive belongs to."""
        return np.array(self.parts.object_of_primitive, dtype=np.int32)

    @cached_property
    def glass(self) -> npt.NDArray[np.bool_]:
        """Which primitives are glass to the laser."""
        return np.array([m.glass for m in self.parts.materials], dtype=np.bool_)

    @property
    def objects(self) -> list[str]:
        """Names of the objects."""
        return self.parts.objects

    @cached_property
    def marks(self) -> dict[str, FloatArray]:
        """Distinct points by name."""
        return {name: self.frame.to_world(p) for name, p in self.parts.marks.items()}

    def cast(self, origin: npt.ArrayLike, rays: npt.ArrayLike) -> Hits:
        """The first hit of each ray (N, 3) from ``origin``; distances in units of the rays' length."""
        directions = np.ascontiguousarray(np.asarray(rays, dtype=np.float64) @ self.frame.rotation)
        distance, primitive, normal = self.core.cast(self.frame.to_scene(origin), directions)
        return Hits(distance, primitive, normal @ self.frame.rotation.T)

    def reflectance(self, points: npt.ArrayLike, primitive: npt.NDArray[np.int32], width: npt.ArrayLike) -> FloatArray:
        """Linear red, green, blue and near-infrared reflectance (N, 4) float32 at points of primitives under footprints
        of ``width`` metres."""
        local = np.ascontiguousarray(self.frame.to_scene(points))
        widths = np.ascontiguousarray(np.broadcast_to(np.asarray(width, dtype=np.float64), len(local)))
        return np.asarray(self.core.reflectance(local, primitive, widths))

    def in_scene(self, view: View) -> _core.View:
        """A view as the compiled scene takes it."""
        if view.camera is None or view.pose is None:
            raise InvalidInputError(
                f"view {view.name!r} has no camera and pose: a scene cannot be photographed by a DLT"
            )
        return View(view.name, None, camera=view.camera, pose=self.frame.pose_in_scene(view.pose)).core

    def visible(self, view: View, points: npt.ArrayLike, tolerance: float = 1e-5) -> npt.NDArray[np.bool_]:
        """Whether the photo of ``view`` shows each true surface point (N, 3): it is imaged inside the photo and nothing
        stands between it and the projection centre, but for the last ``tolerance`` metres."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        xy, _ = _core.project(view.core, points)
        width, height = view.core.width, view.core.height
        with np.errstate(invalid="ignore"):
            inside = (xy >= -0.5).all(axis=1) & (xy[:, 0] < width - 0.5) & (xy[:, 1] < height - 0.5)
        result = np.zeros(len(points), dtype=np.bool_)
        candidates = np.ascontiguousarray(self.frame.to_scene(points[inside]))
        result[inside] = self.core.sees(self.frame.to_scene(view.core.centre), candidates, tolerance)
        return result

    def depth_image(self, view: View) -> tuple[FloatArray, npt.NDArray[np.int32]]:
        """Distance from the projection centre (H, W; infinite for sky, NaN outside the lens's field) and primitive
        (H, W; −1 for none) at the centre of every pixel."""
        width, height = view.core.width, view.core.height
        distance = np.empty((height, width))
        primitive = np.empty((height, width), np.int32)
        band = max(200_000 // width, 1)
        for first in range(0, height, band):
            y, x = np.mgrid[first : min(first + band, height), 0:width].astype(np.float64)
            rays = _core.unproject(view.core, np.stack([x.ravel(), y.ravel()], axis=1))
            hits = self.cast(view.core.centre, rays)
            where = slice(first, first + len(x))
            distance[where] = np.where(np.isnan(rays[:, 0]), np.nan, hits.distance).reshape(x.shape)
            primitive[where] = hits.primitive.reshape(x.shape)
        return distance, primitive
