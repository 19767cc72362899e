"""Reasons not to believe a view that fits its own points: what the points say that took no part in the fit.

A frame with two axes exchanged is a mirror image, and the points of one wall of it fit a view perfectly: the residuals
of the points in use show nothing, those that were thrown out and those that were kept for checking show everything.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..model import ControlPoint, View
from .assessment import CHECK_ALPHA, check_test

#: A check point farther off than this many times the fit's own RMS, and than this share of the photo's diagonal,
#: contradicts the view.
TIMES_RMS, OF_DIAGONAL = 10.0, 0.001

#: Points whose distances from a plane are below this share of their extent lie in it.
FLAT = 0.02

#: From this share of rejected control points on, and with fewer than so many left, the list contradicts itself.
REJECTED, FEW_LEFT = 0.5, 30

#: From this share on, rejected control points may be good ones seen through a lens that is not known.
MANY_REJECTED = 0.25


def contradictions(view: View) -> tuple[str, ...]:
    """Why the view must not be used before somebody has looked at it, each reason with its figures."""
    reasons = []
    control = [p for p in view.points if p.role == "control"]
    rejected = [p for p in control if p.status == "rejected"]
    if control and len(rejected) >= REJECTED * len(control) and len(control) - len(rejected) < FEW_LEFT:
        reasons.append(
            f"{len(rejected)} of {len(control)} control points do not fit the others and were rejected; are the axes in"
            " the right order, and is the frame right-handed?"
        )
    reasons += _mirrored(control)
    checks = [p for p in view.points if p.role == "check"]
    rms = view.statistics.get("rms")
    if view.image_size is not None and rms is not None and len(checks) >= 2:
        limit = max(TIMES_RMS * float(rms), OF_DIAGONAL * float(np.hypot(*view.image_size)))
        off = np.array([np.inf if p.residual_xy is None else np.linalg.norm(p.residual_xy) for p in checks])
        if (off > limit).sum() >= max(2, len(checks) / 2):
            finite = off[np.isfinite(off)]
            typical = f"{np.median(finite):.1f} px" if len(finite) else "so far that the camera does not see them"
            reasons.append(
                f"{int((off > limit).sum())} of {len(checks)} check points are off by more than {limit:.1f} px (the"
                f" middle one by {typical}), while the control points fit to {rms:.2f} px: they do not belong together"
            )
    return tuple(reasons)


def suspicions(view: View, unknown_distortion: bool) -> tuple[str, ...]:
    """What is to be read before the view is used: its points leave it, but not so far that it must be wrong.

    ``unknown_distortion``: the lens was neither calibrated nor are its terms estimated. Taken as free of distortion, it
    makes good points look like blunders, and those that are left fit well.
    """
    found = []
    control = [p for p in view.points if p.role == "control"]
    rejected = sum(p.status == "rejected" for p in control)
    checks = [p for p in view.points if p.role == "check" and p.residual_xy is not None]
    tested = check_test(view, checks, view.statistics.get("adjustment"))
    p_value = tested["joint_p_value"] if tested is not None else None
    if p_value is not None and p_value < CHECK_ALPHA:
        off = np.sqrt(np.mean([np.sum(np.square(p.residual_xy)) for p in checks if p.residual_xy is not None]))
        found.append(
            f"the {len(checks)} check points are off by {off:.2f} px (radial RMS), more than the covariance explains "
            f"(p = {p_value:.2g}): the view is worse than it says"
        )
    if unknown_distortion and (found or (rejected >= 3 and rejected >= MANY_REJECTED * len(control))):
        lost = f"{rejected} of {len(control)} control points were rejected: " if rejected else ""
        found.append(
            f"{lost}a lens whose distortion is not known looks like this: give its calibration with --camera, or "
            "estimate it with --free pose,f,k1"
        )
    return tuple(found)


def _mirrored(control: Sequence[ControlPoint]) -> list[str]:
    """Points of one plane fit the view and its mirror image; where none beside the plane does, it may be the latter."""
    used = np.array([p.xyz for p in control if p.status == "used"])
    if len(used) < 4 or len(used) == len(control):
        return []
    centroid = used.mean(axis=0)
    _, extents, axes = np.linalg.svd(used - centroid, full_matrices=False)
    if extents[2] > FLAT * extents[0]:
        return []
    extent = np.linalg.norm(used - centroid, axis=1).max()
    beside = [p for p in control if abs((p.xyz - centroid) @ axes[2]) > 2 * FLAT * extent]
    if len(beside) < 2 or any(p.status == "used" for p in beside):
        return []
    return [
        f"the {len(used)} control points in use lie in one plane, and all {len(beside)} beside it were rejected: are"
        " the axes in the right order, and is the frame right-handed?"
    ]
