"""How fast is 2D ICP of 100,000 points against 100,000, against small_gicp and NumPy + SciPy?

All programs get the same points and threshold, do the same number of iterations
(small_gicp is asked for 30 and may stop
before, where the error no longer falls), run in the same process with both cores, and must agree on the transformation.
small_gicp works in space: its points have z = 0. Wall-clock time and processor time: on a machine that does other
things the latter is the fairer one. Limits: a rigid motion, point to point, a fixed threshold; small_gicp's time does
not hold the making of its clouds.

    python benches/peers/icp.py [--points 100000] [--repeat 5]
"""

from __future__ import annotations

import argparse
import importlib.util
import time

import numpy as np
from scipy.spatial import cKDTree

from colourreg_rs import _core

THRESHOLD = 30.0


def even(rng, n):
    points = rng.random((n, 2)) * 4000.0
    return points, rng.permutation(points)


def edges(rng, n):
    """Two samples of the same 400 lines, as edges in a picture: no point has an exact partner."""
    starts, angles = rng.random((400, 2)) * 4000.0, rng.random(400) * 2 * np.pi

    def sample():
        line, along = rng.integers(0, 400, n), rng.random(n) * 300.0
        return starts[line] + np.column_stack([np.cos(angles[line]), np.sin(angles[line])]) * along[:, None]

    return sample(), sample()


def make(kind, n):
    rng = np.random.default_rng(1)
    source, target = kind(rng, n)
    c, s = np.cos(2e-3), np.sin(2e-3)
    target = target @ np.array([[c, s], [-s, c]]) + [8.0, -4.0]
    return source, np.ascontiguousarray(target + rng.normal(0, 0.3, target.shape))


def ours(source, target, iterations):
    result = _core.icp(
        source,
        target,
        motion="rigid",
        threshold=THRESHOLD,
        reduction=1.0,
        max_iterations=iterations,
        change_tolerance=0.0,
        residual_limit=100.0,
    )
    assert len(result.history) == iterations
    return result.transform, iterations


def numpy_scipy(source, target, iterations):
    tree, h = cKDTree(target), np.eye(3)
    for _ in range(iterations):
        moved = source @ h[:2, :2].T + h[:2, 2]
        distance, index = tree.query(moved, distance_upper_bound=THRESHOLD, workers=2)
        ok = np.isfinite(distance)
        p, q = moved[ok], target[index[ok]]
        a, b = p.mean(0), q.mean(0)
        u, _, vt = np.linalg.svd((q - b).T @ (p - a))
        r = u @ np.diag([1, np.linalg.det(u @ vt)]) @ vt
        step = np.eye(3)
        step[:2, :2], step[:2, 2] = r, b - r @ a
        h = step @ h
    return h, iterations


class SmallGicp:
    def __init__(self, source, target):
        self.module = importlib.import_module("small_gicp")
        self.clouds = [
            self.module.PointCloud(np.column_stack([p, np.zeros(len(p)), np.ones(len(p))])) for p in (target, source)
        ]

    def __call__(self, source, target, iterations):
        target_cloud, source_cloud = self.clouds
        tree = self.module.KdTree(target_cloud, num_threads=2)
        result = self.module.align(
            target_cloud,
            source_cloud,
            tree,
            registration_type="ICP",
            max_correspondence_distance=THRESHOLD,
            num_threads=2,
            max_iterations=iterations,
            translation_epsilon=0.0,
            rotation_epsilon=0.0,
        )
        h = np.eye(3)
        h[:2, :2], h[:2, 2] = result.T_target_source[:2, :2], result.T_target_source[:2, 3]
        return h, result.iterations


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--repeat", type=int, default=5)
    args = parser.parse_args()
    for kind in (even, edges):
        source, target = make(kind, args.points)
        programs, iterations = {"colourreg": ours, "numpy + scipy": numpy_scipy}, 30
        if importlib.util.find_spec("small_gicp"):
            programs["small_gicp"] = SmallGicp(source, target)
            # The iteration in which it finds that the error no longer falls is counted as well.
            iterations = min(programs["small_gicp"](source, target, 30)[1] + 1, 30)
        else:
            print("small_gicp is not installed and left out")
        wall: dict[str, list[float]] = {name: [] for name in programs}
        cpu: dict[str, list[float]] = {name: [] for name in programs}
        answers = {}
        for _ in range(args.repeat):
            for name, run in programs.items():
                begin, begin_cpu = time.perf_counter(), time.process_time()
                answers[name] = run(source, target, iterations)[0]
                wall[name].append(time.perf_counter() - begin)
                cpu[name].append(time.process_time() - begin_cpu)
        print(f"2D ICP, {args.points:,} to {args.points:,} points ({kind.__name__}), {iterations} iterations")
        for name in programs:
            a, b = [source @ h[:2, :2].T + h[:2, 2] for h in (answers["colourreg"], answers[name])]
            t, p = float(np.median(wall[name])), float(np.median(cpu[name]))
            t0, p0 = float(np.median(wall["colourreg"])), float(np.median(cpu["colourreg"]))
            print(
                f"  {name:14s} {t:.3f} s ({t / t0:.1f}x), processors {p:.3f} s ({p / p0:.1f}x); "
                f"its points are within {np.abs(a - b).max():.0e} px of colourreg's",
                flush=True,
            )


if __name__ == "__main__":
    main()
