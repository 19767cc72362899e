"""Similarity transformations against SciPy's optimum, and their covariance against simulations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from colourreg_rs import DegenerateError, InvalidInputError, NotConvergedError, _core


def rotation(vector):
    if len(vector) == 1:
        c, s = np.cos(vector[0]), np.sin(vector[0])
        return np.array([[c, -s], [s, c]])
    return Rotation.from_rotvec(vector).as_matrix()


def scene(rng, d, n, noise=0.01):
    source = rng.normal(0, 5.0, (n, d))
    scale, turn, shift = rng.uniform(0.3, 3), rng.normal(0, 1.5, 1 if d == 2 else 3), rng.normal(0, 50, d)
    truth = scale, rotation(turn), shift
    target = scale * source @ truth[1].T + shift + rng.normal(0, noise, (n, d))
    return source, target, truth


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("fixed_scale", [False, True])
def test_both_ways_agree_with_scipys_optimum(d, fixed_scale, rng):
    turns = 1 if d == 2 else 3
    for _ in range(30):
        source, target, (scale, R, shift) = scene(rng, d, int(rng.integers(d + 1, 12)), noise=0.3)
        if fixed_scale:
            target = (target - shift) / scale + shift
            scale = 1.0
        weights = rng.uniform(0.1, 3, len(source))

        def residual(x, source=source, target=target, weights=weights, R=R):
            s = 1.0 if fixed_scale else x[0]
            moved = s * source @ (rotation(x[1 : 1 + turns]) @ R).T + x[1 + turns :]
            return ((target - moved) * np.sqrt(weights)[:, None]).ravel()

        best = least_squares(residual, np.r_[scale, np.zeros(turns), shift], xtol=1e-15, ftol=1e-15, gtol=1e-15)
        closed = _core.fit_similarity(source, target, weights=weights, fixed_scale=fixed_scale)
        near = rotation(rng.normal(0, 0.2, turns)) @ R
        start = (1.0 if fixed_scale else scale * 1.2, near, shift + rng.normal(0, 3, d))
        iterated = _core.fit_similarity(source, target, weights=weights, fixed_scale=fixed_scale, initial=start)
        assert closed.iterations == 0 and iterated.iterations > 1
        for fit in (closed, iterated):
            assert fit.residuals.ravel() == pytest.approx(
                residual(best.x) / np.sqrt(weights).repeat(d), abs=1e-6 * np.abs(target).max()
            )
            assert np.sum(weights[:, None] * fit.residuals**2) <= 2 * best.cost * (1 + 1e-12)
            assert fit.sigma0 == pytest.approx(np.sqrt(2 * best.cost / fit.dof))
            assert fit.apply(source) == pytest.approx(target - fit.residuals, abs=1e-12 * np.abs(target).max())
            plain = fit.scale * source @ fit.rotation.T + fit.translation
            assert fit.apply(source) == pytest.approx(plain, abs=1e-11)
        assert closed.covariance == pytest.approx(iterated.covariance, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("d", [2, 3])
def test_the_covariance_is_that_of_a_thousand_simulations(d, rng):
    source, clean, (scale, R, shift) = scene(rng, d, 9, noise=0.0)
    sigma = rng.uniform(0.01, 0.05, len(source))
    weights = 1 / sigma**2
    at_centre = scale * R @ np.average(source, axis=0, weights=weights) + shift
    deviations, sigma0 = [], []
    for _ in range(1000):
        fit = _core.fit_similarity(source, clean + rng.normal(0, 1, clean.shape) * sigma[:, None], weights=weights)
        turn = fit.rotation @ R.T
        angle = [np.arctan2(turn[1, 0], turn[0, 0])] if d == 2 else Rotation.from_matrix(turn).as_rotvec()
        deviation = np.r_[fit.scale - scale, angle, fit.centre_target - at_centre]
        expected = fit.covariance / fit.sigma0**2
        deviations.append(np.linalg.solve(np.linalg.cholesky(expected), deviation))
        sigma0.append(fit.sigma0**2)
    # White, of unit variance: the standard error of a variance from 1,000 draws is 4.5 %.
    scatter = np.cov(np.array(deviations).T)
    assert np.diag(scatter) == pytest.approx(1, abs=0.16)
    assert np.abs(scatter - np.diag(np.diag(scatter))).max() < 0.14
    assert np.mean(sigma0) == pytest.approx(1, abs=4 * np.std(sigma0) / np.sqrt(1000))


def test_utm_coordinates_lose_nothing(rng):
    source, target, _ = scene(rng, 3, 8)
    far = np.array([456_789.0, 5_812_345.0, 143.0])
    here, there = _core.fit_similarity(source, target), _core.fit_similarity(source + far, target + far[::-1])
    assert there.residuals == pytest.approx(here.residuals, abs=1e-8)
    assert there.scale == pytest.approx(here.scale, abs=1e-10)
    iterated = _core.fit_similarity(
        source + far, target + far[::-1], initial=(there.scale * 1.01, there.rotation, there.translation)
    )
    assert iterated.residuals == pytest.approx(here.residuals, abs=1e-8)


def test_what_is_not_determined_is_refused(rng):
    line = np.outer(np.arange(8.0), [1.0, 2.0, 3.0]) + np.array([4.5e5, 5.8e6, 1e2])
    with pytest.raises(DegenerateError, match=r"one line \(collinear\).*limit is 1\.000e-4"):
        _core.fit_similarity(line, line)
    with pytest.raises(DegenerateError, match="coincide"):
        _core.fit_similarity(np.zeros((5, 2)), np.zeros((5, 2)))
    with pytest.raises(DegenerateError, match="number of pairs is 1"):
        _core.fit_similarity(np.zeros((1, 2)), np.zeros((1, 2)))
    with pytest.raises(InvalidInputError, match="4 points cannot be paired with 5"):
        _core.fit_similarity(np.zeros((4, 2)), np.zeros((5, 2)))
    source, target, (scale, R, shift) = scene(rng, 3, 9)
    with pytest.raises(InvalidInputError, match="not a rotation"):
        _core.fit_similarity(source, target, initial=(1.0, 2 * np.eye(3), shift))
    # Half a turn away the gradient of the rotation vanishes; the answer is the right one or none.
    opposite = np.ascontiguousarray(R @ np.diag([1.0, -1.0, -1.0]))
    try:
        fit = _core.fit_similarity(source, target, initial=(scale, opposite, shift))
        assert np.abs(fit.rotation - R).max() < 0.02
    except NotConvergedError as error:
        assert "approximate rotation" in str(error)
    assert _core.fit_similarity(source * [1, 1, -1.0], target).mirrored
    assert not _core.fit_similarity(source, target).mirrored
