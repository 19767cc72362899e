"""How a view is to be estimated, checked before anything is read."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, get_args

from ..errors import InvalidInputError
from ..model import DLT_DISTORTION_NAMES

Method = Literal["dlt", "resection", "sci"]
METHODS: tuple[Method, ...] = get_args(Method)
#: Pixels, or metres: no measurement is worse; and pixels: none in a photo is better.
LARGEST_SIGMA, SMALLEST_SIGMA = 1e4, 1e-4

LOSSES = ("squares", "huber", "cauchy", "tukey")


#: What to do instead.
_HINT = {
    "distortion": "; distortion terms of a camera are named with --free",
    "free": ", or use the method resection",
    "prior": ", or use the method resection",
    "loss": ", or use the method resection",
}


@dataclass(frozen=True)
class RegisterOptions:
    """How a view is estimated. ``free`` of ``None``: the pose, and the focal length where no calibration is given.

    ``sigma_xy`` (px) and ``sigma_xyz`` (m, each axis) hold where the list of points has none. Without either the sigma
    in the photo is found from the residuals, and the coordinates in space are taken as exact.
    """

    method: Method = "resection"
    free: tuple[str, ...] | None = None
    priors: tuple[str, ...] = ()
    sigma_xy: float | None = None
    sigma_xyz: float | None = None
    loss: str | None = None
    distortion: tuple[str, ...] = ()
    dlt_parameters: int = 11
    seed: int = 0

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InvalidInputError(f"there is no method {self.method!r}: {', '.join(METHODS)}")
        if self.loss is not None and self.loss not in LOSSES:
            raise InvalidInputError(f"there is no loss {self.loss!r}: {', '.join(LOSSES)}")
        if self.free is not None and not self.free:
            raise InvalidInputError("nothing is named that is to be free: name pose, or leave the option out")
        foreign: dict[Method, dict[str, object]] = {
            "dlt": {"free": self.free, "prior": self.priors, "loss": self.loss},
            "resection": {"distortion": self.distortion},
            "sci": {"distortion": self.distortion, "loss": self.loss},
        }
        for name, value in foreign[self.method].items():
            if value:
                raise InvalidInputError(f"--{name} has no part in the method {self.method}: leave it out{_HINT[name]}")
        unknown = [name for name in self.distortion if name not in DLT_DISTORTION_NAMES]
        if unknown:
            known = ", ".join(DLT_DISTORTION_NAMES)
            raise InvalidInputError(f"a DLT has no distortion term {unknown[0]!r}: it takes any of {known}")
        if self.dlt_parameters not in (11, 12):
            raise InvalidInputError(f"a DLT of {self.dlt_parameters} parameters is not possible: 11 or 12")
        for name, value, least in (("sigma", self.sigma_xy, SMALLEST_SIGMA), ("sigma-xyz", self.sigma_xyz, 0.0)):
            if value is not None and not least <= value <= LARGEST_SIGMA:
                raise InvalidInputError(f"--{name} {value:g} is not possible: {least:g} to {LARGEST_SIGMA:g}")
        for text in self.priors:
            parse_prior(text)


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
