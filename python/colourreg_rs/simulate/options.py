"""Simulations as a command line asks for them: numbers in text, angles in degrees, noise in grey values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from ..errors import InvalidInputError
from ..model import PARAMETER_NAMES, CameraModel
from ..progress import Progress, silent
from .disturbance import Disturbance
from .photo import Response
from .scanner import Scanner
from .scene import Frame
from .simulation import simulate
from .write import description, write_simulation


def numbers(text: str, option: str, counts: tuple[int, ...], separator: str = ",") -> tuple[float, ...]:
    """Numbers between separators, of which there are as many as one of ``counts``."""
    try:
        values = tuple(float(part) for part in text.split(separator))
    except ValueError:
        values = ()
    if len(values) not in counts or not all(np.isfinite(values)):
        many = " or ".join(str(n) for n in counts)
        raise InvalidInputError(f"{option} {text!r} is not {many} finite numbers separated by {separator!r}")
    return values


def terms(text: str, option: str) -> dict[str, float]:
    """``k1=-0.02,p2=0.001`` as names and values."""
    result = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, equals, value = part.partition("=")
        if not equals:
            raise InvalidInputError(f"{option} {text!r}: {part!r} is not NAME=VALUE")
        result[name.strip()] = numbers(value, option, (1,))[0]
    return result


def simulate_from_text(
    scene: str,
    folder: Path,
    *,
    seed: int,
    photos: int | None,
    size: str | None,
    camera: str,
    points: int | None,
    rotation: str,
    translation: str,
    principal_point: str,
    focal: float,
    distortion: str,
    pixel_noise: float | None,
    point_noise: tuple[float, float],
    blunders: float,
    control: tuple[int, int],
    scan_noise: bool,
    offset: str,
    yaw: float,
    progress: Progress = silent,
) -> tuple[list[Path], dict[str, Any]]:
    """Simulates and writes what the options of ``colourreg simulate`` say; the files and their description."""
    if camera not in PARAMETER_NAMES:
        raise InvalidInputError(f"--camera {camera!r} is not one of {', '.join(PARAMETER_NAMES)}")
    if not 0.0 <= blunders <= 1.0:
        raise InvalidInputError(f"--blunders {blunders} is not a share between 0 and 1")
    if min(*point_noise, pixel_noise or 0.0) < 0:
        raise InvalidInputError("a noise is negative; sigmas are 0 or more")
    width_height = None
    if size is not None:
        width_height = tuple(int(n) for n in numbers(size.lower(), "--size", (2,), "x"))
        if min(width_height) < 16 or width_height[0] * width_height[1] > 200_000_000:
            raise InvalidInputError(f"--size {size}: photos have from 16 x 16 to 200 million pixels")
    turn = np.radians(numbers(rotation, "--rotation", (1, 3)))
    shift = numbers(translation, "--translation", (1, 3))
    disturbance = Disturbance(
        rotation=turn.tolist() if len(turn) == 3 else float(turn[0]),
        translation=shift if len(shift) == 3 else shift[0],
        principal_point=cast(tuple[float, float], numbers(principal_point, "--principal-point", (2,))),
        focal=focal,
        distortion=terms(distortion, "--distortion"),
        point_sigma_xy=point_noise[0],
        point_sigma_xyz=point_noise[1],
        blunders=blunders,
        control_points=control[0],
        check_points=control[1],
    )
    response = Response()
    if pixel_noise is not None:
        # The sRGB curve's slope at middle grey turns grey values into light.
        light = pixel_noise / 255.0 / 0.87
        response = replace(response.without_noise(), read_noise=light)
        if pixel_noise > 0:
            response = replace(response, jpeg_quality=94)
    scanner: Callable[[Scanner], Scanner] | None = None if scan_noise else lambda s: s.without_noise()
    simulation = simulate(
        scene,
        seed=seed,
        photos=photos,
        size=cast(tuple[int, int] | None, width_height),
        camera_model=cast(CameraModel, camera),
        disturbance=disturbance,
        response=response,
        scanner=scanner,
        points=points,
        frame=Frame.turned(float(np.radians(yaw)), numbers(offset, "--offset", (3,))),
        progress=progress,
    )
    return write_simulation(simulation, folder), description(simulation)
