"""Photos of the simulator: where things are imaged, what colour they have, and what the errors put in by hand do."""

from __future__ import annotations

import numpy as np
import pytest

from colourreg_rs import Camera, ControlPoint, Pose, View, _core
from colourreg_rs.errors import InvalidInputError
from colourreg_rs.simulate import SCENES, Disturbance, Frame, Response, Scene, Simulation, simulate
from colourreg_rs.simulate.builder import Builder
from colourreg_rs.simulate.lighting import Lighting
from colourreg_rs.simulate.materials import Material, colour, fill, ring
from colourreg_rs.simulate.photo import blurred, develop, radiance

EVEN_SKY = Lighting(
    sun=(0.0, 0.0, 0.0), zenith=(0.5, 0.5, 0.5), horizon=(0.5, 0.5, 0.5), ground=(0.5, 0.5, 0.5), clouds=0.0
)

CAMERAS = {
    "PINHOLE": Camera("PINHOLE", 320, 240, {"fx": 300.0, "fy": 295.0, "cx": 161.3, "cy": 117.8}),
    "OPENCV": Camera(
        "OPENCV",
        320,
        240,
        {"fx": 300.0, "fy": 300.0, "cx": 158.0, "cy": 121.0, "k1": -0.15, "k2": 0.04, "p1": 8e-4, "p2": -5e-4},
    ),
    "OPENCV_FISHEYE": Camera(
        "OPENCV_FISHEYE", 320, 240, {"fx": 140.0, "fy": 140.0, "cx": 160.0, "cy": 119.0, "k1": -0.02, "k2": 0.004}
    ),
    "EQUIRECTANGULAR": Camera("EQUIRECTANGULAR", 960, 480, {}),
}


def wall_of_discs() -> tuple[Scene, np.ndarray]:
    """Grey plates with white discs of 16 cm, and the discs' centres."""
    b = Builder()
    white, grey = colour("#ffffff", 0.9), colour("#404040", 0.2)
    centres = []
    # In one plane, so that no plate shades another.
    y = 3.0
    for x in (-1.1, -0.05, 1.2):
        for z in (-0.8, 0.25):
            plate = Material((fill(grey), ring(white, (0.5, 0.5), 0.0, 0.08)))
            b.rectangle((x - 0.5, y, z - 0.5), (1.0, 0, 0), (0, 0, 1.0), plate)
            centres.append((x, y, z))
    return Scene("discs", b.parts, EVEN_SKY), np.array(centres)


@pytest.mark.parametrize("model", CAMERAS)
def test_a_disc_is_imaged_where_projection_says(model: str) -> None:
    """Half-pixel conventions, lens and sampling: the centroid of a disc is that of its projected area."""
    scene, centres = wall_of_discs()
    view = View("v", None, CAMERAS[model], Pose.looking_at((0.1, 0.0, -0.2), (0.0, 3.0, -0.2)))
    light = radiance(scene, view, samples=64)[..., 1].astype(np.float64)
    angle = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    for centre in centres:
        rim = centre + 0.08 * np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)
        xy, _ = _core.project(view.core, rim)
        # The centroid of the projected disc's area, from its rim (Green's theorem): not the projected centre.
        x, y = xy.T
        x1, y1 = np.roll(x, -1), np.roll(y, -1)
        cross = x * y1 - x1 * y
        expected = np.array([((x + x1) * cross).sum(), ((y + y1) * cross).sum()]) / (3 * cross.sum())
        lo, hi = np.floor(xy.min(axis=0)).astype(int) - 3, np.ceil(xy.max(axis=0)).astype(int) + 4
        assert (lo >= 0).all() and hi[0] < light.shape[1] and hi[1] < light.shape[0]
        patch = light[lo[1] : hi[1], lo[0] : hi[0]]
        ground = np.median(np.concatenate([patch[0], patch[-1], patch[:, 0], patch[:, -1]]))
        weight = np.where(patch - ground > 0.02, patch - ground, 0.0)
        rows, columns = np.mgrid[lo[1] : hi[1], lo[0] : hi[0]]
        found = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        np.testing.assert_allclose(found, expected, atol=0.02)


def test_every_camera_sees_the_same_colours() -> None:
    scene = simulate("square", seed=5, draft=True, photos=0, points=10).scene
    pose = Pose.looking_at((1.0, -16.0, 1.7), (2.0, 0.0, 2.5))
    rng = np.random.default_rng(7)
    hits = None
    pictures = []
    for name in ("OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR"):
        view = View("v", None, CAMERAS[name], pose)
        if hits is None:
            xy = np.ascontiguousarray(rng.uniform([20, 20], [300, 220], (4000, 2)))
            rays = _core.unproject(view.core, xy)
            found = scene.cast(view.core.centre, rays)
            hits = (view.core.centre + rays * found.distance[:, None])[np.isfinite(found.distance)]
        assert scene.visible(view, hits).mean() > 0.999
        at, _ = _core.project(view.core, hits)
        # The pixels differ in size: the blur makes the footprints of all three alike (1/80 rad).
        angle = {"OPENCV": 300.0, "OPENCV_FISHEYE": 140.0, "EQUIRECTANGULAR": 960 / (2 * np.pi)}[name]
        sigma = 0.0125 * angle
        pictures.append(scene.core.radiance_at(scene.in_scene(view), np.ascontiguousarray(at), sigma, True))
    for other in pictures[1:]:
        assert np.nanmedian(np.abs(other - pictures[0]) / (pictures[0] + 0.02)) < 0.05


def test_true_colours_are_the_photo_s_where_surfaces_are_seen_whole() -> None:
    simulation = simulate(
        "square", seed=2, draft=True, size=(480, 320), photos=1, points=40_000, response=Response().without_noise()
    )
    photo, truth = simulation.photos[0], simulation.scan_truth
    points = truth.surface[photo.visible(truth.surface)]
    xy, _ = _core.project(photo.view.core, points)
    # Bilinear sampling of the photo itself.
    inside = (xy > 1).all(axis=1) & (xy[:, 0] < 478) & (xy[:, 1] < 318)
    xy, points = xy[inside], points[inside]
    i, j = np.floor(xy).astype(int).T
    a, b = (xy - np.floor(xy)).T[:, :, None]
    image = photo.image.astype(np.float64)
    sampled = (image[j, i] * (1 - a) + image[j, i + 1] * a) * (1 - b) + (
        image[j + 1, i] * (1 - a) + image[j + 1, i + 1] * a
    ) * b
    error = np.abs(sampled - photo.true_colour(points)).mean(axis=1)
    assert np.median(error) < 2.0
    assert np.percentile(error, 75) < 6.0


def test_the_errors_put_in_are_the_difference_between_true_and_approximate_view() -> None:
    errors = Disturbance(
        rotation=(0.01, -0.02, 0.005),
        translation=(0.1, -0.2, 0.05),
        principal_point=(3.0, -2.0),
        focal=0.01,
        distortion={"k1": -0.05, "p2": 1e-3},
    )
    photo = simulate("trial", seed=1, draft=True, size=(64, 48), points=2000, disturbance=errors).photos[0]
    start, view = photo.start, photo.view
    assert start.pose is not None and view.pose is not None and start.camera is not None and view.camera is not None
    np.testing.assert_allclose(view.pose.centre - start.pose.centre, [0.1, -0.2, 0.05], atol=1e-12)
    turn = view.pose.rotation @ start.pose.rotation.T
    # A rotation matrix's antisymmetric part is sin(angle)/angle times its rotation vector.
    vector = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    angle = np.linalg.norm([0.01, -0.02, 0.005])
    np.testing.assert_allclose(vector * angle / np.sin(angle), [0.01, -0.02, 0.005], atol=1e-12)
    before, after = start.camera.params, view.camera.params
    assert after["cx"] - before["cx"] == pytest.approx(3.0)
    assert after["cy"] - before["cy"] == pytest.approx(-2.0)
    assert after["fx"] == pytest.approx(1.01 * before["fx"])
    assert after["k1"] - before["k1"] == pytest.approx(-0.05)
    assert after["p2"] - before["p2"] == pytest.approx(1e-3)
    with pytest.raises(InvalidInputError, match="no term k9"):
        simulate("trial", seed=1, draft=True, size=(64, 48), points=20, disturbance=Disturbance(distortion={"k9": 1.0}))


def residuals(view: View, points: tuple[ControlPoint, ...]) -> np.ndarray:
    xy, _ = _core.project(view.core, np.array([p.xyz for p in points]))
    return np.array([p.xy for p in points]) - xy


def test_control_points_have_the_noise_and_the_blunders_that_were_asked_for() -> None:
    errors = Disturbance(blunders=0.25, point_sigma_xy=0.5, point_sigma_xyz=0.0, control_points=8, check_points=4)
    photo = simulate("trial", seed=2, draft=True, size=(640, 480), points=2000, disturbance=errors).photos[0]
    assert len(photo.blunders) == 2
    np.testing.assert_allclose(residuals(photo.view, photo.true_points), 0.0, atol=1e-9)
    assert [p.role for p in photo.points].count("check") == 4
    off = np.linalg.norm(residuals(photo.view, photo.points), axis=1)
    spoiled = np.array([p.name in photo.blunders for p in photo.points])
    assert (off[spoiled] > 18).all() and (off[~spoiled] < 2.5).all()
    assert photo.visible(np.array([p.xyz for p in photo.true_points]), tolerance=0.02).all()


@pytest.mark.parametrize("name", sorted(SCENES))
def test_every_scene_has_what_it_is_for(name: str) -> None:
    simulation = simulate(name, seed=1, draft=True, size=(150, 100), photos=1, points=8000)
    photo = simulation.photos[0]
    assert len(simulation.scan) > 3000
    assert simulation.scan.intensity is not None
    assert simulation.scan.intensity.dtype == np.uint16
    assert np.unique(simulation.scan.intensity).size > 500
    assert photo.image.shape == (100, 150, 3)
    assert 55 < photo.image.mean() < 200, "well exposed"
    assert photo.image.std() > 15
    assert len(photo.points) >= 12
    seen = photo.visible(simulation.scan_truth.surface).mean()
    assert seen > 0.05
    target = simulation.scan_truth.surface - np.array(simulation.stations[0])
    distance = float(np.median(np.linalg.norm(target, axis=1)))
    assert {"corner": 50, "trial": 1.2, "room": 1, "facade": 8}.get(name, 8) < distance
    assert distance < {"corner": 75, "trial": 2.3, "room": 5, "facade": 45}.get(name, 30)


def test_the_blur_has_the_variance_that_it_says() -> None:
    image = np.zeros((41, 41, 1), np.float32)
    image[20, 20] = 1.0
    for sigma in (0.3, 0.5, 1.2):
        spot = blurred(image, sigma)[..., 0].astype(np.float64)
        place = np.arange(41) - 20.0
        assert spot.sum() == pytest.approx(1.0, abs=1e-5)
        assert (spot.sum(axis=0) * place**2).sum() == pytest.approx(sigma**2, rel=0.01)


def test_noise_has_the_sigma_that_it_says() -> None:
    light = np.full((200, 300, 3), 0.3, np.float32)
    response = Response(blur=0.0, exposure=1.0, vignetting=0.0, read_noise=0.002, shot_noise=0.01, jpeg_quality=None)
    image, _ = develop(light, response, np.random.default_rng(3))
    step = (response.coded(np.array([0.301])) - response.coded(np.array([0.299])))[0] / 0.002
    expected = np.hypot(0.002, 0.01 * np.sqrt(0.3)) * step
    # Rounding to whole grey values adds its own 1/12.
    assert image.std() == pytest.approx(np.sqrt(expected**2 + 1 / 12), rel=0.03)


@pytest.fixture(scope="module")
def still() -> Simulation:
    return simulate("trial", seed=4, draft=True, size=(160, 120), points=3000)


def test_one_thread_and_many_give_the_same_picture(still: Simulation) -> None:
    scene, view = still.scene, still.photos[0].view
    whole = radiance(scene, view)
    local = scene.in_scene(view)
    pieces = np.concatenate([scene.core.picture(local, a, min(a + 37, 120), 16) for a in range(0, 120, 37)])
    np.testing.assert_array_equal(pieces, whole)


def test_a_scene_in_a_turned_frame_answers_in_world_coordinates(still: Simulation) -> None:
    frame = Frame.turned(-1.1, (4.0e5, 5.6e6, 80.0))
    moved = Scene("moved", still.scene.parts, still.scene.lighting, frame)
    start = np.array([2.0, -2.0, 1.3])
    rays = np.random.default_rng(1).normal(0, 1, (500, 3))
    here = still.scene.cast(start, rays)
    there = moved.cast(frame.to_world(start), rays @ frame.rotation.T)
    np.testing.assert_array_equal(here.primitive, there.primitive)
    hit = here.primitive >= 0
    np.testing.assert_allclose(there.distance[hit], here.distance[hit], rtol=1e-8)
    np.testing.assert_allclose(there.normal[hit], here.normal[hit] @ frame.rotation.T, atol=1e-12)
