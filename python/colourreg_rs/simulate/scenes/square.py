"""A square where much is hidden: a kiosk, columns, a lamp post, an advertising column before house fronts that meet at
an angle, one of them seen along the wall; the ground runs away from the scanner."""

from __future__ import annotations

import numpy as np

from .. import buildings, plants, street, targets
from ..builder import Builder
from ..layout import Layout, Viewpoint, lens
from ..lighting import daylight
from ..scanner import Scanner


def _square(rng: np.random.Generator, points: float, photos: int) -> Layout:
    b = Builder()
    street.ground(b, rng, pavement=2.2, kerb=False)
    width = float(rng.uniform(15.0, 18.0))
    front = buildings.random_style(rng, wall="plaster")
    buildings.facade(b.place((-4.0, 0, 0)), width, 3, front, rng, name="front", shops=0.4)
    second = buildings.random_style(rng, wall="brick")
    buildings.facade(b.place((-4.0 + width, 0.8, 0)), 10.0, 2, second, rng, name="right", depth=9.0)
    # The wing stands nearly along the line of sight: it is scanned and photographed at grazing angles.
    wing = buildings.random_style(rng, wall=str(rng.choice(["brick", "stone", "plaster"])))
    turn = float(rng.uniform(np.radians(78), np.radians(86)))
    long = float(rng.uniform(12.0, 15.0))
    buildings.facade(
        b.place((-5.0 - long * np.cos(turn), -long * np.sin(turn) + 0.5, 0), turn), long, 3, wing, rng, name="wing"
    )
    street.kiosk(
        b, (float(rng.uniform(1.2, 2.4)), float(rng.uniform(-8.0, -7.0)), 0), float(rng.uniform(-0.5, 0.3)), rng
    )
    street.colonnade(
        b, (float(rng.uniform(5.2, 6.2)), float(rng.uniform(-5.0, -4.0)), 0), float(rng.uniform(-0.2, 0.15)), 4, rng
    )
    street.lamp_post(b, (float(rng.uniform(-1.4, -0.4)), float(rng.uniform(-8.5, -7.0)), 0), rng)
    street.advertising_column(b, (float(rng.uniform(-3.4, -2.6)), float(rng.uniform(-5.0, -3.6)), 0), rng)
    street.bench(
        b, (float(rng.uniform(-0.2, 0.6)), float(rng.uniform(-4.6, -3.6)), 0), float(rng.uniform(-0.3, 0.3)), rng
    )
    plants.tree(b, (float(rng.uniform(9.5, 11.5)), float(rng.uniform(-8.0, -6.5)), 0), 6.0, rng, leaves=2200)
    street.planter(b, (float(rng.uniform(-1.5, -0.6)), -1.2, 0), rng)
    street.planter(b, (float(rng.uniform(4.2, 5.0)), -1.2, 0), rng)
    street.background(b, rng, y=-38.0)
    # Walls alone would leave the ground to extrapolation: plates lie on it, as surveyors lay them.
    for i, (x, y) in enumerate(((-3.5, -10.5), (4.0, -11.0), (0.5, -6.0), (7.5, -9.0))):
        targets.quartered(b.named("target"), f"ground {i}", (x, y, 0.004), 0.3, upward=(0, 1, 0))
    station = (float(rng.uniform(0.8, 2.2)), float(rng.uniform(-18.5, -16.0)), 1.75)
    viewpoints = []
    for i in range(photos):
        side = (-1.0) ** i
        position = (
            station[0] + side * float(rng.uniform(1.2, 2.6)),
            station[1] + float(rng.uniform(-1.0, 0.8)),
            float(rng.uniform(1.5, 1.9)),
        )
        aim = (float(rng.uniform(1.6, 2.8)) - 0.8 * side, 0.0, float(rng.uniform(2.6, 3.2)))
        viewpoints.append(
            Viewpoint(
                position,
                aim,
                float(np.radians(rng.uniform(58, 66))),
                distortion=lens(rng),
                roll=float(rng.normal(0, 0.01)),
            )
        )
    azimuth, elevation = (np.pi / 2 - 0.72, np.pi / 2 + 0.72), (-0.45, 0.58)
    step = float(np.sqrt((azimuth[1] - azimuth[0]) * (elevation[1] - elevation[0]) / points))
    scanner = Scanner(step=step, azimuth=azimuth, elevation=elevation, reference_range=7.0)
    return Layout(b.parts, daylight(rng, (-2.5, -0.7)), [station], scanner, viewpoints)


def square(rng: np.random.Generator) -> Layout:
    """The square, about a million directions, two photos from either side of the scanner."""
    return _square(rng, 1.3e6, 2)


def demo(rng: np.random.Generator) -> Layout:
    """The square, smaller: quick to make and to look at."""
    return _square(rng, 0.7e6, 2)
