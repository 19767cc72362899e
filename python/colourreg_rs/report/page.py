"""From assessments to the page: numbers become short strings here, and the template lays them out."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..accuracy.advice import advice, figure, headline
from ..accuracy.agreement import Agreement
from ..accuracy.assessment import ViewAssessment
from ..evaluate import Accuracy, PointError
from ..io.atomic import write_text
from . import figures, pictures
from .formulas import FORMULAS

_HERE = Path(__file__).parent

_UNITS = {
    "rx": "mrad", "ry": "mrad", "rz": "mrad", "cx_world": "m", "cy_world": "m", "cz_world": "m",
    "f": "px", "fx": "px", "fy": "px", "cx": "px", "cy": "px", "skew": "px",
}  # fmt: skip


def write_report(
    path: str | Path,
    assessed: Sequence[ViewAssessment],
    photos: Sequence[Any],
    *,
    title: str,
    cloud: str | None = None,
) -> None:
    """Writes one self-contained page, atomically. ``photos``: the pixels of each view's photo, or ``None``."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(_HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["code"] = _code
    views = [_view(a, photo) for a, photo in zip(assessed, photos, strict=True)]
    text = environment.get_template("report.html.j2").render(
        title=title,
        cloud=cloud,
        views=views,
        formulas=FORMULAS,
        version=__version__,
        css=(_HERE / "style.css").read_text(encoding="utf-8"),
    )
    write_text(path, text)


def _code(text: str) -> Any:
    """What stands between backticks as code; everything else as it is."""
    from markupsafe import Markup, escape

    return Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", str(escape(text))))


def _number(value: float | None, digits: int = 2) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _short(value: float | None) -> str:
    """Three significant digits."""
    return "–" if value is None or not np.isfinite(value) else f"{value:.3g}"


def _view(assessed: ViewAssessment, pixels: Any) -> dict[str, Any]:
    word, sentence = headline(assessed)
    small = None if pixels is None else pictures.reduced(pixels)
    errors = list(assessed.evaluation.points) if assessed.evaluation else []
    surface = assessed.surface
    edges = None
    if surface is not None and small is not None:
        edges = pictures.jpeg(pictures.with_edges(small, surface.edges))
    a = assessed.adjustment or {}
    caption = (
        f"Photo {assessed.view.name} with {len(errors)} points and their residuals as lines from the measured to the "
        "computed place"
    )
    factor = pictures.exaggeration([e for e in errors if np.isfinite(e.residual_xy).all()], assessed.view.core.width)
    photo = None if small is None else pictures.jpeg(small)
    return {
        "name": assessed.view.name,
        "word": word,
        "headline": sentence,
        "advice": advice(assessed),
        "notes": [*assessed.notes, *(assessed.evaluation.remarks() if assessed.evaluation else ())],
        "tiles": _tiles(assessed),
        "overlay": pictures.residual_overlay(assessed, photo, caption) if errors else None,
        "factor": f"{factor:g}",
        "rms": _rms_rows(assessed),
        "charts": _charts(assessed),
        "next_points": _next_rows(assessed),
        "agreements": [_agreement(x) for x in assessed.agreement],
        "agreement_charts": _agreement_charts(assessed),
        "edges": edges,
        "points": _point_rows(assessed),
        "test_caption": _test_caption(a),
        "parameters": _parameters(assessed),
        "correlated": ", ".join(f"{x} and {y} ({r:.3f})" for x, y, r in a.get("high_correlations", ())),
        "correlations": figures.correlation_matrix(assessed),
    }


def _tiles(assessed: ViewAssessment) -> list[dict[str, str]]:
    """The figures that one looks for first."""
    tiles = []
    s, a = assessed.view.statistics, assessed.adjustment or {}
    if assessed.error_map:
        f = assessed.error_map.figures()
        tiles.append(("expected error, median", f"{f['px']['median']:.2f} px = {figure(f['mm']['median'])} mm"))
        tiles.append(("expected error, at worst", f"{f['px']['largest']:.2f} px = {figure(f['mm']['largest'])} mm"))
    colour = assessed.surface.figures() if assessed.surface else None
    if colour:
        tiles.append(("ColourSigma on the surfaces, median", f"{figure(colour['mm']['median'])} mm"))
        tiles.append(("the same as an angle", f"{colour['mrad']['median']:.2f} mrad"))
    e = assessed.evaluation
    if e and e.check:
        tiles.append((f"check points ({e.check.n}), RMS radial", f"{e.check.rmse:.2f} px"))
    elif e and e.control:
        tiles.append((f"control points ({e.control.n}), RMS radial", f"{e.control.rmse:.2f} px"))
    if "sigma0" in s:
        name = f"σ₀ with {s['dof']:g} degrees of freedom"
        test = a.get("variance_test")
        if test:
            name += f"; test {'passed' if test['accepted'] else 'failed'} at {test['alpha']:g}"
        tiles.append((name, f"{s['sigma0']:.2f}"))
    if a and a.get("sigma_xy_found") is not None:
        origin = "stated" if a["sigma_xy_known"] else "not stated"
        tiles.append((f"sigma of a photo coordinate as found ({origin})", f"{a['sigma_xy_found']:.2f} px"))
    components = a.get("variance_components")
    if components:
        text = f"{components['sigma_xy']:.2f} px, {1e3 * components['sigma_xyz']:.1f} mm"
        tiles.append(("sigmas of photo and object by variance components", text))
    return [{"name": name, "value": value} for name, value in tiles]


def _rms_rows(assessed: ViewAssessment) -> list[dict[str, str]]:
    e = assessed.evaluation
    if e is None:
        return []

    def row(name: str, x: Accuracy) -> dict[str, str]:
        return {
            "name": name, "n": str(x.n), "x": _number(x.rms_x, 3), "y": _number(x.rms_y, 3), "rms": _number(x.rms, 3),
            "rmse": _number(x.rmse, 3), "mrad": _number(assessed.milliradians(x.rmse), 3),
            "object_rms": figure(1e3 * x.object_rms), "object_rmse": figure(1e3 * x.object_rmse),
            "worst": f"{x.worst}, {x.worst_px:.2f} px",
        }  # fmt: skip

    return [row(name, x) for name, x in (("control", e.control), ("check", e.check)) if x is not None]


def _charts(assessed: ViewAssessment) -> list[dict[str, str]]:
    charts: list[tuple[str | None, str, str]] = []
    name, grid = assessed.view.name, assessed.error_map
    if grid is not None:
        f = grid.figures()
        charts.append((
            figures.error_map(assessed, grid),
            f"Map of the expected position error over the photo {name}: {f['px']['median']:.2f} px in the median, "
            f"{f['px']['largest']:.2f} px at worst.",
            f"Expected position error at {grid.depth:.1f} m. White: control points; stars: where the next ones would "
            "help most.",
        ))  # fmt: skip
    charts.append((
        figures.residual_histogram(assessed),
        f"Histogram of the residuals of {name} in pixels with the expected curve.",
        "Residuals of the control points in use, with what the adjustment leads one to expect.",
    ))  # fmt: skip
    charts.append((
        figures.standardised_histogram(assessed),
        f"Histogram of leave-one-out differences of {name} in their own sigmas with the normal curve.",
        "Each point against the estimate without it, in its own sigma: free of the points' own pull on the view.",
    ))  # fmt: skip
    if assessed.surface is not None and assessed.surface.sigma is not None:
        colour = assessed.surface.figures()
        median = f"{figure(colour['mm']['median'])} mm in the median" if colour else ""
        charts.append((
            figures.sigma_map(assessed.surface),
            f"Map of ColourSigma over the photo {name}: {median}.",
            "ColourSigma: how far beside its point a colour may come from, one sigma per axis. Slanted surfaces have "
            "more.",
        ))  # fmt: skip
        charts.append((
            figures.sigma_histogram(assessed.surface),
            f"Histogram of the angular position error of {name} beside 2 and 5 milliradians.",
            "The same as an angle, beside what scanner makers' own cameras (about 2 mrad at worst) and third-party "
            "software (about 5 mrad) were found to be off.",
        ))  # fmt: skip
    return [{"src": src, "alt": alt, "caption": caption} for src, alt, caption in charts if src is not None]


def _agreement_charts(assessed: ViewAssessment) -> list[dict[str, str]]:
    charts = []
    for x in assessed.agreement:
        src = figures.shift_field(assessed, x)
        if src is not None:
            alt = f"Arrows of the shifts of {len(x.patches)} patches, {x.title}. {x.sentence()}"
            charts.append({"src": src, "alt": alt, "caption": f"{x.title}: shifts between local patches."})
    return charts


def _agreement(x: Agreement) -> dict[str, Any]:
    per_mrad = 1e3 / x.pixels_per_radian
    rows = []
    for p in x.patches:
        size = float(np.hypot(*p.shift))
        rows.append(
            {
                "place": f"{p.x:.0f}, {p.y:.0f}", "x": f"{p.shift[0]:+.2f}", "y": f"{p.shift[1]:+.2f}",
                "sigma": f"{p.sigma:.2f}", "mm": f"{size * p.depth * per_mrad:.1f}",
                "sigma_mm": f"{p.sigma * p.depth * per_mrad:.1f}", "mrad": f"{size * per_mrad:.2f}",
                "sigma_mrad": f"{p.sigma * per_mrad:.2f}", "matches": str(p.matches),
                "verdict": "significant" if p.significant else "not significant",
            }
        )  # fmt: skip
    return {"title": x.title, "sentence": x.sentence(), "patches": rows}


def _next_rows(assessed: ViewAssessment) -> list[dict[str, Any]]:
    return [
        {
            "place": f"x {p.xy[0]:.0f}, y {p.xy[1]:.0f}",
            "depth": _number(p.depth, 1),
            "mean": [_number(v) for v in p.mean_px],
            "largest": [_number(v) for v in p.largest_px],
            "gain": f"{100 * (1 - p.mean_px[1] / p.mean_px[0]):.0f} %",
        }
        for p in assessed.next_points
    ]


def _test_caption(a: dict[str, Any]) -> str:
    if not a:
        return "Residuals v are computed − measured."
    critical = _number(a.get("critical"))
    return (
        f"Residuals v are computed − measured. T against {critical} at α = {a['alpha']:g} for each point; the smallest "
        f"bias detectable with power {a['power']:g}, and what one that stays unnoticed does at most anywhere in the "
        "photo."
    )


def _point_rows(assessed: ViewAssessment) -> list[dict[str, str]]:
    if assessed.evaluation is None:
        return []
    tested = {r["name"]: r for r in (assessed.adjustment or {}).get("points", ())}
    checked = {r["name"]: r for r in (assessed.check or {}).get("points", ())}
    rows = [_point_row(e, tested.get(e.name), checked.get(e.name)) for e in assessed.evaluation.points]
    # The numbers are those of the overlay.
    return [{"number": str(k)} | row for k, row in enumerate(rows, 1)]


def _point_row(e: PointError, r: dict[str, Any] | None, c: dict[str, Any] | None) -> dict[str, str]:
    test = r or c or {}
    deleted = r["leave_one_out"] if r and None not in r["leave_one_out"] else None
    redundancy = r["redundancy"] if r else (None, None)
    kind = "rejected" if e.status == "rejected" else e.role
    if e.status == "rejected":
        verdict = "rejected"
    elif e.status == "not visible":
        verdict = "not visible"
    elif e.role == "check":
        verdict = "check" + (", off" if c and c["p_value"] is not None and c["p_value"] < 0.001 else "")
    elif r and r["detectable"] is None:
        verdict = "used, nothing checks it"
    else:
        verdict = "used"
    return {
        "name": e.name,
        "kind": kind,
        "verdict": verdict,
        "vx": _number(float(e.residual_xy[0])),
        "vy": _number(float(e.residual_xy[1])),
        "mm": _number(1e3 * float(np.linalg.norm(e.offset_xyz)), 1),
        "rx": _number(redundancy[0]),
        "ry": _number(redundancy[1]),
        "test": _number(test.get("statistic")),
        "p": _short(test.get("p_value")),
        "deleted": _number(float(np.hypot(*deleted))) if deleted else "–",
        "detectable": _number(r["detectable"]) if r else "–",
        "effect": _number(r["effect"]) if r else "–",
    }


def _parameters(assessed: ViewAssessment) -> list[dict[str, str]]:
    view = assessed.view
    if view.covariance is None:
        return []
    values: dict[str, float] = dict(zip(("cx_world", "cy_world", "cz_world"), view.core.centre.tolist(), strict=True))
    if view.camera:
        values |= view.camera.params
        if "fx" in values:
            values["f"], values["aspect"] = values["fx"], values["fy"] / values["fx"]
    if view.dlt is not None:
        values |= {f"h{i + 1}{j + 1}": float(view.dlt[i, j]) for i in range(3) for j in range(4)}
        values |= dict(view.dlt_distortion)
    rows = []
    for name in view.covariance.parameters:
        sigma, unit = view.covariance.sigma(name), _UNITS.get(name, "")
        value = values.get(name)
        if unit == "mrad":
            rows.append({"name": name, "value": "rotation", "sigma": _short(1e3 * sigma), "unit": "mrad"})
            continue
        digits = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 9)) if sigma > 0 else 6
        rows.append({"name": name, "value": _number(value, digits), "sigma": _number(sigma, digits), "unit": unit})
    return rows
