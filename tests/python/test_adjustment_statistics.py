"""Honest figures: what the adjustment promises with a probability, it keeps in that part of many simulations.

Noise is in the photo *and* in the object coordinates. Bounds are those of the promise (93.5 to 96.5 % for 95 %) or,
where the number of simulations decides, three and a half standard errors of a proportion.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from adjustment_cases import CALIBRATION, Case, case, covariances, dlt_case, errors_of, squared_distance
from scipy import stats

from colourreg_rs import Camera, Pose, View, _core

pytestmark = pytest.mark.slow

N = 1000
KNOWN = {"snoop": False, "estimate_variance": False}


def close_to(rate: float, expected: float, trials: int, width: float = 3.5) -> bool:
    return abs(rate - expected) < width * np.sqrt(expected * (1 - expected) / trials)


def squares(d: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", d, np.linalg.solve(covariance, d[:, :, None])[:, :, 0])


SETUPS = {
    "calibrated pose": (lambda rng: case(14, rng), ["pose"], {}),
    "pose, f, pp, distortion": (lambda rng: case(40, rng), CALIBRATION, {}),
    "dlt": (lambda rng: dlt_case(24, rng), [], {"dlt": True}),
}


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("estimated", [True, False], ids=["estimated variance factor", "known"])
def test_regions_of_parameters_and_pixels_hold_the_truth(setup, estimated, rng):
    make, free, keywords = SETUPS[setup]
    problem = make(rng)
    targets = case(30, rng, view=problem.view).xyz
    exact = _core.project(problem.view.core, targets)[0]
    held, pixels, factors, left_out = 0, 0, np.empty(N), 0
    for k in range(N):
        result = problem.adjust(*problem.noisy(rng), free, snoop=False, estimate_variance=estimated, **keywords)
        statistics = result.statistics()
        dof = statistics["scale_dof"]
        assert dof == (statistics["dof"] if estimated else None)
        error = errors_of(result, problem.view)
        held += squared_distance(error, result.covariance) < _core.region_limit(0.95, len(error), dof)
        xy, covariance = _core.predict(result.view, result.names, result.covariance, targets)
        pixels += (squares(xy - exact, covariance) < _core.region_limit(0.95, 2, dof)).mean()
        factors[k] = statistics["variance_factor"]
        test = statistics["variance_test"]
        left_out += not test[3]
    assert 0.935 < held / N < 0.965, held / N
    assert 0.935 < pixels / N < 0.965, pixels / N
    assert abs(factors.mean() - 1) < 3.5 * factors.std() / np.sqrt(N), factors.mean()
    assert close_to(left_out / N, 0.05, N), left_out / N


def test_regions_of_a_similarity_hold_the_truth(rng):
    R = cv2.Rodrigues(np.array([0.5, -1.0, 2.0]))[0]
    source = rng.uniform(-10, 10, (10, 3)) + np.array([200.0, 100.0, 50.0])
    scale, shift = 1.2, np.array([1000.0, -500.0, 70.0])
    target = scale * source @ R.T + shift
    cov = covariances(10, 0.01, 3), covariances(10, 0.02, 3)
    others = rng.uniform(-10, 10, (30, 3)) + np.array([200.0, 100.0, 50.0])
    held, moved, factors = 0, 0, np.empty(N)
    for k in range(N):
        a, b = source + 0.01 * rng.standard_normal((10, 3)), target + 0.02 * rng.standard_normal((10, 3))
        result = _core.adjust_similarity(a, b, *cov, snoop=False)
        s, rotation, translation = result.similarity
        turn = cv2.Rodrigues(rotation @ R.T)[0].ravel()
        # The translation's error belongs to the rotation and scale of the estimate: both are in the covariance.
        error = np.concatenate([[s - scale], turn, translation - shift])
        statistics = result.statistics()
        held += squared_distance(error, result.covariance) < _core.region_limit(0.95, 7, statistics["dof"])
        # Where other points go: derivatives by scale, by a rotation vector on the left, and by translation.
        arms = others @ rotation.T
        rows = np.zeros((30, 3, 7))
        rows[:, :, 0], rows[:, :, 4:] = arms, np.eye(3)
        for axis in range(3):
            rows[:, :, 1 + axis] = s * np.cross(np.eye(3)[axis], arms)
        off = s * arms + translation - (scale * others @ R.T + shift)
        covariance = rows @ result.covariance @ rows.transpose(0, 2, 1)
        moved += (squares(off, covariance) < _core.region_limit(0.95, 3, statistics["dof"])).mean()
        factors[k] = statistics["variance_factor"]
    assert 0.935 < held / N < 0.965, held / N
    assert 0.935 < moved / N < 0.965, moved / N
    assert abs(factors.mean() - 1) < 3.5 * factors.std() / np.sqrt(N)


@pytest.mark.parametrize("estimated", [True, False], ids=["estimated variance factor", "known"])
def test_false_alarms_come_at_the_stated_rate_and_residuals_have_the_stated_covariance(estimated, rng):
    problem = case(14, rng)
    p, left_out, alarms = [], 0, 0
    for _ in range(N):
        statistics = problem.adjust(
            *problem.noisy(rng), ["pose"], snoop=False, estimate_variance=estimated
        ).statistics()
        p.append(statistics["p_value"])
        alarms += (statistics["statistic"] > statistics["critical"]).sum()
        d2 = squares(statistics["deleted"], statistics["deleted_covariance"])
        if not estimated:
            left_out += (d2 < _core.region_limit(0.95, 2)).mean()
    p = np.array(p)
    # Tests of one simulation are a little correlated, which the width allows for.
    for alpha in (0.001, 0.01, 0.05, 0.5):
        assert close_to((p < alpha).mean(), alpha, p.size, 4.5), (alpha, (p < alpha).mean())
    assert alarms == (p < 0.001).sum()
    if not estimated:
        assert 0.935 < left_out / N < 0.965, left_out / N


@pytest.mark.parametrize("estimated", [True, False], ids=["estimated variance factor", "known"])
def test_a_blunder_of_the_minimal_detectable_size_is_found_at_the_stated_power(estimated, rng):
    problem = case(14, rng)
    xyz, xy = problem.noisy(rng)
    statistics = problem.adjust(xyz, xy, ["pose"], snoop=False, estimate_variance=estimated).statistics()
    size = statistics["detectable"] / np.sqrt(statistics["scale"])
    alone = statistics["detectable_observation"] / np.sqrt(statistics["scale"])
    found = dict.fromkeys(("worst direction", "x alone", "Y alone"), 0)
    for k in range(N):
        i = k % 14
        blunders = {
            "worst direction": (np.zeros(3), size[i] * statistics["detectable_direction"][i]),
            "x alone": (np.zeros(3), np.array([alone[i, 0], 0.0])),
            "Y alone": (np.array([0.0, alone[i, 3], 0.0]), np.zeros(2)),
        }
        for name, (in_space, in_photo) in blunders.items():
            a, b = problem.noisy(rng)
            a[i] += in_space
            b[i] += in_photo
            result = problem.adjust(a, b, ["pose"], snoop=False, estimate_variance=estimated).statistics()
            found[name] += result["statistic"][i] > result["critical"]
    for name, count in found.items():
        assert close_to(count / N, 0.80, N), (name, count / N)


def test_snooping_names_the_blunder_and_what_it_would_have_done_stays_below_the_stated_effect(rng):
    problem = case(14, rng)
    clean = problem.adjust(problem.xyz, problem.xy, ["pose"], **KNOWN)
    statistics = clean.statistics()
    grid = _core.predicted_error_map(clean.view, clean.names, clean.covariance, 12.0, 9, 7)["xyz"].reshape(-1, 3)
    grid = np.ascontiguousarray(grid)
    before = _core.project(clean.view, grid)[0]
    for i in range(14):
        blunder = problem.xy.copy()
        blunder[i] += statistics["detectable"][i] * statistics["detectable_direction"][i]
        moved = problem.adjust(problem.xyz, blunder, ["pose"], **KNOWN)
        shift = np.linalg.norm(_core.project(moved.view, grid)[0] - before, axis=1).max()
        # The stated effect is the largest over all directions; at another depth a little more is possible.
        assert shift < 1.25 * statistics["effect_on_places"][i]
        change = np.abs(errors_of(moved, problem.view) - errors_of(clean, problem.view))
        assert (change < 1.05 * statistics["effect_on_parameters"][i]).all()
    named = wrong = 0
    for k in range(N // 2):
        i = k % 14
        xyz, xy = problem.noisy(rng)
        xy[i] += 1.5 * statistics["detectable"][i] * statistics["detectable_direction"][i]
        rejected = [r[0] for r in problem.adjust(xyz, xy, ["pose"], estimate_variance=False).statistics()["rejected"]]
        named += i in rejected
        wrong += any(r != i for r in rejected)
    assert named / (N // 2) > 0.97, named
    assert wrong / (N // 2) < 0.05, wrong


def test_p_values_of_check_points_are_uniform(rng):
    problem = case(14, rng)
    check = case(8, rng, view=problem.view)
    cov = covariances(8, check.sigma_xyz, 3), covariances(8, check.sigma_xy, 2)
    single, joint = [], []
    for _ in range(N):
        result = problem.adjust(*problem.noisy(rng), ["pose"], snoop=False)
        s = result.statistics()
        report = _core.check_points(
            result.view, *check.noisy(rng), *cov,
            names=result.names, covariance=result.covariance, scale=s["scale"], dof=s["scale_dof"],
        )  # fmt: skip
        single.append(report["p_value"][0])
        joint.append(report["joint_p_value"])
    for p in (single, joint):
        assert stats.kstest(p, "uniform").pvalue > 1e-3
        assert close_to(np.mean(np.array(p) < 0.05), 0.05, N)


def test_variance_components_are_right_on_average(rng):
    # Near points show the object's noise, far ones the photo's.
    near, far = case(40, rng, depths=(1.5, 3.0)), case(40, rng, depths=(30.0, 60.0))
    xyz, xy = np.vstack([near.xyz, far.xyz]), np.vstack([near.xy, far.xy])
    problem = Case(near.view, xyz, xy, near.sigma_xy, near.sigma_xyz)
    true_sigmas = 2 * problem.sigma_xy, 0.5 * problem.sigma_xyz
    simulated = Case(problem.view, problem.xyz, problem.xy, *true_sigmas)
    found, sigmas = [], []
    for _ in range(N // 2):
        s = problem.adjust(*simulated.noisy(rng), ["pose"], snoop=False, variance_components=True).statistics()
        factors, stated, _ = s["variance_components"]
        found.append(factors)
        sigmas.append(stated)
        assert s["variance_factor"] == pytest.approx(1.0, abs=1e-3)
    found, sigmas = np.array(found), np.array(sigmas)
    standard_error = found.std(0) / np.sqrt(len(found))
    assert (np.abs(found.mean(0) - [4.0, 0.25]) < 4 * standard_error).all(), found.mean(0)
    assert found.std(0) == pytest.approx(np.sqrt((sigmas**2).mean(0)), rel=0.2)


def surface_errors(truth: View, estimate: _core.View, xyz, normals, sigma_image, sigma_xyz, rng) -> np.ndarray:
    """Brute force: each point of the cloud is off, its colour is taken from the pixel where the estimated view sees it
    (and a little off), and that pixel shows the true surface where the true ray meets it."""
    noisy = xyz + sigma_xyz * rng.standard_normal(xyz.shape)
    pixel = _core.project(estimate, noisy)[0] + sigma_image * rng.standard_normal((len(xyz), 2))
    rays = _core.unproject(truth.core, np.ascontiguousarray(pixel))
    centre = truth.core.centre
    reach = ((xyz - centre) * normals).sum(1) / (rays * normals).sum(1)
    return centre + rays * reach[:, None] - xyz


@pytest.mark.parametrize(
    "setup",
    ["calibrated pose", "pose, f, pp, distortion", "dlt"],
)
def test_colour_sigma_holds_39_86_and_99_percent_of_the_errors(setup, rng):
    make, free, keywords = SETUPS[setup]
    problem = make(rng)
    points = case(40, rng, view=problem.view, depths=(4.0, 25.0)).xyz
    arms = points - problem.view.core.centre
    arms /= np.linalg.norm(arms, axis=1)[:, None]
    # One half faces the camera, where the errors are circular; the other is slanted in every way up to 75 degrees.
    slant = np.where(np.arange(40) % 2 == 0, 0.05, rng.uniform(0.3, 1.3, 40))
    across = np.cross(arms, rng.standard_normal((40, 3)))
    across /= np.linalg.norm(across, axis=1)[:, None]
    normals = np.ascontiguousarray(np.cos(slant)[:, None] * arms + np.sin(slant)[:, None] * across)
    ratios = np.empty((N, 40))
    for k in range(N):
        result = problem.adjust(*problem.noisy(rng), free, **KNOWN, **keywords)
        sigma = _core.SurfaceSigma(result.view, result.names, result.covariance, sigma_image=0.5, sigma_xyz=0.002)
        stated = sigma.exact(points, normals)
        error = surface_errors(problem.view, result.view, points, normals, 0.5, 0.002, rng)
        ratios[k] = np.linalg.norm(error, axis=1) / stated
    facing, slanted = ratios[:, ::2], ratios[:, 1::2]
    for limit, expected in ((1, 1 - np.exp(-0.5)), (2, 1 - np.exp(-2.0)), (3, 1 - np.exp(-4.5))):
        assert abs((facing < limit).mean() - expected) < 0.015, (limit, (facing < limit).mean())
    # Of slanted surfaces the sigma per axis is right in the mean square; their errors are long ellipses, of which more
    # lie inside one sigma and a few more outside three.
    assert (slanted**2).mean() / 2 == pytest.approx(1.0, abs=0.05)
    assert 0.38 < (slanted < 1).mean() < 0.53 and 0.84 < (slanted < 2).mean() < 0.88 and (slanted < 3).mean() > 0.965


def inside(limit: float, ratio: np.ndarray) -> np.ndarray:
    """The part of a normal distribution within a circle of ``limit`` times √(trace / 2), for this ratio of its axes."""
    turn = np.linspace(0, np.pi / 2, 721)
    # In polar coordinates of the whitened plane the radius integrates by itself.
    radius2 = limit**2 * (1 + ratio[:, None] ** 2) / 2 / (np.cos(turn) ** 2 + ratio[:, None] ** 2 * np.sin(turn) ** 2)
    return 1 - np.trapezoid(np.exp(-0.5 * radius2), turn, axis=1) / (np.pi / 2)


def test_colour_sigma_holds_the_errors_on_slanted_surfaces(rng):
    # The whole way of a cloud: slopes come from the noisy points in the depth buffer of the estimated view.
    camera = Camera("OPENCV", 900, 700, {"fx": 700.0, "fy": 700.0, "cx": 452.0, "cy": 347.0, "k1": -0.06, "k2": 0.02})
    view = View("street", None, camera, Pose.looking_at([0, 0, 1.6], [1.0, 10, 1.4]))
    problem = case(20, rng, view=view)
    # A floor, a façade along the street, one across, and a ramp, seen by a scanner beside the camera.
    surfaces = (((0, 0, 1), 0), ((1, 0.1, 0), -3), ((0.1, 1, 0), 14), ((0.1, -0.3, 1), -1.5))
    planes = [(np.array(n) / np.linalg.norm(n), c / np.linalg.norm(n)) for n, c in surfaces]
    pixels = np.stack(np.meshgrid(np.arange(-20, 920, 0.7), np.arange(-20, 720, 0.7)), -1).reshape(-1, 2)
    rays = _core.unproject(view.core, np.ascontiguousarray(pixels))
    rays = rays[np.isfinite(rays).all(1)]
    station = np.array([0.2, -0.1, 1.7])
    reach = np.stack([(c - station @ n) / (rays @ n) for n, c in planes], 1)
    reach[reach <= 0] = np.inf
    nearest = reach.argmin(1)
    exact = station + rays * reach.min(1)[:, None]
    normals = np.array([n for n, _ in planes])[nearest]
    sigma_image, sigma_xyz, trials, taken = 0.5, 0.002, 100, 3000
    errors, slants, ratios = [], [], []
    for _ in range(trials):
        result = problem.adjust(*problem.noisy(rng), ["pose"], **KNOWN)
        noisy = exact + sigma_xyz * rng.standard_normal(exact.shape)
        buffer = _core.DepthBuffer(result.view)
        buffer.add(noisy)
        seen_by = buffer.finish()
        some = np.sort(rng.choice(len(exact), taken, replace=False))
        some = some[seen_by.visible(noisy[some])]
        sigma = _core.SurfaceSigma(
            result.view, result.names, result.covariance, sigma_image=sigma_image, sigma_xyz=sigma_xyz
        )
        stated = sigma.at(noisy[some], planes=seen_by.planes()).astype(float)
        place, normal = exact[some], normals[some]
        pixel = _core.project(result.view, noisy[some])[0] + sigma_image * rng.standard_normal((len(some), 2))
        seen = _core.unproject(view.core, np.ascontiguousarray(pixel))
        arm = place - view.core.centre
        error = seen * ((arm * normal).sum(1) / (seen * normal).sum(1))[:, None] - arm
        cosine = np.abs((arm * normal).sum(1)) / np.linalg.norm(arm, axis=1)
        errors.append(np.linalg.norm(error, axis=1) / stated)
        slants.append(np.degrees(np.arccos(cosine)))
        ratios.append(cosine)
    ratio, slant = np.concatenate(ratios), np.concatenate(slants)
    for low, high in ((0, 45), (45, 60), (60, 70), (70, 78), (78, 84)):
        here = (slant >= low) & (slant < high)
        assert here.sum() > 3_000
        # The points of one trial share its view's error: what is independent are the trials.
        of_trials = [e[(s >= low) & (s < high)] for e, s in zip(errors, slants, strict=True)]
        # Nearer to grazing, one point in a hundred, at the foot of a wall, takes the wall's slope for its own.
        square, off = mean_and_error([(e**2).mean() / 2 for e in of_trials])
        assert abs(square - 1) < (0.04 if high < 80 else 0.15) + 3 * off, (low, square, off)
        # The axes' ratio is about the cosine: a long ellipse has more within one sigma, and less within three.
        for limit in (1, 2, 3):
            expected = inside(limit, ratio[here]).mean()
            found, off = mean_and_error([(e < limit).mean() for e in of_trials])
            assert abs(found - expected) < 0.01 + 3 * off, (low, limit, found, expected, off)


def mean_and_error(values):
    """The mean, and one sigma of it."""
    return np.mean(values), np.std(values) / np.sqrt(len(values))


def test_colour_sigma_from_the_tables_is_as_honest(rng):
    # One view, many points, the whole cloud's way: the mean square over points of one estimate has a view's error only.
    camera = Camera("OPENCV_FISHEYE", 3000, 3000, {"fx": 900.0, "fy": 900.0, "cx": 1499.5, "cy": 1499.5, "k1": 0.01})
    problem = case(20, rng, camera=camera)
    points = case(100, rng, view=problem.view, depths=(4.0, 25.0)).xyz
    facing = np.ascontiguousarray(points - problem.view.core.centre)
    total = np.zeros(100)
    for _ in range(100):
        result = problem.adjust(*problem.noisy(rng), ["pose"], **KNOWN)
        sigma = _core.SurfaceSigma(result.view, result.names, result.covariance, sigma_image=0.5, sigma_xyz=0.002)
        error = surface_errors(problem.view, result.view, points, facing, 0.5, 0.002, rng)
        total += (error**2).sum(1) / 2 / sigma.at(points, normals=facing).astype(float) ** 2
    assert total.mean() / 100 == pytest.approx(1.0, abs=0.05)
