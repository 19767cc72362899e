"""Points CSV: spreadsheet habits with one meaning are forgiven, everything else is named with its line."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from colourreg_rs import ControlPoint, FileError, InvalidInputError
from colourreg_rs.io.points import read_points, write_points

PLAIN = "name,X,Y,Z,x,y\nT1,1.5,2,3,10.25,20\nT2,-4,5e1,.5,7,8.\n"


def test_the_plain_file(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text(PLAIN)
    first, second = read_points(path)
    assert (first.name, first.role, first.sigma_xyz, first.sigma_xy) == ("T1", "control", None, None)
    assert first.xyz.tolist() == [1.5, 2, 3] and first.xy.tolist() == [10.25, 20]
    assert second.xyz.tolist() == [-4, 50, 0.5] and second.xy.tolist() == [7, 8]


@pytest.mark.parametrize(
    "data",
    [
        b"\xef\xbb\xbf" + PLAIN.encode(),
        PLAIN.encode("utf-16"),
        b"\xfe\xff" + PLAIN.encode("utf-16-be"),
        PLAIN.replace("\n", "\r\n").encode(),
        PLAIN.replace(",", ";").encode(),
        PLAIN.replace(",", "\t").encode(),
        PLAIN.replace(",", ";").replace(".", ",").encode(),
        PLAIN.replace(",", "\t").replace(".", ",").encode(),
        ("sep=;\r\n" + PLAIN.replace(",", ";")).encode(),
        PLAIN.replace("\n", ",,,\n").encode(),
        PLAIN.replace("\n", "\n\n").encode(),
        PLAIN.replace("\n", "\n,,,,,\n").encode(),
        ("\n\n" + PLAIN).encode(),
        PLAIN.replace("T1", '"T1"').replace("1.5", '"1.5"').encode(),
        PLAIN.replace(",", " , ").encode(),
        PLAIN[:-1].encode(),
        PLAIN.replace("-4", "−4").encode(),
    ],
)
def test_habits_with_one_meaning_are_forgiven(tmp_path, data):
    path = tmp_path / "p.csv"
    path.write_bytes(data)
    points = read_points(path)
    assert [p.name for p in points] == ["T1", "T2"]
    assert [p.xyz.tolist() for p in points] == [[1.5, 2, 3], [-4, 50, 0.5]]
    assert [p.xy.tolist() for p in points] == [[10.25, 20], [7, 8]]


def test_names_of_the_windows_code_page(tmp_path):
    path = tmp_path / "p.csv"
    path.write_bytes("name;X;Y;Z;x;y\nTür;1;2;3;4;5\n".encode("cp1252"))
    assert read_points(path)[0].name == "Tür"


def test_columns_in_any_order_with_roles_and_sigmas(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("role,x,y,name,Z,Y,X,sx,sy,sX,sY,sZ\nCheck,1,2,a,3,4,5,.1,.2,.3,.4,.5\n,1,2,b,3,4,6,,,,,\n")
    a, b = read_points(path)
    assert a.role == "check" and b.role == "control"
    assert a.xyz.tolist() == [5, 4, 3] and a.sigma_xy.tolist() == [0.1, 0.2] and a.sigma_xyz.tolist() == [0.3, 0.4, 0.5]
    assert b.sigma_xy is None and b.sigma_xyz is None


H = "name,X,Y,Z,x,y\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["is empty", "name,X,Y,Z,x,y"]),
        (H, ["no points"]),
        ("just a sentence\n", ["line 1", "names no columns"]),
        ("T1,1,2,3,4,5\nT2,1,2,4,4,5\n", ["line 1 (T1,1,2,3,4,5)", "names no columns", "put a line name,X,Y,Z,x,y"]),
        ("T1;1,5;2,5;3;4;5\n", ["line 1", "names no columns", "name;X;Y;Z;x;y"]),
        (H + f"T1,1{'0' * 300},2,3,4,5\n", ["line 2, column X", "10000", "…", "too large"]),
        ("name,X,Y,Z,x\nT1,1,2,3,4\n", ["line 1", "column y is missing"]),
        ("name,x,y,z,u,v\nT1,1,2,3,4,5\n", ["line 1", "column X, Y, Z is missing"]),
        ("name,X,Y,Z,X,Y\nT1,1,2,3,4,5\n", ["line 1", "'X' is there twice", "photo coordinates"]),
        ("name,X,Y,Z,x,y,Role\nT1,1,2,3,4,5,check\n", ["line 1", "'Role' is not known", "write 'role'"]),
        ("name,X,Y,Z,x,y,note\nT1,1,2,3,4,5,a\n", ["line 1", "'note' is not known", "delete it"]),
        ("name,X,Y,Z,x,y,sX\nT1,1,2,3,4,5,6\n", ["line 1", "sX without sY, sZ"]),
        (H + "T1,1,2,3,4\n", ["line 2", "5 values, the header 6"]),
        (H + "T1,1,5,2,5,3,5,4,5,5,5\n", ["line 2", "11 values", "semicolons"]),
        (H + 'T1,"1,5",2,3,4,5\n', ["line 2, column X", "'1,5'", "decimal comma"]),
        (H + "T1,1,2,3,4,5\nT1,1,2,3,4,5\n", ["lines 2 and 3", "'T1'"]),
        (H + "\n\nT1,1,2,3,4,5\n\nT1,1,2,3,4,5\n", ["lines 4 and 6"]),
        (H + ",1,2,3,4,5\n", ["line 2", "without a name"]),
        (H + "T1,,2,3,4,5\n", ["line 2, column X", "is empty"]),
        (H + "T1,nan,2,3,4,5\n", ["line 2, column X", "no finite number"]),
        (H + "T1,-inf,2,3,4,5\n", ["column X", "no finite number"]),
        (H + "T1,1e999,2,3,4,5\n", ["column X", "too large"]),
        (H + "T1,1,2,3,0x10,5\n", ["line 2, column x", "no number"]),
        (H + "T1,1,2,3,1_000,5\n", ["column x", "no number"]),
        (H + "T1,1,2,3.0 m,4,5\n", ["column Z", "unit"]),
        (H + "T1,52°31'N,2,3,4,5\n", ["column X", "angle"]),
        (H.replace(",", ";") + "T1;1.234,56;2;3;4;5\n", ["column X", "thousands"]),
        (H.replace(",", ";") + "T1;1 234.5;2;3;4;5\n", ["column X", "thousands"]),
        (H.replace(",", ";") + "T1;1'234.5;2;3;4;5\n", ["column X", "thousands"]),
        (H.replace(",", ";") + "T1;1.5;2,5;3;4;5\n", ["line 2", "different decimal signs"]),
        (H.replace(",", ";") + "T1;1.5;2;3;4;5\nT2;1,5;2;3;4;5\n", ["line 3", "line 2", "different decimal signs"]),
        ("name,X,Y,Z,x,y,role\nT1,1,2,3,4,5,chek\n", ["line 2, column role", "'chek'", "control or check"]),
        ("name,X,Y,Z,x,y,sx,sy\nT1,1,2,3,4,5,1,\n", ["line 2, column sy", "is empty"]),
        ("name,X,Y,Z,x,y,sx,sy\nT1,1,2,3,4,5,1,-1\n", ["line 2, column sy", "negative"]),
        (H + 'T1,"1,2,3,4,5\n', ["line 2", "quotation"]),
        ("a\0b", ["not a text file"]),
        ("PK\x03\x04xxxx", ["is a spreadsheet"]),
    ],
)
def test_what_is_not_certain_is_refused_with_its_line(tmp_path, text, words):
    path = tmp_path / "p.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileError) as caught:
        read_points(path)
    message = str(caught.value)
    assert "\n" not in message and str(path) in message
    for word in words:
        assert word in message


finite = st.floats(-1e12, 1e12, exclude_min=True, exclude_max=True)
names = st.text(st.characters(blacklist_categories=("Cs", "Cc")), min_size=1, max_size=12).filter(
    lambda s: s == s.strip()
)
point = st.builds(
    lambda name, xyz, xy, role, sxyz, sxy: ControlPoint(
        name,
        np.array(xyz),
        np.array(xy),
        role,
        None if sxyz is None else np.array(sxyz),
        None if sxy is None else np.array(sxy),
    ),
    names,
    st.tuples(finite, finite, finite),
    st.tuples(finite, finite),
    st.sampled_from(["control", "check"]),
    st.none() | st.tuples(*[st.floats(0, 1e6)] * 3),
    st.none() | st.tuples(*[st.floats(0, 1e6)] * 2),
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(st.lists(point, min_size=1, max_size=6, unique_by=lambda p: p.name))
def test_what_is_written_is_read_to_the_last_bit(tmp_path, points):
    path = tmp_path / "p.csv"
    write_points(path, points)
    back = read_points(path)
    for a, b in zip(points, back, strict=True):
        assert (a.name, a.role) == (b.name, b.role)
        for key in ("xyz", "xy", "sigma_xyz", "sigma_xy"):
            x, y = getattr(a, key), getattr(b, key)
            assert (x is None) == (y is None) and (x is None or x.tobytes() == y.tobytes())


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True
)
@given(st.binary(max_size=300) | st.text(max_size=200).map(lambda s: (H + s).encode("utf-8", "replace")))
def test_any_bytes_end_in_points_or_in_one_line(tmp_path, data):
    path = tmp_path / "p.csv"
    path.write_bytes(data)
    try:
        assert read_points(path)
    except FileError as error:
        assert "\n" not in str(error)


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(FileError, match="does not exist"):
        read_points(tmp_path / "none.csv")
    with pytest.raises(FileError, match="is a folder"):
        read_points(tmp_path)
    with pytest.raises(FileError, match="does not exist"):
        write_points(tmp_path / "no" / "p.csv", [])
    with pytest.raises(InvalidInputError, match="begin or end with a blank"):
        write_points(tmp_path / "p.csv", [ControlPoint(" a", np.zeros(3), np.zeros(2))])
    assert list(tmp_path.iterdir()) == []


def test_what_the_csv_module_reads_is_the_same(tmp_path):
    path = tmp_path / "p.csv"
    write_points(path, [ControlPoint('a "quoted", name; Ü', np.array([1e7 + 0.1, 2, 3]), np.array([4, 5.5]))])
    row = next(csv.DictReader(io.StringIO(path.read_text())))
    assert row["name"] == 'a "quoted", name; Ü' and float(row["X"]) == 1e7 + 0.1 and float(row["y"]) == 5.5
