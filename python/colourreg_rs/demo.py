"""The main job from beginning to end on a simulated scan, whose truth tells how good the result really is."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _core
from .accuracy.assessment_run import assess_registration
from .colourise import ColouriseResult, colourise_file
from .io.atomic import write_text
from .io.clouds import open_cloud, read_cloud, write_cloud
from .io.images import read_photo, write_image
from .io.points import write_points
from .io.registration import read_registration, write_camera, write_registration
from .matching.correspondences import supported_scale
from .model import FloatArray, PointCloud, Registration, View
from .pictures import bird_view, draw_cloud, overlay
from .progress import Progress, silent
from .register import RegisterOptions, register_photo
from .report import write_report
from .sci import render_sci, with_size
from .simulate import Disturbance, SimulatedPhoto, Simulation, simulate

IntArray = npt.NDArray[np.int64]

#: Points that are compared with the truth; ray casting every one would take longer than the job itself.
_COMPARED = 60_000

#: Pixels and rays to the pixel of the demo's photos: small enough to render within seconds.
_PHOTO_SIZE, _SAMPLES = (1500, 1000), 9


@dataclass(frozen=True)
class ViewTruth:
    """An estimated view against the true one."""

    name: str
    centre_mm: float
    rotation_mrad: float
    pixels_rms: float
    pixels_worst: float
    stated_centre_mm: float | None
    blunders: tuple[str, ...]
    rejected: tuple[str, ...]


@dataclass(frozen=True)
class ColourTruth:
    """The colours of a cloud against what the photos really show."""

    seen: int
    seen_coloured: float
    hidden: int
    hidden_coloured: float
    median_error: float


@dataclass(frozen=True)
class DemoResult:
    """What the demo found, and where it put its files."""

    folder: Path
    points: int
    views: tuple[ViewTruth, ...]
    colours: ColourTruth
    colourised: ColouriseResult
    pictures: tuple[str, ...]

    def text(self) -> str:
        """The errors against the truth, and the files."""
        lines = [f"simulated a scan of {self.points:,} points and {len(self.views)} photos; the truth is known", ""]
        for v in self.views:
            stated = f" (stated sigma {v.stated_centre_mm:.1f})" if v.stated_centre_mm is not None else ""
            lines += [
                f"{v.name}, from control points of which {len(v.blunders)} were spoiled on purpose"
                f" ({', '.join(v.blunders) or 'none'}); rejected: {', '.join(v.rejected) or 'none'}",
                f"  against the truth: centre {v.centre_mm:.1f} mm{stated}, direction {v.rotation_mrad:.3f} mrad, "
                f"visible points {v.pixels_rms:.2f} px RMS (radial), {v.pixels_worst:.2f} px at worst",
            ]
        c = self.colours
        lines += [
            "",
            self.colourised.text(),
            f"  of {c.seen + c.hidden:,} points compared with the truth, {c.seen:,} are seen by a photo:"
            f" {100 * c.seen_coloured:.2f} % of them have its colour",
            f"  of {c.hidden:,} that no photo sees {100 * c.hidden_coloured:.2f} % have a colour",
            f"  median colour error {c.median_error:.2f} grey levels of 255",
            "",
            f"look at, in {self.folder}:",
            *(f"  {name}" for name in self.pictures),
        ]
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "folder": str(self.folder),
            "points": self.points,
            "views": [dict(vars(v)) for v in self.views],
            "colours": dict(vars(self.colours)),
            "colourised": self.colourised.as_dict(),
            "pictures": list(self.pictures),
        }


def run_demo(folder: Path, *, seed: int = 0, progress: Progress = silent) -> DemoResult:
    """Simulates, registers, colours and compares with the truth; everything it makes lies in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    steps = 7
    progress("demo: simulating", 0, steps)
    errors = Disturbance(blunders=0.15, control_points=16, check_points=6)
    simulation = simulate("demo", seed=seed, disturbance=errors, size=_PHOTO_SIZE, samples=_SAMPLES)
    chosen = np.random.default_rng(seed).permutation(len(simulation.scan))[:_COMPARED]
    write_cloud(folder / "scan.laz", simulation.scan)
    registrations = []
    for i, photo in enumerate(simulation.photos):
        progress(f"demo: registering {photo.name}", 1 + i, steps)
        registrations.append(_register(folder, photo))
    _write_truth(folder, simulation)
    progress("demo: colouring", 3, steps)
    out = folder / "coloured.laz"
    result = colourise_file(folder / "scan.laz", registrations, out)
    views = [read_registration(path).views[0] for path in registrations]
    progress("demo: comparing with the truth", 4, steps)
    coloured = read_cloud(out)
    colours = _colour_truth(simulation, out, chosen)
    truths = tuple(_view_truth(simulation, p, v, chosen) for p, v in zip(simulation.photos, views, strict=True))
    progress("demo: drawing", 5, steps)
    pictures = _draw(folder, coloured, views, np.array(simulation.stations[0]))
    progress("demo: reporting", 6, steps)
    pictures = (*pictures, *(_report(folder, path) for path in registrations))
    progress("demo: done", steps, steps)
    return DemoResult(folder, len(simulation.scan), truths, colours, result, pictures)


def _register(folder: Path, photo: SimulatedPhoto) -> Path:
    image, points = folder / f"{photo.name}.jpg", folder / f"{photo.name}-points.csv"
    camera, out = folder / f"{photo.name}-camera.json", folder / f"{photo.name}-registration.json"
    write_image(image, photo.image)
    write_points(points, photo.points)
    assert photo.view.camera is not None
    write_camera(camera, photo.view.camera)
    register_photo(folder / "scan.laz", image, points=points, camera=camera, options=RegisterOptions()).save(out)
    return out


def _report(folder: Path, registration: Path) -> str:
    """The page that says how good the view is, for people."""
    cloud = folder / "scan.laz"
    assessed, photos = assess_registration(read_registration(registration), [registration], None, cloud, pictures=True)
    name = registration.name.replace("-registration.json", "-report.html")
    write_report(folder / name, assessed, photos, title=registration.stem, cloud=cloud.name)
    return name


def _write_truth(folder: Path, simulation: Simulation) -> None:
    views = tuple(
        View(p.name, folder / f"{p.name}.jpg", p.view.camera, p.view.pose, method="truth") for p in simulation.photos
    )
    write_registration(folder / "truth.json", Registration(views, folder / "scan.laz"))
    blunders = {p.name: list(p.blunders) for p in simulation.photos}
    write_text(folder / "truth-blunders.json", json.dumps(blunders, indent=2) + "\n")


def _view_truth(simulation: Simulation, photo: SimulatedPhoto, view: View, chosen: IntArray) -> ViewTruth:
    assert view.pose is not None and photo.view.pose is not None
    turn = view.pose.rotation @ photo.view.pose.rotation.T
    angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    surface = simulation.scan_truth.surface[chosen]
    surface = np.ascontiguousarray(surface[photo.visible(surface)])
    error = np.linalg.norm(_core.project(view.core, surface)[0] - _core.project(photo.view.core, surface)[0], axis=1)
    stated = None
    if view.covariance is not None:
        sigmas = [view.covariance.sigma(name) for name in ("cx_world", "cy_world", "cz_world")]
        stated = 1000 * float(np.linalg.norm(sigmas))
    return ViewTruth(
        name=photo.name,
        centre_mm=1000 * float(np.linalg.norm(view.pose.centre - photo.view.pose.centre)),
        rotation_mrad=1000 * float(angle),
        pixels_rms=float(np.sqrt(np.nanmean(error**2))),
        pixels_worst=float(np.nanmax(error)),
        stated_centre_mm=stated,
        blunders=photo.blunders,
        rejected=tuple(p.name for p in view.points if p.status == "rejected"),
    )


def _colour_truth(simulation: Simulation, coloured: Path, chosen: IntArray) -> ColourTruth:
    surface = simulation.scan_truth.surface[chosen]
    with open_cloud(coloured) as cloud:
        chunks = list(cloud.chunks())
        rgb = np.concatenate([chunk.rgb for chunk in chunks if chunk.rgb is not None])[chosen]
        source = np.concatenate([chunk.columns()["ColourSource"] for chunk in chunks])[chosen]
    visible = np.stack([photo.visible(surface) for photo in simulation.photos])
    seen = visible.any(axis=0)
    errors = []
    for number, photo in enumerate(simulation.photos, start=1):
        taken = (source == number) & visible[number - 1]
        errors.append(np.abs(rgb[taken] / 256.0 - photo.true_colour(surface[taken])).mean(axis=1))
    return ColourTruth(
        seen=int(seen.sum()),
        seen_coloured=float((source[seen] > 0).mean()),
        hidden=int((~seen).sum()),
        hidden_coloured=float((source[~seen] > 0).mean()),
        median_error=float(np.nanmedian(np.concatenate(errors))),
    )


def _draw(folder: Path, coloured: PointCloud, views: list[View], station: FloatArray) -> tuple[str, ...]:
    xyz, rgb = coloured.xyz, coloured.rgb
    assert rgb is not None
    pictures = {}
    for view in views:
        assert view.image is not None and view.image_size is not None
        # As large as the scan is dense, so that the SCI has no more filled pixels than measured ones.
        scale = supported_scale(coloured, view)
        width, height = (round(side * scale) for side in view.image_size)
        pictures[f"{view.name}-sci.png"] = render_sci(
            coloured, with_size(view, width, height), station=station
        ).intensity
        pictures[f"{view.name}-overlay.png"] = overlay(read_photo(view.image).pixels, view, xyz)
    for name, view in (("coloured-front.png", views[0]), ("coloured-above.png", bird_view(xyz, views[0]))):
        pictures[name] = draw_cloud(xyz, rgb, view)
    for name, picture in pictures.items():
        write_image(folder / name, picture)
    return tuple(pictures)
