"""Runs every comparison of this folder, one after the other: ``python -m benches.peers [NAME ...]``."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HELPERS = {"__init__", "__main__", "building", "harness"}


def main() -> None:
    names = sys.argv[1:] or sorted(p.stem for p in Path(__file__).parent.glob("*.py") if p.stem not in HELPERS)
    failed = [n for n in names if subprocess.run([sys.executable, "-m", f"benches.peers.{n}"], check=False).returncode]
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
