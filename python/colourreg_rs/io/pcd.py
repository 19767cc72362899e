"""Reading PCD: text, binary, and compressed binary; organised or not."""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from .. import _core
from ..errors import FileError, InvalidInputError
from .atomic import open_binary, reason, reopen
from .clouds import CHUNK_SIZE, PIECE, AnyArray, Attribute, CloudChunk, CloudReader

_TRUNCATED = "the file is truncated: copy it again"
_ROWS = 65536
_KINDS = {"I": "i", "U": "u", "F": "f"}
#: What fields are called, in small letters.
_POSITION = (("x", "y", "z"),)
_NORMALS = (("normal_x", "normal_y", "normal_z"), ("normalx", "normaly", "normalz"), ("nx", "ny", "nz"))
_COLOURS = (("r", "g", "b"), ("red", "green", "blue"))
_INTENSITIES = (("intensity",), ("i",), ("reflectance",), ("reflectivity",))


@dataclass(frozen=True)
class Field:
    """One field of a point: ``count`` numbers of one type, ``offset`` bytes into a binary record."""

    name: str
    dtype: np.dtype[Any]
    count: int
    offset: int

    @property
    def size(self) -> int:
        """Bytes in a record."""
        return self.dtype.itemsize * self.count


class PcdReader(CloudReader):
    """An open PCD file of version 0.6 or 0.7.

    A compressed file is one compressed block: it is decompressed as a whole, and all of it stays in memory while it is
    read. The other kinds are read piece by piece.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = open_binary(path)
        self._columns: npt.NDArray[np.uint8] | None = None
        try:
            self._size = os.fstat(self._file.fileno()).st_size
            self._read_header()
            self._check_length()
        except OSError as error:
            self._file.close()
            raise FileError(path, f"cannot be read: {reason(error)}", None) from error
        except BaseException:
            self._file.close()
            raise

    def _read_header(self) -> None:
        words = _header_words(self.path, self._file)
        self._start = self._file.tell()
        names = words["FIELDS"]
        counts = _integers(self.path, words, "COUNT", len(names), 1, 4096) if "COUNT" in words else [1] * len(names)
        sizes = _integers(self.path, words, "SIZE", len(names), 1, 8)
        kinds = words["TYPE"]
        if len(kinds) != len(names):
            raise FileError(self.path, f"names {len(names)} fields, but {len(kinds)} types", "export it again")
        fields: list[Field] = []
        offset = 0
        for name, kind, size, count in zip(names, kinds, sizes, counts, strict=True):
            code = f"{_KINDS.get(kind.upper(), '?')}{size}"
            if code not in ("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8"):
                raise FileError(
                    self.path, f"field {name!r} is of type {kind} {size}", "types are I, U, F of 1 to 8 bytes"
                )
            fields.append(Field(name, np.dtype("<" + code), count, offset))
            offset += fields[-1].size
        self.record_length = offset
        self.fields = tuple(fields)
        real = [f.name for f in fields if f.name != "_"]
        if len(set(real)) < len(real):
            raise FileError(self.path, "has two fields of one name", "rename one of them")
        self._by_name = {f.name: f for f in fields if f.name != "_"}
        position = self._names(_POSITION)
        if position is None:
            raise FileError(self.path, f"has the fields {', '.join(real)[:100]}", "points need x, y and z")
        self.position_names = position
        width = _integers(self.path, words, "WIDTH", 1, 0, 2**40)[0] if "WIDTH" in words else None
        height = _integers(self.path, words, "HEIGHT", 1, 0, 2**40)[0] if "HEIGHT" in words else 1
        points = _integers(self.path, words, "POINTS", 1, 0, 2**40)[0] if "POINTS" in words else None
        if points is None and width is None:
            raise FileError(self.path, "does not say how many points it holds", "export it again")
        self.n_points = points if points is not None else (width or 0) * height
        if width is not None and width * height != self.n_points:
            raise FileError(self.path, f"announces {self.n_points:,} points, but {width} x {height}", "export it again")
        if not self.n_points:
            raise FileError(self.path, "holds no points", "there is nothing to work on")
        self.width, self.height = width or self.n_points, height
        self.encoding = words["DATA"][0].lower() if words["DATA"] else ""
        if self.encoding not in ("ascii", "binary", "binary_compressed"):
            raise FileError(self.path, f"holds {self.encoding!r} data", "ascii, binary and binary_compressed are read")
        self.viewpoint = " ".join(words.get("VIEWPOINT", ["0", "0", "0", "1", "0", "0", "0"]))
        packed = next((f for f in fields if f.name in ("rgb", "rgba") and f.dtype.itemsize == 4 and f.count == 1), None)
        apart = self._names(_COLOURS) if packed is None else None
        if apart and {self._by_name[c].dtype.str[1:] for c in apart} not in ({"u1"}, {"u2"}):
            apart = None
        self._packed = packed
        self._apart = apart
        self.has_rgb = packed is not None or apart is not None
        self.intensity_name = (self._names(_INTENSITIES) or (None,))[0]
        self.has_intensity = self.intensity_name is not None
        self.normal_names = self._names(_NORMALS)
        self.has_normals = self.normal_names is not None
        self.remarks = (f"pcd_viewpoint {self.viewpoint}", f"pcd_width {self.width}", f"pcd_height {self.height}")

    def _names(self, wanted: tuple[tuple[str, ...], ...]) -> tuple[str, ...] | None:
        """The file's own names of the first group of fields that it has, one number each."""
        single = {f.name.lower(): f.name for f in self._by_name.values() if f.count == 1}
        found = next((group for group in wanted if all(name in single for name in group)), None)
        return None if found is None else tuple(single[name] for name in found)

    def _check_length(self) -> None:
        held = self._size - self._start
        n, length = self.n_points, self.record_length
        if self.encoding == "binary" and held < n * length:
            raise FileError(self.path, f"announces {n:,} points, but holds only {held // length:,}", _TRUNCATED)
        if self.encoding == "ascii" and held < n * len(self.fields) * 2 - 1:
            raise FileError(self.path, f"announces {n:,} points, but has only {held:,} bytes for them", _TRUNCATED)
        if self.encoding == "binary_compressed":
            head = self._file.read(8)
            packed, size = int.from_bytes(head[:4], "little"), int.from_bytes(head[4:8], "little")
            if len(head) < 8 or held - 8 < packed:
                raise FileError(self.path, f"announces {packed:,} compressed bytes, but holds {held:,}", _TRUNCATED)
            if size != n * length:
                problem = f"announces {n:,} points of {length} bytes, but {size:,} bytes of data"
                raise FileError(self.path, problem, "the header is broken: export the file again")
            self._packed_size = packed

    @property
    def format(self) -> str:
        return f"PCD {self.encoding}" + (f", {self.width} x {self.height}" if self.height > 1 else "")

    @cached_property
    def attributes(self) -> tuple[Attribute, ...]:
        known = {*self.position_names, self.intensity_name, *(self.normal_names or ()), *(self._apart or ())}
        out: list[Attribute] = []
        for f in self.fields:
            if f.name in known or f.name == "_":
                continue
            if f is self._packed:
                if f.name == "rgba":
                    out.append(Attribute("alpha", np.dtype("u1")))
                continue
            native = f.dtype.newbyteorder("=")
            out += [Attribute(f.name if f.count == 1 else f"{f.name}_{i}", native) for i in range(f.count)]
        return tuple(out)

    def description(self) -> dict[str, Any]:
        return {**super().description(), "width": self.width, "height": self.height, "viewpoint": self.viewpoint}

    def rgb_bits(self) -> int | None:
        return 8 if self._apart is None else super().rgb_bits()

    def chunks(self, size: int = CHUNK_SIZE, positions_only: bool = False) -> Iterator[PcdChunk]:
        size = min(max(1, int(size)), PIECE)
        start = 0
        try:
            with reopen(self.path, self._file) as file:
                file.seek(self._start)
                while start < self.n_points:
                    count = min(size, self.n_points - start)
                    if self.encoding == "ascii":
                        columns = self._text(file, count, start)
                    elif self.encoding == "binary":
                        columns = self._binary(file, count, start)
                    else:
                        columns = self._compressed(file, count, start)
                    yield PcdChunk(self, start, columns)
                    start += count
        except OSError as error:
            raise FileError(self.path, f"cannot be read: {reason(error)}", None) from error

    def _binary(self, file: IO[bytes], count: int, start: int) -> dict[str, AnyArray]:
        dtype = np.dtype(
            {
                "names": list(self._by_name),
                "formats": [(f.dtype, (f.count,)) for f in self._by_name.values()],
                "offsets": [f.offset for f in self._by_name.values()],
                "itemsize": self.record_length,
            }
        )
        rows = np.fromfile(file, dtype, count)
        if len(rows) < count:
            raise FileError(self.path, f"ends after {start:,} points", "did somebody change it meanwhile?")
        return {name: np.ascontiguousarray(rows[name]) for name in self._by_name}

    def _compressed(self, file: IO[bytes], count: int, start: int) -> dict[str, AnyArray]:
        if self._columns is None:
            file.seek(self._start + 8)
            data = np.fromfile(file, np.uint8, self._packed_size)
            try:
                self._columns = _core.lzf_decompress(data, self.n_points * self.record_length)
            except InvalidInputError as error:
                raise FileError(self.path, f"cannot be decompressed: {error}", "copy or export it again") from error
        columns = {}
        for f in self._by_name.values():  # the fields stand one after the other, each for all points
            first = f.offset * self.n_points + start * f.size
            part = self._columns[first : first + count * f.size]
            columns[f.name] = np.frombuffer(part.tobytes(), f.dtype).reshape(count, f.count)
        return columns

    def _text(self, file: IO[bytes], count: int, start: int) -> dict[str, AnyArray]:
        parts: list[dict[str, AnyArray]] = []
        done = 0
        while done < count:
            lines = [line for line in itertools.islice(file, min(_ROWS, count - done)) if line.strip()]
            if not lines and not file.peek(1)[:1]:  # type: ignore[attr-defined]  # a BufferedReader
                problem = f"announces {self.n_points:,} points, but holds only {start + done:,}"
                raise FileError(self.path, problem, _TRUNCATED)
            lines = [line.replace(b",", b" ") for line in lines]  # some programs put commas there
            if lines:
                parts.append(self._parse(lines, start + done))
            done += len(lines)
        return {name: np.concatenate([part[name] for part in parts]) for name in self._by_name}

    def _parse(self, lines: list[bytes], start: int) -> dict[str, AnyArray]:
        total = sum(f.count for f in self.fields)
        values: npt.NDArray[np.float64] | None = None
        wide = any(
            f.dtype.kind in "iu" and f.dtype.itemsize == 8 for f in self.fields
        )  # float64 does not hold them all
        if not wide:
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    values = np.loadtxt((line.decode("ascii") for line in lines), np.float64, comments=None, ndmin=2)
            except (ValueError, UnicodeDecodeError, Warning):
                values = None
        words: list[list[bytes]] = []
        if values is None or values.shape != (len(lines), total):
            values = np.empty((len(lines), total))
            words = [line.split() for line in lines]
            for i, row in enumerate(words):
                if len(row) != total:
                    problem = f"point {start + i + 1:,} has {len(row)} numbers, not {total}"
                    raise FileError(self.path, problem, "the file is truncated or broken: copy or export it again")
                for j, word in enumerate(row):
                    try:
                        values[i, j] = float(word)
                    except ValueError:
                        text = word.decode("latin-1")[:40]
                        problem = f"point {start + i + 1:,}: {text!r} is no number"
                        raise FileError(
                            self.path, problem, "numbers need blanks between them and a decimal point"
                        ) from None
        columns: dict[str, AnyArray] = {}
        at = 0
        for f in self.fields:
            part = values[:, at : at + f.count]
            if f.name != "_":
                columns[f.name] = self._typed(f, part, [row[at : at + f.count] for row in words])
            at += f.count
        return columns

    def _typed(self, field: Field, values: npt.NDArray[np.float64], words: list[list[bytes]]) -> AnyArray:
        """Numbers of a text in the type that the header names; coordinates keep the digits that are written."""
        if field.name in self.position_names:
            return np.ascontiguousarray(values)
        if field.dtype.kind == "f":
            with np.errstate(over="ignore"):
                return values.astype(field.dtype)
        limits = np.iinfo(field.dtype)
        if field.dtype.itemsize == 8 and words:
            return np.array([[_whole(word, limits) for word in row] for row in words], field.dtype)
        whole: AnyArray = np.clip(np.nan_to_num(np.rint(values)), limits.min, limits.max).astype(field.dtype)
        return whole

    def packed_colour(self, columns: dict[str, AnyArray]) -> npt.NDArray[np.uint32] | None:
        """The packed colour of each point, 0xAARRGGBB."""
        field = self._packed
        if field is None:
            return None
        values = columns[field.name][:, 0]
        if field.dtype.kind == "f" and self.encoding == "ascii" and len(values) and np.nanmax(values) >= 1:
            return values.astype(np.uint32)  # some writers put the integer there
        return np.ascontiguousarray(values).view(np.uint32)

    def colours(self, columns: dict[str, AnyArray]) -> npt.NDArray[np.uint16] | None:
        """(N, 3) uint16, 8-bit values times 256."""
        packed = self.packed_colour(columns)
        if packed is not None:
            channels = np.stack([(packed >> np.uint32(shift)) & np.uint32(255) for shift in (16, 8, 0)], axis=1)
            return channels.astype(np.uint16) * np.uint16(256)
        if self._apart:
            values = np.concatenate([columns[c] for c in self._apart], axis=1)
            return np.asarray(values.astype(np.uint16) * np.uint16(256 if values.dtype.itemsize == 1 else 1))
        return None

    def close(self) -> None:
        self._columns = None
        self._file.close()


class PcdChunk(CloudChunk):
    """Successive points of a PCD file."""

    def __init__(self, reader: PcdReader, start: int, columns: dict[str, AnyArray]) -> None:
        self.start = start
        self.record = columns
        self._reader = reader
        self.xyz = np.ascontiguousarray(np.concatenate([columns[c] for c in reader.position_names], axis=1), np.float64)

    @property
    def intensity(self) -> AnyArray | None:
        name = self._reader.intensity_name
        return None if name is None else _native(self.record[name][:, 0])

    @property
    def rgb(self) -> npt.NDArray[np.uint16] | None:
        return self._reader.colours(self.record)

    @property
    def normals(self) -> AnyArray | None:
        names = self._reader.normal_names
        return None if names is None else _native(np.concatenate([self.record[n] for n in names], axis=1))

    def columns(self) -> dict[str, AnyArray]:
        out: dict[str, AnyArray] = {}
        wanted = {a.name for a in self._reader.attributes}
        for name, values in self.record.items():
            for i in range(values.shape[1]):
                title = name if values.shape[1] == 1 else f"{name}_{i}"
                if title in wanted:
                    out[title] = _native(values[:, i])
        if "alpha" in wanted and "alpha" not in out:
            packed = self._reader.packed_colour(self.record)
            if packed is not None:
                out["alpha"] = (packed >> np.uint32(24)).astype(np.uint8)
        return out


def _header_words(path: Path, file: IO[bytes]) -> dict[str, list[str]]:
    """The words after each keyword, up to the line with DATA."""
    words: dict[str, list[str]] = {}
    for _ in range(1000):
        line = file.readline(1 << 20)
        if not line:
            break
        parts = line.decode("latin-1").split()
        if not parts or parts[0].startswith("#"):
            continue
        words[parts[0].upper()] = parts[1:]
        if parts[0].upper() == "DATA":
            break
    if "COLUMNS" in words:  # the name of old versions
        words.setdefault("FIELDS", words["COLUMNS"])
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "DATA") if key not in words]
    if missing:
        what = "is not a PCD file" if len(missing) == 4 else f"has a PCD header without {missing[0]}"
        raise FileError(path, what, "is it complete?")
    return words


def _integers(path: Path, words: dict[str, list[str]], key: str, count: int, low: int, high: int) -> list[int]:
    found = words[key]
    values = [int(w) for w in found if w.isdecimal() and len(w) < 16]
    if len(values) != count or len(found) != count or not all(low <= v <= high for v in values):
        text = " ".join(found)[:60]
        raise FileError(
            path, f"has a line {key} {text!r}; {count} numbers from {low} to {high} are wanted", "export it again"
        )
    return values


def _whole(word: bytes, limits: np.iinfo[Any]) -> int:
    try:
        return min(max(int(word), int(limits.min)), int(limits.max))
    except ValueError:
        return 0


def _native(values: AnyArray) -> AnyArray:
    return np.ascontiguousarray(values).astype(values.dtype.newbyteorder("="), copy=False)
