"""Photos of every kind against what was put into them; nothing narrows, nothing is turned the wrong way."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from colourreg_rs import FileError
from colourreg_rs.io import images
from colourreg_rs.io.images import photo_info, read_photo, write_image


def picture(rng, dtype=np.uint8, shape=(30, 40, 3)) -> np.ndarray:
    return rng.integers(0, np.iinfo(dtype).max + 1, shape).astype(dtype)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(30, 40, 3), (30, 40)])
def test_what_is_written_is_read_bit_for_bit(tmp_path, rng, suffix, dtype, shape):
    path, pixels = tmp_path / f"p{suffix}", picture(rng, dtype, shape)
    write_image(path, pixels)
    photo = read_photo(path)
    assert photo.pixels.dtype == dtype and photo.pixels.flags.c_contiguous
    assert np.array_equal(photo.pixels, pixels if len(shape) == 3 else np.repeat(pixels[:, :, None], 3, 2))
    assert (photo.info.width, photo.info.height, photo.info.bits) == (40, 30, 8 * np.dtype(dtype).itemsize)
    # An independent reader sees the same.
    other = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(other[..., ::-1] if len(shape) == 3 else other, pixels)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_of_another_program_are_not_narrowed(tmp_path, rng, suffix, channels):
    path, pixels = tmp_path / f"p{suffix}", picture(rng, np.uint16, (30, 40, channels))
    compression = [cv2.IMWRITE_TIFF_COMPRESSION, 8] if suffix == ".tif" else []
    assert cv2.imwrite(str(path), pixels, compression)
    expected = np.repeat(pixels, 3, 2) if channels == 1 else pixels[:, :, 2::-1]
    assert np.array_equal(read_photo(path).pixels, expected)


@pytest.mark.parametrize("mode", ["L", "LA", "RGBA", "P", "1", "CMYK"])
def test_other_kinds_become_rgb_or_are_refused(tmp_path, rng, mode):
    path = tmp_path / ("p.tif" if mode == "CMYK" else "p.png")
    image = Image.fromarray(picture(rng)).convert(mode)
    image.save(path)
    if mode == "CMYK":
        with pytest.raises(FileError, match="CMYK.*convert it to sRGB"):
            read_photo(path)
    else:
        assert np.array_equal(read_photo(path).pixels, np.asarray(image.convert("RGB")))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_exif_orientation_is_applied(tmp_path, rng, orientation):
    stored = np.zeros((16, 32, 3), np.uint8)
    stored[:8, :8] = 255  # a mark in the stored image's top-left corner
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(stored).save(tmp_path / "p.png", exif=exif)
    photo = read_photo(tmp_path / "p.png")
    # Where EXIF 2.3 says that the stored row 0 and column 0 are.
    top = {1: (0, 0), 2: (0, 1), 3: (1, 1), 4: (1, 0), 5: (0, 0), 6: (0, 1), 7: (1, 1), 8: (1, 0)}[orientation]
    height, width = (16, 32) if orientation < 5 else (32, 16)
    assert photo.pixels.shape == (height, width, 3)
    assert (photo.info.width, photo.info.height, photo.info.orientation) == (width, height, orientation)
    rows = slice(0, 8) if top[0] == 0 else slice(height - 8, height)
    columns = slice(0, 8) if top[1] == 0 else slice(width - 8, width)
    assert (photo.pixels[rows, columns] == 255).all() and photo.pixels.astype(int).sum() == 8 * 8 * 3 * 255
    from PIL import ImageOps

    with Image.open(tmp_path / "p.png") as image:
        assert np.array_equal(np.asarray(ImageOps.exif_transpose(image)), photo.pixels)


def test_the_focal_length_comes_from_exif(tmp_path, data_dir):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28
    Image.new("RGB", (4000, 3000)).save(tmp_path / "p.jpg", exif=exif)
    assert photo_info(tmp_path / "p.jpg").focal_px == pytest.approx(28 / 36 * 4000)
    assert photo_info(tmp_path / "p.jpg").as_dict()["focal_35mm"] == 28
    Image.new("RGB", (40, 30)).save(tmp_path / "none.jpg")
    assert photo_info(tmp_path / "none.jpg").focal_px is None
    phone = photo_info(data_dir / "opensfm_berlin" / "images" / "01.jpg")
    assert (phone.width, phone.height) == (3264, 2448) and phone.bits == 8


def test_broken_photos_are_one_line(tmp_path, rng):
    for suffix in (".jpg", ".png", ".tif"):
        for dtype in (np.uint8, np.uint16):
            if suffix == ".jpg" and dtype == np.uint16:
                continue
            write_image(tmp_path / f"whole{suffix}", picture(rng, dtype))
            data = (tmp_path / f"whole{suffix}").read_bytes()
            for cut in (0, 3, 20, 60, len(data) // 2, len(data) - 20):
                broken = tmp_path / f"broken{suffix}"
                broken.write_bytes(data[:cut])
                try:
                    read_photo(broken)
                except FileError as error:
                    assert str(broken) in str(error) and "\n" not in str(error)
                else:
                    assert cut >= len(data) - 20, f"{suffix} cut after {cut} bytes was read"


def test_photos_that_are_too_large_or_too_deep_are_refused(tmp_path, rng, monkeypatch):
    write_image(tmp_path / "p.png", picture(rng))
    monkeypatch.setattr(images, "MAX_PIXELS", 1000)
    with pytest.raises(FileError, match="40 x 30 pixels"):
        read_photo(tmp_path / "p.png")
    monkeypatch.undo()
    tifffile.imwrite(tmp_path / "deep.tif", rng.random((30, 40)).astype(np.float32))
    with pytest.raises(FileError, match="32 bits"):
        read_photo(tmp_path / "deep.tif")
    buffer = io.BytesIO()
    Image.new("RGB", (5, 5)).save(buffer, "GIF")
    (tmp_path / "p.jpg").write_bytes(buffer.getvalue())
    with pytest.raises(FileError, match="no JPEG, PNG or TIFF"):
        read_photo(tmp_path / "p.jpg")


def test_a_failed_write_leaves_nothing(tmp_path, rng):
    with pytest.raises(FileError, match="16 bits"):
        write_image(tmp_path / "p.jpg", picture(rng, np.uint16))
    with pytest.raises(FileError, match="suffix"):
        write_image(tmp_path / "p.bmp", picture(rng))
    with pytest.raises(FileError, match="float64"):
        write_image(tmp_path / "p.png", rng.random((4, 4)))
    assert list(tmp_path.iterdir()) == []
