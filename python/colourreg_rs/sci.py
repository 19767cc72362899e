"""The synthetic camera image (SCI): the photo that the scanner would have taken, in its own light, from a view.

Every pixel knows the point behind it. Intensity is what the scanner measured, freed of range and incidence, and
stretched by rank so that it looks like a photograph. Source: Forkuo and King, Automatic fusion of photogrammetric
imagery and laser scanner point clouds, ISPRS 2004.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from . import _core
from .errors import InvalidInputError
from .model import FloatArray, PointCloud, View

Float32Array = npt.NDArray[np.float32]

#: Grey values of colours, as ITU-R BT.601 weighs them.
LUMINANCE = np.array([0.299, 0.587, 0.114])

#: The share of a pixel, as one sigma of a Gaussian, over which intensities are brought to the pixel's centre.
CENTRE_SIGMA = 0.7


@dataclass(frozen=True)
class SCI:
    """A synthetic camera image of ``H`` x ``W`` pixels. Pixel (0, 0) is the centre of the top-left pixel.

    - ``intensity`` (H, W) uint8 or uint16: corrected, holes filled, stretched by rank; 0 where nothing was seen.
    - ``raw`` (H, W) float32: the same before the stretch, in the scanner's unit; NaN where nothing was seen.
    - ``depth`` (H, W) float32, metres, as the view has it; NaN where nothing was seen.
    - ``index`` (H, W) int64: the point behind the pixel, as a row of the cloud; -1 where none was measured.
    - ``subpixel`` (H, W, 2) float32: the true place of that point from the pixel's centre, x and y, px; NaN likewise.
    - ``measured`` (H, W) bool: whether a point lies in this pixel; other finite depths are filled between neighbours.
    - ``colour`` (H, W, 3) uint16 and ``normals`` (H, W, 3) float32 of measured pixels, where the cloud has them.
    - ``exponents``: the powers of range and of the cosine of incidence that the intensity was freed of.
    - ``source``: what the intensity is: the cloud's ``"intensity"``, the luminance of its ``"colour"``, or ``None``.
    """

    view: View
    intensity: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
    raw: Float32Array
    depth: Float32Array
    index: npt.NDArray[np.int64]
    subpixel: Float32Array
    measured: npt.NDArray[np.bool_]
    colour: npt.NDArray[np.uint16] | None
    normals: Float32Array | None
    exponents: tuple[float, float]
    source: Literal["intensity", "colour"] | None

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """(H, W) bool: measured or filled."""
        return np.isfinite(self.depth)

    @cached_property
    def at_centres(self) -> Float32Array:
        """(H, W) float32: ``raw`` brought to the pixels' centres, NaN where nothing is near.

        The point behind a pixel lies up to half a pixel beside the centre; drawn as it is, every edge is torn by as
        much. This is the image to match.
        """
        inverse = np.where(self.seen, 1.0 / self.depth, 0.0).astype(np.float32)
        return _core.sci_resample(self.raw, self.subpixel, inverse, sigma=CENTRE_SIGMA)


def _chunks(cloud: PointCloud | Iterable[PointCloud]) -> Iterator[tuple[int, PointCloud]]:
    first = 0
    for chunk in (cloud,) if isinstance(cloud, PointCloud) else cloud:
        yield first, chunk
        first += len(chunk)


def _values(chunk: PointCloud, source: str | None) -> Float32Array | None:
    if source == "intensity" and chunk.intensity is not None:
        return np.ascontiguousarray(chunk.intensity, dtype=np.float32)
    if source == "colour" and chunk.rgb is not None:
        return np.ascontiguousarray(chunk.rgb @ LUMINANCE, dtype=np.float32)
    return None


def render_sci(
    cloud: PointCloud | Iterable[PointCloud],
    view: View,
    *,
    bits: Literal[8, 16] = 8,
    source: Literal["intensity", "colour"] | None = None,
    station: npt.ArrayLike | None = None,
    exponents: tuple[float, float] | None = None,
    hide: bool = True,
    splat: int | None = None,
    tolerance: float | None = None,
    max_gap: float | None = None,
    fill: int = 8,
) -> SCI:
    """Renders the SCI of a cloud, or of its chunks, in a view.

    Args:
        cloud: a cloud, or something that can be iterated over *twice* and gives its chunks in the same order.
        view: the view; its camera may be of any model.
        bits: of the stretched intensity.
        source: what to show; by default the intensity, or the luminance where there is no intensity.
        station: (3,), world: where the scanner stood, for the correction of range and incidence. By default the view's
            projection centre, near which it usually stood.
        exponents: the powers of range and of the cosine of incidence that the intensity follows. By default they are
            found in the data; ``(0, 0)`` leaves the intensity as it is.
        hide: whether surfaces hide the points that shine through between their own.
        splat: draw each point as a square of so many pixels (odd, 7 at most), as simple renderers do, instead of
            finding the surfaces between the points. Faster; but gaps wider than the square let far points shine
            through, the outlines of near things grow, and ``subpixel`` reaches beyond the pixel.
        tolerance: noise of the depths, relative; what is in front by less hides nothing.
        max_gap: the widest gap between the points of a surface that still hides, px.
        fill: the widest hole to be filled, px; 0 fills none.

    Raises InvalidInputError.
    """
    if not isinstance(cloud, PointCloud) and iter(cloud) is cloud:
        raise InvalidInputError("render_sci reads the chunks twice: give a list, or an object that begins anew")
    if bits not in (8, 16):
        raise InvalidInputError(f"an SCI has 8 or 16 bits, not {bits}")
    core = view.core
    shape = (core.height, core.width)
    buffer = _core.IndexBuffer(core)
    has_intensity, has_colour, has_normals, n = True, True, True, 0
    for first, chunk in _chunks(cloud):
        buffer.add(chunk.xyz, first)
        has_intensity &= chunk.intensity is not None
        has_colour &= chunk.rgb is not None
        has_normals &= chunk.normals is not None
        n += len(chunk)
    if n == 0:
        raise InvalidInputError("the cloud has no points")
    if source is None:
        source = "intensity" if has_intensity else "colour" if has_colour else None
    if (source == "intensity" and not has_intensity) or (source == "colour" and not has_colour):
        raise InvalidInputError(f"the cloud has no {source} to show")
    index, inverse, limit = _core.sci_front(buffer, hide=hide, splat=splat, tolerance=tolerance, max_gap=max_gap)
    del buffer

    offset = np.full((*shape, 2), np.nan, np.float32)
    value, ranges, cosine = (np.full(shape, np.nan, np.float32) for _ in range(3))
    colour = np.zeros((*shape, 3), np.uint16) if has_colour else None
    normals = np.full((*shape, 3), np.nan, np.float32) if has_normals else None
    where = np.array(core.centre if station is None else station, dtype=np.float64)
    if where.shape != (3,) or not np.isfinite(where).all():
        raise InvalidInputError(f"station must be three finite coordinates, not {station!r}")
    for first, chunk in _chunks(cloud):
        chunk_normals = chunk.normals if has_normals else None
        if chunk_normals is not None:
            chunk_normals = np.ascontiguousarray(chunk_normals, dtype=np.float64)
        _core.sci_gather(
            core, index, where, chunk.xyz, first=first, intensity=_values(chunk, source), normals=chunk_normals,
            offset=offset, value=value, range=ranges, cosine=cosine,
        )  # fmt: skip
        if colour is not None or normals is not None:
            mine = (index >= first) & (index < first + len(chunk))
            rows = index[mine] - first
            if colour is not None and chunk.rgb is not None:
                colour[mine] = chunk.rgb[rows]
            if normals is not None and chunk_normals is not None:
                normals[mine] = chunk_normals[rows]

    measured = index >= 0
    if source == "colour":
        exponents = (0.0, 0.0) if exponents is None else exponents
    if source is not None and exponents != (0.0, 0.0) and measured.any():
        if exponents is None:
            seen_cosines = cosine[measured] if has_normals else None
            exponents = _core.fit_exponents(value[measured], ranges[measured], seen_cosines)
        # Where nothing was measured all three are NaN, and stay so.
        cosines = cosine.reshape(-1) if has_normals else None
        value = _core.correct_intensity(value.reshape(-1), ranges.reshape(-1), cosines, *exponents).reshape(shape)
    if fill > 0:
        wraps = core.model == "EQUIRECTANGULAR"
        filled = _core.sci_fill(inverse, limit, width=fill, wraps=wraps)
        holes = (filled > 0) & ~measured
        if source is not None and holes.any():
            at_centres = _core.sci_resample(value, offset, filled, sigma=CENTRE_SIGMA, widest=float(fill), gaps=True)
            np.copyto(value, at_centres, where=holes)
            filled[holes & ~np.isfinite(value)] = 0.0
    else:
        filled = inverse
    depth = np.full(shape, np.nan, np.float32)
    np.divide(np.float32(1.0), filled, out=depth, where=filled > 0)
    grey = _core.stretch_by_rank(value.reshape(-1), 2**bits - 1).reshape(shape)
    return SCI(
        view=view,
        intensity=grey.astype(np.uint8) if bits == 8 else grey,
        raw=value,
        depth=depth,
        index=index,
        subpixel=offset,
        measured=measured,
        colour=colour,
        normals=normals,
        exponents=exponents or (0.0, 0.0),
        source=source,
    )


def draw_points(cloud: PointCloud, view: View, *, splat: int = 1) -> tuple[Float32Array, Float32Array]:
    """The plain picture of a cloud: each point a square of ``splat`` pixels (odd, 7 at most), the nearest in front.

    For a quick look, and for what other programs' depth pictures are for: no surface is made of the points, so that far
    ones shine through gaps, and the intensity is as the scanner gave it. :func:`render_sci` does the rest.

    Returns depth (H, W), in the cloud's unit, and intensity (H, W), or the luminance where there is none, or 0; NaN
    where no point is. Raises InvalidInputError.
    """
    values = _values(cloud, "intensity" if cloud.intensity is not None else "colour")
    if values is None:
        values = np.zeros(len(cloud), np.float32)
    if splat == 1:
        return _core.sci_picture(view.core, cloud.xyz, values)
    buffer = _core.IndexBuffer(view.core)
    buffer.add(cloud.xyz)
    return buffer.draw(values, splat=splat)


def points_of(sci: SCI, cloud: PointCloud, pixels: npt.NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """The points behind measured pixels (M, 2: column, row) and their true places in the SCI.

    Returns world coordinates (M, 3) and pixel positions (M, 2). Raises InvalidInputError for a pixel without a point.
    """
    columns, rows = pixels[:, 0], pixels[:, 1]
    index = sci.index[rows, columns]
    if (index < 0).any():
        raise InvalidInputError(f"{int((index < 0).sum())} of {len(index)} pixels have no measured point")
    return cloud.xyz[index], pixels.astype(np.float64) + sci.subpixel[rows, columns].astype(np.float64)


def with_size(view: View, width: int, height: int) -> View:
    """The same view of a picture resized to ``width`` x ``height`` pixels: its borders, not its centres, stay."""
    from dataclasses import replace

    camera = view.camera
    if camera is None or view.pose is None:
        if view.dlt is None or view.size is None:
            raise InvalidInputError(f"view {view.name!r}: the size of its photo is not known; give `size`")
        sx, sy = width / view.size[0], height / view.size[1]
        scale = np.array([[sx, 0, 0.5 * (sx - 1)], [0, sy, 0.5 * (sy - 1)], [0, 0, 1]])
        return replace(view, dlt=scale @ view.dlt, size=(width, height))
    sx, sy = width / camera.width, height / camera.height
    params: dict[str, Any] = dict(camera.params)
    if params:
        params |= {"fx": params["fx"] * sx, "fy": params["fy"] * sy}
        params |= {"cx": (params["cx"] + 0.5) * sx - 0.5, "cy": (params["cy"] + 0.5) * sy - 0.5}
    return replace(view, camera=replace(camera, width=width, height=height, params=params))
