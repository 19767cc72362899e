"""How fast is the nearest of a million points found, against SciPy, pykdtree and Open3D where they are installed?

Every figure is build and query together, the median of the repetitions, all programs on the same input in the same run
and with both cores. Distances are compared with SciPy's. Limits: points of even density, and half of them on lines as
edges in a picture lie; a machine that does other things moves all figures, the ratios less.

    python benches/peers/neighbours.py [--points 1000000] [--repeat 3]
"""

from __future__ import annotations

import argparse
import importlib.util
import time

import numpy as np
from scipy.spatial import cKDTree

from colourreg_rs import _core


def even(rng, n, d):
    return rng.random((n, d)) * 4000.0


def edges(rng, n, d):
    """Half of the points on 400 lines of about 200 px, the others anywhere."""
    starts, angles = rng.random((400, d)) * 4000.0, rng.random(400) * 2 * np.pi
    which = rng.integers(0, 400, n // 2)
    along = rng.random(n // 2) * 200.0
    lines = starts[which].copy()
    lines[:, 0] += np.cos(angles[which]) * along
    lines[:, 1] += np.sin(angles[which]) * along
    return np.concatenate([lines + rng.normal(0, 0.3, lines.shape), even(rng, n - n // 2, d)])


def ours(points, queries, k):
    index = _core.Neighbours(points)
    return index.nearest(queries)[1] if k == 1 else index.k_nearest(queries, k)[1]


def scipy_tree(points, queries, k):
    return cKDTree(points).query(queries, k=k, workers=2)[0]


def pykdtree_tree(points, queries, k):
    return importlib.import_module("pykdtree.kdtree").KDTree(points).query(queries, k=k)[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--repeat", type=int, default=3)
    args = parser.parse_args()
    programs = {"colourreg": ours, "scipy": scipy_tree}
    if importlib.util.find_spec("pykdtree"):
        programs["pykdtree"] = pykdtree_tree
    else:
        print("pykdtree is not installed and left out")
    rng = np.random.default_rng(1)
    print(f"{args.points:,} nearest in {args.points:,} points, build and query; seconds, and times colourreg's")
    for d, k, make in [(2, 1, even), (2, 1, edges), (2, 8, even), (2, 8, edges), (3, 1, even), (3, 8, even)]:
        points, queries = make(rng, args.points, d), make(rng, args.points, d)
        times: dict[str, list[float]] = {name: [] for name in programs}
        answers = {}
        for _ in range(args.repeat):
            for name, run in programs.items():
                begin = time.perf_counter()
                answers[name] = run(points, queries, k)
                times[name].append(time.perf_counter() - begin)
        assert np.allclose(answers["colourreg"], answers["scipy"], rtol=1e-9, atol=1e-9)
        medians = {name: float(np.median(t)) for name, t in times.items()}
        figures = "  ".join(f"{name} {t:.3f} ({t / medians['colourreg']:.1f}x)" for name, t in medians.items())
        print(f"  {d}D k={k} {make.__name__:6s} {figures}", flush=True)


if __name__ == "__main__":
    main()
