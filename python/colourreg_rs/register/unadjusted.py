"""A view's covariance, points and statistics where the estimate itself is the last word: nothing was adjusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..model import ControlPoint, Covariance


def covariance_of(result: Any) -> Covariance | None:
    """The estimate's own covariance; ``None`` where there is no redundancy to scale it."""
    matrix = np.asarray(result.covariance)
    return Covariance(tuple(result.parameters), matrix) if np.isfinite(matrix).all() else None


def judged_points(control: Sequence[ControlPoint], result: Any) -> tuple[ControlPoint, ...]:
    """The points with their residuals and with what became of them."""
    judged = []
    for p, status, residual in zip(control, result.status, result.residuals, strict=True):
        known = residual if np.isfinite(residual).all() else None
        judged.append(replace(p, residual_xy=known, status="used" if status == "check" else status))
    return tuple(judged)


def statistics_of(result: Any) -> dict[str, float]:
    """What is known of the fit; figures that do not exist (no redundancy) are left out."""
    figures = {name: float(getattr(result, name)) for name in ("sigma0", "dof", "rms", "rms_x", "rms_y", "rmse")}
    return {name: value for name, value in figures.items() if np.isfinite(value)}
