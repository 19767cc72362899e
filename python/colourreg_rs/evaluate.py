"""How accurate a registration is at points whose true place is known: in pixels, and in metres at the object."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import _core
from .errors import InvalidInputError
from .model import ControlPoint, FloatArray, Registration, View


@dataclass(frozen=True, eq=False)
class PointError:
    """What a view makes of one point.

    ``residual_xy``: computed minus measured position ``xy``, pixels. ``offset_xyz``: at the depth of the point, the
    place that the measured pixel stands for minus the point's own, world frame, metres; NaN where the view cannot see
    the point.
    """

    name: str
    role: str
    status: str
    residual_xy: FloatArray
    offset_xyz: FloatArray
    depth: float
    xy: FloatArray | None = None


@dataclass(frozen=True)
class Accuracy:
    """RMS figures of a group of points; ``rms`` and ``rmse`` as ``docs/conventions.md`` defines them."""

    n: int
    rms_x: float
    rms_y: float
    rms: float
    rmse: float
    object_rms_x: float
    object_rms_y: float
    object_rms_z: float
    object_rms: float
    object_rmse: float
    worst: str
    worst_px: float

    @classmethod
    def of(cls, errors: Sequence[PointError]) -> Accuracy | None:
        """The figures of these points, ``None`` where there are none."""
        if not errors:
            return None
        v = np.stack([e.residual_xy for e in errors])
        d = np.stack([e.offset_xyz for e in errors])
        n = len(errors)
        square, offset = (v**2).sum(0), (d**2).sum(0)
        lengths = np.hypot(v[:, 0], v[:, 1])
        worst = int(np.argmax(lengths))
        return cls(
            n=n,
            rms_x=float(np.sqrt(square[0] / n)),
            rms_y=float(np.sqrt(square[1] / n)),
            rms=float(np.sqrt(square.sum() / (2 * n))),
            rmse=float(np.sqrt(square.sum() / n)),
            object_rms_x=float(np.sqrt(offset[0] / n)),
            object_rms_y=float(np.sqrt(offset[1] / n)),
            object_rms_z=float(np.sqrt(offset[2] / n)),
            object_rms=float(np.sqrt(offset.sum() / (3 * n))),
            object_rmse=float(np.sqrt(offset.sum() / n)),
            worst=errors[worst].name,
            worst_px=float(lengths[worst]),
        )


#: Entries closer than this in the photo, px, and than this share of the points' extent in space are one pick: programs
#: round.
SAME_PX, SAME_SHARE = 1e-3, 1e-4


def same_picks(points: Sequence[ControlPoint], others: Sequence[ControlPoint]) -> list[int]:
    """For each point the first of the others that is the same pick, under whatever name; -1 where none is."""
    if not points or not others:
        return [-1] * len(points)
    xyz, xy = np.stack([p.xyz for p in others]), np.stack([p.xy for p in others])
    reach = SAME_SHARE * float(np.ptp(xyz, axis=0).max())
    order = np.argsort(xy[:, 0], kind="stable")
    columns = xy[order, 0]
    found = []
    for p in points:
        near = order[slice(*np.searchsorted(columns, [p.xy[0] - SAME_PX, p.xy[0] + SAME_PX]))]
        same = (np.abs(xy[near] - p.xy) <= SAME_PX).all(axis=1) & (np.abs(xyz[near] - p.xyz) <= reach).all(axis=1)
        found.append(int(near[same].min()) if same.any() else -1)
    return found


@dataclass(frozen=True)
class ViewEvaluation:
    """The accuracy of one view: control and check points apart, and points that were left out, with their reason.

    ``known``: points that were given for the evaluation, and are the registration's own, under whatever name.
    """

    view: str
    points: tuple[PointError, ...]
    control: Accuracy | None
    check: Accuracy | None
    unseen: tuple[str, ...]
    rejected: tuple[str, ...]
    known: tuple[str, ...] = ()

    def remarks(self) -> tuple[str, ...]:
        """What is to be said of the points beside their figures."""
        if not self.known:
            return ()
        named = ", ".join(self.known[:8]) + (f" and {len(self.known) - 8} more" if len(self.known) > 8 else "")
        return (
            f"{len(self.known)} of the points given are the registration's own, under these or other names, and stay "
            f"the control and check points that they are there: {named}",
        )

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""

        def group(accuracy: Accuracy | None) -> dict[str, Any] | None:
            return None if accuracy is None else dict(vars(accuracy))

        return {
            "view": self.view,
            "control": group(self.control),
            "check": group(self.check),
            "unseen": list(self.unseen),
            "rejected": list(self.rejected),
            "known": list(self.known),
            "points": [
                {
                    "name": e.name,
                    "role": e.role,
                    "status": e.status,
                    "residual_xy": _numbers(e.residual_xy),
                    "offset_xyz": _numbers(e.offset_xyz),
                    "depth": e.depth if np.isfinite(e.depth) else None,
                }
                for e in self.points
            ],
        }


def _numbers(values: FloatArray) -> list[float] | None:
    return values.tolist() if np.isfinite(values).all() else None


def point_errors(view: View, points: Sequence[ControlPoint]) -> list[PointError]:
    """Residuals and offsets of all points in one view."""
    if not points:
        return []
    xyz = np.stack([p.xyz for p in points])
    measured = np.stack([p.xy for p in points])
    computed, depth = _core.project(view.core, xyz)
    # The place on the measured pixel's ray that lies as deep as the point.
    centre, rays = view.core.centre, _core.unproject(view.core, measured)
    along_axis = view.core.model not in ("OPENCV_FISHEYE", "EQUIRECTANGULAR")
    scale = depth / (rays @ view.core.rotation[2] if along_axis else 1.0)
    offsets = rays * scale[:, None] - (xyz - centre)
    return [
        PointError(
            p.name, p.role, p.status or "used", computed[i] - measured[i], offsets[i], float(depth[i]), measured[i]
        )
        for i, p in enumerate(points)
    ]


def evaluate_view(view: View, points: Sequence[ControlPoint] | None = None) -> ViewEvaluation:
    """The accuracy of a view at its own points, and at others that are given.

    A given point that is one of the view's own (the same pick, under whatever name) keeps its part; every other one is
    a check point, whatever its file says: it took no part.
    """
    together, known = list(view.points), []
    given = tuple(points or ())
    for p, own in zip(given, same_picks(given, view.points), strict=True):
        if own >= 0:
            known.append(p.name)
            continue
        together.append(ControlPoint(p.name, p.xyz, p.xy, "check", p.sigma_xyz, p.sigma_xy))
    if not together:
        raise InvalidInputError(
            f"view {view.name!r} has no points to evaluate it at; give some (name,X,Y,Z,x,y) with --points"
        )
    errors = point_errors(view, together)
    seen = [e for e in errors if np.isfinite(e.residual_xy).all() and np.isfinite(e.offset_xyz).all()]
    used = [e for e in seen if e.status != "rejected"]
    return ViewEvaluation(
        view=view.name,
        points=tuple(errors),
        control=Accuracy.of([e for e in used if e.role == "control"]),
        check=Accuracy.of([e for e in used if e.role == "check"]),
        unseen=tuple(e.name for e in errors if e not in seen),
        rejected=tuple(e.name for e in errors if e.status == "rejected"),
        known=tuple(known),
    )


def refuse_points_of_several(views: Sequence[View], points: Sequence[ControlPoint] | None) -> None:
    """Points are measured in one photo: raises InvalidInputError where they come with more views than one."""
    if points and len(views) > 1:
        raise InvalidInputError(
            f"control and check points belong to one photo, {len(views)} views were given "
            f"({', '.join(view.name for view in views)}); evaluate the one that was measured alone"
        )


def evaluate(registration: Registration, points: Sequence[ControlPoint] | None = None) -> tuple[ViewEvaluation, ...]:
    """:func:`evaluate_view` for every view; given points belong to a registration of one view only."""
    refuse_points_of_several(registration.views, points)
    return tuple(evaluate_view(view, points) for view in registration.views)


def table(evaluations: Iterable[ViewEvaluation]) -> str:
    """The figures as lines of text."""
    lines = []
    for e in evaluations:
        lines.append(f"view {e.view}")
        for title, a in (("control", e.control), ("check", e.check)):
            if a is None:
                continue
            lines.append(
                f"  {title} points ({a.n}): RMS x {a.rms_x:.3f}  y {a.rms_y:.3f}  "
                f"total {a.rms:.3f} (per coordinate)  {a.rmse:.3f} (radial) px; worst {a.worst} {a.worst_px:.3f} px"
            )
            lines.append(
                f"    at the object: RMS X {a.object_rms_x:.4f}  Y {a.object_rms_y:.4f}  Z {a.object_rms_z:.4f}  "
                f"total {a.object_rms:.4f} (per coordinate)  {a.object_rmse:.4f} (radial) m"
            )
        if e.check is None:
            lines.append("  no check points: these figures say how well the estimate fits, not how accurate it is")
        lines += [f"  {remark}" for remark in e.remarks()]
        if e.rejected:
            lines.append(f"  rejected as blunders, not in the figures: {', '.join(e.rejected)}")
        if e.unseen:
            lines.append(f"  not visible in this view, not in the figures: {', '.join(e.unseen)}")
    return "\n".join(lines)
