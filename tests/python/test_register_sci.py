"""Registration from an approximate view without picks, against simulated truth and real data."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from colourreg_rs import Camera, InvalidInputError, PointCloud, Pose, View, _core
from colourreg_rs.match_covariance import design, match_covariance
from colourreg_rs.register_sci import SciOptions, register_sci
from colourreg_rs.sci import render_sci, with_size


def disturbed(view: View, rng: np.random.Generator, degrees: float, metres: float) -> View:
    """The view turned about a random axis and moved in a random direction, by so much."""
    turn, shift = rng.normal(size=3), rng.normal(size=3)
    rotation = cv2.Rodrigues(turn / np.linalg.norm(turn) * np.radians(degrees))[0] @ view.pose.rotation
    u, _, v = np.linalg.svd(rotation)
    return replace(view, pose=Pose.from_centre(u @ v, view.pose.centre + shift / np.linalg.norm(shift) * metres))


def pixel_errors(found: View, truth: View, cloud: PointCloud) -> np.ndarray:
    """Distances in the photo over the points that it sees, px."""
    sci = render_sci(cloud, with_size(truth, 480, round(480 * truth.camera.height / truth.camera.width)))
    xyz = np.ascontiguousarray(cloud.xyz[sci.index[sci.measured]])
    return np.linalg.norm(_core.project(found.core, xyz)[0] - _core.project(truth.core, xyz)[0], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("degrees, metres", [(0.5, 0.02), (3.0, 0.2)])
def test_a_facade_is_registered_to_a_fraction_of_a_pixel(degrees, metres, rng):
    from colourreg_rs.simulate import simulate

    simulation = simulate("facade", seed=0, photos=1, size=(1500, 1000), samples=4)
    photo = simulation.photos[0]
    start = disturbed(photo.view, rng, degrees, metres)
    result = register_sci(simulation.scan, photo.image, start, SciOptions(station=simulation.stations[0]))
    assert result.trusted, result.reasons
    errors = pixel_errors(result.view, photo.view, simulation.scan)
    assert np.sqrt((errors**2).mean()) < 0.5
    assert result.used > 200 and result.confirmed > 0.25 > 10 * result.by_chance
    assert 0.02 < result.predicted_error < 0.5
    # Somebody else's photo is no registration.
    other = np.ascontiguousarray(photo.image[::-1, ::-1])
    wrong = register_sci(simulation.scan, other, start, SciOptions(station=simulation.stations[0]))
    assert not wrong.trusted and wrong.reasons and wrong.view is start


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
