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
from .accuracy.doubts import contradictions
from .accuracy.view_adjustment import AdjustedView, PointSigmas, adjust_control, rotation_priors
from .errors import DegenerateError, FileError, InvalidInputError, NotConvergedError
from .evaluate import ViewEvaluation, evaluate_view, table
from .io.clouds import open_cloud
from .io.images import PhotoInfo, photo_info, whole_photo_info
from .io.points import read_points
from .io.registration import read_camera, read_registration, write_registration
from .model import DLT_DISTORTION_NAMES, Camera, ControlPoint, Covariance, Pose, Registration, View

#: The focal length, in units of the photo's long side, that a photo without EXIF is first taken to have.
ORDINARY_FOCAL = 0.85


@dataclass(frozen=True)
class RegisterOptions:
    """How a view is estimated. ``free`` of ``None``: the pose, and the focal length where no calibration is given.

    ``sigma_xy`` (px) and ``sigma_xyz`` (m, each axis) hold where the list of points has none. Without either the sigma
    in the photo is found from the residuals, and the coordinates in space are taken as exact.
    """

    method: Literal["dlt", "resection", "sci"] = "resection"
    free: tuple[str, ...] | None = None
    priors: tuple[str, ...] = ()
    sigma_xy: float | None = None
    sigma_xyz: float | None = None
    loss: str | None = None
    distortion: tuple[str, ...] = ()
    dlt_parameters: int = 11
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value in (("sigma", self.sigma_xy), ("sigma-xyz", self.sigma_xyz)):
            if value is not None and not (np.isfinite(value) and value >= 0):
                raise InvalidInputError(f"--{name} {value} is not possible: give a positive number")
        for text in self.priors:
            parse_prior(text)


@dataclass(frozen=True)
class RegisterResult:
    """A registration of one view, how well it fits, and every doubt about it."""

    registration: Registration
    evaluation: ViewEvaluation | None
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against using the view. ``doubts`` says what does; ``warnings`` are to be read too."""
        return not self.doubts

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
        lines = [*self.notes]
        if self.evaluation is not None:  # matches with the SCI are no points to be evaluated at
            lines.append(table([self.evaluation]))
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
        lines += [f"DOUBT: {doubt}" for doubt in self.doubts]
        if self.doubts:
            lines.append("VERDICT: do not use this view before somebody has looked at it")
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        view = self.view
        return {
            "trusted": self.trusted,
            "doubts": list(self.doubts),
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
            "evaluation": self.evaluation.as_dict() if self.evaluation is not None else None,
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
    """The registration with the sizes of photos that DLT views do not state, read from the photos.

    Sizes that are stated are those of the photos that are there. Raises FileError.
    """
    views = []
    for view in registration.views:
        if view.image_size is None:
            if view.image is None:
                raise FileError(path, f"view {view.name!r} states neither its photo nor its size", "add `size`: [w, h]")
            info = photo_info(view.image)
            view = replace(view, size=(info.width, info.height))
        elif view.image is not None and view.image.is_file():
            info = photo_info(view.image)
            if view.image_size != (info.width, info.height):
                wanted = "{} x {}".format(*view.image_size)
                raise FileError(
                    view.image,
                    f"has {info.width} x {info.height} pixels, its camera in {path} {wanted}",
                    "use the photo that was registered, not a scaled or turned copy",
                )
        try:
            _ = view.core
        except (DegenerateError, InvalidInputError) as error:
            raise FileError(path, f"view {view.name!r}: {error}") from error
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
    info = whole_photo_info(photo)
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
    except NotConvergedError as error:
        remedy = "are the points paired rightly, the axes in order, the frame right-handed?"
        raise FileError(points, str(error), remedy) from error
    view = result.view
    if result.doubts:  # whoever uses the file must hear of them
        view = replace(view, statistics={**view.statistics, "doubts": list(result.doubts)})
    registration = Registration((view,), cloud, crs_wkt)
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
    told = reader.told_extent() or reader.extent()
    low, high = told.low, told.high
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
    """Resection: robust against blunders and then adjusted, unless a robust loss was asked for instead."""
    free = options.free or (("pose",) if start.calibrated else ("pose", "f"))
    pose = start.pose or Pose(np.eye(3), np.zeros(3))
    given = View(photo.stem, photo, start.camera, pose)
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
        covariance=Covariance(adjusted.parameters, adjusted.covariance) if adjusted else _covariance(rough),
        method="resection",
        points=adjusted.points if adjusted else _judged(control, rough),
        statistics=adjusted.statistics if adjusted else _statistics(rough),
    )
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
    start: _Start,
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


def _by_sci(cloud: Path, photo: Path, start: _Start, options: RegisterOptions) -> RegisterResult:
    """From the approximate view, without control points. A result that cannot be trusted is an error."""
    from .io.clouds import read_cloud
    from .io.images import read_photo
    from .matching.register_sci import SciOptions, register_sci

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
        evaluation=None,
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


#: Where the approximate values of a DLT come from.
_DLT_STARTS = {11: "11 parameters (h34 = 1)", 12: "12 elements (singular vector, ‖h31 h32 h33‖ = 1)"}


def _by_dlt(photo: Path, info: PhotoInfo, control: Sequence[ControlPoint], options: RegisterOptions) -> RegisterResult:
    """Direct Linear Transformation: nothing is known of the camera. Eleven parameters and twelve under a condition are
    the same family of views: they differ in the approximate values, from which both are adjusted."""
    unknown = sorted(set(options.distortion) - set(DLT_DISTORTION_NAMES))
    if unknown:
        raise InvalidInputError(
            f"a DLT has no distortion term {', '.join(unknown)}; it takes {', '.join(DLT_DISTORTION_NAMES)}"
        )
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
        covariance=adjusted.dlt_covariance if adjusted else _covariance(result),
        method="dlt",
        points=adjusted.points if adjusted else _judged(control, result),
        statistics=adjusted.statistics if adjusted else _statistics(result),
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
