"""Lists of points: round trips, forgiven habits, and refusals that say how to mend them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colourreg_rs import ControlPoint, FileError
from colourreg_rs.io.points import read_points, write_points

numbers = st.floats(-1e7, 1e7, allow_nan=False)
names = st.text(st.characters(blacklist_categories=("Cs", "Cc", "Zl", "Zp", "Zs")), min_size=1, max_size=12)


@settings(max_examples=60, deadline=None)
@given(st.dictionaries(names, st.tuples(*[numbers] * 5), min_size=1, max_size=6), st.booleans())
def test_what_is_written_is_read_bit_for_bit(tmp_path_factory, rows, sigmas):
    path = tmp_path_factory.mktemp("points") / "points.csv"
    points = [
        ControlPoint(
            name, v[:3], v[3:], "check" if i % 2 else "control",
            sigma_xyz=[0.001, 0.002, 0.003] if sigmas and i == 0 else None, sigma_xy=[0.5, 0.25] if sigmas else None,
        )
        for i, (name, v) in enumerate(rows.items())
    ]  # fmt: skip
    write_points(path, points)
    back = read_points(path)
    assert [p.name for p in back] == [p.name for p in points]
    for a, b in zip(points, back, strict=True):
        assert a.role == b.role
        assert np.array_equal(a.xyz, b.xyz) and np.array_equal(a.xy, b.xy)
        assert (a.sigma_xyz is None) == (b.sigma_xyz is None) and (a.sigma_xy is None) == (b.sigma_xy is None)


@pytest.mark.parametrize(
    "content",
    [
        b"name,X,Y,Z,x,y\nT1,1.5,2,3,4,5.25\n",
        b"\xef\xbb\xbfname,X,Y,Z,x,y\r\nT1,1.5,2,3,4,5.25\r\n",
        "name;X;Y;Z;x;y\nT1;1,5;2;3;4;5,25\n".encode("utf-16"),
        b"name\tX\tY\tZ\tx\ty\nT1\t1,5\t2\t3\t4\t5.25\n",
        b'"name", X , Y,Z,x,y,,\n\n "T1",1.5,2,3,4,5.25,,\n,,,,,\n',
        b"y,x,role,Z,Y,X,name,remark\n5.25,4,control,3,2,1.5,T1,corner\n",
    ],
)
def test_habits_of_spreadsheets_are_forgiven_where_the_meaning_is_certain(tmp_path, content):
    path = tmp_path / "points.csv"
    path.write_bytes(content)
    (point,) = read_points(path)
    assert point.name == "T1" and point.role == "control"
    assert point.xyz.tolist() == [1.5, 2, 3] and point.xy.tolist() == [4, 5.25]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is empty"),
        ("name,X,Y,Z,x,y\n", "has a header but no points"),
        ("T1,1,2,3,4,5\n", "the column name, X, Y, Z, x, y is missing"),
        ("name,x,y,z,px,py\nT1,1,2,3,4,5\n", "X, Y, Z is missing .upper case is the object"),
        ("name,X,Y,Z,x,y\nT1,1,5,2,3,4,5,25\n", "line 2: has 8 columns, the header has 6; .*semicolons"),
        ("name;X;Y;Z;x;y\nT1;1.234,5;2;3;4;5\n", "line 2: X = '1.234,5' could mean several numbers"),
        ("name,X,Y,Z,x,y\nT1,1,2,3,4,5\nT1,1,2,3,4,5\n", "line 3: the name 'T1' stands in line 2 too"),
        ("name,X,Y,Z,x,y\nT1,1,2,nan,4,5\n", "line 2: Z = 'nan' is not finite"),
        ("name,X,Y,Z,x,y\nT1,1,2,,4,5\n", "line 2: Z is empty"),
        ("name,X,Y,Z,x,y\nT1,1,2,3 m,4,5\n", "line 2: Z = '3 m' is not a number"),
        ("name,X,Y,Z,x,y\nT1,1,2,1_0,4,5\n", "line 2: Z = '1_0' is not a number"),
        ("name,X,Y,Z,x,y,role\nT1,1,2,3,4,5,chekc\n", "line 2: role = 'chekc'"),
        ("name,X,Y,Z,x,y,sx\nT1,1,2,3,4,5,1\n", "line 2: has sx but not sy"),
        ("name,X,Y,Z,x,y,sx,sy\nT1,1,2,3,4,5,1,-1\n", "line 2: .*negative"),
        ("name,X,Y,Z,x,y\n,1,2,3,4,5\n", "line 2: the point has no name"),
        ('name,X,Y,Z,x,y\n"T1,1,2,3,4,5\n', "line 2: .*quotes"),
        ("name,X,Y,Z,x,y,X\nT1,1,2,3,4,5,6\n", "the column X stands twice"),
        ("no table at all", "line 1: 'no table at all' has no columns"),
    ],
)
def test_what_is_not_certain_is_refused_with_its_line(tmp_path, content, message):
    path = tmp_path / "points.csv"
    path.write_text(content)
    with pytest.raises(FileError, match=message) as caught:
        read_points(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@given(st.binary(max_size=300))
@settings(max_examples=200, deadline=None)
def test_no_bytes_lead_to_anything_but_points_or_a_file_error(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("points") / "points.csv"
    path.write_bytes(content)
    try:
        assert read_points(path)
    except FileError:
        pass


def test_what_is_missing_or_no_file_is_said(tmp_path):
    with pytest.raises(FileError, match="does not exist"):
        read_points(tmp_path / "absent.csv")
    with pytest.raises(FileError, match="is a folder"):
        read_points(tmp_path)
    (tmp_path / "latin.csv").write_bytes("name,X,Y,Z,x,y\nT\xfcr,1,2,3,4,5\n".encode("latin-1"))
    with pytest.raises(FileError, match="line 2: is not UTF-8"):
        read_points(tmp_path / "latin.csv")
