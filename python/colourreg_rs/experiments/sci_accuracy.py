"""How well does registration without picks do, by the truth, and does it know how well?

Simulated scenes with realistic materials and lighting, each scanned and photographed with its own seed; the true view
is turned about a random axis and moved in a random direction, and registered again. For every registration: the rms
distance in the photo, over the points that it sees, between where the result and the truth project them; the same as
the result's covariance predicts it; whether the program believed its result; and whether the truth lies in the 95 %
region that it states for the six parameters of the pose.

    python -m colourreg_rs.experiments.sci_accuracy --scene facade --scene room --seeds 10

``--columns`` turns the scanner by a share of its step, and ``--finer`` divides the step: the same photo, other points.
What changes then is due to where the scan's columns happen to lie.

Source of the region: χ² with six degrees of freedom of the error in the covariance's metric.
"""

from __future__ import annotations

import itertools
import json
import pickle
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .. import _core
from ..matching.register_sci import SciOptions, SciRegistration, register_sci
from ..model import FloatArray, PointCloud, Pose, View
from ..sci import render_sci, with_size
from ..simulate.scanner import Scanner
from . import options

#: χ² with six degrees of freedom holds 95 % below this.
LIMIT_95 = 12.592

#: Starts that are tried: degrees, metres.
STARTS = ((0.5, 0.02), (3.0, 0.2))


@dataclass(frozen=True)
class Case:
    """A photo with its true view, the scan that it is registered to and where the scanner stood."""

    scene: str
    seed: int
    scan: PointCloud
    image: npt.NDArray[np.uint8]
    truth: View
    station: tuple[float, float, float]


@dataclass(frozen=True)
class Outcome:
    """One registration against its truth.

    - ``start`` and ``error``: rms distances in the photo over all visible points, px; of a failure ``error`` is that of
      the view that it would have returned, which is the start.
    - ``predicted``: the same distance as the covariance has it, px. ``distance``: the squared Mahalanobis distance of
      the pose's error; both NaN for a failure.
    """

    scene: str
    seed: int
    degrees: float
    metres: float
    start: float
    error: float
    predicted: float
    distance: float
    trusted: bool
    reasons: tuple[str, ...]
    seconds: float

    @property
    def inside(self) -> bool:
        """Whether the truth lies in the stated 95 % region."""
        return self.distance < LIMIT_95


@dataclass(frozen=True)
class Grid:
    """How the scanner's directions differ from the scene's own: columns moved by a share of the step, and the step
    divided."""

    columns: float = 0.0
    finer: float = 1.0

    def of(self, scanner: Scanner) -> Scanner:
        """The scanner with these directions."""
        first, last = (edge + self.columns * scanner.step for edge in scanner.azimuth)
        return replace(scanner, azimuth=(first, last), step=scanner.step / self.finer)


#: The scene's own.
GIVEN = Grid()


def simulated(scene: str, seed: int, size: tuple[int, int], cache: Path | None = None, grid: Grid = GIVEN) -> Case:
    """A scene's first photo and its scan; kept in ``cache`` where that is given."""
    from ..simulate import simulate

    other = "" if grid == GIVEN else f"-{grid.columns}-{grid.finer}"
    file = None if cache is None else cache / f"{scene}-{seed}-{size[0]}x{size[1]}{other}.pickle"
    if file is not None and file.exists():
        return Case(scene, seed, *pickle.loads(file.read_bytes()))
    made = simulate(scene, seed=seed, photos=1, size=size, samples=4, scanner=grid.of)
    photo = made.photos[0]
    parts = (made.scan, photo.image, replace(photo.view), made.stations[0])
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(pickle.dumps(parts))
    return Case(scene, seed, *parts)


def disturbed(view: View, rng: np.random.Generator, degrees: float, metres: float) -> View:
    """The view turned about a random axis and moved in a random direction, by so much."""
    assert view.pose is not None
    axis, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    cross = np.cross(np.eye(3), -axis)
    angle = np.radians(degrees)
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return replace(view, pose=Pose.from_centre(turn @ view.pose.rotation, view.pose.centre + shift * metres))


def visible_points(cloud: PointCloud, view: View) -> FloatArray:
    """Points (N, 3) of the cloud that the view sees, even over the photo."""
    core = view.core
    sci = render_sci(cloud, with_size(view, 480, round(480 * core.height / core.width)))
    return np.ascontiguousarray(cloud.xyz[sci.index[sci.measured]])


def rms_distance(found: View, truth: View, xyz: FloatArray) -> float:
    """Of the projections of points by two views, px; infinite where a point is not seen by ``found``."""
    apart = _core.project(found.core, xyz)[0] - _core.project(truth.core, xyz)[0]
    square = (apart**2).sum(1)
    return float(np.sqrt(square.mean())) if np.isfinite(square).all() else float("inf")


def pose_error(found: View, truth: View) -> FloatArray:
    """What takes the true pose from the one found, as covariances count it: rotation vector on the left, centre."""
    assert found.pose is not None and truth.pose is not None
    turn = truth.pose.rotation @ found.pose.rotation.T
    # For the small angles of a registration's error sin is the angle.
    vector = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return np.concatenate([vector, truth.pose.centre - found.pose.centre])


def register(case: Case, degrees: float, metres: float) -> tuple[Outcome, SciRegistration]:
    """Registers a case from a disturbed start."""
    rng = np.random.default_rng([zlib.crc32(case.scene.encode()), case.seed, round(100 * degrees)])
    start = disturbed(case.truth, rng, degrees, metres)
    begin = time.perf_counter()
    result = register_sci(case.scan, case.image, start, SciOptions(station=case.station))
    seconds = time.perf_counter() - begin
    xyz = visible_points(case.scan, case.truth)
    predicted = distance = float("nan")
    if result.trusted and result.view.covariance is not None:
        predicted = float(np.sqrt(2.0)) * result.predicted_error
        error = pose_error(result.view, case.truth)
        distance = float(error @ np.linalg.solve(result.view.covariance.matrix, error))
    outcome = Outcome(
        case.scene, case.seed, degrees, metres, rms_distance(start, case.truth, xyz),
        rms_distance(result.view, case.truth, xyz), predicted, distance, result.trusted, result.reasons, seconds,
    )  # fmt: skip
    return outcome, result


def run(
    scenes: Sequence[str],
    seeds: Sequence[int],
    size: tuple[int, int],
    cache: Path | None = None,
    starts: Sequence[tuple[float, float]] = STARTS,
    kept: Path | None = None,
    grid: Grid = GIVEN,
) -> Iterator[Outcome]:
    """All seeds, scenes and starts, in this order, so that what is there after an interruption has all kinds.

    ``kept`` is a file to which every outcome is added, one a line, when it is there; those that it has are not made
    again.
    """
    done = {} if kept is None or not kept.exists() else {_key(o): o for o in _read(kept)}
    for seed, scene in itertools.product(seeds, scenes):
        case = None
        for degrees, metres in starts:
            outcome = done.get((scene, seed, degrees, metres))
            if outcome is None:
                case = case or simulated(scene, seed, size, cache, grid)
                outcome = register(case, degrees, metres)[0]
                if kept is not None:
                    with kept.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(asdict(outcome)) + "\n")
            yield outcome


def _key(o: Outcome) -> tuple[str, int, float, float]:
    return o.scene, o.seed, o.degrees, o.metres


def _read(kept: Path) -> Iterator[Outcome]:
    for text in kept.read_text(encoding="utf-8").splitlines():
        fields = json.loads(text)
        yield Outcome(**(fields | {"reasons": tuple(fields["reasons"])}))


def line(o: Outcome) -> str:
    """A row of the table."""
    verdict = "inside" if o.inside else "OUTSIDE"
    figures = f"{o.error:8.3f} | {o.predicted:9.3f} | {o.distance:8.1f} | {verdict:7}"
    if not o.trusted:
        figures = f"{'failed':>8} | {'':9} | {'':8} | {'':7}"
    start = f"{o.scene:7} | {o.seed:4} | {o.degrees:4.1f}° {o.metres:.2f} m | {o.start:7.1f}"
    return f"| {start} | {figures} | {o.seconds:5.1f} |"


HEADER = (
    "| scene   | seed | start off    | px      |  rms px  | predicted |    χ²    | 95 %    |   s   |\n"
    "| ------- | ---: | ------------ | ------: | -------: | --------: | -------: | ------- | ----: |"
)


def summary(outcomes: Sequence[Outcome]) -> str:
    """The figures of each scene and start, and the coverage over all."""
    rows = [
        "| scene   | start off    | photos | trusted | median px | largest px | < 0.5 px | in the 95 % region | s   |",
        "| ------- | ------------ | -----: | ------: | --------: | ---------: | -------: | -----------------: | --: |",
    ]
    groups = sorted({(o.scene, o.degrees, o.metres) for o in outcomes})
    for group in groups:
        mine = [o for o in outcomes if (o.scene, o.degrees, o.metres) == group]
        good = [o for o in mine if o.trusted]
        errors = np.array([o.error for o in good] or [float("nan")])
        rows.append(
            f"| {group[0]:7} | {group[1]:4.1f}° {group[2]:.2f} m | {len(mine):6} | {len(good):7} | "
            f"{np.median(errors):9.3f} | {errors.max():10.3f} | {(errors < 0.5).sum():8} | "
            f"{sum(o.inside for o in good):18} | {np.median([o.seconds for o in mine]):3.1f} |"
        )
    good = [o for o in outcomes if o.trusted]
    wrong = [o for o in good if o.error > max(1.0, 4 * o.predicted)]
    inside = sum(o.inside for o in good)
    rows.append("")
    rows.append(
        f"{len(outcomes)} registrations, {len(good)} trusted, {len(wrong)} of them wrong (more than 1 px and four "
        f"times the predicted error); {inside} of {len(good)} hold the truth in their 95 % region "
        f"({100 * inside / max(len(good), 1):.0f} %)."
    )
    return "\n".join(rows)


def main() -> None:
    """Prints both tables."""
    parser = options.parser(__doc__, "facade, room, square, corner", "10")
    parser.add_argument("--size", default="1200x800", help="of the photos")
    parser.add_argument("--start", type=float, action="append", help="0.5 or 3 degrees off; both unless one is given")
    parser.add_argument("--cache", type=Path, help="a folder that keeps the simulations")
    parser.add_argument("--keep", type=Path, help="a file that keeps the outcomes: a run that was stopped goes on")
    parser.add_argument("--columns", type=float, default=0.0, help="turn the scanner by this share of its step")
    parser.add_argument("--finer", type=float, default=1.0, help="divide the scanner's step by this")
    arguments = parser.parse_args()
    grid = Grid(arguments.columns, arguments.finer)
    if arguments.keep is not None and grid != GIVEN:
        parser.error("--keep knows scans by scene and seed alone: leave it out with --columns and --finer")
    width, height = (int(n) for n in arguments.size.split("x"))
    wanted = arguments.start or [degrees for degrees, _ in STARTS]
    starts = [start for start in STARTS if start[0] in wanted]
    if len(starts) != len(set(wanted)):
        parser.error(f"--start is one of {', '.join(f'{degrees:g}' for degrees, _ in STARTS)}")
    scenes, seeds = arguments.scene or ["facade", "room"], arguments.seeds
    outcomes = []
    print(HEADER, flush=True)
    for outcome in run(scenes, seeds, (width, height), arguments.cache, starts, arguments.keep, grid):
        print(line(outcome), flush=True)
        for reason in outcome.reasons:
            print(f"    {reason}", flush=True)
        outcomes.append(outcome)
    print()
    print(summary(outcomes))


if __name__ == "__main__":
    main()
