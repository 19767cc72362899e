"""Are the points that back-projection makes for a photo's pixels where the photo looks, and are their sigmas right?

Simulated scenes are scanned and photographed from a view that is known; nine rays through every pixel, cast into the
exact scene, say what it shows. For each origin of a point:

- *wrong*: of all, in percent, those that none of their pixel's rays meets within five sigmas and 2 cm, the sigmas being
  those that are written unless told otherwise;
- *goes on*: of the extended ones, in percent, those whose pixel shows the very face that the nearest measured pixel
  shows; beyond it no sigma can say what there is;
- *1, 2, 3 sigma*: shares of the errors along the ray within so many sigmas of the range's noise alone (68.3, 95.4 and
  99.7 % would be right), where all nine rays meet one face, and for extended points the one that goes on.

    python -m colourreg_rs.experiments.backproject_accuracy --scene corner --scene square --scene facade --seeds 0:6
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .. import _core
from ..backproject import BackProjection, BackprojectOptions, Origin, backproject
from ..model import FloatArray
from ..sci import render_sci
from ..simulate import Simulation, simulate
from . import options

#: Pixels and points of the scenes' photos and scans.
SIZES = {"corner": ((1500, 1000), 500_000), "square": ((1200, 800), 600_000), "facade": ((1200, 800), 400_000)}

#: The same for scenes that are not named there.
USUAL = ((1200, 800), 500_000)

#: How far surfaces are extended, px.
EXTENSION = 8.0


@dataclass(frozen=True)
class Outcome:
    """Of one photo and one origin: how many points, what part is wrong, of these unseen by the scanner, what part goes
    on, and the parts of the errors within one, two and three sigmas."""

    scene: str
    seed: int
    origin: Origin
    points: int
    wrong: float
    unseen: float
    goes_on: float
    within: tuple[float, float, float]


@dataclass(frozen=True)
class Truth:
    """What nine rays through each of N pixels meet: distances (9, N), the middle one the fifth; primitives likewise."""

    distance: FloatArray
    primitive: npt.NDArray[np.int64]


def truth(simulation: Simulation, pixels: npt.NDArray[np.int64]) -> Truth:
    """Rays through the pixels' centres, borders and corners."""
    eye = simulation.photos[0].view.core
    hits = [
        simulation.scene.cast(eye.centre, _core.unproject(eye, pixels + (np.array(shift) - 1) / 2))
        for shift in np.ndindex(3, 3)
    ]
    return Truth(np.stack([h.distance for h in hits]), np.stack([h.primitive for h in hits]).astype(np.int64))


def wrong(simulation: Simulation, result: BackProjection, true: Truth) -> npt.NDArray[np.bool_]:
    """(N,): which points are where no ray of their pixel meets anything, by five sigmas and 2 cm.

    At a silhouette the pixel's centre and its corners meet different surfaces: each of them is right.
    """
    found = np.linalg.norm(result.cloud.xyz - simulation.photos[0].view.core.centre, axis=1)
    off = np.abs(true.distance - found).min(axis=0)
    return np.asarray((off > 5 * result.sigma[:, 0]) & (off > 0.02))


#: What may stand before a place that the scanner sees, metres: rounding of the place.
NEARLY = 1e-3


def unseen(simulation: Simulation, pixels: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """(N,): whether none of a pixel's nine rays ends where the scanner sees. It sees no glass and no sky."""
    eye, scene = simulation.photos[0].view.core, simulation.scene
    stations = [scene.frame.to_scene(np.array(station)) for station in simulation.stations]
    seen = np.zeros(len(pixels), dtype=np.bool_)
    for shift in np.ndindex(3, 3):
        rays = _core.unproject(eye, pixels + (np.array(shift) - 1) / 2)
        hits = scene.cast(eye.centre, rays)
        solid = np.flatnonzero(np.isfinite(hits.distance))
        solid = solid[~scene.glass[hits.primitive[solid]]]
        places = scene.frame.to_scene(eye.centre + rays[solid] * hits.distance[solid, None])
        for station in stations:
            seen[solid] |= scene.core.sees(station, np.ascontiguousarray(places), NEARLY)
    return ~seen


def measure(simulation: Simulation, extension: float = EXTENSION) -> list[Outcome]:
    """Back-projects the first photo, and compares."""
    view = simulation.photos[0].view
    sci = render_sci(simulation.scan, view, exponents=(0.0, 0.0), fill=0)
    written = backproject(simulation.scan, view, options=BackprojectOptions(extension=extension), sci=sci)
    noise = float(np.median(simulation.scan_truth.range_sigma))
    alone = BackprojectOptions(extension=extension, depth_sigma=noise, pixel_sigma=0.0)
    result = backproject(simulation.scan, view, options=alone, sci=sci)
    true = truth(simulation, result.pixels)
    # Noise decides which points are on one surface, so that a few pixels have a point in one of both alone.
    true_of_written = true if np.array_equal(written.pixels, result.pixels) else truth(simulation, written.pixels)
    bad = wrong(simulation, written, true_of_written)
    hidden = np.zeros(len(bad), dtype=np.bool_)
    hidden[bad] = unseen(simulation, written.pixels[bad])
    whole = (true.primitive == true.primitive[4]).all(axis=0) & (true.primitive[4] >= 0)
    row, column = np.nonzero(sci.measured)
    measured = np.stack([column, row], axis=1).astype(np.float64)
    nearest, _ = _core.Neighbours(measured).nearest(result.pixels.astype(np.float64))
    same = true.primitive[4] == truth(simulation, np.stack([column, row], axis=1)[nearest]).primitive[4]
    distance = np.linalg.norm(result.cloud.xyz - view.core.centre, axis=1)
    error = np.abs(distance - true.distance[4]) / result.sigma[:, 0]
    outcomes = []
    for origin in Origin:
        mine = result.origin == origin
        compared = mine & whole & (same | (origin != Origin.EXTENDED))
        within = [_share(error[compared] < k) for k in (1, 2, 3)]
        outcomes.append(
            Outcome(
                simulation.name,
                simulation.seed,
                origin,
                int((written.origin == origin).sum()),
                _share(bad[written.origin == origin]),
                _share(hidden[bad & (written.origin == origin)]),
                _share(same[mine]),
                (within[0], within[1], within[2]),
            )
        )
    return outcomes


def _share(those: npt.NDArray[np.bool_]) -> float:
    return float(those.mean()) if len(those) else float("nan")


def run(scenes: Sequence[str], seeds: Sequence[int], extension: float = EXTENSION) -> Iterator[Outcome]:
    """All scenes and seeds."""
    for scene, seed in itertools.product(scenes, seeds):
        size, points = SIZES.get(scene, USUAL)
        simulation = simulate(scene, seed=seed, photos=1, size=size, points=points, draft=True, samples=1)
        yield from measure(simulation, extension)


HEADER = (
    "| scene   | seed | origin       |  points | wrong, % | unseen, % | goes on, % | 1, 2, 3 sigma, %   |\n"
    "| ------- | ---: | ------------ | ------: | -------: | --------: | ---------: | -----------------: |"
)


def line(o: Outcome) -> str:
    """A row of the table."""
    within = ", ".join(f"{100 * share:.1f}" for share in o.within)
    goes_on = f"{100 * o.goes_on:10.1f}" if o.origin == Origin.EXTENDED else " " * 10
    return (
        f"| {o.scene:7} | {o.seed:4} | {o.origin.name.lower():12} | {o.points:7} | {100 * o.wrong:8.3f} | "
        f"{100 * o.unseen:9.1f} | {goes_on} | {within:>18} |"
    )


def main() -> None:
    """Prints the table."""
    parser = options.parser(__doc__, "corner, square, facade", "3")
    parser.add_argument("--extension", type=float, default=EXTENSION, help="of surfaces beside the scan, px")
    arguments = parser.parse_args()
    print(HEADER, flush=True)
    for outcome in run(arguments.scene or ["corner", "square", "facade"], arguments.seeds, arguments.extension):
        print(line(outcome), flush=True)


if __name__ == "__main__":
    main()
