"""LAZ: the compressed points of a LAS file, block by block, with lazrs as the codec.

A LAZ file holds blocks (its format calls them chunks) of some 50,000 points, each compressed on its own, and a table of
their sizes. In the newer scheme (point formats 6 to 10) a block holds one stream for every attribute, which allows two
savings: positions are decoded without the rest, and a block is recoloured by exchanging the streams of the colour
while all others go through as they are, neither decoded nor encoded.

Everything in a file that would make the codec reserve memory is checked before it sees it.
"""

from __future__ import annotations

import errno
import io
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import lazrs
import numpy as np
import numpy.typing as npt

from ..errors import FileError
from .las_header import LasHeader, Record

Bytes = npt.NDArray[np.uint8]

USER, NUMBER = "laszip encoded", 22204
WAVE13, POINT14, RGB14, RGBNIR14, WAVE14, BYTE14 = 9, 10, 11, 12, 13, 14
POSITIONS = int(lazrs.SELECTIVE_DECOMPRESS_XY_RETURNS_CHANNEL | lazrs.SELECTIVE_DECOMPRESS_Z)
POSITIONS_AND_COLOUR = POSITIONS | int(lazrs.SELECTIVE_DECOMPRESS_RGB)
EVERYTHING = int(lazrs.SELECTIVE_DECOMPRESS_ALL)

_POINTWISE, _CHUNKED, _LAYERED = 1, 2, 3
_VARIABLE = 0xFFFFFFFF
_CHANNEL = 0x30  # the bits of byte 15 of a record that hold the scanner channel
_BROKEN = "the compressed points are broken: copy the file again"


@dataclass(frozen=True)
class Item:
    """A part of the record that is compressed by a method of its own."""

    kind: int
    size: int
    version: int

    @property
    def layers(self) -> int:
        """Streams that the item has in a block of the newer scheme."""
        return {POINT14: 9, RGB14: 1, RGBNIR14: 2, WAVE14: 1, BYTE14: self.size}[self.kind]


@dataclass(frozen=True)
class Scheme:
    """The record that tells how the points are compressed."""

    data: bytes
    compressor: int
    chunk_size: int
    items: tuple[Item, ...]

    @property
    def layered(self) -> bool:
        """Whether every attribute has a stream of its own."""
        return self.compressor == _LAYERED

    @property
    def variable(self) -> bool:
        """Whether blocks differ in their number of points."""
        return self.chunk_size == _VARIABLE

    @classmethod
    def parse(cls, path: Path, header: LasHeader) -> Scheme:
        """The scheme of a compressed file."""
        record = header.find(USER, NUMBER)
        if record is None or record.data is None:
            raise FileError(path, "has compressed points, but not the record that tells how", "export it again")
        data = record.data
        if len(data) < 34 or len(data) < 34 + 6 * int.from_bytes(data[32:34], "little"):
            raise FileError(path, "has a broken record on its compression", "export it again")
        compressor, coder = struct.unpack_from("<HH", data)
        chunk_size, count = struct.unpack_from("<I", data, 12)[0], struct.unpack_from("<H", data, 32)[0]
        items = tuple(Item(*struct.unpack_from("<HHH", data, 34 + 6 * i)) for i in range(count))
        known = {0, 6, 7, 8, 9} if compressor != _LAYERED else {POINT14, RGB14, RGBNIR14, WAVE14, BYTE14}
        if compressor not in (_POINTWISE, _CHUNKED, _LAYERED) or coder != 0:
            raise FileError(path, f"is compressed by method {compressor}.{coder}", "compress it again with laszip")
        versions = (1, 2) if compressor != _LAYERED else (3, 4)
        unknown = [item for item in items if item.kind not in known or item.version not in versions]
        if unknown or sum(item.size for item in items) != header.record_length:
            raise FileError(path, "has a record on its compression that does not fit its points", "export it again")
        if any(item.size != size for item in items if (size := _SIZES.get(item.kind)) is not None):
            raise FileError(path, "has a record on its compression that does not fit its points", "export it again")
        return cls(data, compressor, chunk_size or _VARIABLE, items)

    @classmethod
    def for_points(cls, point_format: int, extra_bytes: int) -> Scheme:
        """The scheme that new files are written with."""
        data = bytes(lazrs.LazVlr.new_for_compression(point_format, extra_bytes).record_data())
        scheme = cls._of(data)
        # lazrs calls its waveform packets of formats 4 and 5 version 2, which LASzip does not know; they are version 1.
        items = tuple(replace(item, version=1) if item.kind == WAVE13 else item for item in scheme.items)
        return scheme.with_items(items)

    @classmethod
    def _of(cls, data: bytes) -> Scheme:
        compressor = struct.unpack_from("<H", data)[0]
        chunk_size, count = struct.unpack_from("<I", data, 12)[0], struct.unpack_from("<H", data, 32)[0]
        return cls(
            data,
            compressor,
            chunk_size,
            tuple(Item(*struct.unpack_from("<HHH", data, 34 + 6 * i)) for i in range(count)),
        )

    def with_items(self, items: tuple[Item, ...], chunk_size: int | None = None) -> Scheme:
        """The same scheme for other records."""
        size = self.chunk_size if chunk_size is None else chunk_size
        data = self.data[:12] + struct.pack("<I", size) + self.data[16:32] + struct.pack("<H", len(items))
        return Scheme(
            data + b"".join(struct.pack("<HHH", i.kind, i.size, i.version) for i in items), self.compressor, size, items
        )

    def record(self) -> Record:
        """The variable-length record that holds the scheme."""
        return Record.new(USER, NUMBER, "http://laszip.org", self.data)

    def codec(self) -> Any:
        """What lazrs wants to have."""
        return lazrs.LazVlr(self.data)


#: Bytes of the items whose size is fixed.
_SIZES = {6: 20, 7: 8, 8: 6, WAVE13: 29, POINT14: 30, RGB14: 6, RGBNIR14: 8, WAVE14: 29}


@contextmanager
def decoding(path: Path) -> Iterator[None]:
    """What the codec says about broken data becomes a :class:`FileError`."""
    try:
        yield
    except (lazrs.LazrsError, MemoryError, OverflowError) as error:
        raise FileError(path, f"cannot be decompressed ({error})", _BROKEN) from error
    except BaseException as error:
        if type(error).__name__ != "PanicException":  # what a Rust panic becomes; it is no Exception
            raise
        raise FileError(path, "cannot be decompressed", _BROKEN) from None


@dataclass(frozen=True)
class Block:
    """Successive blocks of one file as they are stored: number of points and of bytes for each, and the bytes."""

    table: tuple[tuple[int, int], ...]
    data: Bytes

    @property
    def n_points(self) -> int:
        """Points in all of them."""
        return sum(points for points, _ in self.table)

    def parts(self) -> Iterator[tuple[int, Bytes]]:
        """Number of points and bytes of each."""
        at = 0
        for points, size in self.table:
            yield points, self.data[at : at + size]
            at += size


class LazSource:
    """The compressed points of an open file."""

    def __init__(self, path: Path, file: IO[bytes], size: int, header: LasHeader) -> None:
        self.path = path
        self.scheme = Scheme.parse(path, header)
        self.n_points = header.n_points
        self._points_at = header.point_offset
        self.length = header.record_length
        self.table: tuple[tuple[int, int], ...] = ()
        if self.scheme.compressor != _POINTWISE:
            self.table = self._read_table(file, size)
        self.largest = max((points for points, _ in self.table), default=self.n_points)

    def _read_table(self, file: IO[bytes], size: int) -> tuple[tuple[int, int], ...]:
        start, n, chunk_size = self._points_at + 8, self.n_points, self.scheme.chunk_size
        file.seek(self._points_at)
        at = int.from_bytes(file.read(8), "little", signed=True)
        if at <= self._points_at and size >= 8:  # a writer that could not go back left it at the end
            file.seek(size - 8)
            at = int.from_bytes(file.read(8), "little", signed=True)
        if at < start or at + 8 > size:
            raise FileError(self.path, "has no table of its compressed blocks", "the file is truncated: copy it again")
        file.seek(at + 4)
        count = int.from_bytes(file.read(4), "little")
        expected = -(-n // chunk_size) if not self.scheme.variable else None
        if (expected is not None and count != expected) or count > n:
            problem = f"announces {n:,} points, but has {count:,} compressed blocks"
            if not self.scheme.variable:
                problem += f" of {chunk_size:,}"
            raise FileError(self.path, problem, "the file is truncated or broken: copy it again")
        file.seek(self._points_at)
        with decoding(self.path):
            table = [(int(p), int(b)) for p, b in lazrs.read_chunk_table(file, self.scheme.codec())]
        if not self.scheme.variable:
            table[-1] = (n - chunk_size * (count - 1), table[-1][1])
        points, held = sum(p for p, _ in table), sum(b for _, b in table)
        if points != n or held > at - start or min(b for _, b in table) < self.length:
            problem = f"announces {n:,} points in {at - start:,} bytes; its table of blocks says {points:,} in {held:,}"
            raise FileError(self.path, problem, _BROKEN)
        return tuple(table)

    def blocks(self, file: IO[bytes], size: int) -> Iterator[Block]:
        """Groups of whole blocks of together at most ``size`` points, as they are stored."""
        position, first = self._points_at + 8, 0
        while first < len(self.table):
            last, points = first, 0
            while last < len(self.table) and (last == first or points + self.table[last][0] <= size):
                points += self.table[last][0]
                last += 1
            table = self.table[first:last]
            held = sum(b for _, b in table)
            file.seek(position)
            data = np.fromfile(file, np.uint8, held)
            if len(data) < held:
                raise FileError(self.path, "ends inside its compressed points", "the file is truncated: copy it again")
            block = Block(table, data)
            if self.scheme.layered:
                self._check_layers(block)
            yield block
            position, first = position + held, last

    def _check_layers(self, block: Block) -> None:
        """The codec reserves what the sizes of the streams say: they must add up to the block."""
        streams = sum(item.layers for item in self.scheme.items)
        head = self.length + 4 + 4 * streams
        for points, part in block.parts():
            if len(part) >= head:
                stored, *sizes = struct.unpack_from(f"<{streams + 1}I", part.data, self.length)
                if stored == points and sum(sizes) + head == len(part):
                    continue
            raise FileError(self.path, "holds a compressed block whose sizes do not add up", _BROKEN)

    def decode(self, block: Block, selection: int = EVERYTHING) -> Bytes:
        """(N, length) bytes of records; what is not selected has any value."""
        records = np.empty((block.n_points, self.length), np.uint8)
        with decoding(self.path):
            lazrs.decompress_points_with_chunk_table(
                block.data, self.scheme.data, records, list(block.table), lazrs.DecompressionSelection(selection)
            )
        return records

    def stream(self, file: IO[bytes], size: int, selection: int) -> Iterator[Bytes]:
        """Records in order, ``size`` at a time, on one core: for blocks larger than a chunk may be."""
        if self.scheme.layered:
            for points, _ in self.table:
                if points > 1 << 28:
                    raise FileError(self.path, f"has a compressed block of {points:,} points", "compress it again")
        file.seek(self._points_at)
        with decoding(self.path):
            source = lazrs.LasZipDecompressor(file, self.scheme.data, lazrs.DecompressionSelection(selection))
        left = self.n_points
        while left:
            records = np.empty((min(size, left), self.length), np.uint8)
            with decoding(self.path):
                source.decompress_many(records.reshape(-1))
            yield records
            left -= len(records)


class Splicer:
    """Makes recoloured blocks out of stored ones: the streams of colour and of added bytes are new, the rest is copied.

    ``rgb`` tells that there are new colours, ``added`` where in the new record bytes are written or appended: (place
    among the extra bytes, number of bytes) each.
    """

    def __init__(self, scheme: Scheme, rgb: bool, added: list[tuple[int, int]]) -> None:
        self.old = scheme
        self._rgb = rgb
        self._added = added
        items = list(scheme.items)
        version = items[0].version
        kinds = [item.kind for item in items]
        if rgb and RGB14 not in kinds and RGBNIR14 not in kinds:
            items.insert(1, Item(RGBNIR14, 8, version) if WAVE14 in kinds else Item(RGB14, 6, version))
        if added:
            end = max(at + size for at, size in added)
            if items[-1].kind == BYTE14:
                items[-1] = Item(BYTE14, max(items[-1].size, end), items[-1].version)
            else:
                items.append(Item(BYTE14, end, version))
        self.scheme = scheme.with_items(tuple(items))
        self._colour = next((i for i in items if i.kind in (RGB14, RGBNIR14)), None) if rgb else None
        width = sum(size for _, size in added)
        parts = ((self._colour,) if self._colour else ()) + ((Item(BYTE14, width, version),) if width else ())
        self._patch = scheme.with_items(parts)
        self._patch_with_channels = scheme.with_items((Item(POINT14, 30, version), *parts))
        self.patched_colour_size = self._colour.size if self._colour else 0

    def splice(self, block: Block, records: Bytes, values: Bytes) -> Block:
        """The blocks with new values.

        Args:
            block: as stored.
            records: their decoded records, positions at least.
            values: (N, k) bytes: colour (6, or 8 with the infrared) and the added bytes, in the order they were given.
        """
        patch = self._patch
        if not _one_channel_each(records, block.table):
            # The codec keeps a state for each channel of a scanner: it must see which point is of which.
            patch = self._patch_with_channels
            points = np.zeros((len(records), 30), np.uint8)
            points[:, 15] = records[:, 15] & _CHANNEL
            values = np.concatenate([points, values], axis=1)
        patches = compress(patch, values, block.table)
        made = [
            self._join(old, points, _take_apart(patch.items, new))
            for (points, old), (_, new) in zip(block.parts(), patches.parts(), strict=True)
        ]
        table = tuple((points, len(part)) for (points, _), part in zip(block.table, made, strict=True))
        return Block(table, np.frombuffer(b"".join(made), np.uint8))

    def _join(self, old: Bytes, points: int, new: tuple[dict[int, bytes], dict[int, list[bytes]]]) -> bytes:
        """One block: first point, number of points, sizes of the streams, streams."""
        first, streams = _take_apart(self.old.items, old)
        new_first, new_streams = new
        out_first: list[bytes] = []
        out_streams: list[bytes] = []
        for item in self.scheme.items:
            if item is self._colour:
                kept = streams.get(item.kind)
                layers = new_streams[item.kind]
                if item.kind == RGBNIR14 and kept is not None:
                    out_first.append(new_first[item.kind][:6] + first[item.kind][6:])
                    out_streams += [layers[0], kept[1]]
                else:
                    out_first.append(new_first[item.kind])
                    out_streams += layers
            elif item.kind == BYTE14 and self._added:
                head = bytearray(first.get(BYTE14, b"").ljust(item.size, b"\0"))
                layers = streams.get(BYTE14, []) + [b""] * (item.size - len(streams.get(BYTE14, [])))
                taken = 0
                for place, size in self._added:
                    head[place : place + size] = new_first[BYTE14][taken : taken + size]
                    layers[place : place + size] = new_streams[BYTE14][taken : taken + size]
                    taken += size
                out_first.append(bytes(head))
                out_streams += layers
            else:
                out_first.append(first[item.kind])
                out_streams += streams[item.kind]
        sizes = struct.pack(f"<{len(out_streams) + 1}I", points, *map(len, out_streams))
        return b"".join((*out_first, sizes, *out_streams))


def _one_channel_each(records: Bytes, table: tuple[tuple[int, int], ...]) -> bool:
    """Whether each block holds points of one scanner channel only."""
    channel = records[:, 15] & _CHANNEL
    ends = np.cumsum([points for points, _ in table])
    return all(bool((part == part[0]).all()) for part in np.split(channel, ends[:-1]))


def _take_apart(items: tuple[Item, ...], block: Bytes) -> tuple[dict[int, bytes], dict[int, list[bytes]]]:
    """First point and streams of a stored block, by kind of item."""
    data = block.tobytes()
    first: dict[int, bytes] = {}
    at = 0
    for item in items:
        first[item.kind] = data[at : at + item.size]
        at += item.size
    count = sum(item.layers for item in items)
    sizes = iter(struct.unpack_from(f"<{count}I", data, at + 4))
    at += 4 + 4 * count
    streams: dict[int, list[bytes]] = {}
    for item in items:
        layers = []
        for _ in range(item.layers):
            size = next(sizes)
            layers.append(data[at : at + size])
            at += size
        streams[item.kind] = layers
    return first, streams


def compress(scheme: Scheme, records: Bytes, table: tuple[tuple[int, int], ...]) -> Block:
    """Compresses rows in blocks of the same numbers of points as ``table`` has."""
    sizes = [points for points, _ in table]
    even = len(set(sizes[:-1])) <= 1 and sizes[-1] <= sizes[0]
    variable = scheme.with_items(scheme.items, _VARIABLE)
    if even:
        fixed = scheme.with_items(scheme.items, sizes[0])
        out = lazrs.compress_points(fixed.codec(), records.reshape(-1), True)
        made = lazrs.read_chunk_table(io.BytesIO(out), fixed.codec())
        data = np.frombuffer(out, np.uint8)
    else:
        target = io.BytesIO()
        compressor = lazrs.ParLasZipCompressor(target, variable.codec())
        ends = np.cumsum(sizes)
        compressor.compress_chunks([records[end - n : end].reshape(-1) for n, end in zip(sizes, ends, strict=True)])
        compressor.done()
        target.seek(0)
        made = lazrs.read_chunk_table(target, variable.codec())
        data = np.frombuffer(target.getbuffer(), np.uint8)
    held = [int(b) for _, b in made]
    return Block(tuple(zip(sizes, held, strict=True)), data[8 : 8 + sum(held)])


@contextmanager
def _writing() -> Iterator[None]:
    """The codec says only that it could not write; the disk is what ever keeps it from it."""
    try:
        yield
    except lazrs.LazrsError as error:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error


class LazSink:
    """Compressed points on their way into a file whose header is already written."""

    def __init__(self, path: Path, file: IO[bytes], scheme: Scheme, splice: bool) -> None:
        self._path = path
        self._waveforms = any(item.kind == WAVE14 for item in scheme.items)
        self._channel: int | None = None
        self._file = file
        self._scheme = scheme
        self._start = file.tell()
        self._compressor: Any = None
        self._table: list[tuple[int, int]] = []
        if splice:
            file.write(bytes(8))
        else:
            file.flush()  # here, as the codec does not say what kept it from writing
            self._compressor = lazrs.ParLasZipCompressor(file, scheme.codec())
            with _writing():
                self._compressor.reserve_offset_to_chunk_table()

    def write(self, records: Bytes) -> None:
        """Compresses and appends records."""
        if self._waveforms:
            self._refuse_channels(records)
        with _writing():
            self._compressor.compress_many(records.reshape(-1))

    def _refuse_channels(self, records: Bytes) -> None:
        """lazrs 0.8 spoils the waveform packets (point formats 9 and 10) of points of more than one scanner channel."""
        channels = records[:, 15] & _CHANNEL
        if self._channel is None:
            self._channel = int(channels[0])
        if (channels != self._channel).any():
            problem = "waveform packets of several scanner channels cannot be compressed without loss"
            raise FileError(self._path, problem, "give the output the suffix .las")

    def write_block(self, block: Block) -> None:
        """Appends blocks that are compressed already."""
        self._file.write(block.data.data)
        self._table += block.table

    def done(self) -> None:
        """Writes the table of blocks; the file then stands at its end."""
        with _writing():
            if self._compressor is not None:
                self._compressor.done()
                self._file.seek(0, io.SEEK_END)
                return
            at = self._file.tell()
            lazrs.write_chunk_table(self._file, self._table, self._scheme.codec())
            self._file.seek(self._start)
            self._file.write(at.to_bytes(8, "little"))
            self._file.seek(0, io.SEEK_END)
