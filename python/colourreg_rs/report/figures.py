"""The report's diagrams, as SVG in data URIs: each stands alone, with its own names and no script."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from typing import Any

import numpy as np

from ..accuracy.agreement import Agreement
from ..accuracy.assessment import LEAST_COVER, ErrorMap, ViewAssessment
from ..accuracy.surface_picture import SurfacePicture
from ..model import FloatArray

#: Inches: on a phone as wide as the screen, at a desk two beside each other, with letters of readable size in both.
SIZE = (5.0, 3.5)
INK, BLUE, ORANGE, GREY = "#1b1f24", "#1f5fa8", "#b3470f", "#7a828c"

_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "colourreg",
    "font.family": "sans-serif",
    "font.size": 10.5,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.dpi": 96,
    "savefig.facecolor": "white",
}


def _drawn(draw: Callable[[Any, Any], None], size: tuple[float, float] = SIZE) -> str:
    """The data URI of what ``draw(figure, axes)`` draws."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure, figure.subplots())
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": "colourreg"})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue().encode()).decode("ascii")


def _photo_axes(axes: Any, width: int, height: int) -> None:
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("x, px")
    axes.set_ylabel("y, px")


def _photo_size(width: int, height: int) -> tuple[float, float]:
    """As tall as the photo asks for, within reason; room for the colour bar."""
    return SIZE[0], float(np.clip(0.8 * SIZE[0] * height / width + 0.75, 2.2, 6.5))


def error_map(assessed: ViewAssessment, grid: ErrorMap) -> str:
    """The expected position error over the whole photo, with the control points."""
    core = assessed.view.core

    def draw(figure: Any, axes: Any) -> None:
        values = np.ma.masked_invalid(grid.pixels)
        from matplotlib.ticker import MaxNLocator

        low, high = float(values.min()), float(values.max())
        levels = MaxNLocator(10).tick_values(low, max(high, low * 1.02 + 1e-9))
        filled = axes.contourf(grid.xy[:, :, 0], grid.xy[:, :, 1], values, levels=levels, cmap="viridis_r")
        _photo_axes(axes, core.width, core.height)
        points = [p for p in assessed.view.points if p.role == "control" and p.status != "rejected"]
        if points:
            xy = np.stack([p.xy for p in points])
            axes.plot(*xy.T, "o", mfc="white", mec="black", ms=4.5, label="control points")
        for k, p in enumerate(assessed.next_points, 1):
            axes.plot(*p.xy, "*", mfc="#ff5a36", mec="black", ms=11)
            axes.annotate(str(k), p.xy, xytext=(5, 4), textcoords="offset points", weight="bold", color="black")
        bar = figure.colorbar(filled, ax=axes, fraction=0.046, pad=0.03)
        bar.set_label("one sigma per axis, px")

    return _drawn(draw, _photo_size(core.width, core.height))


def residual_histogram(assessed: ViewAssessment) -> str | None:
    """Residuals of control points in px, with the curve that the adjustment leads one to expect."""
    rows = [r for r in (assessed.adjustment or {}).get("points", ()) if r["status"] == "used"]
    residuals = {p.name: p.residual_xy for p in assessed.view.points if p.residual_xy is not None}
    values, variances = [], []
    for r in rows:
        covariance = r.get("residual_covariance")
        if r["name"] in residuals and covariance and None not in (covariance[0][0], covariance[1][1]):
            values.append(residuals[r["name"]])
            variances.append((covariance[0][0], covariance[1][1]))
    if len(values) < 3:
        return None
    v, s = np.array(values), np.sqrt(np.maximum(np.array(variances), 1e-12))

    def draw(figure: Any, axes: Any) -> None:
        reach = 1.1 * max(float(np.abs(v).max()), 3 * float(np.median(s)))
        bins = np.linspace(-reach, reach, int(np.clip(2 * np.sqrt(v.size), 9, 41)) // 2 * 2 + 2)
        width = bins[1] - bins[0]
        axes.hist([v[:, 0], v[:, 1]], bins=list(bins), color=[BLUE, ORANGE], label=["in x", "in y"], stacked=True)
        x = np.linspace(-reach, reach, 301)[:, None]
        curve = _mixture(x, s.ravel()) * width
        axes.plot(x[:, 0], curve, color=INK, lw=1.8, label="expected")
        axes.set_xlabel("residual (computed − measured), px")
        axes.set_ylabel("coordinates")
        axes.yaxis.get_major_locator().set_params(integer=True)
        axes.legend(frameon=False)

    return _drawn(draw)


def _mixture(x: FloatArray, sigma: FloatArray) -> FloatArray:
    """The sum of the normal densities of all coordinates."""
    return np.asarray((np.exp(-0.5 * (x / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))).sum(1))


def standardised_histogram(assessed: ViewAssessment) -> str | None:
    """Each point against the estimate without it, in its own sigmas, with the standard normal curve."""
    values = []
    for r in (assessed.adjustment or {}).get("points", ()):
        covariance = r["leave_one_out_covariance"]
        if (
            r["status"] == "used"
            and None not in r["leave_one_out"]
            and None not in (covariance[0][0], covariance[1][1])
        ):
            values += [d / np.sqrt(covariance[k][k]) for k, d in enumerate(r["leave_one_out"]) if covariance[k][k] > 0]
    if len(values) < 6:
        return None
    v = np.array(values)

    def draw(figure: Any, axes: Any) -> None:
        reach = max(3.5, 1.1 * float(np.abs(v).max()))
        bins = np.linspace(-reach, reach, int(np.clip(2 * np.sqrt(len(v)), 9, 41)) // 2 * 2 + 2)
        axes.hist(v, bins=list(bins), color=BLUE, label="leave-one-out")
        x = np.linspace(-reach, reach, 301)
        expected = np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi) * len(v) * (bins[1] - bins[0])
        axes.plot(x, expected, color=INK, lw=1.8, label="expected")
        axes.set_xlabel("difference in its own sigmas")
        axes.set_ylabel("coordinates")
        axes.yaxis.get_major_locator().set_params(integer=True)
        axes.legend(frameon=False)

    return _drawn(draw)


def correlation_matrix(assessed: ViewAssessment) -> str | None:
    """Correlations of the estimated parameters."""
    a = assessed.adjustment or {}
    # The projection centre's coordinates are not to be taken for the principal point's.
    places = {"cx_world": "X", "cy_world": "Y", "cz_world": "Z"}
    names = [places.get(n, n) for n in a.get("parameters", ())]
    if len(names) < 2:
        return None
    values = np.array(a["correlations"], dtype=np.float64)

    def draw(figure: Any, axes: Any) -> None:
        picture = axes.imshow(values, vmin=-1, vmax=1, cmap="RdBu_r")
        axes.set_xticks(range(len(names)), names, rotation=60, ha="right")
        axes.set_yticks(range(len(names)), names)
        for spine in axes.spines.values():
            spine.set_visible(False)
        if len(names) <= 9:
            for i in range(len(names)):
                for j in range(len(names)):
                    if i != j:
                        dark = abs(values[i, j]) > 0.6
                        axes.text(j, i, f"{values[i, j]:.2f}", ha="center", va="center", fontsize=7.5,
                                  color="white" if dark else INK)  # fmt: skip
        figure.colorbar(picture, ax=axes, shrink=0.85, pad=0.02)

    return _drawn(draw, (5.0, 4.2))


def sigma_map(picture: SurfacePicture) -> str | None:
    """ColourSigma on the surfaces that the photo shows."""
    if picture.sigma is None or np.isfinite(picture.sigma).mean() < LEAST_COVER:
        return None
    values = 1e3 * picture.sigma
    height, width = values.shape
    step = max(1, round(max(height, width) / 550))

    def draw(figure: Any, axes: Any) -> None:
        from matplotlib import colormaps

        colours = colormaps["viridis_r"].with_extremes(bad="#dfe3e8")
        low, high = np.nanquantile(values, [0.01, 0.95])
        shown = axes.imshow(
            np.ma.masked_invalid(values[::step, ::step]), cmap=colours, vmin=low, vmax=max(high, low * 1.01 + 1e-9),
            interpolation="nearest",
        )  # fmt: skip
        axes.set_xticks([])
        axes.set_yticks([])
        figure.colorbar(shown, ax=axes, fraction=0.046, pad=0.03, extend="max").set_label("ColourSigma, mm")

    return _drawn(draw, _photo_size(width, height))


def sigma_histogram(picture: SurfacePicture) -> str | None:
    """How ColourSigma is distributed, as an angle, beside what others reach."""
    if picture.angle is None or not np.isfinite(picture.angle).any():
        return None
    from ..accuracy.advice import MAKERS_MRAD, THIRD_PARTY_MRAD

    values = 1e3 * picture.angle[np.isfinite(picture.angle)]

    def draw(figure: Any, axes: Any) -> None:
        low, high = float(values.min()), float(values.max())
        low, high = min(low, 0.3), max(high, 2.5 * THIRD_PARTY_MRAD)
        axes.hist(
            values,
            bins=list(np.geomspace(max(low, 1e-3), high, 50)),
            color=BLUE,
            weights=np.full(len(values), 100 / len(values)),
        )
        axes.set_xscale("log")
        ticks = [t for t in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100) if low <= t <= high]
        axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
        axes.set_xticks([], minor=True)
        top = axes.get_ylim()[1]
        for place, name in ((MAKERS_MRAD, "makers'\ncameras"), (THIRD_PARTY_MRAD, "third-party\nsoftware")):
            axes.axvline(place, color=ORANGE, lw=1.5)
            axes.text(place * 1.05, top * 0.98, name, color=ORANGE, va="top", ha="left", fontsize=8.5)
        axes.set_xlabel("position error as an angle, mrad")
        axes.set_ylabel("% of the photo")

    return _drawn(draw)


def shift_field(assessed: ViewAssessment, agreement: Agreement) -> str | None:
    """The shifts of the patches, exaggerated, with their sigmas as circles."""
    if not agreement.patches:
        return None
    core = assessed.view.core

    def draw(figure: Any, axes: Any) -> None:
        _photo_axes(axes, core.width, core.height)
        xy = np.array([(p.x, p.y) for p in agreement.patches])
        shift = np.array([p.shift for p in agreement.patches])
        strong = np.array([p.significant for p in agreement.patches])
        sigma = np.array([p.sigma for p in agreement.patches])
        usual = max(float(np.quantile(np.linalg.norm(shift, axis=1), 0.8)), 1.5 * float(np.median(sigma)), 1e-6)
        power = 10.0 ** np.floor(np.log10(core.width / 14 / usual))
        factor = power * max(s for s in (1, 2, 5) if s * power <= core.width / 14 / usual)
        # What is uncertain by more than the patch is wide says nothing, and would hide the others.
        clear = factor * sigma < core.width / 18
        axes.plot(*xy[~clear].T, "x", color=GREY, ms=5, label="too uncertain" if (~clear).any() else None)
        for which, colour, name in ((clear & ~strong, BLUE, "not significant"), (strong, ORANGE, "significant")):
            if which.any():
                axes.quiver(*xy[which].T, *(factor * shift[which]).T, angles="xy", scale_units="xy", scale=1,
                            color=colour, width=0.006, label=name)  # fmt: skip
        from matplotlib.patches import Circle

        for p, (x, y), ok in zip(agreement.patches, xy, clear | strong, strict=True):
            if not ok:
                continue
            end = (x + factor * p.shift[0], y + factor * p.shift[1])
            axes.add_patch(Circle(end, factor * p.sigma, fill=False, ec=GREY, lw=0.9))
        figure.suptitle(f"arrows {factor:g} times as long; circles: one sigma", fontsize=10)
        figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)

    width, height = _photo_size(core.width, core.height)
    return _drawn(draw, (width, height + 0.35))
