"""Evaluation without control points: how far the cloud's synthetic image, or another photo, and a photo lie apart.

Templates of the cloud's image (its intensity, or the colours that another photo gives to points that both see) are
searched in the photo around the very place where the view puts them. What they find took no part in a registration by
control points, so that it checks one. Over a grid of patches each has its shift and its own sigma; and a common field
of shift, rotation and scale is estimated from all matches and tested: where it is significant it is called systematic.

Matches that overlap err together, and all of them share what light does: shadows below ledges are in the photo alone.
The field's covariance sums the products of neighbours' gradients (Conley 1999), and holds what the method itself was
found to be off by on views that were right. Where the registration states a covariance, the field is also compared with
what *that* lets one expect: a systematic field may still be within it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import _core
from ..errors import DegenerateError
from ..matching.correspondences import (
    Correspondences,
    PhotoPyramid,
    Search,
    find_correspondences,
    pixels_per_radian,
    supported_scale,
)
from ..matching.parameters import design
from ..model import FloatArray, PointCloud, View

#: Significance of the test of the field.
ALPHA = 0.01
#: Of Tukey's biweight in two dimensions, as in the resection.
TUKEY = 5.123
#: The distance over which matches err together, as one sigma of a Gaussian and a share of the photo's long side. This,
#: the bias below and the unit of the sigmas are not those of :mod:`..matching.match_covariance`, which say how far off
#: a view is that was fitted to matches. Here single templates are compared with a view that has never seen them, and
#: the level of the test was set, and checked on other views, with all three together: none can be changed alone.
CORRELATION_LENGTH = 0.06
#: What the method is off by in common, px of the synthetic image, one sigma in x and in y (and, of rotation and scale,
#: at half the photo's width): of cloud and photo, whose light differs, and of two photos. Found on 62 right views of
#: simulated scenes; it keeps the level of the test on others.
BIAS_OF_CLOUD, BIAS_OF_PHOTO = 0.16, 0.11
#: A systematic field smaller than this, px of the synthetic image, is beside the point whatever the test says.
NEGLIGIBLE = 0.1
#: Columns and rows of the grid of patches, along the long and the short side.
PATCHES = (8, 6)
#: With fewer matches nothing is said.
LEAST_MATCHES = 20
#: Matches that agree with the field, as a share of all: below, they are found by chance.
LEAST_SHARE = 0.4
#: How many matches of a patch weigh as much as what all matches together say about their precision.
PRIOR = 4
#: Matches farther from the field than this, px of the synthetic image, do not agree with it; by chance 2 % would.
NEAR = 2.5
#: Stated sigmas of matches are twice as large as their errors; the fit's own scale corrects the rest.
UNIT = 0.5
#: How templates are searched, px of the synthetic image: far enough for a view that is a little off.
SEARCH = Search(half=16, radius=14, cell=16, per_cell=1)
#: The long side of the synthetic image, px, is no larger: precision grows no further, but the time does.
LONGEST = 2400

FIELD = ("shift x", "shift y", "rotation", "scale")


@dataclass(frozen=True)
class Patch:
    """A patch of the grid: its middle in the photo, the shift that its matches show (photo minus view, px, x and y)
    with its sigma per axis, the mean depth of its points, and how many matches it has."""

    x: float
    y: float
    shift: tuple[float, float]
    sigma: float
    depth: float
    matches: int

    @property
    def significant(self) -> bool:
        """Whether the shift differs from zero at the level of 0.001, taken alone."""
        return float(np.hypot(*self.shift)) > self.sigma * float(np.sqrt(_core.region_limit(0.999, 2)))


@dataclass(frozen=True, eq=False)
class Agreement:
    """How far a photo lies from what the view makes of the cloud, or of another photo's colours.

    - ``field``: shift in x and y (px), rotation (radians, about the photo's middle, x towards y), scale less one; and
      ``sigmas`` of these. ``p_value``: of a field as large, were there none; ``p_explained``: the same, given what the
      view's own covariance allows; NaN where that is not known.
    - ``size``: root mean square of the field over the photo's matches, px.
    - ``tells`` and ``reason``: whether enough was found to say anything, and why not.
    """

    title: str
    tells: bool
    reason: str
    patches: tuple[Patch, ...]
    templates: int
    matches: int
    used: int
    field: FloatArray
    sigmas: FloatArray
    p_value: float
    p_explained: float
    size: float
    limit: float
    pixels_per_radian: float
    depth: float

    @property
    def systematic(self) -> bool:
        """Whether a common field is significant, and large enough to matter."""
        return self.tells and self.p_value < ALPHA and self.size > self.limit

    @property
    def explained(self) -> bool:
        """Whether the view's own covariance lets one expect a field of this size."""
        return bool(self.p_explained > ALPHA)

    @property
    def _heading(self) -> str:
        return self.title[:1].upper() + self.title[1:]

    def sentence(self) -> str:
        """The finding, with its size in px, mm and mrad."""
        if not self.tells:
            return f"{self._heading}: {self.reason}"
        mm, mrad = 1e3 * self.size * self.depth / self.pixels_per_radian, 1e3 * self.size / self.pixels_per_radian
        size = f"{self.size:.2f} px = {mm:.1f} mm at {self.depth:.1f} m = {mrad:.2f} mrad"
        if not self.systematic:
            return f"{self._heading}: no systematic field ({size}, p = {self.p_value:.2g})."
        f, s = self.field, self.sigmas
        parts = [f"shift x {f[0]:+.2f} ± {s[0]:.2f} px, y {f[1]:+.2f} ± {s[1]:.2f} px"]
        if abs(f[2]) > 2 * s[2]:
            parts.append(f"rotation {np.degrees(f[2]):+.3f} ± {np.degrees(s[2]):.3f}°")
        if abs(f[3]) > 2 * s[3]:
            parts.append(f"scale {1 + f[3]:.5f} ± {s[3]:.5f}")
        return f"{self._heading}: a systematic field of {size} ({'; '.join(parts)}; p = {self.p_value:.1g})."

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        per_mm, per_mrad = 1e3 / self.pixels_per_radian, 1e3 / self.pixels_per_radian

        def number(value: float) -> float | None:
            return float(value) if np.isfinite(value) else None

        return {
            "title": self.title,
            "tells": self.tells,
            "reason": self.reason or None,
            "systematic": self.systematic,
            "explained_by_covariance": None if np.isnan(self.p_explained) else self.explained,
            "alpha": ALPHA,
            "p_value": number(self.p_value),
            "p_value_given_covariance": number(self.p_explained),
            "field": dict(zip(FIELD, map(number, self.field), strict=True)),
            "field_sigmas": dict(zip(FIELD, map(number, self.sigmas), strict=True)),
            "size_px": number(self.size),
            "size_mm": number(self.size * self.depth * per_mm),
            "size_mrad": number(self.size * per_mrad),
            "templates": self.templates,
            "matches": self.matches,
            "used": self.used,
            "patches": [
                {
                    "x": p.x, "y": p.y, "shift_px": list(p.shift), "sigma_px": p.sigma, "depth_m": p.depth,
                    "shift_mm": [v * p.depth * per_mm for v in p.shift], "sigma_mm": p.sigma * p.depth * per_mm,
                    "shift_mrad": [v * per_mrad for v in p.shift], "sigma_mrad": p.sigma * per_mrad,
                    "matches": p.matches, "significant": p.significant,
                }
                for p in self.patches
            ],
        }  # fmt: skip


def cloud_against_photo(cloud: PointCloud, photo: PhotoPyramid, view: View) -> Agreement:
    """The cloud's intensity (or its own colours, where it has none) against the photo."""
    return _compared("cloud against photo", cloud, photo, view)


def photo_against_photo(
    cloud: PointCloud, photo: PhotoPyramid, view: View, other_pixels: Any, other: View
) -> Agreement:
    """The colours that another view's photo gives to the points that both views see, against this view's photo."""
    maps = []
    for v in (view, other):
        buffer = _core.DepthBuffer(v.core)
        buffer.add(cloud.xyz)
        maps.append(buffer.finish())
    both = maps[0].visible(cloud.xyz) & maps[1].visible(cloud.xyz)
    title = f"{other.name} against {view.name}"
    xyz = np.ascontiguousarray(cloud.xyz[both])
    if len(xyz) < 100:
        return _silent(title, view, f"both photos see only {len(xyz)} points of the cloud.")
    rgb, source = _core.colour_points([maps[1]], [other_pixels], xyz)
    seen = source > 0
    return _compared(title, PointCloud(xyz[seen], rgb=rgb[seen]), photo, view, other)


def _silent(title: str, view: View, reason: str, templates: int = 0, matches: int = 0) -> Agreement:
    nan = float("nan")
    empty = np.full(4, nan)
    return Agreement(
        title, False, reason, (), templates, matches, 0, empty, empty, nan, nan, nan, nan, pixels_per_radian(view), nan
    )


def _compared(title: str, cloud: PointCloud, photo: PhotoPyramid, view: View, other: View | None = None) -> Agreement:
    supported = supported_scale(cloud, view)
    long_side = max(view.core.width, view.core.height)
    if supported == 0.0:
        return _silent(title, view, "no point of the cloud lies in the photo.")
    scale = min(1.0, 1.5 * supported, LONGEST / long_side)
    try:
        found, _ = find_correspondences(cloud, view, photo, scale, SEARCH)
    except DegenerateError as error:
        return _silent(title, view, f"{error}.")
    if len(found) < LEAST_MATCHES:
        return _silent(
            title, view, f"only {len(found)} of {found.templates} templates were found in the photo, too few to tell.",
            found.templates, len(found),
        )  # fmt: skip
    return judge(title, found, view, other)


def judge(title: str, found: Correspondences, view: View, other: View | None = None) -> Agreement:
    """The common field of matches, its test, and the shifts of the patches."""
    projected, depth = _core.project(view.core, found.xyz)
    shift = found.xy - projected
    ok = np.isfinite(shift).all(1)
    xyz, shift, projected, depth = found.xyz[ok], shift[ok], projected[ok], depth[ok]
    covariance = found.covariance[ok] * UNIT**2
    bias = (BIAS_OF_CLOUD if other is None else BIAS_OF_PHOTO) * found.pixel
    rows = _field_rows(projected, view)
    field, weight, factors, spread = _fit(rows, shift, covariance, found.pixel)
    # A fit to noise takes the whole window for its scatter: what agrees lies within few pixels.
    near = np.linalg.norm(shift - rows @ field, axis=1) < NEAR * found.pixel
    weight = np.where(near, weight, 0.0)
    used = weight > 0
    share = float(used.mean())
    if share < LEAST_SHARE or used.sum() < LEAST_MATCHES:
        return _silent(
            title, view,
            f"only {int(used.sum())} of {len(used)} matches agree with one another: they are found by chance, or the "
            f"view is off by more than {SEARCH.radius * found.pixel:.0f} px.",
            found.templates, len(used),
        )  # fmt: skip
    spread_place = projected / (CORRELATION_LENGTH * max(view.core.width, view.core.height))
    estimator, matrix = _field_covariance(rows, weight, factors, shift, field, spread_place)
    at_half = 2 * bias / max(view.core.width, view.core.height)
    matrix = matrix + np.diag(np.square([bias, bias, at_half, at_half]))
    explained = float("nan")
    if view.covariance is not None:
        from_view = _of_the_view(estimator, view, xyz)
        if other is not None:
            from_view = None if other.covariance is None else from_view
        if from_view is not None:
            explained = _p(field, matrix + from_view)
    fitted = rows @ field
    size = float(np.sqrt((fitted[used] ** 2).sum(1).mean()))
    patches = _patches(projected, shift, depth, weight, factors, spread, spread_place, bias, view)
    return Agreement(
        title, True, "", patches, found.templates, len(used), int(used.sum()), field, np.sqrt(np.diag(matrix)),
        _p(field, matrix), explained, size, NEGLIGIBLE * found.pixel, pixels_per_radian(view),
        float(np.median(depth[used])),
    )  # fmt: skip


def _p(field: FloatArray, matrix: FloatArray) -> float:
    size = np.sqrt(np.diag(matrix))
    square = float((field / size) @ np.linalg.solve(matrix / np.outer(size, size), field / size))
    return float(_core.exceedance(square, len(field)))


def _field_rows(xy: FloatArray, view: View) -> FloatArray:
    """(N, 2, 4): what each match says of shift, rotation and scale about the photo's middle."""
    x, y = (xy - [0.5 * (view.core.width - 1), 0.5 * (view.core.height - 1)]).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    return np.stack([np.stack([one, zero, -y, x], 1), np.stack([zero, one, x, y], 1)], 1)


def _fit(
    rows: FloatArray, shift: FloatArray, covariance: FloatArray, pixel: float
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Robustly, by Tukey's biweight from afar: field, weights (N,), whitening factors (N, 2, 2), spread in sigmas."""
    factors = np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1)
    design_rows, values = factors @ rows, np.einsum("nij,nj->ni", factors, shift)
    field = np.zeros(4)
    field[:2] = _densest(shift, 1.5 * pixel)
    weight, spread = np.ones(len(rows)), 1.0
    for unit in (8.0, 8.0, 4.0, 4.0, 2.0, 2.0, *[1.0] * 10):
        residual = values - design_rows @ field
        square = (residual**2).sum(1)
        near = square < (8 * TUKEY) ** 2
        if near.sum() < 4:
            break
        # The median of χ² with two degrees of freedom is 2 ln 2.
        spread = float(np.sqrt(max(np.median(square[near]) / (2 * np.log(2)), 0.25)))
        s = square / (TUKEY * max(spread, 1.0) * unit) ** 2
        weight = np.where(s < 1, (1 - np.minimum(s, 1)) ** 2, 0.0)
        if (weight > 0).sum() < 4:
            break
        normal = np.einsum("nki,n,nkj->ij", design_rows, weight, design_rows)
        right = np.einsum("nki,n,nk->i", design_rows, weight, values)
        size = np.sqrt(np.diag(normal))
        field = np.linalg.solve(normal / np.outer(size, size), right / size) / size
    return field, weight, factors, spread


def _densest(shift: FloatArray, radius: float) -> FloatArray:
    """Where most shifts lie together: the mean of those within ``radius`` of the one that has most about it."""
    chosen = shift[:: max(1, len(shift) // 1500)]
    count = (np.linalg.norm(chosen[:, None] - chosen[None], axis=2) < radius).sum(1)
    best = chosen[int(np.argmax(count))]
    return np.asarray(shift[np.linalg.norm(shift - best, axis=1) < radius].mean(0))


def _kernel(place: FloatArray) -> FloatArray:
    p = place.astype(np.float32)
    square = (p**2).sum(1)
    return np.asarray(np.exp(-0.5 * np.maximum(square[:, None] + square[None] - 2 * p @ p.T, 0)), dtype=np.float64)


def _field_covariance(
    rows: FloatArray,
    weight: FloatArray,
    factors: FloatArray,
    shift: FloatArray,
    field: FloatArray,
    place: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """The linear estimator (4, N, 2) of the field from shifts, and the field's covariance, of correlated matches."""
    white = factors @ rows
    residual = np.einsum("nij,nj->ni", factors, shift - rows @ field)
    size = np.sqrt(np.einsum("nki,n,nki->i", white, weight, white))
    inverse = np.linalg.inv(np.einsum("nki,n,nkj->ij", white / size, weight, white / size)) / np.outer(size, size)
    gradients = np.einsum("nki,n,nk->ni", white, weight, residual)
    kernel = _kernel(place)
    filling = gradients.T @ kernel @ gradients
    places = float(weight.sum() ** 2 / (weight @ kernel @ weight))
    matrix = places / max(places - 0.5 * len(field), 1.0) * inverse @ filling @ inverse
    estimator = np.einsum("ij,nkj,n,nkl->inl", inverse, white, weight, factors)
    return estimator, 0.5 * (matrix + matrix.T)


def _of_the_view(estimator: FloatArray, view: View, xyz: FloatArray) -> FloatArray | None:
    """The covariance (4, 4) that the field has because the view's own parameters are uncertain."""
    c = view.covariance
    if c is None or view.camera is None:
        return None
    rows = design(view, c.parameters, np.ascontiguousarray(xyz))
    if not np.isfinite(rows).all():
        return None
    effect = np.einsum("inl,nlu->iu", estimator, rows)
    return np.asarray(effect @ c.matrix @ effect.T)


def _patches(
    xy: FloatArray,
    shift: FloatArray,
    depth: FloatArray,
    weight: FloatArray,
    factors: FloatArray,
    spread: float,
    place: FloatArray,
    bias: float,
    view: View,
) -> tuple[Patch, ...]:
    """The mean shift of the matches in each cell; its sigma counts neighbours' matches as one where they overlap."""
    width, height = view.core.width, view.core.height
    columns, rows = PATCHES if width >= height else PATCHES[::-1]
    column = np.clip((xy[:, 0] + 0.5) / width * columns, 0, columns - 1).astype(int)
    row = np.clip((xy[:, 1] + 0.5) / height * rows, 0, rows - 1).astype(int)
    found = []
    for r in range(rows):
        for c in range(columns):
            mine = np.flatnonzero((column == c) & (row == r) & (weight > 0))
            if len(mine) < 3:
                continue
            # One weight for both axes: the geometric mean of the whitening factors' scales.
            w = weight[mine] * np.abs(np.linalg.det(factors[mine]))
            mean = (w @ shift[mine]) / w.sum()
            # What the matches say of themselves, corrected by all matches' scatter, and their own scatter, as if the
            # former were known from as many matches as PRIOR.
            own = spread**2 / np.abs(np.linalg.det(factors[mine]))
            scatter = ((shift[mine] - mean) ** 2).sum(1) @ w / w.sum() / 2
            each = np.sqrt((PRIOR * own + len(mine) * scatter) / (PRIOR + len(mine) - 1))
            kernel = _kernel(place[mine])
            variance = (w * each) @ kernel @ (w * each) / w.sum() ** 2 + bias**2
            x, y = xy[mine].mean(0)
            found.append(
                Patch(
                    float(x), float(y), (float(mean[0]), float(mean[1])), float(np.sqrt(variance)),
                    float(depth[mine].mean()), len(mine),
                )
            )  # fmt: skip
    return tuple(found)


def agreements(cloud: PointCloud, views: Sequence[View], photos: Sequence[Any]) -> list[list[Agreement]]:
    """For each view the comparison of cloud and photo, and then with each of the other photos."""
    pyramids = [PhotoPyramid.of(p) for p in photos]
    found = []
    for i, view in enumerate(views):
        mine = []
        if cloud.intensity is not None:
            mine.append(cloud_against_photo(cloud, pyramids[i], view))
        else:
            mine.append(_silent("cloud against photo", view, "the cloud has no intensity to compare."))
        # A photo agrees with itself, however wrong its view is.
        others = [
            (photos[j], other)
            for j, other in enumerate(views)
            if j != i and (view.image is None or other.image != view.image)
        ]
        mine += [photo_against_photo(cloud, pyramids[i], view, photo, other) for photo, other in others]
        found.append(mine)
    return found
