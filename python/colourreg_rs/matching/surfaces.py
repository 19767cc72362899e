"""All templates of an SCI taken together: the view at which their likenesses to the photo are largest in sum.

A template on a straight edge fixes its shift across the edge alone, one on a row of equal windows fits at several
shifts; searched one by one they are refused or err. Taken together they need not decide: each keeps its whole surface
of scores over the shifts, and the view is moved until the sum of their log-likelihoods, ``-n/2 log(1 - ρ²)`` of the
correlation ρ over n independent pixels, is largest. It saturates by itself: what looks nowhere alike has no slope.
Source of the idea: constrained local models (Saragih, Lucey and Cohn 2011), with a camera in place of a face.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .. import _core
from ..model import FloatArray, PointCloud, View
from ..sci import SCI, Float32Array, render_sci, with_size
from .correspondences import PhotoPyramid, fill_gaps, grey_to_match, pixels_per_radian

#: Templates of 2 HALF + 1 px a side, the same px apart: larger ones mix surfaces, smaller ones tell too little.
HALF = 14

#: At most about so many templates: larger photos get them farther apart.
MOST = 3000

#: The share of templates with the weakest edges that is left out.
EMPTIEST = 0.3

#: A template's weight falls to a half where its relief, seen from the camera, shifts edges by this, px: there the photo
#: shows shadows and sides that the scan does not. Found on simulated façades and rooms.
RELIEF = 0.07

#: More relief than this, px, says no more: it is another object, whose outline fixes where the camera stands.
MOST_RELIEF = 1.0

#: An estimate from one linearisation moves no template farther than this, px.
STEP = 1.0

#: The least information of a template in any direction, px⁻².
LEAST = 1e-4

#: An edge between two surfaces belongs to the nearer one, if that lies within this, px.
REACH = 3


@dataclass(frozen=True)
class Linearised:
    """The surfaces seen from one view, as matches whose covariances are the surfaces' curvatures.

    ``xyz`` (N, 3), ``xy`` (N, 2) px of the photo, ``covariance`` (N, 2, 2) px²; ``value`` the sum of log-likelihoods.
    """

    xyz: FloatArray
    xy: FloatArray
    covariance: FloatArray
    value: float


@dataclass(frozen=True)
class Surfaces:
    """Templates of one SCI with their scores over shifts in the photo; rows go together.

    - ``xyz`` (T, 3): what a template shows, world; ``places`` (T, 2): its middle, px of the level.
    - ``scores`` (T, S, S): likeness at the shifts −radius … radius in y and x. ``samples`` (T,): independent pixels,
      made less by relief.
    - ``size``: of the photo; ``scale``: px of the photo for one of the level, in x and y.
    """

    xyz: FloatArray
    places: FloatArray
    scores: Float32Array
    samples: FloatArray
    size: tuple[int, int]
    scale: FloatArray

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def radius(self) -> int:
        """The largest shift, px of the level."""
        return int(self.scores.shape[1]) // 2

    @property
    def here(self) -> FloatArray:
        """(T,): the likeness without a shift."""
        return self.scores[:, self.radius, self.radius].astype(np.float64)

    @property
    def level(self) -> tuple[int, int]:
        """Width and height of the level, px."""
        width, height = np.round(self.size / self.scale).astype(int).tolist()
        return width, height

    @property
    def pixel(self) -> float:
        """The size of the level's pixel in the photo, px."""
        return float(self.scale.mean())

    def log_likelihood(self) -> FloatArray:
        """(T, S, S): of each shift, 0 where there is no likeness."""
        rho = np.clip(self.scores, 0.0, 0.999).astype(np.float64)
        return np.asarray(-0.5 * self.samples[:, None, None] * np.log1p(-(rho**2)))

    def linearised(self, view: View, surfaces: FloatArray | None = None) -> Linearised:
        """The surfaces at ``view``; ``surfaces`` are their :meth:`log_likelihood`, if at hand."""
        surfaces = self.log_likelihood() if surfaces is None else surfaces
        projected, _ = _core.project(view.core, self.xyz)
        shift = (projected + 0.5) / self.scale - 0.5 - self.places
        with np.errstate(invalid="ignore"):
            inside = (np.abs(shift) < self.radius - 1).all(1)
        shift = shift[inside]
        value, slope, bend = _splined(surfaces[inside], shift + self.radius)
        curvature, axes = np.linalg.eigh(-bend)
        along = np.einsum("nij,ni->nj", axes, slope)
        information = np.maximum(np.maximum(curvature, np.abs(along) / STEP), LEAST)
        step = np.einsum("nij,nj->ni", axes, along / information)
        covariance = np.einsum("nij,nj,nkj->nik", axes, 1.0 / information, axes)
        return Linearised(
            np.ascontiguousarray(self.xyz[inside]),
            np.ascontiguousarray(projected[inside] + step * self.scale),
            np.ascontiguousarray(covariance * np.outer(self.scale, self.scale)),
            float(value.sum()),
        )


def joined(parts: Sequence[Surfaces]) -> Surfaces:
    """The surfaces of several renderings of one level, with equal radii: their noise is not the same."""
    first = parts[0]
    return Surfaces(
        np.concatenate([p.xyz for p in parts]),
        np.concatenate([p.places for p in parts]),
        np.concatenate([p.scores for p in parts]),
        np.concatenate([p.samples for p in parts]),
        first.size,
        first.scale,
    )


def find_surfaces(
    cloud: PointCloud | Iterable[PointCloud],
    view: View,
    photo: PhotoPyramid,
    scale: float,
    *,
    radius: int,
    spacing: float,
    half: int = HALF,
    offset: int = 0,
    station: FloatArray | None = None,
    exponents: tuple[float, float] | None = None,
) -> tuple[Surfaces, SCI]:
    """The surfaces of a view's SCI in the photo, both reduced to ``scale``. Also returns the SCI.

    ``spacing``: of the cloud's points, px of the level; gaps as narrow are bridged. ``offset``: number of a layout of
    templates, each beside the others. Raises DegenerateError where SCI or
    photo have no edges.
    """
    core = view.core
    width, height = max(round(core.width * scale), 16), max(round(core.height * scale), 16)
    level = with_size(view, width, height)
    sci = render_sci(cloud, level, station=station, exponents=exponents)
    image, known = fill_gaps(*grey_to_match(sci), spacing)
    features = _core.Features.channels(image, known)
    half = min(half, (min(width, height) - 3) // 4)
    points, depth = _laid_out(image, known, sci, half, offset)
    flat, samples = _core.score_templates(features, photo.at(width, height), points, half=half, radius=radius)
    scores = flat.reshape(-1, 2 * radius + 1, 2 * radius + 1)
    inverse = np.where(sci.seen, 1.0 / sci.depth, 0.0).astype(np.float32)
    relief = pixels_per_radian(level) * np.nan_to_num(_core.relief(inverse, points, half), nan=0.01)
    places = points.astype(np.float64)
    xyz = _at_depth(level, places, depth)
    again, _ = _core.project(level.core, xyz)
    with np.errstate(invalid="ignore"):
        ok = (samples > 0) & np.isfinite(scores).all((1, 2)) & (np.abs(again - places).max(1) < 1e-3)
    return (
        Surfaces(
            np.ascontiguousarray(xyz[ok]),
            places[ok],
            np.ascontiguousarray(scores[ok]),
            samples[ok] / (1.0 + (np.minimum(relief[ok], MOST_RELIEF) / RELIEF) ** 2),
            (core.width, core.height),
            np.array([core.width / width, core.height / height]),
        ),
        sci,
    )


def _laid_out(
    image: Float32Array, known: npt.NDArray[np.bool_], sci: SCI, half: int, offset: int
) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """Templates all over the picture, but not where it is empty: middles (T, 2), and depths (T,) of their edges."""
    height, width = image.shape
    apart = max(half, int(np.sqrt(width * height / MOST)))
    # A sequence that fills the cell evenly (Roberts 2018).
    right, down = (int(np.modf(offset * part)[0] * apart) for part in (0.7548776662, 0.5698402910))
    columns, rows = np.arange(half + right, width - half, apart), np.arange(half + down, height - half, apart)
    points = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.int64)
    by_row, by_column = np.gradient(image)
    energy: Float32Array = np.asarray(by_row**2 + by_column**2, dtype=np.float32)
    strength = _core.masked_blur(energy, known, 0.5 * half)[points[:, 1], points[:, 0]]
    depth = np.where(sci.seen, sci.depth, np.inf)
    nearest = _minimum(_minimum(depth, REACH).T, REACH).T[points[:, 1], points[:, 0]].astype(np.float64)
    seen = np.isfinite(nearest)
    points, strength, nearest = points[seen], strength[seen], nearest[seen]
    keep = strength > (np.quantile(strength, EMPTIEST) if len(strength) else 0.0)
    return np.ascontiguousarray(points[keep]), nearest[keep]


def _minimum(values: Float32Array, reach: int) -> Float32Array:
    """The least value within ``reach`` rows."""
    padded = np.pad(values, ((reach, reach), (0, 0)), constant_values=np.inf)
    out = values.copy()
    for k in range(2 * reach + 1):
        np.minimum(out, padded[k : k + len(values)], out=out)
    return out


def _at_depth(view: View, places: FloatArray, depth: FloatArray) -> FloatArray:
    """World points (T, 3) at the depths that the view sees at ``places`` (T, 2)."""
    core = view.core
    rays = _core.unproject(core, places)
    _, unit = _core.project(core, np.ascontiguousarray(core.centre + rays))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.ascontiguousarray(core.centre + rays * (depth / unit)[:, None])


def _splined(surfaces: FloatArray, at: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Value (T,), slope (T, 2) and second derivatives (T, 2, 2), x before y, of surfaces (T, S, S) at columns and rows
    (T, 2). The values are the coefficients of cubic B-splines, which smooths them a little."""
    cell = np.floor(at).astype(np.int64)
    (x, dx, ddx), (y, dy, ddy) = (_weights(at[:, k] - cell[:, k]) for k in range(2))
    offsets = np.arange(-1, 3)
    patch = surfaces[
        np.arange(len(surfaces))[:, None, None],
        cell[:, 1, None, None] + offsets[:, None],
        cell[:, 0, None, None] + offsets[None, :],
    ]

    def product(column: FloatArray, row: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("nij,ni,nj->n", patch, row, column))

    slope = np.stack([product(dx, y), product(x, dy)], axis=1)
    mixed = product(dx, dy)
    bend = np.stack([product(ddx, y), mixed, mixed, product(x, ddy)], axis=1).reshape(-1, 2, 2)
    return product(x, y), slope, bend


def _weights(t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cubic B-spline weights (T, 4) of four values around ``t``, and their first and second derivatives."""
    s, t2 = 1 - t, t * t
    weight = np.stack([s**3, 3 * t2 * t - 6 * t2 + 4, 3 * (t + t2 - t2 * t) + 1, t2 * t], axis=1) / 6
    first = np.stack([-(s**2), 3 * t2 - 4 * t, 1 + 2 * t - 3 * t2, t2], axis=1) / 2
    second = np.stack([s, 3 * t - 2, 1 - 3 * t, t], axis=1)
    return weight, first, second
