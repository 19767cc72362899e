"""What does ColourSigma cost, beside the colouring that it accompanies?

Limits: one photo of 24 megapixels, points of a rough wall that it sees, colours by the best view and bilinear sampling,
no files. The time is that of both passes and of what lies between: the surfaces and, with sigma, their slopes. With
sigma it has to be less than one and a half times that without. A machine that does other things moves both.

    python -m benches.peers.colour_sigma [--points 10000000] [--repeats 9]
"""

from __future__ import annotations

import time

import numpy as np

from benches.peers.harness import compare, parser
from colourreg_rs import Camera, Covariance, Pose, View
from colourreg_rs.colourise import ColouriseOptions, Colouriser

CAMERA = Camera(
    "OPENCV",
    6000,
    4000,
    {"fx": 4500.0, "fy": 4500.0, "cx": 2990.0, "cy": 2010.0, "k1": -0.06, "k2": 0.02, "p1": 5e-4, "p2": -3e-4},
)
NAMES = ("rx", "ry", "rz", "cx_world", "cy_world", "cz_world")
CHUNK = 1_000_000


def timed(count: str, covariance: Covariance | None) -> float:
    rng = np.random.default_rng(1)
    view = View("photo", None, CAMERA, Pose.looking_at([0, 0, 2.0], [0, 20.0, 4.0]), covariance=covariance)
    n = int(count)
    xyz = np.stack([rng.uniform(-12, 12, n), 20 + rng.normal(0, 0.01, n), rng.uniform(-4, 12, n)], 1)
    photo = rng.integers(0, 255, (4000, 6000, 3), dtype=np.uint8)
    begin = time.perf_counter()
    colouriser = Colouriser([view], ColouriseOptions())
    for start in range(0, n, CHUNK):
        colouriser.see(xyz[start : start + CHUNK])
    colouriser.finish([photo])
    coloured = 0
    for start in range(0, n, CHUNK):
        coloured += int((colouriser.colour(xyz[start : start + CHUNK]).source > 0).sum())
    seconds = time.perf_counter() - begin
    assert coloured > n // 2
    return seconds


def without(count: str) -> float:
    return timed(count, None)


def with_sigma(count: str) -> float:
    sigmas = np.array([2e-4, 2e-4, 1e-4, 3e-3, 3e-3, 3e-3])
    return timed(count, Covariance(NAMES, np.diag(sigmas**2)))


def main() -> None:
    options = parser(__doc__.splitlines()[0])
    options.set_defaults(repeats=9)  # the difference of two times scatters more than either
    arguments = options.parse_args()
    print(f"colouring {arguments.points:,} points in memory")
    contenders = {"colourreg": without, "colourreg with ColourSigma": with_sigma}
    own, more = compare(contenders, [str(arguments.points)], arguments.repeats)
    share = more.seconds / own.seconds - 1
    print(f"ColourSigma takes {100 * share:.0f} % of the colouring time (limit 50 %)")


if __name__ == "__main__":
    main()
