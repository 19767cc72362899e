"""The corner of a building, about 60 m away: two house fronts that meet at a right angle."""

from __future__ import annotations

import numpy as np

from .. import buildings, plants, street
from ..builder import Builder
from ..layout import Layout, Viewpoint
from ..lighting import daylight
from ..scanner import Scanner


def corner(rng: np.random.Generator) -> Layout:
    """The corner points at the scanner; one photo from near the station."""
    b = Builder()
    street.ground(b, rng, pavement=3.0, behind=24.0, kerb=False)
    style = buildings.random_style(rng, wall=str(rng.choice(["plaster", "stone", "brick"])))
    turn = float(rng.uniform(np.radians(38), np.radians(52)))
    left, right = float(rng.uniform(16, 19)), float(rng.uniform(16, 19))
    other = turn - np.pi / 2
    start = (-left * np.cos(other), -left * np.sin(other), 0.0)
    buildings.facade(b.place(start, other), left, 5, style, rng, name="left", sides="l", roof=False, shops=0.2)
    buildings.facade(b.place((0, 0, 0), turn), right, 5, style, rng, name="right", sides="r", roof=False, shops=0.2)
    for side, x in (("west", -32.0), ("east", 21.0)):
        neighbour = buildings.random_style(rng)
        buildings.facade(b.place((x, 13.0, 0)), 12.0, 3, neighbour, rng, name=side, shops=0.0)
    plants.tree(b, (-15.5, 2.0, 0), 8.0, rng, leaves=2500)
    street.lamp_post(b, (13.0, -1.5, 0), rng)
    distance = float(rng.uniform(58, 62))
    station = (float(rng.uniform(-2, 2)), -distance, 1.8)
    position = (station[0] + float(rng.uniform(-1, 1)), station[1] + float(rng.uniform(-1, 1)), 1.7)
    # 3,750 pixels of focal length: one pixel is 16 mm at the building.
    view = float(2 * np.arctan(0.5 * 3000 / 3750))
    photo = Viewpoint(position, (0.0, 0.0, 8.0), view, (3000, 2000))
    bearing = np.pi / 2 + np.arctan2(station[0], distance)
    azimuth, elevation = (bearing - 0.28, bearing + 0.28), (-0.04, 0.32)
    step = float(np.sqrt((azimuth[1] - azimuth[0]) * (elevation[1] - elevation[0]) / 1.0e6))
    scanner = Scanner(step=step, azimuth=azimuth, elevation=elevation, reference_range=25.0, range_constant=0.003)
    return Layout(b.parts, daylight(rng, (-2.4, -0.8)), [station], scanner, [photo])
