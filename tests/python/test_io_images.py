"""Photos: every depth and kind comes out as OpenCV reads it, upright; what is broken or unusual is one line."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from colourreg_rs import FileError, InvalidInputError
from colourreg_rs.io import images
from colourreg_rs.io.images import (
    focal_in_pixels,
    photo_info,
    read_photo,
    upright,
    whole_photo_info,
    write_image,
)


def picture(rng: np.random.Generator, dtype: type, channels: int = 3, shape: tuple[int, int] = (37, 53)) -> np.ndarray:
    high = np.iinfo(dtype).max
    smooth = np.add.outer(np.arange(shape[0]) * 5, np.arange(shape[1]) * 3)[:, :, None] * np.arange(1, channels + 1)
    return ((smooth + rng.integers(0, 20, (*shape, channels))) * (1 if high == 255 else 97) % high).astype(dtype)


def as_rgb(pixels: np.ndarray) -> np.ndarray:
    return np.repeat(pixels[:, :, :1], 3, axis=2) if pixels.shape[2] <= 2 else pixels[:, :, :3]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_what_is_written_is_read_by_us_and_by_opencv(tmp_path, rng, dtype, channels, suffix):
    pixels = picture(rng, dtype, channels)
    path = tmp_path / f"p{suffix}"
    write_image(path, pixels)
    photo = read_photo(path)
    assert photo.pixels.dtype == dtype and photo.pixels.flags.c_contiguous
    assert np.array_equal(photo.pixels, as_rgb(pixels))
    if suffix == ".tif" and channels == 4 and dtype is np.uint8:
        assert np.array_equal(tifffile.imread(path), pixels)  # OpenCV multiplies the colours with the alpha
        return
    other = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    other = (
        other[:, :, None]
        if other.ndim == 2
        else cv2.cvtColor(other, cv2.COLOR_BGRA2RGBA if channels == 4 else cv2.COLOR_BGR2RGB)
    )
    assert other.dtype == dtype and np.array_equal(other, pixels)
    info = photo_info(path)
    assert (info.width, info.height, info.bits) == (53, 37, 8 * np.dtype(dtype).itemsize)


@pytest.mark.parametrize("compression", [1, 5, 8, 32773])
@pytest.mark.parametrize("predictor", [1, 2])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_16_bit_tiff_of_other_programs(tmp_path, rng, compression, predictor, channels):
    pixels = picture(rng, np.uint16, channels, (301, 203))
    path = tmp_path / "p.tif"
    stored = (
        pixels[:, :, 0]
        if channels == 1
        else cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGRA if channels == 4 else cv2.COLOR_RGB2BGR)
    )
    rows = [cv2.IMWRITE_TIFF_ROWSPERSTRIP, 17]
    assert cv2.imwrite(
        str(path), stored, [cv2.IMWRITE_TIFF_COMPRESSION, compression, cv2.IMWRITE_TIFF_PREDICTOR, predictor, *rows]
    )
    photo = read_photo(path)
    assert photo.pixels.dtype == np.uint16 and np.array_equal(photo.pixels, as_rgb(pixels))


def lzw(data: bytes) -> bytes:
    """A plain encoder of TIFF's LZW, written for these tests: clear, literals, end, with growing codes."""
    codes, width = [(256, 9)], 9
    table = {bytes([i]): i for i in range(256)}
    following, word = 258, b""
    for value in data:
        if word + bytes([value]) in table:
            word += bytes([value])
            continue
        codes.append((table[word], width))
        table[word + bytes([value])] = following
        following += 1
        width = max(width, 9 if following < 512 else 10 if following < 1024 else 11 if following < 2048 else 12)
        if following == 4095:
            codes.append((256, width))
            table, following, width = {bytes([i]): i for i in range(256)}, 258, 9
        word = bytes([value])
    codes.append((table[word], width))
    following += 1
    width = max(width, 9 if following < 512 else 10 if following < 1024 else 11 if following < 2048 else 12)
    codes.append((257, width))
    text = "".join(f"{code:0{size}b}" for code, size in codes)
    text += "0" * (-len(text) % 8)
    return int(text, 2).to_bytes(len(text) // 8, "big")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("layout", ["strips", "tiles", "planes"])
def test_16_bit_lzw_in_every_layout(tmp_path, rng, order, layout):
    pixels = picture(rng, np.uint16, 3, (70, 90))
    path = tmp_path / "p.tif"
    options = {"tiles": {"tile": (32, 48)}, "planes": {"planarconfig": "separate", "rowsperstrip": 20}}.get(
        layout, {"rowsperstrip": 20}
    )
    data = np.moveaxis(pixels, -1, 0) if layout == "planes" else pixels
    tifffile.imwrite(path, data, byteorder=order, photometric="rgb", **options)
    # The same file with its strips or tiles compressed: appended, and pointed to by the tags.
    raw = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as tiff:
        page = tiff.pages[0]
        places, sizes = [], []
        for at, size in zip(page.dataoffsets, page.databytecounts, strict=True):
            packed = lzw(bytes(raw[at : at + size]))
            places.append(len(raw))
            sizes.append(len(packed))
            raw += packed
        names = ("TileOffsets", "TileByteCounts") if layout == "tiles" else ("StripOffsets", "StripByteCounts")
        for name, values in zip(names, (places, sizes), strict=True):
            tag = page.tags[name]
            width = {3: 2, 4: 4}[int(tag.dtype)]
            for i, value in enumerate(values):
                at = tag.valueoffset + i * width
                raw[at : at + width] = value.to_bytes(width, "little" if order == "<" else "big")
        at = page.tags["Compression"].valueoffset
        raw[at : at + 2] = (5).to_bytes(2, "little" if order == "<" else "big")
    path.write_bytes(raw)
    if layout != "planes":  # which OpenCV reads as if they were mixed
        assert np.array_equal(cv2.cvtColor(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), cv2.COLOR_BGR2RGB), pixels)
    assert np.array_equal(read_photo(path).pixels, pixels)
    for cut in (len(raw) - 1, len(raw) - sizes[-1], len(raw) - sum(sizes)):
        path.write_bytes(raw[:cut])
        with pytest.raises(FileError):
            read_photo(path)


@pytest.mark.parametrize("order", ["<", ">"])
def test_16_bit_tiff_in_tiles_and_planes(tmp_path, rng, order):
    pixels = picture(rng, np.uint16, 3, (70, 90))
    path = tmp_path / "p.tif"
    tifffile.imwrite(
        path, pixels, byteorder=order, photometric="rgb", tile=(32, 48), compression="zlib", predictor=True
    )
    assert np.array_equal(read_photo(path).pixels, pixels)
    tifffile.imwrite(path, np.moveaxis(pixels, -1, 0), byteorder=order, photometric="rgb", planarconfig="separate")
    assert np.array_equal(read_photo(path).pixels, pixels)
    tifffile.imwrite(path, pixels[:, :, 0], photometric="miniswhite")
    assert np.array_equal(read_photo(path).pixels[:, :, 1], 65535 - pixels[:, :, 0])


def test_interlaced_16_bit_png(tmp_path, rng):
    pixels = picture(rng, np.uint16, 3)
    import struct
    import zlib

    body = b""
    for top, left, down, right in (
        (0, 0, 8, 8),
        (0, 4, 8, 8),
        (4, 0, 8, 4),
        (0, 2, 4, 4),
        (2, 0, 4, 2),
        (0, 1, 2, 2),
        (1, 0, 2, 1),
    ):
        part = pixels[top::down, left::right].astype(">u2")
        body += b"".join(b"\0" + row.tobytes() for row in part)

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", 53, 37, 16, 2, 0, 0, 1)
    path = tmp_path / "p.png"
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(body)) + chunk(b"IEND", b"")
    )
    assert np.array_equal(read_photo(path).pixels, pixels)


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "PA"])
def test_modes_of_8_bits(tmp_path, rng, mode):
    image = Image.fromarray(picture(rng, np.uint8))
    image = image.convert("RGBA") if mode == "RGBA" else image.convert("P" if mode == "PA" else mode)
    if mode in ("RGBA", "LA"):
        image.putalpha(Image.fromarray(rng.integers(0, 256, (37, 53)).astype(np.uint8)))
    path = tmp_path / "p.png"
    image.save(path, **({"transparency": 3} if mode == "PA" else {}))
    wanted = (
        image.convert("RGB")
        if mode not in ("RGBA", "LA")
        else Image.merge("RGB", [image.getchannel(i) for i in ("RGB" if mode == "RGBA" else "LLL")])
    )
    assert np.array_equal(read_photo(path).pixels, np.asarray(wanted))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_of_tiff(tmp_path, rng, orientation, dtype):
    pixels = picture(rng, dtype)
    path = tmp_path / "p.tif"
    tifffile.imwrite(path, pixels, photometric="rgb", extratags=[(274, 3, 1, orientation, True)])
    photo, info = read_photo(path), photo_info(path)
    steps = {1: [], 2: ["fliplr"], 3: ["rot2"], 4: ["flipud"], 5: ["t"], 6: ["rot3"], 7: ["t", "rot2"], 8: ["rot1"]}[
        orientation
    ]
    for step in steps:
        moves = {"fliplr": np.fliplr, "flipud": np.flipud, "t": lambda a: a.swapaxes(0, 1)}
        pixels = np.rot90(pixels, int(step[3])) if step.startswith("rot") else moves[step](pixels)
    assert np.array_equal(photo.pixels, pixels)
    assert (info.width, info.height) == (photo.width, photo.height)
    assert photo.exif["orientation"] == orientation


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_applied(tmp_path, rng, orientation):
    blocks = rng.integers(0, 256, (4, 6, 3)).astype(np.uint8).repeat(16, axis=0).repeat(16, axis=1)
    path = tmp_path / "p.jpg"
    exif = {"orientation": orientation, "focal_35mm": 28, "make": "ACME", "model": "One", "focal_length_mm": 4.25}
    write_image(path, blocks, quality=100, exif=exif)
    photo, info = read_photo(path), photo_info(path)
    other = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)  # OpenCV turns pictures by their EXIF data too
    assert photo.pixels.shape == other.shape and np.abs(photo.pixels.astype(int) - other).max() <= 3
    assert (info.width, info.height) == (photo.width, photo.height) == ((96, 64) if orientation < 5 else (64, 96))
    assert np.array_equal(upright(blocks, orientation).shape, photo.pixels.shape)
    assert info.exif["orientation"] == orientation and info.exif["make"] == "ACME"
    assert info.exif["focal_length_mm"] == 4.25
    assert info.exif["focal_px"] == pytest.approx(28 * np.hypot(96, 64) / np.hypot(36, 24))


def test_focal_lengths():
    assert focal_in_pixels({"focal_35mm": 36}, 6000, 4000) == pytest.approx(6000)
    assert focal_in_pixels({"focal_35mm": 36}, 4000, 6000) == pytest.approx(6000)
    assert focal_in_pixels({"focal_35mm": 43.266615}, 4000, 3000) == pytest.approx(5000)
    assert focal_in_pixels({"focal_length_mm": 24.0, "sensor_width_mm": 36.0}, 6000, 4000) == pytest.approx(4000)
    assert focal_in_pixels(
        {"focal_35mm": 24, "focal_length_mm": 24.4, "sensor_width_mm": 36.0}, 6000, 4000
    ) == pytest.approx(4066.6667)
    # A resized photo whose sensor resolution was not adjusted: the equivalent is believed.
    assert focal_in_pixels(
        {"focal_35mm": 24, "focal_length_mm": 24.0, "sensor_width_mm": 9.0}, 6000, 4000
    ) == pytest.approx(4000)
    assert focal_in_pixels({}, 6000, 4000) is None
    assert focal_in_pixels({"focal_35mm": 1}, 600, 400) is None


def test_real_photos(data_dir):
    info = photo_info(data_dir / "opensfm_berlin/images/01.jpg")
    assert (info.width, info.height, info.exif["focal_35mm"]) == (3264, 2448, 35)
    assert info.exif["focal_px"] == pytest.approx(3300.5, abs=0.1)
    photo = read_photo(data_dir / "opensfm_berlin/images/01.jpg")
    other = cv2.cvtColor(cv2.imread(str(data_dir / "opensfm_berlin/images/01.jpg")), cv2.COLOR_BGR2RGB)
    assert np.abs(photo.pixels.astype(int) - other).mean() < 0.5
    depth = read_photo(data_dir / "open3d_rgbd_synthetic/depth/00003.png")
    assert depth.pixels.dtype == np.uint16
    raw = cv2.imread(str(data_dir / "open3d_rgbd_synthetic/depth/00003.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(depth.pixels[:, :, 2], raw)
    assert photo_info(data_dir / "opencv_chessboard/left11.jpg").mode == "L"
    assert photo_info(data_dir / "dbat_camcal/images/P8250040.JPG").exif["datetime"] == "2007:08:25 16:53:13"


def refused(path, word):
    for read in (
        (read_photo, photo_info) if word in ("picture", "pixels", "empty", "folder", "exist", "HEIC") else (read_photo,)
    ):
        with pytest.raises(FileError) as caught:
            read(path)
        message = str(caught.value)
        assert word in message and "\n" not in message and str(path) in message


def test_what_is_no_photo(tmp_path, rng, monkeypatch):
    path = tmp_path / "p.jpg"
    path.write_bytes(b"")
    refused(path, "empty")
    path.write_bytes(b"hello, this is text")
    refused(path, "picture")
    path.write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    refused(path, "HEIC")
    refused(tmp_path / "none.png", "exist")
    refused(tmp_path, "folder")
    Image.fromarray(picture(rng, np.uint8)).save(tmp_path / "p.bmp")
    refused(tmp_path / "p.bmp", "picture")
    Image.fromarray(picture(rng, np.uint8)).convert("CMYK").save(path)
    refused(path, "CMYK")
    tifffile.imwrite(tmp_path / "f.tif", np.zeros((5, 5), np.float32))
    refused(tmp_path / "f.tif", "32 bits")
    write_image(tmp_path / "big.png", picture(rng, np.uint16))
    write_image(tmp_path / "big8.png", picture(rng, np.uint8))
    monkeypatch.setattr(images, "MAX_PIXELS", 1000)
    refused(tmp_path / "big.png", "pixels")
    refused(tmp_path / "big8.png", "pixels")


def test_pillows_own_limit_is_left_alone(tmp_path, rng, monkeypatch):
    path = tmp_path / "p.png"
    write_image(path, picture(rng, np.uint8))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 10)
    assert read_photo(path).width == 53
    assert Image.MAX_IMAGE_PIXELS == 10


@pytest.mark.parametrize("kind", ["jpg", "png", "png16", "tif", "tif16"])
def test_truncated_photos_are_refused_in_one_line(tmp_path, rng, kind):
    path = tmp_path / f"p.{kind[:3]}"
    write_image(path, picture(rng, np.uint16 if kind.endswith("16") else np.uint8, shape=(120, 160)))
    whole = path.read_bytes()
    # Of a JPEG only the marker at its end, of a TIFF a trailing byte may go; of a PNG nothing.
    spare = {"jpg": 2, "png": 0, "tif": 1}[kind[:3]]
    ends = range(len(whole) - 30, len(whole) - spare) if kind.startswith("png") else ()
    for cut in sorted({*range(0, 300, 23), *np.linspace(300, len(whole) - spare - 1, 25).astype(int), *ends}):
        path.write_bytes(whole[:cut])
        for read in (read_photo, whole_photo_info):
            with pytest.raises(FileError) as caught:
                read(path)
            assert "\n" not in str(caught.value)
    path.write_bytes(whole)
    assert whole_photo_info(path) == photo_info(path)


@pytest.mark.parametrize("kind", ["jpg", "png", "png16", "tif", "tif16"])
def test_damaged_photos_end_in_pixels_or_in_one_line(tmp_path, rng, kind):
    path = tmp_path / f"p.{kind[:3]}"
    write_image(path, picture(rng, np.uint16 if kind.endswith("16") else np.uint8))
    whole = path.read_bytes()
    for _ in range(80):
        data = bytearray(whole)
        for at in rng.integers(0, min(len(data), 2000), 3):
            data[at] = rng.integers(0, 256)
        path.write_bytes(data)
        try:
            read_photo(path)
        except FileError as error:
            assert "\n" not in str(error)


def test_what_is_not_written(tmp_path):
    for name, pixels, kind in (
        ("p.bmp", np.zeros((2, 2), np.uint8), FileError),
        ("p.jpg", np.zeros((2, 2), np.uint16), InvalidInputError),
        ("p.png", np.zeros((2, 2), np.float32), InvalidInputError),
        ("p.png", np.zeros((2, 2, 2), np.uint8), InvalidInputError),
        ("p.png", np.zeros((0, 2), np.uint8), InvalidInputError),
        ("p.jpg", np.zeros((2, 2, 4), np.uint8), InvalidInputError),
    ):
        with pytest.raises(kind):
            write_image(tmp_path / name, pixels)
    assert list(tmp_path.iterdir()) == []


def test_depths_as_tiff(tmp_path, rng):
    depth = rng.normal(size=(20, 30)).astype(np.float32)
    write_image(tmp_path / "d.tif", depth)
    assert np.array_equal(tifffile.imread(tmp_path / "d.tif"), depth)
