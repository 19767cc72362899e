"""What an assessment says of views whose errors were put in: units, the corners, next points, advice."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from adjustment_cases import CAMERA, POSE, case

from colourreg_rs import ControlPoint, Covariance, View, _core
from colourreg_rs.accuracy.advice import advice, headline
from colourreg_rs.accuracy.assessment import assess_view, error_map
from colourreg_rs.accuracy.view_adjustment import PointSigmas, adjust_control


def registered(points: list[ControlPoint], *, sigma_xy=None, sigma_xyz=None, start=None) -> View:
    """A view as a registration holds it, adjusted from its true values."""
    start = start or View("photo", None, CAMERA, POSE)
    sigmas = PointSigmas.of(points, sigma_xy, sigma_xyz)
    result = adjust_control(start.core, points, ["used"] * len(points), sigmas, ["pose"])
    pose = type(POSE)(result.core.rotation, result.core.translation)
    return replace(
        start, pose=pose, covariance=Covariance(result.parameters, result.covariance),
        points=result.points, statistics=result.statistics,
    )  # fmt: skip


def control(xyz, xy, **more) -> list[ControlPoint]:
    return [ControlPoint(f"T{i}", a, b, **more) for i, (a, b) in enumerate(zip(xyz, xy, strict=True))]


def test_pixels_millimetres_and_milliradians_are_one_figure(rng):
    problem = case(20, rng, sigma_xyz=0.0)
    assessed = assess_view(registered(control(*problem.noisy(rng)), sigma_xy=0.5))
    # By hand: at the median depth, a pixel is depth / f metres, and 1 / f radians in the middle of the photo.
    depth = float(np.median(_core.project(problem.view.core, problem.xyz)[1]))
    assert assessed.depth == pytest.approx(depth, rel=1e-3)
    assert assessed.millimetres(2.0) == pytest.approx(1000 * 2.0 * depth / 3000, rel=1e-2)
    assert assessed.milliradians(2.0) == pytest.approx(1000 * 2.0 / 3000, rel=1e-2)
    figures = assessed.error_map.figures()
    assert figures["mm"]["median"] == pytest.approx(assessed.millimetres(figures["px"]["median"]), rel=0.1)
    json.dumps(assessed.as_dict(), allow_nan=False)


def test_points_in_the_middle_only_leave_the_corners_and_the_advice_says_so(rng):
    problem = case(14, rng, sigma_xyz=0.0)
    middle = (problem.xy - [2000, 1500]) * 0.2 + [2000, 1500]
    rays = _core.unproject(problem.view.core, np.ascontiguousarray(middle))
    xyz = np.ascontiguousarray(POSE.centre + rays * np.linalg.norm(problem.xyz - POSE.centre, axis=1)[:, None])
    xy = _core.project(problem.view.core, xyz)[0] + rng.normal(0, 0.5, (14, 2))
    view = registered(control(xyz, xy), sigma_xy=0.5)
    assessed = assess_view(view)
    pixels = assessed.error_map.pixels
    assert min(pixels[0, 0], pixels[-1, -1]) > 3 * pixels[9, 12]
    said = " ".join(advice(assessed))
    assert "corners are worse" in said and "next control point would help most" in said
    # The promise is kept: with a point measured there, as well as the others, the expected error is the stated one.
    first = assessed.next_points[0]
    place = _core.backproject(view.core, np.array([first.xy]), np.array([first.depth]))
    more = control(np.vstack([xyz, place]), np.vstack([xy, _core.project(view.core, place)[0]]))
    again = assess_view(registered(more, sigma_xy=0.5))
    scale = view.statistics["adjustment"]["scale"] / again.view.statistics["adjustment"]["scale"]
    assert again.next_points[0].mean_px[0] * np.sqrt(scale) == pytest.approx(first.mean_px[1], rel=0.05)
    assert first.mean_px[1] < 0.8 * first.mean_px[0]


def test_a_careful_view_is_called_right_and_larger_residuals_are_not(rng):
    problem = case(24, rng)
    good = assess_view(registered(control(*problem.noisy(rng)), sigma_xy=0.5, sigma_xyz=0.003))
    assert headline(good)[0] == "good" and "mrad" in headline(good)[1]
    xyz, xy = problem.noisy(rng)
    coarse = control(xyz, xy + rng.normal(0, 4.0, xy.shape))
    worse = assess_view(registered(coarse, sigma_xy=0.5, sigma_xyz=0.003))
    assert headline(worse)[0] == "look"
    assert any("times what the stated sigmas promise" in line for line in advice(worse))


def test_check_points_off_by_more_than_the_covariance_allows_are_bad(rng):
    problem, others = case(24, rng), case(8, rng)
    view = registered(control(*problem.noisy(rng)), sigma_xy=0.5, sigma_xyz=0.003)
    xyz, xy = others.noisy(rng)
    checks = [ControlPoint(f"C{i}", xyz[i], xy[i]) for i in range(8)]
    fine = assess_view(view, checks)
    assert fine.check["joint_p_value"] > 0.001 and headline(fine)[0] == "good"
    off = [ControlPoint(p.name, p.xyz, p.xy + 4.0) for p in checks]
    wrong = assess_view(view, off)
    assert wrong.check["joint_p_value"] < 1e-6 and headline(wrong)[0] == "bad"
    assert any("contradict the covariance" in line for line in advice(wrong))


def test_control_points_under_other_names_are_no_check(rng):
    problem = case(24, rng)
    points = control(*problem.noisy(rng))
    view = registered(points, sigma_xy=0.5, sigma_xyz=0.003)
    renamed = [ControlPoint(f"n{p.name}", np.round(p.xyz, 4), np.round(p.xy, 4), "check") for p in points]
    assessed = assess_view(view, renamed)
    assert assessed.check is None and assessed.evaluation.check is None
    (remark,) = assessed.evaluation.remarks()
    assert "24 of the points given are the registration's own" in remark


def test_without_a_covariance_nothing_is_promised(rng):
    problem = case(10, rng)
    view = View("photo", None, CAMERA, POSE, points=control(*problem.noisy(rng)))
    assessed = assess_view(view)
    assert assessed.error_map is None and assessed.next_points == () and len(assessed.notes) == 2
    assert headline(assessed)[0] == "look" and error_map(view, 10.0) is None
