"""A street: house fronts with windows, balconies, doors, shops and posters, a tree, shrubs, a lamp post."""

from __future__ import annotations

import numpy as np

from .. import buildings, materials, plants, street
from ..builder import Builder
from ..layout import Layout, Viewpoint, lens
from ..lighting import daylight
from ..scanner import Scanner


def facade(rng: np.random.Generator) -> Layout:
    """Two or three houses in a row, seen from 10 to 40 m."""
    b = Builder()
    pavement = float(rng.uniform(2.5, 4.0))
    street.ground(b, rng, pavement=pavement)
    x, houses = -16.0, int(rng.integers(2, 4))
    for i in range(houses):
        width = float(rng.uniform(9.0, 13.0)) if houses == 3 else float(rng.uniform(13.0, 17.0))
        style = buildings.random_style(rng, wall=None if i else "plaster")
        storeys = int(rng.integers(2, 5))
        setback = float(rng.uniform(0.0, 0.5)) * i
        buildings.facade(b.place((x, setback, 0)), width, storeys, style, rng, name=f"house {i + 1}")
        x += width
    street.lamp_post(b, (float(rng.uniform(-7, -4)), -pavement + 0.4, 0), rng)
    if rng.random() < 0.8:
        plants.tree(b, (float(rng.uniform(3.5, 9.0)), -pavement + 0.7, 0), float(rng.uniform(5.5, 8.0)), rng)
    for _ in range(int(rng.integers(2, 5))):
        street.planter(b, (float(rng.uniform(-10, 10)), float(rng.uniform(-1.3, -0.7)), 0), rng)
    if rng.random() < 0.5:
        street.bench(b, (float(rng.uniform(-3, 2)), -1.1, 0), 0.0, rng)
    iron = materials.metal(rng, "#2b2d30", 0.15)
    for k in np.arange(-12.0, 12.0, 2.6):
        street.bollard(b, (float(k), -pavement + 0.25, 0), iron)
    if rng.random() < 0.5:
        street.advertising_column(b, (float(rng.uniform(-11, -8)), -pavement + 1.0, 0), rng)
    distance = float(rng.uniform(11.0, 32.0))
    street.background(b, rng, y=-max(distance, 18.0) - 14.0)
    aim = (float(rng.uniform(-2.0, 2.0)), 0.0, float(rng.uniform(3.2, 4.6)))
    station = (float(rng.uniform(-4, 4)), -distance, 1.7)
    photos = []
    for _ in range(2):
        position = (
            station[0] + float(rng.uniform(-2.5, 2.5)),
            station[1] + float(rng.uniform(-1.5, 2.0)),
            float(rng.uniform(1.5, 2.1)),
        )
        view = 2 * np.arctan(float(rng.uniform(8.0, 11.0)) / distance)
        photos.append(
            Viewpoint(position, aim, min(float(view), 1.35), distortion=lens(rng), roll=float(rng.normal(0, 0.01)))
        )
    bearing, half = np.pi / 2 - np.arctan2(aim[0] - station[0], distance), float(np.arctan(16.0 / distance)) + 0.1
    up = float(np.arctan(15.0 / distance))
    step = float(np.sqrt(2 * half * (up + 0.35) / 1.1e6))
    scanner = Scanner(step=step, azimuth=(bearing - half, bearing + half), elevation=(-0.35, up), reference_range=8.0)
    return Layout(b.parts, daylight(rng, (-2.6, -0.5)), [station], scanner, photos)
