import json

import numpy as np
import pytest

from experiments import learning_curves as lc
from experiments.learning_curves import levels, main, meets, read_runs, steps_to_goal
from seal_gym.core.errors import ConfigError
from seal_gym.envs.sb3 import make_sb3_vec
from seal_gym.tasks.progress import SealTaskCfg

SCORES = {"episodes": 2, "collision_pct": 0.0, "timeout_pct": 0.0, "rmse_whole_mm": 1.0, "coverage_pct": 50.0}


def row(step, reached, rmse):
    return {"step": step, **SCORES, "reached_pct": reached, "rmse_mm": rmse, "time_s": 30.0, "return": 1.0}


ROWS = [
    row(0, 0.0, None),
    row(100, 80.0, 0.2),
    row(200, 95.0, 1.2),
    row(300, 90.0, 1.0),
    row(400, 100.0, 0.1),
]


def write_run(folder, name, seed, control="tip", rows=ROWS):
    path = folder / name
    path.mkdir(parents=True)
    net = {"algo": "ppo", "control": control}
    cfg = {
        "env": "SealGym/Flat-v0",
        "perception": "oracle",
        "seed": seed,
        "steps": 400,
        "init": None,
        "net": net,
    }
    (path / "run.json").write_text(json.dumps({"command": "train", "training": cfg, "stack": {}}))
    (path / "evaluations.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))
    return path


def test_the_goal_is_met_by_share_and_error_together():
    assert [meets(r) for r in ROWS] == [False, False, False, True, True]
    assert steps_to_goal(ROWS) == 300
    assert steps_to_goal(ROWS[:3]) is None


@pytest.fixture
def short(monkeypatch):
    def make(env_id, n, **kwargs):
        return make_sb3_vec(env_id, n, task=SealTaskCfg(time_factor=0.02), **kwargs)

    monkeypatch.setattr(lc, "make_sb3_vec", make)


def test_levels_are_random_zero_and_expert(short):
    rows = levels("SealGym/Flat-v0", 2, "oracle")
    names = [(r["control"], r["policy"]) for r in rows]
    assert names == [
        ("tip", "random"),
        ("tip", "zero"),
        ("rmp", "random"),
        ("rmp", "zero"),
        ("rmp", "rmp_expert"),
    ]
    by = dict(zip(names, rows, strict=True))
    # in half a second: a gun that is not moved hovers, one that is pushed about touches the part or not,
    # but its return differs; only the expert comes nearer.
    assert by["tip", "zero"]["timeout_pct"] == 100.0
    assert by["tip", "random"]["return"] != by["tip", "zero"]["return"]
    assert by["rmp", "rmp_expert"]["rmse_whole_mm"] < 0.9 * by["tip", "zero"]["rmse_whole_mm"]


def test_tables_and_picture_are_written_and_drawn_again(short, tmp_path, capsys):
    for seed in (0, 1):
        write_run(tmp_path / "runs", f"tip_{seed}", seed)
    write_run(tmp_path / "runs", "rmp_0", 0, "rmp", ROWS[:2])
    out = tmp_path / "out"
    assert main(["--runs", str(tmp_path / "runs"), "--out", str(out)]) == 0
    assert "| ppo | Flat-v0 | tip | 1 | 400 | 300 | 100 |" in capsys.readouterr().out
    document = json.loads((out / "learning_curves.json").read_text())
    assert len(document["rows"]) == 3 + 5 and document["trials"][0]["evaluations"] == ROWS[:2]
    first = (out / "learning_curves.png").read_bytes()
    assert main(["--out", str(out)]) == 0
    assert (out / "learning_curves.png").read_bytes() == first


def test_curves_hold_the_evaluations_that_all_seeds_have():
    steps, values = lc.curves([{"evaluations": ROWS}, {"evaluations": ROWS[:3]}], "rmse_mm")
    np.testing.assert_array_equal(steps, [0, 100, 200])
    np.testing.assert_array_equal(values, [[np.nan, 0.2, 1.2]] * 2)


def test_missing_and_broken_runs_are_named(tmp_path, capsys):
    with pytest.raises(ConfigError, match="no runs in"):
        read_runs(tmp_path)
    path = write_run(tmp_path, "a", 0)
    (path / "evaluations.jsonl").write_text("{")
    with pytest.raises(ConfigError, match="holds no whole run"):
        read_runs(tmp_path)
    assert main(["--out", str(tmp_path / "nothing")]) == 2
    assert "--runs" in capsys.readouterr().err
