import csv
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from experiments import fig12, tune_edges
from seal_gym.vision import baselines

RESULTS = Path(tune_edges.__file__).parent / "results" / "tune_edges.json"


def test_the_search_finds_the_least_of_a_bowl():
    method = tune_edges.Method(
        usual={"x": 0, "y": 0}, choices={"x": tuple(range(9)), "y": tuple(range(7))}, make=None
    )
    asked = []

    def bowl(row):
        asked.append((row["x"], row["y"]))
        return (row["x"] - 6) ** 2 + (row["y"] - 2) ** 2

    best, tried = tune_edges.search(method, bowl, 4, np.random.default_rng(0))
    assert best == {"x": 6, "y": 2}
    assert tried == len(asked) == len(set(asked)) < 9 * 7
    every, tried = tune_edges.search(method, bowl, 1000, np.random.default_rng(0))
    assert every == best and tried == 9 * 7 + 1  # (0, 0) is also the usual one


def test_a_small_run_writes_its_table_and_resumes(tmp_path, capsys):
    arguments = ["--frames", "4", "--settings", "2", "--out", str(tmp_path)]
    for name in ("sobel", "ours"):
        arguments += ["--method", name]
    assert tune_edges.main(arguments) == 0
    first = (tmp_path / "tune_edges.json").read_text()
    document = json.loads(first)
    assert document["command"].endswith(f"--out {tmp_path} --method sobel --method ours")
    for condition in tune_edges.CONDITIONS:
        rows = [r for r in document["rows"] if r["condition"] == condition and r["table"] == "methods"]
        assert [(r["method"], r["which"]) for r in rows] == [
            (m, w) for m in ("sobel", "ours") for w in ("usual", "best")
        ]
        for row in rows:
            assert 0 <= row["score"] <= 1 and row["refined_failed_pct"] <= 100
    varied = [r["which"] for r in document["rows"] if r["table"] == "ablation"]
    assert {"terms a", "terms a+b", "terms a+c", "terms a+b+c", "alpha 0.3", "L 7"} <= set(varied)
    with (tmp_path / "tune_edges.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(document["rows"])
    log = (tmp_path / "tune_edges.trials.jsonl").read_text()
    assert tune_edges.main(arguments) == 0  # nothing is measured again
    assert (tmp_path / "tune_edges.trials.jsonl").read_text() == log
    assert (tmp_path / "tune_edges.json").read_text() == first
    assert "| sobel | best |" in capsys.readouterr().out


def test_the_log_survives_a_line_cut_short(tmp_path):
    path = tmp_path / "x.trials.jsonl"
    assert tune_edges.Log(path).get({"a": 1}, lambda: [{"b": 2.5}]) == [{"b": 2.5}]
    path.write_text(path.read_text() + '{"code": "')

    def never():
        raise AssertionError("measured again")

    assert tune_edges.Log(path).get({"a": 1}, never) == [{"b": 2.5}]
    assert tune_edges.Log(path).get({"a": 2}, lambda: [{"b": None}]) == [{"b": None}]


def chosen(condition):
    rows = json.loads(RESULTS.read_text())["rows"]
    return {
        r["method"]: r["settings"]
        for r in rows
        if r["table"] == "methods" and r["which"] == "best" and r["condition"] == condition
    }


def test_the_defaults_are_the_settings_of_the_published_table():
    best = chosen("run")
    assert asdict(baselines.CannyCfg()) == best["canny"]
    assert asdict(baselines.SOBEL_PLAIN) == best["sobel"]
    assert asdict(baselines.SobelCfg()) == best["sobel_blurred"]
    assert asdict(baselines.LsdCfg()) == best["lsd"]
    assert asdict(baselines.OURS_TUNED) == best["ours"]


def test_the_figures_settings_for_noise_are_those_of_the_published_table():
    best = chosen("2 dB")
    for name, settings in fig12.IN_NOISE.items():
        assert tune_edges.shown(settings) == best[name.removesuffix("_tuned")]
    assert set(fig12.IN_NOISE) == set(fig12.LABELS) - {"ours"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seed", "1000000"], "validation"),
        (["--seed", "999990", "--frames", "20"], "validation"),
        (["--frames", "1"], "--frames 1: must be at least 2"),
    ],
)
def test_bad_options_are_refused(arguments, message, capsys):
    with pytest.raises(SystemExit):
        tune_edges.parse(arguments)
    assert message in capsys.readouterr().err
