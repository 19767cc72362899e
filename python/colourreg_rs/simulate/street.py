"""What stands in streets and squares: lamp posts, columns, kiosks, benches, planters, and the ground."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from . import artwork, materials, plants
from .builder import Builder
from .buildings import poster_board
from .materials import Material, colour


def ground(
    b: Builder, rng: np.random.Generator, *, pavement: float, behind: float = 0.3, kerb: bool = True, half: float = 70.0
) -> None:
    """A pavement in front of the house line y = 0, a kerb, a road, and setts beyond. The street lies at y < 0; the
    pavement reaches ``behind`` the house line."""
    b.named("ground")
    _strip(b, half, -pavement, behind, 0.0, materials.slabs(rng))
    step = -0.12 if kerb else 0.0
    if kerb:
        b.box((-half, -pavement - 0.15, -0.12), (half, -pavement, 0.005), materials.stone(rng), open_faces=("-z", "+y"))
    edge = -pavement - (0.15 if kerb else 0.0)
    _strip(b, half, edge - 7.0, edge, step, materials.asphalt(rng))
    setts = materials.cobbles(rng)
    _strip(b, half, edge - 22.0, edge - 7.0, step, setts)
    b.rectangle((-half, edge - 60.0, step), (2 * half, 0, 0), (0, 38.0, 0), setts, (-half, edge - 60.0))


def _strip(b: Builder, half: float, y0: float, y1: float, z: float, material: Material) -> None:
    """Ground in pieces that are small near the middle, so that light is gathered finely there."""
    edges = [-half, -18.0, -6.0, 6.0, 18.0, half]
    for x0, x1 in pairwise(edges):
        b.rectangle((x0, y0, z), (x1 - x0, 0, 0), (0, y1 - y0, 0), material, (x0, y0))


def lamp_post(b: Builder, foot: tuple[float, float, float], rng: np.random.Generator) -> None:
    """A cast-iron lamp post with one or two globes."""
    b.named("lamp post")
    x, y, z = foot
    iron = materials.metal(rng, str(rng.choice(["#23302b", "#2a2b2e", "#4b5558"])), 0.15)
    globe = Material((materials.fill(colour("#f1eee2", 0.6)),), gloss=0.05)
    height = float(rng.uniform(3.8, 4.6))
    b.column((x, y, z), (0, 0, 0.25), 0.16, iron)
    b.column((x, y, z + 0.25), (0, 0, 0.75), 0.11, iron, top_radius=0.07)
    b.disc((x, y, z + 0.25), (0, 0, 1), 0.16, iron)
    b.column((x, y, z + 1.0), (0, 0, 0.06), 0.09, iron)
    b.column((x, y, z + 1.06), (0, 0, height - 1.06), 0.055, iron, top_radius=0.038)
    if rng.random() < 0.5:
        b.column((x, y, z + height), (0, 0, 0.1), 0.08, iron)
        b.ball((x, y, z + height + 0.26), 0.2, globe)
    else:
        for side in (-1.0, 1.0):
            b.column((x, y, z + height - 0.1), (0.5 * side, 0, 0.15), 0.022, iron)
            b.ball((x + 0.5 * side, y, z + height + 0.22), 0.17, globe)
            b.column((x + 0.5 * side, y, z + height), (0, 0, 0.08), 0.07, iron)


def advertising_column(b: Builder, foot: tuple[float, float, float], rng: np.random.Generator) -> None:
    """A round column pasted with posters."""
    b.named("advertising column")
    x, y, z = foot
    radius, height = 0.62, 2.7
    around = np.pi * radius
    layers = [materials.fill(colour("#b9b2a4", 0.55)), materials.noise(0.12, 0.2, octaves=7, seed=3)]
    for base in (0.25, 1.3, 0.7):
        at = -around + float(rng.uniform(0.0, 0.3))
        while at < around - 0.3:
            w = float(rng.uniform(0.5, 0.85))
            low = base + float(rng.uniform(0.0, 0.25))
            if rng.random() < 0.85 and at + w < around:
                layers.append(materials.painted(artwork.poster(rng, w, 1.41 * w), at, low, at + w, low + 1.41 * w))
            at += w + float(rng.uniform(-0.02, 0.08))
    body = Material(tuple(layers))
    iron = materials.metal(rng, "#3a4a42", 0.2)
    b.column((x, y, z), (0, 0, 0.18), radius + 0.06, materials.concrete(rng))
    b.disc((x, y, z + 0.18), (0, 0, 1), radius + 0.06, materials.concrete(rng))
    b.column((x, y, z + 0.18), (0, 0, height), radius, body)
    b.column((x, y, z + height + 0.18), (0, 0, 0.15), radius + 0.12, iron)
    b.disc((x, y, z + height + 0.18), (0, 0, -1), radius + 0.12, iron)
    b.column((x, y, z + height + 0.33), (0, 0, 0.45), radius + 0.12, iron, top_radius=0.02)


def kiosk(b: Builder, origin: tuple[float, float, float], yaw: float, rng: np.random.Generator) -> None:
    """A newspaper kiosk: a box with a counter, posters, papers on display and a roof that overhangs."""
    k = b.place(origin, yaw)
    k.named("kiosk")
    w, d, h = float(rng.uniform(2.2, 2.8)), float(rng.uniform(1.7, 2.1)), 2.45
    base = colour(str(rng.choice(["#2f5a48", "#7a2f2a", "#2d4a6b", "#c9b27a"])), float(rng.uniform(0.35, 0.55)))
    body = materials.wood(rng, base, plank=0.115)
    trim = materials.plain(colour("#e9e4d4", 0.65), rng)
    hole = (0.3, 1.0, w - 0.3, 2.05)
    k.wall(w, h, body, [hole])
    k.rectangle((w, 0, 0), (0, d, 0), (0, 0, h), body)
    k.rectangle((w, d, 0), (-w, 0, 0), (0, 0, h), body)
    k.rectangle((0, d, 0), (0, -d, 0), (0, 0, h), body)
    k.rectangle((0.3, 0.5, 1.0), (w - 0.6, 0, 0), (0, 0, 1.05), materials.plain(colour("#2a2622", 0.2), rng))
    k.rectangle((0.3, 0, 1.0), (0, 0.5, 0), (0, 0, 1.05), body)
    k.rectangle((w - 0.3, 0.5, 1.0), (0, -0.5, 0), (0, 0, 1.05), body)
    k.rectangle((0.3, 0.5, 2.05), (w - 0.6, 0, 0), (0, -0.5, 0), body)
    k.box((0.2, -0.25, 0.94), (w - 0.2, 0.5, 1.0), trim)
    for x in np.arange(0.36, w - 0.6, 0.3):
        paper = artwork.poster(rng, 0.26, 0.36)
        m = Material((materials.fill(colour("#eeeae0", 0.75)), materials.painted(paper, 0, 0, 0.26, 0.36)))
        k.rectangle((x, 0.12, 1.02), (0.26, 0, 0), (0, 0.14, 0.33), m)
    k.box((-0.35, -0.6, h), (w + 0.35, d + 0.35, h + 0.1), trim)
    board = artwork.shop_sign(rng, w + 0.5, 0.4)
    sign = Material((materials.fill(colour("#333333", 0.4)), materials.painted(board, 0, 0, w + 0.5, 0.4)))
    k.box((-0.25, -0.5, h + 0.1), (w + 0.25, d + 0.25, h + 0.5), materials.plain(base, rng), open_faces=("-y",))
    k.rectangle((-0.25, -0.5, h + 0.1), (w + 0.5, 0, 0), (0, 0, 0.4), sign)
    for name, x, z, out in (("foot", 0.0, 0.0, 0.0), ("counter", 0.2, 1.0, 0.25), ("sign", -0.25, h + 0.5, 0.5)):
        k.mark(f"kiosk {name} left", (x, -out, z))
        k.mark(f"kiosk {name} right", (w - x, -out, z))
    side = k.place((w, 0, 0), np.pi / 2)
    side.named("kiosk")
    poster_board(side, (0.25, -0.01, 0.7), 0.62, 0.88, rng)
    poster_board(side, (1.0, -0.01, 0.75), 0.55, 0.8, rng)
    left = k.place((0, d, 0), -np.pi / 2)
    left.named("kiosk")
    poster_board(left, (0.45, -0.01, 0.7), 0.7, 0.99, rng)


def colonnade(b: Builder, origin: tuple[float, float, float], yaw: float, count: int, rng: np.random.Generator) -> None:
    """Columns on bases under a beam."""
    c = b.place(origin, yaw)
    c.named("columns")
    marble = materials.stone(rng, colour(str(rng.choice(["#d4cbb8", "#c9bfae", "#bdb4a6"])), 0.6))
    radius, height, pitch = float(rng.uniform(0.2, 0.27)), float(rng.uniform(3.2, 3.8)), float(rng.uniform(1.9, 2.4))
    for i in range(count):
        x = i * pitch
        c.box((x - 1.5 * radius, -1.5 * radius, 0), (x + 1.5 * radius, 1.5 * radius, 0.16), marble, open_faces=("-z",))
        c.mark(f"column {i} foot left", (x - 1.5 * radius, -1.5 * radius, 0.16))
        c.mark(f"column {i} foot right", (x + 1.5 * radius, -1.5 * radius, 0.16))
        c.column((x, 0, 0.16), (0, 0, 0.12), 1.32 * radius, marble)
        c.disc((x, 0, 0.28), (0, 0, 1), 1.32 * radius, marble)
        c.column((x, 0, 0.28), (0, 0, height - 0.4), radius, marble, top_radius=0.84 * radius)
        c.column((x, 0, height - 0.12), (0, 0, 0.12), 0.9 * radius, marble, top_radius=1.3 * radius)
        c.box((x - 1.4 * radius, -1.4 * radius, height), (x + 1.4 * radius, 1.4 * radius, height + 0.12), marble)
    long = (count - 1) * pitch
    c.box((-0.5, -0.3, height + 0.12), (long + 0.5, 0.3, height + 0.55), marble)
    c.box((-0.62, -0.42, height + 0.55), (long + 0.62, 0.42, height + 0.7), marble)


def bench(b: Builder, origin: tuple[float, float, float], yaw: float, rng: np.random.Generator) -> None:
    """A park bench of slats."""
    c = b.place(origin, yaw)
    c.named("bench")
    slat = materials.wood(rng, colour("#8a6a45", 0.5), plank=5.0)
    iron = materials.metal(rng, "#26292b", 0.15)
    for i in range(4):
        c.box((0, 0.11 * i, 0.43), (1.7, 0.11 * i + 0.08, 0.465), slat)
    c.mark("bench left", (0, 0, 0.465))
    c.mark("bench right", (1.7, 0, 0.465))
    for i in range(3):
        c.box((0, 0.46 + 0.03 * i, 0.55 + 0.13 * i), (1.7, 0.49 + 0.03 * i, 0.64 + 0.13 * i), slat)
    for x in (0.15, 1.5):
        c.box((x, 0.02, 0), (x + 0.05, 0.07, 0.43), iron)
        c.box((x, 0.38, 0), (x + 0.05, 0.45, 0.9), iron)


def planter(b: Builder, centre: tuple[float, float, float], rng: np.random.Generator) -> None:
    """A box of concrete or wood with a shrub."""
    b.named("planter")
    x, y, z = centre
    s = float(rng.uniform(0.35, 0.5))
    m = materials.concrete(rng) if rng.random() < 0.5 else materials.wood(rng, colour("#7a5a3c", 0.5))
    b.box((x - s, y - s, z), (x + s, y + s, z + 0.55), m, open_faces=("-z", "+z"))
    b.rectangle((x - s, y - s, z + 0.5), (2 * s, 0, 0), (0, 2 * s, 0), materials.hedge_soil(rng))
    plants.shrub(b, (x, y, z + 0.95), (s * 1.2, s * 1.2, 0.5), rng, leaves=700)


def bollard(b: Builder, foot: tuple[float, float, float], material: Material) -> None:
    """A low post with a round head."""
    x, y, z = foot
    b.named("bollard")
    b.column((x, y, z), (0, 0, 0.8), 0.07, material, top_radius=0.055)
    b.ball((x, y, z + 0.84), 0.08, material)


def background(b: Builder, rng: np.random.Generator, *, y: float, half: float = 45.0) -> None:
    """Plain houses on the far side of the street: for mirror images, light from below, and the skyline."""
    b.named("background")
    x = -half
    while x < half:
        w, h = float(rng.uniform(9, 16)), float(rng.uniform(6, 10.5))
        body = materials.plaster(colour(str(rng.choice(["#cdbb9a", "#b98a72", "#c3c4b6", "#a56a50"])), 0.5), rng)
        dark = colour("#2b2f33", 0.1)
        windows = [
            materials.rectangle(dark, x + 1.2 + 2.4 * i, 1.1 + 3.0 * k, x + 2.3 + 2.4 * i, 2.7 + 3.0 * k)
            for i in range(int((w - 1.5) / 2.4))
            for k in range(int(h / 3.0))
        ]
        b.rectangle((x + w, y, 0), (-w, 0, 0), (0, 0, h), Material((*body.layers, *windows)), (x, 0))
        b.rectangle((x - 0.2, y - 5, h + 3), (w + 0.4, 0, 0), (0, 5.4, -3.1), materials.roof_tiles(rng))
        x += w
