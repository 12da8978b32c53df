"""A million random-action steps over every id and control mode: no crash, no NaN, no growing memory.

Run with ``python -m tests.benchmarks.soak`` from the checkout (``--steps``, ``--seed``, ``--num``).
"""

import argparse
import resource
import sys
import time
from itertools import product
from pathlib import Path

import gymnasium as gym
import numpy as np
from tqdm import tqdm

import seal_gym
from seal_gym.envs.adapters import CONTROLS
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore


def resident_mib() -> float:
    """Memory that is resident now [MiB]."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 2**20


def soak(core: SealCore, steps: int, seed: int) -> dict[str, int]:
    """Steps all simulations with random actions, resetting those that end; counts the outcomes."""
    rngs = [np.random.default_rng([seed, i]) for i in range(core.n)]
    actions = np.random.default_rng(seed)
    for i, rng in enumerate(rngs):
        core.reset(i, rng)
    core.observe()
    outcomes = dict.fromkeys(("reached", "collision", "lost", "timeout"), 0)
    for _ in range(max(1, steps // core.n)):
        # Walks as well as white noise: a tip that gets nowhere meets nothing.
        action = actions.uniform(-1.0, 1.0, (core.n, core.adapter.size)) * actions.choice((0.02, 0.3, 1.0))
        result = core.step(action)
        observation = core.observe()
        arrays = {"observation": observation, "reward": result.reward, "q": core.arm.q, "qd": core.arm.qd}
        bad = [name for name, values in arrays.items() if not np.isfinite(values).all()]
        if bad:
            raise SystemExit(f"not finite: {bad}")
        for i in np.flatnonzero(result.terminated | result.timeout):
            outcomes[core.episode_metrics(int(i), result)["outcome"]] += 1
            core.reset(int(i), rngs[i])
    return outcomes


def main() -> int:
    """Runs the soak and prints its figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--num", type=int, default=16, help="simulations at once")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    cases = list(product(seal_gym.ENV_IDS, CONTROLS))
    share = options.steps // len(cases)
    start, begun, memory = resident_mib(), time.perf_counter(), []
    for env_id, control in tqdm(cases, unit="case"):
        part = gym.spec(env_id).kwargs["workpiece"]
        core = SealCore(SealCfg.of(workpiece=part, control=control, threads=2), options.num)
        outcomes = soak(core, share, options.seed)
        memory.append(resident_mib())
        print(f"{env_id} {control}: {share // options.num * options.num} steps, {outcomes}")
    seconds = time.perf_counter() - begun
    print(
        f"{options.steps} steps in {seconds:.0f} s; memory {start:.0f} MiB before, {memory[0]:.0f} after "
        f"the first case, {memory[len(memory) // 2]:.0f} half way, {memory[-1]:.0f} at the end"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
