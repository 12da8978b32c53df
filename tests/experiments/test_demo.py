import json
from itertools import pairwise

import cv2
import imageio.v2 as imageio
import numpy as np
import pytest

from experiments import demo


def test_the_demo_writes_table_and_plot(tmp_path, capsys):
    code = demo.main(["--workpiece", "cylinder", "--seed", "500000", "--no-video", "--out", str(tmp_path)])
    assert code == 0
    assert "cylinder" in capsys.readouterr().out
    document = json.loads((tmp_path / "demo.json").read_text())
    (trial,) = document["trials"]
    assert trial["outcome"] == "reached"
    assert trial["rmse_mm"] < 0.06
    assert trial["env_spec"]["seed"] == 500_000
    plot = imageio.imread(tmp_path / "cylinder.png")
    assert plot.shape[0] > 800
    assert plot.std() > 5
    assert not (tmp_path / "cylinder.mp4").exists()


@pytest.mark.gl
def test_the_video_shows_a_run_of_the_users_seam(tmp_path):
    c = np.sqrt(0.5)
    seam = tmp_path / "mine.csv"
    seam.write_text(f"-0.02,0,0,0,{-c},{c}\n0.02,0,0,0,{-c},{c}\n")
    assert demo.main(["--seam", str(seam), "--out", str(tmp_path / "out")]) == 0
    video = cv2.VideoCapture(str(tmp_path / "out" / "mine.mp4"))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    video.release()
    assert len(frames) > 15
    assert frames[0].shape[2] == 3
    change = [np.abs(a.astype(int) - b).mean() for a, b in pairwise(frames)]
    assert np.median(change) > 0.1  # something moves


def test_a_seam_the_cell_cannot_seal_is_refused_in_one_line(tmp_path, capsys):
    seam = tmp_path / "far.csv"
    seam.write_text("2.0,0,0,0,0,1\n2.1,0,0,0,0,1\n2.2,nan,0,0,0,1\n")
    assert demo.main(["--seam", str(seam), "--no-video", "--out", str(tmp_path / "out")]) == 2
    assert "not finite" in capsys.readouterr().err


def test_bad_counts_are_refused(capsys):
    with pytest.raises(SystemExit):
        demo.parse(["--trials", "0"])
    assert "--trials 0: must be at least 1" in capsys.readouterr().err
