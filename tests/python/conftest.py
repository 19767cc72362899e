"""Fixtures that every test file may use."""

from __future__ import annotations

import os
import zlib
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """A generator seeded by the test's own name: the same numbers whenever and wherever it runs."""
    return np.random.default_rng(zlib.crc32(request.node.name.encode()))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real scans and photos; tests that need it are skipped, with a word, where it is missing."""
    root = Path(__file__).parents[2]
    folder = Path(os.environ.get("COLOURREG_DATA", root.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"real data not found at {folder}: set COLOURREG_DATA to the folder that holds it")
    return folder
