"""What a scene family lays out: the scene, where the scanner stood, and how the photos were framed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..model import Camera, CameraModel, Pose
from .builder import Parts
from .lighting import Lighting
from .scanner import Scanner


@dataclass(frozen=True)
class Viewpoint:
    """Where a photo was taken (scene frame) and what it looks at; horizontal field of view and roll in radians, size in
    pixels, distortion of the lens."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    field_of_view: float
    size: tuple[int, int] = (2400, 1600)
    distortion: dict[str, float] = field(default_factory=dict)
    roll: float = 0.0

    def pose(self) -> Pose:
        """The pose in the scene's frame."""
        level = Pose.looking_at(self.position, self.target)
        c, s = np.cos(self.roll), np.sin(self.roll)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return Pose.from_centre(turn @ level.rotation, self.position)

    def camera(self, model: CameraModel, size: tuple[int, int] | None = None) -> Camera:
        """The camera of this model; distortion terms that the model does not have are left out."""
        width, height = size or self.size
        if model == "EQUIRECTANGULAR":
            return Camera(model, width, height)
        middle = {"cx": (width - 1) / 2 + 0.004 * width, "cy": (height - 1) / 2 - 0.003 * height}
        if model == "OPENCV_FISHEYE":
            # The same field of view over the equidistant projection; mild terms of its own.
            f = width / self.field_of_view
            return Camera("OPENCV_FISHEYE", width, height, {"fx": f, "fy": f, **middle, "k1": -0.012, "k2": 0.003})
        f = 0.5 * width / np.tan(0.5 * self.field_of_view)
        terms = {} if model == "PINHOLE" else self.distortion
        return Camera(model, width, height, {"fx": f, "fy": f, **middle, **terms})


@dataclass(frozen=True)
class Layout:
    """A scene family's result for one seed; everything in the scene's frame."""

    parts: Parts
    lighting: Lighting
    stations: list[tuple[float, float, float]]
    scanner: Scanner
    viewpoints: list[Viewpoint]


def lens(rng: np.random.Generator) -> dict[str, float]:
    """The distortion of an ordinary lens."""
    return {
        "k1": float(rng.uniform(-0.11, -0.04)),
        "k2": float(rng.uniform(0.02, 0.06)),
        "p1": float(rng.normal(0, 4e-4)),
        "p2": float(rng.normal(0, 4e-4)),
    }
