"""Control points that fit among themselves, but lie on nothing that was scanned: a wrong unit, axis order or frame."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from colourreg_rs import ControlPoint, PointCloud, _core, write_cloud
from colourreg_rs.io.clouds import open_cloud
from colourreg_rs.io.images import write_image
from colourreg_rs.register.control import off_the_scan, one_pick_twice
from colourreg_rs.simulate import simulate

WRONG = {
    "feet": lambda xyz: xyz * 3.28084,
    "exchanged axes": lambda xyz: xyz[..., [1, 0, 2]],
    "up is y": lambda xyz: xyz[..., [0, 2, 1]],
    "another origin": lambda xyz: xyz + np.array([1.0, 1.0, 0.5]),
}


def moved(points, change):
    return [replace(p, xyz=change(p.xyz)) for p in points]


@pytest.fixture(scope="module", params=["facade", "room", "trial"])
def scene(request, tmp_path_factory):
    simulation = simulate(request.param, size=(300, 200), photos=1, draft=True, samples=1, points=150_000)
    path = tmp_path_factory.mktemp(request.param) / "scan.laz"
    write_cloud(path, simulation.scan)
    return path, simulation.photos[0].points


def judged(path, points):
    with open_cloud(path) as reader:
        return off_the_scan(points, reader)


def test_honest_points_are_neither_refused_nor_suspected(scene):
    path, points = scene
    assert judged(path, points) == ((), ())


def test_one_pick_under_two_names_is_told(scene):
    _, points = scene
    assert one_pick_twice(points) == ()
    again = [
        *points,
        replace(points[0], name="again", role="check"),
        replace(points[1], name="beside", xy=points[0].xy),
    ]
    (warning,) = one_pick_twice(again)
    assert f"{points[0].name} and again" in warning and "beside" not in warning


@pytest.mark.parametrize("what", WRONG)
def test_points_of_another_unit_or_frame_are_doubted_with_figures(scene, what):
    path, points = scene
    warnings, doubts = judged(path, moved(points, WRONG[what]))
    assert warnings == ()
    assert len(doubts) == 1 and f"of {len(points)} control points lie far" in doubts[0] and " m apart" in doubts[0]


def test_a_target_that_stands_off_is_named_and_not_refused(scene):
    path, points = scene
    off = [replace(points[0], xyz=points[0].xyz + np.array([0, 0, 60.0])), *points[1:]]
    (warning,), doubts = judged(path, off)
    assert doubts == () and f"1 of {len(points)}" in warning and points[0].name in warning


def test_a_point_s_own_sigma_is_given_to_it(scene):
    path, points = scene
    wrong = moved(points, WRONG["another origin"])
    assert judged(path, [replace(p, sigma_xyz=np.full(3, 2.0)) for p in wrong]) == ((), ())


def wall_points(rng, n, noise=0.0):
    return np.column_stack([rng.uniform(-10, 10, n), np.full(n, 20.0) + rng.normal(0, noise, n), rng.uniform(0, 8, n)])


@pytest.mark.parametrize("n", [200, 2_000, 200_000])
def test_what_is_far_depends_on_how_densely_the_scan_was_made(tmp_path, rng, n):
    """Honest points between the points of a sparse scan are honest still."""
    cloud = wall_points(rng, n)
    write_cloud(tmp_path / "c.las", PointCloud(cloud))
    points = [ControlPoint(f"P{i}", xyz, np.zeros(2)) for i, xyz in enumerate(wall_points(rng, 30))]
    assert judged(tmp_path / "c.las", points) == ((), ())
    _, doubts = judged(tmp_path / "c.las", moved(points, lambda xyz: xyz - [0, 15.0, 0]))
    assert len(doubts) == 1


def test_reading_stops_when_all_points_are_near_enough(tmp_path, rng):
    write_cloud(tmp_path / "c.las", PointCloud(wall_points(rng, 1_200_000)))
    points = [ControlPoint(f"P{i}", xyz, np.zeros(2)) for i, xyz in enumerate(wall_points(rng, 30))]
    read = []
    with open_cloud(tmp_path / "c.las") as reader:
        chunks = reader.chunks
        reader.chunks = lambda **options: (read.append(len(c)) or c for c in chunks(50_000, **options))
        assert off_the_scan(points, reader) == ((), ())
    assert sum(read) < 600_000


def test_the_kept_points_are_those_of_a_tree(rng):
    cloud, places = rng.uniform(-5, 5, (30_000, 3)), rng.uniform(-7, 7, (40, 3))
    approach = _core.Approach(places)
    assert np.isinf(approach.distances()).all() and np.isinf(approach.spacings()).all()
    for part in np.array_split(cloud, 7):
        approach.add(part)
    index, distance = _core.Neighbours(cloud).k_nearest(places, 8)
    assert np.array_equal(approach.distances(), distance[:, 0])
    near = cloud[index]
    apart = np.linalg.norm(near[:, :, None] - near[:, None], axis=-1) + np.where(np.eye(8), np.inf, 0)
    assert approach.spacings() == pytest.approx(np.sort(apart.min(axis=2), axis=1)[:, 4], rel=1e-12)


@pytest.mark.parametrize("method", ["resection", "dlt"])
def test_register_refuses_what_fits_itself_and_not_the_scan(tmp_path, method):
    """A scale that is wrong by the same factor everywhere leaves no residual: the scan alone tells."""
    # A façade is too flat for a DLT.
    name = {"resection": "facade", "dlt": "trial"}[method]
    simulation = simulate(
        name, size=(600, 400), photos=1, draft=True, samples=1, points=150_000, camera_model="PINHOLE"
    )
    write_cloud(tmp_path / "scan.laz", simulation.scan)
    photo = simulation.photos[0]
    write_image(tmp_path / "photo.png", photo.image)
    camera = {"model": photo.view.camera.model, "width": 600, "height": 400, "params": dict(photo.view.camera.params)}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    for name, change in {"right": lambda xyz: xyz, "feet": WRONG["feet"]}.items():
        rows = [",".join(["name", *"XYZxy", "role"])]
        for p in photo.points:
            rows.append(",".join([p.name, *(f"{v:.5f}" for v in (*change(p.xyz), *p.xy)), p.role]))
        (tmp_path / f"{name}.csv").write_text("\n".join(rows))

    def register(points, *more):
        line = ["register", "scan.laz", "photo.png", "--points", points, "--out", "view.json", "--method", method]
        line += ["--camera", "camera.json"] if method == "resection" else []
        line = [sys.executable, "-m", "colourreg_rs", *line, *more]
        return subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False)

    run = register("feet.csv")
    assert run.returncode == 1 and run.stderr.count("\n") == 1
    assert "lie far from everything that was scanned" in run.stderr and "unit, axis order and frame" in run.stderr
    assert not (tmp_path / "view.json").exists()
    run = register("feet.csv", "--force")
    assert run.returncode == 0 and "DOUBT" in run.stdout
    doubts = json.loads((tmp_path / "view.json").read_text())["views"][0]["statistics"]["doubts"]
    assert any("far from everything" in doubt for doubt in doubts)
    # What else a DLT thinks of a small photo's picks is no matter here.
    run = register("right.csv")
    assert "everything that was scanned" not in run.stdout + run.stderr and "beside what" not in run.stdout
    assert method == "dlt" or run.returncode == 0, run.stderr
