"""How a view is to be estimated, checked before anything is read."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..errors import InvalidInputError


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
