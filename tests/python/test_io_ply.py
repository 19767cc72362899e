"""PLY: every encoding and every property survives a colouring bit for bit; broken files are one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from colourreg_rs import FileError, InvalidInputError, PointCloud
from colourreg_rs.io.clouds import create_cloud, open_cloud, read_cloud, write_cloud

KINDS = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4",
    "float64": "f8",
}  # fmt: skip
ENCODINGS = ["ascii", "binary_little_endian", "binary_big_endian"]


def parse(path: Path) -> tuple[list[str], dict[str, dict[str, list]]]:
    """A small PLY reader of these tests' own: header lines, and every value of every property of every element."""
    data = path.read_bytes()
    end = data.index(b"end_header")
    end = data.index(b"\n", end) + 1
    lines = data[:end].decode().split()
    lines = data[:end].decode().replace("\r\n", "\n").strip().split("\n")
    encoding = next(line.split()[1] for line in lines if line.startswith("format"))
    elements: list[tuple[str, int, list[list[str]]]] = []
    for line in lines:
        words = line.split()
        if words[0] == "element":
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property":
            elements[-1][2].append(words[1:])
    words_left = iter(data[end:].split()) if encoding == "ascii" else iter(())
    at = end

    def take(kind: str):
        nonlocal at
        dtype = np.dtype((">" if "big" in encoding else "<") + KINDS[kind])
        if encoding == "ascii":
            word = next(words_left)
            return dtype.type(word) if dtype.kind == "f" else int(word)
        value = np.frombuffer(data, dtype, 1, at)[0]
        at += dtype.itemsize
        return value

    out: dict[str, dict[str, list]] = {}
    for name, count, properties in elements:
        out[name] = {p[-1]: [] for p in properties}
        for _ in range(count):
            for p in properties:
                if p[0] == "list":
                    out[name][p[-1]].append([take(p[2]) for _ in range(int(take(p[1])))])
                else:
                    out[name][p[-1]].append(take(p[0]))
    assert next(words_left, None) is None and (encoding == "ascii" or at == len(data))
    return lines, out


def build(path: Path, encoding: str, elements: list, newline: str = "\n", comments: tuple[str, ...] = ()) -> None:
    """Writes (name, [(declaration, values), ...]) as PLY; values of lists are lists."""
    lines = ["ply", f"format {encoding} 1.0", *comments]
    body = b""
    order = ">" if "big" in encoding else "<"
    for name, columns in elements:
        count = len(columns[0][1])
        lines.append(f"element {name} {count}")
        lines += [f"property {declaration}" for declaration, _ in columns]
        for i in range(count):
            words = []
            for declaration, values in columns:
                parts = declaration.split()
                if parts[0] == "list":
                    row = [(parts[1], len(values[i])), *((parts[2], v) for v in values[i])]
                else:
                    row = [(parts[0], values[i])]
                for kind, value in row:
                    if encoding == "ascii":
                        words.append(str(value) if "f" not in KINDS[kind] else repr(float(value)))
                    else:
                        body += np.array(value, order + KINDS[kind]).tobytes()
            if encoding == "ascii":
                body += (" ".join(words) + newline).encode()
    path.write_bytes((newline.join(lines) + newline + "end_header" + newline).encode() + body)


def colour(source: Path, target: Path, rng: np.random.Generator, size: int = 1_000_000, only: str = "rgb source sigma"):
    with open_cloud(source) as reader:
        n = reader.n_points
        given_values = {
            "rgb": (rng.integers(0, 256, (n, 3)) * 256).astype(np.uint16),
            "source": rng.integers(0, 3, n).astype(np.uint16),
            "sigma": np.where(rng.random(n) < 0.2, np.nan, rng.random(n)).astype(np.float32),
        }
        given_values = {k: v for k, v in given_values.items() if k in only.split()}
        with create_cloud(target, reader) as out:
            for chunk in reader.chunks(size):
                part = slice(chunk.start, chunk.start + len(chunk))
                out.write(chunk, **{k: v[part] for k, v in given_values.items()})
    return given_values


def same(a: list, b: list) -> bool:
    return len(a) == len(b) and all(np.array(x).tobytes() == np.array(y).tobytes() for x, y in zip(a, b, strict=True))


def assert_coloured(
    source: Path, target: Path, values: dict, colours: tuple[str, ...] = ("red", "green", "blue")
) -> None:
    old_lines, old = parse(source)
    new_lines, new = parse(target)
    new_names = {*colours, "ColourSource", "ColourSigma"}
    for name, columns in old.items():
        for p, column in columns.items():
            if name != "vertex" or p not in new_names:
                assert same(column, new[name][p]), (name, p)
    kept = [line for line in new_lines if line.split()[-1] not in new_names]
    assert kept == [line for line in old_lines if line.split()[-1] not in new_names]
    if "rgb" in values:
        found = np.array([new["vertex"][c] for c in colours]).T
        if found.dtype == np.uint16 or found.max() > 255:
            assert np.array_equal(found, values["rgb"])
        elif found.dtype.kind == "f":
            assert np.allclose(found, values["rgb"] / 65535, atol=1e-7)
        else:
            assert np.array_equal(found, values["rgb"] // 256)
    if "source" in values:
        assert new["vertex"]["ColourSource"] == values["source"].tolist()
    if "sigma" in values:
        found = np.array(new["vertex"]["ColourSigma"], np.float32)
        assert np.array_equal(found, values["sigma"], equal_nan=True)


def test_files_of_other_programs(data_dir, tmp_path, rng):
    refused = {"no_vertex.ply": "no element 'vertex'", "sized_dims.ply": "without z"}
    read = 0
    for entry in json.loads((data_dir / "formats/manifest.json").read_text()):
        path = data_dir / "formats" / entry["file"]
        if path.suffix != ".ply":
            continue
        if path.name in refused:
            with pytest.raises(FileError, match=refused[path.name]):
                open_cloud(path)
            continue
        with open_cloud(path) as reader:
            if "elements" in entry:  # plyfile does not read two of them
                assert reader.n_points == entry["elements"]["vertex"]["n"]
                names = [p.name for p in reader.vertex.properties]
                assert names == entry["elements"]["vertex"]["props"]
            _, values = parse(path)
            assert np.array_equal(read_cloud(path).xyz.T.astype("f4"), [values["vertex"][c] for c in "xyz"])
        assert_coloured(path, tmp_path / "out.ply", colour(path, tmp_path / "out.ply", rng))
        read += 1
    assert read == 4


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("colours", [None, "uchar", "ushort", "float", "int"])
@pytest.mark.parametrize("size", [1_000_000, 7])
def test_every_encoding_and_kind_of_colour(tmp_path, rng, encoding, colours, size):
    n = 20
    xyz = rng.normal(5e6, 10, (n, 3))
    high = {"uchar": 256, "ushort": 65536, "float": 1, "int": 256}.get(colours)
    rgb = rng.random((n, 3)).astype("f4") if colours == "float" else rng.integers(0, high or 1, (n, 3))
    vertex = [
        ("double x", xyz[:, 0]), ("uchar class", rng.integers(0, 9, n)),
        ("double y", xyz[:, 1]), ("double z", xyz[:, 2]),
        *([(f"{colours} {c}", rgb[:, i]) for i, c in enumerate(("red", "green", "blue"))] if colours else []),
        ("float intensity", rng.random(n).astype("f4")), ("int time", rng.integers(-(2**31), 2**31, n)),
    ]  # fmt: skip
    faces = [
        ("list uchar int vertex_indices", [list(range(3 + i % 3)) for i in range(9)]),
        ("short group", [*range(9)]),
    ]
    before = [("list uint8 float32 numbers", [[0.5], [], [1.5, 2.5]])]
    source, target = tmp_path / "in.ply", tmp_path / "out.ply"
    comments = ("comment made by a tëst", "obj_info something else")
    build(source, encoding, [("camera", before), ("vertex", vertex), ("face", faces)], comments=comments)
    with open_cloud(source) as reader:
        cloud = read_cloud(source)
        assert cloud.xyz.tobytes() == np.ascontiguousarray(xyz).tobytes()
        assert reader.has_rgb == bool(colours) and cloud.intensity.dtype == np.float32
        assert [a.name for a in reader.attributes] == ["class", "time"]
        assert reader.unconverted == ("3 rows of 'camera'", "9 rows of 'face'")
        if colours in ("uchar", "int"):
            assert np.array_equal(cloud.rgb, rgb * 256)
        elif colours == "ushort":
            assert np.array_equal(cloud.rgb, rgb)
    values = colour(source, target, rng, size)
    assert_coloured(source, target, values)
    assert values["rgb"].tobytes() == read_cloud(target).rgb.tobytes() or colours == "float"
    again = tmp_path / "again.ply"
    assert_coloured(target, again, colour(target, again, rng, size))
    assert parse(again)[0] == parse(target)[0]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_lists_among_the_points(tmp_path, rng, encoding):
    n = 11
    vertex = [
        ("float x", rng.normal(size=n).astype("f4")),
        ("list uchar ushort views", [list(range(i % 4)) for i in range(n)]),
        ("float y", rng.normal(size=n).astype("f4")), ("float z", rng.normal(size=n).astype("f4")),
        ("uchar green", [7] * n), ("uchar red", [8] * n), ("uchar blue", [9] * n),
    ]  # fmt: skip
    source, target = tmp_path / "in.ply", tmp_path / "out.ply"
    build(source, encoding, [("vertex", vertex), ("face", [("list uchar int i", [[1], []])])])
    assert read_cloud(source).rgb.tolist() == [[8 * 256, 7 * 256, 9 * 256]] * n
    assert np.array_equal(read_cloud(source).xyz[:, 1].astype("f4"), vertex[2][1])
    for size in (100, 3):
        assert_coloured(source, target, colour(source, target, rng, size))
    with open_cloud(source) as reader, pytest.raises(FileError, match="lists views"):
        create_cloud(tmp_path / "out.laz", reader)


def test_text_keeps_its_line_ends_and_digits(tmp_path, rng):
    source, target = tmp_path / "in.ply", tmp_path / "out.ply"
    body = "1.250000000000001 2e0 3 text\r\n".replace(" text", "")
    source.write_bytes(
        b"ply\r\nformat ascii 1.0\r\nelement vertex 2\r\nproperty float x\r\nproperty float y\r\nproperty float z\r\n"
        b"end_header\r\n" + body.encode() + b"\r\n" + b"  -nan 0 1e-3  \r\n"
    )
    colour(source, target, rng, only="source")
    tail = target.read_bytes().split(b"end_header\r\n")[1].split(b"\r\n")
    assert tail[0].startswith(b"1.250000000000001 2e0 3 ") and tail[1].startswith(b"-nan 0 1e-3 ") and tail[2] == b""
    cloud = read_cloud(source)
    assert cloud.xyz[0, 0] == 1.250000000000001 and np.isnan(cloud.xyz[1, 0])


def test_only_what_is_given_is_added(tmp_path, rng):
    source, target = tmp_path / "in.ply", tmp_path / "out.ply"
    build(source, ENCODINGS[1], [("vertex", [(f"float {c}", [1.0, 2.0]) for c in "xyz"])])
    colour(source, target, rng, only="")
    assert target.read_bytes() == source.read_bytes()
    colour(source, target, rng, only="sigma")
    assert list(parse(target)[1]["vertex"]) == ["x", "y", "z", "ColourSigma"]


def test_a_property_of_the_same_name_but_another_type_is_kept_aside(tmp_path, rng):
    source, target = tmp_path / "in.ply", tmp_path / "out.ply"
    columns = [*((f"float {c}", [1.0, 2.0]) for c in "xyz"), ("double ColourSource", [0.25, 0.5])]
    build(source, ENCODINGS[2], [("vertex", columns)])
    values = colour(source, target, rng)
    new = parse(target)[1]["vertex"]
    assert new["ColourSource_before"] == [0.25, 0.5] and new["ColourSource"] == values["source"].tolist()


declarations = st.sampled_from(sorted(KINDS))


@st.composite
def files(draw):
    """Any element table whose vertex has x, y, z somewhere."""
    n = draw(st.integers(1, 5))

    def value(kind: str):
        dtype = np.dtype(KINDS[kind])
        if dtype.kind == "f":
            return draw(st.floats(width=8 * dtype.itemsize, allow_nan=False))
        return draw(st.integers(int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)))

    def column(name: str, count: int, lists: bool):
        kind = draw(declarations)
        if lists and draw(st.integers(0, 3)) == 0:
            counted = draw(st.sampled_from(["uchar", "int", "uint16"]))
            rows = [[value(kind) for _ in range(draw(st.integers(0, 3)))] for _ in range(count)]
            return (f"list {counted} {kind} {name}", rows)
        return (f"{kind} {name}", [value(kind) for _ in range(count)])

    vertex = [column(c, n, False) for c in "xyz"]
    vertex += [
        column(name, n, True) for name in draw(st.lists(st.sampled_from(["a", "intensity", "nx", "q"]), unique=True))
    ]
    vertex = draw(st.permutations(vertex))
    elements = [("vertex", vertex)]
    for name in draw(st.lists(st.sampled_from(["face", "edge"]), unique=True)):
        count = draw(st.integers(0, 4))
        elements.insert(draw(st.integers(0, 1)), (name, [column(c, count, True) for c in ("u", "v")]))
    return draw(st.sampled_from(ENCODINGS)), elements


@settings(
    max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True
)
@given(files(), st.integers(1, 6))
def test_any_table_survives(tmp_path, file, size):
    encoding, elements = file
    source, target = tmp_path / "in.ply", tmp_path / "out.ply"
    build(source, encoding, elements)
    _, values = parse(source)
    found = read_cloud(source).xyz
    assert np.array_equal(found.T, np.array([values["vertex"][c] for c in "xyz"], np.float64)) or encoding == "ascii"
    assert_coloured(source, target, colour(source, target, np.random.default_rng(1), size))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_truncated_files_are_refused_in_one_line(tmp_path, rng, encoding):
    columns = [*((f"float {c}", rng.normal(size=9).astype("f4")) for c in "xyz"), ("uchar red", [250] * 9)]
    whole = tmp_path / "whole.ply"
    build(whole, encoding, [("vertex", columns), ("face", [("list uchar int v", [[100, 200, 300]] * 4)])])
    data = whole.read_bytes()
    source, target = tmp_path / "in.ply", tmp_path / "out" / "out.ply"
    target.parent.mkdir()
    spare = 3 if encoding == "ascii" else 0  # digits of the last number, and the last line end, are not missed
    for cut in range(len(data) - spare):
        source.write_bytes(data[:cut])
        with pytest.raises(FileError) as caught:
            colour(source, target, rng)
        assert "\n" not in str(caught.value) and str(source) in str(caught.value)
    assert list(target.parent.iterdir()) == []


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True
)
@given(st.data())
def test_damaged_files_end_in_a_cloud_or_in_one_line(tmp_path, data):
    encoding = data.draw(st.sampled_from(ENCODINGS))
    source, target = tmp_path / "in.ply", tmp_path / "out.ply"
    columns = [*((f"float {c}", [0.5, 1.5, 2.5]) for c in "xyz"), ("list uchar short l", [[1], [], [2, 3]])]
    build(source, encoding, [("vertex", columns), ("face", [("list uchar int v", [[0, 1, 2]] * 2)])])
    raw = bytearray(source.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    source.write_bytes(raw)
    try:
        colour(source, target, np.random.default_rng(0))
    except FileError as error:
        assert "\n" not in str(error)


HEAD = "ply\nformat ascii 1.0\nelement vertex {n}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("ply\nformat ascii 2.0\nend_header\n", "line 2"),
        ("ply\nelement vertex 1\nproperty float x\nend_header\n", "no line with its format"),
        (HEAD.format(n=0), "holds no points"),
        (HEAD.format(n=1) + "1 2 x\n", "point 1: 'x' is no number"),
        (HEAD.format(n=1) + "1 2\n", "has 2 numbers, not 3"),
        (HEAD.format(n=1) + "1 2 3 4\n", "has 4 numbers, not 3"),
        (HEAD.format(n=1) + "1,0 2,0 3,0\n", "is no number"),
        (HEAD.format(n=10**14) + "1 2 3\n", "announces 100,000,000,000,000 points"),
        (HEAD.format(n=-1) + "1 2 3\n", "line 3"),
        (HEAD.format(n=1).replace("float z", "float y") + "1 2 3\n", "two properties 'y'"),
        (HEAD.format(n=1).replace("float z", "quad z") + "1 2 3\n", "line 6"),
        (HEAD.format(n=1).replace("property float z", "property list float int z") + "1 2 3\n", "line 6"),
        (HEAD.format(n=1).replace("\n", "\r") + "1 2 3\r", "old Macintoshes"),
        (HEAD.format(n=1).replace("ascii", "binary_little_endian").replace("z", "z\nproperty list uchar int l")
         + "abcdefghijkl\xff", "list of 255 values"),
        (HEAD.format(n=10**9).replace("ascii", "binary_big_endian") + "abc", "holds only 0"),
    ],
)  # fmt: skip
def test_absurd_files_are_named(tmp_path, text, word):
    path = tmp_path / "p.ply"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(FileError) as caught, open_cloud(path) as reader:
        list(reader.chunks())
    assert word in str(caught.value) and "\n" not in str(caught.value)


# --- other formats as PLY, and PLY as LAS -----------------------------------------------------------------------


def test_memory_to_every_format_and_back(tmp_path, rng):
    n = 1000
    cloud = PointCloud(
        rng.normal(5e6, 30, (n, 3)).round(4),
        rng.integers(0, 65536, n).astype(np.uint16),
        (rng.integers(0, 256, (n, 3)) * 256).astype(np.uint16),
        rng.normal(size=(n, 3)),
        'PROJCS["somewhere"]',
    )
    extra = {
        "truth": rng.random(n),
        "ring": rng.integers(0, 64, n).astype(np.uint8),
        "Intensity 2": rng.random(n, "f4"),
    }
    for suffix in (".ply", ".las", ".laz"):
        path = tmp_path / f"c{suffix}"
        write_cloud(path, cloud, extra)
        write_cloud(path, cloud, extra)  # over what is there
        back = read_cloud(path)
        assert np.abs(back.xyz - cloud.xyz).max() <= (0 if suffix == ".ply" else 5.01e-6)
        assert np.array_equal(back.intensity, cloud.intensity) and np.array_equal(back.rgb, cloud.rgb)
        assert np.array_equal(back.normals, cloud.normals) and back.crs_wkt == cloud.crs_wkt
        with open_cloud(path) as reader:
            columns = next(iter(reader.chunks())).columns()
        assert np.array_equal(columns["truth"], extra["truth"]) and np.array_equal(columns["ring"], extra["ring"])
    with pytest.raises(FileError, match="without points"):
        write_cloud(tmp_path / "c.ply", PointCloud(np.empty((0, 3))))
    with pytest.raises(InvalidInputError, match="shape"):
        write_cloud(tmp_path / "c.ply", cloud, {"a": np.zeros(3)})


def test_what_is_written_is_the_same_every_time(tmp_path, rng):
    cloud = PointCloud(rng.normal(size=(100, 3)))
    for suffix in (".ply", ".las", ".laz"):
        for name in ("a", "b"):
            write_cloud(tmp_path / (name + suffix), cloud)
        assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_ply_to_las(tmp_path, rng, suffix):
    import laspy

    n = 500
    xyz = rng.normal([4e5, 5.7e6, 100], 20, (n, 3))
    grey = rng.normal(0, 100, n).astype("f4")
    vertex = [
        *((f"double {c}", xyz[:, i]) for i, c in enumerate("xyz")),
        ("float intensity", grey),
        ("int classification", rng.integers(-5, 5, n)),
        ("ushort ColourSource", rng.integers(0, 9, n)),
    ]
    source, target = tmp_path / "in.ply", tmp_path / f"out{suffix}"
    build(source, ENCODINGS[1], [("vertex", vertex), ("face", [("list uchar int v", [[0, 1, 2]])])])
    with open_cloud(source) as reader, create_cloud(target, reader) as out:
        assert any("1 rows of 'face'" in line for line in out.warnings) and any(
            "1e-05" in line for line in out.warnings
        )
        for chunk in reader.chunks(99):
            rgb = np.full((len(chunk), 3), 77, np.uint16)
            out.write(chunk, rgb, np.full(len(chunk), 3, np.uint16), np.full(len(chunk), 0.5, np.float32))
    las = laspy.read(target)
    assert las.point_format.id == 7 and np.abs(las.xyz - xyz).max() <= 5.01e-6
    assert np.array_equal(las["intensity_original"], grey)
    order = np.argsort(grey, kind="stable")
    assert (np.diff(las.intensity[order].astype(int)) >= 0).all() and las.intensity.max() == 65535
    assert np.array_equal(las["classification_2"], vertex[4][1])
    assert list(las.point_format.extra_dimension_names) == [
        "intensity_original", "classification_2", "ColourSource", "ColourSigma",
    ]  # fmt: skip
    assert (las["ColourSource"] == 3).all() and (las.red == 77).all() and (las.return_number == 1).all()
    assert np.allclose(las.header.mins, las.xyz.min(axis=0), atol=1e-9)
    assert las.header.point_count == n and las.header.number_of_points_by_return[0] == n


@pytest.mark.parametrize(
    ("size", "centre", "worst"),
    [(1e-3, 0, 1e-9), (5, 0, 1e-6), (300, 1e6, 1e-5), (1e5, 0, 1e-4), (1e7, 0, 1e-2), (0, 5e6, 1e-5), (2, 6e9, 1e-5)],
)
def test_the_step_of_las_coordinates_follows_the_size(tmp_path, rng, size, centre, worst):
    xyz = centre + rng.uniform(-size / 2, size / 2, (100, 3))
    write_cloud(tmp_path / "c.las", PointCloud(xyz))
    assert np.abs(read_cloud(tmp_path / "c.las").xyz - xyz).max() <= worst / 2 * 1.01 + np.spacing(abs(centre))


def test_points_without_coordinates_do_not_fit_into_las(tmp_path, rng):
    xyz = rng.normal(size=(10, 3))
    xyz[3, 1] = np.nan
    with pytest.raises(FileError, match=r"1 points .*suffix \.ply"):
        write_cloud(tmp_path / "c.laz", PointCloud(xyz))
    write_cloud(tmp_path / "c.ply", PointCloud(xyz))
    assert np.array_equal(read_cloud(tmp_path / "c.ply").xyz, xyz, equal_nan=True)
    assert [p.name for p in tmp_path.iterdir()] == ["c.ply"]


def test_las_to_ply(data_dir, tmp_path, rng):
    import laspy

    for name in ("laspy/fullwave.laz", "las-rs/extrabytes.laz", "laspy/1_4_w_evlr.las", "pdal/gps-time-nan.las"):
        source, target = data_dir / "formats/las" / name, tmp_path / "out.ply"
        values = colour(source, target, rng, 700)
        las = laspy.read(source)
        _, found = parse(target)
        vertex = {k: np.array(v) for k, v in found["vertex"].items()}
        assert np.array_equal(np.stack([vertex[c] for c in "xyz"], axis=1), las.xyz)
        for dimension in las.point_format.dimensions:
            if dimension.name in ("X", "Y", "Z", "red", "green", "blue") or dimension.num_elements > 1:
                continue
            wanted = np.asarray(las[dimension.name])
            other = vertex[dimension.name if dimension.name in vertex else dimension.name + "_2"]
            assert np.array_equal(other.astype(wanted.dtype), wanted, equal_nan=wanted.dtype.kind == "f"), (
                dimension.name
            )
        assert np.array_equal(vertex["red"], values["rgb"][:, 0] // 256)
        assert read_cloud(target).crs_wkt == (" ".join(w.split()) if (w := read_cloud(source).crs_wkt) else None)
