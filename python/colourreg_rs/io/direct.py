"""Large files, written past the system's page cache.

Nobody reads an output before it is whole and on the disk. To keep a copy of it in memory until then would touch as much
memory as the file is long, which takes longer than the writing, and would push out what others have there.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable
from typing import IO

import numpy as np
import numpy.typing as npt

from ..overlap import Behind

Bytes = npt.NDArray[np.uint8]

#: Places, sizes and addresses are multiples of this, which nearly all disks are content with.
_BLOCK = 4096

#: One buffer is filled, one waits, one is being written.
_BUFFERS = 3


class DirectWriter:
    """Appends to an empty file while the next bytes are made.

    Where the system or the disk knows no such writing, it is the ordinary one, with the same result. The process is
    not to fork meanwhile: what the disk is just reading would be shared with the copy.

    Args:
        file: open for writing and empty; it is not to be written by others before :meth:`finish`.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._direct = _opened_directly(file.name)
        self._buffers = [_aligned(0) for _ in range(_BUFFERS)]
        self._begun = (
            0  # bytes at the buffer's beginning that the last one left over, and then those that are filled in
        )
        self._place = 0  # of the buffer in the file
        self._disk = Behind(self._write)

    def append(self, size: int, fill: Callable[[Bytes], None]) -> None:
        """``fill`` puts the next ``size`` bytes where it is told, at once; they are written while the next are made.

        Waits while two others are before them. Raises OSError, also of these.
        """
        last, buffer = self._buffers[-1], self._buffers.pop(0)
        whole = self._begun // _BLOCK * _BLOCK
        left = self._begun - whole
        if len(buffer) < left + size:
            buffer = _aligned(left + size)
        buffer[:left] = last[whole : self._begun]
        self._buffers.append(buffer)
        self._place += whole
        self._begun = left + size
        fill(buffer[left : self._begun])
        self._disk.put((self._place, buffer[: self._begun // _BLOCK * _BLOCK]))

    def finish(self) -> None:
        """Waits for all of it; the file stands at its end then. Raises OSError."""
        self._disk.done()
        self._leave()
        whole = self._begun // _BLOCK * _BLOCK
        self._file.seek(self._place + whole)
        self._file.write(self._buffers[-1][whole : self._begun].data)

    def abandon(self) -> None:
        """Ends without the rest, and without an error; safe to call more than once."""
        try:
            with contextlib.suppress(Exception):
                self._disk.done()
        finally:  # also when the wait is interrupted
            self._leave()

    def _leave(self) -> None:
        if self._direct is not None:
            os.close(self._direct)
            self._direct = None

    def _write(self, item: tuple[int, Bytes]) -> None:
        place, data = item
        written = 0
        # What the disk took in part is no longer aligned.
        while self._direct is not None and written < len(data) and written % _BLOCK == 0:
            try:
                written += os.pwrite(self._direct, data[written:].data, place + written)
            except OSError as error:
                if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP, errno.ENOTSUP):
                    raise
                self._leave()
        if written < len(data):
            self._file.seek(place + written)
            self._file.write(data[written:].data)


def _opened_directly(path: str) -> int | None:
    """A descriptor of the file for writing past the cache, or ``None`` where there is no such thing."""
    flag = getattr(os, "O_DIRECT", None)
    if flag is None:
        return None
    try:
        return os.open(path, os.O_WRONLY | flag | getattr(os, "O_CLOEXEC", 0))
    except OSError:
        return None


def _aligned(size: int) -> Bytes:
    """Memory that begins where a page does; of numpy's own, as it asks the system for large pages."""
    memory = np.empty(size + _BLOCK, np.uint8)
    ahead = -memory.ctypes.data % _BLOCK
    return memory[ahead : ahead + size]
