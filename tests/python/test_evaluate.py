"""RMS figures against numbers worked out by hand, and metres at the object against a shift that was put in."""

from __future__ import annotations

import numpy as np
import pytest

from colourreg_rs import Camera, ControlPoint, InvalidInputError, Pose, Registration, View, _core
from colourreg_rs.evaluate import Accuracy, PointError, evaluate, evaluate_view, point_errors, table

CAMERA = Camera("PINHOLE", 4000, 3000, {"fx": 3000.0, "fy": 3000.0, "cx": 1999.5, "cy": 1499.5})


def view_with(points, model=CAMERA) -> View:
    return View("photo", None, model, Pose.looking_at([0, 0, 2], [0, 20, 4]), points=points)


def shifted_points(rng, metres: float, model=CAMERA) -> tuple[list[ControlPoint], np.ndarray]:
    """Points whose photo coordinates belong to places moved by a known vector at constant depth."""
    view = view_with((), model)
    xyz = np.stack([rng.uniform(-8, 8, 30), rng.uniform(18, 24, 30), rng.uniform(0, 9, 30)], 1)
    right_and_down = rng.normal(size=(30, 2))
    right_and_down *= metres / np.linalg.norm(right_and_down, axis=1)[:, None]
    moved = xyz + right_and_down @ view.pose.rotation[:2]
    xy, _ = _core.project(view.core, moved)
    return [ControlPoint(f"P{i}", xyz[i], xy[i]) for i in range(30)], moved - xyz


def test_the_two_rms_figures_are_those_of_the_papers_table():
    def error(x, y):
        return PointError("p", "control", "used", np.array([x, y]), np.zeros(3), 1.0)

    a = Accuracy.of([error(16.5, 2.5), error(-16.5, -2.5)])
    assert a.rms_x == pytest.approx(16.5) and a.rms_y == pytest.approx(2.5)
    assert a.rms == pytest.approx(11.8, abs=0.01)  # what the table calls the total
    assert a.rmse == pytest.approx(np.hypot(16.5, 2.5))


def test_metres_at_the_object_are_the_shift_that_was_put_in(rng):
    points, shift = shifted_points(rng, 0.05)
    view = view_with(points)
    for error, expected in zip(point_errors(view, points), shift, strict=True):
        assert error.offset_xyz == pytest.approx(expected, abs=1e-9)
    result = evaluate_view(view)
    assert result.control.object_rmse == pytest.approx(0.05, abs=1e-9)
    assert result.control.object_rms == pytest.approx(0.05 / np.sqrt(3), abs=1e-9)
    assert result.check is None
    assert "no check points" in table([result])


def test_metres_at_the_object_for_a_panorama(rng):
    panorama = Camera("EQUIRECTANGULAR", 8000, 4000)
    points, shift = shifted_points(rng, 0.01, panorama)
    errors = point_errors(view_with(points, panorama), points)
    # At equal range instead of equal depth the offset differs by second order only.
    assert np.abs(np.stack([e.offset_xyz for e in errors]) - shift).max() < 0.006
    assert np.linalg.norm(np.stack([e.offset_xyz for e in errors]), axis=1).max() < 0.0101


def test_points_that_took_no_part_are_check_points_whatever_their_file_says(rng):
    points, _ = shifted_points(rng, 0.02)
    view = view_with(points[:10])
    result = evaluate_view(view, points)
    assert result.control.n == 10 and result.check.n == 20
    assert result.known == tuple(p.name for p in points[:10])
    # Another name, and a program's rounding, make no new measurement of a pick.
    others = [ControlPoint(f"n{p.name}", np.round(p.xyz, 4), np.round(p.xy, 4), "check") for p in points[:10]]
    result = evaluate_view(view, others)
    assert result.check is None and len(result.known) == 10
    assert "points that they are there: nP0, nP1" in table([result])
    renamed = ControlPoint(points[0].name, points[0].xyz, points[0].xy + 1.0)
    assert evaluate_view(view, [renamed]).check.n == 1


def test_what_cannot_be_seen_or_was_rejected_is_named_and_not_in_the_figures(rng):
    points, _ = shifted_points(rng, 0.0)
    behind = ControlPoint("behind", [0.0, -20.0, 2.0], [100.0, 100.0])
    blunder = ControlPoint("blunder", points[0].xyz, points[0].xy + 300, status="rejected")
    result = evaluate_view(view_with([*points, behind, blunder]))
    assert result.unseen == ("behind",) and result.rejected == ("blunder",)
    assert result.control.n == 30 and result.control.rmse < 1e-9
    assert result.as_dict()["points"][-2]["residual_xy"] is None


def test_nothing_to_evaluate_is_an_error():
    with pytest.raises(InvalidInputError, match="no points to evaluate"):
        evaluate(Registration((view_with(()),)))
