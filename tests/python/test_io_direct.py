"""Bytes written past the page cache are the same bytes, however they come and whatever the disk takes at once."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from colourreg_rs.io import direct
from colourreg_rs.io.direct import DirectWriter

SIZES = ([10], [0, 0], [4096, 4096], [5_000, 375, 1, 4095, 8192, 3, 100_000, 0, 12_289], [300_000, 7, 500_000])


def _written(path: Path, sizes: Sequence[int], tail: bytes = b"") -> tuple[bytes, bytes]:
    """What was given and what the file holds."""
    rng = np.random.default_rng(5)
    given = b""
    with path.open("x+b") as file:
        writer = DirectWriter(file)
        for size in sizes:
            piece = rng.integers(0, 256, size, dtype=np.uint8)
            writer.append(size, partial(np.copyto, src=piece))
            given += piece.tobytes()
        writer.finish()
        assert file.tell() == len(given)
        file.write(tail)
    return given + tail, path.read_bytes()


@pytest.mark.parametrize("sizes", SIZES)
def test_pieces_of_any_size_stand_one_after_the_other(tmp_path: Path, sizes: list[int]) -> None:
    given, found = _written(tmp_path / "a", sizes, b"what follows the points")
    assert found == given


@pytest.mark.parametrize("sizes", SIZES)
def test_where_there_is_no_such_writing_it_is_the_ordinary_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sizes: list[int]
) -> None:
    monkeypatch.setattr(direct, "_opened_directly", lambda path: None)
    given, found = _written(tmp_path / "a", sizes, b"tail")
    assert found == given


def test_a_disk_that_refuses_it_when_asked_is_written_in_the_ordinary_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused: list[int] = []

    def picky(descriptor: int, data: Any, place: int) -> int:
        if not refused:
            refused.append(descriptor)
            raise OSError(errno.EINVAL, "Invalid argument")
        raise AssertionError("was asked again")

    # Whatever the temporary folder's disk can do.
    monkeypatch.setattr(direct, "_opened_directly", lambda path: os.open(path, os.O_WRONLY))
    monkeypatch.setattr(os, "pwrite", picky)
    given, found = _written(tmp_path / "a", SIZES[3])
    assert refused
    assert found == given


def test_what_the_disk_takes_in_part_is_written_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.pwrite
    monkeypatch.setattr(direct, "_opened_directly", lambda path: os.open(path, os.O_WRONLY))
    monkeypatch.setattr(os, "pwrite", lambda descriptor, data, place: write(descriptor, data[:5_000], place))
    given, found = _written(tmp_path / "a", SIZES[4])
    assert found == given


def test_a_full_disk_is_told_and_can_be_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int, data: Any, place: int) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(direct, "_opened_directly", lambda path: os.open(path, os.O_WRONLY))
    monkeypatch.setattr(os, "pwrite", full)
    with (tmp_path / "a").open("x+b") as file:
        writer = DirectWriter(file)
        writer.append(10_000, lambda space: space.fill(1))
        with pytest.raises(OSError, match="No space"):
            writer.finish()
        writer.abandon()
        writer.abandon()


def test_the_page_cache_holds_none_of_it(tmp_path: Path) -> None:
    """Where the disk of the temporary folder knows direct writing."""
    mincore = _mincore()
    path = tmp_path / "a"
    with path.open("x+b") as file:
        writer = DirectWriter(file)
        if writer._direct is None:
            writer.abandon()
            pytest.skip("no direct writing on this disk")
        for _ in range(20):
            writer.append(1 << 20, lambda space: space.fill(3))
        writer.finish()
        held, pages = mincore(file.fileno(), 20 << 20)
    assert held <= 0.02 * pages


def _mincore() -> Any:
    """(pages in the page cache, pages) of a file's first bytes."""
    import ctypes
    import mmap

    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "mincore"):
        pytest.skip("no mincore on this system")

    def count(descriptor: int, size: int) -> tuple[int, int]:
        with mmap.mmap(descriptor, size) as mapped:
            view = np.frombuffer(mapped, np.uint8)
            pages = -(-size // mmap.PAGESIZE)
            marks = np.zeros(pages, np.uint8)
            found = libc.mincore(
                ctypes.c_void_p(view.ctypes.data), ctypes.c_size_t(size), marks.ctypes.data_as(ctypes.c_void_p)
            )
            assert found == 0
            del view
            return int((marks & 1).sum()), pages

    return count
