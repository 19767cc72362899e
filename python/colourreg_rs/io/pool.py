"""Memory for chunks, used again as soon as nobody holds it."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import numpy.typing as npt

#: Arrays that are kept in mind: more than reading, colouring and writing hold of chunks at once.
_MOST = 16


class Pool:
    """Arrays for one chunk after the other. Fresh memory costs as much as what is done with it.

    An array that somebody still holds, itself or by a view of it, is not given out again: who keeps all chunks has all
    of them, each in memory of its own.
    """

    def __init__(self) -> None:
        self._held: list[npt.NDArray[np.uint8]] = []

    def array(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """Memory with any content, of that shape and type."""
        kind = np.dtype(dtype)
        size = int(np.prod(shape)) * kind.itemsize
        for i in range(len(self._held)):
            # References: the list's and that of the call. A view counts as one, since it holds what it looks into.
            if sys.getrefcount(self._held[i]) == 2 and len(self._held[i]) >= size:
                return self._held[i][:size].view(kind).reshape(shape)
        memory = np.empty(size, np.uint8)
        self._held = [*self._held[-_MOST + 1 :], memory]  # the oldest is its holder's alone from now on
        return memory.view(kind).reshape(shape)
