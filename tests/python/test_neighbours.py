"""Nearest neighbours against SciPy's kd-tree."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree

from colourreg_rs import InvalidInputError, _core


def scattered(rng, n, d):
    return rng.random((n, d)) * 1000.0


def clustered(rng, n, d):
    centres = rng.random((20, d)) * 1000.0
    return centres[rng.integers(0, 20, n)] + rng.normal(0, 0.5, (n, d)) ** 3


def lattice(rng, n, d):
    """Many points and many distances coincide."""
    return rng.integers(0, 25, (n, d)).astype(float)


def lines(rng, n, d):
    starts, directions = rng.random((30, d)) * 1000.0, rng.normal(0, 1, (30, d))
    which = rng.integers(0, 30, n)
    return starts[which] + directions[which] * rng.random((n, 1)) * 200.0


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("make", [scattered, clustered, lattice, lines])
def test_neighbours_agree_with_scipy(make, d, rng):
    points, queries = make(rng, 6000, d), make(rng, 5000, d)
    ours, theirs = _core.Neighbours(points), cKDTree(points)
    assert len(ours) == 6000
    index, distance = ours.nearest(queries)
    assert index.dtype == np.int64
    assert distance == pytest.approx(theirs.query(queries)[0], rel=1e-12, abs=1e-12)
    assert np.linalg.norm(points[index] - queries, axis=1) == pytest.approx(distance, rel=1e-12, abs=1e-12)
    reach = float(np.median(distance)) + 0.5
    index, distance = ours.nearest(queries, reach)
    expected, _ = theirs.query(queries, distance_upper_bound=reach * (1 + 1e-12))
    assert np.array_equal(index == -1, np.isinf(expected)) and np.array_equal(np.isinf(distance), index == -1)
    index, distance = ours.k_nearest(queries, 7)
    assert distance == pytest.approx(theirs.query(queries, k=7)[0], rel=1e-12, abs=1e-12)
    assert all(len(set(row)) == 7 for row in index.tolist())
    offsets, index, distance = ours.within(queries[:500], reach)
    expected = theirs.query_ball_point(queries[:500], reach * (1 + 1e-14))
    assert [sorted(index[a:b]) for a, b in pairwise(offsets)] == [sorted(e) for e in expected]
    assert (distance <= reach * (1 + 1e-12)).all()


def test_fewer_points_than_asked_for_are_filled_up():
    index, distance = _core.Neighbours(np.array([[0.0, 0.0], [3.0, 4.0]])).k_nearest(np.zeros((1, 2)), 4)
    assert index.tolist() == [[0, 1, -1, -1]]
    assert distance.tolist() == [[0.0, 5.0, np.inf, np.inf]]


def test_what_cannot_be_searched_is_refused():
    with pytest.raises(InvalidInputError, match="no point"):
        _core.Neighbours(np.zeros((0, 2)))
    with pytest.raises(InvalidInputError, match="point 1 is not finite"):
        _core.Neighbours(np.array([[0.0, 0, 0], [0.0, np.nan, 0]]))
    index = _core.Neighbours(np.zeros((1, 2)))
    with pytest.raises(InvalidInputError, match="query 0"):
        index.nearest(np.array([[np.inf, 0.0]]))
    with pytest.raises(ValueError, match=r"queries must be .* \(N, 2\)"):
        index.nearest(np.zeros((5, 3)))
    with pytest.raises(ValueError, match=r"points must be .* \(N, 3\)"):
        _core.Neighbours(np.zeros((5, 4)))
    with pytest.raises(InvalidInputError, match="k = 0"):
        index.k_nearest(np.zeros((5, 2)), 0)
