"""Chunks get the memory of earlier ones, and never that of one which somebody keeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from colourreg_rs.io.clouds import open_cloud
from colourreg_rs.io.pool import Pool


def test_memory_comes_back_when_the_last_view_of_it_has_gone() -> None:
    pool = Pool()
    first = pool.array((1000, 3), np.float64)
    place = first.ctypes.data
    view = first[10:20, 1]
    del first
    assert pool.array((1000, 3), np.float64).ctypes.data != place
    del view
    places = {pool.array((10, 36), np.uint8).ctypes.data for _ in range(5)}
    assert len(places) == 1
    larger = pool.array((1001, 3), np.float64)
    larger[:] = 7.0
    assert larger.shape == (1001, 3) and (larger == 7.0).all()


def test_who_keeps_all_chunks_has_all_of_them(tmp_path: Path) -> None:
    import laspy

    rng = np.random.default_rng(3)
    las = laspy.create(point_format=6, file_version="1.4")
    las.xyz = rng.uniform(-50, 50, (5_000, 3))
    las.write(tmp_path / "a.las")
    las.write(tmp_path / "a.laz")
    for name in ("a.las", "a.laz"):
        with open_cloud(tmp_path / name) as reader:
            kept = [chunk.xyz for chunk in reader.chunks(512)]
            streamed = [chunk.xyz.copy() for chunk in reader.chunks(512)]
        np.testing.assert_array_equal(np.concatenate(kept), las.xyz)
        np.testing.assert_array_equal(np.concatenate(streamed), las.xyz)
