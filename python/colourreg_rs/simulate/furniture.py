"""What stands in rooms: shelves with books, tables, chairs, pictures, plants."""

from __future__ import annotations

import numpy as np

from . import artwork, materials, plants
from .builder import Builder
from .materials import Material, colour


def table(
    b: Builder, origin: tuple[float, float, float], yaw: float, size: tuple[float, float, float], top: Material
) -> None:
    """A table with its corner at ``origin``; size: length, width, height."""
    t = b.place(origin, yaw).named("table")
    length, width, height = size
    t.box((0, 0, height - 0.035), (length, width, height), top)
    for name, x, y in (("a", 0.0, 0.0), ("b", length, 0.0), ("c", length, width), ("d", 0.0, width)):
        t.mark(f"table {name}", (x, y, height))
    for x in (0.05, length - 0.11):
        for y in (0.05, width - 0.11):
            t.box((x, y, 0), (x + 0.06, y + 0.06, height - 0.035), top, open_faces=("-z", "+z"))


def chair(b: Builder, origin: tuple[float, float, float], yaw: float, wood: Material) -> None:
    """A plain chair, its back on the far side."""
    c = b.place(origin, yaw).named("chair")
    c.box((0, 0, 0.43), (0.42, 0.42, 0.46), wood)
    c.mark(f"chair {len(b.parts.rows)} left", (0, 0.38, 0.92))
    c.mark(f"chair {len(b.parts.rows)} right", (0.42, 0.38, 0.92))
    for x in (0.0, 0.38):
        c.box((x, 0, 0), (x + 0.04, 0.04, 0.43), wood, open_faces=("-z", "+z"))
        c.box((x, 0.38, 0), (x + 0.04, 0.42, 0.92), wood, open_faces=("-z",))
    for z in (0.58, 0.70, 0.82):
        c.box((0.04, 0.39, z), (0.38, 0.41, z + 0.06), wood, open_faces=("-x", "+x"))


def bookshelf(
    b: Builder, origin: tuple[float, float, float], yaw: float, rng: np.random.Generator, *, width: float = 1.6
) -> None:
    """An open shelf against a wall (y = 0 at the wall, the room at y < 0) with books in most places."""
    s = b.place(origin, yaw).named("bookshelf")
    depth, height, board = 0.28, 2.05, 0.022
    wood = materials.wood(rng, colour(str(rng.choice(["#9a7650", "#c3a57c", "#6d4c33"])), 0.55), plank=0.3)
    s.box((0, -depth, 0), (board, -0.005, height), wood)
    s.box((width - board, -depth, 0), (width, -0.005, height), wood)
    s.rectangle((board, -0.008, 0), (width - 2 * board, 0, 0), (0, 0, height), wood)
    levels = np.linspace(0.06, height - board, 6)
    for z in levels:
        s.box((board, -depth, z), (width - board, -0.01, z + board), wood, open_faces=("-x", "+x"))
    for i, z in enumerate((*levels[1:-1], height)):
        s.mark(f"shelf {i} left", (board, -depth, z))
        s.mark(f"shelf {i} right", (width - board, -depth, z))
    s.named("books")
    for z in levels[:-1]:
        x = board + 0.01
        while x < width - board - 0.1:
            if rng.random() < 0.08:
                x += float(rng.uniform(0.06, 0.2))
                continue
            thick, tall = float(rng.uniform(0.018, 0.055)), float(rng.uniform(0.21, 0.31))
            if x + thick > width - board - 0.01:
                break
            front = -depth + float(rng.uniform(0.02, 0.07))
            spine = artwork.book_spine(rng, thick, tall)
            cover = Material((materials.fill(colour("#8a8378", 0.5)), materials.painted(spine, 0, 0, thick, tall)))
            pages = materials.plain(colour("#d9d2c0", 0.7), rng)
            low = z + board + 0.0005
            s.rectangle((x, front, low), (thick, 0, 0), (0, 0, tall), cover)
            s.box((x, front, low), (x + thick, front + 0.16, low + tall), pages, open_faces=("-y", "-z", "+y"))
            x += thick + float(rng.uniform(0.0005, 0.003))


def picture(b: Builder, low: tuple[float, float], size: tuple[float, float], rng: np.random.Generator) -> None:
    """A framed picture on the wall plane y = 0, its lower left corner at ``low`` (x, z)."""
    b.named("picture")
    (x, z), (w, h) = low, size
    px, py = max(round(w / 0.0015), 16), max(round(h / 0.0015), 16)
    art = artwork.landscape(rng, px, py) if rng.random() < 0.5 else artwork.abstract(rng, px, py)
    canvas = Material((materials.fill(colour("#d8d2c4", 0.6)), materials.painted(art, 0, 0, w, h)), gloss=0.01)
    frame = materials.wood(rng, colour(str(rng.choice(["#3a2a1e", "#b08d4f", "#e8e4da"])), 0.5), plank=1.0)
    b.rectangle((x, -0.012, z), (w, 0, 0), (0, 0, h), canvas)
    t, out = 0.035, 0.03
    b.box((x - t, -out, z - t), (x + w + t, 0, z), frame, open_faces=("+y",))
    b.box((x - t, -out, z + h), (x + w + t, 0, z + h + t), frame, open_faces=("+y",))
    b.box((x - t, -out, z), (x, 0, z + h), frame, open_faces=("+y", "-z", "+z"))
    b.box((x + w, -out, z), (x + w + t, 0, z + h), frame, open_faces=("+y", "-z", "+z"))
    b.mark(f"picture {x:.1f} {z:.1f} lower left", (x - t, -out, z - t))
    b.mark(f"picture {x:.1f} {z:.1f} upper right", (x + w + t, -out, z + h + t))


def pot_plant(b: Builder, foot: tuple[float, float, float], rng: np.random.Generator) -> None:
    """A plant in a clay pot."""
    b.named("plant")
    x, y, z = foot
    clay = materials.plain(colour("#a5623f", 0.5), rng, 0.2)
    b.column((x, y, z), (0, 0, 0.32), 0.13, clay, top_radius=0.18)
    b.disc((x, y, z + 0.29), (0, 0, 1), 0.17, materials.hedge_soil(rng))
    for _ in range(5):
        lean = rng.normal(0, 0.12, 2)
        b.column((x, y, z + 0.29), (lean[0], lean[1], 0.6), 0.008, materials.bark(rng))
    plants.shrub(b, (x, y, z + 0.95), (0.34, 0.34, 0.42), rng, leaves=260, size=0.075)


def sofa(b: Builder, origin: tuple[float, float, float], yaw: float, rng: np.random.Generator) -> None:
    """A sofa of upholstered blocks, its back at y = 0 and the seat towards −y."""
    s = b.place(origin, yaw).named("sofa")
    base = colour(str(rng.choice(["#6b7f86", "#8a5a4a", "#5a6b4a", "#a89878"])), float(rng.uniform(0.45, 0.7)))
    cloth = Material(
        (
            materials.fill(base),
            materials.noise(0.25, 0.004, octaves=3, gain=0.8, seed=int(rng.integers(9999))),
            materials.noise(0.12, 0.5, octaves=6, seed=int(rng.integers(9999))),
        ),
        relief=(0.002, 0.012),
    )
    s.box((0, -0.85, 0.12), (1.9, 0, 0.40), cloth)
    s.box((0.18, -0.88, 0.40), (0.945, -0.22, 0.52), cloth)
    s.box((0.955, -0.88, 0.40), (1.72, -0.22, 0.52), cloth)
    s.box((0, -0.22, 0.40), (1.9, 0, 0.85), cloth)
    for x in (0.0, 1.72):
        s.box((x, -0.85, 0.40), (x + 0.18, -0.22, 0.62), cloth)
    pillow = materials.cloth(rng, (colour("#d9c9a0", 0.7), colour("#b5533c", 0.6)), 0.07)
    s.rectangle((0.3, -0.36, 0.53), (0.42, 0.0, 0.02), (0.0, 0.12, 0.40), pillow)


def radiator(b: Builder, low: tuple[float, float], width: float, material: Material) -> None:
    """A ribbed radiator on the wall plane y = 0."""
    b.named("radiator")
    x, z = low
    for k in np.arange(x, x + width, 0.06):
        b.box((k, -0.12, z), (k + 0.045, -0.03, z + 0.6), material)
