"""What of a scan gets a colour from a photo, and is it what the photo sees?

Simulated scenes, each with its own seed, are scanned and photographed; the scan is coloured with the true view from a
photo without noise. Every point is asked, by casting rays into the exact scene, whether the photo sees it and, where
it does not, whether what hides it was scanned: nothing else can be known to hide it. For each photo, in percent:

- *seen*: of the points that the photo sees, those that got a colour;
- *hidden*: of the points hidden behind scanned surfaces, those that got a colour;
- *beyond 1 px*: of the same points, those that got a colour though the picture shows nothing as far away as the point
  within a pixel of it;
- *colour*: the median difference from the true colour, grey levels of 255, over the seen points that have one.

    python -m colourreg_rs.experiments.visibility_accuracy --scene square --seeds 6 --megapixels 1.5 --megapixels 6
"""

from __future__ import annotations

import itertools
import pickle
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .. import _core
from ..model import FloatArray, View
from ..simulate import Response, SimulatedPhoto, Simulation, simulate
from . import options

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

#: Points whose colour is compared.
COMPARED = 50_000

#: Columns to rows of the photos.
ASPECT = 1.5


@dataclass(frozen=True)
class Case:
    """A photo, a scan, and what is true of the points whose noisy and whose exact place both fall into the photo and
    which lie on one surface.

    - ``seen``: points (indices) that the photo sees.
    - ``hidden``: points behind scanned surfaces. ``far``: whether the picture shows nothing as far away within a pixel.
    - ``compared`` and ``colours``: some of the seen points with their true colours (N, 3), grey levels of 255.
    """

    scene: str
    seed: int
    photo: int
    view: View
    image: npt.NDArray[np.uint8]
    xyz: FloatArray
    seen: IntArray
    hidden: IntArray
    far: BoolArray
    compared: IntArray
    colours: FloatArray

    @property
    def megapixels(self) -> float:
        """Of the photo."""
        return float(self.image.shape[0] * self.image.shape[1]) / 1e6


@dataclass(frozen=True)
class Outcome:
    """The parts of one case's points that were coloured, and the colours' median error in grey levels."""

    scene: str
    seed: int
    photo: int
    megapixels: float
    seen: float
    hidden: float
    far: float
    colour: float


def photo_size(megapixels: float) -> tuple[int, int]:
    """Width and height of a photo."""
    height = round(np.sqrt(megapixels * 1e6 / ASPECT))
    return round(ASPECT * height), height


def cases(
    scene: str, seed: int, size: tuple[int, int], photos: int | None = None, cache: Path | None = None
) -> list[Case]:
    """The photos of a scene (the first ``photos``, or all) with the truth; kept in ``cache`` where that is given."""
    file = None if cache is None else cache / f"visibility-{scene}-{seed}-{size[0]}x{size[1]}-{photos or 'all'}.pickle"
    if file is not None and file.exists():
        return [Case(**fields) for fields in pickle.loads(file.read_bytes())]
    response = Response().without_noise()
    made = simulate(scene, seed=seed, photos=photos, size=size, samples=4, draft=True, response=response)
    found = [case(made, i) for i in range(len(made.photos))]
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        # Plain values: a class is kept by the name of its module, which is another one when that is run as a command.
        file.write_bytes(pickle.dumps([vars(c) for c in found]))
    return found


def case(simulation: Simulation, number: int) -> Case:
    """What is true of one photo of a simulation. The scan has its noise; whether a point is seen is asked of the exact
    surface that it was measured on."""
    photo, truth = simulation.photos[number], simulation.scan_truth
    xyz, surface = (np.ascontiguousarray(a) for a in (simulation.scan.xyz, truth.surface))
    xy, _ = _core.project(photo.view.core, surface)
    noisy, _ = _core.project(photo.view.core, xyz)
    counted = np.flatnonzero(_within(photo, xy) & _within(photo, noisy) & ~truth.mixed)
    seen = photo.visible(surface[counted], 1e-4)
    behind = counted[~seen]
    hidden = behind[_behind_scanned(simulation, photo, surface[behind])]
    visible = counted[seen]
    compared = np.random.default_rng(0).permutation(visible)[:COMPARED]
    return Case(
        simulation.name, simulation.seed, number, replace(photo.view), photo.image, xyz, visible, hidden,
        ~_beside(photo, surface[hidden], xy[hidden]), compared, photo.true_colour(surface[compared]),
    )  # fmt: skip


def _within(photo: SimulatedPhoto, xy: FloatArray) -> BoolArray:
    size = (photo.view.core.width, photo.view.core.height)
    with np.errstate(invalid="ignore"):
        return np.asarray((xy >= -0.5).all(axis=1) & (xy < np.array(size) - 0.5).all(axis=1))


def _behind_scanned(simulation: Simulation, photo: SimulatedPhoto, points: FloatArray) -> BoolArray:
    """Whether what hides each point from the photo was seen by a scanner, and is not glass."""
    scene, eye = simulation.scene, photo.view.core.centre
    rays = points - eye
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    hits = scene.cast(eye, rays)
    places = np.ascontiguousarray(scene.frame.to_scene(eye + rays * hits.distance[:, None]))
    scanned = np.zeros(len(points), np.bool_)
    for station in simulation.stations:
        scanned |= scene.core.sees(scene.frame.to_scene(np.array(station)), places, 1e-3)
    return np.asarray(scanned & ~scene.glass[hits.primitive])


def _beside(photo: SimulatedPhoto, points: FloatArray, xy: FloatArray) -> BoolArray:
    """Whether the middle of a pixel within 1.5 pixels of a point (a pixel's own half, and one) shows something as far
    away as the point."""
    depth, _ = photo.depth_image
    height, width = depth.shape
    at = np.rint(xy).astype(int)
    distance = np.linalg.norm(points - photo.view.core.centre, axis=1)
    beside = np.zeros(len(points), np.bool_)
    for dy, dx in itertools.product((-2, -1, 0, 1, 2), repeat=2):
        x, y = at[:, 0] + dx, at[:, 1] + dy
        near = (np.hypot(x - xy[:, 0], y - xy[:, 1]) < 1.5) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        beside[near] |= depth[y[near], x[near]] >= distance[near] * (1 - 2e-4)
    return beside


def measure(case: Case) -> Outcome:
    """Colours a case's scan and compares."""
    buffer = _core.DepthBuffer(case.view.core)
    buffer.add(case.xyz)
    rgb, source = _core.colour_points([buffer.finish()], [case.image], case.xyz)
    coloured = source > 0
    wrong = coloured[case.hidden]
    compared = coloured[case.compared]
    error = np.abs(rgb[case.compared[compared]] / 256.0 - case.colours[compared])
    return Outcome(
        case.scene, case.seed, case.photo + 1, case.megapixels, _share(coloured[case.seen]), _share(wrong),
        _share(wrong & case.far), float(np.median(error)) if len(error) else float("nan"),
    )  # fmt: skip


def _share(those: BoolArray) -> float:
    return float(those.mean()) if len(those) else float("nan")


def run(
    scenes: Sequence[str],
    seeds: Sequence[int],
    megapixels: Sequence[float],
    photos: int | None = None,
    cache: Path | None = None,
) -> Iterator[Outcome]:
    """All scenes, sizes and seeds, photo by photo."""
    for scene, size, seed in itertools.product(scenes, megapixels, seeds):
        for case in cases(scene, seed, photo_size(size), photos, cache):
            yield measure(case)


HEADER = (
    "| scene   |   MP | seed | photo | seen, % | hidden, % | beyond 1 px, % | colour |\n"
    "| ------- | ---: | ---: | ----: | ------: | --------: | -------------: | -----: |"
)


def line(o: Outcome) -> str:
    """A row of the table."""
    return (
        f"| {o.scene:7} | {o.megapixels:4.1f} | {o.seed:4} | {o.photo:5} | {100 * o.seen:7.2f} | "
        f"{100 * o.hidden:9.2f} | {100 * o.far:14.2f} | {o.colour:6.2f} |"
    )


def summary(outcomes: Sequence[Outcome]) -> str:
    """For each scene and size the median over the photos, and the worst of them."""
    rows = [
        "| scene   |   MP | photos | seen, % (least) | hidden, % (most) | beyond 1 px, % (most) | colour (most) |",
        "| ------- | ---: | -----: | --------------: | ---------------: | --------------------: | ------------: |",
    ]
    for scene, megapixels in dict.fromkeys((o.scene, o.megapixels) for o in outcomes):
        mine = [o for o in outcomes if (o.scene, o.megapixels) == (scene, megapixels)]
        figures = 100 * np.array([[o.seen, o.hidden, o.far, o.colour / 100] for o in mine])
        middle = np.median(figures, axis=0)
        worst = [figures[:, 0].min(), *figures[:, 1:].max(axis=0)]
        pairs = [f"{m:.2f} ({w:.2f})" for m, w in zip(middle, worst, strict=True)]
        rows.append(
            f"| {scene:7} | {megapixels:4.1f} | {len(mine):6} | {pairs[0]:>15} | {pairs[1]:>16} | {pairs[2]:>21} | "
            f"{pairs[3]:>13} |"
        )
    return "\n".join(rows)


def main() -> None:
    """Prints both tables."""
    parser = options.parser(__doc__, "square, demo, facade, room", "6")
    parser.add_argument("--megapixels", type=float, action="append", help="of the photos; several times for several")
    parser.add_argument("--photos", type=int, help="of each scene; all unless given")
    parser.add_argument("--cache", type=Path, help="a folder that keeps the simulations with their truth")
    arguments = parser.parse_args()
    outcomes = []
    print(HEADER, flush=True)
    for outcome in run(
        arguments.scene or ["square"], arguments.seeds, arguments.megapixels or [1.5], arguments.photos,
        arguments.cache,
    ):  # fmt: skip
        print(line(outcome), flush=True)
        outcomes.append(outcome)
    print()
    print(summary(outcomes))


if __name__ == "__main__":
    main()
