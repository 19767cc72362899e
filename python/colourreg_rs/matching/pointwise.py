"""The last step of a registration: the points' intensities explained by the photo at the points' own places.

The scan is not made into a picture, so that nothing is shifted by how it is drawn, and an edge that lies between two
rows of points is not put anywhere. The photo is read where the view puts the points, and in each patch the intensities
are regressed on its colours (:func:`_core.regress_patches`); the view is moved until they explain most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import _core
from ..model import FloatArray, PointCloud, View
from ..sci import Float32Array, render_sci, with_size
from .parameters import design

#: The least side of a patch, px of the level, and in spacings of the points: it has to hold a few materials, and enough
#: points to tell them apart.
CELL, CELL_SPACINGS = 24, 9.0

#: The photo is read with so many pixels per spacing of the points, if it has them: read through the blur of a coarser
#: one, edges that lie between two columns of points are pushed to the middle, all along and whatever else is known.
READ = 6.0

#: A patch says at most about so much as this many mean ones: a long edge between two columns of points explains every
#: intensity beside it and is still uncertain by the gap.
CAP = 1.0

#: Patches of fewer points have no say.
LEAST_POINTS = 40

#: Light is compared by its logarithm above this share of the photo's brightest: a shadow is a factor.
DARKEST = 0.02

#: Fainter intensities than this share of their median count as this.
FAINTEST = 1e-3

#: The order of the polynomial that takes what changes slowly over a patch.
ORDER = 2

#: Layouts of patches that are taken together, each beside the others.
LAYOUTS = 2

#: At most so many steps between two looks at which points the view sees, and at most so many looks.
STEPS, LOOKS = 10, 8

#: Gauss-Newton falls short, since the photo has texture that the intensity does not share: steps are longer by this.
STRIDE = 1.4


@dataclass(frozen=True)
class Patches:
    """What the patches say of a view's ``names``; rows go together.

    ``places`` (K, 2): their middles, px of the photo; ``gradient`` (K, U) and ``information`` (K, U, U) of the
    log-likelihoods ``value`` (K,), weighed against each other; ``explained`` (K,): the share of the intensities'
    variance; ``points`` (K,).
    """

    names: tuple[str, ...]
    places: FloatArray
    gradient: FloatArray
    information: FloatArray
    value: FloatArray
    explained: FloatArray
    points: FloatArray


@dataclass
class PointwisePhoto:
    """A photo's channels at one level, ready to be read."""

    pixels: npt.NDArray[Any]
    width: int
    height: int
    prepared: _core.RegressionPhoto = field(init=False)

    def __post_init__(self) -> None:
        planes = self.pixels[:, :, None] if self.pixels.ndim == 2 else self.pixels[:, :, :3]
        top = {"uint8": 255.0, "uint16": 65535.0}.get(planes.dtype.name) or max(float(planes.max()), 1e-6)
        light = np.stack(
            [
                _core.resize(np.ascontiguousarray(planes[:, :, c], dtype=np.float32), self.width, self.height)
                for c in range(planes.shape[2])
            ]
        )
        linear = np.clip(light / top, 0.0, 1.0) ** 2.2
        self.prepared = _core.RegressionPhoto(np.log(linear + DARKEST).astype(np.float32))

    def scale(self, view: View) -> FloatArray:
        """Pixels of the level for one of the view's, in x and y."""
        return np.array([self.width / view.core.width, self.height / view.core.height])


@dataclass(frozen=True)
class Look:
    """The points that a view sees, one at most in each pixel of the photo's level, in their patches.

    - ``xyz`` (N, 3): world; ``values`` (N,): the logarithm of the intensity.
    - ``slopes`` (N, 2, U): derivatives of the places in the level by ``names``, at the view; they change little nearby.
    - ``members``: the points of all patches one after the other; ``ends`` (K,): where each patch ends; ``places``
      (K, 2): the patches' middles, px of the photo.
    """

    names: tuple[str, ...]
    photo: PointwisePhoto
    xyz: FloatArray
    values: Float32Array
    slopes: FloatArray
    members: npt.NDArray[np.int64]
    ends: npt.NDArray[np.int64]
    places: FloatArray

    @classmethod
    def at(
        cls,
        cloud: PointCloud,
        view: View,
        names: Sequence[str],
        photo: PointwisePhoto,
        spacing: float,
        station: FloatArray | None,
        exponents: tuple[float, float] | None,
    ) -> Look:
        """What ``view`` sees; ``spacing``: of the cloud's points, px of the level."""
        level = with_size(view, photo.width, photo.height)
        sci = render_sci(cloud, level, station=station, exponents=exponents, fill=0)
        known = sci.measured & np.isfinite(sci.raw)
        xyz = np.ascontiguousarray(cloud.xyz[sci.index[known]])
        values = sci.raw[known]
        positive = values[values > 0]
        least = FAINTEST * float(np.median(positive)) if len(positive) else 1.0
        scale = photo.scale(view)
        rows, columns = np.nonzero(known)
        members, ends, places = _laid_out(
            np.stack([columns, rows], axis=1), photo.width, round(max(CELL, CELL_SPACINGS * spacing))
        )
        return cls(
            tuple(names), photo, xyz, np.log(np.maximum(values, least)).astype(np.float32),
            np.ascontiguousarray(design(view, names, xyz) * scale[None, :, None]),
            members, ends, (places + 0.5) / scale - 0.5,
        )  # fmt: skip

    def patches(self, view: View) -> Patches:
        """What the photo says of ``view``."""
        projected, _ = _core.project(view.core, self.xyz)
        found = _core.regress_patches(
            self.photo.prepared,
            np.ascontiguousarray((projected + 0.5) * self.photo.scale(view) - 0.5),
            self.slopes, self.values, self.members, self.ends, least_points=LEAST_POINTS, order=ORDER,
        )  # fmt: skip
        weight = weights(found["information"])
        return Patches(
            self.names, self.places,
            found["gradient"] * weight[:, None], found["information"] * weight[:, None, None],
            found["value"], found["explained"], found["points"],
        )  # fmt: skip


def weights(information: FloatArray) -> FloatArray:
    """Of patches with ``information`` (K, U, U). Each is uncertain by its noise, and by something that is alike in all:
    what it says grows up to :data:`CAP` times the mean and no farther."""
    each = np.diagonal(information, axis1=1, axis2=2)
    total = each.sum(0)
    share = (each / np.where(total > 0, total, 1.0)).sum(1)
    mean = share.sum() / max(int((share > 0).sum()), 1)
    return np.asarray(1.0 / (1.0 + share / (CAP * mean))) if mean > 0 else np.ones(len(share))


def _laid_out(
    pixels: npt.NDArray[np.int64], width: int, cell: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], FloatArray]:
    """The points at ``pixels`` (N, 2: column, row) in patches of ``cell`` px: members, ends and middles."""
    members, ends, places = [], [], []
    for layout in range(LAYOUTS):
        cells = (pixels + layout * cell // LAYOUTS) // cell
        label = cells[:, 1] * (width // cell + 2) + cells[:, 0]
        order = np.argsort(label, kind="stable")
        sizes = np.bincount(label)
        sizes = sizes[sizes > 0]
        starts = np.cumsum(sizes) - sizes
        members.append(order)
        ends.append(layout * len(order) + starts + sizes)
        places.append(np.add.reduceat(pixels[order].astype(np.float64), starts, axis=0) / sizes[:, None])
    return np.concatenate(members), np.concatenate(ends), np.concatenate(places)
