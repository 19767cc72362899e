"""The report: whole in itself, accessible, and with the same figures as the evaluation."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pytest
from test_cli import colourreg, job  # noqa: F401  (the fixture)


class Page(HTMLParser):
    """What the tests look at."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text = ""
        self.problems: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "br", "line", "circle", "rect", "image", "path"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.problems.append(f"</{tag}> closes something else")

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.text += data


@pytest.fixture(scope="module")
def made(job):  # noqa: F811
    done = colourreg(
        "register", "scan.laz", "photo.png", "--points", "points.csv", "--camera", "camera.json",
        "--out", "with-report.json", "--report", "register.html", cwd=job,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    done = colourreg(
        "evaluate",
        "with-report.json",
        "--cloud",
        "scan.laz",
        "--report",
        "report.html",
        "--json",
        "report.json",
        cwd=job,
    )
    assert done.returncode == 0, done.stderr
    return job, (job / "report.html").read_text(encoding="utf-8"), done.stdout


def test_it_is_whole_in_itself_and_accessible(made):
    folder, text, _ = made
    page = Page(text)
    assert not page.problems and page.open == []
    for tag, attributes in page.tags:
        assert tag not in ("script", "link", "iframe")
        for name in ("src", "href"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:", "#")), value[:80]
        if tag == "img":
            assert attributes["alt"] and len(attributes["alt"]) > 15
        if tag == "svg":
            assert attributes["role"] == "img" and attributes["aria-label"]
    assert "url(" not in text and "http:" not in re.sub(r"data:[^\"]*", "", text)
    assert ("html", {"lang": "en"}) in page.tags
    assert any(t == "meta" and a.get("name") == "viewport" for t, a in page.tags)
    levels = [int(t[1]) for t, _ in page.tags if re.fullmatch("h[1-6]", t)]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(b - a <= 1 for a, b in pairwise(levels))
    ids = [a["id"] for _, a in page.tags if "id" in a]
    assert len(ids) == len(set(ids))
    tables = [t for t, _ in page.tags if t == "table"]
    assert len(tables) == len([a for t, a in page.tags if a.get("class") == "scroll" and a.get("tabindex") == "0"])
    assert "@media print" in text and "@media (max-width" in text
    assert len(text) < 3_000_000
    assert (folder / "register.html").exists()


def test_its_figures_are_those_of_the_evaluation(made):
    folder, text, printed = made
    page = Page(text)
    (evaluated,) = json.loads((folder / "report.json").read_text())
    for group in ("control", "check"):
        assert f"{evaluated[group]['rmse']:.3f}" in page.text
    for name in ("T0", "T11", "T15"):
        assert name in page.text
    for row in evaluated["adjustment"]["points"]:
        if row["status"] == "used":
            assert f"{row['detectable']:.2f}" in page.text
    figures = evaluated["expected_error"]
    assert f"{figures['px']['median']:.2f} px" in page.text and f"{figures['mrad']['median']:.2f} mrad" in printed
    assert evaluated["colour_sigma"]["mm"]["median"] > 0
    for line in evaluated["advice"]:
        assert line.replace("`", "") in page.text and line in printed
    for word in ("Baarda", "Pope", "Fedorov", "σ₀"):
        assert word in page.text


def test_names_from_files_are_shown_and_not_obeyed(made, rng):
    folder, _, _ = made
    content = json.loads((folder / "with-report.json").read_text())
    content["views"][0]["name"] = "<script>alert(1)</script>"
    content["views"][0]["points"][0]["name"] = "<b>&\"'"
    (folder / "odd.json").write_text(json.dumps(content))
    done = colourreg("evaluate", "odd.json", "--report", "odd.html", cwd=folder)
    assert done.returncode == 0, done.stderr
    text = (folder / "odd.html").read_text(encoding="utf-8")
    assert "<script" not in text and "&lt;script&gt;" in text and "<b>&" not in text
    assert np.char.count(text, "&lt;b&gt;") >= 2


def test_a_dlt_and_a_view_without_anything_but_its_pose_are_reported_too(made):
    folder, _, _ = made
    done = colourreg(
        "register", "scan.laz", "photo.png", "--points", "points.csv", "--method", "dlt", "--out", "dlt.json",
        "--report", "dlt.html", cwd=folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "h11" in (folder / "dlt.html").read_text(encoding="utf-8")
    content = json.loads((folder / "with-report.json").read_text())
    view = content["views"][0]
    content["views"] = [{k: view[k] for k in ("name", "image", "camera", "pose")}]
    (folder / "bare.json").write_text(json.dumps(content))
    done = colourreg("evaluate", "bare.json", cwd=folder)
    assert done.returncode == 1 and "--points" in done.stderr and "--cloud" in done.stderr
    done = colourreg("evaluate", "bare.json", "--cloud", "scan.laz", "--report", "bare.html", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "covariance" in done.stdout
