"""The observer experiment: drawn palettes against their own labels, counts by hand, its files."""

import json

import numpy as np
import pytest

from experiments import observer, palette_methods, palette_pictures
from experiments.palette_pictures import CAMERA, COLOURS, LightCfg
from seal_gym.core.errors import ConfigError
from seal_gym.vision.palette_regions import RegionCfg, report_on
from seal_gym.vision.palette_segments import PaletteClass

FEW = {"level": (0.5, 1.0), "contrast": (1.0,), "slope": (0.0,), "noise": (4.0,)}


def palette(seed):
    rng = np.random.default_rng(seed)
    return palette_pictures.draw(palette_pictures.layout(rng), rng), rng


@pytest.fixture(scope="module")
def document(tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(observer, "SWEEPS", FEW)
        assert observer.main(["--trials", "1", "--out", str(out)]) == 0
    for name in ("observer.csv", "observer.md"):
        assert (out / name).stat().st_size > 1000
    for name in ("fig4", "fig6", "accuracy"):
        assert (out / f"observer_{name}.png").stat().st_size > 10_000
    return json.loads((out / "observer.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)


def test_rows_count_the_same_elements_for_every_method(document):
    rows = document["rows"]
    assert len(rows) == 2 * len(palette_methods.NAMES) * len(observer.WHATS)
    for what in observer.WHATS:
        assert len({r["elements"] for r in rows if r["class"] == what}) == 1
    for row in rows:
        if row["elements"] and row["regions"]:
            found = row["recall_pct"] * row["elements"]
            assert row["precision_pct"] * row["regions"] == pytest.approx(found)


def test_the_exact_network_finds_all_in_half_the_light_and_the_printed_none(document):
    rows = {(r["light"], r["method"], r["class"]): r for r in document["rows"]}
    for light in ("nominal", "level 0.5"):
        best = rows[light, "Hopfield, exact", "all"]
        assert best["recall_pct"] == best["precision_pct"] == 100.0
        assert best["centroid_px"] < 0.1
        assert rows[light, "Hopfield, Hebb as printed", "all"]["recall_pct"] == 0.0
    assert rows["level 0.5", "thresholds + components, fixed", "all"]["recall_pct"] == 0.0


def test_recall_and_masks(document):
    recall = {r["network"]: (r["table_1_rows"], r["table_2_rows"]) for r in document["recall"]}
    assert recall["exact"] == (8, 8)
    assert recall["Hebb as printed"] == (5, 4)
    assert recall["Hebb, best reading"] == (5, 7)
    assert recall["Hebb: all rows, inputs -1/1, constant unit, no feedback"] == (8, 8)
    masks = {(r["joined_by"], r["pixels"]): r for r in document["masks"]}
    assert masks["or (printed)", "cable"]["connector"] > 90.0
    assert masks["or (printed)", "palette"]["target"] > 99.0
    assert masks["and", "cable"]["connector"] < 5.0


def test_labels_depth_and_truth_of_a_drawn_palette_agree():
    truth, _ = palette(7)
    for kind in (PaletteClass.RIVET, PaletteClass.CONNECTOR):
        for k in np.flatnonzero(truth.classes == kind):
            x, y = truth.centroids_px[k].astype(int)
            assert truth.labels[y, x] == kind
            depth = CAMERA.position_mm[2] * 1e-3 - truth.positions_m[k][2]
            assert truth.depth_m[y, x] == pytest.approx(depth)
            np.testing.assert_allclose(
                palette_pictures.project(truth.positions_m[k]), truth.centroids_px[k], atol=1e-9
            )
    for kind in PaletteClass:
        pixels = truth.colour[truth.labels == kind]
        if len(pixels):
            np.testing.assert_allclose(np.median(pixels, axis=0), COLOURS[kind], atol=10)


def test_light_and_noise_do_what_they_say():
    truth, _ = palette(8)
    board = (truth.labels == PaletteClass.PALETTE) & (np.abs(truth.colour - truth.colour[0, 0]) < 8).all(
        axis=2
    )

    def seen(**light):
        cfg = LightCfg(**{"noise": 0.0, **light})
        return palette_pictures.photograph(truth, cfg, np.random.default_rng(1))[board].astype(float)

    plain = truth.colour[board]
    np.testing.assert_allclose(seen().mean(axis=0), plain.mean(axis=0), atol=0.1)
    np.testing.assert_allclose(seen(level=0.5).mean(axis=0), 0.5 * plain.mean(axis=0), atol=0.1)
    dull = 128 + 0.3 * (plain.mean(axis=0) - 128)
    np.testing.assert_allclose(seen(contrast=0.3).mean(axis=0), dull, atol=0.1)
    assert (seen(noise=8.0) - seen()).std() == pytest.approx(8.0, rel=0.02)
    sloped = seen(level=0.5, slope=0.5) / (0.5 * plain)
    assert sloped.min() == pytest.approx(0.5, abs=0.05)
    assert sloped.max() == pytest.approx(1.5, abs=0.05)
    with pytest.raises(ConfigError, match=r"LightCfg.level = -1.0: must be within 0..4"):
        LightCfg(level=-1.0)


def test_pairs_are_one_to_one_and_near():
    truth = np.array([[0.0, 0.0], [10.0, 0.0], [50.0, 50.0]])
    seen = np.array([[9.0, 0.0], [1.0, 0.0], [2.0, 0.0], [90.0, 50.0]])
    assert sorted(observer.matched(truth, seen, 6.0)) == [(0, 1), (1, 0)]
    assert observer.matched(truth, np.empty((0, 2)), 6.0) == []


def test_judging_counts_by_hand():
    truth, rng = palette(9)
    rgb = palette_pictures.photograph(truth, LightCfg(), rng)
    named = palette_methods.methods()["Hopfield, exact"](rgb)
    rivets = np.flatnonzero(truth.classes == PaletteClass.RIVET)
    x, y = truth.centroids_px[rivets[0]].astype(int)
    # One rivet becomes a conflict, another goes unseen.
    classes, conflict = named.classes.copy(), named.conflict.copy()
    near = np.s_[y - 12 : y + 13, x - 12 : x + 13]
    conflict[near] = classes[near] == PaletteClass.RIVET
    classes[near][conflict[near]] = PaletteClass.UNKNOWN
    x, y = truth.centroids_px[rivets[1]].astype(int)
    classes[y - 12 : y + 13, x - 12 : x + 13] = PaletteClass.PALETTE
    report = report_on(
        type(named)(classes=classes, conflict=conflict), rgb, truth.depth_m, CAMERA, RegionCfg()
    )
    counts = observer.judged(report, truth)
    n = len(rivets)
    assert counts["rivet"][:4].tolist() == [n, n - 2, n - 2, 1]
    everything = int(np.isin(truth.classes, observer.ELEMENTS).sum())
    assert counts["all"][:4].tolist() == [everything, everything - 2, everything - 2, 1]


def test_nearest_neighbours_know_the_colours_they_were_taught():
    methods = palette_methods.methods()
    for kind in observer.ELEMENTS[:4]:
        rgb = np.full((8, 8, 3), COLOURS[kind], dtype=np.uint8)
        for name in ("k-NN", "k-NN, many lights"):
            assert (methods[name](rgb).classes == kind).all()


@pytest.mark.parametrize("arguments", [["--trials", "0"], ["--jobs", "0"], ["--seed", "-1"]])
def test_options_out_of_range_end_the_program(arguments, capsys):
    with pytest.raises(SystemExit):
        observer.parse(arguments)
    assert "must be at least" in capsys.readouterr().err
