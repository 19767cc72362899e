"""Control and check points as CSV: ``name,X,Y,Z,x,y`` and optionally ``role``, ``sX,sY,sZ`` (m), ``sx,sy`` (px).

Spreadsheets have habits. Where the meaning is certain they are forgiven: a byte-order mark, UTF-16, semicolons or tabs
between the columns and then commas in the numbers, spaces, quotes, empty lines and columns. Where it is not, the line
that is wrong is named, with how to mend it. Upper and lower case differ: X is of the object, x of the photo.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal, cast

from ..errors import FileError, InvalidInputError
from ..model import ControlPoint
from .atomic import read_bytes, write_text

REQUIRED = ("name", "X", "Y", "Z", "x", "y")
OPTIONAL = ("role", "sX", "sY", "sZ", "sx", "sy")
HEADER = "name,X,Y,Z,x,y"

#: Bytes: a million points.
_LIMIT = 200_000_000


def read_points(path: str | Path) -> list[ControlPoint]:
    """All points of the file, in its order. Raises FileError with the line that is wrong and how to mend it."""
    path = Path(path)
    lines = _decode(path).splitlines()
    rows = [(number, line) for number, line in enumerate(lines, start=1) if line.strip(" \t,;")]
    if not rows:
        raise FileError(path, "is empty", f"its first line must be {HEADER}")
    separator = _separator(path, rows[0][1])
    header, column = _header(path, rows[0], separator)
    points: list[ControlPoint] = []
    seen: dict[str, int] = {}
    for number, line in rows[1:]:
        fields = _fields(path, number, line, separator, len(header))
        point = _point(path, number, fields, column, separator)
        if point.name in seen:
            raise FileError(
                path,
                f"line {number}: the name {point.name!r} stands in line {seen[point.name]} too",
                "give each point its own",
            )
        seen[point.name] = number
        points.append(point)
    if not points:
        raise FileError(path, "has a header but no points", f"add a line for each point: {HEADER}")
    return points


def _decode(path: Path) -> str:
    data = read_bytes(path, _LIMIT)
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise FileError(path, f"line {line}: is not UTF-8 text", "save it as “CSV UTF-8”") from error
    if "\0" in text:
        raise FileError(path, "holds zero bytes: it is no text file", "save the table as CSV")
    return text


def _separator(path: Path, header: str) -> str:
    counts = {separator: header.count(separator) for separator in (",", ";", "\t")}
    best = max(counts, key=lambda s: counts[s])
    if counts[best] == 0:
        raise FileError(path, f"line 1: {header[:60]!r} has no columns", f"its first line must be {HEADER}")
    return best


def _header(path: Path, row: tuple[int, str], separator: str) -> tuple[list[str], dict[str, int]]:
    number, line = row
    names = [name.strip() for name in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]
    while names and not names[-1]:
        names.pop()
    missing = [name for name in REQUIRED if name not in names]
    if missing:
        lowered = {name.lower() for name in names}
        hint = " (upper case is the object, lower case the photo)" if any(m.lower() in lowered for m in missing) else ""
        found = ",".join(names)[:80]
        raise FileError(
            path, f"line {number}: the column {', '.join(missing)} is missing{hint}; found {found!r}", f"use {HEADER}"
        )
    known = (*REQUIRED, *OPTIONAL)
    doubled = sorted({name for name in names if name in known and names.count(name) > 1})
    if doubled:
        raise FileError(path, f"line {number}: the column {', '.join(doubled)} stands twice", "remove one of them")
    return names, {name: names.index(name) for name in known if name in names}


def _fields(path: Path, number: int, line: str, separator: str, expected: int) -> list[str]:
    try:
        fields = [
            field.strip() for field in next(csv.reader([line], delimiter=separator, strict=True, skipinitialspace=True))
        ]
    except (csv.Error, StopIteration) as error:
        raise FileError(path, f"line {number}: {error}", "close the quotes in the line where they open") from error
    while len(fields) > expected and not fields[-1]:
        fields.pop()
    if len(fields) > expected:
        remedy = "remove what is too much"
        if separator == ",":
            remedy = "numbers take a decimal point; with decimal commas, put semicolons between the columns"
        raise FileError(path, f"line {number}: has {len(fields)} columns, the header has {expected}", remedy)
    return fields + [""] * (expected - len(fields))


def _number(path: Path, number: int, name: str, text: str, separator: str) -> float:
    plain = text
    if separator != "," and "," in text:
        if "." in text or text.count(",") > 1:
            raise FileError(
                path,
                f"line {number}: {name} = {text!r} could mean several numbers",
                "write it without thousands separators",
            )
        plain = text.replace(",", ".")
    if not plain:
        raise FileError(path, f"line {number}: {name} is empty", "give a number, or remove the line")
    try:
        if "_" in plain:
            raise ValueError
        value = float(plain)
    except ValueError:
        raise FileError(
            path, f"line {number}: {name} = {text!r} is not a number", "use digits and a decimal point"
        ) from None
    if not math.isfinite(value):
        raise FileError(path, f"line {number}: {name} = {text!r} is not finite", "give a number, or remove the line")
    return value


def _point(path: Path, line: int, fields: Sequence[str], column: dict[str, int], separator: str) -> ControlPoint:
    name = fields[column["name"]]
    if not name:
        raise FileError(path, f"line {line}: the point has no name", "give it one")

    def numbers(*names: str) -> list[float]:
        return [_number(path, line, n, fields[column[n]], separator) for n in names]

    def sigmas(*names: str) -> list[float] | None:
        """All of them or none; a point may leave them empty."""
        given = [n for n in names if n in column and fields[column[n]]]
        if not given:
            return None
        if len(given) != len(names):
            absent = ", ".join(n for n in names if n not in given)
            raise FileError(path, f"line {line}: has {', '.join(given)} but not {absent}", "give all of them or none")
        return numbers(*names)

    role = fields[column["role"]].lower() if "role" in column else ""
    if role not in ("", "control", "check"):
        raise FileError(
            path, f"line {line}: role = {role!r} is neither control nor check", "leave it empty for control"
        )
    try:
        return ControlPoint(
            name=name,
            xyz=numbers("X", "Y", "Z"),  # type: ignore[arg-type]
            xy=numbers("x", "y"),  # type: ignore[arg-type]
            role=cast(Literal["control", "check"], role or "control"),
            sigma_xyz=sigmas("sX", "sY", "sZ"),  # type: ignore[arg-type]
            sigma_xy=sigmas("sx", "sy"),  # type: ignore[arg-type]
        )
    except InvalidInputError as error:
        raise FileError(path, f"line {line}: {error}", "sigmas are not negative") from error


def write_points(path: str | Path, points: Iterable[ControlPoint]) -> None:
    """Writes all points with their roles, and with sigmas where any point has them."""
    points = list(points)
    object_sigmas = any(p.sigma_xyz is not None for p in points)
    photo_sigmas = any(p.sigma_xy is not None for p in points)
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(
        [*REQUIRED, "role", *(("sX", "sY", "sZ") if object_sigmas else ()), *(("sx", "sy") if photo_sigmas else ())]
    )
    for p in points:
        row: list[object] = [p.name, *map(repr, p.xyz.tolist()), *map(repr, p.xy.tolist()), p.role]
        if object_sigmas:
            row += [""] * 3 if p.sigma_xyz is None else map(repr, p.sigma_xyz.tolist())
        if photo_sigmas:
            row += [""] * 2 if p.sigma_xy is None else map(repr, p.sigma_xy.tolist())
        out.writerow(row)
    write_text(path, text.getvalue())
