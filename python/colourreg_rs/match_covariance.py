"""The covariance of a view estimated from matches that are not independent.

Neighbouring templates overlap and see the same sill, shadow and SCI; all of them share what the SCI gets wrong
everywhere. Taken as independent, a thousand matches promise a tenth of the error that they leave. So, after the robust
fit:

- the sandwich ``H⁻¹ G H⁻¹``, whose filling ``G`` sums the products of the matches' gradients *with those of their
  neighbours*, weighted by a Gaussian of their distance in the photo (Conley 1999), and is raised for the number of
  parameters that the fit has taken from so many independent places;
- and an error common to all matches, a shift of the whole SCI by a share of its pixel, which no residual shows.

How well this holds is measured: see ``tests/python/test_register_sci.py``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from . import _core
from .model import Covariance, FloatArray, View

#: Of Tukey's biweight in two dimensions, as in the resection.
TUKEY = 5.123

#: The distance over which matches err together, as one sigma of a Gaussian and a share of the photo's long side.
CORRELATION_LENGTH = 0.06

#: The error common to all matches, px of the SCI, one sigma in x and in y.
COMMON = 0.06

_POSE = ("rx", "ry", "rz", "cx_world", "cy_world", "cz_world")


def design(view: View, names: Sequence[str], xyz: FloatArray) -> FloatArray:
    """Derivatives of pixels (N, 2, U) by the named parameters, as covariances count them; NaN where not visible."""
    _, _, pose, params = _core.project_jacobians(view.core, xyz)
    camera = view.camera
    assert camera is not None
    order = list(camera.params)

    def column(name: str) -> FloatArray:
        if name in _POSE:
            return pose[:, :, _POSE.index(name)]
        if name in ("f", "aspect"):
            fx, fy = (params[:, :, order.index(n)] for n in ("fx", "fy"))
            if name == "aspect":
                return fy * camera.params["fx"]
            return fx + fy * (camera.params["fy"] / camera.params["fx"])
        return params[:, :, order.index(name)]

    return np.stack([column(name) for name in names], axis=2)


def whitened(view: View, xyz: FloatArray, xy: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Misclosures (N, 2), measured minus projected, in stated sigmas, and the factors (N, 2, 2) that made them so."""
    projected, _ = _core.project(view.core, xyz)
    factors = np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1)
    return np.einsum("nij,nj->ni", factors, xy - projected), factors


def tukey_weights(view: View, xyz: FloatArray, xy: FloatArray, covariance: FloatArray) -> FloatArray:
    """The weights (N,) that a robust fit gives its matches at ``view``; 0 took no part."""
    residual, _ = whitened(view, xyz, xy, covariance)
    s = (residual**2).sum(1) / TUKEY**2
    return np.where(s < 1, (1 - np.where(s < 1, s, 1.0)) ** 2, 0.0)


def match_covariance(
    view: View,
    names: Sequence[str],
    xyz: FloatArray,
    xy: FloatArray,
    covariance: FloatArray,
    pixel: float,
) -> Covariance | None:
    """The covariance of the named parameters of a view fitted to matches; ``None`` where they do not determine them.

    Args:
        view: the fitted view.
        names: the free parameters, in order.
        xyz: (N, 3) points. xy: (N, 2) matches, px.
        covariance: (N, 2, 2) stated, px², in units of which the fit was robust.
        pixel: the size of the SCI's pixel in the photo, px.
    """
    residual, factors = whitened(view, xyz, xy, covariance)
    s = (residual**2).sum(1) / TUKEY**2
    used = np.flatnonzero(s < 1)
    residual, factors, s, xy = residual[used], factors[used], s[used], xy[used]
    weight = (1 - s) ** 2
    rows = factors @ design(view, names, np.ascontiguousarray(xyz[used]))
    if not np.isfinite(rows).all() or len(used) < len(names):
        return None
    # Columns of length 1 for the numbers' sake.
    size = np.sqrt((rows**2).sum((0, 1)))
    if not (size > 0).all():
        return None
    rows = rows / size
    # Second derivative of the loss: w I + 2 w' r rᵀ, which is less than w where the loss bends back.
    bend = -4 * (1 - s) / TUKEY**2
    inner = weight[:, None, None] * np.eye(2) + bend[:, None, None] * residual[:, :, None] * residual[:, None, :]
    curvature = np.einsum("nki,nkl,nlj->ij", rows, inner, rows)
    eigenvalues = np.linalg.eigvalsh(curvature)
    if eigenvalues[0] <= 1e-12 * eigenvalues[-1] or eigenvalues[0] <= 0:
        return None
    gradients = np.einsum("nki,nk->ni", rows, weight[:, None] * residual)
    long_side = max(view.core.width, view.core.height)
    # Dense, but of float32 and of at most some thousand matches.
    place = (xy / (CORRELATION_LENGTH * long_side)).astype(np.float32)
    square = (place**2).sum(1)
    kernel = np.exp(-0.5 * np.maximum(square[:, None] + square[None] - 2 * place @ place.T, 0))
    filling = gradients.T @ (kernel.astype(np.float64) @ gradients)
    # Independent places: (Σ w)² / Σ w w' K; each parameter uses one half of a match's two coordinates.
    places = float(weight.sum() ** 2 / (weight @ kernel @ weight))
    correction = places / max(places - 0.5 * len(names), 1.0)
    inverse = np.linalg.inv(curvature)
    total = correction * inverse @ filling @ inverse
    # A shift of all matches by one px in x, in y.
    for axis in range(2):
        shifted = np.einsum("nki,nk->i", rows, weight[:, None] * factors[:, :, axis])
        effect = inverse @ shifted * (COMMON * pixel)
        total += np.outer(effect, effect)
    total = total / np.outer(size, size)
    return Covariance(tuple(names), 0.5 * (total + total.T))
