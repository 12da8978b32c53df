"""Compiles the kernels and fills their cache on disk, so that the first environment starts at once.

python -m seal_gym.warmup
"""

import numpy as np

from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore


def main() -> None:
    """Runs two frames with images and vision in every control mode."""
    for control in ("tip", "rmp", "joint"):
        core = SealCore(SealCfg.of(control=control, perception="vision", observation="features+images"), 1)
        core.reset(0, np.random.default_rng(0))
        core.observe()
        core.step(np.zeros((1, core.adapter.size)))
        core.observe()


if __name__ == "__main__":
    main()
