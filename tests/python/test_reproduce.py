"""The paper's experiments, on a smaller scale: its method makes its kind of errors, and this package's do not."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from colourreg_rs import InvalidInputError
from colourreg_rs.experiments import reproduce, table1, table2
from colourreg_rs.experiments.figures import Figures, error_table


def test_the_paper_total_is_the_root_mean_square_of_single_coordinates():
    """Its printed figures agree with that, and not with the radial one."""
    for row in (table1.PUBLISHED.photo, table1.PUBLISHED.cloud, table2.PUBLISHED):
        assert np.sqrt(np.mean(np.square(row.axes))) == pytest.approx(row.rms, rel=0.005)
    figures = Figures.of(np.array([[3.0, 4.0], [-3.0, 4.0]]))
    assert figures.axes == (3.0, 4.0) and figures.rms == pytest.approx(np.sqrt(12.5)) and figures.rmse == 5.0
    lines = error_table([table1.PUBLISHED], "X, Y, Z")
    assert len({len(line) for line in lines}) == 1 and "1.680" in lines[2] and "0.0269" in lines[2]


@pytest.fixture(scope="module")
def corner():
    return table1.prepare((900, 650), points=300_000)


def test_the_papers_method_cannot_follow_a_rotation(corner):
    errors = []
    for degrees in (0.2, 1.0, 2.0):
        truth = table1.true_view(corner, degrees)
        moved = table1._pixels(truth, corner.xyz) - table1._pixels(corner.view, corner.xyz)
        assert np.abs(np.median(moved, axis=0) - table1.SHIFT).max() < 1
        found = table1.paper_method(corner, truth, table1.simulated_photo(corner.scan, truth), "paper")
        assert found.icp.accepted
        errors.append(found.row.photo.rms)
    # Half the paper's pixels: about half of its error at its rotation.
    assert errors[0] < 0.15 and 0.3 < errors[2] < 1.2 and errors == sorted(errors)


def test_a_wrong_translation_is_a_failure_that_is_recognised(corner):
    truth = table1.true_view(corner, 2.0, table1.WRONG_TRANSLATION)
    failed = table1.paper_method(corner, truth, table1.simulated_photo(corner.scan, truth), "wrong")
    assert failed.row.photo.rms > 20 and failed.row.cloud.rms > 0.5
    assert not failed.icp.accepted and failed.verdict.startswith("refused: ")


@pytest.mark.slow
def test_the_package_is_ten_times_better_on_the_same_input(corner):
    truth = table1.true_view(corner, table1.ROTATION_DEG)
    photo = table1.simulated_photo(corner.scan, truth)
    theirs = table1.paper_method(corner, truth, photo, "paper").row
    found, mine = table1.full_pipeline(corner, truth, photo, "package")
    assert found.trusted
    assert mine.photo.rms < 0.1 * theirs.photo.rms and mine.cloud.rms < 0.1 * theirs.cloud.rms
    assert mine.photo.rms < 0.05


@pytest.fixture(scope="module")
def trial():
    return table2.prepare((640, 480))


def test_blunders_along_rows_make_the_papers_figures_and_are_named(trial, monkeypatch):
    monkeypatch.setattr(table2, "DRAWS", 8)
    # At half the size the same angles are half the pixels.
    case = table2.Case(0.5, 0.002, blunders=2, aside=29.0)
    result = table2.repeated(trial, case, 0)
    assert result.residuals.axes[0] > 2 * result.residuals.axes[1]
    assert 0.012 < result.residuals_metres < 0.025
    assert result.named > 0.8 and result.failed == 0
    assert result.package.rms < 0.25 * result.dlt.rms
    clean = table2.repeated(trial, table2.Case(0.15, 0.002), 1)
    assert clean.package.rms < 0.6 * clean.dlt.rms and clean.wrongly_named < 0.05


def test_an_unknown_experiment_is_refused():
    with pytest.raises(InvalidInputError, match="table1, table2, all"):
        reproduce("table3")


@pytest.mark.slow
def test_table2_writes_its_page_from_its_results(tmp_path, monkeypatch):
    monkeypatch.setattr(table2, "DRAWS", 2)
    result = reproduce("table2")
    files = result.write(tmp_path / "out")
    assert {f.name for f in files} == {"README.md", "results.json", "table2-residuals.jpg"}
    data = json.loads((tmp_path / "out" / "results.json").read_text())["table2"]
    page = (tmp_path / "out" / "README.md").read_text()
    assert result.text() in page and "never published" in page
    for case in data["cases"]:
        assert re.search(re.escape(case["case"]["label"]) + rf" +\| +{case['dlt_residuals_px']['rms']:.1f} ", page)
    for name in re.findall(r"\]\((.*?)\)", page):
        assert 10_000 < (tmp_path / "out" / name).stat().st_size < 200_000
