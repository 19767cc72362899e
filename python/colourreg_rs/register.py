"""From where a photo was taken, and with what camera: a view from control points.

What is known to begin with comes, in this order, from ``--camera`` (a calibration), from the view of a registration to
start from, from the photo's EXIF, or from nothing at all. What is not known well is estimated with the pose.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from . import _core
from .errors import DegenerateError, FileError, InvalidInputError, NotConvergedError
from .evaluate import ViewEvaluation, evaluate_view, table
from .io.clouds import open_cloud
from .io.images import PhotoInfo, photo_info
from .io.points import read_points
from .io.registration import read_camera, read_registration, write_registration
from .model import DLT_DISTORTION_NAMES, Camera, ControlPoint, Covariance, FloatArray, Pose, Registration, View

#: The focal length, in units of the photo's long side, that a photo without EXIF is first taken to have.
ORDINARY_FOCAL = 0.85


@dataclass(frozen=True)
class RegisterOptions:
    """How a view is estimated. ``free`` of ``None``: the pose, and the focal length where no calibration is given."""

    method: Literal["dlt", "resection", "sci"] = "resection"
    free: tuple[str, ...] | None = None
    priors: tuple[str, ...] = ()
    sigma_xy: float = 0.5
    loss: str | None = None
    distortion: tuple[str, ...] = ()
    dlt_parameters: int = 11
    seed: int = 0


@dataclass(frozen=True)
class RegisterResult:
    """A registration of one view, how well it fits, and every doubt about it."""

    registration: Registration
    evaluation: ViewEvaluation
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    trusted: bool = True
    free: tuple[str, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def view(self) -> View:
        """The estimated view."""
        return self.registration.views[0]

    def save(self, path: str | Path) -> None:
        """Writes the registration, atomically."""
        write_registration(path, self.registration)

    def text(self) -> str:
        """A few lines for people."""
        view = self.view
        s = view.statistics
        lines = [*self.notes, table([self.evaluation])]
        if "sigma0" in s:
            lines.append(f"sigma0 {s['sigma0']:.3f}, {s['dof']:g} degrees of freedom")
        elif "dof" in s:
            lines.append(f"{s['dof']:g} degrees of freedom: nothing checks the fit")
        place = view.core.centre
        lines.append(f"projection centre {place[0]:.4f} {place[1]:.4f} {place[2]:.4f}")
        if view.covariance is not None:
            lines += _sigma_lines(view.covariance)
        if view.camera is not None and view.camera.params:
            lines.append("camera " + "  ".join(f"{k} {v:.6g}" for k, v in view.camera.params.items()))
        lines += [f"{key}: {value}" for key, value in self.facts.items()]
        lines += [f"warning: {warning}" for warning in self.warnings]
        if not self.trusted:
            lines.append("VERDICT: do not use this view before somebody has looked at it (see the warnings)")
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        view = self.view
        return {
            "trusted": self.trusted,
            "warnings": list(self.warnings),
            "notes": list(self.notes),
            "free": list(self.free),
            "method": view.method,
            "centre": view.core.centre.tolist(),
            "rotation": view.core.rotation.tolist(),
            "camera": dict(view.camera.params) if view.camera else None,
            "dlt": view.dlt.tolist() if view.dlt is not None else None,
            "sigmas": {n: view.covariance.sigma(n) for n in view.covariance.parameters} if view.covariance else None,
            "statistics": dict(view.statistics),
            "evaluation": self.evaluation.as_dict(),
            **self.facts,
        }


def _sigma_lines(covariance: Covariance) -> list[str]:
    names = covariance.parameters
    lines = []
    if "cx_world" in names:
        place = [1000 * covariance.sigma(n) for n in ("cx_world", "cy_world", "cz_world") if n in names]
        lines.append("  sigma of the centre " + "  ".join(f"{v:.2f}" for v in place) + " mm")
    if "rx" in names:
        turn = [1000 * covariance.sigma(n) for n in ("rx", "ry", "rz") if n in names]
        lines.append("  sigma of the rotation " + "  ".join(f"{v:.4f}" for v in turn) + " mrad")
    return lines


def with_photo_sizes(registration: Registration, path: Path) -> Registration:
    """The registration with the sizes of photos that DLT views do not state, read from the photos."""
    views = []
    for view in registration.views:
        if view.image_size is None:
            if view.image is None:
                raise FileError(path, f"view {view.name!r} states neither its photo nor its size", "add `size`: [w, h]")
            info = photo_info(view.image)
            view = replace(view, size=(info.width, info.height))
        views.append(view)
    return replace(registration, views=tuple(views))


def register_photo(
    cloud: str | Path,
    photo: str | Path,
    *,
    points: str | Path | None = None,
    init: str | Path | None = None,
    camera: str | Path | None = None,
    options: RegisterOptions | None = None,
) -> RegisterResult:
    """Estimates the view of a photo from control points in the frame of a cloud.

    Raises FileError where a file is unusable, InvalidInputError or DegenerateError where the points cannot determine
    the view.
    """
    options = options or RegisterOptions()
    cloud, photo = Path(cloud), Path(photo)
    info = photo_info(photo)
    if options.method == "sci":
        start = _starting_view(photo, info, Path(init) if init else None, Path(camera) if camera else None)
        return _by_sci(cloud, photo, start, options)
    if points is None:
        raise InvalidInputError(
            f"method {options.method} needs control points: give a table with the columns name,X,Y,Z,x,y with --points"
        )
    points = Path(points)
    control = read_points(points)
    with open_cloud(cloud) as reader:
        crs_wkt = reader.crs_wkt
        warnings = _outside(control, reader, points)
    _check_photo_coordinates(control, info, points)
    start = _starting_view(photo, info, Path(init) if init else None, Path(camera) if camera else None)
    try:
        if options.method == "dlt":
            result = _by_dlt(photo, info, control, options)
        else:
            result = _by_resection(photo, control, start, options)
    except (DegenerateError, InvalidInputError) as error:
        raise FileError(points, str(error)) from error
    registration = Registration((result.view,), cloud, crs_wkt)
    return replace(
        result,
        registration=registration,
        warnings=(*warnings, *result.warnings),
    )


@dataclass(frozen=True)
class _Start:
    """What is known before the estimate."""

    camera: Camera
    pose: Pose | None
    calibrated: bool
    origin: str


def _starting_view(photo: Path, info: PhotoInfo, init: Path | None, camera: Path | None) -> _Start:
    pose, known, calibrated, origin = None, None, False, ""
    if init is not None:
        views = read_registration(init).views
        named = [v for v in views if v.image is not None and v.image.name == photo.name]
        if not named and len(views) > 1:
            raise FileError(init, f"has no view of {photo.name}", "it names " + ", ".join(v.name for v in views))
        view = (named or list(views))[0]
        if view.camera is None:
            raise FileError(init, f"view {view.name!r} is a DLT matrix", "start from a view with camera and pose")
        pose, known, calibrated, origin = view.pose, view.camera, True, f"camera from {init}"
    if camera is not None:
        known, calibrated, origin = read_camera(camera), True, f"camera from {camera}"
    if known is not None:
        if (known.width, known.height) != (info.width, info.height):
            source = camera or init
            assert source is not None
            raise FileError(
                source,
                f"its camera is of {known.width} x {known.height} pixels, {photo} has {info.width} x {info.height}",
                "use the calibration of this photo's own size and orientation",
            )
        return _Start(known, pose, calibrated, origin)
    focal = info.exif.get("focal_px")
    origin = f"focal length {focal:.0f} px from EXIF" if focal else "focal length unknown"
    f = focal or ORDINARY_FOCAL * max(info.width, info.height)
    params = {"fx": f, "fy": f, "cx": (info.width - 1) / 2, "cy": (info.height - 1) / 2}
    return _Start(Camera("OPENCV", info.width, info.height, params), pose, False, origin)


def _outside(control: Sequence[ControlPoint], reader: Any, path: Path) -> tuple[str, ...]:
    """Control points far from the cloud are of another frame: refused; a little outside is worth a warning."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for chunk in reader.chunks(positions_only=True):
        low, high = np.fmin(low, np.fmin.reduce(chunk.xyz)), np.fmax(high, np.fmax.reduce(chunk.xyz))
    xyz = np.stack([p.xyz for p in control])
    size = float(np.linalg.norm(high - low))
    beyond = np.linalg.norm(np.maximum(np.maximum(low - xyz, xyz - high), 0), axis=1)
    worst = int(np.argmax(beyond))
    if beyond[worst] > max(10 * size, 1e3):
        place = ", ".join(f"{v:.2f}" for v in xyz[worst])
        extent = "  ".join(f"{a:.2f}…{b:.2f}" for a, b in zip(low, high, strict=True))
        raise FileError(
            path,
            f"point {control[worst].name} ({place}) lies {beyond[worst]:.0f} m outside the cloud ({extent})",
            "are cloud and points in the same frame, axis order and unit?",
        )
    if beyond[worst] > 0.1 * size:
        return (f"point {control[worst].name} lies {beyond[worst]:.2f} m outside the cloud",)
    return ()


def _check_photo_coordinates(control: Sequence[ControlPoint], info: PhotoInfo, path: Path) -> None:
    xy = np.stack([p.xy for p in control])
    size = np.array([info.width, info.height])
    outside = ((xy < -0.5) | (xy >= size - 0.5)).any(axis=1)
    if outside.any():
        p = control[int(np.argmax(outside))]
        raise FileError(
            path,
            f"point {p.name} at ({p.xy[0]:.1f}, {p.xy[1]:.1f}) lies outside the upright photo of "
            f"{info.width} x {info.height} pixels",
            "were the coordinates measured in a turned or scaled copy?",
        )


def _sigmas(control: Sequence[ControlPoint], fallback: float) -> FloatArray:
    return np.stack([p.sigma_xy if p.sigma_xy is not None else np.full(2, fallback) for p in control])


_PRIOR = re.compile(r"^\s*(\w+)\s*=\s*([^±]+?)\s*(?:±|\+-|\+/-)\s*(\S+)\s*$")


def parse_prior(text: str) -> tuple[str, float, float]:
    """``NAME=VALUE±SIGMA`` to its parts."""
    found = _PRIOR.match(text)
    try:
        if found is None:
            raise ValueError
        return found[1], float(found[2]), float(found[3])
    except ValueError:
        raise InvalidInputError(f"prior {text!r} is not of the form NAME=VALUE±SIGMA, for example fx=3100±5") from None


def _by_resection(
    photo: Path, control: Sequence[ControlPoint], start: _Start, options: RegisterOptions
) -> RegisterResult:
    """Resection: robust against blunders, unless a robust loss was asked for instead."""
    free = options.free or (("pose",) if start.calibrated else ("pose", "f"))
    xyz, xy = np.stack([p.xyz for p in control]), np.stack([p.xy for p in control])
    check = np.array([p.role == "check" for p in control])
    pose = start.pose or Pose(np.eye(3), np.zeros(3))
    given = View(photo.stem, photo, start.camera, pose)
    priors = [parse_prior(text) for text in options.priors]
    common: dict[str, Any] = {
        "free": list(free),
        "sigma_xy": _sigmas(control, options.sigma_xy),
        "priors": priors,
        "check": check,
    }
    if options.loss is not None:
        result = _core.resect(given.core, xyz, xy, loss=options.loss, **common)
    else:
        unknown = not start.calibrated and "focal length unknown" in start.origin
        result = _core.resect_robust(given.core, xyz, xy, seed=options.seed, unknown_focal=unknown, **common)
    core = result.view
    camera = replace(start.camera, params=dict(zip(start.camera.params, core.params.tolist(), strict=True)))
    view = View(
        name=photo.stem,
        image=photo,
        camera=camera,
        pose=Pose(core.rotation, core.translation),
        covariance=_covariance(result),
        method="resection",
        points=_judged(control, result),
        statistics=_statistics(result),
    )
    verdict = result.verdict
    return RegisterResult(
        registration=Registration((view,)),
        evaluation=evaluate_view(view),
        notes=(f"{start.origin}; free: {', '.join(free)}",),
        warnings=tuple(w.message for w in verdict.warnings),
        trusted=verdict.ok,
        free=tuple(free),
        facts={
            "error_in_the_middle_px": round(result.centre_error, 3),
            "error_at_the_border_px": round(result.border_error, 3),
        },
    )


def _by_sci(cloud: Path, photo: Path, start: _Start, options: RegisterOptions) -> RegisterResult:
    """From the approximate view, without control points. A result that cannot be trusted is an error."""
    from .io.clouds import read_cloud
    from .io.images import read_photo
    from .register_sci import SciOptions, register_sci

    if start.pose is None:
        raise InvalidInputError("method sci starts from an approximate view: give a registration with --init")
    free = options.free or ("pose",)
    given = View(photo.stem, photo, start.camera, start.pose)
    priors = tuple(parse_prior(text) for text in options.priors)
    points = read_cloud(cloud)
    found = register_sci(points, read_photo(photo).pixels, given, SciOptions(free=free, priors=priors))
    if not found.trusted:
        raise NotConvergedError(f"no registration that can be trusted: {'; '.join(found.reasons)}")
    last = found.turns[-1]
    return RegisterResult(
        registration=Registration((found.view,), cloud, points.crs_wkt),
        evaluation=evaluate_view(found.view),
        notes=(f"{start.origin}; free: {', '.join(free)}",),
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


def _covariance(result: Any) -> Covariance | None:
    matrix = np.asarray(result.covariance)
    return Covariance(tuple(result.parameters), matrix) if np.isfinite(matrix).all() else None


def _judged(control: Sequence[ControlPoint], result: Any) -> tuple[ControlPoint, ...]:
    """The points with their residuals and with what became of them."""
    judged = []
    for p, status, residual in zip(control, result.status, result.residuals, strict=True):
        known = residual if np.isfinite(residual).all() else None
        judged.append(replace(p, residual_xy=known, status="used" if status == "check" else status))
    return tuple(judged)


def _statistics(result: Any) -> dict[str, float]:
    """What is known of the fit; figures that do not exist (no redundancy) are left out."""
    figures = {name: float(getattr(result, name)) for name in ("sigma0", "dof", "rms", "rms_x", "rms_y", "rmse")}
    return {name: value for name, value in figures.items() if np.isfinite(value)}


def _by_dlt(photo: Path, info: PhotoInfo, control: Sequence[ControlPoint], options: RegisterOptions) -> RegisterResult:
    """Direct Linear Transformation: nothing is known of the camera, and every point is believed."""
    unknown = sorted(set(options.distortion) - set(DLT_DISTORTION_NAMES))
    if unknown:
        raise InvalidInputError(
            f"a DLT has no distortion term {', '.join(unknown)}; it takes {', '.join(DLT_DISTORTION_NAMES)}"
        )
    result = _core.estimate_dlt(
        np.stack([p.xyz for p in control]),
        np.stack([p.xy for p in control]),
        info.width,
        info.height,
        method=options.dlt_parameters,
        distortion=list(options.distortion),
        sigma_xy=_sigmas(control, options.sigma_xy),
        check=np.array([p.role == "check" for p in control]),
    )
    core = result.view
    terms = dict(zip(("fx", "fy", "cx", "cy", *DLT_DISTORTION_NAMES), core.params.tolist(), strict=True))
    view = View(
        name=photo.stem,
        image=photo,
        dlt=result.matrix,
        dlt_distortion={name: terms[name] for name in options.distortion},
        size=(info.width, info.height),
        covariance=_covariance(result),
        method="dlt",
        points=_judged(control, result),
        statistics=_statistics(result),
    )
    parts = Covariance(tuple(result.part_parameters), result.part_covariance)
    figures = {**{name: terms[name] for name in ("fx", "fy", "cx", "cy")}, "skew": core.skew}
    return RegisterResult(
        registration=Registration((view,)),
        evaluation=evaluate_view(view),
        notes=(f"DLT with {options.dlt_parameters} parameters; distortion: {', '.join(options.distortion) or 'none'}",),
        warnings=tuple(w.message for w in result.verdict.warnings),
        trusted=result.verdict.ok,
        free=tuple(result.part_parameters),
        facts={name: f"{value:.2f} ± {parts.sigma(name):.2f}" for name, value in figures.items()},
    )
