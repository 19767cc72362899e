"""Colours laser scans from photographs and says how accurate the result is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ._core import __version__
from .errors import (
    ColourregError,
    DegenerateError,
    FileError,
    InternalError,
    InvalidInputError,
    NotConvergedError,
)
from .model import Camera, ControlPoint, Covariance, PointCloud, Pose, Registration, View

if TYPE_CHECKING:
    from .backproject import BackprojectOptions, backproject_file
    from .colourise import ColouriseOptions, Colouriser, colourise_file
    from .evaluate import evaluate_view
    from .io.clouds import read_cloud, write_cloud
    from .io.images import read_photo
    from .io.points import read_points
    from .io.registration import read_camera, read_registration, write_registration
    from .register import RegisterOptions, register_photo
    from .sci import SCI, draw_points, render_sci

#: The workflow and the files, imported when first used: `import colourreg_rs` stays as quick as numpy's.
_LATER = {
    "SCI": "sci",
    "BackprojectOptions": "backproject",
    "ColouriseOptions": "colourise",
    "Colouriser": "colourise",
    "RegisterOptions": "register",
    "backproject_file": "backproject",
    "colourise_file": "colourise",
    "draw_points": "sci",
    "evaluate_view": "evaluate",
    "read_camera": "io.registration",
    "read_cloud": "io.clouds",
    "read_photo": "io.images",
    "read_points": "io.points",
    "read_registration": "io.registration",
    "register_photo": "register",
    "render_sci": "sci",
    "write_cloud": "io.clouds",
    "write_registration": "io.registration",
}

__all__ = [
    "SCI",
    "BackprojectOptions",
    "Camera",
    "ColouriseOptions",
    "Colouriser",
    "ColourregError",
    "ControlPoint",
    "Covariance",
    "DegenerateError",
    "FileError",
    "InternalError",
    "InvalidInputError",
    "NotConvergedError",
    "PointCloud",
    "Pose",
    "RegisterOptions",
    "Registration",
    "View",
    "__version__",
    "backproject_file",
    "colourise_file",
    "draw_points",
    "evaluate_view",
    "read_camera",
    "read_cloud",
    "read_photo",
    "read_points",
    "read_registration",
    "register_photo",
    "render_sci",
    "write_cloud",
    "write_registration",
]


def __getattr__(name: str) -> Any:
    module = _LATER.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f".{module}", __name__), name)


def __dir__() -> list[str]:
    return sorted(__all__)
