"""ColourSigma where colouring writes it: each point's sigma is that of the view which coloured it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_cases import case

from colourreg_rs import Covariance, _core
from colourreg_rs.colourise import ColouriseOptions, Colouriser


@pytest.fixture
def setup(rng):
    problem = case(20, rng)
    result = problem.adjust(*problem.noisy(rng), ["pose"], snoop=False)
    known = replace(problem.view, covariance=Covariance(tuple(result.names), result.covariance))
    points = case(3000, rng, view=problem.view, depths=(9.0, 10.0)).xyz
    photo = np.full((3000, 4000, 3), 128, np.uint8)
    return known, points, photo


def coloured(views, points, photo, **options):
    colouriser = Colouriser(views, ColouriseOptions(**options))
    colouriser.see(points)
    colouriser.finish([photo] * len(views))
    return colouriser.colour(points)


def test_every_coloured_point_has_its_sigma_and_the_others_none(setup):
    known, points, photo = setup
    chunk = coloured([known], points, photo)
    seen = chunk.source == 1
    assert seen.sum() > 1000
    sigma = _core.SurfaceSigma(
        known.core, list(known.covariance.parameters), known.covariance.matrix, sigma_image=0.3, sigma_xyz=0.002
    )
    # Rounded to eight binary places, so that the file packs them well.
    assert np.abs(chunk.sigma[seen] / sigma.at(points)[seen] - 1).max() <= 2.0**-9
    assert (chunk.sigma[seen].view(np.uint32) & 0x7FFF == 0).all()
    assert np.isnan(chunk.sigma[~seen]).all()


def test_a_view_of_unknown_covariance_gives_no_sigma(setup):
    known, points, photo = setup
    chunk = coloured([replace(known, covariance=None)], points, photo)
    assert (chunk.source == 1).sum() > 1000 and np.isnan(chunk.sigma).all()


def test_unsure_points_stay_uncoloured(setup):
    known, points, photo = setup
    everything = coloured([known], points, photo)
    limit = float(np.nanmedian(everything.sigma))
    chunk = coloured([known], points, photo, max_sigma=limit)
    kept = chunk.source == 1
    assert np.array_equal(kept, (everything.source == 1) & (everything.sigma <= limit))
    assert 0 < kept.sum() < (everything.source == 1).sum()
