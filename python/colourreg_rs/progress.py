"""How long work reports where it is: a function that the caller gives, a bar on the terminal, or nothing."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


class Progress(Protocol):
    """Called with what is being done, how much of it is done, and how much there is."""

    def __call__(self, what: str, done: int, total: int, /) -> None: ...


def silent(what: str, done: int, total: int, /) -> None:
    """Says nothing."""


@contextmanager
def terminal_bars(delay: float = 0.5) -> Iterator[Progress]:
    """Bars on standard error for work that takes longer than ``delay`` seconds; nothing where that is no terminal."""
    if not sys.stderr.isatty():
        yield silent
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
    bars = Progress(*columns, console=Console(stderr=True), transient=True)
    tasks: dict[str, TaskID] = {}
    began = time.monotonic()
    shown = False

    def report(what: str, done: int, total: int, /) -> None:
        nonlocal shown
        if not shown and time.monotonic() - began > delay:
            bars.start()
            shown = True
        if what not in tasks:
            tasks[what] = bars.add_task(what, total=total)
        bars.update(tasks[what], completed=done, total=total)

    try:
        yield report
    finally:
        if shown:
            bars.stop()
