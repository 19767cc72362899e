"""Registrations and cameras as JSON files."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ..errors import ColourregError, FileError
from ..model import Camera, ControlPoint, Covariance, FloatArray, Pose, Registration, View
from .atomic import read_bytes, write_text

if TYPE_CHECKING:
    from pydantic import BaseModel

    from .registration_schema import CameraPart, ViewPart

Part = TypeVar("Part", bound="BaseModel")

FORMAT, VERSION = "colourreg-registration", 1

_LIMIT = 1 << 28
#: How far a redundant matrix may be from the camera and pose beside it, relative to its size.
_SAME = 1e-6
#: Statistics of a view that are numbers.
_FIGURES = ("sigma0", "dof", "rms", "rms_x", "rms_y", "rmse")


def read_registration(path: str | Path) -> Registration:
    """Reads a registration; photos and cloud are found relative to the file.

    Enough are ``format``, ``version`` and, for each view, ``image`` with ``camera`` and ``pose`` or with ``dlt``. A
    view that has both is accepted when they say the same; camera and pose are then used.

    Raises:
        FileError: with the place in the file, as ``views[0].camera.params.fx``.
    """
    path = Path(path)
    data = _load(path)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        what = "is a camera, not a registration" if isinstance(data, dict) and "model" in data else "is no registration"
        raise FileError(path, what, f'a registration begins with "format": "{FORMAT}"')
    version = data.get("version")
    if version != VERSION or isinstance(version, bool):
        raise FileError(path, f"has version {version!r}", f"version {VERSION} is known: is there a newer colourreg?")
    from .registration_schema import RegistrationPart

    part = _validated(path, RegistrationPart, data)
    views = []
    for i, view in enumerate(part.views):
        try:
            views.append(_view(path, f"views[{i}]", view, i + 1))
        except ColourregError as error:
            if isinstance(error, FileError):
                raise
            raise FileError(path, f"views[{i}]: {error}", "correct the value") from error
    return Registration(tuple(views), _beside(path, part.cloud), part.crs_wkt)


def write_registration(path: str | Path, registration: Registration) -> None:
    """Writes a registration, atomically; numbers come back as they were, to the last bit. Never over its own files."""
    path = Path(path)
    sources = (registration.cloud, *(view.image for view in registration.views))
    data = {
        "format": FORMAT,
        "version": VERSION,
        "cloud": _relative(path, registration.cloud),
        "crs_wkt": registration.crs_wkt,
        "views": [_view_data(path, view) for view in registration.views],
    }
    write_text(path, _json(data), tuple(source for source in sources if source is not None and source.exists()))


def read_camera(path: str | Path) -> Camera:
    """Reads a camera file: the ``camera`` object of a registration alone."""
    path = Path(path)
    data = _load(path)
    if isinstance(data, dict) and "views" in data:
        raise FileError(
            path, "is a registration, not a camera", "give the camera object of a view as a file of its own"
        )
    if not isinstance(data, dict) or "model" not in data:
        raise FileError(path, "is no camera", "a camera has model, width, height and params")
    from .registration_schema import CameraPart

    try:
        return _camera(_validated(path, CameraPart, data))
    except ColourregError as error:
        if isinstance(error, FileError):
            raise
        raise FileError(path, str(error), "correct the value") from error


def write_camera(path: str | Path, camera: Camera) -> None:
    """Writes a camera file, atomically."""
    write_text(path, _json(_camera_data(camera)))


def _load(path: Path) -> Any:
    def no_constant(name: str) -> None:
        raise FileError(path, f"holds {name}, which JSON does not know", "write null, or a finite number")

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in pairs]
        twice = next((key for key in keys if keys.count(key) > 1), None) if len(set(keys)) < len(keys) else None
        if twice is not None:
            raise FileError(path, f"has the key {twice!r} twice in one object", "delete one of them")
        return dict(pairs)

    raw = read_bytes(path, _LIMIT)
    if not raw.strip():
        raise FileError(path, "is empty", "was the copy interrupted?")
    try:
        return json.loads(raw.decode("utf-8-sig"), parse_constant=no_constant, object_pairs_hook=unique)
    except UnicodeDecodeError as error:
        raise FileError(
            path,
            "is no text, as registrations and cameras are",
            "name a JSON file; one that was written in another encoding has to be saved as UTF-8",
        ) from error
    except json.JSONDecodeError as error:
        if not raw.lstrip(b"\xef\xbb\xbf \t\r\n").startswith((b"{", b"[")):
            raise FileError(path, "is no JSON, as registrations and cameras are", "name such a file") from error
        problem = f"line {error.lineno}, column {error.colno}: {error.msg[:1].lower()}{error.msg[1:]}"
        raise FileError(path, problem, "correct the JSON") from error
    except (RecursionError, ValueError) as error:
        raise FileError(path, f"is not readable JSON: {error}", "correct the JSON") from error


def _validated(path: Path, part: type[Part], data: Any) -> Part:
    from pydantic import ValidationError

    try:
        return part.model_validate_json(json.dumps(data))
    except ValidationError as error:
        first = error.errors()[0]
        place = ""
        for key in first["loc"]:
            place += f"[{key}]" if isinstance(key, int) else f".{key}" if place else str(key)
        message = first["msg"]
        given = first.get("input")
        shown = (
            "" if isinstance(given, (dict, list)) or first["type"] == "missing" else f", not {json.dumps(given)[:60]}"
        )
        where = f"{place}: " if place else ""
        shown = shown if place else ""
        raise FileError(path, f"{where}{message[:1].lower()}{message[1:]}{shown}", "correct the value") from error


def _camera(part: CameraPart) -> Camera:
    camera = Camera(part.model, part.width, part.height, part.params)
    camera.check_plausible()
    return camera


def _view(path: Path, place: str, part: ViewPart, number: int) -> View:
    image = _beside(path, part.image)
    name = part.name or (image.stem if image is not None else f"view-{number}")
    camera = _camera(part.camera) if part.camera is not None else None
    pose = Pose(np.array(part.pose.rotation), np.array(part.pose.translation)) if part.pose is not None else None
    matrix = np.array(part.dlt) if part.dlt is not None else None
    size = part.size
    if camera is not None and pose is not None:
        if matrix is not None and not _agrees(matrix, camera, pose):
            raise FileError(path, f"{place}: dlt and camera with pose contradict each other", "set one of them to null")
        matrix = None
    elif matrix is None:
        raise FileError(path, f"{place}: needs camera and pose, or dlt", "complete the view")
    else:
        size = size or ((camera.width, camera.height) if camera is not None else None)
        camera = pose = None
    covariance = None
    if part.covariance is not None:
        rows = part.covariance.matrix
        n = len(part.covariance.parameters)
        if len(rows) != n or any(len(row) != n for row in rows):
            raise FileError(path, f"{place}.covariance: the matrix is not {n} x {n}", "one row for each parameter")
        covariance = Covariance(tuple(part.covariance.parameters), np.array(rows, dtype=np.float64).reshape(n, n))
        _check_covariance(path, f"{place}.covariance", covariance)
    return View(
        name=name,
        image=image,
        camera=camera,
        pose=pose,
        dlt=matrix,
        dlt_distortion={str(k): v for k, v in (part.dlt_distortion or {}).items()} if matrix is not None else {},
        size=size if matrix is not None else None,
        covariance=covariance,
        method=part.method,
        points=tuple(
            ControlPoint(
                p.name,
                np.array(p.xyz),
                np.array(p.xy),
                p.role,
                None if p.sigma_xyz is None else np.array(p.sigma_xyz),
                None if p.sigma_xy is None else np.array(p.sigma_xy),
                None if p.residual_xy is None else np.array(p.residual_xy),
                p.status,
            )
            for p in part.points or ()
        ),
        statistics=_statistics(path, f"{place}.statistics", part.statistics or {}),
    )


def _check_covariance(path: Path, place: str, covariance: Covariance) -> None:
    names, matrix = covariance.parameters, covariance.matrix
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise FileError(path, f"{place}: names {twice} twice", "each parameter has one row")
    variances = np.diag(matrix)
    if (variances < 0).any():
        i = int(np.argmin(variances))
        raise FileError(
            path, f"{place}: the variance of {names[i]} is negative, {variances[i]:g}", "correct the matrix"
        )
    scale = np.maximum(np.maximum(np.abs(matrix), np.abs(matrix.T)), np.sqrt(np.outer(variances, variances)))
    if (off := np.abs(matrix - matrix.T) > _SAME * scale).any():
        i, j = np.argwhere(off)[0]
        raise FileError(
            path,
            f"{place}: is not symmetric, {names[i]} and {names[j]} have {matrix[i, j]:g} and {matrix[j, i]:g}",
            "correct the matrix",
        )


def _statistics(path: Path, place: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Those that are known (null stands for a figure that does not exist) have the type that they were written with."""
    known: dict[str, tuple[type, ...]] = dict.fromkeys(_FIGURES, (int, float)) | {
        "doubts": (list,),
        "adjustment": (dict,),
    }
    statistics = {key: value for key, value in given.items() if value is not None or key not in known}
    for key, value in statistics.items():
        right = isinstance(value, known.get(key, (object,))) and not (key in _FIGURES and isinstance(value, bool))
        if key == "doubts":
            right = right and all(isinstance(doubt, str) for doubt in value)
        if not right:
            wanted = {"doubts": "a list of sentences", "adjustment": "an object"}.get(key, "a number")
            raise FileError(path, f"{place}.{key}: is not {wanted} but {json.dumps(value)[:60]}", "correct the value")
    return statistics


def _agrees(matrix: FloatArray, camera: Camera, pose: Pose) -> bool:
    """Whether a DLT matrix is, up to its scale, the linear part of camera and pose."""
    if "fx" not in camera.params or camera.model == "OPENCV_FISHEYE":
        return False
    p = camera.params
    k = np.array([[p["fx"], 0, p["cx"]], [0, p["fy"], p["cy"]], [0, 0, 1]])
    whole = k @ np.column_stack([pose.rotation, pose.translation])
    a, b = matrix / np.linalg.norm(matrix), whole / np.linalg.norm(whole)
    return bool(min(np.abs(a - b).max(), np.abs(a + b).max()) < _SAME)


def _camera_data(camera: Camera) -> dict[str, Any]:
    return {"model": camera.model, "width": camera.width, "height": camera.height, "params": dict(camera.params)}


def _view_data(path: Path, view: View) -> dict[str, Any]:
    data: dict[str, Any] = {
        "name": view.name,
        "image": _relative(path, view.image),
        "camera": _camera_data(view.camera) if view.camera is not None else None,
        "pose": None,
        "dlt": None if view.dlt is None else view.dlt,
    }
    if view.pose is not None:
        data["pose"] = {"rotation": view.pose.rotation, "translation": view.pose.translation}
    if view.dlt is not None:
        if view.dlt_distortion:
            data["dlt_distortion"] = dict(view.dlt_distortion)
        if view.image_size is not None:
            data["size"] = list(view.image_size)
    c = view.covariance
    data["covariance"] = None if c is None else {"parameters": list(c.parameters), "matrix": c.matrix}
    data["method"] = view.method
    data["points"] = [_point_data(p) for p in view.points]
    data["statistics"] = dict(view.statistics)
    return data


def _point_data(point: ControlPoint) -> dict[str, Any]:
    data: dict[str, Any] = {"name": point.name, "role": point.role, "xyz": point.xyz, "xy": point.xy}
    for key in ("sigma_xyz", "sigma_xy", "residual_xy", "status"):
        if (value := getattr(point, key)) is not None:
            data[key] = value
    return data


def _plain(value: Any) -> Any:
    """What JSON has words for: arrays become lists, numbers that are not finite become null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(v) for key, v in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return value.as_posix()
    return value


def _json(data: Any) -> str:
    """JSON with a line for each key, and short lists of numbers on one line."""
    return _lines(_plain(data), 0) + "\n"


def _lines(value: Any, depth: int) -> str:
    inner = "  " * (depth + 1)
    if isinstance(value, dict) and value:
        body = (f"{inner}{json.dumps(key, ensure_ascii=False)}: {_lines(v, depth + 1)}" for key, v in value.items())
        return "{\n" + ",\n".join(body) + "\n" + "  " * depth + "}"
    if isinstance(value, list) and any(isinstance(v, (dict, list)) for v in value):
        return "[\n" + ",\n".join(inner + _lines(v, depth + 1) for v in value) + "\n" + "  " * depth + "]"
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _beside(path: Path, name: str | None) -> Path | None:
    """A path that is written relative to the file."""
    if name is None or not name:
        return None
    found = path.parent / name
    if "\\" in name and not found.exists():  # written on Windows
        found = path.parent / name.replace("\\", "/")
    return found


def _relative(path: Path, target: Path | None) -> str | None:
    if target is None:
        return None
    try:
        return Path(os.path.relpath(target.absolute(), path.absolute().parent)).as_posix()
    except ValueError:  # another drive
        return target.absolute().as_posix()
