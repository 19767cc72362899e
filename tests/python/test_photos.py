"""Photos are held while chunks lie in them; what is coloured does not depend on it, memory does."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from colourreg_rs import (
    Camera,
    ColouriseOptions,
    Colouriser,
    Covariance,
    PointCloud,
    Pose,
    Registration,
    View,
    write_registration,
)
from colourreg_rs.io.clouds import write_cloud
from colourreg_rs.io.images import write_image
from colourreg_rs.photos import PhotoShelf


def ring(count: int, size: tuple[int, int]) -> list[View]:
    """Views all around from one place, overlapping a little."""
    width, height = size
    f = 0.5 * width / np.tan(1.2 * np.pi / count)
    params = {"fx": f, "fy": f, "cx": (width - 1) / 2, "cy": (height - 1) / 2}
    angles = 2 * np.pi * (np.arange(count) + 0.5) / count
    camera = Camera("PINHOLE", width, height, params)
    poses = [Pose.looking_at([0, 0, 0], [np.cos(a), np.sin(a), 0]) for a in angles]
    return [View(f"v{k}", None, camera, pose) for k, pose in enumerate(poses)]


def panorama(n: int) -> np.ndarray:
    """A round wall, column after column, as a scanner goes around."""
    angle = 2 * np.pi * (np.arange(n) // 100) / (n // 100)
    up = (np.arange(n) % 100) / 100 * 4 - 2
    return np.column_stack([10 * np.cos(angle), 10 * np.sin(angle), up])


@pytest.mark.parametrize("blend", ["best", "mean", "median"])
@pytest.mark.parametrize("level", [False, True])
def test_colours_do_not_depend_on_how_many_photos_are_held(rng, blend, level):
    views, xyz = ring(8, (120, 90)), panorama(40_000)
    photos = [rng.integers(0, 256, (90, 120, 3), dtype=np.uint8) for _ in views]
    found, decoded = [], []
    for limit in (8 * photos[0].nbytes, 3 * photos[0].nbytes, 0):
        shelf = PhotoShelf([partial(np.copy, photo) for photo in photos], [(120, 90)] * 8, limit)
        shelf.fill()
        assert shelf.held_bytes <= limit
        colouriser = Colouriser(views, ColouriseOptions(blend=blend, level_exposure=level))
        chunks = [np.ascontiguousarray(part) for part in np.array_split(xyz, 20)]
        for chunk in chunks:
            colouriser.see(chunk)
        colouriser.finish(shelf)
        if level:
            for chunk in chunks:
                colouriser.compare(chunk)
        colours = [colouriser.colour(chunk) for chunk in chunks]
        found.append([np.concatenate([getattr(c, name) for c in colours]) for name in ("rgb", "source")])
        decoded.append(shelf.decoded)
        assert (found[-1][1] > 0).all() and set(found[-1][1]) == set(range(1, 9))
    for rgb, source in found[1:]:
        assert np.array_equal(rgb, found[0][0]) and np.array_equal(source, found[0][1])
    # All at once; or each about once while the scan goes around, in each pass over it.
    assert decoded[0] == 8 and all(8 < times < 50 for times in decoded[1:])


def test_arrays_stay_where_they_are(rng):
    photos = [rng.integers(0, 256, (20, 30, 3), dtype=np.uint8) for _ in range(3)]
    shelf = PhotoShelf.of(photos)
    taken = shelf.take({1})
    assert taken[1] is photos[1] and taken[0].shape == (20, 30, 3) and not taken[0].any()
    assert shelf.take({0, 2})[2] is photos[2] and shelf.decoded == 0


def test_a_run_that_fails_does_not_decode_all_its_photos():
    decoded = []

    def load(number):
        decoded.append(number)
        if number == 1:
            shelf.stop()
        return np.zeros((20, 30, 3), np.uint8)

    shelf = PhotoShelf([partial(load, number) for number in range(9)], [(30, 20)] * 9)
    shelf.fill()
    assert decoded == [0, 1]


RUN = """
import re, sys
from pathlib import Path
from colourreg_rs import ColouriseOptions, colourise_file
options = ColouriseOptions(photo_memory=int(sys.argv[2]), chunk_size=20_000)
folder = Path(sys.argv[1])
colourise_file(folder / "scan.las", [folder / "registration.json"], folder / f"out-{sys.argv[2]}.las", options=options)
print(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
"""


@pytest.mark.slow
def test_memory_is_that_of_the_photos_in_use(tmp_path, rng):
    count, size = 24, (1500, 1000)
    views = ring(count, size)
    named = []
    for k, view in enumerate(views):
        path = tmp_path / f"{k}.jpg"
        write_image(path, np.full((size[1], size[0], 3), 10 * k, np.uint8))
        named.append(View(view.name, path, view.camera, view.pose))
    write_cloud(tmp_path / "scan.las", PointCloud(panorama(400_000)))
    write_registration(tmp_path / "registration.json", Registration(tuple(named)))
    photo = 3 * size[0] * size[1]
    peaks = {}
    # The C library gives pictures above 32 MB back to the system at once, smaller ones when it likes. These small ones
    # are to be treated like those of a camera.
    environment = {**os.environ, "MALLOC_MMAP_THRESHOLD_": "1000000"}
    for limit in (count * photo, 4 * photo):
        done = subprocess.run(
            [sys.executable, "-c", RUN, str(tmp_path), str(limit)],
            capture_output=True,
            text=True,
            check=True,
            env=environment,
        )
        peaks[limit] = int(re.search(r"\d+", done.stdout)[0]) * 1024
    most, few = peaks.values()
    assert most - few > 0.7 * (count - 6) * photo, peaks
    a, b = (Path(tmp_path / f"out-{limit}.las").read_bytes() for limit in peaks)
    assert a == b


def test_unseen_points_keep_what_they_had_and_nobody_s_array_is_written_into(rng):
    (view, *_) = ring(4, (120, 90))
    xyz = panorama(4_000)
    photo = rng.integers(1, 256, (90, 120, 3), dtype=np.uint8)
    before = rng.integers(0, 65536, (len(xyz), 3), dtype=np.uint16)
    kept = before.copy()
    colouriser = Colouriser([view], ColouriseOptions())
    colouriser.see(xyz)
    colouriser.finish([photo])
    over, black = colouriser.colour(xyz, before=before), colouriser.colour(xyz)
    unseen = over.source == 0
    assert 0.2 < unseen.mean() < 0.8 and np.array_equal(before, kept)
    assert np.array_equal(over.rgb[unseen], before[unseen]) and not black.rgb[unseen].any()
    assert np.array_equal(over.rgb[~unseen], black.rgb[~unseen]) and black.rgb[~unseen].all()


def test_doubtful_colours_leave_the_old_ones(rng):
    (view, *_) = ring(4, (120, 90))
    names = ("rx", "ry", "rz", "cx_world", "cy_world", "cz_world")
    view = View(view.name, None, view.camera, view.pose, covariance=Covariance(names, np.eye(6) * 1e-6))
    xyz, before = panorama(4_000), np.full((4_000, 3), 777, np.uint16)
    colouriser = Colouriser([view], ColouriseOptions(max_sigma=1e-9))
    colouriser.see(xyz)
    colouriser.finish([np.full((90, 120, 3), 9, np.uint8)])
    found = colouriser.colour(xyz, before=before)
    assert not found.source.any() and (found.rgb == 777).all() and np.isnan(found.sigma).all()
