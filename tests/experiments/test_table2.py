import csv
import json

import numpy as np
import pytest

from experiments import table2, table2_report
from seal_gym.core.cell import load_cell
from seal_gym.vision.features import SeamLines, ViewGeometry

SHORT = ["--workpiece", "rectangular", "--seconds", "1.5", "--trials", "2", "--seed", "500012"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("table2")
    assert table2.main([*SHORT, "--out", str(out)]) == 0
    return out, json.loads((out / "table2.json").read_text())


def frames_by_hand(out, seed):
    """Arc lengths, truth and what each method found, from the file of a trial."""
    with np.load(out / "frames" / f"rectangular-{seed}.npz") as file:
        return {name: file[name] for name in file.files}


def rmse_by_hand(files, method, view, feature, near_corner):
    squares = []
    for file in files:
        for s, found, truth in zip(
            file["s_m"], file[method][:, view, feature], file["truth"][:, view, feature], strict=True
        ):
            # Sides of 110 and 144.3 mm, each followed by a corner of 5 mm radius and 15 mm around it.
            arc = 0.005 * np.pi / 2
            arcs = [(0.110, 0.110 + arc), (0.2543 + arc, 0.2543 + 2 * arc)]
            if any(a - 0.015 <= s <= b + 0.015 for a, b in arcs) == near_corner and np.isfinite(found):
                squares.append((found - truth) ** 2)
    return np.sqrt(np.mean(squares)), len(squares)


def test_a_table_of_a_short_run(made):
    out, document = made
    rows = document["rows"]
    assert set(rows[0]) == {
        "workpiece", "view", "feature", "region", "edge", "refined", "tracker", "kalman", "rmse", "unit",
        "rmse_ci", "availability_pct", "trials", "seed0",
    }  # fmt: skip
    assert len(rows) == 3 * len(table2.METHODS) * 2 * 4
    assert {(r["tracker"], r["kalman"]) for r in rows} == {
        ("none", False),
        ("kalman", True),
        ("memory", True),
    }
    assert {(r["trials"], r["seed0"]) for r in rows} == {(2, 500_012)}
    assert [t["frames"] for t in document["trials"]] == [45, 45]
    assert document["regime"] == "static" and document["renderer"] == "raycast"
    with (out / "table2.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(rows)
    text = (out / "table2.md").read_text()
    assert "3.69" in text and "### rectangular, corners\n" in text
    assert (out / "table2.png").stat().st_size > 20_000


@pytest.mark.parametrize("region", ["straight", "corner"])
@pytest.mark.parametrize(("method", "k"), [("ours-raw-none", 0), ("ours-refined-kalman", 1),
                                            ("ours-refined-memory", 2)])  # fmt: skip
def test_a_figure_is_the_one_of_the_frames(made, method, k, region):
    out, document = made
    files = [frames_by_hand(out, seed) for seed in (500_012, 500_013)]
    edge, line, tracker = method.split("-")
    for v, view in enumerate(("front", "side")):
        feature = ("d_attr", "theta", "d_tip")[k]
        (row,) = (
            r
            for r in document["rows"]
            if (r["view"], r["feature"], r["region"], r["edge"], r["tracker"], r["refined"])
            == (view, feature, region, edge, tracker, line == "refined")
        )
        rmse, count = rmse_by_hand(files, method, v, k, region == "corner")
        assert count > 10
        assert row["rmse"] == pytest.approx(rmse, rel=1e-12)


def test_the_run_is_where_the_seed_says(made):
    out, document = made
    for trial in document["trials"]:
        s = frames_by_hand(out, trial["seed"])["s_m"]
        assert s[0] == pytest.approx(trial["env_spec"]["from_s_m"], abs=5e-4)
        assert s[-1] - s[0] == pytest.approx(0.015, abs=2e-3)  # 1.5 s at 10 mm/s


def test_the_tracker_is_near_the_truth_and_a_raw_line_less_so(made):
    _, document = made
    best = {
        (r["tracker"], r["view"], r["feature"]): r["rmse"]
        for r in document["rows"]
        if r["region"] == "all"
        and r["edge"] == "ours"
        and (r["tracker"], r["refined"]) in (("memory", True), ("none", False))
    }
    for view in ("front", "side"):
        assert best["memory", view, "d_attr"] < 0.35
        assert best["memory", view, "d_tip"] < 0.15
        assert best["none", view, "d_attr"] > 2 * best["memory", view, "d_attr"]


def test_a_killed_run_goes_on_and_two_processes_find_the_same(made, tmp_path):
    out, document = made
    log = (out / "table2.trials.jsonl").read_text().splitlines()
    marked = json.loads(log[0])
    marked["sums"]["ours-raw-none"]["straight"]["squared"][0][0] += 1e6
    (tmp_path / "table2.trials.jsonl").write_text(json.dumps(marked) + "\n" + log[1][:50] + "\n")
    assert table2.main([*SHORT, "--jobs", "2", "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "table2.json").read_text())["rows"]
    changed = [a for a, b in zip(rows, document["rows"], strict=True) if a != b]
    assert {(r["edge"], r["tracker"], r["refined"], r["view"], r["feature"]) for r in changed} == {
        ("ours", "none", False, "front", "d_attr")
    }
    assert {r["region"] for r in changed} == {"all", "straight"}
    assert not (tmp_path / "frames" / f"rectangular-{marked['seed']}.npz").exists()  # it did not run again


def views_of(point, direction):
    return SeamLines(np.array(point, float), np.array(direction, float), np.ones((1, 2), np.bool_))


def test_features_of_lines_by_hand():
    """Lines beside the stand-off's image, upright in the front view and level in the side view."""
    (x, y), (u, v) = ViewGeometry.of(load_cell()).reference
    straight = table2.features_of(views_of([[[x + 3, 0], [0, v - 2]]], [[[0, 1], [1, 0]]]))
    np.testing.assert_allclose(straight[0, :, :2], [[3, 0], [-2, 0]], atol=1e-9)
    # 30 deg to the right of up through the reference moved by 3 px: the foot is at 3 cos^2(30 deg).
    leaning = table2.features_of(views_of([[[x + 3, y], [u, v]]], [[[0.5, -np.sqrt(0.75)], [1, 0]]]))
    np.testing.assert_allclose(leaning[0, 0, :2], [3 * 0.75, 30.0], atol=1e-9)


def test_a_line_off_the_roi_is_none_in_its_view_and_in_the_tip_frame():
    _, (u, v) = ViewGeometry.of(load_cell()).reference
    found = table2.features_of(views_of([[[60, 0], [u, v]]], [[[0, 1], [1, 0]]]))
    assert np.isnan(found[0, 0]).all() and np.isnan(found[0, 1, 2:]).all()
    assert np.isfinite(found[0, 1, :2]).all()


def test_angles_wrap_and_distances_do_not():
    truth = np.tile([100.0, -88.0, 0.0, 10.0], (1, 2, 1))
    found = np.tile([-50.0, 89.0, 1.0, 8.0], (1, 2, 1))
    np.testing.assert_allclose(table2.error_of(found, truth)[0, 0], [-150.0, -3.0, 1.0, -2.0])


def sums(squared, lines, frames):
    block = {"squared": squared, "lines": lines, "frames": frames}
    return {
        region: {k: np.full((2, 4), v).tolist() for k, v in block.items()}
        for region in ("straight", "corner")
    }


def test_rmse_of_all_frames_and_its_interval():
    trials = [
        {"workpiece": "flat", "seed": 9 + k, "sums": {"e-raw-none": sums(s, n, 10)}}
        for k, (s, n) in enumerate([(8.0, 2), (0.0, 0), (4.0, 4)])
    ]
    rows = table2_report.summarise(trials, [table2_report.Method("e", "none", False)])
    assert len(rows) == 8  # without corners there is one region
    assert rows[0]["rmse"] == pytest.approx(np.sqrt(12 / 6))
    assert rows[0]["availability_pct"] == pytest.approx(100 * 6 / 30)
    assert (rows[0]["trials"], rows[0]["seed0"], rows[0]["region"]) == (3, 9, "all")
    # Of the draws of two trials a quarter is the better one twice, a quarter the worse one twice.
    assert rows[0]["rmse_ci"] == pytest.approx((1.0, 2.0))


def test_an_interval_is_near_the_normal_one():
    squared, lines = np.random.default_rng(0).uniform(0.5, 1.5, 400) * 300, np.full(400, 300)
    low, high = table2_report.rmse_interval(squared, lines)
    # Standard error of the mean square, over twice the root.
    rmse = np.sqrt(squared.sum() / lines.sum())
    half = 1.96 * np.std(squared / 300) / np.sqrt(400) / (2 * rmse)
    assert low == pytest.approx(rmse - half, abs=0.001) and high == pytest.approx(rmse + half, abs=0.001)
    assert table2_report.rmse_interval(squared[:1], lines[:1]) is None


def test_no_line_at_all_leaves_the_error_out():
    trials = [{"workpiece": "flat", "seed": 0, "sums": {"e-raw-none": sums(0.0, 0, 10)}}]
    rows = table2_report.summarise(trials, [table2_report.Method("e", "none", False)])
    assert rows[0]["rmse"] is None and rows[0]["availability_pct"] == 0.0
    assert "| -" in table2_report.markdown(rows)


@pytest.mark.parametrize(
    ("arguments", "message"), [(["--trials", "0"], "--trials 0"), (["--seconds", "60"], "--seconds 60")]
)
def test_bad_arguments_are_refused(arguments, message, capsys):
    with pytest.raises(SystemExit):
        table2.parse(arguments)
    assert message in capsys.readouterr().err
