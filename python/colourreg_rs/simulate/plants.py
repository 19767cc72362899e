"""Trees and shrubs: branches of frustums, and leaves one by one."""

from __future__ import annotations

import numpy as np

from . import materials
from .builder import Builder, FloatArray
from .materials import Material


def _unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.linalg.norm(v))


def _leaf(b: Builder, at: FloatArray, size: float, material: Material, rng: np.random.Generator) -> None:
    along = _unit(rng.normal(0, 1, 3) + np.array([0, 0, -0.3]))
    across = _unit(np.cross(along, rng.normal(0, 1, 3)))
    length = size * float(rng.uniform(0.7, 1.25))
    b.leaf(at, along * length, across * length * 0.55, material)


def tree(
    b: Builder, foot: tuple[float, float, float], height: float, rng: np.random.Generator, *, leaves: int = 4200
) -> None:
    """A broad-leaved tree."""
    b.named("tree")
    wood, foliage = materials.bark(rng), [materials.leaves(rng) for _ in range(4)]
    tips: list[tuple[FloatArray, float]] = []

    def grow(start: FloatArray, direction: FloatArray, length: float, radius: float, level: int) -> None:
        b.column(start, direction * length, radius, wood, top_radius=radius * 0.72)
        end = start + direction * length
        if level == 3:
            tips.append((end, length))
            return
        for k in range(4 if level == 0 else 3):
            turn = 2 * np.pi * (k / (4 if level == 0 else 3) + float(rng.uniform(-0.1, 0.1)))
            spread = float(rng.uniform(0.45, 0.95))
            helper = _unit(np.cross(direction, rng.normal(0, 1, 3)))
            side = np.cos(turn) * helper + np.sin(turn) * np.cross(direction, helper)
            grow(
                end,
                _unit(direction + spread * side + [0, 0, 0.12]),
                length * float(rng.uniform(0.58, 0.78)),
                radius * 0.6,
                level + 1,
            )

    trunk = _unit(np.array([float(rng.normal(0, 0.04)), float(rng.normal(0, 0.04)), 1.0]))
    grow(np.asarray(foot, dtype=np.float64), trunk, 0.38 * height, 0.022 * height, 0)
    for i in range(leaves):
        tip, reach = tips[i % len(tips)]
        _leaf(b, tip + rng.normal(0, 0.5, 3) * reach, 0.065, foliage[i % 4], rng)


def shrub(
    b: Builder,
    centre: tuple[float, float, float],
    radii: tuple[float, float, float],
    rng: np.random.Generator,
    *,
    leaves: int = 900,
    size: float = 0.035,
) -> None:
    """An ellipsoid of leaves, densest at its surface."""
    b.named("shrub")
    foliage = [materials.leaves(rng) for _ in range(3)]
    for i in range(leaves):
        direction = _unit(rng.normal(0, 1, 3))
        at = np.asarray(centre) + direction * np.asarray(radii) * float(rng.uniform(0.15, 1.0)) ** 0.33
        if at[2] > 0.02:
            _leaf(b, at, size, foliage[i % 3], rng)
