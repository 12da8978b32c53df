"""Severity curves: their points, their rows by hand, a small run that is resumed."""

import json

import imageio.v2 as imageio
import pytest

import agents
from agents.policies import LearnedPolicy, save
from experiments import severity, severity_figures, severity_report, trials
from seal_gym.wrappers import NAMES


def trial(disturbance, level, method, seed, outcome="reached", rmse=0.1):
    return {
        "disturbance": disturbance,
        "severity": level,
        "method": method,
        "workpiece": "cylinder",
        "seed": seed,
        "training_seed": None,
        "outcome": outcome,
        "reached": outcome == "reached",
        "collision": outcome == "collision",
        "timeout": outcome in ("timeout", "lost"),
        "rmse_mm": rmse,
        "rmse_whole_mm": 1.0,
        "coverage_pct": 99.0,
        "time_s": 22.0,
    }


def test_all_points_are_the_issues(tmp_path, monkeypatch):
    monkeypatch.setitem(agents.POLICIES, "adaptive", agents.NamedPolicy("tip", lambda cell: None))
    for kind in ("neural_control", "neural_rmp"):
        save(LearnedPolicy.fresh(kind, 4), tmp_path / f"{kind}.safetensors", {"seed": 4})
    points, weights = severity.plan(severity.parse(["--weights", str(tmp_path)]))
    assert {(p.disturbance, p.severity) for p in points} == {(None, 0.0)} | {
        (name, s) for name in NAMES for s in (0.5, 1.0, 2.0, 4.0)
    }
    assert {len(p.trials) for p in points} == {4 * 25}
    assert [w.training_seed for w in weights] == [4, 4]  # the shipped one alone
    for p in points:
        acting = [(d["name"], d["severity"]) for d in p.trials[0].env["disturbances"]]
        assert acting == ([] if p.disturbance is None else [(p.disturbance, p.severity)])
        assert {t.seed for t in p.trials} == set(range(500_000, 500_025))


def test_severity_zero_counts_for_every_disturbance():
    rows = severity_report.summarise(
        [
            trial(None, 0.0, "a", 0, rmse=0.1),
            trial(None, 0.0, "a", 1, rmse=0.3),
            trial("Lighting", 4.0, "a", 0, rmse=0.7),
            trial("Lighting", 4.0, "a", 1, "lost", rmse=9.0),
            trial("CameraNoise", 1.0, "a", 0, "collision", rmse=None),
        ]
    )
    seen = [(r["disturbance"], r["severity"], r["reached_pct"], r["rmse_mm"]) for r in rows]
    assert seen == [
        ("Lighting", 0.0, 100.0, pytest.approx(0.2)),
        ("Lighting", 4.0, 50.0, pytest.approx(0.7)),
        ("CameraNoise", 0.0, 100.0, pytest.approx(0.2)),
        ("CameraNoise", 1.0, 0.0, None),
    ]
    text = severity_report.tables(rows, markdown=True)
    assert "50 %, 0.700 mm" in text
    assert "0 %, -" in text


def test_the_words_hold_the_defaults_of_the_disturbances():
    said = {name: severity_report.at_one(name) for name in NAMES}
    # protocol.md's bounds of the motion; the others as the configurations' docstrings have them.
    assert said["MovingWorkpiece"] == "the part moves up to 20 mm, 10 mm/s, 10 deg, 3 deg/s"
    assert said["CameraDropout"] == "10% of the frames are black"
    assert "8 of 255" in said["CameraNoise"]


def test_charts_stand_a_method_that_never_arrives(tmp_path):
    rows = severity_report.summarise(
        [trial("Lighting", s, m, k, "lost", rmse=None) for s in (1.0, 2.0) for m in "ab" for k in (0, 1)]
    )
    severity_figures.draw(tmp_path, {"name": "severity", "rows": rows})
    assert {p.name for p in tmp_path.iterdir()} == {"severity.png", "severity_Lighting.png"}


def test_bad_options_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        severity.parse(["--trials", "0"])
    assert "--trials 0: must be at least 1" in capsys.readouterr().err
    assert severity.main(["--method", "rmp_expert", "--severities", "99", "--out", str(tmp_path / "o")]) == 2
    assert "severity = 99.0" in capsys.readouterr().err
    assert severity.main(["--redraw", "--out", str(tmp_path)]) == 2
    assert "run the experiment first" in capsys.readouterr().err


def test_a_small_run_writes_its_charts_and_is_resumed(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["severity"])
    out = tmp_path / "out"
    arguments = [
        "--method", "rmp_expert", "--disturbance", "ExternalPush", "--severities", "0", "4",
        "--perception", "oracle", "--trials", "1", "--out", str(out),
    ]  # fmt: skip
    assert severity.main(arguments) == 0
    document = json.loads((out / "severity.json").read_text())
    calm, pushed = document["rows"]
    assert (calm["severity"], pushed["severity"]) == (0.0, 4.0)
    # Pushes of 40 N move the nozzle by a few tenths of a millimetre: more than the expert errs without them.
    assert pushed["rmse_all_mm"] > 10 * calm["rmse_all_mm"]
    specs = [t["env_spec"]["environment"] for t in document["trials"]]
    acting = {e["environment"]: e["kwargs"]["disturbances"] for e in document["environments"]}
    assert [[d["name"] for d in acting[s]] for s in specs] == [[], ["ExternalPush"]]
    for name in ("severity.png", "severity_ExternalPush.png"):
        assert f"({name})" in (out / "severity.md").read_text()
        assert imageio.imread(out / name).std() > 5

    # Killed before the last trial was logged: it alone runs again, and comes out the same.
    log = out / "severity.trials.jsonl"
    first, _ = log.read_text().splitlines()
    log.write_text(json.dumps(json.loads(first) | {"rmse_mm": 7.0}) + "\n")
    assert severity.main(arguments) == 0
    again = json.loads((out / "severity.json").read_text())["trials"]
    assert again[0]["rmse_mm"] == 7.0
    assert again[1] == document["trials"][1]
    # By itself, in an environment made from the JSON, it is the same too.
    env = trials.rebuild(again[1]["env_spec"], document["environments"])
    policy = agents.load_policy("rmp_expert", env)
    observation, info = env.reset(seed=again[1]["env_spec"]["seed"])
    done = False
    while not done:
        observation, _, terminated, truncated, info = env.step(policy.predict(observation)[0])
        done = terminated or truncated
    env.close()
    assert info["episode_metrics"]["outcome"] == again[1]["outcome"]
    assert info["episode_metrics"]["rmse_mm"] == again[1]["rmse_mm"]
