"""Assessing a registration's files: points, covariance and, where the cloud is at hand, cloud and photos themselves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FileError, InvalidInputError
from ..evaluate import refuse_points_of_several, table
from ..io.clouds import open_cloud
from ..io.images import read_photo
from ..io.registration import read_registration
from ..model import ControlPoint, Registration, View
from ..photo_sizes import with_photo_sizes
from ..progress import Progress, silent
from .advice import advice, figure, headline, in_all_units
from .assessment import CHECK_ALPHA, ViewAssessment, assess_view, at_depth, next_points_on


def read_registrations(paths: Sequence[Path]) -> tuple[Registration, tuple[Path, ...]]:
    """The views of one or more registrations together, so that photos of one cloud are compared with each other; and
    the file of each view.

    A name that two files use gets its file's before it. Raises FileError where a file cannot be used, is given twice,
    or is in another coordinate system than the first.
    """
    read = [with_photo_sizes(read_registration(path), path) for path in paths]
    files = tuple(path for path, registration in zip(paths, read, strict=True) for _ in registration.views)
    if len(read) == 1:
        return read[0], files
    names = Counter(view.name for registration in read for view in registration.views)
    views: list[View] = []
    stems = Counter(path.stem for path in paths)
    crs: tuple[Path, str] | None = None
    for i, (path, registration) in enumerate(zip(paths, read, strict=True)):
        if path.resolve() in [earlier.resolve() for earlier in paths[:i]]:
            raise FileError(path, "is given twice", "name each registration once")
        if registration.crs_wkt:
            crs = crs or (path, registration.crs_wkt)
            if registration.crs_wkt != crs[1]:
                raise FileError(
                    path,
                    f"is in another coordinate system than {crs[0]}",
                    "evaluate registrations of one frame together",
                )
        label = path.stem if stems[path.stem] == 1 else str(path)
        views += [replace(v, name=f"{label}: {v.name}") if names[v.name] > 1 else v for v in registration.views]
    return replace(read[0], views=tuple(views)), files


def assess_registration(
    registration: Registration,
    files: Sequence[Path],
    points: Sequence[ControlPoint] | None,
    cloud: Path | None,
    *,
    pictures: bool = False,
    progress: Progress = silent,
) -> tuple[tuple[ViewAssessment, ...], list[Any]]:
    """The assessments, and the photos' pixels where ``pictures`` or the cloud need them (else ``None``).

    ``files`` are those of each view's registration. Raises FileError where one cannot be used, and where there is
    nothing at all to evaluate.
    """
    views = registration.views
    refuse_points_of_several(views, points)
    assessed = tuple(_assessed(view, file, points) for view, file in zip(views, files, strict=True))
    blind = [i for i, a in enumerate(assessed) if a.evaluation is None and a.view.covariance is None]
    if blind and cloud is None:
        raise FileError(
            files[blind[0]],
            f"view {views[blind[0]].name!r} has neither points nor a covariance to evaluate it by",
            "give points (name,X,Y,Z,x,y) with --points, or the scan with --cloud",
        )
    photos: list[Any] = [None] * len(views)
    if pictures or cloud is not None:
        for i, view in enumerate(views):
            if view.image is not None and (cloud is not None or view.image.exists()):
                photos[i] = _photo(view.image, view.image_size)
    if cloud is None:
        return assessed, photos
    if any(photo is None for photo in photos):
        file = next(file for file, photo in zip(files, photos, strict=True) if photo is None)
        raise FileError(file, "a view names no photo to compare the cloud with", "give its image, or leave out --cloud")
    from .agreement import agreements
    from .surface_picture import cloud_before, surface_picture

    steps = 2 + len(views)
    progress("evaluating: reading the cloud", 0, steps)
    scan = cloud_before(cloud, list(views))
    if len(scan) == 0:
        with open_cloud(cloud) as reader:
            reader.extent()  # it may have no place at all
        raise FileError(cloud, "none of its points lies in any photo", "check the registration's frame and unit")
    found = []
    for i, a in enumerate(assessed):
        progress("evaluating: surfaces", 1 + i, steps)
        surface = surface_picture(scan, a.view)
        if surface is not None and np.isfinite(surface.depth).any():
            a = at_depth(a, float(np.nanmedian(surface.depth)))
            on_surfaces = next_points_on(a.view, surface.depth, a.adjustment)
            a = a if on_surfaces is None else replace(a, next_points=on_surfaces)
        found.append(replace(a, surface=surface))
    progress("evaluating: comparing cloud and photos", 1 + len(views), steps)
    compared = agreements(scan, views, photos)
    progress("evaluating: done", steps, steps)
    return tuple(replace(a, agreement=tuple(x)) for a, x in zip(found, compared, strict=True)), photos


def _assessed(view: View, file: Path, points: Sequence[ControlPoint] | None) -> ViewAssessment:
    try:
        return assess_view(view, points)
    except InvalidInputError as error:
        raise FileError(file, str(error)) from error


def _photo(path: Path, size: tuple[int, int] | None) -> Any:
    photo = read_photo(path)
    if size is not None and (photo.width, photo.height) != size:
        raise FileError(
            path,
            f"has {photo.width} x {photo.height} pixels, its camera {size[0]} x {size[1]}",
            "use the photo that was registered, not a scaled or turned copy",
        )
    return photo.pixels


def text_of(assessed: Sequence[ViewAssessment]) -> str:
    """Everything in lines of text."""
    lines: list[str] = []
    for a in assessed:
        lines.append(table([a.evaluation]) if a.evaluation else f"view {a.view.name}\n  no points to evaluate it at")
        lines += [f"  {line}" for line in _lines(a)]
    return "\n".join(lines)


def _lines(assessed: ViewAssessment) -> list[str]:
    lines = []
    e, s, a = assessed.evaluation, assessed.view.statistics, assessed.adjustment
    for title, accuracy in (("control", e.control if e else None), ("check", e.check if e else None)):
        if accuracy is not None:
            lines.append(f"{title} points, radial RMS: {in_all_units(assessed, accuracy.rmse)}")
    if a is not None:
        lines += _test_lines(assessed, a, s)
    if assessed.check is not None and assessed.check["joint_p_value"] is not None:
        lines.append(
            f"check points together against the covariance: p = {assessed.check['joint_p_value']:.3g} "
            f"(below {CHECK_ALPHA}: wrong)"
        )
        if assessed.check.get("joint_p_value_of_the_others") is not None:
            lines.append(
                f"  without {', '.join(assessed.check['off'])}, each off by more than chance: "
                f"p = {assessed.check['joint_p_value_of_the_others']:.3g}"
            )
    if assessed.error_map is not None:
        f = assessed.error_map.figures()
        lines.append(
            f"expected error over the photo at {assessed.error_map.depth:.1f} m, one sigma per axis: median "
            f"{f['px']['median']:.2f} px = {figure(f['mm']['median'])} mm = {f['mrad']['median']:.2f} mrad, at worst "
            f"{f['px']['largest']:.2f} px = {figure(f['mm']['largest'])} mm = {f['mrad']['largest']:.2f} mrad"
        )
    colour = assessed.surface.figures() if assessed.surface else None
    if colour is not None:
        mm, mrad = colour["mm"], colour["mrad"]
        lines.append(
            f"ColourSigma on the surfaces: median {figure(mm['median'])} mm = {mrad['median']:.2f} mrad, 95 % below "
            f"{figure(mm['quantile_95'])} mm"
        )
    lines += [x.sentence() for x in assessed.agreement]
    lines += [f"note: {note}" for note in assessed.notes]
    word, sentence = headline(assessed)
    lines.append({"good": "looks right: ", "look": "have a look: ", "bad": "DO NOT RELY ON IT: "}[word] + sentence)
    lines += [f"next: {line}" for line in advice(assessed)]
    return lines


def _test_lines(assessed: ViewAssessment, a: dict[str, Any], s: Any) -> list[str]:
    lines = []
    if "sigma0" in s:
        line = f"sigma0 {s['sigma0']:.3f} with {s['dof']:g} degrees of freedom"
        test = a.get("variance_test")
        if test:
            line += (
                f"; variance factor {s['sigma0'] ** 2:.3f} {'inside' if test['accepted'] else 'OUTSIDE'} "
                f"{test['lower']:.3f}…{test['upper']:.3f} (p = {test['p_value']:.2g}, tested at {test['alpha']:g})"
            )
        else:
            line += f"; no sigma was stated: a photo coordinate has {a['sigma_xy_found']:.2f} px"
        lines.append(line)
    used = [r for r in a["points"] if r["status"] == "used" and r["detectable"] is not None]
    if used:
        worst = max(used, key=lambda r: r["statistic"])
        weakest = max(used, key=lambda r: r["effect"] if r["effect"] is not None else np.inf)
        lines.append(
            f"tests of points at alpha {a['alpha']:g} against {a['critical']:.2f}: largest {worst['statistic']:.2f} "
            f"({worst['name']})"
        )
        effect = "without bound" if weakest["effect"] is None else f"by {weakest['effect']:.2f} px"
        lines.append(
            f"detectable with power {a['power']:g}: blunders of {min(r['detectable'] for r in used):.2f} to "
            f"{max(r['detectable'] for r in used):.2f} px; one that stays unnoticed, in {weakest['name']}, moves the "
            f"picture {effect} at most"
        )
    components = a.get("variance_components")
    if components:
        lines.append(
            f"variance components: photo {components['sigma_xy']:.2f} px, object {1e3 * components['sigma_xyz']:.1f} mm"
        )
    if a["high_correlations"]:
        pairs = ", ".join(f"{x}/{y} {r:.3f}" for x, y, r in a["high_correlations"])
        lines.append(f"correlations above 0.95: {pairs}")
    return lines
