"""What is hidden, what is seen, and in which colour: on the simulator's square, against rays cast into the scene."""

from __future__ import annotations

import numpy as np
import pytest

from colourreg_rs import _core
from colourreg_rs.simulate import Response, simulate

SIZE = (1500, 1000)


@pytest.mark.slow
def test_the_square_is_coloured_where_it_is_seen():
    """Counted are the scan's points within the photo that lie on one surface (no mixed pixels). The scan has its noise;
    whether a point is seen is asked of the exact surface it was measured on."""
    simulation = simulate(
        "square", photos=1, size=SIZE, points=1_300_000, draft=True, response=Response().without_noise()
    )
    photo, truth, scene = simulation.photos[0], simulation.scan_truth, simulation.scene
    xyz = np.ascontiguousarray(simulation.scan.xyz)
    buffer = _core.DepthBuffer(photo.view.core)
    buffer.add(xyz)
    rgb, source = _core.colour_points([buffer.finish()], [photo.image], xyz)

    def within(xy):
        return (xy >= -0.5).all(axis=1) & (xy < np.array(SIZE) - 0.5).all(axis=1)

    surface = np.ascontiguousarray(truth.surface)
    xy, _ = _core.project(photo.view.core, surface)
    counted = np.flatnonzero(within(xy) & within(_core.project(photo.view.core, xyz)[0]) & ~truth.mixed)
    surface, xy, coloured = surface[counted], xy[counted], source[counted] > 0
    seen = photo.visible(surface, 1e-4)
    assert coloured[seen].mean() > 0.98
    # Only what stands before it and was scanned can be known to hide a point.
    eye = photo.view.core.centre
    behind = np.flatnonzero(~seen)
    rays = surface[behind] - eye
    distance = np.linalg.norm(rays, axis=1)
    hits = scene.cast(eye, rays / distance[:, None])
    places = np.ascontiguousarray(eye + rays / distance[:, None] * hits.distance[:, None])
    scanned = scene.core.sees(np.array(simulation.stations[0]), places, 1e-3) & ~scene.glass[hits.primitive]
    behind, distance = behind[scanned], distance[scanned]
    wrong = coloured[behind]
    assert len(behind) > 20_000
    assert wrong.mean() < 0.015
    # Bleeding: a hidden point's colour from farther than a pixel behind the contour of what hides it.
    depth, _ = photo.depth_image
    at, d = np.rint(xy[behind]).astype(int), distance
    beside = np.zeros(len(behind), bool)
    for dy in (-2, -1, 0, 1, 2):
        for dx in (-2, -1, 0, 1, 2):
            x, y = at[:, 0] + dx, at[:, 1] + dy
            near = np.hypot(x - xy[behind, 0], y - xy[behind, 1]) < 1.5
            inside = near & (x >= 0) & (y >= 0) & (x < SIZE[0]) & (y < SIZE[1])
            beside[inside] |= depth[y[inside], x[inside]] >= d[inside] * (1 - 2e-4)
    assert (wrong & ~beside).mean() < 0.004
    some = np.random.default_rng(0).permutation(np.flatnonzero(seen & coloured))[:50_000]
    error = np.abs(rgb[counted[some]] / 256.0 - photo.true_colour(surface[some]))
    assert np.median(error) < 1.05
