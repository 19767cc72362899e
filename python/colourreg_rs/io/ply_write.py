"""Writing PLY: the input's own rows with the colour put in, or rows made of another format's columns."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import __version__, _core
from ..errors import FileError, InvalidInputError
from .atomic import AtomicFile, not_written
from .clouds import (
    SIGMA_NAME,
    SIGMA_TYPE,
    SOURCE_NAME,
    SOURCE_TYPE,
    AnyArray,
    CloudChunk,
    CloudReader,
    CloudWriter,
    MemoryReader,
)
from .las_write import column_bytes
from .ply import CRS_COMMENT, FixedRows, ListRows, PlyChunk, PlyReader, Rows, TextRows
from .ply_header import NAMES

_COPY = 1 << 24
_COLOUR = ("red", "green", "blue")


@dataclass(frozen=True)
class Put:
    """New values of a property: its name, its type in the output, and whether it is there already."""

    name: str
    kind: str
    exists: bool


class PlyOutput(CloudWriter):
    """The part that both writers share: order of the chunks, types of the arrays, the file."""

    def __init__(self, path: Path, like: CloudReader) -> None:
        self.path = path
        self._like = like
        self._given: tuple[bool, bool, bool] | None = None
        self._written = 0
        self._out = AtomicFile(path, () if isinstance(like, MemoryReader) else (like.path,))
        self._file = self._out.file

    def write(
        self,
        chunk: CloudChunk,
        rgb: npt.NDArray[np.uint16] | None = None,
        source: npt.NDArray[np.uint16] | None = None,
        sigma: npt.NDArray[np.float32] | None = None,
    ) -> None:
        n = len(chunk)
        column_bytes(rgb, "rgb", n, "<u2", 3)
        column_bytes(source, "source", n, SOURCE_TYPE, 1)
        column_bytes(sigma, "sigma", n, SIGMA_TYPE, 1)
        if chunk.start != self._written:
            raise InvalidInputError(f"points from {chunk.start:,} were given, those from {self._written:,} are next")
        given = (rgb is not None, source is not None, sigma is not None)
        if self._given not in (None, given):
            raise InvalidInputError("rgb, source and sigma must be given for all chunks of a cloud or for none")
        try:
            if self._given is None:
                self._given = given
                self.begin(given)
            self.put(chunk, rgb, source, sigma)
        except OSError as error:
            raise not_written(self.path, error) from error
        self._written += n

    def begin(self, given: tuple[bool, bool, bool]) -> None:
        """Writes the header."""
        raise NotImplementedError

    def put(self, chunk: CloudChunk, rgb: AnyArray | None, source: AnyArray | None, sigma: AnyArray | None) -> None:
        """Writes the rows of a chunk."""
        raise NotImplementedError

    def finish(self) -> None:
        """Writes what follows the points."""

    def close(self) -> None:
        if self._written != self._like.n_points:
            raise InvalidInputError(f"{self._written:,} of {self._like.n_points:,} points were written")
        try:
            self.finish()
        except OSError as error:
            raise not_written(self.path, error) from error
        self._out.commit()

    def discard(self) -> None:
        self._out.discard()


class PlyWriter(PlyOutput):
    """A PLY file with the points of another one, in the same encoding, every other element as it is.

    New colours have the type that the file's colours had, else ``uchar``, which every viewer reads; what was there
    stays where it is, what is new stands at the end of the row.
    """

    def __init__(self, path: Path, like: PlyReader) -> None:
        super().__init__(path, like)
        self.warnings = like.warnings
        self._source: PlyReader = like
        self._puts: list[Put] = []

    def _plan(self, given: tuple[bool, bool, bool]) -> None:
        vertex = self._source.vertex
        have = {p.name: p for p in vertex.properties}
        names: list[tuple[str, str]] = []
        if given[0]:
            if self._source.colours is not None:
                names += [(name, have[name].kind) for name in self._source.colours]
            else:
                names += [(name, "u1") for name in _COLOUR]
        names += [(SOURCE_NAME, "u2")] * given[1] + [(SIGMA_NAME, "f4")] * given[2]
        for name, kind in names:
            old = have.get(name)
            self._puts.append(Put(name, kind, old is not None and not old.counted and old.kind == kind))

    def begin(self, given: tuple[bool, bool, bool]) -> None:
        self._plan(given)
        header = self._source.header
        lines = list(header.lines)
        first = next(i for i, line in enumerate(lines) if line.split()[:2] == ["element", "vertex"])
        last = first
        renamed = {put.name for put in self._puts if not put.exists}
        for i in range(first + 1, len(lines)):
            words = lines[i].split()
            if words[:1] in (["element"], ["end_header"]):
                break
            if words[:1] == ["property"]:
                last = i
                if words[-1] in renamed:  # the same name for something else: it stays, under another name
                    lines[i] = lines[i].rstrip() + "_before"
        lines[last + 1 : last + 1] = [f"property {NAMES[put.kind]} {put.name}" for put in self._puts if not put.exists]
        self._file.write((header.newline.join(lines) + header.newline).encode("utf-8", "surrogateescape"))
        self._copy(header.size, self._source.start - header.size)

    def put(self, chunk: CloudChunk, rgb: AnyArray | None, source: AnyArray | None, sigma: AnyArray | None) -> None:
        if not isinstance(chunk, PlyChunk) or not chunk.is_of(self._source):
            raise InvalidInputError("the chunk is not of the cloud that this output was made for")
        values: list[AnyArray] = []
        if rgb is not None:
            scale = self._source.colour_scale if self._source.colours is not None else 256.0
            values += [_colour(rgb[:, i], put.kind, scale) for i, put in enumerate(self._puts[:3])]
        values += [column for column in (source, sigma) if column is not None]
        rows: Rows = chunk.record
        puts = list(zip(self._puts, values, strict=True))
        if isinstance(rows, FixedRows):
            self._put_fixed(rows, puts)
        elif isinstance(rows, ListRows):
            self._put_lists(rows, puts)
        elif isinstance(rows, TextRows):
            self._put_text(rows, puts)

    def _put_fixed(self, rows: FixedRows, puts: list[tuple[Put, AnyArray]]) -> None:
        n, length = rows.data.shape
        columns: list[tuple[int, npt.NDArray[np.uint8]]] = []
        end = length
        for put, values in puts:
            data = np.ascontiguousarray(values, dtype=rows.order + put.kind).view(np.uint8).reshape(n, -1)
            columns.append((rows.offset(put.name) if put.exists else end, data))
            end += 0 if put.exists else data.shape[1]
        out = np.empty((n, end), np.uint8)
        _core.patch_records(rows.data, length, 0, columns, out)
        self._file.write(out.data)

    def _put_lists(self, rows: ListRows, puts: list[tuple[Put, AnyArray]]) -> None:
        kinds = [np.dtype(rows.order + put.kind) for put, _ in puts]
        data = [np.ascontiguousarray(v, dtype=k).tobytes() for (_, v), k in zip(puts, kinds, strict=True)]
        for i, row in enumerate(rows.data):
            made = bytearray(row)
            for (put, _), kind, column in zip(puts, kinds, data, strict=True):
                value = column[i * kind.itemsize : (i + 1) * kind.itemsize]
                if put.exists:
                    at = rows.offset(row, put.name)
                    made[at : at + kind.itemsize] = value
                else:
                    made += value
            self._file.write(made)

    def _put_text(self, rows: TextRows, puts: list[tuple[Put, AnyArray]]) -> None:
        newline = self._source.header.newline.encode()
        added = [_words(values, put.kind) for put, values in puts if not put.exists]
        replaced = [(put.name, _words(values, put.kind)) for put, values in puts if put.exists]
        tails = [b" ".join(words) for words in zip(*added, strict=True)] if added else []
        out: list[bytes] = []
        for i, line in enumerate(rows.lines):
            if replaced:
                parts = line.split()
                for name, words in replaced:
                    parts[self._word(parts, name)] = words[i]
                line = b" ".join(parts)
            out.append(line.strip() + (b" " + tails[i] if tails else b""))
        self._file.write(newline.join(out) + newline)

    def _word(self, parts: list[bytes], name: str) -> int:
        """Which word of a row a property is."""
        at = 0
        for p in self._source.vertex.properties:
            if p.name == name:
                return at
            at += 1 + (int(parts[at]) if p.counted else 0)
        raise KeyError(name)

    def finish(self) -> None:
        self._copy(self._source.end, self._source.size - self._source.end)

    def _copy(self, start: int, size: int) -> None:
        with self._source.open() as file:
            file.seek(start)
            while size > 0:
                data = file.read(min(size, _COPY))
                if not data:
                    raise FileError(self._source.path, "became shorter meanwhile", "start again with a file at rest")
                self._file.write(data)
                size -= len(data)


class PlyConverter(PlyOutput):
    """A binary PLY file of the points of another format: coordinates in double, every column as a property."""

    def __init__(self, path: Path, like: CloudReader) -> None:
        if like.lists:
            raise FileError(path, f"PLY cannot hold {', '.join(like.lists)}", None)
        super().__init__(path, like)
        self.warnings = (
            *like.warnings,
            *(f"PLY has no place for {what}: left out" for what in like.unconverted),
            *(["colours are written as bytes, as most PLY viewers want them"] if like.has_rgb else []),
        )
        self._names: dict[str, str] = {}
        self._dtype = np.dtype([])

    def begin(self, given: tuple[bool, bool, bool]) -> None:
        like = self._like
        first = next(iter(like.chunks(1)))
        fields: list[tuple[str, str]] = [("x", "f8"), ("y", "f8"), ("z", "f8")]
        if first.normals is not None:
            fields += [(name, _ply_kind(first.normals.dtype)) for name in ("nx", "ny", "nz")]
        if first.intensity is not None:
            fields.append(("intensity", _ply_kind(first.intensity.dtype)))
        if given[0] or like.has_rgb:
            fields += [(name, "u1") for name in _COLOUR]
        skipped = {name for name, wanted in ((SOURCE_NAME, given[1]), (SIGMA_NAME, given[2])) if wanted}
        taken = {name for name, _ in fields} | skipped
        for attribute in like.attributes:
            if attribute.name in skipped:
                continue
            name = base = re.sub(r"[^!-~]+", "_", attribute.name).strip("_") or "attribute"
            number = 1
            while name in taken:
                number += 1
                name = f"{base}_{number}"
            taken.add(name)
            self._names[attribute.name] = name
            fields.append((name, _ply_kind(attribute.dtype)))
        fields += [(SOURCE_NAME, "u2")] if given[1] else []
        fields += [(SIGMA_NAME, "f4")] if given[2] else []
        self._dtype = np.dtype([(name, "<" + kind) for name, kind in fields])
        lines = ["ply", "format binary_little_endian 1.0", f"comment written by colourreg {__version__}"]
        if like.crs_wkt:
            lines.append(f"comment {CRS_COMMENT}{' '.join(like.crs_wkt.split())}")
        lines += [f"obj_info {line}" for line in getattr(like, "remarks", ())]
        lines.append(f"element vertex {like.n_points}")
        lines += [f"property {NAMES[kind]} {name}" for name, kind in fields]
        self._file.write(("\n".join(lines) + "\nend_header\n").encode("utf-8"))

    def put(self, chunk: CloudChunk, rgb: AnyArray | None, source: AnyArray | None, sigma: AnyArray | None) -> None:
        rows = np.zeros(len(chunk), self._dtype)
        for i, axis in enumerate("xyz"):
            rows[axis] = chunk.xyz[:, i]
        if (normals := chunk.normals) is not None:
            for i, name in enumerate(("nx", "ny", "nz")):
                rows[name] = normals[:, i]
        if (intensity := chunk.intensity) is not None:
            rows["intensity"] = self._narrow("intensity", intensity)
        colours = rgb if rgb is not None else chunk.rgb
        if colours is not None:
            for i, name in enumerate(_COLOUR):
                rows[name] = _colour(colours[:, i], "u1", 256.0)
        for old, values in chunk.columns().items():
            if old in self._names:
                rows[self._names[old]] = self._narrow(old, values)
        if source is not None:
            rows[SOURCE_NAME] = source
        if sigma is not None:
            rows[SIGMA_NAME] = sigma
        self._file.write(rows.view(np.uint8).data)

    def _narrow(self, name: str, values: AnyArray) -> AnyArray:
        """PLY has no 64-bit integers: they go as double, which must hold them."""
        if values.dtype.kind in "iu" and values.dtype.itemsize == 8:
            if len(values) and int(np.abs(values.astype(object)).max()) > 2**53:
                raise FileError(self.path, f"PLY cannot hold the 64-bit integers of {name}", "give the suffix .laz")
            return values.astype(np.float64)
        return values


def _ply_kind(dtype: np.dtype[Any]) -> str:
    """The PLY type that holds numbers of a numpy type."""
    own = f"{dtype.kind}{dtype.itemsize}"
    kind = {"b1": "u1", "f2": "f4", "i8": "f8", "u8": "f8"}.get(own, own)
    if kind not in NAMES:
        raise InvalidInputError(f"PLY has no type for {dtype}")
    return kind


def _colour(values: AnyArray, kind: str, scale: float) -> AnyArray:
    """16-bit colours in the type and range of a file."""
    if kind == "u2" and scale == 1.0:
        return values
    scaled = values.astype(np.float64) / scale
    if kind[0] in "iu":
        limits = np.iinfo(kind)
        scaled = np.clip(np.floor(scaled + 0.5), limits.min, min(limits.max, 255 if scale == 256.0 else 65535))
    return scaled.astype(kind)


def _words(values: AnyArray, kind: str) -> list[bytes]:
    """Numbers as text that gives the same number when it is read."""
    if kind[0] in "iu":
        return [b"%d" % v for v in values.tolist()]
    digits = "%.9g" if kind == "f4" else "%.17g"
    return [(digits % v).encode() for v in values.tolist()]
