"""A view from control points by resection, with or without a calibrated camera."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import _core
from ..accuracy.doubts import contradictions, suspicions
from ..accuracy.view_adjustment import AdjustedView, PointSigmas, adjust_control, rotation_priors
from ..errors import DegenerateError, NotConvergedError
from ..evaluate import evaluate_view
from ..model import ControlPoint, Covariance, Pose, Registration, View
from .options import RegisterOptions, parse_prior
from .result import RegisterResult
from .start import StartingView
from .unadjusted import covariance_of, judged_points, statistics_of


def by_resection(
    photo: Path, control: Sequence[ControlPoint], start: StartingView, options: RegisterOptions
) -> RegisterResult:
    """Resection: robust against blunders and then adjusted, unless a robust loss was asked for instead."""
    free, given = start.free(options), start.view(photo)
    priors = [parse_prior(text) for text in options.priors]
    sigmas = PointSigmas.of(control, options.sigma_xy, options.sigma_xyz)
    rough, sigmas = _approximate(given, control, sigmas, start, free, priors, options)
    warnings = tuple(w.message for w in rough.verdict.warnings if not w.fatal)
    doubts = tuple(w.message for w in rough.verdict.warnings if w.fatal)
    errors = rough.centre_error, rough.border_error
    adjusted = None
    if options.loss is None:
        held = {name for name, _, sigma in priors if sigma == 0}
        soft = [prior for prior in priors if prior[0] not in held]
        names = [name for name in rough.parameters if name not in held]
        soft = rotation_priors(soft, given.core.rotation, rough.view.rotation)
        try:
            adjusted = adjust_control(rough.view, control, rough.status, sigmas, names, priors=soft)
        except (DegenerateError, NotConvergedError) as error:
            doubts = (*doubts, f"the points could not be adjusted, so that nothing tests them: {error}")
    if adjusted is not None:
        # What the adjustment says again, and better.
        repeated = {"correlation", "variance_factor"}
        kept = [w.message for w in rough.verdict.warnings if w.code not in repeated and not w.fatal]
        warnings = (*kept, *adjusted.warnings)
        errors = _predicted_errors(adjusted, control)
    core = adjusted.core if adjusted else rough.view
    camera = replace(start.camera, params=dict(zip(start.camera.params, core.params.tolist(), strict=True)))
    view = View(
        name=photo.stem,
        image=photo,
        camera=camera,
        pose=Pose(core.rotation, core.translation),
        covariance=Covariance(adjusted.parameters, adjusted.covariance) if adjusted else covariance_of(rough),
        method="resection",
        points=adjusted.points if adjusted else judged_points(control, rough),
        statistics=adjusted.statistics if adjusted else statistics_of(rough),
    )
    plain = not start.calibrated and not any(name == "distortion" or re.fullmatch(r"[kp]\d", name) for name in free)
    warnings = (*warnings, *suspicions(view, unknown_distortion=plain))
    notes = [f"{start.origin}; free: {', '.join(free)}", sigmas.describe()]
    if options.loss is not None:
        notes[1:] = [_of_loss(options.loss, sigmas)]
    return RegisterResult(
        registration=Registration((view,)),
        evaluation=evaluate_view(view),
        notes=tuple(notes),
        warnings=warnings,
        doubts=(*doubts, *contradictions(view)),
        free=tuple(free),
        facts={"error_in_the_middle_px": round(errors[0], 3), "error_at_the_border_px": round(errors[1], 3)},
    )


def _of_loss(loss: str, sigmas: PointSigmas) -> str:
    """What a robust loss leaves out, said to whoever chose it."""
    ignored = "; the stated sigmas in space take no part" if sigmas.space_known else ""
    return (
        f"robust loss {loss}: all points keep a part, coordinates in space are taken as exact{ignored}; nothing is "
        "adjusted or tested point by point. Leave --loss out to have blunders named, and photo and object adjusted"
    )


def _approximate(
    given: View,
    control: Sequence[ControlPoint],
    sigmas: PointSigmas,
    start: StartingView,
    free: Sequence[str],
    priors: Sequence[tuple[str, float, float]],
    options: RegisterOptions,
) -> tuple[_core.ResectionResult, PointSigmas]:
    """A view and its blunders, judged by the photo's and the object's sigmas together; the sigmas, completed."""
    xyz, xy = np.stack([p.xyz for p in control]), np.stack([p.xy for p in control])
    check = np.array([p.role == "check" for p in control])
    common: dict[str, Any] = {"free": list(free), "priors": list(priors), "check": check}
    known = sigmas.covariance_xy if sigmas.photo_known else None
    if options.loss is not None:
        return _core.resect(given.core, xyz, xy, loss=options.loss, sigma_xy=known, **common), sigmas
    common |= {"seed": options.seed}
    common |= {"unknown_focal": not start.calibrated and "focal length unknown" in start.origin}
    uncertain = bool((sigmas.space > 0).any())
    # How large the object's noise is in the photo shows only from a view: the first one judges by its own residuals.
    rough = _core.resect_robust(given.core, xyz, xy, sigma_xy=None if uncertain else known, **common)
    if uncertain and sigmas.photo_known:
        seen = sigmas.seen_from(rough.view, xyz)
        rough = _core.resect_robust(given.core, xyz, xy, sigma_xy=seen, **common)
    elif uncertain:
        used = np.array([s == "used" for s in rough.status]) & ~check
        seen = sigmas.seen_from(rough.view, xyz)
        sigmas = sigmas.with_photo_from(np.asarray(rough.residuals), used, len(rough.parameters), seen)
    return rough, sigmas


def _predicted_errors(adjusted: AdjustedView, control: Sequence[ControlPoint]) -> tuple[float, float]:
    """What the covariance does at the middle and, at worst, at the border, px per coordinate, at a usual distance."""
    _, depths = _core.project(adjusted.core, np.stack([p.xyz for p in control]))
    depth = float(np.nanmedian(depths))
    grid = _core.predicted_error_map(adjusted.core, list(adjusted.parameters), adjusted.covariance, depth, 3, 3)
    sigma = grid["sigma_px"]
    border = np.delete(sigma.ravel(), 4)
    return float(sigma[1, 1]), float(np.nanmax(border)) if np.isfinite(border).any() else float("nan")
