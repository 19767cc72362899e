"""Colours a real scene and compares with its truth; estimates its view anew and compares with the given one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benches.real_data.scenes import FloatArray, Scene
from colourreg_rs import (
    ColouriseOptions,
    ControlPoint,
    RegisterOptions,
    View,
    _core,
    colourise_file,
    read_cloud,
    register_photo,
)
from colourreg_rs.io.clouds import open_cloud
from colourreg_rs.io.points import write_points
from colourreg_rs.io.registration import write_camera


@dataclass(frozen=True)
class Coloured:
    """A coloured scene: its file, colours (N, 3) from 0 to 255 and the number of the view of each point, 0 for none."""

    path: Path
    rgb: FloatArray
    source: npt.NDArray[np.uint16]


def colour(scene: Scene, out: Path, options: ColouriseOptions | None = None) -> Coloured:
    """From files to a file, as the command does it."""
    colourise_file(scene.cloud, [scene.registration], out, options=options)
    with open_cloud(out) as reader:
        parts = [(chunk.rgb, chunk.columns()["ColourSource"]) for chunk in reader.chunks()]
    rgb = np.concatenate([colours for colours, _ in parts if colours is not None]) / 256.0
    return Coloured(out, rgb, np.concatenate([source for _, source in parts]))


@dataclass(frozen=True)
class Comparison:
    """Colours against the points' own: difference of a point is the mean over its three channels, grey levels."""

    points: int
    median: float
    mean: float
    worst: float
    correlation: float

    @classmethod
    def of(cls, found: FloatArray, own: FloatArray) -> Comparison:
        """From (N, 3) each."""
        difference = np.abs(found - own).mean(axis=1)
        grey = np.corrcoef(found.mean(axis=1), own.mean(axis=1))[0, 1]
        return cls(
            len(found), float(np.median(difference)), float(difference.mean()), float(difference.max()), float(grey)
        )


@dataclass(frozen=True)
class ViewDifference:
    """Two views of one photo: between their centres, between their directions, and over points in the photo, px."""

    centre: float
    degrees: float
    rms_px: float

    @classmethod
    def of(cls, found: View, given: View, xyz: FloatArray) -> ViewDifference:
        """Over the points that lie in the photo of the given view."""
        xy, _ = _core.project(given.core, np.ascontiguousarray(xyz))
        assert given.image_size is not None
        with np.errstate(invalid="ignore"):
            inside = (xy >= -0.5).all(1) & (xy < np.array(given.image_size) - 0.5).all(1)
        other, _ = _core.project(found.core, np.ascontiguousarray(xyz[inside]))
        turn = found.core.rotation @ np.asarray(given.core.rotation).T
        skew = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        return cls(
            centre=float(np.linalg.norm(found.core.centre - given.core.centre)),
            degrees=float(np.degrees(np.arcsin(min(1.0, np.linalg.norm(skew))))),
            rms_px=float(np.sqrt(((other - xy[inside]) ** 2).sum(axis=1).mean())),
        )


def estimate(
    scene: Scene, view: View, xyz: FloatArray, xy: FloatArray, folder: Path, options: RegisterOptions | None = None
) -> View:
    """The view from control points, from files as the command does it; the camera is known unless the method is dlt."""
    assert view.image is not None and view.camera is not None
    options = options or RegisterOptions()
    table, camera = folder / "points.csv", folder / "camera.json"
    write_points(table, [ControlPoint(f"P{i}", a, b) for i, (a, b) in enumerate(zip(xyz, xy, strict=True))])
    write_camera(camera, view.camera)
    known = None if options.method == "dlt" else camera
    return register_photo(scene.cloud, view.image, points=table, camera=known, options=options).view


def spread(candidates: Sequence[int] | npt.NDArray[np.int64], count: int) -> npt.NDArray[np.int64]:
    """An even choice."""
    chosen = np.asarray(candidates)
    return chosen[np.linspace(0, len(chosen) - 1, count).astype(np.int64)]


def positions(scene: Scene) -> FloatArray:
    """The scene's coordinates."""
    return read_cloud(scene.cloud).xyz
