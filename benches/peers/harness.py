"""One measurement: every contender in a process of its own, in turn, so that all see the same machine.

A contender is a function of this package that does its untimed preparation, then returns the seconds of the timed part;
with :func:`forget_peak` between the two the preparation does not count towards the peak either.
Its peak memory is that of its process alone.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import resource
import statistics
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Figure:
    """Median seconds and peak memory (MB) of one contender."""

    name: str
    seconds: float
    peak_mb: float


def peak_of_this_process() -> float:
    """MB. What the parent held before the start does not count, as it does in ``ru_maxrss``, where the system tells."""
    try:
        with Path("/proc/self/status").open() as status:
            return next(float(line.split()[1]) for line in status if line.startswith("VmHWM")) / 1024
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def forget_peak() -> None:
    """What was held until now no longer counts towards the peak, where the system can forget."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def run_once(function: Callable[..., float], arguments: Sequence[str]) -> tuple[float, float]:
    """Seconds that the function returns, and the peak memory of its process in MB."""
    module = function.__module__
    if module == "__main__":  # the comparison itself is what was started
        module = str(getattr(sys.modules[module].__spec__, "name", module))
    command = [sys.executable, "-m", "benches.peers.harness", module, function.__name__, *arguments]
    finished = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if finished.returncode != 0:
        raise SystemExit(f"{function.__module__}.{function.__name__} ended with {finished.returncode}")
    figures = json.loads(finished.stdout.splitlines()[-1])
    return float(figures["seconds"]), float(figures["peak_mb"])


def compare(
    contenders: dict[str, Callable[..., float]], arguments: Sequence[str], repeats: int = 3, ours: str = "colourreg"
) -> list[Figure]:
    """Runs all contenders in turn, ``repeats`` times, and prints medians and ratios to ours."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    peaks: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(repeats):
        for name, function in contenders.items():
            seconds, peak = run_once(function, arguments)
            times[name].append(seconds)
            peaks[name].append(peak)
    figures = [Figure(name, statistics.median(times[name]), max(peaks[name])) for name in contenders]
    own = next(f for f in figures if f.name == ours)
    print(f"| {'contender':32} | seconds | peak memory | time / {ours} |")
    print(f"| {'-' * 32} | ------: | ----------: | ------: |")
    for f in figures:
        print(f"| {f.name:32} | {f.seconds:7.3f} | {f.peak_mb:8.0f} MB | {f.seconds / own.seconds:6.2f}× |")
    return figures


def _child() -> None:
    module, name, *arguments = sys.argv[1:]
    seconds = getattr(importlib.import_module(module), name)(*arguments)
    print(json.dumps({"seconds": seconds, "peak_mb": peak_of_this_process()}))


def parser(question: str) -> argparse.ArgumentParser:
    """The options that every comparison has."""
    p = argparse.ArgumentParser(description=question)
    p.add_argument("--points", type=int, default=10_000_000)
    p.add_argument("--repeats", type=int, default=3)
    return p


if __name__ == "__main__":
    _child()
