"""Colours the real clouds and prints the tables of docs/real-data.md: ``python -m benches.real_data --data FOLDER``.

With ``--out FOLDER`` it leaves pictures to look at: each photo, its SCI, and the coloured cloud from another place.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benches.real_data import scenes
from benches.real_data.measures import Coloured, Comparison, ViewDifference, colour, estimate, positions, spread
from benches.real_data.scenes import Scene
from colourreg_rs import (
    Camera,
    ColouriseOptions,
    PointCloud,
    Pose,
    RegisterOptions,
    Registration,
    View,
    read_cloud,
    read_photo,
    write_registration,
)
from colourreg_rs.experiments.sci_accuracy import disturbed
from colourreg_rs.io.images import write_image
from colourreg_rs.matching.correspondences import supported_scale
from colourreg_rs.matching.register_sci import register_sci
from colourreg_rs.pictures import as_8_bit, draw_cloud
from colourreg_rs.sci import render_sci, with_size

Picture = npt.NDArray[np.uint8]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="the folder of real scans and photos")
    parser.add_argument("--out", type=Path, help="a folder for pictures")
    parser.add_argument("--suffix", default=".png", choices=[".png", ".jpg"], help="of the pictures")
    options = parser.parse_args()
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="colourreg-real-") as folder:
        colours(options.data, Path(folder), options.out, options.suffix)
        estimates(options.data, Path(folder))


def row(*cells: object) -> None:
    print("| " + " | ".join(str(cell) for cell in cells) + " |")


def head(*cells: str) -> None:
    row(*cells)
    row(*["---"] * len(cells))


def share(of: npt.NDArray[np.bool_] | None, coloured: npt.NDArray[np.bool_]) -> str:
    return f"{100 * coloured[of].mean():.2f} % of {of.sum():,}" if of is not None and of.any() else "–"


def colours(data: Path, folder: Path, out: Path | None, suffix: str) -> None:
    """Every cloud with the calibration that it came with."""
    head("cloud", "points", "coloured", "of those seen", "of those hidden", "median", "mean", "correlation")
    for name, scene, options, rows in coloured_scenes(data, folder):
        found = colour(scene, folder / f"out{scene.cloud.suffix}", options)
        has = found.source > 0
        figures: tuple[str, ...] = ("–", "–", "–")
        if scene.colours is not None:
            chosen = has if scene.seen is None else has & scene.seen
            if rows is not None:
                chosen = np.zeros_like(has)
                chosen[rows] = has[rows]
            c = Comparison.of(found.rgb[chosen], scene.colours[chosen])
            figures = (f"{c.median:.2f}", f"{c.mean:.2f}", f"{c.correlation:.4f}")
        row(name, f"{len(has):,}", f"{has.sum():,}", share(scene.seen, has), share(scene.hidden, has), *figures)
        if out is not None:
            name = name.replace(" ", "-").replace(",", "").removesuffix(".jpg")
            draw(out / f"{name}{suffix}", scene, found, options and options.tolerance)
    print()


def coloured_scenes(
    data: Path, folder: Path
) -> Iterator[tuple[str, Scene, ColouriseOptions | None, npt.NDArray[np.int64] | None]]:
    """Name, scene, options, and the points whose colours are compared where not all are."""
    for name, short in (("learn0", "kinect, table"), ("region_growing_rgb_tutorial", "kinect, office")):
        yield short, scenes.kinect(data, name, folder), None, None
    for a, b in ((0, 4), (4, 0), (2, 3)):
        yield f"living room, {a} from {b}", scenes.living_room(data, folder, a, b), None, None
    scene = scenes.berlin(data, folder)
    yield "cathedral, three photos", scene, None, None
    for name, (rows, _) in scenes.berlin_observations(data).items():
        one = [view for view in scene.views if view.name == name]
        write_registration(scene.registration, Registration(tuple(one), scene.cloud))
        yield (
            f"cathedral, {name}",
            scenes.Scene(scene.cloud, scene.registration, tuple(one), scene.colours),
            None,
            rows,
        )
    yield "road", scenes.road(data, folder), None, None


def estimates(data: Path, folder: Path) -> None:
    """Views estimated anew, against the given ones."""
    head("view", "from", "centre, mm", "direction, °", "over all points, px RMS")

    def told(name: str, source: str, difference: ViewDifference) -> None:
        centre, degrees, rms = difference.centre * 1000, difference.degrees, difference.rms_px
        row(name, source, f"{centre:.3g}", f"{degrees:.2g}", f"{rms:.2g}")

    for name, short in (("learn0", "kinect, table"), ("region_growing_rgb_tutorial", "kinect, office")):
        scene = scenes.kinect(data, name, folder)
        xyz, rows = positions(scene), spread(np.nonzero(scene.seen)[0], 40)
        pixels = np.column_stack([rows % 640, rows // 640]).astype(np.float64)
        for method in ("resection", "dlt"):
            found = estimate(scene, scene.views[0], xyz[rows], pixels, folder, RegisterOptions(method=method))
            told(short, f"40 points, {method}", ViewDifference.of(found, scene.views[0], xyz[scene.seen]))
    scene = scenes.berlin(data, folder)
    xyz = positions(scene)
    for view in scene.views:
        rows, xy = scenes.berlin_observations(data)[view.name]
        found = estimate(scene, view, xyz[rows], xy, folder)
        told(f"cathedral, {view.name}", f"{len(rows):,} points", ViewDifference.of(found, view, xyz[rows]))
    for a, b in ((0, 4), (4, 0), (2, 3)):
        scene = scenes.living_room(data, folder, a, b)
        assert scene.colours is not None
        xyz, (given,) = positions(scene), scene.views
        start = disturbed(given, np.random.default_rng(1), 1.0, 0.04)
        cloud = PointCloud(xyz, rgb=(scene.colours * 256).astype(np.uint16))
        result = register_sci(cloud, read_photo(_image(given)).pixels, start)
        source = "SCI, from 1° and 40 mm beside" + ("" if result.trusted else ": not trusted")
        told(f"living room, {a} from {b}", source, ViewDifference.of(result.view, given, xyz[scene.seen]))
    scene, rough = scenes.road(data, folder), scenes.road(data, folder, rough=True)
    (given,), (start,) = scene.views, rough.views
    result = register_sci(read_cloud(scene.cloud), read_photo(_image(given)).pixels, start)
    source = "SCI, from the rough calibration" + ("" if result.trusted else ": refused, as it should not be trusted")
    told("road", source, ViewDifference.of(result.view, given, positions(scene)))


def _image(view: View) -> Path:
    assert view.image is not None
    return view.image


def draw(path: Path, scene: Scene, found: Coloured, tolerance: float | None) -> None:
    """Photo, SCI, and the coloured cloud from where the photo was taken and from beside."""
    cloud = read_cloud(found.path)
    view = scene.views[0]
    assert view.image_size is not None
    scale = min(1.0, 960 / view.image_size[0])
    width, height = (round(side * scale) for side in view.image_size)
    small = with_size(view, width, height)
    panels = [_resized(as_8_bit(read_photo(_image(view)).pixels), width, height)]
    drawn = max(0.02, min(scale, supported_scale(cloud, view)))
    at = with_size(view, *(max(8, round(side * drawn)) for side in view.image_size))
    sci = render_sci(cloud, at, tolerance=tolerance)
    panels.append(_resized(np.repeat(sci.intensity[:, :, None], 3, axis=2), width, height))
    has = (found.source > 0) & np.isfinite(cloud.xyz).all(axis=1)
    size = 2 if drawn == scale else 3
    for seen_from in (small, beside(cloud.xyz[has], small)):
        panels.append(draw_cloud(cloud.xyz[has], found.rgb[has].astype(np.uint8), seen_from, size=size))
    write_image(path, np.vstack([np.hstack(panels[:2]), np.hstack(panels[2:])]), quality=80)


def _resized(picture: npt.NDArray[Any], width: int, height: int) -> Picture:
    from PIL import Image

    return np.asarray(Image.fromarray(np.ascontiguousarray(picture)).resize((width, height)))


def beside(xyz: npt.NDArray[np.float64], view: View) -> View:
    """A view of the same things from an eighth of a turn to the right and from above."""
    core = view.core
    middle, centre = np.median(xyz, axis=0), np.asarray(core.centre)
    right, down, forward = np.asarray(core.rotation)
    distance = float((middle - centre) @ forward)
    place = middle + distance * (0.6 * right - 0.35 * down - 0.75 * forward)
    width, height = core.width, core.height
    f = float(core.params[0])
    camera = Camera("PINHOLE", width, height, {"fx": f, "fy": f, "cx": (width - 1) / 2, "cy": (height - 1) / 2})
    return View("beside", None, camera, Pose.looking_at(place, middle, up=-down))


if __name__ == "__main__":
    main()
