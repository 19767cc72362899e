"""The scenes that can be simulated, by name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..layout import Layout
from .corner import corner
from .facade import facade
from .room import room
from .square import demo, square
from .trial import trial

SCENES: dict[str, Callable[[np.random.Generator], Layout]] = {
    "corner": corner,
    "demo": demo,
    "facade": facade,
    "room": room,
    "square": square,
    "trial": trial,
}
