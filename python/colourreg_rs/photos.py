"""The photos of a run: those that the points at hand lie in are held, the others are decoded again when needed.

A run may have hundreds of photos, a chunk of a scan lies in few of them. Those used last are kept, together within a
limit; more only where one chunk needs more at once, for its colours are chosen among all photos that see it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt

Pixels = npt.NDArray[Any]

#: Bytes of photos that are kept: some thirty of 24 megapixels.
PHOTO_MEMORY = 2 << 30


class PhotoShelf:
    """Photos by number. ``load`` makes them; ``sizes`` are their widths and heights.

    Attributes:
        decoded: how many photos were decoded so far, repeats included.
    """

    def __init__(
        self, load: Sequence[Callable[[], Pixels]], sizes: Sequence[tuple[int, int]], limit: int = PHOTO_MEMORY
    ) -> None:
        self._load = tuple(load)
        self._sizes = tuple(sizes)
        self._limit = limit
        self._held: OrderedDict[int, Pixels] = OrderedDict()
        self._absent: dict[tuple[int, int], Pixels] = {}
        self._stopped = False
        self.decoded = 0

    @classmethod
    def of(cls, photos: Sequence[Pixels]) -> PhotoShelf:
        """Photos that are in memory and stay there."""
        arrays = [np.ascontiguousarray(photo) for photo in photos]
        sizes = [(array.shape[1], array.shape[0]) if array.ndim == 3 else (0, 0) for array in arrays]
        shelf = cls((), sizes, limit=sum(array.nbytes for array in arrays))
        shelf._held.update(enumerate(arrays))
        return shelf

    def __len__(self) -> int:
        return len(self._sizes)

    @property
    def held_bytes(self) -> int:
        """Bytes of the photos held now."""
        return sum(photo.nbytes for photo in self._held.values())

    def fill(self) -> None:
        """Decodes photos in their order until the limit is reached: all of them, where that is possible."""
        for number in range(len(self)):
            if self._stopped:
                return
            if number not in self._held:
                if self.held_bytes + 3 * int(np.prod(self._sizes[number])) > self._limit:
                    return
                self._decode([number])

    def stop(self) -> None:
        """Ends :meth:`fill` in another thread after the photo that it is at."""
        self._stopped = True

    def take(self, wanted: Collection[int]) -> list[Pixels]:
        """One picture for each photo: those wanted, and for the others one of their size that must not be read."""
        missing = [number for number in wanted if number not in self._held]
        for number in wanted:
            if number in self._held:
                self._held.move_to_end(number)
        if missing:
            room = self._limit - sum(3 * int(np.prod(self._sizes[number])) for number in missing)
            for number in [n for n in self._held if n not in wanted]:  # those used longest ago come first
                if self.held_bytes <= room:
                    break
                del self._held[number]
            self._decode(missing)
        return [self._held[n] if n in wanted else self._blank(self._sizes[n]) for n in range(len(self))]

    def _decode(self, numbers: Sequence[int]) -> None:
        with ThreadPoolExecutor(min(len(numbers), 4), thread_name_prefix="colourreg-photos") as pool:
            for number, photo in zip(numbers, pool.map(lambda n: self._load[n](), numbers), strict=True):
                self._held[number] = photo
        self.decoded += len(numbers)

    def _blank(self, size: tuple[int, int]) -> Pixels:
        """Never read or written, so that the system gives it no memory."""
        if size not in self._absent:
            self._absent[size] = np.zeros((size[1], size[0], 3), np.uint8)
        return self._absent[size]
