"""Correspondences between a cloud and a photo, without picking: SCI, interest points, templates, and 3D by the index.

A template of the SCI is found in the photo by its oriented gradients. The point behind it is the one that the index
image names, at its own place in its pixel: the shift is that of the template, the pixel that of the point.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import _core
from ..model import FloatArray, PointCloud, View
from ..sci import LUMINANCE, SCI, Float32Array, points_of, render_sci, with_size

#: No match is more precise than this, px of the level: what is left of the SCI's own grid.
FLOOR = 0.05

#: Gaps are bridged by a Gaussian of this share of the points' spacing.
GAP = 0.6

#: How far an edge that relief makes in one picture alone lies from the surface's own: as far as the relief is deep,
#: seen from the camera, times this. Found on simulated façades.
RELIEF = 1.0


@dataclass(frozen=True)
class Correspondences:
    """Matches of one SCI with the photo; rows go together.

    - ``xyz`` (N, 3): points of the cloud; ``xy`` (N, 2): where they are in the photo, px of the full photo.
    - ``covariance`` (N, 2, 2): of ``xy``, px², as the peak and the relief of the template have it.
    - ``template`` (N,): the number of the template; several rows of one are its several hypotheses.
    - ``score`` (N,): the likeness at the match. ``here`` (T,): that of every known template without any shift,
      matched or not.
    - ``outcomes``: how many templates ended how.
    """

    xyz: FloatArray
    xy: FloatArray
    covariance: FloatArray
    template: npt.NDArray[np.int64]
    score: FloatArray
    here: FloatArray
    templates: int
    outcomes: Mapping[str, int]
    pixel: float

    def __len__(self) -> int:
        return len(self.xy)


@dataclass
class PhotoPyramid:
    """A photo, its grey values, and its features at the sizes that were asked for."""

    pixels: npt.NDArray[Any]
    grey: npt.NDArray[np.float32]
    _features: dict[tuple[int, int], _core.Features] = field(default_factory=dict)

    @classmethod
    def of(cls, pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.float32]) -> PhotoPyramid:
        """From a photo (H, W) or (H, W, 3)."""
        grey = pixels if pixels.ndim == 2 else pixels[:, :, :3] @ LUMINANCE
        return cls(pixels, np.ascontiguousarray(grey, dtype=np.float32))

    def at(self, width: int, height: int) -> _core.Features:
        """The features at a size."""
        if (width, height) not in self._features:
            self._features[width, height] = _core.Features.channels(_core.resize(self.grey, width, height))
        return self._features[width, height]


@dataclass(frozen=True)
class Search:
    """How templates are laid out and searched, in pixels of the level."""

    half: int = 12
    radius: int = 4
    cell: int = 24
    per_cell: int = 2
    hypotheses: int = 1


def pixels_per_radian(view: View) -> float:
    """The scale in the middle of the picture."""
    core = view.core
    x, y = 0.5 * (core.width - 1), 0.5 * (core.height - 1)
    rays = _core.unproject(core, np.array([[x - 0.5, y], [x + 0.5, y]]))
    return float(1.0 / np.linalg.norm(rays[1] - rays[0]))


def supported_scale(clouds: PointCloud | Iterable[PointCloud], view: View) -> float:
    """The reduction of the photo at which the SCI has about one point in each pixel where it has any; 1 at most."""
    core = view.core
    cell = max(max(core.width, core.height) // 64, 1)
    shape = (core.height // cell + 1, core.width // cell + 1)
    count = np.zeros(shape[0] * shape[1], np.int64)
    for cloud in (clouds,) if isinstance(clouds, PointCloud) else clouds:
        xy, _ = _core.project(core, cloud.xyz)
        inside = (xy >= -0.5).all(1) & (xy < [core.width - 0.5, core.height - 0.5]).all(1)
        cells = ((xy[inside] + 0.5) / cell).astype(np.int64)
        count += np.bincount(cells[:, 1] * shape[1] + cells[:, 0], minlength=len(count))
    occupied = count[count > 0]
    return 0.0 if len(occupied) == 0 else float(min(1.0, np.sqrt(np.median(occupied)) / cell))


def grey_to_match(sci: SCI) -> tuple[Float32Array, npt.NDArray[np.bool_]]:
    """An SCI's ranks at the pixels' centres, 0 to 1, and where they are known."""
    image = sci.at_centres.copy()
    known = np.isfinite(image)
    image[known] = _core.rank(image[known])
    image[~known] = 0.0
    return image, known


def fill_gaps(
    image: Float32Array, known: npt.NDArray[np.bool_], spacing: float
) -> tuple[Float32Array, npt.NDArray[np.bool_]]:
    """The picture with its gaps as narrow as the points' ``spacing``, px, bridged; wider ones are not seen by the scan.

    Where one surface ends before another there is a gap of about one spacing, and the edge lies anywhere in it: in its
    middle on average. Left open, the strongest edges of all would not be seen.
    """
    sigma = max(GAP * spacing, 0.6)
    near = _core.masked_blur(known.astype(np.float32), None, sigma)
    bridged = ~known & (near > 0.25)
    image = image.copy()
    image[bridged] = _core.masked_blur(image, known, sigma)[bridged]
    return image, known | bridged


def find_correspondences(
    cloud: PointCloud,
    view: View,
    photo: PhotoPyramid,
    scale: float,
    search: Search,
    *,
    station: FloatArray | None = None,
    exponents: tuple[float, float] | None = None,
) -> tuple[Correspondences, SCI]:
    """Matches the SCI of a view with the photo, both reduced to ``scale``. Also returns the SCI.

    Raises DegenerateError where SCI or photo have no edges.
    """
    core = view.core
    width, height = max(round(core.width * scale), 16), max(round(core.height * scale), 16)
    level = with_size(view, width, height)
    sci = render_sci(cloud, level, station=station, exponents=exponents)
    image, known = grey_to_match(sci)
    features = _core.Features.channels(image, known)
    half = min(search.half, (min(width, height) - 3) // 4)
    points, _ = _core.interest_points(image, known, cell=search.cell, per_cell=search.per_cell, border=half)
    points, pixels = _with_a_point(sci, points)
    found = _core.match_templates(
        features, photo.at(width, height), points, half=half, radius=search.radius, hypotheses=search.hypotheses
    )
    matched = found["outcome"] == _core.MATCH_OUTCOMES.index("matched")
    template = found["template"][matched]
    xyz, places = points_of(sci, cloud, pixels[template])
    covariance = found["covariance"][matched]
    inverse = np.where(sci.seen, 1.0 / sci.depth, 0.0).astype(np.float32)
    relief = _core.relief(inverse, np.ascontiguousarray(points[template]), half)
    own = (RELIEF * pixels_per_radian(level) * np.nan_to_num(relief, nan=0.01)) ** 2 + FLOOR**2
    # From the level's pixels to the photo's: borders, not centres, fall on each other.
    sx, sy = core.width / width, core.height / height
    full = np.empty((len(template), 2, 2))
    full[:, 0, 0] = (covariance[:, 0] + own) * sx * sx
    full[:, 1, 1] = (covariance[:, 2] + own) * sy * sy
    full[:, 0, 1] = full[:, 1, 0] = covariance[:, 1] * sx * sy
    xy = (places + found["shift"][matched] + 0.5) * [sx, sy] - 0.5
    counts = np.bincount(found["outcome"], minlength=len(_core.MATCH_OUTCOMES))
    return (
        Correspondences(
            xyz=xyz,
            xy=xy,
            covariance=full,
            template=template,
            score=found["score"][matched].astype(np.float64),
            here=found["here"][np.isfinite(found["here"])].astype(np.float64),
            templates=len(points),
            outcomes={name: int(n) for name, n in zip(_core.MATCH_OUTCOMES, counts, strict=True)},
            pixel=0.5 * (sx + sy),
        ),
        sci,
    )


def _with_a_point(sci: SCI, points: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The interest points that have a measured pixel at or beside them, and that pixel."""
    height, width = sci.index.shape
    pixels = points.copy()
    missing = sci.index[pixels[:, 1], pixels[:, 0]] < 0
    for step in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)):
        beside = np.clip(points + step, 0, [width - 1, height - 1])
        take = missing & (sci.index[beside[:, 1], beside[:, 0]] >= 0)
        pixels[take] = beside[take]
        missing &= ~take
    return points[~missing], pixels[~missing]
