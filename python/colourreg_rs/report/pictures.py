"""The photo with residuals, and with the cloud's edges: SVG and JPEG that need nothing else."""

from __future__ import annotations

import base64
import io
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

from ..accuracy.assessment import ViewAssessment
from ..evaluate import PointError

#: The long side of the embedded photo, px, and its quality.
LONG_SIDE, QUALITY = 1100, 72
#: Labels of more points than this would cover the photo.
MOST_LABELS = 40

Image = npt.NDArray[np.uint8]


def reduced(pixels: npt.NDArray[Any]) -> Image:
    """A photo as 8-bit RGB, at the size in which it is embedded."""
    from PIL import Image as Pillow

    eight = pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)
    picture = Pillow.fromarray(np.ascontiguousarray(eight))
    picture.thumbnail((LONG_SIDE, LONG_SIDE), Pillow.Resampling.LANCZOS)
    return np.asarray(picture.convert("RGB"))


def jpeg(image: Image) -> str:
    """A data URI."""
    from PIL import Image as Pillow

    buffer = io.BytesIO()
    Pillow.fromarray(image).save(buffer, "JPEG", quality=QUALITY, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def with_edges(photo: Image, edges: npt.NDArray[np.bool_]) -> Image:
    """The photo, a little dimmed, with edges of the cloud over it."""
    from PIL import Image as Pillow

    height, width = max(photo.shape[0], edges.shape[0]), max(photo.shape[1], edges.shape[1])
    picture = np.asarray(Pillow.fromarray(photo).resize((width, height), Pillow.Resampling.LANCZOS))
    picture = (picture * 0.72).astype(np.uint8)
    drawn = Pillow.fromarray(edges).resize((width, height), Pillow.Resampling.NEAREST)
    picture[np.asarray(drawn)] = (255, 64, 200)
    return picture


def exaggeration(errors: list[PointError], width: int) -> float:
    """How much longer than they are residuals are drawn: a usual one about a thirtieth of the photo, in round steps."""
    sizes = [float(np.hypot(*e.residual_xy)) for e in errors if e.status != "rejected"]
    sizes = [s for s in sizes if np.isfinite(s)]
    if not sizes or max(sizes) == 0:
        return 1.0
    wanted = width / 30 / max(float(np.quantile(sizes, 0.8)), 1e-6)
    power = 10.0 ** np.floor(np.log10(wanted))
    steps = [s * power for s in (1, 2, 5, 10) if s * power <= wanted]
    return max(1.0, float(max(steps, default=power)))


_COLOURS = {"control": "#00e5ff", "check": "#ffe600", "rejected": "#ff5ad1"}


def kind_of(error: PointError) -> str:
    """By which colour a point is drawn."""
    return "rejected" if error.status == "rejected" else error.role


def residual_overlay(assessed: ViewAssessment, photo: str | None, caption: str) -> str:
    """An inline SVG: the photo, and each point with its exaggerated residual (from measured towards computed)."""
    core = assessed.view.core
    width, height = core.width, core.height
    points = assessed.evaluation.points if assessed.evaluation else ()
    errors = [e for e in points if np.isfinite(e.residual_xy).all()]
    factor = exaggeration(errors, width)
    unit = width / 100
    labelled, numbers = _labelled(errors), {e.name: k for k, e in enumerate(points, 1)}
    body = []
    if photo:
        body.append(f'<image href="{photo}" x="-0.5" y="-0.5" width="{width}" height="{height}"/>')
    else:
        body.append(f'<rect x="-0.5" y="-0.5" width="{width}" height="{height}" fill="#2b3038"/>')
    for e in errors:
        start = e.xy
        if start is None:
            continue
        # Rejected points are drawn as they are: exaggerated they would leave the photo.
        end = start + e.residual_xy * (1.0 if e.status == "rejected" else factor)
        colour = _COLOURS[kind_of(e)]
        line = f'x1="{start[0]:.1f}" y1="{start[1]:.1f}" x2="{end[0]:.1f}" y2="{end[1]:.1f}"'
        body.append(f'<line {line} stroke="#000" stroke-opacity=".65" stroke-width="{0.55 * unit:.2f}"/>')
        body.append(f'<line {line} stroke="{colour}" stroke-width="{0.28 * unit:.2f}"/>')
        body.append(
            f'<circle cx="{start[0]:.1f}" cy="{start[1]:.1f}" r="{0.55 * unit:.2f}" fill="none" '
            f'stroke="{colour}" stroke-width="{0.25 * unit:.2f}"/>'
        )
        if e.name in labelled:
            right = start[0] < 0.8 * width
            body.append(
                f'<text x="{start[0] + (1 if right else -1) * unit:.1f}" y="{start[1] - 0.8 * unit:.1f}" '
                f'text-anchor="{"start" if right else "end"}">{numbers[e.name]}<title>{escape(e.name)}</title></text>'
            )
    # How long a pixel is drawn.
    size = factor * _round(0.12 * width / factor)
    x, y = 2 * unit, height - 2.5 * unit
    body.append(
        f'<rect x="{x - unit:.1f}" y="{y - 5.2 * unit:.1f}" width="{size + 2 * unit:.1f}" height="{6.4 * unit:.1f}" '
        f'fill="#000" fill-opacity=".55" rx="{0.6 * unit:.1f}"/>'
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x + size:.1f}" y2="{y:.1f}" stroke="#fff" '
        f'stroke-width="{0.4 * unit:.2f}"/>'
        f'<text x="{x:.1f}" y="{y - 1.2 * unit:.1f}">{size / factor:g} px</text>'
    )
    return (
        f'<svg class="overlay" role="img" aria-label="{escape(caption, quote=True)}" '
        f'viewBox="-0.5 -0.5 {width} {height}" style="--u:{unit:.3f}px">{"".join(body)}</svg>'
    )


def _round(value: float) -> float:
    """One, two or five times a power of ten, not above."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-9)))
    return float(max(s * power for s in (1, 2, 5) if s * power <= value * 1.000001))


def _labelled(errors: list[PointError]) -> set[str]:
    if len(errors) <= MOST_LABELS:
        return {e.name for e in errors}
    rejected = [e.name for e in errors if e.status == "rejected"][:MOST_LABELS]
    worst = sorted(errors, key=lambda e: -float(np.hypot(*e.residual_xy)))[:10]
    return {*rejected, *(e.name for e in worst)}
