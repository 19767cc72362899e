"""File to file: what does colouring cost beside merely rewriting the cloud with other colours?

Limits: both read and write the same LAS or LAZ; the peer (laspy, chunked, both cores for LAZ) does no colouring at all.
The cloud is a street of façades in point format 7; the photo has 24 megapixels. The page cache holds the
input for both, and no output stands there before: one that is written over gives its memory back to whoever truncates
it first, and not to whoever keeps it until the new one is whole. Loading modules does not count for either.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from .harness import compare, parser

CHUNK = 1_000_000


def make_input(folder: Path, points: int, suffix: str) -> None:
    """A street of façades seen from one end, in point format 7, a photo of 6000 × 4000 and its registration."""
    import laspy
    from PIL import Image

    rng = np.random.default_rng(7)
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = [0.001] * 3, [500_000.0, 5_800_000.0, 100.0]
    with laspy.open(folder / f"scan{suffix}", mode="w", header=header) as writer:
        for start in range(0, points, CHUNK):
            n = min(CHUNK, points - start)
            # As a scanner delivers it: column after column, each from bottom to top.
            column = (start + np.arange(n)) // 2000
            along = column * (60.0 / (points / 2000)) + rng.normal(0, 0.002, n)
            up = ((start + np.arange(n)) % 2000) / 2000 * 15.0 + rng.normal(0, 0.002, n)
            bay = (np.floor(along / 3.0) % 2) * 0.8 + (np.floor(up / 3.5) % 2) * 0.25
            record = laspy.ScaleAwarePointRecord.zeros(n, header=header)
            record.x = 500_000.0 + along - 30.0
            record.y = 5_800_000.0 + 25.0 + bay + rng.normal(0, 0.002, n)
            record.z = 100.0 + up
            record.intensity = (20_000 + 15_000 * np.sin(along * 3) + rng.normal(0, 800, n)).astype(np.uint16)
            record.gps_time = 3e8 + (start + np.arange(n)) * 1e-6
            writer.write_points(record)
    size = (6000, 4000)
    yy, xx = np.mgrid[0 : size[1], 0 : size[0]]
    photo = np.stack([(xx * 0.04) % 256, (yy * 0.06) % 256, ((xx + yy) * 0.03) % 256], 2).astype(np.uint8)
    Image.fromarray(photo).save(folder / "photo.jpg", quality=92)
    terms = {"k1": -0.05, "k2": 0.01, "p1": 1e-4, "p2": -1e-4, "k3": 0.0}
    camera = {
        "model": "OPENCV", "width": size[0], "height": size[1],
        "params": {"fx": 2900.0, "fy": 2900.0, "cx": 2999.5, "cy": 1999.5, **terms},
    }  # fmt: skip
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    centre = np.array([500_000.0, 5_800_000.0, 107.0])
    pose = {"rotation": rotation.tolist(), "translation": (-rotation @ centre).tolist()}
    view = {"name": "photo", "image": "photo.jpg", "camera": camera, "pose": pose, "dlt": None}
    registration = {"format": "colourreg-registration", "version": 1, "views": [view]}
    (folder / "registration.json").write_text(json.dumps(registration))


def colourreg(folder: str, suffix: str) -> float:
    from colourreg_rs.colourise import colourise_file, load_views
    from colourreg_rs.io.clouds import open_cloud

    load_views([Path(folder, "registration.json")])
    open_cloud(Path(folder, f"scan{suffix}")).close()
    out = Path(folder, f"out{suffix}")
    out.unlink(missing_ok=True)
    began = time.perf_counter()
    colourise_file(Path(folder, f"scan{suffix}"), [Path(folder, "registration.json")], out)
    return time.perf_counter() - began


def laspy_recolour(folder: str, suffix: str) -> float:
    import laspy

    out = Path(folder, f"peer{suffix}")
    out.unlink(missing_ok=True)
    began = time.perf_counter()
    with (
        laspy.open(Path(folder, f"scan{suffix}")) as reader,
        laspy.open(out, mode="w", header=reader.header) as writer,
    ):
        for record in reader.chunk_iterator(CHUNK):
            record.red[:] = record.intensity
            record.green[:] = record.intensity
            record.blue[:] = record.intensity
            writer.write_points(record)
    return time.perf_counter() - began


def main() -> None:
    options = parser(__doc__ or "").parse_args()
    for suffix in (".laz", ".las"):
        with tempfile.TemporaryDirectory(prefix="colourreg-bench-") as folder:
            make_input(Path(folder), options.points, suffix)
            print(
                f"\ncolour {options.points / 1e6:g} M points, {suffix[1:].upper()} to {suffix[1:].upper()}, from 24 MP"
            )
            compare({"colourreg": colourreg, "laspy, recolour only": laspy_recolour}, [folder, suffix], options.repeats)
            sys.stdout.flush()


if __name__ == "__main__":
    main()
