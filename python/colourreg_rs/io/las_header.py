"""The header of a LAS file, with its variable-length records, byte for byte.

What is not understood is kept as it is: the header, the records and the bytes between them are changed only where the
new point format, the new record length or the shifted positions make it necessary.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from ..errors import FileError
from .clouds import Attribute

#: Bytes of the header, by minor version.
HEADER_SIZE = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375, 5: 393}

#: Bytes of a point record without extra bytes, by point format.
RECORD_SIZE = {0: 20, 1: 28, 2: 26, 3: 34, 4: 57, 5: 63, 6: 30, 7: 36, 8: 38, 9: 59, 10: 67}

#: Where the colour stands in a record, by point format.
RGB_OFFSET = {2: 20, 3: 28, 5: 28, 7: 30, 8: 30, 10: 30}

#: The format that holds the same and a colour: (format, where the colour is put in, how many bytes with it).
#: Format 10 has a near-infrared channel too, which stays 0.
RAISED = {0: (2, 20, 6), 1: (3, 28, 6), 4: (5, 28, 6), 6: (7, 30, 6), 9: (10, 30, 8)}

#: The first minor version that knows a format.
FIRST_VERSION = {0: 0, 1: 0, 2: 2, 3: 2, 4: 3, 5: 3, 6: 4, 7: 4, 8: 4, 9: 4, 10: 4}

#: Types of extra bytes, by number.
EXTRA_TYPES = ("", "u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8")

#: No LAS file has more bytes than this before its points; a header that says so is not believed.
_MOST_HEADER_BYTES = 1 << 28

#: Bit of the global encoding: waveforms are in a file of their own.
WAVEFORM_EXTERNAL = 0b100


@dataclass(frozen=True)
class Record:
    """A variable-length record: its own header (54 or, extended, 60 bytes) and its data.

    ``position`` is where the data of an extended record stand in the file; they are not loaded unless needed.
    """

    head: bytes
    data: bytes | None
    position: int = 0

    @property
    def extended(self) -> bool:
        """Whether it stands after the points."""
        return len(self.head) == 60

    @property
    def user(self) -> str:
        """Who defined the record."""
        return self.head[2:18].split(b"\0")[0].decode("latin-1")

    @property
    def number(self) -> int:
        """The record's number in its user's list."""
        return int.from_bytes(self.head[18:20], "little")

    @property
    def length(self) -> int:
        """Bytes of data."""
        return len(self.data) if self.data is not None else int.from_bytes(self.head[20:28], "little")

    def with_data(self, data: bytes) -> Record:
        """The same record with other data."""
        width = 8 if self.extended else 2
        return replace(
            self, head=self.head[:20] + len(data).to_bytes(width, "little") + self.head[20 + width :], data=data
        )

    @classmethod
    def new(cls, user: str, number: int, text: str, data: bytes) -> Record:
        """A new record that stands before the points."""
        return cls(struct.pack("<H16sHH32s", 0, user.encode(), number, len(data), text.encode()), data)


@dataclass(frozen=True)
class ExtraBytes:
    """A dimension of a record's extra bytes: where it stands and how it is read."""

    name: str
    offset: int
    dtype: np.dtype[Any]
    count: int = 1
    scale: tuple[float, ...] = ()
    shift: tuple[float, ...] = ()
    description: str = ""
    described: bool = True

    @property
    def size(self) -> int:
        """Bytes in a record."""
        return self.dtype.itemsize * self.count


@dataclass(frozen=True)
class LasHeader:
    """Everything that stands before the points, and the records after them."""

    raw: bytes
    vlrs: tuple[Record, ...]
    padding: bytes
    evlrs: tuple[Record, ...]
    n_points: int
    extra: tuple[ExtraBytes, ...]
    warnings: tuple[str, ...] = field(default=())

    @property
    def minor(self) -> int:
        """The minor version: 4 for LAS 1.4."""
        return self.raw[25]

    @property
    def encoding(self) -> int:
        """The global encoding bits, which LAS 1.0 and 1.1 do not have yet."""
        return self.u16(6) if self.minor >= 2 else 0

    @property
    def compressed(self) -> bool:
        """Whether the points are LAZ."""
        return bool(self.raw[104] & 0x80)

    @property
    def point_format(self) -> int:
        """0 to 10."""
        return self.raw[104] & 0x3F

    @property
    def record_length(self) -> int:
        """Bytes of a point record, with its extra bytes."""
        return self.u16(105)

    @property
    def point_offset(self) -> int:
        """Where the points begin."""
        return self.u32(96)

    @property
    def scale(self) -> tuple[float, float, float]:
        """Factors of the integer coordinates."""
        return struct.unpack_from("<3d", self.raw, 131)

    @property
    def offset(self) -> tuple[float, float, float]:
        """What is added to the scaled integers."""
        return struct.unpack_from("<3d", self.raw, 155)

    @property
    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The least and the greatest coordinates, as the header has them."""
        values = struct.unpack_from("<6d", self.raw, 179)
        return values[1::2], values[0::2]

    @property
    def waveform_start(self) -> int:
        """Where the waveform packets stand in the file, or 0."""
        return self.u64(227) if self.minor >= 3 else 0

    def u16(self, at: int) -> int:
        """An unsigned integer of two bytes."""
        return int.from_bytes(self.raw[at : at + 2], "little")

    def u32(self, at: int) -> int:
        """An unsigned integer of four bytes."""
        return int.from_bytes(self.raw[at : at + 4], "little")

    def u64(self, at: int) -> int:
        """An unsigned integer of eight bytes."""
        return int.from_bytes(self.raw[at : at + 8], "little")

    def text(self, at: int, size: int) -> str:
        """A text that ends with its first zero byte."""
        return self.raw[at : at + size].split(b"\0")[0].decode("latin-1").strip()

    def find(self, user: str, number: int) -> Record | None:
        """The first record of this kind, before or after the points."""
        for record in (*self.vlrs, *self.evlrs):
            if record.user == user and record.number == number:
                return record
        return None


def read_header(path: Path, file: IO[bytes], size: int) -> LasHeader:
    """Reads and checks the header of a file of ``size`` bytes."""
    head = file.read(227)
    if len(head) < 227:
        raise FileError(path, f"ends after {size} bytes, inside the LAS header", "the file is truncated: copy it again")
    major, minor = head[24], head[25]
    if major != 1 or minor not in HEADER_SIZE:
        raise FileError(path, f"is LAS {major}.{minor}", "LAS 1.0 to 1.5 are read")
    header_size, offset = struct.unpack_from("<HI", head, 94)
    if header_size < HEADER_SIZE[minor]:
        raise FileError(path, f"has a header of {header_size} bytes; LAS 1.{minor} has {HEADER_SIZE[minor]}", _BROKEN)
    if offset < header_size or offset > _MOST_HEADER_BYTES:
        raise FileError(path, f"says that its points begin at byte {offset:,}", _BROKEN)
    if offset > size:
        raise FileError(path, f"ends after {size:,} bytes, before its points begin at {offset:,}", _TRUNCATED)
    raw = head + file.read(header_size - 227)
    between = file.read(offset - header_size)
    if len(raw) + len(between) != offset:
        raise FileError(path, "ends inside its header", _TRUNCATED)
    warnings: list[str] = []
    wanted = struct.unpack_from("<I", raw, 100)[0]
    vlrs, used = _read_vlrs(between, wanted)
    if len(vlrs) < wanted:
        warnings.append(f"the header announces {wanted} variable-length records, only {len(vlrs)} are there")
    header = LasHeader(raw, vlrs, between[used:], (), _count(raw, minor), ())
    _check_points(path, header)
    if minor >= 4:
        header = replace(header, evlrs=_read_evlrs(path, file, size, header))
    header = replace(header, extra=_extra_dimensions(file, header, warnings))
    return replace(header, warnings=tuple(warnings))


_BROKEN = "the header is broken: export the file again"
_TRUNCATED = "the file is truncated: copy it again"


def _count(raw: bytes, minor: int) -> int:
    """The number of points; LAS 1.4 moved it, and some writers fill only the old place."""
    old = int.from_bytes(raw[107:111], "little")
    return (int.from_bytes(raw[247:255], "little") or old) if minor >= 4 else old


def _check_points(path: Path, header: LasHeader) -> None:
    form = header.point_format
    if form not in RECORD_SIZE:
        raise FileError(path, f"has point format {form}", "point formats 0 to 10 are read")
    if header.record_length < RECORD_SIZE[form]:
        problem = f"has records of {header.record_length} bytes; point format {form} takes {RECORD_SIZE[form]}"
        raise FileError(path, problem, _BROKEN)
    if header.n_points == 0:
        raise FileError(path, "holds no points", "there is nothing to work on")
    for name, values in (("scale", header.scale), ("offset", header.offset)):
        if not all(np.isfinite(values)) or (name == "scale" and 0.0 in values):
            raise FileError(path, f"has a coordinate {name} of {', '.join(f'{v:g}' for v in values)}", _BROKEN)
    reach = [abs(s) * 2**31 + abs(o) for s, o in zip(header.scale, header.offset, strict=True)]
    if not all(np.isfinite(reach)) or max(reach) > 1e30:
        raise FileError(path, f"has a coordinate scale of {max(map(abs, header.scale)):g}", _BROKEN)


def _read_vlrs(data: bytes, wanted: int) -> tuple[tuple[Record, ...], int]:
    """As many of the wanted records as fit, and how many bytes they take."""
    records: list[Record] = []
    at = 0
    while len(records) < wanted and at + 54 <= len(data):
        end = at + 54 + int.from_bytes(data[at + 20 : at + 22], "little")
        if end > len(data):
            break
        records.append(Record(data[at : at + 54], data[at + 54 : end]))
        at = end
    return tuple(records), at


def _read_evlrs(path: Path, file: IO[bytes], size: int, header: LasHeader) -> tuple[Record, ...]:
    start, wanted = struct.unpack_from("<QI", header.raw, 235)
    if not wanted:
        return ()
    if start < header.point_offset or start > size or wanted > (size - start) // 60:
        problem = f"announces {wanted} extended records at byte {start:,}, but has {size:,} bytes"
        raise FileError(path, problem, _TRUNCATED)
    records: list[Record] = []
    at = start
    for number in range(1, wanted + 1):
        file.seek(at)
        head = file.read(60)
        length = int.from_bytes(head[20:28], "little")
        if len(head) < 60 or length > size - at - 60:
            raise FileError(path, f"ends inside extended record {number} of {wanted}", _TRUNCATED)
        records.append(Record(head, None, at + 60))
        at += 60 + length
    return tuple(records)


def _extra_dimensions(file: IO[bytes], header: LasHeader, warnings: list[str]) -> tuple[ExtraBytes, ...]:
    """What the records hold beyond their format, as the file describes it; what is not described is called so."""
    at, end = RECORD_SIZE[header.point_format], header.record_length
    found: list[ExtraBytes] = []
    record = header.find("LASF_Spec", 4)
    if record is not None:
        data = load(file, record) if record.length <= 192 * 65535 else b""
        for start in range(0, len(data) - 191, 192):
            dimension = _dimension(data[start : start + 192], at)
            if at + dimension.size > end:
                warnings.append(
                    f"extra dimension {dimension.name!r} is described, but the records have no place for it"
                )
                break
            found.append(dimension)
            at += dimension.size
    if at < end:
        found.append(ExtraBytes("ExtraBytes", at, np.dtype("u1"), end - at, described=False))
        if record is not None:
            warnings.append(f"{end - at} extra bytes of each record are not described; they are kept as they are")
    return tuple(found)


def _dimension(data: bytes, at: int) -> ExtraBytes:
    kind, options = data[2], data[3]
    name = data[4:36].split(b"\0")[0].decode("utf-8", "replace")
    text = data[160:192].split(b"\0")[0].decode("utf-8", "replace")
    if kind == 0 or kind > 30:
        return ExtraBytes(name, at, np.dtype("u1"), options, description=text)
    count = (kind - 1) // 10 + 1
    dtype = np.dtype(EXTRA_TYPES[(kind - 1) % 10 + 1])
    scale = struct.unpack_from(f"<{count}d", data, 112) if options & 8 else ()
    shift = struct.unpack_from(f"<{count}d", data, 136) if options & 16 else ()
    return ExtraBytes(name, at, dtype, count, scale, shift, text)


def load(file: IO[bytes], record: Record) -> bytes:
    """The data of a record."""
    if record.data is not None:
        return record.data
    file.seek(record.position)
    return file.read(record.length)


def describe_extra(name: str, dtype: str, text: str) -> bytes:
    """The 192 bytes that describe an extra dimension of one number."""
    kind = EXTRA_TYPES.index(dtype)
    return struct.pack("<2xBB32s4x72x48x32s", kind, 0, name.encode()[:32], text.encode()[:32])


def describe_unknown(count: int) -> bytes:
    """Descriptions of bytes that nobody described.

    The count stands where other types have their option bits, and some readers look at those all the same: counts that
    would set the bits of scale and offset are avoided by describing the bytes in several pieces.
    """
    sizes: list[int] = []
    while count:
        sizes.append(next(size for size in range(min(count, 255), 0, -1) if not size & 0x18))
        count -= sizes[-1]
    numbers = [""] if len(sizes) == 1 else [f"_{i}" for i in range(len(sizes))]
    return b"".join(
        struct.pack("<2xBB32s4x72x48x32s", 0, size, f"ExtraBytes{number}".encode(), b"not described by the source")
        for size, number in zip(sizes, numbers, strict=True)
    )


def attributes(header: LasHeader) -> tuple[Attribute, ...]:
    """All dimensions beyond coordinates, intensity and colour, by the names that laspy gives them."""
    fields = [Attribute(name, np.dtype(kind)) for name, _, _, kind in _FIELDS_6 if header.point_format >= 6] or [
        Attribute(name, np.dtype(kind)) for name, _, _, kind in _FIELDS_0
    ]
    fields += [Attribute(name, np.dtype(kind)) for name, _, kind in _plain_fields(header.point_format)]
    for extra in header.extra:
        dtype = np.dtype("f8") if extra.scale or extra.shift else extra.dtype
        names = [extra.name] if extra.count == 1 else [f"{extra.name}_{i}" for i in range(extra.count)]
        fields += [Attribute(name, dtype, extra.description) for name in names]
    return tuple(fields)


def column(header: LasHeader, records: np.ndarray[Any, Any], name: str) -> np.ndarray[Any, Any]:
    """One dimension of :func:`attributes` out of (N, length) bytes of records."""
    for field_name, at, (shift, bits), kind in _FIELDS_6 if header.point_format >= 6 else _FIELDS_0:
        if field_name == name:
            values = records[:, at]
            return ((values >> shift) & ((1 << bits) - 1)).view(kind) if bits < 8 else values.copy().view(kind)
    for field_name, at, kind in _plain_fields(header.point_format):
        if field_name == name:
            return take(records, at, kind)
    for extra in header.extra:
        for i in range(extra.count):
            if name == (extra.name if extra.count == 1 else f"{extra.name}_{i}"):
                values = take(records, extra.offset + i * extra.dtype.itemsize, extra.dtype)
                if extra.scale or extra.shift:
                    values = values * (extra.scale[i] if extra.scale else 1.0) + (
                        extra.shift[i] if extra.shift else 0.0
                    )
                return values
    raise KeyError(name)


def take(records: np.ndarray[Any, Any], at: int, kind: Any) -> np.ndarray[Any, Any]:
    """The values at byte ``at`` of each record, as an array of their own."""
    dtype = np.dtype(kind)
    whole = records.shape[1]
    view = np.dtype({"names": ["v"], "formats": [dtype], "offsets": [at], "itemsize": whole})
    return np.ascontiguousarray(records.view(view)["v"][:, 0])


_Bits = tuple[int, int]

#: Single bytes and bit fields: name, byte, (first bit, number of bits), type.
_FIELDS_0: tuple[tuple[str, int, _Bits, str], ...] = (
    ("return_number", 14, (0, 3), "u1"),
    ("number_of_returns", 14, (3, 3), "u1"),
    ("scan_direction_flag", 14, (6, 1), "u1"),
    ("edge_of_flight_line", 14, (7, 1), "u1"),
    ("classification", 15, (0, 5), "u1"),
    ("synthetic", 15, (5, 1), "u1"),
    ("key_point", 15, (6, 1), "u1"),
    ("withheld", 15, (7, 1), "u1"),
    ("scan_angle_rank", 16, (0, 8), "i1"),
    ("user_data", 17, (0, 8), "u1"),
)
_FIELDS_6: tuple[tuple[str, int, _Bits, str], ...] = (
    ("return_number", 14, (0, 4), "u1"),
    ("number_of_returns", 14, (4, 4), "u1"),
    ("synthetic", 15, (0, 1), "u1"),
    ("key_point", 15, (1, 1), "u1"),
    ("withheld", 15, (2, 1), "u1"),
    ("overlap", 15, (3, 1), "u1"),
    ("scanner_channel", 15, (4, 2), "u1"),
    ("scan_direction_flag", 15, (6, 1), "u1"),
    ("edge_of_flight_line", 15, (7, 1), "u1"),
    ("classification", 16, (0, 8), "u1"),
    ("user_data", 17, (0, 8), "u1"),
)


def _plain_fields(form: int) -> tuple[tuple[str, int, str], ...]:
    """Fields of whole numbers of bytes: name, place, type."""
    fields: list[tuple[str, int, str]] = (
        [("scan_angle", 18, "<i2"), ("point_source_id", 20, "<u2"), ("gps_time", 22, "<f8")]
        if form >= 6
        else [("point_source_id", 18, "<u2")]
    )
    if form in (1, 3, 4, 5):
        fields.append(("gps_time", 20, "<f8"))
    if form in (8, 10):
        fields.append(("nir", 36, "<u2"))
    wave = {4: 28, 5: 34, 9: 30, 10: 38}.get(form)
    if wave is not None:
        kinds = ("u1", "<u8", "<u4", "<f4", "<f4", "<f4", "<f4")
        names = ("index", "offset", "size")
        titles = [*(f"wavepacket_{n}" for n in names), "return_point_wave_location", "x_t", "y_t", "z_t"]
        for name, kind in zip(titles, kinds, strict=True):
            fields.append((name, wave, kind))
            wave += np.dtype(kind).itemsize
    return tuple(fields)
