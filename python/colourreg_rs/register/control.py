"""Whether a list of control points can belong to this cloud and this photo."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import _core
from ..errors import FileError
from ..evaluate import same_picks
from ..io.images import PhotoInfo
from ..model import ControlPoint, FloatArray
from ..overlap import prefetched

#: A control point lies on what was scanned if the nearest point is no farther than so many spacings of the points
#: there, this share of the control points' own extent, and so many of its sigmas. Twice the first and three times the
#: second is far off: a target's thickness or a sphere's radius, which make points stand off, are not so large.
SPACINGS, OF_EXTENT, SIGMAS = 5.0, 0.01, 4.0
FAR_SPACINGS, FAR_OF_EXTENT = 10.0, 0.03


def outside_cloud(control: Sequence[ControlPoint], reader: Any, path: Path) -> tuple[str, ...]:
    """Control points far from the cloud are of another frame: refused; a little outside is worth a warning."""
    told = reader.told_extent() or reader.extent()
    low, high = told.low, told.high
    xyz = np.stack([p.xyz for p in control])
    size = float(np.linalg.norm(high - low))
    beyond = np.linalg.norm(np.maximum(np.maximum(low - xyz, xyz - high), 0), axis=1)
    worst = int(np.argmax(beyond))
    if beyond[worst] > max(10 * size, 1e3):
        place = ", ".join(f"{v:.2f}" for v in xyz[worst])
        extent = "  ".join(f"{a:.2f}…{b:.2f}" for a, b in zip(low, high, strict=True))
        raise FileError(
            path,
            f"point {control[worst].name} ({place}) lies {beyond[worst]:.0f} m outside the cloud ({extent})",
            "are cloud and points in the same frame, axis order and unit?",
        )
    if beyond[worst] > 0.1 * size:
        return (f"point {control[worst].name} lies {beyond[worst]:.2f} m outside the cloud",)
    return ()


def one_pick_twice(control: Sequence[ControlPoint]) -> tuple[str, ...]:
    """A pick under two names counts twice, and as a control and a check point checks itself: worth a warning, no more,
    as lists made by reconstructions have such points."""
    twice: list[str] = []
    itself: list[str] = []
    for p, first in zip(control, same_picks(control, control), strict=True):
        other = control[first]
        if other is not p:
            (twice if other.role == p.role else itself).append(f"{other.name} and {p.name}")
    said = ((twice, "one pick under two names, which counts twice"), (itself, "a control point that is its own check"))
    return tuple(
        f"{what}: {', '.join(pairs[:5])}" + (f" and {len(pairs) - 5} more" if len(pairs) > 5 else "")
        for pairs, what in said
        if pairs
    )


def off_the_scan(control: Sequence[ControlPoint], reader: Any) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Warnings and doubts about control points that lie on nothing that was scanned.

    Points in another unit, axis order or frame fit among themselves, so that residuals cannot show them; the scan can.
    One point beside it may be a target that stands off, or a wrong one: it is named. If most lie far from it, the list
    is not of this scan. What a shift along the surfaces does, or an exchange that lays walls onto walls, does not show.
    """
    xyz = np.stack([p.xyz for p in control])
    extent = float(np.median(np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)))
    given = [p.sigma_xyz if p.sigma_xyz is not None else np.zeros(3) for p in control]
    sigma = SIGMAS * np.linalg.norm(given, axis=1)
    distance, spacing = _to_the_scan(xyz, np.maximum(OF_EXTENT * extent, sigma), reader)
    beside = distance > np.maximum.reduce([SPACINGS * spacing, np.full(len(xyz), OF_EXTENT * extent), sigma])
    far = distance > np.maximum.reduce([FAR_SPACINGS * spacing, np.full(len(xyz), FAR_OF_EXTENT * extent), sigma])
    if far.sum() > 0.5 * len(control):
        return (), (
            f"{far.sum()} of {len(control)} control points lie far from everything that was scanned (the middle one of "
            f"them {np.median(distance[far]):.3g} m from the nearest point, where points are "
            f"{np.median(spacing[far]):.2g} m apart): are they in the cloud's unit, axis order and frame?",
        )
    if not beside.any():
        return (), ()
    worst = [int(i) for i in np.argsort(-distance) if beside[i]]
    named = ", ".join(f"{control[i].name} ({distance[i]:.3g} m)" for i in worst[:5])
    more = f" and {len(worst) - 5} more" if len(worst) > 5 else ""
    return (
        f"{len(worst)} of {len(control)} points lie beside what was scanned, by the distance to the nearest point: "
        f"{named}{more}; points there are {np.median(spacing[beside]):.2g} m apart",
    ), ()


def _to_the_scan(xyz: FloatArray, enough: FloatArray, reader: Any) -> tuple[FloatArray, FloatArray]:
    """From each place to the nearest point of the scan, and how far points are from each other there.

    The scan is read until all places are near enough; chunk by chunk, coordinates only.
    """
    approach = _core.Approach(np.ascontiguousarray(xyz))
    for chunk in prefetched(reader.chunks(positions_only=True)):
        approach.add(chunk.xyz)
        if (approach.distances() <= enough).all():
            break
    return approach.distances(), approach.spacings()


def check_photo_coordinates(control: Sequence[ControlPoint], info: PhotoInfo, path: Path) -> None:
    """Points outside the photo were measured in another picture: refused."""
    xy = np.stack([p.xy for p in control])
    size = np.array([info.width, info.height])
    outside = ((xy < -0.5) | (xy >= size - 0.5)).any(axis=1)
    if outside.any():
        p = control[int(np.argmax(outside))]
        raise FileError(
            path,
            f"point {p.name} at ({p.xy[0]:.1f}, {p.xy[1]:.1f}) lies outside the upright photo of "
            f"{info.width} x {info.height} pixels",
            "were the coordinates measured in a turned or scaled copy?",
        )
