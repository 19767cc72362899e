"""A view's parameters by name: steps along them, and the derivatives of pixels by them, go together."""

from __future__ import annotations

import numpy as np
import pytest

from colourreg_rs import Camera, Pose, View, _core
from colourreg_rs.matching.parameters import design, stepped, value_of

NAMES = ("rx", "ry", "rz", "cx_world", "cy_world", "cz_world", "f", "cx", "cy", "k1", "p2")


@pytest.fixture
def view():
    params = {"fx": 900.0, "fy": 880.0, "cx": 510.0, "cy": 380.0, "k1": -0.1, "k2": 0.02, "p1": 1e-4, "p2": -2e-4}
    camera = Camera("OPENCV", 1000, 750, {**params, "k3": 0.0})
    return View("v", None, camera, Pose.from_centre(np.eye(3), np.array([0.3, -0.2, 0.1])))


def test_steps_move_pixels_as_the_design_says(view, rng):
    xyz = rng.uniform([-2, -1.5, 5], [2, 1.5, 9], (50, 3))
    here, _ = _core.project(view.core, xyz)
    slopes = design(view, NAMES, xyz)
    sizes = np.array([1e-5] * 3 + [1e-4] * 3 + [0.05, 0.05, 0.05, 1e-5, 1e-5])
    for _ in range(5):
        step = sizes * rng.normal(size=len(NAMES))
        there, _ = _core.project(stepped(view, NAMES, step).core, xyz)
        np.testing.assert_allclose(there - here, slopes @ step, atol=1e-3 * np.abs(slopes @ step).max())


def test_a_large_turn_is_a_rotation_and_comes_back(view):
    turn = np.array([0.4, -0.9, 1.3])
    turned = stepped(view, NAMES[:3], turn)
    np.testing.assert_allclose(turned.pose.rotation @ turned.pose.rotation.T, np.eye(3), atol=1e-12)
    back = stepped(turned, NAMES[:3], -turn)
    np.testing.assert_allclose(back.pose.rotation, view.pose.rotation, atol=1e-12)


def test_values_are_those_that_a_step_changes(view):
    changed = stepped(view, NAMES, np.full(len(NAMES), 0.01))
    for name in NAMES[3:]:
        assert value_of(changed, name) - value_of(view, name) == pytest.approx(0.01)
    assert changed.camera.params["fy"] / changed.camera.params["fx"] == pytest.approx(880 / 900)
