"""The adjustment against SciPy, COLMAP and SciPy's distributions, and what its statistics promise, by example."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest
from adjustment_cases import CALIBRATION, CAMERA, POSE, Case, case, covariances, dlt_case, squared_distance
from scipy import stats
from scipy.optimize import least_squares

from colourreg_rs import Camera, DegenerateError, InvalidInputError, Pose, View, _core

NAMES = {"f": "f", "pp": ("cx", "cy"), "distortion": ("k1", "k2", "p1", "p2")}


def augmented(xyz, xy, problem: Case, project, start: np.ndarray):
    """An independent adjustment: parameters and *adjusted object points* together, by SciPy, with OpenCV's or NumPy's
    projection. Gives parameters, their a posteriori covariance and the square sum."""
    n, u = len(xyz), len(start)

    def residuals(x: np.ndarray) -> np.ndarray:
        points = xyz + x[u:].reshape(n, 3) * problem.sigma_xyz
        photo = (project(start + x[:u] * scale, points) - xy) / problem.sigma_xy
        return np.concatenate([photo.ravel(), x[u:]])

    scale = np.maximum(1e-6 * np.abs(start), 1e-6)
    tolerances = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    found = least_squares(residuals, np.zeros(u + 3 * n), jac="3-point", x_scale="jac", method="lm", **tolerances)
    omega = float(found.fun @ found.fun)
    normal = found.jac.T @ found.jac
    size = np.sqrt(np.diag(normal))
    cofactor = np.linalg.inv(normal / np.outer(size, size)) / np.outer(size, size)
    covariance = cofactor[:u, :u] * np.outer(scale, scale) * omega / (2 * n - u)
    return start + found.x[:u] * scale, covariance, omega


def with_opencv(free: list[str]):
    """Projection by OpenCV as a function of rotation vector, centre and the camera's free parameters."""

    def project(x: np.ndarray, points: np.ndarray) -> np.ndarray:
        p = dict(CAMERA.params)
        rest = list(x[6:])
        if "f" in free:
            p["fx"] = p["fy"] = rest.pop(0)
            p["cx"], p["cy"], p["k1"], p["k2"], p["p1"], p["p2"] = rest
        R = cv2.Rodrigues(x[:3])[0]
        K = np.array([[p["fx"], 0, p["cx"]], [0, p["fy"], p["cy"]], [0, 0, 1]])
        terms = np.array([p["k1"], p["k2"], p["p1"], p["p2"]])
        return cv2.projectPoints(points, x[:3], -R @ x[3:6], K, terms)[0][:, 0]

    return project


@pytest.mark.parametrize(("free", "n"), [(["pose"], 12), (CALIBRATION, 30)], ids=["pose", "calibration"])
def test_the_adjustment_is_that_of_scipy_on_the_augmented_problem(free, n, rng):
    problem = case(n, rng)
    xyz, xy = problem.noisy(rng)
    result = problem.adjust(xyz, xy, free, snoop=False)
    core = result.view
    rotation = cv2.Rodrigues(core.rotation)[0].ravel()
    start = np.concatenate([rotation, core.centre, result.values[6:]])
    away = start + 1e-4 * np.abs(start) * rng.standard_normal(len(start))
    found, covariance, omega = augmented(xyz, xy, problem, with_opencv(free), away)
    sigma = np.sqrt(np.diag(result.covariance))
    assert np.abs((found - start)[3:] / sigma[3:]).max() < 1e-3
    turn = cv2.Rodrigues(cv2.Rodrigues(found[:3])[0] @ core.rotation.T)[0].ravel()
    assert np.abs(turn / sigma[:3]).max() < 1e-3
    statistics = result.statistics()
    assert statistics["omega"] == pytest.approx(omega, rel=1e-7)
    # Covariances differ by second-order terms of the residuals, which first-order statistics leave out, and by SciPy's
    # rotation parameters: a rotation vector, not a small one on the left.
    assert np.abs(np.sqrt(np.diag(covariance))[3:] / sigma[3:] - 1).max() < 3e-3
    mine = result.covariance[3:, 3:] / np.outer(sigma[3:], sigma[3:])
    theirs = covariance[3:, 3:] / np.outer(sigma[3:], sigma[3:])
    assert np.abs(mine - theirs).max() < 6e-3


def test_a_dlt_is_that_of_scipy_on_the_augmented_problem(rng):
    problem = dlt_case(16, rng)
    xyz, xy = problem.noisy(rng)
    result = problem.adjust(xyz, xy, [], dlt=True, snoop=False)
    P = result.view.matrix()

    def project(x: np.ndarray, points: np.ndarray) -> np.ndarray:
        q = np.c_[points, np.ones(len(points))] @ np.append(x, 1.0).reshape(3, 4).T
        return q[:, :2] / q[:, 2:]

    start = (P / P[2, 3]).ravel()[:11]
    found, covariance, omega = augmented(xyz, xy, problem, project, start * (1 + 1e-6 * rng.standard_normal(11)))
    assert result.statistics()["omega"] == pytest.approx(omega, rel=1e-8)
    names, mine = result.dlt_covariance()
    assert names[0] == "h11" and names[11] == "h34" and len(names) == 12
    # From ‖(h31 h32 h33)‖ = 1 to h34 = 1.
    scaled = P.ravel()
    J = np.eye(12)[:11] / scaled[11]
    J[:, 11] = -scaled[:11] / scaled[11] ** 2
    sigma = np.sqrt(np.diag(J @ mine @ J.T))
    assert np.abs((found - start) / sigma).max() < 1e-4
    assert np.abs(np.sqrt(np.diag(covariance)) / sigma - 1).max() < 3e-3
    # The covariance by elements and by camera and pose predict the same.
    a = _core.predict(result.view, names, mine, xyz)[1]
    b = _core.predict(result.view, result.names, result.covariance, xyz)[1]
    assert np.abs(a - b).max() < 1e-6 * np.abs(b).max()


def test_a_pose_and_its_covariance_are_those_of_colmap_where_the_models_coincide(rng):
    pinhole = Camera("PINHOLE", 4000, 3000, {k: CAMERA.params[k] for k in ("fx", "fy", "cx", "cy")})
    problem = case(20, rng, camera=pinhole, sigma_xy=1.0, sigma_xyz=0.0)
    # Small residuals: COLMAP's robust loss is then none.
    xyz, xy = problem.xyz, problem.xy + 1e-3 * rng.standard_normal(problem.xy.shape)
    result = problem.adjust(xyz, xy, ["pose"], snoop=False, estimate_variance=False)
    p = pinhole.params
    # COLMAP's pixel centres are at 0.5.
    camera = pycolmap.Camera(
        model="PINHOLE", width=4000, height=3000, params=[p["fx"], p["fy"], p["cx"] + 0.5, p["cy"] + 0.5]
    )
    start = pycolmap.Rigid3d(pycolmap.Rotation3d(problem.view.core.rotation), problem.view.core.translation)
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.gradient_tolerance = 1e-10
    theirs = pycolmap.refine_absolute_pose(
        start, xy + 0.5, xyz, np.ones(len(xyz), bool), camera, options, return_covariance=True
    )
    found = theirs["cam_from_world"]
    R, t = found.rotation.matrix(), found.translation
    sigma = np.sqrt(np.diag(result.covariance))
    assert np.abs(R - result.view.rotation).max() < 1e-3 * sigma[:3].min()
    assert np.abs(-R.T @ t - result.view.centre).max() < 1e-3 * sigma[3:].min()
    # (rotation on the left, centre) → (half the rotation on the left, a quaternion's own step, and translation)
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    J = np.block([[0.5 * np.eye(3), np.zeros((3, 3))], [-cross, -R]])
    mine = J @ result.covariance @ J.T
    sigma = np.sqrt(np.diag(mine))
    assert np.abs((theirs["covariance"] - mine) / np.outer(sigma, sigma)).max() < 1e-4


def test_a_similarity_is_that_of_scipy(rng):
    R = cv2.Rodrigues(np.array([0.5, -1.0, 2.0]))[0]
    source = rng.uniform(0, 20, (15, 3))
    target = 1.3 * source @ R.T + [100.0, -50.0, 7.0]
    a, b = source + 0.01 * rng.standard_normal((15, 3)), target + 0.004 * rng.standard_normal((15, 3))
    result = _core.adjust_similarity(a, b, covariances(15, 0.01, 3), covariances(15, 0.004, 3), snoop=False)

    def residuals(x: np.ndarray) -> np.ndarray:
        points = a + x[7:].reshape(15, 3) * 0.01
        turned = points @ cv2.Rodrigues(x[1:4])[0].T
        return np.concatenate([((x[0] * turned + x[4:7] - b) / 0.004).ravel(), x[7:]])

    start = np.concatenate([[1.3], cv2.Rodrigues(R)[0].ravel(), [100.0, -50.0, 7.0], np.zeros(45)])
    found = least_squares(residuals, start, jac="3-point", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    scale, rotation, translation = result.similarity
    statistics = result.statistics()
    assert statistics["omega"] == pytest.approx(2 * found.cost, rel=1e-8) and statistics["dof"] == 45 - 7
    sigma = np.sqrt(np.diag(result.covariance))
    assert abs(scale - found.x[0]) < 1e-5 * sigma[0]
    assert np.abs(translation - found.x[4:7]).max() < 1e-4 * sigma[4]
    assert np.abs(rotation - cv2.Rodrigues(found.x[1:4])[0]).max() < 1e-8
    theirs = np.linalg.inv(found.jac.T @ found.jac)[[0, 4, 5, 6]][:, [0, 4, 5, 6]] * 2 * found.cost / 38
    assert np.sqrt(np.diag(theirs)) == pytest.approx(sigma[[0, 4, 5, 6]], rel=1e-3)


def test_limits_and_probabilities_are_those_of_scipy():
    for d in (1, 2, 3, 6, 13):
        assert _core.region_limit(0.95, d) == pytest.approx(stats.chi2.ppf(0.95, d), rel=1e-10)
        assert _core.exceedance(7.3, d) == pytest.approx(stats.chi2.sf(7.3, d), rel=1e-10)
        for dof in (1, 4, 18, 500, 20_000):
            assert _core.region_limit(0.999, d, dof) == pytest.approx(d * stats.f.ppf(0.999, d, dof), rel=1e-7)
            assert _core.exceedance(7.3, d, dof) == pytest.approx(stats.f.sf(7.3 / d, d, dof), rel=1e-9)


def test_the_object_noise_counts_with_its_depth(rng):
    # The same error in the cloud moves a near point further in the photo: it must weigh less.
    problem = case(20, rng, sigma_xy=0.1, sigma_xyz=0.01)
    xyz, xy = problem.noisy(rng)
    result = problem.adjust(xyz, xy, ["pose"], snoop=False, estimate_variance=False)
    statistics = result.statistics()
    near = np.linalg.norm(problem.xyz - problem.view.core.centre, axis=1) < 9
    sigma = np.sqrt(np.linalg.det(statistics["deleted_covariance"])) ** 0.5
    assert sigma[near].min() > sigma[~near].max()
    # Both kinds of corrections: the cloud's take the larger part here.
    assert statistics["group_redundancy"][1] > statistics["group_redundancy"][0] > 0
    assert sum(statistics["group_redundancy"]) == pytest.approx(statistics["dof"], abs=1e-6)
    moved = xyz + statistics["corrections"][:, 2:]
    assert np.abs(_core.project(result.view, moved)[0] - xy - statistics["corrections"][:, :2]).max() < 1e-6


def test_a_scanner_model_weighs_range_and_angles(rng):
    problem = case(30, rng, sigma_xy=0.05, pose=Pose.from_centre(POSE.rotation, np.zeros(3)), depths=(5.0, 60.0))
    # From the camera's own place the range does not matter, the angles do.
    station = problem.view.core.centre.tolist()
    cov_xy = covariances(30, 0.05, 2)

    def sigma(range_: float, angle: float) -> np.ndarray:
        cov = _core.scanner_covariance(problem.xyz, station, range_, angle, angle)
        result = _core.adjust(
            problem.view.core, problem.xyz, problem.xy, cov, cov_xy, ["pose"], snoop=False, estimate_variance=False
        )
        return np.sqrt(np.diag(result.covariance))

    base = sigma(0.0, 1e-4)
    assert sigma(0.05, 1e-4) == pytest.approx(base, rel=1e-6)
    assert (sigma(0.0, 2e-4) > 1.5 * base).all()


def test_data_without_noise_rejects_nothing_and_has_its_geometry_judged(rng):
    problem = case(12, rng)
    result = problem.adjust(problem.xyz, problem.xy, ["pose"])
    statistics = result.statistics()
    assert statistics["rejected"] == [] and statistics["used"].all()
    assert statistics["sigma0"] < 1e-6
    assert np.abs(result.view.centre - problem.view.core.centre).max() < 1e-8


def test_without_redundancy_covariances_are_a_priori_and_nothing_is_tested(rng):
    problem = case(3, rng)
    xyz, xy = problem.noisy(rng)
    result = problem.adjust(xyz, xy, ["pose"])
    statistics = result.statistics()
    assert statistics["dof"] == 0 and statistics["variance_factor"] is None and statistics["variance_test"] is None
    assert statistics["scale"] == 1.0 and statistics["scale_dof"] is None
    assert np.isnan(statistics["p_value"]).all() and np.isfinite(result.covariance).all()
    # No point is controlled by the others: an error of any size stays unseen.
    assert np.isnan(statistics["deleted"]).all() and np.isinf(statistics["effect_on_places"]).all()


def test_picks_in_the_middle_only_say_little_about_the_corners(rng):
    spread = case(16, rng)
    middle = case(16, rng)
    centre = np.array([2000.0, 1500.0])
    middle.xy = np.ascontiguousarray(centre + 0.2 * (middle.xy - centre))
    rays = _core.unproject(middle.view.core, middle.xy)
    middle.xyz = np.ascontiguousarray(middle.view.core.centre + rays * rng.uniform(6, 18, (16, 1)))
    maps = []
    for problem in (spread, middle):
        result = problem.adjust(*problem.noisy(rng), ["pose", "f"], snoop=False, estimate_variance=False)
        maps.append(_core.predicted_error_map(result.view, result.names, result.covariance, 12.0, 9, 7))
    good, bad = maps
    assert good["sigma_px"].shape == (7, 9) and np.isfinite(good["sigma_px"]).all()
    corner = bad["sigma_px"][0, 0] / bad["sigma_px"][3, 4]
    assert corner > 3 and corner > 3 * good["sigma_px"][0, 0] / good["sigma_px"][3, 4]
    assert np.allclose(bad["xy"][0, 0], [0, 0]) and np.allclose(bad["xy"][-1, -1], [3999, 2999])
    # Pixels, metres and radians are one thing.
    range_ = np.linalg.norm(bad["xyz"] - result.view.centre, axis=2)
    assert bad["sigma_object"] == pytest.approx(bad["sigma_angle"] * range_, rel=1e-9)
    assert bad["sigma_angle"][3, 4] == pytest.approx(bad["sigma_px"][3, 4] / 3000, rel=0.02)
    assert (bad["largest_px"] >= bad["sigma_px"]).all()


def test_the_advice_for_the_next_point_comes_true(rng):
    problem = case(9, rng)
    left = problem.xy[:, 0] < 2000
    keep = Case(problem.view, problem.xyz[left], problem.xy[left], problem.sigma_xy, problem.sigma_xyz)
    known = {"snoop": False, "estimate_variance": False}
    before = keep.adjust(keep.xyz, keep.xy, ["pose"], **known)
    grid = _core.predicted_error_map(before.view, before.names, before.covariance, 10.0, 9, 7)
    places = np.ascontiguousarray(grid["xyz"].reshape(-1, 3))
    n = len(places)
    for criterion in ("mean", "largest"):
        advice = _core.next_points(
            before.view, before.names, before.covariance, places, covariances(n, 0.003, 3), covariances(n, 0.5, 2),
            places, criterion=criterion, count=2,
        )  # fmt: skip
        best = advice["candidate"][0]
        figure = advice[f"candidates_{criterion}_px"]
        assert best == np.nanargmin(figure)
        # Where nothing is known: on the other side.
        assert advice["xy"][0, 0] > 2500
        xyz = np.vstack([keep.xyz, places[best]])
        xy = np.vstack([keep.xy, _core.project(keep.view.core, places[best : best + 1])[0]])
        after = keep.adjust(xyz, xy, ["pose"], **known)
        cov = _core.predict(after.view, after.names, after.covariance, places)[1]
        sigma = np.sqrt(np.trace(cov, axis1=1, axis2=2) / 2)
        assert np.sqrt((sigma**2).mean()) == pytest.approx(advice["mean_px"][0, 1], rel=1e-3)
        assert sigma.max() == pytest.approx(advice["largest_px"][0, 1], rel=1e-3)
        key = f"{criterion}_px"
        assert advice[key][0, 1] < advice[key][0, 0] and advice[key][1, 1] < advice[key][1, 0]


def test_check_points_are_judged_by_their_own_covariance(rng):
    problem = case(15, rng)
    result = problem.adjust(*problem.noisy(rng), ["pose"], snoop=False)
    statistics = result.statistics()
    check = case(12, rng, view=problem.view)
    xyz, xy = check.noisy(rng)
    judged = {
        "names": result.names, "covariance": result.covariance,
        "scale": statistics["scale"], "dof": statistics["scale_dof"],
    }  # fmt: skip
    cov = covariances(12, 0.003, 3), covariances(12, 0.5, 2)
    report = _core.check_points(result.view, xyz, xy, *cov, **judged)
    d = xy - _core.project(result.view, xyz)[0]
    assert report["residuals"] == pytest.approx(d)
    assert report["pixels"]["rms"] == pytest.approx(np.sqrt((d**2).sum() / 24))
    assert report["pixels"]["rmse"] == pytest.approx(np.sqrt((d**2).sum() / 12))
    assert report["pixels"]["axes"] == pytest.approx(np.sqrt((d**2).mean(0)))
    # The joint statistic by the whole 24 × 24 covariance.
    _, _, d_pose, _ = _core.project_jacobians(result.view, xyz)
    J = d_pose.reshape(24, 6)
    C = J @ result.covariance @ J.T
    _, d_xyz, _, _ = _core.project_jacobians(result.view, xyz)
    for i in range(12):
        own = d_xyz[i] @ d_xyz[i].T * 0.003**2 + np.eye(2) * 0.25
        C[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += own * statistics["scale"]
    t = d.ravel() @ np.linalg.solve(C, d.ravel())
    assert report["joint_statistic"] == pytest.approx(t / 24, rel=1e-8)
    assert report["joint_p_value"] == pytest.approx(stats.f.sf(t / 24, 24, statistics["dof"]), rel=1e-6)
    assert report["covariance"][3] == pytest.approx(C[6:8, 6:8])
    # A displaced point is noticed; in metres it is off by as much as it was moved across the ray.
    moved = xyz.copy()
    across = np.linalg.svd((xyz[4] - result.view.centre)[None])[2][1]
    moved[4] += 0.1 * across
    bad = _core.check_points(result.view, moved, xy, *cov, **judged)
    assert bad["p_value"][4] < 1e-4 < report["p_value"].min()
    assert np.linalg.norm(bad["offsets"][4]) == pytest.approx(0.1, abs=0.02)
    assert bad["joint_p_value"] < 1e-3


def test_colour_sigma_is_the_propagated_covariance(rng):
    problem = case(20, rng)
    result = problem.adjust(*problem.noisy(rng), CALIBRATION[:2], snoop=False)
    sigma = _core.SurfaceSigma(result.view, result.names, result.covariance, sigma_image=0.4, sigma_xyz=0.002)
    points = case(200, rng, view=problem.view).xyz
    normals = rng.standard_normal(points.shape)
    # The formula, by hand: J_u Σ_u J_uᵀ + J_X Σ_X J_Xᵀ + Σ_image, through the tangent plane's own two directions.
    _, d_xyz, _, _ = _core.project_jacobians(result.view, points)
    _, view_part = _core.predict(result.view, result.names, result.covariance, points)
    expected = np.empty(200)
    for i in range(200):
        total = view_part[i] + d_xyz[i] @ d_xyz[i].T * 0.002**2 + np.eye(2) * 0.4**2
        T = np.linalg.svd(normals[i][None])[2][1:].T
        G = np.linalg.inv(d_xyz[i] @ T)
        expected[i] = np.sqrt(np.trace(G @ total @ G.T) / 2)
    assert sigma.exact(points, normals) == pytest.approx(expected, rel=1e-9)
    cosine = np.abs(((points - result.view.centre) * normals).sum(1))
    cosine /= np.linalg.norm(points - result.view.centre, axis=1) * np.linalg.norm(normals, axis=1)
    steep = cosine > 0.02
    assert sigma.at(points, normals=normals)[steep] == pytest.approx(expected[steep], rel=4e-3)
    # Only the points of the asked source are written, wherever they lie in the chunk.
    source = rng.integers(0, 3, 200).astype(np.uint16)
    out = np.full(200, np.nan, np.float32)
    sigma.fill_where(points, source, 2, out, normals=normals)
    assert np.isnan(out[source != 2]).all()
    # They are rounded to eight binary places, which packs better.
    assert out[source == 2] == pytest.approx(sigma.at(points, normals=normals)[source == 2], rel=2**-9 + 1e-6)
    with pytest.raises(ValueError, match=r"normals must be .*\(200, 3\)"):
        sigma.at(points, normals=normals[:5].copy())


def test_what_cannot_be_worked_with_is_refused_in_a_line(rng):
    problem = case(10, rng)
    xyz, xy = problem.noisy(rng)
    cov = covariances(10, 0.003, 3), covariances(10, 0.5, 2)
    view = problem.view.core

    def refused(match: str, **changes):
        given = {"xyz": xyz, "xy": xy, "cov_xyz": cov[0], "cov_xy": cov[1], "free": ["pose"]} | changes
        with pytest.raises((InvalidInputError, DegenerateError), match=match) as caught:
            _core.adjust(view, **given)
        assert "\n" not in str(caught.value)

    refused("alpha = 2", alpha=2.0)
    refused("`fz` cannot be free", free=["fz"])
    bad = xy.copy()
    bad[3, 0] = np.nan
    refused("point 4 holds values that are not finite", xy=bad)
    skew = cov[1].copy()
    skew[5] = [[1.0, 2.0], [2.0, 1.0]]
    refused("covariance of point 6 is not one", cov_xy=skew)
    refused("point 1 .* without any uncertainty", cov_xy=0 * cov[1], cov_xyz=0 * cov[0])
    refused("a prior on `cx`, which is not free", priors=(["cx"], [1990.0], np.eye(1)))
    refused("not positive definite", priors=(["rx"], [0.0], np.zeros((1, 1))))
    refused("constraint on `f`", constraints=[([("f", 1.0)], 3000.0)])
    refused("2 names of priors, 1 values", priors=(["rx", "ry"], [0.0], np.eye(2)))
    behind = np.ascontiguousarray(2 * view.centre - xyz)
    refused("point 1 has no place", xyz=behind)
    with pytest.raises(TypeError, match="unexpected keyword .alhpa"):
        problem.adjust(xyz, xy, ["pose"], alhpa=0.01)
    with pytest.raises(ValueError, match=r"cov_xyz must be .*\(10, 3, 3\)"):
        _core.adjust(view, xyz, xy, cov[0][:5].copy(), cov[1], ["pose"])
    coplanar = dlt_case(16, rng)
    rays = _core.unproject(coplanar.view.core, coplanar.xy)
    wall = rays / (rays @ np.array([0.6, -0.3, 0.7]))[:, None] * 10 + coplanar.view.core.centre
    coplanar.xyz = np.ascontiguousarray(wall)
    coplanar.xy = _core.project(coplanar.view.core, coplanar.xyz)[0]
    for points in ((coplanar.xyz, coplanar.xy), coplanar.noisy(rng)):
        with pytest.raises(DegenerateError, match="determine"):
            coplanar.adjust(*points, [], dlt=True, snoop=False)


def test_georeferenced_coordinates_lose_nothing(rng):
    problem = case(15, rng)
    xyz, xy = problem.noisy(rng)
    shift = np.array([456_789.0, 5_812_345.0, 143.0])
    pose = Pose.from_centre(POSE.rotation, POSE.centre + shift)
    there = Case(View("there", None, CAMERA, pose), xyz + shift, xy, 0.5, 0.003)
    a = problem.adjust(xyz, xy, CALIBRATION[:3], snoop=False)
    b = there.adjust(xyz + shift, xy, CALIBRATION[:3], snoop=False)
    sigma = np.sqrt(np.diag(a.covariance))
    assert np.abs((b.view.centre - shift - a.view.centre) / sigma[3:6]).max() < 1e-4
    assert np.sqrt(np.diag(b.covariance)) == pytest.approx(sigma, rel=1e-5)
    names, matrix = b.names, b.covariance
    assert _core.predict(b.view, names, matrix, xyz + shift)[1] == pytest.approx(
        _core.predict(a.view, names, a.covariance, xyz)[1], rel=1e-4
    )
    assert squared_distance(a.values[6:] - b.values[6:], a.covariance[6:, 6:]) < 1e-8
