"""Projection against OpenCV, against itself in an inverse and in a moved frame, and its derivatives."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from colourreg_rs import Camera, InvalidInputError, Pose, View, _core
from colourreg_rs.model import PARAMETER_NAMES

MODELS = list(PARAMETER_NAMES)


def random_camera(model: str, rng: np.random.Generator) -> Camera:
    width, height = int(rng.integers(600, 6000)), int(rng.integers(400, 4000))
    if model == "EQUIRECTANGULAR":
        return Camera(model, 2 * height, height)
    f = rng.uniform(0.6, 2.5) * max(width, height) * (0.25 if model == "OPENCV_FISHEYE" else 1.0)
    params = {
        "fx": f, "fy": f * rng.uniform(0.95, 1.05),
        "cx": width / 2 + rng.normal(0, 30), "cy": height / 2 + rng.normal(0, 30),
    }  # fmt: skip
    size = {"k1": 0.1, "k2": 0.03, "k3": 0.01, "p1": 2e-3, "p2": 2e-3, "k4": 0.05, "k5": 0.02, "k6": 0.01}
    if model == "OPENCV_FISHEYE":
        size = {"k1": 0.03, "k2": 0.01, "k3": 0.003, "k4": 0.001}
    params |= {name: rng.normal(0, size[name]) for name in PARAMETER_NAMES[model][4:]}
    return Camera(model, width, height, params)


def random_pose(rng: np.random.Generator, spread: float = 20.0) -> Pose:
    rotation, _ = cv2.Rodrigues(rng.normal(0, 1.5, 3))
    return Pose.from_centre(rotation, rng.normal(0, spread, 3))


def points_in_front(view: View, rng: np.random.Generator, n: int, max_angle: float | None = None) -> np.ndarray:
    """World points inside the valid field of the view."""
    limit = 0.97 * min(view.core.max_angle, max_angle or np.pi)
    if view.camera.model in ("PINHOLE", "OPENCV", "FULL_OPENCV"):
        limit = min(limit, np.arctan(0.9))
    theta, phi, range_ = rng.uniform(0, limit, n), rng.uniform(-np.pi, np.pi, n), rng.uniform(5, 80, n)
    local = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], 1) * range_[:, None]
    return np.ascontiguousarray(local @ view.pose.rotation + view.pose.centre)


def inside_the_image(camera: Camera, xy: np.ndarray) -> np.ndarray:
    return (xy >= -0.5).all(1) & (xy < np.array([camera.width, camera.height]) - 0.5).all(1)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"])
def test_projection_agrees_with_opencv_to_1e_9_px(model, rng):
    for _ in range(50):
        view = View("v", None, random_camera(model, rng), random_pose(rng))
        xyz = points_in_front(view, rng, 2000, np.pi / 2)
        p = view.camera.params
        K = np.array([[p["fx"], 0, p["cx"]], [0, p["fy"], p["cy"]], [0, 0, 1.0]])
        terms = np.array([p[name] for name in PARAMETER_NAMES[model][4:]])
        rvec, tvec = cv2.Rodrigues(view.pose.rotation)[0], view.pose.translation.copy()
        if model == "OPENCV_FISHEYE":
            expected = cv2.fisheye.projectPoints(xyz[:, None], rvec, tvec, K, terms)[0][:, 0]
        else:
            expected = cv2.projectPoints(xyz, rvec, tvec, K, terms if len(terms) else None)[0][:, 0]
        xy, depth = _core.project(view.core, xyz)
        inside = inside_the_image(view.camera, xy)
        assert inside.sum() > 50
        assert np.abs(xy - expected)[inside].max() < 1e-9
        assert np.abs(xy - expected).max() < 1e-12 * np.abs(expected).max() + 1e-8
        local = xyz @ view.pose.rotation.T + view.pose.translation
        truth = np.linalg.norm(local, axis=1) if model == "OPENCV_FISHEYE" else local[:, 2]
        assert np.abs(depth - truth).max() < 1e-10


def test_a_panorama_follows_its_definition(rng):
    view = View("v", None, Camera("EQUIRECTANGULAR", 4000, 2000), random_pose(rng))
    xyz = points_in_front(view, rng, 500)
    X, Y, Z = (xyz @ view.pose.rotation.T + view.pose.translation).T
    r = np.sqrt(X**2 + Y**2 + Z**2)
    expected = np.stack(
        [(np.arctan2(X, Z) / (2 * np.pi) + 0.5) * 4000 - 0.5, (0.5 + np.arcsin(Y / r) / np.pi) * 2000 - 0.5],
        1,
    )
    xy, depth = _core.project(view.core, xyz)
    assert np.abs(xy - expected).max() < 1e-8
    assert np.abs(depth - r).max() < 1e-11


@pytest.mark.parametrize("model", MODELS)
def test_unproject_inverts_project(model, rng):
    for _ in range(20):
        view = View("v", None, random_camera(model, rng), random_pose(rng))
        xyz = points_in_front(view, rng, 200)
        xy, _ = _core.project(view.core, xyz)
        ok = np.isfinite(xy).all(1)
        assert ok.mean() > 0.95
        rays = _core.unproject(view.core, np.ascontiguousarray(xy[ok]))
        towards = xyz[ok] - view.pose.centre
        towards /= np.linalg.norm(towards, axis=1)[:, None]
        assert np.linalg.norm(np.cross(rays, towards), axis=1).max() < 1e-9
        assert (np.einsum("ij,ij->i", rays, towards) > 0).all()


@pytest.mark.parametrize("model", MODELS)
def test_nothing_is_lost_at_utm_coordinates(model, rng):
    shift = np.array([456_789.0, 5_812_345.0, 143.0])
    for _ in range(20):
        camera, pose = random_camera(model, rng), random_pose(rng)
        here = View("here", None, camera, pose)
        there = View("there", None, camera, Pose.from_centre(pose.rotation, pose.centre + shift))
        xyz = points_in_front(here, rng, 2000)
        a, _ = _core.project(here.core, xyz)
        b, _ = _core.project(there.core, xyz + shift)
        inside = inside_the_image(camera, a)
        assert inside.sum() > 50
        assert np.abs(a - b)[inside].max() < 1e-5


@pytest.mark.parametrize("model", MODELS)
def test_derivatives_agree_with_differences(model, rng):
    view = View("v", None, random_camera(model, rng), random_pose(rng))
    xyz = points_in_front(view, rng, 40)
    xy, d_xyz, d_pose, d_params = _core.project_jacobians(view.core, xyz)
    assert np.array_equal(xy, _core.project(view.core, xyz)[0], equal_nan=True)
    camera, pose, h = view.camera, view.pose, 1e-5

    def at(camera: Camera, pose: Pose, points: np.ndarray) -> np.ndarray:
        return _core.project(View("v", None, camera, pose).core, np.ascontiguousarray(points))[0]

    def check(analytic: np.ndarray, plus: np.ndarray, minus: np.ndarray, step: float) -> None:
        numeric = (plus - minus) / (2 * step)
        # A panorama jumps where longitude wraps.
        ok = np.isfinite(numeric).all(1) & (np.abs(plus - minus).max(1) < 100)
        assert ok.sum() > 20
        assert np.abs(analytic - numeric)[ok].max() < 1e-5 * (1 + np.abs(numeric[ok]).max())

    for k in range(3):
        e = h * np.eye(3)[k]
        check(d_xyz[:, :, k], at(camera, pose, xyz + e), at(camera, pose, xyz - e), h)
        turned = [Pose.from_centre(cv2.Rodrigues(s * e)[0] @ pose.rotation, pose.centre) for s in (1, -1)]
        check(d_pose[:, :, k], at(camera, turned[0], xyz), at(camera, turned[1], xyz), h)
        moved = [Pose.from_centre(pose.rotation, pose.centre + s * e) for s in (1, -1)]
        check(d_pose[:, :, 3 + k], at(camera, moved[0], xyz), at(camera, moved[1], xyz), h)
    for k, name in enumerate(PARAMETER_NAMES[model]):
        step = 1e-3 if name in ("fx", "fy", "cx", "cy") else 1e-7
        value = camera.params[name]
        cameras = [camera.with_params(**{name: value + s * step}) for s in (1, -1)]
        check(d_params[:, :, k], at(cameras[0], pose, xyz), at(cameras[1], pose, xyz), step)


def test_points_behind_the_camera_are_never_visible(rng):
    for model in ("PINHOLE", "OPENCV", "FULL_OPENCV"):
        view = View("v", None, random_camera(model, rng), random_pose(rng))
        behind = 2 * view.pose.centre - points_in_front(view, rng, 100)
        assert np.isnan(_core.project(view.core, behind)[0]).all()
    in_the_centre = view.pose.centre[None].copy()
    assert np.isnan(_core.project(view.core, in_the_centre)[0]).all()


def test_points_beyond_the_fold_of_a_distortion_are_never_visible():
    # A barrel whose polynomial brings points 60 degrees aside back into the photo.
    terms = {"k1": -0.108145, "k2": -0.138668, "p1": -0.00379757, "p2": -0.00484127}
    camera = Camera("OPENCV", 1920, 1200, {"fx": 2120.29, "fy": 2071.72, "cx": 949.828, "cy": 576.237, **terms})
    view = View("v", None, camera, Pose(np.eye(3), np.zeros(3)))
    limit = np.tan(view.core.max_angle)
    r = np.linspace(0.01, 3, 2000)
    rd = r * (1 + terms["k1"] * r**2 + terms["k2"] * r**4)
    assert limit == pytest.approx(r[np.argmax(rd)], abs=2e-3)
    xy, _ = _core.project(view.core, np.stack([r, 0 * r, 1 + 0 * r], 1))
    assert np.isfinite(xy[r < limit]).all() and np.isnan(xy[r > limit]).all()
    folded_into_the_photo = (rd > 0) & (rd < 0.4) & (r > limit)
    assert folded_into_the_photo.any()


def test_a_fisheye_sees_beside_and_behind():
    camera = Camera("OPENCV_FISHEYE", 2000, 2000, {"fx": 300.0, "fy": 300.0, "cx": 999.5, "cy": 999.5})
    view = View("v", None, camera, Pose(np.eye(3), np.zeros(3)))
    xyz = np.array([[1.0, 0, 0], [1, 0, -1], [0, 0, 2], [0, 0, -2]])
    xy, depth = _core.project(view.core, xyz)
    assert xy[:3] == pytest.approx(
        np.array([[999.5 + 300 * np.pi / 2, 999.5], [999.5 + 300 * 3 * np.pi / 4, 999.5], [999.5, 999.5]])
    )
    assert depth[1] == pytest.approx(np.sqrt(2))
    assert np.isnan(xy[3]).all()  # the one direction that has no image


def test_results_go_into_given_arrays_and_do_not_depend_on_them(rng):
    view = View("v", None, random_camera("OPENCV", rng), random_pose(rng))
    xyz = points_in_front(view, rng, 10_000)
    xy, depth = _core.project(view.core, xyz)
    out_xy, out_depth = np.empty((10_000, 2)), np.empty(10_000)
    returned, _ = _core.project(view.core, xyz, out_xy=out_xy, out_depth=out_depth)
    assert returned is out_xy
    assert np.array_equal(out_xy, xy, equal_nan=True) and np.array_equal(out_depth, depth, equal_nan=True)


def test_arrays_of_the_wrong_kind_are_refused_by_name():
    view = View("v", None, Camera("EQUIRECTANGULAR", 200, 100), Pose(np.eye(3), np.zeros(3)))
    with pytest.raises(TypeError, match=r"xyz must be a C-contiguous float64 array of shape \(N, 3\), not float32"):
        _core.project(view.core, np.zeros((5, 3), np.float32))
    with pytest.raises(ValueError, match=r"xyz .* not float64 of shape \[5, 2\]"):
        _core.project(view.core, np.zeros((5, 2)))
    with pytest.raises(ValueError, match="Fortran order"):
        _core.project(view.core, np.asfortranarray(np.zeros((5, 3))))
    with pytest.raises(TypeError, match="not list"):
        _core.project(view.core, [[0.0, 0.0, 1.0]])
    with pytest.raises(InvalidInputError, match="fx = -1"):
        Camera("PINHOLE", 10, 10, {"fx": -1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0})


def test_a_dlt_matrix_is_the_same_view_as_its_camera_and_pose(rng):
    camera, pose = random_camera("OPENCV", rng), random_pose(rng)
    view = View("v", None, camera, pose)
    P = view.core.matrix() * -3.7
    terms = {name: camera.params[name] for name in ("k1", "k2", "p1", "p2", "k3")}
    same = View("v", None, dlt=P, dlt_distortion=terms, size=(camera.width, camera.height))
    xyz = points_in_front(view, rng, 500)
    assert np.nanmax(np.abs(_core.project(view.core, xyz)[0] - _core.project(same.core, xyz)[0])) < 1e-6
    K, R, C, scaled = _core.decompose_dlt(P)
    assert np.abs(R - pose.rotation).max() < 1e-12 and np.abs(C - pose.centre).max() < 1e-9
    assert K[0, 0] == pytest.approx(camera.params["fx"]) and abs(K[0, 1]) < 1e-8
    depth = xyz @ scaled[2, :3] + scaled[2, 3]
    assert np.abs(depth - _core.project(view.core, xyz)[1]).max() < 1e-10
