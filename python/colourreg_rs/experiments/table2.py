"""Table 2: a trial scan of some 80,000 points at 1.5 m, with HDS and black-and-white targets, and a DLT of a photo.

The paper's data were never published: the set-up is simulated. What the noise of the readings makes of a DLT, and
which noise makes the paper's figures, is found by varying it; beside it stands what this package reaches on the same
readings: a resection that names blunders, with focal length, principal point and a distortion term free, adjusted with
the scan's noise and the photo's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import _core
from ..matching.register_sci import SciOptions, register_sci
from ..model import FloatArray, View
from ..progress import Progress, silent
from ..simulate import SimulatedPhoto, Simulation, simulate
from .figures import Figures, table

#: What the paper prints: residuals of its DLT, total and x, y, px, and about what that is at the object, m.
PUBLISHED, PUBLISHED_METRES = Figures.published((16.5, 2.5), 11.8), 0.018

#: Each case is drawn so many times.
DRAWS = 25

#: A camera of which nothing but a rough focal length is known: its error, relative.
FOCAL_ERROR = 0.04

FREE = ["pose", "f", "pp", "k1"]


@dataclass(frozen=True)
class Case:
    """Noise of the readings: in the photo, px; of the targets' centres in the scan, m; and how many targets are read
    how far to the side, px."""

    photo: float
    scan: float
    blunders: int = 0
    aside: float = 0.0

    @property
    def label(self) -> str:
        """In words."""
        text = f"{self.photo:g} px, {1000 * self.scan:g} mm"
        return text + (f", {self.blunders} targets {self.aside:g} px aside" if self.blunders else "")


#: The last but one is what makes the paper's figures: large in x, small in y.
CASES = (
    Case(0.3, 0.002), Case(1.0, 0.002), Case(3.0, 0.002), Case(10.0, 0.002), Case(0.3, 0.010),
    Case(1.0, 0.002, blunders=2, aside=58.0), Case(0.3, 0.002, blunders=2, aside=58.0),
)  # fmt: skip
PAPER_LIKE = 5


@dataclass(frozen=True)
class Readings:
    """One draw: targets with noise, and which were spoiled."""

    xyz: FloatArray
    xy: FloatArray
    spoiled: tuple[int, ...]


@dataclass(frozen=True)
class Estimate:
    """A view from readings: its residuals, which were rejected, and its errors all over the photo."""

    view: _core.View
    residuals: FloatArray
    rejected: tuple[int, ...]
    errors: FloatArray
    metres: FloatArray


@dataclass(frozen=True)
class CaseResult:
    """Root mean squares over all draws: of the DLT's residuals, and of both methods' true errors all over the photo."""

    case: Case
    residuals: Figures
    residuals_metres: float
    dlt: Figures
    dlt_metres: float
    package: Figures
    package_metres: float
    named: float
    wrongly_named: float
    failed: int

    def row(self) -> list[str]:
        """Cells of the table."""
        named = f"{100 * self.named:.0f} %" if self.case.blunders else "–"
        residuals = ", ".join(f"{v:.1f}" for v in self.residuals.axes)
        return [
            self.case.label, f"{self.residuals.rms:.1f} ({residuals})", f"{self.residuals_metres:.4f}",
            f"{self.dlt.rms:.1f}", f"{self.dlt_metres:.4f}", f"{self.package.rms:.2f}", f"{self.package_metres:.4f}",
            named, str(self.failed),
        ]  # fmt: skip

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "case": {**vars(self.case), "label": self.case.label},
            "dlt_residuals_px": self.residuals.as_dict(),
            "dlt_residuals_m": self.residuals_metres,
            "dlt_true_error_px": self.dlt.as_dict(),
            "dlt_true_error_m": self.dlt_metres,
            "package_true_error_px": self.package.as_dict(),
            "package_true_error_m": self.package_metres,
            "blunders_named": self.named,
            "good_targets_named": self.wrongly_named,
            "package_failed": self.failed,
        }


@dataclass(frozen=True)
class Trial:
    """The set-up: targets that the photo shows, and surface points all over it."""

    simulation: Simulation
    names: tuple[str, ...]
    xyz: FloatArray
    xy: FloatArray
    surface: FloatArray
    places: FloatArray
    depths: FloatArray

    @property
    def photo(self) -> SimulatedPhoto:
        """The photo."""
        return self.simulation.photos[0]


@dataclass(frozen=True)
class Table2:
    """The experiment's results, and one draw of the case that is like the paper's."""

    trial: Trial
    cases: tuple[CaseResult, ...]
    readings: Readings
    dlt: Estimate
    package: Estimate
    matched: Figures | None
    matched_metres: float
    matched_reasons: tuple[str, ...]

    def lines(self) -> list[str]:
        """As text and Markdown."""
        head = [
            "noise of the readings", "DLT residuals px (x, y)", "m", "DLT true px", "m", "package true px", "m",
            "blunders named", "refused",
        ]  # fmt: skip
        paper = [
            "the paper's Table 2", "11.8 (16.5, 2.5)", f"about {PUBLISHED_METRES}", "–", "–", "–", "–", "–", "–"
        ]  # fmt: skip
        like = self.cases[PAPER_LIKE]
        spoiled = [self.trial.names[i] for i in self.readings.spoiled]
        rejected = [self.trial.names[i] for i in self.package.rejected]
        lines = [
            "## Table 2: trial scan, 1.5 m, DLT",
            "",
            "The paper's data were never published; this is a simulation of its set-up: "
            f"{len(self.trial.simulation.scan):,} points, {len(self.trial.names)} targets in a photo of one "
            "milliradian a pixel, whose lens has distortion. Each case is the root mean square, per coordinate, of "
            f"{DRAWS} draws; "
            "true errors are those all over the photo, at the scan's own points; metres are at the object, "
            "across the ray.",
            "",
            *table(head, [paper, *(c.row() for c in self.cases)]),
            "",
            f"Evenly noisy readings make x and y alike; {like.case.label} makes {like.residuals.rms:.1f} "
            f"({like.residuals.axes[0]:.1f}, {like.residuals.axes[1]:.1f}): figures like the paper's are those of a "
            "few targets that were read or numbered wrongly along a row.",
            f"In the draw of the picture {', '.join(spoiled)} were spoiled; the package rejected "
            f"{', '.join(rejected) or 'none'}.",
        ]
        if self.matched is not None:
            lines += [
                f"Without any readings, from that view and matched to the scan's intensity (`--method sci`): "
                f"{self.matched.rms:.2f} px, {self.matched_metres:.4f} m.",
            ]
        else:
            lines += [f"Matching to the scan's intensity is refused here: {'; '.join(self.matched_reasons)}."]
        return lines

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "paper": {"residuals_px": PUBLISHED.as_dict(), "metres": PUBLISHED_METRES},
            "targets": list(self.trial.names),
            "draws": DRAWS,
            "cases": [c.as_dict() for c in self.cases],
            "matched_px": self.matched.as_dict() if self.matched else None,
            "matched_m": self.matched_metres if self.matched else None,
            "matched_reasons": list(self.matched_reasons),
        }


def run(progress: Progress = silent) -> Table2:
    """The whole experiment."""
    progress("table 2: scan and photo", 0, 3)
    trial = prepare()
    progress("table 2: readings", 1, 3)
    cases = tuple(repeated(trial, case, seed) for seed, case in enumerate(CASES))
    readings = read(trial, CASES[PAPER_LIKE], np.random.default_rng([PAPER_LIKE, 0]))
    dlt, package = by_dlt(trial, readings), by_package(trial, readings, CASES[PAPER_LIKE])
    progress("table 2: matching", 2, 3)
    start = as_view(trial, package.view)
    found = register_sci(
        trial.simulation.scan, trial.photo.image, start, SciOptions(free=("pose", "f", "pp", "k1"), shift=0.05)
    )
    matched, metres = None, float("nan")
    if found.trusted:
        errors, at_object = true_errors(trial, found.view.core)
        matched, metres = Figures.of(errors), _rms(at_object)
    progress("table 2: done", 3, 3)
    return Table2(trial, cases, readings, dlt, package, matched, metres, found.reasons)


def prepare(size: tuple[int, int] | None = None) -> Trial:
    """The set-up."""
    simulation = simulate("trial", draft=True, samples=4, size=size)
    photo = simulation.photos[0]
    marks = photo.scene.marks
    names, xyz = np.array(list(marks)), np.array(list(marks.values()))
    seen = photo.scene.visible(photo.view, xyz, 0.02)
    surface = simulation.scan_truth.surface[::10]
    surface = np.ascontiguousarray(surface[photo.visible(surface)])
    places, depths = _core.project(photo.view.core, surface)
    xyz = np.ascontiguousarray(xyz[seen])
    xy, _ = _core.project(photo.view.core, xyz)
    return Trial(simulation, tuple(str(n) for n in names[seen]), xyz, xy, surface, places, depths)


def read(trial: Trial, case: Case, rng: np.random.Generator) -> Readings:
    """Readings with noise; blunders lie along the picture's rows, either way."""
    xy = trial.xy + rng.normal(0.0, case.photo, trial.xy.shape)
    xyz = trial.xyz + rng.normal(0.0, case.scan, trial.xyz.shape)
    spoiled = rng.choice(len(xy), case.blunders, replace=False)
    xy[spoiled, 0] += case.aside * rng.choice([-1.0, 1.0], case.blunders)
    return Readings(xyz, xy, tuple(sorted(int(i) for i in spoiled)))


def by_dlt(trial: Trial, readings: Readings) -> Estimate:
    """The paper's way: eleven parameters, every reading believed."""
    width, height = trial.photo.view.core.width, trial.photo.view.core.height
    result = _core.estimate_dlt(readings.xyz, readings.xy, width, height)
    return Estimate(result.view, result.residuals, (), *true_errors(trial, result.view))


def by_package(trial: Trial, readings: Readings, case: Case) -> Estimate:
    """Resection among blunders, then the adjustment with both noises."""
    n = len(readings.xy)
    # What the scan's noise is worth in the photo, at the targets' mean distance.
    sigma = float(np.hypot(case.photo, case.scan * _focal(trial) / trial.depths.mean()))
    robust = _core.resect_robust(
        rough_view(trial).core, readings.xyz, readings.xy, free=FREE, unknown_focal=True, sigma_xy=sigma
    )
    used = np.array([status != "rejected" for status in robust.status])
    cov_xyz = np.broadcast_to(np.eye(3) * case.scan**2, (n, 3, 3))
    cov_xy = np.broadcast_to(np.eye(2) * case.photo**2, (n, 2, 2))
    adjusted = _core.adjust(
        robust.view, readings.xyz[used], readings.xy[used], np.ascontiguousarray(cov_xyz[used]),
        np.ascontiguousarray(cov_xy[used]), FREE,
    )  # fmt: skip
    kept = np.flatnonzero(used)
    late = [int(kept[i]) for i, *_ in adjusted.statistics()["rejected"]]
    rejected = tuple(sorted([*np.flatnonzero(~used).tolist(), *late]))
    residuals = _core.project(adjusted.view, readings.xyz)[0] - readings.xy
    return Estimate(adjusted.view, residuals, rejected, *true_errors(trial, adjusted.view))


def rough_view(trial: Trial) -> View:
    """What is known of the camera before: a rough focal length, and nothing of its lens and place."""
    view = trial.photo.view
    assert view.camera is not None
    width, height = view.camera.width, view.camera.height
    f = view.camera.params["fx"] * (1 + FOCAL_ERROR)
    none = dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0)
    camera = view.camera.with_params(fx=f, fy=f, cx=(width - 1) / 2, cy=(height - 1) / 2, **none)
    return View("rough", None, camera, trial.photo.start.pose)


def as_view(trial: Trial, core: _core.View) -> View:
    """An estimate as a view with names."""
    from ..model import Pose

    camera = trial.photo.view.camera
    assert camera is not None
    params = dict(zip(camera.params, core.params.tolist(), strict=True))
    return View("photo-1", None, camera.with_params(**params), Pose(core.rotation, core.translation))


def true_errors(trial: Trial, view: _core.View) -> tuple[FloatArray, FloatArray]:
    """Errors all over the photo, px, and what they are at the object, m."""
    errors = _core.project(view, trial.surface)[0] - trial.places
    seen = np.isfinite(errors).all(axis=1)
    return errors[seen], errors[seen] * (trial.depths[seen] / _focal(trial))[:, None]


def _focal(trial: Trial) -> float:
    return float(trial.photo.view.core.params[0])


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt((errors**2).mean()))


def repeated(trial: Trial, case: Case, seed: int) -> CaseResult:
    """Many draws of a case. Where the package refuses a result, that is counted, and not averaged."""
    depth = _core.project(trial.photo.view.core, trial.xyz)[1]
    residuals, at_object, dlt, dlt_metres, mine, mine_metres = [], [], [], [], [], []
    named = wrongly = failed = 0
    for draw in range(DRAWS):
        readings = read(trial, case, np.random.default_rng([seed, draw]))
        simple = by_dlt(trial, readings)
        residuals.append(simple.residuals)
        at_object.append(simple.residuals * (depth / _focal(trial))[:, None])
        dlt.append(simple.errors)
        dlt_metres.append(simple.metres)
        try:
            best = by_package(trial, readings, case)
        except _core.ColourregError:
            failed += 1
            continue
        mine.append(best.errors)
        mine_metres.append(best.metres)
        named += len(set(best.rejected) & set(readings.spoiled))
        wrongly += len(set(best.rejected) - set(readings.spoiled))
    good = DRAWS - failed
    return CaseResult(
        case,
        Figures.of(np.concatenate(residuals)),
        _rms(np.concatenate(at_object)),
        Figures.of(np.concatenate(dlt)),
        _rms(np.concatenate(dlt_metres)),
        Figures.of(np.concatenate(mine)),
        _rms(np.concatenate(mine_metres)),
        named / max(good * case.blunders, 1),
        wrongly / max(good * (len(trial.names) - case.blunders), 1),
        failed,
    )
