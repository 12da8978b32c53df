"""What sealant costs of a step by vision, frame by frame beside the same run without, in one process.

Run with ``python -m tests.benchmarks.bench_sealant`` from the checkout.
"""

import time

import numpy as np

from agents import load_policy
from agents.pressure import with_pressure
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore

_FRAMES, _FIRST = 500, 100  # the bead is under way by then


def main() -> None:
    """Prints medians of the processor time of a step and its observation."""
    motion = load_policy("rmp_expert")
    for part in ("flat", "cylinder", "rectangular"):
        cores = [
            SealCore(SealCfg.of(workpiece=part, control="rmp", sealant=sealant), 1)
            for sealant in (False, True)
        ]
        cfg = cores[1].cfg
        policies = (motion, with_pressure(motion, cfg.cell, cfg.sealant, "regulated"))
        spent = np.empty((2, _FRAMES))
        for core in cores:
            core.reset(0, np.random.default_rng(0))
        seen, states = [core.observe() for core in cores], [None, None]
        for frame in range(_FRAMES):
            for k, (core, policy) in enumerate(zip(cores, policies, strict=True)):
                action, states[k] = policy.predict(seen[k], states[k])
                start = time.process_time()
                core.step(action)
                seen[k] = core.observe()
                spent[k, frame] = time.process_time() - start
        plain, laid = 1e6 * np.median(spent[:, _FIRST:], axis=1)
        print(
            f"{part:12} {plain:6.0f} us a step, with sealant {laid:6.0f} us: "
            f"{100 * (laid / plain - 1):.0f} % more"
        )


if __name__ == "__main__":
    main()
