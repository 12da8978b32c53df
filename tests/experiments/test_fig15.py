import json
import shlex

import imageio.v2 as imageio
import numpy as np
import pytest

from experiments import fig15
from seal_gym.core.frames import yaw_pose


def test_displacement_by_hand():
    start, now = yaw_pose(0.4, 0.1, 0.0, 0.2), yaw_pose(0.403, 0.104, 0.0, 0.2 - np.deg2rad(7.0))
    assert fig15.displacement(now, start) == pytest.approx((5.0, -7.0))


def test_the_figure_tells_what_the_part_did(tmp_path, monkeypatch):
    monkeypatch.setattr(fig15, "_GL", "disabled")
    options = "--policy rmp_expert --workpiece cylinder --perception oracle --seed 500003 --out"
    assert fig15.main([*shlex.split(options), str(tmp_path)]) == 0
    document = json.loads((tmp_path / "fig15_cylinder.json").read_text())
    rows, (trial,) = document["rows"], document["trials"]
    assert shlex.split(document["command"])[:3] == ["python", "-m", "experiments.fig15"]
    assert (document["regime"], trial["outcome"]) == ("dynamic", "reached")
    assert len(rows) == fig15.FRAMES
    assert (rows[0]["time_s"], rows[0]["shift_mm"], rows[0]["yaw_deg"]) == (0.0, 0.0, 0.0)
    assert rows[-1]["time_s"] == pytest.approx(trial["time_s"], abs=1e-3)
    assert np.all(np.diff([row["s_mm"] for row in rows]) > 0.0)
    assert 1.0 < max(row["shift_mm"] for row in rows) <= 20.0 + 1e-6  # severity 1
    assert 0.5 < max(abs(row["yaw_deg"]) for row in rows) <= 10.0 + 1e-6
    assert imageio.imread(tmp_path / "fig14_cylinder.png").std() > 5
    assert not (tmp_path / "fig15_cylinder.png").exists()  # no OpenGL, no frames


@pytest.mark.gl
def test_the_frames_are_drawn(tmp_path):
    options = "--policy rmp_expert --workpiece cylinder --perception oracle --out"
    assert fig15.main([*shlex.split(options), str(tmp_path)]) == 0
    picture = imageio.imread(tmp_path / "fig15_cylinder.png")
    assert min(picture.shape[:2]) > 700
    assert picture.std() > 20
    assert (tmp_path / "fig15_cylinder.mp4").stat().st_size > 100_000
