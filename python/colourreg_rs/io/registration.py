"""Registrations and cameras as JSON. The format stands in ``docs/formats.md``.

Paths in a file are relative to its folder; in memory they are joined with it. What a reader needs is little: ``format``,
``version`` and, for each view, ``image`` with ``camera`` and ``pose``, or with ``dlt``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..errors import ColourregError, FileError
from ..model import Camera, ControlPoint, Covariance, Pose, Registration, View
from .atomic import read_bytes, write_text

FORMAT, VERSION = "colourreg-registration", 1

#: Bytes: a registration with 100,000 points has a tenth of it.
_LIMIT = 500_000_000

T = TypeVar("T")


@cache
def _schemas() -> tuple[Any, Any]:
    """The models of the two kinds of file; made when first used, since pydantic takes long to import."""
    from typing import Annotated, Literal

    from pydantic import BaseModel, ConfigDict, Field

    Number = Annotated[float, Field(allow_inf_nan=False)]
    Two = Annotated[list[Number], Field(min_length=2, max_length=2)]
    Three = Annotated[list[Number], Field(min_length=3, max_length=3)]
    Four = Annotated[list[Number], Field(min_length=4, max_length=4)]

    class Model(BaseModel):
        # Unknown keys are other programs' business; a known key of the wrong kind is an error.
        model_config = ConfigDict(extra="ignore", strict=False)

    class CameraFile(Model):
        model: str
        width: Annotated[int, Field(gt=0)]
        height: Annotated[int, Field(gt=0)]
        params: dict[str, Number] = {}

    class PoseFile(Model):
        rotation: Annotated[list[Three], Field(min_length=3, max_length=3)]
        translation: Three

    class CovarianceFile(Model):
        parameters: list[str]
        matrix: list[list[Number]]

    class PointFile(Model):
        name: str
        xyz: Three
        xy: Two
        role: Literal["control", "check"] = "control"
        sigma_xyz: Three | None = None
        sigma_xy: Two | None = None
        residual_xy: Two | None = None
        status: str | None = None

    class ViewFile(Model):
        name: str | None = None
        image: str
        camera: CameraFile | None = None
        pose: PoseFile | None = None
        dlt: Annotated[list[Four], Field(min_length=3, max_length=3)] | None = None
        dlt_distortion: dict[str, Number] = {}
        size: Annotated[list[Annotated[int, Field(gt=0)]], Field(min_length=2, max_length=2)] | None = None
        covariance: CovarianceFile | None = None
        method: str | None = None
        points: list[PointFile] = []
        statistics: dict[str, Any] = {}

    class RegistrationFile(Model):
        format: Literal["colourreg-registration"]
        version: int
        cloud: str | None = None
        crs_wkt: str | None = None
        views: Annotated[list[ViewFile], Field(min_length=1)]

    return RegistrationFile, CameraFile


def _refuse_constant(name: str) -> float:
    raise ValueError(f"holds {name}, which is no number in JSON")


def _load(path: Path, schema: Any) -> Any:
    """The file's content, checked against a schema; every fault is a line with the place in the file."""
    from pydantic import ValidationError

    try:
        content = json.loads(read_bytes(path, _LIMIT).decode("utf-8-sig"), parse_constant=_refuse_constant)
    except UnicodeDecodeError as error:
        raise FileError(path, f"is not UTF-8 text (byte {error.start})", "save it as UTF-8") from error
    except json.JSONDecodeError as error:
        raise FileError(path, f"is not JSON: line {error.lineno}, column {error.colno}: {error.msg}") from error
    except (ValueError, RecursionError) as error:
        nested = isinstance(error, RecursionError)
        raise FileError(path, "is nested too deeply" if nested else str(error)) from error
    if schema is _schemas()[0] and isinstance(content, dict):
        if content.get("format") != FORMAT:
            raise FileError(
                path, f"its format is {content.get('format')!r}, not {FORMAT!r}", "is it a registration of colourreg?"
            )
        if content.get("version") != VERSION:
            raise FileError(
                path, f"is of version {content.get('version')!r}, this program reads {VERSION}", "use a newer colourreg"
            )
    try:
        return schema.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the file"
        more = f" (and {error.error_count() - 1} more faults)" if error.error_count() > 1 else ""
        given = "" if first["type"] == "missing" else f", found {str(first['input'])[:60]!r}"
        raise FileError(path, f"{place}: {first['msg'].lower()}{given}{more}") from error


def _built(path: Path, place: str, build: Callable[[], T]) -> T:
    """What ``build`` makes; what the classes of ``model`` refuse gets the file's name and the place."""
    try:
        return build()
    except FileError:
        raise
    except (ColourregError, ValueError, TypeError, OverflowError) as error:
        raise FileError(path, f"{place}: {error}") from error


def _camera(content: Any) -> Camera:
    return Camera(content.model, content.width, content.height, content.params)


def read_camera(path: str | Path) -> Camera:
    """A camera from a file that holds the ``camera`` object alone. Raises FileError."""
    path = Path(path)
    content = _load(path, _schemas()[1])
    return _built(path, "camera", lambda: _camera(content))


def write_camera(path: str | Path, camera: Camera) -> None:
    """Writes the ``camera`` object alone."""
    write_text(path, _dump(_camera_content(camera)))


def read_registration(path: str | Path) -> Registration:
    """A registration; image and cloud paths are joined with the file's folder. Raises FileError."""
    path = Path(path)
    content = _load(path, _schemas()[0])
    views = [_built(path, f"views.{i}", lambda v=view, i=i: _view(path, i, v)) for i, view in enumerate(content.views)]
    cloud = path.parent / content.cloud if content.cloud else None
    return _built(path, "registration", lambda: Registration(tuple(views), cloud, content.crs_wkt))


def _view(path: Path, number: int, v: Any) -> View:
    if v.dlt is not None and (v.camera is not None or v.pose is not None):
        raise FileError(
            path,
            f"views.{number}: has a dlt matrix and a camera or pose as well, which may contradict each other",
            "set one of them to null",
        )
    if v.dlt is None and (v.camera is None or v.pose is None):
        missing = "camera" if v.camera is None else "pose"
        raise FileError(path, f"views.{number}: lacks its {missing}", "give camera and pose, or a dlt matrix")
    covariance = None
    if v.covariance is not None:
        covariance = Covariance(tuple(v.covariance.parameters), np.array(v.covariance.matrix, dtype=np.float64))
    points = tuple(
        ControlPoint(p.name, p.xyz, p.xy, p.role, p.sigma_xyz, p.sigma_xy, p.residual_xy, p.status) for p in v.points
    )
    return View(
        name=v.name or Path(v.image).stem,
        image=path.parent / v.image,
        camera=_camera(v.camera) if v.camera else None,
        pose=Pose(v.pose.rotation, v.pose.translation) if v.pose else None,
        dlt=v.dlt,
        dlt_distortion=v.dlt_distortion,
        size=(v.size[0], v.size[1]) if v.size else None,
        covariance=covariance,
        method=v.method,
        points=points,
        statistics=v.statistics,
    )


def write_registration(path: str | Path, registration: Registration) -> None:
    """Writes a registration, atomically; image and cloud paths become relative to the file where that is possible."""
    path = Path(path)
    content = {
        "format": FORMAT,
        "version": VERSION,
        "cloud": _relative(registration.cloud, path),
        "crs_wkt": registration.crs_wkt,
        "views": [_view_content(view, path) for view in registration.views],
    }
    try:
        text = _dump(content)
    except ValueError as error:
        raise FileError(path, f"cannot be written: a figure is not finite ({error})") from error
    write_text(path, text)


def _dump(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _relative(target: Path | None, path: Path) -> str | None:
    if target is None:
        return None
    try:
        relative = os.path.relpath(target.resolve(), path.resolve().parent)
    except ValueError:  # another drive
        return str(target.resolve())
    return Path(relative).as_posix()


def _camera_content(camera: Camera) -> dict[str, Any]:
    return {"model": camera.model, "width": camera.width, "height": camera.height, "params": dict(camera.params)}


def _view_content(view: View, path: Path) -> dict[str, Any]:
    content: dict[str, Any] = {
        "name": view.name,
        "image": _relative(view.image, path) or view.name,
        "camera": _camera_content(view.camera) if view.camera else None,
        "pose": None,
        "dlt": view.dlt.tolist() if view.dlt is not None else None,
    }
    if view.pose is not None:
        pose = {"rotation": view.pose.rotation.tolist(), "translation": view.pose.translation.tolist()}
        content["pose"] = pose
    if view.dlt_distortion:
        content["dlt_distortion"] = dict(view.dlt_distortion)
    if view.size:
        content["size"] = list(view.size)
    content["covariance"] = None
    if view.covariance is not None:
        content["covariance"] = {
            "parameters": list(view.covariance.parameters),
            "matrix": view.covariance.matrix.tolist(),
        }
    content["method"] = view.method
    content["points"] = [_point_content(p) for p in view.points]
    content["statistics"] = dict(view.statistics)
    return content


def _point_content(p: ControlPoint) -> dict[str, Any]:
    content: dict[str, Any] = {"name": p.name, "role": p.role, "xyz": p.xyz.tolist(), "xy": p.xy.tolist()}
    for name in ("sigma_xyz", "sigma_xy", "residual_xy"):
        value = getattr(p, name)
        if value is not None:
            content[name] = value.tolist()
    if p.status is not None:
        content["status"] = p.status
    return content
