"""Cost of both ROI images with the sensor stage, straight stretches and corners.

Run with ``python -m tests.benchmarks.bench_raycast`` from the checkout. The best of many frames is given, as
other work on the machine only ever adds to it.
"""

import time

import numpy as np

from seal_gym.core.cell import load_cell
from seal_gym.core.frames import tip_rotation, transform
from seal_gym.sim.look import Look, LookCfg
from seal_gym.sim.raycast import Raycaster
from seal_gym.sim.scene import build_scene
from seal_gym.workpieces import catalogue


def poses(name: str, n: int) -> np.ndarray:
    """Tip poses along the whole seam."""
    part, stand_off = catalogue.get(name), load_cell().process.stand_off_m
    position, tangent, approach = part.seam.at(np.linspace(0, part.seam.length, n))
    tip = transform(tip_rotation(tangent, approach), position + stand_off * approach)
    return np.asarray(part.pose @ tip)


def seconds(name: str, batch: int, threads: int, frames: int = 60, rounds: int = 8) -> np.ndarray:
    """Best time of each of ``frames`` places along the seam, shape (frames,), s a pair of images."""
    part, cell = catalogue.get(name), load_cell()
    caster = Raycaster(part.surface, cell, build_scene(part, cell).tool)
    look, rng = Look.empty(batch), np.random.default_rng(0)
    for i in range(batch):
        look.draw(i, rng, LookCfg())
    tips, pose = poses(name, frames), np.tile(part.pose, (batch, 1, 1))
    best = np.full(frames, np.inf)
    for _ in range(rounds):
        for k in range(frames):
            tip, counter = np.tile(tips[k], (batch, 1, 1)), np.full(batch, k, np.uint64)
            start = time.perf_counter()
            caster.render(tip, pose, look, counter, threads=threads)
            best[k] = min(best[k], (time.perf_counter() - start) / batch)
    return best


def main() -> None:
    """Prints the table."""
    seconds("flat", 1, 1, frames=1)  # compiles, or loads what was compiled
    for batch, threads in ((1, 1), (16, 1), (16, 2)):
        print(f"N = {batch}, {threads} thread(s)")
        for name in catalogue.NAMES:
            best = seconds(name, batch, threads, rounds=8 if batch == 1 else 2)
            print(
                f"  {name:<12}{best.mean() * 1e3:7.3f} ms a pair, {1 / best.mean():7.0f} pairs/s; "
                f"slowest place {best.max() * 1e3:6.3f} ms"
            )


if __name__ == "__main__":
    main()
