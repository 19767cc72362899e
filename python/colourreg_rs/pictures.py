"""Pictures for people: points over a photo, and a cloud as seen from somewhere. For looking at, not for measuring."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from . import _core
from .model import Camera, FloatArray, Pose, View

Image = npt.NDArray[np.uint8]


def as_8_bit(image: npt.NDArray[Any]) -> Image:
    """An 8- or 16-bit image as 8-bit RGB."""
    return np.ascontiguousarray(image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8))


def overlay(photo: npt.NDArray[Any], view: View, xyz: FloatArray, *, points: int = 25_000) -> Image:
    """The photo in grey with points that it sees over it, evenly spread, coloured by depth (near red, far blue)."""
    from matplotlib import colormaps

    # Grey and not too light, so that all hues of the points stand out from it.
    grey = 0.55 * (as_8_bit(photo)[:, :, :3] @ np.array([0.299, 0.587, 0.114]))
    picture = np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)
    height, width = picture.shape[:2]
    buffer = _core.DepthBuffer(view.core)
    buffer.add(np.ascontiguousarray(xyz))
    seen = np.ascontiguousarray(xyz[buffer.finish().visible(np.ascontiguousarray(xyz))])
    if not len(seen):
        return picture
    xy, depth = _core.project(view.core, seen)
    cell = np.sqrt(width * height / points)
    column, row = np.floor((xy + 0.5) / cell).astype(np.int64).T
    _, chosen = np.unique(row * (width + 1) + column, return_index=True)
    xy, depth = xy[chosen], depth[chosen]
    near, far = np.log(np.percentile(depth, [2, 98]))
    shade = 1 - np.clip((np.log(depth) - near) / max(far - near, 1e-6), 0, 1)
    # The map's own ends are dark.
    colours = (colormaps["turbo"](0.1 + 0.8 * shade)[:, :3] * 255).astype(np.uint8)
    _splat(picture, xy, depth, colours, max(1, round(max(width, height) / 700)))
    return picture


def draw_cloud(
    xyz: FloatArray,
    rgb: npt.NDArray[Any],
    view: View,
    *,
    size: int = 2,
    background: tuple[int, int, int] = (24, 26, 30),
) -> Image:
    """The coloured points as the view sees them, near ones over far ones, as squares that about close the surfaces."""
    assert view.image_size is not None
    width, height = view.image_size
    picture = np.empty((height, width, 3), np.uint8)
    picture[:] = background
    xy, depth = _core.project(view.core, np.ascontiguousarray(xyz))
    with np.errstate(invalid="ignore"):
        inside = (xy >= -0.5).all(1) & (xy < np.array([width, height]) - 0.5).all(1)
    if size is None:
        size = int(np.clip(np.ceil(1.5 * np.sqrt(width * height / max(1, inside.sum()))), 1, 6))
    _splat(picture, xy[inside], depth[inside], as_8_bit(rgb[inside]), size)
    return picture


def _splat(picture: Image, xy: FloatArray, depth: FloatArray, colours: Image, size: int) -> None:
    order = np.argsort(-depth, kind="stable")
    column, row = np.rint(xy[order] - (size - 1) / 2).astype(np.int64).T
    for dy in range(size):
        for dx in range(size):
            r, c = np.clip(row + dy, 0, picture.shape[0] - 1), np.clip(column + dx, 0, picture.shape[1] - 1)
            picture[r, c] = colours[order]


def bird_view(xyz: FloatArray, view: View, *, width: int = 1600, height: int = 1000) -> View:
    """A view from above and beside the photo's own place, towards the middle of what the photo shows."""
    xy, _ = _core.project(view.core, np.ascontiguousarray(xyz))
    assert view.image_size is not None
    with np.errstate(invalid="ignore"):
        inside = (xy >= -0.5).all(1) & (xy < np.array(view.image_size) - 0.5).all(1)
    seen = xyz[inside] if inside.any() else xyz
    middle = np.median(seen, axis=0)
    centre = view.core.centre
    away = centre - middle
    distance = float(np.linalg.norm(away))
    side = np.cross([0.0, 0.0, 1.0], away / distance)
    place = middle + away * 1.05 + side * 0.45 * distance + np.array([0.0, 0.0, 0.45 * distance])
    params = {"fx": 1.0 * width, "fy": 1.0 * width, "cx": (width - 1) / 2, "cy": (height - 1) / 2}
    return View("from above", None, Camera("PINHOLE", width, height, params), Pose.looking_at(place, middle))
