"""The error on the part: colours where the error is, and where it is not."""

import imageio.v2 as imageio
import numpy as np

from experiments.pictures import Recorder, plot_on_part
from seal_gym.core.frames import yaw_pose
from seal_gym.workpieces import catalogue


def colours(path, error):
    """How many pixels are as dark blue and as dark red as the ends of the scale."""
    run = Recorder(video=False)
    n = 200
    run.time_s = list(np.arange(n) / 30)
    run.s_mm = list(np.linspace(0.0, 300.0, n))
    run.tip_mm = [np.array([s - 150.0, -2.0, 2.0]) for s in run.s_mm]
    run.error_mm = list(np.full(n, error))
    run.part_pose = [yaw_pose(0.4, 1e-4 * k, 0.0, 1e-3 * k) for k in range(n)]
    plot_on_part(path, "test", catalogue.get("flat").surface, run)
    picture = imageio.imread(path)[:700, :, :3].astype(int)
    red, green, blue = np.moveaxis(picture, -1, 0)
    return ((blue > red) & (red < 80) & (green < 40)).sum(), ((red > 100) & (green < 20) & (blue < 20)).sum()


def test_small_errors_are_dark_blue_and_large_ones_dark_red(tmp_path):
    small_blue, small_red = colours(tmp_path / "small.png", 1e-4)
    large_blue, large_red = colours(tmp_path / "large.png", 20.0)
    assert small_blue > 1000 + large_blue
    assert large_red > 1000 + small_red
