"""``colourreg reproduce``: runs the experiments, and writes their tables and pictures."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InvalidInputError
from ..progress import Progress, silent
from . import table1, table2

EXPERIMENTS = ("table1", "table2", "all")

CAPTIONS = {
    "table1-figure-2": "The synthetic camera image and the simulated photo",
    "table1-figure-3": "Interest points of the SCI (green) and of the photo (red), before and after 2D ICP",
    "table1-figure-4": "SCI in red, the photo brought over it in cyan: (a) as above, (b) with a wrong translation",
    "table1-back-projection": "The photo's pixels in space; red where a colour is more than 20 mm off",
    "table2-residuals": "Targets, and the residuals of both methods",
}


#: The names of the files, and how a folder is known that an earlier run filled.
PATTERNS = ("README.md", "results.json", "table1-*.jpg", "table2-*.jpg")
MARK, BEGINNING = "README.md", "# The paper's experiments, made again"


@dataclass(frozen=True)
class Reproduction:
    """What was found; a table that was not asked for is ``None``."""

    table1: table1.Table1 | None
    table2: table2.Table2 | None

    def text(self) -> str:
        """Tables and what they say, as Markdown that reads as text."""
        parts = [part.lines() for part in (self.table1, self.table2) if part is not None]
        return "\n\n".join("\n".join(lines) for lines in parts)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        found = {"table1": self.table1, "table2": self.table2}
        return {name: part.as_dict() for name, part in found.items() if part is not None}

    def write(self, folder: Path) -> list[Path]:
        """``README.md`` with tables and pictures, ``results.json``, and the pictures; returns the files."""
        from ..io.atomic import write_text
        from ..io.images import write_image
        from .drawing import as_pictures

        folder.mkdir(parents=True, exist_ok=True)
        pictures = {}
        for name, picture in as_pictures(self.table1, self.table2).items():
            pictures[name] = folder / f"{name}.jpg"
            write_image(pictures[name], picture, quality=72)
        done = [name for name, part in (("table1", self.table1), ("table2", self.table2)) if part is not None]
        command = f"colourreg reproduce {'all' if len(done) == 2 else done[0]} --out FOLDER"
        page = [
            BEGINNING,
            "",
            "Lim, Bae and Belton, *Semi-Automated Colour Registration and Evaluation of Digital Photogrammetry and "
            "Terrestrial Laser Scanning*.",
            f"Every number on this page comes out of `{command}`. *px* and *m* are root mean squares of single "
            "coordinates, which the paper's tables call total; *radial* ones count a point's coordinates together.",
            "",
            self.text(),
            "",
            *(f"![{CAPTIONS[name]}]({path.name})\n\n*{CAPTIONS[name]}.*\n" for name, path in pictures.items()),
        ]
        text, data = folder / "README.md", folder / "results.json"
        write_text(text, "\n".join(page).rstrip() + "\n")
        write_text(data, json.dumps(self.as_dict(), indent=2, ensure_ascii=False, allow_nan=False) + "\n")
        return [text, data, *pictures.values()]


def reproduce(which: str, progress: Progress = silent) -> Reproduction:
    """Runs ``table1``, ``table2`` or ``all``. Raises InvalidInputError for anything else."""
    if which not in EXPERIMENTS:
        raise InvalidInputError(f"there is no experiment {which!r}; choose one of {', '.join(EXPERIMENTS)}")
    return Reproduction(
        table1.run(progress) if which in ("table1", "all") else None,
        table2.run(progress) if which in ("table2", "all") else None,
    )
