"""A view from control points by Direct Linear Transformation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .. import _core
from ..accuracy.doubts import contradictions
from ..accuracy.view_adjustment import PointSigmas, adjust_control
from ..errors import DegenerateError, NotConvergedError
from ..evaluate import evaluate_view
from ..io.images import PhotoInfo
from ..model import DLT_DISTORTION_NAMES, ControlPoint, Covariance, Registration, View
from .options import RegisterOptions
from .result import RegisterResult
from .unadjusted import covariance_of, judged_points, statistics_of

#: Where the approximate values of a DLT come from.
_DLT_STARTS = {11: "11 parameters (h34 = 1)", 12: "12 elements (singular vector, ‖h31 h32 h33‖ = 1)"}


def by_dlt(photo: Path, info: PhotoInfo, control: Sequence[ControlPoint], options: RegisterOptions) -> RegisterResult:
    """Direct Linear Transformation: nothing is known of the camera. Eleven parameters and twelve under a condition are
    the same family of views: they differ in the approximate values, from which both are adjusted."""
    sigmas = PointSigmas.of(control, options.sigma_xy, options.sigma_xyz)
    result = _core.estimate_dlt(
        np.stack([p.xyz for p in control]),
        np.stack([p.xy for p in control]),
        info.width,
        info.height,
        method=options.dlt_parameters,
        distortion=list(options.distortion),
        sigma_xy=sigmas.covariance_xy if sigmas.photo_known else None,
        check=np.array([p.role == "check" for p in control]),
    )
    verdict, adjusted = result.verdict, None
    unadjusted: tuple[str, ...] = ()
    try:
        adjusted = adjust_control(result.view, control, result.status, sigmas, options.distortion, dlt=True)
    except (DegenerateError, NotConvergedError) as error:
        unadjusted = (f"the points could not be adjusted, so that nothing tests them: {error}",)
    if adjusted is not None and any(p.status == "rejected" for p in adjusted.points):
        # The blunders were in what the verdict looked at: what it says of the points in use counts.
        again = [p for p in adjusted.points if p.status != "rejected"]
        sound = _core.estimate_dlt(
            np.stack([p.xyz for p in again]), np.stack([p.xy for p in again]), info.width, info.height,
            distortion=list(options.distortion), check=np.array([p.role == "check" for p in again]),
        )  # fmt: skip
        verdict = sound.verdict
    warnings = tuple(w.message for w in verdict.warnings if not w.fatal)
    if adjusted is not None:
        # Focal length and distance of a DLT always look alike; its own verdict names what matters.
        warnings = (*warnings, *(w for w in adjusted.warnings if "correlated" not in w))
    core = adjusted.core if adjusted else result.view
    matrix = core.matrix() if adjusted else result.matrix
    assert matrix is not None
    terms = dict(zip(("fx", "fy", "cx", "cy", *DLT_DISTORTION_NAMES), core.params.tolist(), strict=True))
    view = View(
        name=photo.stem,
        image=photo,
        dlt=matrix,
        dlt_distortion={name: terms[name] for name in options.distortion},
        size=(info.width, info.height),
        covariance=adjusted.dlt_covariance if adjusted else covariance_of(result),
        method="dlt",
        points=adjusted.points if adjusted else judged_points(control, result),
        statistics=adjusted.statistics if adjusted else statistics_of(result),
    )
    parts = Covariance(tuple(result.part_parameters), result.part_covariance)
    if adjusted:
        parts = Covariance(adjusted.parameters, adjusted.covariance)
    figures = {**{name: terms[name] for name in ("fx", "fy", "cx", "cy")}, "skew": core.skew}
    return RegisterResult(
        registration=Registration((view,)),
        evaluation=evaluate_view(view),
        notes=(
            f"DLT from {_DLT_STARTS[options.dlt_parameters]}, then {'adjusted' if adjusted else 'NOT adjusted'}; "
            f"distortion: {', '.join(options.distortion) or 'none'}",
            sigmas.describe(),
        ),
        warnings=warnings,
        doubts=(*(w.message for w in verdict.warnings if w.fatal), *unadjusted, *contradictions(view)),
        free=tuple(parts.parameters),
        facts={name: f"{value:.2f} ± {parts.sigma(name):.2f}" for name, value in figures.items()},
    )
