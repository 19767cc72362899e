"""Does the memory for colouring a file grow with the cloud? Peak memory at 20 and at 60 million points.

Limits: the same street and photo of 24 megapixels as in the comparison of files, LAZ to LAZ. Memory should be that of
the photo (72 MB), its depth buffer and some chunks; laspy alone, chunk by chunk, is the measure of what chunks cost.

    python -m benches.peers.memory [--points 20000000 60000000]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from .files import colourreg, laspy_recolour, make_input
from .harness import run_once


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, nargs="+", default=[20_000_000, 60_000_000])
    print("| points | colourreg: seconds | peak memory | laspy, recolour only: peak memory |")
    print("| ---: | ---: | ---: | ---: |")
    for points in parser.parse_args().points:
        with tempfile.TemporaryDirectory(prefix="colourreg-bench-") as folder:
            make_input(Path(folder), points, ".laz")
            seconds, peak = run_once(colourreg, [folder, ".laz"])
            _, other = run_once(laspy_recolour, [folder, ".laz"])
        print(f"| {points / 1e6:g} M | {seconds:.1f} | {peak:.0f} MB | {other:.0f} MB |", flush=True)


if __name__ == "__main__":
    main()
