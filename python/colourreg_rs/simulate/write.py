"""A simulation as files: what a surveyor would bring home, and beside it the truth."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..io.atomic import write_text
from ..io.clouds import write_cloud
from ..io.images import write_image
from ..io.points import write_points
from ..io.registration import write_camera, write_registration
from ..model import PointCloud, Registration, View
from .simulation import Simulation

#: The names of the files, and how a folder is known that an earlier simulation filled.
PATTERNS = (
    *("scan.laz", "photo-*.jpg", "photo-*.png", "photo-*-points.csv", "photo-*-camera.json"),
    *("start.json", "truth.json", "simulation.json"),
)
MARK, BEGINNING = "simulation.json", '{"scene":'


def write_simulation(simulation: Simulation, folder: str | Path, *, cloud: str = "scan.laz") -> list[Path]:
    """Writes scan, photos, approximate views and control points, and the truth; returns the files.

    - ``scan.laz``: the scan as the instrument tells it, with the dimensions ``TrueX``, ``TrueY``, ``TrueZ`` (where the
      beam met the surface) and ``Object`` (number of the object that it met).
    - ``photo-1.jpg`` (``.png`` where compression was switched off), ``photo-1-points.csv`` (measured control and check
      points), ``photo-1-camera.json`` (the camera as one would know it).
    - ``start.json``: the approximate views; ``truth.json``: the true ones with the true control points.
    - ``simulation.json``: scene, seed, instrument, the errors put in, blunders by name, names of the objects.
    """
    import json

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    scan, truth = simulation.scan, simulation.scan_truth
    files = [folder / cloud]
    true = {f"True{axis}": truth.surface[:, k].copy() for k, axis in enumerate("XYZ")}
    write_cloud(files[0], PointCloud(scan.xyz, scan.intensity), {**true, "Object": truth.object.astype(np.uint16)})
    starts: list[View] = []
    truths: list[View] = []
    for photo in simulation.photos:
        image = folder / f"{photo.name}.{'png' if photo.response.jpeg_quality is None else 'jpg'}"
        write_image(image, photo.image, quality=photo.response.jpeg_quality or 95)
        points, camera = folder / f"{photo.name}-points.csv", folder / f"{photo.name}-camera.json"
        write_points(points, photo.points)
        assert photo.start.camera is not None
        write_camera(camera, photo.start.camera)
        starts.append(replace(photo.start, image=image))
        truths.append(replace(photo.view, image=image, points=photo.true_points))
        files += [image, points, camera]
    if simulation.photos:
        for name, views in (("start.json", starts), ("truth.json", truths)):
            write_registration(folder / name, Registration(tuple(views), files[0]))
            files.append(folder / name)
    files.append(folder / "simulation.json")
    write_text(files[-1], json.dumps(description(simulation), indent=2, ensure_ascii=False) + "\n")
    return files


def description(simulation: Simulation) -> dict[str, Any]:
    """What was simulated, and the errors put in, for machines and for people."""
    photos = []
    for photo in simulation.photos:
        assert photo.start.pose is not None and photo.view.pose is not None
        shift = photo.view.pose.centre - photo.start.pose.centre
        turn = photo.view.pose.rotation @ photo.start.pose.rotation.T
        sine = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        size = float(np.linalg.norm(sine))
        angle = float(np.arctan2(size, 0.5 * (np.trace(turn) - 1.0)))
        photos.append(
            {
                "name": photo.name,
                "rotation": (sine * (angle / size if size > 0 else 1.0)).tolist(),
                "translation": shift.tolist(),
                "blunders": list(photo.blunders),
                "response": asdict(photo.response),
            }
        )
    return {
        "scene": simulation.name,
        "seed": simulation.seed,
        "points": len(simulation.scan),
        "stations": [list(s) for s in simulation.stations],
        "frame": {
            "rotation": simulation.scene.frame.rotation.tolist(),
            "offset": simulation.scene.frame.offset.tolist(),
        },
        "scanner": asdict(simulation.scanner),
        "disturbance": _plain(asdict(simulation.disturbance)),
        "photos": photos,
        "objects": simulation.scene.objects,
    }


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    return {name: np.asarray(v).tolist() if isinstance(v, np.generic | np.ndarray) else v for name, v in values.items()}
