"""The obstacle experiment: the leaf keeps off what is touched without it."""

import json

import numpy as np
import pytest

from agents.expert import RmpExpert
from experiments import obstacle, trials
from seal_gym.core.errors import ConfigError
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore
from seal_gym.envs.leaves import ObstacleLeaf

ENV = {"perception": "oracle", "disturbances": [{"name": "MovingObstacle", "severity": 0.2}]}


def aided(aid, part="flat", policy="rmp_expert"):
    return obstacle.Aided(method=policy, workpiece=part, seed=500_000, env=ENV, aid=aid)


@pytest.fixture(scope="module")
def rows():
    return [obstacle.run(aided(aid)) for aid in (obstacle.NONE, obstacle.LEAF)]


def test_with_the_leaf_no_collision_where_there_is_one_without(rows):
    without, with_leaf = rows
    assert without["outcome"] == "collision" and without["clearance_mm"] < 1.0
    assert with_leaf["outcome"] == "reached" and with_leaf["clearance_mm"] > 5.0


def test_it_waits_on_the_seam_and_goes_on(rows):
    t, clearance, way, error = np.array(rows[1]["trace"]).T
    slow = (np.gradient(way, t) < 2.0) & (t > 5.0) & (way < 290.0)
    assert 2.0 < slow.sum() * np.median(np.diff(t)) < 10.0
    assert error[slow].max() < 0.1 and clearance[slow].min() > 5.0
    assert rows[1]["detour_mm"] < 0.1
    assert np.diff(way).min() > -1.0


@pytest.mark.parametrize("disturbances", [[], ENV["disturbances"]])
def test_without_an_obstacle_near_the_leaf_changes_nothing(disturbances):
    cells = [
        SealCore(SealCfg.of(control="rmp", **{**ENV, "disturbances": disturbances}), 1) for _ in range(2)
    ]
    cells[1].add_leaf(ObstacleLeaf())
    policy, seen = RmpExpert(), []
    for core in cells:
        core.reset(0, np.random.default_rng(3))
        for _ in range(60):
            core.step(policy.predict(core.observe())[0])
        seen.append((core.arm.q_command.copy(), core.arm.qd.copy()))
    for a, b in zip(*seen, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_aid_is_part_of_the_trial(rows):
    assert aided("leaf").spec() != aided("none").spec()
    assert rows[1]["env_spec"]["aid"] == "leaf"
    trials.rebuild(rows[1]["env_spec"]).close()
    with pytest.raises(ConfigError, match="aid = 'wings'"):
        obstacle.aided(RmpExpert(), None, "wings")


def test_it_writes_its_files_and_goes_on_where_it_was_stopped(rows, tmp_path, monkeypatch, capsys):
    calls = []

    def fake(trial):
        calls.append(trial)
        row = rows[trial.aid != obstacle.NONE]
        return {**row, "method": trial.method, "aid": trial.aid, "env_spec": trial.spec(), "seed": trial.seed}

    monkeypatch.setattr(obstacle, "run", fake)
    command = ["--trials", "2", "--workpiece", "flat", "--perception", "oracle", "--out", str(tmp_path)]
    assert obstacle.main(command) == 0
    assert len(calls) == 2 * len(obstacle.METHODS)
    assert obstacle.main(command) == 0
    assert len(calls) == 2 * len(obstacle.METHODS)
    assert "neural RMP + leaf" in capsys.readouterr().out
    document = json.loads((tmp_path / "obstacle.json").read_text())
    by_name = {row["method"]: row for row in document["rows"]}
    assert by_name["neural RMP"]["collision_pct"] == 100.0
    assert by_name["neural RMP + leaf"]["reached_pct"] == 100.0
    assert by_name["neural RMP + leaf"]["clearance_mm"] == pytest.approx(rows[1]["clearance_mm"])
    assert len(document["trials"]) == 14 and "trace" not in document["trials"][0]
    assert all((tmp_path / f"obstacle{end}").stat().st_size > 500 for end in (".md", ".csv", "_flat.png"))


@pytest.mark.parametrize("wrong", [["--trials", "0"], ["--severity", "0"], ["--workpiece", "moon"]])
def test_wrong_options_are_refused(wrong):
    with pytest.raises(SystemExit):
        obstacle.parse(wrong)
