"""Registration from an approximate view without picks, against simulated truth and real data."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from colourreg_rs import Camera, InvalidInputError, PointCloud, Pose, View, _core
from colourreg_rs.experiments.sci_accuracy import STARTS, disturbed, register, simulated
from colourreg_rs.io.clouds import write_cloud
from colourreg_rs.io.images import write_image
from colourreg_rs.io.registration import read_registration, write_registration
from colourreg_rs.matching.afar import agreeing_rotations
from colourreg_rs.matching.correspondences import Correspondences
from colourreg_rs.matching.match_covariance import PATCHES_SYSTEMATIC, match_covariance, patch_covariance
from colourreg_rs.matching.parameters import design
from colourreg_rs.matching.pointwise import STRIDE, Patches, weights
from colourreg_rs.matching.register_sci import SciOptions, register_sci
from colourreg_rs.model import Registration
from colourreg_rs.register.sci import limits
from colourreg_rs.simulate import simulate


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["facade", "room"])
def test_photos_are_registered_to_a_fraction_of_a_pixel(scene):
    """One of each kind from both starts; the table over many is that of ``experiments.sci_accuracy``."""
    case = simulated(scene, 0, (1200, 800))
    for degrees, metres in STARTS:
        outcome, result = register(case, degrees, metres)
        assert outcome.trusted, outcome.reasons
        assert outcome.error < 0.5 < 0.1 * outcome.start
        assert result.used > 100 and result.confirmed >= 0.4 > 10 * result.by_chance
        assert outcome.error < 3 * outcome.predicted and outcome.predicted < 1.0


@pytest.mark.slow
def test_somebody_elses_photo_is_no_registration(rng):
    case = simulated("facade", 0, (1200, 800))
    other = np.ascontiguousarray(case.image[::-1, ::-1])
    start = disturbed(case.truth, rng, 0.5, 0.02)
    wrong = register_sci(case.scan, other, start, SciOptions(station=case.station))
    assert not wrong.trusted and wrong.reasons and wrong.view is start


def test_the_rotation_that_most_matches_agree_on_comes_first(rng):
    camera = Camera("PINHOLE", 1200, 800, {"fx": 1000.0, "fy": 1000.0, "cx": 599.5, "cy": 399.5})
    start = View("v", None, camera, Pose(np.eye(3), np.zeros(3)))
    turn = cv2.Rodrigues(np.radians([0.0, 3.0, 1.0]))[0]
    n = 120
    pixels = rng.uniform([100, 100], [1100, 700], (n, 2))
    xyz = _core.unproject(start.core, pixels) * rng.uniform(5, 20, (n, 1))
    # Two fifths follow the rotation, the rest none.
    xy, _ = _core.project(replace(start, pose=Pose(turn, np.zeros(3))).core, xyz)
    xy[48:] = pixels[48:] + rng.uniform(-80, 80, (n - 48, 2))
    found = Correspondences(
        xyz, xy, np.tile(np.eye(2), (n, 1, 1)), np.arange(n), np.ones(n), np.ones(n), n, {}, 4.0,
    )  # fmt: skip
    views = agreeing_rotations(start, found, np.radians(6.0), 2)
    away = [np.degrees(np.linalg.norm(cv2.Rodrigues(view.pose.rotation @ turn.T)[0])) for view in views]
    assert len(views) == 2 and away[0] < 0.5 < away[1], away
    assert all(np.array_equal(view.pose.centre, start.pose.centre) for view in views)


def test_unusable_input_is_refused():
    camera = Camera("PINHOLE", 100, 80, {"fx": 90.0, "fy": 90.0, "cx": 49.5, "cy": 39.5})
    view = View("v", None, camera, Pose(np.eye(3), np.zeros(3)))
    cloud = PointCloud(np.random.default_rng(0).normal(size=(100, 3)), intensity=np.ones(100))
    with pytest.raises(InvalidInputError, match="not that of the camera"):
        register_sci(cloud, np.zeros((10, 10)), view)
    dlt = View("d", None, dlt=view.core.matrix(), size=(100, 80))
    with pytest.raises(InvalidInputError, match="starts from a camera and a pose"):
        register_sci(cloud, np.zeros((80, 100)), dlt)
    behind = PointCloud(cloud.xyz - [0, 0, 50], intensity=np.ones(100))
    lost = register_sci(behind, np.zeros((80, 100)), view)
    assert not lost.trusted and "no point of the cloud" in lost.reasons[0] and lost.view is view


@pytest.mark.slow
def test_the_covariance_meets_the_scatter_of_correlated_matches(rng):
    """Match errors as a smooth random field over the photo: the stated covariance holds the scatter, where one that
    takes the matches as independent is far too small."""
    camera = Camera("PINHOLE", 1500, 1000, {"fx": 1300.0, "fy": 1300.0, "cx": 749.5, "cy": 499.5})
    view = View("v", None, camera, Pose(np.eye(3), np.zeros(3)))
    n, sigma, length = 600, 0.4, 0.05 * 1500
    names = ("rx", "ry", "rz", "cx_world", "cy_world", "cz_world")
    inside, independent = [], []
    for _ in range(60):
        xy = rng.uniform([5, 5], [1495, 995], (n, 2))
        depth = rng.uniform(8, 25, n)
        xyz = np.column_stack([(xy - [749.5, 499.5]) / 1300 * depth[:, None], depth])
        square = ((xy[:, None] - xy[None]) ** 2).sum(2)
        root = np.linalg.cholesky(np.exp(-0.5 * square / length**2) + 0.05 * np.eye(n))
        noisy = xy + sigma * root @ rng.normal(size=(n, 2))
        stated = np.broadcast_to(np.eye(2) * sigma**2, (n, 2, 2)).copy()
        fit = _core.resect(view.core, xyz, noisy, sigma_xy=stated, start="given")
        found = View("f", None, camera, Pose(fit.view.rotation, fit.view.translation))
        turn = cv2.Rodrigues(found.pose.rotation.T)[0].ravel()
        error = np.concatenate([turn, -found.pose.centre])
        covariance = match_covariance(found, names, xyz, noisy, stated, 1.0)
        inside.append(error @ np.linalg.solve(covariance.matrix, error) < 12.59)
        rows = design(found, names, xyz).reshape(-1, 6)
        independent.append(error @ (rows.T @ rows / sigma**2) @ error < 12.59)
    assert np.mean(inside) > 0.8
    assert np.mean(independent) < 0.3


def test_the_covariance_meets_the_scatter_of_patches_along_scan_lines(rng):
    """Upright edges that are off from end to end, level ones likewise: stated without the factors that stand for other
    errors, the covariance holds the scatter, where one that takes patches as independent is far too small."""
    camera = Camera("PINHOLE", 1200, 800, {"fx": 1300.0, "fy": 1300.0, "cx": 599.5, "cy": 399.5})
    view = View("v", None, camera, Pose(np.eye(3), np.zeros(3)))
    names = ("rx", "ry", "rz", "cx_world", "cy_world", "cz_world")
    columns, rows = np.meshgrid(np.arange(15.0, 1200, 30), np.arange(15.0, 800, 30))
    places = np.column_stack([columns.ravel(), rows.ravel()])
    depth = rng.uniform(5, 20, len(places))
    xyz = np.column_stack([(places - [599.5, 399.5]) / 1300 * depth[:, None], depth])
    slopes = design(view, names, xyz)
    information = np.einsum("nki,nkj->nij", slopes, slopes)
    total, sigma = information.sum(0), 0.5
    stated, independent = [], []
    for _ in range(200):
        off = np.column_stack([rng.normal(0, sigma, 40)[(columns.ravel() // 30).astype(int)],
                               rng.normal(0, sigma, 27)[(rows.ravel() // 30).astype(int)]])  # fmt: skip
        gradient = np.einsum("nki,nk->ni", slopes, off)
        error = np.linalg.solve(total, gradient.sum(0))
        left = gradient - information @ error
        patches = Patches(names, places, left, information, *np.ones((3, len(places))))
        covariance = patch_covariance(view, patches, xyz, 0.0).matrix / (PATCHES_SYSTEMATIC * STRIDE**2)
        stated.append(error @ np.linalg.solve(covariance, error))
        independent.append(error @ (total / sigma**2) @ error)
    assert 4.0 < np.mean(stated) < 12.0, np.mean(stated)
    assert np.mean(independent) > 60.0


def test_no_patch_outvotes_the_others():
    mean = np.eye(6)[None] * np.ones((50, 1, 1))
    assert np.allclose(weights(mean), 0.5)
    one = np.concatenate([mean, 1e4 * np.eye(6)[None]])
    assert (one[:, 0, 0] * weights(one)).max() < one[:, 0, 0].mean()
    assert np.isfinite(weights(np.zeros((3, 6, 6)))).all()


def test_a_coarse_scan_is_named_as_what_limits_a_registration():
    assert limits(0.3, 3.6) == ()
    (line,) = limits(0.62, 6.8)
    assert "0.6 px" in line and "6.8 px apart" in line


@pytest.mark.slow
def test_the_command_writes_what_it_found(tmp_path):
    simulation = simulate("room", seed=0, photos=1, size=(900, 600), samples=4)
    photo = simulation.photos[0]
    write_cloud(tmp_path / "scan.laz", simulation.scan)
    write_image(tmp_path / "photo.png", photo.image)
    start = View("photo", tmp_path / "photo.png", photo.view.camera, photo.view.pose)
    write_registration(tmp_path / "start.json", Registration((start,), tmp_path / "scan.laz"))
    command = ["register", "scan.laz", "photo.png", "--method", "sci", "--init", "start.json", "--out", "found.json"]
    done = subprocess.run(
        [sys.executable, "-m", "colourreg_rs.cli", *command], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "matches_used" in done.stdout
    found = read_registration(tmp_path / "found.json").views[0]
    assert found.method == "sci" and found.covariance is not None
    assert np.linalg.norm(found.pose.centre - photo.view.pose.centre) < 0.02
