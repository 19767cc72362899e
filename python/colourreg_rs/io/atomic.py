"""Output files appear whole or not at all.

Everything is written into a file of another name in the target's own folder, forced to the disk, and given its real
name in one step. When anything goes wrong on the way, the half-written file is removed and what stood at the target
before stands there still.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
from collections.abc import Iterable, Iterator, Sequence
from io import BufferedReader
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from ..errors import FileError


def reason(error: OSError) -> str:
    """What the operating system says, in words: without the number and without the path, which the caller names."""
    return (error.strerror or str(error) or type(error).__name__).lower()


def not_written(path: Path, error: OSError) -> FileError:
    """What to raise where the operating system refuses to write."""
    return FileError(path, f"cannot be written: {reason(error)}", _remedy(error))


class AtomicFile:
    """A file under construction: ``file`` is open for writing and reading until the ``with`` block ends.

    The target gets its name when the block ends without an exception; otherwise nothing is left behind.

    Args:
        path: the target. A symbolic link is followed, so that the link stays a link.
        sources: files that the output is made from; none of them may be the target, under whatever name.
    """

    def __init__(self, path: str | Path, sources: tuple[str | Path, ...] = ()) -> None:
        self.path = Path(path)
        refuse_target(self.path, sources)
        try:
            self._target = self.path.resolve()
            name = f".{self._target.name[:100]}.{os.getpid()}-{secrets.token_hex(4)}.part"
            self._temporary = self._target.with_name(name)
            self.file: IO[bytes] = self._temporary.open("x+b", buffering=1 << 20)
        except OSError as error:
            raise not_written(self.path, error) from error

    def __enter__(self) -> AtomicFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is None:
            self.commit()
            return
        self.discard()
        if isinstance(error, OSError):
            raise not_written(self.path, error) from error

    def commit(self) -> None:
        """Forces the file to the disk and gives it its name."""
        try:
            self.file.flush()
            os.fsync(self.file.fileno())
            self.file.close()
            if self._target.exists():
                with contextlib.suppress(OSError):
                    self._temporary.chmod(stat.S_IMODE(self._target.stat().st_mode))
            self._temporary.replace(self._target)
        except OSError as error:
            self.discard()
            raise not_written(self.path, error) from error
        except BaseException:
            self.discard()
            raise
        _sync_folder(self._target.parent)

    def discard(self) -> None:
        """Removes what was written; safe to call more than once."""
        with contextlib.suppress(OSError, ValueError):
            self.file.close()
        with contextlib.suppress(OSError):
            self._temporary.unlink()


def refuse_target(path: Path, sources: tuple[str | Path, ...] = ()) -> None:
    """Raises :class:`FileError` when ``path`` cannot be a target, or is one of ``sources`` under any name."""
    try:
        for source in sources:
            if path.exists() and path.samefile(source):
                same = "is the input file itself" if path == Path(source) else f"is the same file as the input {source}"
                raise FileError(path, f"{same}, which would be lost", "give the output another name")
        if path.exists() and not path.is_file():
            what = "is a folder" if path.is_dir() else "is not a regular file"
            raise FileError(path, f"{what}, so nothing can be written there", "give the name of a file")
        if path.exists() and not os.access(path, os.W_OK):
            raise FileError(path, "is there and write-protected", "permit writing, or give the output another name")
        if not path.resolve().parent.is_dir():
            raise FileError(path, f"the folder {path.parent} does not exist", "create it first")
    except (OSError, ValueError, RuntimeError) as error:
        detail = reason(error) if isinstance(error, OSError) else str(error)
        raise FileError(path, f"cannot be written: {detail}", None) from error


def refuse_outputs(
    files: Sequence[Path | None], inputs: Iterable[Path | None] = (), folders: Sequence[Path | None] = ()
) -> None:
    """Says before the work what could not, or must not, be written after it.

    Args:
        files: the outputs, ``None`` for those that were not asked for; no two may be the same.
        inputs: what the outputs are made from; none may be an output, under whatever name.
        folders: outputs that are folders, made where they are missing.

    Raises FileError.
    """
    sources = tuple(path for path in inputs if path is not None and _is_there(path))
    taken: dict[Path, Path] = {}
    for path in files:
        if path is None:
            continue
        refuse_target(path, sources)
        target = path.resolve()
        if target in taken:
            raise FileError(path, "is named for two outputs, of which one would be lost", "give each a name of its own")
        taken[target] = path
        if not os.access(target.parent, os.W_OK):
            raise FileError(path, "cannot be written: permission denied", "check the permissions of the folder")
    for folder in folders:
        if folder is not None and _is_there(folder) and not folder.is_dir():
            raise FileError(folder, "is a file, and a folder is to be written", "name another folder")


def refuse_foreign_files(folder: Path, patterns: Iterable[str], mark: str, beginning: str) -> None:
    """Files of a folder that a command fills are replaced where an earlier run of it made them, and never others.

    Args:
        folder: where it writes.
        patterns: the names that it writes.
        mark: the file by which a folder of its own is known.
        beginning: what that file begins with, white space apart.

    Raises FileError.
    """
    if not folder.is_dir():
        return
    with contextlib.suppress(OSError, UnicodeDecodeError), (folder / mark).open(encoding="utf-8") as file:
        if "".join(file.read(400).split()).startswith("".join(beginning.split())):
            return
    for pattern in patterns:
        for found in sorted(folder.glob(pattern)):
            raise FileError(found, "is there already and would be replaced", "name a new or an empty folder with --out")


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def write_bytes(path: str | Path, data: bytes | memoryview, sources: tuple[str | Path, ...] = ()) -> None:
    """Writes ``data`` as the whole content of ``path``, atomically."""
    with AtomicFile(path, sources) as out:
        out.file.write(data)


def write_text(path: str | Path, text: str, sources: tuple[str | Path, ...] = ()) -> None:
    """Writes ``text`` as UTF-8 with the line ends that it has, atomically."""
    write_bytes(path, text.encode("utf-8"), sources)


@contextlib.contextmanager
def reading(path: str | Path) -> Iterator[Any]:
    """Opens ``path`` for reading bytes; what the operating system refuses becomes a :class:`FileError`."""
    path = Path(path)
    with open_binary(path) as file:
        try:
            yield file
        except OSError as error:
            raise FileError(path, f"cannot be read: {reason(error)}", None) from error


def open_binary(path: str | Path) -> BufferedReader:
    """Opens a regular file for reading bytes, or raises :class:`FileError`."""
    path = Path(path)
    try:
        if path.is_dir():
            raise FileError(path, "is a folder, not a file", "give the name of a file in it")
        if path.exists() and not path.is_file():
            raise FileError(path, "is not a regular file", "copy its content into a file first")
        return path.open("rb")
    except FileNotFoundError as error:
        raise FileError(path, "does not exist", "check the name and the folder") from error
    except (OSError, ValueError) as error:
        detail = reason(error) if isinstance(error, OSError) else str(error)
        raise FileError(path, f"cannot be read: {detail}", None) from error


def reopen(path: Path, first: IO[bytes]) -> BufferedReader:
    """The open file ``first`` once more, with a position of its own; refused when ``path`` is another file by now."""
    file = open_binary(path)
    a, b = os.fstat(first.fileno()), os.fstat(file.fileno())
    if (a.st_dev, a.st_ino, a.st_size) != (b.st_dev, b.st_ino, b.st_size):
        file.close()
        raise FileError(path, "was replaced while it was read", "start again with a file at rest")
    return file


def read_bytes(path: str | Path, limit: int | None = None) -> bytes:
    """The whole content of a file, refused above ``limit`` bytes."""
    with reading(path) as file:
        if limit is not None:
            size = os.fstat(file.fileno()).st_size
            if size > limit:
                raise FileError(
                    path, f"has {size:,} bytes; {limit:,} are the most that is read", "is it the right file?"
                )
        data: bytes = file.read()
        return data


def _remedy(error: OSError) -> str | None:
    import errno

    return {
        errno.ENOSPC: "free some space or write to another disk",
        errno.EFBIG: "write to a disk that holds files of this size, or as LAZ",
        errno.EDQUOT: "free some space or write to another disk",
        errno.EACCES: "check the permissions of the folder",
        errno.EPERM: "check the permissions of the folder",
        errno.EROFS: "write to another folder",
        errno.ENOENT: "create the folder first",
        errno.ENAMETOOLONG: "give a shorter name",
    }.get(error.errno or 0)


def _sync_folder(folder: Path) -> None:
    """Makes the new name itself durable, where the system can."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
