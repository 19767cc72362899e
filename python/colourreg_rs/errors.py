"""The errors a user can meet. One base class, so that one ``except`` catches them all.

The four that the core raises are made there; :class:`FileError` belongs to the facade.
"""

from __future__ import annotations

from pathlib import Path

from ._core import ColourregError, DegenerateError, InternalError, InvalidInputError, NotConvergedError

__all__ = [
    "ColourregError",
    "DegenerateError",
    "FileError",
    "InternalError",
    "InvalidInputError",
    "NotConvergedError",
]


class FileError(ColourregError):
    """A file that cannot be read or written: one line with the file, what is wrong, and what to do."""

    def __init__(self, path: str | Path, problem: str, remedy: str | None = None) -> None:
        self.path = Path(path)
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{path}: {problem}" + (f"; {remedy}" if remedy else ""))
