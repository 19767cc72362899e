"""A trial set-up in the laboratory: boxes on a bench before a wall, with circular and black-and-white targets, about
1.5 m from scanner and camera; some 80,000 points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import materials, targets
from ..builder import Builder
from ..layout import Layout, Viewpoint, lens
from ..lighting import daylight
from ..materials import Material, colour
from ..scanner import Scanner


def trial(rng: np.random.Generator) -> Layout:
    """Wall at y = 0, bench before it, boxes at different depths so that the targets fill a volume."""
    b = Builder()
    b.named("wall")
    b.wall(4.0, 2.6, materials.plaster(colour("#d9d6cd", 0.7), rng, age=0.12))
    b.rectangle((0, -4.0, 0), (0, 4.0, 0), (0, 0, 2.6), materials.plaster(colour("#cfd3d2", 0.7), rng, age=0.12))
    b.named("floor")
    b.rectangle((0, -5, 0), (4.0, 0, 0), (0, 5, 0), materials.concrete(rng))
    b.named("bench")
    wood = materials.wood(rng, colour("#b58f62", 0.6), plank=0.2)
    b.box((0.9, -0.75, 0.72), (3.1, -0.05, 0.76), wood)
    for x in (0.95, 2.99):
        b.box((x, -0.7, 0), (x + 0.06, -0.64, 0.72), wood)
    count = {"H": 0, "B": 0}

    def put(builder: Builder, x: float, z: float, y: float = -0.003, size: float = 0.10) -> None:
        kind = "H" if count["H"] <= count["B"] else "B"
        count[kind] += 1
        name = f"{kind}{count[kind]}"
        builder.named(f"target {name}")
        (targets.circular if kind == "H" else targets.quartered)(builder, name, (x, y, z), size)

    for x, z in ((1.15, 1.62), (1.62, 1.72), (2.1, 1.66), (2.75, 1.58), (1.5, 1.3), (2.45, 1.25)):
        put(b, x + float(rng.uniform(-0.05, 0.05)), z + float(rng.uniform(-0.05, 0.05)))
    card = ["#b98f5f", "#8d9aa0", "#c9b78d", "#7f6a58", "#a8a39a"]
    for i, x in enumerate((1.0, 1.42, 1.84, 2.3, 2.68)):
        w, d, h = float(rng.uniform(0.26, 0.36)), float(rng.uniform(0.18, 0.3)), float(rng.uniform(0.2, 0.48))
        front = -0.1 - d - float(rng.uniform(0.0, 0.25))
        box = b.place((x, front, 0.76), float(rng.uniform(-0.35, 0.35))).named("box")
        box.box((0, 0, 0), (w, d, h), materials.plain(colour(card[i], float(rng.uniform(0.45, 0.7))), rng, 0.15))
        put(box, w / 2, h * 0.62 if h > 0.3 else h / 2, size=0.085)
        if h > 0.34:
            put(box, w * 0.4, h * 0.2, size=0.07)
    b.named("ball")
    b.ball((2.56, -0.64, 0.83), 0.07, materials.plain(colour("#d8d4ca", 0.7), rng))
    b.named("tube")
    b.column((1.32, -0.66, 0.76), (0, 0, 0.3), 0.045, materials.metal(rng, "#9aa0a2", 0.4))
    b.named("lamps")
    glow = Material((materials.fill(colour("#f4f2ea", 0.7)),), emission=(2.6, 2.6, 2.5))
    b.rectangle((0.8, -0.9, 2.6), (2.4, 0, 0), (0, -0.8, 0), glow)
    b.named("ceiling")
    b.rectangle((0, 0, 2.7), (4.0, 0, 0), (0, -5.0, 0), materials.plain(colour("#e4e3df", 0.75), rng))

    middle = 2.0
    station = (middle + float(rng.uniform(-0.08, 0.08)), -0.35 - 1.5, 1.3)
    position = (
        middle + float(rng.uniform(-0.25, 0.25)),
        -0.35 - 1.5 + float(rng.uniform(-0.1, 0.1)),
        float(rng.uniform(1.3, 1.45)),
    )
    # About one milliradian to a pixel.
    photo = Viewpoint(position, (middle, -0.3, 1.24), float(np.radians(65)), (1280, 960), lens(rng))
    light = replace(
        daylight(rng, (-2.0, -1.0), map_spacing=0.12), sun=(0.0, 0.0, 0.0), map_directions=256, bounces=2,
        zenith=(0.3, 0.3, 0.3), horizon=(0.3, 0.3, 0.3), clouds=0.0,
    )  # fmt: skip
    azimuth, elevation = (np.pi / 2 - 0.56, np.pi / 2 + 0.56), (-0.36, 0.30)
    step = float(np.sqrt((azimuth[1] - azimuth[0]) * (elevation[1] - elevation[0]) / 80_000))
    scanner = Scanner(
        step=step, azimuth=azimuth, elevation=elevation, reference_range=1.2, limits=(0.3, 20.0), range_constant=0.0015
    )
    return Layout(b.parts, light, [station], scanner, [photo])
