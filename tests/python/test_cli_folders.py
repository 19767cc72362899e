"""Folders that commands fill, and commands that are stopped."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest

COMMAND = [sys.executable, "-m", "colourreg_rs"]
SMALL = ["simulate", "trial", "--photos", "1", "--size", "120x90", "--points", "3000", "--out"]


def run(folder, *arguments):
    return subprocess.run([*COMMAND, *arguments], cwd=folder, capture_output=True, text=True, check=False)


def test_a_simulation_replaces_its_own_files_and_no_others(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    assert run(tmp_path, *SMALL, ".").returncode == 0
    first = (tmp_path / "scan.laz").read_bytes()
    again = run(tmp_path, *SMALL, ".", "--seed", "1")
    assert again.returncode == 0, again.stderr
    assert (tmp_path / "scan.laz").read_bytes() != first and (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("command", "name"),
    [
        (SMALL, "scan.laz"),
        (SMALL, "photo-1.jpg"),
        (SMALL, "simulation.json"),
        (["reproduce", "table2", "--out"], "README.md"),
        (["reproduce", "table1", "--out"], "results.json"),
    ],
)
def test_files_of_others_are_not_replaced(tmp_path, command, name):
    (tmp_path / name).write_text("mine")
    refused = run(tmp_path, *command, ".")
    assert refused.returncode == 1 and refused.stderr.count("\n") == 1
    assert name in refused.stderr and "would be replaced" in refused.stderr
    assert [p.name for p in tmp_path.iterdir()] == [name] and (tmp_path / name).read_text() == "mine"


@pytest.mark.parametrize("arguments", [["simulate", "square", "--out", "."], ["reproduce", "table2", "--out", "."]])
def test_ctrl_c_is_one_line_and_leaves_no_file(tmp_path, arguments):
    def listen() -> None:  # a shell that runs the tests in the background has told its children not to
        signal.signal(signal.SIGINT, signal.default_int_handler)

    with subprocess.Popen(
        [*COMMAND, *arguments], cwd=tmp_path, stderr=subprocess.PIPE, text=True, preexec_fn=listen
    ) as process:
        time.sleep(3)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert said.strip().splitlines()[-1].startswith("colourreg: interrupted") and "Traceback" not in said
    assert list(tmp_path.iterdir()) == []
