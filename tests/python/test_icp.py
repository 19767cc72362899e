"""ICP of the plane on scenes as they happen: basins, outliers, statistics, and failures that have to be seen."""

from __future__ import annotations

import numpy as np
import pytest

from colourreg_rs import DegenerateError, InvalidInputError, _core


def similarity(scale, angle, tx, ty):
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    return np.array([[c, -s, tx], [s, c, ty], [0, 0, 1.0]])


def apply(h, points):
    q = np.column_stack([points, np.ones(len(points))]) @ h.T
    return q[:, :2] / q[:, 2:]


def error(h, truth, points):
    """Root mean square distance of where two transformations take points."""
    return np.sqrt(((apply(h, points) - apply(truth, points)) ** 2).sum(1).mean())


def facade(rng):
    """Segments: the outlines of windows at uneven places, eaves, a base and a corner."""
    xs, ys = np.cumsum(rng.uniform(90, 160, 9)), np.cumsum(rng.uniform(90, 170, 6))
    segments = []
    for x in xs:
        for y in ys:
            w, h = rng.uniform(35, 60), rng.uniform(50, 75)
            corners = np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]])
            segments += [(corners[i], corners[(i + 1) % 4]) for i in range(4)]
    far = [((20, ys[0] - 30), (1200, ys[0] - 40)), ((20, ys[-1] + 90), (1250, ys[-1] + 100)), ((30, 10), (35, 900))]
    return np.array(segments + [np.array(s, float) for s in far])


def sample(rng, segments, noise=0.3, keep=0.8):
    """Points about a pixel apart along most of the segments: the same edges as another detector would find them."""
    parts = []
    for a, b in segments:
        if rng.random() < keep:
            t = rng.random(max(2, int(np.linalg.norm(b - a))))[:, None]
            parts.append(a + (b - a) * t)
    points = np.concatenate(parts)
    return points + rng.normal(0, noise, points.shape)


def scattered(rng, n=1500):
    return rng.random((n, 2)) * [1200, 900]


@pytest.mark.parametrize("motion", ["translation", "rigid", "similarity", "affine", "projective"])
@pytest.mark.parametrize("metric", ["point", "line"])
def test_without_noise_it_returns_the_truth(motion, metric, rng):
    truth = {
        "translation": similarity(1, 0, 4, -3),
        "rigid": similarity(1, 0.004, 4, -3),
        "similarity": similarity(1.003, 0.004, 4, -3),
    }.get(motion, similarity(1.003, 0.004, 4, -3) @ np.array([[1.002, 0.003, 0], [0, 1, 0], [0, 0, 1]]))
    if motion == "projective":
        truth[2, :2] = 3e-6, -2e-6
    source = scattered(rng)
    result = _core.icp(source, rng.permutation(apply(truth, source)), motion=motion, metric=metric)
    assert np.abs(apply(result.transform, source) - apply(truth, source)).max() < 1e-6
    assert result.accepted and result.reason == "converged" and result.findings == []
    assert len(result.parameters) == len(result.names) == len(result.covariance)


@pytest.mark.parametrize("metric", ["point", "line"])
def test_the_basin_holds_a_fifth_of_the_spacing_of_windows(metric, rng):
    """20 px where windows are about 125 px apart; beyond it, wrong ends are never accepted."""
    for offset, wanted in [(5, 4), (20, 3), (120, 0)]:
        right = 0
        for _ in range(4):
            direction = rng.random() * 2 * np.pi
            shift = offset * np.cos(direction), offset * np.sin(direction)
            truth = similarity(1 + rng.normal(0, 0.003), rng.normal(0, 0.005), *shift)
            segments = facade(rng)
            source, target = sample(rng, segments), apply(truth, sample(rng, segments))
            result = _core.icp(source, target, metric=metric, residual_limit=1.5)
            good = error(result.transform, truth, source) < 0.5
            assert good or not result.accepted
            right += good and result.accepted
        assert right >= wanted, offset


def test_a_wrong_shift_ends_in_a_wrong_scale_and_is_recognised(rng):
    """As in the paper's Figure 4(b): the translation between the images is larger than closest points can bridge."""
    segments = facade(rng)
    source = sample(rng, segments)
    recognised = []
    for direction in np.linspace(0, 2 * np.pi, 6, endpoint=False):
        truth = similarity(1, 0, 400 * np.cos(direction), 400 * np.sin(direction))
        target = apply(truth, sample(rng, segments))
        result = _core.icp(source, target, motion="affine", residual_limit=30.0)
        assert error(result.transform, truth, source) > 5
        assert not result.accepted
        recognised += [kind for kind, *_ in result.findings]
        for kind, text, *_ in result.findings:
            if kind == "not distinct":
                assert "have a partner here" in text and "-" not in text, text
    assert {"scale", "not distinct"} & set(recognised)


def test_thresholds_trimming_and_mutual_pairs_bear_outliers(rng):
    truth = similarity(1.002, 0.003, 3, -2)
    base = scattered(rng, 1000)
    source = np.concatenate([base + rng.normal(0, 0.3, base.shape), scattered(rng, 500)])
    target = np.concatenate([apply(truth, base), scattered(rng, 500)])
    for options in ({}, {"mutual": True}, {"keep": 0.66}):
        result = _core.icp(source, target, threshold=10.0, final_threshold=1.5, **options)
        inlier = (result.pairs[:, 0] < 1000) & (result.pairs[:, 0] == result.pairs[:, 1])
        assert inlier.mean() > 0.95
        assert error(result.transform, truth, base) < 0.05
        assert result.accepted
        v = result.residuals
        assert result.rms == pytest.approx(np.sqrt((v**2).sum() / (2 * len(v))))
        assert result.rmse == pytest.approx(np.sqrt((v**2).sum() / len(v)))
        assert v == pytest.approx(target[result.pairs[:, 1]] - apply(result.transform, source[result.pairs[:, 0]]))
        thresholds = [step[0] for step in result.history]
        assert thresholds[0] == 10.0 and thresholds[-1] == 1.5 and thresholds == sorted(thresholds, reverse=True)


def test_mahalanobis_gates_and_weighs(rng):
    """Points that are uncertain along their own direction: the weighted fit is far better, and its sigma0 is 1."""
    truth = similarity(1.002, 0.003, 2, -1)
    base = scattered(rng, 600)
    angles = rng.random(600) * np.pi
    axes = np.stack(
        [np.column_stack([np.cos(angles), np.sin(angles)]), np.column_stack([-np.sin(angles), np.cos(angles)])], 1
    )
    covariance = np.einsum("nki,k,nkj->nij", axes, [9.0, 0.01], axes)
    noise = np.einsum("nki,nk->ni", axes, rng.normal(0, 1, (600, 2)) * [3.0, 0.1])
    source = base + noise
    target = np.concatenate([apply(truth, base), scattered(rng, 150)])
    weighted = _core.icp(source, target, source_covariance=covariance, residual_limit=4.0)
    plain = _core.icp(source, target, residual_limit=4.0)
    assert weighted.accepted
    assert error(weighted.transform, truth, base) < 0.5 * error(plain.transform, truth, base)
    assert weighted.sigma0 == pytest.approx(1, abs=0.1)
    assert (weighted.pairs[:, 0] == weighted.pairs[:, 1]).mean() > 0.97


def test_a_slide_along_lines_is_named_with_its_direction(rng):
    lines = np.array([[[0, 100 * k], [900, 100 * k + 300]] for k in range(4)], float)
    source, target = sample(rng, lines, keep=1.1), sample(rng, lines, keep=1.1) + np.array([3.0, -2.0])
    for metric in ("point", "line"):
        result = _core.icp(source, target, motion="rigid", metric=metric, threshold=20.0)
        assert not result.accepted
        (text,) = [text for kind, text, *_ in result.findings if kind == "ambiguous"]
        assert "slide along the direction (0.9" in text
        values, vectors = np.linalg.eigh(result.covariance_at(np.array([[450.0, 300.0]]))[0])
        assert values[1] > 400 * values[0]
        assert abs(vectors[:, 1] @ [3, 1]) / np.sqrt(10) > 0.99


def test_the_covariance_is_that_of_a_thousand_simulations(rng):
    truth = similarity(1.002, 0.003, 3, -2)
    base = scattered(rng, 300)
    corners = np.array([[0.0, 0], [1200, 0], [1200, 900], [0, 900]])
    deviations, sigmas, at_corners, expected = [], [], [], []
    for _ in range(1000):
        source, target = base + rng.normal(0, 0.2, base.shape), apply(truth, base) + rng.normal(0, 0.2, base.shape)
        result = _core.icp(source, target, threshold=20.0, final_threshold=5.0)
        deviations.append(result.parameters - [np.hypot(*truth[:2, 0]), 0.003, 3, -2])
        sigmas.append(result.sigma0)
        at_corners.append((apply(result.transform, corners) - apply(truth, corners)).ravel())
        expected.append(result.covariance)
    whitened = np.linalg.solve(np.linalg.cholesky(np.mean(expected, axis=0)), np.array(deviations).T)
    # Neighbourhoods of scattered points that happen to be flat count less: the statement is slightly cautious.
    assert np.diag(np.cov(whitened)) == pytest.approx(1, abs=0.16)
    assert np.mean(sigmas) == pytest.approx(0.2 * np.sqrt(2), rel=0.02)
    stated = np.trace(result.covariance_at(corners), axis1=1, axis2=2)
    assert stated == pytest.approx(np.var(at_corners, axis=0).reshape(4, 2).sum(1), rel=0.2)


def test_reasons_are_told(rng):
    source = scattered(rng, 500)
    target = source + rng.normal(0, 2.0, source.shape)
    assert _core.icp(source, target, residual_limit=0.5).reason == "residuals large"
    assert _core.icp(source, target + 15.0, max_iterations=2).reason == "iteration limit"
    with pytest.raises(DegenerateError, match="iteration 1: .* number of pairs"):
        _core.icp(source, target + 5000.0, threshold=10.0)
    with pytest.raises(InvalidInputError, match='no motion "quadratic"'):
        _core.icp(source, target, motion="quadratic")
    with pytest.raises(InvalidInputError, match="no metric"):
        _core.icp(source, target, metric="plane")
    with pytest.raises(InvalidInputError, match="source point 0 is not finite"):
        _core.icp(np.full((20, 2), np.nan), target)
    with pytest.raises(ValueError, match="source_covariance"):
        _core.icp(source, target, source_covariance=np.zeros((500, 2)))
