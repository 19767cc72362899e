"""From a scene's name to scan, photos, control points and truth."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..errors import InvalidInputError
from ..model import CameraModel, PointCloud, View
from ..progress import Progress, silent
from .disturbance import Disturbance
from .photo import Response, SimulatedPhoto, develop, radiance
from .scanner import Scanner, ScanTruth, scan
from .scene import Frame, Scene
from .scenes import SCENES


@dataclass(frozen=True)
class Simulation:
    """A scan with its photos, all in one world frame, and what is true of them.

    ``scan_truth`` goes row by row with ``scan``; each photo has its own truth (view, control points, what it sees).
    """

    name: str
    seed: int
    scene: Scene
    scan: PointCloud
    scan_truth: ScanTruth
    scanner: Scanner
    stations: tuple[tuple[float, float, float], ...]
    photos: tuple[SimulatedPhoto, ...]
    disturbance: Disturbance


def simulate(
    scene_name: str,
    *,
    seed: int = 0,
    photos: int | None = None,
    size: tuple[int, int] | None = None,
    camera_model: CameraModel = "OPENCV",
    disturbance: Disturbance | None = None,
    response: Response | None = None,
    scanner: Callable[[Scanner], Scanner] | None = None,
    points: int | None = None,
    frame: Frame | None = None,
    samples: int = 16,
    draft: bool = False,
    progress: Progress = silent,
) -> Simulation:
    """Simulates a scan and photos of one of :data:`SCENES`.

    The same name, seed and options give the same bits. ``photos`` and ``size`` (width, height in pixels) change the
    number and size of photos, ``points`` the number of the scanner's directions; ``scanner`` changes anything about the
    instrument; ``frame`` sets the scene up elsewhere in the world (a turned or georeferenced frame). Edges in the
    photos are sampled ``samples`` times per pixel. A ``draft`` gathers the sky's light coarsely: quicker, plainer,
    geometrically the same. Raises InvalidInputError for a scene that does not exist or options that do not fit.
    """
    if scene_name not in SCENES:
        raise InvalidInputError(f"there is no scene {scene_name!r}; choose one of {', '.join(SCENES)}")
    disturbance, response = disturbance or Disturbance(), response or Response()
    frame = frame or Frame()
    # One stream of randomness for each purpose: another photo size must not change the scene.
    streams = np.random.default_rng([zlib.crc32(scene_name.encode()), seed]).spawn(4)
    layout = SCENES[scene_name](streams[0])
    scene = Scene(scene_name, layout.parts, layout.lighting.draft() if draft else layout.lighting, frame)
    instrument = layout.scanner
    if points is not None:
        if points < 1:
            raise InvalidInputError(f"a scan of {points} points")
        field = (instrument.azimuth[1] - instrument.azimuth[0]) * (instrument.elevation[1] - instrument.elevation[0])
        instrument = replace(instrument, step=float(np.sqrt(field / points)))
    if scanner is not None:
        instrument = scanner(instrument)
    viewpoints = layout.viewpoints if photos is None else layout.viewpoints[:photos]
    if photos is not None and not 0 <= photos <= len(layout.viewpoints):
        raise InvalidInputError(f"scene {scene_name} has {len(layout.viewpoints)} viewpoints, {photos} photos wanted")
    steps = 1 + len(viewpoints)
    progress("simulate: scan", 0, steps)
    stations = [frame.to_world(s) for s in layout.stations]
    cloud, truth = scan(scene, stations, instrument, streams[1])
    taken = []
    generators = streams[2].spawn(len(layout.viewpoints))
    for i, (viewpoint, rng) in enumerate(zip(viewpoints, generators, strict=False), start=1):
        progress(f"simulate: photo {i}", i, steps)
        name = f"photo-{i}"
        camera = viewpoint.camera(camera_model, size)
        errors, pixels, picks = rng.spawn(3)
        nominal = viewpoint.pose()
        disturbed = disturbance.true_pose(nominal, errors)
        start = View(name, None, camera, frame.pose_in_world(nominal), method="approximate")
        view = View(name, None, disturbance.true_camera(camera), frame.pose_in_world(disturbed), method="simulated")
        image, exposed = develop(radiance(scene, view, samples), response, pixels)
        measured, true, blunders = disturbance.control(scene, view, scene.marks, picks)
        taken.append(SimulatedPhoto(name, image, view, start, scene, exposed, measured, true, blunders))
    return Simulation(
        scene_name,
        seed,
        scene,
        cloud,
        truth,
        instrument,
        tuple((float(s[0]), float(s[1]), float(s[2])) for s in stations),
        tuple(taken),
        disturbance,
    )
