"""DLT against the truth, against SciPy's optimum, on published data, and where it has to refuse."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.linalg import rq
from scipy.optimize import least_squares

from colourreg_rs import DegenerateError, InvalidInputError, Pose, _core

SIZE = (4000, 3000)
UTM = np.array([456_789.0, 5_812_345.0, 143.0])


def configuration(rng, n=12, depth=8.0, terms=(), shift=0.0):
    """Control points in a box before a camera with skew and unequal scales, and their exact pixels."""
    f = rng.uniform(2000, 6000)
    K = np.array(
        [
            [f, rng.normal(0, 10), 2000 + rng.normal(0, 80)],
            [0, f * rng.uniform(0.9, 1.1), 1500 + rng.normal(0, 80)],
            [0, 0, 1],
        ]
    )
    reach = 0.8 * 2000 / f
    z = rng.uniform(20 - depth / 2, 20 + depth / 2, n)
    local = np.stack([rng.uniform(-reach, reach, n) * z, rng.uniform(-0.75 * reach, 0.75 * reach, n) * z, z], 1)
    centre = rng.normal(0, 20, 3) + shift
    pose = Pose.looking_at(centre, centre + rng.normal(0, 1, 3) * [1, 1, 0.3])
    xyz = np.ascontiguousarray(local @ pose.rotation + centre)
    P = K @ np.hstack([pose.rotation, (-pose.rotation @ centre)[:, None]])
    view = _core.View.dlt(P, *SIZE, np.array(terms or [0.0] * 5))
    return xyz, _core.project(view, xyz)[0], view


def test_noise_free_points_give_the_truth_at_both_ends_of_the_world(rng):
    for shift in (0.0, UTM):
        for method in (11, 12):
            for _ in range(20):
                xyz, xy, view = configuration(rng, n=int(rng.integers(6, 30)), shift=shift)
                result = _core.estimate_dlt(xyz, xy, *SIZE, method=method)
                limit = 1e-7 if np.any(shift) else 1e-9
                assert np.linalg.norm(result.view.centre - view.centre) < 1e4 * limit
                assert np.abs(result.view.params[:2] / view.params[:2] - 1).max() < 1e3 * limit
                # The third row is the depth, in metres.
                depth = xyz @ result.matrix[2, :3] + result.matrix[2, 3]
                assert np.abs(depth - _core.project(view, xyz)[1]).max() < 1e4 * limit
                assert result.rmse < 1e-4


def test_200_noisy_configurations_reach_scipys_optimum(rng):
    for _ in range(200):
        xyz, exact, _ = configuration(rng, n=int(rng.integers(7, 40)))
        xy = exact + rng.normal(0, 0.5, exact.shape)
        result = _core.estimate_dlt(xyz, xy, *SIZE)
        middle, scale = xyz.mean(0), np.linalg.norm(xyz - xyz.mean(0), axis=1).mean()
        homogeneous = np.hstack([(xyz - middle) / scale, np.ones((len(xyz), 1))])

        def residuals(h, homogeneous=homogeneous, xy=xy):
            p = homogeneous @ np.append(h, 1.0).reshape(3, 4).T
            return (p[:, :2] / p[:, 2:] - xy).ravel()

        # The same matrix in SciPy's frame is its start: from anywhere near, it must find nothing better.
        M = result.matrix.copy()
        M[:, 3] += M[:, :3] @ middle
        M[:, :3] *= scale
        start = (M / M[2, 3]).ravel()[:11]
        best = least_squares(
            residuals, start * (1 + rng.normal(0, 1e-4, 11)), x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        assert np.sqrt(2 * best.cost / (2 * len(xyz))) == pytest.approx(result.rms, rel=1e-9)
        assert np.abs(best.fun - result.residuals.ravel()).max() < 1e-4


def test_the_same_at_utm_coordinates(rng):
    for _ in range(20):
        xyz, exact, _ = configuration(rng, n=15)
        xy = exact + rng.normal(0, 0.5, exact.shape)
        here, there = _core.estimate_dlt(xyz, xy, *SIZE), _core.estimate_dlt(xyz + UTM, xy, *SIZE)
        assert np.abs(here.residuals - there.residuals).max() < 1e-4
        assert np.linalg.norm(here.view.centre + UTM - there.view.centre) < 1e-5
        assert np.abs(here.part_covariance / there.part_covariance - 1).max() < 1e-3


def test_distortion_terms_are_found(rng):
    truth = [-0.06, 0.02, 0.001, -0.0008, 0.0]
    xyz, xy, _ = configuration(rng, n=60, terms=truth)
    result = _core.estimate_dlt(xyz, xy, *SIZE, distortion=["k1", "k2", "p1", "p2"])
    assert result.view.params[4:] == pytest.approx(truth, abs=1e-7)
    assert result.parameters[12:] == ["k1", "k2", "p1", "p2"]
    assert _core.estimate_dlt(xyz, xy, *SIZE).rms > 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("method", "distortion"), [(11, []), (12, []), (11, ["k1"])])
def test_the_stated_covariance_is_the_scatter_of_1000_simulations(rng, method, distortion):
    n, sigma = 20, 0.6
    terms = [-0.05, 0, 0, 0, 0] if distortion else ()
    xyz, exact, view = configuration(rng, n=n, depth=12.0, terms=terms)
    names, parts, stated = None, [], []
    for _ in range(1000):
        result = _core.estimate_dlt(
            xyz, exact + rng.normal(0, sigma, exact.shape), *SIZE, method=method, distortion=distortion, sigma_xy=sigma
        )
        names = result.part_parameters
        values = dict(zip(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"), result.view.params, strict=True))
        values |= dict(zip(("cx_world", "cy_world", "cz_world"), result.view.centre, strict=True))
        values["skew"] = result.view.skew
        turn = result.view.rotation @ view.rotation.T
        values |= dict(zip(("rx", "ry", "rz"), 0.5 * (turn - turn.T)[[2, 0, 1], [1, 2, 0]], strict=True))
        parts.append([values[name] for name in names])
        stated.append(result.part_covariance / result.sigma0**2)  # a priori: sigma is known here
    parts, stated = np.array(parts), np.mean(stated, axis=0)
    found = np.cov(parts.T)
    # The scatter's own relative error is 1/sqrt(2 * 999) = 2.2 % of a sigma; four of them.
    ratio = np.sqrt(np.diag(found) / np.diag(stated))
    assert np.abs(ratio - 1).max() < 0.10, dict(zip(names, ratio.round(3), strict=True))
    # All directions at once: the mean of the quadratic form is the number of parameters.
    inverse = np.linalg.inv(stated)
    d = parts - parts.mean(0)
    mean = np.einsum("ij,jk,ik->i", d, inverse, d).mean()
    assert mean == pytest.approx(len(names), rel=0.10)


def test_the_matrix_covariance_is_that_of_its_parts(rng):
    xyz, exact, _ = configuration(rng, n=20)
    result = _core.estimate_dlt(xyz, exact + rng.normal(0, 0.5, exact.shape), *SIZE, sigma_xy=0.5)
    C = result.covariance
    assert C.shape == (12, 12) and np.allclose(C, C.T)
    # Scaling the third row's direction changes nothing: no variance along it.
    g = np.zeros(12)
    g[8:11] = result.matrix[2, :3]
    assert abs(g @ C @ g) < 1e-9 * np.trace(C[8:11, 8:11])
    # Propagated to a pixel it is what the parts say.
    p = np.append(xyz[0] + 0.2, 1.0)
    x, y, w = result.matrix @ p
    J = np.zeros((2, 12))
    J[0, :4], J[1, 4:8], J[0, 8:], J[1, 8:] = p / w, p / w, -x / w**2 * p, -y / w**2 * p
    _, _, d_pose, d_params = _core.project_jacobians(result.view, np.ascontiguousarray(p[None, :3]))
    columns = dict(zip(("rx", "ry", "rz", "cx_world", "cy_world", "cz_world"), d_pose[0].T, strict=True))
    columns |= dict(zip(("fx", "fy", "cx", "cy"), d_params[0].T[:4], strict=True))
    yd = (y / w - result.view.params[3]) / result.view.params[1]
    columns["skew"] = np.array([yd, 0.0])
    G = np.stack([columns[name] for name in result.part_parameters], axis=1)
    assert J @ C @ J.T == pytest.approx(G @ result.part_covariance @ G.T, rel=1e-6)


def test_points_in_one_plane_are_refused_with_their_number(rng):
    xyz, xy, view = configuration(rng, n=20)
    flat = xyz.copy()
    flat[:, 2] = 1.0
    with pytest.raises(DegenerateError, match=r"one plane.*thickness.*resection"):
        _core.estimate_dlt(flat, xy, *SIZE)
    # Nearly a plane, with noise: either refused, or the covariance says so.
    for thin in (0.01, 0.1, 0.5):
        exact_points = xyz.copy()
        centre = view.centre
        axis = view.rotation[2]
        depth = (xyz - centre) @ axis
        exact_points = centre + (xyz - centre) * ((20 + (depth - 20) * thin / 8) / depth)[:, None]
        exact_points = np.ascontiguousarray(exact_points)
        pixels = _core.project(view, exact_points)[0] + rng.normal(0, 1.0, xy.shape)
        try:
            result = _core.estimate_dlt(exact_points, pixels, *SIZE, sigma_xy=1.0)
        except DegenerateError:
            continue
        error = np.linalg.norm(result.view.centre - centre)
        k = result.part_parameters.index("cx_world")
        assert error < 5 * np.sqrt(np.trace(result.part_covariance[k : k + 3, k : k + 3]))


def test_points_that_determine_nothing_are_refused(rng):
    xyz, xy, _ = configuration(rng, n=20)
    with pytest.raises(InvalidInputError, match="5 control points are too few.*at least 6"):
        _core.estimate_dlt(xyz[:5].copy(), xy[:5].copy(), *SIZE)
    with pytest.raises(DegenerateError):
        _core.estimate_dlt(np.repeat(xyz[:4], 5, axis=0), np.repeat(xy[:4], 5, axis=0), *SIZE)
    with pytest.raises((DegenerateError, InvalidInputError)):
        _core.estimate_dlt(xyz, rng.uniform(0, 3000, xy.shape), *SIZE)
    mirrored = xyz * [1, 1, -1]
    with pytest.raises(InvalidInputError, match="left-handed"):
        _core.estimate_dlt(mirrored, xy, *SIZE)


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_four_real_cameras_with_published_matrices(data_dir, number):
    folder = data_dir / "mcsc_strawlab"
    rows = np.loadtxt(folder / f"cam{number}.points4cal.dat")
    published = np.loadtxt(folder / "Pmatrices.dat").reshape(4, 3, 4)[number - 1]
    rms = [0.334, 0.266, 0.285, 0.337][number - 1]
    xyz, xy = np.ascontiguousarray(rows[:, :3]), np.ascontiguousarray(rows[:, 4:6])
    # A self-calibration knows no handedness: this one's frame is left-handed, which is noticed, and mirrored here.
    with pytest.raises(InvalidInputError, match="left-handed"):
        _core.estimate_dlt(xyz, xy, 659, 494)
    xyz[:, 2] *= -1
    published = published * [1, 1, -1, 1]
    text = (folder / f"basename{number}.rad").read_text()
    k = [float(re.search(rf"kc{i}\s*=\s*([-\d.eE+]+)", text)[1]) for i in (1, 2, 3, 4)]
    theirs = _core.View.dlt(published, 659, 494, np.array([*k, 0.0]))
    centre = theirs.centre
    with_terms = _core.estimate_dlt(xyz, xy, 659, 494, distortion=["k1", "k2", "p1", "p2"])
    # Their distortion has a centre of its own beside the matrix's principal point: two parameters that ours lacks.
    # SciPy, in both models: ours is the optimum of the one, and the other reaches the published figure.
    start = published.ravel() / np.linalg.norm(published)
    own = np.eye(3)
    for (i, j), key in {(0, 0): "11", (1, 1): "22", (0, 2): "13", (1, 2): "23"}.items():
        own[i, j] = float(re.search(rf"K{key}\s*=\s*([-\d.eE+]+)", text)[1])

    def misclosure(v: np.ndarray) -> np.ndarray:
        matrix, terms = v[:12].reshape(3, 4), v[12:16]
        calibration = rq(matrix[:, :3])[0]
        calibration = calibration @ np.diag(np.sign(np.diag(calibration)))
        calibration /= calibration[2, 2]
        if len(v) > 16:
            calibration = own.copy()
            calibration[:2, 2] = v[16:]
        q = np.c_[xyz, np.ones(len(xyz))] @ matrix.T @ np.linalg.inv(calibration).T
        x, y = (q[:, :2] / q[:, 2:]).T
        r, (k1, k2, p1, p2) = x * x + y * y, terms
        d = 1 + k1 * r + k2 * r * r
        bent = np.c_[x * d + 2 * p1 * x * y + p2 * (r + 2 * x * x), y * d + p1 * (r + 2 * y * y) + 2 * p2 * x * y]
        return (bent @ calibration[:2, :2].T + calibration[:2, 2] - xy).ravel()

    scale = np.r_[np.abs(start), np.full(4, 0.01)]
    common = {"xtol": 1e-15, "ftol": 1e-15, "max_nfev": 2000}
    same = least_squares(misclosure, np.r_[start, k], x_scale=scale, **common)
    assert with_terms.rmse == pytest.approx(np.sqrt(2 * np.mean(same.fun**2)), rel=1e-4)
    richer = least_squares(misclosure, np.r_[start, k, own[:2, 2]], x_scale=np.r_[scale, 1, 1], **common)
    assert np.sqrt(2 * np.mean(richer.fun**2)) < rms < 1.4 * with_terms.rmse
    sigma = np.sqrt(np.diag(with_terms.part_covariance)[3:6])
    assert np.abs(with_terms.view.centre - centre).max() < 12 * sigma.max()
    assert _core.estimate_dlt(xyz, xy, 659, 494).rmse > 3 * with_terms.rmse


def test_a_real_target_sheet_is_refused(data_dir):
    export = np.loadtxt(data_dir / "dbat_camcal" / "measurements" / "markpts.txt", delimiter=",", comments="#")
    photo = export[export[:, 0] == export[0, 0]]
    # One square metre of targets on a sheet: the four fixed corners span it.
    grid = np.stack([photo[:, 1] % 10, photo[:, 1] // 10, 0 * photo[:, 1]], 1)
    with pytest.raises(DegenerateError, match="one plane"):
        _core.estimate_dlt(np.ascontiguousarray(grid), np.ascontiguousarray(photo[:, 2:4]), 2272, 1704)
