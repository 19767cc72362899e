"""Sun and sky."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

Light = tuple[float, float, float]


@dataclass(frozen=True)
class Lighting:
    """What lights a scene; radiances are linear RGB in units of a white surface's in full daylight.

    ``sun_direction`` points to the sun (scene frame). Light from sky, lamps and other surfaces is gathered on grids of
    ``map_spacing`` metres from ``map_directions`` directions and passed on between surfaces ``bounces`` times.
    """

    sun_direction: tuple[float, float, float] = (0.4, -0.6, 0.7)
    sun: Light = (0.95, 0.88, 0.76)
    sun_radius: float = 0.0047
    zenith: Light = (0.13, 0.23, 0.46)
    horizon: Light = (0.44, 0.52, 0.62)
    ground: Light = (0.16, 0.15, 0.13)
    clouds: float = 0.35
    seed: int = 1
    map_spacing: float = 0.4
    map_directions: int = 48
    bounces: int = 1

    def draft(self) -> Lighting:
        """The same light, gathered coarsely."""
        return replace(
            self, map_spacing=2.5 * self.map_spacing, map_directions=max(self.map_directions // 4, 12), bounces=0
        )

    def row(self) -> npt.NDArray[np.float64]:
        """The numbers in the core's order."""
        return np.array(
            [
                *self.sun_direction, *self.sun, self.sun_radius, *self.zenith, *self.horizon, *self.ground,
                self.clouds, self.seed, self.map_spacing, self.map_directions, self.bounces,
            ],
            dtype=np.float64,
        )  # fmt: skip


def daylight(rng: np.random.Generator, azimuth: tuple[float, float], *, map_spacing: float = 0.4) -> Lighting:
    """A sunny or hazy hour: sun from an azimuth within these limits (radians, from +x anticlockwise), some clouds."""
    a, h = rng.uniform(*azimuth), np.radians(rng.uniform(24.0, 52.0))
    direction = (float(np.cos(a) * np.cos(h)), float(np.sin(a) * np.cos(h)), float(np.sin(h)))
    warm = 1.0 - np.sin(h)
    strength = float(rng.uniform(0.8, 1.05))
    sun = (1.02 * strength, strength * (0.94 - 0.16 * warm), strength * (0.84 - 0.34 * warm))
    return Lighting(
        sun_direction=direction,
        sun=sun,
        clouds=float(rng.uniform(0.1, 0.6)),
        seed=int(rng.integers(1, 10_000)),
        map_spacing=map_spacing,
    )
