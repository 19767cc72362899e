"""Registrations and cameras: round trips bit for bit, minimal files, and refusals that name the place."""

from __future__ import annotations

import json

import numpy as np
import pytest

from colourreg_rs import Camera, ControlPoint, Covariance, FileError, Pose, Registration, View
from colourreg_rs.io.registration import read_camera, read_registration, write_camera, write_registration

CAMERA = Camera("OPENCV", 4000, 3000, {"fx": 3100.0, "fy": 3101.0, "cx": 1999.5, "cy": 1499.5, "k1": -0.05})
POSE = Pose.looking_at([456_789.123456789, 5_812_345.1, 102.3], [456_800.0, 5_812_360.0, 105.0])
MINIMAL = {
    "format": "colourreg-registration",
    "version": 1,
    "views": [
        {
            "image": "photo.jpg",
            "camera": {"model": "PINHOLE", "width": 40, "height": 30, "params": {"fx": 1, "fy": 1, "cx": 0, "cy": 0}},
            "pose": {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": [0, 0, 0]},
        }
    ],
}


def full_registration(folder) -> Registration:
    matrix = np.random.default_rng(1).normal(size=(6, 6))
    names = ("rx", "ry", "rz", "cx_world", "cy_world", "cz_world")
    points = [
        ControlPoint("T1", [1.1, 2.2, 3.3], [100.25, 200.5], "control", [0.001] * 3, [0.5] * 2, [0.1, -0.2], "used"),
        ControlPoint("T2", [1.1, 2.2, 3.3], [100.25, 200.5], "check"),
    ]
    view = View(
        "photo-1", folder / "photos" / "photo-1.jpg", CAMERA, POSE, method="resection", points=points,
        covariance=Covariance(names, matrix @ matrix.T), statistics={"sigma0": 1.1, "dof": 10, "rms": 0.4},
    )  # fmt: skip
    matrix_view = View(
        "by matrix",
        folder / "photo-2.jpg",
        dlt=np.arange(12.0).reshape(3, 4) / 7,
        dlt_distortion={"k1": -0.01},
        size=(40, 30),
    )
    return Registration((view, matrix_view), folder / "scan.laz", "PROJCS[...]")


def test_what_is_written_is_read_bit_for_bit(tmp_path):
    registration = full_registration(tmp_path)
    write_registration(tmp_path / "registration.json", registration)
    back = read_registration(tmp_path / "registration.json")
    assert back.cloud == registration.cloud and back.crs_wkt == registration.crs_wkt
    a, b = registration.views[0], back.views[0]
    assert (a.name, a.image, a.camera, a.method, a.statistics) == (b.name, b.image, b.camera, b.method, b.statistics)
    assert np.array_equal(a.pose.rotation, b.pose.rotation) and np.array_equal(a.pose.translation, b.pose.translation)
    assert a.covariance.parameters == b.covariance.parameters and np.array_equal(
        a.covariance.matrix, b.covariance.matrix
    )
    for p, q in zip(a.points, b.points, strict=True):
        assert (p.name, p.role, p.status) == (q.name, q.role, q.status)
        for name in ("xyz", "xy", "sigma_xyz", "sigma_xy", "residual_xy"):
            assert np.array_equal(getattr(p, name), getattr(q, name))
    c, d = registration.views[1], back.views[1]
    assert np.array_equal(c.dlt, d.dlt) and d.dlt_distortion == {"k1": -0.01} and d.size == (40, 30)


def test_paths_are_relative_to_the_file(tmp_path):
    write_registration(tmp_path / "registration.json", full_registration(tmp_path))
    content = json.loads((tmp_path / "registration.json").read_text())
    assert content["cloud"] == "scan.laz" and content["views"][0]["image"] == "photos/photo-1.jpg"
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "registration.json").rename(tmp_path / "elsewhere" / "registration.json")
    assert read_registration(tmp_path / "elsewhere" / "registration.json").cloud == tmp_path / "elsewhere" / "scan.laz"


def test_a_minimal_file_is_enough_and_unknown_keys_are_left_alone(tmp_path):
    path = tmp_path / "minimal.json"
    path.write_text("\ufeff" + json.dumps({**MINIMAL, "made_by": "another program"}), encoding="utf-8")
    (view,) = read_registration(path).views
    assert view.name == "photo" and view.camera.model == "PINHOLE" and view.covariance is None


def changed(path: str, value) -> str:
    content = json.loads(json.dumps(MINIMAL))
    *parents, last = path.split(".")
    at = content
    for key in parents:
        at = at[int(key)] if isinstance(at, list) else at[key]
    if value is None:
        del at[last]
    else:
        at[last] = value
    return json.dumps(content)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not JSON: line 1"),
        ("[1, 2", "is not JSON"),
        ('{"format": NaN}', "NaN"),
        ("[" * 100_000, "nested|not JSON"),
        ("[]", "the file"),
        (changed("format", "other"), "its format is 'other'"),
        (changed("version", 2), "is of version 2"),
        (changed("views", []), "views: "),
        (changed("views.0.image", None), "views.0.image: field required"),
        (changed("views.0.pose", None), "views.0: lacks its pose"),
        (changed("views.0.dlt", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]), "dlt matrix and a camera"),
        (changed("views.0.camera.model", "PINHOL"), "views.0: camera model 'PINHOL'"),
        (changed("views.0.camera.width", -4), "views.0.camera.width"),
        (changed("views.0.camera.params", {"fx": 1, "fy": 1, "cx": 0}), "lacks cy"),
        (changed("views.0.camera.params", {"fx": 0, "fy": 1, "cx": 0, "cy": 0}), "fx = 0"),
        (changed("views.0.camera.params", {"fx": "wide", "fy": 1, "cx": 0, "cy": 0}), "params.fx: .*found 'wide'"),
        (changed("views.0.pose.rotation", [[1, 0, 0], [0, 1, 0], [0, 0, 2]]), "not a rotation matrix"),
        (changed("views.0.pose.rotation", [[1, 0], [0, 1]]), "rotation"),
        (changed("views.0.pose.translation", [0, 0]), "translation"),
        (changed("views.0.covariance", {"parameters": ["rx"], "matrix": [[1, 2]]}), "covariance has shape"),
        (changed("views.0.points", [{"name": "a", "xyz": [0, 0, 0], "xy": [0, 0], "role": "chekc"}]), "points.0.role"),
    ],
)
def test_what_is_wrong_is_refused_with_its_place_in_one_line(tmp_path, text, message):
    path = tmp_path / "registration.json"
    path.write_text(text)
    with pytest.raises(FileError, match=message) as caught:
        read_registration(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_figures_that_are_not_finite_are_not_written(tmp_path):
    view = View("v", tmp_path / "v.jpg", CAMERA, POSE, statistics={"rms": float("nan")})
    with pytest.raises(FileError, match="not finite"):
        write_registration(tmp_path / "r.json", Registration((view,)))
    assert list(tmp_path.iterdir()) == []


def test_a_camera_alone(tmp_path):
    write_camera(tmp_path / "camera.json", CAMERA)
    assert read_camera(tmp_path / "camera.json") == CAMERA
    (tmp_path / "camera.json").write_text('{"model": "PINHOLE", "width": 4}')
    with pytest.raises(FileError, match="height: field required"):
        read_camera(tmp_path / "camera.json")
