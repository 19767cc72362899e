"""Evaluation without control points, on simulated scans whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from colourreg_rs import Covariance, PointCloud, Pose, View
from colourreg_rs.accuracy.agreement import agreements, cloud_against_photo, photo_against_photo
from colourreg_rs.matching.correspondences import PhotoPyramid
from colourreg_rs.simulate import Disturbance, simulate


@cache
def scene():
    simulation = simulate("demo", seed=3, disturbance=Disturbance(), size=(900, 600), samples=4, points=400_000)
    views = [View(p.name, None, p.view.camera, p.view.pose) for p in simulation.photos[:2]]
    return simulation.scan, views, [p.image for p in simulation.photos[:2]]


def turned(view: View, vector) -> View:
    rotation = cv2.Rodrigues(np.array(vector, dtype=float))[0]
    return replace(view, pose=Pose.from_centre(rotation @ view.pose.rotation, view.pose.centre))


def test_the_right_view_is_not_systematic():
    scan, views, photos = scene()
    for comparisons in agreements(scan, views, photos):
        assert len(comparisons) == 2
        for found in comparisons:
            assert found.tells and not found.systematic, found.sentence()
            assert found.used > 100 and len(found.patches) > 20
            assert "no systematic field" in found.sentence()
            # Patches by themselves: at a level of 0.001 each.
            assert sum(p.significant for p in found.patches) <= 2


@pytest.mark.parametrize("pixels", [3.0, 10.0])
def test_a_shifted_view_is_called_systematic_with_the_right_amount(pixels):
    scan, views, photos = scene()
    view = views[0]
    f = view.camera.params["fx"]
    camera = view.camera.with_params(cx=view.camera.params["cx"] + pixels, cy=view.camera.params["cy"] - 2.0)
    found = cloud_against_photo(scan, PhotoPyramid.of(photos[0]), replace(view, camera=camera))
    assert found.systematic and found.p_value < 1e-6
    # The photo lies to the left of, and below, what the view promises.
    assert found.field[0] == pytest.approx(-pixels, abs=4 * found.sigmas[0])
    assert found.field[1] == pytest.approx(2.0, abs=4 * found.sigmas[1])
    assert found.size == pytest.approx(np.hypot(pixels, 2.0), abs=0.5)
    said = found.as_dict()
    assert said["size_mrad"] == pytest.approx(1000 * np.hypot(pixels, 2.0) / f, rel=0.15)
    assert said["size_mm"] == pytest.approx(said["size_mrad"] * found.depth, rel=1e-6)
    assert "systematic field" in found.sentence() and "mm" in found.sentence()


def test_rotation_and_scale_are_told_from_a_shift():
    scan, views, photos = scene()
    view, pyramid = views[0], PhotoPyramid.of(photos[0])
    rolled = cloud_against_photo(scan, pyramid, turned(view, [0.0, 0.0, 0.008]))
    # The view is rolled by +0.008 about the axis, x towards y: the photo is rolled back against it.
    assert rolled.systematic and rolled.field[2] == pytest.approx(-0.008, abs=4 * rolled.sigmas[2] + 2e-4)
    params = {n: v * 1.01 for n, v in view.camera.params.items() if n in ("fx", "fy")}
    zoomed = cloud_against_photo(scan, pyramid, replace(view, camera=view.camera.with_params(**params)))
    assert zoomed.systematic and zoomed.field[3] == pytest.approx(-0.01, abs=4 * zoomed.sigmas[3] + 5e-4)


def test_two_photos_are_compared_on_what_both_see():
    scan, views, photos = scene()
    # The other photo is taken as registered wrongly by 3 px: its colours lie beside their points.
    f = views[1].camera.params["fx"]
    wrong = turned(views[1], [0.0, 3.0 / f, 0.0])
    found = photo_against_photo(scan, PhotoPyramid.of(photos[0]), views[0], photos[1], wrong)
    assert found.systematic and 2.0 < found.size < 5.0


def test_what_the_covariance_lets_expect_is_systematic_but_explained():
    scan, views, photos = scene()
    names = ("rx", "ry", "rz", "cx_world", "cy_world", "cz_world")
    off = turned(views[0], [0.0, 0.004, 0.0])
    for sigma, explained in ((0.004, True), (0.0002, False)):
        matrix = np.diag([sigma**2] * 3 + [1e-8] * 3)
        found = cloud_against_photo(
            scan, PhotoPyramid.of(photos[0]), replace(off, covariance=Covariance(names, matrix))
        )
        assert found.systematic and found.explained is explained


def test_where_nothing_can_be_compared_nothing_is_claimed(rng):
    scan, views, photos = scene()
    noise = rng.integers(0, 255, photos[0].shape).astype(np.uint8)
    found = cloud_against_photo(scan, PhotoPyramid.of(noise), views[0])
    assert not found.tells and not found.systematic and found.reason
    bare = PointCloud(scan.xyz)
    (first, second), _ = agreements(bare, views, photos)
    assert not first.tells and "intensity" in first.reason and second.tells


def test_a_photo_does_not_confirm_itself():
    scan, views, photos = scene()
    twice = [replace(views[0], image=Path("same.jpg")), replace(views[0], name="again", image=Path("same.jpg"))]
    found = agreements(scan, twice, [photos[0]] * 2)
    assert [[c.title for c in comparisons] for comparisons in found] == [["cloud against photo"]] * 2
