"""Control and check points: CSV with the columns ``name,X,Y,Z,x,y`` and, where known, role and sigmas.

What spreadsheets do to such files is forgiven where only one meaning is possible (byte-order marks, semicolons or tabs,
decimal commas between them, blank lines, empty columns at the end); everything else is refused with its line.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ..errors import FileError, InvalidInputError
from ..model import ControlPoint, FloatArray, Role
from .atomic import read_bytes, write_text

REQUIRED = ("name", "X", "Y", "Z", "x", "y")
OBJECT_SIGMAS = ("sX", "sY", "sZ")
IMAGE_SIGMAS = ("sx", "sy")
COLUMNS = (*REQUIRED, "role", *OBJECT_SIGMAS, *IMAGE_SIGMAS)

#: What no coordinate in any unit, and no sigma, comes to.
LARGEST = 1e12

_LIMIT = 1 << 26
_POINT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?", re.ASCII)


def read_points(path: str | Path) -> list[ControlPoint]:
    """Reads control and check points.

    Returns:
        The points in the file's order: object coordinates in the cloud's frame and unit, photo coordinates in pixels
        with (0, 0) the centre of the top-left one.

    Raises:
        FileError: with the line, what is wrong in it and how to mend it.
    """
    path = Path(path)
    text = _decoded(path, read_bytes(path, _LIMIT))
    rows, header, separator = _table(path, text)
    points: list[ControlPoint] = []
    lines: dict[str, int] = {}
    marks: dict[str, tuple[int, str]] = {}
    for line, cells in rows:
        row = _Row(path, line, dict(zip(header, cells, strict=True)), separator, marks)
        name = row.cells["name"]
        if not name:
            raise FileError(path, f"line {line}: a point without a name", "give it one, or delete the line")
        if name in lines:
            raise FileError(
                path, f"lines {lines[name]} and {line}: two points {name!r}", "rename or delete one of them"
            )
        lines[name] = line
        try:
            points.append(
                ControlPoint(
                    name,
                    np.array([row.number(c) for c in REQUIRED[1:4]]),
                    np.array([row.number(c) for c in REQUIRED[4:6]]),
                    row.role(),
                    row.sigmas(OBJECT_SIGMAS),
                    row.sigmas(IMAGE_SIGMAS),
                )
            )
        except InvalidInputError as error:
            raise FileError(path, f"line {line}: {error}", "correct the line") from error
    if not points:
        raise FileError(path, "holds a header, but no points", "add a line for each point")
    return points


def write_points(path: str | Path, points: Iterable[ControlPoint]) -> None:
    """Writes control and check points; :func:`read_points` gives the same numbers back, to the last bit."""
    points = list(points)
    with_object = any(p.sigma_xyz is not None for p in points)
    with_image = any(p.sigma_xy is not None for p in points)
    header = [*REQUIRED, "role", *(OBJECT_SIGMAS if with_object else ()), *(IMAGE_SIGMAS if with_image else ())]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    for p in points:
        if p.name != p.name.strip() or not p.name or "\0" in p.name:
            raise InvalidInputError(
                f"point {p.name!r}: a name in a CSV file cannot be empty or begin or end with a blank"
            )
        cells: list[str] = [p.name, *_numbers(p.xyz), *_numbers(p.xy), p.role]
        cells += (_numbers(p.sigma_xyz) if p.sigma_xyz is not None else ["", "", ""]) if with_object else []
        cells += (_numbers(p.sigma_xy) if p.sigma_xy is not None else ["", ""]) if with_image else []
        writer.writerow(cells)
    write_text(path, out.getvalue())


def _numbers(values: FloatArray) -> list[str]:
    if not (np.abs(values) < LARGEST).all():
        raise InvalidInputError(f"{values.tolist()}: a number is not finite or too large, and could not be read again")
    return [repr(float(v)) for v in values]


def _decoded(path: Path, data: bytes) -> str:
    if data[:2] == b"PK":
        raise FileError(path, "is a spreadsheet, not CSV", "save it as CSV (UTF-8) there")
    # Programs that write neither UTF-16 nor UTF-8 write the Windows code page: it can only be a letter in a name.
    wide = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    for encoding in ("utf-16",) if wide else ("utf-8-sig", "cp1252"):
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" in text:
            break
        if not text.strip():
            raise FileError(path, "is empty", f"its first line names the columns: {','.join(REQUIRED)}")
        return text
    raise FileError(path, "is not a text file", "save it as CSV (UTF-8)")


def _table(path: Path, text: str) -> tuple[list[tuple[int, list[str]]], list[str], str]:
    """The rows with their line numbers, the names of the columns, and what separates them."""
    lines = text.splitlines()
    first = next(i for i, line in enumerate(lines) if line.strip())
    separator: str | None = None
    if re.fullmatch(r"\s*\"?sep=(.)\"?\s*", lines[first], re.IGNORECASE):  # Excel's own way to say it
        first = next((i for i, line in enumerate(lines[first + 1 :], first + 1) if line.strip()), first)
    header_line = lines[first]
    for candidate in ("\t", ";", ","):
        if candidate in header_line:
            separator = candidate
            break
    if separator is None:
        problem = f"line {first + 1}: {header_line.strip()[:60]!r} names no columns"
        raise FileError(path, problem, f"the first line is {','.join(REQUIRED)}")
    body = "\n".join(lines[first:]) + "\n"
    reader = csv.reader(io.StringIO(body, newline=""), delimiter=separator, skipinitialspace=True, strict=True)
    header: list[str] | None = None
    rows: list[tuple[int, list[str]]] = []
    line = first + 1
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            while cells and not cells[-1] and (header is None or len(cells) > len(header)):
                cells.pop()
            if header is None:
                header = _header(path, line, cells, separator)
            elif any(cells):
                if len(cells) != len(header):
                    raise FileError(
                        path, f"line {line} has {len(cells)} values, the header {len(header)}", _mend(separator)
                    )
                rows.append((line, cells))
            line = first + 1 + reader.line_num
    except csv.Error as error:
        raise FileError(path, f"line {line}: {error}", "are the quotation marks in pairs?") from error
    assert header is not None
    return rows, header, separator


def _mend(separator: str) -> str:
    if separator == ",":
        return "decimal commas need semicolons between the columns, or write decimal points"
    return "every line has a value for each column"


def _header(path: Path, line: int, cells: list[str], separator: str) -> list[str]:
    wanted = separator.join(REQUIRED)
    if sum(bool(_POINT.fullmatch(c) or _COMMA.fullmatch(c)) for c in cells) >= 3:
        shown = separator.join(cells)
        shown = shown if len(shown) <= 60 else f"{shown[:57]}…"
        raise FileError(path, f"line {line} ({shown}) names no columns", f"put a line {wanted} before it")
    twice = sorted({c for c in cells if cells.count(c) > 1})
    if twice:
        hint = " (X, Y, Z are object coordinates, x, y photo coordinates)" if set(twice) & {*"XYZxy"} else ""
        raise FileError(path, f"line {line}: the column {twice[0]!r} is there twice{hint}", f"the columns are {wanted}")
    missing = [c for c in REQUIRED if c not in cells]
    if missing:
        raise FileError(path, f"line {line}: the column {', '.join(missing)} is missing", f"the columns are {wanted}")
    unknown = [c for c in cells if c not in COLUMNS]
    if unknown:
        near = next((c for c in COLUMNS if c.lower() == unknown[0].lower()), None)
        remedy = f"write {near!r}" if near else f"delete it; {', '.join(COLUMNS[6:])} are known besides {wanted}"
        raise FileError(path, f"line {line}: the column {unknown[0]!r} is not known", remedy)
    for group in (OBJECT_SIGMAS, IMAGE_SIGMAS):
        have = [c for c in group if c in cells]
        if have and len(have) < len(group):
            lacking = ", ".join(c for c in group if c not in cells)
            raise FileError(path, f"line {line}: {', '.join(have)} without {lacking}", "give all of them, or none")
    return cells


class _Row:
    """One line, by column."""

    def __init__(
        self, path: Path, line: int, cells: dict[str, str], separator: str, marks: dict[str, tuple[int, str]]
    ) -> None:
        self.path, self.line, self.cells, self.separator, self.marks = path, line, cells, separator, marks

    def error(self, column: str, what: str, remedy: str) -> FileError:
        return FileError(self.path, f"line {self.line}, column {column}: {self.cells[column]!r} {what}", remedy)

    def number(self, column: str) -> float:
        cell = self.cells[column].replace("−", "-")
        if not cell:
            raise self.error(column, "is empty", "every point has all of " + ", ".join(REQUIRED))
        mark = None
        if _COMMA.fullmatch(cell):
            if self.separator == ",":
                raise self.error(column, "has a decimal comma", "use decimal points, or semicolons between the columns")
            mark = ","
        elif _POINT.fullmatch(cell):
            mark = "." if "." in cell else None
        else:
            raise self._no_number(column, cell)
        if mark is not None:
            other = "." if mark == "," else ","
            if other in self.marks:
                before, example = self.marks[other]
                raise self.error(
                    column,
                    f"and line {before} ({example!r}) have different decimal signs",
                    "use decimal points throughout",
                )
            self.marks.setdefault(mark, (self.line, cell))
        value = float(cell.replace(",", "."))
        if not abs(value) < LARGEST:
            cell = cell if len(cell) < 30 else f"{cell[:20]}…{cell[-5:]}"
            self.cells[column] = cell
            raise self.error(column, "is too large", "correct the number")
        return value

    def _no_number(self, column: str, cell: str) -> FileError:
        if re.search(r"[°′″'\"]", cell) and re.search(r"[°′″]", cell):
            return self.error(column, "is an angle", "coordinates are in the unit of the cloud, not in degrees")
        if re.fullmatch(r"[+-]?\d{1,3}([.,' \u00a0\u2009\u202f]\d{3})+([.,]\d+)?", cell):
            return self.error(column, "has thousands separators", "write the number without them")
        if re.fullmatch(r"[+-]?(nan|inf|infinity|#n/a|n/a|-)", cell, re.IGNORECASE):
            return self.error(column, "is no finite number", "correct the number or delete the line")
        if re.fullmatch(r"[+-]?[\d.,]+([eE][+-]?\d+)?\s*(m|mm|cm|px|ft)", cell):
            return self.error(column, "has a unit", "write the number without it")
        return self.error(column, "is no number", "correct the number")

    def role(self) -> Role:
        cell = self.cells.get("role", "").lower()
        if cell in ("", "control"):
            return "control"
        if cell == "check":
            return "check"
        raise self.error("role", "is no role", "write control or check")

    def sigmas(self, columns: Sequence[str]) -> np.ndarray[tuple[int], np.dtype[np.float64]] | None:
        if columns[0] not in self.cells:
            return None
        empty = [c for c in columns if not self.cells[c]]
        if len(empty) == len(columns):
            return None
        if empty:
            raise self.error(
                empty[0], f"is empty, {', '.join(c for c in columns if c not in empty)} not", "give all or none"
            )
        values = np.array([self.number(c) for c in columns])
        if (values < 0).any():
            raise self.error(columns[int(np.argmax(values < 0))], "is negative", "a sigma is 0 or more")
        return values
