"""The surrogate experiment: metrics by hand, its files, its claims; training on made-up beads."""

import csv
import json
import math

import numpy as np
import pytest

from agents import WEIGHTS
from agents.surrogate_data import OBSTACLE_COURSE, read_beads
from experiments import surrogate as experiment
from experiments import surrogate_ladder as ladder
from experiments import surrogate_metrics as metrics
from experiments.surrogate_ladder import Rung
from seal_gym.sealant.laydown.config import THESIS_FLOW_M3S
from seal_gym.sealant.laydown.paths import TRAINING
from seal_gym.sealant.surrogate import SurrogateCfg, features, load_surrogate
from tests.agents.surrogate_beads import bead, write


def block(rows, columns):
    image = np.zeros((20, 40))
    image[rows, columns] = 1.0
    return image


def test_contours_of_blocks_that_are_moved():
    one, moved = block(slice(5, 9), slice(5, 35)), block(slice(6, 10), slice(5, 35))
    assert metrics.contour_distance_m(one, one) == 0.0
    # top and bottom are 1 mm off, the sides hardly
    assert metrics.contour_distance_m(one, moved) == pytest.approx(1e-3, rel=0.15)
    assert metrics.contour_distance_m(one, np.zeros((20, 40))) is None


def test_scores_by_hand():
    true = bead(n=30)
    images = np.tile(block(slice(8, 10), slice(10, 30)), (30, 1, 1))
    reference = np.tile(block(slice(8, 11), slice(10, 30)), (30, 1, 1))
    true = type(true)(**{**vars(true), "images": reference})
    got = metrics.scores(images, true)
    assert got["mse"] == pytest.approx(20 / 800)
    assert got["iou"] == pytest.approx(40 / 60)
    assert got["area_error_pct"] == pytest.approx(100 * 20 / 60)
    assert got["height_error_mm"] == pytest.approx(1.0)
    assert got["width_error_mm"] == pytest.approx(2 * (1 / 4 - 1 / 6))  # where it is 0.5 mm thick, each side
    ideal = 1e6 * THESIS_FLOW_M3S / true.linear_mps[0, 1]
    assert got["ideal_error_pct"] == pytest.approx(100 * abs(40 - ideal) / ideal)
    assert got["no_contour"] == 0


def test_a_section_without_contour_is_counted():
    true = bead(n=30)
    got = metrics.scores(np.zeros_like(true.images), true)
    assert got["contour_mm"] is None
    assert got["no_contour"] == 30
    assert got["area_error_pct"] == pytest.approx(100.0)


def test_means_and_differences_are_over_beads():
    rows = [dict.fromkeys(metrics.KEYS, v) | {"path": p} for v, p in ((1.0, "a"), (2.0, "a"), (6.0, "b"))]
    rows[1]["contour_mm"] = None
    row = metrics.summary(rows)
    assert (row["beads"], row["paths"], row["iou"], row["contour_mm"]) == (3, 2, 3.0, 3.5)
    assert row["iou_ci"][0] < 3.0 < row["iou_ci"][1]
    others = [r | {"iou": r["iou"] - 0.5} for r in rows]
    mean, interval = metrics.difference(rows, others, "iou")
    assert mean == 0.5
    assert interval == (0.5, 0.5)


def test_effects_of_weights_by_hand():
    mean = block(slice(8, 10), slice(10, 30))
    thicker = block(10, slice(10, 30))
    to_the_right = block(slice(8, 10), 30) - block(slice(8, 10), 10)
    x = np.arange(40) - 19.5
    turned = np.zeros((20, 40))
    turned[9, 10:30], turned[8, 10:30] = 0.01 * x[10:30], -0.01 * x[10:30]
    one, two, three = metrics.effects(np.stack((thicker, to_the_right, turned)), mean)
    assert one["area_mm2"] == pytest.approx(20.0)
    assert one["height_mm"] == pytest.approx(1.0)
    assert one["up_mm"] == pytest.approx(20 * 1.5 / 40)
    assert two["area_mm2"] == pytest.approx(0.0)
    assert two["right_mm"] == pytest.approx(2 * 20 / 40)  # 2 mm2 moved by 20 mm, in 40 mm2
    # d/dt of sum (z - zc)(x - xc) / sum (x - xc)^2, with 0.01 x between rows 1 mm apart
    slope = (0.01 * x[10:30] ** 2).sum() / (2 * (x[10:30] ** 2).sum())
    assert three["slope_deg"] == pytest.approx(math.degrees(slope))
    assert three["right_mm"] == pytest.approx(0.0)


@pytest.fixture
def small(monkeypatch, tmp_path):
    """A short ladder and few beads; gives the folder of the data."""
    net = SurrogateCfg(kind="mlp_cnn", hidden=8, channels=4, on_fan=True)
    rungs = (Rung(ladder.LINEAR, SurrogateCfg(kind="linear")), Rung("net", net, "adamw"))
    monkeypatch.setattr(ladder, "LADDER", rungs)
    data = tmp_path / "data"
    data.mkdir()
    beads = [bead(p.name, draw, n=24) for p in TRAINING[:3] for draw in range(2)]
    write(data, [*beads, *(bead(name, n=24) for name in ("box_side", "stairs_edge"))])
    return data


def test_the_command_trains_judges_and_writes(small, tmp_path, capsys):
    out, weights = tmp_path / "out", tmp_path / "weights"
    arguments = [
        "--data",
        str(small),
        "--out",
        str(out),
        "--save",
        str(weights),
        "--epochs",
        "2",
        "--seeds",
        "2",
    ]
    assert experiment.main(arguments) == 0
    assert "2 beads around 2 of 12 unseen centre paths" in capsys.readouterr().out
    document = json.loads((out / "surrogate.json").read_text())
    rows = {r["model"]: r for r in document["rows"]}
    assert list(rows) == [
        "reference itself",
        "mean section",
        ladder.STATION,
        ladder.PATH,
        ladder.LINEAR,
        "net",
    ]
    assert rows["reference itself"]["iou"] == 1.0
    assert len(rows["net"]["iou_seeds"]) == 2
    assert rows[ladder.STATION]["held_out_mse"] is None
    assert len(document["trials"]) == 6 * 2
    assert len(document["compared"]) == 6
    assert document["data"]["train"] == [4, 2]
    assert "wave_along" in document["data"]["missing"]
    with (out / "surrogate.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 6
    for name in ("ladder", "linear", "examples", "curves"):
        assert (out / f"surrogate_{name}.png").read_bytes().startswith(b"\x89PNG")
    # the rows of what was written are repeated without training, and without the training data
    for p in TRAINING[:3]:
        (small / f"{p.name}.npz").unlink()
    again = tmp_path / "again"
    assert experiment.main(["--data", str(small), "--weights", str(weights), "--out", str(again)]) == 0
    repeated = {r["model"]: r for r in json.loads((again / "surrogate.json").read_text())["rows"]}
    assert ladder.LINEAR in repeated
    for name, row in repeated.items():
        for key in metrics.KEYS:
            assert row[key] == pytest.approx(rows[name][key], rel=1e-9, abs=1e-12)
    assert not (again / "surrogate_curves.png").exists()


def test_a_folder_without_the_course_is_refused(tmp_path, capsys):
    write(tmp_path, [bead("plane_s")])
    assert experiment.main(["--data", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "no bead of the obstacle course" in capsys.readouterr().err


def test_the_words_name_every_motion(small):
    rows = [
        {"input": name, "one_sd": 0.1, "unit": "m/s", **dict.fromkeys(experiment._EFFECTS, 1.0)}
        for name in (*experiment._WORDS, *(f"h({k - 20:+d} mm)" for k in range(41)))
    ]
    rows[1]["area_mm2"] = -99.0
    named = dict(experiment.told(rows))
    assert len(named) == 9 + 3
    assert [n["slope_deg"] for n in named.values()][-3:] == [41.0, 20.0, 20.0]
    said = experiment.words(rows)
    assert "area depends most on speed across the fan (v_y, +0.1 m/s): -99.00 mm²." in said
    assert "slope, up to the right, depends most on all heights (+100.0 mm): +41.00 deg." in said


def test_the_shipped_surrogate_beats_the_fast_tier_and_the_glass_box_on_the_course():
    beads = read_beads(experiment._DATA)
    assert {b.path for b in beads} <= set(OBSTACLE_COURSE)
    best, glass = (load_surrogate(WEIGHTS / ladder.SHIPPED[key]) for key in ("best", "linear"))
    told = [set(model.card["beads"][k]) for model in (best, glass) for k in ("train", "held_out")]
    assert not {f"{b.path}/{b.draw}" for b in beads} & set.union(*told)
    scores = {}
    for name, predict in (
        ("best", best.predict),
        ("glass", glass.predict),
        ("fan", lambda bead: features(bead).fan()),
    ):
        rows = [metrics.scores(predict(bead), bead) for bead in beads]
        scores[name] = [float(np.mean([r[key] for r in rows])) for key in ("iou", "area_error_pct")]
    for other in ("glass", "fan"):
        assert scores["best"][0] > scores[other][0]
        assert scores["best"][1] < scores[other][1]
