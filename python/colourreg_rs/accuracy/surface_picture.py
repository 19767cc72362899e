"""The cloud as a view sees it, for people: its edges over the photo, and how far colours may be off on its surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import _core
from ..io.clouds import open_cloud
from ..matching.correspondences import supported_scale
from ..model import FloatArray, PointCloud, View
from ..sci import SCI, render_sci, with_size

#: The long side of the pictures, px: enough to look at, and quick.
LONG_SIDE = 1100
#: Points beyond so many are thinned: no picture and no template becomes better.
MOST_POINTS = 12_000_000
#: A jump of the depth by this share is an edge.
DEPTH_JUMP = 0.02
#: The share of intensity gradients that are drawn as edges.
STRONGEST = 0.06
#: As in colouring, unless told otherwise: the place where a colour is taken (px), and the cloud's own noise (m).
SIGMA_IMAGE, SIGMA_XYZ = 0.3, 0.002


@dataclass(frozen=True, eq=False)
class SurfacePicture:
    """Of a photo reduced to (H, W): ``edges`` (H, W) bool of the cloud's depth and intensity, and ``sigma`` (H, W), the
    position error of colours on the surface, one sigma per axis, metres; ``angle``, the same in radians across the ray.
    NaN where the cloud has nothing; ``sigma`` and ``angle`` are ``None`` where the view's covariance is not known."""

    edges: npt.NDArray[np.bool_]
    depth: FloatArray
    sigma: FloatArray | None
    angle: FloatArray | None

    def figures(self) -> dict[str, dict[str, float]] | None:
        """Median and 95 % quantile over the photo, in mm and in mrad."""
        if self.sigma is None or self.angle is None or not np.isfinite(self.sigma).any():
            return None
        found = {}
        for unit, values in (("mm", 1e3 * self.sigma), ("mrad", 1e3 * self.angle)):
            median, most = np.nanquantile(values, [0.5, 0.95])
            found[unit] = {"median": float(median), "quantile_95": float(most)}
        return found

    def as_dict(self) -> dict[str, Any] | None:
        """For JSON."""
        return self.figures()


def cloud_before(path: str | Path, views: list[View]) -> PointCloud:
    """The points of a file that lie inside any of the views, thinned where they are very many. The file is read twice
    in chunks, so that a cloud larger than the memory does."""
    inside = 0
    with open_cloud(path) as reader:
        for chunk in reader.chunks(positions_only=True):
            inside += int(_inside(chunk.xyz, views).sum())
        step = max(1, -(-inside // MOST_POINTS))
        parts: list[tuple[FloatArray, Any, Any]] = []
        for chunk in reader.chunks():
            rows = np.flatnonzero(_inside(chunk.xyz, views))[::step]
            intensity, rgb = chunk.intensity, chunk.rgb
            parts.append(
                (chunk.xyz[rows], None if intensity is None else intensity[rows], None if rgb is None else rgb[rows])
            )

    def column(k: int) -> Any:
        values = [part[k] for part in parts]
        return None if not values or any(v is None for v in values) else np.concatenate(values)

    xyz = column(0)
    return PointCloud(np.empty((0, 3)) if xyz is None else xyz, column(1), column(2))


def _inside(xyz: FloatArray, views: list[View]) -> npt.NDArray[np.bool_]:
    found = np.zeros(len(xyz), dtype=bool)
    for view in views:
        core = view.core
        xy, _ = _core.project(core, xyz)
        margin = 0.05 * max(core.width, core.height)
        with np.errstate(invalid="ignore"):
            found |= ((xy >= -margin) & (xy < np.array([core.width, core.height]) + margin)).all(1)
    return found


def surface_picture(cloud: PointCloud, view: View) -> SurfacePicture | None:
    """Draws the cloud as the view sees it; ``None`` where no point of it lies in the photo."""
    supported = supported_scale(cloud, view) if len(cloud) else 0.0
    if supported == 0.0:
        return None
    long_side = max(view.core.width, view.core.height)
    scale = min(LONG_SIDE / long_side, max(1.3 * supported, 200 / long_side), 1.0)
    small = with_size(view, max(round(view.core.width * scale), 16), max(round(view.core.height * scale), 16))
    sci = render_sci(cloud, small)
    depth = sci.depth.astype(np.float64)
    edges = _depth_edges(depth) | _intensity_edges(sci)
    sigma = angle = None
    if view.covariance is not None:
        sigma, angle = _sigma(cloud, view, small, depth)
    return SurfacePicture(edges, depth, sigma, angle)


def _depth_edges(depth: FloatArray) -> npt.NDArray[np.bool_]:
    """Where the nearer of two neighbours stands out from the farther one, on the nearer one's side."""
    inverse = np.where(np.isfinite(depth), 1.0 / depth, np.nan)
    edges = np.zeros(depth.shape, dtype=bool)
    for axis in (0, 1):
        a = np.swapaxes(inverse, 0, axis)
        e = np.swapaxes(edges, 0, axis)
        # Against the slope on either side, so that floors seen at a flat angle are no edges.
        step = a[1:] - a[:-1]
        before, after = np.full_like(step, np.nan), np.full_like(step, np.nan)
        before[1:], after[:-1] = step[:-1], step[1:]
        with np.errstate(invalid="ignore"):
            slope = np.fmin(np.abs(before), np.abs(after))
            jump = np.abs(step) - 3 * np.where(np.isfinite(slope), slope, 0) > DEPTH_JUMP * np.fmax(a[1:], a[:-1])
            e[1:] |= jump & (a[1:] > a[:-1])
            e[:-1] |= jump & (a[1:] <= a[:-1])
    return edges


def _intensity_edges(sci: SCI) -> npt.NDArray[np.bool_]:
    """The strongest gradients of the image brought to the pixels' centres, thinned to their ridges."""
    if sci.source is None:
        return np.zeros(sci.depth.shape, dtype=bool)
    image = sci.at_centres
    known = np.isfinite(image)
    grey = np.full(image.shape, np.nan, np.float64)
    grey[known] = _core.rank(np.ascontiguousarray(image[known]))
    # Sobel, over what is known.
    p = np.pad(grey, 1, mode="edge")
    smooth_x = p[:, :-2] + 2 * p[:, 1:-1] + p[:, 2:]
    smooth_y = p[:-2] + 2 * p[1:-1] + p[2:]
    gy, gx = smooth_x[2:] - smooth_x[:-2], smooth_y[:, 2:] - smooth_y[:, :-2]
    size = np.nan_to_num(np.hypot(gx, gy))
    if not (size > 0).any():
        return np.zeros(size.shape, dtype=bool)
    q = np.pad(size, 1)
    across_x = (size >= q[1:-1, :-2]) & (size > q[1:-1, 2:])
    across_y = (size >= q[:-2, 1:-1]) & (size > q[2:, 1:-1])
    ridge = np.where(np.abs(gx) > np.abs(gy), across_x, across_y)
    return np.asarray(ridge & (size > np.quantile(size[known], 1 - STRONGEST)))


def _sigma(cloud: PointCloud, view: View, small: View, depth: FloatArray) -> tuple[FloatArray, FloatArray]:
    height, width = depth.shape
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2).astype(np.float64)
    places = _core.backproject(small.core, pixels, np.ascontiguousarray(depth.ravel()))
    known = np.isfinite(places).all(1)
    buffer = _core.DepthBuffer(small.core)
    buffer.add(cloud.xyz)
    assert view.covariance is not None
    surface = _core.SurfaceSigma(
        view.core, list(view.covariance.parameters), view.covariance.matrix,
        sigma_image=SIGMA_IMAGE, sigma_xyz=SIGMA_XYZ,
    )  # fmt: skip
    sigma, angle = np.full(len(places), np.nan), np.full(len(places), np.nan)
    chosen = np.ascontiguousarray(places[known])
    sigma[known] = surface.at(chosen, planes=buffer.finish().planes())
    # Across the ray, as if the surface faced the camera: an angle does not know slopes.
    angle[known] = surface.at(chosen) / np.linalg.norm(chosen - view.core.centre, axis=1)
    return sigma.reshape(height, width), angle.reshape(height, width)
