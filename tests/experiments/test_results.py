import csv
import json

import numpy as np
import pytest

from experiments import results


def trial(seed, outcome="reached", rmse=0.1, method="rmp_expert", part="flat", time_s=30.0):
    return {
        "method": method,
        "workpiece": part,
        "seed": seed,
        "training_seed": None,
        "outcome": outcome,
        "reached": outcome == "reached",
        "collision": outcome == "collision",
        "timeout": outcome in ("timeout", "lost"),
        "rmse_mm": rmse,
        "rmse_whole_mm": 1.0,
        "coverage_pct": 99.0,
        "time_s": time_s,
        "env_spec": {},
    }


def wilson_by_hand(k, n):
    z, p = 1.959963984540054, k / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return 100 * (centre - half), 100 * (centre + half)


@pytest.mark.parametrize(("k", "n"), [(0, 10), (10, 10), (93, 100), (1, 3)])
def test_wilson_interval_is_the_textbook_one(k, n):
    assert results.wilson(k, n) == pytest.approx(wilson_by_hand(k, n), abs=1e-6)


def test_bootstrap_interval_is_near_the_normal_one_and_repeats():
    values = list(np.random.default_rng(1).normal(5.0, 2.0, 400))
    low, high = results.bootstrap(values)
    half = 1.96 * np.std(values) / 20
    assert low == pytest.approx(np.mean(values) - half, abs=0.03)
    assert high == pytest.approx(np.mean(values) + half, abs=0.03)
    assert results.bootstrap(values) == (low, high)
    assert results.bootstrap([1.0]) is None


def test_a_row_counts_each_outcome_once_and_averages_the_right_trials():
    rows = results.summarise(
        [
            trial(0, rmse=0.1),
            trial(1, rmse=0.3),
            trial(2, "collision", rmse=2.0),
            trial(3, "lost", rmse=None),
            trial(7, part="cylinder"),
        ]
    )
    assert [r["workpiece"] for r in rows] == ["flat", "cylinder"]
    row = rows[0]
    assert (row["trials"], row["seed0"]) == (4, 0)
    assert (row["reached_pct"], row["collision_pct"], row["timeout_pct"]) == (50.0, 25.0, 25.0)
    assert row["rmse_mm"] == pytest.approx(0.2)  # of those that reached
    assert row["rmse_all_mm"] == pytest.approx(0.8)  # of all that have one


def test_no_trial_reached_leaves_the_error_out():
    (row,) = results.summarise([trial(0, "collision", rmse=None)])
    assert row["rmse_mm"] is None
    assert row["rmse_mm_ci"] is None
    assert " - " in results.table([row])


def test_the_files_hold_the_rows(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["demo", "--trials", "1"])
    trials = [trial(0)]
    rows = results.summarise(trials)
    results.write(tmp_path, "demo", rows, trials, renderer="none", regime="static")
    document = json.loads((tmp_path / "demo.json").read_text())
    assert set(document) == {
        "name", "version", "command", "git_commit", "stack", "renderer", "regime", "rows", "trials",
    }  # fmt: skip
    assert document["command"] == "python -m experiments.demo --trials 1"
    assert document["trials"] == trials
    assert document["rows"][0]["reached_ci"] == list(results.wilson(1, 1))
    assert {"mujoco", "numpy", "gymnasium"} <= set(document["stack"])
    with (tmp_path / "demo.csv").open() as file:
        (line,) = csv.DictReader(file)
    assert float(line["rmse_mm"]) == 0.1
    assert "| rmp_expert | flat" in (tmp_path / "demo.md").read_text()
