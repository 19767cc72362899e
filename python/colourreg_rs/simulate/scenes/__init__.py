"""The scenes that can be simulated, by name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..layout import Layout
from .facade import facade
from .square import demo, square

SCENES: dict[str, Callable[[np.random.Generator], Layout]] = {
    "demo": demo,
    "facade": facade,
    "square": square,
}
