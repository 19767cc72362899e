"""PCD: the three encodings agree, packed colours are taken apart, and every field is in the output."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest

from colourreg_rs import FileError
from colourreg_rs.io.clouds import create_cloud, open_cloud, read_cloud

CODES = {"i": "I", "u": "U", "f": "F"}


def lzf(data: bytes) -> bytes:
    """LZF with literals and back references to the last place where three bytes stood, for these tests."""
    out, literals, seen, i = bytearray(), bytearray(), {}, 0

    def flush() -> None:
        for k in range(0, len(literals), 32):
            run = literals[k : k + 32]
            out.append(len(run) - 1)
            out.extend(run)
        literals.clear()

    while i < len(data):
        key = data[i : i + 3]
        at = seen.get(key, -1)
        seen[key] = i
        if len(key) == 3 and at >= 0 and i - at <= 8192:
            length = 3
            while length < 264 and i + length < len(data) and data[at + length] == data[i + length]:
                length += 1
            flush()
            distance, code = i - at - 1, length - 2
            out.append((min(code, 7) << 5) | (distance >> 8))
            if code >= 7:
                out.append(code - 7)
            out.append(distance & 255)
            i += length
        else:
            literals.append(data[i])
            i += 1
    flush()
    return bytes(out)


def build(
    path: Path, encoding: str, fields: list, width: int, height: int = 1, viewpoint: str = "0 0 0 1 0 0 0"
) -> None:
    """Fields are (name, (N, count) array)."""
    n = width * height
    lines = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7"]
    lines.append("FIELDS " + " ".join(name for name, _ in fields))
    lines.append("SIZE " + " ".join(str(v.dtype.itemsize) for _, v in fields))
    lines.append("TYPE " + " ".join(CODES[v.dtype.kind] for _, v in fields))
    lines.append("COUNT " + " ".join(str(v.shape[1]) for _, v in fields))
    lines += [f"WIDTH {width}", f"HEIGHT {height}", f"VIEWPOINT {viewpoint}", f"POINTS {n}", f"DATA {encoding}"]
    head = ("\n".join(lines) + "\n").encode()
    if encoding == "ascii":
        rows = [" ".join(repr(x.item()) for _, v in fields for x in v[i]) for i in range(n)]
        body = ("\n".join(rows) + "\n").encode()
    elif encoding == "binary":
        body = b"".join(v[i].tobytes() for i in range(n) for _, v in fields)
    else:
        raw = b"".join(v.tobytes() for _, v in fields)
        packed = lzf(raw)
        body = struct.pack("<II", len(packed), len(raw)) + packed
    path.write_bytes(head + body)


def everything(rng: np.random.Generator, n: int) -> list:
    rgb = rng.integers(0, 2**24, (n, 1)).astype("u4")
    xyz = [(c, rng.normal(size=(n, 1)).astype("f4")) for c in "xyz"]
    return [
        ("label", rng.integers(0, 2**32, (n, 1)).astype("u4")), xyz[2], xyz[0], ("_", np.zeros((n, 3), "u1")), xyz[1],
        ("rgb", rgb.view("f4")), ("intensity", rng.random((n, 1)).astype("f4")),
        ("ring", rng.integers(0, 99, (n, 1)).astype("u2")),
        ("t", rng.random((n, 1))), ("hist", rng.random((n, 4)).astype("f4")),
        ("s", rng.integers(-99, 99, (n, 2)).astype("i1")),
        ("normal_x", rng.random((n, 1)).astype("f4")), ("normal_y", rng.random((n, 1)).astype("f4")),
        ("normal_z", rng.random((n, 1)).astype("f4")), ("id", rng.integers(0, 2**60, (n, 1)).astype("u8")),
    ]  # fmt: skip


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("size", [1_000_000, 7])
def test_every_encoding(tmp_path, rng, encoding, size):
    fields = everything(rng, 60)
    if encoding == "ascii":  # packed colours as floats lose nothing here, but signalling NaNs would be no fair test
        fields = [f for f in fields if f[0] != "_"]
    columns = dict(fields)
    path = tmp_path / "c.pcd"
    build(path, encoding, fields, 10, 6, "1 2 3 0 1 0 0")
    packed = columns["rgb"].view("u4")
    with open_cloud(path) as reader:
        assert reader.n_points == 60 and reader.description()["height"] == 6
        chunks = list(reader.chunks(size))
        found = [c.columns() for c in chunks]
        for name in ("label", "ring", "t", "id"):
            assert np.concatenate([c[name] for c in found]).tobytes() == columns[name].tobytes(), name
        for name in ("hist", "s"):
            for i in range(columns[name].shape[1]):
                assert np.array_equal(np.concatenate([c[f"{name}_{i}"] for c in found]), columns[name][:, i])
        assert {a.name: a.dtype for a in reader.attributes}["s_1"] == np.int8
        assert "_" not in found[0] and "rgb" not in found[0]
        xyz = np.concatenate([columns[c] for c in "xyz"], axis=1)
        assert np.array_equal(np.concatenate([c.xyz for c in chunks]).astype("f4"), xyz)
        rgb = np.concatenate([c.rgb for c in chunks])
        assert np.array_equal(rgb, np.concatenate([packed >> 16, packed >> 8 & 255, packed & 255], axis=1) * 256)
        assert np.array_equal(np.concatenate([c.intensity for c in chunks]), columns["intensity"][:, 0])
        assert np.array_equal(np.concatenate([c.normals for c in chunks])[:, 1], columns["normal_y"][:, 0])


def colour(source: Path, target: Path, size: int = 1_000_000):
    with open_cloud(source) as reader, create_cloud(target, reader) as out:
        for chunk in reader.chunks(size):
            n = len(chunk)
            out.write(chunk, np.full((n, 3), 512, np.uint16), np.full(n, 7, np.uint16), np.full(n, 0.5, np.float32))
        return out.warnings


def test_into_laz_with_every_field(tmp_path, rng):
    fields = everything(rng, 60)
    columns = dict(fields)
    build(tmp_path / "c.pcd", "binary", fields, 60)
    colour(tmp_path / "c.pcd", tmp_path / "c.laz", 7)
    las = laspy.read(tmp_path / "c.laz")
    for name in ("label", "ring", "t", "id"):
        assert las[name].tobytes() == columns[name].tobytes()
    for i in range(4):
        assert np.array_equal(las[f"hist_{i}"], columns["hist"][:, i])
    assert np.array_equal(las["intensity_original"], columns["intensity"][:, 0])
    assert np.array_equal(las["NormalZ"], columns["normal_z"][:, 0])
    assert (las.red == 512).all() and (las["ColourSource"] == 7).all() and (las["ColourSigma"] == 0.5).all()
    assert np.abs(las.x - columns["x"][:, 0]).max() < 1e-6
    with pytest.raises(FileError, match=r"64-bit integers of id.*\.laz"):
        colour(tmp_path / "c.pcd", tmp_path / "c.ply")
    assert not (tmp_path / "c.ply").exists()


def test_the_kinect_clouds_into_ply_with_their_empty_points(data_dir, tmp_path):
    for name, empty in (("learn0.pcd", 124_908), ("region_growing_rgb_tutorial.pcd", 47_353)):
        source, target = data_dir / "pcl_osd_kinect" / name, tmp_path / "c.ply"
        colour(source, target, 100_000)
        before, after = read_cloud(source), read_cloud(target)
        assert int(np.isnan(before.xyz).any(axis=1).sum()) == empty
        assert before.xyz.tobytes() == after.xyz.tobytes()
        assert (after.rgb == 512).all()
        head = target.read_bytes()[:2000]
        assert b"obj_info pcd_width 640" in head and b"obj_info pcd_viewpoint 0 0 0" in head
        with open_cloud(source) as reader, pytest.raises(FileError, match=rf"{empty:,} points .*\.ply"):
            create_cloud(tmp_path / "c.laz", reader)
    with open_cloud(data_dir / "pcl_osd_kinect/learn0.pcd") as reader, open_cloud(tmp_path / "c.ply") as other:
        first, second = next(iter(reader.chunks())), next(iter(other.chunks()))
        assert set(first.columns()) == {"label", "alpha"}
        assert "alpha" not in second.columns()  # the other cloud's colours have no alpha


def test_files_of_other_programs(data_dir):
    tab, comma = (read_cloud(data_dir / "formats/pcd/pdal" / f"utm17_{name}.pcd") for name in ("tab", "comma"))
    assert tab.xyz.tobytes() == comma.xyz.tobytes() and tab.xyz[0].tolist() == [289814.15, 4320978.61, 170.76]
    with open_cloud(data_dir / "formats/pcd/pdal/autzen-utm.pcd") as reader:
        assert reader.n_points == 1065 and reader.has_rgb and reader.rgb_bits() == 8
        las = laspy.read(data_dir / "formats/las/pdal/simple.las")
        chunk = next(iter(reader.chunks()))
        assert np.array_equal(chunk.rgb[:, 0], las.red) and np.array_equal(chunk.intensity, las.intensity)
        assert np.array_equal(chunk.columns()["Classification"], las.classification)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_truncated_files_are_refused_in_one_line(tmp_path, rng, encoding):
    whole = tmp_path / "whole.pcd"
    fields = [(c, rng.normal(size=(20, 1)).astype("f4")) for c in "xyz"] + [("k", np.full((20, 1), 30000, "i4"))]
    build(whole, encoding, fields, 20)
    data = whole.read_bytes()
    source, target = tmp_path / "in.pcd", tmp_path / "out" / "out.ply"
    target.parent.mkdir()
    for cut in range(0, len(data) - (5 if encoding == "ascii" else 0), 2):
        source.write_bytes(data[:cut])
        with pytest.raises(FileError) as caught:
            colour(source, target)
        assert "\n" not in str(caught.value) and str(source) in str(caught.value), cut
    assert list(target.parent.iterdir()) == []


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_damaged_files_end_in_a_cloud_or_in_one_line(tmp_path, rng, encoding):
    source, target = tmp_path / "in.pcd", tmp_path / "out.ply"
    build(source, encoding, [f for f in everything(rng, 12) if f[0] not in ("_", "id")], 4, 3)
    whole = source.read_bytes()
    refused = 0
    for _ in range(150):
        data = bytearray(whole)
        for at in rng.integers(44, len(data), rng.integers(1, 4)):
            data[at] = rng.integers(0, 256)
        source.write_bytes(data)
        try:
            colour(source, target, 5)
        except FileError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 10


LINES = {
    "VERSION": "0.7", "FIELDS": "x y z", "SIZE": "4 4 4", "TYPE": "F F F", "COUNT": "1 1 1", "WIDTH": "1",
    "HEIGHT": "1", "POINTS": "1", "DATA": "ascii",
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "body", "word"),
    [
        ({"FIELDS": "x y w"}, "1 2 3", "points need x, y and z"),
        ({"FIELDS": "x y x"}, "1 2 3", "two fields of one name"),
        ({"SIZE": "4 4"}, "1 2 3", "SIZE '4 4'"),
        ({"SIZE": "4 4 3"}, "1 2 3", "type F 3"),
        ({"TYPE": "F F Q"}, "1 2 3", "type Q 4"),
        ({"TYPE": "F F"}, "1 2 3", "3 fields, but 2 types"),
        ({"COUNT": "1 1 99999"}, "1 2 3", "COUNT"),
        ({"POINTS": "0", "WIDTH": "0"}, "", "holds no points"),
        ({"POINTS": "2"}, "1 2 3\n4 5 6", "2 points, but 1 x 1"),
        ({"POINTS": "1000000000", "WIDTH": "1000000000"}, "1 2 3", "only 5 bytes"),
        ({"POINTS": "1000000000", "WIDTH": "1000000000", "DATA": "binary"}, "1 2 3", "holds only 0"),
        ({"DATA": "binary_compressed"}, "\x04\x00\x00\x00\xff\xff\xff\xff1234", "4,294,967,295 bytes"),
        ({"DATA": "binary_compressed"}, "\x04\x00\x00\x00\x0c\x00\x00\x001234", "cannot be decompressed"),
        ({"DATA": "base64"}, "1 2 3", "'base64'"),
        ({"POINTS": "many"}, "1 2 3", "POINTS 'many'"),
        ({}, "1 2 a", "'a' is no number"),
        ({}, "1.25 2.5", "has 2 numbers, not 3"),
    ],
)
def test_absurd_files_are_named(tmp_path, change, body, word):
    path = tmp_path / "c.pcd"
    text = "".join(f"{key} {value}\n" for key, value in {**LINES, **change}.items())
    path.write_bytes((text + body).encode("latin-1"))
    with pytest.raises(FileError) as caught, open_cloud(path) as reader:
        list(reader.chunks())
    assert word in str(caught.value) and "\n" not in str(caught.value)


def test_colours_written_as_integers_in_text(tmp_path):
    path = tmp_path / "c.pcd"
    lines = {**LINES, "FIELDS": "x y z rgb", "SIZE": "4 4 4 4", "TYPE": "F F F U", "COUNT": "1 1 1 1"}
    for kind, value in (("U", 0x0A0B0C), ("F", 0x0A0B0C), ("F", repr(float(np.array([0x0A0B0C], "u4").view("f4")[0])))):
        lines["TYPE"] = f"F F F {kind}"
        path.write_text("".join(f"{k} {v}\n" for k, v in lines.items()) + f"1 2 3 {value}\n")
        assert read_cloud(path).rgb.tolist() == [[0x0A00, 0x0B00, 0x0C00]]
