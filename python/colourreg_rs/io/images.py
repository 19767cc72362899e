"""Photos: JPEG, PNG and TIFF of 8 and 16 bits, upright, with what their EXIF data say."""

from __future__ import annotations

import math
import struct
import threading
import warnings
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .. import _core
from ..errors import ColourregError, FileError, InvalidInputError
from .atomic import AtomicFile, open_binary, read_bytes

if TYPE_CHECKING:
    from PIL import Image

Pixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

#: Photos above this are refused: 3 GB for 8 bits, 6 GB for 16.
MAX_PIXELS = 1_000_000_000

#: Rows of a picture that Pillow gives at a time.
_STRIP = 64

#: Diagonal of a frame of 35 mm film, mm.
_FILM_DIAGONAL = math.hypot(36.0, 24.0)
_EXPORT = "export it as JPEG, PNG or TIFF with 8 or 16 bits"
_BROKEN = "the file is truncated or broken: copy it again"
_pillow = threading.Lock()


@dataclass(frozen=True)
class PhotoInfo:
    """What is known of a photo without decoding it; ``width`` and ``height`` are those of the upright photo.

    ``exif`` holds what there is of: ``make``, ``model``, ``lens``, ``datetime``, ``orientation`` (the tag, 1 to 8),
    ``focal_length_mm``, ``focal_35mm``, ``focal_px`` (see :func:`focal_in_pixels`).
    """

    path: Path
    width: int
    height: int
    bits: int
    mode: str
    format: str
    exif: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Photo:
    """A decoded photo: ``pixels`` (H, W, 3) uint8 or uint16, C-contiguous, upright; grey expanded, no alpha."""

    path: Path
    pixels: Pixels
    exif: Mapping[str, Any] = field(default_factory=dict)

    @property
    def width(self) -> int:
        """Columns."""
        return int(self.pixels.shape[1])

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.pixels.shape[0])


def photo_info(path: str | Path) -> PhotoInfo:
    """Size, depth and EXIF data of a photo, without decoding it.

    Raises:
        FileError: the file is no photo of a kind that is read, is broken, or has more than :data:`MAX_PIXELS` pixels.
    """
    path = Path(path)
    with open_binary(path) as file, _opened(path, file) as image:
        return _info(path, file, image)


def whole_photo_info(path: str | Path) -> PhotoInfo:
    """As :func:`photo_info`, after making sure that the pixels are all there, in some tenths of a second at most.

    A JPEG is decoded at an eighth of its size, which reads all of its data; a PNG must end as one ends; the strips of a
    TIFF must lie in the file.

    Raises:
        FileError: as :func:`photo_info`, and where the file is cut off, does not decode, or is CMYK or the like.
    """
    path = Path(path)
    with open_binary(path) as file, _opened(path, file) as image:
        info = _info(path, file, image)
        _refuse_mode(path, image.mode)
        if info.format == "JPEG":
            image.draft(image.mode, (max(image.width // 8, 1), max(image.height // 8, 1)))
            image.load()
        elif info.format == "PNG":
            _check_png(path, file)
        else:
            _check_tiff(path, file, image)
    return info


def read_photo(path: str | Path) -> Photo:
    """Decodes a photo and turns it upright by its EXIF orientation.

    Raises:
        FileError: as :func:`whole_photo_info`, and for CMYK and other colour spaces and for 32 bits.
    """
    path = Path(path)
    with open_binary(path) as file, _opened(path, file) as image:
        info = _info(path, file, image)
        if info.format == "PNG":  # Pillow takes one without its end as whole, and so would not say what `info` says
            _check_png(path, file)
        if info.bits == 16:
            pixels: npt.NDArray[Any] = _png16(path) if info.format == "PNG" else _tiff16(path)
        else:
            pixels = _eight_bits(path, image)
        # Pillow turns TIFF, and only TIFF, upright by itself, and takes the tag away.
        turned = info.bits == 8 and info.format == "TIFF" and 274 not in getattr(image, "tag_v2", {})
    pixels = upright(pixels, 1 if turned else int(info.exif.get("orientation", 1)))
    if pixels.shape[2] <= 2:  # grey, with or without alpha
        pixels = np.repeat(pixels[:, :, :1], 3, axis=2)
    return Photo(path, np.ascontiguousarray(pixels[:, :, :3]), info.exif)


def focal_in_pixels(exif: Mapping[str, Any], width: int, height: int) -> float | None:
    """The focal length in pixels that EXIF data tell, a starting value good to some per cent.

    The 35 mm equivalent is taken by the diagonal of the picture, as camera makers define it: ``f35 · √(w² + h²) /
    43.27``. (For pictures of 3 : 2 that is the same as 36 mm for the long side; for 4 : 3 it is 4 % more.) Where the
    resolution of the sensor is given too, and agrees with it to 10 %, or stands alone, it is used: it is not rounded.
    """
    equivalent, resolved = exif.get("focal_35mm"), None

    def possible(focal: float) -> float | None:
        return focal if 0.2 < focal / max(width, height) < 50 else None

    if equivalent:
        equivalent = possible(float(equivalent) * math.hypot(width, height) / _FILM_DIAGONAL)
    if exif.get("focal_length_mm") and exif.get("sensor_width_mm"):
        resolved = possible(float(exif["focal_length_mm"]) / float(exif["sensor_width_mm"]) * max(width, height))
    if resolved and (not equivalent or abs(resolved / equivalent - 1) < 0.1):
        return resolved
    return equivalent or None


def upright(pixels: npt.NDArray[Any], orientation: int) -> npt.NDArray[Any]:
    """The picture as it should be seen, by the EXIF orientation 1 to 8 of how it is stored."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def write_image(
    path: str | Path, pixels: npt.NDArray[Any], quality: int = 95, exif: Mapping[str, Any] | None = None
) -> None:
    """Writes a picture, atomically, by the suffix of ``path``.

    Args:
        path: ``.png`` (8 or 16 bits), ``.jpg`` (8 bits), ``.tif`` (8 or 16 bits, or float32 for depths and the like).
        pixels: (H, W) or (H, W, C), C 1, 3 or 4 (JPEG: 1 or 3).
        quality: of JPEG.
        exif: for JPEG: ``make``, ``model``, ``datetime``, ``orientation``, ``focal_length_mm``, ``focal_35mm``.
    """
    path = Path(path)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[:, :, 0]
    if pixels.ndim not in (2, 3) or 0 in pixels.shape or (pixels.ndim == 3 and pixels.shape[2] not in (3, 4)):
        raise InvalidInputError(f"a picture has shape (H, W) or (H, W, 3 or 4), not {pixels.shape}")
    suffix = path.suffix.lower()
    kinds = {".png": "u1 u2", ".jpg": "u1", ".jpeg": "u1", ".tif": "u1 u2 f4", ".tiff": "u1 u2 f4"}
    if suffix not in kinds:
        raise FileError(path, f"{suffix or 'a name without suffix'} is not written", "name it .png, .jpg or .tif")
    if pixels.dtype.str[1:] not in kinds[suffix].split():
        raise InvalidInputError(f"{suffix} does not hold {pixels.dtype}")
    if suffix in (".jpg", ".jpeg") and pixels.ndim == 3 and pixels.shape[2] == 4:
        raise InvalidInputError("JPEG holds no alpha channel")
    pixels = np.ascontiguousarray(pixels)
    with AtomicFile(path) as out:
        if suffix in (".tif", ".tiff"):
            import tifffile

            kind = "minisblack" if pixels.ndim == 2 else "rgb"
            alpha = ("unassalpha",) if pixels.ndim == 3 and pixels.shape[2] == 4 else None
            tifffile.imwrite(out.file, pixels, photometric=kind, extrasamples=alpha, compression="zlib", metadata=None)
        elif pixels.dtype == np.uint16:
            _write_png16(out.file, pixels)
        else:
            from PIL import Image

            image = Image.fromarray(pixels)
            if suffix == ".png":
                image.save(out.file, "PNG", compress_level=4)
            else:
                image.save(out.file, "JPEG", quality=quality, subsampling=0, exif=_exif_block(exif or {}))


@contextmanager
def _opened(path: Path, file: IO[bytes]) -> Iterator[Image.Image]:
    """The photo, not decoded yet. Whatever goes wrong while it is open becomes a :class:`FileError`."""
    from PIL import Image, UnidentifiedImageError

    try:
        with _pillow, warnings.catch_warnings():
            # Pillow's own limit is a setting of the whole process: it is lifted for this one look at the header.
            warnings.simplefilter("ignore")
            limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
            try:
                image = Image.open(file)
            finally:
                Image.MAX_IMAGE_PIXELS = limit
        if image.format not in ("JPEG", "MPO", "PNG", "TIFF"):
            raise FileError(path, f"is a {image.format} picture", _EXPORT)
        width, height = image.size
        if width * height > MAX_PIXELS:
            problem = f"has {width} x {height} pixels; {MAX_PIXELS:,} are the most that is read"
            raise FileError(path, problem, "cut it into pieces or make it smaller")
        if not width * height:
            raise FileError(path, f"has {width} x {height} pixels", _EXPORT)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield image
    except ColourregError:
        raise
    except UnidentifiedImageError as error:
        raise FileError(path, _unknown(path, file), _EXPORT) from error
    except Exception as error:
        text = str(error).splitlines()[0][:100] if str(error) else type(error).__name__
        raise FileError(path, f"cannot be decoded ({text})", _BROKEN) from error


def _unknown(path: Path, file: IO[bytes]) -> str:
    file.seek(0)
    head = file.read(16)
    if not head:
        return "is empty"
    if head[4:12] in (b"ftypheic", b"ftypheix", b"ftypmif1", b"ftypavif"):
        return "is a HEIC or AVIF photo"
    if path.suffix.lower() in (".jpg", ".jpeg", ".png", ".tif", ".tiff"):
        return f"is no {path.suffix[1:].upper()} picture, or is cut off in its header"
    return "is no photo of a known kind"


def _info(path: Path, file: IO[bytes], image: Image.Image) -> PhotoInfo:
    kind = "JPEG" if image.format == "MPO" else str(image.format)
    bits = 8
    if kind == "PNG":
        file.seek(24)
        bits = 16 if file.read(1) == b"\x10" else 8
        file.seek(0)
    elif kind == "TIFF":
        tags: Any = getattr(image, "tag_v2", {})
        depths, forms = tags.get(258, (1,)), tags.get(339, (1,))
        depths = depths if isinstance(depths, tuple) else (depths,)
        forms = forms if isinstance(forms, tuple) else (forms,)
        if max(depths) > 8:
            if set(depths) != {16} or set(forms) != {1}:
                raise FileError(path, f"has {max(depths)} bits of another kind than whole numbers", _EXPORT)
            bits = 16
    exif = _exif(image)
    width, height = image.size
    if kind == "TIFF":  # of which Pillow gives the size as it will be after turning
        width, height = (int(getattr(image, "tag_v2", {}).get(tag, 0)) for tag in (256, 257))
    if exif.get("orientation", 1) >= 5:
        width, height = height, width
    focal = focal_in_pixels(exif, width, height)
    if focal is not None:
        exif["focal_px"] = focal
    return PhotoInfo(path, width, height, bits, image.mode, kind, exif)


def _check_png(path: Path, file: IO[bytes]) -> None:
    """A PNG is a row of chunks, each with its length and check sum, the last of them empty and named IEND."""
    file.seek(8)
    while True:
        head = file.read(8)
        if len(head) < 8:
            raise FileError(path, "ends inside its pixels", _BROKEN)
        content = file.read(int.from_bytes(head[:4], "big"))
        check = file.read(4)
        if len(check) < 4:
            raise FileError(path, "ends inside its pixels", _BROKEN)
        if zlib.crc32(head[4:] + content) != int.from_bytes(check, "big"):
            raise FileError(path, f"has a damaged part ({head[4:].decode('latin-1')})", _BROKEN)
        if head[4:] == b"IEND":
            return


def _check_tiff(path: Path, file: IO[bytes], image: Image.Image) -> None:
    tags: Any = getattr(image, "tag_v2", {})
    offsets, counts = (tags.get(a) or tags.get(b) or () for a, b in ((273, 324), (279, 325)))
    size = file.seek(0, 2)
    if not offsets or any(at + n > size for at, n in zip(offsets, counts, strict=False)):
        raise FileError(path, "ends inside its pixels", _BROKEN)


def _exif(image: Image.Image) -> dict[str, Any]:
    """What is of use here among the EXIF data; what is broken among them is left out."""
    try:
        base = image.getexif()
        detail = base.get_ifd(0x8769)
    except Exception:
        return {}

    def number(value: Any) -> float | None:
        try:
            found = float(value)
        except (TypeError, ValueError, ZeroDivisionError):
            return None
        return found if math.isfinite(found) and found > 0 else None

    def text(value: Any) -> str | None:
        return (str(value).split("\0")[0].strip() or None) if isinstance(value, str) else None

    units = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}.get(detail.get(0xA210, 2))
    resolution, columns = number(detail.get(0xA20E)), number(detail.get(0xA002))
    orientation = base.get(0x0112)
    found: dict[str, Any] = {
        "make": text(base.get(0x010F)),
        "model": text(base.get(0x0110)),
        "lens": text(detail.get(0xA434)),
        "datetime": text(detail.get(0x9003)) or text(base.get(0x0132)),
        "orientation": orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1,
        "focal_length_mm": number(detail.get(0x920A)),
        "focal_35mm": number(detail.get(0xA405)),
    }
    if units and resolution and columns:
        found["sensor_width_mm"] = columns / resolution * units
    return {key: value for key, value in found.items() if value is not None}


def _exif_block(values: Mapping[str, Any]) -> Image.Exif:
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational

    exif = Image.Exif()
    for key, tag in (("make", 0x010F), ("model", 0x0110), ("orientation", 0x0112), ("datetime", 0x0132)):
        if values.get(key) is not None:
            exif[tag] = values[key]
    detail: dict[int, Any] = {}
    if values.get("focal_length_mm") is not None:
        detail[0x920A] = IFDRational(round(float(values["focal_length_mm"]) * 1000), 1000)
    if values.get("focal_35mm") is not None:
        detail[0xA405] = round(float(values["focal_35mm"]))
    if detail:
        exif.get_ifd(0x8769).update(detail)
    return exif


def _refuse_mode(path: Path, mode: str) -> None:
    if mode in ("CMYK", "LAB", "HSV"):
        raise FileError(path, f"is in {mode}, which needs a colour profile to become RGB", "export it as RGB")


def _eight_bits(path: Path, image: Image.Image) -> npt.NDArray[np.uint8]:
    """(H, W, C) as it is stored."""
    mode = image.mode
    _refuse_mode(path, mode)
    if mode in ("I", "F", "I;16", "I;16B", "I;16L", "I;16N"):
        raise FileError(path, f"has pixels of an unusual kind ({mode})", _EXPORT)
    if mode == "LA" or mode == "1":
        image = image.convert("L")
    elif mode not in ("L", "RGB"):
        image = image.convert("RGB")
    image.load()
    # Strip by strip: Pillow packs a picture into one new string, by way of as many bytes again in pieces, which for a
    # large photo is three times its size in memory that nobody has touched before.
    pixels = np.empty((image.height, image.width, len(image.getbands())), np.uint8)
    for top in range(0, image.height, _STRIP):
        strip = np.asarray(image.crop((0, top, image.width, min(top + _STRIP, image.height))))
        pixels[top : top + _STRIP] = strip.reshape(len(strip), image.width, -1)
    return pixels


def _png16(path: Path) -> npt.NDArray[np.uint16]:
    data = np.frombuffer(read_bytes(path), np.uint8)
    try:
        return _core.decode_png(data, MAX_PIXELS)
    except InvalidInputError as error:
        raise FileError(path, f"cannot be decoded ({error})", _BROKEN) from error


def _tiff16(path: Path) -> npt.NDArray[np.uint16]:
    """(H, W, C) of the first page; Pillow would cut the values down to 8 bits."""
    import logging

    import tifffile

    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    with tifffile.TiffFile(path) as tiff:
        page: Any = tiff.pages[0]
        photometric = int(page.photometric)
        if photometric not in (0, 1, 2):
            raise FileError(path, f"is a TIFF of the photometric kind {photometric}", "export it as RGB or grey")
        held = sum(page.databytecounts)
        size = path.stat().st_size
        if any(at + n > size for at, n in zip(page.dataoffsets, page.databytecounts, strict=True)) or not held:
            raise FileError(path, "ends inside its pixels", _BROKEN)
        compression = int(page.compression)
        if compression == 5:
            pixels = _lzw_pages(path, page)
        elif compression in (1, 8, 32946, 32773):
            pixels = page.asarray()
            if "S" in page.axes and page.axes.index("S") == 0:
                pixels = np.moveaxis(pixels, 0, -1)
        else:
            name = getattr(page.compression, "name", str(compression))
            raise FileError(
                path, f"is a 16-bit TIFF compressed with {name}", "export it with LZW, ZIP or without compression"
            )
    pixels = np.asarray(pixels)
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.ndim != 3 or pixels.dtype.str[1:] != "u2":
        raise FileError(path, f"has pixels of shape {pixels.shape}, {pixels.dtype}", _EXPORT)
    pixels = pixels.astype(np.uint16, copy=False)
    if photometric == 2 and pixels.shape[2] < 3:
        raise FileError(path, f"is RGB with {pixels.shape[2]} channels", _EXPORT)
    if photometric < 2:
        pixels = pixels[:, :, :1]
        if photometric == 0:  # white is zero
            pixels = np.uint16(65535) - pixels
    return pixels


def _lzw_pages(path: Path, page: Any) -> npt.NDArray[np.uint16]:
    """LZW, which tifffile leaves to a package of 60 MB: strips or tiles are decoded and put together here."""
    height, width, samples = int(page.imagelength), int(page.imagewidth), int(page.samplesperpixel)
    planar = int(page.planarconfig) == 2 and samples > 1
    channels = 1 if planar else samples
    tiled = bool(page.is_tiled)
    rows = int(page.tilelength) if tiled else min(int(page.rowsperstrip), height)
    columns = int(page.tilewidth) if tiled else width
    if min(rows, columns) <= 0 or int(page.predictor) not in (1, 2) or int(page.fillorder) != 1:
        raise FileError(path, "has an unusual layout", _EXPORT)
    down, across = -(-height // rows), -(-width // columns)
    planes = samples if planar else 1
    if len(page.dataoffsets) != down * across * planes or rows * columns * channels > 4 * MAX_PIXELS:
        raise FileError(path, "does not hold as many strips as its size asks for", _BROKEN)
    pixels = np.empty((height, width, samples), np.uint16)
    raw = np.memmap(path, np.uint8, "r")
    order = ">u2" if page.parent.byteorder == ">" else "<u2"
    for i, (at, size) in enumerate(zip(page.dataoffsets, page.databytecounts, strict=True)):
        plane, place = divmod(i, down * across)
        top, left = place // across * rows, place % across * columns
        deep = rows if tiled else min(rows, height - top)
        data = _core.decode_lzw(np.array(raw[at : at + size]), deep * columns * channels * 2)
        part = data.view(order).astype(np.uint16).reshape(deep, columns, channels)
        if int(page.predictor) == 2:
            part = np.cumsum(part, axis=1, dtype=np.uint16)
        part = part[: height - top, : width - left]
        target = pixels[top : top + part.shape[0], left : left + part.shape[1]]
        if planar:
            target[:, :, plane] = part[:, :, 0]
        else:
            target[:] = part
    return pixels


def _write_png16(file: IO[bytes], pixels: npt.NDArray[np.uint16]) -> None:
    """A PNG of 16 bits, which Pillow writes only for grey."""
    height, width = pixels.shape[:2]
    kind = {2: 0, 3: 2, 4: 6}[2 if pixels.ndim == 2 else pixels.shape[2]]
    data = pixels.astype(">u2").view(np.uint8).reshape(height, -1)
    rows = np.empty((height, data.shape[1] + 1), np.uint8)
    rows[:, 0] = 2  # each row as the difference to the one above
    rows[0, 1:] = data[0]
    np.subtract(data[1:], data[:-1], out=rows[1:, 1:])

    def chunk(name: bytes, content: bytes) -> None:
        file.write(struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content)))

    file.write(b"\x89PNG\r\n\x1a\n")
    chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0))
    packer = zlib.compressobj(4)
    step = max(1, (1 << 24) // rows.shape[1])
    for top in range(0, height, step):
        if part := packer.compress(rows[top : top + step].data):
            chunk(b"IDAT", part)
    chunk(b"IDAT", packer.flush())
    chunk(b"IEND", b"")
