"""Façades: walls with recessed windows, sills, balconies, doors, shop fronts, cornices and roofs.

The local frame of a façade: x along it to the right as seen from the street, z up, y into the building.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from . import artwork, materials
from .builder import Builder
from .materials import Colour, Material, colour


@dataclass(frozen=True)
class Style:
    """What one façade is made of and how it is divided."""

    wall: Material
    plinth: Material
    trim: Material
    frame: Material
    rail: Material
    bay: float
    ground_height: float
    storey_height: float
    window: tuple[float, float]
    sill: float
    surround: bool
    shutters: Material | None
    balconies: float


def random_style(rng: np.random.Generator, *, wall: str | None = None) -> Style:
    """A façade of plaster, brick or stone."""
    kind = wall or str(rng.choice(["plaster", "brick", "stone"], p=[0.55, 0.3, 0.15]))
    if kind == "plaster":
        code = str(rng.choice(["#d3c3a4", "#cdb098", "#c6c7b6", "#dcd5c4", "#c09a86", "#b9c0c1", "#d6c79c", "#c7bfb3"]))
        body = materials.plaster(colour(code, float(rng.uniform(0.5, 0.68))), rng, age=float(rng.uniform(0.6, 1.4)))
    elif kind == "brick":
        body = materials.brick(rng)
    else:
        body = materials.ashlar(rng)
    shutters = None
    if kind == "plaster" and rng.random() < 0.5:
        base = colour(str(rng.choice(["#3f5a3c", "#4a5d70", "#6b3a2e", "#5c6b52"])), float(rng.uniform(0.25, 0.5)))
        shutters = Material(
            (
                materials.fill(base),
                materials.courses(
                    materials.shaded(base, 0.25), 5.0, 0.045, 0.008, stagger=0.0, brightness=0.08, relief=0.5, wobble=0
                ),
                materials.noise(0.15, 0.3, octaves=7, seed=int(rng.integers(9999))),
            )
        )
    frame_code = str(rng.choice(["#eeebe2", "#e6e0d0", "#5a4332", "#3d4a44"]))
    return Style(
        wall=body,
        plinth=materials.ashlar(rng) if rng.random() < 0.7 else materials.stone(rng, colour("#8c857a", 0.4)),
        trim=materials.stone(rng, colour(str(rng.choice(["#cfc5b0", "#bdb3a2", "#d8cfbd"])), 0.55)),
        frame=materials.plain(colour(frame_code, float(rng.uniform(0.45, 0.7))), rng, 0.08),
        rail=materials.metal(rng, "#22252a", 0.12),
        bay=float(rng.uniform(2.3, 3.0)),
        ground_height=float(rng.uniform(3.4, 4.0)),
        storey_height=float(rng.uniform(2.9, 3.4)),
        window=(float(rng.uniform(0.95, 1.3)), float(rng.uniform(1.5, 1.9))),
        sill=float(rng.uniform(0.75, 0.95)),
        surround=bool(rng.random() < 0.7),
        shutters=shutters,
        balconies=float(rng.choice([0.0, 0.25, 0.45])),
    )


def facade(
    b: Builder,
    width: float,
    storeys: int,
    style: Style,
    rng: np.random.Generator,
    *,
    name: str = "house",
    shops: float = 0.3,
    posters: float = 0.5,
    roof: bool = True,
    depth: float = 8.0,
    sides: str = "lr",
) -> float:
    """A house front of this width at the builder's origin, with plain side walls; returns its height."""
    b.named(f"{name} wall")
    bays = max(round(width / style.bay), 1)
    bay = width / bays
    openings: list[tuple[float, float, float, float]] = []
    door_bay = int(rng.integers(bays))
    ground_floor = [
        "door" if i == door_bay else "shop" if bay > 2.2 and rng.random() < shops else "window" for i in range(bays)
    ]
    height = style.ground_height + style.storey_height * (storeys - 1)
    for storey in range(storeys):
        low = 0.0 if storey == 0 else style.ground_height + (storey - 1) * style.storey_height
        for i in range(bays):
            middle = (i + 0.5) * bay
            tag = f"{name} {storey}-{i}"
            if storey == 0 and ground_floor[i] == "door":
                openings.append(_door(b, middle, style, rng, tag))
            elif storey == 0 and ground_floor[i] == "shop":
                openings.append(_shop(b, middle, bay, style, rng, tag))
            else:
                balcony = storey > 0 and rng.random() < style.balconies
                openings.append(_window(b, middle, low, style, rng, tag, balcony=balcony))
                # Posters hang between two windows.
                if storey == 0 and ground_floor[i : i + 2] == ["window"] * 2 and rng.random() < posters:
                    _posters(b, middle, bay, style, rng, tag)
    b.named(f"{name} wall")
    plinth = min(0.55, style.sill - 0.1)
    b.wall(width, height, style.wall, openings, low=plinth)
    gaps = sorted((o[0], o[2]) for o in openings if o[1] < plinth)
    x = 0.0
    for x0, x1 in [*gaps, (width, width)]:
        if x0 > x + 0.01:
            b.box((x, -0.06, 0.0), (x0, 0.02, plinth), style.plinth, open_faces=("-z", "+y"))
        x = x1
    _cornice(b, width, height, style, rng)
    if "l" in sides:
        b.rectangle((0, depth, 0), (0, -depth, 0), (0, 0, height), style.wall, (-depth, 0))
    if "r" in sides:
        b.rectangle((width, 0, 0), (0, depth, 0), (0, 0, height), style.wall, (width, 0))
    if roof:
        _roof(b, width, height, depth, rng, style)
    _downpipe(b, width - 0.25 if rng.random() < 0.5 else 0.25, height, style, name)
    return height


def _reveal(b: Builder, hole: tuple[float, float, float, float], depth: float, material: Material) -> None:
    x0, z0, x1, z1 = hole
    w, h = x1 - x0, z1 - z0
    b.rectangle((x0, 0, z0), (0, depth, 0), (0, 0, h), material, (x0, z0))
    b.rectangle((x1, depth, z0), (0, -depth, 0), (0, 0, h), material, (x1, z0))
    b.rectangle((x0, 0, z0), (w, 0, 0), (0, depth, 0), material, (x0, z0))
    b.rectangle((x0, depth, z1), (w, 0, 0), (0, -depth, 0), material, (x0, z1))


def _casement(
    b: Builder,
    hole: tuple[float, float, float, float],
    y: float,
    frame: Material,
    rng: np.random.Generator,
    *,
    columns: int = 2,
    transom: float | None = 0.7,
    bar: float = 0.055,
) -> None:
    """Frame and panes in an opening, the frame's face at depth y."""
    x0, z0, x1, z1 = hole
    front, back = y, y + 0.05
    uprights = np.linspace(x0, x1 - bar, columns + 1)
    levels = [z0, z1 - bar] if transom is None else [z0, z0 + transom * (z1 - z0), z1 - bar]
    for x in uprights:
        b.box((x, front, z0), (x + bar, back, z1), frame, open_faces=("+y", "-z", "+z"))
    for z in levels:
        for a, c in pairwise(uprights):
            b.box((a + bar, front, z), (c, back, z + bar), frame, open_faces=("+y", "-x", "+x"))
    behind = artwork.interior(rng, x1 - x0, z1 - z0)
    for k, (a, c) in enumerate(pairwise(uprights)):
        for low, high in pairwise(levels):
            w, h = c - a, high - low
            part = _crop(behind, (a - x0) / (x1 - x0), (low - z0) / (z1 - z0), w / (x1 - x0), h / (z1 - z0))
            # Panes are never quite parallel: each mirrors another piece of sky.
            tilt = rng.normal(0.0, 0.004, 2)
            b.rectangle(
                (a, y + 0.03 + 0.002 * k, low),
                (w, tilt[0] * w, 0),
                (0, tilt[1] * h, h),
                materials.window_glass(part, w, h),
            )


def _crop(painting: materials.Painting, s: float, t: float, ds: float, dt: float) -> materials.Painting:
    h, w = painting.shape[:2]
    x0, x1 = int(s * w), max(int((s + ds) * w), int(s * w) + 1)
    y0, y1 = int((1 - t - dt) * h), max(int((1 - t) * h), int((1 - t - dt) * h) + 1)
    return painting[max(y0, 0) : y1, x0:x1].copy()


def _window(
    b: Builder, middle: float, low: float, style: Style, rng: np.random.Generator, name: str, *, balcony: bool
) -> tuple[float, float, float, float]:
    w, h = style.window
    z0 = low + (0.05 if balcony else style.sill)
    hole = (middle - w / 2, z0, middle + w / 2, low + style.sill + h)
    x0, _, x1, z1 = hole
    depth = 0.17
    b.named(f"{name} window")
    _reveal(b, hole, depth, style.wall)
    _casement(b, hole, depth - 0.06, style.frame, rng, transom=float(rng.choice([0.66, 0.72])))
    b.mark(f"{name} lower left", (x0, 0, z0))
    b.mark(f"{name} upper left", (x0, 0, z1))
    b.mark(f"{name} upper right", (x1, 0, z1))
    b.mark(f"{name} lower right", (x1, 0, z0))
    if not balcony:
        b.box((x0 - 0.09, -0.11, z0 - 0.07), (x1 + 0.09, 0, z0 + 0.004), style.trim, open_faces=("+y",))
        b.rectangle((x0, 0, z0 + 0.004), (w, 0, 0), (0, depth, 0), style.trim)
    if style.surround:
        t, out = 0.13, 0.035
        b.box((x0 - t, -out, z0), (x0, 0, z1 + t), style.trim, open_faces=("+y",))
        b.box((x1, -out, z0), (x1 + t, 0, z1 + t), style.trim, open_faces=("+y",))
        b.box((x0, -out, z1), (x1, 0, z1 + t), style.trim, open_faces=("+y",))
        b.box((x0 - t - 0.05, -0.10, z1 + t), (x1 + t + 0.05, 0, z1 + t + 0.08), style.trim, open_faces=("+y",))
    elif style.shutters is not None and not balcony:
        for side, x in (("l", x0 - 0.04), ("r", x1 + 0.04)):
            wide = w / 2 - 0.02
            left = x - wide if side == "l" else x
            b.box((left, -0.075, z0), (left + wide, -0.035, z1), style.shutters)
    if balcony:
        _balcony(b, middle, low, w + 0.7, style, name)
    return hole


def _balcony(b: Builder, middle: float, low: float, width: float, style: Style, name: str) -> None:
    b.named(f"{name} balcony")
    x0, x1, out = middle - width / 2, middle + width / 2, 0.85
    b.box((x0, -out, low - 0.13), (x1, 0, low), style.trim, open_faces=("+y",))
    for x in (x0 + 0.15, x1 - 0.27):
        b.box((x, -0.5, low - 0.38), (x + 0.12, 0, low - 0.13), style.trim, open_faces=("+y", "+z"))
    top = low + 1.0
    rail = style.rail
    b.box((x0, -out, top), (x1, -out + 0.045, top + 0.03), rail)
    b.box((x0, -out + 0.045, top), (x0 + 0.045, 0, top + 0.03), rail, open_faces=("-y",))
    b.box((x1 - 0.045, -out + 0.045, top), (x1, 0, top + 0.03), rail, open_faces=("-y",))
    n = int((width - 0.045) / 0.115)
    for x in np.linspace(x0 + 0.022, x1 - 0.022, n):
        b.column((x, -out + 0.022, low), (0, 0, 1.0), 0.008, rail)
    for y in np.arange(-out + 0.13, -0.05, 0.115):
        for x in (x0 + 0.022, x1 - 0.022):
            b.column((x, y, low), (0, 0, 1.0), 0.008, rail)


def _door(
    b: Builder, middle: float, style: Style, rng: np.random.Generator, name: str
) -> tuple[float, float, float, float]:
    b.named(f"{name} door")
    w, h = float(rng.uniform(1.1, 1.4)), float(rng.uniform(2.5, 2.8))
    step = 0.16
    hole = (middle - w / 2, 0.0, middle + w / 2, step + h)
    x0, _, x1, z1 = hole
    depth = 0.28
    _reveal(b, hole, depth, style.wall)
    leaf_top = step + 2.12
    base = colour(
        str(rng.choice(["#5b3a24", "#2f4a3a", "#6b2222", "#2b3c55", "#8a6a45"])), float(rng.uniform(0.35, 0.55))
    )
    leaf = materials.wood(rng, base, plank=w / 2, gloss=0.02)
    b.rectangle((x0, depth, step), (w, 0, 0), (0, 0, leaf_top - step), leaf)
    for i in range(2):
        for k, (a, c) in enumerate(((0.10, 0.75), (0.90, 1.95))):
            left = x0 + i * w / 2 + 0.07
            frame = (left, step + a, left + w / 2 - 0.14, step + c)
            inset = 0.02 + 0.01 * k
            b.box((frame[0], depth - inset, frame[1]), (frame[2], depth, frame[3]), leaf, open_faces=("+y",))
    b.box((middle - 0.02, depth - 0.025, step), (middle + 0.02, depth, leaf_top), leaf, open_faces=("+y", "-z"))
    b.ball((middle + 0.08, depth - 0.05, step + 1.05), 0.032, materials.metal(rng, "#b59a4a", 0.6))
    _casement(b, (x0, leaf_top, x1, z1), depth - 0.06, style.frame, rng, columns=2, transom=None)
    t = 0.18
    b.box((x0 - t, -0.07, 0), (x0, 0, z1 + t), style.trim, open_faces=("+y", "-z"))
    b.box((x1, -0.07, 0), (x1 + t, 0, z1 + t), style.trim, open_faces=("+y", "-z"))
    b.box((x0, -0.07, z1), (x1, 0, z1 + t), style.trim, open_faces=("+y",))
    b.box((x0 - t - 0.08, -0.16, z1 + t), (x1 + t + 0.08, 0, z1 + t + 0.10), style.trim, open_faces=("+y",))
    b.box((x0 - 0.1, -0.42, 0), (x1 + 0.1, depth, step), materials.stone(rng), open_faces=("-z", "+y"))
    plate = artwork.number_plate(str(int(rng.integers(1, 99))), 0.22, 0.16)
    m = Material((materials.fill(colour("#1d3f87", 0.5)), materials.painted(plate, 0, 0, 0.22, 0.16)), gloss=0.03)
    b.rectangle((x1 + t + 0.12, -0.012, 1.75), (0.22, 0, 0), (0, 0, 0.16), m)
    b.mark(f"{name} door left", (x0, 0, z1))
    b.mark(f"{name} door right", (x1, 0, z1))
    return hole


def _shop(
    b: Builder, middle: float, bay: float, style: Style, rng: np.random.Generator, name: str
) -> tuple[float, float, float, float]:
    b.named(f"{name} shop")
    w = bay - 0.5
    hole = (middle - w / 2, 0.35, middle + w / 2, 2.65)
    x0, z0, x1, z1 = hole
    depth = 0.22
    _reveal(b, hole, depth, style.trim)
    dark = materials.wood(rng, colour(str(rng.choice(["#2c3a33", "#4a2a20", "#333a44"])), 0.3), plank=0.2)
    _casement(b, hole, depth - 0.06, dark, rng, columns=max(int(w / 0.9), 1), transom=0.8, bar=0.07)
    b.box((x0 - 0.05, -0.05, 0), (x1 + 0.05, depth - 0.06, z0), dark, open_faces=("+y", "-z"))
    board = artwork.shop_sign(rng, w + 0.2, 0.5)
    sign = Material((materials.fill(colour("#333333", 0.4)), materials.painted(board, 0, 0, w + 0.2, 0.5)), gloss=0.03)
    b.box((x0 - 0.1, -0.10, z1 + 0.08), (x1 + 0.1, 0, z1 + 0.58), dark, open_faces=("+y", "-y"))
    b.rectangle((x0 - 0.1, -0.10, z1 + 0.08), (w + 0.2, 0, 0), (0, 0, 0.5), sign)
    if rng.random() < 0.6:
        stripes: tuple[Colour, Colour] = (
            colour(str(rng.choice(["#e8e2d2", "#efe6cf"])), 0.7),
            colour(str(rng.choice(["#8a2b2b", "#2c5a3f", "#2a4a78", "#b5702a"])), 0.6),
        )
        awning = materials.cloth(rng, stripes)
        b.rectangle((x0 - 0.15, -1.1, z1 - 0.45), (w + 0.3, 0, 0), (0, 1.0, 0.5), awning)
        b.rectangle((x0 - 0.15, -1.1, z1 - 0.65), (w + 0.3, 0, 0), (0, 0, 0.2), awning)
    b.mark(f"{name} sign lower left", (x0 - 0.1, -0.10, z1 + 0.08))
    b.mark(f"{name} sign upper right", (x1 + 0.1, -0.10, z1 + 0.58))
    return hole


def poster_board(
    b: Builder, corner: tuple[float, float, float], width: float, height: float, rng: np.random.Generator
) -> None:
    """A poster on the wall plane (facing −y), its lower left corner at ``corner``."""
    art = artwork.poster(rng, width, height)
    m = Material((materials.fill(colour("#f2efe8", 0.78)), materials.painted(art, 0, 0, width, height)))
    lean = float(rng.normal(0, 0.01))
    b.rectangle(corner, (width, 0, lean * width), (-lean * height, 0, height), m)


def _posters(b: Builder, middle: float, bay: float, style: Style, rng: np.random.Generator, name: str) -> None:
    gap = bay - style.window[0] - (0.36 if style.surround else 0.08)
    if style.shutters is not None and not style.surround:
        gap -= style.window[0]
    if gap < 0.62:
        return
    b.named(f"{name} posters")
    w = min(gap - 0.12, 0.84)
    x = middle + bay / 2 - w / 2
    poster_board(b, (x, -0.006, 1.05), w, w * 1.41, rng)
    b.mark(f"{name} poster upper left", (x, -0.006, 1.05 + w * 1.41))


def _cornice(b: Builder, width: float, height: float, style: Style, rng: np.random.Generator) -> None:
    b.box((-0.02, -0.10, height - 0.45), (width + 0.02, 0, height - 0.30), style.trim, open_faces=("+y",))
    b.box((-0.10, -0.22, height - 0.16), (width + 0.10, 0, height), style.trim, open_faces=("+y",))
    b.box((-0.18, -0.38, height), (width + 0.18, 0.3, height + 0.10), style.trim, open_faces=("+y",))
    if rng.random() < 0.7:
        for x in np.arange(0.15, width - 0.1, 0.42):
            b.box((x, -0.19, height - 0.28), (x + 0.14, 0, height - 0.16), style.trim, open_faces=("+y", "+z"))
    if rng.random() < 0.6:
        z = style.ground_height - 0.12
        b.box((0, -0.06, z), (width, 0, z + 0.14), style.trim, open_faces=("+y", "-x", "+x"))


def _roof(b: Builder, width: float, height: float, depth: float, rng: np.random.Generator, style: Style) -> None:
    tiles = materials.roof_tiles(rng)
    rise = 0.7 * depth / 2
    z = height + 0.1
    b.rectangle((-0.15, -0.42, z), (width + 0.3, 0, 0), (0, depth / 2 + 0.42, rise), tiles)
    b.rectangle((width + 0.15, depth + 0.4, z), (-width - 0.3, 0, 0), (0, -depth / 2 - 0.4, rise), tiles)
    b.triangle((width, 0, height), (width, depth, height), (width, depth / 2, height + rise), style.wall)
    b.triangle((0, depth, height), (0, 0, height), (0, depth / 2, height + rise), style.wall)
    b.column((-0.15, -0.46, z - 0.02), (width + 0.3, 0, 0), 0.06, materials.metal(rng, "#7f8683", 0.35))
    for x in np.arange(width * 0.3, width - 1.0, 4.5):
        b.box((x, depth * 0.3, z + rise * 0.4), (x + 0.6, depth * 0.3 + 0.5, z + rise + 0.6), materials.brick(rng))


def _downpipe(b: Builder, x: float, height: float, style: Style, name: str) -> None:
    b.named(f"{name} downpipe")
    pipe = style.rail if style.balconies == 0 else Material(style.trim.layers[:2], gloss=0.01)
    b.column((x, -0.13, 0.1), (0, 0, height - 0.1), 0.045, pipe)
    for z in np.arange(1.0, height, 2.4):
        b.column((x, -0.13, z), (0, 0, 0.03), 0.055, pipe)
