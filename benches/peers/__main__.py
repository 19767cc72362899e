"""Runs the comparisons of this folder, one after the other: ``python -m benches.peers [NAME ...] [OPTIONS]``.

Without a name all of them; options, such as ``--repeats 5``, go to each.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HELPERS = {"__init__", "__main__", "building", "harness"}


def main() -> None:
    given = sys.argv[1:]
    first = next((i for i, word in enumerate(given) if word.startswith("-")), len(given))
    options = given[first:]
    there = sorted(p.stem for p in Path(__file__).parent.glob("*.py") if p.stem not in HELPERS)
    names = given[:first] or there
    unknown = [name for name in names if name not in there]
    if unknown:
        raise SystemExit(f"there is no comparison {', '.join(unknown)}; there are {', '.join(there)}")
    command = [sys.executable, "-m"]
    failed = [n for n in names if subprocess.run([*command, f"benches.peers.{n}", *options], check=False).returncode]
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
