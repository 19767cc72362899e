"""The two root mean squares of errors, and rows of tables made of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..model import FloatArray


@dataclass(frozen=True)
class Figures:
    """Root mean squares of ``n`` errors: of each coordinate, ``rms`` over all coordinates (what the paper's tables call
    "total"), and ``rmse``, the radial one. ``None`` where they are not known."""

    axes: tuple[float, ...]
    rms: float
    rmse: float | None
    n: int | None

    @classmethod
    def of(cls, errors: FloatArray) -> Figures:
        """Of errors (N, D)."""
        squares = (errors**2).mean(axis=0)
        total = float(squares.sum())
        axes = tuple(float(v) for v in np.sqrt(squares))
        return cls(axes, float(np.sqrt(total / errors.shape[1])), float(np.sqrt(total)), len(errors))

    @classmethod
    def published(cls, axes: tuple[float, ...], rms: float) -> Figures:
        """As printed."""
        return cls(axes, rms, None, None)

    def cells(self, digits: int) -> list[str]:
        """Total, its coordinates, and the radial one, for a table."""
        axes = ", ".join(f"{v:.{digits}f}" for v in self.axes)
        return [f"{self.rms:.{digits}f}", axes, "–" if self.rmse is None else f"{self.rmse:.{digits}f}"]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"axes": list(self.axes), "rms": self.rms, "rmse": self.rmse, "n": self.n}


@dataclass(frozen=True)
class Row:
    """What one method reaches: in the photo, px, and at the object, m."""

    label: str
    photo: Figures
    cloud: Figures

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"label": self.label, "photo_px": self.photo.as_dict(), "cloud_m": self.cloud.as_dict()}


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    """A table that reads well as text and is one in Markdown; the first column is of words."""
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]

    def line(cells: list[str]) -> str:
        first, *others = cells
        padded = [first.ljust(widths[0]), *(c.rjust(w) for c, w in zip(others, widths[1:], strict=True))]
        return "| " + " | ".join(padded) + " |"

    rule = "| " + " | ".join(["-" * widths[0], *("-" * (w - 1) + ":" for w in widths[1:])]) + " |"
    return [line(head), rule, *(line(row) for row in rows)]


def error_table(rows: list[Row], axes: str) -> list[str]:
    """Photo and cloud, each with both root mean squares."""
    head = ["", "photo px", "x, y", "radial", "cloud m", axes, "radial"]
    return table(head, [[row.label, *row.photo.cells(3), *row.cloud.cells(4)] for row in rows])
