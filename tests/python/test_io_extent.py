"""The extent that a file tells is taken where its points bear it out, and found anew where they do not."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from colourreg_rs import ControlPoint, FileError, PointCloud, write_cloud
from colourreg_rs.io.clouds import CloudReader, open_cloud
from colourreg_rs.register.control import outside_cloud


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_the_header_s_bounds_are_the_points_own(tmp_path, rng, suffix):
    xyz = rng.uniform([500_000, 5_800_000, 90], [500_040, 5_800_070, 130], (200_000, 3))
    write_cloud(tmp_path / f"c{suffix}", PointCloud(xyz))
    with open_cloud(tmp_path / f"c{suffix}") as cloud:
        told, found = cloud.told_extent(), cloud.extent()
    assert np.abs(told.low - found.low).max() <= 0.001 and np.abs(told.high - found.high).max() <= 0.001


@pytest.mark.parametrize(
    "bounds",
    [
        [0.0] * 6,
        [1.0, 0.0, 1.0, 0.0, 1.0, 0.0],
        [np.nan] * 6,
        [-1e300, 1e300, 1.0, 0.0, 1.0, 0.0],
        [1e300, -1e300, 1e300, -1e300, 1e300, -1e300],
    ],
)
def test_bounds_that_cannot_be_are_not_believed(tmp_path, rng, bounds):
    xyz = rng.uniform([500_000, 5_800_000, 90], [500_040, 5_800_070, 130], (2_000, 3))
    write_cloud(tmp_path / "c.las", PointCloud(xyz))
    data = bytearray((tmp_path / "c.las").read_bytes())
    struct.pack_into("<6d", data, 179, *bounds)
    (tmp_path / "c.las").write_bytes(data)
    with open_cloud(tmp_path / "c.las") as cloud:
        assert cloud.told_extent() is None
        found = cloud.extent()
    assert np.abs(found.low - xyz.min(0)).max() <= 0.001 and np.abs(found.high - xyz.max(0)).max() <= 0.001


def test_control_points_are_judged_without_reading_the_cloud(tmp_path, rng, monkeypatch):
    write_cloud(tmp_path / "c.laz", PointCloud(rng.uniform(0, 10, (120_000, 3))))

    def unwanted(_):
        raise AssertionError("the whole cloud was read")

    monkeypatch.setattr(CloudReader, "extent", unwanted)
    near, beside, far = (ControlPoint("P", np.full(3, v), np.zeros(2)) for v in (5.0, 20.0, 9e3))
    with open_cloud(tmp_path / "c.laz") as cloud:
        assert outside_cloud([near], cloud, tmp_path / "p.csv") == ()
        (warning,) = outside_cloud([beside], cloud, tmp_path / "p.csv")
        assert "outside the cloud" in warning
        with pytest.raises(FileError, match="outside the cloud"):
            outside_cloud([far], cloud, tmp_path / "p.csv")
