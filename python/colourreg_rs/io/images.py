"""Photos: JPEG, PNG and TIFF with 8 or 16 bits a channel, upright, as (H, W, 3); and pictures to write.

Pillow narrows 16-bit colour to 8 bits without a word. So the file itself is asked for its depth first: 16-bit PNGs go
through the core's decoder, 16-bit TIFFs through tifffile, everything else through Pillow.
"""

from __future__ import annotations

import io
import math
import struct
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import _core
from ..errors import FileError, InvalidInputError
from .atomic import read_bytes, write_bytes

#: The largest photo that is read. Pillow's own limits (89 and 179 megapixels) are below today's stitched panoramas.
MAX_PIXELS = 1_000_000_000

_FORMATS = ("JPEG", "PNG", "TIFF")
_SIXTEEN_BIT_MODES = ("I;16", "I;16B", "I;16L", "I;16N")
_ORIENTATION, _EXIF_IFD = 0x0112, 0x8769


@dataclass(frozen=True)
class PhotoInfo:
    """What a photo's header says. ``width`` and ``height`` are those of the upright image.

    ``focal_px``: the focal length in pixels, from the 35 mm equivalent (36 mm are the image's long side), or from the
    focal length and the resolution of the sensor; ``None`` where the file has neither.
    """

    width: int
    height: int
    bits: int
    channels: str
    format: str
    orientation: int = 1
    make: str | None = None
    model: str | None = None
    taken: str | None = None
    focal_mm: float | None = None
    focal_35mm: float | None = None
    focal_px: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return dict(vars(self))


@dataclass(frozen=True)
class Photo:
    """An upright photo: ``pixels`` (H, W, 3) uint8 or uint16, C-contiguous, and what its header says."""

    path: Path
    pixels: npt.NDArray[Any] = field(repr=False)
    info: PhotoInfo


@contextmanager
def _opened(path: Path, data: bytes) -> Iterator[Any]:
    """The file in Pillow, its limits and formats set on purpose; whatever Pillow raises becomes a FileError."""
    from PIL import Image, UnidentifiedImageError

    before = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
                if image.width * image.height > MAX_PIXELS:
                    raise FileError(
                        path,
                        f"has {image.width} x {image.height} pixels, more than {MAX_PIXELS / 1e6:.0f} megapixels",
                        "make it smaller",
                    )
                yield image
    except UnidentifiedImageError as error:
        raise FileError(
            path, "is no JPEG, PNG or TIFF photo, or is broken", "export it again as one of them"
        ) from error
    except FileError:
        raise
    except Exception as error:
        # Pillow's decoders raise nearly anything on broken files: OSError, SyntaxError, struct.error, ValueError, ...
        detail = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FileError(
            path, f"cannot be decoded: {detail[:120]}", "the file is probably damaged; copy it again"
        ) from error
    finally:
        Image.MAX_IMAGE_PIXELS = before


def photo_info(path: str | Path) -> PhotoInfo:
    """What the photo's header says; no pixel is decoded. Raises FileError."""
    path = Path(path)
    data = read_bytes(path)
    with _opened(path, data) as image:
        return _info(image, data)


def read_photo(path: str | Path) -> Photo:
    """The upright photo. Grey becomes three equal channels, an alpha channel is dropped. Raises FileError."""
    path = Path(path)
    data = read_bytes(path)
    with _opened(path, data) as image:
        info = _info(image, data)
        if info.bits == 16:
            pixels = _sixteen_bits(path, data, image)
        else:
            pixels = _eight_bits(path, image)
    pixels = _upright(pixels, info.orientation)
    return Photo(path, np.ascontiguousarray(pixels), info)


def _info(image: Any, data: bytes) -> PhotoInfo:
    try:
        exif = image.getexif()
        details = exif.get_ifd(_EXIF_IFD)
    except Exception:
        # A damaged EXIF block says nothing, but the photo itself may be whole.
        exif, details = {}, {}
    orientation = exif.get(_ORIENTATION, 1)
    if orientation not in range(1, 9):
        orientation = 1
    width, height = image.size if orientation < 5 else image.size[::-1]
    focal_mm, focal_35mm = _positive(details.get(0x920A)), _positive(details.get(0xA405))
    return PhotoInfo(
        width=width,
        height=height,
        bits=_bits(image, data),
        channels=image.mode,
        format="JPEG" if image.format == "MPO" else str(image.format),
        orientation=int(orientation),
        make=_text(exif.get(0x010F)),
        model=_text(exif.get(0x0110)),
        taken=_text(details.get(0x9003)),
        focal_mm=focal_mm,
        focal_35mm=focal_35mm,
        focal_px=_focal_px(max(image.size), focal_mm, focal_35mm, details),
    )


def _focal_px(
    long_side: int, focal_mm: float | None, focal_35mm: float | None, details: Mapping[int, Any]
) -> float | None:
    if focal_35mm is not None:
        return focal_35mm / 36.0 * long_side
    # FocalPlaneXResolution in pixels per unit, FocalPlaneResolutionUnit 2 inch, 3 cm, 4 mm.
    resolution = _positive(details.get(0xA20E))
    unit = {2: 25.4, 3: 10.0, 4: 1.0}.get(details.get(0xA210, 2))
    if focal_mm is None or resolution is None or unit is None:
        return None
    return focal_mm * resolution / unit


def _positive(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _text(value: Any) -> str | None:
    text = str(value).strip("\0 \t\r\n") if value is not None else ""
    return text if text and text.isprintable() else None


def _bits(image: Any, data: bytes) -> int:
    """Bits a channel, from the file: the mode that Pillow shows is that of what it would make."""
    if image.mode in _SIXTEEN_BIT_MODES:
        return 16
    if image.format == "PNG" and len(data) > 24:
        return 16 if data[24] == 16 else 8
    if image.format == "TIFF":
        bits = image.tag_v2.get(258, 8)
        return max(bits) if isinstance(bits, tuple) else int(bits)
    return 8


def _eight_bits(path: Path, image: Any) -> npt.NDArray[np.uint8]:
    if image.mode in ("I", "F"):
        raise FileError(
            path, f"has {_bits(image, b'')} bits a channel; 8 and 16 bits are read", "convert it to 16 bits"
        )
    if image.mode in ("CMYK", "LAB", "HSV"):
        raise FileError(
            path, f"is {image.mode}, whose colours depend on a profile", "convert it to sRGB in an image editor"
        )
    return np.asarray(image.convert("RGB"))


def _sixteen_bits(path: Path, data: bytes, image: Any) -> npt.NDArray[np.uint16]:
    if image.format == "PNG":
        try:
            pixels = _core.decode_png(np.frombuffer(data, np.uint8), MAX_PIXELS)
        except InvalidInputError as error:
            raise FileError(
                path, f"cannot be decoded: {error}", "the file is probably damaged; copy it again"
            ) from error
    else:
        pixels = _sixteen_bit_tiff(path, data)
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    # One or two channels are grey without and with alpha, three or four RGB.
    return np.repeat(pixels[:, :, :1], 3, axis=2) if pixels.shape[2] < 3 else pixels[:, :, :3]


def _sixteen_bit_tiff(path: Path, data: bytes) -> npt.NDArray[np.uint16]:
    import tifffile

    try:
        with tifffile.TiffFile(io.BytesIO(data)) as file:
            page = file.pages.first
            pixels = page.asarray()
            if pixels.ndim == 3 and page.planarconfig == tifffile.PLANARCONFIG.SEPARATE:
                pixels = np.moveaxis(pixels, 0, 2)
            if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
                pixels = np.iinfo(pixels.dtype).max - pixels
            elif page.photometric not in (tifffile.PHOTOMETRIC.RGB, tifffile.PHOTOMETRIC.MINISBLACK):
                raise FileError(path, f"is a TIFF of kind {page.photometric.name}", "convert it to RGB or grey")
    except FileError:
        raise
    except Exception as error:
        # tifffile raises nearly anything on broken files, and KeyError or ValueError for a codec that it lacks.
        if "imagecodecs" in str(error):
            name = str(getattr(getattr(page, "compression", None), "name", "another codec"))
            raise FileError(
                path,
                f"is a 16-bit TIFF compressed with {name}",
                "save it uncompressed or with ZIP (deflate) compression",
            ) from error
        detail = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FileError(
            path, f"cannot be decoded: {detail[:120]}", "the file is probably damaged; copy it again"
        ) from error
    if pixels.dtype != np.uint16 or pixels.ndim not in (2, 3):
        raise FileError(path, f"holds {pixels.dtype} values of shape {pixels.shape}", "convert it to 16-bit RGB")
    return np.asarray(pixels)


def _upright(pixels: npt.NDArray[Any], orientation: int) -> npt.NDArray[Any]:
    """Undoes the EXIF orientation: what the camera stored, turned and mirrored as it says."""
    if orientation in (2, 4, 5, 7):
        pixels = pixels[:, ::-1]
    return np.rot90(pixels, {3: 2, 4: 2, 5: 1, 6: 3, 7: 3, 8: 1}.get(orientation, 0))


def write_image(path: str | Path, pixels: npt.NDArray[Any], *, quality: int = 95) -> None:
    """Writes a picture atomically: (H, W) or (H, W, 3), uint8 as JPEG, PNG or TIFF by the suffix, uint16 as PNG (grey
    alone) or TIFF. Raises FileError."""
    path = Path(path)
    pixels = np.ascontiguousarray(pixels)
    grey = pixels.ndim == 2
    if pixels.dtype not in (np.uint8, np.uint16) or not (grey or (pixels.ndim == 3 and pixels.shape[2] == 3)):
        raise FileError(path, f"cannot hold {pixels.dtype} values of shape {pixels.shape}", None)
    suffix = path.suffix.lower()
    out = io.BytesIO()
    if suffix in (".tif", ".tiff"):
        import tifffile

        tifffile.imwrite(out, pixels, photometric="minisblack" if grey else "rgb", compression="zlib", metadata=None)
    elif pixels.dtype == np.uint16:
        if suffix != ".png":
            raise FileError(path, "cannot hold 16 bits", "name it .png or .tif")
        out.write(_png16(pixels))
    elif suffix in (".jpg", ".jpeg", ".png"):
        from PIL import Image

        kind = "PNG" if suffix == ".png" else "JPEG"
        options: dict[str, Any] = {} if kind == "PNG" else {"quality": quality, "subsampling": 0}
        Image.fromarray(pixels).save(out, kind, **options)
    else:
        raise FileError(path, f"has a suffix that names no picture format: {suffix!r}", "use .png, .jpg or .tif")
    write_bytes(path, out.getbuffer())


def _png16(pixels: npt.NDArray[np.uint16]) -> bytes:
    """A PNG of 16 bits a channel; Pillow writes such files for grey alone."""
    import zlib

    height, width = pixels.shape[:2]
    lines = np.zeros((height, 1 + pixels[0].nbytes), np.uint8)
    lines[:, 1:] = pixels.astype(">u2").reshape(height, -1).view(np.uint8)

    def part(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 16, 0 if pixels.ndim == 2 else 2, 0, 0, 0)
    body = zlib.compress(lines.tobytes(), 6)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", header) + part(b"IDAT", body) + part(b"IEND", b"")
