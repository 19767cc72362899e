"""Surveyors' targets: circular ones in blue and white, and black-and-white quadrants."""

from __future__ import annotations

from . import materials
from .builder import Builder, Vector
from .materials import Material, colour

_WHITE = colour("#f4f4f2", 0.86)
_BLACK = colour("#141414", 0.04)
_BLUE = colour("#1f4f9e", 0.22)


def _plate(b: Builder, centre: Vector, size: float, material: Material, across: Vector, upward: Vector) -> None:
    corner = [c - 0.5 * size * (a + u) for c, a, u in zip(centre, across, upward, strict=True)]
    b.rectangle(corner, [size * a for a in across], [size * u for u in upward], material)


def circular(
    b: Builder, name: str, centre: Vector, size: float = 0.15, across: Vector = (1, 0, 0), upward: Vector = (0, 0, 1)
) -> None:
    """A blue plate with a white disc; ``across`` and ``upward`` are unit vectors in it, its front their product."""
    middle = (0.5 * size, 0.5 * size)
    material = Material((materials.fill(_BLUE), materials.ring(_WHITE, middle, 0.0, 0.3 * size)), gloss=0.01)
    _plate(b, centre, size, material, across, upward)
    b.mark(name, centre)


def quartered(
    b: Builder, name: str, centre: Vector, size: float = 0.15, across: Vector = (1, 0, 0), upward: Vector = (0, 0, 1)
) -> None:
    """A white plate with two black quadrants that meet in its middle."""
    middle = (0.5 * size, 0.5 * size)
    material = Material((materials.fill(_WHITE), materials.quadrants(_BLACK, middle, 0.44 * size)))
    _plate(b, centre, size, material, across, upward)
    b.mark(name, centre)
