"""The nouns: cloud, camera, pose, view, registration. Frozen, and checked at birth.

Frames and pixel conventions are those of ``docs/conventions.md``: the camera frame is x right, y down, z forward,
``x_cam = R @ X + t``; pixel (0, 0) is the *centre* of the top-left pixel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from . import _core
from .errors import InvalidInputError

FloatArray = npt.NDArray[np.float64]

#: Parameter names of each camera model, in the order of the arrays that the core takes and gives.
PARAMETER_NAMES: dict[str, tuple[str, ...]] = {
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "EQUIRECTANGULAR": (),
}

#: Distortion terms that a DLT matrix may carry, in the core's order.
DLT_DISTORTION_NAMES = ("k1", "k2", "p1", "p2", "k3")

CameraModel = Literal["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR"]
Role = Literal["control", "check"]


def _frozen(array: npt.ArrayLike, shape: tuple[int, ...], name: str) -> FloatArray:
    """A read-only float64 copy of ``array``, refused when its shape is wrong or a value is not finite."""
    value = np.array(array, dtype=np.float64)
    if value.shape != shape:
        raise InvalidInputError(f"{name} has shape {value.shape}, not {shape}")
    if not np.isfinite(value).all():
        raise InvalidInputError(f"{name} holds values that are not finite: {value.ravel().tolist()}")
    value.flags.writeable = False
    return value


@dataclass(frozen=True)
class Camera:
    """Interior orientation and distortion of a camera, for the upright image of ``width`` x ``height`` pixels.

    ``params`` are named as in OpenCV; distortion terms that are left out are zero.
    """

    model: CameraModel
    width: int
    height: int
    params: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = PARAMETER_NAMES.get(self.model)
        if names is None:
            raise InvalidInputError(f"camera model {self.model!r} is not one of {', '.join(PARAMETER_NAMES)}")
        given = dict(self.params)
        unknown = sorted(set(given) - set(names))
        if unknown:
            raise InvalidInputError(
                f"{self.model} has no parameter {', '.join(unknown)}; it has {', '.join(names) or 'none'}"
            )
        missing = [name for name in names[:4] if name not in given]
        if missing:
            raise InvalidInputError(f"{self.model} camera lacks {', '.join(missing)}")
        ordered = {name: float(given.get(name, 0.0)) for name in names}
        object.__setattr__(self, "params", ordered)
        object.__setattr__(self, "width", int(self.width))
        object.__setattr__(self, "height", int(self.height))
        self._canonical()  # the core's checks

    def _canonical(self) -> _core.View:
        return _core.View.canonical(self.model, self.width, self.height, self.vector, np.eye(3), np.zeros(3))

    def check_plausible(self) -> None:
        """For cameras that people wrote: raises InvalidInputError for what none has, as a focal length in mm."""
        self._canonical().check_plausible()

    @property
    def vector(self) -> FloatArray:
        """The parameters as an array, in the order of :data:`PARAMETER_NAMES`."""
        return np.array(list(self.params.values()), dtype=np.float64)

    def with_params(self, **params: float) -> Camera:
        """The same camera with some parameters replaced."""
        return replace(self, params={**self.params, **params})


@dataclass(frozen=True)
class Pose:
    """Exterior orientation ``t_camera_world``: ``x_cam = rotation @ X + translation``."""

    rotation: FloatArray
    translation: FloatArray

    def __post_init__(self) -> None:
        rotation = _frozen(self.rotation, (3, 3), "rotation")
        departure = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if departure > 1e-6 or np.linalg.det(rotation) < 0:
            raise InvalidInputError(
                f"rotation is not a rotation matrix: R R^T differs from the identity by {departure:.3g}, "
                f"determinant {np.linalg.det(rotation):.6g}"
            )
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", _frozen(self.translation, (3,), "translation"))

    @classmethod
    def from_centre(cls, rotation: npt.ArrayLike, centre: npt.ArrayLike) -> Pose:
        """The pose with this rotation (world to camera) and projection centre (world)."""
        rotation = np.asarray(rotation, dtype=np.float64)
        return cls(rotation, -rotation @ np.asarray(centre, dtype=np.float64))

    @classmethod
    def looking_at(cls, centre: npt.ArrayLike, target: npt.ArrayLike, up: npt.ArrayLike = (0.0, 0.0, 1.0)) -> Pose:
        """The pose at ``centre`` whose optical axis goes through ``target``, with ``up`` upwards in the image."""
        c, a, u = (np.asarray(v, dtype=np.float64) for v in (centre, target, up))
        forward = (a - c) / np.linalg.norm(a - c)
        right = np.cross(forward, u)
        if np.linalg.norm(right) < 1e-9:
            raise InvalidInputError("looking_at: the direction of view is parallel to `up`")
        right /= np.linalg.norm(right)
        return cls.from_centre(np.stack([right, np.cross(forward, right), forward]), c)

    @property
    def centre(self) -> FloatArray:
        """The projection centre in the world frame."""
        # Solved rather than transposed, as in the core: a rotation with few digits keeps its meaning.
        return np.asarray(np.linalg.solve(self.rotation, -self.translation), dtype=np.float64)


@dataclass(frozen=True)
class ControlPoint:
    """A point known in the cloud and in the photo, with its sigmas and what the adjustment made of it."""

    name: str
    xyz: FloatArray
    xy: FloatArray
    role: Role = "control"
    sigma_xyz: FloatArray | None = None
    sigma_xy: FloatArray | None = None
    residual_xy: FloatArray | None = None
    status: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyz", _frozen(self.xyz, (3,), f"point {self.name}: xyz"))
        object.__setattr__(self, "xy", _frozen(self.xy, (2,), f"point {self.name}: xy"))
        if self.role not in ("control", "check"):
            raise InvalidInputError(f"point {self.name}: role {self.role!r} is neither 'control' nor 'check'")
        for attribute, size in (("sigma_xyz", 3), ("sigma_xy", 2)):
            value = getattr(self, attribute)
            if value is not None:
                value = _frozen(value, (size,), f"point {self.name}: {attribute}")
                if (value < 0).any():
                    raise InvalidInputError(f"point {self.name}: {attribute} is negative: {value.tolist()}")
                object.__setattr__(self, attribute, value)
        if self.residual_xy is not None:
            object.__setattr__(self, "residual_xy", _frozen(self.residual_xy, (2,), f"point {self.name}: residual_xy"))


@dataclass(frozen=True)
class Covariance:
    """Covariance of estimated parameters, named as in ``docs/conventions.md``."""

    parameters: tuple[str, ...]
    matrix: FloatArray

    def __post_init__(self) -> None:
        n = len(self.parameters)
        object.__setattr__(self, "parameters", tuple(self.parameters))
        object.__setattr__(self, "matrix", _frozen(self.matrix, (n, n), "covariance"))

    def sigma(self, name: str) -> float:
        """The standard deviation of one parameter."""
        i = self.parameters.index(name)
        return float(np.sqrt(self.matrix[i, i]))


@dataclass(frozen=True)
class View:
    """A photo with its camera and pose, or with its DLT matrix."""

    name: str
    image: Path | None
    camera: Camera | None = None
    pose: Pose | None = None
    dlt: FloatArray | None = None
    dlt_distortion: Mapping[str, float] = field(default_factory=dict)
    size: tuple[int, int] | None = None
    covariance: Covariance | None = None
    method: str | None = None
    points: Sequence[ControlPoint] = ()
    statistics: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if (self.dlt is None) == (self.camera is None or self.pose is None):
            raise InvalidInputError(f"view {self.name!r} needs either camera and pose, or a dlt matrix")
        if self.dlt is not None:
            object.__setattr__(self, "dlt", _frozen(self.dlt, (3, 4), f"view {self.name!r}: dlt"))
        object.__setattr__(self, "points", tuple(self.points))

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(width, height) in pixels; ``None`` for a DLT view whose photo was not read yet."""
        return (self.camera.width, self.camera.height) if self.camera else self.size

    @cached_property
    def core(self) -> _core.View:
        """The compiled view that the kernels take."""
        if self.camera is not None and self.pose is not None:
            c = self.camera
            return _core.View.canonical(c.model, c.width, c.height, c.vector, self.pose.rotation, self.pose.translation)
        assert self.dlt is not None
        if self.size is None:
            raise InvalidInputError(f"view {self.name!r}: the size of its photo is not known; give `size`")
        unknown = sorted(set(self.dlt_distortion) - set(DLT_DISTORTION_NAMES))
        if unknown:
            raise InvalidInputError(f"view {self.name!r}: a dlt has no distortion term {', '.join(unknown)}")
        terms = [float(self.dlt_distortion.get(name, 0.0)) for name in DLT_DISTORTION_NAMES]
        return _core.View.dlt(self.dlt, *self.size, np.array(terms))


@dataclass(frozen=True)
class Registration:
    """One or more views in the frame of one cloud, with their statistics."""

    views: tuple[View, ...]
    cloud: Path | None = None
    crs_wkt: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "views", tuple(self.views))
        if not self.views:
            raise InvalidInputError("a registration needs at least one view")


@dataclass(frozen=True)
class PointCloud:
    """A cloud in memory: ``xyz`` (N, 3) float64 in the cloud's own frame, and what else it carries.

    ``intensity`` (N,), ``rgb`` (N, 3) uint16 and ``normals`` (N, 3) are ``None`` where the file has none.
    """

    xyz: FloatArray
    intensity: npt.NDArray[Any] | None = None
    rgb: npt.NDArray[np.uint16] | None = None
    normals: FloatArray | None = None
    crs_wkt: str | None = None

    def __post_init__(self) -> None:
        xyz = np.ascontiguousarray(self.xyz, dtype=np.float64)
        if xyz.ndim != 2 or xyz.shape[1] != 3:
            raise InvalidInputError(f"xyz has shape {xyz.shape}, not (N, 3)")
        object.__setattr__(self, "xyz", xyz)
        for name, shape in (("intensity", (len(xyz),)), ("rgb", (len(xyz), 3)), ("normals", (len(xyz), 3))):
            value = getattr(self, name)
            if value is not None and np.shape(value) != shape:
                raise InvalidInputError(f"{name} has shape {np.shape(value)}, not {shape}")

    def __len__(self) -> int:
        return len(self.xyz)
