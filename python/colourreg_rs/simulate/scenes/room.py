"""A living room: shelves, table and chairs, pictures, a door, a window, lamps on the ceiling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import artwork, furniture, materials, targets
from ..builder import Builder
from ..layout import Layout, Viewpoint, lens
from ..lighting import daylight
from ..materials import Material, colour
from ..scanner import Scanner


def _window(b: Builder, hole: tuple[float, float, float, float], frame: Material, reveal: Material) -> None:
    """An open view to the outside: reveals and frame, no pane."""
    b.named("window")
    x0, z0, x1, z1 = hole
    w, h, d = x1 - x0, z1 - z0, 0.25
    b.rectangle((x0, 0, z0), (0, d, 0), (0, 0, h), reveal)
    b.rectangle((x1, d, z0), (0, -d, 0), (0, 0, h), reveal)
    b.rectangle((x0, d, z1), (w, 0, 0), (0, -d, 0), reveal)
    b.box((x0 - 0.05, -0.12, z0 - 0.03), (x1 + 0.05, 0, z0), reveal)
    b.rectangle((x0, 0, z0), (w, 0, 0), (0, d, 0), reveal)
    for x in (x0, 0.5 * (x0 + x1) - 0.03, x1 - 0.06):
        b.box((x, d - 0.09, z0), (x + 0.06, d - 0.03, z1), frame)
    for z in (z0, z1 - 0.06):
        b.box((x0 + 0.06, d - 0.088, z), (x1 - 0.06, d - 0.032, z + 0.06), frame)
    b.mark("window lower left", (x0, 0, z0))
    b.mark("window upper left", (x0, 0, z1))
    b.mark("window upper right", (x1, 0, z1))


def _door(b: Builder, x: float, rng: np.random.Generator) -> None:
    """A closed door with its frame, on the wall plane."""
    b.named("door")
    leaf = materials.wood(rng, colour(str(rng.choice(["#e9e4d8", "#a97c50", "#7d5a3c"])), 0.62), plank=2.0)
    w, h = 0.9, 2.02
    b.box((x - 0.09, -0.025, 0), (x, 0, h + 0.09), leaf, open_faces=("+y", "-z"))
    b.box((x + w, -0.025, 0), (x + w + 0.09, 0, h + 0.09), leaf, open_faces=("+y", "-z"))
    b.box((x, -0.025, h), (x + w, 0, h + 0.09), leaf, open_faces=("+y",))
    b.rectangle((x, -0.01, 0), (w, 0, 0), (0, 0, h), leaf)
    for z0, z1 in ((0.2, 0.85), (1.0, 1.85)):
        b.box((x + 0.13, -0.022, z0), (x + w - 0.13, -0.01, z1), leaf, open_faces=("+y",))
    brass = materials.metal(rng, "#b59a4a", 0.6)
    b.column((x + 0.07, -0.07, 1.03), (0.12, 0, 0), 0.011, brass)
    b.column((x + 0.07, -0.075, 1.03), (0, 0.065, 0), 0.012, brass)
    b.mark("door upper left", (x - 0.09, -0.025, h + 0.09))
    b.mark("door upper right", (x + w + 0.09, -0.025, h + 0.09))


def room(rng: np.random.Generator) -> Layout:
    """About 6 by 5 metres; the scanner near the middle, the photos from within a metre of it."""
    b = Builder()
    long, wide, high = float(rng.uniform(5.6, 6.8)), float(rng.uniform(4.6, 5.6)), float(rng.uniform(2.6, 2.9))
    x0, y0 = -long / 2, -wide / 2
    tone = colour(
        str(rng.choice(["#e4dccb", "#d8dfe0", "#e3d3c2", "#d3dccb", "#e8e4da"])), float(rng.uniform(0.7, 0.8))
    )
    seed = int(rng.integers(9999))
    wall = Material(
        (
            materials.fill(tone),
            materials.noise(0.05, 0.012, octaves=4, gain=0.8, seed=seed, channels=materials.RELIEF),
            materials.noise(0.06, 1.5, octaves=6, seed=seed + 1),
            materials.patches(materials.shaded(tone, 0.8), 0.25, 0.3, threshold=0.6, softness=0.2, seed=seed + 2),
        ),
        relief=(0.0006, 0.01),
    )
    white = materials.plain(colour("#ebe9e4", 0.8), rng)
    accent = wall
    if rng.random() < 0.6:
        base = colour(str(rng.choice(["#7f9aa5", "#a86f5a", "#8a9a6b", "#c9a75d"])), 0.6)
        accent = Material((materials.fill(base), *wall.layers[1:3]), relief=wall.relief)

    b.named("floor")
    floor = materials.parquet(rng, colour(str(rng.choice(["#a97f56", "#8a6444", "#c09a6b"])), 0.55))
    for i in range(2):
        for k in range(2):
            b.rectangle(
                (x0 + i * long / 2, y0 + k * wide / 2, 0),
                (long / 2, 0, 0),
                (0, wide / 2, 0),
                floor,
                (i * long / 2, k * wide / 2),
            )
    b.named("ceiling")
    b.rectangle((x0, wide / 2, high), (long, 0, 0), (0, -wide, 0), white)
    b.named("lamps")
    glow = Material((materials.fill(colour("#f4f2ea", 0.7)),), emission=(3.4, 3.2, 2.8))
    for x in (-0.25 * long, 0.25 * long):
        b.box((x - 0.6, -0.32, high - 0.06), (x + 0.6, 0.32, high), white, open_faces=("-z", "+z"))
        b.rectangle((x - 0.6, 0.32, high - 0.055), (1.2, 0, 0), (0, -0.64, 0), glow)

    north, east = b.place((x0, wide / 2, 0)), b.place((long / 2, wide / 2, 0), -np.pi / 2)
    south, west = b.place((long / 2, y0, 0), np.pi), b.place((x0, y0, 0), np.pi / 2)
    hole = (0.28 * wide, 0.9, 0.72 * wide, 2.25)
    for side, width, material, holes in (
        (north, long, accent, []), (east, wide, wall, [hole]), (south, long, wall, []), (west, wide, wall, []),
    ):  # fmt: skip
        side.named("walls")
        side.wall(width, high, material, holes)
        side.named("skirting")
        side.box((0, -0.015, 0), (width, 0, 0.08), white, open_faces=("+y", "-z", "-x", "+x"))
    _window(east, hole, white, white)
    furniture.radiator(east, (hole[0] + 0.1, 0.12), hole[2] - hole[0] - 0.2, white)
    _door(south, float(rng.uniform(0.6, 1.2)), rng)
    _door(west, 0.62 * wide, rng)

    shelf = float(rng.uniform(0.3, 0.7))
    furniture.bookshelf(b, (x0 + shelf, wide / 2, 0), 0.0, rng, width=1.65)
    x = shelf + 2.0
    while x + 0.9 < long - 0.3:
        w, h = float(rng.uniform(0.5, 0.95)), float(rng.uniform(0.4, 0.7))
        furniture.picture(north, (x, float(rng.uniform(1.3, 1.5))), (w, h), rng)
        x += w + float(rng.uniform(0.25, 0.5))
    furniture.picture(west, (0.4, 1.35), (0.7, 0.9), rng)
    furniture.picture(south, (0.62 * long, 1.4), (0.8, 0.6), rng)
    clock = artwork.clock_face(0.3)
    north.named("clock")
    dial = Material((materials.fill(colour("#f4f2ec", 0.7)), materials.painted(clock, 0, 0, 0.3, 0.3)))
    north.flat(2, (shelf + 2.6, -0.03, 2.3), (0.15, 0, 0), (0, 0, 0.15), Material(
        (dial.layers[0], materials.painted(clock, -0.15, -0.15, 0.15, 0.15))
    ))  # fmt: skip
    north.column((shelf + 2.6, -0.03, 2.3), (0, 0.03, 0), 0.152, materials.metal(rng, "#222222", 0.1))

    wood = materials.wood(rng, colour(str(rng.choice(["#b08a5c", "#7a5638", "#d0b48a"])), 0.58), plank=0.12, gloss=0.02)
    tx, ty = float(rng.uniform(0.4, 1.0)), float(rng.uniform(0.2, 0.7))
    yaw = float(rng.uniform(-0.25, 0.25))
    furniture.table(b, (tx, ty, 0), yaw, (1.5, 0.8, 0.74), wood)
    around = b.place((tx, ty, 0), yaw)
    for cx in (0.2, 0.9):
        furniture.chair(around, (cx, 0.75, 0), 0.0, wood)
        furniture.chair(around, (cx + 0.42, 0.05, 0), np.pi, wood)
    around.named("on the table")
    jug = materials.plain(colour(str(rng.choice(["#3f6f8f", "#b0573f", "#e6dfcf"])), 0.5), rng)
    around.column((0.5, 0.4, 0.74), (0, 0, 0.2), 0.05, jug, top_radius=0.07)
    around.ball((0.85, 0.45, 0.785), 0.045, materials.plain(colour("#c9772f", 0.6), rng))
    around.ball((0.94, 0.38, 0.78), 0.04, materials.plain(colour("#7f9a3a", 0.6), rng))
    box = artwork.poster(rng, 0.21, 0.3)
    paper = Material((materials.fill(colour("#f0eee8", 0.8)), materials.painted(box, 0, 0, 0.21, 0.3)))
    around.rectangle((1.1, 0.2, 0.7415), (0.2, 0.06, 0), (-0.085, 0.285, 0), paper)
    furniture.sofa(west, (0.25, -0.05, 0), 0.0, rng)
    furniture.pot_plant(b, (long / 2 - 0.45, wide / 2 - 0.5, 0), rng)
    b.named("rug")
    rug = materials.cloth(rng, (colour("#8f3f35", 0.6), colour("#d8c7a0", 0.65)), 0.16)
    b.rectangle(
        (-2.2, -1.7, 0.006),
        (2.4, 0, 0),
        (0, 1.5, 0),
        Material((*rug.layers, materials.noise(0.2, 0.006, octaves=2, seed=4))),
    )
    places = [(north, long - 0.35, 1.9), (east, 0.3, 1.7), (west, wide - 0.35, 2.3), (south, 0.5 * long, 1.1)]
    places += [(north, 0.16, 1.6), (east, wide - 0.35, 2.2)]
    for i, (wall_frame, x, z) in enumerate(places, start=1):
        name = f"T{i}"
        wall_frame.named(f"target {name}")
        targets.quartered(wall_frame, name, (x, -0.004, z), 0.13)

    outside = materials.grass(rng)
    b.named("outside")
    b.rectangle((long / 2 + 0.3, -30, -1.2), (40, 0, 0), (0, 60, 0), outside)
    station = (float(rng.uniform(-1.1, -0.4)), float(rng.uniform(-1.2, -0.5)), float(rng.uniform(1.4, 1.6)))
    photos = []
    for aim in ((0.9, wide / 2, 1.2), (long / 2, 0.3, 1.2)):
        position = (
            station[0] + float(rng.uniform(-0.7, 0.3)),
            station[1] + float(rng.uniform(-0.5, 0.3)),
            station[2] + float(rng.uniform(-0.2, 0.2)),
        )
        photos.append(
            Viewpoint(
                position,
                aim,
                float(np.radians(rng.uniform(68, 78))),
                distortion=lens(rng),
                roll=float(rng.normal(0, 0.01)),
            )
        )
    light = replace(
        daylight(rng, (-0.5, 0.5), map_spacing=0.2), map_directions=192, bounces=2, clouds=0.2, ground=(0.2, 0.22, 0.14)
    )
    scanner = Scanner(step=0.0036, elevation=(-1.0, 1.45), reference_range=1.2, limits=(0.4, 60.0))
    return Layout(b.parts, light, [station], scanner, photos)
