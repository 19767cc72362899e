"""How fast, and how accurate, is resection with a calibrated camera beside OpenCV, pycolmap and PoseLib?

All get the same control points in turn in one process: a photo of 6000 × 4000 px with OpenCV's distortion, points 10
to 40 m away, 0.5 px of noise, and, for the robust ones, blunders anywhere in the photo. The median of several scenes
counts; what is compared with the truth is the projection centre. Limits: pycolmap and PoseLib estimate robustly always;
a threshold of 4 px is given to all that take one; USAC answers without a last refinement, which is its way of being
fast. Points that a program cannot work with at map coordinates are still given to it: that is what its users do.
OpenCV's iterative search needs a start and gets its own (SQPNP).

    python -m benches.peers.resection [--repeats 5]
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from colourreg_rs import _core

MAP = np.array([456_789.0, 5_812_345.0, 143.0])
PARAMS = np.array([4200.0, 4200.0, 2999.5, 1999.5, -0.05, 0.01, 1e-4, -2e-4, 0.0])
K = np.array([[PARAMS[0], 0, PARAMS[2]], [0, PARAMS[1], PARAMS[3]], [0, 0, 1]])
THRESHOLD = 4.0


@dataclass
class Task:
    """Control points, the camera at a place of no meaning, and the true centre."""

    xyz: np.ndarray
    xy: np.ndarray
    camera: _core.View
    centre: np.ndarray


def task(n: int, share: float, shift: np.ndarray, seed: int) -> Task:
    rng = np.random.default_rng(seed)
    rotation = cv2.Rodrigues(rng.normal(0, 1, 3))[0]
    centre = rng.normal(0, 5, 3) + shift
    view = _core.View.canonical("OPENCV", 6000, 4000, PARAMS, rotation, -rotation @ centre)
    pixels = rng.uniform(0.02, 0.98, (n, 2)) * [6000, 4000]
    xyz = np.ascontiguousarray(centre + _core.unproject(view, pixels) * rng.uniform(10, 40, (n, 1)))
    xy = pixels + rng.normal(0, 0.5, (n, 2))
    bad = rng.permutation(n)[: round(share * n)]
    xy[bad] = rng.uniform(0, 1, (len(bad), 2)) * [6000, 4000]
    blank = _core.View.canonical("OPENCV", 6000, 4000, PARAMS, np.eye(3), np.zeros(3))
    return Task(xyz, np.ascontiguousarray(xy), blank, centre)


def centre_of(rvec: np.ndarray, tvec: np.ndarray) -> np.ndarray:
    return -cv2.Rodrigues(rvec)[0].T @ tvec.ravel()


def ours(t: Task) -> np.ndarray:
    return _core.resect(t.camera, t.xyz, t.xy, start="search").view.centre


def ours_robust(t: Task) -> np.ndarray:
    return _core.resect_robust(t.camera, t.xyz, t.xy, threshold=THRESHOLD).view.centre


def ours_robust_without_a_threshold(t: Task) -> np.ndarray:
    return _core.resect_robust(t.camera, t.xyz, t.xy).view.centre


def opencv_sqpnp(t: Task) -> np.ndarray:
    _, rvec, tvec = cv2.solvePnP(t.xyz, t.xy, K, PARAMS[4:], flags=cv2.SOLVEPNP_SQPNP)
    return centre_of(*cv2.solvePnPRefineLM(t.xyz, t.xy, K, PARAMS[4:], rvec, tvec))


def opencv_iterative(t: Task) -> np.ndarray:
    _, rvec, tvec = cv2.solvePnP(t.xyz, t.xy, K, PARAMS[4:], flags=cv2.SOLVEPNP_ITERATIVE)
    return centre_of(rvec, tvec)


def opencv_ransac(t: Task) -> np.ndarray:
    _, rvec, tvec, _ = cv2.solvePnPRansac(
        t.xyz, t.xy, K, PARAMS[4:], reprojectionError=THRESHOLD, iterationsCount=10_000, confidence=0.9999
    )
    return centre_of(rvec, tvec)


def opencv_usac(t: Task) -> np.ndarray:
    settings = cv2.UsacParams()
    settings.threshold, settings.maxIterations, settings.confidence = THRESHOLD, 10_000, 0.9999
    _, _, rvec, tvec, _ = cv2.solvePnPRansac(t.xyz, t.xy, K, PARAMS[4:], params=settings)
    return centre_of(rvec, tvec)


def pycolmap(t: Task) -> np.ndarray:
    import pycolmap as colmap

    # COLMAP's pixels begin at the corner, not at the centre, of the first one.
    camera = colmap.Camera(
        model="FULL_OPENCV",
        width=6000,
        height=4000,
        params=[*(PARAMS[:4] + np.array([0, 0, 0.5, 0.5])), *PARAMS[4:], 0, 0, 0],
    )
    options = colmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.confidence = THRESHOLD, 0.9999
    found = colmap.estimate_and_refine_absolute_pose(t.xy + 0.5, t.xyz, camera, options)
    if found is None:
        return np.full(3, np.nan)
    pose = found["cam_from_world"]
    return -pose.rotation.matrix().T @ pose.translation


def poselib(t: Task) -> np.ndarray:
    import poselib as library

    camera = {"model": "OPENCV", "width": 6000, "height": 4000, "params": PARAMS[:8].tolist()}
    pose, _ = library.estimate_absolute_pose(
        t.xy, t.xyz, camera, {"max_error": THRESHOLD, "success_prob": 0.9999, "max_iterations": 10_000}
    )
    return -pose.R.T @ pose.t


PLAIN: dict[str, Callable[[Task], np.ndarray]] = {
    "colourreg": ours,
    "OpenCV SQPNP + RefineLM": opencv_sqpnp,
    "OpenCV ITERATIVE": opencv_iterative,
}
ROBUST: dict[str, Callable[[Task], np.ndarray]] = {
    "colourreg": ours_robust,
    "colourreg, no threshold given": ours_robust_without_a_threshold,
    "OpenCV solvePnPRansac": opencv_ransac,
    "OpenCV USAC": opencv_usac,
    "pycolmap": pycolmap,
    "PoseLib": poselib,
}
CASES = [
    (PLAIN, 20, 0.0),
    (PLAIN, 1_000, 0.0),
    (PLAIN, 100_000, 0.0),
    (ROBUST, 20, 0.6),
    (ROBUST, 1_000, 0.3),
    (ROBUST, 1_000, 0.6),
    (ROBUST, 100_000, 0.6),
]


def measure(function: Callable[[Task], np.ndarray], tasks: list[Task]) -> tuple[float, float]:
    """Median seconds, and the median distance of the centre from its truth, metres; inf where it failed."""
    times, errors = [], []
    for t in tasks:
        runs = []
        for _ in range(5 if len(t.xyz) <= 20 else 1):
            began = time.perf_counter()
            try:
                centre = function(t)
            except (cv2.error, _core.ColourregError):
                centre = np.full(3, np.inf)
            runs.append(time.perf_counter() - began)
        times.append(np.median(runs))
        errors.append(np.linalg.norm(centre - t.centre))
    return float(np.median(times)), float(np.median(np.nan_to_num(errors, nan=np.inf)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5, help="scenes for each case")
    repeats = parser.parse_args().repeats
    missing = [name for name in ("pycolmap", "poselib") if importlib.util.find_spec(name) is None]
    if missing:
        print("not installed, left out: " + ", ".join(missing))
    for contenders, n, share in CASES:
        for place, shift in (("origin", np.zeros(3)), ("map coordinates", MAP)):
            scenes = repeats if n > 1000 else 6 * repeats
            tasks = [task(n, share, shift, seed) for seed in range(scenes)]
            what = f"{n:,} points" + (f", {100 * share:.0f} % blunders" if share else "")
            print(f"\n{what}, at {place}; median of {scenes} scenes")
            print("| contender | ms | time / colourreg | centre off by |")
            print("| --- | ---: | ---: | ---: |")
            own = None
            for name, function in contenders.items():
                if name.lower() in missing:
                    continue
                if function is opencv_ransac and n > 1000 and shift.any():
                    print(f"| {name} | half a minute each, left out | | |")
                    continue
                function(tasks[0])
                seconds, error = measure(function, tasks)
                own = own or seconds
                off = f"{error * 1000:.2f} mm" if error < 10 else f"{error:.1f} m"
                print(f"| {name} | {seconds * 1000:.3f} | {seconds / own:.2f}× | {off} |", flush=True)


if __name__ == "__main__":
    main()
