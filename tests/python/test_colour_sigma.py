"""ColourSigma where colouring writes it: each point's sigma is that of the view which coloured it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_cases import case

from colourreg_rs import Camera, Covariance, Pose, View, _core
from colourreg_rs.colourise import ColouriseOptions, Colouriser, SigmaHistogram


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
    buffer = _core.DepthBuffer(known.core)
    buffer.add(points)
    stated = sigma.at(points, planes=buffer.finish().planes())
    # Rounded to eight binary places, so that the file packs them well.
    assert np.abs(chunk.sigma[seen] / stated[seen] - 1).max() <= 2.0**-9
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


VIEWS = {
    "pinhole": Camera("PINHOLE", 1200, 900, {"fx": 900.0, "fy": 900.0, "cx": 599.5, "cy": 449.5}),
    "distorted": Camera("OPENCV", 1200, 900, {"fx": 900.0, "fy": 905.0, "cx": 590.0, "cy": 460.0, "k1": -0.1}),
    "fisheye": Camera("OPENCV_FISHEYE", 1200, 1200, {"fx": 400.0, "fy": 400.0, "cx": 599.5, "cy": 599.5, "k1": 0.01}),
    "panorama": Camera("EQUIRECTANGULAR", 2400, 1200, {}),
}  # fmt: skip


def room(rng, spacing=0.012, noise=0.002):
    """Points, with scan noise, and true normals of a room of 8 x 10 m, 3 m high, with a column and a slanted screen."""

    def patch(corner, a, b):
        corner, a, b = np.array(corner, float), np.array(a, float), np.array(b, float)
        n = [int(np.linalg.norm(side) / spacing) for side in (a, b)]
        s, t = np.meshgrid((np.arange(n[0]) + 0.5) / n[0], (np.arange(n[1]) + 0.5) / n[1])
        xyz = corner + s.reshape(-1, 1) * a + t.reshape(-1, 1) * b
        normal = np.cross(a, b)
        return xyz, np.tile(normal / np.linalg.norm(normal), (len(xyz), 1))

    parts = [
        patch((-4, -2, 0), (8, 0, 0), (0, 10, 0)),
        patch((-4, -2, 3), (8, 0, 0), (0, 10, 0)),
        patch((-4, -2, 0), (8, 0, 0), (0, 0, 3)),
        patch((-4, 8, 0), (8, 0, 0), (0, 0, 3)),
        patch((-4, -2, 0), (0, 10, 0), (0, 0, 3)),
        patch((4, -2, 0), (0, 10, 0), (0, 0, 3)),
        patch((-2.5, 5, 0), (1.5, 1.2, 0), (0, 0, 2.2)),
    ]
    turn = np.arange(0, 2 * np.pi, spacing / 0.4)
    angle, z = np.meshgrid(turn, np.arange(0, 3, spacing))
    around = np.stack([np.cos(angle).ravel(), np.sin(angle).ravel(), np.zeros(angle.size)], 1)
    parts.append((np.array([1.5, 5.0, 0]) + 0.4 * around + np.outer(z.ravel(), [0, 0, 1]), around))
    xyz, normals = (np.concatenate(column) for column in zip(*parts, strict=True))
    return xyz + noise * rng.standard_normal(xyz.shape), normals


@pytest.mark.parametrize("camera", VIEWS)
def test_slopes_of_surfaces_are_found_in_the_depth_buffer(camera, rng):
    xyz, truth = room(rng)
    sigmas = np.array([2e-4, 2e-4, 2e-4, 3e-3, 3e-3, 3e-3])
    names = ["rx", "ry", "rz", "cx_world", "cy_world", "cz_world"]
    view = View("room", None, VIEWS[camera], Pose.looking_at([0.3, 0.0, 1.5], [0.0, 8.0, 1.3]))
    buffer = _core.DepthBuffer(view.core)
    buffer.add(xyz)
    seen_by = buffer.finish()
    seen = seen_by.visible(xyz)
    xyz, truth = np.ascontiguousarray(xyz[seen]), np.ascontiguousarray(truth[seen])
    planes = seen_by.planes()
    normals = planes.normals(xyz)
    assert (normals != 0).any(1).mean() > 0.99
    assert np.allclose(np.linalg.norm(normals[(normals != 0).any(1)], axis=1), 1)
    arms = xyz - view.core.centre
    distances = np.linalg.norm(arms, axis=1)
    assert (np.einsum("ni,ni->n", normals, arms) >= 0).all()
    sigma = _core.SurfaceSigma(view.core, names, np.diag(sigmas**2), sigma_image=0.3, sigma_xyz=0.002)
    ratio = sigma.at(xyz, planes=planes).astype(float) / sigma.at(xyz, normals=truth)
    slant = np.degrees(np.arccos(np.abs(np.einsum("ni,ni->n", truth, arms)) / distances))
    for low, high in ((0, 40), (40, 60), (60, 75), (75, 80)):
        here = (slant >= low) & (slant < high)
        assert here.sum() > 1000
        assert abs(np.median(ratio[here]) - 1) < 0.02, (low, np.median(ratio[here]))
        assert (np.abs(ratio[here] - 1) < 0.1).mean() > 0.9, (low, (np.abs(ratio[here] - 1) < 0.1).mean())
    # Without slopes the floor would have looked twice as sure, and more.
    assert np.median(sigma.at(xyz)[slant > 60] / sigma.at(xyz, normals=truth)[slant > 60]) < 0.5


def test_normals_of_the_cloud_come_before_the_depth_buffer(setup):
    known, points, photo = setup
    arms = points - known.core.centre
    facing = coloured([known], points, photo)
    across = np.cross(arms, [0.0, 0.0, 1.0])
    slanted = arms / np.linalg.norm(arms, axis=1)[:, None] + 3 * across / np.linalg.norm(across, axis=1)[:, None]
    slanted[::2] = 0  # no normal: the depth buffer's word
    colouriser = Colouriser([known])
    colouriser.see(points)
    colouriser.finish([photo])
    chunk = colouriser.colour(points, slanted)
    seen = chunk.source == 1
    sigma = _core.SurfaceSigma(
        known.core, list(known.covariance.parameters), known.covariance.matrix, sigma_image=0.3, sigma_xyz=0.002
    )
    own = seen & (np.arange(len(points)) % 2 == 1)
    assert np.abs(chunk.sigma[own] / sigma.at(points, normals=slanted)[own] - 1).max() <= 2.0**-8
    assert np.array_equal(chunk.sigma[seen & ~own], facing.sigma[seen & ~own])


def test_the_median_of_all_sigmas_needs_no_list_of_them(rng):
    sigma = rng.lognormal(-6, 1, 100_001).astype(np.float32)
    sigma = ((sigma.view(np.uint32) >> 15) << 15).view(np.float32)
    histogram = SigmaHistogram()
    assert histogram.median() is None
    histogram.add(np.full(10, np.nan, np.float32))
    assert histogram.median() is None
    for part in np.array_split(np.append(sigma, np.full(999, np.nan, np.float32)), 7):
        histogram.add(part)
    assert histogram.median() == np.median(sigma)
