"""Reading LAS and LAZ: records as bytes, coordinates out of them, the rest when it is asked for."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterator
from functools import cached_property
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import _core
from ..errors import FileError
from . import laz
from .atomic import open_binary, reason, reopen
from .clouds import CHUNK_SIZE, PIECE, AnyArray, Attribute, CloudChunk, CloudReader, Extent
from .las_header import (
    RAISED,
    RGB_OFFSET,
    WAVEFORM_EXTERNAL,
    Record,
    attributes,
    column,
    load,
    read_header,
    take,
)
from .pool import Pool

#: Points that are looked at to see whether the header's bounds can be believed.
_LOOK = 50_000

_NORMALS = (("NormalX", "NormalY", "NormalZ"), ("normal_x", "normal_y", "normal_z"), ("nx", "ny", "nz"))


class LasReader(CloudReader):
    """An open LAS or LAZ file of version 1.0 to 1.5 and any point format."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = open_binary(path)
        self._lock = threading.Lock()  # each iteration over the points has a file of its own, what else is read has not
        try:
            self._size = os.fstat(self._file.fileno()).st_size
            self.header = read_header(path, self._file, self._size)
            self.laz = laz.LazSource(path, self._file, self._size, self.header) if self.header.compressed else None
            if self.laz is None:
                self._check_length()
        except OSError as error:
            self._file.close()
            raise FileError(path, f"cannot be read: {reason(error)}", None) from error
        except BaseException:
            self._file.close()
            raise
        header = self.header
        self.n_points = header.n_points
        self.has_rgb = header.point_format in RGB_OFFSET
        self.has_intensity = True
        names = {extra.name for extra in header.extra if extra.count == 1}
        self._normals = next((n for n in _NORMALS if names.issuperset(n)), None)
        self.has_normals = self._normals is not None
        self.is_copc = any(record.user == "copc" for record in header.vlrs)
        self.warnings = (*header.warnings, *self._remarks())

    def _check_length(self) -> None:
        header = self.header
        held = (self._size - header.point_offset) // header.record_length
        if held < header.n_points:
            problem = f"announces {header.n_points:,} points, but holds only {held:,}"
            raise FileError(
                self.path, problem, "the file is truncated or its header is broken: copy or export it again"
            )

    def _remarks(self) -> Iterator[str]:
        header = self.header
        if self.is_copc:
            yield "COPC: an output is written as plain LAZ, without the index, which would no longer fit"
        if header.encoding & WAVEFORM_EXTERNAL and header.point_format in (4, 5, 9, 10):
            name = self.path.with_suffix(".wdp").name
            yield f"waveforms are in a file of their own: copy {name} beside an output, under the output's name"
        if header.minor < 2 and header.point_format in RAISED:
            yield f"LAS 1.{header.minor} has no colours: an output is written as LAS 1.2"

    @property
    def format(self) -> str:
        header = self.header
        family = "LAZ" if header.compressed else "LAS"
        return f"{family} 1.{header.minor}, point format {header.point_format}" + (" (COPC)" if self.is_copc else "")

    @cached_property
    def crs_wkt(self) -> str | None:  # cached, as pyproj takes its time
        record = self.header.find("LASF_Projection", 2112)
        if record is not None and record.length < 1 << 24:
            text = self.load(record).split(b"\0")[0].decode("utf-8", "replace").strip()
            if re.match(r"[A-Za-z_]+\s*\[", text):  # some writers leave quotes or a word there
                return text
        keys = self.header.find("LASF_Projection", 34735)
        return _wkt_of_keys(keys.data) if keys is not None and keys.data else None

    @property
    def attributes(self) -> tuple[Attribute, ...]:
        return tuple(a for a in attributes(self.header) if a.name not in (self._normals or ()))

    def description(self) -> dict[str, Any]:
        header = self.header
        low, high = header.bounds
        found = super().description()
        found["bounds"] = [list(low), list(high)] if np.isfinite([*low, *high]).all() else None
        found["scale"], found["offset"] = list(header.scale), list(header.offset)
        found["system"], found["software"] = header.text(26, 32), header.text(58, 32)
        found["records"] = [
            {"user": r.user, "number": r.number, "bytes": r.length, "after_points": r.extended}
            for r in (*header.vlrs, *header.evlrs)
        ]
        if found["crs_wkt"] is None and header.find("LASF_Projection", 34735):
            found["warnings"].append("the coordinate reference system is given by GeoTIFF keys that name no EPSG code")
        if found["rgb_bits"] == 8:
            found["warnings"].append("colours are 8-bit values; LAS wants them times 256: viewers may show them black")
        return found

    def told_extent(self) -> Extent | None:
        low, high = (np.array(values) for values in self.header.bounds)
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
            return None
        first = next(iter(self.chunks(_LOOK, positions_only=True)))
        # Some writers leave the bounds of another file, or of nothing; others round them to a step of the coordinates.
        step = np.abs(self.header.scale)
        if (first.xyz < low - step).any() or (first.xyz > high + step).any():
            return None
        # Nor is a box believed that the points could not fill: it would hide what is far outside.
        reach = np.abs(self.header.scale) * 2.0**31
        offset = np.array(self.header.offset)
        if (low < offset - reach - step).any() or (high > offset + reach + step).any():
            return None
        return Extent(low, high, 0)

    def chunks(self, size: int = CHUNK_SIZE, positions_only: bool = False) -> Iterator[CloudChunk]:
        size = max(1, int(size))
        try:
            with reopen(self.path, self._file) as file:
                yield from self._chunks(file, size, positions_only)
        except OSError as error:
            raise FileError(self.path, f"cannot be read: {reason(error)}", None) from error

    def _chunks(self, file: BufferedReader, size: int, positions_only: bool) -> Iterator[LasChunk]:
        start, pool = 0, Pool()
        if self.laz is None:
            length = self.header.record_length
            size = min(size, PIECE)
            file.seek(self.header.point_offset)
            while start < self.n_points:
                records = pool.array((min(size, self.n_points - start), length), np.uint8)
                got = file.readinto(records.data)
                if got < records.nbytes:
                    problem = f"ends after {start + got // length:,} points"
                    raise FileError(self.path, problem, "did somebody change it meanwhile?")
                yield LasChunk(self, start, records, None, pool=pool)
                start += len(records)
                del records  # a chunk that nobody keeps gives its memory to the next
        elif self.laz.largest <= size and self.laz.table:
            layered = self.laz.scheme.layered
            # Enough blocks to keep all processors busy until the last of them.
            size = min(size, max(PIECE, self.laz.largest * max(8, 4 * (os.cpu_count() or 1))))
            selection = laz.POSITIONS if positions_only else laz.POSITIONS_AND_COLOUR
            for block in self.laz.blocks(file, size):
                if layered:
                    yield LasChunk(self, start, self.laz.decode(block, selection), block, selection, pool=pool)
                else:
                    yield LasChunk(self, start, self.laz.decode(block), block, pool=pool)
                start += block.n_points
        else:
            selection = laz.POSITIONS if positions_only else laz.EVERYTHING
            for records in self.laz.stream(file, size, selection):
                yield LasChunk(self, start, records, None, pool=pool)
                start += len(records)

    def close(self) -> None:
        self._file.close()

    def read_at(self, position: int, size: int) -> bytes:
        """Bytes of the file, as they are."""
        with self._lock:
            self._file.seek(position)
            data = self._file.read(size)
        if len(data) < size:
            raise FileError(self.path, f"ends inside the {size:,} bytes at {position:,}", "copy the file again")
        return data

    def load(self, record: Record) -> bytes:
        """The data of a variable-length record."""
        with self._lock:
            return load(self._file, record)

    @property
    def points_end(self) -> int:
        """Where the points of an uncompressed file end."""
        return self.header.point_offset + self.n_points * self.header.record_length

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self._size


class LasChunk(CloudChunk):
    """Successive point records; of a LAZ file, with the compressed blocks that they came from."""

    def __init__(
        self,
        reader: LasReader,
        start: int,
        records: npt.NDArray[np.uint8],
        block: laz.Block | None,
        selection: int = laz.EVERYTHING,
        *,
        pool: Pool,
    ) -> None:
        header = reader.header
        self.start = start
        self.record = (records, block)
        self.positions = records
        self.block = block
        self.xyz = pool.array((len(records), 3), np.float64)
        _core.scaled_xyz(records, np.array(header.scale), np.array(header.offset), self.xyz)
        self._reader = reader
        self._complete = selection == laz.EVERYTHING
        self._coloured = selection in (laz.EVERYTHING, laz.POSITIONS_AND_COLOUR)

    @cached_property
    def records(self) -> npt.NDArray[np.uint8]:
        """(N, length) bytes, all of them decoded."""
        if self._complete or self.block is None or self._reader.laz is None:
            return self.positions
        return self._reader.laz.decode(self.block)

    def is_of(self, reader: LasReader) -> bool:
        """Whether the points are of this file."""
        return reader is self._reader

    def layered_scheme(self) -> laz.Scheme | None:
        """How the blocks are compressed, where each attribute has a stream of its own."""
        source = self._reader.laz
        return source.scheme if source is not None and source.scheme.layered and self.block is not None else None

    @property
    def intensity(self) -> AnyArray | None:
        return take(self.records, 12, "<u2")

    @property
    def rgb(self) -> npt.NDArray[np.uint16] | None:
        at = RGB_OFFSET.get(self._reader.header.point_format)
        if at is None:
            return None
        return take(self.positions if self._coloured else self.records, at, "(3,)<u2")

    @property
    def normals(self) -> AnyArray | None:
        names = self._reader._normals
        header = self._reader.header
        return None if names is None else np.stack([column(header, self.records, n) for n in names], axis=1)

    def columns(self) -> dict[str, AnyArray]:
        header, records = self._reader.header, self.records
        return {a.name: column(header, records, a.name) for a in self._reader.attributes}


def _wkt_of_keys(data: bytes) -> str | None:
    """WKT for the EPSG code that GeoTIFF keys name, or ``None``."""
    import logging

    from laspy.vlrs.known import GeoKeyDirectoryVlr

    logging.getLogger("laspy").setLevel(logging.ERROR)
    try:
        keys = GeoKeyDirectoryVlr()
        keys.parse_record_data(data)
        crs = keys.parse_crs()
        return None if crs is None else str(crs.to_wkt())
    except Exception:
        return None
