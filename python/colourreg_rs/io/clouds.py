"""Clouds of any format: what a reader, a chunk and a writer are, and which module knows a file.

A cloud is read in chunks and written in chunks, each point's native record going through untouched; what is computed
for a chunk (colours, where they came from, how sure their place is) is put into the record on its way out.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from ..errors import FileError, InvalidInputError
from ..model import FloatArray, PointCloud
from .atomic import open_binary

AnyArray = npt.NDArray[Any]

#: Points in a chunk where nobody asks for another number.
CHUNK_SIZE = 1_000_000

#: Points that are read at a time at most where the file leaves the choice: arrays of this size are handed out by the
#: allocator again and again, while each larger one is asked of the system anew, page by page.
PIECE = 1 << 18

#: Names, types and descriptions of the dimensions that colouring adds.
SOURCE_NAME, SOURCE_TYPE, SOURCE_TEXT = "ColourSource", "<u2", "view of the colour, 0 = none"
SIGMA_NAME, SIGMA_TYPE, SIGMA_TEXT = "ColourSigma", "<f4", "sigma of colour's position, m"

#: Suffixes that name a format to write.
WRITTEN = {".las": "LAS", ".laz": "LAZ", ".ply": "PLY"}


@dataclass(frozen=True)
class Attribute:
    """What every point of a file carries beyond coordinates, colour, intensity and normal."""

    name: str
    dtype: np.dtype[Any]
    description: str = ""


class CloudChunk(ABC):
    """Successive points of a cloud. Columns are made when they are asked for.

    Attributes:
        start: index of the first point in the file.
        xyz: (N, 3) float64, C-contiguous, in the cloud's own frame and unit.
        record: the points as their file holds them; only the format's own module looks inside.
    """

    start: int
    xyz: FloatArray
    record: Any

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    @abstractmethod
    def intensity(self) -> AnyArray | None:
        """(N,) in the file's own type, or ``None``."""

    @property
    @abstractmethod
    def rgb(self) -> npt.NDArray[np.uint16] | None:
        """(N, 3) uint16 as the file holds them; 8-bit formats times 256; or ``None``."""

    @property
    @abstractmethod
    def normals(self) -> AnyArray | None:
        """(N, 3) in the file's own type, or ``None``."""

    @abstractmethod
    def columns(self) -> dict[str, AnyArray]:
        """The reader's :attr:`CloudReader.attributes` by name, (N,) each."""


class CloudReader(ABC):
    """An open cloud. ``with open_cloud(path) as cloud: for chunk in cloud.chunks(): ...``, as often as needed.

    Attributes:
        path: the file.
        n_points: how many points it holds, at least one.
        has_rgb, has_intensity, has_normals: what its points carry.
        warnings: what somebody who trusts the file should know, one line each.
    """

    path: Path
    n_points: int
    has_rgb: bool
    has_intensity: bool
    has_normals: bool
    warnings: tuple[str, ...] = ()

    #: What an output in another format cannot hold of this file and goes without; and lists, which are refused.
    unconverted: tuple[str, ...] = ()
    lists: tuple[str, ...] = ()

    @property
    @abstractmethod
    def format(self) -> str:
        """What kind of file it is, in a few words."""

    @property
    def crs_wkt(self) -> str | None:
        """The coordinate reference system as WKT, where the file names one that is understood."""
        return None

    @property
    @abstractmethod
    def attributes(self) -> tuple[Attribute, ...]:
        """What :meth:`CloudChunk.columns` gives."""

    @abstractmethod
    def chunks(self, size: int = CHUNK_SIZE, positions_only: bool = False) -> Iterator[CloudChunk]:
        """All points in order, at most ``size`` at a time; a new iteration starts at the first point again.

        Fewer than ``size`` may come where that is faster. Iterations may overlap, in several threads too.

        With ``positions_only`` nothing but ``xyz`` need be there, which saves decoding the rest.
        """

    @abstractmethod
    def close(self) -> None:
        """Closes the file; chunks that were read stay valid."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def description(self) -> dict[str, Any]:
        """What the file says of itself, ready for JSON; only the first points are read for it."""
        return {
            "format": self.format,
            "points": self.n_points,
            "rgb": self.has_rgb,
            "rgb_bits": self.rgb_bits() if self.has_rgb else None,
            "intensity": self.has_intensity,
            "normals": self.has_normals,
            "attributes": [{"name": a.name, "type": a.dtype.str.lstrip("<|=>")} for a in self.attributes],
            "crs_wkt": self.crs_wkt,
            "warnings": list(self.warnings),
        }

    def rgb_bits(self) -> int | None:
        """8 where a 16-bit colour field holds 8-bit values, else 16; ``None`` where the first 100,000 points are black.

        The LAS specification wants 8-bit values times 256; files in the wild often hold them as they are.
        """
        for chunk in self.chunks(100_000):
            return bits_of(chunk.rgb)
        return None

    def told_extent(self) -> Extent | None:
        """What the file says of its extent, where a look at some points bears it out; only they are read for it."""
        return None

    def extent(self) -> Extent:
        """Goes through all points once.

        Raises:
            FileError: no point has coordinates.
        """
        low, high, invalid = np.full(3, np.inf), np.full(3, -np.inf), 0
        for chunk in self.chunks(positions_only=True):
            xyz = chunk.xyz
            valid = np.isfinite(xyz).all(axis=1)
            if not valid.all():
                invalid += int(len(xyz) - valid.sum())
                xyz = xyz[valid]
            if len(xyz):
                low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
        if invalid == self.n_points:
            raise _without_coordinates(self.path, self.n_points)
        return Extent(low, high, invalid)


@dataclass(frozen=True)
class Extent:
    """The box around all points that have coordinates, and how many have none."""

    low: FloatArray
    high: FloatArray
    invalid: int


class CloudWriter(ABC):
    """A cloud under construction: ``with create_cloud(path, like) as out: out.write(chunk, rgb=...)``.

    The file gets its name when the block ends without an exception and every point was written; otherwise nothing is
    left behind.

    Attributes:
        warnings: those of the input, and what the output cannot keep of it, one line each.
    """

    path: Path
    warnings: tuple[str, ...] = ()

    @abstractmethod
    def write(
        self,
        chunk: CloudChunk,
        rgb: npt.NDArray[np.uint16] | None = None,
        source: npt.NDArray[np.uint16] | None = None,
        sigma: npt.NDArray[np.float32] | None = None,
    ) -> None:
        """Appends the chunk's points, with new colours where they are given.

        Args:
            chunk: the next points of the cloud that the writer was made for.
            rgb: (N, 3) uint16, 8-bit values times 256; ``None`` keeps what the points have.
            source: (N,) uint16, the dimension ``ColourSource``.
            sigma: (N,) float32, the dimension ``ColourSigma``, in metres.

        Which of the three are given is the same for all chunks of a cloud.
        """

    @abstractmethod
    def close(self) -> None:
        """Completes the file and gives it its name."""

    @abstractmethod
    def discard(self) -> None:
        """Removes what was written."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is not None:
            self.discard()
            return
        try:
            self.close()
        except BaseException:
            self.discard()
            raise


def open_cloud(path: str | Path) -> CloudReader:
    """Opens a LAS, LAZ, PLY or PCD file, told apart by what it holds.

    Raises:
        FileError: the file is missing, broken, truncated, holds no points, or is of another kind.
    """
    path = Path(path)
    with open_binary(path) as file:
        head = file.read(256)
    if not head:
        raise FileError(path, "is empty", "was the copy interrupted?")
    if head.startswith(b"LASF"):
        from .las import LasReader

        return LasReader(path)
    if head[:3] == b"ply" and head[3:4] in (b"\n", b"\r", b" ", b"\t"):
        from .ply import PlyReader

        return PlyReader(path)
    if path.suffix.lower() == ".pcd" or head.startswith(b"# .PCD"):
        from .pcd import PcdReader

        return PcdReader(path)
    raise FileError(path, f"is {_kind(path, head)}", "clouds are read from LAS, LAZ, PLY and PCD files")


def create_cloud(path: str | Path, like: CloudReader) -> CloudWriter:
    """Begins an output for the points of ``like``: in the format of the suffix, else in that of the input.

    Raises:
        FileError: the suffix names a format that is not written, the target is the input itself, or the points cannot
            be held by the format.
    """
    path = Path(path)
    form = output_format(path, like)
    from .las import LasReader
    from .ply import PlyReader

    if form == "PLY":
        from .ply_write import PlyConverter, PlyWriter

        return PlyWriter(path, like) if isinstance(like, PlyReader) else PlyConverter(path, like)
    if isinstance(like, LasReader):
        from .las_write import LasWriter

        return LasWriter(path, like, compressed=form == "LAZ")
    from .las_convert import LasConverter

    return LasConverter(path, like, compressed=form == "LAZ")


def output_format(path: Path, like: CloudReader) -> str:
    """``LAS``, ``LAZ`` or ``PLY``: what a file of this name is written as."""
    suffix = path.suffix.lower()
    if path.name.lower().endswith(".copc.laz"):
        raise FileError(path, "COPC is read but not written", "name the output .laz: it is written as plain LAZ")
    if suffix in WRITTEN:
        return WRITTEN[suffix]
    family = WRITTEN.get(f".{like.format.split()[0].lower()}")
    if suffix == "" and family:
        return family
    kind = f"{suffix[1:].upper()} is not written" if suffix else "the name has no suffix to tell the format"
    raise FileError(path, kind, "give a name that ends in .las, .laz or .ply")


def read_cloud(path: str | Path) -> PointCloud:
    """Reads a whole cloud into memory.

    Raises:
        FileError: as :func:`open_cloud`; or no point has coordinates.
    """
    with open_cloud(path) as reader:
        n = reader.n_points
        xyz = np.empty((n, 3))
        intensity: AnyArray | None = None
        normals: FloatArray | None = np.empty((n, 3)) if reader.has_normals else None
        rgb: npt.NDArray[np.uint16] | None = np.empty((n, 3), np.uint16) if reader.has_rgb else None
        for chunk in reader.chunks():
            part = slice(chunk.start, chunk.start + len(chunk))
            xyz[part] = chunk.xyz
            if (values := chunk.intensity) is not None:
                if intensity is None:
                    intensity = np.empty(n, values.dtype)
                intensity[part] = values
            if rgb is not None:
                rgb[part] = chunk.rgb  # type: ignore[assignment]  # there, as the reader says
            if normals is not None:
                normals[part] = chunk.normals
        if not np.isfinite(xyz).all(axis=1).any():
            raise _without_coordinates(reader.path, n)
        return PointCloud(xyz, intensity, rgb, normals, reader.crs_wkt)


def _without_coordinates(path: Path, n: int) -> FileError:
    return FileError(path, f"none of its {n:,} points has finite coordinates", "export the cloud again")


def write_cloud(path: str | Path, cloud: PointCloud, extra: Mapping[str, AnyArray] | None = None) -> None:
    """Writes a cloud from memory as LAS, LAZ or PLY, by the suffix of ``path``.

    Args:
        path: the target.
        cloud: the points; integer intensities up to 16 bit are written as they are.
        extra: further columns, (N,) each, by name.
    """
    reader = MemoryReader(Path(path), cloud, extra or {})
    with create_cloud(path, reader) as out:
        for chunk in reader.chunks():
            out.write(chunk)


def bits_of(rgb: npt.NDArray[np.uint16] | None) -> int | None:
    """8 or 16: the range that colours in a 16-bit field make use of; ``None`` when there are none but black ones."""
    if rgb is None or not len(rgb) or not (highest := int(rgb.max())):
        return None
    return 8 if highest <= 255 else 16


class MemoryReader(CloudReader):
    """A cloud in memory as if it were a file, so that every writer can write it."""

    def __init__(self, path: Path, cloud: PointCloud, extra: Mapping[str, AnyArray]) -> None:
        self.path = path
        self.n_points = len(cloud)
        if not self.n_points:
            raise FileError(path, "a cloud without points is not written", None)
        self.has_rgb = cloud.rgb is not None
        self.has_intensity = cloud.intensity is not None
        self.has_normals = cloud.normals is not None
        self.cloud = cloud
        self.extra = {name: np.ascontiguousarray(values) for name, values in extra.items()}
        for name, values in self.extra.items():
            if values.shape != (self.n_points,):
                raise InvalidInputError(f"{name} has shape {values.shape}, not ({self.n_points},)")

    @property
    def format(self) -> str:
        return "memory"

    @property
    def crs_wkt(self) -> str | None:
        return self.cloud.crs_wkt

    @property
    def attributes(self) -> tuple[Attribute, ...]:
        return tuple(Attribute(name, values.dtype) for name, values in self.extra.items())

    def chunks(self, size: int = CHUNK_SIZE, positions_only: bool = False) -> Iterator[CloudChunk]:
        for start in range(0, self.n_points, size):
            yield MemoryChunk(self, start, min(start + size, self.n_points))

    def close(self) -> None:
        pass


class MemoryChunk(CloudChunk):
    """A piece of a cloud in memory."""

    def __init__(self, reader: MemoryReader, start: int, stop: int) -> None:
        self.start = start
        self.record = slice(start, stop)
        self.xyz = reader.cloud.xyz[start:stop]
        self._reader = reader

    def _part(self, values: AnyArray | None) -> AnyArray | None:
        return None if values is None else values[self.record]

    @property
    def intensity(self) -> AnyArray | None:
        return self._part(self._reader.cloud.intensity)

    @property
    def rgb(self) -> npt.NDArray[np.uint16] | None:
        return self._part(self._reader.cloud.rgb)

    @property
    def normals(self) -> AnyArray | None:
        return self._part(self._reader.cloud.normals)

    def columns(self) -> dict[str, AnyArray]:
        return {name: values[self.record] for name, values in self._reader.extra.items()}


def _kind(path: Path, head: bytes) -> str:
    """A few words on what a file that is no cloud seems to be."""
    for start, kind in (
        (b"ASTM-E57", "an E57 file"),
        (b"\xff\xd8\xff", "a JPEG photo, not a cloud"),
        (b"\x89PNG", "a PNG image, not a cloud"),
        (b"II*\0", "a TIFF image, not a cloud"),
        (b"MM\0*", "a TIFF image, not a cloud"),
        (b"GIF8", "a GIF image, not a cloud; photos are JPEG, PNG or TIFF"),
        (b"RIFF", "a WebP or other RIFF file, not a cloud; photos are JPEG, PNG or TIFF"),
        (b"BM", "a BMP image, not a cloud; photos are JPEG, PNG or TIFF"),
        (b"PK\x03\x04", "a ZIP archive"),
        (b"\x1f\x8b", "a gzip archive"),
        (b"{", "a JSON file, not a cloud"),
    ):
        if head.startswith(start):
            return kind
    if path.suffix.lower() in (".las", ".laz"):
        return f"not a LAS file: it begins with {head[:4]!r} instead of b'LASF'"
    if path.suffix.lower() == ".ply":
        return "not a PLY file: its first line is not 'ply'"
    return "of an unknown kind" + (f" ({path.suffix})" if path.suffix else "")
