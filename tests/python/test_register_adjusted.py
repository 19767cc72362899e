"""The registration's statistics: sigmas of photo and object, blunders, what is kept in the file; against the truth."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from adjustment_cases import squared_distance

from colourreg_rs import Camera, ControlPoint, InvalidInputError, PointCloud, Pose, View, _core
from colourreg_rs.io.clouds import write_cloud
from colourreg_rs.io.images import write_image
from colourreg_rs.io.points import write_points
from colourreg_rs.io.registration import read_registration, write_camera, write_registration
from colourreg_rs.model import Registration
from colourreg_rs.register import RegisterOptions, register_photo

CAMERA = Camera("OPENCV", 1500, 1000, {"fx": 1300.0, "fy": 1300.0, "cx": 749.5, "cy": 499.5, "k1": -0.05})
POSE = Pose.looking_at([3.0, -2.0, 1.7], [4.0, 8.0, 3.0])
VIEW = View("photo", None, CAMERA, POSE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("adjusted")
    rng = np.random.default_rng(3)
    write_cloud(folder / "scan.ply", PointCloud(rng.uniform([-12, 0, -8], [20, 25, 14], (500, 3))))
    write_image(folder / "photo.png", np.zeros((1000, 1500, 3), np.uint8))
    write_camera(folder / "camera.json", CAMERA)
    return folder


def places(rng, n: int, nearest: float = 5.0, furthest: float = 15.0) -> tuple[np.ndarray, np.ndarray]:
    columns = int(np.ceil(np.sqrt(1.5 * n)))
    cells = np.stack(np.meshgrid(np.arange(columns), np.arange(-(-n // columns))), -1).reshape(-1, 2)[:n]
    xy = (cells + 0.1 + 0.8 * rng.random((n, 2))) / [columns, -(-n // columns)] * [1500, 1000] - 0.5
    rays = _core.unproject(VIEW.core, np.ascontiguousarray(xy))
    xyz = np.ascontiguousarray(POSE.centre + rays * rng.uniform(nearest, furthest, (n, 1)))
    return xyz, _core.project(VIEW.core, xyz)[0]


def register(folder, points, *, camera=True, init=None, **options):
    write_points(folder / "points.csv", points)
    return register_photo(
        folder / "scan.ply", folder / "photo.png", points=folder / "points.csv", init=init,
        camera=folder / "camera.json" if camera else None, options=RegisterOptions(**options),
    )  # fmt: skip


def control(xyz, xy, **more) -> list[ControlPoint]:
    return [ControlPoint(f"T{i:02d}", a, b, **more) for i, (a, b) in enumerate(zip(xyz, xy, strict=True))]


def rejected(result) -> list[str]:
    return [p.name for p in result.view.points if p.status == "rejected"]


def test_coarse_picks_of_unknown_sigma_lose_no_good_point(folder, rng):
    lost, believed = 0, 0
    for _ in range(25):
        xyz, xy = places(rng, 16)
        points = control(xyz, xy + rng.normal(0, 2.0, xy.shape))
        result = register(folder, points)
        lost += len(rejected(result))
        found = result.view.statistics["adjustment"]["sigma_xy_found"]
        assert 1.2 < found < 3.0
        assert result.view.statistics["adjustment"]["variance_test"] is None
        believed += len(rejected(register(folder, points, sigma_xy=0.5)))
    # 400 points at a level of 0.001 each; a stated sigma that is wrong costs far more.
    assert lost <= 3
    assert believed > 20


def test_a_small_blunder_among_sharp_picks_of_unknown_sigma_is_found(folder, rng):
    found = wrong = 0
    for k in range(25):
        xyz, xy = places(rng, 16)
        noisy = xy + rng.normal(0, 0.2, xy.shape)
        angle = rng.uniform(0, 2 * np.pi)
        noisy[k % 16] += 3.0 * np.array([np.cos(angle), np.sin(angle)])
        names = rejected(register(folder, control(xyz, noisy)))
        found += f"T{k % 16:02d}" in names
        wrong += any(name != f"T{k % 16:02d}" for name in names)
    assert found >= 24 and wrong <= 2


def test_noise_in_space_is_not_taken_for_blunders_and_the_regions_hold_the_truth(folder, rng):
    held = np.zeros(3)
    n, lost, runs = 18, 0, 60
    for _ in range(runs):
        xyz, xy = places(rng, n, nearest=2.0, furthest=20.0)
        points = control(
            xyz + rng.normal(0, 0.01, xyz.shape), xy + rng.normal(0, 0.3, xy.shape),
            sigma_xyz=np.full(3, 0.01), sigma_xy=np.full(2, 0.3),
        )  # fmt: skip
        # Known everywhere; the photo's from the residuals; the photo's from the option.
        bare = [ControlPoint(p.name, p.xyz, p.xy, sigma_xyz=p.sigma_xyz) for p in points]
        nothing = [ControlPoint(p.name, p.xyz, p.xy) for p in points]
        results = [
            register(folder, points),
            register(folder, bare),
            register(folder, nothing, sigma_xy=0.3, sigma_xyz=0.01),
        ]
        for k, result in enumerate(results):
            lost += len(rejected(result)) if k != 1 else 0
            c, s = result.view.covariance, result.view.statistics
            assert c.parameters == ("rx", "ry", "rz", "cx_world", "cy_world", "cz_world")
            error = result.view.pose.centre - POSE.centre
            dof = s["adjustment"]["scale_dof"]
            held[k] += squared_distance(error, c.matrix[3:, 3:]) < _core.region_limit(0.95, 3, dof)
        assert np.array_equal(results[0].view.core.centre, results[2].view.core.centre)
    assert (held / runs > 0.85).all(), held / runs
    # Two thousand tests at 0.001.
    assert lost <= 8


def test_what_the_adjustment_says_is_kept_in_the_file(folder, rng):
    xyz, xy = places(rng, 20, nearest=2.0, furthest=30.0)
    noisy = xy + rng.normal(0, 0.3, xy.shape)
    noisy[7] += [60.0, 0.0]
    points = [
        ControlPoint(
            f"T{i:02d}", xyz[i] + rng.normal(0, 0.004, 3), noisy[i], "check" if i % 5 == 4 else "control",
            sigma_xyz=np.full(3, 0.004), sigma_xy=np.full(2, 0.3),
        )
        for i in range(20)
    ]  # fmt: skip
    result = register(folder, points)
    result.save(folder / "registration.json")
    json.dumps(result.as_dict(), allow_nan=False)
    view = read_registration(folder / "registration.json").views[0]
    assert view.statistics == result.view.statistics
    a = view.statistics["adjustment"]
    assert [p.name for p in view.points if p.status == "rejected"] == ["T07"]
    assert a["alpha"] == 0.001 and a["power"] == 0.8 and a["sigma_xy_known"] and a["sigma_xyz_known"]
    assert a["variance_test"]["lower"] < view.statistics["sigma0"] ** 2 < a["variance_test"]["upper"]
    rows = {row["name"]: row for row in a["points"]}
    # Found before the adjustment, so that nothing is adjusted of it.
    assert "T07" not in rows and len(rows) == 15
    for row in rows.values():
        assert len(row["redundancy"]) == 5 and row["detectable"] > 0 and row["effect"] > 0
        assert 0 <= row["p_value"] <= 1
    total = sum(sum(row["redundancy"]) for row in rows.values())
    assert total == pytest.approx(view.statistics["dof"])
    assert len(a["check_points"]) == 4 and a["check"]["pixels"]["rms"] < 3.0
    assert 0.0 < a["check"]["joint_p_value"] <= 1.0
    assert "variance_components" in a or "variance_components_refused" in a


def test_a_blunder_in_a_dlt_is_found_and_left_out(folder, rng):
    pinhole = View("pinhole", None, CAMERA.with_params(k1=0.0), POSE)
    xyz, _ = places(rng, 20)
    xy = _core.project(pinhole.core, xyz)[0] + rng.normal(0, 0.3, (20, 2))
    xy[4] += [15.0, -20.0]
    result = register(folder, control(xyz, xy), camera=False, method="dlt")
    assert rejected(result) == ["T04"] and result.trusted
    kept = np.arange(20) != 4
    alone = register(folder, control(xyz[kept], xy[kept]), camera=False, method="dlt")
    assert np.abs(result.view.dlt - alone.view.dlt).max() < 1e-6 * np.abs(alone.view.dlt).max()
    assert result.view.covariance.parameters[0] == "h11" and len(result.view.covariance.parameters) == 12
    # Least squares of the eleven parameters is the adjustment with exact coordinates in space.
    direct = _core.estimate_dlt(xyz[kept], xy[kept], 1500, 1000)
    a, b = (_core.project(v, xyz)[0] for v in (alone.view.core, direct.view))
    assert np.abs(a - b).max() < 1e-4
    assert alone.view.statistics["sigma0"] * 0.5 == pytest.approx(direct.sigma0, rel=1e-3)


def test_priors_and_held_parameters_come_into_the_adjustment(folder, rng):
    xyz, xy = places(rng, 12)
    noisy = xy + rng.normal(0, 1.0, xy.shape)
    turned = Pose.from_centre(_core_turn([0.05, -0.03, 0.04]) @ POSE.rotation, POSE.centre + np.array([0.3, 0.2, -0.1]))
    write_registration(folder / "init.json", Registration((View("i", folder / "photo.png", CAMERA, turned),)))
    # The truth counted from the turned start.
    back = _vector(POSE.rotation @ turned.rotation.T)
    priors = [f"{n}={float(v)!r}±1e-5" for n, v in zip(("rx", "ry", "rz"), back, strict=True)]
    priors += [f"cx_world={POSE.centre[0]}±0"]
    held = Pose.from_centre(turned.rotation, [POSE.centre[0], *turned.centre[1:]])
    write_registration(folder / "init.json", Registration((View("i", folder / "photo.png", CAMERA, held),)))
    result = register(folder, control(xyz, noisy), init=folder / "init.json", camera=False, priors=tuple(priors))
    assert result.view.covariance.parameters == ("rx", "ry", "rz", "cy_world", "cz_world")
    assert result.view.pose.centre[0] == pytest.approx(POSE.centre[0], abs=1e-9)
    assert np.abs(_vector(result.view.pose.rotation @ POSE.rotation.T)).max() < 5e-5
    # A posteriori the prior's sigma is scaled with everything else.
    scale = np.sqrt(result.view.statistics["adjustment"]["scale"])
    assert result.view.covariance.sigma("rx") < 1.01e-5 * scale


def _core_turn(vector) -> np.ndarray:
    import cv2

    return cv2.Rodrigues(np.array(vector))[0]


def _vector(rotation) -> np.ndarray:
    import cv2

    return cv2.Rodrigues(rotation)[0][:, 0]


def test_impossible_sigmas_are_refused(folder, rng):
    points = control(*places(rng, 8))
    with pytest.raises(InvalidInputError, match=r"-0\.5"):
        register(folder, points, sigma_xy=-0.5)
    with pytest.raises(InvalidInputError, match="nan"):
        register(folder, points, sigma_xyz=float("nan"))


def test_minimal_points_are_registered_and_said_to_be_unchecked(folder, rng):
    xyz, xy = places(rng, 4)
    result = register(folder, control(xyz, xy + rng.normal(0, 0.2, xy.shape)))
    assert result.view.statistics["dof"] == 2
    assert any("redundant" in w for w in result.warnings)


def test_a_dlt_from_twelve_elements_is_adjusted_too(folder, rng):
    # Approximate values differ, the answer does not: blunders named, regions, the same view.
    xyz, _ = places(rng, 30)
    plain = View("plain", None, Camera("PINHOLE", 1500, 1000, dict(list(CAMERA.params.items())[:4])), POSE)
    xy = _core.project(plain.core, xyz)[0] + 0.5 * rng.standard_normal((30, 2))
    xy[4] += [9.0, -4.0]
    points = control(xyz + 0.003 * rng.standard_normal((30, 3)), xy)
    keywords = {"method": "dlt", "sigma_xy": 0.5, "sigma_xyz": 0.003}
    eleven = register(folder, points, **keywords)
    twelve = register(folder, points, dlt_parameters=12, **keywords)
    assert rejected(twelve) == rejected(eleven) == ["T04"]
    assert np.allclose(twelve.view.core.centre, eleven.view.core.centre, atol=1e-7)
    assert np.allclose(twelve.view.covariance.matrix, eleven.view.covariance.matrix, rtol=1e-5, atol=1e-15)
    assert twelve.view.statistics["adjustment"]["points"] and "singular vector" in twelve.notes[0]
    assert "adjusted" in twelve.notes[0] and "NOT" not in twelve.notes[0]
    assert any("does not use" in warning for warning in twelve.warnings)


def test_a_robust_loss_says_that_nothing_is_adjusted(folder, rng):
    xyz, xy = places(rng, 20)
    result = register(folder, control(xyz, xy), loss="huber", sigma_xy=0.5, sigma_xyz=0.003)
    assert "adjustment" not in result.view.statistics
    assert any("nothing is adjusted" in n and "take no part" in n for n in result.notes)
    assert "nothing is adjusted" in result.text()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"method": "magic"}, "no method 'magic': dlt, resection, sci"),
        ({"loss": "absolute"}, "no loss 'absolute': squares, huber, cauchy, tukey"),
        ({"free": ()}, "nothing is named"),
        ({"method": "dlt", "priors": ("fx=1000±1",)}, "--prior has no part in the method dlt"),
        ({"distortion": ("k1",)}, "--distortion has no part in the method resection"),
        ({"method": "sci", "loss": "huber"}, "--loss has no part in the method sci"),
        ({"dlt_parameters": 13}, "13 parameters is not possible: 11 or 12"),
        ({"sigma_xy": -1.0}, "--sigma -1 is not possible: 0.0001 to 10000"),
        ({"sigma_xyz": float("nan")}, "--sigma-xyz nan is not possible"),
    ],
)
def test_options_that_mean_nothing_are_refused_at_once(wrong, words):
    with pytest.raises(InvalidInputError, match=re.escape(words)):
        RegisterOptions(**wrong)
