"""Whether a list of control points can belong to this cloud and this photo."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FileError
from ..io.images import PhotoInfo
from ..model import ControlPoint


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
