"""The covariance of a view estimated from matches that are not independent.

Neighbouring templates overlap and see the same sill, shadow and SCI; all of them share what the SCI gets wrong
everywhere. Taken as independent, a thousand matches promise a tenth of the error that they leave. So, after the fit:

- the sandwich ``H⁻¹ G H⁻¹``, whose filling ``G`` sums the products of the matches' gradients *with those of their
  neighbours*, weighted by a Gaussian of their distance in the photo (Conley 1999), and is raised for the number of
  parameters that the fit has taken from so many independent places;
- an error common to all matches, a shift of the whole SCI by a share of its pixel, which no residual shows;
- and a factor for what errs alike wherever the same is built.

How well this holds is measured by ``python -m colourreg_rs.experiments.sci_accuracy``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .. import _core
from ..model import Covariance, FloatArray, View

#: The distance over which matches err together, as one sigma of a Gaussian and a share of the photo's long side.
CORRELATION_LENGTH = 0.18

#: The error common to all matches, px of the SCI, one sigma in x and in y.
COMMON = 0.15

#: What is left unexplained, shadows beside every sill on the same side, as a factor of the variances. This and the two
#: above were set on façades and rooms with seeds 0 to 9.
SYSTEMATIC = 2.5

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
        covariance: (N, 2, 2) px², by which the fit weighted them; their common factor does not matter.
        pixel: the size of the SCI's pixel in the photo, px.
    """
    projected, _ = _core.project(view.core, xyz)
    factors = np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1)
    residual = np.einsum("nij,nj->ni", factors, xy - projected)
    rows = factors @ design(view, names, xyz)
    if not (np.isfinite(rows).all() and np.isfinite(residual).all()) or len(rows) < len(names):
        return None
    # Columns of length 1 for the numbers' sake.
    size = np.sqrt((rows**2).sum((0, 1)))
    if not (size > 0).all():
        return None
    rows = rows / size
    curvature = np.einsum("nki,nkj->ij", rows, rows)
    eigenvalues = np.linalg.eigvalsh(curvature)
    if eigenvalues[0] <= 1e-12 * eigenvalues[-1] or eigenvalues[0] <= 0:
        return None
    gradients = np.einsum("nki,nk->ni", rows, residual)
    long_side = max(view.core.width, view.core.height)
    # Dense, but of float32 and of at most some thousand matches.
    place = (xy / (CORRELATION_LENGTH * long_side)).astype(np.float32)
    square = (place**2).sum(1)
    kernel = np.exp(-0.5 * np.maximum(square[:, None] + square[None] - 2 * place @ place.T, 0))
    filling = gradients.T @ (kernel.astype(np.float64) @ gradients)
    # Independent places: (Σ w)² / Σ w w' K, each weighing what it contributes; each parameter uses one half of a
    # match's two coordinates.
    weight = (rows**2).sum((1, 2))
    places = float(weight.sum() ** 2 / (weight @ kernel @ weight))
    correction = places / max(places - 0.5 * len(names), 1.0)
    inverse = np.linalg.inv(curvature)
    total = correction * inverse @ filling @ inverse
    # A shift of all matches by one px in x, in y.
    for axis in range(2):
        shifted = np.einsum("nki,nk->i", rows, factors[:, :, axis])
        effect = inverse @ shifted * (COMMON * pixel)
        total += np.outer(effect, effect)
    total = SYSTEMATIC * total / np.outer(size, size)
    return Covariance(tuple(names), 0.5 * (total + total.T))
