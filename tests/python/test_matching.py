"""Template matching and the information distance through the boundary, against OpenCV, SciPy and shifted pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import ndimage
from scipy.optimize import approx_fprime

from colourreg_rs import Camera, DegenerateError, InvalidInputError, Pose, View, _core


def texture(rng: np.random.Generator, height: int = 220, width: int = 260) -> np.ndarray:
    image = sum(ndimage.gaussian_filter(rng.normal(size=(height, width)), s) * s for s in (2.0, 4.0, 8.0))
    return (100 + 40 * image / image.std()).astype(np.float32)


def shifted(image: np.ndarray, dx: float, dy: float) -> np.ndarray:
    return ndimage.shift(image, (dy, dx), order=5, mode="nearest").astype(np.float32)


POINTS = np.array([[x, y] for y in range(60, 170, 25) for x in range(60, 210, 25)], dtype=np.int64)


def test_grey_correlation_is_that_of_opencv(rng):
    image = texture(rng)
    other = shifted(image, 1.0, -2.0) + rng.normal(size=image.shape).astype(np.float32)
    a, b = _core.Features.grey(image, sigma=0.0), _core.Features.grey(other, sigma=0.0)
    found = _core.match_templates(a, b, POINTS, half=15, radius=6)
    # The taper is ours alone: OpenCV's peak is the same pixel, and the score is near its own.
    for k, (x, y) in enumerate(POINTS):
        template = image[y - 15 : y + 16, x - 15 : x + 16]
        window = other[y - 21 : y + 22, x - 21 : x + 22]
        scores = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
        row, column = np.unravel_index(scores.argmax(), scores.shape)
        assert np.abs(found["shift"][k] - [column - 6, row - 6]).max() < 0.6
        assert found["score"][k] == pytest.approx(scores.max(), abs=0.02)


@pytest.mark.parametrize("kind", ["channels", "grey", "mutual_information"])
def test_a_known_shift_is_found_to_a_fraction_of_a_pixel(kind, rng):
    image = texture(rng)
    moved = shifted(image, 2.3, -1.6)
    if kind != "grey":
        moved = 255 - moved + 0.002 * (moved - 100) ** 2  # another sensor
    make = getattr(_core.Features, kind)
    found = _core.match_templates(make(image), make(moved.astype(np.float32)), POINTS, half=20, radius=8)
    assert (found["outcome"] == _core.MATCH_OUTCOMES.index("matched")).mean() > 0.9
    ok = found["outcome"] == 0
    error = found["shift"][ok] - [2.3, -1.6]
    limit = 0.25 if kind == "mutual_information" else 0.08
    assert np.abs(error).max() < limit
    assert np.abs(error.mean(0)).max() < limit / 3


def test_every_template_is_accounted_for(rng):
    image = texture(rng)
    known = np.ones(image.shape, bool)
    known[:, 150:] = False
    a = _core.Features.channels(image, known)
    b = _core.Features.channels(texture(rng))
    points = np.array([[-5, 60], [10_000, 60], [70, 80], [180, 80]], dtype=np.int64)
    found = _core.match_templates(a, b, points, half=20, radius=8)
    names = [_core.MATCH_OUTCOMES[o] for o in found["outcome"]]
    assert names[0] == names[1] == names[3] == "unknown"
    assert names[2] != "matched"  # unrelated pictures
    several = _core.match_templates(a, b, points[2:3], half=20, radius=25, hypotheses=3)
    assert (several["template"] == 0).all() and len(several["score"]) == 3
    assert (np.diff(several["score"]) <= 0).all()


def test_pictures_that_do_not_fit_are_refused(rng):
    image = texture(rng)
    a = _core.Features.channels(image)
    with pytest.raises(InvalidInputError, match="brought to the size"):
        _core.match_templates(a, _core.Features.channels(image[:100].copy()), POINTS)
    with pytest.raises(InvalidInputError, match="different measures"):
        _core.match_templates(a, _core.Features.grey(image), POINTS)
    with pytest.raises(InvalidInputError, match="half size"):
        _core.match_templates(a, a, POINTS, half=1)
    with pytest.raises(DegenerateError, match="no edges"):
        _core.Features.channels(np.full((50, 50), 7.0, np.float32))
    with pytest.raises(InvalidInputError, match="tuning"):
        _core.Features.channels(image, tuning="sharp")


def test_resizing_agrees_with_an_area_mean_of_a_smooth_picture(rng):
    image = ndimage.gaussian_filter(texture(rng, 240, 320), 4).astype(np.float32)
    small = _core.resize(image, 80, 60)
    mean = cv2.resize(image, (80, 60), interpolation=cv2.INTER_AREA)
    assert np.abs(small - mean)[3:-3, 3:-3].max() < 2.0
    assert np.abs((small - mean)[3:-3, 3:-3].mean()) < 0.05


def test_interest_points_are_corners_spread_over_the_picture(rng):
    image = texture(rng)
    points, strength = _core.interest_points(image, cell=40, per_cell=1, border=10, floor=0.1)
    assert len(points) > 20 and (strength > 0).all()
    assert (points >= 10).all() and (points < [250, 210]).all()
    eigen = cv2.cornerMinEigenVal(image, 9)
    chosen = eigen[points[:, 1], points[:, 0]]
    assert np.median(chosen) > np.quantile(eigen, 0.8)


def test_the_information_distance_is_least_at_the_truth_and_its_gradient_holds(rng):
    camera = Camera("OPENCV", 260, 220, {"fx": 240.0, "fy": 240.0, "cx": 130.0, "cy": 108.0, "k1": -0.1})
    image = texture(rng)
    view = View("v", None, camera, Pose(np.eye(3), np.zeros(3)))
    xy = rng.uniform([10, 10], [250, 210], (8000, 2))
    rays = _core.unproject(view.core, xy)
    xyz = np.ascontiguousarray(rays * rng.uniform(4, 9, (8000, 1)))
    value = 300 - ndimage.map_coordinates(image, xy[:, ::-1].T, order=3)
    ranks = _core.rank(value.astype(np.float32))
    assert np.abs(ranks - value.argsort().argsort() / 7999).max() < 1e-3  # float32 makes a few values equal
    photo = _core.InformationPhoto(image, bins=16)

    def at(x: np.ndarray) -> _core.View:
        rotation = cv2.Rodrigues(np.asarray(x[:3], float))[0]
        return View("v", None, camera, Pose.from_centre(rotation, x[3:])).core

    truth, _, n = _core.information_distance(at(np.zeros(6)), xyz, ranks, photo)
    assert n == 8000
    for k in range(6):
        x = np.zeros(6)
        x[k] = 0.01 if k < 3 else 0.1
        assert _core.information_distance(at(x), xyz, ranks, photo)[0] > truth + 0.003
    x = np.array([0.004, -0.003, 0.006, 0.02, -0.01, 0.03])
    _, gradient, _ = _core.information_distance(at(x), xyz, ranks, photo)
    # The gradient is by a rotation applied on the left of the current one.
    base = cv2.Rodrigues(x[:3])[0]

    def value_at(d: np.ndarray) -> float:
        rotation = cv2.Rodrigues(np.asarray(d[:3], float))[0] @ base
        moved = View("v", None, camera, Pose.from_centre(rotation, x[3:] + d[3:])).core
        return _core.information_distance(moved, xyz, ranks, photo)[0]

    numeric = approx_fprime(np.zeros(6), value_at, 1e-6)
    assert np.abs(gradient - numeric).max() < 2e-3 * (1 + np.abs(numeric).max())
