"""Depth buffers and visibility: against NumPy, and on surfaces whose answer is known."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from colourreg_rs import Camera, InvalidInputError, Pose, View, _core

SIZE = (640, 480)


def pinhole(f: float = 500.0, size: tuple[int, int] = SIZE, centre=(0.0, 0.0, 0.0)) -> _core.View:
    camera = Camera("PINHOLE", *size, {"fx": f, "fy": f, "cx": size[0] / 2 - 0.5, "cy": size[1] / 2 - 0.5})
    return View("v", None, camera, Pose.from_centre(np.eye(3), centre)).core


def plane(rng, n, depth, spread=1.0, slope=(0.0, 0.0)):
    """Points of z = depth + slope · (x, y), spread over the picture of the camera above, and a little beyond."""
    uv = rng.uniform(-spread, spread, (n, 2)) * np.array([0.7, 0.55])
    z = depth / (1 - uv @ np.array(slope))
    return np.column_stack([uv * z[:, None], z])


def see(view, *chunks, **options):
    buffer = _core.DepthBuffer(view, **options)
    for chunk in chunks:
        buffer.add(np.ascontiguousarray(chunk))
    return buffer.finish()


def test_an_index_buffer_is_that_of_numpy(rng):
    view = pinhole()
    xyz = np.concatenate([plane(rng, 100_000, 8.0), plane(rng, 100_000, 5.0, slope=(0.5, -0.3))])
    xyz[::7] = xyz[3]  # equal depths, so that the lower index has to win
    xyz[5::1000] = np.nan
    xyz[6::1000, 2] *= -1
    buffer = _core.IndexBuffer(view)
    for first in (120_000, 0, 60_000):
        last = {120_000: 200_000, 0: 60_000, 60_000: 120_000}[first]
        buffer.add(np.ascontiguousarray(xyz[first:last]), first)
    depth, index = buffer.images()
    xy, z = _core.project(view, xyz)
    column, row = np.floor(xy + 0.5).T
    inside = (column >= 0) & (column < SIZE[0]) & (row >= 0) & (row < SIZE[1])
    ids = np.flatnonzero(inside)
    cell = row[ids].astype(int) * SIZE[0] + column[ids].astype(int)
    order = np.lexsort((ids, -(1 / z[ids]).astype(np.float32), cell))
    cells, firsts = np.unique(cell[order], return_index=True)
    expected = np.full(SIZE[0] * SIZE[1], -1)
    expected[cells] = ids[order][firsts]
    assert np.array_equal(index.ravel(), expected)
    found = expected >= 0
    assert np.allclose(depth.ravel()[found], z[expected[found]], rtol=1e-6)
    assert np.isnan(depth.ravel()[~found]).all()
    # A depth buffer keeps 22 bits of the depth.
    assert np.allclose(see(view, xyz).depth(), depth, rtol=5e-6, atol=0, equal_nan=True)
    # In one go with the points' values, here their numbers: the same.
    drawn, numbers = _core.sci_picture(view, xyz, np.arange(len(xyz), dtype=np.float32))
    assert np.array_equal(drawn, depth, equal_nan=True)
    assert np.array_equal(np.nan_to_num(numbers, nan=-1.0), index)
    with pytest.raises(InvalidInputError, match="200000 points have 3 values"):
        _core.sci_picture(view, xyz, np.zeros(3, np.float32))


def test_chunks_their_order_and_threads_leave_no_trace(rng):
    view = pinhole()
    xyz = np.concatenate([plane(rng, 60_000, 8.0), plane(rng, 3_000, 5.0, 0.5), plane(rng, 20_000, 6.0, 0.3, (2.0, 0))])
    whole = see(view, xyz)
    shuffled = see(view, *np.array_split(rng.permutation(xyz), 13))
    buffer = _core.DepthBuffer(view)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(buffer.add, map(np.ascontiguousarray, np.array_split(xyz, 50))))
    threaded = buffer.finish()
    photo = rng.integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    for other in (shuffled, threaded):
        assert np.array_equal(whole.depth(), other.depth(), equal_nan=True)
        assert np.array_equal(whole.limit(), other.limit())
        assert np.array_equal(whole.visible(xyz), other.visible(xyz))
    rgb, source = _core.colour_points([whole], [photo], xyz)
    parts = [_core.colour_points([threaded], [photo], np.ascontiguousarray(p)) for p in np.array_split(xyz, 7)]
    assert np.array_equal(rgb, np.concatenate([p[0] for p in parts]))
    assert np.array_equal(source, np.concatenate([p[1] for p in parts]))


@pytest.mark.parametrize("points", [4_000, 20_000, 100_000, 2_000_000])
@pytest.mark.parametrize("slope", [(0.0, 0.0), (1.0, 0.5), (-6.0, 3.0)])
def test_a_surface_does_not_hide_itself(rng, points, slope):
    view = pinhole()
    spread = 1.0 if slope[0] >= 0 else 0.1
    xyz = plane(rng, points, 10.0, spread, slope)
    xyz += rng.normal(0, 0.003, (len(xyz), 1)) * xyz / np.linalg.norm(xyz, axis=1)[:, None]
    xy, _ = _core.project(view, xyz)
    inside = (xy > -0.5).all(1) & (xy < np.array(SIZE) - 0.5).all(1)
    visible = see(view, xyz).visible(xyz)
    assert not visible[~inside].any()
    assert visible[inside].mean() > 0.99


def test_a_finished_buffer_takes_nothing_more(rng):
    buffer = _core.DepthBuffer(pinhole())
    buffer.finish()
    with pytest.raises(InvalidInputError, match="finished"):
        buffer.add(np.zeros((1, 3)))
    with pytest.raises(InvalidInputError, match="finished"):
        buffer.finish()


def test_an_empty_buffer_hides_nothing():
    empty = see(pinhole())
    assert empty.visible(np.array([[0.0, 0, 5], [0, 0, -5], [np.nan, 0, 5], [50, 0, 5]])).tolist() == [
        True,
        False,
        False,
        False,
    ]
    assert np.isinf(empty.limit()).all()


def test_limits_of_distance_and_incidence(rng):
    view = pinhole()
    near, far = plane(rng, 100_000, 5.0, 0.4), plane(rng, 100_000, 20.0)
    xyz = np.concatenate([near, far])
    visible = see(view, xyz, max_distance=15.0).visible(xyz)
    assert visible[:100_000].mean() > 0.99 and not visible[100_000:].any()
    steep = plane(rng, 200_000, 10.0, 0.1, (-6.0, 0.0))  # the ray meets it at about 81 degrees
    for limit, seen in ((np.radians(70), False), (np.radians(88), True)):
        assert (see(view, steep, max_incidence=limit).visible(steep).mean() > 0.5) == seen
    for options in ({"max_distance": -1.0}, {"max_incidence": 2.0}, {"tolerance": -0.1}, {"max_gap": np.nan}):
        with pytest.raises(InvalidInputError):
            _core.DepthBuffer(view, **options)


@pytest.mark.parametrize("block", [3, 5])
def test_noise_that_neighbours_share_does_not_hide_the_surface_itself(rng, block):
    """A depth camera's wall: patches of equal depth, which then jumps by more than neighbours tell of the noise."""
    width, height = 320, 240
    x, y = (a.ravel() for a in np.meshgrid(np.arange(float(width)), np.arange(float(height))))
    noise = np.kron(rng.normal(0, 0.012, (height // block + 1, width // block + 1)), np.ones((block, block)))
    depth = 2.0 + noise[:height, :width].ravel()
    xyz = np.column_stack([(x - 159.5) / 260 * depth + 0.05, (y - 119.5) / 260 * depth, depth])
    buffer = _core.DepthBuffer(pinhole(260.0, (width, height)))
    buffer.add(xyz)
    assert buffer.finish().visible(xyz).mean() > 0.955
