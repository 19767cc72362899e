"""Colours of photos onto a cloud, in two passes over chunks.

The first pass puts every point into each photo's depth buffer, the second colours each chunk against the finished
buffers. Memory holds the buffers, the photos and a few chunks, whatever the cloud's size; the output depends neither on
the size of the chunks nor on the number of threads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from . import _core
from .errors import FileError, InvalidInputError
from .io.clouds import CloudChunk, CloudReader, create_cloud, open_cloud
from .io.images import Photo, read_photo
from .io.registration import read_registration
from .model import FloatArray, Registration, View
from .overlap import Behind, prefetched
from .progress import Progress, silent

#: Pixels: how sure a registration without stated covariance of its photo coordinates is taken to be.
IMAGE_SIGMA = 0.5


@dataclass(frozen=True)
class ColouriseOptions:
    """How a cloud is coloured; the defaults are meant to be right."""

    blend: Literal["best", "mean", "median"] = "best"
    sampling: Literal["bilinear", "bicubic"] = "bilinear"
    max_distance: float | None = None
    max_sigma: float | None = None
    level_exposure: bool = False
    chunk_size: int = 1_000_000


@dataclass(frozen=True)
class ColouriseResult:
    """What colouring did: how many points each view coloured, and how sure the colours' places are."""

    out: Path | None
    points: int
    coloured: int
    by_view: dict[str, int]
    median_sigma: float | None
    warnings: tuple[str, ...]

    def text(self) -> str:
        """A few lines for people."""
        lines = [f"coloured {self.coloured:,} of {self.points:,} points ({100 * self.coloured / self.points:.1f} %)"]
        lines += [f"  {name}: {count:,}" for name, count in self.by_view.items()]
        if self.median_sigma is not None:
            lines.append(f"  position of the colours: median sigma {self.median_sigma * 1000:.1f} mm per axis")
        lines += [f"warning: {warning}" for warning in self.warnings]
        if self.out is not None:
            lines.append(f"wrote {self.out}")
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**vars(self), "out": str(self.out) if self.out else None, "warnings": list(self.warnings)}


class Colouriser:
    """Two passes: :meth:`see` every chunk, then :meth:`finish`, then :meth:`colour` every chunk."""

    def __init__(
        self, views: Sequence[View], photos: Sequence[npt.NDArray[Any]], options: ColouriseOptions | None = None
    ) -> None:
        if not views:
            raise InvalidInputError("there is no view to colour from")
        self.views = tuple(views)
        self.options = options or ColouriseOptions()
        self._photos = [np.ascontiguousarray(photo) for photo in photos]
        self._buffers = [_core.DepthBuffer(view.core) for view in self.views]
        self._maps: list[_core.VisibilityMap] = []

    def see(self, xyz: FloatArray) -> None:
        """First pass: the chunk's points hide what lies behind them."""
        for buffer in self._buffers:
            buffer.add(xyz)

    def finish(self) -> None:
        """Between the passes: surfaces are made of the points that were seen."""
        self._maps = [buffer.finish() for buffer in self._buffers]
        self._buffers = []

    def colour(
        self, xyz: FloatArray
    ) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint16], npt.NDArray[np.float32]]:
        """Second pass: colours (N, 3), their view's number from 1 or 0 (N,), and their place's sigma in metres (N,)."""
        options = self.options
        rgb, source = _core.colour_points(
            self._maps, self._photos, xyz, sampling=options.sampling, blend=options.blend
        )
        sigma = np.full(len(xyz), np.nan, np.float32)
        return rgb, source, sigma
