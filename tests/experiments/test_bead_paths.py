"""The bead path table: files of a small run, its rows against the planner, a wrong command line."""

import csv
import json

import imageio.v2 as imageio
import pytest

from experiments import bead_figures, bead_paths
from seal_gym.planning import bead_cases
from seal_gym.planning.bead_solver import solve


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bead_paths")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bead_paths, "SLSQP_INTERVALS", 10)
        words = ["--case", "over_corner", "--case", "small_square", "--out", str(folder)]
        assert bead_paths.main(words) == 0
    return folder


@pytest.fixture(scope="module")
def rows(out):
    document = json.loads((out / "bead_paths.json").read_text())
    assert document["name"] == "bead_paths"
    assert "casadi" in document["stack"]
    return {r["case"]: r for r in document["rows"]}


def test_rows_say_what_the_planner_says(rows):
    case = bead_cases.get("over_corner")
    edges = case.edges()
    row, found = rows["over_corner"], solve(edges, case.duration_s)
    assert row["result"] == "solved"
    assert row["ipopt_cost"] == pytest.approx(found.cost)
    assert row["slsqp_cost"] == pytest.approx(found.cost, rel=1e-2)
    assert row["left_mm"] == pytest.approx(1e3 * edges.left.length_m)
    assert row["ipopt_spread_pct"] < 2.0
    assert row["robot_spread_pct"] < 2.0
    assert row["slow_down"] > 1.0
    assert row["robot_time_s"] == pytest.approx(row["slow_down"] * case.duration_s)


def test_a_case_without_a_path_has_its_reason_and_no_numbers(rows):
    row = rows["small_square"]
    assert row["result"] == "infeasible, proven"
    assert "tilt" in row["reason"]
    assert row["ipopt_spread_pct"] is None
    assert row["slow_down"] is None
    assert row["slsqp_word"].startswith("SLSQP ended")
    # Its inner border all but stands still in the corners.
    assert row["naive_height_max_mm"] > 5 * row["naive_height_min_mm"]


def test_files(out, rows):
    with (out / "bead_paths.csv").open() as file:
        assert [r["case"] for r in csv.DictReader(file)] == list(rows)
    text = (out / "bead_paths.md").read_text()
    assert "infeasible, proven" in text
    for name in ("over_corner", "over_corner_parameters", "small_square"):
        picture = imageio.imread(out / f"bead_paths_{name}.png")
        assert picture.std() > 5
    assert not (out / "bead_paths_small_square_parameters.png").exists()


@pytest.mark.parametrize(("spread", "text"), [(0.0026, "0.26 %"), (0.766, "77 %"), (53.0, "over 1000 %")])
def test_percent(spread, text):
    assert bead_figures.percent(spread) == text


def test_an_unknown_case_is_refused(capsys):
    with pytest.raises(SystemExit):
        bead_paths.main(["--case", "circle"])
    assert "invalid choice" in capsys.readouterr().err
