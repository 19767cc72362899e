"""Colours from one and from several photos, against OpenCV and against what was put in."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from colourreg_rs import Camera, InvalidInputError, Pose, View, _core

SIZE = (320, 240)


def view_at(x: float, model: str = "PINHOLE") -> _core.View:
    params = {"fx": 250.0, "fy": 250.0, "cx": 159.5, "cy": 119.5} if model != "EQUIRECTANGULAR" else {}
    return View("v", None, Camera(model, *SIZE, params), Pose.from_centre(np.eye(3), [x, 0, 0])).core


def wall(rng, n=40_000, z=10.0):
    return np.column_stack([rng.uniform(-8, 8, n), rng.uniform(-5, 5, n), np.full(n, z)])


def see(view, xyz):
    buffer = _core.DepthBuffer(view)
    buffer.add(xyz)
    return buffer.finish()


def smooth_photo(rng, dtype):
    coarse = rng.uniform(0, 250, (12, 16, 3))
    photo = cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC).clip(0, 255)
    return (photo if dtype is np.uint8 else photo * 257).astype(dtype)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_bilinear_agrees_with_opencv(rng, dtype):
    view, xyz, photo = view_at(0.0), wall(rng), smooth_photo(rng, dtype)
    rgb, source = _core.colour_points([see(view, xyz)], [photo], xyz)
    xy, _ = _core.project(view, xyz)
    inside = (xy >= -0.5).all(1) & (xy < np.array(SIZE) - 0.5).all(1)
    assert np.array_equal(source == 1, inside)
    x, y = xy[inside].astype(np.float32).T
    exact = photo.astype(np.float32) * (256 if dtype is np.uint8 else 1)
    expected = np.concatenate(
        [
            cv2.remap(exact, a[:, None], b[:, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
            for a, b in zip(np.array_split(x, 4), np.array_split(y, 4), strict=True)
        ]
    )
    error = rgb[inside] - expected
    # OpenCV rounds positions to 1/32 pixel.
    steepest = np.abs(np.diff(exact, axis=0)).max() + np.abs(np.diff(exact, axis=1)).max()
    assert np.abs(error).max() < steepest / 32 and abs(error.mean()) < steepest / 2000
    assert (rgb[~inside] == 0).all()


@pytest.mark.parametrize("sampling", ["bilinear", "bicubic"])
def test_a_point_on_a_pixel_centre_has_that_pixel_s_colour(rng, sampling):
    view = view_at(0.0)
    photo = rng.integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    column, row = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    z = 4.0
    # Powers of two, so that the projection is exact.
    camera = Camera("PINHOLE", *SIZE, {"fx": 256.0, "fy": 256.0, "cx": 160.0, "cy": 120.0})
    view = View("v", None, camera, Pose(np.eye(3), np.zeros(3))).core
    xyz = np.column_stack([(column.ravel() - 160) / 256 * z, (row.ravel() - 120) / 256 * z, np.full(column.size, z)])
    rgb, source = _core.colour_points([see(view, xyz)], [photo], xyz, sampling=sampling)
    assert (source == 1).all()
    assert np.array_equal(rgb.reshape(photo.shape), photo.astype(np.uint16) * 256)


def test_several_photos(rng):
    xyz = wall(rng)
    maps = [see(view_at(x), xyz) for x in (-3.0, 0.0, 3.0)]
    photos = [np.full((SIZE[1], SIZE[0], 3), v, np.uint8) for v in (100, 120, 200)]
    seen = np.stack([m.visible(xyz) for m in maps])
    rgb, source = _core.colour_points(maps, photos, xyz)
    assert np.array_equal(source > 0, seen.any(0))
    assert seen[source[source > 0] - 1, np.flatnonzero(source)].all()
    assert np.array_equal(rgb[source > 0, 0], np.array([100, 120, 200])[source[source > 0] - 1] * 256)
    # A photo's own side is seen best by it.
    inside = np.abs(xyz[:, 1]) < 3
    for number, x in ((1, -5.0), (2, 0.0), (3, 5.0)):
        assert (source[(np.abs(xyz[:, 0] - x) < 0.3) & inside] == number).all()
    mean, _ = _core.colour_points(maps, photos, xyz, blend="mean")
    three = seen.all(0)
    assert (mean[three, 0] > 100 * 256).all() and (mean[three, 0] < 200 * 256).all()
    median, _ = _core.colour_points(maps, photos, xyz, blend="median")
    assert (np.abs(median[three & (np.abs(xyz[:, 0]) < 1), 0] / 256.0 - 120) < 12).all()


def test_gains_level_photos_that_differ_in_exposure(rng):
    xyz = wall(rng)
    maps = [see(view_at(x), xyz) for x in (-2.0, 0.0, 2.0)]
    truth = np.array([[1.0, 1.0, 1.0], [0.8, 0.9, 1.0], [1.2, 1.1, 0.9]])
    texture = lambda x, y: 110 + 40 * np.sin(1.3 * x) * np.cos(0.9 * y)  # noqa: E731
    photos = []
    column, row = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    for x, gain in zip((-2.0, 0.0, 2.0), truth, strict=True):
        grey = texture((column - 159.5) / 250 * 10 + x, (row - 119.5) / 250 * 10)
        photos.append(np.rint(grey[..., None] * gain).astype(np.uint8))
    exposure = _core.Exposure(3)
    for chunk in np.array_split(xyz, 5):
        exposure.add(maps, photos, np.ascontiguousarray(chunk))
    gains = exposure.gains()
    levelled = gains * truth
    assert np.abs(levelled / levelled.mean(0) - 1).max() < 0.02
    rgb, source = _core.colour_points(maps, photos, xyz, gains=gains, blend="mean")
    expected = texture(xyz[:, 0], xyz[:, 1])[:, None] * levelled.mean(0) * 256
    ok = source > 0
    assert np.abs(rgb[ok] / expected[ok] - 1).max() < 0.05


def test_given_arrays_are_written_and_unseen_points_keep_their_colour(rng):
    xyz = wall(rng, 1000)
    xyz[::3] = np.nan
    rgb, source = np.full((1000, 3), 7, np.uint16), np.full(1000, 9, np.uint16)
    photo = np.full((SIZE[1], SIZE[0], 3), 50, np.uint8)
    got, _ = _core.colour_points([see(view_at(0.0), xyz)], [photo], xyz, out_rgb=rgb, out_source=source)
    assert got is rgb
    assert (source[::3] == 0).all() and (rgb[::3] == 7).all()
    assert set(source) == {0, 1} and (rgb[source == 1] == 50 * 256).all()


def test_what_does_not_belong_together_is_refused(rng):
    seen = see(view_at(0.0), wall(rng, 100))
    photo = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    xyz = np.zeros((1, 3))
    with pytest.raises(InvalidInputError, match="photo 1 has 319 × 240 pixels, its camera 320 × 240"):
        _core.colour_points([seen], [np.ascontiguousarray(photo[:, 1:])], xyz)
    with pytest.raises(InvalidInputError, match="1 maps and 2 photos"):
        _core.colour_points([seen], [photo, photo], xyz)
    with pytest.raises(TypeError, match=r"photos\[0\] must be a C-contiguous uint8 array"):
        _core.colour_points([seen], [photo.astype(float)], xyz)
    with pytest.raises(InvalidInputError, match='no sampling "cubic"'):
        _core.colour_points([seen], [photo], xyz, sampling="cubic")
    with pytest.raises(InvalidInputError, match="gain"):
        _core.colour_points([seen], [photo], xyz, gains=np.zeros((1, 3)))


def test_a_panorama_and_a_fisheye_colour_all_around(rng):
    direction = rng.normal(size=(60_000, 3))
    xyz = direction / np.linalg.norm(direction, axis=1)[:, None] * 6.0
    photo = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    photo[..., 0] = np.arange(SIZE[0]) * 255 // SIZE[0]
    photo[..., 1] = np.arange(SIZE[1])[:, None]
    for model in ("EQUIRECTANGULAR", "OPENCV_FISHEYE"):
        view = view_at(0.0, model)
        seen = see(view, xyz)
        xy, _ = _core.project(view, xyz)
        inside = (xy >= -0.5).all(1) & (xy < np.array(SIZE) - 0.5).all(1)
        rgb, source = _core.colour_points([seen], [photo], xyz)
        assert (source[inside] == 1).mean() > 0.999 and (source[~inside] == 0).all()
        ok = inside & (source == 1) & (xy[:, 1] > 0) & (xy[:, 1] < SIZE[1] - 1)
        assert np.abs(rgb[ok, 1] / 256.0 - xy[ok, 1]).max() < 0.02
    near = xyz * 0.5
    both = np.concatenate([near[:50_000], xyz])
    seen = see(view_at(0.0, "EQUIRECTANGULAR"), both)
    visible = seen.visible(both)
    assert visible[:50_000].mean() > 0.99 and visible[50_000:].mean() < 0.02
