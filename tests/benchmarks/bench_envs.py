"""Speed of the environments next to the raw physics of the same model, in one run.

Run with ``python -m tests.benchmarks.bench_envs`` from the checkout. Ratios travel between machines, rates do
not.
"""

import subprocess
import sys
import time

import gymnasium as gym
import mujoco
import numpy as np

import seal_gym  # noqa: F401  # registers the ids
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore

_ROUNDS = 5
_FRAMES = 900
_FRESH = """
import gymnasium as gym, seal_gym, time
start = time.perf_counter()
env = gym.make("SealGym/{part}-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
print(time.perf_counter() - start)
"""


def raw_steps_s(core: SealCore) -> float:
    """Physics steps a second of one ``mj_step`` loop from an episode's start."""
    core.reset(0, np.random.default_rng(0))
    data, model = core.arm.data(0), core.scene.model
    data.ctrl[:] = data.qpos
    count = _FRAMES * core.cfg.cell.timing.substeps
    start = time.perf_counter()
    for _ in range(count):
        mujoco.mj_step(model, data)
    return count / (time.perf_counter() - start)


def single_steps_s(env: gym.Env) -> float:
    """Environment steps a second of ``gym.make``'s environment, wrappers and all."""
    action = np.zeros(env.action_space.shape, np.float32)
    env.reset(seed=0)
    start = time.perf_counter()
    for _ in range(_FRAMES):
        env.step(action)
    return _FRAMES / (time.perf_counter() - start)


def vector_steps_s(core: SealCore) -> float:
    """Environment steps a second of a vector."""
    for i in range(core.n):
        core.reset(i, np.random.default_rng(i))
    core.observe()
    action = np.zeros((core.n, core.adapter.size))
    frames = max(1, 8 * _FRAMES // core.n)
    start = time.perf_counter()
    for _ in range(frames):
        core.step(action)
        core.observe()
    return frames * core.n / (time.perf_counter() - start)


def first_step_s(part: str) -> float:
    """Seconds from ``gym.make`` to the end of the first step in a fresh process."""
    run = subprocess.run(
        [sys.executable, "-c", _FRESH.format(part=part)], capture_output=True, text=True, check=True
    )
    return float(run.stdout)


def main() -> None:
    """Prints the figures: the median of interleaved rounds."""
    for part in ("flat", "cylinder", "rectangular"):
        env = gym.make(f"SealGym/{part.title()}-v0", perception="oracle")
        one = SealCore(SealCfg.of(workpiece=part, perception="oracle"), 1)
        many = SealCore(SealCfg.of(workpiece=part, perception="oracle", threads=2), 64)
        rows = np.array(
            [(raw_steps_s(one), single_steps_s(env), vector_steps_s(many)) for _ in range(_ROUNDS)]
        )
        raw, single, vector = np.median(rows, axis=0)
        seeing = gym.make(f"SealGym/{part.title()}-v0")
        crowd = SealCore(SealCfg.of(workpiece=part, threads=2), 64)
        sight = np.median([(single_steps_s(seeing), vector_steps_s(crowd)) for _ in range(_ROUNDS)], axis=0)
        substeps = one.cfg.cell.timing.substeps
        fresh = np.median([first_step_s(part.title()) for _ in range(3)])
        print(
            f"{part:12} raw mj_step {raw:8.0f}/s = {raw / substeps:6.0f} frames/s | single {single:6.0f} "
            f"steps/s ({single * substeps / raw:.2f} of raw) | vector of 64, 2 threads {vector:6.0f} steps/s "
            f"({vector * substeps / raw:.2f}) | by vision {sight[0]:6.0f} and {sight[1]:6.0f} steps/s "
            f"| first step {fresh:.2f} s after gym.make"
        )


if __name__ == "__main__":
    main()
