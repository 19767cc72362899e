"""The options that experiments over many simulated scenes share."""

from __future__ import annotations

import argparse


def seeds(text: str) -> list[int]:
    """How many seeds from 0, or FIRST:END, without END itself."""
    first, colon, last = text.partition(":")
    try:
        found = list(range(int(first), int(last)) if colon else range(int(first)))
    except ValueError:
        found = []
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} holds no seed: give how many, or FIRST:END")
    return found


def parser(doc: str | None, scenes: str, default_seeds: str) -> argparse.ArgumentParser:
    """With ``--scene`` and ``--seeds``; ``doc`` is the module's, ``scenes`` are the names that make sense."""
    made = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    made.add_argument("--scene", action="append", help=f"{scenes}; several times for several")
    made.add_argument("--seeds", type=seeds, default=default_seeds, help="how many, or FIRST:END, without END itself")
    return made
