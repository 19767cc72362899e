"""From where a photo was taken, and with what camera: a view from control points, or from the scan's own intensity.

What is known to begin with comes, in this order, from ``--camera`` (a calibration), from the view of a registration to
start from, from the photo's EXIF, or from nothing at all. What is not known well is estimated with the pose.
"""

from .options import RegisterOptions, parse_prior
from .photo import register_photo
from .result import RegisterResult

__all__ = ["RegisterOptions", "RegisterResult", "parse_prior", "register_photo"]
