"""The covariance of a view estimated from matches that are not independent.

Neighbouring templates overlap and see the same sill, shadow and SCI; all of them share what the SCI gets wrong
everywhere. Taken as independent, a thousand matches promise a tenth of the error that they leave. So, after the fit:

- the sandwich ``H⁻¹ G H⁻¹``, whose filling ``G`` sums the products of the matches' gradients *with those of their
  neighbours*, weighted by a Gaussian of their distance in the photo (Conley 1999), and is raised for the number of
  parameters that the fit has taken from so many independent places;
- an error common to all matches, a shift of the whole SCI by a share of its pixel, which no residual shows;
- and a factor for what errs alike wherever the same is built.

The patches of the last step (:mod:`.pointwise`) are treated like matches: their gradients sum up in ``G``, their
information in ``H``. But what errs together there is another thing: an upright edge lies somewhere between two columns
of the scan, from end to end, and a level one between two rows. So a patch's neighbours are those above and below it and
those beside it, over the whole photo.

How well this holds is measured by ``python -m colourreg_rs.experiments.sci_accuracy``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .. import _core
from ..model import Covariance, FloatArray, View
from ..sci import Float32Array
from .parameters import design
from .pointwise import STRIDE, Patches

#: The distance over which single matches err together, as one sigma of a Gaussian and a share of the photo's long side.
CORRELATION_LENGTH = 0.18

#: The error common to all matches, px of the SCI, one sigma in x and in y.
COMMON = 0.15

#: What is left unexplained, shadows beside every sill on the same side, as a factor of the variances. This and the two
#: above were set on façades and rooms with seeds 0 to 9.
SYSTEMATIC = 2.5

#: The distance across lines of points over which patches err together; along them they do from end to end. As a patch;
#: 0.015 to 0.02 makes the true errors on façades and rooms with seeds 100 to 119 more likely than wider ones, and than
#: any distance in all directions.
PATCHES_LENGTH = 0.02

#: The error common to all patches, px of the level, one sigma in x and in y. In those scenes there is none to be seen;
#: colours that a camera has put onto a real cloud lay 0.1 px beside its next picture.
PATCHES_COMMON = 0.06

#: What is left unexplained, as a factor of the variances: the one with which 95 % of those scenes' regions hold the
#: truth. It stands beside that of the stride, since the patches' information is that of Gauss-Newton, larger than the
#: likelihood's curvature by :data:`.pointwise.STRIDE`.
PATCHES_SYSTEMATIC = 3.3


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
    information = np.einsum("nki,nkj->nij", rows, rows)
    gradients = np.einsum("nki,nk->ni", rows, residual)
    # What a shift of all matches by one px in x, in y, adds to the gradient.
    shifted = np.stack([np.einsum("nki,nk->i", rows, factors[:, :, axis]) for axis in range(2)])
    common = COMMON * pixel
    return _sandwich(view, names, xy, information, gradients, shifted * common, _near, CORRELATION_LENGTH, SYSTEMATIC)


def patch_covariance(view: View, patches: Patches, seen: FloatArray, pixel: float) -> Covariance | None:
    """The covariance of a view's parameters from ``patches`` at the view; ``None`` where they do not determine them.

    Args:
        view: the view.
        patches: what they say of it.
        seen: (N, 3) points all over the photo, through which an error common to all acts.
        pixel: the size of the level's pixel in the photo, px.
    """
    information = patches.information.sum(0)
    slopes = design(view, patches.names, seen)
    slopes = slopes[np.isfinite(slopes).all((1, 2))]
    normal = np.einsum("nki,nkj->ij", slopes, slopes)
    if not np.isfinite(information).all() or np.linalg.matrix_rank(normal) < len(patches.names):
        return None
    # The change of the parameters that comes nearest to a shift of all the picture, as a gradient that makes it.
    shifts = np.linalg.solve(normal, slopes.sum(0).T).T
    factor = PATCHES_SYSTEMATIC * STRIDE**2
    common = shifts @ information * (PATCHES_COMMON * pixel / np.sqrt(factor))
    return _sandwich(
        view, patches.names, patches.places, patches.information, patches.gradient, common, _in_line, PATCHES_LENGTH,
        factor,
    )  # fmt: skip


def _near(places: Float32Array) -> Float32Array:
    """How much matches at ``places`` (K, 2), in lengths, err together: a Gaussian of their distance."""
    square = (places**2).sum(1)
    return np.asarray(np.exp(-0.5 * np.maximum(square[:, None] + square[None] - 2 * places @ places.T, 0)))


def _in_line(places: Float32Array) -> Float32Array:
    """The same of patches, half of it for lying above each other and half for lying beside each other."""
    return np.asarray(0.5 * (_near(places[:, :1]) + _near(places[:, 1:])))


def _sandwich(
    view: View,
    names: Sequence[str],
    places: FloatArray,
    information: FloatArray,
    gradients: FloatArray,
    common: FloatArray,
    kernel: Callable[[Float32Array], Float32Array],
    length: float,
    systematic: float,
) -> Covariance | None:
    """``H⁻¹ G H⁻¹`` of information (K, U, U) and gradients (K, U) at places (K, 2), that err together as
    ``kernel`` says over ``length``, with errors common to all, whose gradients are ``common`` (C, U)."""
    # Columns of length 1 for the numbers' sake.
    size = np.sqrt(np.diagonal(information, axis1=1, axis2=2).sum(0))
    if not (size > 0).all():
        return None
    scaled = information / np.outer(size, size)
    gradients, common = gradients / size, common / size
    curvature = scaled.sum(0)
    eigenvalues = np.linalg.eigvalsh(curvature)
    if eigenvalues[0] <= 1e-12 * eigenvalues[-1] or eigenvalues[0] <= 0:
        return None
    long_side = max(view.core.width, view.core.height)
    # Dense, but of float32 and of at most some thousand matches.
    together = kernel((places / (length * long_side)).astype(np.float32))
    filling = gradients.T @ (together @ gradients.astype(np.float32)).astype(np.float64)
    # Independent places: (Σ w)² / Σ w w' K, each weighing what it contributes; each parameter uses one half of a
    # match's two coordinates.
    weight = np.trace(scaled, axis1=1, axis2=2)
    independent = float(weight.sum() ** 2 / (weight @ (together @ weight.astype(np.float32))))
    correction = independent / max(independent - 0.5 * len(names), 1.0)
    inverse = np.linalg.inv(curvature)
    total = correction * inverse @ filling @ inverse
    for gradient in common:
        effect = inverse @ gradient
        total += np.outer(effect, effect)
    total = systematic * total / np.outer(size, size)
    return Covariance(tuple(names), 0.5 * (total + total.T))
