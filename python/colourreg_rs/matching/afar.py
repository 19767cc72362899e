"""The rotations that the matches of a far start agree on.

Seen from afar a start differs from the truth by a rotation first of all: where a photo shows something is changed by a
degree as much as by the decimetres that a start is displaced. Pairs of matches each give a rotation; the ones that most
templates agree on are starts to go on from.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import _core
from ..model import FloatArray, Pose, View
from .correspondences import Correspondences, pixels_per_radian

#: Matches agree within this, radians, or two pixels of their level: what a displaced centre leaves.
TOLERANCE = float(np.radians(0.8))

#: Two matches nearer to each other than this, radians, tell no rotation.
LEAST_APART = float(np.radians(4.0))

#: So many pairs are drawn, and so many of those that fit are tried.
DRAWN, TRIED = 6000, 1500


def agreeing_rotations(view: View, found: Correspondences, search: float, most: int) -> list[View]:
    """The view turned so that most templates agree, each with the best of its hypotheses; then the next best rotations.

    Args:
        view: the start. found: its matches.
        search: rotations beyond 1.5 times this, radians, are not looked for.
        most: at most so many; each differs from the others by more than the tolerance.
    """
    core, pose = view.core, view.pose
    assert pose is not None
    towards = found.xyz - core.centre
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    seen = _core.unproject(core, found.xy)
    ok = np.isfinite(seen).all(1)
    towards, seen, template = towards[ok], seen[ok], found.template[ok]
    tolerance = max(2.0 * found.pixel / pixels_per_radian(view), TOLERANCE)
    a, b = np.random.default_rng(0).integers(0, len(seen), (DRAWN, 2)).T
    apart = _angle((seen[a] * seen[b]).sum(1))
    fits = np.abs(_angle((towards[a] * towards[b]).sum(1)) - apart) < tolerance
    keep = (template[a] != template[b]) & fits & (apart > LEAST_APART)
    a, b = a[keep][:TRIED], b[keep][:TRIED]
    if len(a) == 0:
        return [view]
    turns = np.einsum("kij,klj->kil", _frames(towards[a], towards[b]), _frames(seen[a], seen[b]))
    turns = turns[_angle((np.trace(turns, axis1=1, axis2=2) - 1) / 2) < 1.5 * search]
    turns = np.concatenate([np.eye(3)[None], turns])
    turned = np.einsum("kij,nj->kni", turns, seen)
    miss = 1 - np.einsum("kni,ni->kn", turned, towards)
    score = np.maximum(0, 1 - 2 * miss / tolerance**2)
    first = np.flatnonzero(np.r_[True, template[1:] != template[:-1]])
    total = np.maximum.reduceat(score, first, axis=1).sum(1)
    views: list[View] = []
    while len(views) < most and total.max() > 0:
        best = turns[int(np.argmax(total))]
        # x_cam = R X: what was seen in the direction R⁻¹x is in truth in the direction best · R⁻¹x.
        u, _, v = np.linalg.svd(pose.rotation @ best.T)
        views.append(replace(view, pose=Pose.from_centre(u @ v, core.centre)))
        total[_angle((np.einsum("kij,ij->k", turns, best) - 1) / 2) < tolerance] = 0.0
    return views or [view]


def _angle(cosine: FloatArray) -> FloatArray:
    return np.asarray(np.arccos(np.clip(cosine, -1, 1)))


def _frames(a: FloatArray, b: FloatArray) -> FloatArray:
    """Orthonormal frames (K, 3, 3), in columns, of pairs of unit directions."""
    middle = a + b
    middle /= np.linalg.norm(middle, axis=1)[:, None]
    side = b - a
    side /= np.linalg.norm(side, axis=1)[:, None]
    return np.stack([middle, side, np.cross(middle, side)], axis=2)
