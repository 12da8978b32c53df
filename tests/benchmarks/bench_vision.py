"""Seam vision: both views of a frame, images to lines and features (target: 1.0 ms on one core)."""

import time

import numpy as np

from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore
from seal_gym.vision.features import RoiFeatures, ViewGeometry, update_features
from seal_gym.vision.perception import Perception
from seal_gym.workpieces import catalogue


def milliseconds(name: str, *, tracked: bool, rounds: int = 300) -> float:
    """Median time of a frame.

    Args:
        name: The part.
        tracked: Carry a track on, instead of looking for the seam anew.
        rounds: How often.

    Returns:
        Milliseconds.
    """
    core = SealCore(SealCfg(workpiece=name, observation="features+images"), 1)
    core.reset(0, np.random.default_rng(0))
    views, features = ViewGeometry.of(core.cfg.cell), RoiFeatures.zeros(1)
    eyes = Perception(1, views, core.sensors.nozzle, core.cfg.cell.timing.frame_s)
    images = [core.sensors.images(core.tip.pose, core.arm, np.array([k])) for k in range(32)]
    took = []
    for k in range(-40, rounds):
        seen = images[k % 32]
        if not tracked:
            eyes.reset(0)
        start = time.perf_counter()
        update_features(features, eyes.update(seen.front, seen.side, core.tip.pose), views)
        took.append(time.perf_counter() - start)
    return float(np.median(took[40:]) * 1e3)


def main() -> None:
    """Prints the table."""
    for name in catalogue.NAMES:
        print(
            f"  {name:<12}{milliseconds(name, tracked=True):7.3f} ms tracked, "
            f"{milliseconds(name, tracked=False):7.3f} ms from nothing"
        )


if __name__ == "__main__":
    main()
