"""The synthetic camera image against scenes that can be written down."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from colourreg_rs import Camera, InvalidInputError, PointCloud, Pose, View, _core
from colourreg_rs.io.sci import write_sci
from colourreg_rs.sci import draw_points, points_of, render_sci, with_size

PINHOLE = Camera("PINHOLE", 240, 180, {"fx": 220.0, "fy": 220.0, "cx": 118.0, "cy": 91.0})
TERMS = {"k1": -0.12, "k2": 0.03, "p1": 1e-3, "p2": -5e-4}
CAMERAS = {
    "PINHOLE": PINHOLE,
    "OPENCV": Camera("OPENCV", 240, 180, {**PINHOLE.params, **TERMS}),
    "OPENCV_FISHEYE": Camera("OPENCV_FISHEYE", 240, 200, {"fx": 80.0, "fy": 80.0, "cx": 119.5, "cy": 99.5, "k1": 0.02}),
    "EQUIRECTANGULAR": Camera("EQUIRECTANGULAR", 360, 180),
}


def paint(xyz: np.ndarray) -> np.ndarray:
    """A smooth pattern on all surfaces."""
    return 100.0 + 40.0 * np.sin(2.0 * xyz[:, 0] + xyz[:, 2]) + 30.0 * np.cos(2.5 * xyz[:, 1])


def box(rng: np.random.Generator, n: int) -> PointCloud:
    """The inside of a box of 8 x 6 x 10 m; the intensity follows the laser radar equation from (0, 0, 0)."""
    size = np.array([8.0, 6.0, 10.0])
    face = rng.integers(0, 6, n)
    xyz = rng.uniform(-0.5, 0.5, (n, 3)) * size
    axis, side = face % 3, np.where(face < 3, -0.5, 0.5)
    xyz[np.arange(n), axis] = side * size[axis]
    normals = np.zeros((n, 3))
    normals[np.arange(n), axis] = -np.sign(side)
    r = np.linalg.norm(xyz, axis=1)
    cosine = np.abs((xyz * normals).sum(1)) / r
    return PointCloud(xyz, intensity=(1e4 * paint(xyz) / r**2 * cosine).astype(np.float32), normals=normals)


@pytest.mark.parametrize("model", CAMERAS)
def test_an_sci_shows_what_the_camera_sees(model, rng):
    cloud = box(rng, 400_000)
    view = View("v", None, CAMERAS[model], Pose.from_centre(np.eye(3), [0.3, -0.2, 0.1]))
    sci = render_sci(cloud, view, station=np.zeros(3), exponents=(-2.0, 1.0))
    rows, columns = np.nonzero(sci.measured)
    pixels = np.stack([columns, rows], 1)
    xyz, xy = points_of(sci, cloud, pixels)
    projected, depth = _core.project(view.core, xyz)
    assert np.abs(projected - xy).max() < 1e-4
    assert np.abs(sci.subpixel[sci.measured]).max() <= 0.5 + 1e-6
    assert np.abs(depth / sci.depth[sci.measured] - 1).max() < 1e-6
    # Every pixel that looks at the box was measured or filled, with the depth of the box.
    grid = np.stack(np.meshgrid(np.arange(view.camera.width), np.arange(view.camera.height)), -1).reshape(-1, 2)
    rays = _core.unproject(view.core, grid.astype(np.float64))
    inside = np.isfinite(rays).all(1).reshape(sci.depth.shape)
    rays = np.nan_to_num(rays, nan=1.0)
    if model == "EQUIRECTANGULAR":  # towards the poles a row of pixels shrinks to a point
        inside[:15] = inside[-15:] = False
    assert sci.seen[inside].mean() > 0.995
    rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    t = ((np.sign(rays) * [4.0, 3.0, 5.0] - view.core.centre) / rays).min(axis=1)
    truth = _core.project(view.core, view.core.centre + rays * t[:, None])[1]
    error = np.abs(sci.depth / truth.reshape(sci.depth.shape) - 1)
    # Half a pixel beside a point at grazing incidence is some per cent of the depth.
    assert np.nanquantile(error[sci.measured & inside], 0.99) < 0.1
    # Range and incidence are gone from the grey values: what is left is the paint.
    at_centres = sci.at_centres[inside & sci.seen]
    expected = paint(view.core.centre + rays * t[:, None])[(inside & sci.seen).ravel()]
    ok = np.isfinite(at_centres)
    assert np.corrcoef(at_centres[ok], expected[ok])[0, 1] > 0.97
    assert sci.intensity.dtype == np.uint8 and sci.intensity.max() == 255


@pytest.mark.parametrize("model", ["OPENCV", "EQUIRECTANGULAR"])
def test_splats_are_squares_about_the_points(model, rng):
    cloud = box(rng, 5_000)
    view = View("v", None, CAMERAS[model], Pose.from_centre(np.eye(3), [0.3, -0.2, 0.1]))
    sci = render_sci(cloud, view, splat=3, fill=0)
    plain = render_sci(cloud, view, hide=False, fill=0)
    assert sci.measured.sum() > 3 * plain.measured.sum()
    assert np.abs(sci.subpixel[sci.measured]).max() <= 1.5 + 1e-6
    assert (sci.depth[plain.measured] <= plain.depth[plain.measured]).all()
    xyz = cloud.xyz[sci.index[sci.measured]]
    assert np.abs(_core.project(view.core, xyz)[1] / sci.depth[sci.measured] - 1).max() < 1e-6
    with pytest.raises(InvalidInputError, match="odd"):
        render_sci(cloud, view, splat=2)


@pytest.mark.parametrize("splat", [1, 3])
@pytest.mark.parametrize("model", ["OPENCV", "EQUIRECTANGULAR"])
def test_a_plain_picture_shows_the_nearest_point_of_each_square(model, splat, rng):
    cloud = box(rng, 5_000)
    view = View("v", None, CAMERAS[model], Pose.from_centre(np.eye(3), [0.3, -0.2, 0.1]))
    depth, intensity = draw_points(cloud, view, splat=splat)
    sci = render_sci(cloud, view, splat=splat, fill=0, exponents=(0.0, 0.0))
    assert np.allclose(depth, sci.depth, rtol=1e-6, equal_nan=True)
    assert np.array_equal(intensity, sci.raw, equal_nan=True) and 0.01 < np.isfinite(intensity).mean() < 0.99
    # Without intensities the luminance, without colours nothing.
    grey = np.full((len(cloud), 3), 7, np.uint16)
    assert set(np.unique(draw_points(PointCloud(cloud.xyz, rgb=grey), view)[1]).round(3)[:1]) == {7.0}
    assert np.nanmax(np.abs(draw_points(PointCloud(cloud.xyz), view)[1])) == 0.0
    with pytest.raises(InvalidInputError, match="odd"):
        draw_points(cloud, view, splat=2)


def test_intensity_at_the_centres_does_not_follow_the_points_about(rng):
    """A wall sampled once for each pixel: drawn as it is the pattern is torn, at the centres it is not."""
    n = 60_000
    xyz = np.column_stack([rng.uniform(-5, 5, n), rng.uniform(-4, 4, n), np.full(n, 8.0)])
    cloud = PointCloud(xyz, intensity=(100 + 50 * np.sin(9 * xyz[:, 0]) * np.cos(8 * xyz[:, 1])).astype(np.float32))
    view = View("v", None, PINHOLE, Pose(np.eye(3), np.zeros(3)))
    sci = render_sci(cloud, view, exponents=(0.0, 0.0))
    u, v = np.meshgrid((np.arange(240) - 118.0) * 8 / 220, (np.arange(180) - 91.0) * 8 / 220)
    truth = 100 + 50 * np.sin(9 * u) * np.cos(8 * v)
    part = np.s_[20:160, 20:220]
    measured = sci.measured[part]
    torn = np.std((sci.raw - truth)[part][measured])
    mended = np.std((sci.at_centres - truth)[part])
    assert mended < 0.6 * torn
    # The same point that is drawn in the pixel is the one that the index names.
    assert np.array_equal(sci.raw[sci.measured], cloud.intensity[sci.index[sci.measured]])


def test_nothing_is_filled_across_a_depth_edge(rng):
    """A board before a wall, both so thinly scanned that half of the pixels are empty."""
    n = 30_000
    wall = np.column_stack([rng.uniform(-9, 9, n), rng.uniform(-7, 7, n), np.full(n, 16.0)])
    board = np.column_stack([rng.uniform(-1, 1, n // 8), rng.uniform(-1, 1, n // 8), np.full(n // 8, 6.0)])
    cloud = PointCloud(np.vstack([wall, board]), intensity=np.ones(n + n // 8, np.float32))
    view = View("v", None, PINHOLE, Pose(np.eye(3), np.zeros(3)))
    sci = render_sci(cloud, view)
    depth = sci.depth[np.isfinite(sci.depth)]
    assert (sci.seen & ~sci.measured).sum() > 8000
    assert ((np.abs(depth - 16) < 0.2) | (np.abs(depth - 6) < 0.1)).all()
    centre = sci.depth[91 - 30 : 91 + 30, 118 - 30 : 118 + 30]
    assert (np.abs(centre[np.isfinite(centre)] - 6) < 0.1).all() and np.isfinite(centre).mean() > 0.97


def test_chunks_threads_and_order_of_calls_do_not_show(rng):
    cloud = box(rng, 60_000)
    view = View("v", None, CAMERAS["OPENCV"], Pose(np.eye(3), np.zeros(3)))
    whole = render_sci(cloud, view)
    parts = [
        PointCloud(
            cloud.xyz[i : i + 7000], intensity=cloud.intensity[i : i + 7000], normals=cloud.normals[i : i + 7000]
        )
        for i in range(0, len(cloud), 7000)
    ]
    chunked = render_sci(parts, view)
    for name in ("intensity", "raw", "depth", "index", "subpixel", "measured", "normals"):
        assert getattr(whole, name).tobytes() == getattr(chunked, name).tobytes(), name
    assert whole.at_centres.tobytes() == chunked.at_centres.tobytes()
    with pytest.raises(InvalidInputError, match="reads the chunks twice"):
        render_sci(iter(parts), view)


def test_the_bits_do_not_depend_on_the_number_of_threads(tmp_path):
    code = (
        "import sys, hashlib, numpy as np; sys.path.insert(0, sys.argv[1]); from test_sci import *;"
        "cloud = box(np.random.default_rng(1), 80_000);"
        "s = render_sci(cloud, View('v', None, CAMERAS['PINHOLE'], Pose(np.eye(3), np.zeros(3))));"
        "h = hashlib.sha256();"
        "[h.update(a.tobytes()) for a in (s.intensity, s.raw, s.depth, s.index, s.subpixel, s.at_centres)];"
        "print(h.hexdigest())"
    )
    import os
    from pathlib import Path

    folder = str(Path(__file__).parent)
    run = [
        subprocess.run(
            [sys.executable, "-c", code, folder],
            env={**os.environ, "RAYON_NUM_THREADS": threads, "PYTHONPATH": os.pathsep.join(sys.path)},
            capture_output=True, text=True, check=True,
        ).stdout
        for threads in ("1", "5")
    ]  # fmt: skip
    assert run[0] == run[1] and len(run[0]) > 60


def test_colour_stands_in_for_intensity_and_nothing_for_neither(rng):
    cloud = box(rng, 30_000)
    rgb = rng.integers(0, 65535, (len(cloud), 3)).astype(np.uint16)
    view = View("v", None, PINHOLE, Pose(np.eye(3), np.zeros(3)))
    sci = render_sci(PointCloud(cloud.xyz, rgb=rgb), view, bits=16)
    assert sci.source == "colour" and sci.intensity.dtype == np.uint16 and sci.exponents == (0.0, 0.0)
    assert np.array_equal(sci.colour[sci.measured], rgb[sci.index[sci.measured]])
    expected = rgb[sci.index[sci.measured]] @ [0.299, 0.587, 0.114]
    assert np.abs(sci.raw[sci.measured] - expected).max() < 0.01
    bare = render_sci(PointCloud(cloud.xyz), view)
    assert bare.source is None and not bare.intensity.any() and bare.seen.any()
    with pytest.raises(InvalidInputError, match="no intensity to show"):
        render_sci(PointCloud(cloud.xyz), view, source="intensity")


def test_a_resized_view_sees_the_same_field(rng):
    for camera in (CAMERAS["OPENCV"], CAMERAS["OPENCV_FISHEYE"], CAMERAS["EQUIRECTANGULAR"]):
        view = View("v", None, camera, Pose(np.eye(3), np.zeros(3)))
        half = with_size(view, camera.width // 2, camera.height // 2)
        xyz = box(rng, 2000).xyz
        a, b = _core.project(view.core, xyz)[0], _core.project(half.core, xyz)[0]
        ok = np.isfinite(a).all(1) & (np.abs(a) < 1000).all(1)
        assert np.abs((a[ok] + 0.5) / 2 - 0.5 - b[ok]).max() < 1e-9
    P = View("v", None, PINHOLE, Pose(np.eye(3), np.zeros(3))).core.matrix()
    dlt = View("d", None, dlt=P, size=(240, 180))
    assert with_size(dlt, 120, 90).core.params[:2] == pytest.approx([110.0, 110.0])


def test_an_sci_is_written_and_read_back(tmp_path, rng):
    import tifffile
    from PIL import Image

    cloud = box(rng, 30_000)
    view = View("v", None, PINHOLE, Pose(np.eye(3), np.zeros(3)))
    sci = render_sci(cloud, view)
    paths = write_sci(tmp_path / "a" / "sci", sci)
    names = {p.name for p in paths}
    assert {"intensity.png", "depth.tif", "index.tif", "subpixel.tif", "measured.png", "view.json"} <= names
    folder = tmp_path / "a" / "sci"
    assert np.array_equal(np.asarray(Image.open(folder / "intensity.png")), sci.intensity)
    assert np.array_equal(tifffile.imread(folder / "depth.tif"), sci.depth, equal_nan=True)
    assert np.array_equal(tifffile.imread(folder / "index.tif"), sci.index)
    assert np.array_equal(tifffile.imread(folder / "subpixel.tif")[0], sci.subpixel[..., 0], equal_nan=True)
    assert sorted(p.name for p in folder.iterdir()) == sorted(names)


def test_kinect_cloud_gives_its_own_photo_back(data_dir):
    """An organised cloud that carries its whole photo: the SCI's colours are the photo's, pixel by pixel."""
    from colourreg_rs.io.clouds import read_cloud

    cloud = read_cloud(data_dir / "pcl_osd_kinect" / "learn0.pcd")
    keep = np.isfinite(cloud.xyz).all(1)
    camera = Camera("PINHOLE", 640, 480, {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5})
    view = View("v", None, camera, Pose(np.eye(3), np.zeros(3)))
    sci = render_sci(PointCloud(cloud.xyz[keep], rgb=cloud.rgb[keep]), view, hide=False)
    photo = cloud.rgb.reshape(480, 640, 3)
    assert sci.measured.mean() > 0.5
    difference = np.abs(sci.colour.astype(int) - photo)[sci.measured].max(1)
    assert (difference == 0).mean() > 0.99
