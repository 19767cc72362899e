"""Memory is that of a few chunks, whatever the cloud's size."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest

COLOUR = """
import re, sys
from pathlib import Path
import numpy as np
from colourreg_rs.io.clouds import create_cloud, open_cloud

def peak():
    # What getrusage says includes the process that started this one.
    return int(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1])

def colour(source, target):
    with open_cloud(source) as reader, create_cloud(target, reader) as out:
        for chunk in reader.chunks(positions_only=True):
            pass
        for chunk in reader.chunks():
            n = len(chunk)
            rgb = chunk.rgb if chunk.rgb is not None else np.zeros((n, 3), np.uint16)
            out.write(chunk, rgb, np.ones(n, np.uint16), np.full(n, 0.5, np.float32))

colour(sys.argv[1], sys.argv[1] + ".out" + sys.argv[1][-4:])  # what is imported and set up once is not counted
before = peak()
colour(sys.argv[2], sys.argv[2] + ".out" + sys.argv[2][-4:])
print(before, peak())
"""


def make_las(path: Path, n: int, rng: np.random.Generator) -> None:
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = [0.001] * 3
    with laspy.open(path, mode="w", header=header) as out:
        for start in range(0, n, 500_000):
            points = laspy.ScaleAwarePointRecord.zeros(min(500_000, n - start), header=header)
            points.X[:] = np.arange(start, start + len(points)) % 2000
            points.Y[:] = rng.integers(0, 50, len(points))
            points.red[:] = rng.integers(0, 65536, len(points))
            out.write_points(points)


def make_ply(path: Path, n: int, rng: np.random.Generator) -> None:
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity", "a", "b", "c"))
    with path.open("wb") as out:
        out.write(f"ply\nformat binary_little_endian 1.0\nelement vertex {n}\n{properties}end_header\n".encode())
        for start in range(0, n, 500_000):
            out.write(rng.random((min(500_000, n - start), 7), np.float32).tobytes())


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".las", ".laz", ".ply"])
def test_memory_is_that_of_a_few_chunks(tmp_path, rng, suffix):
    small, large = tmp_path / f"small{suffix}", tmp_path / f"large{suffix}"
    make = make_ply if suffix == ".ply" else make_las
    make(small, 1_200_000, rng)
    make(large, 5_000_000, rng)
    out = subprocess.run(
        [sys.executable, "-c", COLOUR, str(small), str(large)], capture_output=True, text=True, check=True
    )
    before, after = (int(word) / 1024 for word in out.stdout.split())
    # Four times the points; the whole cloud's records alone would be 140 MB more.
    assert after - before < 40, (before, after)
    assert after < 400
