"""Pictures of the experiments, like the paper's Figures 2 to 4."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

from ..backproject import BackprojectOptions, backproject
from ..model import Camera, FloatArray, Pose, View
from ..pictures import Image, draw_cloud
from .table1 import Grey, Matched, Table1, interest_points
from .table2 import Table2

#: Widths of one part of a picture, and the part of the corner's photo that is enlarged, as shares of it.
WIDTH = 640
DETAIL = (0.30, 0.38, 0.56, 0.64)

RED, GREEN, YELLOW, WHITE = (255, 70, 60), (90, 230, 110), (255, 220, 60), (255, 255, 255)


def table1_pictures(result: Table1) -> dict[str, Image]:
    """By name: both images, the points before and after ICP, the right and the wrong end, the back-projection."""
    sci = result.setup.sci.intensity.astype(np.uint8)
    parts = {
        "figure-2": [("SCI: what the scanner saw", _rgb(sci)), ("SRCI: the simulated photo", _rgb(result.photo))],
        "figure-3": [
            ("before ICP", _points(sci, result.matched, np.eye(3))),
            ("after ICP", _points(sci, result.matched, result.matched.icp.transform)),
        ],
        "figure-4": [
            ("(a) SCI red, moved photo cyan", _fringes(sci, result.photo, result.matched)),
            ("(b) wrong translation: " + _accepted(result.failed), _fringes(sci, result.failed_photo, result.failed)),
        ],
        "back-projection": [("the photo's pixels in space: the paper's method", _in_space(result, True))],
    }
    parts["back-projection"].append(("this package", _in_space(result, False)))
    return {name: _beside(pictures) for name, pictures in parts.items()}


def _accepted(matched: Matched) -> str:
    return "accepted" if matched.icp.accepted else "refused"


def _rgb(grey: Grey) -> Image:
    return np.repeat(grey[..., None], 3, axis=2)


def _beside(parts: list[tuple[str, Image]]) -> Image:
    """Pictures at the same height, each with its title."""
    titled = []
    for title, picture in parts:
        height = round(picture.shape[0] * WIDTH / picture.shape[1])
        small = PillowImage.fromarray(picture).resize((WIDTH, height), PillowImage.Resampling.LANCZOS)
        draw = ImageDraw.Draw(small)
        font = ImageFont.load_default(18)
        box = draw.textbbox((10, 8), title, font=font)
        draw.rectangle((box[0] - 6, box[1] - 4, box[2] + 6, box[3] + 4), fill=(0, 0, 0))
        draw.text((10, 8), title, fill=WHITE, font=font)
        titled.append(np.asarray(small))
    height = min(p.shape[0] for p in titled)
    gap = np.full((height, 6, 3), 255, np.uint8)
    row = [titled[0][:height]]
    for picture in titled[1:]:
        row += [gap, picture[:height]]
    return np.ascontiguousarray(np.concatenate(row, axis=1))


def _points(sci: Grey, matched: Matched, transform: FloatArray) -> Image:
    """A part of the SCI, enlarged, with its interest points as green circles and the photo's as red dots."""
    height, width = sci.shape
    x0, y0, x1, y1 = (round(share * n) for share, n in zip(DETAIL, (width, height, width, height), strict=True))
    scale = 3
    picture = PillowImage.fromarray((_rgb(sci[y0:y1, x0:x1]) * 0.55).astype(np.uint8))
    picture = picture.resize(((x1 - x0) * scale, (y1 - y0) * scale), PillowImage.Resampling.BICUBIC)
    draw = ImageDraw.Draw(picture)

    def place(points: FloatArray) -> list[list[float]]:
        at = (points - [x0, y0] + 0.5) * scale
        inside = (at > 0).all(axis=1) & (at < [picture.width, picture.height]).all(axis=1)
        return [[float(x), float(y)] for x, y in at[inside]]

    for x, y in place(interest_points(sci)):
        draw.ellipse((x - 6, y - 6, x + 6, y + 6), outline=GREEN, width=2)
    moved = np.column_stack([matched.points, np.ones(len(matched.points))]) @ transform.T
    for x, y in place(moved[:, :2] / moved[:, 2:]):
        draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill=RED)
    return np.asarray(picture)


def _fringes(sci: Grey, photo: Grey, matched: Matched) -> Image:
    """The SCI in red, the photo brought over it in green and blue: grey where they agree."""
    height, width = sci.shape
    rows, columns = np.mgrid[0:height, 0:width]
    inverse = np.linalg.inv(matched.icp.transform)
    source = np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)], axis=1) @ inverse.T
    at = np.rint(source[:, :2] / source[:, 2:]).astype(np.int64)
    inside = ((at >= 0) & (at < [width, height])).all(axis=1)
    moved = np.zeros(rows.size, np.uint8)
    moved[inside] = photo[at[inside, 1], at[inside, 0]]
    moved = moved.reshape(height, width)
    return np.ascontiguousarray(np.stack([sci, moved, moved], axis=2))


def _in_space(result: Table1, paper: bool) -> Image:
    """The corner's coloured points from above and beside, after either method; where they are off by more than 20 mm,
    red."""
    setup = result.setup
    view = setup.view if paper else result.pipeline.view
    photo = result.photo
    if paper:
        moved = _fringes(setup.sci.intensity.astype(np.uint8), photo, result.matched)[..., 1]
        photo = np.ascontiguousarray(moved)
    back = backproject(setup.scan, view, photo, options=BackprojectOptions())
    rgb = back.cloud.rgb
    assert rgb is not None
    shade = np.ascontiguousarray(rgb)
    off = _displacement(result, back.cloud.xyz, back.pixels.astype(np.float64), paper)
    shade[off > 0.02] = np.stack([shade[off > 0.02, 0] // 2 + 32768, *(shade[off > 0.02, 0] // 4,) * 2], axis=1)
    eye = View(
        "above", None,
        Camera("PINHOLE", 1200, 870, {"fx": 1500.0, "fy": 1500.0, "cx": 600.0, "cy": 435.0}),
        Pose.looking_at((-14.0, -44.0, 24.0), (0.0, 4.0, 7.0)),
    )  # fmt: skip
    return draw_cloud(back.cloud.xyz, shade, eye, size=2)


def _displacement(result: Table1, xyz: FloatArray, pixels: FloatArray, paper: bool) -> FloatArray:
    """How far, m, each point's colour was taken from where it belongs, across the ray."""
    from .. import _core

    belongs, depth = _core.project(result.truth.core, np.ascontiguousarray(xyz))
    taken = pixels
    if paper:
        inverse = np.linalg.inv(result.matched.icp.transform)
        source = np.column_stack([pixels, np.ones(len(pixels))]) @ inverse.T
        taken = source[:, :2] / source[:, 2:]
    camera = result.setup.view.camera
    assert camera is not None
    return np.asarray(np.linalg.norm(taken - belongs, axis=1) * depth / camera.params["fx"])


def table2_picture(result: Table2) -> Image:
    """The photo with the residuals of both methods, five times as long, at the targets; spoiled ones marked."""
    picture = PillowImage.fromarray(result.trial.photo.image)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(15)
    true = result.trial.xy
    for colour, estimate, width in ((RED, result.dlt, 3), (GREEN, result.package, 3)):
        for at, residual in zip(result.readings.xy, estimate.residuals, strict=True):
            end = at + 5 * np.asarray(residual)
            draw.line([*map(float, at), *map(float, end)], fill=colour, width=width)
    for name, index in zip(result.trial.names, range(len(true)), strict=True):
        x, y = (float(v) for v in result.readings.xy[index])
        spoiled = index in result.readings.spoiled
        draw.ellipse((x - 5, y - 5, x + 5, y + 5), outline=YELLOW if spoiled else WHITE, width=2)
        draw.text(
            (x + 8, y + 6), name + (" (spoiled)" if spoiled else ""), fill=YELLOW if spoiled else WHITE, font=font
        )
    legend = "residuals x 5: red, DLT; green, this package"
    box = draw.textbbox((12, 10), legend, font=font)
    draw.rectangle((box[0] - 6, box[1] - 4, box[2] + 6, box[3] + 4), fill=(0, 0, 0))
    draw.text((12, 10), legend, fill=WHITE, font=font)
    return np.asarray(picture)


def as_pictures(table1: Table1 | None, table2: Table2 | None) -> dict[str, npt.NDArray[Any]]:
    """All pictures by name."""
    pictures: dict[str, npt.NDArray[Any]] = {}
    if table1 is not None:
        pictures |= {f"table1-{name}": picture for name, picture in table1_pictures(table1).items()}
    if table2 is not None:
        pictures["table2-residuals"] = table2_picture(table2)
    return pictures
