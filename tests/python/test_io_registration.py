"""Registration and camera files: what is written is read, minimal files are accepted, errors name their place."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from colourreg_rs import Camera, ControlPoint, Covariance, FileError, Pose, Registration, View
from colourreg_rs.io.registration import read_camera, read_registration, write_camera, write_registration

CAMERA = {
    "model": "OPENCV",
    "width": 4000,
    "height": 3000,
    "params": {"fx": 3100.0, "fy": 3100, "cx": 1999.5, "cy": 1499.5},
}
POSE = {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": [0.0, 0.0, 0]}
DLT = [[3100, 0, 1999.5, 0], [0, 3100, 1499.5, 0], [0, 0, 1, 0]]
HEAD = {"format": "colourreg-registration", "version": 1}


def store(path: Path, data: object) -> Path:
    path.write_text(json.dumps(data))
    return path


def test_everything_comes_back(tmp_path, rng):
    camera = Camera(
        "FULL_OPENCV", 640, 480, {"fx": 500.123456789012345, "fy": 1000 / 3, "cx": 319.5, "cy": 239.5, "k6": -1e-300}
    )
    pose = Pose.looking_at([1e6 + 1 / 3, 5.7e6, 3], [1e6, 5.7e6 + 10, 4])
    a = rng.normal(size=(6, 6))
    point = ControlPoint(
        "Ü 1",
        np.array([1, 2, 1 / 3]),
        np.array([4, 5.5]),
        "check",
        np.ones(3),
        np.ones(2),
        np.array([0.1, -0.2]),
        "used",
    )
    views = (
        View(
            "one",
            tmp_path / "photos" / "a b.jpg",
            camera,
            pose,
            covariance=Covariance(("rx", "ry", "rz", "cx_world", "cy_world", "cz_world"), a @ a.T),
            method="resection",
            points=(point,),
            statistics={"rms": np.float64(0.5), "dof": np.int64(7), "odd": float("nan"), "list": np.arange(3.0)},
        ),
        View("two", None, dlt=rng.normal(size=(3, 4)), dlt_distortion={"k1": 0.1}, size=(640, 480)),
    )
    registration = Registration(views, tmp_path / "scan.laz", 'PROJCS["x"]')
    path = tmp_path / "r.json"
    write_registration(path, registration)
    back = read_registration(path)
    assert back.cloud == tmp_path / "scan.laz" and back.crs_wkt == 'PROJCS["x"]'
    one, two = back.views
    assert one.image == tmp_path / "photos" / "a b.jpg" and one.name == "one" and one.method == "resection"
    assert one.camera == camera
    assert one.pose.rotation.tobytes() == pose.rotation.tobytes()
    assert one.pose.translation.tobytes() == pose.translation.tobytes()
    assert one.covariance.parameters == views[0].covariance.parameters
    assert one.covariance.matrix.tobytes() == views[0].covariance.matrix.tobytes()
    assert one.statistics == {"rms": 0.5, "dof": 7, "odd": None, "list": [0, 1, 2]}
    (p,) = one.points
    assert (p.name, p.role, p.status) == ("Ü 1", "check", "used") and p.xyz.tobytes() == point.xyz.tobytes()
    assert p.residual_xy.tolist() == [0.1, -0.2] and p.sigma_xyz.tolist() == [1, 1, 1]
    assert two.dlt.tobytes() == views[1].dlt.tobytes() and two.size == (640, 480) and two.dlt_distortion == {"k1": 0.1}
    assert two.image is None and two.core is not None
    data = json.loads(path.read_text())
    assert data["cloud"] == "scan.laz" and data["views"][0]["image"] == "photos/a b.jpg"
    write_registration(tmp_path / "again.json", back)
    assert (tmp_path / "again.json").read_bytes() == path.read_bytes()


def test_the_minimal_file(tmp_path):
    path = store(
        tmp_path / "r.json",
        {**HEAD, "views": [{"image": "p 1.jpg", "camera": CAMERA, "pose": POSE}, {"image": "q.png", "dlt": DLT}]},
    )
    one, two = read_registration(path).views
    assert one.name == "p 1" and one.image == tmp_path / "p 1.jpg" and one.camera.params["k1"] == 0
    assert two.name == "q" and two.dlt.tolist() == DLT and two.size is None and two.image_size is None


def test_the_example_of_the_documentation(tmp_path):
    view = {
        "name": "photo-1", "image": "photo-1.jpg", "camera": CAMERA, "pose": POSE, "dlt": None, "covariance": None,
        "method": "resection", "statistics": {"sigma0": 1.0, "dof": 10},
        "points": [{"name": "T1", "role": "control", "xyz": [0, 0, 0], "xy": [0, 0], "residual_xy": [0, 0],
                    "status": "used"}],
    }  # fmt: skip
    path = store(
        tmp_path / "r.json", {**HEAD, "cloud": "scan.laz", "crs_wkt": None, "views": [view], "later": {"a": 1}}
    )
    registration = read_registration(path)
    assert registration.views[0].points[0].status == "used" and registration.cloud == tmp_path / "scan.laz"


def test_a_redundant_matrix_is_accepted_when_it_says_the_same(tmp_path):
    view = {"image": "p.jpg", "camera": CAMERA, "pose": POSE}
    path = store(tmp_path / "r.json", {**HEAD, "views": [{**view, "dlt": (-np.array(DLT) / 7).tolist()}]})
    assert read_registration(path).views[0].dlt is None
    other = np.array(DLT)
    other[0, 0] = 3105
    path = store(tmp_path / "r.json", {**HEAD, "views": [{**view, "dlt": other.tolist()}]})
    with pytest.raises(FileError, match=r"views\[0\]: dlt and camera with pose contradict"):
        read_registration(path)


def test_a_camera_beside_a_matrix_gives_its_size(tmp_path):
    path = store(tmp_path / "r.json", {**HEAD, "views": [{"image": "p.jpg", "camera": CAMERA, "dlt": DLT}]})
    assert read_registration(path).views[0].size == (4000, 3000)


def test_paths_written_on_windows(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "p.jpg").write_bytes(b"")
    path = store(tmp_path / "r.json", {**HEAD, "views": [{"image": "photos\\p.jpg", "dlt": DLT}]})
    assert read_registration(path).views[0].image == tmp_path / "photos" / "p.jpg"


def changed(*keys: object, value: object) -> dict:
    data = json.loads(json.dumps({**HEAD, "views": [{"image": "p.jpg", "camera": CAMERA, "pose": POSE}]}))
    part = data
    for key in keys[:-1]:
        part = part[key]
    part[keys[-1]] = value
    return data


V = ("views", 0)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ([], ["is no registration"]),
        ({}, ["is no registration", "colourreg-registration"]),
        (CAMERA, ["is a camera, not a registration"]),
        (changed("version", value=2), ["version 2", "newer"]),
        (changed("version", value="1"), ["version '1'"]),
        (changed("views", value=[]), ["views: ", "at least 1"]),
        (changed("views", value={}), ["views: "]),
        (changed(*V, "camera", value=None), ["views[0]: needs camera and pose, or dlt"]),
        (changed(*V, "pose", value=None), ["views[0]: needs camera and pose, or dlt"]),
        (changed(*V, "camera", "params", "fx", value="3100"), ["views[0].camera.params.fx", "number", '"3100"']),
        (changed(*V, "camera", "params", "fx", value=-1.0), ["views[0]", "-1"]),
        (changed(*V, "camera", "params", "cx", value=1e300), ["views[0]", "cx = 1e300", "4000 × 3000"]),
        *[
            (changed(*V, "camera", "params", name, value=value), ["views[0]", f"({name} = ", "80 pixels"])
            for name, value in itertools.product(("k1", "k2", "k3", "p1", "p2"), (1e300, -1e300))
        ],
        (changed(*V, "camera", "params", "k1", value=0.1 * 3100**2), ["views[0]", "not on pixels"]),
        (changed(*V, "camera", "params", value={"fx": 1, "fy": 1, "cx": 0}), ["views[0]", "lacks cy"]),
        (changed(*V, "camera", "params", "k9", value=1), ["views[0]", "k9"]),
        (changed(*V, "camera", "width", value=0), ["views[0].camera.width", "greater than 0", "not 0"]),
        (changed(*V, "camera", "width", value=4000.5), ["views[0].camera.width"]),
        (changed(*V, "camera", "model", value="SIMPLE"), ["views[0].camera.model", "OPENCV_FISHEYE"]),
        (changed(*V, "pose", "rotation", 1, value=[0, 1]), ["views[0].pose.rotation[1]"]),
        (changed(*V, "pose", "rotation", 1, value=[0, 2, 0]), ["views[0]", "not a rotation matrix"]),
        (changed(*V, "pose", "translation", 2, value=None), ["views[0].pose.translation[2]"]),
        (changed(*V, "dlt", value=[[1, 2], [3, 4]]), ["views[0].dlt[0]"]),
        (changed(*V, "dlt_distortion", value={"k7": 1}), ["views[0].dlt_distortion.k7"]),
        (changed(*V, "covariance", value={"parameters": ["rx"], "matrix": [[1, 0]]}), ["views[0].covariance", "1 x 1"]),
        (changed(*V, "points", value=[{"name": "a", "xyz": [0, 0, 0], "xy": [0]}]), ["views[0].points[0].xy"]),
        (changed(*V, "points", value=[{"name": "a", "role": "x", "xyz": [0, 0, 0], "xy": [0, 0]}]), ["points[0].role"]),
    ],
)
def test_errors_name_their_place(tmp_path, data, words):
    path = store(tmp_path / "r.json", data)
    with pytest.raises(FileError) as caught:
        read_registration(path)
    message = str(caught.value)
    assert "\n" not in message and str(path) in message and len(message) < 400
    for word in words:
        assert word in message, message


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "is empty"),
        ("{", "line 1"),
        ('{"format": NaN}', "holds NaN"),
        ('{"format": -Infinity}', "holds -Infinity"),
        ('{"format": 1, "format": 2}', "twice"),
        ("[" * 100_000, "JSON"),
        (
            json.dumps({**HEAD, "views": [{"image": "p", "dlt": [[1e999] * 4] * 3}]}).replace("Infinity", "1e999"),
            "views[0]",
        ),
    ],
)
def test_what_is_no_json_is_refused(tmp_path, text, word):
    path = tmp_path / "r.json"
    path.write_text(text)
    with pytest.raises(FileError) as caught:
        read_registration(path)
    assert word in str(caught.value) and "\n" not in str(caught.value)


def test_bytes_that_are_no_text(tmp_path):
    path = tmp_path / "r.json"
    path.write_bytes(b"\xff\xfe\x00\xd8")
    for read in (read_registration, read_camera):
        with pytest.raises(FileError, match="UTF-8"):
            read(path)


def test_cameras(tmp_path):
    camera = Camera("OPENCV_FISHEYE", 640, 480, {"fx": 300.1, "fy": 300, "cx": 319.5, "cy": 239.5, "k1": 1 / 3})
    path = tmp_path / "c.json"
    write_camera(path, camera)
    assert read_camera(path) == camera
    assert read_camera(store(path, {"model": "EQUIRECTANGULAR", "width": 100, "height": 50})).model == "EQUIRECTANGULAR"
    for data, word in (
        ({**HEAD, "views": []}, "is a registration"),
        ({"a": 1}, "is no camera"),
        ({**CAMERA, "width": -3}, "width"),
        ({**CAMERA, "params": {"fx": 1}}, "lacks fy"),
    ):
        with pytest.raises(FileError, match=word):
            read_camera(store(path, data))


json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-10, 10**6)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=8,
)
places = st.sampled_from(
    [
        ("views",),
        V,
        (*V, "camera"),
        (*V, "pose"),
        (*V, "camera", "params"),
        (*V, "dlt"),
        (*V, "points"),
        (*V, "covariance"),
        (*V, "size"),
        (*V, "statistics"),
    ]
)


@settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True
)
@given(places, json_values)
def test_anything_anywhere_ends_in_a_registration_or_in_one_line(tmp_path, place, value):
    path = store(tmp_path / "r.json", changed(*place, value=value))
    try:
        read_registration(path)
    except FileError as error:
        assert "\n" not in str(error) and str(path) in str(error)


def test_importing_the_package_does_not_load_what_files_need():
    heavy = ("pydantic", "PIL", "laspy", "lazrs", "tifffile")
    code = f"import sys, colourreg_rs; print([m for m in {heavy} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
