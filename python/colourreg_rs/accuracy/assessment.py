"""Everything that can be said about the accuracy of a view, gathered for text, JSON and the report.

Residuals and RMS figures, what the adjustment said of each point, what the covariance does over the whole photo, where
the next control point would help most, and, where the cloud is at hand, how far the colours may be off on its surfaces
and how far its synthetic image and the photo really lie apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import _core
from ..errors import DegenerateError, InvalidInputError
from ..evaluate import ViewEvaluation, evaluate_view, same_picks
from ..matching.correspondences import pixels_per_radian
from ..model import ControlPoint, FloatArray, View
from .view_adjustment import NOMINAL_SIGMA, PointSigmas, plain

if TYPE_CHECKING:
    from .agreement import Agreement
    from .surface_picture import SurfacePicture

#: The grid on which the predicted error is looked at, columns and rows.
GRID = (25, 19)
#: Places over the photo, and distances among those of the points, where a next control point could lie.
CANDIDATES, CANDIDATE_DEPTHS = (9, 7), (0.1, 0.5, 0.9)
#: Places over the photo that are looked up on the cloud's surfaces.
ON_SURFACES = (24, 18)
#: The level at which a check point contradicts the view, and all of them together do.
CHECK_ALPHA = 0.001
#: The share of the photo that the cloud has to cover for that.
LEAST_COVER = 0.05
#: How many next control points are named.
NEXT = 3


@dataclass(frozen=True, eq=False)
class ErrorMap:
    """The expected position error over the photo at one ``depth``, one sigma per axis, on a grid of pixels ``xy``
    (R, C, 2): ``pixels``, ``metres`` and ``radians``, each (R, C); NaN where nothing is imaged."""

    depth: float
    xy: FloatArray
    pixels: FloatArray
    metres: FloatArray
    radians: FloatArray

    def figures(self) -> dict[str, dict[str, float]]:
        """Median and largest in px, mm and mrad."""
        units = {"px": self.pixels, "mm": 1e3 * self.metres, "mrad": 1e3 * self.radians}
        return {u: {"median": float(np.nanmedian(v)), "largest": float(np.nanmax(v))} for u, v in units.items()}


@dataclass(frozen=True)
class NextPoint:
    """Where one more control point would help most: its pixel and distance, and the expected error over the photo
    (root mean square and largest, px) before and after."""

    xy: tuple[float, float]
    depth: float
    mean_px: tuple[float, float]
    largest_px: tuple[float, float]

    @property
    def where(self) -> str:
        """In words, for a person who looks at the photo."""
        return f"near x {self.xy[0]:.0f}, y {self.xy[1]:.0f}, about {self.depth:.1f} m away"


@dataclass(frozen=True, eq=False)
class ViewAssessment:
    """All of it for one view. What could not be worked out is ``None``, and ``notes`` say why."""

    view: View
    evaluation: ViewEvaluation | None
    adjustment: dict[str, Any] | None
    check: dict[str, Any] | None
    error_map: ErrorMap | None
    next_points: tuple[NextPoint, ...]
    pixels_per_radian: float
    depth: float
    notes: tuple[str, ...]
    surface: SurfacePicture | None = None
    agreement: tuple[Agreement, ...] = ()

    def millimetres(self, pixels: float) -> float:
        """What so many pixels are at the points' usual distance, mm."""
        return 1e3 * pixels * self.depth / self.pixels_per_radian

    def milliradians(self, pixels: float) -> float:
        """What so many pixels are as an angle."""
        return 1e3 * pixels / self.pixels_per_radian

    def as_dict(self) -> dict[str, Any]:
        """For JSON: the evaluation's own keys, and more beside them."""
        own = self.evaluation.as_dict() if self.evaluation else {"view": self.view.name}
        return own | {
            "units": {"depth_m": plain(self.depth), "pixels_per_radian": self.pixels_per_radian},
            "statistics": {k: plain(v) for k, v in self.view.statistics.items() if k != "adjustment"},
            "adjustment": self.adjustment,
            "check_points": self.check,
            "expected_error": self.error_map.figures() | {"depth_m": self.error_map.depth} if self.error_map else None,
            "next_points": [dict(vars(p)) for p in self.next_points],
            "colour_sigma": self.surface.as_dict() if self.surface else None,
            "agreement": [a.as_dict() for a in self.agreement],
            "notes": list(self.notes),
        }


def assess_view(view: View, points: Sequence[ControlPoint] | None = None) -> ViewAssessment:
    """One view by its points and its covariance."""
    notes: list[str] = []
    evaluation = evaluate_view(view, points) if view.points or points else None
    adjustment = view.statistics.get("adjustment")
    if not isinstance(adjustment, dict):
        adjustment = None
        if view.points:
            notes.append("the registration holds no adjustment: register again for the tests of its points")
    if view.covariance is None:
        notes.append("the registration holds no covariance: how sure the view is over the photo is not known")
    depths = [e.depth for e in evaluation.points if np.isfinite(e.depth)] if evaluation else []
    depth = float(np.median(depths)) if depths else float("nan")
    given = tuple(points or ())
    checks = [p for p, own in zip(given, same_picks(given, view.points), strict=True) if own < 0]
    return ViewAssessment(
        view=view,
        evaluation=evaluation,
        adjustment=adjustment,
        check=check_test(view, [*[p for p in view.points if p.role == "check"], *checks], adjustment),
        error_map=error_map(view, depth) if np.isfinite(depth) else None,
        next_points=next_points(view, depths, adjustment),
        pixels_per_radian=pixels_per_radian(view),
        depth=depth,
        notes=tuple(notes),
    )


def at_depth(assessed: ViewAssessment, depth: float) -> ViewAssessment:
    """The same where the points, if there are any, do not tell the distance, but the cloud does."""
    if np.isfinite(assessed.depth) or not np.isfinite(depth):
        return assessed
    return replace(assessed, depth=depth, error_map=error_map(assessed.view, depth))


def check_test(view: View, points: Sequence[ControlPoint], adjustment: dict[str, Any] | None) -> dict[str, Any] | None:
    """The check points against what the covariance promises: probabilities of differences as large by chance. Where a
    few are off by themselves, and no more than a fifth, the others are judged together again, without them."""
    found = _tested(view, points, adjustment)
    if found is None or not found["off"] or 5 * len(found["off"]) > len(found["points"]):
        return found
    rest = _tested(view, [p for p in points if p.name not in found["off"]], adjustment)
    return found | {"joint_p_value_of_the_others": rest["joint_p_value"] if rest else None}


def _tested(view: View, points: Sequence[ControlPoint], adjustment: dict[str, Any] | None) -> dict[str, Any] | None:
    seen = [p for p in points if np.isfinite(_core.project(view.core, p.xyz[None])[0]).all()]
    if not seen or view.covariance is None:
        return None
    found = (adjustment or {}).get("sigma_xy") or NOMINAL_SIGMA
    space = (adjustment or {}).get("sigma_xyz") or 0.0
    scale, dof = (adjustment or {}).get("scale") or 1.0, (adjustment or {}).get("scale_dof")
    sigmas = PointSigmas.of(seen, found, space)
    report = _core.check_points(
        view.core, np.stack([p.xyz for p in seen]), np.stack([p.xy for p in seen]),
        sigmas.covariance_xyz, sigmas.covariance_xy,
        names=list(view.covariance.parameters), covariance=view.covariance.matrix, scale=scale, dof=dof,
    )  # fmt: skip
    return {
        "points": [
            {"name": p.name, "statistic": plain(report["statistic"][k]), "p_value": plain(report["p_value"][k])}
            for k, p in enumerate(seen)
        ],
        "joint_p_value": plain(report["joint_p_value"]),
        "off": [p.name for k, p in enumerate(seen) if report["p_value"][k] < CHECK_ALPHA],
    }


def error_map(view: View, depth: float) -> ErrorMap | None:
    """What the view's covariance does over the photo; ``None`` where it is not known."""
    if view.covariance is None or not depth > 0:
        return None
    names, matrix = list(view.covariance.parameters), view.covariance.matrix
    grid = _core.predicted_error_map(view.core, names, matrix, depth, *GRID)
    if not np.isfinite(grid["sigma_px"]).any():
        return None
    return ErrorMap(depth, grid["xy"], grid["sigma_px"], grid["sigma_object"], grid["sigma_angle"])


def next_points(view: View, depths: Sequence[float], adjustment: dict[str, Any] | None) -> tuple[NextPoint, ...]:
    """Where more control would help most, one place after the other, if measured as well as the present points.

    Candidates and the places whose error counts lie all over the photo at distances that the points have.
    """
    if view.covariance is None or not depths:
        return ()
    pixels = _spread_pixels(view, CANDIDATES)
    levels = np.quantile(depths, CANDIDATE_DEPTHS)
    distance = np.repeat(levels, len(pixels))
    targets = _core.backproject(view.core, pixels, np.full(len(pixels), levels[len(levels) // 2]))
    return _best_of(view, np.tile(pixels, (len(levels), 1)), distance, targets, adjustment)


def next_points_on(view: View, depth: FloatArray, adjustment: dict[str, Any] | None) -> tuple[NextPoint, ...] | None:
    """The same on the cloud's own surfaces, as a picture of depths (H, W) of the reduced photo has them; ``None`` where
    the cloud covers too little of the photo."""
    if view.covariance is None:
        return None
    height, width = depth.shape
    pixels = _spread_pixels(view, ON_SURFACES)
    column = ((pixels[:, 0] + 0.5) / view.core.width * width).astype(int)
    row = ((pixels[:, 1] + 0.5) / view.core.height * height).astype(int)
    distance = depth[row, column]
    if np.isfinite(distance).mean() < LEAST_COVER:
        return None
    return _best_of(view, pixels, distance, _core.backproject(view.core, pixels, distance), adjustment)


def _spread_pixels(view: View, grid: tuple[int, int]) -> FloatArray:
    columns, rows = grid
    x = (np.arange(columns) + 0.5) / columns * 0.96 + 0.02
    y = (np.arange(rows) + 0.5) / rows * 0.96 + 0.02
    places = np.meshgrid(x * view.core.width - 0.5, y * view.core.height - 0.5)
    return np.ascontiguousarray(np.stack(places, -1).reshape(-1, 2))


def _best_of(
    view: View, pixels: FloatArray, distance: FloatArray, targets: FloatArray, adjustment: dict[str, Any] | None
) -> tuple[NextPoint, ...]:
    assert view.covariance is not None
    core = view.core
    places = _core.backproject(core, np.ascontiguousarray(pixels), np.ascontiguousarray(distance))
    ok = np.isfinite(places).all(1)
    places, distance = np.ascontiguousarray(places[ok]), distance[ok]
    targets = np.ascontiguousarray(targets[np.isfinite(targets).all(1)])
    if not len(places) or not len(targets):
        return ()
    a = adjustment or {}
    photo = a.get("sigma_xy_found") or a.get("sigma_xy") or NOMINAL_SIGMA
    space = (a.get("sigma_xyz") or 0.0) * np.sqrt(a.get("scale") or 1.0)
    n = len(places)
    try:
        found = _core.next_points(
            core, list(view.covariance.parameters), view.covariance.matrix, places,
            np.tile(np.eye(3) * space**2, (n, 1, 1)), np.tile(np.eye(2) * photo**2, (n, 1, 1)), targets,
            criterion="mean", count=NEXT,
        )  # fmt: skip
    except (DegenerateError, InvalidInputError):
        return ()
    said: list[NextPoint] = []
    for k, i in enumerate(found["candidate"]):
        if i in found["candidate"][:k]:
            break  # to measure there again is no new place
        said.append(
            NextPoint(
                (float(found["xy"][k][0]), float(found["xy"][k][1])),
                float(distance[i]),
                (float(found["mean_px"][k][0]), float(found["mean_px"][k][1])),
                (float(found["largest_px"][k][0]), float(found["largest_px"][k][1])),
            )
        )
    return tuple(said)
