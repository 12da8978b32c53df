"""Table 3: its statistics by hand, its trials batched, killed and resumed, its files."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest

import agents
from agents.policies import LearnedPolicy, save
from agents.provenance import commit
from experiments import control_figures, control_report, control_table, methods, results, table3, trials

ROOT = Path(__file__).resolve().parents[2]
KINDS = ("neural_control", "neural_rmp")


def trial(method, seed, outcome="reached", rmse=0.1, part="flat", training_seed=None):
    return {
        "method": method,
        "workpiece": part,
        "seed": seed,
        "training_seed": training_seed,
        "outcome": outcome,
        "reached": outcome == "reached",
        "collision": outcome == "collision",
        "timeout": outcome in ("timeout", "lost"),
        "rmse_mm": rmse,
        "rmse_whole_mm": 1.0,
        "coverage_pct": 99.0,
        "time_s": 30.0,
        "env_spec": {"id": "SealGym/Seal-v0", "workpiece": part, "kwargs": {}, "seed": seed},
    }


def weights(folder, seeds=(0, 1), shipped=1, kinds=KINDS):
    folder.mkdir(exist_ok=True)
    for kind in kinds:
        for seed in seeds:
            policy = LearnedPolicy.fresh(kind, seed)
            save(policy, folder / f"{kind}-seed{seed}.safetensors", {"seed": seed})
            if seed == shipped:
                save(policy, folder / f"{kind}.safetensors", {"seed": seed})
    return folder


# -- statistics -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "second", "p"),
    [
        (0, 0, 1.0),
        (3, 3, 1.0),
        (5, 0, 2 / 2**5),  # both tails of five heads in a row
        (1, 7, 2 * (1 + 8) / 2**8),  # 0 or 1 head of 8, doubled
        (2, 8, 2 * (1 + 10 + 45) / 2**10),
    ],
)
def test_mcnemars_test_is_the_sign_test_by_hand(first, second, p):
    assert control_report.mcnemar(first, second) == pytest.approx(p, rel=1e-12)


def test_paired_differences_by_hand():
    base = [
        trial("neural_rmp", 0, rmse=0.10),
        trial("neural_rmp", 1, rmse=0.20),
        trial("neural_rmp", 2, rmse=0.30),
        trial("neural_rmp", 3, "lost", rmse=9.0),
    ]
    mine = [
        trial("pid_servo", 3, rmse=0.9),
        trial("pid_servo", 2, "collision", rmse=5.0),
        trial("pid_servo", 1, rmse=0.25),
        trial("pid_servo", 0, rmse=0.19),
    ]
    (row,) = control_report.paired([*mine, *base])
    assert (row["method"], row["against"], row["workpiece"]) == ("pid_servo", "neural_rmp", "flat")
    assert row["pairs"] == 4
    assert (row["only_method"], row["only_against"], row["both_reached"]) == (1, 1, 2)
    assert row["reached_diff_pct"] == 0.0
    assert row["mcnemar_p"] == 1.0
    assert row["rmse_diff_mm"] == pytest.approx((0.09 + 0.05) / 2)
    # Of two values the mean resampled lies between them, and is each of them a quarter of the time.
    assert row["rmse_diff_mm_ci"] == pytest.approx((0.05, 0.09))


def test_the_interval_of_a_paired_difference_uses_the_pairing():
    rng = np.random.default_rng(0)
    hard = rng.normal(1.0, 0.3, 200)  # how hard a seed is, for both alike
    gap = 0.05 + rng.normal(0.0, 0.01, 200)
    rows = [trial("neural_rmp", k, rmse=v) for k, v in enumerate(hard)]
    rows += [trial("neural_control", k, rmse=v + g) for k, (v, g) in enumerate(zip(hard, gap, strict=True))]
    (row,) = control_report.paired(rows)
    low, high = row["rmse_diff_mm_ci"]
    half = 1.96 * gap.std() / np.sqrt(200)
    assert (low, high) == pytest.approx((gap.mean() - half, gap.mean() + half), abs=5e-4)


def test_a_pair_needs_both_methods_and_the_same_seeds():
    assert control_report.paired([trial("pid_servo", 0)]) == []
    with pytest.raises(results_error(), match="differ in seeds on flat"):
        control_report.paired([trial("neural_rmp", 0), trial("pid_servo", 1)])


def results_error():
    from seal_gym.core.errors import SealGymError

    return SealGymError


def test_spread_between_training_seeds_by_hand():
    per_seed = {0: (0.10, "reached"), 1: (0.20, "reached"), 2: (0.60, "collision")}
    seeds = [
        trial("neural_rmp", k, outcome if k == 0 else "reached", rmse, training_seed=s)
        for s, (rmse, outcome) in per_seed.items()
        for k in (0, 1)
    ]
    main = [t for t in seeds if t["training_seed"] == 1]
    rows = control_report.summarise(main, seeds, [])
    assert [r["training_seed"] for r in control_report.of_table(rows, "training_seeds")] == [0, 1, 2]
    (line,) = control_report.spread(rows)
    assert (line["shipped"], line["training_seeds"]) == (1, [0, 1, 2])
    assert (line["rmse_mm"], line["rmse_mm_min"], line["rmse_mm_max"]) == pytest.approx((0.2, 0.1, 0.6))
    assert line["rmse_mm_sd"] == pytest.approx(np.sqrt((0.2**2 + 0.1**2 + 0.3**2) / 2))
    assert (line["reached_pct_min"], line["reached_pct_max"]) == (50.0, 100.0)
    assert line["reached_ci"] == results.wilson(2, 2)


# -- what to run ------------------------------------------------------------------------------------------


def plan(tmp_path, *arguments):
    options = control_table.parse(table3.TABLE, ["--weights", str(weights(tmp_path / "w")), *arguments])
    return control_table.plan(table3.TABLE, options)


def test_the_shipped_seed_runs_once_and_has_rows_in_both_tables(tmp_path):
    what = plan(
        tmp_path, "--method", "neural_rmp", "--trials", "2", "--training-seeds", "0", "1",
        "--workpiece", "flat", "--workpiece", "groove",
    )  # fmt: skip
    assert [(t.training_seed, t.seed) for t in what.main] == [(1, 500_000), (1, 500_001)]
    assert [t.training_seed for t in what.seeds] == [0, 0, 1, 1]
    assert {t.weights for t in what.seeds if t.training_seed == 1} == {t.weights for t in what.main}
    assert [(t.workpiece, t.training_seed) for t in what.other] == [("groove", 1)] * 2


def test_the_whole_table_is_the_protocols(tmp_path):
    chosen = [a for m in ("rmp_expert", *KINDS) for a in ("--method", m)]
    what = plan(
        tmp_path, *chosen, "--trials", "100", "--seed", "600000", "--training-seeds", "0", "1"
    )  # fmt: skip
    assert len(what.main) == 3 * 3 * 100
    assert len(what.seeds) == 2 * 2 * 3 * 100
    shapes = {t.workpiece for t in what.other}
    assert len(shapes) >= 6
    assert len(what.other) == 3 * len(shapes) * 25
    for group in (what.main, what.seeds, what.other):
        seeds = {}
        for t in group:
            seeds.setdefault((t.method, t.training_seed, t.workpiece), []).append(t.seed)
        assert {tuple(s) for s in seeds.values()} == {
            tuple(range(600_000, 600_000 + len(s))) for s in seeds.values()
        }
        assert all(t.env == {"perception": "vision", "renderer": "raycast"} for t in group)


def test_missing_weights_are_an_error_that_says_how_to_train(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(agents.POLICIES, "neural_rmp_dagger", agents.POLICIES["neural_rmp"])
    monkeypatch.delitem(agents.POLICIES, "pid_servo", raising=False)
    folder = weights(tmp_path / "w", seeds=(0, 1), kinds=("neural_rmp",))
    out = tmp_path / "out"
    assert table3.main(["--weights", str(folder), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert "neural_rmp: neural_rmp-seed2.safetensors missing" in said
    assert "neural_control: neural_control.safetensors, neural_control-seed0" in said
    assert "agents.train_bc --policy neural_control --seed S" in said
    assert "neural_rmp_dagger: neural_rmp_dagger.safetensors missing" in said
    assert "--policy neural_rmp --dagger 3" in said
    assert "pid_servo: no policy of that name" in said
    assert not out.exists()


def test_shipped_weights_that_are_not_their_seeds_are_refused(tmp_path):
    folder = weights(tmp_path / "w", kinds=("neural_rmp",))
    save(LearnedPolicy.fresh("neural_rmp", 7), folder / "neural_rmp.safetensors", {"seed": 1})
    with pytest.raises(results_error(), match="both of training seed 1, but differ"):
        methods.find_weights(folder, "neural_rmp", (0, 1))


def test_of_dagger_one_seed_is_enough(tmp_path):
    policy = LearnedPolicy.fresh("neural_rmp", 4)
    save(policy, tmp_path / "neural_rmp_dagger.safetensors", {"seed": 4})
    found, missing = methods.find_weights(tmp_path, "neural_rmp_dagger", (0, 1, 2))
    assert missing == []
    assert [w.training_seed for w in found] == [4]


@pytest.mark.parametrize("text", ["--trials 0", "--shape-trials 0", "--jobs 0", "--seed -1"])
def test_bad_counts_are_refused(text, capsys):
    with pytest.raises(SystemExit):
        control_table.parse(table3.TABLE, text.split())
    assert "must be at least" in capsys.readouterr().err


def test_runs_on_published_seeds_are_logged_and_no_others(tmp_path, monkeypatch):
    log = tmp_path / "results" / "LOG.md"
    monkeypatch.setattr(results, "LOG", log)
    monkeypatch.setattr("sys.argv", ["table3", "--seed", "1000000"])
    results.log_run("table3", "Table 3", 999_999)
    assert not log.exists()
    results.log_run("table3", "Table 3", 1_000_000)
    results.log_run("table3", "Table 3", 1_000_099)
    lines = [line for line in log.read_text().splitlines() if "experiments.table3" in line]
    assert len(lines) == 2
    assert "`python -m experiments.table3 --seed 1000000` | Table 3 |" in lines[0]
    assert (commit() or "no repository") in lines[0]


# -- the whole command ------------------------------------------------------------------------------------

SHORT = ["--workpiece", "wall_right", "--workpiece", "hexagon", "--method", "rmp_expert"]
ORACLE = ["--perception", "oracle", "--trials", "3"]


def files(out):
    """All that must be the same again; the command, which names the folder, aside."""
    document = json.loads((out / "table3.json").read_text())
    document.pop("command")
    kept = ("table3.csv", "table3.md", "table3_paths.npz")
    return document, {name: (out / name).read_bytes() for name in kept}


def test_it_writes_the_same_files_after_a_kill_and_with_two_jobs(tmp_path):
    whole = tmp_path / "whole"
    assert table3.main([*SHORT, *ORACLE, "--out", str(whole)]) == 0
    document, _ = files(whole)
    assert [t["outcome"] for t in document["trials"]] == ["reached"] * 6
    log = (whole / "table3.trials.jsonl").read_text().splitlines(keepends=True)

    # A kill in the middle of a batch's lines: what is whole is kept, the marked trial shows that.
    cut = tmp_path / "cut"
    cut.mkdir()
    (cut / "table3.trials.jsonl").write_text("".join(log[:2]) + log[2][:100])
    assert table3.main([*SHORT, *ORACLE, "--jobs", "2", "--out", str(cut)]) == 0
    assert files(cut) == files(whole)
    again = (cut / "table3.trials.jsonl").read_text().splitlines(keepends=True)
    assert again[:2] == log[:2]
    assert len(again) == 7  # the cut line, and the four trials that were not whole

    marked = json.loads(log[0])
    marked["rmse_mm"] = 123.0
    (cut / "table3.trials.jsonl").write_text("".join([json.dumps(marked) + "\n", *log[1:]]))
    assert table3.main([*SHORT, *ORACLE, "--out", str(cut)]) == 0
    assert json.loads((cut / "table3.json").read_text())["trials"][0]["rmse_mm"] == 123.0


def test_the_files_hold_what_the_protocol_names(tmp_path):
    folder = weights(tmp_path / "w", kinds=("neural_rmp",))
    out = tmp_path / "out"
    arguments = [
        "--method", "rmp_expert", "--method", "neural_rmp", "--weights", str(folder),
        "--training-seeds", "0", "1", "--workpiece", "cylinder", "--workpiece", "wall_right",
        "--perception", "oracle", "--trials", "2", "--out", str(out),
    ]  # fmt: skip
    assert table3.main(arguments) == 0
    document = json.loads((out / "table3.json").read_text())
    assert {
        "name",
        "version",
        "command",
        "git_commit",
        "stack",
        "renderer",
        "regime",
        "rows",
        "trials",
    } <= set(document)
    assert (document["renderer"], document["regime"]) == ("none", "static")
    main = control_report.of_table(document["rows"], "main")
    assert [(r["method"], r["workpiece"], r["training_seed"]) for r in main] == [
        ("rmp_expert", "cylinder", None),
        ("neural_rmp", "cylinder", 1),
    ]
    seeds = control_report.of_table(document["rows"], "training_seeds")
    assert [r["training_seed"] for r in seeds] == [0, 1]
    assert {k: v for k, v in seeds[1].items() if k != "table"} == {
        k: v for k, v in main[1].items() if k != "table"
    }
    for row in document["rows"]:
        assert row["reached_pct"] + row["collision_pct"] + row["timeout_pct"] == pytest.approx(100.0)
    # The shipped seed's trials stand there once: 2 methods and 1 more seed on 1 part, 2 methods on 1 shape.
    assert len(document["trials"]) == 3 * 2 + 2 * 2
    assert [(p["training_seed"], p["file"]) for p in document["policies"]] == [
        (1, "neural_rmp.safetensors"),
        (0, "neural_rmp-seed0.safetensors"),
    ]
    pairs = {(p["method"], p["workpiece"]) for p in document["paired"]}
    assert pairs == {("rmp_expert", "cylinder"), ("rmp_expert", "wall_right")}
    assert (out / "table3_paired.csv").read_text().count("\n") == 3

    text = (out / "table3.md").read_text()
    for words in ("Nominal parts", "Every training seed", "Spread", "Paired differences", "Generalisation"):
        assert words in text
    for name in ("table3_paths_cylinder.png", "table3_rmse.png", "table3_generalisation.png"):
        assert f"({name})" in text
        picture = imageio.imread(out / name)
        assert min(picture.shape[:2]) > 250
        assert picture.std() > 5
        (out / name).unlink()
    assert table3.main(["--redraw", "--out", str(out)]) == 0
    assert (out / "table3_rmse.png").exists()

    # Any trial can be run again from the document alone.
    last = next(t for t in reversed(document["trials"]) if t["method"] == "rmp_expert")
    env = trials.rebuild(last["env_spec"], document["environments"])
    policy = agents.load_policy("rmp_expert", env)
    observation, info = env.reset(seed=last["env_spec"]["seed"])
    done = False
    while not done:
        observation, _, terminated, truncated, info = env.step(policy.predict(observation)[0])
        done = terminated or truncated
    env.close()
    again = json.loads(json.dumps(info["episode_metrics"]))
    assert again == {k: last[k] for k in again}


def test_redraw_without_a_table_says_so(tmp_path, capsys):
    assert table3.main(["--redraw", "--out", str(tmp_path)]) == 2
    assert "run the table first" in capsys.readouterr().err


def test_kept_paths_end_where_the_trials_did(tmp_path):
    out = tmp_path / "out"
    assert table3.main([*SHORT, *ORACLE, "--shape-trials", "1", "--out", str(out)]) == 0
    with np.load(out / "table3_paths.npz", allow_pickle=False) as paths:
        tip = np.asarray(paths["rmp_expert/wall_right/500000"])
    assert tip.dtype == np.float32
    # A line of 200 mm along x in the part's frame, 3 mm from the edge at 45 deg, wall on the right.
    assert tip[0, 0] == pytest.approx(-100.0, abs=3.0)
    assert tip[-1, 0] == pytest.approx(100.0, abs=1.0)
    settled = tip[tip[:, 0] > -80.0]
    np.testing.assert_allclose(settled[:, 1:], np.full((len(settled), 2), 3 / np.sqrt(2)), atol=0.3)
    assert np.diff(tip[:, 0]).max() < 2.0  # sampled finely enough to draw


def test_distance_along_a_path_by_hand():
    desired = np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 0]])
    arc = np.array([0.0, 10.0, 20.0])
    s, off = control_figures.along_path(np.array([[3.0, 4.0, 0], [10, 6, 2], [12, -1, 0]]), desired, arc)
    np.testing.assert_allclose(s, [3.0, 16.0, 10.0])
    np.testing.assert_allclose(off, [4.0, 2.0, np.sqrt(5)])


@pytest.mark.slow
def test_a_process_that_is_killed_goes_on_where_it_was(tmp_path):
    # Batches of several cells; the first is in the log when the kill comes.
    arguments = [*SHORT, "--workpiece", "groove", "--workpiece", "ellipse", *ORACLE]
    log = tmp_path / "killed" / "table3.trials.jsonl"
    command = [sys.executable, "-m", "experiments.table3", *arguments, "--jobs", "2", "--out"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        [*command, str(log.parent)],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as process:
        until = time.monotonic() + 600
        while not (log.exists() and log.stat().st_size) and time.monotonic() < until:
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGKILL)
    first = log.read_text()
    assert first
    assert not (log.parent / "table3.json").exists()
    subprocess.run([*command, str(log.parent)], cwd=ROOT, env=environment, check=True, capture_output=True)
    assert log.read_text().startswith(first)
    whole = tmp_path / "whole"
    assert table3.main([*arguments, "--out", str(whole)]) == 0
    assert files(log.parent) == files(whole)


@pytest.mark.slow
def test_by_vision_batches_are_single_trials_to_the_bit():
    wanted = [
        trials.Trial(method="rmp_expert", workpiece="hexagon", seed=s, env={"perception": "vision"})
        for s in range(500_000, 500_003)
    ]
    together = trials.run_together(wanted)
    for row, t in zip(together, wanted, strict=True):
        row.pop("path_mm")
        assert row == trials.run(t)
