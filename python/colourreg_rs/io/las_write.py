"""Writing LAS and LAZ: the input's records with the colour put in, everything else byte for byte."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .. import _core
from ..errors import FileError, InvalidInputError
from . import laz
from .atomic import AtomicFile, not_written
from .clouds import (
    SIGMA_NAME,
    SIGMA_TEXT,
    SIGMA_TYPE,
    SOURCE_NAME,
    SOURCE_TEXT,
    SOURCE_TYPE,
    AnyArray,
    CloudChunk,
    CloudWriter,
)
from .direct import DirectWriter
from .las import LasChunk, LasReader
from .las_header import (
    FIRST_VERSION,
    RAISED,
    RECORD_SIZE,
    RGB_OFFSET,
    LasHeader,
    Record,
    describe_extra,
    describe_unknown,
)

Bytes = npt.NDArray[np.uint8]

#: Bytes of the file copied at a time.
_COPY = 1 << 24


@dataclass(frozen=True)
class Layout:
    """What becomes of a record: where bytes are opened, and where the new values go."""

    point_format: int
    split: int
    gap: int
    length: int
    rgb: int | None
    source: int | None
    sigma: int | None
    descriptions: bytes | None

    @classmethod
    def plan(cls, header: LasHeader, known: bytes, rgb: bool, source: bool, sigma: bool) -> Layout:
        """The layout for adding what is asked for; ``known`` is the file's own description of its extra bytes."""
        form, split, gap = header.point_format, header.record_length, 0
        if rgb and form in RAISED:
            form, split, gap = RAISED[form]
        length = header.record_length + gap
        places: dict[str, int | None] = {SOURCE_NAME: None, SIGMA_NAME: None}
        described = [extra for extra in header.extra if extra.described]
        blocks = [known[i : i + 192] for i in range(0, 192 * len(described), 192)]
        blocks = [b for b in blocks if len(b) == 192]
        unknown = (
            header.record_length - RECORD_SIZE[header.point_format] - sum(e.size for e in described[: len(blocks)])
        )
        added = b""
        wanted = [(SOURCE_NAME, SOURCE_TYPE, SOURCE_TEXT)] * source + [(SIGMA_NAME, SIGMA_TYPE, SIGMA_TEXT)] * sigma
        for name, kind, text in wanted:
            for i, extra in enumerate(described[: len(blocks)]):
                if extra.name != name:
                    continue
                if extra.dtype == np.dtype(kind) and extra.count == 1 and not (extra.scale or extra.shift):
                    places[name] = extra.offset + gap
                else:  # the same name for something else: it stays, under another name
                    blocks[i] = blocks[i][:4] + f"{name}_before".encode().ljust(32, b"\0") + blocks[i][36:]
            if places[name] is None:
                places[name] = length
                length += np.dtype(kind).itemsize
                added += describe_extra(name, kind, text)
        changed = bool(added) or b"".join(blocks) != known[: 192 * len(blocks)]
        descriptions = b"".join(blocks) + describe_unknown(unknown) + added if changed else None
        where = RGB_OFFSET[form] if rgb else None
        return cls(form, split, gap, length, where, places[SOURCE_NAME], places[SIGMA_NAME], descriptions)


class LasOutput(CloudWriter):
    """Header, records and what follows them, in a file that appears when it is complete."""

    def __init__(
        self, path: Path, header: LasHeader, known: bytes, compressed: bool, sources: tuple[Path, ...]
    ) -> None:
        if path.name.lower().endswith(".copc.laz"):
            raise FileError(path, "COPC is read but not written", "name the output .laz")
        self.path = path
        self._header = header
        self._known = known
        self._compressed = compressed
        self._out = AtomicFile(path, sources)
        self._file = self._out.file
        self._layout: Layout | None = None
        self._given: tuple[bool, bool, bool] | None = None
        self._written = 0
        self._sink: laz.LazSink | None = None
        self._splicer: laz.Splicer | None = None
        self._scheme: laz.Scheme | None = None
        self._splicing = False
        self._direct: DirectWriter | None = None
        self._new_header = b""

    def write_records(
        self,
        records: Callable[[], Bytes],
        n: int,
        start: int,
        rgb: AnyArray | None,
        source: AnyArray | None,
        sigma: AnyArray | None,
        chunk: LasChunk | None = None,
    ) -> None:
        """Appends the records of a chunk with the new values put in."""
        if start != self._written:
            raise InvalidInputError(f"points from {start:,} were given, those from {self._written:,} are next")
        given = (rgb is not None, source is not None, sigma is not None)
        if self._layout is None:
            self._begin(given, chunk)
        elif given != self._given:
            raise InvalidInputError("rgb, source and sigma must be given for all chunks of a cloud or for none")
        if self._splicing and (chunk is None or chunk.block is None):
            raise InvalidInputError("the chunks of one output must come from one iteration over its input")
        layout = self._layout
        assert layout is not None
        columns = [
            (at, values)
            for at, values in (
                (layout.rgb, column_bytes(rgb, "rgb", n, "<u2", 3)),
                (layout.source, column_bytes(source, "source", n, SOURCE_TYPE, 1)),
                (layout.sigma, column_bytes(sigma, "sigma", n, SIGMA_TYPE, 1)),
            )
            if at is not None and values is not None
        ]
        if self._splicing and chunk is not None and chunk.block is not None:
            self._write_block(chunk, chunk.block, columns)
        elif self._direct is not None:
            patch = partial(_core.patch_records, records(), layout.split, layout.gap, columns)
            self._direct.append(n * layout.length, lambda space: patch(space.reshape(n, layout.length)))
        elif self._sink is not None:
            patched = np.empty((n, layout.length), np.uint8)
            _core.patch_records(records(), layout.split, layout.gap, columns, patched)
            self._sink.write(patched)
        self._written += n

    def _write_block(self, chunk: LasChunk, block: laz.Block, columns: list[tuple[int, Bytes]]) -> None:
        assert self._sink is not None and self._scheme is not None
        if not columns:
            self._sink.write_block(block)
            return
        assert self._splicer is not None
        parts = [values for _, values in columns]
        layout = self._layout
        if layout is not None and layout.rgb is not None and self._splicer.patched_colour_size == 8:
            parts.insert(
                1, np.zeros((len(chunk), 2), np.uint8)
            )  # the infrared, which is not exchanged where there is one
        first, *others = parts
        ends = np.cumsum([first.shape[1], *(part.shape[1] for part in others)]).tolist()
        values = np.empty((len(chunk), ends[-1]), np.uint8)
        _core.patch_records(first, first.shape[1], 0, list(zip(ends, others, strict=False)), values)
        self._sink.write_block(self._splicer.splice(block, chunk.positions, values))

    def _begin(self, given: tuple[bool, bool, bool], chunk: LasChunk | None) -> None:
        """Writes the header, now that it is known what is added."""
        header, self._given = self._header, given
        self._layout = layout = Layout.plan(header, self._known, *given)
        if self._compressed:
            extra = layout.length - RECORD_SIZE[layout.point_format]
            self._scheme = laz.Scheme.for_points(layout.point_format, extra)
            if chunk is not None and chunk.block is not None and (old := chunk.layered_scheme()) is not None:
                base = RECORD_SIZE[layout.point_format]
                added = [(at - base, size) for at, size in ((layout.source, 2), (layout.sigma, 4)) if at is not None]
                self._splicing = True
                self._scheme = old
                if layout.rgb is not None or added:
                    self._splicer = laz.Splicer(old, layout.rgb is not None, added)
                    self._scheme = self._splicer.scheme
        vlrs, padding = self._vlrs(layout), header.padding
        raw = bytearray(header.raw)
        raw[104] = layout.point_format | (0x80 if self._compressed else 0)
        if header.minor < 2 and FIRST_VERSION[layout.point_format] > header.minor:
            raw[25] = 2
            # LAS 1.2 gives a meaning to bits that were unused before; earlier files set only the first of them.
            raw[6:8] = (header.u16(6) & 1).to_bytes(2, "little")
        body = b"".join(record.head + (record.data or b"") for record in vlrs) + padding
        struct.pack_into("<I", raw, 96, len(raw) + len(body))
        struct.pack_into("<I", raw, 100, len(vlrs))
        struct.pack_into("<H", raw, 105, layout.length)
        if header.minor >= 4:
            struct.pack_into("<Q", raw, 247, header.n_points)
        self._new_header = bytes(raw)
        if self._scheme is None:
            self._direct = DirectWriter(self._file)
            head = np.frombuffer(self._new_header + body, np.uint8)
            self._direct.append(len(head), partial(np.copyto, src=head))
        else:
            self._file.write(self._new_header + body)
            self._sink = laz.LazSink(self.path, self._file, self._scheme, self._splicing)

    def _vlrs(self, layout: Layout) -> list[Record]:
        """The records before the points, in their order."""
        out: list[Record] = []
        placed = described = False
        for record in self._header.vlrs:
            if record.user == laz.USER and record.number == laz.NUMBER:
                if self._scheme is not None and not placed:
                    out.append(record.with_data(self._scheme.data))
                    placed = True
            elif record.user == "copc":
                continue
            elif record.user == "LASF_Spec" and record.number == 4 and not described:
                described = True
                out.append(self._described(record, layout))
            else:
                out.append(record)
        if layout.descriptions is not None and not described and self._header.find("LASF_Spec", 4) is None:
            out.append(self._described(Record.new("LASF_Spec", 4, "Extra bytes", b""), layout))
        if self._scheme is not None and not placed:
            out.append(self._scheme.record())
        return out

    def _described(self, record: Record, layout: Layout) -> Record:
        if layout.descriptions is None:
            return record
        if not record.extended and len(layout.descriptions) > 0xFFFF:
            raise FileError(self.path, "the points have too many dimensions to add one", "leave some out first")
        return record.with_data(layout.descriptions)

    def write_tail(self) -> dict[int, bytes]:
        """Writes what follows the points; what the header must say of it, by place."""
        return {}

    def close(self) -> None:
        if self._written != self._header.n_points:
            raise InvalidInputError(f"{self._written:,} of {self._header.n_points:,} points were written")
        try:
            if self._direct is not None:
                self._direct.finish()
            if self._sink is not None:
                self._sink.done()
            header = bytearray(self._new_header)
            for at, data in self.write_tail().items():
                header[at : at + len(data)] = data
            self._file.seek(0)
            self._file.write(bytes(header))
        except OSError as error:
            raise not_written(self.path, error) from error
        self._out.commit()

    def discard(self) -> None:
        try:
            if self._direct is not None:
                self._direct.abandon()
        finally:  # also when the wait is interrupted
            self._out.discard()


class LasWriter(LasOutput):
    """A LAS or LAZ file with the points of another one."""

    def __init__(self, path: Path, like: LasReader, compressed: bool) -> None:
        self._like = like
        extra = like.header.find("LASF_Spec", 4)
        known = like.load(extra) if extra is not None else b""
        super().__init__(path, like.header, known, compressed, (like.path,))
        self.warnings = like.warnings

    def write(
        self,
        chunk: CloudChunk,
        rgb: npt.NDArray[np.uint16] | None = None,
        source: npt.NDArray[np.uint16] | None = None,
        sigma: npt.NDArray[np.float32] | None = None,
    ) -> None:
        if not isinstance(chunk, LasChunk) or not chunk.is_of(self._like):
            raise InvalidInputError("the chunk is not of the cloud that this output was made for")
        try:
            self.write_records(lambda: chunk.records, len(chunk), chunk.start, rgb, source, sigma, chunk)
        except OSError as error:
            raise not_written(self.path, error) from error

    def write_tail(self) -> dict[int, bytes]:
        like, header = self._like, self._header
        places: dict[int, bytes] = {}
        waveforms = header.waveform_start
        layout = self._layout
        kept = [record for record in header.evlrs if record.user != "copc"]
        described = layout is not None and layout.descriptions is not None
        rewritten = len(kept) < len(header.evlrs) or (
            described and any(r.user == "LASF_Spec" and r.number == 4 for r in kept) and not self._has_description()
        )
        if not header.compressed and not rewritten:
            # What stands behind the points of an uncompressed file is moved as a whole.
            start, at = like.points_end, self._file.tell()
            self._copy(start, like.size - start)
            if header.minor >= 3 and waveforms >= start:
                places[227] = (waveforms - start + at).to_bytes(8, "little")
            if kept:
                first = header.u64(235)
                if first < start:
                    raise FileError(like.path, "has extended records among its points", "export it again")
                places[235] = (first - start + at).to_bytes(8, "little")
            return places
        if kept:
            places[235] = self._file.tell().to_bytes(8, "little")
        elif header.evlrs:
            places[235] = bytes(8)
        for record in kept:
            if waveforms and record.position - 60 == waveforms:
                places[227] = self._file.tell().to_bytes(8, "little")
            is_description = record.user == "LASF_Spec" and record.number == 4
            if described and layout is not None and is_description and not self._has_description():
                record = self._described(replace(record, data=b""), layout)
            self._file.write(record.head)
            if record.data is not None:
                self._file.write(record.data)
            else:
                self._copy(record.position, record.length)
        if header.evlrs:
            places[243] = len(kept).to_bytes(4, "little")
        if waveforms and 227 not in places and header.point_offset < waveforms < like.size - 60:
            head = like.read_at(waveforms, 60)  # LAS 1.3 has one such record and no count of them
            places[227] = self._file.tell().to_bytes(8, "little")
            self._copy(waveforms, min(60 + int.from_bytes(head[20:28], "little"), like.size - waveforms))
        return places

    def _has_description(self) -> bool:
        return any(r.user == "LASF_Spec" and r.number == 4 for r in self._header.vlrs)

    def _copy(self, start: int, size: int) -> None:
        while size > 0:
            data = self._like.read_at(start, min(size, _COPY))
            self._file.write(data)
            start, size = start + len(data), size - len(data)


def column_bytes(values: AnyArray | None, name: str, n: int, kind: str, count: int) -> Bytes | None:
    """The values as (N, w) bytes in the file's order, after a look at their type and shape."""
    if values is None:
        return None
    shape = (n, count) if count > 1 else (n,)
    if not isinstance(values, np.ndarray) or values.dtype != np.dtype(kind) or values.shape != shape:
        found = f"{values.dtype} {values.shape}" if isinstance(values, np.ndarray) else type(values).__name__
        raise InvalidInputError(f"{name} must be {np.dtype(kind).name} {shape}, not {found}")
    return np.ascontiguousarray(values, dtype=kind).view(np.uint8).reshape(n, -1)
