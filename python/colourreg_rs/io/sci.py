"""A synthetic camera image as files: one folder, one picture for each thing that a pixel knows."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import FileError
from ..model import Registration, View
from ..sci import SCI
from .atomic import AtomicFile, reason
from .images import write_image
from .registration import write_registration

#: What :func:`write_sci` may write into its folder.
FILES = (
    "intensity.png", "measured.png", "raw.tif", "depth.tif", "index.tif", "subpixel.tif", "colour.png", "normals.tif",
    "view.json",
)  # fmt: skip


def view_folders(folder: Path, views: Sequence[View]) -> list[Path]:
    """A folder for each view: ``folder`` itself for a single one, else one below it, by the name, for each."""
    if len(views) == 1:
        return [folder]
    # Names come out of files: nothing in them may lead elsewhere, and two views may have the same one.
    names = [re.sub(r"[^\w.\- ]", "_", view.name).strip(". ") or "view" for view in views]
    twice = {name for name in names if names.count(name) > 1}
    return [folder / (f"{i}-{name}" if name in twice else name) for i, name in enumerate(names, 1)]


def write_sci(folder: str | Path, sci: SCI) -> list[Path]:
    """Writes an SCI into ``folder``, which is made where it is missing; every file appears whole or not at all.

    - ``intensity.png``: 8 or 16 bits, to look at and to match; ``raw.tif``: float32, NaN where nothing was seen;
    - ``depth.tif``: float32, metres, NaN where nothing was seen; ``measured.png``: 255 measured, 127 filled, 0 nothing;
    - ``index.tif``: int32 (int64 beyond 2³¹ points), −1 where no point was measured;
    - ``subpixel.tif``: float32, two pictures, the point's place in its pixel in x and in y;
    - ``colour.png`` (16 bits) and ``normals.tif`` (float32) where the cloud has them;
    - ``view.json``: the registration file of the view.

    Returns the paths. Raises FileError.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(folder, f"cannot be made: {reason(error)}", "name another folder") from error
    index = sci.index if sci.index.size and sci.index.max() >= 2**31 else sci.index.astype(np.int32)
    state = np.where(sci.measured, 255, np.where(sci.seen, 127, 0)).astype(np.uint8)
    written = []

    def image(name: str, pixels: npt.NDArray[Any]) -> None:
        write_image(folder / name, pixels)
        written.append(folder / name)

    def tiff(name: str, pages: npt.NDArray[Any]) -> None:
        import tifffile

        with AtomicFile(folder / name) as out:
            tifffile.imwrite(out.file, pages, photometric="minisblack", compression="zlib", metadata=None)
        written.append(folder / name)

    image("intensity.png", sci.intensity)
    image("measured.png", state)
    tiff("raw.tif", sci.raw)
    tiff("depth.tif", sci.depth)
    tiff("index.tif", index)
    tiff("subpixel.tif", np.ascontiguousarray(np.moveaxis(sci.subpixel, 2, 0)))
    if sci.colour is not None:
        image("colour.png", sci.colour)
    if sci.normals is not None:
        tiff("normals.tif", np.ascontiguousarray(np.moveaxis(sci.normals, 2, 0)))
    path = folder / "view.json"
    write_registration(path, Registration((sci.view,)))
    return [*written, path]
