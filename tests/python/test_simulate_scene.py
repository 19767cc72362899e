"""Scenes, rays and visibility of the simulator."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from colourreg_rs import _core
from colourreg_rs.errors import InvalidInputError
from colourreg_rs.io.clouds import read_cloud
from colourreg_rs.io.points import read_points
from colourreg_rs.io.registration import read_registration
from colourreg_rs.simulate import Frame, Simulation, simulate, write_simulation


@pytest.fixture(scope="module")
def square() -> Simulation:
    return simulate("square", seed=3, draft=True, size=(360, 240), photos=1, points=60_000)


def test_scan_points_lie_on_their_surfaces_up_to_the_stated_noise(square: Simulation) -> None:
    truth = square.scan_truth
    station = np.array(square.stations[0])
    ranges = np.linalg.norm(square.scan.xyz - station, axis=1)
    error = (ranges - np.linalg.norm(truth.surface - station, axis=1)) / truth.range_sigma
    assert abs(error.mean()) < 0.02
    assert abs(error.std() - 1.0) < 0.02
    rays = truth.surface - station
    hits = square.scene.cast(station, rays)
    np.testing.assert_allclose(hits.distance, 1.0, atol=1e-9)
    # Where two surfaces touch, rounding decides which one is met.
    assert (hits.primitive != truth.primitive).mean() < 1e-3


def test_without_noise_the_scan_is_the_truth() -> None:
    clean = simulate("square", seed=3, photos=0, points=20_000, scanner=lambda s: s.without_noise())
    np.testing.assert_allclose(clean.scan.xyz, clean.scan_truth.surface, atol=1e-9)


def test_visibility_agrees_with_the_depth_image(square: Simulation) -> None:
    photo = square.photos[0]
    points = square.scan_truth.surface
    visible = photo.visible(points)
    depth, primitive = photo.depth_image
    xy, _ = _core.project(photo.view.core, points)
    inside = np.isfinite(xy[:, 0]) & (xy >= 0).all(axis=1) & (xy[:, 0] <= 359) & (xy[:, 1] <= 239)
    assert not visible[~np.isfinite(xy[:, 0])].any()
    columns, rows = np.round(xy[inside]).astype(int).T
    # A pixel whose neighbourhood is one primitive sees just that one, but for what is thinner than a pixel.
    padded = np.pad(primitive, 1, mode="edge")
    neighbours = np.stack([padded[1 + a : 241 + a, 1 + b : 361 + b] for a in (-1, 0, 1) for b in (-1, 0, 1)])
    even = (neighbours == primitive).all(axis=0)[rows, columns]
    same = primitive[rows, columns] == square.scan_truth.primitive[inside]
    assert even.sum() > 10_000
    assert (visible[inside][even] != same[even]).mean() < 2e-3
    distance = np.linalg.norm(points[inside] - photo.view.core.centre, axis=1)
    seen = even & same
    assert np.median(np.abs(distance[seen] - depth[rows, columns][seen]) / distance[seen]) < 0.005
    assert 0.05 < 1 - visible[inside].mean() < 0.6, "the square is there to hide things"


def test_the_same_seed_gives_the_same_bits_and_another_another_scene(square: Simulation) -> None:
    again = simulate("square", seed=3, draft=True, size=(360, 240), photos=1, points=60_000)
    np.testing.assert_array_equal(again.scan.xyz, square.scan.xyz)
    np.testing.assert_array_equal(again.photos[0].image, square.photos[0].image)
    np.testing.assert_array_equal(again.photos[0].points[0].xy, square.photos[0].points[0].xy)
    other = simulate("square", seed=4, photos=0, points=60_000)
    assert len(other.scan) != len(square.scan)


def test_the_options_do_not_change_the_scene(square: Simulation) -> None:
    other = simulate("square", seed=3, draft=True, size=(90, 60), photos=1, points=10_000)
    assert other.scene.parts.rows == square.scene.parts.rows
    np.testing.assert_array_equal(other.photos[0].start.pose.rotation, square.photos[0].start.pose.rotation)


def test_a_georeferenced_frame_shows_the_same_picture(square: Simulation) -> None:
    frame = Frame.turned(0.7, (500_000.0, 5_000_000.0, 100.0))
    moved = simulate("square", seed=3, draft=True, size=(360, 240), photos=1, points=60_000, frame=frame)
    a, b = square.photos[0], moved.photos[0]
    np.testing.assert_allclose(frame.to_scene(moved.scan.xyz), square.scan.xyz, atol=1e-5)
    difference = np.abs(a.image.astype(int) - b.image.astype(int)).max(axis=2)
    assert (difference > 3).mean() < 0.01
    here, _ = _core.project(a.view.core, square.scan_truth.surface)
    there, _ = _core.project(b.view.core, moved.scan_truth.surface)
    # The translation vector has seven digits before the point; what is left is its rounding.
    np.testing.assert_allclose(there, here, atol=1e-4)
    np.testing.assert_array_equal(
        a.visible(square.scan_truth.surface[:5000]), b.visible(moved.scan_truth.surface[:5000])
    )


def test_near_infrared_is_not_the_visible(square: Simulation) -> None:
    truth = square.scan_truth
    names = np.array(square.scene.objects)[truth.object]
    leaves = np.isin(names, ["tree", "shrub"]) & (truth.reflectance[:, 3] > 0.5)
    assert leaves.sum() > 50
    visible = truth.reflectance[leaves, :3].mean(axis=1)
    assert (truth.reflectance[leaves, 3] > 2.5 * visible).mean() > 0.95


def test_what_does_not_exist_is_refused_in_one_line() -> None:
    with pytest.raises(InvalidInputError, match="no scene 'moon'; choose one of"):
        simulate("moon")
    with pytest.raises(InvalidInputError, match="2 viewpoints, 9 photos wanted"):
        simulate("square", photos=9, points=10)


def test_what_is_written_can_be_read_and_projects_rightly(tmp_path: Path) -> None:
    frame = Frame.turned(0.3, (500_000.0, 5_000_000.0, 100.0))
    simulation = simulate("trial", seed=6, draft=True, size=(320, 240), points=20_000, frame=frame)
    files = write_simulation(simulation, tmp_path / "out")
    assert {f.name for f in files} == {
        "scan.laz",
        "photo-1.jpg",
        "photo-1-points.csv",
        "photo-1-camera.json",
        "start.json",
        "truth.json",
        "simulation.json",
    }
    cloud = read_cloud(tmp_path / "out" / "scan.laz")
    np.testing.assert_allclose(cloud.xyz, simulation.scan.xyz, atol=1e-4)
    np.testing.assert_array_equal(cloud.intensity, simulation.scan.intensity)
    truth, start = (read_registration(tmp_path / "out" / n).views[0] for n in ("truth.json", "start.json"))
    xyz, xy = np.array([p.xyz for p in truth.points]), np.array([p.xy for p in truth.points])
    np.testing.assert_allclose(_core.project(truth.core, xyz)[0], xy, atol=1e-4)
    assert np.abs(_core.project(start.core, xyz)[0] - xy).max() > 1.0
    measured = read_points(tmp_path / "out" / "photo-1-points.csv")
    assert [p.name for p in measured] == [p.name for p in truth.points]
    assert truth.image is not None
    assert truth.image.is_file()
    what = json.loads((tmp_path / "out" / "simulation.json").read_text())
    assert what["photos"][0]["translation"] == pytest.approx((truth.pose.centre - start.pose.centre).tolist(), abs=1e-6)


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "colourreg_rs.cli", "simulate", *arguments], capture_output=True, text=True, check=False
    )


def test_the_command_puts_in_the_errors_that_it_is_told(tmp_path: Path) -> None:
    out = tmp_path / "sim"
    options = "--size 160x120 --points 4000 --rotation 1,-2,0.5 --translation 0.1,0,0 --principal-point 4,-3"
    more = "--distortion k1=-0.01 --blunders 0.25 --offset 5e5,5e6,100 --yaw 30 --pixel-noise 0"
    done = run("trial", "--out", str(out), "--seed", "3", *options.split(), *more.split())
    assert done.returncode == 0, done.stderr
    start, truth = (read_registration(out / n).views[0] for n in ("start.json", "truth.json"))
    assert truth.camera.params["cx"] - start.camera.params["cx"] == pytest.approx(4.0)
    assert truth.camera.params["k1"] - start.camera.params["k1"] == pytest.approx(-0.01)
    moved = np.linalg.norm(truth.pose.centre - start.pose.centre)
    assert moved == pytest.approx(0.1, abs=1e-6)
    assert truth.pose.centre[1] > 4.9e6
    assert (out / "photo-1.png").is_file()
    what = json.loads((out / "simulation.json").read_text())
    np.testing.assert_allclose(np.degrees(what["photos"][0]["rotation"]), [1, -2, 0.5], atol=1e-6)
    control = [p for p in truth.points if p.role == "control"]
    assert len(what["photos"][0]["blunders"]) == round(0.25 * len(control)) > 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("moon",), "no scene 'moon'"),
        (("trial", "--size", "10"), "--size '10' is not 2 finite numbers"),
        (("trial", "--rotation", "1,2"), "--rotation '1,2' is not 1 or 3 finite numbers"),
        (("trial", "--distortion", "k1"), "'k1' is not NAME=VALUE"),
        (("trial", "--camera", "BOX"), "--camera 'BOX' is not one of PINHOLE"),
        (("trial", "--blunders", "7"), "--blunders 7.0 is not a share"),
    ],
)
def test_wrong_options_are_refused_in_one_line(arguments: tuple[str, ...], said: str, tmp_path: Path) -> None:
    done = run(*arguments, "--out", str(tmp_path / "x"))
    assert done.returncode == 1
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "x").exists()
