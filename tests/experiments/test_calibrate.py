import json

import numpy as np
import pytest

from experiments import calibrate
from seal_gym.core.cell import load_cell


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrate")
    arguments = ["--views", "8", "--trials", "1", "--parts", "2", "--gl-parts", "0", "--out", str(folder)]
    assert calibrate.main(arguments) == 0
    return folder


def test_true_found_and_error_are_written(out):
    document = json.loads((out / "calibrate.json").read_text(encoding="utf-8"))
    assert [(r["camera"], r["tip_poses"]) for r in document["rows"]] == [
        (camera, arm) for camera in ("front", "side") for arm in ("exact", "arm")
    ]
    for camera in load_cell().cameras:
        values = document["values"][camera.name]
        assert values["focal length"]["true"] == [camera.focal_px]
        assert values["position"]["true"] == list(camera.position_mm)
        assert values["focal length"]["found"] == pytest.approx([camera.focal_px], rel=5e-3)
        assert values["position"]["found"] == pytest.approx(list(camera.position_mm), abs=0.5)
        assert values["nozzle mouth"]["found"] != values["nozzle mouth"]["true"]
    for row in document["rows"]:
        assert row["position_mm_rms"] == row["position_mm_max"]  # of one trial
        assert (row["trials"], row["views"]) == (1, 8)
    parts = document["parts"]
    assert [(r["workpiece"], r["regime"]) for r in parts] == [
        (part, regime) for part in ("flat", "cylinder", "rectangular") for regime in ("static", "dynamic")
    ]
    assert all(r["renderer"] == "software" and r["trials"] == 2 and r["seen_pct"] == 100 for r in parts)
    assert all(0 < r["level_mm_rms"] <= r["level_mm_max"] < 0.5 for r in parts)
    table = (out / "calibrate.md").read_text(encoding="utf-8")
    assert "| front  | focal length" in table and "400.0000" in table
    assert (out / "calibrate.png").stat().st_size > 50_000


def test_the_calibrated_cell_file_is_read(out):
    found, true = load_cell(out / "calibrate.cell.toml"), load_cell()
    document = json.loads((out / "calibrate.json").read_text(encoding="utf-8"))
    for camera, nominal in zip(found.cameras, true.cameras, strict=True):
        assert camera.roi_px == nominal.roi_px
        assert [camera.focal_px] == document["values"][camera.name]["focal length"]["found"]
        np.testing.assert_allclose(camera.rotation, nominal.rotation, atol=5e-3)
    assert found.process == true.process and found.overhead == true.overhead


@pytest.mark.parametrize(
    "arguments",
    [["--views", "4"], ["--trials", "0"], ["--parts", "0"], ["--seed", "-1"], ["--gl-parts", "-1"]],
)
def test_impossible_numbers_are_refused(arguments, capsys):
    with pytest.raises(SystemExit):
        calibrate.parse(arguments)
    assert "must be at least" in capsys.readouterr().err


def test_tip_poses_are_in_reach_and_look_at_the_board():
    poses = calibrate.tip_poses(10, np.random.default_rng(0))
    assert poses.shape == (10, 4, 4)
    assert (np.abs(poses[:, :2, 3] - [0.45, 0.0]) <= 0.015).all()
    height = poses[:, 2, 3] + 0.05
    assert (height > 0.0119).all() and (height < 0.0601).all()
    assert (np.rad2deg(np.arccos(poses[:, 2, 2])) < 45).all()
