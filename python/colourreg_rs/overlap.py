"""Reading, computing and writing at the same time, a chunk each, so that memory stays bounded."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Generic, TypeVar

T = TypeVar("T")

_END = object()


def prefetched(items: Iterable[T], ahead: int = 1) -> Iterator[T]:
    """The same items in the same order, the next ``ahead`` of them made in a thread while one is used."""
    waiting: queue.Queue[object] = queue.Queue(maxsize=ahead)
    stopped = threading.Event()
    failure: list[BaseException] = []

    def put(item: object) -> bool:
        while not stopped.is_set():
            try:
                waiting.put(item, timeout=0.1)
                return True
            except queue.Full:
                continue
        return False

    def produce() -> None:
        try:
            for item in items:
                if not put(item):
                    return
        except BaseException as error:
            failure.append(error)
        finally:
            put(_END)

    thread = threading.Thread(target=produce, name="colourreg-reader", daemon=True)
    thread.start()
    try:
        while (item := waiting.get()) is not _END:
            yield item  # type: ignore[misc]
        if failure:
            raise failure[0]
    finally:
        stopped.set()
        thread.join()


class Behind(Generic[T]):
    """``work`` on items in a thread, in order, at most ``depth`` of them waiting; errors surface at the next call."""

    def __init__(self, work: Callable[[T], None], depth: int = 1) -> None:
        self._work = work
        self._waiting: queue.Queue[object] = queue.Queue(maxsize=depth)
        self._failure: list[BaseException] = []
        self._thread = threading.Thread(target=self._run, name="colourreg-writer", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while (item := self._waiting.get()) is not _END:
            if not self._failure:
                try:
                    self._work(item)  # type: ignore[arg-type]
                except BaseException as error:
                    self._failure.append(error)

    def put(self, item: T) -> None:
        """Hands an item over; waits while ``depth`` others are before it."""
        if self._failure:
            raise self._failure[0]
        self._waiting.put(item)

    def done(self) -> None:
        """Waits until all items are worked on; nothing may be handed over afterwards."""
        if self._thread.is_alive():
            self._waiting.put(_END)
            self._thread.join()
        if self._failure:
            raise self._failure[0]

    def __enter__(self) -> Behind[T]:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        try:
            self.done()
        except BaseException:
            if error is None:
                raise
