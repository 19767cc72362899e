"""What is known of a view before it is estimated: from a calibration, an earlier registration, or EXIF."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import FileError
from ..io.images import PhotoInfo
from ..io.registration import read_camera, read_registration
from ..model import Camera, Pose, View
from .options import RegisterOptions

#: The focal length, in units of the photo's long side, that a photo without EXIF is first taken to have.
ORDINARY_FOCAL = 0.85


@dataclass(frozen=True)
class StartingView:
    """What is known before the estimate.

    ``calibrated``: the camera comes from a calibration or an earlier view, so that only the pose is free unless more is
    asked for. ``origin`` says for people where the camera comes from.
    """

    camera: Camera
    pose: Pose | None
    calibrated: bool
    origin: str

    def view(self, photo: Path) -> View:
        """The view of the photo before anything is estimated; without a pose it stands in the origin."""
        return View(photo.stem, photo, self.camera, self.pose or Pose(np.eye(3), np.zeros(3)))

    def free(self, options: RegisterOptions) -> tuple[str, ...]:
        """What is estimated: what was asked for, else the pose, and the focal length where it is not known."""
        return options.free or (("pose",) if self.calibrated else ("pose", "f"))


def starting_view(photo: Path, info: PhotoInfo, init: Path | None, camera: Path | None) -> StartingView:
    """The camera that a calibration, ``init`` or EXIF tells, in this order, and the pose of ``init`` if there is one.

    Raises:
        FileError: ``init`` has no usable view of the photo, or the camera is of another size than the photo.
    """
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
        if view.image is not None and not named:
            origin += f", where it is that of {view.image.name}"
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
        return StartingView(known, pose, calibrated, origin)
    focal = info.exif.get("focal_px")
    origin = f"focal length {focal:.0f} px from EXIF" if focal else "focal length unknown"
    f = focal or ORDINARY_FOCAL * max(info.width, info.height)
    params = {"fx": f, "fy": f, "cx": (info.width - 1) / 2, "cy": (info.height - 1) / 2}
    return StartingView(Camera("OPENCV", info.width, info.height, params), pose, False, origin)
