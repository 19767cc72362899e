"""What surfaces are made of: stacks of procedural layers, and a small library of real materials.

Every colour has four channels: visible red, green and blue, and the near infrared that a scanner works in. The two
disagree as they do outdoors: leaves are bright in near infrared, printed paper is as white as unprinted, soot and
carbon black stay dark, painted wood and cloth lose their colour.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Painting = npt.NDArray[np.uint8]


class Colour(NamedTuple):
    """Linear reflectances in [0, 1]."""

    red: float
    green: float
    blue: float
    nir: float


def colour(code: str, nir: float) -> Colour:
    """The colour of an sRGB code like ``"#b05a3c"`` with a near-infrared reflectance."""
    value = np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return Colour(float(linear[0]), float(linear[1]), float(linear[2]), nir)


def shaded(base: Colour, factor: float) -> Colour:
    """The same colour, lighter or darker."""
    return Colour(*(min(c * factor, 0.95) for c in base))


@dataclass(frozen=True)
class Layer:
    """One layer over those below; the numbers are those of the core's patterns."""

    pattern: int
    colour: Colour
    amount: float = 1.0
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    seed: int = 0
    parameters: tuple[float, ...] = ()
    painting: Painting | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Material:
    """A stack of layers, lowest first, and how the whole surface takes light.

    ``gloss`` is the mirror reflectance at normal incidence; ``translucency`` the part of the light that comes through;
    ``relief`` height and wavelength (m) of bumps that show in sunlight; ``emission`` light of its own (linear RGB);
    ``glass`` says that the laser passes through and seldom returns.
    """

    layers: tuple[Layer, ...]
    gloss: float = 0.0
    translucency: float = 0.0
    relief: tuple[float, float] = (0.0, 0.1)
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    glass: bool = False

    def over(self, *layers: Layer) -> Material:
        """The same with more layers on top."""
        return replace(self, layers=(*self.layers, *layers))


EVEN = Colour(1.0, 1.0, 1.0, 1.0)
#: Gains of unevenness that comes from the surface's fine relief: daylight shows it, the scanner's own light hardly.
RELIEF = Colour(1.0, 1.0, 1.0, 0.3)
#: Gains of dirt: browner and darker, weaker in near infrared.
DIRT = Colour(0.85, 1.0, 1.2, 0.45)


def fill(base: Colour) -> Layer:
    """Covers everything with one colour."""
    return Layer(0, base)


def noise(
    amount: float,
    size: float | tuple[float, float, float],
    *,
    octaves: int = 6,
    gain: float = 0.55,
    seed: int = 0,
    channels: Colour = EVEN,
    on_surface: bool = False,
) -> Layer:
    """Fractal unevenness from ``size`` metres down, as a factor about 1."""
    return Layer(1, channels, amount, _scale(size), seed, (octaves, gain, float(on_surface)))


def patches(
    base: Colour,
    amount: float,
    size: float | tuple[float, float, float],
    *,
    threshold: float = 0.2,
    softness: float = 0.15,
    octaves: int = 6,
    seed: int = 0,
    on_surface: bool = False,
) -> Layer:
    """Stains of another colour, where fractal noise is high."""
    return Layer(2, base, amount, _scale(size), seed, (octaves, 0.55, float(on_surface), threshold, softness))


def courses(
    joint_colour: Colour,
    length: float,
    height: float,
    joint: float,
    *,
    stagger: float = 0.5,
    brightness: float = 0.15,
    hue: float = 0.06,
    relief: float = 0.0,
    wobble: float = 0.002,
    seed: int = 0,
    amount: float = 1.0,
) -> Layer:
    """Cells in courses with joints: bricks, stones, tiles, planks. A negative ``stagger`` is random."""
    parameters = (joint, stagger, brightness, hue, relief, wobble)
    return Layer(3, joint_colour, amount, (length, height, 1.0), seed, parameters)


def gradient(base: Colour, amount: float, low: float, high: float, *, by_height: bool = True) -> Layer:
    """Covers below ``low`` and fades out up to ``high`` (scene height, or the second surface coordinate)."""
    return Layer(4, base, amount, parameters=(low, high, float(by_height)))


def painted(painting: Painting, left: float, low: float, right: float, high: float) -> Layer:
    """A painting (H, W, 5: sRGB, near infrared, opacity) on a rectangle of surface coordinates."""
    return Layer(5, EVEN, parameters=(0.0, left, low, right, high), painting=painting)


def ring(base: Colour, centre: tuple[float, float], inner: float, outer: float) -> Layer:
    """A ring about ``centre``; a disc if ``inner`` is 0."""
    return Layer(6, base, parameters=(*centre, inner, outer))


def quadrants(base: Colour, centre: tuple[float, float], radius: float) -> Layer:
    """Two opposite quadrants of a disc: the pattern of a black-and-white target."""
    return Layer(7, base, parameters=(*centre, radius))


def rectangle(base: Colour, left: float, low: float, right: float, high: float, amount: float = 1.0) -> Layer:
    """A rectangle of surface coordinates."""
    return Layer(8, base, amount, parameters=(left, low, right, high))


def _scale(size: float | tuple[float, float, float]) -> tuple[float, float, float]:
    return size if isinstance(size, tuple) else (size, size, size)


# The library. Each takes a generator: no two walls are alike.


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1, 1_000_000))


def plain(base: Colour, rng: np.random.Generator, amount: float = 0.05) -> Material:
    """An almost even surface, such as painted metal or plastic."""
    return Material((fill(base), noise(amount, 0.4, octaves=8, seed=_seed(rng))))


def plaster(base: Colour, rng: np.random.Generator, *, age: float = 1.0) -> Material:
    """Rendered wall: grain down to the millimetre, clouds of dirt, runs of rain, stains near the ground."""
    grime = colour("#4f4a42", 0.25)
    return Material(
        (
            fill(base),
            noise(0.16 * age, 2.6, octaves=5, gain=0.6, seed=_seed(rng), channels=DIRT),
            noise(0.12, 0.16, octaves=8, gain=0.72, seed=_seed(rng), channels=RELIEF),
            patches(grime, 0.42 * age, (0.34, 0.34, 4.0), threshold=0.42, softness=0.4, octaves=5, seed=_seed(rng)),
            patches(shaded(base, 1.18), 0.5, 1.1, threshold=0.55, softness=0.05, octaves=7, seed=_seed(rng)),
            patches(colour("#6d685e", 0.3), 0.5, 0.5, threshold=0.62, softness=0.06, octaves=7, seed=_seed(rng)),
            gradient(grime, 0.3 * age, -0.1, 0.9),
        ),
        relief=(0.0022, 0.014),
    )


def brick(rng: np.random.Generator, base: Colour | None = None) -> Material:
    """Brickwork in stretcher bond."""
    base = base or [
        colour("#a35a41", 0.42), colour("#8f4f3c", 0.38), colour("#b98a5e", 0.5), colour("#a8644b", 0.45)
    ][int(rng.integers(4))]  # fmt: skip
    mortar = colour(str(rng.choice(["#b3aa9b", "#9a9284", "#c4bcae"])), 0.5)
    return Material(
        (
            fill(base),
            noise(0.3, 0.07, octaves=7, gain=0.7, seed=_seed(rng), channels=RELIEF),
            patches(shaded(base, 0.45), 0.7, 0.09, threshold=0.45, softness=0.2, octaves=5, seed=_seed(rng)),
            courses(mortar, 0.25, 0.0765, 0.011, brightness=0.3, hue=0.12, relief=0.06, wobble=0.004, seed=_seed(rng)),
            noise(0.1, 2.2, octaves=5, seed=_seed(rng), channels=DIRT),
            patches(colour("#d8d2c8", 0.6), 0.25, 1.4, threshold=0.5, softness=0.3, seed=_seed(rng)),
            gradient(colour("#4a463e", 0.25), 0.35, -0.1, 0.7),
        ),
        relief=(0.0025, 0.02),
    )


def ashlar(
    rng: np.random.Generator, base: Colour | None = None, *, length: float = 0.8, height: float = 0.4
) -> Material:
    """Dressed stone blocks."""
    base = base or colour(str(rng.choice(["#c2b28f", "#b8ab97", "#c9bda6", "#a89f90"])), float(rng.uniform(0.45, 0.6)))
    return Material(
        (
            fill(base),
            noise(0.14, 0.5, octaves=9, gain=0.66, seed=_seed(rng)),
            noise(0.13, 0.03, octaves=6, gain=0.7, seed=_seed(rng), channels=RELIEF),
            courses(
                colour("#6f675a", 0.32), length, height, 0.009, brightness=0.13, hue=0.05, wobble=0.003,
                relief=0.04, seed=_seed(rng),
            ),
            patches(
                colour("#57514a", 0.22), 0.5, (0.5, 0.5, 2.4), threshold=0.4, softness=0.35, octaves=6, seed=_seed(rng)
            ),
            gradient(colour("#57514a", 0.25), 0.35, -0.1, 0.6),
        ),
        relief=(0.003, 0.03),
    )  # fmt: skip


def stone(rng: np.random.Generator, base: Colour | None = None) -> Material:
    """Stone without joints: sills, steps, columns."""
    base = base or colour("#b9b0a0", 0.52)
    return Material(
        (
            fill(base),
            noise(0.15, 0.35, octaves=8, gain=0.65, seed=_seed(rng)),
            noise(0.14, 0.02, octaves=5, gain=0.75, seed=_seed(rng), channels=RELIEF),
            patches(shaded(base, 0.5), 0.45, (0.2, 0.2, 0.9), threshold=0.4, softness=0.3, seed=_seed(rng)),
        ),
        relief=(0.0015, 0.02),
    )


def concrete(rng: np.random.Generator) -> Material:
    """Cast concrete with pores and formwork joints."""
    base = colour(str(rng.choice(["#9b9892", "#a8a49c", "#8b8982"])), 0.42)
    return Material(
        (
            fill(base),
            noise(0.14, 1.3, octaves=9, gain=0.6, seed=_seed(rng)),
            patches(shaded(base, 0.4), 0.8, 0.03, threshold=0.68, softness=0.06, octaves=3, seed=_seed(rng)),
            courses(shaded(base, 0.6), 1.25, 2.5, 0.006, stagger=0.0, brightness=0.07, seed=_seed(rng)),
            patches(shaded(base, 0.6), 0.5, (0.3, 0.3, 3.0), threshold=0.35, softness=0.4, seed=_seed(rng)),
        ),
        relief=(0.0012, 0.015),
    )


def wood(rng: np.random.Generator, base: Colour, *, plank: float = 0.14, gloss: float = 0.0) -> Material:
    """Planks with grain along the second surface coordinate."""
    return Material(
        (
            fill(base),
            noise(0.28, (0.018, 0.5, 1.0), octaves=5, gain=0.6, seed=_seed(rng), on_surface=True),
            noise(0.12, (0.16, 1.6, 1.0), octaves=4, seed=_seed(rng), on_surface=True),
            courses(
                shaded(base, 0.25), plank, 2.1, 0.004, stagger=0.0, brightness=0.14, hue=0.05, wobble=0.0,
                seed=_seed(rng),
            ),
        ),
        gloss=gloss,
    )  # fmt: skip


def parquet(rng: np.random.Generator, base: Colour) -> Material:
    """A floor of short boards."""
    return Material(
        (
            fill(base),
            noise(0.25, (0.35, 0.02, 1.0), octaves=5, gain=0.6, seed=_seed(rng), on_surface=True),
            courses(
                shaded(base, 0.3), 0.9, 0.11, 0.0025, stagger=-1.0, brightness=0.22, hue=0.07, wobble=0.0,
                seed=_seed(rng),
            ),
            noise(0.1, 1.5, octaves=5, seed=_seed(rng)),
        ),
        gloss=0.03,
    )  # fmt: skip


def asphalt(rng: np.random.Generator) -> Material:
    """Road surface with stones, patches and cracks."""
    base = colour("#5c5b59", 0.2)
    return Material(
        (
            fill(base),
            noise(0.35, 0.011, octaves=3, gain=0.8, seed=_seed(rng)),
            noise(0.2, 0.5, octaves=8, gain=0.7, seed=_seed(rng)),
            patches(shaded(base, 0.72), 0.6, 3.5, threshold=0.5, softness=0.03, octaves=8, seed=_seed(rng)),
            patches(
                colour("#8b857a", 0.35), 0.3, (0.25, 2.5, 1.0), threshold=0.3, softness=0.4, octaves=7, seed=_seed(rng)
            ),
            patches(shaded(base, 0.35), 0.7, 0.05, threshold=0.72, softness=0.05, octaves=3, seed=_seed(rng)),
        ),
        relief=(0.0025, 0.012),
    )


def cobbles(rng: np.random.Generator, size: float = 0.105) -> Material:
    """Setts of granite with sand in the joints."""
    base = colour(str(rng.choice(["#8d877e", "#7f7b76", "#94897b"])), 0.36)
    return Material(
        (
            fill(base),
            noise(0.3, 0.02, octaves=5, gain=0.75, seed=_seed(rng)),
            courses(
                colour("#4c453a", 0.26), size, size, 0.016, stagger=-1.0, brightness=0.28, hue=0.06, wobble=0.013,
                seed=_seed(rng),
            ),
            patches(colour("#52583a", 0.5), 0.5, 1.7, threshold=0.42, softness=0.25, octaves=8, seed=_seed(rng)),
            noise(0.16, 3.0, octaves=5, seed=_seed(rng), channels=DIRT),
        ),
        relief=(0.010, 0.08),
    )  # fmt: skip


def slabs(rng: np.random.Generator, size: float = 0.5) -> Material:
    """Paving slabs."""
    base = colour(str(rng.choice(["#a39c90", "#b0a89a", "#98948d"])), 0.42)
    return Material(
        (
            fill(base),
            noise(0.2, 0.02, octaves=5, gain=0.75, seed=_seed(rng)),
            courses(
                colour("#58524a", 0.27), size, size, 0.008, brightness=0.14, hue=0.05, wobble=0.003, seed=_seed(rng)
            ),
            patches(colour("#5d574e", 0.28), 0.5, 0.7, threshold=0.38, softness=0.25, octaves=8, seed=_seed(rng)),
            noise(0.14, 3.0, octaves=5, seed=_seed(rng), channels=DIRT),
        ),
        relief=(0.002, 0.02),
    )


def roof_tiles(rng: np.random.Generator) -> Material:
    """Clay tiles, darker towards the lower edge of each."""
    base = colour(str(rng.choice(["#9c5038", "#8a4a3a", "#6b5a52"])), 0.4)
    return Material(
        (
            fill(base),
            noise(0.2, 0.1, octaves=6, gain=0.65, seed=_seed(rng)),
            courses(
                shaded(base, 0.3), 0.22, 0.34, 0.014, brightness=0.25, hue=0.1, relief=0.5, wobble=0.004,
                seed=_seed(rng),
            ),
            patches(colour("#4d4f3a", 0.5), 0.5, 0.8, threshold=0.4, softness=0.2, seed=_seed(rng)),
        )
    )  # fmt: skip


def metal(rng: np.random.Generator, code: str, nir: float = 0.3) -> Material:
    """Painted or galvanised metal."""
    base = colour(code, nir)
    return Material(
        (
            fill(base),
            noise(0.1, 0.3, octaves=7, seed=_seed(rng)),
            patches(colour("#6b4a35", 0.3), 0.5, 0.25, threshold=0.6, softness=0.08, seed=_seed(rng)),
        ),
        gloss=0.02,
    )


def leaves(rng: np.random.Generator) -> Material:
    """Foliage: dark green, and very bright in near infrared."""
    code = str(rng.choice(["#5d7a34", "#6b8a3a", "#4f6b2e", "#7b8f42", "#48632f"]))
    base = colour(code, float(rng.uniform(0.62, 0.74)))
    return Material((fill(base), noise(0.3, 0.35, octaves=5, seed=_seed(rng))), translucency=0.45)


def bark(rng: np.random.Generator) -> Material:
    """Bark with furrows along the trunk."""
    base = colour(str(rng.choice(["#6b5a49", "#7a6a58", "#5a4d41"])), 0.42)
    return Material(
        (
            fill(base),
            noise(0.5, (0.03, 0.03, 0.2), octaves=5, gain=0.6, seed=_seed(rng)),
            patches(colour("#7d8560", 0.5), 0.5, 0.25, threshold=0.35, softness=0.2, seed=_seed(rng)),
        ),
        relief=(0.006, 0.03),
    )


def hedge_soil(rng: np.random.Generator) -> Material:
    """Earth with litter."""
    return Material(
        (
            fill(colour("#5b4a38", 0.3)),
            noise(0.4, 0.08, octaves=7, gain=0.7, seed=_seed(rng)),
            patches(colour("#8a7a4a", 0.45), 0.6, 0.05, threshold=0.35, softness=0.1, seed=_seed(rng)),
        ),
        relief=(0.01, 0.05),
    )


def grass(rng: np.random.Generator) -> Material:
    """Short grass."""
    return Material(
        (
            fill(colour("#6a7d3a", 0.6)),
            noise(0.5, (0.012, 0.012, 0.05), octaves=4, gain=0.8, seed=_seed(rng)),
            patches(colour("#8b8250", 0.5), 0.5, 0.5, threshold=0.2, softness=0.3, octaves=7, seed=_seed(rng)),
        ),
        relief=(0.02, 0.03),
    )


def cloth(rng: np.random.Generator, stripes: tuple[Colour, Colour], width: float = 0.22) -> Material:
    """Striped awning cloth."""
    bands = [rectangle(stripes[1], (2 * i + 1) * width, -9.0, (2 * i + 2) * width, 9.0) for i in range(-1, 24)]
    return Material(
        (fill(stripes[0]), *bands, noise(0.12, 0.5, octaves=8, seed=_seed(rng), channels=DIRT)), translucency=0.2
    )


def window_glass(behind: Painting, width: float, height: float) -> Material:
    """A pane with what is seen through it; from outside mostly the sky's mirror image."""
    return Material((fill(colour("#14171a", 0.05)), painted(behind, 0.0, 0.0, width, height)), gloss=0.11, glass=True)
