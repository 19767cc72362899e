"""Colours laser scans from photographs and says how accurate the result is."""

from __future__ import annotations

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

__all__ = [
    "Camera",
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
    "Registration",
    "View",
    "__version__",
]
