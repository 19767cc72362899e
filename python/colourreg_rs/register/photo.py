"""One photo registered to one cloud, from files: what is read, which method, what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from .. import _core
from ..errors import DegenerateError, FileError, InvalidInputError, NotConvergedError
from ..io.clouds import open_cloud
from ..io.images import whole_photo_info
from ..io.points import read_points
from ..model import Registration
from .control import check_photo_coordinates, off_the_scan, one_pick_twice, outside_cloud
from .dlt import by_dlt
from .options import RegisterOptions, parse_prior
from .resection import by_resection
from .result import RegisterResult
from .sci import by_sci
from .start import starting_view


def register_photo(
    cloud: str | Path,
    photo: str | Path,
    *,
    points: str | Path | None = None,
    init: str | Path | None = None,
    camera: str | Path | None = None,
    options: RegisterOptions | None = None,
) -> RegisterResult:
    """Estimates the view of a photo in the frame of a cloud. Nothing is written: ``save`` of the result does that.

    Args:
        cloud: the laser scan (LAS, LAZ, PLY, PCD).
        photo: JPEG, PNG or TIFF; its view is that of the upright photo.
        points: control and check points (CSV: ``name,X,Y,Z,x,y`` in the cloud's frame and unit, and in pixels); the
            methods ``resection`` and ``dlt`` need them.
        init: a registration whose view of this photo is the start; the method ``sci`` needs one.
        camera: a calibrated camera (JSON), of this photo's size.
        options: the method, what is free, and what the points are worth.

    Returns:
        The view with its statistics. Where ``doubts`` is not empty the view should not be used unseen.

    Raises:
        FileError: a file is unusable, or its points cannot determine the view.
        InvalidInputError: what was asked for does not fit together, such as ``sci`` without ``init``.
        NotConvergedError: ``sci`` found nothing that can be trusted.
    """
    options = options or RegisterOptions()
    cloud, photo = Path(cloud), Path(photo)
    info = whole_photo_info(photo)
    if options.method == "sci":
        start = starting_view(photo, info, Path(init) if init else None, Path(camera) if camera else None)
        return by_sci(cloud, photo, start, options)
    if points is None:
        raise InvalidInputError(
            f"method {options.method} needs control points: give a table with the columns name,X,Y,Z,x,y with --points"
        )
    points = Path(points)
    start = starting_view(photo, info, Path(init) if init else None, Path(camera) if camera else None)
    if options.method == "resection":  # what the points are not to blame for
        priors = [parse_prior(text) for text in options.priors]
        _core.check_parameters(start.view(photo).core, free=list(start.free(options)), priors=priors)
    control = read_points(points)
    with open_cloud(cloud) as reader:
        crs_wkt = reader.crs_wkt
        warnings = (*_unused(options, init, camera), *one_pick_twice(control), *outside_cloud(control, reader, points))
    check_photo_coordinates(control, info, points)
    try:
        if options.method == "dlt":
            result = by_dlt(photo, info, control, options)
        else:
            result = by_resection(photo, control, start, options)
    except (DegenerateError, InvalidInputError) as error:
        raise FileError(points, str(error)) from error
    except NotConvergedError as error:
        remedy = "are the points paired rightly, the axes in order, the frame right-handed?"
        raise FileError(points, str(error), remedy) from error
    with open_cloud(cloud) as reader:
        beside, strange = off_the_scan(control, reader)
    result = replace(result, warnings=(*warnings, *beside, *result.warnings), doubts=(*strange, *result.doubts))
    view = result.view
    if result.doubts:  # whoever uses the file must hear of them
        view = replace(view, statistics={**view.statistics, "doubts": list(result.doubts)})
    registration = Registration((view,), cloud, crs_wkt)
    return replace(result, registration=registration)


def _unused(options: RegisterOptions, *given: str | Path | None) -> tuple[str, ...]:
    """A DLT has a camera of its own: worth a warning where one is given."""
    names = ", ".join(str(path) for path in given if path is not None)
    if options.method != "dlt" or not names:
        return ()
    return (f"method dlt estimates its camera from the points alone, and does not use {names}",)
