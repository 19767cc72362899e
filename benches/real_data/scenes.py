"""Real clouds with a photo and a calibration made by others, brought into the project's files.

Each scene is written as somebody would have it on disk: a cloud without colours, photos, and a registration. What was
held back (the points' own colours, what another depth image says is hidden) is the truth to compare with.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from colourreg_rs import (
    Camera,
    PointCloud,
    Pose,
    Registration,
    View,
    read_cloud,
    read_photo,
    write_cloud,
    write_registration,
)
from colourreg_rs.io.images import write_image

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Scene:
    """A cloud, its photos and their calibration as files, and what is known about the right answer.

    - ``colours`` (N, 3), 0 to 255: the points' own, from the instrument or another photo; NaN where unknown.
    - ``seen`` and ``hidden`` (N,): what an independent depth image says of each point; neither where it cannot tell.
    """

    cloud: Path
    registration: Path
    views: tuple[View, ...]
    colours: FloatArray | None = None
    seen: BoolArray | None = None
    hidden: BoolArray | None = None


def _write(
    folder: Path,
    cloud: PointCloud,
    views: list[View],
    suffix: str = ".ply",
    *,
    colours: FloatArray | None = None,
    seen: BoolArray | None = None,
    hidden: BoolArray | None = None,
) -> Scene:
    path, registration = folder / f"cloud{suffix}", folder / "registration.json"
    write_cloud(path, cloud)
    write_registration(registration, Registration(tuple(views), path))
    return Scene(path, registration, tuple(views), colours, seen, hidden)


def kinect(data: Path, name: str, folder: Path) -> Scene:
    """An organised cloud that carries its whole photo: exact camera, exact pixel and exact colour of every point.

    Points without coordinates stay in the cloud: they hold a colour of the photo all the same, and must get none.
    """
    cloud = read_cloud(data / "pcl_osd_kinect" / f"{name}.pcd")
    assert cloud.rgb is not None
    photo = (cloud.rgb >> 8).astype(np.uint8).reshape(480, 640, 3)
    write_image(folder / "photo.png", photo)
    cx, cy = {"learn0": (319.5, 239.5), "region_growing_rgb_tutorial": (320.0, 240.0)}[name]
    camera = Camera("PINHOLE", 640, 480, {"fx": 525.0, "fy": 525.0, "cx": cx, "cy": cy})
    view = View(name, folder / "photo.png", camera, Pose(np.eye(3), np.zeros(3)))
    valid = np.isfinite(cloud.xyz).all(axis=1)
    return _write(
        folder,
        PointCloud(cloud.xyz),
        [view],
        colours=photo.reshape(-1, 3).astype(np.float64),
        seen=np.asarray(valid),
        hidden=np.asarray(~valid),
    )


def living_room(data: Path, folder: Path, cloud_of: int, photo_of: int) -> Scene:
    """The cloud of one RGB-D frame, to be coloured from the photo of another; that one's depths say what it sees.

    A point counts as seen within 1.5 % of the other frame's depth in all of 3 x 3 pixels, as hidden where it lies 8 %
    behind all of them: the depths carry the noise of the instrument, and its edges are a pixel or two wide.
    """
    source = data / "open3d_rgbd_synthetic"
    rows = [line.split() for line in (source / "odometry.log").read_text().splitlines()]
    t_world = [np.array(rows[5 * i + 1 : 5 * i + 5], dtype=np.float64) for i in range(5)]
    camera = Camera("PINHOLE", 640, 480, {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5})
    t_camera = np.linalg.inv(t_world[photo_of])
    u, _, vt = np.linalg.svd(t_camera[:3, :3])  # six printed digits are no rotation to 1e-6
    image = source / f"color/{photo_of:05d}.jpg"
    pose = Pose(np.asarray(u @ vt, dtype=np.float64), np.asarray(t_camera[:3, 3], dtype=np.float64))
    view = View(f"frame {photo_of}", image, camera, pose)

    depth = read_depth(source / f"depth/{cloud_of:05d}.png")
    row, column = np.nonzero(depth)
    z = depth[row, column]
    xyz = np.column_stack([(column - 319.5) * z / 525, (row - 239.5) * z / 525, z])
    xyz = xyz @ t_world[cloud_of][:3, :3].T + t_world[cloud_of][:3, 3]
    colours = read_photo(source / f"color/{cloud_of:05d}.jpg").pixels[row, column].astype(np.float64)

    other = read_depth(source / f"depth/{photo_of:05d}.png")
    in_camera = xyz @ pose.rotation.T + pose.translation
    with np.errstate(divide="ignore", invalid="ignore"):  # points in the plane of the camera
        xy = 525 * in_camera[:, :2] / in_camera[:, 2:] + [319.5, 239.5]
    inside = (in_camera[:, 2] > 0) & (xy >= 1).all(1) & (xy < [638, 478]).all(1)
    around = np.full((len(xyz), 9), np.nan)
    x, y = np.rint(xy[inside]).astype(np.int64).T
    around[inside] = np.stack([other[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)], axis=1)
    around[around == 0] = np.nan
    measured = np.isfinite(around).all(1)
    ratio = in_camera[:, 2:] / around
    seen = measured & (np.abs(ratio - 1) < 0.015).all(1)
    return _write(folder, PointCloud(xyz), [view], colours=colours, seen=seen, hidden=measured & (ratio > 1.08).all(1))


def read_depth(path: Path) -> FloatArray:
    """Metres, 0 where nothing was measured."""
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image).astype(np.float64) / 1000


def opensfm(data: Path) -> dict[str, Any]:
    """The published reconstruction from three phone photos, as it stands in its file."""
    return dict(json.loads((data / "opensfm_berlin/reconstruction_example.json").read_text())[0])


def turn(vector: FloatArray) -> FloatArray:
    """The rotation matrix of an angle-axis vector."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k)


def turned(view: View, axis: int, degrees: float) -> View:
    """The view turned about an axis of its camera, where it stands."""
    assert view.pose is not None
    vector = np.zeros(3)
    vector[axis] = np.radians(degrees)
    return replace(view, pose=Pose.from_centre(turn(vector) @ view.pose.rotation, view.pose.centre))


def berlin(data: Path, folder: Path) -> Scene:
    """1,430 points of a portal and three phone photos, by others' bundle adjustment."""
    source, made = data / "opensfm_berlin", opensfm(data)
    (c,) = made["cameras"].values()
    width, height = c["width"], c["height"]
    f = c["focal"] * max(width, height)
    params = {"fx": f, "fy": f, "cx": (width - 1) / 2, "cy": (height - 1) / 2, "k1": c["k1"], "k2": c["k2"]}
    camera = Camera("OPENCV", width, height, params)
    views = [
        View(name, source / "images" / name, camera, Pose(turn(np.array(s["rotation"])), np.array(s["translation"])))
        for name, s in sorted(made["shots"].items())
    ]
    points = list(made["points"].values())
    xyz = np.array([p["coordinates"] for p in points])
    return _write(folder, PointCloud(xyz), views, colours=np.array([p["color"] for p in points], dtype=np.float64))


def berlin_observations(data: Path) -> dict[str, tuple[npt.NDArray[np.int64], FloatArray]]:
    """For each photo the points, as rows of the cloud, that were found in it, and where (M, 2), px."""
    made = opensfm(data)
    row_of = {track: row for row, track in enumerate(made["points"])}
    found: dict[str, list[tuple[int, float, float]]] = {name: [] for name in sorted(made["shots"])}
    for line in (data / "opensfm_berlin/tracks_example.csv").read_text().splitlines()[1:]:
        shot, track, _, x, y, *_ = line.split("\t")
        if shot in found and track in row_of:
            found[shot].append((row_of[track], float(x) * 3264 + 1631.5, float(y) * 3264 + 1223.5))
    tables = {name: np.array(rows) for name, rows in found.items()}
    return {name: (table[:, 0].astype(np.int64), table[:, 1:]) for name, table in tables.items()}


def road(data: Path, folder: Path, rough: bool = False) -> Scene:
    """78,238 points of a car's scanner on a road, and its camera: calibrated roughly, or refined by others."""
    source = data / "opencalib_manual"
    fx = 2109.75 if rough else 2120.29
    params = {"fx": fx, "fy": 2071.72, "cx": 949.828, "cy": 576.237}
    params |= dict(zip(("k1", "k2", "p1", "p2"), (-0.108145, 0.138668, -0.00379757, -0.00484127), strict=True))
    start = json.loads((source / "top_center_lidar-to-center_camera-extrinsic.json").read_text())
    given = start["top_center_lidar-to-center_camera-extrinsic"]["param"]["sensor_calib"]["data"]
    t = np.array(given) if rough else np.array(
        [
            [0.0121008, -0.999863, -0.0112902, 0.0134153],
            [0.0133341, 0.0114512, -0.999846, -0.352602],
            [0.999838, 0.0119484, 0.0134707, -0.575013],
        ]
    )  # fmt: skip
    u, _, vt = np.linalg.svd(t[:3, :3])
    view = View("road", source / "0.png", Camera("OPENCV", 1920, 1200, params), Pose(u @ vt, t[:3, 3]))
    cloud = read_cloud(source / "0.pcd")
    return _write(folder, cloud, [view], ".laz")
