"""LAS and LAZ made of the points of another format."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .. import __version__
from ..errors import FileError, InvalidInputError
from .atomic import not_written
from .clouds import AnyArray, CloudChunk, CloudReader, Extent, MemoryReader
from .las_header import EXTRA_TYPES, RECORD_SIZE, ExtraBytes, LasHeader, Record, attributes, describe_extra
from .las_write import LasOutput

_INTENSITY = "intensity_original"


class LasConverter(LasOutput):
    """A LAS 1.4 or LAZ file of point format 6 or 7 with every column of the input as an extra dimension."""

    def __init__(self, path: Path, like: CloudReader, compressed: bool) -> None:
        if like.lists:
            raise FileError(
                path, f"LAS cannot hold the lists {', '.join(like.lists)}", "give the output the suffix .ply"
            )
        extent = like.extent()
        if extent.invalid:
            problem = f"LAS cannot hold {extent.invalid:,} points of {like.path.name} that have no coordinates (NaN)"
            raise FileError(path, problem, "give the output the suffix .ply")
        self._like = like
        self._intensity_range = _intensity_range(like)
        self._step, self._origin = choose_step(path, extent)
        header, known = self._header_of(path, extent)
        sources = () if isinstance(like, MemoryReader) else (like.path,)
        super().__init__(path, header, known, compressed, sources)
        self.warnings = (
            *like.warnings,
            *(f"LAS has no place for {what}: left out" for what in like.unconverted),
            f"coordinates are rounded to steps of {self._step:g}",
        )

    def _header_of(self, path: Path, extent: Extent) -> tuple[LasHeader, bytes]:
        """A header that says what the columns are, as if there were such a file."""
        like = self._like
        form = 7 if like.has_rgb else 6
        first = next(iter(like.chunks(1)))
        columns: list[tuple[str, np.dtype[np.generic], str]] = []
        if self._intensity_range is not None and first.intensity is not None:
            columns.append((_INTENSITY, first.intensity.dtype, "as in the source"))
        if first.normals is not None:
            columns += [(name, first.normals.dtype, "") for name in ("NormalX", "NormalY", "NormalZ")]
        columns += [(a.name, a.dtype, a.description) for a in like.attributes]
        standard = {"x", "y", "z", "intensity", "red", "green", "blue", "nir"}
        standard |= {a.name.lower() for a in attributes(_bare(form))}
        at = RECORD_SIZE[form]
        extra: list[ExtraBytes] = []
        known = b""
        self._columns: dict[str, ExtraBytes] = {}
        for name, dtype, text in columns:
            kind = _las_kind(dtype)
            title = _title(name, standard | {e.name.lower() for e in extra})
            dimension = ExtraBytes(title, at, np.dtype(kind), description=text)
            extra.append(dimension)
            self._columns[name] = dimension
            known += describe_extra(title, kind, text)
            at += dimension.size
        if len(known) > 0xFFFF or at > 0xFFFF:
            raise FileError(path, f"LAS cannot hold {len(columns)} attributes", "give the output the suffix .ply")
        vlrs = [Record.new("LASF_Spec", 4, "Extra bytes", known)] if known else []
        if like.crs_wkt:
            wkt = like.crs_wkt.encode() + b"\0"
            if len(wkt) <= 0xFFFF:
                vlrs.append(Record.new("LASF_Projection", 2112, "OGC WKT", wkt))
        raw = bytearray(375)
        raw[0:4] = b"LASF"
        raw[6] = 0x10  # the coordinate reference system, if any, is WKT
        raw[24:26] = bytes((1, 4))
        raw[26:35] = b"colourreg"
        raw[58:90] = f"colourreg {__version__}".encode()[:31].ljust(32, b"\0")
        struct.pack_into("<HII", raw, 94, 375, 375, len(vlrs))
        raw[104] = form
        struct.pack_into("<H", raw, 105, at)
        struct.pack_into("<3d", raw, 131, self._step, self._step, self._step)
        struct.pack_into("<3d", raw, 155, *self._origin)
        low, high = (
            np.rint((v - self._origin) / self._step) * self._step + self._origin for v in (extent.low, extent.high)
        )
        struct.pack_into("<6d", raw, 179, high[0], low[0], high[1], low[1], high[2], low[2])
        struct.pack_into("<Q", raw, 247, like.n_points)
        struct.pack_into("<Q", raw, 255, like.n_points)  # every point is the first return of one
        return LasHeader(bytes(raw), tuple(vlrs), b"", (), like.n_points, tuple(extra)), known

    def write(
        self,
        chunk: CloudChunk,
        rgb: npt.NDArray[np.uint16] | None = None,
        source: npt.NDArray[np.uint16] | None = None,
        sigma: npt.NDArray[np.float32] | None = None,
    ) -> None:
        try:
            self.write_records(lambda: self._records(chunk), len(chunk), chunk.start, rgb, source, sigma)
        except OSError as error:
            raise not_written(self.path, error) from error

    def _records(self, chunk: CloudChunk) -> npt.NDArray[np.uint8]:
        fields: list[tuple[str, str, int]] = [("xyz", "(3,)<i4", 0), ("intensity", "<u2", 12), ("returns", "u1", 14)]
        if self._like.has_rgb:
            fields.append(("rgb", "(3,)<u2", 30))
        fields += [(f"+{name}", d.dtype.str, d.offset) for name, d in self._columns.items()]
        names, formats, offsets = zip(*fields, strict=True)
        length = self._header.record_length
        dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": length})
        records = np.zeros((len(chunk), length), np.uint8)
        rows = records.view(dtype)[:, 0]
        rows["xyz"] = np.rint((chunk.xyz - self._origin) / self._step)
        rows["returns"] = 0x11
        intensity = chunk.intensity
        if intensity is not None:
            rows["intensity"] = self._stretched(intensity)
            if _INTENSITY in self._columns:
                rows[f"+{_INTENSITY}"] = intensity
        if self._like.has_rgb:
            rows["rgb"] = chunk.rgb
        if (normals := chunk.normals) is not None:
            for i, name in enumerate(("NormalX", "NormalY", "NormalZ")):
                rows[f"+{name}"] = normals[:, i]
        for name, values in chunk.columns().items():
            rows[f"+{name}"] = values
        return records

    def _stretched(self, intensity: AnyArray) -> AnyArray:
        """Intensities in 16 bits: as they are, or the range of all of them stretched to what LAS can hold."""
        if self._intensity_range is None:
            return intensity
        low, high = self._intensity_range
        scaled = (np.nan_to_num(intensity.astype(np.float64), nan=low) - low) * (
            65535 / (high - low) if high > low else 0
        )
        return np.clip(np.rint(scaled), 0, 65535).astype(np.uint16)


def choose_step(path: Path, extent: Extent) -> tuple[float, AnyArray]:
    """The coordinates' step and origin: 1e-5, finer for clouds below 10 units, coarser where 32 bits ask for it."""
    size = float((extent.high - extent.low).max())
    largest = float(np.abs([extent.low, extent.high]).max())
    if not math.isfinite(size) or largest > 1e15:
        raise FileError(path, f"LAS cannot hold coordinates up to {largest:g}", "give the output the suffix .ply")
    exponent = -5
    if 0 < size < 10:
        exponent = max(math.floor(math.log10(size)) - 6, -12)
    while size / 10.0**exponent > 4e9:
        exponent += 1
    # A step below the spacing of float64 there would be a pretence.
    while largest and 10.0**exponent < np.spacing(largest):
        exponent += 1
    step = float(f"1e{exponent}")
    middle = (extent.low + extent.high) / 2
    unit = 10.0 ** max(0, math.floor(math.log10(size)) if size > 0 else 0)
    origin = np.round(middle / unit) * unit
    if (np.abs(np.stack([extent.low, extent.high]) - origin).max() / step) >= 2**31 - 1:
        origin = middle
    return step, origin


def _intensity_range(like: CloudReader) -> tuple[float, float] | None:
    """``None`` where intensities fit into 16 bits as they are, else their least and greatest."""
    if not like.has_intensity:
        return None
    low, high = math.inf, -math.inf
    for chunk in like.chunks():
        values = chunk.intensity
        if values is None or values.dtype in (np.uint8, np.uint16):
            return None
        finite = values[np.isfinite(values)]
        if len(finite):
            low, high = min(low, float(finite.min())), max(high, float(finite.max()))
    return (low, high) if high >= low else (0.0, 0.0)


def _las_kind(dtype: np.dtype[np.generic]) -> str:
    kind = {"b1": "u1", "u1": "u1", "i1": "i1", "f2": "<f4"}.get(dtype.str[1:], "<" + dtype.str[1:])
    if kind not in EXTRA_TYPES:
        raise InvalidInputError(f"LAS has no type for {dtype}")
    return kind


def _title(name: str, taken: set[str]) -> str:
    """A name of at most 32 bytes that nothing else has."""
    base = name.encode("utf-8", "replace")[:32].decode("utf-8", "ignore").strip() or "attribute"
    title, number = base, 1
    while title.lower() in taken:
        number += 1
        title = f"{base[:28]}_{number}"
    return title


def _bare(form: int) -> LasHeader:
    raw = bytearray(227)
    raw[104] = form
    struct.pack_into("<H", raw, 105, RECORD_SIZE[form])
    return LasHeader(bytes(raw), (), b"", (), 1, ())
