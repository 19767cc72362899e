"""Colours of photos onto a cloud, in two passes over chunks.

The first pass puts every point into each photo's depth buffer, the second colours each chunk against the finished
buffers. Memory holds the buffers, the photos in use and a few chunks, whatever the cloud's size; the output depends
neither on the size of the chunks nor on the number of threads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from . import _core
from .errors import DegenerateError, FileError, InvalidInputError
from .io.clouds import CloudChunk, CloudReader, CloudWriter, create_cloud, open_cloud
from .io.images import photo_info, read_photo
from .io.registration import read_registration
from .model import FloatArray, View
from .overlap import Behind, prefetched
from .photos import PHOTO_MEMORY, PhotoShelf
from .progress import Progress, silent


@dataclass(frozen=True)
class ColouriseOptions:
    """How a cloud is coloured; the defaults are meant to be right.

    ``sigma_image`` (pixels, where a colour is taken) and ``sigma_xyz`` (the cloud's own noise, its unit) go into
    ColourSigma beside the view's covariance. Points whose ColourSigma exceeds ``max_sigma`` stay uncoloured.
    ``tolerance`` is a part of the depth: what is in front by less hides nothing. Without it the scatter of the cloud's
    own depths decides, three sigma of it.
    ``photo_memory`` (bytes) is what photos that are not in use just now may take; see :mod:`colourreg_rs.photos`.
    """

    blend: Literal["best", "mean", "median"] = "best"
    sampling: Literal["bilinear", "bicubic"] = "bilinear"
    max_distance: float | None = None
    max_sigma: float | None = None
    tolerance: float | None = None
    sigma_image: float = 0.3
    sigma_xyz: float = 0.002
    level_exposure: bool = False
    chunk_size: int = 1_000_000
    photo_memory: int = PHOTO_MEMORY


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


@dataclass(frozen=True)
class ColouredChunk:
    """Colours (N, 3), the number of their view from 1 or 0 (N,), and the sigma of their place in metres (N,).

    Points of view 0 have the colour that they had before, or black.
    """

    rgb: npt.NDArray[np.uint16]
    source: npt.NDArray[np.uint16]
    sigma: npt.NDArray[np.float32]


class SigmaHistogram:
    """The median of any number of sigmas in little memory: ColourSigma is kept to eight binary places, so that the
    numbers themselves can be counted."""

    _DROPPED = 15
    _BINS = int(np.float32(np.inf).view(np.uint32)) >> _DROPPED

    def __init__(self) -> None:
        self._counts = np.zeros(self._BINS, np.int64)

    def add(self, sigma: npt.NDArray[np.float32]) -> None:
        """Counts those that are known: not negative and finite."""
        self._counts += np.bincount(sigma.view(np.uint32) >> self._DROPPED, minlength=self._BINS)[: self._BINS]

    def median(self) -> float | None:
        """Metres; ``None`` where none was known."""
        total = self._counts.sum()
        if total == 0:
            return None
        i = np.searchsorted(np.cumsum(self._counts), total / 2)
        return float(np.uint32(i << self._DROPPED).view(np.float32))


class Colouriser:
    """Two passes: :meth:`see` every chunk, then :meth:`finish` with the photos, then :meth:`colour` every chunk.

    With ``level_exposure``, :meth:`compare` every chunk between :meth:`finish` and :meth:`colour`.
    """

    def __init__(self, views: Sequence[View], options: ColouriseOptions | None = None) -> None:
        if not views:
            raise InvalidInputError("there is no view to colour from")
        limit = (options or ColouriseOptions()).max_sigma
        if limit is not None and not limit > 0:
            raise InvalidInputError(f"a largest ColourSigma of {limit} is not possible: give metres above zero")
        self.views = tuple(views)
        self.options = options or ColouriseOptions()
        self._photos = PhotoShelf((), ())
        limits = {"max_distance": self.options.max_distance, "tolerance": self.options.tolerance}
        self._buffers = [_core.DepthBuffer(view.core, **limits) for view in self.views]
        self._maps: list[_core.VisibilityMap] = []
        self._planes: list[_core.LocalPlanes | None] = []
        self._exposure = _core.Exposure(len(self.views)) if self.levels else None
        self._gains: FloatArray | None = None
        self._sigmas = [_surface_sigma(view, self.options) for view in self.views]

    @property
    def levels(self) -> bool:
        """Whether exposures are to be levelled, which takes two photos."""
        return self.options.level_exposure and len(self.views) > 1

    def see(self, xyz: FloatArray) -> None:
        """First pass: the chunk's points hide what lies behind them."""
        for buffer in self._buffers:
            buffer.add(xyz)

    def finish(self, photos: Sequence[npt.NDArray[Any]] | PhotoShelf) -> None:
        """Between the passes: surfaces are made of the points that were seen.

        Args:
            photos: (H, W, 3) uint8 or uint16, those of the views, in their order; or a shelf of them.
        """
        if len(photos) != len(self.views):
            raise InvalidInputError(f"{len(photos)} photos for {len(self.views)} views")
        self._maps = [buffer.finish() for buffer in self._buffers]
        self._buffers = []
        # Slopes are asked for by ColourSigma alone.
        self._planes = [
            None if sigma is None else m.planes() for m, sigma in zip(self._maps, self._sigmas, strict=True)
        ]
        self._photos = photos if isinstance(photos, PhotoShelf) else PhotoShelf.of(photos)

    def _photos_of(self, xyz: FloatArray) -> list[npt.NDArray[Any]]:
        """The photos that the chunk may lie in; of the others nothing is looked at."""
        return self._photos.take({i for i, view in enumerate(self.views) if view.core.meets(xyz)})

    def compare(self, xyz: FloatArray) -> None:
        """What several photos see of the chunk tells how their exposures differ."""
        assert self._exposure is not None
        self._exposure.add(self._maps, self._photos_of(xyz), xyz)

    def colour(
        self,
        xyz: FloatArray,
        normals: FloatArray | None = None,
        before: npt.NDArray[np.uint16] | None = None,
    ) -> ColouredChunk:
        """Second pass. Points that no photo sees have source 0.

        Args:
            xyz: (N, 3) points.
            normals: (N, 3) the surface's normals, of any length, where the cloud knows them; zeros where it does not.
                Else slopes come from the depth buffers.
            before: (N, 3) the colours that unseen points keep; without them these are black.
        """
        if self._exposure is not None and self._gains is None:
            self._gains = self._exposure.gains()
        options = self.options
        rgb = np.zeros((len(xyz), 3), np.uint16) if before is None else np.array(before, np.uint16, order="C")
        source = np.empty(len(xyz), np.uint16)
        # The core writes over the points that it sees.
        _core.colour_points(
            self._maps, self._photos_of(xyz), xyz, sampling=options.sampling, blend=options.blend, gains=self._gains,
            normals=normals, out_rgb=rgb, out_source=source,
        )  # fmt: skip
        sigma = np.full(len(xyz), np.nan, np.float32)
        for number, (surface, planes) in enumerate(zip(self._sigmas, self._planes, strict=True), 1):
            if surface is not None:
                surface.fill_where(xyz, source, number, sigma, normals=normals, planes=planes)
        if options.max_sigma is not None:
            unsure = sigma > options.max_sigma  # not where it is unknown: NaN compares false
            source[unsure], sigma[unsure] = 0, np.nan
            rgb[unsure] = 0 if before is None else before[unsure]
        return ColouredChunk(rgb, source, sigma)


def _surface_sigma(view: View, options: ColouriseOptions) -> _core.SurfaceSigma | None:
    """What says how sure the places of this view's colours are; ``None`` where the view's covariance is not known."""
    if view.covariance is None:
        return None
    names, matrix = list(view.covariance.parameters), view.covariance.matrix
    return _core.SurfaceSigma(view.core, names, matrix, sigma_image=options.sigma_image, sigma_xyz=options.sigma_xyz)


def load_views(paths: Sequence[Path]) -> list[View]:
    """All views of all registrations, in order, whose photos exist and have the size that is told. Raises FileError."""
    views = []
    for i, path in enumerate(paths):
        if path.resolve() in [earlier.resolve() for earlier in paths[:i]]:
            raise FileError(path, "is given twice", "name each registration once")
        for view in read_registration(path).views:
            if view.image is None:
                raise FileError(path, f"view {view.name!r} names no photo", "give its image")
            photo = photo_info(view.image)
            size = (photo.width, photo.height)
            if view.image_size is not None and view.image_size != size:
                wanted = "{} x {}".format(*view.image_size)
                raise FileError(
                    view.image,
                    f"has {size[0]} x {size[1]} pixels, its camera in {path} {wanted}",
                    "use the photo that was registered, not a scaled or turned copy",
                )
            view = view if view.image_size else replace(view, size=size)
            try:
                _surface_sigma(view, ColouriseOptions())
                _ = view.core
            except (DegenerateError, InvalidInputError) as error:
                raise FileError(path, f"view {view.name!r}: {error}") from error
            views.append(view)
    return views


def _pixels(view: View) -> npt.NDArray[Any]:
    assert view.image is not None
    return read_photo(view.image).pixels


def _sizes(views: Sequence[View]) -> list[tuple[int, int]]:
    return [(view.core.width, view.core.height) for view in views]


def colourise_file(
    cloud: str | Path,
    registrations: Sequence[str | Path],
    out: str | Path,
    *,
    options: ColouriseOptions | None = None,
    progress: Progress = silent,
) -> ColouriseResult:
    """Colours the cloud from all views of the registrations into ``out``, which appears whole or not at all.

    Raises FileError where a file cannot be used, and where no point lies in any photo: that registration is of another
    place or frame, and calling its result coloured would be wrong.
    """
    options = options or ColouriseOptions()
    cloud, out = Path(cloud), Path(out)
    with open_cloud(cloud) as reader, create_cloud(out, like=reader) as writer:
        views = load_views([Path(path) for path in registrations])
        unlimited = _without_sigma(views, options)
        colouriser = Colouriser(views, options)
        # The first pass needs no photo: they are decoded behind it.
        with ThreadPoolExecutor(1, thread_name_prefix="colourreg-photos") as decoder:
            photos = PhotoShelf([partial(_pixels, view) for view in views], _sizes(views), options.photo_memory)
            filled = decoder.submit(photos.fill)
            try:
                _first_pass(reader, colouriser, photos, filled, progress)
            except BaseException:
                photos.stop()
                raise
        coloured, counts, sigmas = _second_pass(reader, writer, colouriser, progress)
        if coloured == 0:
            raise FileError(cloud, _nothing_seen(views, reader), "check the registration's frame and unit")
    return ColouriseResult(
        out=out,
        points=reader.n_points,
        coloured=coloured,
        by_view={f"{i}: {view.name}": int(n) for i, (view, n) in enumerate(zip(views, counts, strict=True), start=1)},
        median_sigma=sigmas,
        warnings=(*_doubts(views), *unlimited, *writer.warnings),
    )


def _without_sigma(views: Sequence[View], options: ColouriseOptions) -> tuple[str, ...]:
    """Warns of views that a limit of ColourSigma does not reach. Raises InvalidInputError if it reaches none."""
    unknown = [view.name for view in views if view.covariance is None]
    if options.max_sigma is None or not unknown:
        return ()
    if len(unknown) == len(views):
        raise InvalidInputError(
            "no view has a covariance, so that no ColourSigma is known to be limited: register again, or leave "
            "--max-sigma out"
        )
    return (f"no covariance, hence no ColourSigma and no limit of it: {', '.join(unknown)}",)


def _doubts(views: Sequence[View]) -> tuple[str, ...]:
    """What was said against the views when they were registered, and written all the same."""
    said = ((view.name, doubt) for view in views for doubt in view.statistics.get("doubts") or ())
    return tuple(f"view {name} was registered with a doubt: {doubt}" for name, doubt in said)


def _nothing_seen(views: Sequence[View], reader: CloudReader) -> str:
    box = reader.told_extent() or reader.extent()
    extent = " x ".join(f"{_metres(a)}…{_metres(b)}" for a, b in zip(box.low, box.high, strict=True))
    place = ", ".join(_metres(v) for v in views[0].core.centre)
    return f"none of its points lies in any photo; it spans {extent}, view {views[0].name!r} stands at {place}"


def _metres(value: float) -> str:
    return f"{value:.1f}" if abs(value) < 1e9 else f"{value:.3g}"


def _positions(reader: CloudReader, options: ColouriseOptions) -> Iterator[CloudChunk]:
    return prefetched(reader.chunks(options.chunk_size, positions_only=True))


def _first_pass(
    reader: CloudReader, colouriser: Colouriser, photos: PhotoShelf, filled: Future[None], progress: Progress
) -> None:
    """Fills and finishes the buffers."""
    total = reader.n_points
    for chunk in _positions(reader, colouriser.options):
        colouriser.see(chunk.xyz)
        progress("finding what hides what", chunk.start + len(chunk), total)
    colouriser.finish(photos)
    filled.result()
    if colouriser.levels:
        for chunk in _positions(reader, colouriser.options):
            colouriser.compare(chunk.xyz)
            progress("levelling exposures", chunk.start + len(chunk), total)


def _normals(chunk: CloudChunk) -> FloatArray | None:
    """The cloud's own, zeros where they are none."""
    found = chunk.normals
    if found is None:
        return None
    normals = np.ascontiguousarray(found, np.float64)
    return np.where(np.isfinite(normals).all(axis=1, keepdims=True), normals, 0.0)


def _second_pass(
    reader: CloudReader, writer: CloudWriter, colouriser: Colouriser, progress: Progress
) -> tuple[int, npt.NDArray[np.int64], float | None]:
    """Colours and writes; gives the number of coloured points, those of each view, and the median sigma."""
    counts = np.zeros(len(colouriser.views) + 1, np.int64)
    sigmas, known = SigmaHistogram(), any(view.covariance is not None for view in colouriser.views)
    total = reader.n_points

    def write(item: tuple[CloudChunk, ColouredChunk]) -> None:
        nonlocal counts
        chunk, new = item
        writer.write(chunk, rgb=new.rgb, source=new.source, sigma=new.sigma)
        counts += np.bincount(new.source, minlength=len(counts))
        if known:
            sigmas.add(new.sigma)
        progress("colouring", chunk.start + len(chunk), total)

    with Behind(write) as writing:
        for chunk in prefetched(reader.chunks(colouriser.options.chunk_size)):
            writing.put((chunk, colouriser.colour(chunk.xyz, _normals(chunk), chunk.rgb)))
    return int(counts[1:].sum()), counts[1:], sigmas.median()
