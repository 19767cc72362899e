"""The report: whole in itself, accessible, and with the same figures as the evaluation."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pytest
from test_adjustment_real_data import dbat
from test_cli import colourreg, job  # noqa: F401  (the fixture)

from colourreg_rs import ControlPoint, PointCloud
from colourreg_rs.io.clouds import write_cloud
from colourreg_rs.io.points import write_points
from colourreg_rs.io.registration import read_registration


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


def test_a_photo_of_a_published_calibration(data_dir, tmp_path):
    """A real photo of a hundred targets, with the published network's coordinates: half a tenth of a pixel."""
    views, _, photo, xyz, _ = dbat(data_dir / "dbat_camcal")
    marks = np.loadtxt(data_dir / "dbat_camcal" / "measurements" / "markpts.txt", delimiter=",", comments="#")
    mine = np.flatnonzero(photo == 8)
    points = [
        ControlPoint(f"{int(marks[i, 1])}", xyz[i], marks[i, 2:4] - 1.0, "check" if k % 5 == 4 else "control")
        for k, i in enumerate(mine)
    ]
    write_points(tmp_path / "points.csv", points)
    write_cloud(tmp_path / "targets.ply", PointCloud(np.unique(xyz, axis=0)))
    image = sorted((data_dir / "dbat_camcal" / "images").glob("*.JPG"))[8]
    done = colourreg(
        "register", "targets.ply", image, "--points", "points.csv", "--free", "pose,f,pp,distortion",
        "--out", "photo.json", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    done = colourreg("evaluate", "photo.json", "--report", "photo.html", "--json", "photo-eval.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (found,) = json.loads((tmp_path / "photo-eval.json").read_text())
    assert found["adjustment"]["sigma_xy_found"] < 0.1 and found["control"]["n"] > 75
    # The network's own residuals of point 90 are among its largest, too.
    assert "90" in found["check_points"]["off"] and len(found["check_points"]["off"]) <= 3
    assert found["check_points"]["joint_p_value_of_the_others"] > 0.01
    text = (tmp_path / "photo.html").read_text(encoding="utf-8")
    assert "data:image/jpeg;base64," in text and len(text) < 1_500_000
    # Another lens model (measured to ideal, with an aspect) and one photo of a plane: near the published value only.
    view = read_registration(tmp_path / "photo.json").views[0]
    assert view.camera.params["fx"] == pytest.approx(views[8].camera.params["fx"], rel=0.01)
