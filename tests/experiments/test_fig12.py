import csv
import json

import imageio.v2 as imageio
import numpy as np
import pytest

from experiments import fig12, photo_seams


def test_a_small_run_writes_everything(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(fig12, "LEVELS_DB", (20, -6))
    assert fig12.main(["--frames", "3", "--no-photos", "--out", str(tmp_path)]) == 0
    assert "| canny |" in capsys.readouterr().out
    document = json.loads((tmp_path / "fig12.json").read_text())
    rows = document["rows"]
    with (tmp_path / "fig12.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(rows)
    cells = {(r["chosen"], r["method"], r["stage"], r["part"], r["level_db"]) for r in rows}
    # Two levels with both sets of settings, and frames as in a run.
    assert len(cells) == len(rows) == 6 * 2 * 4 * (2 * 2 + 1)
    for row in rows:
        assert row["frames"] == (18 if row["part"] == "all" else 6)
        if row["level_db"] is not None:
            assert row["snr_db"] == pytest.approx(row["level_db"], abs=0.05)

    def lost(level):
        return np.mean([r["failed_pct"] for r in rows if r["level_db"] == level and r["part"] == "all"])

    assert lost(20) < 5 and lost(-6) > lost(20) + 20
    for name in ("front", "side", "snr", "snr_in_noise"):
        picture = imageio.imread(tmp_path / f"fig12_{name}.png")
        assert min(picture.shape[:2]) > 400 and picture.std() > 10


def test_panels_show_a_corner_where_there_is_one():
    assert fig12.panel_frame("rectangular", 500_000).corner.all()
    assert fig12.panel_frame("flat", 500_000).seed[0] == 500_000


def test_the_ramp_of_a_photographs_seam_is_where_it_should_be():
    p, q, t_ref = 22.3, 0.1, 20.0
    for ramp in (1.0, 3.0):
        share = photo_seams.cover(p, q, t_ref, ramp)
        # What is not covered of a row is the line's distance from the left border.
        t = np.arange(photo_seams.LENGTH) + 0.5
        np.testing.assert_allclose((1 - share).sum(axis=1), p + q * (t - t_ref), atol=0.01)
        partly = ((share > 1e-9) & (share < 1 - 1e-9)).sum(axis=1)
        assert ramp <= partly.mean() <= ramp + 1.5


def test_seams_in_photographs():
    pytest.importorskip("skimage")
    for name in ("brick", "coffee"):
        seams = photo_seams.draw(name, 12, 500_000)
        again = photo_seams.draw(name, 2, 500_005)
        np.testing.assert_array_equal(seams.strip[5:7], again.strip)
        assert seams.strip.shape == (12, 100, 50, 3)
        assert seams.strip.reshape(12, -1).std(axis=1).min() > 8  # no empty picture
        grey = seams.strip.astype(float).mean(axis=3)
        columns = np.arange(50) + 0.5
        for g, (p, q) in zip(grey, seams.truth, strict=True):
            line = p + q * (np.arange(100) + 0.5 - seams.reference[0])
            right = columns[None] > line[:, None] + 2
            left = columns[None] < line[:, None] - 2
            assert g[right].mean() > g[left].mean() + 10  # the plate is the brighter side


def test_only_photographs_that_come_with_the_package():
    data = pytest.importorskip("skimage.data")
    from pathlib import Path

    files = {f.stem for f in Path(data.__file__).parent.iterdir()}
    names = {"clock": "clock_motion"}
    assert {names.get(n, n) for n in photo_seams.PHOTOS} <= files


def test_a_row_of_photographs():
    pytest.importorskip("skimage")
    rows = fig12.photo_rows("gravel", 12, 500_000)
    assert {(r["method"], r["stage"]) for r in rows} == {
        (m, s) for m in fig12.LABELS for s in ("raw", "refined")
    }
    table = fig12.pooled(rows, {"part": "gravel"})
    assert [r["frames"] for r in table] == [12] * len(table)
    assert max(r["offset_px"] for r in table) < 0.5


@pytest.mark.parametrize("arguments", [["--seed", "1000000"], ["--frames", "0"]])
def test_bad_options_are_refused(arguments):
    with pytest.raises(SystemExit):
        fig12.parse(arguments)
