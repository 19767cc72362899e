"""The statistical end of a registration: photo *and* object coordinates adjusted with their sigmas, and judged.

A robust resection or a DLT gives approximate values and throws out what cannot be right. From there on the
Gauss-Helmert adjustment of the core estimates view and control points together, tests each point, leaves out what fails
and adjusts again. Its covariance is the registration's, and what it says about every point is kept with the view, under
``statistics["adjustment"]``. Sources: Pope 1972; Baarda 1968; Koch 1999.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .. import _core
from ..errors import DegenerateError, NotConvergedError
from ..model import ControlPoint, Covariance, FloatArray

#: Sigma of a photo coordinate, px, that gives the weights their unit where nobody knows it.
NOMINAL_SIGMA = 0.5
#: No photo coordinate is taken as more precise than this, px, where its sigma had to be found from residuals.
LEAST_SIGMA = 0.05
#: Significance and power of the test of a point, and significance of the test of the variance factor.
ALPHA, POWER, ALPHA_VARIANCE = 0.001, 0.80, 0.05

_ROTATION = ("rx", "ry", "rz")


@dataclass(frozen=True, eq=False)
class PointSigmas:
    """Sigmas of points: ``photo`` (N, 2) px and ``space`` (N, 3) m; whether somebody stated them, or the residuals have
    to tell (photo), or the coordinates are taken as exact (space)."""

    photo: FloatArray
    space: FloatArray
    photo_known: bool
    space_known: bool

    @classmethod
    def of(cls, points: Sequence[ControlPoint], sigma_xy: float | None, sigma_xyz: float | None) -> PointSigmas:
        """From the list of points, or from what holds where the list has none."""
        photo = [p.sigma_xy for p in points if p.sigma_xy is not None]
        # Some stated, others not: the others are taken to be as good as the stated ones usually are.
        usual = sigma_xy if sigma_xy is not None else float(np.median(photo)) if photo else NOMINAL_SIGMA
        space = [p.sigma_xyz for p in points if p.sigma_xyz is not None]
        usual_space = sigma_xyz if sigma_xyz is not None else float(np.median(space)) if space else 0.0
        photo_all = np.stack([np.full(2, usual) if p.sigma_xy is None else p.sigma_xy for p in points])
        # Zero says that somebody pointed without any error; no weight can say that.
        return cls(
            np.where(photo_all > 0, photo_all, LEAST_SIGMA),
            np.stack([np.full(3, usual_space) if p.sigma_xyz is None else p.sigma_xyz for p in points]),
            bool(photo) or sigma_xy is not None,
            bool(space) or sigma_xyz is not None,
        )

    def describe(self) -> str:
        """What is taken as known, in a line."""
        photo, space = np.sqrt(np.mean(self.photo**2)), 1000 * np.sqrt(np.mean(self.space**2))
        first = f"photo coordinates {photo:.2f} px" if self.photo_known else "photo coordinates: from the residuals"
        second = f"object coordinates {space:.1f} mm" if self.space_known else "object coordinates: taken as exact"
        return f"sigmas: {first}; {second}"

    @property
    def covariance_xy(self) -> FloatArray:
        """(N, 2, 2)"""
        return np.ascontiguousarray(self.photo[:, :, None] ** 2 * np.eye(2))

    @property
    def covariance_xyz(self) -> FloatArray:
        """(N, 3, 3)"""
        return np.ascontiguousarray(self.space[:, :, None] ** 2 * np.eye(3))

    def seen_from(self, view: _core.View, xyz: FloatArray, rows: Any = slice(None)) -> FloatArray:
        """Covariances (N, 2, 2) of misclosures in the photo: its own, and that of the object as the view sees it."""
        _, by_point, _, _ = _core.project_jacobians(view, xyz)
        by_point = np.where(np.isfinite(by_point), by_point, 0.0)
        return np.ascontiguousarray(
            self.covariance_xy[rows] + np.einsum("nij,njk,nlk->nil", by_point, self.covariance_xyz[rows], by_point)
        )

    def with_photo_from(self, residuals: FloatArray, used: Any, parameters: int, seen: FloatArray) -> PointSigmas:
        """With the photo's sigma found from residuals (N, 2): what the object's noise does not explain."""
        n = int(used.sum())
        freedom = 1.0 - parameters / (2.0 * max(n, 1))
        if freedom <= 0.0:
            return self
        explained = np.trace(seen - self.covariance_xy, axis1=1, axis2=2)[used].sum()
        variance = ((residuals[used] ** 2).sum() / freedom - explained) / (2 * n)
        return replace(self, photo=np.full_like(self.photo, np.sqrt(max(variance, LEAST_SIGMA**2))))


@dataclass(frozen=True, eq=False)
class AdjustedView:
    """What the adjustment made of a view.

    - ``core``, ``parameters``, ``covariance``: the estimate; the covariance is a posteriori.
    - ``points``: all points with residuals (computed minus measured) and what became of them.
    - ``statistics``: plain numbers, as they stand in the registration.
    - ``warnings``: doubts, in words.
    """

    core: _core.View
    parameters: tuple[str, ...]
    covariance: FloatArray
    dlt_covariance: Covariance | None
    points: tuple[ControlPoint, ...]
    statistics: dict[str, Any]
    warnings: tuple[str, ...]


def adjust_control(
    start: _core.View,
    points: Sequence[ControlPoint],
    status: Sequence[str],
    sigmas: PointSigmas,
    free: Sequence[str],
    *,
    priors: Sequence[tuple[str, float, float]] = (),
    dlt: bool = False,
) -> AdjustedView:
    """Adjusts a view from approximate values to the points whose ``status`` is ``used``.

    ``free``: the parameters' names (with ``dlt`` those of the distortion alone). ``priors``: (name, value, sigma); of
    the rotation, a small vector on the left of ``start``'s. Raises DegenerateError and NotConvergedError.
    """
    xyz, xy = np.stack([p.xyz for p in points]), np.stack([p.xy for p in points])
    rows = np.flatnonzero([s == "used" and p.role == "control" for s, p in zip(status, points, strict=True)])
    names = [name for name, _, _ in priors]
    known = (names, [value for _, value, _ in priors], np.diag([sigma**2 for _, _, sigma in priors])) if names else None

    def run(**keywords: Any) -> _core.Adjustment:
        return _core.adjust(
            start, xyz[rows], xy[rows], sigmas.covariance_xyz[rows], sigmas.covariance_xy[rows], list(free),
            dlt=dlt, priors=known, alpha=ALPHA, power=POWER, alpha_variance=ALPHA_VARIANCE, **keywords,
        )  # fmt: skip

    result = run()
    s = result.statistics()
    judged = _judged(result, points, status, rows, s)
    statistics = _statistics(result, points, judged, rows, s, sigmas)
    if sigmas.space_known and (sigmas.space[rows] > 0).any() and s["dof"] > 0:
        try:
            statistics["adjustment"]["variance_components"] = _components(run(variance_components=True), sigmas, rows)
        except (DegenerateError, NotConvergedError) as error:
            statistics["adjustment"]["variance_components_refused"] = str(error)
    dlt_covariance = result.dlt_covariance() if dlt else None
    return AdjustedView(
        core=result.view,
        parameters=tuple(result.names),
        covariance=np.asarray(result.covariance),
        dlt_covariance=Covariance(tuple(dlt_covariance[0]), dlt_covariance[1]) if dlt_covariance else None,
        points=judged,
        statistics=statistics,
        warnings=_warnings(s, sigmas),
    )


def _judged(
    result: _core.Adjustment, points: Sequence[ControlPoint], status: Sequence[str], rows: Any, s: Mapping[str, Any]
) -> tuple[ControlPoint, ...]:
    projected, _ = _core.project(result.view, np.stack([p.xyz for p in points]))
    snooped = {int(rows[i]) for i, _, _ in s["rejected"]}
    judged = []
    for i, (p, was) in enumerate(zip(points, status, strict=True)):
        residual = projected[i] - p.xy
        visible = bool(np.isfinite(residual).all())
        now = "rejected" if i in snooped else "not visible" if not visible else "used" if p.role == "check" else was
        judged.append(replace(p, residual_xy=residual if visible else None, status=now))
    return tuple(judged)


def plain(value: Any) -> Any:
    """As JSON has it: lists, and null for what is not finite."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value


def _statistics(
    result: _core.Adjustment,
    points: Sequence[ControlPoint],
    judged: Sequence[ControlPoint],
    rows: Any,
    s: Mapping[str, Any],
    sigmas: PointSigmas,
) -> dict[str, Any]:
    used = [p for p in judged if p.role == "control" and p.status == "used"]
    v = np.stack([p.residual_xy for p in used if p.residual_xy is not None])
    square, n = (v**2).sum(0), len(v)
    figures: dict[str, Any] = {
        "dof": s["dof"],
        "rms": float(np.sqrt(square.sum() / (2 * n))),
        "rms_x": float(np.sqrt(square[0] / n)),
        "rms_y": float(np.sqrt(square[1] / n)),
        "rmse": float(np.sqrt(square.sum() / n)),
    }
    if s["sigma0"] is not None:
        figures["sigma0"] = s["sigma0"]
    test = s["variance_test"]
    typical = float(np.sqrt(np.mean(sigmas.photo[rows] ** 2)))
    figures["adjustment"] = {
        "sigma_xy_known": sigmas.photo_known,
        "sigma_xyz_known": sigmas.space_known,
        "sigma_xy": typical,
        "sigma_xyz": float(np.sqrt(np.mean(sigmas.space[rows] ** 2))),
        "sigma_xy_found": None if s["sigma0"] is None else typical * s["sigma0"],
        "alpha": ALPHA,
        "power": POWER,
        "critical": plain(s["critical"]),
        "noncentrality": plain(s["noncentrality"]),
        "scale": s["scale"],
        "scale_dof": s["scale_dof"],
        # A sigma that the residuals themselves gave cannot be tested against them.
        "variance_test": None
        if test is None or not sigmas.photo_known
        else {
            "alpha": ALPHA_VARIANCE, "lower": test[0], "upper": test[1], "p_value": test[2], "accepted": bool(test[3]),
        },
        "group_redundancy": dict(zip(("photo", "object", "priors"), plain(s["group_redundancy"]), strict=True)),
        "high_correlations": plain(s["high_correlations"]),
        "smallest_eigenvalue": s["smallest_eigenvalue"],
        "parameters": list(result.names),
        "correlations": plain(s["correlations"]),
        "points": _point_rows(result, points, judged, rows, s, sigmas),
        **_checks(result, judged, sigmas, s),
    }  # fmt: skip
    return figures


def _point_rows(
    result: _core.Adjustment,
    points: Sequence[ControlPoint],
    judged: Sequence[ControlPoint],
    rows: Any,
    s: Mapping[str, Any],
    sigmas: PointSigmas,
) -> list[dict[str, Any]]:
    """What the tests say about each control point that came into the adjustment."""
    # Cov(w) = W Cov(d)⁻¹ W of residuals w and those without the point, d; W is the misclosures' own.
    seen = s["scale"] * sigmas.seen_from(result.view, np.stack([points[i].xyz for i in rows]), rows)
    said = []
    for k, i in enumerate(rows.tolist()):
        said.append(
            {
                "name": points[i].name,
                "status": judged[i].status,
                "redundancy": plain(s["redundancy"][k]),
                "statistic": plain(s["statistic"][k]),
                "p_value": plain(s["p_value"][k]),
                "corrections": plain(s["corrections"][k]),
                "residual_covariance": plain(_of_residual(seen[k], s["deleted_covariance"][k], s["used"][k])),
                "leave_one_out": plain(s["deleted"][k]),
                "leave_one_out_covariance": plain(s["deleted_covariance"][k]),
                "detectable": plain(s["detectable"][k]),
                "detectable_direction": plain(s["detectable_direction"][k]),
                "detectable_observation": plain(s["detectable_observation"][k]),
                "effect": plain(s["effect_on_places"][k]),
                "effect_on_parameters": plain(s["effect_on_parameters"][k]),
            }
        )
    return said


def _of_residual(own: FloatArray, deleted: FloatArray, used: bool) -> FloatArray:
    if not used or not np.isfinite(deleted).all():
        return deleted
    return np.asarray(own @ np.linalg.solve(deleted, own))


def _checks(
    result: _core.Adjustment, judged: Sequence[ControlPoint], sigmas: PointSigmas, s: Mapping[str, Any]
) -> dict[str, Any]:
    """Check points against what the covariance promises."""
    rows = [i for i, p in enumerate(judged) if p.role == "check" and p.residual_xy is not None]
    if not rows:
        return {}
    report = _core.check_points(
        result.view,
        np.stack([judged[i].xyz for i in rows]),
        np.stack([judged[i].xy for i in rows]),
        sigmas.covariance_xyz[rows],
        sigmas.covariance_xy[rows],
        names=list(result.names),
        covariance=np.asarray(result.covariance),
        scale=s["scale"],
        dof=s["scale_dof"],
    )
    return {
        "check_points": [
            {"name": judged[i].name, "statistic": plain(report["statistic"][k]), "p_value": plain(report["p_value"][k])}
            for k, i in enumerate(rows)
        ],
        "check": {"joint_p_value": plain(report["joint_p_value"]), **{k: plain_dict(report[k]) for k in _GROUPS}},
    }


_GROUPS = ("pixels", "object")


def plain_dict(value: Any) -> Any:
    """A group of RMS figures as JSON has it."""
    return {str(k): plain(v) for k, v in value.items()} if isinstance(value, Mapping) else plain(value)


def _components(result: _core.Adjustment, sigmas: PointSigmas, rows: Any) -> dict[str, Any]:
    """How far the stated sigmas of photo and object are from what the residuals say, each by itself."""
    factors, deviations, correlation = result.statistics()["variance_components"]
    return {
        "photo_factor": factors[0],
        "object_factor": factors[1],
        "photo_factor_sigma": deviations[0],
        "object_factor_sigma": deviations[1],
        "correlation": correlation,
        "sigma_xy": float(np.sqrt(factors[0] * np.mean(sigmas.photo[rows] ** 2))),
        "sigma_xyz": float(np.sqrt(factors[1] * np.mean(sigmas.space[rows] ** 2))),
    }


def _warnings(s: Mapping[str, Any], sigmas: PointSigmas) -> tuple[str, ...]:
    found = []
    pairs = sorted(s["high_correlations"], key=lambda p: -abs(p[2]))
    if pairs:
        named = ", ".join(f"{a} and {b} by {r:.3f}" for a, b, r in pairs[:4])
        more = f" and {len(pairs) - 4} more pairs" if len(pairs) > 4 else ""
        found.append(
            f"correlated above 0.95 are {named}{more}: the points hardly tell them apart; their own sigmas say how well"
        )
    test = s["variance_test"]
    if test is not None and sigmas.photo_known and not test[3]:
        more = s["variance_factor"] > 1
        found.append(
            f"sigma0 {s['sigma0']:.2f}: the residuals are {'larger' if more else 'smaller'} than the stated sigmas "
            f"promise (p = {test[2]:.2g}, tested at {ALPHA_VARIANCE}); "
            + ("look for blunders, or for a camera that does not fit" if more else "they may be stated too large")
        )
    return tuple(found)


def rotation_priors(
    priors: Sequence[tuple[str, float, float]], given: FloatArray, estimate: FloatArray
) -> list[tuple[str, float, float]]:
    """Priors with those of the rotation, which count from ``given``, counted from ``estimate`` (3, 3 both)."""
    if not any(name in _ROTATION for name, _, _ in priors):
        return list(priors)
    present = _rotation_vector(estimate @ given.T)
    wanted = present.copy()
    for name, value, _ in priors:
        if name in _ROTATION:
            wanted[_ROTATION.index(name)] = value
    relative = _rotation_vector(_rotation_matrix(wanted) @ _rotation_matrix(present).T)
    return [(n, float(relative[_ROTATION.index(n)]) if n in _ROTATION else v, s) for n, v, s in priors]


def _rotation_matrix(vector: FloatArray) -> FloatArray:
    """Rodrigues."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-12:
        return np.asarray(np.eye(3) + k)
    return np.asarray(np.eye(3) + np.sin(angle) / angle * k + (1 - np.cos(angle)) / angle**2 * (k @ k))


def _rotation_vector(matrix: FloatArray) -> FloatArray:
    """The inverse of :func:`_rotation_matrix`, for turns short of a half one."""
    axis: FloatArray = 0.5 * np.array(
        [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    )
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, 0.5 * (np.trace(matrix) - 1)))
    scale = angle / sine if sine > 1e-12 else 1.0
    return np.asarray(scale * axis)
