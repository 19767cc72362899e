"""The command line: exit codes, one-line errors, and the same results as the API."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from colourreg_rs import Camera, ControlPoint, FileError, PointCloud, Pose, Registration, View, _core
from colourreg_rs.io.atomic import write_text
from colourreg_rs.io.clouds import open_cloud, read_cloud, write_cloud
from colourreg_rs.io.images import read_photo, write_image
from colourreg_rs.io.points import read_points, write_points
from colourreg_rs.io.registration import read_registration, write_camera, write_registration
from colourreg_rs.register import RegisterOptions, register_photo

CAMERA = Camera("OPENCV", 600, 400, {"fx": 500.0, "fy": 500.0, "cx": 299.5, "cy": 199.5, "k1": -0.04})
REGISTER = ["register", "scan.laz", "photo.png", "--points", "points.csv", "--camera", "camera.json"]
START = ["--method", "sci", "--init", "registration.json", "--out", "x.json"]
POSE = Pose.looking_at([500_000.0, 5_800_000.0, 102.0], [500_001.0, 5_800_010.0, 103.0])


def colourreg(*arguments: object, cwd=None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "colourreg_rs.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=300)


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """A wall with a step before a camera: scan, photo, camera, control and check points."""
    folder = tmp_path_factory.mktemp("job")
    rng = np.random.default_rng(5)
    view = View("photo", None, CAMERA, POSE)
    u, v = rng.uniform(-8, 8, 60_000), rng.uniform(-4, 6, 60_000)
    xyz = np.stack([500_001 + u, np.where(u > 1, 5_800_009.0, 5_800_011.0), 102 + v], 1)
    write_cloud(folder / "scan.laz", PointCloud(xyz, intensity=rng.integers(0, 60_000, len(xyz)).astype(np.uint16)))
    yy, xx = np.mgrid[0:400, 0:600]
    write_image(folder / "photo.png", np.stack([xx % 256, yy % 256, (xx + yy) % 256], 2).astype(np.uint8))
    write_camera(folder / "camera.json", CAMERA)
    xy, _ = _core.project(view.core, xyz)
    inside = np.flatnonzero((xy > 20).all(1) & (xy < [580, 380]).all(1))[:16]
    points = [
        ControlPoint(f"T{i}", xyz[k], xy[k] + rng.normal(0, 0.2, 2), "control" if i < 12 else "check")
        for i, k in enumerate(inside)
    ]
    write_points(folder / "points.csv", points)
    registered = register_photo(
        folder / "scan.laz", folder / "photo.png", points=folder / "points.csv", camera=folder / "camera.json"
    )
    registered.save(folder / "registration.json")
    registered.save(folder / "twin.json")
    broken = json.loads((folder / "twin.json").read_text())
    broken["views"][0]["camera"]["params"] |= {"fx": 8.0, "fy": 8.0}
    (folder / "in_millimetres.json").write_text(json.dumps(broken))
    write_cloud(folder / "nowhere.ply", PointCloud(np.full((5, 3), np.nan)))
    return folder


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_a_photo_that_is_cut_off_is_refused_before_anything_is_done(job, tmp_path, suffix):
    photo, out = tmp_path / f"photo{suffix}", tmp_path / "registration.json"
    write_image(photo, read_photo(job / "photo.png").pixels)
    data = photo.read_bytes()
    photo.write_bytes(data[: int(0.8 * len(data))])
    register = ["--points", job / "points.csv", "--camera", job / "camera.json", "--out", out]
    for command in (["info", photo], ["register", job / "scan.laz", photo, *register]):
        done = colourreg(*command)
        assert done.returncode == 1 and not out.exists()
        assert len(done.stderr.splitlines()) == 1 and str(photo) in done.stderr


def test_register_colourise_evaluate(job):
    done = colourreg(
        "register", "scan.laz", "photo.png", "--points", "points.csv", "--camera", "camera.json",
        "--out", "registration.json", "--json", "register.json", cwd=job,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "wrote registration.json" in done.stdout and "at the object" in done.stdout
    view = read_registration(job / "registration.json").views[0]
    assert np.linalg.norm(view.pose.centre - POSE.centre) < 0.05
    assert json.loads((job / "register.json").read_text())["trusted"] is True

    done = colourreg("evaluate", "registration.json", "--json", "evaluate.json", cwd=job)
    assert done.returncode == 0, done.stderr
    (evaluation,) = json.loads((job / "evaluate.json").read_text())
    assert evaluation["control"]["n"] == 12 and evaluation["check"]["n"] == 4
    assert evaluation["check"]["rmse"] < 1.0

    done = colourreg("colorize", "scan.laz", "registration.json", "--out", "coloured.laz", "--json", "c.json", cwd=job)
    assert done.returncode == 0, done.stderr
    result = json.loads((job / "c.json").read_text())
    before, after = read_cloud(job / "scan.laz"), read_cloud(job / "coloured.laz")
    assert np.array_equal(before.xyz, after.xyz) and np.array_equal(before.intensity, after.intensity)
    with open_cloud(job / "coloured.laz") as cloud:
        source = np.concatenate([chunk.columns()["ColourSource"] for chunk in cloud.chunks()])
    assert (source > 0).sum() == result["coloured"] > 10_000
    # A point's colour tells its pixel: red is the column, green the row.
    xy, _ = _core.project(view.core, after.xyz)
    # Not where the ramps wrap, nor in the outermost half pixel, which repeats the border.
    plain = (source > 0) & (np.abs(xy % 256 - 128) < 100).all(1) & (xy > 0).all(1) & (xy < [599, 399]).all(1)
    assert np.abs(after.rgb[plain, :2] / 256 - xy[plain] % 256).max() < 0.01
    assert (after.rgb[source == 0] == 0).all()


def test_several_registrations_are_evaluated_together(job, tmp_path):
    first, second, elsewhere = tmp_path / "first.json", tmp_path / "second.json", tmp_path / "elsewhere.json"
    view = View("photo", job / "photo.png", CAMERA, POSE, points=tuple(read_points(job / "points.csv")))
    write_registration(first, Registration((view,), crs_wkt='LOCAL_CS["here"]'))
    write_registration(second, Registration((view, replace(view, name="other")), crs_wkt=None))
    write_registration(elsewhere, Registration((view,), crs_wkt='LOCAL_CS["elsewhere"]'))
    done = colourreg("evaluate", first, second, "--json", tmp_path / "all.json")
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stdout.splitlines() if line.startswith("view ")] == [
        "view first: photo", "view second: photo", "view other",
    ]  # fmt: skip
    assert len(json.loads((tmp_path / "all.json").read_text())) == 3
    (tmp_path / "again").mkdir()
    write_registration(tmp_path / "again" / "second.json", Registration((view,), crs_wkt=None))
    done = colourreg("evaluate", second, tmp_path / "again" / "second.json")
    names = [line for line in done.stdout.splitlines() if line.startswith("view ")]
    assert names == [f"view {second}: photo", "view other", f"view {tmp_path / 'again' / 'second.json'}: photo"]
    for wrong, what in ((first, "is given twice"), (elsewhere, "another coordinate system")):
        done = colourreg("evaluate", second, first, wrong)
        assert done.returncode == 1 and done.stderr.count("\n") == 1
        assert what in done.stderr and str(wrong) in done.stderr


def test_a_registration_given_twice_and_a_sigma_that_is_no_length_are_refused(job, tmp_path):
    write_registration(tmp_path / "r.json", Registration((View("photo", job / "photo.png", CAMERA, POSE),)))
    out = tmp_path / "coloured.laz"
    for options, what in (
        (["r.json", "./r.json"], "is given twice"),
        (["r.json", "--max-sigma", "nan"], "ColourSigma"),
    ):
        done = colourreg("colourise", job / "scan.laz", *options, "--out", out, cwd=tmp_path)
        assert done.returncode == 1 and done.stderr.count("\n") == 1 and what in done.stderr, done.stderr
        assert not out.exists()


def test_what_is_no_registration_is_called_so(job):
    for name, what in (("scan.laz", "is no text"), ("points.csv", "is no JSON")):
        done = colourreg("evaluate", name, cwd=job)
        assert done.returncode == 1 and done.stderr.count("\n") == 1 and what in done.stderr, done.stderr


def test_exchanged_axes_are_refused_however_well_one_wall_fits(job):
    """The mirror image of a wall is a wall: its points fit a view without a residual. The others tell."""
    points = read_points(job / "points.csv")
    middle = np.mean([p.xyz for p in points], axis=0)
    mirrored = [replace(p, xyz=middle + (p.xyz - middle)[[0, 2, 1]]) for p in points]
    write_points(job / "mirrored.csv", mirrored)
    arguments = ["register", "scan.laz", "photo.png", "--points", "mirrored.csv", "--camera", "camera.json"]
    done = colourreg(*arguments, "--out", "mirrored.json", cwd=job)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert "no view that can be trusted" in done.stderr and "--force" in done.stderr
    assert not (job / "mirrored.json").exists()
    done = colourreg(*arguments, "--out", "mirrored.json", "--force", cwd=job)
    assert done.returncode == 0, done.stderr
    view = read_registration(job / "mirrored.json").views[0]
    assert view.statistics["doubts"]


def test_dlt(job):
    done = colourreg(
        "register", "scan.laz", "photo.png", "--points", "points.csv", "--method", "dlt", "--distortion", "k1",
        "--out", "dlt.json", cwd=job,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    view = read_registration(job / "dlt.json").views[0]
    assert view.dlt is not None and view.size == (600, 400)


def test_info(job):
    done = colourreg("info", "scan.laz", "photo.png", "camera.json", "points.csv", "--json", "info.json", cwd=job)
    assert done.returncode == 0, done.stderr
    kinds = [d["kind"] for d in json.loads((job / "info.json").read_text())]
    assert kinds == ["cloud", "photo", "camera", "points"]
    assert "points: 60000" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "file", "problem"),
    [
        (["info", "absent.laz"], "absent.laz", "no such file"),
        (
            ["register", "scan.laz", "absent.png", "--points", "points.csv", "--out", "x.json"],
            "absent.png",
            "does not exist",
        ),
        (["register", "scan.laz", "photo.png", "--points", "camera.json", "--out", "x.json"], "camera.json", ""),
        (["register", "scan.laz", "photo.png", "--out", "x.json"], "", "--points"),
        ([*REGISTER, "--out", "x.json", "--free", "pose,zoom"], "colourreg: `zoom`", "camera of model OPENCV"),
        ([*REGISTER, "--out", "x.json", "--prior", "fx=500+-1"], "colourreg: `fx`", "is not free"),
        ([*REGISTER, "--out", "x.json", "--method", "dlt", "--distortion", "k9"], "colourreg: a DLT", "'k9'"),
        ([*REGISTER, "--out", "x.json", "--free", "pose,f", "--prior", "fx=500±0"], "colourreg: `fx`", "hold `f`"),
        ([*REGISTER, "--out", "x.json", "--free", "f"], "points.csv", "neither free nor held"),
        (["register", "scan.laz", "photo.png", *START, "--free", "f"], "colourreg: method sci", "whole pose"),
        ([*REGISTER, "--out", "x.json", "--sigma", "1e5"], "colourreg: --sigma 100000", "0.0001 to 10000"),
        (["register", "scan.laz", "photo.png", *START, "--free", "pose,zoom"], "colourreg: `zoom`", "camera of model"),
        (["evaluate", "registration.json", "twin.json", "--points", "points.csv"], "belong to one photo", "2 views"),
        (["evaluate", "registration.json", "--cloud", "nowhere.ply"], "nowhere.ply", "finite coordinates"),
        (["sci", "nowhere.ply", "--view", "registration.json", "--out", "x"], "nowhere.ply", "finite coordinates"),
        ([REGISTER[0], "nowhere.ply", *REGISTER[2:], "--out", "x.json"], "nowhere.ply", "finite coordinates"),
        (["colourise", "nowhere.ply", "registration.json", "--out", "x.ply"], "nowhere.ply", "finite coordinates"),
        (["backproject", "nowhere.ply", "registration.json", "--out", "x.ply"], "nowhere.ply", "finite coordinates"),
        (["colourise", "scan.laz", "in_millimetres.json", "--out", "x.laz"], "in_millimetres.json", "no focal length"),
        (["colourise", "scan.laz", "camera.json", "--out", "x.laz"], "camera.json", "format"),
        (["colourise", "photo.png", "registration.json", "--out", "x.laz"], "photo.png", ""),
        (["colourise", "scan.laz", "registration.json", "--out", "scan.laz"], "scan.laz", "input"),
        (["colourise", "scan.laz", "registration.json", "--out", "absent/x.laz"], "x.laz", "folder"),
        (["colourise", "scan.laz", "registration.json", "--out", "x.xyz"], "x.xyz", ""),
        (["evaluate", "points.csv"], "points.csv", "JSON"),
    ],
)
def test_bad_data_is_one_line_and_exit_code_1(job, arguments, file, problem):
    before = sorted(job.iterdir())
    done = colourreg(*arguments, cwd=job)
    assert done.returncode == 1
    assert done.stderr.startswith("colourreg: ") and done.stderr.count("\n") == 1
    assert file in done.stderr and problem in done.stderr
    assert sorted(job.iterdir()) == before


@pytest.mark.parametrize(
    ("arguments", "victim"),
    [
        ([*REGISTER, "--out", "photo.png"], "photo.png"),
        ([*REGISTER, "--out", "x.json", "--json", "points.csv"], "points.csv"),
        ([*REGISTER, "--out", "x.json", "--report", "scan.laz"], "scan.laz"),
        ([*REGISTER, "--init", "registration.json", "--out", "alias"], "registration.json"),
        (["info", "camera.json", "--json", "camera.json"], "camera.json"),
        (["evaluate", "registration.json", "--report", "photo.png"], "photo.png"),
        (["evaluate", "registration.json", "--json", "scan.laz"], "scan.laz"),
        (["colourise", "scan.laz", "registration.json", "--out", "x.laz", "--json", "photo.png"], "photo.png"),
        (["backproject", "scan.laz", "registration.json", "--out", "x.laz", "--json", "alias"], "registration.json"),
        (["sci", "scan.laz", "--view", "registration.json", "--out", "x", "--json", "scan.laz"], "scan.laz"),
    ],
)
def test_no_output_takes_the_place_of_an_input(job, arguments, victim):
    """Under any option, and under another name; and before any work, so that nothing else is written either."""
    (job / "alias").unlink(missing_ok=True)
    (job / "alias").symlink_to(job / "registration.json")
    kept, before = (job / victim).read_bytes(), sorted(job.iterdir())
    done = colourreg(*arguments, cwd=job)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert victim in done.stderr and "would be lost" in done.stderr
    assert (job / victim).read_bytes() == kept and sorted(job.iterdir()) == before


@pytest.mark.parametrize(
    "arguments",
    [
        ["colourise", "scan.laz", "registration.json", "--out", "x.laz", "--json", "absent/x.json"],
        ["colourise", "scan.laz", "registration.json", "--out", "x.laz", "--json", "x.laz"],
        ["evaluate", "registration.json", "--report", "x.html", "--json", "absent/x.json"],
        ["sci", "scan.laz", "--view", "registration.json", "--out", "x", "--json", "absent/x.json"],
        ["sci", "scan.laz", "--view", "registration.json", "--out", "scan.laz"],
        ["simulate", "trial", "--out", "x", "--json", "absent/x.json"],
        ["reproduce", "table2", "--out", "scan.laz"],
        ["demo", "--out", "scan.laz"],
    ],
)
def test_what_cannot_be_written_is_said_before_the_work(job, arguments):
    before = sorted(job.iterdir())
    done = colourreg(*arguments, cwd=job)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert sorted(job.iterdir()) == before


def test_a_write_protected_output_is_not_replaced(job, tmp_path, monkeypatch):
    target = tmp_path / "x.json"
    write_text(target, "kept")
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != target)  # whoever runs the tests may be root
    with pytest.raises(FileError, match="write-protected; permit writing"):
        write_text(target, "new")
    assert target.read_text() == "kept" and list(tmp_path.iterdir()) == [target]


def test_pictures_of_several_views_stay_in_their_folder(job, tmp_path):
    """Names of views come out of files, and may be the same, or lead elsewhere."""
    content = json.loads((job / "registration.json").read_text())
    content["views"] *= 3
    content["views"] = [
        dict(view, name=name) for view, name in zip(content["views"], ["../a", "../a", ".."], strict=True)
    ]
    (job / "three.json").write_text(json.dumps(content))
    done = colourreg("sci", "scan.laz", "--view", "three.json", "--out", tmp_path / "out" / "in", cwd=job)
    assert done.returncode == 0, done.stderr
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["in"]
    assert len(list((tmp_path / "out" / "in").glob("*/view.json"))) == 3


def test_a_lens_taken_as_free_of_distortion_is_suspected(job, tmp_path):
    """Good points are rejected then, the others fit, and the check points tell; with the lens known nothing is said."""
    lens = CAMERA.with_params(fx=520.0, fy=520.0, k1=-0.2)
    rng = np.random.default_rng(8)
    pixels = rng.uniform([5, 5], [595, 395], (22, 2))
    depths = rng.uniform(7.0, 12.0, 22)
    plain = View("photo", None, replace(CAMERA, params={**lens.params, "k1": 0.0}), POSE)
    rays = np.column_stack([(pixels - [299.5, 199.5]) / 520.0, np.ones(22)]) * depths[:, None]
    xyz = (rays - POSE.translation) @ POSE.rotation
    assert np.allclose(_core.project(plain.core, xyz)[0], pixels, atol=1e-4)
    xy, _ = _core.project(View("photo", None, lens, POSE).core, xyz)
    sigma = np.array([0.3, 0.3])
    points = [
        ControlPoint(f"T{i}", a, b, "check" if i % 4 == 3 else "control", None, sigma)
        for i, (a, b) in enumerate(zip(xyz, xy + rng.normal(0, 0.3, xy.shape), strict=True))
    ]
    write_points(tmp_path / "points.csv", points)
    write_camera(tmp_path / "lens.json", lens)
    arguments = {"cloud": job / "scan.laz", "photo": job / "photo.png", "points": tmp_path / "points.csv"}
    for free in (None, ("pose", "f", "k1")):
        said = " ".join(register_photo(**arguments, options=RegisterOptions(free=free)).warnings)
        assert ("--free pose,f,k1" in said) == (free is None)
    assert "check points are off" not in said
    assert "--camera" not in " ".join(register_photo(**arguments, camera=tmp_path / "lens.json").warnings)


def test_photos_that_need_a_colour_profile_are_refused_at_once(job, tmp_path):
    from PIL import Image

    with Image.open(job / "photo.png") as image:
        image.convert("CMYK").save(tmp_path / "photo.jpg")
    done = colourreg(*REGISTER[:2], tmp_path / "photo.jpg", *REGISTER[3:], "--out", "x.json", cwd=job)
    assert done.returncode == 1 and "CMYK" in done.stderr and done.stderr.count("\n") == 1


def _without_cloud(view):
    """A view that looks the other way: the half turn about its vertical axis."""
    pose = view["pose"]
    turn = np.diag([-1.0, 1.0, -1.0])
    pose["rotation"] = (turn @ np.array(pose["rotation"])).tolist()
    pose["translation"] = (turn @ np.array(pose["translation"])).tolist()


@pytest.mark.parametrize(
    ("change", "command", "file", "problem"),
    [
        (lambda v: v["camera"].update(width=601), "sci", "photo.png", "601 x 400"),
        (lambda v: v["camera"].update(width=601), "evaluate", "photo.png", "601 x 400"),
        (lambda v: v["covariance"]["parameters"].__setitem__(0, "banana"), "colourise", "broken.json", "banana"),
        (lambda v: v["covariance"]["matrix"][0].__setitem__(0, -1.0), "info", "broken.json", "variance of rx"),
        (lambda v: v.update(camera=None, pose=None, dlt=[[0.0] * 4] * 3), "colourise", "broken.json", "DLT"),
        (lambda v: v.update(camera=None, pose=None, dlt=[[0.0] * 4] * 3), "sci", "broken.json", "DLT"),
        (lambda v: v["statistics"].update(doubts=5), "colourise", "broken.json", "statistics.doubts"),
        (lambda v: v["statistics"].update(sigma0="abc"), "evaluate", "broken.json", "statistics.sigma0"),
        (_without_cloud, "sci", "broken.json", "no point"),
        (_without_cloud, "colourise", "scan.laz", "none of its points"),
    ],
)
def test_a_broken_registration_is_one_line_from_every_command(job, change, command, file, problem):
    content = json.loads((job / "registration.json").read_text())
    change(content["views"][0])
    (job / "broken.json").write_text(json.dumps(content))
    before = set(job.rglob("*"))
    arguments = {
        "info": ["info", "broken.json"],
        "evaluate": ["evaluate", "broken.json"],
        "colourise": ["colourise", "scan.laz", "broken.json", "--out", "x.laz"],
        "sci": ["sci", "scan.laz", "--view", "broken.json", "--out", "x"],
    }[command]
    done = colourreg(*arguments, cwd=job)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert file in done.stderr and problem in done.stderr and "defect" not in done.stderr
    assert set(job.rglob("*")) == before


def test_points_that_give_no_view_are_named_with_their_file(job):
    points = read_points(job / "points.csv")
    write_points(job / "same.csv", [replace(p, xyz=points[0].xyz, xy=points[0].xy) for p in points])
    done = colourreg("register", "scan.laz", "photo.png", "--points", "same.csv", "--out", "x.json", cwd=job)
    assert done.returncode == 1 and done.stderr.startswith("colourreg: same.csv: ") and done.stderr.count("\n") == 1


def test_a_registration_of_another_place_is_refused_and_nothing_is_written(job):
    content = json.loads((job / "registration.json").read_text())
    content["views"][0]["pose"]["translation"][0] += 5000.0
    (job / "elsewhere.json").write_text(json.dumps(content))
    done = colourreg("colourise", "scan.laz", "elsewhere.json", "--out", "elsewhere.laz", cwd=job)
    assert done.returncode == 1 and "none of its points lies in any photo" in done.stderr
    assert not (job / "elsewhere.laz").exists()


def test_wrong_usage_is_exit_code_2(job):
    for arguments in (["colourise"], ["no-such-command"], ["register", "a", "b", "--out", "c", "--method", "magic"]):
        assert colourreg(*arguments, cwd=job).returncode == 2
    assert colourreg("--version").stdout.startswith("colourreg ")


def test_import_stays_light():
    code = (
        "import sys, colourreg_rs; heavy = 'pydantic typer rich matplotlib tifffile pyproj jinja2 scipy'.split();"
        "print([name for name in heavy if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
