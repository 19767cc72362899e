"""What a file holds, as a dictionary for machines and as lines for people."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .errors import FileError
from .model import Camera, View

PHOTO_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}


def describe(path: Path) -> dict[str, Any]:
    """What the file at ``path`` is and holds. Raises FileError where it cannot be read."""
    if not path.exists():
        raise FileError(path, "there is no such file")
    suffix = path.suffix.lower()
    if suffix == ".json":
        return {"file": str(path), **_describe_json(path)}
    if suffix == ".csv":
        return {"file": str(path), **_describe_points(path)}
    if suffix in PHOTO_SUFFIXES:
        from .io.images import whole_photo_info

        photo = whole_photo_info(path)
        return {
            "file": str(path),
            "kind": "photo",
            "format": photo.format,
            "width": photo.width,
            "height": photo.height,
            "bits": photo.bits,
            "mode": photo.mode,
            "exif": dict(photo.exif),
        }
    from .io.clouds import open_cloud

    with open_cloud(path) as cloud:
        return {"file": str(path), "kind": "cloud", **cloud.description()}


def _describe_json(path: Path) -> dict[str, Any]:
    from .io.registration import read_camera, read_registration

    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError):
        content = None  # the reader below says what is wrong
    if isinstance(content, dict) and "model" in content and "views" not in content:
        return {"kind": "camera", **_camera(read_camera(path))}
    registration = read_registration(path)
    return {
        "kind": "registration",
        "cloud": str(registration.cloud) if registration.cloud else None,
        "crs_wkt": registration.crs_wkt,
        "views": [_view(view) for view in registration.views],
    }


def _camera(camera: Camera) -> dict[str, Any]:
    field_of_view = None
    if camera.params:
        half = (camera.width / (2 * camera.params["fx"]), camera.height / (2 * camera.params["fy"]))
        if camera.model != "OPENCV_FISHEYE":
            field_of_view = [float(np.degrees(2 * np.arctan(v))) for v in half]
    return {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "params": dict(camera.params),
        "field_of_view_degrees": field_of_view,
    }


def _view(view: View) -> dict[str, Any]:
    described: dict[str, Any] = {"name": view.name, "image": str(view.image) if view.image else None}
    if view.camera is not None and view.pose is not None:
        described["camera"] = _camera(view.camera)
        described["centre"] = view.pose.centre.tolist()
        described["direction"] = view.pose.rotation[2].tolist()
    elif view.dlt is not None:
        described["dlt"] = view.dlt.tolist()
    if view.covariance is not None:
        described["sigmas"] = {name: view.covariance.sigma(name) for name in view.covariance.parameters}
    described["method"] = view.method
    described["control_points"] = sum(p.role == "control" for p in view.points)
    described["check_points"] = sum(p.role == "check" for p in view.points)
    # The tests of every point and what belongs to them are for `evaluate`.
    described["statistics"] = {k: v for k, v in view.statistics.items() if not isinstance(v, Mapping)}
    return described


def _describe_points(path: Path) -> dict[str, Any]:
    from .io.points import read_points

    points = read_points(path)
    xyz, xy = np.stack([p.xyz for p in points]), np.stack([p.xy for p in points])
    return {
        "kind": "points",
        "control": sum(p.role == "control" for p in points),
        "check": sum(p.role == "check" for p in points),
        "object_min": xyz.min(0).tolist(),
        "object_max": xyz.max(0).tolist(),
        "photo_min": xy.min(0).tolist(),
        "photo_max": xy.max(0).tolist(),
    }


def lines(description: Mapping[str, Any]) -> Iterator[str]:
    """The description as indented text; what is unknown is left out."""
    yield from _lines({key: value for key, value in description.items() if key != "file"}, "")


def _lines(content: Mapping[str, Any], indent: str) -> Iterator[str]:
    for key, value in content.items():
        name = key.replace("_", " ")
        if value is None or value in ([], {}):
            continue
        if isinstance(value, Mapping):
            yield f"{indent}{name}:"
            yield from _lines(value, indent + "  ")
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            yield f"{indent}{name}:"
            for item in value:
                rest = list(_lines(item, indent + "    "))
                yield f"{indent}  - {rest[0].strip()}" if rest else f"{indent}  -"
                yield from rest[1:]
        else:
            yield f"{indent}{name}: {_text(value)}"


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}" if abs(value) < 1e5 else f"{value:.4f}"
    if isinstance(value, list):
        return "  ".join(_text(v) for v in value)
    text = str(value)
    return text if len(text) <= 100 else text[:97] + "..."
