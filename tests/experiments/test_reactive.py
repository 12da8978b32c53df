"""Reactive control with a part of it switched off."""

import json

import pytest

from experiments import reactive, trials
from seal_gym.core.errors import ConfigError
from seal_gym.wrappers import dynamic_regime

ENV = {"perception": "vision", "renderer": "raycast", "disturbances": dynamic_regime(1.0)}


def ablated(without, method="rmp_expert"):
    return reactive.Ablated(method=method, workpiece="cylinder", seed=500_001, env=ENV, without=without)


@pytest.fixture(scope="module")
def rows():
    return {without: reactive.run(ablated(without)) for without in reactive.VARIANTS}


def test_everything_is_the_plain_trial(rows):
    plain = trials.run(trials.Trial(method="rmp_expert", workpiece="cylinder", seed=500_001, env=ENV))
    assert rows["everything"]["rmse_mm"] == plain["rmse_mm"]
    assert rows["everything"]["time_s"] == plain["time_s"]


def test_each_part_that_is_off_changes_the_run(rows):
    errors = [row["rmse_mm"] for row in rows.values()]
    # Nothing on a cylinder turns fast: the last one may equal everything.
    assert len({*errors[:4]}) == 4


def test_a_seam_that_is_not_followed_costs_accuracy(rows):
    whole = rows["everything"]
    for without in ("follow", "feed_forward"):
        row = rows[without]
        assert not row["reached"] or row["rmse_mm"] > 1.5 * whole["rmse_mm"]


def test_an_unknown_part_is_refused():
    with pytest.raises(ConfigError, match="without = 'wings'"):
        reactive.run(ablated("wings"))


def test_it_writes_its_files_and_goes_on_where_it_was_stopped(rows, tmp_path, monkeypatch, capsys):
    calls = []

    def fake(trial):
        calls.append(trial)
        row = {**rows[trial.without], "method": trial.method, "seed": trial.seed}
        return {**row, "env_spec": trial.spec()}

    monkeypatch.setattr(reactive, "run", fake)
    arguments = ["--trials", "2", "--workpiece", "cylinder", "--out", str(tmp_path)]
    for _ in range(2):
        assert reactive.main(arguments) == 0
        assert len(calls) == 2 * 2 * len(reactive.VARIANTS)
    assert "full speed in fast turns" in capsys.readouterr().out
    document = json.loads((tmp_path / "reactive.json").read_text())
    first = document["rows"][0]
    assert (first["without"], first["rmse_mm"]) == ("everything", rows["everything"]["rmse_mm"])
    assert all((tmp_path / f"reactive{end}").stat().st_size > 500 for end in (".md", ".csv", ".png"))


@pytest.mark.parametrize("wrong", [["--trials", "0"], ["--severity", "0"], ["--workpiece", "moon"]])
def test_wrong_options_are_refused(wrong):
    with pytest.raises(SystemExit):
        reactive.parse(wrong)
