"""The header of a PLY file, and how long its elements are."""

from __future__ import annotations

import itertools
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from ..errors import FileError

#: PLY's names of the number types, both generations of them.
TYPES = {
    **{
        "char": "i1",
        "uchar": "u1",
        "short": "i2",
        "ushort": "u2",
        "int": "i4",
        "uint": "u4",
        "float": "f4",
        "double": "f8",
    },
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float32": "f4", "float64": "f8"},
}
#: The names to write, by kind and size.
NAMES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}

#: No header is longer.
_MOST_HEADER_BYTES = 1 << 20
_TRUNCATED = "the file is truncated: copy it again"
_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}


@dataclass(frozen=True)
class Property:
    """One number of an element, or a list of them when ``counted`` is the type of the list's length."""

    name: str
    kind: str
    counted: str | None = None


@dataclass(frozen=True)
class Element:
    """A table of the file: so many rows of the same properties."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """Whether rows differ in length."""
        return any(p.counted for p in self.properties)

    @property
    def least(self) -> int:
        """Bytes of a row whose lists are empty."""
        return sum(np.dtype(p.counted or p.kind).itemsize for p in self.properties)

    def dtype(self, order: str, lengths: tuple[int, ...] = ()) -> np.dtype[Any]:
        """The rows as numpy has them, for lists of the given lengths; fields are numbered."""
        fields: list[Any] = []
        left = iter(lengths)
        for i, p in enumerate(self.properties):
            if p.counted:
                fields += [(f"n{i}", order + p.counted), (f"p{i}", order + p.kind, (next(left),))]
            else:
                fields.append((f"p{i}", order + p.kind))
        return np.dtype(fields)


@dataclass(frozen=True)
class PlyHeader:
    """The header: its lines as they are, and what they say."""

    lines: tuple[str, ...]
    newline: str
    order: str  # "<", ">" or "" for text
    elements: tuple[Element, ...]
    size: int

    @property
    def text(self) -> bool:
        """Whether the numbers are written out."""
        return self.order == ""

    @property
    def comments(self) -> tuple[str, ...]:
        """What follows the word ``comment``."""
        found = (line[8:].strip() for line in self.lines if line.startswith("comment "))
        return tuple(c.encode("utf-8", "surrogateescape").decode("utf-8", "replace") for c in found)


def read_header(path: Path, file: IO[bytes]) -> PlyHeader:
    """Reads the header; the file then stands at the first element."""
    head = file.read(_MOST_HEADER_BYTES)
    end = head.find(b"end_header")
    while end > 0 and head[end - 1 : end] not in (b"\n", b"\r"):
        end = head.find(b"end_header", end + 1)
    if end <= 0:
        raise FileError(path, "has a PLY header that does not end", _TRUNCATED)
    newline = "\r\n" if b"\r\n" in head[:end] else "\r" if b"\n" not in head[:end] else "\n"
    stop = head.find(newline.encode(), end)
    if stop < 0:
        raise FileError(path, "ends with its header", _TRUNCATED)
    size = stop + len(newline)
    file.seek(size)
    # Bytes that are no UTF-8 survive the way in and out again.
    lines = head[:stop].decode("utf-8", "surrogateescape").split(newline)
    order: str | None = None
    elements: list[tuple[str, int, list[Property]]] = []
    for number, line in enumerate(lines[1:-1], 2):
        words = line.split()
        match words:
            case ["format", kind, *rest]:
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}.get(kind)
                if order is None or rest != ["1.0"]:
                    raise FileError(path, f"line {number}: {line.strip()!a} is not a PLY 1.0 format", "export it again")
            case ["element", name, count] if count.isdecimal() and len(count) < 16:
                elements.append((name, int(count), []))
            case ["property", "list", counted, kind, name] if elements and _whole(counted) and kind in TYPES:
                elements[-1][2].append(Property(name, TYPES[kind], TYPES[counted]))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1][2].append(Property(name, TYPES[kind]))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise FileError(path, f"line {number}: {line.strip()[:80]!a} is not understood", "export it again")
    if order is None:
        raise FileError(path, "has no line with its format", "export it again")
    if order == "" and newline == "\r":
        raise FileError(path, "has lines that end as on old Macintoshes", "convert the line ends first")
    made = tuple(Element(name, count, tuple(properties)) for name, count, properties in elements)
    for element in made:
        names = [p.name for p in element.properties]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise FileError(path, f"has two properties {twice!a} in its element {element.name!a}", "rename one of them")
    return PlyHeader(tuple(lines), newline, order, made, size)


def _whole(kind: str) -> bool:
    return TYPES.get(kind, "f4")[0] in "iu"


def skip_element(path: Path, file: IO[bytes], size: int, header: PlyHeader, element: Element) -> None:
    """Goes over all rows of an element, making sure that they are there."""
    if header.text:
        _skip_text(path, file, element)
        return
    start = file.tell()
    if not element.has_lists:
        end = start + element.count * element.least
        if end > size:
            raise _too_few(path, element, (size - start) // max(element.least, 1))
        file.seek(end)
        return
    if element.count * element.least > size - start:
        raise _too_few(path, element, (size - start) // element.least)
    done = 0
    while done < element.count:
        # Rows mostly have lists of one length: take that of the next row for all that follow, and see how far it goes.
        at = file.tell()
        lengths = _lengths_of_row(path, file, size, header, element, done)
        dtype = element.dtype(header.order, lengths)
        file.seek(at)
        wanted = min(element.count - done, max(1, (1 << 22) // dtype.itemsize))
        rows = np.fromfile(file, dtype, wanted)
        same = np.ones(len(rows), bool)
        for i, length in zip((i for i, p in enumerate(element.properties) if p.counted), lengths, strict=True):
            same &= rows[f"n{i}"] == length
        good = len(rows) if same.all() else int(np.argmin(same))
        if good == 0:
            raise _too_few(path, element, done)
        done += good
        file.seek(at + good * dtype.itemsize)


def _lengths_of_row(
    path: Path, file: IO[bytes], size: int, header: PlyHeader, element: Element, done: int
) -> tuple[int, ...]:
    lengths: list[int] = []
    for p in element.properties:
        if not p.counted:
            file.seek(np.dtype(p.kind).itemsize, 1)
            continue
        data = file.read(np.dtype(p.counted).itemsize)
        if len(data) < np.dtype(p.counted).itemsize:
            raise _too_few(path, element, done)
        length = struct.unpack((header.order or "<") + _CODES[p.counted], data)[0]
        end = file.tell() + length * np.dtype(p.kind).itemsize
        if length < 0 or end > size:
            problem = f"has a list of {length:,} values in row {done + 1:,} of its element {element.name!r}"
            raise FileError(path, problem, "the file is truncated or broken: copy it again")
        file.seek(end)
        lengths.append(length)
    return tuple(lengths)


def _skip_text(path: Path, file: IO[bytes], element: Element) -> None:
    done = 0
    while done < element.count:
        lines = [line for line in itertools.islice(file, min(65536, element.count - done)) if line.strip()]
        if not lines and not file.peek(1)[:1]:  # type: ignore[attr-defined]  # a BufferedReader
            raise _too_few(path, element, done)
        for number, line in enumerate(lines, done + 1):
            row_of_text(path, line, element, number)
        done += len(lines)


def row_of_text(path: Path, line: bytes, element: Element, number: int) -> list[bytes]:
    """The words of a row of text, after a check that its lists and numbers are all there."""
    words = line.split()
    at = 0
    for p in element.properties:
        step = 1
        if p.counted:
            if at < len(words) and not words[at].isdigit():
                raise FileError(
                    path, f"row {number:,} of {element.name!r}: {words[at].decode('latin-1')!r} is no length"
                )
            step += int(words[at]) if at < len(words) and len(words[at]) < 10 else len(words)
        at += step
    if at != len(words):
        problem = f"row {number:,} of {element.name!r} has {len(words)} numbers, not {at}"
        raise FileError(path, problem, "the file is truncated or broken: copy or export it again")
    return words


def _too_few(path: Path, element: Element, found: int) -> FileError:
    name = "points" if element.name == "vertex" else f"rows of {element.name!r}"
    return FileError(path, f"announces {element.count:,} {name}, but holds only {found:,}", _TRUNCATED)
