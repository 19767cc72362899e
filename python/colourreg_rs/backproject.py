"""Back-projection: a point of space, with its colour, for the pixels of a photo.

The depths come from the synthetic camera image in the photo's own view. They are those of measured points, or
interpolated between points of one surface, or, where that is wished, extended along a surface beside the cloud. Source:
Hartley and Zisserman, Multiple View Geometry, 6.2.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _core
from .errors import FileError, InvalidInputError
from .model import FloatArray, PointCloud, View
from .sci import SCI, render_sci


class Origin(IntEnum):
    """Where a pixel's depth comes from."""

    MEASURED = 1
    INTERPOLATED = 2
    EXTENDED = 3


@dataclass(frozen=True)
class BackprojectOptions:
    """How depths are found, and how sure their sources are.

    - ``extension``: how far a surface is extended beside the cloud, px.
    - ``radius``: points within it make a surface, px.
    - ``depth_sigma``: noise of the scanner along the ray, m.
    - ``pixel_sigma``: of a pixel's place by registration and photo, per axis, px.

    Raises InvalidInputError.
    """

    extension: float = 0.0
    radius: float = 4.0
    depth_sigma: float = 0.003
    pixel_sigma: float = 0.5

    def __post_init__(self) -> None:
        limits = {"extension": (0.0, 1000.0, "px"), "radius": (1.5, 32.0, "px")}
        limits |= {"depth_sigma": (0.0, 1000.0, "m"), "pixel_sigma": (0.0, 1000.0, "px")}
        for name, (least, most, unit) in limits.items():
            value = getattr(self, name)
            if not (np.isfinite(value) and least <= value <= most):
                allowed = f"{least:g} to {most:g} {unit}"
                raise InvalidInputError(f"{name.replace('_', ' ')} of {value:g} is not possible: {allowed}")


@dataclass(frozen=True)
class BackProjection:
    """Points for N pixels of a photo.

    - ``pixels`` (N, 2) int64: column and row.
    - ``cloud``: the points, with the photo's colours.
    - ``origin`` (N,) uint8: see :class:`Origin`.
    - ``sigma`` (N, 2): along the ray and, per axis, across it, m.
    """

    pixels: npt.NDArray[np.int64]
    cloud: PointCloud
    depth: FloatArray
    origin: npt.NDArray[np.uint8]
    sigma: FloatArray

    @property
    def position_sigma(self) -> FloatArray:
        """(N,): one sigma of the position per axis, the root mean of the three variances, m."""
        along, across = self.sigma.T
        return np.asarray(np.sqrt((along**2 + 2 * across**2) / 3), dtype=np.float64)

    def counts(self) -> dict[str, int]:
        """How many points have each origin."""
        return {o.name.lower(): int((self.origin == o).sum()) for o in Origin}


def exact_depths(sci: SCI, cloud: PointCloud) -> FloatArray:
    """(H, W): the depths of the measured points in double precision, NaN elsewhere."""
    depth = np.full(sci.depth.shape, np.nan)
    _, of_points = _core.project(sci.view.core, cloud.xyz[sci.index[sci.measured]])
    depth[sci.measured] = of_points
    return depth


def backproject(
    cloud: PointCloud,
    view: View,
    photo: npt.NDArray[Any] | None = None,
    *,
    options: BackprojectOptions | None = None,
    sci: SCI | None = None,
) -> BackProjection:
    """Points for all pixels of a photo whose depth the cloud tells.

    ``photo`` (H, W), (H, W, 1) or (H, W, 3), uint8 or uint16, gives them colours; ``sci`` is that of the cloud in the
    view, if it was rendered already. Raises InvalidInputError.
    """
    options = options or BackprojectOptions()
    if sci is None:
        sci = render_sci(cloud, view, exponents=(0.0, 0.0), fill=0)
    pixel, xyz, depth, origin, sigma = _core.backproject_pixels(
        view.core,
        exact_depths(sci, cloud),
        sci.measured,
        subpixel=np.nan_to_num(sci.subpixel),
        radius=options.radius,
        extension=options.extension,
        depth_sigma=options.depth_sigma,
        pixel_sigma=options.pixel_sigma,
    )
    height, width = sci.depth.shape
    pixels = np.stack([pixel % width, pixel // width], 1)
    coloured = PointCloud(xyz, rgb=None if photo is None else _colours(photo, (height, width), pixels))
    return BackProjection(pixels, coloured, depth, origin, sigma)


def _colours(photo: npt.NDArray[Any], shape: tuple[int, int], pixels: npt.NDArray[np.int64]) -> npt.NDArray[np.uint16]:
    photo = photo[..., None] if photo.ndim == 2 else photo
    if photo.shape[:2] != shape:
        raise InvalidInputError(
            f"the photo has {photo.shape[1]} x {photo.shape[0]} pixels, the view's camera {shape[1]} x {shape[0]}; "
            f"give the photo that the view was registered with"
        )
    if photo.dtype not in (np.uint8, np.uint16):
        raise InvalidInputError(f"the photo's pixels are {photo.dtype}; they have to be uint8 or uint16")
    colours = photo[pixels[:, 1], pixels[:, 0]]
    colours = np.repeat(colours[:, :1], 3, 1) if colours.shape[1] < 3 else colours[:, :3]
    # As the LAS specification wants 8-bit values in 16 bits.
    return colours.astype(np.uint16) * 256 if photo.dtype == np.uint8 else np.ascontiguousarray(colours)


@dataclass(frozen=True)
class BackprojectResult:
    """What was written, for people and machines."""

    out: Path
    counts: dict[str, dict[str, int]]
    sigma: dict[str, float]

    def text(self) -> str:
        """A line for each view."""
        lines = []
        for view, counts in self.counts.items():
            parts = ", ".join(f"{n:,} {name}" for name, n in counts.items())
            lines.append(f"{view}: {sum(counts.values()):,} points ({parts}), position sigma {self.sigma[view]:.4f} m")
        return "\n".join([*lines, f"wrote {self.out}"])

    def as_dict(self) -> dict[str, Any]:
        """The same for machines."""
        return {"out": str(self.out), "points": self.counts, "median_position_sigma": self.sigma}


def backproject_file(
    cloud_path: str | Path, registration_path: str | Path, out: str | Path, *, options: BackprojectOptions | None = None
) -> BackprojectResult:
    """Back-projects every photo of a registration and writes the points as one cloud.

    Its attributes ``Origin`` (1 measured, 2 interpolated, 3 extended), ``Sigma`` (m, per axis) and ``View`` (from 1)
    say what each point is. Raises FileError.
    """
    from .io.atomic import refuse_target
    from .io.clouds import open_cloud, output_format, read_cloud, write_cloud
    from .io.images import read_photo
    from .io.registration import read_registration
    from .photo_sizes import with_photo_sizes

    registration = with_photo_sizes(read_registration(registration_path), Path(registration_path))
    photos = [view.image for view in registration.views]
    for view in registration.views:
        if view.image is None:
            raise FileError(registration_path, f"view {view.name!r} names no photo", "add `image`, for the colours")
    # What cannot be written is said before the work, not after it.
    out = Path(out)
    refuse_target(out, (cloud_path, registration_path, *(p for p in photos if p is not None and p.exists())))
    with open_cloud(cloud_path) as reader:
        suffix = output_format(out, reader).lower()
    out = out if out.suffix else out.with_suffix(f".{suffix}")
    cloud = read_cloud(cloud_path)
    found, counts, sigma = [], {}, {}
    for view, path in zip(registration.views, photos, strict=True):
        assert path is not None
        photo = read_photo(path).pixels
        try:
            found.append(backproject(cloud, view, photo, options=options))
        except InvalidInputError as error:
            raise FileError(path, str(error)) from error
        if len(found[-1].cloud) == 0:
            raise FileError(registration_path, f"no pixel of view {view.name!r} sees the cloud", "look at its pose")
        counts[view.name] = found[-1].counts()
        sigma[view.name] = float(np.median(found[-1].position_sigma))
    joined = PointCloud(
        np.concatenate([f.cloud.xyz for f in found]),
        rgb=np.concatenate([f.cloud.rgb for f in found if f.cloud.rgb is not None]),
        crs_wkt=cloud.crs_wkt,
    )
    extra = {
        "Origin": np.concatenate([f.origin for f in found]),
        "Sigma": np.concatenate([f.position_sigma for f in found]).astype(np.float32),
        "View": np.repeat(np.arange(1, len(found) + 1, dtype=np.uint16), [len(f.cloud) for f in found]),
    }
    write_cloud(out, joined, extra)
    return BackprojectResult(out, counts, sigma)
