"""Reading PLY: text and both binary orders, any properties."""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
import numpy.typing as npt

from ..errors import FileError
from .atomic import open_binary, reason, reopen
from .clouds import CHUNK_SIZE, PIECE, AnyArray, Attribute, CloudChunk, CloudReader
from .las_header import take
from .ply_header import Element, PlyHeader, Property, read_header, row_of_text, skip_element

#: Names that say what a property is.
COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
INTENSITIES = ("intensity", "Intensity", "scalar_intensity", "scalar_Intensity", "reflectance", "scalar_reflectance")

#: A comment of ours that keeps the coordinate reference system, for which PLY has no place.
CRS_COMMENT = "crs_wkt: "

#: Rows of text that are parsed at a time.
_ROWS = 65536


class PlyReader(CloudReader):
    """An open PLY file whose element ``vertex`` holds the points."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = open_binary(path)
        try:
            self.size = os.fstat(self._file.fileno()).st_size
            self.header: PlyHeader = read_header(path, self._file)
            self._find_points()
        except OSError as error:
            self._file.close()
            raise FileError(path, f"cannot be read: {reason(error)}", None) from error
        except BaseException:
            self._file.close()
            raise
        names = {p.name for p in self.vertex.properties if not p.counted}
        self.colours = next((c for c in COLOURS if names.issuperset(c)), None)
        self.normal_names = next((n for n in NORMALS if names.issuperset(n)), None)
        self.intensity_name = next((i for i in INTENSITIES if i in names), None)
        self.has_rgb = self.colours is not None
        self.has_normals = self.normal_names is not None
        self.has_intensity = self.intensity_name is not None
        self.lists = tuple(p.name for p in self.vertex.properties if p.counted)
        self.unconverted = tuple(
            f"{e.count:,} rows of {e.name!r}" for e in self.header.elements if e.name != "vertex" and e.count
        )

    def _find_points(self) -> None:
        """Walks over the file once, so that whatever is missing is missed now."""
        header = self.header
        vertex = next((e for e in header.elements if e.name == "vertex"), None)
        if vertex is None:
            raise FileError(self.path, "has no element 'vertex'", "clouds are read from that element")
        self.vertex: Element = vertex
        names = [p.name for p in vertex.properties if not p.counted]
        missing = [name for name in "xyz" if name not in names]
        if missing:
            raise FileError(self.path, f"has points without {' and '.join(missing)}", "points need x, y and z")
        self.n_points = vertex.count
        if not self.n_points:
            raise FileError(self.path, "holds no points", "there is nothing to work on")
        self.start = self.end = header.size
        for element in header.elements:
            if element is vertex:
                self.start = self._file.tell()
            if element is not vertex or not header.text:
                skip_element(self.path, self._file, self.size, header, element)
            else:
                self._skip_lines()
            if element is vertex:
                self.end = self._file.tell()

    def _skip_lines(self) -> None:
        """The points of a text file are parsed when they are asked for; here they are counted."""
        left = self.n_points
        if self.size - self.start < 2 * left - 1:
            problem = f"announces {left:,} points, but has only {self.size - self.start:,} bytes for them"
            raise FileError(self.path, problem, "the file is truncated: copy it again")
        while left:
            lines = sum(1 for line in itertools.islice(self._file, min(left, _ROWS)) if line.strip())
            if not lines and not self._file.peek(1)[:1]:
                problem = f"announces {self.n_points:,} points, but holds only {self.n_points - left:,}"
                raise FileError(self.path, problem, "the file is truncated: copy it again")
            left -= lines

    @property
    def format(self) -> str:
        return "PLY " + {"": "text", "<": "binary, little endian", ">": "binary, big endian"}[self.header.order]

    @property
    def crs_wkt(self) -> str | None:
        for comment in self.header.comments:
            if comment.startswith(CRS_COMMENT):
                return comment[len(CRS_COMMENT) :].strip() or None
        return None

    @cached_property
    def attributes(self) -> tuple[Attribute, ...]:
        known = {"x", "y", "z", *(self.colours or ()), *(self.normal_names or ()), self.intensity_name}
        return tuple(
            Attribute(p.name, np.dtype(p.kind)) for p in self.vertex.properties if not p.counted and p.name not in known
        )

    @cached_property
    def colour_scale(self) -> float:
        """What the file's colours are multiplied with to have 16 bits.

        Bytes by 256, 16-bit integers by 1. Of other types the first points tell: numbers up to 1, up to 255, or more.
        """
        kinds = {p.kind for p in self.vertex.properties if p.name in (self.colours or ())}
        if kinds <= {"u1", "i1"}:
            return 256.0
        if kinds == {"u2"}:
            return 1.0
        chunk = next(iter(self.chunks(100_000)))
        highest = max((float(np.nanmax(chunk.column(name))) for name in self.colours or ()), default=0.0)
        if highest <= 1 and "f" in {k[0] for k in kinds}:
            return 65535.0
        return 256.0 if highest <= 255 else 1.0

    def description(self) -> dict[str, Any]:
        found = super().description()
        found["elements"] = [{"name": e.name, "rows": e.count} for e in self.header.elements]
        found["comments"] = [c for c in self.header.comments if not c.startswith(CRS_COMMENT)]
        if self.lists:
            found["lists"] = list(self.lists)
        return found

    def rgb_bits(self) -> int | None:
        return 8 if self.colour_scale == 256.0 else 16

    def chunks(self, size: int = CHUNK_SIZE, positions_only: bool = False) -> Iterator[PlyChunk]:
        size = min(max(1, int(size)), PIECE)
        start = 0
        try:
            with reopen(self.path, self._file) as file:
                file.seek(self.start)
                while start < self.n_points:
                    count = min(size, self.n_points - start)
                    rows = self._text_rows(file, count, start) if self.header.text else self._rows(file, count, start)
                    yield PlyChunk(self, start, rows)
                    start += count
        except OSError as error:
            raise FileError(self.path, f"cannot be read: {reason(error)}", None) from error

    def _rows(self, file: IO[bytes], count: int, start: int) -> Rows:
        """Binary rows; where they differ in length, each on its own."""
        order, vertex = self.header.order, self.vertex
        if not vertex.has_lists:
            data = np.fromfile(file, np.uint8, count * vertex.least)
            if len(data) < count * vertex.least:
                raise FileError(self.path, f"ends after {start:,} points", "did somebody change it meanwhile?")
            return FixedRows(vertex, order, data.reshape(count, -1))
        data_rows: list[bytes] = []
        for _ in range(count):
            row = b""
            for p in vertex.properties:
                width, repeat = np.dtype(p.counted or p.kind).itemsize, 1
                head = file.read(width)
                row += head
                if p.counted:
                    repeat = int(np.frombuffer(head, order + p.counted)[0])
                    row += file.read(repeat * np.dtype(p.kind).itemsize)
            data_rows.append(row)
        return ListRows(vertex, order, data_rows)

    def _text_rows(self, file: IO[bytes], count: int, start: int) -> TextRows:
        lines: list[bytes] = []
        values: list[npt.NDArray[np.float64]] = []
        while len(lines) < count:
            part = [line for line in itertools.islice(file, min(_ROWS, count - len(lines))) if line.strip()]
            values.append(self._parse(part, start + len(lines)))
            lines += part
        return TextRows(self.vertex, lines, np.concatenate(values))

    def _parse(self, lines: list[bytes], start: int) -> npt.NDArray[np.float64]:
        """The numbers of rows of text, (N, number of properties that are no lists)."""
        wanted = sum(1 for p in self.vertex.properties if not p.counted)
        if not self.vertex.has_lists:
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    values = np.loadtxt((line.decode("ascii") for line in lines), np.float64, comments=None, ndmin=2)
                if values.shape == (len(lines), wanted):
                    return values
            except (ValueError, UnicodeDecodeError, Warning):
                pass  # row by row, to say which
        out = np.empty((len(lines), wanted))
        for i, line in enumerate(lines):
            words = row_of_text(self.path, line, self.vertex, start + i + 1)
            scalars = _scalars(self.vertex, words)
            for j, word in enumerate(scalars):
                try:
                    out[i, j] = float(word)
                except ValueError:
                    text = word.decode("latin-1")[:40]
                    raise FileError(
                        self.path, f"point {start + i + 1:,}: {text!r} is no number", "export it again"
                    ) from None
        return out

    def close(self) -> None:
        self._file.close()

    def open(self) -> IO[bytes]:
        """The file once more, with a position of its own."""
        return reopen(self.path, self._file)


class Rows:
    """Rows of the element ``vertex``."""

    vertex: Element

    def column(self, name: str) -> AnyArray:
        """One property, in its own type."""
        raise NotImplementedError

    def xyz(self) -> npt.NDArray[np.float64]:
        """(N, 3) float64."""
        return np.ascontiguousarray(np.stack([self.column(c) for c in "xyz"], axis=1), dtype=np.float64)


class FixedRows(Rows):
    """Binary rows of one length: (N, length) bytes."""

    def __init__(self, vertex: Element, order: str, data: npt.NDArray[np.uint8]) -> None:
        self.vertex, self.order, self.data = vertex, order, data

    def offset(self, name: str) -> int:
        """Where a property stands in a row."""
        at = 0
        for p in self.vertex.properties:
            if p.name == name:
                return at
            at += np.dtype(p.kind).itemsize
        raise KeyError(name)

    def column(self, name: str) -> AnyArray:
        values = take(self.data, self.offset(name), self.order + find(self.vertex, name).kind)
        return values.astype(values.dtype.newbyteorder("="), copy=False)

    def xyz(self) -> npt.NDArray[np.float64]:
        kinds = [find(self.vertex, c).kind for c in "xyz"]
        places = [self.offset(c) for c in "xyz"]
        width = np.dtype(kinds[0]).itemsize
        if len(set(kinds)) == 1 and places == [places[0], places[0] + width, places[0] + 2 * width]:
            return take(self.data, places[0], f"(3,){self.order}{kinds[0]}").astype(np.float64, copy=False)
        return super().xyz()


class ListRows(Rows):
    """Binary rows of different lengths."""

    def __init__(self, vertex: Element, order: str, data: list[bytes]) -> None:
        self.vertex, self.order, self.data = vertex, order, data

    def column(self, name: str) -> AnyArray:
        kind = np.dtype(self.order + find(self.vertex, name).kind)
        values = b"".join(row[at : at + kind.itemsize] for row in self.data for at in (self.offset(row, name),))
        return np.frombuffer(values, kind).astype(kind.newbyteorder("="))

    def offset(self, row: bytes, name: str) -> int:
        """Where a property stands in this row."""
        at = 0
        for p in self.vertex.properties:
            if p.name == name:
                return at
            if p.counted:
                width = np.dtype(p.counted).itemsize
                at += (
                    width
                    + int(np.frombuffer(row[at : at + width], self.order + p.counted)[0]) * np.dtype(p.kind).itemsize
                )
            else:
                at += np.dtype(p.kind).itemsize
        raise KeyError(name)


class TextRows(Rows):
    """Rows of text, and the numbers in them that are no lists."""

    def __init__(self, vertex: Element, lines: list[bytes], values: npt.NDArray[np.float64]) -> None:
        self.vertex, self.lines, self.values = vertex, lines, values

    def column(self, name: str) -> AnyArray:
        scalars = [p.name for p in self.vertex.properties if not p.counted]
        dtype = np.dtype(find(self.vertex, name).kind)
        values = self.values[:, scalars.index(name)]
        if dtype.kind in "iu":
            limits = np.iinfo(dtype)
            values = np.clip(np.nan_to_num(np.rint(values)), limits.min, limits.max)
        with np.errstate(over="ignore"):
            return values.astype(dtype)

    def xyz(self) -> npt.NDArray[np.float64]:
        scalars = [p.name for p in self.vertex.properties if not p.counted]
        # Coordinates keep the digits that are written, even where the header calls them float.
        return np.ascontiguousarray(self.values[:, [scalars.index(c) for c in "xyz"]])


class PlyChunk(CloudChunk):
    """Successive points of a PLY file."""

    def __init__(self, reader: PlyReader, start: int, rows: Rows) -> None:
        self.start = start
        self.record = rows
        self.xyz = rows.xyz()
        self._reader = reader

    def is_of(self, reader: PlyReader) -> bool:
        """Whether the points are of this file."""
        return reader is self._reader

    def column(self, name: str) -> AnyArray:
        """One property, in its own type."""
        return cast(Rows, self.record).column(name)

    @property
    def intensity(self) -> AnyArray | None:
        name = self._reader.intensity_name
        return None if name is None else self.column(name)

    @property
    def rgb(self) -> npt.NDArray[np.uint16] | None:
        names = self._reader.colours
        if names is None:
            return None
        values = np.stack([self.column(name) for name in names], axis=1)
        if values.dtype == np.uint16:
            return values
        if values.dtype == np.uint8:
            return values.astype(np.uint16) * np.uint16(256)
        scaled = np.rint(np.nan_to_num(values.astype(np.float64)) * self._reader.colour_scale)
        return np.clip(scaled, 0, 65535).astype(np.uint16)

    @property
    def normals(self) -> AnyArray | None:
        names = self._reader.normal_names
        return None if names is None else np.stack([self.column(name) for name in names], axis=1)

    def columns(self) -> dict[str, AnyArray]:
        return {a.name: self.column(a.name) for a in self._reader.attributes}


def find(element: Element, name: str) -> Property:
    """The property of this name."""
    return next(p for p in element.properties if p.name == name)


def _scalars(element: Element, words: list[bytes]) -> list[bytes]:
    """The words of a row that belong to no list."""
    out: list[bytes] = []
    at = 0
    for p in element.properties:
        if p.counted:
            at += 1 + int(words[at])
        else:
            out.append(words[at])
            at += 1
    return out
