"""A view without control points, by matching the photo with the synthetic camera image (SCI)."""

from __future__ import annotations

from pathlib import Path

from .. import _core
from ..errors import InvalidInputError, NotConvergedError
from ..io.clouds import read_cloud
from ..io.images import read_photo
from ..matching.register_sci import SciOptions, register_sci
from ..model import Registration
from .options import RegisterOptions, parse_prior
from .result import RegisterResult
from .start import StartingView

#: A predicted error, px per coordinate, above which the result says what limits it.
WORTH_A_WORD = 0.5

POSE = {"rx", "ry", "rz", "cx_world", "cy_world", "cz_world"}


def by_sci(cloud: Path, photo: Path, start: StartingView, options: RegisterOptions) -> RegisterResult:
    """From the approximate view, without control points. A result that cannot be trusted is an error."""
    if start.pose is None:
        raise InvalidInputError("method sci starts from an approximate view: give a registration with --init")
    free = options.free or ("pose",)
    given = start.view(photo)
    priors = tuple(parse_prior(text) for text in options.priors)
    if not {"pose"} <= {*free} and not {*free} >= POSE:
        raise InvalidInputError(
            "method sci estimates the whole pose: name `pose` with --free, and hold what is known of it by --prior "
            "NAME=VALUE±0"
        )
    _core.check_parameters(given.core, free=list(free), priors=list(priors))
    points = read_cloud(cloud)
    found = register_sci(points, read_photo(photo).pixels, given, SciOptions(free=free, priors=priors))
    if not found.trusted:
        raise NotConvergedError(
            f"{photo}: no registration that can be trusted: {'; '.join(found.reasons)}; start from a nearer view "
            "(--init), or measure control points (--method resection)"
        )
    last = found.turns[-1]
    return RegisterResult(
        registration=Registration((found.view,), cloud, points.crs_wkt),
        evaluation=None,
        notes=(f"{start.origin}; free: {', '.join(free)}",),
        warnings=limits(found.predicted_error, found.statistics["point_spacing_px"]),
        free=free,
        facts={
            "matches_used": found.used,
            "matches_found": last.matched,
            "templates": last.templates,
            "confirmed_share": round(found.confirmed, 3),
            "confirmed_by_chance": round(found.by_chance, 3),
            "predicted_error_px": round(found.predicted_error, 3),
        },
    )


def limits(predicted: float, spacing: float) -> tuple[str, ...]:
    """What is to be said of a view with a predicted error, px per coordinate, from points ``spacing`` px apart."""
    if predicted <= WORTH_A_WORD:
        return ()
    return (
        f"the predicted error over the photo is {predicted:.1f} px per coordinate: points are {spacing:.1f} "
        "px apart there, and an edge along the scan's columns or rows lies anywhere between two of them",
    )
