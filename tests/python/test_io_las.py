"""LAS and LAZ: what laspy reads from an output is what it reads from the input, and the new values."""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest

from colourreg_rs import FileError, InvalidInputError
from colourreg_rs.io.clouds import create_cloud, open_cloud, read_cloud
from colourreg_rs.io.las_header import RECORD_SIZE, RGB_OFFSET

RAISED = {0: 2, 1: 3, 2: 2, 3: 3, 4: 5, 5: 5, 6: 7, 7: 7, 8: 8, 9: 10, 10: 10}
DIMENSIONS = {f: laspy.PointFormat(f).dimension_names for f in range(11)}


def las_files(folder: Path) -> list[dict]:
    return [e for e in json.loads((folder / "formats" / "manifest.json").read_text()) if e["file"].startswith("las/")]


def colour(source: Path, target: Path, rng: np.random.Generator, size: int = 1_000_000, only: str = "rgb source sigma"):
    """Writes random colours and returns what was given."""
    with open_cloud(source) as reader:
        n = reader.n_points
        given = {
            "rgb": rng.integers(0, 65536, (n, 3)).astype(np.uint16),
            "source": rng.integers(0, 3, n).astype(np.uint16),
            "sigma": rng.random(n).astype(np.float32),
        }
        given = {k: v for k, v in given.items() if k in only}
        with create_cloud(target, reader) as out:
            for chunk in reader.chunks(size):
                part = slice(chunk.start, chunk.start + len(chunk))
                out.write(chunk, **{k: v[part] for k, v in given.items()})
    return given


def raw_records(path: Path) -> list[tuple[bytes, int, bytes]]:
    """All variable-length records as bytes, by a reader of this test's own."""
    data = path.read_bytes()
    at = struct.unpack_from("<H", data, 94)[0]
    found = []
    for _ in range(struct.unpack_from("<I", data, 100)[0]):
        length = struct.unpack_from("<H", data, at + 20)[0]
        if at + 54 + length > struct.unpack_from("<I", data, 96)[0]:
            break
        found.append((data[at : at + 20] + data[at + 22 : at + 54], 54, data[at + 54 : at + 54 + length]))
        at += 54 + length
    if data[25] >= 4:
        at, count = struct.unpack_from("<QI", data, 235)
        for _ in range(count):
            length = struct.unpack_from("<Q", data, at + 20)[0]
            found.append((data[at : at + 20] + data[at + 28 : at + 60], 60, data[at + 60 : at + 60 + length]))
            at += 60 + length
    return found


def is_expected_to_change(head: bytes) -> bool:
    user, number = head[2:18].rstrip(b"\0"), struct.unpack_from("<H", head, 18)[0]
    return (user, number) in ((b"LASF_Spec", 4), (b"laszip encoded", 22204)) or user == b"copc"


def assert_same_but_coloured(source: Path, target: Path, given: dict) -> None:
    old, new = laspy.read(source), laspy.read(target)
    assert len(new) == len(old)
    raised = RAISED[old.point_format.id] if "rgb" in given else old.point_format.id
    assert new.point_format.id == raised
    skipped = {"red", "green", "blue"} if "rgb" in given else set()
    skipped |= {"ColourSource"} if "source" in given else set()
    skipped |= {"ColourSigma"} if "sigma" in given else set()
    for name in old.point_format.dimension_names:
        if name in skipped:
            continue
        if name in ("ExtraBytes",):  # undescribed in the input, described as such in the output
            continue
        a, b = (
            np.ascontiguousarray(np.asarray(c.points.array[name] if name in c.points.array.dtype.names else c[name]))
            for c in (old, new)
        )
        assert a.dtype == b.dtype, name
        assert a.tobytes() == b.tobytes(), name
    if "rgb" in given:
        assert np.array_equal(np.stack([new.red, new.green, new.blue], axis=1), given["rgb"])
    if "source" in given:
        assert np.array_equal(new["ColourSource"], given["source"])
        assert new.points.array["ColourSource"].dtype == np.uint16
    if "sigma" in given:
        assert np.array_equal(new["ColourSigma"].view("u4"), given["sigma"].view("u4"))
    kept = [r for r in raw_records(source) if not is_expected_to_change(r[0])]
    assert [r for r in raw_records(target) if not is_expected_to_change(r[0])] == kept
    a, b = source.read_bytes(), target.read_bytes()
    size = struct.unpack_from("<H", a, 94)[0]
    for start, stop in ((0, 6), (8, 24), (26, 96), (107, 227), (255, 375)):
        start, stop = min(start, size), min(stop, size)
        if a[25] >= 4 and start <= 235 < stop:  # where the extended records are, changes
            stop = 235
        assert a[start:stop] == b[start:stop], (start, stop)


def test_agrees_with_the_reference_reader(data_dir):
    refused = {
        "1.2-with-color-clipped.las": "holds only 1,064",
        "no-points.las": "no points",
        "1.2-no-points.las": "only 0",
    }
    for entry in las_files(data_dir):
        path = data_dir / "formats" / entry["file"]
        if path.name in refused:
            with pytest.raises(FileError, match=refused[path.name]):
                open_cloud(path)
            continue
        with open_cloud(path) as reader:
            assert reader.n_points == entry["n"]
            assert reader.format.startswith(
                f"{path.suffix[1:].upper()} {entry['las_version']}, point format {entry['point_format']}"
            )
            for size in (1_000_000, 777):
                chunks = list(reader.chunks(size))
                assert [c.start for c in chunks] == list(np.cumsum([0, *map(len, chunks)])[:-1])
                xyz = np.concatenate([c.xyz for c in chunks])
                assert xyz.shape == (entry["n"], 3) and xyz.dtype == np.float64 and chunks[0].xyz.flags.c_contiguous
                assert xyz.min(axis=0).tolist() == entry["min"] and xyz.max(axis=0).tolist() == entry["max"]
                positions = np.concatenate([c.xyz for c in reader.chunks(size, positions_only=True)])
                assert positions.tobytes() == xyz.tobytes()
            las = laspy.read(path)
            assert np.array_equal(np.concatenate([c.intensity for c in chunks]), las.intensity)
            if reader.has_rgb:
                assert np.concatenate([c.rgb for c in chunks]).max(axis=0).tolist() == entry["rgb_max"]
            columns = [c.columns() for c in chunks]
            for attribute in reader.attributes:
                values = np.concatenate([c[attribute.name] for c in columns])
                assert values.dtype == attribute.dtype, attribute.name
                if attribute.name in las.point_format.dimension_names and attribute.name != "ExtraBytes":
                    wanted = np.asarray(las[attribute.name])
                    assert np.array_equal(values, wanted.astype(values.dtype), equal_nan=values.dtype.kind == "f")
            json.dumps(reader.description(), allow_nan=False)


@pytest.mark.parametrize("size", [1_000_000, 5_000])
@pytest.mark.parametrize("suffix", ["same", "other"])
def test_every_real_file_survives_colouring(data_dir, tmp_path, rng, size, suffix):
    done = 0
    for entry in las_files(data_dir):
        source = data_dir / "formats" / entry["file"]
        try:
            open_cloud(source).close()
        except FileError:
            continue
        swap = {".las": ".laz", ".laz": ".las"}
        target = tmp_path / f"out{source.suffix if suffix == 'same' else swap[source.suffix]}"
        given = colour(source, target, rng, size)
        assert_same_but_coloured(source, target, given)
        done += 1
    assert done == 33


def make(path: Path, form: int, rng: np.random.Generator, n: int = 3000, channels: int = 1, extra: bool = True) -> None:
    """A file with something in every dimension."""
    header = laspy.LasHeader(point_format=form)
    header.scales, header.offsets = [0.001, 0.002, 0.0005], [4e5, 5.7e6, -3.25]
    if extra:
        header.add_extra_dim(laspy.ExtraBytesParams("wave", "f8", "a double"))
        header.add_extra_dim(laspy.ExtraBytesParams("triple", "3i2", "three"))
    header.vlrs.append(laspy.VLR("somebody", 77, "a record", bytes(range(256))))
    las = laspy.LasData(header)
    las.points = laspy.ScaleAwarePointRecord.zeros(n, header=header)
    array = las.points.array
    for name in array.dtype.names:
        array[name] = (
            rng.integers(0, 256, array[name].nbytes, np.uint8).view(array[name].dtype).reshape(array[name].shape)
        )
    if form >= 6:
        channel = (np.arange(n) // 7 % channels).astype(np.uint8)
        array["classification_flags"] = (array["classification_flags"] & 0xCF) | (channel << 4)
    for name in ("gps_time", "wave"):
        if name in array.dtype.names:
            array[name] = rng.normal(1e5, 1e3, n)
    las.write(path)
    if form >= 9 and channels > 1 and path.suffix == ".laz":  # which lazrs itself writes wrongly
        las.write(path.with_suffix(".las"))


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("form", range(11))
def test_every_point_format(tmp_path, rng, form, suffix):
    source, target = tmp_path / f"in{suffix}", tmp_path / f"out{suffix}"
    make(source, form, rng)
    assert_same_but_coloured(source, target, colour(source, target, rng))
    with open_cloud(target) as reader:
        assert reader.header.record_length == RECORD_SIZE[RAISED[form]] + 14 + 6
        assert reader.header.point_format in RGB_OFFSET


@pytest.mark.parametrize("form", range(11))
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_laszip_reads_what_is_compressed_here(tmp_path, rng, form, suffix):
    pytest.importorskip("laszip", reason="the reference codec is not installed: pip install laszip")
    source, target = tmp_path / f"in{suffix}", tmp_path / "out.laz"
    make(source, form, rng, n=52_000)
    given = colour(source, target, rng)
    old, new = laspy.read(source), laspy.read(target, laz_backend=laspy.LazBackend.Laszip)
    assert np.array_equal(new.green, given["rgb"][:, 1]) and np.array_equal(new["ColourSigma"], given["sigma"])
    for name in old.points.array.dtype.names:
        if name not in ("red", "green", "blue"):
            assert old.points.array[name].tobytes() == new.points.array[name].tobytes(), name


@pytest.mark.parametrize("form", [4, 5])
def test_waveform_packets_have_the_version_that_all_programs_know(tmp_path, rng, form):
    source, target = tmp_path / "in.laz", tmp_path / "out.laz"
    make(source, form, rng, n=10)
    colour(source, target, rng)
    with open_cloud(target) as reader:
        assert {item.kind: item.version for item in reader.laz.scheme.items}[9] == 1


@pytest.mark.parametrize("form", [6, 7, 8, 9, 10])
@pytest.mark.parametrize("channels", [1, 3])
def test_streams_of_compressed_blocks_are_exchanged(tmp_path, rng, form, channels):
    source, target = tmp_path / "in.laz", tmp_path / "out.laz"
    make(source, form, rng, n=60_000, channels=channels, extra=form % 2 == 0)
    if channels > 1 and form >= 9:
        with pytest.raises(FileError, match="waveform packets of several scanner channels"):
            colour(source.with_suffix(".las"), target, rng)
        assert not target.exists()
    assert_same_but_coloured(source, target, colour(source, target, rng, size=50_000))
    # Coloured again: the dimensions are there, and are overwritten.
    again = tmp_path / "again.laz"
    assert_same_but_coloured(target, again, colour(target, again, rng, size=100_000))
    assert laspy.read(again).point_format.size == laspy.read(target).point_format.size


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("only", ["rgb", "source", "sigma", "rgb sigma", ""])
def test_only_what_is_given_is_added(tmp_path, rng, only, suffix):
    source, target = tmp_path / f"in{suffix}", tmp_path / f"out{suffix}"
    make(source, 6, rng)
    given = colour(source, target, rng, only=only)
    assert_same_but_coloured(source, target, given)
    if not only and suffix == ".las":
        assert source.read_bytes() == target.read_bytes()


@pytest.mark.parametrize("pair", [(".las", ".las"), (".laz", ".laz"), (".las", ".laz"), (".laz", ".las")])
@pytest.mark.parametrize("form", [3, 7])
def test_the_output_does_not_depend_on_the_chunk_size(tmp_path, pair, form):
    source = tmp_path / f"in{pair[0]}"
    make(source, form, np.random.default_rng(1), n=60_000)
    outputs = []
    for size in (1_000_000, 50_000, 7_777):
        target = tmp_path / f"out-{size}{pair[1]}"
        colour(source, target, np.random.default_rng(2), size)
        outputs.append(laspy.read(target).points.array.tobytes() if pair[0] == ".laz" else target.read_bytes())
    assert outputs[0] == outputs[1] == outputs[2]


def test_dimensions_of_the_same_name_but_another_type_are_kept_aside(tmp_path, rng):
    source, target = tmp_path / "in.las", tmp_path / "out.las"
    header = laspy.LasHeader(point_format=7)
    header.add_extra_dim(laspy.ExtraBytesParams("ColourSource", "f8"))
    header.add_extra_dim(laspy.ExtraBytesParams("ColourSigma", "f4"))
    las = laspy.LasData(header)
    las.x = np.arange(5.0)
    las["ColourSource"] = np.arange(5) / 3
    las.write(source)
    given = colour(source, target, rng)
    out = laspy.read(target)
    assert out["ColourSource_before"].tobytes() == las["ColourSource"].tobytes()
    assert np.array_equal(out["ColourSource"], given["source"]) and np.array_equal(out["ColourSigma"], given["sigma"])
    assert list(out.point_format.extra_dimension_names) == ["ColourSource_before", "ColourSigma", "ColourSource"]


@pytest.mark.parametrize("count", [1, 2, 3, 8, 16, 31, 300])
def test_undescribed_extra_bytes_keep_their_values_and_place(tmp_path, rng, count):
    source, target = tmp_path / "in.las", tmp_path / "out.las"
    make(source, 1, rng, n=10, extra=False)
    data = bytearray(source.read_bytes())
    start = struct.unpack_from("<I", data, 96)[0]
    records = np.frombuffer(data[start:], np.uint8).reshape(10, 28)
    tail = rng.integers(0, 256, (10, count), np.uint8)
    struct.pack_into("<H", data, 105, 28 + count)
    source.write_bytes(bytes(data[:start]) + np.hstack([records, tail]).tobytes())
    given = colour(source, target, rng)
    out = laspy.read(target)
    names = [name for name in out.point_format.extra_dimension_names if name.startswith("ExtraBytes")]
    assert np.array_equal(np.hstack([out[name].reshape(10, -1) for name in names]), tail)
    assert np.array_equal(out["ColourSource"], given["source"])


def test_internal_waveforms_move_with_the_file(data_dir, tmp_path, rng):
    source = data_dir / "formats/las/laspy/simple1_3.las"
    a = source.read_bytes()
    start = struct.unpack_from("<Q", a, 227)[0]
    for suffix in (".las", ".laz", ".las"):
        target = tmp_path / f"out{suffix}"
        colour(source, target, rng)
        b = target.read_bytes()
        assert b[struct.unpack_from("<Q", b, 227)[0] :] == a[start:]
    colour(tmp_path / "out.laz", tmp_path / "back.las", rng)
    b = (tmp_path / "back.las").read_bytes()
    assert b[struct.unpack_from("<Q", b, 227)[0] :] == a[start:]


def test_external_waveforms_are_spoken_of(data_dir):
    with open_cloud(data_dir / "formats/las/laspy/fullwave.laz") as reader:
        assert any("fullwave.wdp" in line for line in reader.warnings)


def test_extra_bytes_described_after_the_points(tmp_path, rng):
    source, target = tmp_path / "in.las", tmp_path / "out.las"
    make(source, 6, rng, n=10)
    data = bytearray(source.read_bytes())
    records = raw_records(source)
    described = next(r for r in records if r[0][2:11] == b"LASF_Spec")
    start = struct.unpack_from("<I", data, 96)[0]
    body = data[start:]
    data = data[:375]
    vlr = next(r for r in records if r[0][2:10] == b"somebody")
    data += vlr[0][:20] + struct.pack("<H", len(vlr[2])) + vlr[0][20:] + vlr[2]
    struct.pack_into("<II", data, 96, len(data), 1)
    data += body
    struct.pack_into("<QI", data, 235, len(data), 2)
    other = (b"\0\0" + b"else".ljust(16, b"\0") + struct.pack("<H", 5) + bytes(32), b"payload")
    for head, payload in ((described[0], described[2]), other):
        data += head[:20] + struct.pack("<Q", len(payload)) + head[20:] + payload
    source.write_bytes(data)
    with open_cloud(source) as reader:
        assert [e.name for e in reader.header.extra] == ["wave", "triple"]
    for suffix in (".las", ".laz"):
        target = tmp_path / f"out{suffix}"
        colour(source, target, rng)
        with open_cloud(target) as reader:
            assert [e.name for e in reader.header.extra] == ["wave", "triple", "ColourSource", "ColourSigma"]
        assert [r for r in raw_records(target) if r[1] == 60][1] == (other[0], 60, other[1])


def test_a_copc_file_becomes_a_plain_one(data_dir, tmp_path, rng):
    source, target = data_dir / "formats/las/laspy/simple.copc.laz", tmp_path / "out.laz"
    colour(source, target, rng)
    assert not any(head[2:6] == b"copc" for head, _, _ in raw_records(target))
    with open_cloud(source) as reader:
        assert any("COPC" in line for line in reader.warnings)
        with pytest.raises(FileError, match="COPC is read but not written"):
            create_cloud(tmp_path / "out.copc.laz", reader)


def test_crs(data_dir):
    with open_cloud(data_dir / "formats/las/laspy/1_4_w_evlr.las") as reader:
        assert reader.crs_wkt.startswith('PROJCS["NAD83(HARN) / New Mexico')
    with open_cloud(data_dir / "formats/las/pdal/utm15.las") as reader:
        assert "UTM zone 15N" in reader.crs_wkt
    with open_cloud(data_dir / "formats/las/pdal/warsaw_small.las") as reader:
        assert reader.crs_wkt is None


def test_read_cloud(data_dir):
    cloud = read_cloud(data_dir / "formats/las/laspy/simple.las")
    las = laspy.read(data_dir / "formats/las/laspy/simple.las")
    assert np.array_equal(cloud.xyz, las.xyz) and np.array_equal(cloud.intensity, las.intensity)
    assert np.array_equal(cloud.rgb[:, 1], las.green)


# --- broken input ---------------------------------------------------------------------------------------------


def attempt(source: Path, target: Path) -> None:
    """Reads and writes as a colouring does."""
    with open_cloud(source) as reader:
        reader.description()
        with create_cloud(target, reader) as out:
            for _ in reader.chunks(positions_only=True):
                pass
            for chunk in reader.chunks():
                out.write(chunk, np.zeros((len(chunk), 3), np.uint16), np.zeros(len(chunk), np.uint16))


@pytest.mark.parametrize(
    "name",
    [
        "laspy/simple.las",
        "laspy/1_4_w_evlr.las",
        "las-rs/extrabytes.laz",
        "laspy/simple.copc.laz",
        "laspy/simple1_3.las",
    ],
)
def test_truncated_files_are_refused_in_one_line(data_dir, tmp_path, name):
    whole = (data_dir / "formats/las" / name).read_bytes()
    source = tmp_path / f"in{Path(name).suffix}"
    header = struct.unpack_from("<I", whole, 96)[0]
    cuts = {*range(0, header, 37), *np.linspace(header, len(whole) - 1, 60).astype(int).tolist(), len(whole) - 1}
    accepted = []
    for cut in sorted(cuts):
        source.write_bytes(whole[:cut])
        target = tmp_path / "out" / f"out{source.suffix}"
        target.parent.mkdir(exist_ok=True)
        try:
            attempt(source, target)
        except FileError as error:
            assert "\n" not in str(error) and len(str(error)) < 400 and str(source) in str(error)
            assert list(target.parent.iterdir()) == [], cut
        else:
            accepted.append(cut)
            target.unlink()
    # LAS 1.3 does not say how long its waveforms are; nothing else may be missed.
    assert [cut for cut in accepted if name != "laspy/simple1_3.las" or cut < 62728] == []


@pytest.mark.parametrize(
    "name", ["laspy/simple1_4.las", "laspy/append-bug.laz", "las-rs/extrabytes.laz", "laspy/simple.copc.laz"]
)
def test_damaged_bytes_never_end_in_anything_but_a_line(data_dir, tmp_path, rng, name):
    whole = (data_dir / "formats/las" / name).read_bytes()
    source, target = tmp_path / f"in{Path(name).suffix}", tmp_path / f"out{Path(name).suffix}"
    header = struct.unpack_from("<I", whole, 96)[0]
    refused = 0
    for i in range(50):
        data = bytearray(whole)
        end = header + 60 if i % 3 else len(data)
        for at in rng.integers(4, end, rng.integers(1, 4)):
            data[at] = rng.integers(0, 256)
        source.write_bytes(data)
        try:
            attempt(source, target)
        except FileError as error:
            refused += 1
            assert "\n" not in str(error)
            assert not target.exists()
        else:
            target.unlink()
    assert refused >= 3


@pytest.mark.parametrize(
    ("at", "value", "word"),
    [
        (131, struct.pack("<d", 0.0), "scale"),
        (131, struct.pack("<d", float("nan")), "scale"),
        (139, struct.pack("<d", 1e300), "scale"),
        (155, struct.pack("<d", float("inf")), "offset"),
        (104, b"\x0b", "point format 11"),
        (105, struct.pack("<H", 10), "records of 10 bytes"),
        (107, struct.pack("<I", 4_000_000_000), "holds only 1,065"),
        (107, struct.pack("<I", 0), "holds no points"),
        (96, struct.pack("<I", 4_000_000_000), "points begin at"),
        (94, struct.pack("<H", 12), "header of 12 bytes"),
        (24, b"\x02", "LAS 2.2"),
        (0, b"LASX", "not a LAS file"),
    ],
)
def test_absurd_headers_are_named(data_dir, tmp_path, at, value, word):
    data = bytearray((data_dir / "formats/las/laspy/simple.las").read_bytes())
    data[at : at + len(value)] = value
    source = tmp_path / "in.las"
    source.write_bytes(data)
    with pytest.raises(FileError, match=word):
        attempt(source, tmp_path / "out.las")
    assert [p.name for p in tmp_path.iterdir()] == ["in.las"]


# --- output files appear whole or not at all -----------------------------------------------------------------


def test_nothing_is_left_of_an_output_that_was_not_finished(data_dir, tmp_path, rng):
    source = data_dir / "formats/las/laspy/simple.las"
    target = tmp_path / "out.laz"
    target.write_bytes(b"what stood here before")
    with open_cloud(source) as reader:
        with pytest.raises(ZeroDivisionError), create_cloud(target, reader) as out:
            out.write(next(iter(reader.chunks(100))))
            raise ZeroDivisionError
        with pytest.raises(InvalidInputError, match="100 of 1,065"), create_cloud(target, reader) as out:
            out.write(next(iter(reader.chunks(100))))
    assert target.read_bytes() == b"what stood here before"
    assert [p.name for p in tmp_path.iterdir()] == ["out.laz"]


@pytest.mark.skipif(sys.platform == "win32", reason="there is no limit to a file's size there")
@pytest.mark.parametrize("held", [40_000, 55_000])
def test_a_disk_that_is_full_ends_in_one_line_and_leaves_nothing(tmp_path, rng, held):
    import resource

    source, target = tmp_path / "in.las", tmp_path / "out.las"
    make(source, 7, rng, n=60_000)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (held * 42, before[1]))
    try:
        # The records are written behind their making: also the last of them have to be asked for.
        with pytest.raises(FileError, match="cannot be written"):
            colour(source, target, rng, size=7_777)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [p.name for p in tmp_path.iterdir()] == ["in.las"]


def test_the_input_is_never_the_output(data_dir, tmp_path):
    source = tmp_path / "in.las"
    source.write_bytes((data_dir / "formats/las/laspy/simple.las").read_bytes())
    (tmp_path / "soft.las").symlink_to(source)
    (tmp_path / "hard.las").hardlink_to(source)
    with open_cloud(source) as reader:
        for name in ("in.las", "soft.las", "hard.las"):
            with pytest.raises(FileError, match="input"):
                create_cloud(tmp_path / name, reader)
        with pytest.raises(FileError, match="does not exist"):
            create_cloud(tmp_path / "nowhere" / "out.las", reader)
        with pytest.raises(FileError, match="folder"):
            (tmp_path / "dir.las").mkdir()
            create_cloud(tmp_path / "dir.las", reader)
        for name, word in (("out.txt", "TXT is not written"), ("out.pcd", "PCD is not written")):
            with pytest.raises(FileError, match=word):
                create_cloud(tmp_path / name, reader)


def test_wrong_arrays_are_refused(data_dir, tmp_path):
    with open_cloud(data_dir / "formats/las/laspy/simple.las") as reader:
        chunk = next(iter(reader.chunks()))
        n = len(chunk)
        for arguments in (
            {"rgb": np.zeros((n, 3), np.uint8)},
            {"rgb": np.zeros((n - 1, 3), np.uint16)},
            {"source": np.zeros(n)},
            {"sigma": np.zeros((n, 1), np.float32)},
        ):
            with pytest.raises(InvalidInputError, match="must be"), create_cloud(tmp_path / "out.las", reader) as out:
                out.write(chunk, **arguments)
        with pytest.raises(InvalidInputError, match="are next"), create_cloud(tmp_path / "out.las", reader) as out:
            for part in reader.chunks(500):
                if part.start:
                    out.write(part)
    assert list(tmp_path.iterdir()) == []
